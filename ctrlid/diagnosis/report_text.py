"""The printed report of a diagnosis: what a control engineer reads in a minute."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

from .._base.text import write_number, write_quantity
from . import wording
from .findings import Finding, Gap

if TYPE_CHECKING:
    from .result import Diagnosis

# Lines of the report have at most so many characters, which fits a terminal.
WIDTH = 100
# Beside names of any length, words have so many characters at least.
NARROW = 30


def write_report_text(found: Diagnosis) -> str:
    """Return a diagnosis in plain words.

    Parameters
    ----------
    found : Diagnosis
        From `diagnose`.

    Returns
    -------
    str
        Lines of at most 100 columns. Bad news is in capitals.
    """
    lines = [
        f"Diagnosis of {found.record or 'a record'}",
        *_wrap_text(wording.write_headline(found), 2),
    ]
    lines += ["", *write_gap_lines(found.gap), "", *_write_where(found)]
    if found.findings:
        lines += ["", "  what is missing"]
        for k, finding in enumerate(found.findings, 1):
            lines += _write_finding(found, finding, f"{k}. ")
    if found.stand_ins:
        lines += ["", f"  {wording.STAND_INS}"]
        for k, finding in enumerate(found.stand_ins, 1):
            lines += _write_finding(found, finding, f"{k}. ")
    if found.added:
        lines += _wrap_text(wording.explain_evidence(), 4)
        if found.verdict == "explained":
            lines += _wrap_text(wording.explain_catalogue(), 4)
    elif found.verdict == "nothing missing" and found.sensitivity:
        lines += ["", *_write_sensitivity(found)]
    lines += ["", *_write_parameters(found)]
    lines += _wrap_text(wording.describe_sensor_noise(found), 2, hang=4)
    lines += _wrap_text(wording.describe_disturbance(found), 2, hang=4)
    lines += _wrap_text(wording.describe_remains(found), 2, hang=4)
    if found.audit:
        lines.append("  about the record:")
    for remark in found.audit:
        lines += _wrap_text(remark, 4, hang=6)
    for note in found.notes:
        lines += _wrap_text(f"note: {note}", 2, hang=4)
    lines.append(f"  computed in {found.seconds:.1f} s")
    return "\n".join(line.rstrip() for line in lines)


def _wrap_text(text: str, indent: int, hang: int | None = None) -> list[str]:
    later = " " * (indent if hang is None else hang)
    # No line may be broken beside these signs.
    for sign in ("=", "±"):
        text = text.replace(f" {sign} ", f"\xa0{sign}\xa0")
    lines = textwrap.wrap(text, WIDTH, initial_indent=" " * indent, subsequent_indent=later,
                          break_on_hyphens=False)  # fmt: skip
    return [line.replace("\xa0", " ") for line in lines]


def write_gap_lines(gap: Gap) -> list[str]:
    """Return the sizes of the gap as aligned lines."""
    wide = max(len(label) for label, *_ in wording.list_gap_rows(gap)) if gap.outputs else 0
    sizes = max((len(size) for _, size, _ in wording.list_gap_rows(gap)), default=0)
    rows = [f"    {label:<{max(wide + 1, 20)}}{size:>{max(sizes, 12)}}   {times}"
            for label, size, times in wording.list_gap_rows(gap)]  # fmt: skip
    head = _wrap_text(wording.introduce_gap(gap), 2, hang=4)
    words = (wording.explain_prediction(gap), wording.describe_shrinking(gap),
             wording.describe_trivial(gap))  # fmt: skip
    return [*head, *rows, *(line for text in words for line in _wrap_text(text, 4))]


def _write_where(found: Diagnosis) -> list[str]:
    places = wording.list_telling_places(found)
    if not places:
        return _wrap_text(f"where the error is: {wording.describe_nowhere(found)}", 2, hang=4)
    same = not found.added
    head = "  where the error is: normalized RMS of the one-step errors (1 for noise)"
    wide = max(12, *(len(place.axis) for place in places))
    rows = [f"{head:<79}{'there' if same else 'before':>10}"
            f"{'' if same else 'after':>10}"]  # fmt: skip
    for place in places:
        room = max(72 - wide, NARROW)
        first, *more = textwrap.wrap(wording.describe_place(place), room) or [""]
        before, after = (
            write_number(wording.find_told_rms(place, v), 3) for v in (place.before, place.after)
        )
        after = "" if same else after
        rows.append(f"    {place.axis:<{wide}} {first:<{room + 2}}{before:>10}{after:>10}")
        rows += [f"{'':<{wide + 5}}{line}" for line in more]
    return rows


def _write_finding(found: Diagnosis, finding: Finding, label: str) -> list[str]:
    lines = _wrap_text(f"{label}{wording.name_finding(finding)}", 4, hang=7)
    lines += _wrap_text(wording.describe_size(found, finding), 7, hang=9)
    for text in (wording.describe_certainty(found, finding), *wording.list_doubts(found, finding)):
        lines += _wrap_text(text, 7, hang=9)
    return lines


def _write_sensitivity(found: Diagnosis) -> list[str]:
    rows = [f"{key:<{max(46 - len(size), len(key) + 1)}}{size}"
            for key, size in wording.list_sensitivity_rows(found)]  # fmt: skip
    half = (len(rows) + 1) // 2
    right = [*rows[half:], ""][:half]
    head = f"  size of each effect that {wording.describe_power()}"
    wide = max(map(len, rows[:half]), default=0)
    if 8 + wide + max(map(len, right), default=0) > WIDTH:
        return [head, *(f"    {row}" for row in rows)]
    return [head, *(f"    {a:<{wide}}    {b}" for a, b in zip(rows[:half], right, strict=True))]


def _write_parameters(found: Diagnosis) -> list[str]:
    if not found.calibrated:
        return ["  the model has no free parameters"]
    last = "with the effects" if found.added else "fitted"
    rows = [("free parameters", "given", "recalibrated", f"{last} ± standard error")]
    for c in found.calibrated:
        fitted = write_quantity(c.after, error=c.standard_error, digits=4)
        if c.standard_error == 0:
            fitted = f"{write_number(c.after, 4)} (ON ITS BOUND)"
        rows.append((f"  {c.name}", write_number(c.given, 4), write_number(c.before, 4), fitted))
    if not found.added:
        rows = [(a, b, "", d) for a, b, _, d in rows]
    lines = [f"  {a:<26}{b:>12}{c:>14}  {d:>34}" for a, b, c, d in rows]
    return [*lines, *_wrap_text(wording.describe_limits(found), 4)]
