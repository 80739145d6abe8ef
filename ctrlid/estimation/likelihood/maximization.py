"""The maximum of the likelihood by Gauss-Newton steps, and the information matrix there."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from ..._base.arrays import Array
from ..._base.criterion import bayesian_penalty
from ..._base.errors import EffectDoesNotApply, ModelCannotRun
from ..._base.statistics import pseudo_inverse
from ...loop.loop import replace_effect_values, sharpen_effects
from .filter_data import prepare_for_loop
from .kalman_filter import (
    Noise,
    carry_trajectory,
    choose_settled_samples,
    converge_trajectory,
    guess_trajectory,
    linearize_inside_domain,
)
from .likelihood import (
    Fit,
    Known,
    Problem,
    evaluate_likelihood,
    list_start_values,
    rank_by_likelihood,
    relinearize_fit,
)
from .noise.coordinates import (
    choose_force_ratios,
    compute_noise_criterion,
    compute_noise_logs,
    list_difference_steps,
    make_noise,
)
from .noise.fit import ENOUGH, fit_noise, try_tails
from .noise.orders import try_coloured_force, try_coloured_sensor
from .sampled_plant import SampledPlant
from .tails import choose_law, compute_information_shares

# A climb ends after at most so many Gauss-Newton steps.
ROUNDS = 25
# After a step of more standard errors the plant is linearized again along the new trajectory.
RELINEARIZED_BEYOND = 3.0
# A climb has converged when its step is shorter than so many standard errors.
CONVERGED_STEP = 0.02
# These shares of a step are tried in turn until the likelihood grows.
SHARES = tuple(3.0**-k for k in range(6))
# From so many of the longest shares a second step may lead higher along a curved ridge.
SECOND_STEP_SHARES = 2
# A second step is tried only where the first one is expected to gain so much log-likelihood, since
# it hardly ever helps elsewhere.
SECOND_STEP_GAIN = 30.0
# Noise found far away must gain so much log-likelihood before the climb goes on from there.
OTHER_NOISE_GAIN = 2.0
# A force is hardly any with so small a share of its variance.
QUIET = 1e-4
# On the way there it has these shares in turn.
QUIETER = (1e-1, 1e-2, 1e-3, QUIET)
# A trajectory has settled where linearizing along it changes the log-likelihood by less.
SETTLED_VALUE = 1.0
# Passes from a trajectory near the record to that of the model.
FOLLOWING_PASSES = 3
# A step that is expected to gain less log-likelihood is not worth its evaluation.
LEAST_STEP_GAIN = 1e-3


def begin_fit(problem: Problem, theta: Array | None = None, noise: Noise | None = None) -> Fit:
    """Return the likelihood at a starting point, along converged trajectories.

    Parameters
    ----------
    problem : Problem
        What is fitted; without `counts` the samples that count are chosen here.
    theta : ndarray, shape (p,), optional
        Parameter values; by default those of the loop.
    noise : Noise, optional
        The noise; by default estimated.

    Returns
    -------
    Fit
        The starting point.

    Raises
    ------
    ModelCannotRun
        If the filter cannot follow the record with this model.
    """
    noise = problem.known.noise if problem.known else noise
    theta = list_start_values(problem.plant.loop, problem.plant.names) if theta is None else theta
    if problem.plant.loop.sharpness > 1 and problem.plant.e.kinked:
        return _begin_with_abrupt_friction(problem, theta, noise)
    beside = bool(problem.plant.loop.effects)
    found = []
    try:
        fit = _begin_with_noise(problem, theta, noise)
        # A position that no output shows is guessed to rest, from where a filter may stay lost.
        hidden = len(problem.plant.e.velocities) > len(problem.plant.e.outputs)
        if not beside or (_stays_inside_domain(fit) and not hidden):
            return fit
        found.append(fit)
    except ModelCannotRun:
        if not beside:
            raise
    try:
        found.append(_begin_beside_effects(problem, theta, noise))
    except ModelCannotRun:
        if not found:
            raise
    return max(found, key=rank_by_likelihood)


def _begin_with_abrupt_friction(problem: Problem, theta: Array, noise: Noise | None) -> Fit:
    """Return the starting point with friction that is made twice as abrupt again and again.

    From a guess a trajectory does not settle where friction is abrupt; it does from one along which
    that is half as abrupt.
    """
    plant = problem.plant
    sharpness, fit = 1.0, begin_fit(replace_sharpness(problem, 1.0), theta, noise)
    while sharpness < plant.loop.sharpness:
        sharpness = min(2 * sharpness, plant.loop.sharpness)
        there = replace_sharpness(fit.problem, sharpness)
        fit = evaluate_likelihood(there, theta, fit.noise, fit.trajectories)
        fit = relinearize_fit(fit)
    return evaluate_likelihood(
        replace(fit.problem, plant=plant), theta, fit.noise, fit.trajectories
    )


def replace_sharpness(problem: Problem, sharpness: float) -> Problem:
    """Return a problem whose friction is so many times as abrupt as that of the first filter."""
    plant = problem.plant
    return replace(
        problem, plant=plant.of_loop(sharpen_effects(plant.loop, sharpness), plant.names)
    )


def _stays_inside_domain(fit: Fit) -> bool:
    """Whether a fit follows the records without leaving where the plant is defined."""
    if not math.isfinite(fit.value):
        return False
    pairs = zip(fit.data, fit.trajectories, strict=True)
    return all(linearize_inside_domain(fit.plant, one, fit.theta, at)[0] is at
               for one, at in pairs)  # fmt: skip


def _begin_beside_effects(problem: Problem, theta: Array, noise: Noise | None) -> Fit:
    """Return the starting point along the trajectory of the plant without its effects.

    Dry friction in a plant that is unstable and hardly measured makes a filter lose the record from
    a guess, though not from a trajectory that is nearly right.
    """
    plant = problem.plant
    loop = replace(plant.loop, effects=(), free=())
    own = [k for k, name in enumerate(plant.names) if "." not in name]
    bare = plant.of_loop(loop, tuple(plant.names[k] for k in own))
    data = tuple(prepare_for_loop(one, loop) for one in problem.data)
    simple = replace(
        problem, plant=bare, data=data, lower=problem.lower[own], upper=problem.upper[own]
    )
    known = maximize(_begin_with_noise(simple, theta[own], noise if problem.known else None))
    at = [
        carry_trajectory(bare, plant, out.trajectory, guess_trajectory(plant, one))
        for out, one in zip(known.filtered, problem.data, strict=True)
    ]
    there = replace(problem, counts=known.counts)
    fit = evaluate_likelihood(there, theta, noise or known.noise, at)
    if not math.isfinite(fit.value):
        raise ModelCannotRun(
            f"the Kalman filter of {plant.e.name} loses the record with its effects: the model "
            "contradicts the record. Check units, signs and the operating point"
        )
    return fit


def guess_noise(problem: Problem) -> Noise:
    """Return noise to begin with: a random force that moves the output by a tenth of the sensor's.

    Within a period, that is.
    """
    scales = problem.data[0].scales
    return Noise(
        tuple(float(v) ** 2 * 1e-2 for v in choose_force_ratios(problem)),
        sensors=tuple((float(scale) / float(scales[0])) ** 2 for scale in scales[1:]),
    )


def _begin_with_noise(problem: Problem, theta: Array, noise: Noise | None) -> Fit:
    plant = problem.plant
    first = noise or guess_noise(problem)
    guessed = []
    for data in problem.data:
        at = guess_trajectory(plant, data)
        if noise is None:
            at = converge_trajectory(plant, data, theta, first, at, passes=2)[1].trajectory
        guessed.append((data, at))
    if noise is None:
        lins = tuple(linearize_inside_domain(plant, data, theta, at)[1] for data, at in guessed)
        counts = tuple(data.usable for data in problem.data)
        first = fit_noise(replace(problem, counts=counts), theta, lins, first, wide=True).noise
    results = [converge_trajectory(plant, data, theta, first, at) for data, at in guessed]
    if not problem.counts:
        pairs = zip(problem.data, results, strict=True)
        counts = tuple(choose_settled_samples(data, out) for data, (_, out) in pairs)
        problem = replace(problem, counts=counts)
    fit = evaluate_likelihood(problem, theta, first, [out.trajectory for _, out in results])
    return _follow_records(fit)


def _follow_records(fit: Fit) -> Fit:
    """Return a fit, begun along trajectories that stay near the records if its own do not settle.

    Where dry friction sticks and hardly any force is random, linearizing along the last trajectory
    may lead from one wrong one to the next. A force that moves the output by as much as the noise
    of the sensor within a period keeps the filter near the record, and from there it settles.
    """
    again = relinearize_fit(fit)
    if math.isfinite(fit.value) and abs(again.value - fit.value) < SETTLED_VALUE:
        return fit
    loud = replace(fit.noise, force=tuple((choose_force_ratios(fit.problem) ** 2).tolist()))
    try:
        results = [
            converge_trajectory(fit.plant, one, fit.theta, loud, guess_trajectory(fit.plant, one))
            for one in fit.data
        ]
    except ModelCannotRun:
        return fit
    at = [out.trajectory for _, out in results]
    near = evaluate_likelihood(fit.problem, fit.theta, fit.noise, at)
    for _ in range(FOLLOWING_PASSES):
        near = relinearize_fit(near)
    return max(fit, near, key=rank_by_likelihood)


def maximize(fit: Fit, rounds: int = ROUNDS, exact: bool = True) -> Fit:
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
        Whether to end with steps on the likelihood itself, and to fit the colour of the sensor
        noise along, which else stays.

    Returns
    -------
    Fit
        The maximum, or the best point found.
    """

    def tune(fit: Fit) -> Fit:
        return fit_noise(
            fit.problem, fit.theta, fit.linearized, fit.noise, enough=enough, hold_colour=not exact
        )

    tuned, far, enough = -math.inf, True, ENOUGH if exact else 0.3
    if not fit.linearized:
        fit, far = relinearize_fit(fit), False
        if not math.isfinite(fit.value):
            return fit
    for _ in range(rounds):
        # A short step was already evaluated along the trajectory of the pass before.
        again = relinearize_fit(fit) if far else fit
        fit = again if np.isfinite(again.value) else fit
        if fit.value > tuned + 2.0:
            fit = tune(fit)
            tuned = fit.value
        fit, length = _take_step(fit, *fit.normal)
        far = bool(length > RELINEARIZED_BEYOND)
        if length < (CONVERGED_STEP if exact else 5 * CONVERGED_STEP):
            if fit.value <= tuned + 2.5 * enough:
                break
            fit = tune(fit)
            tuned = fit.value
    return polish_fit(fit) if exact else fit


