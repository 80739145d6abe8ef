"""What an effect is: one piece of physics that a model may lack, as a value with parameters."""

import copy
import dataclasses
import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import casadi
import numpy as np

from ..errors import CtrlidError
from ..linearization import OperatingPoint
from ..physics import Equations, Lag
from ..tracing import Symbol, rebind
from .moment import Follow, Moment, motion

Place = Literal["input", "force", "law", "output"]


@dataclass(frozen=True)
class Parameter:
    """What is known about one parameter of an effect.

    `unit` is a template in which ``{u}``, ``{y}`` and ``{x}`` stand for the units of the input, the
    output and the state that the effect names. `neutral` is the value at which the effect vanishes,
    None for a parameter that does not decide this, such as the frequency of a vibration.
    """

    name: str
    unit: str
    lower: float
    upper: float
    neutral: float | None


def parameter(
    unit: str,
    *,
    lower: float = -math.inf,
    upper: float = math.inf,
    neutral: float | None = None,
    default: Any = dataclasses.MISSING,
) -> Any:
    """Declare a numeric field of an effect.

    Parameters
    ----------
    unit : str
        Unit, with ``{u}`` and ``{y}`` for the units of input and output; "" for a plain number.
    lower, upper : float, optional
        Physical bounds, included.
    neutral : float, optional
        The value at which the effect vanishes; none if this parameter does not decide it.
    default : float, optional
        Value of the field if it is not given.

    Returns
    -------
    dataclasses.Field
        The field.
    """
    about = {"unit": unit, "lower": lower, "upper": upper, "neutral": neutral}
    if default is dataclasses.MISSING:
        return dataclasses.field(metadata={"parameter": about})
    return dataclasses.field(default=default, metadata={"parameter": about})


@dataclass(frozen=True)
class AbstractEffect:
    """One piece of physics that a model may lack.

    An effect is a frozen dataclass: fields declared with `parameter` are its parameters, other
    fields (the name of a state, for instance) are structure. A subclass of one of the bases
    `InputEffect`, `ForceEffect`, `LawEffect`, `OutputEffect` or `ReadingEffect` writes its formula
    in one method, with ordinary arithmetic and numpy.
    """

    place: ClassVar[Place]
    stage: ClassVar[int]  # effects are applied from the plant's law outwards
    look_alikes: ClassVar[tuple[str, ...]] = ()
    sentence: ClassVar[str] = ""
    experiment: ClassVar[str] = ""
    states: ClassVar[tuple[str, ...]] = ()
    in_linear_model: ClassVar[bool] = True  # False: no part of small deviations from rest

    def __post_init__(self) -> None:
        kind = type(self).__name__
        for p in self.parameters():
            value = getattr(self, p.name)
            if isinstance(value, bool) or not isinstance(value, int | float | np.number):
                raise CtrlidError(f"{kind} needs a number for {p.name}; given {value!r}")
            value = float(value)
            # An infinite value is a limit that is never met.
            if math.isnan(value) or (math.isinf(value) and value not in (p.lower, p.upper)):
                raise CtrlidError(f"{kind} needs a finite {p.name}; given {value!r}")
            if math.isinf(value) and (p.neutral is None or not math.isinf(p.neutral)):
                raise CtrlidError(f"{kind} needs a finite {p.name}; given {value!r}")
            if not p.lower <= value <= p.upper:
                raise CtrlidError(f"{kind} needs {p.name} between {p.lower:g} and {p.upper:g} "
                                  f"[{_fill(p.unit)}]; given {value:g}")  # fmt: skip
            object.__setattr__(self, p.name, value)
        self.check()

    def check(self) -> None:
        """Refuse values that do not fit together; nothing by default."""

    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:
        """Return what is known about each parameter."""
        return tuple(
            Parameter(f.name, **f.metadata["parameter"])
            for f in dataclasses.fields(cls)
            if "parameter" in f.metadata
        )

    def values(self) -> dict[str, float]:
        """Return the values of the parameters."""
        return {p.name: getattr(self, p.name) for p in self.parameters()}

    @property
    def neutral(self) -> bool:
        """Whether the effect changes nothing at its present values."""
        deciding = [p for p in self.parameters() if p.neutral is not None]
        return bool(deciding) and all(getattr(self, p.name) == p.neutral for p in deciding)

    def units(self, loop: Any = None) -> dict[str, str]:
        """Return the unit of each parameter, in those of a loop's plant if they are known."""
        signals: dict[str, str] = {}
        if loop is not None:
            known: Mapping[str, str] = getattr(loop.plant, "units", {})
            e = loop.equations()
            names = {"u": e.inputs[0], "y": e.outputs[0], "x": getattr(self, "name", "")}
            signals = {key: known[name] for key, name in names.items() if name in known}
        return {p.name: _fill(p.unit, signals) for p in self.parameters()}

    def text(self, loop: Any = None) -> str:
        """Return the effect in words, with the units of a loop's plant if one is given."""
        units = self.units(loop)
        parts = []
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            shown = f"{value:.4g} {units[f.name]}" if f.name in units else str(value)
            parts.append(f"{f.name} = {shown.strip()}")
        return f"{type(self).__name__}: {', '.join(parts)}"

    def __str__(self) -> str:
        return self.text()

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return instances to start a fit from: neutral, where the derivative there is of use.

        Parameters
        ----------
        loop : Loop
            The loop that may lack the effect.
        record : Record, optional
            Data, which set the scale.

        Returns
        -------
        tuple of effects
            Empty where the effect makes no sense for the plant.
        """
        neutral = {p.name: p.neutral for p in cls.parameters()}
        structure = [f for f in dataclasses.fields(cls) if "parameter" not in f.metadata]
        if structure or any(v is None for v in neutral.values()):
            return ()
        return cls._applicable(loop, cls(**neutral))

    @classmethod
    def _applicable(cls, loop: Any, *effects: Any) -> tuple[Any, ...]:
        """Keep those that the loop's plant takes."""
        return tuple(e for e in effects if _takes(loop, e))

    def rates(self, m: Moment) -> Sequence[Any]:
        """Return the rates of the effect's own `states`; `m.own` holds their symbols."""
        del m
        return ()

    def rest(self, at: OperatingPoint) -> tuple[float, ...]:
        """Return the values at rest of the effect's own `states`."""
        del at
        return (0.0,) * len(self.states)

    def build(self, e: Equations, m: Moment) -> Equations:
        """Return the changed equations; `self` has symbols in place of numbers."""
        raise NotImplementedError

    def apply(self, equations: Equations, at: OperatingPoint, dt: float, label: str) -> Equations:
        """Return equations with this effect in them.

        Parameters
        ----------
        equations : Equations
            The equations so far, in absolute physical units.
        at : OperatingPoint
            The point that deviations are counted from.
        dt : float
            Sampling period [s].
        label : str
            Name of the effect; its parameters become ``label.parameter``.

        Returns
        -------
        Equations
            New equations with the parameters of the effect appended to `parameters` and `p`.

        Raises
        ------
        CtrlidError
            If the effect makes no sense for this plant.
        """
        symbolic = copy.copy(self)
        symbols = []
        for p in self.parameters():
            symbols.append(casadi.SX.sym(f"{label}.{p.name}"))
            object.__setattr__(symbolic, p.name, Symbol(symbols[-1]))
        own = {name: casadi.SX.sym(f"{label}.{name}") for name in self.states}
        if own and equations.dt:
            raise CtrlidError(
                f"{type(self).__name__} is a motion in continuous time, but {equations.name} is "
                f"sampled at {equations.dt:g} s; give the plant in continuous time"
            )
        values = {f"{label}.{name}": value for name, value in self.values().items()}
        clash = values.keys() & equations.parameters.keys()
        if clash:
            raise CtrlidError(f"there is already an effect with the parameter {min(clash)}; give "
                              "each effect its own label")  # fmt: skip
        e = dataclasses.replace(
            equations,
            p=casadi.vertcat(equations.p, *symbols),
            parameters={**equations.parameters, **values},
            spread=_spread(equations),
        )
        m = Moment(e, at, dt, {name: Symbol(s) for name, s in own.items()})
        rates = tuple(traced(symbolic.rates)(m))
        if len(rates) != len(own):
            raise CtrlidError(f"{type(self).__name__}.rates returned {len(rates)} rates for the "
                              f"states {self.states}")  # fmt: skip
        changed = type(self).build(symbolic, e, m)
        return _with_states(changed, label, own, rates, self.rest(at))


