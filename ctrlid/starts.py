"""Where a simulation starts: the state from which it follows the first samples of a record."""

from typing import Any

import numpy as np
from scipy import optimize

from .data import Record
from .effects.moment import motion
from .equations import Array
from .errors import CtrlidError
from .linearization import state_matrices
from .simulation import Simulator


def best_start(
    simulator: Simulator, part: Record, r: Any, d: Array, guess: Array, fitted: int
) -> Array:
    """Return the initial state whose first entries fit the first samples best.

    Parameters
    ----------
    simulator : Simulator
        The loop.
    part : Record
        The record, without gaps.
    r : ndarray or None
        Its reference.
    d : ndarray
        What is added to the controller's output.
    guess : ndarray
        A state of plant, controller and input path.
    fitted : int
        How many of its first entries are sought; the others are kept.

    Returns
    -------
    ndarray
        The state.
    """
    spread = max(float(np.std(part.y)), 1e-12 * float(np.abs(part.y).max()), 1e-300)
    scale = np.maximum(0.01 * np.abs(guess[:fitted]), spread)
    for j in simulator.loop.equations().velocities:
        scale[j] = max(float(np.std(np.diff(part.y))) / part.dt, 1e-300)

    def misfit(z: Array, count: int) -> Array | None:
        try:
            y = simulator.run(z, None if r is None else r[:count], d[:count])[0]
        except CtrlidError:
            return None
        return np.asarray((y - part.y[:count]) / spread, dtype=float)

    def moved(start: Array, point: Array) -> Array:
        z = start.copy()
        z[:fitted] += scale * (point - 1)
        return z

    def nearby(start: Array, count: int) -> Array:
        def residual(point: Array) -> Array:
            found = misfit(moved(start, point), count)
            return np.full(count, 1e3) if found is None else found

        # Around 1, so that the differences have the relative size that is asked for.
        best = optimize.least_squares(residual, np.ones(fitted), diff_step=[1e-4], max_nfev=20)
        return moved(start, best.x)

    # From rest a short search does not find a start that is far away.
    seen, count = _as_measured(simulator, part, guess), min(len(part), 400)
    there, here = misfit(seen, count), misfit(guess, count)
    if there is None and here is None:
        # An unstable plant is lost soon from a start that is only nearly right.
        for few in (10, 30, 100):
            seen = nearby(seen, min(few, count))
        return nearby(seen, count)
    if there is not None and (here is None or there @ there < here @ here):
        guess = seen
    return nearby(guess, count)


def _as_measured(simulator: Simulator, part: Record, guess: Array) -> Array:
    """Return a guess moved to where the first samples see the plant, and how fast."""
    loop, start = simulator.loop, guess.copy()
    e = loop.equations()
    n = len(e.states)
    few = min(len(part), 8)
    slope, first = np.polyfit(np.arange(few) * part.dt, part.y[:few], 1)
    c = state_matrices(e, loop.point, spread=1e6)[2][0]
    off = first - float(e.evaluate(guess[:n], loop.point.input, 0.0)[1][0])
    seen = np.array([0.0 if j in e.velocities else c[j] for j in range(n)])
    if seen.any():
        start[:n] += seen * off / (seen @ seen)
    moving = motion(e)
    if moving is not None and c[moving[0]]:
        start[moving[1]] = slope / c[moving[0]]
    return start
