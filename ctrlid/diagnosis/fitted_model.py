"""A loop fitted to records, and the same fit carried over to another loop."""

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base.arrays import Array
from .._base.criterion import bayesian_penalty
from ..data.record import Record
from ..estimation.likelihood.filter_data import FilterData, prepare_for_loop
from ..estimation.likelihood.kalman_filter import carry_trajectory, guess_trajectory
from ..estimation.likelihood.likelihood import (
    Fit,
    evaluate_likelihood,
    evaluate_linearized,
    list_parameter_bounds,
    list_start_values,
    relinearize_fit,
)
from ..estimation.likelihood.maximization import quieten_force
from ..estimation.likelihood.noise.coordinates import count_noise_parameters
from ..estimation.likelihood.noise.force_size import find_mean_force
from ..estimation.likelihood.sampled_plant import SampledPlant, Trajectory
from ..estimation.likelihood.tails import choose_law
from ..loop.loop import Loop
from ..loop.period_map import comes_to_rest
from ..loop.wiring import knows_references
from .thresholds import THRESHOLD


@dataclass(frozen=True, eq=False)
class Model:
    """A loop fitted to the records, the base that candidates are added to.

    One that was fitted by another criterion, and without the data that it is compared on, has
    standard `errors` of its own.
    """

    loop: Loop
    fit: Fit
    errors: Mapping[str, float] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters that were fitted."""
        return self.plant.names

    @property
    def plant(self) -> SampledPlant:
        """The plant that was fitted, made ready to be filtered."""
        return self.fit.plant

    @property
    def data(self) -> tuple[FilterData, ...]:
        """The records that it was fitted to, made ready for the filter."""
        return self.fit.data

    @property
    def records(self) -> tuple[Record, ...]:
        """The records that it was fitted to."""
        return tuple(one.record for one in self.data)

    @functools.cached_property
    def fitted(self) -> Loop:
        """The loop with the fitted values."""
        values = dict(zip(self.names, self.fit.theta.tolist(), strict=True))
        return self.loop.with_parameters(values)


def can_simulate(model: Model) -> bool:
    """Whether the records can be simulated with this model."""
    loop = model.loop
    if loop.controller is None:
        return comes_to_rest(loop)
    return all(knows_references(loop.wiring, record) for record in model.records)


def without_random_force(model: Model) -> Model:
    """Return a model with hardly any random force, to begin a fit with; known noise is kept."""
    noise = model.fit.noise
    if model.fit.known is not None:
        return model
    quiet = replace(quieten_force(noise), memory=0.0, drift=0.0)
    return replace(model, fit=replace(model.fit, noise=quiet))


def compute_penalized_likelihood(fit: Fit) -> float:
    """Return the log-likelihood less half the penalty of the Bayesian information criterion."""
    return fit.value - bayesian_penalty(len(fit.theta), fit.size)


def compute_criterion(model: Model) -> float:
    """Return the log-likelihood less the penalty for all that was fitted, the noise included."""
    fit = model.fit
    value = fit.value - bayesian_penalty(len(fit.theta) + count_noise_parameters(fit), fit.size)
    return value if math.isfinite(value) else -math.inf


def compute_null_likelihood(fit: Fit) -> float:
    """Return the penalized likelihood of outputs that scatter about means, whatever moves them."""
    value = 0.0
    for data, keep in zip(fit.data, fit.counts, strict=True):
        rows = zip(np.reshape(data.y, (len(data.y), -1)).T,
                   np.reshape(keep, (len(keep), -1)).T, strict=True)  # fmt: skip
        for y in (row[use] for row, use in rows):
            value -= 0.5 * len(y) * (math.log(2 * math.pi * float(np.var(y)) + THRESHOLD.tiny) + 1)
            value -= bayesian_penalty(1, fit.size)
    return value


def drop_arrays(fit: Fit) -> Fit:
    """Return a fit without its arrays: many candidates on a long record must fit into memory."""
    return keep_information(fit, replace(fit, linearized=(), filtered=()))


def drop_linearization(fit: Fit) -> Fit:
    """Return a fit without the plant along its trajectory, four fifths of its memory.

    A fit that continues from it linearizes again.
    """
    return keep_information(fit, replace(fit, linearized=()))


def has_trajectories(fit: Fit) -> bool:
    """Whether a fit still has the states along its records, from which others are carried on."""
    return bool(fit.filtered) and all(at.filtered.size for at in fit.trajectories)


def keep_information(fit: Fit, bare: Fit) -> Fit:
    """Return a fit that lost its arrays with what had been computed from them."""
    bare.__dict__["normal"] = fit.normal
    return bare


def with_linearization(model: Model) -> Model:
    """Return a model whose fit has the plant along its trajectory."""
    return model if model.fit.linearized else replace(model, fit=relinearize_fit(model.fit))


def with_mean_force(model: Model) -> Model:
    """Return a model beside the mean of the random forces that its record allows."""
    model = with_linearization(model)
    fit, noise = model.fit, find_mean_force(model.fit)
    if noise == fit.noise or not math.isfinite(fit.value):
        return model
    return replace(model, fit=evaluate_linearized(fit.problem, fit.theta, noise, fit.linearized))


def compute_log_terms(fit: Fit) -> Array:
    """Return each sample's share of the log-likelihood, records one after the other."""
    parts: list[Any] = []
    for out, keep, r in zip(fit.filtered, fit.counts, fit.sensor, strict=True):
        tails = choose_law(fit.noise.tails, keep)
        s = out.variance[keep] * r
        if tails is not None:
            density = tails.compute_log_density(out.innovations[keep] / np.sqrt(s))
            parts.append(density - 0.5 * np.log(s))
            continue
        parts.append(-0.5 * (np.log(2 * np.pi * s) + out.innovations[keep] ** 2 / s))
    return np.concatenate(parts)


