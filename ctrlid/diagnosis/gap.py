"""Step 9: how far a model is from data it was not fitted to, and what noise alone would leave."""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import signal, stats

from .._base.arrays import Array
from .._base.errors import EffectDoesNotApply, ModelCannotRun
from .._base.statistics import autocorrelation_time, rounding_variance
from ..data.record import Record
from ..data.validity import find_last_valid, find_whole_past
from ..estimation.likelihood.kalman_filter import make_sensor_states
from ..estimation.likelihood.likelihood import Fit
from ..estimation.likelihood.prediction import predict_ahead, predict_from, predict_spread
from ..estimation.likelihood.tails import JointTails, Tails
from ..loop.loop import Loop, find_converter_steps
from ..loop.period_map import count_forces
from ..loop.simulation import Simulator, make_simulator
from ..validation.record_simulation import Stretch, find_long_stretches, prepare_stretch
from ..validation.reproduction import Reproduction
from .thresholds import THRESHOLD


@dataclass(frozen=True, eq=False)
class Window:
    """A stretch of a record that is compared, with a lead in which the start may still show.

    `start_time` is the time of its first sample since the start of the record, `mask` what is
    compared. Of several outputs `mask` has a row for each, and their errors count in units of
    `scales`, the floors. `noises` are draws of sensor noise and random force, with which loops are
    simulated. `readable` tells which samples are not on a limit of the sensor, if it has one.
    """

    record: Record
    start_time: float
    mask: Any
    scales: tuple[float, ...] = ()
    noises: tuple[Sequence[Array], ...] = ()
    readable: Any = None

    @property
    def seen(self) -> Record:
        """The record as a filter may take it: a reading on a limit of the sensor is none."""
        if self.readable is None:
            return self.record
        return replace(self.record, valid=np.asarray(self.record.valid) & self.readable)

    @property
    def predicted(self) -> Any:
        """What is compared of a prediction: of a reading on a limit it does not know how far."""
        return self.mask if self.readable is None else self.mask & self.readable

    def choose_output(self, k: int) -> "Window":
        """Return the same for one of several outputs, in its own unit."""
        part = self.record.select(y=self.record.signals["y"][k])
        return Window(part, self.start_time, self.mask[k])

    @property
    def measured(self) -> Array:
        """The outputs, in units of the scales where there are several."""
        y = np.asarray(self.record.y)
        return self.scale(y)

    def scale(self, y: Array) -> Array:
        """Return outputs in units of the scales where there are several."""
        return y / np.array(self.scales)[:, None] if self.scales else y


