"""Maximum likelihood of a loop's parameters and noise, from the innovations of its filter."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import optimize

from .errors import CtrlidError
from .filtering import SETTLED, Filtered, Linearized, Machine, Noise, Track, Trajectory
from .physics import Array

ROUNDS = 25  # Gauss-Newton steps at most
FAR = 3.0  # standard errors: after a longer step the trajectory is settled anew
CLOSE = 0.02  # standard errors: a smaller step ends the search
QUIET = 1e-14  # of the output's size, squared: the least variance of the sensor noise
LEAST = -24.0  # logarithm of the least force noise: below, only the start of the record counts
MOST = 14.0  # and of the largest: above, the sensor is exact
SLOWEST = 0.05  # of the longest record: the time constant of a coloured force
LOG_STEP = 0.2  # of log variances, for derivatives
SHARES = tuple(3.0**-k for k in range(6))  # of a step, until the likelihood grows
ELSEWHERE = 2.0  # of log-likelihood, that a noise far away must gain to go on from there
NOTHING = 1e-3  # of log-likelihood: a step that promises less is not worth taking
SINGULAR = 1e-10  # relative eigenvalue below which a direction is not in the data


@dataclass(frozen=True, eq=False)
class Known:
    """Noise that is known beforehand.

    Ratios, and the variance of each record's sensor noise; None: what the model leaves.
    """

    noise: Noise
    sensor: Array | None = None


@dataclass(frozen=True, eq=False)
class Problem:
    """What is fitted to what.

    Parameters
    ----------
    machine : Machine
        The plant, with the free parameters as its names.
    tracks : tuple of Track
        The records.
    lower, upper : ndarray, shape (p,)
        Bounds of the parameters.
    counts : tuple of ndarray of bool
        Samples of each record that enter the likelihood.
    known : Known, optional
        The noise, where it is not to be searched.
    periods : tuple of int
        For each record, after how many samples it repeats itself: then only the differences
        between the repeats count, which no wrong model can have made.
    """

    machine: Machine
    tracks: tuple[Track, ...]
    lower: Array
    upper: Array
    counts: tuple[Any, ...] = ()
    known: Known | None = None
    periods: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Fit:
    """A point of the likelihood, with all that was computed there.

    `sensor` holds the variance of each record's sensor noise, `linearized` and `filtered` the last
    pass, `normal` the held-gain Fisher information of `theta` and its score.
    """

    problem: Problem
    theta: Array
    noise: Noise
    value: float
    sensor: Array
    linearized: tuple[Linearized, ...]
    filtered: tuple[Filtered, ...]

    @property
    def size(self) -> int:
        """Number of samples that count."""
        return int(sum(np.count_nonzero(c) for c in self.problem.counts))

    @functools.cached_property
    def normal(self) -> tuple[Array, Array]:
        """The held-gain information matrix and score of the parameters."""
        p = len(self.theta)
        matrix, score = np.zeros((p, p)), np.zeros(p)
        for out, keep, r in zip(self.filtered, self.problem.counts, self.sensor, strict=True):
            slopes, s = out.slopes[keep], out.variance[keep] * r
            matrix += (slopes / s[:, None]).T @ slopes
            score += slopes.T @ (out.innovations[keep] / s)
        return matrix, score

    @property
    def standard_errors(self) -> Array:
        """Standard errors of the parameters, the noise held."""
        return np.sqrt(np.maximum(np.diag(pseudo_inverse(self.normal[0])), 0.0))

    @property
    def standardized(self) -> list[Array]:
        """The innovations divided by their standard deviations; NaN where they do not count."""
        return [
            np.where(keep, out.innovations / np.sqrt(out.variance * r), np.nan)
            for out, keep, r in zip(self.filtered, self.problem.counts, self.sensor, strict=True)
        ]


def begin(problem: Problem, theta: Array, noise: Noise | None) -> Fit:
    """Return the likelihood at a starting point, with settled trajectories.

    Parameters
    ----------
    problem : Problem
        What is fitted; without `counts` the samples that count are chosen here.
    theta : ndarray, shape (p,)
        Parameter values.
    noise : Noise, optional
        The noise; by default searched.

    Returns
    -------
    Fit
        The starting point.
    """
    m = problem.machine
    noise = problem.known.noise if problem.known else noise
    first = noise or Noise((_unit(m) ** 2 * 1e-2,) * m.channels)
    settled = []
    for track in problem.tracks:
        at = m.guess(track)
        if noise is None:
            at = m.settle(track, theta, first, at, passes=2)[1].trajectory
        settled.append((track, at))
    if noise is None:
        lins = tuple(m.linearize(t, theta, at) for t, at in settled)
        counts = tuple(t.valid & ~t.afresh for t in problem.tracks)
        first = _tune(replace(problem, counts=counts), theta, lins, first, wide=True).noise
    results = [m.settle(track, theta, first, at) for track, at in settled]
    if not problem.counts:
        problem = replace(problem, counts=tuple(
            _settled(track, out) for track, (_, out) in zip(problem.tracks, results, strict=True)
        ))  # fmt: skip
    return evaluate(problem, theta, first, [out.trajectory for _, out in results])


def _settled(track: Track, out: Filtered) -> Any:
    known = track.valid & np.isfinite(out.variance)
    usual = np.median(out.variance[known])
    return known & ~track.afresh & (out.variance <= SETTLED * usual)


def _unit(machine: Machine) -> float:
    """Return a ratio of force to sensor noise from which others are counted."""
    return 1.0 / machine.loop.dt ** (2 if machine.e.velocities else 1)


def evaluate(problem: Problem, theta: Array, noise: Noise, at: Sequence[Trajectory]) -> Fit:
    """Return the likelihood of parameters and noise, linearized along given trajectories."""
    m = problem.machine
    lins = tuple(m.linearize(t, theta, a) for t, a in zip(problem.tracks, at, strict=True))
    return _measure(problem, theta, noise, lins)


def _measure(
    problem: Problem, theta: Array, noise: Noise, lins: Sequence[Linearized], sensitive: bool = True
) -> Fit:
    m = problem.machine
    outs = tuple(
        m.run(t, lin, noise, sensitive) for t, lin in zip(problem.tracks, lins, strict=True)
    )
    value, sensors = 0.0, []
    for k, (track, out, keep) in enumerate(zip(problem.tracks, outs, problem.counts, strict=True)):
        e, s = out.innovations[keep], out.variance[keep]
        if problem.periods:
            e, s = _between_repeats(out, keep, problem.periods[k])
        if not (np.isfinite(e).all() and np.isfinite(s).all() and (s > 0).all()):
            value, e, s = -math.inf, np.ones(1), np.ones(1)
        mean = float(np.mean(e**2 / s))
        if problem.known is not None and problem.known.sensor is not None:
            r = float(problem.known.sensor[k])
        else:
            least = QUIET * float(np.var(track.table[3][keep]) + np.mean(track.table[3][keep]) ** 2)
            r = max(mean, least, 1e-300)
        value -= 0.5 * (len(e) * (math.log(2 * math.pi * r) + mean / r) + np.sum(np.log(s)))
        sensors.append(r)
    return Fit(problem, theta, noise, float(value), np.array(sensors), tuple(lins), outs)


def _between_repeats(out: Filtered, keep: Any, period: int) -> tuple[Array, Array]:
    """Return what differs between repeats of the innovations, as large as they are, and variances.

    Counted from the end: whatever dies out at the start does not repeat.
    """
    first = len(keep) % period
    e, use = out.innovations[first:].reshape(-1, period), keep[first:].reshape(-1, period)
    count = use.sum(axis=0)
    mean = np.sum(np.where(use, e, 0.0), axis=0) / np.maximum(count, 1)
    use = use & (count > 1)
    size = np.sqrt(count / np.maximum(count - 1, 1))
    return ((e - mean) * size)[use], out.variance[first:].reshape(-1, period)[use]


def _log_noise(noise: Noise, dt: float) -> Array:
    logs = list(np.log(noise.force))
    if noise.drift:
        logs += [math.log(noise.coloured), math.log(-dt / math.log(noise.memory))]
    return np.array(logs)


def _noise(logs: Array, channels: int, dt: float) -> Noise:
    force = tuple(np.exp(np.clip(logs[:channels], -300, 300)).tolist())
    if len(logs) == channels:
        return Noise(force)
    memory = math.exp(-dt / math.exp(min(max(logs[channels + 1], -50), 50)))
    memory = min(max(memory, 1e-6), 1 - 1e-9)
    return Noise(force, memory, math.exp(min(max(logs[channels], -300), 300)) * (1 - memory**2))


def _tune(
    problem: Problem, theta: Array, lins: Sequence[Linearized], noise: Noise, wide: bool = False,
    enough: float = 0.02,
) -> Fit:  # fmt: skip
    """Return the most likely noise for parameters as they are."""
    m, dt = problem.machine, problem.machine.loop.dt
    if problem.known is not None:
        return _measure(problem, theta, problem.known.noise, lins)

    def at(logs: Array) -> Noise:
        return _noise(logs, m.channels, dt)

    def cost(logs: Array) -> float:
        value = _measure(problem, theta, at(np.atleast_1d(logs)), lins, sensitive=False).value
        return -value if np.isfinite(value) else 1e15

    start = _log_noise(noise, dt)
    longest = max(len(t.record) for t in problem.tracks)
    low, high = _limits(m, len(start) > m.channels, longest)
    start = np.clip(start, low, high)
    if wide:
        grid = np.linspace(low[0], high[0], 20)
        best = grid[int(np.argmin([cost(np.full(m.channels, g)) for g in grid]))]
        start[: m.channels] = best
    if len(start) == 1:
        best = _line(cost, start[0], low[0], high[0])
    else:
        best = _newton(cost, start, low, high, enough)
    return _measure(problem, theta, at(best), lins)


def _line(cost: Callable[[Array], float], x: float, low: float, high: float) -> Array:
    """Minimise along one logarithm, moving on while the minimum lies at the end of the bracket."""
    reach = 2.5
    while True:
        ends = max(x - reach, low), min(x + reach, high)
        found = optimize.minimize_scalar(
            lambda v: cost(np.atleast_1d(np.asarray(v))), bounds=ends, method="bounded",
            options={"xatol": 0.03, "maxiter": 20},
        )  # fmt: skip
        moved = abs(float(found.x) - x)
        x = float(found.x)
        if moved < 0.9 * reach or x - low < 0.1 or high - x < 0.1:
            return np.array([x])


def _limits(m: Machine, coloured: bool, longest: int) -> tuple[Array, Array]:
    """Return bounds of the logarithms of the noise variances.

    A force that hardly changes during a record is an offset, not noise.
    """
    unit, dt = 2 * math.log(_unit(m)), m.loop.dt
    low, high = [unit + LEAST] * m.channels, [unit + MOST] * m.channels
    if coloured:
        low += [unit + LEAST, math.log(2 * dt)]
        high += [unit + MOST, math.log(max(min(SLOWEST * longest, 2e4), 4.0) * dt)]
    return np.array(low), np.array(high)


def _newton(
    cost: Callable[[Array], float], x: Array, low: Array, high: Array, enough: float
) -> Array:  # fmt: skip
    """Minimise a smooth function of a few logarithms by damped Newton steps with differences."""
    n, h = len(x), LOG_STEP
    here, damping = cost(x), 0.1
    for _ in range(12):
        ups = np.array([cost(np.clip(x + h * row, low, high)) for row in np.eye(n)])
        downs = np.array([cost(np.clip(x - h * row, low, high)) for row in np.eye(n)])
        slope = (ups - downs) / (2 * h)
        hessian = np.diag((ups + downs - 2 * here) / h**2)
        for i in range(n):
            for j in range(i):
                both = cost(np.clip(x + h * (np.eye(n)[i] + np.eye(n)[j]), low, high))
                hessian[i, j] = hessian[j, i] = (both - ups[i] - ups[j] + here) / h**2
        values, vectors = np.linalg.eigh(hessian)
        values = np.maximum(np.abs(values), 1e-3)
        while True:
            step = -vectors @ ((vectors.T @ slope) / (values + damping))
            step *= min(1.0, 2.5 / max(float(np.abs(step).max()), 1e-300))
            trial = np.clip(x + step, low, high)
            there = cost(trial)
            if there <= here or damping > 1e6:
                break
            damping = max(10 * damping, 1.0)
        gain = here - there
        if gain <= 0:
            break
        x, here, damping = trial, there, damping / 10
        if gain < enough:
            break
    return x


def climb(fit: Fit, rounds: int = ROUNDS, exact: bool = True) -> Fit:
    """Climb to the maximum of the likelihood over parameters and noise.

    Gauss-Newton steps on the innovations with the filter's gain held fixed, the noise tuned between
    them, and at the end Newton steps on the likelihood itself, whose derivative knows that the
    gain moves as well.

    Parameters
    ----------
    fit : Fit
        Where to begin.
    rounds : int, optional
        Steps at most.
    exact : bool, optional
        Whether to end with steps on the likelihood itself.

    Returns
    -------
    Fit
        The maximum, or the best point found.
    """
    tuned, far, enough = -math.inf, True, 0.02 if exact else 0.3
    for _ in range(rounds):
        # A short step was already evaluated along the trajectory of the pass before.
        moved = relinearized(fit) if far else fit
        fit = moved if np.isfinite(moved.value) else fit
        if fit.value > tuned + 2.0:
            fit = _tune(fit.problem, fit.theta, fit.linearized, fit.noise, enough=enough)
            tuned = fit.value
        fit, length = _ascend(fit, *fit.normal)
        far = bool(length > FAR)
        if length < (CLOSE if exact else 5 * CLOSE):
            if fit.value <= tuned + 2.5 * enough:
                break
            fit = _tune(fit.problem, fit.theta, fit.linearized, fit.noise, enough=enough)
            tuned = fit.value
    return polish(fit) if exact else fit


def retuned(fit: Fit) -> Fit:
    """Return the fit climbed on from a noise sought over its whole range, if that is far better.

    A random force that stood for a wrong parameter at the start may have left no noise to the
    sensor, from where small changes lead nowhere.
    """
    plain = Noise(fit.noise.force)
    other = _tune(fit.problem, fit.theta, fit.linearized, plain, wide=True)
    return climb(other) if other.value > fit.value + ELSEWHERE else fit


def relinearized(fit: Fit) -> Fit:
    """Return the likelihood of the same values, the plant linearized along its last trajectory."""
    along = [out.trajectory for out in fit.filtered]
    return evaluate(fit.problem, fit.theta, fit.noise, along)


def bounded_step(fit: Fit, matrix: Array, score: Array) -> tuple[Array, Array]:
    """Return the Newton step and the standard errors; bounds hold what pushes outwards."""
    p, problem = len(fit.theta), fit.problem
    step, error = np.zeros(p), np.full(p, np.inf)
    moving = np.diag(matrix) > 0
    for _ in range(p + 1):
        rows = np.flatnonzero(moving)
        if not len(rows):
            break
        inverse = pseudo_inverse(matrix[np.ix_(rows, rows)])
        step[:] = 0.0
        step[rows] = inverse @ score[rows]
        error[rows] = np.sqrt(np.maximum(np.diag(inverse), 1e-300))
        stuck = ((fit.theta <= problem.lower) & (step < 0)) | (
            (fit.theta >= problem.upper) & (step > 0)
        )
        if not (stuck & moving).any():
            break
        moving &= ~stuck
    step[~moving] = 0.0
    return step, error


def pseudo_inverse(matrix: Array) -> Array:
    """Invert an information matrix, leaving out directions that are not in the data."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
    keep = values > SINGULAR * values.max()
    inverse = (vectors[:, keep] / values[keep]) @ vectors[:, keep].T
    return np.asarray(inverse / np.outer(size, size), dtype=float)


