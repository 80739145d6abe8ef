"""A diagnosis as a file that a person can read, and back."""

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .._base.errors import CtrlidError
from ..effects import AbstractEffect
from ..loop.loop import Loop
from ..physics.linearization import OperatingPoint
from .readable import numbers, readable
from .result import Calibrated, Candidate, Diagnosis, Disturbance, Finding, Gap, Place

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
    free : tuple of str
        The uncertain parameters.
    input_limits : (float, float)
        Limits of the actuator.
    effects : tuple of AbstractEffect
        The effects, with those that were found.
    parameters : dict of str to float
        Values of the parameters of plant and effects.
    units : dict of str to dict
        Units of the parameters of effects, by class name.
    """

    plant_name: str
    controller_text: str
    dt: float
    at: OperatingPoint
    free: tuple[str, ...]
    input_limits: tuple[float, float]
    effects: tuple[AbstractEffect, ...]
    parameters: dict[str, float]
    units: dict[str, dict[str, str]]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise CtrlidError(
            f"the loop of this diagnosis was loaded without its plant {self.plant_name!r}, which "
            f"is Python code and not in the file, so there is no {name}. Give the loop that was "
            "diagnosed: load_diagnosis(file, loop=loop)"
        )


def units_of(loop: Loop | SavedLoop, effect: AbstractEffect) -> dict[str, str]:
    """Return the unit of each parameter of an effect, by a loop or by what was saved of it."""
    if isinstance(loop, SavedLoop):
        return loop.units.get(type(effect).__name__, effect.units())
    return effect.units(loop)


def save(found: Diagnosis, path: str | Path) -> Path:
    """Write a diagnosis to a file; see `Diagnosis.save`."""
    fields = dict(_plain(found))
    loop = {**fields.pop("loop"), "units": _units(found)}
    extra, left = {}, []
    for key, value in found.extra.items():
        try:
            extra[str(key)] = _plain(value)
        except CtrlidError:
            left.append(str(key))
    fields |= {"extra": extra, **({"left out of extra": left} if left else {})}
    arrays = fields.pop("gap")  # long: last
    text = readable({"format": FORMAT, **fields, "loop": loop, "gap": arrays})
    path = Path(path)
    try:
        path.write_text(text + "\n", encoding="utf-8")
    except OSError as reason:
        raise CtrlidError(
            f"the diagnosis cannot be written to {path}: {reason.strerror}. Give a file in a "
            "folder that exists and may be written to"
        ) from reason
    return path


def load_diagnosis(path: str | Path, loop: Loop | None = None) -> Diagnosis:
    """Read a diagnosis that `Diagnosis.save` wrote.

    Parameters
    ----------
    path : str or Path
        The file.
    loop : Loop, optional
        The loop that was diagnosed, or one like it: its plant and controller are taken, the
        fitted parameters and the effects come from the file. Without it ``found.loop`` shows the
        values and cannot simulate, since a plant is Python code and not in the file.

    Returns
    -------
    Diagnosis
        The diagnosis.

    Raises
    ------
    CtrlidError
        If the file is none of these, an effect is of an unknown class, or the loop does not fit.
    """
    try:
        data = json.loads(Path(path).read_text("utf-8"))
    except OSError as reason:
        raise CtrlidError(f"cannot read {path}: {reason.strerror}") from reason
    except ValueError as reason:
        raise CtrlidError(f"{path} is not a saved diagnosis: {reason}. Give a file that "
                          "found.save(file) wrote") from reason  # fmt: skip
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        given = data.get("format") if isinstance(data, dict) else type(data).__name__
        raise CtrlidError(f"{path} is not a saved diagnosis: it has the format {given!r}, not "
                          f"{FORMAT!r}. Give a file that found.save(file) wrote")  # fmt: skip
    try:
        return _diagnosis(data, loop)
    except (KeyError, TypeError) as reason:
        raise CtrlidError(f"the saved diagnosis {path} is damaged: {reason}") from reason


def _diagnosis(data: Mapping[str, Any], loop: Loop | None) -> Diagnosis:
    saved = _loop(data["loop"])
    return Diagnosis(
        verdict=data["verdict"], sentence=data["sentence"],
        findings=tuple(_made(Finding, f) for f in data["findings"]),
        loop=saved if loop is None else _rebuilt(loop, saved),  # type: ignore[arg-type]
        gap=_made(Gap, data["gap"]), where=tuple(_made(Place, p) for p in data["where"]),
        ranking=tuple(_made(Candidate, c) for c in data["ranking"]),
        disturbance=_made(Disturbance, data["disturbance"]),
        calibrated=tuple(_made(Calibrated, c) for c in data["calibrated"]),
        sensitivity=numbers(data["sensitivity"]), tests=numbers(data["tests"]),
        audit=tuple(data["audit"]), notes=tuple(data["notes"]), record=data["record"],
        seconds=numbers(data["seconds"]), extra=numbers(data["extra"]),
    )  # fmt: skip


def _rebuilt(loop: Loop, saved: SavedLoop) -> Loop:
    """Return the user's loop with the saved parameters and effects."""
    if not isinstance(loop, Loop):
        raise CtrlidError(f"loop= needs the Loop that was diagnosed; given {type(loop).__name__}")
    name = loop.equations().name
    if name != saved.plant_name:
        raise CtrlidError(f"the saved diagnosis is of the plant {saved.plant_name!r}; the loop "
                          f"given has {name!r}. Give the loop that was diagnosed")  # fmt: skip
    changed = dataclasses.replace(loop, dt=saved.dt, at=saved.at, free=(), effects=saved.effects,
                                  input_limits=saved.input_limits)  # fmt: skip
    return dataclasses.replace(changed.with_parameters(saved.parameters), free=saved.free)


