"""Constraints: the rows they give, their words, and contradictions by name."""

from __future__ import annotations

import functools

import control as ct
import numpy as np
import pytest
from scipy.signal import lfilter

import ctrlid as cid
from ctrlid._base.errors import CtrlidError
from ctrlid.estimation.constraints import (
    CONSTRAINTS,
    AbstractConstraint,
    Branch,
    Row,
    check_constraints,
)
from ctrlid.estimation.constraints.branches import (
    Infeasible,
    eliminate_equalities,
    explain_conflict,
    is_possible,
    list_cases,
)
from ctrlid.estimation.identified_model import Structure
from ctrlid.estimation.root_errors import compute_root_errors

Z2, Z3 = Structure(2, 2), Structure(3, 2)
S2, S3 = Structure(2, 1, domain="s"), Structure(3, 1, domain="s")

EXAMPLES = [
    cid.Bounds("b1", lower=-1.0),
    cid.Equal("a1", "b1"),
    cid.Fixed("a2", 1.0),
    cid.Integrator(),
    cid.Linear({"a1": 1.0, "b1": -2.0}, upper=3.0),
    cid.Nonlinear(inequality=np.sum),
    cid.PoleAt(0.5),
    cid.ReciprocalPoles(),
    cid.StaticGain(2.0),
    cid.SymmetricPoles(),
]


def rows(constraint, structure):
    return [str(row) for row in constraint.branches(structure)[0].rows]


# -- the contract, over every member of the family -----------------------------------------------


def test_the_catalogue_is_complete():
    assert {type(c) for c in EXAMPLES} == set(CONSTRAINTS)


@pytest.mark.parametrize("constraint", EXAMPLES, ids=repr)
@pytest.mark.parametrize("structure", [Z2, Z3, S2, S3], ids=str)
def test_every_constraint_gives_rows_or_refuses_in_words(constraint, structure):
    if isinstance(constraint, cid.ReciprocalPoles) and structure.domain == "s":
        with pytest.raises(CtrlidError, match=r"write SymmetricPoles\(\)"):
            constraint.branches(structure)
        return
    for branch in constraint.branches(structure):
        every = [*branch.rows, *(branch.family(branch.grid[1]) if branch.family else [])]
        assert every or branch.equality or branch.inequality
        for row in every:
            assert np.isfinite(structure.vector(row.weights)).all()
            assert row.lower <= row.upper
            assert str(row)


@pytest.mark.parametrize("constraint", EXAMPLES, ids=repr)
def test_printing_gives_back_the_constraint(constraint):
    if not isinstance(constraint, cid.Nonlinear):
        assert eval(repr(constraint), vars(cid)) == constraint


# -- rows ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("constraint", "structure", "expected"),
    [
        (cid.ReciprocalPoles(), Z2, ["a2 = 1", "a1 <= -2"]),
        (cid.SymmetricPoles(), Z2, ["a2 = 1", "a1 <= -2"]),
        (cid.SymmetricPoles(), S2, ["a1 = 0", "a2 <= 0"]),
        (cid.Integrator(), Z2, ["a1 + a2 = -1"]),
        (cid.Integrator(), S2, ["a2 = 0"]),
        (cid.PoleAt(-2.0), Z2, ["-0.5 a1 + 0.25 a2 = -1"]),
        (cid.PoleAt(1j), Z2, ["a2 = 1", "a1 = 0"]),
        (cid.PoleAt(-3.0), S2, ["-0.3333333333 a1 + 0.1111111111 a2 = -1"]),
        (cid.StaticGain(2.0), Z2, ["-2 a1 - 2 a2 + b1 + b2 = 2"]),
        (cid.StaticGain(2.0), S2, ["-2 a2 + b1 = 0"]),
        (cid.Fixed("b2", 0.5), Z2, ["b2 = 0.5"]),
        (cid.Bounds("b2", -1.0, 2.0), Z2, ["-1 <= b2 <= 2"]),
        (cid.Bounds("b2", upper=2.0), Z2, ["b2 <= 2"]),
        (cid.Equal("b1", "b2"), Z2, ["b1 - b2 = 0"]),
        (cid.Linear({"a1": 1, "b2": -0.5}, equals=4), Z2, ["a1 - 0.5 b2 = 4"]),
    ],
    ids=str,
)
def test_rows_in_words(constraint, structure, expected):
    assert rows(constraint, structure) == expected


