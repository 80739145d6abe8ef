"""The descent to the most likely noise, on functions whose minimum is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from ctrlid.estimation.likelihood.noise.descent import minimize_by_newton


def make_fit(e):
    """Return what the descent reads of a fit whose innovations of variance one are given."""
    one = SimpleNamespace(innovations=e, variance=np.ones(len(e)))
    return SimpleNamespace(value=-0.5 * float(e @ e), filtered=(one,), sensor=np.ones(1),
                           counts=(np.ones(len(e), bool),))  # fmt: skip


def descend(measure, x, width=0.1):
    n = len(x)
    return minimize_by_newton(measure, np.array(x), np.full(n, -20.0), np.full(n, 20.0), 1e-6,
                              np.full(n, width))  # fmt: skip


@pytest.mark.parametrize("n", [1, 2, 3, 4, 6])
def test_least_squares_are_found_with_mixed_derivatives_of_either_kind(n):
    rng = np.random.default_rng(n)
    a = rng.standard_normal((40, n)) + 2 * rng.standard_normal((40, 1))
    b = rng.standard_normal(40)
    looked = []

    def measure(x):
        looked.append(x)
        return make_fit(a @ x - b)

    found = descend(measure, [0.5] * n)
    assert found == pytest.approx(np.linalg.lstsq(a, b)[0], abs=1e-3)
    # One way around for each step; a search without mixed derivatives would need many.
    assert len(looked) < 8 * (2 * n + n * (n - 1) // 2 + 2)


def test_what_is_lost_is_left_again():
    def measure(x):
        fit = make_fit(np.array([x[0] - 1.0, x[1] + 1.0]))
        return fit if x[0] < 1.5 else SimpleNamespace(value=np.nan)

    assert descend(measure, (-3.0, 2.0)) == pytest.approx([1.0, -1.0], abs=1e-3)
