"""select_order(): poles, numerator coefficients and delay, held against one long regression."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from numbers import Integral
from typing import Any

import numpy as np
from scipy import linalg, stats

from .._base.arguments import check_arguments, explain_names
from .._base.arrays import Array, freeze_arrays
from .._base.criterion import bayesian_penalty
from .._base.errors import CtrlidError
from .._base.rounding import keep_numpy_quiet
from .._base.signals import require_one_signal
from .._base.statistics import regress
from .._base.text import Printed, write_count
from ..data.record import Record
from ..data.validity import find_whole_past

# The long regression has at most so many lags.
LONGEST = 60
# The long regression uses at most so many rows, which determine it well.
ROWS = 30_000
# This share of the record is fitted, and the rest judges.
SHARE = 2 / 3
# A weighted fit that needs more iterations does not converge.
ITERATIONS = 20
# A one-step error that differs by more than this share says that the choice is wrong.
COSTS = 0.1
# Noise of this share of y's standard deviation is added, since a long regression on noise-free
# signals has no unique answer.
ADDED_NOISE = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class OrderRow(Printed):
    """One structure and how it fares.

    Parameters
    ----------
    na, nb, nk : int
        Poles, numerator coefficients, delay in samples.
    misfit : float
        Chi-square distance to the long regression [1].
    p_value : float
        Probability of such a distance by chance if the structure is right.
    bic : float
        Misfit plus a penalty for each coefficient; the smallest is best.
    held_out : float
        Ratio: one-step error on the part of the record that was not fitted, over that of the long
        regression there.
    values : ndarray
        Coefficients ``a1 .. a_na, b1 .. b_nb``.
    """

    na: int
    nb: int
    nk: int
    misfit: float
    p_value: float
    bic: float
    held_out: float
    values: Array

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __str__(self) -> str:
        return (f"na = {self.na}, nb = {self.nb}, nk = {self.nk}: misfit {self.misfit:.4g}, "
                f"p = {self.p_value:.2g}, BIC {self.bic:.5g}, held-out error "
                f"{self.held_out:.4f}")  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class OrderChoice(Printed):
    """What `select_order` found.

    Parameters
    ----------
    na, nb, nk : int
        The structure chosen, as `fit_arx` and `fit_iv` take it.
    rows : tuple of OrderRow
        All structures, best first.
    length : int
        Lags of the long regression.
    text : str
        The choice in words.
    """

    na: int
    nb: int
    nk: int
    rows: tuple[OrderRow, ...]
    length: int
    text: str

    def __str__(self) -> str:
        lines = ["   na  nb  nk      misfit  p-value         BIC   held-out error"]
        lines += [
            f"  {row.na:>3} {row.nb:>3} {row.nk:>3} {row.misfit:>11.4g} {row.p_value:>8.2g} "
            f"{row.bic:>11.5g} {row.held_out:>16.4f}"
            for row in self.rows[:12]
        ]
        if len(self.rows) > 12:
            lines.append(f"  ... and {len(self.rows) - 12} more")
        return "\n".join([*lines, self.text])


@explain_names
@keep_numpy_quiet
def select_order(
    record: Record,
    na: Iterable[int] = range(1, 5),
    nb: Iterable[int] = range(1, 4),
    nk: Iterable[int] = range(1, 4),
) -> OrderChoice:
    r"""Choose the orders of a difference equation, in open or closed loop, whatever the noise.

    .. math:: \hat A_n y = \hat B_n u + e, \qquad
        \min_{A, B} \; r^T (T P T^T)^{-1} r, \quad r = A \hat B_n - B \hat A_n

    Comparing the residuals of short least-squares fits goes wrong here: with sensor noise they ask
    for ever more coefficients, which describe the noise. So one long regression takes plant and
    noise together; it is right under feedback too. Then each structure B / A is held against it:
    r is zero where both have the same transfer function, whatever the noise model, and the
    covariance P of the long regression says how much of r is chance. The criterion is that
    distance plus log N for each coefficient, where a distance that even the richest structure
    cannot bring down to chance (a plant that is not quite linear) counts as the unit. The last
    third of the record is not fitted and shows what each structure costs in prediction.

    Parameters
    ----------
    record : Record
        The record; no reference is needed.
    na, nb, nk : iterable of int, optional
        Numbers of poles, of numerator coefficients and delays to try.

    Returns
    -------
    OrderChoice
        The structure, the table and words.

    Raises
    ------
    CtrlidError
        If orders are not positive, the record is too short for them, or u or y is constant.

    References
    ----------
    Galrinho, Rojas and Hjalmarsson, "Parametric identification using weighted null-space fitting",
    IEEE Transactions on Automatic Control 64 (2019); Schwarz, Annals of Statistics 6 (1978).

    Examples
    --------
    >>> import control as ct
    >>> import ctrlid as cid
    >>> P = ct.tf([-6.5], [1, 0, -1600])
    >>> C = cid.design_lead(P, crossover=100, phase_margin=50)
    >>> C = ct.sample_system(ct.ss(C), 0.004, "tustin")
    >>> r = cid.random_binary(8000, amplitude=1e-4, hold=8, seed=1)
    >>> record = cid.simulate(cid.Loop(P, C, dt=0.004), r, sensor_noise=2e-6, seed=2)
    >>> choice = cid.select_order(record)
    >>> choice.na, choice.nb, choice.nk
    (2, 2, 1)
    """
    check_arguments(select_order, locals(), "record", "na", "nb", "nk")
    if not isinstance(record, Record):
        raise CtrlidError(f"select_order needs a Record; given {type(record).__name__}")
    require_one_signal("select_order", record)
    grids = [
        _check_whole_numbers(name, values) for name, values in (("na", na), ("nb", nb), ("nk", nk))
    ]
    most = max(grids[0]) + max(grids[1]) + max(grids[2])
    cut, gain = int(SHARE * record.n), 1.0
    if record.valid.any():
        for key in ("u", "y"):
            if np.ptp(getattr(record, key)[record.valid]) == 0:
                raise CtrlidError(f"{key} is constant, so no structure can be selected. Excite the "
                                  "loop")  # fmt: skip
        record, gain = _take_scales_off(record)
    length = _choose_length(record, cut, most)
    long = _fit_long_regression(record, 0, cut, length)
    judge = _find_rows(record, cut, record.n, length)
    table, goal = _make_table(record, judge, length)
    reference = float(np.std(goal - table @ long.eta)) if len(judge) > 10 else np.nan
    found = []
    for a in grids[0]:
        for b in grids[1]:
            for d in grids[2]:
                theta, misfit, eta = _fit_structure(long, a, b, d)
                left = goal - table[:, :-1] @ eta
                error = float(np.std(left)) / reference if len(judge) > 10 else np.nan
                found.append((a, b, d, misfit, length - a - b, error, theta))
    unit = max(1.0, min(misfit / free for *_, misfit, free, _, _ in found))
    rows = sorted(
        (OrderRow(a, b, d, misfit, float(stats.chi2.sf(misfit / unit, free)),
                  misfit / unit + 2 * bayesian_penalty(a + b, long.rows), error,
                  np.concatenate([theta[:a], gain * theta[a:]]))
         for a, b, d, misfit, free, error, theta in found),
        key=lambda row: row.bic,
    )  # fmt: skip
    best = rows[0]
    return OrderChoice(best.na, best.nb, best.nk, tuple(rows), length,
                       _write_choice(rows, unit, length))  # fmt: skip


def _take_scales_off(record: Record) -> tuple[Record, float]:
    """Return the record with u and y of size one, and what that multiplies the coefficients by."""
    u, y = (float(np.max(np.abs(s[record.valid]))) for s in (record.u, record.y))
    if not 0 < (gain := y / u) < np.inf:
        raise CtrlidError(f"y is up to {y:.3g} and u up to {u:.3g}: their ratio is no number that "
                          "a computer holds. Give them other units")  # fmt: skip
    return replace(record, u=record.u / u, y=record.y / y), gain


@dataclass(frozen=True, eq=False)
class _Long:
    """The long regression: coefficients of A, then of B, then a constant; covariance without it."""

    eta: Array
    covariance: Array
    variance: float
    rows: int
    length: int


def _check_whole_numbers(name: str, values: Any) -> list[int]:
    listed = np.atleast_1d(values) if isinstance(values, np.ndarray) else values
    listed = list(listed) if isinstance(listed, Iterable) else [listed]
    if not listed or not all(isinstance(v, Integral) and int(v) >= 1 for v in listed):
        raise CtrlidError(f"{name} takes whole numbers from 1, as range(1, 5); given {listed}")
    return sorted({int(v) for v in listed})


def _find_rows(record: Record, start: int, stop: int, length: int) -> Any:
    """Return the samples whose past counts, not more than are needed."""
    return start + np.flatnonzero(find_whole_past(record.valid[start:stop], length))[:ROWS]


def _make_table(record: Record, rows: Any, length: int) -> tuple[Array, Array]:
    y, u = (s - np.mean(s[record.valid]) for s in (record.y, record.u))
    spread = float(np.std(y[record.valid]))
    y = y + ADDED_NOISE * spread * np.random.default_rng(1).standard_normal(len(y))
    past = [-y[rows - k] for k in range(1, length + 1)] + [
        u[rows - k] for k in range(1, length + 1)
    ]
    return np.column_stack([*past, np.ones(len(rows))]), y[rows]


def _fit_long_regression(
    record: Record, start: int, stop: int, length: int, reach: int = 0
) -> _Long:
    rows = _find_rows(record, start, stop, max(length, reach))
    if len(rows) < 4 * length + 20:
        raise CtrlidError(f"a regression on {write_count(length, 'lag')} needs {4 * length + 20} "
                          f"equations; the "
                          f"first two thirds of the record give {len(rows)}. Record longer, or try "
                          "lower orders")  # fmt: skip
    table, goal = _make_table(record, rows, length)
    size = np.maximum(np.linalg.norm(table, axis=0), 1e-300)
    _, values, vt = np.linalg.svd(np.linalg.qr(table / size, mode="r"))
    values = np.maximum(values, 1e-13 * values[0])
    inverse = (vt.T / values**2) @ vt / np.outer(size, size)
    eta = inverse @ (table.T @ goal)
    # One step of iterative refinement removes the rounding of the inverse.
    eta = eta + inverse @ (table.T @ (goal - table @ eta))
    left = goal - table @ eta
    variance = float(left @ left) / (len(rows) - table.shape[1])
    return _Long(eta, variance * inverse[:-1, :-1], variance, len(rows), length)


def _choose_length(record: Record, cut: int, most: int) -> int:
    """Choose the lags of the long regression by the Bayesian criterion, with room to spare."""
    room = len(_find_rows(record, 0, cut, 1))
    longest = min(LONGEST, room // 12)
    if longest < most + 2:
        raise CtrlidError(f"select_order needs about {12 * (most + 2) * 3 // 2} samples in "
                          f"succession for these orders; the record has {record.n}. Record longer, "
                          "or try lower orders")  # fmt: skip
    scores = {}
    for n in sorted({most + 2, 10, 15, 20, 30, 40, longest}):
        if most + 2 <= n <= longest:
            # All lengths are compared on the same rows.
            long = _fit_long_regression(record, 0, cut, n, reach=longest)
            scores[n] = long.rows * np.log(long.variance) + 2 * bayesian_penalty(2 * n, long.rows)
    best = min(scores, key=lambda n: scores[n])
    return min(longest, max(best + 5, most + 4))


def _delay_polynomial(p: Array, k: int, length: int) -> Array:
    """Return coefficients of lags 1 to length of a polynomial from lag 0, delayed by k."""
    out = np.zeros(length + 1)
    out[k : length + 1] = p[: max(length + 1 - k, 0)]
    return out[1:]


def _fit_structure(long: _Long, na: int, nb: int, nk: int) -> tuple[Array, float, Array]:
    """Return the coefficients of a structure, its distance, and the long regression bent to it."""
    n = long.length
    A = np.concatenate([[1.0], long.eta[:n]])
    B = np.concatenate([[0.0], long.eta[n : 2 * n]])
    Q = np.column_stack([_delay_polynomial(B, i, n) for i in range(1, na + 1)]
                        + [-_delay_polynomial(A, nk + j, n) for j in range(nb)])  # fmt: skip
    start = _delay_polynomial(B, 0, n)
    theta, misfit, bent = np.zeros(na + nb), np.inf, long.eta[: 2 * n]
    scale = np.sqrt(np.diag(long.covariance))
    half = np.linalg.cholesky(long.covariance / np.outer(scale, scale) + 1e-12 * np.eye(2 * n))
    half = scale[:, None] * half
    for _ in range(ITERATIONS):
        a = np.concatenate([[1.0], theta[:na], np.zeros(n - na)])
        b = np.concatenate([np.zeros(nk), theta[na:], np.zeros(max(n + 1 - nk - nb, 0))])
        slope = np.hstack([linalg.toeplitz(np.concatenate([[0.0], -b[1:n]]), np.zeros(n)),
                           linalg.toeplitz(a[:n], np.zeros(n))])  # fmt: skip
        root = np.asarray(np.linalg.qr((slope @ half).T, mode="r"), dtype=float).T
        weighted = linalg.solve_triangular(root, np.column_stack([Q, start]), lower=True)
        size = np.linalg.norm(weighted[:, :-1], axis=0)
        new = -regress(weighted[:, :-1], weighted[:, -1], 1e-12)
        rest = weighted[:, -1] + weighted[:, :-1] @ new
        change = float(np.max(np.abs(new - theta) * size))
        theta, misfit = new, float(rest @ rest)
        bent = long.eta[: 2 * n] - half @ (
            (slope @ half).T @ linalg.solve_triangular(root, rest, lower=True, trans="T")
        )
        if change < 1e-3:
            break
    return theta, misfit, bent


def _write_choice(rows: list[OrderRow], unit: float, length: int) -> str:
    best = rows[0]
    text = (f"Chosen: na={best.na}, nb={best.nb}, nk={best.nk}, by comparison with a long "
            f"regression on {write_count(length, 'lag')} of y and u. On the last third of the "
            f"record, which was "
            f"not fitted, its one-step error is {best.held_out:.3f} times that of the long "
            "regression.")  # fmt: skip
    if len(rows) > 1:
        ahead = rows[1].bic - best.bic
        text += (f" The next structure is na={rows[1].na}, nb={rows[1].nb}, nk={rows[1].nk}; its "
                 f"BIC is larger by {ahead:.3g}"
                 f"{', NOT A CLEAR DECISION' if ahead < 6 else ''}.")  # fmt: skip
    if best.held_out < 1 - COSTS:
        text += (" THE RECORD DOES NOT DECIDE: the long regression predicts worse than the chosen "
                 "structure. The excitation is too weak or too smooth, or the record is too short. "
                 "No order can be trusted here.")  # fmt: skip
    elif best.held_out > 1 + COSTS:
        text += (" THE STRUCTURE PREDICTS WORSE than the long regression: try higher orders or "
                 "longer delays.")  # fmt: skip
    if unit > 2:
        text += (f" NO STRUCTURE FITS THE RECORD: the misfit is {unit:.2g} times that of noise. "
                 "The plant may have more poles or a nonlinearity, or it changed during the "
                 "record.")  # fmt: skip
    return text
