"""Pictures: a result and Axes in, the Axes out. The only file that imports matplotlib.

Without Axes a function makes its own figure. A script or notebook that has imported pyplot gets it
through pyplot, so that ``plt.show()`` shows it; otherwise it is outside pyplot's list of open
figures. Save it with ``axes.figure.savefig(...)`` or turn it into bytes with `png`. Nothing else
that is global is changed.
"""

import io
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.rcsetup import cycler
from matplotlib.ticker import MultipleLocator

from . import _pictures, _text
from .band import response_band
from .comparison import Comparison
from .controller_redesign import Redesign
from .data import Record
from .diagnosis.result import Diagnosis, Place
from .each import FitSeries
from .errors import CtrlidError
from .model import IdentifiedModel, delay_of
from .physics import Array, timebase

# Okabe and Ito's colours, told apart by the colour-blind; lines and markers differ as well.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
DASHES = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)), (0, (8, 3)))
MARKERS = ("o", "s", "^", "D", "v", "P")
MEASURED = {"color": "0.72", "linewidth": 3.2}  # broad and pale: what lies on it stays visible
BINS = 1500  # a record is drawn as an envelope when it has more than twice as many samples
# For axes of your own: plt.rcParams.update(cid.plot.STYLE) makes them look like those here.
STYLE = {
    "axes.prop_cycle": cycler(color=COLOURS) + cycler(linestyle=DASHES),
    "axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True,
    "axes.grid": True, "grid.color": "0.9", "grid.linewidth": 0.6,
    "lines.linewidth": 1.4, "legend.frameon": False,
}  # fmt: skip


def record(record: Record, axes: Any = None, *, extra: Sequence[str] = ()) -> Any:
    """Draw an experiment: reference and output, the input below, and extra channels on request.

    Stretches that do not count are shaded. A long record is drawn as the band between the smallest
    and the largest value of neighbouring samples, so that no peak is lost.

    Parameters
    ----------
    record : Record
        The experiment; draw a part with ``record.between(t0, t1)``.
    axes : sequence of matplotlib Axes, optional
        Two, and one more for each extra channel; by default those of a new figure.
    extra : sequence of str, optional
        Names of extra channels.

    Returns
    -------
    numpy.ndarray of matplotlib Axes
        The axes, from top to bottom.

    Raises
    ------
    CtrlidError
        If something else than a record is given, or the axes or channels do not fit.

    Examples
    --------
    >>> import ctrlid as cid
    >>> r = cid.random_binary(500, amplitude=1, hold=20, seed=1)
    >>> axes = cid.plot.record(cid.Record(r=r, u=-r, y=0.9 * r, dt=0.01, units={"y": "mm"}))
    >>> [ax.get_ylabel() for ax in axes]
    ['y [mm]', 'u [unit not given]']
    """
    _require(record, Record, "plot.record draws a Record")
    extra = (extra,) if isinstance(extra, str) else tuple(extra)
    unknown = [name for name in extra if name not in record.extra]
    if unknown:
        raise CtrlidError(f"the record has no extra channel {unknown}; it has {list(record.extra)}")
    axes = _axes(axes, 2 + len(extra), sharex=True)
    both = [record.y] if record.r is None else [record.y, record.r]
    scale, unit = _pictures.scale(both, record.units.get("y", ""))
    name = record.names.get("y", "y")
    _trace(axes[0], record, scale * record.y, 0, f"measured {name}")
    if record.r is not None:
        _trace(axes[0], record, scale * record.r, 1, f"reference {record.names.get('r', '')}", True)
    axes[0].set_ylabel(f"{name} [{unit}]")
    panels = [(record.names.get("u", "u"), record.u, "u", record.hold == "zoh")]
    panels += [(key, record.extra[key], key, False) for key in extra]
    for i, (ax, (name, values, key, held)) in enumerate(zip(axes[1:], panels, strict=True)):
        scale, unit = _pictures.scale([values], record.units.get(key, ""))
        label = name if i else f"input {name}"
        _trace(ax, record, scale * values, (2 + i) % len(COLOURS), label, held)
        ax.set_ylabel(f"{name} [{unit}]")
    for ax in axes:
        _shade(ax, record)
        _finish(ax)
    axes[-1].set_xlabel("time [s]")
    return axes


