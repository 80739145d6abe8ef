"""Trying an effect: what it promises, and what it gives when everything is refitted."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .._base.errors import CtrlidError
from ..effects import AbstractEffect
from ..estimation.likelihood.kalman_filter import Noise
from ..estimation.likelihood.likelihood import Fit, evaluate
from ..estimation.likelihood.maximization import climb, promised
from .carrying import carried_over
from .fitted import Model, light, simulable, spared
from .instants import timed
from .trial import Trial
from .weighing import doubled_by, objection, own_parameters

SCREEN_ROUNDS = 14  # of a refit: a candidate that needs more is not the missing effect
FAINTER = 3  # times that an effect which promises nothing is tried at a tenth of its size


def attempt(base: Model, effect: AbstractEffect, scan: float = 0.0) -> Trial:
    """Add an effect, as it is or nearer to nothing, and ask what a first step would gain.

    An effect that is faint is tried faint: far from there the first step promises nothing. The
    arguments are those of `attempt_at`.
    """
    best = attempt_at(base, effect, scan)
    for _ in range(FAINTER):
        if effect.neutral or best.promise > 0:
            break
        fainter = _fainter(best.effect)
        if fainter is None:
            break
        best = max(best, attempt_at(base, fainter, scan), key=lambda t: t.promise)
    return best


def _fainter(effect: AbstractEffect) -> AbstractEffect | None:
    """Return an effect with a tenth of its size; None where that has no meaning."""
    sizes = {
        p.name: p.neutral + 0.1 * (getattr(effect, p.name) - p.neutral)
        for p in effect.parameters()
        if p.neutral is not None and math.isfinite(p.neutral)
    }
    return replace(effect, **sizes) if sizes else None


def attempt_at(base: Model, effect: AbstractEffect, scan: float = 0.0) -> Trial:
    """Add an effect as it is to a model and ask what the first step would gain.

    Parameters
    ----------
    base : Model
        The fitted model.
    effect : AbstractEffect
        The candidate at its start.
    scan : float, optional
        Logarithm of the number of places at which it was looked for before.

    Returns
    -------
    Trial
        With `promise`; a `remark` if the filter cannot follow the record with it.
    """
    try:
        loop = base.fitted.with_effect(effect)
    except CtrlidError as reason:
        return Trial(effect, "", base, -math.inf, scan, remark=str(reason))
    label = next(k for k in loop.labelled if k not in base.loop.labelled)
    own = [f"{label}.{k}" for k, v in effect.values().items() if math.isfinite(v)]
    names = (*base.names, *own)
    try:
        fit = carried_over(base, loop, names)
    except CtrlidError as reason:
        return Trial(effect, label, base, -math.inf, scan, remark=str(reason))
    doubled = doubled_by(fit, label, effect)
    if doubled:
        loop = loop.with_parameters(doubled)
        names = tuple(n for n in names if n not in doubled)
        fit = carried_over(base, loop, names)
    model = Model(loop, fit)
    if not math.isfinite(fit.value):
        return Trial(effect, label, model, -math.inf, scan, remark="cannot follow the record")
    promise = fit.value - base.fit.value + promised(fit)
    return Trial(effect, label, Model(loop, light(fit)), promise, scan)


def attempt_best(base: Model, effects: Sequence[AbstractEffect], scan: float) -> Trial:
    """Try effects that differ in their values only, and return the one that promises most."""
    best = attempt_at(base, effects[0], scan)
    if best.remark:
        return best
    label, loop, names = best.label, best.model.loop, best.model.names
    start = carried_over(base, loop, names)
    for effect in effects[1:]:
        theta = start.theta.copy()
        for field, value in effect.values().items():
            if f"{label}.{field}" in names:  # and not one that the model's own double
                theta[names.index(f"{label}.{field}")] = value
        fit = start
        for _ in range(2):  # the second time along its own states
            fit = evaluate(start.problem, theta, start.noise, [o.trajectory for o in fit.filtered])
        if not math.isfinite(fit.value):
            continue
        promise = fit.value - base.fit.value + promised(fit)
        if promise > best.promise:
            moved = loop.with_parameters(dict(zip(names, theta.tolist(), strict=True)))
            best = Trial(effect, label, Model(moved, light(fit)), promise, scan)
    return best


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
        fits = [spared(timed(climb(s, rounds=SCREEN_ROUNDS, exact=False))) for s in starts]
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
        fit = spared(climb(moved, rounds=SCREEN_ROUNDS, exact=False))
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
