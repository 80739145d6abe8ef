"""Effects put into the equations of a plant, in the order in which signals pass them."""

import dataclasses
from collections.abc import Mapping

import casadi
import numpy as np

from ..physics.equations import Equations
from ..physics.linearization import OperatingPoint
from .base import AbstractEffect


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


def compose_effects(
    e: Equations, effects: Mapping[str, AbstractEffect], at: OperatingPoint, dt: float
) -> Equations:
    """Return equations with effects in them, from the plant's law outwards.

    Parameters
    ----------
    e : Equations
        The plant in absolute physical units.
    effects : mapping of str to effect
        The effects by name. Of those at the same place the one given last is furthest from the
        plant.
    at : OperatingPoint
        The point that deviations are counted from, with the plant's states.
    dt : float
        Sampling period [s].

    Returns
    -------
    Equations
        The equations; lags rest where their targets do.
    """
    for label, effect in sorted(effects.items(), key=lambda pair: pair[1].stage):
        e = effect.apply(e, at, dt, label)
    return dataclasses.replace(e, rest=_find_rest(e, at)) if e.lags else e


def _find_rest(e: Equations, at: OperatingPoint) -> tuple[float, ...]:
    own = len(e.states) - len(e.rest)
    rest = list(e.rest)
    targets = casadi.Function("targets", [e.t, e.x, e.u, e.p, e.spread],
                              [lag.target for lag in e.lags])  # fmt: skip
    # Of lags in series each needs the value at rest of the one before.
    for _ in e.lags:
        point = [*at.states, *rest]
        values = targets.call([0.0, point, list(at.inputs), e.values, np.zeros(len(point))])
        for lag, value in zip(e.lags, values, strict=True):
            rest[lag.state - own] = float(value)
    return tuple(rest)
