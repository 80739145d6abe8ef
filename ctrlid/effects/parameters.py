"""What is known about a parameter of an effect: unit, bounds, and the value that does nothing."""

import dataclasses
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from .._base import units as _units
from .._base.arguments import check_arguments
from .._base.errors import CtrlidError

# What the names in the unit of a parameter stand for.
WORDS = {"u": "input unit", "y": "output unit", "x": "unit of the state"}


@dataclass(frozen=True)
class Parameter:
    """What is known about one parameter of an effect.

    `unit` is a template in which ``{u}``, ``{y}`` and ``{x}`` stand for the units of the input, the
    output and the state that the effect names. `neutral` is the value at which the effect vanishes,
    None for a parameter that does not decide this, such as the frequency of a vibration. `instant`
    says that it is a moment in time, `searched` that it is looked for over a range, on whose edge
    nothing was found, `optional` that an effect may go without it: at zero it is no value of the
    effect, and is not fitted.
    """

    name: str
    unit: str
    lower: float
    upper: float
    neutral: float | None
    instant: bool = False
    searched: bool = False
    optional: bool = False


def parameter(
    unit: str,
    *,
    lower: float = -math.inf,
    upper: float = math.inf,
    neutral: float | None = None,
    default: Any = dataclasses.MISSING,
    instant: bool = False,
    searched: bool = False,
    optional: bool = False,
) -> Any:
    """Declare a numeric field of an effect.

    Parameters
    ----------
    unit : str
        Unit, with ``{u}`` and ``{y}`` for the units of input and output, and ``{x}`` for that of
        the state that the effect names; "" for a plain number.
    lower, upper : float, optional
        Physical bounds, included.
    neutral : float, optional
        The value at which the effect vanishes; none if this parameter does not decide it.
    default : float, optional
        Value of the field if it is not given.
    instant : bool, optional
        Whether it is a moment in time [s], at which the likelihood is too rugged for a fit by
        slopes; a fit then also tries moments nearby.
    searched : bool, optional
        Whether it is looked for over a range that the record sets, such as a frequency; an effect
        that ends on the edge of this range was not found.
    optional : bool, optional
        Whether the effect may go without it: at zero, its default, it is not fitted.

    Returns
    -------
    dataclasses.Field
        The field.

    Raises
    ------
    CtrlidError
        If the unit has other names in braces.
    """
    check_arguments(parameter, locals(), "default")
    unknown = [name for name in re.findall(r"\{(.*?)\}", unit) if name not in WORDS]
    if unknown:
        raise CtrlidError(f"unit takes {{u}}, {{y}} and {{x}} for the units of input, output and "
                          f"state; given {{{unknown[0]}}} in {unit!r}")  # fmt: skip
    about = {"unit": unit, "lower": lower, "upper": upper, "neutral": neutral,
             "instant": instant, "searched": searched, "optional": optional}  # fmt: skip
    default = 0.0 if optional else default
    if default is dataclasses.MISSING:
        return dataclasses.field(metadata={"parameter": about})
    return dataclasses.field(default=default, metadata={"parameter": about})


def fill_unit(unit: str, signals: Mapping[str, str] | None = None) -> str:
    """Return a unit with the units of signals in it, or with [u] and [y] where they are unknown."""
    known = {"u": "[u]", "y": "[y]", "x": "[state]", **(signals or {})}
    return _units.fill_unit(unit, known)


def write_unit(unit: str) -> str:
    """Return a unit in brackets, with those of signals in words; nothing for a plain number.

    Examples
    --------
    >>> write_unit("s"), write_unit("{y}/s"), write_unit("1/(s {u}^2)"), write_unit("")
    (' [s]', ' [output unit/s]', ' [1/(s (input unit)^2)]', '')
    """
    return f" [{fill_unit(unit, WORDS)}]" if unit else ""
