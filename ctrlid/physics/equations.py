"""The equations of a plant as expressions, with what effects have added to them."""

import functools
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import casadi
import numpy as np

from .._base.arrays import Array
from .._base.errors import CtrlidError

Found = TypeVar("Found")

# At so many states it is asked whether a force works along its velocity or against it.
TURNED = 20


@dataclass(frozen=True, eq=False)
class Lag:
    """A state that follows `target` as a first-order lag, ``T dx/dt = target - x``.

    Its rate is part of `Equations.rhs` as well; knowing that it is a lag allows it to be advanced
    by its exact exponential however short T is.
    """

    state: int
    time_constant: Any
    target: Any


@dataclass(frozen=True, eq=False)
class InputMemory:
    """What an input passes through once per sample before it reaches the plant, with memory.

    ``(next m, applied u)`` as expressions of the memory `m`, the computed input `u`, the `period`
    from one input to the next and the parameters. The applied input is the mean over the period;
    where the input runs straight from sample to sample, the memory itself acts at the samples.
    Where nobody knows what went before, the memory may be as far as `reach` from `start`; these are
    expressions of the first input and of that `at_rest`, and for both at rest the memory is there.
    `moves` says that the memory goes towards the input by itself, and is not only held and carried.
    """

    m: Any
    u: Any
    period: Any
    at_rest: Any
    after: Any
    applied: Any
    start: Any
    reach: Any
    moves: bool = False


class Formulas:
    """What was derived from the formulas of equations, whatever values their parameters have.

    Equations that share it have the same formulas.
    """

    def __init__(self) -> None:
        self.derived: dict[Hashable, Any] = {}


def _derive_once(compute: Callable[["Equations"], Found]) -> Callable[["Equations"], Found]:
    """Return a method that derives something from the formulas alone, and so only once for them."""

    @functools.wraps(compute)
    def find(e: "Equations") -> Found:
        found: Found = e.derive(compute.__name__, lambda: compute(e))
        return found

    return find


def _pack_value(value: Any, found: list[Any]) -> Any:
    """Return nested values in which each expression is replaced by its place in the list."""
    if isinstance(value, casadi.SX):
        found.append(value)
        return "expression", len(found) - 1
    if isinstance(value, Lag | InputMemory):
        return type(value), [_pack_value(v, found) for v in vars(value).values()]
    if isinstance(value, tuple):
        return "tuple", [_pack_value(v, found) for v in value]
    return "value", value


def _unpack_value(packed: Any, found: list[Any]) -> Any:
    """Return what `_pack_value` packed."""
    kind, content = packed
    if kind == "expression":
        return found[content]
    if kind == "value":
        return content
    parts = [_unpack_value(part, found) for part in content]
    return tuple(parts) if kind == "tuple" else kind(*parts)


def _rebuild_equations(fields: list[Any], package: str) -> "Equations":
    found = casadi.StringDeserializer(package).unpack()
    return Equations(*(_unpack_value(field, found) for field in fields))