@pytest.mark.parametrize("pair", [1.0, 1.0001, 1.3, 5.0, -1.0, -1.2])
@pytest.mark.parametrize("rest", [[], [0.4], [0.4, 0.3]])
def test_reciprocal_family_holds_for_polynomials_with_that_pair(pair, rest):
    a = np.poly([pair, 1 / pair, *rest, 0.1])
    structure = Structure(len(a) - 1, 1)
    branch = cid.ReciprocalPoles().branches(structure)[0 if pair > 0 else 1]
    weights = np.array([structure.vector(row.weights) for row in branch.family(pair)])
    values = [row.lower for row in branch.family(pair)]
    np.testing.assert_allclose(weights @ np.r_[a[1:], 7.0], values, atol=1e-13)
    # And they are two independent facts, also where the poles merge.
    assert np.linalg.cond(weights) < 1e3


@pytest.mark.parametrize("p", [0.0, 0.5, 40.0])
def test_symmetric_family_holds_in_continuous_time(p):
    a = np.poly([p, -p, -3.0])
    branch = cid.SymmetricPoles().branches(S3)[0]
    for row in branch.family(p):
        assert S3.vector(row.weights) @ np.r_[a[1:], 1.0] == pytest.approx(row.lower, abs=1e-12)


def test_row_in_words_without_weights():
    assert str(Row({"a1": 0.0}, upper=1.0)) == "0 <= 1"


# -- elimination ---------------------------------------------------------------------------------


def test_elimination_is_exact_in_small_integers():
    e = eliminate_equalities(
        np.array([[0, 1.0, 0, 0], [1, 1, 0, 0], [0, 0, 1, -1]]), np.array([1.0, -1, 0])
    )
    theta = e.snap(np.array([0.1, 0.2, 0.3, 0.7]))
    np.testing.assert_array_equal(theta, [-2.0, 1.0, 0.7, 0.7])


def test_elimination_drops_repetitions_and_finds_contradictions():
    row = np.array([[1.0, 2.0], [2.0, 4.0]])
    assert len(eliminate_equalities(row, np.array([1.0, 2.0])).pivots) == 1
    with pytest.raises(Infeasible):
        eliminate_equalities(row, np.array([1.0, 3.0]))


# -- contradictions ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("constraints", "core"),
    [
        (
            [cid.Bounds("b1", upper=0.0), cid.Fixed("a1", -1.0), cid.Fixed("a1", -2.0)],
            'Fixed("a1", -1.0) and Fixed("a1", -2.0)',
        ),
        (
            [cid.ReciprocalPoles(), cid.Bounds("b1", upper=0.0), cid.Bounds("a1", -1.9, 1.9)],
            'ReciprocalPoles() and Bounds("a1", lower=-1.9, upper=1.9)',
        ),
        (
            [cid.ReciprocalPoles(), cid.PoleAt(0.5 + 0.1j)],
            "ReciprocalPoles() and PoleAt((0.5+0.1j))",
        ),
        ([cid.StaticGain(3.0), cid.Integrator()], "StaticGain(3.0) and Integrator()"),
        (
            [cid.Fixed("a2", 1.0), cid.StaticGain(3.0), cid.Fixed("a1", -2.0)],
            'Fixed("a2", 1.0), StaticGain(3.0) and Fixed("a1", -2.0)',
        ),
        (
            [
                cid.Bounds("b1", lower=1.0),
                cid.Equal("b1", "b2"),
                cid.Bounds("b2", upper=0.5),
                cid.Fixed("a2", 1.0),
            ],
            'Bounds("b1", lower=1.0), Equal("b1", "b2") and Bounds("b2", upper=0.5)',
        ),
        (
            [cid.Linear({"a1": 1, "a2": 1}, lower=-1), cid.Linear({"a1": 2, "a2": 2}, upper=-2.1)],
            "Linear({'a1': 1.0, 'a2': 1.0}, lower=-1.0) and",
        ),
    ],
)
def test_a_smallest_contradicting_set_is_named(constraints, core):
    assert not is_possible(constraints, Z2)
    text = explain_conflict(constraints, Z2)
    assert text.startswith(f"These constraints contradict each other: {core}")
    assert "Drop one of them or loosen it." in text