def _ascend(fit: Fit, matrix: Array, score: Array) -> tuple[Fit, float]:
    """Take a Gauss-Newton step, or as much of it as makes the likelihood grow.

    Returns
    -------
    fit : Fit
        A better point, or the same.
    length : float
        Length of the step in standard errors; zero if none is better.
    """
    problem = fit.problem
    whole, error = bounded_step(fit, matrix, score)
    if not np.isfinite(whole).all() or 0.5 * score @ whole < NOTHING:
        return fit, 0.0
    for step in (share * whole for share in SHARES):
        theta = np.clip(fit.theta + step, problem.lower, problem.upper)
        try:
            if not problem.machine.fits(theta):
                problem, fit = _rebuilt(fit, theta)
            trial = evaluate(problem, theta, fit.noise, [o.trajectory for o in fit.filtered])
        except CtrlidError:  # too far: what moves so fast is no longer followed
            continue
        if np.isfinite(trial.value) and trial.value >= fit.value - 1e-6:
            return trial, float(np.max(np.abs(step) / error, initial=0.0))
    return fit, 0.0


def _rebuilt(fit: Fit, theta: Array) -> tuple[Problem, Fit]:
    """Return the problem with a machine for the delay that `theta` has."""
    m = fit.problem.machine
    loop = m.loop.with_parameters(dict(zip(m.names, theta.tolist(), strict=True)))
    problem = replace(fit.problem, machine=Machine(loop, m.names, m.hold, m.law is not None))
    return problem, replace(fit, problem=problem)


