"""Minimising the prediction errors of a continuous-time model: starts, steps and constraints."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from ..._base.arrays import Array
from ..._base.errors import CtrlidError
from ..._base.statistics import regress
from ..._base.text import write_list
from ..constraints import AbstractConstraint
from ..constraints.constrained_minimum import Found, minimize
from ..constraints.quadratic_program import Cost, NotExcited
from ..identified_model import Structure
from .regression import merge_factors, triangularize
from .restricted_likelihood import compute_restricted_cost, restrict_likelihood
from .sampled_motion import (
    Circuit,
    DiscreteModel,
    add_noise_states,
    compute_prediction_errors,
    discretize_model,
    list_inputs,
    place_gain,
    realize_model,
)

# A search ends after at most so many Gauss-Newton steps.
ROUNDS = 40
# An averaging converter takes up to four samples in practice, AR noise is followed for so long.
MOST_COLOUR = 6
# A search has converged when a full step gains less than this share of the residual variance.
CONVERGED = 1e-7
# Observer poles stay so many over the samples of a stretch inside the unit circle, since the data
# resolve no slower ones.
SLOWEST = 3
# Directions of initial state and operating point below this share of the largest are not in the
# data.
RESOLVED = 1e-12
# A delay is looked for up to this share of the longest stretch.
LONGEST_DELAY = 10
# No stretch loses more than this share of its samples to a delay.
SHORTENED = 4


class NotDetermined(CtrlidError):
    """The data say nothing of some coefficients of a model."""


@dataclass(frozen=True, eq=False)
class Piece:
    """One valid stretch of a record, as deviations."""

    signals: dict[str, Array]
    n: int
    # The input before its first sample, as far as it is known.
    before: Array = field(default_factory=lambda: np.zeros(0))

    def predict(self, motion: DiscreteModel, gain: Array) -> Array | None:
        """Return the prediction errors of a model; None if its observer is unstable."""
        return compute_prediction_errors(motion, gain, self.signals, self.before)


@dataclass(frozen=True, eq=False)
class Point:
    """Where the search stands: coefficients, observer gain and delay."""

    theta: Array
    gain: Array
    delay: float


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where a search ended: its task, the residuals, and whether it converged."""

    task: Task
    point: Point
    found: Found
    rss: float
    residuals: list[Array]
    settled: bool

    @property
    def used(self) -> int:
        """Number of samples less the initial states and levels fitted to them."""
        task = self.task
        states = task.structure.na + task.colour + (len(task.circuit.a) if task.circuit else 0)
        return sum(p.n for p in task.pieces) - len(task.pieces) * (states + 1)

    @property
    def fitted(self) -> int:
        """Number of coefficients that are free, observer gains and delays fitted."""
        return self.found.free + len(self.point.gain) + int(self.task.free_delay)

    @property
    def criterion(self) -> float:
        """The Bayesian information criterion of the noise model."""
        n = sum(p.n for p in self.task.pieces)
        return n * float(np.log(self.rss)) + len(self.point.gain) * float(np.log(n))


@dataclass(frozen=True, eq=False)
class Task:
    """What is fitted to which data; `speed` is a typical rate [rad/s] that scales the states."""

    structure: Structure
    pieces: tuple[Piece, ...]
    dt: float
    hold: str
    circuit: Circuit | None
    free_delay: bool
    speed: float
    # Order of the moving average that the sensor noise is.
    colour: int = 0

    def discretize(self, theta: Array, delay: float) -> DiscreteModel:
        """Return the model over one period."""
        num, den = self.structure.fraction(theta)
        # With as many zeros as poles the first coefficient passes u on to y at once.
        at_once = float(num[0]) if len(num) == len(den) else 0.0
        num = num[1:] - at_once * den[1:] if len(num) == len(den) else num
        motion = discretize_model(
            *realize_model(den, num, self.speed), self.dt, self.hold, delay, self.circuit
        )
        motion = add_noise_states(motion, self.colour) if self.colour else motion
        late = math.ceil(delay / self.dt - 1e-12) if self.hold == "zoh" else 0
        return replace(motion, direct=(late, at_once))


