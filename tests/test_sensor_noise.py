"""Coloured sensor noise in the likelihood, against theory and noise made by a filter."""

import dataclasses
import functools
import weakref
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal
from scipy.linalg import expm, toeplitz

import ctrlid as cid
from ctrlid._base.errors import ModelCannotRun
from ctrlid.diagnosis import gap_summary, noise_choice
from ctrlid.diagnosis.fitted_model import Model
from ctrlid.diagnosis.fresh_data import choose_fresh_data
from ctrlid.diagnosis.gap import compute_chance_among_runs, measure_noise_errors
from ctrlid.diagnosis.gap_summary import make_noise_test
from ctrlid.diagnosis.noise_choice import rings_at_line
from ctrlid.diagnosis.noise_tests import run_noise_tests
from ctrlid.diagnosis.thresholds import THRESHOLD
from ctrlid.estimation.likelihood.kalman_filter import Noise, compute_memory
from ctrlid.estimation.likelihood.likelihood import make_problem
from ctrlid.estimation.likelihood.maximization import begin_fit, choose_sensor_noise, maximize
from ctrlid.estimation.likelihood.noise.coordinates import RINGING, compute_noise_criterion
from ctrlid.estimation.likelihood.noise.fit import fit_noise
from ctrlid.estimation.likelihood.noise.orders import try_coloured_force
from problems import diagnose_draw, load_script


def simulate_servo(r, noise, dt=0.01, kp=20.0, kd=1.0, filter_time=0.02, dead_zone=0.0, force=None):
    """Return reading and input of y" = 3 u - 2 y' with a PD that sees the noise, held exactly.

    A random `force` is an acceleration that is held over each period.

    The transition is a matrix exponential: what interpolates the input between samples, as
    scipy.signal.lsim does unless told otherwise, is another plant, with a large random force.
    """
    rates = np.array([[0.0, 1.0, 0.0], [0.0, -2.0, 3.0], [0.0, 0.0, 0.0]])
    move = expm(rates * dt)
    x, d, last = np.zeros(2), 0.0, r[0] - noise[0]
    y, u = np.zeros(len(r)), np.zeros(len(r))
    for k in range(len(r)):
        y[k] = x[0] + noise[k]
        e = r[k] - y[k]
        d = (filter_time * d + kd * (e - last)) / (filter_time + dt)
        u[k], last = kp * e + d, e
        acting = u[k] - np.clip(u[k], -dead_zone, dead_zone)
        push = 0.0 if force is None else force[k] / 3.0
        x = move[:2, :2] @ x + move[:2, 2] * (acting + push)
    return y, u


