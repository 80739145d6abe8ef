"""Effects in the equations of a plant, and those equations as an ordinary continuous system."""

import dataclasses
from collections.abc import Mapping

import casadi
import numpy as np

from ..errors import CtrlidError
from ..linearization import OperatingPoint
from ..physics import Equations
from .base import AbstractEffect, substituted

FAR = 1e12  # a spread that is large against every kink


def labels(effects: tuple[AbstractEffect, ...]) -> dict[str, AbstractEffect]:
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


def compose(
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
    return dataclasses.replace(e, rest=_at_rest(e, at)) if e.lags else e


def _at_rest(e: Equations, at: OperatingPoint) -> tuple[float, ...]:
    own = len(e.states) - len(e.rest)
    rest = list(e.rest)
    targets = casadi.Function("targets", [e.t, e.x, e.u, e.p, e.spread],
                              [lag.target for lag in e.lags])  # fmt: skip
    for _ in e.lags:  # of lags in a row each waits for the one before
        point = [*at.states, *rest]
        values = targets.call([0.0, point, at.input, e.values, np.zeros(len(point))])
        for lag, value in zip(e.lags, values, strict=True):
            rest[lag.state - own] = float(value)
    return tuple(rest)


def ordinary(e: Equations, at: OperatingPoint) -> Equations:
    r"""Return equations without a delay, a memory, a readout or a spread.

    .. math:: e^{-\theta s} \approx
        \frac{1 - \theta s/2 + (\theta s)^2/12}{1 + \theta s/2 + (\theta s)^2/12}

    A delay becomes its Padé approximation of order two, good below about 2/delay [rad/s], with two
    states. What becomes of the reading becomes part of the output.

    Parameters
    ----------
    e : Equations
        Equations with effects.
    at : OperatingPoint
        The operating point, for the rest of the delay's states.

    Returns
    -------
    Equations
        Equations of states, input and output only.

    Raises
    ------
    CtrlidError
        If there is a backlash, whose memory is no state of a continuous system, or a delay ahead
        of a plant in discrete time.
    """
    if e.play is not None:
        raise CtrlidError(
            "InputBacklash has a memory that is no state of a continuous system; use "
            "loop.without_effect('InputBacklash') first"
        )
    if e.delay is not None:
        e = _pade(e, at)
    output = e.output
    if e.readout is not None:
        output = casadi.substitute(e.readout, e.reading, output)
    e = dataclasses.replace(e, output=output, reading=None, readout=None, lags=())
    return with_spread(e, 0.0)


def with_spread(e: Equations, size: float) -> Equations:
    """Return equations with a number for how uncertain every state is.

    Parameters
    ----------
    e : Equations
        Equations with effects.
    size : float
        Standard deviation of every state.

    Returns
    -------
    Equations
        Without symbols for the spread.
    """
    if e.spread is None:
        return e
    known = casadi.DM.ones(*e.spread.shape) * size
    return dataclasses.replace(substituted(e, e.spread, known), spread=None)


def _pade(e: Equations, at: OperatingPoint) -> Equations:
    if e.dt:
        raise CtrlidError(
            f"{e.name} is in discrete time (dt = {e.dt:g} s): give the delay as poles at zero"
        )
    late, slope = casadi.SX.sym("late"), casadi.SX.sym("slope")
    rates = casadi.vertcat(slope, 12 * (e.u - late) - 6 * slope) / e.delay
    e_late = substituted(e, e.u, e.u - slope)
    spread = None if e.spread is None else casadi.vertcat(e.spread, casadi.SX.sym("s", 2))
    return dataclasses.replace(
        e_late,
        states=(*e.states, "delay.late", "delay.slope"),
        x=casadi.vertcat(e.x, late, slope),
        rhs=casadi.vertcat(e_late.rhs, rates),
        spread=spread,
        delay=None,
        rest=(*e.rest, at.input, 0.0),
    )