def comparison(
    comparison: Comparison, ax: Any = None, *, window: tuple[float, float] | None = None
) -> Any:
    """Draw the measured output against each prediction and simulation.

    Parameters
    ----------
    comparison : Comparison
        From `compare`.
    ax : matplotlib Axes, optional
        By default that of a new figure.
    window : (float, float), optional
        From when to when [s]; by default a stretch with a lively output in which the error of the
        last curve is as large as it usually is, neither the best nor the worst one.

    Returns
    -------
    matplotlib Axes
        The axes; the legend says of every curve what it is and its fit over the whole record.

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
    >>> ax = cid.plot.comparison(found, window=(0, 5))
    >>> ax.get_xlabel()
    'time [s], 0 to 5 s of a record from 0 to 10 s'
    """
    _require(comparison, Comparison, "plot.comparison draws a Comparison, as compare() returns")
    whole = comparison.record
    if window is None:
        first = _pictures.telling(comparison)
        stop = min(first + _pictures.WINDOW, len(whole))
    else:
        part = whole.between(*window)
        first = round((part.start - whole.start) / whole.dt)
        stop = first + len(part)
    ax = _axes(ax, 1)[0]
    t, shown = whole.t[first:stop], slice(first, stop)
    scale, unit = _pictures.scale([whole.y[shown]], whole.units.get("y", ""))
    y = scale * whole.y[shown]
    ax.plot(t, y, label=f"measured {whole.names.get('y', 'y')}", **MEASURED)
    for i, curve in enumerate(comparison.curves):
        values = scale * curve.y[shown]
        # Long predictions are made from every few samples only; breaks are where nothing counts.
        kept = np.isfinite(values) | ~whole.valid[shown]
        label = f"{curve.label}: fit {curve.fit:.1f} %"
        ax.plot(t[kept], values[kept], label=label, **_line(i))
    # A prediction of a wrong model can be anywhere; what was measured must stay readable.
    span = float(np.ptp(y)) or 1.0
    low, high = ax.get_ylim()
    low, high = max(low, y.min() - 0.8 * span), min(high, y.max() + 0.8 * span)
    ax.set_ylim(low, high)
    for line, curve in zip(
        ax.get_lines()[-len(comparison.curves) :], comparison.curves, strict=True
    ):
        values = scale * curve.y[shown]
        if not np.any((low < values) & (values < high)):
            line.set_label(f"{line.get_label()}, outside this picture")
    _shade(ax, whole[first:stop])
    ax.set_ylabel(f"{whole.names.get('y', 'y')} [{unit}]")
    ends = [f"{a:.4g} to {a + n * whole.dt:.4g} s" for a, n in
            ((t[0], len(t)), (whole.start, len(whole)))]  # fmt: skip
    ax.set_xlabel(f"time [s], {ends[0]} of a record from {ends[1]}")
    return _finish(ax)


