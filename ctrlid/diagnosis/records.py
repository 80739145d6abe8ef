"""Step 1: records looked over, and what their readout shows by itself."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import control as ct
import numpy as np

from .._base.arguments import point_at_part
from .._base.errors import CtrlidError
from .._base.signals import require_one_signal
from .._base.statistics import rounding_variance
from .._base.text import write_list
from ..data.record import Record
from ..effects import AbstractEffect, InputDelay, InputOffset, Quantization, SensorSaturation
from ..estimation.identified_model import read_delay
from ..estimation.likelihood.likelihood import Fit
from ..loop.loop import Loop, find_converter_steps
from ..loop.unit_check import list_recorded_units
from ..physics.conversions import to_transfer_function
from ..physics.linearization import OperatingPoint
from ..validation.record_audit import Audit, AuditFinding, audit
from .thresholds import THRESHOLD

HOPELESS = ("too few samples", "constant signal", "operating point", "sampled", "wrapped")


def make_loop(loop: Any, record: Record) -> Loop:
    """Return the loop; a transfer function becomes one around the means of the record."""
    if isinstance(loop, Loop):
        return loop
    require_one_signal("diagnose", record)
    if not isinstance(loop, ct.TransferFunction):
        raise CtrlidError(
            "diagnose needs a Loop(plant, controller, dt=..., at=..., free=...) or a transfer "
            f"function such as the fits return; given {type(loop).__name__}"
            f"{point_at_part(loop, Loop)}"
        )
    valid = record.valid
    u, y = float(np.mean(record.u[valid])), float(np.mean(record.y[valid]))
    linear = Loop(to_transfer_function(loop), None, dt=record.dt, at=OperatingPoint((), u, y))
    delay = read_delay(loop)
    # The means of the record only estimate the input at rest, so that its offset stays free.
    linear = linear.with_effect(InputOffset(0.0))
    linear = replace(linear, free=tuple(linear.parameters))
    return linear.with_effect(InputDelay(delay)) if delay else linear


def with_units_of(loop: Loop, record: Record) -> Loop:
    """Return the loop with the units of a record, in which the sizes of effects will be written."""
    given = list_recorded_units(loop, record)
    own = {name: unit for key, name, unit in given if unit and key != "r"}
    return replace(loop, units={**loop.units, **own}) if own else loop


def look_over_records(
    loop: Loop, records: Sequence[Record]
) -> tuple[tuple[Audit, ...], tuple[str, ...]]:
    """Return what is remarkable about the records; refuse those that carry nothing."""
    audits, remarks = [], _list_silent_units(loop, records[0])
    for k, record in enumerate(records):
        found = audit(record, loop)
        audits.append(found)
        references = ("r", *record.signals.get("r", ())) if record.y.ndim == 1 else ()
        hopeless = [
            f.text
            for f in found.findings
            if f.kind in HOPELESS and f.channel not in references and not _is_still_input(f, record)
        ]
        if hopeless:
            raise CtrlidError(
                f"{record.name or 'the record'} cannot be diagnosed: {' '.join(hopeless)}"
            )
        which = f"record {k + 1}, " if len(records) > 1 else ""
        remarks += [f"{which}{f.kind}: {f.text}" for f in found.findings]
    return tuple(audits), tuple(remarks)


def _is_still_input(finding: AuditFinding, record: Record) -> bool:
    """Whether it is one of several inputs that stays constant, while another moves."""
    inputs = record.signals["u"]
    moves = np.ptp(np.reshape(record.u, (len(inputs), -1)), axis=1) > 0
    return len(inputs) > 1 and finding.channel in inputs and bool(moves.any())


def _list_silent_units(loop: Loop, record: Record) -> list[str]:
    """Say where a record has no units and the plant has; those that clash are in the audit."""
    of_plant, several = loop.known_units, not loop.equations().siso
    silent = [
        f"{name if several else key} in {of_plant[name]}"
        for key, name, there in list_recorded_units(loop, record)
        if key != "r" and not there and of_plant.get(name)
    ]
    if not silent:
        return []
    return [
        "units: the record does not say its units, so that those of the plant are written, "
        f"{write_list(silent)}. Record has units= to state them."
    ]


def find_repeat_periods(parts: Sequence[Record], audits: Sequence[Audit]) -> list[int]:
    """Return after how many samples each record repeats itself; empty if one does not."""
    if len(parts) != len(audits) or parts[0].y.ndim == 2:
        return []
    periods = [a.repeats[0] for a in audits]
    whole = [p and len(part) // p for p, part in zip(periods, parts, strict=True)]
    return periods if min(whole) >= THRESHOLD.repeats else []


@dataclass(frozen=True)
class Readout:
    """An effect of the readout with the evidence for it and the uncertainty of its parameters."""

    effect: AbstractEffect
    evidence: float
    errors: dict[str, float]


@dataclass(frozen=True, eq=False)
class ReadLimits:
    """Loop and records after the limits of the sensor were read off, and what was found so.

    `limits` are those of the sensor, known before or read off; None where it has none.
    """

    loop: Loop
    records: tuple[Record, ...]
    limits: SensorSaturation | None
    found: tuple[Readout, ...]


def read_limits(
    loop: Loop, records: Sequence[Record], audits: Sequence[Audit],
    catalogue: Sequence[type[AbstractEffect]],
) -> ReadLimits:  # fmt: skip
    """Return the loop with the sensor's limits and the records without samples that sit on them.

    Limits that the loop has are no finding, unless readings stop inside of them.
    """
    # Samples on a limit are left out of one output alone; of several the audit tells of them.
    if not loop.equations().siso:
        return ReadLimits(loop, tuple(records), None, ())
    own = [e for e in loop.effects if isinstance(e, SensorSaturation)]
    known = SensorSaturation(max((e.lower for e in own), default=-math.inf),
                             min((e.upper for e in own), default=math.inf))  # fmt: skip
    found = read_clipping(records, audits, catalogue, known)
    if found is not None:
        loop, inside = loop.with_effect(found.effect), found.effect.values()
        known = SensorSaturation(max(known.lower, inside["lower"]),
                                 min(known.upper, inside["upper"]))  # fmt: skip
    if known.neutral:
        return ReadLimits(loop, tuple(records), None, ())
    used = tuple(censor_record(record, known) for record in records)
    return ReadLimits(loop, used, known, () if found is None else (found,))


def read_clipping(
    records: Sequence[Record], audits: Sequence[Audit],
    catalogue: Sequence[type[AbstractEffect]], known: SensorSaturation,
) -> Readout | None:  # fmt: skip
    r"""Return the limits of the sensor if samples sit on them, inside of those that are known.

    A sensor without limits is above a value as often as below it, so that n samples exactly on
    the largest value, and none beyond, have a chance of :math:`2^{-n}`.
    """
    if SensorSaturation not in catalogue:
        return None
    low = high = 0.0
    lower, upper = -math.inf, math.inf
    for record, found in zip(records, audits, strict=True):
        if "y" not in found.saturated:
            continue
        size = int(np.count_nonzero(record.valid))
        slack = THRESHOLD.rounding * float(np.ptp(record.y))
        share_low, share_high, at_low, at_high = found.saturated["y"]
        if share_low > THRESHOLD.clipped and at_low > known.lower + slack:
            low, lower = low + share_low * size, max(lower, at_low)
        if share_high > THRESHOLD.clipped and at_high < known.upper - slack:
            high, upper = high + share_high * size, min(upper, at_high)
    if not low + high:
        return None
    effect = SensorSaturation(lower, upper)
    return Readout(effect, (low + high) * math.log(2), {
        k: 0.0 for k, v in effect.values().items() if math.isfinite(v)})  # fmt: skip


def censor_record(record: Record, effect: SensorSaturation) -> Record:
    """Return a record in which samples on a limit of the sensor do not count."""
    slack = THRESHOLD.rounding * float(np.ptp(record.y))
    y = np.asarray(record.y)
    # What lies beyond a limit is not on it: the limit is not that of this sensor.
    at = (np.abs(y - effect.lower) <= slack) | (np.abs(y - effect.upper) <= slack)
    return replace(record, valid=np.asarray(record.valid) & ~at)


def read_steps(fit: Fit, audits: Sequence[Audit]) -> tuple[Readout, ...]:
    r"""Return the step of each sensor if it makes a good part of its noise.

    Rounding to steps q adds a variance of :math:`q^2/12`; knowing it, the likelihood gains
    :math:`\tfrac{n}{2} \ln r / (r - q^2/12)`. They belong to the record, and are no
    candidate of the catalogue.
    """
    e = fit.plant.e
    found = []
    for k, name in enumerate(e.outputs):
        # The audit calls the signals of a plant with one of each u and y.
        key, at = ("y", "") if e.siso else (name, name)
        step = max((float(a.quantum.get(key, 0.0)) for a in audits), default=0.0)
        noise = fit.sensor_noises[k]
        share = float(rounding_variance(step)) / noise if noise > 0 else 0.0
        if share < THRESHOLD.coarse_steps:
            continue
        size = fit.size if e.siso else sum(int(keep[:, k].sum()) for keep in fit.counts)
        gain = -0.5 * size * math.log(max(1 - share, THRESHOLD.noise_beside_steps))
        found.append(Readout(Quantization(step, at=at), gain, {"step": 0.0}))
    return tuple(found)


def add_steps(loop: Loop, steps: Sequence[Readout]) -> Loop:
    """Return the loop with the steps of the converters that it does not have yet.

    Then of equal readings in a row one counts, and what is simulated has the steps as well.
    """
    known = dict(zip(loop.signals["y"], find_converter_steps(loop), strict=True))
    first = loop.signals["y"][0]
    for one in steps:
        if not known[one.effect.at or first]:
            loop = loop.with_effect(one.effect)
    return loop
