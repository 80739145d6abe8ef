"""What every room uses: correlations, autoregressions, the inverse of an information matrix.

And what parameters cost.
"""

import math

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from ctrlid._base.criterion import bayesian_penalty
from ctrlid._base.statistics import (
    autocorrelation_time,
    compute_lagged_products,
    compute_predicted_likelihood,
    fit_autoregression,
    kurtosis_about_zero,
    portmanteau,
    pseudo_inverse,
    reflect_into_circle,
    regress,
)


def test_the_inverse_does_not_depend_on_units():
    rng = np.random.default_rng(1)
    x = rng.standard_normal((50, 4))
    matrix, size = x.T @ x, np.array([1e-8, 1.0, 1e6, 3.0])
    scaled = matrix * np.outer(size, size)
    np.testing.assert_allclose(pseudo_inverse(matrix), np.linalg.inv(matrix), rtol=1e-9)
    expected = np.linalg.inv(matrix) / np.outer(size, size)
    np.testing.assert_allclose(pseudo_inverse(scaled), expected, rtol=1e-9)


def test_a_direction_that_is_not_in_the_data_is_left_out():
    x = np.random.default_rng(2).standard_normal((50, 2))
    twice = np.column_stack([x, x[:, 0]])
    matrix = twice.T @ twice
    inverse = pseudo_inverse(matrix)
    np.testing.assert_allclose(matrix @ inverse @ matrix, matrix, rtol=1e-9)
    assert np.max(np.abs(inverse)) < 1.0


@pytest.mark.parametrize(("n", "samples"), [(1, 100), (2, 45_000), (7, 3.5)])
def test_the_penalty_is_half_that_of_the_criterion(n, samples):
    assert 2 * bayesian_penalty(n, samples) == pytest.approx(n * math.log(samples), rel=1e-15)
    assert bayesian_penalty(n + 1, samples) > bayesian_penalty(n, samples)


# --- correlations


@pytest.mark.parametrize("lags", [0, 3, 50, 51, 200, 299, 400])
def test_products_of_delayed_signals_are_the_same_either_way(lags):
    a, b = np.random.default_rng(3).standard_normal((2, 300))
    expected = [sum(a[k] * b[k - t] for k in range(t, 300)) for t in range(lags + 1)]
    np.testing.assert_allclose(compute_lagged_products(a, b, lags), expected, atol=1e-12)


