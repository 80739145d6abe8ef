"""The gap on fresh data: what chance makes of it, and which samples decide and which are shown."""

from dataclasses import replace
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest
from scipy import signal

import ctrlid as cid
from ctrlid import effects as E
from ctrlid._base.errors import ModelCannotRun
from ctrlid.diagnosis import gap_summary
from ctrlid.diagnosis.findings import Disturbance, Gap
from ctrlid.diagnosis.fresh_data import FreshData, choose_fresh_data
from ctrlid.diagnosis.gap import (
    Window,
    _average_runs,
    compute_excess_chance,
    compute_floor,
    compute_widening_chance,
    halve_windows,
    measure_constant_error,
    measure_spreads,
    measure_trivial_error,
    root_mean_square,
    simulate_window,
)
from ctrlid.diagnosis.gap_summary import replace_simulation, summarize_gap
from ctrlid.diagnosis.growth import Search
from ctrlid.diagnosis.noise_tests import run_noise_tests
from ctrlid.diagnosis.recalibration import fit_base_model
from ctrlid.diagnosis.thresholds import THRESHOLD
from ctrlid.diagnosis.wording import describe_trivial, list_gap_rows
from ctrlid.estimation.likelihood.prediction import predict_from, predict_spread
from ctrlid.validation.reproduction import CLOSED_LOOP, Reproduction
from problems import diagnose_draw, drive, record_of
from test_wiring import CART, DT, at_rest, luenberger

NOTHING = Disturbance(0.0, 0.0, np.nan, 0.0)


def window(y, mask=None):
    record = cid.Record(u=np.zeros(len(y)), y=y, dt=0.01)
    return Window(record, 0.0, np.ones(len(y), bool) if mask is None else mask)


def slow(rng, n, memory):
    return signal.lfilter([1.0], [1.0, -memory], rng.standard_normal(n + 500))[500:]


def spring():
    """Return a mass on a spring under a PD."""
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], u[0] - 4.0 * x[0] - 2.0 * x[1]]),
        lambda t, x, u, p: x[0], inputs=["F"], outputs=["x"], states=["x", "v"],
    )  # fmt: skip
    at = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
    return cid.Loop(plant, cid.PID(kp=10.0, kd=2.0, filter_time=0.05), dt=DT, at=at)


def cart():
    """Return a cart with a pole under an observer."""
    return cid.Loop(CART, luenberger(CART), dt=DT, at=at_rest(CART))


@pytest.mark.parametrize(("loop", "place"), [(spring(), ""), (cart(), "x")])
def test_what_depends_on_time_acts_from_the_start_of_the_experiment(loop, place):
    """A late window starts where the sensor has drifted to, and a line has its phase."""
    drift = cid.effects.SensorDrift(rate=0.005, at=place)
    line = cid.effects.SensorHum(amplitude=0.002, frequency=1.3, phase=0.4, at=place)
    real = loop.with_effect(drift).with_effect(line)
    r = None if place else cid.random_binary(800, amplitude=0.1, hold=40, seed=4)
    record = cid.simulate(real, r, d=0.01 * np.sin(np.arange(800) / 30))
    late = record[600:]
    windows = [Window(late, 600 * DT, np.ones(np.shape(late.y), bool), measure_spreads(late))]
    y = simulate_window(real, windows[0], CLOSED_LOOP)
    assert root_mean_square(windows, [y]) < 1e-6
    # Where the controller is not known, predictions go by the same time, and so does their floor.
    ahead = Reproduction("prediction", 7)
    assert root_mean_square(windows, [simulate_window(real, windows[0], ahead)]) < 1e-6
    fit = predict_from(real, late, 600 * DT)
    both, _ = predict_spread(real, late, fit, 7, 600 * DT)
    assert np.max(both) < 1e-6


@pytest.mark.parametrize("memory", [0.0, 0.9, 0.98])
def test_a_difference_by_chance_is_rarely_beyond_chance(memory):
    rng = np.random.default_rng(11)
    y = np.zeros(800)
    hits = 0
    for _ in range(400):
        common, one, other = (slow(rng, 800, memory) for _ in range(3))
        chance = compute_widening_chance([window(y)], [common + one / 2], [common + other / 2])
        hits += chance < 0.01
    assert hits <= 11  # 4 are expected; more than 11 has a probability of 1e-3


