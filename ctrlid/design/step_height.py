"""How high a reference steps where nobody says so: by what the loop itself calls small."""

from collections.abc import Callable

import numpy as np

from .._base.arrays import Array
from .._base.text import write_percent
from .._base.units import count_per_si_unit
from ..loop.loop import Loop

# A step is this share of the output at rest, so that it stays in the linear range around it.
SHARE = 0.01
# An output that rests at zero steps as far as moves the input by this share of its way to a limit.
ROOM = 0.1


def choose_height(
    loop: Loop, output: str | None, find_peaks: Callable[[], Array]
) -> tuple[float, str]:
    """Return the default height of a reference step, and why it is that.

    Parameters
    ----------
    loop : Loop
        The loop whose reference steps.
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
        A sentence; empty where the height is a share of the output at rest.

    Notes
    -----
    Without any such size a hundredth of an SI unit is taken, so that the same plant in millimetres
    or degrees steps as it does in metres or radians.
    """
    outputs = loop.signals["y"]
    rest = 0.0 if output is None else loop.point.outputs[outputs.index(output)]
    if rest:
        return SHARE * abs(rest), ""
    zero = f"{output} rests at zero" if output else "No output is known to follow"
    lower, upper = (np.broadcast_to(v, len(loop.signals["u"])) for v in loop.input_limits)
    inputs = np.array(loop.point.inputs)
    room = np.minimum(inputs - lower, upper - inputs)
    if np.isfinite(room).any() and (room > 0).all():
        peaks = find_peaks()
        with np.errstate(divide="ignore", invalid="ignore"):
            height = float(np.nanmin(np.where(np.isfinite(room), ROOM * room / peaks, np.inf)))
        if np.isfinite(height) and height > 0:
            return float(f"{height:.2g}"), (
                f"{zero}, so that the step is chosen to move the input by {write_percent(ROOM)} of "
                "its way to a limit."
            )
    unit = loop.known_units.get(output, "") if output else ""
    return SHARE * count_per_si_unit(unit), (
        f"{zero}, and no limit of the input says what is small, so that the height of the step is "
        "a guess: give step= what is small for this plant."
    )