def takes_readings_as_exact(fit: Fit) -> bool:
    """Whether the one-step errors of the filter are hardly noise of the sensor."""
    errors = np.concatenate([np.ravel(out.variance) for out in fit.filtered])
    errors = errors[np.isfinite(errors)]
    return len(errors) > 0 and float(np.median(errors)) > THRESHOLD.exact_readings


def carry_over_fit(base: Model, loop: Loop, names: Sequence[str]) -> Fit:
    """Return the likelihood of a larger or smaller model, along the trajectory of the base."""
    old = base.fit.problem
    plant = old.plant.of_loop(loop, names)
    data = tuple(prepare_for_loop(one, loop) for one in old.data)
    at = [
        carry_trajectory(old.plant, plant, out.trajectory, guess_trajectory(plant, one))
        for out, one in zip(base.fit.filtered, data, strict=True)
    ]
    lower, upper = list_parameter_bounds(loop, names)
    for k, name in enumerate(names):
        if name in base.names:
            i = base.names.index(name)
            lower[k], upper[k] = old.lower[i], old.upper[i]
    # Stretches of a long record are parts of one experiment, whose time goes on in them.
    seen = RecordRange(plant, max(float(one.t[-1]) for one in data) + loop.dt, tuple(at))
    for label, effect in loop.labelled.items():
        for key, (low, high) in effect.limits(seen).items():
            if f"{label}.{key}" in names:
                k = list(names).index(f"{label}.{key}")
                lower[k] = max(lower[k], low)
                upper[k] = max(min(upper[k], high), lower[k])
    problem = replace(old, plant=plant, data=data, lower=lower, upper=upper)
    theta = np.clip(list_start_values(loop, names), lower, upper)
    fit = evaluate_likelihood(problem, theta, base.fit.noise, at)
    if math.isfinite(fit.value) and plant.n > old.plant.n:
        fit = evaluate_likelihood(problem, theta, base.fit.noise, fit.trajectories)
    return fit


@dataclass(frozen=True, eq=False)
class RecordRange:
    """What records cover along the trajectories of a plant; see `ctrlid.effects.scanning.Range`."""

    plant: SampledPlant
    duration: float
    at: tuple[Trajectory, ...]

    @property
    def dt(self) -> float:
        """Sampling period [s]."""
        return self.plant.loop.dt

    @property
    def travel(self) -> float:
        """How far the position moves [output unit]; infinite where no state is one."""
        if not self.plant.e.position_rates:
            return math.inf
        return max(float(np.ptp(a.filtered[:, self.plant.position])) for a in self.at)

    @property
    def fastest(self) -> float:
        """The largest usual speed [output unit/s]; 1 where nothing moves."""
        return max(self._find_usual_speed(a) for a in self.at)

    def _find_usual_speed(self, at: Trajectory) -> float:
        speeds = [np.abs(at.filtered[:, j]) for j in self.plant.e.velocities]
        usual = (float(np.quantile(v, THRESHOLD.usual_speed)) for v in speeds)
        return max(usual, default=1.0) or 1.0
