"""A loop fitted to the records: the base that candidates are added to."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .._base.errors import CtrlidError
from ..data.record import Record
from ..estimation.likelihood.kalman_filter import Noise
from ..estimation.likelihood.likelihood import Fit, relinearized
from ..estimation.likelihood.maximization import begin, climb, retuned
from ..estimation.likelihood.noise_fit import known_from_repeats
from ..estimation.likelihood.physics_fit import choose_noise, make_problem, start_values
from ..loop.loop import Loop
from ..loop.period_map import comes_to_rest
from ..physics.equations import Array

QUIET = 1e-4  # of the variance of a random force, with which kinks are sharp
AWAY = 0.3  # of a given value: a recalibration beyond is doubted
FAR = 10.0  # times its given value: no recalibration goes further


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
        return self.fit.problem.machine.names

    @property
    def fitted(self) -> Loop:
        """The loop with the fitted values."""
        values = dict(zip(self.names, self.fit.theta.tolist(), strict=True))
        return self.loop.with_parameters(values)


def simulable(model: Model) -> bool:
    """Whether the records can be simulated with this model."""
    loop = model.loop
    if loop.controller is None:
        return comes_to_rest(loop)
    return all(t.record.r is not None for t in model.fit.problem.tracks)


def base_model(
    loop: Loop, records: Sequence[Record], names: Sequence[str], begins: Sequence[float] = ()
) -> Model:
    """Fit the model as it is, with the noise that the data want."""
    problem = make_problem(loop, names, records, begins)
    lower, upper = _near(loop, names, problem.lower, problem.upper)
    problem = replace(problem, lower=lower, upper=upper)
    fit = retuned(climb(begin(problem, start_values(loop, names), None)))
    return Model(loop, choose_noise(fit))


def weighted_by_repeats(base: Model, periods: Sequence[int]) -> Model:
    """Return the model fitted with the noise that differs between repeats.

    A noise that is fitted to what a model leaves takes part of a missing effect for noise.
    """
    problem = replace(base.fit.problem, known=known_from_repeats(base.fit, periods))
    return Model(base.loop, climb(begin(problem, base.fit.theta, None), exact=False))


def anchor(base: Model) -> Model | None:
    """Return the model at its given values if recalibration has led far away from them.

    Where much is missing, the likelihood of the model alone may be largest at absurd values; the
    missing effect shows at the given ones.
    """
    given = start_values(base.loop, base.names)
    size = np.maximum(np.abs(given), 1e-300)
    if not np.any(np.abs(base.fit.theta - given) > AWAY * size):
        return None
    try:
        fit = begin(base.fit.problem, given, None)
    except CtrlidError:
        return None
    return Model(base.loop, fit) if math.isfinite(fit.value) else None


def _near(loop: Loop, names: Sequence[str], lower: Array, upper: Array) -> tuple[Array, Array]:
    """Narrow the bounds of the plant's parameters: a model ten times off is another model."""
    lower, upper = lower.copy(), upper.copy()
    for k, (name, value) in enumerate(zip(names, start_values(loop, names), strict=True)):
        if "." not in name and value:
            ends = sorted((value / FAR, value * FAR))
            lower[k], upper[k] = max(lower[k], ends[0]), min(upper[k], ends[1])
    return lower, upper


def quiet(model: Model) -> Model:
    """Return a model with hardly any random force, to begin a fit with; known noise is kept."""
    noise = model.fit.noise
    if model.fit.problem.known is not None:
        return model
    force = tuple(QUIET * v for v in noise.force)
    return replace(model, fit=replace(model.fit, noise=Noise(force)))


def light(fit: Fit) -> Fit:
    """Return a fit without its arrays: many candidates on a long record must fit into memory."""
    return as_known(fit, replace(fit, linearized=(), filtered=()))


def spared(fit: Fit) -> Fit:
    """Return a fit without the plant along its trajectory, four fifths of its memory.

    Whatever climbs on from it linearizes anew.
    """
    return as_known(fit, replace(fit, linearized=()))


def as_known(fit: Fit, bare: Fit) -> Fit:
    """Return a fit that lost its arrays with what had been computed from them."""
    bare.__dict__["normal"] = fit.normal
    return bare


def whole(model: Model) -> Model:
    """Return a model whose fit has the plant along its trajectory."""
    return model if model.fit.linearized else replace(model, fit=relinearized(model.fit))


def log_terms(fit: Fit) -> Array:
    """Return each sample's share of the log-likelihood, records one after the other."""
    parts: list[Any] = []
    for out, keep, r in zip(fit.filtered, fit.problem.counts, fit.sensor, strict=True):
        s = out.variance[keep] * r
        parts.append(-0.5 * (np.log(2 * np.pi * s) + out.innovations[keep] ** 2 / s))
    return np.concatenate(parts)
