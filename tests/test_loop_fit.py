"""fit_loop: exact recovery, scatter as the standard errors say, exact information, refusals.

Groups: without noise; scatter; what is fitted with what; information; noise; limits; refusals.
"""

import re
from dataclasses import replace

import control as ct
import numpy as np
import pytest
from scipy import stats

import ctrlid as cid
from ctrlid import CtrlidError
from ctrlid import effects as E
from ctrlid._base.text import with_error
from ctrlid.estimation.likelihood.likelihood import (
    evaluate_likelihood,
    make_problem,
    pseudo_inverse,
)
from ctrlid.estimation.likelihood.maximization import (
    begin_fit,
    compute_information,
    maximize,
    refit_noise_size,
)
from ctrlid.estimation.likelihood.noise.force_size import measure_doubt_by_force
from ctrlid.loop.simulation import Simulator
from problems import astray, drive, levitation, load_script, record_of, tanks

RARE = 1e-5  # chance at which a test of chance may fail a right program


def sampled(free=("gain", "pole")):
    """A first-order plant that grows, written in discrete time."""

    def update(t, x, u, params):
        return np.array([params["pole"] * x[0] + params["gain"] * np.tanh(u[0])])

    values = {"gain": 0.3, "pole": 1.05}
    plant = ct.nlsys(update, lambda t, x, u, params: x[0], name="reactor", inputs=["q"],
                     outputs=["T"], states=["T"], dt=0.5, params=values)  # fmt: skip
    return cid.Loop(plant, ct.tf([0.6], [1.0], 0.5), dt=0.5, free=free)


LOOPS = {
    "levitation": (levitation, 1e-4, 15, 5e-6),
    "analog levitation": (lambda **k: levitation(analog=True, **k), 1e-4, 15, 5e-6),
    "drive": (drive, 0.05, 40, 2e-3),
    "discrete time": (sampled, 0.5, 5, 0.02),
}


def experiment(loop, swing, hold, n=3000, seed=1, **noise):
    return record_of(loop, swing=swing, hold=hold, n=n, seed=seed, noise_seed=seed + 1000, **noise)


def shaken(loop, r, seed, sensor, force=0.0, coloured=0.0, time=1.0):
    """A record with a coloured force; `time` is its time constant [s]."""
    rng = np.random.default_rng(seed)
    memory = np.exp(-loop.dt / time)
    white = rng.standard_normal((3, len(r)))
    push = np.empty(len(r))
    d = white[2, 0]
    for k in range(len(r)):
        push[k] = d
        d = memory * d + np.sqrt(1 - memory**2) * white[2, k]
    simulator = Simulator(loop)
    noise = [sensor * white[0], force * white[1] + coloured * push]
    y, u = simulator.run(simulator.start(None), r, np.zeros(len(r)), noise)
    return cid.Record(r=r, u=u, y=y, dt=loop.dt, hold="foh" if loop.analog else "zoh")


# --- without noise


@pytest.mark.parametrize("name", list(LOOPS))
def test_without_noise_the_truth_is_found(name):
    build, swing, hold, _ = LOOPS[name]
    loop = build()
    record = experiment(loop, swing, hold, n=1500)
    for seed in range(2):
        fitted = cid.fit_loop(astray(loop, seed), record)
        for key in loop.free:
            assert fitted.estimate[key] == pytest.approx(loop.parameters[key], rel=1e-5)
        assert fitted.loop.parameters == {
            **loop.parameters, **dict(zip(fitted.estimate.names, fitted.estimate.values,
                                          strict=True))}  # fmt: skip


@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_a_straight_or_held_input(hold):
    t = 0.02 * np.arange(1500)
    u = np.sin(3 * t) + 0.4 * np.sin(11 * t + 1)
    if hold == "foh":
        y = np.ravel(ct.forced_response(ct.tf([30.0], [2.0, 5.0, 0.0]), t, u).outputs)
    else:
        G = ct.sample_system(ct.tf([30.0], [2.0, 5.0, 0.0]), 0.02)
        y = np.ravel(ct.forced_response(G, t, u).outputs)
    loop = cid.Loop(drive().plant, None, dt=0.02, free=("c", "k"))
    record = cid.Record(u=u, y=y, dt=0.02, hold=hold)
    found = cid.fit_loop(astray(loop, 1), record).estimate
    assert found["c"] == pytest.approx(5.0, rel=1e-6)
    assert found["k"] == pytest.approx(30.0, rel=1e-6)


# --- scatter


