"""Conversions of linear systems: exact where fractions are, the same response everywhere."""

import math
from fractions import Fraction

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid.physics.conversions import (
    sample_held,
    to_polynomials,
    to_state_matrices,
    to_transfer_function,
)


def random_matrices(n, inputs, seed):
    rng = np.random.default_rng(seed)
    return [rng.standard_normal(shape) for shape in ((n, n), (n, inputs), (1, n), (1, inputs))]


@pytest.mark.parametrize(("n", "inputs"), [(0, 1), (1, 1), (2, 2), (5, 1), (9, 3)])
def test_polynomials_have_the_response_of_the_states(n, inputs):
    a, b, c, d = random_matrices(n, inputs, n)
    numerators, den = to_polynomials(a, b, c, d)
    assert len(numerators) == inputs
    assert all(len(num) == len(den) == n + 1 for num in numerators)
    for s in (0.3, 2.0 + 1.0j, -4.0j):
        response = c @ np.linalg.solve(s * np.eye(n) - a, b) + d if n else d
        found = [np.polyval(num, s) / np.polyval(den, s) for num in numerators]
        np.testing.assert_allclose(found, response[0], rtol=1e-11)


def test_polynomials_are_rounded_once():
    a, b, c, d = random_matrices(3, 1, 7)
    (num,), den = to_polynomials(a, b, c, d)
    A = [[Fraction(v) for v in row] for row in a.tolist()]
    minors = [A[i][i] * A[j][j] - A[i][j] * A[j][i] for i in range(3) for j in range(i)]
    assert den[1] == float(-(A[0][0] + A[1][1] + A[2][2]))
    assert den[2] == float(sum(minors))
    assert num[0] == d[0, 0]
    gain = sum((Fraction(x) * Fraction(y) for x, y in zip(c[0], b[:, 0], strict=True)), Fraction(0))
    assert num[1] == float(gain + Fraction(d[0, 0]) * Fraction(-sum(A[i][i] for i in range(3))))


def test_sizes_far_apart_lose_nothing():
    (num,), den = to_polynomials([[0, 1e200], [1e-150, -1e-20]], [[0], [1]], [[1e-30, 0]], [[0]])
    np.testing.assert_allclose(num, [0, 0, 1e170], rtol=1e-15)
    np.testing.assert_allclose(den, [1, 1e-20, -1e50], rtol=1e-15)


@pytest.mark.parametrize("entry", [math.nan, math.inf])
def test_what_is_no_number_gives_none(entry):
    (num, other), den = to_polynomials([[entry]], [[1.0, 2.0]], [[1.0]], [[0.0, 0.0]])
    assert np.isnan([num, other, den]).all()
    with pytest.raises(cid.CtrlidError, match="L has coefficients that are NaN or infinite"):
        cid.loop_margins(ct.ss([[entry]], [[1.0]], [[1.0]], [[0.0]]))


@pytest.mark.parametrize("dt", [0, 0.1])
def test_a_plain_transfer_function_keeps_coefficients_and_period(dt):
    G = ct.tf([2.0, 1.0], [3.0, 4.0, 5.0], dt, name="named", inputs=["v"])
    plain = to_transfer_function(G)
    assert (plain.num[0][0].tolist(), plain.den[0][0].tolist()) == ([2.0, 1.0], [3.0, 4.0, 5.0])
    assert (plain.dt, plain.input_labels) == (dt, ["u[0]"])
    again = to_transfer_function(ct.ss(*to_state_matrices(G), dt))
    np.testing.assert_allclose(again.num[0][0] * 3, plain.num[0][0], rtol=1e-14)
    np.testing.assert_allclose(again.den[0][0] * 3, plain.den[0][0], rtol=1e-14)


def test_each_input_has_states_of_its_own():
    C = ct.tf([[[1.0, 2.0], [3.0]]], [[[1.0, 0.5], [1.0, 2.0, 5.0]]], 0.1)
    a, b, c, d = to_state_matrices(C)
    assert (a.shape, b.shape, c.shape, d.shape) == ((3, 3), (3, 2), (1, 3), (1, 2))
    z = np.exp(0.7j)
    response = c @ np.linalg.solve(z * np.eye(3) - a, b) + d
    np.testing.assert_allclose(response[0], C(z)[0], rtol=1e-13)
    assert len(to_state_matrices(ct.tf([[[0.0], [1.0]]], [[[1.0, 2.0], [1.0]]]))[0]) == 0


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("second", [1e-9, 1.0, 1e9])
def test_a_first_coefficient_of_rounding_lets_nothing_through(unit, second):
    """Neither the unit of a signal nor that of time makes a small coefficient one of rounding."""
    den = np.array([1.0, 2.0, 3.0]) * second ** np.arange(2, -1, -1)
    rounded = ct.tf(unit * np.array([-6e-15 * second**2, second, 2]), den)
    small = ct.tf(unit * np.array([6e-12 * second**2, second, 2]), den)
    assert to_state_matrices(rounded)[3] == 0
    assert to_state_matrices(small)[3][0, 0] == pytest.approx(6e-12 * unit)
    a, b, c, _ = to_state_matrices(rounded)
    assert c @ np.linalg.solve(-a, b) == pytest.approx(unit * 2 / 3)


@pytest.mark.parametrize("dt", [1e-2, 1e-4, 1e-6])
def test_fast_sampling_keeps_the_digits_of_the_numerator(dt):
    """Of ``1/(s^2 - alpha)`` both numerators are ``(cosh(sqrt(alpha) dt) - 1)/alpha``."""
    G = sample_held(ct.tf([1.0], [1.0, 0.0, -1600.0]), dt)
    expected = 2 * math.sinh(20 * dt) ** 2 / 1600
    np.testing.assert_allclose(G.num[0][0], [expected, expected], rtol=1e-11)
    assert G.dt == dt
