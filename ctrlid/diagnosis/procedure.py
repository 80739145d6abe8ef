"""diagnose(): the steps of docs/theory/diagnosis.rst in their order, from record to verdict."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from .._base.arguments import check_arguments, explain_names
from .._base.errors import EffectDoesNotApply, ModelCannotRun
from .._base.interruption import Budget, Stopped, check_seconds, hold_interrupt
from .._base.jobs import check_jobs, share_out
from .._base.rounding import keep_numpy_quiet
from ..data.record import Record
from ..data.several_records import as_records, order_model_and_data, require_valid_samples
from ..effects import CATALOGUE, AbstractEffect
from ..estimation.likelihood.likelihood import make_problem
from ..loop.loop import Loop
from ..loop.unit_check import refuse_unit_clashes
from ..loop.velocities import suppose_force
from ..loop.wiring import match_signals
from ..validation.record_audit import Audit
from ..validation.reproduction import OPEN_LOOP
from .answer import assemble_answer, name_records
from .candidates import Work, check_catalogue
from .findings import COMPLETE, Disturbance, Gap
from .fitted_model import Model, compute_null_likelihood, compute_penalized_likelihood
from .fresh_data import FreshData, check_length, choose_fresh_data
from .gap_summary import (
    lengthen_horizon,
    make_fresh_data_test,
    make_noise_test,
    replace_simulation,
    summarize_gap,
    take_back_widening,
)
from .growth import (
    Search,
    choose_search,
    compare_names,
    keep_main_effects,
    refuse_false_noise,
    search_effects,
)
from .log_errors import Log, find_log_error, seems_idle
from .noise_choice import colour_beside_force
from .open_loop_search import search_by_simulation
from .progress import Progress
from .recalibration import recalibrate
from .records import (
    Readout,
    add_steps,
    look_over_records,
    make_loop,
    read_limits,
    read_steps,
    with_units_of,
)
from .removal import Weighed
from .replicas import measure_rounding
from .result import Diagnosis
from .several_records import merge_diagnoses
from .sharpening import sharpen_model
from .thresholds import THRESHOLD
from .verdict import declare_unfinished

WRONG_LOG = (
    "THE LOG LOOKS WRONG: {0.words}. So repaired, the record is explained better than by any "
    "effect of the catalogue, by {0.gain:.0f} of log-likelihood. No effect is named on a record "
    "that may be wrong: check the log, mend it, and diagnose again."
)

IDLE_INPUT = (
    "THE INPUT DOES NOT SEEM TO REACH THE PLANT: y moves as it would if u stood still, and that "
    "explains the record as well as any effect of the catalogue does. Either u is not the signal "
    "that drives the plant, or the actuator is off, or a dead zone, a gap, a limit or dry friction "
    "swallows all that u did. No effect is named: check the log and the wiring, and excite the "
    "plant by larger inputs."
)

AT_REST = (
    "THE OUTPUT DOES NOT SEEM TO MOVE: a constant and noise explain y as well as the model does "
    "with any effect of the catalogue. Either the plant is held, by dry friction, a stop or a "
    "brake, or a dead zone, a gap or a limit swallows all that u did, or the actuator or the "
    "sensor is off. No effect is named: check the log and the wiring, and excite the plant by "
    "larger inputs."
)

SUPPOSED_FORCE = (
    "{1} is taken for the force at {0}, the only velocity that it accelerates its own way; in the "
    "mechanism a force there accelerates the other coordinates as well. If that is not so, say "
    "which input works on which velocity in forces= of the Loop"
)

BY_SIMULATION = (
    "in the Kalman filter a random force explained the error, so the effects were found by the "
    "error of an open-loop simulation. Their sizes are those with the smallest simulation error. "
    "What is called one-step errors above are errors of that simulation, and the evidence is "
    "computed for the number of independent samples"
)


@dataclass(frozen=True, eq=False)
class Question:
    """What is asked: a model, records of which much is known already, and the means to answer.

    `fresh` is what models are compared on, `audits` what the records show by themselves, `work` a
    map that may run in parallel, `tell` is told what is being done. The `budget` is how long the
    search may go on; `end` is called where it is spent.
    """

    loop: Loop
    records: tuple[Record, ...]
    audits: tuple[Audit, ...]
    fresh: FreshData
    catalogue: Sequence[type[AbstractEffect]]
    work: Work
    tell: Callable[..., None]
    budget: Budget
    end: Callable[[], None]
    settle: Callable[[], None]

    def attempt(self, step: Callable[[], Any], otherwise: Any) -> Any:
        """Return what a step gives, or something else where the budget is spent before."""
        try:
            with self.budget.running():
                return step()
        except Stopped:
            self.end()
            return otherwise


@explain_names
@hold_interrupt()
@keep_numpy_quiet
def diagnose(
    loop: Any,
    record: Record | Sequence[Record],
    *,
    catalogue: Sequence[type[AbstractEffect]] | None = None,
    validation: Record | Sequence[Record] | None = None,
    jobs: int | None = None,
    seconds: float | None = None,
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
        tenth and ten times its given value: further off is another model. ``free={"K": 0.1}`` says
        that K is known to 10 % (standard deviation), which is weighed against the record. With a
        controller the gap is that of the closed-loop simulation; without one that of a prediction
        several samples ahead, or of an open-loop simulation if the plant is stable. A transfer
        function stands for a linear plant without a known controller.
    record : Record or sequence of Record
        The data; several records are diagnosed together. Loop and record may change places.
    catalogue : sequence of effect classes, optional
        What may be missing: ``[*cid.effects.CATALOGUE, Mine]``; None for ``CATALOGUE``. A diagnosis
        with a few classes takes a fraction of the time.
    validation : Record or sequence of Record, optional
        Data for the comparison before and after.
    jobs : int, optional
        Candidates that are tried at the same time, each in a process of its own, through joblib;
        by default one, or what ``joblib.parallel_config`` says.
    seconds : float, optional
        After so many seconds, less what the end needs, the search ends with its best answer so far,
        and the verdict says that it was not finished [s]. The model is recalibrated and the gap
        measured in any case. By default the search ends at the same place on every machine: after
        so much work that it takes some minutes on two processors, and mostly long before.
    progress : bool, optional
        Whether to show on stderr what is done: in a terminal or notebook as a bar, elsewhere a
        line a round.

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
    >>> r = cid.random_binary(1000, amplitude=0.1, hold=50, seed=1)
    >>> real = loop.with_effect(cid.effects.CoulombFriction(fc=0.5))
    >>> record = cid.simulate(real, r, sensor_noise=1e-4, seed=2)
    >>> few = (cid.effects.ViscousFriction, cid.effects.CoulombFriction, cid.effects.InputDelay)
    >>> found = cid.diagnose(loop, record, catalogue=few, progress=False)
    >>> found.verdict, found.findings[0].name
    ('explained', 'CoulombFriction')
    """
    check_arguments(diagnose, locals(), "record", "catalogue", "validation", "jobs", "seconds")
    started = time.monotonic()
    catalogue = CATALOGUE if catalogue is None else catalogue
    check_catalogue(catalogue)
    loop, record = order_model_and_data(loop, record)
    records = as_records(record)
    require_valid_samples(records, "record=")
    given = make_loop(loop, records[0])
    if not given.equations().siso:
        records = tuple(match_signals(one, given.equations(), given.wiring) for one in records)
    for one in records:
        refuse_unit_clashes(given, one)
    loop = with_units_of(given, records[0])
    supposed = suppose_force(loop.equations(), loop.point)
    if supposed is not None:
        loop = replace(loop, forces=dict([supposed]))
    fresh = choose_fresh_data(loop, records, None if validation is None else as_records(validation))
    jobs = check_jobs(jobs)
    shown = Progress(progress)
    # The clock decides only where it was asked to.
    samples = THRESHOLD.search_samples if seconds is None else math.inf
    budget = shown.make_budget(check_seconds(seconds), samples, started)

    def work(function: Callable[..., Any], items: Iterable[Any]) -> list[Any]:
        given, results = list(items), []
        shown.begin(len(given))
        for result in share_out(function, given, jobs):
            shown.count(result)
            results.append(result)
        return results

    try:
        # What has to be done in any case moves the bar, and asks for no time.
        with budget.running(binding=False):
            audits, remarks = look_over_records(given, records)
            check_length(fresh)
            question = Question(
                loop, records, audits, fresh, catalogue, work, shown.tell, budget, shown.end,
                shown.settle,
            )  # fmt: skip
            result, search = _answer_question(question)
            if len(records) > 1 and not _have_same_effects(result, len(records)):
                each = question.attempt(lambda: _answer_each_record(question, search), None)
                result = each or result
    finally:
        shown.close()
    if shown.ended:
        result = declare_unfinished(result, shown.ended, shown.spent)
    if supposed is not None:
        result = replace(result, notes=(*result.notes, SUPPOSED_FORCE.format(*supposed)))
    return replace(result, audit=(*remarks, *result.audit), record=name_records(records),
                   seconds=time.monotonic() - started)  # fmt: skip


