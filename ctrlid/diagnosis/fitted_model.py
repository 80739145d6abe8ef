"""A loop fitted to records, and the same fit carried over to another loop."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base.arrays import Array
from ..data.record import Record
from ..estimation.likelihood.filter_data import prepare_for_loop
from ..estimation.likelihood.kalman_filter import Noise, first_guess
from ..estimation.likelihood.likelihood import Fit, evaluate, linearize_again
from ..estimation.likelihood.physics_fit import parameter_bounds, start_values
from ..estimation.likelihood.sampled_plant import SampledPlant, Trajectory
from ..loop.loop import Loop
from ..loop.period_map import comes_to_rest
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
        return self.fit.problem.plant.names

    @property
    def records(self) -> tuple[Record, ...]:
        """The records that it was fitted to."""
        return tuple(data.record for data in self.fit.problem.prepared)

    @property
    def fitted(self) -> Loop:
        """The loop with the fitted values."""
        values = dict(zip(self.names, self.fit.theta.tolist(), strict=True))
        return self.loop.with_parameters(values)


def can_simulate(model: Model) -> bool:
    """Whether the records can be simulated with this model."""
    loop = model.loop
    if loop.controller is None:
        return comes_to_rest(loop)
    return all(record.r is not None for record in model.records)


def without_random_force(model: Model) -> Model:
    """Return a model with hardly any random force, to begin a fit with; known noise is kept."""
    noise = model.fit.noise
    if model.fit.problem.known is not None:
        return model
    force = tuple(THRESHOLD.quiet_force * v for v in noise.force)
    return replace(model, fit=replace(model.fit, noise=Noise(force)))


def drop_arrays(fit: Fit) -> Fit:
    """Return a fit without its arrays: many candidates on a long record must fit into memory."""
    return keep_information(fit, replace(fit, linearized=(), filtered=()))


def drop_linearization(fit: Fit) -> Fit:
    """Return a fit without the plant along its trajectory, four fifths of its memory.

    Whatever climbs on from it linearizes anew.
    """
    return keep_information(fit, replace(fit, linearized=()))


def keep_information(fit: Fit, bare: Fit) -> Fit:
    """Return a fit that lost its arrays with what had been computed from them."""
    bare.__dict__["normal"] = fit.normal
    return bare


def with_linearization(model: Model) -> Model:
    """Return a model whose fit has the plant along its trajectory."""
    return model if model.fit.linearized else replace(model, fit=linearize_again(model.fit))


def log_terms(fit: Fit) -> Array:
    """Return each sample's share of the log-likelihood, records one after the other."""
    parts: list[Any] = []
    for out, keep, r in zip(fit.filtered, fit.problem.counts, fit.sensor, strict=True):
        s = out.variance[keep] * r
        parts.append(-0.5 * (np.log(2 * np.pi * s) + out.innovations[keep] ** 2 / s))
    return np.concatenate(parts)


def carry_over(base: Model, loop: Loop, names: Sequence[str]) -> Fit:
    """Return the likelihood of a larger or smaller model, along the trajectory of the base."""
    old = base.fit.problem
    m = SampledPlant(loop, names, old.plant.hold, old.plant.law is not None)
    prepared = tuple(prepare_for_loop(track, loop) for track in old.prepared)
    at = [
        _carry_trajectory(old.plant, m, out.trajectory, first_guess(m, track))
        for out, track in zip(base.fit.filtered, prepared, strict=True)
    ]
    lower, upper = parameter_bounds(loop, names)
    for k, name in enumerate(names):
        if name in base.names:
            i = base.names.index(name)
            lower[k], upper[k] = old.lower[i], old.upper[i]
    longest = max(len(t.record) for t in prepared) * loop.dt
    for k, name in enumerate(names):
        if name.endswith(".frequency"):  # what samples show: below Nyquist's, above one period
            lower[k], upper[k] = max(lower[k], 1.0 / longest), min(upper[k], 0.4 / loop.dt)
        if name.endswith(".damping"):
            upper[k] = min(upper[k], 1.0)
        if name.endswith(".period") and m.e.velocities:  # what repeats has to repeat
            way = max(float(np.ptp(a.filtered[:, m.position])) for a in at)
            upper[k] = max(min(upper[k], way), lower[k])
        if name.endswith(".vs"):  # of the speeds that there are
            fastest = max(_largest_speed(m, a) for a in at)
            lower[k], upper[k] = max(lower[k], 1e-3 * fastest), min(upper[k], 3.0 * fastest)
    problem = replace(old, plant=m, prepared=prepared, lower=lower, upper=upper)
    theta = np.clip(start_values(loop, names), lower, upper)
    fit = evaluate(problem, theta, base.fit.noise, at)
    if math.isfinite(fit.value) and m.n > old.plant.n:
        fit = evaluate(problem, theta, base.fit.noise, [o.trajectory for o in fit.filtered])
    return fit


def _largest_speed(m: SampledPlant, at: Trajectory) -> float:
    """Return the largest usual speed along a trajectory."""
    fastest = [float(np.quantile(np.abs(at.filtered[:, j]), 0.99)) for j in m.e.velocities]
    return max(fastest, default=1.0) or 1.0


def _carry_trajectory(
    old: SampledPlant, new: SampledPlant, known: Trajectory, guess: Trajectory
) -> Trajectory:
    """Take states that both have from the old trajectory, and guess the others."""
    mine = list(new.e.states)
    columns = [(mine.index(s), k) for k, s in enumerate(old.e.states) if s in mine]
    if new.size - new.n == old.size - old.n:  # a delay keeps a known circuit from being followed
        columns += [(new.n + k, old.n + k) for k in range(old.size - old.n)]
    result = []
    for start, theirs in ((guess.predicted, known.predicted), (guess.filtered, known.filtered),
                         (guess.spread, known.spread)):  # fmt: skip
        mixed = start.copy()
        for i, k in columns:
            mixed[:, i] = theirs[:, k]
        result.append(mixed)
    return Trajectory(*result)
