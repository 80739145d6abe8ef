"""Operating points and exact linear models of a plant."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi
import control as ct
import numpy as np
from scipy import linalg

from .._base.arguments import check_arguments, explain_names, is_number
from .._base.arrays import Array, to_real_array
from .._base.errors import CtrlidError, ModelCannotRun
from .._base.interruption import hold_interrupt
from .._base.rounding import keep_numpy_quiet
from .._base.text import write_count
from .conversions import to_polynomials
from .equations import Equations
from .trace import trace

# A state with a smaller relative coupling is reached by rounding errors only.
UNREACHABLE = 1e-12
# An equilibrium is accepted if its residual is below this share of the terms that cancel there.
EQUILIBRIUM = 1e-9
# Smaller numbers than this may be round-off of zero, whatever their unit is.
TINY = 1e-12
# A point is called none where more than this share of the terms is left: a rounded input, or a
# parameter that is known to ten per cent, leaves less.
UNBALANCED = 0.05
# Where nothing balances a rate, this share of the terms is left.
NOT_AT_ALL = 0.9
# The search for equilibria starts from so many random points, and from as many far ones where they
# find none.
STARTS = 60
# As large as a state is sought, where nothing is found nearer.
FARTHEST = 1e8

WANTED = "an operating point is given by numbers: states=(...), input=, output=, which"


@dataclass(frozen=True)
class OperatingPoint:
    """Where a plant rests: its states, input and output in physical units.

    Parameters
    ----------
    states : sequence of float
        State values in the order of the plant's states [their units].
    input : float or tuple of float
        The input there [its unit], which is also the bias that a one-input controller adds; of a
        plant with several inputs, one value for each.
    output : float or tuple of float
        The output there [its unit], one value for each of several.

    Raises
    ------
    CtrlidError
        If a value is not a finite number.

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.OperatingPoint(states=(0.012, 0.0), input=3.0, output=0.012).input
    3.0
    >>> cid.OperatingPoint(states=(0, 0, 0, 0), input=0, output=(0, 0)).output
    (0.0, 0.0)
    """

    states: tuple[float, ...]
    input: Any
    output: Any

    def __post_init__(self) -> None:
        values = []
        for given in (self.states, self.input, self.output):
            array = np.atleast_1d(to_real_array(given, WANTED))
            if array.ndim > 1:
                raise CtrlidError(f"{WANTED}: given {self}")
            values.append(tuple(array.tolist()))
        states, inputs, outputs = values
        point = tuple(each[0] if len(each) == 1 else each for each in (inputs, outputs))
        if not np.isfinite([*states, *inputs, *outputs]).all():
            raise ModelCannotRun(
                f"an operating point must be finite; given states={states}, "
                f"input={point[0]}, output={point[1]}"
            )
        object.__setattr__(self, "states", states)
        object.__setattr__(self, "input", point[0])
        object.__setattr__(self, "output", point[1])

    @property
    def inputs(self) -> tuple[float, ...]:
        """The inputs as a tuple, also where there is one."""
        return tuple(np.ravel(self.input).tolist())

    @property
    def outputs(self) -> tuple[float, ...]:
        """The outputs as a tuple, also where there is one."""
        return tuple(np.ravel(self.output).tolist())


@dataclass(frozen=True)
class Imbalance:
    """A rate of a plant that is not zero at a point.

    Parameters
    ----------
    state : str
        The state that changes.
    rate : float
        By how much, a second or a sample [its unit].
    share : float
        That beside all terms of the rate; 1 where nothing cancels.
    steered : bool
        Whether a small change of the inputs changes the rate, or they are not in it at all.
    """

    state: str
    rate: float
    share: float
    steered: bool


def as_operating_point(at: Any, equations: Equations, inputs: Sequence[str]) -> OperatingPoint:
    """Return an operating point of ours, also from one of python-control.

    Parameters
    ----------
    at : OperatingPoint or control.OperatingPoint
        The point; what `control.find_operating_point` returns has states and inputs, and its
        outputs are computed.
    equations : Equations
        The plant, with the inputs that it is driven by.
    inputs : sequence of str
        All inputs of the plant as it was given; the point may have a value for each.

    Returns
    -------
    OperatingPoint
        The point, with the driven inputs only.

    Raises
    ------
    CtrlidError
        If it is something else, or has another number of states, inputs or outputs than the plant.
    """
    if isinstance(at, ct.OperatingPoint):
        states, given = (np.ravel(np.asarray(v, dtype=float)) for v in (at.states, at.inputs))
        if len(given) == len(inputs):
            given = given[[list(inputs).index(name) for name in equations.inputs]]
        if (len(states), len(given)) == (len(equations.states), len(equations.inputs)):
            outputs = equations.evaluate(states, given)[1] if at.outputs is None else at.outputs
            at = OperatingPoint(tuple(states), given, outputs)
        else:
            at = OperatingPoint(tuple(states), given, np.zeros(len(equations.outputs)))
    if not isinstance(at, OperatingPoint):
        raise CtrlidError(
            "at= needs an OperatingPoint, from operating_point(plant, output=...) or given as "
            f"OperatingPoint(states=, input=, output=); given {type(at).__name__}"
        )
    for what, values, names in (
        ("input", at.inputs, equations.inputs), ("output", at.outputs, equations.outputs)
    ):  # fmt: skip
        if len(values) != len(names):
            raise CtrlidError(
                f"at= has {write_count(len(values), what)}, but {equations.name} has {len(names)} "
                f"({', '.join(names)}); give {what}=({', '.join(['...'] * len(names))})"
            )
    return at


@explain_names
@hold_interrupt()
@keep_numpy_quiet
def operating_point(
    plant: Any, *, output: Any, guess: Sequence[float] | OperatingPoint | None = None
) -> OperatingPoint:
    r"""Return the equilibrium of a plant at a given output.

    .. math:: f(x_0, u_0) = 0, \quad h(x_0, u_0) = y_0

    States and input are solved together by Newton's method with the exact derivatives of the traced
    equations, from many starting points, and the equations are evaluated at the result. Of several
    equilibria the one with the smallest non-negative input is returned (a magnet pulls with
    either sign of the voltage), and without any such the one with the smallest input.

    Parameters
    ----------
    plant : control.NonlinearIOSystem, control.StateSpace or control.TransferFunction
        The plant.
    output : float or sequence of float
        The output to rest at [output unit]; of a plant with several outputs, one value for each. A
        single one may stand in a list, too.
    guess : sequence of float or OperatingPoint, optional
        States near which to look first [their units]; then the equilibrium found from there is
        returned.

    Returns
    -------
    OperatingPoint
        With floats `.input` and `.output`, tuples where there are several, and the tuple
        `.states`.

    Raises
    ------
    CtrlidError
        If there is no such equilibrium, or the plant cannot be traced.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.maglev(m=0.0213, K=3.34e-6, g=9.81)
    >>> op = cid.operating_point(plant, output=0.012)
    >>> op.states, round(op.input, 6)
    ((0.012, 0.0), 3.001458)
    """
    check_arguments(operating_point, locals(), "output")
    equations = trace(plant)
    one = len(equations.outputs) == 1
    listed = isinstance(output, list | tuple | np.ndarray)
    if one and not listed and not (is_number(output) and np.isfinite(float(output))):
        raise CtrlidError(f"output must be a finite number; given {output!r}")
    target = _check_target(equations, output)
    n = len(equations.states)
    residual = equations.rhs - equations.x if equations.dt else equations.rhs
    if casadi.depends_on(casadi.vertcat(residual, equations.output), equations.t):
        raise ModelCannotRun(
            f"{equations.name} changes with time by itself, because its equations use t, so that "
            "it has no operating point. Write the equations without t, and what they read from t "
            "as a further input or as a parameter held at one value"
        )
    z = casadi.vertcat(equations.x, equations.u)
    goal = casadi.vertcat(residual, equations.output - casadi.DM(target))
    both = casadi.Function("equilibrium", [z, equations.p], [goal, casadi.jacobian(goal, z)])
    values = equations.values

    def evaluate(point: Array) -> tuple[Array, Array]:
        f, jac = both(point, values)
        return np.asarray(f, float).ravel(), np.asarray(jac, float)

    found: list[Array] = []
    repeats = 0
    closest: tuple[float, Array] | None = None
    inputs = len(equations.inputs)
    starts = _draw_starts(n, target if one else [0.0], guess, inputs)
    far = len(starts) - STARTS
    for trial, start in enumerate(starts):
        if found and trial >= far:
            # Far starts are for plants of large numbers, such as pressures in Pa.
            break
        solution, error = _solve_equilibrium(evaluate, start, damped=trial % 3 == 2)
        if solution is None:
            continue
        if error < EQUILIBRIUM:
            known = any(np.allclose(solution, f, rtol=1e-6, atol=1e-9) for f in found)
            repeats = repeats + 1 if known else 0
            found.append(solution)
            # With a guess the first equilibrium is the wanted one, since the starts begin with it.
            if guess is not None or repeats >= 15:
                break
        elif trial < far and (closest is None or error < closest[0]):
            closest = (error, solution)
    if not found:
        hint = ""
        if closest is not None:
            near = ", ".join(f"{s}={v:.4g}" for s, v in zip(
                (*equations.states, *equations.inputs), closest[1], strict=True))  # fmt: skip
            hint = f" The nearest point found is {near}, which is no equilibrium."
        elif n > 1:
            hint = (" Its equations are not finite wherever the search ended. A root or a "
                    "logarithm of a negative number has no value. A quotient such as "
                    "v / abs(v) has no value at v = 0: write np.sign(v).")  # fmt: skip
        wanted = ", ".join(
            f"{name} = {value:g}" for name, value in zip(equations.outputs, target, strict=True)
        )
        raise ModelCannotRun(
            f"{equations.name} has no equilibrium with {wanted}: from {len(starts)} starting "
            f"points, with states of up to {FARTHEST:g}, no states and input "
            f"{', '.join(equations.inputs)} were found that hold it there.{hint} Choose an output "
            "inside the range of the plant, or give guess= near an equilibrium"
        )
    if inputs == 1:
        best = min(found, key=lambda s: (s[n] < -1e-12 * abs(s).max(), abs(s[n])))
    else:
        best = min(found, key=lambda s: float(np.sum(s[n:] ** 2)))
    return OperatingPoint(tuple(best[:n].tolist()), best[n:] + 0.0, target)


def _check_target(equations: Equations, output: Any) -> list[float]:
    """Return the outputs to rest at, one for each that the plant has."""
    values = np.ravel(np.asarray(output))
    names = equations.outputs
    if values.dtype.kind not in "fiu" or len(values) != len(names) or not np.isfinite(values).all():
        raise CtrlidError(
            f"output needs {write_count(len(names), 'finite number')}, one for each output of "
            f"{equations.name} ({', '.join(names)}); given {output!r}"
        )
    return [float(v) for v in values]


def _draw_starts(n: int, target: Sequence[float], guess: Any, inputs: int = 1) -> list[Array]:
    rng = np.random.default_rng(1)
    starts = []
    if isinstance(guess, OperatingPoint):
        if len(guess.states) != n:
            raise CtrlidError(f"guess needs {write_count(n, 'state')}; given {len(guess.states)}")
        starts.append(np.array([*guess.states, *guess.inputs]))
    elif guess is not None:
        states = np.atleast_1d(to_real_array(guess, "guess"))
        if states.shape != (n,):
            raise CtrlidError(f"guess needs {write_count(n, 'state')}; given {states.size}")
        sizes = [s * 10.0**k for k in range(-2, 3) for s in (1, -1)]
        starts += [np.append(states, [size] * inputs) for size in sizes]
    for trial in range(2 * STARTS):
        most = 2.0 if trial < STARTS else math.log10(FARTHEST)
        size = 10.0 ** rng.uniform(-3, most, n + inputs)
        start = rng.choice([-1.0, 1.0], n + inputs) * size
        # The output is often a state, and the other states are often at rest.
        start[:n] = np.where(rng.random(n) < 0.6, target[0], start[:n])
        start[1:n] *= rng.random(max(n - 1, 0)) < (0.3 if trial % 2 else 1.0)
        if trial % 3:
            start[n:] = abs(start[n:])
        starts.append(start)
    return starts


def _solve_equilibrium(
    evaluate: Any, start: Array, damped: bool
) -> tuple[Array | None, float]:  # fmt: skip
    """Find a root by Newton's method, and its residual relative to what cancels there.

    Full steps solve the rows that are linear at once (the output is often a state) and are the
    best choice for products and powers; damped ones (Deuflhard's natural monotonicity test, which
    does not depend on the units of the equations) for the rest.
    """
    z = start
    f, jac = evaluate(z)
    for _ in range(50):
        if not (np.isfinite(f).all() and np.isfinite(jac).all()):
            return None, np.inf
        step = np.linalg.lstsq(jac, f, rcond=None)[0]
        scale = np.maximum(np.abs(z), 1e-9 + 1e-3 * np.abs(z).max())
        size = np.abs(step / scale).max()
        if size < 1e-15:
            break
        for damping in (1.0, 0.5, 0.25, 0.1, 0.03):
            f, next_jac = evaluate(z - damping * step)
            if np.isfinite(f).all():
                if not damped or size < 1e-10:
                    break
                correction = np.linalg.lstsq(jac, f, rcond=None)[0]
                if np.abs(correction / scale).max() <= (1 - damping / 4) * size:
                    break
        z, jac = z - damping * step, next_jac
    # A state that is at rest up to rounding is set to zero.
    z = np.where(np.abs(z) < max(1e-12 * np.abs(z).max(), 1e-20), 0.0, z)
    z = _drop_rounding(evaluate, z)
    error = _measure_residual(evaluate, z)
    if EQUILIBRIUM <= error < np.inf:
        held = _solve_at_rest(evaluate, z)
        rest = _measure_residual(evaluate, held)
        z, error = (held, rest) if rest < error else (z, error)
    return (z, error) if error < np.inf else (None, np.inf)


def _drop_rounding(evaluate: Any, z: Array) -> Array:
    """Return a solution with its tiny values at zero, if the equations hold there as well.

    Where the whole solution is zero nothing else says how large a number of round-off is.
    """
    rest = np.where(np.abs(z) < TINY, 0.0, z)
    if np.array_equal(rest, z):
        return z
    f, left = np.abs(evaluate(z)[0]), np.abs(evaluate(rest)[0])
    return rest if np.isfinite(left).all() and np.all(left <= f) else z


def _solve_at_rest(evaluate: Any, start: Array) -> Array:
    """Continue Newton's method with what is zero held at zero.

    Dry friction written as np.sign(v) is zero at rest, but the rounding of a step moves v, and the
    whole friction is then balanced by an input that no equilibrium has.
    """
    z, free = start.copy(), start != 0
    for _ in range(20):
        f, jac = evaluate(z)
        if not (np.isfinite(f).all() and np.isfinite(jac).all()):
            break
        step = np.linalg.lstsq(jac[:, free], f, rcond=None)[0]
        before = z[free]
        if np.all(np.abs(step) <= 1e-15 * np.abs(before)):
            break
        z[free] = np.where(np.abs(before - step) < 1e-12 * np.abs(before), 0.0, before - step)
    return z


def _measure_residual(evaluate: Any, z: Array) -> float:
    """Return the residual relative to what cancels there; infinite where there is none."""
    f, jac = evaluate(z)
    if not np.isfinite(f).all():
        return np.inf
    terms = np.abs(jac) @ np.abs(z) + np.abs(f)
    return float(np.max(np.where(f == 0, 0.0, np.abs(f) / np.where(terms > 0, terms, 1.0))))


def find_unbalanced_rate(equations: Equations, at: OperatingPoint) -> Imbalance | None:
    """Return the rate that is furthest from zero at a point, beside what cancels in it there.

    Parameters
    ----------
    equations : Equations
        The plant.
    at : OperatingPoint
        The point.

    Returns
    -------
    Imbalance or None
        The worst rate; None where all of them are balanced, or the point is out of the domain.
    """
    e = equations
    x, u = np.array(at.states), np.array(at.inputs)
    rates = e.evaluate(x, u)[0] - (x if e.dt else 0.0)
    a, b = e.derive(("jacobians", 0.0), lambda: _build_jacobians(e, 0.0))(
        0.0, x, u, e.values)[:2]  # fmt: skip
    a, b = np.asarray(casadi.DM(a), float), np.asarray(casadi.DM(b), float)
    if e.dt:
        a = a - np.eye(len(x))
    terms = np.abs(a) @ np.abs(x) + np.abs(b) @ np.abs(u) + np.abs(rates)
    if not rates.size or not np.isfinite([*rates, *terms]).all():
        return None
    shares = np.abs(rates) / np.where(terms > 0, terms, 1.0)
    k = int(np.argmax(shares))
    if shares[k] < UNBALANCED:
        return None
    steered = bool(np.any(b[k])) or not casadi.depends_on(e.rhs[k], e.u)
    return Imbalance(e.states[k], float(rates[k]), float(shares[k]), steered)


def _refuse_dead_point(equations: Equations, at: OperatingPoint) -> None:
    """Refuse a point that is no equilibrium, and at which the input cannot balance the plant."""
    # A point with other states than the plant's is refused where the matrices are computed.
    known = len(at.states) == len(equations.states)
    found = find_unbalanced_rate(equations, at) if known else None
    if found is None or found.steered or found.share < NOT_AT_ALL:
        return
    e = equations
    per = "a sample" if e.dt else "a second"
    raise ModelCannotRun(
        f"{e.name} does not rest at the operating point, where {found.state} changes by "
        f"{found.rate:.4g} {per}, and the input {', '.join(f'{v:g}' for v in at.inputs)} has no "
        "influence on that to first order, so that a linear model would have no gain. Give the "
        "point where it rests: at=operating_point(plant, output=...)"
    )


def compute_state_matrices(
    equations: Equations, at: OperatingPoint, spread: float = 0.0
) -> tuple[Array, Array, Array, Array]:
    """Return the exact Jacobians (A, B, C, D) of the traced equations at a point.

    With a `spread` the kinks of effects are smoothed as if each state had that standard deviation.
    """
    e = equations
    if len(at.states) != len(e.states):
        raise CtrlidError(
            f"the operating point has {write_count(len(at.states), 'state')} {at.states}, but "
            f"{e.name} has "
            f"{len(e.states)}: {', '.join(e.states)}"
        )
    jacobians = e.derive(("jacobians", spread), lambda: _build_jacobians(e, spread))
    a, b, c, d = (np.asarray(casadi.DM(m), float) for m in
                  jacobians(0.0, list(at.states), at.inputs, e.values))  # fmt: skip
    if not all(np.isfinite(m).all() for m in (a, b, c, d)):
        raise ModelCannotRun(
            f"{e.name} has no derivative at states {at.states}, input "
            f"{', '.join(f'{v:g}' for v in at.inputs)}: the point is "
            "outside its domain or on a corner; choose another operating point"
        )
    return a, b, c, d


def _build_jacobians(e: Equations, spread: float) -> Any:
    """Return the CasADi function ``(t, x, u, p) -> (A, B, C, D)``."""
    parts = [casadi.jacobian(f, z) for f in (e.rhs, e.output) for z in (e.x, e.u)]
    if e.spread is not None:
        level = casadi.SX.ones(*e.spread.shape) * spread
        parts = [casadi.substitute(part, e.spread, level) for part in parts]
    return casadi.Function("jacobians", [e.t, e.x, e.u, e.p], parts)


@explain_names
@hold_interrupt()
@keep_numpy_quiet
def linearize(plant: Any, at: OperatingPoint, *, states: bool = False) -> Any:
    r"""Return the linear model of a plant for small deviations from an operating point.

    .. math:: G(s) = C (s I - A)^{-1} B + D, \quad A = \partial f/\partial x, \;
        B = \partial f/\partial u, \; C = \partial h/\partial x

    The derivatives are those of the traced equations, without differencing, and the polynomials are
    formed in rational arithmetic, so that no dust coefficients appear: the levitated ball gives
    exactly ``-beta/(s^2 - alpha)``. States are removed only where the input does not reach
    them or the output does not show them. `control.linearize` returns a state-space model; here
    it is one with ``states=True``. For a state feedback take that one: the states of
    ``ct.ss(linearize(plant, at))`` are no physical quantities.

    Parameters
    ----------
    plant : control.NonlinearIOSystem, control.StateSpace or control.TransferFunction
        The plant; discrete plants give discrete models.
    at : OperatingPoint or control.OperatingPoint
        The point, from `operating_point` or given directly.
    states : bool, optional
        Whether to keep the states of the plant, all of them and in their order.

    Returns
    -------
    control.TransferFunction or control.StateSpace
        From the deviation of the input to the deviation of the output; with ``states=True``, and
        for a plant with several inputs or outputs, a state-space model of the deviations of the
        plant's states, under their names, as `control.lqr` needs it.

    Raises
    ------
    CtrlidError
        If the plant cannot be traced, or has no derivative at the point.

    Notes
    -----
    "Identification of a class of unstable processes" goes from ``-beta`` in equation (2) to
    ``beta/(s^2 - alpha)`` in (3), and from (1) to (2) without the mass. With both kept,
    ``alpha = 2 K V0^2/(m x0^3) = 2 g/x0``, ``beta = 2 K V0/(m x0^2) = 2 g/V0``, and
    the gain is negative: more voltage lifts the ball, which shortens the gap.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.maglev(m=0.0213, K=3.34e-6, g=9.81)
    >>> P = cid.linearize(plant, cid.operating_point(plant, output=0.012))
    >>> P.den[0][0].round(6).tolist()
    [1.0, 0.0, -1635.0]
    >>> cid.linearize(plant, cid.operating_point(plant, output=0.012), states=True).state_labels
    ['x', 'v']
    """
    check_arguments(linearize, locals())
    if not isinstance(at, OperatingPoint | ct.OperatingPoint):
        raise CtrlidError(
            f"linearize needs an OperatingPoint, as operating_point() returns; given "
            f"{type(at).__name__}"
        )
    equations = trace(plant)
    at = as_operating_point(at, equations, equations.inputs)
    if states or not equations.siso:
        return make_state_space(equations, at)
    _refuse_dead_point(equations, at)
    (num,), den = to_polynomials(*_reduce_to_minimal(*compute_state_matrices(equations, at)))
    return ct.tf(num, den, equations.dt if equations.dt else 0, name=f"{equations.name}_linear",
                 inputs=list(equations.inputs), outputs=list(equations.outputs))  # fmt: skip


def make_state_space(equations: Equations, at: OperatingPoint) -> Any:
    """Return the linear model of a plant at a point with all its states, and its names."""
    e = equations
    _refuse_dead_point(e, at)
    # python-control keeps dots for the names of systems.
    names = [name.replace(".", "_") for name in e.states]
    return ct.ss(*compute_state_matrices(e, at), e.dt if e.dt else 0, name=f"{e.name}_linear",
                 states=names, inputs=list(e.inputs), outputs=list(e.outputs))  # fmt: skip


def _reduce_to_minimal(a: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array, Array, Array]:
    """Keep the states that the input reaches and the output shows."""
    keep = find_reached_states(a, b) & find_reached_states(a.T, c.T)
    a, b, c = a[np.ix_(keep, keep)], b[keep], c[:, keep]
    if not a.size:
        return a, b, c, d
    scale = linalg.matrix_balance(
        np.block([[a, b], [c, np.zeros((1, 1))]]), permute=False, separate=True
    )[1][0][:-1]
    balanced = (a * scale / scale[:, None], b / scale[:, None], c * scale)
    q = _find_reachable_basis(balanced[0], balanced[1])
    qa, qb, qc = q.T @ balanced[0] @ q, q.T @ balanced[1], balanced[2] @ q
    w = _find_reachable_basis(qa.T, qc.T)
    if w.shape[1] == len(a):
        return a, b, c, d
    return w.T @ qa @ w, w.T @ qb, qc @ w, d


def find_reached_states(a: Array, b: Array) -> Any:
    """Return which states a signal entering through `b` reaches along the non-zero couplings."""
    reached = np.any(b != 0, axis=1)
    for _ in range(len(a)):
        reached = reached | np.any((a != 0) & reached[None, :], axis=1)
    return reached


def _find_reachable_basis(a: Array, b: Array) -> Array:
    """Return an orthonormal basis of the reachable subspace."""
    n = len(a)
    basis = np.empty((n, 0))
    block = b / max(float(np.linalg.norm(b)), np.finfo(float).tiny)
    size = max(float(np.linalg.norm(a)), np.finfo(float).tiny)
    while basis.shape[1] < n:
        # Orthogonalizing twice is enough (Kahan, Parlett).
        for _ in range(2):
            block = block - basis @ (basis.T @ block)
        left, gains, _ = np.linalg.svd(block, full_matrices=False)
        new = left[:, gains > UNREACHABLE]
        if not new.shape[1]:
            break
        basis = np.hstack([basis, new])
        block = a @ new / size
    return basis if basis.shape[1] < n else np.eye(n)
