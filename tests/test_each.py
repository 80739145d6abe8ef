"""Many and long records: one model each, trends, jobs, a dask cluster, constant memory."""

import tracemalloc
from contextlib import contextmanager
from dataclasses import replace

import cloudpickle
import distributed
import joblib
import numpy as np
import pytest
from scipy.signal import lfilter

import ctrlid as cid
from ctrlid import plot
from ctrlid.estimation.identified_model import Structure
from ctrlid.estimation.linear.regression import reduce_record
from problems import legend, levitation, record_of

KNOWN = (cid.ReciprocalPoles(), cid.Equal("b1", "b2"))
GAPS = (0.008, 0.010, 0.012, 0.015)


def levitations(gaps=GAPS, n=3000, noise=2e-6):
    records = [record_of(levitation(gap=gap), swing=5e-5, hold=10, n=n, seed=k, noise_seed=k,
                         sensor_noise=noise) for k, gap in enumerate(gaps)]  # fmt: skip
    return [replace(record, name=f"gap {k}") for k, record in enumerate(records)]


@pytest.fixture(scope="module")
def records():
    return levitations()


@pytest.fixture(scope="module")
def series(records):
    return cid.fit_each(cid.fit_iv, records, na=2, nb=2, constraints=KNOWN)


def test_each_model_is_that_of_its_record(records, series):
    for record, model in zip(records, series.models, strict=True):
        alone = cid.fit_iv(record, 2, 2, constraints=KNOWN)
        assert np.array_equal(alone.estimate.values, model.estimate.values)
    assert series.names == ("gap 0", "gap 1", "gap 2", "gap 3")
    assert series.levels == pytest.approx(GAPS, rel=2e-3)


def test_poles_follow_the_gap_as_physics_says(series):
    truth = np.sqrt(2 * 9.81 / series.levels)
    assert np.all(np.abs(series.rates - truth) < 4.5 * series.rate_errors)
    line = series.trend
    assert line.exponent == pytest.approx(-0.5, abs=0.06)  # a line through a power
    assert line.slope == pytest.approx(-0.5 * line.pole / line.level, rel=0.1)


def test_trend_is_the_weighted_line(series):
    line, y, p, s = series.trend, series.levels, series.rates, series.rate_errors
    table = np.column_stack([np.ones(len(y)), y - line.level]) / s[:, None]
    best = np.linalg.lstsq(table, p / s, rcond=None)[0]
    errors = np.sqrt(np.diag(np.linalg.inv(table.T @ table)))
    square = np.sum((p / s - table @ best) ** 2)
    scale = np.sqrt(max(square / (len(y) - 2), 1.0))
    assert (line.pole, line.slope) == pytest.approx(tuple(best))
    assert (line.pole_error, line.slope_error) == pytest.approx(tuple(scale * errors))


def test_trend_in_words_and_as_a_picture(series):
    text = str(series)
    assert "gap 2" in text
    assert "rightmost pole" in text
    assert "proportional to the output to the power -0." in text
    (ax,) = plot.trend(series, truth=lambda y: np.sqrt(2 * 9.81 / y))
    assert ax.get_xlabel() == "mean output [mm]" or "unit" in ax.get_xlabel()
    assert legend(ax) == ["line through the fits", "physics", "fits, 95 % intervals"]


def test_noise_free_fits_have_a_trend_too():
    line = cid.fit_each(cid.fit_arx, levitations((0.01, 0.012), 500, 0.0), na=2, nb=2).trend
    assert line.exponent == pytest.approx(-0.5, abs=0.02)
    assert np.isnan(line.p_value)


def test_a_refusal_names_the_record(records):
    still = replace(records[1], y=np.full(3000, 0.01), u=np.full(3000, 3.0), name="asleep")
    with pytest.raises(cid.CtrlidError, match=r"^asleep \(number 2\): "):
        cid.fit_each(cid.fit_arx, [records[0], still], na=2, nb=2)


