"""Trying an effect: what it promises, and what it gives when everything is refitted."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..data import Record
from ..effects import AbstractEffect
from ..errors import CtrlidError
from ..filtering import Noise, first_guess
from ..likelihood import Fit, evaluate, relinearized
from ..loop import Loop
from ..loop_fit import bounds_of, choose_noise, make_problem, start_values
from ..machine import Machine, Trajectory
from ..maximum import begin, bounded_step, climb, retuned
from ..noise_search import known_from_repeats
from ..physics import Array
from ..stepping import comes_to_rest
from ..tracks import retracked

SCREEN_ROUNDS = 14  # of a refit: a candidate that needs more is not the missing effect
QUIET = 1e-4  # of the variance of a random force, with which kinks are sharp
AWAY = 0.3  # of a given value: a recalibration beyond is doubted
FAR = 10.0  # times its given value: no recalibration goes further
FAINTER = 3  # times that an effect which promises nothing is tried at a tenth of its size
SIGNIFICANT = 2.0  # standard errors that a fitted effect must at least be large
SEEN = 1e-7  # share of a parameter's information that others must leave to it


@dataclass(frozen=True, eq=False)
class Model:
    """A loop fitted to the records, the base that candidates are added to.

    One that was fitted by another criterion, and without the data that it is compared on, has
    standard `errors` of its own.
    """

    loop: Loop
    fit: Fit
    errors: Mapping[str, float] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters that were fitted."""
        return self.fit.problem.machine.names

    @property
    def fitted(self) -> Loop:
        """The loop with the fitted values."""
        values = dict(zip(self.names, self.fit.theta.tolist(), strict=True))
        return self.loop.with_parameters(values)


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


def simulable(model: Model) -> bool:
    """Whether the records can be simulated with this model."""
    loop = model.loop
    if loop.controller is None:
        return comes_to_rest(loop)
    return all(t.record.r is not None for t in model.fit.problem.tracks)


def same_kind(one: AbstractEffect, other: AbstractEffect) -> bool:
    """Whether two effects differ in their values only: of one class, and of one state or name."""
    return type(one) is type(other) and getattr(one, "name", "") == getattr(other, "name", "")


def base_model(
    loop: Loop, records: Sequence[Record], names: Sequence[str], begins: Sequence[float] = ()
) -> Model:
    """Fit the model as it is, with the noise that the data want."""
    problem = make_problem(loop, names, records, begins)
    lower, upper = _near(loop, names, problem.lower, problem.upper)
    problem = replace(problem, lower=lower, upper=upper)
    fit = retuned(climb(begin(problem, start_values(loop, names), None)))
    return Model(loop, choose_noise(fit))


def weighted_by_repeats(base: Model, periods: Sequence[int]) -> Model:
    """Return the model fitted with the noise that differs between repeats.

    A noise that is fitted to what a model leaves takes part of a missing effect for noise.
    """
    problem = replace(base.fit.problem, known=known_from_repeats(base.fit, periods))
    return Model(base.loop, climb(begin(problem, base.fit.theta, None), exact=False))


def anchor(base: Model) -> Model | None:
    """Return the model at its given values if recalibration has led far away from them.

    Where much is missing, the likelihood of the model alone may be largest at absurd values; the
    missing effect shows at the given ones.
    """
    given = start_values(base.loop, base.names)
    size = np.maximum(np.abs(given), 1e-300)
    if not np.any(np.abs(base.fit.theta - given) > AWAY * size):
        return None
    try:
        fit = begin(base.fit.problem, given, None)
    except CtrlidError:
        return None
    return Model(base.loop, fit) if math.isfinite(fit.value) else None


def _near(loop: Loop, names: Sequence[str], lower: Array, upper: Array) -> tuple[Array, Array]:
    """Narrow the bounds of the plant's parameters: a model ten times off is another model."""
    lower, upper = lower.copy(), upper.copy()
    for k, (name, value) in enumerate(zip(names, start_values(loop, names), strict=True)):
        if "." not in name and value:
            ends = sorted((value / FAR, value * FAR))
            lower[k], upper[k] = max(lower[k], ends[0]), min(upper[k], ends[1])
    return lower, upper


