"""Steps 5 and 7: where among the effects of its place an effect acts."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from ..effects.composition import label_effects, order_effects
from ..estimation.likelihood.maximization import maximize
from .candidates import Trial, attempt_trial
from .fitted_model import Model, carry_over_fit, drop_linearization
from .refitting import weigh_refit
from .thresholds import THRESHOLD


def order_trial(base: Model, trial: Trial, given: int) -> Trial:
    """Return a refitted candidate where it fits best among the effects that were found before.

    Parameters
    ----------
    base : Model
        The model without it.
    trial : Trial
        The refitted candidate, the last effect of its model.
    given : int
        Effects that the base had from the beginning, whose order is known.

    Returns
    -------
    Trial
        As it is, or nearer to the plant.
    """
    if not trial.net_gain > 0:
        return trial
    return attempt_trial(lambda: _weigh_order(base, trial, given), trial)


def _weigh_order(base: Model, trial: Trial, given: int) -> Trial:
    """Return the trial of `order_trial`, where nothing fails."""
    model = order_last_effect(trial.model, given)
    if model is trial.model:
        return trial
    return weigh_refit(base, replace(trial, model=model), drop_linearization(model.fit))


def order_last_effect(model: Model, given: int) -> Model:
    """Return the model with its last effect nearer to the plant, if it fits better there.

    What is found last was found second, which says nothing of where it acts: a valve may have its
    dead zone before the offset or behind it, or before a backlash, and in the wrong order both end
    beside their values.

    Parameters
    ----------
    model : Model
        The model to which an effect was added last.
    given : int
        Effects that it had from the beginning, whose order is known.

    Returns
    -------
    Model
        The order that is likelier by more than 3 units, or the model as it is.
    """
    *others, last = model.fitted.effects
    if not last.ordered:
        return model
    best, count = model, len(others) + 1
    seen = {_find_order(model, range(count))}
    for k in range(given, len(others)):
        order = _find_order(model, _move_last(k, count))
        if order in seen:
            continue
        seen.add(order)
        tried = move_last_effect(model, k)
        if math.isfinite(tried.fit.value):
            tried = replace(
                tried, fit=maximize(tried.fit, rounds=THRESHOLD.removal_rounds, exact=False)
            )
        best = max(best, tried, key=lambda m: m.fit.value)
    return best if best.fit.value > model.fit.value + THRESHOLD.close else model


def move_last_effect(model: Model, position: int) -> Model:
    """Return the model with its last effect at another position among the effects, all else as is.

    The likelihood is minus infinity if the filter cannot follow the record then.
    """
    fitted = model.fitted
    order = _move_last(position, len(fitted.effects))
    labels = list(fitted.labelled)
    loop = replace(fitted, effects=tuple(fitted.effects[k] for k in order), free=())
    renamed = dict(zip([labels[k] for k in order], loop.labelled, strict=True))
    loop = replace(loop, free=tuple(n for n in fitted.free if "." not in n))
    names = rename_labels(model.names, renamed)
    return Model(loop, carry_over_fit(model, loop, names))


def _move_last(position: int, count: int) -> list[int]:
    """Return places of effects, of which the last one has come to another position."""
    return [*range(position), count - 1, *range(position, count - 1)]


def _find_order(model: Model, places: Sequence[int]) -> tuple[int, ...]:
    """Return places of a model's effects as signals pass them, if the loop has them in an order."""
    labelled = label_effects(tuple(model.loop.effects[k] for k in places))
    found = dict(zip(labelled, places, strict=True))
    return tuple(found[label] for label, _ in order_effects(labelled))


def rename_labels(names: Sequence[str], labels: Mapping[str, str]) -> list[str]:
    """Return names of parameters with the new labels of their effects."""
    parts = [name.partition(".") for name in names]
    return [f"{labels.get(head, head)}.{tail}" if dot else head for head, dot, tail in parts]
