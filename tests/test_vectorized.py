"""Vectorized: every operation and whole functions against CasADi's own interpreter.

Groups: single operations; registers and constants; shapes and blocks; one after another; refusals.
"""

from types import SimpleNamespace

import casadi
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import CtrlidError
from ctrlid.physics import block_evaluation
from ctrlid.physics.block_evaluation import (
    BINARY,
    BLOCK,
    BLOCKS,
    UNARY,
    BlockEvaluation,
    evaluate_blocks,
)

EVERYWHERE = np.array([-np.inf, -1e200, -3.0, -1.0, -0.5, -0.0, 0.0, 1e-300, 0.5, 1.0, 2.0, 2.5,
                       1e200, np.inf, np.nan])  # fmt: skip

UNARIES = {
    "neg": lambda a: -a, "exp": casadi.exp, "log": casadi.log, "sqrt": casadi.sqrt,
    "square": lambda a: a * a, "twice": lambda a: a + a, "sin": casadi.sin, "cos": casadi.cos,
    "tan": casadi.tan, "asin": casadi.asin, "acos": casadi.acos, "atan": casadi.atan,
    "sinh": casadi.sinh, "cosh": casadi.cosh, "tanh": casadi.tanh, "asinh": casadi.asinh,
    "acosh": casadi.acosh, "atanh": casadi.atanh, "floor": casadi.floor, "ceil": casadi.ceil,
    "abs": casadi.fabs, "sign": casadi.sign, "erf": casadi.erf, "inverse": lambda a: 1 / a,
    "log1p": casadi.log1p, "expm1": casadi.expm1, "not": casadi.logic_not,
    "constpow": lambda a: a**2.7, "copy": lambda a: a,
}  # fmt: skip
BINARIES = {
    "add": lambda a, b: a + b, "sub": lambda a, b: a - b, "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b, "pow": lambda a, b: a**b, "fmin": casadi.fmin,
    "fmax": casadi.fmax, "fmod": casadi.fmod, "atan2": casadi.atan2, "hypot": casadi.hypot,
    "copysign": casadi.copysign, "lt": lambda a, b: a < b, "le": lambda a, b: a <= b,
    "eq": lambda a, b: a == b, "ne": lambda a, b: a != b, "and": casadi.logic_and,
    "or": casadi.logic_or, "if_else_zero": lambda a, b: casadi.if_else(a, b, 0),
}  # fmt: skip


def one_by_one(function, *arguments):
    """What CasADi's interpreter gives, sample by sample; columns of the arguments are samples."""
    n = max(np.shape(a)[-1] for a in arguments)
    results = []
    for k in range(n):
        results.append(function(*(a[..., k] if a.shape[-1] > 1 else a[..., 0] for a in arguments)))
        if function.n_out() == 1:
            results[-1] = (results[-1],)
    return [np.array([np.asarray(casadi.DM(r[j]).full()) for r in results])
            for j in range(function.n_out())]  # fmt: skip


def same(function, *arguments, rtol=2e-14, atol=1e-300):
    found = BlockEvaluation(function)(*arguments)
    expected = one_by_one(function, *(np.asarray(a, dtype=float) for a in arguments))
    for ours, theirs in zip(found, expected, strict=True):
        full = np.broadcast_to(ours, theirs.shape) if len(ours) == 1 else ours
        np.testing.assert_allclose(full, theirs, rtol=rtol, atol=atol)


# --- single operations


@pytest.mark.parametrize("name", list(UNARIES))
def test_one_argument(name):
    a = casadi.SX.sym("a")
    rng = np.random.default_rng(1)
    ordinary = rng.standard_normal(300) * np.exp(rng.uniform(-6, 4, 300))
    values = np.concatenate([EVERYWHERE, np.linspace(-1, 1, 41), ordinary])
    if name in ("sin", "cos", "tan"):  # at 1e200 libraries differ by their reduction
        values = values[np.abs(values) < 1e6]
    same(casadi.Function("f", [a], [UNARIES[name](a)]), values[None, :])