def attempt(base: Model, effect: AbstractEffect, scan: float = 0.0) -> Trial:
    """Add an effect, as it is or nearer to nothing, and ask what a first step would gain.

    An effect that is faint is tried faint: far from there the first step promises nothing. The
    arguments are those of `attempt_at`.
    """
    best = attempt_at(base, effect, scan)
    for _ in range(FAINTER):
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
        fit = _extended(base, loop, names)
    except CtrlidError as reason:
        return Trial(effect, label, base, -math.inf, scan, remark=str(reason))
    doubled = _doubled(fit, label, effect)
    if doubled:
        loop = loop.with_parameters(doubled)
        names = tuple(n for n in names if n not in doubled)
        fit = _extended(base, loop, names)
    model = Model(loop, fit)
    if not math.isfinite(fit.value):
        return Trial(effect, label, model, -math.inf, scan, remark="cannot follow the record")
    promise = fit.value - base.fit.value + promised(fit)
    return Trial(effect, label, Model(loop, light(fit)), promise, scan)


def _doubled(fit: Fit, label: str, effect: AbstractEffect) -> dict[str, float]:
    """Return the neutral values of an effect's parameters that do what the model's own do.

    The viscous part of an asymmetric friction is one, beside a viscous friction in the model.
    """
    names, matrix = fit.problem.machine.names, fit.normal[0]
    neutral = {f"{label}.{p.name}": p.neutral for p in effect.parameters()}
    deciding = {n: v for n, v in neutral.items() if n in names and v is not None}
    others = [k for k, n in enumerate(names) if not n.startswith(f"{label}.")]
    if len(deciding) < 2 or not np.isfinite(matrix).all():
        return {}
    found = {}
    for name, value in deciding.items():
        k = names.index(name)
        if matrix[k, k] > 0 and _left(matrix, [k], others)[0, 0] < SEEN:
            found[name] = value
    return found if len(found) < len(deciding) else {}


