"""A noise model fitted to the equation errors of a model that has none."""

import numpy as np
from scipy import optimize, signal

from .._base.arrays import Array
from .._base.statistics import reflect_into_circle

# So many samples of each stretch are enough to tell the colour of its noise.
SAMPLES = 20_000


def whiten_errors(equation_errors: Array, segments: list[tuple[int, int]], noise: Array) -> Array:
    r"""Return white errors from equation errors of a known colour.

    .. math:: \varepsilon = \frac{A(q) y - B(q) u}{C(q)}

    Parameters
    ----------
    equation_errors : ndarray, shape (n,)
        ``A y - B u``, less its mean.
    segments : list of (int, int)
        Stretches over which the filter runs, each from rest.
    noise : ndarray
        Monic polynomial C in falling powers of q, with its roots inside the unit circle.

    Returns
    -------
    ndarray, shape (n,)
        The errors; zero outside the segments.
    """
    white = np.zeros(len(equation_errors))
    for start, stop in segments:
        white[start:stop] = signal.lfilter([1.0], noise, equation_errors[start:stop])
    return white


def fit_noise_polynomial(
    equation_errors: Array, segments: list[tuple[int, int]], den: Array
) -> Array:
    """Return the polynomial C of a model's order that leaves the smallest one-step errors.

    Noise of the sensor alone makes C the denominator A with its unstable roots reflected into the
    unit circle, white equation errors make it one; the search starts from there.

    Parameters
    ----------
    equation_errors : ndarray, shape (n,)
        ``A y - B u``, less its mean.
    segments : list of (int, int)
        Stretches that count.
    den : ndarray
        Monic denominator A in falling powers of q.

    Returns
    -------
    ndarray
        C, monic and of the same degree.

    References
    ----------
    Åström, *Introduction to Stochastic Control Theory*, chapter 4 (spectral factorization).
    """
    order = len(den) - 1
    if order == 0:
        return np.ones(1)
    head = [(a, min(b, a + SAMPLES)) for a, b in segments][:10]
    size = max(float(np.std(equation_errors)), 1e-300)

    def errors(tail: Array) -> Array:
        white = whiten_errors(equation_errors, head, _reflect_roots(np.concatenate([[1.0], tail])))
        return np.asarray(np.concatenate([white[a:b] for a, b in head]) / size, dtype=float)

    starts = [_reflect_roots(den), np.eye(1, order + 1)[0]]
    best = min(starts, key=lambda c: float(np.sum(errors(c[1:]) ** 2)))
    found = optimize.least_squares(errors, best[1:], x_scale="jac", max_nfev=40)
    return _reflect_roots(np.concatenate([[1.0], found.x]))


def _reflect_roots(polynomial: Array) -> Array:
    """Reflect roots into the unit circle, and keep a hair's breadth from it."""
    roots = reflect_into_circle(np.roots(polynomial), 0.9995)
    return np.asarray(np.real(np.poly(roots)), dtype=float)
