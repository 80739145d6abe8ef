"""The most likely noise of a loop whose parameters are as they are."""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from ..._base.arrays import Array
from ..._base.criterion import bayesian_penalty
from ..._base.errors import ModelCannotRun
from ..._base.jobs import run_side_by_side
from .kalman_filter import Noise
from .likelihood import Fit, Known, Problem, evaluate_linearized
from .sampled_plant import Linearized, SampledPlant

# Logarithm of the least variance of a force, below which it affects only the start of a record.
LEAST = -24.0
# Logarithm of the largest variance of a force, above which the sensor counts as exact.
MOST = 14.0
# A coloured force with a time constant above this share of the record would be an offset.
SLOWEST = 0.05
# Derivatives by the logarithm of a variance are differences over this step.
LOG_STEP = 0.2
# Above this second derivative by a log variance, a parabola tells how far the minimum is.
CONVEX = 0.05


def fit_noise(
    problem: Problem, theta: Array, lins: Sequence[Linearized], noise: Noise, wide: bool = False,
    enough: float = 0.02,
) -> Fit:  # fmt: skip
    """Return the most likely noise for parameters as they are."""
    plant, dt = problem.plant, problem.plant.loop.dt
    if problem.known is not None:
        return evaluate_linearized(problem, theta, problem.known.noise, lins)

    def at(logs: Array) -> Noise:
        return make_noise(logs, plant.channels, dt)

    def cost(logs: Array) -> float:
        value = evaluate_linearized(
            problem, theta, at(np.atleast_1d(logs)), lins, sensitive=False
        ).value
        return -value if np.isfinite(value) else 1e15

    start = compute_noise_logs(noise, dt)
    longest = max(len(data.record) for data in problem.data)
    low, high = _bound_logs(plant, len(start) > plant.channels, longest)
    start = np.clip(start, low, high)
    if wide:
        grid = np.linspace(low[0], high[0], 20)
        best = grid[
            int(np.argmin(_evaluate_costs(cost, [np.full(plant.channels, g) for g in grid])))
        ]
        start[: plant.channels] = best
    return evaluate_linearized(
        problem, theta, at(_minimize_by_newton(cost, start, low, high, enough)), lins
    )


def choose_noise_ratio(plant: SampledPlant) -> float:
    """Return the reference ratio of force noise to sensor noise, by the sampling period."""
    return 1.0 / plant.loop.dt ** (2 if plant.e.velocities else 1)


def compute_noise_logs(noise: Noise, dt: float) -> Array:
    """Return the logarithms that are searched: of variances, and of the coloured force's time."""
    logs = list(np.log(noise.force))
    if noise.drift:
        logs += [math.log(noise.coloured), math.log(-dt / math.log(noise.memory))]
    return np.array(logs)


def make_noise(logs: Array, channels: int, dt: float) -> Noise:
    """Return the noise that has such logarithms."""
    force = tuple(np.exp(np.clip(logs[:channels], -300, 300)).tolist())
    if len(logs) == channels:
        return Noise(force)
    memory = math.exp(-dt / math.exp(min(max(logs[channels + 1], -50), 50)))
    memory = min(max(memory, 1e-6), 1 - 1e-9)
    return Noise(force, memory, math.exp(min(max(logs[channels], -300), 300)) * (1 - memory**2))


def _bound_logs(plant: SampledPlant, coloured: bool, longest: int) -> tuple[Array, Array]:
    """Return bounds of the logarithms of the noise variances.

    A force that hardly changes during a record is an offset, not noise.
    """
    unit, dt = 2 * math.log(choose_noise_ratio(plant)), plant.loop.dt
    low, high = [unit + LEAST] * plant.channels, [unit + MOST] * plant.channels
    if coloured:
        low += [unit + LEAST, math.log(2 * dt)]
        high += [unit + MOST, math.log(max(min(SLOWEST * longest, 2e4), 4.0) * dt)]
    return np.array(low), np.array(high)


def _evaluate_costs(cost: Callable[[Array], float], points: Iterable[Array]) -> Array:
    """Return the cost at each point, computed side by side: the filter leaves Python alone."""
    return np.array(run_side_by_side(cost, points))


