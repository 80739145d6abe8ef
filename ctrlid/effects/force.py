"""Forces that depend on place or time, as accelerations of the moving mass."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self, final

import numpy as np

from .._base.arrays import Array
from .context import Moment
from .kinds import ForceEffect
from .parameters import parameter
from .scanning import (
    Overview,
    Range,
    Scan,
    Sight,
    choose_middle_frequency,
    compute_amplitude_and_phase,
    find_visible_frequencies,
    make_waves,
    scan_line,
)

# What the travel shows fewer times than this does not repeat.
FEWEST_WAVES = 2
# Wavelengths shorter than the travel over this number are not scanned, to save time.
LENGTHS = 150
# A wave is scanned if the motion is slow enough for it at this share of the samples.
SLOW_SHARE = 0.25
# A wave that gains this share of the largest gain may be the right one.
NEARLY = 0.7
# At most so many waves are refitted, to save time.
PEAKS = 4
# Records of the same model from which the information on the size of a wave is guessed.
DRAWS = 32
# So many waves are summed together, which is faster than one by one.
TOGETHER = 8
# A flexible mode is scanned at so many frequencies, to save time.
MODES = 7
# A mode with fewer periods in the record is no vibration.
SLOWEST_MODE = 5.0
# A mode above this share of the sampling frequency does not show.
FASTEST_MODE = 0.35


def _find_peaks(gains: Array, nearly: float, most: int) -> list[int]:
    """Return the highest peaks: those that are nearly as high as the best, at most so many."""
    padded = np.concatenate([[-np.inf], gains, [-np.inf]])
    tops = np.flatnonzero((gains >= padded[:-2]) & (gains > padded[2:]))
    tops = tops[gains[tops] > nearly * gains.max()]
    return [int(k) for k in tops[np.argsort(-gains[tops])][:most]] or [int(np.argmax(gains))]


def _guess_gains(sight: Sight, positions: Sequence[Array], numbers: Array) -> Array:
    r"""Return about what forces :math:`e^{2 \pi i \kappa x}` gain, for evenly spaced wave numbers.

    .. math:: \tfrac12 g^T H^{-1} g, \quad g = \sum_k f_k \lambda_k

    with the variance H of g over records of the same model, which a few draws tell roughly.
    """
    scores = sight.force_scores(DRAWS)
    step = numbers[1] - numbers[0] if len(numbers) > 1 else 0.0
    waves = [np.exp(2j * np.pi * np.outer(numbers[:TOGETHER], x)) for x in positions]
    turns = [np.exp(2j * np.pi * TOGETHER * step * x) for x in positions]
    found: list[float] = []
    while len(found) < len(numbers):
        pairs = zip(waves, scores, strict=True)
        sums = np.sum([(w.real @ s, w.imag @ s) for w, s in pairs], axis=0)
        for k in range(sums.shape[1]):
            own, drawn = sums[:, k, 0], sums[:, k, 1:]
            inverse = np.linalg.pinv(drawn @ drawn.T / DRAWS, hermitian=True)
            found.append(0.5 * float(own @ inverse @ own))
        for wave, turn in zip(waves, turns, strict=True):
            wave *= turn
    return np.array(found[: len(numbers)])


def _find_quantization_step(y: Array) -> float:
    """Return the step of a coarsely quantised sensor, whose rounding repeats along the way."""
    values = np.unique(y)
    return float(np.min(np.diff(values))) if 1 < len(values) < len(y) / 8 else 0.0


@final
@dataclass(frozen=True)
class LinearStiffness(ForceEffect):
    r"""A spring, relaxed at the operating point.

    .. math:: a = -k_1 (x - x_0)

    Parameters
    ----------
    k1 : float
        Stiffness over mass [1/s^2]; negative for a force that pushes away.

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.LinearStiffness(k1=20.0))
    LinearStiffness: k1 = 20 1/s^2
    """

    k1: float = parameter("1/s^2", neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = ("ForceExponent", "PositionOffset", "CubicStiffness")
    sentence: ClassVar[str] = (
        "A force in proportion to the deflection, as of a spring, a cable or a guide."
    )
    experiment: ClassVar[str] = (
        "several operating points over the whole stroke: a spring has the same stiffness at each"
    )

    def force(self, m: Moment) -> Any:
        """Return the acceleration."""
        return -self.k1 * m.deviation


@final
@dataclass(frozen=True)
class CubicStiffness(ForceEffect):
    r"""A spring that stiffens with its deflection.

    .. math:: a = -k_3 (x - x_0)^3

    Parameters
    ----------
    k3 : float
        Cubic stiffness over mass [1/(s^2 output unit^2)].

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.effects.CubicStiffness(k3=1e4).units()
    {'k3': '1/(s^2 [y]^2)'}
    """

    k3: float = parameter("1/(s^2 {y}^2)", neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = (
        "LinearStiffness", "ForceExponent", "SensorNonlinearity",
    )  # fmt: skip
    sentence: ClassVar[str] = "A spring that gets stiffer the further it is bent."
    experiment: ClassVar[str] = "small and large deflections to both sides of the operating point"

    def force(self, m: Moment) -> Any:
        """Return the acceleration."""
        return -self.k3 * m.deviation**3


@final
@dataclass(frozen=True)
class ConstantForce(ForceEffect):
    r"""A force that is always there.

    .. math:: a = b

    A tilted table, a cable's pull, a wrong weight.

    Parameters
    ----------
    bias : float
        Force over mass [output unit/s^2], positive towards larger outputs.

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.ConstantForce(bias=-0.03))
    ConstantForce: bias = -0.03 [y]/s^2
    """

    bias: float = parameter("{y}/s^2", neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = (
        "InputOffset", "InputSaturatingGain", "AsymmetricCoulombFriction", "PositionOffset",
        "SensorGain", "SensorDrift",
    )  # fmt: skip
    sentence: ClassVar[str] = "A constant force acts in addition to those of the model."
    experiment: ClassVar[str] = (
        "several operating points with different inputs: a constant force is the same at each, "
        "while the force of an input offset changes with the gain of the plant"
    )
    constant_force: ClassVar[str] = "bias"

    def force(self, m: Moment) -> Any:
        """Return the acceleration."""
        return self.bias


@final
@dataclass(frozen=True)
class PeriodicForce(ForceEffect):
    r"""A vibration at a fixed frequency.

    .. math:: a = A \sin(2 \pi f t + \varphi)

    Mains hum, an unbalanced fan.

    Parameters
    ----------
    amplitude : float
        Force over mass A [output unit/s^2].
    frequency : float
        Frequency f [Hz].
    phase : float, optional
        Phase at time zero [rad], private to a record.

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.effects.PeriodicForce(amplitude=0.0, frequency=50.0).neutral
    True
    """

    amplitude: float = parameter("{y}/s^2", lower=0.0, neutral=0.0)
    frequency: float = parameter("Hz", lower=1e-9, searched=True)
    phase: float = parameter("rad", default=0.0)

    private: ClassVar[tuple[str, ...]] = ("phase",)
    in_linear_model: ClassVar[bool] = False
    repeatable: ClassVar[bool] = True
    look_alikes: ClassVar[tuple[str, ...]] = ("PositionRipple", "FlexibleMode", "SensorHum")
    sentence: ClassVar[str] = "A vibration at a fixed frequency acts on the plant."
    experiment: ClassVar[str] = (
        "a record at rest, and motion at two speeds: the frequency of a vibration is always the "
        "same, while that of a ripple is proportional to the speed"
    )

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return a vibration of no amplitude; its frequency is to be scanned."""
        return cls._applicable(loop, cls(0.0, choose_middle_frequency(loop, record)))

    def limits(self, seen: Range) -> dict[str, tuple[float, float]]:
        """Keep the frequency where samples show it."""
        return {"frequency": find_visible_frequencies(seen)}

    def scan(self, sight: Sight) -> Scan:
        """Look at the strongest line of the prediction errors."""
        return scan_line(self, sight)

    def spread_starts(self, sight: Overview) -> tuple[Self, ...]:
        """Return the strongest line in two phases."""
        line = sight.strongest_line()
        return tuple(replace(self, frequency=line, phase=p) for p in (0.0, np.pi / 2))

    def force(self, m: Moment) -> Any:
        """Return the acceleration."""
        return self.amplitude * np.sin(2 * np.pi * self.frequency * m.t + self.phase)


