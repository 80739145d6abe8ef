"""Step 9: how far a model is from data it was not fitted to, and what noise alone would leave."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import signal

from .._base.arrays import Array
from .._base.errors import EffectDoesNotApply, ModelCannotRun
from ..data.record import Record
from ..estimation.likelihood.filter_data import FEWEST
from ..estimation.likelihood.likelihood import Fit
from ..estimation.likelihood.prediction import predict, predict_ahead, spread_ahead
from ..loop.controller_replay import replay_from_best_state
from ..loop.initial_state import best_start
from ..loop.loop import Loop
from ..loop.period_map import comes_to_rest
from ..loop.simulation import Simulator
from ..validation.comparing import moving_poles, time_constant
from .thresholds import THRESHOLD

Name = Literal["closed-loop simulation", "open-loop simulation", "prediction"]


@dataclass(frozen=True)
class Way:
    """How a loop is compared with data: simulated, or predicted `horizon` samples ahead."""

    name: Name
    horizon: int = 0

    def __str__(self) -> str:
        return f"{self.horizon}-step {self.name}" if self.horizon else self.name


def choose_comparison(loop: Loop, record: Record) -> Way:
    """Return how a loop is compared with a record: the most telling way there is."""
    if loop.controller is not None and record.r is not None:
        return Way("closed-loop simulation")
    if loop.controller is None and comes_to_rest(loop):
        return Way("open-loop simulation")
    steps = time_constant(moving_poles(loop), loop.equations().dt, record)
    return Way("prediction", steps)


@dataclass(frozen=True, eq=False)
class Window:
    """A stretch of a record that is compared, with a lead in which the start may still show.

    `begin` is the time of its first sample since the start of the record, `mask` what is compared.
    """

    record: Record
    begin: float
    mask: Any


def hold_out(record: Record) -> tuple[Window, Record]:
    """Return the last quarter of what counts, and the record before it."""
    valid = np.flatnonzero(record.valid)
    first = max(
        int(valid[int((1 - THRESHOLD.held_out) * len(valid))]),
        len(record) - THRESHOLD.held_out_samples,
    )
    start = max(first - max((len(record) - first) // THRESHOLD.lead, THRESHOLD.shortest_lead), 0)
    part = record[start:]
    mask = np.asarray(part.valid) & (np.arange(len(part)) >= first - start)
    return Window(part, start * record.dt, mask), record[:first]


def make_window(record: Record) -> Window:
    """Return a record of which all but the very start is compared."""
    mask = np.asarray(record.valid).copy()
    mask[: max(int(THRESHOLD.start_left_out * len(mask)), 1)] = False
    return Window(record, 0.0, mask)


def root_mean_square(windows: Sequence[Window], results: Sequence[Array]) -> float:
    """Return the RMS difference on compared samples; infinite where the model gives nothing."""
    squares, count = 0.0, 0
    for window, y in zip(windows, results, strict=True):
        use = window.mask & np.isfinite(y)
        if window.mask.any() and not use.any():
            return math.inf
        squares += float(np.sum((window.record.y[use] - y[use]) ** 2))
        count += int(use.sum())
    return math.sqrt(squares / max(count, 1))


def simulate_window(loop: Loop, window: Window, way: Way) -> Array:
    """Return what a loop makes of a window, without any of its measured outputs but the first.

    Parameters
    ----------
    loop : Loop
        The model.
    window : Window
        The data.
    way : Way
        As `choose_comparison` says it.

    Returns
    -------
    ndarray
        Outputs; NaN where there are none.
    """
    record, first = window.record, window.begin
    y = np.full(len(record), np.nan)
    try:
        if way.horizon:
            index, values = predict_ahead(loop, record, predict(loop, record), way.horizon)
            y[index] = values
            return y
        simulator = Simulator(loop, THRESHOLD.gap_integration_error, THRESHOLD.gap_steps)
    except (ModelCannotRun, EffectDoesNotApply):
        return y
    for start, stop in record.segments():
        if stop - start < FEWEST:
            continue
        try:
            part = record[start:stop]
            z, r, d = prepare_simulation(simulator, part)
            begin = first + float(record.t[start] - record.start)
            y[start:stop] = simulator.run(z, r, d, None, begin)[0]
        except ModelCannotRun:
            continue
    return y


def prepare_simulation(
    simulator: Simulator, part: Record, follows: bool = False
) -> tuple[Array, Array | None, Array]:
    """Return initial state, reference and injected signal for one stretch.

    Where the controller `follows` the record, the reference is its output.
    """
    loop = simulator.loop
    n = len(simulator.plant_states)
    guess = simulator.rest.copy()
    guess[: len(loop.point.states)] = loop.point.states
    if loop.controller is None:
        r, d = None, part.u - loop.point.input
    elif follows:
        r, d = np.asarray(part.y), part.u - loop.point.input
    elif loop.analog:
        r, d = np.asarray(part.r), np.zeros(len(part))
    else:
        r = np.asarray(part.r)
        replayed, state = replay_from_best_state(loop, part)
        guess[n : n + len(state)] = state
        d = part.u - replayed
    return best_start(simulator, part, r, d, guess, n), r, d


@dataclass(frozen=True)
class Floor:
    """The RMS error that noise leaves through a loop [output unit].

    `both` with sensor noise and random force, `sensor` with sensor noise alone, `widest` that of
    the simulation with both that erred most; NaN where they cannot be computed.
    """

    both: float
    sensor: float
    widest: float


def compute_floor(
    loops: Sequence[Loop],
    fit: Fit,
    windows: Sequence[Window],
    way: Way,
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
    way : Way
        As `choose_comparison` says it.
    runs : int
        Simulations with noise.

    Returns
    -------
    Floor
        RMS errors [output unit]; NaN where they cannot be computed.
    """
    runs = runs or THRESHOLD.floor_runs
    squares, count = np.zeros((runs, 2)), 0
    for k, (loop, window) in enumerate(zip(loops, windows, strict=True)):
        noise = float(fit.sensor[min(k, len(fit.sensor) - 1)])
        try:
            squares += _simulate_noise(loop, fit, noise, window, way, runs)
        except (ModelCannotRun, EffectDoesNotApply):
            return Floor(math.nan, math.nan, math.nan)
        count += int(np.count_nonzero(window.mask))
    errors = np.sqrt(squares / max(count, 1))
    both, sensor = np.sqrt(np.mean(errors**2, axis=0)).tolist()
    return Floor(both, sensor, float(np.max(errors[:, 0])))


