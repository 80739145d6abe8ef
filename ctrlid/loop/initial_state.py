"""Where a simulation starts: the state from which it follows the first samples of a record."""

from typing import Any

import casadi
import numpy as np
from scipy import optimize

from .._base.arrays import Array
from .._base.errors import ModelCannotRun
from ..data.record import Record, fill_readings
from ..effects.context import find_motion
from ..physics.linearization import compute_state_matrices
from .period_map import find_memory_range
from .simulation import Simulator

# The initial velocity is at most so many standard deviations of the measured velocity.
FASTEST = 20.0
# The start is at most so many times the largest step of the first samples from where it is seen.
NEAR = 3.0
# So many samples tell where a record starts and how fast.
FEW = 8
# So many first samples are followed.
FIRST = 400
# The search for what a backlash remembers begins at the best of so many places in its gap.
MEMORIES = 8
# A search starts by this share of the scale inside its bounds, as its solver demands.
NARROW = 1e-6
# A search ends where a step gains less than this share of the sum of squares: a hundredth of what
# the noise of a thousand samples leaves open.
SETTLED = 1e-5
# Where a simulation runs away, it errs by so many spreads of the output: its numbers say no more.
LOST = 1e3


def find_initial_state(
    simulator: Simulator, part: Record, r: Any, d: Array, guess: Array, fitted: int,
    start_time: float = 0.0, first: int = FIRST,
) -> Array:  # fmt: skip
    """Return the initial state whose first entries fit the first samples best.

    Parameters
    ----------
    simulator : Simulator
        The loop.
    part : Record
        The record, without gaps in which no output counts.
    r : ndarray or None
        Its reference.
    d : ndarray
        What is added to the controller's output.
    guess : ndarray
        A state of plant, controller and input.
    fitted : int
        How many of its first entries are sought, and with them what a backlash remembers; the
        others are kept.
    start_time : float, optional
        Time of the first sample since the start of the experiment, which a drift counts from [s].
    first : int, optional
        How many samples are followed.

    Returns
    -------
    ndarray
        The state: where it is measured, no faster than the record moves, with lags of the input
        within what they follow, and a backlash within its gap.
    """
    counted = np.reshape(part.valid_outputs, np.shape(part.y))
    part = fill_readings(part)
    if simulator.loop.equations().siso:
        spread: Any = max(float(np.std(part.y)), 1e-12 * float(np.abs(part.y).max()), 1e-300)
        scale = np.maximum(0.01 * np.abs(guess[:fitted]), spread)
        for j in simulator.loop.equations().position_rates:
            scale[j] = max(float(np.std(np.diff(part.y))) / part.dt, 1e-300)
        seen = _set_measured_state(simulator, part, guess, start_time)
        low, high = _bound_initial_state(simulator, part, seen)
    else:
        several = _SeveralOutputs(simulator, part, start_time)
        spread, scale = several.spread, several.choose_scale(guess, fitted)
        seen = several.set_measured_state(guess)
        low, high = several.bound_state(seen)
    for lag in _find_input_lags(simulator, fitted):
        scale[lag] = max(float(np.std(part.u)), 1e-300)
    sought, memory, memories = list(range(fitted)), _find_memory(simulator, part), [0.0]
    if memory is not None and memory[0] >= fitted:
        k, middle, reach = memory
        sought, scale = [*sought, k], np.append(scale, reach)
        low[k], high[k] = middle - reach, middle + reach
        at_rest = float(np.clip(guess[k], low[k], high[k]))
        memories = [at_rest, *np.linspace(low[k], high[k], MEMORIES)]

    # Runs of a search differ little, so that each begins with the steps that the last one needed.
    substeps = 1

    def compute_misfit(z: Array, count: int) -> Array | None:
        nonlocal substeps
        given = None if r is None else r[..., :count]
        try:
            y, _, substeps = simulator.run_in_steps(
                substeps, z, given, d[..., :count], start_time=start_time
            )
        except ModelCannotRun:
            return None
        misfit = np.where(counted[..., :count], (y - part.y[..., :count]) / spread, 0.0)
        return np.ravel(np.asarray(misfit, dtype=float))

    def move_state(start: Array, point: Array) -> Array:
        z = start.copy()
        z[sought] += scale * (point - 1)
        return z

    def search_nearby(start: Array, count: int) -> Array:
        def residual(point: Array) -> Array:
            found = compute_misfit(move_state(start, point), count)
            lost = np.full(part.y[..., :count].size, LOST)
            return lost if found is None else np.clip(found, -lost, lost)

        # Bounds keep an absurd start from standing in for a force that acts from the first sample
        # on.
        lower, upper = (1 + (v - start)[sought] / scale for v in (low, high))
        # Beside a bound far away a narrow room would be lost to rounding.
        far = [np.where(np.isfinite(bound), np.abs(bound), 1.0) for bound in (lower, upper)]
        narrow = NARROW * np.maximum(1.0, np.maximum(*far))
        upper = np.maximum(upper, lower + 4 * narrow)
        # The search is around 1, so that its differences have the relative size that is asked for.
        best = optimize.least_squares(
            residual, np.clip(np.ones(len(sought)), lower + narrow, upper - narrow),
            bounds=(lower, upper), diff_step=[1e-4], max_nfev=20, ftol=SETTLED,
        )  # fmt: skip
        return move_state(start, best.x)

    def choose_memory(start: Array, count: int) -> tuple[Array, Array | None]:
        """Return a start with the memory of a backlash that follows the samples best."""
        best, least = start, None
        for value in memories:
            z = start.copy()
            z[sought[fitted:]] = value
            found = compute_misfit(z, count)
            if found is not None and (least is None or found @ found < least @ least):
                best, least = z, found
        return best, least

    # From rest a short search does not find a start that is far away.
    count = min(len(part), first)
    guess, here = choose_memory(guess, count)
    seen, there = choose_memory(seen, count)
    if there is None and here is None:
        # From a rough start an unstable plant diverges soon, so that few samples are fitted first.
        for few in (10, 30, 100):
            seen = search_nearby(seen, min(few, count))
        return search_nearby(seen, count)
    if there is not None and (here is None or there @ there < here @ here):
        guess = seen
    return search_nearby(guess, count)


