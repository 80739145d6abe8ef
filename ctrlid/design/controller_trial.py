"""A controller of any kind: what it promises on a linear model, and what it does on the physics."""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import control as ct
import numpy as np

from .._base.arguments import is_number
from .._base.arrays import Array, ComplexArray, freeze_arrays
from .._base.errors import CtrlidError, ModelCannotRun
from .._base.text import Printed, write_count, write_list, write_quantity
from ..effects import (
    AsymmetricCoulombFriction,
    CoulombFriction,
    InputBacklash,
    InputDeadZone,
    Quantization,
    StribeckFriction,
)
from ..loop.controllers import PID
from ..loop.loop import Loop, exchange_limits, find_input_limits
from ..loop.simulation import SimulationStopped, simulate
from ..physics.trace import timebase
from .input_margins import LoopPerformance, measure_performance
from .settling import SETTLED, TAIL, explain_unsettled, settles_otherwise
from .step_height import StepHeight, choose_height, try_heights

# A response so many times the promised one is no longer under control.
LOST = 20
# The loss of more than this share of what was promised is reported.
CLOSE = 0.25
# A final value below this share of the largest deviation is none: the output returns.
RETURNS = 0.02
# A reference is followed if the output ends at no less than this share of it.
HELD = 0.5
# A deviation below this share of a step is rounding.
NOTHING = 1e-9
# A step response lasts so many time constants of the slowest promised pole.
LASTING = 8.0
LONGEST = 20_000
# These have a kink at rest, of which the smallest signals see most.
KINKS = (
    AsymmetricCoulombFriction, CoulombFriction, InputBacklash, InputDeadZone, Quantization,
    StribeckFriction,
)  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class StepMotion(Printed):
    """What a step of one reference does to all signals of a loop.

    Parameters
    ----------
    y, u : ndarray, shape (outputs, k) and (inputs, k)
        Deviations from rest [their units]; they end early where the simulation broke off.
    final_value : float
        Of the output that follows, per unit of the reference; NaN where it is not known.
    overshoot : float
        Of that output, in percent of its final value.
    settling_time : float
        Until that output stays within 2 % of its final value [s]; infinite if it never does.
    failure : str or None
        Why the simulation broke off; None if it did not.
    """

    y: Array
    u: Array
    final_value: float
    overshoot: float
    settling_time: float
    failure: str | None = None

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    def peak_outputs(self) -> tuple[float, ...]:
        """Largest deviation of each output [its unit]."""
        return tuple(np.max(np.abs(self.y), axis=1, initial=0.0).tolist())

    @property
    def peak_inputs(self) -> tuple[float, ...]:
        """Largest deviation of each input [its unit]."""
        return tuple(np.max(np.abs(self.u), axis=1, initial=0.0).tolist())

    def __str__(self) -> str:
        if self.failure is not None:
            return f"broke off: {self.failure}"
        return (f"final value {_write(self.final_value, '.4g')}, overshoot "
                f"{_write(self.overshoot, '.3g')} %, settled after "
                f"{_write(self.settling_time, '.4g')} s")  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class ReferenceStep(Printed):
    """A step of one reference, on the model and on the physics.

    Parameters
    ----------
    reference : str
        Its name.
    height : float
        Height of the step [unit of the reference].
    output : str
        The output that follows it.
    time : ndarray
        Time after the step [s].
    promised, achieved : StepMotion
        On the model, and on the nonlinear physics within its input limits.
    reason : str
        Why the step has this height where none was given and the output rests at zero, or empty.
    """

    reference: str
    height: float
    output: str
    time: Array
    promised: StepMotion
    achieved: StepMotion
    reason: str = ""

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __str__(self) -> str:
        return (f"step of {self.reference} by {self.height:.4g}, followed by {self.output}\n"
                f"  promised: {self.promised}\n  achieved: {self.achieved}")  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class ControllerTrial(Printed):
    """A controller that a function designed on a model, with the promise and what came of it.

    Parameters
    ----------
    controller : control.TransferFunction, control.StateSpace, control.NonlinearIOSystem or PID
        What the function returned.
    promised, achieved : LoopPerformance
        On the model, and on the physics of the loop near its operating point.
    steps : tuple of ReferenceStep
        One for each reference that was stepped.
    loop : Loop
        The physics with the new controller.
    model : control.TransferFunction or control.StateSpace
        The linear model that the function was given.
    failure : str or None
        Why the physics was not kept stable; None if it was.
    """

    controller: Any
    promised: LoopPerformance
    achieved: LoopPerformance
    steps: tuple[ReferenceStep, ...]
    loop: Loop
    model: Any
    failure: str | None = None

    @property
    def stable(self) -> bool:
        """Whether the controller keeps the physics stable."""
        return self.achieved.stable

    @property
    def verdict(self) -> str:
        """The outcome in words."""
        if self.promised.growth_rate > 0:
            text = (
                "The design DOES NOT STABILIZE ITS OWN MODEL: small deviations grow at "
                f"{self.promised.growth_rate:.3g} 1/s. Check the signs and the weights."
            )
            if self.achieved.growth_rate > 0:
                return f"{text} Nor does it stabilize the physics."
            return f"{text} Near its operating point the physics is stable."
        if self.achieved.growth_rate > 0:
            return (
                "The controller DOES NOT STABILIZE THE PHYSICS: the model is too different from "
                f"it. {self.failure}"
            )
        text = self._compare_margins()
        if self.achieved.growth_rate == 0:
            text += (
                " A pole at zero remains: a state that the controller does not hold, such as a "
                "position that it does not read, stays where a push has taken it."
            )
        if self.failure is not None:
            return f"{text} This is for small signals: WITH THE STEP THE LOOP DIVERGES. " + (
                self.failure
            )
        restless = [s for s in self.steps if np.isfinite(s.promised.settling_time)
                    and not np.isfinite(s.achieved.settling_time)]  # fmt: skip
        if restless:
            names = write_list([f"{s.reference} by {self._write_height(s)}" for s in restless])
            reasons = [explain_unsettled(self.loop, s.output, s.height) for s in restless]
            return (f"{text} WITH THE STEP OF {names} THE RESPONSE DOES NOT SETTLE. "
                    + " ".join(dict.fromkeys(reasons)))  # fmt: skip
        return f"{text} {self._compare_steps()}".rstrip()

    def _write_height(self, step: ReferenceStep) -> str:
        """Return the height of a step with the unit of what it asks for, where that is known."""
        followed = _find_followed(self.loop, self.model, step.reference)
        return write_quantity(step.height, self.loop.known_units.get(followed or "", ""))

    def _compare_margins(self) -> str:
        """Return what became of the smallest promised phase margin."""
        inputs = self.loop.signals["u"]
        pairs = [(p.phase_margin - a.phase_margin, p, a, name) for name, p, a in
                 zip(inputs, self.promised.margins, self.achieved.margins, strict=True)
                 if np.isfinite([p.phase_margin, a.phase_margin]).all()]  # fmt: skip
        if not pairs:
            return "The controller keeps the physics stable."
        loss, p, a, name = max(pairs, key=lambda pair: pair[0] / pair[1].phase_margin)
        text = (
            f"At {name} the model promises a phase margin of {p.phase_margin:.1f} deg; achieved on "
            f"the physics are {a.phase_margin:.1f} deg"
        )
        if loss > CLOSE * p.phase_margin:
            return f"{text}: {loss:.1f} DEGREES OF PHASE MARGIN ARE LOST."
        return f"{text}, so the controller keeps the physics stable."

    def _compare_steps(self) -> str:
        """Return how far the responses are from the promised ones."""
        far = []
        for step in self.steps:
            k = self.loop.signals["y"].index(step.output)
            promised, achieved = step.promised.y[k], step.achieved.y[k]
            size = np.max(np.abs(promised), initial=0.0)
            if len(promised) == len(achieved) and size:
                far.append((float(np.max(np.abs(achieved - promised)) / size), step.reference))
        if not far:
            return ""
        share, name = max(far)
        if share > CLOSE:
            return (f"THE STEP OF {name} DIFFERS from what is promised by up to "
                    f"{100 * share:.0f} % of its size.")  # fmt: skip
        kept = f"The steps are as promised within {max(math.ceil(100 * share), 1)} % of their size"
        tails = [
            f"{s.reference} settles after {s.achieved.settling_time:.4g} s where "
            f"{s.promised.settling_time:.4g} s is promised"
            for s in self.steps
            if settles_otherwise(s.promised.settling_time, s.achieved.settling_time, self.loop.dt)
        ]
        return f"{kept}, but {write_list(tails)}: {TAIL}." if tails else f"{kept}."

    @property
    def rows(self) -> tuple[tuple[str, str, str], ...]:
        """Return quantity, promised and achieved value as printed, row by row."""
        sides = (self.promised, self.achieved)

        def row(label: str, values: Iterable[str]) -> tuple[str, str, str]:
            promised, achieved = values
            return label, promised, achieved

        made = [
            row("slowest pole [rad/s]", (_write_slowest(side.poles) for side in sides)),
            row("smallest damping ratio", (_write(side.damping, ".3f") for side in sides)),
        ]
        for k, name in enumerate(self.loop.signals["u"]):
            for label, field, form in (
                ("phase margin at {} [deg]", "phase_margin", ".2f"),
                ("gain margin at {} [factor]", "gain_margin", ".3f"),
                ("gain reduction margin at {}", "gain_reduction_margin", ".3f"),
                ("delay margin at {} [s]", "delay_margin", ".3g"),
            ):
                values = (_write(getattr(side.margins[k], field), form) for side in sides)
                made.append(row(label.format(name), values))
        if np.isfinite(self.promised.disk_margin):
            made.append(row("disk margin [1]", (_write(s.disk_margin, ".3f") for s in sides)))
        for step in self.steps:
            both = (step.promised, step.achieved)
            for label, field, form in (
                (f"final {step.output} per unit", "final_value", ".3f"),
                (f"overshoot of {step.output} [%]", "overshoot", ".2f"),
                ("settling time [s]", "settling_time", ".4g"),
            ):
                values = (_write(getattr(side, field), form) for side in both)
                made.append(row(f"step of {step.reference}: {label}", values))
            made += [
                row(f"step of {step.reference}: largest change of {signal}", texts)
                for signal, texts in self._list_peaks(step)
            ]
        return tuple(made)

    def _list_peaks(self, step: ReferenceStep) -> list[tuple[str, list[str]]]:
        """Return the largest deviations of inputs, and of outputs that do not follow the step."""
        signals, units = self.loop.signals, self.loop.known_units
        peaks = [
            ("peak_outputs", k, name) for k, name in enumerate(signals["y"]) if name != step.output
        ]
        peaks += [("peak_inputs", k, name) for k, name in enumerate(signals["u"])]
        return [
            (name, [write_quantity(getattr(side, field)[k],
                                   units.get(name, ""), digits=3) if side.u.size else "-"
                    for side in (step.promised, step.achieved)])
            for field, k, name in peaks
        ]  # fmt: skip

    def __str__(self) -> str:
        rows = self.rows
        width = max(len(label) for label, _, _ in rows) + 2
        table = [
            f"  {a:<{width}}{b:>18}{c:>18}" for a, b, c in (("", "promised", "achieved"), *rows)
        ]
        kind = "analog" if self.loop.analog else f"digital, {self.loop.dt:g} s"
        wiring = self.loop.wiring
        lines = () if wiring is None else tuple(f"    {line}" for line in wiring.lines)
        head = f"controller: {type(self.controller).__name__}, {kind}"
        heights = [f"{s.reference} by {self._write_height(s)}" for s in self.steps]
        tried = (
            f"  Achieved steps ({', '.join(heights)}) are those of the nonlinear physics. "
            f"{advise_step(self.loop)}" if heights else
            "  The controller has no reference to step."
        )  # fmt: skip
        reasons = [f"  {text}" for text in dict.fromkeys(s.reason for s in self.steps) if text]
        lacking = [
            "  The disk margin of several inputs is not known: python-control needs slycot for it."
        ] if len(self.promised.margins) > 1 and np.isnan(self.promised.disk_margin) and (
            self.promised.growth_rate <= 0) else []  # fmt: skip
        return "\n".join([head, *lines, *table, *lacking, tried, *reasons, "  " + self.verdict])


