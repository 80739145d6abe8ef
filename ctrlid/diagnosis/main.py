"""diagnose(): from the audit of the record to the verdict."""

import functools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import control as ct
import numpy as np
from tqdm import tqdm

from .._jobs import check_jobs, spread
from ..audit import Audit, audit
from ..data import Record, as_records
from ..effects import CATALOGUE, AbstractEffect, InputDelay, InputOffset, equivalents
from ..errors import CtrlidError
from ..likelihood import Fit
from ..linearization import OperatingPoint
from ..loop import Loop
from ..loop_fit import summary
from ..model import delay_of
from . import gap as gaps
from .decide import GATE, doubt_of_all
from .experiment import separating_experiment
from .fresh import Fresh, fresh_data, stretches
from .omnibus import places
from .readout import Readout, censored, clipping, steps
from .replica import forgiven, replica
from .result import Calibrated, Candidate, Diagnosis, Disturbance, Finding, Gap, Verdict
from .rounds import Work, check_catalogue
from .search import Search, main_ones, search
from .sentences import conclusion
from .settling import Found
from .several import merged, presence
from .simulated_search import search_by_simulation
from .trial import (
    Model,
    Trial,
    attempt_at,
    base_model,
    refit,
    same_kind,
    simulable,
    weighted_by_repeats,
)

HOPELESS = ("too few samples", "constant signal")
TIE = 0.02  # difference of log-likelihood between effects that are one and the same
HELPS = 0.05  # of what is left without an effect, on fresh data
EXCESS = 1.5  # times the noise floor (twice that with a coloured force): above, not explained
WORSE = 1.2  # times the gap of the model as given: above, the fit explains nothing
MOST_SIMULATED = 12_000  # samples of a search by simulation
BY_SIMULATION = (
    "with filters a random force took up what is missing; so effects were looked for by the error "
    "of an open-loop simulation, and sizes are those that simulate best. What is called one-step "
    "errors above are errors of that simulation; evidence counts as many samples as are independent"
)
COMPLETE = ("explained", "nothing missing")
REPEATS = 3  # of an experiment, from which its noise is taken
STEPS = 6  # of the progress bar


