"""What sampling, sensors and loggers do to a signal: steps, clipping, repeats, spikes, drift.

Arrays in, numbers out. The bounds are laws of chance for a signal of this length, or ratios to the
signal's own size; none is in physical units.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import ndimage, stats

from .._base.arrays import Array
from .._base.statistics import compute_lagged_products, regress, robust_deviation
from ..data.converter_grid import ENOUGH, LEVELS, count_distinct, estimate_rounding
from ..data.validity import find_runs, find_whole_past

# A signal with more than this share of its samples on one value does not show what moves it.
STUCK = 0.9
# A continuous distribution does not give so many equal extreme values.
SOME = 4
# So many samples on either side tell whether a spike stands alone.
QUIET = 8
# Responses that repeat exactly are alike within so many steps of a signal, or this share of it.
REPEATED_STEPS = 3.0
REPEATED_SHARE = 1e-3
# A drift is tested on the means of at most so many blocks.
BLOCKS = 40
# So many samples tell how large a drift is; of longer records every k-th is used.
PLENTY = 100_000
# An angle or a counter that starts over fills this share of its range.
FULL = 0.9
# A signal that is computed anew in each period differs by rounding, within this share of its range.
SAME = 1e-9
# Where angles start over [rad, deg], and counters of 8 to 32 bits.
TURNS = (2 * math.pi, 360.0, *(2.0**bits for bits in (8, 10, 12, 14, 16, 24, 32)))


def is_held(v: Array) -> bool:
    """Return whether a signal is a staircase of few levels, as a program gives it out."""
    if len(np.unique(v[:ENOUGH])) > LEVELS or len(np.unique(v)) > LEVELS:
        return False
    return float(np.mean(np.diff(v) != 0)) < 0.2


def find_stuck(v: Array, driver: Array) -> tuple[float, float]:
    """Return the share of the samples at which a signal sits on its extreme, and that value.

    Zero unless it is nearly all of them, and the signal leaves the value far less often than what
    drives it changes: one that rests between moves is not stuck.
    """
    changes = np.count_nonzero(np.abs(np.diff(driver)) > estimate_rounding(driver))
    for value in (float(v.min()), float(v.max())):
        at = np.abs(v - value) <= estimate_rounding(v)
        if np.mean(at) > STUCK and len(find_runs(at)[0]) < (1 - STUCK) * changes:
            return float(np.mean(at)), value
    return 0.0, 0.0


def find_clipped(
    v: Array, valid: Any, others: Sequence[Array], step: float, side: int,
    reference: Array | None = None,
) -> tuple[Any, float]:  # fmt: skip
    """Return where a signal sits on its extreme value too often, and that value.

    A continuous distribution never gives its largest value twice; a quantised one gives it about as
    often as the values beside it. Rest does not count: all other signals stand still too (or, for
    a quantised signal, its reference does), and the signal came to its value gently, or the record
    starts there. A single stretch must be twice as long as several together.

    Parameters
    ----------
    v : ndarray, shape (n,)
        Signal.
    valid : ndarray of bool, shape (n,)
        Samples that count.
    others : sequence of ndarray
        The other signals.
    step : float
        Quantisation step of the signal, or 0.
    side : int
        1 for the largest value, -1 for the smallest.
    reference : ndarray, optional
        What the signal should follow.

    Returns
    -------
    mask : ndarray of bool, shape (n,)
        The samples at the limit, none if chance explains them.
    limit : float
        The extreme value.
    """
    w = side * v
    tol, limit = estimate_rounding(v), float(np.max(w[valid]))
    at = valid & (w >= limit - tol)
    none = np.zeros(len(v), dtype=bool)
    if np.count_nonzero(at) < SOME or limit - np.min(w[valid]) <= tol or is_held(v[valid]):
        return none, side * limit
    first, stop = find_runs(at)
    gentle = 1.5 * step if step else 1e-3 * float(np.ptp(v[valid]))
    before = np.maximum(first - 1, 0)
    starts = (first == 0) | ~valid[before]
    slope = np.maximum(
        np.abs(w[first] - w[before]), np.abs(w[before] - w[np.maximum(first - 2, 0)])
    )
    moves = [np.abs(np.diff(s, prepend=s[0])) > 1e-9 * float(np.ptp(s)) for s in others]
    changes = np.cumsum(np.any(moves, axis=0))
    since = np.where(starts, first, before)
    # The sample at which the others move on is the last one at which this signal has not yet.
    still = changes[np.maximum(stop - 2, since)] == changes[since]
    if step and reference is not None:
        steps = np.cumsum(np.diff(reference, prepend=reference[0]) != 0)
        still |= steps[np.maximum(stop - 2, since)] == steps[since]
    rest = still & (starts | (slope <= gentle))
    for a, b in zip(first[rest], stop[rest], strict=True):
        at[a:b] = False
    values, counts = count_distinct(w[valid])
    near = counts[-4:-1]
    levels = max(len(near), round((limit - values[-len(near) - 1]) / step) if step else 0)
    usual = near.sum() / levels if step else near.mean() - 1
    least = SOME if len(find_runs(at)[0]) > 1 else 2 * SOME
    enough = np.count_nonzero(at) >= least + SOME * max(usual, 0.0)
    return (at if enough else none), side * limit


def find_wraps(v: Array, valid: Any) -> tuple[float, Any]:
    r"""Return the range at whose ends a signal starts over, and where it does.

    .. math:: |\Delta v_k| > P/2, \quad \bigl| |\Delta v_k| - P \bigr| \le
        2 \max_{others} |\Delta v| < P/2

    for a turn P in radians or degrees, or the range of a counter of 8 to 32 bits, of which the
    signal fills most and which it does not leave: an angle or a count that goes on where it seems
    to jump. Where all that jumps returns at once, and from the same number, readings were lost.

    Parameters
    ----------
    v : ndarray, shape (n,)
        Signal.
    valid : ndarray of bool, shape (n,)
        Samples that count.

    Returns
    -------
    period : float
        The range [signal unit]; 0 for a signal that does not start over.
    at : ndarray of int
        The samples right after it does.
    """
    none = np.zeros(0, dtype=int)
    step = np.where(valid[1:] & valid[:-1], np.diff(v), 0.0)
    reach = float(np.ptp(v[valid]))
    for period in TURNS:
        far = np.abs(step) > period / 2
        usual = float(np.max(np.abs(step[~far]), initial=0.0))
        # A turn that is rounded to some digits is a little longer.
        if not (far.any() and FULL * period <= reach <= period + usual and usual > 0):
            continue
        at = np.flatnonzero(far) + 1
        there = at[:-1][(np.diff(at) == 1) & (step[at[1:] - 1] * step[at[:-1] - 1] < 0)]
        if 2 * len(there) == len(at) and np.ptp(v[there]) == 0:
            continue  # Readings that were lost, and are all logged as the same number.
        if np.max(np.abs(np.abs(step[far]) - period)) <= 2 * usual < period / 2:
            return period, at
    return 0.0, none


def find_exact_period(v: Array) -> int:
    """Return after how many samples a signal repeats itself but for rounding, or 0."""
    period = find_period(v)
    if not period:
        return 0
    same = np.abs(v[period:] - v[:-period]) <= SAME * float(np.ptp(v))
    return period if same.all() else 0


def is_one_event(v: Array, at: Any, references: Sequence[Array], step: float) -> bool:
    """Return whether equal extreme values are the same response, again and again, and no limit.

    A controller with feed-through moves its output at once when a reference jumps. From rest, equal
    jumps give equal peaks of one sample. A limit holds for longer, or is met after other jumps; and
    it cuts off what the samples beside it show, which noise makes different each time.

    Parameters
    ----------
    v : ndarray, shape (n,)
        Signal.
    at : ndarray of bool, shape (n,)
        Samples on the extreme value.
    references : sequence of ndarray, shape (n,)
        What jumps.
    step : float
        Quantisation step of the signal, or 0.

    Returns
    -------
    bool
        True where each sample stands alone, all are the one of an equal jump or the one after it,
        and the samples beside them are equal as well.
    """
    k = np.flatnonzero(at)
    if not len(k) or not references or np.any(np.diff(k) == 1):
        return False

    def follows_equal_jumps(lag: int) -> bool:
        heights = [np.diff(r, prepend=r[0])[np.maximum(k - lag, 0)] for r in references]
        alike = all(np.ptp(h) <= estimate_rounding(r)
                    for h, r in zip(heights, references, strict=True))  # fmt: skip
        return alike and any(np.abs(h).min() > estimate_rounding(r)
                             for h, r in zip(heights, references, strict=True))  # fmt: skip

    if not any(follows_equal_jumps(lag) for lag in (0, 1)):
        return False
    beside = [v[np.clip(k + side, 0, len(v) - 1)] for side in (-1, 1)]
    bound = max(REPEATED_STEPS * step, REPEATED_SHARE * float(np.ptp(v)))
    return all(float(np.ptp(w)) <= bound for w in beside)


def find_repeats(v: Array, valid: Any, step: float, ignore: Any) -> Any:
    """Return where a signal repeats its last value although it moves just before and after.

    A quantised signal that moves by many steps a sample passes through a difference of nought as
    seldom as through one of one or two steps; what is more is a defect.

    Parameters
    ----------
    v : ndarray, shape (n,)
        Signal.
    valid : ndarray of bool, shape (n,)
        Samples that count.
    step : float
        Quantisation step, or 0.
    ignore : ndarray of bool, shape (n,)
        Samples with another explanation, for instance at a limit.

    Returns
    -------
    ndarray of bool, shape (n,)
        The repeated samples, none if chance explains them.
    """
    d = np.diff(v)
    good = valid[1:] & valid[:-1] & ~ignore[1:]
    size = np.where(good, np.abs(d), 0.0)
    moved = size[size > 0]
    none = np.zeros(len(v), dtype=bool)
    if moved.size < 10:
        return none
    fast = 3.5 * step if step else 1e-3 * float(np.median(moved))
    padded = np.concatenate([[0.0], size, [0.0]])
    first, stop = find_runs(good & (size <= estimate_rounding(v)))
    among = (padded[first] > fast) & (padded[stop + 1] > fast)
    usual = 0.0
    if step:
        few = (size > 0.5 * step) & (size < 2.5 * step)
        usual = np.count_nonzero(few & (padded[:-2] > fast) & (padded[2:] > fast)) / 4
    if np.count_nonzero(among) < 1 + (2 + 3 * usual + 3 * np.sqrt(usual) if step else 0):
        return none
    for a, b in zip(first[among], stop[among], strict=True):
        none[a + 1 : b + 1] = True
    return none


def find_spikes(v: Array, valid: Any, step: float) -> Array:
    r"""Return the height of isolated spikes, 0 where there is none.

    A spike is off the line through the two samples before it, off the line through the two after
    it, and off the middle of its neighbours, all to the same side; a jump or a kink agrees with one
    of them. The smallest of the three must exceed what noise of the signal's own size reaches once
    in a thousand records of this length, half as much again, and the curvature around.

    Parameters
    ----------
    v : ndarray, shape (n,)
        Signal.
    valid : ndarray of bool, shape (n,)
        Samples that count.
    step : float
        Quantisation step, or 0.

    Returns
    -------
    ndarray, shape (n,)
        Heights [signal unit].
    """
    height = np.zeros(len(v))
    if len(v) < 2 * QUIET + 1:
        return height
    c = v[2:-2]
    off = np.array([
        c - 2 * v[1:-3] + v[:-4], c - 2 * v[3:-1] + v[4:], c - 0.5 * (v[1:-3] + v[3:-1])
    ])  # fmt: skip
    small = np.min(np.abs(off), axis=0)
    small[np.abs(np.sign(off).sum(axis=0)) < 3] = 0.0
    clear = ndimage.minimum_filter1d(valid.astype(np.int8), 5)[2:-2] > 0
    curvature = np.where(ndimage.minimum_filter1d(valid.astype(np.int8), 3)[1:-1] > 0,
                    np.abs(np.diff(v, 2)), 0.0)  # fmt: skip
    if not clear.any():
        return height
    noise = max(robust_deviation(off[2][clear]), step, 1e-9 * float(np.ptp(v)))
    bound = 1.5 * float(stats.norm.isf(0.0005 / len(v))) * noise
    # Curvature centred 3 to 8 samples away on either side does not touch the spike.
    wide, reach = np.pad(curvature, QUIET + 1), QUIET - 2
    most = ndimage.maximum_filter1d(wide, reach, origin=-(reach // 2))
    at = np.arange(2, len(v) - 2)
    around = np.maximum(most[at], most[at + QUIET + 3])
    found = clear & (small > bound) & (small > 1.5 * around)
    height[2:-2][found] = off[2][found]
    return height


def find_drift(y: Array, causes: Sequence[Array]) -> tuple[float, float, float]:
    r"""Return how far a signal drifts over the record, next to what its causes explain.

    .. math:: \bar y_i = c + \sum_j g_j \bar w_{ij} + d_1 t_i + d_2 t_i^2 + d_3 t_i^3 + e_i

    over means of up to 40 blocks, with the F-test of d. Where neighbouring e are alike there are
    fewer independent blocks.

    Parameters
    ----------
    y : ndarray, shape (n,)
        Signal.
    causes : sequence of ndarray
        Signals that may move it.

    Returns
    -------
    change : float
        Difference of the largest and the smallest value of the drift [signal unit].
    scatter : float
        Standard deviation of the signal about its causes and the drift.
    p_value : float
        Probability of such a drift by chance.
    """
    n = len(y)
    m = min(BLOCKS, n // 20)
    if m < 10:
        return 0.0, 0.0, 1.0
    edges = np.linspace(0, n, m + 1).astype(int)[:-1]
    size = np.diff(np.append(edges, n))

    def columns(signals: Sequence[Array], t: Array) -> Array:
        scaled = [(w - np.mean(w)) / s for w in signals if (s := float(np.std(w))) > 0]
        return np.column_stack([np.ones(len(t)), *scaled, t, t**2, t**3])

    def split(target: Array, table: Array) -> tuple[Array, Array]:
        beta = np.asarray(np.linalg.lstsq(table, target, rcond=1e-9)[0], dtype=float)
        return beta, target - table @ beta

    def means(s: Array) -> Array:
        out: Array = np.add.reduceat(s, edges) / size
        return out

    y = y - y[0]
    some = slice(None, None, max(1, n // PLENTY))
    whole = columns([w[some] for w in causes], np.linspace(-1, 1, n)[some])
    beta, e = split(y[some], whole)
    change = float(np.ptp(whole[:: max(1, len(e) // 200), -3:] @ beta[-3:]))
    scatter = float(np.std(e))
    if scatter <= 1e-9 * float(np.std(y)):
        return change, scatter, 1.0
    table = columns([means(w) for w in causes], np.linspace(-1, 1, m))
    _, left = split(means(y), table[:, :-3])
    _, e = split(means(y), table)
    rss = float(e @ e)
    # Neighbouring blocks that are alike make fewer independent ones.
    alike = float(np.clip(e[1:] @ e[:-1] / max(rss, 1e-300), 0.0, 0.9))
    free = max((m - table.shape[1]) * (1 - alike) / (1 + alike), 2.0)
    f = (float(left @ left) - rss) / 3 / max(rss / free, 1e-300)
    return change, scatter, float(stats.f.sf(f, 3, free))


def find_share_beyond_controller(u: Array, y: Array, valid: Any) -> float:
    """Return the share of u's variance that no linear law of y and past u gives, at most ten back.

    Parameters
    ----------
    u, y : ndarray, shape (n,)
        Input and output.
    valid : ndarray of bool, shape (n,)
        Samples that count.

    Returns
    -------
    float
        0 where a linear controller of a constant reference computes u; 1 with too few samples.
    """
    order = 10
    rows = np.flatnonzero(find_whole_past(valid, order))[:ENOUGH]
    if len(rows) < 4 * order:
        return 1.0
    law = np.column_stack([
        np.ones(len(rows)), *(y[rows - k] - y[0] for k in range(order + 1)),
        *(u[rows - k] - u[0] for k in range(1, order + 1)),
    ])  # fmt: skip
    target = u[rows] - np.mean(u[rows])
    left = target - law @ regress(law, target, 1e-12)
    return float(left @ left) / max(float(target @ target), 1e-300)


def find_period(r: Array) -> int:
    r"""Return after how many samples a signal repeats itself, at least once, or 0.

    .. math:: D(P) = \operatorname{mean}_k (r_{k+P} - r_k)^2

    is zero at a period. Nearly is enough: less than 2 % of the signal's size and a quarter of
    D(1), the price of being one sample off.

    Parameters
    ----------
    r : ndarray, shape (n,)
        Signal.

    Returns
    -------
    int
        The smallest period of at most half the length.
    """
    n, v = len(r), r - np.mean(r)
    variance = float(np.mean(v**2))
    if n < 8 or variance <= estimate_rounding(r) ** 2:
        return 0
    lags = np.arange(n // 2 + 1)
    products = compute_lagged_products(v, v, n // 2)
    power = np.concatenate([[0.0], np.cumsum(v**2)])
    D = (power[n - lags] + power[n] - power[lags] - 2 * products) / (n - lags)
    near = min(4e-4 * variance, 0.25 * float(D[1])) > D
    near[:2] = False
    first, stop = find_runs(near)
    if not first.size:
        return 0
    best = int(first[0] + np.argmin(D[first[0] : stop[0]]))
    # What repeats must not be mere rest: the part repeated has to hold most of the motion.
    return best if float(np.var(v[:best])) > 0.1 * variance else 0
