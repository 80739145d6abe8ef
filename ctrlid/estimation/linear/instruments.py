"""Signals from outside the loop, and what their past explains of y and u: first instruments."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from ..._base import text as _text
from ..._base.arguments import is_iterable
from ..._base.arrays import Array
from ..._base.errors import CtrlidError
from ..._base.statistics import regress
from ...data.record import Record
from .regression import block_qr, merge_factors

Signals = list[tuple[Array, Array]]

# Delayed references reach back by at most so many samples, which bounds the regression.
_LONGEST = 8192
# Singular values of delayed references below this share of the largest are rounding errors.
_SMALLEST = 1e-8


@dataclass(frozen=True, eq=False)
class Piece:
    """A stretch of valid samples of one record, levels taken off.

    ``y`` is ``(n,)``, ``u`` is ``(inputs, n)``, ``w`` is ``(signals, n)`` with the external
    signals; ``owner`` is the number of the record and ``levels`` what was taken off y and each u.
    """

    owner: int
    y: Array
    u: Array
    w: Array
    levels: tuple[float, ...]


def cut_pieces(
    records: Sequence[Record], names: Sequence[str], intercept: bool, shortest: int
) -> Any:
    """Cut records into valid stretches.

    Parameters
    ----------
    records : sequence of Record
        Experiments.
    names : sequence of str
        External signals: ``"r"`` or channels of ``extra``.
    intercept : bool
        Take off the means, since a constant is estimated anyway.
    shortest : int
        Stretches of fewer samples are left out.

    Returns
    -------
    list of Piece
        In order.
    """
    pieces = []
    for owner, record in enumerate(records):
        w = np.vstack([record.r if name == "r" else record.extra[name] for name in names])
        u = np.atleast_2d(record.u)
        levels = (0.0,) * (1 + len(u))
        if intercept and record.valid.any():
            levels = tuple(float(signal[record.valid].mean()) for signal in (record.y, *u))
            w = w - w[:, record.valid].mean(axis=1, keepdims=True)
        y, u = record.y - levels[0], u - np.array(levels[1:])[:, None]
        for i, j in record.segments():
            if j - i >= shortest:
                pieces.append(Piece(owner, y[i:j], u[:, i:j], w[:, i:j], levels))
    return pieces


def project_on_references(pieces: Sequence[Piece]) -> Signals:
    r"""Project y and u on the past of the external signals: the first of two least squares.

    .. math:: \hat y(k) = \sum_i g_i \sum_{l \in I_i} w(k - l)

    The delays l run in windows I that widen geometrically, 0, 1, 2, 3, 4-5, 6-7, 8-11, ..., so that
    few coefficients follow a response fast or slow.

    Parameters
    ----------
    pieces : sequence of Piece
        Data.

    Returns
    -------
    list of (array, array)
        Of each piece what of y and u the external signals explain.

    References
    ----------
    Van den Hof and Schrama, "An indirect method for transfer function estimation from closed loop
    data", Automatica 29 (1993).
    """
    longest = max(len(piece.y) for piece in pieces)
    edges = _choose_windows(min(_LONGEST, longest // 8))
    m = (len(edges) - 1) * len(pieces[0].w)
    factors = []
    for piece in pieces:
        sums = [_compute_running_sums(w, edges[-1]) for w in piece.w]

        def fill(out: Array, start: int, stop: int, p: Piece = piece, s: Any = sums) -> None:
            out[:, 0] = 1.0
            out[:, 1 : m + 1] = _average_delays(s, edges, start, stop)
            out[:, m + 1], out[:, m + 2 :] = p.y[start:stop], p.u[:, start:stop].T

        factors.append(block_qr(fill, len(piece.y), m + 2 + len(piece.u))[1:, 1:])
    total = merge_factors(factors)
    g = regress(total[:, :m], total[:, m:], _SMALLEST)
    found = []
    for piece in pieces:
        sums, n = [_compute_running_sums(w, edges[-1]) for w in piece.w], len(piece.y)
        blocks = [_average_delays(sums, edges, i, min(i + 4096, n)) @ g for i in range(0, n, 4096)]
        both = np.vstack(blocks)
        found.append((both[:, 0].copy(), both[:, 1:].T.copy()))
    return found


def compute_independence_probability(errors: Sequence[Array], references: Sequence[Array]) -> float:
    r"""Return the probability that white errors depend so much on past references by chance.

    .. math:: e^T P_W e / \hat\sigma^2 \sim \chi^2_m

    for the projection :math:`P_W` on m averages of the references over windows of delays, those of
    `project_on_references` without the same sample. What has moved the loop before explains
    nothing of the errors of a right model, also where the references themselves react to y. Errors
    of a fit, which explains part of them itself, give small probabilities less often.

    Parameters
    ----------
    errors : sequence of (n,) array
        Errors of a model, each stretch without a gap; NaN where there are none.
    references : sequence of (signals, n) array
        The references of each stretch.

    Returns
    -------
    float
        The probability; 1 where nothing moves the loop, or too little is known.

    References
    ----------
    Ljung, *System Identification*, section 16.6.
    """
    edges = _choose_windows(min(_LONGEST, max(map(len, errors)) // 8))[1:]
    m = (len(edges) - 1) * len(references[0])
    factors, rows = [], 0
    for e, w in zip(errors, references, strict=True):
        sums = [_compute_running_sums(row - row[0], edges[-1]) for row in w]
        known = np.isfinite(e)

        def fill(
            out: Array, start: int, stop: int, e: Array = e, s: Any = sums, known: Any = known
        ) -> None:
            out[:, 0] = 1.0
            out[:, 1 : m + 1] = _average_delays(s, edges, start, stop)
            out[:, m + 1] = e[start:stop]
            out[~known[start:stop]] = 0.0

        factors.append(block_qr(fill, len(e), m + 2)[1:, 1:])
        rows += max(int(np.count_nonzero(known)) - 1, 0)
    total = merge_factors(factors)
    table, goal = total[:, :m], total[:, m]
    sizes = np.linalg.svd(table, compute_uv=False)
    rank = int(np.count_nonzero(sizes > _SMALLEST * sizes.max(initial=0.0)))
    if not rank or rows <= 2 * rank:
        return 1.0
    explained = float(np.sum((table @ regress(table, goal, _SMALLEST)) ** 2))
    variance = (float(goal @ goal) - explained) / (rows - rank)
    return float(stats.chi2.sf(explained / variance, rank)) if variance > 0 else 1.0


def _choose_windows(reach: int) -> list[int]:
    edges = [0, 1, 2, 3, 4]
    while edges[-1] < reach:
        edges.append(edges[-1] + max(1, 1 << (edges[-1].bit_length() - 2)))
    return edges


def _compute_running_sums(w: Array, reach: int) -> Array:
    """Return running sums; the signal waits at its first value before the first sample."""
    return np.concatenate([[0.0], np.cumsum(np.concatenate([np.full(reach, w[0]), w]))])


def _average_delays(sums: Sequence[Array], edges: list[int], start: int, stop: int) -> Array:
    columns = []
    at = edges[-1] + 1 + np.arange(start, stop)
    for s in sums:
        for near, far in itertools.pairwise(edges):
            columns.append((s[at - near] - s[at - far]) / (far - near))
    return np.column_stack(columns)


def check_instruments(records: Sequence[Record], instruments: Any) -> tuple[str, ...]:
    """Return the names of the external signals, refused in words where they cannot serve.

    Parameters
    ----------
    records : sequence of Record
        Experiments.
    instruments : str or sequence of str
        ``"r"`` or names of extra channels.

    Returns
    -------
    tuple of str
        The names.

    Raises
    ------
    CtrlidError
        If a signal is missing, constant, or is u or y itself.
    """
    one = isinstance(instruments, str) or not is_iterable(instruments)
    names = (instruments,) if one else tuple(instruments)
    if not names or not all(isinstance(name, str) for name in names):
        raise CtrlidError(
            f"instruments names external signals, 'r' or channels of extra; given {instruments!r}."
        )
    for number, record in enumerate(records, start=1):
        where = f"Record {number} of {len(records)}" if len(records) > 1 else "The record"
        for name in names:
            if name in ("u", "y"):
                raise CtrlidError(
                    f"{name} cannot be an instrument: the feedback carries the noise into it. Name "
                    "a signal from outside the loop, 'r' or an injected one in extra."
                )
            channel = record.r if name == "r" else record.extra.get(name)
            if channel is None:
                raise CtrlidError(_explain_missing(where, name, record))
            counted = np.atleast_2d(channel)[:, record.valid]
            if counted.size and not np.ptp(counted, axis=1).any():
                raise CtrlidError(
                    f"{where} has a constant {name}: nothing from outside moves the loop, so there "
                    "is no instrument. Vary the reference (random_binary), or name an injected "
                    "signal with instruments=. Without either use fit_continuous, which needs u "
                    "and y only, or fit_loop for physical parameters."
                )
    return names


def _explain_missing(where: str, name: str, record: Record) -> str:
    has = _text.write_list([repr(key) for key in record.extra])
    if name != "r":
        return f"{where} has no extra channel {name!r}; it has {has or 'none'}."
    return (
        f"{where} has no reference r. Instruments must come from outside the loop: log the "
        "reference, or, if a dither or pulses were added to u, put them into extra and name them, "
        "instruments='dither'" + (f" (there is {has})" if has else "") + ". Without either use "
        "fit_continuous, which needs u and y only, or fit_loop for physical parameters."
    )