def advise_step(loop: Loop) -> str:
    """Return which height of a step brings the physics of a loop closer to the promised values.

    What is smooth is linear for small signals. Of a kink at rest, such as dry friction, the
    smallest signals see most.
    """
    kinks = [
        name for name, e in loop.labelled.items() if not e.neutral and isinstance(e, KINKS)
    ]  # fmt: skip
    if kinks:
        return (
            f"{write_list(kinks)} {'counts' if len(kinks) == 1 else 'count'} for more the smaller "
            "the step is, and the promise leaves that out: with a larger step= they are closer to "
            "the promised values, as far as the input and the range of the plant allow."
        )
    return (
        "With a smaller step= they are closer to the promised values, unless the equations of the "
        "plant have a kink at rest, such as dry friction."
    )


def _write(value: float, form: str) -> str:
    return "-" if math.isnan(value) else f"{value:{form}}"


def _write_slowest(poles: ComplexArray) -> str:
    """Return the pole with the largest real part."""
    if not len(poles):
        return "-"
    pole = poles[int(np.argmax(poles.real))]
    if abs(pole.imag) <= 1e-9 * abs(pole):
        return f"{pole.real:.4g}"
    return f"{pole.real:.4g} ± {abs(pole.imag):.4g}j"


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
    sides = [(side, _stay(side, length)) for side in (promise, trial) if heights]

    def make(name: str, chosen: StepHeight) -> ReferenceStep:
        unit = loop.known_units.get(_find_followed(trial, model, name) or "", "")

        def run(value: float) -> _Run:
            motions = (_step(side, name, value, length, rest) for side, rest in sides)
            return _Run(_make_step(trial, model, name, value, dt, length, *motions))

        # A promise that breaks off is no matter of the height.
        stable = achieved.growth_rate <= 0 and promised.growth_rate <= 0
        height, made = try_heights(chosen, unit, stable, run)
        return replace(made.step, reason=height.reason)

    steps = tuple(make(name, chosen) for name, chosen in heights.items())
    if not isinstance(step, Mapping):
        # An angle that no controller can hold is a reference by name only.
        steps = tuple(s for s in steps if not _returns(trial, s)) or steps[:1]
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