def _minimize_by_newton(
    cost: Callable[[Array], float], x: Array, low: Array, high: Array, enough: float
) -> Array:
    """Minimise a smooth function of a few logarithms by damped Newton steps with differences.

    Where a step gained what the parabola g^2/2h foresaw but for e, a function with a third
    derivative has e^2 / (g^2/2h) * 9/4 left to gain: on a line that tells the end. With more
    directions the errors of several may cancel.
    """
    n, h = len(x), LOG_STEP
    pairs = list(itertools.combinations(range(n), 2))
    unit = np.eye(n)
    around = np.vstack([unit, -unit, *(unit[i] + unit[j] for i, j in pairs)])
    here, damping = cost(x), 0.1
    for _ in range(12):
        costs = _evaluate_costs(cost, np.clip(x + h * around, low, high))
        ups, downs, both = np.split(costs, [n, 2 * n])
        slope = (ups - downs) / (2 * h)
        hessian = np.diag((ups + downs - 2 * here) / h**2)
        for (i, j), value in zip(pairs, both, strict=True):
            hessian[i, j] = hessian[j, i] = (value - ups[i] - ups[j] + here) / h**2
        values, vectors = np.linalg.eigh(hessian)
        convex = n == 1 and values[0] > CONVEX
        values, turned = np.maximum(np.abs(values), 1e-3), vectors.T @ slope
        while True:
            step = -vectors @ (turned / (values + damping))
            step *= min(1.0, 2.5 / max(float(np.abs(step).max()), 1e-300))
            trial = np.clip(x + step, low, high)
            taken = vectors.T @ (trial - x)
            foreseen = -float((turned + 0.5 * values * taken) @ taken)
            if convex and foreseen < 0.1 * enough:
                return x
            there = cost(trial)
            if there <= here or damping > 1e6:
                break
            damping = max(10 * damping, 1.0)
        gain = here - there
        if gain <= 0:
            break
        x, here, damping = trial, there, damping / 10
        if gain < enough:
            break
        if convex:
            # This slope of the quadratic model is left after the step.
            slope_left = turned + values * taken
            left = (
                0.5 * float(slope_left @ (slope_left / values))
                + 2.25 * (gain - foreseen) ** 2 / foreseen
            )
            if left < 0.5 * enough:
                break
    return x


def try_coloured_force(fit: Fit) -> Fit:
    """Return the fit with a coloured force added, whether or not the BIC prefers it."""
    plant, dt = fit.plant, fit.plant.loop.dt
    best: Fit | None = None
    sizes = np.array([1e-2, 1.0]) * sum(fit.noise.force)
    for time in (3 * dt, 30 * dt, 300 * dt):
        for size in sizes:
            memory = math.exp(-dt / time)
            force = tuple(0.5 * v for v in fit.noise.force)
            noise = Noise(force, memory, size * (1 - memory**2))
            trial = evaluate_linearized(
                fit.problem, fit.theta, noise, fit.linearized, sensitive=False
            )
            if best is None or trial.value > best.value:
                best = trial
    assert best is not None
    if not np.isfinite(best.value):
        raise ModelCannotRun(f"no coloured force can be fitted to {plant.e.name}")
    return fit_noise(fit.problem, fit.theta, fit.linearized, best.noise)


def estimate_noise_from_repeats(fit: Fit, periods: Sequence[int]) -> Known:
    r"""Return the noise that differs between repeats of the same experiment.

    .. math:: d_k^p = \sqrt{\tfrac{P}{P-1}} \Bigl( e_k^p - \tfrac{1}{P} \sum_q e_k^q \Bigr)

    What a wrong model leaves in the innovations e is the same in each of the P periods; what
    differs is noise. A coloured force takes part if the Bayesian criterion wants it.

    Parameters
    ----------
    fit : Fit
        A fit of any model that follows the records.
    periods : sequence of int
        For each record, after how many samples it repeats itself.

    Returns
    -------
    Known
        The noise.

    References
    ----------
    Pintelon and Schoukens, *System Identification: A Frequency Domain Approach*, section 4.3.
    """
    problem = replace(fit.problem, known=None, periods=tuple(periods))
    plain = fit_noise(problem, fit.theta, fit.linearized, Noise(fit.noise.force), wide=True)
    richer = try_coloured_force(plain)
    best = richer if richer.value > plain.value + bayesian_penalty(2, fit.size) else plain
    return Known(best.noise, best.sensor)
