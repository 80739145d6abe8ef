"""The answer of a diagnosis: its findings, gap and verdict put together from the search."""

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from .._base.errors import EffectDoesNotApply, ModelCannotRun
from .._base.text import write_count, write_quantity
from .._base.units import fill_unit
from ..data.record import Record
from ..effects import AbstractEffect, Quantization, equivalents
from ..effects.base import find_own_module, name_with_subject
from ..estimation.likelihood.filter_data import find_noise_units
from ..estimation.likelihood.likelihood import Fit
from ..estimation.likelihood.physics_estimate import is_unseen
from ..estimation.likelihood.physics_fit import summarize_fit
from ..estimation.likelihood.tails import JointTails, Tails
from ..loop.loop import Loop
from ..loop.velocities import (
    describe_missing_forces,
    describe_possible_speeds,
    list_possible_speeds,
    list_unforced_velocities,
)
from .candidates import Trial, has_same_penalty, is_same_kind
from .experiment import find_experiment
from .findings import COMPLETE, Calibrated, Candidate, Finding, SensorNoise
from .fitted_model import with_mean_force
from .gap_summary import GapSummary
from .grounds import Case, find_ground
from .growth import Search
from .recalibration import fit_base_model
from .records import Readout
from .refitting import refit_candidate
from .removal import Weighed
from .result import Diagnosis, shift_visible_size
from .screening import screen_at
from .several_records import describe_presence
from .thresholds import THRESHOLD
from .verdict import (
    blame_slow_force,
    choose_verdict,
    describe_grounds,
    find_doubt,
    gap_is_left,
    write_conclusion,
)
from .where import locate_errors


def assemble_answer(
    loop: Loop, records: Sequence[Record], found: Search, summary: GapSummary,
    read: Sequence[Readout],
) -> Diagnosis:  # fmt: skip
    """Return verdict, findings, gap and whatever else a diagnosis tells.

    Parameters
    ----------
    loop : Loop
        The model as given.
    records : sequence of Record
        The records that were diagnosed.
    found : Search
        The end of the search.
    summary : GapSummary
        The gap on fresh data, and what each effect closes of it.
    read : sequence of Readout
        What the readout of the sensor shows by itself: its limits and the steps of its converter.

    Returns
    -------
    Diagnosis
        The answer, without the remarks of the audit.
    """
    gap, disturbance = summary.gap, summary.disturbance
    fitted = summarize_fit(found.final.loop, found.final.fit)
    names, known = fitted.estimate.names, found.final.errors
    errors = dict(known or zip(names, fitted.estimate.standard_errors.tolist(), strict=True))
    made = [
        _make_finding(f, fitted.loop, errors, summary.shares, found, records) for f in found.found
    ]
    total = found.final.fit.value - found.base.fit.value
    total = total if math.isfinite(total) else 0.0
    # Of effects that need each other, one may gain more than all of them beyond the model alone.
    gains = [f.trial.gain for f in found.found]
    gained = max(filter(math.isfinite, [total, *gains]))
    case = Case(
        loop, found.final, records, errors, gap, found.after.passed, gained, found.finished
    )  # fmt: skip
    judged = [(one, find_ground(case, f)) for one, f in zip(made, found.found, strict=True)]
    judged.sort(key=lambda pair: -pair[0].evidence)
    findings = tuple(one for one, ground in judged if not ground)
    grounds = [pair for pair in judged if pair[1]]
    stand_ins = tuple(_doubt_name(one, ground) for one, ground in grounds)
    # The steps of a converter belong to the record; no part of the loop is missing.
    steps = [r for r in read if isinstance(r.effect, Quantization)]
    units = loop.known_units
    remarks = tuple(_describe_steps(r, units.get(r.effect.at, gap.unit)) for r in steps)
    read = [r for r in read if r not in steps]
    findings += tuple(
        Finding(r.effect, r.errors, (), (), r.evidence, units=r.effect.units(loop)) for r in read
    )
    findings = tuple(sorted(findings, key=lambda f: -f.evidence))
    final = fitted.loop
    for r in read:
        final = final if r.effect in final.effects else final.with_effect(r.effect)
    # Where nothing was added, the errors are those of the final model, which the tests are of.
    before = found.before if findings or stand_ins else found.after
    where = locate_errors(before, found.after, _find_units(loop))
    left = gap_is_left(
        gap, disturbance, found.final.fit, summary.excess_chance, summary.worse_chance
    )
    objection = find_doubt([f.trial.effect for f in found.found], gains, total)
    objection = objection or describe_grounds(grounds)
    if not (findings or stand_ins):
        objection = blame_slow_force(disturbance, gap.force_unit)
    complete = found.after.passed and not left and objection is None
    verdict = choose_verdict(complete, named=bool(findings))
    notes = (*fitted.estimate.notes, *_list_notes(loop, found), *_list_untried(found))
    calibrated = _list_calibrated(loop, found, fitted.loop, errors)
    tests = dict(found.after.p_values)
    ranking = _rank_candidates(found)
    noise = describe_noise(found.final.fit, gap.unit)
    sizes, size_errors = _find_sensitivity(found)
    sentence = write_conclusion(
        verdict, findings, gap, disturbance, found.after, where, None if left else objection,
        len({type(c.effect) for c in ranking}), grounds, noise,
    )  # fmt: skip
    if verdict not in COMPLETE and list_unforced_velocities(loop.equations()):
        sentence += (
            " The loop does not say which input works on which velocity, so that no friction of a "
            "mechanism can be named rightly: give forces=, and diagnose again."
        )
    return Diagnosis(
        verdict, sentence, findings, final, gap, where, ranking, disturbance,
        calibrated, sizes, tests, remarks, notes, noise=noise, stand_ins=stand_ins,
        sensitivity_errors=size_errors,
    )  # fmt: skip