def refit_noise_size(fit: Fit) -> Fit:
    """Return the fit continued from the best noise of the whole range, if that is far better.

    A random force that stood for a wrong parameter at the start may have left no noise to the
    sensor, from where small changes lead nowhere.
    """
    plain = fit.noise.plain
    other = fit_noise(fit.problem, fit.theta, fit.linearized, plain, wide=True)
    return maximize(other) if other.value > fit.value + OTHER_NOISE_GAIN else fit


def refit_quiet_force(fit: Fit) -> Fit:
    """Return the fit of a plant with kinks continued from hardly any force, if that is far better.

    For a model that is taken to be complete. Beside one that still lacks something a random force
    stands for it, and without any the parameters would.
    """
    if not fit.plant.e.kinked or fit.known is not None:
        return fit
    quiet = maximize(climb_under_quiet_force(fit))
    return quiet if quiet.value > fit.value + OTHER_NOISE_GAIN else fit


def climb_under_quiet_force(fit: Fit) -> Fit:
    """Return the start of a climb from the best parameters under hardly any random force.

    Under a large force a filter averages over where a mass sticks, and friction that is averaged
    leaves much to a force: the likelihood has a maximum with and one without it. From the former no
    climb leads to the latter while the noise is free.
    """
    return replace(maximize_under_quiet_force(fit), problem=fit.problem)