def _loop(data: Mapping[str, Any]) -> SavedLoop:
    at = numbers(data["at"])
    return SavedLoop(
        plant_name=data["plant"], controller_text=data["controller"], dt=numbers(data["dt"]),
        at=OperatingPoint(tuple(at["states"]), at["input"], at["output"]),
        free=tuple(data["free"]), input_limits=tuple(numbers(data["input_limits"])),
        effects=tuple(_effect(e) for e in data["effects"]),
        parameters=numbers(data["parameters"]), units=data["units"],
    )  # fmt: skip


def _effect(data: Mapping[str, Any]) -> AbstractEffect:
    """Return an effect by the name of its class."""
    name, values = data["name"], {k: numbers(v) for k, v in data["parameters"].items()}
    classes, known = [AbstractEffect], []
    for cls in classes:
        classes += cls.__subclasses__()
        known += [cls] if cls.__name__ == name else []
    module = data.get("module")
    known = [cls for cls in known if cls.__module__ == module] or known
    if not known:
        where = f"; import it first, it was defined in {module}" if module else ""
        raise CtrlidError(f"the saved diagnosis has an effect {name!r}, but no effect of this name "
                          f"is defined{where}")  # fmt: skip
    return known[-1](**values)


def _made(kind: Any, data: Mapping[str, Any]) -> Any:
    """Return one of the values of a diagnosis from its fields."""
    made: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        value = data[field.name]
        match field.name:
            case "effect":
                made[field.name] = _effect(value)
            case "alternatives":
                made[field.name] = tuple(_effect(e) for e in value)
            case "equivalents":
                made[field.name] = tuple(value)
            case _:
                made[field.name] = value if field.type in (str, "str") else numbers(value)
                if isinstance(value, list):
                    made[field.name] = np.asarray(made[field.name], dtype=float)
    return kind(**made)


def _plain(value: Any) -> Any:
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
            own = {} if type(value).__module__.startswith("ctrlid.") else {
                "module": type(value).__module__}  # fmt: skip
            fields = {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
            return {"name": type(value).__name__, **own, "parameters": fields}
        case Loop() | SavedLoop():
            return _plain_loop(value)
        case np.ndarray() | list() | tuple():
            return [_plain(v) for v in (value.tolist() if isinstance(value, np.ndarray) else value)]
        case Mapping():
            return {str(k): _plain(v) for k, v in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)
                if not (isinstance(value, Diagnosis) and f.name == "extra")}  # fmt: skip
    raise CtrlidError(f"a {type(value).__name__} cannot be saved as text")


def _plain_loop(loop: Loop | SavedLoop) -> dict[str, Any]:
    at = loop.at
    assert at is not None
    name, law = ((loop.plant_name, loop.controller_text) if isinstance(loop, SavedLoop) else
                 (loop.equations().name, " ".join(str(loop.controller).split())))  # fmt: skip
    return {
        "plant": name,
        "parameters": _plain(loop.parameters), "free": list(loop.free), "dt": _plain(loop.dt),
        "at": _plain(at), "input_limits": _plain(loop.input_limits),
        "controller": law,
        "effects": [_plain(e) for e in loop.effects],
    }  # fmt: skip


def _units(found: Diagnosis) -> dict[str, dict[str, str]]:
    """Return the units of all effects that a diagnosis speaks of, by class name."""
    spoken = [*found.loop.effects, *(c.effect for c in found.ranking)]
    spoken += [e for f in found.findings for e in (f.effect, *f.alternatives)]
    return {type(e).__name__: units_of(found.loop, e) for e in spoken}
