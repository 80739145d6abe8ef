"""Replicas of records whose controller nobody knows."""

from dataclasses import replace
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest
from scipy import linalg

import ctrlid as cid
import problems
from ctrlid import effects as E
from ctrlid.diagnosis import replicas
from ctrlid.diagnosis.noise_tests import NoiseTests, run_noise_tests
from ctrlid.diagnosis.recalibration import fit_base_model
from ctrlid.diagnosis.replicas import (
    _design_normalized_controller,
    _regress_controller,
    follow_record,
    forgive_filter,
    make_replica,
    measure_gain_on_replicas,
)
from ctrlid.diagnosis.selection import run_round
from ctrlid.diagnosis.wording import find_told_rms
from ctrlid.loop.period_map import comes_to_rest
from problems import levitation


def rubbing(fc):
    """A levitated ball with dry friction [m/s^2], or with none at all."""
    return levitation(*([E.CoulombFriction(fc=fc)] if fc else []), dt=0.001)


def record_of(loop, seed, n=1500):
    return problems.record_of(loop, swing=3e-4, hold=30, n=n, seed=seed, sensor_noise=4e-6,
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


@pytest.mark.parametrize("fc", [0.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_a_replica_without_a_controller_is_like_the_record(fc, monkeypatch):
    loop = rubbing(fc)
    record = record_of(loop, 3)
    model = fit_base_model(replace(loop, controller=None), [record], ("K",))
    copy = make_replica(model)
    made = copy.fit.problem.data[0].record
    assert not np.array_equal(made.y, record.y)
    assert np.std(made.y - record.y) < 0.3 * np.std(record.y)
    assert copy.fit.theta[0] == pytest.approx(model.fit.theta[0], rel=0.01)
    assert copy.fit.value == pytest.approx(model.fit.value, abs=300)
    # What the filter smooths of friction that is as abrupt as nature's may fail a test of one
    # replica, and is forgiven by another one.
    assert forgive_filter(run_noise_tests(copy.fit), [make_replica(model, seed=1)]).passed
    monkeypatch.setattr(replicas, "sharpen_effects", lambda loop, times: loop)
    assert run_noise_tests(make_replica(model).fit).passed


@pytest.mark.slow
def test_friction_in_the_model_is_given_no_companion():
    """What the filter does wrong with sharp friction had been an actuator's lag."""
    loop = rubbing(1.0)
    model = replace(loop, controller=None).with_parameters({"K": 3.4e-6})
    found = cid.diagnose(model, record_of(loop, 3), progress=False)
    assert (found.verdict, found.findings) == ("nothing missing", ())


@pytest.mark.slow
def test_what_is_missing_is_found_beside_friction_all_the_same():
    loop = rubbing(1.0)
    record = record_of(loop.with_effect(E.ActuatorLag(tau=0.002)), 3)
    base = fit_base_model(replace(loop, controller=None), [record], ("K",))
    lag = E.ActuatorLag(tau=0.001)
    best = run_round(base, [lag], lambda f, items: list(map(f, items))).best
    assert best is not None
    assert measure_gain_on_replicas([make_replica(base)], best) < 0.1 * best.gain


def log_arm(n=4000, seed=3, step=360 / 4096, zone=0.0):
    """Return r, u and y of an arm held upright by a PID that reads an encoder [deg].

    ``y" = 30 y - 4 y' + 60 u + w``, by scipy. In a dead zone w alone acts.
    """
    dt = 0.01
    rng = np.random.default_rng(seed)
    r = 2 + np.repeat(rng.choice([-4.0, 4.0], n // 45 + 1), 45)[:n]
    A = np.array([[0.0, 1.0, 0.0], [30.0, -4.0, 60.0], [0.0, 0.0, 0.0]])
    F = linalg.expm(A * dt)
    x, kept, slope, us, ys = np.array([2.0, 0.0]), 0.0, 0.0, [], []
    last = step * np.round(x[0] / step)
    for k in range(n):
        y = step * np.round(x[0] / step)
        slope = (0.01 * slope - 0.35 * (y - last)) / (0.01 + dt)
        last = y
        kept += 6.0 * dt * (r[k] - y)
        u = 4.0 * (r[k] - y) + kept + slope
        us.append(u)
        ys.append(y)
        acting = u - np.clip(u, -zone / 2, zone / 2)
        x = F[:2, :2] @ x + F[:2, 2] * (acting + 25.0 * rng.standard_normal() / 60)
    return r, np.array(us), np.array(ys)


ARM = ct.nlsys(
    lambda t, x, u, p: np.array([x[1], p["a"] * x[0] - p["c"] * x[1] + p["K"] * u[0]]),
    lambda t, x, u, p: x[0], inputs=["duty"], outputs=["angle"], states=["angle", "rate"],
    params={"a": 30.0, "c": 5.0, "K": 50.0}, name="arm",
)  # fmt: skip


@pytest.mark.parametrize("filter_time", [0.01, 0.02, None])
def test_answer_about_a_coarse_encoder_needs_no_controller(filter_time):
    """The steps reach u through the law, whether it is stated rightly, wrongly or not at all."""
    r, u, y = log_arm(2000)
    law = None
    if filter_time:
        law = cid.PID(kp=4, ki=6, kd=0.35, filter_time=filter_time, derivative="measurement")
    record = cid.Record(r=r, u=u, y=y, dt=0.01)
    at = cid.operating_point(ARM, output=2.0)
    loop = cid.Loop(ARM, law, dt=0.01, at=at, free=("c", "K"))
    few = [E.CoulombFriction, E.InputDelay]
    found = cid.diagnose(loop, record, catalogue=few, progress=False)
    assert found.verdict == "nothing missing"


def test_law_is_found_in_the_recorded_input():
    r, u, y = log_arm(2000)
    record = cid.Record(r=r, u=u, y=y, dt=0.01)
    C = _regress_controller(record, 0.01)
    # Of a PID with a filtered derivative: u reacts to y as -(4 + 6 T / (1 - 1/z) + 0.35 s / ...).
    z = np.exp(1j * np.array([0.1, 0.5, 2.0]))
    wanted = 4 + 0.06 / (1 - 1 / z) + 0.35 * (1 - 1 / z) / (0.02 - 0.01 / z)
    assert C(z) == pytest.approx(wanted, rel=1e-6)
    noisy = replace(record, u=u + np.random.default_rng(1).standard_normal(len(u)))
    assert _regress_controller(noisy, 0.01) is None


def test_dead_zone_is_about_zero_where_a_weight_is_held():
    """It was found about the operating point's input, with the rest of the error unexplained."""
    r, u, y = log_arm(1500, step=0.01, zone=3.0)
    record = cid.Record(r=r, u=u, y=y, dt=0.01)
    law = cid.PID(kp=4, ki=6, kd=0.35, filter_time=0.01, derivative="measurement")
    at = cid.operating_point(ARM, output=2.0)
    assert at.input == pytest.approx(-1.2)
    loop = cid.Loop(ARM, law, dt=0.01, at=at, free=("c", "K"))
    found = cid.diagnose(loop, record, catalogue=[E.InputDeadZone, E.CoulombFriction],
                         progress=False)  # fmt: skip
    assert found.verdict == "explained"
    # The number of a place is that of the bin which its words speak of.
    told = [p for p in found.where if p.words.endswith("than noise")]
    assert told
    for place in told:
        assert ("smaller" in place.words) == (find_told_rms(place, place.before) < 1)
    (finding,) = found.findings
    assert finding.effect.centre == 0.0
    assert finding.equivalents == ()
    assert abs(finding.effect.width - 3.0) < 4 * finding.standard_errors["width"]
    assert "centre = 0" in str(found)


def test_middle_of_a_dead_zone_is_a_number():
    assert str(E.InputDeadZone(2.0, centre=0.0)) == "InputDeadZone: width = 2 [u], centre = 0.0"
    assert "centre" not in str(E.InputDeadZone(2.0))
    for wrong in ("middle", np.nan, None):
        with pytest.raises(cid.CtrlidError, match="needs a finite number for centre"):
            E.InputDeadZone(2.0, centre=wrong)


@pytest.mark.parametrize("period", [0.05, 0.2, 0.5])
def test_the_designed_controller_holds_a_plant_that_is_sampled_slowly(period):
    """1/(s^2 - 25), whose pole times the period is up to 2.5."""
    plant = ct.ss([[0.0, 1.0], [25.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], 0)
    one = np.ones(1)
    law = _design_normalized_controller(plant, period, one, one)
    sampled = ct.sample_system(plant, period, "zoh")
    poles = ct.poles(ct.feedback(sampled, law))
    # A linear quadratic regulator of unit weights mirrors a fast unstable pole or does better.
    assert np.abs(poles).max() < np.exp(-0.9 * 5.0 * period) + 1e-9


def test_what_replicas_fail_as_well_is_forgiven_by_the_reference_of_several_outputs(monkeypatch):
    axes = ("time", "reference a", "a")

    def tests(p):
        return NoiseTests(
            {f"size by {x} of {name}": p.get((x, name), 1.0) for x in axes for name in "ab"},
            np.zeros(2), dict.fromkeys(axes, np.zeros(2)),
            outputs=dict.fromkeys("ab", NoiseTests({}, np.zeros(2), {})),
        )  # fmt: skip

    of_copy = tests({("a", "b"): 1e-9})
    monkeypatch.setattr(replicas, "run_noise_tests", lambda fit: of_copy)
    copy = SimpleNamespace(fit=None, loop=SimpleNamespace(effects=()))
    here = tests({("reference a", "b"): 1e-9, ("reference a", "a"): 1e-9})
    found = forgive_filter(here, [copy]).p_values
    assert found["size by reference a of b"] == 0.5
    assert found["size by reference a of a"] == 1e-9
