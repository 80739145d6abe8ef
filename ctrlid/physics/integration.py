"""A plant advanced over pieces of its input: formulas of integration, and lags exactly."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi
from scipy.integrate import DOP853

from .equations import Equations, Lag

# A piece is its duration [s], the input at its start and the slope of the input.
Piece = tuple[Any, Any, Any]
# As plain numbers, since CasADi turns each of numpy's into a matrix first, which takes long.
A, B, C, E3, E5 = (getattr(DOP853, name).tolist() for name in ("A", "B", "C", "E3", "E5"))
# The transient of a lag is over after so many time constants.
SHARP = 8.0


@dataclass(frozen=True)
class Scheme:
    """How a period is integrated.

    Parameters
    ----------
    order : int
        Order of the steps, four or eight.
    steps : int
        How many in each piece.
    sharp : (int, int), optional
        Order and steps for the transient of a short lag of the input; pieces are cut where it is
        over. By default they are not.
    """

    order: int
    steps: int
    sharp: tuple[int, int] | None = None


def integrate(
    rate: Any, z: Any, dt: Any, substeps: int, once: bool = True
) -> tuple[Any, Any]:  # fmt: skip
    """Advance an expression by Dormand and Prince's eighth-order formula.

    Parameters
    ----------
    rate : callable
        ``rate(tau, z)``, the derivative at time `tau` after the start, as CasADi expression.
    z : casadi.SX
        The state at the start.
    dt : float or casadi.SX
        Time to advance [s].
    substeps : int
        Number of steps of equal length.
    once : bool, optional
        Whether the expression of a step is built once for all of them, so that `rate` is asked in
        the first one only.

    Returns
    -------
    z : casadi.SX
        The state after `dt`.
    error : casadi.SX
        Largest estimate of the local error of a step, per state.

    References
    ----------
    Hairer, Nørsett and Wanner, *Solving Ordinary Differential Equations I*, section II.10.
    """
    h = dt / substeps

    def one(start: Any, z: Any) -> list[Any]:
        stages: list[Any] = []
        for row, c in zip(A, C, strict=True):
            point = z
            for weight, stage in zip(row, stages, strict=False):
                if weight:
                    point = point + (h * weight) * stage
            stages.append(rate(start + c * h, point))
        total, fifth, third = (
            sum((w * s for w, s in zip(weights, stages, strict=False) if w), casadi.SX(0))
            for weights in (B, E5, E3)
        )
        fifth, third = casadi.fabs(h * fifth), casadi.fabs(h * third)
        error = fifth**2 / casadi.sqrt(fifth**2 + 0.01 * third**2 + 1e-300)
        return [z + h * total, error]

    worst = casadi.SX.zeros(z.shape[0], 1)
    step = _build_once(one, z.shape[0], substeps) if once else one
    for k in range(substeps):
        z, error = step(k * h, z)
        worst = casadi.fmax(worst, error)
    return z, worst


def integrate_fast(rate: Any, z: Any, dt: Any, substeps: int, once: bool = True) -> Any:
    """Advance an expression by the classical fourth-order formula of Runge and Kutta."""
    h = dt / substeps

    def one(start: Any, z: Any) -> list[Any]:
        first = rate(start, z)
        second = rate(start + h / 2, z + h / 2 * first)
        third = rate(start + h / 2, z + h / 2 * second)
        fourth = rate(start + h, z + h * third)
        return [z + h / 6 * (first + 2 * second + 2 * third + fourth)]

    step = _build_once(one, z.shape[0], substeps) if once else one
    for k in range(substeps):
        (z,) = step(k * h, z)
    return z


def _build_once(one: Any, size: int, count: int) -> Any:
    """Return ``one(start, z)`` made ready to be called many times: its expression is built once."""
    if count == 1:
        return one
    start, z = casadi.SX.sym("start"), casadi.SX.sym("z", size)
    results = one(start, z)
    own = {s.element_hash() for s in (start, *casadi.vertsplit(z))}
    every = casadi.symvar(casadi.vertcat(*results))
    others = [s for s in every if s.element_hash() not in own]
    made = casadi.Function("one", [start, z, *others], results)
    return lambda start, z: made.call([start, z, *others])


def cut_input(e: Equations, dt: float, path: Sequence[Any], hold: str) -> list[Piece]:
    r"""Return the input of the plant over one period as straight pieces.

    .. math:: u(t - d), \quad d = (l + \varphi) T

    changes from one sample to the next at the time :math:`\varphi T` after the start.

    Parameters
    ----------
    e : Equations
        The plant, with or without a delay.
    dt : float
        Sampling period T [s].
    path : sequence of 3 expressions
        The input at the samples k - l - 1, k - l and k - l + 1; of several inputs only that which
        comes late, and the others at k - 1, k and k + 1.
    hold : {"zoh", "foh", "bandlimited"}
        How the input runs between samples: held or straight. A band-limited one is straight
        between many closer samples.

    Returns
    -------
    list of tuple
        Duration [s], input at the start of the piece, slope [1/s].
    """
    before, now, ahead = path
    slopes: list[Any] = [(now - before) / dt, (ahead - now) / dt] if hold != "zoh" else [0.0, 0.0]
    if e.delay is None:
        return [(dt, now, slopes[1])]
    late = substitute_delay(e, e.p) / dt - count_delay_samples(e, dt)
    held, slope, then = before + slopes[0] * (1 - late) * dt, slopes[0], now
    if len(e.inputs) > 1:
        # All inputs but one are on time, and run on where that one changes.
        k = e.late_input
        held, then = put_entry(now, k, held[k]), put_entry(now + slopes[1] * late * dt, k, now[k])
        if hold != "zoh":
            slope = put_entry(slopes[1], k, slopes[0][k])
    return [(late * dt, held, slope), ((1 - late) * dt, then, slopes[1])]


def put_entry(column: Any, k: int, value: Any) -> Any:
    """Return a column of expressions with another one in place k."""
    return casadi.vertcat(*(value if i == k else column[i] for i in range(column.shape[0])))


def substitute_delay(e: Equations, p: Any) -> Any:
    """Return the delay of the input [s] for parameter values `p`."""
    return casadi.substitute(casadi.SX(e.delay), e.p, casadi.SX(p))


def count_delay_samples(e: Equations, dt: float) -> int:
    """Return by how many whole samples the input comes late, with the parameters as they are."""
    if e.delay is None:
        return 0
    seconds = float(casadi.evalf(substitute_delay(e, casadi.DM(e.values))))
    # A delay of whole samples belongs to the interval above it: only there can it grow and fall.
    return max(math.floor(seconds / dt + 1e-9), 0)


def find_lags(e: Equations) -> tuple[list[Lag], list[Lag]]:
    """Return the lags that follow the input or a curve of it, and those that only outputs see."""
    driven, seen = [], []
    for lag in e.lags:
        others = casadi.vertcat(*(e.rhs[i] for i in range(len(e.states)) if i != lag.state))
        if not casadi.depends_on(lag.target, casadi.vertcat(e.t, e.x, *_list_spreads(e))):
            driven.append(lag)
        elif not casadi.depends_on(others, e.x[lag.state]) and not e.dt:
            seen.append(lag)
    return driven, seen


def _list_spreads(e: Equations) -> list[Any]:
    return [] if e.spread is None else [e.spread]


def advance(
    e: Equations, t: Any, x: Any, pieces: Sequence[Piece], p: Any, spread: Any = None,
    held_rate: Any = None, *, scheme: Scheme, stages: Any = None,
) -> tuple[Any, Any]:  # fmt: skip
    """Return the state of a plant after the pieces of its input, and the local error.

    Lags of the input and of the output are advanced by their exact exponential, so that a lag
    far shorter than the period neither disturbs nor slows the integration.

    Parameters
    ----------
    e : Equations
        The plant.
    t : expression
        Time at the start [s].
    x : expression, shape (states,)
        State at the start.
    pieces : sequence of tuple
        Duration, input at the start and slope, as `cut_input` returns them.
    p : expression or ndarray
        Parameter values.
    spread : expression, optional
        Standard deviations of the states, which smooth kinks; zero by default.
    held_rate : expression, optional
        Constant added to the rates: a force held over the period.
    scheme : Scheme
        Order and number of the steps.
    stages : Stages, optional
        What stands in the place of the plant's rates, so that the result can be differentiated.

    Returns
    -------
    x : casadi.SX
        State after the last piece.
    error : casadi.SX
        Estimate of the local error per state, zero for steps of order four.
    """
    n = len(e.states)
    spread = casadi.SX.zeros(n, 1) if spread is None else spread
    held_rate = casadi.SX.zeros(n, 1) if held_rate is None else held_rate
    worst = casadi.SX.zeros(n, 1)
    driven, seen = find_lags(e)
    hidden = [lag.state for lag in (*driven, *seen)]
    evaluate, once = (e.smoothed, True) if stages is None else (stages, False)
    if e.dt:
        return evaluate(t, x, pieces[-1][1], p, spread)[0] + held_rate, worst
    times = {
        lag.state: casadi.substitute(casadi.SX(lag.time_constant), e.p, casadi.SX(p))
        for lag in e.lags
    }
    short = [times[lag.state] for lag in driven[:1] if scheme.sharp]
    for sharp, (duration, level, slope) in _cut_transients(pieces, short):
        followed = [_map_piece(e, lag.target, duration, level, slope, p) for lag in driven]

        def filled(tau: Any, z: Any, x: Any = x, followed: Any = followed) -> Any:
            z = casadi.SX(z)
            for lag, (first, climb) in zip(driven, followed, strict=True):
                time = times[lag.state]
                steady = first - time * climb
                decay = casadi.exp(-tau / time)
                z[lag.state] = steady + climb * tau + (x[lag.state] - steady) * decay
            return z

        def rate(
            tau: Any,
            z: Any,
            level: Any = level,
            slope: Any = slope,
            filled: Any = filled,
            t: Any = t,
        ) -> Any:
            rates = evaluate(t + tau, filled(tau, z), level + slope * tau, p, spread)[0] + held_rate
            for k in hidden:
                rates[k] = 0
            return rates

        order, steps = scheme.sharp if sharp and scheme.sharp else (scheme.order, scheme.steps)
        if order == 8:
            after, error = integrate(rate, x, duration, steps, once)
            worst = casadi.fmax(worst, error)
        else:
            after = integrate_fast(rate, x, duration, steps, once)
        after = filled(duration, after)
        for lag in seen:
            ends = [
                _evaluate_target(e, lag, t + tau, z, level + slope * tau, p, spread)
                for tau, z in ((0.0, x), (duration, after))
            ]
            after[lag.state] = _advance_lag(x[lag.state], times[lag.state], duration, *ends)
        x, t = after, t + duration
    return x, worst


def _cut_transients(pieces: Sequence[Piece], times: Sequence[Any]) -> list[tuple[bool, Piece]]:
    """Cut pieces where the transient of the first lag is over; say which parts hold one."""
    parts: list[tuple[bool, Piece]] = []
    for duration, level, slope in pieces:
        if not times:
            parts.append((False, (duration, level, slope)))
            continue
        sharp = casadi.fmin(duration / 2, SHARP * times[0])
        parts += [(True, (sharp, level, slope)),
                  (False, (duration - sharp, level + slope * sharp, slope))]  # fmt: skip
    return parts


def _map_piece(
    e: Equations, target: Any, duration: Any, level: Any, slope: Any, p: Any
) -> tuple[Any, Any]:
    """Return start and slope of a curve of the input over a piece of it, straight as well."""
    if len(e.inputs) == 1 and casadi.is_equal(target, e.u, 2):
        return level, slope
    curve = casadi.Function("curve", [e.u, e.p], [target])
    first = curve(level, p)
    if isinstance(slope, float) and slope == 0.0:
        return first, 0.0
    return first, (curve(level + slope * duration, p) - first) / duration


def _evaluate_target(e: Equations, lag: Lag, t: Any, x: Any, u: Any, p: Any, spread: Any) -> Any:
    """Return what a lag follows, and its rate, at one point."""
    velocity = casadi.jtimes(lag.target, e.x, e.rhs) + casadi.jacobian(lag.target, e.t)
    symbols = [e.t, e.x, e.u, e.p, *_list_spreads(e)]
    function = casadi.Function("followed", symbols, [lag.target, velocity])
    return function(*[t, x, u, p, spread][: len(symbols)])


def _advance_lag(start: Any, time: Any, duration: Any, begin: Any, end: Any) -> Any:
    """Advance a lag that follows the cubic through two values and two slopes."""
    a = duration / time
    decay = casadi.exp(-a)
    m0 = 1 - decay
    m1 = 1 - m0 / a
    m2 = 1 - 2 * m1 / a
    m3 = 1 - 3 * m2 / a
    (z0, v0), (z1, v1) = begin, end
    v0, v1 = duration * v0, duration * v1
    return (decay * start + m0 * z0 + m1 * v0 + m2 * (3 * (z1 - z0) - 2 * v0 - v1)
            + m3 * (2 * (z0 - z1) + v0 + v1))  # fmt: skip
