"""compare(): identities, labels, and a verdict in words for right, wrong and unknown models.

Groups: exact loops; noise; wrong models; transfer functions; stretches and missing references;
texts; refusals; real logs.
"""

from dataclasses import replace

import control as ct
import numpy as np
import pytest
from scipy import signal

import ctrlid as cid
from ctrlid import CtrlidError
from ctrlid.diagnosis.gap import make_window, simulate_window
from ctrlid.estimation.likelihood.prediction import predict_ahead, predict_spread
from ctrlid.validation.comparison import Comparison, Curve
from ctrlid.validation.reproduction import choose_reproduction
from ctrlid.validation.residual_tests import Correlation
from problems import held_ball, levitation, rough_mass, tank

DT = 1e-3
LEAD = levitation(dt=DT, analog=True).controller
DIGITAL = levitation(dt=DT).controller
PLANT, AT = levitation().plant, levitation().at
PID = cid.PID(kp=-700.0, ki=-1500.0, kd=-13.0, filter_time=2e-3, lower=0.0, upper=6.0)


def loop_with(controller, plant=PLANT, **options):
    return cid.Loop(plant, controller, dt=DT, at=AT, **options)


def reference(n=4000, seed=1):
    return cid.random_binary(n, amplitude=1e-4, hold=20, around=AT.output, seed=seed)


def noisy(loop, n=6000, **options):
    given = {"sensor_noise": 2e-6, "force_noise": 0.02, "seed": 2}
    return cid.simulate(loop, reference(n), **{**given, **options})


# --- exact loops


@pytest.mark.parametrize("controller", [DIGITAL, LEAD, PID], ids=["digital", "analog", "pid"])
def test_a_noise_free_loop_is_reproduced_exactly(controller):
    loop = loop_with(controller)
    record = cid.simulate(loop, reference())
    found = cid.compare(record, loop)
    labels = [c.label for c in found.curves]
    assert labels == ["one-step prediction", "25-step prediction", "closed-loop simulation"]
    for curve in found.curves:
        assert curve.fit == pytest.approx(100, abs=1e-6)
        assert curve.noise_share == 1
    simulated = found["simulation"]
    np.testing.assert_allclose(simulated.y, record.y, atol=1e-9 * np.std(record.y))
    assert found.verdict == ("The fit of the closed-loop simulation is 100 %: the model explains "
                             "the whole record.")  # fmt: skip
    assert found.tests == ()
    assert found.notes == ()


def test_a_record_cut_out_of_a_run_starts_from_its_own_states():
    loop = loop_with(PID)
    part = cid.simulate(loop, reference())[1013:3000]
    assert cid.compare(part, loop)["closed-loop"].fit > 99.99
    analog = loop_with(LEAD)
    part = cid.simulate(analog, reference())[1013:3000]
    assert cid.compare(part, analog)["closed-loop"].fit > 99.99


@pytest.mark.parametrize(
    "effect", [cid.effects.InputDelay(7e-4), cid.effects.InputBacklash(0.01)], ids=str
)
def test_what_the_input_remembers_is_no_state_of_the_controller(effect):
    loop = loop_with(PID).with_effect(effect)
    assert cid.compare(cid.simulate(loop, reference()), loop)["closed-loop"].fit > 99.9


def test_a_run_is_followed_from_the_middle_of_a_fall():
    # So much acceleration that the speed over a few samples is none to begin with: from there, and
    # from rest, the simulated ball is lost within 400 samples.
    plant = cid.plants.maglev(m=0.0234, K=9e-7)
    at = cid.operating_point(plant, output=0.0169)
    loop = cid.Loop(plant, cid.PID(kp=-1266.0, kd=-39.4, filter_time=0.0037), dt=2e-3, at=at,
                    input_limits=(0.0, 25.1))  # fmt: skip
    loop = loop.with_effect(cid.effects.InputDeadZone(0.33))
    loop = loop.with_effect(cid.effects.InputOffset(2.9))
    r = cid.random_binary(3000, amplitude=7e-4, hold=56, around=0.0169, seed=5)
    record = cid.simulate(loop, r, sensor_noise=1e-5, seed=4)
    how = choose_reproduction(loop, record)
    assert str(how) == "closed-loop simulation"
    assert how.horizon == 0
    speed = np.diff(record.y)
    hardest = 500 + np.argsort(-np.abs(np.diff(speed)[500:2000]))[:10]
    for k in hardest.tolist():
        part = record[k:]
        assert (
            np.std(simulate_window(loop, make_window(part), how) - part.y) < 4e-5
        )  # its noise, through the loop


