"""Lag, delay and backlash between the controller and the plant."""

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, Self, final

import casadi

from .._base.errors import EffectDoesNotApply
from ..physics.equations import Backlash, Equations
from ..physics.linearization import OperatingPoint
from .context import Moment
from .kinds import InputEffect, choose_widths, require_one_input, scan_widths
from .parameters import parameter
from .scanning import Range, Scan, Sight
from .symbolic import to_expression


@final
@dataclass(frozen=True)
class ActuatorLag(InputEffect):
    r"""The plant's input follows the computed one as a first-order lag.

    .. math:: \tau \dot u_a = u - u_a

    The current in a coil (tau = L/R), an amplifier of finite bandwidth.

    Parameters
    ----------
    tau : float
        Time constant [s].

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.ActuatorLag(tau=0.002))
    ActuatorLag: tau = 0.002 s
    """

    tau: float = parameter("s", lower=0.0, neutral=0.0)

    states: ClassVar[tuple[str, ...]] = ("input",)
    look_alikes: ClassVar[tuple[str, ...]] = ("InputDelay", "SensorLag")
    sentence: ClassVar[str] = "The actuator follows its command with a first-order lag."
    experiment: ClassVar[str] = (
        "large steps of the input: a lag of the actuator acts before the nonlinearities of the "
        "plant, a lag of the sensor after them, and the response to a delay has no exponential tail"
    )

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return a lag of one sampling period: at zero there is no derivative to go by."""
        del record
        return cls._applicable(loop, cls(tau=loop.dt))

    def rates(self, m: Moment) -> tuple[Any, ...]:
        """Return the lag."""
        return (m.follow(m.u, self.tau),)

    def rest(self, at: OperatingPoint) -> tuple[float, ...]:
        """Return the input at rest."""
        return (at.input,)

    def input(self, m: Moment) -> Any:
        """Return the lagging input."""
        return m.own["input"]


# A delay of more periods than this is asked about: it may be meant in samples. A process with a
# long dead time may have it all the same, so that it is not refused.
MANY_PERIODS = 100


@final
@dataclass(frozen=True)
class InputDelay(InputEffect):
    r"""The computed input arrives late.

    .. math:: u_a(t) = u(t - \theta)

    Computation time, a bus, a conversion. A delay of the output cannot be told from it.

    Parameters
    ----------
    delay : float
        The delay [s], on top of the one that a sampled loop has anyway; any fraction of a period.

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.effects.InputDelay(delay=0.0005).neutral
    False
    """

    delay: float = parameter("s", lower=0.0, neutral=0.0)

    stage: ClassVar[int] = 5
    look_alikes: ClassVar[tuple[str, ...]] = ("SensorLag", "ActuatorLag", "ViscousFriction")
    sentence: ClassVar[str] = "The input acts on the plant after a fixed delay."
    experiment: ClassVar[str] = (
        "fast excitation: at high frequencies the phase of a delay continues to fall, while that "
        "of a lag levels off"
    )

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return a delay of half a period: at zero the derivative has one side only."""
        del record
        return cls._applicable(loop, cls(delay=0.5 * loop.dt))

    def question(self, dt: float) -> str | None:
        """Ask whether a delay of very many periods was meant in samples."""
        periods = self.delay / dt
        if periods <= MANY_PERIODS:
            return None
        return (
            f"InputDelay(delay={self.delay:g}) is a delay of {self.delay:g} s, which is "
            f"{periods:.6g} sampling periods of {dt:g} s. The delay is in seconds: if "
            f"{self.delay:g} samples are meant, give delay={self.delay * dt:.6g}"
        )

    def limits(self, seen: Range) -> dict[str, tuple[float, float]]:
        """Return the length of the record: of a longer delay nothing would arrive."""
        return {"delay": (0.0, seen.duration)}

    def build(self, e: Equations, m: Moment) -> Equations:
        """Return the equations with this delay on top of what there is."""
        k, delay = e.inputs.index(self.at) if len(e.inputs) > 1 else 0, to_expression(self.delay)
        if e.delay is not None and k != e.late_input:
            raise EffectDoesNotApply(
                f"one of several inputs can come late, and {e.inputs[e.late_input]} does already. "
                "Write the other delay as states of the plant (control.pade)"
            )
        delay = delay if e.delay is None else e.delay + delay
        return dataclasses.replace(e, delay=delay, late_input=k)


@final
@dataclass(frozen=True)
class InputBacklash(InputEffect):
    r"""Backlash of the input, before the plant.

    .. math:: m_{k} = \min(\max(m_{k-1}, u_k - w/2), u_k + w/2), \quad u_a = m_k

    The applied input moves only once the computed one has crossed the gap, as where the input is a
    position that a linkage with play carries to a valve or a rudder. Play between a motor and its
    load is another thing, and not in the catalogue: in the gap no torque acts on the load, which
    moves on by itself.

    Parameters
    ----------
    width : float
        Full width w of the gap [input unit].

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.effects.InputBacklash(width=0.2).place
    'input'
    """

    width: float = parameter("{u}", lower=0.0, neutral=0.0)

    stage: ClassVar[int] = 6
    in_linear_model: ClassVar[bool] = False
    look_alikes: ClassVar[tuple[str, ...]] = ("InputDeadZone", "InputDelay", "CoulombFriction")
    sentence: ClassVar[str] = (
        "After a reversal the input moves the plant only when it has crossed a gap, as a linkage "
        "with play has one; a valve that sticks and then jumps looks much the same."
    )
    experiment: ClassVar[str] = (
        "slow triangular inputs of several amplitudes: the hysteresis of a backlash has the same "
        "width at each amplitude"
    )

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return gaps of a tenth of the range of the recorded input, and of all but a tenth."""
        widths = choose_widths(loop, record)
        return cls._applicable(loop, *(cls(width=width) for width in widths))

    def scan(self, sight: Sight) -> Scan | None:
        """Look at a few widths."""
        return scan_widths(self, sight)

    @classmethod
    def is_scanned(cls) -> bool:
        """Say no: a few widths hardly take longer than one."""
        return False

    def build(self, e: Equations, m: Moment) -> Equations:
        """Return the equations with the backlash ahead of them."""
        require_one_input(self, e)
        if e.play is not None:
            raise EffectDoesNotApply(
                "there is a backlash already; one loop takes a single InputBacklash"
            )
        memory, u = casadi.SX.sym("m"), casadi.SX.sym("u")
        half = to_expression(self.width) / 2
        after = casadi.fmin(casadi.fmax(memory, u - half), u + half)
        return dataclasses.replace(e, play=Backlash(memory, u, after, after, u, half))
