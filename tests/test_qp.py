"""Least squares under rows: optimality, other solvers, degenerate and impossible problems."""

from __future__ import annotations

import numpy as np
import pytest
import qpsolvers
from hypothesis import given, settings
from hypothesis import strategies as st

import ctrlid as cid
from ctrlid._base.errors import CtrlidError
from ctrlid.estimation.constraints import Row
from ctrlid.estimation.constraints import quadratic_program as qp
from ctrlid.estimation.constraints.branches import Infeasible, Rows, list_cases
from ctrlid.estimation.constraints.constrained_minimum import minimize
from ctrlid.estimation.constraints.quadratic_program import (
    Cost,
    NotExcited,
    compute_covariance,
    solve_program,
)
from ctrlid.estimation.identified_model import Structure

Z2 = Structure(2, 2)


def problem(seed, p=4, m=30):
    rng = np.random.default_rng(seed)
    return Cost(rng.standard_normal((m, p)), rng.standard_normal(m), np.eye(p), np.zeros(p))


def rows_of(*rows):
    return Rows.build(Z2, [("test", row) for row in rows])


def random_rows(seed, count):
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(count):
        weights = dict(zip(Z2.names, rng.standard_normal(4), strict=True))
        rows.append(Row(weights, upper=float(rng.standard_normal() * 0.2 + 0.1)))
    return rows


def optimality(cost, rows, theta):
    """Gradient as a non-negative combination of the normals of tight rows: the residual of that."""
    from scipy.optimize import nnls

    gradient = 2 * cost.R.T @ (cost.R @ theta - cost.d)
    value = rows.weights @ theta
    upper = np.abs(value - rows.upper) < 1e-9
    lower = np.abs(value - rows.lower) < 1e-9
    normals = np.vstack([rows.weights[upper], -rows.weights[lower]])
    if not len(normals):
        return np.linalg.norm(gradient)
    return nnls(normals.T, -gradient)[1]


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 7), equalities=st.integers(0, 2))
def test_optimal_feasible_and_as_daqp_says(seed, count, equalities):
    cost = problem(seed)
    made = random_rows(seed + 1, count)
    made = [Row(r.weights, r.upper, r.upper) for r in made[:equalities]] + made[equalities:]
    rows = rows_of(*made)
    hessian, linear = cost.R.T @ cost.R, -cost.R.T @ cost.d
    e = rows.equality
    wanted = qpsolvers.solve_qp(
        hessian, linear, rows.weights[~e], rows.upper[~e],
        rows.weights[e] if e.any() else None, rows.lower[e] if e.any() else None, solver="daqp",
    )  # fmt: skip
    try:
        found = solve_program(cost, rows)
    except Infeasible:
        assert wanted is None
        return
    assert np.all(rows.weights @ found.theta <= rows.upper + 1e-9)
    assert np.all(rows.weights @ found.theta >= rows.lower - 1e-9)
    assert optimality(cost, rows, found.theta) < 1e-7
    np.testing.assert_allclose(found.theta, wanted, atol=1e-6)
    at = float(np.sum((cost.R @ found.theta - cost.d) ** 2))
    assert found.cost == pytest.approx(at, rel=1e-9)


def test_a_general_quadratic_cost_comes_in_by_its_cholesky_factor():
    rng = np.random.default_rng(2)
    half = rng.standard_normal((4, 4))
    hessian, linear = half @ half.T + np.eye(4), rng.standard_normal(4)
    upper = np.linalg.cholesky(hessian).T
    cost = Cost(upper, np.linalg.solve(upper.T, linear), np.eye(4), np.zeros(4))
    np.testing.assert_allclose(
        solve_program(cost, rows_of()).theta, np.linalg.solve(hessian, linear)
    )