@pytest.mark.parametrize("fc", [pytest.param(0.05, marks=pytest.mark.slow), 0.3])
def test_dry_friction_damps_no_prediction_of_what_moves(fc):
    # At rest its steep slope makes the fall a hundred times slower; on the move it does not.
    loop = cid.Loop(PLANT, DIGITAL, dt=DT, at=AT)
    loop = loop.with_effect(cid.effects.CoulombFriction(fc))
    r = cid.random_binary(3000, amplitude=2e-4, hold=60, around=0.012, seed=1)
    record = cid.simulate(loop, r, sensor_noise=5e-6, seed=2)
    found = cid.compare(record, replace(loop, controller=None))
    assert [c.label for c in found.curves[:2]] == ["one-step prediction", "25-step prediction"]
    prediction = cid.predict(loop, record)
    both, sensor = predict_spread(loop, record, prediction, 25)
    assert 0.9 * prediction.sensor_noise < sensor <= both
    index, y = predict_ahead(loop, record, prediction, 25)
    assert 0.4 < np.std(record.y[index] - y) / both < 1.2


def test_injected_signals_are_found_and_injected_again():
    loop = loop_with(DIGITAL)
    d = np.zeros(3000)
    d[500:520], d[1500:1600] = 0.05, -0.03
    record = cid.simulate(loop, np.full(3000, AT.output), d=d)
    found = cid.compare(record, loop)
    assert found["closed-loop"].fit == pytest.approx(100, abs=1e-4)


def test_an_open_loop_of_a_stable_plant_is_simulated_from_its_input():
    loop = tank()
    d = cid.random_binary(600, amplitude=0.1, hold=40, seed=1)
    record = cid.simulate(loop, d=d, sensor_noise=1e-5, initial=(0.21,), seed=3)
    found = cid.compare(record, loop)
    assert found.curves[-1].label == "open-loop simulation"
    assert found.curves[-1].rms == pytest.approx(1e-5, rel=0.1)
    assert "Noise explains" in found.verdict


# --- noise


@pytest.mark.parametrize("controller", [DIGITAL, LEAD], ids=["digital", "analog"])
def test_noise_explains_what_the_right_model_leaves(controller):
    loop = loop_with(controller)
    found = cid.compare(noisy(loop), loop)
    for curve in found.curves:
        assert curve.follows < 0.01
        assert curve.noise_share > 0.85
    assert all(test.passed for test in found.tests)
    assert [t.name for t in found.tests] == [
        "with their own past", "with past u", "with past r",
    ]  # fmt: skip
    assert "Noise explains" in found.verdict
    assert "MISSING" not in found.verdict
    assert found.verdict.endswith(
        "The one-step errors are white and independent of the past signals."
    )


def test_the_right_model_passes_as_often_as_it_should():
    loop = loop_with(DIGITAL)
    passed = [
        [t.passed for t in cid.compare(noisy(loop, 2000, seed=s), loop).tests] for s in range(6)
    ]
    assert np.mean(passed) > 0.9


# --- wrong models


def test_a_wrong_mass_is_seen_in_every_curve():
    record = noisy(loop_with(DIGITAL))
    heavy = cid.plants.maglev(m=1.2 * 0.0213, K=3.34e-6)
    found = cid.compare(record, loop_with(DIGITAL, heavy))
    assert found.curves[-1].fit < 0
    assert found.curves[-1].noise_share < 0.2
    assert "SOMETHING IS MISSING in the model" in found.verdict
    assert "NOT NOISE ALONE: they are correlated with their own past (" in found.verdict