@pytest.mark.parametrize(
    ("call", "words"),
    [(lambda r: cid.fit_each("fit_iv", r), "needs a function such as fit_iv; given str"),
     (lambda r: cid.fit_each(cid.fit_iv, []), "at least one record"),
     (lambda r: cid.fit_each(cid.fit_iv, [3]), "number 1 is a int"),
     (lambda r: cid.fit_each(cid.fit_iv, r, jobs=0), "jobs is a number of processes.*given 0"),
     (lambda r: cid.fit_arx(r, 2, 2, jobs=True), "jobs is a number of processes.*given True"),
     (lambda r: cid.fit_each(cid.fit_arx, r[:1], na=2, nb=2).trend, "or more different outputs"),
     (lambda r: plot.trend(r), "plot.trend draws a FitSeries")],
)  # fmt: skip
def test_refusals(records, call, words):
    with pytest.raises(cid.CtrlidError, match=words):
        call(records)


def same(one, other):
    return all(
        np.array_equal(a.estimate.values, b.estimate.values)
        and np.array_equal(a.estimate.covariance, b.estimate.covariance)
        for a, b in zip(one, other, strict=True)
    )


def test_processes_give_the_same_numbers(records, series):
    shared = cid.fit_each(cid.fit_iv, records, na=2, nb=2, constraints=KNOWN, jobs=2)
    assert same(series.models, shared.models)
    assert same([cid.fit_arx(records, 2, 2)], [cid.fit_arx(records, 2, 2, jobs=2)])


@contextmanager
def local_cluster():
    """A dask cluster of two workers in this process, to which joblib sends as to a distant one."""
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None
    )
    with cluster, distributed.Client(cluster):
        yield


def test_a_dask_cluster_gives_the_same_numbers(records, series):
    with local_cluster(), joblib.parallel_config(backend="dask"):
        spread = cid.fit_each(cid.fit_iv, records, na=2, nb=2, constraints=KNOWN)
        one = cid.fit_arx(records, 2, 2)
        sweep = cid.sweep_sampling_period(
            records[0], [0.002, 0.004], estimators=["fit_arx"], jobs=2
        )
        assert joblib.effective_n_jobs(None) == 2
    assert same(series.models, spread.models)
    assert same([one], [cid.fit_arx(records, 2, 2)])
    alone = cid.sweep_sampling_period(records[0], [0.002, 0.004], estimators=["fit_arx"])
    assert [row.poles.tolist() for row in sweep.table] == [
        row.poles.tolist() for row in alone.table
    ]


def test_factors_of_parts_are_the_factor_of_the_whole(records):
    record = records[0]
    s = Structure(2, 2)
    parts = [record[i : i + 1000 + 2] for i in range(0, 3000, 1000)]
    merged = cid.fit_arx(parts, 2, 2, intercept=False).estimate
    whole = cid.fit_arx(record, 2, 2, intercept=False).estimate
    assert merged.n_samples == whole.n_samples == 2998
    assert merged.values == pytest.approx(whole.values, rel=1e-9)
    assert merged.covariance == pytest.approx(whole.covariance, rel=1e-6)
    factor = reduce_record(record, s, intercept=False).factor
    stacked = np.vstack([reduce_record(p, s, intercept=False).factor for p in parts])
    assert stacked.T @ stacked == pytest.approx(factor.T @ factor, rel=1e-9)


def blocks(n, size=100_000):
    """Cut an endless log into records, each made when it is asked for."""
    rng, state = np.random.default_rng(0), np.zeros(2)
    for _ in range(0, n, size):
        u = rng.standard_normal(size)
        y, state = lfilter([0.0, 0.1, 0.08], [1.0, -1.9, 0.92], u, zi=state)
        yield cid.Record(u=u, y=y + 0.01 * rng.standard_normal(size), dt=1e-3)


def test_a_generator_is_fitted_like_a_list():
    listed = cid.fit_arx(list(blocks(300_000)), 2, 2, intercept=False).estimate
    streamed = cid.fit_arx(blocks(300_000), 2, 2, intercept=False).estimate
    assert np.array_equal(listed.values, streamed.values)
    assert streamed.n_samples == 3 * (100_000 - 2)


def test_memory_does_not_grow_with_the_number_of_samples():
    def peak(n):
        tracemalloc.start()
        try:
            cid.fit_arx(blocks(n), 2, 2)
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(200_000)  # what is imported and cached on the way
    short, long = peak(500_000), peak(5_000_000)
    assert long < 1.05 * short + 1e5, (short, long)
    assert long < 5 * 8 * 2 * 100_000  # a few blocks, and not the 80 MB of the samples