def residuals(comparison: Comparison, axes: Any = None) -> Any:
    """Draw the correlations of the one-step errors with their 99 % bands.

    Parameters
    ----------
    comparison : Comparison
        From `compare`.
    axes : sequence of matplotlib Axes, optional
        One for each of `comparison.tests`; by default those of a new figure.

    Returns
    -------
    numpy.ndarray of matplotlib Axes
        The axes, from top to bottom.

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
    >>> len(cid.plot.residuals(found))
    3
    """
    _require(comparison, Comparison, "plot.residuals draws a Comparison, as compare() returns")
    if not comparison.tests:
        raise CtrlidError("plot.residuals has nothing to draw: the one-step errors of this record "
                          "were not tested, they are round-off or too few")  # fmt: skip
    axes = _axes(axes, len(comparison.tests), sharex=True)
    for ax, test in zip(axes, comparison.tests, strict=True):
        inside = np.abs(test.values) <= test.band
        if np.isfinite(test.band):
            ax.axhspan(-test.band, test.band, color="0.85", label="99 % band of chance")
        ax.axhline(0, color="0.3", linewidth=0.8)
        ax.vlines(test.lags, 0, test.values, color="0.5", linewidth=1)
        for which, marker, colour, label in (
            (inside, "o", COLOURS[0], "within"), (~inside, "s", COLOURS[1], "outside"),
        ):  # fmt: skip
            if which.any():
                ax.plot(test.lags[which], test.values[which], marker, color=colour, markersize=4,
                        label=label)  # fmt: skip
        verdict = "chance explains it" if test.passed else "NOT CHANCE"
        title = f"{test.name}: {verdict} ({_text.chance(test.p_value)})"
        ax.set_title(title, loc="left", fontsize="medium")
        reach = 1.15 * max(float(np.abs(test.values).max()), min(test.band, 1.0))
        ax.set_ylim(-reach, reach)
        ax.set_ylabel("correlation [1]")
        _finish(ax, legend=False)
    axes[0].legend(loc="lower right", bbox_to_anchor=(1, 1.12), ncols=3, frameon=False, borderpad=0)
    axes[-1].set_xlabel("lag [samples]")
    return axes


def poles(models: Any, ax: Any = None, *, truth: Any = None) -> Any:
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
    matplotlib Axes
        The axes; the legend lists the poles.

    Raises
    ------
    CtrlidError
        If there is nothing to draw, or the sampling periods differ.

    Examples
    --------
    >>> import control as ct, ctrlid as cid
    >>> ax = cid.plot.poles({"guess": ct.tf(1, [1, -1.9, 1], 0.1)}, truth=ct.tf(1, [1, 0, -1]))
    >>> ax.get_xlabel()
    'real part of z [1]'
    """
    models = _pictures.checked_models(models, "plot.poles")
    physics = (
        _pictures.checked_models({"physics": truth}, "plot.poles") if truth is not None else {}
    )
    dt = _pictures.period({**models, **physics})
    found = {k: _pictures.places(m, dt) for k, m in (*models.items(), *physics.items())}
    if not any(p.size for p in found.values()):
        raise CtrlidError("plot.poles has nothing to draw: none of the models has a pole")
    ax = _axes(ax, 1, size=(6.4, 3.6))[0]
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
        listed = ", ".join(_text.number(p, 4) for p in places) or "none"
        ax.plot(places.real, places.imag, linestyle="none", markeredgewidth=1.8,
                label=f"{label}: {listed}", **style)  # fmt: skip
    _view(ax, np.concatenate([*found.values(), [1.0 if dt else 0.0]]))
    plane, unit = ("z", "1") if dt else ("s", "rad/s")
    ax.set_xlabel(f"real part of {plane} [{unit}]")
    ax.set_ylabel(f"imaginary part of {plane} [{unit}]")
    return _finish(ax, columns=1)


def bode(models: Any, axes: Any = None, *, omega: Any = None, level: float | None = 0.95) -> Any:
    """Draw the frequency responses of models, magnitude above phase, of fits with their bands.

    Parameters
    ----------
    models : mapping of str to control.TransferFunction or control.StateSpace
        The models by label, or one model. Sampled ones end at their Nyquist frequency, which is
        marked.
    axes : sequence of two matplotlib Axes, optional
        By default those of a new figure.
    omega : array_like, optional
        Frequencies [rad/s]; by default around all poles and zeros.
    level : float or None, optional
        Probability of the confidence bands of fitted models, as in `response_band`; None leaves
        them out.

    Returns
    -------
    numpy.ndarray of matplotlib Axes
        Magnitude and phase. Phases run on without jumps of 360 degrees, and those of different
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
    models = _pictures.checked_models(models, "plot.bode")
    grid = (
        _pictures.frequencies(models)
        if omega is None
        else np.sort(np.atleast_1d(np.asarray(omega, float)))
    )
    if not (np.isfinite(grid).all() and grid.size > 1 and (grid > 0).all()):
        raise CtrlidError("omega needs at least two positive frequencies in rad/s")
    axes = _axes(axes, 2, sharex=True)
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
        values = values * np.exp(-1j * w * delay_of(model))
        phase = np.degrees(np.unwrap(np.angle(values)))
        # On the sheet of the first model; that one starts within (-270, 90].
        turn = (
            np.floor((phase[0] + 270) / 360)
            if sheet is None
            else np.round((phase[0] - sheet) / 360)
        )
        if sheet is None and phase[0] - 360 * turn == -270:
            turn -= 1
        phase = phase - 360 * turn
        sheet = float(phase[0]) if sheet is None else sheet
        axes[0].semilogx(w, 20 * np.log10(np.abs(values)), label=label, **_line(i))
        axes[1].semilogx(w, phase, **_line(i))
        if level is not None and isinstance(model, IdentifiedModel):
            _band(axes, model, w, level, phase, _line(i)["color"], label)
    for limit in sorted(set(np.round(limits, 9))):
        for ax in axes:
            ax.axvline(limit, color="0.5", linewidth=1, linestyle=":",
                       label="Nyquist frequency" if ax is axes[0] else None)  # fmt: skip
    _degrees(axes[1])
    axes[0].set_ylabel("magnitude [dB]")
    axes[1].set_ylabel("phase [deg]")
    axes[1].set_xlabel("frequency [rad/s]")
    _finish(axes[0])
    _finish(axes[1], legend=False)
    return axes


