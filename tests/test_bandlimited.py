"""A measured, band-limited input: the samples say what it does in between.

The records are of a solver of SciPy at tight tolerances, driven by sums of sines whose every value
is known; ctrlid takes no part in making them.
"""

from dataclasses import replace

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import ctrlid as cid
from ctrlid import effects as E
from ctrlid.data.reconstruction import PIECES, reconstruct_signal
from ctrlid.loop.simulation import Simulator
from problems import mass

DT, N = 0.01, 600
# Lines from 2 to 32 Hz, up to 0.65 of the Nyquist frequency, that do not repeat in the record.
RNG = np.random.default_rng(3)
FREQUENCIES = 2 * np.pi * (2 + 30 * RNG.uniform(size=25))
PHASES = RNG.uniform(0, 2 * np.pi, 25)
M, C, K, CUBIC = 1.0, 4.0, 3000.0, 1e7


def drive(t):
    """The input [N] at any time."""
    return 0.2 * np.sin(np.multiply.outer(t, FREQUENCIES) + PHASES).sum(axis=-1) * 5


def respond(delay=0.0, cubic=0.0, n=N, start=-2.0):
    """The position at the samples of an oscillator that the input moves [m]."""

    def rate(t, x):
        return [x[1], (drive(t - delay) - C * x[1] - K * x[0] - cubic * x[0] ** 3) / M]

    t = DT * np.arange(n)
    found = solve_ivp(rate, (start, t[-1]), [0.0, 0.0], "DOP853", t_eval=t, rtol=1e-10, atol=1e-13)
    return found.y[0]


def make_record(y, hold="bandlimited", noise=0.0):
    """What a logger writes of it."""
    rng = np.random.default_rng(5)
    y = y + noise * rng.standard_normal(len(y))
    return cid.Record(u=drive(DT * np.arange(len(y))), y=y, dt=DT, hold=hold)


def oscillator(**free):
    """The model without what is hidden."""

    def rates(t, x, u, p):
        return np.array([x[1], (u[0] - p["c"] * x[1] - p["k"] * x[0]) / p["m"]])

    plant = mass(rates, m=M, c=C, k=K)
    return cid.Loop(plant, dt=DT, **free)


@pytest.fixture(scope="module")
def y():
    return respond()


def relative(error, y):
    return np.std(error) / np.std(y)


def test_the_corners_stand_for_the_signal():
    t = DT * np.arange(N)
    corners = reconstruct_signal(drive(t))
    # A triangle as wide as two pieces has the mean (v- + 10 v + v+) / 12 on the signal.
    on = (np.roll(corners, 1) + 10 * corners + np.roll(corners, -1)) / 12
    error = on - drive(DT / PIECES * np.arange(N * PIECES))
    inside = slice(20 * PIECES, -20 * PIECES)
    assert relative(error[inside], drive(t)) < 3e-4
    assert relative(error[PIECES : -2 * PIECES], drive(t)) < 3e-3


def test_constants_short_stretches_and_gaps_are_kept():
    assert (reconstruct_signal([2.0, 2.0, 2.0]) == 2.0).all()
    u, valid = np.arange(30.0), np.ones(30, bool)
    valid[10:14] = False
    corners = reconstruct_signal(u, valid)
    assert (corners[10 * PIECES : 14 * PIECES] == np.repeat(u[10:14], PIECES)).all()
    assert np.allclose(corners[: 8 * PIECES], np.arange(8 * PIECES) / PIECES, atol=0.05)


def test_a_simulation_follows_a_tight_solver(y):
    errors = {}
    for hold in ("zoh", "foh", "bandlimited"):
        record = make_record(y, hold)
        curve = cid.compare(record, oscillator()).curves[-1]
        assert "simulation" in curve.label
        errors[hold] = relative((curve.y - y)[30:-3], y)
    assert errors["bandlimited"] < 1e-3
    assert errors["foh"] > 30 * errors["bandlimited"]
    assert errors["zoh"] > 100 * errors["bandlimited"]


def test_a_prediction_follows_a_tight_solver(y):
    sizes = {}
    for hold in ("foh", "bandlimited"):
        found = cid.predict(oscillator(), make_record(y, hold), noise_ratio=1.0)
        sizes[hold] = relative(found.innovations[30:-3], y)
    assert sizes["bandlimited"] < 1e-3
    assert sizes["foh"] > 30 * sizes["bandlimited"]


def test_simulation_and_filter_take_a_delay_of_any_fraction():
    late = 1.37 * DT
    y = respond(delay=late)
    loop = oscillator().with_effect(E.InputDelay(late))
    record = make_record(y)
    for curve in cid.compare(record, loop).curves:
        seen = np.isfinite(curve.y[40:-3])
        assert seen.any()
        assert relative((curve.y - y)[40:-3][seen], y) < 2e-3


def test_a_fit_finds_the_parameters(y):
    record = make_record(y, noise=1e-3 * np.std(y))
    fit = cid.fit_loop(oscillator(free=("m", "c", "k")), record)
    for name, truth in (("m", M), ("c", C), ("k", K)):
        error = fit.estimate.standard_errors[fit.estimate.names.index(name)]
        assert abs(fit.estimate[name] - truth) < 3.5 * error, name
        assert abs(fit.estimate[name] / truth - 1) < 3e-3
    wrong = cid.fit_loop(oscillator(free=("m", "c", "k")), replace(record, hold="foh"))
    assert abs(wrong.estimate["m"] / M - 1) > 0.03