def _list_notes(loop: Loop, found: Search) -> list[str]:
    """Return what the user should know of what was not asked, or of how the model is given."""
    notes, e = [], loop.equations()
    if not loop.free:
        notes.append("no parameter of the model was free, so a wrong value counts as a missing "
                     "effect. Name the uncertain parameters in free=")  # fmt: skip
    if list_unforced_velocities(e) and not found.after.passed:
        notes.append(f"{describe_missing_forces(e, loop.point)}, and diagnose again")
    speeds = list_possible_speeds(e, loop.state_units)
    if speeds and not found.after.passed:
        notes.append(f"{describe_possible_speeds(speeds)}, and diagnose again")
    if loop.linear_plant and not found.after.passed:
        notes.append(
            "the model is linear. If the errors depend on position, velocity or input, write the "
            "equations of the plant with ct.nlsys and diagnose that model"
        )
    if not e.siso:
        notes.append(
            "with several inputs or outputs the noise of each output is taken to be white: "
            "coloured noise, limits of a sensor, repeats of the experiment and errors of the log "
            "are not looked for"
        )
    return notes


def _list_calibrated(
    loop: Loop, found: Search, fitted: Loop, errors: Mapping[str, float]
) -> tuple[Calibrated, ...]:
    """Return each free parameter of the plant as given, recalibrated and with the effects."""
    first = found.base.fit
    before = dict(zip(found.base.names, first.theta.tolist(), strict=True))
    on_limit = (first.theta == first.problem.lower) | (first.theta == first.problem.upper)
    ended = {name for name, there in zip(found.base.names, on_limit, strict=True) if there}
    return tuple(
        Calibrated(name, loop.parameters[name], before[name], fitted.parameters[name],
                   errors.get(name, math.nan), name in ended)
        for name in loop.free
    )  # fmt: skip


