"""The most likely noise of a loop whose parameters are as they are."""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from ..._base.arrays import Array
from ..._base.criterion import bayesian_penalty
from ..._base.errors import ModelCannotRun
from ..._base.jobs import run_side_by_side
from .kalman_filter import Noise
from .likelihood import Fit, Known, Problem, evaluate_linearized, measure_slope
from .sampled_plant import Linearized, SampledPlant
from .tails import JointTails, Tails, fit_tails, list_tails

# Logarithm of the least variance of a force, below which it affects only the start of a record.
LEAST = -24.0
# Logarithm of the largest variance of a force, above which the sensor counts as exact.
MOST = 14.0
# A coloured force with a time constant above this share of the record would be an offset.
SLOWEST = 0.05
# Sensor noise that rings for tau samples leaves N / 2 tau of log-likelihood to a line within it. At
# this share of the record that is 25, where a name costs 17 in 3000 samples; more would be a line.
RINGING = 0.02
# Derivatives by the logarithm of a variance are differences over this step.
LOG_STEP = 0.2
# Derivatives by the angle of a coefficient are differences over this step: the zero of a random
# walk beside white noise is 0.1 to 0.3 away from the circle, beyond which all comes again.
ANGLE_STEP = 0.05
# Of so many directions all mixed derivatives are differences.
FEW_DIRECTIONS = 3
# Of a step no direction is longer, and none is shortened more often than leads to this brake.
LONGEST_STEP, MOST_BRAKE = 2.5, 1e4
# Above this second derivative by a log variance, a parabola tells how far the minimum is.
CONVEX = 0.05
# Partial autocorrelations are read back from coefficients up to this size.
SURE = 1 - 1e-9
# Coefficients of coloured sensor noise from which a fit starts, and those of an average.
SIZES, AVERAGED = (-0.4, 0.4, 0.8, 0.97), 0.9
# Steps of a random walk from which a fit of one beside white noise starts, over the white noise.
WALKS = (0.01, 0.03, 0.1, 0.3)
# A root this near the limit of what a record tells apart from a random walk lies on it.
ON_THE_LIMIT = 1e-6
# A search for the noise ends where so much of log-likelihood is left to gain.
ENOUGH = 0.02
# Orders of coloured sensor noise: of the autoregression and of the moving average, at most.
ORDERS = 2, 3


def fit_noise(
    problem: Problem, theta: Array, lins: Sequence[Linearized], noise: Noise, wide: bool = False,
    enough: float = ENOUGH, hold_colour: bool = False,
) -> Fit:  # fmt: skip
    """Return the most likely noise for parameters as they are.

    With `hold_colour` the coefficients of coloured sensor noise stay: each of them is a direction
    more of the search, and they hardly move from one candidate to the next.
    """
    plant, dt = problem.plant, problem.plant.loop.dt
    if problem.known is not None:
        return evaluate_linearized(problem, theta, problem.known.noise, lins)

    held = len(noise.ar) + len(noise.ma) if hold_colour else 0
    start = compute_noise_logs(noise, dt)
    start, colour = np.split(start, [len(start) - held])

    def at(logs: Array) -> Noise:
        return make_noise(np.append(logs, colour), noise, dt)

    def measure(logs: Array) -> Fit:
        return evaluate_linearized(problem, theta, at(logs), lins, sensitive=False)

    def find_cost(logs: Array) -> float:
        return _find_cost(measure(logs))

    low, high = (ends[: len(start)] for ends in _bound_logs(problem, noise))
    start = np.clip(start, low, high)
    if wide:
        # Several forces are in the same proportion to what is usual for each.
        apart, rest = low[: plant.channels] - low[0], start[plant.channels :]
        grid = np.linspace(low[0], high[0], 20)
        points = [np.append(np.full(plant.channels, g) + apart, rest) for g in grid]
        start = points[int(np.argmin(run_side_by_side(find_cost, points)))]
    steps = list_difference_steps(noise)[: len(start)]
    best = at(_minimize_by_newton(measure, start, low, high, enough, steps))
    fit = evaluate_linearized(problem, theta, best, lins)
    return fit if noise.tails is None else _refit_tails(fit, hold_colour)