@pytest.mark.parametrize("name", list(LOOPS))
def test_errors_scatter_as_their_standard_errors_say(name):
    """Both sums are of normal deviates, if intervals are to cover as they promise."""
    build, swing, hold, sensor = LOOPS[name]
    loop = build()
    runs = 6 if loop.analog else 12
    z = []
    for seed in range(runs):
        record = experiment(loop, swing, hold, n=1000, seed=3000 + seed, sensor_noise=sensor)
        found = cid.fit_loop(astray(loop, seed), record, coloured=False).estimate
        truth = [loop.parameters[k] for k in found.names]
        z.append((found.values - truth) / found.standard_errors)
    for column in np.transpose(z):
        total = float(np.sum(column**2))
        assert stats.chi2.cdf(total, runs) > RARE
        assert stats.chi2.sf(total, runs) > RARE
        assert abs(column.mean()) * np.sqrt(runs) < stats.norm.isf(RARE)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(LOOPS))
def test_intervals_cover(name):
    build, swing, hold, sensor = LOOPS[name]
    loop = build()
    runs, inside = 400, 0
    for seed in range(runs):
        record = experiment(loop, swing, hold, n=3000, seed=90_000 + seed, sensor_noise=sensor)
        found = cid.fit_loop(astray(loop, seed), record).estimate
        for key in found.names:
            low, high = found.confidence_interval(key)
            inside += low < loop.parameters[key] < high
    assert stats.binomtest(inside, runs * len(loop.free), 0.95).pvalue > 1e-3


# --- what is fitted with what


def test_effects_are_fitted_with_the_plant():
    loop = levitation()
    real = loop.with_effect(E.ViscousFriction(c=3.0)).with_effect(E.ActuatorLag(tau=1.5e-3))
    record = experiment(real, 1e-4, 15, n=4000, sensor_noise=2e-6)
    start = loop.with_effect(E.ViscousFriction(c=0.0)).with_effect(E.ActuatorLag(tau=2e-3))
    found = cid.fit_loop(start, record).estimate
    assert found.names == ("K", "ViscousFriction.c", "ActuatorLag.tau")
    truth = np.array([3.34e-6, 3.0, 1.5e-3])
    assert (np.abs(found.values - truth) < 4.5 * found.standard_errors).all()
    assert (found.standard_errors < [1e-2 * 3.34e-6, 0.5, 2e-4]).all()
    only = cid.fit_loop(start, record, free="ViscousFriction.c")
    assert only.estimate.names == ("ViscousFriction.c",)
    assert only.loop.parameters["ActuatorLag.tau"] == 2e-3


def test_free_coefficients_of_an_unstable_transfer_function():
    """No reference in the record, no controller known: instruments would have nothing to use."""
    dt, u0, y0 = 2e-3, 3.0, 0.012
    G = ct.tf([-6.5], [1.0, 0.0, -1635.0])
    C = cid.design_lead(G, crossover=100, phase_margin=50).sample(dt, "tustin")
    at = cid.OperatingPoint((), u0, y0)
    real = cid.Loop(G, C, dt=dt, at=at)
    r = cid.random_binary(6000, amplitude=1e-4, hold=15, around=y0, seed=5)
    record = cid.simulate(real, r, sensor_noise=5e-6, seed=6)
    bare = cid.Record(u=record.u, y=record.y, dt=dt)
    start = cid.Loop(ct.tf([-5.0], [1.0, 10.0, -1300.0]), None, dt=dt, at=at,
                     free=("a1", "a2", "b1"))  # fmt: skip
    fitted = cid.fit_loop(start, bare)
    found = fitted.estimate
    truth = np.array([0.0, -1635.0, -6.5])
    assert (np.abs(found.values - truth) < 4.5 * found.standard_errors).all()
    assert (found.standard_errors < [2.0, 30.0, 0.1]).all()
    assert isinstance(fitted.loop.plant, ct.TransferFunction)
    assert fitted.loop.plant.num[0][0][0] == pytest.approx(-6.5, rel=0.05)
    # A fit that knows of no noise in y is far off on the same record.
    naive = cid.fit_arx(bare, na=2, nb=2).estimate
    b = ct.sample_system(G, dt).num[0][0].sum()
    assert abs((naive["b1"] + naive["b2"]) / b - 1) > 0.05


