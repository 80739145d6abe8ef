"""Steps 5 and 7: where among the effects of its place an effect acts."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from ..effects.composition import label_effects, order_effects
from ..estimation.likelihood.maximization import maximize
from ..loop.loop import Loop
from .candidates import Trial, attempt_trial
from .fitted_model import Model, carry_over_fit, drop_arrays, drop_linearization
from .refitting import weigh_refit
from .screening import compute_score
from .thresholds import THRESHOLD


def order_trial(base: Model, trial: Trial, given: int) -> Trial:
    """Return a refitted candidate where it fits best among the effects that were found before.

    Parameters
    ----------
    base : Model
        The model without it.
    trial : Trial
        The refitted candidate.
    given : int
        Effects that the base had from the beginning, whose order is known.

    Returns
    -------
    Trial
        As it is, or at another position.
    """
    if not trial.net_gain > 0:
        return trial
    return attempt_trial(lambda: _weigh_order(base, trial, given), trial)


def _weigh_order(base: Model, trial: Trial, given: int) -> Trial:
    """Return the trial of `order_trial`, where nothing fails."""
    model = order_effect(trial.model, trial.position, given)
    if model is trial.model:
        return trial
    return weigh_refit(base, replace(trial, model=model), drop_linearization(model.fit))


def screen_orders(base: Model, trial: Trial) -> Trial:
    """Return a screened candidate where among the effects of its place it promises most.

    Behind a dead zone a narrow backlash may promise nothing, and ahead of it be what is missing.

    Parameters
    ----------
    base : Model
        The model without it.
    trial : Trial
        The screened candidate, the last effect of its model.

    Returns
    -------
    Trial
        As it is, or at another position where it promises more by more than 3 units.
    """
    if trial.out is not None or not trial.model.loop.effects[-1].ordered:
        return trial
    best, at = trial, len(trial.model.loop.effects) - 1
    for k in _list_other_positions(trial.model, at, 0):
        loop, labels = _reorder_loop(trial.model, at, k)
        fit = carry_over_fit(base, loop, rename_labels(trial.model.names, labels))
        score = compute_score(base, fit)
        if score > max(best.score, trial.score + THRESHOLD.close):
            there = Model(loop, drop_arrays(fit))
            best = replace(trial, label=labels[trial.label], model=there, score=score)
    return best


def order_effect(model: Model, at: int, given: int) -> Model:
    """Return the model with one of its effects nearer to the plant or further off, if that fits.

    What is found last was found second, which says nothing of where it acts: a valve may have its
    dead zone before the offset or behind it, or before a backlash, and in the wrong order both end
    beside their values.

    Parameters
    ----------
    model : Model
        The model to which an effect was added.
    at : int
        The position of this effect.
    given : int
        Effects that it had from the beginning, whose order is known.

    Returns
    -------
    Model
        The order that is likelier by more than 3 units, or the model as it is.
    """
    best = model
    for k in _list_other_positions(model, at, given):
        tried = _move_effect(model, at, k)
        if math.isfinite(tried.fit.value):
            tried = replace(
                tried, fit=maximize(tried.fit, rounds=THRESHOLD.removal_rounds, exact=False)
            )
        best = max(best, tried, key=lambda m: m.fit.value)
    return best if best.fit.value > model.fit.value + THRESHOLD.close else model


def _move_effect(model: Model, at: int, position: int) -> Model:
    """Return the model with an effect at another position among the effects, all else as is.

    The likelihood is minus infinity if the filter cannot follow the record then.
    """
    loop, labels = _reorder_loop(model, at, position)
    return Model(loop, carry_over_fit(model, loop, rename_labels(model.names, labels)))


def _reorder_loop(model: Model, at: int, position: int) -> tuple[Loop, dict[str, str]]:
    """Return the fitted loop with an effect at another position, and the new labels of all."""
    fitted = model.fitted
    order = _list_places(at, position, len(fitted.effects))
    labels = list(fitted.labelled)
    loop = replace(fitted, effects=tuple(fitted.effects[k] for k in order), free=())
    renamed = dict(zip([labels[k] for k in order], loop.labelled, strict=True))
    return replace(loop, free=tuple(n for n in fitted.free if "." not in n)), renamed


def _list_other_positions(model: Model, at: int, given: int) -> list[int]:
    """Return positions from `given` on at which signals pass an effect in another order.

    None for an effect that has no order.
    """
    count = len(model.loop.effects)
    if not model.loop.effects[at].ordered:
        return []
    seen, found = {_find_order(model, range(count))}, []
    for k in range(given, count):
        order = _find_order(model, _list_places(at, k, count))
        if order not in seen:
            seen.add(order)
            found.append(k)
    return found


def _list_places(at: int, position: int, count: int) -> list[int]:
    """Return places of effects, of which one has come to another position."""
    others = [k for k in range(count) if k != at]
    return [*others[:position], at, *others[position:]]


def _find_order(model: Model, places: Sequence[int]) -> tuple[int, ...]:
    """Return places of a model's effects as signals pass them, if the loop has them in an order."""
    labelled = label_effects(tuple(model.loop.effects[k] for k in places))
    found = dict(zip(labelled, places, strict=True))
    return tuple(found[label] for label, _ in order_effects(labelled))


def rename_labels(names: Sequence[str], labels: Mapping[str, str]) -> list[str]:
    """Return names of parameters with the new labels of their effects."""
    parts = [name.partition(".") for name in names]
    return [f"{labels.get(head, head)}.{tail}" if dot else head for head, dot, tail in parts]
