"""Steps of the references of a loop with a controller of any kind: what they move, and how far."""

import math
import re
from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np

from .._base.arrays import Array, freeze_arrays
from .._base.errors import CtrlidError, ModelCannotRun
from .._base.text import Printed, write_list
from ..loop.loop import Loop
from ..loop.simulation import SimulationStopped, simulate
from .settling import SETTLED

# A response so many times the promised one is no longer under control.
LOST = 20
# A final value below this share of the largest deviation is none: the output returns.
RETURNS = 0.02
# A reference is followed if the output ends at no less than this share of it.
HELD = 0.5
# A deviation below this share of a step is rounding.
NOTHING = 1e-9


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
        return (f"final value {write_or_dash(self.final_value, '.4g')}, overshoot "
                f"{write_or_dash(self.overshoot, '.3g')} %, settled after "
                f"{write_or_dash(self.settling_time, '.4g')} s")  # fmt: skip


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


@dataclass(frozen=True, eq=False)
class Motion:
    """Deviations of all signals from rest, and why they end early."""

    y: Array
    u: Array
    failure: str | None = None


def list_references(loop: Loop) -> tuple[str, ...]:
    """Return the names of the references of a loop."""
    wiring = loop.wiring
    return loop.signals["y"] if wiring is None else wiring.open


def find_followed(loop: Loop, model: Any, name: str) -> str | None:
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


def stay(loop: Loop, n: int) -> Motion:
    """Return what all signals do without a step."""
    try:
        record = _follow(loop, n)
    except ModelCannotRun as reason:
        p, m = len(loop.signals["y"]), len(loop.signals["u"])
        return Motion(np.empty((p, 0)), np.empty((m, 0)), write_sentence(reason))
    return Motion(np.atleast_2d(record.y), np.atleast_2d(record.u))


def follow_step(loop: Loop, name: str, height: float, n: int, rest: Motion) -> Motion:
    """Return what a step of one reference does, less what happens without it."""
    if rest.failure is not None:
        return rest
    try:
        record = _follow(loop, n, name, height)
    except SimulationStopped as reason:
        got = np.atleast_2d(reason.y)
        return Motion(got - rest.y[:, : got.shape[1]], np.empty((len(rest.u), 0)),
                       write_sentence(reason))  # fmt: skip
    y, u = np.atleast_2d(record.y) - rest.y, np.atleast_2d(record.u) - rest.u
    for move in (y, u):
        move[np.max(np.abs(move), axis=1) < NOTHING * abs(height)] = 0.0
    return Motion(y, u)


def _follow(loop: Loop, n: int, moved: str = "", height: float = 0.0) -> Any:
    """Return the record of a loop whose references rest, but for one that steps."""
    names, law = list_references(loop), loop.law()
    assert law is not None
    rest = np.array(loop.point.outputs if law.references is None else law.references)
    references = np.repeat(rest[:, None], n, axis=1)
    if moved:
        references[names.index(moved)] += height
    return simulate(loop, references[0] if loop.wiring is None
                    else dict(zip(names, references, strict=True)))  # fmt: skip


def write_sentence(reason: CtrlidError) -> str:
    """Return the words of an error as a sentence."""
    text = str(reason)
    return text[0].upper() + text[1:] + "."


def make_step(
    loop: Loop, model: Any, name: str, height: float, dt: float, n: int,
    promised: Motion, achieved: Motion,
) -> ReferenceStep:  # fmt: skip
    """Return what a step did on the model and on the physics, which ends where control is lost."""
    outputs = loop.signals["y"]
    output = find_followed(loop, model, name) or outputs[_find_nearest(promised.y, height)]
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
        achieved = Motion(achieved.y[:, : at + 1], achieved.u[:, : at + 1], f"{text}.")
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


def _measure_motion(motion: Motion, k: int, height: float, time: Array) -> StepMotion:
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


def returns_to_rest(loop: Loop, step: ReferenceStep) -> bool:
    """Return whether an output goes back to rest though a reference that could be held asks."""
    wiring = loop.wiring
    held = wiring is not None and wiring.held[wiring.open.index(step.reference)] is not None
    return held and abs(step.promised.final_value) < HELD


def write_or_dash(value: float, form: str) -> str:
    """Return a number in a format, or a dash where there is none."""
    return "-" if math.isnan(value) else f"{value:{form}}"