def _compute_columns(task: Task, point: Point, piece: Piece) -> Array | None:
    """Return the prediction errors and what initial state and operating point add to them."""
    motion = task.discretize(point.theta, point.delay)
    errors = piece.predict(motion, point.gain)
    if errors is None:
        return None
    size, n = len(motion.f), piece.n
    closed = motion.f - np.outer(place_gain(motion, point.gain), motion.c)
    free = np.empty((n, size))
    state = np.eye(size)
    # -c closed^k by doubling: the first rows times a power of the matrix give the next ones.
    free[:1] = -motion.c @ state
    filled, power = 1, closed
    # What has died out is zero.
    with np.errstate(under="ignore"):
        while filled < n:
            more = min(filled, n - filled)
            free[filled : filled + more] = free[:more] @ power
            power, filled = power @ power, filled + more
    ones = {name: np.zeros(n) for name in piece.signals}
    ones |= {"y": np.ones(n)} if _has_no_gain(task, point) else list_inputs(np.ones(n), task.hold)
    rest = compute_prediction_errors(motion, point.gain, ones)
    assert rest is not None  # The observer is the one that was stable above.
    return np.column_stack([free, rest, errors])


def _has_no_gain(task: Task, point: Point) -> bool:
    """Whether a level of y, and not of u, is what an unknown operating point adds.

    Beside a free initial state one follows from the other, but for a plant that passes no constant
    on: an offset of u then does what a state does, and a level of y, as of a sensor whose zero is
    off, is the offset that is left. A plant with a pole at the origin has it the other way round,
    and a known circuit sees y as well.
    """
    if task.circuit is not None:
        return False
    num, den = task.structure.fraction(point.theta)
    num, den = (np.abs(p) * task.speed ** np.arange(len(p)) for p in (num[::-1], den[::-1]))
    return bool(num[0] * den.max() < den[0] * num.max())


def _compute_residuals(task: Task, point: Point) -> list[Array]:
    """Return the prediction errors of each stretch, with the best initial state and level.

    These are the innovations, if model and observer are right.
    """
    errors = []
    for table in _evaluate_cost(task, point)[1]:
        free = table[:, :-1]
        errors.append(table[:, -1] - free @ regress(free, table[:, -1], RESOLVED))
    return errors


def _evaluate_cost(task: Task, point: Point) -> tuple[float, list[Array]]:
    """Return the sum of squared errors with initial states and offsets at their best."""
    total, columns = 0.0, []
    for piece in task.pieces:
        table = _compute_columns(task, point, piece)
        if table is None or not np.isfinite(table).all():
            return np.inf, []
        r = triangularize(table)
        total += float(r[-1, -1] ** 2)
        columns.append(table)
    return total, columns


def _compute_errors(task: Task, point: Point, piece: Piece) -> Array | None:
    """Return the prediction errors of a point; None where there is no prediction."""
    if point.delay < 0:
        return None
    motion = task.discretize(point.theta, point.delay)
    return piece.predict(motion, point.gain)


def _differentiate_errors(
    task: Task, piece: Piece, here: Array, h: float, move: Callable[[float], Point]
) -> Array:
    """Difference the errors; one-sided or with shorter steps where there is no prediction.

    The observer may turn unstable, and no delay is negative.
    """
    for _ in range(8):
        up, down = (_compute_errors(task, move(step), piece) for step in (h, -h))
        if up is not None and down is not None:
            return (up - down) / (2 * h)
        if up is not None:
            return (up - here) / h
        if down is not None:
            return (here - down) / h
        h /= 10
    return np.zeros_like(here)