def polish(fit: Fit, rounds: int = 2) -> Fit:
    """Take Newton steps on the likelihood itself, by differences over half a standard error."""
    for _ in range(rounds):
        matrix, _ = fit.normal
        _, error = bounded_step(fit, *fit.normal)
        score, known = np.zeros(len(fit.theta)), np.isfinite(error)
        at = [out.trajectory for out in fit.filtered]
        fit = evaluate(fit.problem, fit.theta, fit.noise, at)
        for k in np.flatnonzero(known):
            values = []
            ends = np.clip(
                fit.theta[k] + np.array([-0.5, 0.5]) * error[k],
                fit.problem.lower[k], fit.problem.upper[k],
            )  # fmt: skip
            for end in ends:
                theta = fit.theta.copy()
                theta[k] = end
                values.append(evaluate(fit.problem, theta, fit.noise, at).value)
            if ends[1] > ends[0] and np.isfinite(values).all():
                score[k] = (values[1] - values[0]) / (ends[1] - ends[0])
        if not known.any():
            return fit
        fit, length = _ascend(fit, matrix, score)
        if length < 0.05:
            break
    tuned = _tune(fit.problem, fit.theta, fit.linearized, fit.noise)
    return tuned if tuned.value > fit.value else fit


def with_coloured_force(fit: Fit) -> Fit:
    """Return the fit with a coloured force added, whether it pays or not."""
    m, dt = fit.problem.machine, fit.problem.machine.loop.dt
    best: Fit | None = None
    sizes = np.array([1e-2, 1.0]) * sum(fit.noise.force)
    for time in (3 * dt, 30 * dt, 300 * dt):
        for size in sizes:
            memory = math.exp(-dt / time)
            force = tuple(0.5 * v for v in fit.noise.force)
            noise = Noise(force, memory, size * (1 - memory**2))
            trial = _measure(fit.problem, fit.theta, noise, fit.linearized, sensitive=False)
            if best is None or trial.value > best.value:
                best = trial
    assert best is not None
    if not np.isfinite(best.value):
        raise CtrlidError(f"no coloured force can be fitted to {m.e.name}")
    return _tune(fit.problem, fit.theta, fit.linearized, best.noise)


