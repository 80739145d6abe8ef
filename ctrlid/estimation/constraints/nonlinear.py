"""Nonlinear constraints: a sequence of quadratic programs from several starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..._base.arrays import Array
from ..._base.errors import CtrlidError
from . import Branch, Row
from .branches import Infeasible, Rows
from .quadratic_program import Cost, Solution, solve_program

# Each sequence ends in a local minimum, so that so many random starts are tried.
_STARTS = 12
# A sequence that needs more quadratic programs does not converge.
_ITERATIONS = 80
# A function or row holds if it is violated by less than this share of its own terms.
_FEASIBLE = 1e-8


@dataclass(frozen=True, eq=False)
class _Functions:
    """All nonlinear functions as one vector ``c(theta)``: equalities first."""

    functions: tuple[tuple[str, Branch], ...]
    # Sizes of the coefficients, by which the steps of the differences are scaled.
    typical: Array

    def evaluate_parts(self, theta: Array) -> tuple[Array, int, list[tuple[str, str]]]:
        """Return values, the number of equalities, and for each its owner and its words."""
        values: list[Array] = []
        words: list[tuple[str, str]] = []
        count = 0
        for kind in ("equality", "inequality"):
            for owner, branch in self.functions:
                function = getattr(branch, kind)
                if function is None:
                    continue
                value = np.atleast_1d(np.asarray(function(theta.copy()), dtype=float)).ravel()
                values.append(value)
                name = getattr(function, "__name__", "<lambda>")
                name = kind if name == "<lambda>" else name
                words += [(owner, f"{name}(theta)")] * len(value)
                count += len(value) * (kind == "equality")
        return np.concatenate(values), count, words

    def __call__(self, theta: Array) -> Array:
        """Return the values of all functions."""
        return self.evaluate_parts(theta)[0]

    def jacobian(self, theta: Array) -> Array:
        """Return central differences, ``(functions, p)``."""
        columns = []
        for i, h in enumerate(6e-6 * np.maximum(np.abs(theta), self.typical)):
            e = np.zeros(len(theta))
            e[i] = h
            columns.append((self(theta + e) - self(theta - e)) / (2 * h))
        return np.column_stack(columns)

    def curvature(self, theta: Array, multipliers: Array) -> Array:
        """Return the Hessian of ``multipliers @ c`` by central differences, ``(p, p)``."""
        p = len(theta)
        steps = np.diag(2e-4 * np.maximum(np.abs(theta), self.typical))
        hessian = np.empty((p, p))
        for i in range(p):
            for j in range(i + 1):
                corners = [
                    sign_i
                    * sign_j
                    * (multipliers @ self(theta + sign_i * steps[i] + sign_j * steps[j]))
                    for sign_i in (1, -1)
                    for sign_j in (1, -1)
                ]
                hessian[i, j] = hessian[j, i] = sum(corners) / (4 * steps[i, i] * steps[j, j])
        return hessian


def solve_nonlinear(
    cost: Cost, rows: Rows, functions: tuple[tuple[str, Branch], ...]
) -> tuple[Solution, Array]:
    """Minimise a quadratic cost under rows and nonlinear functions.

    Parameters
    ----------
    cost : Cost
        What to minimise.
    rows : Rows
        Linear rows.
    functions : tuple of (owner, Branch)
        Functions ``equality(theta) = 0`` and ``inequality(theta) >= 0``.

    Returns
    -------
    solution : Solution
        The best local minimum found; its rows hold the linearised functions too.
    normals : (k, p) array
        Directions in which the coefficients cannot move.

    Raises
    ------
    Infeasible
        If no start leads to coefficients that satisfy everything.
    """
    cost = cost.scaled()
    start = solve_program(cost, rows)
    s = np.linalg.lstsq(cost.basis, start.theta - cost.origin, rcond=None)[0]
    typical = np.maximum(np.abs(start.theta), np.abs(cost.basis) @ np.abs(s))
    typical = np.where(typical > 0, typical, 1.0)
    c = _Functions(functions, typical)
    _check_functions(c, start.theta)
    rng = np.random.default_rng(0)
    reach = max(float(np.linalg.norm(s)), float(np.linalg.norm(cost.d)))
    starts = [start.theta]
    for k in range(_STARTS):
        direction = rng.standard_normal(len(s))
        radius = 10.0 ** (k % 4 - 1) * reach
        starts.append(start.theta + cost.basis @ direction * radius / np.linalg.norm(direction))
    best: Solution | None = None
    for theta in starts:
        try:
            found = _run_sequence(cost, rows, c, theta, reach)
        except Infeasible:
            continue
        if best is None or found.cost < best.cost:
            best = found
    if best is None:
        raise Infeasible
    text = f"a sequence of quadratic programs from {len(starts)} starts"
    best = Solution(best.theta, best.cost, best.rows, best.normals, best.active, start.theta, text)
    return best, best.normals


def _check_functions(c: _Functions, theta: Array) -> None:
    for owner, branch in c.functions:
        for function in (branch.equality, branch.inequality):
            if function is None:
                continue
            try:
                value = np.asarray(function(theta.copy()), dtype=float)
            except (TypeError, ValueError, IndexError) as error:
                raise CtrlidError(
                    f"A function of {owner} failed at theta = {theta}: {error}. It is called with "
                    "the vector (a1 .. a_na, b1 .. b_nb) and must return a number or an array."
                ) from error
            if not np.all(np.isfinite(value)):
                raise CtrlidError(
                    f"A function of {owner} gave {value} at theta = {theta}, which is the fit "
                    "without this constraint. It must be finite there."
                )


def _compute_violation(c: Array, equalities: int) -> Array:
    v: Array = np.concatenate([np.abs(c[:equalities]), np.maximum(-c[equalities:], 0.0)])
    return v


def _compute_linear_violation(rows: Rows, theta: Array) -> float:
    value = rows.weights @ theta
    return float(np.sum(np.maximum(rows.lower - value, 0) + np.maximum(value - rows.upper, 0)))


def _run_sequence(cost: Cost, rows: Rows, c: _Functions, theta: Array, reach: float) -> Solution:
    """Run one sequence: linearise the functions, solve the QP, shorten the step by an l1 merit."""
    inverse = np.linalg.inv(cost.basis)
    hessian = cost.R.T @ cost.R

    def cost_at(x: Array) -> float:
        return float(np.sum((cost.R @ (inverse @ (x - cost.origin)) - cost.d) ** 2))

    def merit(x: Array, size: Array, penalty: float) -> float:
        values, equalities, _ = c.evaluate_parts(x)
        if not np.isfinite(values).all():
            return np.inf
        broken = float(
            np.sum(_compute_violation(values, equalities) / size)
        ) + _compute_linear_violation(rows, x)
        return cost_at(x) + penalty * broken

    penalty = 0.0
    multipliers = np.zeros(len(c(theta)))
    for _ in range(_ITERATIONS):
        values, equalities, words = c.evaluate_parts(theta)
        slopes = c.jacobian(theta)
        if not (np.isfinite(values).all() and np.isfinite(slopes).all()):
            raise Infeasible
        size = _estimate_sizes(slopes, cost, reach)
        model = _add_curvature(
            cost, inverse @ (theta - cost.origin), hessian, c, theta, multipliers
        )
        step = _solve_linearized(model, rows, slopes, values, equalities, theta, words)
        direction = step.theta - theta
        # Multipliers by least squares on what the step holds with equality.
        gradient = 2 * model.R.T @ (model.R @ inverse @ (step.theta - cost.origin) - model.d)
        normals = step.normals @ cost.basis
        held = np.asarray(np.linalg.lstsq(normals.T, gradient, rcond=None)[0], dtype=float)
        multipliers = _assign_multipliers(held, rows, equalities, step.active, len(values))
        largest = float(np.max(np.abs(multipliers) * size, initial=0.0))
        penalty = max(penalty, 2 * largest, 1e-3 * cost_at(theta))
        before = merit(theta, size, penalty)
        length = 1.0
        while length > 1e-6:
            # Rounding of the merit itself must not stop the last full steps.
            if merit(theta + length * direction, size, penalty) <= before * (1 + 1e-12):
                break
            length /= 2
        theta = step.theta if length == 1.0 else theta + length * direction
        if length <= 1e-6 or length * np.linalg.norm(inverse @ direction) <= 1e-11 * reach:
            break
    return _check_end_point(cost, rows, c, theta, reach, cost_at(theta))


def _estimate_sizes(slopes: Array, cost: Cost, reach: float) -> Array:
    """Return the size of each function: what all coefficients moved by their reach do to it."""
    size: Array = np.maximum(np.linalg.norm(slopes @ cost.basis, axis=1) * reach, 1e-300)
    return size


def _solve_linearized(
    model: Cost,
    rows: Rows,
    slopes: Array,
    values: Array,
    equalities: int,
    theta: Array,
    words: list[tuple[str, str]],
) -> Solution:
    """Solve the linearised problem; where that has no solution, ask for part of the way."""
    for fraction in (1.0, 0.5, 0.1, 0.01):
        try:
            return solve_program(
                model,
                rows + _linearize_functions(slopes, values, equalities, theta, words, fraction),
            )
        except Infeasible:
            continue
    raise Infeasible


def _check_end_point(
    cost: Cost, rows: Rows, c: _Functions, theta: Array, reach: float, value: float
) -> Solution:
    """Check that the end point holds; describe what it rests on."""
    values, equalities, words = c.evaluate_parts(theta)
    slopes = c.jacobian(theta)
    size = _estimate_sizes(slopes, cost, reach)
    if np.any(_compute_violation(values, equalities) > _FEASIBLE * size):
        raise Infeasible
    linear = np.abs(rows.weights) @ np.abs(theta) + 1e-300
    reached = rows.weights @ theta
    below, above = rows.lower - reached, reached - rows.upper
    if np.any(np.maximum(below, above) > _FEASIBLE * linear):
        raise Infeasible
    lines = _linearize_functions(slopes, values, equalities, theta, words, 1.0)
    everything = rows + lines
    size = np.concatenate([linear, size])
    tight = np.minimum(np.abs(below), np.abs(above)) <= _FEASIBLE * linear
    tight = np.concatenate([tight, np.abs(values) <= _FEASIBLE * size[len(linear) :]])
    active = np.flatnonzero(tight & ~everything.equality)
    normals = np.vstack([everything.weights[everything.equality], everything.weights[active]])
    return Solution(theta, value, everything, normals, tuple(map(int, active)), theta, "")


def _linearize_functions(
    slopes: Array,
    values: Array,
    equalities: int,
    theta: Array,
    words: list[tuple[str, str]],
    fraction: float,
) -> Rows:
    """Write the functions as rows: the step removes this fraction of what is violated."""
    right = slopes @ theta - np.where(values < 0, fraction, 1.0) * values
    right[:equalities] = (slopes @ theta - fraction * values)[:equalities]
    upper = np.full(len(values), np.inf)
    upper[:equalities] = right[:equalities]
    names = tuple(
        Row({word: 1.0}, 0.0, 0.0 if i < equalities else np.inf)
        for i, (_, word) in enumerate(words)
    )
    return Rows(slopes, right, upper, names, tuple(owner for owner, _ in words))


def _assign_multipliers(
    held: Array, rows: Rows, equalities: int, active: Sequence[int], count: int
) -> Array:
    """Return the multipliers of the functions, in their own order, from those of the rows held."""
    first = int(rows.equality.sum())
    multipliers = np.zeros(count)
    multipliers[:equalities] = held[first : first + equalities]
    for i, value in zip(active, held[first + equalities :], strict=True):
        if i >= len(rows.lower):
            multipliers[i - len(rows.lower)] = value
    return multipliers


def _add_curvature(
    cost: Cost,
    s: Array,
    hessian: Array,
    c: _Functions,
    theta: Array,
    multipliers: Array,
) -> Cost:
    """Return the quadratic model with the curvature of the functions, kept convex."""
    if not multipliers.any():
        return cost
    curved = cost.basis.T @ c.curvature(theta, multipliers) @ cost.basis
    if not np.isfinite(curved).all():
        return cost
    # cost = s' H s - ...: twice the Hessian of the model is 2 H - bend.
    values, vectors = np.linalg.eigh(hessian - curved / 2)
    least = 1e-3 * float(np.linalg.eigvalsh(hessian)[0])
    root = np.sqrt(np.maximum(np.abs(values), least))
    upper = root[:, None] * vectors.T
    gradient = hessian @ s - cost.R.T @ cost.d
    d = upper @ s - np.linalg.solve(upper.T, gradient)
    return Cost(upper, d, cost.basis, cost.origin, cost.floor * 1e-2)