def _set_measured_state(
    simulator: Simulator, part: Record, guess: Array, start_time: float
) -> Array:
    """Return a guess moved to where the first samples see the plant, and how fast."""
    loop, start = simulator.loop, guess.copy()
    e = loop.equations()
    n = len(e.states)
    few = min(len(part), FEW)
    slope, first = np.polyfit(np.arange(few) * part.dt, part.y[:few], 1)
    c = _differentiate_output(simulator)
    off = first - float(e.evaluate(guess[:n], loop.point.input, start_time)[1][0])
    seen = np.array([0.0 if j in e.position_rates else c[j] for j in range(n)])
    if seen.any():
        start[:n] += seen * off / (seen @ seen)
    moving = find_motion(e)
    if moving is not None and moving[0] is not None and c[moving[0]]:
        start[moving[1]] = slope / c[moving[0]]
    return start


def _bound_initial_state(simulator: Simulator, part: Record, seen: Array) -> tuple[Array, Array]:
    """Return between what values the state of the plant may start, around where it is seen."""
    e = simulator.loop.equations()
    low, high = np.full(len(seen), -np.inf), np.full(len(seen), np.inf)
    moving, c = find_motion(e), _differentiate_output(simulator)
    if moving is not None and moving[0] is not None and c[moving[0]]:
        where, speed = moving
        steps = np.diff(part.y)
        high[speed] = FASTEST * float(np.std(steps)) / part.dt / abs(c[where])
        low[speed] = -high[speed]
        if not casadi.depends_on(casadi.jacobian(e.output, e.x), e.x):
            off = NEAR * float(np.abs(steps[:FEW]).max()) / abs(c[where])
            low[where], high[where] = seen[where] - off, seen[where] + off
    for lag in _find_input_lags(simulator, len(seen)):
        low[lag], high[lag] = float(part.u.min()), float(part.u.max())
    return low, high


