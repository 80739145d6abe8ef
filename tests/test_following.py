"""Replicas of records whose controller nobody knows."""

from dataclasses import replace

import control as ct
import numpy as np
import pytest

import ctrlid as cid
import problems
from ctrlid import effects as E
from ctrlid.diagnosis.noise_tests import run_noise_tests
from ctrlid.diagnosis.recalibration import fit_base_model
from ctrlid.diagnosis.replicas import follow_record, make_replica, measure_gain_on_replicas
from ctrlid.diagnosis.selection import run_round
from ctrlid.loop.period_map import comes_to_rest
from problems import levitation


def rubbing(fc):
    """A levitated ball with dry friction [m/s^2], or with none at all."""
    return levitation(*([E.CoulombFriction(fc=fc)] if fc else []), dt=0.001)


def record_of(loop, seed):
    return problems.record_of(loop, swing=3e-4, hold=30, n=3000, seed=seed, sensor_noise=4e-6,
                              force_noise=0.01)  # fmt: skip


def random_plant(rng):
    """An unstable plant of order two to four, with a time scale of its own."""
    scale = 10 ** rng.uniform(-1, 2)
    poles = scale * np.array([rng.uniform(0.3, 2), *-rng.uniform(0.2, 3, rng.integers(1, 4))])
    gain = 10 ** rng.uniform(-3, 3) * rng.choice([-1, 1]) * scale ** len(poles)
    return ct.tf([gain], np.poly(poles)), scale


@pytest.mark.parametrize("seed", range(12))
def test_unstable_plants_are_held_to_what_was_recorded(seed):
    """Whoever controlled it: here a state feedback that the diagnosis does not know."""
    rng = np.random.default_rng([71, seed])
    P, scale = random_plant(rng)
    dt = 0.05 / scale
    plant = ct.sample_system(ct.ss(P), dt, "zoh")
    feedback = ct.dlqr(plant.A, plant.B, np.eye(len(plant.A)), np.eye(1))[0]
    x, y, u = np.zeros(len(plant.A)), [], []
    for push in cid.random_binary(2000, amplitude=1.0, hold=40, seed=seed + 1):
        u.append(float(push - (feedback @ x)[0]))
        y.append(float((plant.C @ x)[0]))
        x = plant.A @ x + plant.B[:, 0] * u[-1]
    record = cid.Record(u=u, y=y, dt=dt)
    loop = follow_record(cid.Loop(P, None, dt=dt), record)
    assert comes_to_rest(loop)
    # As the plant itself, the loop that is driven by record and input gives the record again.
    again = cid.simulate(loop, record.y, d=record.u)
    np.testing.assert_allclose(again.y, record.y, atol=1e-6 * np.std(record.y))
    np.testing.assert_allclose(again.u, record.u, atol=1e-6 * np.std(record.u))
    # And it stays near when it is disturbed; open loop it would be gone after one time constant.
    noise = 0.01 * np.std(record.y)
    pushed = cid.simulate(loop, record.y, d=record.u, sensor_noise=noise, seed=seed)
    assert np.std(pushed.y - record.y) < 0.3 * np.std(record.y)


def test_what_cannot_be_held_is_left_alone():
    """An unstable mode that the input does not reach."""
    hidden = ct.ss([[1.0, 0.0], [0.0, -2.0]], [[0.0], [1.0]], [[1.0, 1.0]], 0)
    record = cid.Record(u=np.sin(np.arange(500)), y=np.cos(np.arange(500)), dt=0.01)
    assert follow_record(cid.Loop(hidden, None, dt=0.01), record) is None


@pytest.mark.parametrize("fc", [0.0, 1.0])
def test_a_replica_without_a_controller_is_like_the_record(fc):
    loop = rubbing(fc)
    record = record_of(loop, 3)
    model = fit_base_model(replace(loop, controller=None), [record], ("K",))
    copy = make_replica(model)
    made = copy.fit.problem.data[0].record
    assert not np.array_equal(made.y, record.y)
    assert np.std(made.y - record.y) < 0.3 * np.std(record.y)
    assert copy.fit.theta[0] == pytest.approx(model.fit.theta[0], rel=0.01)
    assert copy.fit.value == pytest.approx(model.fit.value, abs=300)
    assert run_noise_tests(copy.fit).passed


def test_friction_in_the_model_is_given_no_companion():
    """What the filter does wrong with sharp friction had been an actuator's lag."""
    loop = rubbing(1.0)
    model = replace(loop, controller=None).with_parameters({"K": 3.4e-6})
    found = cid.diagnose(model, record_of(loop, 3), progress=False)
    assert (found.verdict, found.findings) == ("nothing missing", ())


def test_what_is_missing_is_found_beside_friction_all_the_same():
    loop = rubbing(1.0)
    record = record_of(loop.with_effect(E.ActuatorLag(tau=0.002)), 3)
    base = fit_base_model(replace(loop, controller=None), [record], ("K",))
    lag = E.ActuatorLag(tau=0.001)
    best = run_round(base, [lag], lambda f, items: list(map(f, items))).best
    assert best is not None
    assert measure_gain_on_replicas([make_replica(base)], best) < 0.1 * best.gain