def _simulate_noise(
    loop: Loop, fit: Fit, sensor: float, window: Window, way: Way, runs: int
) -> Array:  # fmt: skip
    """Return what noise leaves in a window, squared and summed over its samples, for each run."""
    record = window.record
    size = int(np.count_nonzero(window.mask))
    if way.horizon:
        known = np.array(spread_ahead(loop, record, predict(loop, record), way.horizon))
        return np.tile(size * known**2, (runs, 1))
    simulator = Simulator(loop, THRESHOLD.gap_integration_error, THRESHOLD.gap_steps)
    squares, count = np.zeros((runs, 2)), 0
    for start, stop in record.segments():
        use = window.mask[start:stop]
        if stop - start < FEWEST or not use.any():
            continue
        part = record[start:stop]
        begin = window.begin + float(record.t[start] - record.start)
        z, r, d = prepare_simulation(simulator, part)
        rest = simulator.run(z, r, d, None, begin)[0]
        for seed in range(runs):
            noise = draw_noise(fit, sensor, len(part), seed)
            for k, both in enumerate((noise, [noise[0], 0 * noise[1]])):
                moved = simulator.run(z, r, d, both, begin)[0] - rest
                squares[seed, k] += float(np.sum(moved[use] ** 2))
        count += int(use.sum())
    if not count:
        raise ModelCannotRun("no stretch is long enough to be simulated")
    return squares * (size / count)


def draw_noise(fit: Fit, sensor: float, n: int, seed: int) -> list[Array]:
    """Return sensor noise and force noise as a fit found them."""
    noise, streams = fit.noise, np.random.default_rng(seed).standard_normal((3, n))
    force = streams[1] * math.sqrt(sensor * float(np.mean(noise.force)))
    if noise.drift:
        steps = streams[2] * math.sqrt(sensor * noise.drift)
        steps[0] *= 1 / math.sqrt(1 - noise.memory**2)
        force = force + signal.lfilter([1.0], [1.0, -noise.memory], steps)
    return [streams[0] * math.sqrt(sensor), force]
