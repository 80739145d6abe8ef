"""fit_simulation: parameters by the error of a simulation that uses no measured output."""

import control as ct
import numpy as np
import pytest
from scipy import linalg, signal

import ctrlid as cid
from ctrlid.loop.sensitivities import build_sensitive_simulation
from ctrlid.loop.simulation import Simulator

DT = 0.001


def levitating(**values):
    """Return a levitated ball under a digital lead, and a reference that moves it."""
    plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    op = cid.operating_point(plant, output=0.012)
    C = cid.design_lead(cid.linearize(plant, op), crossover=100, phase_margin=50)
    loop = cid.Loop(plant, C.sample(DT, "tustin"), dt=DT, at=op, free=("K", "m"), **values)
    return loop, cid.random_binary(1500, amplitude=1e-4, hold=20, around=op.output, seed=1)


def driving(free=("m", "c"), **values):
    """Return a drive under proportional control, and a reference."""
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    loop = cid.Loop(plant, ct.tf([5.0], [1.0], 0.01), dt=0.01, free=free, **values)
    return loop, cid.random_binary(1500, amplitude=0.1, hold=50, seed=1)


def standing():
    """Return a cart with a pole under state feedback with an observer, and a dither."""
    plant = cid.plants.cart_pole(M=0.5, m=0.2, length=0.3, J=0.006, c=0.2, gamma=0.002)
    upright = cid.operating_point(plant, output=[0.0, 0.0])
    G = ct.sample_system(cid.linearize(plant, upright), 0.005)
    K = ct.dlqr(G, np.diag([20.0, 20.0, 1.0, 1.0]), np.eye(1))[0]
    L = G.A @ ct.dlqe(G.A, G.B, G.C, np.eye(1), 1e-4 * np.eye(2))[0]
    observer = ct.ss(G.A - L @ G.C, np.hstack([L, G.B]), -K, np.zeros((1, 3)), 0.005,
                     inputs=["x", "theta", "F"], outputs=["F"])  # fmt: skip
    loop = cid.Loop(plant, observer, dt=0.005, at=upright, free=("m", "c"))
    return loop, cid.random_binary(1200, amplitude=0.8, hold=40, seed=1)


def test_exact_values_without_noise():
    loop, r = levitating()
    record = cid.simulate(loop, r)
    for intercept in (True, False):
        start = loop.with_parameters({"K": 3.0e-6, "m": 0.0226})
        found = cid.fit_simulation(start, record, intercept=intercept)
        # A ball tells the ratio of its parameters only.
        ratio = found.estimate["K"] / found.estimate["m"]
        assert ratio == pytest.approx(3.34e-6 / 0.0213, rel=1e-6)
        assert found.estimate.errors[0] < 1e-9


def test_levels_tell_offsets_only_without_an_intercept():
    loop, r = driving(free=("c",))
    loop = loop.with_effect(cid.effects.InputOffset(offset=0.05))
    record = cid.simulate(loop, r, sensor_noise=1e-4, seed=4)
    with_levels, without = (
        cid.fit_simulation(loop.with_parameters({"c": 1.8}), record, intercept=which).estimate
        for which in (False, True)
    )
    assert with_levels["InputOffset.offset"] == pytest.approx(0.05, rel=0.01)
    assert np.isinf(without.standard_errors[1])
    assert "DO NOT DETERMINE InputOffset.offset" in str(without)
    assert without["c"] == pytest.approx(2.0, rel=2e-3)


def test_exact_values_of_a_drive_that_rubs():
    loop, r = driving()
    loop = loop.with_effect(cid.effects.CoulombFriction(fc=0.05))
    start = loop.with_parameters({"m": 1.2, "c": 1.6, "CoulombFriction.fc": 0.02})
    found = cid.fit_simulation(start, cid.simulate(loop, r)).estimate
    assert found.names == ("m", "c", "CoulombFriction.fc")
    assert found.values == pytest.approx([1.0, 2.0, 0.05], rel=2e-3)


def test_steps_of_a_reading_do_not_hide_the_parameters():
    """A reading in steps has no slope; the values come out as they do without the steps."""
    loop, r = driving()
    rough = loop.with_effect(cid.effects.Quantization(step=0.004))
    record = cid.simulate(rough, r, sensor_noise=2e-3, seed=5)
    start = rough.with_parameters({"m": 1.2, "c": 1.6})
    found = cid.fit_simulation(start, record)
    for name, true in {"m": 1.0, "c": 2.0}.items():
        low, high = found.estimate.confidence_interval(name, level=0.999)
        assert low < true < high
        assert high - low < 0.2 * true
    assert [type(e) for e in found.loop.effects] == [cid.effects.Quantization]
    assert found.loop.parameters["m"] == found.estimate["m"]