@dataclass(frozen=True, eq=False)
class Equations:
    """The equations of one plant: ``dx/dt = rhs(t, x, u, p)``, ``y = output(t, x, u, p)``.

    For a discrete-time plant (`dt` > 0) `rhs` is the next state. The members `t`, `x`, `u`, `p`,
    `rhs` and `output` are CasADi expressions; `parameters` holds the value of each entry of `p`.

    Effects (`with_effect`) may add more: `spread` are symbols for the standard deviations of the
    states, zero in a simulation, by which a filter smooths kinks; `lags` lists states that are
    plain first-order lags; `memory` is one between controller and plant; `delay` an expression
    of `p` for the time by which the input comes late, of several inputs that with the index
    `late_input`; `readout` what becomes of the noisy `reading`; `rest` the values at rest of states
    that were added to the plant's own.

    `pushes` has a column for each force that is known to work on a velocity: the derivative of the
    states' rates by it, turned so that a positive one makes the velocity grow; `push_units` are the
    units of these forces, or the names of their inputs in brackets, and empty for a velocity that
    is pushed alone. Without, each velocity is. `speeds` names velocities whose position is no
    state, as of a drive with a tachometer.
    """

    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    parameters: Mapping[str, float]
    dt: float
    t: Any
    x: Any
    u: Any
    p: Any
    rhs: Any
    output: Any
    spread: Any = None
    lags: tuple[Lag, ...] = ()
    memory: InputMemory | None = None
    delay: Any = None
    late_input: int = 0
    reading: Any = None
    readout: Any = None
    rest: tuple[float, ...] = ()
    pushes: Any = None
    push_units: tuple[str, ...] = ()
    speeds: tuple[str, ...] = ()

    def __reduce__(self) -> Any:
        # CasADi pickles no expression alone: all go into one package, which keeps the symbols that
        # they share.
        found: list[Any] = []
        fields = [_pack_value(getattr(self, name), found) for name in self.__dataclass_fields__]
        package = casadi.StringSerializer()
        package.pack(found)
        return _rebuild_equations, (fields, package.encode())

    @functools.cached_property
    def formulas(self) -> Formulas:
        """What was derived from the formulas, shared by equations with other values."""
        return Formulas()

    def derive(self, key: Hashable, compute: Callable[[], Any]) -> Any:
        """Return what is computed from the formulas alone, at the first call for each key."""
        derived = self.formulas.derived
        if key not in derived:
            derived[key] = compute()
        return derived[key]

    def with_values(self, parameters: Mapping[str, float], rest: tuple[float, ...]) -> "Equations":
        """Return the same formulas with other values of the same parameters, and at rest."""
        changed = replace(self, parameters=parameters, rest=rest)
        changed.__dict__["formulas"] = self.formulas
        return changed

    @property
    def values(self) -> Array:
        """The parameter values in the order of `p`."""
        return np.array(list(self.parameters.values()), dtype=float)

    @property
    def siso(self) -> bool:
        """Whether the plant has one input and one output."""
        return len(self.inputs) == 1 and len(self.outputs) == 1

    @property
    @_derive_once
    def velocities(self) -> tuple[int, ...]:
        """Indices of the plant's own states that forces act on: rates of others, and speeds."""
        speeds = (self.states.index(name) for name in self.speeds)
        return tuple(sorted({*self.position_rates, *speeds}))

    @property
    @_derive_once
    def position_rates(self) -> tuple[int, ...]:
        """Indices of the plant's own states that are another one's rate."""
        rates = [casadi.simplify(self.rhs[i]) for i in range(len(self.states) - len(self.rest))]
        return tuple(
            j
            for j in range(len(rates))
            if any(casadi.is_equal(rates[i], self.x[j], 2) for i in range(len(rates)) if i != j)
        )

    @property
    @_derive_once
    def feedthrough(self) -> bool:
        """Whether the output depends on the input without delay."""
        return bool(casadi.which_depends(self.output, self.u, 1, False)[0])

    @property
    @_derive_once
    def kinked(self) -> bool:
        """Whether the motion has kinks that a filter smooths, such as dry friction at rest."""
        return self.spread is not None and bool(casadi.depends_on(self.rhs, self.spread))

    @property
    @_derive_once
    def bent(self) -> bool:
        """Whether rates or outputs are no straight lines in states and inputs."""
        both, signals = casadi.vertcat(self.rhs, self.output), casadi.vertcat(self.x, self.u)
        return any(casadi.which_depends(both, signals, 2, True))

    @property
    @_derive_once
    def has_sign(self) -> bool:
        """Whether a sign is in the formulas, as of dry friction.

        Other kinks often guard the range where a formula is valid, and are far from rest.
        """
        f = self.function
        return any(f.instruction_id(k) == casadi.OP_SIGN for k in range(f.n_instructions()))

    @property
    @_derive_once
    def function(self) -> Any:
        """The CasADi function ``(t, x, u, p) -> (rhs, output)``."""
        # Without states, two indices keep the column that one would turn into a row.
        both = casadi.vertcat(self.rhs, self.output)
        if self.spread is not None:
            both = casadi.substitute(both, self.spread, casadi.SX.zeros(*self.spread.shape))
        n = len(self.states)
        return casadi.Function(
            "plant", [self.t, self.x, self.u, self.p], [both[:n, 0], both[n:, 0]]
        )

    @property
    @_derive_once
    def smoothed(self) -> Any:
        """The CasADi function ``(t, x, u, p, spread) -> (rhs, output)``."""
        spread = casadi.SX.sym("s", len(self.states)) if self.spread is None else self.spread
        return casadi.Function(
            "smoothed", [self.t, self.x, self.u, self.p, spread], [self.rhs, self.output]
        )

    @property
    @_derive_once
    def reader(self) -> Any:
        """The CasADi function ``(noisy output, p) -> reading``, or None."""
        if self.readout is None:
            return None
        return casadi.Function("reader", [self.reading, self.p], [self.readout])

    def evaluate(self, x: Any, u: Any, t: float = 0.0, p: Any = None) -> tuple[Array, Array]:
        """Return the numbers ``rhs`` and ``output`` at one point."""
        p = self.values if p is None else p
        rhs, output = self.function(t, x, u, p)
        return np.asarray(rhs, float).ravel(), np.asarray(output, float).ravel()

    def evaluate_points(
        self, x: Array, u: Array, t: Array, p: Array | None = None
    ) -> tuple[Array, Array]:
        """Return ``rhs`` and ``output`` at many points at once, a row each.

        Parameters
        ----------
        x : ndarray, shape (k, n)
            States.
        u : ndarray, shape (k,) or (k, inputs)
            The input; of several inputs all, or else they all have this value.
        t : ndarray, shape (k,)
            Times [s].
        p : ndarray, optional
            Values of all parameters, by default those of the equations.

        Returns
        -------
        rhs, output : ndarray, shapes (k, n) and (k, outputs)
        """
        inputs = np.transpose(u) if u.ndim == 2 else np.tile(u, (len(self.inputs), 1))
        p = self.values if p is None else p
        rhs, output = self.function(np.reshape(t, (1, -1)), np.transpose(x), inputs, p)
        return np.asarray(rhs, float).T, np.asarray(output, float).T


