"""Whether residuals are white and independent of the signals, and how much is at stake if not."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import linalg, signal, stats

from .._base.arrays import Array, freeze_arrays
from .._base.statistics import (
    compute_lagged_products,
    compute_whiteness_probability,
    fit_autoregression,
)
from .._base.text import Printed, write_percent
from ..data.validity import find_whole_past

# The bands and tests have this probability of covering what chance does.
LEVEL = 0.99
# Correlations of residuals are computed over at most so many samples.
MEMORY = 1000
# The autoregression that describes the colour of residuals has at most this order.
MOST_ORDER = 40
# More rows of a regression add nothing to the few digits of a share.
ROWS = 50_000


@dataclass(frozen=True, eq=False, repr=False)
class Correlation(Printed):
    """A correlation function of residuals with its confidence band and test.

    Parameters
    ----------
    name : str
        What the residuals are correlated with, as in ``"with past u"``.
    lags : ndarray of int
        Lags in samples; at lag tau the residual is compared with the signal tau samples before.
    values : ndarray
        Correlation coefficients.
    band : float
        Half width that a coefficient exceeds by chance in one of a hundred cases.
    p_value : float
        Probability of coefficients as large as these, taken together, by chance.
    share : float
        Share of the residuals' variance that the signal's past accounts for, less what chance
        gives. In long records a correlation can be certain and yet negligible: the p-value tells
        the one, the share the other.
    """

    name: str
    lags: Any
    values: Array
    band: float
    p_value: float
    share: float = 0.0

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    def passed(self) -> bool:
        """Whether chance explains the correlations at the 1 % level."""
        return self.p_value >= 1 - LEVEL

    def __str__(self) -> str:
        worst = int(np.argmax(np.abs(self.values)))
        judged = "passed" if self.passed else f"NOT PASSED, {write_percent(self.share)} of variance"
        return (f"correlation {self.name}: largest {self.values[worst]:+.3f} at lag "
                f"{self.lags[worst]}, chance gives ±{self.band:.3f}, p = {self.p_value:.2g}: "
                f"{judged}")  # fmt: skip


def autocorrelation(e: Array, valid: Any, lags: int = 25, fitted: int = 0) -> Correlation:
    r"""Test whether residuals are white.

    .. math:: \hat\rho(\tau) = \frac{\sum_k e_k e_{k-\tau}}{\sum_k e_k^2}, \quad
        Q = N (N + 2) \sum_\tau \frac{\hat\rho(\tau)^2}{N - \tau}

    White residuals have coefficients with standard deviation 1/sqrt(N), and Q follows a chi-square
    law with as many degrees of freedom as lags less fitted coefficients.

    Parameters
    ----------
    e : ndarray, shape (n,)
        Residuals.
    valid : ndarray of bool, shape (n,)
        Samples that count.
    lags : int, optional
        Number of lags.
    fitted : int, optional
        Number of coefficients fitted on these very data.

    Returns
    -------
    Correlation
        Lags 1 to `lags`.

    References
    ----------
    Ljung and Box, Biometrika 65 (1978) 297-303.
    """
    e, n = _remove_mean(e, valid)
    c = compute_lagged_products(e, e, lags)
    rho = c[1:] / c[0] if c[0] > 0 else np.zeros(lags)
    tau = np.arange(1, lags + 1)
    band = float(stats.norm.ppf(0.5 + LEVEL / 2) / np.sqrt(n))
    p = compute_whiteness_probability(rho, n, fitted)
    share = 0.0
    if c[0] > 0:
        # What the best prediction from this many past residuals would take away.
        whole = linalg.toeplitz(np.concatenate([[1.0], rho[:-1]])) + 1e-12 * np.eye(lags)
        share = _subtract_chance(float(rho @ np.linalg.solve(whole, rho)), lags / n)
    return Correlation("with their own past", tau, rho, band, p, share)


def _subtract_chance(raw: float, chance: float) -> float:
    """Return a share of variance less what a fit to independent signals takes by chance."""
    return float(np.clip((raw - chance) / max(1 - chance, 1e-12), 0.0, 1.0))


def _smooth_autocovariance(e: Array, n: int, memory: int) -> Array:
    """Return the autocovariance of residuals up to a lag, as an autoregression continues it.

    The order is chosen by the Bayesian information criterion: white residuals stay white.
    """
    order = min(MOST_ORDER, n // 20, memory)
    r = compute_lagged_products(e, e, order) / len(e)
    a = fit_autoregression(r, n)
    p = len(a) - 1
    out = np.zeros(memory + 1)
    out[: p + 1] = r[: p + 1]
    for k in range(p + 1, memory + 1 if p else 0):
        out[k] = -float(a[1:] @ out[k - 1 : k - p - 1 : -1])
    return out


def cross_correlation(
    e: Array, s: Array, valid: Any, name: str, lags: int = 25, first: int = 1
) -> Correlation:
    r"""Test whether residuals are independent of a signal's past.

    .. math:: N \operatorname{cov}\bigl(\hat R_{es}(i), \hat R_{es}(j)\bigr) \to
        \sum_l R_e(l) R_s(l + i - j)

    Under feedback only the past of u says something: its future contains the residual.

    Parameters
    ----------
    e, s : ndarray, shape (n,)
        Residuals and signal.
    valid : ndarray of bool, shape (n,)
        Samples that count.
    name : str
        Name of the signal.
    lags : int, optional
        Number of lags.
    first : int, optional
        The smallest lag: 1 for u, 0 for a reference.

    Returns
    -------
    Correlation
        Lags `first` to `first + lags - 1`.

    References
    ----------
    Ljung, *System Identification*, 2nd edition, section 16.6.
    """
    e, n = _remove_mean(e, valid)
    s, _ = _remove_mean(s, valid)
    tau = np.arange(first, first + lags)
    r = compute_lagged_products(e, s, int(tau[-1]))[tau] / len(e)
    memory = min(n // 10, MEMORY)
    re, rs = (
        _smooth_autocovariance(e, n, memory),
        compute_lagged_products(s, s, memory + lags) / len(s),
    )
    scale = np.sqrt(re[0] * rs[0])
    if scale <= 0:
        return Correlation(f"with past {name}", tau, np.zeros(lags), np.inf, 1.0)
    two_sided_e = np.concatenate([re[:0:-1], re])
    shifted = [
        float(two_sided_e @ rs[np.abs(np.arange(-memory, memory + 1) + k)]) for k in range(lags)
    ]
    row = np.array(shifted)
    row[0] = max(row[0], 1e-300)
    band = float(stats.norm.ppf(0.5 + LEVEL / 2) * np.sqrt(row[0] / n) / scale)
    # Signals that move slowly make neighbouring lags nearly the same number.
    z = _compute_whitening(linalg.toeplitz(row), 1e-6).T @ r * np.sqrt(n)
    p = float(stats.chi2.sf(float(z @ z), len(z)))
    share = _compute_share(r, rs[:lags], re[0], linalg.toeplitz(row) / n)
    return Correlation(f"with past {name}", tau, r / scale, band, p, share)


def _compute_whitening(covariance: Array, smallest: float) -> Array:
    """Return directions in which signals of this covariance are independent and of size one.

    Directions with a smaller eigenvalue, relative to the largest one, are rounding errors.
    """
    values, vectors = linalg.eigh(covariance)
    keep = values > smallest * max(values.max(), 1e-300)
    return np.asarray(vectors[:, keep] / np.sqrt(values[keep]), dtype=float)


def _compute_share(r: Array, rs: Array, variance: float, covariance: Array) -> float:
    """Return the share of the variance that a regression on the lagged signal would explain."""
    basis = _compute_whitening(linalg.toeplitz(rs), 1e-6)
    raw = float(np.sum((basis.T @ r) ** 2)) / variance
    chance = float(np.trace(basis.T @ covariance @ basis)) / variance
    return _subtract_chance(raw, chance)


def _remove_mean(e: Array, valid: Any) -> tuple[Array, int]:
    """Remove the mean; samples that do not count become zero and so add nothing to any sum."""
    n = int(np.count_nonzero(valid))
    centred = np.where(valid, e - np.mean(e[valid]), 0.0) if n else np.zeros(len(e))
    return centred, max(n, 1)


def compute_explained_share(
    e: Array, signals: Sequence[tuple[Array, int]], valid: Any, lags: int = 30
) -> float:
    r"""Return the share of the residuals' variance that follows the past of some signals.

    A linear regression on `lags` past samples of each signal. What it would take from residuals of
    this colour by chance is taken off:

    .. math:: \frac{R^2 - c}{1 - c}, \quad c = \frac{1}{N} \sum_i \sum_l
        \rho_e(l) \sum_k v_{i,k} v_{i,k+l}

    with the regression's orthonormal directions :math:`v_i`; for white residuals c is the number of
    coefficients over N. A share within what chance does now and then is none.

    Parameters
    ----------
    e : ndarray, shape (n,)
        Residuals.
    signals : sequence of (ndarray, int)
        Signals that the residuals should be independent of, each with the smallest lag from
        which they should be.
    valid : ndarray of bool, shape (n,)
        Samples that count.
    lags : int, optional
        Past samples of each signal.

    Returns
    -------
    float
        Between 0 (chance can do it) and 1.
    """
    valid = np.asarray(valid)
    # Nothing follows a signal that does not move.
    signals = [(s, delay) for s, delay in signals if np.ptp(s[valid]) > 0]
    lags = max(1, min(lags, len(e) // (10 * max(len(signals), 1))))
    first = max((delay for _, delay in signals), default=0) + lags - 1
    rows = np.arange(first, len(e), max(1, -(-len(e) // ROWS)))
    rows = rows[find_whole_past(valid, first)[rows]]
    if not signals or len(rows) < 3 * lags * len(signals):
        return 0.0
    target = e[rows] - np.mean(e[rows])
    total = float(target @ target)
    if total == 0:
        return 0.0
    past = np.column_stack(
        [s[rows - delay - k] for s, delay in signals for k in range(lags)]
    )  # fmt: skip
    past -= past.mean(axis=0)
    scale = np.linalg.norm(past, axis=0)
    past /= np.where(scale > 0, scale, 1.0)
    # The share needs few digits, so that the small normal matrix is accurate enough.
    basis = past @ _compute_whitening(past.T @ past, 1e-9)
    along = basis.T @ target
    left = target - basis @ along
    n = len(rows)
    rho = _smooth_autocovariance(left, n, min(n // 10, MEMORY))
    if rho[0] <= 0:
        return 1.0
    # Under independence the squared components along the basis are this matrix on average.
    kernel = np.concatenate([rho[:0:-1], rho]) / rho[0]
    coloured = np.column_stack([signal.fftconvolve(v, kernel, "same") for v in basis.T])
    spread = basis.T @ coloured / n
    chance = float(np.trace(spread))
    raw = float(along @ along) / total
    if raw < chance + 3 * np.sqrt(2 * np.sum(spread**2)):
        return 0.0
    return _subtract_chance(raw, min(max(chance, 0.0), 0.9))
