"""Signals that no measurement noise reaches: the external signal as it runs through the loop."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import control
import numpy as np
from numpy.typing import NDArray
from scipy import signal

from . import _text
from .data import Record
from .errors import CtrlidError
from .model import Structure
from .regression import block_qr, merge, to_differences

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Signals = list[tuple[FloatArray, FloatArray]]

_LONGEST = 8192  # samples of the past that delayed references reach back to
_HIGHEST = 4  # order up to which a controller is sought in the record


@dataclass(frozen=True, eq=False)
class Piece:
    """A stretch of valid samples of one record, levels taken off.

    ``y`` and ``u`` are ``(n,)``, ``w`` is ``(signals, n)`` with the external signals; ``owner`` is
    the number of the record and ``levels`` what was taken off y and u.
    """

    owner: int
    y: FloatArray
    u: FloatArray
    w: FloatArray
    levels: tuple[float, float]


def cut(records: Sequence[Record], names: Sequence[str], intercept: bool, shortest: int) -> Any:
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
        w = np.array([record.r if name == "r" else record.extra[name] for name in names])
        y0 = u0 = 0.0
        if intercept and record.valid.any():
            y0, u0 = float(record.y[record.valid].mean()), float(record.u[record.valid].mean())
            w = w - w[:, record.valid].mean(axis=1, keepdims=True)
        for i, j in record.segments():
            if j - i >= shortest:
                y, u = record.y[i:j] - y0, record.u[i:j] - u0
                pieces.append(Piece(owner, y, u, w[:, i:j], (y0, u0)))
    return pieces


# -- without a model: delayed references ---------------------------------------------------------


def two_stage(pieces: Sequence[Piece]) -> Signals:
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
    edges = _windows(min(_LONGEST, longest // 8))
    m = (len(edges) - 1) * len(pieces[0].w)
    factors = []
    for piece in pieces:
        sums = [_sums(w, edges[-1]) for w in piece.w]

        def fill(out: FloatArray, start: int, stop: int, p: Piece = piece, s: Any = sums) -> None:
            out[:, 0] = 1.0
            out[:, 1 : m + 1] = _delayed(s, edges, start, stop)
            out[:, m + 1], out[:, m + 2] = p.y[start:stop], p.u[start:stop]

        factors.append(block_qr(fill, len(piece.y), m + 3)[1:, 1:])
    total = merge(factors)
    scale = np.linalg.norm(total[:, :m], axis=0)
    scale[scale == 0] = 1.0
    g = np.linalg.lstsq(total[:, :m] / scale, total[:, m:], rcond=1e-8)[0] / scale[:, None]
    found = []
    for piece in pieces:
        sums, n = [_sums(w, edges[-1]) for w in piece.w], len(piece.y)
        blocks = [_delayed(sums, edges, i, min(i + 4096, n)) @ g for i in range(0, n, 4096)]
        both = np.vstack(blocks)
        found.append((both[:, 0].copy(), both[:, 1].copy()))
    return found


def _windows(reach: int) -> list[int]:
    edges = [0, 1, 2, 3, 4]
    while edges[-1] < reach:
        edges.append(edges[-1] + max(1, 1 << (edges[-1].bit_length() - 2)))
    return edges


def _sums(w: FloatArray, reach: int) -> FloatArray:
    """Return running sums; the signal waits at its first value before the first sample."""
    return np.concatenate([[0.0], np.cumsum(np.concatenate([np.full(reach, w[0]), w]))])


def _delayed(sums: Sequence[FloatArray], edges: list[int], start: int, stop: int) -> FloatArray:
    columns = []
    at = edges[-1] + 1 + np.arange(start, stop)
    for s in sums:
        for near, far in itertools.pairwise(edges):
            columns.append((s[at - near] - s[at - far]) / (far - near))
    return np.column_stack(columns)


# -- with a model and a controller: the noise-free loop ------------------------------------------


@dataclass(frozen=True, eq=False)
class Law:
    """A linear controller ``D u = sum of N_i w_i + M y`` in powers of the delay.

    ``source`` says where it comes from.
    """

    den: FloatArray
    external: tuple[FloatArray, ...]
    feedback: FloatArray
    source: str


def given_law(controller: Any, names: Sequence[str], dt: float) -> Law:
    """Turn a controller of r - y or of (r, y) into a law; further signals are added to u.

    Parameters
    ----------
    controller : control.TransferFunction or control.StateSpace
        The controller, in discrete time.
    names : sequence of str
        External signals.
    dt : float
        Sampling period of the record [s].

    Returns
    -------
    Law
        The law.

    Raises
    ------
    CtrlidError
        If it is no linear controller in discrete time with the period of the record.
    """
    if isinstance(controller, int | float | np.number):
        controller = control.tf([float(controller)], [1.0], dt)
    if not isinstance(controller, control.TransferFunction | control.StateSpace):
        raise CtrlidError(
            f"fit_iv takes a linear controller, a TransferFunction or StateSpace of r - y or of "
            f"(r, y); given {type(controller).__name__}. Leave controller=None: it is then found "
            "from r, y and u in the record."
        )
    if controller.noutputs != 1 or controller.ninputs not in (1, 2):
        raise CtrlidError(
            "A controller has one output u and one input (r - y) or two inputs (r, y); given "
            f"{controller.ninputs} inputs and {controller.noutputs} outputs."
        )
    if not controller.isdtime(strict=True):
        raise CtrlidError(
            "The controller is continuous, but u of this record is held between samples. Give the "
            "difference equation that runs in the computer, for instance "
            f"control.sample_system(C, {dt:g}, method='bilinear'), or leave controller=None."
        )
    if controller.dt is not True and abs(controller.dt - dt) > 1e-9 * dt:
        raise CtrlidError(
            f"The controller runs at {controller.dt:g} s, the record at {dt:g} s. Convert it to "
            "the period of the record."
        )
    numerators, den = _fractions(controller)
    if controller.ninputs == 2 and list(controller.input_labels) == ["y", "r"]:
        numerators = numerators[::-1]
    feedback = numerators[1] if len(numerators) == 2 else -numerators[0]
    external = tuple(numerators[0] if name == "r" else den for name in names)
    return Law(den, external, feedback, "the given controller")


def _fractions(controller: Any) -> tuple[list[FloatArray], FloatArray]:
    """Numerators over one denominator, all of one length, in powers of the delay."""
    inputs = range(controller.ninputs)
    if isinstance(controller, control.StateSpace):
        matrices = (controller.A, controller.B, controller.C, controller.D)
        if not controller.nstates:
            return [np.array([controller.D[0, i]]) for i in inputs], np.ones(1)
        pairs = [signal.ss2tf(*matrices, input=i) for i in inputs]
        return [num[0] for num, _ in pairs], np.asarray(pairs[0][1])
    parts = [
        (np.trim_zeros(np.asarray(controller.num[0][i], dtype=float), "f"), controller.den[0][i])
        for i in inputs
    ]
    den = np.asarray(parts[0][1], dtype=float)
    if any(len(d) != len(den) or not np.allclose(d, den, rtol=1e-12, atol=0) for _, d in parts):
        parts = [(np.convolve(num, parts[1 - i][1]), d) for i, (num, d) in enumerate(parts)]
        den = np.convolve(den, controller.den[0][1])
    if any(len(num) > len(den) for num, _ in parts):
        raise CtrlidError("The controller has more zeros than poles: it would need the future.")
    padded = [np.concatenate([np.zeros(len(den) - len(num)), num]) for num, _ in parts]
    return [num / den[0] for num in padded], den / den[0]


def found_law(pieces: Sequence[Piece], names: Sequence[str]) -> Law | None:
    """Find the controller in the record: u is what it computes from past u, w and y.

    The lowest order wins that leaves nothing, or else the one that Schwarz' criterion prefers. It
    serves for instruments only: a wrong one costs precision, not consistency.

    Parameters
    ----------
    pieces : sequence of Piece
        Data.
    names : sequence of str
        External signals.

    Returns
    -------
    Law or None
        None where u does not depend on the external signals.
    """
    best: tuple[float, Law | None] = (np.inf, None)
    swing = sum(float(np.sum(piece.u**2)) for piece in pieces)
    for m in range(_HIGHEST + 1):
        factors, rows = [], 0
        for p in pieces:
            columns = [np.ones(len(p.u) - m)]
            columns += [p.u[m - i : len(p.u) - i] for i in range(1, m + 1)]
            columns += [s[m - i : len(s) - i] for s in (*p.w, p.y) for i in range(m + 1)]
            table = np.column_stack([*columns, p.u[m:]])
            rows += len(table)
            factor = np.asarray(np.linalg.qr(table, mode="r"), dtype=float)
            factors.append(factor[1:, 1:])
        total = merge(factors)
        scale = np.linalg.norm(total[:, :-1], axis=0)
        scale[scale == 0] = 1.0
        x = np.linalg.lstsq(total[:, :-1] / scale, total[:, -1], rcond=1e-11)[0] / scale
        left = float(np.sum((total[:, -1] - total[:, :-1] @ x) ** 2))
        merit = rows * np.log(max(left, 1e-18 * swing)) + len(x) * np.log(rows)
        if merit < best[0] - 1e-9 * abs(best[0]) or best[1] is None:
            taps = x[m:].reshape(len(names) + 1, m + 1)
            den = np.concatenate([[1.0], -x[:m]])
            source = f"a controller of order {m} found in the record"
            best = (merit, Law(den, tuple(taps[:-1]), taps[-1], source))
        if left <= 1e-16 * swing:
            break
    law = best[1]
    return law if law is not None and any(np.any(taps != 0) for taps in law.external) else None


def loop_signals(
    pieces: Sequence[Piece], law: Law, structure: Structure, theta: FloatArray
) -> Signals | None:
    r"""Simulate model and controller without noise, driven by the external signals.

    .. math:: \hat y = \frac{B \sum N_i w_i}{A D - B M}, \quad
        \hat u = \frac{A \sum N_i w_i}{A D - B M}

    Parameters
    ----------
    pieces : sequence of Piece
        Data.
    law : Law
        The controller.
    structure : Structure
        Orders of the model.
    theta : (p,) array
        Its coefficients.

    Returns
    -------
    list of (array, array) or None
        y and u of each piece; None if the loop of this model is not stable.
    """
    a = np.concatenate([[1.0], theta[: structure.na]])
    b = np.concatenate([np.zeros(structure.nk), theta[structure.na :]])
    left, right = np.convolve(a, law.den), np.convolve(b, law.feedback)
    both = np.zeros(max(len(left), len(right)))
    both[: len(left)] += left
    both[: len(right)] -= right
    if abs(both[0]) < 1e-9 or np.max(np.abs(np.roots(both)), initial=0.0) >= 1 - 1e-9:
        return None
    found = []
    for piece in pieces:
        # From rest at the levels: what came before a stretch is not known.
        y, u = np.zeros_like(piece.y), np.zeros_like(piece.u)
        for n, w in zip(law.external, piece.w, strict=True):
            y += signal.lfilter(np.convolve(n, b), both, w)
            u += signal.lfilter(np.convolve(n, a), both, w)
        found.append((y, u))
    return found


# -- whitening -----------------------------------------------------------------------------------


def stable_factor(structure: Structure, theta: FloatArray, n: int) -> FloatArray:
    """Denominator with the poles outside the unit circle reflected into it.

    ``A(q)`` over it is an all-pass: it whitens the equation error ``A v`` of white sensor noise v.
    Poles within 5/n of the circle are drawn in by that much, beyond what n samples resolve.

    Parameters
    ----------
    structure : Structure
        Orders.
    theta : (p,) array
        Coefficients of the model.
    n : int
        Samples.

    Returns
    -------
    (na + 1,) array
        Monic, in powers of the delay.

    Examples
    --------
    >>> import numpy as np
    >>> stable_factor(Structure(2, 1), np.array([-2.5, 1.0, 0.3]), 10_000)
    array([ 1.  , -1.  ,  0.25])
    """
    delta = to_differences(structure, theta)[: structure.na]
    roots = 1.0 + np.roots(np.concatenate([[1.0], -delta[::-1]])).astype(complex)
    z: ComplexArray = np.where(np.abs(roots) > 1, 1 / roots.conj(), roots)
    size = np.maximum(np.abs(z), 1e-300)
    z = z * np.minimum(1.0, (1 - 5 / max(n, 10)) / size)
    return np.asarray(np.poly(z).real, dtype=float)


def autoregression(residuals: Sequence[FloatArray], highest: int = 10) -> FloatArray:
    """Autoregressive whitening filter of residuals, its order by Schwarz' criterion.

    Parameters
    ----------
    residuals : sequence of arrays
        Pieces of one noise.
    highest : int
        Largest order.

    Returns
    -------
    (order + 1,) array
        Monic; ``[1]`` for white residuals. Always minimum phase.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.signal import lfilter
    >>> white = np.random.default_rng(0).standard_normal(20_000)
    >>> autoregression([white])
    array([1.])
    >>> autoregression([lfilter([1.0], [1.0, -0.8], white)]).round(1)
    array([ 1. , -0.8])
    """
    rows = sum(len(e) for e in residuals)
    r = np.zeros(highest + 1)
    for e in residuals:
        for lag in range(min(highest, len(e) - 1) + 1):
            r[lag] += float(e[lag:] @ e[: len(e) - lag])
    filters = [np.ones(1)]
    d, power = np.ones(1), r[0]
    merits = [rows * np.log(power)]
    for order in range(1, highest + 1):  # Levinson and Durbin
        reflection = -float(d @ r[order:0:-1]) / power
        d = np.concatenate([d, [0.0]]) + reflection * np.concatenate([[0.0], d[::-1]])
        power *= 1 - reflection**2
        filters.append(d)
        merits.append(rows * np.log(power) + order * np.log(rows))
    return filters[int(np.argmin(merits))]


def check_instruments(records: Sequence[Record], instruments: Any) -> tuple[str, ...]:
    """Names of the external signals, refused in words where they cannot serve.

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
    names = (instruments,) if isinstance(instruments, str) else tuple(instruments)
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
                raise CtrlidError(_missing(where, name, record))
            counted = channel[record.valid]
            if counted.size and np.ptp(counted) == 0:
                raise CtrlidError(
                    f"{where} has a constant {name}: nothing from outside moves the loop, so there "
                    "is no instrument. Vary the reference (random_binary), or name an injected "
                    "signal with instruments=. Without either use fit_loop, which needs u and y "
                    "only."
                )
    return names


def _missing(where: str, name: str, record: Record) -> str:
    has = _text.listing([repr(key) for key in record.extra])
    if name != "r":
        return f"{where} has no extra channel {name!r}; it has {has or 'none'}."
    return (
        f"{where} has no reference r. Instruments must come from outside the loop: log the "
        "reference, or, if a dither or pulses were added to u, put them into extra and name them, "
        "instruments='dither'" + (f" (there is {has})" if has else "") + ". Without either use "
        "fit_loop, which needs u and y only."
    )