def maximize_under_quiet_force(fit: Fit) -> Fit:
    """Return the maximum under hardly any random force, with the noise held.

    The force becomes quieter by and by, each climb begun where the one before it ended. Friction
    that was fitted beside a large force makes a filter with hardly any lose the record at once.
    """
    noise = fit.noise
    for share in QUIETER:
        quieter = quieten_force(noise, share)
        held = replace(fit, noise=quieter, problem=replace(fit.problem, known=Known(quieter)))
        fit = maximize(held, exact=False)
    return fit


def quieten_force(noise: Noise, share: float = QUIET) -> Noise:
    """Return noise with a share of its random force, which is hardly any by default."""
    return replace(noise, force=tuple(share * v for v in noise.force))


def choose_noise(fit: Fit, always: bool = False) -> Fit:
    """Add a coloured force if the Bayesian information criterion wants it.

    A record that the model loses under a white force tells nothing of a colour.
    """
    lost = not math.isfinite(fit.value)
    if fit.known is not None or ((lost or not fit.plant.e.siso) and not always):
        return fit
    try:
        richer = try_coloured_force(fit)
    except ModelCannotRun:
        if always:
            raise
        return fit
    # A coloured force is refitted only if it gains at once half the penalty of its two parameters.
    if not always and richer.value < fit.value + bayesian_penalty(1, fit.size):
        return fit
    richer = maximize(richer)
    return richer if always or richer.value > fit.value + bayesian_penalty(2, fit.size) else fit


