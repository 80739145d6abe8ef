"""The map of a loop over one sampling period, as exact equations."""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np

from .._base.arrays import Array, ComplexArray
from .._base.errors import EffectDoesNotApply, ModelCannotRun
from ..data.reconstruction import count_pieces
from ..physics.equations import Equations
from ..physics.integration import (
    Piece,
    Scheme,
    advance,
    count_delay_samples,
    cut_input,
    integrate,
    put_entry,
)
from ..physics.linearization import find_reached_states
from .loop import Loop


@dataclass(frozen=True, eq=False)
class PeriodMap:
    """The loop over one sampling period as a CasADi function.

    ``step(z, w) -> (next z, y, u, local error)``; z stacks plant and controller states, then what
    the input remembers; w is ``(t, r, d, sensor noise, force noise, next d)``, all held over the
    period but for an input without controller that runs straight from d to the next d. For a
    band-limited input the corners of its pieces, the next sample last, stand in place of next d.
    `counts` says how many rows each of them has, `reference` the references at rest.
    ``rate(z, w)`` is the derivative of z for a loop with an analog controller, else None.
    """

    plant_states: tuple[str, ...]
    rest: tuple[float, ...]
    step: Any
    rate: Any = None
    counts: tuple[int, ...] = (1,) * 6
    reference: tuple[float, ...] = ()

    @property
    def still(self) -> Array:
        """The signals of w at rest."""
        w = np.zeros(sum(self.counts))
        w[self.places[1]] = self.reference
        if len(self.counts) > 6:
            w[self.places[6]] = self.reference
        return w

    @property
    def places(self) -> list[slice]:
        """Where in w each of its signals is."""
        ends = np.cumsum((0, *self.counts)).tolist()
        return [slice(a, b) for a, b in itertools.pairwise(ends)]


def count_signals(loop: Loop) -> tuple[int, ...]:
    """Return how many rows t, r, d, sensor noise and force noise have."""
    e, law = loop.equations(), loop.law()
    m, p = len(e.inputs), len(e.outputs)
    references = 1 if law is None or law.references is None else len(law.references)
    return 1, references, m, p, count_forces(e)


def count_forces(e: Equations) -> int:
    """Return the number of random forces: one for all velocities of a plant of single signals.

    Where nothing moves, each state of the plant has a noise of its own on its rate.
    """
    if e.pushes is not None:
        return int(e.pushes.shape[1])
    if not e.velocities:
        return 1 if e.dt else len(e.states) - len(e.rest)
    return 1 if e.siso else len(e.velocities)


def push_velocities(e: Equations, force: Any, t: Any, x: Any, p: Any) -> Any:
    """Return what random forces, held over a period, add to the rates of the states."""
    n = len(e.states)
    if e.pushes is not None:
        given = casadi.Function("push", [e.t, e.x, e.u, e.p], [e.pushes])
        held = casadi.mtimes(given(t, x, casadi.SX.zeros(len(e.inputs), 1), p), force)
        # Effects may have added states, which no force moves.
        return casadi.vertcat(held, casadi.SX.zeros(n - held.shape[0], 1))
    held = casadi.SX.zeros(n, 1)
    # Effects may have added states, which no force moves.
    for k, j in enumerate(e.velocities or (range(n - len(e.rest)) if e.dt == 0 else ())):
        held[j] = force[min(k, force.shape[0] - 1)]
    return held