def test_a_wrong_gain_that_follows_the_reference_is_named_so():
    record = noisy(loop_with(DIGITAL))
    strong = cid.plants.maglev(m=0.0213 * 1.1, K=3.34e-6 * 1.1)
    soft = ct.nlsys(
        lambda t, x, u, p: [x[1], 9.81 - 3.34e-6 / 0.0213 * (u[0] / x[0]) ** 2 - 40 * x[1]],
        lambda t, x, u, p: x[0], inputs=["V"], outputs=["x"], states=["x", "v"], name="damped",
    )  # fmt: skip
    assert cid.compare(record, loop_with(DIGITAL, strong)).fit["closed-loop simulation"] > 97
    found = cid.compare(record, loop_with(DIGITAL, soft))
    assert found["closed-loop"].follows > 0.3
    assert "of the variance of the error depends on the reference or the input" in found.verdict


def test_an_offset_is_not_called_noise():
    """A constant error follows no signal, and no white noise makes it."""
    record = noisy(loop_with(DIGITAL))
    shifted = cid.Record(r=record.r, u=record.u + 0.02, y=record.y, dt=DT)
    biased = cid.compare(shifted, loop_with(DIGITAL))
    assert biased["closed-loop"].noise_share < 0.5


def test_small_but_certain_is_said_to_be_small():
    base = {"record": noisy(loop_with(DIGITAL), 400), "what": "x", "residuals": np.zeros(400)}
    curve = Curve("closed-loop simulation", np.zeros(400), 98.0, 1e-6, 0.0, 0.97)
    lags = np.arange(1, 3)

    def verdict(p, share):
        test = Correlation("with past u", lags, np.array([0.1, 0.2]), 0.05, p, share)
        return Comparison(curves=(curve,), tests=(test,), **base).verdict

    assert verdict(1e-9, 0.004).endswith(
        "nearly noise: they are correlated with past u (0.4 % of the variance), which is "
        "significant but small."
    )
    assert "SOMETHING IS MISSING in the model, or its noise is not white" in verdict(1e-9, 0.3)
    assert "NOT NOISE ALONE: they are correlated with past u (30 % of the variance)." in verdict(
        1e-9, 0.3
    )
    assert "are white and independent" in verdict(0.5, 0.0)


def test_noise_that_is_not_white_is_said_to_be_taken_for_white():
    loop = loop_with(DIGITAL)
    record = noisy(loop)
    white = np.random.default_rng(3).standard_normal(len(record) + 1)
    # The logger reads twice and takes the mean, which the controller does not see.
    coloured = cid.Record(r=record.r, u=record.u, y=record.y + 4e-6 * (white[1:] + white[:-1]),
                          dt=DT)  # fmt: skip
    said = "the sensor noise is taken for white here"
    found = cid.compare(coloured, loop)
    assert not found.tests[0].passed
    assert f"note: {said}" in str(found)
    assert "diagnose() fits coloured noise as well" in str(found)
    assert said not in str(cid.compare(record, loop))


def test_noise_is_said_to_explain_nothing_of_what_a_straight_line_does_better():
    """With u of the wrong sign a large random force explains any error."""
    pid = cid.PID(kp=50.0, ki=20.0, kd=2.0, filter_time=0.02, b=0.0)
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), pid, dt=0.01)
    r = cid.random_binary(1500, amplitude=0.1, hold=50, seed=1)
    record = cid.simulate(loop, r, sensor_noise=1e-4, seed=2)
    right = cid.compare(record, loop)
    assert not any(curve.useless for curve in right.curves)
    wrong = cid.compare(replace(record, u=-record.u), loop)
    curve = wrong["50-step"]
    assert curve.fit < 0
    assert curve.useless
    assert curve.written_share == "-"
    assert "noise explains" not in str(curve)
    assert "straight line through the last two is nearer to y" in str(wrong)
    assert "Noise explains" not in wrong.verdict
    # The last value of a ramp errs by as much as it climbs, the line through the last two does not.
    ramp = 0.01 * np.arange(400.0) + 0.2 * np.sin(0.02 * np.arange(400.0))
    climbing = cid.Record(u=np.ones(400), y=ramp, dt=0.01)
    flat = cid.compare(climbing, ct.tf([1e-9], [1, -0.9], 0.01), horizon=5)
    assert flat["5-step"].useless


