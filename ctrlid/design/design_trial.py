"""A design tried: the controller that it makes of a model, on the model and on the physics."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import control as ct
import numpy as np

from .._base.arguments import is_number
from .._base.arrays import Array, ComplexArray
from .._base.errors import CtrlidError
from .._base.text import write_count, write_list
from ..loop.controllers import PID
from ..loop.loop import Loop, exchange_limits, find_input_limits
from ..physics.trace import timebase
from .controller_trial import ControllerTrial
from .input_margins import measure_performance
from .reference_steps import (
    ReferenceStep,
    find_followed,
    follow_step,
    list_references,
    make_step,
    returns_to_rest,
    stay,
)
from .step_height import StepHeight, choose_height, try_heights

# A step response lasts so many time constants of the slowest promised pole.
LASTING = 8.0
LONGEST = 20_000


def try_design(
    model: Any, loop: Loop, design: Callable[[Any], Any], step: Any = None
) -> ControllerTrial:
    """Design a controller on a model and try it on the physics of a loop.

    Parameters
    ----------
    model : control.TransferFunction or control.StateSpace
        The linear model.
    loop : Loop
        The physics and its operating point.
    design : callable
        From the model to a controller.
    step : float or mapping of str to float, optional
        Height of the steps, or of each reference.

    Returns
    -------
    ControllerTrial
        Promise and achievement.

    Raises
    ------
    CtrlidError
        If model, controller and loop do not fit together.
    """
    model = _name_signals(model, loop)
    controller = _call_design(design, model)
    dt = _find_period(controller, loop, timebase(model))
    at = loop.at
    promise = Loop(model, controller, dt=dt, at=at, units=_pick_units(loop))
    trial = replace(loop, controller=controller, dt=dt)
    if not isinstance(controller, PID):
        # What limits the input is the actuator, which stays when the PID that knew it goes.
        trial = exchange_limits(trial, *find_input_limits(loop))
    promised, achieved = (measure_performance(side) for side in (promise, trial))
    length = _choose_length(promised.poles, dt)
    # The limits that the former PID kept tell what is small where the new controller has none.
    sized = trial if isinstance(controller, PID) else loop

    def choose(output: str | None, name: str) -> StepHeight:
        return choose_height(sized, output, partial(_find_peaks, promise, length, name))

    heights = _choose_steps(trial, model, step, choose)
    sides = [(side, stay(side, length)) for side in (promise, trial) if heights]

    def make(name: str, chosen: StepHeight) -> ReferenceStep:
        unit = loop.known_units.get(find_followed(trial, model, name) or "", "")

        def run(value: float) -> _Run:
            motions = (follow_step(side, name, value, length, rest) for side, rest in sides)
            return _Run(make_step(trial, model, name, value, dt, length, *motions))

        # A promise that breaks off is no matter of the height.
        stable = achieved.growth_rate <= 0 and promised.growth_rate <= 0
        height, made = try_heights(chosen, unit, stable, run)
        return replace(made.step, reason=height.reason)

    steps = tuple(make(name, chosen) for name, chosen in heights.items())
    if not isinstance(step, Mapping):
        # An angle that no controller can hold is a reference by name only.
        steps = tuple(s for s in steps if not returns_to_rest(trial, s)) or steps[:1]
    rate = achieved.growth_rate
    reasons = [s.achieved.failure for s in steps if s.achieved.failure is not None]
    if rate > 0:
        reasons.insert(0, f"Small deviations grow at {rate:.3g} 1/s.")
    failure = " ".join(dict.fromkeys(reasons[:2])) if reasons else None
    achieved = replace(achieved, stable=not reasons)
    return ControllerTrial(controller, promised, achieved, steps, trial, model, failure)


def _name_signals(model: Any, loop: Loop) -> Any:
    """Return a model with the signals of the loop, refused where it has others."""
    for key, what, given in (("u", "input", model.input_labels), ("y", "output",
                                                                 model.output_labels)):  # fmt: skip
        names = list(loop.signals[key])
        if len(given) != len(names):
            raise CtrlidError(
                f"redesign: the model has {write_count(len(given), what)} ({', '.join(given)}), "
                f"the loop {len(names)} ({', '.join(names)}); give a model of the same signals"
            )
        if list(given) != names and set(given) == set(names):
            raise CtrlidError(
                f"redesign: the {what}s of the model are ({', '.join(given)}), those of the loop "
                f"({', '.join(names)}); put them into the order of the loop"
            )
    signals = {"inputs": list(loop.signals["u"]), "outputs": list(loop.signals["y"])}
    if isinstance(model, ct.StateSpace):
        return ct.ss(model.A, model.B, model.C, model.D, timebase(model) or 0,
                     states=model.state_labels, name="model", **signals)  # fmt: skip
    return ct.tf(model.num, model.den, timebase(model) or 0, name="model", **signals)


def _call_design(design: Callable[[Any], Any], model: Any) -> Any:
    """Return the controller that a function designs, refused where it is none."""
    try:
        controller = design(model)
    except Exception as reason:
        if isinstance(reason, CtrlidError):
            raise
        raise CtrlidError(
            f"design raised {type(reason).__name__} on the model with inputs "
            f"{model.input_labels}, outputs {model.output_labels} and {model.nstates or 'no'} "
            f"states: {reason}{_advise_observer(reason, model)}"
        ) from reason
    # create_statefbk_iosystem returns the controller, and the closed loop beside it.
    if isinstance(controller, tuple) and len(controller) == 2:
        controller = controller[0]
    if is_number(controller):
        return ct.tf([float(controller)], [1.0], timebase(model) or 0)
    if isinstance(controller, PID | ct.TransferFunction | ct.NonlinearIOSystem):
        return controller
    given = "nothing" if controller is None else f"a {type(controller).__name__}"
    hint = (
        "; of a gain matrix K make one with ct.ss([], [], [], K) or ct.create_statefbk_iosystem"
        if isinstance(controller, np.ndarray | list | tuple) else ""
    )  # fmt: skip
    raise CtrlidError(
        "design is a function from the model to a controller, a python-control system or a PID; "
        f"it returned {given}{hint}"
    )


def _advise_observer(reason: Exception, model: Any) -> str:
    """Return what a state feedback lacks on a model that does not measure all of its states."""
    if not isinstance(reason, ct.ControlArgument) or not isinstance(model, ct.StateSpace):
        return ""
    if model.noutputs >= model.nstates:
        return ""
    return (
        f". A state feedback needs all {model.nstates} states, and the model has "
        f"{write_count(model.noutputs, 'output')}: add an observer, by "
        "ct.create_estimator_iosystem or as one ct.ss with the gain of ct.lqe (the last example of "
        "help(ctrlid.redesign))"
    )


def _find_period(controller: Any, loop: Loop, dt: float) -> float:
    """Return the sampling period of the loop with a controller [s]."""
    own = None if isinstance(controller, PID) else controller.dt
    own = 0.0 if own is None or own is True else float(own)
    return dt or own or loop.dt


def _pick_units(loop: Loop) -> dict[str, str]:
    names = (*loop.signals["u"], *loop.signals["y"])
    return {name: unit for name, unit in loop.known_units.items() if name in names}


def _choose_steps(
    loop: Loop, model: Any, step: Any, choose: Callable[[str | None, str], StepHeight]
) -> dict[str, StepHeight]:
    """Return the height of the step of each reference that is tried, and why it is that."""
    names = list_references(loop)
    if isinstance(step, Mapping):
        unknown = [name for name in step if name not in names]
        if unknown or not step:
            raise CtrlidError(
                f"step= names {write_list([str(n) for n in unknown]) or 'no reference'}; the "
                f"controller has the references {', '.join(names) or 'none'}"
            )
        return {name: StepHeight(_check_height(value)) for name, value in step.items()}
    wiring = loop.wiring
    held = (None,) * len(names) if wiring is None else wiring.held
    chosen = [name for name, value in zip(names, held, strict=True)
              if value is None or find_followed(loop, model, name) is not None]  # fmt: skip
    if step is not None:
        return dict.fromkeys(chosen, StepHeight(_check_height(step)))
    return {name: choose(find_followed(loop, model, name), name) for name in chosen}


def _find_peaks(promise: Loop, n: int, name: str) -> Array:
    """Return how far each input moves on the model for a step of one reference by 1.

    Infinitely far where the design does not stabilize its own model.
    """
    motion = follow_step(promise, name, 1.0, n, stay(promise, n))
    if motion.failure is not None or not motion.u.size:
        return np.full(len(promise.signals["u"]), np.inf)
    return np.asarray(np.max(np.abs(motion.u), axis=1))


def _check_height(step: Any) -> float:
    if not is_number(step) or not np.isfinite(float(step)) or step == 0:
        raise CtrlidError("step must be the height of the reference step in output units, a "
                          f"finite number other than zero, or a mapping of references; given "
                          f"{step!r}")  # fmt: skip
    return float(step)


def _choose_length(poles: ComplexArray, dt: float) -> int:
    """Return how many samples a step response lasts."""
    rates = -poles.real[np.isfinite(poles.real)]
    rates = rates[rates > 1e-6 * np.max(np.abs(rates), initial=0.0)]
    slow = float(np.min(rates, initial=math.inf))
    return int(np.clip(LASTING / (slow * dt), 50, LONGEST))


@dataclass(frozen=True, eq=False)
class _Run:
    """A step of some height, and why the physics did not follow it."""

    step: ReferenceStep

    @property
    def failure(self) -> str | None:
        """What the physics says, None where it followed."""
        return self.step.achieved.failure