@pytest.mark.parametrize("memory", [0.0, 0.9, 0.98])
def test_errors_of_the_size_of_noise_are_rarely_called_larger(memory):
    """Predictions that overlap are alike, so that few of them say little of their size."""
    rng = np.random.default_rng(13)
    y, floor = np.zeros(400), 1 / np.sqrt(1 - memory**2)
    hits = larger = 0
    for _ in range(400):
        e = slow(rng, 400, memory)
        hits += compute_excess_chance([window(y)], [e], [floor]) < 0.01
        larger += compute_excess_chance([window(y)], [2.5 * e], [floor]) < 0.01
    assert hits <= 11  # at most 4 are expected; more than 11 of 4 have a probability of 1e-3
    assert larger > (250 if memory == 0.98 else 390)


def test_errors_of_several_outputs_count_in_units_of_their_floors():
    rng = np.random.default_rng(14)
    record = cid.Record(u=np.zeros(300), y=np.zeros((2, 300)), dt=0.01)
    both = Window(record, 0.0, np.ones((2, 300), bool), (1.0, 1.0))
    e = np.array([[1.0], [50.0]]) * rng.standard_normal((2, 300))
    assert compute_excess_chance([both], [e], (1.0, 50.0)) > 0.01
    assert compute_excess_chance([both], [e], (1.0, 35.0)) < 1e-6
    assert np.isnan(compute_excess_chance([both], [e], (1.0, np.nan)))


def test_a_wider_gap_is_seen_although_what_both_models_miss_is_large():
    rng = np.random.default_rng(12)
    y = slow(rng, 1000, 0.9)
    both = y + 2 * slow(rng, 1000, 0.5)
    wider = both + slow(rng, 1000, 0.5)
    assert compute_widening_chance([window(y)], [both], [wider]) < 1e-3
    assert compute_widening_chance([window(y)], [wider], [both]) > 0.99
    assert compute_widening_chance([window(y)], [both], [both]) == 1.0


def test_a_model_that_makes_nothing_of_a_window_is_wider_and_two_blocks_are_needed():
    y = np.sin(np.arange(300.0))
    nothing = np.full(300, np.nan)
    assert compute_widening_chance([window(y)], [0 * y], [nothing]) == 0.0
    assert compute_widening_chance([window(y)], [nothing], [0 * y]) == 1.0
    few = window(y, np.arange(300) < 3)
    assert compute_widening_chance([few], [y], [y + np.arange(300)]) == 1.0


def test_the_halves_have_every_compared_sample_once():
    mask = np.random.default_rng(13).random(501) < 0.7
    one = window(np.arange(501.0), mask)
    first, second = (half[0] for half in halve_windows([one]))
    np.testing.assert_array_equal(first.mask | second.mask, mask)
    assert not np.any(first.mask & second.mask)
    assert np.flatnonzero(first.mask)[-1] < np.flatnonzero(second.mask)[0]
    assert abs(int(first.mask.sum()) - int(second.mask.sum())) <= 1


def take_back(monkeypatch, after):
    """Take back the only effect of a search where the model errs so much with it."""
    n = len(after)
    y = np.zeros(n)
    fresh = SimpleNamespace(windows=(window(y),))
    fresh.halve = lambda: tuple(SimpleNamespace(windows=w) for w in halve_windows(fresh.windows))
    noise = np.random.default_rng(14).standard_normal(n)
    found = SimpleNamespace(found=("one",))
    shown = []

    def reproduce(loop, search, fresh):
        with_it = noise + after if search.found else noise
        return gap_summary._Reproductions((), [(2 * noise,), (noise,), (with_it,)])

    def exchange(search, refused, deciding):
        shown.append(deciding.windows[0].mask)
        return SimpleNamespace(found=()), "one"

    def summarize(loop, search, fresh):
        shown.append(fresh.windows[0].mask)
        return "summary of a half"

    monkeypatch.setattr(gap_summary, "_reproduce", reproduce)
    monkeypatch.setattr(gap_summary, "exchange_worst_effect", exchange)
    monkeypatch.setattr(gap_summary, "summarize_gap", summarize)
    size = float(np.sqrt(np.mean((noise + after) ** 2)))
    gap = Gap("simulation", 2.0, 1.0, size, 0.1, "m", *[np.zeros(3)] * 4)
    whole = gap_summary.GapSummary(gap, {}, NOTHING)
    left, summary = gap_summary.take_back_widening(None, found, whole, fresh)
    return left.found, summary, whole, shown


