"""A loop's plant along a record: its map over a period, with derivatives, and the sensor."""

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi
import numpy as np

from ..._base.arrays import Array
from ..._base.errors import CtrlidError
from ...data.record import Record
from ...loop.loop import Loop
from ...physics.block_evaluation import BlockEvaluation, evaluate_blocks
from ...physics.equations import Equations
from ...physics.integration import Scheme, known_lags, whole_delay
from ...physics.linearization import state_matrices
from .backlash import follow_backlash
from .filter_data import FilterData, state_at_rest
from .initial_conditions import InitialConditions, delay_signal, shift_signal
from .transition_maps import PeriodPlan, build_maps

SLOW = 0.35  # rate times step up to which a step of order four is exact enough
MOST_STEPS = 100  # of order eight in a period: more make an expression that takes minutes to build
BRISK = 0.35  # of a lag's time constant: a step of order four that follows it exactly enough
ROUGH = 0.7  # the same beside the kink of friction, where no formula is more exact
FEW_STEPS = 3  # of order four, which cost less than one of order eight
SHARP_STEPS = 6  # of order four in the transient of a short lag, where friction has a kink
KINK_STEPS = 4  # of order four in a period where friction has a kink; twice as many beside a lag


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Where to linearize: states before and after each measurement, and their spreads."""

    predicted: Array
    filtered: Array
    spread: Array


@dataclass(frozen=True, eq=False)
class Linearized:
    """The plant along a trajectory, as `kalman.filter_pass` takes it."""

    step: Array
    a: Array
    b: Array
    du: Array
    dp: Array
    height: Array
    c: Array
    hp: Array
    doubt: Array  # variance of the input, relative to the sensor's
    start: Array
    spread: Array  # of the start: its covariance, relative to the sensor's variance
    trajectory: Trajectory


class SampledPlant:
    """The equations of a loop's plant made ready to be filtered along records.

    Machines whose equations differ in the values of their parameters only share their maps.

    Parameters
    ----------
    loop : Loop
        The loop; effects at their neutral values take part.
    names : sequence of str
        Parameters whose sensitivities are wanted.
    hold : {"zoh", "foh"}
        How the input runs between samples.
    follow : bool
        Whether a known analog controller moves the input between samples.
    """

    def __init__(self, loop: Loop, names: Sequence[str], hold: str, follow: bool) -> None:
        self.loop, self.names, self.hold = loop, tuple(names), hold
        e = self.e = loop.equations(keep=True)
        every = list(e.parameters)
        self.index = [every.index(name) for name in self.names]
        law = loop.law() if follow and e.play is None and e.delay is None else None
        self.law = law if law is not None and law.dt == 0.0 else None
        self.n = len(e.states)
        self.size = self.n + (len(self.law.rest) if self.law else 0)
        self.late = whole_delay(e, loop.dt)
        self.forces = e.velocities or tuple(range(self.n - len(e.rest)))
        # One force on all velocities; without any, each state has a noise of its own.
        self.channels = 1 if e.velocities else len(self.forces)
        self.scheme = _scheme(e, loop)
        self.plan = PeriodPlan(e, self.law, loop.dt, hold, self.scheme, self.forces, self.channels,
                         tuple(self.index), self.late)  # fmt: skip
        self.maps = build_maps(self.plan)
        self.onset = InitialConditions(self.plan)

    def _period(self, stages: Sequence[BlockEvaluation], x: Array, *given: Any) -> list[Array]:
        """Go through a period; return the state after it and its derivatives, by itself first."""
        if not self.maps.carries:
            return evaluate_blocks(stages, [], [x, *given, 0])
        n = self.size
        widths = [size // n for size in stages[0].sizes[2 : -len(given) - 1]]
        still = [np.eye(n).ravel(), *(np.zeros(n * k) for k in widths)]
        return evaluate_blocks(stages, [x, *still], given, self.maps.parts)

    @property
    def position(self) -> int:
        """Index of the state whose rate is the first velocity."""
        e, v = self.e, self.e.velocities[0]
        rates = [casadi.simplify(e.rhs[k]) for k in range(self.n) if k != v]
        found = [casadi.is_equal(rate, e.x[v], 2) for rate in rates]
        return [k for k in range(self.n) if k != v][found.index(True)]

    def values(self, theta: Any) -> Array:
        """Return all parameter values with `theta` in the places of the free ones."""
        p = self.e.values.copy()
        p[self.index] = theta
        return p

    def fits(self, theta: Array) -> bool:
        """Whether the map was built for such values of a delay or of a lag."""
        e, dt = self.e, self.loop.dt
        p = casadi.SX(casadi.DM(self.values(theta)))
        if e.delay is not None:
            late = delay_signal(e, p) / dt + 1e-9
            if not self.late <= late <= self.late + 1 + 1e-6:
                return False
        time, scheme = _shortest(e, p), self.scheme
        if scheme.sharp:
            return time < dt / 4
        return time > (dt / scheme.steps / (2 * _brisk(e)) if scheme.order == 4 else dt / 16)

    def linearize(self, data: FilterData, theta: Array, at: Trajectory) -> Linearized:
        """Return the plant along a trajectory, for parameter values `theta`."""
        p = self.values(theta)
        u = data.u
        applied, slopes = self._through_play(u, p)
        doubt = data.doubt + self.onset.doubt(u, p) / data.scale**2
        w = self._inputs(data, applied)
        spread = at.spread[:, : self.n].T
        given = (at.filtered.T, w, p, spread, np.zeros(self.channels))
        step, a, b, dp, *moved = self._period(self.maps.stages, *given)
        # How the input moves the state matters only where the input is not what was measured.
        du = np.zeros((len(u), self.size))
        rows = np.flatnonzero(doubt)
        if slopes is not None:
            dw = _full(moved[0], len(u))
            du = dw.sum(axis=2)
            dp = _full(dp, len(u)).copy()
            for k in (-1, 0, 1):
                dp += dw[:, :, k + 1, None] * shift_signal(slopes, self.late - k)[:, None, :]
        elif len(rows):
            du[rows] = self._moved(rows, given, 1e-3 * float(np.std(u[data.valid])))
        start, wide = self.onset.start(data, p)
        height, c, hp = self.maps.sensor(at.predicted.T, w, p, spread)
        return Linearized(
            _full(step, len(u))[:, :, 0], _full(a, len(u)), _full(b, len(u)),
            du, _full(dp, len(u)), _full(height, len(u))[:, 0, 0],
            _full(c, len(u))[:, 0, :], _full(hp, len(u))[:, 0, :], doubt,
            self.padded(start), self.padded(wide), at,
        )  # fmt: skip

    def _moved(self, rows: Any, given: Sequence[Array], h: float) -> Array:
        """Return by differences how the state after the samples `rows` depends on the input."""
        x, w, p, spread, force = given
        path = np.array([0.0, 1.0, 1.0, 1.0, 0.0, 0.0])[:, None]
        above, below = (
            self._period(
                self.maps.stages, x[:, rows], w[:, rows] + s * h * path, p, spread[:, rows], force
            )[0]
            for s in (1, -1)
        )
        slope: Array = (above - below)[:, :, 0] / (2 * h)
        return slope

    def _through_play(self, u: Array, p: Array) -> tuple[Array, Array | None]:
        """Return the input behind the play, and how it depends on the free parameters."""
        if self.e.play is None:
            return u, None
        return follow_backlash(self.plan).along(self.onset.memory(float(u[0]), p)[0], u, p)

    def with_slopes(self) -> casadi.Function:
        """Return one period of the plant, as it is, together with that of its sensitivities.

        ``f(z, w, p) -> (next z, y and its slopes)``; z stacks the state and its derivatives by the
        free parameters and the initial state, w is a column of `inputs`.
        """
        n, p = self.size, len(self.index)
        x, s, w, values = (casadi.SX.sym(k, *size) for k, size in (
            ("x", (n, 1)), ("s", (n, p + n)), ("w", (6, 1)), ("p", self.e.p.shape)))  # fmt: skip
        still, quiet = casadi.SX.zeros(self.n), casadi.SX.zeros(self.channels)
        y, c, hp = self.maps.sensor_function(x, w, values, still)
        seen = casadi.mtimes(c, s) + casadi.horzcat(hp, casadi.SX.zeros(1, n))
        widths = [self.channels, p] + ([] if self.e.play is None else [3])
        stage = [x, casadi.SX.eye(n), *(casadi.SX(n, width) for width in widths)]
        carried = len(stage) if self.maps.carries else 1
        for function, part in itertools.product(self.maps.functions, range(self.maps.parts)):
            stage = function.call([*stage[:carried], w, values, still, quiet, part])
        after, a, _, dp, *_ = stage
        moved = casadi.mtimes(a, s) + casadi.horzcat(dp, casadi.SX.zeros(n, n))
        return casadi.Function(
            "period", [casadi.vertcat(x, casadi.vec(s)), w, values],
            [casadi.vertcat(after, casadi.vec(moved)), casadi.vertcat(y, seen.T)], {"cse": True},
        )  # fmt: skip

    def inputs(self, data: FilterData, theta: Array) -> Array:
        """Return the rows over which the map is evaluated, shape (6, n), behind any play."""
        return self._inputs(data, self._through_play(data.u, self.values(theta))[0])

    def advance(self, data: FilterData, x: Array, rows: Any, known: bool = True) -> Array:
        """Return states (k, n) one period after the samples `rows`, with the loop's parameters."""
        p = self.e.values
        w = self._inputs(data, self._through_play(data.u, p)[0])[:, rows]
        if not known:
            w[5] = self.height(data, x, rows)
        quiet = np.zeros((self.n, 1))
        return self._period(self.maps.stages, x.T, w, p, quiet, np.zeros(self.channels))[0][:, :, 0]

    def height(self, data: FilterData, x: Array, rows: Any) -> Array:
        """Return the outputs at states (k, n) and the samples `rows`."""
        p = self.e.values
        w = self._inputs(data, self._through_play(data.u, p)[0])[:, rows]
        return self.maps.sensor(x.T, w, p, np.zeros((self.n, 1)))[0][:, 0, 0]

    def _inputs(self, data: FilterData, applied: Array) -> Array:
        """Return the rows (t, input before, now, ahead, r, y) over which the map is evaluated."""
        t, r, y = data.t, data.r, data.y
        moved = [shift_signal(applied, self.late - k) for k in (-1, 0, 1)]
        return np.vstack([t, *moved, r, y])

    def padded(self, values: Array) -> Array:
        """Add the states of a known analog controller, at rest, to a start."""
        extra = self.size - values.shape[0]
        return np.pad(values, [(0, extra)] * values.ndim)


