"""sweep_sampling_period(): which sampling period, and which estimator at it."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from .._base.arguments import check_arguments, explain_names, is_iterable
from .._base.errors import CtrlidError, CtrlidWarning, ModelCannotRun
from .._base.jobs import check_jobs, share_out
from .._base.rounding import keep_numpy_quiet
from .._base.signals import require_one_signal
from .._base.text import write_count, write_list, write_percent
from ..data.record import Record
from ..estimation.constraints import AbstractConstraint
from ..estimation.linear.arx import fit_arx
from ..estimation.linear.continuous import fit_continuous
from ..estimation.linear.iv import fit_iv
from .comparing import compare
from .comparison import SYSTEMATIC
from .sampling_table import FAR, SamplingRow, SamplingSweep

ESTIMATORS = ("fit_arx", "fit_iv", "fit_continuous")
# By default a record is slowed down by these factors, evenly on a logarithmic scale.
FACTORS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 70, 100)
# By default a slower record keeps at least so many samples.
FEWEST = 150
# Poles agree if they are nearer than this share of the largest pole.
AGREES = 0.1


@explain_names
@keep_numpy_quiet
def sweep_sampling_period(
    record: Record,
    periods: Sequence[float] | None = None,
    *,
    estimators: Sequence[str] = ESTIMATORS,
    constraints: Sequence[AbstractConstraint] | Mapping[str, Sequence[AbstractConstraint]] = (),
    poles: int = 2,
    zeros: int = 0,
    controller: Any = None,
    jobs: int | None = None,
) -> SamplingSweep:
    r"""Fit a record at several sampling periods and say which one to use, and what to distrust.

    .. math:: p = \frac{\ln z}{T}

    is the same at every period T if the estimate is right. Least squares at a short period takes
    sensor noise for dynamics: the output hardly moves from sample to sample, the noise does, and
    the poles drift to the origin (or one of them far into the left half plane). At a long period
    few samples are left, and the input no longer is what the model supposes.

    The last deserves care. A digital controller holds u over its own period; over a slower one u
    moves, so that a record with every q-th sample left would be wrong even without noise. What
    loses least differs by estimator:

    - `fit_arx` gets ``record.decimate(q)``, all channels through one filter. Its u runs nearly
      straight, so the numerator starts at u(k) and has one coefficient more (nk=0). Less of the
      noise passes the filter: that, as much as the longer period, is what mends least squares.
    - `fit_iv` and `fit_continuous` get every q-th output and the mean of u over each slow period,
      taken as held: for slow dynamics only this mean counts. What u does besides, around its
      mean, is an error that grows with q and with the activity of the controller, and that
      standard errors do not contain.

    A fit that is refused is a row with its reason.

    Parameters
    ----------
    record : Record
        The record at its shortest period.
    periods : sequence of float, optional
        Sampling periods [s], whole multiples of the record's; by default up to twelve from once to
        a hundred times, as long as 150 samples are left.
    estimators : sequence of str, optional
        Of ``"fit_arx"``, ``"fit_iv"`` and ``"fit_continuous"``.
    constraints : sequence of constraints, or mapping, optional
        What is known; a mapping from estimator to constraints where they differ, as
        `ReciprocalPoles` and `SymmetricPoles` do.
    poles, zeros : int, optional
        Orders of the plant in continuous time.
    controller : optional
        As in `fit_iv` and `fit_continuous`; used at the record's own period, since a slower record
        has no controller of this form.
    jobs : int, optional
        Processes that share the fits, through joblib; by default one, or what
        ``joblib.parallel_config`` says, which can be another backend such as a dask cluster.

    Returns
    -------
    SamplingSweep
        The table, a recommendation and its reason.

    Raises
    ------
    CtrlidError
        If an argument does not fit, or no fit succeeds at all.

    References
    ----------
    "Identification of a class of unstable processes", section II.C. Ljung, *System Identification*,
    2nd edition, section 13.7 (choice of sampling interval).

    Examples
    --------
    >>> import control as ct
    >>> import ctrlid as cid
    >>> P = ct.tf([-6.5], [1, 0, -1600])
    >>> C = cid.design_lead(P, crossover=100, phase_margin=50)
    >>> C = ct.sample_system(ct.ss(C), 5e-4, "tustin")
    >>> r = cid.random_binary(20_000, amplitude=1e-4, hold=40, seed=1)
    >>> record = cid.simulate(cid.Loop(P, C, dt=5e-4), r, sensor_noise=2e-6, seed=2)
    >>> sweep = cid.sweep_sampling_period(record, [5e-4, 5e-3], estimators=("fit_arx", "fit_iv"))
    >>> for row in sweep["fit_arx"]:
    ...     print(row.period, abs(row.poles.real.max()) < 4, abs(row.poles.real.max() - 40) < 4)
    0.0005 True False
    0.005 False True
    >>> sweep.recommended
    0.005
    """
    check_arguments(sweep_sampling_period, locals(), "record", "constraints")
    factors = _choose_factors(record, periods)
    names = tuple(estimators)
    unknown = [name for name in names if name not in ESTIMATORS]
    if unknown or not names:
        raise CtrlidError(f"estimators takes names out of {write_list(ESTIMATORS)}; given {names}")
    if isinstance(constraints, Mapping) and (strange := [k for k in constraints if k not in names]):
        raise CtrlidError(f"constraints= names {strange}, but the estimators of this sweep are "
                          f"{list(names)}")  # fmt: skip
    known = {
        name: tuple(constraints.get(name, ())) if isinstance(constraints, Mapping)
        else tuple(_as_list(constraints)) for name in names
    }  # fmt: skip
    tasks = [
        (record, factor, name, known[name], poles, zeros, controller if factor == 1 else None)
        for factor in factors
        for name in names
    ]
    rows = list(share_out(_fit_row, tasks, check_jobs(jobs)))
    done = [row for row in rows if not row.failed]
    if not done:
        raise CtrlidError(f"no fit succeeded at any period; the first one: {rows[0].failure}")
    # A fit whose one-step errors follow u or r leaves dynamics out, and has no vote.
    sound = [row for row in done if row.independent]
    voters = sound or done
    centre = min(voters, key=lambda row: _measure_median_distance(row.poles, voters)).poles
    rows = [_rate_row(row, centre) for row in rows]
    best, reason = _recommend(rows, names)
    agreed = "The consensus poles are those on which most rows agree"
    scale = "p is the largest of them, and distance is relative to it."
    if sound:
        reason += f" {agreed} whose one-step errors are independent of u and r; {scale}"
    else:
        reason += (f" {agreed}; {scale} In no row are the one-step errors known to be independent "
                   "of u and r: MOST ROWS MAY AGREE ON WRONG POLES.")  # fmt: skip
    warning = ""
    if max(factors) > 1:
        what = (
            "The controller changed u more often than the longer periods sample it."
            if record.hold == "zoh"
            else "u changes between the samples of the longer periods."
        )
        warning = (f"{what} There u is approximated (see input_between), and the standard errors "
                   "do not include the error of this approximation.")  # fmt: skip
    return SamplingSweep(record, tuple(rows), centre, best, reason, warning)


def _as_list(constraints: Any) -> Sequence[AbstractConstraint]:
    # What is no sequence is refused by the fits.
    one = isinstance(constraints, AbstractConstraint) or not is_iterable(constraints)
    return (constraints,) if one else constraints


def _choose_factors(record: Any, periods: Sequence[float] | None) -> list[int]:
    if not isinstance(record, Record):
        raise CtrlidError(f"sweep_sampling_period needs one Record; given {type(record).__name__}")
    require_one_signal("sweep_sampling_period", record)
    if periods is None:
        return [q for q in FACTORS if q == 1 or record.n // q >= FEWEST]
    ratios = np.asarray(periods, dtype=float) / record.dt
    whole = np.round(ratios)
    if not ratios.size or np.any(whole < 1) or np.any(np.abs(ratios - whole) > 1e-6 * whole):
        raise CtrlidError("periods needs whole multiples of the sampling period of the record, "
                          f"{record.dt:g} s; given {list(periods)}")  # fmt: skip
    return sorted({int(q) for q in whole})


def average_input(record: Record, factor: int) -> Record:
    """Return every q-th sample, with u as its mean over each slow period.

    Parameters
    ----------
    record : Record
        The record.
    factor : int
        q.

    Returns
    -------
    Record
        The slow record, its input taken as held.
    """
    n = record.n // factor
    if factor == 1:
        return record
    if n < 2:
        raise CtrlidError(f"at {factor} times the period fewer than 2 of the {record.n} samples "
                          "are left; use a shorter period")  # fmt: skip
    cut = n * factor
    # Between samples u is held, or runs straight to the next one.
    mean = (
        record.u
        if record.hold == "zoh"
        else 0.5 * (record.u + np.append(record.u[1:], record.u[-1]))
    )
    return Record(
        r=None if record.r is None else record.r[:cut:factor],
        u=mean[:cut].reshape(n, factor).mean(axis=1), y=record.y[:cut:factor],
        dt=record.dt * factor, valid=record.valid[:cut].reshape(n, factor).all(axis=1),
        names=record.names, name=record.name, start=record.start,
        units=record.units, extra={k: v[:cut:factor] for k, v in record.extra.items()},
    )  # fmt: skip


def _fit_row(task: Any) -> SamplingRow:
    record, factor, name, known, poles, zeros, controller = task
    between = "as recorded" if factor == 1 else "filtered" if name == "fit_arx" else "mean"
    period = record.dt * factor
    count = int(np.count_nonzero(record.valid)) // factor
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CtrlidWarning)
        try:
            slow = record.decimate(factor) if name == "fit_arx" else average_input(record, factor)
            count = int(np.count_nonzero(slow.valid))
            if name == "fit_continuous":
                model = fit_continuous(slow, poles, zeros, known, controller=controller)
            elif name == "fit_iv":
                model = fit_iv(slow, poles, poles, 1, known, controller=controller)
            elif factor == 1 and slow.hold == "zoh":
                model = fit_arx(slow, poles, poles, 1, known)
            else:
                model = fit_arx(slow, poles, poles + 1, 0, known)
            white, independent = _test_errors(slow, model)
        except (CtrlidError, np.linalg.LinAlgError) as reason:  # The table prints a refusal.
            empty = np.zeros(0)
            return SamplingRow(name, factor, period, count, between, empty, empty,
                               failure=str(reason))  # fmt: skip
    order = np.argsort(model.estimate.poles_s.real, kind="stable")
    return SamplingRow(
        name, factor, period, count, between, model.estimate.poles_s[order],
        model.estimate.poles_s_standard_errors[order], white, independent, model.estimate.active,
        notes=tuple(dict.fromkeys(str(w.message) for w in caught)),
    )  # fmt: skip


def _test_errors(record: Record, model: Any) -> tuple[bool | None, bool | None]:
    """Return whether the one-step errors are white and independent of u and r."""
    try:
        tests = compare(record, model).tests
    except ModelCannotRun:
        return None, None
    fine = [t.passed or t.share < SYSTEMATIC for t in tests]
    return (fine[0], all(fine[1:])) if fine else (None, None)


def _measure_distance(p: Any, q: Any) -> float:
    """Return how far poles are from others, over the largest of those."""
    size = float(np.max(np.abs(q)))
    if not np.all(np.isfinite(p)) or not np.isfinite(size):
        return FAR
    return min(float(np.max(np.abs(p - q))) / max(size, 1e-300), FAR)


def _measure_median_distance(p: Any, rows: Sequence[SamplingRow]) -> float:
    """Return how far the poles of half of the rows are from these at most."""
    return float(np.median([_measure_distance(row.poles, p) for row in rows]))


def _rate_row(row: SamplingRow, centre: Any) -> SamplingRow:
    if row.failed:
        return row
    return replace(row, deviation=_measure_distance(row.poles, centre))


def _recommend(rows: Sequence[SamplingRow], names: Sequence[str]) -> tuple[float, str]:
    """Return the period at which the worst estimator is least off, and the words for it."""
    worst: dict[float, float] = {}
    for row in rows:
        worst[row.period] = max(worst.get(row.period, 0.0), min(row.deviation, FAR))
    best = min(worst, key=lambda period: worst[period])
    words = []
    for name in names:
        good = [r.period for r in rows if r.estimator == name and r.deviation <= AGREES]
        tried = sum(r.estimator == name for r in rows)
        if len(good) == tried:
            words.append(f"{name} at every period")
        elif good:
            reach = f"{min(good):.4g}" + (f" to {max(good):.4g}" if len(good) > 1 else "")
            words.append(f"{name} at {reach} s ({len(good)} of {write_count(tried, 'period')})")
        else:
            words.append(f"{name} AT NO PERIOD")
    off = (
        "the estimates agree best, although not all are within 100 % of"
        if worst[best] >= 1
        else f"all estimates are within {write_percent(worst[best])} of"
    )
    return best, (
        f"Recommended: {best:.4g} s, where {off} the consensus poles. Within "
        f"{100 * AGREES:.0f} % of these poles: {'; '.join(words)}."
    )
