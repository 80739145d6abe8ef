"""The single steps of a search: where it begins, what contains what, what stays possible.

And what a random force that is none looks like.
"""

from dataclasses import dataclass, replace

import control as ct
import numpy as np
import pytest
from scipy import signal, stats

import ctrlid as cid
import problems
from ctrlid import effects as E
from ctrlid.diagnosis import growth, refitting, removal, replicas, scans, screening, selection
from ctrlid.diagnosis.candidates import Objection, _has_effect, contains, keep_for_comparison
from ctrlid.diagnosis.experiment import _can_survive, _list_references, find_experiment
from ctrlid.diagnosis.findings import Disturbance, Finding, Gap
from ctrlid.diagnosis.fitted_model import (
    Model,
    carry_over_fit,
    compute_criterion,
    compute_log_terms,
    drop_arrays,
    drop_linearization,
    has_trajectories,
    takes_readings_as_exact,
    with_linearization,
)
from ctrlid.diagnosis.gap import Window, root_mean_square, share_samples
from ctrlid.diagnosis.growth import (
    Reached,
    _end_search,
    _is_stand_in,
    exchange_worst_effect,
    search_effects,
)
from ctrlid.diagnosis.hindsight import find_better_choice
from ctrlid.diagnosis.noise_tests import NoiseTests, _compute_force_deviates, run_noise_tests
from ctrlid.diagnosis.ordering import order_effect, order_trial
from ctrlid.diagnosis.recalibration import fit_base_model
from ctrlid.diagnosis.refitting import place_instants, refit_candidate, refit_under_noise
from ctrlid.diagnosis.removal import fuse_effects, refit_without_effect, weigh_effects
from ctrlid.diagnosis.replicas import make_replica
from ctrlid.diagnosis.rivals import _find_close, find_rivals
from ctrlid.diagnosis.scans import scan_candidate
from ctrlid.diagnosis.screening import screen_at, screen_candidate
from ctrlid.diagnosis.selection import Round, prefer_plainer, run_round
from ctrlid.diagnosis.thresholds import THRESHOLD
from ctrlid.diagnosis.verdict import find_doubt, gap_is_wider, write_conclusion
from ctrlid.estimation.likelihood.kalman_filter import Noise, guess_trajectory
from ctrlid.estimation.likelihood.likelihood import make_problem, relinearize_fit
from ctrlid.estimation.likelihood.maximization import begin_fit, choose_noise, guess_noise, maximize
from ctrlid.loop.loop import sharpen_effects
from ctrlid.loop.simulation import Simulator
from problems import drive, levitation, pendulum, tanks, under_lead


def record_of(loop, effect, swing, noise, seed, n=1500):
    real = loop.with_effect(effect)
    return problems.record_of(real, swing=swing, hold=60, n=n, seed=seed, sensor_noise=noise)


def test_a_small_zone_is_found_from_a_large_start():
    loop = drive()
    base = fit_base_model(
        loop, [record_of(loop, E.InputDeadZone(0.004), 0.3, 1e-5, 9100)], loop.free
    )
    start = E.InputDeadZone(width=2.0)
    assert screen_at(base, start).score < 0
    trial = screen_candidate(base, start)
    assert trial.score > 0
    found = refit_candidate(base, trial)
    assert found.fitted.width == pytest.approx(0.004, rel=0.1)


def test_a_candidate_that_the_values_of_another_exclude_fails_alone():
    loop = drive()
    record = record_of(loop, E.CoulombFriction(0.5), 0.3, 1e-3, 9330)
    base = fit_base_model(loop, [record], loop.free)
    middle, reach = float(np.mean(record.y)), float(np.ptp(record.y))
    trial = screen_at(base, E.SensorSaturation(middle - reach, middle + reach))
    assert trial.out is None
    near = screen_at(base, E.SensorSaturation(middle + 2 * reach, np.inf)).model
    refused = refit_candidate(base, trial, near)
    assert refused.out.ground == "does not apply"
    assert refused.net_gain == -np.inf


def test_a_candidate_without_what_the_model_doubles_fails_alone(monkeypatch):
    loop = drive()
    record = record_of(loop, E.CoulombFriction(0.5), 0.3, 1e-3, 9330)
    base = fit_base_model(loop, [record], loop.free)
    # With this value in place of what the model doubles, the lower limit is above the upper one.
    excluded = {"SensorSaturation.lower": 11.0}
    monkeypatch.setattr(screening, "find_doubles", lambda *_: excluded)
    refused = screen_at(base, E.SensorSaturation(-10.0, 10.0))
    assert refused.out.ground == "does not apply"


def test_what_contains_what():
    simple, more = E.CoulombFriction(0.1), E.AsymmetricCoulombFriction(0.1, 0.02)
    assert contains(more, simple)
    assert not contains(simple, more)
    assert not contains(more, E.ViscousFriction(0.1))
    assert contains(E.AsymmetricViscousFriction(0.1, 0.02), E.ViscousFriction(0.1))


@pytest.fixture(scope="module")
def one_level():
    """A levitation at one height: a constant force does what its magnet constant does."""
    loop = levitation()
    record = record_of(loop, E.CoulombFriction(0.1), 1e-4, 1e-5, 9200, 3000)
    base = fit_base_model(loop, [record], loop.free)
    plain, more = (refit_candidate(base, screen_candidate(base, e)) for e in (
        E.CoulombFriction(0.0), E.AsymmetricCoulombFriction(0.0, 0.0)))  # fmt: skip
    return base, plain, more


def test_what_the_record_says_nothing_of_stays_possible(one_level):
    _, plain, more = one_level
    assert plain.net_gain > more.net_gain
    assert [t.name for t in find_rivals(plain, [more])] == ["AsymmetricCoulombFriction"]


@pytest.mark.parametrize(
    ("more", "first", "left"), [(0.4, 0, False), (3.0, 0, True), (9.0, 1, True)]
)
def test_a_gain_too_small_to_prove_anything_is_still_compared(
    one_level, monkeypatch, more, first, left
):
    """Beyond what the filter's approximations gain, it has to be paid for, or stays possible."""
    base, plain, rich = one_level
    rich = replace(rich, gain=plain.gain + 10.0)
    monkeypatch.setattr(selection, "measure_gain_beyond_simple", lambda *_: more)
    trials = selection._prefer_simplest(base, [rich, plain])
    assert trials[0].name == (plain.name, rich.name)[first]
    assert all(np.isfinite(t.net_gain) for t in trials) == left


def test_the_simple_effect_of_a_replica_climbs_from_where_the_richer_one_does(
    one_level, monkeypatch
):
    """Where the replica's own fit is stuck, all that it lost would count as the filter's error."""
    base, plain, rich = one_level
    copy = plain.model
    stuck = replace(copy, fit=replace(copy.fit, theta=1.2 * copy.fit.theta))
    stuck = replace(stuck, fit=relinearize_fit(stuck.fit))
    assert stuck.fit.value < copy.fit.value - 100.0
    monkeypatch.setattr(replicas, "make_replica", lambda model: stuck)
    won = replicas.measure_gain_beyond_simple(base, rich, plain)
    assert won == pytest.approx(rich.gain - plain.gain, abs=2 * THRESHOLD.hint)


def test_candidates_are_compared_under_the_same_random_force():
    """A slow force that stood for the missing spring may stay beside one candidate only."""
    loop = levitation()
    record = record_of(loop, E.LinearStiffness(120.0), 2e-4, 2e-6, 9210)
    base = fit_base_model(loop, [record], loop.free)
    right = refit_candidate(base, screen_candidate(base, E.LinearStiffness(0.0)))
    assert selection._forces_differ(right, right) is False
    good = right.model.fit.noise
    slow = replace(good, memory=0.999, drift=1e6)
    wrong = replace(right.model, fit=replace(right.model.fit, noise=slow))
    wrong = replace(wrong, fit=relinearize_fit(wrong.fit))
    lost = replace(right, model=wrong, gain=wrong.fit.value - base.fit.value)
    assert lost.gain < right.gain - 10.0
    assert selection._forces_differ(lost, right)
    assert refit_under_noise(base, lost, good).gain == pytest.approx(right.gain, abs=0.5)
    assert refit_under_noise(base, right, slow).gain >= right.gain  # never lower


def test_what_the_record_excludes_does_not():
    loop = drive()
    record = record_of(loop, E.CoulombFriction(0.5), 0.3, 1e-4, 9300)
    base = fit_base_model(loop, [record], loop.free)
    plain, more = (refit_candidate(base, screen_candidate(base, e)) for e in (
        E.CoulombFriction(0.0), E.AsymmetricCoulombFriction(0.0, 0.0)))  # fmt: skip
    assert plain.gain > 100
    assert find_rivals(plain, [more]) == ()
    # One record in five gains so much by a difference that is none: here it is below a fifth.
    by_chance = replace(more, gain=plain.gain + 2 * THRESHOLD.hint)
    assert find_rivals(plain, [by_chance]) == ()


