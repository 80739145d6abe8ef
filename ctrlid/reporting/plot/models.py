"""Models: poles, frequency responses, and their trend over set-points."""

import textwrap
from typing import Any

import numpy as np
from matplotlib.ticker import MultipleLocator

from ..._base.arguments import explain_names
from ..._base.arrays import Array, to_real_array
from ..._base.errors import CtrlidError
from ...estimation.confidence_band import response_band
from ...estimation.identified_model import IdentifiedModel, read_delay
from ...estimation.series import FitSeries
from ...physics.trace import timebase
from .. import pictures as _pictures
from .axes import COLOURS, MARKERS, Picture, choose_line_style, finish_axes, require_kind, take_axes

# A legend of poles is broken after so many characters.
LEGEND_WIDTH = 60


@explain_names
def poles(models: Any, ax: Any = None, *, truth: Any = None) -> Picture:
    """Draw the poles of models against the border of stability.

    If one of the models is sampled, all are drawn in the z-plane (continuous ones at
    ``exp(s dt)``) with the unit circle, else in the s-plane with the imaginary axis. The view holds
    all poles and the point z = 1 (s = 0), where the slow ones are.

    Parameters
    ----------
    models : mapping of str to control.TransferFunction or control.StateSpace
        The models by label, or one model.
    ax : matplotlib Axes, optional
        By default that of a new figure.
    truth : control.TransferFunction or control.StateSpace, optional
        The physics, drawn as a reference.

    Returns
    -------
    Picture
        Its legend lists the poles.

    Raises
    ------
    CtrlidError
        If there is nothing to draw, or the sampling periods differ.

    Examples
    --------
    >>> import control as ct, ctrlid as cid
    >>> made = cid.plot.poles({"guess": ct.tf(1, [1, -1.9, 1], 0.1)}, truth=ct.tf(1, [1, 0, -1]))
    >>> made.axes[0].get_xlabel()
    'real part of z [1]'
    """
    models = _pictures.check_models(models, "plot.poles", several=True)
    physics = {"physics": truth} if truth is not None else {}
    if physics:
        physics = _pictures.check_models(physics, "plot.poles", several=True)
    dt = _pictures.find_period({**models, **physics})
    found = {k: _pictures.find_poles(m, dt) for k, m in (*models.items(), *physics.items())}
    if not any(p.size for p in found.values()):
        raise CtrlidError("plot.poles has nothing to draw: none of the models has a pole")
    axes = take_axes(ax, 1, size=(6.4, 3.6))
    ax = axes[0]
    if dt:
        angle = np.linspace(0, 2 * np.pi, 721)
        ax.plot(np.cos(angle), np.sin(angle), color="0.5", linewidth=1)
        ax.axhline(0, color="0.85", linewidth=0.8, zorder=0)
    else:
        ax.axvline(0, color="0.5", linewidth=1)
        ax.axhline(0, color="0.85", linewidth=0.8, zorder=0)
    for i, (label, places) in enumerate(found.items()):
        style: dict[str, Any] = {"color": "k", "marker": "+", "markersize": 15, "zorder": 4}
        if label in models:
            style = {"color": COLOURS[i % len(COLOURS)], "marker": MARKERS[i % len(MARKERS)],
                     "markersize": 8, "markerfacecolor": "none", "zorder": 3}  # fmt: skip
        words = textwrap.fill(f"{label}: {_pictures.list_poles(places)}", LEGEND_WIDTH)
        ax.plot(places.real, places.imag, linestyle="none", markeredgewidth=1.8, label=words,
                **style)  # fmt: skip
    _choose_view(ax, np.concatenate([*found.values(), [1.0 if dt else 0.0]]))
    plane, unit = ("z", "1") if dt else ("s", "rad/s")
    ax.set_xlabel(f"real part of {plane} [{unit}]")
    ax.set_ylabel(f"imaginary part of {plane} [{unit}]")
    finish_axes(ax, columns=1)
    return Picture(axes)


