"""Step 7: the search adds effects, drops superfluous ones and looks back, round by round."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial

import numpy as np

from .._base.errors import EffectDoesNotApply, ModelCannotRun
from .._base.interruption import Stopped, ending
from ..effects import AbstractEffect
from ..effects.base import name_at_place, name_with_subject
from ..estimation.likelihood.kalman_filter import Noise
from ..estimation.likelihood.likelihood import Fit
from ..estimation.likelihood.maximization import choose_noise, maximize, refit_noise_size
from ..estimation.likelihood.tails import JointTails
from ..loop.loop import find_converter_steps
from .candidates import Trial, Work, is_same_kind, list_missing_candidates
from .fitted_model import (
    Model,
    can_simulate,
    compute_criterion,
    drop_linearization,
    with_linearization,
)
from .fresh_data import FreshData
from .hindsight import find_better_choice
from .noise_choice import prefer_sensor_noise
from .noise_tests import NoiseTests, choose_alarm_level, run_noise_tests
from .ordering import order_effect
from .recalibration import restore_given_values
from .refitting import refit_candidate
from .removal import (
    Weighed,
    drop_superfluous,
    drop_unseen_values,
    refit_noise,
    refit_without_effect,
    weigh_effects,
)
from .replicas import forgive_filter, make_replica
from .rivals import compare_effects
from .screening import screen_at
from .selection import Round, run_round
from .sharpening import sharpen_model
from .thresholds import THRESHOLD


@dataclass(frozen=True, eq=False)
class Search:
    """The end of a search: the base, the rounds, the final model and its effects.

    Where the choice of a round was taken back for a better pair, `other` holds the rounds before
    the first such change, with the round that showed it. Where the budget was spent before the end,
    it is not `finished`, and nothing was checked after the last round.
    """

    base: Model
    steps: tuple[Round, ...]
    final: Model
    found: tuple[Weighed, ...]
    before: NoiseTests
    after: NoiseTests
    other: tuple[Round, ...] = ()
    finished: bool = True


def search_effects(
    base: Model, catalogue: Sequence[type[AbstractEffect]], work: Work,
    tell: Callable[..., None], is_false: Callable[..., bool], first: Sequence[Round] = (),
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
    is_false : callable
        ``is_false(model)``: whether fresh data falsify the noise of a model.
    first : sequence of Round, optional
        The rounds that another search had taken when it changed a choice. This one goes on from
        there and takes nothing back.

    Returns
    -------
    Search
        The rounds and the final model; where the budget was spent before, those that were reached.
    """
    before = [(step.base, step.best) for step in first[:-1] if step.best is not None]
    reached = Reached(base, list(first), base, before)
    try:
        return _grow_model(base, catalogue, work, tell, is_false, first, reached)
    except Stopped:
        return _end_search(reached)


@dataclass(eq=False)
class Reached:
    """How far a search has come: what is left of it when it is stopped.

    `taken` holds each effect as it was taken, with the model that it was added to; `likeliest` is
    the most probable model so far, for a search may be stopped just after it went back.
    """

    base: Model
    steps: list[Round]
    model: Model
    taken: list[tuple[Model, Trial]] = field(default_factory=list)
    likeliest: Model | None = None

    def keep(self, before: Model, best: Trial) -> None:
        """Keep an effect as it is taken."""
        self.taken.append((before, best))
        self.note(best.model)

    def note(self, model: Model) -> None:
        """Keep a model if it is the most probable one so far."""
        if self.likeliest is None or compute_criterion(model) > compute_criterion(self.likeliest):
            self.likeliest = model


