"""The search for missing effects: screen, refit, decide, add, drop, and again."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..data import Record
from ..effects import AbstractEffect, SensorOffset
from ..errors import CtrlidError
from ..likelihood import Fit, climb, polish
from ..linearization import state_matrices
from ..loop import Loop
from ..loop_fit import choose_noise
from .decide import CLOSE, GATE, MANY, rivals
from .omnibus import ALPHA, Omnibus, omnibus
from .replica import (
    DOUBTFUL,
    KINKED,
    TWICE,
    artefact,
    forgiven,
    kinked,
    more_than_simple,
    replica,
    simulable,
)
from .scan import scanned
from .trial import (
    Model,
    Trial,
    anchor,
    attempt_at,
    contains,
    needed,
    promised,
    reduced,
    refit,
    same_kind,
    spared,
    whole,
)

NEXT = 5  # candidates after the best that are looked at closely
TOP = 5  # candidates refitted because of what they promise
SHARE = 0.2  # of the best promise: what promises more is refitted as well
NEARLY = 0.8  # of the best merit: what comes so close may be the better half of a pair
FORESEEN = 2  # of them
NEAR = 0.5  # of the winner's merit: what came so close is asked again when all effects are in
MINOR = 0.15  # of the whole gain: less, beside something unknown, is a stand-in
OFFSETS = (SensorOffset,)
LITTLE = 0.1  # of what known noise does not explain: less, beside so much, is a stand-in
SURE = 100.0  # times the gate: an effect so significant is not asked whether it is needed
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
    base: Model
    position: int  # among the effects of the final loop


@dataclass(frozen=True, eq=False)
class Search:
    """The end of a search: the base, the rounds, the final model and its effects.

    `turned` says whether the choice of a round was taken back for a better pair.
    """

    base: Model
    steps: tuple[Step, ...]
    final: Model
    found: tuple[Found, ...]
    before: Omnibus
    after: Omnibus
    turned: bool = False


def candidates(
    catalogue: Sequence[type[AbstractEffect]], loop: Any, record: Record
) -> list[AbstractEffect]:
    """Return every effect of a catalogue that a plant can have, at its start."""
    found: list[AbstractEffect] = []
    for kind in catalogue:
        if kind.place == "output" and kind in OFFSETS and not _place_matters(loop):
            continue  # the initial position, of which nobody knows where it is counted from
        found += kind.candidates(loop, record)
    return found


def check_catalogue(catalogue: Sequence[type[AbstractEffect]]) -> None:
    """Refuse what is no class of effects, with what is needed."""
    kinds = catalogue if isinstance(catalogue, Sequence) else [catalogue]
    for kind in kinds:
        if isinstance(catalogue, str) or not (
            isinstance(kind, type) and issubclass(kind, AbstractEffect)
        ):
            raise CtrlidError("catalogue= is a list of classes of effects, such as "
                              f"ctrlid.effects.CATALOGUE; given {kind!r}")  # fmt: skip
    if kinds is not catalogue:
        raise CtrlidError("catalogue= is a list of classes of effects; put the one given into "
                          f"brackets: [{catalogue!r}]")  # fmt: skip


def _place_matters(loop: Loop) -> bool:
    """Whether the plant moves differently when its output is shifted."""
    a, _, c, _ = state_matrices(loop.equations(), loop.point, spread=1e6)
    return bool(np.any(np.abs(a[:, np.flatnonzero(c[0])]).sum(axis=0) > 0))


def one_round(
    base: Model, pool: Sequence[AbstractEffect], work: Work, other: Model | None = None
) -> Step:
    """Screen all candidates, refit the promising, and return the best that earns its place.

    They are added to the base, and to the `other` model in its place if one is given.
    """
    tried: list[Trial] = work(lambda effect: scanned(base, effect), pool)
    if other is not None:
        # What the model alone would regain from there is no merit of a candidate.
        lost = other.fit.value - base.fit.value
        lost -= max(0.0, lost + promised(other.fit))
        more: list[Trial] = work(lambda effect: scanned(other, effect), pool)
        more = [replace(t, promise=t.promise + lost) for t in more]
        pairs = zip(tried, more, strict=True)
        tried = [a if a.promise > 0 or a.promise >= b.promise else b for a, b in pairs]
        tried += [b for b in more if b.promise > 0]
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
    trials = _simplest(base, _checked(base, trials))
    plain = _plainer(base, trials[0], trials[1:])
    if plain is not trials[0]:
        trials = [plain, *(t for t in trials if not same_kind(t.effect, plain.effect))]
    best = trials[0]
    return Step(base, tuple(trials), best if best.merit > GATE else None)


def _plainer(base: Model, best: Trial, others: Sequence[Trial]) -> Trial:
    """Return an effect that the best one contains, if it does as well when it starts from there."""
    for t in others:
        if not best.merit > 0 or not contains(best.effect, t.effect):
            continue
        values = best.fitted.values()
        start = replace(t.effect, **{k: values[k] for k in t.effect.values()})
        again = refit(base, attempt_at(base, start, t.scan), best.model)
        if again.merit >= best.merit:
            return again
    return best


def _simplest(base: Model, trials: list[Trial]) -> list[Trial]:
    """Put out a winner whose further parameters gain from the filter's approximations only."""
    best = trials[0]
    for simple in trials[1:NEXT]:
        fewer = len(simple.effect.parameters()) < len(best.effect.parameters())
        if not fewer or simple.merit <= GATE or not simulable(base):
            continue
        if best.gain - simple.gain > 0.1 * best.gain or simple.name not in best.effect.look_alikes:
            continue
        if not more_than_simple(base, best, simple):
            out = replace(best, remark=f"{simple.name} explains as much with fewer parameters")
            return sorted([out, *trials[1:]], key=lambda t: (-t.merit, -t.promise))
    return trials