@explain_names
def bode(models: Any, ax: Any = None, *, omega: Any = None, level: float | None = 0.95) -> Picture:
    """Draw the frequency responses of models, magnitude above phase, of fits with their bands.

    Parameters
    ----------
    models : mapping of str to control.TransferFunction or control.StateSpace
        The models by label, or one model. Sampled ones end at their Nyquist frequency, which is
        marked.
    ax : sequence of two matplotlib Axes, optional
        By default those of a new figure.
    omega : array_like, optional
        Frequencies [rad/s]; by default around all poles and zeros.
    level : float or None, optional
        Probability of the confidence bands of fitted models, as in `response_band`; None leaves
        them out.

    Returns
    -------
    Picture
        Magnitude above phase. Phases run on without jumps of 360 degrees, and those of different
        models are drawn on the same sheet.

    Raises
    ------
    CtrlidError
        If there is nothing to draw, a frequency is not positive, or the level is not between 0 and
        1.

    Examples
    --------
    >>> import control as ct, ctrlid as cid
    >>> magnitude, phase = cid.plot.bode({"levitation": ct.tf(-2, [1, 0, -1600])})
    >>> phase.get_ylabel(), phase.get_xlabel()
    ('phase [deg]', 'frequency [rad/s]')
    """
    models = _pictures.check_models(models, "plot.bode")
    grid = (
        _pictures.make_frequency_grid(models)
        if omega is None
        else np.sort(np.atleast_1d(to_real_array(omega, "omega")).ravel())
    )
    if not (np.isfinite(grid).all() and grid.size > 1 and (grid > 0).all()):
        raise CtrlidError("omega needs at least two positive frequencies in rad/s")
    axes = take_axes(ax, 2, sharex=True)
    sheet: float | None = None
    limits = []
    for i, (label, model) in enumerate(models.items()):
        dt = timebase(model)
        # At the Nyquist frequency itself a response is real and its phase says nothing.
        w = grid[grid < 0.999 * np.pi / dt] if dt else grid
        if dt:
            limits.append(np.pi / dt)
        if not w.size:
            continue
        values = np.atleast_1d(model(np.exp(1j * w * dt) if dt else 1j * w))
        values = values * np.exp(-1j * w * read_delay(model))
        phase = np.degrees(np.unwrap(np.angle(values)))
        # All phases are on the sheet of the first model, which starts within (-270, 90] degrees.
        turn = (
            np.floor((phase[0] + 270) / 360)
            if sheet is None
            else np.round((phase[0] - sheet) / 360)
        )
        if sheet is None and phase[0] - 360 * turn == -270:
            turn -= 1
        phase = phase - 360 * turn
        sheet = float(phase[0]) if sheet is None else sheet
        axes[0].semilogx(w, 20 * np.log10(np.abs(values)), label=label, **choose_line_style(i))
        axes[1].semilogx(w, phase, **choose_line_style(i))
        if level is not None and isinstance(model, IdentifiedModel):
            _draw_band(axes, model, w, level, phase, choose_line_style(i)["color"], label)
    for limit in sorted(set(np.round(limits, 9))):
        for ax in axes:
            ax.axvline(limit, color="0.5", linewidth=1, linestyle=":",
                       label="Nyquist frequency" if ax is axes[0] else None)  # fmt: skip
    _set_degree_ticks(axes[1])
    axes[0].set_ylabel("magnitude [dB]")
    axes[1].set_ylabel("phase [deg]")
    axes[1].set_xlabel("frequency [rad/s]")
    finish_axes(axes[0])
    finish_axes(axes[1], legend=False)
    return Picture(axes)