def test_several_records_share_what_they_have_in_common():
    loop = levitation()
    records = [experiment(loop, 1e-4, 15, n=1500, seed=s, sensor_noise=v)
               for s, v in ((11, 3e-6), (12, 9e-6))]  # fmt: skip
    start = astray(loop, 3)
    alone = [cid.fit_loop(start, r, coloured=False).estimate for r in records]
    both = cid.fit_loop(start, records, coloured=False).estimate
    turned = cid.fit_loop(start, records[::-1], coloured=False).estimate
    np.testing.assert_allclose(both.values, turned.values, atol=0.02 * both.standard_errors[0])
    np.testing.assert_allclose(both.sensor_noise, [3e-6, 9e-6], rtol=0.1)
    np.testing.assert_allclose(turned.sensor_noise[::-1], both.sensor_noise, rtol=1e-2)
    weights = np.array([e.standard_errors[0] ** -2 for e in alone])
    mean = weights @ [e["K"] for e in alone] / weights.sum()
    assert abs(both["K"] - mean) < 0.3 * both.standard_errors[0]
    assert both.standard_errors[0] == pytest.approx(weights.sum() ** -0.5, rel=0.1)
    assert both.n_samples == sum(e.n_samples for e in alone)
    twice = cid.fit_loop(start, [records[0]] * 2, coloured=False).estimate
    assert twice["K"] == pytest.approx(alone[0]["K"], abs=0.05 * alone[0].standard_errors[0])
    # Twice the data, which also say twice as well how large the random force may be.
    assert 0.93 < twice.standard_errors[0] * 2**0.5 / alone[0].standard_errors[0] < 1.02


def test_a_force_that_hardly_shows_widens_what_it_may_have_moved():
    """The bias of the input was known far too well where the likeliest force is none."""
    real, free = drive().with_effect(E.InputOffset(offset=0.05)), ("k", "c", "InputOffset.offset")
    z, narrow = [], []
    for seed in range(500, 532, 2):
        record = record_of(real, swing=0.3, hold=60, n=1000, seed=seed, sensor_noise=1e-2,
                           force_noise=0.3)  # fmt: skip
        fit = fit_of(real, record, free)
        matrix = np.linalg.inv(compute_information(fit)[0])[:3, :3]
        off = fit.theta[2] - 0.05
        z.append(off / np.sqrt(matrix[2, 2] + measure_doubt_by_force(fit)[2, 2]))
        narrow.append(off / np.sqrt(matrix[2, 2]))
    assert 0.3 < np.mean(np.square(z)) < 1.5
    assert np.mean(np.square(z)) < 0.85 * np.mean(np.square(narrow))


def test_a_force_that_is_seen_adds_no_doubt():
    loop = drive()
    names = ("k", "c")
    rig = {"swing": 0.3, "hold": 60, "n": 1200, "seed": 600}
    seen = record_of(loop, **rig, sensor_noise=1e-3, force_noise=10.0)
    np.testing.assert_array_equal(measure_doubt_by_force(fit_of(loop, seen, names)), 0.0)
    hidden = record_of(loop, **rig, sensor_noise=1e-2)
    doubt = measure_doubt_by_force(fit_of(loop, hidden, names))
    assert np.linalg.eigvalsh(doubt / np.sqrt(np.outer(*[np.diag(doubt)] * 2))).min() > -1e-9
    assert np.diag(doubt).min() > 0


def fit_of(loop, record, names):
    """The most likely parameters, with the noise that was found."""
    return refit_noise_size(maximize(begin_fit(make_problem(loop, names, [record]))))


def test_what_is_not_valid_and_the_reference_do_not_matter():
    loop = levitation()
    record = experiment(loop, 1e-4, 15, n=2500, sensor_noise=5e-6)
    plain = cid.fit_loop(astray(loop, 1), record, coloured=False).estimate
    bare = cid.Record(u=record.u, y=record.y, dt=record.dt)
    unknown = cid.Loop(loop.plant, None, dt=loop.dt, at=loop.at, free=loop.free)
    other = cid.fit_loop(astray(unknown, 2), bare, coloured=False).estimate
    assert other["K"] == pytest.approx(plain["K"], abs=0.05 * plain.standard_errors[0])
    valid = np.ones(2500, dtype=bool)
    valid[600:900] = valid[1700:1703] = False
    y, u = record.y.copy(), record.u.copy()
    y[~valid], u[~valid] = 1.0, 99.0
    fits = [cid.fit_loop(loop, cid.Record(u=a, y=b, dt=record.dt, valid=valid), coloured=False)
            for a, b in ((record.u, record.y), (u, y))]  # fmt: skip
    np.testing.assert_array_equal(fits[0].estimate.values, fits[1].estimate.values)
    assert fits[0].estimate.n_samples < 2197
    assert abs(fits[0].estimate["K"] - 3.34e-6) < 4.5 * fits[0].estimate.standard_errors[0]


