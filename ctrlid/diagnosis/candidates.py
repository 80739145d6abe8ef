"""What may be missing: the candidates of a catalogue, and one of them added to a model."""

import contextlib
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np

from .._base.criterion import bayesian_penalty
from .._base.errors import CtrlidError, EffectDoesNotApply, ModelCannotRun
from .._base.text import write_list
from ..data.record import Record, hold_readings
from ..data.validity import find_last_valid
from ..effects import AbstractEffect
from ..effects.base import name_at_place
from ..estimation.likelihood.sampled_plant import Trajectory
from .fitted_model import Model, keep_information
from .places import list_placed_candidates, needs_place
from .thresholds import THRESHOLD

# A map that may run in parallel: ``work(function, items)``.
Work = Callable[[Callable[..., Any], Iterable[Any]], list[Any]]
Ground = Literal[
    "does not apply", "cannot run", "not seen", "vanishes", "on a bound", "insignificant",
    "doubtful", "artefact", "not the simplest",
]  # fmt: skip


@dataclass(frozen=True)
class Objection:
    """What puts a candidate out: the ground, and the words of the ranking, which decide nothing."""

    ground: Ground
    words: str

    @classmethod
    def of(cls, refusal: EffectDoesNotApply | ModelCannotRun) -> Self:
        """Return the objection that a refusal is."""
        unfit = isinstance(refusal, EffectDoesNotApply)
        return cls("does not apply" if unfit else "cannot run", str(refusal))

    @classmethod
    def of_failure(cls, failure: Exception) -> Self:
        """Return the objection that a failure of the arithmetic is."""
        return cls("cannot run", f"the arithmetic fails with it: {failure}")


# A decomposition that does not converge, and a function of the equations that CasADi gives up.
NUMERICAL_FAILURES = (np.linalg.LinAlgError, SystemError)
VANISHES = Objection("vanishes", "the refit ends at the neutral value")


@dataclass(frozen=True, eq=False)
class Trial:
    """A candidate added to a model.

    `score` is the gain of log-likelihood that the first step expects, `gain` what the refit gave,
    `penalty` half the Bayesian penalty of its parameters and of what was scanned, `out` what puts
    it out. `others` are starts with nearly the same score, which only a refit tells apart.
    """

    effect: AbstractEffect
    label: str
    model: Model
    score: float
    scan_penalty: float = 0.0
    gain: float = math.nan
    penalty: float = math.nan
    out: Objection | None = None
    others: tuple[AbstractEffect, ...] = ()

    @property
    def name(self) -> str:
        """The name of the effect; drifts and steps belong to a parameter."""
        return type(self.effect).__name__

    @property
    def key(self) -> str:
        """The name, with the place on a plant that has several."""
        return name_at_place(self.effect)

    def resembles(self, other: "Trial") -> bool:
        """Whether another one is known to have this for a look-alike, at a place of its own kind.

        On a plant with several signals it then acts at the same place.
        """
        return self.name in type(other.effect).look_alikes and (
            self.effect.place != other.effect.place or self.effect.at == other.effect.at
        )

    @property
    def full_penalty(self) -> float:
        """Half the Bayesian penalty if all its parameters count."""
        size = self.model.fit.size
        return bayesian_penalty(len(self.effect.values()), size) + self.scan_penalty

    @property
    def net_gain(self) -> float:
        """Gain less penalty; minus infinity for what is out."""
        if self.out is not None or not math.isfinite(self.gain):
            return -math.inf
        return self.gain - self.penalty

    @property
    def position(self) -> int:
        """Where it is among the effects of its model, in their order."""
        return list(self.model.loop.labelled).index(self.label)

    @property
    def fitted(self) -> AbstractEffect:
        """The effect with its fitted parameters."""
        return self.model.fitted.labelled[self.label]


def attempt_trial(attempt: Callable[[], Trial], otherwise: Trial) -> Trial:
    """Return what an attempt gives; where it fails, another trial that says why it is out.

    An effect may be impossible at a place, as at a frequency outside its bounds, its model may lose
    the record, and arithmetic may fail with it: a candidate that fails, fails alone.
    """
    try:
        return attempt()
    except (ModelCannotRun, EffectDoesNotApply) as reason:
        return replace(otherwise, out=Objection.of(reason))
    # A decomposition that does not converge, and a function of the equations that CasADi gives up.
    except NUMERICAL_FAILURES as reason:
        return replace(otherwise, out=Objection.of_failure(reason))


