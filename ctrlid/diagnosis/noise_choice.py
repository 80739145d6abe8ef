"""Step 7: whether other noise of the sensor explains a record better than the best effect does."""

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from .._base.criterion import bayesian_penalty
from .._base.errors import ModelCannotRun
from .._base.statistics import rounding_variance
from ..data.converter_grid import find_grid_step
from ..effects import AbstractEffect
from ..estimation.likelihood.likelihood import Fit
from ..estimation.likelihood.maximization import choose_sensor_noise, choose_tails, maximize
from ..estimation.likelihood.noise.coordinates import (
    compute_noise_criterion,
    count_noise_parameters,
)
from ..estimation.likelihood.noise.orders import measure_walk_gain
from ..estimation.likelihood.tails import JointTails
from .candidates import Trial
from .fitted_model import Model, with_linearization
from .noise_tests import measure_colour_promise, run_noise_tests
from .thresholds import THRESHOLD


def prefer_sensor_noise(
    model: Model, best: Trial | None, is_false: Callable[..., bool],
    is_stand_in: Callable[[Trial, Model], bool],
) -> Model | None:  # fmt: skip
    """Return the model with other sensor noise if that gains about as much as the best effect.

    Coloured, or with heavy tails. An effect has to gain more than the noise by as much as it has to
    gain beside none: a slow wander of the sensor looks like a drift. Not where fresh data falsify
    the noise, because it is larger than the error that it explains, or because that grows with it.
    """
    fit = model.fit
    if not _is_open_to_other_noise(fit):
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
    tried = _try_colour(fit, more)
    if fit.noise.tails is None and tests.has_heavy_tails:
        heavy = choose_tails(fit)
        if not _errs_less_than_rounding(heavy):
            tried.append(heavy)
    other = max(tried, key=compute_noise_criterion, default=fit)
    gain = compute_noise_criterion(other) - compute_noise_criterion(fit)
    if not gain > more:
        return None
    newly_coloured = fit.noise.sensor_is_white and not other.noise.sensor_is_white
    recoloured = with_linearization(Model(model.loop, other))
    if newly_coloured and is_false(recoloured, model):
        return None
    if newly_coloured and best is not None:
        # The line or the effect is taken first, and the colour is chosen anew beside it. What can
        # only stand in for what is missing has no such turn.
        if _takes_line(other, best, model):
            return None
        if _gains_beside_colour(other, best) and not is_stand_in(best, model):
            return None
    return recoloured


def colour_beside_force(model: Model, is_false: Callable[..., bool]) -> Model | None:
    """Return a model with coloured sensor noise beside its coloured force, if the BIC wants it.

    Two colours at once explain nearly everything, a missing effect as well, so that this is for a
    model to which no effect was found.
    """
    model = with_linearization(model)
    fit = model.fit
    if not (fit.noise.drift and fit.noise.sensor_is_white and _is_open_to_other_noise(fit)):
        return None
    if not measure_colour_promise(fit) > bayesian_penalty(1, fit.size):
        return None
    with contextlib.suppress(ModelCannotRun):
        both = with_linearization(Model(model.loop, choose_sensor_noise(fit, beside=True)))
        if not both.fit.noise.sensor_is_white and not is_false(both, model):
            return both
    return None


def measure_colour_gain(model: Model, more: float) -> float:
    """Return what coloured sensor noise gains beside a model, less its penalty.

    Zero where it gains nothing, and where it cannot gain `more`.
    """
    fit = model.fit
    if not _is_open_to_other_noise(fit):
        return 0.0
    before = compute_noise_criterion(fit)
    return max((compute_noise_criterion(f) - before for f in _try_colour(fit, more)), default=0.0)


def _try_colour(fit: Fit, more: float) -> list[Fit]:
    """Return the fit with coloured sensor noise, if that may gain so much."""
    # Of several outputs no colour is fitted.
    if fit.plant.e.siso and fit.noise.sensor_is_white and _may_be_coloured(fit, more):
        with contextlib.suppress(ModelCannotRun):
            return [choose_sensor_noise(fit)]
    return []


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
        steps = [find_grid_step(np.atleast_2d(r.y)[k][r.valid_outputs[k]]) for r in records]
        if law is not None and usual[k] < rounding_variance(max(steps)):
            return True
    return False


def _gains_beside_colour(other: Fit, best: Trial) -> bool:
    """Whether the best effect gains at least as much beside coloured noise as it did without.

    Noise that was fitted while the effect was missing leaves it little to gain: the two explain the
    same. Where both together explain as much more, neither stands for the other, and the colour is
    chosen beside the effect.
    """
    if best.net_gain <= THRESHOLD.gate:
        return False
    beside = with_linearization(best.model)
    taken = compute_noise_criterion(other) - compute_noise_criterion(beside.fit)
    return measure_colour_gain(beside, best.gain + taken) > best.gain + taken


def _is_open_to_other_noise(fit: Fit) -> bool:
    """Whether the form of the noise is to be found: nothing tells it, and the fit has a likelihood.

    Of a sensor whose noise is mostly the rounding of its converter the form is known.
    """
    rounds_most = bool(np.any(fit.problem.rounding > 0.5 * fit.sensor_noises))
    return fit.known is None and math.isfinite(fit.value) and not rounds_most


def _takes_line(other: Fit, best: Trial, model: Model) -> bool:
    """Whether sensor noise has a resonance where a line and other noise explain as much, or more.

    A resonance that hardly fades takes a line for itself, and then hides it from every screen. One
    that is left beside a line in the model, as of mains whose frequency wanders, may stay.
    """
    known = [e for e in model.fitted.effects if rings_at_line(other, e)]
    if known or not rings_at_line(other, best.fitted) or best.net_gain <= THRESHOLD.gate:
        return False
    with contextlib.suppress(ModelCannotRun):
        fit = with_linearization(best.model).fit
        beside = max(fit, maximize(replace(fit, noise=other.noise)), key=compute_noise_criterion)
        gain = compute_noise_criterion(beside) - compute_noise_criterion(other)
        return gain - best.penalty > -THRESHOLD.gate
    return False


def rings_at_line(fit: Fit, effect: AbstractEffect) -> bool:
    r"""Whether a resonance of the sensor noise is where the line of an effect is.

    .. math:: |\arg p - \omega T| < \max(-\ln |p|, 2\pi/N)

    for a pole p of the noise and a line at :math:`\omega`, folded: half the width of the resonance,
    or what N samples resolve.
    """
    frequency = effect.values().get("frequency")
    if frequency is None or not effect.values().get("amplitude"):
        return False
    # The angle between samples is from zero to pi, whatever whole turns the line makes.
    dt = fit.plant.loop.dt
    line = abs(math.remainder(2 * math.pi * frequency * dt, 2 * math.pi))
    poles = np.roots([1.0, *(-np.array(fit.noise.ar))])
    poles = poles[poles.imag > 0]
    width = np.maximum(-np.log(np.abs(poles)), 2 * math.pi / fit.size)
    return bool(np.any(np.abs(np.angle(poles) - line) < width))


def _may_be_coloured(fit: Fit, more: float) -> bool:
    """Whether coloured sensor noise can gain more than so much, in place of a coloured force.

    A slow walk of the sensor tells hardly anything from one innovation to the next, the less beside
    a coloured force that follows it.
    """
    least = bayesian_penalty(1 - 2 * bool(fit.noise.drift), fit.size)
    if measure_colour_promise(fit) > more + least:
        return True
    return THRESHOLD.colour_promise * measure_walk_gain(fit) > more