def test_the_start_does_not_matter():
    loop = drive()
    record = experiment(loop, 0.05, 40, sensor_noise=2e-3)
    ends = [cid.fit_loop(astray(loop, s), record, coloured=False).estimate for s in range(4)]
    ends.append(cid.fit_loop(loop.with_parameters({"c": 1.0, "k": 90.0}), record,
                             coloured=False).estimate)  # fmt: skip
    for e in ends[1:]:
        assert (np.abs(e.values - ends[0].values) < 0.15 * ends[0].standard_errors).all()
        # Which samples count at the start may differ by a few.
        assert abs(e.n_samples - ends[0].n_samples) < 10
        mean = ends[0].log_likelihood / ends[0].n_samples
        assert e.log_likelihood / e.n_samples == pytest.approx(mean, rel=1e-3)


# --- information


def point(loop, record, **noise):
    """The likelihood at its maximum, as `fit_loop` finds it."""
    from ctrlid.estimation.likelihood.maximization import begin_fit, maximize

    problem = make_problem(loop, loop.free, [record])
    return maximize(begin_fit(problem))


def moved(fit, theta):
    at = [out.trajectory for out in fit.filtered]
    for _ in range(3):  # the trajectory follows the parameters
        there = evaluate_likelihood(fit.problem, theta, fit.noise, at)
        at = [out.trajectory for out in there.filtered]
    return there.value


@pytest.mark.parametrize("name", ["levitation", "analog levitation", "drive"])
def test_the_information_is_the_curvature_of_the_likelihood(name):
    """By differences, the sensor's variance being the best at every point, the ratio held."""
    build, swing, hold, sensor = LOOPS[name]
    loop = build(free=("K", "g")) if "lev" in name else build()
    record = experiment(loop, swing, hold, n=6000, seed=21, sensor_noise=sensor,
                        force_noise=0.3 if "lev" in name else 1.0)  # fmt: skip
    fit = point(loop, record)
    matrix, score = compute_information(fit)
    p = len(fit.theta)
    assert len(matrix) == p + 2  # force ratio and sensor variance beside them
    np.testing.assert_allclose(matrix, matrix.T, rtol=1e-10)
    # The score vanishes at the maximum, in units of its own spread.
    assert (np.abs(score) < 0.1 * np.sqrt(np.diag(matrix))).all()
    h = 0.5 / np.sqrt(np.diag(matrix)[:p])
    hessian = np.zeros((p, p))
    for i in range(p):
        for j in range(p):
            values = [moved(fit, fit.theta + a * h[i] * np.eye(p)[i] + b * h[j] * np.eye(p)[j])
                      for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))]  # fmt: skip
            both = values[0] - values[1] - values[2] + values[3]
            hessian[i, j] = -both / (4 * h[i] * h[j])
    # The variance was profiled: take it out of the information in the same way.
    keep = [*range(p), p + 1]
    inner = matrix[np.ix_(keep, keep)]
    expected = inner[:p, :p] - np.outer(inner[:p, p], inner[p, :p]) / inner[p, p]
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(hessian / np.outer(size, size), expected / np.outer(size, size),
                               atol=0.1)  # fmt: skip


def test_standard_errors_without_any_force_noise():
    """An analog loop sampled slowly, where no force noise is found: errors are as large as held.

    With the gain of the filter held, the information is that of the slopes; the exact one is nearly
    the same, as what the noise tells of the parameters is little.
    """
    draw = load_script("benchmarks", "study_iv").draw_analog(
        np.random.default_rng([3, 0, 0]), 0.5, 0.01
    )
    loop, record = draw.loop, draw.record
    names = loop.free
    start = begin_fit(make_problem(loop, names, [record]))
    fit = maximize(start)
    held = np.sqrt(np.diag(pseudo_inverse(fit.normal[0])))
    exact = np.sqrt(np.diag(pseudo_inverse(compute_information(fit)[0])))[: len(names)]
    np.testing.assert_allclose(exact, held, rtol=0.05)