def test_a_memory_mapped_log_is_read_in_blocks(tmp_path):
    path, n = tmp_path / "log.f8", 200_000
    log = np.memmap(path, dtype=float, mode="w+", shape=(n, 2))
    whole = next(blocks(n, n))
    log[:, 0], log[:, 1] = whole.u, whole.y

    def cut():
        for i in range(0, n, 50_000):
            part = log[i : i + 50_002]  # two samples more: no row is lost at the seam
            yield cid.Record(u=part[:, 0], y=part[:, 1], dt=1e-3)

    streamed = cid.fit_arx(cut(), 2, 2, intercept=False).estimate
    assert streamed.values == pytest.approx(
        cid.fit_arx(whole, 2, 2, intercept=False).estimate.values, rel=1e-9
    )


def test_what_a_generator_yields_is_checked(records):
    faster = replace(records[1], dt=0.001)
    for strange, words in ((faster, "the same sampling period"), ("no", "the list given has str")):
        with pytest.raises(cid.CtrlidError, match=words):
            cid.fit_arx(iter([records[0], strange]), 2, 2)
    with pytest.raises(cid.CtrlidError, match="the list given is empty"):
        cid.fit_arx(iter([]), 2, 2)
    with pytest.raises(cid.CtrlidError, match="Record 2 gives no equation"):
        cid.fit_arx(iter([records[0], records[1][:2]]), 2, 2)


def test_a_loop_travels_to_other_processes():
    """Plant, effects and equations survive cloudpickle, which joblib and dask send work with."""
    loop = levitation(
        cid.effects.ActuatorLag(2e-3), cid.effects.InputDelay(1e-3),
        cid.effects.InputBacklash(0.01), cid.effects.CoulombFriction(0.1),
        cid.effects.Quantization(1e-6),
    )  # fmt: skip
    again = cloudpickle.loads(cloudpickle.dumps(loop))
    assert repr(again) == repr(loop)
    r = cid.random_binary(300, amplitude=1e-4, hold=15, around=0.012, seed=1)
    one, other = (cid.simulate(it, r, sensor_noise=1e-6, seed=2) for it in (loop, again))
    assert np.array_equal(one.y, other.y)
    assert again.parameters == loop.parameters


def test_a_diagnosis_on_a_dask_cluster_finds_the_same():
    model = levitation()
    rig = model.with_effect(cid.effects.ActuatorLag(tau=0.002))
    record = record_of(rig, swing=2e-4, hold=20, n=1000, seed=1, sensor_noise=5e-6)
    few = {"catalogue": (cid.effects.ActuatorLag, cid.effects.CoulombFriction), "progress": False}
    with local_cluster(), joblib.parallel_config(backend="dask"):
        spread = cid.diagnose(model, record, jobs=2, **few)
    alone = cid.diagnose(model, record, **few)
    assert [f.name for f in spread.findings] == [f.name for f in alone.findings] == ["ActuatorLag"]
    assert spread.loop.parameters == alone.loop.parameters


def test_a_line_through_two_exact_poles_has_no_error_that_is_known():
    """It was made up of two ones: 353 of a unit for a slope of zero."""
    records = []
    for seed, gap in ((1, 0.010), (2, 0.014)):
        plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
        at = cid.operating_point(plant, output=gap)
        C = cid.design_lead(cid.linearize(plant, at), crossover=100, phase_margin=50)
        loop = cid.Loop(plant, C.sample(0.001, "tustin"), dt=0.001, at=at)
        r = cid.random_binary(1000, amplitude=1e-4, hold=20, around=gap, seed=seed)
        records.append(cid.simulate(loop, r, sensor_noise=1e-6, seed=seed))
    known = [cid.Fixed("a1", -2.002), cid.Fixed("a2", 1.0)]
    trend = cid.fit_each(cid.fit_iv, records, na=2, nb=2, constraints=known).trend
    assert np.isnan(trend.pole_error)
    assert np.isnan(trend.slope_error)
