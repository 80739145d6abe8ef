"""Between the controller and the plant: limits, offsets and curves of the actuator.

The signal passes backlash, delay, then offset, dead zone and limits (the one added last comes
first), then lags, then the curves of the plant's own input.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self, final

import numpy as np

from .._base.arguments import is_number
from .._base.errors import CtrlidError, EffectDoesNotApply
from .context import Moment
from .kinds import InputEffect, choose_widths, scan_widths
from .parameters import parameter
from .scanning import CUT_OFF, Scan, Sight

# An input that was limited nearly always may have been limited to these shares of its range.
DEPTHS = (0.5, 0.25)
# Where the operating point's input is nearer to zero than this share of its range, a zone about the
# one is a zone about the other.
NEAR_ZERO = 0.01


def find_range(values: Any, around: float) -> tuple[float, float]:
    """Return a range a little inside that of a signal, or one around its value at rest."""
    if values is None:
        reach = max(abs(around), 1.0)
        return around - reach, around + reach
    low, high = float(np.min(values)), float(np.max(values))
    return low + 0.02 * (high - low), high - 0.02 * (high - low)


@final
@dataclass(frozen=True)
class InputSaturation(InputEffect):
    r"""The actuator has limits.

    .. math:: u_a = \min(\max(u, u_{min}), u_{max})

    Parameters
    ----------
    lower, upper : float
        Absolute limits [input unit]; infinite for none.

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.effects.InputSaturation(lower=0.0, upper=6.0).values()
    {'lower': 0.0, 'upper': 6.0}
    """

    lower: float = parameter("{u}", neutral=-math.inf)
    upper: float = parameter("{u}", neutral=math.inf)

    look_alikes: ClassVar[tuple[str, ...]] = ("InputSaturatingGain", "InputDeadZone")
    sentence: ClassVar[str] = "The actuator cannot go beyond its limits."
    experiment: ClassVar[str] = "larger steps: a limit acts only while the input is beyond it"

    def check(self) -> None:
        """Refuse limits in the wrong order."""
        if not self.lower < self.upper:
            raise EffectDoesNotApply(
                f"InputSaturation needs lower < upper; given lower={self.lower:g}, "
                f"upper={self.upper:g}"
            )

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return limits just inside the range of the recorded input."""
        low, high = find_range(None if record is None else record.u, loop.point.input)
        return cls._applicable(loop, cls(low, high)) if low < high else ()

    def scan(self, sight: Sight) -> Scan:
        """Look at limits on either side, over the range that the input has visited."""
        upper = [replace(self, upper=float(v)) for v in np.quantile(sight.inputs, CUT_OFF)]
        lower = [replace(self, lower=float(v))
                 for v in np.quantile(sight.inputs, 1 - np.array(CUT_OFF))]  # fmt: skip
        sides = tuple(tuple(e for e in side if e.lower < e.upper)
                      for side in ([self], upper, lower))  # fmt: skip
        return Scan(tuple(side for side in sides if side), places=sum(map(len, sides)))

    def other_starts(self, sight: Sight) -> tuple[Self, ...]:
        """Return limits well inside the range of the input.

        An input that is limited nearly always has made the model's parameters fit the limited one:
        no limit has a score then, and a fit from the edge of the range stays there.
        """
        u = sight.inputs
        middle, low, high = float(np.median(u)), float(np.min(u)), float(np.max(u))
        if not low < high:
            return ()
        if not low < middle < high:
            # The median of an input with two values is one of them.
            middle = 0.5 * (low + high)
        return tuple(
            type(self)(middle - d * (middle - low), middle + d * (high - middle)) for d in DEPTHS
        )

    def input(self, m: Moment) -> Any:
        """Return the limited input."""
        return np.minimum(np.maximum(m.u, self.lower), self.upper)


