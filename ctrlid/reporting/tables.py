"""Results as tables and sentences, for any page that shows them."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from .._base import text as _text
from .._base.errors import CtrlidError
from ..data.record import Record, list_rows
from ..design.controller_trial import ControllerTrial
from ..design.redesigning import Redesign
from ..diagnosis import wording
from ..diagnosis.findings import BinnedErrors
from ..diagnosis.result import Diagnosis
from ..effects.base import name_with_subject
from ..estimation.identified_model import Estimate, IdentifiedModel, IdentifiedSystem
from ..estimation.likelihood.physics_estimate import LoopFit
from ..physics.trace import timebase
from ..validation.comparison import Comparison, write_fit
from ..validation.record_audit import Audit

# What u does between the samples, by the record's hold.
BETWEEN = {
    "zoh": "is held",
    "foh": "is a straight line",
    "bandlimited": "is reconstructed as a band-limited signal",
}


@dataclass(frozen=True, repr=False)
class Table(_text.Printed):
    """Numbers in rows, the first column of which says what they are.

    Parameters
    ----------
    head : tuple of str
        Titles of the columns.
    rows : tuple of tuple of str
        The rows, as wide as the head.
    caption : str, optional
        What the table shows.

    Raises
    ------
    CtrlidError
        If a row is not as wide as the head.

    Examples
    --------
    >>> print(Table(("pole", "rad/s"), (("unstable", "25.6"), ("stable", "-25.6"))))
    pole        rad/s
    unstable     25.6
    stable      -25.6
    """

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""

    def __post_init__(self) -> None:
        wrong = [row for row in self.rows if len(row) != len(self.head)]
        if wrong:
            raise CtrlidError(
                f"each row of this table needs {len(self.head)} cells; given {wrong[0]}"
            )

    def __str__(self) -> str:
        lines = (self.head, *self.rows)
        widths = [max(len(line[i]) for line in lines) for i in range(len(self.head))]
        text = "\n".join(
            "   ".join([line[0].ljust(widths[0]), *(c.rjust(w) for c, w in
                       zip(line[1:], widths[1:], strict=True))]).rstrip() for line in lines
        )  # fmt: skip
        return f"{self.caption}\n{text}" if self.caption else text


@dataclass(frozen=True)
class Title:
    """A heading within the page of a result.

    Parameters
    ----------
    text : str
        The heading.
    """

    text: str


Block = Table | Title | str
PLACES = (
    "Normalized RMS of the one-step errors in the bin that is farthest from noise (1 for noise)."
)


def write_heading(result: Any) -> str:
    """Return a title for a result, or refuse what cannot be shown."""
    match result:
        case Record():
            return f"Record {result.name}".strip()
        case Audit():
            return "Audit of a record"
        case IdentifiedModel():
            return f"Model by {result.estimate.method}"
        case IdentifiedSystem():
            return f"Model by {next(iter(result.estimates.values())).method}"
        case LoopFit():
            return f"Physical parameters of {result.loop.plant.name}"
        case Comparison():
            return f"{result.what.split('(')[0]} against the record {result.record.name}".strip()
        case Redesign() | ControllerTrial():
            return "Redesign: promised against achieved"
        case Diagnosis():
            return f"Diagnosis of {result.record or 'a record'}"
        case Table():
            return result.caption or "Table"
    raise CtrlidError(
        "a report shows a Record, Audit, IdentifiedModel, IdentifiedSystem, LoopFit, Comparison, "
        "Redesign, ControllerTrial, Diagnosis, Table or Section, or a sequence of them; given "
        f"{type(result).__name__}"
    )


def make_blocks(result: Any) -> list[Block]:
    """Return a result as tables, headings and sentences."""
    match result:
        case Table():
            return [result]
        case Record():
            return [_make_record_table(result)]
        case Audit():
            return _make_audit_blocks(result)
        case IdentifiedModel():
            return _make_estimate_blocks(result.estimate)
        case IdentifiedSystem():
            return [block for name, estimate in result.estimates.items()
                    for block in (Title(name), *_make_estimate_blocks(estimate))]  # fmt: skip
        case LoopFit():
            return _make_loop_fit_blocks(result)
        case Comparison():
            tables = [
                t for one in result.outputs or (result,) for t in _make_comparison_tables(one)
            ]
            return [*tables, *result.notes, result.verdict]
        case Redesign():
            return _make_redesign_blocks(result)
        case ControllerTrial():
            return [Table(("", "promised on the model", "achieved on the physics"), result.rows),
                    result.verdict, f"{result.loop!r}."]  # fmt: skip
        case Diagnosis():
            return _make_diagnosis_blocks(result)
    # This refuses a result that no page can show.
    write_heading(result)
    return []


def _make_record_table(record: Record) -> Table:
    rows = tuple(
        (name, unit or "not given", *(f"{f(v):.6g}" for f in (np.min, np.mean, np.max, np.std)))
        for _, name, unit, _, v in list_rows(record)
    )
    share = f"{100 * record.valid.mean():.1f} %"
    valid = "" if record.valid.all() else f", {share} of them valid, whose numbers are these"
    between = BETWEEN[record.hold]
    caption = (
        f"{_text.write_count(len(record), 'sample')} at {record.dt:g} s, {record.duration:.4g} s "
        f"in all{valid}; "
        f"u {between} between samples."
    )
    head = ("signal", "unit", "smallest", "mean", "largest", "standard deviation")
    return Table(head, rows, caption)


def _make_audit_blocks(found: Audit) -> list[Block]:
    if not found.findings:
        return ["No defect was found in this record."]
    rows = tuple((f.kind, f.channel, "yes" if f.harmful else "no", f.text) for f in found.findings)
    return [Table(("finding", "channel", "harms a fit", "what it is"), rows)]


def _make_estimate_blocks(e: Estimate) -> list[Block]:
    held = {bound.quantity for bound in e.active_bounds}
    rows = []
    for name, value, error in zip(e.names, e.values, e.standard_errors, strict=True):
        known = "on its bound" if name in held else "fixed" if error == 0 else f"{error:.2g}"
        rows.append((name, f"{value:.7g}", known))
    sampled = e.structure.domain == "z"
    poles = tuple(
        (*((_text.write_number(z, 5),) if sampled else ()), _text.write_number(s, 5), f"{ds:.2g}")
        for z, s, ds in zip(e.poles, e.poles_s, e.poles_s_standard_errors, strict=True)
    )
    head = (*(("pole in z",) if sampled else ()), "pole in s [rad/s]", "standard error [rad/s]")
    text = str(e).splitlines()
    news = text[1 + next(i for i, line in enumerate(text) if "active bounds:" in line) :]
    period = f", dt = {e.dt:g} s" if e.dt else ""
    white = (
        " Standard errors are valid only if the errors are white."
        if e.errors == "equation error"
        else ""
    )
    used = _text.write_count(e.n_samples, "sample")
    caption = f"{_upper(e.method)}, {used} used{period}.{white}"
    return [
        Table(("coefficient", "value", "standard error"), tuple(rows), caption),
        Table(head, poles),
        *(line.strip() for line in news),
    ]


def _make_comparison_tables(c: Comparison) -> list[Table]:
    # Of several outputs, each error stands with its own unit.
    unit = "" if c.outputs else f" [{c.record.units.get('y', 'unit of y')}]"
    curves = tuple(
        (
            q.label,
            write_fit(q.fit),
            f"{q.rms:.3g} {q.unit if c.outputs else ''}".rstrip(),
            "-" if q.useless else f"{100 * q.noise_share:.1f} %",
        )
        for q in c.curves
    )
    tests = tuple(
        (t.name, "yes" if t.passed else "NO", f"{np.abs(t.values).max():.3f}",
         f"{t.band:.3f}", _text.write_p_value(t.p_value)) for t in c.tests
    )  # fmt: skip
    tables = [Table(("curve", "fit", f"RMS error{unit}", "noise explains"), curves, f"{c.what}.")]
    if tests:
        head = ("correlation", "passed?", "largest", "99 % band", "p-value")
        tables.append(Table(head, tests, "Correlation of the one-step errors."))
    return tables


def _make_loop_fit_blocks(fit: LoopFit) -> list[Block]:
    e = fit.estimate
    errors = ("on its bound" if name in e.active else
              f"{error:.2g}" if np.isfinite(error) else "not determined by the data"
              for name, error in zip(e.names, e.standard_errors, strict=True))  # fmt: skip
    rows = tuple(zip(e.names, (f"{v:.7g}" for v in e.values), errors, strict=True))
    first, *rest = str(e).splitlines()
    return [
        Table(("parameter", "value", "standard error"), rows, f"{_upper(first)}."),
        *(_upper(line.strip()) + "." for line in rest[len(e.names) :]),
        f"{fit.loop!r}.",
    ]


def _make_redesign_blocks(r: Redesign) -> list[Block]:
    z = "z" if timebase(r.controller) else "s"
    return [
        Table(("", "promised on the model", "achieved on the physics"), r.rows),
        r.verdict,
        f"{_upper(str(r).splitlines()[0])}, coefficients in falling powers of {z}.",
    ]


def _make_diagnosis_blocks(found: Diagnosis) -> list[Block]:
    caption = f"{_upper(wording.introduce_gap(found.gap))}."
    sizes = tuple(wording.list_gap_rows(found.gap))
    gap = Table(("", "RMS error", "relative to the noise floor"), sizes, caption)
    made: list[Block] = [
        wording.write_headline(found),
        gap,
        wording.explain_prediction(found.gap),
        wording.describe_shrinking(found.gap),
        wording.describe_trivial(found.gap),
    ]
    for title, named in (
        ("What is missing", found.findings),
        (_upper(wording.STAND_INS), found.stand_ins),
    ):
        if named:
            made.append(Title(title))
        for k, finding in enumerate(named, 1):
            sure = wording.describe_certainty(found, finding)
            made += [
                f"{k}. {wording.name_finding(finding)}. {wording.describe_size(found, finding)}.",
                f"{_upper(sure)}.",
            ]
            made += [f"{_upper(doubt)}." for doubt in wording.list_doubts(found, finding)]
    if found.added:
        made.append(wording.explain_evidence())
        if found.verdict == "explained":
            made.append(wording.explain_catalogue())
    if found.where:
        made.append(Title("Where the error is"))
    made += [
        f"{_name_place(p)}: {wording.describe_place(p)}."
        for p in wording.list_telling_places(found)
    ]
    sides = 2 if found.added else 1
    places = tuple(
        (
            _name_place(p),
            *(
                _text.write_number(wording.find_told_rms(p, v), 3)
                for v in (p.before, p.after)[:sides]
            ),
            *(_text.write_p_value(v) for v in (p.p_before, p.p_after)[:sides]),
        )
        for p in found.where
    )
    if places:
        columns = (
            "in bins of",
            *(("before", "after") if found.added else ("RMS",)),
            *(("p-value before", "p-value after") if found.added else ("p-value",)),
        )
        made.append(Table(columns, places, PLACES))
    if found.verdict == "nothing missing" and found.sensitivity:
        made.append(Table(("effect", f"size that {wording.describe_power()}"),
                          tuple(wording.list_sensitivity_rows(found))))  # fmt: skip
    made.append(Title("Parameters, noise and remarks"))
    parameters = tuple(
        (c.name, f"{c.given:.6g}", f"{c.before:.6g}", f"{c.after:.6g}",
         "on its bound" if c.standard_error == 0 else
         f"{c.standard_error:.2g}" if np.isfinite(c.standard_error) else "not in the data")
        for c in found.calibrated
    )  # fmt: skip
    if parameters:
        titles = ("parameter", "given", "recalibrated", "final", "standard error")
        made.append(Table(titles, parameters, "The free parameters of the model."))
        made.append(wording.describe_limits(found))
    made += [
        f"{_upper(line)}."
        for line in (
            wording.describe_sensor_noise(found),
            wording.describe_disturbance(found),
            wording.describe_remains(found),
        )
        if line
    ]
    if found.audit:
        made.append(Title("About the record"))
    made += [f"{remark.rstrip('.')}." for remark in found.audit]
    made += [f"Note: {remark.rstrip('.')}." for remark in found.notes]
    tried = tuple(
        (name_with_subject(c.effect), c.round_name.removeprefix("round "), f"{c.gain:.1f}",
         f"{c.penalty:.1f}", c.remark)
        for c in found.ranking if np.isfinite(c.gain)
    )  # fmt: skip
    if tried:
        # The column of remarks is shown only where there are any.
        width = 5 if any(row[-1] for row in tried) else 4
        heads = ("candidate", "round", "evidence", "penalty", "remark")[:width]
        rows = tuple(row[:width] for row in tried)
        made += [Title("What was tried"), Table(heads, rows, "The candidates that were refitted.")]
    return [block for block in made if block]


def _name_place(place: BinnedErrors) -> str:
    """Name the quantity that errors are binned by, and of several outputs whose errors they are."""
    return f"{place.axis}, errors of {place.output}" if place.output else place.axis


def _upper(text: str) -> str:
    return text[:1].upper() + text[1:]