def test_a_family_without_any_member_is_a_contradiction():
    constraints = [cid.ReciprocalPoles(), cid.PoleAt(0.5), cid.PoleAt(0.6), cid.PoleAt(0.7)]
    assert explain_conflict(constraints, Z3).count("PoleAt") == 2


def test_a_constraint_that_contradicts_itself():
    class Never(AbstractConstraint):
        def __repr__(self):
            return "Never()"

        def branches(self, structure):
            return [Branch([Row({"a1": 1.0}, 1.0, 1.0), Row({"a1": 1.0}, 2.0, 2.0)])]

    words = r"Never() cannot be met by any model with coefficients a1, a2, b1, b2."
    assert explain_conflict([cid.Fixed("a2", 1.0), Never()], Z2).startswith(words)


def test_bounds_that_just_touch_are_possible():
    constraints = [cid.Bounds("a1", upper=-2.0), cid.Linear({"a1": 3.0}, lower=-6.0)]
    assert is_possible(constraints, Z2)
    assert not is_possible([*constraints, cid.Fixed("a1", -2.000001)], Z2)


# -- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: cid.Bounds("b1", 2, 1), "lower bound 2 exceeds the upper bound 1"),
        (lambda: cid.Bounds("b1"), "has no bound: give lower=, upper= or both"),
        (lambda: cid.Bounds("b1", float("nan")), "must be finite; given nan"),
        (lambda: cid.Bounds("b1", float("inf")), "leave no room"),
        (lambda: cid.Bounds("b1", "low"), "must be a real number; given 'low'"),
        (lambda: cid.Fixed("a2", float("nan")), r"Fixed\('a2', ...\) must be finite; given nan"),
        (lambda: cid.Fixed("a2", None), "must be a real number; given None"),
        (lambda: cid.StaticGain(float("inf")), "StaticGain must be finite; given inf"),
        (lambda: cid.PoleAt(float("inf")), "needs a finite pole; given inf"),
        (lambda: cid.PoleAt("one"), "PoleAt needs a number; given 'one'"),
        (lambda: cid.Equal("b1", "b1"), "two different coefficients; given 'b1' twice"),
        (lambda: cid.Linear({}), "needs the weights by coefficient"),
        (lambda: cid.Linear([1, 2]), r"needs the weights by coefficient.*given \[1, 2\]"),
        (lambda: cid.Linear({"a1": 0.0}, upper=1.0), "all weights are zero"),
        (lambda: cid.Linear({"a1": "x"}, upper=1.0), "the weight of a1 must be a real number"),
        (lambda: cid.Linear({"a1": 1.0}), "has no bound"),
        (lambda: cid.Linear({"a1": 1.0}, lower=2, upper=1), "lower bound 2 exceeds"),
        (lambda: cid.Linear({"a1": 1.0}, lower=2, equals=1), "equals= or bounds .* not both"),
        (lambda: cid.Nonlinear(), "needs equality=, inequality= or both"),
        (lambda: cid.Nonlinear(equality=3), "needs functions of the coefficient vector; given 3"),
    ],
)
def test_bad_arguments_are_refused(make, words):
    with pytest.raises(CtrlidError, match=words):
        make()