def test_the_covariance_is_the_inverse_of_the_information():
    loop = drive()
    record = experiment(loop, 0.05, 40, n=2000, sensor_noise=2e-3, force_noise=1.0)
    fitted = cid.fit_loop(loop, record, coloured=False)
    again = point(loop, record)
    inverse = np.linalg.inv(compute_information(again)[0])[:2, :2]
    np.testing.assert_allclose(fitted.estimate.covariance, inverse, rtol=1e-2)
    low, high = fitted.estimate.confidence_interval("c", 0.68269)
    assert (high - low) / 2 == pytest.approx(fitted.estimate.standard_errors[0], rel=1e-4)
    assert (high + low) / 2 == pytest.approx(fitted.estimate["c"])


# --- noise


def test_the_noise_is_found_with_the_parameters():
    loop = levitation()
    r = cid.random_binary(8000, amplitude=1e-4, hold=15, around=0.012, seed=31)
    record = cid.simulate(loop, r, sensor_noise=5e-6, force_noise=0.2, seed=32)
    found = cid.fit_loop(astray(loop, 5), record).estimate
    assert found.sensor_noise[0] == pytest.approx(5e-6, rel=0.1)
    assert found.force_noise == pytest.approx(0.2, rel=0.2)
    assert found.coloured_force == 0.0
    assert np.isnan(found.force_time)
    assert abs(found["K"] - 3.34e-6) < 4.5 * found.standard_errors[0]


@pytest.mark.parametrize("analog", [False, True])
def test_a_coloured_force_is_found(analog):
    loop = levitation(analog=analog)
    r = cid.random_binary(8000, amplitude=1e-4, hold=15, around=0.012, seed=41)
    record = shaken(loop, r, 42, 3e-6, coloured=0.2, time=0.05)
    found = cid.fit_loop(astray(loop, 6), record).estimate
    assert found.coloured_force == pytest.approx(0.2, rel=0.3)
    assert 0.03 < found.force_time < 0.09
    assert abs(found["K"] - 3.34e-6) < 4.5 * found.standard_errors[0]
    white = cid.fit_loop(astray(loop, 6), record, coloured=False).estimate
    assert white.coloured_force == 0.0
    assert white.bic > found.bic + 20
    assert "coloured force" in str(found)
    assert "coloured force" not in str(white)


def test_a_coloured_force_can_be_asked_for():
    loop = drive()
    record = experiment(loop, 0.05, 40, n=1500, sensor_noise=2e-3)
    asked = cid.fit_loop(loop, record, coloured=True).estimate
    plain = cid.fit_loop(loop, record).estimate
    assert asked.coloured_force > 0
    assert plain.coloured_force == 0
    assert asked.log_likelihood > plain.log_likelihood - 0.5
    assert asked.bic > plain.bic


# --- limits


def test_a_parameter_on_its_bound_is_said_to_be():
    loop = levitation()
    # Less friction than none: the plant pushes itself along.
    real = loop.with_effect(E.ViscousFriction(c=0.0))
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], 9.81 - 3.34e-6 * u[0] ** 2 / (0.0213 * x[0] ** 2)
                                     + 8.0 * x[1]]),
        lambda t, x, u, p: x[0], inputs=["V"], outputs=["x"], states=["x", "v"],
    )  # fmt: skip
    driven = cid.Loop(plant, loop.controller, dt=loop.dt, at=loop.at)
    record = experiment(driven, 1e-4, 15, sensor_noise=2e-6)
    found = cid.fit_loop(real, record, coloured=False).estimate
    assert found.active == ("ViscousFriction.c",)
    assert found["ViscousFriction.c"] == 0.0
    assert "ViscousFriction.c = 0 (on its bound)\n" in str(found)


def test_parameters_that_do_the_same_are_said_to():
    loop = levitation(free=("K", "m"))
    record = experiment(loop, 1e-4, 15, sensor_noise=5e-6)
    fitted = cid.fit_loop(astray(loop, 7), record)
    found = fitted.estimate
    assert np.isinf(found.standard_errors).all()
    assert found.notes == (
        "THE DATA DO NOT DETERMINE K and m: other parameters can compensate a change of them",
    )
    assert str(found).count("(not determined by the data)") == 2
    ratio = fitted.loop.parameters["K"] / fitted.loop.parameters["m"]
    assert ratio == pytest.approx(3.34e-6 / 0.0213, rel=1e-3)
    alone = cid.fit_loop(levitation(), record).estimate
    assert np.isfinite(alone.standard_errors).all()
    assert alone.notes == ()


