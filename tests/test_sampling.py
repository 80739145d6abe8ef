"""sweep_sampling_period(): the drift of the poles, who is spared it, and honest rows."""

from dataclasses import replace

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid.validation.sampling_sweep import average_input
from ctrlid.validation.sampling_table import SamplingRow, SamplingSweep
from problems import levitation, record_of

POLE = 40.435  # rad/s


def levitated(pole_times_period, n, noise=2e-6, digital=True, seed=1):
    """A maglev loop sampled so fast; the reference switches every 0.6 / pole."""
    loop = levitation(dt=pole_times_period / POLE, analog=not digital)
    hold = max(1, round(0.6 / pole_times_period))
    return record_of(loop, swing=1e-4, hold=hold, n=n, seed=seed, noise_seed=seed,
                     sensor_noise=noise)  # fmt: skip


@pytest.fixture(scope="module")
def fast():
    record = levitated(0.01, 20_000)
    return cid.sweep_sampling_period(record, [q * record.dt for q in (1, 3, 10, 20)])


def test_least_squares_drifts_to_the_origin_and_comes_back(fast):
    """Section II.C of the paper: at p Ts = 0.01 no unstable pole is left, at 0.1 and 0.2 it is."""
    unstable = [row.poles.real.max() for row in fast["fit_arx"]]
    assert abs(unstable[0]) < 0.2 * POLE
    assert unstable[2:] == pytest.approx([POLE, POLE], rel=0.1)
    assert not fast["fit_arx"][0].independent


def test_instruments_and_the_innovations_model_are_spared(fast):
    for row in fast["fit_iv"]:
        assert row.poles.real == pytest.approx([-POLE, POLE], rel=0.06)
    for row in fast["fit_continuous"][:3]:
        assert row.poles.real == pytest.approx([-POLE, POLE], rel=0.06)
        assert row.independent


def test_recommendation(fast):
    assert fast.recommended in (fast.table[6].period, fast.table[9].period)
    assert "fit_iv at every period" in fast.reason
    assert "more often than the longer periods sample it" in fast.warning
    assert fast.poles.real == pytest.approx([-POLE, POLE], rel=0.05)
    worst = {q: max(row.deviation for row in fast.table if row.factor == q) for q in (1, 3, 10, 20)}
    assert fast.recommended == fast.record.dt * min(worst, key=worst.get)


def test_table_is_ordered_and_readable(fast):
    assert [row.factor for row in fast.table] == [1, 1, 1, 3, 3, 3, 10, 10, 10, 20, 20, 20]
    assert [row.input_between for row in fast.table[:6]] == [
        "as recorded", "as recorded", "as recorded", "filtered", "mean", "mean"]  # fmt: skip
    text = str(fast)
    assert len(text.splitlines()) == 2 + 12 + 2
    assert "CORRELATED WITH u OR r" in text
    assert fast.table[9].pole_times_period.max() == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize("seed", [2, 3, 4])
@pytest.mark.parametrize("digital", [True, False])
def test_random_noise_and_analog_controllers(seed, digital):
    rng = np.random.default_rng(seed)
    record = levitated(0.01, 10_000, noise=10 ** rng.uniform(-6, -5), digital=digital, seed=seed)
    sweep = cid.sweep_sampling_period(
        record, [record.dt, 10 * record.dt], estimators=("fit_arx", "fit_iv")
    )
    first, later = sweep["fit_arx"]
    assert first.poles.real.max() < 0.3 * POLE
    assert later.poles.real.max() > first.poles.real.max()
    iv = sweep["fit_iv"]
    assert iv[1].poles.real == pytest.approx([-POLE, POLE], rel=0.15)
    if not digital:
        assert "held between samples" in iv[0].failure
        assert "FAILED" in str(sweep)


@pytest.mark.slow
def test_noise_free_records_need_no_slowing_down():
    record = levitated(0.05, 2000, noise=0.0)
    sweep = cid.sweep_sampling_period(record, [record.dt, 4 * record.dt])
    assert all(row.deviation < 0.2 for row in sweep.table)
    assert sweep["fit_iv"][0].poles.real == pytest.approx([-POLE, POLE], rel=0.02)


def test_constraints_by_estimator_and_the_wrong_ones():
    record = levitated(0.05, 2000)
    known = {"fit_arx": [cid.ReciprocalPoles()], "fit_iv": [cid.ReciprocalPoles()],
             "fit_continuous": [cid.SymmetricPoles()]}  # fmt: skip
    sweep = cid.sweep_sampling_period(record, [record.dt, 5 * record.dt], constraints=known)
    for row in sweep.table:
        assert not row.failure
        assert np.sum(row.poles.real) == pytest.approx(0.0, abs=1e-6)
    same = cid.sweep_sampling_period(record, [record.dt], constraints=cid.ReciprocalPoles())
    assert "SymmetricPoles" in same["fit_continuous"][0].failure
    assert not same["fit_iv"][0].failure


def test_active_bounds_are_in_the_table():
    record = levitated(0.01, 4000)
    known = [cid.ReciprocalPoles(), cid.Bounds("a1", upper=-2.0)]
    sweep = cid.sweep_sampling_period(
        record, [record.dt], estimators=["fit_arx"], constraints=known
    )
    row = sweep.table[0]
    assert bool(row.active) == ("ON ITS BOUND" in str(sweep))