@pytest.mark.parametrize("name", list(BINARIES))
def test_two_arguments(name):
    a, b = casadi.SX.sym("a"), casadi.SX.sym("b")
    rng = np.random.default_rng(2)
    pairs = np.array(np.meshgrid(EVERYWHERE, EVERYWHERE)).reshape(2, -1)
    more = rng.standard_normal((2, 300)) * np.exp(rng.uniform(-4, 3, (2, 300)))
    both = np.hstack([pairs, more, np.round(more)])
    if name in ("fmin", "fmax"):  # of +0 and -0 either may come back
        both = both[:, ~((both == 0).all(axis=0))]
    if name == "fmod":  # far beyond the divisor round-off decides
        both = both[:, ~(np.abs(both[0]) > 1e10 * np.abs(both[1]))]
    same(casadi.Function("f", [a, b], [BINARIES[name](a, b)]), both[:1], both[1:])


def test_every_operation_of_the_tables_is_tried_above():
    a, b = casadi.SX.sym("a"), casadi.SX.sym("b")
    seen = set()
    for results in ([f(a) for f in UNARIES.values()], [f(a, b) for f in BINARIES.values()]):
        for result in results:
            f = casadi.Function("f", [a, b], [result])
            seen |= {f.instruction_id(k) for k in range(f.n_instructions())}
    # CasADi writes a copy as input and output; OP_ASSIGN comes from nowhere else.
    assert (set(UNARY) | set(BINARY)) - seen == {casadi.OP_ASSIGN}


# --- registers and constants


def test_a_branch_that_is_not_taken_may_be_nan():
    x = casadi.SX.sym("x")
    root = casadi.if_else(x > 0, casadi.sqrt(x), -casadi.sqrt(-x))
    nested = casadi.if_else(x > 1, casadi.log(x - 1), casadi.if_else(x < -1, 1 / (x + 1), x / x))
    f = casadi.Function("f", [x], [root, nested])
    values = np.array([[-4.0, -1.0, -0.0, 0.0, 1.0, 9.0, np.nan]])
    same(f, values)
    assert np.isfinite(BlockEvaluation(f)(values)[0][:6]).all()


def test_comparisons_are_numbers():
    """One and zero, with which one may calculate: CasADi's slope of fmin at a tie does."""
    a, b = casadi.SX.sym("a"), casadi.SX.sym("b")
    more, less = a > b, a <= b
    outputs = [more + (b > -1), more - less, -more, casadi.exp(more), casadi.sign(less),
               2 * more, more / 4, more**less, casadi.erf(more), more * more]  # fmt: skip
    rng = np.random.default_rng(9)
    same(casadi.Function("f", [a, b], outputs), *rng.standard_normal((2, 1, 30)))
    slopes = casadi.jacobian(casadi.fmin(a, b) + casadi.fmax(a, 3 * b), casadi.vertcat(a, b))
    same(casadi.Function("f", [a, b], [slopes]), *np.round(rng.standard_normal((2, 1, 30))))


def test_an_unselected_infinity_does_not_leak_through_shared_registers():
    """if_else_zero writes into the register of its own branch, which CasADi may reuse."""
    x, y = casadi.SX.sym("x"), casadi.SX.sym("y")
    branch = casadi.exp(1e3 * y)
    both = [casadi.if_else(x > 0, branch, 2.0), branch + 1, branch * x,
            casadi.if_else(x > 0, x, branch)]  # fmt: skip
    f = casadi.Function("f", [x, y], both)
    rng = np.random.default_rng(3)
    same(f, rng.standard_normal((1, 50)), rng.standard_normal((1, 50)))


