"""What is known beforehand about a model, as rows of a quadratic program.

Every constraint answers one question: which rows ``lower <= w' theta <= upper`` does it put on the
coefficients of a given `Structure`? An estimator never asks which constraint it has.

A constraint of your own is a subclass of `AbstractConstraint` with the one method ``branches``:

>>> from dataclasses import dataclass
>>> @dataclass(frozen=True)
... class NoDamping(AbstractConstraint):
...     def branches(self, structure):
...         return [Branch([equals({"a1": 1.0}, 0.0)])]
>>> NoDamping().branches(Structure(2, 1, domain="s"))[0].rows[0]
a1 = 0

Several branches are alternatives of which the cheapest wins; a branch may hold a family of rows
with one free number, which is searched for.
"""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray
from scipy.special import eval_chebyt, eval_chebyu

from .errors import CtrlidError
from .model import Structure

FloatArray = NDArray[np.float64]
Function = Callable[[FloatArray], Any]


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


class AbstractConstraint(ABC):
    """Something known about the coefficients; a subclass says which rows that gives."""

    @abstractmethod
    def branches(self, structure: Structure) -> Sequence[Branch]:
        """Return the alternatives, of which one must hold."""


class _Known(AbstractConstraint):
    """The constraints of ctrlid print as the user wrote them."""

    def __repr__(self) -> str:
        parts = []
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            if field.default is not dataclasses.MISSING and value == field.default:
                continue
            text = f'"{value}"' if isinstance(value, str) else repr(value)
            if callable(value):
                text = getattr(value, "__name__", text)
            keyword = field.kw_only or field.default is not dataclasses.MISSING
            parts.append(f"{field.name}={text}" if keyword else text)
        return f"{type(self).__name__}({', '.join(parts)})"


