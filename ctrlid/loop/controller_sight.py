"""Whether an analog controller sees the noise of the readings, or only the logger does."""

from typing import Any, Literal

import numpy as np

from .._base.statistics import regress
from ..data.record import Record
from ..data.validity import find_whole_past
from .controllers import linearize_law
from .loop import Loop

# An analog controller sees readings with their noise, or the output itself.
Sight = Literal["reading", "output"]
# What is new in a signal is told against so many samples of the past of all.
MEMORY = 6
# So many samples tell enough.
MOST = 5000
# What is new in y below this share of its variance is rounding of the computer.
ROUNDING = 1e-18
# A direction below this share of the largest one is rounding.
DETERMINED = 1e-10


def find_sight(loop: Loop, record: Record) -> Sight:
    r"""Return what an analog controller sees, as its record tells.

    Noise that the controller sees is in its output at once, by its feedthrough D, so that what is
    new in u, given the past of all signals and r, is that of y times D:

    .. math:: \varepsilon_u = D \varepsilon_y, \qquad \varepsilon = s_k - E(s_k \mid r_k,
        \text{past of } r, u, y)

    Noise of the logger is in y alone. The share of :math:`\varepsilon_y` that
    :math:`\varepsilon_u` explains is one in the first case and zero in the second. Where noise is
    no part of what is new, both are the same, and the controller is said to see the readings.

    Parameters
    ----------
    loop : Loop
        A loop with an analog controller.
    record : Record
        Its record. Without a reference, and of several signals, nothing is told.

    Returns
    -------
    {"reading", "output"}
        What the controller sees. A law without feedthrough does not tell, and sees readings.
    """
    law = loop.law()
    if law is None or not loop.equations().siso or not np.any(linearize_law(law, loop.point)[4]):
        return "reading"
    return read_sight(record)


def read_sight(record: Record) -> Sight:
    """Return what a record tells of `find_sight`, for a law that has a feedthrough."""
    if record.r is None:
        return "reading"
    part = record[:MOST]
    rows = np.flatnonzero(find_whole_past(part.valid, MEMORY))
    signals: list[Any] = [part.r, part.u, part.y]
    scaled = [(s - np.mean(s[part.valid])) / (np.std(s[part.valid]) or 1.0) for s in signals]
    past = [s[rows - k] for s in scaled for k in range(1, MEMORY + 1)]
    table = np.column_stack([np.ones(len(rows)), scaled[0][rows], *past])
    if len(rows) <= 4 * table.shape[1]:
        return "reading"
    goal = np.column_stack([scaled[1][rows], scaled[2][rows]])
    new = goal - table @ regress(table, goal, DETERMINED)
    of_u, of_y = np.sum(new**2, axis=0)
    if of_y <= ROUNDING * len(rows):
        return "reading"
    share = float(np.sum(new[:, 0] * new[:, 1])) ** 2 / max(of_u * of_y, 1e-300)
    return "output" if share < 0.5 else "reading"
