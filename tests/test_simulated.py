"""Fits and searches by the error of an open-loop simulation."""

from types import SimpleNamespace

import numpy as np
import pytest

import ctrlid as cid
from ctrlid import effects as E
from ctrlid.diagnosis.fresh_data import choose_fresh_data
from ctrlid.diagnosis.growth import Search
from ctrlid.diagnosis.noise_tests import run_noise_tests
from ctrlid.diagnosis.open_loop_fit import Simulation
from ctrlid.diagnosis.open_loop_search import search_by_simulation
from ctrlid.diagnosis.procedure import _is_worth_simulating
from ctrlid.diagnosis.recalibration import fit_base_model
from problems import TANKS, tanks


def record_of(loop, n=600, noise=1e-3, seed=1):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(1.5, 4.0, -(-n // 30)), 30)[:n]
    return cid.simulate(loop, d=u - loop.point.input, sensor_noise=noise, seed=seed)


def simulation_of(loop, record, names=None):
    task = Simulation(loop, names or loop.free, [record], [0.0])
    return task, task.make_initial_states([{}])


def test_sensitivities_are_the_derivatives():
    loop = tanks().with_effect(E.StateLimit(name="h1", upper=9.0, spill_to="h2", share=0.5))
    record = record_of(loop)
    names = (*loop.free, "StateLimit.upper", "StateLimit.share")
    task, x0 = simulation_of(tanks(k1=0.052).with_effect(loop.effects[0]), record, names)
    theta = np.array([0.052, 0.06, 0.05, 9.0, 0.5])
    _, slopes, states = task.run(theta, x0)
    v = np.concatenate([theta, x0.ravel()])
    for k in range(len(v)):
        h = 1e-6 * max(abs(v[k]), 1e-3)
        moved = []
        for sign in (1, -1):
            w = v.copy()
            w[k] += sign * h
            moved.append(task.run(w[:5], w[5:].reshape(1, -1))[0])
        np.testing.assert_allclose((moved[0] - moved[1]) / (2 * h), slopes[:, k],
                                   rtol=2e-3, atol=2e-3 * np.abs(slopes[:, k]).max())  # fmt: skip
    assert states[0].shape == (len(record), 2)


def test_a_record_without_noise_gives_the_parameters_back():
    record = record_of(tanks(), noise=0.0)
    task, x0 = simulation_of(tanks(k1=0.06, k3=0.05, k4=0.06), record)
    found = task.fit(np.array([0.06, 0.05, 0.06]), x0 + 0.5)
    np.testing.assert_allclose(found.theta, list(TANKS.values()), rtol=1e-5)
    assert found.square < 1e-10
    starts = [found.starts[0][k] for k in ("h1", "h2")]
    np.testing.assert_allclose(starts, tanks().point.states, rtol=1e-4)


def test_standard_errors_are_those_of_white_noise():
    task, x0 = simulation_of(tanks(), record_of(tanks(), noise=0.05))
    found = task.fit(np.array(list(TANKS.values())), x0)
    assert found.correlated == pytest.approx(1.0, abs=0.5)
    for name, value in zip(found.names, found.theta, strict=True):
        error = found.standard_errors[name]
        assert abs(value - TANKS[name]) < 4.5 * error < 0.2 * TANKS[name]


@pytest.mark.slow
def test_the_search_names_an_overflow_and_a_wrong_zero():
    real = tanks().with_effect(E.StateLimit(name="h1", upper=8.0, spill_to="h2", share=1.0))
    real = real.with_effect(E.SensorOffset(0.6))
    record = record_of(real, n=900, noise=0.02, seed=5)
    loop = tanks(k1=0.055, k3=0.055, k4=0.052)
    base = fit_base_model(loop, [record], loop.free)
    tests = run_noise_tests(base.fit)
    fresh = choose_fresh_data(loop, [record], None)
    catalogue = (E.StateLimit, E.SensorOffset, E.InputNonlinearity, E.InputBacklash)
    found = search_by_simulation(Search(base, (), base, (), tests, tests), fresh, catalogue,
                                 lambda text: None, np.inf)  # fmt: skip
    effects = {type(e).__name__: e for e in found.final.fitted.effects}
    assert set(effects) == {"StateLimit", "SensorOffset"}
    assert effects["StateLimit"].name == "h1"
    for name, size in (("StateLimit.upper", 8.0), ("SensorOffset.offset", 0.6)):
        fitted = found.final.fitted.parameters[name]
        assert abs(fitted - size) < 4.5 * found.final.errors[name]
    assert fresh.measure_gap(fresh.prepare_loops(found.final)) < 0.025
    assert found.after.passed


def test_nothing_is_found_where_nothing_is_missing():
    record = record_of(tanks(), noise=0.02)
    loop = tanks(k1=0.055)
    base = fit_base_model(loop, [record], loop.free)
    tests = run_noise_tests(base.fit)
    search = Search(base, (), base, (), tests, tests)
    fresh = choose_fresh_data(loop, [record], None)
    catalogue = (E.StateLimit, E.SensorOffset, E.InputNonlinearity)
    assert search_by_simulation(search, fresh, catalogue, lambda t: None, np.inf) is None


@pytest.mark.parametrize(("verdict", "after", "asks"), [
    ("unknown", 1.0, True), ("partly explained", 0.5, True), ("explained", 0.5, False),
    ("explained", 1.1, True),  # what is named leaves the gap to a random force
    ("nothing missing", 1.1, False),
])  # fmt: skip
def test_which_answers_are_followed_by_a_search_by_simulation(verdict, after, asks):
    loop, findings = tanks(), () if verdict in ("unknown", "nothing missing") else ("one",)
    question = SimpleNamespace(loop=loop, fresh=choose_fresh_data(loop, [record_of(loop)], None))
    result, gap = SimpleNamespace(verdict=verdict, findings=findings), SimpleNamespace(before=1.0)
    gap.after = after
    assert _is_worth_simulating(question, result, gap, [range(1000)]) is asks
    assert not _is_worth_simulating(question, result, gap, [range(10**6)])
