"""The likelihood of a loop's parameters and noise, from the innovations of its filter."""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..._base.arrays import Array
from ..._base.errors import CtrlidError
from ..._base.statistics import pseudo_inverse, rounding_variance
from ...data.record import Record
from ...loop.controller_sight import find_sight
from ...loop.loop import Loop, find_converter_steps
from .filter_data import FilterData, can_follow_controller, make_filter_data
from .kalman_filter import Filtered, Noise, linearize_inside_domain, run_filter
from .sampled_plant import Linearized, SampledPlant, Trajectory, make_sampled_plant
from .tails import FlatTails, choose_law, compute_information_shares

# The sensor's variance is at least this share of the output's mean square, which keeps the
# likelihood of a noise-free record finite.
LEAST_SENSOR_SHARE = 1e-14
# An optional parameter is not in use at zero; one that is fitted comes no nearer.
LEAST_IN_USE = 1e-12
# The scale of heavy-tailed noise is known when its logarithm changes by less; it is asked so often.
SAME_SCALE, SCALE_PASSES = 0.05, 5


@dataclass(frozen=True, eq=False)
class Known:
    r"""Noise that is known beforehand.

    Ratios, and the variance of each record's sensor noise; None: what the model leaves.

    What repeats of an experiment show of a random force is its share of the output. Where the noise
    comes from them, `slope` is that of the output in the states, :math:`|\partial y / \partial x|`,
    of the model beside which it was found. A sensor of twice the slope sees half the force.
    """

    noise: Noise
    sensor: Array | None = None
    slope: float = 0.0

    def see_through(self, lins: Sequence[Linearized]) -> Noise:
        """Return the noise that makes the same output beside a model of another slope."""
        share = (self.slope / measure_slope(lins)) ** 2
        force = tuple(share * v for v in self.noise.force)
        return replace(self.noise, force=force, drift=share * self.noise.drift)


def measure_slope(lins: Sequence[Linearized]) -> float:
    """Return the RMS slope of the outputs in the states, along trajectories."""
    squares = [np.sum(np.reshape(lin.c, (len(lin.c), -1)) ** 2, axis=1) for lin in lins]
    return math.sqrt(float(np.mean(np.concatenate(squares))))


@dataclass(frozen=True, eq=False)
class Problem:
    """What is fitted to what.

    Parameters
    ----------
    plant : SampledPlant
        The plant, with the free parameters as its names.
    data : tuple of FilterData
        The records.
    lower, upper : ndarray, shape (p,)
        Bounds of the parameters.
    counts : tuple of ndarray of bool
        Samples of each record that enter the likelihood.
    known : Known, optional
        The noise, where it is not estimated.
    periods : tuple of int
        For each record, after how many samples it repeats itself: then only the differences
        between the repeats count, which no wrong model can have made.
    priors : mapping of str to (float, float)
        Mean and standard deviation of what is believed of parameters, by name.
    """

    plant: SampledPlant
    data: tuple[FilterData, ...]
    lower: Array
    upper: Array
    counts: tuple[Any, ...] = ()
    known: Known | None = None
    periods: tuple[int, ...] = ()
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def find_least_sensor(self, record: int, noise: Noise) -> float:
        """Return the least variance of the first output's noise: no reading errs less than rounded.

        Those of further outputs are told relative to it.
        """
        least = float(np.max(self.rounding / noise.ratios))
        return max(self.least_sensors[record], least)

    @functools.cached_property
    def rounding(self) -> Array:
        """The variance that converters of the loop add to the noise of each output."""
        return rounding_variance(find_converter_steps(self.plant.loop))

    @functools.cached_property
    def least_sensors(self) -> list[float]:
        """The least variance of the sensor noise of each record, for the sake of the arithmetic."""
        found = []
        for data, keep in zip(self.data, self.counts, strict=True):
            # Of several outputs the first has this variance, the others have it times a ratio.
            y = data.y[keep] if keep.ndim == 1 else data.y[keep[:, 0], 0]
            found.append(LEAST_SENSOR_SHARE * float(np.var(y) + np.mean(y) ** 2))
        return found

    @functools.cached_property
    def beliefs(self) -> tuple[Array, Array]:
        """Mean and information (inverse variance) of what is believed of each parameter."""
        known = [self.priors.get(name, (0.0, math.inf)) for name in self.plant.names]
        mean, deviation = np.array(known, dtype=float).reshape(-1, 2).T
        return mean, deviation**-2


def make_problem(
    loop: Loop, names: Sequence[str], records: Sequence[Record], start_times: Sequence[float] = ()
) -> Problem:
    """Return the likelihood problem of a loop on records that start at given times [s].

    Raises
    ------
    CtrlidError
        If the records do not fit the loop, or the plant moves too fast for its sampling period.
    """
    bounds = list_parameter_bounds(loop, names)
    start_times = start_times or [0.0] * len(records)
    data = tuple(make_filter_data(loop, r, b) for r, b in zip(records, start_times, strict=True))
    # One record without a reference leaves the input between samples unknown in the filter of all.
    followed = all(can_follow_controller(loop, one) for one in records)
    sees = find_sight(loop, records[0]) if followed else ""
    plant = make_sampled_plant(
        loop, tuple(names), records[0].hold, sees, records[0].hold_r if sees else "zoh"
    )
    if not plant.n:
        raise CtrlidError(
            f"{plant.e.name} has no state, so that there is nothing for a filter to follow. Give "
            "a plant whose output depends on the past of its input"
        )
    return Problem(plant, data, *bounds, priors=find_priors(loop, loop.free))


