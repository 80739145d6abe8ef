"""A loop's plant along a record: its map over a period, with derivatives, and the sensor."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np

from ..._base.arrays import Array
from ...data.reconstruction import count_pieces
from ...loop.loop import Loop
from ...loop.period_map import find_memory_range
from ...physics.block_evaluation import BlockEvaluation, evaluate_blocks
from ...physics.equations import Equations
from ...physics.integration import count_delay_samples, substitute_delay
from .filter_data import FilterData, find_rest_state
from .input_memory import InputRange, find_input_range
from .transition_maps import (
    PeriodPlan,
    build_maps,
    choose_scheme,
    is_scheme_suitable,
)

# What a short lag follows is known within this share of the sensor's variance.
NEARLY = 0.01


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Where to linearize: states before and after each measurement, and their spreads."""

    predicted: Array
    filtered: Array
    spread: Array


@dataclass(frozen=True, eq=False)
class Linearized:
    """The plant along a trajectory, as `kalman_recursion.filter_pass` takes it."""

    step: Array
    a: Array
    b: Array
    du: Array
    dp: Array
    output: Array
    c: Array
    hp: Array
    # Variance of the input at each sample, relative to that of the sensor noise.
    input_variance: Array
    start: Array
    # Covariance of the initial state, relative to the variance of the sensor noise.
    spread: Array
    trajectory: Trajectory


