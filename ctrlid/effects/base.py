"""What an effect is: one piece of physics that a model may lack, as a value with parameters."""

import copy
import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NoReturn, Self

import casadi

from .._base.arguments import CheckedCalls, ShownFields, check_fields, is_number
from .._base.errors import CtrlidError, EffectDoesNotApply
from ..physics.equations import Equations
from ..physics.linearization import OperatingPoint
from ..physics.symbols import Symbol
from .context import Moment, find_motion
from .parameters import Parameter, fill_unit, write_unit
from .scanning import Overview, Range, Scan, Sight
from .symbolic import append_states, find_spread, trace_hook

Place = Literal["input", "force", "law", "output"]
# What the name of a place is, in words.
PLACES = {"input": "an input", "force": "a velocity", "law": "no place", "output": "an output"}


def refuse_missing_formula(base: str, method: str) -> NoReturn:
    """Refuse an effect of a user in which the one method of its base is not written.

    Parameters
    ----------
    base : str
        Name of the base class.
    method : str
        Name of the method.

    Raises
    ------
    CtrlidError
        Always.
    """
    raise CtrlidError(
        f"a subclass of {base} needs a method {method} with its formula, and the one given has "
        "none. Write it, or look whether its name is misspelt"
    )


@dataclass(frozen=True)
class AbstractEffect(metaclass=CheckedCalls):
    """One piece of physics that a model may lack.

    An effect is a frozen dataclass: fields declared with `parameter` are its parameters, other
    fields (the name of a state, for instance) are structure. A subclass of one of the bases
    `InputEffect`, `ForceEffect`, `LawEffect`, `OutputEffect` or `ReadingEffect` writes its formula
    in one method, with ordinary arithmetic and numpy.

    Parameters
    ----------
    at : str, optional
        Where it acts: the name of an input, of a velocity (a force) or of an output of the plant.
        Needed where the plant has several of them. A force acts through the mass matrix where the
        loop knows which input works on the velocity (`Loop.forces`), and its parameters are then in
        the unit of that input; else it accelerates this coordinate alone.
    """

    # A name; type checkers see that `dataclasses.replace` with values of parameters is sound.
    at: Any = dataclasses.field(default="", kw_only=True, repr=False)

    place: ClassVar[Place]
    # Effects are applied in this order, from the plant's equations outwards.
    stage: ClassVar[int]
    look_alikes: ClassVar[tuple[str, ...]] = ()
    sentence: ClassVar[str] = ""
    experiment: ClassVar[str] = ""
    # The names of look-alikes that another experiment tells it from, with that experiment.
    experiment_against: ClassVar[Mapping[str, str]] = {}
    states: ClassVar[tuple[str, ...]] = ()
    # These parameters have other values in another record.
    private: ClassVar[tuple[str, ...]] = ()
    # False says that the effect has no part in small deviations from rest.
    in_linear_model: ClassVar[bool] = True
    # True says that a signal passes the effect, so that its turn among others counts.
    ordered: ClassVar[bool] = False
    # True says that a plant may have several effects of this class at once.
    repeatable: ClassVar[bool] = False
    # This says why several effects of this class at once prove little.
    doubt_of_several: ClassVar[str | None] = None
    # This names the parameter that is a force which is always there; empty if there is none.
    constant_force: ClassVar[str] = ""

    # Help shows the fields of each effect.
    __signature__ = ShownFields()

    def __new__(cls, *args: Any, **fields: Any) -> Self:
        """Refuse a class that declares parameters and is no dataclass."""
        del args, fields
        # The decorator takes the declarations of parameters away.
        bare = [name for name, value in vars(cls).items() if isinstance(value, dataclasses.Field)]
        if bare:
            raise CtrlidError(
                f"{cls.__name__} declares {', '.join(bare)}, but is no dataclass: write "
                "@dataclass(frozen=True) in the line above its class"
            )
        return super().__new__(cls)

    def __post_init__(self) -> None:
        kind = type(self).__name__
        check_fields(self, *(p.name for p in self.parameters()))
        for p in self.parameters():
            value = getattr(self, p.name)
            called = f"{p.name}{write_unit(p.unit)}"
            if not is_number(value):
                raise CtrlidError(f"{kind} needs a number for {called}; given {value!r}")
            value = float(value)
            # An infinite value is a limit that is never met.
            if math.isnan(value) or (math.isinf(value) and value not in (p.lower, p.upper)):
                raise EffectDoesNotApply(f"{kind} needs a finite {called}; given {value!r}")
            if math.isinf(value) and (p.neutral is None or not math.isinf(p.neutral)):
                raise EffectDoesNotApply(f"{kind} needs a finite {called}; given {value!r}")
            if not p.lower <= value <= p.upper:
                raise EffectDoesNotApply(
                    f"{kind} needs {p.name} between {p.lower:g} and {p.upper:g}"
                    f"{write_unit(p.unit)}; given {value:g}"
                )
            object.__setattr__(self, p.name, value)
        self.check()

    def check(self) -> None:
        """Refuse values that do not fit together by `EffectDoesNotApply`; nothing by default."""

    @property
    def called(self) -> str:
        """What reports call it: its class."""
        return type(self).__name__

    def doubt(self) -> str | None:
        """Say why values that were fitted cannot be this effect; by default None, for they can."""
        return None

    def question(self, dt: float) -> str | None:
        """Say what is odd about its values at a sampling period; by default None, for nothing is.

        Parameters
        ----------
        dt : float
            Sampling period of the loop [s].
        """
        del dt
        return None

    def disguise(self, e: Equations) -> str | None:
        """Say what has no name in the catalogue and reads alike on a plant; by default None.

        Parameters
        ----------
        e : Equations
            The plant.
        """
        del e
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

    @property
    def limited_states(self) -> tuple[str, ...]:
        """States that have a limit, which a linear model takes as it is at the point; none here.

        Other kinks are left out of it, as in motion that is large against them.
        """
        return ()

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
        """Return the values of the parameters, without an optional one that is not made use of."""
        return {p.name: getattr(self, p.name) for p in self._list_used()}

    def _list_used(self) -> list[Parameter]:
        """Return the parameters without an optional one at zero."""
        return [p for p in self.parameters() if not (p.optional and getattr(self, p.name) == 0)]

    @property
    def neutral(self) -> bool:
        """Whether the effect changes nothing at its present values."""
        deciding = [p for p in self.parameters() if p.neutral is not None]
        return bool(deciding) and all(getattr(self, p.name) == p.neutral for p in deciding)

    def units(self, loop: Any = None) -> dict[str, str]:
        """Return the unit of each parameter, in those of a loop if they are known."""
        signals: dict[str, str] = {}
        if loop is not None:
            e, known = loop.equations(), loop.known_units
            inputs, outputs = (
                names.index(self.at) if self.at in names else 0 for names in (e.inputs, e.outputs)
            )
            names = {"u": e.inputs[inputs], "y": e.outputs[outputs],
                     "x": getattr(self, "name", "")}  # fmt: skip
            signals = {key: known[name] for key, name in names.items() if name in known}
            if self.place in ("force", "law"):
                # These are counted in the unit of the position, which an output may show scaled.
                at = self.at if self.place == "force" else ""
                signals["y"] = loop.position_units.get(at, loop.position_unit)
                if at:
                    return self._find_force_units(e, signals)
        return {p.name: fill_unit(p.unit, signals) for p in self._list_used()}

    def _find_force_units(self, e: Equations, signals: Mapping[str, str]) -> dict[str, str]:
        """Return the units of a force at a velocity: an acceleration, or that of its input."""
        found, position = find_motion(e, self.at), signals["y"]
        units = {p.name: fill_unit(p.unit, signals) for p in self._list_used()}
        force = ""
        if found is not None and e.push_units:
            force = e.push_units[e.velocities.index(found[1])]
        if not force:
            return units
        # Of accelerations and what is counted per velocity or position, these are the forces.
        u = signals.get("u") or "[u]"
        forces = {
            "{y}/s^2": force, "1/s": f"{force} s/{position}", "1/s^2": f"{force}/{position}",
            "1/{y}": f"{force} s^2/{position}^2", "1/(s^2 {y}^2)": f"{force}/{position}^3",
            "1/(s {u}^2)": f"{force} s/({position} {u}^2)",
        }  # fmt: skip
        return {p.name: forces.get(p.unit, units[p.name]) for p in self._list_used()}

    def text(self, loop: Any = None) -> str:
        """Return the effect in words, with the units of a loop if one is given."""
        units = self.units(loop)
        parts = []
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            if value == "" or f.name == "at":
                continue
            if "parameter" in f.metadata and f.name not in units:
                continue
            shown = f"{value:.4g} {units[f.name]}" if f.name in units else str(value)
            parts.append(f"{f.name} = {shown.strip()}")
        where = f" at {self.at}" if self.at else ""
        return f"{type(self).__name__}{where}: {', '.join(parts)}"

    def __str__(self) -> str:
        return self.text()

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return instances to start a fit from: neutral, where the derivative there is of use.

        A parameter that has no neutral value starts from its default.

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
        if cls.list_undecided():
            return ()
        neutral = {p.name: p.neutral for p in cls.parameters() if p.neutral is not None}
        return cls._applicable(loop, cls(**neutral))

    @classmethod
    def list_undecided(cls) -> list[str]:
        """Return the fields that keep `candidates` from proposing anything.

        They have neither a neutral value nor a default, or say what the effect acts on.
        """
        fields = [f for f in dataclasses.fields(cls) if f.name != "at"]
        neutral = {p.name: p.neutral for p in cls.parameters()}
        return [f.name for f in fields if f.name not in neutral
                or (neutral[f.name] is None and f.default is dataclasses.MISSING)]  # fmt: skip

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
        refuse_missing_formula("AbstractEffect", "build(self, e, m)")

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
        for name in self.values():
            symbols.append(casadi.SX.sym(f"{label}.{name}"))
            object.__setattr__(symbolic, name, Symbol(symbols[-1]))
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
        here = self._find_place(e)
        own_point = at
        if not e.siso:
            own_point = OperatingPoint(at.states, at.inputs[here[0]], at.outputs[here[1]])
        own_states = {name: Symbol(s) for name, s in own.items()}
        m = Moment(e, own_point, dt, own_states, *here, named=bool(self.at))
        rates = tuple(trace_hook(symbolic.rates)(m))
        if len(rates) != len(own):
            raise CtrlidError(f"{type(self).__name__}.rates returned {len(rates)} rates for the "
                              f"states {self.states}")  # fmt: skip
        changed = type(self).build(symbolic, e, m)
        return append_states(changed, label, own, rates, self.rest(own_point))

    def _find_place(self, e: Equations) -> tuple[int, int, tuple[int | None, int] | None]:
        """Return which input, which output and which position and velocity the effect is about."""
        velocities = tuple(e.states[j] for j in e.velocities)
        names = {"input": e.inputs, "output": e.outputs, "force": velocities, "law": ()}[self.place]
        kind = type(self).__name__
        if self.at and self.at not in names:
            raise EffectDoesNotApply(
                f"{kind} acts at {PLACES[self.place]}; given at={self.at!r}, but {e.name} has "
                f"{', '.join(names) or 'none'}"
            )
        if not self.at and not e.siso and len(names) > 1:
            raise EffectDoesNotApply(
                f"{kind} acts at {PLACES[self.place]}, and {e.name} has several: say which with "
                f"at=, one of {', '.join(names)}"
            )
        at = names.index(self.at) if self.at else 0
        motion = find_motion(e, self.at) if self.place == "force" and self.at else None
        return (at if self.place == "input" else 0, at if self.place == "output" else 0, motion)


