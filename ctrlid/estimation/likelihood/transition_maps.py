"""Maps of a plant over one sampling period with their derivatives, built once per structure."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import casadi
import numpy as np

from ..._base.arrays import Array
from ..._base.errors import ModelCannotRun
from ...data.reconstruction import count_pieces
from ...loop.controllers import ControlLaw, connect_law
from ...loop.loop import Loop
from ...loop.period_map import push_velocities
from ...physics.block_evaluation import BlockEvaluation
from ...physics.differentiation import Stages, differentiate
from ...physics.equations import Equations
from ...physics.integration import Scheme, advance, cut_input, find_lags, integrate, integrate_fast
from ...physics.linearization import compute_state_matrices
from .filter_data import find_rest_state

# The maps of so many structures are kept, which bounds memory.
BUILT = 64
# In an expression of more instructions the search for common parts costs more than it saves.
LONG = 3000
# A step of order four is accurate enough up to this product of step and fastest rate.
SLOW = 0.35
# More steps of order eight in a period make an expression that takes minutes to build.
MOST_STEPS = 100
# Under an analog controller all steps of a period are one expression, so that each is dear; so many
# of order eight are stable up to twenty radians in a period.
MOST_STEPS_UNDER_LAW = 4
# A step of order four follows a lag accurately if it is this share of its time constant.
LAG_STEP = 0.35
# Beside the kink of friction this share is enough, since no formula is more accurate there.
LAG_STEP_AT_KINK = 0.7
# So many steps of order four cost less than one of order eight.
FEW_STEPS = 3
# So many steps of order four resolve the transient of a short lag where friction has a kink.
SHARP_STEPS = 6
# So many steps of order four resolve the kink of friction in a period; a lag doubles them.
KINK_STEPS = 4


@dataclass(frozen=True)
class PeriodPlan:
    """What is to be built; plans that differ in the values of parameters only are equal.

    Parameters
    ----------
    equations : Equations
        The plant with its effects, neutral ones as well.
    law : ControlLaw or None
        A known analog controller that moves the input between samples.
    dt : float
        Sampling period [s].
    hold : {"zoh", "foh", "bandlimited"}
        How the input runs between samples otherwise.
    scheme : Scheme
        How a period is integrated.
    forces : tuple of int
        States that random forces act on.
    channels : int
        Number of these forces; a single one acts on all.
    index : tuple of int
        Places of the free parameters.
    delay_samples : int
        Whole pieces by which the input comes late: periods, or parts of one if it is band-limited.
    hold_r : {"zoh", "foh"}
        How the reference of the controller runs between samples.
    sees : {"reading", "output"}
        Whether such a controller sees the noise of the readings, or only the logger does.
    structure : tuple
        What is compared in place of equations and law: their expressions without values.
    """

    equations: Equations = field(compare=False)
    law: ControlLaw | None = field(compare=False)
    dt: float
    hold: str
    scheme: Scheme
    forces: tuple[int, ...]
    channels: int
    index: tuple[int, ...]
    delay_samples: int
    hold_r: str
    sees: str
    structure: tuple[Any, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        e, law = self.equations, self.law
        key = ("structure", law, self.references, self.rows[-1])
        text = e.derive(key, self._write_expressions)
        lags = tuple(lag.state for lag in e.lags)
        parts = (text, e.dt, len(e.rest), lags, law is not None, e.late_input)
        object.__setattr__(self, "structure", parts)

    def _write_expressions(self) -> str:
        """Return the expressions of equations and law in the text of CasADi."""
        e, law = self.equations, self.law
        spread = e.smoothed.sx_in(4) if e.spread is None else e.spread
        given, found = [e.t, e.x, e.u, e.p, spread], [e.rhs, e.output]
        found += [part for lag in e.lags for part in (lag.time_constant, lag.target)]
        found += [part for part in (e.delay, e.pushes) if part is not None]
        if e.memory is not None:
            given += [e.memory.m, e.memory.u, e.memory.period, e.memory.at_rest]
            found += [e.memory.after, e.memory.applied, e.memory.start, e.memory.reach]
        if law is not None:
            state, r, y = (
                casadi.SX.sym(key, size)
                for key, size in (
                    ("c", len(law.rest)),
                    ("r", self.references),
                    ("y", self.rows[-1]),
                )
            )
            given += [state, r, y]
            found += law.apply(e.t, state, r, y)
        every = casadi.Function("every", given, [casadi.SX(part) for part in found])
        return str(every.serialize())

    @property
    def size(self) -> int:
        """Number of states, those of the controller among them."""
        return len(self.equations.states) + (len(self.law.rest) if self.law else 0)

    @property
    def pieces(self) -> int:
        """Number of straight pieces of the input in a period."""
        return count_pieces(self.hold)

    @property
    def references(self) -> int:
        """Number of references of the controller; one where there is none."""
        known = None if self.law is None else self.law.references
        return 1 if known is None else len(known)

    @property
    def rows(self) -> tuple[int, ...]:
        """How many rows time, the input at each corner, reference and output have."""
        m, q = len(self.equations.inputs), len(self.equations.outputs)
        references = (self.references,) * (2 if self.hold_r == "foh" else 1)
        return 1, *(m,) * (self.pieces + 2), *references, q


def choose_scheme(e: Equations, loop: Loop, dt: float, law: ControlLaw | None = None) -> Scheme:
    """Return the cheapest scheme that integrates the plant over a time dt accurately enough.

    Together with the analog controller `law`, if it moves the input between samples.
    """
    if e.dt:
        return Scheme(4, 1)
    time = _find_input_lag_time(e, e.values)
    driven, cut = np.isfinite(time), bool(time < dt / 8) and law is None
    try:
        rate, rate_under_law = (v * dt for v in _find_fastest_rates(e, loop, law))
    except ModelCannotRun:
        return Scheme(8, 2, (8, 2) if cut else None)
    # Under whatever controller, a plant that is too fast is refused below.
    if law is not None and rate / 1.5 <= MOST_STEPS:
        return _choose_scheme_under_law(e, rate_under_law, loop.sharpness)
    if rate <= 3 * SLOW:
        # A velocity that turns within a period crosses the kink of friction there.
        kink = _count_kink_steps(loop.sharpness)
        few = max(kink if e.kinked else 1, math.ceil(rate / SLOW))
        if not driven:
            return Scheme(4, few)
        # A higher order does not help beside a kink.
        if cut and e.kinked:
            return Scheme(4, few, (4, SHARP_STEPS * kink // KINK_STEPS))
        # What a lag of the input does is known exactly; the plant has to follow it.
        few = max(
            2 * few if e.kinked else few,
            2,
            math.ceil(dt / time / _choose_lag_step(e)),
        )
        if e.kinked or few <= FEW_STEPS:
            return Scheme(4, few)
    steps = max(2 if e.kinked else 1, math.ceil(rate / 1.5))
    if steps > MOST_STEPS:
        raise ModelCannotRun(
            f"{e.name} has a motion at {rate / dt:.3g} rad/s, {rate:.3g} times faster than it "
            "is sampled. The filter cannot follow a motion that ends within one sample: leave it "
            "out of the plant, or sample faster"
        )
    return Scheme(8, steps, (8, steps) if cut else None)


def _count_kink_steps(sharpness: float) -> int:
    """Return how many steps of order four resolve friction that is so many times as abrupt.

    A step is at most twice the time in which friction stops a mass; it is stable up to 2.8 times.
    """
    return max(KINK_STEPS, math.ceil(KINK_STEPS * sharpness / 2))


def _choose_scheme_under_law(e: Equations, rate: float, sharpness: float) -> Scheme:
    """Return the scheme of a plant and its analog controller, which move together.

    A lag has no exact formula there, and is a state as others are.
    """
    if rate > 3 * SLOW:
        return Scheme(8, min(max(2, math.ceil(rate / 1.5)), MOST_STEPS_UNDER_LAW))
    few = max(_count_kink_steps(sharpness) if e.kinked else 2, math.ceil(rate / SLOW))
    return Scheme(4, 2 * few if e.kinked and find_lags(e)[0] else few)


def _find_fastest_rates(e: Equations, loop: Loop, law: ControlLaw | None) -> tuple[float, float]:
    """Return the rates of the fastest motion of the plant, and of it under a controller [rad/s].

    Lags count under the controller only: without one they are advanced exactly.
    """
    point = replace(loop.point, states=find_rest_state(loop, e))
    # The filter's own uncertainty smooths kinks; sharp friction does not make the plant stiff.
    a, b, c, _ = compute_state_matrices(e, point, spread=1e6)
    hidden = [lag.state for lags in find_lags(e) for lag in lags]
    plain = [k for k in range(len(e.states)) if k not in hidden]
    alone = _find_fastest_rate(a[np.ix_(plain, plain)])
    if law is None:
        return alone, alone
    both, entry, feedback = connect_law(a, b, c, law, loop.point)
    return alone, _find_fastest_rate(both + entry @ feedback)


def _find_fastest_rate(a: Array) -> float:
    return float(np.max(np.abs(np.linalg.eigvals(a)), initial=0.0))


def _choose_lag_step(e: Equations) -> float:
    """Return the step of order four that follows a lag, as a share of its time constant."""
    return LAG_STEP_AT_KINK if e.kinked else LAG_STEP


def is_scheme_suitable(
    scheme: Scheme, e: Equations, p: Array, dt: float, law: ControlLaw | None = None
) -> bool:
    """Return whether a period is integrated well enough for the lag of the parameters `p`."""
    time = _find_input_lag_time(e, p)
    if scheme.sharp:
        return time < dt / 4
    if scheme.order == 4:
        return time > dt / scheme.steps / (2 * _choose_lag_step(e))
    return time > dt / (16 if law is None else 4 * scheme.steps)


def _find_input_lag_time(e: Equations, p: Array) -> float:
    """Return the time constant of the lag that follows the input; infinite without one."""
    for lag in find_lags(e)[0]:
        values = casadi.SX(casadi.DM(p))
        return float(casadi.evalf(casadi.substitute(casadi.SX(lag.time_constant), e.p, values)))
    return math.inf


@dataclass(frozen=True, eq=False)
class TransitionMaps:
    """What is built from expressions: a period in stages, each in equal parts, and the sensor."""

    functions: tuple[casadi.Function, ...]
    stages: tuple[BlockEvaluation, ...]
    parts: int
    sensor_function: casadi.Function
    sensor: BlockEvaluation

    @property
    def carries(self) -> bool:
        """Whether state and derivatives go from one map to the next."""
        return len(self.functions) * self.parts > 1


@functools.lru_cache(maxsize=BUILT)
def build_maps(plan: PeriodPlan) -> TransitionMaps:
    """Return the maps, built once: that takes the time of several passes."""
    x, ends, given, by, parts = _build_period(plan)
    # Behind backlash, the input itself depends on the free parameters.
    own = ("force", "free") if plan.equations.memory is None else ("force", "free", "input")
    functions = _chain_maps(x, ends, parts, given, [by[key] for key in own], plan.index)
    output = by["output"]
    outputs = [output, casadi.jacobian(output, x), casadi.jacobian(output, by["free"])]
    sensor = casadi.Function("sensor", [x, *given[:3]], outputs, {"cse": True})
    stages = tuple(BlockEvaluation(f) for f in functions)
    return TransitionMaps(functions, stages, parts, sensor, BlockEvaluation(sensor))


def _build_period(plan: PeriodPlan) -> tuple[Any, list[Any], list[Any], dict[str, Any], int]:
    """Return the state, its value after each stage, what is given, symbols, and the parts."""
    e, n, dt = plan.equations, len(plan.equations.states), plan.dt
    x, p, s = (casadi.SX.sym(k, m) for k, m in (("x", plan.size), ("p", e.p.shape[0]),
                                                ("s", n)))  # fmt: skip
    w = [casadi.SX.sym(f"w{k}", rows) for k, rows in enumerate(plan.rows)]
    # A straight reference comes with the one of the next sample.
    straight = plan.hold_r == "foh"
    t, *path, r, next_r, y = w if straight else [*w[:-1], w[-2], w[-1]]
    now = path[1]
    if plan.pieces > 1:
        # The corners are off the signal itself, but this mean of three of them is on it.
        now = (path[0] + 10 * now + path[2]) / 12
    force = casadi.SX.sym("f", plan.channels)
    held_rate = casadi.SX.zeros(n, 1)
    for k, j in enumerate(plan.forces):
        held_rate[j] = force[k if plan.channels > 1 else 0]
    if e.pushes is not None:
        held_rate = push_velocities(e, force, t, x[:n], p)
    # A fit repeats the map often; a single prediction can afford to be exact.
    scheme = plan.scheme if plan.index else _raise_order(plan.scheme, e.kinked)
    part = casadi.SX.sym("i")
    if plan.law is None:
        pieces = [
            tuple(casadi.substitute(casadi.SX(value), e.p, p) for value in piece)
            for k in range(plan.pieces)
            for piece in cut_input(e, dt / plan.pieces, path[k : k + 3], plan.hold)
        ]
        ends, parts = _build_stages(plan, t, x, pieces, p, s, held_rate, scheme, part)
    else:
        stages = Stages(e)
        end = _integrate_with_controller(
            plan, stages, t, x, p, s, held_rate, now, (r, next_r), y, scheme
        )
        ends, parts = [(end, stages)], 1
    free = casadi.vertcat(*(p[k] for k in plan.index)) if plan.index else casadi.SX(0, 1)
    by = {"force": force, "free": free, "input": casadi.vertcat(*path),
          "output": e.smoothed(t, x[:n], now, p, s)[1]}  # fmt: skip
    return x, ends, [casadi.vertcat(*w), p, s, force, part], by, parts


def _raise_order(scheme: Scheme, kinked: bool) -> Scheme:
    """Return a scheme of order eight throughout."""
    steps = scheme.steps if kinked or scheme.order == 8 else 1
    return Scheme(8, steps, (8, steps) if scheme.sharp else None)


def _build_stages(
    plan: PeriodPlan, t: Any, x: Any, pieces: Any, p: Any, s: Any, held_rate: Any, scheme: Scheme,
    part: Any,
) -> tuple[list[Any], int]:  # fmt: skip
    """Return the maps that make up a period, and how many equal parts each of them has.

    Several steps of one kind are one short expression that is gone through several times.
    """
    e, steps = plan.equations, scheme.steps
    if e.dt or scheme.sharp or steps == 1:
        stages = Stages(e)
        end = advance(e, t, x, pieces, p, s, held_rate, scheme=scheme, stages=stages)[0]
        return [(end, stages)], 1
    ends, begin, one = [], t, Scheme(scheme.order, 1)
    for duration, level, slope in pieces:
        h, stages = duration / steps, Stages(e)
        piece = (h, level + slope * part * h, slope)
        after = advance(e, begin + part * h, x, [piece], p, s, held_rate, scheme=one,
                        stages=stages)[0]  # fmt: skip
        ends.append((after, stages))
        begin = begin + duration
    return ends, steps


def _integrate_with_controller(
    plan: PeriodPlan,
    stages: Stages,
    t: Any,
    x: Any,
    p: Any,
    s: Any,
    held_rate: Any,
    u: Any,
    path_r: tuple[Any, Any],
    y: Any,
    scheme: Scheme,
) -> Any:
    """Advance plant and analog controller together, u being the measured one at the start.

    The reference runs straight from one value to the next one, or is held if both are the same.
    """
    law, n = plan.law, len(plan.equations.states)
    assert law is not None
    r, climb = path_r[0], (path_r[1] - path_r[0]) / plan.dt
    output = stages(t, x[:n], u, p, s)[1]
    y = y if plan.sees == "reading" else output
    noise = y - output
    # The offset holds bias, injected signals and what the controller's state leaves unexplained.
    offset = u - law.apply(t, x[n:], r, y)[0]

    def rate(tau: Any, z: Any) -> Any:
        seen = stages(t + tau, z[:n], u, p, s)[1] + noise
        computed, slope = law.apply(t + tau, z[n:], r + climb * tau, seen)
        driven = stages(t + tau, z[:n], computed + offset, p, s)[0] + held_rate
        return casadi.vertcat(driven, slope)

    if scheme.order == 4:
        return integrate_fast(rate, x, plan.dt, scheme.steps, once=False)
    return integrate(rate, x, plan.dt, max(scheme.steps, 2), once=False)[0]


def _chain_maps(
    x: Any, ends: Sequence[tuple[Any, Stages]], parts: int, given: Sequence[Any],
    by: Sequence[Any], index: Sequence[int],
) -> tuple[casadi.Function, ...]:  # fmt: skip
    """Return maps that carry the state and its derivatives, by itself first, along.

    Kinks have no slope at the kink itself; everything else is exact.
    """
    n, sizes = x.shape[0], [x.shape[0], *(v.shape[0] for v in by)]
    before = [casadi.SX.eye(n), *(casadi.SX(n, size) for size in sizes[1:])]
    carried = []
    if len(ends) * parts > 1:
        before = carried = [casadi.SX.sym("s", *value.shape) for value in before]
    # The directions: the state as it was, and each further column by itself.
    own = [casadi.horzcat(*(casadi.SX.eye(size) if k == j else casadi.SX(size, other)
                            for j, other in enumerate(sizes)))
           for k, size in enumerate(sizes) if k]  # fmt: skip
    seeds = [casadi.horzcat(*before), *own]
    functions = []
    for end, stages in ends:
        after, slopes = differentiate(end, stages, index, [x, *by], seeds)
        outputs = casadi.horzsplit(slopes, [0, *np.cumsum(sizes).tolist()])
        functions.append(_make_function([x, *carried, *given], [after, *outputs]))
    return tuple(functions)


def _make_function(inputs: Sequence[Any], outputs: Sequence[Any]) -> casadi.Function:
    """Return a function, common parts found once where that pays: long ones have few."""
    plain = casadi.Function("step", inputs, outputs)
    if plain.n_instructions() > LONG:
        return plain
    return casadi.Function("step", inputs, outputs, {"cse": True})
