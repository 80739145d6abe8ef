"""The study of the numbers: draws in which one may matter, and what half or twice of it changes."""

import pytest

from ctrlid.diagnosis.thresholds import THRESHOLD
from problems import load_script

numbers = load_script("benchmarks", "study_numbers")


def make_line(seed, near=(), names=(), gap=1.0, **more):
    found = [{"set": [n], "equal": [], "evidence": 1.0, "values": {}} for n in names]
    return {"class": "one", "seed": seed, "n": 10, "plant": "drive", "truth": ["InputDelay"],
            "findings": found, "stand_ins": [], "verdict": "explained",
            "near": dict.fromkeys(near, 1), "gap": [2.0, 2.0, gap, 0.5], **more}  # fmt: skip


def test_only_draws_in_which_a_number_may_matter_are_run_again_spread_over_them():
    lines = [make_line(k, ["excess"] if k % 2 else ["block, left Python"]) for k in range(20)]
    assert [x["seed"] for x in numbers.choose_draws(lines, "excess", 3)] == [1, 9, 19]
    assert len(numbers.choose_draws(lines, "block", 50)) == 10
    assert numbers.choose_draws(lines, "minor", 3) == []


def test_the_table_says_what_a_number_changes():
    lines = [make_line(0, ["excess"], ["InputDelay"]), make_line(1, ["excess"], ["InputDelay"])]
    own = {"number": "excess", "factor": 2.0}
    changed = [
        make_line(0, names=["CoulombFriction"], gap=1.5, **own),
        make_line(1, names=["InputDelay"], **own),
    ]
    rows = {(row[0], row[2]): row for row in numbers.write_rows(lines, changed)}
    assert rows["excess", "3"][3:] == ("2 of 2", "1 of 2", "-1", "+1", "1.50")
    assert rows["excess", "0.75"][3:5] == ("2 of 2", "none run")
    assert len(rows) == 2 * len(numbers.list_judged_numbers())


def test_a_draw_is_diagnosed_with_the_other_value_and_the_table_is_left_as_it_was(monkeypatch):
    seen = []
    monkeypatch.setattr(
        numbers.study, "run", lambda *_, watched: seen.append(THRESHOLD.many_effects) or {}
    )
    before = THRESHOLD.table()
    line = numbers.run("many_effects", 0.5, ("one", 0, 10))
    assert seen == [2]
    assert line == {"number": "many_effects", "factor": 0.5}
    assert THRESHOLD.table() == before


@pytest.mark.parametrize(("value", "factor", "wanted"), [(1, 0.5, 1), (50, 0.5, 25), (0.2, 2, 0.4)])
def test_a_count_stays_a_count(value, factor, wanted):
    assert numbers.change_number(value, factor) == wanted
