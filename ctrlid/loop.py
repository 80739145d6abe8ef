"""The loop: a plant under control, in absolute physical units."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import casadi
import control as ct
import numpy as np

from .controllers import ControlLaw, control_law
from .errors import CtrlidError
from .linearization import OperatingPoint, linearize
from .physics import Equations, require_siso, trace


@dataclass(frozen=True, eq=False)
class Loop:
    """A plant, its controller and the point around which they work.

    .. math:: u = u_0 + C(r - y)

    with all signals in absolute physical units and ``u0 = at.input``, the bias that the real
    controller adds. A linear plant acts on deviations: ``y = at.output + G (u - at.input)``.

    Parameters
    ----------
    plant : control.NonlinearIOSystem, control.StateSpace or control.TransferFunction
        Plant with one input and one output, continuous or with the sampling period `dt`.
    controller : TransferFunction, StateSpace, NonlinearIOSystem or PID, optional
        One input (r - y), or two inputs (r, y). A controller in discrete time and a `PID` hold
        their output between samples, a continuous one is an analog circuit. None: the loop is
        open, or the controller is unknown.
    dt : float
        Sampling period of the record [s].
    at : OperatingPoint, optional
        Operating point; by default all zero.
    free : sequence of str, optional
        Names of the plant parameters that are uncertain.
    input_limits : (float, float), optional
        Limits of the actuator [input unit]; the logged u is the limited one.

    Raises
    ------
    CtrlidError
        If a part does not fit: the message says which and what is needed.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    >>> op = cid.operating_point(plant, output=0.012)
    >>> C = cid.design_lead(cid.linearize(plant, op), crossover=100, phase_margin=50)
    >>> cid.Loop(plant, C, dt=0.001, at=op, free=("K",))
    Loop(maglev, analog controller, dt=0.001 s, at x = 0.012, V = 3.00146, free: K)
    """

    plant: Any
    controller: Any = None
    dt: float = 0.0
    at: OperatingPoint | None = None
    free: tuple[str, ...] = ()
    input_limits: tuple[float, float] = (-math.inf, math.inf)
    _traced: Equations = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not (isinstance(self.dt, int | float | np.number) and 0 < self.dt < math.inf):
            raise CtrlidError(f"a loop needs its sampling period dt > 0 s; given dt={self.dt!r}")
        equations = trace(self.plant)
        # A loop is a value: its equations are those of the plant at the time it was made.
        object.__setattr__(self, "_traced", equations)
        require_siso(equations)
        if equations.dt and self.plant.dt is not True and abs(equations.dt - self.dt) > 1e-9:
            raise CtrlidError(f"the plant is sampled at {equations.dt:g} s, the loop at "
                              f"{self.dt:g} s; give dt={equations.dt:g}")  # fmt: skip
        n = len(equations.states)
        at = self.at or OperatingPoint((0.0,) * n, 0.0, 0.0)
        if not isinstance(at, OperatingPoint):
            raise CtrlidError(
                "at= needs an OperatingPoint, from operating_point(plant, output=...) or given as "
                f"OperatingPoint(states=, input=, output=); given {type(at).__name__}"
            )
        if not self.linear_plant and len(at.states) != n:
            raise CtrlidError(f"at= has {len(at.states)} states, {equations.name} has {n}: "
                              f"{', '.join(equations.states)}")  # fmt: skip
        free = (self.free,) if isinstance(self.free, str) else tuple(self.free)
        unknown = [name for name in free if name not in equations.parameters]
        if unknown:
            raise CtrlidError(
                f"free= names {unknown}, but the numeric parameters of {equations.name} are "
                f"{list(equations.parameters)}; give parameters to ct.nlsys with params={{...}}"
            )
        try:
            lower, upper = (float(v) for v in self.input_limits)
        except (TypeError, ValueError) as reason:
            raise CtrlidError("input_limits is a pair (lower, upper) in input units; given "
                              f"{self.input_limits!r}") from reason  # fmt: skip
        if not lower < upper:
            raise CtrlidError(f"input_limits needs lower < upper; given ({lower:g}, {upper:g})")
        object.__setattr__(self, "dt", float(self.dt))
        object.__setattr__(self, "at", at)
        object.__setattr__(self, "free", free)
        object.__setattr__(self, "input_limits", (lower, upper))
        law = self.law()
        if law and law.dt == 0.0 and equations.dt:
            raise CtrlidError("an analog controller cannot act on a plant in discrete time; give "
                              "the plant in continuous time or sample the controller")  # fmt: skip
        if law and equations.feedthrough:
            raise CtrlidError(
                f"{equations.name} passes its input to its output without delay, so the loop with "
                "a controller is algebraic; add the sensor's or actuator's lag to the plant"
            )

    @property
    def linear_plant(self) -> bool:
        """Whether the plant is a linear system and so acts on deviations from `at`."""
        return isinstance(self.plant, ct.TransferFunction | ct.StateSpace)

    def equations(self) -> Equations:
        """Return the traced equations of the plant in absolute physical units."""
        e = self._traced
        if not self.linear_plant:
            return e
        at = self.point
        rhs = casadi.substitute(e.rhs, e.u, e.u - at.input)
        output = casadi.substitute(e.output, e.u, e.u - at.input) + at.output
        return replace(e, rhs=rhs, output=output)

    @property
    def point(self) -> OperatingPoint:
        """The operating point with the states of this very plant."""
        assert self.at is not None
        if not self.linear_plant:
            return self.at
        n = len(self._traced.states)
        return OperatingPoint((0.0,) * n, self.at.input, self.at.output)

    def law(self) -> ControlLaw | None:
        """Return the controller as equations, None where there is none."""
        if self.controller is None:
            return None
        assert self.at is not None
        return control_law(self.controller, self.at, self.dt)

    @property
    def analog(self) -> bool:
        """Whether the controller is an analog circuit, so that u moves between samples."""
        law = self.law()
        return law is not None and law.dt == 0.0

    def system(self) -> Any:
        """Return the plant in absolute physical units.

        Returns
        -------
        control.NonlinearIOSystem
            The plant as given, or a linear one with its operating point added.
        """
        if not self.linear_plant:
            return self.plant
        e = self.equations()

        def update(t: float, x: Any, u: Any, params: Mapping[str, Any]) -> Any:
            return e.evaluate(x, u)[0]

        def output(t: float, x: Any, u: Any, params: Mapping[str, Any]) -> Any:
            return e.evaluate(x, u)[1]

        return ct.nlsys(update, output, inputs=list(e.inputs), outputs=list(e.outputs),
                        states=list(e.states), dt=e.dt, name=e.name)  # fmt: skip

    def linearize(self) -> Any:
        """Return the plant linearized at the operating point.

        Returns
        -------
        control.TransferFunction
            From deviations of the input to deviations of the output.
        """
        if isinstance(self.plant, ct.TransferFunction):
            return self.plant
        return linearize(self.plant, self.point)

    def __repr__(self) -> str:
        e = self._traced
        assert self.at is not None
        kind = "no controller" if self.controller is None else (
            "analog controller" if self.analog else "digital controller")  # fmt: skip
        text = (f"Loop({e.name}, {kind}, dt={self.dt:g} s, at {e.outputs[0]} = "
                f"{self.at.output:g}, {e.inputs[0]} = {self.at.input:g}")  # fmt: skip
        if np.isfinite(self.input_limits).any():
            text += f", {e.inputs[0]} within {self.input_limits[0]:g}..{self.input_limits[1]:g}"
        if self.free:
            text += f", free: {', '.join(self.free)}"
        return text + ")"