def traced(hook: Any) -> Any:
    """Return a hook that computes with symbols where it says numpy or math."""
    return rebind(hook) if inspect.ismethod(hook) else hook


def expression(value: Any) -> Any:
    """Return what a hook returned as a CasADi expression."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    return value.sx if isinstance(value, Symbol) else casadi.SX(float(value))


def substituted(e: Equations, old: Any, new: Any) -> Equations:
    """Return the equations with an expression in place of a symbol, wherever the plant has it."""
    rhs, output = (casadi.substitute(f, old, new) for f in (e.rhs, e.output))
    lags = tuple(
        Lag(lag.state, lag.time_constant, casadi.substitute(lag.target, old, new))
        for lag in e.lags
    )  # fmt: skip
    return dataclasses.replace(e, rhs=rhs, output=output, lags=lags)


def _spread(e: Equations) -> Any:
    return casadi.SX.sym("s", len(e.states)) if e.spread is None else e.spread


def _with_states(
    e: Equations, label: str, own: Mapping[str, Any], rates: Sequence[Any], rest: Sequence[float]
) -> Equations:
    """Append an effect's own states to the equations."""
    if not own:
        return e
    n, lags, columns = len(e.states), list(e.lags), []
    for k, rate in enumerate(rates):
        if isinstance(rate, Follow):
            tau, target = expression(rate.time_constant), expression(rate.target)
            tau = casadi.fmax(tau, rate.shortest)
            lags.append(Lag(n + k, tau, target))
            columns.append((target - list(own.values())[k]) / tau)
        else:
            columns.append(expression(rate))
    return dataclasses.replace(
        e,
        states=(*e.states, *(f"{label}.{name}" for name in own)),
        x=casadi.vertcat(e.x, *own.values()),
        rhs=casadi.vertcat(e.rhs, *columns),
        spread=casadi.vertcat(e.spread, *(casadi.SX.sym("s") for _ in own)),
        lags=tuple(lags),
        rest=(*e.rest, *(float(v) for v in rest)),
    )


def _takes(loop: Any, effect: AbstractEffect) -> bool:
    try:
        loop.with_effect(effect)
    except CtrlidError:
        return False
    return True


def _fill(unit: str, signals: Mapping[str, str] | None = None) -> str:
    known = {"u": "[u]", "y": "[y]", "x": "[state]", **(signals or {})}
    return unit.format(**known)


def require_motion(effect: AbstractEffect, e: Equations) -> tuple[int, int]:
    """Return the indices of position and velocity, or refuse."""
    found = motion(e)
    if found is None:
        raise CtrlidError(
            f"{type(effect).__name__} acts on a moving mass, but no state of {e.name} is the rate "
            f"of another one ({', '.join(e.states)}); write the plant with position and velocity "
            "as states, dx/dt = v"
        )
    return found
