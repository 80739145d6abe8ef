"""The predictor: an independent Kalman filter, white innovations of the right size, refusals.

Groups: linear plants; simulated records; stretches that do not count; several steps; refusals.
"""

from functools import partial

import control as ct
import numpy as np
import pytest
from scipy import linalg

import ctrlid as cid
from ctrlid import CtrlidError
from ctrlid.estimation.likelihood.prediction import predict_ahead
from ctrlid.validation.residual_tests import autocorrelation, cross_correlation
from problems import levitation, record_of, servo

SENSOR, FORCE = 2e-6, 0.02


levitated = partial(levitation, dt=1e-3, free=())


def experiment(loop, n=6000, seed=1, **noise):
    return record_of(loop, swing=1e-4, hold=20, n=n, seed=seed, noise_seed=seed + 10,
                     **{"sensor_noise": SENSOR, **noise})  # fmt: skip


def kalman(a, b, c, f, u, y, ratio):
    """The textbook filter with sensor variance one and force variance ratio**2."""
    n = len(a)
    x, p = np.zeros(n), 1e10 * np.eye(n)
    predicted, spread = [], []
    for uk, yk in zip(u, y, strict=True):
        predicted.append(c @ x)
        s = c @ p @ c + 1
        spread.append(s)
        k = p @ c / s
        x = x + k * (yk - c @ x)
        p = p - np.outer(k, c @ p)
        x = a @ x + b * uk
        p = a @ p @ a.T + ratio**2 * np.outer(f, f)
    return np.array(predicted), np.array(spread)


# --- linear plants


@pytest.mark.parametrize("stiffness", [-1600.0, 0.0, 400.0])
def test_equals_an_independent_kalman_filter(stiffness):
    """x'' = -c x' - k x + 3 u, unstable, integrating and stable."""
    A, B = np.array([[0.0, 1.0], [-stiffness, -2.0]]), np.array([0.0, 3.0])
    plant = ct.ss(A, B[:, None], [[1.0, 0.0]], 0, inputs="u", outputs="x", states=["x", "v"])
    dt = 1e-3
    at = cid.OperatingPoint((0.0, 0.0), 0.7, 0.3)
    loop = cid.Loop(plant, ct.tf([4000.0, -3700.0], [1.0, -0.6], dt), dt=dt, at=at)
    r = 0.3 + cid.random_binary(3000, amplitude=1e-3, hold=50, seed=1)
    record = cid.simulate(loop, r, sensor_noise=1e-5, force_noise=1.0, seed=2)
    ratio = 1e5
    prediction = cid.predict(loop, record, noise_ratio=ratio)
    both = np.vstack([np.column_stack([A, B, [0.0, 1.0]]), np.zeros((2, 4))])
    whole = linalg.expm(dt * both)
    expected, s = kalman(whole[:2, :2], whole[:2, 2], np.array([1.0, 0.0]), whole[:2, 3],
                         record.u - 0.7, record.y - 0.3, ratio)  # fmt: skip
    late = slice(300, None)
    size = np.std(record.y - 0.3 - expected)
    assert np.abs(prediction.y - 0.3 - expected)[late].max() < 1e-5 * size
    shape = prediction.spread / prediction.sensor_noise
    np.testing.assert_allclose(shape[late] ** 2, s[late], rtol=1e-5)
    assert prediction.force_noise == pytest.approx(ratio * prediction.sensor_noise)


def test_a_plant_in_discrete_time():
    a, b, c = np.array([[1.7, -0.72], [1.0, 0.0]]), np.array([1.0, 0.0]), np.array([0.2, 0.1])
    plant = ct.ss(a, b[:, None], c[None, :], 0, 0.1)
    rng = np.random.default_rng(0)
    u = rng.standard_normal(2000)
    x, y = np.zeros(2), []
    for uk in u:
        y.append(c @ x + 0.05 * rng.standard_normal())
        x = a @ x + b * (uk + 0.1 * rng.standard_normal())
    loop = cid.Loop(plant, None, dt=0.1)
    record = cid.Record(u=u, y=y, dt=0.1)
    prediction = cid.predict(loop, record, noise_ratio=2.0)
    expected, _ = kalman(a, b, c, b, u, record.y, 2.0)
    np.testing.assert_allclose(prediction.y[200:], expected[200:], atol=1e-7)
    assert prediction.sensor_noise == pytest.approx(0.05, rel=0.05)
    tuned = cid.predict(loop, record)
    assert tuned.force_noise / tuned.sensor_noise == pytest.approx(2.0, rel=0.25)