def test_exact_values_of_two_outputs():
    loop, d = standing()
    record = cid.simulate(loop, d=d)
    found = cid.fit_simulation(loop.with_parameters({"m": 0.22, "c": 0.15}), record)
    assert found.estimate.values == pytest.approx([0.2, 0.2], rel=1e-5)
    assert len(found.estimate.errors) == 2
    text = str(found.estimate)
    assert "fit by the error of the simulation, 2400 samples used" in text
    assert "rad" in text.splitlines()[-1]


@pytest.mark.parametrize("make", [levitating, driving])
def test_derivatives_are_those_of_differences(make):
    loop, r = make()
    names = tuple(loop.free)
    simulator = Simulator(loop)
    w = simulator.stack_signals(r[:200], np.zeros(200))
    maps = build_sensitive_simulation(loop, names, 1, "zoh", "zoh")
    values = loop.equations().parameters
    theta = np.array([values[name] for name in names])
    start = simulator.rest + 1e-4 * np.arange(1, len(simulator.rest) + 1)
    y, slopes = maps.run(start, w, theta, 2)
    assert y[:, 0] == pytest.approx(simulator.run(start, r[:200], np.zeros(200))[0], rel=1e-6)
    for k in range(4):
        h = 1e-6 * (theta[k] if k < 2 else 1e-3)
        ends = []
        for way in (h, -h):
            z, p = start.copy(), theta.copy()
            (p if k < 2 else z)[k % 2] += way
            ends.append(maps.run(z, w, p, 2)[0])
        wanted = (ends[0] - ends[1]) / (2 * h)
        assert slopes[:, :, k] == pytest.approx(wanted, rel=1e-4, abs=1e-5 * np.abs(wanted).max())


def log_drive(r, d, noise, step=0.0):
    """Return u and y of ``y" = -2 y' + 3 u`` under ``u = 5 (r - y) + d``, by numpy and scipy."""
    A, B = np.array([[0.0, 1.0], [0.0, -2.0]]), np.array([[0.0], [3.0]])
    whole = linalg.expm(0.01 * np.block([[A, B], [np.zeros((1, 3))]]))
    x, us, ys = np.zeros(2), [], []
    for k in range(len(r)):
        y = x[0] + noise[k]
        y = step * np.round(y / step) if step else y
        u = 5 * (r[k] - y) + d[k]
        us.append(u)
        ys.append(y)
        x = whole[:2, :2] @ x + whole[:2, 2] * u
    return np.array(us), np.array(ys)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["correlated", "encoder"])
def test_intervals_hold_under_noise_that_is_not_white(kind):
    loop, r = driving()
    errors = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        noise = 0.0015 * signal.lfilter([1.0], [1, -0.95], rng.standard_normal(len(r)))
        d = 0.05 * rng.standard_normal(len(r))
        step = 0.01 if kind == "encoder" else 0.0
        u, y = log_drive(r, d, 0.003 * rng.standard_normal(len(r)) if step else noise, step)
        record = cid.Record(r=r, u=u, y=y, dt=0.01)
        found = cid.fit_simulation(loop.with_parameters({"m": 1.1, "c": 1.9}), record).estimate
        errors.append((found.values - [1.0, 2.0]) / found.standard_errors)
    # Of 24 draws the mean is within 0.2 of zero by one standard deviation, the size within 15 %.
    assert np.all(np.abs(np.mean(errors, axis=0)) < 0.8)
    assert np.all(np.abs(np.sqrt(np.mean(np.square(errors), axis=0)) - 1) < 0.5)


def test_delay_passes_from_one_sample_to_another():
    loop, r = driving(free=("c",))
    record = cid.simulate(loop.with_effect(cid.effects.InputDelay(delay=0.017)), r)
    start = loop.with_effect(cid.effects.InputDelay(delay=0.003))
    found = cid.fit_simulation(start, record).estimate
    assert found["InputDelay.delay"] == pytest.approx(0.017, rel=1e-3)
    assert not found.active


