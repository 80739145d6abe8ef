"""Step 8: what the record cannot tell apart from an effect, by Vuong's test."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .._base.arrays import Array
from ..effects.base import name_at_place
from ..estimation.likelihood.maximization import maximize
from .candidates import Trial, Work, borrow_size, contains, has_same_penalty, is_same_kind
from .fitted_model import Model, compute_criterion, compute_log_terms
from .noise_tests import run_noise_tests
from .ordering import order_trial
from .refitting import refit_candidate, weigh_refit
from .removal import (
    Weighed,
    has_same_noise,
    refit_noise,
    refit_without_effect,
    weigh_effects,
)
from .screening import screen_at
from .selection import Round, prefer_plainer
from .thresholds import THRESHOLD


def vuong_statistic(best: Array, other: Array, penalty: float) -> float:
    r"""Return Vuong's statistic of two models on the same samples.

    .. math:: z = \frac{\sum_k d_k - \Delta}{\sqrt{\sum_b (D_b - \bar D)^2}}, \quad
        d_k = \ell_k^{best} - \ell_k^{other}

    with sums D over blocks, so that neighbours may be correlated.

    Parameters
    ----------
    best, other : ndarray, shape (n,)
        Terms of the log-likelihood.
    penalty : float
        How much larger the penalty of the better model is.

    Returns
    -------
    float
        Large: the better one is really better.

    References
    ----------
    Vuong, Econometrica 57 (1989) 307-333.
    """
    d = best - other
    spread = _compute_spread_of_sum(d)
    return float((d.sum() - penalty) / max(spread, THRESHOLD.least_spread))


def _compute_spread_of_sum(d: Array) -> float:
    """Return the standard deviation of a sum whose terms may be correlated with neighbours."""
    n = len(d) // THRESHOLD.block * THRESHOLD.block
    sums = d[:n].reshape(-1, THRESHOLD.block).sum(axis=1) if n else d
    return math.sqrt(float(np.sum((sums - sums.mean()) ** 2)))


def _compute_share_beyond(trial: Trial, simple: Trial) -> float:
    """Return how large what an effect has beyond a simpler one may be, over what both have.

    NaN where the two have nothing of one unit.
    """
    names = trial.model.names
    errors = trial.model.fit.standard_errors
    units = {p.name: p.unit for p in trial.effect.parameters() if p.neutral is not None}
    shared, values, shares = simple.fitted.values(), trial.fitted.values(), []
    for k in units.keys() - shared.keys():
        size = max((abs(v) for i, v in shared.items() if units.get(i) == units[k]), default=0.0)
        key = f"{trial.label}.{k}"
        if key in names and size > 0:
            shares.append((abs(values[k]) + THRESHOLD.vuong_z * errors[names.index(key)]) / size)
    return max(shares, default=math.nan)


def find_rivals(best: Trial, others: Sequence[Trial], sure: bool = True) -> tuple[Trial, ...]:
    """Return the candidates that the record cannot tell apart from the best, best first.

    Parameters
    ----------
    best : Trial
        The refitted winner.
    others : sequence of Trial
        Refitted candidates, on the same samples and beside the same other effects.
    sure : bool, optional
        Whether what all of them leave is noise; if not, a difference of likelihood may come from
        what is still missing.

    Returns
    -------
    tuple of Trial
        Those within 3 units of log-likelihood, or not rejected by Vuong's test at z = 2; unless
        `sure`, also what is known to resemble the best and gains nearly as much.
    """
    mine = compute_log_terms(best.model.fit)
    found = []
    for trial in others:
        if is_same_kind(trial.effect, best.effect) or trial.net_gain <= THRESHOLD.gate:
            continue
        lost = best.net_gain - trial.net_gain
        theirs = compute_log_terms(trial.model.fit)
        # A larger model that predicts the same contains the best one, and pays for nothing; but one
        # that gains more may be right (a Stribeck curve hardly told from dry friction), and one
        # whose further part may be large, for all the record says, cannot be excluded. Nor can a
        # known look-alike that does not contain it and is held by no bound: a limit and a gain that
        # saturates predict the same where the input hardly comes back, whatever more one costs.
        alike = trial.resembles(best)
        larger = contains(trial.effect, best.effect)
        nothing = (
            trial.gain < best.gain + THRESHOLD.close
            and _compute_spread_of_sum(mine - theirs) < THRESHOLD.same_predictions
        )
        dearer = trial.penalty > best.penalty and not has_same_penalty(trial, best)
        if dearer and nothing and (larger or not alike):
            share = _compute_share_beyond(trial, best) if larger else math.nan
            hinted = (
                alike
                and trial.gain > best.gain + THRESHOLD.hint
                and not share <= THRESHOLD.small_part
            )
            if share > THRESHOLD.small_part or hinted:
                found.append(trial)
            continue
        equal = nothing and alike and best.gain - trial.gain < THRESHOLD.close
        ended = [n for n in _find_on_bounds(trial.model) if n.startswith(f"{trial.label}.")]
        if equal and not ended:
            found.append(trial)
            continue
        z = vuong_statistic(mine, theirs, best.penalty - trial.penalty)
        doubtful = not sure and alike and trial.net_gain > THRESHOLD.doubtful_rival * best.net_gain
        if lost < THRESHOLD.close or z < THRESHOLD.vuong_z or doubtful:
            found.append(trial)
    found.sort(key=lambda t: -t.net_gain)
    # An effect that was started from several values is one rival.
    return tuple(_list_kinds(found))


def compare_effects(
    model: Model, found: Sequence[Weighed], given: int, steps: Sequence[Round], work: Work
) -> tuple[Model, tuple[Weighed, ...]]:
    """Ask for each effect what else could stand in its place, all others being in the model.

    Parameters
    ----------
    model : Model
        The model with all effects that were found.
    found : sequence of Weighed
        These effects.
    given : int
        How many effects the model had from the beginning.
    steps : sequence of Round
        The rounds of the search, with the candidates that were refitted in each.
    work : callable
        ``work(function, items)``, a map that may run in parallel.

    Returns
    -------
    model : Model
        The model, in which a likelier rival may have taken the place of an effect.
    found : tuple of Weighed
        Its effects, each with its rivals, the largest gain first.
    """
    sure = run_noise_tests(model.fit).passed
    if len(found) == 1 and found[0].trial is steps[0].best:
        return _compare_in_round(model, found[0], steps[0], sure, work)
    done, now = [], model
    where = {id(f): f.position for f in found}
    for f in sorted(found, key=lambda f: f.position):
        place = where[id(f)]
        smaller, mine = (f.base, f.trial) if now is model else refit_without_effect(now, place)
        # An effect that took the place of another may have made this one superfluous.
        if mine.net_gain <= THRESHOLD.gate:
            fewer, left = weigh_effects(refit_noise(smaller), given, steps)
            return compare_effects(fewer, left, given, steps, work)
        there = {name_at_place(e) for e in smaller.loop.effects}
        rest = [t for t in _find_close(mine, steps, beside=True) if t.key not in there]
        # Noise that stands for the effect in the smaller model would be paid for by its rivals.
        bare = smaller
        if rest and not has_same_noise(smaller, now):
            bare = refit_without_effect(now, place)[0]

        def refit(t: Trial, bare: Model = bare, now: Model = now, mine: Trial = mine) -> Trial:
            # From the model without the effect, whose values and noise stand for it, a rival may
            # stay short of its place, and so it may from the model with it.
            start = screen_at(bare, t.fitted if t.net_gain > THRESHOLD.gate else t.effect)
            tried = [refit_candidate(bare, start, near) for near in (None, now)]
            borrowed = borrow_size(t, mine)
            if borrowed is not None:
                tried.append(refit_candidate(bare, screen_at(bare, borrowed), now))
            if contains(t.effect, mine.effect):
                # One that contains the effect is as likely where it begins as that.
                same = screen_at(bare, replace(t.effect, **mine.fitted.values()))
                tried.append(refit_candidate(bare, same, now))
            return order_trial(bare, max(tried, key=lambda t: t.net_gain), given)

        again = work(refit, rest)
        again = [_count_from(t, bare, smaller) for t in again]
        ended = _find_plant_on_bounds(mine.model)
        again = [t for t in again if _find_plant_on_bounds(t.model) <= ended]
        best = max([mine, *again], key=lambda t: t.net_gain)
        if best.net_gain <= mine.net_gain + THRESHOLD.taken_by_better:
            best = mine
        best = prefer_plainer(smaller, best, [mine, *again])
        if best is not mine:
            fit = maximize(best.model.fit, rounds=THRESHOLD.rival_rounds)
            now = replace(best.model, fit=fit)
            # All that lay between the places of the two has moved by one.
            for key, k in where.items():
                k -= k > place
                where[key] = k + (k >= best.position)
            where[id(f)] = best.position
        close = find_rivals(best, [t for t in [mine, *again] if t is not best], sure)
        done.append((f, Weighed(best, close, smaller, place)))
    weighed = [replace(w, position=where[id(f)]) for f, w in done]
    weighed.sort(key=lambda f: -f.trial.gain)
    return now, tuple(weighed)


def _compare_in_round(
    model: Model, f: Weighed, step: Round, sure: bool, work: Work
) -> tuple[Model, tuple[Weighed, ...]]:
    """Return the model and its only effect, with what came close in the round that it won.

    The fits of a round end early, each with a noise of its own, while the model was fitted on: what
    came close climbs on from the noise of the model, so that it does not lose by that.
    """
    base, close = step.base, _find_close(f.trial, (step,))
    mine = weigh_refit(base, f.trial, model.fit)

    def refit(t: Trial) -> Trial:
        # It was found by the same scan as before, and pays for that again.
        return refit_candidate(base, screen_at(base, t.fitted, t.scan_penalty), model)

    again = work(refit, close)
    if not mine.net_gain > THRESHOLD.gate:
        mine = f.trial
    all_close = [mine, *again]
    best = max(all_close, key=lambda t: t.net_gain)
    if best.net_gain > mine.net_gain + THRESHOLD.taken_by_better:
        model, mine, f = best.model, best, replace(f, trial=best)
    others = [t for t in all_close if t is not mine]
    rest = [t for t in step.trials if not any(is_same_kind(t.effect, c.effect) for c in all_close)]
    # What a noise that was chosen since gains is no evidence of an effect.
    since = mine.gain - f.trial.gain
    alike = [replace(t, gain=t.gain - since) for t in find_rivals(mine, others, sure)]
    return model, (replace(f, rivals=(*alike, *find_rivals(f.trial, rest, sure))),)


def _count_from(trial: Trial, base: Model, other: Model) -> Trial:
    """Return a trial on top of a base with its gain and penalty beyond another base."""
    if other is base:
        return trial
    gain = base.fit.value - other.fit.value
    net = compute_criterion(base) - compute_criterion(other)
    return replace(trial, gain=trial.gain + gain, penalty=trial.penalty + gain - net)


def _find_plant_on_bounds(model: Model) -> set[str]:
    """Return the plant's own parameters that are as far from their given values as is allowed."""
    return {name for name in _find_on_bounds(model) if "." not in name}


