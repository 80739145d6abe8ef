"""When something happened: instants that a fit by slopes does not come to."""

from dataclasses import replace

import numpy as np

from .._base.errors import CtrlidError
from ..estimation.likelihood.likelihood import Fit, evaluate
from ..estimation.likelihood.maximization import ELSEWHERE, climb

REACH = 2.0 ** np.arange(11)  # samples to either side


def timed(fit: Fit) -> Fit:
    """Return the fit with each instant, such as that of a step, where the record has it.

    The likelihood is rugged in an instant: its slope sees one sample. An instant that was found
    while other parameters or effects were not yet right may be some dozens off.

    Parameters
    ----------
    fit : Fit
        A fit with any parameters.

    Returns
    -------
    Fit
        The same, or one that is more likely.
    """
    machine = fit.problem.machine
    best = fit
    for k, name in enumerate(machine.names):
        while name.endswith(".time"):
            there = max((_moved(best, k, s * r) for r in REACH for s in (-1, 1)), key=_value)
            if not there.value > best.value + ELSEWHERE:
                break
            best = climb(there, rounds=4, exact=False)
    return best


def _moved(fit: Fit, k: int, samples: float) -> Fit:
    """Return the fit with one parameter, an instant, so many samples later."""
    problem, theta = fit.problem, fit.theta.copy()
    theta[k] = np.clip(theta[k] + samples * problem.machine.loop.dt, problem.lower[k],
                       problem.upper[k])  # fmt: skip
    try:
        return evaluate(problem, theta, fit.noise, [o.trajectory for o in fit.filtered])
    except CtrlidError:  # no such instant in this record
        return replace(fit, value=-np.inf)


def _value(fit: Fit) -> float:
    return fit.value if np.isfinite(fit.value) else -np.inf
