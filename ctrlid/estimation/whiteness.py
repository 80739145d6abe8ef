"""Whether the innovations of a fit are white, as its standard errors take for granted."""

from collections.abc import Sequence

import numpy as np
from scipy import stats

from .._base.arrays import Array
from .._base.statistics import compute_lagged_products, compute_whiteness_probability
from .._base.text import write_p_value

# Innovations are compared with so many samples of their own past.
LAGS = 20
# White innovations are called coloured in so many cases, by chance.
LEVEL = 0.01
# An interval of 95 % that covers 90 % in truth was computed with a variance too small by 1.42, the
# ratio of the squared quantiles; a colour that cannot do so much is not worth a warning.
HARMLESS = (stats.norm.ppf(0.975) / stats.norm.ppf(0.95)) ** 2 - 1
# Errors below this share of the signal come from rounding in the computation.
ROUNDING = 1e-9
# More samples than these add nothing to the answer.
ENOUGH = 50_000


def note_coloured_innovations(
    stretches: Sequence[Array], fitted: int, consequence: str, size: float = 0.0
) -> tuple[str, ...]:
    r"""Return a note in capitals if innovations are not white, and nothing if they are.

    .. math:: Q = N (N + 2) \sum_{\tau=1}^{20} \frac{\hat\rho(\tau)^2}{N - \tau}, \quad
        2 \sum_\tau |\hat\rho(\tau)| \quad \text{of those that chance does not give}

    White innovations make Q follow a chi-square law. In a long record a correlation can be
    certain and yet do no harm, so that it also has to be large enough to make intervals of 95 %
    cover less than 90 %: the variance of an estimate can be off by as much as the sum says.

    Parameters
    ----------
    stretches : sequence of ndarray
        Innovations, each stretch without a gap; NaN where there are none.
    fitted : int
        Number of coefficients that take a degree of freedom each: those of the dynamics of the
        noise. What multiplies the past of other signals takes none.
    consequence : str
        What follows for the estimate, as a sentence.
    size : float, optional
        Largest value of the signal that the innovations are errors of; errors that are rounding
        beside it say nothing about noise.

    Returns
    -------
    tuple of str
        One note, or none.

    References
    ----------
    Ljung and Box, Biometrika 65 (1978) 297-303; Ljung, *System Identification*, section 16.6.

    Examples
    --------
    >>> e = np.random.default_rng(1).standard_normal(2000)
    >>> note_coloured_innovations([e], 2, "Intervals are too narrow.")
    ()
    >>> slow = e[1:] + e[:-1]
    >>> note_coloured_innovations([slow], 2, "Intervals are too narrow.")[0][:28]
    'THE INNOVATIONS ARE NOT WHIT'
    """
    products, samples = np.zeros(LAGS + 1), 0
    for stretch in stretches:
        e = np.asarray(stretch, dtype=float)[: ENOUGH - samples]
        known = np.isfinite(e)
        if np.count_nonzero(known) > LAGS:
            e = np.where(known, e - np.mean(e[known]), 0.0)
            products += compute_lagged_products(e, e, LAGS)
            samples += int(np.count_nonzero(known))
    if samples <= fitted + LAGS or not products[0] > 0 or are_rounding(stretches, size):
        return ()
    rho = products[1:] / products[0]
    p = compute_whiteness_probability(rho, samples, fitted)
    chance = float(stats.norm.ppf(1 - LEVEL / 2)) / np.sqrt(samples)
    sure = np.abs(rho[np.abs(rho) > chance])
    if p >= LEVEL or 2 * float(np.sum(sure)) < HARMLESS:
        return ()
    first = int(np.argmax(np.abs(rho))) + 1
    return (
        f"THE INNOVATIONS ARE NOT WHITE ({write_p_value(p)}; correlation {rho[first - 1]:.2f} at a "
        f"lag of {first}): the noise is coloured, or the model lacks something. {consequence}",
    )


def are_rounding(stretches: Sequence[Array], size: float) -> bool:
    """Return whether errors vary no more than those of rounding beside a signal of such a size.

    Parameters
    ----------
    stretches : sequence of ndarray
        Errors, each stretch about a level of its own; NaN where there are none.
    size : float
        Largest value of the signal.
    """
    known = [e[np.isfinite(e)] for e in stretches]
    squares = sum(float(np.sum((e - np.mean(e)) ** 2)) for e in known if len(e))
    return not squares > (ROUNDING * size) ** 2 * sum(map(len, known))