def make_period_map(
    loop: Loop, substeps: int, hold: str = "zoh", hold_r: str = "zoh", free: Sequence[str] = ()
) -> PeriodMap:
    """Build the map of a loop over one sampling period.

    Parameters
    ----------
    loop : Loop
        The loop.
    substeps : int
        Integration steps in a period.
    hold : {"zoh", "foh", "bandlimited"}, optional
        How the input of a loop without controller runs between samples. A digital controller holds
        its input, and an analog one moves it by its own law.
    hold_r : {"zoh", "foh"}, optional
        How r runs between samples, as an analog controller sees it. If it is straight, the next r
        comes last in w.
    free : sequence of str, optional
        Parameters that stay symbols; their values are the third argument of `step`, near those of
        the loop.

    Returns
    -------
    PeriodMap
        The map.

    Raises
    ------
    CtrlidError
        If an analog controller acts through a delay, a backlash or a limited rate: these need a
        sampled input.
    """
    e, law = loop.equations(), loop.law()
    n, nc = len(e.states), len(law.rest) if law else 0
    pieces = 1 if law else count_pieces(hold)
    late = count_delay_samples(e, loop.dt / pieces)
    # What the input remembers: its memory, then the inputs of the last samples.
    kept = 0 if e.delay is None else late + 1
    size = n + nc + (e.memory is not None) + kept
    # Corners of a band-limited input follow the signals that are held; else the next sample does.
    corners, m = (pieces + 1 if pieces > 1 else 1), len(e.inputs)
    straight_r = loop.analog and hold_r == "foh"
    counts = count_signals(loop)
    # A straight reference comes last, with its value at the next sample.
    counts = (*counts, m * corners, *(counts[1:2] if straight_r else ()))
    z, w = casadi.SX.sym("z", size), casadi.SX.sym("w", sum(counts))
    t0, r, d, sensor, force, ahead, *last = casadi.vertsplit(w, np.cumsum((0, *counts)).tolist())
    climb = (last[0] - r) / loop.dt if straight_r else casadi.SX(0)
    following = casadi.vertsplit(ahead, m)
    path = following if pieces > 1 else [d, *following]
    at, limits = loop.point, loop.input_limits
    symbols = casadi.SX.sym("free", len(free))
    p = _insert_symbols(e, free, symbols) if len(free) else e.values
    given = [z, w, symbols] if len(free) else [z, w]
    held_rate = push_velocities(e, force, t0, z[:n], p)
    # Several inputs rest at a column of values.
    u_rest = casadi.DM(at.inputs) if len(at.inputs) > 1 else at.input
    lower, upper = (casadi.DM(v) if np.ndim(v) else v for v in limits)

    def limit_input(u: Any) -> Any:
        if np.isfinite(limits[0]).any():
            u = casadi.fmax(u, lower)
        if np.isfinite(limits[1]).any():
            u = casadi.fmin(u, upper)
        return u

    def compute_input(t: Any, z: Any, y: Any, tau: Any = 0.0) -> tuple[Any, Any]:
        now = r + climb * tau
        wish, moved = law.apply(t, z[n:], now, y) if law else (u_rest, casadi.SX(0, 1))
        u = limit_input(wish + d)
        if law and law.reads_input:
            # An observer reads what the actuator applies, at its limits too.
            moved = law.apply(t, z[n:], now, y, u)[1]
        return u, moved

    def measure_output(t: Any, z: Any, u: Any) -> Any:
        y = e.function(t, z[:n], u, p)[1] + sensor
        return y if e.reader is None else e.reader(y, p)

    slope = None
    y = measure_output(t0, z, u_rest)
    u, moved = compute_input(t0, z[: n + nc], y)
    if loop.analog:
        if kept or e.memory is not None:
            raise EffectDoesNotApply(
                "a delay, a backlash or a limited rate acts on the samples of a digital "
                "controller, and this loop has an analog one. In redesign a continuous model asks "
                "for an analog controller, also where that of the loop is digital: sample the "
                "model first, with the period of the loop, "
                f"ct.sample_system(G, {loop.dt:g}), where G is loop.linearize() or the model you "
                "gave. Otherwise give the loop a digital controller, or put the delay into the "
                "plant as a Padé approximation (control.pade)"
            )

        # The reference jumps or bends only at the samples, so that a period has a smooth motion.
        def rate(tau: Any, z: Any) -> Any:
            u, charge = compute_input(t0 + tau, z, measure_output(t0 + tau, z, u_rest), tau)
            return casadi.vertcat(e.function(t0 + tau, z[:n], u, p)[0] + held_rate, charge)

        slope = casadi.Function("rate", given, [rate(0.0, z)])
        after, error = integrate(rate, z, loop.dt, substeps)
    else:
        memory: Any = z[n + nc] if e.memory is not None else None
        hold = "zoh" if law else hold
        pass_on = functools.partial(apply_memory, e, period=loop.dt / pieces, held=hold == "zoh")
        wanted = [u] if pieces == 1 else [limit_input(u_rest + value) for value in path[:-1]]
        applied = []
        for value in wanted:
            behind, memory = pass_on(memory, value, p)
            applied.append(behind)
        past = [z[k] for k in range(size - kept, size)]
        ahead = pass_on(memory, limit_input(u_rest + path[-1]), p)[0]
        # The inputs from the oldest that is remembered to the one of the next sample.
        following = [*applied, ahead if hold != "zoh" else applied[-1]]
        known = [applied[0], *following]
        if kept:
            own = [*reversed(past), *(value[e.late_input] for value in following)]
            pairs = zip(known, own, strict=False)
            known = [put_entry(each, e.late_input, late) for each, late in pairs]
        straight = [
            piece
            for k in range(pieces)
            for piece in cut_input(e, loop.dt / pieces, known[k : k + 3], hold)
        ]
        straight = _insert_values(e, straight, p)
        if law is None:
            # What passes through at once is the input that acts, and not the one that is computed.
            (lasting, acting, _), *later = straight
            acting = casadi.if_else(lasting > 0, acting, later[0][1]) if later else acting
            y = measure_output(t0, z, acting)
        scheme = Scheme(8, substeps, sharp=(8, substeps))
        x, error = advance(e, t0, z[:n], straight, p, None, held_rate, scheme=scheme)
        after = casadi.vertcat(x, moved, memory)
        if kept:
            newest = [value[e.late_input] for value in reversed(applied)]
            after = casadi.vertcat(after, *[*newest, *past][:kept])
        error = casadi.vertcat(error, casadi.SX.zeros(size - n, 1))
    rest = [*at.states, *(law.rest if law else ())]
    input_at_rest = at.inputs[e.late_input]
    memory = []
    if e.memory is not None:
        memory = [find_memory_range(e, at.input, at.input, e.values)[0]]
        behind = apply_memory(e, memory[0], at.input, e.values, loop.dt)[0]
        input_at_rest = float(casadi.evalf(casadi.SX(behind)))
    rest += [*memory, *([input_at_rest] * kept)]
    step = casadi.Function("step", given, [after, y, u, error])
    reference = at.outputs if e.siso else (0.0,)
    if law is not None and law.references is not None:
        reference = law.references
    return PeriodMap(e.states, tuple(rest), step, slope, counts, reference)