def make_loop_and_record(b, a, n=1500, seed=2):
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    at = cid.OperatingPoint(states=(0.0, 0.0), input=0.0, output=0.0)
    law = cid.PID(kp=20.0, kd=1.0, filter_time=0.02)
    loop = cid.Loop(plant, law, dt=0.01, at=at, free=("k", "c"))
    rng = np.random.default_rng(seed)
    r = np.repeat(rng.choice([-0.1, 0.1], n // 50), 50)
    noise = signal.lfilter(b, a, rng.standard_normal(n + 500))[500:]
    noise *= 1e-4 / noise.std()
    y, u = simulate_servo(r, noise)
    return loop, cid.Record(r=r, u=u, y=y, dt=0.01), noise


@pytest.mark.parametrize(
    ("ar", "ma"), [((0.8,), ()), ((), (0.6,)), ((), (1.0,)), ((0.5, 0.2), (0.3, -0.4))]
)
def test_the_likelihood_is_that_of_the_dense_covariance(ar, ma):
    loop, record, _ = make_loop_and_record([1.0], [1.0])
    quiet = Noise((1e-290,))
    fit = begin_fit(make_problem(loop, (), [record]), noise=quiet)
    known = dataclasses.replace(fit.data[0], spread=0 * fit.data[0].spread)
    problem = dataclasses.replace(fit.problem, data=(known,))
    fit = begin_fit(problem, noise=dataclasses.replace(quiet, ar=ar, ma=ma))
    out = fit.filtered[0]
    # The covariance of the process, of variance one, comes from its impulse response.
    impulse = signal.lfilter([1, *ma], [1, *(-v for v in ar)], np.eye(1, 3000)[0])
    gamma = np.correlate(impulse, impulse, "full")[2999 : 2999 + len(record)]
    covariance = toeplitz(gamma / gamma[0])
    e = record.y - out.trajectory.predicted[:, 0]
    squares = np.sum(out.innovations**2 / out.variance)
    assert squares == pytest.approx(e @ np.linalg.solve(covariance, e), rel=1e-9)
    logs = np.linalg.slogdet(covariance)[1]
    assert np.sum(np.log(out.variance)) == pytest.approx(logs, rel=1e-8)


@pytest.mark.parametrize(
    ("b", "a", "orders"),
    [
        ([1.0], [1.0], (0, 0)),
        ([1.0], [1.0, -0.9], (1, 0)),
        ([0.5, 0.5], [1.0], (0, 1)),
        ([1.0, 1.0, 1.0], [1.0], (0, 2)),
    ],
)
def test_the_order_of_coloured_noise_is_found_and_white_stays_white(b, a, orders):
    loop, record, noise = make_loop_and_record(b, a, n=2500)
    fit = choose_sensor_noise(maximize(begin_fit(make_problem(loop, ("k", "c"), [record]))))
    assert (len(fit.noise.ar), len(fit.noise.ma)) == orders
    assert np.sqrt(fit.sensor[0]) == pytest.approx(noise.std(), rel=0.15)
    z = fit.standardized[0]
    z = z[np.isfinite(z)]
    assert abs(np.mean(z[1:] * z[:-1])) < 4 / np.sqrt(len(z))
    error = (fit.theta - [3.0, 2.0]) / fit.standard_errors
    assert np.abs(error).max() < 4


@pytest.mark.slow
def test_a_coloured_force_and_a_colour_of_the_sensor_are_found_beside_each_other():
    """Gusts on a plant whose sensor errs alike in successive readings."""
    loop, record, noise = make_loop_and_record([1.0], [1.0, -0.5], n=3000, seed=9)
    rng = np.random.default_rng(10)
    keep, size = np.exp(-0.01 / 0.5), 0.3
    force = signal.lfilter([size * np.sqrt(1 - keep**2)], [1.0, -keep], rng.standard_normal(3500))
    y, u = simulate_servo(record.r, noise, force=force[500:])
    record = dataclasses.replace(record, y=y, u=u)
    fit = maximize(begin_fit(make_problem(loop, ("k", "c"), [record])))
    gusts = maximize(try_coloured_force(fit))
    both = choose_sensor_noise(gusts, beside=True)
    assert both.noise.drift
    assert not both.noise.sensor_is_white
    assert compute_noise_criterion(both) > compute_noise_criterion(gusts) + 30
    assert both.noise.ar[0] == pytest.approx(0.5, abs=0.12)
    assert -0.01 / np.log(both.noise.memory) == pytest.approx(0.5, rel=0.5)
    assert np.sqrt(both.noise.coloured * both.sensor[0]) == pytest.approx(size, rel=0.3)
    assert run_noise_tests(both).passed
    # Without gusts there are none beside the colour.
    loop, record, _ = make_loop_and_record([1.0], [1.0, -0.5], n=1500)
    still = maximize(begin_fit(make_problem(loop, ("k", "c"), [record])))
    stirred = maximize(try_coloured_force(still))
    assert not choose_sensor_noise(stirred, beside=True).noise.drift


@functools.cache
def fit_beside_autoregression(controller):
    """Return loop, record and fit: two tests ask of the same true noise, which takes seconds."""
    loop, record, _ = make_loop_and_record([1.0], [1.0, -0.9], n=4000, seed=5)
    if controller == "unknown":
        loop = dataclasses.replace(loop, controller=None)
    fit = maximize(begin_fit(make_problem(loop, ("k", "c"), [record])))
    return loop, record, choose_sensor_noise(fit)


@pytest.mark.parametrize("controller", ["known", "unknown"])
def test_noise_larger_than_the_gap_is_refused_and_true_noise_is_not(controller):
    loop, record, fit = fit_beside_autoregression(controller)
    assert not fit.noise.sensor_is_white
    is_false = make_noise_test(choose_fresh_data(loop, [record], None))
    assert not is_false(Model(loop, fit))
    # The same record with the noise three times as large as it is.
    larger = dataclasses.replace(fit, sensor=9 * fit.sensor)
    assert is_false(Model(loop, larger))


@pytest.mark.parametrize(("floor", "wider", "refused"), [
    (2.0, 1e-4, True),  # far larger than the error, and the model errs more
    (2.0, 0.3, False),  # as large by chance, and no harm
    (1.0, 1e-4, False),  # as large as the error: noise makes it err
])  # fmt: skip
def test_a_wander_that_makes_a_model_err_more_is_refused(monkeypatch, floor, wider, refused):
    fresh = SimpleNamespace(
        windows=(), how=None, prepare_loops=lambda model: (), measure_gap=lambda loops: 1.0,
        compute_widening_chance=lambda before, model: wider,
        compute_size_chance=lambda loops, fit: 0.07,
    )  # fmt: skip
    monkeypatch.setattr(gap_summary.gaps, "compute_floor", lambda *_: SimpleNamespace(both=floor))
    model = Model(None, None)
    assert make_noise_test(fresh)(model, model) is refused
    assert not make_noise_test(fresh)(model)


@pytest.mark.parametrize(("floors", "gaps", "narrower", "refused"), [
    ((3.0, 10.0), (1.0, 1.0), False, False),  # the other noise exceeds the error by more
    ((3.0, 2.0), (1.0, 1.0), False, True),
    ((1.2, 1.0), (1.0, 4.0), True, False),  # the model errs less than beside the other noise
    ((1.2, 1.0), (1.0, 1.0), False, True),
])  # fmt: skip
def test_noise_is_refused_for_what_is_better(monkeypatch, floors, gaps, narrower, refused):
    model, other = (Model(None, k) for k in range(2))
    fresh = SimpleNamespace(
        windows=(), how=None, prepare_loops=lambda m: m.fit, measure_gap=lambda k: gaps[k],
        compute_widening_chance=lambda one, two: 1e-4 if narrower and two is other else 0.3,
        compute_size_chance=lambda loops, k: 1e-4 if floors[k] > gaps[k] else 0.5,
    )  # fmt: skip
    monkeypatch.setattr(gap_summary.gaps, "compute_floor",
                        lambda loops, k, *_: SimpleNamespace(both=floors[k]))  # fmt: skip
    assert make_noise_test(fresh)(model, other) is refused


def test_a_model_is_simulated_once_for_both_questions_and_not_kept(monkeypatch):
    asked = []
    fresh = SimpleNamespace(
        windows=(), how=None, prepare_loops=lambda m: (), measure_gap=lambda loops: 1.0,
        compute_widening_chance=lambda one, two: 0.3,
        compute_size_chance=lambda loops, k: asked.append(k) or 1e-4,
    )  # fmt: skip
    monkeypatch.setattr(gap_summary.gaps, "compute_floor", lambda *_: SimpleNamespace(both=1.2))
    model, is_false = Model(None, 0), make_noise_test(fresh)
    assert is_false(model)
    is_false(model, Model(None, 1))
    assert asked.count(0) == 1
    kept = weakref.ref(model)
    del model
    assert kept() is None


@pytest.mark.slow
def test_a_delay_beside_averaged_noise_is_named():
    """The force that stands for the delay is too large beside any noise of the sensor."""
    study = load_script("benchmarks", "study_suspects")
    draw = study.rigs.draw("plant-delay", "pendulum", 731, 3000)
    found = cid.diagnose(study.make_loop(draw), study.make_record(draw), progress=False)
    (finding,) = found.findings
    assert "InputDelay" in finding.names
    assert found.noise.kind == "coloured"


def test_the_chance_among_runs_keeps_its_level():
    # Of true noise one in a hundred is refused.
    rng = np.random.default_rng(7)
    runs = np.sqrt(rng.chisquare(20, (4000, 9)))
    low = [compute_chance_among_runs(float(r[0]), r[1:]) < 0.01 for r in runs]
    assert 0.004 < np.mean(low) < 0.02


def test_the_runs_of_a_chance_spread_as_many_more_do():
    """Of the first 8 seeds errors are alike by chance, which made true noise look false."""
    loop, record, fit = fit_beside_autoregression("known")
    fresh = choose_fresh_data(loop, [record], None)
    errors = measure_noise_errors(fresh.prepare_loops(Model(loop, fit)), fit, fresh.windows,
                                  fresh.how, 300)[:, 0]  # fmt: skip
    spread = np.std(np.log(errors[: THRESHOLD.size_runs]))
    assert spread == pytest.approx(np.std(np.log(errors)), rel=0.25)


@pytest.mark.parametrize(("name", "plant"), [
    ("ar", "drive"), pytest.param("ar", "pendulum", marks=pytest.mark.slow),
    pytest.param("averaged", "ball", marks=pytest.mark.slow),
])  # fmt: skip
def test_the_order_is_asked_again_where_the_colour_has_moved_the_parameters(name, plant):
    """Beside parameters that a random force had led astray an average looked like a wander."""
    study = load_script("benchmarks", "study_suspects")
    draw = study.rigs.draw(name, plant, 721, 3000)
    found = cid.diagnose(study.make_loop(draw), study.make_record(draw), progress=False,
                         catalogue=(cid.effects.ConstantForce, cid.effects.SensorLag))  # fmt: skip
    assert found.verdict == "nothing missing"
    if name == "ar":
        assert "ARMA(1, 0)" in found.noise.words
        return
    # A small coefficient may be made up by chance, on either side; the average is there.
    colour = [1.0, *found.noise.ma], [1.0, *(-v for v in found.noise.ar)]
    response = signal.lfilter(*colour, np.eye(1, 50)[0])
    alike = np.correlate(response, response, "full")[49:55]
    count = draw.truth["samples"]
    expected = np.maximum(1 - np.arange(6) / count, 0)
    assert alike / alike[0] == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize("count", [2, 3, pytest.param(4, marks=pytest.mark.slow)])
def test_an_average_over_samples_is_found_as_such(count):
    """Its zeros are on the unit circle, which a search from within does not reach."""
    loop, record, _ = make_loop_and_record(np.ones(count), [1.0], n=2000, seed=7)
    fit = choose_sensor_noise(maximize(begin_fit(make_problem(loop, ("k", "c"), [record]))))
    assert np.array(fit.noise.ma) == pytest.approx(np.ones(count - 1), abs=0.01)


def test_the_memory_of_noise_is_that_of_its_autocorrelation():
    # Of an autoregression of order one the sum is (1 + a^2) / (1 - a^2).
    memory = compute_memory(Noise((1.0,), ar=(0.9,)), 2000)
    assert memory == pytest.approx((1 + 0.81) / (1 - 0.81), rel=1e-6)
    assert compute_memory(Noise((1.0,)), 2000) == pytest.approx(1)
    assert compute_memory(Noise((1.0,), ma=(1.0,)), 2000) == pytest.approx(1.5)


def test_holding_the_colour_fits_the_force_alone():
    loop, record, _ = make_loop_and_record([1.0], [1.0, -0.8])
    start = begin_fit(make_problem(loop, ("k", "c"), [record]), noise=Noise((1e2,), ar=(0.6,)))
    held = fit_noise(start.problem, start.theta, start.linearized, start.noise, hold_colour=True)
    free = fit_noise(start.problem, start.theta, start.linearized, start.noise)
    assert held.noise.ar == pytest.approx((0.6,))
    assert held.noise.force != start.noise.force
    assert free.noise.ar[0] == pytest.approx(0.8, abs=0.05)
    assert free.value > held.value > start.value


def fit_white_noise(noise, seed):
    """Return the fit of a servo that takes the given noise of its sensor as white."""
    loop, _, _ = make_loop_and_record([1.0], [1.0])
    rng = np.random.default_rng(seed)
    r = np.repeat(rng.choice([-0.1, 0.1], len(noise) // 50), 50)
    y, u = simulate_servo(r, noise)
    record = cid.Record(r=r, u=u, y=y, dt=0.01)
    return maximize(begin_fit(make_problem(loop, ("k", "c"), [record]), noise=Noise((1e-2,))))


@pytest.mark.parametrize("seed", [6, 7, 8])
def test_the_search_for_a_walk_ends_at_a_maximum(seed):
    rng, n = np.random.default_rng(seed + 100), 2000
    noise = 1e-4 * (rng.standard_normal(n) + 0.05 * np.cumsum(rng.standard_normal(n)))
    fit = fit_white_noise(noise, seed)
    root = 1 - 1 / n
    for force in (1e-4, 1.0, 1e4):
        for step in (0.01, 0.3):
            start = Noise((force,), ar=(root,), ma=(-root * (1 - step),))
            found = fit_noise(fit.problem, fit.theta, fit.linearized, start)
            # A walk stays one, and its root is no parameter.
            assert found.noise.ar[0] == pytest.approx(root, abs=1e-9)
            again = fit_noise(fit.problem, fit.theta, fit.linearized, found.noise)
            assert again.value < found.value + 0.1


def test_what_rings_for_a_fair_part_of_the_record_is_a_line():
    n = 2000
    noise = 1e-4 * np.random.default_rng(3).standard_normal(n)
    noise += 2e-4 * np.sin(2 * np.pi * 0.4 * np.arange(n))
    fit = fit_white_noise(noise, 3)
    turn = 2 * np.cos(2 * np.pi * 0.4)
    start = Noise((1e-2,), ar=(0.999 * turn, -(0.999**2)), ma=(-0.9 * turn, 0.9**2))
    found = fit_noise(fit.problem, fit.theta, fit.linearized, start).noise
    poles = np.roots([1.0, -found.ar[0], -found.ar[1]])
    assert np.abs(np.angle(poles)) == pytest.approx(2 * np.pi * 0.4, abs=0.01)
    assert -1 / np.log(np.abs(poles)) == pytest.approx(RINGING * n, rel=0.01)


@pytest.mark.parametrize(("frequency", "there"), [(40.0, True), (60.0, True), (140.0, True),
                                                  (40.5, False)])  # fmt: skip
def test_a_resonance_is_where_a_line_folds_to(frequency, there):
    ar = (2 * 0.99 * np.cos(2 * np.pi * 0.4), -(0.99**2))
    fit = SimpleNamespace(noise=Noise((1.0,), ar=ar), size=2000,
                          plant=SimpleNamespace(loop=SimpleNamespace(dt=0.01)))  # fmt: skip
    hum = cid.effects.SensorHum(amplitude=1.0, frequency=frequency, phase=0.0)
    assert rings_at_line(fit, hum) is there
    assert not rings_at_line(fit, cid.effects.SensorDrift(1.0))
    white = SimpleNamespace(noise=Noise((1.0,)), size=2000, plant=fit.plant)
    assert not rings_at_line(white, hum)


def test_a_line_that_cannot_be_fitted_beside_the_noise_is_not_taken_first(monkeypatch):
    ar = (2 * 0.99 * np.cos(2 * np.pi * 0.4), -(0.99**2))
    other = SimpleNamespace(noise=Noise((1.0,), ar=ar), size=2000,
                            plant=SimpleNamespace(loop=SimpleNamespace(dt=0.01)))  # fmt: skip
    hum = cid.effects.SensorHum(amplitude=1.0, frequency=60.0, phase=0.0)
    best = SimpleNamespace(fitted=hum, net_gain=100.0, penalty=20.0, model=None)
    model, asked = SimpleNamespace(fitted=SimpleNamespace(effects=())), []

    def refuse(model):
        asked.append(model)
        raise ModelCannotRun("the filter loses the record")

    monkeypatch.setattr(noise_choice, "with_linearization", refuse)
    assert not noise_choice._takes_line(other, best, model)
    assert len(asked) == 1


@pytest.mark.slow
def test_a_line_beside_averaged_noise_is_named():
    """A resonance of the noise model takes a strong line nearly for itself."""
    few = [cid.effects.SensorHum, cid.effects.SensorLag]
    case, found = diagnose_draw("one", 80031, few)
    assert case.hidden == ("SensorHum",)
    assert found.verdict == "explained"
    (one,) = found.findings
    assert one.name == "SensorHum"
    assert one.effect.amplitude == pytest.approx(case.sizes[0]["hum"], rel=0.01)
    assert found.noise.kind == "coloured"