def _checked(base: Model, trials: list[Trial]) -> list[Trial]:
    """Put out what gains as much on records in which it is known not to be."""
    copies: list[Model | None] = []
    for _ in range(NEXT):
        trials.sort(key=lambda t: (-t.merit, -t.promise))
        best = trials[0]
        sure = best.gain > DOUBTFUL and not base.loop.effects
        if best.merit <= GATE or sure or not simulable(base):
            break
        copies = copies or [replica(base, seed) for seed in range(2 if kinked(base) else 1)]
        if best.merit - TWICE * artefact(copies, best) > GATE:
            break
        trials[0] = replace(
            best, remark="gains as much on a simulated record in which it is known not to be"
        )
    return trials


def search(
    base: Model, catalogue: Sequence[type[AbstractEffect]], work: Work,
    tell: Callable[[str], None], look_back: bool = True,
) -> Search:  # fmt: skip
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
    look_back : bool, optional
        Whether the choice of a round may be taken back when the next one is known.

    Returns
    -------
    Search
        The rounds and the final model.
    """
    record = base.fit.problem.tracks[0].record
    given = len(base.loop.effects)
    model = base
    steps: list[Step] = []
    before, changed, turned = omnibus(base.fit), False, False

    def grown(best: Trial) -> Model:
        return whole(_without_superfluous(_renoised(best.model), given))

    while len(model.loop.effects) - given < MANY and len(steps) < MANY + 2:
        tell(f"round {len(steps) + 1}: screening")
        pool = [c for c in candidates(catalogue, model.fitted, record) if not _there(model, c)]
        step = one_round(model, pool, work, None if steps else anchor(base))
        if step.best is not None and step.best.gain < LITTLE * excess(model.fit):
            step = replace(step, best=None)
        asked = look_back and steps and step.best and not changed
        other = _foreseen(steps[-1], step, catalogue, work) if asked else None
        if other is not None:
            changed = turned = True
            steps[-1] = replace(steps[-1], best=other)
            model = grown(other)
            continue
        changed = False
        steps.append(replace(step, base=Model(model.loop, spared(model.fit))))
        if step.best is None:
            break
        tell(f"round {len(steps)}: {step.best.name}")
        model = grown(step.best)
    model, found = _settled(model, given, steps, work)
    return Search(base, tuple(steps), model, found, before, _judged(model), turned)


def _foreseen(
    last: Step, step: Step, catalogue: Sequence[type[AbstractEffect]], work: Work
) -> Trial | None:  # fmt: skip
    """Return what would have been the better choice of the last round, now that more is found.

    Where two effects hide together, the one that alone gains most may be a mixture of both. So each
    effect of its kind that did nearly as well is asked what could follow on it; the best pair wins.
    """
    assert last.best is not None
    assert step.best is not None
    best = last.best
    near = [t for t in last.trials[1:NEXT] if _nearly(t, best)][:FORESEEN]
    record = last.base.fit.problem.tracks[0].record
    pairs: list[tuple[float, int]] = []
    for k, trial in enumerate(near):
        model = whole(trial.model)
        pool = [c for c in candidates(catalogue, model.fitted, record) if not _there(model, c)]
        tried: list[Trial] = work(lambda effect, model=model: scanned(model, effect), pool)
        tried = sorted(tried, key=lambda t: t.price - t.promise)[:2]
        done = work(lambda t, model=model: refit(model, t), tried)
        pairs.append((trial.merit + max((t.merit for t in done), default=-math.inf), k))
    total, k = max(pairs, default=(-math.inf, 0))
    return near[k] if total > best.merit + step.best.merit + GATE else None


def _nearly(trial: Trial, best: Trial) -> bool:
    """Whether a candidate did nearly as well as one that resembles it, and not the same."""
    mine, its = ({t.name, *type(t.effect).look_alikes} for t in (best, trial))
    return bool(mine & its) and NEARLY * best.merit < trial.merit < best.merit - CLOSE


def excess(fit: Fit) -> float:
    """Return the log-likelihood above that of noise which is known; zero where none is known."""
    if fit.problem.known is None:
        return 0.0
    z = np.concatenate(fit.standardized)
    return max(0.0, 0.5 * float(np.nansum(z**2 - 1)))


def _judged(model: Model) -> Omnibus:
    """Return the tests of what a model leaves, without the alarms of the filter itself."""
    after = omnibus(model.fit)
    if not after.passed and simulable(model):
        copies = [replica(model, seed) for seed in (1, 2)]
        after = forgiven(after, copies, KINKED if kinked(model) else ALPHA)
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
    complete = found.after.passed and len(found.found) < MANY
    if complete or len(found.found) < 2:
        return found
    model, left = found.final, list(found.found)
    for f in sorted(found.found, key=lambda f: -f.position):
        if f.trial.gain >= MINOR * total or helps(f, found.final):
            continue
        model = _taken_out(model, f.position)[0]
        left = [replace(k, position=k.position - (k.position > f.position))
                for k in left if k.trial is not f.trial]  # fmt: skip
    if len(left) == len(found.found):
        return found
    return replace(found, final=model, found=tuple(left), after=_judged(model))


def _there(model: Model, effect: AbstractEffect) -> bool:
    """Whether the model has this effect already; there may be several vibrations."""
    waves = {"frequency", "period"} & set(effect.values())
    return not waves and any(same_kind(e, effect) for e in model.loop.effects)


def _renoised(model: Model) -> Model:
    """Ask again whether the data want a coloured force, now that an effect is in the model."""
    fit = polish(model.fit)
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


def _without_superfluous(model: Model, given: int) -> Model:
    """Drop effects that the later ones made superfluous."""
    for position in range(given, len(model.loop.effects) - 1):
        if needed(model, position) > SURE * GATE:
            continue
        smaller, trial = _taken_out(model, position)
        if trial.merit <= GATE:
            return _without_superfluous(smaller, given)
    return model


def taken_out(
    loop: Loop, position: int, names: Sequence[str]
) -> tuple[Loop, tuple[str, ...]]:  # fmt: skip
    """Return a loop without one of its effects, and the names of what is free then."""
    labels = list(loop.labelled)
    label, less = labels[position], loop.without_effect(labels[position])
    renamed = dict(zip(labels[:position] + labels[position + 1 :], less.labelled, strict=True))
    left = [n for n in names if not n.startswith(f"{label}.")]
    return less, tuple(_relabelled(left, renamed))


def _taken_out(model: Model, position: int) -> tuple[Model, Trial]:
    """Return the model without one effect, refitted, and the effect as a trial on top of it."""
    effect = model.fitted.effects[position]
    loop, names = taken_out(model.fitted, position, model.names)
    smaller = Model(loop, spared(climb(reduced(model, loop, names), rounds=10)))
    return smaller, refit(smaller, attempt_at(smaller, effect))


def _settled(
    model: Model, given: int, steps: Sequence[Step], work: Work
) -> tuple[Model, tuple[Found, ...]]:
    """Ask for each effect what else could stand in its place, all others being in the model."""
    first = steps[0] if steps else None
    if len(model.loop.effects) == given:
        return model, ()
    assert first is not None
    sure = omnibus(model.fit).passed
    if len(model.loop.effects) == given + 1 and first.best is not None and len(steps) <= 2:
        best = first.best
        if bool(best.model.fit.noise.drift) == bool(model.fit.noise.drift):
            return model, (Found(best, rivals(best, first.trials, sure), first.base, given),)
    found: list[Found] = []
    for position in range(given, len(model.loop.effects)):
        smaller, mine = _taken_out(model, position)
        if mine.merit <= GATE:
            return _settled(_renoised(smaller), given, steps, work)
        there = {type(e).__name__ for e in smaller.loop.effects}
        rest = [t for t in _close(mine, steps) if t.name not in there]
        again = work(lambda t, smaller=smaller: refit(smaller, attempt_at(smaller, t.fitted)), rest)
        best = max([mine, *again], key=lambda t: t.merit)
        if best.merit <= mine.merit + 1.0:
            best = mine
        best = _plainer(smaller, best, [mine, *again])
        if best is not mine:
            model = _moved(best.model, position)
        close = rivals(best, [t for t in [mine, *again] if t is not best], sure)
        found.append(Found(best, close, smaller, position))
    found.sort(key=lambda f: -f.trial.gain)
    return model, tuple(found)


def _moved(model: Model, position: int) -> Model:
    """Return the model with its last effect at another position among the effects."""
    fitted = model.fitted
    order = [*range(position), len(fitted.effects) - 1, *range(position, len(fitted.effects) - 1)]
    labels = list(fitted.labelled)
    loop = replace(fitted, effects=tuple(fitted.effects[k] for k in order), free=())
    renamed = dict(zip([labels[k] for k in order], loop.labelled, strict=True))
    loop = replace(loop, free=tuple(n for n in fitted.free if "." not in n))
    names = _relabelled(model.names, renamed)
    return Model(loop, climb(reduced(model, loop, names), rounds=4))


def _relabelled(names: Sequence[str], labels: Mapping[str, str]) -> list[str]:
    """Return names of parameters with the new labels of their effects."""
    parts = [name.partition(".") for name in names]
    return [f"{labels.get(head, head)}.{tail}" if dot else head for head, dot, tail in parts]


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
        return near[:NEXT]
    return []
