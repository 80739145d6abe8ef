"""Statistics that several rooms need: correlations, autoregressions, information matrices."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike
from scipy import signal, stats

from .arrays import Array, ComplexArray
from .criterion import bayesian_penalty

SINGULAR = 1e-10  # A direction with a smaller relative eigenvalue is not in the data.
MEDIAN_TO_DEVIATION = 1.4826  # One over the median of a standard Gaussian variable's size.
FEW_LAGS = 50  # Up to so many, products lag by lag are faster than by Fourier transform.


def compute_lagged_products(a: Array, b: Array, lags: int) -> Array:
    r"""Return the sums of products of two signals, the second one delayed.

    .. math:: S(\tau) = \sum_k a_k \, b_{k - \tau}, \quad \tau = 0, \dots, n_\tau

    Parameters
    ----------
    a, b : ndarray, shape (n,)
        Signals of the same length.
    lags : int
        The largest delay [samples].

    Returns
    -------
    ndarray, shape (lags + 1,)
        The sums [product of the units]; zero from lag n on.

    Examples
    --------
    >>> compute_lagged_products(np.array([1.0, 2.0, 3.0]), np.array([1.0, 0.0, 1.0]), 3)
    array([4., 2., 3., 0.])
    """
    n = len(a)
    if lags <= FEW_LAGS:
        return np.array([a[t:] @ b[: max(n - t, 0)] for t in range(lags + 1)], dtype=float)
    sums = np.zeros(lags + 1)
    whole = signal.fftconvolve(a, b[::-1])[n - 1 : n + lags]
    sums[: len(whole)] = whole
    return sums


def autocorrelation_time(e: Array, power: int = 1) -> float:
    r"""Return how many neighbouring samples say no more than one that is independent.

    .. math:: 1 + 2 \sum_{\tau \ge 1} \rho(\tau)^p

    as far as the autocorrelation :math:`\rho` stays positive, over a quarter of the signal at most.
    N samples are worth N over this number of independent ones; of a Gaussian signal that holds
    for its moment of order p.

    Parameters
    ----------
    e : ndarray, shape (n,)
        Signal, of mean zero.
    power : int, optional
        Order p of the moment.

    Returns
    -------
    float
        The time [samples], at least 1.

    References
    ----------
    Priestley, *Spectral Analysis and Time Series*, section 5.3.2; Lobato and Velasco, Econometric
    Theory 20 (2004) 671-689.

    Examples
    --------
    >>> white = np.random.default_rng(0).standard_normal(100_000)
    >>> round(autocorrelation_time(signal.lfilter([1.0], [1.0, -0.8], white)))
    9
    """
    products = compute_lagged_products(e, e, max(len(e) // 4 - 1, 0))
    rho = products / max(products[0], 1e-300)
    ends = np.flatnonzero(rho <= 0)
    return float(1 + 2 * np.sum(rho[1 : ends[0] if len(ends) else len(rho)] ** power))


def kurtosis_about_zero(z: Array) -> float:
    r"""Return how heavy the tails of a signal are that has mean zero by law.

    .. math:: \overline{z^4} / \bigl(\overline{z^2}\bigr)^2

    Parameters
    ----------
    z : ndarray, shape (n,)
        Signal.

    Returns
    -------
    float
        The ratio: 3 for a Gaussian signal, 1 for one of constant size.

    Examples
    --------
    >>> kurtosis_about_zero(np.array([1.0, -1.0, 1.0, 1.0]))
    1.0
    """
    return float(np.mean(z**4) / np.mean(z**2) ** 2)


def robust_deviation(e: Array) -> float:
    r"""Return the standard deviation of errors about zero, as their middle half tells it.

    .. math:: 1.4826 \operatorname{med} |e|

    For Gaussian errors it is the standard deviation; a few outliers do not move it.

    Parameters
    ----------
    e : ndarray
        Errors.

    Returns
    -------
    float
        The deviation [unit of the errors].

    Examples
    --------
    >>> robust_deviation(np.array([1.0, -1.0, 1.0, 1e6]))
    1.4826
    """
    return MEDIAN_TO_DEVIATION * float(np.median(np.abs(e)))


def portmanteau(rho: Array, samples: int, short: bool) -> float:
    r"""Return how large autocorrelations are together.

    .. math:: N \sum_\tau \hat\rho(\tau)^2 \quad \text{or} \quad
        N (N + 2) \sum_\tau \frac{\hat\rho(\tau)^2}{N - \tau}

    Of white noise both follow a chi-square law with as many degrees of freedom as lags; the
    second one, of Ljung and Box, in short records too.

    Parameters
    ----------
    rho : ndarray
        Autocorrelations at lags 1, 2, ...
    samples : int
        Number N of samples.
    short : bool
        Whether to take the second one.

    Returns
    -------
    float
        The statistic.

    References
    ----------
    Box and Pierce, Journal of the American Statistical Association 65 (1970) 1509-1526; Ljung and
    Box, Biometrika 65 (1978) 297-303.

    Examples
    --------
    >>> rho = np.array([0.1, 0.05])
    >>> round(portmanteau(rho, 100, short=False), 4), round(portmanteau(rho, 100, short=True), 4)
    (1.25, 1.2905)
    """
    if not short:
        return samples * float(np.sum(rho**2))
    left = np.maximum(samples - np.arange(1, len(rho) + 1), 1)
    return samples * (samples + 2) * float(np.sum(rho**2 / left))


def compute_whiteness_probability(rho: Array, samples: int, fitted: int) -> float:
    """Return the probability that white noise has as large autocorrelations (Ljung and Box).

    Parameters
    ----------
    rho : ndarray
        Autocorrelations at lags 1, 2, ...
    samples : int
        Number of samples.
    fitted : int
        Number of coefficients fitted on these very data, each of which takes a degree of freedom.

    Returns
    -------
    float
        The probability.

    Examples
    --------
    >>> round(compute_whiteness_probability(np.array([0.1, 0.05]), 100, 0), 3)
    0.525
    """
    degrees = max(len(rho) - fitted, 1)
    return float(stats.chi2.sf(portmanteau(rho, samples, short=True), degrees))


def fit_autoregression(products: Array, samples: float) -> Array:
    r"""Return the autoregression of a signal with the order that the Bayesian criterion prefers.

    .. math:: e_k + a_1 e_{k-1} + \dots + a_p e_{k-p} = \varepsilon_k, \quad
        N \ln \sigma_\varepsilon^2 + p \ln N \to \min

    By the recursion of Levinson and Durbin, which needs the autocovariances only.

    Parameters
    ----------
    products : ndarray, shape (highest order + 1,)
        Autocovariances of the signal from lag 0 on, or any multiple of them.
    samples : float
        Number N of samples behind them.

    Returns
    -------
    ndarray, shape (order + 1,)
        The filter ``1, a1, ...`` that whitens the signal, always minimum phase; ``[1]`` for a white
        one.

    References
    ----------
    Durbin, Review of the International Statistical Institute 28 (1960) 233-244; Schwarz, Annals of
    Statistics 6 (1978) 461-464.

    Examples
    --------
    >>> fit_autoregression(0.8 ** np.arange(6), 1000)
    array([ 1. , -0.8])
    """
    chosen, least = np.ones(1), 0.0
    for a, share in _list_autoregressions(products):
        score = samples * math.log(share) + 2 * bayesian_penalty(len(a) - 1, samples)
        if score < least:
            least, chosen = score, a
    return chosen


def _list_autoregressions(products: Array) -> Iterator[tuple[Array, float]]:
    """Yield the whitening filter of each order, and the share of variance that it leaves."""
    a, share = np.ones(1), 1.0
    if products[0] <= 0:
        return
    for order in range(1, len(products)):
        reflection = -float(a @ products[order:0:-1]) / (share * products[0])
        a = np.append(a, 0.0) + reflection * np.append(a, 0.0)[::-1]
        share *= 1 - reflection**2
        if share <= 0:
            return
        yield a, share


def compute_predicted_likelihood(products: Array, samples: float) -> float:
    r"""Return what the past of a signal tells of it, as a gain of log-likelihood.

    .. math:: \tfrac{N}{2} \ln \frac{\sigma_e^2}{\sigma_\varepsilon^2}

    for the autoregression of the highest order, whose errors are :math:`\varepsilon`.

    Parameters
    ----------
    products : ndarray, shape (highest order + 1,)
        Autocovariances of the signal from lag 0 on, or any multiple of them.
    samples : float
        Number N of samples behind them.

    Returns
    -------
    float
        The gain; that of white noise is about half the order, by chance.

    Examples
    --------
    >>> round(compute_predicted_likelihood(0.8 ** np.arange(6), 1000), 1)
    510.8
    """
    shares = [1.0, *(share for _, share in _list_autoregressions(products))]
    return -0.5 * samples * math.log(shares[-1])


def reflect_into_circle(roots: ArrayLike, largest: float) -> ComplexArray:
    r"""Return roots with those outside the unit circle reflected into it.

    .. math:: z \to 1 / \bar z

    The polynomial keeps its amplitude on the circle, up to a factor: the spectrum of a noise does
    not tell the two apart. Roots on the circle or close to it are drawn in.

    Parameters
    ----------
    roots : ndarray of complex
        Roots of a polynomial in z.
    largest : float
        Largest absolute value that is left, below 1.

    Returns
    -------
    ndarray of complex
        The roots.

    References
    ----------
    Åström, *Introduction to Stochastic Control Theory*, chapter 4 (spectral factorization).

    Examples
    --------
    >>> reflect_into_circle(np.array([2.0 + 0j, 0.3, -1.0]), 0.99).real
    array([ 0.5 ,  0.3 , -0.99])
    """
    z = np.array(roots, dtype=complex)
    outside = np.abs(z) > 1
    z[outside] = 1 / z[outside].conj()
    edge = np.abs(z) > largest
    z[edge] *= largest / np.abs(z[edge])
    return z


def regress(table: Array, goal: Array, smallest: float) -> Array:
    r"""Return the coefficients of a regression on columns of any size.

    .. math:: \min_\theta \| y - X \theta \|

    The columns are brought to size one before it is judged which directions they determine.

    Parameters
    ----------
    table : ndarray, shape (n, p)
        Regressors X, a column each.
    goal : ndarray, shape (n,) or (n, q)
        What they should give, y.
    smallest : float
        Directions with a smaller singular value, relative to the largest one, are left out.

    Returns
    -------
    ndarray, shape (p,) or (p, q)
        The coefficients; zero for a column of zeros.

    Examples
    --------
    >>> table = np.array([[1.0, 0.0], [1.0, 1e-20], [1.0, 2e-20]])
    >>> regress(table, np.array([1.0, 3.0, 5.0]), 1e-12)
    array([1.e+00, 2.e+20])
    """
    size = np.linalg.norm(table, axis=0)
    size[size == 0] = 1.0
    scaled = np.linalg.lstsq(table / size, goal, rcond=smallest)[0]
    return np.asarray((scaled.T / size).T, dtype=float)


def pseudo_inverse(matrix: Array, smallest: float = SINGULAR) -> Array:
    """Invert an information matrix, leaving out directions that are not in the data.

    Parameters
    ----------
    matrix : ndarray, shape (p, p)
        Information of p parameters; their units do not matter.
    smallest : float, optional
        Directions with a smaller eigenvalue, relative to the largest one, are left out.

    Returns
    -------
    ndarray, shape (p, p)
        The inverse where the data determine the parameters.
    """
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
    keep = values > smallest * values.max(initial=0.0)
    inverse = (vectors[:, keep] / values[keep]) @ vectors[:, keep].T
    return np.asarray(inverse / np.outer(size, size), dtype=float)


def sum_with_correlations(g: Array) -> Array:
    r"""Return the covariance of the sum of correlated rows (Newey, West).

    .. math:: \sum_{|l| \le L} \Bigl(1 - \frac{|l|}{L + 1}\Bigr) \sum_k g_k g_{k - l}^T, \quad
        L = \lceil 1.5\, n^{1/3} \rceil

    Parameters
    ----------
    g : ndarray, shape (n, p)
        Rows of mean zero, such as the scores of the samples.

    Returns
    -------
    ndarray, shape (p, p)
        The covariance.

    References
    ----------
    Newey and West, Econometrica 55 (1987) 703-708.
    """
    lags = min(int(np.ceil(1.5 * len(g) ** (1 / 3))), max(len(g) - 1, 0))
    total = g.T @ g
    for lag in range(1, lags + 1):
        both = g[lag:].T @ g[: len(g) - lag] * (1 - lag / (lags + 1))
        total = total + both + both.T
    return np.asarray(total)


def rounding_variance(step: ArrayLike) -> Array:
    r"""Return the variance that rounding to steps q adds, :math:`q^2 / 12`."""
    return np.asarray(np.square(step) / 12, dtype=float)
