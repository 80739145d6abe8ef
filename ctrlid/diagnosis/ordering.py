"""In which order effects at one place act: an offset moves a dead zone that it comes after."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from ..estimation.likelihood.maximization import climb
from .carrying import carried_over
from .decide import CLOSE
from .fitted import Model

ORDERED = ("input", "output")  # places with a signal through them; forces and laws only add up


def reordered(model: Model, given: int) -> Model:
    """Return the model with its last effect nearer to the plant, if it fits better there.

    What is found last was found second, which says nothing of where it acts: a valve may have its
    dead zone before the offset or behind it, and in the wrong order both end beside their values.

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
    if last.place not in ORDERED:
        return model
    best = model
    for k in range(given, len(others)):
        if others[k].stage != last.stage:
            continue
        tried = moved(model, k)
        if math.isfinite(tried.fit.value):
            tried = replace(tried, fit=climb(tried.fit, rounds=10, exact=False))
        best = max(best, tried, key=lambda m: m.fit.value)
    return best if best.fit.value > model.fit.value + CLOSE else model


def moved(model: Model, position: int) -> Model:
    """Return the model with its last effect at another position among the effects, all else as is.

    The likelihood is minus infinity if the filter cannot follow the record then.
    """
    fitted = model.fitted
    last = len(fitted.effects) - 1
    order = [*range(position), last, *range(position, last)]
    labels = list(fitted.labelled)
    loop = replace(fitted, effects=tuple(fitted.effects[k] for k in order), free=())
    renamed = dict(zip([labels[k] for k in order], loop.labelled, strict=True))
    loop = replace(loop, free=tuple(n for n in fitted.free if "." not in n))
    names = relabelled(model.names, renamed)
    return Model(loop, carried_over(model, loop, names))


def relabelled(names: Sequence[str], labels: Mapping[str, str]) -> list[str]:
    """Return names of parameters with the new labels of their effects."""
    parts = [name.partition(".") for name in names]
    return [f"{labels.get(head, head)}.{tail}" if dot else head for head, dot, tail in parts]
