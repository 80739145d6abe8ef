"""What not knowing the size of the random force adds to the uncertainty of parameters."""

import functools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ...._base.arrays import Array
from ...._base.statistics import pseudo_inverse
from ..kalman_filter import Noise
from ..likelihood import Fit, evaluate_linearized, relinearize_fit
from .coordinates import choose_force_ratios

# Sizes whose likelihood is so many times smaller than the largest, as a logarithm, do not count.
NEGLIGIBLE = 6.0
# A size is known where this factor either way costs so much log-likelihood, as two standard
# deviations do; what is left is in the information matrix.
KNOWN_FACTOR, KNOWN_COST = 1.6, 2.0
# No record shows a force of this share of the reference; larger ones are looked for by steps.
UNSEEN, STEP, MOST_STEPS = 1e-3, 3.0, 12
# So many sizes stand for all between nothing and the largest that is likely.
SIZES = 10


def measure_doubt_by_force(fit: Fit) -> Array:
    r"""Return what the unknown size of the random force adds to a covariance of parameters.

    .. math:: \sum_i w_i \bigl(H_i^{-1} + \Delta_i \Delta_i^T\bigr) - H^{-1}, \quad
        w_i \propto e^{\ell_i + \Delta_i^T H_i \Delta_i / 2} |H_i|^{-1/2}

    over sizes a of the force from zero on, with the information H of the parameters, the step
    :math:`\Delta` to their best values, and the likelihood of a with the parameters integrated out.
    The sizes count alike beforehand, as standard deviations. A force that a record hardly shows may
    have moved the plant for long all the same; where the most likely size is zero, standard errors
    that take it for known leave that out, and a bias of the input seems known far too well.

    Parameters
    ----------
    fit : Fit
        A maximum of the likelihood.

    Returns
    -------
    ndarray, shape (p, p)
        Zero where the size is known, or where a coloured force was fitted.

    References
    ----------
    Harville, Journal of the American Statistical Association 72 (1977) 320-338 (restricted
    likelihood); Gelman, Bayesian Analysis 1 (2006) 515-533 (standard deviations that count alike).
    """
    total = np.zeros((len(fit.theta), len(fit.theta)))
    inside = (fit.theta > fit.problem.lower) & (fit.theta < fit.problem.upper)
    rows = np.flatnonzero(inside & (np.diag(fit.normal[0]) > 0))
    if fit.known is not None or fit.noise.drift or not len(rows):
        return total
    fit = fit if fit.linearized else relinearize_fit(fit)
    for which, variance in enumerate(fit.noise.force):
        weigh = functools.cache(functools.partial(_weigh_size, fit, rows, which))
        likely = _list_likely_sizes(fit, which, weigh)
        if likely is not None:
            mean = sum(share * weigh(float(size))[1] for size, share in zip(*likely, strict=True))
            total[np.ix_(rows, rows)] += _keep_positive(mean - weigh(math.sqrt(variance))[1])
    return total


def find_mean_force(fit: Fit) -> Noise:
    """Return the noise of a fit with the mean of the likely sizes for each force that is not known.

    What a record like this one would show depends on the force that acts in it, of which the
    likeliest size is often zero.
    """
    force = list(fit.noise.force)
    if fit.known is None and not fit.noise.drift:
        fit = fit if fit.linearized else relinearize_fit(fit)
        rows = np.flatnonzero(np.diag(fit.normal[0]) > 0)
        for which in range(len(force)):
            weigh = functools.cache(functools.partial(_weigh_size, fit, rows, which))
            likely = _list_likely_sizes(fit, which, weigh)
            if likely is not None:
                sizes, shares = likely
                force[which] = float(shares @ sizes) ** 2
    return replace(fit.noise, force=tuple(force))


def _list_likely_sizes(
    fit: Fit, which: int, weigh: Callable[[float], tuple[float, Array]]
) -> tuple[Array, Array] | None:
    """Return sizes of one force, and how likely each is; None if its size is known."""
    size = math.sqrt(fit.noise.force[which])
    best = weigh(size)[0]
    pair = [weigh(size * factor)[0] for factor in (1 / KNOWN_FACTOR, KNOWN_FACTOR)]
    if max(pair) < best - KNOWN_COST or not math.isfinite(best):
        return None
    largest = max(size, UNSEEN * math.sqrt(choose_force_ratios(fit.problem)[which]))
    for _ in range(MOST_STEPS):
        value = weigh(largest)[0]
        best = max(best, value)
        if value < best - NEGLIGIBLE:
            break
        largest *= STEP
    sizes = np.linspace(0.0, largest, SIZES + 1)
    sizes[0] = UNSEEN * largest
    logs = np.array([weigh(float(a))[0] for a in sizes])
    if not np.isfinite(logs).any():
        return None
    weights = np.exp(logs - np.max(logs))
    # Half of each end of the trapezoids.
    weights[[0, -1]] /= 2
    return sizes, weights / np.sum(weights)


def _weigh_size(fit: Fit, rows: Any, which: int, size: float) -> tuple[float, Array]:
    """Return the logarithm of how likely a size is, and the second moment of parameters there."""
    force = list(fit.noise.force)
    force[which] = size**2
    noise = replace(fit.noise, force=tuple(force))
    here = evaluate_linearized(fit.problem, fit.theta, noise, fit.linearized)
    matrix, score = here.normal[0][np.ix_(rows, rows)], here.normal[1][rows]
    inverse = pseudo_inverse(matrix)
    step = inverse @ score
    likely = here.value + 0.5 * float(score @ step) - 0.5 * float(np.linalg.slogdet(matrix)[1])
    moment = inverse + np.outer(step, step)
    known = math.isfinite(likely) and bool(np.isfinite(moment).all())
    return (likely, moment) if known else (-math.inf, np.zeros_like(inverse))


def _keep_positive(matrix: Array) -> Array:
    """Return a symmetric matrix without what is negative in it."""
    size = np.sqrt(np.maximum(np.abs(np.diag(matrix)), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
    positive = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(positive * np.outer(size, size))
