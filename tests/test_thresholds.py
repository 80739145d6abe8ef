"""One place for every number that decides a name: its table, its reasons, and what uses it."""

import ast
import re
from dataclasses import fields
from pathlib import Path

import pytest

from ctrlid.diagnosis.thresholds import KINDS, THRESHOLD, Thresholds, declare_number, vary_numbers

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted(
    path for path in (ROOT / "ctrlid" / "diagnosis").glob("*.py") if path.stem != "thresholds"
)
LAYOUT = {
    "wording",
    "report_text",
    "saving",
    "several_records",
    "progress",
}  # columns and digits of texts
PLAIN = {0, 1, 2, 0.5}
# Coefficients of published formulas, and numbers that belong to nobody's judgement.
FORMULAS = {
    ("noise_tests", "_compute_force_deviates"),  # D'Agostino; Anscombe and Glynn
    ("noise_tests", "_test_tails"),  # kurtosis of a Gaussian, and its variance 24 / n
    ("noise_tests", "compute_excess"),  # kurtosis of a Gaussian
    ("gap", "draw_noise"),  # three streams of random numbers
    ("verdict", "write_conclusion"),  # per cent
    ("findings", "SensorNoise"),  # per cent
}
CONSTANTS = {
    ("procedure", "PROGRESS"),
    ("replicas", "SEEDS"),
    # Ratios of units, by which a log can be off.
    ("log_errors", "DEGREE"),
    ("log_errors", "REPAIRS"),
}


def numbers_in(source, stem):
    """Numbers of a file that stand outside the table, as (place, number)."""
    tree = ast.parse(source)
    found = []
    for node in tree.body:
        targets = [t.id for t in getattr(node, "targets", ()) if isinstance(t, ast.Name)]
        name = getattr(node, "name", "") or (targets[0] if targets else "")
        if (stem, name) in FORMULAS | CONSTANTS:
            continue
        inside = {getattr(n, "name", "") for n in ast.walk(node)}
        if any((stem, n) in FORMULAS for n in inside):
            continue
        # The column of a table of signals and the formats of texts are no judgement.
        indexed = {id(n.slice) for n in ast.walk(node) if isinstance(n, ast.Subscript)}
        texts = {id(c) for n in ast.walk(node) if isinstance(n, ast.JoinedStr) for c in ast.walk(n)}
        for n in ast.walk(node):
            if isinstance(n, ast.Constant) and type(n.value) in (int, float):
                plain = abs(n.value) in PLAIN and not name.isupper()
                if not plain and id(n) not in indexed | texts:
                    found.append((name, n.value))
    return found


@pytest.mark.parametrize("path", [p for p in FILES if p.stem not in LAYOUT], ids=lambda p: p.stem)
def test_no_number_stands_outside_the_table(path):
    assert numbers_in(path.read_text("utf-8"), path.stem) == []


@pytest.mark.parametrize(
    "line",
    ["NEARLY = 0.7  # of the best", "def f(gain):\n    return gain > 3.7", "LIMITS = (0.9, 0.8)",
     "MANY = 2", "def f(fit, rounds=14):\n    return fit"],
)  # fmt: skip
def test_a_number_outside_the_table_is_found(line):
    assert numbers_in(line, "growth")


def test_every_number_has_one_kind_a_reason_and_a_unit():
    for t in THRESHOLD.table():
        assert t.kind in KINDS
        assert len(t.reason.split()) >= 3, t.name
        assert not re.search(rf"(?<![\w.]){re.escape(str(t.value))}(?![\w.])", t.reason), t.name
        assert t.unit or "chance" in t.reason or "probability" in t.reason or t.kind == "cost"
    laws = [t for t in THRESHOLD.table() if t.kind == "law"]
    assert laws
    assert THRESHOLD.gate == 5.0


def test_a_number_without_a_reason_or_with_two_is_refused():
    with pytest.raises(ValueError, match="exactly one reason, given none"):
        declare_number(1.0)
    with pytest.raises(ValueError, match="given law and study"):
        declare_number(1.0, law="so it is", study="and so it was chosen")


def test_every_number_is_used():
    text = "\n".join(
        path.read_text("utf-8") for folder in ("diagnosis", "reporting")
        for path in (ROOT / "ctrlid" / folder).rglob("*.py") if path.stem != "thresholds"
    )  # fmt: skip
    unused = [f.name for f in fields(Thresholds)
              if not re.search(rf"THRESHOLD\.{f.name}\b", text)]  # fmt: skip
    assert unused == []