def test_constants_and_numbers_in_place_of_arrays():
    x, p = casadi.SX.sym("x", 2), casadi.SX.sym("p")
    f = casadi.Function("f", [x, p], [casadi.vertcat(3.5, x[0] * p, 0, p), casadi.SX(2.0), 0 * p])
    rng = np.random.default_rng(4)
    x_, p_ = rng.standard_normal((2, 7)), rng.standard_normal((1, 7))
    same(f, x_, p_)
    wide, constant, zero = BlockEvaluation(f)(x_, 2.0)
    assert wide.shape == (7, 4, 1)
    np.testing.assert_array_equal(wide[:, 1, 0], 2 * x_[0])
    np.testing.assert_array_equal(constant, np.full((7, 1, 1), 2.0))
    np.testing.assert_array_equal(zero, np.zeros((7, 1, 1)))
    # A single sample given as plain numbers.
    one = BlockEvaluation(f)([1.0, 5.0], 2.0)[0]
    np.testing.assert_array_equal(one[0, :, 0], [3.5, 2.0, 0.0, 2.0])


def test_rows_that_nothing_reads_still_say_how_many_samples_there_are():
    x, p = casadi.SX.sym("x", 3), casadi.SX.sym("p")
    f = BlockEvaluation(casadi.Function("f", [x, p], [2 * p, x[1]]))
    x_ = np.random.default_rng(6).standard_normal((3, 1300))
    double, second = f(x_, 2.0)
    np.testing.assert_array_equal(double, np.full((1300, 1, 1), 4.0))
    np.testing.assert_array_equal(second[:, 0, 0], x_[1])
    g = BlockEvaluation(casadi.Function("g", [x, p], [2 * p]))
    np.testing.assert_array_equal(g(x_, 2.0)[0], double)


def write_controller():
    """A function of states, a matrix and signals, with every kind of instruction."""
    x, s, w = casadi.SX.sym("x", 2), casadi.SX.sym("s", 2, 2), casadi.SX.sym("w", 3)
    after = casadi.vertcat(0.5 * x[0] + w[0] * w[1], casadi.sin(x[0]) - 0.25 * x[1] + w[2])
    wish = casadi.fmin(casadi.fmax(3 * x[1] - w[1], -1), casadi.atan2(w[0], 2))
    outputs = [after, casadi.mtimes(casadi.jacobian(after, x), s), wish, casadi.SX(7.25)]
    return casadi.Function("step", [x, s, w], outputs)


def test_instructions_read_from_the_text_are_those_that_casadi_was_asked_for(monkeypatch):
    function = write_controller()
    asked = block_evaluation._ask_for_instructions(function, range(function.n_instructions()))
    np.testing.assert_array_equal(block_evaluation._decode_instructions(function), asked)
    steps, constants = block_evaluation._list_instructions(function)
    # Where CasADi writes another text, it is asked, and nothing else changes.
    other = SimpleNamespace(serialize=lambda: "abcdefgh" * 99)
    for name in ("n_instructions", "instruction_id", "instruction_input", "instruction_output",
                 "instruction_constant"):  # fmt: skip
        setattr(other, name, getattr(function, name))
    assert block_evaluation._decode_instructions(other) is None
    monkeypatch.setattr(block_evaluation, "_decode_instructions", lambda function: None)
    again, numbers = block_evaluation._list_instructions(function)
    np.testing.assert_array_equal(steps, again)
    np.testing.assert_array_equal(constants, numbers)


def test_sample_by_sample_it_does_what_casadi_does():
    function, rng = write_controller(), np.random.default_rng(8)
    w, start = rng.standard_normal((3, 200)), np.array([0.3, -0.2])
    found = BlockEvaluation(function).iterate(np.concatenate([start, np.eye(2).ravel()]), w)
    state, slope = start, np.eye(2)
    for k in range(200):
        results = [np.asarray(v) for v in function(state, slope, w[:, k])]
        state, slope = results[0][:, 0], results[1]
        expected = np.concatenate([v.ravel(order="F") for v in results])
        np.testing.assert_allclose(found[k], expected, rtol=1e-12, atol=1e-14)


