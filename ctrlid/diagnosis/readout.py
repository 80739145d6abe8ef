"""Effects of the sensor's readout, which the record shows by itself: limits and steps."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..data.record import Record
from ..effects import AbstractEffect, Quantization, SensorSaturation
from ..estimation.likelihood.likelihood import Fit
from ..validation.record_audit import Audit

CLIPPED = 0.005  # share of the samples at a limit that is worth a name
COARSE = 0.25  # share of the sensor noise's variance that comes from the steps


@dataclass(frozen=True)
class Readout:
    """An effect of the readout with the evidence for it and the uncertainty of its parameters."""

    effect: AbstractEffect
    evidence: float
    errors: dict[str, float]


def clipping(
    records: Sequence[Record], audits: Sequence[Audit], catalogue: Sequence[type[AbstractEffect]]
) -> Readout | None:
    r"""Return the limits of the sensor if samples sit on them.

    A sensor without limits is above a value as often as below it, so that n samples exactly on
    the largest value, and none beyond, have a chance of :math:`2^{-n}`.
    """
    if SensorSaturation not in catalogue:
        return None
    low = high = 0.0
    lower, upper = -math.inf, math.inf
    for record, audit in zip(records, audits, strict=True):
        if "y" not in audit.saturated:
            continue
        size = int(np.count_nonzero(record.valid))
        share_low, share_high, at_low, at_high = audit.saturated["y"]
        if share_low > CLIPPED:
            low, lower = low + share_low * size, max(lower, at_low)
        if share_high > CLIPPED:
            high, upper = high + share_high * size, min(upper, at_high)
    if not low + high:
        return None
    effect = SensorSaturation(lower, upper)
    return Readout(effect, (low + high) * math.log(2), {
        k: 0.0 for k, v in effect.values().items() if math.isfinite(v)})  # fmt: skip


def censored(record: Record, effect: AbstractEffect) -> Record:
    """Return a record in which samples on a limit of the sensor do not count."""
    assert isinstance(effect, SensorSaturation)
    slack = 1e-9 * float(np.ptp(record.y))
    y = np.asarray(record.y)
    free = (y > effect.lower + slack) & (y < effect.upper - slack)
    return replace(record, valid=np.asarray(record.valid) & free)


def steps(
    fit: Fit, audits: Sequence[Audit], catalogue: Sequence[type[AbstractEffect]]
) -> Readout | None:
    r"""Return the step of the sensor if it makes a good part of its noise.

    Rounding to steps q adds a variance of :math:`q^2/12`; knowing it, the likelihood gains
    :math:`\tfrac{n}{2} \ln r / (r - q^2/12)`.
    """
    step = max((float(a.quantum.get("y", 0.0)) for a in audits), default=0.0)
    noise = float(np.mean(fit.sensor))
    share = step**2 / 12 / noise if noise > 0 else 0.0
    if Quantization not in catalogue or share < COARSE:
        return None
    gain = -0.5 * fit.size * math.log(max(1 - share, 1e-3))
    return Readout(Quantization(step), gain, {"step": 0.0})
