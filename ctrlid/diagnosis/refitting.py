"""Step 5: a candidate fitted by maximum likelihood, with everything else."""

import contextlib
import math
from dataclasses import replace

import numpy as np

from .._base.criterion import bayesian_penalty
from .._base.errors import EffectDoesNotApply, ModelCannotRun
from ..estimation.likelihood.kalman_filter import Noise
from ..estimation.likelihood.likelihood import Fit, evaluate_likelihood, rank_by_likelihood
from ..estimation.likelihood.maximization import OTHER_NOISE_GAIN, climb_under_quiet_force, maximize
from .candidates import Objection, Trial, attempt_trial
from .fitted_model import (
    Model,
    can_simulate,
    carry_over_fit,
    compute_null_likelihood,
    drop_arrays,
    drop_linearization,
)
from .information import count_own_parameters, find_objection
from .thresholds import THRESHOLD


def refit_candidate(base: Model, trial: Trial, near: Model | None = None) -> Trial:
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
        With gain and penalty, or with what puts it out.
    """
    if trial.out is not None:
        return trial
    return attempt_trial(lambda: _climb_from_starts(base, trial, near), trial)


def _climb_from_starts(base: Model, trial: Trial, near: Model | None) -> Trial:
    """Return the trial of `refit_candidate`, where nothing fails."""
    loop, names = trial.model.loop, trial.model.names
    if near is not None:
        known = dict(zip(near.names, near.fit.theta.tolist(), strict=True))
        loop = loop.with_parameters({n: known[n] for n in names if n in known})
    start = carry_over_fit(near or base, loop, names)
    starts = [start]
    if start.noise.is_coloured and start.problem.known is None and can_simulate(base):
        # Coloured noise that was fitted while the effect was missing may never let it in.
        # (Where no simulation can check it, the likelihood also leads to absurd values.)
        starts.append(replace(start, noise=start.noise.plain))
    fit = max((climb(s) for s in starts), key=lambda f: f.value)
    done = weigh_refit(base, trial, fit)
    sticks = start.plant.e.kinked and not base.fit.plant.e.kinked
    if sticks and start.problem.known is None and done.net_gain > 0:
        # The force of the model without it stands for what sticks.
        quiet = climb(climb_under_quiet_force(start))
        if quiet.value > fit.value:
            done = weigh_refit(base, trial, quiet)
    return done


def climb(start: Fit) -> Fit:
    """Return the likeliest fit of a candidate, without the plant along its trajectory."""
    fit = maximize(start, rounds=THRESHOLD.refit_rounds, exact=False)
    return drop_linearization(place_instants(fit))


def refit_under_noise(base: Model, trial: Trial, noise: Noise) -> Trial:
    """Return a refitted candidate, climbed on from another noise if that leads higher.

    The likelihood of the noise has several maxima: a slow force that stood for what is missing may
    stay beside one candidate and leave the next, which says nothing of the candidates.
    """
    start = replace(trial.model.fit, noise=noise)
    fit = drop_linearization(maximize(start, rounds=THRESHOLD.refit_rounds, exact=False))
    return weigh_refit(base, trial, fit) if fit.value > trial.model.fit.value else trial


def weigh_refit(base: Model, trial: Trial, fit: Fit) -> Trial:
    """Return a trial with what a fit of it gained, its penalty, and what speaks against it."""
    model = Model(trial.model.loop, fit)
    own = count_own_parameters(trial, fit)
    penalty = bayesian_penalty(own, fit.size) + trial.scan_penalty
    before = base.fit.value if math.isfinite(base.fit.value) else compute_null_likelihood(fit)
    done = replace(trial, model=model, gain=fit.value - before, penalty=penalty)
    try:
        done = replace(done, out=find_objection(done))
        if _gained_much(done) and _measure_own_gain(base, done) > THRESHOLD.gate:
            done = replace(done, out=None)
    # Fitted values may exclude each other, as a lower limit above the upper one does.
    except EffectDoesNotApply as reason:
        return replace(trial, out=Objection.of(reason))
    return done if done.net_gain > 0 else replace(done, model=Model(model.loop, drop_arrays(fit)))


def _gained_much(trial: Trial) -> bool:
    """Whether an effect gained much though its size is within a few standard errors of nothing.

    A standard error says how the likelihood bends at the size that was found, and not how it falls
    towards none: a dead zone that swallows all of the input may be any wider, and a narrow backlash
    beside a dead zone may be as narrow again, but not nothing. An effect of several parameters
    gains by another one then: dry friction of any size, of which only the creep is seen, is viscous
    friction. It counts only where nothing tells how large it is.
    """
    insignificant = trial.out is not None and trial.out.ground == "insignificant"
    if not (insignificant and trial.gain - trial.penalty > THRESHOLD.gate):
        return False
    names, information = trial.model.names, trial.model.fit.normal[0]
    deciding = {
        f"{trial.label}.{p.name}" for p in trial.effect.parameters() if p.neutral is not None
    }
    return len(trial.effect.values()) == 1 or any(
        information[k, k] == 0 for k, name in enumerate(names) if name in deciding
    )


def _measure_own_gain(base: Model, trial: Trial) -> float:
    """Return the net gain over the model without the effect that has all else of it."""
    known = dict(zip(trial.model.names, trial.model.fit.theta.tolist(), strict=True))
    loop = base.loop.with_parameters({n: known[n] for n in base.names if n in known})
    without = base.fit.value
    with contextlib.suppress(ModelCannotRun):
        start = carry_over_fit(trial.model, loop, base.names)
        climbed = maximize(start, rounds=THRESHOLD.refit_rounds, exact=False)
        without = max(without, climbed.value)
    return trial.model.fit.value - without - trial.penalty


def place_instants(fit: Fit) -> Fit:
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
    plant = fit.plant
    best = fit
    instants = {
        f"{label}.{p.name}" for label, e in plant.loop.labelled.items()
        for p in e.parameters() if p.instant
    }  # fmt: skip
    for k, name in enumerate(plant.names):
        while name in instants:
            reach = 2.0 ** np.arange(THRESHOLD.instant_doublings)
            there = max(
                (_move_instant(best, k, s * r) for r in reach for s in (-1, 1)),
                key=rank_by_likelihood,
            )
            if not there.value > best.value + OTHER_NOISE_GAIN:
                break
            best = maximize(there, rounds=THRESHOLD.instant_rounds, exact=False)
    return best


def _move_instant(fit: Fit, k: int, samples: float) -> Fit:
    """Return the fit with one parameter, an instant, so many samples later."""
    problem, theta = fit.problem, fit.theta.copy()
    theta[k] = np.clip(theta[k] + samples * problem.plant.loop.dt, problem.lower[k],
                       problem.upper[k])  # fmt: skip
    return evaluate_likelihood(problem, theta, fit.noise, fit.trajectories)
