"""Replay of controllers, audit and compare for loops of several inputs and outputs."""

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid.reporting.tables import _make_comparison_tables
from test_wiring import CART, DT, QUAD, at_rest, lqr_with_observer, luenberger

NOISE = {"sensor_noise": (1e-4, 1e-3), "force_noise": (0.05, 0.001)}


@pytest.fixture(scope="module")
def dithered():
    """A cart with a pole under an observer, white dither added to its force."""
    loop = cid.Loop(CART, luenberger(CART), dt=DT, at=at_rest(CART))
    d = 0.05 * np.random.default_rng(3).standard_normal(1000)
    return loop, cid.simulate(loop, d=d, **NOISE, seed=2), d


def test_replay_of_an_observer_is_exact():
    loop = cid.Loop(CART, lqr_with_observer(CART), dt=DT, at=at_rest(CART))
    r = cid.random_binary(400, amplitude=0.05, hold=100, seed=1)
    record = cid.simulate(loop, {"xd[0]": r}, **NOISE, seed=2)
    assert np.max(np.abs(cid.replay_controller(loop, record) - record.u)) < 1e-9
    found = cid.audit(record, loop)
    assert "exactly what the controller" in found["controller"][0].text


def test_replay_with_several_inputs_and_no_reference():
    C = lqr_with_observer(QUAD, weights=[10.0, 10, 10, 1, 1, 1])
    loop = cid.Loop(QUAD, C, dt=DT, at=at_rest(QUAD))
    d = 0.1 * np.random.default_rng(4).standard_normal((2, 400))
    record = cid.simulate(loop, d=d, sensor_noise=1e-4, seed=5)
    replayed = cid.replay_controller(loop, record)
    assert replayed.shape == (2, 400)
    # What the unknown state of the observer takes of the dither dies out.
    assert np.max(np.abs((record.u - replayed - d)[:, 200:])) < 0.02


def test_audit_tells_dither_from_a_wrong_law(dithered):
    loop, record, _ = dithered
    assert "that does not depend on the outputs" in cid.audit(record, loop)["controller"][0].text
    C = loop.controller
    wrong = ct.ss(C.A, C.B, 2 * C.C, C.D, DT, inputs=C.input_labels, outputs=C.output_labels)
    found = cid.audit(record, cid.Loop(CART, wrong, dt=DT, at=at_rest(CART)))
    assert found["unknown"]
    assert found["unknown"][0].harmful


def test_audit_names_the_signal(dithered):
    _, record, _ = dithered
    y = np.array(record.y)
    y[1] = np.round(y[1] / 1e-3) * 1e-3
    y[0, 300] += 0.1
    r = np.sin(0.01 * np.arange(len(record)) * np.array([[1.0], [1.3]]))
    found = cid.audit(cid.Record(r=r, u=record.u, y=y, dt=DT,
                                 names={**record.names, "r": ("x", "theta")}))  # fmt: skip
    assert found["quantization"][0].channel == "theta"
    assert found["quantization"][0].text.startswith("theta is quantized in steps of ")
    assert all(f.text.startswith(f"{f.channel} ") for f in found["outliers"])
    assert {f.text.split(" has ")[0] for f in found["repeats"]} <= {
        "the reference x", "the reference theta"
    }  # fmt: skip
    assert found["outliers"][0].channel == "x"
    assert found.quantum["theta"] == pytest.approx(1e-3)


def test_compare_reproduces_each_output(dithered):
    loop, record, _ = dithered
    found = cid.compare(record, loop)
    assert [c.what for c in found.outputs] == ["x", "theta"]
    assert found["closed-loop simulation of theta"].noise_share > 0.5
    assert all(t.passed for t in found.tests)
    assert found.residuals.shape == (2, len(record))
    assert found["one-step prediction of x"].rms == pytest.approx(1e-4, rel=0.1)
    assert found.verdict.startswith("x: ")
    assert "theta: " in str(found)


def test_compare_sees_a_wrong_plant(dithered):
    loop, record, _ = dithered
    found = cid.compare(loop.with_parameters({"m": 0.4}), record)
    assert "SOMETHING IS MISSING" in found.verdict
    with pytest.raises(cid.CtrlidError, match="pick one with"):
        cid.compare(record, ct.tf([1], [1, 1]))


def test_pictures_and_report_of_several_outputs(dithered, tmp_path):
    """Each raised numpy's or matplotlib's own error, or spoke of a picture nobody had asked for."""
    loop, record, _ = dithered
    found = cid.compare(record, loop)
    for window in (None, (0.0, 1.0)):
        picture = cid.plot.comparison(found, window=window)
        labels = [ax.get_ylabel() for ax in picture.axes]
        assert [text.split()[0] for text in labels] == list(loop.signals["y"])
        assert all("fit" in ax.get_legend_handles_labels()[1][1] for ax in picture.axes)
    fitted = cid.fit_loop(loop, record, free=("M",))
    assert cid.plot.poles({"fitted": fitted.model}).axes[0].lines
    rows = cid.fit_arx(record, 4, 4)
    page = cid.write_report([record, fitted, found, rows], tmp_path / "page.html").read_text(
        "utf-8"
    )
    for words in ("Poles of the fitted physics", "Poles of each output", "<h3>theta</h3>",
                  "Measured output, predictions and simulations"):  # fmt: skip
        assert words in page


def test_each_error_of_several_outputs_has_its_unit(dithered):
    """Millimetres and degrees stood below each other without a unit."""
    loop, record, _ = dithered
    found = cid.compare(record, loop)
    for curve in found.curves:
        unit = "rad" if curve.label.endswith("theta") else "m"
        assert curve.unit == unit
        assert f"RMS error {curve.rms:.3e} {unit}" in str(curve)
        assert f" {curve.rms:.3e} {unit} " in str(found)
    assert "RMS error [m]" in str(found.outputs[0])
    assert "RMS error [" not in str(found)
    table = _make_comparison_tables(found)[0]
    assert table.head[2] == "RMS error"
    assert table.rows[0][2].endswith(" m")
