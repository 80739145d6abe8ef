"""Between the plant and the record: lags, scale, curves, offsets, drift, lines and steps."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self, final

import numpy as np

from .._base.errors import EffectDoesNotApply
from ..physics.equations import Equations
from ..physics.linearization import OperatingPoint, compute_state_matrices
from ..physics.symbols import Symbol
from .context import Moment
from .input import find_range
from .kinds import OutputEffect, ReadingEffect
from .parameters import parameter
from .scanning import (
    Overview,
    Range,
    Scan,
    Sight,
    choose_middle_frequency,
    scan_line,
)

# At a spread so many times the output every kink is smooth.
SHIFTED_FAR = 1e6
# A drift that settles is looked for from this share of the record on, between so many samples, for
# faster ones are the start of the record, and so many records, where it is steady.
WARM = 0.3
SOON = 10
LATE = 3


@final
@dataclass(frozen=True)
class SensorLag(OutputEffect):
    r"""The reading follows the output as a first-order lag.

    .. math:: \tau \dot y_s = y - y_s

    A sensor of finite bandwidth, an anti-alias filter.

    Parameters
    ----------
    tau : float
        Time constant [s].

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.SensorLag(tau=0.001))
    SensorLag: tau = 0.001 s
    """

    tau: float = parameter("s", lower=0.0, neutral=0.0)

    states: ClassVar[tuple[str, ...]] = ("reading",)
    look_alikes: ClassVar[tuple[str, ...]] = ("InputDelay", "ActuatorLag")
    sentence: ClassVar[str] = "The sensor follows the output with a first-order lag."
    experiment: ClassVar[str] = (
        "fast excitation: at high frequencies the phase of a lag levels off, while that of a delay "
        "continues to fall"
    )
    experiment_against: ClassVar[Mapping[str, str]] = {
        "ActuatorLag": "large steps of the input: a lag of the actuator acts before the "
        "nonlinearities of the plant, a lag of the sensor after them"
    }

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return a lag of one sampling period: at zero there is no derivative to go by."""
        del record
        return cls._applicable(loop, cls(tau=loop.dt))

    def rates(self, m: Moment) -> tuple[Any, ...]:
        """Return the lag."""
        return (m.follow(m.y, self.tau),)

    def rest(self, at: OperatingPoint) -> tuple[float, ...]:
        """Return the output at rest."""
        return (at.output,)

    def output(self, m: Moment) -> Any:
        """Return the lagging reading."""
        return m.own["reading"]


