"""Pictures: units and legends that say what is drawn, refusals in words, nothing global changed."""

from dataclasses import replace
from types import ModuleType

import control as ct
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

import ctrlid as cid
from ctrlid import plot
from ctrlid.reporting import pictures as _pictures
from ctrlid.reporting.plot import findings
from ctrlid.reporting.plot.axes import COLOURS
from ctrlid.reporting.tables import make_blocks
from problems import legend, record_of, redesigned_levitation, servo

DT = 0.01


@pytest.fixture(scope="module")
def loop():
    return servo(dt=DT)


@pytest.fixture(scope="module")
def record(loop):
    made = record_of(loop, swing=0.1, hold=50, n=1000, seed=1, sensor_noise=2e-3)
    return replace(made, units={"r": "m", "u": "V", "y": "m"})


@pytest.fixture(scope="module")
def comparison(record, loop):
    return cid.compare(record, loop)


@pytest.fixture(scope="module")
def outcome():
    return redesigned_levitation()


def labels(ax):
    return ax.get_xlabel(), ax.get_ylabel()


def test_no_setting_of_matplotlib_is_changed(record, comparison):
    before = dict(mpl.rcParams)
    plot.record(record)
    plot.png(plot.comparison(comparison))
    assert dict(mpl.rcParams) == before


def test_pyplot_saves_and_closes_what_was_drawn_last(record, tmp_path):
    picture = plot.record(record)
    # A user may import pyplot after the call, and then save.
    import matplotlib.pyplot as plt

    assert plt.gcf() is picture.figure
    plt.savefig(tmp_path / "pyplot.png")
    picture.figure.savefig(tmp_path / "own.png")
    assert (tmp_path / "pyplot.png").read_bytes() == (tmp_path / "own.png").read_bytes()
    other = plot.record(record)
    assert plt.get_fignums() == [picture.figure.number, other.figure.number]
    plt.close(other.figure)
    assert plt.gcf() is picture.figure


def test_an_empty_figure_is_drawn_on_as_python_control_does(record):
    import matplotlib.pyplot as plt

    wide = plt.figure(figsize=(12, 5))
    assert plot.record(record).figure is wide
    assert plot.record(record).figure is not wide
    assert len(plt.get_fignums()) == 2


def test_files_leave_no_figures_open(record, tmp_path):
    import matplotlib.pyplot as plt

    cid.write_report(record, tmp_path / "r.html")
    assert plt.get_fignums() == []


def test_a_picture_shows_itself(record):
    picture = plot.record(record)
    assert repr(picture) == "Picture with 2 axes"
    assert picture._repr_png_() == plot.png(picture, dpi=100)
    assert [ax.figure for ax in picture] == [picture.figure] * len(picture)
    assert picture[0] is picture.axes[0]
    assert repr(plot.poles(ct.tf(1, [1, 1]))) == "Picture with 1 axis"


def test_every_picture_takes_axes_by_the_same_name(record, comparison, outcome):
    G = ct.tf(1, [1, 1])
    pictures = ((plot.record, record), (plot.comparison, comparison), (plot.poles, G),
                (plot.residuals, comparison), (plot.bode, G), (plot.step, outcome))  # fmt: skip
    for draw, what in pictures:
        axes = draw(what).axes
        with plot.axes.off_screen():
            own = plot.figure(len(axes))
        for given in (own, own.axes[:, 0], list(own.axes[:, 0])):
            picture = draw(what, ax=given)
            assert list(picture.axes) == list(own.axes[:, 0])
            assert picture.figure is own.figure
        if len(axes) == 1:
            assert draw(what, ax=own[0, 0]).axes[0] is own[0, 0]


def test_record_has_names_and_units(record):
    top, bottom = plot.record(record)
    assert top.get_ylabel() == f"{record.names['y']} [m]"
    assert bottom.get_ylabel().endswith("[V]")
    assert bottom.get_xlabel() == "time [s]"
    assert [text.split()[0] for text in legend(top)] == ["measured", "reference"]
    assert legend(bottom)[0].startswith("input")


def test_record_says_where_no_unit_is_known(record):
    top, bottom = plot.record(replace(record, units={}))
    assert top.get_ylabel().endswith("[unit not given]")
    assert bottom.get_ylabel().endswith("[unit not given]")