def _find_on_bounds(model: Model) -> set[str]:
    """Return the parameters that have come to an end of their range."""
    problem, theta = model.fit.problem, model.fit.theta
    ends = zip(model.names, theta, problem.lower, problem.upper, strict=True)
    return {name for name, v, low, high in ends if v in (low, high)}


def _find_close(mine: Trial, steps: Sequence[Round], beside: bool = False) -> list[Trial]:
    """Return the candidates that came close to an effect in the round that it won.

    Or that one which resembles it won, whose place it took since. Where more was found `beside` it,
    what resembles it may have come nowhere in that round, and is asked again: a lag of the actuator
    gains nothing while the curve of the input that it acts behind is missing. The same change of
    another parameter is always asked, since a score hardly tells which of them changed. What may
    have its size, as a lag has that of another lag, is asked beside however many came closer.
    """
    won = [s for s in steps if s.best is not None and s.best.key == mine.key]
    lost = [s for s in steps if s.best is not None and s.best.resembles(mine)]
    for step in [*won, *lost]:
        assert step.best is not None
        least = THRESHOLD.near_winner * step.best.net_gain
        near = [
            t
            for t in step.trials
            if not is_same_kind(t.effect, mine.effect)
            and (
                (t.net_gain > THRESHOLD.gate and (t.resembles(mine) or t.net_gain > least))
                or (t.score > -math.inf and (t.key == mine.key or (beside and t.resembles(mine))))
            )
        ]
        each = _list_kinds(near)
        others = each[THRESHOLD.looked_at :]
        alike = [t for t in others if borrow_size(t, mine) is not None]
        return [*each[: THRESHOLD.looked_at], *alike]
    return []


def _list_kinds(trials: Sequence[Trial]) -> list[Trial]:
    """Return the best trial of each kind, in their order: other starts of it ask nothing more."""
    best: list[Trial] = []
    for t in trials:
        k = next((k for k, b in enumerate(best) if is_same_kind(t.effect, b.effect)), None)
        if k is None:
            best.append(t)
        else:
            best[k] = max(best[k], t, key=lambda t: t.net_gain)
    return best
