"""Steps 5 and 7: candidates refitted under hardly any random force, for what hides together."""

import math
from collections.abc import Sequence
from dataclasses import replace

from .._base.errors import EffectDoesNotApply, ModelCannotRun
from ..effects import AbstractEffect
from ..estimation.likelihood.likelihood import Fit, rank_by_likelihood
from ..estimation.likelihood.maximization import maximize, maximize_under_quiet_force
from ..estimation.likelihood.noise.fit import fit_noise
from .candidates import NUMERICAL_FAILURES, Trial, Work, attempt_trial
from .fitted_model import Model, carry_over_fit, with_linearization
from .refitting import climb, weigh_refit
from .scans import scan_candidate
from .thresholds import THRESHOLD


def refit_quietly(base: Model, effects: Sequence[AbstractEffect], work: Work) -> list[Trial]:
    """Refit effects under hardly any random force, and the likeliest of them with it again.

    A random force stands for whatever a model lacks. Of two effects that hide together the first
    leaves a large one, beside which the second gains little at first, and its score says nothing.
    Under hardly any force the second completes the model, and gains more than any other.

    Parameters
    ----------
    base : Model
        The model with what was found before.
    effects : sequence of effects
        The candidates.
    work : callable
        ``work(function, items)``, a map that may run in parallel.

    Returns
    -------
    list of Trial
        The likeliest under hardly any force, refitted with the force free; none where the noise is
        known beforehand, or the model does with hardly any force: there every score is as good.
    """
    if base.fit.known is not None or not math.isfinite(base.fit.value):
        return []
    fit = with_linearization(base).fit
    if fit.noise.drift:
        # A coloured force leaves a white one of any size, which says nothing of how large one was.
        white = replace(fit.noise, memory=0.0, drift=0.0)
        fit = fit_noise(fit.problem, fit.theta, fit.linearized, white, wide=True)
    held = maximize_under_quiet_force(fit)
    if not math.isfinite(held.value):
        return []
    quiet = with_linearization(Model(base.loop, held))
    if quiet.fit.value > base.fit.value - THRESHOLD.gate:
        return []
    tried: list[Trial] = work(lambda effect: scan_candidate(quiet, effect), effects)
    tried = sorted(tried, key=lambda t: -t.score)[: THRESHOLD.tried_quietly]
    fits = work(lambda t: _climb_quietly(quiet, t), tried)
    pairs = [(t, f) for t, f in zip(tried, fits, strict=True) if f is not None]
    pairs.sort(key=lambda pair: -rank_by_likelihood(pair[1]))
    return work(lambda pair: _release(base, *pair), pairs[: THRESHOLD.released])


def _climb_quietly(quiet: Model, trial: Trial) -> Fit | None:
    """Return a candidate fitted with the noise held; None if it cannot run."""
    if trial.out is not None:
        return None
    try:
        start = carry_over_fit(quiet, trial.model.loop, trial.model.names)
        if not math.isfinite(start.value):
            return None
        return maximize(start, rounds=THRESHOLD.refit_rounds, exact=False)
    except (ModelCannotRun, EffectDoesNotApply, *NUMERICAL_FAILURES):
        return None


def _release(base: Model, trial: Trial, fit: Fit) -> Trial:
    """Return a trial on top of the base, climbed on with its noise free."""

    def climb_on() -> Trial:
        free = replace(fit, problem=replace(fit.problem, known=base.fit.known))
        return weigh_refit(base, trial, climb(free))

    return attempt_trial(climb_on, trial)
