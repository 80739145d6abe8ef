"""Figures, axes and the style that all pictures share."""

import io
import sys
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.rcsetup import cycler
from matplotlib.text import Text

from ..._base.errors import CtrlidError

# Okabe and Ito's colours, told apart by the colour-blind; lines and markers differ as well.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
DASHES = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)), (0, (8, 3)))
MARKERS = ("o", "s", "^", "D", "v", "P")
# The measured curve is broad and pale, so that what lies on it stays visible.
MEASURED = {"color": "0.72", "linewidth": 3.2}
# A record of more than twice so many samples is drawn as an envelope of so many bins.
BINS = 1500
STYLE = {
    "axes.prop_cycle": cycler(color=COLOURS) + cycler(linestyle=DASHES),
    "axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True,
    "axes.grid": True, "grid.color": "0.9", "grid.linewidth": 0.6,
    "lines.linewidth": 1.4, "legend.frameon": False,
}  # fmt: skip


def style() -> dict[str, Any]:
    """Return the look of all pictures, for axes of your own.

    Returns
    -------
    dict
        Settings of matplotlib: lines that differ without colour too, and a pale grid.

    Examples
    --------
    >>> import matplotlib.pyplot as plt
    >>> import ctrlid as cid
    >>> with plt.rc_context(cid.plot.style()):
    ...     figure = plt.figure()
    >>> plt.close(figure)
    """
    return dict(STYLE)


def figure(
    rows: int = 1, columns: int = 1, size: tuple[float, float] = (7.2, 4.0), sharex: Any = False
) -> Any:
    """Make a figure with axes, to draw several pictures side by side.

    Parameters
    ----------
    rows, columns : int, optional
        How many axes.
    size : (float, float), optional
        Width and height [inch].
    sharex : bool or str, optional
        As in matplotlib's ``subplots``: True, False or ``"col"``.

    Returns
    -------
    numpy.ndarray of matplotlib Axes, shape (rows, columns)
        The axes; ``axes[0, 0].figure`` is the figure.

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.plot.figure(2, 2).shape
    (2, 2)
    """
    return new_figure(size).subplots(rows, columns, squeeze=False, sharex=sharex)


def png(drawn: Any, dpi: float = 150) -> bytes:
    """Return a picture as the bytes of a PNG file.

    Parameters
    ----------
    drawn : matplotlib Figure, Axes or array of Axes
        What the functions here return, or its figure.
    dpi : float, optional
        Resolution [pixels per inch].

    Returns
    -------
    bytes
        The file.

    Raises
    ------
    CtrlidError
        If something else is given.

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.plot.png(cid.plot.figure())[1:4]
    b'PNG'
    """
    first = np.asarray(drawn, dtype=object).ravel()[0] if np.size(drawn) else None
    picture = first if isinstance(first, Figure) else getattr(first, "figure", None)
    if not isinstance(picture, Figure):
        raise CtrlidError(f"png() takes a figure or axes; given {type(drawn).__name__}")
    buffer = io.BytesIO()
    # Without the metadata the same picture is the same file.
    picture.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()


def new_figure(size: tuple[float, float]) -> Any:
    """Make a figure, through pyplot where the calling code has imported it and may show it."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__package__") == __package__:
        frame = frame.f_back
    pyplot = sys.modules.get("matplotlib.pyplot")
    inside = str(frame.f_globals.get("__name__", "")).split(".")[0] == __name__.split(".")[0]
    names = [*frame.f_globals.values(), *frame.f_locals.values()]
    # The package control imports pyplot as well, but it does not show our figures.
    if pyplot is not None and not inside and any(value is pyplot for value in names):
        return pyplot.figure(figsize=size, layout="constrained")
    return Figure(figsize=size, layout="constrained")


def require_kind(value: Any, kind: type, sentence: str) -> None:
    """Refuse what is not of the kind that a picture shows."""
    if not isinstance(value, kind):
        raise CtrlidError(f"{sentence}; given {type(value).__name__}")


def take_axes(
    axes: Any, number: int, size: tuple[float, float] | None = None, sharex: bool = False
) -> Any:
    """Return the axes as an array of the right length, new ones if none are given."""
    if axes is None:
        size = size or (7.2, 3.6 if number == 1 else 1.4 + 1.7 * number)
        return figure(number, 1, size, sharex).ravel()
    given = np.atleast_1d(np.asarray(axes, dtype=object)).ravel()
    if given.size != number or not all(isinstance(ax, Axes) for ax in given):
        raise CtrlidError(f"this picture needs {number} matplotlib Axes; given {given.size}: "
                          f"{', '.join(type(ax).__name__ for ax in given)}")  # fmt: skip
    return given


def choose_line_style(i: int) -> dict[str, Any]:
    """Return colour, dashes and width of the line number `i`."""
    return {
        "color": COLOURS[i % len(COLOURS)],
        "linestyle": DASHES[i % len(DASHES)],
        "linewidth": 1.4,
    }


def finish_axes(ax: Any, *, legend: bool = True, columns: int = 2, size: str = "medium") -> Any:
    """Add grid, open frame, and a legend above the axes, where it covers no data."""
    ax.grid(True, color="0.9", linewidth=0.6)
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    if ax.get_xscale() == "linear":
        ax.ticklabel_format(useOffset=False, axis="both")
        ax.locator_params(axis="x", nbins=6)
    if legend:
        ax.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=columns, frameon=False,
                  borderaxespad=0.3, fontsize=size, handlelength=2.6)  # fmt: skip
    take_literally(ax)
    return ax


def take_literally(ax: Any) -> None:
    """Draw names and units as they are: a dollar sign in them is no formula.

    The numbers at the ticks of a logarithmic axis are formulas.
    """
    ticks = {t for axis in (ax.xaxis, ax.yaxis) for t in axis.findobj(Text) if t is not axis.label}
    for text in ax.findobj(Text):
        if text not in ticks:
            text.set_parse_math(False)