def test_the_arguments_are_left_alone_and_the_results_are_not_views():
    x = casadi.SX.sym("x", 2)
    f = BlockEvaluation(casadi.Function("f", [x], [x, x + 1, casadi.fabs(x)]))
    values = np.random.default_rng(5).standard_normal((2, 9))
    kept = values.copy()
    first = f(values)
    second = f(2 * values)
    np.testing.assert_array_equal(values, kept)
    first[0][:] = 7.0
    np.testing.assert_array_equal(values, kept)
    np.testing.assert_array_equal(first[1][:, :, 0].T, kept + 1)
    np.testing.assert_array_equal(second[1][:, :, 0].T, 2 * kept + 1)


@pytest.mark.parametrize("seed", range(25))
def test_random_expressions_share_registers_as_casadi_does(seed):
    """Random trees over few variables: most registers are overwritten and read again."""
    rng = np.random.default_rng([6, seed])
    x = casadi.SX.sym("x", 3)
    pool = [x[0], x[1], x[2], casadi.SX(0.7), casadi.SX(-2.0)]
    one = [casadi.sin, casadi.tanh, casadi.fabs, casadi.erf, casadi.floor, casadi.sign,
           lambda a: a * a, lambda a: casadi.sqrt(casadi.fabs(a))]  # fmt: skip
    two = [lambda a, b: a + b, lambda a, b: a - b, lambda a, b: a * b, casadi.fmin, casadi.fmax,
           lambda a, b: casadi.if_else(a > b, a, casadi.log(b)), casadi.atan2,
           lambda a, b: a / (1 + b * b), lambda a, b: 0.5 * (a >= b)]  # fmt: skip
    for _ in range(60):
        recent = pool[-12:]
        if rng.uniform() < 0.4:
            pool.append(one[rng.integers(len(one))](recent[rng.integers(len(recent))]))
        else:
            i, j = rng.integers(len(recent), size=2)
            pool.append(two[rng.integers(len(two))](recent[i], recent[j]))
    outputs = [casadi.vertcat(*pool[-5:]), casadi.jacobian(casadi.vertcat(*pool[-9:]), x)]
    f = casadi.Function("f", [x], outputs, {"cse": bool(seed % 2)})
    same(
        f, rng.standard_normal((3, 40)) * np.exp(rng.uniform(-2, 2, (3, 40))), rtol=1e-9, atol=1e-12
    )


# --- shapes and blocks


@pytest.mark.parametrize("n", [1, 2, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK, 2 * BLOCK + 17,
                               2 * BLOCK * BLOCKS + 3])  # fmt: skip
def test_block_boundaries(n):
    x, p = casadi.SX.sym("x", 2), casadi.SX.sym("p")
    matrix = casadi.vertcat(casadi.horzcat(x[0], 0, p), casadi.horzcat(0, casadi.sin(x[1]), 1))
    f = casadi.Function("f", [x, p], [matrix, x[0] * p])
    rng = np.random.default_rng(7)
    x_, p_ = rng.standard_normal((2, n)), rng.standard_normal(n)
    found, product = BlockEvaluation(f)(x_, p_)
    assert found.shape == (n, 2, 3)
    expected = np.zeros((n, 2, 3))
    expected[:, 0, 0], expected[:, 0, 2] = x_[0], p_
    expected[:, 1, 1], expected[:, 1, 2] = np.sin(x_[1]), 1.0
    np.testing.assert_allclose(found, expected, rtol=1e-15)
    np.testing.assert_array_equal(product[:, 0, 0], x_[0] * p_)


def test_blocks_do_not_remember_each_other():
    x, y = casadi.SX.sym("x"), casadi.SX.sym("y")
    f = BlockEvaluation(casadi.Function("f", [x, y], [casadi.if_else(x > 0, casadi.log(y), 0)]))
    n = 3 * BLOCK
    x_ = np.where(np.arange(n) < BLOCK, 1.0, -1.0)
    y_ = np.where(np.arange(n) < BLOCK, np.nan, -1.0)
    found = f(x_, y_)[0][:, 0, 0]
    assert np.isnan(found[:BLOCK]).all()
    assert (found[BLOCK:] == 0).all()


