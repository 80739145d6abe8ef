"""Least squares under linear rows: the one place that calls a quadratic-programming solver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import qpsolvers
from numpy.typing import NDArray
from scipy.optimize import nnls

from ..._base.arrays import Array
from ..._base.errors import CtrlidError
from .branches import (
    Elimination,
    Infeasible,
    Rows,
    eliminate_equalities,
    is_feasible,
    split_inequalities,
)

IndexArray = NDArray[np.intp]

TOLERANCE = 1e-10
"""Absolute tolerance handed to the solver, in units where the largest violation is one."""


# After so many exchanges for each row the search for the active set is given up.
_ROUNDS = 10


class NotExcited(Exception):
    """The data leave a combination of coefficients free; carries that direction in theta."""

    def __init__(self, direction: Array) -> None:
        super().__init__("the regression has no unique solution")
        self.direction = direction


@dataclass(frozen=True, eq=False)
class Cost:
    """A quadratic cost of the coefficients, ``|| R (theta - origin) in the basis - d ||^2``.

    ``theta = origin + basis @ delta`` and ``cost = || R delta - d ||^2``. With a basis in which
    the columns of R are far from parallel (the differenced one of a sampled model) nothing is
    lost to rounding at fast sampling, where theta itself is all but undetermined. A cost
    ``theta' H theta / 2 - g' theta`` comes in as the Cholesky factor of H.

    Parameters
    ----------
    R : (m, p) array
        Least-squares rows, or their triangular factor.
    d : (m,) array
        Right-hand side.
    basis : (p, p) array
        From the coordinates of R to coefficients.
    origin : (p,) array
        Coefficients at ``delta = 0``.
    floor : float
        Singular values of R with unit columns below this are rounding errors.
    """

    R: Array
    d: Array
    basis: Array
    origin: Array
    floor: float = 1e-11

    @property
    def scale(self) -> Array:
        """Column norms of R."""
        norms: Array = np.linalg.norm(self.R, axis=0)
        return np.where(norms > 0, norms, 1.0)

    def scaled(self) -> Cost:
        """Return the same cost in coordinates where the columns of R have norm one."""
        scale = self.scale
        return Cost(self.R / scale, self.d, self.basis / scale, self.origin, self.floor)


@dataclass(frozen=True, eq=False)
class Solution:
    """Minimum of a cost under rows.

    ``cost`` is the cost there, ``normals`` are the rows held with equality, ``active`` the indices
    of the inequalities among them, ``free_theta`` the minimum under the equalities alone.
    """

    theta: Array
    cost: float
    rows: Rows
    normals: Array
    active: tuple[int, ...]
    free_theta: Array
    solver: str


@dataclass(frozen=True, eq=False)
class _Reduced:
    """Under equalities: ``s = s0 + step @ (u0 + u)`` and ``cost = | u |^2`` plus a constant."""

    elimination: Elimination
    s0: Array
    step: Array
    u0: Array
    singular: Array


def _reduce_cost(cost: Cost, weights: Array, values: Array) -> _Reduced:
    """Minimise a scaled cost under equalities by an orthogonal null-space method."""
    e = eliminate_equalities(weights, values)
    p, rank = len(cost.origin), len(e.pivots)
    s0, null = np.zeros(p), np.eye(p)
    if rank:
        k = e.weights @ cost.basis
        size = np.linalg.norm(k, axis=1)
        q, r = np.linalg.qr((k / size[:, None]).T, mode="complete")
        right = (e.values - e.weights @ cost.origin) / size
        s0 = q[:, :rank] @ np.linalg.solve(r[:rank].T, right)
        null = q[:, rank:]
    if rank == p:
        return _Reduced(e, s0, null, np.zeros(0), np.ones(1))
    left, singular, right_t = np.linalg.svd(cost.R @ null, full_matrices=False)
    if singular[-1] <= cost.floor:
        raise NotExcited(cost.basis @ null @ right_t[-1])
    step = null @ (right_t.T / singular)
    return _Reduced(e, s0, step, left.T @ (cost.d - cost.R @ s0), singular)


def _find_minimum(cost: Cost, reduced: _Reduced) -> tuple[Array, float]:
    s = reduced.s0 + reduced.step @ reduced.u0
    theta = reduced.elimination.snap(cost.origin + cost.basis @ s)
    return theta, float(np.sum((cost.R @ s - cost.d) ** 2))


def solve_program(cost: Cost, rows: Rows, below: float = np.inf) -> Solution:
    """Minimise a quadratic cost under linear equalities and inequalities.

    Equalities are eliminated, the rest becomes the projection of a point on a polyhedron, which
    ProxQP solves in units where the largest violation is one. Its answer only proposes the active
    set: the minimum on that set is computed exactly and its optimality checked.

    Parameters
    ----------
    cost : Cost
        What to minimise.
    rows : Rows
        What must hold.
    below : float
        A cost already reached elsewhere: a minimum that cannot come below it is not sought.

    Returns
    -------
    Solution
        The minimum; fixed coefficients and active bounds are met exactly.

    Raises
    ------
    Infeasible
        If no coefficients satisfy the rows, or none that come below.
    NotExcited
        If the minimum is not unique.
    CtrlidError
        If the solver fails although a solution exists.
    """
    cost = cost.scaled()
    equality = rows.equality
    weights, values = rows.weights[equality], rows.lower[equality]
    free = _reduce_cost(cost, weights, values)
    free_theta, free_cost = _find_minimum(cost, free)
    if free_cost >= below:
        raise Infeasible
    g, h, origin, sign = split_inequalities(rows)
    full = g @ cost.basis
    slope = full @ free.step
    room = h - g @ cost.origin - full @ (free.s0 + free.step @ free.u0)
    norm = np.linalg.norm(slope, axis=1)
    # Rows that the equalities already decide carry no direction of their own.
    size = np.linalg.norm(full, axis=1) / free.singular[-1]
    decided = norm <= 1e-11 * size
    terms = np.abs(h) + np.abs(g) @ np.abs(free.elimination.offset)
    if np.any(room[decided] < -1e-9 * terms[decided]):
        raise Infeasible
    origin, on_bound = origin[~decided], (sign * h)[~decided]
    slope, room = slope[~decided] / norm[~decided, None], room[~decided] / norm[~decided]
    worst = float(-room.min(initial=0.0))
    if worst <= 1e-13 * float(np.linalg.norm(cost.d)):
        text = "orthogonal least squares" + (
            " with the equality constraints eliminated" if len(values) else ""
        )
        return Solution(free_theta, free_cost, rows, weights, (), free_theta, text)
    held = _find_active_set(slope, room / worst, rows)
    active = origin[held]
    normals = np.vstack([weights, rows.weights[active]])
    bound = _reduce_cost(cost, normals, np.concatenate([values, on_bound[held]]))
    theta, at_bound = _find_minimum(cost, bound)
    text = "ProxQP, then exact least squares on the active set"
    return Solution(theta, at_bound, rows, normals, tuple(map(int, active)), free_theta, text)


def _find_active_set(slope: Array, room: Array, rows: Rows) -> IndexArray:
    """Return the rows held with equality at the point of ``slope @ u <= room`` nearest to zero.

    ProxQP proposes; then rows with a multiplier of the wrong sign leave and violated rows enter
    until the optimality conditions hold to rounding.
    """
    n = slope.shape[1]
    problem = qpsolvers.Problem(np.eye(n), np.zeros(n), slope, room)
    proposal = qpsolvers.solve_problem(problem, solver="proxqp", eps_abs=TOLERANCE, eps_rel=0.0)
    # An infeasible problem leaves numbers in x all the same: only `found` and our own check count.
    if proposal.found and proposal.z is not None:
        held = _exchange_rows(slope, room, np.flatnonzero(proposal.z > 1e-6))
        if held is not None:
            return held
    if not is_feasible(rows, rows.none()):
        raise Infeasible
    # Slower, but sure to end: the nearest point as a non-negative least-squares problem.
    dual = nnls(np.vstack([-slope.T, -room]), np.r_[np.zeros(n), 1.0])[0]
    held = _exchange_rows(slope, room, np.flatnonzero(dual > 1e-12))
    if held is not None:
        return held
    raise CtrlidError(
        "The quadratic program of the constrained fit could not be solved to its optimality "
        f"conditions; its rows are {', '.join(map(repr, rows.rows))}. The usual cause are bounds "
        "that nearly contradict each other: loosen or drop one of them."
    )


def _exchange_rows(slope: Array, room: Array, start: IndexArray) -> IndexArray | None:
    held = [int(i) for i in start]
    for _ in range(_ROUNDS * (1 + len(room))):
        u = np.zeros(slope.shape[1])
        if held:
            a = slope[held]
            mu = np.linalg.lstsq(a @ a.T, -room[held], rcond=1e-12)[0]
            if mu.min() < -1e-9 * max(1.0, float(np.abs(mu).max())):
                held.pop(int(np.argmin(mu)))
                continue
            u = -a.T @ mu
        violation = slope @ u - room
        worst = int(np.argmax(violation))
        if violation[worst] <= 1e-9:
            return np.array(held, dtype=np.intp)
        if worst in held:
            return None
        held.append(worst)
    return None


def compute_covariance(cost: Cost, normals: Array) -> tuple[Array, float]:
    """Return how equation errors of variance one scatter the coefficients.

    Parameters
    ----------
    cost : Cost
        The regression.
    normals : (k, p) array
        Directions in which the coefficients cannot move.

    Returns
    -------
    covariance : (p, p) array
        ``Z (Z' R'R Z)^-1 Z'``, exactly zero for coefficients that cannot move.
    condition : float
        Condition number of the scaled regression in the free directions.
    """
    cost = cost.scaled()
    reduced = _reduce_cost(cost, normals, np.zeros(len(normals)))
    half = cost.basis @ reduced.step
    half[~reduced.elimination.directions.any(axis=1)] = 0.0
    condition = float(reduced.singular[0] / reduced.singular[-1])
    return half @ half.T, condition
