"""The equations of instrumental variables from passes over the data, nuisances eliminated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..._base.arrays import Array
from ..._base.errors import CtrlidError
from ..._base.statistics import regress
from ..._base.text import write_count
from ...data.record import Record
from ..constraints.quadratic_program import Cost
from ..identified_model import Structure
from .instruments import Piece, Signals, cut_pieces, project_on_references
from .prefilter import MOST_COLOURED, View
from .regression import block_qr, from_differences, merge_factors, to_differences


@dataclass(frozen=True, eq=False)
class Task:
    """The data and orders of a fit, which stay the same through all iterations.

    Parameters
    ----------
    structure : Structure
        Orders of the model.
    pieces : list of Piece
        The valid stretches.
    delayed : list of (array, array)
        What delayed external signals explain of y and u, stretch by stretch.
    records : int
        Number of records, each with its own constant.
    intercept : bool
        Whether there is a constant.
    """

    structure: Structure
    pieces: list[Piece]
    delayed: Signals
    records: int
    intercept: bool

    @classmethod
    def prepare(
        cls,
        records: Sequence[Record],
        structure: Structure,
        names: tuple[str, ...],
        intercept: bool,
    ) -> Task:
        """Cut the records and project them on the delayed external signals.

        Parameters
        ----------
        records : sequence of Record
            Experiments.
        structure : Structure
            Orders of the model.
        names : tuple of str
            External signals.
        intercept : bool
            Whether to estimate a constant.

        Returns
        -------
        Task
            The data as all passes use them.

        Raises
        ------
        CtrlidError
            If there are too few samples, or too few in succession.
        """
        na, span = structure.na, structure.span
        shortest = span + na + 2 * MOST_COLOURED
        pieces = cut_pieces(records, names, intercept, shortest)
        for number, one in enumerate(records):
            if not any(piece.owner == number for piece in pieces):
                longest = max((j - i for i, j in one.segments()), default=0)
                raise CtrlidError(
                    f"Record {number + 1} of {len(records)} has no stretch of {shortest} valid "
                    f"samples in succession; its longest has {longest}. Record longer, leave it "
                    "out or lower the orders."
                )
        unknowns = len(structure.names) + len(records) + na * len(pieces)
        total = sum(len(piece.y) for piece in pieces)
        if total < 10 * unknowns:
            raise CtrlidError(
                f"Too few samples: {write_count(total, 'valid sample')} for "
                f"{write_count(unknowns, 'unknown')}. Instrumental "
                f"variables need at least {10 * unknowns}. Record longer or lower the orders."
            )
        return cls(structure, pieces, project_on_references(pieces), len(records), intercept)

    @property
    def longest(self) -> int:
        """Samples of the longest stretch."""
        return max(len(piece.y) for piece in self.pieces)


@dataclass(frozen=True, eq=False)
class Moments:
    """Triangular factor of ``[instruments | regressors | target]``, nuisances eliminated.

    Parameters
    ----------
    factor : (2 p + 1, 2 p + 1) array
        Upper triangular, p the number of coefficients, in the differenced basis.
    rows, nuisances : int
        Rows used, and unknowns eliminated.
    structure : Structure
        Orders of the model.
    floor : (p,) array
        Size of the rounding errors in each regressor, as far as instruments pick them up.
    """

    factor: Array
    rows: int
    nuisances: int
    structure: Structure
    floor: Array

    @property
    def cost(self) -> Cost:
        """``|| (Z'Z)^(-1/2) Z' (y - Phi theta) ||^2`` in the differenced basis."""
        p = len(self.structure.names)
        upper = self.factor[:p, p : 2 * p]
        size = np.linalg.norm(upper, axis=0)
        excited = size > 10 * self.floor
        noise = np.linalg.norm(self.floor[excited] / size[excited])
        basis, origin = from_differences(self.structure)
        rest = max(1e-11, 10 * float(noise))
        return Cost(np.where(excited, upper, 0.0), self.factor[:p, -1], basis, origin, rest)

    def rss(self, theta: Array) -> float:
        """Return the sum of squares of the filtered equation error."""
        p = len(self.structure.names)
        delta = to_differences(self.structure, theta)
        return float(np.sum((self.factor[:, -1] - self.factor[:, p : 2 * p] @ delta) ** 2))

    @property
    def size(self) -> float:
        """Norm of the target."""
        return float(np.linalg.norm(self.factor[:, -1]))


def _compute_differences(signal: Array, start: int, n: int, count: int) -> list[Array]:
    """Return ``s, D s, D^2 s, ..``, each ``(n,)`` from sample ``start`` on."""
    return [np.diff(signal, k)[start : start + n] for k in range(count)]


def _multiply_signals(piece: Piece, hats: tuple[Array, Array], view: View) -> list[Array]:
    """Return squares and products of what the external signals cause, up to a degree, size one.

    Near an equilibrium every smooth plant is linear but for these.
    """
    if view.degree == 1:
        return []
    y = hats[0] / np.abs(hats[0]).max()
    u = hats[1][0] - (view.shift[piece.owner] if view.shift else 0.0)
    u = u / np.abs(u).max()
    degrees = range(2, view.degree + 1)
    return [u ** (total - i) * y**i for total in degrees for i in range(total + 1)]


def compute_curved_force(task: Task, hats: Signals, view: View) -> list[Array] | None:
    """Return the force of the products, in the units of the difference equation.

    Parameters
    ----------
    task : Task
        The data.
    hats : list of (array, array)
        y and u as the external signals cause them.
    view : View
        With the coefficients of the products.

    Returns
    -------
    list of arrays or None
        For each stretch, mean taken off; None without such coefficients.
    """
    if not view.curvature:
        return None
    s = task.structure
    first = s.nk + s.nb - 1
    found = []
    for piece, hat, curvature in zip(task.pieces, hats, view.curvature, strict=True):
        n = len(piece.y) - first
        columns = [
            column
            for product in _multiply_signals(piece, hat, view)
            for column in _compute_differences(product, 0, n, s.nb)
        ]
        force = np.column_stack(columns) @ curvature
        found.append(np.concatenate([np.zeros(first), force - force.mean()]))
    return found


def _make_table(
    task: Task, piece: Piece, hats: tuple[Array, Array], view: View
) -> tuple[list[Array], int]:
    """Return ``nuisances | 1 | instruments | regressors | target`` and the number of the first.

    Nuisances are what the prefilter's initial state leaves behind, and products of y and u.
    """
    s = task.structure
    first = max(s.na, s.nk + s.nb - 1) + len(view.num) - 1
    n = len(piece.y) - first
    i, j = first - s.na, first - s.nk - s.nb + 1
    columns = list(view.list_decays(len(piece.y))[first:].T)
    for product in _multiply_signals(piece, hats, view):
        columns += _compute_differences(view(product), j, n, s.nb)
    nuisances = len(columns)
    columns.append(view(np.ones(len(piece.y)))[first:] if task.intercept else np.zeros(n))
    for y, u in (hats, (piece.y, piece.u)):
        ys = _compute_differences(view(y), i, n, s.na + 1)
        columns += ys[:-1]
        for signal in u:
            columns += _compute_differences(view(signal), j, n, s.nb)
    return [*columns, ys[-1]], nuisances


def compute_moments(task: Task, hats: Signals, view: View) -> Moments:
    """Pass over the data with given instruments and prefilter.

    Parameters
    ----------
    task : Task
        The data.
    hats : list of (array, array)
        Instruments: y and u as the external signals cause them.
    view : View
        The prefilter.

    Returns
    -------
    Moments
        All that the coefficients need, whatever the length of the records.
    """
    s = task.structure
    owned: list[list[Array]] = [[] for _ in range(task.records)]
    rows, nuisances = 0, task.records * task.intercept
    for piece, hat in zip(task.pieces, hats, strict=True):
        columns, skip = _make_table(task, piece, hat, view)

        def fill(out: Array, i: int, j: int, columns: Any = columns) -> None:
            for k, column in enumerate(columns):
                out[:, k] = column[i:j]

        n, width = len(columns[0]), len(columns)
        factor = block_qr(fill, n, width)
        owned[piece.owner].append(factor[skip:, skip:])
        rows += n
        nuisances += min(skip, n)
    whole = merge_factors([merge_factors(factors)[1:, 1:] for factors in owned])
    return Moments(whole, rows, nuisances, s, _estimate_rounding(task, view))


def _estimate_rounding(task: Task, view: View) -> Array:
    """Return the rounding errors of the data in each column, as far as instruments pick them up."""
    s = task.structure
    impulse = np.zeros(task.longest)
    impulse[0] = 1.0
    h = view(impulse)
    gains = [
        np.sqrt(np.sum(np.diff(h, k, prepend=np.zeros(k)) ** 2)) for k in range(max(s.na, s.nb))
    ]
    eps = float(np.finfo(float).eps) * np.sqrt(len(s.names))
    y = max(abs(piece.levels[0]) + float(np.abs(piece.y).max()) for piece in task.pieces)
    sizes = [y * gain for gain in gains[: s.na]]
    for k in range(len(s.numerators)):
        u = max(abs(p.levels[1 + k]) + float(np.abs(p.u[k]).max()) for p in task.pieces)
        sizes += [u * gain for gain in gains[: s.nb]]
    return np.asarray(eps * np.array(sizes, dtype=float))


@dataclass(frozen=True, eq=False)
class Residuals:
    """One stretch with nuisances taken out.

    Parameters
    ----------
    z : (n, p) array
        Instruments.
    e : (n,) array
        Whitened equation errors.
    curvature : array
        Coefficients of the products of signals.
    constant : float
        Constant of the equation.
    """

    z: Array
    e: Array
    curvature: Array
    constant: float


def separate_nuisances(task: Task, theta: Array, hats: Signals, view: View) -> list[Residuals]:
    """Separate nuisances from instruments and equation errors.

    Parameters
    ----------
    task : Task
        The data.
    theta : (p,) array
        Coefficients of the model.
    hats : list of (array, array)
        Instruments: y and u as the external signals cause them.
    view : View
        The prefilter.

    Returns
    -------
    list of Residuals
        One for each stretch.
    """
    found = []
    for nuisance, z, error in tabulate_errors(task, theta, hats, view):
        both = np.column_stack([z, error])
        x = regress(nuisance, both, 1e-12)
        both -= nuisance @ x
        curvature, constant = x[len(view.den) - 1 : -1, -1], x[-1, -1]
        found.append(Residuals(both[:, :-1], both[:, -1], curvature, constant))
    return found


def tabulate_errors(
    task: Task, theta: Array, hats: Signals, view: View
) -> list[tuple[Array, Array, Array]]:
    """Return of each stretch nuisances, instruments, and the filtered equation errors.

    The parameters are those of `separate_nuisances`.

    Returns
    -------
    list of (array, array, array)
        The last column of the nuisances is the constant.
    """
    p = len(task.structure.names)
    delta = to_differences(task.structure, theta)
    found = []
    for piece, hat in zip(task.pieces, hats, strict=True):
        columns, skip = _make_table(task, piece, hat, view)
        table, skip = np.column_stack(columns), skip + 1
        error = table[:, -1] - table[:, skip + p : -1] @ delta
        found.append((table[:, :skip], table[:, skip : skip + p], error))
    return found
