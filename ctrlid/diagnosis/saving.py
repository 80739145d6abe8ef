"""A diagnosis as a file that a person can read."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .._base.errors import CtrlidError
from .._base.files import replace_file
from ..effects import AbstractEffect
from ..effects.base import find_own_module, name_at_place, name_with_subject
from ..loop.loop import Loop
from ..physics.linearization import OperatingPoint

if TYPE_CHECKING:
    from .result import Diagnosis

FORMAT = "ctrlid diagnosis 1"


@dataclass(frozen=True)
class SavedLoop:
    """What a file keeps of the loop of a diagnosis: all but its plant and controller.

    It shows the values; whatever needs the equations is refused, with what to do.

    Parameters
    ----------
    plant_name : str
        Name of the plant.
    controller_text : str
        The controller in words.
    dt : float
        Sampling period [s].
    at : OperatingPoint
        The operating point.
    free : tuple of str, or dict of str to float
        The uncertain parameters, with how well each was known if that was said.
    input_limits : (float, float)
        Limits of the actuator; each may be a tuple with a value for every input.
    effects : tuple of AbstractEffect
        The effects, with those that were found.
    parameters : dict of str to float
        Values of the parameters of plant and effects.
    units : dict of str to dict
        Units of the parameters of effects, by class name, with what it acts on and its place where
        there are several.
    known_units : dict of str to str
        Units of signals, states and parameters of the plant, by name.
    """

    plant_name: str
    controller_text: str
    dt: float
    at: OperatingPoint
    free: tuple[str, ...] | dict[str, float]
    input_limits: tuple[float | tuple[float, ...], float | tuple[float, ...]]
    effects: tuple[AbstractEffect, ...]
    parameters: dict[str, float]
    units: dict[str, dict[str, str]]
    known_units: dict[str, str] = field(default_factory=dict)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise CtrlidError(
            f"the loop of this diagnosis was loaded without its plant {self.plant_name!r}, which "
            f"is Python code and not in the file, so that its {name!r} is not known. Give the loop "
            "that was diagnosed: load_diagnosis(file, loop=loop)"
        )


def list_units(loop: Loop | SavedLoop, effect: AbstractEffect) -> dict[str, str]:
    """Return the unit of each parameter of an effect, by a loop or by what was saved of it."""
    if isinstance(loop, SavedLoop):
        # Files of earlier versions do not tell effects on two states or parameters apart.
        units = loop.units.get(name_with_subject(effect)) or loop.units.get(name_at_place(effect))
        return units or effect.units()
    return effect.units(loop)


def save_diagnosis(found: Diagnosis, path: str | Path) -> Path:
    """Write a diagnosis to a file; see `Diagnosis.save`."""
    fields = {f.name: _encode(getattr(found, f.name))
              for f in dataclasses.fields(found) if f.name != "extra"}  # fmt: skip
    loop = {**fields.pop("loop"), "units": _list_effect_units(found)}
    extra, left = {}, []
    for key, value in found.extra.items():
        try:
            extra[str(key)] = _encode(value)
        except _NoText:
            left.append(str(key))
    fields |= {"extra": extra, **({"left out of extra": left} if left else {})}
    # The gap holds long arrays, so that it is written last.
    arrays = fields.pop("gap")
    text = write_readable_json({"format": FORMAT, **fields, "loop": loop, "gap": arrays})
    path = Path(path)
    try:
        with replace_file(path) as file:
            file.write(text + "\n")
    except OSError as reason:
        raise CtrlidError(
            f"the diagnosis cannot be written to {path}: {reason.strerror}. Give a file in a "
            "folder that exists and may be written to"
        ) from reason
    return path


class _NoText(CtrlidError):
    """A value that has no form in a file that a person can read."""


def _encode(value: Any) -> Any:
    """Return a value as what JSON has: texts, numbers, lists and mappings."""
    match value:
        case None | bool() | str():
            return value
        case int() | np.integer():
            return int(value)
        case float() | np.floating():
            number = float(value)
            return number if math.isfinite(number) else str(number)
        case AbstractEffect():
            module = find_own_module(value)
            own = {"module": module} if module else {}
            # An effect of a plant with one place has no place to name, nor a value out of use.
            fields = {f.name: _encode(getattr(value, f.name)) for f in dataclasses.fields(value)
                      if (f.name != "at" or value.at)
                      and ("parameter" not in f.metadata or f.name in value.values())}  # fmt: skip
            return {"name": type(value).__name__, **own, "parameters": fields}
        case Loop() | SavedLoop():
            return _encode_loop(value)
        case np.ndarray() | list() | tuple():
            return [
                _encode(v) for v in (value.tolist() if isinstance(value, np.ndarray) else value)
            ]
        case Mapping():
            return {str(k): _encode(v) for k, v in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _encode(getattr(value, f.name)) for f in dataclasses.fields(value)}
    raise _NoText(f"a {type(value).__name__} cannot be saved as text")


def _encode_loop(loop: Loop | SavedLoop) -> dict[str, Any]:
    at = loop.at
    assert at is not None
    name, controller = ((loop.plant_name, loop.controller_text) if isinstance(loop, SavedLoop) else
                 (loop.equations().name, " ".join(str(loop.controller).split())))  # fmt: skip
    return {
        "plant": name,
        "parameters": _encode(loop.parameters), "known_units": loop.known_units,
        "free": _encode(loop.free), "dt": _encode(loop.dt),
        "at": _encode(at), "input_limits": _encode(loop.input_limits),
        "controller": controller,
        "effects": [_encode(e) for e in loop.effects],
    }  # fmt: skip


def _list_effect_units(found: Diagnosis) -> dict[str, dict[str, str]]:
    """Return the units of all effects that a diagnosis speaks of, by what reports call them."""
    spoken = [*found.loop.effects, *(c.effect for c in found.ranking)]
    spoken += [e for f in found.added for e in (f.effect, *f.alternatives)]
    return {name_with_subject(e): list_units(found.loop, e) for e in spoken}


# JSON has no such numbers, so that they are written as texts.
SPECIAL = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}
# So many numbers of an array are written in one line, which a person can still read.
IN_A_LINE = 8


def read_numbers(data: Any) -> Any:
    """Return numbers that JSON does not have from their names, and all else as it is."""
    match data:
        case str():
            return SPECIAL.get(data, data)
        case list():
            return [read_numbers(v) for v in data]
        case dict():
            return {k: read_numbers(v) for k, v in data.items()}
    return data


def write_readable_json(value: Any, indent: int = 0) -> str:
    """Write JSON with an entry a line and the numbers of an array several in a line."""
    inner, outer = " " * (indent + 2), " " * indent
    if isinstance(value, dict) and value:
        rows = [f"{json.dumps(k, ensure_ascii=False)}: {write_readable_json(v, indent + 2)}"
                for k, v in value.items()]  # fmt: skip
        return "{\n" + ",\n".join(inner + row for row in rows) + f"\n{outer}}}"
    if isinstance(value, list) and value and any(isinstance(v, dict | list) for v in value):
        return (
            "[\n"
            + ",\n".join(inner + write_readable_json(v, indent + 2) for v in value)
            + f"\n{outer}]"
        )
    if isinstance(value, list) and len(value) > IN_A_LINE:
        rows = [json.dumps(value[k : k + IN_A_LINE], ensure_ascii=False)[1:-1]
                for k in range(0, len(value), IN_A_LINE)]  # fmt: skip
        return "[\n" + ",\n".join(inner + row for row in rows) + f"\n{outer}]"
    return json.dumps(value, ensure_ascii=False)
