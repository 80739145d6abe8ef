"""What a loop is given: its limits, effects, free parameters and units, refused in words."""

import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from .._base.arguments import is_iterable, is_number
from .._base.arrays import to_real_array
from .._base.errors import CtrlidError, CtrlidWarning
from .._base.text import write_percent
from ..effects import AbstractEffect
from ..physics.equations import Equations


def check_limits(given: Any, inputs: int) -> Any:
    """Return the limits of the actuator, as floats or with a value for each input."""
    try:
        # A transfer function is asked for its elements, too, and refuses otherwise.
        pair = tuple(given) if is_iterable(given) else ()
        lower, upper = (to_real_array(v, "input_limits") for v in pair)
        # Where one of them differs between the inputs, both have a value for each.
        lower, upper = np.broadcast_arrays(lower, upper)
        pairs = np.broadcast_to(np.array([lower, upper]).T, (inputs, 2))
    except (TypeError, ValueError) as reason:
        raise CtrlidError("input_limits is a pair (lower, upper) in input units; given "
                          f"{given!r}") from reason  # fmt: skip
    for low, high in pairs:
        if not low < high:
            raise CtrlidError(f"input_limits needs lower < upper; given ({low:g}, {high:g})")
    return tuple(tuple(v.tolist()) if v.ndim else float(v) for v in (lower, upper))


def check_effects(given: Any) -> tuple[AbstractEffect, ...]:
    """Return the effects of a loop, of which a single one may be given by itself."""
    if isinstance(given, AbstractEffect):
        return (given,)
    effects = tuple(_require_sequence(given, "effects"))
    strangers = [e for e in effects if not isinstance(e, AbstractEffect)]
    if strangers:
        raise CtrlidError(
            "effects are instances of the classes in ctrlid.effects, such as "
            f"CoulombFriction(fc=0.1); given {strangers[0]!r}"
        )
    return effects


def check_free(given: Any, e: Equations) -> tuple[str, ...] | dict[str, float]:
    """Return the names of free parameters, with how well each is known where that is given."""
    _require_sequence(given, "free")
    named = (given,) if isinstance(given, str) else given
    free = dict(named) if isinstance(named, Mapping) else tuple(named)
    if not all(isinstance(name, str) for name in free):
        raise CtrlidError(f"free= takes names of parameters; given {given!r}")
    unknown = [name for name in dict.fromkeys(free) if name not in e.parameters]
    if unknown:
        raise CtrlidError(
            f"free= names {unknown}, but the numeric parameters of {e.name} are "
            f"{list(e.parameters)}; give parameters to ct.nlsys with params={{...}}, each of them "
            "one number: an array cannot be free"
        )
    if not isinstance(free, dict):
        return tuple(dict.fromkeys(free))
    _check_beliefs(free, e.parameters)
    return free


def check_units(given: Any, e: Equations) -> None:
    """Refuse units of what the plant does not have."""
    known = (*e.inputs, *e.outputs, *e.states, *e.parameters)
    if not isinstance(given, Mapping) or not all(isinstance(v, str) for v in given.values()):
        raise CtrlidError("units= maps names of the plant to units, as in "
                          f"{{{e.outputs[0]!r}: 'm'}}; given {given!r}")  # fmt: skip
    unknown = [name for name in given if name not in known]
    if unknown:
        raise CtrlidError(f"units= names {unknown}, but the signals, states and parameters of "
                          f"{e.name} are {list(dict.fromkeys(known))}")  # fmt: skip


def question_effects(effects: tuple[AbstractEffect, ...], dt: float, stacklevel: int) -> None:
    """Warn of values that are odd at this sampling period, such as a delay of 400 samples."""
    for effect in effects:
        text = effect.question(dt)
        if text is not None:
            warnings.warn(text, CtrlidWarning, stacklevel=stacklevel)


def question_beliefs(free: Any, parameters: Mapping[str, float], stacklevel: int) -> None:
    """Warn of a belief that seems to be a value of the parameter, or a number of per cent."""
    for name, share in free.items() if isinstance(free, Mapping) else ():
        value = parameters[name]
        is_value = share < 1e-3 and 0.5 < share / abs(value) < 2 if value else False
        if is_value or 1 < share < math.inf:
            warnings.warn(
                f"free={{{name!r}: {share:g}}} says that {name} is known to "
                f"{write_percent(share)} of {value:g}, as a standard deviation. It is no value of "
                f"{name} and no number of per cent: 10 % is {{{name!r}: 0.1}}, and inf that "
                "nothing is known",
                CtrlidWarning, stacklevel=stacklevel,
            )  # fmt: skip


def _require_sequence(given: Any, name: str) -> Any:
    if not is_iterable(given):
        raise CtrlidError(f"a loop needs a sequence as {name}=; given {given!r}")
    return given


def _check_beliefs(free: Mapping[str, Any], parameters: Mapping[str, float]) -> None:
    """Refuse what does not say how well a parameter is known."""
    for name, share in free.items():
        if not is_number(share):
            problem = f"given {share!r} for {name}"
        elif math.isnan(share) or share < 0:
            problem = f"given {share:g} for {name}"
        elif share == 0:
            problem = f"{name} is known exactly by what is given, 0: leave out what is not free"
        elif parameters[name] == 0 and share < math.inf:
            problem = (f"{name} is zero in the loop, of which no share can be taken: give inf for "
                       "it, or the value that is believed")  # fmt: skip
        else:
            continue
        raise CtrlidError(
            "free= as a mapping says how well each parameter is known, by the standard deviation "
            f'of what is believed relative to its value, such as {{"{name}": 0.1}} for 10 %; '
            f"{problem}"
        )