def _refit_tails(fit: Fit, hold_shape: bool) -> Fit:
    """Return the fit with the likeliest tails of its innovations, or as it is where that is less.

    Only the scale moves with `hold_shape`. The filter weighs readings anew, by the new law.
    """
    tails = fit.noise.tails
    assert tails is not None
    if not math.isfinite(fit.value):
        return fit
    noise = replace(fit.noise, tails=replace(tails, scale=float(np.mean(fit.sensor))))
    if not hold_shape and isinstance(tails, JointTails):
        laws = [None if law is None else fit_tails(law, *_list_squares(fit, k))[0]
                for k, law in enumerate(tails.each)]  # fmt: skip
        noise = _give_laws(fit, laws)
    elif not hold_shape:
        assert isinstance(noise.tails, Tails)
        noise = replace(noise, tails=fit_tails(noise.tails, *_list_squares(fit))[0])
    again = evaluate_linearized(fit.problem, fit.theta, noise, fit.linearized)
    return again if again.value > fit.value else fit


def _list_squares(fit: Fit, output: int | None = None) -> tuple[Array, float]:
    """Return squared innovations over their relative variances, and half the sum of their logs."""
    at = slice(None) if output is None else (slice(None), output)
    pairs = [(out.innovations[at][keep[at]] ** 2, out.variance[at][keep[at]])
             for out, keep in zip(fit.filtered, fit.counts, strict=True)]  # fmt: skip
    return (np.concatenate([e / s for e, s in pairs]),
            0.5 * float(sum(np.sum(np.log(s)) for _, s in pairs)))  # fmt: skip


def try_tails(fit: Fit) -> Fit:
    """Return the fit with the heavy tails of the sensor noise that the BIC prefers.

    Student's law and a share of wild readings compete; parameters of the plant stay as they are.
    """
    if not fit.plant.e.siso:
        return _try_joint_tails(fit)
    squares, logs = _list_squares(fit)
    laws = [fit_tails(law, squares, logs) for law in list_tails(squares)]
    tried = []
    for student in (True, False):
        law, _ = max(((t, v) for t, v in laws if bool(t.freedom) == student), key=lambda p: p[1])
        noise = replace(fit.noise, tails=law)
        tried.append(fit_noise(fit.problem, fit.theta, fit.linearized, noise))
    return max(tried, key=compute_noise_criterion)


def _try_joint_tails(fit: Fit) -> Fit:
    """Return the fit with the heavy tails of each output that the BIC prefers, or none.

    A wild reading of one output leads the filter astray, which the others then seem to be: with
    the laws that a first choice gave, each output is asked anew.
    """
    tried = [fit]
    kinds: list[tuple[int, ...]] = []
    while True:
        laws = [_choose_law(tried[-1], k) for k in range(len(fit.plant.e.outputs))]
        kind = tuple(0 if law is None else law.parameters for law in laws)
        if not any(kind) or kind in kinds:
            return max(tried, key=compute_noise_criterion)
        kinds.append(kind)
        noise = _give_laws(tried[-1], laws)
        tried.append(fit_noise(fit.problem, fit.theta, fit.linearized, noise))


def _choose_law(fit: Fit, output: int) -> Tails | None:
    """Return the law of one output's innovations that the BIC prefers; None: a Gaussian one."""
    squares, logs = _list_squares(fit, output)
    size, scale = len(squares), float(np.mean(squares))
    gaussian = -0.5 * size * (math.log(2 * math.pi * scale) + 1) - logs
    each = [fit_tails(law, squares, logs) for law in list_tails(squares)]
    best, value = max(each, key=lambda p: p[1] - bayesian_penalty(p[0].parameters, size))
    better = value - bayesian_penalty(best.parameters, size) > gaussian
    return best if better else None


def _give_laws(fit: Fit, laws: Sequence[Tails | None]) -> Noise:
    """Return the noise with given laws of the outputs, the scale of each told by its own."""
    scales = np.array([np.mean(_list_squares(fit, k)[0]) if law is None else law.scale
                       for k, law in enumerate(laws)])  # fmt: skip
    further = np.array(fit.noise.sensors) * scales[1:] / scales[0]
    return replace(fit.noise, sensors=tuple(further.tolist()),
                   tails=JointTails(tuple(laws), float(scales[0])))  # fmt: skip


def choose_noise_ratio(plant: SampledPlant) -> float:
    """Return the reference ratio of force noise to sensor noise, by the sampling period."""
    return 1.0 / plant.loop.dt ** (2 if plant.e.position_rates else 1)