def test_samples_that_decide_a_take_back_are_not_those_on_which_the_gap_is_shown(monkeypatch):
    after = 2.0 * np.random.default_rng(15).standard_normal(1000)
    after[500:] /= 2
    left, summary, _, (decided, shown) = take_back(monkeypatch, after)
    assert left == ()
    assert summary == "summary of a half"
    assert not np.any(decided & shown)
    assert decided[0]  # the half in which the gap is wider by more


def test_a_gap_that_is_wider_within_chance_takes_nothing_back(monkeypatch):
    after = 0.05 * np.random.default_rng(16).standard_normal(1000)
    left, summary, whole, shown = take_back(monkeypatch, after)
    assert left == ("one",)
    assert summary is whole
    assert shown == []


# --- the trivial predictor


def test_trivial_predictors_are_exact_on_what_they_assume():
    line = 3.0 + 0.5 * np.arange(200.0)
    later = np.arange(200) > 50
    assert measure_trivial_error([window(line, later)], 7) < 1e-10
    assert measure_trivial_error([window(np.full(200, 2.0))], 1) < 1e-12
    noisy = line + np.random.default_rng(17).standard_normal(200)
    longer = measure_trivial_error([window(noisy, later)], 16)
    # A line of least squares through 16 samples, 16 ahead, by its textbook variance.
    assert longer < 1.3 * np.sqrt(1 + 1 / 16 + 23.5**2 / (16 * (16**2 - 1) / 12))


def test_samples_that_do_not_count_tell_a_trivial_predictor_nothing():
    line = np.arange(100.0)
    valid = np.ones(100, bool)
    valid[40:43] = False
    spoiled = np.where(valid, line, 1e6)
    record = cid.Record(u=np.zeros(100), y=spoiled, dt=0.01, valid=valid)
    mask = valid & (np.arange(100) > 60)
    assert measure_trivial_error([Window(record, 0.0, mask)], 3) < 1e-10


def test_a_horizon_at_which_a_straight_line_wins_is_lengthened(monkeypatch):
    n = 2000
    t = np.arange(n) * 0.01
    y = np.sin(2 * t)
    made = []

    def simulate_outputs(self, loops):
        made.append(self.how.horizon)
        return (y + 0.05,)  # a model with a constant error, whatever the horizon

    monkeypatch.setattr(FreshData, "simulate_outputs", simulate_outputs)
    fresh = FreshData((window(y),), None, Reproduction("prediction", 5))
    model = SimpleNamespace(fitted=None)
    search = SimpleNamespace(base=model, final=model)
    longer = gap_summary.lengthen_horizon(None, search, fresh)
    assert longer.how == Reproduction("prediction", 20)
    # No horizon helps a model that errs more than the output moves: it stays, and is said.
    monkeypatch.setattr(FreshData, "simulate_outputs", lambda self, loops: (y + 9,))
    assert gap_summary.lengthen_horizon(None, search, fresh) is fresh
    gap = Gap("prediction", 9.0, 9.0, 9.0, 0.1, "m", *[np.zeros(3)] * 4, horizon=5, trivial=0.1)
    assert gap.trivial_wins
    assert "SAYS NOTHING ABOUT THE MODEL" in " ".join(describe_trivial(gap).split())
    assert ("last value or line", "0.100 m") in [row[:2] for row in list_gap_rows(gap)]
    assert not replace(gap, after=0.05).trivial_wins
    simulated = FreshData((window(y),), None, Reproduction("closed-loop simulation"))
    assert gap_summary.lengthen_horizon(None, search, simulated) is simulated


