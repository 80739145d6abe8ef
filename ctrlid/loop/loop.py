"""The loop: a plant under control, in absolute physical units."""

import functools
import math
import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import casadi
import control as ct
import numpy as np

from .._base.arguments import check_arguments, explain_fields, is_number
from .._base.errors import CtrlidError, EffectDoesNotApply
from .._base.periods import have_same_period, write_both_periods
from .._base.pickling import pack_by_value
from .._base.text import Printed, list_known, write_count, write_percent
from ..effects import AbstractEffect, Quantization
from ..effects.composition import compose_effects, label_effects
from ..effects.context import find_position_unit, find_state_units
from ..effects.python_control import as_system, linearize_with_effects
from ..physics.equations import Equations, drive_inputs
from ..physics.linearization import (
    OperatingPoint,
    as_operating_point,
    find_unbalanced_rate,
    linearize,
    make_state_space,
)
from ..physics.trace import trace, with_parameters
from .controllers import PID, ControlLaw, make_control_law
from .loop_arguments import (
    check_effects,
    check_free,
    check_limits,
    check_units,
    question_beliefs,
    question_effects,
)
from .velocities import describe_missing_forces, list_unforced_velocities
from .wiring import Wiring, is_wired_by_name, make_wired_law, make_wiring

# The output of an operating point is another than the plant's by more than this share.
OTHER_OUTPUT = 0.05


