"""Whether residuals are white and independent of the signals, with bands that mean what they say."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import linalg, signal, stats

from .physics import Array

LEVEL = 0.99  # of the drawn bands and of the tests


@dataclass(frozen=True, eq=False)
class Correlation:
    """A correlation function of residuals with its confidence band and test.

    Attributes
    ----------
    name : str
        What is correlated.
    lags : ndarray of int
        Lags in samples; at lag tau the residual is compared with the signal tau samples before.
    values : ndarray
        Correlation coefficients.
    band : float
        Half width that a coefficient exceeds by chance in one of a hundred cases.
    p_value : float
        Probability of coefficients as large as these, taken together, by chance.
    """

    name: str
    lags: Any
    values: Array
    band: float
    p_value: float

    @property
    def passed(self) -> bool:
        """Whether chance explains the correlations at the 1 % level."""
        return self.p_value >= 1 - LEVEL


def _covariance(a: Array, b: Array, lags: int) -> Array:
    """Return ``mean(a[k] b[k - tau])`` for tau = 0..lags, by FFT."""
    full = signal.fftconvolve(a, b[::-1])
    middle = len(b) - 1
    return np.asarray(full[middle : middle + lags + 1] / len(a), dtype=float)


def autocorrelation(e: Array, valid: Any, lags: int = 25, fitted: int = 0) -> Correlation:
    """Test whether residuals are white.

    .. math:: \\hat\\rho(\\tau) = \\frac{\\sum_k e_k e_{k-\\tau}}{\\sum_k e_k^2}, \\quad
        Q = N (N + 2) \\sum_\\tau \\frac{\\hat\\rho(\\tau)^2}{N - \\tau}

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
    e, n = _centred(e, valid)
    c = _covariance(e, e, lags)
    rho = c[1:] / c[0] if c[0] > 0 else np.zeros(lags)
    tau = np.arange(1, lags + 1)
    q = n * (n + 2) * np.sum(rho**2 / np.maximum(n - tau, 1))
    band = float(stats.norm.ppf(0.5 + LEVEL / 2) / np.sqrt(n))
    p = float(stats.chi2.sf(q, max(lags - fitted, 1)))
    return Correlation("residual with its own past", tau, rho, band, p)


def cross_correlation(
    e: Array, s: Array, valid: Any, name: str, lags: int = 25, first: int = 1
) -> Correlation:
    """Test whether residuals are independent of a signal's past.

    .. math:: N \\operatorname{cov}\\bigl(\\hat R_{es}(i), \\hat R_{es}(j)\\bigr) \\to
        \\sum_l R_e(l) R_s(l + i - j)

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
    e, n = _centred(e, valid)
    s, _ = _centred(s, valid)
    tau = np.arange(first, first + lags)
    r = _covariance(e, s, int(tau[-1]))[tau]
    memory = min(n // 10, 200)
    re, rs = _covariance(e, e, memory), _covariance(s, s, memory + lags)
    scale = np.sqrt(re[0] * rs[0])
    if scale <= 0:
        return Correlation(f"residual with past {name}", tau, np.zeros(lags), np.inf, 1.0)
    # Beyond the noise of their own estimate, and with a window that keeps the matrix positive.
    re = re * (1 - np.arange(memory + 1) / (memory + 1))
    re[1:][np.abs(re[1:]) < 2.6 * re[0] / np.sqrt(n)] = 0.0
    two_sided_e = np.concatenate([re[:0:-1], re])
    shifted = [
        float(two_sided_e @ rs[np.abs(np.arange(-memory, memory + 1) + k)]) for k in range(lags)
    ]
    row = np.array(shifted)
    row[0] = max(row[0], 1e-300)
    band = float(stats.norm.ppf(0.5 + LEVEL / 2) * np.sqrt(row[0] / n) / scale)
    # Signals that move slowly make neighbouring lags nearly the same number.
    values, vectors = linalg.eigh(linalg.toeplitz(row))
    keep = values > 1e-6 * values.max()
    z = vectors[:, keep].T @ r / np.sqrt(values[keep] / n)
    p = float(stats.chi2.sf(float(z @ z), int(keep.sum())))
    return Correlation(f"residual with past {name}", tau, r / scale, band, p)


def _centred(e: Array, valid: Any) -> tuple[Array, int]:
    """Remove the mean; samples that do not count become zero and so add nothing to any sum."""
    n = int(np.count_nonzero(valid))
    centred = np.where(valid, e - np.mean(e[valid]), 0.0) if n else np.zeros(len(e))
    return centred, max(n, 1)


def explained_share(e: Array, signals: list[Array], valid: Any, lags: int = 30) -> float:
    """Return the share of the residuals' variance that follows the past of some signals.

    A linear regression on `lags` past samples of each signal, its R squared corrected for the number
    of coefficients.

    Parameters
    ----------
    e : ndarray, shape (n,)
        Residuals.
    signals : list of ndarray, shape (n,)
        Signals that the residuals should be independent of.
    valid : ndarray of bool, shape (n,)
        Samples that count.
    lags : int, optional
        Past samples of each signal.

    Returns
    -------
    float
        Between 0 (chance alone) and 1.
    """
    lags = max(1, min(lags, len(e) // (10 * max(len(signals), 1))))
    windows = np.lib.stride_tricks.sliding_window_view
    usable = windows(valid, lags + 1).all(axis=1)
    target = e[lags:][usable]
    if not signals or len(target) < 3 * lags * len(signals):
        return 0.0
    past = np.hstack([windows(s, lags + 1)[usable, :-1] for s in signals])
    past = past - past.mean(axis=0)
    target = target - target.mean()
    total = float(target @ target)
    if total == 0:
        return 0.0
    scale = np.linalg.norm(past, axis=0)
    past = past / np.where(scale > 0, scale, 1.0)
    # Through the normal matrix: the share needs few digits, the matrix is small.
    values, vectors = linalg.eigh(past.T @ past)
    keep = values > 1e-9 * values.max()
    z = (vectors[:, keep].T @ (past.T @ target)) / np.sqrt(values[keep])
    n, p = len(target), int(keep.sum())
    raw = float(z @ z) / total
    return float(np.clip(1 - (1 - raw) * (n - 1) / max(n - p - 1, 1), 0.0, 1.0))