def _compute_jacobian(task: Task, point: Point, tables: Sequence[Array] | None = None) -> Array:
    """Return the triangular factor of ``[gain, delay, theta, errors]``, nuisance projected out.

    The tables of the cost may be given where they are known.
    """
    tables = _evaluate_cost(task, point)[1] if tables is None else tables
    steps: list[tuple[float, Callable[[float], Point]]] = []
    for e in np.eye(len(point.gain)):
        h = 1e-5 * max(abs(float(point.gain @ e)), 1e-3 * float(np.abs(point.gain).max()), 1e-9)
        steps.append((h, lambda h, e=e: replace(point, gain=point.gain + h * e)))  # type: ignore[misc]
    if task.free_delay:
        steps.append((1e-4 * task.dt, lambda h: replace(point, delay=point.delay + h)))
    factors = []
    for piece, table in zip(task.pieces, tables, strict=True):
        here = table[:, -1]
        slopes = [_differentiate_errors(task, piece, here, h, move) for h, move in steps]
        slopes += [*_differentiate_by_coefficients(task, point, piece, here).T]
        nuisance = table.shape[1] - 1
        whole = np.column_stack([table[:, :nuisance], *slopes, here])
        factors.append(triangularize(whole)[nuisance:, nuisance:])
    return merge_factors(factors)


def _differentiate_by_coefficients(task: Task, point: Point, piece: Piece, here: Array) -> Array:
    """Return what each coefficient does to the prediction errors of a stretch, a column each."""
    size = _measure_coefficients(task, point)
    slopes = []
    for e in np.eye(len(point.theta)):
        h = 1e-5 * max(abs(float(point.theta @ e)), 1e-2 * float(size @ e))

        def move(h: float, e: Array = e) -> Point:
            return replace(point, theta=point.theta + h * e)

        slopes.append(_differentiate_errors(task, piece, here, h, move))
    return np.column_stack(slopes)


def measure_delay_spread(best: Minimum) -> tuple[float, Array]:
    r"""Return variance and covariances of a fitted delay, in units of the residual variance.

    .. math:: R_1 (\eta - \hat\eta) + R_{12} (\theta - \hat\theta) = w, \quad
        \operatorname{cov} \hat\eta = R_1^{-1} R_1^{-\mathsf T} + W S W^{\mathsf T}, \quad
        \operatorname{cov}(\hat\eta, \hat\theta) = -W S, \quad W = R_1^{-1} R_{12}

    for the observer gains and the delay :math:`\eta`, with the rows R of the triangular factor and
    the spread S of the coefficients. At a delay of zero the slope is that towards larger ones.
    """
    task, point = best.task, best.point
    factor = _compute_jacobian(task, point)
    extra = len(point.gain) + 1
    p = extra + len(task.structure.names)
    inverse = np.linalg.pinv(factor[:extra, :extra])
    rows = inverse @ factor[:extra, extra:p]
    spread = inverse @ inverse.T + rows @ best.found.spread @ rows.T
    return float(spread[-1, -1]), -rows[-1] @ best.found.spread


def _measure_coefficients(task: Task, point: Point) -> Array:
    """Return a typical size of each coefficient, in its own unit."""
    s = task.structure
    largest = float(np.abs(point.theta[s.na :]).max())
    return np.concatenate([task.speed ** np.arange(1.0, s.na + 1), np.full(s.nb, largest)])


def _make_unit_vector(n: int, i: int) -> Array:
    e = np.zeros(n)
    e[i] = 1.0
    return e


