"""select_order(): orders and delay, in open and closed loop, with sensor noise."""

from dataclasses import replace

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid.validation.order_selection import _fit_long_regression, _fit_structure
from problems import LINEAR_LEVITATION, record_of, under_lead


def random_record(rng, n=6000):
    """A sampled lag of order one to three, delayed, open loop or closed, with sensor noise."""
    na, delay = int(rng.integers(1, 4)), int(rng.integers(1, 4))
    w = rng.uniform(5, 30, na)
    dt = rng.uniform(0.2, 0.5) / w.max()
    P = ct.sample_system(ct.tf([np.prod(w)], np.poly(-w)), dt)
    b, a = np.trim_zeros(P.num[0][0], "f"), P.den[0][0]
    r = np.repeat(rng.choice([-1.0, 1.0], n // 5 + 1), 5)[:n]
    v = rng.standard_normal(n) * 10 ** rng.uniform(-2, -1)
    gain = rng.uniform(0.1, 0.5) if rng.random() < 0.6 else 0.0
    x, y, u = np.zeros(n), np.zeros(n), np.zeros(n)
    for k in range(n):
        x[k] = sum(b[j] * u[k - delay - j] for j in range(len(b)) if k >= delay + j)
        x[k] -= sum(a[i] * x[k - i] for i in range(1, na + 1) if k >= i)
        y[k] = x[k] + v[k]
        u[k] = r[k] - gain * y[k]
    return (na, delay), cid.Record(u=u, y=y, dt=dt)


def levitated(pole_times_period, noise, n=8000):
    loop = under_lead(LINEAR_LEVITATION, pole_times_period / 40)
    hold = max(1, round(0.6 / pole_times_period))
    return record_of(loop, swing=1e-4, hold=hold, n=n, seed=1, sensor_noise=noise)


@pytest.mark.slow
def test_poles_and_delay_of_random_plants():
    rng = np.random.default_rng(1)
    right = []
    for _ in range(40):
        (na, delay), record = random_record(rng)
        choice = cid.select_order(record)
        right.append([choice.na == na, (choice.na, choice.nk) == (na, delay)])
    assert np.mean(right, axis=0)[0] >= 0.9
    assert np.mean(right, axis=0)[1] >= 0.8  # of three lags the first coefficient is tiny


@pytest.mark.parametrize("pole_times_period", [0.05, 0.1, 0.2])
@pytest.mark.parametrize("noise", [0.0, 5e-7, 2e-6])
def test_unstable_plant_under_feedback(pole_times_period, noise):
    choice = cid.select_order(levitated(pole_times_period, noise))
    assert (choice.na, choice.nb, choice.nk) == (2, 2, 1)
    assert choice.rows[0].held_out == pytest.approx(1.0, abs=0.05)


def test_where_least_squares_asks_for_too_much():
    record = levitated(0.1, 2e-6)
    scores = {}
    for na in range(1, 5):
        for nb in range(1, 4):
            e = cid.fit_arx(record, na, nb).estimate
            price = (na + nb) * np.log(e.n_samples)
            scores[na, nb] = e.n_samples * np.log(e.residual_variance) + price
    assert min(scores, key=scores.get) == (4, 3)
    assert cid.select_order(record).na == 2


def test_the_right_structure_is_at_chance_distance():
    """Chi-square with as many degrees of freedom as lags less coefficients."""
    misfits = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal(3000)
        x, e = np.zeros(3000), 0.1 * rng.standard_normal(3000)
        for k in range(2, 3000):
            x[k] = 1.5 * x[k - 1] - 0.7 * x[k - 2] + u[k - 1] + 0.5 * u[k - 2]
        record = cid.Record(u=u, y=x + e, dt=1.0)
        theta, misfit, _ = _fit_structure(_fit_long_regression(record, 0, 3000, 24), 2, 2, 1)
        assert theta == pytest.approx([-1.5, 0.7, 1.0, 0.5], abs=0.02)
        misfits.append(misfit)
    assert np.mean(misfits) == pytest.approx(20, abs=3)


def test_units_do_not_matter():
    record = levitated(0.1, 2e-6, n=4000)
    scaled = replace(record, u=1e3 * record.u, y=1e-3 * record.y + 7.0)
    one, two = cid.select_order(record), cid.select_order(scaled)
    for row, other in zip(one.rows[:5], two.rows[:5], strict=True):
        assert (row.na, row.nb, row.nk) == (other.na, other.nb, other.nk)
        assert row.misfit == pytest.approx(other.misfit, rel=1e-3, abs=1e-3)


def test_gaps_are_left_out():
    record = levitated(0.1, 2e-6, n=6000)
    valid = np.ones(record.n, bool)
    valid[1500:1600] = False
    spoilt = replace(record, y=np.where(valid, record.y, 1.0), valid=valid)
    choice = cid.select_order(spoilt)
    assert (choice.na, choice.nb, choice.nk) == (2, 2, 1)


def test_words():
    text = str(cid.select_order(levitated(0.1, 2e-6)))
    assert "Chosen: na=2, nb=2, nk=1" in text
    assert "held-out error" in text
    t = np.arange(3000)
    poor = cid.Record(u=np.sin(0.01 * t), y=np.cumsum(np.sin(0.01 * t)) ** 2, dt=1.0)
    assert any(
        word in str(cid.select_order(poor)) for word in ("DECIDE", "DECISION", "NO STRUCTURE")
    )


def test_measured_delay(data_dir):
    """The log of the MagnetoShield has one sample of delay more than its loop suggests."""
    for record in cid.datasets.load("magnetoshield_r3")[:3]:
        assert cid.select_order(record).nk == 2


@pytest.mark.parametrize(("options", "words"), [
    ({"na": range(0, 3)}, "na takes whole numbers"),
    ({"nk": []}, "nk takes whole numbers"),
    ({"nb": [1.5]}, "nb takes whole numbers"),
])  # fmt: skip
def test_refused_orders(options, words):
    with pytest.raises(cid.CtrlidError, match=words):
        cid.select_order(levitated(0.2, 1e-6, n=1000), **options)


def test_refused_records():
    y = np.random.default_rng(3).standard_normal(120)
    with pytest.raises(cid.CtrlidError, match="samples in succession"):
        cid.select_order(cid.Record(u=y, y=y, dt=1.0))
    with pytest.raises(cid.CtrlidError, match="u is constant"):
        cid.select_order(cid.Record(u=0 * y, y=y, dt=1.0))
    with pytest.raises(cid.CtrlidError, match="needs a Record"):
        cid.select_order(y)


@pytest.mark.parametrize(
    ("u", "y"), [(1e160, 1.0), (1.0, 1e-200), (1e-200, 1e-200), (1e150, 1e160)]
)
def test_any_unit_gives_the_same_choice(u, y):
    record = random_record(np.random.default_rng(5))[1]
    one = cid.select_order(record)
    other = cid.select_order(replace(record, u=u * record.u, y=y * record.y))
    assert (other.na, other.nb, other.nk) == (one.na, one.nb, one.nk)
    gain = np.repeat([1.0, y / u], [one.na, one.nb])
    assert other.rows[0].values == pytest.approx(gain * one.rows[0].values, rel=1e-6)


def test_a_ratio_that_no_number_holds_is_refused():
    record = random_record(np.random.default_rng(5))[1]
    with pytest.raises(cid.CtrlidError, match="their ratio is no number"):
        cid.select_order(replace(record, u=1e-200 * record.u, y=1e200 * record.y))