def choose_force_ratios(problem: Problem) -> Array:
    """Return the reference ratio of each random force to the sensor noise of the first output.

    Of several outputs a force is compared with that on which it shows most: it moves it within a
    period by as much as its own sensor noise.
    """
    plant = problem.plant
    e = plant.e
    if e.siso:
        return np.full(plant.channels, choose_noise_ratio(plant))
    scales = problem.data[0].scales
    a, b, c = plant.linearize_at_rest()
    # The output moves at once, or else after one period more, where a force changes its rate.
    moved = np.abs(c @ b) + np.abs(c @ a @ b)
    shares = moved / (scales / scales[0])[:, None]
    return np.asarray(1.0 / np.maximum(np.max(shares, axis=0), 1e-300))


def compute_noise_logs(noise: Noise, dt: float) -> Array:
    """Return what is searched: logarithms of variances and of the coloured force's time, angles.

    The partial autocorrelations of coloured sensor noise are tanh of the angles of its
    autoregression, which keeps it stationary, and sin of those of its moving average, which
    reaches the zeros on the unit circle that an average over several samples has.
    """
    logs = [*np.log(noise.force), *np.log(noise.sensors)]
    if noise.drift:
        logs += [math.log(noise.coloured), math.log(-dt / math.log(noise.memory))]
    logs += np.arctanh(_compute_reflections(noise.ar)).tolist()
    logs += np.arcsin(_compute_reflections([-v for v in noise.ma])).tolist()
    return np.array(logs)


def list_difference_steps(noise: Noise) -> Array:
    """Return over which steps of the logarithms and angles of a noise differences are taken."""
    angles = len(noise.ar) + len(noise.ma)
    logs = len(noise.force) + len(noise.sensors) + 2 * bool(noise.drift)
    return np.repeat([LOG_STEP, ANGLE_STEP], [logs, angles])


def make_noise(logs: Array, like: Noise, dt: float) -> Noise:
    """Return the noise of the same kind that has such logarithms and angles."""
    channels, p, q = len(like.force), len(like.ar), len(like.ma)
    force = tuple(np.exp(np.clip(logs[:channels], -300, 300)).tolist())
    ar, ma = np.tanh(logs[len(logs) - p - q : len(logs) - q]), np.sin(logs[len(logs) - q :])
    further = channels + len(like.sensors)
    noise = Noise(force, ar=_make_coefficients(ar), ma=tuple(-v for v in _make_coefficients(ma)),
                  sensors=tuple(np.exp(logs[channels:further]).tolist()),
                  tails=like.tails)  # fmt: skip
    if not like.drift:
        return noise
    memory = math.exp(-dt / math.exp(min(max(logs[further + 1], -50), 50)))
    memory = min(max(memory, 1e-6), 1 - 1e-9)
    drift = math.exp(min(max(logs[further], -300), 300)) * (1 - memory**2)
    return replace(noise, memory=memory, drift=drift)


def _make_coefficients(reflections: Iterable[float]) -> tuple[float, ...]:
    """Return the autoregression with given partial autocorrelations, by Levinson's recursion."""
    phi = np.zeros(0)
    for k in reflections:
        phi = np.append(phi - k * phi[::-1], k)
    return tuple(phi.tolist())


def _compute_reflections(coefficients: Sequence[float]) -> Array:
    """Return the partial autocorrelations of an autoregression: Levinson's recursion backwards."""
    phi, found = np.asarray(coefficients, dtype=float), []
    while len(phi):
        k, phi = float(np.clip(phi[-1], -SURE, SURE)), phi[:-1]
        found.append(k)
        phi = (phi + k * phi[::-1]) / (1 - k**2)
    return np.array(found[::-1])


