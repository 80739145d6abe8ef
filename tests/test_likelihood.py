"""Climbing the likelihood: steps, bounds, and giving up."""

from types import SimpleNamespace

import numpy as np
import pytest

from ctrlid.estimation.likelihood import maximization as maximum


@pytest.fixture
def hill(monkeypatch):
    """Make a fit on a hill of any shape: `hill(value)` returns one by its parameters.

    Without `normal`, nobody knows a second step.
    """
    tried = []

    def fit_on(value, theta, lower=-np.inf, upper=np.inf, normal=None):
        def at(theta):
            nothing = np.zeros((len(theta), len(theta))), np.zeros(len(theta))
            return SimpleNamespace(value=value(theta), theta=np.asarray(theta, dtype=float),
                                   noise=None, trajectories=[], problem=problem,
                                   normal=normal(theta) if normal else nothing)  # fmt: skip

        def evaluate(problem, theta, noise, along):
            tried.append(theta)
            return at(theta)

        problem = SimpleNamespace(
            lower=np.full(len(theta), lower), upper=np.full(len(theta), upper),
            plant=SimpleNamespace(
                is_built_for=lambda theta: True, loop=SimpleNamespace(labelled={}),
                names=tuple(f"p{k}" for k in range(len(theta))),
            ),
        )  # fmt: skip
        monkeypatch.setattr(maximum, "evaluate_likelihood", evaluate)
        monkeypatch.setattr(maximum, "relinearize_fit", lambda fit: fit)
        return at(theta)

    fit_on.tried = tried
    return fit_on


def valley(theta):
    """Rosenbrock's, upside down: its top is at (1, 1)."""
    return -1e4 * ((1 - theta[0]) ** 2 + 100 * (theta[1] - theta[0] ** 2) ** 2)


def normal(theta):
    """Return Gauss and Newton's matrix and the slope of the valley."""
    slopes = np.array([[-1.0, 0.0], [-20 * theta[0], 10.0]])
    errors = np.array([1 - theta[0], 10 * (theta[1] - theta[0] ** 2)])
    return 2e4 * slopes.T @ slopes, -2e4 * slopes.T @ errors


def test_a_step_that_is_right_is_taken_whole(hill):
    fit, length = maximum._take_step(
        hill(lambda t: -2 * t[0] ** 2, [3.0]), np.array([[4.0]]), np.array([-12.0])
    )
    assert fit.theta == pytest.approx([0.0])
    assert length == pytest.approx(6.0)  # of standard errors of one half
    assert len(hill.tried) == 1


def test_a_bent_valley_is_followed_to_its_end(hill):
    fit = hill(valley, [-1.2, 1.0])
    heights = [fit.value]
    for _ in range(60):
        fit, length = maximum._take_step(fit, *normal(fit.theta))
        heights.append(fit.value)
        if length < 1e-6:
            break
    assert np.all(np.diff(heights) >= -1e-6)
    assert fit.theta == pytest.approx([1.0, 1.0], abs=1e-3)


def test_along_a_curved_ridge_a_second_step_saves_many_short_ones(hill):
    """Gauss and Newton's second step ends at the top of Rosenbrock's valley, wherever it began."""
    fit = hill(valley, [-1.2, 1.0], normal=normal)
    top, length = maximum._take_step(fit, *normal(fit.theta))
    assert top.theta == pytest.approx([1.0, 1.0], abs=1e-9)
    assert length > 1
    assert len(hill.tried) == 2


def test_a_step_that_is_too_long_is_shortened(hill):
    fit = hill(lambda t: -((t[0] - 1) ** 2), [0.0])
    better, length = maximum._take_step(fit, np.array([[0.02]]), np.array([2.0]))
    assert better.value > fit.value
    assert 0 < length < 100 / np.sqrt(50)
    assert len(hill.tried) > 1


def test_a_wrong_slope_gives_up_where_it_is(hill):
    fit = hill(lambda t: -(t[0] ** 2), [0.0])
    same, length = maximum._take_step(fit, np.array([[2.0]]), np.array([5.0]))
    assert same is fit
    assert length == 0.0
    assert len(hill.tried) == len(maximum.SHARES)  # and no second step, for so little


def test_what_promises_nothing_is_not_tried(hill):
    fit = hill(lambda t: 0.0, [0.0])
    assert maximum._take_step(fit, np.array([[4.0]]), np.array([0.01]))[0] is fit
    assert not hill.tried


def test_bounds_hold(hill):
    fit = hill(lambda t: -((t[0] - 3) ** 2) - (t[1] - 1) ** 2, [0.0, 0.0], upper=2.0)
    top, _ = maximum._take_step(fit, 2 * np.eye(2), np.array([6.0, 2.0]))
    assert top.theta == pytest.approx([2.0, 1.0])
