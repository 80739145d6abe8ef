"""diagnose(): from the audit of the record to the verdict."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from tqdm import tqdm

from .._base.errors import CtrlidError
from .._base.jobs import check_jobs, spread
from ..data.record import Record
from ..data.several_records import as_records, model_and_data
from ..effects import CATALOGUE, AbstractEffect
from ..estimation.likelihood.likelihood import Fit
from ..loop.loop import Loop
from ..validation.record_audit import Audit
from .answer import assemble_answer, name_records
from .candidates import check_catalogue
from .findings import COMPLETE, Disturbance
from .fresh_data import FreshData, choose_fresh_data
from .gap_summary import helps_on_fresh_data, summarize_gap
from .growth import Search, compare_names, drop_worst_effect, keep_main_effects, search_effects
from .open_loop_search import search_by_simulation
from .recalibration import cut_stretches, fit_base_model, weigh_by_repeats
from .records import (
    censor_record,
    find_repeat_periods,
    look_over_records,
    make_loop,
    read_clipping,
    read_steps,
)
from .replicas import forgive_filter, make_replica, with_rounding
from .result import Diagnosis
from .selection import Work
from .several_records import merge_diagnoses
from .thresholds import THRESHOLD
from .verdict import gap_is_wider

BY_SIMULATION = (
    "with filters a random force took up what is missing; so effects were looked for by the error "
    "of an open-loop simulation, and sizes are those that simulate best. What is called one-step "
    "errors above are errors of that simulation; evidence counts as many samples as are independent"
)


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
        The model, with the names of its uncertain parameters in `free`; each is sought between a
        tenth and ten times its given value: further off is another model. With a controller the gap
        is that of the closed-loop simulation; without one that of a prediction several
        samples ahead, or of an open-loop simulation if the plant is stable. A transfer function
        stands for a linear plant without a known controller.
    record : Record or sequence of Record
        The data; several records are diagnosed together. Loop and record may change places.
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
    loop, record = model_and_data(loop, record)
    records = as_records(record)
    loop = make_loop(loop, records[0])
    fresh = choose_fresh_data(loop, records, None if validation is None else as_records(validation))
    bar = tqdm(total=STEPS, disable=not progress, leave=False, desc="diagnose")

    def tell(text: str, step: int = 0) -> None:
        bar.set_description(f"diagnose: {text}")
        bar.update(step)

    tell("looking the records over", 1)
    audits, remarks = look_over_records(loop, records)
    options = catalogue, _make_worker(check_jobs(jobs)), tell
    result, found = _diagnose_together(loop, records, audits, fresh, *options)
    if len(records) > 1 and not _have_same(result):
        result = _diagnose_each(loop, records, audits, found, *options) or result
    bar.close()
    return replace(result, audit=remarks, record=name_records(records),
                   seconds=time.perf_counter() - started)  # fmt: skip


def _diagnose_together(
    loop: Loop, records: Sequence[Record], audits: Sequence[Audit], fresh: FreshData,
    catalogue: Sequence[type[AbstractEffect]], work: Work, tell: Callable[..., None],
) -> tuple[Diagnosis, Search]:  # fmt: skip
    """Diagnose records together."""
    given = loop
    read = [r for r in (read_clipping(records, audits, catalogue),) if r is not None]
    used = tuple(records)
    for r in read:
        loop = loop.with_effect(r.effect)
        used = tuple(censor_record(record, r.effect) for record in records)
    tell("recalibrating", 1)
    parts, begins = cut_stretches(used)
    base = fit_base_model(loop, parts, loop.free, begins)
    periods = find_repeat_periods(parts, audits)
    if periods:
        base = weigh_by_repeats(base, periods)
    found = search_effects(base, catalogue, work, tell)
    if found.other and not found.after.passed:
        # Neither way explains the record, perhaps: fresh data tell which leads further.
        tell("another way")
        greedy = search_effects(base, catalogue, work, tell, found.other)
        ways = [keep_main_effects(s, helps_on_fresh_data(fresh)) for s in (found, greedy)]
        found = min(ways, key=lambda s: (not s.after.passed, fresh.gap(fresh.loops(s.final))))
    tell("comparing on fresh data", 2)
    coarse = read_steps(found.final.fit, audits, catalogue)
    if coarse and not found.after.passed:
        copies = [make_replica(with_rounding(found.final, coarse), seed) for seed in (1, 2)]
        found = replace(found, after=forgive_filter(found.after, copies))
    tell("comparing names")
    found = compare_names(keep_main_effects(found, helps_on_fresh_data(fresh)), work)
    gap, shares, disturbance = summarize_gap(given, found, fresh)
    # What names something and leaves more unexplained than before has a wrong name among its
    # names. An effect of one record only may widen the gap in others.
    alone = len(records) == 1
    while alone and found.found and not found.after.passed and gap_is_wider(gap, disturbance):
        found = drop_worst_effect(found, lambda model: fresh.gap(fresh.loops(model)))
        gap, shares, disturbance = summarize_gap(given, found, fresh)
    tell("writing down", 1)
    read += [coarse] if coarse else []
    result = assemble_answer(given, records, found, gap, shares, disturbance, read)
    if result.verdict not in COMPLETE and _is_worth_simulating(fresh, parts):
        # What a random force explains nobody names: a stable plant can do without one.
        smallest = min(gap.given, gap.before, gap.after)
        other = search_by_simulation(found, fresh, catalogue, tell, smallest)
        if other is not None:
            gap, shares, _ = summarize_gap(given, other, fresh)
            quiet = Disturbance(0.0, 0.0, math.nan, 0.0)
            again = assemble_answer(given, records, other, gap, shares, quiet, read)
            return replace(again, notes=(*again.notes, BY_SIMULATION)), other
    return result, found


def _is_worth_simulating(fresh: FreshData, records: Sequence[Record]) -> bool:
    """Whether a plant runs open loop, and records are short enough for hundreds of simulations."""
    open_loop = fresh.kind == "open-loop simulation"
    return open_loop and sum(len(r) for r in records) <= THRESHOLD.open_loop_samples


def _have_same(result: Diagnosis) -> bool:
    """Whether records that were diagnosed together seem to have the same in them."""
    whole = result.verdict in COMPLETE
    return whole and not any(f.note.endswith(" only") for f in result.findings)


def _diagnose_each(
    loop: Loop, records: Sequence[Record], audits: Sequence[Audit], together: Search,
    catalogue: Sequence[type[AbstractEffect]], work: Work, tell: Callable[..., None],
) -> Diagnosis | None:  # fmt: skip
    """Diagnose each record alone; None where that does not explain all of them, and better."""
    parts: list[Diagnosis] = []
    won = size = 0.0
    for record, looked in zip(records, audits, strict=True):
        tell(f"record {len(parts) + 1} alone")
        fresh = choose_fresh_data(loop, [record], None)
        try:
            result, found = _diagnose_together(
                loop, [record], [looked], fresh, catalogue, work, tell
            )
        except CtrlidError:  # one that says too little when it stands alone
            return None
        if result.verdict not in COMPLETE:
            return None
        parts.append(result)
        won += _penalized_likelihood(found.final.fit)
        size += found.final.fit.size
    fit = together.final.fit
    better = size != fit.size or won > _penalized_likelihood(fit) + THRESHOLD.gate
    return merge_diagnoses(loop, parts) if better else None


def _penalized_likelihood(fit: Fit) -> float:
    """Return the log-likelihood less half the Bayesian penalty."""
    return fit.value - 0.5 * len(fit.theta) * math.log(fit.size)


def _make_worker(jobs: int | None) -> Work:
    return lambda function, items: list(spread(function, items, jobs))
