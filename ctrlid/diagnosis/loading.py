"""A diagnosis read back from its file."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np

from .._base.arguments import check_arguments, check_fields, explain_names
from .._base.errors import CtrlidError
from ..effects import AbstractEffect
from ..loop.loop import Loop
from ..physics.linearization import OperatingPoint
from ..validation.reproduction import CLOSED_LOOP, OPEN_LOOP
from .findings import (
    BinnedErrors,
    Calibrated,
    Candidate,
    Disturbance,
    Finding,
    Gap,
    GapKind,
    SensorNoise,
)
from .result import Diagnosis
from .saving import FORMAT, SavedLoop, read_numbers


@explain_names
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
    check_arguments(load_diagnosis, locals(), "loop")
    try:
        data = json.loads(Path(path).read_text("utf-8"))
    except OSError as reason:
        raise CtrlidError(f"cannot read {path}: {reason.strerror}") from reason
    except (ValueError, RecursionError) as reason:
        raise CtrlidError(f"{path} is not a saved diagnosis: {reason}. Give a file that "
                          "found.save(file) wrote") from reason  # fmt: skip
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        given = data.get("format") if isinstance(data, dict) else type(data).__name__
        raise CtrlidError(f"{path} is not a saved diagnosis: it has the format {given!r}, not "
                          f"{FORMAT!r}. Give a file that found.save(file) wrote")  # fmt: skip
    try:
        found = _decode_diagnosis(data, loop)
        str(found)  # What cannot be printed is damaged, too.
        return found
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as reason:
        if isinstance(reason, CtrlidError):
            raise
        raise CtrlidError(f"the saved diagnosis {path} is damaged: {reason}. Save it again with "
                          "found.save(file)") from reason  # fmt: skip


def _decode_diagnosis(data: Mapping[str, Any], loop: Loop | None) -> Diagnosis:
    saved = _decode_loop(data["loop"])
    found = Diagnosis(
        verdict=data["verdict"], sentence=data["sentence"],
        findings=tuple(_decode(Finding, f) for f in data["findings"]),
        loop=saved if loop is None else _rebuild_loop(loop, saved),  # type: ignore[arg-type]
        gap=_decode(Gap, _name_kind(data["gap"])),
        where=tuple(_decode(BinnedErrors, p) for p in data["where"]),
        ranking=tuple(_decode(Candidate, c) for c in data["ranking"]),
        disturbance=_decode(Disturbance, data["disturbance"]),
        calibrated=tuple(_decode(Calibrated, c) for c in data["calibrated"]),
        sensitivity=read_numbers(data["sensitivity"]), tests=read_numbers(data["tests"]),
        audit=tuple(data["audit"]), notes=tuple(data["notes"]), record=data["record"],
        seconds=read_numbers(data["seconds"]), extra=read_numbers(data["extra"]),
        noise=_decode(SensorNoise, data["noise"]) if data.get("noise") else None,
        stand_ins=tuple(_decode(Finding, f) for f in data.get("stand_ins", ())),
        finished=bool(data.get("finished", True)),
        sensitivity_errors=read_numbers(data.get("sensitivity_errors", {})),
    )  # fmt: skip
    check_fields(found, "loop")
    return found


def _name_kind(gap: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the fields of a gap with the kind as it is called now; files may be older."""
    if gap["kind"] in get_args(GapKind):
        return gap
    simulated = gap["kind"] in (str(CLOSED_LOOP), str(OPEN_LOOP))
    return {**gap, "kind": "simulation" if simulated else "prediction",
            "closed_loop": gap["kind"] == str(CLOSED_LOOP)}  # fmt: skip


def _rebuild_loop(loop: Loop, saved: SavedLoop) -> Loop:
    """Return the user's loop with the saved parameters and effects."""
    if not isinstance(loop, Loop):
        raise CtrlidError(f"loop= needs the Loop that was diagnosed; given {type(loop).__name__}")
    name = loop.equations().name
    if name != saved.plant_name:
        raise CtrlidError(f"the saved diagnosis is of the plant {saved.plant_name!r}; the loop "
                          f"given has {name!r}. Give the loop that was diagnosed")  # fmt: skip
    e, known = loop.equations(), saved.known_units
    units = {name: known[name] for name in (*e.inputs, *e.outputs) if name in known}
    limits: Any = saved.input_limits
    changed = dataclasses.replace(
        loop, dt=saved.dt, at=saved.at, free=(), effects=saved.effects, input_limits=limits,
        units={**loop.units, **units},
    )  # fmt: skip
    return dataclasses.replace(changed.with_parameters(saved.parameters), free=saved.free)


def _decode_loop(data: Mapping[str, Any]) -> SavedLoop:
    at = read_numbers(data["at"])
    saved = SavedLoop(
        plant_name=data["plant"], controller_text=data["controller"], dt=read_numbers(data["dt"]),
        at=OperatingPoint(tuple(at["states"]), *(
            tuple(v) if isinstance(v, list) else v for v in (at["input"], at["output"])
        )),
        free=_decode_free(data["free"]), input_limits=_read_limits(data["input_limits"]),
        effects=tuple(_decode_effect(e) for e in data["effects"]),
        parameters=read_numbers(data["parameters"]), units=data["units"],
        known_units=data.get("known_units", {}),
    )  # fmt: skip
    check_fields(saved)
    return saved


def _read_limits(data: Any) -> Any:
    """Return limits of one input, or with a value for each of several."""
    return tuple(tuple(v) if isinstance(v, list) else v for v in read_numbers(data))


def _decode_free(data: Any) -> tuple[str, ...] | dict[str, float]:
    return read_numbers(data) if isinstance(data, dict) else tuple(data)


def _decode_effect(data: Mapping[str, Any]) -> AbstractEffect:
    """Return an effect by the name of its class."""
    name, values = data["name"], {k: read_numbers(v) for k, v in data["parameters"].items()}
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


def _decode(kind: Any, data: Mapping[str, Any]) -> Any:
    """Return one of the values of a diagnosis from its fields."""
    made: Any = {}
    for field in dataclasses.fields(kind):
        if field.name not in data and field.default is not dataclasses.MISSING:
            continue  # The file was written before there was this field.
        value = data[field.name]
        match field.name:
            case "effect":
                made[field.name] = _decode_effect(value)
            case "alternatives":
                made[field.name] = tuple(_decode_effect(e) for e in value)
            case "outputs" if kind is Gap:
                made[field.name] = tuple(_decode(Gap, part) for part in value)
            case "outputs" | "forces" | "tails":
                made[field.name] = tuple(tuple(read_numbers(row)) for row in value)
            case "equivalents" | "records" | "ar" | "ma":
                made[field.name] = tuple(value)
            case _:
                made[field.name] = value if field.type in (str, "str") else read_numbers(value)
                if isinstance(value, list):
                    made[field.name] = np.asarray(made[field.name], dtype=float)
    made = kind(**made)
    check_fields(made)
    return made
