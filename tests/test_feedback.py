"""check_feedback(): open and closed loops are told apart, with and without noise and reference."""

from dataclasses import replace

import control as ct
import numpy as np
import pytest
from scipy import signal

import ctrlid as cid
import problems


def excitation(rng, n, amplitude, around=0.0):
    kind = rng.choice(["noise", "prbs", "multisine", "binary"])
    if kind == "noise":
        return around + amplitude * rng.standard_normal(n)
    if kind == "multisine":
        return around + amplitude * problems.twelve_waves(rng, n)
    if kind == "prbs":
        return around + amplitude * problems.repeated_bits(rng, n)
    hold, seed = int(rng.integers(1, 40)), int(rng.integers(1_000_000))
    return cid.random_binary(n, amplitude=amplitude, hold=hold, around=around, seed=seed)


def open_record(rng, noisy=True):
    n = int(10 ** rng.uniform(2.5, 3.8))
    kind, at, amplitude = rng.choice(["servo", "tank", "lag"]), None, 1.0
    if kind == "servo":
        plant, _, w = problems.random_servo(rng)
        dt = 10 ** rng.uniform(-2, -0.3) / w
    elif kind == "tank":
        plant = problems.random_tank(rng)
        at = cid.operating_point(plant, output=rng.uniform(1, 2))
        dt, amplitude = rng.choice([1.0, 2.0, 5.0]), 0.1 * at.input
    else:
        lag = 10 ** rng.uniform(-2, 2)
        plant, dt = ct.tf([2.0], [lag, 1]), lag * 10 ** rng.uniform(-2, -0.3)
    record = cid.simulate(cid.Loop(plant, dt=float(dt), at=at), d=excitation(rng, n, amplitude))
    noise = np.std(record.y) * 10 ** rng.uniform(-2, -0.7) if noisy else 0.0
    return replace(record, y=record.y + noise * rng.standard_normal(n))


def closed_record(rng, noisy=True):
    n = int(10 ** rng.uniform(2.5, 3.8))
    digital = bool(rng.random() < 0.6)
    if rng.random() < 0.5:
        loop, gap = problems.random_levitation(rng, digital)
        amplitude = 0.004 * gap
    else:
        loop, amplitude = problems.random_lag(rng, digital), 1.0
    r = excitation(rng, n, amplitude, loop.point.output)
    noise = amplitude * 10 ** rng.uniform(-2, -0.7) if noisy else 0.0
    return cid.simulate(loop, r, sensor_noise=noise, seed=int(rng.integers(1_000_000)))


def many(make, count, seed, **options):
    rng, out = np.random.default_rng(seed), []
    while len(out) < count:
        try:
            out.append(make(rng, **options))
        except cid.CtrlidError:  # the reference was too rough for a levitated ball
            continue
    return out


def test_open_loops_stay_open():
    records = many(open_record, 25, 1)
    wrong = [r for r in records if cid.check_feedback(r).closed_loop]
    assert len(wrong) <= 1


def test_closed_loops_are_found():
    records = many(closed_record, 30, 2)
    assert sum(cid.check_feedback(r).closed_loop for r in records) >= 0.98 * len(records)
    blind = [cid.check_feedback(replace(r, r=None)).closed_loop for r in records]
    assert sum(blind) >= 0.7 * len(records)  # a rough reference hides what noise does


def test_closed_loops_without_noise():
    records = many(closed_record, 25, 3, noisy=False)
    found = [cid.check_feedback(r).closed_loop for r in records if r.hold == "zoh"]
    assert all(found)


@pytest.mark.slow
def test_rates_over_many_records(capsys):
    """False alarms and finds: ``pytest -m slow tests/test_feedback.py``."""
    opened, closed = many(open_record, 600, 10), many(closed_record, 400, 11)
    alarms = sum(cid.check_feedback(r).closed_loop for r in opened)
    found = sum(cid.check_feedback(r).closed_loop for r in closed)
    blind = sum(cid.check_feedback(replace(r, r=None)).closed_loop for r in closed)
    with capsys.disabled():
        rates = f"open {alarms}/{len(opened)}, closed {found} and blind {blind}/{len(closed)}"
        print("\nsaid to be closed:", rates)  # noqa: T201
    assert alarms <= 0.01 * len(opened)
    assert found >= 0.98 * len(closed)


def test_unstable_plant_without_noise_or_reference():
    loop = problems.under_lead(problems.LINEAR_LEVITATION, 1e-3)
    record = problems.record_of(loop, swing=1e-4, hold=20, n=2000, seed=1)
    record = replace(record, r=None)
    found = cid.check_feedback(record)
    assert found.closed_loop
    assert "unstable" in str(found)


@pytest.mark.slow
def test_p_values_are_honest():
    """White u and white noise: a tenth of the cases lies below 0.1."""
    rng = np.random.default_rng(4)
    p = []
    for _ in range(200):
        u = rng.standard_normal(800)
        y = np.convolve(u, [0, 1, 0.5, 0.2])[:800] + rng.standard_normal(800)
        p.append(cid.check_feedback(cid.Record(u=u, y=y, dt=1.0)).p_value)
    assert np.mean(np.array(p) < 0.1) < 0.18
    assert min(p) > 1e-4


def test_gaps_do_not_join():
    rng = np.random.default_rng(5)
    record = closed_record(rng)
    valid = np.ones(record.n, bool)
    valid[record.n // 2 : record.n // 2 + 40] = False
    y = np.where(valid, record.y, 1e3)
    assert cid.check_feedback(replace(record, y=y, valid=valid)).closed_loop


@pytest.mark.parametrize(("name", "closed"), [
    ("emps", True), ("inteco_pid_step", True), ("magnetoshield_r3", True),
    ("inteco_coil_step", False), ("silverbox", False), ("tanks_estimation", False),
    ("tanks_validation", False),
])  # fmt: skip
def test_measured_records(data_dir, name, closed):
    records = cid.datasets.load(name)
    for record in records if isinstance(records, list) else [records]:
        assert cid.check_feedback(record).closed_loop is closed


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("hold", ["zoh", "foh", "bandlimited"])
def test_an_open_bench_whose_input_is_not_held_is_no_closed_loop(hold, seed):
    """An oscillator under a filtered noise that runs straight between the samples, by SciPy."""
    rng = np.random.default_rng(seed)
    dt, n = 1 / 610, 3000
    stiffness, cut = rng.uniform(0.5e5, 2.5e5), rng.uniform(0.3, 0.7)
    plant = np.array([[0, 1.0], [-stiffness, -40.0]]), np.array([[0.0], [1e5]]), np.eye(2)[:1], 0.0
    u = signal.lfilter(*signal.butter(6, cut), rng.standard_normal(n))
    y = signal.lsim(plant, u, dt * np.arange(n), interp=True)[1]
    y += 10 ** rng.uniform(-3.5, -2) * np.std(y) * rng.standard_normal(n)
    found = cid.check_feedback(cid.Record(u=u, y=y, dt=dt, hold=hold))
    assert not found.closed_loop
    if abs(found.correlation[0]) > 0.5:
        assert "not held between the samples" in str(found)


def test_refusals():
    y = np.random.default_rng(6).standard_normal(100)
    with pytest.raises(cid.CtrlidError, match="60 valid samples"):
        cid.check_feedback(cid.Record(u=y[:30], y=y[:30], dt=1.0))
    with pytest.raises(cid.CtrlidError, match="u is constant"):
        cid.check_feedback(cid.Record(u=0 * y, y=y, dt=1.0))
    with pytest.raises(cid.CtrlidError, match="needs a Record"):
        cid.check_feedback(y)