def test_a_model_that_cannot_be_simulated_says_why():
    record = noisy(loop_with(DIGITAL), 2000)
    weak = cid.compare(record, loop_with(0.05 * DIGITAL))
    assert weak.curves[-1].label == "25-step prediction"
    assert "no simulation: the law of the controller is rejected" in weak.notes[0]
    alone = cid.compare(record, loop_with(None))
    assert "the plant is not stable and the loop has no controller" in alone.notes[0]
    assert "note: no simulation" in str(alone)


# --- transfer functions


def test_one_step_and_several_steps_of_an_arx_model_by_hand():
    rng = np.random.default_rng(0)
    n = 300
    u = rng.standard_normal(n)
    y = np.zeros(n)
    for k in range(2, n):
        y[k] = 2.05 * y[k - 1] - 1.0 * y[k - 2] + 0.2 * u[k - 1] + 0.1 * u[k - 2]
        y[k] = np.clip(y[k], -50, 50) + 0.01 * rng.standard_normal()
    record = cid.Record(u=u + 3.0, y=y + 1.0, dt=0.1)
    model = cid.fit_arx(record, 2, 2, constraints=[cid.ReciprocalPoles()])  # 1/A colours its noise
    a1, b1, b2 = (model.estimate[name] for name in ("a1", "b1", "b2"))
    found = cid.compare(record, model, horizon=4)
    assert [c.label for c in found.curves] == ["one-step prediction", "4-step prediction"]
    du, dy = record.u - record.u.mean(), record.y - record.y.mean()
    raw = np.full(n, np.nan)
    raw[2:] = dy[2:] + a1 * dy[1:-1] + dy[:-2] - b1 * du[1:-1] - b2 * du[:-2]
    constant = np.nanmean(raw)
    np.testing.assert_allclose(found.residuals[2:], raw[2:] - constant, atol=1e-10)
    np.testing.assert_allclose(found["one-step"].y[2:], record.y[2:] - raw[2:] + constant)
    for k in (10, 57, 200):  # origin k: outputs up to y[k] are known
        past = [dy[k], dy[k - 1]]
        for j in range(1, 5):
            new = -a1 * past[0] - past[1] + b1 * du[k + j - 1] + b2 * du[k + j - 2] + constant
            past = [new, past[0]]
        assert found["4-step"].y[k + 4] == pytest.approx(past[0] + record.y.mean(), abs=1e-9)
    assert "an unstable model cannot be simulated in open loop" in found.notes[0]


def test_a_stable_model_is_simulated_from_its_first_outputs():
    model = ct.tf([0.3], [1.0, -0.9], 0.1)
    u = cid.random_binary(500, amplitude=1.0, hold=10, seed=1)
    y = np.zeros(500)
    y[0] = 5.0
    for k in range(1, 500):
        y[k] = 0.9 * y[k - 1] + 0.3 * u[k - 1]
    found = cid.compare(cid.Record(u=u, y=y, dt=0.1), model)
    assert found.curves[-1].label == "open-loop simulation"
    assert found.curves[-1].fit == pytest.approx(100, abs=1e-6)
    assert found.notes == ()
    unspecified = ct.tf([0.3], [1.0, -0.9], True)
    assert cid.compare(cid.Record(u=u, y=y, dt=0.1), unspecified).curves[-1].fit > 99.999