def _answer_question(q: Question, start: Model | None = None) -> tuple[Diagnosis, Search]:
    """Take the steps of the theory page, for records that are diagnosed together.

    A recalibrated model to `start` from may be given.
    """
    # Step 1: what the readout of the sensor shows by itself is no candidate.
    readout = read_limits(q.loop, q.records, q.audits, q.catalogue)
    if readout.limits is not None:
        q = replace(q, fresh=q.fresh.censor(readout.limits))
    # Step 2: a wrong value of a parameter is no missing effect.
    q.tell("recalibrating")
    base = start or sharpen_model(recalibrate(readout.loop, readout.records, q.audits))
    stepped = _add_steps(q, base)
    if stepped is not None:
        return _answer_question(stepped)
    # The gap and the tests at the end take about as long as what was done so far. Records that are
    # diagnosed one by one afterwards begin late, and keep what was kept.
    if not q.budget.kept:
        q.budget.keep_back(time.monotonic() - q.budget.start)
    # Steps 3 to 7: effects are screened, refitted, decided upon, added and dropped.
    is_false = make_noise_test(q.fresh)
    with q.budget.running():
        search = search_effects(base, q.catalogue, q.work, q.tell, is_false)
    if search.finished and not search.after.passed and q.loop.equations().siso:
        # Beside what the effects explained, the steps of a converter may be all that is left.
        stepped = _add_steps(q, search.final)
        if stepped is not None:
            return _answer_question(stepped)
    if search.finished:
        search = refuse_false_noise(search, is_false)
    else:
        q.end()
    search = replace(search, final=measure_rounding(search.final))
    fresh = lengthen_horizon(q.loop, search, q.fresh)
    q = replace(q, fresh=fresh.with_noise(search.final).weigh_outputs(search.final))
    helps = make_fresh_data_test(q.fresh)
    if search.found or not search.after.passed:
        # A wrong sign or unit in the log makes the plant look as if almost anything were missing.
        q.tell("looking for errors of the log")
        reached = compute_penalized_likelihood(search.final.fit)

        def look() -> str:
            if compute_null_likelihood(search.final.fit) >= reached:
                return AT_REST
            if not readout.loop.equations().siso:
                return ""
            log = Log(readout.loop, readout.records, q.audits, reached)
            wrong = find_log_error(log)
            if wrong is not None:
                return WRONG_LOG.format(wrong)
            return IDLE_INPUT if seems_idle(log) else ""

        if search.finished:
            wrong = q.attempt(look, "")
        else:
            # Who has no time to wait must not be told that the plant lacks something either.
            with q.budget.running(binding=False):
                wrong = look()
        if wrong:
            return _blame_log(q, search, wrong)
    if search.other and not search.after.passed:
        # Perhaps neither search explains the record; fresh data tell which of them leads further.
        q.tell("second search")
        search = q.attempt(lambda: _search_again(q, base, search, helps, is_false), search)
    q.tell("comparing on fresh data")
    # Step 8: what else would do in the place of each effect.
    compared = None
    if search.finished:
        q.tell("comparing names")
        compared = q.attempt(lambda: compare_names(keep_main_effects(search, helps), q.work), None)
        search = compared or search
    # What was fitted anew has its noise measured anew.
    search = replace(search, final=measure_rounding(search.final))
    # Step 9: the gap before and after. An effect of one of several records may widen the others'.
    q = replace(q, fresh=q.fresh.with_noise(search.final))
    summary = summarize_gap(q.loop, search, q.fresh)
    fresh, summary, notes = replace_simulation(q.loop, search, summary, q.fresh)
    q = replace(q, fresh=fresh)
    if len(q.records) == 1 and search.finished:
        search, summary = take_back_widening(q.loop, search, summary, q.fresh)
    # Step 10: the decision table.
    q.tell("writing the report")
    # What was not compared was not asked either whether it only stands in for something.
    search = replace(search, finished=compared is not None)
    read = (*readout.found, *read_steps(search.final.fit, q.audits))
    result = assemble_answer(q.loop, q.records, search, summary, read)
    result = replace(result, notes=(*result.notes, *notes))
    if search.finished and _is_worth_simulating(q, result, summary.gap, base.records):
        simulated: tuple[Diagnosis, Search] | None
        simulated = q.attempt(lambda: _answer_by_simulation(q, search, summary.gap, read), None)
        if simulated is not None:
            return simulated
    if search.finished and not search.found and not search.after.passed:
        # Gusts and a sensor that errs alike may be all there is, or have hidden what is missing.
        coloured = q.attempt(lambda: colour_beside_force(search.final, is_false), None)
        if coloured is not None:
            q.tell("beginning anew beside other noise")
            anew = _answer_question(q, coloured)
            return anew if anew[1].finished else (result, search)
    return result, search


