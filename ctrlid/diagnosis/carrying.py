"""Another model of a loop, begun where one is already fitted."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..estimation.likelihood.filter_data import retracked
from ..estimation.likelihood.kalman_filter import first_guess
from ..estimation.likelihood.likelihood import Fit, evaluate
from ..estimation.likelihood.physics_fit import bounds_of, start_values
from ..estimation.likelihood.sampled_plant import Machine, Trajectory
from ..loop.loop import Loop
from .fitted import Model


def carried_over(base: Model, loop: Loop, names: Sequence[str]) -> Fit:
    """Return the likelihood of a larger or smaller model, along the trajectory of the base."""
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
