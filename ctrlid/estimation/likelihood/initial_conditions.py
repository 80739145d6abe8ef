"""What is known of a plant where a record begins: its state, and the input that came before."""

from typing import Any

import casadi
import numpy as np

from ..._base.arrays import Array
from ...physics.block_evaluation import BlockEvaluation
from ...physics.equations import Equations
from ...physics.integration import delay_of
from .backlash import follow_backlash
from .filter_data import FilterData
from .transition_maps import PeriodPlan

FORGOTTEN = 200  # samples after which one looks whether a play has forgotten how it began
LASTING = 10  # samples: an error that stays moves the plant as far as noise of so many variances
NEARLY = 0.01  # of the sensor's variance: how well what a lag shows is known where it is short


class InitialConditions:
    """How the record of a plan's plant begins.

    A lag begins near what it follows. A play may lie anywhere in its gap, and what a delay still
    holds is unknown: until it has passed, the input is uncertain.
    """

    def __init__(self, plan: PeriodPlan) -> None:
        self.plan = plan
        self.lags = _lags(plan.equations)

    def memory(self, u: float, p: Array) -> tuple[float, float]:
        """Return the play's memory at the start, and how far off it may be."""
        e = self.plan.equations
        assert e.play is not None
        given = casadi.vertcat(e.play.u, e.p), casadi.vertcat(u, p)
        found = casadi.substitute(casadi.vertcat(e.play.start, e.play.reach), *given)
        start, reach = np.asarray(casadi.evalf(found), float).ravel().tolist()
        return start, reach

    def doubt(self, u: Array, p: Array) -> Array:
        """Return the variance of the input, as far as it is older than the record.

        Parameters
        ----------
        u : ndarray, shape (n,)
            The input.
        p : ndarray
            Values of all parameters.

        Returns
        -------
        ndarray, shape (n,)
            Variances, by the sample at which the input was computed.
        """
        e, variance = self.plan.equations, np.zeros(len(u))
        if e.play is not None:
            variance = shift_signal(self._forgetting(u, p), self.plan.late)
        if e.delay is not None:
            late = delay_signal(e, p) / self.plan.dt - np.arange(len(u))
            variance = variance + np.clip(late, 0.0, 1.0) ** 2 * np.var(u)
        return variance

    def _forgetting(self, u: Array, p: Array) -> Array:
        """Return the variance of the input behind the play, until it forgets how it began."""
        variance = np.zeros(len(u))
        middle, reach = self.memory(float(u[0]), p)
        ends, path = [middle - reach, middle + reach], follow_backlash(self.plan)
        for first in range(0, len(u), FORGOTTEN):
            some = u[first : first + FORGOTTEN]
            memories = [path.memories(z, some, p) for z in ends]
            low, high = (path.slopes(m[None, :-1], some[None, :], p)[0][:, 0, 0] for m in memories)
            variance[first : first + FORGOTTEN] = LASTING * (high - low) ** 2 / 12
            if high[-1] == low[-1]:
                break
            ends = [float(m[-1]) for m in memories]
        return variance

    def start(self, data: FilterData, p: Array) -> tuple[Array, Array]:
        """Return state and covariance at the start of a record, for parameter values `p`."""
        start, spread = data.start.copy(), data.spread.copy()
        u, y = data.u, data.y
        alone = not data.afresh[int(np.argmax(data.valid)) + 1 :].any()
        for k, shown, function in self.lags:
            time, target, near = (v[:, 0] for v in function(start if shown else u[None, :], p))
            late = float(time[0, 0]) / self.plan.dt
            if shown:
                spread[k] = spread[:, k] = near[0] @ spread
                wide = near[0] @ spread @ near[0]
                moved = late**2 * float(np.var(np.diff(y))) / data.scale**2
                spread[k, k] = wide + min(moved, wide) + NEARLY
            else:
                before = float(np.mean((target - start[k]) ** 2))
                if alone:  # as far as the input moves within the lag's time, if it does not return
                    start[k] = target[0, 0]
                    steps = float(np.var(np.diff(target[:, 0])))
                    before = min((1 + late / 2) * steps, 2 * float(np.var(target)))
                spread[k, k] = before / data.scale**2 + NEARLY
        return start, spread


def _lags(e: Equations) -> list[tuple[int, bool, BlockEvaluation]]:
    """Lags behind the input, or behind what the plant shows: whether so, time and target."""
    found = []
    for lag in e.lags:
        shown = not casadi.depends_on(lag.target, casadi.vertcat(e.t, e.u))
        driven = not casadi.depends_on(lag.target, casadi.vertcat(e.t, e.x))
        if shown != driven:
            near = casadi.densify(casadi.jacobian(lag.target, e.x))
            parts = [casadi.SX(lag.time_constant), lag.target, near]
            function = casadi.Function("lag", [e.x if shown else e.u, e.p], parts)
            found.append((lag.state, shown, BlockEvaluation(function)))
    return found


def delay_signal(e: Equations, p: Any) -> float:
    """Return the delay of the input [s] for parameter values `p`."""
    return float(casadi.evalf(delay_of(e, p)))


def shift_signal(values: Array, late: int) -> Array:
    """Return values so many samples later, or earlier if `late` is negative; the ends are held."""
    first = np.repeat(values[:1], max(late, 0), axis=0)
    last = np.repeat(values[-1:], max(-late, 0), axis=0)
    return np.concatenate([first, values[max(-late, 0) :], last])[: len(values)]