def _band(
    axes: Any, model: IdentifiedModel, w: Array, level: float, phase: Array, color: str, label: str
) -> None:
    """Shade where the response of a fit lies, without letting a wide band set the view."""
    band = response_band(model, w, level)
    if not model.estimate.covariance.any():
        return
    shift = phase - band.phase
    sides = [
        (20 * np.log10(band.magnitude_low), 20 * np.log10(band.magnitude_high)),
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


def trend(series: FitSeries, ax: Any = None, *, truth: Any = None) -> Any:
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
    matplotlib Axes
        The axes; bars are 95 % intervals.

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
    >>> cid.plot.trend(cid.fit_each(cid.fit_iv, runs, na=2, nb=2)).get_ylabel()
    'rightmost pole [rad/s]'
    """
    _require(series, FitSeries, "plot.trend draws a FitSeries, as fit_each() returns")
    line = series.trend
    ax = _axes(ax, 1)[0]
    scale, unit = _pictures.scale([series.levels], series.unit)
    y = np.linspace(series.levels.min(), series.levels.max(), 101)
    ax.plot(scale * y, line.pole + line.slope * (y - line.level), label="line through the fits",
            **_line(0))  # fmt: skip
    if truth is not None:
        ax.plot(scale * y, truth(y), label="physics", **_line(1))
    ax.errorbar(scale * series.levels, series.rates, 1.96 * series.rate_errors, fmt=MARKERS[0],
                color="k", capsize=4, label="fits, 95 % intervals")  # fmt: skip
    ax.set_xlabel(f"mean output [{unit}]")
    ax.set_ylabel("rightmost pole [rad/s]")
    return _finish(ax, columns=3)


def step(redesigns: Any, axes: Any = None) -> Any:
    """Draw what redesigns promised against what they achieved on the physics.

    Parameters
    ----------
    redesigns : Redesign or mapping of str to Redesign
        From `redesign`: one, or several by a label, each with axes of its own.
    axes : matplotlib Axes or sequence of them, optional
        By default those of a new figure.

    Returns
    -------
    matplotlib Axes or numpy.ndarray of matplotlib Axes
        The axes of the redesign; of a mapping an array, in its order.

    Raises
    ------
    CtrlidError
        If something else than redesigns is given.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    >>> op = cid.operating_point(plant, output=0.012)
    >>> loop = cid.Loop(plant, None, dt=0.001, at=op)
    >>> G = cid.linearize(plant, op)
    >>> slow = cid.redesign(G, loop, crossover=100, phase_margin=50)
    >>> cid.plot.step(slow).get_xlabel()
    'time after the step [s]'
    >>> fast = cid.redesign(G, loop, crossover=200, phase_margin=50)
    >>> len(cid.plot.step({"100 rad/s": slow, "200 rad/s": fast}))
    2
    """
    several = redesigns if isinstance(redesigns, Mapping) else {"": redesigns}
    if not several:
        raise CtrlidError("plot.step has nothing to draw: the mapping is empty")
    needed = "plot.step draws a Redesign, as redesign() returns, or a mapping of them"
    for redesign in several.values():
        _require(redesign, Redesign, needed)
    size = (7.2, 3.2 * len(several)) if len(several) > 1 else None
    axes = _axes(axes, len(several), size, sharex=True)
    ends = []
    for ax, (label, redesign) in zip(axes, several.items(), strict=True):
        ends.append(_step(ax, redesign))
        if label:
            ax.get_legend().set_title(label)
            ax.get_legend().set_alignment("left")
    for ax in axes:
        ax.set_xlim(0, max(ends))
        ax.set_xlabel("time after the step [s]" if ax is axes[-1] else "")
    return axes if isinstance(redesigns, Mapping) else axes[0]


def diagnosis(found: Diagnosis, axes: Any = None) -> Any:
    """Draw what a diagnosis found: the gap before and after, where it sits, and the ranking.

    From top to bottom: the measured output against the model before and after, on those samples
    kept back on which it erred most; the errors against the noise floor; RMS one-step errors along
    the two most telling quantities, in units of noise; and the evidence for each candidate, by
    rounds of the search.

    Parameters
    ----------
    found : Diagnosis
        From `diagnose`.
    axes : sequence of five matplotlib Axes, optional
        By default those of a new figure.

    Returns
    -------
    numpy.ndarray of matplotlib Axes
        The axes of the outputs, the errors, the two places and the ranking.

    Raises
    ------
    CtrlidError
        If something else than a diagnosis is given, or the number of axes differs.
    """
    _require(found, Diagnosis, "plot.diagnosis draws a Diagnosis, as diagnose() returns")
    rounds = _pictures.ranking(found)
    if axes is None:
        rows = max(sum(len(bars) + 1 for bars in rounds.values()), 3)
        height = 0.21 * rows + 0.9
        layout = [["output"] * 2, ["error"] * 2, ["first", "second"], ["ranking"] * 2]
        heights = [2.5, 1.9, 2.2, height]
        made = _new_figure((8.0, sum(heights))).subplot_mosaic(
            layout, gridspec_kw={"height_ratios": heights}
        )
        axes = list(made.values())
    axes = _axes(axes, 5)
    _gap(axes[0], axes[1], found)
    places = _pictures.two_places(found)
    for ax, place in zip(axes[2:4], [*places, None, None][:2], strict=True):
        _where(ax, place, found)
    _ranking(axes[4], rounds)
    return axes


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
    return _new_figure(size).subplots(rows, columns, squeeze=False, sharex=sharex)


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


def _new_figure(size: tuple[float, float]) -> Any:
    """Make a figure, through pyplot where the calling code has imported it and may show it."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__") == __name__:
        frame = frame.f_back
    pyplot = sys.modules.get("matplotlib.pyplot")
    inside = str(frame.f_globals.get("__name__", "")).split(".")[0] == __name__.split(".")[0]
    names = [*frame.f_globals.values(), *frame.f_locals.values()]
    # The package control imports pyplot as well, but it does not show our figures.
    if pyplot is not None and not inside and any(value is pyplot for value in names):
        return pyplot.figure(figsize=size, layout="constrained")
    return Figure(figsize=size, layout="constrained")