@pytest.mark.parametrize(
    ("size", "unit", "expected"),
    [(0.03, "m", (1e3, "mm")), (7.5, "V", (1, "V")), (2e-5, "m", (1e6, "µm")),
     (3e-9, "A", (1e9, "nA")), (0.03, "rad", (1, "rad")), (0.0, "m", (1, "m"))],
)  # fmt: skip
def test_units_get_the_prefix_people_use(size, unit, expected):
    factor, text = _pictures.choose_scale([np.array([-size, 0.0])], unit)
    assert (pytest.approx(factor), text) == expected


def test_record_without_reference_and_with_extra_channels(record):
    made = cid.Record(
        u=record.u, y=record.y, dt=DT, extra={"current": record.u}, units={"current": "A"}
    )
    axes = plot.record(made, extra="current")
    assert len(axes) == 3
    assert axes[2].get_ylabel() == "current [A]"
    assert legend(axes[0]) == ["measured y"]
    with pytest.raises(cid.CtrlidError, match=r"no extra channel 'speed'; it has current"):
        plot.record(made, extra=["speed"])


def test_a_reference_of_no_output_has_axes_of_its_own():
    t = np.arange(200) * 0.01
    made = cid.Record(r=np.sign(np.sin(t)), u=0 * t, y=[np.sin(t), np.cos(t)], dt=0.01,
                      names={"r": ("xd[0]",), "y": ("x", "theta")})  # fmt: skip
    axes = plot.record(made)
    assert [ax.get_ylabel().split()[0] for ax in axes] == ["x", "theta", "xd[0]", "u"]
    assert legend(axes[2]) == ["reference xd[0]"]
    assert len(plot.record(replace(made, names={"r": ("theta",), "y": ("x", "theta")}))) == 3


