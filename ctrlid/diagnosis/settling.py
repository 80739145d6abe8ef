"""When all effects are found: what is superfluous, and what could stand in the place of each."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..estimation.likelihood.maximization import begin, climb, polish, retuned
from ..estimation.likelihood.physics_fit import choose_noise
from ..loop.loop import Loop
from .attempts import attempt_at, outcome, refit
from .carrying import carried_over
from .decide import GATE, rivals
from .fitted import Model, simulable, spared
from .omnibus import omnibus
from .ordering import moved, relabelled
from .rounds import NEAR, NEXT, Step, Work, plainer
from .trial import Trial, contains
from .weighing import needed

REGAINED = 0.1  # of what leaving an effect out loses: what promises less does not stand for it
SURE = 100.0  # times the gate: an effect so significant is not asked whether it is needed


@dataclass(frozen=True, eq=False)
class Found:
    """An effect that earned its place, and what cannot be told apart from it."""

    trial: Trial
    rivals: tuple[Trial, ...]
    base: Model
    position: int  # among the effects of the final loop


def settled(model: Model, given: int, steps: Sequence[Step]) -> tuple[Model, tuple[Found, ...]]:
    """Return the model without what is superfluous, and each effect on top of all the others."""
    if len(model.loop.effects) == given:
        return model, ()
    best = steps[0].best
    alone = len(model.loop.effects) == given + 1 and len(steps) <= 2
    if alone and best is not None and _drifts(best.model) == _drifts(model):
        return model, (Found(best, (), steps[0].base, given),)
    one = fused(model, given, steps)
    if one is not model:
        return settled(renoised(one), given, steps)
    found: list[Found] = []
    for position in range(given, len(model.loop.effects)):
        smaller, mine = cut(model, position)
        if mine.merit <= GATE:
            return settled(renoised(smaller), given, steps)
        found.append(Found(mine, (), smaller, position))
    found.sort(key=lambda f: -f.trial.gain)
    return model, tuple(found)


def _drifts(model: Model) -> bool:
    return bool(model.fit.noise.drift)


def compared(
    model: Model, found: Sequence[Found], given: int, steps: Sequence[Step], work: Work
) -> tuple[Model, tuple[Found, ...]]:
    """Ask for each effect what else could stand in its place, all others being in the model."""
    sure = omnibus(model.fit).passed
    if len(found) == 1 and found[0].trial is steps[0].best:
        best = found[0].trial
        return model, (replace(found[0], rivals=rivals(best, steps[0].trials, sure)),)
    done, now = [], model
    for f in sorted(found, key=lambda f: f.position):
        smaller, mine = (f.base, f.trial) if now is model else cut(now, f.position)
        if mine.merit <= GATE:  # what took the place of another makes this one superfluous
            fewer, left = settled(renoised(smaller), given, steps)
            return compared(fewer, left, given, steps, work)
        there = {type(e).__name__ for e in smaller.loop.effects}
        rest = [t for t in _close(mine, steps) if t.name not in there]
        again = work(lambda t, smaller=smaller: refit(smaller, attempt_at(smaller, t.fitted)), rest)
        again = [t for t in again if _on_bounds(t.model) <= _on_bounds(mine.model)]
        best = max([mine, *again], key=lambda t: t.merit)
        if best.merit <= mine.merit + 1.0:
            best = mine
        best = plainer(smaller, best, [mine, *again])
        if best is not mine:
            now = moved(best.model, f.position)
            now = replace(now, fit=climb(now.fit, rounds=4))
        close = rivals(best, [t for t in [mine, *again] if t is not best], sure)
        done.append(Found(best, close, smaller, f.position))
    done.sort(key=lambda f: -f.trial.gain)
    return now, tuple(done)


def fused(model: Model, given: int, steps: Sequence[Step]) -> Model:
    """Return a model in which one effect stands for two, if it explains as much with as few.

    Dry friction found first and a constant force after it may be one asymmetric friction.
    """
    effects = model.fitted.effects
    richer = {t.name: t.effect for s in steps for t in s.trials}
    for k, other in itertools.permutations(range(given, len(effects)), 2):
        for start in richer.values():
            if not contains(start, effects[k]):
                continue
            more = len(effects[k].parameters()) + len(effects[other].parameters())
            saved = 0.5 * (more - len(start.parameters())) * math.log(model.fit.size)
            without = _without(model, [other])
            smaller = _without(model, [k, other])
            trial = attempt_at(smaller, replace(start, **effects[k].values()))
            lost = model.fit.value - without.fit.value
            regained = smaller.fit.value + trial.promise - without.fit.value
            if regained < REGAINED * lost:
                continue
            trial = refit(smaller, trial, model)
            if trial.merit > GATE and trial.model.fit.value + saved > model.fit.value:
                return trial.model
    return model


def _without(model: Model, positions: Sequence[int]) -> Model:
    """Return the model without some of its effects, all else as it is."""
    loop, names = model.fitted, model.names
    for position in sorted(positions, reverse=True):
        loop, names = taken_out(loop, position, names)
    fit = carried_over(model, loop, names)
    if not math.isfinite(fit.value):  # with noise as small as that, it cannot follow the record
        fit = begin(fit.problem, fit.theta, None)
    return Model(loop, fit)


def _on_bounds(model: Model) -> set[str]:
    """Return the plant's own parameters that are as far from their given values as is allowed."""
    problem, theta = model.fit.problem, model.fit.theta
    ends = zip(model.names, theta, problem.lower, problem.upper, strict=True)
    return {name for name, v, low, high in ends if "." not in name and v in (low, high)}