def find_priors(
    loop: Loop, free: Sequence[str] | Mapping[str, float]
) -> dict[str, tuple[float, float]]:
    """Return mean and standard deviation of what is believed of parameters, by name.

    A parameter that an effect has driven to zero has no share of its value left to say.
    """
    if not isinstance(free, Mapping):
        return {}
    values = loop.equations(keep=True).parameters
    return {
        name: (values[name], abs(values[name]) * share)
        for name, share in free.items()
        if math.isfinite(share) and values[name] != 0
    }


def list_effect_bounds(loop: Loop) -> dict[str, tuple[float, float]]:
    """Return the bounds of the parameters of a loop's effects, by name.

    One that an effect may go without stays in use while it is fitted.
    """
    return {
        f"{label}.{p.name}": (LEAST_IN_USE if p.optional else p.lower, p.upper)
        for label, effect in loop.labelled.items()
        for p in effect.parameters()
        if p.name in effect.values()
    }


def list_parameter_bounds(loop: Loop, names: Sequence[str]) -> tuple[Array, Array]:
    """Return the bounds of parameters: those of effects, and none that changes a sign."""
    known = list_effect_bounds(loop)
    parameters = loop.equations(keep=True).parameters
    lower, upper = [], []
    for name in names:
        if name in known:
            low, high = known[name]
        else:
            # A mass or a gain may be far off, but not of the other sign.
            value = parameters[name]
            low = 1e-3 * value if value > 0 else -math.inf
            high = 1e-3 * value if value < 0 else math.inf
        lower.append(low)
        upper.append(high)
    return np.array(lower), np.array(upper)


def list_start_values(loop: Loop, names: Sequence[str]) -> Array:
    """Return the values of parameters as the loop has them."""
    parameters = loop.equations(keep=True).parameters
    return np.array([parameters[name] for name in names], dtype=float)


@dataclass(frozen=True, eq=False)
class Fit:
    """A point of the likelihood, with all that was computed there.

    `sensor` holds the variance of each record's sensor noise, `linearized` and `filtered` the last
    pass, `normal` the held-gain Fisher information of `theta` and its score. `rounding` is the
    variance that converters in the loop add to the noise of each sensor.
    """

    problem: Problem
    theta: Array
    noise: Noise
    value: float
    sensor: Array
    linearized: tuple[Linearized, ...]
    filtered: tuple[Filtered, ...]
    rounding: tuple[float, ...] = ()

    @property
    def plant(self) -> SampledPlant:
        """The plant, with the free parameters as its names."""
        return self.problem.plant

    @property
    def data(self) -> tuple[FilterData, ...]:
        """The records, made ready for the filter."""
        return self.problem.data

    @property
    def counts(self) -> tuple[Any, ...]:
        """Samples of each record that enter the likelihood."""
        return self.problem.counts

    @property
    def known(self) -> Known | None:
        """The noise, where it is not estimated."""
        return self.problem.known

    @property
    def sensor_noises(self) -> Array:
        """Variance of each output's sensor noise, in the mean of the records."""
        return float(np.mean(self.sensor)) * self.noise.ratios

    @property
    def trajectories(self) -> list[Trajectory]:
        """What a next pass is linearized along, for each record."""
        return [out.trajectory for out in self.filtered]

    @property
    def size(self) -> int:
        """Number of samples that count."""
        return int(sum(np.count_nonzero(c) for c in self.counts))

    @functools.cached_property
    def working(self) -> list[tuple[Array, Array]]:
        """Innovations and variances that, as Gaussian ones, have the score and the information.

        Of heavy-tailed noise a wild innovation counts for less than a usual one.
        """
        tails = self.noise.tails
        pairs = [(out.innovations, out.variance * r)
                 for out, r in zip(self.filtered, self.sensor, strict=True)]  # fmt: skip
        if tails is None:
            return pairs
        share, _ = compute_information_shares(tails)
        # Where rounding leaves no positive variance, a reading that does not count has no weight.
        pairs = [(e, np.where(s > 0, s, np.nan)) for e, s in pairs]
        return [(e * tails.compute_weight(e / np.sqrt(s)) / share, s / share) for e, s in pairs]

    @functools.cached_property
    def normal(self) -> tuple[Array, Array]:
        """The held-gain information matrix and score of the parameters."""
        p = len(self.theta)
        matrix, score = np.zeros((p, p)), np.zeros(p)
        for out, keep, (e, s) in zip(self.filtered, self.counts, self.working, strict=True):
            slopes = out.slopes[keep]
            matrix += (slopes / s[keep, None]).T @ slopes
            score += slopes.T @ (e[keep] / s[keep])
        mean, information = self.problem.beliefs
        return matrix + np.diag(information), score - information * (self.theta - mean)

    @property
    def standard_errors(self) -> Array:
        """Standard errors of the parameters, the noise held."""
        return np.sqrt(np.maximum(np.diag(pseudo_inverse(self.normal[0])), 0.0))

    @property
    def standardized(self) -> list[Array]:
        """The innovations divided by their standard deviations; NaN where they do not count.

        Those of heavy-tailed noise are the standard normal deviates of the same probability.
        """
        z = [
            np.where(keep, out.innovations / np.sqrt(out.variance * r), np.nan)
            for out, keep, r in zip(self.filtered, self.counts, self.sensor, strict=True)
        ]
        tails = self.noise.tails
        return z if tails is None else [tails.normalize(part) for part in z]


