"""Parameters of the plant that are off, drift, or step during a record."""

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self, final

import numpy as np

from .context import Moment
from .kinds import LawEffect
from .parameters import parameter
from .scanning import Overview, Range, Scan, Sight

# The acceleration of gravity lies between these everywhere on earth [m/s^2], and is not off.
GRAVITY = (9.76, 9.84)
# A step is not looked for in this share of the record at either end.
EDGE = 0.05
# A scan looks for a step at so many instants at once.
TIMES = 40
# A fit by simulation starts from so many instants, since each takes its time.
SPREAD_TIMES = 12
# A fit starts from a relative change between these two.
SMALLEST, LARGEST = -0.9, 10.0


@final
@dataclass(frozen=True)
class ParameterError(LawEffect):
    r"""A parameter of the plant is not what the model says.

    .. math:: \theta \to \theta (1 + \epsilon)

    A mass that nobody weighed, a gain from a data sheet. It is tried for each parameter that is not
    in ``free``, but for the acceleration of gravity: what is free is fitted before any effect is
    sought. From a tenth to ten times the value it is the parameter that is wrong, beyond that the
    model.

    Parameters
    ----------
    name : str
        Name of the plant's parameter.
    error : float
        Relative error epsilon, from -0.9 to 9.

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.ParameterError("K", error=0.03))
    ParameterError: name = K, error = 0.03
    """

    name: str
    error: float = parameter("", lower=-0.9, upper=9.0, neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = (
        "SensorGain", "ConstantForce", "LinearStiffness", "ViscousFriction",
    )  # fmt: skip
    sentence: ClassVar[str] = "A parameter of the plant is not what the model says."
    experiment: ClassVar[str] = (
        "a measurement of the parameter itself; if it may be off, name it in free="
    )

    @property
    def called(self) -> str:
        """What reports call it: the parameter."""
        return f"parameter {self.name}"

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return one for each parameter of the plant that is called exact."""
        del record
        return cls._applicable(loop, *(cls(name, 0.0) for name in _list_exact_parameters(loop)))

    def law(self, m: Moment) -> dict[str, Any]:
        """Return the parameter as it is."""
        return {self.name: m.plant_parameter(self.name) * (1 + self.error)}


def _list_exact_parameters(loop: Any) -> list[str]:
    """Return the parameters of the plant that are called exact, without the earth's gravity."""
    return [
        k for k, v in loop.equations().parameters.items()
        if "." not in k and k not in loop.free and v != 0
        and not (k == "g" and GRAVITY[0] <= v <= GRAVITY[1])
    ]  # fmt: skip


def _list_changing(loop: Any) -> list[str]:
    """Return the parameters of the plant that may change: what was exact once need not stay so.

    Of a plant with several signals the free ones alone, since there each place adds to a search.
    """
    own = [name for name in loop.free if name.partition(".")[0] not in loop.labelled]
    return [*own, *_list_exact_parameters(loop)] if loop.equations().siso else own


@final
@dataclass(frozen=True)
class ParameterDrift(LawEffect):
    r"""A parameter of the plant changes steadily.

    .. math:: \theta(t) = \theta (1 + \rho t)

    A coil that warms up, a battery that runs down, a heat exchanger that fouls. It is tried for
    each parameter of the plant, free or exact, but for the gravity of the earth; of a plant with
    several signals for the free ones.

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

    look_alikes: ClassVar[tuple[str, ...]] = ("ParameterStep", "ConstantForce", "SensorDrift")
    sentence: ClassVar[str] = "A parameter of the plant drifts, as from warming, wear or fouling."
    experiment: ClassVar[str] = "the same excitation at the beginning and at the end of a record"

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return one for each parameter of the plant."""
        del record
        return cls._applicable(loop, *(cls(name, 0.0) for name in _list_changing(loop)))

    def limits(self, seen: Range) -> dict[str, tuple[float, float]]:
        """Keep the sign of the parameter: a mass or a stiffness does not drift through zero."""
        return {"rate": (-1 / seen.duration, math.inf)}

    def law(self, m: Moment) -> dict[str, Any]:
        """Return the drifting parameter."""
        return {self.name: m.plant_parameter(self.name) * (1 + self.rate * m.t)}


@final
@dataclass(frozen=True)
class ParameterStep(LawEffect):
    r"""A parameter of the plant jumps.

    .. math:: \theta(t) = \theta (1 + \sigma H(t - t_s))

    with the step H spread over one sampling period, so that its time can be fitted. It is tried for
    the parameters for which a `ParameterDrift` is.

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
    time: float = parameter("s", instant=True, searched=True)
    size: float = parameter("", neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = ("ParameterDrift", "ConstantForce")
    sentence: ClassVar[str] = "A parameter of the plant jumps at one instant."
    experiment: ClassVar[str] = (
        "excitation without pauses, so that the instant of the change can be seen"
    )

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return one of no size for each parameter of the plant; its time is to be scanned."""
        half = 500 * loop.dt if record is None else record.duration / 2
        return cls._applicable(loop, *(cls(name, half, 0.0) for name in _list_changing(loop)))

    def limits(self, seen: Range) -> dict[str, tuple[float, float]]:
        """Keep the instant within the record, and the sign of the parameter.

        Outside, a step is a constant of the plant. A damping does not jump to below zero.
        """
        return {"time": (0.0, seen.duration), "size": (-1.0, math.inf)}

    def scan(self, sight: Sight) -> Scan | None:
        """Look at instants over the record, ever closer around the best, down to one sample."""
        sight = sight.with_free(self.name)
        value = sight.parameter(self.name)
        last = float(max(t[-1] for t in sight.times))
        # At the very ends a step is only another name for the initial state.
        low, high = EDGE * last, (1 - EDGE) * last
        # The likelihood is rugged in the time of a step: the scan must come within a sample of it.
        while True:
            times = np.linspace(low, high, TIMES + 2)[1:-1]
            gains, sizes = sight.score_shapes(
                [(t[:, None] >= times).astype(float) for t in sight.times], self.name
            )
            best = int(np.argmax(gains))
            width = times[1] - times[0]
            if width < 0.5 * sight.dt:
                break
            low, high = max(times[best] - 2 * width, low), min(times[best] + 2 * width, high)
        size = float(sizes[best, 0]) / value if value else 0.0
        start = replace(self, time=float(times[best]), size=min(max(size, SMALLEST), LARGEST))
        return Scan(((start,),), places=round(last / sight.dt) + 1)

    def spread_starts(self, sight: Overview) -> tuple[Self, ...]:
        """Return a step at several instants of the record."""
        times = np.linspace(0, max(float(t[-1]) for t in sight.times), SPREAD_TIMES + 2)[1:-1]
        return tuple(replace(self, time=float(t)) for t in times)

    def law(self, m: Moment) -> dict[str, Any]:
        """Return the parameter before and after."""
        after = 0.5 + 0.5 * m.sign(m.t - self.time, width=0.5 * m.dt)
        return {self.name: m.plant_parameter(self.name) * (1 + self.size * after)}