def choose_sensor_noise(fit: Fit, beside: bool = False) -> Fit:
    """Return the fit with coloured sensor noise if the BIC wants it, in place of a coloured force.

    Both explain much of the same, so the likelihood decides between them. It may also stand
    `beside` the force: together they explain nearly everything, a missing effect as well.
    """
    if fit.known is not None:
        return fit
    richer, promised = _colour_sensor(fit)
    least = compute_noise_criterion(fit)
    if beside and fit.noise.drift:
        both, _ = _colour_sensor(fit, beside=True)
        richer = max(richer, both, key=compute_noise_criterion)
    if not compute_noise_criterion(richer) > least and promised > least and fit.noise.drift:
        # A coloured force that stood for the colour may have led a parameter so far astray that the
        # climb beside the colour loses the record.
        richer, _ = _colour_sensor(maximize(replace(fit, noise=fit.noise.plain)))
    if not compute_noise_criterion(richer) > least:
        return fit
    # The orders were chosen beside parameters that the colour has moved since: what was made up
    # there for wrong parameters needs fewer coefficients now, or as many others.
    count = len(richer.noise.ar) + len(richer.noise.ma)
    for most in range(max(count - 1, 1), count + 1):
        anew = try_coloured_sensor(richer, most, beside=bool(richer.noise.drift))
        if compute_noise_criterion(anew) > compute_noise_criterion(richer) + OTHER_NOISE_GAIN:
            return maximize(anew)
    return richer


def _colour_sensor(fit: Fit, beside: bool = False) -> tuple[Fit, float]:
    """Return the fit with coloured sensor noise, and the criterion that it had at the start.

    A coloured force may stay `beside` it.
    """
    start = try_coloured_sensor(fit, beside=beside)
    richer = maximize(start)
    # A force that stood for the colour may have led a parameter astray, which needs it there.
    quiet = maximize(replace(richer, noise=quieten_force(richer.noise)), exact=False)
    if quiet.value > richer.value + OTHER_NOISE_GAIN:
        anew = try_coloured_sensor(relinearize_fit(quiet), beside=beside)
        richer = maximize(max(quiet, anew, key=compute_noise_criterion))
    return richer, compute_noise_criterion(start)


def choose_tails(fit: Fit) -> Fit:
    """Return the fit with heavy tails of the sensor noise if the BIC wants them."""
    if fit.known is not None:
        return fit
    richer = maximize(try_tails(fit))
    return max(fit, richer, key=compute_noise_criterion)


