"""Step 7: what the model does without: superfluous effects, and two that are one."""

import contextlib
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from .._base.criterion import bayesian_penalty
from .._base.errors import ModelCannotRun
from ..effects.base import name_with_subject
from ..estimation.likelihood.kalman_filter import Noise
from ..estimation.likelihood.likelihood import evaluate_likelihood, relinearize_fit
from ..estimation.likelihood.maximization import (
    begin_fit,
    choose_noise,
    choose_sensor_noise,
    maximize,
    polish_fit,
    refit_noise_size,
)
from ..estimation.likelihood.noise.coordinates import compute_noise_criterion
from ..loop.loop import Loop
from .candidates import Trial, contains
from .fitted_model import (
    Model,
    carry_over_fit,
    compute_criterion,
    drop_linearization,
    has_trajectories,
    with_linearization,
)
from .information import estimate_need
from .ordering import rename_labels
from .refitting import refit_candidate, weigh_refit
from .screening import screen_at
from .selection import Round
from .thresholds import THRESHOLD


@dataclass(frozen=True, eq=False)
class Weighed:
    """An effect that earned its place, and what cannot be told apart from it."""

    trial: Trial
    rivals: tuple[Trial, ...]
    base: Model
    # This is the position of the effect among those of the final loop.
    position: int


def weigh_effects(
    model: Model, given: int, steps: Sequence[Round]
) -> tuple[Model, tuple[Weighed, ...]]:
    """Return the model without what is superfluous, and each effect on top of all the others."""
    if len(model.loop.effects) == given:
        return model, ()
    model = drop_unseen_values(model, given)
    best = steps[0].best
    alone = len(model.loop.effects) == given + 1 and len(steps) <= 2
    alone = alone and best is not None and list(best.model.names) == list(model.names)
    if alone and best is not None and _is_as_fitted(best.model, model):
        return model, (Weighed(best, (), steps[0].base, given),)
    one = fuse_effects(model, given, steps)
    if one is not model:
        return weigh_effects(refit_noise(one), given, steps)
    found: list[Weighed] = []
    for position in range(given, len(model.loop.effects)):
        refitted, mine = weigh_without_effect(model, position)
        smaller = _find_likeliest_passed(refitted, steps)
        if smaller is not refitted:
            mine = _count_beyond(smaller, model, mine)
        if mine.net_gain <= THRESHOLD.gate:
            return weigh_effects(refit_noise(smaller), given, steps)
        found.append(Weighed(mine, (), smaller, position))
    found.sort(key=lambda f: -f.trial.gain)
    return model, tuple(found)


def _find_likeliest_passed(model: Model, steps: Sequence[Round]) -> Model:
    """Return the likeliest model of the same effects that a search passed through.

    Where an effect that is taken out had moved the others, a climb may end short of where they were
    before it came.
    """
    tried = (t.model for s in steps for t in s.trials if t.out is None)
    same = [
        m for m in (*(s.base for s in steps), *tried)
        if m.names == model.names and _name_effects(m) == _name_effects(model)
    ]  # fmt: skip
    passed = max([model, *same], key=compute_criterion)
    kept = passed.fit
    if has_trajectories(kept):
        return passed
    # Of what was only kept for a comparison, they are gone.
    fit = evaluate_likelihood(kept.problem, kept.theta, kept.noise, model.fit.trajectories)
    restored = replace(passed, fit=drop_linearization(relinearize_fit(fit)))
    return max(model, restored, key=compute_criterion)


def _name_effects(model: Model) -> list[str]:
    return [name_with_subject(effect) for effect in model.loop.effects]


def _is_as_fitted(one: Model, other: Model) -> bool:
    """Whether two models of the same effects differ in values alone."""
    return one.loop.sharpness == other.loop.sharpness and has_same_noise(one, other)


def has_same_noise(one: Model, other: Model) -> bool:
    """Whether the noise of two models is of one kind and order."""
    a, b = one.fit.noise, other.fit.noise
    return _list_kinds(a) == _list_kinds(b)


def _list_kinds(noise: Noise) -> tuple[bool, int, int, bool]:
    return bool(noise.drift), len(noise.ar), len(noise.ma), noise.tails is not None