def _bound_logs(problem: Problem, noise: Noise) -> tuple[Array, Array]:
    """Return bounds of the logarithms of the noise variances, and of the angles.

    A force that hardly changes during a record is an offset, not noise.
    """
    units, dt = [2 * math.log(v) for v in choose_force_ratios(problem)], problem.plant.loop.dt
    low, high = [unit + LEAST for unit in units], [unit + MOST for unit in units]
    scales = problem.data[0].scales
    usual = [2 * math.log(scale / scales[0]) for scale in scales[1 : 1 + len(noise.sensors)]]
    low, high = [*low, *(v - MOST for v in usual)], [*high, *(v + MOST for v in usual)]
    if noise.drift:
        unit, longest = units[0], _find_longest_record(problem)
        low += [unit + LEAST, math.log(2 * dt)]
        high += [unit + MOST, math.log(max(min(SLOWEST * longest, 2e4), 4.0) * dt)]
    # A random walk stays one, since a root that leaves its limit is a parameter more.
    slowest = math.atanh(_find_slowest_root(problem))
    ringing = math.atanh(math.exp(-2 / max(RINGING * _find_longest_record(problem), 2.0)))
    walks = _compute_reflections(noise.ar) > _find_slowest_root(problem) - ON_THE_LIMIT
    least = [-slowest, *[-ringing] * (len(walks) - 1)][: len(walks)]
    low += [*np.where(walks, slowest, least), *[-math.pi] * len(noise.ma)]
    high += [*[slowest] * len(walks), *[math.pi] * len(noise.ma)]
    return np.array(low), np.array(high)


def _find_longest_record(problem: Problem) -> int:
    """Return the number of samples of the longest record."""
    return max(len(data.record) for data in problem.data)


def _find_slowest_root(problem: Problem) -> float:
    """Return the slowest root of coloured sensor noise, which is a random walk to a record.

    Sensor noise that is correlated over more than the record would be an offset.
    """
    return 1 - 1 / _find_longest_record(problem)


def _find_cost(fit: Fit) -> float:
    """Return the cost of a fit; a lost record has a large one."""
    return -fit.value if np.isfinite(fit.value) else 1e15


def _minimize_by_newton(
    measure: Callable[[Array], Fit], x: Array, low: Array, high: Array, enough: float, h: Array
) -> Array:
    """Minimise a smooth function by damped Newton steps with differences of the widths `h`.

    Where a step gained what the parabola g^2/2h foresaw but for e, a function with a third
    derivative has e^2 / (g^2/2h) * 9/4 left to gain: on a line that tells the end. With more
    directions the errors of several may cancel. Of many directions, mixed derivatives are those
    of the information, since there would be far more of them than of all else.
    """
    n = len(x)
    few = n <= FEW_DIRECTIONS
    pairs = list(itertools.combinations(range(n), 2)) if few else []
    unit = np.eye(n)
    around = np.vstack([unit, -unit, *(unit[i] + unit[j] for i, j in pairs)])

    def look(point: Array) -> tuple[float, list[tuple[Array, Array]]]:
        fit = measure(point)
        return _find_cost(fit), [] if few else _list_innovations(fit)

    here, damping = _find_cost(measure(x)), 0.1
    for _ in range(12):
        found = run_side_by_side(look, np.clip(x + h * around, low, high))
        ups, downs, both = np.split(np.array([cost for cost, _ in found]), [n, 2 * n])
        slope = (ups - downs) / (2 * h)
        hessian = np.diag((ups + downs - 2 * here) / h**2)
        for (i, j), value in zip(pairs, both, strict=True):
            hessian[i, j] = hessian[j, i] = (value - ups[i] - ups[j] + here) / (h[i] * h[j])
        if not few:
            widths = np.sqrt(np.abs(np.diag(hessian)))
            moved = [parts for _, parts in found]
            mixed = _correlate_directions(moved[:n], moved[n:]) * np.outer(widths, widths)
            hessian += mixed - np.diag(np.diag(mixed))
        values, vectors = np.linalg.eigh(hessian)
        convex = n == 1 and values[0] > CONVEX
        values, turned = np.maximum(np.abs(values), 1e-3), vectors.T @ slope
        # All directions are shortened alike: a damping of the curvatures would stop the flat ones.
        brake = 0.0
        while True:
            step = -turned / (values * (1 + brake) + damping)
            trial = np.clip(x + vectors @ np.clip(step, -LONGEST_STEP, LONGEST_STEP), low, high)
            taken = vectors.T @ (trial - x)
            foreseen = -float((turned + 0.5 * values * taken) @ taken)
            if convex and foreseen < 0.1 * enough:
                return x
            there = _find_cost(measure(trial))
            if there <= here or brake > MOST_BRAKE:
                break
            brake = 4 * brake + 1.0
        gain = here - there
        if gain <= 0:
            break
        x, here, damping = trial, there, damping / 10
        if gain < enough and not brake:
            break
        if convex:
            # This slope of the quadratic model is left after the step.
            slope_left = turned + values * taken
            left = (
                0.5 * float(slope_left @ (slope_left / values))
                + 2.25 * (gain - foreseen) ** 2 / foreseen
            )
            if left < 0.5 * enough:
                break
    return x


