"""Figures, axes and the style that all pictures share."""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.rcsetup import cycler
from matplotlib.text import Text

from ..._base.arguments import check_arguments, explain_names
from ..._base.arrays import Array
from ..._base.errors import CtrlidError
from ..._base.text import write_count

# Okabe and Ito's colours, told apart by the colour-blind; lines and markers differ as well.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
DASHES = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)), (0, (8, 3)))
MARKERS = ("o", "s", "^", "D", "v", "P")
# The measured curve is broad and pale, so that what lies on it stays visible.
MEASURED = {"color": "0.72", "linewidth": 3.2}
# So much of its span is left free below and above the measured curve, which always fills at least
# this share of the height.
BESIDE, READABLE = 0.8, 0.25
# A record of more than twice so many samples is drawn as an envelope of so many bins.
BINS = 1500
# A figure has so many axes along a side at most, and is so large [inch]; matplotlib draws so many
# pixels along a side.
MOST, LARGEST, PIXELS = 50, 100.0, 2**16 - 1
# With fewer pixels an inch no letter can be drawn.
COARSEST = 10
SHARED = ("none", "all", "row", "col")
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


@explain_names
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
    Picture
        The figure and its axes, of shape (rows, columns).

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.plot.figure(2, 2).axes.shape
    (2, 2)
    """
    check_arguments(figure, locals(), "sharex")
    if not (1 <= rows <= MOST and 1 <= columns <= MOST):
        raise CtrlidError(f"figure() takes 1 to {MOST} rows and columns of axes; given {rows} rows "
                          f"and {columns} columns")  # fmt: skip
    if not all(0 < length <= LARGEST for length in size):
        raise CtrlidError(f"size is a width and a height of up to {LARGEST:g} inches; given {size}")
    if not isinstance(sharex, bool) and not (isinstance(sharex, str) and sharex in SHARED):
        raise CtrlidError(f"sharex is True, False or one of {', '.join(SHARED)}; given {sharex!r}")
    return Picture(new_figure(size).subplots(rows, columns, squeeze=False, sharex=sharex))


@explain_names
def png(drawn: Any, dpi: float = 150) -> bytes:
    """Return a picture as the bytes of a PNG file.

    Parameters
    ----------
    drawn : Picture, matplotlib Figure, Axes or array of Axes
        What the functions here return, or a figure or axes of matplotlib.
    dpi : float, optional
        Resolution [pixels per inch].

    Returns
    -------
    bytes
        The file.

    Raises
    ------
    CtrlidError
        If something else is given, or the picture would have more pixels than matplotlib draws.

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.plot.png(cid.plot.figure())[1:4]
    b'PNG'
    """
    check_arguments(png, locals())
    drawn = drawn.figure if isinstance(drawn, Picture) else drawn
    first = np.asarray(drawn, dtype=object).ravel()[0] if np.size(drawn) else None
    picture = first if isinstance(first, Figure) else getattr(first, "figure", None)
    if not isinstance(picture, Figure):
        raise CtrlidError(f"png() takes a figure or axes; given {type(drawn).__name__}")
    pixels = dpi * max(picture.get_size_inches())
    if not (dpi >= COARSEST and pixels <= PIXELS):
        raise CtrlidError(
            f"a picture has {COARSEST} or more pixels an inch and up to {PIXELS} along a side; "
            f"dpi={dpi!r} gives {pixels:.4g}"
        )
    buffer = io.BytesIO()
    # Without the metadata the same picture is the same file.
    picture.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()


@dataclass(frozen=True, eq=False, repr=False)
class Picture:
    """A figure with the axes that were drawn on; a notebook shows it.

    Iterating over it, indexing it and ``len`` go to its axes. The figure is one of pyplot's, so
    that ``plt.show()`` and ``plt.savefig`` find it; ``plt.close(picture.figure)`` frees it.

    Parameters
    ----------
    axes : numpy.ndarray of matplotlib Axes
        What was drawn on, from top to bottom.
    """

    axes: Any

    @property
    def figure(self) -> Any:
        """The matplotlib Figure."""
        return self.axes.flat[0].figure

    def savefig(self, *args: Any, **options: Any) -> None:
        """Save the figure, as `matplotlib.figure.Figure.savefig` does."""
        self.figure.savefig(*args, **options)

    def __iter__(self) -> Iterator[Any]:
        return iter(self.axes)

    def __len__(self) -> int:
        return len(self.axes)

    def __getitem__(self, index: Any) -> Any:
        return self.axes[index]

    def __repr__(self) -> str:
        return f"Picture with {write_count(self.axes.size, 'axis', 'axes')}"

    def _repr_png_(self) -> bytes | None:
        """Return the bytes that a notebook shows, None where it shows pyplot's figures itself."""
        from matplotlib import pyplot as plt

        shown = "inline" in plt.get_backend() and plt.fignum_exists(self.figure.number)
        return None if shown else png(self, dpi=100)