def hold_out(record: Record) -> tuple[Window, Record]:
    """Return the last quarter of what counts, less of a long record, and the record before it."""
    valid = np.flatnonzero(record.valid_outputs.any(axis=0))
    first = max(
        int(valid[int((1 - THRESHOLD.held_out) * len(valid))]),
        len(record) - THRESHOLD.held_out_samples,
    )
    start = max(first - max((len(record) - first) // THRESHOLD.lead, THRESHOLD.shortest_lead), 0)
    part = record[start:]
    mask = list_compared(part) & (np.arange(len(part)) >= first - start)
    return Window(part, start * record.dt, mask, measure_spreads(record)), record[:first]


def make_window(record: Record) -> Window:
    """Return a record of which all but the very start is compared."""
    mask = list_compared(record).copy()
    mask[..., : max(int(THRESHOLD.start_left_out * len(record)), 1)] = False
    return Window(record, 0.0, mask, measure_spreads(record))


def measure_spreads(record: Record) -> tuple[float, ...]:
    """Return the spread of each of several outputs, by which they count until floors are known."""
    if record.y.ndim == 1:
        return ()
    pairs = zip(record.y, record.valid_outputs, strict=True)
    return tuple(max(float(np.std(y[use])), THRESHOLD.tiny) for y, use in pairs)


def list_compared(record: Record) -> Any:
    """Return which samples may be compared, with a row for each of several outputs."""
    return np.array(record.valid if record.y.ndim == 1 else record.valid_outputs)


def root_mean_square(windows: Sequence[Window], results: Sequence[Array]) -> float:
    """Return the RMS difference on compared samples; infinite where the model gives nothing."""
    squares, count = 0.0, 0
    for window, y in zip(windows, results, strict=True):
        square, used = _sum_squares(window, np.asarray(window.record.y), y)
        if window.mask.any() and not used:
            return math.inf
        squares, count = squares + square, count + used
    return math.sqrt(squares / max(count, 1))


def measure_difference(
    windows: Sequence[Window], one: Sequence[Array], other: Sequence[Array]
) -> float:
    """Return the RMS difference of two simulations on compared samples; infinite without any."""
    squares, count = 0.0, 0
    for window, a, b in zip(windows, one, other, strict=True):
        square, used = _sum_squares(window, a, b)
        squares, count = squares + square, count + used
    return math.sqrt(squares / count) if count else math.inf


def _sum_squares(window: Window, one: Array, other: Array) -> tuple[float, int]:
    """Return the squared differences on compared samples, and how many samples they are of."""
    use = window.mask & np.isfinite(one) & np.isfinite(other)
    difference = window.scale(one)[use] - window.scale(other)[use]
    return float(np.sum(difference**2)), int(use.sum())


def share_samples(
    windows: Sequence[Window], results: Sequence[Sequence[Array]]
) -> tuple[Window, ...]:
    """Return the windows with only those samples compared of which every model makes something.

    A stretch that one model cannot simulate is taken out for all: on other samples the errors of
    two models cannot be compared. A model that makes nothing of a whole window takes nothing out,
    and its error is infinite.
    """
    shared = []
    for k, window in enumerate(windows):
        known = [np.isfinite(y[k]) for y in results]
        known = [mask for mask in known if (mask & window.mask).any()]
        common = np.logical_and.reduce([window.mask, *known])
        shared.append(replace(window, mask=common) if common.any() else window)
    return tuple(shared)


def measure_trivial_error(windows: Sequence[Window], horizon: int) -> float:
    """Return the RMS error of the best trivial predictor, so many samples ahead [output unit].

    The last value, and straight lines through the last 2, 4, 8, ... samples, as many as it looks
    ahead at most: a few where the sensor is quiet, many where it is noisy.
    """
    lengths = [1, 2]
    while 2 * lengths[-1] <= horizon:
        lengths.append(2 * lengths[-1])
    return min(
        root_mean_square(windows, [_extrapolate_outputs(w.seen, horizon, n) for w in windows])
        for n in lengths
    )


def measure_constant_error(windows: Sequence[Window]) -> float:
    """Return the RMS error of the mean of each output: how much it moves [output unit]."""
    constants = []
    for window in windows:
        y = np.asarray(window.record.y, dtype=float)
        count = np.maximum(np.sum(window.mask, axis=-1, keepdims=True), 1)
        total = np.sum(np.where(window.mask, y, 0.0), axis=-1, keepdims=True)
        constants.append(np.broadcast_to(total / count, y.shape))
    return root_mean_square(windows, constants)


def _extrapolate_outputs(record: Record, horizon: int, samples: int) -> Array:
    """Return what `_extrapolate` does, for each of several outputs."""
    if record.y.ndim == 1:
        return _extrapolate(record, horizon, samples)
    parts = [record.select(y=name) for name in record.signals["y"]]
    return np.array([_extrapolate(part, horizon, samples) for part in parts])


def _extrapolate(record: Record, horizon: int, samples: int) -> Array:
    """Return each output by the straight line of least squares through samples before it.

    The last of them is `horizon` samples before. One sample is the last valid value, which also
    stands where a line has too few.
    """
    ago = np.arange(float(samples))
    middle = ago - np.mean(ago)
    slope = -middle / np.sum(middle**2) if samples > 1 else middle
    weights: Array = 1 / samples + (horizon + np.mean(ago)) * slope
    valid = np.asarray(record.valid)
    y = np.asarray(record.y, dtype=float)[find_last_valid(valid)]
    line = np.append(np.full(horizon, np.nan), np.convolve(weights, y)[: len(y) - horizon])
    known = find_whole_past(valid, horizon + samples - 1)
    return np.where(known, line, np.append(np.full(horizon, np.nan), y[:-horizon]))


def halve_windows(windows: Sequence[Window]) -> tuple[tuple[Window, ...], tuple[Window, ...]]:
    """Return the windows with the first and with the second half of the compared samples only."""
    halves: tuple[list[Window], list[Window]] = ([], [])
    for window in windows:
        count = np.cumsum(window.mask if window.mask.ndim == 1 else window.mask.any(axis=0))
        first = count <= count[-1] // 2
        for half, part in zip(halves, (first, ~first), strict=True):
            half.append(replace(window, mask=window.mask & part))
    return tuple(halves[0]), tuple(halves[1])


def compute_widening_chance(
    windows: Sequence[Window], one: Sequence[Array], other: Sequence[Array]
) -> float:
    r"""Return the probability with which chance alone makes one model err so much more.

    .. math:: d_k = (y_k - \hat y^{other}_k)^2 - (y_k - \hat y^{one}_k)^2

    are averaged over blocks, each several autocorrelation times of d long, and Student's test asks
    whether their mean is above zero. The samples are paired, so what both models miss cancels.

    Parameters
    ----------
    windows : sequence of Window
        The data.
    one, other : sequence of ndarray
        What two models make of each window [output unit].

    Returns
    -------
    float
        The probability; 1 if there are not two blocks, or if the first model makes nothing of a
        whole window.

    References
    ----------
    Diebold and Mariano, Journal of Business and Economic Statistics 13 (1995) 253-263; Law and
    Kelton, *Simulation Modeling and Analysis*, section 9.5 (batch means).
    """
    sizes = [root_mean_square(windows, y) for y in (one, other)]
    if not all(map(math.isfinite, sizes)):
        return 0.0 if math.isfinite(sizes[0]) else 1.0
    parts = []
    for window, a, b in zip(windows, one, other, strict=True):
        use = window.mask & np.isfinite(a) & np.isfinite(b)
        if use.ndim == 2:
            # What several outputs say at one time is not independent.
            squares = [np.where(use, window.measured - window.scale(v), 0.0) ** 2 for v in (b, a)]
            d = np.sum(squares[0] - squares[1], axis=0)[use.any(axis=0)]
            parts.append(d / (max(sizes) or 1.0) ** 2)
            continue
        y = np.asarray(window.record.y)[use] / (max(sizes) or 1.0)
        a, b = (v[use] / (max(sizes) or 1.0) for v in (a, b))
        parts.append((y - b) ** 2 - (y - a) ** 2)
    d = np.concatenate(parts)
    if len(d) < 2:
        return 1.0
    length = math.ceil(THRESHOLD.independent_block * autocorrelation_time(d - np.mean(d)))
    count = len(d) // length
    if count < 2:
        return 1.0
    means = np.mean(d[: count * length].reshape(count, length), axis=1)
    scatter = float(np.std(means, ddof=1)) / math.sqrt(count)
    if not scatter:
        return 0.0 if means[0] > 0 else 1.0
    return float(stats.t.sf(float(np.mean(means)) / scatter, count - 1))


def compute_excess_chance(
    windows: Sequence[Window], results: Sequence[Array], floor: Sequence[float]
) -> float:
    r"""Return the probability that noise alone makes errors so large.

    .. math:: \sum_i N_i \, \frac{\overline{e_i^2}}{f_i^2} \sim \chi^2_{\sum_i N_i}

    for the errors e of each output in each window, the floor f of the output, and as many
    independent errors N as they are worth: errors of predictions that overlap are alike.

    Parameters
    ----------
    windows : sequence of Window
        The data.
    results : sequence of ndarray
        What a model makes of each window [output unit].
    floor : sequence of float
        The RMS error that noise leaves in each output [its unit].

    Returns
    -------
    float
        The probability; NaN where no floor is known.
    """
    squares = freedom = 0.0
    for window, y in zip(windows, results, strict=True):
        outputs = zip(np.atleast_2d(window.record.y), np.atleast_2d(y), np.atleast_2d(window.mask),
                      floor, strict=True)  # fmt: skip
        for measured, made, mask, size in outputs:
            use = mask & np.isfinite(made)
            if not use.any():
                continue
            e = measured[use] - made[use]
            independent = len(e) / autocorrelation_time(e, power=2)
            squares += independent * float(np.mean(e**2)) / max(size, THRESHOLD.tiny) ** 2
            freedom += independent
    known = freedom and all(map(math.isfinite, floor))
    return float(stats.chi2.sf(squares, freedom)) if known else math.nan


def simulate_window(loop: Loop, window: Window, how: Reproduction) -> Array:
    r"""Return what a loop makes of a window: a simulation, or a prediction some samples ahead.

    .. math:: \hat y = \mathrm{E}[y \mid r] \approx \frac1{2R} \sum_{i=1}^R \bigl(y(r, w_i) +
        y(r, -w_i)\bigr)

    with draws w of the noise, if the window has some. Noise shakes a backlash loose and rounds a
    curve: a simulation without it is not what the loop does on average. Of a linear loop both are
    the same.

    Parameters
    ----------
    loop : Loop
        The model.
    window : Window
        The data.
    how : Reproduction
        As `choose_reproduction` says it.

    Returns
    -------
    ndarray
        Outputs [output unit]; NaN where there are none.
    """
    record = window.record
    y = np.full(np.shape(record.y), np.nan)
    try:
        if how.horizon:
            first = window.start_time
            made = predict_from(loop, window.seen, first)
            index, values = predict_ahead(loop, record, made, how.horizon, first)
            y[..., index] = values.T
            y[~window.predicted] = np.nan
            return y
        simulator = make_gap_simulator(loop, record.hold, record.hold_r)
    except (ModelCannotRun, EffectDoesNotApply):
        return y
    for part in find_long_stretches(record, loop):
        try:
            stretch = prepare_stretch(simulator, record, part, start_time=window.start_time)
            y[..., part] = _average_runs(stretch, simulator, window.noises, part)
        except ModelCannotRun:
            continue
    return y


def _average_runs(
    stretch: Stretch, simulator: Simulator, noises: Sequence[Sequence[Array]], part: slice
) -> Array:
    """Return the mean of simulations with each noise and its opposite; without noises, that alone.

    A loop that noise drives out of its range now and then did not leave it in the record.
    """
    runs: list[Array] = []
    for noise in noises:
        pair = [[sign * np.asarray(v)[..., part] for v in noise] for sign in (1, -1)]
        with contextlib.suppress(ModelCannotRun):
            one, other = (stretch.run(simulator, each)[0] for each in pair)
            runs.append((one + other) / 2)
    return np.mean(runs, axis=0) if runs else stretch.run(simulator)[0]


def make_gap_simulator(
    loop: Loop, hold: str = "zoh", hold_r: str = "zoh", most: int | None = None
) -> Simulator:
    """Return a loop made ready to be simulated many times, as exactly as a gap needs.

    In at `most` so many steps of the integration in a period, by default as a gap.
    """
    most = THRESHOLD.gap_steps if most is None else most
    return make_simulator(loop, THRESHOLD.gap_integration_error, most, hold, hold_r)


@dataclass(frozen=True)
class Floor:
    """The RMS error that noise leaves through a loop [output unit].

    `both` with sensor noise and random force, `sensor` with sensor noise alone, `widest` that of
    the simulation with both that erred most; NaN where they cannot be computed. Of several outputs
    they are in units of the windows' scales, and `outputs` holds the same of each in its own unit.
    """

    both: float
    sensor: float
    widest: float
    outputs: tuple["Floor", ...] = ()


def compute_floor(
    loops: Sequence[Loop],
    fit: Fit,
    windows: Sequence[Window],
    how: Reproduction,
    runs: int | None = None,
) -> Floor:
    """Return the RMS error that noise leaves through a loop.

    Parameters
    ----------
    loops : sequence of Loop
        The model with everything in it, for each window.
    fit : Fit
        Its fit, for the noise.
    windows : sequence of Window
        The data.
    how : Reproduction
        As `choose_reproduction` says it.
    runs : int, optional
        Simulations with noise.

    Returns
    -------
    Floor
        RMS errors [output unit]; NaN where they cannot be computed.
    """
    runs = runs or THRESHOLD.floor_runs
    if windows[0].record.y.ndim == 1:
        return _summarize_runs(measure_noise_errors(loops, fit, windows, how, runs))
    each, counts = _measure_each_output(loops, fit, windows, how, runs)
    outputs = tuple(_summarize_runs(errors) for errors in each)
    return replace(_summarize_runs(_weigh_outputs(each, counts, windows)), outputs=outputs)


def _summarize_runs(errors: Array) -> Floor:
    both, sensor = np.sqrt(np.mean(errors**2, axis=0)).tolist()
    return Floor(both, sensor, float(np.max(errors[:, 0])))


def _weigh_outputs(each: Array, counts: Array, windows: Sequence[Window]) -> Array:
    """Return the RMS errors of all outputs together, in units of the scales."""
    scales = np.array(windows[0].scales or np.ones(len(each)))
    squares = (each / scales[:, None, None]) ** 2 * counts[:, None, None]
    return np.asarray(np.sqrt(squares.sum(axis=0) / max(counts.sum(), 1)))


def _measure_each_output(
    loops: Sequence[Loop], fit: Fit, windows: Sequence[Window], how: Reproduction, runs: int
) -> tuple[Array, Array]:
    """Return what `measure_noise_errors` does for each output, and how many samples count."""
    q = len(windows[0].record.y)
    squares, counts = np.zeros((q, runs, 2)), np.zeros(q)
    for k, (loop, window) in enumerate(zip(loops, windows, strict=True)):
        noise = _find_sensor_variance(fit, k)
        try:
            squares += _simulate_noise(loop, fit, noise, window, how, runs)
        except (ModelCannotRun, EffectDoesNotApply):
            return np.full((q, runs, 2), math.nan), counts
        counts += np.count_nonzero(window.mask, axis=1)
    return np.sqrt(squares / np.maximum(counts, 1)[:, None, None]), counts


def measure_noise_errors(
    loops: Sequence[Loop], fit: Fit, windows: Sequence[Window], how: Reproduction, runs: int
) -> Array:
    """Return the RMS errors that noise leaves in each run, with all noise and with the sensor's.

    Parameters
    ----------
    loops, fit, windows, how
        As in `compute_floor`.
    runs : int
        Simulations with noise.

    Returns
    -------
    ndarray, shape (runs, 2)
        RMS errors [output unit], of several outputs in units of the windows' scales; NaN where they
        cannot be computed.
    """
    if windows[0].record.y.ndim == 2:
        each, counts = _measure_each_output(loops, fit, windows, how, runs)
        return _weigh_outputs(each, counts, windows)
    squares, count = np.zeros((runs, 2)), 0
    for k, (loop, window) in enumerate(zip(loops, windows, strict=True)):
        noise = _find_sensor_variance(fit, k)
        try:
            squares += _simulate_noise(loop, fit, noise, window, how, runs)
        except (ModelCannotRun, EffectDoesNotApply):
            return np.full((runs, 2), math.nan)
        count += int(np.count_nonzero(window.mask))
    return np.asarray(np.sqrt(squares / max(count, 1)))


def compute_chance_among_runs(size: float, runs: Array) -> float:
    r"""Return the probability that one more run errs as little, of runs with noise.

    .. math:: \frac{\ln e - \overline{\ln e_r}}{s \sqrt{1 + 1/R}} \sim t_{R-1}
    """
    logs, count = np.log(runs), len(runs)
    width = float(np.std(logs, ddof=1)) * math.sqrt(1 + 1 / count)
    away = math.log(max(size, THRESHOLD.tiny)) - float(np.mean(logs))
    return float(stats.t.cdf(away / max(width, THRESHOLD.tiny), count - 1))


def _simulate_noise(
    loop: Loop, fit: Fit, sensor: float, window: Window, how: Reproduction, runs: int
) -> Array:
    """Return what noise leaves in a window, squared and summed over its samples, for each run.

    Of several outputs, first by the output. At least what the steps of a converter in the loop hide
    of any difference, :math:`q^2 / 12`.
    """
    record = window.record
    size = np.count_nonzero(window.mask, axis=-1)
    if how.horizon:
        first = window.start_time
        made = predict_from(loop, window.seen, first)
        known = np.array(predict_spread(loop, record, made, how.horizon, first))
        if known.ndim == 2:
            squares = size[:, None, None] * known.T[:, None, :] ** 2
            return np.tile(squares, (1, runs, 1))
        return np.tile(size * known**2, (runs, 1))
    simulator = make_gap_simulator(loop, record.hold, record.hold_r)
    squares, count = np.zeros((*np.shape(size), runs, 2)), np.zeros_like(size)
    for part in find_long_stretches(record, loop):
        use = window.mask[..., part]
        if not use.any():
            continue
        stretch = prepare_stretch(simulator, record, part, start_time=window.start_time)
        rest = _average_runs(stretch, simulator, window.noises, part)
        for seed in range(runs):
            noise = draw_noise(fit, sensor, rest.shape[-1], seed)
            for k, both in enumerate((noise, [noise[0], 0 * noise[1]])):
                error = stretch.run(simulator, both)[0] - rest
                if use.ndim == 2:
                    squares[:, seed, k] += np.sum(np.where(use, error, 0.0) ** 2, axis=1)
                else:
                    squares[seed, k] += float(np.sum(error[use] ** 2))
        count = count + use.sum(axis=-1)
    if not np.any(count):
        raise ModelCannotRun("no stretch is long enough to be simulated")
    hidden = size * rounding_variance(find_converter_steps(loop))
    if np.ndim(size):
        squares *= (size / np.maximum(count, 1))[:, None, None]
        return np.asarray(np.maximum(squares, hidden[:, None, None]))
    return np.asarray(np.maximum(squares * (size / count), hidden[0]))


def _find_sensor_variance(fit: Fit, k: int) -> float:
    """Return the variance of the sensor noise in a window; further windows have the last one's."""
    return float(fit.sensor[min(k, len(fit.sensor) - 1)])


def draw_noises(fit: Fit, windows: Sequence[Window]) -> tuple[Window, ...]:
    """Return the windows with draws of a fit's noise."""
    found = []
    # Other seeds than those of the runs that say what noise makes.
    seeds = range(THRESHOLD.size_runs, THRESHOLD.size_runs + THRESHOLD.mean_runs)
    for k, window in enumerate(windows):
        sensor = _find_sensor_variance(fit, k)
        n = window.record.y.shape[-1]
        noises = tuple(draw_noise(fit, sensor, n, seed) for seed in seeds)
        found.append(replace(window, noises=noises))
    return tuple(found)


def draw_noise(fit: Fit, sensor: float, n: int, seed: int) -> list[Array]:
    """Return sensor noise and force noise of a fit; `sensor` is the variance of the sensor's.

    What the steps of a converter in the loop add to the noise, its simulation adds by itself.
    """
    if not fit.plant.e.siso:
        return _draw_several_noises(fit, sensor, n, seed)
    noise, streams = fit.noise, np.random.default_rng(seed).standard_normal((3, n))
    force = streams[1] * math.sqrt(sensor * noise.force[0])
    if (rows := count_forces(fit.plant.e)) > 1:
        # Where nothing moves, each state of the plant has a noise of its own.
        more = np.random.default_rng([seed, 2]).standard_normal((rows - 1, n))
        sizes = np.sqrt(sensor * np.array(noise.force[1:rows]))
        force = np.vstack([force, more * sizes[:, None]])
    if noise.drift:
        steps = streams[2] * math.sqrt(sensor * noise.drift)
        steps[0] *= 1 / math.sqrt(1 - noise.memory**2)
        force = force + signal.lfilter([1.0], [1.0, -noise.memory], steps)
    tails, reading = noise.tails, streams[0]
    if not noise.sensor_is_white:
        # As many samples again let the noise begin anywhere in its stationary run.
        reading = np.append(np.random.default_rng([seed, 1]).standard_normal(n), reading)
    if isinstance(tails, Tails):
        reading = tails.draw(reading, seed)
    if not noise.sensor_is_white:
        _, drive, _ = make_sensor_states(noise.ar, noise.ma)
        colour = [1.0, *noise.ma], [1.0, *(-v for v in noise.ar)]
        reading = drive[0] * signal.lfilter(*colour, reading)[n:]
    (beside,) = _list_noises_beside_steps(fit, sensor)
    return [reading * math.sqrt(beside), force]


def _draw_several_noises(fit: Fit, sensor: float, n: int, seed: int) -> list[Array]:
    """Return the noise of each sensor and of each force of a fit."""
    sizes = [np.sqrt(_list_noises_beside_steps(fit, sensor)),
             np.sqrt(sensor * np.array(fit.noise.force))]  # fmt: skip
    streams = [np.random.default_rng([seed, k]).standard_normal((len(size), n))
               for k, size in enumerate(sizes)]  # fmt: skip
    if isinstance(fit.noise.tails, JointTails):
        for k, law in enumerate(fit.noise.tails.each):
            streams[0][k] = streams[0][k] if law is None else law.draw(streams[0][k], (seed, k))
    return [size[:, None] * s for size, s in zip(sizes, streams, strict=True)]


def _list_noises_beside_steps(fit: Fit, sensor: float) -> Array:
    """Return the variance of each sensor's noise without that of rounding, a trace at least."""
    noises = sensor * fit.noise.ratios
    rounding = fit.rounding or fit.problem.rounding
    return np.maximum(noises - rounding, THRESHOLD.noise_beside_steps * noises)
