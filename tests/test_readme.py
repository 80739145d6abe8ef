"""What the README shows is what its script prints today, up to the last digits of an estimate."""

import re
from pathlib import Path

import pytest

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
NUMBER = re.compile(r"[-+]?\d[\d_]*\.?\d*(?:e[-+]?\d+)?")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def comparable(text):
    # The largest of 25 correlations and its lag are a matter of the last digit.
    return [line.split() for line in text.splitlines() if " at lag " not in line and line.strip()]


def printed_by(script, capsys):
    assert len(script.strip().splitlines()) <= 12
    exec(compile(script, "README.md", "exec"), {})
    return comparable(capsys.readouterr().out)


def agree(printed, shown):
    assert len(printed) == len(shown)
    for new, old in zip(printed, shown, strict=True):
        assert len(new) == len(old)
        for word, said in zip(new, old, strict=True):
            assert NUMBER.sub("#", word) == NUMBER.sub("#", said)
            for a, b in zip(NUMBER.findall(word), NUMBER.findall(said), strict=True):
                assert float(a) == pytest.approx(float(b), rel=0.05, abs=0.02)
        if "other" in new:  # So many other effects: a count, and no estimate.
            assert new == old


@pytest.mark.parametrize(("block", "title"), [(0, "pole at s"), (1, "Diagnosis of")])
def test_the_scripts_print_what_is_shown(block, title, capsys):
    """Between the dots; the parts appear in this order."""
    shown = next(b for b in blocks("text") if title in b)
    left = printed_by(blocks("python")[block], capsys)
    parts = [comparable(part) for part in re.split(r"^\.\.\.\n", shown, flags=re.MULTILINE)]
    assert sum(map(len, parts)) >= 5
    for part in filter(None, parts):
        start = next(k for k, words in enumerate(left) if words[:3] == part[0][:3])
        agree(left[start : start + len(part)], part)
        left = left[start + len(part) :]


def test_a_stranger_reads_it_in_three_minutes():
    assert len(README.splitlines()) <= 130


def test_the_two_commands_are_one_line_each():
    commands = [line for b in blocks("bash") for line in b.strip().splitlines()]
    assert len(commands) == 2
    assert all(c.startswith("python3 -m venv .venv && .venv/bin/pip install ") for c in commands)
    assert commands[0].endswith(".venv/bin/python -m ctrlid")
    assert commands[1].endswith(".venv/bin/pytest")