def compute_expected_gain(fit: Fit) -> float:
    """Return the gain that a Gauss-Newton step within the bounds expects."""
    matrix, score = fit.normal
    return 0.5 * float(score @ compute_bounded_step(fit, matrix, score)[0])


def compute_bounded_step(fit: Fit, matrix: Array, score: Array) -> tuple[Array, Array]:
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


def _take_step(fit: Fit, matrix: Array, score: Array) -> tuple[Fit, float]:
    """Take a Gauss-Newton step, or as much of it as makes the likelihood grow.

    Returns
    -------
    fit : Fit
        A better point, or the same.
    length : float
        Length of the step in standard errors; zero if none is better.
    """
    problem = fit.problem
    whole, error = compute_bounded_step(fit, matrix, score)
    expected = 0.5 * float(score @ whole)
    if not np.isfinite(whole).all() or expected < LEAST_STEP_GAIN:
        return fit, 0.0
    for k, step in enumerate(share * whole for share in SHARES):
        theta = np.clip(fit.theta + step, problem.lower, problem.upper)
        try:
            _refuse_conflicts(problem.plant, theta)
            if not problem.plant.is_built_for(theta):
                problem, fit = _rebuild_plant(fit, theta)
            trial = evaluate_likelihood(problem, theta, fit.noise, fit.trajectories)
            worse = not trial.value >= fit.value - 1e-6
            if (
                worse
                and k < SECOND_STEP_SHARES
                and expected > SECOND_STEP_GAIN
                and np.isfinite(trial.value)
            ):
                trial = _take_second_step(trial)
                worse = not trial.value > fit.value + LEAST_STEP_GAIN
        except (ModelCannotRun, EffectDoesNotApply):
            # Too far: what moves so fast is no longer followed.
            continue
        if np.isfinite(trial.value) and not worse:
            return trial, float(np.max(np.abs(trial.theta - fit.theta) / error, initial=0.0))
    return fit, 0.0


def _take_second_step(fit: Fit) -> Fit:
    """Return where a whole Gauss-Newton step leads from a point that may lie beside the ridge.

    Where a product of two parameters is all that the record knows, the ridge is curved: along its
    tangent only short steps climb, but a long one and a second from there come back to it.
    """
    there, problem = relinearize_fit(fit), fit.problem
    step, _ = compute_bounded_step(there, *there.normal)
    theta = np.clip(there.theta + step, problem.lower, problem.upper)
    if not problem.plant.is_built_for(theta):
        return fit
    _refuse_conflicts(problem.plant, theta)
    return evaluate_likelihood(problem, theta, there.noise, there.trajectories)


def _refuse_conflicts(plant: SampledPlant, theta: Array) -> None:
    """Refuse values that exclude each other by `EffectDoesNotApply`.

    The likelihood has a value beyond, as with a lower limit above the upper one, but no effect has.
    """
    replace_effect_values(plant.loop, dict(zip(plant.names, theta.tolist(), strict=True)))


def _rebuild_plant(fit: Fit, theta: Array) -> tuple[Problem, Fit]:
    """Return the problem with a plant for the delay that `theta` has."""
    names = fit.plant.names
    loop = fit.plant.loop.with_parameters(dict(zip(names, theta.tolist(), strict=True)))
    problem = replace(fit.problem, plant=fit.plant.of_loop(loop, names))
    return problem, replace(fit, problem=problem)


