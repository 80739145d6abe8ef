"""Which candidates a record can tell apart, and what earns its place."""

import itertools
import math
from collections.abc import Sequence

import numpy as np

from ..effects import AbstractEffect, PositionRipple
from ..physics.equations import Array
from .fitted import log_terms
from .trial import Trial, contains, same_kind

GATE = 5.0  # gain of log-likelihood less penalty: 10 in units of the Bayesian criterion
CLOSE = 3.0  # difference of log-likelihood that says nothing
HINT = 1.0  # of log-likelihood, that a larger model gains by chance in one record of ten
SAME = 4.0  # spread of a likelihood ratio: two models that differ by less are nested
Z = 2.0  # standard deviations of Vuong's test
DOUBT = 0.6  # of the best merit: where something is left, a look-alike with more is not excluded
SMALL = 0.2  # of the size of an effect: a further parameter that is no larger is no other effect
MANY = 4  # effects at once: such a list describes almost any error, and explains none
SOME = 3  # effects at once, of which none may be slight
SLIGHT = 0.02  # of the largest gain: what corrects so little of it corrects a wrong law, perhaps
RESIDUE = 0.1  # of what all explain: two look-alikes that both add less are one thing, perhaps
BLOCK = 50  # samples whose terms are summed before their spread is taken


def doubt_of_all(effects: Sequence[AbstractEffect], gains: Sequence[float], total: float) -> str:
    """Say why effects that explain a record together may yet be no explanation.

    Parameters
    ----------
    effects : sequence of effects
        Those that were found.
    gains : sequence of float
        What each gains of log-likelihood beside the others.
    total : float
        What they gain together.

    Returns
    -------
    str
        The reason, empty if there is none.
    """
    if len(effects) >= MANY:
        return "so many effects at once describe almost any error, and prove little"
    if sum(isinstance(e, PositionRipple) for e in effects) > 1:
        return "several ripples together describe any curve over the position, and prove little"
    if len(effects) >= SOME and min(gains) < SLIGHT * max(gains):
        return "the smallest of so many effects may only correct what a larger one gets wrong"
    for one, other in itertools.combinations(range(len(effects)), 2):
        alone = max(gains[one], gains[other]) < RESIDUE * total
        if alone and _alike(effects[one], effects[other]):
            names = [type(effects[k]).__name__ for k in (one, other)]
            return (f"{names[0]} and {names[1]} resemble each other, and either alone explains "
                    "nearly all of it: one effect of another kind may be behind both")  # fmt: skip
    return ""


def _alike(one: AbstractEffect, other: AbstractEffect) -> bool:
    """Whether one of two effects is known to resemble the other."""
    names = type(one).__name__, type(other).__name__
    return names[1] in type(one).look_alikes or names[0] in type(other).look_alikes


def vuong(best: Array, other: Array, penalty: float) -> float:
    r"""Return Vuong's statistic of two models on the same samples.

    .. math:: z = \frac{\sum_k d_k - \Delta}{\sqrt{\sum_b (D_b - \bar D)^2}}, \quad
        d_k = \ell_k^{best} - \ell_k^{other}

    with sums D over blocks, so that neighbours may be correlated.

    Parameters
    ----------
    best, other : ndarray, shape (n,)
        Terms of the log-likelihood.
    penalty : float
        What the better model pays more for its parameters.

    Returns
    -------
    float
        Large: the better one is really better.

    References
    ----------
    Vuong, Econometrica 57 (1989) 307-333.
    """
    d = best - other
    spread = _spread(d)
    return float((d.sum() - penalty) / max(spread, 1e-12))


def _spread(d: Array) -> float:
    """Return the standard deviation of a sum whose terms may be correlated with neighbours."""
    n = len(d) // BLOCK * BLOCK
    sums = d[:n].reshape(-1, BLOCK).sum(axis=1) if n else d
    return math.sqrt(float(np.sum((sums - sums.mean()) ** 2)))


def _beyond(trial: Trial, simple: Trial) -> float:
    """Return how large what an effect has beyond a simpler one may be, over what both have.

    NaN where the two have nothing of one unit.
    """
    names = trial.model.names
    errors = trial.model.fit.standard_errors
    units = {p.name: p.unit for p in trial.effect.parameters() if p.neutral is not None}
    shared, values, shares = simple.fitted.values(), trial.fitted.values(), []
    for k in units.keys() - shared.keys():
        size = max((abs(v) for i, v in shared.items() if units.get(i) == units[k]), default=0.0)
        key = f"{trial.label}.{k}"
        if key in names and size > 0:
            shares.append((abs(values[k]) + Z * errors[names.index(key)]) / size)
    return max(shares, default=math.nan)


def rivals(best: Trial, others: Sequence[Trial], sure: bool = True) -> tuple[Trial, ...]:
    """Return the candidates that the record cannot tell apart from the best, best first.

    Parameters
    ----------
    best : Trial
        The refitted winner.
    others : sequence of Trial
        Refitted candidates, on the same samples and beside the same other effects.
    sure : bool, optional
        Whether what all of them leave is noise; if not, a difference of likelihood may come from
        what is still missing.

    Returns
    -------
    tuple of Trial
        Those within 3 units of log-likelihood, or not rejected by Vuong's test at z = 2; unless
        `sure`, also what is known to resemble the best and gains nearly as much.
    """
    mine = log_terms(best.model.fit)
    found = []
    for trial in others:
        if same_kind(trial.effect, best.effect) or trial.merit <= GATE:
            continue
        lost = best.merit - trial.merit
        theirs = log_terms(trial.model.fit)
        # A larger model that predicts the same contains the best one, and pays for nothing; but one
        # that gains more may be right (a Stribeck curve hardly told from dry friction), and one
        # whose further part may be large, for all the record says, cannot be excluded.
        alike = trial.name in type(best.effect).look_alikes
        nothing = trial.gain < best.gain + CLOSE and _spread(mine - theirs) < SAME
        if trial.cost > best.cost and nothing:
            larger = contains(trial.effect, best.effect)
            share = _beyond(trial, best) if larger else math.nan
            hinted = alike and trial.gain > best.gain + HINT and not share <= SMALL
            if share > SMALL or hinted:
                found.append(trial)
            continue
        z = vuong(mine, theirs, best.cost - trial.cost)
        doubtful = not sure and alike and trial.merit > DOUBT * best.merit
        if lost < CLOSE or z < Z or doubtful:
            found.append(trial)
    found.sort(key=lambda t: -t.merit)
    # One that was begun at several places is one.
    return tuple(
        t for k, t in enumerate(found) if not any(same_kind(t.effect, b.effect) for b in found[:k])
    )
