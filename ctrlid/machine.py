"""A loop's plant along a record: its map over a period, with derivatives, and the sensor."""

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi
import numpy as np

from .data import Record
from .errors import CtrlidError
from .linearization import state_matrices
from .loop import Loop
from .physics import Array, Equations
from .stepping import (
    Scheme,
    advance,
    input_pieces,
    integrate,
    known_lags,
    through_play,
    whole_delay,
)
from .tracks import Track, state_at_rest
from .vectorized import Vectorized, through

SLOW = 0.35  # rate times step up to which a step of order four is exact enough
MOST_STEPS = 100  # of order eight in a period: more make an expression that takes minutes to build
BRISK = 0.35  # of a lag's time constant: a step of order four that follows it exactly enough
FEW_STEPS = 3  # of order four, which cost less than one of order eight
KINK_STEPS = 4  # of order four in a period where friction has a kink


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
    trajectory: Trajectory


class Machine:
    """The equations of a loop's plant made ready to be filtered along records.

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
        self._plays: dict[int, casadi.Function] = {}
        self._build()

    def _map(self) -> tuple[Any, list[Any], list[Any], dict[str, Any]]:
        """Return the state, its value after each stage of a period, what is given, and symbols."""
        e, n, dt = self.e, self.n, self.loop.dt
        x, p, s = (casadi.SX.sym(k, m) for k, m in (("x", self.size), ("p", e.p.shape[0]),
                                                    ("s", n)))  # fmt: skip
        t, before, now, ahead, r, y = w = [casadi.SX.sym(k) for k in "tbnary"]
        force = casadi.SX.sym("f", self.channels)
        kick = casadi.SX.zeros(n, 1)
        for k, j in enumerate(self.forces):
            kick[j] = force[k if self.channels > 1 else 0]
        # A fit repeats the map often; a single prediction can afford to be exact.
        order, steps, cut = self.scheme = _scheme(e, self.loop)
        scheme = self.scheme if self.names else (8, 1 if order == 4 else steps, cut)
        part = casadi.SX.sym("i")
        if self.law is None:
            pieces = [
                tuple(casadi.substitute(casadi.SX(value), e.p, p) for value in piece)
                for piece in input_pieces(e, dt, (before, now, ahead), self.hold)
            ]
            ends, self._parts = self._stages_of(t, x, pieces, p, s, kick, scheme, part)
        else:
            ends = [self._follow(t, x, p, s, kick, now, r, y, max(scheme[1], 2))]
            self._parts = 1
        free = casadi.vertcat(*(p[k] for k in self.index)) if self.index else casadi.SX(0, 1)
        self._carries = len(ends) * self._parts > 1
        by = {"force": force, "free": free, "path": casadi.vertcat(before, now, ahead),
              "height": e.smoothed(t, x[:n], now, p, s)[1]}  # fmt: skip
        return x, ends, [casadi.vertcat(*w), p, s, force, part], by

    def _build(self) -> None:
        x, ends, given, by = self._map()
        self._functions = self._chained(x, ends, given, (by["force"], by["free"]))
        self._stages = [Vectorized(f) for f in self._functions]
        height = by["height"]
        outputs = [height, casadi.jacobian(height, x), casadi.jacobian(height, by["free"])]
        self.sensor_function = casadi.Function("sensor", [x, *given[:3]], outputs, {"cse": True})
        self._sensor = Vectorized(self.sensor_function)

    def _stages_of(self, t: Any, x: Any, pieces: Any, p: Any, s: Any, kick: Any, scheme: Scheme,
                   part: Any) -> tuple[list[Any], int]:  # fmt: skip
        """Return the maps that make up a period, and how many equal parts each of them has.

        Several steps of one kind are one short expression that is gone through several times.
        """
        order, steps, cut = scheme
        if self.e.dt or cut or steps == 1:
            return [advance(self.e, t, x, pieces, p, s, kick, scheme)[0]], 1
        ends, begin = [], t
        for duration, level, slope in pieces:
            h = duration / steps
            piece = (h, level + slope * part * h, slope)
            after = advance(self.e, begin + part * h, x, [piece], p, s, kick, (order, 1, False))[0]
            ends.append(after)
            begin = begin + duration
        return ends, steps

    def _chained(
        self, x: Any, ends: Sequence[Any], given: Sequence[Any], by: Sequence[Any]
    ) -> list[casadi.Function]:
        """Return maps that carry the state and its derivatives, by itself first, along.

        Kinks have no slope at the kink itself; everything else is exact.
        """
        n = self.size
        before = [casadi.SX.eye(n), *(casadi.SX(n, v.shape[0]) for v in by)]
        carried = []
        if self._carries:
            before = carried = [casadi.SX.sym("s", *value.shape) for value in before]
        functions = []
        for end in ends:
            a = casadi.jacobian(end, x)
            own = [casadi.SX(n, n), *(casadi.jacobian(end, v) for v in by)]
            outputs = [casadi.mtimes(a, s) + d for s, d in zip(before, own, strict=True)]
            functions.append(
                casadi.Function("step", [x, *carried, *given], [end, *outputs], {"cse": True})
            )
        return functions

    @functools.cached_property
    def _moves(self) -> list[Vectorized]:
        """How the state after a period depends on the input."""
        x, ends, given, by = self._map()  # expressions themselves do not travel to other processes
        return [Vectorized(f) for f in self._chained(x, ends, given, (by["path"],))]

    def _period(self, stages: Sequence[Vectorized], x: Array, *given: Any) -> list[Array]:
        """Go through a period; return the state after it and its derivatives, by itself first."""
        if not self._carries:
            return through(stages, [], [x, *given, 0])
        n = self.size
        widths = [size // n for size in stages[0].sizes[2 : -len(given) - 1]]
        still = [np.eye(n).ravel(), *(np.zeros(n * k) for k in widths)]
        return through(stages, [x, *still], given, self._parts)

    def _follow(self, t: Any, x: Any, p: Any, s: Any, kick: Any, u: Any, r: Any, y: Any,
                substeps: int) -> Any:  # fmt: skip
        """Advance plant and analog controller together, u being the measured one at the start."""
        e, n, law = self.e, self.n, self.law
        assert law is not None
        noise = y - e.smoothed(t, x[:n], u, p, s)[1]
        offset = u - law.apply(t, x[n:], r, y)[0]  # bias, injected signals, what xc does not know

        def rate(tau: Any, z: Any) -> Any:
            seen = e.smoothed(t + tau, z[:n], u, p, s)[1] + noise
            computed, slope = law.apply(t + tau, z[n:], r, seen)
            moved = e.smoothed(t + tau, z[:n], computed + offset, p, s)[0] + kick
            return casadi.vertcat(moved, slope)

        return integrate(rate, x, self.loop.dt, substeps)[0]

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
            late = float(casadi.evalf(casadi.substitute(casadi.SX(e.delay), e.p, p))) / dt + 1e-9
            if not self.late <= late <= self.late + 1 + 1e-6:
                return False
        time, (order, steps, cut) = _shortest(e, p), self.scheme
        if order == 4:
            return time > dt / steps / (2 * BRISK)
        return time < dt / 4 if cut else time > dt / 16

    def linearize(self, track: Track, theta: Array, at: Trajectory) -> Linearized:
        """Return the plant along a trajectory, for parameter values `theta`."""
        p = self.values(theta)
        u = track.table[1]
        applied, slopes = self._through_play(u, p)
        w = self._inputs(track, applied)
        spread = at.spread[:, : self.n].T
        given = (at.filtered.T, w, p, spread, np.zeros(self.channels))
        step, a, b, dp = self._period(self._stages, *given)
        # How the input moves the state matters only where the input is not what was measured.
        unsure = slopes is not None or not track.valid.all()
        dw = self._period(self._moves, *given)[2] if unsure else np.zeros((1, self.size, 3))
        if slopes is not None:
            dw = _full(dw, len(u))
            dp = _full(dp, len(u)).copy()
            for k in (-1, 0, 1):
                dp += dw[:, :, k + 1, None] * self._shifted(slopes, k)[:, None, :]
        height, c, hp = self._sensor(at.predicted.T, w, p, spread)
        return Linearized(
            _full(step, len(u))[:, :, 0], _full(a, len(u)), _full(b, len(u)),
            _full(dw, len(u)).sum(axis=2), _full(dp, len(u)), _full(height, len(u))[:, 0, 0],
            _full(c, len(u))[:, 0, :], _full(hp, len(u))[:, 0, :], at,
        )  # fmt: skip

    def _through_play(self, u: Array, p: Array) -> tuple[Array, Array | None]:
        """Return the input behind the play, and how it depends on the free parameters."""
        e = self.e
        if e.play is None:
            return u, None
        start = casadi.substitute(
            casadi.SX(e.play.start), casadi.vertcat(e.play.u, e.p), casadi.vertcat(u[0], p)
        )
        z = np.concatenate([np.asarray(casadi.evalf(start), float).ravel(),
                            np.zeros(len(self.index))])  # fmt: skip
        if len(u) not in self._plays:  # building it takes longer than running it
            self._plays[len(u)] = self._play().mapaccum("run", len(u))
        out = np.asarray(self._plays[len(u)](z, u[None, :], p)[1], float)
        return out[0], out[1:].T

    def _play(self) -> casadi.Function:
        """Return one sample of the play, with its slopes by the free parameters."""
        e = self.e
        assert e.play is not None
        m, slope = casadi.SX.sym("m"), casadi.SX.sym("d", len(self.index))
        sample, values = casadi.SX.sym("u"), casadi.SX.sym("p", e.p.shape[0])
        applied, after = through_play(e, m, sample, values)
        free = casadi.vertcat(*(values[k] for k in self.index)) if self.index else casadi.SX(0, 1)
        rows = [
            casadi.jacobian(out, m) * slope + casadi.jacobian(out, free).T
            for out in (applied, after)
        ]
        return casadi.Function(
            "play", [casadi.vertcat(m, slope), sample, values],
            [casadi.vertcat(after, rows[1]), casadi.vertcat(applied, rows[0])],
        )  # fmt: skip

    def with_slopes(self) -> casadi.Function:
        """Return one period of the plant, as it is, together with that of its sensitivities.

        ``f(z, w, p) -> (next z, y and its slopes)``; z stacks the state and its derivatives by the
        free parameters and the initial state, w is a column of `inputs`.
        """
        n, p = self.size, len(self.index)
        x, s, w, values = (casadi.SX.sym(k, *size) for k, size in (
            ("x", (n, 1)), ("s", (n, p + n)), ("w", (6, 1)), ("p", self.e.p.shape)))  # fmt: skip
        still, quiet = casadi.SX.zeros(self.n), casadi.SX.zeros(self.channels)
        y, c, hp = self.sensor_function(x, w, values, still)
        seen = casadi.mtimes(c, s) + casadi.horzcat(hp, casadi.SX.zeros(1, n))
        stage = [x, casadi.SX.eye(n), casadi.SX(n, self.channels), casadi.SX(n, p)]
        carried = len(stage) if self._carries else 1
        for function, part in itertools.product(self._functions, range(self._parts)):
            stage = function.call([*stage[:carried], w, values, still, quiet, part])
        after, a, _, dp = stage
        moved = casadi.mtimes(a, s) + casadi.horzcat(dp, casadi.SX.zeros(n, n))
        return casadi.Function(
            "period", [casadi.vertcat(x, casadi.vec(s)), w, values],
            [casadi.vertcat(after, casadi.vec(moved)), casadi.vertcat(y, seen.T)], {"cse": True},
        )  # fmt: skip

    def inputs(self, track: Track, theta: Array) -> Array:
        """Return the rows over which the map is evaluated, shape (6, n), behind any play."""
        return self._inputs(track, self._through_play(track.table[1], self.values(theta))[0])

    def advance(self, track: Track, x: Array, rows: Any, known: bool = True) -> Array:
        """Return states (k, n) one period after the samples `rows`, with the loop's parameters."""
        p = self.e.values
        w = self._inputs(track, self._through_play(track.table[1], p)[0])[:, rows]
        if not known:
            w[5] = self.height(track, x, rows)
        quiet = np.zeros((self.n, 1))
        return self._period(self._stages, x.T, w, p, quiet, np.zeros(self.channels))[0][:, :, 0]

    def height(self, track: Track, x: Array, rows: Any) -> Array:
        """Return the outputs at states (k, n) and the samples `rows`."""
        p = self.e.values
        w = self._inputs(track, self._through_play(track.table[1], p)[0])[:, rows]
        return self._sensor(x.T, w, p, np.zeros((self.n, 1)))[0][:, 0, 0]

    def at_rest(self) -> tuple[Array, Array, Array]:
        """Return the derivatives of the map by state and force and of the output, at rest."""
        at, p = self.loop.point, self.e.values
        x = self.padded(np.array(state_at_rest(self.loop, self.e)))
        w = np.array([0.0, at.input, at.input, at.input, at.output, at.output])
        quiet = np.zeros(self.n)
        _, a, b, _ = self._period(self._stages, x, w, p, quiet, np.zeros(self.channels))
        _, h, _ = self._sensor(x, w, p, quiet)
        return a[0], b[0], h[0]

    def _inputs(self, track: Track, applied: Array) -> Array:
        """Return the rows (t, input before, now, ahead, r, y) over which the map is evaluated."""
        t, _, r, y = track.table
        moved = [self._shifted(applied, k) for k in (-1, 0, 1)]
        return np.vstack([t, *moved, r, y])

    def _shifted(self, values: Array, k: int) -> Array:
        rows = np.clip(np.arange(len(values)) - self.late + k, 0, len(values) - 1)
        return np.asarray(values[rows])

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
        return (4, 1, False)
    hidden = [lag.state for lag in e.lags]
    plain = [k for k in range(len(e.states)) if k not in hidden]
    time = _shortest(e, casadi.SX(casadi.DM(e.values)))
    driven, cut = np.isfinite(time), bool(time < loop.dt / 8)
    # The filter's own uncertainty smooths kinks; sharp friction does not make the plant stiff.
    try:
        point = replace(loop.point, states=state_at_rest(loop, e))
        a = state_matrices(e, point, spread=1e6)[0][np.ix_(plain, plain)]
    except CtrlidError:
        return (8, 2, cut)
    rate = float(np.max(np.abs(np.linalg.eigvals(a)), initial=0.0)) * loop.dt
    if rate <= 3 * SLOW:
        # A velocity that turns within a period crosses the kink of friction there.
        few = max(KINK_STEPS if e.kinked else 1, math.ceil(rate / SLOW),
                  2 * driven, math.ceil(min(loop.dt / time / BRISK, MOST_STEPS)))  # fmt: skip
        # What a lag of the input does is known exactly; the plant has to follow it.
        if not driven or few <= FEW_STEPS:
            return (4, few, False)
    steps = max(1, math.ceil(rate / 1.5))
    if steps > MOST_STEPS:
        raise CtrlidError(
            f"{e.name} moves at {rate / loop.dt:.3g} rad/s, {rate:.3g} times faster than it is "
            "sampled; what settles within a sample is a constant for the filter: leave that motion "
            "out of the plant, or sample faster"
        )
    return (8, steps, cut)


def _shortest(e: Equations, p: Any) -> float:
    """Return the time constant of the lag that follows the input; infinite without one."""
    for lag in known_lags(e)[0]:
        return float(casadi.evalf(casadi.substitute(casadi.SX(lag.time_constant), e.p, p)))
    return math.inf


@functools.lru_cache(maxsize=8)
def machine(loop: Loop, names: tuple[str, ...], hold: str, follow: bool) -> Machine:
    """Return the machine of a loop, made once."""
    return Machine(loop, names, hold, follow)


def machine_for(loop: Loop, names: Sequence[str], record: Record) -> Machine:
    """Return the machine of a loop for records of one kind."""
    follow = record.r is not None and loop.analog
    return machine(loop, tuple(names), record.hold, follow)