def _list_references(loop: Loop) -> tuple[str, ...]:
    """Return the names of the references of a loop."""
    wiring = loop.wiring
    return loop.signals["y"] if wiring is None else wiring.open


def _find_followed(loop: Loop, model: Any, name: str) -> str | None:
    """Return the output that a reference is for, where its name tells."""
    outputs = loop.signals["y"]
    match = re.fullmatch(r"xd\[(\d+)\]", name)
    if match is not None:
        states = model.state_labels if isinstance(model, ct.StateSpace) else []
        known = states[int(match[1])] if int(match[1]) < len(states) else ""
        return known if known in outputs else None
    if name in outputs:
        return name
    # One that is called r_z or z_ref is for z, unless it is a state such as z_dot.
    affixed = [y for y in outputs if re.fullmatch(rf".*[\W_]{re.escape(y)}|{re.escape(y)}[\W_].*",
               name)]  # fmt: skip
    return affixed[0] if len(affixed) == 1 and name not in loop.equations().states else None


def _choose_steps(
    loop: Loop, model: Any, step: Any, choose: Callable[[str | None, str], StepHeight]
) -> dict[str, StepHeight]:
    """Return the height of the step of each reference that is tried, and why it is that."""
    names = _list_references(loop)
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
              if value is None or _find_followed(loop, model, name) is not None]  # fmt: skip
    if step is not None:
        return dict.fromkeys(chosen, StepHeight(_check_height(step)))
    return {name: choose(_find_followed(loop, model, name), name) for name in chosen}