def _finite(value: Any, what: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise CtrlidError(f"{what} must be a real number; given {value!r}.") from None
    if not math.isfinite(number):
        raise CtrlidError(f"{what} must be finite; given {value!r}.")
    return number


def _interval(lower: Any, upper: Any, what: str) -> tuple[float, float]:
    """Both bounds as floats; -inf and inf stand for "no bound"."""
    low, high = (float(v) if _is_infinite(v) else _finite(v, what) for v in (lower, upper))
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


def _need_poles(constraint: AbstractConstraint, structure: Structure, needed: int) -> None:
    if structure.na < needed:
        raise CtrlidError(
            f"{constraint!r} needs at least {needed} pole{'s' * (needed > 1)}, but the model has "
            f"{structure.na}. Raise the order or drop the constraint."
        )


def _denominator(values: Sequence[float] | FloatArray, na: int) -> dict[str, float]:
    return {f"a{i}": float(values[i - 1]) for i in range(1, na + 1)}


def _pole_rows(structure: Structure, pole: complex) -> list[Row]:
    """``A(pole) = 0``; both parts of it if the pole is complex."""
    # Products, unlike powers of complex numbers, are exact for poles such as 1j.
    powers = np.cumprod([1.0, *[complex(pole)] * structure.na])[::-1]
    # Beyond the unit circle the powers grow: divided by the largest, the row stays of size one.
    powers = powers / max(1.0, abs(powers[0]))
    parts = [powers.real] if complex(pole).imag == 0 else [powers.real, powers.imag]
    return [equals(_denominator(p[1:], structure.na), 0.0 - float(p[0])) for p in parts]


@final
@dataclass(frozen=True, repr=False)
class ReciprocalPoles(_Known):
    """Among the poles there is a real pair z and 1/z: a sampled symmetric pair s = ±p.

    For two poles the paper's constraints ``a2 = 1`` and ``|a1| > 2``: two alternatives,
    ``a1 <= -2`` (poles at positive z) and ``a1 >= 2``, of which the cheaper one wins. The bound
    itself, where the poles merge, is allowed, and reported in capitals when the estimate sits on
    it. For more poles ``A(z) = A(1/z) = 0`` for some real z, which is searched for.

    Examples
    --------
    >>> for branch in ReciprocalPoles().branches(Structure(2, 2)):
    ...     print(branch.rows)
    (a2 = 1, a1 <= -2)
    (a2 = 1, a1 >= 2)
    """

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        if structure.domain == "s":
            raise CtrlidError(
                "ReciprocalPoles() speaks of sampled poles z and 1/z, but this model is in "
                "continuous time: write SymmetricPoles() for poles at s = ±p."
            )
        _need_poles(self, structure, 2)
        na = structure.na
        if na == 2:
            reciprocal = equals({"a2": 1.0}, 1.0)
            return (
                Branch((reciprocal, Row({"a1": 1.0}, upper=-2.0)), label="a1 <= -2"),
                Branch((reciprocal, Row({"a1": 1.0}, lower=2.0)), label="a1 >= 2"),
            )

        def pair(z: float) -> Sequence[Row]:
            # A(z) ± A(1/z), divided by what vanishes at z = ±1, are Chebyshev polynomials of
            # (z + 1/z)/2: independent rows right down to the double pole.
            c = math.copysign(1.0 + (abs(z) - 1.0) ** 2 / (2.0 * abs(z)), z)
            even = eval_chebyt(np.arange(na, -1, -1), c)
            odd = np.append(eval_chebyu(np.arange(na - 1, -1, -1), c), 0.0)
            return [
                equals(_denominator(v[1:] / abs(v[0]), na), -float(v[0] / abs(v[0])))
                for v in (even, odd)
            ]

        outwards = np.concatenate([[0.0], np.geomspace(1e-4, 4.0, 80)])
        positive = np.exp(outwards)
        label = "reciprocal pair at z"
        return (
            Branch(label=label, family=pair, grid=tuple(positive)),
            Branch(label=label, family=pair, grid=tuple(-positive[::-1])),
        )


@final
@dataclass(frozen=True, repr=False)
class SymmetricPoles(_Known):
    """Among the poles there is a real pair s = ±p, as in ``-beta / (s^2 - alpha)``.

    In continuous time with two poles ``a1 = 0`` and ``a2 <= 0``; with more,
    ``A(p) = A(-p) = 0`` for some p between 1e-3 and 1e5 rad/s, which is searched for. In a
    sampled model the same fact reads z and 1/z, hence the rows of `ReciprocalPoles`, with z > 0.

    Examples
    --------
    >>> SymmetricPoles().branches(Structure(2, 1, domain="s"))[0].rows
    (a1 = 0, a2 <= 0)
    """

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        _need_poles(self, structure, 2)
        if structure.domain == "z":
            # exp(p dt) is positive: the alternative at negative z is no sampled real pole.
            return ReciprocalPoles().branches(structure)[:1]
        na = structure.na
        if na == 2:
            return (Branch((equals({"a1": 1.0}, 0.0), Row({"a2": 1.0}, upper=0.0))),)

        def pair(p: float) -> Sequence[Row]:
            # Even and odd part of A vanish at p; the odd one is divided by p, for p = 0.
            power = np.arange(na, -1, -1)
            rows = []
            for parity in (0, 1):
                part = np.where(power % 2 == parity, float(p) ** np.maximum(power - parity, 0), 0.0)
                part = part / part.max()
                rows.append(equals(_denominator(part[1:], na), 0.0 - float(part[0])))
            return rows

        grid = tuple(np.concatenate([[0.0], np.geomspace(1e-3, 1e5, 160)]))
        return (Branch(label="symmetric pair at s = ±p, p", family=pair, grid=grid),)


@final
@dataclass(frozen=True, repr=False)
class PoleAt(_Known):
    """``A(pole) = 0``: the model has this pole; a complex one brings its conjugate.

    Parameters
    ----------
    pole : float or complex
        In z for a sampled model, in rad/s for a continuous one.

    Examples
    --------
    >>> PoleAt(0.5).branches(Structure(2, 1))[0].rows
    (0.5 a1 + a2 = -0.25,)
    """

    pole: complex

    def __post_init__(self) -> None:
        try:
            pole = complex(self.pole)
        except (TypeError, ValueError):
            raise CtrlidError(f"PoleAt needs a number; given {self.pole!r}.") from None
        if not np.isfinite(pole):
            raise CtrlidError(f"PoleAt needs a finite pole; given {self.pole!r}.")

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        _need_poles(self, structure, 1 if complex(self.pole).imag == 0 else 2)
        return (Branch(tuple(_pole_rows(structure, self.pole))),)


@final
@dataclass(frozen=True, repr=False)
class Integrator(_Known):
    """A pole at the origin of the s-plane: z = 1 in a sampled model, last a = 0 in s.

    Examples
    --------
    >>> Integrator().branches(Structure(2, 1))[0].rows
    (a1 + a2 = -1,)
    """

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        _need_poles(self, structure, 1)
        pole = 1.0 if structure.domain == "z" else 0.0
        return (Branch(tuple(_pole_rows(structure, pole))),)


@final
@dataclass(frozen=True, repr=False)
class StaticGain(_Known):
    """``B(1) = gain * A(1)``: output over input at rest (``B(0) = gain * A(0)`` in s).

    It contradicts an integrator, whose gain is infinite: the row alone would let the numerator
    vanish there as well.

    Parameters
    ----------
    gain : float
        In output units per input unit.

    Examples
    --------
    >>> StaticGain(3.0).branches(Structure(1, 1))[0].rows
    (-3 a1 + b1 = 3,)
    """

    gain: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "gain", _finite(self.gain, "StaticGain"))

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        if structure.domain == "z":
            a = [f"a{i}" for i in range(1, structure.na + 1)]
            b = [f"b{i}" for i in range(1, structure.nb + 1)]
            one = 1.0
        else:
            a, b, one = [f"a{structure.na}"], [f"b{structure.nb}"], 0.0
        weights = {**dict.fromkeys(a, -self.gain), **dict.fromkeys(b, 1.0)}
        at_rest = equals(dict.fromkeys(a, 1.0), -one)
        return (Branch((equals(weights, self.gain * one),), nonzero=(at_rest,)),)


