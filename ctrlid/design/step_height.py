"""How high a reference steps where nobody says so: by what the loop itself calls small."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np

from .._base.arrays import Array
from .._base.errors import CtrlidWarning
from .._base.text import write_list, write_number, write_percent, write_quantity
from .._base.units import count_per_si_unit
from ..effects import (
    AsymmetricCoulombFriction,
    CoulombFriction,
    InputBacklash,
    InputDeadZone,
    Quantization,
    StribeckFriction,
)
from ..loop.loop import Loop, find_input_limits
from .settling import find_reading_step

# A step is this share of the output at rest, so that it stays in the linear range around it.
SHARE = 0.01
# An output that rests at zero steps as far as moves the input by this share of its way to a limit.
ROOM = 0.1
# A step is so many of those in which an encoder reads that one of them counts as settled (2 %),
SEVERAL = 50
# unless it were more than so many times what is chosen without them.
MOST = 5.0
# A guess with which the physics breaks off is divided by ten so many times.
TENTHS = 5
# These have a kink at rest, of which the smallest signals see most.
KINKS = (
    AsymmetricCoulombFriction, CoulombFriction, InputBacklash, InputDeadZone, Quantization,
    StribeckFriction,
)  # fmt: skip


@dataclass(frozen=True)
class StepHeight:
    """How high a reference steps [unit of the output], and why.

    `reason` is a sentence or more, empty for a height that was given or is a share of the output
    at rest; `guessed` says that neither the loop nor its user told what is small.
    """

    value: float
    reason: str = ""
    guessed: bool = False


class Tried(Protocol):
    """What a step of some height came to."""

    @property
    def failure(self) -> str | None:
        """Why the simulation broke off; None if it did not."""


Outcome = TypeVar("Outcome", bound=Tried)


def try_heights(
    first: StepHeight, unit: str, stable: bool, run: Callable[[float], Outcome]
) -> tuple[StepHeight, Outcome]:
    """Return what a step came to; of a guess that breaks off the largest tenth that does not.

    Parameters
    ----------
    first : StepHeight
        The height that was chosen.
    unit : str
        Of the height.
    stable : bool
        Whether small deviations decay; if not, no height is small enough.
    run : callable
        From a height to what came of it.

    Returns
    -------
    StepHeight, object
        The height that was taken, with the reason, and its outcome: that of the first where none
        holds. Warnings are those of the outcome alone.
    """
    outcome, doubts = _run_quietly(run, first.value)
    height = first
    if outcome.failure is not None and first.guessed and stable:
        wide = write_quantity(first.value, unit)
        tries = [first.value / 10**k for k in range(1, TENTHS + 1)]
        kept: tuple[Outcome, list[Any], float] | None = None
        for value in tries:
            tried, own = _run_quietly(run, value)
            # A simulation with a doubt about it may have jumped over what the physics cannot pass.
            if tried.failure is None and (kept is None or not own):
                kept = tried, own, value
            if kept is not None and not kept[1]:
                break
        if kept is None:
            more = f"Steps down to {write_quantity(tries[-1], unit)} break off as well."
            height = StepHeight(first.value, f"{first.reason} {more}", guessed=True)
        else:
            outcome, doubts, value = kept
            more = (
                f"With {wide} the physics leaves the range in which this controller holds it, so "
                f"that {write_quantity(value, unit)} was taken."
            )
            height = StepHeight(value, f"{first.reason} {more}", guessed=True)
    for doubt in doubts:
        warnings.warn(doubt.message, stacklevel=3)
    return height, outcome


def _run_quietly(run: Callable[[float], Outcome], value: float) -> tuple[Outcome, list[Any]]:
    """Return an outcome and the warnings on the way to it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CtrlidWarning)
        return run(value), caught


def choose_height(loop: Loop, output: str | None, find_peaks: Callable[[], Array]) -> StepHeight:
    """Return the default height of a reference step, and why it is that.

    Parameters
    ----------
    loop : Loop
        The loop whose reference steps; the limits of its PID count as limits of the input.
    output : str or None
        The output that follows, where it is known.
    find_peaks : callable
        Returns how far the model promises each input to move for a step by 1; it is asked only
        where the inputs have limits.

    Returns
    -------
    StepHeight
        Guessed where nothing but SI units or an encoder tells it.

    Notes
    -----
    Without any such size a hundredth of an SI unit is taken, so that the same plant in millimetres
    or degrees steps as it does in metres or radians. Of an output that is read in steps, several
    of these are taken where that is not too much for the loop.
    """
    height, reason, bound = _choose_smooth_height(loop, output, find_peaks)
    step = 0.0 if output is None else find_reading_step(loop, output)
    if SEVERAL * step <= height:
        return StepHeight(height, reason, not bound)
    size = write_quantity(step, loop.known_units.get(output or "", ""))
    enough = SEVERAL * step
    read = f"{output} is read in steps of {size}"
    if bound and enough > MOST * height:
        words = (
            f"{reason} {read}, of which this is only {write_number(height / step, 2)}, so that the "
            f"response shows mostly the reading; {SEVERAL} of them may be too much for this loop."
        )
        return StepHeight(height, words.strip())
    words = (
        f"{read}, of which {SEVERAL} are taken: without them the step would have been "
        f"{write_quantity(height, loop.known_units.get(output or '', ''))}."
    )
    return StepHeight(enough, words, not bound)


def _choose_smooth_height(
    loop: Loop, output: str | None, find_peaks: Callable[[], Array]
) -> tuple[float, str, bool]:
    """Return height and reason as if the output were read without steps.

    The third says whether much more would leave the range of the plant or the input.
    """
    outputs = loop.signals["y"]
    rest = 0.0 if output is None else loop.point.outputs[outputs.index(output)]
    if rest:
        return SHARE * abs(rest), "", True
    zero = f"{output} rests at zero" if output else "No output is known to follow"
    lower, upper = (np.broadcast_to(v, len(loop.signals["u"])) for v in find_input_limits(loop))
    inputs = np.array(loop.point.inputs)
    room = np.minimum(inputs - lower, upper - inputs)
    if np.isfinite(room).any() and (room > 0).all():
        peaks = find_peaks()
        with np.errstate(divide="ignore", invalid="ignore"):
            height = float(np.nanmin(np.where(np.isfinite(room), ROOM * room / peaks, np.inf)))
        if np.isfinite(height) and height > 0:
            words = (
                f"{zero}, so that the step is chosen to move the input by {write_percent(ROOM)} of "
                "its way to a limit."
            )
            return float(f"{height:.2g}"), words, True
    unit = loop.known_units.get(output, "") if output else ""
    words = (
        f"{zero}, and no limit of the input says what is small, so that the height of the step is "
        "a guess: give step= what is small for this plant."
    )
    return SHARE * count_per_si_unit(unit), words, False


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