def test_a_continuous_model_is_fitted_and_compared(y):
    record = make_record(y, noise=1e-3 * np.std(y))
    G = cid.fit_continuous(record, poles=2)
    for name, truth in (("a1", C / M), ("a2", K / M), ("b1", 1 / M)):
        assert abs(G.estimate[name] / truth - 1) < 0.01, name
    assert cid.compare(record, G).curves[-1].fit > 99.5


@pytest.mark.slow
def test_a_hidden_effect_is_named():
    y = respond(cubic=CUBIC, n=1500)
    record = make_record(y, noise=2e-3 * np.std(y))
    found = cid.diagnose(oscillator(free=("m", "c", "k")), record)
    assert [f.name for f in found.findings] == ["CubicStiffness"]


def test_under_feedback_it_is_refused():
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    loop = cid.Loop(plant, 1.0, dt=DT, free=("c",))
    r = cid.random_binary(300, amplitude=1e-3, hold=20, seed=1)
    record = replace(cid.simulate(loop, r, sensor_noise=1e-5, seed=1), hold="bandlimited")
    for act in (cid.predict, cid.fit_loop, cid.compare, cid.diagnose):
        with pytest.raises(cid.CtrlidError, match="did not react to y"):
            act(loop, record)


def test_a_record_keeps_the_word(tmp_path, y):
    record = make_record(y)
    record.to_csv(tmp_path / "a.csv")
    assert cid.Record.from_csv(tmp_path / "a.csv").hold == "bandlimited"
    assert record.decimate(2).hold == "bandlimited"


def test_backlash_and_dead_zone_act_on_what_is_reconstructed():
    d = drive(DT * np.arange(200))
    for effect in (E.InputBacklash(4.0), E.InputDeadZone(3.0)):
        loop = oscillator().with_effect(effect)
        simulator = Simulator(loop, tolerance=1e-5, hold="bandlimited")
        y = simulator.run(simulator.start(None), None, d)[0]
        ahead, plain = (cid.predict(one, make_record(y), noise_ratio=1.0).innovations[30:-3]
                        for one in (loop, oscillator()))  # fmt: skip
        assert relative(ahead, y) < 3e-3 < 0.1 * relative(plain, y)


def test_an_audit_says_how_the_input_looks(y):
    loop = oscillator()
    noise = 3e-4 * np.std(y)
    for hold in ("zoh", "foh"):
        (found,) = cid.audit(make_record(y, hold, noise), loop)["between samples"]
        assert found.harmful
        assert "looks band-limited" in found.text
        assert "hold='bandlimited'" in found.text
    (found,) = cid.audit(make_record(y, noise=noise), loop)["between samples"]
    assert not found.harmful
    (found,) = cid.audit(make_record(y, "zoh", noise))["between samples"]
    assert "u is not held" in found.text


def test_an_audit_says_nothing_of_a_held_input():
    loop = oscillator()
    d = drive(DT * np.arange(N))
    record = cid.simulate(loop, d=d, sensor_noise=1e-5, seed=1)
    assert not cid.audit(record)["between samples"]
    assert not cid.audit(record, loop)["between samples"]
    (found,) = cid.audit(replace(record, hold="foh"), loop)["between samples"]
    assert "looks held" in found.text


def test_an_audit_and_a_fit_speak_of_an_unknown_analog_controller():
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    loop = cid.Loop(plant, ct.tf([8, 30], [0.02, 1]), dt=0.02, free=("m",))
    r = cid.random_binary(1000, amplitude=0.1, hold=10, seed=1)
    record = cid.simulate(loop, r, sensor_noise=1e-3, seed=1)
    unknown = replace(loop, controller=None)
    (found,) = cid.audit(record, unknown)["between samples"]
    assert found.harmful
    assert "give the analog controller to the loop" in found.text
    assert not cid.audit(record, loop)["between samples"]
    notes = [cid.fit_loop(one, record).estimate.notes for one in (unknown, loop)]
    assert [any("MOVES BETWEEN THE SAMPLES" in n for n in each) for each in notes] == [True, False]


def test_undeclared_feedback_is_warned_of_with_the_size_of_the_bias():
    rng = np.random.default_rng(0)
    n, dt = 1500, 0.02
    whole = expm(dt * np.array([[0, 1, 0], [0, -2.0, 3.0], [0, 0, 0]]))
    r = np.repeat(rng.choice([-0.1, 0.1], n // 25), 25)
    x, u, y, last = np.zeros(2), np.zeros(n), np.zeros(n), 0.0
    for j in range(n):
        y[j] = x[0] + 1e-3 * rng.standard_normal()
        u[j] = 20 * (r[j] - y[j]) + 60 * (r[j] - y[j] - last)
        last = r[j] - y[j]
        x = whole[:2, :2] @ x + whole[:2, 2] * u[j]
    record = cid.Record(u=u, y=y, dt=dt, hold="bandlimited")
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), dt=dt, free=("c",))
    (found,) = cid.audit(record, loop)["between samples"]
    biased, held = (cid.fit_loop(loop, replace(record, hold=hold)).estimate.values[0]
                    for hold in ("bandlimited", "zoh"))  # fmt: skip
    assert found.harmful
    assert found.size == pytest.approx(abs(biased / held - 1), rel=0.3)
    assert "c by" in found.text
    assert abs(held - biased) > 2 * abs(held - 2.0)
    assert "reconstructs u between the samples from later ones" in found.text
    (alone,) = cid.audit(record)["between samples"]
    assert alone.harmful
    assert "a fit is biased. Give" in alone.text
