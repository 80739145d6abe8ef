"""Records of which a part does not count, long ones, and several that are not alike."""

import math
from dataclasses import replace
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import effects as E
from ctrlid.diagnosis import fresh_data, gap
from ctrlid.diagnosis.candidates import list_candidates
from ctrlid.diagnosis.findings import Gap
from ctrlid.diagnosis.fresh_data import choose_fresh_data
from ctrlid.diagnosis.gap import Window, measure_trivial_error
from ctrlid.diagnosis.open_loop_fit import Simulation
from ctrlid.diagnosis.open_loop_search import SimulationSight
from ctrlid.diagnosis.recalibration import cut_stretches, fit_base_model, recalibrate
from ctrlid.diagnosis.screening import screen_at
from ctrlid.diagnosis.several_records import _merge_gaps
from ctrlid.diagnosis.thresholds import vary_numbers
from ctrlid.estimation.likelihood.likelihood import make_problem
from ctrlid.validation.controller_check import take_bias_from_log

PID = cid.PID(kp=8.0, kd=1.0)


def servo(*effects, controller=PID, free=("k", "c"), dt=0.02):
    """A mass of 1 kg with a damping of 2 N s/m and a gain of 3 N/V."""
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), controller, dt=dt, free=free)
    for effect in effects:
        loop = loop.with_effect(effect)
    return loop


def record_of(loop, n=2000, amplitude=0.25, around=0.2, seed=1, noise=2e-3):
    r = cid.random_binary(n, amplitude=amplitude, hold=60, seed=seed, around=around)
    return cid.simulate(loop, r, sensor_noise=noise, seed=seed + 1)


# --- readings on a limit of the sensor

RANGE = E.SensorSaturation(lower=-1.0, upper=0.45)
FEW = (E.SensorSaturation, E.ViscousFriction, E.InputDelay)


@pytest.fixture(scope="module")
def clipped():
    """Two fifths of these readings are on the upper limit."""
    record = record_of(servo(RANGE), 3000)
    assert 0.3 < np.mean(record.y >= 0.45) < 0.5
    return record


@pytest.mark.parametrize("controller", [PID, None])
def test_a_model_that_is_refitted_for_the_gap_does_not_believe_clipped_readings(
    clipped, controller
):
    found = cid.diagnose(servo(controller=controller), clipped, catalogue=FEW, progress=False)
    assert [f.name for f in found.findings] == ["SensorSaturation"]
    assert found.verdict == "explained"
    # With them the refitted model errs by 41 mm in the simulation, 25 times the floor.
    assert found.gap.after < 1.4 * found.gap.floor


def test_a_limit_that_the_model_has_is_not_missing(clipped):
    found = cid.diagnose(servo(RANGE), clipped, catalogue=FEW, progress=False)
    assert (found.verdict, found.findings) == ("nothing missing", ())
    assert list(found.loop.labelled) == ["SensorSaturation"]
    assert found.calibrated[0].after == pytest.approx(
        3.0, abs=4 * found.calibrated[0].standard_error
    )


def test_readings_that_stop_inside_of_the_known_limit_are_a_finding(clipped):
    wider = replace(RANGE, upper=0.6)
    found = cid.diagnose(servo(wider), clipped, catalogue=FEW, progress=False)
    assert [f.effect.upper for f in found.findings] == [pytest.approx(0.45)]


# --- long records, of which stretches are fitted


def test_an_instant_in_a_late_stretch_can_be_found():
    """Of stretches the longest set the range of instants, though their time goes on."""
    step = E.ParameterStep("k", time=100.0, size=0.03)
    record = record_of(servo(step), 8000)
    with vary_numbers(fitted_samples=2000):
        base = recalibrate(servo(), [record], [cid.audit(record)])
        parts, _ = cut_stretches([record])
        assert max(map(len, parts)) * 0.02 < 50.0
        trial = screen_at(base, step)
    assert trial.fitted.time == 100.0
    assert trial.score > 100.0
    late = screen_at(base, replace(step, time=1e4)).model.fit.problem
    assert late.upper[-2] == pytest.approx(160.0, abs=1.0)


