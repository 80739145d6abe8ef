"""Step 6: one round of the search: all screened, the promising refitted, the best checked."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..effects import AbstractEffect
from ..estimation.likelihood.maximization import compute_expected_gain
from .candidates import (
    Objection,
    Trial,
    Work,
    borrow_size,
    contains,
    is_same_kind,
    keep_for_comparison,
)
from .fitted_model import Model, without_random_force
from .ordering import order_trial
from .quiet_refitting import refit_quietly
from .refitting import refit_candidate, refit_under_noise
from .replicas import has_kinks, make_replica, measure_gain_beyond_simple, measure_gain_on_replicas
from .scans import ModelSight, scan_candidate
from .screening import screen_at
from .thresholds import THRESHOLD

# A job is the trial that is refitted, the start, and the model near whose values it starts.
Job = tuple[Trial, Trial | AbstractEffect, Model | None]


@dataclass(frozen=True, eq=False)
class Round:
    """One round: the model it started from, what was tried, and what won.

    The `others` earn a place as well, and are no forms of the best or of each other.
    """

    base: Model
    trials: tuple[Trial, ...]
    best: Trial | None
    others: tuple[Trial, ...] = ()


def run_round(
    base: Model, pool: Sequence[AbstractEffect], work: Work, other: Model | None = None,
    given: int = 0, beside: bool = False,
) -> Round:  # fmt: skip
    """Screen all candidates, refit the promising, and return the best that earns its place.

    They are added to the base, and to the `other` model in its place if one is given. Where an
    effect was found before, `beside` it, they are also tried under hardly any random force. The
    base had `given` effects from the beginning.
    """
    tried: list[Trial] = work(lambda effect: scan_candidate(base, effect), pool)
    more: list[Trial] = []
    if other is not None:
        # What the model alone would regain from these values is no gain of a candidate.
        lost = other.fit.value - base.fit.value
        lost -= max(0.0, lost + compute_expected_gain(other.fit))
        more = work(lambda effect: scan_candidate(other, effect), pool)
        more = [replace(t, score=t.score + lost) for t in more]
        pairs = zip(tried, more, strict=True)
        tried = [a if a.score > 0 or a.score >= b.score else b for a, b in pairs]
        tried += [b for b in more if b.score > 0 and all(b is not t for t in tried)]
    tried.sort(key=lambda t: -t.score)
    if not tried or not math.isfinite(tried[0].score):
        return Round(base, tuple(tried), None)
    copies: list[Model | None] = []
    trials = _refit_promising(base, tried, more, work, given)
    if beside:
        # Two that hide together leave a large random force, beside which a score tells little.
        trials += refit_quietly(base, [t.effect for t in tried], work)
    trials = _prefer_simplest(base, _check_on_replicas(base, trials, copies))
    plain = prefer_plainer(base, trials[0], trials[1:])
    if plain is not trials[0]:
        trials = [plain, *(t for t in trials if not is_same_kind(t.effect, plain.effect))]
        trials = _check_on_replicas(base, trials, copies)
    best = trials[0]
    if best.net_gain <= THRESHOLD.gate:
        return Round(base, tuple(map(keep_for_comparison, trials)), None)
    others = _list_other_choices(trials)
    kept = {id(t) for t in (*trials[: THRESHOLD.looked_at], *others)}
    trials = [t if id(t) in kept else keep_for_comparison(t) for t in trials]
    return Round(base, tuple(trials), best, others)


def _list_other_choices(trials: Sequence[Trial]) -> tuple[Trial, ...]:
    """Return what a round could take in place of its best, none a form of another."""
    choices = list(trials[:1])
    for t in trials[1:]:
        forms = (
            is_same_kind(t.effect, c.effect)
            or contains(t.effect, c.effect)
            or contains(c.effect, t.effect)
            for c in choices
        )
        if t.net_gain > THRESHOLD.gate and not any(forms):
            choices.append(t)
    return tuple(choices[1 : THRESHOLD.looked_back + 1])


def _refit_promising(
    base: Model, tried: Sequence[Trial], more: Sequence[Trial], work: Work, given: int
) -> list[Trial]:
    """Return the trials, the promising and what resembles the best refitted.

    `more` are trials around other values of the model, for those whose fit may be stuck.
    """
    done: dict[int, Trial] = {}

    def one(job: Job) -> Trial:
        trial, start, near = job
        if isinstance(start, AbstractEffect):
            start = screen_at(base, start, trial.scan_penalty)
        return refit_candidate(base, start, near)

    def fit(jobs: Sequence[Job]) -> Trial:
        for (t, _, _), r in zip(jobs, work(one, jobs), strict=True):
            done[id(t)] = max(done.get(id(t), r), r, key=lambda t: t.net_gain)
        return max((*done.values(), *tried), key=lambda t: t.net_gain)

    leader = tried[0]
    wanted = {t.key for t in tried[: THRESHOLD.refitted_first]}
    wanted |= {t.key for t in tried if t.resembles(leader)}
    promising = [t for t in tried if t.score > THRESHOLD.faint * (THRESHOLD.gate + t.full_penalty)]
    first = [
        t for t in promising if t.key in wanted or t.score > THRESHOLD.refitted_share * leader.score
    ]
    fit([(t, e, None) for t in first for e in t.others])
    best = fit([(t, t, None) for t in first])
    if math.isfinite(best.net_gain):
        winner = best
        fit([(t, t, None) for t in tried
             if id(t) not in done and t.resembles(winner) and t.score > -math.inf])  # fmt: skip
        best = fit([(t, e, None) for t in tried
                    if id(t) in done and (t.key == winner.key or t.resembles(winner))
                    for e in t.effect.other_starts(ModelSight(base, t.effect.at))])  # fmt: skip
        least = THRESHOLD.near_winner * best.net_gain
        behind = [t for t in tried if id(t) in done and best.net_gain > 0
                  and done[id(t)].net_gain <= least]  # fmt: skip
        borrowed = [(t, borrow_size(t, best)) for t in behind]
        best = fit([(t, e, best.model) for t, e in borrowed if e is not None])
        stuck = [t for t in _find_stuck(best, tried) if id(t) in done]
        near = without_random_force(best.model)
        fit([(t, done[id(t)].fitted, near) for t in stuck])
        best = fit([(t, m, None) for t in stuck for m in more if m is not t and m.key == t.key])
        apart = [
            k
            for k, t in done.items()
            if t.net_gain > THRESHOLD.near_winner * best.net_gain and _forces_differ(t, best)
        ]
        noise = best.model.fit.noise
        again = work(lambda k: refit_under_noise(base, done[k], noise), apart)
        done |= dict(zip(apart, again, strict=True))
        near_winner = [
            k
            for k, t in done.items()
            if t.net_gain > THRESHOLD.near_winner * best.net_gain or t.resembles(best)
        ]
        again = work(lambda k: order_trial(base, done[k], given), near_winner)
        done |= dict(zip(near_winner, again, strict=True))
    return [done.get(id(t), t) for t in tried]


def _forces_differ(one: Trial, other: Trial) -> bool:
    """Whether the random forces that two fits ended with are not the same."""
    a, b = one.model.fit.noise, other.model.fit.noise
    if not (a.drift and b.drift):
        return bool(a.drift) != bool(b.drift)
    return abs(math.log((1 - a.memory) / (1 - b.memory))) > math.log(THRESHOLD.different_force)


def _find_stuck(best: Trial, tried: Sequence[Trial]) -> list[Trial]:
    """Return what may have lost only because its likelihood is rugged, as dry friction's is.

    Where a large random force smooths the kink away, a fit stays there. It is refitted with hardly
    any such force, from the values that it has reached: from its first ones success is chance.
    """
    if not best.net_gain > 0:
        return []
    own = [t for t in tried if t.key == best.key or contains(best.effect, t.effect)]
    most = len(best.effect.values())
    plain = [
        t
        for t in tried
        if t.key != best.key and any(t.resembles(o) for o in own) and len(t.effect.values()) <= most
    ]
    return [t for t in plain if has_kinks(t.model)]


def prefer_plainer(base: Model, best: Trial, others: Sequence[Trial]) -> Trial:
    """Return an effect that the best one contains, if it does as well when it starts from there."""
    for t in others:
        if not best.net_gain > 0 or not contains(best.effect, t.effect):
            continue
        values = best.fitted.values()
        start = replace(t.effect, **{k: values[k] for k in t.effect.values()})
        again = refit_candidate(base, screen_at(base, start, t.scan_penalty), best.model)
        if again.net_gain >= best.net_gain:
            return again
    return best


def _prefer_simplest(base: Model, trials: list[Trial]) -> list[Trial]:
    """Put a winner behind what it contains if its further parameters do not earn their penalty.

    What the filter's approximations gain counts for nothing. A gain beyond that is too small to
    prove anything, and too large to exclude it: it is left to be compared.
    """
    best = trials[0]
    for simple in trials[1 : THRESHOLD.looked_at]:
        fewer = len(simple.effect.values()) < len(best.effect.values())
        if not fewer or simple.net_gain <= THRESHOLD.gate:
            continue
        if best.gain - simple.gain > THRESHOLD.simpler_nearly * best.gain or not simple.resembles(
            best
        ):
            continue
        more = measure_gain_beyond_simple(base, best, simple)
        if more <= best.penalty - simple.penalty:
            words = f"{simple.name} explains as much with fewer parameters"
            behind = (
                replace(best, gain=simple.gain + more)
                if more > THRESHOLD.hint
                else replace(best, out=Objection("not the simplest", words))
            )
            return sorted([behind, *trials[1:]], key=lambda t: (-t.net_gain, -t.score))
    return trials


def _check_on_replicas(base: Model, trials: list[Trial], copies: list[Model | None]) -> list[Trial]:
    """Put out what gains as much on records in which it is known not to be.

    The `copies` are made when the first candidate needs them.
    """
    for _ in range(THRESHOLD.looked_at):
        trials.sort(key=lambda t: (-t.net_gain, -t.score))
        best = trials[0]
        sure = best.gain > THRESHOLD.no_artefact and not base.loop.effects
        if best.net_gain <= THRESHOLD.gate or sure:
            break
        enough = (
            (THRESHOLD.replicas_beside_kink if best.net_gain < THRESHOLD.slight_beside_kink else 2)
            if has_kinks(base)
            else 1
        )
        copies += [make_replica(base, seed) for seed in range(len(copies), enough)]
        if (
            best.net_gain - THRESHOLD.replica_weight * measure_gain_on_replicas(copies, best)
            > THRESHOLD.gate
        ):
            break
        words = "gains nearly as much on a simulated record that does not contain it"
        trials[0] = replace(best, out=Objection("artefact", words))
    return trials
