"""What an effect is: one piece of physics that a model may lack, as a value with parameters."""

import copy
import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import casadi

from .._base.arguments import check_fields, is_number
from .._base.errors import CtrlidError, EffectDoesNotApply
from ..physics.equations import Equations
from ..physics.linearization import OperatingPoint
from ..physics.symbols import Symbol
from .context import Moment, find_motion
from .parameters import Parameter, fill_unit
from .scanning import Overview, Range, Scan, Sight
from .symbolic import append_states, find_spread, trace_hook

Place = Literal["input", "force", "law", "output"]


@dataclass(frozen=True)
class AbstractEffect:
    """One piece of physics that a model may lack.

    An effect is a frozen dataclass: fields declared with `parameter` are its parameters, other
    fields (the name of a state, for instance) are structure. A subclass of one of the bases
    `InputEffect`, `ForceEffect`, `LawEffect`, `OutputEffect` or `ReadingEffect` writes its formula
    in one method, with ordinary arithmetic and numpy.
    """

    place: ClassVar[Place]
    # Effects are applied in this order, from the plant's equations outwards.
    stage: ClassVar[int]
    look_alikes: ClassVar[tuple[str, ...]] = ()
    sentence: ClassVar[str] = ""
    experiment: ClassVar[str] = ""
    states: ClassVar[tuple[str, ...]] = ()
    # These parameters have other values in another record.
    private: ClassVar[tuple[str, ...]] = ()
    # False says that the effect has no part in small deviations from rest.
    in_linear_model: ClassVar[bool] = True
    ordered: ClassVar[bool] = (
        False  # True: a signal passes it, so that its turn among others counts
    )
    # True says that a plant may have several effects of this class at once.
    repeatable: ClassVar[bool] = False
    # This says why several effects of this class at once prove little.
    doubt_of_several: ClassVar[str | None] = None

    def __post_init__(self) -> None:
        kind = type(self).__name__
        check_fields(self, *(p.name for p in self.parameters()))
        for p in self.parameters():
            value = getattr(self, p.name)
            if not is_number(value):
                raise CtrlidError(f"{kind} needs a number for {p.name}; given {value!r}")
            value = float(value)
            # An infinite value is a limit that is never met.
            if math.isnan(value) or (math.isinf(value) and value not in (p.lower, p.upper)):
                raise EffectDoesNotApply(f"{kind} needs a finite {p.name}; given {value!r}")
            if math.isinf(value) and (p.neutral is None or not math.isinf(p.neutral)):
                raise EffectDoesNotApply(f"{kind} needs a finite {p.name}; given {value!r}")
            if not p.lower <= value <= p.upper:
                raise EffectDoesNotApply(
                    f"{kind} needs {p.name} between {p.lower:g} and {p.upper:g} "
                    f"[{fill_unit(p.unit)}]; given {value:g}"
                )
            object.__setattr__(self, p.name, value)
        self.check()

    def check(self) -> None:
        """Refuse values that do not fit together by `EffectDoesNotApply`; nothing by default."""

    def doubt(self) -> str | None:
        """Say why values that were fitted cannot be this effect; by default None, for they can."""
        return None

    def limits(self, seen: Range) -> dict[str, tuple[float, float]]:
        """Return what a record limits parameters to, beyond their own bounds; nothing by default.

        Parameters
        ----------
        seen : Range
            What the record covers: period, duration, travel, speed.

        Returns
        -------
        dict of str to (float, float)
            Lower and upper limit by the name of the parameter.
        """
        del seen
        return {}

    def scan(self, sight: Sight) -> Scan | None:
        """Return the places at which the effect was looked for; None to screen it as it is.

        An effect whose likelihood has many maxima, over a frequency, a length or a time, says here
        where a fit may start.

        Parameters
        ----------
        sight : Sight
            What a fitted model sees of the records.

        Returns
        -------
        Scan or None
            Starts, the number of places, and what else may be it.
        """
        del sight
        return None

    @classmethod
    def is_scanned(cls) -> bool:
        """Whether the effect looks for its place in a record, which takes time."""
        return cls.scan is not AbstractEffect.scan

    def other_starts(self, sight: Sight) -> tuple[Self, ...]:
        """Return starts far from this one, for a likelihood with maxima far apart; none by default.

        Parameters
        ----------
        sight : Sight
            As in `scan`.
        """
        del sight
        return ()

    def spread_starts(self, sight: Overview) -> tuple[Self, ...]:
        """Return starts of a fit by simulation, where no score tells them apart; itself by default.

        Parameters
        ----------
        sight : Overview
            What the simulation sees of the records: times, states, and the strongest line.
        """
        del sight
        return (self,)

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
        """Return the unit of each parameter, in those of a loop if they are known."""
        signals: dict[str, str] = {}
        if loop is not None:
            known: Mapping[str, str] = loop.known_units
            e = loop.equations()
            names = {"u": e.inputs[0], "y": e.outputs[0], "x": getattr(self, "name", "")}
            signals = {key: known[name] for key, name in names.items() if name in known}
        return {p.name: fill_unit(p.unit, signals) for p in self.parameters()}

    def text(self, loop: Any = None) -> str:
        """Return the effect in words, with the units of a loop if one is given."""
        units = self.units(loop)
        parts = []
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            if value == "":
                continue
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
        return tuple(e for e in effects if _can_take(loop, e))

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
        EffectDoesNotApply
            If the effect makes no sense for this plant.
        """
        symbolic = copy.copy(self)
        symbols = []
        for p in self.parameters():
            symbols.append(casadi.SX.sym(f"{label}.{p.name}"))
            object.__setattr__(symbolic, p.name, Symbol(symbols[-1]))
        own = {name: casadi.SX.sym(f"{label}.{name}") for name in self.states}
        if own and equations.dt:
            raise EffectDoesNotApply(
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
            spread=find_spread(equations),
        )
        m = Moment(e, at, dt, {name: Symbol(s) for name, s in own.items()})
        rates = tuple(trace_hook(symbolic.rates)(m))
        if len(rates) != len(own):
            raise CtrlidError(f"{type(self).__name__}.rates returned {len(rates)} rates for the "
                              f"states {self.states}")  # fmt: skip
        changed = type(self).build(symbolic, e, m)
        return append_states(changed, label, own, rates, self.rest(at))


def _can_take(loop: Any, effect: AbstractEffect) -> bool:
    try:
        loop.with_effect(effect)
    except EffectDoesNotApply:
        return False
    return True


def require_motion(effect: AbstractEffect, e: Equations) -> tuple[int, int]:
    """Return the indices of position and velocity, or refuse."""
    found = find_motion(e)
    if found is None:
        raise EffectDoesNotApply(
            f"{type(effect).__name__} acts on a moving mass, but no state of {e.name} is the rate "
            f"of another one ({', '.join(e.states)}); write the plant with position and velocity "
            "as states, dx/dt = v"
        )
    return found
