"""check_feedback(): open and closed loops are told apart, with and without noise and reference."""

from dataclasses import replace

import control as ct
import numpy as np
import pytest

import ctrlid as cid


def excitation(rng, n, amplitude, around=0.0):
    kind = rng.choice(["noise", "prbs", "multisine", "binary"])
    if kind == "noise":
        return around + amplitude * rng.standard_normal(n)
    if kind == "multisine":
        waves = [np.sin(2 * np.pi * (f * np.arange(n) + rng.uniform()))
                 for f in rng.uniform(1 / 400, 0.1, 12)]  # fmt: skip
        return around + amplitude * sum(waves) / 5
    if kind == "prbs":
        period = np.repeat(rng.choice([-1.0, 1.0], 127), int(rng.integers(1, 9)))
        return around + amplitude * np.tile(period, n)[:n]
    hold, seed = int(rng.integers(1, 40)), int(rng.integers(1_000_000))
    return cid.random_binary(n, amplitude=amplitude, hold=hold, around=around, seed=seed)


def open_record(rng, noisy=True):
    n = int(10 ** rng.uniform(2.5, 3.8))
    kind, at, amplitude = rng.choice(["servo", "tank", "lag"]), None, 1.0
    if kind == "servo":
        m, w = 10 ** rng.uniform(-1, 1), 10 ** rng.uniform(0, 1.5)
        plant = cid.plants.servo(m=m, c=m * w * rng.uniform(0.2, 3), k=m * w**2)
        dt = 10 ** rng.uniform(-2, -0.3) / w
    elif kind == "tank":
        plant = cid.plants.tank(area=rng.uniform(0.5, 2), outlet=0.02, k=0.05)
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
        x0 = rng.uniform(0.008, 0.02)
        plant = cid.plants.maglev(m=rng.uniform(0.01, 0.1), K=10 ** rng.uniform(-6, -4))
        at = cid.operating_point(plant, output=x0)
        P = cid.linearize(plant, at)
        p = float(np.max(np.abs(P.poles())))
        dt, amplitude = float(f"{10 ** rng.uniform(-2, -1.3) / p:.3g}"), 0.004 * x0
        C = cid.design_lead(P, crossover=2.5 * p, phase_margin=45)
        C = ct.sample_system(ct.ss(C), dt, "tustin") if digital else C
    else:
        lag, gain = 10 ** rng.uniform(-2, 2), rng.uniform(0.5, 4)
        plant, at = ct.tf([2.0], [lag, 1]), cid.OperatingPoint((0.0,), 1.0, 3.0)
        dt, amplitude = 0.05 * lag, 1.0
        C = cid.PID(gain, ki=rng.uniform(0.1, 2) / lag) if digital else ct.tf([gain], [1])
    r = excitation(rng, n, amplitude, at.output)
    noise = amplitude * 10 ** rng.uniform(-2, -0.7) if noisy else 0.0
    loop = cid.Loop(plant, C, dt=dt, at=at)
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
    P = ct.tf([-6.5], [1, 0, -1600])
    C = ct.sample_system(ct.ss(cid.design_lead(P, crossover=100, phase_margin=50)), 1e-3, "tustin")
    r = cid.random_binary(2000, amplitude=1e-4, hold=20, seed=1)
    record = replace(cid.simulate(cid.Loop(P, C, dt=1e-3), r), r=None)
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
    ("inteco_coil_step", False), ("tanks_estimation", False), ("tanks_validation", False),
])  # fmt: skip
def test_measured_records(data_dir, name, closed):
    records = cid.datasets.load(name)
    for record in records if isinstance(records, list) else [records]:
        assert cid.check_feedback(record).closed_loop is closed


def test_refusals():
    y = np.random.default_rng(6).standard_normal(100)
    with pytest.raises(cid.CtrlidError, match="60 valid samples"):
        cid.check_feedback(cid.Record(u=y[:30], y=y[:30], dt=1.0))
    with pytest.raises(cid.CtrlidError, match="u is constant"):
        cid.check_feedback(cid.Record(u=0 * y, y=y, dt=1.0))
    with pytest.raises(cid.CtrlidError, match="needs a Record"):
        cid.check_feedback(y)
