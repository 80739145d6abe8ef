"""Step 7: gross errors of the log: a wrong sign or unit, or an input that does nothing."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .._base.errors import ModelCannotRun
from ..data.record import Record
from ..effects import Quantization
from ..estimation.likelihood.maximization import choose_sensor_noise
from ..loop.loop import Loop
from ..loop.period_map import comes_to_rest
from ..validation.record_audit import Audit
from .fitted_model import compute_penalized_likelihood
from .recalibration import fit_base_model, recalibrate
from .thresholds import THRESHOLD

DEGREE = math.pi / 180


@dataclass(frozen=True)
class LogError:
    """A repair of the log that explains the record better than any model of the log as it is.

    Parameters
    ----------
    words : str
        What is wrong, as part of a sentence.
    gain : float
        What the repair gains of penalized log-likelihood over the model that it was compared with.
    """

    words: str
    gain: float


# What is wrong, in words; the factor by which u is multiplied to mend it; and that for y and r.
REPAIRS = (
    ("u is logged with the wrong sign", -1.0, 1.0),
    ("y and r are logged with the wrong sign", 1.0, -1.0),
    ("y and r are in degrees where the model has radians", 1.0, DEGREE),
    ("y and r are in radians where the model has degrees", 1.0, 1 / DEGREE),
    ("y and r are a thousand times too large", 1.0, 1e-3),
    ("y and r are a thousand times too small", 1.0, 1e3),
    ("u is a thousand times too large", 1e-3, 1.0),
    ("u is a thousand times too small", 1e3, 1.0),
    ("u is in degrees where the model has radians", DEGREE, 1.0),
    ("u is in radians where the model has degrees", 1 / DEGREE, 1.0),
    ("u is in per cent where the model has shares of one", 1e-2, 1.0),
    ("u is in shares of one where the model has per cent", 1e2, 1.0),
)

EARLY = (
    "y is logged one sample early, u is logged one sample late, or the sensor answers to the speed "
    "too"
)


@dataclass(frozen=True, eq=False)
class Log:
    """Records of a plant with one input and output, in whose log an error may be.

    Parameters
    ----------
    loop : Loop
        The model as given.
    records : sequence of Record
        The data as logged.
    audits : sequence of Audit
        What the records show by themselves.
    reached : float
        Penalized log-likelihood of the model that the search ended with.
    """

    loop: Loop
    records: Sequence[Record]
    audits: Sequence[Audit]
    reached: float

    @property
    def heads(self) -> list[Record]:
        """The first part of each record."""
        return [r[: THRESHOLD.log_error_samples] for r in self.records]

    @functools.cached_property
    def least(self) -> float:
        """What a repair of the heads has to exceed to be fitted to whole records.

        The heads are fitted at the given values, with the noise alone free: a gross error shows.
        """
        return _measure(self.loop, self.heads, None) + THRESHOLD.gate


def find_log_error(log: Log) -> LogError | None:
    r"""Return the gross error of the log that explains records better than what was found.

    A repair multiplies u by a factor, or y and r, or logs y a sample later. (A sample earlier would
    be a delay, which may be true.) Beside the density of the outputs as they were
    logged, that of repaired outputs counts with the factor a of their unit,

    .. math:: \ln p(y \mid u) = \ln p(a y \mid u) + N \ln |a|,

    so that a wrong unit competes with missing effects by the same criterion. The plant alone, with
    its free parameters, is fitted to the repaired records; it has to do better than the search, and
    than with an input that stands still. Else a random force explains what is logged so, and the
    plant nothing.

    Parameters
    ----------
    log : Log
        The records and what the search made of them.

    Returns
    -------
    LogError or None
        The best repair, with those that do as well in the same sentence; None if none helps.
    """
    heads = log.heads
    found: list[tuple[float, str]] = []
    goal = log.reached + THRESHOLD.gate
    for words, repair, factor, early in _list_repairs():
        left_out = early * len(heads)
        loop = _scale_steps(log, factor)
        if _measure(loop, [repair(r) for r in heads], None, factor, left_out) < log.least:
            continue
        whole = [repair(r) for r in log.records]
        measure = functools.partial(
            _measure, loop, audits=log.audits, factor=factor, left_out=left_out
        )
        value = measure(whole)
        if not value > goal:
            continue
        if value > measure(_hold(whole, _compute_mean(whole))) + THRESHOLD.gate:
            found.append((value - log.reached, words))
    if not found:
        return None
    best = max(gain for gain, _ in found)
    # Where u enters by its square, or the plant is the same upside down, repairs do the same.
    same = [words for gain, words in found if gain > best - THRESHOLD.gate]
    return LogError(", or ".join(same), best)


def seems_idle(log: Log) -> bool:
    """Whether records are explained by an input that stands still as well as by what was found.

    Then nothing of the logged input reaches the plant, and all that makes it do nothing explains
    the record alike, a stiff spring or a limit of a state included: no name says more than that.

    Parameters
    ----------
    log : Log
        The records and what the search made of them.

    Returns
    -------
    bool
        Whether the plant alone, its input at rest, does better by far than with the input, and no
        worse than with what was found. False of a plant that would not stay where it is with its
        input at rest.
    """
    loop, records, audits = log.loop, log.records, log.audits
    if not comes_to_rest(replace(loop, controller=None)):
        return False
    # It stands at rest, or where it is on average, or it is off.
    levels = {loop.point.input, _compute_mean(records), 0.0}
    if max(_measure(loop, _hold(log.heads, v), None) for v in levels) < log.least:
        return False
    moved = _measure(loop, records, audits, coloured=True)
    stood = max(_measure(loop, _hold(records, v), audits, coloured=True) for v in levels)
    return stood > max(moved + THRESHOLD.gate, log.reached - THRESHOLD.close)


def _compute_mean(records: Sequence[Record]) -> float:
    """Return where the input is on average."""
    return float(np.mean([np.mean(r.u) for r in records]))


def _hold(records: Sequence[Record], level: float) -> list[Record]:
    """Return records with an input that stands still."""
    return [replace(r, u=np.full_like(r.u, level)) for r in records]


def _list_repairs() -> list[tuple[str, Callable[[Record], Record], float, int]]:
    """Return what may be wrong, what mends a record, its factor of y, and samples that it costs."""
    scaled = [
        (words, functools.partial(_scale, input_factor=mine, output_factor=factor), factor, 0)
        for words, mine, factor in REPAIRS
    ]
    return [*scaled, (EARLY, _delay_output, 1.0, 1)]


def _scale(record: Record, input_factor: float, output_factor: float) -> Record:
    """Return a record with u, and y and r, multiplied by a factor."""
    return replace(
        record,
        u=input_factor * np.asarray(record.u),
        y=output_factor * np.asarray(record.y),
        r=None if record.r is None else output_factor * np.asarray(record.r),
    )


def _scale_steps(log: Log, factor: float) -> Loop:
    """Return the loop for outputs times a factor: the steps that the log shows are scaled as well.

    A step that the model has from elsewhere is in the units of the model already.
    """
    shown = [a.quantum.get("y", 0.0) for a in log.audits]
    effects = tuple(
        replace(e, step=e.step * abs(factor))
        if isinstance(e, Quantization) and any(math.isclose(e.step, q) for q in shown) else e
        for e in log.loop.effects
    )  # fmt: skip
    return replace(log.loop, effects=effects) if effects != log.loop.effects else log.loop


def _delay_output(record: Record) -> Record:
    """Return a record whose output is logged one sample later; the first one is then not known."""
    y, valid = np.roll(record.y, 1), np.roll(record.valid, 1)
    y[0], valid[0] = y[1], False
    return replace(record, y=y, valid=valid & record.valid)


def _measure(
    loop: Loop, records: Sequence[Record], audits: Sequence[Audit] | None, factor: float = 1.0,
    left_out: int = 0, coloured: bool = False,
) -> float:  # fmt: skip
    """Return the penalized log-likelihood of y as logged; minus infinity where nothing runs.

    Without audits the plant keeps its given values. The noise of the sensor may be `coloured`, as
    that of a search may.
    """
    try:
        model = (
            fit_base_model(loop, records, ()) if audits is None
            else recalibrate(loop, records, audits)
        )  # fmt: skip
        fit = choose_sensor_noise(model.fit) if coloured else model.fit
    except ModelCannotRun:
        return -math.inf
    if not math.isfinite(fit.value):
        return -math.inf
    count = sum(int(np.count_nonzero(np.isfinite(z))) for z in fit.standardized)
    value = compute_penalized_likelihood(fit) + count * math.log(abs(factor))
    # A sample that a repair leaves out counts as the others do on average.
    return value * (1 + left_out / max(count, 1))