def diagnose(
    loop: Any,
    record: Record | Sequence[Record],
    *,
    catalogue: Sequence[type[AbstractEffect]] = CATALOGUE,
    validation: Record | Sequence[Record] | None = None,
    jobs: int | None = None,
    progress: bool = True,
) -> Diagnosis:
    r"""Find where a model and data disagree, name what is missing, and show what it closes.

    The innovations of a Kalman filter on the loop's own equations, driven by the measured input,
    are what the model does not explain. First the free parameters and the noise are fitted: a
    wrong mass is not a missing effect. Then every effect of the catalogue is asked what it would
    gain, the promising ones are refitted by maximum likelihood with everything else, and the
    best stays if it gains more than ten in units of the Bayesian information criterion,

    .. math:: 2\,(\ell_{with} - \ell_{without}) - n \ln N > 10,

    and so on until nothing more does. What Vuong's test cannot reject against a finding is
    reported beside it. Tests that name nothing say whether noise is all that is left. The gap is
    shown on the last quarter of each record, with parameters fitted to the rest, or on records
    given for `validation`.

    Parameters
    ----------
    loop : Loop or control.TransferFunction
        The model, with the names of its uncertain parameters in `free`. With a controller the gap
        is that of the closed-loop simulation; without one that of a prediction several
        samples ahead, or of an open-loop simulation if the plant is stable. A transfer function
        stands for a linear plant without a known controller.
    record : Record or sequence of Record
        The data; several records are diagnosed together.
    catalogue : sequence of effect classes, optional
        What may be missing: ``[*cid.effects.CATALOGUE, Mine]``.
    validation : Record or sequence of Record, optional
        Data for the comparison before and after.
    jobs : int, optional
        Candidates that are tried at the same time, each in a process of its own, through joblib;
        by default one, or what ``joblib.parallel_config`` says.
    progress : bool, optional
        Whether to show progress.

    Returns
    -------
    Diagnosis
        Verdict, findings, the completed loop, the gap; ``print`` shows the report.

    Raises
    ------
    CtrlidError
        If the record cannot carry a diagnosis (it says why) or does not fit the loop.

    References
    ----------
    Kristensen, Madsen and Jørgensen, Computers and Chemical Engineering 28 (2004) 1431-1449;
    Basseville and Nikiforov, *Detection of Abrupt Changes* (score tests with nuisance parameters);
    Vuong, Econometrica 57 (1989) 307-333.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    >>> op = cid.OperatingPoint(states=(0.0, 0.0), input=0.0, output=0.0)
    >>> loop = cid.Loop(plant, cid.PID(kp=20.0, kd=1.0), dt=0.01, at=op, free=("k", "c"))
    >>> r = cid.random_binary(3000, amplitude=0.1, hold=50, seed=1)
    >>> real = loop.with_effect(cid.effects.CoulombFriction(fc=0.5))
    >>> record = cid.simulate(real, r, sensor_noise=1e-4, seed=2)
    >>> found = cid.diagnose(loop, record, progress=False)
    >>> found.verdict, found.findings[0].name
    ('explained', 'CoulombFriction')
    """
    started = time.perf_counter()
    check_catalogue(catalogue)
    if isinstance(loop, Record) or (isinstance(loop, list | tuple) and isinstance(record, Loop)):
        raise CtrlidError("the loop comes first: diagnose(loop, record)")
    records = as_records(record)
    loop = _loop(loop, records[0])
    fresh = fresh_data(loop, records, None if validation is None else as_records(validation))
    bar = tqdm(total=STEPS, disable=not progress, leave=False, desc="diagnose")

    def tell(text: str, step: int = 0) -> None:
        bar.set_description(f"diagnose: {text}")
        bar.update(step)

    tell("looking the records over", 1)
    audits, remarks = _look_over(loop, records)
    options = catalogue, _worker(check_jobs(jobs)), tell
    result, found = _diagnosed(loop, records, audits, fresh, *options)
    if len(records) > 1 and not _alike(result):
        result = _one_by_one(loop, records, audits, found, *options) or result
    bar.close()
    return replace(result, audit=remarks, record=_name(records),
                   seconds=time.perf_counter() - started)  # fmt: skip


def _diagnosed(
    loop: Loop, records: Sequence[Record], audits: Sequence[Audit], fresh: Fresh,
    catalogue: Sequence[type[AbstractEffect]], work: Work, tell: Callable[..., None],
) -> tuple[Diagnosis, Search]:  # fmt: skip
    """Diagnose records together."""
    given = loop
    read = [r for r in (clipping(records, audits, catalogue),) if r is not None]
    used = tuple(records)
    for r in read:
        loop = loop.with_effect(r.effect)
        used = tuple(censored(record, r.effect) for record in records)
    tell("recalibrating", 1)
    parts, begins = stretches(used)
    base = base_model(loop, parts, loop.free, begins)
    periods = _periods(parts, audits)
    if periods:
        base = weighted_by_repeats(base, periods)
    found = search(base, catalogue, work, tell)
    if found.turned and not found.after.passed:
        # Neither way explains the record, perhaps: fresh data tell which leads further.
        tell("another way")
        greedy = search(base, catalogue, work, tell, found.steps[0])
        ways = [main_ones(s, _helps(fresh)) for s in (found, greedy)]
        found = min(ways, key=lambda s: (not s.after.passed, fresh.gap(fresh.loops(s.final))))
    tell("comparing on fresh data", 2)
    coarse = steps(found.final.fit, audits, catalogue)
    if coarse and not found.after.passed and simulable(found.final):
        copies = [replica(_rounded(found.final, coarse), seed) for seed in (1, 2)]
        found = replace(found, after=forgiven(found.after, copies))
    found = main_ones(found, _helps(fresh))
    gap, shares, disturbance = _gaps(given, found, fresh)
    alone = len(records) == 1  # an effect of one record only may widen the gap in others
    if alone and found.found and not found.after.passed and _wider(gap, disturbance):
        # What names something and leaves more unexplained than before has the wrong name.
        found = replace(found, final=found.base, found=(), after=found.before)
        gap, shares, disturbance = _gaps(given, found, fresh)
    tell("writing down", 1)
    read += [coarse] if coarse else []
    result = _result(given, records, found, gap, shares, disturbance, read)
    if result.verdict not in COMPLETE and _worth_simulating(fresh, parts):
        # What a random force explains nobody names: a stable plant can do without one.
        smallest = min(gap.given, gap.before, gap.after)
        other = search_by_simulation(found, fresh, catalogue, tell, smallest)
        if other is not None:
            gap, shares, _ = _gaps(given, other, fresh)
            quiet = Disturbance(0.0, 0.0, math.nan, 0.0)
            again = _result(given, records, other, gap, shares, quiet, read)
            return replace(again, notes=(*again.notes, BY_SIMULATION)), other
    return result, found


