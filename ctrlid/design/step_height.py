"""How high a reference steps where nobody says so: by what the loop itself calls small."""

from collections.abc import Callable

import numpy as np

from .._base.arrays import Array
from .._base.text import write_number, write_percent, write_quantity
from .._base.units import count_per_si_unit
from ..loop.controllers import PID
from ..loop.loop import Loop
from .settling import find_reading_step

# A step is this share of the output at rest, so that it stays in the linear range around it.
SHARE = 0.01
# An output that rests at zero steps as far as moves the input by this share of its way to a limit.
ROOM = 0.1
# A step is so many of those in which an encoder reads, of which one alone is a response of its own,
SEVERAL = 10
# unless it were more than so many times what is chosen without them.
MOST = 5.0


def choose_height(
    loop: Loop, output: str | None, find_peaks: Callable[[], Array]
) -> tuple[float, str]:
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
    height : float
        In the unit of the output.
    reason : str
        A sentence or more; empty where the height is a share of the output at rest.

    Notes
    -----
    Without any such size a hundredth of an SI unit is taken, so that the same plant in millimetres
    or degrees steps as it does in metres or radians. Of an output that is read in steps, several
    of these are taken where that is not too much for the loop.
    """
    height, reason, bound = _choose_smooth_height(loop, output, find_peaks)
    step = 0.0 if output is None else find_reading_step(loop, output)
    if SEVERAL * step <= height:
        return height, reason
    size = write_quantity(step, loop.known_units.get(output or "", ""))
    enough = SEVERAL * step
    read = f"{output} is read in steps of {size}"
    if bound and enough > MOST * height:
        return height, (
            f"{reason} {read}, of which this is only {write_number(height / step, 2)}, so that the "
            f"response shows mostly the reading; {SEVERAL} of them may be too much for this loop."
        ).strip()
    return enough, (
        f"{read}, of which {SEVERAL} are taken: without them the step would have been "
        f"{write_quantity(height, loop.known_units.get(output or '', ''))}."
    )


def _find_range(loop: Loop) -> tuple[Array, Array]:
    """Return the limits of each input: those of the loop, and those that its PID keeps."""
    lower, upper = (np.broadcast_to(v, len(loop.signals["u"])) for v in loop.input_limits)
    if isinstance(loop.controller, PID):
        lower = np.maximum(lower, loop.controller.lower)
        upper = np.minimum(upper, loop.controller.upper)
    return lower, upper


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
    lower, upper = _find_range(loop)
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
