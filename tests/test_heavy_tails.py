"""Heavy-tailed sensor noise, against its laws and records of a simulator that is not ctrlid's."""

import dataclasses
import math

import numpy as np
import pytest
from scipy import integrate, stats

import ctrlid as cid
from ctrlid.diagnosis.noise_choice import _errs_less_than_rounding
from ctrlid.estimation.likelihood import tails
from ctrlid.estimation.likelihood.kalman_filter import Noise, run_filter
from ctrlid.estimation.likelihood.likelihood import make_problem
from ctrlid.estimation.likelihood.maximization import begin_fit, choose_tails, maximize
from ctrlid.estimation.likelihood.tails import (
    MOST_SHARE,
    Tails,
    compute_information_shares,
    fit_tails,
)
from test_sensor_noise import simulate_servo

# Effects that wild readings could be blamed on: forces, the input, the sensor.
SOME = (
    cid.effects.CoulombFriction, cid.effects.QuadraticDrag, cid.effects.PeriodicForce,
    cid.effects.InputDeadZone, cid.effects.InputDelay, cid.effects.SensorNonlinearity,
)  # fmt: skip
LAWS = [Tails(freedom=3.0), Tails(share=0.02, ratio=10.0)]
SIZE = 1e-4


def make_loop_and_record(kind, seed, n=2000, dead_zone=0.0):
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    at = cid.OperatingPoint(states=(0.0, 0.0), input=0.0, output=0.0)
    law = cid.PID(kp=20.0, kd=1.0, filter_time=0.02)
    loop = cid.Loop(plant, law, dt=0.01, at=at, free=("k", "c"))
    rng = np.random.default_rng(seed)
    r = np.repeat(rng.choice([-0.1, 0.1], n // 50), 50)
    noise = rng.standard_normal(n)
    if kind == "student":
        noise = rng.standard_t(3, n) / math.sqrt(3)
    if kind == "wild":
        noise *= np.where(rng.random(n) < 0.01, 10.0, 1.0)
    y, u = simulate_servo(r, SIZE * noise, dead_zone=dead_zone)
    return loop, cid.Record(r=r, u=u, y=y, dt=0.01)


@pytest.mark.parametrize("law", LAWS)
def test_the_law_is_a_law(law):
    def density(z):
        return math.exp(float(law.compute_log_density(np.array([z]))[0]))

    assert 2 * integrate.quad(density, 0, 400, limit=500)[0] == pytest.approx(1, abs=1e-5)
    z = np.linspace(-8, 8, 41)
    h = 1e-5
    slope = (law.compute_log_density(z + h) - law.compute_log_density(z - h)) / (2 * h)
    np.testing.assert_allclose(law.compute_weight(z) * z, -slope, atol=1e-6)
    drawn = law.draw(np.random.default_rng(0).standard_normal(20_000), seed=1)
    assert stats.kstest(law.normalize(drawn), "norm").pvalue > 1e-3
    assert law.find_scale(4 * drawn**2, 1.0) == pytest.approx(4, rel=0.05)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("start", [1e-6, 1.0, 1e4])
def test_the_scale_solves_its_equation_from_any_start_in_few_steps(law, start, monkeypatch):
    squares = (3 * law.draw(np.random.default_rng(1).standard_normal(800), seed=2)) ** 2
    monkeypatch.setattr(tails, "STEPS", 25)
    found = law.find_scale(squares, start)
    made = np.mean(law.compute_weight(np.sqrt(squares / found)) * squares)
    assert made == pytest.approx(found, rel=1e-6)


def test_information_is_that_of_students_law():
    mean, _ = compute_information_shares(Tails(freedom=3.0))
    assert mean == pytest.approx(4 / 6, rel=1e-3)
    assert compute_information_shares(Tails(freedom=100.0)) == pytest.approx((1, 1), rel=0.06)
    assert compute_information_shares(None) == (1, 1)


def test_the_law_is_found_from_errors():
    rng = np.random.default_rng(3)
    student, _ = fit_tails(Tails(freedom=6.0), 4 * rng.standard_t(3, 20_000) ** 2, 0.0)
    assert student.freedom == pytest.approx(3, rel=0.1)
    assert student.scale == pytest.approx(4, rel=0.1)
    wild = np.where(rng.random(20_000) < 0.01, 8.0, 1.0) * rng.standard_normal(20_000)
    mixture, _ = fit_tails(Tails(share=0.1, ratio=3.0), wild**2, 0.0)
    assert mixture.share == pytest.approx(0.01, rel=0.3)
    assert mixture.ratio == pytest.approx(8, rel=0.2)


@pytest.mark.parametrize("law", LAWS)
def test_a_wild_reading_moves_the_estimate_as_little_as_its_weight_says(law):
    loop, record = make_loop_and_record("normal", 1, n=300)
    y = np.array(record.y)
    y[150] += 50 * SIZE
    record = dataclasses.replace(record, y=y)
    fit = begin_fit(make_problem(loop, (), [record]), noise=Noise((1e3,)))
    law = dataclasses.replace(law, scale=float(np.median(fit.filtered[0].innovations ** 2)))
    lin, data = fit.linearized[0], fit.data[0]
    plain = run_filter(fit.plant, data, lin, Noise((1e3,)))
    robust = run_filter(fit.plant, data, lin, Noise((1e3,), tails=law))
    kicks = [abs(o.trajectory.filtered[150, 0] - o.trajectory.predicted[150, 0])
             for o in (plain, robust)]  # fmt: skip
    assert kicks[1] < 0.05 * kicks[0]


@pytest.mark.parametrize(("kind", "seed"), [("student", 5), ("wild", 6), ("normal", 7)])
def test_the_tails_are_chosen_that_there_are(kind, seed):
    loop, record = make_loop_and_record(kind, seed)
    base = maximize(begin_fit(make_problem(loop, ("k", "c"), [record])))
    fit = choose_tails(base)
    if kind == "normal":
        assert fit is base
        return
    tails = fit.noise.tails
    assert bool(tails.freedom) == (kind == "student")
    assert fit.value > base.value + 50
    error = (fit.theta - [3.0, 2.0]) / fit.standard_errors
    assert np.abs(error).max() < 4
    # What a wild reading counts for makes the others tell more.
    assert (fit.standard_errors < base.standard_errors).all()


@pytest.mark.parametrize(("kind", "seed"), [("student", 105), ("wild", 106)])
def test_a_clean_record_with_heavy_tails_has_nothing_missing(kind, seed, tmp_path):
    loop, record = make_loop_and_record(kind, seed)
    found = cid.diagnose(loop, record, catalogue=SOME, progress=False)
    assert found.verdict == "nothing missing"
    assert found.noise.kind == "heavy-tailed"
    assert str(found.noise) in found.sentence
    assert found.noise.size == pytest.approx(SIZE * (1 if kind == "student" else 1.4), rel=0.4)
    told = "Student's law" if kind == "student" else "of the readings err"
    assert told in " ".join(str(found).split())
    again = cid.load_diagnosis(found.save(tmp_path / "found.json"))
    assert again.noise == found.noise


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "seed"), [("student", 205), ("wild", 206)])
def test_a_dead_zone_is_named_under_heavy_tails(kind, seed):
    loop, record = make_loop_and_record(kind, seed, dead_zone=0.05)
    found = cid.diagnose(loop, record, progress=False)
    assert found.verdict == "explained"
    (finding,) = found.findings
    assert "InputDeadZone" in finding.names
    assert found.noise.kind == "heavy-tailed"