def _minimize_errors(
    task: Task, point: Point, known: Sequence[AbstractConstraint], rounds: int = ROUNDS,
    hold_gain: bool = False,
) -> tuple[Point, Found, float, bool]:  # fmt: skip
    """Run Gauss-Newton with the constraints in each step; halved until the errors shrink.

    The observer gain may be held, whose errors the spread of the coefficients then leaves out.

    The last result says whether it converged: a further step of the coefficients promised less
    than one residual variance, which is half a unit of log-likelihood. At short periods the best
    observer is at the border of stability, so that a step of its gain may promise more for ever.
    """
    settled = False
    rss, tables = _evaluate_cost(task, point)
    found: Found | None = None
    for _ in range(rounds):
        factor = _compute_jacobian(task, point, tables)
        held = len(point.gain) if hold_gain else 0
        factor = triangularize(factor[:, held:]) if held else factor
        found, others, predicted = _solve_step(task, point, known, factor, rss)
        if task.free_delay and point.delay == 0 and others[-1] < 0:
            # No delay is negative, so that the others find their best beside none. They are known
            # no better for that: the delay was none by chance.
            factor = triangularize(np.delete(factor, len(point.gain) - held, axis=1))
            spread = found.spread
            found, others, predicted = _solve_step(task, point, known, factor, rss)
            found, others = replace(found, spread=spread), np.append(others, 0.0)
        move = found.theta - point.theta
        p = factor.shape[1] - 1
        extra = p - len(task.structure.names)
        degrees = max(sum(q.n for q in task.pieces) - p, 1)
        settled = predicted < rss / degrees
        for k in range(12):
            share = 0.5**k
            step = share * np.append(np.zeros(held), others)
            delay = max(point.delay + (step[-1] if task.free_delay else 0.0), 0.0)
            trial = Point(point.theta + share * move, point.gain + step[: len(point.gain)], delay)
            new, new_tables = _evaluate_cost(task, trial)
            # The first step may raise the cost, since it has to meet the constraints.
            if new < rss or (
                share == 1.0 and _is_violated(task, point, known) and np.isfinite(new)
            ):
                break
        else:
            break
        gained, rss, point, tables = rss - new, new, trial, new_tables
        if share == 1.0 and abs(gained) < CONVERGED * rss / degrees and settled:
            break
    assert found is not None
    if not settled:
        alone, right = factor[:, extra:p], factor[:, p]
        size = np.where((size := np.linalg.norm(alone, axis=0)) > 0, size, 1.0)
        cost = Cost(alone / size, -right, np.diag(1 / size), point.theta)
        move = minimize(cost, known, task.structure).theta - point.theta
        left = float(np.sum((alone @ move + right) ** 2))
        settled = float(right @ right) - left < rss / degrees
    return point, found, rss, settled


def _solve_step(
    task: Task, point: Point, known: Sequence[AbstractConstraint], factor: Array, rss: float
) -> tuple[Found, Array, float]:
    """Return the best coefficients, the step of gains and delay, and the gain that they promise.

    The columns of `factor` before those of the coefficients are what is stepped.
    """
    p = factor.shape[1] - 1
    extra = p - len(task.structure.names)
    inner, right = factor[extra:p, extra:p], factor[extra:p, p]
    size = np.linalg.norm(inner, axis=0)
    size = np.where(size > 0, size, 1.0)
    cost = Cost(inner / size, -right, np.diag(1 / size), point.theta)
    found = minimize(cost, known, task.structure)
    move = found.theta - point.theta
    goal = -factor[:extra, p] - factor[:extra, extra:p] @ move
    others: Array = np.linalg.lstsq(factor[:extra, :extra], goal, rcond=None)[0].astype(float)
    promised = (
        rss - float(np.sum((inner @ move + right) ** 2)) - float(factor[p:, p] @ factor[p:, p])
    )
    return found, others, promised


def _is_violated(task: Task, point: Point, known: Sequence[AbstractConstraint]) -> bool:
    if not known:
        return False
    least = 1e-12 * np.maximum(_measure_coefficients(task, point), np.finfo(float).tiny)
    eye = np.eye(len(point.theta))
    cost = Cost(eye / np.maximum(np.abs(point.theta), least), np.zeros(len(eye)), eye, point.theta)
    nearest = minimize(cost, known, task.structure).theta
    return bool(np.any(np.abs(nearest - point.theta) > 1e-9 * (np.abs(point.theta) + least)))