def test_the_simple_effect_begins_where_the_larger_one_ended(one_level):
    base, plain, more = one_level
    poor = screen_at(base, E.CoulombFriction(5.0))  # from where no refit would find it
    again = prefer_plainer(base, more, [poor])
    assert again.name == "CoulombFriction"
    assert again.gain == pytest.approx(plain.gain, abs=1.0)
    assert np.isfinite(again.net_gain)


def test_the_shape_of_gaussian_noise_is_that_of_scipy():
    x = np.random.default_rng(1).standard_normal(5000)
    expected = [stats.skewtest(x).statistic, stats.kurtosistest(x).statistic]
    np.testing.assert_allclose(
        _compute_force_deviates(x), expected, atol=0.02
    )  # but for a chance correlation
    assert _compute_force_deviates(np.zeros(100)) == []


def test_the_shape_of_a_slow_gaussian_force_is_no_alarm():
    rng = np.random.default_rng(2)
    sizes = []
    for _ in range(300):
        x = signal.lfilter([1.0], [1.0, -0.97], rng.standard_normal(5000))[1000:]
        sizes.append(stats.chi2.sf(np.sum(np.square(_compute_force_deviates(x))), 2))
    assert np.mean(np.array(sizes) < 0.1) == pytest.approx(0.1, abs=0.05)
    assert min(sizes) > 1e-5


@dataclass(frozen=True)
class Pulses(E.ForceEffect):
    """A force that is there for a tenth of the time."""

    push: float = E.parameter("{y}/s^2", neutral=0.0)

    def force(self, m):
        beat = np.sin(2 * np.pi * 0.31 * m.t) + np.sin(2 * np.pi * 0.5 * m.t)
        return self.push * 0.5 * (1 + np.tanh(20 * (beat - 1.2)))


def test_a_force_of_pulses_is_not_taken_for_a_random_one():
    loop = levitation()
    r = cid.random_binary(12_000, amplitude=1e-4, hold=60, around=loop.point.output, seed=9400)
    noise = np.random.default_rng(1).standard_normal(len(r))
    random = signal.lfilter([0.05 * np.sqrt(1 - 0.99**2)], [1.0, -0.99], noise)  # m/s^2
    tests = []
    for real, force in ((loop.with_effect(Pulses(0.15)), 0 * random), (loop, random)):
        d = -force * loop.point.input / (2 * 9.81)  # what the magnet pulls more or less, in volts
        record = cid.simulate(real, r, d=d, sensor_noise=1e-5, seed=9401)
        fit = fit_base_model(loop, [replace(record, u=record.u - d)], loop.free).fit
        assert fit.noise.drift > 0
        tests.append(run_noise_tests(fit).p_values["shape of the random force"])
    assert tests[0] < 1e-5 < 1e-3 < tests[1]


def test_a_curve_that_gains_more_than_chance_stays_possible():
    loop = drive()
    record = record_of(loop, E.CoulombFriction(0.5), 0.3, 1e-3, 9310)
    plain, curve = refitted(loop, record, E.CoulombFriction(0.0), E.StribeckFriction(0.0, 5.0))
    assert plain.net_gain > curve.net_gain
    by_chance, by_more = (replace(curve, gain=plain.gain + d) for d in (0.5, 2.0))
    assert find_rivals(plain, [by_chance]) == ()
    assert [t.name for t in find_rivals(plain, [by_more])] == ["StribeckFriction"]


def test_what_took_the_place_of_another_has_its_rivals():
    loop = levitation()
    record = record_of(loop, E.ActuatorLag(1e-3), 1e-4, 1e-5, 9320)
    base = fit_base_model(loop, [record], loop.free)
    lag, late = (
        refit_candidate(base, screen_candidate(base, e))
        for e in (E.ActuatorLag(5e-4), E.InputDelay(0.0))
    )
    step = Round(base, (lag, late), lag)
    assert lag.net_gain > late.net_gain
    assert [t.name for t in _find_close(lag, [step])] == ["InputDelay"]
    assert [t.name for t in _find_close(late, [step])] == ["ActuatorLag"]
    # Other starts of the same effect take nobody's place.
    lower = replace(late, gain=late.gain - 1)
    crowd = replace(step, trials=(lag, *[lower] * THRESHOLD.looked_at, late))
    assert _find_close(lag, [crowd]) == [late]


def test_what_costs_as_much_but_for_rounding_is_no_larger_model():
    """A rival that predicts the same was left out where it was counted from another base."""
    loop = levitation()
    record = record_of(loop, E.ActuatorLag(1e-3), 1e-4, 1e-5, 9330)
    lag, late = refitted(loop, record, E.ActuatorLag(5e-4), E.InputDelay(0.0))
    assert late.net_gain < lag.net_gain
    twin = replace(lag, effect=E.QuadraticDrag(0.0))  # no look-alike of a lag
    assert find_rivals(lag, [twin]) == (twin,)
    by_rounding = replace(twin, penalty=np.nextafter(np.nextafter(lag.penalty, 9e9), 9e9))
    assert by_rounding.penalty > lag.penalty
    assert find_rivals(lag, [by_rounding]) == (by_rounding,)
    # One that costs more and predicts the same contains it, and pays for nothing.
    dearer = replace(twin, penalty=lag.penalty + 4, effect=E.StribeckFriction(0.0, 1.0))
    assert find_rivals(lag, [dearer]) == ()


def refitted(loop, record, *candidates):
    base = fit_base_model(loop, [record], loop.free)
    return [refit_candidate(base, screen_candidate(base, e)) for e in candidates]


def test_an_experiment_is_recommended_that_tells():
    """Around one height an exponent and an offset of the law are one; over several they are two."""
    loop = levitation()
    record = record_of(loop, E.ForceExponent(n=2.2), 1e-4, 2e-6, 9500)
    best, other = refitted(loop, record, E.ForceExponent(n=2.0), E.PositionOffset(0.0))
    words, reference = find_experiment(best, [other], record)
    assert "Recommended reference: " in words
    real = loop.with_effect(E.ForceExponent(n=2.2))
    second = cid.simulate(real, reference, sensor_noise=2e-6, seed=9502)
    best, other = refitted(loop, second, E.ForceExponent(n=2.0), E.PositionOffset(0.0))
    assert find_rivals(best, [other]) == ()


def test_an_experiment_is_told_by_the_rival():
    """What tells a lag of the sensor from a delay does not tell it from a lag of the actuator."""
    loop = levitation()
    record = replace(record_of(loop, E.SensorLag(1e-3), 1e-4, 1e-5, 9550), r=None)
    lags = E.SensorLag(5e-4), E.ActuatorLag(5e-4), E.InputDelay(0.0)
    best, actuator, late = refitted(loop, record, *lags)
    words, reference = find_experiment(best, [actuator], record)
    assert words.startswith("large steps of the input")
    assert "delay" not in words
    assert reference is None
    assert find_experiment(best, [late], record)[0] == E.SensorLag.experiment
    both = find_experiment(best, [actuator, late], record)[0]
    assert both == f"{words}; and {E.SensorLag.experiment}"


def test_a_reference_is_described_as_it_is():
    record = record_of(levitation(), E.SensorLag(1e-3), 1e-4, 1e-5, 9550)
    text, r = _list_references(record)[-1]
    assert text.endswith("can change at every second sample")
    changes = np.flatnonzero(np.diff(r))
    assert np.all(changes % 2 == 1)
    assert np.ptp(np.diff(changes)) > 0


def test_no_experiment_is_recommended_where_none_tells():
    """A delay and a lag of a hundredth of a sample are the same for any record."""
    loop = levitation()
    record = record_of(loop, E.InputDelay(2e-5), 1e-4, 2e-7, 9600)
    best, other = refitted(loop, record, E.InputDelay(1e-5), E.SensorLag(1e-5))
    assert abs(best.gain - other.gain) < 3 < best.gain
    words, reference = find_experiment(best, [other], record)
    assert reference is None
    assert "No steps of the reference" in words


def test_an_experiment_under_which_the_plant_falls_is_not_recommended():
    """Behind limits of the input a pendulum that has fallen stays bounded: no simulation fails."""
    loop = pendulum(E.InputSaturation(-0.1, 0.1))
    record = problems.record_of(loop, swing=0.02, hold=60, n=6000, seed=3, sensor_noise=1e-4)
    simulator = Simulator(loop, 1e-6, 8)
    assert _can_survive(simulator, record.r, record)
    bold = cid.random_binary(6000, amplitude=0.4, hold=60, seed=3)
    assert np.ptp(simulator.run(simulator.start(None), bold, np.zeros(6000))[0]) > 3.0
    assert not _can_survive(simulator, bold, record)


def test_a_filter_that_lost_the_record_passes_no_test():
    loop = drive()
    record = record_of(loop, E.CoulombFriction(0.3), 0.3, 1e-4, 9701)
    fit = fit_base_model(loop, [record], loop.free).fit
    assert run_noise_tests(replace(fit, value=-np.inf)).worst == ("following the record", 0.0)


