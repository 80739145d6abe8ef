"""What may be known of a model's gain and of its coefficients."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import final

from ..._base.arguments import check_fields
from ..._base.errors import CtrlidError
from ..identified_model import Structure
from .base import (
    Branch,
    Function,
    Known,
    Row,
    check_finite,
    check_interval,
    equals,
)


@final
@dataclass(frozen=True, repr=False)
class StaticGain(Known):
    """``B(1) = gain * A(1)``: output over input at rest (``B(0) = gain * A(0)`` in s).

    It contradicts an integrator, whose gain is infinite: the row alone would let the numerator
    vanish there as well.

    Parameters
    ----------
    gain : float
        In output units per input unit.
    output : str, optional
        The output that it speaks of; by default all.
    input : str, optional
        Which of several inputs.

    Examples
    --------
    >>> StaticGain(3.0).branches(Structure(1, 1))[0].rows
    (-3 a1 + b1 = 3,)
    """

    gain: float
    input: str = dataclasses.field(default="", kw_only=True)

    def __post_init__(self) -> None:
        check_fields(self, "gain")
        object.__setattr__(self, "gain", check_finite(self.gain, "StaticGain"))

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        which = self._find_input(structure)
        if structure.domain == "z":
            a = [f"a{i}" for i in range(1, structure.na + 1)]
            b = list(structure.names[structure.numerators[which]])
            one = 1.0
        else:
            a, b, one = [f"a{structure.na}"], [f"b{structure.nb}"], 0.0
        weights = {**dict.fromkeys(a, -self.gain), **dict.fromkeys(b, 1.0)}
        at_rest = equals(dict.fromkeys(a, 1.0), -one)
        return (Branch((equals(weights, self.gain * one),), nonzero=(at_rest,)),)

    def _find_input(self, structure: Structure) -> int:
        """Return the number of the input whose gain is known."""
        inputs = structure.inputs
        # The name of a single input is not part of the structure.
        if not inputs:
            return 0
        if self.input not in inputs:
            raise CtrlidError(
                f"StaticGain needs input= with one of {', '.join(inputs)}; given {self.input!r}."
            )
        return inputs.index(self.input)


@final
@dataclass(frozen=True, repr=False)
class Fixed(Known):
    """One coefficient is known.

    Parameters
    ----------
    name : str
        Coefficient, for instance ``"a2"``.
    value : float
        Its value [unit of the coefficient].
    output : str, optional
        The output that it speaks of; by default all.

    Examples
    --------
    >>> Fixed("a2", 1.0)
    Fixed("a2", 1.0)
    """

    name: str
    value: float

    def __post_init__(self) -> None:
        check_fields(self, "value")
        object.__setattr__(self, "value", check_finite(self.value, f"Fixed({self.name!r}, ...)"))

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        return (Branch((equals({self.name: 1.0}, self.value),)),)


@final
@dataclass(frozen=True, repr=False)
class Bounds(Known):
    """One coefficient lies between two values; leave one out for a one-sided bound.

    Parameters
    ----------
    name : str
        Coefficient, for instance ``"b1"``.
    lower, upper : float
        Bounds, both allowed values [unit of the coefficient].
    output : str, optional
        The output that it speaks of; by default all.

    Examples
    --------
    >>> Bounds("b1", upper=0.0).branches(Structure(2, 2))[0].rows
    (b1 <= 0,)
    """

    name: str
    lower: float = -math.inf
    upper: float = math.inf

    def __post_init__(self) -> None:
        check_fields(self, "lower", "upper")
        low, high = check_interval(self.lower, self.upper, f"Bounds({self.name!r}, ...)")
        object.__setattr__(self, "lower", low)
        object.__setattr__(self, "upper", high)

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        return (Branch((Row({self.name: 1.0}, self.lower, self.upper),)),)


@final
@dataclass(frozen=True, repr=False)
class Equal(Known):
    """Two coefficients are equal, as b1 and b2 of a zero-order held double integrator or maglev.

    Parameters
    ----------
    first, second : str
        Coefficients.
    output : str, optional
        The output that it speaks of; by default all.

    Examples
    --------
    >>> Equal("b1", "b2").branches(Structure(2, 2))[0].rows
    (b1 - b2 = 0,)
    """

    first: str
    second: str

    def __post_init__(self) -> None:
        check_fields(self)
        if self.first == self.second:
            raise CtrlidError(
                f"Equal needs two different coefficients; given {self.first!r} twice."
            )

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        return (Branch((equals({self.first: 1.0, self.second: -1.0}, 0.0),)),)


@final
@dataclass(frozen=True, repr=False)
class Linear(Known):
    """A weighted sum of coefficients is bounded, or equals a value.

    Parameters
    ----------
    weights : mapping of str to float
        Weight of each coefficient in the sum.
    output : str, optional
        The output that it speaks of; by default all.
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
        weights = {
            n: check_finite(w, f"Linear: the weight of {n}") for n, w in self.weights.items()
        }
        if not any(weights.values()):
            raise CtrlidError(f"Linear: all weights are zero in {weights!r}: nothing is bounded.")
        object.__setattr__(self, "weights", weights)
        check_fields(self, "weights", "equals")
        if self.equals is None:
            low, high = check_interval(self.lower, self.upper, "Linear")
            object.__setattr__(self, "lower", low)
            object.__setattr__(self, "upper", high)
        elif self.lower > -math.inf or self.upper < math.inf:
            raise CtrlidError("Linear takes equals= or bounds (lower=, upper=), not both.")
        else:
            object.__setattr__(self, "equals", check_finite(self.equals, "Linear: equals"))

    def branches(self, structure: Structure) -> Sequence[Branch]:
        """See the base class."""
        if self.equals is not None:
            return (Branch((equals(self.weights, self.equals),)),)
        return (Branch((Row(self.weights, self.lower, self.upper),)),)


@final
@dataclass(frozen=True, repr=False)
class Nonlinear(Known):
    """The general form: ``g(theta) = 0`` and ``f(theta) >= 0``, equation (7) of [1]_.

    Solved as a sequence of quadratic programs from several starts; what comes out is a local
    optimum, checked to meet the constraint. A linear fact is better given as `Linear`.

    Parameters
    ----------
    output : str, optional
        The output that it speaks of; by default all.
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