@final
@dataclass(frozen=True)
class SensorNonlinearity(OutputEffect):
    r"""The sensor's gain changes over its range.

    .. math:: y_s = y + \gamma (y - y_0)^2

    Parameters
    ----------
    curvature : float
        The curvature gamma [1/output unit].

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.SensorNonlinearity(curvature=2.0))
    SensorNonlinearity: curvature = 2 1/[y]
    """

    curvature: float = parameter("1/{y}", neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = ("ForceExponent", "CubicStiffness", "PositionRipple")
    sentence: ClassVar[str] = "The gain of the sensor depends on the position."
    experiment: ClassVar[str] = "reference measurements at positions over the whole range"

    def output(self, m: Moment) -> Any:
        """Return the bent reading."""
        d = m.y - m.at.output
        return m.y + self.curvature * d * d


@final
@dataclass(frozen=True)
class SensorOffset(OutputEffect):
    r"""The sensor adds a constant.

    .. math:: y_s = y + y_{off}

    Parameters
    ----------
    offset : float
        The constant [output unit].

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.effects.SensorOffset(offset=1e-4).place
    'output'
    """

    offset: float = parameter("{y}", neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = ("PositionOffset", "InputOffset", "ConstantForce")
    sentence: ClassVar[str] = "The sensor has an offset."
    experiment: ClassVar[str] = (
        "a reference measurement at a known position; no record of u and y alone decides"
    )

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return no offset, where the plant moves otherwise when its output is shifted.

        Elsewhere the offset is the initial position, of which nobody knows where it is counted
        from.
        """
        del record
        a, _, c, _ = compute_state_matrices(loop.equations(), loop.point, spread=SHIFTED_FAR)
        # Of a plant with several outputs a diagnosis asks for one by its number.
        seen = np.flatnonzero(c[getattr(loop, "output", 0)])
        matters = np.any(np.abs(a[:, seen]).sum(axis=0) > 0)
        return cls._applicable(loop, cls(0.0)) if matters else ()

    def output(self, m: Moment) -> Any:
        """Return the shifted reading."""
        return m.y + self.offset


@final
@dataclass(frozen=True)
class SensorGain(OutputEffect):
    r"""The sensor's scale is off: it reads a fixed share too much, from its zero on.

    .. math:: y_s = (1 + \epsilon) y

    Parameters
    ----------
    error : float
        The relative error epsilon of the scale.

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.SensorGain(error=0.03))
    SensorGain: error = 0.03
    """

    error: float = parameter("", neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = (
        "ConstantForce", "SensorNonlinearity", "ForceExponent", "InputOffset",
    )  # fmt: skip
    sentence: ClassVar[str] = "The scale of the sensor is off."
    experiment: ClassVar[str] = "reference measurements at two known positions"

    def output(self, m: Moment) -> Any:
        """Return the reading on the wrong scale."""
        return (1 + self.error) * m.y


@final
@dataclass(frozen=True)
class SensorDrift(OutputEffect):
    r"""The zero of the sensor drifts, steadily or ever more slowly.

    .. math:: y_s = y + \rho t \quad\text{or}\quad y_s = y + \rho T (1 - e^{-t/T})

    A sensor that warms up drifts by rho T in all, most of it in the first T seconds. The time t
    counts from the start of the record.

    Parameters
    ----------
    rate : float
        The drift rho at the start of the record [output unit/s].
    settling : float, optional
        Time constant T with which the drift comes to its end [s]; by default zero, which is a
        steady drift without end.

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.SensorDrift(rate=1e-6))
    SensorDrift: rate = 1e-06 [y]/s
    >>> print(cid.effects.SensorDrift(rate=1e-6, settling=20.0))
    SensorDrift: rate = 1e-06 [y]/s, settling = 20 s
    """

    rate: float = parameter("{y}/s", neutral=0.0)
    settling: float = parameter("s", lower=0.0, optional=True)

    look_alikes: ClassVar[tuple[str, ...]] = ("ParameterDrift", "ConstantForce", "InputOffset")
    sentence: ClassVar[str] = "The zero of the sensor drifts."
    experiment: ClassVar[str] = (
        "a reference measurement at one known position, at the beginning and at the end"
    )

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return no drift, which would be steady, and one that would end within the record."""
        warm = () if record is None else (cls(rate=0.0, settling=WARM * record.duration),)
        return cls._applicable(loop, cls(rate=0.0), *warm)

    def limits(self, seen: Range) -> dict[str, tuple[float, float]]:
        """Return how late a drift ends: after some samples, and before it looks steady."""
        return {"settling": (SOON * seen.dt, LATE * seen.duration)}

    def output(self, m: Moment) -> Any:
        """Return the drifting reading."""
        if not isinstance(self.settling, Symbol) and self.settling == 0:
            return m.y + self.rate * m.t
        return m.y + self.rate * self.settling * (1 - np.exp(-m.t / self.settling))