def test_records_for_validation_are_sampled_as_the_loop_is():
    loop = drive()
    record = record_of(loop, E.CoulombFriction(0.3), 0.3, 1e-4, 9702)
    with pytest.raises(cid.CtrlidError, match=r"sampled at 0\.02 s, the loop at 0\.01 s"):
        cid.diagnose(loop, record, validation=record.decimate(2), progress=False)


def test_a_model_without_its_arrays_can_be_searched_on():
    loop = drive()
    record = record_of(loop, E.CoulombFriction(0.3), 0.3, 1e-4, 9700)
    base = fit_base_model(loop, [record], loop.free)
    lean = Model(base.loop, drop_linearization(base.fit))
    assert not lean.fit.linearized
    assert with_linearization(base) is base
    full = with_linearization(lean)
    assert full.fit.value == pytest.approx(base.fit.value, abs=0.1)
    effect = E.PeriodicForce(amplitude=0.0, frequency=1.0, phase=0.0)
    assert scan_candidate(full, effect).score == pytest.approx(
        scan_candidate(base, effect).score, rel=0.05
    )


def test_a_motion_far_faster_than_the_samples_is_refused():
    loop = drive(("k",), cid.plants.servo(m=1e-6, c=1.0, k=1.0), cid.PID(kp=1.0))
    still = record_of(drive(), E.CoulombFriction(0.3), 0.3, 1e-4, 9800)
    with pytest.raises(cid.CtrlidError, match="times faster than it is sampled"):
        cid.fit_loop(loop, still)


def test_many_effects_at_once_are_no_explanation():
    gap = Gap("simulation", 3.0, 2.0, 1.1, 1.0, "m", *[np.zeros(3)] * 4)
    quiet = Disturbance(0.0, 0.0, np.nan, 0.0)
    tests = NoiseTests({"whiteness": 0.5}, np.zeros(3), {})
    kinds = (
        E.CoulombFriction(0.1),
        E.LinearStiffness(1.0),
        E.InputOffset(0.1),
        E.QuadraticDrag(1.0),
    )
    findings = [Finding(e, {}, (), (), 50.0) for e in kinds]
    loose = find_doubt(kinds, [50.0] * 4, 200.0)
    text = write_conclusion("partly explained", findings, gap, quiet, tests, (), loose)
    assert text.startswith("With CoulombFriction, LinearStiffness, ")
    assert "so many effects together can describe almost any error" in text


@pytest.mark.slow
def test_a_pair_is_not_taken_for_the_mixture_that_alone_gains_most():
    """Brake and dead zone: a quadratic drag gains more than either, and then needs two more."""
    plant = cid.plants.maglev(m=0.0787, K=1.561e-5)
    at = cid.operating_point(plant, output=0.01868)
    lead = ct.tf([-5996, 5780], [1, -0.6211], 1.4e-3)
    loop = cid.Loop(plant, lead, dt=1.4e-3, at=at, free=("K",))
    real = loop.with_effect(E.InputDeadZone(0.143)).with_effect(E.EddyCurrentDamping(1.4))
    r = cid.random_binary(4000, amplitude=3.7e-4, hold=38, around=at.output, seed=5)
    record = cid.simulate(real, r, sensor_noise=1.2e-5, force_noise=0.036, seed=6)
    found = cid.diagnose(loop, record, progress=False, catalogue=[
        E.QuadraticDrag, E.EddyCurrentDamping, E.InputDeadZone, E.ForceExponent,
        E.InputSaturatingGain,
    ])  # fmt: skip
    first = next(c for c in found.ranking if c.round == 1)
    assert type(first.effect) is E.QuadraticDrag
    assert {f.name for f in found.findings} == {"EddyCurrentDamping", "InputDeadZone"}
    assert found.verdict == "explained"


def test_a_replica_is_fitted_from_its_own_trajectory():
    """Another noise, and the ball moves a quarter of a ripple elsewhere: the record is no guide."""
    plant = cid.plants.maglev(m=0.0307, K=4.21e-6)
    at = cid.operating_point(plant, output=0.00762)
    loop = under_lead(plant, 6.6e-4, at, crossover=130, phase_margin=45, free=("K",))
    hidden = E.PositionRipple(amplitude=0.8, period=1.6e-4, phase=1.0)
    r = cid.random_binary(4000, amplitude=1e-4, hold=70, around=at.output, seed=9800)
    record = cid.simulate(loop.with_effect(hidden), r, sensor_noise=7.5e-6, seed=9801)
    real = loop.with_effect(hidden)
    names = ("K", "PositionRipple.amplitude", "PositionRipple.period", "PositionRipple.phase")
    model = fit_base_model(real, [record], names)
    for seed in (0, 1):
        copy = make_replica(model, seed)
        np.testing.assert_allclose(copy.fit.theta[1], model.fit.theta[1], rtol=0.05)
        assert copy.fit.value > model.fit.value - 300


@pytest.mark.slow
def test_units_of_the_record_that_are_not_those_of_the_plant_are_told():
    loop = drive()
    record = record_of(loop, E.CoulombFriction(2.0), 0.3, 1e-4, 9850, n=300)
    volts = replace(record, units={"u": "1", "y": "V"})
    found = cid.diagnose(loop, volts, progress=False, catalogue=[E.CoulombFriction])
    told = [text for text in found.audit if text.startswith("units: ")]
    assert len(told) == 2
    assert "u is recorded without a unit, but the plant has it in" in told[0]
    assert "y is recorded in V, but the plant has it in m. The model takes the numbers" in told[1]
    # The plant says that its velocity is in m/s, and so is told what accelerates it.
    assert "m/s^2" in str(found)
    # The audit comes before the search, so that there is nothing to search for.
    again = cid.diagnose(loop, record, progress=False, catalogue=())
    assert not [text for text in again.audit if text.startswith("units: ")]
    silent = replace(record, units={})
    found = cid.diagnose(loop, silent, progress=False, catalogue=())
    (told,) = [text for text in found.audit if text.startswith("units: ")]
    assert "the record does not say its units" in told


@pytest.mark.slow
def test_a_limit_is_found_behind_a_random_force_that_stood_for_it():
    plant = cid.plants.tank(area=0.0147, outlet=7.7e-5, k=5.9e-5)
    op = cid.operating_point(plant, output=0.8)
    loop = cid.Loop(plant, cid.PID(kp=4.0, ki=0.03), dt=12.0, at=op, free=("k", "outlet"))
    real = loop.with_effect(E.StateLimit("h", upper=0.82))
    r = cid.random_binary(12000, amplitude=0.045, hold=40, around=0.8, seed=9300)
    record = cid.simulate(real, r, sensor_noise=3e-3, seed=9301)
    believed = loop.with_parameters({"k": 6.1e-5, "outlet": 7.1e-5})
    base = fit_base_model(believed, [record], believed.free)
    assert base.fit.noise.drift > 0  # there is none in the record
    (start,) = E.StateLimit.candidates(base.fitted, record)
    trial = refit_candidate(base, scan_candidate(base, start))
    assert trial.model.fit.noise.drift == 0
    assert trial.fitted.upper == pytest.approx(0.82, abs=2e-4)
    assert trial.model.fitted.parameters["k"] == pytest.approx(5.9e-5, rel=0.02)


def test_an_overflow_is_looked_for_from_above():
    loop = tanks(cid.PID(kp=0.5, ki=0.005), free=("k4",))
    full = loop.at.states[0] * 1.3
    record = record_of(loop, E.StateLimit("h1", full, "h2", share=0.3), 1.5, 1e-2, 9320, 3000)
    base = fit_base_model(loop, [record], loop.free)
    start, _ = E.StateLimit.candidates(base.fitted, record)
    trial = scan_candidate(base, start)
    assert trial.score > 20
    fitted = refit_candidate(base, trial).fitted
    assert (fitted.upper, fitted.share) == pytest.approx((full, 0.3), rel=0.1)


def test_friction_that_would_push_is_none():
    assert not E.AsymmetricCoulombFriction(fc=0.2, difference=-0.25).doubt()
    assert "push" in E.AsymmetricCoulombFriction(fc=0.1, difference=-0.25).doubt()
    loop = levitation()
    record = record_of(loop, E.ConstantForce(-0.5), 4e-4, 1e-6, 9330)
    base = fit_base_model(loop, [record], loop.free)
    start = E.AsymmetricCoulombFriction(fc=0.0, difference=0.0)
    assert "push" in refit_candidate(base, screen_at(base, start)).out.words


def test_waves_that_two_levels_see_nearly_alike_are_fitted():
    loop = levitation()
    ripple = E.PositionRipple(amplitude=0.4, period=2.3e-4, phase=1.0)
    record = record_of(loop, ripple, 2.5e-4, 1e-6, 9340, n=6000)
    base = fit_base_model(loop, [record], loop.free)
    (start,) = E.PositionRipple.candidates(base.fitted, record)
    assert scan_candidate(base, start).others
    step = run_round(base, [start], lambda f, given: [f(x) for x in given])
    assert step.best is not None
    assert step.best.fitted.period == pytest.approx(2.3e-4, rel=0.005)
    assert step.best.fitted.amplitude == pytest.approx(0.4, rel=0.1)


