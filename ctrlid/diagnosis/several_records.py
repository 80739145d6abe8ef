"""Several records that differ in their effects: one diagnosis made of one for each record."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from .._base.text import with_error, write_list, write_number
from ..effects import AbstractEffect
from ..loop.loop import Loop
from .candidates import is_same_kind
from .findings import Calibrated, Candidate, Finding, Gap
from .result import Diagnosis
from .thresholds import THRESHOLD
from .wording import join_names


@dataclass(frozen=True, eq=False)
class Shared:
    """One effect and the findings that may be it, by the number of their record."""

    kinds: tuple[AbstractEffect, ...]
    seen: dict[int, Finding]


def merge_diagnoses(loop: Loop, parts: Sequence[Diagnosis]) -> Diagnosis:
    """Return one diagnosis of several records, each of which was diagnosed alone.

    Parameters
    ----------
    loop : Loop
        The model as given.
    parts : sequence of Diagnosis
        One for each record, all of them explained or with nothing missing.

    Returns
    -------
    Diagnosis
        Findings say in which records they were seen, and how large. Where no effect but a
        parameter of the model tells the records apart, the verdict is ``"unknown"``.
    """
    lead = max(parts, key=lambda p: max((f.evidence for f in p.findings), default=0.0))
    findings = tuple(sorted((_merge_findings(s, len(parts)) for s in _match_findings(parts)),
                            key=lambda f: -f.evidence))  # fmt: skip
    calibrated, differing = _merge_calibrated(parts)
    complete = loop.with_parameters({c.name: c.after for c in calibrated})
    for f in findings:
        if not any(is_same_kind(f.effect, e) for e in complete.effects):
            complete = complete.with_effect(f.effect)
    notes = _merge_notes(parts)
    alike = [k for k, p in enumerate(parts) if p.gap.name == lead.gap.name]
    notes.append(
        "the records do not lack the same effects, so each was diagnosed alone. The gap is that of "
        f"{_name_records(alike, len(parts))}, on the last quarter of each. The table of where the "
        "error is, the curves of the picture, the sensor noise and the random force are those of "
        f"record {parts.index(lead) + 1}"
    )
    others = [f"that of record {k + 1} is the RMS error of the {p.gap.name}, {p.gap.written_sizes}"
              for k, p in enumerate(parts) if k not in alike]  # fmt: skip
    if others:
        notes.append(
            f"the {lead.gap.name} tells nothing in each record, and errors of different kinds have "
            f"no mean: beside the gap above, {write_list(others)}"
        )
    verdict, sentence = lead.verdict, _write_sentence(findings, len(parts))
    if differing:
        words = "; ".join(differing)
        notes.append(f"the free parameters differ between the records: {words}")
    if not findings and differing:
        verdict = "unknown"
        sentence = (f"The model explains each record alone, but with different values: {words}. "
                    "The cause of this difference is not in the model.")  # fmt: skip
    return replace(
        lead, verdict=verdict, sentence=sentence, findings=findings, loop=complete,
        gap=_merge_gaps(lead.gap, [parts[k].gap for k in alike]), ranking=_merge_rankings(parts),
        calibrated=calibrated,
        tests={name: min(p.tests.get(name, 1.0) for p in parts) for name in lead.tests},
        notes=tuple(notes),
    )  # fmt: skip


def _match_findings(parts: Sequence[Diagnosis]) -> list[Shared]:
    """Put findings of different records together that may be one and the same effect."""
    every = [(k, f) for k, p in enumerate(parts) for f in p.findings]
    found: list[Shared] = []
    for k, f in sorted(every, key=lambda pair: -pair[1].evidence):
        mine = (f.effect, *f.alternatives)
        for i, s in enumerate(found):
            common = tuple(e for e in s.kinds if any(is_same_kind(e, other) for other in mine))
            if common and k not in s.seen:
                found[i] = Shared(common, {**s.seen, k: f})
                break
        else:
            found.append(Shared(mine, {k: f}))
    return found


def describe_presence(seen: Sequence[int], records: int) -> str:
    """Say in which of several records an effect was seen.

    Parameters
    ----------
    seen : sequence of int
        Numbers of the records, from 0.
    records : int
        How many there are.

    Returns
    -------
    str
        ``"seen in every record"`` or, for instance, ``"seen in record 1 of 2 only"``.
    """
    if len(seen) == records:
        return "seen in every record"
    if not seen:
        return "seen in no record alone"
    return f"seen in {_name_records(seen, records)} of {records} only"


def _write_values(effect: AbstractEffect) -> str:
    return ", ".join(f"{k} = {write_number(v, 4)}" for k, v in effect.values().items())


def _find_kind(kind: AbstractEffect, f: Finding) -> AbstractEffect:
    return next(e for e in (f.effect, *f.alternatives) if is_same_kind(kind, e))


def _merge_findings(s: Shared, records: int) -> Finding:
    """Return what several records say of an effect; the clearest gives the values."""
    best = max(s.seen.values(), key=lambda f: f.evidence)
    chosen, *others = (_find_kind(kind, best) for kind in s.kinds)
    numbers = sorted(s.seen)
    note = describe_presence(numbers, records)
    if len(numbers) > 1:
        sizes = [
            f"{_write_values(_find_kind(chosen, s.seen[k]))} in record {k + 1}" for k in numbers
        ]
        note += f"; each has its own size: {write_list(sizes)}"
    sure = is_same_kind(chosen, best.effect)
    return replace(
        best, effect=chosen, alternatives=tuple(others),
        standard_errors=best.standard_errors if sure else {},
        evidence=sum(f.evidence for f in s.seen.values()), note=note,
        records=tuple(k + 1 for k in numbers),
        experiment=best.experiment if others else "", reference=best.reference if others else None,
    )  # fmt: skip


def _merge_calibrated(parts: Sequence[Diagnosis]) -> tuple[tuple[Calibrated, ...], list[str]]:
    """Return the parameters' weighted means, and those that no single value explains."""
    means, differing = [], []
    for same in zip(*(p.calibrated for p in parts), strict=True):
        first = same[0]
        sure = [c for c in same if math.isfinite(c.standard_error) and c.standard_error > 0]
        if not sure:
            means.append(first)
            continue
        values = np.array([c.after for c in sure])
        weights = np.array([c.standard_error**-2 for c in sure])
        mean = float(weights @ values / weights.sum())
        before = float(np.mean([c.before for c in same]))
        means.append(
            Calibrated(
                first.name,
                first.given,
                before,
                mean,
                float(weights.sum()) ** -0.5,
                any(c.at_limit for c in same),
            )
        )
        spread = float(weights @ (values - mean) ** 2)
        if len(sure) > 1 and stats.chi2.sf(spread, len(sure) - 1) < THRESHOLD.telling:
            sizes = [f"{with_error(c.after, c.standard_error)} in record {k + 1}"
                     for k, c in enumerate(same)]  # fmt: skip
            differing.append(f"{first.name} = {write_list(sizes)}")
    return tuple(means), differing


