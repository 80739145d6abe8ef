"""The filter and fit_loop on loops of several outputs."""

import control as ct
import numpy as np
import pytest
from scipy import linalg, stats

import ctrlid as cid
from ctrlid.estimation.likelihood.kalman_filter import Noise, predict_outputs, run_filter
from ctrlid.estimation.likelihood.likelihood import make_problem
from ctrlid.estimation.likelihood.maximization import begin_fit
from test_wiring import CART, DT, QUAD, at_rest, lqr_with_observer

NOISE = {"sensor_noise": (2e-4, 1e-3), "force_noise": (0.1, 2e-3)}


def swinging(seed=1, n=1500, plant=CART, **options):
    loop = cid.Loop(plant, lqr_with_observer(plant), dt=DT, at=at_rest(plant), **options)
    r = 0.05 * cid.random_binary(n, amplitude=1, hold=100, seed=seed)
    d = 0.5 * cid.random_binary(n, amplitude=1, hold=25, seed=seed + 1)
    return loop, cid.simulate(loop, {"xd[0]": r}, d=d, seed=seed + 2, **NOISE)


def textbook(plant, record, sensor, force):
    """Innovations and variances of a Kalman filter with vector updates, Anderson and Moore."""
    a, b, c, _ = (np.asarray(m) for m in ct.ssdata(ct.sample_system(plant, DT)))
    n, m = plant.nstates, plant.ninputs
    # A force of each velocity is held over a period.
    g = np.vstack([np.zeros((n - 2, 2)), np.eye(2)])
    held = linalg.expm(np.block([[plant.A, g], [np.zeros((2, n + 2))]]) * DT)[:n, n:]
    q, r = held @ np.diag(np.square(force)) @ held.T, np.diag(np.square(sensor))
    x, p, found = np.zeros(n), None, []
    p = np.eye(n) * 1e4
    for y, u in zip(record.y.T, np.atleast_2d(record.u).T, strict=True):
        s = c @ p @ c.T + r
        e = y - c @ x
        found.append((e, s))
        k = p @ c.T @ np.linalg.inv(s)
        x, p = x + k @ e, p - k @ s @ k.T
        x, p = a @ x + b @ u[:m], a @ p @ a.T + q
    return found


def test_scalar_updates_are_the_vector_update():
    plant = cid.linearize(CART, at_rest(CART))
    loop = cid.Loop(plant, dt=DT)
    _, record = swinging(n=400)
    problem = make_problem(loop, (), [record])
    sensor, force = np.array([2e-4, 1e-3]), np.array([0.5, 2.0])
    noise = Noise(tuple((force / sensor[0]) ** 2), sensors=((sensor[1] / sensor[0]) ** 2,))
    fit = begin_fit(problem, noise=noise)
    out = run_filter(fit.plant, fit.data[0], fit.linearized[0], noise)
    errors, variances = predict_outputs(fit.data[0], fit.linearized[0], noise)
    expected = textbook(plant, record, sensor, force)
    for k in range(100, 400):
        e, s = expected[k]
        np.testing.assert_allclose(errors[k], e, rtol=1e-5, atol=1e-9)
        np.testing.assert_allclose(variances[k] * sensor[0] ** 2, np.diag(s), rtol=1e-5)
        # The likelihood of a sample is that of its outputs one after another.
        scaled = out.variance[k] * sensor[0] ** 2
        ours = np.sum(out.innovations[k] ** 2 / scaled + np.log(scaled))
        assert ours == pytest.approx(e @ np.linalg.solve(s, e) + np.linalg.slogdet(s)[1], rel=1e-6)


def test_parameters_and_noises_are_recovered():
    loop, record = swinging(free=("m", "length", "c"))
    fitted = cid.fit_loop(loop.with_parameters({"m": 0.25, "length": 0.27, "c": 0.2}), record)
    for name in ("m", "length", "c"):
        low, high = fitted.estimate.confidence_interval(name, 0.999)
        assert low < CART.params[name] < high
    assert fitted.estimate.sensor_noise[0] == pytest.approx(NOISE["sensor_noise"], rel=0.1)
    assert fitted.estimate.force_noise == pytest.approx(NOISE["force_noise"], rel=0.35)
    assert fitted.estimate.units == (("m", "rad"), ("N", "N m"))
    told = str(fitted).splitlines()[-1]
    assert " m at x and " in told
    assert " rad at theta; of the white force: " in told
    assert " N at x_dot and " in told
    assert told.endswith(" N m at theta_dot")
    assert told.count(" at ") == 4
    truth = np.sort(loop.linearize().poles().real)
    found, errors = fitted.poles, fitted.poles_standard_errors
    order = np.argsort(found.real)
    assert (np.abs(found.real[order] - truth) <= 4 * errors[order] + 1e-6).all()