def drive_inputs(
    equations: Equations, driven: Sequence[str], forces: Mapping[str, str | None],
    units: Mapping[str, str],
) -> Equations:  # fmt: skip
    """Return a plant with some of its inputs only, the others zero, and with known forces.

    Parameters
    ----------
    equations : Equations
        The plant with all its inputs.
    driven : sequence of str
        The inputs that remain, in this order.
    forces : mapping of str to str or None
        Which input works on which velocity, None for one that is pushed alone; see
        `Equations.pushes`.
    units : mapping of str to str
        Units of the inputs.

    Returns
    -------
    Equations
        The plant.

    Raises
    ------
    CtrlidError
        If there is no such input or state, a position is taken for a velocity, or the plant is
        not affine in a force.
    """
    e, names = equations, list(equations.inputs)
    unknown = [name for name in driven if name not in names]
    if unknown or not driven:
        raise CtrlidError(f"driven= names {list(driven)}, but the inputs of {e.name} are {names}")
    velocities = [e.states[j] for j in e.velocities]
    speeds = tuple(v for v, u in forces.items() if v not in velocities and may_be_speed(e, v, u))
    known = (*velocities, *speeds)
    wrong = {v: u for v, u in forces.items() if v not in known or u not in (None, *names)}
    if wrong:
        raise CtrlidError(
            f"forces= says which input works on which velocity; given {wrong}, but the velocities "
            f"of {e.name} are {velocities} and its inputs {names}. A speed whose position is no "
            "state is a velocity, too, where the input changes its rate"
        )
    e = replace(e, speeds=speeds)
    velocities = [e.states[j] for j in e.velocities]
    kept = [names.index(name) for name in driven]
    u = casadi.SX.sym("u", len(driven)) if list(driven) != names else e.u
    values = casadi.SX.zeros(len(names), 1)
    for k, j in enumerate(kept):
        values[j] = u[k]
    pushes = None
    # A single mass with a single input and output is pushed by accelerations, as without forces.
    by_forces = bool(forces) and not len(velocities) == len(driven) == len(e.outputs) == 1
    if by_forces:
        slopes = casadi.jacobian(e.rhs, e.u)
        columns = []
        for j, velocity in zip(e.velocities, velocities, strict=True):
            force = forces.get(velocity)
            if force is None:
                columns.append(casadi.SX(casadi.DM.eye(len(e.states))[:, j]))
                continue
            at = names.index(force)
            if casadi.depends_on(slopes[:, at], e.u[at]):
                raise CtrlidError(
                    f"forces= says that {force} works on {velocity}, but {e.name} is "
                    "not affine in it: a force enters the accelerations as it is, times a factor"
                )
            columns.append(_turn_forward(e, slopes[:, at], j))
        pushes = casadi.substitute(casadi.horzcat(*columns), e.u, values)
    given = [forces.get(name) for name in velocities]
    own = tuple("" if force is None else units.get(force) or f"[{force}]" for force in given)
    return replace(
        e, inputs=tuple(driven), u=u, rhs=casadi.substitute(e.rhs, e.u, values),
        output=casadi.substitute(e.output, e.u, values), pushes=pushes,
        push_units=own if by_forces else (),
    )  # fmt: skip


def _turn_forward(e: Equations, column: Any, j: int) -> Any:
    """Return what a force does to all rates, so that a positive one makes its velocity grow.

    An input may oppose the velocity that it works on: a hoist pulls at a rope that it shortens. A
    friction that opposes the velocity must not do so.
    """
    own = casadi.Function("own", [e.x, e.p, e.u, e.t], [column[j]])
    # At rest and at some states of any size, for the sign may depend on where the mechanism is.
    rng = np.random.default_rng(0)
    states = [np.zeros(len(e.states)), *rng.standard_normal((TURNED, len(e.states)))]
    slopes = np.array([float(own(x, e.values, 0, 0)) for x in states])
    slopes = slopes[np.isfinite(slopes)]
    if (slopes >= 0).all():
        return column
    if (slopes <= 0).all():
        return -column
    return casadi.if_else(column[j] < 0, -1.0, 1.0) * column


def may_be_speed(e: Equations, name: str, force: str | None = None) -> bool:
    """Whether a state may be a velocity whose position is no state.

    Its rate is no other state, which would make it a position, and changes with the force, unless
    that is none of the inputs (None).
    """
    if name not in e.states or e.dt:
        return False
    own = e.states.index(name)
    rate = casadi.simplify(e.rhs[own])
    if any(casadi.is_equal(rate, e.x[k], 2) for k in range(len(e.states)) if k != own):
        return False
    pushed = force in e.inputs and casadi.jacobian(rate, e.u[e.inputs.index(force)]).nnz() > 0
    return force is None or pushed