def find_best_fit(task: Task, known: Sequence[AbstractConstraint], delay: float) -> Minimum:
    """Search from the most promising starts and return the best minimum.

    Raises
    ------
    NotDetermined
        If some coefficients change no prediction.
    """
    whole, latest = task, delay
    if task.free_delay:
        latest = max(p.n for p in task.pieces) * task.dt / LONGEST_DELAY
    task = _give_lead(task, latest)
    starts = _rank_starts(task, delay)
    short = replace(task, pieces=_take_head(task.pieces))
    ranked: list[tuple[float, float, Point]] = []
    for speed, point in starts[:6]:
        local = _change_speed(short, speed)
        try:
            refined, _, rss, _ = _minimize_errors(local, point, known, rounds=12)
        except NotExcited:
            continue
        ranked.append((rss, speed, refined))
    if not ranked:
        raise NotDetermined(
            "The data do not determine the coefficients: from every start of the search some "
            "coefficients changed no prediction. Vary the reference, lower the orders or add a "
            "constraint."
        )
    ranked.sort(key=lambda r: r[0])
    _, speed, point = ranked[0]
    try:
        # The delay is about known now, and may move by a sample or two.
        lead = point.delay + 2 * task.dt if task.free_delay else delay
        task = _change_speed(_give_lead(whole, lead), speed)
        best, found, rss, settled = _minimize_twice(task, point, known)
    except NotExcited as trouble:
        raise NotDetermined(
            "The data do not determine the coefficients: a change of "
            f"{write_list(task.structure.names)} in the direction "
            f"{np.array2string(trouble.direction, precision=3)} changes no prediction. Vary the "
            "reference, lower the orders or add a constraint."
        ) from None
    return Minimum(task, best, found, rss, _compute_residuals(task, best), settled)


def restrict_observer(best: Minimum, known: Sequence[AbstractConstraint]) -> Minimum:
    """Return the minimum beside the observer gain of the largest restricted likelihood."""
    task, gains = best.task, len(best.point.gain)
    factor = _compute_jacobian(task, best.point)
    last = factor.shape[1] - 1
    # The gain stands last, so that its triangle is what the data say of it beside all else.
    turned = triangularize(factor[:, [*range(gains, last), *range(gains)]])
    units = np.linalg.pinv(turned[-gains:, -gains:]) * np.sqrt(best.rss / best.used)
    values, vectors = np.linalg.eigh(best.found.spread)
    free = vectors[:, values > 0] * np.sqrt(values[values > 0])

    def compute_cost(gain: Array) -> float:
        point, tables = replace(best.point, gain=gain), []
        for piece in task.pieces:
            table = _compute_columns(task, point, piece)
            if table is None or not np.isfinite(table).all():
                return np.inf
            slopes = _differentiate_by_coefficients(task, point, piece, table[:, -1])
            tables.append((table[:, :-1], slopes @ free, table[:, -1]))
        return compute_restricted_cost(tables, best.used)

    gain = restrict_likelihood(compute_cost, best.point.gain, units)
    if gain is best.point.gain:
        return best
    start = replace(best.point, gain=gain)
    point, found, rss, settled = _minimize_errors(task, start, known, hold_gain=True)
    # The spread is that beside a gain which is not known either.
    factor = _compute_jacobian(task, point)
    spread = _solve_step(task, point, known, factor, rss)[0].spread
    return Minimum(task, point, replace(found, spread=spread), rss, best.residuals, settled)


def add_delay(best: Minimum, known: Sequence[AbstractConstraint]) -> Minimum:
    """Return the minimum that is reached from another one with a free delay, or that one itself."""
    task = replace(best.task, free_delay=True)
    try:
        point, found, rss, settled = _minimize_errors(task, best.point, known)
    except NotExcited:
        return best
    return Minimum(task, point, found, rss, _compute_residuals(task, point), settled)


def colour_noise(white: Minimum, known: Sequence[AbstractConstraint]) -> Minimum:
    """Return the minimum with sensor noise that is a moving average of the best order.

    The order is chosen by the Bayesian criterion, and none is taken that gains nothing by it.
    """
    best, first = white, white.task.structure.na
    for order in range(1, MOST_COLOUR + 1):
        task, tried = replace(white.task, colour=order), []
        # From the white minimum, whose observer took up colour, and from that of sensor noise.
        for gain in (best.point.gain, _find_sensor_gain(best)):
            start = replace(best.point, gain=np.append(gain, np.zeros(first + order - len(gain))))
            # Rounding may have placed a pole of the observer outside the unit circle.
            if not np.isfinite(_evaluate_cost(task, start)[0]):
                continue
            try:
                point, found, rss, settled = _minimize_errors(task, start, known)
            except NotExcited:
                continue
            tried.append(Minimum(task, point, found, rss, _compute_residuals(task, point), settled))
        # The observer does the work of one order by itself, so that one without a gain is no end.
        best = min([best, *tried], key=lambda m: m.criterion)
        if order > best.task.colour + 1:
            break
    return best