@final
@dataclass(frozen=True)
class SensorHum(OutputEffect):
    r"""A line at a fixed frequency in the reading.

    .. math:: y_s = y + A \sin(2 \pi f t + \varphi)

    Mains hum in a cable or an amplifier.

    Parameters
    ----------
    amplitude : float
        The amplitude A [output unit].
    frequency : float
        Frequency f [Hz].
    phase : float, optional
        Phase at time zero [rad], private to a record.

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.SensorHum(amplitude=1e-5, frequency=50.0))
    SensorHum: amplitude = 1e-05 [y], frequency = 50 Hz, phase = 0 rad
    """

    amplitude: float = parameter("{y}", lower=0.0, neutral=0.0)
    frequency: float = parameter("Hz", lower=1e-9, searched=True)
    phase: float = parameter("rad", default=0.0)

    private: ClassVar[tuple[str, ...]] = ("phase",)
    in_linear_model: ClassVar[bool] = False
    repeatable: ClassVar[bool] = True
    look_alikes: ClassVar[tuple[str, ...]] = ("PeriodicForce", "PositionRipple")
    sentence: ClassVar[str] = "A line at a fixed frequency, such as mains hum, is in the reading."
    experiment: ClassVar[str] = (
        "a record with the actuator off and the plant held still: a line that remains is the "
        "sensor's"
    )

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return a line of no amplitude; its frequency is to be scanned."""
        return cls._applicable(loop, cls(0.0, choose_middle_frequency(loop, record)))

    def limits(self, seen: Range) -> dict[str, tuple[float, float]]:
        """Keep the frequency between one period in the record and half the sampling rate.

        The reading is sampled as it is, while the mass that a force moves averages over a period.
        """
        return {"frequency": (1.0 / seen.duration, 0.5 / seen.dt)}

    def disguise(self, e: Equations) -> str | None:
        """Say that a plant without a moving mass may be disturbed at the frequency."""
        if e.velocities:
            return None
        return (
            "a disturbance of the plant itself at this frequency, such as a roll that runs out of "
            "true, reads alike, and has no name in the catalogue where no mass moves"
        )

    def scan(self, sight: Sight) -> Scan:
        """Look at the strongest line of the prediction errors."""
        return scan_line(self, sight, "output")

    def spread_starts(self, sight: Overview) -> tuple[Self, ...]:
        """Return the strongest line in two phases."""
        line = sight.strongest_line()
        return tuple(replace(self, frequency=line, phase=p) for p in (0.0, np.pi / 2))

    def output(self, m: Moment) -> Any:
        """Return the reading with the line in it."""
        return m.y + self.amplitude * np.sin(2 * np.pi * self.frequency * m.t + self.phase)


@final
@dataclass(frozen=True)
class SensorSaturation(ReadingEffect):
    r"""The reading is clipped, its noise included.

    .. math:: y_s = \min(\max(y, y_{min}), y_{max})

    Parameters
    ----------
    lower, upper : float
        Limits of the reading [output unit]; infinite for none.

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.effects.SensorSaturation(lower=0.0, upper=0.016).neutral
    False
    """

    lower: float = parameter("{y}", neutral=-math.inf)
    upper: float = parameter("{y}", neutral=math.inf)

    look_alikes: ClassVar[tuple[str, ...]] = ("StateLimit", "InputSaturation")
    sentence: ClassVar[str] = "The sensor shows nothing beyond its range."
    experiment: ClassVar[str] = (
        "motion beyond the range and back: u continues to change while y does not"
    )

    def check(self) -> None:
        """Refuse limits in the wrong order."""
        if not self.lower < self.upper:
            raise EffectDoesNotApply(
                f"SensorSaturation needs lower < upper; given lower={self.lower:g}, "
                f"upper={self.upper:g}"
            )

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return limits just inside the range of the recorded output."""
        low, high = find_range(None if record is None else record.y, loop.point.output)
        return cls._applicable(loop, cls(low, high)) if low < high else ()

    def read(self, m: Moment) -> Any:
        """Return the clipped reading."""
        return np.minimum(np.maximum(m.y, self.lower), self.upper)


@final
@dataclass(frozen=True)
class Quantization(ReadingEffect):
    r"""The reading has steps, its noise included.

    .. math:: y_s = q \, \mathrm{round}(y / q)

    Equal readings in a row err alike, so that together they count as one in fits and predictions.

    Parameters
    ----------
    step : float
        The step q [output unit].

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.Quantization(step=1e-5))
    Quantization: step = 1e-05 [y]
    """

    step: float = parameter("{y}", lower=0.0, neutral=0.0)

    in_linear_model: ClassVar[bool] = False
    look_alikes: ClassVar[tuple[str, ...]] = ("CoulombFriction", "InputDeadZone")
    sentence: ClassVar[str] = "The reading is quantized."
    experiment: ClassVar[str] = "the distinct values of a slow ramp"

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return the smallest step between recorded outputs, if they have few distinct values."""
        step = 1e-3 * max(abs(loop.point.output), 1.0)
        if record is not None:
            gaps = np.diff(np.unique(record.y))
            seen = gaps[gaps > 1e-9 * max(float(np.ptp(record.y)), np.finfo(float).tiny)]
            few = seen.size and len(seen) < 0.5 * len(record)
            step = float(seen.min()) if few else 0.1 * float(np.std(record.y))
        return cls._applicable(loop, cls(step)) if step > 0 else ()

    def read(self, m: Moment) -> Any:
        """Return the rounded reading."""
        steps = np.round(m.y / np.maximum(self.step, 1e-300))
        return np.where(self.step > 0, self.step * steps, m.y)