def describe_noise(fit: Fit, unit: str) -> SensorNoise:
    """Return the sensor noise of a fit as a diagnosis tells it."""
    noise, variance = fit.noise, float(np.mean(fit.sensor))
    if not fit.plant.e.siso:
        joint = noise.tails
        laws = joint.each if isinstance(joint, JointTails) else (None,) * len(fit.plant.e.outputs)
        worth = [1.0 if law is None else law.variance for law in laws]
        sizes = np.sqrt(fit.sensor_noises * worth).tolist()
        told = tuple((math.inf, 0.0, 1.0) if law is None else
                     (law.freedom or math.inf, law.share, law.ratio) for law in laws)  # fmt: skip
        units = find_noise_units(fit.plant.loop, fit.data[0].record)[0]
        rows = tuple(zip(fit.plant.e.outputs, sizes, units, strict=True))
        return SensorNoise(sizes[0], units[0], outputs=rows, tails=told if joint else ())
    if not isinstance(noise.tails, Tails):
        return SensorNoise(math.sqrt(variance), unit, noise.ar, noise.ma)
    tails = noise.tails
    return SensorNoise(
        math.sqrt(variance * tails.variance), unit, noise.ar, noise.ma,
        tails.freedom or math.inf, tails.share, tails.ratio,
    )  # fmt: skip


def _doubt_name(finding: Finding, ground: str) -> Finding:
    words = f"THE NAME DOES NOT STAND, since {ground}"
    return replace(finding, note="; ".join(filter(None, [words, finding.note])))


def _describe_steps(read: Readout, unit: str) -> str:
    step = write_quantity(read.effect.values()["step"], unit)
    name = read.effect.at or "y"
    return (f"converter: {name} moves in steps of {step}, whose rounding makes a good part of the "
            "sensor noise")  # fmt: skip


def name_records(records: Sequence[Record]) -> str:
    """Return what the records are called, with their size."""
    names = ", ".join(dict.fromkeys(r.name or "record" for r in records))
    size = sum(int(np.count_nonzero(r.valid_somewhere)) for r in records)
    many = f"{len(records)} records, " if len(records) > 1 else ""
    return f"{names} ({many}{write_count(size, 'sample')}, dt = {records[0].dt:g} s)"


def _find_units(loop: Loop) -> dict[str, str]:
    """Return the units of the quantities by which errors are located, of states and inputs."""
    e, known, states = loop.equations(), loop.known_units, loop.state_units
    if not e.siso:
        changes = {f"change of {name}": known.get(name, "") for name in e.inputs}
        references = {f"reference {name}": known.get(name, "") for name in e.outputs}
        inputs = {name: known.get(name, "") for name in e.inputs}
        return {**changes, **references, "time": "s", **inputs, **states}
    y, u = known.get(e.outputs[0], ""), known.get(e.inputs[0], "")
    x = "" if loop.position_unit.startswith("[") else loop.position_unit
    units = {"time": "s", "position": x, "reference": y, "input": u, "input change": u,
             "velocity": fill_unit("{x}/s", {"x": x}) if x else ""}  # fmt: skip
    return {**states, **units}


def _make_finding(
    f: Weighed, loop: Loop, errors: dict[str, float], shares: Mapping[int, float], found: Search,
    records: Sequence[Record],
) -> Finding:  # fmt: skip
    label, effect = list(loop.labelled.items())[f.position]
    own = {n.partition(".")[2]: v for n, v in errors.items() if n.startswith(f"{label}.")}
    same = equivalents(effect, loop)
    # With the free parameters moving along, two effects may be one on every record.
    ties = {
        t.key
        for t in f.rivals
        if abs(t.gain - f.trial.gain) < THRESHOLD.tie and has_same_penalty(t, f.trial)
    }
    same = (*same, *sorted(ties - set(same)))
    others = tuple(t.fitted for t in f.rivals)
    apart = [t for t in f.rivals if t.key not in same]
    words, reference = "", None
    if apart:
        words, reference = find_experiment(f.trial, apart, records[0])
    seen = _find_presence(f, found, records)
    notes = [None if seen is None else describe_presence(seen, len(records)),
             effect.disguise(loop.equations())]  # fmt: skip
    note = "; ".join(words for words in notes if words is not None)
    return Finding(effect, own, others, same, f.trial.gain, shares.get(f.position, math.nan),
                   words, reference, note, tuple(k + 1 for k in seen or ()),
                   effect.units(loop))  # fmt: skip