def test_sparse_inputs_and_empty_outputs():
    a = casadi.SX.sym("a", casadi.Sparsity.triplet(3, 1, [0, 2], [0, 0]))
    f = casadi.Function("f", [a, casadi.SX.sym("b", 0)], [a[0] + 10 * a[2], casadi.SX(2, 0)])
    values = np.arange(12.0).reshape(3, 4)
    found, empty = BlockEvaluation(f)(values, np.zeros(0))
    np.testing.assert_array_equal(found[:, 0, 0], values[0] + 10 * values[2])
    assert empty.shape == (4, 2, 0)


def test_a_plants_map_with_effects_and_derivatives():
    plant = cid.plants.maglev(m=0.02, K=3e-6)
    loop = cid.Loop(plant, None, dt=0.001, at=cid.operating_point(plant, output=0.01))
    for effect in (cid.effects.CoulombFriction(fc=0.1), cid.effects.InputDeadZone(width=0.2)):
        loop = loop.with_effect(effect)
    e = loop.equations()
    rate = casadi.jacobian(e.rhs, casadi.vertcat(e.x, e.u, e.p))
    f = casadi.Function("f", [e.t, e.x, e.u, e.p, e.spread], [e.rhs, rate], {"cse": True})
    rng = np.random.default_rng(8)
    x = np.vstack([rng.uniform(0.005, 0.02, 60), 0.1 * rng.standard_normal(60)])
    spread = np.abs(rng.standard_normal((2, 60))) * 1e-3
    spread[:, ::7] = 0.0
    p = np.tile(e.values[:, None], 60) * rng.uniform(0.8, 1.2, (len(e.values), 60))
    same(f, np.zeros((1, 60)), x, rng.uniform(0, 5, (1, 60)), p, spread, rtol=1e-10)


# --- one after another


def test_stages_feed_each_other_over_several_blocks():
    x, s, a, part = (casadi.SX.sym(k, n) for k, n in (("x", 2), ("s", 2), ("a", 1), ("i", 1)))
    turned = casadi.vertcat(x[1] + part, x[0] * casadi.sin(a))
    along = casadi.mtimes(casadi.jacobian(turned, x), s)
    stages = [casadi.Function("f", [x, s, a, part], outputs)
              for outputs in ([turned, along], [x * x - a, 2 * x * s])]  # fmt: skip
    n = BLOCK + 5
    rng = np.random.default_rng(5)
    first, given = rng.standard_normal((2, n)), rng.standard_normal((1, n))
    values, slopes = evaluate_blocks(
        [BlockEvaluation(f) for f in stages], [first, [1.0, 0.0]], [given], parts=2
    )
    for k in (0, BLOCK - 1, BLOCK, n - 1):
        x_, s_ = first[:, k], [1.0, 0.0]
        for f in stages:
            for i in range(2):
                x_, s_ = f(x_, s_, given[0, k], i)
        np.testing.assert_allclose(values[k], x_, rtol=1e-12)
        np.testing.assert_allclose(slopes[k], s_, rtol=1e-12)


# --- refusals


def test_an_unknown_operation_is_refused():
    a = casadi.SX.sym("a")
    f = casadi.Function("f", [a], [casadi.erfinv(a)])
    with pytest.raises(CtrlidError, match=r"operation \(CasADi's number \d+\) that cannot be"):
        BlockEvaluation(f)


def test_the_number_of_arguments_counts():
    f = BlockEvaluation(casadi.Function("f", [casadi.SX.sym("a"), casadi.SX.sym("b")], [1.0]))
    with pytest.raises(ValueError, match="argument"):
        f(1.0)