def _close(mine: Trial, steps: Sequence[Step]) -> list[Trial]:
    """Return the candidates that came close to an effect in the round that it won.

    Or that one which resembles it won, whose place it took since.
    """
    alike = set(type(mine.effect).look_alikes)
    won = [s for s in steps if s.best is not None and s.best.name == mine.name]
    lost = [s for s in steps if s.best is not None and s.best.name in alike]
    for step in [*won, *lost]:
        assert step.best is not None
        near = [
            t for t in step.trials
            if t.name != mine.name and t.merit > GATE
            and (t.name in alike or t.merit > NEAR * step.best.merit)
        ]  # fmt: skip
        return near[:NEXT]
    return []


def taken_out(
    loop: Loop, position: int, names: Sequence[str]
) -> tuple[Loop, tuple[str, ...]]:  # fmt: skip
    """Return a loop without one of its effects, and the names of what is free then."""
    labels = list(loop.labelled)
    label, less = labels[position], loop.without_effect(labels[position])
    renamed = dict(zip(labels[:position] + labels[position + 1 :], less.labelled, strict=True))
    left = [n for n in names if not n.startswith(f"{label}.")]
    return less, tuple(relabelled(left, renamed))


def cut(model: Model, position: int) -> tuple[Model, Trial]:
    """Return the model without one effect, refitted, and the effect as a trial on top of it."""
    bare = _without(model, [position])
    smaller = replace(bare, fit=spared(climb(bare.fit, rounds=10)))
    effect = model.fitted.effects[position]
    # Put back anew, it would come last; and all else may have gone too far astray without it.
    label = list(model.loop.labelled)[position]
    known = outcome(smaller, Trial(effect, label, model, -math.inf), model.fit)
    if simulable(model):
        return smaller, known
    # Where no simulation can check it, a likelihood may be that of absurd values.
    again = refit(smaller, attempt_at(smaller, effect))
    return smaller, again if again.gain > 0 else known  # below nothing it was stuck


def renoised(model: Model) -> Model:
    """Ask again whether the data want a coloured force, now that an effect is in the model."""
    fit = retuned(polish(model.fit))
    if fit.problem.known is not None:
        return Model(model.loop, fit)
    if fit.noise.drift:
        plain = climb(replace(fit, noise=replace(fit.noise, memory=0.0, drift=0.0)))
        if plain.value > fit.value - math.log(fit.size):
            return Model(model.loop, plain)
        # The force that stood for the effect may be far from the one that is left.
        anew = choose_noise(plain)
        return Model(model.loop, max(fit, anew, key=lambda f: f.value))
    return Model(model.loop, choose_noise(fit))


def without_superfluous(model: Model, given: int) -> Model:
    """Drop effects that the later ones made superfluous."""
    for position in range(given, len(model.loop.effects) - 1):
        if needed(model, position) > SURE * GATE:
            continue
        smaller, trial = cut(model, position)
        if trial.merit <= GATE:
            return without_superfluous(smaller, given)
    return model
