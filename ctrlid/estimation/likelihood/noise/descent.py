"""The descent to the most likely noise, by Newton steps with differences."""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np

from ...._base.arrays import Array
from ...._base.jobs import run_side_by_side
from ..likelihood import Fit

# Of so many directions all mixed derivatives are differences.
FEW_DIRECTIONS = 3
# Of a step no direction is longer, and none is shortened more often than leads to this brake.
LONGEST_STEP, MOST_BRAKE = 2.5, 1e4
# Above this second derivative by a log variance, a parabola tells how far the minimum is.
CONVEX = 0.05


def find_cost(fit: Fit) -> float:
    """Return the cost of a fit; a lost record has a large one."""
    return -fit.value if np.isfinite(fit.value) else 1e15


def minimize_by_newton(
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
        return find_cost(fit), [] if few else _list_innovations(fit)

    here, damping = find_cost(measure(x)), 0.1
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
            there = find_cost(measure(trial))
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
