"""Equations with effects as what python-control knows: a system, or a transfer function."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import casadi
import control as ct

from .._base.errors import EffectDoesNotApply
from ..physics.equations import Equations
from ..physics.integration import put_entry
from ..physics.linearization import OperatingPoint, linearize, operating_point
from .base import AbstractEffect
from .composition import compose_effects
from .symbolic import substitute_symbol

# A standard deviation this large is wide against every kink.
FAR = 1e12


def as_system(e: Equations, at: OperatingPoint, units: Mapping[str, str]) -> Any:
    """Return equations as a python-control system that can be traced again.

    Parameters
    ----------
    e : Equations
        Equations with effects.
    at : OperatingPoint
        The operating point, with the plant's states.
    units : mapping of str to str
        Units of the signals, which the system keeps.

    Returns
    -------
    control.NonlinearIOSystem
        With the parameters of the equations.

    Raises
    ------
    CtrlidError
        As `make_ordinary`.
    """
    e = make_ordinary(e, at)

    def values(params: Mapping[str, Any]) -> list[float]:
        return [float(params[name]) for name in e.parameters]

    def update(t: float, x: Any, u: Any, params: Mapping[str, Any]) -> Any:
        return e.evaluate(x, u, t, values(params))[0]

    def output(t: float, x: Any, u: Any, params: Mapping[str, Any]) -> Any:
        return e.evaluate(x, u, t, values(params))[1]

    # Python-control forbids dots in names.
    names = [name.replace(".", "_") for name in e.states]
    system = ct.nlsys(update, output, inputs=list(e.inputs), outputs=list(e.outputs), states=names,
                      dt=e.dt, name=e.name, params=dict(e.parameters))  # fmt: skip
    # Whoever traces the system again takes its equations from here.
    system.equations = e
    system.units = units
    return system


def linearize_with_effects(
    e: Equations, effects: Mapping[str, AbstractEffect], at: OperatingPoint, dt: float,
    states: bool = False,
) -> Any:  # fmt: skip
    """Return the linear model of a plant with effects, at the equilibrium with its output.

    Parameters
    ----------
    e : Equations
        The plant without effects, in absolute physical units.
    effects : mapping of str to effect
        The effects by name.
    at : OperatingPoint
        The operating point, with the plant's states; its output is kept.
    dt : float
        Sampling period [s].
    states : bool, optional
        Whether to keep the states, as in `linearize`.

    Returns
    -------
    control.TransferFunction or control.StateSpace
        From deviations of the input to deviations of the output.

    Raises
    ------
    CtrlidError
        If there is no equilibrium at this output.
    """
    changed = compose_effects(e, effects, at, dt)
    changed = substitute_symbol(changed, changed.t, casadi.SX(0.0))
    resting = make_ordinary(changed, at)
    guess = OperatingPoint((*at.states, *resting.rest), at.input, at.output)
    point = operating_point(resting, output=at.output, guess=guess)
    # Half of what is beyond a limit would run over at any point if the state were that uncertain.
    limited = {name for effect in effects.values() for name in effect.limited_states}
    spread = [0.0 if name in limited else FAR for name in changed.states]
    return linearize(make_ordinary(with_spread(changed, spread), at), point, states=states)


def make_ordinary(e: Equations, at: OperatingPoint) -> Equations:
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
        If there is a backlash or a limited rate, whose memory is no state of a continuous
        system, or a delay ahead of a plant in discrete time.
    """
    if e.memory is not None:
        raise EffectDoesNotApply(
            "InputBacklash or InputRateLimit has a memory that is no state of a continuous system; "
            "take it out first, as with loop.without_effect('InputBacklash')"
        )
    if e.delay is not None:
        e = _apply_pade(e, at)
    output = e.output
    if e.readout is not None:
        output = casadi.substitute(e.readout, e.reading, output)
    e = dataclasses.replace(e, output=output, reading=None, readout=None, lags=())
    return with_spread(e, 0.0)


def with_spread(e: Equations, size: float | Sequence[float]) -> Equations:
    """Return equations with a number for how uncertain every state is.

    Parameters
    ----------
    e : Equations
        Equations with effects.
    size : float or sequence of float
        Standard deviation of every state, or of each.

    Returns
    -------
    Equations
        Without symbols for the spread.
    """
    if e.spread is None:
        return e
    known = casadi.DM.ones(*e.spread.shape) * casadi.DM(size)
    return dataclasses.replace(substitute_symbol(e, e.spread, known), spread=None)


def _apply_pade(e: Equations, at: OperatingPoint) -> Equations:
    if e.dt:
        raise EffectDoesNotApply(
            f"{e.name} is in discrete time (dt = {e.dt:g} s): give the delay as poles at zero"
        )
    late, slope = casadi.SX.sym("late"), casadi.SX.sym("slope")
    k = e.late_input
    rates = casadi.vertcat(slope, 12 * (e.u[k] - late) - 6 * slope) / e.delay
    e_late = substitute_symbol(e, e.u, put_entry(e.u, k, e.u[k] - slope))
    spread = None if e.spread is None else casadi.vertcat(e.spread, casadi.SX.sym("s", 2))
    return dataclasses.replace(
        e_late,
        states=(*e.states, "delay.late", "delay.slope"),
        x=casadi.vertcat(e.x, late, slope),
        rhs=casadi.vertcat(e_late.rhs, rates),
        spread=spread,
        delay=None,
        rest=(*e.rest, at.inputs[k], 0.0),
    )