def known_from_repeats(fit: Fit, periods: Sequence[int]) -> Known:
    r"""Return the noise that differs between repeats of the same experiment.

    .. math:: d_k^p = \sqrt{\tfrac{P}{P-1}} \Bigl( e_k^p - \tfrac{1}{P} \sum_q e_k^q \Bigr)

    What a wrong model leaves in the innovations e is the same in each of the P periods; what
    differs is noise. A coloured force takes part if the Bayesian criterion wants it.

    Parameters
    ----------
    fit : Fit
        A fit of any model that follows the records.
    periods : sequence of int
        For each record, after how many samples it repeats itself.

    Returns
    -------
    Known
        The noise.

    References
    ----------
    Pintelon and Schoukens, *System Identification: A Frequency Domain Approach*, section 4.3.
    """
    problem = replace(fit.problem, known=None, periods=tuple(periods))
    plain = _tune(problem, fit.theta, fit.linearized, Noise(fit.noise.force), wide=True)
    richer = with_coloured_force(plain)
    best = richer if richer.value > plain.value + math.log(fit.size) else plain
    return Known(best.noise, best.sensor)


def information(fit: Fit) -> tuple[Array, Array]:
    r"""Return the exact Fisher information of parameters and noise, and the score.

    .. math:: I = \sum_k \frac{1}{s_k} \frac{\partial e_k}{\partial\eta}
        \frac{\partial e_k}{\partial\eta}^T + \frac{1}{2 s_k^2}
        \frac{\partial s_k}{\partial\eta} \frac{\partial s_k}{\partial\eta}^T

    over parameters, logarithms of the noise ratios and of each record's sensor variance, with the
    gain of the filter moving with them.

    Parameters
    ----------
    fit : Fit
        The maximum of the likelihood.

    Returns
    -------
    matrix : ndarray
        Information of the parameters first, then of the noise.
    score : ndarray
        Derivative of the log-likelihood.

    References
    ----------
    Åström, "Maximum likelihood and prediction error methods", Automatica 16 (1980).
    """
    problem, m = fit.problem, fit.problem.machine
    dt, p = m.loop.dt, len(fit.theta)
    at = [out.trajectory for out in fit.filtered]
    _, error = bounded_step(fit, *fit.normal)
    logs = _log_noise(fit.noise, dt) if problem.known is None else np.zeros(0)

    def innovations(theta: Array, noise: Noise) -> Any:
        out = evaluate(problem, theta, noise, at).filtered
        return [(o.innovations[c], np.log(o.variance[c]))
                for o, c in zip(out, problem.counts, strict=True)]  # fmt: skip

    columns: list[Any] = []
    for k in range(p):
        h = error[k] if np.isfinite(error[k]) else 0.0
        ends = np.clip(fit.theta[k] + np.array([-0.5, 0.5]) * h, problem.lower[k], problem.upper[k])
        pair = []
        for end in ends:
            theta = fit.theta.copy()
            theta[k] = end
            pair.append(innovations(theta, fit.noise))
        columns.append(_difference(pair, float(ends[1] - ends[0])))
    for k in range(len(logs)):
        pair = []
        for h in (-LOG_STEP, LOG_STEP):
            moved = logs.copy()
            moved[k] += h
            pair.append(innovations(fit.theta, _noise(moved, m.channels, dt)))
        columns.append(_difference(pair, 2 * LOG_STEP))
    count, records = len(columns), len(problem.tracks) if problem.known is None else 0
    matrix = np.zeros((count + records, count + records))
    score = np.zeros(count + records)
    for k, (out, keep, r) in enumerate(zip(fit.filtered, problem.counts, fit.sensor, strict=True)):
        s, e = out.variance[keep] * r, out.innovations[keep]
        size = np.zeros((len(e), records))
        size[:, k : k + 1] = 1.0
        slopes = np.column_stack([c[k][0] for c in columns] + [np.zeros_like(size)])
        widths = np.column_stack([c[k][1] for c in columns] + [size])
        matrix += (slopes / s[:, None]).T @ slopes + 0.5 * widths.T @ widths
        score += -slopes.T @ (e / s) + 0.5 * widths.T @ (e**2 / s - 1)
    return matrix, score


def _difference(pair: Any, width: float) -> list[tuple[Array, Array]]:
    if width <= 0:
        return [(np.zeros_like(e), np.zeros_like(s)) for e, s in pair[0]]
    return [((e1 - e0) / width, (s1 - s0) / width)
            for (e0, s0), (e1, s1) in zip(*pair, strict=True)]  # fmt: skip