def test_numbers_are_varied_within_a_block_and_come_back():
    known = THRESHOLD.gate
    with vary_numbers(gate=7.0, near_winner=0.3):
        assert (THRESHOLD.gate, THRESHOLD.near_winner) == (7.0, 0.3)
    assert THRESHOLD.gate == known

    def fail():
        with vary_numbers(gate=9.0):
            assert THRESHOLD.gate == 9.0
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        fail()
    assert THRESHOLD.gate == known
    with pytest.raises(AttributeError, match="no_such"), vary_numbers(no_such=1.0):
        pass


# What was measured on records, and an example: no numbers of the table.
MEASURED = {"10 %", "13", "0.7", "3.2", "2.53", "0.31", "18", "426"}


def numbers_of(page):
    """Numbers in the sentences of a page, without code, formulas, references and steps."""
    page = page.split("References\n---")[0]
    page = re.sub(r"(?m)^(>>>|\.\.\.) .*\n", "", page)
    page = re.sub(r"\.\. math::.*?\n\n(?=\S)", "", page, flags=re.DOTALL)
    page = re.sub(r":?\w*:?`+[^`]*`+|\[\d+\]_|[Ss]tep \d+", "", page)
    return re.findall(r"(?<![\w|])\d+(?:\.\d+)?(?: %)?", page)


def test_the_theory_page_takes_its_numbers_from_the_table():
    page = (ROOT / "docs" / "theory" / "diagnosis.rst").read_text("utf-8")
    assert ".. thresholds::" in page
    known = {t.name for t in THRESHOLD.table()}
    used = set(re.findall(r"\|([a-z_]+)\|", re.sub(r":math:`[^`]*`", "", page)))
    assert used <= known
    assert len(used) > 25
    assert set(numbers_of(page)) <= MEASURED
    assert numbers_of(page.replace("|gate|", "7")) != numbers_of(page)


# --- statements in words, wherever they stand

WORDS = {"ten": 10, "a tenth": 0.1, "a quarter": 0.25, "quarter": 0.25, "half": 0.5}
NUMBER = rf"(\d[\d ]*\d|\d+(?:\.\d+)?|{'|'.join(WORDS)})"
# What a page or a docstring may say of a number, N, with what it then has to say.
STATEMENTS = {
    "N in units of the Bayesian": lambda t: 2 * t.gate,
    "between N and ten times its given value": lambda t: 1 / t.parameter_range,
    "between a tenth and N times its given value": lambda t: t.parameter_range,
    "the last N of (?:each|what counts|every)": lambda t: t.held_out,
    "N is strong": lambda t: t.strong,
    "more than N of the floor's variance": lambda t: t.large_disturbance,
    "within N units of log-likelihood": lambda t: t.close,
    "Vuong's test at z = N": lambda t: t.vuong_z,
    "more than N samples is fitted on evenly": lambda t: t.fitted_samples,
}


def texts():
    """Pages, the README, and what the package says of itself and prints, one line each."""
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.rst"), *(ROOT / "examples").glob("*.py"),
             *(ROOT / "ctrlid").rglob("*.py")]  # fmt: skip
    kept = (p for p in pages if p.name != "CHANGELOG.md" and "_build" not in p.parts)
    return {str(p.relative_to(ROOT)): " ".join(p.read_text("utf-8").split()) for p in kept}


def disagreements(pages):
    """Statements that say another number than the table, as (page, pattern, what it says)."""
    wrong = []
    for page, text in pages.items():
        for pattern, number in STATEMENTS.items():
            for said in re.findall(pattern.replace("N", NUMBER), text):
                known = WORDS.get(said) or float(said.replace(" ", ""))
                if known != pytest.approx(number(THRESHOLD)):
                    wrong.append((page, pattern, said))
    return wrong


def test_no_page_states_another_number_than_the_table():
    pages = texts()
    assert disagreements(pages) == []
    said = "\n".join(pages.values())
    assert [p for p in STATEMENTS if not re.search(p.replace("N", NUMBER), said)] == []


def test_a_page_that_states_another_number_is_found():
    with vary_numbers(gate=7.0, held_out=0.2, fitted_samples=50_000):
        found = {page for page, _, _ in disagreements(texts())}
    assert "ctrlid/diagnosis/procedure.py" in found
    assert "docs/theory/speed.rst" in found
