"""A controller that follows a record, where the one that made it is not known."""

from dataclasses import replace
from typing import Any

import control as ct
import numpy as np

from .._base.errors import CtrlidError
from ..data.record import Record
from ..loop.loop import Loop
from ..loop.period_map import comes_to_rest


def following(loop: Loop, record: Record) -> Loop | None:
    r"""Return a loop whose output follows that of a record, driven by its input.

    .. math:: u = u_{record} + C (y_{record} - y)

    With the recorded input alone an unstable plant leaves the record at once. C is the normalized
    linear quadratic Gaussian controller of the linearized plant: input and output count by their
    standard deviations in the record, and so do the noises at input and output.

    Parameters
    ----------
    loop : Loop
        The model, without a controller.
    record : Record
        What it follows.

    Returns
    -------
    Loop or None
        The loop with C; None where no such controller keeps it stable.

    References
    ----------
    Jonckheere and Silverman, IEEE Transactions on Automatic Control 28 (1983) 953-964.
    """
    try:
        plant = ct.ss(loop.linearize())
        plant = plant if plant.dt else ct.sample_system(plant, loop.dt, "zoh")
        u, y = (max(float(np.std(v[record.valid])), 1e-300) for v in (record.u, record.y))
        made = replace(loop, controller=_normalized(plant, u, y))
        return made if comes_to_rest(made) else None
    except (CtrlidError, ValueError, np.linalg.LinAlgError):
        return None


def _normalized(plant: Any, u: float, y: float) -> Any:
    """Return the controller for a plant in discrete time, by the sizes of its input and output."""
    a, b, c = plant.A, plant.B * u, plant.C / y
    feedback, _, _ = ct.dlqr(a, b, c.T @ c, np.eye(1))
    gain, _, _ = ct.dlqe(a, np.eye(len(a)), c, b @ b.T, np.eye(1))
    # The estimate is predicted: what is measured acts at the next sample.
    through = a @ gain
    matrix = a - b @ feedback - through @ c
    return ct.ss(matrix, through / y, feedback * u, 0, plant.dt)
