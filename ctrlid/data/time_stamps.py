"""The sampling period of time stamps, and the samples that are missing among them."""

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .._base.errors import CtrlidError, CtrlidWarning
from .._base.text import drop_roundoff, write_count, write_percent

# A file with more missing samples than this many times its rows has a wild time stamp.
WILD = 100
# A good clock never jitters by more than this share of the period.
JITTER = 0.01
# A clock is right to this share; beyond it the times of a log and its stated period contradict.
CLOCK = 0.01
# A step of more periods between two time stamps says that samples are missing.
GAP = 1.5
# Where steps of two units come less often than this, rows may have been lost at a regular pace. A
# recorder that loses a fifth of all rows would have been noticed, so that it is only warned of.
LOST = 0.2


def make_uniform(stamps: Any, dt: float | None, gaps: str, path: Path) -> tuple[float, Any]:
    """Return the period of time stamps and, for each uniform sample, its row."""
    lost = np.flatnonzero(~np.isfinite(stamps))
    if len(stamps) < 2 or lost.size:
        here = f"; row {lost[0] + 1} of the data has none" if lost.size else ""
        raise CtrlidError(f"the time column of {path} needs at least 2 values, all finite{here}. "
                          "Complete it, or remove the column and give dt=")  # fmt: skip
    rounding, period_is_free = _find_resolution(stamps), dt is None
    even = _find_even_period(stamps, rounding, dt)
    if even is not None and dt is None and (unit := _find_doubled_unit(stamps)) is not None:
        # A slow clock in whole units and a fast one that lost rows write the same stamps.
        longer = int(np.count_nonzero(np.diff(stamps) > GAP * unit))
        either = (
            f"the time column of {path} steps by {unit:g} s, and {longer} times, at a regular "
            f"pace, by twice as much: either rows were lost (give gaps='mask' to fill them and "
            f"mark them as not valid), or the period is no whole number of {unit:g} s (give "
            f"dt={even:.10g})"
        )
        few = longer <= LOST * (len(stamps) - 1) + 1
        if gaps == "error" and few:
            raise CtrlidError(either)
        if not few:
            here = "lost rows" if gaps == "mask" else "the slower clock"
            warnings.warn(f"{either}. Read as {here}", CtrlidWarning, stacklevel=5)
        if gaps == "mask":
            even, dt = None, unit
    if even is not None:
        return even, np.arange(len(stamps))
    steps = np.diff(stamps)
    back = np.flatnonzero(steps <= 0)
    if back.size:
        k = int(back[0])
        raise CtrlidError(
            f"the time column of {path} does not increase: {stamps[k]:g} s in row {k + 1} of the "
            f"data is followed by {stamps[k + 1]:g} s. Sort the rows, cut at the restart of the "
            "clock, or remove the column and give dt="
        )
    regular = steps[steps < GAP * np.median(steps)]
    # Round-off of the stamps is no digit of the period, also where rows are lost.
    usual = drop_roundoff(float(np.mean(regular)), 4 * float(np.spacing(np.abs(stamps).max())))
    # Where rows are lost, rounded stamps tell the period over the longest stretch without a gap.
    stretch = np.diff(np.flatnonzero(np.r_[True, steps >= GAP * np.median(steps), True])).max()
    unsure = CLOCK * usual + (rounding + 8 * float(np.spacing(np.abs(stamps).max()))) / stretch
    if dt is not None and not abs(usual - dt) < unsure:
        raise CtrlidError(f"the time column of {path} steps by {usual:.4g} s, but dt is {dt:g} s. "
                          "Leave out dt=, or remove the column; if its times are in another unit, "
                          "write it into the header, as in 't [ms]'")  # fmt: skip
    ends = len(stamps) * abs(usual - dt) if dt is not None else 0.0
    if dt is not None and len(regular) == len(steps) and ends > max(dt, 1.5 * rounding):
        warnings.warn(
            f"the times of {path} run over {stamps[-1] - stamps[0]:.6g} s, the samples with "
            f"dt={dt:.10g} over {(len(stamps) - 1) * dt:.6g} s. dt= is believed",
            CtrlidWarning, stacklevel=4,
        )  # fmt: skip
    if dt is None:
        dt = _estimate_period(stamps) if len(regular) == len(steps) else usual
    lost = np.round(steps / dt) - 1
    if np.sum(lost) > WILD * len(stamps):
        k = int(np.argmax(lost))
        raise CtrlidError(
            f"the time column of {path} jumps from {stamps[k]:.6g} s to {stamps[k + 1]:.6g} s in "
            f"row {k + 2} of the data, at a period of {dt:.4g} s: {lost[k]:.4g} samples would be "
            "missing. Correct or remove the wild time stamp, or cut the file there"
        )
    missing = np.where(steps < GAP * dt, 0, lost).astype(int)
    where = np.flatnonzero(missing)
    if where.size and gaps == "error":
        k = int(where[np.argmax(missing[where])])
        places = "one place" if where.size == 1 else f"{where.size} places"
        raise CtrlidError(
            f"{path} lacks {write_count(int(missing.sum()), 'sample')} in {places}; the longest "
            f"gap has {missing[k]}, {steps[k]:.4g} s after t = {stamps[k]:.6g} s, at a period of "
            f"{dt:.4g} s. Give "
            "gaps='mask' to fill them with the last values and mark them as not valid"
        )
    jitter = float(np.max(np.abs(steps - (missing + 1) * dt))) / dt
    if jitter > JITTER + rounding / dt:
        if even is None and period_is_free:
            # No mean of stamps that jitter is known better than that.
            dt = _shorten_period(dt, 2 * jitter * dt / (len(stamps) - 1))
        warnings.warn(
            f"the times of {path} jitter by up to {write_percent(jitter)} of the period "
            f"{dt:.10g} s; they are taken as uniform. "
            f"{'Give dt= if the clock has another period. ' if period_is_free else ''}If "
            "the samples really were taken unevenly, resample them at even times first, as with "
            "numpy.interp",
            CtrlidWarning, stacklevel=4,
        )  # fmt: skip
    return dt, np.repeat(np.arange(len(stamps)), np.append(missing, 0) + 1)


