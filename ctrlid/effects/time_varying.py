"""Parameters of the plant that do not stay what they were."""

from dataclasses import dataclass
from typing import Any, ClassVar, Self, final

from .context import Moment
from .kinds import LawEffect
from .parameters import parameter


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
        half = 500 * loop.dt if record is None else record.duration / 2
        return cls._applicable(loop, *(cls(name, half, 0.0) for name in _of_plant(loop)))

    def law(self, m: Moment) -> dict[str, Any]:
        """Return the parameter before and after."""
        after = 0.5 + 0.5 * m.sign(m.t - self.time, width=0.5 * m.dt)
        return {self.name: m.plant_parameter(self.name) * (1 + self.size * after)}