@pytest.mark.parametrize(
    ("constraint", "structure", "words"),
    [
        (cid.Fixed("a3", 1.0), Z2, r"'a3', but this model has no such.*it has a1, a2, b1, b2"),
        (cid.Equal("b1", "b4"), Z2, r"Equal\(\"b1\", \"b4\"\) uses 'b4'"),
        (cid.ReciprocalPoles(), Structure(1, 1), "needs at least 2 poles, but the model has 1"),
        (cid.SymmetricPoles(), Structure(1, 1), "needs at least 2 poles, but the model has 1"),
        (cid.PoleAt(1j), Structure(1, 1), "needs at least 2 poles, but the model has 1"),
    ],
)
def test_constraints_that_do_not_fit_the_model_are_refused(constraint, structure, words):
    with pytest.raises(CtrlidError, match=words):
        list_cases([constraint], structure)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("ReciprocalPoles", "must be a list of constraint objects.*There are Bounds, Equal, Fixed"),
        ({"a1": 2}, "must be a list of constraint objects"),
        (None, "must be a list of constraint objects; given None"),
        ([3], r"3 is not a constraint. There are Bounds,.*of your own"),
        ([cid.Integrator], r"Integrator is a class: write Integrator\(...\) with parentheses"),
    ],
)
def test_what_is_no_constraint_is_refused_by_listing_what_there_is(given, words):
    with pytest.raises(CtrlidError, match=words):
        check_constraints(given)


def test_a_single_constraint_and_repetitions_are_understood():
    assert check_constraints(cid.Integrator()) == (cid.Integrator(),)
    assert len(check_constraints([cid.Integrator(), cid.Integrator()])) == 1


def test_two_searches_at_a_time_are_refused():
    with pytest.raises(
        CtrlidError, match=r"ReciprocalPoles\(\) and SymmetricPoles\(\) each need a search"
    ):
        list_cases([cid.ReciprocalPoles(), cid.SymmetricPoles()], Z3)
    # With two poles nothing is searched for, and both say the same.
    assert is_possible([cid.ReciprocalPoles(), cid.SymmetricPoles()], Z2)


def test_too_many_branches_are_refused():
    class Either(AbstractConstraint):
        def branches(self, structure):
            return [Branch([Row({"a1": 1.0}, upper=0.0)])] * 20

    with pytest.raises(CtrlidError, match="more than 256 combinations of branches"):
        list_cases([Either(), Either()], Z2)


# --- units


def respond(scale, n=600):
    rng = np.random.default_rng(0)
    u = rng.standard_normal(n)
    y = scale * (lfilter([0, 1, 2.0], [1, -1.5, 0.6], u) + 0.01 * rng.standard_normal(n))
    return cid.Record(u=u, y=y, dt=0.1)


@pytest.mark.parametrize("scale", [1.0, 1e-10, 1e10])
@pytest.mark.parametrize(
    "known",
    [
        lambda s: [cid.Fixed("b1", s), cid.Fixed("b1", 6 * s)],
        lambda s: [cid.Fixed("b1", s), cid.Bounds("b1", lower=6 * s)],
        lambda s: [cid.Fixed("b1", s), cid.Fixed("b2", 2 * s), cid.Equal("b1", "b2")],
        lambda s: [cid.Bounds("b1", lower=6 * s), cid.Bounds("b1", upper=2 * s)],
    ],
    ids=["two values", "value and bound", "equal", "two bounds"],
)
def test_contradictions_do_not_depend_on_units(scale, known):
    """Coefficients around 1e-10, such as metres per volt, made any two facts agree."""
    with pytest.raises(cid.CtrlidError, match="contradict each other"):
        cid.fit_arx(respond(scale), 2, 2, constraints=known(scale))


@pytest.mark.parametrize("scale", [1.0, 1e-10, 1e10])
def test_right_facts_do_not_contradict_each_other_in_any_unit(scale):
    fit = functools.partial(cid.fit_arx, respond(scale), 2, 2)
    known = [cid.StaticGain(30 * scale), cid.Fixed("a2", 0.6), cid.Bounds("a1", upper=-1.5)]
    assert fit(constraints=known).estimate["b1"] == pytest.approx(scale, rel=0.01)
    known = [cid.StaticGain(30 * scale), cid.PoleAt(0.75 + 0.1936j)]
    assert fit(constraints=known).estimate["b1"] == pytest.approx(scale, rel=0.01)