def test_a_scan_of_instants_pays_for_all_of_them():
    record = record_of(servo(), 3000)
    with vary_numbers(fitted_samples=600):
        base = recalibrate(servo(), [record], [cid.audit(record)])
        times = [data.t for data in base.fit.data]
        sight = SimpleNamespace(
            times=times, dt=0.02, with_free=lambda name: sight, parameter=lambda name: 3.0,
            score_shapes=lambda shapes, name: (
                np.ones(shapes[0].shape[1]), np.full((shapes[0].shape[1], 1), 0.1)
            ),
        )  # fmt: skip
        assert E.ParameterStep("k", 1.0, 0.0).scan(sight).places == 3000


# --- samples that do not count


def test_what_a_masked_sample_holds_sets_no_range():
    record = record_of(servo(), 800)
    u, y = record.u.copy(), record.y.copy()
    u[400], y[400] = -999.0, 1e6
    valid = np.arange(800) != 400
    kinds = (E.InputDeadZone, E.InputBacklash, E.InputSaturation, E.StribeckFriction)
    known, spoiled = (
        list_candidates(kinds, servo(), replace(record, u=us, y=ys, valid=valid))
        for us, ys in ((record.u, record.y), (u, y))
    )
    assert len(known) >= 5
    for one, other in zip(known, spoiled, strict=True):
        assert other.values() == pytest.approx(one.values(), rel=0.2)


def test_a_masked_sample_leaves_the_others_and_the_record_alone():
    seen = []

    class Looking(E.InputDelay):
        @classmethod
        def candidates(cls, loop, record=None):
            seen.append(record)
            return ()

    record = record_of(servo(), 100)
    list_candidates((Looking,), servo(), record)
    assert seen[0] is record
    masked = replace(record, valid=np.arange(100) > 9)
    list_candidates((Looking,), servo(), masked)
    np.testing.assert_array_equal(seen[1].u[:10], record.u[10])
    np.testing.assert_array_equal(seen[1].y[10:], record.y[10:])


def test_the_last_valid_value_is_what_a_trivial_predictor_has():
    """Of an output that is far from zero, an invalid sample is no zero."""
    rng = np.random.default_rng(5)
    y = 0.012 + np.cumsum(1e-6 * rng.standard_normal(4000))
    every = np.ones(4000, bool)
    some = rng.uniform(size=4000) > 0.02
    whole, holed = (
        measure_trivial_error(
            [Window(cid.Record(u=np.zeros(4000), y=np.where(v, y, -7.0), dt=0.01, valid=v),
                    0.0, v & (np.arange(4000) > 100))], 5
        )
        for v in (every, some)
    )  # fmt: skip
    assert holed == pytest.approx(whole, rel=0.1)


def test_a_line_keeps_its_frequency_where_samples_do_not_count():
    """Every fifth sample is left out; pushed together, 2 Hz would be 2.5 Hz."""
    n, dt = 1000, 0.02
    plant = ct.tf([1.0], [0.3, 1.0])
    loop = cid.Loop(plant, None, dt=dt)
    u = cid.random_binary(n, amplitude=1.0, hold=25, seed=3)
    record = cid.simulate(loop, d=u, sensor_noise=1e-3, seed=4)
    y = record.y + 0.2 * np.sin(2 * np.pi * 2.0 * record.t)
    part = replace(record, y=y, valid=np.arange(n) % 5 > 0)
    task = Simulation(loop, (), [part], [0.0])
    start = task.make_initial_states([{}])
    errors, slopes, states = task.run(np.zeros(0), start)
    simulated = SimpleNamespace(task=task, errors=errors, slopes=slopes, states=states)
    assert SimulationSight(simulated).strongest_line() == pytest.approx(2.0, abs=0.05)


# --- several records that are not alike


def test_a_record_without_its_reference_lets_no_analog_controller_be_followed():
    """Of two records the second does not tell r: read as y, its controller saw no error."""
    law = ct.tf([20.0, 40.0], [0.05, 1.0])
    loop = servo(controller=law, free=("k", "c"))
    one, other = (record_of(loop, 800, seed=s, noise=1e-4) for s in (1, 3))
    mute = replace(other, r=None)
    alone = make_problem(loop, loop.free, [mute]).plant.plan.size
    assert make_problem(loop, loop.free, [one, other]).plant.plan.size > alone
    assert make_problem(loop, loop.free, [one, mute]).plant.plan.size == alone
    assert make_problem(loop, loop.free, [mute, one]).plant.plan.size == alone