class _SeveralOutputs:
    """What the first samples of a record of several outputs say of its initial state."""

    def __init__(self, simulator: Simulator, part: Record, start_time: float) -> None:
        self.simulator, self.part, self.start_time = simulator, part, start_time
        loop = simulator.loop
        e = self.e = loop.equations()
        self.y = np.reshape(part.y, (len(e.outputs), -1))
        self.c = np.asarray(compute_state_matrices(e, loop.point, spread=1e6)[2])
        largest = np.abs(self.y).max(axis=1)
        self.spreads = np.maximum(np.std(self.y, axis=1), np.maximum(1e-12 * largest, 1e-300))
        self.spread: Any = self.spreads[:, None] if part.y.ndim == 2 else self.spreads[0]
        moves = np.std(np.diff(self.y, axis=1), axis=1) / part.dt
        self.speeds = np.maximum(moves, 1e-300)
        pairs = [find_motion(e, e.states[j]) for j in e.position_rates]
        self.motions = [(p[0], p[1]) for p in pairs if p is not None and p[0] is not None]

    def _find_output(self, state: int) -> int | None:
        """Return the output that shows a state most, beside its own spread."""
        shown = np.abs(self.c[:, state]) / self.spreads
        return int(np.argmax(shown)) if shown.any() else None

    def choose_scale(self, guess: Array, fitted: int) -> Array:
        """Return the step of the search for each state."""
        least = 0.01 * np.abs(guess[:fitted])
        scale = np.where(least > 0, least, float(np.min(self.spreads)))
        for i in range(min(fitted, len(self.e.states))):
            k = self._find_output(i)
            if k is not None:
                scale[i] = max(scale[i], self.spreads[k] / abs(self.c[k, i]))
        for i, j in self.motions:
            k = self._find_output(i)
            if k is not None:
                scale[j] = self.speeds[k] / abs(self.c[k, i])
        return np.asarray(scale)

    def set_measured_state(self, guess: Array) -> Array:
        """Return a guess moved to where the first samples see the plant, and how fast."""
        start, n = guess.copy(), len(self.e.states)
        few = min(self.y.shape[1], FEW)
        slopes, first = np.polyfit(np.arange(few) * self.part.dt, self.y[:, :few].T, 1)
        at = self.simulator.loop.point
        off = first - self.e.evaluate(guess[:n], np.array(at.inputs), self.start_time)[1]
        still = [k for k in range(n) if k not in self.e.position_rates]
        start[still] += np.linalg.lstsq(self.c[:, still], off, rcond=1e-9)[0]
        moving = [i for i, _ in self.motions]
        speeds = np.linalg.lstsq(self.c[:, moving], slopes, rcond=1e-9)[0]
        for (i, j), speed in zip(self.motions, speeds, strict=True):
            if self.c[:, i].any():
                start[j] = speed
        return start

    def bound_state(self, seen: Array) -> tuple[Array, Array]:
        """Return between what values the states may start, around where they are seen."""
        low, high = np.full(len(seen), -np.inf), np.full(len(seen), np.inf)
        bent = casadi.depends_on(casadi.jacobian(self.e.output, self.e.x), self.e.x)
        for i, j in self.motions:
            k = self._find_output(i)
            if k is None:
                continue
            high[j] = FASTEST * self.speeds[k] / abs(self.c[k, i])
            low[j] = -high[j]
            if not bent:
                steps = np.abs(np.diff(self.y[k]))
                off = NEAR * max(float(steps[:FEW].max()), 1e-300) / abs(self.c[k, i])
                low[i], high[i] = seen[i] - off, seen[i] + off
        return low, high


def _find_memory(simulator: Simulator, part: Record) -> tuple[int, float, float] | None:
    """Return the place of the state that an input remembers, the middle of its range and its reach.

    That of a backlash may lie anywhere in the gap around the first input; None without a range.
    """
    loop = simulator.loop
    e, law = loop.equations(), loop.law()
    if e.memory is None:
        return None
    middle, reach = find_memory_range(e, float(np.ravel(part.u)[0]), loop.point.input, e.values)
    place = len(e.states) + (len(law.rest) if law else 0)
    return (place, middle, reach) if reach > 0 else None


def _find_input_lags(simulator: Simulator, fitted: int) -> list[int]:
    """Return the states that are lags of the input."""
    e = simulator.loop.equations()
    inputs = [e.u[k] for k in range(len(e.inputs))]
    return [
        lag.state
        for lag in e.lags
        if lag.state < fitted and any(casadi.is_equal(lag.target, u, 2) for u in inputs)
    ]


def _differentiate_output(simulator: Simulator) -> Array:
    """Return how the output depends on the states, at rest."""
    loop = simulator.loop
    return np.asarray(compute_state_matrices(loop.equations(), loop.point, spread=1e6)[2][0])
