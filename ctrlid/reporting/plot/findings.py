"""The picture of a diagnosis: the gap, where the errors are, and the candidates."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.ticker import FixedLocator, NullLocator

from ..._base.arguments import explain_names
from ..._base.arrays import Array
from ...diagnosis import wording
from ...diagnosis.findings import BinnedErrors
from ...diagnosis.result import Diagnosis
from ...diagnosis.thresholds import THRESHOLD
from ...effects.base import name_with_subject
from .. import pictures as _pictures
from .axes import (
    COLOURS,
    MEASURED,
    Picture,
    finish_axes,
    fit_legends,
    limit_view,
    new_figure,
    require_kind,
    take_axes,
)

# Labels of ticks need this share of the width of an axis.
APART = 0.13
BEFORE = {"color": COLOURS[1], "linestyle": "--", "linewidth": 1.4}
AFTER = {"color": COLOURS[0], "linestyle": "-", "linewidth": 1.4}
FILLS: dict[str, dict[str, Any]] = {
    "found": {"facecolor": COLOURS[0], "edgecolor": "k"},
    "not told apart": {"facecolor": COLOURS[5], "edgecolor": "k", "hatch": "////"},
    "in the model, but its name does not stand": {
        "facecolor": COLOURS[0], "edgecolor": "w", "hatch": "xxx"},
    "taken, later replaced or dropped": {
        "facecolor": "0.75", "edgecolor": COLOURS[0], "hatch": "...."},
    "fitted, not taken": {"facecolor": "0.75", "edgecolor": "0.3"},
    "put out": {"facecolor": "0.92", "edgecolor": "0.3", "hatch": "xxx"},
    "screened only, not fitted": {
        "facecolor": "w", "edgecolor": "0.45", "hatch": "////", "linestyle": "--"},
}  # fmt: skip
# What explains the bars is broken after so many characters, and begins so far below the axes [pt].
CAPTION_WIDTH = 100
CAPTION_BELOW = 38


@explain_names
def diagnosis(found: Diagnosis, ax: Any = None) -> Picture:
    """Draw what a diagnosis found: the gap before and after, where it sits, and the ranking.

    From top to bottom: the measured output against the model before and after, on those samples
    kept back on which it erred most; the errors against the noise floor; RMS one-step errors along
    the two most telling quantities, in units of noise; and the evidence for each candidate, by
    rounds of the search. What became of a candidate is in the legend, and below it why one beyond
    the line that a gain must pass need not be a name.

    Parameters
    ----------
    found : Diagnosis
        From `diagnose`.
    ax : sequence of five matplotlib Axes, optional
        By default those of a new figure.

    Returns
    -------
    Picture
        With the axes of the outputs, the errors, the two places and the ranking.

    Raises
    ------
    CtrlidError
        If something else than a diagnosis is given, or the number of axes differs.
    """
    require_kind(found, Diagnosis, "plot.diagnosis draws a Diagnosis, as diagnose() returns")
    rounds = _pictures.make_ranking(found)
    own = ax is None
    if own:
        rows = max(sum(len(bars) + 1 for bars in rounds.values()), 3)
        lines = len(textwrap.wrap(_pictures.explain_bars(rounds), CAPTION_WIDTH))
        height = 0.21 * rows + 0.9 + 0.16 * lines
        layout = [["output"] * 2, ["error"] * 2, ["first", "second"], ["ranking"] * 2]
        heights = [2.5, 1.9, 2.2, height]
        made = new_figure((8.0, sum(heights))).subplot_mosaic(
            layout, gridspec_kw={"height_ratios": heights}
        )
        ax = list(made.values())
    axes = take_axes(ax, 5)
    _draw_gap(axes[0], axes[1], found)
    places = _pictures.choose_two_most_telling(found)
    for ax, place in zip(axes[2:4], [*places, None, None][:2], strict=True):
        _draw_errors(ax, place, found)
    _draw_ranking(axes[4], rounds)
    if own:
        fit_legends(axes)
    return Picture(axes)


def _draw_gap(above: Any, below: Any, found: Diagnosis) -> None:
    """Draw the measured output against the model before and after, and the errors below."""
    gap = next((g for g in found.gap.outputs if g.output == found.gap.output), found.gap)
    part = _pictures.find_largest_gap(gap)
    t, y = gap.time[part], gap.measured[part]
    scale, unit = _pictures.choose_scale([y], gap.unit)
    above.plot(t, scale * y, label="measured", **MEASURED)
    names = " and ".join(name_with_subject(f.effect) for f in found.added[:2])
    names += f" and {len(found.added) - 2} more" if len(found.added) > 2 else ""
    # A model without free parameters is not recalibrated.
    changed = gap.before == gap.fitted != gap.given
    start = "recalibrated model" if changed else "model as given"
    label = "recalibrated" if changed and not names else "before"
    cases = [(label, gap.simulated_before, gap.before, BEFORE if names else AFTER)]
    if names:
        cases.append(("after", gap.simulated_after, gap.after, AFTER))
    errors = [y - values[part] for _, values, _, _ in cases]
    known = [e[np.isfinite(e)] for e in errors if np.isfinite(e).any()] or [np.zeros(1)]
    floored = np.isfinite(gap.floor) and gap.floor > 0
    fine, small = _pictures.choose_scale([np.full(1, gap.floor)] if floored else known, gap.unit)
    # Where the unit is not known, only the label of the axis says so.
    short = f" {small}" if gap.unit else ""
    if floored:
        below.axhspan(-2 * fine * gap.floor, 2 * fine * gap.floor, color="0.87", zorder=0,
                      label=f"±2 x noise floor, {fine * gap.floor:.3g}{short}")  # fmt: skip
    below.axhline(0, color="0.3", linewidth=0.8)
    lines: list[Any] = []
    for (label, values, size, style), error in zip(cases, errors, strict=True):
        rms = "none" if np.isnan(size) else f"RMS {fine * size:.3g}{short}"
        long = {"before": start, "after": f"with {names}"}.get(label, label)
        # A long prediction is made at some of the samples only.
        made = np.isfinite(error) if gap.horizon else slice(None)
        shown = scale * values[part]
        lines += above.plot(t[made], shown[made], label=f"{gap.name}, {long}", **style)
        below.plot(t[made], fine * error[made], label=f"{label}: {rms}", **style)
    limit_view(above, scale * y, lines)
    above.set_ylabel(f"{gap.output or 'output'} [{unit}]")
    below.set_ylabel(f"error [{small}]")
    among = wording.describe_drawn_samples(found.gap)
    below.set_xlabel(f"time [s], where the gap is largest among {among}")
    for ax in (above, below):
        ax.set_xlim(t[0], t[-1])
        finish_axes(ax, columns=1 if ax is above else 3, size="small")


def _draw_errors(ax: Any, place: BinnedErrors | None, found: Diagnosis) -> None:
    """Draw the RMS of the one-step errors along one quantity, before and after."""
    if place is None:
        ax.text(0.5, 0.5, "no bins to show", ha="center", va="center", transform=ax.transAxes)
        ax.set_axis_off()
        return
    edges, title = _pictures.scale_edges(place)
    before, after = np.sqrt(place.before), np.sqrt(place.after)
    both = bool(found.added)
    # Bins hold equally many samples each, so that they are of unequal width.
    alone = "recalibrated" if found.calibrated else "model as given"
    filled, label = (after, "after") if both else (before, alone)
    ax.stairs(np.nan_to_num(filled), edges, fill=True, color=COLOURS[0], alpha=0.55, label=label)
    ax.stairs(filled, edges, color=COLOURS[0], linewidth=0.8)
    if both:
        ax.stairs(before, edges, label="before", baseline=None, **BEFORE)
    ax.axhline(1, color="k", linewidth=1.2, linestyle=":", label="noise")
    ax.set_xlim(edges[0], edges[-1])
    ax.set_xlabel(title)
    ax.set_ylabel("normalized RMS of\none-step errors [1]")
    top = float(np.nanmax([*before, *after, 1.0]))
    finish_axes(ax, columns=3, size="small")
    ax.locator_params(axis="x", nbins=5)
    inner = edges[1:-1]
    if np.ptp(inner) < np.ptp(edges) / 4 and np.any(inner):
        # Seldom and far values would leave no room for the others.
        ax.set_xscale("symlog", linthresh=float(np.max(np.abs(inner))))
        ax.xaxis.set_major_locator(FixedLocator(_space_ticks(ax, edges)))
        ax.xaxis.set_minor_locator(NullLocator())
        ax.xaxis.set_major_formatter(lambda v, _: f"{v:.0f}" if abs(v) >= 100 else f"{v:.3g}")
    if top > 10:
        ax.set_yscale("log")
    else:
        ax.set_ylim(0, 1.1 * top)


def _space_ticks(ax: Any, edges: Array) -> list[float]:
    """Return the ends, zero and the inner ends of bins, without those that would overlap."""
    scale = ax.xaxis.get_transform()
    low, high = scale.transform(np.array([edges[0], edges[-1]]))
    kept, places = [float(edges[0]), float(edges[-1])], [0.0, 1.0]
    for value in (0.0, float(edges[1]), float(edges[-2])):
        place = float((scale.transform(np.array([value]))[0] - low) / (high - low))
        if 0 < place < 1 and min(abs(place - other) for other in places) >= APART:
            kept.append(value)
            places.append(place)
    return sorted(kept)


def _draw_ranking(ax: Any, rounds: Mapping[str, Sequence[_pictures.Bar]]) -> None:
    """Draw the net gain of each candidate as bars, round below round."""
    labels, row, drawn = [], 0, set()
    top = max((bar.net_gain for bars in rounds.values() for bar in bars), default=0.0)
    for name, bars in rounds.items():
        ax.text(0.0, row, f" {name}", ha="left", va="center", style="italic",
                fontsize="small", transform=ax.get_yaxis_transform())  # fmt: skip
        labels.append("")
        row += 1
        for bar in bars:
            ax.barh(row, bar.net_gain, 0.72, linewidth=0.7, **FILLS[bar.kind],
                    label=None if bar.kind in drawn else bar.kind)  # fmt: skip
            # The gain of what no fit has confirmed is told as the estimate that it is.
            about = "" if bar.fitted else "about "
            words = f"{about}{round(bar.net_gain)}"
            if bar.net_gain <= _pictures.LEAST:
                words = f"below {_pictures.LEAST:g}"
            if np.isfinite(bar.evidence):
                words += f"; evidence {bar.evidence:.0f}"
            ax.annotate(words, (max(bar.net_gain, 0.0), row), (3, 0), va="center",
                        textcoords="offset points", fontsize="x-small",
                        bbox={"facecolor": "w", "edgecolor": "none", "pad": 0.5})  # fmt: skip
            drawn.add(bar.kind)
            labels.append(bar.label)
            row += 1
    if not rounds:
        ax.text(0.5, 0.5, "no candidate was tried", ha="center", transform=ax.transAxes)
    gate = THRESHOLD.gate
    ax.axvline(gate, color="k", linewidth=1, linestyle="--", label=f"required net gain, {gate:g}")
    ax.axvline(0, color="0.3", linewidth=0.8)
    ax.set_xscale("symlog", linthresh=2 * gate)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.set_xlim(_pictures.LEAST, 12 * max(top, 2 * gate))
    ax.set_yticks(range(row), labels, fontsize="small")
    ax.tick_params(axis="y", length=0)
    ax.set_ylim(row - 0.4, -0.6)
    ax.set_xlabel("net gain in its round, less the Bayesian penalty (BIC) [log-likelihood]")
    caption = textwrap.fill(_pictures.explain_bars(rounds), CAPTION_WIDTH)
    if caption:
        ax.annotate(
            caption, (1, 0), (0, -CAPTION_BELOW), xycoords="axes fraction", va="top",
            # Long names on the left leave the axes narrower than the text.
            ha="right", multialignment="left", textcoords="offset points", fontsize="small",
            annotation_clip=False,
        )  # fmt: skip
    finish_axes(ax, columns=5, size="small")
    ax.grid(False, axis="y")