def _worth_simulating(fresh: Fresh, records: Sequence[Record]) -> bool:
    """Whether a plant runs open loop, and records are short enough for hundreds of simulations."""
    open_loop = fresh.kind == "open-loop simulation"
    return open_loop and sum(len(r) for r in records) <= MOST_SIMULATED


def _alike(result: Diagnosis) -> bool:
    """Whether records that were diagnosed together seem to have the same in them."""
    whole = result.verdict in COMPLETE
    return whole and not any(f.note.endswith(" only") for f in result.findings)


def _one_by_one(
    loop: Loop, records: Sequence[Record], audits: Sequence[Audit], together: Search,
    catalogue: Sequence[type[AbstractEffect]], work: Work, tell: Callable[..., None],
) -> Diagnosis | None:  # fmt: skip
    """Diagnose each record alone; None where that does not explain all of them, and better."""
    parts: list[Diagnosis] = []
    won = size = 0.0
    for record, looked in zip(records, audits, strict=True):
        tell(f"record {len(parts) + 1} alone")
        fresh = fresh_data(loop, [record], None)
        try:
            result, found = _diagnosed(loop, [record], [looked], fresh, catalogue, work, tell)
        except CtrlidError:  # one that says too little when it stands alone
            return None
        if result.verdict not in COMPLETE:
            return None
        parts.append(result)
        won += _merit(found.final.fit)
        size += found.final.fit.size
    fit = together.final.fit
    better = size != fit.size or won > _merit(fit) + GATE
    return merged(loop, parts) if better else None


def _merit(fit: Fit) -> float:
    """Return the log-likelihood less half the Bayesian penalty."""
    return fit.value - 0.5 * len(fit.theta) * math.log(fit.size)


def _loop(loop: Any, record: Record) -> Loop:
    """Return the loop; a transfer function becomes one around the means of the record."""
    if isinstance(loop, Loop):
        return loop
    if not isinstance(loop, ct.TransferFunction):
        raise CtrlidError(
            "diagnose needs a Loop(plant, controller, dt=..., at=..., free=...) or a transfer "
            f"function such as the fits return; given {type(loop).__name__}"
        )
    valid = record.valid
    u, y = float(np.mean(record.u[valid])), float(np.mean(record.y[valid]))
    plain = ct.tf(loop.num, loop.den, loop.dt)
    linear = Loop(plain, None, dt=record.dt, at=OperatingPoint((), u, y))
    delay = delay_of(loop)
    linear = linear.with_effect(InputOffset(0.0))  # where it rests, the means only guess
    linear = replace(linear, free=tuple(linear.parameters))
    return linear.with_effect(InputDelay(delay)) if delay else linear


def _look_over(
    loop: Loop, records: Sequence[Record]
) -> tuple[tuple[Audit, ...], tuple[str, ...]]:  # fmt: skip
    """Return what is remarkable about the records; refuse those that carry nothing."""
    audits, remarks = [], _foreign_units(loop, records[0])
    for k, record in enumerate(records):
        found = audit(record, loop)
        audits.append(found)
        hopeless = [f.text for f in found.findings if f.kind in HOPELESS and f.channel != "r"]
        if hopeless:
            raise CtrlidError(
                f"{record.name or 'the record'} cannot be diagnosed: {' '.join(hopeless)}"
            )
        which = f"record {k + 1}: " if len(records) > 1 else ""
        remarks += [f"{which}{f.kind}: {f.text}" for f in found.findings]
    return tuple(audits), tuple(remarks)


