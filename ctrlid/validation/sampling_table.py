"""What a sweep over sampling periods found, as a table and in words."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from .._base.arrays import Array, freeze_arrays, read_only
from .._base.errors import CtrlidError
from .._base.text import Printed, with_error, write_count, write_list
from ..data.record import Record

# A relative difference beyond this is not told apart from a larger one.
FAR = 10.0


@dataclass(frozen=True, eq=False, repr=False)
class SamplingRow(Printed):
    """One estimator at one sampling period.

    Parameters
    ----------
    estimator : str
        Its name.
    factor : int
        Whole factor by which the record was slowed down.
    period : float
        Sampling period [s].
    n : int
        Samples that counted.
    input_between : str
        What became of u between the slow samples: ``"as recorded"``, ``"filtered"`` or ``"mean"``.
    poles : ndarray of complex
        Poles of the plant in s, by rising real part [rad/s]; empty if the fit failed.
    standard_errors : ndarray
        Their standard errors [rad/s], as the estimator states them.
    white : bool or None
        Whether the one-step errors are white, or less than a twentieth of their variance is not;
        None if that could not be tested.
    independent : bool or None
        The same for their independence of past u and r.
    active : tuple of str
        Inequalities on which the estimate sits.
    deviation : float
        Ratio: largest distance of a pole to that of the whole table, over the largest of those,
        printed as "distance".
    failure : str
        Why there is no fit; empty if there is one.
    notes : tuple of str
        What the estimator warned of.
    """

    estimator: str
    factor: int
    period: float
    n: int
    input_between: str
    poles: Any
    standard_errors: Array
    white: bool | None = None
    independent: bool | None = None
    active: tuple[str, ...] = ()
    deviation: float = np.inf
    failure: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    def failed(self) -> bool:
        """Whether there is no fit."""
        return not len(self.poles)

    @property
    @read_only
    def pole_times_period(self) -> Array:
        """The poles' absolute values times the sampling period."""
        return np.asarray(np.abs(self.poles) * self.period, dtype=float)

    def __str__(self) -> str:
        result = f"FAILED: {self.failure}"
        if not self.failed:
            result = f"poles {_poles(self)} rad/s, one-step errors {_judge_errors(self)}"
        notes = "".join(f"\n  note: {note}" for note in self.notes)
        return (f"{self.estimator} at {self.period:g} s ({write_count(self.n, 'sample')}, u "
                f"{self.input_between}): {result}{notes}")  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class SamplingSweep(Printed):
    """What `sweep_sampling_period` found.

    Parameters
    ----------
    record : Record
        The record as given.
    table : tuple of SamplingRow
        One row for each period and estimator, shortest period first.
    poles : ndarray of complex
        The poles on which most rows agree [rad/s], of those whose one-step errors are independent
        of u and r where there are any.
    recommended : float
        The sampling period at which the estimators differ least [s].
    reason : str
        Why, in words.
    warning : str
        What slowing this record down does to its input; empty if nothing was slowed down.
    """

    record: Record
    table: tuple[SamplingRow, ...]
    poles: Any
    recommended: float
    reason: str
    warning: str = ""

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __getitem__(self, estimator: str) -> tuple[SamplingRow, ...]:
        """Return the rows of one estimator, shortest period first."""
        rows = tuple(row for row in self.table if row.estimator == estimator)
        if not rows:
            known = dict.fromkeys(row.estimator for row in self.table)
            raise CtrlidError(f"the sweep has no estimator {estimator!r}; it has "
                              f"{write_list(tuple(known))}")  # fmt: skip
        return rows

    def __str__(self) -> str:
        largest = float(np.max(np.abs(self.poles))) if len(self.poles) else np.nan
        heading = "poles ± standard error [rad/s]"
        width = 2 + max([len(heading), *(len(_poles(row)) for row in self.table)])
        lines = [f"Sampling period of {self.record.name or 'the record'}: "
                 f"{write_count(self.record.n, 'sample')} "
                 f"at {self.record.dt:g} s",
                 f"  {'Ts [s]':>9} {'p Ts':>7}  {'estimator':<15}{'samples':>8}  "
                 f"{heading:<{width}}{'distance':>8}  one-step errors"]  # fmt: skip
        for row in self.table:
            head = (f"  {row.period:>9.4g} {largest * row.period:>7.3g}  {row.estimator:<15}"
                    f"{row.n:>8}  ")  # fmt: skip
            words = (
                f"FAILED: {_shorten_refusal(row.failure)}"
                if row.failed
                else _write_result(row, width)
            )
            lines.append(head + words)
        lines += [f"  {self.reason}", *([f"  {self.warning}"] if self.warning else [])]
        return "\n".join(lines)


def _shorten_refusal(failure: str) -> str:
    """Return the head of a refusal; the whole of it is in the row."""
    head = failure.split(". ")[0]
    return head if len(head) <= 80 else head[:77].rsplit(" ", 1)[0] + " ..."


def _poles(row: SamplingRow) -> str:
    pairs = zip(row.poles, row.standard_errors, strict=True)
    return ", ".join(with_error(p, s) for p, s in pairs)


def _write_result(row: SamplingRow, width: int) -> str:
    share = 100 * row.deviation
    off = f"> {100 * FAR:.0f} %" if row.deviation >= FAR else (
        f"{share:.2g} %" if share < 99.5 else f"{share:.0f} %")  # fmt: skip
    return f"{_poles(row):<{width}}{off:>8}  {_judge_errors(row)}"


def _judge_errors(row: SamplingRow) -> str:
    judged = {True: "white", False: "NOT WHITE", None: "not tested"}[row.white]
    if row.independent is not None:
        judged += ", independent" if row.independent else ", CORRELATED WITH u OR r"
    return judged + (f"; ON ITS BOUND: {write_list(row.active)}" if row.active else "")