def test_the_rest_is_determined_all_the_same():
    loop = drive(free=("m", "c", "k"))
    record = experiment(loop, 0.05, 40, sensor_noise=2e-3)
    found = cid.fit_loop(loop, record).estimate
    assert np.isinf(found.standard_errors).all()  # only the ratios are in u and y
    real = levitation(free=("m", "K")).with_effect(E.ViscousFriction(c=3.0))
    record = experiment(real, 1e-4, 15, sensor_noise=5e-6)
    found = cid.fit_loop(real, record).estimate
    assert np.isinf(found.standard_errors[:2]).all()
    assert np.isfinite(found.standard_errors[2])
    assert abs(found["ViscousFriction.c"] - 3.0) < 4.5 * found.standard_errors[2]


def test_a_parameter_without_any_influence():
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([p["gain"] * u[0] - x[0] + 0.0 * p["idle"]]),
        lambda t, x, u, p: x[0], inputs=["u"], outputs=["y"], states=["x"],
        params={"gain": 2.0, "idle": 1.0},
    )  # fmt: skip
    loop = cid.Loop(plant, None, dt=0.1, free=("gain", "idle"))
    u = cid.random_binary(1000, amplitude=1.0, hold=10, seed=1)
    record = cid.simulate(loop, d=u, sensor_noise=0.05, seed=2)
    found = cid.fit_loop(loop, record).estimate
    assert found["idle"] == 1.0
    assert np.isinf(found.standard_errors[1])
    assert abs(found["gain"] - 2.0) < 4.5 * found.standard_errors[0]
    assert np.isfinite(found.standard_errors[0])


# --- refusals and texts


def test_refusals():
    loop = levitation()
    record = experiment(loop, 1e-4, 15, n=300, sensor_noise=2e-6)
    for bad in (None, 3, [], [record, 3], "record", loop):
        with pytest.raises(CtrlidError, match="a Record or a list of Records is needed"):
            cid.fit_loop(loop, bad)
    with pytest.raises(CtrlidError, match=r"is needed; the list given is empty"):
        cid.fit_loop(loop, [])
    with pytest.raises(CtrlidError, match=r"fit_loop needs a Loop\(plant, .* given Transfer"):
        cid.fit_loop(ct.tf([1.0], [1.0, 1.0]), record)
    with pytest.raises(
        CtrlidError, match=r"none was given\. Name them in free= .* the loop has m, K, g"
    ):
        cid.fit_loop(levitation(free=()), record)
    with pytest.raises(CtrlidError, match=r"names of the parameters to fit, given \['Km'\]"):
        cid.fit_loop(loop, record, free=("K", "Km"))
    with pytest.raises(CtrlidError, match=r"sampled at 0\.002 s, the record at 0\.004 s"):
        cid.fit_loop(loop, record.decimate(2, antialias=False))
    still = replace(record, y=np.full(len(record), 0.012))
    with pytest.raises(CtrlidError, match=r"x stays at one value in all valid samples.*stuck"):
        cid.fit_loop(loop, still)
    cid.fit_loop(loop, [still, record])
    other = replace(record, hold="foh")
    with pytest.raises(
        CtrlidError, match=r"the same hold; given 0\.002 s, 'zoh' and 0\.002 s, 'foh'"
    ):
        cid.fit_loop(loop, [record, other])
    blind = cid.Record(u=record.u, y=record.y, dt=record.dt, valid=np.arange(300) < 9)
    with pytest.raises(CtrlidError, match="at least 10 valid samples; the record has 9 of 300"):
        cid.fit_loop(loop, blind)


def test_texts():
    loop = levitation()
    record = experiment(loop, 1e-4, 15, n=1500, sensor_noise=5e-6)
    fitted = cid.fit_loop(loop, record)
    text = str(fitted)
    assert text.startswith("Loop(maglev, digital controller, dt=0.002 s")
    assert f"maximum likelihood, {fitted.estimate.n_samples} samples used, log-likelihood" in text
    error = float(fitted.estimate.standard_errors[0])
    assert f"  K = {with_error(fitted.estimate['K'], error)}\n" in text
    noise = r"standard deviation of the sensor noise: \S+ m; of the white force: \S+ m/s\^2"
    assert re.search(noise, text)
    bare = replace(loop, plant=cid.linearize(loop.plant, loop.at), free=())
    assert cid.predict(bare, replace(record, units={})).units == ("", "")
    assert "note:" not in text
    with pytest.raises(CtrlidError, match="'m' was not fitted; fitted were K"):
        fitted.estimate["m"]
    with pytest.raises(CtrlidError, match="'g' was not fitted"):
        fitted.estimate.confidence_interval("g")
    assert fitted.loop.free == ("K",)
    assert loop.parameters["K"] == 3.34e-6