def _require(value: Any, kind: type, sentence: str) -> None:
    if not isinstance(value, kind):
        raise CtrlidError(f"{sentence}; given {type(value).__name__}")


def _axes(
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


def _line(i: int) -> dict[str, Any]:
    return {
        "color": COLOURS[i % len(COLOURS)],
        "linestyle": DASHES[i % len(DASHES)],
        "linewidth": 1.4,
    }


def _finish(ax: Any, *, legend: bool = True, columns: int = 2, size: str = "medium") -> Any:
    """Grid, open frame, and a legend above the axes, where it covers no data."""
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
    return ax


def _step(ax: Any, redesign: Redesign) -> float:
    """Draw the promised and the achieved response; return where the axis should end."""
    cases = (("promised on the model", redesign.promised, redesign.promised_step),
             ("achieved on the physics", redesign.achieved, redesign.achieved_step))  # fmt: skip
    for i, (what, performance, values) in enumerate(cases):
        if not performance.stable:
            label = f"{what}: UNSTABLE" + ("" if len(values) else ", the simulation breaks off")
        elif not np.isfinite(performance.settling_time):
            label = f"{what}: DOES NOT SETTLE"
        else:
            label = (f"{what}: {performance.overshoot:.0f} % overshoot, "
                     f"{performance.settling_time:.2g} s to settle")  # fmt: skip
        ax.plot(redesign.time[: len(values)], values, label=label, **_line(i),
                marker=MARKERS[i], markevery=max(len(values) // 25, 1), markersize=4)  # fmt: skip
    promised = redesign.promised_step
    restless = any(p.stable and not np.isfinite(p.settling_time) for _, p, _ in cases)
    reach = (1.5 if restless else 0.6) * max(float(np.ptp(promised)), 1e-12)
    low, high = ax.get_ylim()
    ax.set_ylim(max(low, promised.min() - reach), min(high, promised.max() + reach))
    settled = [t for t in (redesign.promised.settling_time, redesign.achieved.settling_time)
               if np.isfinite(t)]  # fmt: skip
    ax.set_ylabel("output per step\nof the reference [1]")
    _finish(ax, columns=1)
    last = float(redesign.time[-1])
    # Long enough to see the promise kept or broken, short enough to see how.
    return min(last, max(3 * max(settled), 20 * redesign.loop.dt)) if settled else last


BEFORE = {"color": COLOURS[1], "linestyle": "--", "linewidth": 1.4}
AFTER = {"color": COLOURS[0], "linestyle": "-", "linewidth": 1.4}
FILLS: dict[str, dict[str, Any]] = {
    "found": {"facecolor": COLOURS[0], "edgecolor": "k"},
    "not told apart": {"facecolor": COLOURS[5], "edgecolor": "k", "hatch": "////"},
    "refitted": {"facecolor": "0.75", "edgecolor": "0.3"},
    "not refitted": {"facecolor": "w", "edgecolor": "0.3", "linestyle": "--"},
}
GATE = 10.0  # difference in the Bayesian criterion that is strong evidence


def _gap(above: Any, below: Any, found: Diagnosis) -> None:
    """Draw the measured output against the model before and after, and the errors below."""
    gap, part = found.gap, _pictures.largest_gap(found.gap)
    t, y = gap.time[part], gap.measured[part]
    scale, unit = _pictures.scale([y], gap.unit)
    above.plot(t, scale * y, label="measured", **MEASURED)
    names = " and ".join(f.name for f in found.findings[:2])
    names += f" and {len(found.findings) - 2} more" if len(found.findings) > 2 else ""
    cases = [("before" if names else "recalibrated", gap.simulated_before, gap.before,
              BEFORE if names else AFTER)]  # fmt: skip
    if names:
        cases.append(("after", gap.simulated_after, gap.after, AFTER))
    errors = [y - values[part] for _, values, _, _ in cases]
    known = [e[np.isfinite(e)] for e in errors if np.isfinite(e).any()] or [np.zeros(1)]
    floored = np.isfinite(gap.floor) and gap.floor > 0
    fine, small = _pictures.scale([np.full(1, gap.floor)] if floored else known, gap.unit)
    if floored:
        below.axhspan(-2 * fine * gap.floor, 2 * fine * gap.floor, color="0.87", zorder=0,
                      label=f"±2 x noise floor, {fine * gap.floor:.3g} {small}")  # fmt: skip
    below.axhline(0, color="0.3", linewidth=0.8)
    for (label, values, size, style), error in zip(cases, errors, strict=True):
        rms = "none" if np.isnan(size) else f"RMS {fine * size:.3g} {small}"
        long = {"before": "recalibrated model", "after": f"with {names}"}.get(label, label)
        # A long prediction is made at some of the samples only.
        made = np.isfinite(error) if gap.kind.endswith("prediction") else slice(None)
        shown = scale * values[part]
        above.plot(t[made], shown[made], label=f"{gap.kind}, {long}", **style)
        below.plot(t[made], fine * error[made], label=f"{label}: {rms}", **style)
    _limit(above, scale * y)
    above.set_ylabel(f"output [{unit}]")
    below.set_ylabel(f"error [{small}]")
    below.set_xlabel(f"time [s], where the gap is largest among {len(gap.time)} samples kept back")
    for ax in (above, below):
        ax.set_xlim(t[0], t[-1])
        _finish(ax, columns=1 if ax is above else 3, size="small")


def _limit(ax: Any, y: Array) -> None:
    """Keep what was measured readable, wherever a wrong model goes."""
    span = float(np.ptp(y)) or 1.0
    low, high = ax.get_ylim()
    ax.set_ylim(max(low, y.min() - 0.8 * span), min(high, y.max() + 0.8 * span))


def _where(ax: Any, place: Place | None, found: Diagnosis) -> None:
    """Draw the RMS of the one-step errors along one quantity, before and after."""
    if place is None:
        ax.text(0.5, 0.5, "no place is known", ha="center", va="center", transform=ax.transAxes)
        ax.set_axis_off()
        return
    at, before, after = np.arange(len(place.before)), np.sqrt(place.before), np.sqrt(place.after)
    both = bool(found.findings)
    solid = {"facecolor": COLOURS[0], "edgecolor": COLOURS[0], "linewidth": 0.8}
    if both:
        ax.bar(at + 0.3, before, 0.4, label="before", facecolor="w", edgecolor=COLOURS[1],
               hatch="//////", linewidth=0.8)  # fmt: skip
        ax.bar(at + 0.7, after, 0.4, label="after", **solid)
    else:
        ax.bar(at + 0.5, before, 0.8, label="recalibrated", **solid)
    ax.axhline(1, color="k", linewidth=1.2, linestyle=":", label="noise")
    labels, title = _pictures.bin_labels(place)
    every = -(-len(at) // 5)
    ax.set_xlim(0, len(at))
    ax.set_xlabel(title)
    ax.set_ylabel("one-step RMS error /\nthat of noise [1]")
    top = float(np.nanmax([*before, *after, 1.0]))
    _finish(ax, columns=3, size="small")
    if top > 10:
        ax.set_yscale("log")
    else:
        ax.set_ylim(0, 1.1 * top)
    ax.set_xticks(np.arange(len(labels))[::every], labels[::every])


def _ranking(ax: Any, rounds: Mapping[int, Sequence[_pictures.Bar]]) -> None:
    """Draw the evidence for each candidate as bars, round below round."""
    labels, row, drawn = [], 0, set()
    top = max((bar.evidence for bars in rounds.values() for bar in bars), default=0.0)
    for number, bars in rounds.items():
        ax.text(0.0, row, f" round {number}", ha="left", va="center", style="italic",
                fontsize="small", transform=ax.get_yaxis_transform())  # fmt: skip
        labels.append("")
        row += 1
        for bar in bars:
            ax.barh(row, bar.evidence, 0.72, linewidth=0.7, **FILLS[bar.kind],
                    label=None if bar.kind in drawn else bar.kind)  # fmt: skip
            ax.annotate(f"{bar.evidence:.0f}", (max(bar.evidence, 0.0), row), (3, 0), va="center",
                        textcoords="offset points", fontsize="x-small")  # fmt: skip
            drawn.add(bar.kind)
            labels.append(bar.label)
            row += 1
    if not rounds:
        ax.text(0.5, 0.5, "no candidate was tried", ha="center", transform=ax.transAxes)
    ax.axvline(GATE, color="k", linewidth=1, linestyle="--", label="strong")
    ax.axvline(0, color="0.3", linewidth=0.8)
    ax.set_xscale("symlog", linthresh=GATE)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.set_xlim(_pictures.LEAST, 3 * max(top, 2 * GATE))
    ax.set_yticks(range(row), labels, fontsize="small")
    ax.tick_params(axis="y", length=0)
    ax.set_ylim(row - 0.4, -0.6)
    ax.set_xlabel("gain by the Bayesian criterion (BIC), twice the evidence less the penalty [1]")
    _finish(ax, columns=5, size="small")
    ax.grid(False, axis="y")


def _trace(ax: Any, record: Record, values: Array, i: int, label: str, held: bool = False) -> None:
    """Draw one signal over time, or the band it fills where there are more samples than pixels."""
    n = len(record)
    if n <= 2 * BINS:
        where = "steps-post" if held else "default"
        style = {**_line(i), "linestyle": DASHES[i == 1]}  # two signals share the first axes only
        ax.plot(record.t, values, drawstyle=where, label=label.strip(), **style)
        return
    bounded = held and i == 1  # of the reference the border alone, so that the output shows through
    edges = np.linspace(0, n, (BINS // 15 if bounded else BINS) + 1).astype(int)[:-1]
    low, high = np.minimum.reduceat(values, edges), np.maximum.reduceat(values, edges)
    t, label = record.t[edges], f"{label.strip()}, range"
    if bounded:
        ax.step(t, high, where="post", label=label, **_line(i))
        ax.step(t, low, where="post", **_line(i))
        return
    ax.fill_between(t, low, high, color=COLOURS[i], alpha=0.55, linewidth=0.4, label=label)


def _shade(ax: Any, record: Record) -> None:
    """Shade the stretches that do not count."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], ~record.valid, [0]]).astype(int)))
    for k, (start, stop) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
        t0, t1 = (record.start + i * record.dt for i in (start, stop))
        ax.axvspan(t0, t1, facecolor="0.88", hatch="///", edgecolor="0.6", linewidth=0, zorder=0,
                   label=None if k else "does not count")  # fmt: skip


def _view(ax: Any, places: Any) -> None:
    """Choose limits that hold all places, of the same scale in both directions."""
    low, high = places.real.min(), places.real.max()
    tall = np.abs(places.imag).max()
    pad = 0.15 * max(high - low, tall, 0.1 * max(abs(high), abs(low)))
    half = max(tall + pad, 0.25 * (high - low + 2 * pad))
    width = max(high - low + 2 * pad, 4 * half)
    middle = 0.5 * (low + high)
    ax.set_xlim(middle - width / 2, middle + width / 2)
    ax.set_ylim(-half, half)
    ax.set_aspect("equal", adjustable="box")


def _degrees(ax: Any) -> None:
    """Put the ticks of a phase at parts of a right angle."""
    low, high = ax.get_ylim()
    step = next((s for s in (1, 5, 15, 30, 45, 90) if high - low <= 7 * s), 180)
    ax.yaxis.set_major_locator(MultipleLocator(step))
