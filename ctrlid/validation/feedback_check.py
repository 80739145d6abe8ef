"""check_feedback(): whether a record was taken in closed loop."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import linalg, stats

from .._base.arguments import check_arguments, explain_names
from .._base.arrays import Array, freeze_arrays
from .._base.errors import CtrlidError
from .._base.rounding import keep_numpy_quiet
from .._base.signals import require_one_signal
from .._base.statistics import robust_deviation
from .._base.text import Printed, write_count
from ..data.record import Record
from ..data.validity import find_whole_past
from .residual_tests import Correlation, cross_correlation

# A check needs so many valid samples in succession.
FEWEST = 60
# This is the probability of calling an open loop closed.
LEVEL = 1e-3
# Regressions use at most so many past samples of each signal.
ORDER = 20
# A controller shows itself within so many samples.
LAGS = 8
# More rows do not change what a regression says.
MOST = 50_000
# A remainder below this share of a signal's standard deviation is rounding of a short regression.
NOTHING = 1e-7
# A long regression leaves this share of the standard deviation of a signal without noise.
ROUNDING = 1e-11
# An exact controller is sought with at most so many past samples.
EXACT_LAGS = 6
# A band-limited input midway between two samples takes its next but one sample with a third of the
# weight of the next one, sinc(3/2) / sinc(1/2): so far a correlation at lag 0 reaches to others.
TAIL = 1 / 3
# A straight input moves a slow plant in the period before its sample half as far as in both. Where
# u is said to be held, it must show that; under feedback y would have to double what is new in it.
FURTHER = 2.0
# If y takes away all but this share of what r and past u leave of u, u is computed from y.
TELLING = 0.01


@dataclass(frozen=True, eq=False, repr=False)
class FeedbackCheck(Printed):
    """What `check_feedback` found.

    Parameters
    ----------
    closed_loop : bool
        Whether u reacts to y.
    p_value : float
        Probability of correlations as large as these if it does not; 0 or 1 where an exact
        function decided.
    lags : ndarray of int
        Lags in samples: at lag tau, u is compared with what was new in y tau samples before.
    correlation : ndarray
        Correlation coefficients; empty where an exact function decided.
    text : str
        The finding in words.
    """

    closed_loop: bool
    p_value: float
    lags: Any
    correlation: Array
    text: str

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __str__(self) -> str:
        return self.text


@explain_names
@keep_numpy_quiet
def check_feedback(record: Record) -> FeedbackCheck:
    r"""Check whether u was computed from y, from the record alone.

    .. math:: e_k = y_k - \hat E(y_k \mid y, u \text{ before } k), \quad
        w_k = u_k - \hat E(u_k \mid u \text{ before } k, \; r), \quad
        \operatorname{E} w_k e_{k-\tau} = 0 \text{ for } \tau \ge 0 \text{ in open loop}

    Both expectations are long linear regressions. What is new in y, sensor noise and disturbances,
    cannot show in an input that was made without looking at y; a controller cannot help showing
    it. The test is of all lags together, with the covariance that the colours of e and w give.
    Without any noise e is nothing, and the law itself is looked for: with fewer past samples u is
    an exact function of r and y than of r alone, or the plant is unstable and y stays bounded all
    the same.

    Parameters
    ----------
    record : Record
        The record, with the reference if there is one.

    Returns
    -------
    FeedbackCheck
        The answer, its probability of being chance, and the correlations.

    Raises
    ------
    CtrlidError
        If u or y is constant, or there are fewer than 60 valid samples in succession.

    References
    ----------
    Caines and Chan, "Feedback between stationary stochastic processes", IEEE Transactions on
    Automatic Control 20 (1975); Granger, Econometrica 37 (1969).

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    >>> r = cid.random_binary(2000, amplitude=0.1, hold=50, seed=1)
    >>> closed = cid.simulate(cid.Loop(plant, cid.PID(kp=5.0), dt=0.01), r, sensor_noise=1e-3)
    >>> opened = cid.simulate(cid.Loop(plant, dt=0.01), d=r, sensor_noise=1e-3, seed=1)
    >>> cid.check_feedback(closed).closed_loop, cid.check_feedback(opened).closed_loop
    (True, False)
    """
    check_arguments(check_feedback, locals())
    if not isinstance(record, Record):
        raise CtrlidError(f"check_feedback needs a Record; given {type(record).__name__}")
    require_one_signal("check_feedback", record)
    found = _find_feedback(record)
    if not found.closed_loop:
        return found
    return replace(found, text=f"{found.text} {_recommend_estimator(record)}")


def _recommend_estimator(record: Record) -> str:
    """Say which estimator is consistent under feedback with what a record has."""
    if record.r is not None and record.hold == "zoh":
        return "Use an estimator that is consistent under feedback: fit_iv, by the reference."
    why = "needs no reference" if record.r is None else "knows how u runs between the samples"
    return f"Use an estimator that is consistent under feedback: fit_continuous, which {why}."


def _find_feedback(record: Record) -> FeedbackCheck:
    longest = max((b - a for a, b in record.segments()), default=0)
    if longest < FEWEST:
        raise CtrlidError(f"check_feedback needs {FEWEST} valid samples in succession; the record "
                          f"has {longest}. Record longer")  # fmt: skip
    for key in ("u", "y"):
        if np.ptp(getattr(record, key)[record.valid]) == 0:
            raise CtrlidError(f"{key} is constant, so the record does not show whether there is "
                              "feedback. Excite the loop")  # fmt: skip
    order = int(np.clip(longest // 20, 2, ORDER))
    signals = {"u": record.u, "y": record.y}
    if record.r is not None and np.ptp(record.r[record.valid]) > 0:
        same = np.corrcoef(record.r[record.valid], record.u[record.valid])[0, 1] ** 2
        if same < 1 - NOTHING:
            signals["r"] = record.r
    if "r" in signals and (
        said := _test_short_law(signals, record.valid, order, record.hold == "zoh")
    ):
        return said
    e, rows = compute_residual(signals, record.valid, "y", {"y": (1, order), "u": (1, order)})
    if np.std(e[rows]) <= ROUNDING * np.std(record.y[rows]):
        return _decide_without_noise(signals, record.valid, int(record.hold == "zoh"))
    past = {"u": (1, order + LAGS)} | ({"r": (0, order)} if "r" in signals else {})
    w, rows = compute_residual(signals, record.valid, "u", past, robust=True)
    good = np.zeros(record.n, dtype=bool)
    good[rows] = True
    if np.std(w[rows]) <= NOTHING * np.std(record.u[rows]):
        return FeedbackCheck(False, 1.0, np.zeros(0, int), np.zeros(0),
                             "No feedback found: u is a function of its own past "
                             f"{'and r ' if 'r' in signals else ''}alone.")  # fmt: skip
    test = cross_correlation(w, e, good, "y", lags=LAGS, first=0)
    p, moved = _compute_p_value(test), False
    least = FURTHER if record.hold == "zoh" else 1.0
    seen = abs(test.values[0]) > test.band
    if seen and _is_tie_of_plant(signals, record.valid, w, e, order, least):
        # Lag 0 says how u runs on between the samples, and so do the next lags up to its tail.
        moved = True
        p = _compute_p_value(cross_correlation(w, e, good, "y", lags=LAGS, first=1))
        if np.max(np.abs(test.values[1:])) <= TAIL * abs(test.values[0]) + test.band:
            p = 1.0
    elif record.hold == "foh":
        later = _compute_p_value(cross_correlation(w, e, good, "y", lags=LAGS, first=1))
        p = min(1.0, 2 * min(p, later))
    closed = p < LEVEL
    if closed:
        worst = int(np.argmax(np.abs(test.values[int(moved) :]))) + int(moved)
        text = (f"Closed loop: u depends on the innovations of y (correlation "
                f"{test.values[worst]:+.2g} after {write_count(int(test.lags[worst]), 'sample')}, "
                f"p = {p:.1g}).")  # fmt: skip
    elif moved:
        text = (
            "No feedback found: u and y go together within a sample, but in the direction in which "
            "u moves y, and further in the next one. So u is not held between the samples"
        )
        text += (
            ": give the record hold='foh', or hold='bandlimited' for a measured input."
            if record.hold == "zoh"
            else "."
        )
    else:
        text = (f"No feedback found: u does not depend on the innovations of y (p = {p:.2g}). The "
                "loop is open, or its feedback is too weak to be seen.")  # fmt: skip
    return FeedbackCheck(closed, p, test.lags, test.values, text)


def _compute_p_value(test: Correlation) -> float:
    """Return the chance of all correlations together, and not less than that of the largest."""
    largest = float(np.max(np.abs(test.values))) / test.band * stats.norm.ppf(0.995)
    return float(max(test.p_value, min(1.0, 2 * len(test.lags) * stats.norm.sf(largest))))


def _test_short_law(
    signals: dict[str, Array], valid: Any, order: int, held: bool
) -> FeedbackCheck | None:
    """Return the answer if a short law of r and y gives u, and none of r alone comes near.

    A held input is no function of y up to now if it was made without it, so there an exact law
    need only be shorter than any of r alone.
    """

    def rest(keys: str, n: int) -> float:
        past = {k: (int(k == "u"), n) for k in keys if n or k != "u"}
        left, rows = compute_residual(signals, valid, "u", past)
        return float(np.std(left[rows]))

    least, size = rest("ur", order), float(np.std(signals["u"][valid]))
    for n in range(EXACT_LAGS // 2 + 1):
        left = rest("uyr", n)
        shorter = held and left <= min(NOTHING * size, TELLING * rest("ur", n))
        if shorter or (least > NOTHING * size and left <= TELLING * least):
            return FeedbackCheck(
                True, 0.0, np.zeros(0, int), np.zeros(0),
                f"Closed loop: u is nearly exactly a function of r and y {_write_reach(n)}, and "
                "not of r and past u alone.",
            )  # fmt: skip
    return None


def _is_tie_of_plant(
    signals: dict[str, Array], valid: Any, w: Array, e: Array, order: int, least: float
) -> bool:
    """Return whether the plant, and not a controller, may tie u to y of the same sample.

    An input that is not held moves y within its own period, but a plant goes on in the same
    direction and further in the next, by `least` times.
    """
    ahead = {"y": (2, order + 1), "u": (2, order + 1)}
    next_e, rows = compute_residual(signals, valid, "y", ahead)
    now = float(np.mean(w[rows] * e[rows]))
    next_ = float(np.mean(w[rows - 1] * next_e[rows]))
    return now * next_ > 0 and abs(next_) > least * abs(now)


def compute_residual(
    signals: dict[str, Array],
    valid: Any,
    target: str,
    past: dict[str, tuple[int, int]],
    robust: bool = False,
) -> tuple[Array, Any]:
    """Return what a regression on past samples leaves of a signal, and the rows that count.

    Robust means that jumps, of an unknown reference for instance, neither bend the regression nor
    weigh more in what it leaves than three times the usual remainder.
    """
    reach = max(last for _, last in past.values())
    rows = np.flatnonzero(find_whole_past(valid, reach))[:MOST]
    mean = {k: float(np.mean(v[rows])) for k, v in signals.items()}
    columns = [np.ones(len(rows))]
    for key, (first, last) in past.items():
        columns += [signals[key][rows - k] - mean[key] for k in range(first, last + 1)]
    table = np.column_stack(columns)
    size = np.linalg.norm(table, axis=0)
    table = table[:, size > 0] / size[size > 0]
    goal = signals[target][rows] - mean[target]
    left = goal - table @ _solve_least_squares(table, goal)
    for _ in range(4 if robust else 0):
        usual = 3 * robust_deviation(left)
        if usual <= NOTHING * float(np.std(goal)):
            break
        weight = np.sqrt(usual / np.maximum(np.abs(left), usual))
        beta = _solve_least_squares(table * weight[:, None], goal * weight)
        left = goal - table @ beta
        goal = table @ beta + np.clip(left, -usual, usual)
    # A clipped signal is no longer uncorrelated with the past, so that it is regressed once more.
    if robust:
        left = goal - table @ _solve_least_squares(table, goal)
    out = np.zeros(len(valid))
    out[rows] = left
    return out, rows


def _solve_least_squares(table: Array, goal: Array) -> Array:
    return np.asarray(linalg.lstsq(table, goal, cond=1e-13, lapack_driver="gelsy")[0], dtype=float)


def _find_exact_order(
    signals: dict[str, Array], valid: Any, keys: str, target: str, now: int
) -> int:
    """Return how many past samples make a signal an exact function; beyond `EXACT_LAGS`: none."""
    for order in range(EXACT_LAGS + 1):
        past = {k: (now if k == target or target == "y" else 0, order) for k in keys}
        past = {k: (1 if k == target else first, last) for k, (first, last) in past.items()}
        left, rows = compute_residual(signals, valid, target, past)
        if np.std(left[rows]) <= NOTHING * np.std(signals[target][rows]):
            return order
    return EXACT_LAGS + 1


def _decide_without_noise(signals: dict[str, Array], valid: Any, now: int) -> FeedbackCheck:
    """Decide without noise, by the laws that hold exactly."""

    def answer(closed: bool, text: str) -> FeedbackCheck:
        return FeedbackCheck(closed, 0.0 if closed else 1.0, np.zeros(0, int), np.zeros(0), text)

    if "r" in signals:
        with_y = _find_exact_order(signals, valid, "uyr", "u", now)
        without = _find_exact_order(signals, valid, "ur", "u", now)
        if with_y < without:
            return answer(True, "Closed loop: there is no noise, and u is an exact function of r "
                          f"and y {_write_reach(with_y)}, while one of r alone needs more "
                          "samples.")  # fmt: skip
    order = _find_exact_order(signals, valid, "yu", "y", now)
    if 0 < order <= EXACT_LAGS and _is_unstable(signals, valid, order, now):
        return answer(True, "Closed loop: there is no noise, and y stays bounded although the "
                      "plant is unstable.")  # fmt: skip
    return answer(False, "No feedback found: there is no noise in y that could appear in u, and "
                  "u can be explained without y. Without noise this does not prove an open "
                  "loop.")  # fmt: skip


def _write_reach(n: int) -> str:
    """Say which samples a controller uses."""
    return f"at the present and {write_count(n, 'past sample')}" if n else "at the present sample"


def _is_unstable(signals: dict[str, Array], valid: Any, order: int, now: int) -> bool:
    """Return whether the exact difference equation has a pole clearly outside the unit circle."""
    rows = np.flatnonzero(find_whole_past(valid, order))[:MOST]
    y, u = signals["y"], signals["u"]
    columns = [y[rows - k] - y[rows[0]] for k in range(1, order + 1)]
    columns += [u[rows - k] - u[rows[0]] for k in range(now, order + 1)]
    table = np.column_stack([*columns, np.ones(len(rows))])
    size = np.linalg.norm(table, axis=0)
    beta = _solve_least_squares(table / size, y[rows] - y[rows[0]]) / size
    poles = np.roots(np.concatenate([[1.0], -beta[:order]]))
    return bool(np.max(np.abs(poles)) > 1 + 1e-4)
