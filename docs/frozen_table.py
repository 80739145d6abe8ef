"""The tables of the frozen study in the manual, printed from the file of its lines."""

import importlib.util
import sys
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
FILE = BENCHMARKS / "frozen_study.jsonl.gz"


def load_study():
    """Return ``benchmarks/study_frozen.py`` as a module."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        spec = importlib.util.spec_from_file_location(
            "study_frozen", BENCHMARKS / "study_frozen.py"
        )
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(BENCHMARKS))
    return module


def write_list_table(head, rows, widths):
    """Return the lines of a list table."""
    lines = [".. list-table::", "   :header-rows: 1", f"   :widths: {widths}", ""]
    for first, *rest in [head, *rows]:
        lines.append(f"   * - {first}")
        lines += [f"     - {cell}" for cell in rest]
    return [*lines, ""]


def write_tables(path=FILE):
    """Return the tables of a study as lines of a page."""
    study = load_study()
    lines = study.read(path)
    out = [study.describe_draws(lines), ""]
    out += write_list_table(("asked", "target", "measured, with Wilson's 95 % interval"),
                            study.score(lines), "50 12 38")  # fmt: skip
    out += ["One effect, by what it is worth:", ""]
    out += write_list_table(("worth", "a finding", "the truth in a set", "a set without the truth"),
                            study.find_power(lines), "16 28 28 28")  # fmt: skip
    out += ["Every answer that is wrong, with what the truth was worth in brackets:", ""]
    return out + [f"- {miss}" for miss in study.find_misses(lines)]


def write_summary(path=FILE):
    """Return what has a target, what was measured and the target, as a list of sentences."""
    study = load_study()
    lines = study.read(path)
    out, first = [study.describe_draws(lines), ""], ""
    for what, target, found in study.score(lines):
        own = what.strip()
        if own.startswith("the same: "):
            own = f"{first}: {own.removeprefix('the same: ')}"
        else:
            first = own.rpartition(":")[0] or own
        if target and "no draw" not in found:
            out.append(f"- {own[0].upper()}{own[1:]}: {found}; the target is {target}.")
    return out


class FrozenStudy(Directive):
    """Tables and misses of the frozen study, or with ``summary`` the main figures alone."""

    optional_arguments = 1

    def run(self):
        """Return the tables."""
        place = nodes.Element()
        write = write_summary if self.arguments == ["summary"] else write_tables
        text = StringList(write(), source="frozen_study")
        self.state.nested_parse(text, self.content_offset, place)
        return place.children


def setup(app):
    """Register the directive."""
    app.add_directive("frozen-study", FrozenStudy)
    return {"parallel_read_safe": True}
