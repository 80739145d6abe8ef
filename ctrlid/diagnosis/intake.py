"""What a diagnosis begins with: the model as a loop, and the records looked over."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import control as ct
import numpy as np

from .._base.errors import CtrlidError
from ..data.record import Record
from ..effects import InputDelay, InputOffset
from ..estimation.identified_model import delay_of
from ..loop.loop import Loop
from ..physics.linearization import OperatingPoint
from ..validation.record_audit import Audit, audit

HOPELESS = ("too few samples", "constant signal", "operating point")
REPEATS = 3  # of an experiment, from which its noise is taken


def as_loop(loop: Any, record: Record) -> Loop:
    """Return the loop; a transfer function becomes one around the means of the record."""
    if isinstance(loop, Loop):
        return loop
    if not isinstance(loop, ct.TransferFunction):
        raise CtrlidError(
            "diagnose needs a Loop(plant, controller, dt=..., at=..., free=...) or a transfer "
            f"function such as the fits return; given {type(loop).__name__}"
        )
    valid = record.valid
    u, y = float(np.mean(record.u[valid])), float(np.mean(record.y[valid]))
    plain = ct.tf(loop.num, loop.den, loop.dt)
    linear = Loop(plain, None, dt=record.dt, at=OperatingPoint((), u, y))
    delay = delay_of(loop)
    linear = linear.with_effect(InputOffset(0.0))  # where it rests, the means only guess
    linear = replace(linear, free=tuple(linear.parameters))
    return linear.with_effect(InputDelay(delay)) if delay else linear


def look_over(
    loop: Loop, records: Sequence[Record]
) -> tuple[tuple[Audit, ...], tuple[str, ...]]:  # fmt: skip
    """Return what is remarkable about the records; refuse those that carry nothing."""
    audits, remarks = [], _foreign_units(loop, records[0])
    for k, record in enumerate(records):
        found = audit(record, loop)
        audits.append(found)
        hopeless = [f.text for f in found.findings if f.kind in HOPELESS and f.channel != "r"]
        if hopeless:
            raise CtrlidError(
                f"{record.name or 'the record'} cannot be diagnosed: {' '.join(hopeless)}"
            )
        which = f"record {k + 1}: " if len(records) > 1 else ""
        remarks += [f"{which}{f.kind}: {f.text}" for f in found.findings]
    return tuple(audits), tuple(remarks)


def _foreign_units(loop: Loop, record: Record) -> list[str]:
    """Say where a record counts in other units than the plant, whose words sizes are written in."""
    e, known = loop.equations(), getattr(loop.plant, "units", {})
    remarks = []
    for key, name in (("u", e.inputs[0]), ("y", e.outputs[0])):
        there, here = record.units.get(key, ""), known.get(name, "")
        if there and here and there != here:
            there = "plain numbers" if there == "1" else there
            remarks.append(
                f"units: {key} is recorded in {there}, and the plant counts it in {here}; where "
                f"sizes say {here}, it stands for {there}."
            )
    return remarks


def repeat_periods(parts: Sequence[Record], audits: Sequence[Audit]) -> list[int]:
    """Return after how many samples each record repeats itself; empty if one does not."""
    if len(parts) != len(audits):
        return []
    periods = [a.repeats[0] for a in audits]
    whole = [p and len(part) // p for p, part in zip(periods, parts, strict=True)]
    return periods if min(whole) >= REPEATS else []