def question_period(dt: float, stamps: Any, path: Path, label: str) -> None:
    """Warn of times without a unit that are hardly in seconds: whole numbers, or below 1 µs."""
    if dt < 1e-6 or (dt >= 1 and np.all(stamps == np.round(stamps))):
        warnings.warn(
            f"the time column {label!r} of {path} has no unit, so that it is taken in seconds and "
            f"the period is {dt:g} s. If it is in milliseconds or counts samples, write its unit "
            f"into the header, as in '{label} [ms]', or remove the column and give dt=; otherwise "
            f"write '{label} [s]'",
            CtrlidWarning, stacklevel=4,
        )  # fmt: skip


def _estimate_period(stamps: Any) -> float:
    """Return the mean period of time stamps, with no digits that only round-off gave it."""
    mean = float(stamps[-1] - stamps[0]) / (len(stamps) - 1)
    finest = float(np.spacing(np.abs(stamps).max()))
    usual = drop_roundoff(mean, 4 * finest)
    # The mean of a few seconds since 1970 has digits that only the size of the stamps gave it.
    return _shorten_period(usual, 2 * finest / (len(stamps) - 1))


def _find_resolution(stamps: Any) -> float:
    """Return the last decimal place that time stamps use, at least their round-off."""
    finest = 4 * float(np.spacing(np.abs(stamps).max()))
    for digits in range(13):
        unit = 10.0**-digits
        if unit <= finest:
            break
        if np.all(np.abs(stamps - np.round(stamps / unit) * unit) <= finest):
            return unit
    return finest


def _find_even_period(stamps: Any, rounding: float, dt: float | None) -> float | None:
    """Return the period of which stamps are rounded multiples, None if they are not.

    A clock of 3.25 ms printed in whole milliseconds steps by 3 and 4 ms, and is regular.
    """
    n = len(stamps)
    k = np.arange(n)

    def fits(period: float, share: float = 1.01) -> bool:
        return period > 0 and float(np.ptp(stamps - k * period)) <= share * rounding

    finest = 4 * float(np.spacing(np.abs(stamps).max()))
    mean = float(stamps[-1] - stamps[0]) / (n - 1)
    if dt is None and mean > 0 and float(np.ptp(stamps - k * mean)) <= finest:
        return _estimate_period(stamps)
    steps = np.diff(stamps)
    base = float(np.median(steps)) if dt is None else dt
    if dt is not None and rounding > dt:
        # Times in whole seconds of samples that are taken ten times a second.
        return dt if fits(dt, 1.25) else None
    if not rounding <= mean or base <= 0:
        return None
    # Steps of 1, 1 and 2 units may also be lost samples, unless there are many, evenly spread.
    with np.errstate(over="ignore"):  # A period far below the steps is refused by them below.
        longer = np.round(steps / base)
    if np.all(np.abs(steps - longer * base) <= finest) and (
        dt is not None or np.count_nonzero(longer > 1) < 5
    ):
        return None
    if dt is not None:
        return dt if fits(dt, 1.25) else None
    slope = float(np.polyfit(k / n, stamps - stamps[0], 1)[0]) / n
    if not fits(slope, 1.25):
        return None
    # Of the periods that the stamps allow, the one with the fewest digits is taken.
    short = _list_roundings(slope)
    return next((p for p in short if fits(p) and abs(p - slope) <= rounding / n), slope)


def _find_doubled_unit(stamps: Any) -> float | None:
    """Return the step of a clock of which some steps are twice as long, None for other clocks."""
    steps = np.diff(stamps)
    unit = float(np.min(steps))
    finest = 4 * float(np.spacing(np.abs(stamps).max()))
    longer = np.round(steps / unit) if unit > 0 else np.zeros(0)
    whole = np.all(np.abs(steps - longer * unit) <= finest)
    return drop_roundoff(unit, finest) if np.any(longer > 1) and whole else None


def _shorten_period(dt: float, uncertainty: float) -> float:
    """Return the period with the fewest digits within an uncertainty of another."""
    return next((p for p in _list_roundings(dt) if abs(p - dt) <= uncertainty), dt)


def _list_roundings(period: float) -> Iterator[float]:
    """Yield a period rounded to one digit, to two, and so on."""
    return (float(f"{period:.{digits}g}") for digits in range(1, 16))