def apply_memory(
    e: Equations, m: Any, u: Any, p: Any, period: float, held: bool = True
) -> tuple[Any, Any]:
    """Return the input that acts and the next memory; without one, u and nothing.

    Parameters
    ----------
    e : Equations
        The plant.
    m, u, p : expression
        The memory, the input and the parameters.
    period : float
        Time from one input to the next [s].
    held : bool, optional
        Whether the input is held from one to the next, and does not run straight.
    """
    memory = e.memory
    if memory is None:
        return u, casadi.SX(0, 1)
    given = casadi.vertcat(memory.m, memory.u, memory.period, e.p)
    acting = memory.applied if held else memory.after
    both = casadi.substitute(
        casadi.vertcat(acting, memory.after), given, casadi.vertcat(m, u, period, p)
    )
    return both[0], both[1]


def find_memory_range(e: Equations, u: float, at_rest: float, p: Any) -> tuple[float, float]:
    """Return the middle of where a memory may be ahead of the first input, and its reach.

    Nobody knows what went before; `at_rest` is the input at the operating point.
    """
    memory = e.memory
    assert memory is not None
    given = casadi.vertcat(memory.u, memory.at_rest, e.p), casadi.vertcat(u, at_rest, p)
    found = casadi.substitute(casadi.vertcat(memory.start, memory.reach), *given)
    middle, reach = casadi.DM(casadi.evalf(found)).full().ravel().tolist()
    return middle, reach


def _insert_symbols(e: Equations, free: Sequence[str], symbols: Any) -> Any:
    """Return the values of all parameters, with symbols in place of those that are free."""
    p, names = casadi.SX(casadi.DM(e.values)), list(e.parameters)
    for k, name in enumerate(free):
        p[names.index(name)] = symbols[k]
    return p


def _insert_values(e: Equations, pieces: Sequence[Piece], p: Any) -> list[Piece]:
    """Put parameter values into the durations of pieces."""
    values = casadi.SX(p) if isinstance(p, casadi.SX) else casadi.SX(casadi.DM(p))
    return [
        tuple(casadi.substitute(casadi.SX(part), e.p, values) for part in piece)  # type: ignore[misc]
        for piece in pieces
    ]


def linearize_at_rest(s: PeriodMap, function: Any) -> tuple[Array, Array]:
    """Return the derivatives of a function (step, rate) by state and signals at rest."""
    a, b = _differentiate(s, lambda z, w: function.call([z, w])[:1])
    return a, b