def fuse_effects(model: Model, given: int, steps: Sequence[Round]) -> Model:
    """Return a model in which one effect stands for two, if it explains as much with as few.

    Dry friction found first and a constant force after it may be one asymmetric friction.
    """
    one = _merge_contained_effects(model, given)
    if one is not model:
        return one
    effects = model.fitted.effects
    richer = {t.key: t.effect for s in steps for t in s.trials}
    for k, other in itertools.permutations(range(given, len(effects)), 2):
        for start in richer.values():
            if not contains(start, effects[k]):
                continue
            more = len(effects[k].values()) + len(effects[other].values())
            saved = bayesian_penalty(more - len(start.values()), model.fit.size)
            without = _drop_effects(model, [other])
            smaller = _drop_effects(model, [k, other])
            trial = screen_at(smaller, replace(start, **effects[k].values()))
            lost = model.fit.value - without.fit.value
            regained = smaller.fit.value + trial.score - without.fit.value
            if regained < THRESHOLD.regained * lost:
                continue
            trial = refit_candidate(smaller, trial, model)
            if not trial.net_gain > THRESHOLD.gate:
                continue
            # Where both say the same of the plant, no climb makes the one exactly as likely.
            one = replace(trial.model, fit=maximize(with_linearization(trial.model).fit))
            if one.fit.value + saved > model.fit.value - THRESHOLD.tie:
                return one
    return model


def _merge_contained_effects(model: Model, given: int) -> Model:
    """Return a model in which an effect and one that contains it are one, if that explains as much.

    Asymmetric friction beside dry friction has one size too many.
    """
    effects = model.fitted.effects
    for k, other in itertools.permutations(range(given, len(effects)), 2):
        if not contains(effects[other], effects[k]):
            continue
        with contextlib.suppress(ModelCannotRun):
            one = _merge_effect(model, k, other)
            saved = bayesian_penalty(len(model.names) - len(one.names), one.fit.size)
            if one.fit.value + saved > model.fit.value:
                return one
    return model


def _merge_effect(model: Model, k: int, other: int) -> Model:
    """Return the model with the sizes of one effect added to those of another."""
    effects, label = model.fitted.effects, list(model.fitted.labelled)[other]
    sizes, shared = effects[other].values(), effects[k].values()
    sums = {f"{label}.{name}": sizes[name] + shared[name] for name in shared}
    loop, names = take_out_effect(model.fitted.with_parameters(sums), k, model.names)
    fit = maximize(carry_over_fit(model, loop, names), rounds=THRESHOLD.removal_rounds)
    return Model(loop, fit)


def _drop_effects(model: Model, positions: Sequence[int]) -> Model:
    """Return the model without some of its effects, all else as it is where that can run.

    Beside an effect the parameters may have gone to where the plant alone cannot be: a wrong zero
    of the position lets a magnet be a thousand times too strong. Then it begins as handed in.
    """
    with contextlib.suppress(ModelCannotRun):
        return _carry_without(model, model.fitted, positions)
    return _carry_without(model, model.loop, positions)


def _carry_without(model: Model, loop: Loop, positions: Sequence[int]) -> Model:
    """Return a loop of the model without some of its effects, on the model's records."""
    names = model.names
    for position in sorted(positions, reverse=True):
        loop, names = take_out_effect(loop, position, names)
    fit = carry_over_fit(model, loop, names)
    # With the small noise of the full model, the smaller one may lose the record.
    if not math.isfinite(fit.value):
        fit = begin_fit(fit.problem, fit.theta)
    return Model(loop, fit)


def take_out_effect(
    loop: Loop, position: int, names: Sequence[str]
) -> tuple[Loop, tuple[str, ...]]:
    """Return a loop without one of its effects, and the names of what is free then."""
    labels = list(loop.labelled)
    label, less = labels[position], loop.without_effect(labels[position])
    renamed = dict(zip(labels[:position] + labels[position + 1 :], less.labelled, strict=True))
    left = [n for n in names if not n.startswith(f"{label}.")]
    return less, tuple(rename_labels(left, renamed))


