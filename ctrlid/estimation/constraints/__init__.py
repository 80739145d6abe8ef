"""What is known beforehand about a model, as rows of a quadratic program.

Every constraint answers one question: which rows ``lower <= w' theta <= upper`` does it put on the
coefficients of a given `Structure`? An estimator never asks which constraint it has.

A constraint of your own is a subclass of `AbstractConstraint` with the one method ``branches``:

>>> from dataclasses import dataclass
>>> from ctrlid.estimation.constraints import AbstractConstraint, Branch, equals
>>> from ctrlid.estimation.identified_model import Structure
>>> @dataclass(frozen=True)
... class NoDamping(AbstractConstraint):
...     def branches(self, structure):
...         return [Branch([equals({"a1": 1.0}, 0.0)])]
>>> NoDamping().branches(Structure(2, 1, domain="s"))[0].rows[0]
a1 = 0

Several branches are alternatives of which the cheapest wins; a branch may hold a family of rows
with one free number, which is searched for.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from ..._base.arguments import is_iterable
from ..._base.errors import CtrlidError
from .base import AbstractConstraint, Branch, Row, equals
from .coefficients import Bounds, Equal, Fixed, Linear, Nonlinear, StaticGain
from .poles import Integrator, PoleAt, ReciprocalPoles, SymmetricPoles

__all__ = [
    "CONSTRAINTS",
    "AbstractConstraint",
    "Bounds",
    "Branch",
    "Equal",
    "Fixed",
    "Integrator",
    "Linear",
    "Nonlinear",
    "PoleAt",
    "ReciprocalPoles",
    "Row",
    "StaticGain",
    "SymmetricPoles",
    "check_constraints",
    "divide_constraints",
    "equals",
]

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
    if isinstance(constraints, str | Mapping) or not is_iterable(constraints):
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
                "ctrlid.estimation.constraints.AbstractConstraint of your own."
            )
        if constraint not in kept:
            kept.append(constraint)
    return tuple(kept)


def divide_constraints(
    constraints: Sequence[AbstractConstraint], outputs: Collection[str], inputs: Collection[str]
) -> dict[str, tuple[AbstractConstraint, ...]]:
    """Return the constraints of each output: those that name it, and those that name none.

    Parameters
    ----------
    constraints : sequence of AbstractConstraint
        All of them.
    outputs : collection of str
        Names of the outputs.
    inputs : collection of str
        Names of the inputs.

    Returns
    -------
    dict of str to tuple of AbstractConstraint
        By output.

    Raises
    ------
    CtrlidError
        If one names an output or an input that there is not.
    """
    for constraint in constraints:
        for kind, known in (("output", outputs), ("input", inputs)):
            name = getattr(constraint, kind, "")
            if name not in ("", *known):
                raise CtrlidError(f"{constraint!r} speaks of the {kind} {name!r}; the record has "
                                  f"{', '.join(known)}.")  # fmt: skip
    return {
        output: tuple(c for c in constraints if getattr(c, "output", "") in ("", output))
        for output in outputs
    }