@final
@dataclass(frozen=True, repr=False)
class Fixed(_Known):
    """One coefficient is known.

    Parameters
    ----------
    name : str
        Coefficient, for instance ``"a2"``.
    value : float
        Its value [unit of the coefficient].

    Examples
    --------
    >>> Fixed("a2", 1.0)
    Fixed("a2", 1.0)
    """

    name: str
    value: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "value", _finite(self.value, f"Fixed({self.name!r}, ...)"))

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        return (Branch((equals({self.name: 1.0}, self.value),)),)


@final
@dataclass(frozen=True, repr=False)
class Bounds(_Known):
    """One coefficient lies between two values; leave one out for a one-sided bound.

    Parameters
    ----------
    name : str
        Coefficient, for instance ``"b1"``.
    lower, upper : float
        Bounds, both allowed values [unit of the coefficient].

    Examples
    --------
    >>> Bounds("b1", upper=0.0).branches(Structure(2, 2))[0].rows
    (b1 <= 0,)
    """

    name: str
    lower: float = -math.inf
    upper: float = math.inf

    def __post_init__(self) -> None:
        low, high = _interval(self.lower, self.upper, f"Bounds({self.name!r}, ...)")
        object.__setattr__(self, "lower", low)
        object.__setattr__(self, "upper", high)

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        return (Branch((Row({self.name: 1.0}, self.lower, self.upper),)),)


@final
@dataclass(frozen=True, repr=False)
class Equal(_Known):
    """Two coefficients are equal, as b1 and b2 of a zero-order held double integrator or maglev.

    Parameters
    ----------
    first, second : str
        Coefficients.

    Examples
    --------
    >>> Equal("b1", "b2").branches(Structure(2, 2))[0].rows
    (b1 - b2 = 0,)
    """

    first: str
    second: str

    def __post_init__(self) -> None:
        if self.first == self.second:
            raise CtrlidError(
                f"Equal needs two different coefficients; given {self.first!r} twice."
            )

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        return (Branch((equals({self.first: 1.0, self.second: -1.0}, 0.0),)),)


