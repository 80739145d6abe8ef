"""Step 5: a candidate fitted by maximum likelihood, with everything else."""

import math
from dataclasses import replace

import numpy as np

from .._base.errors import CtrlidError
from ..estimation.likelihood.kalman_filter import Noise
from ..estimation.likelihood.likelihood import Fit, evaluate
from ..estimation.likelihood.maximization import ELSEWHERE, climb
from .candidates import Trial
from .fitted_model import Model, carried_over, light, simulable, spared
from .information import objection, own_parameters
from .thresholds import THRESHOLD


def refit(base: Model, trial: Trial, near: Model | None = None) -> Trial:
    """Refit a candidate together with the model and its noise.

    Parameters
    ----------
    base : Model
        The model without it.
    trial : Trial
        The candidate at its start.
    near : Model, optional
        A model from whose values and noise to start in place of those of `base`.

    Returns
    -------
    Trial
        With gain and cost, or with a remark that puts it out.
    """
    if trial.remark:
        return trial
    loop, names = trial.model.loop, trial.model.names
    if near is not None:
        known = dict(zip(near.names, near.fit.theta.tolist(), strict=True))
        loop = loop.with_parameters({n: known[n] for n in names if n in known})
    try:
        start = carried_over(near or base, loop, names)
        starts = [start]
        if start.noise.drift and start.problem.known is None and simulable(base):
            # A random force that was fitted while the effect was missing may never let it in.
            # (Where no simulation can check it, the likelihood also leads to absurd values.)
            starts.append(replace(start, noise=replace(start.noise, memory=0.0, drift=0.0)))
        fits = [spared(timed(climb(s, rounds=THRESHOLD.refit_rounds, exact=False))) for s in starts]
        fit = max(fits, key=lambda f: f.value)
    except CtrlidError as reason:
        return replace(trial, remark=str(reason))
    return outcome(base, trial, fit)


def under(base: Model, trial: Trial, noise: Noise) -> Trial:
    """Return a refitted candidate, climbed on from another noise if that leads higher.

    The likelihood of the noise has several maxima: a slow force that stood for what is missing may
    stay beside one candidate and leave the next, which says nothing of the candidates.
    """
    try:
        moved = replace(trial.model.fit, noise=noise)
        fit = spared(climb(moved, rounds=THRESHOLD.refit_rounds, exact=False))
    except CtrlidError:
        return trial
    return outcome(base, trial, fit) if fit.value > trial.model.fit.value else trial


def outcome(base: Model, trial: Trial, fit: Fit) -> Trial:
    """Return a trial with what a fit of it gained, what that cost, and what speaks against it."""
    model = Model(trial.model.loop, fit)
    own = own_parameters(trial, fit)
    cost = 0.5 * own * math.log(fit.size) + trial.scan
    before = base.fit.value if math.isfinite(base.fit.value) else _of_no_model(fit)
    done = replace(trial, model=model, gain=fit.value - before, cost=cost)
    try:
        done = replace(done, remark=objection(done))
    except CtrlidError as reason:  # values that do not go together, such as crossed limits
        return replace(trial, remark=str(reason))
    return done if done.merit > 0 else replace(done, model=Model(model.loop, light(fit)))


def _of_no_model(fit: Fit) -> float:
    """Return the likelihood of outputs that scatter about their mean, whatever drives them."""
    value = 0.0
    for track, keep in zip(fit.problem.tracks, fit.problem.counts, strict=True):
        y = track.table[3][keep]
        value -= 0.5 * len(y) * (math.log(2 * math.pi * float(np.var(y)) + 1e-300) + 1)
    return value


def timed(fit: Fit) -> Fit:
    """Return the fit with each instant, such as that of a step, where the record has it.

    The likelihood is rugged in an instant: its slope sees one sample. An instant that was found
    while other parameters or effects were not yet right may be some dozens off.

    Parameters
    ----------
    fit : Fit
        A fit with any parameters.

    Returns
    -------
    Fit
        The same, or one that is more likely.
    """
    machine = fit.problem.machine
    best = fit
    for k, name in enumerate(machine.names):
        while name.endswith(".time"):
            reach = 2.0 ** np.arange(THRESHOLD.instant_doublings)
            there = max((_moved(best, k, s * r) for r in reach for s in (-1, 1)), key=_value)
            if not there.value > best.value + ELSEWHERE:
                break
            best = climb(there, rounds=4, exact=False)
    return best


def _moved(fit: Fit, k: int, samples: float) -> Fit:
    """Return the fit with one parameter, an instant, so many samples later."""
    problem, theta = fit.problem, fit.theta.copy()
    theta[k] = np.clip(theta[k] + samples * problem.machine.loop.dt, problem.lower[k],
                       problem.upper[k])  # fmt: skip
    try:
        return evaluate(problem, theta, fit.noise, [o.trajectory for o in fit.filtered])
    except CtrlidError:  # no such instant in this record
        return replace(fit, value=-np.inf)


def _value(fit: Fit) -> float:
    return fit.value if np.isfinite(fit.value) else -np.inf
