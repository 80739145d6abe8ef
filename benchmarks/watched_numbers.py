"""Numbers of the diagnosis that are watched: what would be decided with half or twice of each.

A study cannot run again with every number of the table halved and doubled. But most draws would
not notice: what is compared with a limit is far from it. So each number of judgement is replaced by
one that reckons with its half and its double as well, through sums, products and maxima, and notes
where a comparison comes out otherwise. Only the draws in which it does are run again
(``study_frozen.py ablate``).

``watch_numbers`` imports ctrlid's table and nothing else of it.
"""

from __future__ import annotations

import operator
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from ctrlid.diagnosis.thresholds import THRESHOLD, vary_numbers

LEFT = "left Python"


class Watched:
    """A number, and what it would be if single numbers of the table were halved or doubled.

    Parameters
    ----------
    value : number
        What it is.
    others : dict of str to tuple of numbers
        For each number of the table that it comes from, what it would be with half and twice that.
    noted : Counter of str
        How often a decision would have been another, by number. A value that leaves Python, as an
        index or into a compiled function, is noted as well: nobody knows what it decides there.
    """

    # An array that meets one leaves the operation to it.
    __array_ufunc__ = None

    def __init__(self, value: Any, others: dict[str, tuple[Any, Any]], noted: Counter[str]) -> None:
        self.value, self.others, self.noted = value, others, noted

    def __repr__(self) -> str:
        return f"Watched({self.value!r})"

    def __hash__(self) -> int:
        return hash(self.value)

    def __float__(self) -> float:
        return float(self._leave())

    def __index__(self) -> int:
        return operator.index(self._leave())

    def __int__(self) -> int:
        return int(self._leave())

    def __bool__(self) -> bool:
        return bool(self.value)

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        return np.asarray(self._leave(), dtype)

    def __format__(self, form: str) -> str:
        return format(self.value, form)

    def __neg__(self) -> Any:
        return self._apply(operator.neg)

    def __abs__(self) -> Any:
        return self._apply(abs)

    def _leave(self) -> Any:
        """Return the plain value, and note that it is out of sight."""
        for name in self.others:
            self.noted[f"{name}, {LEFT}"] += 1
        return self.value

    def _apply(self, function: Callable[..., Any]) -> Any:
        changed = {k: (function(a), function(b)) for k, (a, b) in self.others.items()}
        return Watched(function(self.value), changed, self.noted)

    def _combine(self, function: Callable[..., Any], other: Any, swapped: bool) -> Any:
        """Return the result with another number or array on the right, or on the left."""
        names = [*self.others, *(other.others if isinstance(other, Watched) else {})]
        value, theirs = self.value, other.value if isinstance(other, Watched) else other
        result = function(theirs, value) if swapped else function(value, theirs)
        changed = {}
        for name in dict.fromkeys(names):
            mine = self.others.get(name, (value, value))
            yours = (theirs, theirs)
            if isinstance(other, Watched):
                yours = other.others.get(name, yours)
            pairs = zip(mine, yours, strict=True)
            changed[name] = tuple(function(b, a) if swapped else function(a, b) for a, b in pairs)
        return Watched(result, changed, self.noted)  # type: ignore[arg-type]

    def _decide(self, function: Callable[..., Any], other: Any) -> Any:
        """Return a comparison, and note the numbers with which it would come out otherwise."""
        result = self._combine(function, other, False)
        for name, others in result.others.items():
            if any(np.any(np.asarray(o) != np.asarray(result.value)) for o in others):
                self.noted[name] += 1
        return result.value


def _make_operation(function: Callable[..., Any], swapped: bool) -> Callable[..., Any]:
    return lambda self, other: self._combine(function, other, swapped)


def _make_comparison(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda self, other: self._decide(function, other)


for _name in ("add", "sub", "mul", "truediv", "floordiv", "mod", "pow"):
    _function = getattr(operator, _name)
    setattr(Watched, f"__{_name}__", _make_operation(_function, False))
    setattr(Watched, f"__r{_name}__", _make_operation(_function, True))
for _name in ("lt", "le", "gt", "ge", "eq", "ne"):
    setattr(Watched, f"__{_name}__", _make_comparison(getattr(operator, _name)))


def list_judged_numbers() -> dict[str, Any]:
    """Return the numbers of judgement of the table, by name."""
    return {t.name: t.value for t in THRESHOLD.table() if t.kind == "study"}


def change_number(value: Any, factor: float) -> Any:
    """Return a number times a factor; a count stays one, and is not less than one."""
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


@contextmanager
def watch_numbers() -> Iterator[Counter[str]]:
    """Watch all numbers of judgement within a ``with`` block; give what is noted.

    Yields
    ------
    Counter of str
        By name, how many comparisons would have come out otherwise with half or twice the number.
    """
    noted: Counter[str] = Counter()
    watched = {
        name: Watched(value, {name: (change_number(value, 0.5), change_number(value, 2.0))}, noted)
        for name, value in list_judged_numbers().items()
    }
    with vary_numbers(**watched):
        yield noted