def test_long_records_keep_every_peak():
    n = 45_000
    y = np.zeros(n)
    y[12_345] = 1.0
    r = np.where(np.arange(n) // 100 % 2, 0.2, -0.2)
    top, bottom = plot.record(cid.Record(r=r, u=y, y=y, dt=0.005))
    assert all("range" in text for text in (*legend(top), *legend(bottom)))
    for ax in (top, bottom):
        band = ax.collections[0].get_paths()[0].vertices
        assert band[:, 1].max() == 1.0
        assert len(band) < 4 * 1600
    high, low = (line.get_ydata() for line in top.get_lines())
    assert set(high) == {0.2}
    assert set(low) == {-0.2}


def test_stretches_that_do_not_count_are_shaded(record):
    valid = np.ones(len(record), bool)
    valid[100:200] = valid[500:600] = False
    top, bottom = plot.record(replace(record, valid=valid))
    for ax in (top, bottom):
        spans = [patch.get_x() for patch in ax.patches]
        assert spans == pytest.approx([1.0, 5.0])
        assert legend(ax).count("does not count") == 1


def test_given_axes_are_drawn_on_and_returned(record, comparison):
    axes = plot.figure(2, 2)
    assert list(plot.record(record, axes[:, 0])) == list(axes[:, 0])
    assert plot.comparison(comparison, axes[0, 1]).axes[0] is axes[0, 1]
    with pytest.raises(cid.CtrlidError, match="needs 2 matplotlib Axes; given 1"):
        plot.record(record, axes[0, 0])
    with pytest.raises(cid.CtrlidError, match="needs 1 matplotlib Axes; given 1: str"):
        plot.comparison(comparison, "here")


def test_axes_of_ones_own_in_the_same_style():
    with mpl.rc_context(plot.style()):
        ax = plot.figure()[0, 0]
        lines = [ax.plot([0, 1], [k, k])[0] for k in range(len(COLOURS))]
    assert tuple(line.get_color() for line in lines) == COLOURS
    assert len({str(line._dash_pattern) for line in lines}) == len(lines)
    assert not ax.spines["top"].get_visible()


def test_comparison_labels_every_curve(comparison):
    (ax,) = plot.comparison(comparison)
    text = legend(ax)
    assert text[0].startswith("measured")
    assert len(text) == 1 + len(comparison.curves)
    for label, curve in zip(text[1:], comparison.curves, strict=True):
        assert label == f"{curve.label}: fit {curve.fit:.1f} %"
        assert "prediction" in label or "simulation" in label
    assert ax.get_ylabel().endswith("m]")
    assert ax.get_xlabel().startswith("time [s], ")
    assert ax.get_xlabel().endswith("of a record from 0 to 10 s")


def test_jitter_of_the_time_stamps_is_not_told(comparison):
    """A log whose stamps were not perfectly even gave "a record from -7e-06 to 10 s"."""
    moved = replace(comparison, record=replace(comparison.record, start=-7e-6))
    (ax,) = plot.comparison(moved)
    assert ax.get_xlabel().endswith("of a record from 0 to 10 s")
    with pytest.raises(cid.CtrlidError, match="the record runs from 0 to 10 s"):
        moved.record.between(20, 30)
    late = replace(comparison, record=replace(comparison.record, start=1234.565))
    (ax,) = plot.comparison(late)
    assert ax.get_xlabel().endswith("of a record from 1234.565 to 1244.565 s")


def test_comparison_window(comparison):
    (ax,) = plot.comparison(comparison, window=(2, 3))
    t = ax.get_lines()[0].get_xdata()
    assert (t[0], len(t)) == (pytest.approx(2), 100)
    with pytest.raises(cid.CtrlidError, match="fewer than 2 samples lie between 20 and 30 s"):
        plot.comparison(comparison, window=(20, 30))


def test_default_window_is_lively_and_usual(comparison):
    y = np.array(comparison.record.y)
    y[:700] = y[0]
    moved = replace(comparison, record=replace(comparison.record, y=y))
    assert _pictures.find_telling_window(moved) > 400
    short = replace(comparison, record=comparison.record[:100])
    assert _pictures.find_telling_window(short) == 0


def test_a_curve_far_away_leaves_the_measurement_readable(comparison):
    far = replace(comparison.curves[-1], y=comparison.curves[-1].y + 100)
    (ax,) = plot.comparison(replace(comparison, curves=(*comparison.curves[:-1], far)))
    assert legend(ax)[-1].endswith("outside this picture")
    low, high = ax.get_ylim()
    assert high - low < 3 * 1e3 * np.ptp(comparison.record.y)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_curve_not_so_far_away_is_seen_in_part(comparison, side):
    """It lay outside, or only its tip was seen, while the measured curve had height to spare."""
    last, span = comparison.curves[-1], float(np.ptp(comparison.record.y[:300]))
    for size in (1.5, 2.0):
        near = replace(last, y=last.y + side * size * span)
        moved = replace(comparison, curves=(*comparison.curves[:-1], near))
        (ax,) = plot.comparison(moved, window=(0, 3))
        assert not any("outside" in text for text in legend(ax))
        low, high = ax.get_ylim()
        values = ax.get_lines()[3].get_ydata()
        assert np.mean((low < values) & (values < high)) >= 0.25
        assert np.ptp(ax.get_lines()[0].get_ydata()) >= 0.25 * (high - low)


def test_a_line_from_below_to_above_the_picture_is_seen(comparison):
    wild = np.where(np.arange(len(comparison.record)) % 2, 100.0, -100.0)
    curves = (replace(comparison.curves[-1], y=wild),)
    (ax,) = plot.comparison(replace(comparison, curves=curves))
    assert not any("outside" in text for text in legend(ax))


def test_predictions_of_every_few_samples_are_connected(comparison):
    curve = comparison.curves[1]
    sparse = np.where(np.arange(len(curve.y)) % 3 == 0, curve.y, np.nan)
    (ax,) = plot.comparison(replace(comparison, curves=(replace(curve, y=sparse),)), window=(2, 5))
    assert np.isfinite(ax.get_lines()[1].get_ydata()).all()


def test_residuals_have_bands_and_verdicts(comparison):
    axes = plot.residuals(comparison)
    assert len(axes) == len(comparison.tests) == 3
    for ax, test in zip(axes, comparison.tests, strict=True):
        assert ax.get_ylabel() == "correlation [1]"
        assert ax.get_title(loc="left").startswith(f"one-step errors {test.name}: ")
        assert ax.patches[0].get_y() == pytest.approx(-test.band)
    assert axes[-1].get_xlabel() == "lag [samples]"
    assert "99 % band" in legend(axes[0])


def test_residuals_mark_what_is_no_chance(comparison):
    test = comparison.tests[0]
    bad = replace(test, values=np.full_like(test.values, 0.5), p_value=1e-20)
    endless = replace(test, band=np.inf)
    axes = plot.residuals(replace(comparison, tests=(bad, endless)))
    assert axes[0].get_title(loc="left").endswith("NOT BY CHANCE (p < 0.0001)")
    assert "outside" in legend(axes[0])
    assert not axes[1].patches


def test_poles_in_the_z_plane():
    P = ct.tf(-2.6, [1, 0, -654])
    G = ct.tf([1, 1], [1, -2.01, 1], 0.005)
    (ax,) = plot.poles({"fit": G}, truth=P)
    assert labels(ax) == ("real part of z [1]", "imaginary part of z [1]")
    outer, inner = (np.exp(s * np.sqrt(654) * 0.005) for s in (1, -1))
    assert legend(ax) == ["fit: 1.105, 0.9049", f"physics: {outer:.4g}, {inner:.4g}"]
    assert ax.get_xlim()[0] < 0.9 < 1.0 < 1.14 < ax.get_xlim()[1]


def test_poles_of_a_fit_are_those_of_its_estimate(record):
    G = cid.fit_arx(record, na=2, nb=2)
    assert len(legend(plot.poles({"fit": G})[0])) == 1


TWO_INPUTS = ct.ss(np.zeros((1, 1)), np.zeros((1, 2)), np.zeros((1, 1)), np.zeros((1, 2)))


def test_frequency_response_is_that_of_one_signal():
    with pytest.raises(cid.CtrlidError, match="'a' must have one input and one output"):
        plot.bode({"a": TWO_INPUTS})


def test_band_that_reaches_zero_goes_down_without_end(monkeypatch):
    u, y = np.random.default_rng(4).standard_normal((2, 200))
    model = cid.fit_arx(cid.Record(u=u, y=y, dt=0.1), 1, 1)

    def find_wide_band(*given):
        band = cid.response_band(*given)
        return replace(band, magnitude_low=0 * band.magnitude_low)

    monkeypatch.setattr("ctrlid.reporting.plot.models.response_band", find_wide_band)
    low, high = plot.bode({"noise": model}).axes[0].get_ylim()
    assert np.isfinite([low, high]).all()


def test_poles_of_several_signals_and_a_single_one_at_the_origin():
    for model in (TWO_INPUTS, ct.tf(1, [1, 0])):
        (ax,) = plot.poles({"a": model})
        assert legend(ax) == ["a: 0"]


def test_poles_in_the_s_plane():
    (ax,) = plot.poles({"a": ct.tf(1, [1, 2, 10]), "b": ct.tf(1, [1, 0])})
    assert labels(ax) == ("real part of s [rad/s]", "imaginary part of s [rad/s]")
    assert legend(ax) == ["a: -1±3j", "b: 0"]


@pytest.mark.parametrize("draw", [plot.poles, plot.bode])
@pytest.mark.parametrize(
    ("models", "words"),
    [({}, "at least one model"), ([1], "takes a mapping from labels to models"),
     ({"a": 3}, "'a' must be a TransferFunction or StateSpace; given int")],
)  # fmt: skip
def test_models_are_checked(draw, models, words):
    with pytest.raises(cid.CtrlidError, match=words):
        draw(models)


@pytest.mark.parametrize("draw", [plot.poles, plot.bode])
def test_one_model_needs_no_label(draw):
    ax = draw(ct.tf(1, [1, 0.5], name="tank"))[0]
    assert legend(ax)[0].startswith("tank")


def test_poles_that_do_not_compare_are_refused():
    one, other = ct.tf(1, [1, 0.5], 0.1), ct.tf(1, [1, 0.5], 0.2)
    with pytest.raises(cid.CtrlidError, match=r"different sampling periods .*a: 0.1 s, b: 0.2 s"):
        plot.poles({"a": one, "b": other})
    with pytest.raises(cid.CtrlidError, match="none of the models has a pole"):
        plot.poles({"gain": ct.tf(2, 1)})


def test_bode_ends_at_the_nyquist_frequency():
    G = ct.tf([1, 1], [1, -2.01, 1], 0.005)
    magnitude, phase = plot.bode({"P": ct.tf(-2.6, [1, 0, -654]), "G": G})
    assert magnitude.get_ylabel() == "magnitude [dB]"
    assert labels(phase) == ("frequency [rad/s]", "phase [deg]")
    assert legend(magnitude) == ["P", "G", "Nyquist frequency"]
    drawn = magnitude.get_lines()[1].get_xdata()
    assert 0.9 * np.pi / 0.005 < drawn[-1] < np.pi / 0.005


def test_bode_phase_runs_on_without_jumps():
    lag = ct.tf(1, [1, 0.1, 1])
    _, phase = plot.bode({"four lags": lag**4, "one": lag}, omega=np.geomspace(0.01, 100, 2000))
    first, second = (line.get_ydata() for line in phase.get_lines())
    assert (first[0], first[-1]) == (pytest.approx(0, abs=2), pytest.approx(-720, abs=2))
    assert second[-1] == pytest.approx(-180, abs=2)
    assert np.abs(np.diff(first)).max() < 90


def test_bode_starts_on_the_usual_sheet():
    _, phase = plot.bode({"double integrator": ct.tf(1, [1, 0, 0])})
    assert phase.get_lines()[0].get_ydata()[0] == pytest.approx(-180)
    _, phase = plot.bode({"minus": ct.tf(-1, [1, 1])}, omega=[1e-4, 1.0])
    assert phase.get_lines()[0].get_ydata()[0] == pytest.approx(-180, abs=0.1)


def test_bode_magnitude_is_that_of_the_model():
    magnitude, _ = plot.bode({"gain": ct.tf(10, 1), "sampled gain": ct.tf(1, 1, 0.1)})
    assert magnitude.get_lines()[0].get_ydata() == pytest.approx(20)


@pytest.mark.parametrize("omega", [[1.0], [0.0, 1.0], [-1.0, 2.0], [1.0, np.nan]])
def test_bode_refuses_frequencies(omega):
    with pytest.raises(cid.CtrlidError, match="two positive frequencies in rad/s"):
        plot.bode({"a": ct.tf(1, [1, 1])}, omega=omega)


def test_bode_leaves_out_a_model_sampled_too_slowly_for_the_frequencies():
    slow = ct.tf(1, [1, 0.5], 1.0)
    magnitude, _ = plot.bode({"slow": slow, "P": ct.tf(1, [1, 1])}, omega=[10, 100])
    assert legend(magnitude) == ["P", "Nyquist frequency"]


def test_step_shows_promise_and_achievement(outcome):
    (ax,) = plot.step(outcome)
    assert labels(ax) == ("time after the step [s]", "output per step\nof the reference [1]")
    promised, achieved = legend(ax)
    assert promised.startswith(
        f"promised on the model: {outcome.promised.overshoot:.0f} % overshoot"
    )
    assert achieved.startswith("achieved on the physics: ")


def test_step_says_when_the_physics_is_lost(outcome):
    lost = replace(outcome.achieved, stable=False)
    (ax,) = plot.step(replace(outcome, achieved=lost, achieved_step=outcome.achieved_step[:4]))
    assert (
        legend(ax)[1]
        == f"achieved on the physics: UNSTABLE, the simulation stops after {outcome.time[4]:.2g} s"
    )
    assert len(ax.lines[1].get_ydata()) == 4
    never = replace(outcome.promised, settling_time=np.inf)
    endless = replace(outcome, promised=never, achieved=never)
    assert plot.step(endless)[0].get_xlim()[1] >= outcome.time[-1]


def test_step_draws_redesigns_by_their_labels_over_one_time(outcome):
    longer = replace(outcome, achieved=replace(outcome.achieved, settling_time=outcome.time[-1]))
    axes = plot.step({"first": outcome, "second": longer})
    legends = [ax.get_legend() for ax in axes]
    assert [legend.get_title().get_text() for legend in legends] == ["first", "second"]
    assert [ax.get_xlabel() for ax in axes] == ["", "time after the step [s]"]
    assert axes[0].get_xlim() == axes[1].get_xlim() == (0, plot.step(longer)[0].get_xlim()[1])
    restless = replace(outcome, achieved=replace(outcome.achieved, settling_time=np.inf))
    _, achieved = plot.step(restless)[0].get_legend().get_texts()
    assert achieved.get_text() == "achieved on the physics: DOES NOT SETTLE"
    with pytest.raises(cid.CtrlidError, match="the mapping is empty"):
        plot.step({})
    with pytest.raises(cid.CtrlidError, match="or a mapping of them; given int"):
        plot.step({"first": 3})
    with pytest.raises(cid.CtrlidError, match=r"draw that with plot.record\(simulate\(loop, r\)\)"):
        plot.step({"old": outcome.loop, "new": outcome})


@pytest.mark.parametrize(
    ("draw", "words"),
    [(plot.record, "plot.record draws a Record; given int"),
     (plot.comparison, "draws a Comparison, as compare"), (plot.residuals, "draws a Comparison"),
     (plot.step, "plot.step draws a Redesign, as redesign")],
)  # fmt: skip
def test_wrong_results_are_refused(draw, words):
    with pytest.raises(cid.CtrlidError, match=words):
        draw(3)


def test_png_of_figures_and_axes(record):
    axes = plot.record(record)
    for drawn in (axes, axes[0], axes[0].figure):
        assert plot.png(drawn, dpi=50).startswith(b"\x89PNG")
    assert plot.png(axes, dpi=50) == plot.png(axes, dpi=50)
    for wrong in (3, [], None):
        with pytest.raises(cid.CtrlidError, match=r"png\(\) takes a figure or axes"):
            plot.png(wrong)
    assert isinstance(axes[0].figure, Figure)


def test_only_what_draws_is_listed():
    assert dir(cid.plot) == sorted(cid.plot.__all__)
    assert not [name for name in dir(cid.plot) if isinstance(getattr(cid.plot, name), ModuleType)]


@pytest.mark.parametrize(
    ("edges", "ticks"),
    [
        ([-40.0, -3.63, 5.0, 30.0, 400.0], [-40.0, 0.0, 30.0, 400.0]),
        ([-900.0, -10.0, 0.0, 10.0, 900.0], [-900.0, -10.0, 0.0, 10.0, 900.0]),
    ],
)
def test_ticks_keep_apart(edges, ticks):
    ax = Figure().subplots()
    ax.set_xscale("symlog", linthresh=max(abs(edges[1]), abs(edges[-2])))
    assert findings._space_ticks(ax, np.array(edges)) == ticks


def test_a_picture_is_saved_as_a_figure_is(tmp_path):
    record = cid.Record(u=[0, 1, 0, 1], y=[0, 0, 1, 1], dt=0.1)
    cid.plot.record(record).savefig(tmp_path / "record.png", dpi=40)
    assert (tmp_path / "record.png").read_bytes().startswith(b"\x89PNG")


@pytest.fixture
def dropout(record):
    """The record with a dropout of the sensor that is marked, and far from all else."""
    y, valid = np.array(record.y), np.ones(len(record), bool)
    y[100:110], valid[100:110] = 1e6, False
    return replace(record, y=y, valid=valid)


def test_a_dropout_that_does_not_count_sets_no_scale(dropout, record):
    """A dropout of 1e6 made flat lines of all others, and the mean of the table 5000."""
    ax = plot.record(dropout).axes[0]
    assert ax.get_ylabel() == plot.record(record).axes[0].get_ylabel()
    low, high = ax.get_ylim()
    assert high - low < 3 * 1e3 * np.ptp(record.y)
    assert "1e+06" not in repr(dropout)
    table = make_blocks(dropout)[0]
    row = next(row for row in table.rows if row[0] == "x")
    assert float(row[4]) == pytest.approx(dropout.y[dropout.valid].max(), rel=1e-5)
    assert "whose numbers are these" in table.caption


def test_a_dropout_leaves_a_comparison_readable(dropout):
    loop = servo(5.0, dt=dropout.dt)
    ax = plot.comparison(cid.compare(dropout, loop), window=(dropout.start, dropout.t[-1])).axes[0]
    low, high = ax.get_ylim()
    assert high - low < 20 * 1e3 * np.ptp(dropout.y[dropout.valid])


def test_a_reference_in_another_unit_has_axes_of_its_own(record):
    volts = replace(record, r=10 * np.sign(record.r), units={**record.units, "r": "V", "y": "m"})
    labels = [ax.get_ylabel() for ax in plot.record(volts).axes]
    assert len(labels) == 3
    assert labels[1] == "r [V]"


def test_many_poles_stay_in_the_figure():
    """The legend of twenty poles ran off the page and left the axes no room."""
    rng = np.random.default_rng(0)
    roots = 0.9 * np.exp(1j * rng.uniform(0.1, 3, 10))
    models = {"order 20": ct.tf(1, np.real(np.poly(np.r_[roots, roots.conj()])), 0.1),
              "order 3": ct.tf(1, np.poly([0.5, 0.2, -0.3]), 0.1)}  # fmt: skip
    picture = plot.poles(models)
    picture.figure.draw_without_rendering()
    first, second = legend(picture.axes[0])
    assert first.endswith("and 4 more")
    assert first.count("±") == 6
    assert second == "order 3: 0.5, 0.2, -0.3"
    box = picture.axes[0].get_legend().get_window_extent()
    page = picture.figure.bbox
    assert (page.x0 <= box.x0, box.x1 <= page.x1, box.y1 <= page.y1) == (True, True, True)
