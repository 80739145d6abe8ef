"""Forces that oppose motion, as accelerations of the moving mass.

All are counted in output units per second squared; times the mass they are newtons.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Self, final

import numpy as np

from .context import Moment
from .kinds import ForceEffect
from .parameters import parameter
from .scanning import Range

# Dry friction comes after all forces that it may balance.
LAST_FORCE = 2
# Stribeck's velocity lies between these shares of the largest usual speed.
SLOWEST, FASTEST = 1e-3, 3.0
# Half the difference over the mean friction is at most 1 for friction; the rest is left to the
# uncertainty of both.
LARGEST_ASYMMETRY = 1.5


@final
@dataclass(frozen=True)
class ViscousFriction(ForceEffect):
    r"""Friction in proportion to the velocity.

    .. math:: a = -c \dot x

    Parameters
    ----------
    c : float
        Friction over mass [1/s].

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.ViscousFriction(c=2.14))
    ViscousFriction: c = 2.14 1/s
    """

    c: float = parameter("1/s", lower=0.0, neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = (
        "EddyCurrentDamping", "CoulombFriction", "InputDelay", "QuadraticDrag",
        "AsymmetricViscousFriction",
    )  # fmt: skip
    sentence: ClassVar[str] = "A force against the motion that grows with the speed."
    experiment: ClassVar[str] = (
        "motion at several constant speeds and positions: viscous friction is proportional to the "
        "speed and the same at every position"
    )

    def force(self, m: Moment) -> Any:
        """Return the acceleration."""
        return -self.c * m.velocity


@final
@dataclass(frozen=True)
class AsymmetricViscousFriction(ForceEffect):
    r"""Viscous friction that differs between the two directions.

    .. math:: a = -(c \dot x + \delta |\dot x|)

    Forwards the coefficient is c + delta, backwards c - delta.

    Parameters
    ----------
    c : float
        Mean friction over mass [1/s].
    difference : float
        Half the difference between forward and backward friction [1/s].

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.effects.AsymmetricViscousFriction(c=2.1, difference=-0.4).neutral
    False
    """

    c: float = parameter("1/s", lower=0.0, neutral=0.0)
    difference: float = parameter("1/s", neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = ("ViscousFriction", "AsymmetricCoulombFriction")
    sentence: ClassVar[str] = "Viscous friction is stronger in one direction."
    experiment: ClassVar[str] = "the same strokes in both directions at several speeds"

    def force(self, m: Moment) -> Any:
        """Return the acceleration."""
        return -self.c * m.velocity - self.difference * m.abs(m.velocity)


@final
@dataclass(frozen=True)
class CoulombFriction(ForceEffect):
    r"""Dry friction of constant size.

    .. math:: a = -f_c \, \mathrm{sign}(\dot x)

    while it moves; at rest it holds against all other forces, up to f_c (`Moment.rub`). In a filter
    the jump is spread over what it does not know of the velocity.

    With a time of creep it is :math:`a = -f_c \tanh(\dot x / (\tau f_c))`, as many simulations
    have it: nothing sticks, and what is pushed at rest creeps. A simulation with
    ``fc * tanh(v / v0)`` has ``creep = v0 / fc``.

    Parameters
    ----------
    fc : float
        Friction over mass [output unit/s^2].
    creep : float, optional
        Time of creep tau [s]; by default zero, which sticks.

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.CoulombFriction(fc=0.214))
    CoulombFriction: fc = 0.214 [y]/s^2
    """

    fc: float = parameter("{y}/s^2", lower=0.0, neutral=0.0)
    creep: float = parameter("s", lower=0.0, optional=True)

    stage: ClassVar[int] = LAST_FORCE
    in_linear_model: ClassVar[bool] = False
    look_alikes: ClassVar[tuple[str, ...]] = (
        "ViscousFriction", "StribeckFriction", "AsymmetricCoulombFriction", "InputDeadZone",
    )  # fmt: skip
    sentence: ClassVar[str] = "A force of constant size against the motion, as of dry surfaces."
    experiment: ClassVar[str] = "slow motion with reversals: the force jumps when the motion turns"

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return no friction, which would stick, and one that would creep for a period."""
        del record
        return cls._applicable(loop, cls(fc=0.0), cls(fc=0.0, creep=loop.dt))

    def force(self, m: Moment) -> Any:
        """Return the acceleration."""
        return -m.rub(self.fc, creep=self.creep)


