"""Standard errors of the roots of a fitted polynomial, also where roots coincide."""

import math
from typing import Any

import numpy as np

from .._base.arrays import Array, ComplexArray

# Roots nearer to each other, relative to their size, cannot be told from multiple ones: rounding of
# the coefficients parts a double root by the square root of the machine's precision.
RESOLVED = 8 * math.sqrt(np.finfo(float).eps)
# A share of the terms of a sum that is rounding beside a double root.
PARTED = 1e-6


def find_coincident(roots: ComplexArray, root: complex) -> Any:
    """Return which of the roots cannot be told from one of them."""
    return np.abs(roots - root) <= RESOLVED * np.maximum(np.abs(roots), abs(root))


def compute_root_errors(roots: ComplexArray, covariance: Array) -> Array:
    """Return the standard errors of the roots of a monic polynomial, by the delta method.

    Parameters
    ----------
    roots : (n,) array
        Its roots.
    covariance : (n, n) array
        Covariance of its coefficients after the leading 1, in falling powers.

    Returns
    -------
    (n,) array
        Standard errors; of roots that coincide that of their mean where the coefficients can only
        move so that they go on to coincide, and else infinite.
    """
    n = len(roots)
    if not covariance.any():
        return np.zeros(n)
    powers, spread = np.arange(n - 1, -1, -1), np.sqrt(np.diag(covariance))
    errors = np.empty(n)
    for k in range(n):
        alike = find_coincident(roots, roots[k])
        if alike.sum() == 1:
            gradient = -(roots[k] ** powers) / np.prod(roots[k] - np.delete(roots, k))
            errors[k] = _compute_spread(gradient, covariance)
            continue
        # At a multiple root a change of the polynomial's value there parts the roots.
        apart = roots[alike].mean() ** powers
        if _compute_spread(apart, covariance) > PARTED * (np.abs(apart) @ spread):
            errors[k] = np.inf
            continue
        gradient = _differentiate_mean(roots, alike)
        error = _compute_spread(gradient, covariance)
        errors[k] = error if error > PARTED * (np.abs(gradient) @ spread) else 0.0
    return errors


def _compute_spread(gradient: ComplexArray, covariance: Array) -> float:
    return math.sqrt(max(float((gradient.conj() @ covariance @ gradient).real), 0.0))


def _differentiate_mean(roots: ComplexArray, alike: Any) -> ComplexArray:
    r"""Return the derivatives of the mean of some roots that coincide by the coefficients.

    .. math:: \frac{\partial}{\partial a_j} \sum_i z_i
        = -\frac{1}{2 \pi i} \oint \frac{z^{n-j}}{A(z)} \, dz

    around them alone, by the trapezoidal rule, which converges geometrically on a circle.
    """
    n, center = len(roots), roots[alike].mean()
    far = np.abs(roots[~alike] - center)
    radius = 0.5 * (float(far.min()) if far.size else max(abs(center), 1.0))
    turn = np.exp(2j * np.pi * (np.arange(64) + 0.5) / 64)
    z = center + radius * turn
    value = np.prod(z[:, None] - roots, axis=1)
    each = z[:, None] ** np.arange(n - 1, -1, -1) * (radius * turn / value)[:, None]
    gradient: ComplexArray = -each.mean(axis=0) / np.count_nonzero(alike)
    return gradient