def test_a_wave_that_half_the_samples_pass_in_a_hurry_is_found():
    loop = drive()
    record = record_of(loop, E.PositionRipple(amplitude=1.0, period=3e-4, phase=1.0), 4e-3, 4e-6,
                       9350, n=4000)  # fmt: skip
    assert 4 * np.median(np.abs(np.diff(record.y))) > 3e-4
    base = fit_base_model(loop, [record], loop.free)
    (start,) = E.PositionRipple.candidates(base.fitted, record)
    assert scan_candidate(base, start).effect.period == pytest.approx(3e-4, rel=0.01)


def test_a_limit_of_the_input_is_found_wherever_it_cuts():
    loop = levitation()
    record = record_of(loop, E.InputSaturation(-np.inf, 4.0), 6e-4, 1e-6, 9350)
    base = fit_base_model(loop, [record], loop.free)
    (start,) = E.InputSaturation.candidates(base.fitted, record)
    trial = refit_candidate(base, scan_candidate(base, start))
    assert trial.fitted.upper == pytest.approx(4.0, abs=0.01)
    assert trial.gain > 1000


def test_lists_that_prove_little():
    ripples = [E.PositionRipple(0.1, period, 0.0) for period in (1e-3, 2e-3)]
    assert "several ripples" in find_doubt(ripples, [100.0, 90.0], 200.0)
    three = [E.QuadraticDrag(1.0), E.LinearStiffness(1.0), E.EddyCurrentDamping(0.1)]
    assert not find_doubt(three, [900.0, 300.0, 60.0], 1200.0)
    assert "an error in the form of a larger one" in find_doubt(three, [900.0, 24.0, 11.0], 1000.0)
    assert not find_doubt(three[:2], [900.0, 11.0], 1000.0)


def test_two_look_alikes_of_which_either_would_do_are_one_thing():
    """A limited rate is nearly a delay and nearly a lag; the rest is filled with the other."""
    both = [E.InputDelay(1e-3), E.ActuatorLag(1e-3)]
    text = find_doubt(both, [80.0, 57.0], 2050.0)
    assert "InputDelay and ActuatorLag are look-alikes" in text
    assert not find_doubt(both, [1240.0, 240.0], 4200.0)
    assert not find_doubt([both[0], E.LinearStiffness(1.0)], [80.0, 57.0], 4100.0)


def test_a_filter_begins_where_a_curved_sensor_points():
    loop = levitation().with_effect(E.SensorLag(4e-4)).with_effect(E.SensorNonlinearity(20.0))
    truth = np.linspace(0.010, 0.015, 500)
    y = truth + 20.0 * (truth - loop.point.output) ** 2
    record = cid.Record(r=y, u=np.full(500, loop.point.input), y=y, dt=2e-3)
    problem = make_problem(loop, (), [record])
    begun = guess_trajectory(problem.plant, problem.data[0]).predicted
    position = list(problem.plant.e.states).index("x")
    np.testing.assert_allclose(begun[:, position], truth, rtol=1e-6)


def test_limits_far_inside_are_found_though_none_promises_anything():
    """A rolling ball under an observer that kicks: limits at a third of what it asks for."""

    def ball(c, w):
        return ct.nlsys(
            lambda t, x, u, p: [x[1], p["c"] * np.sin(x[2]), p["w"] * (u[0] - x[2])],
            lambda t, x, u, p: x[0], inputs=["u"], outputs=["x"], states=["x", "v", "tilt"],
            params={"c": c, "w": w}, name="ball_beam",
        )  # fmt: skip

    C = ct.tf([118.2, -94.08, -117.6, 94.68], [1.0, -0.7534, 0.4893, -0.07494], 0.01)
    at = cid.OperatingPoint((0.0, 0.0, 0.0), 0.0, 0.0)
    real, believed = (cid.Loop(ball(*p), C, dt=0.01, at=at, free=("c", "w"))
                      for p in ((9.37, 19.2), (8.66, 19.74)))  # fmt: skip
    record = record_of(real, E.InputSaturation(-3.4, 3.4), 0.05, 5e-4, 9700, 4000)
    base = fit_base_model(believed, [record], believed.free)
    pool = [E.InputSaturatingGain(0.0), *E.InputSaturation.candidates(believed, record)]
    step = run_round(base, pool, lambda f, given: [f(x) for x in given])
    assert step.best is not None
    assert step.best.name == "InputSaturation"
    assert step.best.fitted.upper == pytest.approx(3.4, rel=1e-3)
    first, _ = sorted(step.trials, key=lambda t: -t.net_gain)
    assert first.net_gain > 1.5 * refit_candidate(base, scan_candidate(base, pool[1])).net_gain


@pytest.mark.slow
def test_dry_friction_is_not_lost_to_a_curve_that_contains_it():
    """A fit that a large random force smooths is stuck; one that starts without it is not."""

    def coil(K, R):
        return ct.nlsys(
            lambda t, x, u, p: [x[1], 9.81 - p["K"] / 0.1076 * (x[2] / x[0]) ** 2,
                                (u[0] - p["R"] * x[2]) / 0.0245],
            lambda t, x, u, p: x[0], inputs=["V"], outputs=["y"], states=["x", "v", "i"],
            params={"K": K, "R": R}, name="maglev_coil",
        )  # fmt: skip

    C = ct.tf([-8862.054, 7623.508, 8819.593, -7665.969], [1.0, -0.612588, -0.892843, 0.641762],
              0.001)  # fmt: skip
    real, believed = (
        cid.Loop(plant, C, dt=0.001, at=cid.operating_point(plant, output=0.01), free=("K", "R"))
        for plant in (coil(9.13e-5, 2.2), coil(9.09e-5, 2.1))
    )
    r = cid.random_binary(10_000, amplitude=3e-4, hold=40, around=0.01, seed=5)
    rig = real.with_effect(E.CoulombFriction(0.082))
    record = cid.simulate(rig, r, sensor_noise=5e-6, seed=6)
    base = fit_base_model(believed, [record], believed.free)
    friction, curve = (kind.candidates(believed, record)[0]
                       for kind in (E.CoulombFriction, E.StribeckFriction))  # fmt: skip
    alone, other = (refit_candidate(base, screen_candidate(base, e)) for e in (friction, curve))
    assert alone.net_gain < other.net_gain
    step = run_round(base, [friction, curve], lambda f, given: [f(x) for x in given])
    assert step.best is not None
    assert step.best.name == "CoulombFriction"
    assert step.best.net_gain > alone.net_gain + 50


def test_one_asymmetric_friction_is_not_called_two_effects():
    loop = levitation()
    record = record_of(loop, E.AsymmetricCoulombFriction(0.2, 0.15), 4e-4, 1e-6, 9400)
    pair = loop.with_effect(E.CoulombFriction(0.2)).with_effect(E.ConstantForce(0.05))
    names = ("K", "CoulombFriction.fc", "ConstantForce.bias")
    model = fit_base_model(pair, [record], names)
    base = fit_base_model(loop, [record], loop.free)
    rounds = (Round(base, (screen_candidate(base, E.AsymmetricCoulombFriction(0.1, 0.0)),), None),)
    one = fuse_effects(model, 0, rounds)
    assert [type(e).__name__ for e in one.loop.effects] == ["AsymmetricCoulombFriction"]
    assert one.fitted.effects[0].fc == pytest.approx(0.2, rel=0.02)
    assert one.fitted.effects[0].difference == pytest.approx(0.15, rel=0.05)
    assert fuse_effects(model, 0, ()) is model


def test_friction_beside_asymmetric_friction_is_one():
    loop = levitation()
    real = loop.with_effect(E.AsymmetricCoulombFriction(0.2, 0.15))
    record = record_of(real, E.ConstantForce(0.0), 4e-4, 1e-6, 9411)
    pair = loop.with_effect(E.CoulombFriction(0.1)).with_effect(
        E.AsymmetricCoulombFriction(0.1, 0.15)
    )
    names = ("K", "AsymmetricCoulombFriction.difference")
    two = fit_base_model(pair, [record], names)
    sizes = ("CoulombFriction.fc", "AsymmetricCoulombFriction.fc")
    model = Model(two.loop, carry_over_fit(two, two.fitted, (*two.names, *sizes)))
    one = fuse_effects(model, 0, ())
    assert [type(e).__name__ for e in one.loop.effects] == ["AsymmetricCoulombFriction"]
    assert one.fitted.effects[0].fc == pytest.approx(0.2, rel=0.02)
    assert one.fit.value > model.fit.value - 1


def test_two_effects_that_are_two_stay_two():
    loop = levitation()
    pair = loop.with_effect(E.CoulombFriction(0.2)).with_effect(E.LinearStiffness(300.0))
    record = record_of(pair, E.ConstantForce(0.0), 4e-4, 1e-6, 9410)
    names = ("K", "CoulombFriction.fc", "LinearStiffness.k1")
    model = fit_base_model(pair, [record], names)
    base = fit_base_model(loop, [record], loop.free)
    rounds = (Round(base, (screen_candidate(base, E.AsymmetricCoulombFriction(0.1, 0.0)),), None),)
    assert fuse_effects(model, 0, rounds) is model


