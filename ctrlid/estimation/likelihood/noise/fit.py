"""The most likely noise of one kind, for a loop whose parameters are as they are."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...._base.arrays import Array
from ...._base.criterion import bayesian_penalty
from ...._base.jobs import run_side_by_side
from ..kalman_filter import Noise
from ..likelihood import Fit, Problem, evaluate_linearized
from ..sampled_plant import Linearized
from ..tails import JointTails, Tails, fit_tails, list_tails
from .coordinates import (
    bound_noise_logs,
    compute_noise_criterion,
    compute_noise_logs,
    list_difference_steps,
    make_noise,
)
from .descent import find_cost, minimize_by_newton

# A search for the noise ends where so much of log-likelihood is left to gain.
ENOUGH = 0.02


def fit_noise(
    problem: Problem, theta: Array, lins: Sequence[Linearized], noise: Noise, wide: bool = False,
    enough: float = ENOUGH, hold_colour: bool = False,
) -> Fit:  # fmt: skip
    """Return the most likely noise for parameters as they are.

    With `hold_colour` the coefficients of coloured sensor noise stay: each of them is a direction
    more of the search, and they hardly move from one candidate to the next.
    """
    plant, dt = problem.plant, problem.plant.loop.dt
    if problem.known is not None:
        return evaluate_linearized(problem, theta, problem.known.noise, lins)

    held = len(noise.ar) + len(noise.ma) if hold_colour else 0
    start = compute_noise_logs(noise, dt)
    start, colour = np.split(start, [len(start) - held])

    def at(logs: Array) -> Noise:
        return make_noise(np.append(logs, colour), noise, dt)

    def measure(logs: Array) -> Fit:
        return evaluate_linearized(problem, theta, at(logs), lins, sensitive=False)

    def compute_cost(logs: Array) -> float:
        return find_cost(measure(logs))

    low, high = (ends[: len(start)] for ends in bound_noise_logs(problem, noise))
    start = np.clip(start, low, high)
    if wide:
        # Several forces are in the same proportion to what is usual for each.
        apart, rest = low[: plant.channels] - low[0], start[plant.channels :]
        grid = np.linspace(low[0], high[0], 20)
        points = [np.append(np.full(plant.channels, g) + apart, rest) for g in grid]
        start = points[int(np.argmin(run_side_by_side(compute_cost, points)))]
    steps = list_difference_steps(noise)[: len(start)]
    best = at(minimize_by_newton(measure, start, low, high, enough, steps))
    fit = evaluate_linearized(problem, theta, best, lins)
    return fit if noise.tails is None else _refit_tails(fit, hold_colour)


def _refit_tails(fit: Fit, hold_shape: bool) -> Fit:
    """Return the fit with the likeliest tails of its innovations, or as it is where that is less.

    Only the scale moves with `hold_shape`. The filter weighs readings anew, by the new law.
    """
    tails = fit.noise.tails
    assert tails is not None
    if not math.isfinite(fit.value):
        return fit
    noise = replace(fit.noise, tails=replace(tails, scale=float(np.mean(fit.sensor))))
    if not hold_shape and isinstance(tails, JointTails):
        laws = [None if law is None else fit_tails(law, *_list_squares(fit, k))[0]
                for k, law in enumerate(tails.each)]  # fmt: skip
        noise = _give_laws(fit, laws)
    elif not hold_shape:
        assert isinstance(noise.tails, Tails)
        noise = replace(noise, tails=fit_tails(noise.tails, *_list_squares(fit))[0])
    again = evaluate_linearized(fit.problem, fit.theta, noise, fit.linearized)
    return again if again.value > fit.value else fit


def _list_squares(fit: Fit, output: int | None = None) -> tuple[Array, float]:
    """Return squared innovations over their relative variances, and half the sum of their logs."""
    at = slice(None) if output is None else (slice(None), output)
    pairs = [(out.innovations[at][keep[at]] ** 2, out.variance[at][keep[at]])
             for out, keep in zip(fit.filtered, fit.counts, strict=True)]  # fmt: skip
    return (np.concatenate([e / s for e, s in pairs]),
            0.5 * float(sum(np.sum(np.log(s)) for _, s in pairs)))  # fmt: skip


def try_tails(fit: Fit) -> Fit:
    """Return the fit with the heavy tails of the sensor noise that the BIC prefers.

    Student's law and a share of wild readings compete; parameters of the plant stay as they are.
    """
    if not fit.plant.e.siso:
        return _try_joint_tails(fit)
    squares, logs = _list_squares(fit)
    laws = [fit_tails(law, squares, logs) for law in list_tails(squares)]
    tried = []
    for student in (True, False):
        law, _ = max(((t, v) for t, v in laws if bool(t.freedom) == student), key=lambda p: p[1])
        noise = replace(fit.noise, tails=law)
        tried.append(fit_noise(fit.problem, fit.theta, fit.linearized, noise))
    return max(tried, key=compute_noise_criterion)


def _try_joint_tails(fit: Fit) -> Fit:
    """Return the fit with the heavy tails of each output that the BIC prefers, or none.

    A wild reading of one output leads the filter astray, which the others then seem to be: with
    the laws that a first choice gave, each output is asked anew.
    """
    tried = [fit]
    kinds: list[tuple[int, ...]] = []
    while True:
        laws = [_choose_law(tried[-1], k) for k in range(len(fit.plant.e.outputs))]
        kind = tuple(0 if law is None else law.parameters for law in laws)
        if not any(kind) or kind in kinds:
            return max(tried, key=compute_noise_criterion)
        kinds.append(kind)
        noise = _give_laws(tried[-1], laws)
        tried.append(fit_noise(fit.problem, fit.theta, fit.linearized, noise))


def _choose_law(fit: Fit, output: int) -> Tails | None:
    """Return the law of one output's innovations that the BIC prefers; None: a Gaussian one."""
    squares, logs = _list_squares(fit, output)
    size, scale = len(squares), float(np.mean(squares))
    gaussian = -0.5 * size * (math.log(2 * math.pi * scale) + 1) - logs
    each = [fit_tails(law, squares, logs) for law in list_tails(squares)]
    best, value = max(each, key=lambda p: p[1] - bayesian_penalty(p[0].parameters, size))
    better = value - bayesian_penalty(best.parameters, size) > gaussian
    return best if better else None


def _give_laws(fit: Fit, laws: Sequence[Tails | None]) -> Noise:
    """Return the noise with given laws of the outputs, the scale of each told by its own."""
    scales = np.array([np.mean(_list_squares(fit, k)[0]) if law is None else law.scale
                       for k, law in enumerate(laws)])  # fmt: skip
    further = np.array(fit.noise.sensors) * scales[1:] / scales[0]
    return replace(fit.noise, sensors=tuple(further.tolist()),
                   tails=JointTails(tuple(laws), float(scales[0])))  # fmt: skip
