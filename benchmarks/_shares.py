"""What studies read, keep and print alike: seeds, files of lines, shares with intervals."""

from __future__ import annotations

import functools
import gzip
import json
import os
import subprocess
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

import ctrlid as cid


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


def write_share(hits: Sequence[bool]) -> str:
    """Return a share in words, with its 95 % interval.

    >>> write_share([True] * 98 + [False] * 2)
    '98 of 100: 98.0 % (93.0 to 99.4 %)'
    """
    low, high = wilson(sum(hits), len(hits))
    if not hits:
        return "no draw"
    return (f"{sum(hits)} of {len(hits)}: {100 * sum(hits) / len(hits):.1f} % "
            f"({100 * low:.1f} to {100 * high:.1f} %)")  # fmt: skip


def print_farthest(rows: list[dict[str, Any]], failed: list[dict[str, Any]]) -> None:
    """Print the times, the fits that are most standard errors off, and those that failed."""
    spent = [row["seconds"] for row in rows]
    print(f"median time {np.median(spent):.2f} s, longest {max(spent):.1f} s")
    print("farthest off:")
    for row in sorted(rows, key=lambda row: -abs(row["z"]))[:12]:
        print("  ", {k: f"{v:.3g}" if isinstance(v, float) else v for k, v in row.items()})
    for row in failed:
        print("failed:", row)


def find_commit() -> str:
    """Return the commit of ctrlid that is diagnosed with, with a plus where files have changed."""
    here = Path(cid.__file__).parent
    ask = functools.partial(subprocess.run, cwd=here, capture_output=True, text=True, check=True)
    try:
        commit = ask(["git", "rev-parse", "--short=7", "HEAD"]).stdout.strip()
        changed = ask(["git", "status", "--porcelain", "--untracked-files=no", "."]).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""
    return commit + "+" * bool(changed)


def read_lines(
    path: str | Path, key: Callable[[dict[str, Any]], tuple[Any, ...]]
) -> list[dict[str, Any]]:
    """Return the lines of a file; of a draw that is there twice, by its key, the last one counts.

    What a run that was killed left half written at the end is left out.
    """
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    if Path(path).exists():
        try:
            with gzip.open(path, "rt") as file:
                for text in file:
                    line = json.loads(text)
                    found[key(line)] = line
        except (EOFError, json.JSONDecodeError, gzip.BadGzipFile):
            pass
    return list(found.values())


def write_lines(path: str | Path, lines: Iterable[dict[str, Any]]) -> None:
    """Write lines as one compressed file, the same bytes for the same lines."""
    text = "".join(json.dumps(x, separators=(",", ":")) + "\n" for x in lines)
    part = Path(f"{path}.part")
    part.write_bytes(gzip.compress(text.encode(), 9, mtime=0))
    os.replace(part, path)


def append_line(path: str | Path, line: dict[str, Any]) -> None:
    """Add a line to a file; a gzip file may have several parts."""
    with Path(path).open("ab") as file:
        file.write(gzip.compress((json.dumps(line) + "\n").encode(), 6, mtime=0))
