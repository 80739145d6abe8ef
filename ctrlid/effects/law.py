"""Changes inside the plant's own law: what it sees, how its force falls, what drifts."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, ClassVar, Self, final

import casadi
import numpy as np
from scipy import signal

from ..errors import CtrlidError
from ..linearization import state_matrices
from ..physics import Equations
from .base import expression, parameter, require_motion
from .moment import Moment
from .places import LawEffect

RIM = 0.25  # of a sampling period: how fast what exceeds a limit runs off
INVERSE_SQUARE = 1e-9  # relative agreement with a force that falls with the distance squared


@final
@dataclass(frozen=True)
class PositionOffset(LawEffect):
    r"""The law sees another position than the sensor's zero says.

    .. math:: f(x, \dot x, u) \to f(x + x_{off}, \dot x, u)

    The gap of a magnet counted from a wrong surface.

    Parameters
    ----------
    offset : float
        What the law adds to the position [output unit].

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.PositionOffset(offset=0.0008))
    PositionOffset: offset = 0.0008 [y]
    """

    offset: float = parameter("{y}", neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = (
        "SensorOffset", "ForceExponent", "LinearStiffness", "InputOffset",
    )  # fmt: skip
    sentence: ClassVar[str] = "The force depends on a distance that starts at another zero."
    experiment: ClassVar[str] = (
        "the stiffness at operating points far apart; the zero of the sensor has to be measured "
        "with a gauge"
    )

    def law(self, m: Moment) -> dict[str, Any]:
        """Return the position as the law sees it."""
        return {m.position_name: m.position + self.offset}

    def build(self, e: Equations, m: Moment) -> Equations:
        """Return the changed equations, if the force depends on the position at all."""
        i, j = require_motion(self, e)
        if not casadi.jacobian(e.rhs[j], e.x[i]).nnz():
            raise CtrlidError(f"PositionOffset: the force in {e.name} does not depend on "
                              f"{e.states[i]}: an offset of it changes nothing")  # fmt: skip
        return super().build(e, m)


@final
@dataclass(frozen=True)
class ForceExponent(LawEffect):
    r"""The input's force falls with another power of the distance than the second.

    .. math:: f_u \propto x^{-2} \to x_0^{-2} (x / x_0)^{-n}

    The same force at the operating point; `f_u` is the part that vanishes with the input.

    Parameters
    ----------
    n : float
        The power, 2 for a thin gap in iron, about 4 for a coil and a small magnet.

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.effects.ForceExponent(n=2).neutral
    True
    """

    n: float = parameter("", lower=0.5, upper=6.0, neutral=2.0)

    stage: ClassVar[int] = -1  # of the law as it is written, before offsets and curves
    look_alikes: ClassVar[tuple[str, ...]] = (
        "PositionOffset", "LinearStiffness", "CubicStiffness", "SensorNonlinearity",
    )  # fmt: skip
    sentence: ClassVar[str] = "The force falls with the distance by another power."
    experiment: ClassVar[str] = "the input at rest at operating points over the whole stroke"

    def build(self, e: Equations, m: Moment) -> Equations:
        """Return the changed equations, if the force falls with the square of the distance."""
        i, j = require_motion(self, e)
        rest = m.at.states[i]
        pull = e.rhs[j] - casadi.substitute(e.rhs[j], e.u, casadi.SX.zeros(*e.u.shape))
        falling = casadi.Function("pull", [e.t, e.x, e.u, e.p], [pull])
        values = list(e.parameters.values())
        ratios = []
        for scale in (0.7, 1.0, 1.4):
            states = np.array(m.at.states[: len(e.states)])
            states[i] *= scale
            ratios.append(scale**2 * float(falling(0.0, states, m.at.input or 1.0, values)))
        off = np.ptp(ratios) / max(abs(ratios[1]), np.finfo(float).tiny)
        if not (rest > 0 and ratios[1] and off < INVERSE_SQUARE):
            raise CtrlidError(
                f"ForceExponent needs a force of the input that falls with the square of "
                f"{e.states[i]} > 0; that of {e.name} does not"
            )
        factor = (e.x[i] / rest) ** (2 - expression(self.n))
        rhs = casadi.SX(e.rhs)
        rhs[j] = rhs[j] + pull * (factor - 1)
        return dataclasses.replace(e, rhs=rhs)


def _of_plant(loop: Any) -> list[str]:
    """Return the free parameters that are the plant's own."""
    return [name for name in loop.free if name.partition(".")[0] not in loop.labelled]