@final
@dataclass(frozen=True)
class InputDeadZone(InputEffect):
    r"""Small inputs, or small deviations of the input, do nothing.

    .. math:: u_a = u - \min(\max(u - u_0, -w/2), w/2)

    Crossover of an output stage, the overlap of a valve.

    Parameters
    ----------
    width : float
        Full width w of the zone [input unit].
    centre : float, optional
        Its middle u_0 [input unit]; by default the operating point's input. `diagnose` tries zero
        as well, where that of an amplifier or a motor is, if the input comes by.

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.effects.InputDeadZone(width=0.0).neutral
    True
    """

    width: float = parameter("{u}", lower=0.0, neutral=0.0)
    # A number; without one nothing is shown of it.
    centre: Any = ""

    in_linear_model: ClassVar[bool] = False
    look_alikes: ClassVar[tuple[str, ...]] = (
        "InputBacklash", "CoulombFriction", "InputSaturation",
    )  # fmt: skip
    sentence: ClassVar[str] = "Small deviations of the input from the middle of a zone do nothing."
    experiment: ClassVar[str] = (
        "small and large signals around the operating point: the gain is lower for small ones"
    )

    def check(self) -> None:
        """Refuse a middle that is no number."""
        if isinstance(self.centre, str) and not self.centre:
            return
        if not is_number(self.centre) or not math.isfinite(self.centre):
            raise CtrlidError(f"InputDeadZone needs a finite number for centre; given "
                              f"{self.centre!r}. Leave it out for the operating point's input"
                              )  # fmt: skip

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return zones of a tenth of the range of the recorded input and of all but a tenth.

        Such zones may also lie about zero.
        """
        zones = [cls(width=width) for width in choose_widths(loop, record)]
        if _passes_zero_elsewhere(loop, record):
            zones += [replace(zone, centre=0.0) for zone in zones]
        return cls._applicable(loop, *zones)

    def scan(self, sight: Sight) -> Scan | None:
        """Look at a few widths."""
        return scan_widths(self, sight)

    @classmethod
    def is_scanned(cls) -> bool:
        """Say no: a few widths hardly take longer than one."""
        return False

    def input(self, m: Moment) -> Any:
        """Return the input without what the zone swallows."""
        half, middle = self.width / 2, m.at.input if self.centre == "" else self.centre
        return m.u - np.minimum(np.maximum(m.u - middle, -half), half)


def _passes_zero_elsewhere(loop: Any, record: Any) -> bool:
    """Whether a recorded input passes zero, and its operating point is visibly elsewhere."""
    if record is None or not loop.equations().siso:
        return False
    u = record.u[record.valid]
    visible = NEAR_ZERO * float(np.ptp(u)) if u.size else 0.0
    return bool(u.size and u.min() < 0 < u.max() and abs(loop.point.input) > visible)


@final
@dataclass(frozen=True)
class InputOffset(InputEffect):
    r"""The actuator adds a constant.

    .. math:: u_a = u + u_{off}

    Parameters
    ----------
    offset : float
        The constant [input unit].

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.InputOffset(offset=0.05))
    InputOffset: offset = 0.05 [u]
    """

    offset: float = parameter("{u}", neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = (
        "ConstantForce", "InputSaturatingGain", "InputNonlinearity", "PositionOffset",
    )  # fmt: skip
    sentence: ClassVar[str] = "A constant offset is added to the input."
    experiment: ClassVar[str] = "several operating points: the offset is the same at each"

    def input(self, m: Moment) -> Any:
        """Return the input with the constant added."""
        return m.u + self.offset


@final
@dataclass(frozen=True)
class InputNonlinearity(InputEffect):
    r"""The actuator's gain changes with the input.

    .. math:: u_a = u + \gamma (u - u_0)^2

    Parameters
    ----------
    curvature : float
        The curvature gamma [1/input unit].

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.InputNonlinearity(curvature=0.01))
    InputNonlinearity: curvature = 0.01 1/[u]
    """

    curvature: float = parameter("1/{u}", neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = (
        "InputSaturatingGain", "InputOffset", "ForceExponent",
    )  # fmt: skip
    sentence: ClassVar[str] = "The gain of the actuator depends on the input."
    experiment: ClassVar[str] = (
        "large inputs to both sides of the operating point: the gain differs between the sides"
    )

    def input(self, m: Moment) -> Any:
        """Return the input bent around the operating point."""
        d = m.u - m.at.input
        return m.u + self.curvature * d * d


@final
@dataclass(frozen=True)
class InputSaturatingGain(InputEffect):
    r"""The actuator's gain falls for large inputs, as iron does when it saturates.

    .. math:: u_a = u / \sqrt{1 + s u^2}, \quad s = 1/U_s^2

    Parameters
    ----------
    saturation : float
        One over the square of the largest input that can take effect [1/input unit^2].

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.effects.InputSaturatingGain(saturation=1 / 10.0**2).values()
    {'saturation': 0.01}
    """

    saturation: float = parameter("1/{u}^2", lower=0.0, neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = (
        "InputOffset", "ConstantForce", "InputNonlinearity", "InputSaturation",
    )  # fmt: skip
    sentence: ClassVar[str] = "The gain of the actuator decreases with the size of the input."
    experiment: ClassVar[str] = "operating points far apart, which need a wide range of inputs"

    def input(self, m: Moment) -> Any:
        """Return the saturating input."""
        return m.u / np.sqrt(1 + self.saturation * m.u * m.u)
