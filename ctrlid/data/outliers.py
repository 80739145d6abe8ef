"""Gross outliers of a record: single readings that no motion can have made."""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy import ndimage

from .._base.arrays import Array
from .._base.statistics import robust_deviation
from .record import Record

# The median of so many neighbours does not follow an outlier, nor two side by side.
NEIGHBOURS = 5
# The median of so many medians does not follow where outliers crowd.
WIDER = 11
# Gaussian noise goes so many standard deviations away once in 10^23 samples.
FAR = 10.0


def find_outliers(record: Record) -> Any:
    """Return which readings of y are gross outliers.

    Those are away from the median of their neighbours by more than ten standard deviations, and by
    more than the whole range in which the medians move: within one sample and back, nothing that
    has inertia goes so far. Where every pulse of the input is followed by such a reading, these
    are answers of the plant and no outliers.

    Parameters
    ----------
    record : Record
        The data.

    Returns
    -------
    ndarray of bool, shape (n,) or (outputs, n)
        True for valid samples that are outliers.
    """
    names = record.signals["y"]
    if len(names) > 1:
        return np.array([find_outliers(record.select(y=name)) for name in names])
    valid = np.flatnonzero(record.valid)
    found = np.zeros(len(record), dtype=bool)
    if len(valid) < NEIGHBOURS:
        return found
    away = _stands_out(record.y[valid])
    # Single pulses of the input have real answers, and then every pulse has one.
    inputs = np.reshape(record.u, (-1, len(record)))[:, valid]
    pulse = np.any([_stands_out(u) for u in inputs], axis=0)
    after_pulse = np.concatenate([[False], pulse[:-1]])
    found[valid] = away & ~(after_pulse & away[after_pulse].all())
    return found


def _stands_out(signal: Array) -> Any:
    middle = _find_middles(signal)
    distance = np.abs(signal - middle)
    return distance > max(FAR * robust_deviation(distance), float(np.ptp(middle)))


def _find_middles(signal: Array) -> Any:
    """Return the median of the neighbours of each value.

    Of many outliers, three may stand among five readings here and there. A median that stands out
    among its own neighbours gives way to theirs.
    """
    middle = ndimage.median_filter(signal, NEIGHBOURS, mode="mirror")
    wider = ndimage.median_filter(middle, WIDER, mode="mirror")
    off = np.abs(middle - wider)
    far = off > max(FAR * robust_deviation(off), float(np.ptp(wider)))
    return np.where(far, wider, middle)


def mask_outliers(record: Record) -> tuple[Record, Any]:
    """Return a record without its gross outliers, which are no longer valid, and which they are.

    A record without any is returned as it is.
    """
    found = find_outliers(record)
    if not found.any():
        return record, found
    return replace(record, valid=record.valid & ~found), found


def describe_outliers(record: Record, found: Any, label: str = "y") -> str:
    """Return a sentence on the outliers of a record: how many, where, and how far out."""
    names = record.signals["y"]
    if len(names) > 1:
        return "; ".join(
            describe_outliers(record.select(y=name), row, name)
            for name, row in zip(names, found, strict=True)
            if row.any()
        )
    places = np.flatnonzero(found)
    times = ", ".join(f"{record.t[k]:.4g}" for k in places[:3])
    more = ", ..." if len(places) > 3 else ""
    middle = float(np.median(record.y[record.valid & ~found]))
    largest = float(np.max(np.abs(record.y[found] - middle)))
    unit = record.units.get("y", "")
    one = len(places) == 1
    return (
        f"{len(places)} OF {np.count_nonzero(record.valid)} READINGS OF {label} "
        f"{'IS A GROSS OUTLIER' if one else 'ARE GROSS OUTLIERS'}, AND {'WAS' if one else 'WERE'} "
        f"LEFT OUT: at t = {times}{more} s, up to {largest:.3g}{f' {unit}' if unit else ''} from "
        "the median"
    )