def _add_steps(q: Question, model: Model) -> Question | None:
    """Return what is asked of a loop with the steps that make a good part of a model's noise.

    None where the loop has them, and where too few readings differ for a fit.
    """
    loop = add_steps(q.loop, read_steps(model.fit, q.audits))
    if loop is q.loop:
        return None
    with contextlib.suppress(ModelCannotRun):
        make_problem(loop, model.names, q.records)
        return replace(q, loop=loop)
    return None


def _search_again(
    q: Question, base: Model, search: Search, helps: Callable[[Weighed, Model], bool],
    is_false: Callable[..., bool],
) -> Search:  # fmt: skip
    """Return the better of two searches, the second of which keeps what the first took back."""
    other = search_effects(base, q.catalogue, q.work, q.tell, is_false, search.other)
    if not other.finished:
        raise Stopped
    other = refuse_false_noise(other, is_false)
    return choose_search(search, other, helps, q.fresh.measure_model_gap)


def _blame_log(q: Question, search: Search, sentence: str) -> tuple[Diagnosis, Search]:
    """Answer that the log is at fault: nothing is named on a record that cannot be trusted."""
    q.settle()
    empty = replace(search, final=search.base, found=(), after=search.before)
    summary = summarize_gap(q.loop, empty, q.fresh)
    result = assemble_answer(q.loop, q.records, empty, summary, ())
    return replace(result, verdict="unknown", sentence=sentence), empty


