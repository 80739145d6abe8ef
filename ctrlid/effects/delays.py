"""Lag, delay, backlash and limited rate between the controller and the plant."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, ClassVar, Self, final

import casadi
import numpy as np

from .._base.errors import EffectDoesNotApply
from ..physics.equations import Equations, InputMemory
from ..physics.linearization import OperatingPoint
from .context import Moment
from .kinds import InputEffect, MemoryEffect, choose_widths, scan_widths
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
class InputBacklash(MemoryEffect):
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

    def remember(self, memory: Any, u: Any, period: Any, at_rest: Any) -> InputMemory:
        """Return the gap, in which the memory stays where it is."""
        half = to_expression(self.width) / 2
        after = casadi.fmin(casadi.fmax(memory, u - half), u + half)
        return InputMemory(memory, u, period, at_rest, after, after, u, half)


# A largest speed is looked for where it holds back all but these shares of the steps of the input.
REACHED = (0.999, 0.99, 0.95, 0.8, 0.5)


@final
@dataclass(frozen=True)
class InputRateLimit(MemoryEffect):
    r"""The actuator moves at a limited speed.

    .. math:: m_{k+1} = m_k + \min(\max(u_k - m_k, -RT), RT)

    The actuator runs from where it is towards the computed input at the speed R, and waits where it
    arrives. Of a held input the plant gets the mean over the sampling period T,

    .. math:: u_a = m_k + \Delta - \frac{\Delta |\Delta|}{2RT}, \quad \Delta = m_{k+1} - m_k,

    which moves a velocity exactly as the ramp does. The servo of a rudder or an elevator, a valve
    with a motor.

    Parameters
    ----------
    rate : float
        The largest speed R [input unit/s]; infinite for none.

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.InputRateLimit(rate=0.5))
    InputRateLimit: rate = 0.5 [u]/s
    """

    rate: float = parameter("{u}/s", lower=0.0, neutral=math.inf)

    look_alikes: ClassVar[tuple[str, ...]] = ("ActuatorLag", "InputDelay", "InputSaturation")
    sentence: ClassVar[str] = "The speed of the actuator is limited."
    experiment: ClassVar[str] = (
        "small and large steps of the input: at a largest speed the larger step takes longer, "
        "while a lag takes as long for both"
    )

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return a speed that holds back some of the steps of the recorded input."""
        if record is None:
            return cls._applicable(loop, cls(rate=max(abs(float(loop.point.input)), 1.0) / loop.dt))
        rates = _find_rates(record.u[..., record.valid_somewhere], loop.dt)
        return cls._applicable(loop, cls(rate=rates[len(rates) // 2])) if rates else ()

    def scan(self, sight: Sight) -> Scan | None:
        """Look at speeds that hold back few or many of the steps of the input."""
        rates = _find_rates(sight.inputs, sight.dt)
        if not rates:
            return None
        starts = tuple(dataclasses.replace(self, rate=rate) for rate in rates)
        return Scan((starts,), places=len(starts))

    def remember(self, memory: Any, u: Any, period: Any, at_rest: Any) -> InputMemory:
        """Return the way at the largest speed; where a record begins, it may be under way."""
        most = to_expression(self.rate) * period
        step = casadi.fmin(casadi.fmax(u - memory, -most), most)
        # At a speed of zero nothing moves, and nothing is divided by it.
        lost = step * casadi.fabs(step) / (2 * most + np.finfo(float).tiny)
        start, reach = (u + at_rest) / 2, casadi.fabs(u - at_rest) / 2
        after = memory + step
        return InputMemory(
            memory, u, period, at_rest, after, after - lost, start, reach, moves=True
        )


def _find_rates(u: Any, dt: float) -> list[float]:
    """Return speeds that hold back few or many of the steps of an input, the fastest first."""
    steps = np.abs(np.diff(u))
    if not steps.size:
        return []
    return [float(step) / dt for step in np.quantile(steps, REACHED) if step > 0]