@dataclass(frozen=True)
class CubicDrag(E.ForceEffect):
    """A drag that grows with the third power of the speed."""

    c3: float = E.parameter("s/{y}^2", neutral=0.0)

    def force(self, m):
        return -self.c3 * m.velocity**3


def test_what_gains_far_less_than_is_missing_only_stands_in_for_it():
    loop = levitation()
    record = record_of(loop, CubicDrag(3e5), 4e-4, 1e-6, 9420, 3000)
    base = fit_base_model(loop, [record], loop.free)
    nearly = with_linearization(
        refit_candidate(base, screen_candidate(base, E.QuadraticDrag(10.0))).model
    )
    right = refit_candidate(nearly, screen_candidate(nearly, CubicDrag(1e4)))
    assert right.gain > 1500
    assert not _is_stand_in(right, nearly, beside=True)
    (spring,) = E.LinearStiffness.candidates(loop, record)
    little = refit_candidate(nearly, screen_candidate(nearly, spring))
    assert 0 < little.gain < 50
    assert _is_stand_in(little, nearly, beside=True)
    assert not _is_stand_in(little, nearly, beside=False)


def test_a_search_that_is_stopped_just_after_it_went_back_keeps_the_best_that_it_had():
    loop = levitation()
    record = record_of(loop, E.ViscousFriction(0.3), 4e-4, 1e-6, 9425, 3000)
    base = fit_base_model(loop, [record], loop.free)
    (friction,) = E.ViscousFriction.candidates(loop, record)
    best = refit_candidate(base, screen_candidate(base, friction))
    assert best.net_gain > 50
    reached = Reached(base, [Round(base, (best,), best)], base)
    reached.keep(base, best)
    reached.steps[-1], reached.model = Round(base, (best,), None), base
    stopped = _end_search(reached)
    assert [f.trial for f in stopped.found] == [best]
    assert stopped.final is best.model
    assert not stopped.finished


def test_where_nothing_follows_equals_of_the_best_are_asked():
    """With a constant force in place of an offset, the middle of the spring is wrong."""
    plant = ct.nlsys(
        lambda t, x, u, p: [x[1], p["k"] * u[0] - p["s"] * x[0] - p["d"] * x[1]],
        lambda t, x, u, p: x[0], inputs=["u"], outputs=["x"], states=["x", "v"],
        params={"k": 2.0, "s": 40.0, "d": 4.0}, name="spring",
    )  # fmt: skip
    loop = drive(("s", "d"), plant, cid.PID(kp=20.0, ki=30.0, kd=2.0, filter_time=0.02))
    spring, offset = E.CubicStiffness(8000.0), E.SensorOffset(-0.05)
    record = record_of(loop.with_effect(offset), spring, 0.05, 1e-5, 9430, 4000)
    base = fit_base_model(loop, [record], loop.free)
    force, zero = (refit_candidate(base, screen_candidate(base, *kind.candidates(loop, record)))
                   for kind in (E.ConstantForce, E.SensorOffset))  # fmt: skip
    assert force.net_gain == pytest.approx(zero.net_gain, abs=0.1)
    first = Round(base, (force, zero), force, (zero,))
    nothing = Round(with_linearization(force.model), (), None)
    other = find_better_choice(
        first, nothing, [E.CubicStiffness], lambda f, given: [f(x) for x in given]
    )
    assert other is zero
    assert E.equivalents(offset, loop.with_effect(spring)) == ()


def test_waves_may_be_several_and_modes_may_not():
    loop = levitation()
    mode, wave = E.FlexibleMode(40.0, 0.1, 0.2), E.PeriodicForce(0.1, 3.0, 0.0)
    fit = fit_base_model(loop, [record_of(loop, wave, 1e-4, 1e-5, 9440)], loop.free).fit
    model = Model(loop.with_effect(mode).with_effect(wave), fit)
    assert _has_effect(model, E.FlexibleMode(9.0, 0.3, 0.1))
    assert not _has_effect(model, E.PeriodicForce(0.1, 5.0, 0.0))
    assert not _has_effect(model, E.CoulombFriction(0.1))


@pytest.mark.parametrize(("size", "alone"), [(1.0, False), (40.0, True)])
def test_a_parameter_at_its_bound_does_nothing_for_an_effect(size, alone):
    """The drive's own friction may grow to ten times its given value; the rest is the effect's."""
    loop = drive()
    hidden = E.AsymmetricViscousFriction(c=size, difference=-0.5 * size)
    base = fit_base_model(loop, [record_of(loop, hidden, 0.3, 1e-4, 9450, n=2000)], loop.free)
    trial = screen_candidate(base, E.AsymmetricViscousFriction(0.0, 0.0))
    assert (base.fit.theta[0] == pytest.approx(50.0)) == alone
    assert ("AsymmetricViscousFriction.c" in trial.model.names) == alone


@pytest.mark.slow
def test_an_offset_ahead_of_a_curve_is_no_force_behind_it():
    """Alone the two are the same; beside a gain that falls with the input they are not."""
    loop = drive()
    real = loop.with_effect(E.InputSaturatingGain(0.004)).with_effect(E.InputOffset(-0.7))
    r = cid.random_binary(4000, amplitude=0.05, hold=60, around=loop.point.output, seed=5)
    record = cid.simulate(real, r, sensor_noise=2e-5, force_noise=0.05, seed=6)
    found = cid.diagnose(loop, record, progress=False, catalogue=[
        E.ConstantForce, E.InputOffset, E.InputSaturatingGain, E.InputDelay, E.CoulombFriction,
    ])  # fmt: skip
    assert found.verdict == "explained"
    assert [f.name for f in found.findings] == ["InputOffset", "InputSaturatingGain"]
    assert not any(f.alternatives or f.equivalents for f in found.findings)


@pytest.fixture(scope="module")
def two_found():
    """A search that found a friction and a spring."""
    loop = replace(drive(), controller=None)
    real = drive().with_effect(E.CoulombFriction(0.3)).with_effect(E.LinearStiffness(20.0))
    r = cid.random_binary(2000, amplitude=0.3, hold=60, seed=9470)
    record = cid.simulate(real, r, sensor_noise=1e-4, seed=9471)
    base = fit_base_model(loop, [record], loop.free)
    kinds = (E.CoulombFriction, E.AsymmetricCoulombFriction, E.LinearStiffness)
    return search_effects(base, kinds, lambda f, items: [f(x) for x in items],
                          lambda text, **_: None, lambda model: False)  # fmt: skip


class FreshStub:
    """Fresh data that each name in a model makes so much wider, of which chance makes nothing."""

    def __init__(self, widens):
        self.widens = widens

    def measure_model_gap(self, model):
        return sum(self.widens.get(name, 0.0) for name in model.loop.labelled)

    def compute_widening_chance(self, one, other):
        return 0.0 if self.measure_model_gap(one) < self.measure_model_gap(other) else 1.0


@pytest.mark.slow
def test_the_rival_that_fresh_data_like_takes_the_place_of_a_harmful_name(two_found):
    rivals = {t.name for step in two_found.steps for t in step.trials if t.net_gain > 5}
    rivals -= {"CoulombFriction", "LinearStiffness"}
    assert rivals == {"AsymmetricCoulombFriction"}
    other = "AsymmetricCoulombFriction"
    fresh = FreshStub({"CoulombFriction": 1.0, other: -1.0})
    left, worst = exchange_worst_effect(two_found, (), fresh)
    assert worst == "CoulombFriction"
    assert other in {f.trial.name for f in left.found}
    assert "CoulombFriction" not in left.final.loop.labelled
    kept, _ = exchange_worst_effect(two_found, (other,), fresh)
    assert other not in {f.trial.name for f in kept.found}


@pytest.mark.slow
def test_the_name_without_which_the_gap_is_narrowest_goes_first(two_found):
    names = {f.trial.name for f in two_found.found}
    assert names == {"CoulombFriction", "LinearStiffness"}
    for name in names:
        fresh = FreshStub({name: 1.0})
        left, worst = exchange_worst_effect(two_found, (), fresh)
        assert worst == name
        assert {f.trial.name for f in left.found} == names - {name}
        assert list(left.final.loop.labelled) == [*names - {name}]


def test_a_standard_error_does_not_overrule_a_likelihood(two_found, monkeypatch):
    model = two_found.final
    smaller, trial = refit_without_effect(model, 0)
    bare = replace(trial.model, fit=drop_arrays(trial.model.fit))
    flat = replace(trial, model=bare, out=Objection("insignificant", "within 2 standard errors"))
    monkeypatch.setattr(removal, "refit_without_effect", lambda *_: (smaller, flat))
    left, kept = removal.weigh_without_effect(model, 0)
    assert kept.out is None
    assert kept.net_gain > 100
    assert compute_criterion(left) < compute_criterion(model) - 100
    assert kept.net_gain == pytest.approx(compute_criterion(model) - compute_criterion(left))
    # What was put out had lost its likelihood, which a comparison of names needs.
    assert np.sum(compute_log_terms(kept.model.fit)) == pytest.approx(model.fit.value)
    # What explains as much without the effect takes its place all the same.
    monkeypatch.setattr(removal, "refit_noise", lambda smaller: model)
    assert removal.weigh_without_effect(model, 0)[1] is flat


