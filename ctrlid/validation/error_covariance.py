"""How uncertain least squares are whose errors are correlated in time and between outputs."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import ndimage

from .._base.arrays import Array, ComplexArray
from .._base.criterion import bayesian_penalty
from .._base.statistics import pseudo_inverse

# Orders of the autoregression that describes the errors, of which a criterion chooses one.
ORDERS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
# A record must have so many samples for each value that is estimated of it.
SAMPLES_PER_VALUE = 10
# A periodogram is averaged over so many square roots of n frequencies to both sides, so that it is
# known within a quarter at a thousand samples.
WIDTH = 0.25
# The fit takes at most the rest of this share out of a frequency, or nothing could be said of it.
LEFT = 0.1


def compute_score_covariance(
    slopes: Sequence[Array], errors: Sequence[Array], find_shape: Callable[[Array], ComplexArray]
) -> Array:
    r"""Return the covariance of the score of least squares under correlated errors.

    .. math:: \operatorname{cov} \sum_k \psi_k^T e_k = \frac{1}{n} \sum_\omega
        \Psi^*(\omega)\, \Phi_e(\omega)\, \Psi(\omega)

    with the slopes :math:`\psi_k`, which do not depend on the errors, and the spectrum
    :math:`\Phi_e` of the errors. That is their periodogram, averaged over neighbouring frequencies
    behind two filters that make it nearly flat: what the loop makes of noise, since it may ring
    where its references move it, and an autoregression. What the fit took out of each frequency is
    put back.

    Parameters
    ----------
    slopes : sequence of ndarray, shape (n, outputs, q)
        Derivatives of the errors by q values, for each stretch.
    errors : sequence of ndarray, shape (n, outputs)
        The errors of each stretch, of mean zero.
    find_shape : callable
        Returns how the loop amplifies noise of the sensors, shape (frequencies, outputs, outputs),
        at frequencies [rad/sample].

    Returns
    -------
    ndarray, shape (q, q)
        The covariance.

    References
    ----------
    Ljung, *System Identification*, section 9.3; Andrews and Monahan, "An improved
    heteroskedasticity and autocorrelation consistent covariance matrix estimator", Econometrica 60
    (1992) 953-966; MacKinnon and White, Journal of Econometrics 29 (1985) 305-325, on what the fit
    takes out.
    """
    inverse = pseudo_inverse(sum(np.einsum("kja,kjb->ab", part, part) for part in slopes))
    quiet: list[tuple[Any, Any, Any]] = []
    for part, error in zip(slopes, errors, strict=True):
        n = len(error)
        seen, left = np.fft.fft(part, axis=0), np.fft.fft(error, axis=0)
        taken = np.einsum("fja,ab,fjb->fj", seen.conj(), inverse, seen, optimize=True).real / n
        left = left / np.sqrt(np.maximum(1 - taken, LEFT))
        shape = find_shape(np.asarray(2 * np.pi * np.fft.fftfreq(n), float))
        quiet.append((seen, shape, np.linalg.solve(shape, left[:, :, None])[:, :, 0]))
    coefficients = fit_vector_autoregression(
        [np.asarray(np.fft.ifft(e, axis=0).real, float) for *_, e in quiet]
    )
    lags = np.arange(1, 1 + len(coefficients))
    total = np.zeros(inverse.shape)
    for seen, shape, noise in quiet:
        n, p = noise.shape
        late = np.exp(-2j * np.pi * np.outer(np.fft.fftfreq(n), lags))
        whitening = np.eye(p) - np.einsum("fl,lij->fij", late, coefficients)
        white = np.einsum("fij,fj->fi", whitening, noise)
        periodogram = np.einsum("fi,fj->fij", white, white.conj()) / n
        wide = 2 * round(WIDTH * np.sqrt(n)) + 1
        smooth = ndimage.uniform_filter1d(periodogram, wide, axis=0, mode="wrap")
        back = shape @ np.linalg.inv(whitening)
        rows = np.einsum("fji,fja->fia", back.conj(), seen)
        total += np.einsum("fia,fij,fjb->ab", rows.conj(), smooth, rows, optimize=True).real / n
    return total


def fit_vector_autoregression(errors: Sequence[Array]) -> Array:
    r"""Return the autoregression of several signals with the order that a criterion prefers.

    .. math:: e_k = A_1 e_{k-1} + \dots + A_m e_{k-m} + w_k, \quad
        N \ln \det \operatorname{cov} w + m p^2 \ln N \to \min

    By the equations of Yule and Walker, whose solution is always stable.

    Parameters
    ----------
    errors : sequence of ndarray, shape (n, p)
        Stretches of the p signals, of mean zero.

    Returns
    -------
    ndarray, shape (m, p, p)
        The matrices A.

    References
    ----------
    Lütkepohl, *New Introduction to Multiple Time Series Analysis*, sections 3.3 and 4.3.
    """
    count, p = sum(map(len, errors)), errors[0].shape[1]
    most = max(min(count // (SAMPLES_PER_VALUE * p * p), min(map(len, errors)) - 1), 0)
    orders = [m for m in ORDERS if m <= most]
    products = np.array([
        sum(e[lag:].T @ e[: len(e) - lag] for e in errors) for lag in range(orders[-1] + 1)
    ]) / count  # fmt: skip
    best, least = np.zeros((0, p, p)), np.inf
    for m in orders:
        matrices, left = np.zeros((m, p, p)), products[0]
        if m:
            # Block (i, j) of the equations is the covariance of e[k-i] and e[k-j].
            table = np.block([[products[j - i] if j >= i else products[i - j].T for j in range(m)]
                              for i in range(m)])  # fmt: skip
            wanted = np.hstack(list(products[1 : m + 1]))
            try:
                found = np.linalg.solve(table.T, wanted.T).T
            except np.linalg.LinAlgError:
                break
            left = products[0] - found @ wanted.T
            matrices = found.reshape(p, m, p).transpose(1, 0, 2)
        sign, size = np.linalg.slogdet(left)
        if sign <= 0:
            break
        score = count * size + 2 * bayesian_penalty(m * p * p, count)
        if score < least:
            best, least = matrices, score
    return best
