"""Step 7: whether other noise of the sensor explains a record better than the best effect does."""

import contextlib
import math
from collections.abc import Callable

import numpy as np

from .._base.criterion import bayesian_penalty
from .._base.errors import ModelCannotRun
from .._base.statistics import (
    compute_lagged_products,
    compute_predicted_likelihood,
    rounding_variance,
)
from ..data.converter_grid import find_grid_step
from ..estimation.likelihood.kalman_filter import Noise
from ..estimation.likelihood.likelihood import Fit, evaluate_likelihood
from ..estimation.likelihood.maximization import choose_sensor_noise, choose_tails
from ..estimation.likelihood.noise_fit import (
    compute_noise_criterion,
    count_noise_parameters,
    measure_walk_gain,
)
from ..estimation.likelihood.tails import JointTails
from .candidates import Trial
from .fitted_model import Model, with_linearization
from .noise_tests import run_noise_tests
from .thresholds import THRESHOLD


def prefer_sensor_noise(
    model: Model, best: Trial | None, is_false: Callable[..., bool]
) -> Model | None:
    """Return the model with other sensor noise if that gains about as much as the best effect.

    Coloured, or with heavy tails. An effect has to gain more than the noise by as much as it has to
    gain beside none: a slow wander of the sensor looks like a drift. Not where fresh data falsify
    the noise, because it is larger than the error that it explains, or because that grows with it.
    """
    fit = model.fit
    if fit.known is not None or not math.isfinite(fit.value) or _rounds_most(fit):
        return None
    tests = run_noise_tests(fit)
    if tests.passed and not fit.noise.drift and best is None:
        return None
    # Further noise in the fit of the best effect is paid for as well.
    more = 0.0
    if best is not None:
        parameters = count_noise_parameters(best.model.fit) - count_noise_parameters(fit)
        earned = best.net_gain - bayesian_penalty(parameters, fit.size)
        more = max(0.0, earned - THRESHOLD.gate)
    tried = []
    # Of several outputs no colour is fitted.
    if fit.plant.e.siso and fit.noise.sensor_is_white and _may_be_coloured(fit, more):
        with contextlib.suppress(ModelCannotRun):
            tried.append(choose_sensor_noise(fit))
    if fit.noise.tails is None and tests.has_heavy_tails:
        heavy = choose_tails(fit)
        if not _errs_less_than_rounding(heavy):
            tried.append(heavy)
    other = max(tried, key=compute_noise_criterion, default=fit)
    gain = compute_noise_criterion(other) - compute_noise_criterion(fit)
    if not gain > more:
        return None
    newly_coloured = fit.noise.sensor_is_white and not other.noise.sensor_is_white
    if newly_coloured and is_false(Model(model.loop, other), model):
        return None
    if newly_coloured and best is not None and _rings_on(other):
        beside = _colour_beside(best, other)
        if beside is not None and beside.sensor_is_white:
            return None
        if beside is not None:
            other = evaluate_likelihood(fit.problem, fit.theta, beside, fit.trajectories)
    return with_linearization(Model(model.loop, other))


def _errs_less_than_rounding(fit: Fit) -> bool:
    r"""Whether the usual readings of a heavy-tailed sensor err less than its converter rounds.

    Rounding to steps q adds a variance of :math:`q^2/12`. While a plant hardly moves it adds none,
    and what it adds in motion looks like wild readings.
    """
    tails = fit.noise.tails
    if tails is None:
        return False
    laws = tails.each if isinstance(tails, JointTails) else (tails,)
    usual = fit.sensor_noises
    records = [data.record for data in fit.data]
    for k, law in enumerate(laws):
        steps = [find_grid_step(np.atleast_2d(r.y)[k][r.valid_samples]) for r in records]
        if law is not None and usual[k] < rounding_variance(max(steps)):
            return True
    return False


def _rounds_most(fit: Fit) -> bool:
    """Whether most of a sensor's noise is the rounding of its converter, whose form is known."""
    return bool(np.any(fit.problem.rounding > 0.5 * fit.sensor_noises))


def _rings_on(fit: Fit) -> bool:
    r"""Whether a resonance of the sensor noise lasts for a fair part of the record, as a line does.

    A pole p fades to 1/e within :math:`-1/\ln |p|` samples.
    """
    poles = np.roots([1.0, *(-np.array(fit.noise.ar))])
    ringing = np.abs(poles[np.abs(poles.imag) > 0])
    return bool(np.any(ringing > math.exp(-1 / (THRESHOLD.ringing * fit.size))))


def _colour_beside(best: Trial, other: Fit) -> Noise | None:
    """Return the sensor noise beside the best effect where both explain more than noise alone.

    A resonance of the noise may take a line nearly for itself, and then hides it from every screen.
    """
    if best.net_gain <= THRESHOLD.gate:
        return None
    with contextlib.suppress(ModelCannotRun):
        beside = choose_sensor_noise(with_linearization(best.model).fit)
        gain = compute_noise_criterion(beside) - compute_noise_criterion(other)
        return beside.noise if gain - best.penalty > THRESHOLD.gate else None
    return None


def _may_be_coloured(fit: Fit, more: float) -> bool:
    """Whether coloured sensor noise can gain more than so much, in place of a coloured force.

    What past innovations tell of the next one is what a colour of the noise can explain; with
    parameters that move along it may be twice as much. A slow walk of the sensor tells hardly
    anything from one innovation to the next, the less beside a coloured force that follows it.
    """
    told = 0.0
    for z in fit.standardized:
        filled = np.nan_to_num(z)
        products = compute_lagged_products(filled, filled, THRESHOLD.lags)
        told += compute_predicted_likelihood(products, float(np.count_nonzero(np.isfinite(z))))
    least = bayesian_penalty(1 - 2 * bool(fit.noise.drift), fit.size)
    if THRESHOLD.colour_promise * told > more + least:
        return True
    return THRESHOLD.colour_promise * measure_walk_gain(fit) > more