@explain_fields
@dataclass(frozen=True, eq=False, repr=False)
class Loop(Printed):
    """A plant, its controller and the point around which they work.

    .. math:: u = u_0 + C(r - y)

    with all signals in absolute physical units and ``u0 = at.input``, the bias that the real
    controller adds. A linear plant acts on deviations: ``y = at.output + G (u - at.input)``.

    A controller of a plant with several signals is wired by name, as `control.interconnect` does
    it: inputs called after the plant's outputs and inputs (or ``y[i]`` and ``u[i]``) read these,
    and its signals are absolute. Its other inputs are references by name; where the record has
    none, ``xd[i]`` and ``ud[i]`` of `control.create_statefbk_iosystem` are held at the states and
    inputs of `at`. Without names of its own (``u[0], u[1], ...``) it reads r - y, or r and then y.
    `print` lists the wiring.

    Parameters
    ----------
    plant : control.NonlinearIOSystem, control.StateSpace or control.TransferFunction
        The plant, continuous or with the sampling period `dt`.
    controller : TransferFunction, StateSpace, NonlinearIOSystem or PID, optional
        One input (r - y), or two inputs (r, y), of which the one that is called y or as the output
        of the plant is y; or several, wired as above. A controller in
        discrete time and a `PID` hold their output between samples, a continuous one is an analog
        circuit. None: the loop is open, or the controller is unknown.
    dt : float
        Sampling period of the record [s].
    at : OperatingPoint or control.OperatingPoint, optional
        Operating point; by default all zero, which a plant must be defined at.
    free : sequence of str, or mapping of str to float, optional
        Names of the plant parameters that are uncertain; ``{"K": 0.1}`` also says how well each is
        known, by the standard deviation of what is believed, as a share of the value that the loop
        has. Fits weigh that against the data, as a Gaussian prior; infinite is a name alone.
    input_limits : (float, float), optional
        Limits of the actuator [input unit]; the logged u is the limited one. Each may be a sequence
        with a value for each input.
    effects : sequence of effects, optional
        Physics that the plant lacks, from `ctrlid.effects`; `with_effect` adds one. Each is known
        by its class name, a second one of a class by name and number: "ViscousFriction2".
    units : mapping of str to str, optional
        Units of signals, states and parameters of the plant by their names, such as
        ``{"theta": "rad", "tau": "N m", "J": "kg m^2"}``; by default those in the attribute `units`
        of the plant, which the plants of `ctrlid.plants` have. Sizes of effects are written in
        them, and as forces if the output is in m and one parameter in kg, or as torques if it is
        in rad and one in kg m^2.
    driven : sequence of str, optional
        The inputs that the record has, in its order; the others are zero. By default all.
    forces : mapping of str to str, optional
        Which input of the plant works on which velocity, ``{"x_dot": "F", "theta_dot": "tau"}``:
        random forces act there, through the mass matrix. By default as a plant of `plants` has it;
        else each velocity is pushed alone. A state that is a speed, though its position is no
        state, becomes a velocity in this way: a motor with a tachometer, ``{"omega": "tau"}``, or
        ``{"omega": None}`` where no input is its torque, may then have friction.
    sharpness : float, optional
        The factor by which dry friction and stops among the effects bring a mass to rest faster
        than in a quarter of a sampling period: 1, or more. `fit_loop` and `diagnose` find out
        which makes a record most probable.

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
    free: tuple[str, ...] | Mapping[str, float] = ()
    input_limits: tuple[float, float] = (-math.inf, math.inf)
    effects: tuple[AbstractEffect, ...] = field(default=(), kw_only=True)
    units: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    driven: tuple[str, ...] = field(default=(), kw_only=True)
    forces: Mapping[str, str | None] | None = field(default=None, kw_only=True)
    sharpness: float = field(default=1.0, kw_only=True)
    _traced: Equations = field(init=False, repr=False)
    _active: Equations = field(init=False, repr=False)
    _kept: Equations = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not (is_number(self.dt) and 0 < self.dt < math.inf):
            raise CtrlidError("a loop needs its sampling period dt > 0 s, as in Loop(plant, "
                              f"controller, dt=0.001); given dt={self.dt!r}")  # fmt: skip
        if not (is_number(self.sharpness) and 1 <= self.sharpness < math.inf):
            raise CtrlidError(
                "sharpness= says how many times faster than in a quarter of a sampling period "
                f"friction stops a mass, 1 or more; given {self.sharpness!r}"
            )
        equations, inputs = self._trace_plant()
        # A loop is a value: its equations are those of the plant at the time it was made.
        object.__setattr__(self, "_traced", equations)
        own = equations.dt and self.plant.dt is not True
        if own and not have_same_period(equations.dt, self.dt):
            both = write_both_periods("the plant is sampled", equations.dt, "the loop", self.dt)
            raise CtrlidError(f"{both}; give dt={equations.dt:.10g}")
        n = len(equations.states)
        if self.at is None and not np.isfinite(equations.evaluate(np.zeros(n), 0.0)[0]).all():
            raise CtrlidError(f"{equations.name} is not defined where all its signals are zero; "
                              "give at=operating_point(plant, output=...)")  # fmt: skip
        still: Any = [(0.0,) * len(names) for names in (equations.inputs, equations.outputs)]
        given = OperatingPoint((0.0,) * n, *still) if self.at is None else self.at
        at = as_operating_point(given, equations, inputs)
        if not self.linear_plant and len(at.states) != n:
            raise CtrlidError(
                f"at= has {write_count(len(at.states), 'state')}, but {equations.name} has {n} "
                f"({', '.join(equations.states)}); give at=operating_point(plant, output=...)"
            )
        limits = check_limits(self.input_limits, len(equations.inputs))
        object.__setattr__(self, "dt", float(self.dt))
        object.__setattr__(self, "at", at)
        object.__setattr__(self, "input_limits", limits)
        self._apply_effects()
        question_effects(self.effects, self.dt, stacklevel=5)
        question_beliefs(self.free, self.parameters, stacklevel=5)
        check_units(self.units, self._traced)
        law = self.law()
        if law and law.dt == 0.0 and equations.dt:
            raise CtrlidError("an analog controller cannot act on a plant in discrete time; give "
                              "the plant in continuous time or sample the controller")  # fmt: skip

    def __getstate__(self) -> dict[str, Any]:
        # Lambdas and functions inside functions, as plants and controllers are made of, have no
        # name by which pickle finds them.
        state = {k: v for k, v in self.__dict__.items() if k != "_law"}
        for name in ("plant", "controller"):
            state[name] = pack_by_value(state[name], f"the {name} of {self._traced.name}")
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        parts = {name: pickle.loads(state[name]) for name in ("plant", "controller")}
        self.__dict__.update(state | parts)

    def _trace_plant(self) -> tuple[Equations, tuple[str, ...]]:
        """Return the equations of the driven plant, and the names of all its inputs."""
        whole = trace(self.plant)
        driven = (self.driven,) if isinstance(self.driven, str) else tuple(self.driven)
        object.__setattr__(self, "driven", driven)
        names = whole.inputs
        # What is no mapping of names is refused once the plant is known.
        stated = self.units if isinstance(self.units, Mapping) else {}
        units = {**getattr(self.plant, "units", {}), **stated}
        forces = self.forces
        mechanism = getattr(self.plant, "mechanism", None)
        if mechanism is not None and not whole.siso:
            forces = dict(self.plant.forces) if forces is None else forces
            # The plants of `plants` know where forces work; their parameters may have been changed.
            if forces and {*forces.values()} - {None} <= set(mechanism.input_labels):
                whole = trace(with_parameters(mechanism, self.plant.params))
        if not driven and not forces:
            return whole, names
        return drive_inputs(whole, driven or names, forces or {}, units), names

    def _apply_effects(self, like: "Loop | None" = None) -> None:
        """Put the effects into the equations and see that the free parameters exist.

        Where a loop `like` this one has the same effects at work, its equations are taken over.
        """
        period = self.dt / self.sharpness
        effects = check_effects(self.effects)
        object.__setattr__(self, "effects", effects)
        plant, at = self._shift_to_absolute(), self._bare_point
        kept = compose_effects(plant, self.labelled, at, period)
        active = {label: e for label, e in self.labelled.items() if not e.neutral}
        object.__setattr__(self, "_kept", kept)
        if len(active) == len(effects):
            changed = kept
        elif like is not None and self._has_same_at_work(like):
            changed = like._active
        else:
            changed = compose_effects(plant, active, at, period)
        object.__setattr__(self, "_active", changed)
        object.__setattr__(self, "free", check_free(self.free, kept))
        if self.controller is not None and self._active.feedthrough:
            # With effects it is they, or their values, that close the loop without delay.
            refusal = EffectDoesNotApply if effects else CtrlidError
            raise refusal(
                f"{kept.name} passes its input to its output without delay, so the loop with "
                "a controller would be algebraic; add the lag of the sensor or the actuator to the "
                "plant. If this is the controller, the order is Loop(plant, controller, ...)"
            )

    def _has_same_at_work(self, other: "Loop") -> bool:
        """Whether the very same effects are at work on the very same plant in another loop."""
        mine, its = (
            [(k, id(e)) for k, e in x.labelled.items() if not e.neutral] for x in (self, other)
        )
        plant = self._traced is other._traced and self.at is other.at and self.dt == other.dt
        return plant and mine == its and self.sharpness == other.sharpness

    @property
    def linear_plant(self) -> bool:
        """Whether the plant is a linear system and so acts on deviations from `at`."""
        return isinstance(self.plant, ct.TransferFunction | ct.StateSpace)

    @property
    def signals(self) -> Mapping[str, tuple[str, ...]]:
        """The names of the inputs u and outputs y, and of the references of a wired controller."""
        wiring = self.wiring
        several = {"u": self._traced.inputs, "y": self._traced.outputs}
        return several if wiring is None else {"r": wiring.open, **several}

    @property
    def wiring(self) -> Wiring | None:
        """How a controller of several signals is wired to the plant; None for any other."""
        if self.controller is None or not is_wired_by_name(self.controller, self._traced):
            return None
        assert self.at is not None
        return make_wiring(self.controller, self._traced, self.at)

    @property
    def labelled(self) -> dict[str, AbstractEffect]:
        """The effects by name: that of the class, numbered from the second of a class on."""
        return label_effects(self.effects)

    @property
    def parameters(self) -> dict[str, float]:
        """Values of the plant's numeric parameters and of those of the effects."""
        return dict(self._kept.parameters)

    @property
    def known_units(self) -> dict[str, str]:
        """Units by the names of the plant: those in `units`, and else those that the plant has."""
        return {**getattr(self.plant, "units", {}), **self.units}

    @property
    def position_unit(self) -> str:
        """The unit of the position that forces act on; a name in brackets where it is not known."""
        return find_position_unit(self._traced, self.known_units)

    @property
    def position_units(self) -> dict[str, str]:
        """The unit of the position of each velocity, by its name, as in `position_unit`."""
        e, known = self._traced, self.known_units
        return {s: find_position_unit(e, known, s) for s in (e.states[j] for j in e.velocities)}

    @property
    def state_units(self) -> dict[str, str]:
        """Units of the plant's states by name, as far as they are known.

        A state that shares its name with an output has the output's unit only where that shows it
        as it is.
        """
        return find_state_units(self._traced, self.known_units)

    def equations(self, keep: bool = False) -> Equations:
        """Return the traced equations of the plant with its effects, in absolute physical units.

        Parameters
        ----------
        keep : bool, optional
            Keep effects that are neutral in the formulas, as a fit needs that asks which way they
            would help. By default they are left out, so that not one sample changes.

        Returns
        -------
        Equations
            The equations.
        """
        check_arguments(Loop.equations, locals())
        return self._kept if keep else self._active

    def _shift_to_absolute(self) -> Equations:
        e = self._traced
        if not self.linear_plant:
            return e
        at = self._bare_point
        u0, y0 = (casadi.DM(v) if np.ndim(v) else v for v in (at.input, at.output))

        def shift() -> Equations:
            rhs = casadi.substitute(e.rhs, e.u, e.u - u0)
            output = casadi.substitute(e.output, e.u, e.u - u0) + y0
            return replace(e, rhs=rhs, output=output)

        shifted: Equations = e.derive(("absolute", at.input, at.output), shift)
        return shifted.with_values(e.parameters, e.rest)

    @property
    def _bare_point(self) -> OperatingPoint:
        assert self.at is not None
        if not self.linear_plant:
            return self.at
        n = len(self._traced.states)
        return OperatingPoint((0.0,) * n, self.at.input, self.at.output)

    @functools.cached_property
    def point(self) -> OperatingPoint:
        """The operating point with the states of this very plant and of its effects."""
        at = self._bare_point
        return replace(at, states=(*at.states, *self._active.rest))

    def with_effect(self, effect: AbstractEffect) -> "Loop":
        """Return the loop with one more effect.

        Parameters
        ----------
        effect : AbstractEffect
            An effect of `ctrlid.effects` or of your own.

        Returns
        -------
        Loop
            A new loop.

        Raises
        ------
        CtrlidError
            If the effect makes no sense for this plant.

        Examples
        --------
        >>> import ctrlid as cid
        >>> loop = cid.Loop(cid.plants.servo(m=2.0, c=1.0, k=3.0), dt=0.01)
        >>> loop.with_effect(cid.effects.CoulombFriction(fc=0.2)).parameters
        {'m': 2.0, 'c': 1.0, 'k': 3.0, 'CoulombFriction.fc': 0.2}
        """
        # Whether a plant takes an effect is found out by adding it, and then it is added again.
        loop = _add_effect(self, _Itself(effect))
        question_effects((effect,), self.dt, stacklevel=3)
        return loop

    def without_effect(self, effect: str | AbstractEffect) -> "Loop":
        """Return the loop without one of its effects.

        Parameters
        ----------
        effect : str or AbstractEffect
            Its name, as in `labelled`, or the effect itself.

        Returns
        -------
        Loop
            A new loop, in which the parameters of the effect are no longer free.

        Raises
        ------
        CtrlidError
            If the loop has no such effect.
        """
        check_arguments(Loop.without_effect, locals())
        known = self.labelled
        label = next((key for key, e in known.items() if key == effect or e is effect), None)
        label = label or next((key for key, e in known.items() if e == effect), None)
        if label is None:
            raise CtrlidError(f"the loop has no effect {effect}; {list_known(str(effect), known)}")
        rest = tuple(e for key, e in known.items() if key != label)
        kept = [name for name in self.free if not name.startswith(f"{label}.")]
        free = {n: self.free[n] for n in kept} if isinstance(self.free, Mapping) else tuple(kept)
        return self._replace_fields(effects=rest, free=free)

    def with_parameters(self, values: Mapping[str, float] | None = None, **named: float) -> "Loop":
        """Return the loop with other values of plant or effect parameters.

        Parameters
        ----------
        values : mapping of str to float, optional
            New values by name as in `parameters`, each in its unit:
            ``{"K": 3e-6, "CoulombFriction.fc": 0.2}``.
        **named : float
            The same by keyword, each in its unit, for names that Python can spell:
            ``with_parameters(K=3e-6)``.

        Returns
        -------
        Loop
            A new loop with a copy of the plant; the given plant stays as it is.

        Raises
        ------
        CtrlidError
            If there is no such parameter or the value is out of its bounds.
        """
        check_arguments(Loop.with_parameters, locals())
        values = {**(values or {}), **named}
        for name, value in values.items():
            if name not in self.parameters:
                raise CtrlidError(
                    f"the loop has no parameter {name!r}; {list_known(name, self.parameters)}"
                )
            if not is_number(value):
                raise CtrlidError(f"with_parameters needs a number as {name}; given {value!r}")
        of_plant = {k: float(v) for k, v in values.items() if k in self._traced.parameters}
        if not np.isfinite(list(of_plant.values())).all():
            raise CtrlidError(f"plant parameters are finite numbers; given {of_plant}")
        effects = replace_effect_values(self, values)
        if not of_plant:
            return self._replace_fields(effects=effects)
        own = self._traced
        traced = own.with_values({**own.parameters, **of_plant}, own.rest)
        return self._replace_fields(
            plant=with_parameters(self.plant, of_plant), _traced=traced, effects=effects
        )

    def _replace_fields(self, **changes: Any) -> "Loop":
        """Return a copy with other fields, without tracing the plant again."""
        new = object.__new__(Loop)
        new.__dict__.update(self.__dict__ | changes)
        # Effects have states of their own.
        new.__dict__.pop("point", None)
        if "controller" in changes:
            new.__dict__.pop("_law", None)
        new._apply_effects(self)
        return new

    def law(self) -> ControlLaw | None:
        """Return the controller as equations, None where there is none."""
        if self.controller is None:
            return None
        assert self.at is not None
        known = self.__dict__.get("_law")
        if known is None:
            wiring = self.wiring
            if wiring is None:
                known = make_control_law(self.controller, self.at, self.dt, self._traced.outputs[0])
            else:
                known = make_wired_law(self.controller, wiring, self.at, self.dt)
            object.__setattr__(self, "_law", known)
        return known

    @property
    def analog(self) -> bool:
        """Whether the controller is an analog circuit, so that u moves between samples."""
        law = self.law()
        return law is not None and law.dt == 0.0

    def system(self) -> Any:
        """Return the plant with its effects, in absolute physical units.

        A delay becomes its Padé approximation of order two; kinks are as sharp as in a simulation.

        Returns
        -------
        control.NonlinearIOSystem
            The plant as given, or with its effects and, if it is linear, its operating point. Its
            parameters are those of the loop.

        Raises
        ------
        CtrlidError
            If there is a backlash, whose memory is no state of a continuous system.
        """
        if not self.linear_plant and self._active is self._traced:
            return self.plant
        return as_system(self._active, self._bare_point, self.known_units)

    def linearize(self, *, states: bool = False) -> Any:
        """Return the plant with its effects, linearized at the operating point.

        The point keeps its output; with effects, its states and input are solved for anew.
        Dry friction, dead zones, backlash, steps of a converter and vibrations are left out, as
        in motion that is large against them; a `StateLimit` is as it is at the point, where nothing
        runs over below the limit; a delay is its Padé approximation of order two; what drifts has
        its value at time zero.

        Parameters
        ----------
        states : bool, optional
            Whether to keep the states of the plant and of its effects, which a state feedback
            needs: ``ct.lqr(loop.linearize(states=True), Q, R)``.

        Returns
        -------
        control.TransferFunction or control.StateSpace
            From deviations of the input to deviations of the output; with ``states=True``, and for
            a plant with several inputs or outputs, a state-space model in the physical states,
            first those of the plant in their order, under the names of `equations`, with an
            underscore for a dot.

        Raises
        ------
        CtrlidError
            If the plant with its effects has no equilibrium at this output.

        Examples
        --------
        >>> import ctrlid as cid
        >>> loop = cid.Loop(cid.plants.servo(m=2.0, c=1.0, k=3.0), dt=0.01)
        >>> stiff = loop.with_effect(cid.effects.LinearStiffness(k1=5.0))
        >>> G = stiff.linearize(states=True)
        >>> G.A.tolist(), G.state_labels, G.input_labels, G.output_labels
        ([[0.0, 1.0], [-5.0, -0.5]], ['x', 'v'], ['V'], ['x'])
        """
        active = {k: e for k, e in self.labelled.items() if not e.neutral and e.in_linear_model}
        if not active and not self._traced.siso:
            return make_state_space(self._traced, self._bare_point)
        if not active:
            if isinstance(self.plant, ct.TransferFunction) and not states:
                return self.plant
            return linearize(self.plant, self.point, states=states)
        return linearize_with_effects(
            self._shift_to_absolute(), active, self._bare_point, self.dt, states
        )

    def _describe(self) -> str:
        e = self._traced
        assert self.at is not None
        kind = "no controller" if self.controller is None else (
            "analog controller" if self.analog else "digital controller")  # fmt: skip
        pairs = zip((*e.outputs, *e.inputs), (*self.at.outputs, *self.at.inputs), strict=True)
        point = ", ".join(f"{name} = {value:g}" for name, value in pairs)
        text = f"Loop({e.name}, {kind}, dt={self.dt:g} s, at {point}"
        other = describe_other_output(self)
        text += f" (THE OUTPUT IS ANOTHER: {other})" if other else self._describe_imbalance()
        limits = np.broadcast_to(np.array(np.broadcast_arrays(*self.input_limits)).T,
                                 (len(e.inputs), 2))  # fmt: skip
        for name, (low, high) in zip(e.inputs, limits, strict=True):
            if np.isfinite([low, high]).any():
                text += f", {name} within {low:g}..{high:g}"
        if self.free:
            known = self.free if isinstance(self.free, Mapping) else {}
            names = [
                n if math.isinf(known.get(n, math.inf)) else f"{n} (± {write_percent(known[n])})"
                for n in self.free
            ]
            text += f", free: {', '.join(names)}"
        if self.effects:
            text += f", effects: {', '.join(self.labelled)}"
        if self.effects and self.sharpness != 1:
            text += f", sharpness {self.sharpness:g}"
        wiring = self.wiring
        if wiring is None:
            return text + ")"
        return "\n  ".join([text + "), wired:", *wiring.lines])

    def __str__(self) -> str:
        e = self.equations()
        if not list_unforced_velocities(e):
            return write_loop(self)
        return f"{write_loop(self)}\n  note: {describe_missing_forces(e, self.point)}."

    def _describe_imbalance(self) -> str:
        """Say that the plant does not rest at the operating point; empty where it does.

        With effects, such as a constant force, it may rest where the plant alone does not.
        """
        found = find_unbalanced_rate(self._shift_to_absolute(), self._bare_point)
        if found is None or find_unbalanced_rate(self._active, self.point) is None:
            return ""
        per = "a sample" if self._traced.dt else "a second"
        unit = self.state_units.get(found.state, "")
        rate = f"{found.rate:.3g} {unit}".rstrip()
        return f" (NOT AT REST THERE: {found.state} changes by {rate} {per})"