def _write_sentence(findings: Sequence[Finding], records: int) -> str:
    if not findings:
        return ("No effect that is large enough to show in these records is missing: the residuals "
                "are noise.")  # fmt: skip
    seen = [describe_presence([k - 1 for k in f.records], records) for f in findings]
    them = "them" if len(findings) > 1 else "it"
    return f"The model lacks {join_names(findings, seen)}. With {them} the residuals are noise."


def _merge_gaps(lead: Gap, parts: Sequence[Gap]) -> Gap:
    """Return the RMS over records whose gaps are of one kind; the curves are those of one."""
    weights = np.array([p.samples or len(p.time) for p in parts], dtype=float)

    def rms(name: str) -> float:
        sizes = np.array([getattr(p, name) for p in parts])
        return float(np.sqrt(np.average(sizes**2, weights=weights)))

    pairs = zip(lead.outputs, zip(*(p.outputs for p in parts), strict=True), strict=True)
    return replace(
        lead, given=rms("given"), before=rms("before"), after=rms("after"), floor=rms("floor"),
        recalibrated=rms("fitted"), trivial=rms("trivial"), widest=max(p.widest for p in parts),
        samples=sum(p.samples for p in parts),
        outputs=tuple(_merge_gaps(one, of) for one, of in pairs),
    )  # fmt: skip


def _merge_rankings(parts: Sequence[Diagnosis]) -> tuple[Candidate, ...]:
    return tuple(replace(c, record=k) for k, p in enumerate(parts, 1) for c in p.ranking)


def _merge_notes(parts: Sequence[Diagnosis]) -> list[str]:
    """Return the notes of all, each with the records that it is of where it is not of all."""
    where: dict[str, list[int]] = {}
    for k, p in enumerate(parts):
        for note in dict.fromkeys(p.notes):
            where.setdefault(note, []).append(k)
    return [
        note if len(ks) == len(parts) else f"{_name_records(ks, len(parts))}: {note}"
        for note, ks in where.items()
    ]


def _name_records(numbers: Sequence[int], records: int) -> str:
    if len(numbers) == records:
        return "all records"
    return f"record{'s' if len(numbers) > 1 else ''} {write_list([str(k + 1) for k in numbers])}"
