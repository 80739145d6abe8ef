"""What a diagnosis found, phrase by phrase, for any report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .._base.arrays import Array
from .._base.text import (
    choose_prefix,
    write_count,
    write_list,
    write_number,
    write_p_value,
    write_quantity,
)
from ..effects import AbstractEffect, ParameterError, ReadingEffect
from ..effects.base import name_at_place, name_with_subject
from .findings import COMPLETE, BinnedErrors, Disturbance, Finding, Gap
from .noise_tests import choose_alarm_level
from .saving import list_units
from .thresholds import THRESHOLD

if TYPE_CHECKING:
    from .result import Diagnosis

# The report shows so many quantities along which the errors are not noise.
PLACES = 3
# So many failed tests are named, which still makes one sentence.
LISTED = 4
# From here on a size is written with an exponent.
LONG = 1e6
# The heading of what does not stand.
STAND_INS = "what only describes part of the record"
HEADLINES = {
    "nothing missing": "Nothing missing",
    "explained": "Explained",
    "partly explained": "PARTLY EXPLAINED: SOMETHING IS STILL MISSING",
    "unknown": "UNKNOWN: SOMETHING IS MISSING",
}
# Of a search that was stopped, only what was checked is said.
UNFINISHED = {"partly explained": "PARTLY EXPLAINED SO FAR", "unknown": "UNKNOWN SO FAR"}
WIDENED = (
    "Recalibration alone decreases the one-step errors but increases this gap, because no values "
    "of the parameters can replace what is missing."
)
# The tests of noise whose names say too little in a sentence.
TESTS = {
    "independence of past signals": "independence of past input and reference",
    "following the record": "whether the filter follows the record",
}
# The first words of the names of tests that are made for each quantity or parameter.
TESTS_OF = {
    "mean by ": "the mean in bins of ",
    "size by ": "the variance in bins of ",
    "rhythm of ": "a periodic change of ",
}
# The same of what may depend on a quantity in any way; the words of the input or the output, where
# there are several, stand in place of the general ones.
SHAPES = {"force": "a force", "slope": "an effect of {}", "reading": "an error of {}"}
OF_ONE = {"slope": "the input", "reading": "the reading"}
# The first word of what a parameter of the plant is called that is not what the model says.
PARAMETER = "parameter "
# What is no effect of the catalogue needs an article in a sentence.
ARTICLES = {"delay of the output": "a delay of the output"}
# Lines of the mains [Hz], so many multiples of them, and how far they may be off: by EN 50160,
# an interconnected grid keeps within one per cent.
MAINS = (50.0, 60.0)
HARMONICS = 3
MAINS_WIDTH = 0.01
# What a parameter per unit of inertia is times the inertia, by the unit of accelerations: the unit
# of that inertia, and the units of the products by the declared unit of the parameter.
FORCES = {
    "m/s^2": ("kg", {"{y}/s^2": "N", "1/s": "N s/m", "1/s^2": "N/m", "1/{y}": "kg/m",
                 "1/(s^2 {y}^2)": "N/m^3"}),
    "rad/s^2": ("kg m^2", {"{y}/s^2": "N m", "1/s": "N m s/rad", "1/s^2": "N m/rad",
                       "1/{y}": "N m s^2/rad^2", "1/(s^2 {y}^2)": "N m/rad^3"}),
}  # fmt: skip


def write_headline(found: Diagnosis) -> str:
    """Return the verdict with its sentence."""
    headline = HEADLINES[found.verdict]
    if not found.finished:
        headline = UNFINISHED.get(found.verdict, headline)
    return f"{headline}. {found.sentence}"


def name_test(key: str) -> str:
    """Return the name of a test of noise as a sentence has it: ``the test of ...``.

    Examples
    --------
    >>> name_test("mean by velocity"), name_test("whiteness")
    ('the mean in bins of velocity', 'whiteness')
    >>> name_test("force by velocity"), name_test("slope of V at x_dot by theta")
    ('a force that depends on velocity', 'an effect of V at x_dot that depends on theta')
    """
    for start, words in TESTS_OF.items():
        if key.startswith(start):
            return words + key.removeprefix(start)
    if is_shape_test(key):
        what, _, quantity = key.partition(" by ")
        what, _, place = what.partition(" at ")
        kind, _, signal = what.partition(" of ")
        words = SHAPES[kind].format(signal or OF_ONE.get(kind, ""))
        return f"{words}{f' at {place}' if place else ''} that depends on {quantity}"
    return TESTS.get(key, key)


def is_shape_test(key: str) -> bool:
    """Whether a test asks if something depends on a quantity: its name ends in ``by`` and that."""
    return " by " in key and key.split(maxsplit=1)[0] in SHAPES


def list_names(finding: Finding) -> list[str]:
    """Return the name of a finding, what is the same on this plant, and what may be in its place.

    What no record can tell apart is one name, of which no part stands alone.
    """
    first, *others = finding.names
    of_plant = first.startswith(PARAMETER)
    names = dict.fromkeys([first, *finding.equivalents, *others])
    spoken: dict[str, list[str]] = {}
    for name, effect in zip(finding.names, (finding.effect, *finding.alternatives), strict=True):
        spoken.setdefault(name, []).append(name_with_subject(effect))
    return [_write_name(words, of_plant or name in others)
            for name in names for words in spoken.get(name, [name])]  # fmt: skip


def _write_name(name: str, missing: bool) -> str:
    """Return a name as a sentence about what the model lacks has it.

    Of a parameter of the plant the model lacks the right value; beside an effect that does the
    same, the parameter is named alone.
    """
    if name.startswith(PARAMETER):
        return f"the right value of the {name}" if missing else f"the {name} of the plant"
    return ARTICLES.get(name, name)


def join_alternatives(names: Sequence[str]) -> str:
    """Return names of which one is right, for a sentence."""
    return f"{', '.join(names[:-1])} or {names[-1]}" if len(names) > 1 else names[0]


def join_names(findings: Sequence[Finding], remarks: Sequence[str] = ()) -> str:
    """Return the names of findings and of what may be in their place, for a sentence.

    Where a name has alternatives, findings are separated by semicolons. Remarks, one for each
    finding, follow in parentheses.
    """
    names = [join_alternatives(list_names(f)) for f in findings]
    if remarks:
        names = [f"{name} ({remark})" for name, remark in zip(names, remarks, strict=True)]
    if len(names) < 2 or all(len(list_names(f)) == 1 for f in findings):
        return write_list(names)
    return f"{'; '.join(names[:-1])}; and {names[-1]}"


def explain_evidence() -> str:
    """Say what the evidence is, and how much of it is strong."""
    return (
        "Evidence E means that the record is exp(E) times as probable with the effect as without "
        f"it. Chance reaches 2 or 3; from {THRESHOLD.strong:g} on evidence is strong, from "
        f"{THRESHOLD.certain:g} on very strong."
    )


def explain_catalogue() -> str:
    """Say what no diagnosis can rule out about the names in a complete explanation."""
    return (
        "Names are of the catalogue. What is not in it and acts like one of them is taken for that "
        "one, and parameters fitted beside it are then off by more than their standard errors."
    )


def introduce_gap(gap: Gap) -> str:
    """Say what the gap is."""
    text = f"gap between model and record: RMS error of the {gap.name} {_tell_samples(gap)}"
    if gap.outputs:
        names = write_list([part.output for part in gap.outputs])
        text += f", of {names} together in units of their noise floors"
    return text


def count_samples(gap: Gap) -> int:
    """Return how many samples were kept back; one of several outputs is one sample."""
    return max(part.samples or len(part.time) for part in gap.outputs or (gap,))


def _find_counted(gap: Gap) -> tuple[Gap, int, int]:
    """Return the output that has most samples, how many are kept back, and how many compared.

    Both are those of the first record. A prediction far ahead is not made at each sample, and what
    a model makes nothing of is not compared.
    """
    part = max(gap.outputs or (gap,), key=lambda p: p.samples or len(p.time))
    known = [np.isfinite(v) for v in (part.simulated_before, part.simulated_after)]
    known = [mask for mask in known if mask.any()]
    kept = len(part.time)
    return part, kept, int(np.count_nonzero(np.logical_and.reduce(known))) if known else kept


def _tell_samples(gap: Gap) -> str:
    """Say at how many samples the RMS errors are, of how many that are kept back."""
    total, (_, kept, compared) = count_samples(gap), _find_counted(gap)
    if compared == kept:
        return f"of {write_count(total, 'sample')} kept back"
    if total > compared:  # There are further records, of which only the samples are known.
        return f"at {total} of the samples kept back"
    return f"at {total} of the {write_count(kept, 'sample')} kept back"


def describe_drawn_samples(gap: Gap) -> str:
    """Say among which samples a picture of the first record shows the largest gap."""
    total, (_, kept, compared) = count_samples(gap), _find_counted(gap)
    if total > compared:
        return f"{compared} of {write_count(total, 'sample')} kept back"
    if compared == kept:
        return f"{write_count(total, 'sample')} kept back"
    return f"{total} of {write_count(kept, 'sample')} kept back"


def explain_prediction(gap: Gap) -> str:
    """Say why the gap is that of predictions and not of a simulation; empty where it is one."""
    if gap.kind != "prediction" or not gap.reason:
        return ""
    return (f"{gap.reason[:1].upper()}{gap.reason[1:]}, so that this gap is that of predictions, "
            "which use the logged input and earlier outputs, and not of a simulation.")  # fmt: skip


def list_gap_rows(gap: Gap) -> list[tuple[str, str, str]]:
    """Return what the gap is, how large, and how many times the noise floor, row by row."""
    rows = _list_rows(gap)
    for part in gap.outputs:
        *sizes, (_, floor, _) = _list_rows(part)
        rows += [(f"{label}, {part.output}", size, times) for label, size, times in sizes]
        rows.append((f"noise floor, {part.output}", floor, ""))
    return rows


def _list_rows(gap: Gap) -> list[tuple[str, str, str]]:
    known = [v for v in (gap.floor, gap.after, gap.before) if 0 < v < math.inf]
    known = known or [v for v in (gap.given,) if 0 < v < math.inf]
    middle = math.exp(sum(map(math.log, known)) / len(known)) if known else 0.0
    factor, unit = choose_prefix(middle, gap.unit)
    places = 2 - math.floor(math.log10(factor * min(known))) if known else 0

    def size(value: float) -> str:
        # Beyond so many digits a model diverges, and an exponent says so in fewer.
        if math.isfinite(value) and places <= 6 and abs(factor * value) < LONG:
            return f"{factor * value:.{max(places, 0)}f} {unit}".strip()
        if math.isfinite(value):
            return f"{write_number(factor * value, 3)} {unit}".strip()
        return "none" if math.isnan(value) else "DIVERGES"

    def times(value: float) -> str:
        ratio = value / gap.floor if gap.floor > 0 else math.nan
        if not math.isfinite(ratio):
            return ""
        if ratio >= LONG:
            return f"{write_number(ratio, 3)} x the floor"
        return f"{ratio:.2f} x the floor" if ratio < 9.995 else f"{ratio:.0f} x the floor"

    shown = [("the model as given", gap.given)]
    # A model without free parameters is not recalibrated, and nothing need be missing.
    for label, value in (("recalibrated", gap.fitted), ("with the effects", gap.after)):
        shown += [(label, value)] if value != shown[-1][1] else []
    rows = [(label, size(value), times(value)) for label, value in shown]
    if gap.kind == "prediction" and math.isfinite(gap.trivial):
        rows.append(("last value or line", size(gap.trivial), times(gap.trivial)))
    cause = "due to sensor noise and random force alone"
    if math.isnan(gap.floor):
        cause = "because the completed model breaks off when simulated with its noise"
    return [*rows, ("noise floor", size(gap.floor), cause)]


def _is_at_floor(size: float, gap: Gap) -> bool:
    """Whether an error is as small as noise alone leaves, so that nothing was there to close."""
    return size < THRESHOLD.near_floor * gap.floor


def _name_runs(gap: Gap) -> str:
    """Say what noise alone does to the kind of reproduction that a gap is of."""
    if gap.kind == "prediction":
        return "By noise alone, the predictions of the completed model err"
    return "Two simulations of the completed model that differ only in their noise differ"


def describe_shrinking(gap: Gap) -> str:
    """Say how much of the gap above the noise floor the effects close; empty if they do not."""
    if gap.fitted == gap.after:
        return ""
    above = gap.before**2 - gap.floor**2
    if not math.isfinite(above):
        return ""
    if THRESHOLD.excess * gap.floor < gap.after < THRESHOLD.excess * gap.widest:
        widest = write_quantity(gap.widest, gap.unit)
        return (f"{_name_runs(gap)} by up to {widest}. So the gap hardly shows the benefit of the "
                "effects; the one-step errors show it.")  # fmt: skip
    if _is_at_floor(gap.before, gap) and _is_at_floor(gap.after, gap):
        return (f"{_name_runs(gap)} by as much. So the gap cannot show the benefit of the effects; "
                "the one-step errors show it.")  # fmt: skip
    if above <= 0 or gap.after >= gap.before:
        return "On these samples the effects do NOT REDUCE THE GAP."
    share = min((gap.before**2 - gap.after**2) / above, 1.0)
    closed = (f"On these samples the effects remove {write_percent(share)} of the mean square "
              "error above the noise floor.")  # fmt: skip
    return f"{closed} {WIDENED}" if gap.fitted > gap.given * THRESHOLD.widened else closed


def describe_trivial(gap: Gap) -> str:
    """Say that a trivial predictor wins; empty where it does not."""
    if not gap.trivial_wins:
        return ""
    return (
        "The last value, or a straight line through the last samples, predicts better than each of "
        "these models, and no longer horizon changes that. So this gap SAYS NOTHING ABOUT THE "
        "MODEL; the one-step errors do."
    )


def describe_limits(found: Diagnosis) -> str:
    """Say which parameters a recalibration alone took to a limit; empty if there is none."""
    names = [c.name for c in found.calibrated if c.at_limit and "." not in c.name]
    if not names or not found.added:
        return ""
    ends = "ENDS AT ITS LIMIT" if len(names) == 1 else "END AT THEIR LIMITS"
    return (f"Recalibrated alone, {write_list(names)} {ends}, a tenth or ten times the value as "
            "given: the model without the effects has no good value there.")  # fmt: skip


def write_percent(share: float) -> str:
    """Write a share in percent, with more digits near the whole."""
    if 0 < share < 0.005:
        return "under 1 %"
    return f"{100 * share:.1f} %" if 0.99 < share < 0.9995 else f"{100 * share:.0f} %"


def list_telling_places(found: Diagnosis) -> list[BinnedErrors]:
    """Return the places where the disagreement sits, most telling first, then what is left.

    What a test of the final errors finds is told also where the effects brought it in.
    """
    first = [p for p in found.where if p.p_before < THRESHOLD.telling][:PLACES]
    left = [p for p in found.where if p.p_after < THRESHOLD.telling and p not in first]
    return first + sorted(left, key=lambda place: place.p_after)[:PLACES]


def describe_nowhere(found: Diagnosis) -> str:
    """Say that no bin of any quantity shows an error by itself, and what all of them show together.

    Of several outputs the errors of each were looked for along the same axes.
    """
    axes = write_list(list(dict.fromkeys(p.axis for p in found.where)))
    if not axes:
        return "not known"
    shown = []
    if found.verdict not in COMPLETE and found.tests:
        of_shapes = ((p, key) for key, p in found.tests.items() if is_shape_test(key))
        shown = [key for p, key in sorted(of_shapes) if p < THRESHOLD.telling]
    if shown:
        return (f"in no bin of {axes} do the one-step errors differ from noise by themselves, but "
                f"together they show {name_test(shown[0])}")  # fmt: skip
    return f"nowhere. In bins of {axes}, the one-step errors are noise."


def find_told_rms(place: BinnedErrors, levels: Array) -> float:
    """Return the RMS in the bin that a place's words speak of, or the highest, from mean squares.

    NaN where nothing is known.
    """
    if place.told >= 0:
        return math.sqrt(levels[place.told])
    return math.sqrt(max((v for v in levels if math.isfinite(v)), default=math.nan))


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
    if isinstance(effect, ParameterError):
        return _describe_parameter_of_plant(found, effect, (errors or {}).get("error"))
    units = list_units(found.loop, effect)
    words = []
    unused = {p.name for p in effect.parameters()} - set(effect.values())
    for name, value in vars(effect).items():
        if name not in units:
            words += [f"{name} = {value}"] if value != "" and name not in unused else []
            continue
        error = None if errors is None else errors.get(name)
        words.append(f"{name} = {write_quantity(value, units[name], error)}")
    return ", ".join(words)


def _describe_parameter_of_plant(
    found: Diagnosis, effect: ParameterError, error: float | None
) -> str:
    """Write the right value of a parameter of the plant, and the value that the model has."""
    given, unit = found.loop.parameters[effect.name], found.loop.known_units.get(effect.name, "")
    spread = None if error is None else abs(given) * error
    value = write_quantity(given * (1 + effect.error), unit, spread)
    return f"{effect.name} = {value} in place of {_write_alike(given, unit, spread)}"


def _write_alike(given: float, unit: str, spread: float | None) -> str:
    """Write a value with the digits of another one beside it, which has a standard error."""
    if not (given and spread and math.isfinite(spread)):
        return write_quantity(given, unit)
    # A standard error has two digits, and from 1e6 on both are written with a power of ten.
    digits = math.floor(math.log10(abs(given))) - math.floor(math.log10(spread)) + 2
    return write_quantity(given, unit, digits=min(max(digits, 3), 12))


def describe_forces(found: Diagnosis, effect: AbstractEffect) -> str:
    """Write the accelerations among the parameters as forces, or angular ones as torques.

    This takes a position in m (rad) and just one parameter in kg (kg m^2): of several masses it is
    not known which one moves.
    """
    if effect.place != "force" or found.gap.force_unit not in FORCES:
        return ""
    unit, products = FORCES[found.gap.force_unit]
    values = found.loop.parameters
    names = [name for name, u in found.loop.known_units.items() if u == unit and name in values]
    if len(names) != 1:
        return ""
    inertia = values[names[0]]
    words = [write_quantity(inertia * getattr(effect, p.name), products[p.unit])
             for p in effect.parameters() if p.unit in products]  # fmt: skip
    return f"{write_list(words)} at {names[0]} = {write_quantity(inertia, unit)}" if words else ""


def describe_certainty(found: Diagnosis, finding: Finding) -> str:
    """Say how sure it is that something like this effect is there, and that it is this one."""
    sure = ("WEAK" if finding.evidence < THRESHOLD.strong else
            "strong" if finding.evidence < THRESHOLD.certain else "very strong")  # fmt: skip
    text = f"evidence {finding.written_evidence} ({sure})"
    told = math.isfinite(finding.share) and not _is_at_floor(found.gap.before, found.gap)
    if told and len(found.added) > 1:
        share = write_percent(finding.share)
        above = " above the noise floor" if math.isfinite(found.gap.floor) else ""
        text += f"; without it, {share} of the mean square error{above} would return"
    every = (finding.effect, *finding.alternatives)
    many = len({name_with_subject(e) for e in every if name_at_place(e) not in finding.equivalents})
    if many > 1:
        what = "the record" if found.verdict == "explained" else "as much of the record"
        text += f"; ONE OF {many} EFFECTS that explain {what}"
    elif found.finished:
        kinds = {name_at_place(c.effect) for c in found.ranking}
        count = len(kinds - {*finding.names, *finding.equivalents})
        rest = "none of the {} other effects" if count > 1 else "no other effect"
        text += f"; {rest.format(count)} of the catalogue explains the record as well"
    if found.verdict == "partly explained" and not isinstance(finding.effect, ReadingEffect):
        text += (
            ". It may stand in for an effect that is not in the catalogue"
            if found.finished
            else ". The search did not come to compare it with all other effects, and it may stand "
            "in for one of them"
        )
    return text


def list_doubts(found: Diagnosis, finding: Finding) -> list[str]:
    """Say what else it could be, and which experiment would tell."""
    lines = []
    apart = [e for e in finding.alternatives if name_at_place(e) not in finding.equivalents]
    if apart:
        others = [f"{name_with_subject(e)} ({describe_parameters(found, e)})" for e in apart]
        lines.append(f"this record cannot distinguish it from {write_list(others)}")
    if finding.equivalents:
        # The same influence may take another value, or the other sign.
        sizes = {name_at_place(e): f" ({describe_parameters(found, e)})"
                 for e in finding.alternatives}  # fmt: skip
        same = [f"{ARTICLES.get(name, name)}{sizes.get(name, '')}" for name in finding.equivalents]
        lines.append(
            f"no record of u and y can distinguish it from {write_list(same)}, because on this "
            "plant their influence is the same"
        )
    frequency = finding.effect.values().get("frequency")
    if frequency is not None and finding.effect.repeatable:
        error = finding.standard_errors.get("frequency", 0.0)
        lines.append(describe_aliases(frequency, found.loop.dt, THRESHOLD.significant * error))
    if finding.experiment:
        lines.append(f"to decide, use {finding.experiment}")
    if finding.reference is not None:
        lines.append(f"the reference signal for it is in .reference of this finding "
                     f"({write_count(len(finding.reference), 'sample')})")  # fmt: skip
    return [*lines, *([finding.note] if finding.note else [])]


def describe_aliases(frequency: float, dt: float, width: float = 0.0) -> str:
    """Say which lines samples show at a frequency: those of the mains by name.

    Examples
    --------
    >>> describe_aliases(40.0, 0.01)
    '40 Hz, or 60 Hz (of the mains) folded at 100 Hz sampling'
    """
    rate = 1 / dt
    near = max(width, MAINS_WIDTH * frequency)

    def is_seen(line: float) -> bool:
        return abs(abs(line - rate * round(line / rate)) - frequency) <= near

    lines = [n * f for f in MAINS for n in range(1, HARMONICS + 1) if is_seen(n * f)]
    direct = [f for f in lines if f < rate / 2]
    text = f"{write_number(frequency, 4)} Hz{' (of the mains)' if direct else ''}"
    folded = [f"{write_number(f, 4)} Hz (of the mains)" for f in sorted(set(lines) - set(direct))]
    if not folded:
        folded = [f"{write_number(rate - frequency, 4)} Hz"]
    return f"{text}, or {' or '.join(folded)} folded at {write_number(rate, 4)} Hz sampling"


def name_finding(finding: Finding) -> str:
    """Name the effect of a finding and say what it is."""
    what = finding.effect.sentence.rstrip(".")
    first = name_with_subject(finding.effect)
    of_plant = first.startswith(PARAMETER)
    same = [n if of_plant else _write_name(n, False) for n in finding.equivalents]
    name = join_alternatives([first, *same])
    return f"{name}: {what[:1].lower()}{what[1:]}" if what else name


def describe_size(found: Diagnosis, finding: Finding) -> str:
    """Write the fitted parameters of a finding, and its accelerations as forces if they are one."""
    force = describe_forces(found, finding.effect)
    if "SensorHum" in finding.equivalents:
        # Newtons would blame the plant for what may be in the reading.
        force = ""
    size = describe_parameters(found, finding.effect, finding.standard_errors)
    return f"{size} ({force})" if force else size


def describe_power() -> str:
    """Say how many records would have shown effects of the sizes that are listed."""
    return f"{100 * THRESHOLD.power:.0f} of 100 records like this one would have shown"


def list_sensitivity_rows(found: Diagnosis) -> list[tuple[str, str]]:
    """Return the smallest visible size of each effect."""
    tried = {name_with_subject(c.effect): c.effect for c in found.ranking}
    rows = []
    for key, size in found.sensitivity.items():
        label, _, name = key.rpartition(".")
        effect = tried.get(label)
        unit = "" if effect is None else list_units(found.loop, effect).get(name, "")
        rows.append((key, write_quantity(size, unit) if math.isfinite(size) else "not visible"))
    return rows


def describe_disturbance(found: Diagnosis) -> str:
    """Say how large the random force is, and in capitals if it may hide something."""
    d, unit = found.disturbance, found.gap.force_unit
    if d.forces:
        each = [f"{write_quantity(size, unit or f'[{name}]/s')} RMS at {name}"
                for name, size, unit in d.forces]  # fmt: skip
        parts = [f"white ({write_list(each)})", *_list_forces(replace(d, white=0.0), "")]
    elif found.gap.outputs:
        parts = []
    else:
        parts = _list_forces(d, unit)
    return _describe_parts(d, parts)


def _list_forces(d: Disturbance, unit: str) -> list[str]:
    parts = [f"white ({write_quantity(d.white, unit)} RMS)"] if d.white else []
    if d.coloured:
        parts.append(f"coloured ({write_quantity(d.coloured, unit)} RMS, time constant "
                     f"{write_quantity(d.time_constant, 's')})")  # fmt: skip
    return parts


def _describe_parts(d: Disturbance, parts: Sequence[str]) -> str:
    if not parts:
        return "random force: none was found; the noise floor is due to sensor noise alone"
    words = " and ".join(parts)
    if math.isfinite(d.share):
        words += f"; it causes {write_percent(d.share)} of the variance of the noise floor"
    if not d.large:
        return f"random force: {words}"
    return (f"A LARGE RANDOM FORCE: {words}. It may hide effects, so the verdict holds only for "
            "effects larger than this force")  # fmt: skip


def describe_sensor_noise(found: Diagnosis) -> str:
    """Say what the noise of the sensor is, and how large."""
    return "" if found.noise is None else f"sensor noise: {found.noise.words}"


def describe_remains(found: Diagnosis) -> str:
    """Say whether the residuals are noise, by the tests of the final one-step errors."""
    if not found.tests:
        return "residuals: not tested"
    count = len(found.tests)
    name, p = min(found.tests.items(), key=lambda item: item[1])
    together = min(1.0, count * p)
    if found.verdict in COMPLETE or together > choose_alarm_level(len(found.added)):
        text = f"residuals: noise, by {count} tests. The smallest p-value is that of "
        if p < THRESHOLD.telling:
            # Without its size, p < 0.0001 beside a corrected value reads as a contradiction.
            return (f"{text}{name_test(name)}, p = {p:.2g}, which is {together:.2g} for the "
                    f"smallest of {count}")  # fmt: skip
        return f"{text}{name_test(name)}, {write_p_value(p)}"
    failed = sorted((v, k) for k, v in found.tests.items() if v < THRESHOLD.telling) or [(p, name)]
    names = [name_test(name) for _, name in failed[:LISTED]]
    if len(failed) > LISTED:
        names[-1] = f"{len(failed) - LISTED + 1} others"
    fail, smallest = ("fail", "smallest ") if len(failed) > 1 else ("fails", "")
    return (f"residuals: NOT NOISE ALONE. {len(failed)} of {count} tests {fail}: "
            f"{write_list(names)} ({smallest}{write_p_value(failed[0][0])})")  # fmt: skip