@pytest.mark.slow
def test_intervals_cover():
    hits, draws = 0, 30
    for seed in range(draws):
        loop, record = swinging(seed=100 + 5 * seed, free=("m", "length", "c"))
        given = {"m": 0.25, "length": 0.27, "c": 0.2}
        estimate = cid.fit_loop(loop.with_parameters(given), record).estimate
        for name in given:
            low, high = estimate.confidence_interval(name)
            hits += low < CART.params[name] < high
    trials = 3 * draws
    assert stats.binom.cdf(hits, trials, 0.95) > 1e-3, (hits, trials)


def test_two_inputs_and_three_outputs():
    plant = QUAD
    loop = cid.Loop(plant, lqr_with_observer(plant, weights=[10.0, 10, 10, 1, 1, 1]), dt=DT,
                    at=at_rest(plant), free=("m", "J"))  # fmt: skip
    d = 0.3 * np.array([cid.random_binary(1000, amplitude=1, hold=20, seed=s) for s in (1, 2)])
    record = cid.simulate(loop, d=d, sensor_noise=(1e-3, 1e-3, 2e-3), seed=3)
    fitted = cid.fit_loop(loop.with_parameters({"m": 0.45, "J": 2.3e-3}), record)
    for name in ("m", "J"):
        low, high = fitted.estimate.confidence_interval(name, 0.999)
        assert low < plant.params[name] < high


@pytest.mark.slow
def test_an_analog_controller_is_followed_between_the_samples():
    P = cid.linearize(CART, at_rest(CART))
    gain = ct.lqr(P, np.diag([10.0, 10, 1, 1]), np.eye(1))[0]
    slow = ct.lqe(P, np.eye(1), 1e-4 * np.eye(2))[0]
    C = ct.ss(P.A - slow @ P.C, np.hstack([slow, P.B]), -gain, np.zeros((1, 3)),
              inputs=["x", "theta", "F"], outputs="F")  # fmt: skip
    loop = cid.Loop(CART, C, dt=0.01, at=at_rest(CART), free=("length",))
    d = 0.5 * cid.random_binary(800, amplitude=1, hold=10, seed=4)
    record = cid.simulate(loop, d=d, sensor_noise=(1e-4, 5e-4), seed=5)
    estimate = cid.fit_loop(loop.with_parameters({"length": 0.28}), record).estimate
    low, high = estimate.confidence_interval("length", 0.999)
    assert low < 0.3 < high


def test_readings_of_one_output_that_do_not_count():
    loop, record = swinging(n=800, free=("length",))
    valid = np.ones((2, record.n), dtype=bool)
    valid[1, 400:420] = False
    y = record.y.copy()
    y[1, 400:420] = 3.0
    spoilt = cid.Record(r=record.r, u=record.u, y=y, dt=DT, valid=valid, names=record.names)
    low, high = cid.fit_loop(loop, spoilt).estimate.confidence_interval("length", 0.999)
    assert low < 0.3 < high
    assert not cid.predict(loop, spoilt).innovations[1, 400:420].any()


def test_gross_outliers_of_one_output_are_left_out():
    loop, record = swinging(free=("length",))
    y = record.y.copy()
    y[1, 700] = 3.0
    spoilt = cid.Record(r=record.r, u=record.u, y=y, dt=DT, names=record.names)
    fitted = cid.fit_loop(loop, spoilt)
    assert "1 OF 1500 READINGS OF theta IS A GROSS OUTLIER" in str(fitted)
    assert fitted.estimate["length"] == pytest.approx(0.3, rel=0.05)


def test_predictions_are_as_good_as_the_filter_says():
    loop, record = swinging()
    found = cid.predict(loop, record)
    assert found.y.shape == found.innovations.shape == found.spread.shape == (2, record.n)
    np.testing.assert_allclose(found.y + found.innovations, record.y, atol=1e-12)
    ratio = found.innovations[:, 200:].std(axis=1) / found.spread[:, 200:].mean(axis=1)
    assert ratio == pytest.approx([1, 1], rel=0.1)
    assert "2 outputs" in str(found)
    assert "  theta: RMS of the innovations" in str(found)
    assert str(found).endswith(" N m at theta_dot")