@pytest.mark.parametrize("ended", [-np.inf, -60.0])
def test_evidence_is_against_the_likeliest_model_that_the_search_passed(
    two_found, monkeypatch, ended
):
    """A climb without an effect that ends too low, or loses the record, makes no evidence."""
    model, steps = two_found.final, two_found.steps
    weigh = removal.weigh_without_effect

    def fall_short(model, position):
        smaller, trial = weigh(model, position)
        low = replace(smaller.fit, value=smaller.fit.value + ended)
        return replace(smaller, fit=low), replace(trial, gain=trial.gain - ended)

    honest = {f.position: f for f in weigh_effects(model, 0, steps)[1]}
    monkeypatch.setattr(removal, "weigh_without_effect", fall_short)
    found = {f.position: f for f in weigh_effects(model, 0, steps)[1]}
    last = max(found)
    assert found[last].trial.net_gain == pytest.approx(honest[last].trial.net_gain, abs=1.0)
    assert np.isfinite(found[last].base.fit.value)


def test_a_model_that_was_kept_for_a_comparison_alone_can_be_carried_on(two_found, monkeypatch):
    """One that a search passed may be the likeliest without an effect, and has no states left."""
    model, first = two_found.final, two_found.steps[0]
    steps = [replace(first, trials=tuple(map(keep_for_comparison, first.trials)))]
    weigh = removal.weigh_without_effect

    def fall_short(model, position):
        smaller, trial = weigh(model, position)
        return replace(smaller, fit=replace(smaller.fit, value=smaller.fit.value - 60)), trial

    monkeypatch.setattr(removal, "weigh_without_effect", fall_short)
    last = max(weigh_effects(model, 0, steps)[1], key=lambda f: f.position)
    assert has_trajectories(last.base.fit)
    assert not has_trajectories(steps[0].trials[0].model.fit)
    assert last.base.fit.value == pytest.approx(first.best.model.fit.value, abs=0.5)
    assert np.isfinite(screen_at(last.base, E.LinearStiffness(1.0)).score)


@pytest.mark.slow
def test_a_search_ends_with_the_likeliest_state_it_passed_through(monkeypatch):
    loop = replace(drive(), controller=None)
    real = drive().with_effect(E.CoulombFriction(0.3)).with_effect(E.LinearStiffness(20.0))
    r = cid.random_binary(600, amplitude=0.3, hold=60, seed=9472)
    record = cid.simulate(real, r, sensor_noise=1e-4, seed=9473)
    base = fit_base_model(loop, [record], loop.free)
    drop = growth.drop_superfluous

    def drop_the_first(model, given):
        """Lose what gained much as soon as something that gains little is beside it."""
        if len(model.loop.effects) < given + 2:
            return drop(model, given)
        return refit_without_effect(model, given)[0]

    monkeypatch.setattr(growth, "drop_superfluous", drop_the_first)
    kinds = (E.CoulombFriction, E.LinearStiffness)
    found = search_effects(base, kinds, lambda f, items: [f(x) for x in items],
                           lambda text, **_: None, lambda model: False)  # fmt: skip
    passed = [Model(step.base.loop, step.base.fit) for step in found.steps]
    assert len(passed) > 1
    reached = max(map(compute_criterion, passed))
    assert compute_criterion(found.final) > reached - THRESHOLD.gate


def test_what_is_put_back_and_stuck_keeps_its_evidence(two_found, monkeypatch):
    model = two_found.final
    right = refit_without_effect(model, 0)[1]
    assert right.gain > 100
    monkeypatch.setattr(removal, "refit_candidate", lambda base, trial: replace(trial, gain=-10.0))
    smaller, kept = refit_without_effect(model, 0)
    assert kept.gain == model.fit.value - smaller.fit.value
    assert kept.gain == pytest.approx(right.gain, rel=0.01)


def test_a_gap_about_the_floor_takes_no_name_back():
    def gap(after):
        return Gap("simulation", 9.0, 3.0, after, 4.0, "m", *[np.zeros(3)] * 4)

    sensor, force = Disturbance(0.1, 0.0, np.nan, 0.2), Disturbance(0.1, 0.0, np.nan, 0.9)
    assert not gap_is_wider(gap(2.9), force)
    assert not gap_is_wider(gap(3.9), force)  # above the gap before, and below the floor
    assert not gap_is_wider(gap(4.4), sensor)
    assert gap_is_wider(gap(4.4), force)
    assert gap_is_wider(gap(6.1), sensor)


def test_what_went_astray_beside_an_effect_begins_without_it_as_handed_in():
    # With another zero of the gap a magnet may be fitted that no ball could hang below.
    plant = cid.plants.maglev(m=0.037, K=3.8264e-5)
    op = cid.operating_point(plant, output=0.0154)
    loop = under_lead(plant, 3e-3, op, crossover=55, free=("K",))
    r = cid.random_binary(600, amplitude=1.7e-4, hold=40, around=op.output, seed=5)
    record = cid.simulate(loop, r, sensor_noise=1e-5, seed=2)
    model = fit_base_model(
        loop.with_effect(E.PositionOffset(offset=1e-4)), [record], ("K", "PositionOffset.offset")
    )
    astray = replace(model, fit=replace(model.fit, theta=np.array([1e13, 1.0]) * model.fit.theta))
    smaller, _ = refit_without_effect(astray, 0)
    assert smaller.names == ("K",)
    assert smaller.fit.theta == pytest.approx([3.8264e-5], rel=0.01)


def test_an_effect_without_which_nothing_follows_stays():
    # The saturating gain lets the ball fall: a filter without it cannot follow, however noisy.
    plant = cid.plants.maglev(m=0.037, K=3.8264e-5)
    op = cid.operating_point(plant, output=0.0154)
    loop = under_lead(plant, 3e-3, op, crossover=55, input_limits=(0, 3.76), free=("K",))
    real = loop.with_effect(E.QuadraticDrag(c2=7725.0))
    real = real.with_effect(E.InputSaturatingGain(saturation=0.036))
    r = cid.random_binary(2000, amplitude=1.7e-4, hold=40, around=op.output, seed=5)
    record = cid.simulate(real, r, sensor_noise=1e-5, force_noise=0.01, seed=2)
    names = ("K", "QuadraticDrag.c2", "InputSaturatingGain.saturation")
    model = fit_base_model(real, [record], names)
    smaller, back = refit_without_effect(model, 1)
    assert smaller.fit.value == -np.inf
    assert np.isfinite(back.net_gain)
    assert back.net_gain > 10 * THRESHOLD.gate
    assert back.fitted.saturation == pytest.approx(0.036, rel=1e-2)
    fit = with_linearization(smaller).fit
    assert choose_noise(fit) is fit


def test_values_of_two_effects_of_a_class_stay_with_their_own():
    loop = levitation()
    both = loop.with_effect(E.ViscousFriction(c=1.0)).with_effect(E.ViscousFriction(c=2.0))
    r = cid.random_binary(1500, amplitude=1e-4, hold=40, around=0.012, seed=3)
    record = cid.simulate(both, r, sensor_noise=2e-6, seed=4)
    names = ("K", *(f"{label}.c" for label in both.labelled))
    problem = make_problem(both, names, [record], ())
    fit = begin_fit(problem)
    model = Model(both, fit)
    smaller, back = refit_without_effect(model, 0)
    assert len(smaller.loop.effects) == 1
    assert back.model.fit.value > fit.value - 1.0


@pytest.mark.parametrize("late", [-45, 37, 150])
def test_an_instant_that_is_dozens_of_samples_off_is_found(late):
    loop = drive()
    real = loop.with_effect(E.ParameterStep("k", time=14.2, size=-0.15))
    r = cid.random_binary(3000, amplitude=0.3, hold=60, around=0.0, seed=21)
    record = cid.simulate(real, r, sensor_noise=1e-4, seed=22)
    begun = loop.with_effect(E.ParameterStep("k", time=14.2 + late * 0.01, size=-0.1))
    names = ("c", "k", "ParameterStep.time", "ParameterStep.size")
    problem = make_problem(begun, names, [record], ())
    climbed = maximize(begin_fit(problem))
    fit = place_instants(climbed)
    assert fit.value > climbed.value + 10.0
    assert fit.theta[2] == pytest.approx(14.2, abs=0.01)
    assert fit.theta[3] == pytest.approx(-0.15, abs=0.01)
    assert place_instants(fit) is fit


# --- an input that hardly comes through


