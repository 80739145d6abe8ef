"""Which effects no record of input and output can tell apart, found from a plant's equations."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi
import numpy as np

from .._base.arguments import check_arguments
from .._base.arrays import Array
from .._base.errors import CtrlidError, EffectDoesNotApply
from ..physics.equations import Equations
from ..physics.linearization import compute_state_matrices
from .base import AbstractEffect
from .catalogue import CATALOGUE
from .context import find_motion
from .kinds import ReadingEffect
from .law import PositionOffset
from .time_varying import ParameterError

# Two changes are compared at so many random states and inputs.
POINTS = 24
# Changes that differ by less than this share are the same.
SAME = 1e-6
# Changes are compared at two sizes of a parameter, since equal ones agree at every size.
SIZES = (1e-4, 1e-2)
# A wrong scale is compared at this size, at which it is not nearly a straight line.
SCALE = 0.1
# Newton's method, with differences of this relative width, is at the solution after so many steps.
NEWTON_STEPS = 6
NEWTON_WIDTH = 1e-5


def equivalents(
    effect: AbstractEffect, loop: Any, catalogue: Sequence[type[AbstractEffect]] = CATALOGUE
) -> tuple[str, ...]:
    """Return what changes the loop's plant in exactly the same way as an effect does.

    Two effects that change rates and output alike, at random points and at two sizes, are one:
    only a further measurement can tell them apart. So is an offset of the sensor and one of the
    position in the law, where the output is the position: the state is counted from another zero.
    So is, on a linear plant, a lag ahead of it and one behind it, and a line in the force and one
    in the reading; and a delay at either end of any. A wrong scale of the sensor is the same plant
    on another scale: it is compared with the free parameters moving along. A drift of the sensor
    is a steady motion, which on a linear plant a constant force may keep up.

    Parameters
    ----------
    effect : AbstractEffect
        The effect, at any values.
    loop : Loop
        The loop, with or without the effect.
    catalogue : sequence of effect classes, optional
        The effects to compare with.

    Returns
    -------
    tuple of str
        Names of effect classes; "parameter g" for a parameter of the plant; and in words what is
        no effect of the catalogue.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.servo(m=2.0, c=1.0, k=3.0)
    >>> loop = cid.Loop(plant, dt=0.01)
    >>> cid.effects.equivalents(cid.effects.ConstantForce(bias=0.1), loop)
    ('InputOffset', 'SensorDrift')
    """
    check_arguments(equivalents, locals())
    if isinstance(loop, type) or not callable(getattr(loop, "with_effect", None)):
        raise CtrlidError(f"equivalents needs a Loop as loop; given {type(loop).__name__}")
    if getattr(effect, "centre", "") != "":
        # From one side of a zone it is an offset, but its record comes from both.
        return ()
    base = loop.without_effect(effect) if effect in loop.effects else loop
    if not base.equations().siso:
        return _find_equivalents_at_places(effect, base, catalogue)
    name = type(effect).__name__
    if name == "InputDelay":
        return ("delay of the output",)
    if name == "AsymmetricCoulombFriction":
        return ("CoulombFriction with a constant force",)
    if name in LINES:
        e = base.equations()
        both = _is_linear(e, forced=True) and find_motion(e) is not None
        asked = {cls.__name__ for cls in catalogue}
        return tuple(k for k in LINES if k != name and k in asked) if both else ()
    if name in LAGS:
        return tuple(k for k in LAGS if k != name) if _is_linear(base.equations()) else ()
    others = [e for e in (_make_member(cls, base) for cls in catalogue) if e is not None]
    # A drift that settles is no steady motion.
    tied = _find_tied(base, others) if len(effect.values()) == 1 else []
    found = {name: effect}
    words: set[str] = set()
    todo = [name]
    # What is equivalent to an equivalent effect is equivalent.
    while todo:
        known = todo.pop()
        shifted = _find_shifted_offsets(known, base)
        equal = [
            e
            for e in others
            if type(e).__name__ in shifted
            or {known, type(e).__name__} in tied
            or _is_same_change(base, found[known], e)
        ]
        words |= {word for word in shifted if word not in OFFSETS}
        words |= {
            word for pair in tied if known in pair for word in pair if not word.isidentifier()
        }
        words |= {
            f"parameter {key}"
            for key in base.equations().parameters
            if "." not in key and _is_change_of_parameter(base, found[known], key)
        }
        new = {type(e).__name__: e for e in equal if type(e).__name__ not in found}
        found |= new
        todo += new
    return (*sorted(found.keys() - {name}), *sorted(words - {effect.called}))


def _find_equivalents_at_places(
    effect: AbstractEffect, loop: Any, catalogue: Sequence[type[AbstractEffect]]
) -> tuple[str, ...]:
    """Return what changes rates and outputs alike, of a plant with several signals."""
    e = loop.equations()
    if type(effect).__name__ == "InputDelay":
        return ("delay of all outputs",)
    velocities = [e.states[j] for j in e.velocities]
    places = {"input": e.inputs, "output": e.outputs, "force": velocities}
    found = []
    for kind in catalogue:
        given = kind.parameters()
        if len(given) != 1 or kind.states or given[0].neutral is None:
            continue
        for at in places.get(kind.place, ()):
            if (kind, at) == (type(effect), effect.at):
                continue
            try:
                other = kind(**{given[0].name: given[0].neutral}, at=at)
                same = _is_same_change(loop, effect, other)
            except (EffectDoesNotApply, TypeError):
                # One that names a state of the plant as well is compared with none.
                continue
            if same:
                found.append(f"{kind.__name__} at {at}")
    words = {f"parameter {key}" for key in e.parameters
             if "." not in key and _is_change_of_parameter(loop, effect, key)}  # fmt: skip
    return (*sorted(found), *sorted(words - {effect.called}))


LAGS = ("ActuatorLag", "SensorLag")
OFFSETS = ("PositionOffset", "SensorOffset")
LINES = ("PeriodicForce", "SensorHum")


def _find_tied(loop: Any, others: Sequence[AbstractEffect]) -> list[set[str]]:
    """Return pairs of names that are one when states are counted otherwise."""
    names = {type(e).__name__ for e in others}
    tied = []
    if "SensorGain" in names:
        tied += [{"SensorGain", name} for name in _find_scaled(loop, others)]
    if "SensorDrift" in names:
        tied += [{"SensorDrift", name} for name in _find_steady_motion(loop)]
    return tied


def _find_scaled(loop: Any, others: Sequence[AbstractEffect]) -> set[str]:
    r"""Return what does as a wrong scale of the sensor does, the free parameters moving along.

    .. math:: \dot z = S f(S^{-1} z, u), \quad z = S x, \quad S = 1 + \epsilon

    for position and velocity: the same plant, as its sensor shows it.
    """
    e = loop.equations()
    motion = find_motion(e)
    if motion is None:
        return set()
    moving = [k for k in motion if k is not None]
    if not casadi.is_equal(casadi.simplify(e.output), e.x[moving[0]], 2):
        return set()
    stretch = np.ones(len(e.states))
    stretch[moving] = 1 + SCALE
    points = _draw_points(loop.point)
    x, u, t = points
    rates = stretch * e.evaluate_points(x / stretch, u, t)[0]
    own = [n for n in loop.free if "." not in n]
    if _can_reproduce(e, own, points, rates):
        # The free parameters take it up, so that no effect is left to stand for it.
        return set()
    found = {
        f"parameter {n}"
        for n in e.parameters
        if "." not in n and n not in own and _can_reproduce(e, [*own, n], points, rates)
    }
    for effect in others:
        if effect.place == "output" or effect.states:
            continue
        key = effect.parameters()[0].name
        try:
            there = loop.with_effect(replace(effect, **{key: effect.parameters()[0].neutral}))
            changed = there.equations(keep=True)
        except EffectDoesNotApply:
            continue
        if changed.delay is not None or changed.memory is not None:
            continue
        unknown = [*own, f"{list(there.labelled)[-1]}.{key}"]
        if unknown[-1] in changed.parameters and _can_reproduce(changed, unknown, points, rates):
            found.add(type(effect).__name__)
    return found


def _can_reproduce(
    e: Equations, names: Sequence[str], points: tuple[Array, Array, Array], wanted: Array
) -> bool:
    """Whether some values of named parameters give the wanted rates at all points."""
    if not names:
        return False
    index = [list(e.parameters).index(n) for n in names]
    start = np.array(e.values, dtype=float)
    scale = np.where(start == 0, 1.0, np.abs(start))[index]

    def compute_error(shift: Array) -> Array:
        values = start.copy()
        values[index] += scale * shift
        return np.ravel(e.evaluate_points(*points, values)[0] - wanted)

    shift = np.zeros(len(names))
    first = error = compute_error(shift)
    if not np.isfinite(first).all() or not first.any():
        return False
    for _ in range(NEWTON_STEPS):
        columns = [
            (compute_error(shift + h) - compute_error(shift - h)) / (2 * NEWTON_WIDTH)
            for h in NEWTON_WIDTH * np.eye(len(names))
        ]
        slopes = np.column_stack(columns)
        if not np.isfinite(slopes).all():
            return False
        shift = shift - np.linalg.lstsq(slopes, error, rcond=None)[0]
        error = compute_error(shift)
        # What first slopes cannot nearly reproduce, no values do.
        if not np.linalg.norm(error) < 0.1 * np.linalg.norm(first):
            return False
    return bool(np.linalg.norm(error) <= SAME * np.linalg.norm(first))


def _find_steady_motion(loop: Any) -> set[str]:
    r"""Return what makes the output of a linear plant a ramp, as a drift of its sensor does.

    .. math:: A x_1 = 0, \quad C x_1 = 1, \quad A x_0 + b f = x_1, \quad C x_0 = 0

    for the motion :math:`x_0 + x_1 t` under a constant force f.
    """
    e = loop.equations()
    motion = find_motion(e)
    if motion is None or not _is_linear(e, forced=True):
        return set()
    a, _, c, _ = compute_state_matrices(e, loop.point)
    n = len(a)
    push = np.zeros((n, 1))
    push[motion[1]] = 1.0
    zero = np.zeros((n, n))
    rows = np.block([
        [a, zero, np.zeros((n, 1))],
        [c, np.zeros((1, n + 1))],
        [-np.eye(n), a, push],
        [np.zeros((1, n)), c, np.zeros((1, 1))],
    ])  # fmt: skip
    wanted = np.zeros(2 * n + 2)
    wanted[n] = 1.0
    for kept, name in ((slice(0, 2 * n), "the initial velocity"), (slice(None), "ConstantForce")):
        part = rows[:, kept]
        z = np.linalg.lstsq(part, wanted, rcond=None)[0]
        if np.linalg.norm(part @ z - wanted) <= SAME:
            return {name}
    return set()


def _find_shifted_offsets(name: str, loop: Any) -> set[str]:
    """Offsets that become one another when the position is counted from another zero."""
    e = loop.equations()
    found = find_motion(e)
    if name not in OFFSETS or found is None:
        return set()
    i, j = found
    if i is None:
        return set()
    # The output is the position, but for a constant.
    shown = casadi.simplify(casadi.jacobian(e.output, e.x[i]))
    rest = casadi.substitute(e.output, e.x[i], casadi.SX(0.0))
    if not casadi.is_equal(shown, casadi.SX(1.0), 2) or any(
        casadi.which_depends(rest, casadi.vertcat(e.x, e.u, e.t), 1, True)
    ):
        return set()
    if not casadi.jacobian(e.rhs[j], e.x[i]).nnz():
        return {"the initial position"}
    return set(OFFSETS) if _is_seen_by_law_alone(loop, i) else set()


def _is_seen_by_law_alone(loop: Any, i: int) -> bool:
    """Whether the law of the plant alone sees the position, state i, and no spring beside it."""
    size = 1e-2 * (abs(loop.point.states[i]) or 1.0)
    try:
        changed = loop.with_effect(PositionOffset(size)).equations()
    except EffectDoesNotApply:
        return False
    e, shift = loop.equations(), np.zeros(len(loop.point.states))
    shift[i] = size
    x, u, t = _draw_points(loop.point)
    offset, elsewhere, here = (
        np.ravel(one.evaluate_points(z, u, t)[0])
        for one, z in ((changed, x), (e, x + shift), (e, x))
    )
    return _are_equal(elsewhere - here, offset - here)


def _is_linear(e: Equations, forced: bool = False) -> bool:
    """Whether rates and output are straight lines in states and input, the same at all times.

    What is only added may change with time if the plant is allowed to be `forced`.
    """
    if e.dt:
        return False
    both = casadi.vertcat(e.rhs, e.output)
    z = casadi.vertcat(e.x, e.u)
    bent = any(casadi.which_depends(both, z, 2, True))
    steady = casadi.vec(casadi.densify(casadi.jacobian(both, z))) if forced else both
    return not bent and not any(casadi.which_depends(steady, e.t, 1, True))


def _make_member(cls: type[AbstractEffect], loop: Any) -> AbstractEffect | None:
    """Return an instance of a class that has a single parameter and no states, else None.

    Parameters of the plant are compared by their names.
    """
    if cls is ParameterError:
        return None
    needed = [p for p in cls.parameters() if not p.optional]
    if len(needed) != 1 or cls.states or needed[0].neutral is None:
        return None
    return next(iter(cls.candidates(loop)), None)


def _compute_change(loop: Any, effect: AbstractEffect, size: float) -> Array | None:
    """Return how rates and output change at random points, None where the effect is not static."""
    if effect.states or len(effect.values()) != 1 or isinstance(effect, ReadingEffect):
        return None
    parameter = effect.parameters()[0]
    if parameter.neutral is None or not np.isfinite(parameter.neutral):
        return None
    try:
        changed = loop.with_effect(replace(effect, **{parameter.name: parameter.neutral + size}))
    except EffectDoesNotApply:
        return None
    e = changed.equations(keep=True)
    if e.delay is not None or e.memory is not None:
        return None
    return _evaluate_at_points(e, loop.point) - _evaluate_at_points(loop.equations(), loop.point)


def _evaluate_at_points(e: Equations, at: Any, values: Array | None = None) -> Array:
    return np.hstack(e.evaluate_points(*_draw_points(at), values)).ravel()


def _draw_points(at: Any) -> tuple[Array, Array, Array]:
    """Return random states and inputs around rest, and a time for each of them."""
    rng = np.random.default_rng(3)
    n, inputs = len(at.states), at.inputs
    rest = np.array([*at.states, *inputs])
    scale = np.where(rest == 0, 1.0, 0.3 * np.abs(rest))
    points = rest + scale * rng.uniform(-1, 1, (POINTS, rest.size))
    u = points[:, n:] if len(inputs) > 1 else points[:, n]
    return points[:, :n], u, np.arange(float(POINTS))


def _find_factor(first: Array | None, second: Array | None) -> float | None:
    """Return the factor by which the second change is to be taken, None if it is another one."""
    if first is None or second is None:
        return None
    good = np.isfinite(first) & np.isfinite(second)
    first, second = first[good], second[good]
    if not (first.any() and second.any()):
        return None
    factor = float(first @ second / (second @ second))
    near = np.linalg.norm(first - factor * second) <= 0.1 * np.linalg.norm(first)
    return factor if near else None


def _are_equal(first: Array | None, second: Array | None) -> bool:
    if first is None or second is None:
        return False
    good = np.isfinite(first) & np.isfinite(second)
    off = float(np.linalg.norm((first - second)[good]))
    return off <= SAME * float(np.linalg.norm(first[good]))


def _is_same_change(loop: Any, first: AbstractEffect, second: AbstractEffect) -> bool:
    if type(first) is type(second) and first.at == second.at:
        return False
    for size in SIZES:
        one = _compute_change(loop, first, size)
        factor = _find_factor(one, _compute_change(loop, second, size))
        if factor is None or not _are_equal(one, _compute_change(loop, second, factor * size)):
            return False
    return True


def _is_change_of_parameter(loop: Any, effect: Any, name: str) -> bool:
    e, at = loop.equations(), loop.point
    k = list(e.parameters).index(name)

    def change(size: float) -> Array:
        values = e.values
        values[k] += size
        return _evaluate_at_points(e, at, values) - _evaluate_at_points(e, at)

    for size in SIZES:
        one = None if effect is None else _compute_change(loop, effect, size)
        step = 1e-3 * (abs(e.values[k]) or 1.0)
        factor = _find_factor(one, change(step))
        if factor is None:
            return False
        for _ in range(NEWTON_STEPS):
            # What a parameter divides by changes a little less or more than in proportion.
            correction = _find_factor(one, change(factor * step))
            if correction is None:
                return False
            factor *= correction
        if not _are_equal(one, change(factor * step)):
            return False
    return True