# --- simulated records


@pytest.mark.parametrize("analog", [False, True])
def test_innovations_are_white_and_of_the_expected_size(analog):
    loop = levitated(analog=analog)
    record = experiment(loop, force_noise=FORCE)
    prediction = cid.predict(loop, record, noise_ratio=FORCE / SENSOR)
    assert prediction.sensor_noise == pytest.approx(SENSOR, rel=0.05)
    e, known = prediction.innovations, prediction.settled
    assert known.sum() > 5900
    scaled = e[known] / prediction.spread[known]
    assert scaled.std() == pytest.approx(1.0, rel=0.03)
    assert np.mean(np.abs(scaled) < 1.96) == pytest.approx(0.95, abs=0.015)
    assert autocorrelation(e, known).p_value > 0.001
    assert cross_correlation(e, record.r, known, "r", first=0).p_value > 0.001
    assert cross_correlation(e, record.u, known, "u").p_value > 0.001
    # The filtered states know the speed better than differences of the output do.
    assert prediction.states.shape == (6000, 2)
    assert prediction.circuit.shape == (6000, 1 if analog else 0)


def test_the_noise_ratio_is_found():
    loop = levitated()
    for force in (0.005, 0.05):
        prediction = cid.predict(loop, experiment(loop, force_noise=force))
        assert prediction.sensor_noise == pytest.approx(SENSOR, rel=0.1)
        assert prediction.force_noise == pytest.approx(force, rel=0.4)


def test_a_noise_free_record_is_predicted_to_integration_accuracy():
    loop = levitated()
    record = experiment(loop, sensor_noise=0.0)
    error = cid.predict(loop, record).innovations
    assert np.abs(error).max() < 1e-6 * record.y.std()


def test_a_known_analog_circuit_is_followed_between_samples():
    """A straight line between the samples of u misses what the circuit did at each switch."""
    loop = levitated(analog=True)
    record = experiment(loop, sensor_noise=0.0)
    known = cid.predict(loop, record, noise_ratio=1e3).innovations
    alone = cid.Loop(loop.plant, None, dt=loop.dt, at=loop.at)
    straight = cid.predict(alone, record, noise_ratio=1e3).innovations
    assert known.std() < 1e-3 * straight.std()


def test_a_smooth_input_is_followed_as_a_straight_line():
    t = 0.05 * np.arange(400)
    response = ct.forced_response(ct.tf([3.0], [1.0, 2.0, 0.0]), t, np.sin(2 * t))
    record = cid.Record(u=np.sin(2 * t), y=np.ravel(response.outputs), dt=0.05, hold="foh")
    loop = servo(None, dt=0.05)
    assert np.abs(cid.predict(loop, record).innovations).max() < 1e-8
    held = cid.Record(u=record.u, y=record.y, dt=0.05, hold="zoh")
    assert np.abs(cid.predict(loop, held).innovations).max() > 1e-4


