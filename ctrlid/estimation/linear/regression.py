"""Regressions on records: columns in a differenced basis, and their triangular factor in blocks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence, Sized
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from operator import mul
from typing import Any

import numpy as np
from scipy.linalg import invpascal, pascal
from scipy.linalg.lapack import dgeqrf, dgeqrf_lwork

from ..._base.arguments import is_iterable
from ..._base.arrays import Array
from ..._base.errors import CtrlidError
from ..._base.jobs import share_out
from ..._base.text import write_count
from ...data.record import Record
from ..identified_model import Structure

Fill = Callable[[Array, int, int], None]

BLOCK = 8000
"""Numbers of the regression held in memory at a time.

Small enough for the processor's nearest cache, and for the linear algebra to stay in one thread:
for matrices this narrow, waking others costs more than it gives, up to tenfold on a busy machine.
"""


def block_qr(fill: Fill, rows: int, columns: int, block: int = BLOCK) -> Array:
    """Return the triangular factor R of a tall matrix that is never held as a whole.

    ``R'R = A'A``: each chunk of rows is put under the factor so far and both are triangularised
    together. Orthogonal throughout, so columns of very different size lose nothing.

    Parameters
    ----------
    fill : callable
        ``fill(out, start, stop)`` writes rows ``start:stop`` of A into ``out``.
    rows, columns : int
        Shape of A.
    block : int
        Numbers held at a time, at least three times those of R.

    Returns
    -------
    (columns, columns) array
        Upper triangular.

    Examples
    --------
    >>> import numpy as np
    >>> A = np.arange(12.0).reshape(6, 2) ** 2
    >>> R = block_qr(lambda out, i, j: np.copyto(out, A[i:j]), 6, 2, block=12)
    >>> np.allclose(R.T @ R, A.T @ A)
    True
    """
    # One buffer in LAPACK's own order, factored in place: no copies, no growth with the record.
    chunk = max(block // columns - columns, 2 * columns)
    buffer = np.zeros((columns + chunk, columns), order="F")
    upper = np.triu(np.ones((columns, columns)))
    lwork = int(dgeqrf_lwork(*buffer.shape)[0])
    for start in range(0, rows, chunk):
        stop = min(start + chunk, rows)
        fill(buffer[columns : columns + stop - start], start, stop)
        buffer[columns + stop - start :] = 0.0
        dgeqrf(buffer, lwork=lwork, overwrite_a=1)
        buffer[:columns] *= upper
    return np.array(buffer[:columns])


def triangularize(table: Array) -> Array:
    """Return the triangular factor of a tall table."""
    return block_qr(lambda out, i, j: np.copyto(out, table[i:j]), *table.shape)


def merge_factors(factors: Sequence[Array]) -> Array:
    """Return the triangular factor of matrices stacked on each other, from the factor of each."""
    if len(factors) == 1:
        return factors[0]
    return np.asarray(np.linalg.qr(np.vstack(factors), mode="r"), dtype=float)


@lru_cache(maxsize=64)
def from_differences(structure: Structure) -> tuple[Array, Array]:
    """Return coefficients as ``theta = origin + basis @ delta``, delta in the differenced basis.

    With the forward difference ``D = q - 1`` the model reads ``D^na y = delta_0 y + delta_1 D y +
    ... + beta_0 u + beta_1 D u + ...``, all at the oldest sample of each signal. The origin is
    ``A = (z - 1)^na``, B = 0; the basis holds binomial coefficients, exact in floating point.

    Parameters
    ----------
    structure : Structure
        Orders of the model.

    Returns
    -------
    basis : (p, p) array
        Integers.
    origin : (p,) array
        Integers.
    """
    na, p = structure.na, len(structure.names)
    # invpascal[j, i]: coefficient of z^i in (z - 1)^j.
    powers = np.asarray(invpascal(na + 1, kind="lower"), dtype=float)
    basis = np.zeros((p, p))
    basis[:na, :na] = -powers[:na, :na].T[::-1]
    for part in structure.numerators:
        block = np.asarray(invpascal(structure.nb, kind="lower"), dtype=float)
        basis[part, part] = block.T[::-1]
    origin = np.zeros(p)
    origin[:na] = powers[na, :na][::-1]
    basis.setflags(write=False)
    origin.setflags(write=False)
    return basis, origin


def to_differences(structure: Structure, theta: Array) -> Array:
    """Return the inverse of `from_differences`, without solving anything."""
    na, nb = structure.na, structure.nb
    _, origin = from_differences(structure)
    x = theta - origin
    a = np.asarray(pascal(na, kind="lower"), dtype=float).T @ x[:na][::-1]
    powers = np.asarray(pascal(nb, kind="lower"), dtype=float).T
    return np.concatenate([-a, *(powers @ x[part][::-1] for part in structure.numerators)])


@dataclass(frozen=True, eq=False)
class Regression:
    """A least-squares problem ``|| R delta - d ||^2 + rss`` with the intercepts eliminated.

    Parameters
    ----------
    structure : Structure
        Orders of the model.
    R, d : (p, p) and (p,) arrays
        Triangular factor and right-hand side, in the differenced basis.
    rss : float
        Sum of squares that no coefficients can remove.
    rows : int
        Rows used.
    floor : (p,) array
        Size of the rounding errors in each column.
    intercept_rows : tuple of (array, tuple of float)
        For each record the first row of its factor, and the levels taken off y and each u.
    """

    structure: Structure
    R: Array
    d: Array
    rss: float
    rows: int
    floor: Array
    intercept_rows: tuple[tuple[Array, tuple[float, ...]], ...]

    def intercepts(self, theta: Array) -> Array:
        """Return c of each record in ``y(k) + a1 y(k-1) + ... = b1 u(k-nk) + ... + c``."""
        delta = to_differences(self.structure, theta)
        constants = []
        for row, (y0, *u0) in self.intercept_rows:
            constant = (row[-1] - row[1:-1] @ delta) / row[0]
            # A(1) = -delta_0 and B(1) = beta_0 return the levels that were taken off.
            firsts = [delta[part.start] for part in self.structure.numerators]
            constants.append(constant - delta[0] * y0 - sum(map(mul, firsts, u0)))
        return np.array(constants)


@dataclass(frozen=True, eq=False)
class Part:
    """What a record says, reduced to the triangular factor of its regression.

    Factors of several records merge into the factor of all of them, so that one regression can be
    shared among processes, and a record can be forgotten once it is reduced.
    """

    factor: Array
    rows: int
    levels: tuple[float, ...]
    samples: int
    valid: int


def reduce_record(record: Record, structure: Structure, intercept: bool = True) -> Part:
    """Return the factor of ``[1 | y D y ... | u D u ... | D^na y]`` of one record."""
    u = np.atleast_2d(record.u)
    levels = _find_levels(record, u) if intercept else (0.0,) * (1 + len(u))
    factor, rows = _compute_factor(record, u, structure, levels, intercept)
    return Part(factor, rows, levels, len(record.y), int(record.valid.sum()))


def count_equations(record: Record, structure: Structure) -> int:
    """Return how many rows the regression of a record has, without forming any.

    Parameters
    ----------
    record : Record
        The data.
    structure : Structure
        Orders of the model.

    Returns
    -------
    int
        The rows whose samples are all valid.
    """
    na, nb, nk = structure.na, structure.nb, structure.nk
    rows = np.arange(max(na, nk + nb - 1), len(record))
    before = np.concatenate([[0], np.cumsum(~record.valid)])
    # The samples that a row needs of y, and of u.
    spoilt = before[rows + 1] - before[rows - na]
    spoilt += before[rows - nk + 1] - before[rows - nk - nb + 1]
    return int(np.count_nonzero(spoilt == 0))


def build_arx_regression(
    records: Iterable[Record],
    structure: Structure,
    intercept: bool = True,
    jobs: int | None = None,
) -> Regression:
    """Return the regression of ``A y = B u + c`` on one or several records, one intercept each.

    Parameters
    ----------
    records : iterable of Record
        Experiments; no row spans two of them, or a sample that is not valid. Each is read once and
        then forgotten.
    structure : Structure
        Orders of the model.
    intercept : bool
        Estimate a constant for each record.
    jobs : int, optional
        Jobs among which the records are shared.

    Returns
    -------
    Regression
        Reduced to ``p`` rows, whatever the length of the records.

    Raises
    ------
    CtrlidError
        If a record has no row at all.
    """
    p = len(structure.names)
    total, firsts = np.zeros((p + 1, p + 1)), []
    used = 0
    noise = np.zeros(p)
    task = partial(reduce_record, structure=structure, intercept=intercept)
    for number, part in enumerate(share_out(task, records, jobs), start=1):
        factor = part.factor
        if not part.rows:
            needed = structure.span
            count = f" of {len(records)}" if isinstance(records, Sized) else ""
            raise CtrlidError(
                f"Record {number}{count} gives no equation: an equation needs "
                f"{write_count(needed, 'valid sample')} in succession, and {part.valid} of its "
                f"{write_count(part.samples, 'sample')} {'is' if part.samples == 1 else 'are'} "
                f"valid. "
                "Leave it out or lower the orders."
            )
        used += part.rows
        if intercept:
            firsts.append((factor[0], part.levels))
            factor = factor[1:, 1:]
        total = factor if number == 1 else merge_factors([total, factor])
        noise += _estimate_rounding(factor, structure, part.levels, part.rows) ** 2
    return Regression(
        structure,
        total[:p, :p],
        total[:p, p],
        float(total[p, p] ** 2),
        used,
        np.sqrt(noise),
        tuple(firsts),
    )


def _find_levels(record: Record, u: Array) -> tuple[float, ...]:
    """Return means of y and each u where they count: taken off before any product is formed."""
    if record.valid.all():
        return tuple(float(signal.mean()) for signal in (record.y, *u))
    if not record.valid.any():
        return (0.0,) * (1 + len(u))
    return tuple(float(signal.mean(where=record.valid)) for signal in (record.y, *u))


def _compute_factor(
    record: Record, u: Array, structure: Structure, levels: tuple[float, ...], intercept: bool
) -> tuple[Array, int]:
    """Return the factor R of ``[1 | y D y ... | u D u ... | D^na y]`` and the rows that count."""
    na, nb, nk = structure.na, structure.nb, structure.nk
    y, valid, (y0, *u0) = record.y, record.valid, levels
    first = max(na, nk + nb - 1)
    rows = max(len(y) - first, 0)
    masked = not valid.all()
    lead = 1 if intercept else 0
    used = 0

    def fill(out: Array, start: int, stop: int) -> None:
        nonlocal used
        i, j = first + start, first + stop
        if intercept:
            out[:, 0] = 1.0
        _write_differences(y[i - na : j] - y0, [*out[:, lead : lead + na].T, out[:, -1]])
        for k, (signal, level) in enumerate(zip(u, u0, strict=True)):
            first_column = lead + na + k * nb
            _write_differences(signal[i - nk - nb + 1 : j - nk] - level,
                               list(out[:, first_column : first_column + nb].T))  # fmt: skip
        used += stop - start
        if masked:
            counts = valid[i:j].copy()
            for lag in range(1, na + 1):
                counts &= valid[i - lag : j - lag]
            for lag in range(nk, nk + nb):
                counts &= valid[i - lag : j - lag]
            # A row of zeros adds nothing to the factor.
            out[~counts] = 0.0
            used -= int(np.count_nonzero(~counts))

    factor = block_qr(fill, rows, lead + na + nb * len(u) + 1)
    return factor, used


def _write_differences(signal: Array, columns: Sequence[Array]) -> None:
    """Write the signal and its forward differences, all at the oldest sample, into columns."""
    n = len(columns[0])
    for k, column in enumerate(columns):
        if k:
            signal = signal[1:] - signal[:-1]
        column[:] = signal[:n]


def _estimate_rounding(
    factor: Array, structure: Structure, levels: tuple[float, ...], rows: int
) -> Array:
    """Return the size of the rounding errors of the data in each differenced column."""
    na, nb = structure.na, structure.nb
    eps = float(np.finfo(float).eps)
    norm = np.linalg.norm(factor, axis=0)
    y0, *u0 = levels
    sizes = [(norm[0] + np.sqrt(rows) * abs(y0)) * 2.0 ** np.arange(na)]
    sizes += [(norm[part.start] + np.sqrt(rows) * abs(level)) * 2.0 ** np.arange(nb)
              for part, level in zip(structure.numerators, u0, strict=True)]  # fmt: skip
    return eps * np.concatenate(sizes)


# No computer solves for more coefficients than these.
MOST_ORDER = 100_000


def list_structures(na: Any, nb: Any, nk: Any, record: Record) -> dict[str, Structure]:
    """Return the orders of each output of a record.

    Parameters
    ----------
    na, nb, nk : int or sequence of int
        Orders of all outputs, or one for each.
    record : Record
        The data.

    Returns
    -------
    dict of str to Structure
        By output.

    Raises
    ------
    CtrlidError
        If they are no usable integers, or not one for each output.
    """
    outputs, inputs = record.signals["y"], record.signals["u"]
    columns = []
    for name, value in (("na", na), ("nb", nb), ("nk", nk)):
        several = isinstance(value, list | tuple | np.ndarray) and is_iterable(value)
        if several and len(value) != len(outputs):
            raise CtrlidError(f"{name} is one integer, or one for each output ({', '.join(outputs)}"
                              f"); given {value!r}")  # fmt: skip
        columns.append(list(value) if several else [value] * len(outputs))
    names = inputs if len(inputs) > 1 else ()
    return {
        output: replace(check_orders(*orders), inputs=names)
        for output, *orders in zip(outputs, *columns, strict=True)
    }


def check_orders(na: object, nb: object, nk: object) -> Structure:
    """Return the orders of a sampled model, refused in words unless they are usable integers."""
    for name, value, least in (("na", na, 1), ("nb", nb, 1), ("nk", nk, 0)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
            raise CtrlidError(
                f"{name} must be an integer of at least {least}; given {value!r}. na counts the "
                "poles, nb the numerator coefficients, nk the samples from u to y (1 for a plant "
                "whose u is held between samples)."
            )
        if value > MOST_ORDER:
            raise CtrlidError(f"{name} is at most {MOST_ORDER}; given {value}")
    return Structure(int(na), int(nb), int(nk))  # type: ignore[call-overload]
