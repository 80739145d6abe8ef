"""The best of all cases: branches, families of rows with one free number, nonlinear functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from ..._base import text as _text
from ..._base.arrays import Array
from ..._base.errors import CtrlidError
from ..identified_model import ActiveBound, Structure
from . import AbstractConstraint
from .branches import (
    Case,
    Infeasible,
    Rows,
    eliminate_equalities,
    explain_conflict,
    is_forced,
    is_possible,
    list_cases,
)
from .nonlinear import solve_nonlinear
from .quadratic_program import Cost, Solution, compute_covariance, solve_program


@dataclass(frozen=True, eq=False)
class Found:
    """The constrained minimum, ready to become an `Estimate`.

    ``spread`` times the residual variance is the covariance, ``free`` the number of directions
    left free; both count an active bound as fixed.
    """

    theta: Array
    cost: float
    spread: Array
    free: int
    condition: float
    active_bounds: tuple[ActiveBound, ...]
    branch: str
    solver: str


@dataclass(frozen=True, eq=False)
class _Candidate:
    """Minimum of one case, the directions it cannot move in, its label, and an end it sits on."""

    solution: Solution
    normals: Array
    label: str
    edge: tuple[ActiveBound, ...] = ()


def minimize(cost: Cost, constraints: Sequence[AbstractConstraint], structure: Structure) -> Found:
    """Minimise a quadratic cost of the coefficients of a structure under constraints.

    Every combination of branches is a case of its own; the cheapest wins. Which constraint it
    has, this function does not know: it sees rows, families and functions.

    Parameters
    ----------
    cost : Cost
        What to minimise.
    constraints : sequence of AbstractConstraint
        What is known.
    structure : Structure
        Orders and names of the coefficients.

    Returns
    -------
    Found
        The minimum with its covariance, active bounds and winning branch.

    Raises
    ------
    CtrlidError
        If the constraints contradict each other: names a smallest contradicting set.
    NotExcited
        If data and constraints together leave a combination of coefficients free.
    """
    best: _Candidate | None = None
    for case in list_cases(constraints, structure):
        try:
            if is_forced(case.rows, case.nonzero):
                continue
            limit = np.inf if best is None else best.solution.cost
            candidate = _solve_case(cost, case, limit)
        except Infeasible:
            continue
        if candidate.solution.cost < limit:
            best = candidate
    if best is None:
        raise CtrlidError(_explain_failure(constraints, structure))
    solution = best.solution
    covariance, condition = compute_covariance(cost, best.normals)
    bounds = tuple(_make_active_bound(solution, i) for i in solution.active) + best.edge
    unstable = [repr(c) for c in constraints if c.unstable]
    bounds = tuple(replace(b, unstable=b.constraint in unstable) for b in bounds)
    free = len(cost.origin) - len(
        eliminate_equalities(best.normals, np.zeros(len(best.normals))).pivots
    )
    return Found(
        solution.theta,
        solution.cost,
        covariance,
        free,
        condition,
        bounds,
        best.label,
        solution.solver,
    )


def _explain_failure(constraints: Sequence[AbstractConstraint], structure: Structure) -> str:
    if not is_possible(constraints, structure):
        return explain_conflict(constraints, structure)
    names = _text.write_list([repr(c) for c in constraints])
    return (
        f"No coefficients that satisfy {names} were found from any start. Check the functions at "
        "coefficients where you know they hold, or loosen the other constraints."
    )


def _make_active_bound(solution: Solution, i: int) -> ActiveBound:
    row, weights = solution.rows.rows[i], solution.rows.weights[i]
    value = float(weights @ solution.theta)
    above = abs(value - solution.rows.upper[i]) <= abs(value - solution.rows.lower[i])
    bound = row.upper if above else row.lower
    # The difference, since the row of a function is its linearisation at the solution.
    free = bound + float(weights @ (solution.free_theta - solution.theta))
    return ActiveBound(repr(row), solution.rows.owners[i], row.quantity, bound, free)


def _solve_case(cost: Cost, case: Case, limit: float) -> _Candidate:
    label = ", ".join(case.labels)
    if case.family is None:
        if case.functions:
            return _Candidate(*solve_nonlinear(cost, case.rows, case.functions), label)
        solution = solve_program(cost, case.rows, below=limit)
        return _Candidate(solution, solution.normals, label)
    owner, _, branch = case.family
    if case.functions:
        raise CtrlidError(
            f"{owner} searches for a free number in this model and cannot be combined with "
            f"{case.functions[0][0]}: write both as functions of one Nonlinear."
        )
    x, solution, normals = _search_family(cost, case)
    end = f"{branch.label} = {x:.7g}"
    edge = (ActiveBound(end, owner, branch.label, x, np.nan),) if x in _find_ends(case) else ()
    return _Candidate(solution, normals, ", ".join(filter(None, [label, end])), edge)


def _find_ends(case: Case) -> tuple[float, float]:
    return float(case.grid[0]), float(case.grid[-1])


def _search_family(cost: Cost, case: Case) -> tuple[float, Solution, Array]:
    """Find the best member of a family: scan, refine in the brackets, finish by Newton steps."""

    def value(x: float) -> float:
        try:
            return solve_program(cost, case.at(x)).cost
        except Infeasible:
            return np.inf

    grid = np.array(case.grid)
    values = np.array([value(x) for x in grid])
    if not np.isfinite(values).any():
        raise Infeasible
    padded = np.concatenate([[np.inf], values, [np.inf]])
    valleys = np.flatnonzero((values <= padded[:-2]) & (values <= padded[2:]) & np.isfinite(values))
    best_x, best_value = 0.0, np.inf
    for i in valleys[np.argsort(values[valleys])][:4]:
        x, at_x = float(grid[i]), float(values[i])
        low, high = grid[max(i - 1, 0)], grid[min(i + 1, len(grid) - 1)]
        inside = minimize_scalar(
            value, bounds=(low, high), method="bounded", options={"xatol": 1e-12}
        )
        if inside.fun < at_x:
            x, at_x = float(inside.x), float(inside.fun)
        if at_x < best_value:
            best_x, best_value = x, at_x
    return _refine_family(cost, case, best_x)


def _refine_family(cost: Cost, case: Case, x: float) -> tuple[float, Solution, Array]:
    """Take Newton steps on coefficients and the family's number together.

    A line search in x stops at half the digits of x. To first order the family lets its rows move
    along ``slope`` when x moves, so the rows at right angles to the slope are what truly holds:
    they give the next coefficients, and the rest the next x.
    """
    solution = solve_program(cost, case.at(x))
    fixed = len(case.rows.lower)
    ends = _find_ends(case)
    for _ in range(8):
        rows = case.at(x)
        step = 1e-6 * max(abs(x), 1e-3)
        ahead, behind = case.at(min(x + step, ends[1])), case.at(max(x - step, ends[0]))
        width = min(x + step, ends[1]) - max(x - step, ends[0])
        theta = solution.theta
        slope = (_compute_gap(ahead, theta) - _compute_gap(behind, theta))[fixed:] / width
        length = float(slope @ slope)
        if length == 0:
            break
        loose = _loosen_rows(rows, fixed, slope)
        try:
            moved = solve_program(cost, loose)
        except Infeasible:
            break
        new_x = x - float(slope @ _compute_gap(rows, moved.theta)[fixed:]) / length
        if not ends[0] <= new_x <= ends[1] or abs(new_x - x) > 1e-3 * max(abs(x), 1e-3):
            break
        done = abs(new_x - x) <= 4e-16 * abs(x)
        x = new_x
        solution = solve_program(cost, case.at(x))
        if done:
            break
    rows = case.at(x)
    if x in ends:
        return x, solution, solution.normals
    step = 1e-6 * max(abs(x), 1e-3)
    slope = (
        _compute_gap(case.at(x + step), solution.theta)
        - _compute_gap(case.at(x - step), solution.theta)
    )[fixed:]
    loose = _loosen_rows(rows, fixed, slope)
    solution = replace(solution, free_theta=solve_program(cost, loose).free_theta)
    active = rows.weights[list(solution.active)]
    return x, solution, np.vstack([loose.weights[loose.equality], active])


def _compute_gap(rows: Rows, theta: Array) -> Array:
    gap: Array = rows.weights @ theta - np.where(rows.equality, rows.lower, 0.0)
    return gap


def _loosen_rows(rows: Rows, fixed: int, slope: Array) -> Rows:
    """Replace the family's rows by their combinations at right angles to the slope."""
    q = np.linalg.qr(slope[:, None], mode="complete")[0][:, 1:]
    weights, values = q.T @ rows.weights[fixed:], q.T @ rows.lower[fixed:]
    head = slice(0, fixed)
    kept = Rows(
        rows.weights[head], rows.lower[head], rows.upper[head], rows.rows[head], rows.owners[head]
    )
    names = tuple(rows.rows[fixed] for _ in values)
    return kept + Rows(weights, values, values, names, tuple(rows.owners[fixed] for _ in values))
