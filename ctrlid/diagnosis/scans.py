"""Step 4: where along a frequency, a length or the time an effect would have to sit."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from .._base.arrays import Array
from .._base.errors import CtrlidError
from ..effects import (
    AbstractEffect,
    FlexibleMode,
    InputSaturation,
    ParameterStep,
    PeriodicForce,
    PositionRipple,
    StateLimit,
)
from ..estimation.likelihood.kalman_filter import run_filter
from ..estimation.likelihood.likelihood import pseudo_inverse
from .candidates import Trial
from .fitted_model import Model
from .screening import screen_candidate, screen_starts
from .thresholds import THRESHOLD

LENGTHS = 150  # wavelengths that are looked for in the travel
UNHURRIED = 0.25  # of the samples: a wave that these can follow is looked for
EDGE = 0.05  # of the record, at either end
TIMES = 40  # instants at which a parameter might have stepped
LIMITS = (0.999, 0.998, 0.995, 0.99, 0.98, 0.95, 0.9, 0.8)  # quantiles that may be cut off
DEPTHS = (0.5, 0.25)  # of the range of the input, to which it may have been limited
MODES = 7  # frequencies at which a flexible mode is tried


def score_shapes(
    model: Model, shapes: Sequence[Array], parameter: str | None = None, width: int = 1
) -> tuple[Array, Array]:
    r"""Return what forces of given shapes would gain, with the model's parameters moving along.

    .. math:: \tfrac12 g^T H^{-1} g, \quad g = \sum_k \psi_k e_k / s_k, \quad
        H = \sum_k \psi_k \psi_k^T / s_k

    where psi is what the shape does to the predictions, projected on what the model's own
    parameters cannot do.

    Parameters
    ----------
    model : Model
        The fitted model.
    shapes : sequence of ndarray, shape (n, shapes)
        For each record, the shapes over its samples.
    parameter : str, optional
        What is modulated: by default a force, else the named parameter of the model.
    width : int, optional
        Neighbouring shapes that belong together, such as a sine and a cosine.

    Returns
    -------
    gains : ndarray, shape (shapes / width,)
        Gains of log-likelihood.
    sizes : ndarray, shape (shapes / width, width)
        The sizes that the first step gives them.
    """
    fit = model.fit
    m, count = fit.problem.plant, shapes[0].shape[1]
    samples = max(len(s) for s in shapes)
    step = max(width, THRESHOLD.scan_block // (samples * (m.size + 1)) // width * width)
    gains, sizes = [], []
    p = len(fit.theta)
    for first in range(0, count, step):
        size = min(step, count - first)
        matrix, score = np.zeros((p + size, p + size)), np.zeros(p + size)
        for track, lin, keep, r, shape in zip(
            fit.problem.prepared,
            fit.linearized,
            fit.problem.counts,
            fit.sensor,
            shapes,
            strict=True,
        ):
            part = shape[:, None, first : first + size]
            if parameter is None:
                extra = lin.b.sum(axis=2)[:, :, None] * part
            else:
                extra = lin.dp[:, :, m.names.index(parameter)][:, :, None] * part
            wide = replace(
                lin, dp=np.concatenate([lin.dp, extra], axis=2),
                hp=np.concatenate([lin.hp, np.zeros((len(shape), size))], axis=1),
            )  # fmt: skip
            out = run_filter(m, track, wide, fit.noise, columns=p + size)
            slopes, s = out.slopes[keep], out.variance[keep] * r
            weighted = slopes / s[:, None]
            matrix += weighted.T @ slopes
            score += weighted.T @ out.innovations[keep]
        own = pseudo_inverse(matrix[:p, :p]) if p else np.zeros((0, 0))
        through = matrix[p:, :p] @ own
        left = matrix[p:, p:] - through @ matrix[:p, p:]
        push = score[p:] - through @ score[:p]
        for k in range(0, size, width):
            rows = slice(k, k + width)
            amount = pseudo_inverse(left[rows, rows]) @ push[rows]
            gains.append(0.5 * float(push[rows] @ amount))
            sizes.append(amount)
    return np.array(gains), np.array(sizes)


def scan_candidate(model: Model, effect: AbstractEffect) -> Trial:
    """Return the trial of an effect at the place where its score is largest.

    Parameters
    ----------
    model : Model
        The fitted model.
    effect : AbstractEffect
        An effect with a frequency, a period or a time to be looked for; others are tried as
        they are.

    Returns
    -------
    Trial
        The best place, which has paid for the search.
    """
    search = SCANS.get(type(effect), screen_candidate)
    try:
        return search(model, effect)
    except CtrlidError as reason:  # a place that the effect cannot have
        return Trial(effect, "", model, -math.inf, remark=str(reason))


def _amplitude_and_phase(size: Array) -> tuple[float, float]:
    """Return amplitude and phase of ``size[0] sin + size[1] cos``."""
    return float(np.hypot(*size)), float(np.arctan2(size[1], size[0]))


def _find_strongest_line(model: Model) -> tuple[float, int]:
    """Return the frequency of the strongest line in the innovations [Hz], and their number."""
    z = max(model.fit.standardized, key=len)
    n, dt = len(z), model.loop.dt
    power = np.abs(np.fft.rfft(np.nan_to_num(z), 4 * n)) ** 2
    power[:8] = 0.0  # slower than two periods: a drift, not a vibration
    return int(np.argmax(power)) / (4 * n * dt), n


def _limit(model: Model, effect: StateLimit) -> Trial:
    states = list(model.fit.problem.plant.e.states)
    if effect.name not in states:
        return screen_candidate(model, effect)
    k = states.index(effect.name)
    values = np.concatenate([out.trajectory.filtered[:, k] for out in model.fit.filtered])
    # From the highest down: where it cuts off little, the trajectory of the model still holds.
    limits = [float(v) for v in np.quantile(values, LIMITS)]
    return screen_starts(model, [replace(effect, upper=v) for v in limits], math.log(len(limits)))


def _valid_inputs(model: Model) -> Array:
    """Return the recorded inputs that count, one record after the other."""
    return np.concatenate([t.table[1][t.valid] for t in model.fit.problem.prepared])


def _saturation(model: Model, effect: InputSaturation) -> Trial:
    u = _valid_inputs(model)
    upper = [replace(effect, upper=float(v)) for v in np.quantile(u, LIMITS)]
    lower = [replace(effect, lower=float(v)) for v in np.quantile(u, 1 - np.array(LIMITS))]
    sides = [[e for e in side if e.lower < e.upper] for side in ([effect], upper, lower)]
    full_penalty = math.log(sum(len(side) for side in sides))
    return max((screen_starts(model, side, full_penalty) for side in sides if side),
               key=lambda t: t.score)  # fmt: skip


def other_starts(model: Model, effect: AbstractEffect) -> list[AbstractEffect]:
    """Return other starts of an effect whose likelihood has maxima far apart.

    An input that is limited nearly always has made the model's parameters fit the limited one: no
    limit promises anything then, and a fit from the edge of the range stays there.
    """
    if not isinstance(effect, InputSaturation):
        return []
    u = _valid_inputs(model)
    middle, low, high = float(np.median(u)), float(np.min(u)), float(np.max(u))
    if not low < middle < high:
        return []
    return [InputSaturation(middle - d * (middle - low), middle + d * (high - middle))
            for d in DEPTHS]  # fmt: skip


def _periodic(model: Model, effect: PeriodicForce) -> Trial:
    frequency, n = _find_strongest_line(model)
    shapes = []
    for track in model.fit.problem.prepared:
        angle = 2 * np.pi * frequency * track.table[0]
        shapes.append(np.column_stack([np.sin(angle), np.cos(angle)]))
    _, sizes = score_shapes(model, shapes, width=2)
    amplitude, phase = _amplitude_and_phase(sizes[0])
    start = replace(effect, amplitude=amplitude, frequency=frequency, phase=phase)
    return screen_candidate(model, start, math.log(n / 2))


def _ripple(model: Model, effect: PositionRipple) -> Trial:
    m = model.fit.problem.plant
    ways = [out.trajectory.filtered[:, m.position] for out in model.fit.filtered]
    travel = max(float(np.ptp(w[k])) for w, k in zip(ways, model.fit.problem.counts, strict=True))
    step = max(float(np.quantile(np.abs(np.diff(w)), UNHURRIED)) for w in ways)
    grain = max(_grain(track.record.y) for track in model.fit.problem.prepared)
    shortest = max(travel / LENGTHS, 4 * step, 4 * grain)
    if not travel > 2 * shortest:
        return Trial(effect, "", model, -math.inf, remark="the travel is too short to see a ripple")
    finest, full_penalty = 0.25 / travel, math.log(max((1.0 / shortest - 1.0 / travel) * travel, 1))

    def gains_of(waves: Array) -> tuple[Array, Array]:
        block = max(1, THRESHOLD.scan_block // (2 * (m.size + 1) * max(len(w) for w in ways)))
        parts = []
        for k in range(0, len(waves), block):
            angles = [2 * np.pi * np.outer(w, waves[k : k + block]) for w in ways]
            shapes = [np.stack([np.sin(a), np.cos(a)], axis=2).reshape(len(a), -1) for a in angles]
            parts.append(score_shapes(model, shapes, width=2))
        gains, sizes = zip(*parts, strict=True)
        return np.concatenate(gains), np.concatenate(sizes)

    waves = np.arange(1.0 / travel, 1.0 / shortest, 2 * finest)
    gains, sizes = gains_of(waves)
    # A peak is about one over the travel wide: only those that may be the highest are seen finely.
    tops = _peaks(gains, THRESHOLD.wave_near_best**2, 2 * THRESHOLD.waves_kept)
    between = np.concatenate([waves[tops] - finest, waves[tops] + finest])
    between = np.unique(between[between > 0])
    more, theirs = gains_of(between)
    waves, first = np.unique(np.concatenate([waves, between]), return_index=True)
    gains, sizes = (np.concatenate(x)[first] for x in ((gains, more), (sizes, theirs)))

    def at(k: int) -> PositionRipple:
        amplitude, phase = _amplitude_and_phase(sizes[k])
        return replace(effect, amplitude=amplitude, period=float(1 / waves[k]), phase=phase)

    best, *others = map(at, _peaks(gains, THRESHOLD.wave_near_best, THRESHOLD.waves_kept))
    # Motion between a few levels sees several waves nearly alike: only fits tell them apart.
    return replace(screen_candidate(model, best, full_penalty), others=tuple(others))


def _peaks(gains: Array, nearly: float, most: int) -> list[int]:
    """Return the highest peaks: those that are nearly as high as the best, at most so many."""
    padded = np.concatenate([[-np.inf], gains, [-np.inf]])
    tops = np.flatnonzero((gains >= padded[:-2]) & (gains > padded[2:]))
    tops = tops[gains[tops] > nearly * gains.max()]
    return [int(k) for k in tops[np.argsort(-gains[tops])][:most]] or [int(np.argmax(gains))]


def _grain(y: Array) -> float:
    """Return the step of a coarsely quantised sensor, whose rounding repeats along the way."""
    values = np.unique(y)
    return float(np.min(np.diff(values))) if 1 < len(values) < len(y) / 8 else 0.0


def _step(model: Model, effect: ParameterStep) -> Trial:
    if effect.name not in model.names:
        return screen_candidate(model, effect)
    records = [t.record for t in model.fit.problem.prepared]
    last = float(max(t.table[0, -1] for t in model.fit.problem.prepared))
    # At the very ends a step is only another name for the initial state.
    low, high = EDGE * last, (1 - EDGE) * last
    # The likelihood is rugged in the time of a step: the scan must come within a sample of it.
    while True:
        times = np.linspace(low, high, TIMES + 2)[1:-1]
        shapes = [t.table[0][:, None] >= times for t in model.fit.problem.prepared]
        gains, sizes = score_shapes(model, shapes, effect.name)
        best = int(np.argmax(gains))
        width = times[1] - times[0]
        if width < 0.5 * records[0].dt:
            break
        low, high = max(times[best] - 2 * width, low), min(times[best] + 2 * width, high)
    value = float(model.fit.theta[model.names.index(effect.name)])
    size = float(sizes[best, 0]) / value if value else 0.0
    start = replace(effect, time=float(times[best]), size=min(max(size, -0.9), 10.0))
    return screen_candidate(model, start, math.log(len(records[0])))


def _mode(model: Model, effect: FlexibleMode) -> Trial:
    record = model.fit.problem.prepared[0].record
    slowest = 5.0 / (len(record) * record.dt)
    grid = np.geomspace(max(slowest, 1e-2 / record.dt / 10), 0.35 / record.dt, MODES)
    modes = [replace(effect, frequency=float(f), damping=0.1, coupling=0.0) for f in grid]
    # A lightly damped mode is a line in the innovations, too narrow for any grid.
    line = min(
        max(_find_strongest_line(model)[0], 2.0 / (len(record) * record.dt)), 0.35 / record.dt
    )
    modes += [replace(effect, frequency=line, damping=0.03, coupling=c) for c in (0.0, 0.05)]
    return screen_starts(model, modes, math.log(MODES))


SCANS: dict[type, Callable[[Model, Any], Trial]] = {
    PeriodicForce: _periodic,
    PositionRipple: _ripple,
    ParameterStep: _step,
    FlexibleMode: _mode,
    StateLimit: _limit,
    InputSaturation: _saturation,
}