def _left(matrix: Array, own: Sequence[int], others: Sequence[int]) -> Array:
    """Return the scaled information of parameters that others leave to them."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix / np.outer(size, size)
    left = scaled[np.ix_(own, own)]
    if not len(others):
        return np.asarray(left)
    cross = scaled[np.ix_(own, others)]
    inverse = np.linalg.pinv(scaled[np.ix_(others, others)], rcond=SEEN)
    return np.asarray(left - cross @ inverse @ cross.T)


def contains(effect: AbstractEffect, simple: AbstractEffect) -> bool:
    """Whether one effect is another with further parameters, as asymmetric friction is friction."""
    more = set(effect.values()) > set(simple.values())
    return more and type(simple).__name__ in effect.look_alikes


def attempt_best(base: Model, effects: Sequence[AbstractEffect], scan: float) -> Trial:
    """Try effects that differ in their values only, and return the one that promises most."""
    best = attempt_at(base, effects[0], scan)
    if best.remark:
        return best
    label, loop, names = best.label, best.model.loop, best.model.names
    start = _extended(base, loop, names)
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


def light(fit: Fit) -> Fit:
    """Return a fit without its arrays: many candidates on a long record must fit into memory."""
    return _as_known(fit, replace(fit, linearized=(), filtered=()))


def spared(fit: Fit) -> Fit:
    """Return a fit without the plant along its trajectory, four fifths of its memory.

    Whatever climbs on from it linearizes anew.
    """
    return _as_known(fit, replace(fit, linearized=()))


def comparable(trial: Trial) -> Trial:
    """Return a trial with what a comparison of likelihoods needs, without what a refit would."""
    fit, none = trial.model.fit, np.zeros((0, 0))
    nowhere = Trajectory(none, none, none)
    bare = tuple(
        replace(out, trajectory=nowhere, slopes=none, disturbance=none) for out in fit.filtered
    )
    slim = _as_known(fit, replace(fit, linearized=(), filtered=bare))
    return replace(trial, model=replace(trial.model, fit=slim))


def _as_known(fit: Fit, bare: Fit) -> Fit:
    """Return a fit that lost its arrays with what had been computed from them."""
    bare.__dict__["normal"] = fit.normal
    return bare


def whole(model: Model) -> Model:
    """Return a model whose fit has the plant along its trajectory."""
    return model if model.fit.linearized else replace(model, fit=relinearized(model.fit))


def promised(fit: Fit) -> float:
    """Return the gain that a Gauss-Newton step within the bounds expects."""
    matrix, score = fit.normal
    return 0.5 * float(score @ bounded_step(fit, matrix, score)[0])


def _extended(base: Model, loop: Loop, names: Sequence[str]) -> Fit:
    """Return the likelihood of a larger model at its start, along the base's trajectory."""
    old = base.fit.problem
    m = Machine(loop, names, old.machine.hold, old.machine.law is not None)
    tracks = tuple(retracked(track, loop) for track in old.tracks)
    at = [
        _carried(old.machine, m, out.trajectory, first_guess(m, track))
        for out, track in zip(base.fit.filtered, tracks, strict=True)
    ]
    lower, upper = bounds_of(loop, names)
    for k, name in enumerate(names):
        if name in base.names:
            i = base.names.index(name)
            lower[k], upper[k] = old.lower[i], old.upper[i]
    longest = max(len(t.record) for t in tracks) * loop.dt
    for k, name in enumerate(names):
        if name.endswith(".frequency"):  # what samples show: below Nyquist's, above one period
            lower[k], upper[k] = max(lower[k], 1.0 / longest), min(upper[k], 0.4 / loop.dt)
        if name.endswith(".damping"):
            upper[k] = min(upper[k], 1.0)
        if name.endswith(".period") and m.e.velocities:  # what repeats has to repeat
            way = max(float(np.ptp(a.filtered[:, m.position])) for a in at)
            upper[k] = max(min(upper[k], way), lower[k])
        if name.endswith(".vs"):  # of the speeds that there are
            fastest = max(_speed(m, a) for a in at)
            lower[k], upper[k] = max(lower[k], 1e-3 * fastest), min(upper[k], 3.0 * fastest)
    problem = replace(old, machine=m, tracks=tracks, lower=lower, upper=upper)
    theta = np.clip(start_values(loop, names), lower, upper)
    fit = evaluate(problem, theta, base.fit.noise, at)
    if math.isfinite(fit.value) and m.n > old.machine.n:
        fit = evaluate(problem, theta, base.fit.noise, [o.trajectory for o in fit.filtered])
    return fit


def _speed(m: Machine, at: Trajectory) -> float:
    """Return the largest usual speed along a trajectory."""
    fastest = [float(np.quantile(np.abs(at.filtered[:, j]), 0.99)) for j in m.e.velocities]
    return max(fastest, default=1.0) or 1.0


def _carried(old: Machine, new: Machine, known: Trajectory, guess: Trajectory) -> Trajectory:
    """Take states that both have from the old trajectory, and guess the others."""
    mine = list(new.e.states)
    columns = [(mine.index(s), k) for k, s in enumerate(old.e.states) if s in mine]
    if new.size - new.n == old.size - old.n:  # a delay keeps a known circuit from being followed
        columns += [(new.n + k, old.n + k) for k in range(old.size - old.n)]
    result = []
    for start, theirs in ((guess.predicted, known.predicted), (guess.filtered, known.filtered),
                         (guess.spread, known.spread)):  # fmt: skip
        mixed = start.copy()
        for i, k in columns:
            mixed[:, i] = theirs[:, k]
        result.append(mixed)
    return Trajectory(*result)