def evaluate_likelihood(
    problem: Problem, theta: Array, noise: Noise, at: Sequence[Trajectory]
) -> Fit:
    """Return the likelihood of parameters and noise, linearized along given trajectories."""
    pairs = zip(problem.data, at, strict=True)
    lins = tuple(linearize_inside_domain(problem.plant, one, theta, a)[1] for one, a in pairs)
    return evaluate_linearized(problem, theta, noise, lins)


def rank_by_likelihood(fit: Fit) -> float:
    """Return the log-likelihood to rank a fit by: one that is not finite comes last."""
    return fit.value if math.isfinite(fit.value) else -math.inf


def relinearize_fit(fit: Fit) -> Fit:
    """Return the likelihood of the same values, the plant linearized along its last trajectory."""
    return evaluate_likelihood(fit.problem, fit.theta, fit.noise, fit.trajectories)


def evaluate_linearized(
    problem: Problem, theta: Array, noise: Noise, lins: Sequence[Linearized], sensitive: bool = True
) -> Fit:
    """Return the likelihood of parameters and noise, the plant linearized before.

    The filter weighs wild readings by the scale of the usual ones, which it finds itself.
    """
    if problem.known is not None and problem.known.slope:
        noise = problem.known.see_through(lins)
    fit = _evaluate_at_scale(problem, theta, noise, lins, sensitive)
    for _ in range(SCALE_PASSES):
        tails, scale = fit.noise.tails, float(np.mean(fit.sensor))
        if tails is None or not math.isfinite(fit.value):
            break
        if abs(math.log(scale / tails.scale)) < SAME_SCALE:
            break
        noise = replace(noise, tails=replace(tails, scale=scale))
        fit = _evaluate_at_scale(problem, theta, noise, lins, sensitive)
    return fit


def _evaluate_at_scale(
    problem: Problem, theta: Array, noise: Noise, lins: Sequence[Linearized], sensitive: bool
) -> Fit:
    """Return the likelihood, wild readings weighed by the scale that the noise has."""
    plant = problem.plant
    outs = tuple(
        run_filter(plant, one, lin, noise, sensitive)
        for one, lin in zip(problem.data, lins, strict=True)
    )
    believed, information = problem.beliefs
    value = -0.5 * float(information @ (theta - believed) ** 2)
    sensors = []
    for k, (out, keep) in enumerate(zip(outs, problem.counts, strict=True)):
        e, s = out.innovations[keep], out.variance[keep]
        if problem.periods:
            e, s = _subtract_repeat_mean(out, keep, problem.periods[k])
        tails = choose_law(noise.tails, keep)
        if not (np.isfinite(e).all() and np.isfinite(s).all() and (s > 0).all()):
            value, e, s = -math.inf, np.ones(1), np.ones(1)
            tails = None if isinstance(tails, FlatTails) else tails
        squares = e**2 / s
        mean = float(np.mean(squares))
        if problem.known is not None and problem.known.sensor is not None:
            r = float(problem.known.sensor[k])
        else:
            usual = mean if tails is None else tails.find_scale(squares, tails.scale)
            r = max(usual, problem.find_least_sensor(k, noise), 1e-300)
        if tails is None:
            value -= 0.5 * (len(e) * (math.log(2 * math.pi * r) + mean / r) + np.sum(np.log(s)))
        else:
            value += np.sum(tails.compute_log_density(np.sqrt(squares / r)))
            value -= 0.5 * (len(e) * math.log(r) + np.sum(np.log(s)))
        sensors.append(r)
    return Fit(problem, theta, noise, float(value), np.array(sensors), tuple(lins), outs)


def _subtract_repeat_mean(out: Filtered, keep: Any, period: int) -> tuple[Array, Array]:
    """Return what differs between repeats of the innovations, as large as they are, and variances.

    Counted from the end: whatever dies out at the start does not repeat.
    """
    first = len(keep) % period
    e, use = out.innovations[first:].reshape(-1, period), keep[first:].reshape(-1, period)
    count = use.sum(axis=0)
    mean = np.sum(np.where(use, e, 0.0), axis=0) / np.maximum(count, 1)
    use = use & (count > 1)
    size = np.sqrt(count / np.maximum(count - 1, 1))
    return ((e - mean) * size)[use], out.variance[first:].reshape(-1, period)[use]