def _foreign_units(loop: Loop, record: Record) -> list[str]:
    """Say where a record counts in other units than the plant, whose words sizes are written in."""
    e, known = loop.equations(), getattr(loop.plant, "units", {})
    remarks = []
    for key, name in (("u", e.inputs[0]), ("y", e.outputs[0])):
        there, here = record.units.get(key, ""), known.get(name, "")
        if there and here and there != here:
            there = "plain numbers" if there == "1" else there
            remarks.append(
                f"units: {key} is recorded in {there}, and the plant counts it in {here}; where "
                f"sizes say {here}, it stands for {there}."
            )
    return remarks


def _periods(parts: Sequence[Record], audits: Sequence[Audit]) -> list[int]:
    """Return after how many samples each record repeats itself; empty if one does not."""
    if len(parts) != len(audits):
        return []
    periods = [a.repeats[0] for a in audits]
    whole = [p and len(part) // p for p, part in zip(periods, parts, strict=True)]
    return periods if min(whole) >= REPEATS else []


def _rounded(model: Model, coarse: Readout) -> Model:
    """Return the model with a rounding sensor, whose steps are then no part of its noise.

    Rounding is no white noise: a record simulated with it says what it does to the tests.
    """
    fit = model.fit
    step = coarse.effect.values()["step"]
    sensor = np.maximum(fit.sensor - step**2 / 12, 0.05 * fit.sensor)
    ratio = float(np.mean(fit.sensor) / np.mean(sensor))
    force = tuple(v * ratio for v in fit.noise.force)
    noise = replace(fit.noise, force=force, drift=fit.noise.drift * ratio)
    loop = model.loop.with_effect(coarse.effect)
    return Model(loop, replace(fit, sensor=sensor, noise=noise))


def _worker(jobs: int | None) -> Work:
    return lambda function, items: list(spread(function, items, jobs))


def _gaps(loop: Loop, found: Search, fresh: Fresh) -> tuple[Gap, dict[int, float], Disturbance]:
    """Return the gap on data that no parameter was fitted to, and what each finding closes."""
    windows, kind = fresh.windows, fresh.kind
    before, after = (fresh.loops(m) for m in (found.base, found.final))
    for effect in found.base.loop.effects[len(loop.effects) :]:
        before = tuple(x.without_effect(type(effect).__name__) for x in before)
    results = [fresh.outputs(x) for x in ((loop,) * len(windows), before, after)]
    sizes = [gaps.root_mean_square(windows, y) for y in results]
    fit = found.final.fit
    floor, quiet = gaps.floors(after, fit, windows, kind)
    shares: dict[int, float] = {}
    for f in found.found:
        error = sizes[1]
        if len(found.found) > 1:
            label = list(after[0].labelled)[f.position]
            error = fresh.gap([x.without_effect(label) for x in after])
        shares[f.position] = _share(error**2 - sizes[2] ** 2, sizes[1], floor)
    first = windows[0]
    gap = Gap(
        kind, sizes[0], sizes[1], sizes[2], floor, first.record.units.get("y", ""),
        first.begin + np.asarray(first.record.t - first.record.start)[first.mask],
        np.asarray(first.record.y)[first.mask], results[1][0][first.mask],
        results[2][0][first.mask],
    )  # fmt: skip
    return gap, shares, _disturbance(found.final.fit, loop, floor, quiet)


def _wider(gap: Gap, disturbance: Disturbance) -> bool:
    """Whether effects leave a wider gap than sensor noise does, by itself, in a loop with them.

    With friction and play a loop hunts, and no simulation follows it for long.
    """
    by_noise = not disturbance.large and gap.after <= EXCESS * gap.floor
    return gap.after > gap.before and not by_noise


def _helps(fresh: Fresh) -> Callable[[Found, Model], bool]:
    """Return whether an effect closes a fair part of what is left without it, on fresh data.

    Of the gap, or, where noise is known, of the one-step errors: a small fast force is seen there.
    """
    loops = functools.cache(fresh.loops)

    def helps(f: Found, model: Model) -> bool:
        with_it, without = loops(model), loops(f.base)
        if model.fit.problem.known is not None:
            left = fresh.excess(without, model.fit)
            if left - fresh.excess(with_it, model.fit) > HELPS * left:
                return True
        floor = gaps.floors(with_it, model.fit, fresh.windows, fresh.kind)[0]
        gap, before = fresh.gap(with_it), fresh.gap(without)
        return _share(before**2 - gap**2, before, floor) > HELPS

    return helps


def _share(closed: float, before: float, floor: float) -> float:
    above = before**2 - (floor**2 if math.isfinite(floor) else 0.0)
    if not (math.isfinite(closed) and math.isfinite(above)) or above <= 0:
        return math.nan
    return float(min(max(closed / above, 0.0), 1.0))


def _disturbance(fit: Fit, loop: Loop, floor: float, quiet: float) -> Disturbance:
    noise, scale = fit.noise, float(np.mean(fit.sensor))
    time_constant = -loop.dt / math.log(noise.memory) if noise.drift else math.nan
    share = 1 - (quiet / floor) ** 2 if floor > 0 and math.isfinite(quiet) else math.nan
    coloured = math.sqrt(scale * noise.coloured) if noise.drift else 0.0
    white = math.sqrt(scale * float(np.mean(noise.force)))
    return Disturbance(white, coloured, time_constant, float(np.clip(share, 0.0, 1.0)))


def _result(
    loop: Loop, records: Sequence[Record], found: Search, gap: Gap, shares: dict[int, float],
    disturbance: Disturbance, read: Sequence[Readout],
) -> Diagnosis:  # fmt: skip
    fitted = summary(found.final.loop, found.final.fit)
    names, known = fitted.estimate.names, found.final.errors
    errors = dict(known or zip(names, fitted.estimate.standard_errors.tolist(), strict=True))
    findings = tuple(_finding(f, fitted.loop, errors, shares, found, records) for f in found.found)
    findings += tuple(Finding(r.effect, r.errors, (), (), r.evidence) for r in read)
    findings = tuple(sorted(findings, key=lambda f: -f.evidence))
    final = fitted.loop
    for r in read:
        final = final if r.effect in final.effects else final.with_effect(r.effect)
    units = _units(loop, records[0])
    where = places(found.before, found.after, units)
    verdict: Verdict
    excess = EXCESS * (2 if found.final.fit.noise.drift else 1)
    left = math.isfinite(gap.floor) and gap.after > excess * gap.floor
    # A random force that may do anything explains everything, and nothing.
    blamed = disturbance.large or math.isnan(disturbance.share)
    left = left or (blamed and gap.after > WORSE * gap.given)
    loose = doubt_of_all([f.trial.effect for f in found.found], [f.trial.gain for f in found.found])
    if found.after.passed and not left and not loose:
        verdict = "explained" if findings else "nothing missing"
    else:
        verdict = "partly explained" if findings else "unknown"
    notes = list(fitted.estimate.notes)
    if not loop.free:
        notes.append("no parameter of the model was free: a wrong value counts as a missing effect")
    if loop.linear_plant and not found.after.passed:
        notes.append(
            "the model is linear; errors that depend on position, velocity or input ask for the "
            "physics: write the plant with ct.nlsys and diagnose that"
        )
    before = dict(zip(found.base.names, found.base.fit.theta.tolist(), strict=True))
    calibrated = tuple(
        Calibrated(name, loop.parameters[name], before[name], fitted.loop.parameters[name],
                   errors.get(name, math.nan))
        for name in loop.free
    )  # fmt: skip
    tests = dict(found.after.p_values)
    return Diagnosis(
        verdict, conclusion(verdict, findings, gap, disturbance, found.after, where), findings,
        final, gap, where, _ranking(found), disturbance, calibrated, _sensitivity(found),
        tests, notes=tuple(notes),
    )  # fmt: skip


def _name(records: Sequence[Record]) -> str:
    names = ", ".join(dict.fromkeys(r.name or "record" for r in records))
    size = sum(int(np.count_nonzero(r.valid)) for r in records)
    many = f"{len(records)} records, " if len(records) > 1 else ""
    return f"{names} ({many}{size} samples, dt = {records[0].dt:g} s)"


def _units(loop: Loop, record: Record) -> dict[str, str]:
    e = loop.equations()
    known = dict(getattr(loop.plant, "units", {}))
    y = record.units.get("y", known.get(e.outputs[0], ""))
    u = record.units.get("u", known.get(e.inputs[0], ""))
    units = {"time": "s", "position": y, "reference": y, "input": u, "input change": u,
             "velocity": f"{y}/s" if y else ""}  # fmt: skip
    return {**known, **units}


def _finding(
    f: Found, loop: Loop, errors: dict[str, float], shares: dict[int, float], found: Search,
    records: Sequence[Record],
) -> Finding:  # fmt: skip
    label, effect = list(loop.labelled.items())[f.position]
    own = {n.partition(".")[2]: v for n, v in errors.items() if n.startswith(f"{label}.")}
    same = equivalents(effect, loop)
    # With the free parameters moving along, two effects may be one on every record.
    ties = {t.name for t in f.rivals if abs(t.gain - f.trial.gain) < TIE and t.cost == f.trial.cost}
    same = (*same, *sorted(ties - set(same)))
    others = tuple(t.fitted for t in f.rivals)
    apart = [t for t in f.rivals if t.name not in same]
    words, reference = "", None
    if apart:
        words, reference = separating_experiment(f.trial, apart, records[0])
    return Finding(effect, own, others, same, f.trial.gain, shares.get(f.position, math.nan),
                   words, reference, _presence(f, found, records))  # fmt: skip


def _presence(f: Found, found: Search, records: Sequence[Record]) -> str:
    """Say in which of several records an effect is seen when each is fitted alone."""
    several = len(records) > 1 and len(found.final.fit.problem.tracks) == len(records)
    if not several or found.final.errors is not None:
        return ""
    seen = []
    for k, record in enumerate(records):
        try:
            alone = base_model(f.base.fitted, [record], f.base.names)
        except CtrlidError:
            continue
        if refit(alone, attempt_at(alone, f.trial.fitted)).merit > GATE:
            seen.append(k)
    return presence(seen, len(records))


def _ranking(found: Search) -> tuple[Candidate, ...]:
    rows = []
    for k, step in enumerate(found.steps):
        begun: list[AbstractEffect] = []  # the same effect, begun elsewhere, is shown once
        for t in step.trials:
            if any(same_kind(t.effect, b) for b in begun):
                continue
            begun.append(t.effect)
            refitted = math.isfinite(t.gain)
            effect = t.fitted if refitted else t.effect
            price = t.cost if refitted else t.price
            rows.append(Candidate(k + 1, effect, t.promise, t.gain, price, t.remark))
    return tuple(rows)


def _sensitivity(found: Search) -> dict[str, float]:
    """Return the size of each one-parameter effect that would have earned a place."""
    sizes: dict[str, float] = {}
    if not found.steps:
        return sizes
    for t in found.steps[-1].trials:
        size = _visible(t)
        key = f"{t.name}.{t.effect.parameters()[0].name}" if t.effect.parameters() else t.name
        if math.isfinite(size) and key not in sizes:
            sizes[key] = size
    return sizes


def _visible(t: Trial) -> float:
    if len(t.effect.parameters()) != 1 or not t.label or not math.isfinite(t.promise):
        return math.nan
    fit = t.model.fit
    k = t.model.names.index(f"{t.label}.{t.effect.parameters()[0].name}")
    if not fit.normal[0][k, k] > 0:
        return math.nan
    return float(fit.standard_errors[k]) * math.sqrt(2 * (GATE + t.price))
