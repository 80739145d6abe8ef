"""A candidate added to a model, and how effects are related."""

import math
from dataclasses import dataclass, replace

import numpy as np

from ..effects import AbstractEffect
from ..estimation.likelihood.sampled_plant import Trajectory
from .fitted import Model, as_known


@dataclass(frozen=True, eq=False)
class Trial:
    """A candidate added to a model.

    `promise` is the gain of log-likelihood that the first step expects, `gain` what the refit gave,
    `cost` half the Bayesian penalty of its parameters and of what was scanned. `others` are starts
    that promise nearly as much, which only a refit tells apart.
    """

    effect: AbstractEffect
    label: str
    model: Model
    promise: float
    scan: float = 0.0
    gain: float = math.nan
    cost: float = math.nan
    remark: str = ""
    others: tuple[AbstractEffect, ...] = ()

    @property
    def name(self) -> str:
        """The name of the effect; drifts and steps belong to a parameter."""
        return type(self.effect).__name__

    @property
    def price(self) -> float:
        """Half the Bayesian penalty if all its parameters count."""
        size = self.model.fit.size
        return 0.5 * len(self.effect.parameters()) * math.log(size) + self.scan

    @property
    def merit(self) -> float:
        """Gain less penalty; minus infinity for what is out."""
        if self.remark or not math.isfinite(self.gain):
            return -math.inf
        return self.gain - self.cost

    @property
    def fitted(self) -> AbstractEffect:
        """The effect with its fitted parameters."""
        return self.model.fitted.labelled[self.label]


def same_kind(one: AbstractEffect, other: AbstractEffect) -> bool:
    """Whether two effects differ in their values only: of one class, and of one state or name."""
    return type(one) is type(other) and getattr(one, "name", "") == getattr(other, "name", "")


def contains(effect: AbstractEffect, simple: AbstractEffect) -> bool:
    """Whether one effect is another with further parameters, as asymmetric friction is friction."""
    more = set(effect.values()) > set(simple.values())
    return more and type(simple).__name__ in effect.look_alikes


def comparable(trial: Trial) -> Trial:
    """Return a trial with what a comparison of likelihoods needs, without what a refit would."""
    fit, none = trial.model.fit, np.zeros((0, 0))
    nowhere = Trajectory(none, none, none)
    bare = tuple(
        replace(out, trajectory=nowhere, slopes=none, disturbance=none) for out in fit.filtered
    )
    slim = as_known(fit, replace(fit, linearized=(), filtered=bare))
    return replace(trial, model=replace(trial.model, fit=slim))