def test_degenerate_vertices_and_repeated_rows():
    cost = Cost(np.eye(4), np.array([1.0, 1.0, 0.0, 0.0]), np.eye(4), np.zeros(4))
    upper = [Row({"a1": 1.0}, upper=0.0), Row({"a2": 1.0}, upper=0.0)]
    more = [Row({"a1": 1.0, "a2": 1.0}, upper=0.0), Row({"a1": 2.0}, upper=0.0), upper[0]]
    found = solve_program(cost, rows_of(*upper, *more))
    np.testing.assert_array_equal(found.theta, [0.0, 0.0, 0.0, 0.0])
    assert found.cost == pytest.approx(2.0)


def test_impossible_rows_are_found_out_although_the_solver_returns_numbers():
    rows = rows_of(Row({"a1": 1.0}, upper=-1.0), Row({"a1": 1.0, "a2": 0.0}, lower=1.0))
    g = np.vstack([rows.weights[0], -rows.weights[1]])
    answer = qpsolvers.solve_problem(
        qpsolvers.Problem(np.eye(4), np.zeros(4), g, np.array([-1.0, -1.0])), solver="proxqp"
    )
    assert not answer.found
    assert answer.x is not None
    with pytest.raises(Infeasible):
        solve_program(problem(0), rows)
    with pytest.raises(Infeasible):
        solve_program(problem(0), rows_of(Row({"a1": 1.0}, 1.0, 1.0), Row({"a1": 2.0}, upper=1.0)))


def test_a_failing_solver_is_not_believed(monkeypatch):
    """Whatever the solver proposes, the optimality conditions decide."""
    cost, rows = problem(3), rows_of(*random_rows(4, 4))
    wanted = solve_program(cost, rows).theta

    def silly(problem, **options):
        return qpsolvers.Solution(problem, found=True, x=np.ones(4), z=np.ones(len(problem.h)))

    monkeypatch.setattr(qp.qpsolvers, "solve_problem", silly)
    np.testing.assert_allclose(solve_program(cost, rows).theta, wanted, atol=1e-10)


def test_a_solver_that_gives_up_is_replaced(monkeypatch):
    problems = [(problem(seed), rows_of(*random_rows(seed + 1, 5))) for seed in range(30, 45)]
    wanted = []
    for cost, rows in problems:
        try:
            wanted.append(solve_program(cost, rows).theta)
        except Infeasible:
            wanted.append(None)
    assert sum(w is not None for w in wanted) > 8

    def give_up(problem, **options):
        return qpsolvers.Solution(problem, found=False, x=np.zeros(4))

    monkeypatch.setattr(qp.qpsolvers, "solve_problem", give_up)
    for (cost, rows), theta in zip(problems, wanted, strict=True):
        if theta is None:
            with pytest.raises(Infeasible):
                solve_program(cost, rows)
        else:
            np.testing.assert_allclose(solve_program(cost, rows).theta, theta, atol=1e-10)


def test_a_problem_nobody_solves_is_an_error_with_its_rows(monkeypatch):
    monkeypatch.setattr(qp, "_ROUNDS", 0)
    rows = rows_of(Row({"a1": 1.0}, upper=-5.0))
    with pytest.raises(CtrlidError, match=r"could not be solved .* its rows are a1 <= -5"):
        solve_program(problem(3), rows)


def test_what_cannot_come_below_is_not_sought():
    cost = problem(1)
    best = solve_program(cost, rows_of())
    with pytest.raises(Infeasible):
        solve_program(cost, rows_of(), below=best.cost * 0.99)


def test_a_free_direction_is_reported():
    cost = problem(1)
    r = cost.R.copy()
    r[:, 3] = 2 * r[:, 2]
    flat = Cost(r, cost.d, cost.basis, cost.origin)
    with pytest.raises(NotExcited) as trouble:
        solve_program(flat, rows_of())
    direction = trouble.value.direction
    np.testing.assert_allclose(direction / direction[2], [0, 0, 1, -0.5], atol=1e-10)
    # An equality that settles it is enough.
    theta = solve_program(flat, rows_of(Row({"b1": 1.0, "b2": -1.0}, 0.0, 0.0))).theta
    assert theta[2] == theta[3]


