"""The tables of the studies in the manual, printed from the files of their lines."""

import importlib.util
import sys
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
FILES = {"study_frozen": "frozen_study.jsonl.gz", "study_suspects": "suspects.jsonl.gz"}


def load_study(name):
    """Return a script of the benchmarks as a module."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(BENCHMARKS))
    return module


def read_study(name, path=None):
    """Return a study as a module, and its lines."""
    study = load_study(name)
    return study, study.read(path or BENCHMARKS / FILES[name])


def write_list_table(head, rows, widths):
    """Return the lines of a list table."""
    lines = [".. list-table::", "   :header-rows: 1", f"   :widths: {widths}", ""]
    for first, *rest in [head, *rows]:
        lines.append(f"   * - {first}")
        lines += [f"     - {cell}" for cell in rest]
    return [*lines, ""]


def write_tables(name, path=None):
    """Return the tables of a study as lines of a page."""
    study, lines = read_study(name, path)
    out = [study.describe_draws(lines), ""]
    out += write_list_table(("asked", "target", "measured, with Wilson's 95 % interval"),
                            study.score(lines), "50 12 38")  # fmt: skip
    if hasattr(study, "find_power"):
        out += ["One effect, by what it is worth:", ""]
        out += write_list_table(
            ("worth", "a finding", "the truth in a set", "a set without the truth"),
            study.find_power(lines), "16 28 28 28",
        )  # fmt: skip
    out += ["Every answer that is wrong, with the truth and, where it was measured, its worth:", ""]
    return out + [f"- {miss}" for miss in study.find_misses(lines)]


def write_number_tables():
    """Return the table of the numbers of judgement as lines of a page."""
    numbers = load_study("study_numbers")
    lines = numbers.study.read(BENCHMARKS / FILES["study_frozen"])
    changed = numbers.study.read(BENCHMARKS / "numbers.jsonl.gz", numbers.study.make_changed_key)
    rows = numbers.write_rows(lines, changed)
    return write_list_table(numbers.HEAD, rows, "22 8 8 16 12 10 12 12")


def write_summary(name, path=None):
    """Return what has a target, what was measured and the target, as a list of sentences."""
    study, lines = read_study(name, path)
    out, first = [study.describe_draws(lines), ""], ""
    for what, target, found in study.score(lines):
        own = what.strip()
        if own.startswith("the same"):
            own = first + own.removeprefix("the same")
        else:
            first = own.rpartition(":")[0] or own
        if target and "no draw" not in found:
            out.append(f"- {own[0].upper()}{own[1:]}: {found}; the target is {target}.")
    return out


class Study(Directive):
    """Tables and misses of a study, or with ``summary`` its main figures alone."""

    required_arguments = 1
    optional_arguments = 1

    def run(self):
        """Return the tables."""
        name, *how = self.arguments
        place = nodes.Element()
        if name == "study_numbers":
            lines = write_number_tables()
        else:
            lines = write_summary(name) if how == ["summary"] else write_tables(name)
        self.state.nested_parse(StringList(lines, source=name), self.content_offset, place)
        return place.children


def setup(app):
    """Register the directive."""
    app.add_directive("study", Study)
    return {"parallel_read_safe": True}