@final
@dataclass(frozen=True)
class ParameterDrift(LawEffect):
    r"""A parameter of the plant changes steadily.

    .. math:: \theta(t) = \theta (1 + \rho t)

    A coil that warms up, a battery that runs down.

    Parameters
    ----------
    name : str
        Name of the plant's parameter.
    rate : float
        Relative change per second rho [1/s].

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.ParameterDrift("K", rate=-0.002))
    ParameterDrift: name = K, rate = -0.002 1/s
    """

    name: str
    rate: float = parameter("1/s", neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = ("ParameterStep", "ConstantForce")
    sentence: ClassVar[str] = "A parameter of the plant drifts, as of a coil that warms up."
    experiment: ClassVar[str] = "the same excitation at the beginning and at the end of a record"

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return one for each free parameter of the plant."""
        del record
        return cls._applicable(loop, *(cls(name, 0.0) for name in _of_plant(loop)))

    def law(self, m: Moment) -> dict[str, Any]:
        """Return the drifting parameter."""
        return {self.name: m.plant_parameter(self.name) * (1 + self.rate * m.t)}


@final
@dataclass(frozen=True)
class ParameterStep(LawEffect):
    r"""A parameter of the plant jumps.

    .. math:: \theta(t) = \theta (1 + \sigma H(t - t_s))

    with the step H spread over one sampling period, so that its time can be fitted.

    Parameters
    ----------
    name : str
        Name of the plant's parameter.
    time : float
        When it jumps, t_s [s].
    size : float
        Relative change sigma.

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.ParameterStep("k", time=3.0, size=-0.1))
    ParameterStep: name = k, time = 3 s, size = -0.1
    """

    name: str
    time: float = parameter("s")
    size: float = parameter("", neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = ("ParameterDrift", "ConstantForce")
    sentence: ClassVar[str] = "A parameter of the plant changes at one moment."
    experiment: ClassVar[str] = "excitation that never pauses, so that the moment is seen"

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return one of no size for each free parameter; its time is to be scanned."""
        half = 500 * loop.dt if record is None else record.start + record.duration / 2
        return cls._applicable(loop, *(cls(name, half, 0.0) for name in _of_plant(loop)))

    def law(self, m: Moment) -> dict[str, Any]:
        """Return the parameter before and after."""
        after = 0.5 + 0.5 * m.sign(m.t - self.time, width=0.5 * m.dt)
        return {self.name: m.plant_parameter(self.name) * (1 + self.size * after)}


@final
@dataclass(frozen=True)
class StateLimit(LawEffect):
    r"""A state that cannot exceed a limit: what flows in beyond it runs over.

    .. math:: \dot x = f - q, \quad \dot x_{to} = f_{to} + \kappa q, \quad
        q = \max(x - x_{max}, 0) / (T/4)

    with the sampling period T. A tank that overflows, in part into the next one.

    Parameters
    ----------
    name : str
        The state.
    upper : float
        Its limit [unit of the state].
    spill_to : str, optional
        The state that what runs over flows into; by default it is lost.
    share : float, optional
        The share kappa of it that arrives there, between 0 and 1.

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.StateLimit("h1", upper=10.0, spill_to="h2", share=0.3))
    StateLimit: name = h1, upper = 10 [state], spill_to = h2, share = 0.3
    """

    name: str
    upper: float = parameter("{x}", neutral=math.inf)
    spill_to: str = ""
    share: float = parameter("", lower=0.0, upper=1.0, default=1.0)

    look_alikes: ClassVar[tuple[str, ...]] = ("SensorSaturation", "InputSaturation")
    sentence: ClassVar[str] = "A tank is full, and what comes in runs over."
    experiment: ClassVar[str] = "large slow steps that fill it to the brim and beyond"

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return one for each state that is no motion; it spills into the state it feeds."""
        e = loop.equations()
        own = range(len(e.states) - len(e.rest))
        moving = {*e.velocities, *(i for i in own if _rate_is_state(e, i))}
        if loop.linear_plant or e.dt:
            return ()
        found = []
        for i in own:
            if i in moving:
                continue
            fed = [k for k in own if k != i and casadi.jacobian(e.rhs[k], e.x[i]).nnz()]
            upper = _high(loop, record, i)
            to, share = (e.states[fed[0]], 0.5) if fed else ("", 1.0)
            found.append(cls(e.states[i], upper, to, share))
        return cls._applicable(loop, *found)

    def build(self, e: Equations, m: Moment) -> Equations:
        """Return the equations with the overflow."""
        unknown = [s for s in (self.name, self.spill_to or self.name) if s not in e.states]
        if unknown:
            raise CtrlidError(f"StateLimit names the state {unknown[0]!r}; {e.name} has "
                              f"{list(e.states)}")  # fmt: skip
        if e.dt:
            raise CtrlidError("StateLimit is a flow in continuous time; the plant "
                              f"{e.name} is sampled at {e.dt:g} s")  # fmt: skip
        over = expression(m.above(m.states[self.name] - self.upper)) / (RIM * m.dt)
        rhs = casadi.SX(e.rhs)
        i = e.states.index(self.name)
        rhs[i] = rhs[i] - over
        if self.spill_to:
            k = e.states.index(self.spill_to)
            rhs[k] = rhs[k] + expression(self.share) * over
        return dataclasses.replace(e, rhs=rhs)


def _rate_is_state(e: Equations, i: int) -> bool:
    rate = casadi.simplify(e.rhs[i])
    return any(casadi.is_equal(rate, e.x[k], 2) for k in range(len(e.states)) if k != i)


def _high(loop: Any, record: Any, i: int) -> float:
    """Return a value that a state exceeds now and then, as far as a record tells."""
    e, at = loop.equations(), loop.point
    if record is not None and casadi.is_equal(e.output[0], e.x[i], 2):
        return float(np.quantile(record.y, 0.9))
    if record is not None:  # by the linear model, from the recorded input
        a, b, _, _ = state_matrices(e, at)
        if np.linalg.eigvals(a).real.max() < 0:
            n = len(a)
            sampled = signal.cont2discrete((a, b, np.eye(n), np.zeros((n, 1))), record.dt)
            moved = signal.dlsim(sampled, record.u - at.input)[1][:, i]
            return float(at.states[i] + np.quantile(moved, 0.9))
    return float(at.states[i] + 0.5 * max(abs(at.states[i]), 1e-3))
