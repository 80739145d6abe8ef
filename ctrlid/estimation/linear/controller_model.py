"""The controller as a difference equation, given or found in a record; the noise-free loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import control
import numpy as np
from scipy import signal

from ..._base.arguments import is_number
from ..._base.arrays import Array
from ..._base.criterion import bayesian_penalty
from ..._base.errors import CtrlidError
from ..._base.periods import have_same_period, write_both_periods
from ..._base.statistics import regress
from ..._base.text import write_count
from ...loop.controllers import find_input_order
from ...physics.conversions import require_finite_coefficients, to_polynomials
from ..identified_model import Structure
from .instruments import Piece, Signals
from .regression import merge_factors

# A controller is sought in the record up to this order.
_HIGHEST = 4


@dataclass(frozen=True, eq=False)
class LinearController:
    """A linear controller ``D u = sum of N_i w_i + M y`` in powers of the delay.

    ``source`` says where it comes from.
    """

    den: Array
    external: tuple[Array, ...]
    feedback: Array
    source: str


def convert_controller(
    controller: Any, names: Sequence[str], dt: float, output: str = "y"
) -> LinearController:
    """Turn a controller of r - y or of (r, y) into a law; further signals are added to u.

    Parameters
    ----------
    controller : control.TransferFunction or control.StateSpace
        The controller, in discrete time.
    names : sequence of str
        External signals.
    dt : float
        Sampling period of the record [s].
    output : str, optional
        What the record calls its output.

    Returns
    -------
    LinearController
        The law.

    Raises
    ------
    CtrlidError
        If it is no linear controller in discrete time with the period of the record.
    """
    if is_number(controller):
        controller = control.tf([float(controller)], [1.0], dt)
    if not isinstance(controller, control.TransferFunction | control.StateSpace):
        raise CtrlidError(
            f"fit_iv takes a linear controller, a TransferFunction or StateSpace of r - y or of "
            f"(r, y); given {type(controller).__name__}. Leave controller=None: it is then found "
            "from r, y and u in the record."
        )
    require_finite_coefficients(controller, "The controller")
    if controller.noutputs != 1 or controller.ninputs not in (1, 2):
        raise CtrlidError(
            "A controller has one output u and one input (r - y) or two inputs (r, y); given "
            f"{write_count(controller.ninputs, 'input')} and "
            f"{write_count(controller.noutputs, 'output')}."
        )
    if not controller.isdtime(strict=True):
        raise CtrlidError(
            "The controller is continuous, but u of this record is held between samples. Give the "
            "difference equation that runs in the computer, for instance "
            f"control.sample_system(C, {dt:g}, method='bilinear'), or leave controller=None."
        )
    if controller.dt is not True and not have_same_period(controller.dt, dt):
        both = write_both_periods("The controller runs", controller.dt, "the record", dt)
        raise CtrlidError(f"{both}. Convert it to the period of the record.")
    numerators, den = _expand_fractions(controller)
    if controller.ninputs == 2:
        numerators = [numerators[k] for k in find_input_order(controller, output)]
    feedback = numerators[1] if len(numerators) == 2 else -numerators[0]
    external = tuple(numerators[0] if name == "r" else den for name in names)
    return LinearController(den, external, feedback, "a simulation with the given controller")


def _expand_fractions(controller: Any) -> tuple[list[Array], Array]:
    """Return numerators over one denominator, all of one length, in powers of the delay."""
    if isinstance(controller, control.StateSpace):
        return to_polynomials(controller.A, controller.B, controller.C, controller.D)
    parts = [
        (np.trim_zeros(np.asarray(controller.num[0][i], dtype=float), "f"), controller.den[0][i])
        for i in range(controller.ninputs)
    ]
    den = np.asarray(parts[0][1], dtype=float)
    if any(len(d) != len(den) or not np.allclose(d, den, rtol=1e-12, atol=0) for _, d in parts):
        parts = [(np.convolve(num, parts[1 - i][1]), d) for i, (num, d) in enumerate(parts)]
        den = np.convolve(den, controller.den[0][1])
    if any(len(num) > len(den) for num, _ in parts):
        raise CtrlidError(
            "The controller has more zeros than poles, so it would need future samples. Add a pole."
        )
    padded = [np.concatenate([np.zeros(len(den) - len(num)), num]) for num, _ in parts]
    return [num / den[0] for num in padded], den / den[0]


def identify_controller(pieces: Sequence[Piece], names: Sequence[str]) -> LinearController | None:
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
    best: tuple[float, LinearController | None] = (np.inf, None)
    swing = sum(float(np.sum(piece.u**2)) for piece in pieces)
    for m in range(_HIGHEST + 1):
        factors, rows = [], 0
        for p in pieces:
            (u,) = p.u
            columns = [np.ones(len(u) - m)]
            columns += [u[m - i : len(u) - i] for i in range(1, m + 1)]
            columns += [s[m - i : len(s) - i] for s in (*p.w, p.y) for i in range(m + 1)]
            table = np.column_stack([*columns, u[m:]])
            rows += len(table)
            factor = np.asarray(np.linalg.qr(table, mode="r"), dtype=float)
            factors.append(factor[1:, 1:])
        total = merge_factors(factors)
        x = regress(total[:, :-1], total[:, -1], 1e-11)
        left = float(np.sum((total[:, -1] - total[:, :-1] @ x) ** 2))
        criterion = rows * np.log(max(left, 1e-18 * swing)) + 2 * bayesian_penalty(len(x), rows)
        if criterion < best[0] - 1e-9 * abs(best[0]) or best[1] is None:
            taps = x[m:].reshape(len(names) + 1, m + 1)
            den = np.concatenate([[1.0], -x[:m]])
            source = f"a simulation with a controller of order {m} that was fitted to the record"
            best = (criterion, LinearController(den, tuple(taps[:-1]), taps[-1], source))
        if left <= 1e-16 * swing:
            break
    law = best[1]
    return law if law is not None and any(np.any(taps != 0) for taps in law.external) else None


def simulate_noise_free_loop(
    pieces: Sequence[Piece],
    law: LinearController,
    structure: Structure,
    theta: Array,
    forces: Sequence[Array] | None = None,
) -> Signals | None:
    r"""Simulate model and controller without noise, driven by the external signals.

    .. math:: \hat y = \frac{B \sum N_i w_i + D q}{A D - B M}, \quad
        \hat u = \frac{A \sum N_i w_i + M q}{A D - B M}

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
    forces : sequence of arrays, optional
        A force q on each piece, ``A y = B u + q``.

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
    for i, piece in enumerate(pieces):
        # What came before a stretch is not known, so that it starts from rest at the mean levels.
        y, u = np.zeros_like(piece.y), np.zeros_like(piece.y)
        for n, w in zip(law.external, piece.w, strict=True):
            y += signal.lfilter(np.convolve(n, b), both, w)
            u += signal.lfilter(np.convolve(n, a), both, w)
        if forces is not None:
            y += signal.lfilter(law.den, both, forces[i])
            u += signal.lfilter(law.feedback, both, forces[i])
        found.append((y, u[None]))
    return found