def test_white_noise_is_told_as_white():
    loop, record = make_loop_and_record("normal", 305)
    found = cid.diagnose(loop, record, progress=False)
    assert found.verdict == "nothing missing"
    assert found.noise.kind == "white"
    assert str(found.noise) == f"The sensor noise is {found.noise.words}."
    assert found.noise.size == pytest.approx(SIZE, rel=0.1)
    assert str(found.noise) not in found.sentence


def test_tails_finer_than_the_converter_are_no_noise_of_the_sensor():
    """At rest a coarse converter errs hardly at all, and its steps in motion look wild."""
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    at = cid.OperatingPoint(states=(0.0, 0.0), input=0.0, output=0.0)
    law = cid.PID(kp=20.0, kd=1.0, filter_time=0.02)
    loop = cid.Loop(plant, law, dt=0.01, at=at, free=("k", "c"))
    r = np.repeat([0.0, 0.1, 0.0, -0.1, 0.0, 0.1], 400)
    step = 0.004
    fits = {}
    for size, q in ((0.0, step), (step, step / 100)):
        noise = size * np.random.default_rng(1).standard_t(3, len(r))
        y, u = simulate_servo(r, noise)
        record = cid.Record(r=r, u=u, y=q * np.round(y / q), dt=0.01)
        with np.errstate(all="ignore"):
            fit = choose_tails(maximize(begin_fit(make_problem(loop, ("k", "c"), [record]))))
        assert fit.noise.tails is not None
        fits[size] = fit
    assert _errs_less_than_rounding(fits[0.0])
    assert not _errs_less_than_rounding(fits[step])


def test_a_search_begins_at_a_limit_as_well():
    """The logarithm of a share at its limit is infinite, from which no search went on."""
    squares = np.random.default_rng(8).standard_normal(500) ** 2
    for share in (MOST_SHARE, 0.5 * MOST_SHARE):
        law, value = fit_tails(Tails(share=share, ratio=3.0), squares, 0.0)
        assert np.isfinite([law.share, law.ratio, law.scale, value]).all()
        assert law.share <= MOST_SHARE


def test_a_scale_is_found_where_a_secant_leads_below_zero():
    """Errors over twenty orders of magnitude, as of a filter that loses its record."""
    rng, lost = np.random.default_rng(0), 0
    for _ in range(200):
        count = int(rng.integers(20, 120))
        wild = np.geomspace(1e-4, 10 ** rng.uniform(10, 22), count)
        squares = np.concatenate([10 ** rng.uniform(-8, -2, 100), wild])
        law = Tails(share=0.05, ratio=100.0, scale=10 * float(squares.max()))
        with np.errstate(all="raise", under="ignore"):
            scale = law.find_scale(squares, law.scale)
        again = np.mean(law.compute_weight(np.sqrt(squares / scale)) * squares)
        lost += again != pytest.approx(scale, rel=0.02)
    assert lost == 0