def test_spread_in_the_free_directions():
    cost = problem(5)
    everything, condition = compute_covariance(cost, np.zeros((0, 4)))
    np.testing.assert_allclose(everything, np.linalg.inv(cost.R.T @ cost.R), rtol=1e-9)
    assert condition == pytest.approx(np.linalg.cond(cost.R / np.linalg.norm(cost.R, axis=0)))
    fixed, _ = compute_covariance(cost, np.array([[0, 1.0, 0, 0]]))
    keep = [0, 2, 3]
    r = cost.R[:, keep]
    np.testing.assert_allclose(fixed[np.ix_(keep, keep)], np.linalg.inv(r.T @ r), rtol=1e-9)
    assert not fixed[1].any()
    nothing, condition = compute_covariance(cost, np.eye(4))
    assert not nothing.any()
    assert condition == 1.0


# -- cases, families and functions on a bare cost (no data, no sampling) --------------------------


def test_symmetric_poles_in_continuous_time():
    structure = Structure(2, 1, domain="s")
    target = np.array([0.3, -400.0, 5.0])
    cost = Cost(np.diag([1.0, 0.01, 2.0]), np.array([0.3, -4.0, 10.0]), np.eye(3), np.zeros(3))
    np.testing.assert_allclose(solve_program(cost, Rows.build(structure, [])).theta, target)
    found = minimize(cost, [cid.SymmetricPoles()], structure)
    np.testing.assert_array_equal(found.theta, [0.0, -400.0, 5.0])
    assert found.free == 2


@pytest.mark.parametrize("p", [0.02, 7.0, 3000.0])
def test_symmetric_pair_among_three_continuous_poles(p):
    structure = Structure(3, 1, domain="s")
    theta = np.r_[np.poly([p, -p, -2.0 * p])[1:], 4.0]
    scale = np.diag(1 / np.abs(theta))
    cost = Cost(scale, scale @ theta, np.eye(4), np.zeros(4))
    found = minimize(cost, [cid.SymmetricPoles()], structure)
    np.testing.assert_allclose(found.theta, theta, rtol=1e-12)
    assert found.branch == f"symmetric pair at s = ±p, p = {p:.7g}"
    assert found.free == 3


def test_a_family_at_its_end_sits_on_a_bound():
    """The data want a complex pair; the nearest real reciprocal pair merges at z = 1."""
    structure = Structure(3, 1)
    theta = np.r_[np.poly([np.exp(0.3j), np.exp(-0.3j), 0.5]).real[1:], 1.0]
    cost = Cost(np.eye(4), theta, np.eye(4), np.zeros(4))
    found = minimize(cost, [cid.ReciprocalPoles()], structure)
    assert found.active_bounds[0].bound == 1.0
    assert found.active_bounds[0].quantity == "reciprocal pair at z"
    np.testing.assert_allclose(np.polyval(np.r_[1, found.theta[:3]], 1.0), 0.0, atol=1e-12)
    # No pair of any other size is cheaper.
    branch = cid.ReciprocalPoles().branches(structure)[0]
    for z in (1.01, 1.1, 2.0):
        rows = Rows.build(structure, [("", row) for row in branch.family(z)])
        assert solve_program(cost, rows).cost > found.cost


def test_a_family_finds_the_best_of_a_dense_scan():
    structure = Structure(3, 1)
    rng = np.random.default_rng(8)
    r = rng.standard_normal((20, 4))
    theta = np.r_[np.poly([1.4, 0.65, 0.3])[1:], 1.0]
    d = r @ theta + 0.05 * rng.standard_normal(20)
    cost = Cost(r, d, np.eye(4), np.zeros(4))
    found = minimize(cost, [cid.ReciprocalPoles(), cid.Bounds("b1", upper=0.99)], structure)
    (case, _) = list_cases([cid.ReciprocalPoles(), cid.Bounds("b1", upper=0.99)], structure)
    scan = [solve_program(cost, case.at(z)).cost for z in np.linspace(1.2, 1.7, 2001)]
    assert found.cost <= min(scan)
    assert found.cost == pytest.approx(min(scan), rel=1e-6)
    assert found.theta[3] <= 0.99
    # The errors leave the pair free to slide: one direction more than with a known pair.
    assert found.free == 4 - 2 + 1 - len(found.active_bounds)