def is_same_kind(one: AbstractEffect, other: AbstractEffect) -> bool:
    """Whether two effects differ in their values only: of one class, and of one state or name."""
    return (
        type(one) is type(other)
        and getattr(one, "name", "") == getattr(other, "name", "")
        and one.at == other.at
    )


def borrow_size(trial: Trial, best: Trial) -> AbstractEffect | None:
    """Return an effect of the size of one that it resembles; None if it does not, or has another.

    A lag is as long as the lag that stands for it, while its own start may be on the wrong side of
    a hill: a long lag of the actuator looks like none at all beside the parameters as they are.
    """
    mine, theirs = ([p for p in t.effect.parameters() if p.neutral is not None]
                    for t in (trial, best))  # fmt: skip
    alike = len(mine) == len(theirs) == 1 and mine[0].unit == theirs[0].unit != ""
    if not (alike and trial.resembles(best)):
        return None
    with contextlib.suppress(EffectDoesNotApply):
        return replace(trial.effect, **{mine[0].name: getattr(best.fitted, theirs[0].name)})
    return None


def has_same_penalty(one: Trial, other: Trial) -> bool:
    """Whether two effects pay as much, but for the rounding of what was counted on the way."""
    return math.isclose(one.penalty, other.penalty, rel_tol=THRESHOLD.rounding)


def contains(effect: AbstractEffect, simple: AbstractEffect) -> bool:
    """Whether one effect is another with further parameters, as asymmetric friction is friction."""
    more = set(effect.values()) > set(simple.values())
    return more and type(simple).__name__ in effect.look_alikes and effect.at == simple.at


def keep_for_comparison(trial: Trial) -> Trial:
    """Return a trial with what a comparison of likelihoods needs, without what a refit would."""
    fit, none = trial.model.fit, np.zeros((0, 0))
    nowhere = Trajectory(none, none, none)
    bare = tuple(
        replace(out, trajectory=nowhere, slopes=none, disturbance=none) for out in fit.filtered
    )
    slim = keep_information(fit, replace(fit, linearized=(), filtered=bare))
    return replace(trial, model=replace(trial.model, fit=slim))


def list_candidates(
    catalogue: Sequence[type[AbstractEffect]], loop: Any, record: Record
) -> list[AbstractEffect]:
    """Return every effect of a catalogue that a plant can have, at its start."""
    # What a sample holds that does not count must not set a range.
    record = _hold_last_valid(record)
    found: list[AbstractEffect] = []
    for kind in catalogue:
        if needs_place(loop, kind):
            found += list_placed_candidates(kind, loop, record)
        else:
            found += kind.candidates(loop, record)
    return found


def _hold_last_valid(record: Record) -> Record:
    """Return a record in which what does not count repeats the last value that does."""
    if record.valid.all():
        return record
    u = np.asarray(record.u)[..., find_last_valid(record.valid_somewhere)]
    return replace(hold_readings(record), u=u)


def check_catalogue(catalogue: Sequence[type[AbstractEffect]]) -> None:
    """Refuse what is no class of effects, with what is needed."""
    several = isinstance(catalogue, Sequence) and not isinstance(catalogue, str)
    kinds = catalogue if several else [catalogue]
    for kind in kinds:
        if not (isinstance(kind, type) and issubclass(kind, AbstractEffect)):
            raise CtrlidError("catalogue= is a list of classes of effects, such as "
                              f"ctrlid.effects.CATALOGUE; given {kind!r}")  # fmt: skip
        own = kind.__mro__[: kind.__mro__.index(AbstractEffect)]
        proposes = any("candidates" in vars(base) for base in own)
        undecided = [] if proposes else kind.list_undecided()
        if undecided:
            raise CtrlidError(f"the effect {kind.__name__} would never be tried: nothing says from "
                              f"which value of {write_list(undecided)} a fit starts. Give a "
                              "neutral value or a default, or write the class method "
                              "candidates(cls, loop, record)")  # fmt: skip
    if kinds is not catalogue:
        raise CtrlidError("catalogue= is a list of classes of effects; put the one given into "
                          f"brackets: [{catalogue!r}]")  # fmt: skip


def list_missing_candidates(
    model: Model, catalogue: Sequence[type[AbstractEffect]]
) -> list[AbstractEffect]:
    """Return the candidates that a model does not have yet."""
    record = model.records[0]
    return [
        c for c in list_candidates(catalogue, model.fitted, record) if not _has_effect(model, c)
    ]


def _has_effect(model: Model, effect: AbstractEffect) -> bool:
    """Whether the model has this effect already, alone or in a larger one, and only once."""
    if effect.repeatable:
        return False
    return any(is_same_kind(e, effect) or contains(e, effect) for e in model.loop.effects)
