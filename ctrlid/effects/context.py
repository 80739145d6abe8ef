"""What the formula of an effect sees: the signals of the loop at one moment."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np

from .._base.errors import EffectDoesNotApply
from .._base.units import fill_unit
from ..physics.equations import Equations
from ..physics.linearization import OperatingPoint
from ..physics.symbols import Symbol

# A kink has at least this width, in units of what has it, so that derivatives stay finite.
SHARPEST = 1e-12
# A lag shorter than this share of a sampling period is treated as that long, so that its rate stays
# finite.
INSTANT = 1e-6
# A mass comes to rest within this share of a sampling period, or sooner in a sharper loop.
STICKING = 0.25
# Friction creeps with the velocity that this share of its limit needs, where more is asked for.
LARGEST_SHARE = 0.99
# This number stands for an infinite distance to a limit, with which CasADi cannot compute.
FARTHEST = 1e30
# A slope that differs from one by less is one but for round-off.
ONE = 1e-9


@dataclass(frozen=True)
class Follow:
    """The rate of a state that follows `target` as a first-order lag."""

    target: Any
    time_constant: Any
    shortest: float


def find_motion(e: Equations, velocity: str = "") -> tuple[int | None, int] | None:
    """Return the indices of the position and the velocity that forces act on, None without any.

    Of several moving masses it is the one whose position the output shows, else the first; with
    the name of a velocity it is that one. The position of a speed may be no state (None).
    """
    if e.dt:
        return None
    shown = casadi.jacobian(e.output, e.x).sparsity().get_col()
    own = len(e.states) - len(e.rest)
    pairs = [
        (i, j)
        for j in e.position_rates
        for i in range(own)
        if i != j and casadi.is_equal(casadi.simplify(e.rhs[i]), e.x[j], 2)
        if velocity in ("", e.states[j])
    ]
    if pairs:
        return min(pairs, key=lambda pair: (pair[0] not in shown, pair))
    speeds = [e.states.index(name) for name in e.speeds if velocity in ("", name)]
    return min(((None, j) for j in speeds), key=lambda pair: pair[1] not in shown, default=None)


def find_output_of(e: Equations, velocity: str) -> int:
    """Return the output that shows the position of a velocity, else the first."""
    motion = find_motion(e, velocity)
    if motion is not None:
        shown = casadi.jacobian(e.output, e.x)
        for k in range(len(e.outputs)):
            if shown[k, :].sparsity().get_col() == [motion[1] if motion[0] is None else motion[0]]:
                return k
    return 0


def _list_shown_states(e: Equations) -> dict[int, int]:
    """Return the states that an output shows as they are, factor one, with that output."""
    slopes = casadi.simplify(casadi.sparsify(casadi.jacobian(e.output, e.x)))
    found: dict[int, int] = {}
    for k in range(len(e.outputs)):
        places = slopes[k, :].sparsity().get_col()
        if len(places) != 1:
            continue
        slope = slopes[k, places[0]]
        if slope.is_constant() and abs(float(slope) - 1) < ONE:
            found.setdefault(places[0], k)
    return found


def find_state_units(e: Equations, known: Mapping[str, str]) -> dict[str, str]:
    """Return the units of a plant's states.

    They are those stated for the states, those of outputs which show a state as it is, and, of
    positions and velocities, those that follow from each other. An output in degrees of an angle in
    radians says nothing of the angle's unit, even where both have one name.

    Parameters
    ----------
    e : Equations
        The plant, without effects.
    known : mapping of str to str
        Units of its signals and states by name.

    Returns
    -------
    dict of str to str
        The units by the states' names; a state whose unit is not known is not in it.
    """
    # A name that state and output share is told the unit of the output.
    units = {s: known[s] for s in e.states if s not in e.outputs and known.get(s)}
    for i, k in e.derive("shown states", lambda: _list_shown_states(e)).items():
        if known.get(e.outputs[k]):
            units.setdefault(e.states[i], known[e.outputs[k]])
    for velocity in (e.states[j] for j in e.velocities):
        motion = find_motion(e, velocity)
        if motion is None or motion[0] is None:
            continue
        position = e.states[motion[0]]
        if position in units:
            units.setdefault(velocity, fill_unit("{x}/s", {"x": units[position]}))
        elif integrated := _integrate_unit(units.get(velocity, "")):
            units[position] = integrated
    return units


def _integrate_unit(velocity: str) -> str:
    """Return the unit of a position by that of its velocity; empty where it is no rate."""
    unit = fill_unit("{v} s", {"v": velocity}) if velocity else ""
    return "" if "s" in unit.split() else unit


def find_position_unit(e: Equations, known: Mapping[str, str], velocity: str = "") -> str:
    """Return the unit of the position that forces act on.

    It is that which the unit stated for its velocity asks for, so that m/s gives m; else that of
    the position, as `find_state_units` has it.

    Parameters
    ----------
    e : Equations
        The plant, without effects.
    known : mapping of str to str
        Units of its signals and states by name.
    velocity : str, optional
        The velocity, of several; by default that of `find_motion`.

    Returns
    -------
    str
        The unit; where it is not known, a name in brackets.
    """
    motion = find_motion(e, velocity)
    if motion is None:
        return known.get(e.outputs[0], "") or "[y]"
    speed, units = e.states[motion[1]], find_state_units(e, known)
    unit = _integrate_unit(units.get(speed, ""))
    shown = e.derive("shown states", lambda: _list_shown_states(e))
    if motion[0] is None:
        name = units.get(speed) or ("[y]" if motion[1] in shown else f"[{speed}]")
        return unit or f"{name} s"
    position = e.states[motion[0]]
    return unit or units.get(position, "") or ("[y]" if motion[0] in shown else f"[{position}]")


class Moment:
    """The signals of a loop at one moment, as symbols that understand arithmetic and numpy.

    Attributes
    ----------
    t : Symbol
        Time [s].
    dt : float
        Sampling period [s].
    u, y : Symbol
        Input and output, as they are before this effect.
    states : dict of str to Symbol
        Every state by its name.
    own : dict of str to Symbol
        The effect's own states.
    parameters : dict of str to Symbol
        Every parameter of the plant by its name.
    at : OperatingPoint
        Where deviations are counted from.
    """

    def __init__(
        self, e: Equations, at: OperatingPoint, dt: float, own: dict[str, Any], u: int = 0,
        y: int = 0, motion: tuple[int | None, int] | None = None, named: bool = False,
    ) -> None:  # fmt: skip
        self._e, self._motion = e, motion
        # What a force at a named place accelerates its velocity by; elsewhere it is one already.
        self._push: Any = 1.0
        if named and motion is not None and e.pushes is not None:
            self._push = Symbol(e.pushes[motion[1], e.velocities.index(motion[1])])
        self.at, self.dt, self.own = at, dt, own
        self.t: Any = Symbol(e.t)
        self.u: Any = Symbol(e.u if len(e.inputs) == 1 else e.u[u])
        self.y: Any = Symbol(e.output if len(e.outputs) == 1 else e.output[y])
        self.states: dict[str, Any] = {s: Symbol(e.x[k]) for k, s in enumerate(e.states)}
        self.parameters: dict[str, Any] = {s: Symbol(e.p[k]) for k, s in enumerate(e.parameters)}

    def _require_motion(self) -> tuple[int | None, int]:
        found = self._motion or find_motion(self._e)
        if found is None:
            raise EffectDoesNotApply(
                f"{self._e.name} has no moving mass: no state is the rate of another"
            )
        return found

    def _require_position(self) -> int:
        position, velocity = self._require_motion()
        if position is None:
            raise EffectDoesNotApply(
                f"{self._e.states[velocity]} of {self._e.name} is a speed whose position is no "
                "state"
            )
        return position

    @property
    def position_name(self) -> str:
        """Name of the state that is the position of the moving mass."""
        return self._e.states[self._require_position()]

    @property
    def position(self) -> Any:
        """Position of the moving mass."""
        return Symbol(self._e.x[self._require_position()])

    @property
    def velocity(self) -> Any:
        """Velocity of the moving mass."""
        return Symbol(self._e.x[self._require_motion()[1]])

    @property
    def acceleration(self) -> Any:
        """Acceleration of the moving mass without this effect."""
        return Symbol(self._e.rhs[self._require_motion()[1]])

    def find_force(self, acceleration: Any) -> Any:
        """Return the force that accelerates the moving mass so much, as `force` returns it.

        Where `Loop.forces` tells the inertia it is in the unit of its input, elsewhere it is the
        acceleration itself.
        """
        return acceleration / self._push

    @property
    def deviation(self) -> Any:
        """Position of the moving mass, counted from where it is at the operating point."""
        index = self._require_position()
        return Symbol(self._e.x[index] - self.at.states[index])

    def plant_parameter(self, name: str) -> Any:
        """Return a parameter of the plant, or refuse."""
        if name not in self.parameters:
            raise EffectDoesNotApply(
                f"{self._e.name} has no numeric parameter {name!r}; it has {list(self.parameters)}"
            )
        return self.parameters[name]

    def _variance(self, value: Any, width: Any) -> Any:
        """Variance of an expression when each state is uncertain by its spread."""
        slopes = casadi.jacobian(value.sx, self._e.x)
        width = width.sx if isinstance(width, Symbol) else casadi.SX(float(width))
        doubt = casadi.mtimes(slopes**2, self._e.spread**2)
        return doubt + width**2 + SHARPEST**2

    def sign(self, v: Any, width: Any = 0.0) -> Any:
        r"""Return the sign of an expression, averaged over what a filter does not know of it.

        .. math:: E[\mathrm{sign}(v)] = \mathrm{erf}\left(v / \sqrt{2 (s^2 + w^2)}\right)

        Parameters
        ----------
        v : Symbol
            The expression, usually a velocity. Its standard deviation s follows from those of the
            states and is zero in a simulation.
        width : Symbol or float, optional
            Width w over which the jump is spread in any case [unit of v]. Finer than what happens
            within one sample anyway it cannot matter.

        Returns
        -------
        Symbol
            Between -1 and 1.
        """
        return Symbol(casadi.erf(v.sx / casadi.sqrt(2 * self._variance(v, width))))

    def rub(self, limit: Any, drag: Any = 0.0, creep: Any = 0.0) -> Any:
        r"""Return what dry friction of a given limit holds against the motion.

        .. math::
            f = f_c \, E[\mathrm{sign}(v + \tau b)],
            \quad b = \frac{a}{(1 + (a / f_c)^8)^{1/8}}, \quad \tau = T / 4 s

        The jump is spread over velocities of the size :math:`\sqrt{2/\pi} \, \tau f_c`, so that
        near rest f is :math:`v / \tau + b`: it balances what else accelerates the mass, a, up to
        its limit, and takes the velocity away within a quarter of a sampling period T, or s times
        as fast where the loop has the `sharpness` s. This is Karnopp's friction without a switch:
        the mass sticks, and nothing is too sharp for an integration.

        With a time of creep :math:`\tau_c` it is the friction
        :math:`f_c \tanh(v / (\tau_c f_c))` that simulations are often written with. It holds no
        force at rest: where it balances b the mass creeps with
        :math:`v_c = \tau_c f_c \, \mathrm{artanh}(b / f_c)`, so that

        .. math::
            f = f_c \, E[\mathrm{sign}(v + \lambda (\tau b - v_c))],
            \quad \tau = \sqrt{(T/4s)^2 + \tau_c^2}, \quad \lambda = (T / 4 s \tau)^2

        which needs no small steps where the creep is slow, and is the friction itself where it is
        fast.

        Parameters
        ----------
        limit : Symbol or float
            The largest friction f_c [unit of the force].
        drag : Symbol or float, optional
            A further force of the same effect [unit of the force], which is part of what it
            balances.
        creep : Symbol or float, optional
            Time of creep [s]: the velocity that half the limit needs, over the limit, by and large.

        Returns
        -------
        Symbol
            Between minus and plus the limit [unit of the force].

        References
        ----------
        D. Karnopp, Computer simulation of stick-slip friction in mechanical dynamic systems.
        Journal of Dynamic Systems, Measurement, and Control 107, 1985.
        """
        j = self._require_motion()[1]
        most, further = self._push * limit, self._push * drag
        others = self.acceleration + further
        # A limit without a corner, which would cost an integration many small steps.
        beyond = (others / (most + SHARPEST)) ** 2
        balanced = others / np.sqrt(np.sqrt(np.sqrt(1 + (beyond * beyond) ** 2)))
        short = STICKING * self.dt
        if isinstance(creep, int | float) and creep == 0:
            width = np.sqrt(2 / np.pi) * short * most
            return limit * self.sign(Symbol(self._e.x[j]) + short * balanced, width)
        time = np.sqrt(short**2 + creep**2)
        share = LARGEST_SHARE * balanced / (most + SHARPEST)
        ahead = time * balanced - creep * most * np.arctanh(share)
        width = np.sqrt(2 / np.pi) * time * most
        return limit * self.sign(Symbol(self._e.x[j]) + (short / time) ** 2 * ahead, width)

    def abs(self, v: Any, width: Any = 0.0) -> Any:
        """Return the absolute value of an expression, averaged as in `sign`."""
        return 2 * self.above(v, width) - v

    def above(self, v: Any, width: Any = 0.0) -> Any:
        """Return ``max(v, 0)``, averaged as in `sign`."""
        s = casadi.sqrt(self._variance(v, width))
        z = casadi.fmax(v.sx, -FARTHEST) / s
        share = (1 + casadi.erf(z / np.sqrt(2))) / 2
        density = casadi.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
        return Symbol(s * (z * share + density))

    def follow(self, target: Any, time_constant: Any) -> Follow:
        """Return the rate of a state that is a first-order lag behind `target`."""
        return Follow(target, time_constant, INSTANT * self.dt)