def _find_peaks(promise: Loop, n: int, name: str) -> Array:
    """Return how far each input moves on the model for a step of one reference by 1.

    Infinitely far where the design does not stabilize its own model.
    """
    motion = _step(promise, name, 1.0, n, _stay(promise, n))
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
class _Motion:
    """Deviations of all signals from rest, and why they end early."""

    y: Array
    u: Array
    failure: str | None = None


def _follow(loop: Loop, n: int, moved: str = "", height: float = 0.0) -> Any:
    """Return the record of a loop whose references rest, but for one that steps."""
    names, law = _list_references(loop), loop.law()
    assert law is not None
    rest = np.array(loop.point.outputs if law.references is None else law.references)
    references = np.repeat(rest[:, None], n, axis=1)
    if moved:
        references[names.index(moved)] += height
    return simulate(loop, references[0] if loop.wiring is None
                    else dict(zip(names, references, strict=True)))  # fmt: skip


def _stay(loop: Loop, n: int) -> _Motion:
    """Return what all signals do without a step."""
    try:
        record = _follow(loop, n)
    except ModelCannotRun as reason:
        p, m = len(loop.signals["y"]), len(loop.signals["u"])
        return _Motion(np.empty((p, 0)), np.empty((m, 0)), write_sentence(reason))
    return _Motion(np.atleast_2d(record.y), np.atleast_2d(record.u))


