"""Which numbers of the diagnosis have earned their place: the study again with half and twice each.

``python benchmarks/study_numbers.py run STUDY.jsonl.gz --out numbers.jsonl.gz`` takes the lines of
``study_frozen.py``, which say in which draws half or twice a number of judgement would have decided
something otherwise (``watched_numbers.py``), and diagnoses up to ``--each`` of these draws again
with each. In all other draws the number decides nothing. ``print`` gives the table; a run that was
interrupted goes on. It is to be run on the commit of the study.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import study_frozen as study
from _shares import append_line
from watched_numbers import LEFT, change_number, list_judged_numbers

from ctrlid.diagnosis.thresholds import vary_numbers

FACTORS = (0.5, 2.0)
Line = dict[str, Any]


def is_near(line: Line, name: str) -> bool:
    """Whether half or twice a number might have decided something otherwise in a draw."""
    near = line.get("near", {})
    return name in near or f"{name}, {LEFT}" in near


def choose_draws(lines: Sequence[Line], name: str, each: int) -> list[Line]:
    """Return draws in which a number may matter, so many and spread evenly over all of them."""
    near = [x for x in lines if is_near(x, name)]
    picked = np.unique(np.linspace(0, len(near) - 1, min(each, len(near))).round().astype(int))
    return [near[k] for k in picked]


def run(name: str, factor: float, key: tuple[str, int, int]) -> Line:
    """Diagnose a draw with another value of a number; return the line."""
    value = change_number(list_judged_numbers()[name], factor)
    with vary_numbers(**{name: value}):
        line = study.run(*key, watched=False)
    return line | {"number": name, "factor": factor}


def count_wrong(line: Line) -> int:
    """Return how many findings of a line have nothing true in their set."""
    return sum(study.is_wrong(line, groups) for groups in study.list_sets(line))


def count_right(line: Line) -> int:
    """Return how many of the hidden effects are in the set of a finding."""
    return sum(study.is_in_sets(line, truth) for truth in line["truth"])


def has_other_names(one: Line, other: Line) -> bool:
    """Whether two answers have another verdict or other names."""
    told = [(x.get("verdict"), [f["set"] for f in x.get("findings", [])]) for x in (one, other)]
    return told[0] != told[1]


def write_rows(lines: Sequence[Line], changed: Sequence[Line]) -> list[tuple[str, ...]]:
    """Return the table: for each number and factor in how many draws it matters, and how."""
    known = {study.make_key(x): x for x in lines}
    rows = []
    for name, value in list_judged_numbers().items():
        near = sum(is_near(x, name) for x in lines)
        for factor in FACTORS:
            own = [x for x in changed if x["number"] == name and x["factor"] == factor]
            pairs = [(known[study.make_key(x)], x) for x in own]
            other = sum(has_other_names(a, b) for a, b in pairs)
            right = sum(count_right(b) - count_right(a) for a, b in pairs)
            wrong = sum(count_wrong(b) - count_wrong(a) for a, b in pairs)
            gaps = [b["gap"][2] / a["gap"][2] for a, b in pairs
                    if has_other_names(a, b) and a.get("gap") and b.get("gap")
                    and a["gap"][2] and b["gap"][2]]  # fmt: skip
            gap = f"{np.exp(np.mean(np.log(gaps))):.2f}" if gaps else ""
            told = f"{other} of {len(own)}" if own else "none run"
            rows.append((name, f"{value:g}", f"{change_number(value, factor):g}",
                         f"{near} of {len(lines)}", told, f"{right:+d}", f"{wrong:+d}",
                         gap))  # fmt: skip
    return rows


HEAD = ("number", "value", "tried", "draws in which it may matter", "answers with other names",
        "true names", "false findings", "gap of those, times")  # fmt: skip


def main() -> None:
    """Run the study of the numbers, or print it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("command", choices=("run", "print"))
    parser.add_argument("study", help="the lines of the frozen study")
    parser.add_argument("--out", required=True, help="the file, such as numbers.jsonl.gz")
    parser.add_argument("--each", type=int, default=6, help="draws for each number")
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    lines = study.read(options.study)
    done = study.read(options.out, study.make_changed_key)
    if options.command == "run":
        known = {study.make_changed_key(x) for x in done}
        tasks = [
            (name, factor, study.make_key(x))
            for name, factor in itertools.product(list_judged_numbers(), FACTORS)
            for x in choose_draws(lines, name, options.each)
            if (*study.make_key(x), name, factor) not in known
        ]
        work = joblib.Parallel(n_jobs=options.jobs, return_as="generator_unordered")
        for line in work(joblib.delayed(run)(*task) for task in tasks):
            append_line(options.out, line)
            print(line["number"], line["factor"], *study.make_key(line), flush=True)
        done = study.read(options.out, study.make_changed_key)
        if Path(options.out).exists():
            study.write(options.out, done)
    for row in (HEAD, *write_rows(lines, done)):
        print("  ".join(f"{cell:<{width}}" for cell, width in
                        zip(row, (26, 7, 7, 29, 26, 11, 15, 8), strict=True)))  # fmt: skip


if __name__ == "__main__":
    main()
