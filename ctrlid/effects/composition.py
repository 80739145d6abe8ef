"""Effects put into the equations of a plant, in the order in which signals pass them."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import casadi
import numpy as np

from ..physics.equations import Equations
from ..physics.linearization import OperatingPoint
from .base import AbstractEffect
from .kinds import ForceEffect, InputEffect, LawEffect, MemoryEffect, OutputEffect, ReadingEffect

# These builds call a hook that sees symbols only, so that no formula depends on a value.
BUILDS = {kind.build for kind in (LawEffect, ForceEffect, InputEffect, OutputEffect, ReadingEffect)}
# The formulas of so many combinations of effects are kept, which bounds memory.
BUILT = 256


def label_effects(effects: tuple[AbstractEffect, ...]) -> dict[str, AbstractEffect]:
    """Return effects by name: that of the class, numbered from the second of a class on.

    Parameters
    ----------
    effects : tuple of effects
        The effects.

    Returns
    -------
    dict of str to effect
        In the given order.
    """
    found: dict[str, AbstractEffect] = {}
    for effect in effects:
        name = type(effect).__name__
        count = sum(type(e).__name__ == name for e in found.values())
        found[f"{name}{count + 1}" if count else name] = effect
    return found


def order_effects(effects: Mapping[str, AbstractEffect]) -> tuple[tuple[str, AbstractEffect], ...]:
    """Return effects in the order in which they are put into equations, from the plant outwards.

    Of those at the same place the one given last is furthest from the plant. What bends or limits
    the input and is given after a backlash (or a largest speed) acts ahead of it, as the overlap of
    a valve does that a linkage with play comes behind; a lag does not, for a backlash passes once
    per sample.

    Parameters
    ----------
    effects : mapping of str to effect
        The effects by name.

    Returns
    -------
    tuple of (str, effect)
        The same, nearest to the plant first.
    """
    found: list[tuple[int, str, AbstractEffect]] = []
    stage_of_curves = InputEffect.stage
    for label, effect in effects.items():
        if isinstance(effect, MemoryEffect):
            stage_of_curves = effect.stage
        curve = isinstance(effect, InputEffect) and not effect.states
        ahead = curve and effect.stage == InputEffect.stage
        found.append((stage_of_curves if ahead else effect.stage, label, effect))
    return tuple((label, effect) for _, label, effect in sorted(found, key=lambda f: f[0]))


def compose_effects(
    e: Equations, effects: Mapping[str, AbstractEffect], at: OperatingPoint, dt: float
) -> Equations:
    """Return equations with effects in them, from the plant's law outwards.

    Parameters
    ----------
    e : Equations
        The plant in absolute physical units.
    effects : mapping of str to effect
        The effects by name, in the order of `order_effects`.
    at : OperatingPoint
        The point that deviations are counted from, with the plant's states.
    dt : float
        Sampling period [s].

    Returns
    -------
    Equations
        The equations; lags rest where their targets do.
    """
    ordered = order_effects(effects)
    if not ordered:
        return e
    values = dict(e.parameters)
    for label, effect in ordered:
        values |= {f"{label}.{name}": value for name, value in effect.values().items()}
    built = _build_formulas(Composition(e, ordered, at, dt))
    e = built.with_values(values, built.rest)
    return e.with_values(values, _find_rest(e, at)) if e.lags else e


@dataclass(frozen=True)
class Composition:
    """Effects to be put into equations; equal ones lead to the same formulas.

    Parameters
    ----------
    equations : Equations
        The plant.
    effects : tuple of (str, effect)
        The effects and their names, in the order in which they are applied.
    at : OperatingPoint
        The point that deviations are counted from.
    dt : float
        Sampling period [s].
    structure : tuple
        What is compared in place of equations and effects.
    """

    equations: Equations = field(compare=False)
    effects: tuple[tuple[str, AbstractEffect], ...] = field(compare=False)
    at: OperatingPoint
    dt: float
    structure: tuple[Any, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        e = self.equations
        bare = all(_is_made_of_symbols(type(effect)) for _, effect in self.effects)
        parts = [_describe(label, effect, bare) for label, effect in self.effects]
        looked_at = () if bare else tuple(e.parameters.values())
        object.__setattr__(self, "structure", (e.formulas, e.rest, looked_at, *parts))


def _is_made_of_symbols(kind: type[AbstractEffect]) -> bool:
    """Whether neither the formulas of an effect nor its states at rest depend on any value.

    What builds the equations itself may look at the numbers in them.
    """
    return (
        kind.build in BUILDS
        and kind.apply is AbstractEffect.apply
        and kind.rest is AbstractEffect.rest
    )


def _describe(label: str, effect: AbstractEffect, bare: bool) -> tuple[Any, ...]:
    """Return what the formulas of an effect depend on; its values only if they are not `bare`."""
    left_out = effect.values() if bare else ()
    given = [getattr(effect, f.name) for f in fields(effect) if f.name not in left_out]
    # What is no number or name need have no hash; the effect keeps it, and so its identity.
    simple = str | int | float | None
    return label, type(effect), *(repr(v) if isinstance(v, simple) else id(v) for v in given)


@functools.lru_cache(maxsize=BUILT)
def _build_formulas(what: Composition) -> Equations:
    """Return the equations with the effects in them, built once: a search asks for them often."""
    e = what.equations
    for label, effect in what.effects:
        e = effect.apply(e, what.at, what.dt, label)
    return e


def _find_rest(e: Equations, at: OperatingPoint) -> tuple[float, ...]:
    own = len(e.states) - len(e.rest)
    rest = list(e.rest)
    targets = e.derive("targets", lambda: casadi.Function(
        "targets", [e.t, e.x, e.u, e.p, e.spread], [lag.target for lag in e.lags]
    ))  # fmt: skip
    # Of lags in series each needs the value at rest of the one before.
    for _ in e.lags:
        point = [*at.states, *rest]
        values = targets.call([0.0, point, list(at.inputs), e.values, np.zeros(len(point))])
        for lag, value in zip(e.lags, values, strict=True):
            rest[lag.state - own] = float(value)
    return tuple(rest)
