"""What is searched for the most likely noise: logarithms and angles, their bounds and price."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...._base.arrays import Array
from ...._base.criterion import bayesian_penalty
from ..kalman_filter import Noise
from ..likelihood import Fit, Problem
from ..sampled_plant import SampledPlant

# Logarithm of the least variance of a force, below which it affects only the start of a record.
LEAST = -24.0
# Logarithm of the largest variance of a force, above which the sensor counts as exact.
MOST = 14.0
# A coloured force with a time constant above this share of the record would be an offset.
SLOWEST = 0.05
# Sensor noise that rings for tau samples leaves N / 2 tau of log-likelihood to a line within it. At
# this share of the record that is 25, where a name costs 17 in 3000 samples; more would be a line.
RINGING = 0.02
# Derivatives by the logarithm of a variance are differences over this step.
LOG_STEP = 0.2
# Derivatives by the angle of a coefficient are differences over this step: the zero of a random
# walk beside white noise is 0.1 to 0.3 away from the circle, beyond which all comes again.
ANGLE_STEP = 0.05
# Partial autocorrelations are read back from coefficients up to this size.
SURE = 1 - 1e-9
# A root this near the limit of what a record tells apart from a random walk lies on it.
ON_THE_LIMIT = 1e-6


def choose_noise_ratio(plant: SampledPlant) -> float:
    """Return the reference ratio of force noise to sensor noise, by the sampling period."""
    return 1.0 / plant.loop.dt ** (2 if plant.e.position_rates else 1)


def choose_force_ratios(problem: Problem) -> Array:
    """Return the reference ratio of each random force to the sensor noise of the first output.

    Of several outputs a force is compared with that on which it shows most: it moves it within a
    period by as much as its own sensor noise.
    """
    plant = problem.plant
    e = plant.e
    if e.siso:
        return np.full(plant.channels, choose_noise_ratio(plant))
    scales = problem.data[0].scales
    a, b, c = plant.linearize_at_rest()
    # The output moves at once, or else after one period more, where a force changes its rate.
    moved = np.abs(c @ b) + np.abs(c @ a @ b)
    shares = moved / (scales / scales[0])[:, None]
    return np.asarray(1.0 / np.maximum(np.max(shares, axis=0), 1e-300))


def compute_noise_logs(noise: Noise, dt: float) -> Array:
    """Return what is searched: logarithms of variances and of the coloured force's time, angles.

    The partial autocorrelations of coloured sensor noise are tanh of the angles of its
    autoregression, which keeps it stationary, and sin of those of its moving average, which
    reaches the zeros on the unit circle that an average over several samples has.
    """
    logs = [*np.log(noise.force), *np.log(noise.sensors)]
    if noise.drift:
        logs += [math.log(noise.coloured), math.log(-dt / math.log(noise.memory))]
    logs += np.arctanh(_compute_reflections(noise.ar)).tolist()
    logs += np.arcsin(_compute_reflections([-v for v in noise.ma])).tolist()
    return np.array(logs)


def list_difference_steps(noise: Noise) -> Array:
    """Return over which steps of the logarithms and angles of a noise differences are taken."""
    angles = len(noise.ar) + len(noise.ma)
    logs = len(noise.force) + len(noise.sensors) + 2 * bool(noise.drift)
    return np.repeat([LOG_STEP, ANGLE_STEP], [logs, angles])


def make_noise(logs: Array, like: Noise, dt: float) -> Noise:
    """Return the noise of the same kind that has such logarithms and angles."""
    channels, p, q = len(like.force), len(like.ar), len(like.ma)
    force = tuple(np.exp(np.clip(logs[:channels], -300, 300)).tolist())
    ar, ma = np.tanh(logs[len(logs) - p - q : len(logs) - q]), np.sin(logs[len(logs) - q :])
    further = channels + len(like.sensors)
    noise = Noise(force, ar=_make_coefficients(ar), ma=tuple(-v for v in _make_coefficients(ma)),
                  sensors=tuple(np.exp(logs[channels:further]).tolist()),
                  tails=like.tails)  # fmt: skip
    if not like.drift:
        return noise
    memory = math.exp(-dt / math.exp(min(max(logs[further + 1], -50), 50)))
    memory = min(max(memory, 1e-6), 1 - 1e-9)
    drift = math.exp(min(max(logs[further], -300), 300)) * (1 - memory**2)
    return replace(noise, memory=memory, drift=drift)


def _make_coefficients(reflections: Iterable[float]) -> tuple[float, ...]:
    """Return the autoregression with given partial autocorrelations, by Levinson's recursion."""
    phi = np.zeros(0)
    for k in reflections:
        phi = np.append(phi - k * phi[::-1], k)
    return tuple(phi.tolist())