@pytest.mark.slow
def test_a_gap_that_swallows_nearly_all_of_the_input_is_found_from_either_side():
    """It is as likely as the input behind it would be if it were known, and so is the width."""
    study = problems.load_script("benchmarks", "study_frozen")
    case = study.cases.draw_case("one", 82013, 1500)
    loop = study.make_loop(case.rig)
    record = cid.Record(r=case.r, u=case.u, y=case.y, dt=case.rig.dt)
    width = case.sizes[0]["backlash"]
    assert width > 0.8 * np.ptp(record.u)
    behind, memory = np.array(case.u), case.rig.at[1]
    for k, u in enumerate(case.u):
        memory = behind[k] = np.clip(memory, u - width / 2, u + width / 2)
    known = fit_base_model(loop, [replace(record, u=behind)], loop.free).fit
    base = fit_base_model(loop, [record], loop.free)
    assert known.value > base.fit.value + 200
    tried = [refit_candidate(base, screen_at(base, e))
             for e in E.InputBacklash.candidates(loop, record)]  # fmt: skip
    best = max(tried, key=lambda t: t.net_gain)
    # What is not known of its beginning costs a few units.
    assert known.value - 12 < best.model.fit.value < known.value + 5
    assert best.fitted.width == pytest.approx(width, rel=0.005)


@pytest.mark.slow
def test_a_model_that_takes_readings_for_exact_is_fitted_from_a_usual_noise_as_well():
    """Without what is missing, a large force that leaves no noise to the sensor is a maximum."""
    study = problems.load_script("benchmarks", "study_frozen")
    case = study.cases.draw_case("one", 82013, 1500)
    loop = study.make_loop(case.rig)
    record = cid.Record(r=case.r, u=case.u, y=case.y, dt=case.rig.dt)
    base = fit_base_model(loop, [record], loop.free).fit
    stuck = maximize(begin_fit(base.problem))
    assert takes_readings_as_exact(stuck)
    assert not takes_readings_as_exact(base)
    assert base.value > stuck.value + 200
    for size in (1e-6, 1e-4, 1e-2, 1.0):
        noise = replace(guess_noise(base.problem), force=tuple(
            size * v for v in guess_noise(base.problem).force))  # fmt: skip
        other = choose_noise(maximize(begin_fit(base.problem, noise=noise)))
        assert other.value < base.value + 2


@pytest.mark.slow
def test_a_zone_that_swallows_everything_may_be_any_wider_and_is_named():
    """Its width has no standard error. The record says as much of limits that meet."""
    few = (E.InputDeadZone, E.InputSaturation, E.ViscousFriction, E.ActuatorLag)
    case, found = problems.diagnose_draw("two", 82045, few)
    assert case.hidden[1] == "InputDeadZone"
    assert found.verdict == "explained"
    assert [set(f.names) for f in found.findings] == [{"InputDeadZone", "InputSaturation"}]


# --- in which order effects act


@pytest.mark.parametrize("order", [(0, 1), (1, 0)], ids=["offset behind", "offset before"])
def test_effects_at_one_place_end_in_the_order_in_which_they_act(order):
    loop, real = levitation(), levitation()
    hidden = E.InputDeadZone(0.04), E.InputOffset(0.3)
    for k in order:
        real = real.with_effect(hidden[k])
    r = cid.random_binary(4000, amplitude=2e-4, hold=60, around=0.012, seed=9900)
    record = cid.simulate(real, r, sensor_noise=2e-6, seed=9901)
    for found in (hidden, hidden[::-1]):
        both = loop.with_effect(found[0]).with_effect(found[1])
        own = ("InputDeadZone.width", "InputOffset.offset")
        model = fit_base_model(both, [record], (*loop.free, *own))
        names = [type(e).__name__ for e in order_effect(model, 1, given=0).fitted.effects]
        assert names == [type(hidden[k]).__name__ for k in order]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)], ids=["zone behind", "zone before"])
def test_a_dead_zone_ends_on_its_side_of_a_backlash(order):
    loop, real = drive(), drive()
    hidden = E.InputDeadZone(0.3), E.InputBacklash(0.2)
    for k in order:
        real = real.with_effect(hidden[k])
    record = problems.record_of(real, swing=0.3, hold=60, n=1200, seed=9970, sensor_noise=1e-4)
    for found in (hidden, hidden[::-1]):
        both = loop.with_effect(found[0]).with_effect(found[1])
        own = ("InputDeadZone.width", "InputBacklash.width")
        model = fit_base_model(both, [record], (*loop.free, *own))
        fitted = order_effect(model, 1, given=0).fitted
        names = [type(e).__name__ for e in fitted.effects]
        assert names == [type(hidden[k]).__name__ for k in order]
        assert fitted.labelled["InputDeadZone"].width == pytest.approx(0.3, abs=0.01)
        assert fitted.labelled["InputBacklash"].width == pytest.approx(0.2, abs=0.01)


def test_a_candidate_is_screened_behind_and_ahead_of_what_was_found():
    loop = drive()
    real = loop.with_effect(E.InputBacklash(0.05)).with_effect(E.InputDeadZone(0.3))
    record = problems.record_of(real, swing=0.3, hold=60, n=1200, seed=9980, sensor_noise=1e-4)
    found = loop.with_effect(E.InputDeadZone(0.32))
    base = fit_base_model(found, [record], (*loop.free, "InputDeadZone.width"))
    narrow = E.InputBacklash(0.03)
    behind, trial = screen_candidate(base, narrow), scan_candidate(base, narrow)
    names = [[type(e).__name__ for e in t.model.loop.effects] for t in (behind, trial)]
    assert names == [["InputDeadZone", "InputBacklash"], ["InputBacklash", "InputDeadZone"]]
    assert trial.score > behind.score + 10
    done = refit_candidate(base, trial)
    assert done.position == 0
    assert done.fitted.width == pytest.approx(0.05, abs=0.005)
    # Where both are asked again, the effect that moves is the one that was added.
    assert order_trial(base, done, given=0).model.loop.effects == done.model.loop.effects


def test_a_gain_counts_though_a_size_is_within_its_error_of_nothing(two_found, monkeypatch):
    f = two_found.found[0]
    flat = Objection("insignificant", "within 2 standard errors of its neutral value")
    monkeypatch.setattr(refitting, "find_objection", lambda trial: flat)
    assert f.trial.gain > 100
    assert refitting.weigh_refit(f.base, f.trial, f.trial.model.fit).out is None
    # What the model without the effect reaches as well from there is no gain of the effect.
    monkeypatch.setattr(refitting, "_measure_own_gain", lambda base, trial: 0.0)
    assert refitting.weigh_refit(f.base, f.trial, f.trial.model.fit).out is flat
    # A part that is not seen makes an effect another one, whatever it gains.
    monkeypatch.undo()
    part = Objection("not the simplest", "within 2 standard errors of its neutral value")
    monkeypatch.setattr(refitting, "find_objection", lambda trial: part)
    assert refitting.weigh_refit(f.base, f.trial, f.trial.model.fit).out is part


@pytest.mark.parametrize("seed", [9950, 9960])
@pytest.mark.slow
def test_a_lag_behind_a_curve_of_the_input_is_not_taken_for_one_of_the_sensor(seed):
    """On a linear plant a lag behind the curve and one of the sensor are the same.

    The record is of plain arithmetic, in which the input is bent first and lags then.
    """
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], u[0] - 40.0 * x[0] - p["c"] * x[1]]),
        lambda t, x, u, p: x[0], inputs=["F"], outputs=["x"], states=["x", "v"],
        params={"c": 2.0}, name="spring",
    )  # fmt: skip
    loop = cid.Loop(plant, dt=0.02, at=cid.OperatingPoint((0.0, 0.0), 0.0, 0.0), free=("c",))
    u = cid.random_binary(1500, amplitude=1.0, hold=15, around=0.5, seed=seed)
    u += cid.random_binary(1500, amplitude=0.5, hold=40, around=0.0, seed=seed + 1)
    y, h, (x, v, lagged) = np.zeros(1500), 0.001, np.zeros(3)
    for k, bent in enumerate(u + 0.8 * u**2):
        y[k] = x
        for _ in range(20):
            lagged += h * (bent - lagged) / 0.15
            v += h * (lagged - 40 * x - 2 * v)
            x += h * v
    y += 0.01 * np.random.default_rng(seed).standard_normal(1500)
    catalogue = (E.ActuatorLag, E.InputNonlinearity, E.SensorLag, E.InputDelay)
    record = cid.Record(u=u, y=y, dt=0.02)
    found = cid.diagnose(loop, record, catalogue=catalogue, progress=False)
    assert found.verdict == "explained"
    sets = sorted(sorted(f.names) for f in found.findings)
    assert sets == [["ActuatorLag", "SensorLag"], ["InputNonlinearity"]]


def test_an_order_that_makes_no_difference_is_kept():
    loop = drive()
    record = record_of(loop, E.CoulombFriction(0.1), 0.3, 1e-5, 9910)
    model = fit_base_model(loop, [record], loop.free)
    for effect in (E.CoulombFriction(0.1), E.QuadraticDrag(0.1)):
        model = refit_candidate(model, screen_at(model, effect)).model
    assert order_effect(model, len(model.loop.effects) - 1, given=0) is model
    one = fit_base_model(loop.with_effect(E.InputOffset(0.1)), [record], loop.free)
    two = refit_candidate(one, screen_at(one, E.InputDeadZone(0.01))).model
    assert order_effect(two, 1, given=1) is two  # whose place the user knows