def _find_sensor_gain(best: Minimum) -> Array:
    """Return the observer gain of pure sensor noise; that of the minimum where there is none."""
    motion = _discretize_open_loop(best.task, best.point.theta)
    poles = _reflect_poles(best.task, np.linalg.eigvals(motion.f))
    gain = _place_poles(motion.f, motion.c, poles)
    return best.point.gain if gain is None else gain


def _minimize_twice(
    task: Task, point: Point, known: Sequence[AbstractConstraint]
) -> tuple[Point, Found, float, bool]:
    """Refine, and once more from the observer of pure sensor noise.

    At short periods a search may slide along the border where the observer turns unstable, and
    stop there short of the minimum.
    """
    first = _minimize_errors(task, point, known)
    open_loop = _discretize_open_loop(task, first[0].theta)
    gain = _place_poles(
        open_loop.f, open_loop.c, _reflect_poles(task, np.linalg.eigvals(open_loop.f))
    )
    start = first[0] if gain is None else replace(first[0], gain=gain)
    if start is first[0] or not np.isfinite(_evaluate_cost(task, start)[0]):
        return first
    try:
        second = _minimize_errors(task, start, known)
    except NotExcited:
        return first
    return min(first, second, key=lambda r: r[2])


def _reflect_poles(task: Task, poles: Any) -> Array:
    """Reflect poles at the unit circle; none slower than the data are long."""
    size = np.abs(poles)
    most = 1 - SLOWEST / max(p.n for p in task.pieces)
    wanted = np.minimum(np.where(size > 1, 1 / np.maximum(size, 1.0), size), most)
    return np.asarray(poles * wanted / np.maximum(size, 1e-300))


def _discretize_open_loop(task: Task, theta: Array) -> DiscreteModel:
    """Return how the plant's states move by themselves over one period."""
    den = np.concatenate([[1.0], theta[: task.structure.na]])
    return discretize_model(*realize_model(den, np.ones(1), task.speed), task.dt, "zoh")


def _change_speed(task: Task, speed: float) -> Task:
    return replace(task, speed=speed)


def _take_head(pieces: tuple[Piece, ...], samples: int = 8000) -> tuple[Piece, ...]:
    """Return a beginning of the data that is long enough to rank the starts."""
    head: list[Piece] = []
    total = 0
    for piece in pieces:
        take = min(piece.n, samples - total)
        if take < 40 and head:
            break
        signals = {k: s[:take] for k, s in piece.signals.items()}
        head.append(Piece(signals, take, piece.before))
        total += take
    return tuple(head)


