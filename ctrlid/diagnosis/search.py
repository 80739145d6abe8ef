"""The search for missing effects: screen, refit, decide, add, drop, and again."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..data import Record
from ..effects import AbstractEffect
from ..errors import CtrlidError
from ..likelihood import climb, polish
from ..loop_fit import choose_noise
from .decide import GATE, rivals
from .omnibus import Omnibus, omnibus
from .scan import scanned
from .trial import Model, Trial, attempt, reduced, refit

MOST = 5  # effects in one record
TOP = 5  # candidates refitted because of what they promise
SHARE = 0.2  # of the best promise: what promises more is refitted as well
NEAR = 0.5  # of the winner's merit: what came so close is asked again when all effects are in
FAINT = 0.5  # of what would earn a place: a fainter promise is not worth a refit

Work = Callable[[Callable[..., Any], Iterable[Any]], list[Any]]


@dataclass(frozen=True, eq=False)
class Step:
    """One round: the model it started from, what was tried, and what won."""

    base: Model
    trials: tuple[Trial, ...]
    best: Trial | None


@dataclass(frozen=True, eq=False)
class Found:
    """An effect that earned its place, and what cannot be told apart from it."""

    trial: Trial
    rivals: tuple[Trial, ...]
    base: Model | None = None


@dataclass(frozen=True, eq=False)
class Search:
    """The end of a search: the base, the rounds, the final model and its effects."""

    base: Model
    steps: tuple[Step, ...]
    final: Model
    found: tuple[Found, ...]
    before: Omnibus
    after: Omnibus


def candidates(
    catalogue: Sequence[type[AbstractEffect]], loop: Any, record: Record
) -> list[AbstractEffect]:
    """Return every effect of a catalogue that a plant can have, at its start."""
    found: list[AbstractEffect] = []
    for kind in catalogue:
        if not (isinstance(kind, type) and issubclass(kind, AbstractEffect)):
            raise CtrlidError("catalogue= holds classes of effects, such as those of "
                              f"ctrlid.effects.CATALOGUE; given {kind!r}")  # fmt: skip
        found += kind.candidates(loop, record)
    return found


def one_round(base: Model, pool: Sequence[AbstractEffect], work: Work) -> Step:
    """Screen all candidates, refit the promising, and return the best that earns its place."""
    tried: list[Trial] = work(lambda effect: scanned(base, effect), pool)
    tried.sort(key=lambda t: -t.promise)
    leader = tried[0] if tried else None
    if leader is None or not math.isfinite(leader.promise):
        return Step(base, tuple(tried), None)
    wanted = {t.name for t in tried[:TOP]} | set(type(leader.effect).look_alikes)
    chosen = [
        t
        for t in tried
        if t.promise > FAINT * (GATE + t.price)
        and (t.name in wanted or t.promise > SHARE * leader.promise)
    ]
    done = {id(t): r for t, r in zip(chosen, work(lambda t: refit(base, t), chosen), strict=True)}
    trials = [done.get(id(t), t) for t in tried]
    best = max(trials, key=lambda t: t.merit)
    alike = set(type(best.effect).look_alikes) if math.isfinite(best.merit) else set()
    late = [t for t in tried if id(t) not in done and t.name in alike and t.promise > -math.inf]
    done |= {id(t): r for t, r in zip(late, work(lambda t: refit(base, t), late), strict=True)}
    trials = [done.get(id(t), t) for t in tried]
    trials.sort(key=lambda t: (-t.merit, -t.promise))
    best = trials[0]
    return Step(base, tuple(trials), best if best.merit > GATE else None)


def search(base: Model, catalogue: Sequence[type[AbstractEffect]], work: Work,
           tell: Callable[[str], None]) -> Search:  # fmt: skip
    """Add effects to a base model until nothing more earns a place.

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

    Returns
    -------
    Search
        The rounds and the final model.
    """
    record = base.fit.problem.tracks[0].record
    model, steps, kept = base, [], []
    before = omnibus(base.fit)
    while len(kept) < MOST:
        tell(f"round {len(steps) + 1}: screening")
        pool = [c for c in candidates(catalogue, model.fitted, record) if not _there(model, c)]
        step = one_round(model, pool, work)
        steps.append(step)
        if step.best is None:
            break
        tell(f"round {len(steps)}: {step.best.name}")
        kept.append(step.best.label)
        model = _renoised(step.best.model)
        model, kept = _without_superfluous(model, kept)
        if len(steps) > MOST + 2:
            break
    model, found = _settled(model, kept, steps, work)
    return Search(base, tuple(steps), model, found, before, omnibus(model.fit))


def _there(model: Model, effect: AbstractEffect) -> bool:
    """Whether the model has this effect already; there may be several vibrations."""
    waves = {"frequency", "period"} & set(effect.values())
    return not waves and any(
        type(e) is type(effect) and getattr(e, "name", "") == getattr(effect, "name", "")
        for e in model.loop.effects
    )


def _renoised(model: Model) -> Model:
    """Ask again whether the data want a coloured force, now that an effect is in the model."""
    fit = polish(model.fit, np.ones(len(model.fit.theta), dtype=bool))
    if fit.noise.drift:
        plain = climb(replace(fit, noise=replace(fit.noise, memory=0.0, drift=0.0)))
        if plain.value > fit.value - math.log(fit.size):
            return Model(model.loop, plain)
        return Model(model.loop, fit)
    return Model(model.loop, choose_noise(fit))


def _without_superfluous(model: Model, kept: list[str]) -> tuple[Model, list[str]]:
    """Drop effects that the later ones made superfluous."""
    for label in kept[:-1]:
        smaller, trial = _taken_out(model, label)
        if trial.merit <= GATE:
            return _without_superfluous(smaller, [k for k in kept if k != label])
    return model, kept


def _taken_out(model: Model, label: str) -> tuple[Model, Trial]:
    """Return the model without one effect, refitted, and the effect as a trial on top of it."""
    fitted = model.fitted
    effect = fitted.labelled[label]
    names = [n for n in model.names if not n.startswith(f"{label}.")]
    loop = fitted.without_effect(label)
    labels = dict(zip([k for k in fitted.labelled if k != label], loop.labelled, strict=True))
    renamed = []
    for name in names:
        head, dot, tail = name.partition(".")
        renamed.append(f"{labels.get(head, head)}{dot}{tail}")
    fit = climb(reduced(model, loop, renamed), rounds=10)
    smaller = Model(loop, fit)
    return smaller, refit(smaller, attempt(smaller, effect))


def _settled(
    model: Model, kept: Sequence[str], steps: Sequence[Step], work: Work
) -> tuple[Model, tuple[Found, ...]]:
    """Ask for each effect what else could stand in its place, all others being in the model."""
    if len(kept) == 1 and len(steps) <= 2:
        first = steps[0]
        assert first.best is not None
        same = bool(first.best.model.fit.noise.drift) == bool(model.fit.noise.drift)
        if same:
            best = first.best
            return model, (Found(best, rivals(best, first.trials), first.base),)
    found: list[Found] = []
    for label in list(kept):
        effect = model.fitted.labelled.get(label)
        if effect is None:
            continue
        smaller, mine = _taken_out(model, label)
        there = {type(e).__name__ for e in smaller.loop.effects}
        rest = [t for t in _close(mine, steps) if t.name not in there]
        again = work(lambda t, smaller=smaller: refit(smaller, attempt(smaller, t.fitted)), rest)
        best = max([mine, *again], key=lambda t: t.merit)
        if best.merit <= mine.merit + 1.0:
            best = mine
        else:
            model = best.model
        close = rivals(best, [t for t in [mine, *again] if t is not best])
        found.append(Found(best, close, smaller))
    found.sort(key=lambda f: -f.trial.gain)
    return model, tuple(found)


def _close(mine: Trial, steps: Sequence[Step]) -> list[Trial]:
    """Return the candidates that came close to an effect in the round that it won."""
    alike = set(type(mine.effect).look_alikes)
    for step in steps:
        if step.best is None or step.best.name != mine.name:
            continue
        near = [
            t for t in step.trials
            if t.name != mine.name and t.merit > GATE
            and (t.name in alike or t.merit > NEAR * step.best.merit)
        ]  # fmt: skip
        return near[:MOST]
    return []
