"""The grid on which the readings of a converter lie."""

from typing import Any

import numpy as np

from .._base.arrays import Array

# So many samples are enough to find the grid of a quantized signal.
ENOUGH = 20_000
# A signal with at most so many distinct values may be a staircase.
LEVELS = 12


def estimate_rounding(v: Array) -> float:
    """Return the difference up to which two values of a signal are the same number."""
    return 4 * float(np.spacing(np.max(np.abs(v))))


def count_distinct(v: Array) -> tuple[Array, Any]:
    """Return the values of a signal in rising order and how often each occurs."""
    values, counts = np.unique(v, return_counts=True)
    first = np.flatnonzero(np.concatenate([[True], np.diff(values) > estimate_rounding(v)]))
    return values[first], np.add.reduceat(counts, first)


def find_grid_step(v: Array) -> float:
    r"""Return the step of the grid on which all values of a signal lie, or 0.

    .. math:: v_k = v_0 + q \, i_k, \quad i_k \text{ whole}

    The greatest common measure of the differences of distinct values, by Euclid's rule with a
    tolerance. The extreme values may be a limiter's and are left out; one value in a hundred may
    be off the grid. Where few levels recur all the time but are unevenly spaced, as those of a
    converter behind a calibration curve, the middle spacing is returned. A staircase of a few
    levels that are far apart is not quantised.

    Parameters
    ----------
    v : ndarray, shape (n,)
        Signal.

    Returns
    -------
    float
        The step [signal unit]; 0 for a signal of full floating-point resolution.
    """
    values, counts = count_distinct(v[:ENOUGH])
    if len(values) < 3:
        return 0.0
    if len(values) > LEVELS:
        values, counts = values[1:-1], counts[1:-1]
    again = counts > 1
    if np.count_nonzero(again) > 2 and counts[again].sum() >= 0.9 * counts.sum():
        values, again = values[again], again[again]
    finest = 250 * estimate_rounding(v)
    gaps = np.diff(values)
    step = float(gaps.min())
    # Levels that all recur but are unevenly spaced come from a converter with a calibration curve.
    uneven = float(np.median(gaps)) if len(values) < 0.1 * len(v) and again.all() else 0.0
    for _ in range(40):
        if step < finest:
            return uneven
        rest = np.abs(gaps - step * np.round(gaps / step))
        off = rest > 0.03 * step
        if np.mean(off) <= 0.01:
            break
        step = float(rest[off].min())
    step = float(values[-1] - values[0]) / float(np.sum(np.round(gaps / step)))
    place = (v - values[0]) / step
    inner = (v < v.max()) & (v > v.min()) if len(values) > LEVELS else np.ones(len(v), bool)
    if np.mean(np.abs(place - np.round(place))[inner] < 0.1) < 0.99:
        return uneven
    jumps = np.abs(np.diff(v))
    jumps = jumps[jumps > 0.5 * step]
    if len(values) <= LEVELS and (not jumps.size or np.median(jumps) > 1.5 * step):
        return 0.0
    return step