def test_a_continuous_model_is_sampled_as_the_record_holds():
    t = 0.05 * np.arange(400)
    model = ct.tf([2.0], [1.0, 3.0, 2.0])
    smooth = ct.forced_response(model, t, np.sin(3 * t))
    record = cid.Record(u=np.sin(3 * t), y=np.ravel(smooth.outputs), dt=0.05, hold="foh")
    assert cid.compare(record, model)["one-step"].fit > 99.999
    held = cid.Record(u=record.u, y=record.y, dt=0.05)
    assert cid.compare(held, model)["one-step"].fit < 99.99


def test_a_pure_gain_and_a_delay():
    u = np.sin(np.arange(200))
    found = cid.compare(cid.Record(u=u, y=3 * u + 1, dt=1.0), ct.tf([3.0], [1.0], 1.0))
    assert found["one-step"].fit == pytest.approx(100)
    delayed = cid.Record(u=u, y=np.r_[0, 0, u[:-2]], dt=1.0)
    found = cid.compare(delayed, ct.tf([1.0], [1.0, 0.0, 0.0], 1.0))
    assert found["one-step"].rms < 0.01


def test_identified_models_of_an_unstable_plant():
    record = noisy(loop_with(DIGITAL), sensor_noise=1e-8, force_noise=0.0)
    G = cid.fit_arx(record, 2, 2, constraints=[cid.ReciprocalPoles()])
    found = cid.compare(record, G)
    assert "identified (poles 1.04" in found.what
    assert found.curves[-1].label.endswith("-step prediction")
    assert found["one-step"].fit > 99.8
    assert "an unstable model cannot be simulated in open loop" in str(found)


# --- stretches, missing references


def test_valid_stretches_are_reproduced_one_by_one():
    loop = loop_with(DIGITAL)
    record = cid.simulate(loop, reference(), sensor_noise=1e-8, seed=1)
    valid = np.ones(4000, dtype=bool)
    valid[:300] = valid[1800:2300] = valid[2302] = False
    y = np.where(valid, record.y, 0.02)
    marked = cid.Record(r=record.r, u=np.where(valid, record.u, 0.0), y=y, dt=DT, valid=valid)
    found = cid.compare(marked, loop)
    for curve in found.curves:
        assert curve.fit > 99.9
        assert np.isnan(curve.y[~valid]).all()
    assert found["closed-loop"].rms < 2e-8
    arx = cid.compare(marked, cid.fit_arx(marked, 2, 2))
    assert arx["one-step"].fit > 99.8
    assert np.isnan(arx.residuals[300:302]).all()
    assert np.isfinite(arx.residuals[302])


def test_dither_without_a_logged_reference():
    """As MagnetoShield logs: constant set-point, r not recorded, noise injected into u."""
    loop = loop_with(DIGITAL)
    rng = np.random.default_rng(0)
    record = cid.simulate(loop, np.full(6000, AT.output), d=rng.uniform(-0.05, 0.05, 6000),
                          sensor_noise=1e-6, seed=1)  # fmt: skip
    blind = cid.Record(u=record.u, y=record.y, dt=DT)
    found = cid.compare(blind, loop)
    assert found.curves[-1].label == "closed-loop simulation"
    assert found["closed-loop"].fit > 85
    assert "Noise explains" in found.verdict
    assert len(found.tests) == 2
    with_limits = cid.compare(blind, loop_with(PID))
    assert "a loop with a limited PID is simulated from its reference" in with_limits.notes[0]
    analog = cid.compare(blind, loop_with(LEAD))
    assert "a loop with an analog controller is simulated from its reference" in analog.notes[0]


def test_a_stretch_too_short_for_the_horizon():
    record = noisy(loop_with(DIGITAL), 1000)
    valid = np.arange(1000) % 40 > 5
    marked = cid.Record(r=record.r, u=record.u, y=record.y, dt=DT, valid=valid)
    found = cid.compare(marked, loop_with(DIGITAL), horizon=100)
    assert "no 100-step prediction: no stretch of valid samples is long enough" in found.notes
    assert all("100" not in c.label for c in found.curves)


