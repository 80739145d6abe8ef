"""Whether two sampling periods are one, and how they are printed where they are not."""

# Periods read from printed times, and those of single precision, differ by their last digits. Over
# a million samples, the longest of records, such a clock is one sample off.
SAME = 1e-6
# Periods that differ by this factor, within a hundredth, are in different units.
THOUSAND = 1000.0
NEARLY = 0.01


def have_same_period(first: float, second: float) -> bool:
    """Return whether two sampling periods [s] are the same but for their last digits.

    Examples
    --------
    >>> import numpy as np
    >>> have_same_period(0.02, float(np.float32(0.02))), have_same_period(0.02, 0.0201)
    (True, False)
    """
    return abs(first - second) <= SAME * max(abs(first), abs(second))


def differ_by_thousand(first: float, second: float) -> bool:
    """Whether one of two periods is in milliseconds where the other is in seconds.

    Examples
    --------
    >>> differ_by_thousand(0.005, 5.0), differ_by_thousand(0.005, 0.05)
    (True, False)
    """
    return abs(max(first, second) / min(first, second) / THOUSAND - 1) < NEARLY


def write_both_periods(one: str, first: float, other: str, second: float) -> str:
    """Return that two things run at periods that differ, with as many digits as tell them apart.

    Examples
    --------
    >>> write_both_periods("the loop is sampled", 0.02, "the record", 0.020001)
    'the loop is sampled at 0.02 s, the record at 0.020001 s'
    >>> print(write_both_periods("the loop is sampled", 0.005, "the record", 5.0))
    the loop is sampled at 0.005 s, the record at 5 s (5 s is a thousand times as much, so that
    milliseconds were probably taken for seconds)
    """
    both = f"{one} at {first:.10g} s, {other} at {second:.10g} s"
    if differ_by_thousand(first, second):
        both += (
            f" ({max(first, second):.10g} s is a thousand times as much, so that milliseconds were "
            "probably taken for seconds)"
        )
    return both


def write_difference(first: float, second: float) -> str:
    """Return by how much two periods differ, as the end of a sentence."""
    return f"they differ by {abs(first - second):.3g} s"