def test_references_that_run_differently_between_samples_are_refused():
    loop = servo(controller=ct.tf([20.0], [1.0]))
    one = record_of(loop, 300)
    with pytest.raises(cid.CtrlidError, match="hold_r='foh' and hold_r='zoh'"):
        cid.fit_loop(loop, [replace(one, r=None), one, replace(one, hold_r="foh")])


@pytest.mark.parametrize("first", [0, 1])
def test_one_record_that_can_only_be_predicted_makes_predictions_of_all(first):
    records = [record_of(servo(), 500, seed=s) for s in (1, 3)]
    records[first] = replace(records[first], r=None)
    how = choose_fresh_data(servo(), records, None).how
    assert (how.name, how.horizon > 0) == ("prediction", True)
    assert "lacks a reference" in how.reason


def make_gap(size, samples, outputs=(), trivial=math.nan):
    none = np.zeros(0)
    return Gap(
        "prediction", size, size, size, size, "m", none, none, none, none, widest=size, horizon=3,
        recalibrated=size, trivial=trivial, samples=samples, outputs=outputs,
    )  # fmt: skip


def test_the_gap_of_records_answered_one_by_one_is_that_of_all_in_each_of_its_rows():
    parts = [make_gap(s, 100, (make_gap(s, 50), make_gap(2 * s, 50)), 3 * s) for s in (1.0, 7.0)]
    found = _merge_gaps(parts[0], parts)
    mean = math.sqrt((1 + 49) / 2)
    rows = (found.given, found.before, found.after, found.floor, found.recalibrated)
    assert rows == pytest.approx([mean] * 5)
    assert (found.trivial, found.widest) == (pytest.approx(3 * mean), 7.0)
    assert (found.samples, [o.samples for o in found.outputs]) == (200, [100, 100])
    assert [o.given for o in found.outputs] == pytest.approx([mean, 2 * mean])
    assert not found.trivial_wins


# --- what is refitted without the samples kept back


def test_a_refit_for_the_gap_keeps_the_limits_of_the_fit():
    """A gain given as 40 V in place of 3 may go to a tenth of it, and stays there."""
    record = record_of(servo(), 1500)
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=40.0), PID, dt=0.02, free=("k", "c"))
    model = recalibrate(loop, [record], [cid.audit(record)])
    assert model.fitted.parameters["k"] == pytest.approx(4.0)
    fresh = choose_fresh_data(loop, [record], None)
    assert fresh.prepare_loops(model)[0].parameters["k"] == pytest.approx(4.0)


def test_the_doubt_about_parameters_is_that_about_the_loops_that_are_compared(monkeypatch):
    """The loops are fitted without what is kept back; that they differ so is no doubt."""
    record = record_of(servo(), 1500)
    loop = servo()
    model = fit_base_model(loop, [record], loop.free)
    fresh = choose_fresh_data(loop, [record], None)
    usual = fresh.measure_doubt(model)
    exact = fresh_data.pseudo_inverse
    monkeypatch.setattr(fresh_data, "pseudo_inverse", lambda m: 1e-12 * exact(m))
    assert fresh.measure_doubt(model).max() < 1e-3 * usual.min()
    assert gap.root_mean_square(fresh.windows, fresh.simulate_outputs([loop])) < 2.5e-3


# --- a sensor that is slower than the others


def two_readings(controller=None):
    """A mass on a spring of which position and speed are measured."""
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], u[0] - p["k"] * x[0] - 2.0 * x[1]]),
        lambda t, x, u, p: x, inputs=["F"], outputs=["x", "v"], states=["x", "v"],
        params={"k": 9.0}, name="spring",
    )  # fmt: skip
    return cid.Loop(plant, controller, dt=0.02, free=("k",))


def slow_first_sensor(record, every=5, other=-999.0):
    """Of the first output each fifth reading counts; what stands between is no reading."""
    k = np.arange(len(record))
    valid = np.array([k % every == 0, np.ones(len(record), bool)])
    return replace(record, valid=valid, y=np.where(valid, record.y, other))