def test_noise_without_a_moving_mass_and_without_units_has_a_place():
    """Two tanks have two rates and no velocity: the print of their fit raised an error."""
    tanks = ct.nlsys(lambda t, x, u, p: np.array([p["a"] * u[0] - x[0], x[0] - x[1]]),
                     lambda t, x, u, p: x, inputs=["q"], outputs=["l1", "l2"],
                     states=["h1", "h2"], params={"a": 1.0}, name="tanks")  # fmt: skip
    rest = cid.OperatingPoint((0.0, 0.0), 0.0, (0.0, 0.0))
    loop = cid.Loop(tanks, None, dt=0.1, at=rest, free=("a",))
    d = cid.random_binary(600, amplitude=1.0, hold=20, seed=1)
    record = cid.simulate(loop, d=d, sensor_noise=0.01, seed=2)
    for told in (str(cid.fit_loop(loop, record)), str(cid.predict(loop, record))):
        assert all(f" [{name}]" in told for name in ("l1", "l2"))
        assert " [h1]/s at h1 and " in told
        assert told.endswith(" [h2]/s at h2")


def test_records_are_matched_by_name():
    loop, record = swinging(free=("length",))
    turned = record.select(y=("theta", "x"))
    one, other = (cid.fit_loop(loop, r).estimate["length"] for r in (record, turned))
    assert one == other
    with pytest.raises(cid.CtrlidError, match=r"has outputs \(x, theta\), but y of the record is"):
        cid.fit_loop(loop, record.select(y="theta"))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda loop, r: cid.fit_loop(loop, r, coloured=True), "leave out coloured=True"),
        (lambda loop, r: cid.predict(loop, r, noise_ratio=1.0), "for several outputs"),
        (lambda loop, r: cid.fit_loop(loop, r[:8]), "at least 10 valid samples of each output"),
    ],
)
def test_refusals(call, words):
    loop, record = swinging(n=100, free=("length",))
    with pytest.raises(cid.CtrlidError, match=f"(?i){words}"):
        call(loop, record)


def test_rotary_pendulum_of_a_real_rig(data_dir):
    if not (data_dir / "qube_furuta" / "qube_estim.npz").is_file():
        pytest.skip("needs the measured files of the QUBE")
    den = 1 + 50 * DT
    poles = np.eye(2) / den
    # The rate is 50 (e - x) with a state that lags behind: two parallel PD as one system.
    slope = 50 / den
    C = ct.ss(poles, np.eye(2) - poles, [[1.8 * slope, 2.5 * slope]],
              [[-6 - 1.8 * slope, -30 - 2.5 * slope]], DT)  # fmt: skip
    plant = cid.plants.rotary_pendulum(
        m=0.024, length=0.0645, arm=0.085, arm_inertia=0.095 * 0.085**2 / 12,
        J=0.024 * 0.129**2 / 12, kt=0.042, R=8.4, c=0.00027, gamma=5e-5,
    )  # fmt: skip
    free = ("arm_inertia", "arm", "J", "kt", "c", "gamma")
    loop = cid.Loop(plant, C, dt=DT, free=free, input_limits=(-10, 10))

    def miss(loop):
        """RMS error of the closed-loop simulation from second two on [mrad], mean of the runs."""
        sizes = []
        for run in cid.datasets.load("qube_validation"):
            part = run[1000:]
            sim = cid.simulate(loop, part.r, d=part.extra["feedforward"],
                               initial=[*part.y[:, 0], 0, 0])  # fmt: skip
            sizes.append(1e3 * np.sqrt(np.mean((sim.y - part.y) ** 2, axis=1)))
        return np.mean(sizes, axis=0)

    # As others computed it from the data sheet, and as physics alone leaves it.
    assert miss(loop) == pytest.approx([41, 31], abs=1)
    runs = [run[1000:7000:] for run in cid.datasets.load("qube_estimation")[:2]]
    fitted = cid.fit_loop(loop, runs)
    assert (miss(fitted.loop) < [16, 7.5]).all()
    assert 13.5 < fitted.poles.real.max() < 14.9