def _grow_model(
    base: Model, catalogue: Sequence[type[AbstractEffect]], work: Work,
    tell: Callable[..., None], is_false: Callable[..., bool], first: Sequence[Round],
    reached: Reached,
) -> Search:  # fmt: skip
    """Take the rounds of `search_effects`, and keep what was reached."""
    given = len(base.loop.effects)
    steps = reached.steps
    model = with_linearization(first[-1].base) if first else base
    changed, left = False, tuple[Round, ...]()
    likeliest = model
    # The last round that was begun before the search looked back.
    seen = 0
    while not steps or steps[-1].best is not None:
        if steps and steps[-1].best is not None:
            best = steps[-1].best
            head = _name_round(len(steps), seen, again=bool(first))
            tell(f"{head}: {name_with_subject(best.effect)} with all else")
            reached.keep(steps[-1].base, best)
            reached.model = best.model
            model = refit_noise(order_effect(best.model, best.position, given))
            model = sharpen_model(drop_unseen_values(model, given))
            model = with_linearization(drop_superfluous(model, given))
            likeliest = max(likeliest, model, key=compute_criterion)
            reached.note(model)
        if (
            len(model.loop.effects) - given >= THRESHOLD.many_effects
            or len(steps) >= THRESHOLD.many_effects + THRESHOLD.more_rounds
        ):
            break
        reached.model = model
        head = _name_round(len(steps) + 1, seen, again=bool(first))
        tell(f"{head}: screening")
        pool = list_missing_candidates(model, catalogue)
        given_values = None if steps else restore_given_values(base)
        step = run_round(model, pool, work, given_values, given, beside=bool(steps))
        # Noise may be coloured and have heavy tails, one after the other.
        # It may simulate replicas, and is asked of the same effect twice.
        is_stand_in = cache(partial(_is_stand_in, beside=bool(steps)))
        while (other := prefer_sensor_noise(model, step.best, is_false, is_stand_in)) is not None:
            tell(f"{head}: screening beside other sensor noise")
            model, base = other, base if steps else other
            reached.model, reached.base = model, base
            pool = list_missing_candidates(model, catalogue)
            step = run_round(model, pool, work, given=given, beside=bool(steps))
        step = replace(step, base=Model(model.loop, drop_linearization(model.fit)))
        if step.best is not None and is_stand_in(step.best, model):
            step = replace(step, best=None)
        asked = steps and not first and not changed
        tell(f"{head}: checking", ranked=False)
        better = find_better_choice(steps[-1], step, catalogue, work) if asked else None
        changed = better is not None
        if changed:
            seen = len(steps) + 1
            left = left or (*steps, step)
            steps[-1] = replace(steps[-1], best=better)
        else:
            steps.append(step)
    tell("weighing what was found")
    if compute_criterion(likeliest) > compute_criterion(model) + THRESHOLD.gate:
        # What was dropped, or came in its place, was worth less than what it cost.
        model = likeliest
    try:
        model, found = weigh_effects(model, given, steps)
    except (ModelCannotRun, EffectDoesNotApply):
        # What cannot be taken out again cannot be weighed, and explains nothing.
        model, found = base, ()
    tests = run_noise_tests(base.fit), retest_with_replicas(model)
    return Search(base, tuple(steps), model, found, *tests, left)


def _name_round(number: int, seen: int, again: bool) -> str:
    """Return what a round is called while it is taken, so that its number never goes back.

    Parameters
    ----------
    number : int
        The number of the round, from 1.
    seen : int
        The round that was begun when the search looked back, up to which rounds are taken anew.
    again : bool
        Whether this is the second search, which begins where the first one changed a choice.
    """
    if again:
        return f"second search, round {number}"
    return f"looking back from round {seen}" if number <= seen else f"round {number}"


def _end_search(reached: Reached) -> Search:
    """Return a search that was stopped, with each effect as it stood in the round that took it."""
    base, found = reached.base, list[Weighed]()
    model = max(reached.model, reached.likeliest or reached.model, key=compute_criterion)
    for position in range(len(base.loop.effects), len(model.loop.effects)):
        effect = model.loop.effects[position]
        taken = [pair for pair in reached.taken if is_same_kind(pair[1].effect, effect)]
        found += [Weighed(best, (), before, position) for before, best in taken[-1:]]
    found.sort(key=lambda f: -f.trial.gain)
    with ending():
        before, after = run_noise_tests(base.fit), run_noise_tests(model.fit)
    return Search(base, tuple(reached.steps), model, tuple(found), before, after, finished=False)


def refuse_false_noise(found: Search, is_false: Callable[..., bool]) -> Search:
    """Return the search without sensor noise that stands for something else.

    Parameters
    ----------
    found : Search
        The end of a search.
    is_false : callable
        ``is_false(model)``: whether fresh data falsify the noise of a model.
    """
    return _refuse_bursts(_refuse_larger_noise(found, is_false))


def _refuse_larger_noise(found: Search, is_false: Callable[..., bool]) -> Search:
    """Return the search with white sensor noise in the place of what exceeds the gap that it left.

    Coloured noise that was chosen before the effects were found may be too large beside them.
    """
    fit = found.final.fit
    if fit.noise.sensor_is_white or fit.known is not None or not is_false(found.final):
        return found
    plain = _refit_with_noise(found.final, fit.noise.plain)
    return _weigh_anew(found, plain) if is_false(found.final, plain) else found


def _refuse_bursts(found: Search) -> Search:
    """Return the search with Gaussian sensor noise where the wild readings come in bursts.

    These are events of the plant, or of a clock, that heavy tails of several outputs stood for.
    """
    noise = found.final.fit.noise
    if not isinstance(noise.tails, JointTails) or not found.after.has_bursts:
        return found
    return _weigh_with_noise(found, replace(noise, tails=None))


def _weigh_with_noise(found: Search, noise: Noise) -> Search:
    """Return the search with what was found weighed anew, beside noise of another kind."""
    return _weigh_anew(found, _refit_with_noise(found.final, noise))


def _refit_with_noise(model: Model, noise: Noise) -> Model:
    """Return a model fitted anew beside noise of another kind."""
    plain = refit_noise_size(maximize(replace(model.fit, noise=noise)))
    return Model(model.loop, drop_linearization(choose_noise(plain)))