def test_each_stretch_starts_where_it_does():
    loop, r = driving()
    record = cid.simulate(loop, r, sensor_noise=1e-4, seed=3)
    valid = np.ones(len(r), dtype=bool)
    valid[600:640] = False
    y = np.where(valid, record.y, 5.0)
    gapped = cid.Record(r=r, u=record.u, y=y, dt=0.01, valid=valid)
    start = loop.with_parameters({"m": 1.1, "c": 1.9})
    for data in (gapped, [record[:700], record[700:]]):
        found = cid.fit_simulation(start, data).estimate
        assert np.all(np.abs(found.values - [1.0, 2.0]) < 4 * found.standard_errors)
        assert found.errors[0] == pytest.approx(1e-4, rel=0.1)


def test_stable_plant_is_simulated_from_its_input():
    plant = ct.tf([2.0], [0.5, 1.0])
    G = ct.ss(plant)
    rates = ct.nlsys(
        lambda t, x, u, p: np.array([(p["k"] * u[0] - x[0]) / p["T"]]), lambda t, x, u, p: x[0],
        inputs=["u"], outputs=["y"], states=["x"], params={"k": 2.0, "T": 0.5}, name="lag",
    )  # fmt: skip
    assert G.nstates == 1
    u = cid.random_binary(800, amplitude=1.0, hold=20, seed=4)
    loop = cid.Loop(rates, None, dt=0.02, free=("k", "T"))
    record = cid.simulate(loop, d=u, sensor_noise=0.01, seed=5)
    found = cid.fit_simulation(loop.with_parameters({"k": 1.5, "T": 0.7}), record).estimate
    assert np.all(np.abs(found.values - [2.0, 0.5]) < 4 * found.standard_errors)


def test_analog_controller_runs_with_the_plant():
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    loop = cid.Loop(plant, ct.tf([20.0, 40.0], [1.0, 20.0]), dt=0.02, free=("m", "c"))
    r = cid.random_binary(800, amplitude=0.1, hold=50, seed=1)
    record = cid.simulate(loop, r, sensor_noise=1e-4, seed=2)
    found = cid.fit_simulation(loop.with_parameters({"m": 1.1, "c": 1.8}), record).estimate
    assert np.all(np.abs(found.values - [1.0, 2.0]) < 4 * found.standard_errors)


def test_value_at_its_bound_is_said_to_be():
    loop, r = driving()
    marked = []
    for seed in range(4):
        record = cid.simulate(loop, r, sensor_noise=1e-3, seed=seed)
        rubbing = loop.with_effect(cid.effects.CoulombFriction(fc=0.02))
        found = cid.fit_simulation(rubbing, record).estimate
        marked.append("CoulombFriction.fc" in found.active)
        assert ("on its bound" in str(found)) == marked[-1]
        assert found["CoulombFriction.fc"] < 0.01
    # Without friction half of the records would have a negative one.
    assert any(marked)


def refuse(loop, record, words, **how):
    with pytest.raises(cid.CtrlidError, match=words):
        cid.fit_simulation(loop, record, **how)


def test_refusals():
    loop, r = driving()
    record = cid.simulate(loop, r, sensor_noise=1e-3, seed=2)
    refuse(loop, record, "names of the parameters to fit, given .'mass'.", free="mass")
    refuse(cid.Loop(loop.plant, loop.controller, dt=0.01), record, "none was given")
    refuse(loop.plant, record, "needs a Loop")
    neutral = loop.with_effect(cid.effects.CoulombFriction(fc=0.0))
    refuse(neutral, record, "CoulombFriction.fc = 0 there is none: give a size")
    ball, height = levitating()
    logged = cid.simulate(ball, height, sensor_noise=2e-6, seed=2)
    alone = cid.Loop(ball.plant, None, dt=DT, at=ball.at, free=("K",))
    refuse(alone, logged, "not stable and the loop has no controller")
    silent = cid.Record(u=record.u, y=record.y, dt=0.01)
    refuse(loop, silent, "has no reference")
    other = cid.Loop(loop.plant, ct.tf([7.0], [1.0], 0.01), dt=0.01, free=("m", "c"))
    refuse(other, record, "the law of the controller is rejected")
    short = cid.Record(r=r[:5], u=record.u[:5], y=record.y[:5], dt=0.01)
    refuse(loop, short, "at least|too short")


def test_what_the_data_do_not_say():
    loop, r = driving(free=("m", "c", "k"))
    record = cid.simulate(loop, r, sensor_noise=1e-4, seed=2)
    found = cid.fit_simulation(loop, record).estimate
    # Mass, friction and force per volt scale together.
    assert np.isinf(found.standard_errors).all()
    assert "THE DATA DO NOT DETERMINE m, c and k" in str(found)
