"""Which colour the noise of force and sensor has: its orders, chosen by a criterion."""

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from ...._base.criterion import bayesian_penalty
from ...._base.errors import ModelCannotRun
from ...._base.jobs import run_side_by_side
from ..kalman_filter import Noise
from ..likelihood import Fit, Known, evaluate_linearized, measure_slope
from .coordinates import (
    compute_noise_criterion,
    compute_noise_logs,
    find_slowest_root,
    make_noise,
)
from .fit import ENOUGH, fit_noise

# Coefficients of coloured sensor noise from which a fit starts, and those of an average.
SIZES, AVERAGED = (-0.4, 0.4, 0.8, 0.97), 0.9
# Steps of a random walk from which a fit of one beside white noise starts, over the white noise.
WALKS = (0.01, 0.03, 0.1, 0.3)
# A sensor whose noise makes a smaller share of the variance of one-step errors reads exactly.
EXACT = 1e-4
# Where one seems to, a fit of a coloured force also starts from so much of the white one.
SMALLER = 1e-4
# Orders of coloured sensor noise: of the autoregression and of the moving average, at most.
ORDERS = 2, 3


def try_coloured_force(fit: Fit) -> Fit:
    """Return the fit with a coloured force added, whether or not the BIC prefers it.

    A white force alone that stood for the coloured one may have left hardly any noise to the
    sensor. Then all forces are also tried far smaller beside it.
    """
    dt = fit.plant.loop.dt
    memories = [math.exp(-dt / time) for time in (3 * dt, 30 * dt, 300 * dt)]
    tried = []
    for smaller in (1.0, SMALLER) if _reads_exactly(fit) else (1.0,):
        noises = [
            Noise(tuple(0.5 * smaller * v for v in fit.noise.force), memory,
                  share * smaller * sum(fit.noise.force) * (1 - memory**2), tails=fit.noise.tails)
            for memory in memories
            for share in (1e-2, 1.0)
        ]  # fmt: skip
        best, value = _find_likeliest(fit, noises)
        if np.isfinite(value):
            tried.append(fit_noise(fit.problem, fit.theta, fit.linearized, best))
    if not tried:
        raise ModelCannotRun(f"no coloured force can be fitted to {fit.plant.e.name}")
    return max(tried, key=lambda fit: fit.value)


def _reads_exactly(fit: Fit) -> bool:
    """Whether a sensor has hardly any noise beside what a random force does within a period."""
    return any(
        EXACT * float(np.mean(out.variance[keep])) > 1.0
        for out, keep in zip(fit.filtered, fit.counts, strict=False)
    )


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


def try_coloured_sensor(fit: Fit, most: int = sum(ORDERS), beside: bool = False) -> Fit:
    """Return the fit with the coloured sensor noise that the BIC prefers.

    Parameters of the plant stay as they are. From the first order on, a coefficient more is tried
    on either side until none pays. A random walk beside white noise, which hardly shows in any
    coefficient alone, is tried by itself.

    Parameters
    ----------
    fit : Fit
        The fit.
    most : int, optional
        Number of coefficients at most, one or more.
    beside : bool, optional
        Whether a coloured force stays beside it, and no random walk of the sensor, which moves as
        slowly, is tried. By default the colour of the sensor takes its place.

    References
    ----------
    Hannan and Rissanen, Biometrika 69 (1982) 81-94, for the choice of orders by a criterion.
    """
    white = replace(fit.noise if beside else fit.noise.plain, ar=(), ma=())
    quieter = [replace(white, force=force) for force in _list_smaller_forces(fit)]
    values: list[tuple[float, ...]] = [(v,) for v in SIZES]

    def fit_moving(starts: Sequence[tuple[float, ...]]) -> Fit:
        return _fit_best(fit, [replace(noise, ma=ma) for noise in quieter for ma in starts])

    # A converter that averages samples has zeros on the unit circle, all of which it needs at once,
    # and which a search from within nears ever more slowly.
    averages: list[list[tuple[float, ...]]]
    averages = [[*values, (1.0,)]]
    averages += [[(AVERAGED,) * q, (1.0,) * q] for q in range(2, min(ORDERS[1], most) + 1)]
    chains = [
        _fit_best(fit, [replace(noise, ar=ar) for noise in quieter for ar in values]),
        max((fit_moving(each) for each in averages), key=compute_noise_criterion),
    ]
    if most > 1 and not beside:
        chains.append(_fit_best(fit, list(_list_walks(fit, _list_smaller_forces(fit)))))
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
    root = find_slowest_root(fit.problem)
    for force, step in itertools.product(forces, WALKS):
        yield Noise(force, ar=(root,), ma=(-root * (1 - step),), tails=fit.noise.tails)


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