def _list_innovations(fit: Fit) -> list[tuple[Array, Array]]:
    """Return the innovations of each record and the logarithms of their variances."""
    return [(out.innovations[keep], np.log(out.variance[keep] * r))
            for out, keep, r in zip(fit.filtered, fit.counts, fit.sensor, strict=True)]  # fmt: skip


def _correlate_directions(
    ups: Sequence[list[tuple[Array, Array]]], downs: Sequence[list[tuple[Array, Array]]]
) -> Array:
    r"""Return the information on steps in several directions, scaled to a unit diagonal.

    .. math:: \sum_k \frac{\Delta_i e_k \Delta_j e_k}{s_k}
        + \tfrac12 \Delta_i \ln s_k \, \Delta_j \ln s_k

    with the differences of innovations e and logarithms of their variances s between both ends of a
    step, the mean of the latter taken out, for the size of all noise is fitted along.
    """
    rows = []
    for up, down in zip(ups, downs, strict=True):
        parts = []
        for (e1, logs1), (e0, logs0) in zip(up, down, strict=True):
            turned = (logs1 - logs0) / math.sqrt(2.0)
            parts += [(e1 - e0) / np.exp(0.25 * (logs1 + logs0)), turned - turned.mean()]
        rows.append(np.concatenate(parts))
    moves = np.nan_to_num(np.array(rows), nan=0.0, posinf=0.0, neginf=0.0)
    moves /= np.maximum(np.linalg.norm(moves, axis=1), 1e-300)[:, None]
    return np.asarray(moves @ moves.T)


def try_coloured_force(fit: Fit) -> Fit:
    """Return the fit with a coloured force added, whether or not the BIC prefers it."""
    dt = fit.plant.loop.dt
    force, whole = tuple(0.5 * v for v in fit.noise.force), sum(fit.noise.force)
    memories = [math.exp(-dt / time) for time in (3 * dt, 30 * dt, 300 * dt)]
    noises = [
        Noise(force, memory, share * whole * (1 - memory**2), tails=fit.noise.tails)
        for memory in memories
        for share in (1e-2, 1.0)
    ]
    best, value = _find_likeliest(fit, noises)
    if not np.isfinite(value):
        raise ModelCannotRun(f"no coloured force can be fitted to {fit.plant.e.name}")
    return fit_noise(fit.problem, fit.theta, fit.linearized, best)


def _find_likeliest(fit: Fit, noises: Sequence[Noise]) -> tuple[Noise, float]:
    """Return the likeliest of several noises with all else as it is, and its likelihood."""

    def measure(noise: Noise) -> float:
        value = evaluate_linearized(
            fit.problem, fit.theta, noise, fit.linearized, sensitive=False
        ).value
        return value if np.isfinite(value) else -math.inf

    values = run_side_by_side(measure, noises)
    k = int(np.argmax(values))
    return noises[k], values[k]


def try_coloured_sensor(fit: Fit, most: int = sum(ORDERS)) -> Fit:
    """Return the fit with the coloured sensor noise that the BIC prefers, no coloured force beside.

    Parameters of the plant stay as they are. From the first order on, a coefficient more is tried
    on either side until none pays. A random walk beside white noise, which hardly shows in any
    coefficient alone, is tried by itself.

    Parameters
    ----------
    fit : Fit
        The fit.
    most : int, optional
        Number of coefficients at most, one or more.

    References
    ----------
    Hannan and Rissanen, Biometrika 69 (1982) 81-94, for the choice of orders by a criterion.
    """
    forces = _list_smaller_forces(fit)
    tails = fit.noise.tails
    values: list[tuple[float, ...]] = [(v,) for v in SIZES]

    def fit_moving(starts: Sequence[tuple[float, ...]]) -> Fit:
        return _fit_best(fit, [Noise(f, ma=ma, tails=tails) for f in forces for ma in starts])

    # A converter that averages samples has zeros on the unit circle, all of which it needs at once,
    # and which a search from within nears ever more slowly.
    averages: list[list[tuple[float, ...]]]
    averages = [[(AVERAGED,) * q, (1.0,) * q] for q in range(1, min(ORDERS[1], most) + 1)]
    averages[0] = [*values, (1.0,)]
    chains = [
        _fit_best(fit, [Noise(f, ar=ar, tails=tails) for f in forces for ar in values]),
        max((fit_moving(each) for each in averages), key=compute_noise_criterion),
    ]
    if most > 1:
        chains.append(_fit_best(fit, list(_list_walks(fit, forces))))
    reached: dict[tuple[int, int], float] = {}
    return max((_lengthen_sensor_noise(f, most, reached) for f in chains),
               key=compute_noise_criterion)  # fmt: skip