@pytest.mark.parametrize("power", [1, 3, 4])
@pytest.mark.parametrize("n", [5, 150, 5000])
def test_the_autocorrelation_time_sums_the_correlation_up_to_its_first_zero(n, power):
    e = lfilter([1.0], [1.0, -0.9], np.random.default_rng(n).standard_normal(n))
    rho = np.correlate(e, e, "full")[n - 1 :][: n // 4] / (e @ e)
    positive = rho[1:] if np.all(rho > 0) else rho[1 : np.argmax(rho <= 0)]
    assert autocorrelation_time(e, power) == pytest.approx(1 + 2 * np.sum(positive**power), 1e-11)


def test_an_autoregressive_signal_has_as_many_independent_samples_as_theory_says():
    e = lfilter([1.0], [1.0, -0.8], np.random.default_rng(4).standard_normal(400_000))
    for power in (1, 3, 4):
        expected = (1 + 0.8**power) / (1 - 0.8**power)
        assert autocorrelation_time(e, power) == pytest.approx(expected, rel=0.03)


def test_both_statistics_of_whiteness_agree_in_long_records():
    rho = np.random.default_rng(5).standard_normal(25) / 1000
    weights = 1_000_002 / (1_000_000 - np.arange(1, 26))
    short = portmanteau(rho, 1_000_000, short=True)
    assert short == pytest.approx(1e6 * np.sum(weights * rho**2), rel=1e-13)
    assert portmanteau(rho, 1_000_000, short=False) == pytest.approx(short, rel=1e-4)


def test_a_gaussian_signal_has_kurtosis_three():
    z = np.random.default_rng(10).standard_normal(400_000)
    assert kurtosis_about_zero(2.5 * z) == pytest.approx(3.0, abs=0.04)
    about = np.mean((z + 1) ** 4) / np.mean((z + 1) ** 2) ** 2
    assert kurtosis_about_zero(z + 1) == pytest.approx(about, rel=1e-14)


# --- autoregressions


@pytest.mark.parametrize("poles", [[], [0.5], [0.9, -0.3], [0.8 + 0.5j, 0.8 - 0.5j]])
def test_the_order_of_an_autoregression_is_that_of_the_criterion(poles):
    e = lfilter([1.0], np.poly(poles).real, np.random.default_rng(6).standard_normal(20_000))
    r = compute_lagged_products(e, e, 8)
    # Each order by the normal equations themselves.
    filters = [np.append(1.0, np.linalg.solve(toeplitz(r[:p]), -r[1 : p + 1])) if p else np.ones(1)
               for p in range(9)]  # fmt: skip
    scores = [len(e) * np.log(a @ r[: len(a)]) + (len(a) - 1) * np.log(len(e)) for a in filters]
    found = fit_autoregression(r, len(e))
    np.testing.assert_allclose(found, filters[int(np.argmin(scores))], rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(fit_autoregression(7.3 * r, len(e)), found, rtol=1e-12)
    assert len(found) == len(poles) + 1


def test_nothing_has_no_colour():
    assert fit_autoregression(np.zeros(5), 100).tolist() == [1.0]


def test_what_the_past_tells_is_the_gain_of_the_best_predictor():
    """Of an autoregression of the first order it is that of its one coefficient."""
    products = 5.0 * 0.6 ** np.arange(8)
    told = compute_predicted_likelihood(products, 1000)
    assert told == pytest.approx(-500 * np.log(1 - 0.6**2))
    assert compute_predicted_likelihood(np.eye(8)[0], 1000) == 0.0
    assert compute_predicted_likelihood(np.zeros(5), 100) == 0.0


def test_reflected_roots_leave_the_spectrum_on_the_circle():
    rng = np.random.default_rng(7)
    half = 2 * (rng.random(4) + 1j * rng.random(4))
    roots = np.concatenate([half, half.conj(), [0.0, -3.0]])
    inside = reflect_into_circle(roots, 1 - 1e-9)
    assert np.max(np.abs(inside)) < 1
    w = np.exp(1j * np.linspace(0, 3, 40))
    ratio = np.abs(np.polyval(np.poly(roots), w) / np.polyval(np.poly(inside), w))
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-6)
    kept = np.abs(roots) < 0.9
    np.testing.assert_array_equal(inside[kept], roots[kept])


def test_directions_below_a_given_size_are_left_out():
    q, _ = np.linalg.qr(np.random.default_rng(8).standard_normal((4, 4)))
    q = np.linalg.qr(np.column_stack([np.ones(4), q[:, 1:]]))[0]
    matrix = q @ np.diag([1.0, 1.0, 1e-3, 1.0]) @ q.T
    size = np.sqrt(np.diag(matrix))
    scaled = matrix / np.outer(size, size)
    for smallest in (1e-10, 1e-2):
        expected = np.linalg.pinv(scaled, rcond=smallest)
        np.testing.assert_allclose(pseudo_inverse(scaled, smallest), expected, atol=1e-9)


@pytest.mark.parametrize("q", [(), (2,)])
def test_a_regression_does_not_depend_on_the_units_of_its_columns(q):
    rng = np.random.default_rng(9)
    table, goal = rng.standard_normal((40, 4)), rng.standard_normal((40, *q))
    units = np.array([1e-12, 1.0, 1e8, 1e3])
    plain = regress(table, goal, 1e-10)
    np.testing.assert_allclose(plain, np.linalg.lstsq(table, goal)[0], rtol=1e-11)
    np.testing.assert_allclose((regress(table * units, goal, 1e-10).T * units).T, plain, rtol=1e-11)
    table[:, 2] = 0.0
    assert np.all(regress(table, goal, 1e-10)[2] == 0)
