"""Step 7: what a round would rather have chosen, now that more is found."""

import math
from collections.abc import Sequence
from dataclasses import replace

from ..effects import AbstractEffect
from ..effects.base import name_at_place
from ..estimation.likelihood.maximization import maximize
from .candidates import Trial, Work, list_missing_candidates
from .fitted_model import Model, compute_criterion, with_linearization
from .noise_choice import measure_colour_gain
from .noise_tests import run_noise_tests
from .quiet_refitting import refit_quietly
from .refitting import refit_candidate
from .scans import scan_candidate
from .selection import Round
from .thresholds import THRESHOLD


def find_better_choice(
    last: Round, step: Round, catalogue: Sequence[type[AbstractEffect]], work: Work
) -> Trial | None:
    """Return what would have been the better choice of the last round, now that more is found.

    Where two effects hide together, the one that alone gains most may be a mixture of both. So what
    could have been taken in its place is asked what could follow on it; the best pair wins. Where
    what follows on the best leaves noise alone, only its look-alikes are asked that. All others are
    asked for a colour of the sensor's noise, which stays hidden beside a wrong effect: one effect
    and a colour may explain as much as two.
    """
    if step.best is None and run_noise_tests(step.base.fit).passed:
        return None
    best = last.best
    assert best is not None
    near = last.others
    complete = step.best is not None and run_noise_tests(step.best.model.fit).passed
    own = best.net_gain + (step.best.net_gain if step.best is not None else THRESHOLD.gate)
    if not _has_same_sensor_noise(best.model, step.base):
        own += max(0.0, compute_criterion(step.base) - compute_criterion(best.model))
    # Effects with a small score beside the best are not scanned again, since scans take longest.
    ranked = sorted(step.trials, key=lambda t: -t.score)
    likely = {t.key for t in (ranked if step.best is None else ranked[: THRESHOLD.looked_at])}
    pairs: list[tuple[float, int]] = []
    for k, trial in enumerate(near):
        model, earned = _adopt_noise(trial.model, best.model, step.base)
        if complete:
            least = own + THRESHOLD.gate - trial.net_gain - earned
            pairs.append((trial.net_gain + earned + measure_colour_gain(model, least), k))
            if not (trial.resembles(best) or best.resembles(trial)):
                continue
        pool = [c for c in list_missing_candidates(model, catalogue)
                if not c.is_scanned() or name_at_place(c) in likely]  # fmt: skip
        tried: list[Trial] = work(lambda effect, model=model: scan_candidate(model, effect), pool)
        tried = sorted(tried, key=lambda t: t.full_penalty - t.score)[: THRESHOLD.released]
        done = work(lambda t, model=model: refit_candidate(model, t), tried)
        done += refit_quietly(model, pool, work)
        follows = max((t.net_gain for t in done), default=-math.inf)
        pairs.append((trial.net_gain + earned + follows, k))
    total, k = max(pairs, default=(-math.inf, 0))
    return near[k] if total > own + THRESHOLD.gate else None


def _adopt_noise(model: Model, before: Model, since: Model) -> tuple[Model, float]:
    """Return a model with the sensor noise that was chosen since beside another, and what it gains.

    Beside other noise of the sensor what follows has less to gain, so that two choices are
    compared beside the same. Where it gains nothing, or none was chosen since, the model stays.
    """
    model = with_linearization(model)
    if _has_same_sensor_noise(before, since):
        return model, 0.0
    fit = maximize(replace(model.fit, noise=since.fit.noise), exact=False)
    other = Model(model.loop, fit)
    earned = compute_criterion(other) - compute_criterion(model)
    return (with_linearization(other), earned) if earned > 0 else (model, 0.0)


def _has_same_sensor_noise(one: Model, other: Model) -> bool:
    """Whether the sensor noise of two models is of one kind."""
    a, b = one.fit.noise, other.fit.noise
    same_tails = (a.tails is None) == (b.tails is None)
    return a.sensor_is_white == b.sensor_is_white and same_tails