def measure_walk_gain(fit: Fit) -> float:
    """Return what a random walk of the sensor gains at once, in place of a coloured force.

    Parameters of the plant stay as they are, and the noise is the best of a few.
    """
    noise, value = _find_likeliest(fit, list(_list_walks(fit, _list_smaller_forces(fit))))
    walking = replace(fit, noise=noise, value=value)
    return compute_noise_criterion(walking) - compute_noise_criterion(fit)


def _list_smaller_forces(fit: Fit) -> list[tuple[float, ...]]:
    shares = (1.0, 1e-2, 1e-4, 1e-6, 1e-8)
    return [tuple(share * v for v in fit.noise.force) for share in shares]


def _list_walks(fit: Fit, forces: Sequence[tuple[float, ...]]) -> Iterable[Noise]:
    """Return sensor noises that are random walks beside white noise."""
    root = _find_slowest_root(fit.problem)
    for force, step in itertools.product(forces, WALKS):
        yield Noise(force, ar=(root,), ma=(-root * (1 - step),), tails=fit.noise.tails)


def count_noise_parameters(fit: Fit) -> int:
    """Return how many parameters of the noise are free.

    A root of the sensor noise at its limit is that of a random walk, and is no free parameter.
    """
    noise = fit.noise
    if not noise.ar:
        return noise.parameters
    slowest = _find_slowest_root(fit.problem)
    walks = np.max(_compute_reflections(noise.ar)) > slowest - ON_THE_LIMIT
    return noise.parameters - int(walks)


def compute_noise_criterion(fit: Fit) -> float:
    """Return the log-likelihood less the penalty for the parameters of the noise."""
    value = fit.value - bayesian_penalty(count_noise_parameters(fit), fit.size)
    return value if np.isfinite(value) else -math.inf


def _fit_best(fit: Fit, noises: Sequence[Noise]) -> Fit:
    """Return the fit with the noise fitted from the likeliest of several."""
    best, _ = _find_likeliest(fit, noises)
    return fit_noise(fit.problem, fit.theta, fit.linearized, best)


def _lengthen_sensor_noise(fit: Fit, most: int, reached: dict[tuple[int, int], float]) -> Fit:
    """Return the fit with coefficients added to its sensor noise while the BIC wants them.

    `reached` keeps what was reached with each pair of orders. From orders that another search has
    passed as likely, nothing else is reached.
    """
    while True:
        noise, dt, value = fit.noise, fit.plant.loop.dt, compute_noise_criterion(fit)
        logs = compute_noise_logs(noise, dt)
        orders = p, q = len(noise.ar), len(noise.ma)
        if value <= reached.get(orders, -math.inf) + ENOUGH or p + q >= most:
            return fit
        reached[orders] = value
        tried = []
        for longer, at, more in (
            (replace(noise, ar=(*noise.ar, 0.0)), len(logs) - q, p < ORDERS[0]),
            (replace(noise, ma=(*noise.ma, 0.0)), len(logs), q < ORDERS[1]),
        ):
            if not more:
                continue
            near = [make_noise(np.insert(logs, at, v), longer, dt) for v in (-0.5, 0.05, 0.5)]
            tried.append(_fit_best(fit, near))
        better = max(tried, key=compute_noise_criterion, default=fit)
        if compute_noise_criterion(better) <= value:
            return fit
        fit = better


def estimate_noise_from_repeats(fit: Fit, periods: Sequence[int]) -> Known:
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
    plain = fit_noise(problem, fit.theta, fit.linearized, Noise(fit.noise.force), wide=True)
    richer = try_coloured_force(plain)
    best = richer if richer.value > plain.value + bayesian_penalty(2, fit.size) else plain
    return Known(best.noise, best.sensor, measure_slope(best.linearized))
