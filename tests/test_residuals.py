"""Residual tests: false alarms at the rate they promise, shares of variance of the right size."""

import numpy as np
import pytest
from scipy import signal

from ctrlid.validation.residual_tests import (
    autocorrelation,
    compute_explained_share,
    cross_correlation,
)

N, DRAWS = 1000, 1000
ALL = np.ones(N, dtype=bool)


def white(rng, n=N):
    return rng.standard_normal(n)


def coloured(pole):
    def draw(rng, n=N):
        return signal.lfilter([1.0], [1.0, -pole], rng.standard_normal(n + 300))[300:]

    draw.__name__ = f"coloured{pole}"
    return draw


def binary(rng, n=N):
    return np.repeat(rng.choice([-1.0, 1.0], n // 20 + 1), 20)[:n]


def test_whiteness_false_alarms():
    rng = np.random.default_rng(1)
    found = [autocorrelation(white(rng), ALL) for _ in range(DRAWS)]
    rate = np.mean([not c.passed for c in found])
    assert 0.003 <= rate <= 0.02  # 1 %, three standard deviations
    beyond = np.mean([np.abs(c.values) > c.band for c in found])
    assert beyond == pytest.approx(0.01, abs=0.003)
    assert found[0].band == pytest.approx(2.576 / np.sqrt(N), rel=1e-3)
    np.testing.assert_array_equal(found[0].lags, np.arange(1, 26))


@pytest.mark.parametrize(
    ("e", "s"),
    [
        (white, white),
        (white, coloured(0.95)),
        (white, binary),
        (coloured(0.7), coloured(0.7)),
        (coloured(-0.8), coloured(0.5)),
        (coloured(0.8), binary),
    ],
)
def test_cross_correlation_false_alarms(e, s):
    """The band of white residuals, 1/sqrt(N), would be far too narrow for the coloured ones."""
    rng = np.random.default_rng(2)
    found = [cross_correlation(e(rng), s(rng), ALL, "u") for _ in range(DRAWS)]
    # Estimated colours: within a few per mille of 1 %, never several per cent.
    assert np.mean([not c.passed for c in found]) <= 0.03
    beyond = np.mean([np.abs(c.values) > c.band for c in found])
    assert 0.004 <= beyond <= 0.018


def test_dependence_is_found():
    rng = np.random.default_rng(13)
    s = coloured(0.5)(rng, 2000)
    e = rng.standard_normal(2000) + 0.25 * np.r_[0, 0, 0, s[:-3]]
    every = np.ones(2000, dtype=bool)
    found = cross_correlation(e, s, every, "r", first=0)
    assert not found.passed
    assert found.name == "with past r"
    assert found.lags[np.argmax(np.abs(found.values))] == 3
    assert found.share == pytest.approx(np.var(0.25 * s) / np.var(e), abs=0.02)
    # What happened after it says nothing about a residual's past.
    assert cross_correlation(s, e, every, "e").passed
    own = autocorrelation(coloured(0.6)(rng, 2000), every)
    assert not own.passed
    assert own.values[0] == pytest.approx(0.6, abs=0.06)
    assert own.share == pytest.approx(0.36, abs=0.06)


def test_certain_and_negligible_are_told_apart():
    rng = np.random.default_rng(4)
    n = 200_000
    e = coloured(0.03)(rng, n)
    found = autocorrelation(e, np.ones(n, dtype=bool))
    assert found.p_value < 1e-9
    assert found.share < 0.002


def test_samples_that_do_not_count_add_nothing():
    rng = np.random.default_rng(5)
    e, s = rng.standard_normal((2, N))
    valid = np.ones(N, dtype=bool)
    valid[300:500] = False
    soiled, other = e.copy(), s.copy()
    soiled[300:500], other[300:500] = 1e6, -1e6
    for test in (
        lambda a, b: autocorrelation(a, valid),
        lambda a, b: cross_correlation(a, b, valid, "u"),
    ):
        one, two = test(e, s), test(soiled, other)
        np.testing.assert_array_equal(one.values, two.values)
        assert one.p_value == two.p_value > 0.001
    assert compute_explained_share(soiled, [(other, 1)], valid) == 0.0


def test_signals_that_do_not_move():
    rng = np.random.default_rng(6)
    e = rng.standard_normal(N)
    still = cross_correlation(e, np.full(N, 3.0), ALL, "r")
    assert still.passed
    assert still.band == np.inf
    assert autocorrelation(np.full(N, 2.0), ALL).share == 0
    assert compute_explained_share(np.full(N, 2.0), [(e, 1)], ALL) == 0
    assert compute_explained_share(e, [], ALL) == 0
    assert compute_explained_share(e[:20], [(e[:20], 1)], ALL[:20]) == 0
    assert autocorrelation(e, np.zeros(N, dtype=bool)).passed


@pytest.mark.parametrize("colour", [white, coloured(0.8), coloured(0.95)])
@pytest.mark.parametrize("s", [white, coloured(0.9), binary])
def test_independent_signals_explain_nothing(colour, s):
    rng = np.random.default_rng(7)
    n = 3000
    every = np.ones(n, dtype=bool)
    shares = [
        compute_explained_share(colour(rng, n), [(s(rng, n), 1), (white(rng, n), 3)], every)
        for _ in range(40)
    ]
    assert np.mean(np.array(shares) > 0.05) <= 0.05
    assert np.mean(shares) < 0.01


@pytest.mark.parametrize("share", [0.03, 0.2, 0.8, 0.98])
@pytest.mark.parametrize("n", [5000, 120_000])
def test_the_share_that_follows_a_signal_is_measured(share, n):
    rng = np.random.default_rng(8)
    s, noise = coloured(0.9)(rng, n), coloured(0.5)(rng, n)
    moved = signal.lfilter([0, 0, 1.0, -0.4], [1.0], s)
    e = np.sqrt(share) * moved / moved.std() + np.sqrt(1 - share) * noise / noise.std() + 7.0
    every = np.ones(n, dtype=bool)
    assert compute_explained_share(e, [(s, 1)], every) == pytest.approx(share, abs=0.02)
    # From the eleventh sample before on, less of it can be known.
    assert compute_explained_share(e, [(s, 11)], every) < 0.6 * share


def test_an_exact_relation_is_the_whole_share():
    rng = np.random.default_rng(9)
    s = rng.standard_normal(N)
    assert compute_explained_share(np.r_[0, s[:-1]], [(s, 1)], ALL) == pytest.approx(1.0, abs=1e-9)
