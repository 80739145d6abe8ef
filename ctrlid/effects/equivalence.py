"""Which effects no record of input and output can tell apart, found from a plant's equations."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi
import numpy as np

from .._base.arrays import Array
from .._base.errors import EffectDoesNotApply
from ..physics.equations import Equations
from .base import AbstractEffect
from .catalogue import CATALOGUE
from .context import find_motion
from .law import PositionOffset

# Two changes are compared at so many random states and inputs.
POINTS = 24
# Changes that differ by less than this share are the same.
SAME = 1e-6
# Changes are compared at two sizes of a parameter, since equal ones agree at every size.
SIZES = (1e-4, 1e-2)


def equivalents(
    effect: AbstractEffect, loop: Any, catalogue: Sequence[type[AbstractEffect]] = CATALOGUE
) -> tuple[str, ...]:
    """Return what changes the loop's plant in exactly the same way as an effect does.

    Two effects that change rates and output alike, at random points and at two sizes, are one:
    only a further measurement can tell them apart. So is an offset of the sensor and one of the
    position in the law, where the output is the position: the state is counted from another zero.
    So is, on a linear plant, a lag ahead of it and one behind it; and a delay at either end of any.

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
    ('InputOffset',)
    """
    base = loop.without_effect(effect) if effect in loop.effects else loop
    name = type(effect).__name__
    if name == "InputDelay":
        return ("delay of the output",)
    if name == "AsymmetricCoulombFriction":
        return ("CoulombFriction with a constant force",)
    if name in LAGS:
        return tuple(k for k in LAGS if k != name) if _is_linear(base.equations()) else ()
    others = [e for e in (_make_member(cls, base) for cls in catalogue) if e is not None]
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
            if type(e).__name__ in shifted or _is_same_change(base, found[known], e)
        ]
        words |= {word for word in shifted if word not in OFFSETS}
        words |= {
            f"parameter {key}"
            for key in base.equations().parameters
            if "." not in key and _is_change_of_parameter(base, found[known], key)
        }
        new = {type(e).__name__: e for e in equal if type(e).__name__ not in found}
        found |= new
        todo += new
    return (*sorted(found.keys() - {name}), *sorted(words))


LAGS = ("ActuatorLag", "SensorLag")
OFFSETS = ("PositionOffset", "SensorOffset")


def _find_shifted_offsets(name: str, loop: Any) -> set[str]:
    """Offsets that become one another when the position is counted from another zero."""
    e = loop.equations()
    found = find_motion(e)
    if name not in OFFSETS or found is None:
        return set()
    i, j = found
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
    rates = [
        (changed.evaluate(x, u, t)[0], e.evaluate(x + shift, u, t)[0], e.evaluate(x, u, t)[0])
        for t, (x, u) in enumerate(_draw_points(loop.point))
    ]
    offset, elsewhere, here = (np.concatenate(part) for part in zip(*rates, strict=True))
    return _are_equal(elsewhere - here, offset - here)


def _is_linear(e: Equations) -> bool:
    """Whether rates and output are straight lines in states and input, the same at all times."""
    if e.dt:
        return False
    both = casadi.vertcat(e.rhs, e.output)
    z = casadi.vertcat(e.x, e.u)
    bent = any(casadi.which_depends(both, z, 2, True))
    return not bent and not any(casadi.which_depends(both, e.t, 1, True))


def _make_member(cls: type[AbstractEffect], loop: Any) -> AbstractEffect | None:
    """Return an instance of a class that has a single parameter and no states, else None."""
    if len(cls.parameters()) != 1 or cls.states or cls.parameters()[0].neutral is None:
        return None
    return next(iter(cls.candidates(loop)), None)


def _compute_change(loop: Any, effect: AbstractEffect, size: float) -> Array | None:
    """Return how rates and output change at random points, None where the effect is not static."""
    if effect.states or len(effect.parameters()) != 1:
        return None
    parameter = effect.parameters()[0]
    if parameter.neutral is None or not np.isfinite(parameter.neutral):
        return None
    try:
        changed = loop.with_effect(replace(effect, **{parameter.name: parameter.neutral + size}))
    except EffectDoesNotApply:
        return None
    e = changed.equations(keep=True)
    if e.delay is not None or e.play is not None or e.readout is not None:
        return None
    return _evaluate_at_points(e, loop.point) - _evaluate_at_points(loop.equations(), loop.point)


def _evaluate_at_points(e: Equations, at: Any, values: Array | None = None) -> Array:
    rows = [
        np.concatenate(e.evaluate(x, u, t, values)) for t, (x, u) in enumerate(_draw_points(at))
    ]
    return np.concatenate(rows)


def _draw_points(at: Any) -> list[tuple[Array, float]]:
    """Return random states and inputs around rest."""
    rng = np.random.default_rng(3)
    rest = np.array([*at.states, at.input])
    scale = np.where(rest == 0, 1.0, 0.3 * np.abs(rest))
    points = rest + scale * rng.uniform(-1, 1, (POINTS, rest.size))
    return [(z[:-1], float(z[-1])) for z in points]


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
    if type(first) is type(second):
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
        if factor is None or not _are_equal(one, change(factor * step)):
            return False
    return True