@pytest.mark.parametrize("closed", [False, True])
def test_a_slow_sensor_takes_nothing_from_the_others(closed):
    """The gap was infinite, and the record refused for 400 valid samples, none in succession."""
    law = (
        ct.ss([], [], [], [[-4.0, -0.5]], 0.02, inputs=["x", "v"], outputs=["F"])
        if closed
        else None
    )
    loop = two_readings(law)
    d = cid.random_binary(2000, amplitude=1.0, hold=25, seed=1)
    whole = cid.simulate(loop, d=d, sensor_noise=[1e-3, 2e-3], seed=2)
    record = slow_first_sensor(whole)
    assert not cid.audit(record)["too few samples"]
    fresh = choose_fresh_data(loop, [record], None)
    assert (fresh.how.horizon > 0) == closed
    made = fresh.simulate_outputs([loop])[0]
    errors = made - fresh.windows[0].record.y
    for row, mask, noise in zip(errors, fresh.windows[0].mask, (1e-3, 2e-3), strict=True):
        use = mask & np.isfinite(row)
        assert np.count_nonzero(use) > 50
        assert np.std(row[use]) == pytest.approx(noise, rel=0.25)
    found = cid.diagnose(loop, record, catalogue=(E.CoulombFriction,), progress=False)
    assert (found.verdict, found.findings) == ("nothing missing", ())
    assert found.gap.after == pytest.approx(1.0, abs=0.2)


def test_a_missing_effect_is_found_with_a_slow_sensor():
    real = two_readings().with_effect(E.CoulombFriction(fc=0.2))
    d = cid.random_binary(2000, amplitude=1.0, hold=25, seed=1)
    record = slow_first_sensor(cid.simulate(real, d=d, sensor_noise=[1e-3, 2e-3], seed=2))
    few = (E.CoulombFriction, E.ViscousFriction, E.InputDelay)
    found = cid.diagnose(two_readings(), record, catalogue=few, progress=False)
    assert [f.name for f in found.findings] == ["CoulombFriction"]
    assert found.findings[0].effect.fc == pytest.approx(0.2, rel=0.05)
    assert found.gap.after < 1.3


def test_outputs_that_are_read_in_turn_leave_the_input_whole():
    """No sample counts for both, and u is known at all of them."""
    loop = two_readings()
    d = cid.random_binary(600, amplitude=1.0, hold=25, seed=1)
    record = cid.simulate(loop, d=d, sensor_noise=[1e-3, 2e-3], seed=2)
    k = np.arange(600) % 2
    turns = replace(record, valid=np.array([k == 0, k == 1]))
    kinds = (E.InputDeadZone, E.InputSaturation)
    whole, half = (list_candidates(kinds, loop, one) for one in (record, turns))
    assert [c.values() for c in half] == [c.values() for c in whole]
    found = cid.diagnose(loop, turns, catalogue=(E.CoulombFriction,), progress=False)
    assert (found.verdict, found.findings) == ("nothing missing", ())


def test_readings_beyond_a_known_limit_are_not_taken_out():
    """A limit that is wrong must show; it took all readings beyond it out of the record."""
    wrong = replace(RANGE, lower=-0.02, upper=0.02)
    record = record_of(servo(), 600)
    found = cid.diagnose(servo(wrong), record, catalogue=FEW, progress=False)
    assert found.gap.after > 5 * found.gap.floor
    assert found.calibrated[0].after == pytest.approx(3.0, abs=0.05)


def test_a_masked_reading_does_not_lead_a_replay_astray():
    """With an integral it erred by half of what u moves, before the reading as well."""
    loop = servo(controller=cid.PID(kp=5.0, ki=1.0, kd=0.3), dt=0.01)
    record = record_of(loop, 1000, amplitude=0.1, around=0.0, noise=1e-4)
    y = np.where(np.arange(1000) == 500, 50.0, record.y)
    masked = replace(record, y=y, valid=np.arange(1000) != 500)
    left = cid.replay_controller(loop, masked) - record.u
    assert np.abs(left[:499]).max() < 1e-3 * np.std(record.u)
    assert np.abs(left[510:]).max() < 1e-3 * np.std(record.u)
    assert take_bias_from_log(loop, masked).point.input == pytest.approx(0.0, abs=1e-3)
