"""The prefilter that whitens residuals: reflected poles, coloured noise, curvature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal
from scipy.optimize import least_squares

from ..._base.arrays import Array
from ..._base.statistics import compute_lagged_products, fit_autoregression, reflect_into_circle
from ..identified_model import Structure
from .regression import to_differences

MOST_COLOURED = 10
"""Largest order of the autoregression that describes the colour of the noise."""


# The search for a moving average ends where a step gains less than this share of the squares.
_SETTLED = 1e-6


@dataclass(frozen=True, eq=False)
class View:
    """How the data are looked at: through ``num / den``, and curved up to some degree.

    ``curvature`` holds of each stretch the coefficients of the products, and ``shift`` how far the
    equilibrium of each record lies from the mean of u: a curved plant rectifies what moves it.

    Parameters
    ----------
    num, den : arrays
        Prefilter in powers of the delay.
    degree : int
        Degree of the products of y and u that are estimated with the model; 1 for none.
    curvature : tuple of arrays
        Coefficients of the products on each stretch, once known.
    shift : tuple of float
        For each record the input at the equilibrium, less the mean input.
    moving : bool
        Whether ``den`` is a moving average that was fitted to the equation errors, as those of
        sensor noise and a random force together are, or the reflected denominator of the model.
    """

    num: Array
    den: Array
    degree: int = 1
    curvature: tuple[Array, ...] = ()
    shift: tuple[float, ...] = ()
    moving: bool = False

    def __call__(self, s: Array) -> Array:
        """Filter a signal, from rest."""
        return np.asarray(signal.lfilter(self.num, self.den, s), dtype=float)

    def list_decays(self, n: int) -> Array:
        """Return all ways in which the filter's unknown initial state decays, ``(n, order)``.

        Estimated with the model they make the start of each stretch exact: else the filter would
        need several of its time constants to forget it.
        """
        order = len(self.den) - 1
        impulse = np.zeros(n + order)
        impulse[0] = 1.0
        h = np.asarray(signal.lfilter([1.0], self.den, impulse), dtype=float)
        h[np.abs(h) < 1e-30 * np.abs(h).max()] = 0.0
        late = [h[order - i : order - i + n] for i in range(1, order + 1)]
        return np.reshape(late, (order, n)).T


def reflect_poles(structure: Structure, theta: Array, n: int) -> Array:
    """Return the denominator with the poles outside the unit circle reflected into it.

    ``A(q)`` over it is an all-pass: it whitens the equation error ``A v`` of white sensor noise v.
    Poles within 5/n of the circle are drawn in by that much, beyond what n samples resolve.

    Parameters
    ----------
    structure : Structure
        Orders.
    theta : (p,) array
        Coefficients of the model.
    n : int
        Samples.

    Returns
    -------
    (na + 1,) array
        Monic, in powers of the delay.

    Examples
    --------
    >>> import numpy as np
    >>> reflect_poles(Structure(2, 1), np.array([-2.5, 1.0, 0.3]), 10_000)
    array([ 1.  , -1.  ,  0.25])
    """
    delta = to_differences(structure, theta)[: structure.na]
    roots = 1.0 + np.roots(np.concatenate([[1.0], -delta[::-1]])).astype(complex)
    inside = reflect_into_circle(roots, find_slowest(n))
    return np.asarray(np.poly(inside).real, dtype=float)


def find_slowest(n: int) -> float:
    """Return how near to the unit circle poles and zeros come that n samples resolve, 1 - 5/n."""
    return 1 - 5 / max(n, 10)


def fit_moving_average(errors: Sequence[Array], starts: Sequence[Array], n: int) -> Array:
    r"""Return the moving average whose innovations are smallest, for coloured equation errors.

    .. math:: w_k = C(q)\, e_k, \quad \min_C \sum_k e_k^2

    White sensor noise v gives the equation error A v, and a white force at the input B w. Both
    together are one moving average of the order of A, which is A with its poles reflected only
    where there is no force. What an autoregression of ten coefficients makes of its slow zeros is
    far from it: the filter of the estimator of a drive under a random force was so wrong that
    coefficients scattered 40 times as much. Initial states and levels are estimated along.

    Parameters
    ----------
    errors : sequence of arrays
        Equation errors, each stretch without a gap.
    starts : sequence of arrays
        Polynomials to begin from, monic, with zeros inside the unit circle.
    n : int
        Samples of the longest stretch; zeros stay 5/n inside the circle.

    Returns
    -------
    array
        Monic, in powers of the delay.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> white = np.random.default_rng(0).standard_normal(20_000)
    >>> w = lfilter([1.0, -1.6, 0.63], [1.0], white)
    >>> fit_moving_average([w], [np.poly([0.9, 0.9])], len(w)).round(1)
    array([ 1. , -1.6,  0.6])
    """
    slowest = find_slowest(n)

    def bring_inside(c: Array) -> Array:
        # Zeros outside the circle leave noise of the same spectrum as those inside it.
        roots = np.roots(np.concatenate([[1.0], c])).astype(complex)
        return np.asarray(np.poly(reflect_into_circle(roots, slowest)).real)

    def compute_innovations(c: Array) -> Array:
        return np.concatenate([e for e, _ in _whiten(errors, bring_inside(c))])

    def differentiate(c: Array) -> Array:
        inside = bring_inside(c)
        return np.vstack([_differentiate(part, inside) for part in _whiten(errors, inside)])

    best = min(starts, key=lambda c: _sum_squares(_whiten(errors, c)))
    found = least_squares(
        compute_innovations, best[1:], differentiate, method="lm", ftol=_SETTLED, xtol=_SETTLED
    )
    return bring_inside(found.x)


def measure_units(errors: Sequence[Array], c: Array) -> Array:
    """Return independent directions of a moving average's coefficients, a standard error each.

    Parameters
    ----------
    errors : sequence of arrays
        As in `fit_moving_average`.
    c : array
        The moving average, monic.
    """
    parts = _whiten(errors, c)
    table = np.vstack([_differentiate(part, c) for part in parts])
    spread = np.sqrt(_sum_squares(parts) / len(table))
    return np.asarray(np.linalg.pinv(np.linalg.qr(table, mode="r")) * spread)


def _whiten(errors: Sequence[Array], c: Array) -> list[tuple[Array, Array]]:
    """Return the innovations of each stretch, and a basis of what its start and level add."""
    found = []
    for w in errors:
        e = np.asarray(signal.lfilter([1.0], c, w), dtype=float)
        level = signal.lfilter([1.0], c, np.ones(len(e)))
        nuisances = np.column_stack([View(np.ones(1), c).list_decays(len(e)), level])
        basis = np.linalg.qr(nuisances)[0]
        found.append((e - basis @ (basis.T @ e), basis))
    return found


def _differentiate(part: tuple[Array, Array], c: Array) -> Array:
    r"""Return what each coefficient does to innovations: :math:`-q^{-i} C^{-1} e`."""
    e, basis = part
    slope = -np.asarray(signal.lfilter([1.0], c, e), dtype=float)
    late = [np.concatenate([np.zeros(i), slope[: len(e) - i]]) for i in range(1, len(c))]
    table = np.column_stack(late)
    return np.asarray(table - basis @ (basis.T @ table))


def _sum_squares(parts: Sequence[tuple[Array, Array]]) -> float:
    return sum(float(e @ e) for e, _ in parts)


def autoregression(residuals: Sequence[Array], highest: int = MOST_COLOURED) -> Array:
    """Return an autoregressive whitening filter of residuals, its order by Schwarz' criterion.

    Parameters
    ----------
    residuals : sequence of arrays
        Pieces of one noise.
    highest : int
        Largest order.

    Returns
    -------
    (order + 1,) array
        Monic; ``[1]`` for white residuals. Always minimum phase.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> white = np.random.default_rng(0).standard_normal(20_000)
    >>> autoregression([white])
    array([1.])
    >>> autoregression([lfilter([1.0], [1.0, -0.8], white)]).round(1)
    array([ 1. , -0.8])
    """
    products = np.sum([compute_lagged_products(e, e, highest) for e in residuals], axis=0)
    return fit_autoregression(products, sum(len(e) for e in residuals))