class _Itself:
    """An object as a key that equals no other object, whatever its values are."""

    def __init__(self, given: Any) -> None:
        self.given = given

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Itself) and self.given is other.given

    def __hash__(self) -> int:
        return id(self.given)


@functools.lru_cache(maxsize=64)
def _add_effect(loop: Loop, effect: _Itself) -> Loop:
    """Return a loop with one more effect; the last ones are kept."""
    return loop._replace_fields(effects=(*loop.effects, effect.given))


def describe_other_output(loop: Loop) -> str:
    """Say what the plant shows at the states of the operating point, if not the output there.

    Empty where both agree. The parameters of a sensor, which a fit may change, are a reason why
    they need not agree exactly.
    """
    if loop.linear_plant:
        return ""
    at, e = loop._bare_point, loop._traced
    shown = e.evaluate(np.array(at.states), np.array(at.inputs))[1]
    small = 1e-3 * max(map(abs, at.states), default=0.0)
    others = [
        f"{name} = {there:g}"
        for name, given, there in zip(e.outputs, at.outputs, shown.tolist(), strict=True)
        if abs(given - there) > OTHER_OUTPUT * max(abs(given), abs(there)) + small
    ]
    return f"at these states the plant shows {', '.join(others)}" if others else ""


def exchange_controller(loop: Loop, controller: Any) -> Loop:
    """Return a loop with another controller on the same plant.

    The plant, which was traced and checked when the loop was made, is not traced again: who tries
    many controllers need not wait for it.
    """
    return loop._replace_fields(controller=controller)


