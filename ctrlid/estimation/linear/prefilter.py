"""The prefilter that whitens residuals: reflected poles, coloured noise, curvature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal

from ..._base.arrays import Array
from ..._base.statistics import compute_lagged_products, fit_autoregression, reflect_into_circle
from ..identified_model import Structure
from .regression import to_differences

MOST_COLOURED = 10
"""Largest order of the autoregression that describes the colour of the noise."""


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
    """

    num: Array
    den: Array
    degree: int = 1
    curvature: tuple[Array, ...] = ()
    shift: tuple[float, ...] = ()

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
        return np.column_stack([h[order - i : order - i + n] for i in range(1, order + 1)])


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
    inside = reflect_into_circle(roots, 1 - 5 / max(n, 10))
    return np.asarray(np.poly(inside).real, dtype=float)


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