def test_a_line_that_leaves_nothing_to_be_seen_is_no_stand_in():
    """A test of whiteness counts it once for each lag, and says more than it gains."""
    loop = drive()
    real = loop.with_effect(E.SensorHum(amplitude=8e-5, frequency=11.0, phase=0.4))
    record = problems.record_of(real, swing=0.3, hold=60, n=2000, seed=9430, sensor_noise=1e-4)
    model = with_linearization(fit_base_model(loop, [record], loop.free))
    start = E.SensorHum(amplitude=7e-5, frequency=11.0, phase=0.3)
    hum = refit_candidate(model, screen_candidate(model, start))
    assert hum.gain < THRESHOLD.small_gain * run_noise_tests(model.fit).evidence
    assert not _is_stand_in(hum, model, beside=True)


def test_models_are_compared_on_the_samples_that_all_of_them_reach():
    record = cid.Record(u=np.zeros(100), y=np.zeros(100), dt=0.1)
    window = Window(record, 0.0, np.arange(100) >= 10)
    whole, half, nothing = np.ones(100), np.full(100, 2.0), np.full(100, np.nan)
    whole[50:] = 5.0
    half[50:] = np.nan
    shared = share_samples([window], [[whole], [half], [nothing]])
    assert np.flatnonzero(shared[0].mask).tolist() == list(range(10, 50))
    sizes = [root_mean_square(shared, [y]) for y in (whole, half, nothing)]
    assert sizes == [1.0, 2.0, np.inf]


@pytest.mark.parametrize("free", [(), pytest.param(("k",), marks=pytest.mark.slow)])
def test_the_gap_before_is_the_smaller_of_given_and_recalibrated(free):
    """A gain that is twice as large on the fitted part alone spoils the recalibration."""
    dt, n, k = 0.02, 2000, 3.0
    rng = np.random.default_rng(3)
    u = np.repeat(rng.choice([-1.0, 1.0], n // 40), 40)
    y, x, v = np.zeros(n), 0.0, 0.0
    for i in range(n):
        y[i] = x + 1e-4 * rng.standard_normal()
        gain = 2 * k if i < 3 * n // 4 else k
        for _ in range(10):
            v += dt / 10 * (gain * u[i] - 2.0 * v)
            x += dt / 10 * v
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=k), dt=dt, free=free,
                    at=cid.OperatingPoint(states=(0.0, 0.0), input=0.0, output=0.0))  # fmt: skip
    found = cid.diagnose(loop, cid.Record(u=u, y=y, dt=dt), catalogue=(), progress=False)
    gap = found.gap
    assert gap.before == min(gap.given, gap.recalibrated)
    assert (gap.recalibrated > 2 * gap.given) == bool(free)
    error = gap.measured - gap.simulated_before
    assert np.sqrt(np.nanmean(error**2)) == pytest.approx(gap.before)


@pytest.mark.parametrize("failure", [np.linalg.LinAlgError("SVD did not converge"),
                                     SystemError("error without exception set")])  # fmt: skip
def test_a_candidate_whose_arithmetic_fails_fails_alone(two_found, monkeypatch, failure):
    def fail(*_, **__):
        raise failure

    base = two_found.found[0].base
    with monkeypatch.context() as patch:
        patch.setattr(scans, "screen_candidate", fail)
        out = scan_candidate(base, E.ViscousFriction(c=0.1)).out
        assert out.ground == "cannot run"
        assert str(failure) in out.words
    trial = screen_candidate(with_linearization(base), two_found.found[0].trial.effect)
    monkeypatch.setattr(refitting, "maximize", fail)
    assert refit_candidate(base, trial).out.ground == "cannot run"


def test_a_climb_from_noise_that_loses_the_record_is_an_answer():
    """A fit without its linearization has nothing else to go on where the new noise loses it."""
    loop = drive(("k",))
    record = record_of(loop, E.InputDeadZone(0.5), 1.0, 1e-3, 9500, 600)
    fit = fit_base_model(loop, [record], loop.free).fit
    lost = replace(drop_linearization(fit), noise=replace(fit.noise, force=(float("nan"),)))
    assert not maximize(lost, rounds=3, exact=False).value > -float("inf")


@pytest.mark.slow
def test_a_gap_is_that_of_the_friction_which_was_found():
    """Linearized along its last trajectory, a filter with a stick and hardly any force was lost."""
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([
            x[1], (p["mgl"] * np.sin(x[0]) + p["kt"] * u[0] - p["b"] * x[1]) / p["J"]]),
        lambda t, x, u, p: x[0], inputs=["V"], outputs=["theta"], states=["theta", "w"],
        params={"J": 0.012, "mgl": 0.9, "kt": 0.25, "b": 0.02}, name="arm",
    )  # fmt: skip
    law = ct.sample_system(ct.tf([0.8, 12.0], [0.01, 1]), 0.01, "tustin")
    at = cid.operating_point(plant, output=0.0)
    loop = cid.Loop(plant, law, dt=0.01, at=at, free=("mgl", "kt"))
    real = loop.with_effect(E.CoulombFriction(4.17))
    r = cid.random_binary(2000, amplitude=0.05, hold=25, seed=0)
    record = cid.simulate(real, r, sensor_noise=2e-4, seed=2)
    problem = make_problem(real, ("mgl", "kt", "CoulombFriction.fc"), [record[:1500]])
    begun = begin_fit(problem, np.array([0.9, 0.25, 4.17]), Noise((0.24,)))
    assert begun.value > 10000
    assert abs(relinearize_fit(begun).value - begun.value) < 1.0
    found = cid.diagnose(loop, record, catalogue=[E.CoulombFriction], progress=False)
    assert [f.name for f in found.findings] == ["CoulombFriction"]
    assert found.verdict == "explained"
    assert found.gap.after < 1.2 * found.gap.floor
    assert found.gap.before > 20 * found.gap.floor


def test_a_look_alike_that_predicts_the_same_is_a_rival_whatever_more_it_costs():
    """Two limits cost a parameter more than a gain that saturates, and so more on a longer record.

    An input of two values shows both alike: neither can be excluded.
    """
    loop = drive()
    record = record_of(loop, E.InputSaturatingGain(0.4), 0.3, 1e-4, 9350, n=6000)
    base = fit_base_model(loop, [record], loop.free)
    low, high = np.quantile(record.u, (0.02, 0.98))
    gain, limits = (refit_candidate(base, screen_candidate(base, e)) for e in (
        E.InputSaturatingGain(0.0), E.InputSaturation(float(low), float(high))))  # fmt: skip
    # The same predictions, at the price of one parameter more than chance would forgive.
    twin = replace(limits, model=gain.model, label=gain.label, gain=gain.gain,
                   penalty=gain.penalty + THRESHOLD.close + 1.0)  # fmt: skip
    assert twin.resembles(gain)
    assert [t.name for t in find_rivals(gain, [twin])] == ["InputSaturation"]
    fit = gain.model.fit
    on_end = replace(fit, theta=np.where([n.startswith(f"{gain.label}.") for n in gain.model.names],
                                         fit.problem.lower, fit.theta))  # fmt: skip
    ended = replace(twin, model=replace(gain.model, fit=on_end))
    assert find_rivals(gain, [ended]) == ()


def test_a_replica_of_dry_friction_is_as_abrupt_as_nature():
    """What mends the filter's smoothing gains on a replica as well, so that it is no evidence.

    A Stribeck curve as narrow as the smoothing sharpens friction: of records from an exact
    simulation it gains, and has to gain as much on what stands for them.
    """
    loop = pendulum()
    record = record_of(loop, E.CoulombFriction(1.2), 0.05, 2e-5, 9360)
    base = fit_base_model(loop, [record], loop.free)
    model = refit_candidate(base, screen_at(base, E.CoulombFriction(1.0))).model
    sharp = sharpen_effects(model.fitted, 16.0)
    assert sharpen_effects(loop, 16.0) is loop
    slow = 0.02 * loop.dt * 1.2  # a speed that the filter takes for nearly at rest
    rates = [
        float(e.smoothed(0, [0.0, slow], 0, list(e.parameters.values()), [0, 0])[0][1])
        for e in (model.fitted.equations(), sharp.equations())
    ]  # fmt: skip
    assert rates[1] < 2 * rates[0] < 0
    gained = []
    for times in (1.0, THRESHOLD.replica_sharpness):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                replicas, "sharpen_effects", lambda one, _, t=times: sharpen_effects(one, t)
            )
            copy = make_replica(model)
        width = np.sqrt(2 / np.pi) * 0.25 * loop.dt * 1.2
        finer = refit_candidate(copy, screen_at(copy, E.StribeckFriction(fs=0.2, vs=width)))
        gained.append(finer.gain)
    assert gained[1] > gained[0]
