"""Step 7: the search: add, drop, look back, and again."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .._base.errors import CtrlidError
from ..effects import AbstractEffect
from ..estimation.likelihood.likelihood import Fit
from .candidates import Trial, contains, missing_candidates
from .fitted_model import Model, simulable, spared, whole
from .noise_tests import Omnibus, alarm_level, omnibus
from .recalibration import anchor
from .refitting import refit
from .removal import Found, cut, renoised, reordered, settled, without_superfluous
from .replicas import forgiven, replica
from .rivals import compared
from .scans import SCANS, scanned
from .selection import Step, Work, one_round
from .thresholds import THRESHOLD


@dataclass(frozen=True, eq=False)
class Search:
    """The end of a search: the base, the rounds, the final model and its effects.

    Where the choice of a round was taken back for a better pair, `other` are the rounds of the way
    that was left first, with the one that showed it.
    """

    base: Model
    steps: tuple[Step, ...]
    final: Model
    found: tuple[Found, ...]
    before: Omnibus
    after: Omnibus
    other: tuple[Step, ...] = ()


def search(
    base: Model, catalogue: Sequence[type[AbstractEffect]], work: Work,
    tell: Callable[[str], None], first: Sequence[Step] = (),
) -> Search:  # fmt: skip
    """Add effects to a base model until nothing more earns a place, and drop what is superfluous.

    Parameters
    ----------
    base : Model
        The recalibrated model.
    catalogue : sequence of effect classes
        What may be missing.
    work : callable
        ``work(function, items)``, a map that may run in parallel.
    tell : callable
        Told what is being done.
    first : sequence of Step, optional
        The rounds of a way that another search has left. This one goes on from there and takes
        nothing back.

    Returns
    -------
    Search
        The rounds and the final model.
    """
    given = len(base.loop.effects)
    steps = list(first)
    model = whole(first[-1].base) if first else base
    changed, left = False, tuple[Step, ...]()
    while not steps or steps[-1].best is not None:
        if steps and steps[-1].best is not None:
            tell(f"round {len(steps)}: {steps[-1].best.name}")
            model = renoised(reordered(steps[-1].best.model, given))
            model = whole(without_superfluous(model, given))
        if (
            len(model.loop.effects) - given >= THRESHOLD.many_effects
            or len(steps) >= THRESHOLD.many_effects + 2
        ):
            break
        tell(f"round {len(steps) + 1}: screening")
        pool = missing_candidates(model, catalogue)
        step = one_round(model, pool, work, None if steps else anchor(base))
        step = replace(step, base=Model(model.loop, spared(model.fit)))
        if step.best is not None and _stands_in(step.best, model, beside=bool(steps)):
            step = replace(step, best=None)
        asked = steps and not first and not changed
        better = _foreseen(steps[-1], step, catalogue, work) if asked else None
        changed = better is not None
        if changed:
            left = left or (*steps, step)
            steps[-1] = replace(steps[-1], best=better)
        else:
            steps.append(step)
    try:
        model, found = settled(model, given, steps)
    except CtrlidError:  # what cannot be taken out again cannot be weighed, and explains nothing
        model, found = base, ()
    tests = omnibus(base.fit), judged(model)
    return Search(base, tuple(steps), model, found, *tests, left)


def named(found: Search, work: Work) -> Search:
    """Return the search with what could stand in the place of each effect."""
    given = len(found.base.loop.effects)
    model, each = compared(found.final, found.found, given, found.steps, work)
    after = found.after if model is found.final else judged(model)
    return replace(found, final=model, found=each, after=after)


def _stands_in(best: Trial, model: Model, beside: bool) -> bool:
    """Whether an effect gains so much less than what is missing that it can only stand in for it.

    Parameters
    ----------
    best : Trial
        The best candidate.
    model : Model
        The model that it was added to.
    beside : bool
        Whether an effect was found before; the best of several unknown ones may gain little.
    """
    if best.gain < THRESHOLD.little_of_known * excess(model.fit):
        return True
    if (
        not (beside and simulable(model))
        or best.gain >= THRESHOLD.small_gain * omnibus(model.fit).told
    ):
        return False
    # The tests may be alarmed by the filter itself: replicas, which take their time, forgive that.
    return best.gain < THRESHOLD.small_gain * judged(model).told


def _foreseen(
    last: Step, step: Step, catalogue: Sequence[type[AbstractEffect]], work: Work
) -> Trial | None:  # fmt: skip
    """Return what would have been the better choice of the last round, now that more is found.

    Where two effects hide together, the one that alone gains most may be a mixture of both. So each
    effect of its kind that did nearly as well is asked what could follow on it; the best pair wins.
    Where nothing follows on the best that leaves noise alone, those that did as well are asked: an
    offset of the sensor moves the middle of a spring, and a constant force does not.
    """
    if step.best is None and omnibus(step.base.fit).passed:
        return None
    best = last.best
    assert best is not None
    ties = step.best is None or not omnibus(step.best.model.fit).passed
    near = [t for t in last.trials[1 : THRESHOLD.looked_at] if _nearly(t, best, ties)]
    # What promised little beside the best is not scanned again, which takes most of the time.
    ranked = sorted(step.trials, key=lambda t: -t.promise)
    likely = {t.name for t in (ranked if step.best is None else ranked[: THRESHOLD.looked_at])}
    pairs: list[tuple[float, int]] = []
    for k, trial in enumerate(near[: THRESHOLD.looked_back]):
        model = whole(trial.model)
        pool = [c for c in missing_candidates(model, catalogue)
                if type(c) not in SCANS or type(c).__name__ in likely]  # fmt: skip
        tried: list[Trial] = work(lambda effect, model=model: scanned(model, effect), pool)
        tried = sorted(tried, key=lambda t: t.price - t.promise)[:2]
        done = work(lambda t, model=model: refit(model, t), tried)
        pairs.append((trial.merit + max((t.merit for t in done), default=-math.inf), k))
    total, k = max(pairs, default=(-math.inf, 0))
    own = best.merit + (step.best.merit if step.best is not None else THRESHOLD.gate)
    return near[k] if total > own + THRESHOLD.gate else None


def _nearly(trial: Trial, best: Trial, ties: bool) -> bool:
    """Whether a candidate did nearly as well as one that resembles it, and is another.

    One that did as well is asked for `ties` only: it is another name for the same, as a rule.
    """
    if contains(trial.effect, best.effect) or contains(best.effect, trial.effect):
        return False
    if not THRESHOLD.look_back * best.merit < trial.merit:
        return False
    mine, its = ({t.name, *type(t.effect).look_alikes} for t in (best, trial))
    return ties or (bool(mine & its) and trial.merit < best.merit - THRESHOLD.close)


def excess(fit: Fit) -> float:
    """Return the log-likelihood above that of noise which is known; zero where none is known."""
    if fit.problem.known is None:
        return 0.0
    z = np.concatenate(fit.standardized)
    return max(0.0, 0.5 * float(np.nansum(z**2 - 1)))


def judged(model: Model) -> Omnibus:
    """Return the tests of what a model leaves, without the alarms of the filter itself."""
    after = replace(omnibus(model.fit), alpha=alarm_level(len(model.loop.effects)))
    if not after.passed:
        copies = [replica(model, seed) for seed in (1, 2)]
        after = forgiven(after, copies)
    return after


def main_ones(found: Search, helps: Callable[[Found, Model], bool]) -> Search:
    """Keep the effects that carry the explanation where something unknown remains.

    Small effects beside something unknown are stand-ins for it, and a wrong name is worse than
    none: they stay if they help on data that they were not fitted to.

    Parameters
    ----------
    found : Search
        The end of a search.
    helps : callable
        ``helps(finding, model)``: whether an effect narrows the gap of the model on fresh data.

    Returns
    -------
    Search
        Without those that do not.
    """
    total = found.final.fit.value - found.base.fit.value
    complete = found.after.passed and len(found.found) < THRESHOLD.many_effects
    if complete or len(found.found) < 2:
        return found
    model = found.final
    for f in sorted(found.found, key=lambda f: -f.position):
        if f.trial.gain < THRESHOLD.minor * total and not helps(f, found.final):
            model = cut(model, f.position)[0]
    if model is found.final:
        return found
    model, left = settled(model, len(found.base.loop.effects), found.steps)
    return replace(found, final=model, found=left, after=judged(model))


def without_worst(found: Search, gap: Callable[[Model], float]) -> Search:
    """Take back the effect without which a model leaves the narrowest gap."""
    worst = min(found.found, key=lambda f: gap(f.base))
    model, left = settled(worst.base, len(found.base.loop.effects), found.steps)
    return replace(found, final=model, found=left, after=judged(model))