def _give_lead(task: Task, delay: float) -> Task:
    """Return the task with stretches that begin only where the input that acts is in the record.

    What u was before a stretch nobody knows. Where it was not what it is at its first sample, a
    simulated delay would have the wrong input for so long.
    """
    samples = math.ceil(delay / task.dt - 1e-9)
    pieces = []
    for piece in task.pieces:
        lead = min(samples, piece.n // SHORTENED)
        signals = {name: s[lead:] for name, s in piece.signals.items()}
        pieces.append(Piece(signals, piece.n - lead, piece.signals["u"][:lead]))
    return replace(task, pieces=tuple(pieces))


def _rank_starts(task: Task, delay: float) -> list[tuple[float, Point]]:
    """Rank poles on a logarithmic grid, with the best numerator for each.

    For given poles the errors are linear in the numerator, with the observer of pure sensor noise
    (unstable poles reflected, Anderson and Moore) a little faster than the poles themselves.
    """
    s, pieces = task.structure, _take_head(task.pieces, 4000)
    length = max(p.n for p in pieces) * task.dt
    rates = np.geomspace(max(3 / length, 1e-3 / task.dt), 1.5 / task.dt, 8)
    levels = [0.0, *rates, *-rates]
    # More than two poles: the others are stable and fast to begin with.
    fast = tuple(-rates[-1] / 2**k for k in range(max(s.na - 2, 0)))
    combinations = [
        (*slow, *fast) for slow in itertools.combinations_with_replacement(levels, min(s.na, 2))
    ]

    def rank(tried: Sequence[tuple[float, ...]], delay: float) -> list[_Start]:
        found = []
        for roots in tried:
            magnitudes = np.maximum(np.abs(roots), rates[0])
            speed = max(float(np.exp(np.mean(np.log(magnitudes)))), rates[0])
            point, rss = _fit_numerator(_change_speed(task, speed), pieces, np.array(roots), delay)
            if point is not None:
                found.append(_Start(rss, speed, point, roots))
        return sorted(found, key=lambda start: start.rss)

    ranked = rank(combinations, delay)
    if not task.free_delay:
        return [(start.speed, start.point) for start in ranked]
    # Steps of Gauss and Newton do not find a delay that is several times as long as u stays alike.
    likely = [start.roots for start in ranked[:6]]
    late = task.dt * 2.0 ** np.arange(np.log2(max(length / task.dt / LONGEST_DELAY, 1.0)))
    delayed = sorted((s for d in late for s in rank(likely, d)), key=lambda start: start.rss)
    # Those without a delay and those with one come in turn, the better ones first.
    mixed = [s for pair in itertools.zip_longest(ranked, delayed) for s in pair if s is not None]
    return [(start.speed, start.point) for start in mixed]


class _Start(NamedTuple):
    """Where a search may begin: the squared errors there, a typical rate, and the poles."""

    rss: float
    speed: float
    point: Point
    roots: tuple[float, ...]


def _fit_numerator(
    task: Task, pieces: tuple[Piece, ...], roots: Array, delay: float
) -> tuple[Point | None, float]:
    s = task.structure
    den = np.real(np.poly(roots))
    blank = Point(np.concatenate([den[1:], np.zeros(s.nb)]), np.zeros(s.na), delay)
    motion = task.discretize(blank.theta, delay)
    plant = motion.f[: s.na, : s.na] if task.circuit is None else None
    if plant is None:
        plant = _discretize_open_loop(task, blank.theta).f
    inside = np.exp(-np.abs(roots) * task.dt) * 0.98
    gain = _place_poles(plant, motion.c[: s.na], inside)
    if gain is None:
        return None, np.inf
    blocks = []
    for piece in pieces:
        table = _compute_columns(task, Point(blank.theta, gain, delay), piece)
        if table is None:
            return None, np.inf
        slopes = []
        for i in range(s.nb):
            theta = blank.theta + _make_unit_vector(len(s.names), s.na + i)
            errors = piece.predict(task.discretize(theta, delay), gain)
            if errors is None:
                return None, np.inf
            slopes.append(errors - table[:, -1])
        # The offset column vanished with the numerator: a constant error does its part.
        table[:, -2] = 1.0
        whole = np.column_stack([table[:, :-1], *slopes, table[:, -1]])
        if not np.isfinite(whole).all():
            return None, np.inf
        blocks.append(triangularize(whole)[table.shape[1] - 1 :, table.shape[1] - 1 :])
    factor = merge_factors(blocks)
    columns = factor[: s.nb, : s.nb]
    if not np.all(np.linalg.norm(columns, axis=0) > 0):
        return None, np.inf
    b = -regress(columns, factor[: s.nb, -1], 1e-12)
    theta = np.concatenate([den[1:], b])
    return Point(theta, gain, delay), float(np.sum(factor[s.nb :, -1] ** 2))


def _place_poles(f: Array, c: Array, poles: Array) -> Array | None:
    """Return the observer gain that puts the poles of ``f - k c`` there (Ackermann)."""
    n = len(f)
    observability = np.vstack([c @ np.linalg.matrix_power(f, i) for i in range(n)])
    value = np.real(np.poly(poles))
    polynomial = sum(
        (v * np.linalg.matrix_power(f, n - i) for i, v in enumerate(value)), np.zeros((n, n))
    )
    try:
        gain = polynomial @ np.linalg.solve(observability, _make_unit_vector(n, n - 1))
    except np.linalg.LinAlgError:
        return None
    return gain if np.isfinite(gain).all() else None
