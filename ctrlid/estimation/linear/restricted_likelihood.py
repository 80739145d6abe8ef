r"""Noise by restricted likelihood, which counts what was fitted beside it.

.. math:: (N - q) \ln V(\kappa) + \ln \det X(\kappa)^T X(\kappa) \to \min_\kappa

for the sum of squared errors V beside noise parameters :math:`\kappa`, and the q columns X of what
initial states, levels and coefficients do to the errors. These take with them what the data say of
slow noise, so that the noise of the largest likelihood is too fast, and the standard errors beside
it are too small. The difference matters where noise is slow beside the length of a record, and
vanishes in a long one.

Patterson and Thompson, Biometrika 58 (1971) 545-554; Harville, Journal of the American Statistical
Association 72 (1977) 320-338.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..._base.arrays import Array
from .regression import merge_factors, triangularize

# Differences of the restricted likelihood are over this part of a standard error.
DIFFERENCE = 0.03
# A step that gains less than this in twice the log-likelihood is the last, of so many at most.
ENOUGH, STEPS = 0.02, 8
# Initial states and levels that add less than this share of what the largest adds are not counted.
SEEN = 1e-9


def compute_restricted_cost(tables: Sequence[tuple[Array, Array, Array]], samples: int) -> float:
    """Return minus twice the restricted log-likelihood, but for a constant.

    Parameters
    ----------
    tables : sequence of (array, array, array)
        For each stretch what initial states and levels, which it has for itself, and coefficients
        do to the errors, a column each, and the errors.
    samples : int
        Number of samples, less initial states and levels.
    """
    factors, log_volume = [], 0.0
    for own, common, errors in tables:
        factor = triangularize(np.column_stack([own, common, errors]))
        count = own.shape[1]
        sizes = np.abs(np.diag(factor))[:count]
        log_volume += float(np.sum(np.log(sizes[sizes > SEEN * sizes.max(initial=0.0)])))
        factors.append(factor[count:, count:])
    total, count = merge_factors(factors), tables[0][1].shape[1]
    log_volume += float(np.sum(np.log(np.abs(np.diag(total))[:count])))
    return float((samples - count) * np.log(total[count, count] ** 2)) + 2 * log_volume


def restrict_likelihood(cost: Callable[[Array], float], start: Array, units: Array) -> Array:
    """Return the noise parameters of the largest restricted likelihood, from those of the largest.

    Parameters
    ----------
    cost : callable
        ``cost(parameters)`` is minus twice the restricted log-likelihood, infinite where there is
        none.
    start : (n,) array
        Parameters of the largest likelihood.
    units : (n, n) array
        Directions of the parameters that are known independently, each as long as its standard
        error, in its columns.
    """
    best, least = start, cost(start)
    for _ in range(STEPS if np.isfinite(least) else 0):
        # Beside the largest likelihood the curvature is two along each of the units.
        step = -units @ _differentiate(cost, best, least, units) / 2
        value, share = min((cost(best + share * step), share) for share in 0.5 ** np.arange(5))
        # Near the border of stability noise is known far less than it seems to be.
        while share >= 1 and (further := cost(best + 2 * share * step)) < value:
            value, share = further, 2 * share
        gained = least - value
        if not gained > 0:
            break
        best, least = best + share * step, value
        if gained < ENOUGH:
            break
    return best


def _differentiate(
    cost: Callable[[Array], float], here: Array, value: float, units: Array
) -> Array:
    """Return the slope along each unit, one-sided at the border of stability."""
    slopes = []
    for unit in units.T:
        up, down = (cost(here + h * unit) for h in (DIFFERENCE, -DIFFERENCE))
        if not np.isfinite(up):
            up = 2 * value - down
        elif not np.isfinite(down):
            down = 2 * value - up
        slope = (up - down) / (2 * DIFFERENCE)
        slopes.append(slope if np.isfinite(slope) else 0.0)
    return np.array(slopes)