def test_a_horizon_beyond_which_the_bare_models_lose_the_record_is_not_taken(monkeypatch):
    y = np.sin(0.002 * np.arange(2000))

    def simulate_outputs(self, loop):
        # An unstable model errs by e-fold more for every sample that it looks ahead.
        return (y + (0.005 if loop[0] == "complete" else 1e-4 * np.exp(self.how.horizon)),)

    monkeypatch.setattr(FreshData, "simulate_outputs", simulate_outputs)
    fresh = FreshData((window(y),), None, Reproduction("prediction", 5))
    search = SimpleNamespace(base=SimpleNamespace(fitted="bare"),
                             final=SimpleNamespace(fitted="complete"))  # fmt: skip
    wins_at_80 = measure_trivial_error(fresh.windows, 80)
    assert measure_trivial_error(fresh.windows, 20) < 0.005 < wins_at_80
    assert gap_summary.lengthen_horizon("bare", search, fresh) is fresh


def test_a_constant_errs_by_what_the_output_moves():
    y = np.stack([np.sin(np.arange(400.0)), 3 + np.cos(np.arange(400.0))])
    mask = np.ones((2, 400), bool)
    mask[1, 100:] = False
    record = cid.Record(u=np.zeros(400), y=y, dt=0.01)
    expected = np.sqrt((np.sum((y[0] - y[0].mean()) ** 2)
                        + np.sum((y[1, :100] - y[1, :100].mean()) ** 2)) / 500)  # fmt: skip
    assert measure_constant_error([Window(record, 0.0, mask)]) == pytest.approx(expected)


def test_a_gap_is_named_by_its_kind_and_horizon():
    arrays = [np.zeros(3)] * 4
    one = Gap("prediction", 1.0, 1.0, 1.0, 0.1, "m", *arrays, horizon=25)
    assert (one.kind, one.name) == ("prediction", "25-step prediction")
    assert replace(one, horizon=1).name == "one-step prediction"
    assert Gap("simulation", 1.0, 1.0, 1.0, 0.1, "m", *arrays).name == "open-loop simulation"


def test_the_time_of_a_force_runs_on_through_a_gap_of_the_log():
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    point = cid.OperatingPoint(states=(0.0, 0.0), input=0.0, output=0.0)
    loop = cid.Loop(plant, cid.PID(kp=20.0, kd=1.0), dt=0.01, at=point)
    loop = loop.with_effect(cid.effects.PeriodicForce(amplitude=2.0, frequency=0.7, phase=0.3))
    r = cid.random_binary(1500, amplitude=0.1, hold=60, seed=3)
    record = cid.simulate(loop, r, sensor_noise=1e-4, seed=4)
    valid = np.ones(1500, bool)
    valid[500:640] = False  # the second stretch begins 4.48 periods after the first
    gapped = replace(record, valid=valid)
    assert cid.compare(gapped, loop)["closed-loop simulation"].fit > 99


@pytest.mark.slow
def test_a_right_name_whose_simulation_diverges_stays():
    """A cubic force pushes a pendulum over: noise alone takes its simulation out of the record."""
    few = [cid.effects.CubicStiffness, cid.effects.CoulombFriction]
    case, found = diagnose_draw("one", 80060, few)
    assert case.hidden == ("CubicStiffness",)
    assert [one.name for one in found.findings] == ["CubicStiffness"]
    k3, error = found.findings[0].effect.k3, found.findings[0].standard_errors["k3"]
    assert abs(k3 - case.sizes[0]["cubic"]) < 3 * error
    assert found.gap.kind == "prediction"
    assert found.gap.after < 0.3 * found.gap.before
    assert "diverges on the samples kept back" in found.notes[-1]


@pytest.mark.slow
def test_a_simulation_that_the_last_digits_decide_takes_no_name_back():
    """Cogging strong enough to hold a mass anywhere: which of many places it stops at is chance."""
    few = [E.PositionRipple, E.CoulombFriction]
    case, found = diagnose_draw("one", 93057, few)
    assert case.hidden == ("PositionRipple",)
    assert [one.name for one in found.findings] == ["PositionRipple"]
    amplitude, error = (
        found.findings[0].effect.amplitude, found.findings[0].standard_errors["amplitude"]
    )  # fmt: skip
    assert abs(amplitude - case.sizes[0]["ripple"]) < 3 * error
    assert found.gap.kind == "prediction"
    assert found.gap.after < 0.2 * found.gap.before
    assert "last digits" in found.notes[-1]