def _find_presence(f: Weighed, found: Search, records: Sequence[Record]) -> list[int] | None:
    """Return in which of several records an effect is seen when each is fitted alone, from 0."""
    several = len(records) > 1 and len(found.final.records) == len(records)
    if not several or found.final.errors is not None:
        return None
    seen = []
    for k, record in enumerate(records):
        try:
            alone = fit_base_model(f.base.fitted, [record], f.base.names)
        except (ModelCannotRun, EffectDoesNotApply):
            continue
        if refit_candidate(alone, screen_at(alone, f.trial.fitted)).net_gain > THRESHOLD.gate:
            seen.append(k)
    return seen


def _list_untried(found: Search) -> list[str]:
    """Say of effects of the user's own that could not be tried, and why not."""
    said: dict[str, str] = {}
    for t in (t for step in found.steps for t in step.trials):
        if find_own_module(t.effect) and t.out is not None and t.out.ground == "cannot run":
            said.setdefault(t.effect.called, t.out.words)
    return [f"{name} could not be tried: {words}" for name, words in said.items()]


def _rank_candidates(found: Search) -> tuple[Candidate, ...]:
    rows = []
    for k, step in enumerate(found.steps):
        # An effect that was started from several values is shown once.
        shown: list[AbstractEffect] = []
        for t in step.trials:
            if any(is_same_kind(t.effect, b) for b in shown):
                continue
            shown.append(t.effect)
            refitted = math.isfinite(t.gain)
            effect = t.fitted if refitted else t.effect
            full_penalty = t.penalty if refitted else t.full_penalty
            remark = "" if t.out is None else t.out.words
            taken = step.best is not None and is_same_kind(t.effect, step.best.effect)
            rows.append(Candidate(k + 1, effect, t.score, t.gain, full_penalty, remark, taken))
    return tuple(rows)


def _find_sensitivity(found: Search) -> tuple[dict[str, float], dict[str, float]]:
    """Return the size of each one-parameter effect that is due to be shown, and its error."""
    sizes: dict[str, float] = {}
    errors: dict[str, float] = {}
    if not found.steps:
        return sizes, errors
    base = None if found.found else with_mean_force(found.steps[-1].base)
    for t in found.steps[-1].trials:
        kind, own = name_with_subject(t.effect), t.effect.parameters()
        key = f"{kind}.{own[0].name}" if own else kind
        if key in sizes or len(t.effect.values()) != 1 or not math.isfinite(t.score):
            continue
        error = _find_own_error(t if base is None else screen_at(base, t.effect, t.scan_penalty))
        root = math.sqrt(2 * (THRESHOLD.gate + t.full_penalty))
        if base is not None and t.effect.neutral and math.isfinite(error):
            # What a curve shows of its size is less where it is bent than where it is straight.
            with contextlib.suppress(EffectDoesNotApply):
                there = replace(t.effect, **{own[0].name: (own[0].neutral or 0.0) + root * error})
                bent = _find_own_error(screen_at(base, there, t.scan_penalty))
                error = error if math.isnan(bent) else max(error, bent)
        if not math.isnan(error):
            half = root * error
            sizes[key], errors[key] = shift_visible_size(half, error, 0.5, THRESHOLD.power), error
    return sizes, errors


def _find_own_error(t: Trial) -> float:
    """Return the standard error of an effect's only parameter; NaN where the record has none.

    It is infinite where other parameters make up for any size: a curve of an input with two values
    is a gain and a bias.
    """
    name = f"{t.label}.{t.effect.parameters()[0].name}"
    if not t.label or not math.isfinite(t.score) or name not in t.model.names:
        return math.nan
    fit, k = t.model.fit, t.model.names.index(name)
    matrix = fit.normal[0]
    if not matrix[k, k] > 0:
        return math.nan
    unseen = is_unseen(matrix, np.flatnonzero(np.diag(matrix) > 0), k)
    return math.inf if unseen else float(fit.standard_errors[k])