def linearize_sensors_at_rest(s: PeriodMap) -> tuple[Array, Array, Array, Array]:
    """Return A, B, C and D of a loop from the noise of its sensors to its outputs, at rest."""
    a, b, c, d = _differentiate(s, lambda z, w: s.step.call([z, w])[:2])
    return a, b[:, s.places[3]], c, d[:, s.places[3]]


def _differentiate(s: PeriodMap, evaluate: Callable[[Any, Any], Sequence[Any]]) -> list[Array]:
    """Return the derivatives of expressions by state and signals at rest, one after the other."""
    z, w = casadi.SX.sym("z", len(s.rest)), casadi.SX.sym("w", sum(s.counts))
    slopes = [casadi.jacobian(value, by) for value in evaluate(z, w) for by in (z, w)]
    found = casadi.Function("j", [z, w], slopes).call([s.rest, s.still])
    return [np.asarray(value, float) for value in found]


def leave_out_kinks(loop: Loop, memories: bool = True) -> Loop:
    """Return a loop without the effects that have no linear model, such as dry friction.

    Parameters
    ----------
    loop : Loop
        The loop.
    memories : bool, optional
        Whether those between controller and plant go as well, whose memories are states.

    Returns
    -------
    Loop
        The loop.
    """
    # From the last one on, since the effects of one kind behind it would be numbered anew.
    for label, effect in reversed(loop.labelled.items()):
        if not effect.in_linear_model and (memories or effect.place != "input"):
            loop = loop.without_effect(label)
    return loop


def compute_closed_loop_poles(loop: Loop, hidden: bool = True) -> ComplexArray:
    r"""Return the poles of a loop for small deviations [rad/s].

    .. math:: s_i = \ln(\lambda_i) / T

    with the eigenvalues of the linearized map over one sampling period T, with the controller as it
    runs; with an analog controller the poles of the loop's rates. As in `Loop.linearize`, the steps
    of a converter, dry friction, dead zones and backlash are left out: within one step of it at
    rest, no converter passes anything on, and a mass that sticks moves for no small force.

    Parameters
    ----------
    loop : Loop
        The loop.
    hidden : bool, optional
        Whether those of controller states count that no signal reaches, such as the integral of a
        `PID` without integral gain or the covariance of an observer.

    Returns
    -------
    ndarray of complex
        Poles of plant and controller; minus infinity for what is at rest after one period.

    Raises
    ------
    CtrlidError
        If the plant has no derivative at the operating point.
    """
    loop = leave_out_kinks(loop)
    s = make_period_map(loop, 8)
    # The rates give the poles of a stiff circuit without the error of an integration step.
    matrix, entry = linearize_at_rest(s, s.step if s.rate is None else s.rate)
    if not np.isfinite(matrix).all():
        raise ModelCannotRun(
            f"{loop.equations().name} has no derivative at its operating point, {loop.point}; "
            "give at=operating_point(plant, output=...)"
        )
    if not hidden:
        n, law = len(s.plant_states), loop.law()
        of_controller = np.zeros(len(matrix), dtype=bool)
        of_controller[n : n + (len(law.rest) if law else 0)] = True
        kept = find_reached_states(matrix, entry) | ~of_controller
        matrix = matrix[np.ix_(kept, kept)]
    poles: ComplexArray = np.linalg.eigvals(matrix).astype(complex)
    if s.rate is not None:
        return poles
    with np.errstate(divide="ignore"):
        rates: ComplexArray = np.log(np.abs(poles)) / loop.dt + 1j * (np.angle(poles) / loop.dt)
    return rates


def compute_growth_rate(loop: Loop) -> float:
    r"""Return the growth rate of small deviations in the closed loop [1/s].

    .. math:: \max_i \operatorname{Re} s_i

    over its poles. Negative: stable.

    Parameters
    ----------
    loop : Loop
        The loop.

    Returns
    -------
    float
        The rate; minus infinity for a loop that is at rest after one period.

    Raises
    ------
    CtrlidError
        If the plant has no derivative at the operating point.
    """
    return float(np.max(compute_closed_loop_poles(loop).real, initial=-math.inf))


@functools.lru_cache(maxsize=32)
def comes_to_rest(loop: Loop) -> bool:
    """Return whether small deviations die out in a loop, or in the plant without a controller."""
    return compute_growth_rate(loop) < -1e-6 / loop.dt