def test_a_simulation_that_noise_drives_further_than_the_record_moves_tells_nothing():
    """It need not end: a ball that is lost in a magnet's equations goes on falling."""
    loop = drive()
    r = cid.random_binary(1200, amplitude=0.3, hold=60, seed=60)
    record = cid.simulate(loop, r, sensor_noise=1e-3, seed=61)
    base = fit_base_model(loop, [record], loop.free)
    tests = run_noise_tests(base.fit)
    search = Search(base, (), base, (), tests, tests)
    fresh = choose_fresh_data(loop, [record], None)
    summary = summarize_gap(loop, search, fresh)
    kept, same, notes = replace_simulation(loop, search, summary, fresh)
    assert (kept, same, notes) == (fresh, summary, ())
    moves = measure_constant_error(fresh.windows)
    lost = replace(summary, gap=replace(summary.gap, after=1.9 * moves, floor=2 * moves))
    other, left, notes = replace_simulation(loop, search, lost, fresh)
    assert "diverges" in notes[0]
    assert other.how.horizon
    assert left.gap.kind == "prediction"
    assert left.gap.after < 0.1 * moves


def fresh_under_noise(real, record, names):
    """Fresh data of a record, without noise and with that of the true model, and its loops."""
    model = fit_base_model(real, [record], names)
    fresh = choose_fresh_data(real, [record], None)
    return model, fresh, fresh.with_noise(model), fresh.prepare_loops(model)


def test_noise_shakes_a_play_loose():
    """Without noise a loop with a play hunts in the simulation, and in the record it does not."""
    real = drive().with_effect(E.InputBacklash(0.4))
    record = record_of(real, swing=0.3, hold=60, n=3000, seed=40, sensor_noise=1e-2)
    model, still, shaken, loops = fresh_under_noise(real, record, ("InputBacklash.width",))
    floors = [compute_floor(loops, model.fit, f.windows, f.how).both for f in (still, shaken)]
    gaps = [f.measure_gap(loops) for f in (still, shaken)]
    assert gaps[1] < 0.9 * gaps[0]
    assert floors[1] < 0.9 * floors[0]
    assert 0.8 < gaps[1] / floors[1] < 1.25
    windows = still.windows
    hunts = [f.simulate_outputs(loops) for f in (still, shaken)]
    assert compute_widening_chance(windows, *reversed(hunts)) < 1e-3


def test_of_a_linear_loop_the_mean_is_the_run_without_noise():
    loop = drive()
    record = record_of(loop, swing=0.3, hold=60, n=1200, seed=42, sensor_noise=1e-3)
    model, still, shaken, loops = fresh_under_noise(loop, record, ("k",))
    assert [len(w.noises) for w in (*still.windows, *shaken.windows)] == [0, THRESHOLD.mean_runs]
    one, other = (f.simulate_outputs(loops)[0] for f in (still, shaken))
    np.testing.assert_allclose(other, one, atol=1e-12)
    # What is predicted, or simulated from the measured input, begins with what was measured.
    ahead = replace(still, how=Reproduction("prediction", 5))
    assert ahead.with_noise(model) is ahead


def test_a_run_that_leaves_its_range_is_left_out():
    class Runs:
        def run(self, simulator, noise=None):
            if noise is not None and noise[0][0] > 2:
                raise ModelCannotRun("far away")
            return np.zeros(3) if noise is None else 1 + noise[0] ** 2, None

    calm, wild = [np.ones(3)], [np.full(3, 3.0)]
    np.testing.assert_array_equal(_average_runs(Runs(), None, (calm, wild), slice(0, 3)), 2.0)
    np.testing.assert_array_equal(_average_runs(Runs(), None, (wild,), slice(0, 3)), 0.0)