@final
@dataclass(frozen=True)
class AsymmetricCoulombFriction(ForceEffect):
    r"""Dry friction that differs between the two directions.

    .. math:: a = -f_c \, \mathrm{sign}(\dot x) - \delta

    while it moves, and what holds it at rest. Nothing tells it from `CoulombFriction` together with
    a `ConstantForce`: what sticks is held against the one as against the other.

    Parameters
    ----------
    fc : float
        Mean friction over mass [output unit/s^2].
    difference : float
        Half the difference between forward and backward friction [output unit/s^2].

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.effects.AsymmetricCoulombFriction(fc=0.2, difference=0.03).values()
    {'fc': 0.2, 'difference': 0.03}
    """

    fc: float = parameter("{y}/s^2", lower=0.0, neutral=0.0)
    difference: float = parameter("{y}/s^2", neutral=0.0)

    stage: ClassVar[int] = LAST_FORCE
    in_linear_model: ClassVar[bool] = False
    look_alikes: ClassVar[tuple[str, ...]] = (
        "CoulombFriction", "AsymmetricViscousFriction", "ConstantForce",
    )  # fmt: skip
    sentence: ClassVar[str] = "Dry friction is stronger in one direction."
    experiment: ClassVar[str] = (
        "slow strokes in both directions: the force that each of them needs is measured on its own"
    )

    def doubt(self) -> str | None:
        """Say so where it would push: friction is against the motion in both directions."""
        if abs(self.difference) > LARGEST_ASYMMETRY * self.fc:
            return "in one direction it would push along the motion, which no friction does"
        return None

    def force(self, m: Moment) -> Any:
        """Return the acceleration."""
        return -m.rub(self.fc, drag=-self.difference) - self.difference


@final
@dataclass(frozen=True)
class StribeckFriction(ForceEffect):
    r"""Extra friction near rest, which fades as the motion gets faster.

    .. math:: a = -f_s \, \mathrm{sign}(\dot x) \, e^{-(\dot x / v_s)^2}

    On top of `CoulombFriction`, the classical curve of Stribeck.

    Parameters
    ----------
    fs : float
        Extra friction over mass at rest [output unit/s^2].
    vs : float
        Velocity at which it has fallen to 37 % [output unit/s].

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.effects.StribeckFriction(fs=0.0, vs=0.01).neutral
    True
    """

    fs: float = parameter("{y}/s^2", lower=0.0, neutral=0.0)
    vs: float = parameter("{y}/s", lower=1e-12)

    stage: ClassVar[int] = LAST_FORCE
    in_linear_model: ClassVar[bool] = False
    look_alikes: ClassVar[tuple[str, ...]] = ("CoulombFriction", "AsymmetricCoulombFriction")
    sentence: ClassVar[str] = "Friction is larger at standstill than in motion."
    experiment: ClassVar[str] = "very slow motion, in which the plant sticks and slips"

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return no friction with a velocity of a tenth of the usual one."""
        speed = 0.01
        if record is not None:
            speed = 0.1 * float(np.std(np.gradient(record.y, record.dt))) or speed
        return cls._applicable(loop, cls(fs=0.0, vs=speed))

    def limits(self, seen: Range) -> dict[str, tuple[float, float]]:
        """Keep the velocity among those that there are."""
        return {"vs": (SLOWEST * seen.fastest, FASTEST * seen.fastest)}

    def force(self, m: Moment) -> Any:
        """Return the acceleration."""
        return -m.rub(self.fs) * np.exp(-((m.velocity / self.vs) ** 2))


@final
@dataclass(frozen=True)
class QuadraticDrag(ForceEffect):
    r"""Drag of a fast motion in a fluid.

    .. math:: a = -c_2 \dot x |\dot x|

    Parameters
    ----------
    c2 : float
        Drag over mass [1/output unit].

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.QuadraticDrag(c2=3.0))
    QuadraticDrag: c2 = 3 1/[y]
    """

    c2: float = parameter("1/{y}", lower=0.0, neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = ("ViscousFriction",)
    sentence: ClassVar[str] = "A force against the motion that grows with the speed squared."
    experiment: ClassVar[str] = (
        "motion at several speeds: at twice the speed the drag is four times as large"
    )

    def force(self, m: Moment) -> Any:
        """Return the acceleration."""
        return -self.c2 * m.velocity * np.abs(m.velocity)


@final
@dataclass(frozen=True)
class EddyCurrentDamping(ForceEffect):
    r"""Damping by currents that a magnet induces, which grows with its field squared.

    .. math:: a = -c_e u^2 \dot x

    Parameters
    ----------
    ce : float
        Damping over mass per input squared [1/(s input unit^2)].

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.EddyCurrentDamping(ce=0.5))
    EddyCurrentDamping: ce = 0.5 1/(s [u]^2)
    """

    ce: float = parameter("1/(s {u}^2)", lower=0.0, neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = ("ViscousFriction",)
    sentence: ClassVar[str] = "A magnet brakes metal that moves in its field."
    experiment: ClassVar[str] = (
        "several operating points with different inputs: this damping grows with the input, while "
        "viscous friction does not"
    )

    def force(self, m: Moment) -> Any:
        """Return the acceleration."""
        return -self.ce * m.u * m.u * m.velocity