def test_a_sharp_plant_gets_a_note_instead_of_a_warning():
    t = 0.05 * np.arange(60)
    smooth = cid.simulate(cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=1.0), 20.0, dt=0.05),
                          0.5 * np.sin(t), sensor_noise=1e-4, seed=1)  # fmt: skip
    found = cid.compare(smooth, cid.Loop(rough_mass(5), 20.0, dt=0.05))
    assert any("the simulation has an error of about" in note for note in found.notes)


# --- texts


def test_the_table_reads_as_it_should():
    loop = loop_with(DIGITAL)
    record = noisy(loop, 3000)
    named = cid.Record(r=record.r, u=record.u, y=record.y, dt=DT, name="run 7", units={"y": "m"})
    found = cid.compare(named, loop)
    lines = str(found).splitlines()
    assert lines[0].endswith("with the record run 7 (3000 samples, 3000 valid)")
    assert lines[1].split() == ["curve", "fit", "RMS", "error", "[m]", "noise", "explains"]
    assert lines[2].strip().startswith("one-step prediction ")
    assert lines[4].strip().startswith("closed-loop simulation ")
    head = "  correlation of one-step errors       passed?           largest    variance share"
    assert lines[5] == head
    assert lines[6].split()[:5] == ["with", "their", "own", "past", "yes"]
    assert len({len(line) for line in lines[1:6]}) == 1
    assert lines[-1].strip() == found.verdict
    assert found.fit["one-step prediction"] == found.curves[0].fit
    with pytest.raises(CtrlidError, match=r"no curve is called 'nyquist'; there are one-step pred"):
        found["nyquist"]


@pytest.mark.parametrize(
    ("share", "words"),
    [(0.0, "0 %"), (0.004, "0.4 %"), (0.0961, "10 %"), (0.2, "20 %"), (0.9966, "99.7 %"),
     (0.99999, "100 %"), (1.0, "100 %")],
)  # fmt: skip
def test_percentages(share, words):
    from ctrlid.validation.comparison import _write_percent

    assert _write_percent(share) == words


# --- refusals

SHORT = cid.Record(u=np.arange(30.0), y=np.arange(30.0), dt=DT)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: cid.compare([1, 2], loop_with(DIGITAL)), "a Record and a model; given list"),
        (lambda: cid.compare(SHORT, PLANT), "compare needs a Loop, or a transfer function such as"),
        (lambda: cid.compare(SHORT, loop_with(DIGITAL), horizon=0), "between 1 and 29 samples; g"),
        (lambda: cid.compare(SHORT, loop_with(DIGITAL), horizon=30), "samples; given 30"),
        (lambda: cid.compare(SHORT, loop_with(DIGITAL), horizon=2.5), "samples; given 2.5"),
        (lambda: cid.compare(SHORT, ct.tf([1], [1, 0.5], 0.1)), "sampled at 0.1 s, the record at"),
        (lambda: cid.compare(SHORT, ct.tf([[[1], [1]]], [[[1], [1]]])), "one input and one output"),
        (
            lambda: cid.compare(SHORT, ct.tf([1], np.ones(25), DT)),
            "of order 24 needs 34 valid samp",
        ),
        (
            lambda: cid.compare(SHORT, cid.Loop(PLANT, None, dt=0.1, at=AT)),
            "loop is sampled at 0.1",
        ),
    ],
)
def test_refusals(call, words):
    with pytest.raises(CtrlidError, match=words):
        call()


# --- real logs


def test_emps_with_and_without_its_friction(data_dir):
    record = cid.datasets.load("emps")[:8000]
    law = cid.PID(kp=254.49 * 159.86, kd=254.49, bias=0, derivative="measurement")

    def emps(sharpness, coulomb):
        return ct.nlsys(
            lambda t, x, u, p: [x[1], (35.15065 * u[0] - 203.5 * x[1] + 3.16
                                       - coulomb * np.tanh(x[1] / sharpness)) / 95.11],
            lambda t, x, u, p: x[0], inputs=["V"], outputs=["q"], states=["q", "v"], name="emps",
        )  # fmt: skip

    right = cid.compare(record, cid.Loop(emps(1e-3, 20.39), law, dt=1e-3))
    wrong = cid.compare(record, cid.Loop(emps(1e-3, 0.0), law, dt=1e-3))
    assert right["closed-loop"].rms < 4e-6 < 1e-5 < wrong["closed-loop"].rms
    assert "SOMETHING IS MISSING" in wrong.verdict


