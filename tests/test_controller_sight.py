"""Noise that only the logger sees, under an analog controller that sees the output itself."""

import control as ct
import numpy as np
import pytest
from scipy.linalg import expm

import ctrlid as cid
import problems
from ctrlid.loop.controller_sight import find_sight

DT, N = 2e-4, 4000
MASS, SPRING, GAIN = 2.0, 1.5e6, 300.0  # an unstable bearing: +- 866 rad/s
KP, KD, TF = 12000.0, 22.0, 3e-4
LEAD = KP + ct.tf([KD, 0], [TF, 1])


def record_bearing(seen=0.0, logged=0.0, seed=0, push=0.0):
    """A bearing under an analog lead, exactly, with noise held in the loop, or in the log alone."""
    rng = np.random.default_rng(seed)
    r = 8e-6 * np.repeat(rng.choice([-1.0, 1.0], N // 60 + 1), 60)[:N]
    # States x, v, w; the error e is r less noise and x, the current KP e + KD (e - w) / TF.
    gain = KP + KD / TF
    a = np.array([[0, 1, 0], [(SPRING - GAIN * gain) / MASS, 0, -GAIN * KD / TF / MASS],
                  [-1 / TF, 0, -1 / TF]])  # fmt: skip
    b = np.array([[0, 0], [GAIN * gain / MASS, 1 / MASS], [1 / TF, 0]])
    whole = expm(DT * np.block([[a, b], [np.zeros((2, 5))]]))
    z, u, y = np.zeros(3), np.zeros(N), np.zeros(N)
    for k in range(N):
        noise = seen * rng.standard_normal()
        e = r[k] - noise
        y[k] = z[0] + noise + logged * rng.standard_normal()
        u[k] = KP * (e - z[0]) + KD * (e - z[0] - z[2]) / TF
        z = whole[:3] @ np.concatenate([z, [e, push * np.sin(500 * k * DT)]])
    return cid.Record(r=r, u=u, y=y, dt=DT, hold="foh")


def make_bearing():
    plant = problems.mass(
        lambda t, x, u, p: np.array([x[1], (p["k"] * x[0] + p["b"] * u[0]) / p["m"]]),
        m=MASS, k=SPRING, b=GAIN,
    )  # fmt: skip
    return cid.Loop(plant, LEAD, dt=DT, free=("k",))


@pytest.mark.parametrize("push", [0.0, 5.0])
@pytest.mark.parametrize("noise", [2e-8, 2e-7, 1e-6])
def test_a_record_tells_what_an_analog_controller_sees(noise, push):
    loop = make_bearing()
    for seed in range(3):
        assert find_sight(loop, record_bearing(logged=noise, seed=seed, push=push)) == "output"
        assert find_sight(loop, record_bearing(seen=noise, seed=seed, push=push)) == "reading"


def test_without_noise_and_without_a_reference_a_controller_sees_readings():
    loop, record = make_bearing(), record_bearing()
    assert find_sight(loop, record) == "reading"
    silent = cid.Record(u=record.u, y=record.y, dt=DT, hold="foh")
    assert find_sight(loop, silent) == "reading"


@pytest.mark.parametrize("kind", ["seen", "logged"])
def test_the_filter_is_the_best_one_for_either_noise(kind):
    loop, record = make_bearing(), record_bearing(**{kind: 2e-7}, seed=3)
    prediction = cid.predict(loop, record)
    assert prediction.sensor_noise == pytest.approx(2e-7, rel=0.03)
    e = prediction.innovations[5:]
    e = e[np.isfinite(e)]
    assert abs(np.sum(e[1:] * e[:-1]) / np.sum(e**2)) < 3 / np.sqrt(len(e))


@pytest.mark.parametrize("kind", ["seen", "logged"])
def test_estimates_are_right_within_their_errors(kind):
    record = record_bearing(**{kind: 2e-7}, seed=4)
    fit = cid.fit_loop(make_bearing(), record).estimate
    assert abs(fit["k"] - SPRING) < 3 * fit.standard_errors[0]
    assert not any("NOT WHITE" in note for note in fit.notes)
    linear = cid.fit_continuous(record, poles=2, constraints=[cid.SymmetricPoles()],
                                controller=LEAD)  # fmt: skip
    pole, error = linear.estimate.poles_s.real.max(), linear.estimate.poles_s_standard_errors.max()
    assert abs(pole - np.sqrt(SPRING / MASS)) < 3 * error
    assert not any("NOT WHITE" in note for note in linear.estimate.notes)


@pytest.mark.parametrize("kind", ["seen", "logged"])
def test_nothing_is_missing_and_the_gap_is_what_the_noise_leaves(kind):
    loop, record = make_bearing(), record_bearing(**{kind: 2e-7}, seed=5)
    few = [cid.effects.StribeckFriction, cid.effects.PositionRipple]
    found = cid.diagnose(loop, record, progress=False, catalogue=few)
    assert found.verdict == "nothing missing"
    assert 0.85 < found.gap.after / found.gap.floor < 1.15


def test_the_audit_says_whose_noise_it_is():
    loop = make_bearing()
    words = "the noise of y is that of the logger alone"
    logged, seen = (str(cid.audit(record_bearing(**{kind: 2e-7}), loop))
                    for kind in ("logged", "seen"))  # fmt: skip
    assert words in logged
    assert words not in seen
