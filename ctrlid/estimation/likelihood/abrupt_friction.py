"""Dry friction of a fitted model, as abrupt as its records have it."""

import contextlib
import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from ..._base.errors import ModelCannotRun
from .likelihood import Fit, evaluate_likelihood, relinearize_fit
from .maximization import (
    maximize,
    maximize_under_quiet_force,
    quieten_force,
    replace_sharpness,
)
from .noise.coordinates import compute_noise_criterion

# Friction becomes at most so many times as abrupt as in the first filter, since each doubling
# doubles the steps of the integration.
SHARPEST = 16.0
# More abrupt friction has to gain so much log-likelihood: very strong evidence (Kass and Raftery).
GAIN = 5.0

Climb = Callable[[Fit], Fit]


def sharpen_friction(
    fit: Fit, climb: Climb = maximize, free_noise: Callable[[Fit], Iterable[Fit]] | None = None
) -> Fit:
    """Return a fit whose friction stops a mass as fast as makes its records more probable.

    A filter begins with friction that takes a quarter of a sampling period, with which it finds
    the parameters from afar. It then loses much of a record in which a mass sticks to a random
    force. From there the friction becomes twice as abrupt again and again, and each fit begins
    where the one before it ended, so that the maximum moves little at a time: first with hardly any
    random force, then with all noise free.

    Parameters
    ----------
    fit : Fit
        A maximum of the likelihood.
    climb : callable, optional
        What climbs to a maximum with the noise free.
    free_noise : callable, optional
        What makes fits with their noise free of one with hardly any force; by default `climb` does.

    Returns
    -------
    Fit
        A sharper one if that is more probable and leaves less to random forces; else the fit as it
        is.
    """
    if not fit.plant.e.kinked or fit.known is not None or not math.isfinite(fit.value):
        return fit
    quiet = maximize_under_quiet_force(fit)
    held = _double_while_likelier(quiet, lambda start: maximize(start, exact=False))
    freed = replace(held, problem=replace(held.problem, known=None))
    begun = [fit, *([climb(freed)] if free_noise is None else free_noise(freed))]
    best = _double_while_likelier(max(begun, key=compute_noise_criterion), climb)
    # What friction mends was left to a random force. One that grows mends something else, and is
    # not needed here.
    quiet = replace(best, noise=quieten_force(best.noise))
    best = best if _measure_force(best) < _measure_force(fit) else relinearize_fit(quiet)
    return best if compute_noise_criterion(best) > compute_noise_criterion(fit) + GAIN else fit


def _measure_force(fit: Fit) -> float:
    """Return the variance of all random forces, white and coloured [input of the force^2]."""
    return float(np.mean(fit.sensor)) * (sum(fit.noise.force) + fit.noise.coloured)


def _double_while_likelier(fit: Fit, climb: Climb) -> Fit:
    """Return a fit with friction twice as abrupt as often as that may yet gain enough.

    As often as it gains so much that all doublings would gain enough if each gained the same.
    """
    least = GAIN / math.log2(SHARPEST)
    while 2 * fit.plant.loop.sharpness <= SHARPEST:
        with contextlib.suppress(ModelCannotRun):
            there = replace_sharpness(fit.problem, 2 * fit.plant.loop.sharpness)
            sharper = climb(evaluate_likelihood(there, fit.theta, fit.noise, fit.trajectories))
            if compute_noise_criterion(sharper) > compute_noise_criterion(fit) + least:
                fit = sharper
                continue
        break
    return fit