def find_input_limits(loop: Loop) -> tuple[Any, Any]:
    """Return the limits of the input: those of the loop and of its PID."""
    lower, upper = loop.input_limits
    if isinstance(loop.controller, PID):
        return max(lower, loop.controller.lower), min(upper, loop.controller.upper)
    return lower, upper


def exchange_limits(loop: Loop, lower: float = -math.inf, upper: float = math.inf) -> Loop:
    """Return a loop with other limits of its input, by default none, on the same plant."""
    return loop._replace_fields(input_limits=(lower, upper))


def exchange_constant_input(loop: Loop, constant: float) -> Loop:
    """Return a loop whose controller adds its part to another constant input."""
    return replace(loop, at=replace(loop._bare_point, input=constant))


def add_units(loop: Loop, units: Mapping[str, str]) -> Loop:
    """Return the loop with further units, by names of the plant."""
    return loop._replace_fields(units={**loop.units, **units}) if units else loop


def write_loop(loop: Loop) -> str:
    """Return what a loop is made of, without a note on what it lacks."""
    return loop._describe()


def find_converter_steps(loop: Loop) -> tuple[float, ...]:
    """Return the step in which each output is read [its unit], zero for one without `Quantization`.

    Of several steps of one output the largest counts.
    """
    names = loop.signals["y"]
    steps = dict.fromkeys(names, 0.0)
    for effect in loop.effects:
        if isinstance(effect, Quantization):
            name = effect.at or names[0]
            steps[name] = max(steps[name], effect.step)
    return tuple(steps.values())


def replace_effect_values(loop: Loop, values: Mapping[str, float]) -> tuple[AbstractEffect, ...]:
    """Return the effects of a loop with other values, by the names of `Loop.parameters`.

    Raises
    ------
    CtrlidError
        If an effect cannot have its values.
    """
    return tuple(
        replace(e, **{name: values[f"{label}.{name}"] for name in e.values()
                      if f"{label}.{name}" in values})
        for label, e in loop.labelled.items()
    )  # fmt: skip


@functools.lru_cache(maxsize=64)
def sharpen_effects(loop: Loop, times: float) -> Loop:
    """Return a loop whose effects act as abruptly as with a period so many times shorter.

    The last ones are kept: replicas are simulated with one loop again and again.

    Dry friction takes a mass to rest within a share of a period, and a parameter steps within half
    of one. That keeps a filter fast; nature does not wait for samples.

    Parameters
    ----------
    loop : Loop
        The loop.
    times : float
        How much shorter the period is that its effects are told of.

    Returns
    -------
    Loop
        The same loop with sharper effects; itself where it has none, or where they are that sharp.
    """
    if not loop.effects or loop.sharpness == times:
        return loop
    return loop._replace_fields(sharpness=float(times))