def test_inteco_log_is_predicted_over_its_valid_stretches(data_dir):
    record = cid.datasets.load("inteco_pid_step")
    at = cid.OperatingPoint((0.012, 0.0), 0.5, 0.012)
    plant = held_ball(0.058, 0.012, 0.5)
    found = cid.compare(record, cid.Loop(plant, None, dt=1e-3, at=at))
    assert found["one-step"].fit > 98
    assert "SOMETHING IS MISSING" in found.verdict  # the coil


@pytest.mark.parametrize("delay", [0.0, 0.4, 1.0, 2.3])
def test_an_input_that_runs_straight_is_simulated_so(delay):
    # An oscillator with a period of few samples, integrated by scipy, its input straight or late.
    rng = np.random.default_rng(5)
    a, b, d, dt, n = 900.0, 1100.0, 7.0, 0.02, 600
    fine = 10
    u = signal.lfilter([0.3], [1, -0.7], rng.standard_normal(n))
    u[:5] = 0.0
    time = np.arange((n - 1) * fine + 1) * dt / fine
    late = np.interp(time - delay * dt, np.arange(n) * dt, u, left=0.0)
    matrices = np.array([[0, 1], [-a, -d]]), np.array([[0], [b]]), np.array([[1, 0]]), 0
    y = signal.lsim(matrices, late, time, interp=True)[1][::fine]
    effects = (cid.effects.InputDelay(delay * dt),) if delay else ()
    loop = cid.Loop(rough_oscillator(a, b, d), dt=dt, at=cid.OperatingPoint((0.0, 0.0), 0.0, 0.0),
                    effects=effects)  # fmt: skip
    record = cid.Record(u=u, y=y, dt=dt, hold="foh")
    curves = {c.label: c for c in cid.compare(record, loop).curves}
    assert curves["open-loop simulation"].fit > 99.9
    held = cid.compare(replace(record, hold="zoh"), loop)
    assert {c.label: c for c in held.curves}["open-loop simulation"].fit < 95


def rough_oscillator(a, b, d):
    return ct.nlsys(lambda t, x, u, p: [x[1], b * u[0] - a * x[0] - d * x[1]],
                    lambda t, x, u, p: x[0], inputs=["u"], outputs=["y"], states=["y", "v"],
                    name="oscillator")  # fmt: skip


@pytest.mark.parametrize("effect", [cid.effects.ActuatorLag(0.0), cid.effects.SensorLag(0.0)])
def test_a_lag_of_zero_is_no_lag(effect):
    rng = np.random.default_rng(3)
    u, dt = np.repeat(rng.choice([-1.0, 1.0], 50), 10), 0.02
    phi, gamma = signal.cont2discrete(
        (np.array([[0, 1], [-9.0, -1.0]]), np.array([[0], [2.0]]), np.eye(2), np.zeros((2, 1))), dt
    )[:2]
    x, y = np.zeros(2), []
    for value in u:
        y.append(x[0])
        x = phi @ x + gamma[:, 0] * value
    record = cid.Record(u=u, y=np.array(y) + 1e-3 * rng.standard_normal(len(u)), dt=dt)
    at = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
    plain = cid.Loop(rough_oscillator(9.0, 2.0, 1.0), dt=dt, at=at)
    given = cid.Loop(rough_oscillator(9.0, 2.0, 1.0), dt=dt, at=at, effects=(effect,))
    without, with_ = cid.compare(record, plain), cid.compare(record, given)
    for one, other in zip(without.curves, with_.curves, strict=True):
        assert other.rms == pytest.approx(one.rms, rel=1e-6)
    ahead = cid.predict(given, record)
    assert ahead.states.shape == (len(u), 2)
