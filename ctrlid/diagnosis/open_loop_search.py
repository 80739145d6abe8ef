"""Missing effects looked for by the error of an open-loop simulation.

A filter that may blame a random force for everything leaves nothing to be named. A stable plant can
do without: simulated from its own initial state, what it lacks shows in full.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .._base.arrays import Array
from .._base.criterion import bayesian_penalty
from .._base.errors import EffectDoesNotApply, ModelCannotRun
from ..effects import AbstractEffect
from ..estimation.likelihood.likelihood import list_start_values
from .candidates import VANISHES, Objection, Trial, is_same_kind, list_candidates
from .fitted_model import Model
from .fresh_data import FreshData
from .growth import Search
from .noise_tests import run_noise_tests
from .open_loop_fit import Simulated, Simulation, make_fit
from .removal import Weighed, take_out_effect
from .scans import find_strongest_line
from .selection import Round
from .thresholds import THRESHOLD


@dataclass(frozen=True, eq=False)
class Tried:
    """An effect added to a simulated loop."""

    effect: AbstractEffect
    label: str
    score: float
    task: Simulation
    theta: Array
    x0: Array
    found: Simulated | None = None
    gain: float = math.nan
    penalty: float = math.nan
    out: Objection | None = None

    @property
    def net_gain(self) -> float:
        """Gain less penalty; minus infinity for what is out."""
        if self.out is not None or not math.isfinite(self.gain):
            return -math.inf
        return self.gain - self.penalty


def search_by_simulation(
    other: Search, fresh: FreshData, catalogue: Sequence[type[AbstractEffect]],
    tell: Callable[[str], None], gap: float,
) -> Search | None:  # fmt: skip
    """Look for effects again where a random force had taken up what is missing.

    Parameters
    ----------
    other : Search
        The search with filters, which left something unexplained.
    fresh : FreshData
        What models are compared on; nothing is fitted to it.
    catalogue : sequence of effect classes
        What may be missing.
    tell : callable
        Told what is being done.
    gap : float
        The smallest gap so far, on the fresh data [output unit].

    Returns
    -------
    Search or None
        The base, the rounds and the final model, whose parameters are not to be fitted again; None
        if no effect was found or the gap is hardly smaller.
    """
    loop, names = other.base.loop, other.base.names
    records = fresh.without_windows(other.base.records)
    task = Simulation(loop, names, records, [0.0] * len(records))
    x0 = task.make_initial_states([{} for _ in records])
    started = [task.fit(t, x0) for t in (list_start_values(loop, names), other.base.fit.theta)]
    base = now = min(started, key=lambda s: s.square)
    sensor, given = other.final.fit.sensor, len(loop.effects)
    before = _measure_gap(base, fresh)
    rounds: list[tuple[Simulated, list[Tried], Tried | None]] = []
    while len(rounds) < THRESHOLD.open_loop_rounds:
        tell(f"by simulation, round {len(rounds) + 1}")
        tried = _run_round(now, catalogue)
        best = tried[0] if tried and math.isfinite(tried[0].net_gain) else None
        new = best and best.found
        after = _measure_gap(new, fresh) if new else math.inf
        if not (
            new
            and new.square < THRESHOLD.open_loop_closes**2 * now.square
            and after < THRESHOLD.open_loop_closes * before
        ):
            rounds.append((now, tried, None))
            break
        rounds.append((now, tried, best))
        now, before = new, after
    tell("by simulation, what is needed")
    now, smaller = _drop_superfluous(_refit_each(now, given), given)
    if (
        len(now.loop.effects) == given
        or _measure_gap(now, fresh) > THRESHOLD.open_loop_better * gap
    ):
        return None
    first, final = (_make_model(s, sensor) for s in (base, now))
    steps = []
    for s, tried, best in rounds:
        model = _make_model(s, sensor)
        done = {id(t): _make_trial(t, model) for t in tried}
        steps.append(Round(model, tuple(done.values()), None if best is None else done[id(best)]))
    found = [_weigh_effect(final, now, given + k, s, rounds) for k, s in enumerate(smaller)]
    found.sort(key=lambda f: -f.trial.gain)
    return Search(
        first,
        tuple(steps),
        final,
        tuple(found),
        run_noise_tests(first.fit),
        run_noise_tests(final.fit),
    )


def _measure_gap(s: Simulated, fresh: FreshData) -> float:
    return fresh.measure_gap((s.fitted,) * len(fresh.windows))


def _make_model(s: Simulated, sensor: Array) -> Model:
    """Return a simulated loop as a model of the filter, without random forces."""
    fit = make_fit(s, np.resize(sensor, len(s.task.records)))
    return Model(s.loop, fit, s.standard_errors)


def _drop_superfluous(now: Simulated, given: int) -> tuple[Simulated, list[Simulated]]:
    """Take effects out until each is worth its parameters; return also the loops without each."""
    while True:
        smaller = [_refit_without(now, k) for k in range(given, len(now.loop.effects))]
        net_gains = [_compute_gain(s, now.square) - _compute_penalty(s, now) for s in smaller]
        if min(net_gains, default=math.inf) > THRESHOLD.gate:
            return now, smaller
        now = smaller[int(np.argmin(net_gains))]


def _refit_each(now: Simulated, given: int) -> Simulated:
    """Return a simulation in which each effect was looked for once more beside all others."""
    position = given
    for _ in range(given, len(now.loop.effects)):
        smaller = _refit_without(now, position)
        screened = _screen_effect(smaller, now.fitted.effects[position])
        again = screened and _refit_trial(smaller, screened).found
        if again and again.square < now.square:
            # The refitted effect stands last now, so that the next one is at this position.
            now = again
        else:
            position += 1
    return now


def _refit_without(now: Simulated, position: int) -> Simulated:
    """Return the loop without one of its effects, fitted again."""
    loop, names = take_out_effect(now.fitted, position, now.names)
    task = now.task.with_loop(loop, names)
    return task.fit(np.array(list_start_values(loop, names)), task.make_initial_states(now.starts))


def _weigh_effect(
    final: Model, now: Simulated, position: int, smaller: Simulated,
    rounds: Sequence[tuple[Simulated, list[Tried], Tried | None]],
) -> Weighed:  # fmt: skip
    """Return an effect with what closes nearly as much of the error in its place."""
    label, effect = list(now.fitted.labelled.items())[position]
    gain, penalty = _compute_gain(smaller, now.square), _compute_penalty(smaller, now)
    base = _make_model(smaller, final.fit.sensor)
    mine = Trial(effect, label, final, gain, 0.0, gain, penalty)
    near = max(THRESHOLD.close, THRESHOLD.open_loop_alike * mine.net_gain)
    close: list[Trial] = []
    for _, tried, best in rounds:
        if best is None or not is_same_kind(best.effect, effect):
            continue
        there = [*now.loop.effects]
        for t in tried[: THRESHOLD.open_loop_refitted]:
            if t.net_gain <= 0 or any(is_same_kind(t.effect, e) for e in there):
                continue
            screened = _screen_effect(smaller, t.effect)
            again = screened and _refit_trial(smaller, screened)
            if again and mine.net_gain - again.net_gain < near and again.net_gain > THRESHOLD.gate:
                close.append(_make_trial(again, base))
    return Weighed(mine, tuple(sorted(close, key=lambda t: -t.net_gain)), base, position)


def _run_round(now: Simulated, catalogue: Sequence[type[AbstractEffect]]) -> list[Tried]:
    """Screen all candidates, refit the promising, best first."""
    loop = now.fitted
    pool = [c for c in list_candidates(catalogue, loop, now.task.records[0])
            if not any(is_same_kind(e, c) for e in loop.effects)]  # fmt: skip
    tried = [t for c in pool if (t := _screen_effect(now, c)) is not None]
    tried.sort(key=lambda t: -t.score)
    done = [_refit_trial(now, t) for t in tried[: THRESHOLD.open_loop_refitted]]
    return (
        sorted(done, key=lambda t: (-t.net_gain, -t.score)) + tried[THRESHOLD.open_loop_refitted :]
    )


def _screen_effect(now: Simulated, effect: AbstractEffect) -> Tried | None:
    """Return an effect at the start with the largest score."""
    best: Tried | None = None
    task: Simulation | None = None
    for one in effect.spread_starts(SimulationSight(now)):
        try:
            loop = now.fitted.with_effect(one)
            label = next(k for k in loop.labelled if k not in now.loop.labelled)
            own = {f"{label}.{k}": v for k, v in one.values().items() if math.isfinite(v)}
            names = (*now.names, *own)
            if task is None:
                task = now.task.with_loop(loop, names)
            # The sensitivities of a backlash need another recursion than that of the states.
            if task.plant.e.memory is not None:
                return None
            theta = np.array([*now.theta, *own.values()])
            theta = np.clip(theta, task.problem.lower, task.problem.upper)
            x0 = task.make_initial_states(now.starts)
            errors, slopes, _ = task.run(theta, x0)
        except (ModelCannotRun, EffectDoesNotApply):
            continue
        step = np.linalg.lstsq(slopes, -errors, rcond=THRESHOLD.open_loop_rank)[0]
        left = float(np.mean((errors + slopes @ step) ** 2))
        score = _compute_gain(now, min(left, float(np.mean(errors**2))))
        if best is None or score > best.score:
            best = Tried(one, label, score, task, theta, x0)
    return best


def _compute_gain(now: Simulated, square: float) -> float:
    """Return what a smaller error is worth, for as many samples as are independent."""
    count = len(now.errors) / now.correlated
    return 0.5 * count * math.log(now.square / max(square, THRESHOLD.tiny))


def _compute_penalty(smaller: Simulated, larger: Simulated) -> float:
    """Return half the Bayesian penalty of the further parameters."""
    free = len(larger.names) - len(smaller.names)
    return bayesian_penalty(free, max(len(smaller.errors) / smaller.correlated, math.e))


def _refit_trial(now: Simulated, t: Tried) -> Tried:
    try:
        found = t.task.fit(t.theta, t.x0)
        effect = found.fitted.labelled[t.label]
    except (ModelCannotRun, EffectDoesNotApply) as reason:
        return replace(t, out=Objection.of(reason))
    gain = _compute_gain(now, found.square)
    penalty = _compute_penalty(now, found)
    out = VANISHES if effect.neutral else None
    return replace(t, found=found, gain=gain, penalty=penalty, out=out)


@dataclass(frozen=True, eq=False)
class SimulationSight:
    """What a simulated loop sees of its records, in place of what a filter sees."""

    simulated: Simulated

    @property
    def times(self) -> tuple[Array, ...]:
        """Times of the samples since the start of each record [s]."""
        return tuple(record.t - record.start for record in self.simulated.task.records)

    def state(self, name: str) -> tuple[Array, ...] | None:
        """Return a simulated state along each record, or None if the plant has no such state."""
        names = list(self.simulated.starts[0])
        if name not in names:
            return None
        return tuple(x[:, names.index(name)] for x in self.simulated.states)

    def strongest_line(self) -> float:
        """Return the frequency of the strongest line in the errors of the simulation [Hz]."""
        task, parts, first = self.simulated.task, [], 0
        for data in task.problem.data:
            # A sample that does not count keeps its place in time.
            part = np.zeros(len(data.valid))
            count = int(np.count_nonzero(data.valid))
            part[data.valid] = self.simulated.errors[first : first + count]
            parts.append(part)
            first += count
        return find_strongest_line(max(parts, key=len), task.records[0].dt)


def _make_trial(t: Tried, base: Model) -> Trial:
    """Return what was tried in the words of the other search."""
    model, label = base, ""
    if t.found is not None:
        model, label = _make_model(t.found, base.fit.sensor), t.label
    return Trial(t.effect, label, model, t.score, 0.0, t.gain, t.penalty, t.out)