def test_mean_input_is_exact_for_an_integrator():
    rng = np.random.default_rng(5)
    u = rng.standard_normal(3000)
    y = np.concatenate([[0.0], np.cumsum(u)[:-1]]) * 0.01
    slow = average_input(cid.Record(u=u, y=y, dt=0.01), 7)
    assert np.diff(slow.y) == pytest.approx(slow.u[:-1] * slow.dt, abs=1e-12)
    sweep = cid.sweep_sampling_period(
        cid.Record(u=u, y=y, dt=0.01), [0.01, 0.07], estimators=["fit_continuous"], poles=1
    )
    assert [row.poles[0].real for row in sweep.table] == pytest.approx([0, 0], abs=1e-6)


def test_gaps_stay_gaps():
    record = levitated(0.05, 3000)
    valid = np.ones(record.n, bool)
    valid[1001] = False
    slow = average_input(replace(record, valid=valid), 5)
    assert np.flatnonzero(~slow.valid).tolist() == [200]


def test_default_periods_leave_samples_enough():
    record = levitated(0.05, 2000)
    sweep = cid.sweep_sampling_period(record, estimators=["fit_arx"])
    assert [row.factor for row in sweep.table] == [1, 2, 3, 5, 7, 10]


def test_too_long_a_period_is_a_row():
    record = levitated(0.05, 1000)
    sweep = cid.sweep_sampling_period(record, [record.dt, 400 * record.dt])
    assert all(row.failure for row in sweep.table[3:])
    assert sweep.recommended == record.dt


def test_processes_give_the_same_table():
    record = levitated(0.05, 1500)
    one, two = (
        cid.sweep_sampling_period(
            record, [record.dt, 3 * record.dt], estimators=["fit_arx"], jobs=jobs
        )
        for jobs in (1, 2)
    )
    assert str(one) == str(two)


@pytest.mark.parametrize(("options", "words"), [
    ({"periods": [1e-5]}, "whole multiples"),
    ({"periods": []}, "whole multiples"),
    ({"estimators": ["fit_magic"]}, "estimators takes names out of"),
    ({"estimators": []}, "estimators takes names out of"),
    ({"jobs": 0}, "number of processes"),
])  # fmt: skip
def test_refusals(options, words):
    record = cid.Record(u=np.ones(300), y=np.arange(300.0), dt=0.01)
    with pytest.raises(cid.CtrlidError, match=words):
        cid.sweep_sampling_period(record, **options)


def test_nothing_to_fit_is_refused_with_the_reason():
    record = cid.Record(u=np.ones(300), y=np.arange(300.0), dt=0.01)
    with pytest.raises(cid.CtrlidError, match=r"no fit succeeded.*u is constant"):
        cid.sweep_sampling_period(record, [0.01], estimators=["fit_arx"])
    with pytest.raises(cid.CtrlidError, match="needs one Record"):
        cid.sweep_sampling_period([record])


def test_unknown_estimator_in_the_table(fast):
    with pytest.raises(cid.CtrlidError, match="has no estimator"):
        fast["fit_loop"]


def test_poles_are_written_as_everywhere_and_stay_in_their_column():
    def row(pole, error):
        return SamplingRow("fit_arx", 1, 0.01, 100, "as recorded", np.array([pole, -pole]),
                           np.full(2, error), white=True, deviation=0.01)  # fmt: skip

    record = cid.Record(u=np.zeros(9), y=np.zeros(9), dt=0.01)
    table = (row(40.123456, 0.31), row(40.123456, 3.1e-7), row(40 + 30j, 0.2))
    sweep = SamplingSweep(record, table, np.array([-40.0, 40.0]), 0.01, "why")
    _, head, *lines = str(sweep).splitlines()[:5]
    assert "  40.12 ± 0.31, -40.12 ± 0.31  " in lines[0]
    assert "  40.12345600 ± 0.00000031, -40.12345600 ± 0.00000031  " in lines[1]
    assert "40.00+30.00j ± 0.20" in lines[2]
    assert {line.index(" 1 %") for line in lines} == {head.index("distance") + 4}


def test_the_mean_of_a_straight_input_is_that_of_its_lines():
    """The left sum is half a period late: a2 = 4.03 with a standard error of 0.0019."""
    plant = ct.tf([1.0], [1.0, 1.2, 4.0])
    u = np.convolve(np.random.default_rng(3).standard_normal(8000), np.ones(30) / 30, "same")
    y = ct.forced_response(plant, 0.01 * np.arange(8000), u).outputs
    noise = 1e-4 * np.random.default_rng(4).standard_normal(8000)
    record = cid.Record(u=u, y=y + noise, dt=0.01, hold="foh")
    slow = average_input(record, 5)
    np.testing.assert_allclose(slow.u[0], np.mean(0.5 * (u[:5] + u[1:6])))
    G = cid.fit_continuous(slow, poles=2, zeros=0)
    assert G.den[0][0][2] == pytest.approx(4.0, abs=0.01)