@pytest.mark.parametrize(("lag", "said"), [(0.0, False), (0.03, True)])
def test_a_value_far_beyond_its_stated_uncertainty_is_said_in_capitals(lag, said):
    """A lag that the model lacks takes the gain from 3 +- 1 % to 2.6, with a small error."""
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    pid = cid.PID(kp=20.0, kd=1.0)
    loop = cid.Loop(plant, pid, dt=0.01, free={"k": 0.01, "c": 0.5})
    real = loop.with_effect(E.ActuatorLag(tau=lag)) if lag else loop
    r = cid.random_binary(3000, amplitude=0.1, hold=50, seed=1)
    record = cid.simulate(real, r, sensor_noise=1e-4, seed=3)
    notes = " ".join(cid.fit_loop(loop, record).estimate.notes)
    assert ("k IS FAR FROM ITS GIVEN VALUE" in notes) == said
    assert ("the uncertainty that free= states" in notes) == said


# -- poles ---------------------------------------------------------------------------------------


def test_poles_are_those_of_the_fitted_plant_at_rest():
    """The poles of a drive are known by c and m alone, those of a levitation by g and the gap."""
    loop = drive(("c", "k"))
    fitted = cid.fit_loop(loop, experiment(loop, 0.05, 40, sensor_noise=2e-3))
    c, error = fitted.estimate["c"], fitted.estimate.standard_errors[0]
    order = np.argsort(fitted.poles.real)
    assert fitted.poles[order].real == pytest.approx([-c / 2.0, 0.0], abs=1e-9)
    assert fitted.poles_standard_errors[order] == pytest.approx([error / 2.0, 0.0], rel=1e-5)
    loop = levitation(free=("K", "g"))
    fitted = cid.fit_loop(loop, experiment(loop, 1e-4, 15, sensor_noise=5e-6))
    g, error = fitted.estimate["g"], fitted.estimate.standard_errors[1]
    pole = np.sqrt(2 * g / 0.012)
    assert np.sort(fitted.poles.real) == pytest.approx([-pole, pole], rel=1e-6)
    assert fitted.poles_standard_errors == pytest.approx(0.5 * pole * error / g, rel=1e-3)


def test_poles_include_effects_and_say_what_is_not_in_the_data():
    loop = levitation().with_effect(E.ActuatorLag(tau=2e-3))
    fitted = cid.fit_loop(loop, experiment(loop, 1e-4, 15, sensor_noise=5e-6))
    lag = int(np.argmin(fitted.poles.real))
    tau = fitted.estimate["ActuatorLag.tau"]
    error = fitted.estimate.standard_errors[fitted.estimate.names.index("ActuatorLag.tau")]
    assert fitted.poles[lag].real == pytest.approx(-1 / tau, rel=1e-6)
    assert fitted.poles_standard_errors[lag] == pytest.approx(error / tau**2, rel=1e-3)
    lost = replace(fitted, estimate=replace(fitted.estimate, covariance=np.diag([np.inf, np.inf])))
    assert np.isinf(lost.poles_standard_errors).all()


def test_a_wrong_gain_at_the_start_does_not_take_the_noise_from_the_sensor():
    """Two tanks, the lower level measured: at first a random force explains what the gain does."""
    real = tanks(level=4.37, dt=8.0, free=("k4",), k1=0.0708, k3=0.068, k4=0.0463)
    believed = real.with_parameters({"k4": 0.0495})
    d = cid.random_binary(3000, amplitude=0.6, hold=60, around=0.0, seed=1)
    record = cid.simulate(real, d=d, sensor_noise=0.011, seed=2)
    estimate = cid.fit_loop(believed, record).estimate
    assert estimate.sensor_noise[0] == pytest.approx(0.011, rel=0.05)
    assert abs(estimate.values[0] - 0.0463) < 4 * estimate.standard_errors[0]


