"""Step 4: the score of a candidate, which is the gain that its first step expects."""

import math
from collections.abc import Sequence
from dataclasses import replace

from .._base.errors import EffectDoesNotApply, ModelCannotRun
from ..effects import AbstractEffect
from ..estimation.likelihood.likelihood import Fit, evaluate_likelihood
from ..estimation.likelihood.maximization import compute_expected_gain
from .candidates import Objection, Trial
from .fitted_model import Model, carry_over_fit, drop_arrays
from .information import find_doubles
from .thresholds import THRESHOLD


def screen_candidate(base: Model, effect: AbstractEffect, scan_penalty: float = 0.0) -> Trial:
    """Add an effect, as it is or nearer to nothing, and ask what a first step would gain.

    An effect that may be faint is tried faint, since far from there its score is zero. The
    arguments are those of `screen_at`.
    """
    best = screen_at(base, effect, scan_penalty)
    for _ in range(THRESHOLD.fainter_tries):
        if effect.neutral or best.score > 0:
            break
        fainter = _make_fainter(best.effect)
        if fainter is None:
            break
        best = max(best, screen_at(base, fainter, scan_penalty), key=lambda t: t.score)
    return best


def _make_fainter(effect: AbstractEffect) -> AbstractEffect | None:
    """Return an effect with a tenth of its size; None where that has no meaning."""
    sizes = {
        p.name: p.neutral + THRESHOLD.fainter * (getattr(effect, p.name) - p.neutral)
        for p in effect.parameters()
        if p.neutral is not None and math.isfinite(p.neutral)
    }
    return replace(effect, **sizes) if sizes else None


def screen_at(base: Model, effect: AbstractEffect, scan_penalty: float = 0.0) -> Trial:
    """Add an effect as it is to a model and ask what the first step would gain.

    Parameters
    ----------
    base : Model
        The fitted model.
    effect : AbstractEffect
        The candidate at its start.
    scan_penalty : float, optional
        Logarithm of the number of places at which it was looked for before.

    Returns
    -------
    Trial
        With `score`; `out` if the filter cannot follow the record with it.
    """
    try:
        loop = base.fitted.with_effect(effect)
    except EffectDoesNotApply as reason:
        return Trial(effect, "", base, -math.inf, scan_penalty, out=Objection.of(reason))
    label = next(k for k in loop.labelled if k not in base.loop.labelled)
    own = [f"{label}.{k}" for k, v in effect.values().items() if math.isfinite(v)]
    names = (*base.names, *own)
    try:
        fit = carry_over_fit(base, loop, names)
        doubled = find_doubles(fit, label, effect)
        if doubled:
            loop = loop.with_parameters(doubled)
            names = tuple(n for n in names if n not in doubled)
            fit = carry_over_fit(base, loop, names)
    except (ModelCannotRun, EffectDoesNotApply) as reason:
        return Trial(effect, label, base, -math.inf, scan_penalty, out=Objection.of(reason))
    model = Model(loop, fit)
    if not math.isfinite(fit.value):
        lost = Objection("cannot run", "cannot follow the record")
        return Trial(effect, label, model, -math.inf, scan_penalty, out=lost)
    there = Model(loop, drop_arrays(fit))
    return Trial(effect, label, there, compute_score(base, fit), scan_penalty)


def compute_score(base: Model, fit: Fit) -> float:
    """Return what a larger model gains and its first step expects to; minus infinity if it is lost.

    Parameters
    ----------
    base : Model
        The fitted model.
    fit : Fit
        The model with a candidate, at its start.
    """
    if not math.isfinite(fit.value):
        return -math.inf
    return fit.value - base.fit.value + compute_expected_gain(fit)


def screen_starts(base: Model, effects: Sequence[AbstractEffect], scan_penalty: float) -> Trial:
    """Try effects that differ in their values only, and return the one with the largest score."""
    best = screen_at(base, effects[0], scan_penalty)
    if best.out is not None:
        return best
    label, loop, names = best.label, best.model.loop, best.model.names
    start = carry_over_fit(base, loop, names)
    for effect in effects[1:]:
        theta = start.theta.copy()
        for field, value in effect.values().items():
            # A parameter that the model's own parameters duplicate is not free.
            if f"{label}.{field}" in names:
                theta[names.index(f"{label}.{field}")] = value
        fit = start
        # The second pass linearizes along the states that the first one found.
        for _ in range(2):
            fit = evaluate_likelihood(start.problem, theta, start.noise, fit.trajectories)
        score = compute_score(base, fit)
        if score > best.score:
            there = loop.with_parameters(dict(zip(names, theta.tolist(), strict=True)))
            best = Trial(effect, label, Model(there, drop_arrays(fit)), score, scan_penalty)
    return best
