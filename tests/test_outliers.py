"""Gross outliers of the sensor: found, left out and told; what a plant does itself is kept.

The records come from a mass on a spring that this file integrates by itself.
"""

from dataclasses import replace

import control as ct
import numpy as np
import pytest
from scipy import linalg

import ctrlid as cid
from ctrlid._base import rounding
from ctrlid.data.outliers import find_outliers, mask_outliers
from problems import levitation

MASS, DAMPING, STIFFNESS, DT = 1.0, 2.0, 30.0, 0.02


def spring(seed, n=2000, sigma=2e-4, noise=None):
    """Input [N] and measured position [m] of a mass on a spring, driven by random steps."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], n // 20), 20)
    a = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -DAMPING / MASS]])
    block = np.zeros((3, 3))
    block[:2, :2], block[1, 2] = a, 1 / MASS
    step = linalg.expm(block * DT)
    x, y = np.zeros(2), np.zeros(n)
    for k in range(n):
        y[k] = x[0]
        x = step[:2, :2] @ x + step[:2, 2] * u[k]
    v = rng.standard_normal(n) if noise is None else noise(rng, n)
    return cid.Record(u=u, y=y + sigma * v, dt=DT, units={"y": "m"})


def strike(record, share, size, seed=0):
    """A record some of whose readings are replaced by `size` [m] of either sign."""
    rng = np.random.default_rng(seed)
    hit = rng.random(len(record)) < share
    return replace(record, y=np.where(hit, size * rng.choice([-1, 1], len(hit)), record.y)), hit


def bench():
    """The mass on its spring as a model, with both constants wrong."""

    def move(t, x, u, params):
        return np.array([x[1], (u[0] - params["c"] * x[1] - params["k"] * x[0]) / MASS])

    plant = ct.nlsys(move, lambda t, x, u, params: x[0], inputs=["F"], outputs=["x"],
                     states=["x", "v"], params={"c": 1.5, "k": 25.0}, name="spring")  # fmt: skip
    return cid.Loop(plant, None, dt=DT, free=("c", "k"))


@pytest.mark.parametrize("share", [0.1, 0.15])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_many_outliers_are_all_found_where_they_crowd(share, seed):
    record, hit = strike(spring(seed), share, 400.0, seed)
    np.testing.assert_array_equal(find_outliers(record), hit)


def test_a_fit_that_says_nothing_of_any_parameter_is_refused():
    loop = levitation()
    r = cid.random_binary(2000, amplitude=1e-4, hold=40, around=loop.at.output, seed=1)
    record = cid.simulate(loop, r, sensor_noise=2e-6, seed=2)
    hit = np.random.default_rng(0).random(len(record)) < 0.2
    record = replace(record, y=np.where(hit, 400.0, record.y))
    with pytest.raises(cid.CtrlidError, match="lost the record"):
        cid.fit_loop(loop, record)


@pytest.mark.parametrize("share", [0.02, 0.05])
@pytest.mark.parametrize("size", [2.0, 400.0, 1e9])
def test_a_fit_leaves_gross_outliers_out_and_says_so(size, share):
    record, hit = strike(spring(1), share, size)
    estimate = cid.fit_loop(bench(), record).estimate
    assert np.isfinite(estimate.log_likelihood)
    for name, true in (("c", DAMPING), ("k", STIFFNESS)):
        low, high = estimate.confidence_interval(name, level=0.9999)
        assert low < true < high
        assert 0 < high - low < 0.02 * true
    assert estimate.sensor_noise[0] == pytest.approx(2e-4, rel=0.1)
    (note,) = estimate.notes
    assert note.startswith(f"{hit.sum()} OF 2000 READINGS OF y ARE GROSS OUTLIERS")
    assert f"{size:.3g} m" in note
    assert f"{np.flatnonzero(hit)[0] * DT:.4g}" in note


def test_a_fit_without_outliers_says_nothing_of_them_and_is_the_same():
    record = spring(2)
    assert mask_outliers(record)[0] is record
    assert cid.fit_loop(bench(), record).estimate.notes == ()


@pytest.mark.parametrize("seed", range(20))
def test_neither_noise_nor_motion_is_an_outlier(seed):
    rng = np.random.default_rng(seed)
    assert not find_outliers(spring(seed, sigma=10.0 ** rng.uniform(-8, 1))).any()


def of_signal(y, u=None):
    return cid.Record(u=np.zeros(len(y)) if u is None else u, y=y, dt=DT)


def test_a_real_answer_is_no_outlier():
    n = 400
    chatter = np.resize([1.0, -1.0], n)
    jump = np.where(np.arange(n) < 200, 0.0, 5.0)
    steps = np.round(np.sin(np.arange(n) / 30) * 3) / 3
    for y in (chatter, jump, steps, np.zeros(n)):
        assert not find_outliers(of_signal(y)).any()
    pulse = np.zeros(n)
    pulse[100] = 1.0
    answered = np.roll(pulse, 1)
    assert not find_outliers(of_signal(answered, u=pulse)).any()
    assert find_outliers(of_signal(answered)).sum() == 1


def test_two_side_by_side_and_the_ends_of_a_record_are_found():
    y = np.random.default_rng(0).standard_normal(300)
    for places in ([150, 151], [0], [299], [1, 298]):
        struck = y.copy()
        struck[places] = 1e4
        assert np.flatnonzero(find_outliers(of_signal(struck))).tolist() == places


def test_a_record_that_no_likelihood_follows_is_refused(monkeypatch):
    # As users have it, who see no warnings of numpy.
    monkeypatch.setattr(rounding, "HANDLING", dict.fromkeys(rounding.HANDLING, "ignore"))
    loop = bench()
    record = spring(3)
    # From here on the sensor is broken: this is no single reading, and nothing can be learnt.
    y = np.where(np.arange(len(record)) > 1000, 1e200, record.y)
    with pytest.raises(cid.CtrlidError):
        cid.fit_loop(loop, replace(record, y=y))


def test_a_levitated_ball_under_wild_readings_keeps_its_constant():
    """The case that gave K +- 0 and a log-likelihood of -inf."""
    plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    at = cid.operating_point(plant, output=0.012)
    lead = cid.design_lead(cid.linearize(plant, at), crossover=100, phase_margin=50)
    law = ct.ss(lead.sample(0.002, "tustin"))
    rng, n, m, K = np.random.default_rng(4), 2000, 0.0213, 3.34e-6
    r = 0.012 + 1e-4 * np.repeat(rng.choice([-1.0, 1.0], n // 20), 20)
    x, v, z, y, u = 0.012, 0.0, np.zeros(law.nstates), np.zeros(n), np.zeros(n)
    for k in range(n):
        y[k] = x + 2e-6 * rng.standard_normal()
        e = np.array([r[k] - y[k]])
        u[k] = at.input + (law.C @ z + law.D @ e).item()
        z = law.A @ z + law.B @ e
        for _ in range(10):
            v += 2e-4 * (9.81 - K / m * (u[k] / x) ** 2)
            x += 2e-4 * v
    loop = cid.Loop(plant, None, dt=0.002, at=at, free=("K",))
    struck, _ = strike(cid.Record(r=r, u=u, y=y, dt=0.002), 0.02, 400.0)
    estimate = cid.fit_loop(loop.with_parameters({"K": 3e-6}), struck).estimate
    assert estimate["K"] == pytest.approx(K, rel=1e-3)
    assert 0 < estimate.standard_errors[0] < 1e-3 * K
    assert np.isfinite(estimate.log_likelihood)