@final
@dataclass(frozen=True)
class PositionRipple(ForceEffect):
    r"""A force that repeats along the way.

    .. math:: a = A \sin(2 \pi x / p + \varphi)

    The pitch of a screw, the poles of a motor, the teeth of a gear.

    Parameters
    ----------
    amplitude : float
        Force over mass A [output unit/s^2].
    period : float
        Length p after which it repeats [output unit].
    phase : float, optional
        Phase at position zero [rad], private to a record: where zero is, differs.

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.PositionRipple(amplitude=0.05, period=0.0025))
    PositionRipple: amplitude = 0.05 [y]/s^2, period = 0.0025 [y], phase = 0 rad
    """

    amplitude: float = parameter("{y}/s^2", lower=0.0, neutral=0.0)
    period: float = parameter("{y}", lower=1e-12, searched=True)
    phase: float = parameter("rad", default=0.0)

    private: ClassVar[tuple[str, ...]] = ("phase",)
    repeatable: ClassVar[bool] = True
    doubt_of_several: ClassVar[str | None] = (
        "several ripples together can describe any function of the position"
    )
    look_alikes: ClassVar[tuple[str, ...]] = ("PeriodicForce", "SensorNonlinearity")
    sentence: ClassVar[str] = "A force that repeats with the position, as of a screw or a gear."
    experiment: ClassVar[str] = (
        "the same motion at two speeds: the period of the ripple in position does not change"
    )

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return a ripple of no amplitude; its period is to be scanned."""
        travel = 0.0 if record is None else float(np.ptp(record.y))
        return cls._applicable(loop, cls(0.0, travel / 10 if travel > 0 else 0.1))

    def limits(self, seen: Range) -> dict[str, tuple[float, float]]:
        """Keep two periods within the travel: what is seen once does not repeat."""
        return {"period": (-math.inf, seen.travel / FEWEST_WAVES)}

    def scan(self, sight: Sight) -> Scan:
        """Look at all wavelengths that the travel can show, and then finely at the best of them.

        What a wave gains is guessed for all of them, and computed for those that may be the best.
        """
        positions, travel = sight.positions(), sight.travel
        step = max(float(np.quantile(np.abs(np.diff(w)), SLOW_SHARE)) for w in positions)
        grain = max(_find_quantization_step(y) for y in sight.outputs)
        shortest = max(travel / LENGTHS, 4 * step, 4 * grain)
        if not travel > 2 * FEWEST_WAVES * shortest:
            return Scan((), remark="the motion is too small to show a ripple")
        finest = 0.25 / travel
        places = max((1.0 / shortest - FEWEST_WAVES / travel) * travel, 1)

        # A peak is about one over the travel wide: only those that may be the highest are seen
        # finely.
        numbers = np.arange(FEWEST_WAVES / travel, 1.0 / shortest, finest)
        likely = _find_peaks(_guess_gains(sight, positions, numbers[::2]), 0.0, 4 * PEAKS)
        near = np.unique(np.add.outer(2 * np.array(likely), (-1, 0, 1)))
        near = near[(near >= 0) & (near < len(numbers))]
        gains, sizes = np.zeros(len(numbers)), np.zeros((len(numbers), 2))
        for k in range(0, len(near), sight.block):
            part = near[k : k + sight.block]
            angles = [2 * np.pi * np.outer(w, numbers[part]) for w in positions]
            waves = [make_waves(a) for a in angles]
            gains[part], sizes[part] = sight.score_shapes(waves, width=2)

        def at(k: int) -> PositionRipple:
            amplitude, phase = compute_amplitude_and_phase(sizes[k])
            return replace(self, amplitude=amplitude, period=float(1 / numbers[k]), phase=phase)

        best, *others = map(at, _find_peaks(gains, NEARLY, PEAKS))
        # Motion between a few levels sees several waves nearly alike: only fits tell them apart.
        return Scan(((best,),), places, tuple(others))

    def force(self, m: Moment) -> Any:
        """Return the acceleration."""
        return self.amplitude * np.sin(2 * np.pi * m.position / self.period + self.phase)


@final
@dataclass(frozen=True)
class FlexibleMode(ForceEffect):
    r"""A small mass on a spring, carried by the moving mass.

    .. math:: \ddot x = \frac{a + \mu\,w}{1 - \mu}, \quad \ddot q = -w - \ddot x, \quad
        w = \omega^2 q + 2 \zeta \omega \dot q, \quad \omega = 2 \pi f

    where a is the acceleration without it, of both masses together, and q the deflection. At one
    coordinate of a mechanism the change of :math:`\ddot x` accelerates the others as a force there
    does. The plant's response has a notch at f and a resonance at :math:`f/\sqrt{1 - \mu}`.

    Parameters
    ----------
    frequency : float
        Natural frequency f of the small mass while the large one is held [Hz].
    damping : float
        Its damping ratio zeta.
    coupling : float
        Its share mu of the moving mass.

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.effects.FlexibleMode(frequency=30.0, damping=0.02, coupling=0.1).states
    ('deflection', 'speed')
    """

    frequency: float = parameter("Hz", lower=1e-9, searched=True)
    damping: float = parameter("", lower=0.0)
    coupling: float = parameter("", lower=0.0, upper=0.95, neutral=0.0)

    stage: ClassVar[int] = 3
    states: ClassVar[tuple[str, ...]] = ("deflection", "speed")
    look_alikes: ClassVar[tuple[str, ...]] = ("PeriodicForce", "InputDelay", "ActuatorLag")
    sentence: ClassVar[str] = "Part of the moving mass is attached by a spring."
    experiment: ClassVar[str] = (
        "a sine sweep through the resonance, repeated: the resonance is at the same frequency again"
    )

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return a mode of no mass; its frequency is to be scanned."""
        return cls._applicable(loop, cls(choose_middle_frequency(loop, record), 0.05, 0.0))

    def limits(self, seen: Range) -> dict[str, tuple[float, float]]:
        """Keep the frequency where samples show it; what is damped more is no mode."""
        return {"frequency": find_visible_frequencies(seen), "damping": (0.0, 1.0)}

    def scan(self, sight: Sight) -> Scan:
        """Look at a few frequencies, and at the strongest line of the prediction errors."""
        duration, fastest = len(sight.times[0]) * sight.dt, FASTEST_MODE / sight.dt
        slowest = max(SLOWEST_MODE / duration, 1e-2 / sight.dt / 10)
        modes = [replace(self, frequency=float(f), damping=0.1, coupling=0.0)
                 for f in np.geomspace(slowest, fastest, MODES)]  # fmt: skip
        # A lightly damped mode is a line in the innovations, too narrow for any grid.
        line = min(max(sight.strongest_line(), 2.0 / duration), fastest)
        modes += [replace(self, frequency=line, damping=0.03, coupling=c) for c in (0.0, 0.05)]
        return Scan((tuple(modes),), places=MODES)

    def pull(self, m: Moment) -> Any:
        """Return the spring's force over the small mass."""
        omega = 2 * np.pi * self.frequency
        return omega * (omega * m.own["deflection"] + 2 * self.damping * m.own["speed"])

    def carry(self, m: Moment) -> Any:
        """Return the change of the acceleration of the large mass."""
        return self.coupling * (m.acceleration + self.pull(m)) / (1 - self.coupling)

    def force(self, m: Moment) -> Any:
        """Return what changes the acceleration so."""
        return m.find_force(self.carry(m))

    def rates(self, m: Moment) -> tuple[Any, ...]:
        """Return the rates of the deflection and of its speed."""
        carried = m.acceleration + self.carry(m)
        return m.own["speed"], -self.pull(m) - carried