_unseen: ContextVar[bool] = ContextVar("unseen", default=False)


@contextmanager
def off_screen() -> Iterator[None]:
    """Make figures that pyplot does not know, for pictures that end up in files."""
    before = _unseen.set(True)
    try:
        yield
    finally:
        _unseen.reset(before)


def new_figure(size: tuple[float, float]) -> Any:
    """Make a figure as python-control does: by pyplot, on the present one while it is empty."""
    if _unseen.get():
        return Figure(figsize=size, layout="constrained")
    # The import takes a while, and a session without pictures does not need it.
    from matplotlib import pyplot as plt

    if plt.get_fignums() and not plt.gcf().axes:
        plt.gcf().set_layout_engine("constrained")
        return plt.gcf()
    return plt.figure(figsize=size, layout="constrained")


def require_kind(value: Any, kind: type, sentence: str) -> None:
    """Refuse what is not of the kind that a picture shows."""
    if not isinstance(value, kind):
        raise CtrlidError(f"{sentence}; given {type(value).__name__}")


def take_axes(
    ax: Any, number: int, size: tuple[float, float] | None = None, sharex: bool = False
) -> Any:
    """Return the axes as an array of the right length, new ones if none are given."""
    if ax is None:
        size = size or (7.2, 3.6 if number == 1 else 1.4 + 1.7 * number)
        return figure(number, 1, size, sharex).axes.ravel()
    given = ax.axes if isinstance(ax, Picture) else ax
    given = np.atleast_1d(np.asarray(given, dtype=object)).ravel()
    if given.size != number or not all(isinstance(one, Axes) for one in given):
        raise CtrlidError(f"this picture needs {number} matplotlib Axes; given {given.size}: "
                          f"{', '.join(type(one).__name__ for one in given)}")  # fmt: skip
    return given


def choose_line_style(i: int) -> dict[str, Any]:
    """Return colour, dashes and width of the line number `i`."""
    return {
        "color": COLOURS[i % len(COLOURS)],
        "linestyle": DASHES[i % len(DASHES)],
        "linewidth": 1.4,
    }


def limit_view(ax: Any, measured: Array, lines: Sequence[Any]) -> None:
    """Keep what was measured readable wherever a wrong model goes, and say what is not seen.

    A line that is far away is seen in part where there is room for it.
    """
    least, most = float(np.min(measured)), float(np.max(measured))
    span = (most - least) or 1.0
    low, high = ax.get_ylim()
    low, high = max(low, least - BESIDE * span), min(high, most + BESIDE * span)
    drawn = [np.asarray(line.get_ydata(), float) for line in lines]
    drawn = [values[np.isfinite(values)] for values in drawn]
    for values in drawn:
        if values.size:
            # The nearest quarter of a line is enough to see where it goes.
            down, up = np.quantile(values, (0.75, 0.25)) + 0.05 * span * np.array([-1, 1])
            wider = min(low, float(down)), max(high, float(up))
            if wider[1] - wider[0] <= span / READABLE:
                low, high = wider
    ax.set_ylim(low, high)
    for line, values in zip(lines, drawn, strict=True):
        if not _crosses(values, low, high):
            line.set_label(f"{line.get_label()}, outside this picture")


def _crosses(values: Array, low: float, high: float) -> bool:
    """Return whether a line through these values is seen between two limits."""
    return bool(np.any(values > low) and np.any(values < high))


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
        _place_legend(ax, columns, size)
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


def fit_legends(axes: Sequence[Any]) -> None:
    """Give legends fewer columns where the laid out axes are narrower than they are.

    Long labels of one of several axes take room from all that stand above or below it.
    """
    axes[0].figure.draw_without_rendering()
    for ax in axes:
        made, room = ax.get_legend(), ax.get_window_extent().width
        if made is not None and made.get_window_extent().width > room:
            texts = made.get_texts()
            _place_legend(ax, len(texts), texts[0].get_fontsize(), room)


def _place_legend(ax: Any, columns: int, size: Any, room: float | None = None) -> None:
    """Put a legend above the axes, in so many columns that it does not run off the figure."""
    if room is None:
        # The layout is made when the figure is drawn.
        place = ax.get_subplotspec()
        box = ax.get_position() if place is None else place.get_position(ax.figure)
        room = box.width * ax.figure.bbox.width
    for number in range(columns, 0, -1):
        made = ax.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=number, frameon=False,
                         borderaxespad=0.3, fontsize=size, handlelength=2.6)  # fmt: skip
        for text in made.get_texts():
            text.set_parse_math(False)
        if made.get_window_extent().width <= room:
            return