@pytest.mark.parametrize("n", [100_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_long_records_of_an_unstable_plant_stay_finite(n):
    loop = levitated()
    record = experiment(loop, n=n)
    prediction = cid.predict(loop, record)
    assert np.isfinite(prediction.innovations).all()
    assert prediction.innovations[prediction.settled].std() < 1.5 * SENSOR
    assert prediction.innovations[-1000:].std() < 1.5 * SENSOR


# --- stretches that do not count


def test_what_is_not_valid_is_not_looked_at():
    loop = levitated()
    record = experiment(loop, n=3000)
    valid = np.ones(3000, dtype=bool)
    valid[:700] = valid[1500:1505] = valid[2000:2400] = False
    clean = cid.Record(r=record.r, u=record.u, y=record.y, dt=record.dt, valid=valid)
    y, u = record.y.copy(), record.u.copy()
    y[~valid] = 5.0  # nonsense, as from a ball on the floor
    u[:700], u[2000:2400] = 9.0, 9.0
    soiled = cid.Record(r=record.r, u=u, y=y, dt=record.dt, valid=valid)
    a, b = (cid.predict(loop, r, noise_ratio=1e4) for r in (clean, soiled))
    np.testing.assert_array_equal(a.innovations, b.innovations)
    assert np.all(a.innovations[~valid] == 0)
    assert not a.settled[~valid].any()
    # A short gap is bridged with an unknown input, a long one starts the filter afresh.
    assert a.settled[1515:2000].all()
    np.testing.assert_allclose(a.states[1502], a.states[1500], atol=1e-2)
    np.testing.assert_array_equal(a.states[2200], [loop.at.output, 0.0])
    assert not a.settled[2400]
    assert a.settled[2420:].all()
    assert a.innovations[a.settled].std() < 1.6 * SENSOR


def test_a_record_that_starts_elsewhere_is_caught():
    loop = levitated()
    r = np.full(2000, 0.0115)
    record = cid.simulate(loop, r, sensor_noise=SENSOR, initial=(0.0118, 0.003), seed=1)
    prediction = cid.predict(loop, record)
    assert prediction.innovations[prediction.settled].std() < 1.3 * SENSOR
    assert prediction.settled[30:].all()


# --- several steps


def test_several_steps_equal_a_simulation_from_the_filtered_state():
    loop = levitated()
    record = experiment(loop, n=400)
    prediction = cid.predict(loop, record)
    index, y = predict_ahead(loop, record, prediction, 12)
    assert set(np.diff(index)) == {3}
    alone = cid.Loop(loop.plant, None, dt=loop.dt, at=loop.at)
    for k, value in list(zip(index, y, strict=True))[5:40:7]:
        d = record.u[k - 12 : k + 1] - loop.at.input
        free = cid.simulate(alone, d=d, initial=prediction.states[k - 12])
        assert value == pytest.approx(free.y[-1], abs=1e-10)


def test_several_steps_need_as_many_valid_samples():
    loop = levitated()
    record = experiment(loop, n=400)
    prediction = cid.predict(loop, record)
    valid = np.ones(400, dtype=bool)
    valid[::11] = False
    marked = cid.Record(r=record.r, u=record.u, y=record.y, dt=record.dt, valid=valid)
    index, y = predict_ahead(loop, marked, prediction, 12)
    assert len(index) == len(y) == 0
    index, _ = predict_ahead(loop, marked, prediction, 8)
    assert len(index)
    assert all(valid[k - 8 : k + 1].all() for k in index)


# --- refusals


def test_a_prediction_prints_its_noise_with_units():
    loop = levitated()
    lines = str(cid.predict(loop, experiment(loop, n=500, sensor_noise=1e-6))).splitlines()
    assert lines[0] == "One-step prediction of 500 samples"
    assert "RMS of the innovations: " in lines[1]
    assert " m; of the white force: " in lines[2]
    assert lines[2].endswith(" m/s^2")


def test_refusals():
    loop = levitated()
    record = experiment(loop, n=200)
    with pytest.raises(CtrlidError, match="a Loop and a Record; given Record and Record"):
        cid.predict(record, record)
    with pytest.raises(CtrlidError, match=r"the loop is sampled at 0.001 s, the record at 0.002 s"):
        cid.predict(loop, record.decimate(2, antialias=False))
    for bad in (-1.0, np.nan, np.inf):
        with pytest.raises(CtrlidError, match=r"noise_ratio is the ratio .* >= 0; given"):
            cid.predict(loop, record, noise_ratio=bad)
    blind = cid.Record(u=record.u, y=record.y, dt=1e-3, valid=np.arange(200) < 9)
    with pytest.raises(CtrlidError, match="at least 10 valid samples; the record has 9 of 200"):
        cid.predict(loop, blind)


def test_a_model_that_cannot_follow_says_where():
    plant = ct.nlsys(
        lambda t, x, u, p: [x[1], u[0] - x[0] + np.exp(x[0])], lambda t, x, u, p: x[0],
        inputs=["u"], outputs=["y"], states=["x", "v"], name="burst",
    )  # fmt: skip
    y = 900 + np.sin(np.arange(300))
    record = cid.Record(u=np.zeros(300), y=y, dt=0.1, start=5.0)
    with pytest.raises(CtrlidError, match=r"the Kalman filter of burst diverges at sample \d+ "
                       r"\(t = [\d.]+ s\): .* exclude these samples with valid="):  # fmt: skip
        cid.predict(cid.Loop(plant, None, dt=0.1), record)


def move_cart_and_pole(x, force, p, fc):
    """Return the derivative of a cart with a pole upright and dry friction at the cart."""
    _, v, angle, rate = x
    sine, cosine = np.sin(angle), np.cos(angle)
    load = p["M"] + p["m"] * sine**2
    f = force - fc * np.tanh(v / 2e-3)
    pull = p["m"] * p["l"] * rate**2 * sine
    push = (f + pull - p["m"] * p["g"] * sine * cosine) / load
    fall = (load + p["m"] * cosine**2) * p["g"] * sine - cosine * (f + pull)
    return np.array([v, push, rate, fall / (p["l"] * load)])


def run_cart_and_pole(p, fc, n, dt, seed, steps=20):
    """Return input and measured position of a cart with a pole under a state feedback."""
    rng = np.random.default_rng(seed)
    a = np.zeros((4, 4))
    b = np.zeros(4)
    for k in range(4):
        a[:, k] = move_cart_and_pole(1e-6 * np.eye(4)[k], 0.0, p, 0.0) / 1e-6
    b = move_cart_and_pole(np.zeros(4), 1e-6, p, 0.0) / 1e-6
    riccati = linalg.solve_continuous_are(a, b[:, None], np.diag([10.0, 1, 100, 1]), [[0.5]])
    gain = b @ riccati / 0.5
    r = np.repeat(rng.choice([-0.15, 0.15], n // 100), 100)
    x, u, y = np.zeros(4), np.zeros(n), np.zeros(n)
    for k in range(n):
        seen = x + rng.standard_normal(4) * [2e-4, 1e-3, 4e-4, 1e-3]
        u[k], y[k] = -gain @ (seen - [r[k], 0, 0, 0]), seen[0]
        for _ in range(steps):
            half = x + dt / steps / 2 * move_cart_and_pole(x, u[k], p, fc)
            x = x + dt / steps * move_cart_and_pole(half, u[k], p, fc)
    return u, y


@pytest.mark.parametrize("fc", [0.05, 0.15])
def test_dry_friction_in_an_unstable_plant_is_followed_from_a_trajectory_without_it(fc):
    p = {"M": 0.6, "m": 0.25, "l": 0.35, "g": 9.81}
    u, y = run_cart_and_pole(p, fc, 1500, 0.005, 21)
    plant = ct.nlsys(
        lambda t, x, u, p: move_cart_and_pole(x, u[0], p, 0.0), lambda t, x, u, p: x[0],
        inputs=["F"], outputs=["s"], states=["s", "v", "angle", "rate"], params=p, name="cart",
    )  # fmt: skip
    bare = cid.Loop(plant, None, dt=0.005)
    record = cid.Record(u=u, y=y, dt=0.005)
    errors = []
    for loop in (bare, bare.with_effect(cid.effects.CoulombFriction(fc=fc / p["M"]))):
        index, ahead = predict_ahead(loop, record, cid.predict(loop, record), 30)
        errors.append(float(np.sqrt(np.mean((ahead - y[index]) ** 2))))
    assert errors[1] < 0.6 * errors[0]