def _weigh_anew(found: Search, model: Model) -> Search:
    """Return the search with another final model, its effects weighed and what it leaves tested."""
    model, left = weigh_effects(model, len(found.base.loop.effects), found.steps)
    return replace(found, final=model, found=left, after=retest_with_replicas(model))


def choose_search(
    one: Search, other: Search, helps: Callable[[Weighed, Model], bool],
    gap: Callable[[Model], float],
) -> Search:  # fmt: skip
    """Return the search that leaves noise alone, or else the one with the narrower gap.

    Parameters
    ----------
    one, other : Search
        Two searches of the same records, of which the second took nothing back.
    helps : callable
        As in `keep_main_effects`.
    gap : callable
        ``gap(model)``: the RMS error of a model on fresh data [output unit].
    """
    kept = [keep_main_effects(search, helps) for search in (one, other)]
    return min(kept, key=lambda search: (not search.after.passed, gap(search.final)))


def compare_names(found: Search, work: Work) -> Search:
    """Return the search with what could stand in the place of each effect."""
    given = len(found.base.loop.effects)
    model, each = compare_effects(found.final, found.found, given, found.steps, work)
    after = found.after if model is found.final else retest_with_replicas(model)
    return replace(found, final=model, found=each, after=after)


def _is_stand_in(best: Trial, model: Model, beside: bool) -> bool:
    """Whether an effect gains so much less than what is missing that it can only stand in for it.

    It is none where the tests see nothing any more beside it.

    Parameters
    ----------
    best : Trial
        The best candidate.
    model : Model
        The model that it was added to.
    beside : bool
        Whether an effect was found before; the best of several unknown ones may gain little.
    """
    if best.gain < THRESHOLD.little_of_known * measure_unexplained_likelihood(model.fit):
        return True
    if not (beside and can_simulate(model)):
        return False
    if best.gain >= THRESHOLD.small_gain * run_noise_tests(model.fit).evidence:
        return False
    # A test of whiteness counts a line once for each lag, and says more than the line is worth.
    if run_noise_tests(with_linearization(best.model).fit).passed:
        return False
    # The tests may be alarmed by the filter itself: replicas, which take their time, forgive that.
    return best.gain < THRESHOLD.small_gain * retest_with_replicas(model).evidence


def measure_unexplained_likelihood(fit: Fit) -> float:
    """Return the log-likelihood above that of noise which is known; zero where none is known."""
    if fit.known is None:
        return 0.0
    z = np.concatenate([np.ravel(part) for part in fit.standardized])
    return max(0.0, 0.5 * float(np.nansum(z**2 - 1)))


def retest_with_replicas(model: Model) -> NoiseTests:
    """Return the tests of what a model leaves, without the alarms of the filter itself."""
    after = replace(run_noise_tests(model.fit), alpha=choose_alarm_level(len(model.loop.effects)))
    if not after.passed:
        copies = [make_replica(model, seed) for seed in (1, 2)]
        if any(find_converter_steps(model.loop)):
            copies.append(make_replica(model, noisy=False))
        after = forgive_filter(after, copies)
    return after


def keep_main_effects(found: Search, helps: Callable[[Weighed, Model], bool]) -> Search:
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
            model = refit_without_effect(model, f.position)[0]
    return found if model is found.final else _weigh_anew(found, model)


def exchange_worst_effect(
    found: Search, refused: Collection[str], fresh: FreshData
) -> tuple[Search, str]:
    """Take back the effect without which a model leaves the narrowest gap, and name it.

    Its place is taken by the rival that narrows the gap most, if one does so beyond chance: the
    harmful name was only likelier.

    Parameters
    ----------
    found : Search
        The end of a search.
    refused : collection of str
        Names that are not tried again.
    fresh : FreshData
        What models are compared on.
    """
    worst = min(found.found, key=lambda f: fresh.measure_model_gap(f.base))
    base = with_linearization(worst.base)
    out = {worst.trial.key, *refused, *(name_at_place(e) for e in base.loop.effects)}
    best: dict[str, Trial] = {}
    for t in (*worst.rivals, *(t for step in found.steps for t in step.trials)):
        if t.net_gain > THRESHOLD.gate and t.key not in out:
            best[t.key] = max(best.get(t.key, t), t, key=lambda t: t.net_gain)
    rivals = sorted(best.values(), key=lambda t: -t.net_gain)[: THRESHOLD.looked_at]
    tried = [refit_candidate(base, screen_at(base, t.fitted)) for t in rivals]
    liked = [
        t.model for t in tried
        if t.net_gain > THRESHOLD.gate
        and fresh.compute_widening_chance(t.model, worst.base) < THRESHOLD.beyond_chance
    ]  # fmt: skip
    model = min(liked, key=fresh.measure_model_gap, default=worst.base)
    return _weigh_anew(found, model), worst.trial.key
