"""Pictures of a record, of a comparison with it, and of residual correlations."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..._base import text as _text
from ..._base.arguments import explain_names
from ..._base.arrays import Array
from ..._base.errors import CtrlidError
from ...data.record import Record, keep_counted, list_rows
from ...data.validity import find_runs
from ...validation.comparison import Comparison, write_fit
from .. import pictures as _pictures
from .axes import (
    BINS,
    COLOURS,
    DASHES,
    MEASURED,
    Picture,
    choose_line_style,
    finish_axes,
    limit_view,
    require_kind,
    take_axes,
)


@explain_names
def record(record: Record, ax: Any = None, *, extra: Sequence[str] = ()) -> Picture:
    """Draw an experiment: reference and output, the input below, and extra channels on request.

    Of several outputs each has axes of its own, with the reference of its name, or else the one of
    its number where there are as many references as outputs, unless its unit is another one; so has
    each of several inputs, and a reference that belongs to no output, such as that of a state.
    Stretches that do not count are shaded, and do not set the scale. A long record is drawn as the
    band between the smallest and the largest value of neighbouring samples, so that no peak is
    lost.

    Parameters
    ----------
    record : Record
        The experiment; draw a part with ``record.between(t0, t1)``.
    ax : sequence of matplotlib Axes, optional
        One for each output, reference without an output, input and extra channel; by default those
        of a new figure.
    extra : sequence of str, optional
        Names of extra channels.

    Returns
    -------
    Picture
        Its axes, from top to bottom.

    Raises
    ------
    CtrlidError
        If something else than a record is given, or the axes or channels do not fit.

    Examples
    --------
    >>> import ctrlid as cid
    >>> r = cid.random_binary(500, amplitude=1, hold=20, seed=1)
    >>> picture = cid.plot.record(cid.Record(r=r, u=-r, y=0.9 * r, dt=0.01, units={"y": "mm"}))
    >>> [ax.get_ylabel() for ax in picture.axes]
    ['y [mm]', 'u [unit not given]']
    """
    require_kind(record, Record, "plot.record draws a Record")
    extra = (extra,) if isinstance(extra, str) else extra
    if not (isinstance(extra, list | tuple) and all(isinstance(name, str) for name in extra)):
        raise CtrlidError(f"extra takes names of channels, as in ('current',); given {extra!r}")
    unknown = [name for name in extra if name not in record.extra]
    if unknown:
        raise CtrlidError(
            f"the record has no extra channel {_text.write_list([repr(k) for k in unknown])}; it "
            f"has {', '.join(record.extra) or 'none'}"
        )
    rows = list_rows(record)
    outputs, references, inputs = (
        [row[1:] for row in rows if row[0] == key] for key in ("y", "r", "u")
    )
    followed = [_find_reference(references, k, row, len(outputs)) for k, row in enumerate(outputs)]
    alone = [row for row in references if all(row is not one for one in followed)]
    axes = take_axes(ax, len(outputs) + len(alone) + len(inputs) + len(extra), sharex=True)
    for ax, (name, unit, values, counted), wanted in zip(axes, outputs, followed, strict=False):
        both = [counted] if wanted is None else [counted, wanted[3]]
        scale, unit = _pictures.choose_scale(both, unit)
        _draw_trace(ax, record, scale * values, 0, f"measured {name}")
        if wanted is not None:
            label = wanted[0] if wanted[0] != "r" else ""
            _draw_trace(ax, record, scale * wanted[2], 1, f"reference {label}", True)
        ax.set_ylabel(f"{name} [{unit}]")
        _view_counted(ax, scale * np.concatenate(both))
    panels = [(1, "reference ", True, row) for row in alone]
    panels += [(2 + i, "input ", record.hold == "zoh", row) for i, row in enumerate(inputs)]
    channels = {row[0]: row[1:] for row in rows if row[0] in record.extra}
    panels += [(2 + len(inputs) + i, "", False, channels[k]) for i, k in enumerate(extra)]
    for ax, (colour, kind, held, (name, unit, values, counted)) in zip(
        axes[len(outputs) :], panels, strict=True
    ):
        scale, unit = _pictures.choose_scale([counted], unit)
        _draw_trace(ax, record, scale * values, colour % len(COLOURS), f"{kind}{name}", held)
        ax.set_ylabel(f"{name} [{unit}]")
        _view_counted(ax, scale * counted)
    for ax in axes:
        _shade_gaps(ax, record)
        finish_axes(ax)
    axes[-1].set_xlabel("time [s]")
    return Picture(axes)


def _find_reference(references: Any, k: int, output: Any, outputs: int) -> Any:
    """Return the row of the reference of an output, None if there is none.

    One in another unit, such as the volts of a set-point, is none that the axes of it could show.
    """
    name, unit = output[:2]
    alike = [row for row in references if row[0] == name]
    if not alike and len(references) == outputs:
        alike = [references[k]]
    return next((row for row in alike if not unit or not row[1] or row[1] == unit), None)


def _view_counted(ax: Any, counted: Array) -> None:
    """Keep what counts readable wherever samples go that do not."""
    low, high = counted.min(), counted.max()
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    bottom, top = ax.get_ylim()
    if bottom < low - 2 * margin or top > high + 2 * margin:
        ax.set_ylim(max(bottom, low - margin), min(top, high + margin))


@explain_names
def comparison(
    comparison: Comparison, ax: Any = None, *, window: tuple[float, float] | None = None
) -> Picture:
    """Draw the measured output against each prediction and simulation.

    Parameters
    ----------
    comparison : Comparison
        From `compare`.
    ax : matplotlib Axes or sequence of them, optional
        One for each output; by default those of a new figure.
    window : (float, float), optional
        From when to when [s]; by default a stretch with a lively (first) output in which the error
        of its last curve is as large as it usually is, neither the best nor the worst one.

    Returns
    -------
    Picture
        Its legend says of every curve what it is and its fit over the whole record.

    Raises
    ------
    CtrlidError
        If something else than a comparison is given, or the window is outside the record.

    Examples
    --------
    >>> import ctrlid as cid
    >>> loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), 5.0, dt=0.01)
    >>> r = cid.random_binary(1000, amplitude=0.1, hold=50, seed=1)
    >>> found = cid.compare(cid.simulate(loop, r, sensor_noise=1e-3, seed=2), loop)
    >>> cid.plot.comparison(found, window=(0, 5)).axes[0].get_xlabel()
    'time [s], 0 to 5 s of a record from 0 to 10 s'
    """
    require_kind(comparison, Comparison, "plot.comparison draws a Comparison, as compare() returns")
    whole, parts = comparison.record, comparison.outputs or (comparison,)
    if window is None:
        first = _pictures.find_telling_window(parts[0])
        stop = min(first + _pictures.WINDOW, len(whole))
    else:
        if not (isinstance(window, tuple | list | np.ndarray) and len(window) == 2):
            raise CtrlidError(f"window is (from, to) in seconds; given {window!r}")
        part = whole.between(*window)
        first = round((part.start - whole.start) / whole.dt)
        stop = first + len(part)
    axes = take_axes(ax, len(parts), (7.2, 1.2 + 2.4 * len(parts)), sharex=True)
    for ax, one in zip(axes, parts, strict=True):
        _draw_curves(ax, one, slice(first, stop))
        finish_axes(ax)
    ends = [
        f"{_text.write_time(a, whole.dt)} to {_text.write_time(a + n * whole.dt, whole.dt)} s"
        for a, n in ((whole.t[first], stop - first), (whole.start, len(whole)))
    ]
    axes[-1].set_xlabel(f"time [s], {ends[0]} of a record from {ends[1]}")
    return Picture(axes)


def _draw_curves(ax: Any, comparison: Comparison, shown: slice) -> None:
    """Draw the measured output and what is made of it, in the samples shown."""
    whole = comparison.record
    t = whole.t[shown]
    counted = keep_counted(whole.y[shown], whole.valid[shown])
    scale, unit = _pictures.choose_scale([counted], whole.units.get("y", ""))
    y = scale * whole.y[shown]
    ax.plot(t, y, label=f"measured {whole.names.get('y', 'y')}", **MEASURED)
    lines = []
    for i, curve in enumerate(comparison.curves):
        values = scale * curve.y[shown]
        # Long predictions are made from every few samples only; breaks are where nothing counts.
        kept = np.isfinite(values) | ~whole.valid[shown]
        label = f"{curve.label}: fit {write_fit(curve.fit, 1)}"
        lines += ax.plot(t[kept], values[kept], label=label, **choose_line_style(i))
    limit_view(ax, scale * counted, lines)
    _shade_gaps(ax, whole[shown])
    ax.set_ylabel(f"{whole.names.get('y', 'y')} [{unit}]")


@explain_names
def residuals(comparison: Comparison, ax: Any = None) -> Picture:
    """Draw the correlations of the one-step errors with their 99 % bands.

    Parameters
    ----------
    comparison : Comparison
        From `compare`.
    ax : sequence of matplotlib Axes, optional
        One for each of `comparison.tests`; by default those of a new figure.

    Returns
    -------
    Picture
        Its axes, from top to bottom.

    Raises
    ------
    CtrlidError
        If something else than a comparison with tests is given, or the number of axes differs.

    Examples
    --------
    >>> import ctrlid as cid
    >>> loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), 5.0, dt=0.01)
    >>> r = cid.random_binary(1000, amplitude=0.1, hold=50, seed=1)
    >>> found = cid.compare(cid.simulate(loop, r, sensor_noise=1e-3, seed=2), loop)
    >>> cid.plot.residuals(found)
    Picture with 3 axes
    """
    require_kind(comparison, Comparison, "plot.residuals draws a Comparison, as compare() returns")
    if not comparison.tests:
        raise CtrlidError("plot.residuals has nothing to draw: the one-step errors are only "
                          "round-off and were not tested")  # fmt: skip
    axes = take_axes(ax, len(comparison.tests), sharex=True)
    for ax, test in zip(axes, comparison.tests, strict=True):
        inside = np.abs(test.values) <= test.band
        if np.isfinite(test.band):
            ax.axhspan(-test.band, test.band, color="0.85", label="99 % band")
        ax.axhline(0, color="0.3", linewidth=0.8)
        ax.vlines(test.lags, 0, test.values, color="0.5", linewidth=1)
        for which, marker, colour, label in (
            (inside, "o", COLOURS[0], "within"), (~inside, "s", COLOURS[1], "outside"),
        ):  # fmt: skip
            if which.any():
                ax.plot(test.lags[which], test.values[which], marker, color=colour, markersize=4,
                        label=label)  # fmt: skip
        verdict = "not significant" if test.passed else "NOT BY CHANCE"
        title = (f"one-step errors {test.name}: {verdict} "
                 f"({_text.write_p_value(test.p_value)})")  # fmt: skip
        ax.set_title(title, loc="left", fontsize="medium")
        reach = 1.15 * max(float(np.abs(test.values).max()), min(test.band, 1.0))
        ax.set_ylim(-reach, reach)
        ax.set_ylabel("correlation [1]")
        finish_axes(ax, legend=False)
    axes[0].legend(loc="lower right", bbox_to_anchor=(1, 1.12), ncols=3, frameon=False, borderpad=0)
    axes[-1].set_xlabel("lag [samples]")
    return Picture(axes)


def _draw_trace(
    ax: Any, record: Record, values: Array, i: int, label: str, held: bool = False
) -> None:
    """Draw one signal over time, or the band it fills where there are more samples than pixels."""
    n = len(record)
    if n <= 2 * BINS:
        where = "steps-post" if held else "default"
        # Two signals share the first axes only.
        style = {**choose_line_style(i), "linestyle": DASHES[i == 1]}
        ax.plot(record.t, values, drawstyle=where, label=label.strip(), **style)
        return
    # Only the border of a reference is drawn, so that the output shows through.
    bounded = held and i == 1
    edges = np.linspace(0, n, (BINS // 15 if bounded else BINS) + 1).astype(int)[:-1]
    low, high = np.minimum.reduceat(values, edges), np.maximum.reduceat(values, edges)
    t, label = record.t[edges], f"{label.strip()}, range"
    if bounded:
        ax.step(t, high, where="post", label=label, **choose_line_style(i))
        ax.step(t, low, where="post", **choose_line_style(i))
        return
    ax.fill_between(t, low, high, color=COLOURS[i], alpha=0.55, linewidth=0.4, label=label)


def _shade_gaps(ax: Any, record: Record) -> None:
    """Shade the stretches that do not count."""
    for k, (start, stop) in enumerate(zip(*find_runs(~record.valid_samples), strict=True)):
        t0, t1 = (record.start + i * record.dt for i in (start, stop))
        ax.axvspan(t0, t1, facecolor="0.88", hatch="///", edgecolor="0.6", linewidth=0, zorder=0,
                   label=None if k else "does not count")  # fmt: skip