def name_at_place(effect: AbstractEffect) -> str:
    """Return what an effect is called, with its place on a plant that has several.

    Examples
    --------
    >>> import ctrlid as cid
    >>> name_at_place(cid.effects.CoulombFriction(fc=0.2, at="theta_dot"))
    'CoulombFriction at theta_dot'
    """
    return f"{effect.called} at {effect.at}" if effect.at else effect.called


def find_own_module(effect: AbstractEffect) -> str:
    """Return the module of an effect that a user wrote; empty for one of ctrlid."""
    module = type(effect).__module__
    return "" if module.startswith("ctrlid.") else module


def name_with_subject(effect: AbstractEffect) -> str:
    """Return what a report calls an effect: its name, of which parameter or state, and its place.

    Two drifts are told apart by their parameters only.

    Examples
    --------
    >>> import ctrlid as cid
    >>> name_with_subject(cid.effects.ParameterDrift("K", rate=0.1))
    'ParameterDrift of K'
    >>> name_with_subject(cid.effects.ParameterError("K", error=0.1))
    'parameter K'
    >>> name_with_subject(cid.effects.CoulombFriction(fc=0.2, at="theta_dot"))
    'CoulombFriction at theta_dot'
    """
    subject = getattr(effect, "name", "")
    if not (isinstance(subject, str) and subject and effect.called == type(effect).__name__):
        return name_at_place(effect)
    return name_at_place(effect).replace(effect.called, f"{effect.called} of {subject}", 1)


def _can_take(loop: Any, effect: AbstractEffect) -> bool:
    try:
        loop.with_effect(effect)
    except EffectDoesNotApply:
        return False
    return True


def require_motion(effect: AbstractEffect, e: Equations) -> tuple[int | None, int]:
    """Return the indices of position, if it is a state, and velocity, or refuse."""
    found = find_motion(e, effect.at if effect.place == "force" else "")
    if found is None:
        raise EffectDoesNotApply(
            f"{type(effect).__name__} acts on a moving mass, but no state of {e.name} is the rate "
            f"of another one ({', '.join(e.states)}); write the plant with position and velocity "
            f"as states, dx/dt = v, or say that a state is a speed: Loop(..., "
            f"forces={{{e.states[-1]!r}: None}})"
        )
    return found


def require_position(effect: AbstractEffect, e: Equations) -> tuple[int, int]:
    """Return the indices of position and velocity, or refuse."""
    position, velocity = require_motion(effect, e)
    if position is None:
        raise EffectDoesNotApply(
            f"{type(effect).__name__} needs the position of {e.states[velocity]}, which is no "
            f"state of {e.name}"
        )
    return position, velocity
