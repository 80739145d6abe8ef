"""What a record tells of an effect's parameters, and what speaks against a fitted effect."""

import math
from collections.abc import Sequence

import numpy as np

from .._base.arrays import Array
from .._base.criterion import bayesian_penalty
from .._base.statistics import pseudo_inverse
from ..effects import AbstractEffect
from ..estimation.likelihood.likelihood import Fit
from .candidates import VANISHES, Objection, Trial
from .fitted_model import Model
from .thresholds import THRESHOLD


def compute_remaining_information(
    matrix: Array, own: Sequence[int], others: Sequence[int]
) -> Array:
    """Return the scaled information of parameters that others leave to them."""
    size = np.sqrt(np.maximum(np.diag(matrix), THRESHOLD.tiny))
    scaled = matrix / np.outer(size, size)
    left = scaled[np.ix_(own, own)]
    if not len(others):
        return np.asarray(left)
    cross = scaled[np.ix_(own, others)]
    inverse = pseudo_inverse(scaled[np.ix_(others, others)], THRESHOLD.seen)
    return np.asarray(left - cross @ inverse @ cross.T)


def find_doubles(fit: Fit, label: str, effect: AbstractEffect) -> dict[str, float]:
    """Return the neutral values of an effect's parameters that do what the model's own do.

    The viscous part of an asymmetric friction is one, beside a viscous friction in the model. What
    has come to a bound of its own can do no more.
    """
    names, matrix, problem = fit.plant.names, fit.normal[0], fit.problem
    moving = (fit.theta > problem.lower) & (fit.theta < problem.upper)
    neutral = {f"{label}.{p.name}": p.neutral for p in effect.parameters()}
    deciding = {n: v for n, v in neutral.items() if n in names and v is not None}
    others = [k for k, n in enumerate(names) if moving[k] and not n.startswith(f"{label}.")]
    if len(deciding) < 2 or not np.isfinite(matrix).all():
        return {}
    found = {}
    for name, value in deciding.items():
        k = names.index(name)
        if (
            matrix[k, k] > 0
            and compute_remaining_information(matrix, [k], others)[0, 0] < THRESHOLD.seen
        ):
            found[name] = value
    return found if len(found) < len(deciding) else {}


def count_own_parameters(trial: Trial, fit: Fit) -> int:
    """Count the parameters of the effect that the record determines."""
    matrix, _ = fit.normal
    own = [k for k, n in enumerate(fit.plant.names) if n.startswith(f"{trial.label}.")]
    left = compute_remaining_information(
        matrix, own, [k for k in range(len(matrix)) if k not in own]
    )
    return max(1, int(np.sum(np.linalg.eigvalsh(left) > THRESHOLD.seen)))


def estimate_need(model: Model, position: int) -> float:
    """Return what a model would lose of log-likelihood without an effect, less its penalty.

    In the quadratic approximation around the fitted values, all other parameters and the size of
    the noise moving along (a coloured force may take up much of it).
    Zero where that says nothing, as for a limit.
    """
    fit, names = model.fit, list(model.names)
    label, effect = list(model.fitted.labelled.items())[position]
    away = {f"{label}.{p.name}": getattr(effect, p.name) - p.neutral
            for p in effect.parameters() if p.neutral is not None}  # fmt: skip
    own = [names.index(n) for n, d in away.items() if n in names and math.isfinite(d)]
    matrix = fit.normal[0]
    if not own or len(own) < len(away) or not np.isfinite(matrix).all():
        return 0.0
    every = [k for k, n in enumerate(names) if n.startswith(f"{label}.")]
    size = np.sqrt(np.maximum(np.diag(matrix), THRESHOLD.tiny))
    left = compute_remaining_information(
        matrix, own, [k for k in range(len(matrix)) if k not in every]
    )
    d = np.array([away[names[k]] for k in own]) * size[own]
    gain = 0.5 * fit.size * math.log1p(float(d @ left @ d) / fit.size)
    return gain - bayesian_penalty(len(every), fit.size)


def find_objection(trial: Trial) -> Objection | None:
    """Return why a fitted effect cannot be what is missing, if so."""
    effect = trial.fitted
    if effect.neutral:
        return VANISHES
    fit, names = trial.model.fit, trial.model.names
    for k, name in enumerate(names):
        if not name.startswith(f"{trial.label}."):
            continue
        low, high = fit.problem.lower[k], fit.problem.upper[k]
        about = next(p for p in effect.parameters() if p.name == name.partition(".")[2])
        on_bound = fit.theta[k] in (low, high)
        if on_bound and (about.searched or about.neutral not in (None, low, high)):
            unit = effect.units(trial.model.loop).get(about.name, "")
            words = f"{about.name} ends on its bound {fit.theta[k]:g} {unit}".rstrip()
            return Objection("on a bound", words)
    words = f"within {THRESHOLD.significant:g} standard errors of its neutral value"
    if _has_unseen_part(trial, effect):
        return Objection("not the simplest", words)
    if _is_insignificant(trial, effect):
        return Objection("insignificant", words)
    if not all(f"{trial.label}.{name}" in names for name in effect.values()):
        # A parameter that is held at its neutral value is another effect's, which excuses this one.
        return None
    doubt = effect.doubt()
    return None if doubt is None else Objection("doubtful", doubt)


def _has_unseen_part(trial: Trial, effect: AbstractEffect) -> bool:
    """Whether a parameter that an effect may go without is not seen."""
    keys = [f"{trial.label}.{p.name}" for p in effect.parameters() if p.optional]
    fit, names = trial.model.fit, trial.model.names
    places = [names.index(key) for key in keys if key in names]
    return any(fit.theta[k] <= THRESHOLD.significant * fit.standard_errors[k] for k in places)


def _is_insignificant(trial: Trial, effect: AbstractEffect) -> bool:
    """Whether every parameter that decides about an effect may as well be neutral."""
    fit, names = trial.model.fit, trial.model.names
    error = fit.standard_errors
    sure = []
    for p in effect.parameters():
        key = f"{trial.label}.{p.name}"
        if p.neutral is None or key not in names:
            continue
        k = names.index(key)
        away = math.inf if math.isinf(p.neutral) else abs(fit.theta[k] - p.neutral)
        sure.append(away > THRESHOLD.significant * error[k] and fit.normal[0][k, k] > 0)
    return not any(sure)