class SampledPlant:
    """The equations of a loop's plant made ready to be filtered along records.

    Sampled plants whose equations differ only in the values of their parameters share their maps.

    Parameters
    ----------
    loop : Loop
        The loop; effects at their neutral values take part.
    names : sequence of str
        Parameters whose sensitivities are wanted.
    hold : {"zoh", "foh", "bandlimited"}
        How the input runs between samples.
    sees : {"", "reading", "output"}
        What a known analog controller sees that moves the input between samples: the readings with
        their noise, which stays over a period, or the output itself, where the noise is that of the
        logger. Empty: the input is that of the record.
    hold_r : {"zoh", "foh"}, optional
        How the reference runs between samples, as such a controller sees it.
    """

    def __init__(
        self, loop: Loop, names: Sequence[str], hold: str, sees: str, hold_r: str = "zoh"
    ) -> None:
        self.loop, self.names, self.hold = loop, tuple(names), hold
        e = self.e = loop.equations(keep=True)
        every = list(e.parameters)
        self.index = [every.index(name) for name in self.names]
        law = loop.law() if sees and e.memory is None and e.delay is None else None
        self.law = law if law is not None and law.dt == 0.0 else None
        self.hold_r = hold_r if self.law else "zoh"
        self.sees = sees if self.law else ""
        self.n = len(e.states)
        self.pieces = count_pieces(hold)
        self.delay_samples = count_delay_samples(e, loop.dt / self.pieces)
        self.forces = e.velocities or tuple(range(self.n - len(e.rest)))
        # One force on all velocities; without any, each state has a noise of its own.
        self.channels = 1 if e.velocities else len(self.forces)
        if not e.siso or e.pushes is not None:
            self.channels = len(self.forces)
        self.scheme = choose_scheme(e, loop, loop.dt / self.pieces, self.law)
        self.plan = PeriodPlan(e, self.law, loop.dt, hold, self.scheme, self.forces, self.channels,
                         tuple(self.index), self.delay_samples, self.hold_r, self.sees)  # fmt: skip
        # What the filter estimates beside those: where a backlash stood when the record began.
        self.size = self.plan.size + (e.memory is not None)
        self.maps = build_maps(self.plan)
        self.initial_conditions = InitialConditions(self.plan)

    def of_loop(self, loop: Loop, names: Sequence[str]) -> SampledPlant:
        """Return the plant of another loop, for the same kind of record."""
        return SampledPlant(loop, names, self.hold, self.sees, self.hold_r)

    def _evaluate_transition(
        self, stages: Sequence[BlockEvaluation], x: Array, *given: Any
    ) -> list[Array]:
        """Return the state after a period and its derivatives, those by the state first."""
        if not self.maps.carries:
            return evaluate_blocks(stages, [], [x, *given, 0])
        n = self.plan.size
        widths = [size // n for size in stages[0].sizes[2 : -len(given) - 1]]
        still = [np.eye(n).ravel(), *(np.zeros(n * k) for k in widths)]
        return evaluate_blocks(stages, [x, *still], given, self.maps.parts)

    @property
    def position(self) -> int:
        """Index of the state whose rate is the first velocity, of those that are one."""
        e, v = self.e, self.e.position_rates[0]
        rates = [casadi.simplify(e.rhs[k]) for k in range(self.n) if k != v]
        found = [casadi.is_equal(rate, e.x[v], 2) for rate in rates]
        return [k for k in range(self.n) if k != v][found.index(True)]

    def insert_free_values(self, theta: Any) -> Array:
        """Return all parameter values with `theta` in the places of the free ones."""
        p = self.e.values.copy()
        p[self.index] = theta
        return p

    def is_built_for(self, theta: Array) -> bool:
        """Return whether the map was built for such values of a delay or of a lag."""
        e, dt, p = self.e, self.loop.dt / self.pieces, self.insert_free_values(theta)
        if e.delay is not None:
            late = evaluate_delay(e, p) / dt + 1e-9
            if not self.delay_samples <= late <= self.delay_samples + 1 + 1e-6:
                return False
        return is_scheme_suitable(self.scheme, e, p, dt, self.law)

    def linearize(self, data: FilterData, theta: Array, at: Trajectory) -> Linearized:
        """Return the plant along a trajectory, for parameter values `theta`."""
        p, u, n = self.insert_free_values(theta), data.u, self.plan.size
        late_variance = self.initial_conditions.find_input_variance(u, p) / data.scale**2
        input_variance = data.input_variance + late_variance
        corners, by_memory, by_free = self._find_expected_corners(data, p, at)
        w = self._stack_signals(data, corners)
        moved = 1e-3 * np.std(u[data.valid if u.ndim == 1 else data.valid.any(axis=1)], axis=0)
        spread = at.spread[:, : self.n].T
        given = (at.filtered[:, :n].T, w, p, spread, np.zeros(self.channels))
        step, a, b, dp, *by_input = (
            _repeat_over_samples(part, len(u))
            for part in self._evaluate_transition(self.maps.stages, *given)
        )
        step = step[:, :, 0]
        # How the input moves the state matters only where the input is not what was measured.
        du = np.zeros((len(u), n))
        rows = np.flatnonzero(input_variance)
        if by_input:
            du = by_input[0].sum(axis=2)
            dp = dp + np.einsum("nic,cnp->nip", by_input[0], by_free)
        elif len(rows):
            du[rows] = self._differentiate_by_input(rows, given, moved)
            rows = np.flatnonzero(late_variance)
            if len(self.e.inputs) > 1 and len(rows):
                alone = np.arange(len(moved)) == self.e.late_input
                du[rows] = self._differentiate_by_input(rows, given, moved * alone)
        output, c, hp = (
            _repeat_over_samples(part, len(u))
            for part in self.maps.sensor(at.predicted[:, :n].T, w, p, spread)
        )
        if by_input:
            # The memory of a backlash stands still, and nothing but the input shows it.
            a = np.pad(a, [(0, 0), (0, 1), (0, 1)])
            a[:, :n, n], a[:, n, n] = np.einsum("nic,cn->ni", by_input[0], by_memory), 1.0
            step = np.column_stack([step, at.filtered[:, n]])
            b, du, dp = (np.pad(v, [(0, 0), (0, 1)] + [(0, 0)] * (v.ndim - 2)) for v in (b, du, dp))
            c = np.pad(c, [(0, 0), (0, 0), (0, 1)])
        # Of one output the axis of outputs is left out.
        seen = 0 if self.e.siso else slice(None)
        start, wide = self.extend_start(
            data, *self.initial_conditions.find_initial_state(data, p), p
        )
        return Linearized(
            step, a, b, du, dp, output[:, seen, 0], c[:, seen, :], hp[:, seen, :],
            input_variance, start, wide, at,
        )  # fmt: skip

    def linearize_at_rest(self) -> tuple[Array, Array, Array]:
        """Return (A, B, C) of a sample at rest: by the state before, by forces, of the outputs."""
        p, at = self.e.values, self.loop.point
        x = self.pad_controller_states(np.array(find_rest_state(self.loop, self.e)))[:, None]
        law = self.law
        r = np.zeros(self.plan.references)
        if law is not None and law.references is not None:
            r = np.array(law.references)
        corners = np.tile(at.inputs, self.pieces + 2)
        references = [r] if self.hold_r == "zoh" else [r, r]
        w = np.concatenate([[0.0], corners, *references, at.outputs])[:, None]
        # Dry friction, which holds still what rests, damps nothing that moves.
        wide = np.full((self.n, 1), 1e6)
        stages = self.maps.stages
        _, a, b, *_ = self._evaluate_transition(stages, x, w, p, wide, np.zeros(self.channels))
        return a[0], b[0], self.maps.sensor(x, w, p, wide)[1][0]

    def _differentiate_by_input(self, rows: Any, given: Sequence[Array], h: Any) -> Array:
        """Return by differences how the state after the samples `rows` depends on the input.

        Several inputs move together, each by its own step `h`; the derivative is then by what all
        of them have in common, in thousands of steps.
        """
        x, w, p, spread, force = given
        m = len(self.e.inputs)
        steps = np.zeros((w.shape[0], 1))
        steps[1 : 1 + (self.pieces + 2) * m, 0] = np.tile(h, self.pieces + 2)
        above, below = (
            self._evaluate_transition(
                self.maps.stages, x[:, rows], w[:, rows] + s * steps, p, spread[:, rows], force
            )[0]
            for s in (1, -1)
        )
        slope: Array = (above - below)[:, :, 0] / (2 * (h if self.e.siso else 1e-3))
        return slope

    def _list_input_ranges(self, data: FilterData, p: Array) -> InputRange:
        """Return what acts behind the backlash at each corner; shapes (corners, n, ...)."""
        found = find_input_range(
            self.e, self.index, data.path.ravel(), p, at_rest=self.loop.point.inputs[0],
            period=self.loop.dt / self.pieces, held=self.hold == "zoh",
        )  # fmt: skip
        return found.map(lambda values: np.array(self._list_corners(values)))

    def _find_memory(self, data: FilterData, p: Array) -> tuple[float, float]:
        """Return what the input remembers at the start, and its standard deviation."""
        first, at_rest = float(data.path.flat[0]), self.loop.point.inputs[0]
        middle, reach = find_memory_range(self.e, first, at_rest, p)
        # It is anywhere in its range.
        return middle, reach / math.sqrt(3)

    def _find_expected_corners(
        self, data: FilterData, p: Array, at: Trajectory
    ) -> tuple[Sequence[Array], Any, Any]:
        """Return the input at each corner, and its derivatives where it is behind a backlash.

        Those by the memory of the backlash have shape (corners, n), those by the free parameters
        (corners, n, free).
        """
        if self.e.memory is None:
            return self._list_corners(data.path), None, None
        ranges = self._list_input_ranges(data, p)
        # Errors of a model that does not fit yet make no memory less certain than it was at first.
        spread = np.minimum(at.spread[:, -1], self._find_memory(data, p)[1])
        applied, by_memory, by_free = ranges.linearize(at.filtered[:, -1], spread)
        return list(applied), by_memory, by_free

    def build_sensitivity_map(self) -> casadi.Function:
        """Return one period of the plant, as it is, together with that of its sensitivities.

        ``f(z, w, p) -> (next z, y and its slopes)``; z stacks the state and its derivatives by the
        free parameters and the initial state, w is a column of `stack_inputs`.
        """
        n, p = self.plan.size, len(self.index)
        sizes = {
            "x": (n, 1),
            "s": (n, p + n),
            "w": (self.pieces + 5 + (self.hold_r == "foh"), 1),
            "p": self.e.p.shape,
        }
        x, s, w, values = (casadi.SX.sym(k, *size) for k, size in sizes.items())
        still, quiet = casadi.SX.zeros(self.n), casadi.SX.zeros(self.channels)
        y, c, hp = self.maps.sensor_function(x, w, values, still)
        seen = casadi.mtimes(c, s) + casadi.horzcat(hp, casadi.SX.zeros(1, n))
        widths = [self.channels, p] + ([] if self.e.memory is None else [self.pieces + 2])
        stage = [x, casadi.SX.eye(n), *(casadi.SX(n, width) for width in widths)]
        carried = len(stage) if self.maps.carries else 1
        for function, part in itertools.product(self.maps.functions, range(self.maps.parts)):
            stage = function.call([*stage[:carried], w, values, still, quiet, part])
        after, a, _, dp, *_ = stage
        onward = casadi.mtimes(a, s) + casadi.horzcat(dp, casadi.SX.zeros(n, n))
        return casadi.Function(
            "period", [casadi.vertcat(x, casadi.vec(s)), w, values],
            [casadi.vertcat(after, casadi.vec(onward)), casadi.vertcat(y, seen.T)], {"cse": True},
        )  # fmt: skip

    def stack_inputs(self, data: FilterData, theta: Array) -> Array:
        """Return the rows over which the map is evaluated.

        They have the shape (pieces + 5, n), one more if the reference runs straight. A backlash
        begins in the middle of its gap.
        """
        p = self.insert_free_values(theta)
        memory = self._find_memory(data, p)[0] if self.e.memory is not None else None
        return self._stack_known_signals(data, p, slice(None), memory)

    def advance(self, data: FilterData, x: Array, rows: Any, known: bool = True) -> Array:
        """Return states (k, n) one period after the samples `rows`, with the loop's parameters."""
        p, n = self.e.values, self.plan.size
        w = self._stack_known_signals(data, p, rows, x[:, n:].T)
        if not known:
            w[-len(self.e.outputs) :] = self.evaluate_output(data, x, rows).T
        quiet = np.zeros((self.n, 1))
        moved = self._evaluate_transition(
            self.maps.stages, x[:, :n].T, w, p, quiet, np.zeros(self.channels)
        )[0][:, :, 0]
        return np.hstack([moved, x[:, n:]])

    def evaluate_output(self, data: FilterData, x: Array, rows: Any) -> Array:
        """Return the outputs at states (k, n) and the samples `rows`."""
        p, n = self.e.values, self.plan.size
        w = self._stack_known_signals(data, p, rows, x[:, n:].T)
        output: Array = self.maps.sensor(x[:, :n].T, w, p, np.zeros((self.n, 1)))[0][:, :, 0]
        return output[:, 0] if self.e.siso else output

    def _stack_known_signals(self, data: FilterData, p: Array, rows: Any, memory: Any) -> Array:
        """Return what `_stack_signals` does at some samples, the memory of a backlash known."""
        if self.e.memory is None:
            corners = [corner[rows] for corner in self._list_corners(data.path)]
        else:
            ranges = self._list_input_ranges(data, p).map(lambda values: values[:, rows])
            corners = list(ranges.follow(memory))
        return self._stack_signals(data, corners, rows)

    def _stack_signals(
        self, data: FilterData, corners: Sequence[Array], rows: Any = slice(None)
    ) -> Array:
        """Return the rows (t, input before, now, ..., ahead, r, y) the map is evaluated over."""
        references = [data.r] if self.hold_r == "zoh" else [data.r, shift_signal(data.r, -1)]
        others = (part.T[..., rows] for part in (*references, data.y))
        return np.vstack([data.t[rows], *(part.T for part in corners), *others])

    def _list_corners(self, path: Array) -> list[Array]:
        """Return what acts at each corner, one before the sample to the one ahead of it."""
        # What a delay still holds when the record begins may be anything that the input is in it: a
        # reference that sets in with the record makes its first sample an unusual one.
        before = path[:1] if self.e.delay is None else path.mean(axis=0, keepdims=True)
        steps, late = range(-1, self.pieces + 1), self.delay_samples
        corners = [shift_signal(path, late - k, before)[:: self.pieces] for k in steps]
        if self.e.delay is not None and len(self.e.inputs) > 1:
            # All inputs but one are on time.
            others = np.arange(len(self.e.inputs)) != self.e.late_input
            for k, corner in zip(steps, corners, strict=True):
                corner[:, others] = shift_signal(path[:, others], -k)[:: self.pieces]
        return corners

    def pad_controller_states(self, values: Array) -> Array:
        """Add the states of a known analog controller, at rest, to a start."""
        extra = self.plan.size - values.shape[0]
        if not extra:
            return values
        padded = np.pad(values, [(0, extra)] * values.ndim)
        if self.law is not None and values.ndim == 1:
            padded[-extra:] = self.law.rest
        return padded

    def extend_start(
        self, data: FilterData, start: Array, spread: Array, p: Array
    ) -> tuple[Array, Array]:
        """Return start and covariance with what else the filter estimates.

        A known analog controller begins at rest, a backlash anywhere in its gap.
        """
        start, spread = (self.pad_controller_states(v) for v in (start, spread))
        if self.e.memory is None:
            return start, spread
        memory, deviation = self._find_memory(data, p)
        wide = np.pad(spread, (0, 1))
        with np.errstate(over="ignore"):
            # Of an input that runs away the square is infinite, which the filter refuses.
            wide[-1, -1] = np.square(deviation / data.scale)
        return np.append(start, memory), wide


def _repeat_over_samples(values: Array, n: int) -> Array:
    """Repeat values that are the same at all samples, so that there are n of them."""
    return values if values.shape[0] == n else np.repeat(values, n, axis=0)


class InitialConditions:
    """The initial conditions of a plant at the start of a record.

    A lag begins near what it follows. What a delay still holds is unknown: until it has passed, the
    input is uncertain.
    """

    def __init__(self, plan: PeriodPlan) -> None:
        self.plan = plan
        self.lags = _prepare_lags(plan.equations)

    def find_input_variance(self, u: Array, p: Array) -> Array:
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
        u = u if u.ndim == 1 else u[:, e.late_input]
        if e.delay is not None:
            late = evaluate_delay(e, p) / self.plan.dt
            far = np.clip(late - np.arange(len(u)), 0.0, 1.0)
            # These samples may all have been off by the same, which the filter takes for chance.
            # Beside several signals an input is counted in its standard deviations.
            size = np.var(u) if e.siso or e.memory is not None else 1.0
            variance = variance + far**2 * max(late, 1.0) * size
        return variance

    def find_initial_state(self, data: FilterData, p: Array) -> tuple[Array, Array]:
        """Return state and covariance at the start of a record, for parameter values `p`."""
        start, spread = data.start.copy(), data.spread.copy()
        u, y = data.u, data.y
        alone = not data.restart[int(np.argmax(data.valid)) + 1 :].any()
        for k, shown, function in self.lags:
            given = start if shown else np.reshape(u, (len(u), -1)).T
            time, target, near = (v[:, 0] for v in function(given, p))
            late = float(time[0, 0]) / self.plan.dt
            if shown:
                spread[k] = spread[:, k] = near[0] @ spread
                wide = near[0] @ spread @ near[0]
                change = late**2 * float(np.var(np.diff(y, axis=0))) / data.scale**2
                # Outputs in several units tell nothing of each other's motion.
                change = change if y.ndim == 1 else float(wide)
                spread[k, k] = wide + min(change, wide) + NEARLY
            else:
                before = float(np.mean((target - start[k]) ** 2))
                # Without restarts a lag is off by what its target moves within the time constant.
                if alone:
                    start[k] = target[0, 0]
                    steps = float(np.var(np.diff(target[:, 0])))
                    before = min((1 + late / 2) * steps, 2 * float(np.var(target)))
                spread[k, k] = before / data.scale**2 + NEARLY
        return start, spread


def _prepare_lags(e: Equations) -> list[tuple[int, bool, BlockEvaluation]]:
    """Return the lags behind the input or the output of the plant: which, time and target."""
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


def evaluate_delay(e: Equations, p: Array) -> float:
    """Return the delay of the input [s] for parameter values `p`."""
    return float(casadi.evalf(substitute_delay(e, p)))


def shift_signal(values: Array, late: int, before: Array | None = None) -> Array:
    """Return values so many samples later, or earlier if `late` is negative.

    The ends are held, but for the first where it is said what was `before`.
    """
    first = np.repeat(values[:1] if before is None else before, max(late, 0), axis=0)
    last = np.repeat(values[-1:], max(-late, 0), axis=0)
    return np.concatenate([first, values[max(-late, 0) :], last])[: len(values)]


@functools.lru_cache(maxsize=8)
def make_sampled_plant(
    loop: Loop, names: tuple[str, ...], hold: str, sees: str, hold_r: str = "zoh"
) -> SampledPlant:
    """Return the plant of a loop, made once."""
    return SampledPlant(loop, names, hold, sees, hold_r)
