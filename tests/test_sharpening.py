"""Dry friction as abrupt as the record has it, on records of a simulator that is not ctrlid's."""

import math
from dataclasses import replace

import control as ct
import numpy as np
import pytest
from scipy.signal import lfilter

import ctrlid as cid
from ctrlid import effects as E
from ctrlid._base.errors import CtrlidError
from ctrlid.diagnosis.fitted_model import compute_criterion
from ctrlid.diagnosis.fresh_data import choose_fresh_data
from ctrlid.diagnosis.noise_tests import run_noise_tests
from ctrlid.diagnosis.recalibration import fit_base_model
from ctrlid.diagnosis.refitting import refit_candidate
from ctrlid.diagnosis.screening import screen_at
from ctrlid.diagnosis.sharpening import sharpen_model
from ctrlid.diagnosis.thresholds import THRESHOLD
from ctrlid.estimation.likelihood.abrupt_friction import SHARPEST
from ctrlid.estimation.likelihood.likelihood import make_problem
from ctrlid.estimation.likelihood.maximization import begin_fit
from ctrlid.loop.loop import sharpen_effects

DT, PARTS = 0.02, 200
# A carriage of 1 kg on a spring: stiffness [N/m], damping [N s/m] and dry friction [N].
STIFFNESS, DAMPING, FRICTION = 60.0, 2.0, 1.0


def model_of(*effects, free=("s", "c"), **options):
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], u[0] - p["s"] * x[0] - p["c"] * x[1]]),
        lambda t, x, u, p: x[0], inputs=["F"], outputs=["x"], states=["x", "v"],
        params={"s": STIFFNESS, "c": DAMPING}, name="carriage",
    )  # fmt: skip
    return cid.Loop(plant, dt=DT, free=free, effects=effects, **options)


