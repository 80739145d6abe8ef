"""The Bayesian information criterion, in units of the log-likelihood."""

import math


def bayesian_penalty(parameters: float, samples: float) -> float:
    r"""Return the penalty for the parameters of a model.

    .. math:: \tfrac12\, n \ln N

    Half the penalty of the Bayesian information criterion, so that it is taken off the
    log-likelihood itself: of two models the one with the larger
    :math:`\ell - \tfrac12\, n \ln N` is preferred, and a difference of 5 is very strong.

    Parameters
    ----------
    parameters : float
        Number n of parameters that the data determine.
    samples : float
        Number N of samples, or of as many as are independent.

    Returns
    -------
    float
        The penalty [log-likelihood].

    References
    ----------
    Schwarz, Annals of Statistics 6 (1978) 461-464; Kass and Raftery, Journal of the American
    Statistical Association 90 (1995) 773-795.

    Examples
    --------
    >>> round(bayesian_penalty(2, 1000), 3)
    6.908
    """
    return 0.5 * parameters * math.log(samples)
