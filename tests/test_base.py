"""What every room uses: the inverse of an information matrix, and what parameters cost."""

import math

import numpy as np
import pytest

from ctrlid._base.criterion import bayesian_penalty
from ctrlid._base.statistics import pseudo_inverse


def test_the_inverse_does_not_depend_on_units():
    rng = np.random.default_rng(1)
    x = rng.standard_normal((50, 4))
    matrix, size = x.T @ x, np.array([1e-8, 1.0, 1e6, 3.0])
    scaled = matrix * np.outer(size, size)
    np.testing.assert_allclose(pseudo_inverse(matrix), np.linalg.inv(matrix), rtol=1e-9)
    expected = np.linalg.inv(matrix) / np.outer(size, size)
    np.testing.assert_allclose(pseudo_inverse(scaled), expected, rtol=1e-9)


def test_a_direction_that_is_not_in_the_data_is_left_out():
    x = np.random.default_rng(2).standard_normal((50, 2))
    twice = np.column_stack([x, x[:, 0]])
    matrix = twice.T @ twice
    inverse = pseudo_inverse(matrix)
    np.testing.assert_allclose(matrix @ inverse @ matrix, matrix, rtol=1e-9)
    assert np.max(np.abs(inverse)) < 1.0


@pytest.mark.parametrize(("n", "samples"), [(1, 100), (2, 45_000), (7, 3.5)])
def test_the_penalty_is_half_that_of_the_criterion(n, samples):
    assert 2 * bayesian_penalty(n, samples) == pytest.approx(n * math.log(samples), rel=1e-15)
    assert bayesian_penalty(n + 1, samples) > bayesian_penalty(n, samples)