@pytest.mark.parametrize(("dt", "rates"), [(1e-6, (1e6, 2e6, 3e6)), (3600.0, (1e-6, 2e-6, 5e-6))])
def test_known_poles_of_fast_and_slow_plants_are_taken(dt, rates):
    rng = np.random.default_rng(3)
    u = np.repeat(rng.choice([-1.0, 1.0], 160), 5)
    # A chain of lags with a gain of three.
    lags = np.diag([-p for p in rates]) + np.diag(rates[1:], -1)
    plant = ct.ss(lags, [[rates[0]], [0], [0]], [[0, 0, 3]], 0)
    y = ct.forced_response(ct.sample_system(plant, dt), np.arange(800) * dt, u).outputs
    record = cid.Record(u=u, y=y + 1e-3 * rng.standard_normal(800), dt=dt)
    known = [cid.StaticGain(3.0), *(cid.PoleAt(-p) for p in rates)]
    fitted = cid.fit_continuous(record, 3, constraints=known).estimate
    np.testing.assert_allclose(fitted.values[:3], np.poly([-p for p in rates])[1:], rtol=1e-9)


def test_a_static_gain_of_an_input_that_there_is_not_is_refused():
    with pytest.raises(cid.CtrlidError, match="speaks of the input 'nonsense'; the record has u"):
        cid.fit_arx(respond(1.0), 2, 2, constraints=[cid.StaticGain(30.0, input="nonsense")])


# --- poles that coincide


def test_poles_that_a_constraint_merges_have_no_invented_errors():
    """An invented 2.024e-07 +- 4e-09 rad/s was printed for a pair on its bound, and no warning."""
    rng = np.random.default_rng(0)
    u, e = rng.standard_normal(200), rng.standard_normal(200)
    den = np.poly([0.97, 0.95, 0.5])
    y = lfilter([0, 0.1, 0.1], den, u) + lfilter([1], den, 0.01 * e)
    record = cid.Record(u=u, y=y, dt=0.1)
    found = cid.fit_arx(record, 3, 2, constraints=[cid.ReciprocalPoles()]).estimate
    merged = np.abs(found.poles - 1) < 1e-6
    assert merged.sum() == 2
    assert (found.poles_standard_errors[merged] == 0).all()
    assert "NO POLE OUTSIDE THE UNIT CIRCLE" in str(found)


def test_a_double_pole_on_a_bound_has_the_error_of_its_mean():
    """It is at -a1/2, so that its error is half of that of a1."""
    record = respond(1.0, 200)
    real = cid.Nonlinear(inequality=lambda theta: [theta[0] ** 2 / 4 - theta[1]])
    found = cid.fit_arx(record, 2, 2, constraints=[real]).estimate
    assert abs(found.poles[0] - found.poles[1]) < 1e-6
    half = found.standard_errors[0] / 2
    assert found.poles_standard_errors == pytest.approx([half, half], rel=1e-3)


def test_a_double_pole_that_may_part_has_no_error_of_first_order():
    errors = compute_root_errors(np.array([0.7, 0.7, 0.2]), np.diag([1e-4, 1e-4, 1e-4]))
    assert np.isinf(errors[:2]).all()
    assert np.isfinite(errors[2])


def test_the_error_of_a_mean_is_that_of_the_coefficients():
    """Two poles at 0.7 move together, a third one is held: a = -(2 p + 0.2) and so on."""
    slope = np.array([-2.0, 2 * 0.7 + 2 * 0.2, -2 * 0.7 * 0.2])
    errors = compute_root_errors(np.array([0.7, 0.7, 0.2]), 1e-6 * np.outer(slope, slope))
    assert errors == pytest.approx([1e-3, 1e-3, 0.0], abs=1e-9)