def _step(loop: Loop, name: str, height: float, n: int, rest: _Motion) -> _Motion:
    """Return what a step of one reference does, less what happens without it."""
    if rest.failure is not None:
        return rest
    try:
        record = _follow(loop, n, name, height)
    except SimulationStopped as reason:
        got = np.atleast_2d(reason.y)
        return _Motion(got - rest.y[:, : got.shape[1]], np.empty((len(rest.u), 0)),
                       write_sentence(reason))  # fmt: skip
    y, u = np.atleast_2d(record.y) - rest.y, np.atleast_2d(record.u) - rest.u
    for move in (y, u):
        move[np.max(np.abs(move), axis=1) < NOTHING * abs(height)] = 0.0
    return _Motion(y, u)


def write_sentence(reason: CtrlidError) -> str:
    """Return the words of an error as a sentence."""
    text = str(reason)
    return text[0].upper() + text[1:] + "."


@dataclass(frozen=True, eq=False)
class _Run:
    """A step of some height, and why the physics did not follow it."""

    step: ReferenceStep

    @property
    def failure(self) -> str | None:
        return self.step.achieved.failure


def _make_step(
    loop: Loop, model: Any, name: str, height: float, dt: float, n: int,
    promised: _Motion, achieved: _Motion,
) -> ReferenceStep:  # fmt: skip
    outputs = loop.signals["y"]
    output = _find_followed(loop, model, name) or outputs[_find_nearest(promised.y, height)]
    k = outputs.index(output)
    time: Array = np.arange(n, dtype=float) * dt
    reach = LOST * np.max(np.abs(promised.y[k]), initial=0.0)
    far = np.abs(achieved.y[k]) > reach
    if promised.failure is None and achieved.failure is None and far.any():
        at = int(np.argmax(far))
        text = (f"After {at * dt:.4g} s the step of {name} has moved {output} by "
                f"{achieved.y[k, at]:.4g}")  # fmt: skip
        limited = _find_limited(loop, achieved.u[:, : at + 1])
        text += f", with {write_list(limited)} at its limit" if limited else ""
        achieved = _Motion(achieved.y[:, : at + 1], achieved.u[:, : at + 1], f"{text}.")
    return ReferenceStep(name, height, output, time, _measure_motion(promised, k, height, time),
                         _measure_motion(achieved, k, height, time))  # fmt: skip


def _find_nearest(y: Array, height: float) -> int:
    """Return the output that ends nearest to the step, or else moves most."""
    if not y.shape[1]:
        return 0
    ends = np.mean(y[:, -max(y.shape[1] // 20, 1) :], axis=1) / height
    return int(np.argmin(np.abs(ends - 1)))


def _find_limited(loop: Loop, u: Array) -> list[str]:
    """Return the inputs that were at a limit."""
    lower, upper = (np.broadcast_to(v, len(u)) for v in loop.input_limits)
    absolute = u + np.array(loop.point.inputs)[:, None]
    hit = (absolute <= lower[:, None]) | (absolute >= upper[:, None])
    return [name for name, any_ in zip(loop.signals["u"], hit.any(axis=1), strict=True) if any_]


def _returns(loop: Loop, step: ReferenceStep) -> bool:
    """Return whether an output goes back to rest though a reference that could be held asks."""
    wiring = loop.wiring
    held = wiring is not None and wiring.held[wiring.open.index(step.reference)] is not None
    return held and abs(step.promised.final_value) < HELD


def _measure_motion(motion: _Motion, k: int, height: float, time: Array) -> StepMotion:
    final = overshoot = settling = math.nan
    if motion.failure is None and motion.y.size:
        response = motion.y[k] / height
        final = float(np.mean(response[-max(len(response) // 20, 1) :]))
        if abs(final) > RETURNS * np.max(np.abs(response)):
            overshoot = max(0.0, 100 * (float(np.max(response / final)) - 1))
            outside = np.flatnonzero(np.abs(response / final - 1) > SETTLED)
            last = int(outside[-1]) + 1 if outside.size else 0
            settling = float(time[last]) if last < len(time) else math.inf
    return StepMotion(motion.y, motion.u, final, overshoot, settling, motion.failure)