def _full(values: Array, n: int) -> Array:
    """Repeat what does not depend on the sample."""
    return values if values.shape[0] == n else np.repeat(values, n, axis=0)


def _scheme(e: Equations, loop: Loop) -> Scheme:
    """Return how a period is integrated: as cheaply as the plant and its lags allow."""
    if e.dt:
        return Scheme(4, 1)
    hidden = [lag.state for lags in known_lags(e) for lag in lags]
    plain = [k for k in range(len(e.states)) if k not in hidden]
    time = _shortest(e, casadi.SX(casadi.DM(e.values)))
    driven, cut = np.isfinite(time), bool(time < loop.dt / 8)
    # The filter's own uncertainty smooths kinks; sharp friction does not make the plant stiff.
    try:
        point = replace(loop.point, states=state_at_rest(loop, e))
        a = state_matrices(e, point, spread=1e6)[0][np.ix_(plain, plain)]
    except CtrlidError:
        return Scheme(8, 2, (8, 2) if cut else None)
    rate = float(np.max(np.abs(np.linalg.eigvals(a)), initial=0.0)) * loop.dt
    if rate <= 3 * SLOW:
        # A velocity that turns within a period crosses the kink of friction there.
        few = max(KINK_STEPS if e.kinked else 1, math.ceil(rate / SLOW))
        if not driven:
            return Scheme(4, few)
        if cut and e.kinked:  # no order is high enough for a kink
            return Scheme(4, few, (4, SHARP_STEPS))
        # What a lag of the input does is known exactly; the plant has to follow it.
        few = max(2 * few if e.kinked else few, 2, math.ceil(loop.dt / time / _brisk(e)))
        if e.kinked or few <= FEW_STEPS:
            return Scheme(4, few)
    steps = max(2 if e.kinked else 1, math.ceil(rate / 1.5))
    if steps > MOST_STEPS:
        raise CtrlidError(
            f"{e.name} moves at {rate / loop.dt:.3g} rad/s, {rate:.3g} times faster than it is "
            "sampled; what settles within a sample is a constant for the filter: leave that motion "
            "out of the plant, or sample faster"
        )
    return Scheme(8, steps, (8, steps) if cut else None)


def _brisk(e: Equations) -> float:
    return ROUGH if e.kinked else BRISK


def _shortest(e: Equations, p: Any) -> float:
    """Return the time constant of the lag that follows the input; infinite without one."""
    for lag in known_lags(e)[0]:
        return float(casadi.evalf(casadi.substitute(casadi.SX(lag.time_constant), e.p, p)))
    return math.inf


@functools.lru_cache(maxsize=8)
def make_sampled_plant(loop: Loop, names: tuple[str, ...], hold: str, follow: bool) -> SampledPlant:
    """Return the plant of a loop, made once."""
    return SampledPlant(loop, names, hold, follow)


def sampled_plant_for(loop: Loop, names: Sequence[str], record: Record) -> SampledPlant:
    """Return the plant of a loop for records of one kind."""
    follow = record.r is not None and loop.analog
    return make_sampled_plant(loop, tuple(names), record.hold, follow)