def refit(base: Model, trial: Trial, near: Model | None = None) -> Trial:
    """Refit a candidate together with the model and its noise.

    Parameters
    ----------
    base : Model
        The model without it.
    trial : Trial
        The candidate at its start.
    near : Model, optional
        A model from whose values and noise to start in place of those of `base`.

    Returns
    -------
    Trial
        With gain and cost, or with a remark that puts it out.
    """
    if trial.remark:
        return trial
    loop, names = trial.model.loop, trial.model.names
    if near is not None:
        known = dict(zip(near.names, near.fit.theta.tolist(), strict=True))
        loop = loop.with_parameters({n: known[n] for n in names if n in known})
    try:
        start = _extended(near or base, loop, names)
        starts = [start]
        if start.noise.drift and start.problem.known is None and simulable(base):
            # A random force that was fitted while the effect was missing may never let it in.
            # (Where no simulation can check it, the likelihood also leads to absurd values.)
            starts.append(replace(start, noise=replace(start.noise, memory=0.0, drift=0.0)))
        fits = [spared(climb(s, rounds=SCREEN_ROUNDS, exact=False)) for s in starts]
        fit = max(fits, key=lambda f: f.value)
    except CtrlidError as reason:
        return replace(trial, remark=str(reason))
    model = Model(trial.model.loop, fit)
    own = _own_parameters(trial, fit)
    cost = 0.5 * own * math.log(fit.size) + trial.scan
    done = replace(trial, model=model, gain=fit.value - base.fit.value, cost=cost)
    try:
        done = replace(done, remark=_objection(done))
    except CtrlidError as reason:  # values that do not go together, such as crossed limits
        return replace(trial, remark=str(reason))
    return done if done.merit > 0 else replace(done, model=Model(model.loop, light(fit)))


def _own_parameters(trial: Trial, fit: Fit) -> int:
    """Count the parameters of the effect that the record determines."""
    matrix, _ = fit.normal
    own = [k for k, n in enumerate(fit.problem.machine.names) if n.startswith(f"{trial.label}.")]
    left = _left(matrix, own, [k for k in range(len(matrix)) if k not in own])
    return max(1, int(np.sum(np.linalg.eigvalsh(left) > SEEN)))


def quiet(model: Model) -> Model:
    """Return a model with hardly any random force, to begin a fit with; known noise is kept."""
    noise = model.fit.noise
    if model.fit.problem.known is not None:
        return model
    force = tuple(QUIET * v for v in noise.force)
    return replace(model, fit=replace(model.fit, noise=Noise(force)))


def _objection(trial: Trial) -> str:
    """Say why a fitted effect cannot be what is missing, if so."""
    effect = trial.fitted
    if effect.neutral:
        return "vanishes when refitted"
    fit, names = trial.model.fit, trial.model.names
    for k, name in enumerate(names):
        if not name.startswith(f"{trial.label}."):
            continue
        low, high = fit.problem.lower[k], fit.problem.upper[k]
        about = next(p for p in effect.parameters() if p.name == name.partition(".")[2])
        on_bound = fit.theta[k] in (low, high)
        scanned = about.name in ("frequency", "period")
        if on_bound and (scanned or about.neutral not in (None, low, high)):
            return f"{about.name} ends on its bound {fit.theta[k]:g}"
    if _insignificant(trial, effect):
        return "no larger than its uncertainty"
    every = all(f"{trial.label}.{p.name}" in names for p in effect.parameters())
    return effect.doubt() if every else ""  # what is held still, another effect has


def needed(model: Model, position: int) -> float:
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
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    left = _left(matrix, own, [k for k in range(len(matrix)) if k not in every])
    d = np.array([away[names[k]] for k in own]) * size[own]
    gain = 0.5 * fit.size * math.log1p(float(d @ left @ d) / fit.size)
    return gain - 0.5 * len(every) * math.log(fit.size)


def _insignificant(trial: Trial, effect: AbstractEffect) -> bool:
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
        sure.append(away > SIGNIFICANT * error[k] and fit.normal[0][k, k] > 0)
    return not any(sure)


def log_terms(fit: Fit) -> Array:
    """Return each sample's share of the log-likelihood, records one after the other."""
    parts: list[Any] = []
    for out, keep, r in zip(fit.filtered, fit.problem.counts, fit.sensor, strict=True):
        s = out.variance[keep] * r
        parts.append(-0.5 * (np.log(2 * np.pi * s) + out.innovations[keep] ** 2 / s))
    return np.concatenate(parts)


def reduced(model: Model, loop: Loop, names: Sequence[str]) -> Fit:
    """Return the likelihood of a smaller model at the larger one's values."""
    return _extended(model, loop, names)