@pytest.mark.parametrize(
    ("ratio", "seed"), [(0.0125, 4), pytest.param(0.2, 1, marks=pytest.mark.slow)]
)
def test_a_lag_beside_dry_friction_is_within_its_errors(ratio, seed):
    """One step of any order takes the kink, which is crossed within a period, for a curve."""
    dt = 0.01
    true = {"c": 10.0, "k": 11.0, "CoulombFriction.fc": 0.3, "ActuatorLag.tau": ratio * dt}
    plant = cid.plants.servo(m=2.7, c=true["c"], k=true["k"])
    hidden = (cid.effects.CoulombFriction(fc=0.3), cid.effects.ActuatorLag(tau=ratio * dt))
    pid = cid.PID(kp=15.0, kd=1.5, filter_time=0.05)
    loop = cid.Loop(plant, pid, dt=dt, effects=hidden, free=tuple(true))
    r = cid.random_binary(2000, amplitude=0.02, hold=60, seed=seed)
    record = cid.simulate(loop, r, sensor_noise=4e-6, force_noise=0.02, seed=seed + 50)
    e = cid.fit_loop(loop, record).estimate
    off = [(e[n] - true[n]) / s for n, s in zip(e.names, e.standard_errors, strict=True)]
    assert np.abs(off).max() < 2.9


@pytest.mark.parametrize("tau", [2e-3, 1e-5])
def test_a_lag_that_is_not_there_ends_at_nothing(tau):
    """A lag of nothing is no state any more, and nothing else of the fit may ask for it."""
    plant, pid = cid.plants.servo(m=2.7, c=10.0, k=11.0), cid.PID(kp=15.0, kd=1.5, filter_time=0.05)
    r = cid.random_binary(2000, amplitude=0.02, hold=60, seed=1)
    record = cid.simulate(cid.Loop(plant, pid, dt=0.01), r, sensor_noise=4e-6, seed=2)
    record = replace(record, y=np.append(record.y[1:], record.y[-1]))  # early, not late
    lag = cid.effects.ActuatorLag(tau=tau)
    loop = cid.Loop(plant, pid, dt=0.01, effects=(lag,), free=("k", "ActuatorLag.tau"))
    estimate = cid.fit_loop(loop, record).estimate
    assert estimate["ActuatorLag.tau"] == 0.0
    assert "ActuatorLag.tau" in estimate.active
    assert not any("HARDLY COUNTS" in note for note in estimate.notes)


# --- a wrong sign or unit of u


@pytest.mark.parametrize(("factor", "on_bound"), [(-1.0, True), (2e3, True), (1.0, False)])
def test_a_parameter_on_its_bound_by_a_wrong_input_is_said(factor, on_bound):
    def move(t, x, u, p):
        return np.array([x[1], p["a"] * np.sin(x[0]) - p["c"] * x[1] + p["b"] * u[0]])

    plant = ct.nlsys(move, lambda t, x, u, p: x[0], name="pend", inputs=["V"], outputs=["theta"],
                     states=["theta", "omega"], params={"a": 60.0, "b": 20.0, "c": 1.0}
                     )  # fmt: skip
    C = ct.sample_system(ct.tf([0.8, 12.0], [0.01, 1.0]), 0.01, "tustin")
    at = cid.operating_point(plant, output=0.0)
    loop = cid.Loop(plant, C, dt=0.01, at=at, free=("b",))
    r = cid.random_binary(800, amplitude=0.05, hold=25, seed=1)
    record = cid.simulate(loop, r, sensor_noise=2e-4, seed=1)
    found = cid.fit_loop(loop, replace(record, u=factor * np.asarray(record.u))).estimate
    assert (found.active == ("b",)) is on_bound
    said = [note for note in found.notes if note.startswith("THE INPUT HARDLY COUNTS")]
    assert len(said) == on_bound
    assert not said or "b IS ON A BOUND. CHECK THE SIGN AND THE UNIT of u" in said[0]


def test_a_mass_beyond_all_bounds_is_a_wrong_input_as_well():
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), cid.PID(kp=20.0, kd=1.0), dt=0.01)
    r = cid.random_binary(800, amplitude=0.1, hold=25, seed=1)
    record = cid.simulate(loop, r, sensor_noise=1e-4, seed=1)
    found = cid.fit_loop(loop, replace(record, u=-np.asarray(record.u)), free=("m",)).estimate
    assert [note for note in found.notes if note.startswith("THE INPUT HARDLY COUNTS")]


def test_friction_that_is_not_there_is_no_reason_to_doubt_the_input():
    plant = cid.plants.servo(m=1.0, c=1e-9, k=3.0)
    loop = cid.Loop(plant, cid.PID(kp=20.0, kd=1.0), dt=0.01, free=("c",))
    record = cid.simulate(loop, cid.random_binary(800, amplitude=0.1, hold=25, seed=1))
    start = loop.with_parameters({"c": 2.0})
    found = cid.fit_loop(start, record).estimate
    assert found.active == ("c",)
    assert not [note for note in found.notes if "CHECK THE SIGN" in note]
