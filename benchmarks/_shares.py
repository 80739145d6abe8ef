"""What studies read and print alike: seeds, shares with intervals, the draws farthest off."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import binomtest


def parse_seeds(text: str) -> range:
    """Return the seeds of ``3`` or ``0-24``.

    >>> parse_seeds("0-24")
    range(0, 25)
    """
    first, _, last = text.partition("-")
    return range(int(first), int(last or first) + 1)


def wilson(hits: int, count: int, level: float = 0.95) -> tuple[float, float]:
    """Return Wilson's interval of a share; all of it without any draw.

    >>> [round(v, 3) for v in wilson(98, 100)]
    [0.93, 0.994]
    """
    if not count:
        return 0.0, 1.0
    found = binomtest(hits, count).proportion_ci(confidence_level=level, method="wilson")
    return float(found.low), float(found.high)


def print_farthest(rows: list[dict[str, Any]], failed: list[dict[str, Any]]) -> None:
    """Print the times, the fits that are most standard errors off, and those that failed."""
    spent = [row["seconds"] for row in rows]
    print(f"median time {np.median(spent):.2f} s, longest {max(spent):.1f} s")
    print("farthest off:")
    for row in sorted(rows, key=lambda row: -abs(row["z"]))[:12]:
        print("  ", {k: f"{v:.3g}" if isinstance(v, float) else v for k, v in row.items()})
    for row in failed:
        print("failed:", row)