def _compute_reflections(coefficients: Sequence[float]) -> Array:
    """Return the partial autocorrelations of an autoregression: Levinson's recursion backwards."""
    phi, found = np.asarray(coefficients, dtype=float), []
    while len(phi):
        k, phi = float(np.clip(phi[-1], -SURE, SURE)), phi[:-1]
        found.append(k)
        phi = (phi + k * phi[::-1]) / (1 - k**2)
    return np.array(found[::-1])


def bound_noise_logs(problem: Problem, noise: Noise) -> tuple[Array, Array]:
    """Return bounds of the logarithms of the noise variances, and of the angles.

    A force that hardly changes during a record is an offset, not noise.
    """
    units, dt = [2 * math.log(v) for v in choose_force_ratios(problem)], problem.plant.loop.dt
    low, high = [unit + LEAST for unit in units], [unit + MOST for unit in units]
    scales = problem.data[0].scales
    usual = [2 * math.log(scale / scales[0]) for scale in scales[1 : 1 + len(noise.sensors)]]
    low, high = [*low, *(v - MOST for v in usual)], [*high, *(v + MOST for v in usual)]
    if noise.drift:
        unit, longest = units[0], _find_longest_record(problem)
        low += [unit + LEAST, math.log(2 * dt)]
        high += [unit + MOST, math.log(max(min(SLOWEST * longest, 2e4), 4.0) * dt)]
    # A random walk stays one, since a root that leaves its limit is a parameter more.
    slowest = math.atanh(find_slowest_root(problem))
    ringing = math.atanh(math.exp(-2 / max(RINGING * _find_longest_record(problem), 2.0)))
    walks = _find_walks(problem, noise)
    least = [-slowest, *[-ringing] * (len(walks) - 1)][: len(walks)]
    low += [*np.where(walks, slowest, least), *[-math.pi] * len(noise.ma)]
    high += [*[slowest] * len(walks), *[math.pi] * len(noise.ma)]
    return np.array(low), np.array(high)


def _find_longest_record(problem: Problem) -> int:
    """Return the number of samples of the longest record."""
    return max(len(data.record) for data in problem.data)


def find_slowest_root(problem: Problem) -> float:
    """Return the slowest root of coloured sensor noise, which is a random walk to a record.

    Sensor noise that is correlated over more than the record would be an offset.
    """
    return 1 - 1 / _find_longest_record(problem)


def count_noise_parameters(fit: Fit) -> int:
    """Return how many parameters of the noise are free.

    A root of the sensor noise at its limit is that of a random walk, and is no free parameter.
    """
    return fit.noise.parameters - int(np.any(_find_walks(fit.problem, fit.noise)))


def _find_walks(problem: Problem, noise: Noise) -> Any:
    """Return which partial autocorrelations of the sensor noise are at the limit: random walks."""
    return _compute_reflections(noise.ar) > find_slowest_root(problem) - ON_THE_LIMIT


def compute_noise_criterion(fit: Fit) -> float:
    """Return the log-likelihood less the penalty for the parameters of the noise."""
    value = fit.value - bayesian_penalty(count_noise_parameters(fit), fit.size)
    return value if np.isfinite(value) else -math.inf
