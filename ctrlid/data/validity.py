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
