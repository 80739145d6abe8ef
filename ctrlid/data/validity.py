"""Which samples count: stretches of them, and those whose whole past counts too."""

from typing import Any

import numpy as np


def find_runs(mask: Any) -> tuple[Any, Any]:
    """Return first indices and ends (exclusive) of the stretches where a mask is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(mask, dtype=np.int8), [0]])))
    return edges[::2], edges[1::2]


def find_longest_run(mask: Any) -> slice:
    """Return the longest stretch in which a mask is true, the first of several; it has one."""
    first, stop = find_runs(mask)
    k = int(np.argmax(stop - first))
    return slice(int(first[k]), int(stop[k]))


def find_last_valid(valid: Any) -> Any:
    """Return for each sample the last one that counts, before all of them the first.

    Examples
    --------
    >>> find_last_valid(np.array([False, True, False, False, True])).tolist()
    [1, 1, 1, 1, 4]
    """
    return np.maximum.accumulate(np.where(valid, np.arange(len(valid)), np.argmax(valid)))


def find_whole_past(valid: Any, lags: int) -> Any:
    """Return which samples count together with all of a number of samples before them.

    Parameters
    ----------
    valid : ndarray of bool, shape (n,)
        Samples that count.
    lags : int
        Number of past samples that a row of a regression, or a prediction, needs.

    Returns
    -------
    ndarray of bool, shape (n,)
        False for the first `lags` samples, whose past is not whole.

    Examples
    --------
    >>> find_whole_past(np.array([True, True, False, True, True, True]), 1).tolist()
    [False, True, False, False, True, True]
    """
    bad = np.concatenate([[0], np.cumsum(~np.asarray(valid, dtype=bool))])
    whole = np.zeros(len(valid), dtype=bool)
    whole[lags:] = bad[lags + 1 :] == bad[: max(len(valid) - lags, 0)]
    return whole


def find_equal_readings(y: Any, valid: Any) -> tuple[Any, Any]:
    r"""Return how many equal readings stand in a row, and one reading of each such run.

    .. math:: \operatorname{var} \left( y_k - y(t_k) \right) = q^2 / 12

    is the variance that rounding to steps q adds, and it is as white noise if what is measured
    moves by a step from one sample to the next. While it does not, all readings of a run err
    alike, and say together what one of them says. Which one is returned is drawn, always the same
    for the same record: the first and the last err by half a step against and along the motion.

    Parameters
    ----------
    y : ndarray, shape (n,)
        Readings.
    valid : ndarray of bool, shape (n,)
        Samples that count.

    Returns
    -------
    lengths : ndarray of float, shape (n,)
        For each valid sample the length of its run; one elsewhere.
    one : ndarray of bool, shape (n,)
        One valid sample of each run.

    References
    ----------
    Widrow and Kollár, *Quantization Noise*, chapter 4 (when rounding is like white noise).

    Examples
    --------
    >>> y = np.array([0.0, 0.0, 0.0, 1.0, 2.0, 2.0])
    >>> lengths, one = find_equal_readings(y, np.ones(6, dtype=bool))
    >>> lengths.tolist(), int(one.sum())
    ([3.0, 3.0, 3.0, 1.0, 2.0, 2.0], 3)
    """
    valid = np.asarray(valid, dtype=bool)
    lengths, one = np.ones(len(valid)), np.zeros(len(valid), dtype=bool)
    counted = np.flatnonzero(valid)
    if not counted.size:
        return lengths, one
    firsts = np.flatnonzero(np.concatenate([[True], np.diff(np.asarray(y)[counted]) != 0]))
    sizes = np.diff(np.append(firsts, len(counted)))
    lengths[counted] = np.repeat(sizes, sizes)
    drawn = np.floor(np.random.default_rng(0).random(len(firsts)) * sizes).astype(int)
    one[counted[firsts + drawn]] = True
    return lengths, one