@final
@dataclass(frozen=True, repr=False)
class Linear(_Known):
    """A weighted sum of coefficients is bounded, or equals a value.

    Parameters
    ----------
    weights : mapping of str to float
        Weight of each coefficient in the sum.
    lower, upper : float
        Bounds of the sum [its unit].
    equals : float, optional
        Value of the sum [its unit], instead of bounds.

    Examples
    --------
    >>> Linear({"a1": 1, "a2": 1}, lower=-1.0).branches(Structure(2, 2))[0].rows
    (a1 + a2 >= -1,)
    """

    weights: Mapping[str, float]
    lower: float = dataclasses.field(default=-math.inf, kw_only=True)
    upper: float = dataclasses.field(default=math.inf, kw_only=True)
    equals: float | None = dataclasses.field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if not isinstance(self.weights, Mapping) or not self.weights:
            raise CtrlidError(
                'Linear needs the weights by coefficient, for instance Linear({"a1": 1, "b1": -2}, '
                f"upper=0); given {self.weights!r}."
            )
        weights = {n: _finite(w, f"Linear: the weight of {n}") for n, w in self.weights.items()}
        if not any(weights.values()):
            raise CtrlidError(f"Linear: all weights are zero in {weights!r}: nothing is bounded.")
        object.__setattr__(self, "weights", weights)
        if self.equals is None:
            low, high = _interval(self.lower, self.upper, "Linear")
            object.__setattr__(self, "lower", low)
            object.__setattr__(self, "upper", high)
        elif self.lower > -math.inf or self.upper < math.inf:
            raise CtrlidError("Linear takes equals= or bounds (lower=, upper=), not both.")
        else:
            object.__setattr__(self, "equals", _finite(self.equals, "Linear: equals"))

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        if self.equals is not None:
            return (Branch((equals(self.weights, self.equals),)),)
        return (Branch((Row(self.weights, self.lower, self.upper),)),)


@final
@dataclass(frozen=True, repr=False)
class Nonlinear(_Known):
    """The general form: ``g(theta) = 0`` and ``f(theta) >= 0``, equation (7) of [1]_.

    Solved as a sequence of quadratic programs from several starts; what comes out is a local
    optimum, checked to meet the constraint. A linear fact is better given as `Linear`.

    Parameters
    ----------
    equality, inequality : callable, optional
        Functions g and f of the coefficient vector ``theta = (a1 .. a_na, b1 .. b_nb)``, returning
        a number or an array. They are differentiated numerically, so they should be smooth.

    References
    ----------
    .. [1] "Identification of a class of unstable processes", section IV.

    Examples
    --------
    >>> def real_poles(theta):
    ...     return theta[0] ** 2 - 4 * theta[1]
    >>> Nonlinear(inequality=real_poles)
    Nonlinear(inequality=real_poles)
    """

    equality: Function | None = dataclasses.field(default=None, kw_only=True)
    inequality: Function | None = dataclasses.field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        for function in (self.equality, self.inequality):
            if function is not None and not callable(function):
                raise CtrlidError(
                    f"Nonlinear needs functions of the coefficient vector; given {function!r}."
                )
        if self.equality is None and self.inequality is None:
            raise CtrlidError("Nonlinear needs equality=, inequality= or both.")

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        return (Branch(equality=self.equality, inequality=self.inequality),)


CONSTRAINTS: tuple[type[AbstractConstraint], ...] = (
    Bounds,
    Equal,
    Fixed,
    Integrator,
    Linear,
    Nonlinear,
    PoleAt,
    ReciprocalPoles,
    StaticGain,
    SymmetricPoles,
)


def check_constraints(constraints: Any) -> tuple[AbstractConstraint, ...]:
    """Return the constraints as a tuple; anything that is none is refused by listing what there is.

    Parameters
    ----------
    constraints : AbstractConstraint or sequence of them
        As the user gave them.

    Returns
    -------
    tuple of AbstractConstraint
        Without repetitions.
    """
    if isinstance(constraints, AbstractConstraint):
        constraints = (constraints,)
    known = ", ".join(c.__name__ for c in CONSTRAINTS)
    if isinstance(constraints, str | Mapping) or not hasattr(constraints, "__iter__"):
        raise CtrlidError(
            f"constraints must be a list of constraint objects; given {constraints!r}. "
            f"There are {known}."
        )
    kept: list[AbstractConstraint] = []
    for constraint in constraints:
        if isinstance(constraint, type) and issubclass(constraint, AbstractConstraint):
            name = constraint.__name__
            raise CtrlidError(f"{name} is a class: write {name}(...) with parentheses.")
        if not isinstance(constraint, AbstractConstraint):
            raise CtrlidError(
                f"{constraint!r} is not a constraint. There are {known}, or a subclass of "
                "ctrlid.constraints.AbstractConstraint of your own."
            )
        if constraint not in kept:
            kept.append(constraint)
    return tuple(kept)