def log_carriage(seed, n=700, noise=2e-5, sticks=True, memory=0.0):
    """What is logged of the carriage: a period in many parts, and friction as an impulse in each.

    It takes up to so much of the velocity, never more than there is. Without sticking it is the
    friction that ctrlid begins with, over a quarter of a period. The noise may have a memory.
    """
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(0.0, 2.0, n // 12 + 1), 12)[:n]
    if not sticks:
        blunt = model_of(E.CoulombFriction(fc=FRICTION))
        return cid.simulate(blunt, d=u, sensor_noise=noise, seed=seed)
    x = v = 0.0
    y, h = np.empty(n), DT / PARTS
    for k in range(n):
        y[k] = x
        for _ in range(PARTS):
            v += h * (u[k] - STIFFNESS * x - DAMPING * v)
            v = math.copysign(max(abs(v) - h * FRICTION, 0.0), v)
            x += h * v
    white = noise * rng.normal(size=n)
    coloured = lfilter([math.sqrt(1 - memory**2)], [1.0, -memory], white)
    return cid.Record(u=u, y=y + coloured, dt=DT)


def fit_with_friction(record):
    """The carriage with its friction in the model, a tenth off."""
    loop = model_of(E.CoulombFriction(fc=0.9 * FRICTION))
    return fit_base_model(loop, [record], ("s", "c", "CoulombFriction.fc"))


def gain_of_second_friction(model):
    second = refit_candidate(model, screen_at(model, E.StribeckFriction(fs=0.1, vs=0.01)))
    return second.net_gain


@pytest.fixture(scope="module")
def sharpened():
    record = log_carriage(1)
    blunt = fit_with_friction(record)
    return record, blunt, sharpen_model(blunt)


def test_friction_becomes_as_abrupt_as_a_record_has_it(sharpened):
    """A filter's blunt friction lost 300 units, and a Stribeck curve that mends it gained 150."""
    _, blunt, sharp = sharpened
    assert sharp.loop.sharpness == SHARPEST
    assert compute_criterion(sharp) > compute_criterion(blunt) + 100
    assert gain_of_second_friction(blunt) > 50
    assert not gain_of_second_friction(sharp) > THRESHOLD.gate
    # The steps of the simulator alone leave some ten-thousandths.
    np.testing.assert_allclose(sharp.fit.theta, [STIFFNESS, DAMPING, FRICTION], rtol=1e-3)
    assert abs(sharp.fit.theta[2] - FRICTION) < 0.2 * abs(blunt.fit.theta[2] - FRICTION)


def test_friction_that_is_blunt_stays_so():
    blunt = fit_with_friction(log_carriage(2, sticks=False))
    assert sharpen_model(blunt) is blunt
    bare = fit_base_model(model_of(), [log_carriage(2, n=300)], ("s", "c"))
    assert sharpen_model(bare) is bare


def test_noise_that_hides_how_a_mass_sticks_asks_for_less(sharpened):
    noisy = sharpen_model(fit_with_friction(log_carriage(1, noise=5e-4)))
    assert 1 < noisy.loop.sharpness < sharpened[2].loop.sharpness


@pytest.mark.parametrize("seed", [2, 3])
def test_friction_is_found_beside_a_sensor_that_errs_alike_in_successive_readings(seed):
    """Beside white noise a force of 2 N took the sensor's colour; no climb led from it to none."""
    blunt = fit_with_friction(log_carriage(seed, noise=3e-3, memory=0.9))
    quiet = sharpen_model(blunt)
    assert compute_criterion(quiet) > compute_criterion(blunt) + 50
    assert run_noise_tests(quiet.fit).passed
    assert quiet.fit.noise.ar == pytest.approx((0.9,), abs=0.05)
    np.testing.assert_allclose(quiet.fit.theta[1:], [DAMPING, FRICTION], rtol=0.03)


def test_a_filter_finds_its_way_where_friction_is_abrupt(sharpened):
    """From a guess the trajectory did not settle: fitted to a part of it, friction was zero."""
    record, _, sharp = sharpened
    part = record[:500]
    begun = begin_fit(
        make_problem(sharp.loop, sharp.names, [part]), sharp.fit.theta, sharp.fit.noise
    )
    shown = np.isfinite(begun.standardized[0])
    assert np.sqrt(np.mean(begun.standardized[0][shown] ** 2)) < 1.3
    fresh = choose_fresh_data(sharp.loop, (record,), None)
    loop = fresh.prepare_loops(sharp)[0]
    assert loop.sharpness == sharp.loop.sharpness
    assert loop.parameters["CoulombFriction.fc"] == pytest.approx(FRICTION, rel=0.01)


@pytest.mark.slow
def test_dry_friction_alone_is_named_alone():
    record = log_carriage(3, n=500, noise=1e-4)
    few = [E.CoulombFriction, E.AsymmetricCoulombFriction, E.StribeckFriction, E.ViscousFriction]
    found = cid.diagnose(model_of(), record, catalogue=few, progress=False)
    assert [f.names[0] for f in found.findings] == ["CoulombFriction"]
    assert found.verdict == "explained"
    known = model_of(E.CoulombFriction(fc=0.9), free=("s", "c", "CoulombFriction.fc"))
    found = cid.diagnose(known, record, catalogue=few, progress=False)
    assert (found.verdict, found.findings) == ("nothing missing", ())


def test_sharpness_belongs_to_the_loop():
    loop = model_of(E.CoulombFriction(fc=1.0), sharpness=4.0)
    assert "sharpness 4" in repr(loop)
    assert sharpen_effects(loop, 4.0) is loop
    for other in (loop.with_parameters(s=50.0), replace(loop, free=("s",)),
                  loop.with_effect(E.ViscousFriction(c=0.1))):  # fmt: skip
        assert other.sharpness == 4.0
    assert "sharpness" not in repr(model_of(sharpness=4.0))
    u = np.repeat([3.0, -3.0, 0.5], 40)
    sharp, blunt = (cid.simulate(x, d=u).y for x in (loop, replace(loop, sharpness=1.0)))
    assert 0 < np.abs(sharp - blunt).max() < 0.1 * np.ptp(sharp)
    for wrong in (0.5, math.nan, math.inf, "2", True):
        with pytest.raises(CtrlidError, match="sharpness= says how many times faster"):
            model_of(sharpness=wrong)


def test_fit_loop_knows_friction_as_well_as_the_record_does(sharpened):
    """With blunt friction the errors were ten times as large, and a random force took the rest."""
    record, blunt, _ = sharpened
    names = ("s", "c", "CoulombFriction.fc")
    fitted = cid.fit_loop(model_of(E.CoulombFriction(fc=0.9 * FRICTION), free=names), record)
    assert fitted.loop.sharpness == SHARPEST
    np.testing.assert_allclose(fitted.estimate.values, [STIFFNESS, DAMPING, FRICTION], rtol=1e-3)
    assert fitted.estimate.standard_errors[2] < 0.2 * blunt.fit.standard_errors[2]
