"""What a diagnosis found, phrase by phrase, for any report."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from .._base.text import choose_prefix, write_list, write_number, write_p_value, write_quantity
from ..effects import AbstractEffect, ReadingEffect
from .findings import COMPLETE, BinnedErrors, Finding, Gap
from .noise_tests import choose_alarm_level
from .saving import list_units
from .thresholds import THRESHOLD

if TYPE_CHECKING:
    from .result import Diagnosis

# The report shows so many quantities along which the errors are not noise.
# The report shows so many quantities along which the errors are not noise.
PLACES = 3
# So many failed tests are named, which still makes one sentence.
LISTED = 4
HEADLINES = {
    "nothing missing": "Nothing missing",
    "explained": "Explained",
    "partly explained": "PARTLY EXPLAINED: SOMETHING IS STILL MISSING",
    "unknown": "UNKNOWN: SOMETHING IS MISSING that no candidate explains",
}
EVIDENCE = (
    "Evidence: the logarithm of how many times likelier the record is with the effect than "
    "without; chance reaches 2 or 3, 10 is strong."
)
WIDENED = (
    "Recalibrating alone makes the one-step errors smaller and this gap larger: parameters cannot "
    "stand in for what is missing."
)
MASSES = ("m", "M", "mass")
# Units of a force parameter times a mass in kg, by its unit per unit of mass.
FORCES = {"m/s^2": "N", "1/s": "N s/m", "1/s^2": "N/m", "1/m": "kg/m"}


def write_headline(found: Diagnosis) -> str:
    """Return the verdict with its sentence."""
    return f"{HEADLINES[found.verdict]}. {found.sentence}"


def list_gap_rows(gap: Gap) -> list[tuple[str, str, str]]:
    """Return what the gap is, how large, and how many times the noise floor, row by row."""
    known = [v for v in (gap.floor, gap.after, gap.before) if 0 < v < math.inf]
    known = known or [v for v in (gap.given,) if 0 < v < math.inf]
    middle = math.exp(sum(map(math.log, known)) / len(known)) if known else 0.0
    factor, unit = choose_prefix(middle, gap.unit)
    places = 2 - math.floor(math.log10(factor * min(known))) if known else 0

    def size(value: float) -> str:
        if math.isfinite(value) and places <= 6:
            return f"{factor * value:.{max(places, 0)}f} {unit}".strip()
        if math.isfinite(value):
            return f"{write_number(factor * value, 3)} {unit}".strip()
        return "none" if math.isnan(value) else "RUNS AWAY"

    def times(value: float) -> str:
        ratio = value / gap.floor if gap.floor > 0 else math.nan
        if not math.isfinite(ratio):
            return ""
        return f"{ratio:.2f} x the floor" if ratio < 9.995 else f"{ratio:.0f} x the floor"

    cases = (("the model as given", gap.given), ("recalibrated", gap.before),
             ("with the effects", gap.after))  # fmt: skip
    shown = cases[:2] if gap.after == gap.before else cases
    rows = [(label, size(value), times(value)) for label, value in shown]
    return [*rows, ("noise floor", size(gap.floor), "what noise and random force leave")]


def describe_shrinking(gap: Gap) -> str:
    """Say how much of the gap above the noise floor the effects close; empty if they do not."""
    if gap.before == gap.after:
        return ""
    above = gap.before**2 - gap.floor**2
    if not math.isfinite(above):
        return ""
    if THRESHOLD.excess * gap.floor < gap.after < THRESHOLD.excess * gap.widest:
        widest = write_quantity(gap.widest, gap.unit)
        return (f"Two runs of the completed model that differ in noise alone end up as far as "
                f"{widest} apart, so the gap shows little of what the effects close; the "
                "one-step errors do.")  # fmt: skip
    if above <= 0 and gap.after < THRESHOLD.near_floor * gap.floor:
        return ("Noise alone moves two runs of the completed model apart by as much, so "
                "the gap cannot show what the effects close; the one-step errors do.")  # fmt: skip
    if above <= 0 or gap.after >= gap.before:
        return "On samples kept back the effects do NOT MAKE THE GAP SMALLER."
    share = min((gap.before**2 - gap.after**2) / above, 1.0)
    closed = (f"On samples kept back the effects close {write_percent(share)} of the squared gap "
              "above the noise floor.")  # fmt: skip
    return f"{closed} {WIDENED}" if gap.before > gap.given * THRESHOLD.widened else closed


def write_percent(share: float) -> str:
    """Write a share in percent, with more digits near the whole."""
    if 0 < share < 0.005:
        return "under 1 %"
    return f"{100 * share:.1f} %" if 0.99 < share < 0.9995 else f"{100 * share:.0f} %"


def list_telling_places(found: Diagnosis) -> list[BinnedErrors]:
    """Return the places where the disagreement sits, most telling first."""
    return [p for p in found.where if p.p_before < THRESHOLD.telling][:PLACES]


def find_highest_rms(levels: Iterable[float]) -> float:
    """Return the highest RMS among the bins that hold something, from mean squares; NaN without."""
    known = [v for v in levels if math.isfinite(v)]
    return math.sqrt(max(known, default=math.nan))


def describe_place(place: BinnedErrors) -> str:
    """Say where along its axis a place sits."""
    if place.words:
        return place.words.removeprefix(f"at {place.axis} ")
    if not np.isfinite(place.before).any():
        return "nowhere"
    k = int(np.nanargmax(place.before))
    low, high = (write_number(v, 3) for v in place.edges[k : k + 2])
    return f"between {low} and {high} {place.unit}".strip()


def describe_parameters(
    found: Diagnosis, effect: AbstractEffect, errors: dict[str, float] | None = None
) -> str:
    """Write the parameters of an effect with units and standard errors, if they are given."""
    units = list_units(found.loop, effect)
    words = []
    for name, value in vars(effect).items():
        if name not in units:
            words += [f"{name} = {value}"] if value != "" else []
            continue
        error = None if errors is None else errors.get(name)
        words.append(f"{name} = {write_quantity(value, units[name], error)}")
    return ", ".join(words)


def describe_forces(found: Diagnosis, effect: AbstractEffect) -> str:
    """Write the accelerations among the parameters as forces, where the mass is a parameter."""
    known = found.loop.parameters
    mass = next((name for name in MASSES if name in known), None)
    if effect.place != "force" or mass is None:
        return ""
    units = list_units(found.loop, effect)
    words = [write_quantity(known[mass] * value, FORCES[units[name]])
             for name, value in effect.values().items() if units[name] in FORCES]  # fmt: skip
    return f"{write_list(words)} at {mass} = {write_quantity(known[mass], 'kg')}" if words else ""


def describe_certainty(found: Diagnosis, finding: Finding) -> str:
    """Say how sure it is that something like this effect is there, and that it is this one."""
    sure = ("WEAK" if finding.evidence < THRESHOLD.strong else
            "strong" if finding.evidence < THRESHOLD.certain else "beyond doubt")  # fmt: skip
    text = (
        f"evidence {finding.evidence:.{0 if finding.evidence >= THRESHOLD.strong else 1}f}, {sure}"
    )
    if math.isfinite(finding.share) and len(found.findings) > 1:
        text += f"; closes {write_percent(finding.share)} of the squared gap above the floor"
    many = len(finding.names)
    if many > 1:
        text += f"; ONE OF {many} that explain the record"
    else:
        text += "; no other effect explains the record as well"
    if found.verdict == "partly explained" and not isinstance(finding.effect, ReadingEffect):
        text += ". It may stand in for what is still missing"
    return text


def list_doubts(found: Diagnosis, finding: Finding) -> list[str]:
    """Say what else it could be, and which experiment would tell."""
    lines = []
    apart = [e for e in finding.alternatives if type(e).__name__ not in finding.equivalents]
    if apart:
        others = [f"{type(e).__name__} ({describe_parameters(found, e)})" for e in apart]
        lines.append(f"this record does not tell it from {write_list(others)}")
    if finding.equivalents:
        lines.append(
            f"no record of u and y tells it from {write_list(finding.equivalents)}: on this "
            "plant they are the same"
        )
    if finding.experiment:
        lines.append(f"what would tell: {finding.experiment}")
    if finding.reference is not None:
        lines.append(f"a reference for it is ready: .reference, {len(finding.reference)} samples")
    return [*lines, *([finding.note] if finding.note else [])]


def name_finding(finding: Finding) -> str:
    """Name the effect of a finding and say what it is."""
    what = finding.effect.sentence.rstrip(".")
    return f"{finding.name}: {what[:1].lower()}{what[1:]}" if what else finding.name


def describe_size(found: Diagnosis, finding: Finding) -> str:
    """Write the fitted parameters of a finding, and its accelerations as forces if they are one."""
    force = describe_forces(found, finding.effect)
    size = describe_parameters(found, finding.effect, finding.standard_errors)
    return f"{size} ({force})" if force else size


def list_sensitivity_rows(found: Diagnosis) -> list[tuple[str, str]]:
    """Return the smallest visible size of each effect."""
    tried = {type(c.effect).__name__: c.effect for c in found.ranking}
    rows = []
    for key, size in found.sensitivity.items():
        label, _, name = key.partition(".")
        effect = tried.get(label)
        unit = "" if effect is None else list_units(found.loop, effect).get(name, "")
        rows.append((key, write_quantity(size, unit) if math.isfinite(size) else "not visible"))
    return rows


def describe_disturbance(found: Diagnosis) -> str:
    """Say how large the random force is, and in capitals if it may hide something."""
    d, unit = found.disturbance, f"{found.gap.unit}/s^2" if found.gap.unit else ""
    parts = [f"white {write_quantity(d.white, unit)}"] if d.white else []
    if d.coloured:
        parts.append(f"coloured {write_quantity(d.coloured, unit)} with a time constant of "
                     f"{write_quantity(d.time_constant, 's')}")  # fmt: skip
    if not parts:
        return "random force: none; the noise floor is sensor noise"
    words = " and ".join(parts)
    if math.isfinite(d.share):
        words += f", {write_percent(d.share)} of the noise floor's variance"
    if not d.large:
        return f"random force: {words}"
    return (f"A LARGE RANDOM FORCE: {words}. Effects that it hides cannot be seen; the verdict "
            "holds above it only")  # fmt: skip


def describe_remains(found: Diagnosis) -> str:
    """Say whether what is left is noise, by the tests of the final one-step errors."""
    if not found.tests:
        return "what remains: not tested"
    count = len(found.tests)
    name, p = min(found.tests.items(), key=lambda item: item[1])
    together = min(1.0, count * p)
    if found.verdict in COMPLETE or together > choose_alarm_level(len(found.findings)):
        doubt = f"{name}, {write_p_value(p)}"
        if p < THRESHOLD.telling:
            doubt += f", among so many {write_p_value(together)}"
        return f"what remains: noise, by {count} tests, the most doubtful of which is {doubt}"
    failed = sorted((v, k) for k, v in found.tests.items() if v < THRESHOLD.telling) or [(p, name)]
    names = [name for _, name in failed[:LISTED]]
    if len(failed) > LISTED:
        names[-1] = f"{len(failed) - LISTED + 1} others"
    return (f"what remains: NOT NOISE ALONE, by {len(failed)} of {count} tests: "
            f"{write_list(names)} ({write_p_value(failed[0][0])})")  # fmt: skip