def _draw_band(
    axes: Any, model: IdentifiedModel, w: Array, level: float, phase: Array, color: str, label: str
) -> None:
    """Shade where the response of a fit lies, without letting a wide band set the view."""
    band = response_band(model, w, level)
    if not model.estimate.covariance.any():
        return
    shift = phase - band.phase
    # A band that holds zero goes down without end.
    lowest = np.maximum(band.magnitude_low, np.finfo(float).tiny)
    sides = [
        (20 * np.log10(lowest), 20 * np.log10(band.magnitude_high)),
        (band.phase_low + shift, band.phase_high + shift),
    ]
    for ax, (low, high) in zip(axes, sides, strict=True):
        view = ax.get_ylim()
        name = f"{label}: {100 * level:g} % confidence" if ax is axes[0] else None
        ax.fill_between(w, low, high, color=color, alpha=0.22, linewidth=0.6, label=name)
        reach = 0.5 * (view[1] - view[0])
        ax.set_ylim(
            max(min(view[0], low.min()), view[0] - reach),
            min(max(view[1], high.max()), view[1] + reach),
        )
        ax.autoscale(True, axis="x")


@explain_names
def trend(series: FitSeries, ax: Any = None, *, truth: Any = None) -> Picture:
    """Draw the rightmost pole of each record against its mean output, and the line through them.

    Parameters
    ----------
    series : FitSeries
        From `fit_each`.
    ax : matplotlib Axes, optional
        By default that of a new figure.
    truth : callable, optional
        What physics says: from an array of outputs [output unit] to poles [rad/s].

    Returns
    -------
    Picture
        Its bars are 95 % intervals.

    Raises
    ------
    CtrlidError
        If something else is given, or the records do not allow a line.

    Examples
    --------
    >>> import control as ct, ctrlid as cid
    >>> loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), ct.tf(5, 1, 0.05), dt=0.05)
    >>> runs = [cid.simulate(loop, cid.random_binary(500, amplitude=0.1, hold=9, around=at, seed=1),
    ...                      sensor_noise=1e-3, seed=2) for at in (0, 1)]
    >>> cid.plot.trend(cid.fit_each(cid.fit_iv, runs, na=2, nb=2)).axes[0].get_ylabel()
    'rightmost pole [rad/s]'
    """
    require_kind(series, FitSeries, "plot.trend draws a FitSeries, as fit_each() returns")
    line = series.trend
    axes = take_axes(ax, 1)
    ax = axes[0]
    scale, unit = _pictures.choose_scale([series.levels], series.unit)
    y = np.linspace(series.levels.min(), series.levels.max(), 101)
    ax.plot(scale * y, line.pole + line.slope * (y - line.level), label="line through the fits",
            **choose_line_style(0))  # fmt: skip
    if truth is not None:
        ax.plot(scale * y, truth(y), label="physics", **choose_line_style(1))
    ax.errorbar(scale * series.levels, series.rates, 1.96 * series.rate_errors, fmt=MARKERS[0],
                color="k", capsize=4, label="fits, 95 % intervals")  # fmt: skip
    ax.set_xlabel(f"mean output [{unit}]")
    ax.set_ylabel("rightmost pole [rad/s]")
    finish_axes(ax, columns=3)
    return Picture(axes)


def _choose_view(ax: Any, places: Any) -> None:
    """Choose limits that hold all places, of the same scale in both directions."""
    low, high = places.real.min(), places.real.max()
    tall = np.abs(places.imag).max()
    # A single pole at the origin has no size to choose the view by.
    pad = 0.15 * (max(high - low, tall, 0.1 * max(abs(high), abs(low))) or 1.0)
    half = max(tall + pad, 0.25 * (high - low + 2 * pad))
    width = max(high - low + 2 * pad, 4 * half)
    middle = 0.5 * (low + high)
    ax.set_xlim(middle - width / 2, middle + width / 2)
    ax.set_ylim(-half, half)
    ax.set_aspect("equal", adjustable="box")


def _set_degree_ticks(ax: Any) -> None:
    """Put the ticks of a phase at parts of a right angle."""
    low, high = ax.get_ylim()
    step = next((s for s in (1, 5, 15, 30, 45, 90) if high - low <= 7 * s), 180)
    ax.yaxis.set_major_locator(MultipleLocator(step))