def _answer_by_simulation(
    q: Question, search: Search, gap: Gap, read: Sequence[Readout]
) -> tuple[Diagnosis, Search] | None:
    """Answer by open-loop simulation: a random force that explains everything names nothing."""
    smallest = min(gap.given, gap.before, gap.after)
    other = search_by_simulation(search, q.fresh, q.catalogue, q.tell, smallest)
    if other is None:
        return None
    summary = summarize_gap(q.loop, other, q.fresh)
    summary = replace(summary, disturbance=Disturbance(0.0, 0.0, math.nan, 0.0))
    result = assemble_answer(q.loop, q.records, other, summary, read)
    return replace(result, notes=(*result.notes, BY_SIMULATION)), other


def _is_worth_simulating(
    q: Question, result: Diagnosis, gap: Gap, records: Sequence[Record]
) -> bool:
    """Whether more may be found by simulation: open loop, of records short enough for hundreds.

    Effects that explain the one-step errors and do not narrow the gap leave it to a random force.
    """
    useless = bool(result.findings) and gap.after > gap.before
    short = sum(len(r) for r in records) <= THRESHOLD.open_loop_samples
    asks = result.verdict not in COMPLETE or useless
    return asks and short and q.fresh.how == OPEN_LOOP and q.loop.equations().siso


def _have_same_effects(result: Diagnosis, records: int) -> bool:
    """Whether records that were diagnosed together seem to have the same in them."""
    some_only = any(0 < len(f.records) < records for f in result.findings)
    return result.verdict in COMPLETE and not some_only


def _answer_each_record(q: Question, together: Search) -> Diagnosis | None:
    """Diagnose each record alone; None where that does not explain all of them, and better."""
    parts: list[Diagnosis] = []
    gained = size = 0.0
    for record, audit in zip(q.records, q.audits, strict=True):
        head = f"record {len(parts) + 1} alone"
        q.tell(head)

        def tell(step: str, head: str = head, **options: Any) -> None:
            # Its rounds count from 1 again.
            q.tell(f"{head}, {step}", **options)

        fresh = choose_fresh_data(q.loop, [record], None)
        try:
            result, search = _answer_question(
                replace(q, records=(record,), audits=(audit,), fresh=fresh, tell=tell)
            )
        except (ModelCannotRun, EffectDoesNotApply):
            # The record says too little when it stands alone.
            return None
        if result.verdict not in COMPLETE:
            return None
        parts.append(result)
        gained += compute_penalized_likelihood(search.final.fit)
        size += search.final.fit.size
    fit = together.final.fit
    better = size != fit.size or gained > compute_penalized_likelihood(fit) + THRESHOLD.gate
    return merge_diagnoses(q.loop, parts) if better else None
