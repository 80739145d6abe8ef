"""Step 4: what a candidate promises, by the score test."""

import math
from collections.abc import Sequence
from dataclasses import replace

from .._base.errors import CtrlidError
from ..effects import AbstractEffect
from ..estimation.likelihood.likelihood import evaluate
from ..estimation.likelihood.maximization import promised
from .candidates import Trial
from .fitted_model import Model, carried_over, light
from .information import doubled_by
from .thresholds import THRESHOLD


def attempt(base: Model, effect: AbstractEffect, scan: float = 0.0) -> Trial:
    """Add an effect, as it is or nearer to nothing, and ask what a first step would gain.

    An effect that is faint is tried faint: far from there the first step promises nothing. The
    arguments are those of `attempt_at`.
    """
    best = attempt_at(base, effect, scan)
    for _ in range(THRESHOLD.fainter_tries):
        if effect.neutral or best.promise > 0:
            break
        fainter = _fainter(best.effect)
        if fainter is None:
            break
        best = max(best, attempt_at(base, fainter, scan), key=lambda t: t.promise)
    return best


def _fainter(effect: AbstractEffect) -> AbstractEffect | None:
    """Return an effect with a tenth of its size; None where that has no meaning."""
    sizes = {
        p.name: p.neutral + 0.1 * (getattr(effect, p.name) - p.neutral)
        for p in effect.parameters()
        if p.neutral is not None and math.isfinite(p.neutral)
    }
    return replace(effect, **sizes) if sizes else None


def attempt_at(base: Model, effect: AbstractEffect, scan: float = 0.0) -> Trial:
    """Add an effect as it is to a model and ask what the first step would gain.

    Parameters
    ----------
    base : Model
        The fitted model.
    effect : AbstractEffect
        The candidate at its start.
    scan : float, optional
        Logarithm of the number of places at which it was looked for before.

    Returns
    -------
    Trial
        With `promise`; a `remark` if the filter cannot follow the record with it.
    """
    try:
        loop = base.fitted.with_effect(effect)
    except CtrlidError as reason:
        return Trial(effect, "", base, -math.inf, scan, remark=str(reason))
    label = next(k for k in loop.labelled if k not in base.loop.labelled)
    own = [f"{label}.{k}" for k, v in effect.values().items() if math.isfinite(v)]
    names = (*base.names, *own)
    try:
        fit = carried_over(base, loop, names)
    except CtrlidError as reason:
        return Trial(effect, label, base, -math.inf, scan, remark=str(reason))
    doubled = doubled_by(fit, label, effect)
    if doubled:
        loop = loop.with_parameters(doubled)
        names = tuple(n for n in names if n not in doubled)
        fit = carried_over(base, loop, names)
    model = Model(loop, fit)
    if not math.isfinite(fit.value):
        return Trial(effect, label, model, -math.inf, scan, remark="cannot follow the record")
    promise = fit.value - base.fit.value + promised(fit)
    return Trial(effect, label, Model(loop, light(fit)), promise, scan)


def attempt_best(base: Model, effects: Sequence[AbstractEffect], scan: float) -> Trial:
    """Try effects that differ in their values only, and return the one that promises most."""
    best = attempt_at(base, effects[0], scan)
    if best.remark:
        return best
    label, loop, names = best.label, best.model.loop, best.model.names
    start = carried_over(base, loop, names)
    for effect in effects[1:]:
        theta = start.theta.copy()
        for field, value in effect.values().items():
            if f"{label}.{field}" in names:  # and not one that the model's own double
                theta[names.index(f"{label}.{field}")] = value
        fit = start
        for _ in range(2):  # the second time along its own states
            fit = evaluate(start.problem, theta, start.noise, [o.trajectory for o in fit.filtered])
        if not math.isfinite(fit.value):
            continue
        promise = fit.value - base.fit.value + promised(fit)
        if promise > best.promise:
            moved = loop.with_parameters(dict(zip(names, theta.tolist(), strict=True)))
            best = Trial(effect, label, Model(moved, light(fit)), promise, scan)
    return best