def refit_without_effect(model: Model, position: int) -> tuple[Model, Trial]:
    """Return the model without one effect, refitted, and the effect as a trial on top of it."""
    bare = _drop_effects(model, [position])
    # What the effect explained is left to a random force, which may have to be far larger.
    fit = refit_noise_size(maximize(bare.fit, rounds=THRESHOLD.removal_rounds))
    smaller = replace(bare, fit=drop_linearization(fit))
    effect = model.fitted.effects[position]
    # Put back anew, it would come last; and all else may have gone too far astray without it.
    label = list(model.loop.labelled)[position]
    return smaller, weigh_refit(smaller, Trial(effect, label, model, -math.inf), model.fit)


def weigh_without_effect(model: Model, position: int) -> tuple[Model, Trial]:
    """Return what `refit_without_effect` does, unless a standard error overrules a likelihood.

    The likelihood beside the maximum may be flat, and fall far away where the effect is absent: dry
    friction that a slow mode partly replaces has a wide error, and gains thousands. The model
    without it is then fitted as well as it can be, noise included, and what that leaves decides.
    """
    smaller, trial = refit_without_effect(model, position)
    flat = trial.out is not None and trial.out.ground == "insignificant"
    if not (flat and trial.gain - trial.penalty > THRESHOLD.gate):
        return smaller, trial
    smaller = refit_noise(smaller)
    # A trial that was put out has lost what a comparison of likelihoods needs; the model has it.
    label = list(model.loop.labelled)[position]
    whole = _count_beyond(smaller, model, replace(trial, label=label, model=model, out=None))
    return smaller, whole if whole.net_gain > THRESHOLD.gate else trial


def _count_beyond(smaller: Model, model: Model, trial: Trial) -> Trial:
    """Return a trial with what a model gains beyond a smaller one, all that was fitted paid for."""
    gain = model.fit.value - smaller.fit.value
    net = compute_criterion(model) - compute_criterion(smaller)
    return replace(trial, gain=gain, penalty=gain - net)


def refit_noise(model: Model) -> Model:
    """Ask again whether the data want a coloured force, now that an effect is in the model."""
    fit = refit_noise_size(polish_fit(model.fit))
    if fit.known is not None:
        return Model(model.loop, fit)
    if fit.noise.tails is not None:
        # The tails may have been those of errors that the effect explains.
        bare = maximize(replace(fit, noise=replace(fit.noise, tails=None)))
        fit = max(fit, bare, key=compute_noise_criterion)
    if fit.noise.is_coloured:
        plain = maximize(replace(fit, noise=fit.noise.plain))
        if compute_noise_criterion(plain) > compute_noise_criterion(fit):
            return Model(model.loop, plain)
        # The coloured noise that stood in for the effect may be far from the one that remains.
        anew = choose_noise(plain)
        if not fit.noise.sensor_is_white:
            anew = max(anew, choose_sensor_noise(plain), key=compute_noise_criterion)
        return Model(model.loop, max(fit, anew, key=compute_noise_criterion))
    return Model(model.loop, choose_noise(fit))


def drop_superfluous(model: Model, given: int) -> Model:
    """Drop effects that the later ones made superfluous."""
    for position in range(given, len(model.loop.effects) - 1):
        if estimate_need(model, position) > THRESHOLD.surely_needed * THRESHOLD.gate:
            continue
        smaller, trial = weigh_without_effect(model, position)
        if trial.net_gain <= THRESHOLD.gate:
            return drop_superfluous(smaller, given)
    return model


def drop_unseen_values(model: Model, given: int) -> Model:
    """Return the model without optional values of its effects that earn no place.

    Friction that was found first may have to creep in place of what was found since.
    """
    for position in range(given, len(model.loop.effects)):
        label, effect = list(model.fitted.labelled.items())[position]
        for p in effect.parameters():
            name = f"{label}.{p.name}"
            if not p.optional or name not in model.names:
                continue
            effects = list(model.fitted.effects)
            effects[position] = replace(effect, **{p.name: 0.0})
            loop = replace(model.fitted, effects=tuple(effects),
                           free=tuple(n for n in model.fitted.free if n != name))  # fmt: skip
            names = [n for n in model.names if n != name]
            start = carry_over_fit(model, loop, names)
            if not math.isfinite(start.value):
                continue
            fit = maximize(start, rounds=THRESHOLD.removal_rounds)
            if fit.value + bayesian_penalty(1, fit.size) > model.fit.value:
                return drop_unseen_values(Model(loop, drop_linearization(fit)), given)
    return model
