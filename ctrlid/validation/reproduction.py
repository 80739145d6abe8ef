"""How a record is reproduced: predicted some samples ahead, or simulated open or closed loop."""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from ..data.record import Record
from ..loop.loop import Loop
from ..loop.period_map import comes_to_rest
from ..loop.wiring import knows_references
from ..physics.linearization import compute_state_matrices
from .controller_check import find_rejection
from .record_simulation import find_long_stretches
from .wired_controller_check import find_wired_rejection

Name = Literal["closed-loop simulation", "open-loop simulation", "prediction"]


@dataclass(frozen=True)
class Reproduction:
    """What is made of a record: a simulation, or a prediction `horizon` samples ahead.

    A prediction uses the measured output up to `horizon` samples before; a simulation uses none.
    `reason` says why it is no simulation, as a clause; empty where that is not known.
    """

    name: Name
    horizon: int = 0
    reason: str = field(default="", compare=False)

    def __str__(self) -> str:
        if not self.horizon:
            return self.name
        return f"{'one' if self.horizon == 1 else self.horizon}-step {self.name}"


ONE_STEP = Reproduction("prediction", 1)
OPEN_LOOP = Reproduction("open-loop simulation")
CLOSED_LOOP = Reproduction("closed-loop simulation")
# Why a record is predicted and not simulated.
NO_CONTROLLER = "no controller is given, and the plant alone does not come to rest"
NO_REFERENCE = "the record lacks a reference of the controller"
MISSING = "no stretch is long enough in which all readings are known that the controller had"
REJECTED = "the law of the controller is rejected, since it is not what computed the logged input"


def find_law_rejection(loop: Loop, record: Record) -> str:
    """Return why the stated law is not what computed the logged input; empty where it stands."""
    reject = find_rejection if loop.wiring is None else find_wired_rejection
    return reject(loop, record)


def choose_reproduction(loop: Loop, record: Record) -> Reproduction:
    """Return the most telling reproduction that there is: a simulation where one is possible.

    What a wrong law leaves of the logged input carries the measured output into a simulation, so
    that after a rejected law only a prediction remains, which does not contain the controller.
    """
    if loop.controller is None:
        return OPEN_LOOP if comes_to_rest(loop) else choose_prediction(loop, record, NO_CONTROLLER)
    if not knows_references(loop.wiring, record):
        return choose_prediction(loop, record, NO_REFERENCE)
    if record.valid.ndim == 2 and not find_long_stretches(record, loop):
        return choose_prediction(loop, record, MISSING)
    if find_law_rejection(loop, record):
        return choose_prediction(loop, record, REJECTED)
    return CLOSED_LOOP


def choose_prediction(loop: Loop, record: Record, reason: str = "") -> Reproduction:
    """Return the prediction over the time constant of the plant; `reason` says why not more."""
    poles = compute_moving_poles(loop)
    horizon = find_time_constant(poles, loop.equations().dt, record)
    return Reproduction("prediction", horizon, reason)


def compute_moving_poles(loop: Loop) -> Any:
    """Return the poles of a plant in motion, where dry friction does not damp it as at rest."""
    return np.linalg.eigvals(compute_state_matrices(loop.equations(), loop.point, spread=1e6)[0])


def find_time_constant(poles: Any, dt: float, record: Record) -> int:
    """Return the slowest unstable, or else the slowest stable, time constant in samples."""
    # A pole at z = 0 is infinitely fast, so that its logarithm is minus infinity.
    with np.errstate(divide="ignore", invalid="ignore"):
        rates = (np.log(poles.astype(complex)) / dt if dt else poles).real
    fast = rates[rates > 1e-6] if np.any(rates > 1e-6) else -rates[rates < -1e-6]
    slowest = float(np.min(fast)) if fast.size else 10 / record.duration
    return int(np.clip(round(1 / (slowest * record.dt)), 1, find_longest_horizon(record)))


def find_longest_horizon(record: Record) -> int:
    """Return how many samples ahead a record is predicted at most: a tenth of it."""
    return max(len(record) // 10, 1)
