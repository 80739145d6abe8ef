"""Dates with a time of day, as data loggers write them, as times in seconds."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from .._base.arrays import Array

# A date and a time by ISO 8601, with a space or a T between them; a fraction of the second behind a
# point or a comma, and a zone, may follow.
STAMP = re.compile(
    r"(\d{4}-\d\d-\d\d)[T ]+(\d\d:\d\d(?::\d\d)?)(?:[.,](\d+))? ?(Z|[+-]\d\d(?::?\d\d)?)?",
    re.IGNORECASE,
)
NANOSECONDS = 1_000_000_000
DIGITS = 9


def read_seconds(cells: Sequence[str]) -> Array | None:
    """Return the times of a column of dates in seconds since its first row, None for other columns.

    Times without a zone are those of one clock, which is not set to summer time in between.

    Parameters
    ----------
    cells : sequence of str
        The column as it stands in the file; a blank cell has the time NaN.

    Examples
    --------
    >>> read_seconds(["2026-11-27T23:59:59.750Z", "2026-11-28 01:00:00,5+01:00"])
    array([0.  , 0.75])
    >>> read_seconds(["2026-11-27T23:59:59", "at rest"])
    """
    stamps = [_read_stamp(cell) if cell.strip() else None for cell in cells]
    known = [stamp for stamp in stamps if stamp is not None]
    if not known or len(known) < sum(bool(cell.strip()) for cell in cells):
        return None
    if len({has_zone for _, has_zone in known}) > 1:
        return None
    # Whole nanoseconds are subtracted, so that no digit of the fraction is lost.
    first = known[0][0]
    return np.array([np.nan if s is None else (s[0] - first) / NANOSECONDS for s in stamps])


def _read_stamp(cell: str) -> tuple[int, bool] | None:
    """Return a date in nanoseconds, and whether it has a zone; None for what is no date."""
    parts = STAMP.fullmatch(cell.strip())
    if parts is None:
        return None
    date, time, fraction, zone = parts.groups()
    try:
        moment = datetime.fromisoformat(f"{date}T{time}{(zone or '').upper()}")
    except ValueError:
        return None
    # Any zone will do for times of one clock.
    moment = moment if zone else moment.replace(tzinfo=UTC)
    since = moment - datetime(1970, 1, 1, tzinfo=UTC)
    whole = (since.days * 86_400 + since.seconds) * NANOSECONDS
    return whole + int((fraction or "0")[:DIGITS].ljust(DIGITS, "0")), zone is not None