def test_a_family_with_no_member_in_the_bounds_is_refused_by_name():
    structure = Structure(3, 1)
    constraints = [cid.ReciprocalPoles(), cid.Bounds("a1", 0, 0.1), cid.Fixed("a3", 50.0)]
    with pytest.raises(CtrlidError, match="contradict each other"):
        minimize(problem(2), [*constraints, cid.Fixed("a2", 0.0)], structure)


def test_a_family_and_functions_do_not_mix():
    constraints = [cid.ReciprocalPoles(), cid.Nonlinear(equality=np.sum)]
    with pytest.raises(CtrlidError, match="write both as functions of one Nonlinear"):
        minimize(problem(2), constraints, Structure(3, 1))


def test_functions_nobody_can_meet_are_refused_by_name():
    impossible = cid.Nonlinear(equality=lambda t: t[0] ** 2 + 1)
    with pytest.raises(CtrlidError, match=r"Nonlinear\(.*\) and Fixed\(\"a2\", 1.0\) were found"):
        minimize(problem(2), [impossible, cid.Fixed("a2", 1.0)], Z2)


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda t: np.nan, "gave nan at theta"),
        (lambda t: t[9], "failed at theta.*index 9 is out of bounds"),
        (lambda t: "x", "failed at theta"),
    ],
)
def test_functions_that_do_not_work_are_refused(function, words):
    with pytest.raises(CtrlidError, match=words):
        minimize(problem(2), [cid.Nonlinear(inequality=function)], Z2)


def test_several_starts_find_the_better_valley():
    """Two arcs of a hyperbola: the nearer one to the start is not the cheaper one."""
    cost = Cost(np.diag([1.0, 3.0, 1, 1]), np.array([0.2, -1.5, 0, 0]), np.eye(4), np.zeros(4))
    known = cid.Nonlinear(equality=lambda t: t[0] * t[1] - 0.5)
    found = minimize(cost, [known], Z2)
    a1 = np.r_[np.linspace(-9, -0.01, 200_001), np.linspace(0.01, 9, 200_001)]
    costs = (a1 - 0.2) ** 2 + (1.5 / a1 + 1.5) ** 2
    assert found.cost == pytest.approx(costs.min(), rel=1e-7)
    assert found.theta[0] * found.theta[1] == pytest.approx(0.5, abs=1e-10)


def test_functions_of_many_values_with_linear_rows():
    cost = problem(6)
    ring = cid.Nonlinear(
        equality=lambda t: np.array([t[0] ** 2 + t[1] ** 2 - 1, t[2] - t[0] * t[1]]),
        inequality=lambda t: [t[3] - 0.4, 5 - t[3]],
    )
    found = minimize(cost, [ring, cid.Bounds("a1", upper=0.6)], Z2)
    a1, a2, b1, b2 = found.theta
    assert a1**2 + a2**2 == pytest.approx(1.0, abs=1e-9)
    assert b1 == pytest.approx(a1 * a2, abs=1e-9)
    assert b2 >= 0.4 - 1e-9
    angle = np.linspace(0, 2 * np.pi, 4001)
    best = np.inf
    for x, y in zip(np.cos(angle), np.sin(angle), strict=True):
        if x <= 0.6:
            rest = cost.d - cost.R[:, :3] @ [x, y, x * y]
            column = cost.R[:, 3]
            b = min(max(column @ rest / (column @ column), 0.4), 5.0)
            best = min(best, float(np.sum((rest - column * b) ** 2)))
    assert found.cost == pytest.approx(best, rel=1e-5)
    assert found.cost <= best * (1 + 1e-9)
