"""What a constraint is: rows on the coefficients of a model, in one or several alternatives."""

from __future__ import annotations

import dataclasses
import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ..._base.arguments import CheckedCalls, ShownFields, is_number
from ..._base.arrays import Array
from ..._base.errors import CtrlidError
from ..identified_model import Structure

Function = Callable[[Array], Any]


@dataclass(frozen=True, repr=False)
class Row:
    """``lower <= sum of weight * coefficient <= upper``; an equality where both are equal."""

    weights: Mapping[str, float]
    lower: float = -math.inf
    upper: float = math.inf

    @property
    def quantity(self) -> str:
        """The sum in words, for instance ``"b1 - b2"``."""
        text = ""
        for name, weight in self.weights.items():
            if weight == 0:
                continue
            sign = "-" if weight < 0 else "+"
            size = "" if abs(weight) == 1 else f"{abs(weight):.10g} "
            text += f" {sign} {size}{name}" if text else f"{sign.strip('+')}{size}{name}"
        return text or "0"

    def __repr__(self) -> str:
        if self.lower == self.upper:
            return f"{self.quantity} = {self.lower:.10g}"
        left = f"{self.lower:.10g} <= " if self.lower > -math.inf else ""
        right = f" <= {self.upper:.10g}" if self.upper < math.inf else ""
        if left and not right:
            return f"{self.quantity} >= {self.lower:.10g}"
        return f"{left}{self.quantity}{right}"


def equals(weights: Mapping[str, float], value: float) -> Row:
    """Return the row ``sum of weight * coefficient = value``."""
    return Row(weights, value, value)


@dataclass(frozen=True)
class Branch:
    """One alternative of a constraint.

    Parameters
    ----------
    rows : sequence of Row
        What holds.
    label : str
        What this alternative is called in the result, if there are several.
    family : callable, optional
        ``family(x)`` gives further rows for a number ``x`` that is searched for, first over
        ``grid`` and then between its points; the result is called ``"label = x"``.
    grid : sequence of float
        Values of ``x`` to start from, ascending.
    nonzero : sequence of Row
        Sums that the other constraints must leave free to differ from their bound.
    equality, inequality : callable, optional
        ``equality(theta) = 0`` and ``inequality(theta) >= 0``, numbers or arrays.
    """

    rows: Sequence[Row] = ()
    label: str = ""
    family: Callable[[float], Sequence[Row]] | None = None
    grid: Sequence[float] = ()
    nonzero: Sequence[Row] = ()
    equality: Function | None = None
    inequality: Function | None = None


class AbstractConstraint(metaclass=CheckedCalls):
    """Something known about the coefficients; a subclass says which rows that gives."""

    # True says that the constraint states an unstable pole of the plant.
    unstable: ClassVar[bool] = False

    # Help shows the fields of each constraint.
    __signature__ = ShownFields()

    @abstractmethod
    def branches(self, structure: Structure) -> Sequence[Branch]:
        """Return the alternatives, of which one must hold."""


@dataclass(frozen=True, repr=False)
class Known(AbstractConstraint):
    """The constraints of ctrlid print as the user wrote them.

    Parameters
    ----------
    output : str
        The output whose equation it speaks of; empty for all.
    """

    output: str = dataclasses.field(default="", kw_only=True)

    def __repr__(self) -> str:
        parts = []
        for field in sorted(dataclasses.fields(self), key=lambda field: bool(field.kw_only)):
            value = getattr(self, field.name)
            if field.default is not dataclasses.MISSING and value == field.default:
                continue
            text = f'"{value}"' if isinstance(value, str) else repr(value)
            if callable(value):
                text = getattr(value, "__name__", text)
            keyword = field.kw_only or field.default is not dataclasses.MISSING
            parts.append(f"{field.name}={text}" if keyword else text)
        return f"{type(self).__name__}({', '.join(parts)})"


def check_finite(value: Any, what: str) -> float:
    """Return a number as float, or say that it must be a finite one."""
    if not is_number(value):
        raise CtrlidError(f"{what} must be a real number; given {value!r}.")
    number = float(value)
    if not math.isfinite(number):
        raise CtrlidError(f"{what} must be finite; given {value!r}.")
    return number


def check_interval(lower: Any, upper: Any, what: str) -> tuple[float, float]:
    """Return both bounds as floats; -inf and inf stand for "no bound"."""
    low, high = (float(v) if _is_infinite(v) else check_finite(v, what) for v in (lower, upper))
    if low == math.inf or high == -math.inf:
        raise CtrlidError(f"{what}: lower={lower!r}, upper={upper!r} leave no room at all.")
    if low > high:
        raise CtrlidError(
            f"{what}: the lower bound {low:.10g} exceeds the upper bound {high:.10g}. "
            "Swap them or loosen one."
        )
    if low == -math.inf and high == math.inf:
        raise CtrlidError(f"{what} has no bound: give lower=, upper= or both.")
    return low, high


def _is_infinite(value: Any) -> bool:
    return isinstance(value, float | np.floating) and math.isinf(value)


def require_poles(constraint: AbstractConstraint, structure: Structure, needed: int) -> None:
    """Refuse a model with fewer poles than a constraint speaks of."""
    if structure.na < needed:
        raise CtrlidError(
            f"{constraint!r} needs at least {needed} pole{'s' * (needed > 1)}, but the model has "
            f"{structure.na}. Raise the order or drop the constraint."
        )


def make_denominator_weights(values: Sequence[float] | Array, na: int) -> dict[str, float]:
    """Return the weights of a row on the denominator's coefficients."""
    return {f"a{i}": float(values[i - 1]) for i in range(1, na + 1)}