def polish_fit(fit: Fit, rounds: int = 2) -> Fit:
    """Take Newton steps on the likelihood itself, by differences over half a standard error."""
    for _ in range(rounds):
        matrix, _ = fit.normal
        _, error = compute_bounded_step(fit, *fit.normal)
        score, known = np.zeros(len(fit.theta)), np.isfinite(error)
        at = fit.trajectories
        fit = evaluate_likelihood(fit.problem, fit.theta, fit.noise, at)
        for k in np.flatnonzero(known):
            values = []
            ends = np.clip(
                fit.theta[k] + np.array([-0.5, 0.5]) * error[k],
                fit.problem.lower[k], fit.problem.upper[k],
            )  # fmt: skip
            for end in ends:
                theta = fit.theta.copy()
                theta[k] = end
                values.append(evaluate_likelihood(fit.problem, theta, fit.noise, at).value)
            if ends[1] > ends[0] and np.isfinite(values).all():
                score[k] = (values[1] - values[0]) / (ends[1] - ends[0])
        if not known.any():
            return fit
        fit, length = _take_step(fit, matrix, score)
        if length < 0.05:
            break
    tuned = fit_noise(fit.problem, fit.theta, fit.linearized, fit.noise)
    return tuned if tuned.value > fit.value else fit


def compute_information(fit: Fit) -> tuple[Array, Array]:
    r"""Return the exact Fisher information of parameters and noise, and the score.

    .. math:: I = \sum_k \frac{1}{s_k} \frac{\partial e_k}{\partial\eta}
        \frac{\partial e_k}{\partial\eta}^T + \frac{1}{2 s_k^2}
        \frac{\partial s_k}{\partial\eta} \frac{\partial s_k}{\partial\eta}^T

    over parameters, logarithms of the noise ratios and of each record's sensor variance, with the
    gain of the filter moving with them, and what is believed of the parameters added.

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
    problem = fit.problem
    dt, p = fit.plant.loop.dt, len(fit.theta)
    at = fit.trajectories
    _, error = compute_bounded_step(fit, *fit.normal)
    logs = compute_noise_logs(fit.noise, dt) if problem.known is None else np.zeros(0)

    def compute_innovations(theta: Array, noise: Noise) -> Any:
        out = evaluate_likelihood(problem, theta, noise, at).filtered
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
            pair.append(compute_innovations(theta, fit.noise))
        columns.append(_divide_difference(pair, float(ends[1] - ends[0])))
    for k, width in enumerate(list_difference_steps(fit.noise)[: len(logs)]):
        pair = []
        for h in (-width, width):
            shifted = logs.copy()
            shifted[k] += h
            pair.append(compute_innovations(fit.theta, make_noise(shifted, fit.noise, dt)))
        columns.append(_divide_difference(pair, 2 * float(width)))
    law = fit.noise.tails
    shares = compute_information_shares(law)
    count, records = len(columns), len(problem.data) if problem.known is None else 0
    matrix = np.zeros((count + records, count + records))
    score = np.zeros(count + records)
    for k, (out, keep, r) in enumerate(zip(fit.filtered, problem.counts, fit.sensor, strict=True)):
        s, e = out.variance[keep] * r, out.innovations[keep]
        size = np.zeros((len(e), records))
        size[:, k : k + 1] = 1.0
        z2 = e**2 / s
        # Of several outputs each has its own share, which all its samples have.
        mean, scale = (np.broadcast_to(v, keep.shape)[keep] if np.ndim(v) else v for v in shares)
        tails = choose_law(law, keep)
        if tails is not None:
            w = tails.compute_weight(np.sqrt(z2))
            e, z2 = w * e, w * z2
        slopes = np.column_stack([c[k][0] for c in columns] + [np.zeros_like(size)])
        widths = np.column_stack([c[k][1] for c in columns] + [size])
        matrix += mean * (slopes / s[:, None]).T @ slopes + 0.5 * scale * widths.T @ widths
        score += -slopes.T @ (e / s) + 0.5 * widths.T @ (z2 - 1)
    believed, information = problem.beliefs
    matrix[range(p), range(p)] += information
    score[:p] -= information * (fit.theta - believed)
    return matrix, score


def _divide_difference(pair: Any, width: float) -> list[tuple[Array, Array]]:
    if width <= 0:
        return [(np.zeros_like(e), np.zeros_like(s)) for e, s in pair[0]]
    return [((e1 - e0) / width, (s1 - s0) / width)
            for (e0, s0), (e1, s1) in zip(*pair, strict=True)]  # fmt: skip
