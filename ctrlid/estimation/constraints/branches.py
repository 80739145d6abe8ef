"""From constraints to matrices: the alternatives to try, and which constraints contradict."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from ..._base import text as _text
from ..._base.arrays import Array
from ..._base.errors import CtrlidError
from ..identified_model import Structure
from . import AbstractConstraint, Branch, Row

# More combinations of branches are refused, since each is a quadratic program of its own.
_MOST_CASES = 256


class Infeasible(Exception):
    """No coefficients satisfy these rows; the caller tries another case or explains."""


@dataclass(frozen=True, eq=False)
class Rows:
    """``lower <= weights @ theta <= upper`` as arrays, each row with its words and its owner.

    ``weights`` is ``(m, p)``, ``lower`` and ``upper`` are ``(m,)``; ``owners`` are the constraints
    as the user wrote them.
    """

    weights: Array
    lower: Array
    upper: Array
    rows: tuple[Row, ...]
    owners: tuple[str, ...]

    @classmethod
    def build(cls, structure: Structure, owned: Sequence[tuple[str, Row]]) -> Rows:
        """Turn rows by coefficient name into arrays."""
        weights = [structure.vector(row.weights, owner) for owner, row in owned]
        return cls(
            np.array(weights).reshape(len(owned), len(structure.names)),
            np.array([row.lower for _, row in owned], dtype=float),
            np.array([row.upper for _, row in owned], dtype=float),
            tuple(row for _, row in owned),
            tuple(owner for owner, _ in owned),
        )

    def __add__(self, other: Rows) -> Rows:
        return Rows(
            np.vstack([self.weights, other.weights]),
            np.concatenate([self.lower, other.lower]),
            np.concatenate([self.upper, other.upper]),
            self.rows + other.rows,
            self.owners + other.owners,
        )

    def none(self) -> Rows:
        """Return no rows, for as many coefficients."""
        return Rows(self.weights[:0], self.lower[:0], self.upper[:0], (), ())

    @property
    def equality(self) -> NDArray[np.bool_]:
        """Which rows are equalities."""
        return np.equal(self.lower, self.upper)


@dataclass(frozen=True, eq=False)
class Case:
    """One alternative of every constraint, together."""

    structure: Structure
    rows: Rows
    nonzero: Rows
    labels: tuple[str, ...]
    family: tuple[str, Callable[[float], Sequence[Row]], Branch] | None
    functions: tuple[tuple[str, Branch], ...]

    def at(self, x: float) -> Rows:
        """Return all rows, with those of the family at ``x``."""
        if self.family is None:
            return self.rows
        owner, family, _ = self.family
        return self.rows + Rows.build(self.structure, [(owner, row) for row in family(x)])

    @property
    def grid(self) -> tuple[float, ...]:
        """Values of the family's number to start from; one idle value without a family."""
        return (0.0,) if self.family is None else tuple(self.family[2].grid)


def list_cases(constraints: Sequence[AbstractConstraint], structure: Structure) -> list[Case]:
    """Return all combinations of the branches of the constraints."""
    choices = [[(repr(c), b) for b in c.branches(structure)] for c in constraints]
    if np.prod([float(len(c)) for c in choices]) > _MOST_CASES:
        raise CtrlidError(
            f"These constraints have more than {_MOST_CASES} combinations of branches, each a "
            "quadratic program of its own. Drop constraints with branches that are not needed."
        )
    found = []
    for choice in itertools.product(*choices):
        families = [(owner, b.family, b) for owner, b in choice if b.family is not None]
        if len(families) > 1:
            names = _text.write_list([owner for owner, _, _ in families])
            raise CtrlidError(
                f"{names} each need a search for a free number in a model with {structure.na} "
                "poles; use only one constraint of this kind at a time."
            )
        found.append(
            Case(
                structure,
                Rows.build(structure, [(o, row) for o, b in choice for row in b.rows]),
                Rows.build(structure, [(o, row) for o, b in choice for row in b.nonzero]),
                tuple(b.label for _, b in choice if b.label and b.family is None),
                families[0] if families else None,
                tuple((o, b) for o, b in choice if b.equality or b.inequality),
            )
        )
    return found


@dataclass(frozen=True, eq=False)
class Elimination:
    """Solutions of equalities as ``theta = offset + directions @ theta[free]``; the reduced rows.

    Fixed coefficients have zero directions, so they come out exactly as given.
    """

    offset: Array
    directions: Array
    pivots: NDArray[np.intp]
    free: NDArray[np.intp]
    weights: Array
    values: Array

    def snap(self, theta: Array) -> Array:
        """Recompute the dependent coefficients from the free ones."""
        snapped: Array = theta.copy()
        snapped[self.pivots] = (self.offset + self.directions @ theta[self.free])[self.pivots]
        return snapped


def eliminate_equalities(weights: Array, values: Array) -> Elimination:
    """Return the row echelon form of ``weights @ theta = values``, or raise `Infeasible`."""
    work = np.column_stack([weights, values])
    return _eliminate_cached(work.shape, work.tobytes())


@lru_cache(maxsize=64)
def _eliminate_cached(shape: tuple[int, int], numbers: bytes) -> Elimination:
    # One fit asks for the same few rows several times, and a study for them in every fit.
    work = np.frombuffer(numbers).reshape(shape).copy()
    m, p = shape[0], shape[1] - 1
    work, columns = _equilibrate_rows(work)
    # How large the terms are that each number is the sum of: what is left of them is rounding.
    terms = np.abs(work)
    pivots: list[int] = []
    for step in range(min(m, p)):
        rest = np.where(np.abs(work[step:, :p]) > 1e-11 * terms[step:, :p], work[step:, :p], 0.0)
        i, j = np.unravel_index(np.argmax(np.abs(rest)), rest.shape)
        if rest[i, j] == 0:
            break
        chosen = step + int(i)
        work[[step, chosen]], terms[[step, chosen]] = work[[chosen, step]], terms[[chosen, step]]
        pivot = work[step, j]
        work[step], terms[step] = work[step] / pivot, terms[step] / abs(pivot)
        column = work[:, j].copy()
        column[step] = 0.0
        work -= np.outer(column, work[step])
        terms += np.outer(np.abs(column), terms[step])
        pivots.append(int(j))
    rank = len(pivots)
    if np.any(np.abs(work[rank:, p]) > 1e-9 * terms[rank:, p]):
        raise Infeasible
    # Back to the units of the coefficients.
    work = np.ldexp(work, columns[pivots + [p] * (m - rank)][:, None] - columns)
    free = np.array([j for j in range(p) if j not in pivots], dtype=np.intp)
    offset, directions = np.zeros(p), np.zeros((p, len(free)))
    offset[pivots] = work[:rank, p]
    directions[pivots] = -work[:rank][:, free]
    directions[free, np.arange(len(free))] = 1.0
    # Adding zero turns negative zeros, which would be printed, into zeros.
    directions += 0.0
    index = np.array(pivots, dtype=np.intp)
    arrays = (offset, directions, index, free, work[:rank, :p], work[:rank, p])
    for array in arrays:
        array.setflags(write=False)
    return Elimination(*arrays)


def _equilibrate_rows(work: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return rows whose largest weights are about one in every row and every column.

    Coefficients may differ by many powers of ten in size, as those in s of a slow plant do. Powers
    of two scale without rounding, so that rows of small integers stay exact. The exponents of the
    columns are returned with them; that of the right-hand side is zero.
    """
    columns = np.zeros(work.shape[1], dtype=np.intp)
    if not len(work):
        return work, columns
    for axis in (1, 0, 1, 0, 1):
        size = np.abs(work[:, :-1]).max(axis=axis)
        shift = np.where(size > 0, -np.frexp(size)[1], 0)
        if axis:
            work = np.ldexp(work, shift[:, None])
        else:
            columns[:-1] += shift
            work = np.column_stack([np.ldexp(work[:, :-1], shift), work[:, -1]])
    return work, columns


def split_inequalities(rows: Rows) -> tuple[Array, Array, NDArray[np.intp], Array]:
    """Return inequalities as ``G theta <= h``, the row each comes from, and its sign in it."""
    below = np.flatnonzero(~rows.equality & (rows.upper < np.inf))
    above = np.flatnonzero(~rows.equality & (rows.lower > -np.inf))
    sign = np.concatenate([np.ones(len(below)), -np.ones(len(above))])
    h = sign * np.concatenate([rows.upper[below], rows.lower[above]])
    origin = np.concatenate([below, above])
    return sign[:, None] * rows.weights[origin], h, origin, sign


def is_forced(rows: Rows, nonzero: Rows) -> bool:
    """Return whether the equalities force a sum to the very value it must differ from."""
    if not len(nonzero.lower):
        return False
    e = eliminate_equalities(rows.weights[rows.equality], rows.lower[rows.equality])
    # Small means small against the terms of the sum, which may be of any unit.
    w = np.abs(nonzero.weights)
    loose = np.abs(nonzero.weights @ e.directions) > 1e-9 * (w @ np.abs(e.directions))
    gap = np.abs(nonzero.weights @ e.offset - nonzero.lower)
    apart = gap > 1e-9 * (w @ np.abs(e.offset) + np.abs(nonzero.lower))
    return bool(np.any(~loose.any(axis=1) & ~apart))


def is_feasible(rows: Rows, nonzero: Rows) -> bool:
    """Return whether any coefficients satisfy the rows, by linear programming."""
    try:
        e = eliminate_equalities(rows.weights[rows.equality], rows.lower[rows.equality])
        if is_forced(rows, nonzero):
            return False
    except Infeasible:
        return False
    g, h, _, _ = split_inequalities(rows)
    if not len(h):
        return True
    reduced, room = g @ e.directions, h - g @ e.offset
    terms = np.abs(g) @ np.abs(e.directions)
    size = np.abs(h) + np.abs(g) @ np.abs(e.offset)
    reduced = np.where(np.abs(reduced) > 1e-11 * terms, reduced, 0.0)
    empty = ~reduced.any(axis=1)
    if np.any(room[empty] < -1e-9 * size[empty]):
        return False
    reduced, room, size = reduced[~empty], room[~empty], size[~empty]
    if not len(room):
        return True
    # Each free coefficient is counted in the largest value that a row asks of it.
    asked = np.divide(
        size[:, None], np.abs(reduced), out=np.zeros(reduced.shape), where=reduced != 0
    ).max(axis=0)
    reduced = reduced * np.where(asked > 0, asked, 1.0)
    norm = np.linalg.norm(reduced, axis=1)
    reduced, room = reduced / norm[:, None], room / norm
    # The largest common slack, at most 1: its sign decides, which a bare feasibility test with
    # the solver's own tolerance would blur.
    size = max(1.0, float(np.abs(room).max()))
    columns = np.column_stack([reduced, np.ones(len(room))])
    best = linprog(
        np.r_[np.zeros(reduced.shape[1]), -1.0],
        A_ub=columns,
        b_ub=room / size,
        bounds=[(None, None)] * reduced.shape[1] + [(None, 1.0)],
    )
    return bool(best.x is not None and best.x[-1] >= -1e-10)


def is_possible(constraints: Sequence[AbstractConstraint], structure: Structure) -> bool:
    """Return whether the linear rows of some case can be met together."""
    return any(
        is_feasible(case.at(x), case.nonzero)
        for case in list_cases(constraints, structure)
        for x in case.grid
    )


def explain_conflict(constraints: Sequence[AbstractConstraint], structure: Structure) -> str:
    """Name a smallest set of constraints that contradict each other."""
    core = list(constraints)
    for constraint in constraints:
        rest = [c for c in core if c is not constraint]
        if not is_possible(rest, structure):
            core = rest
    names = [repr(c) for c in core]
    if len(core) == 1:
        return (
            f"{names[0]} cannot be met by any model with coefficients "
            f"{', '.join(structure.names)}. Drop it or change the orders."
        )
    return (
        f"These constraints contradict each other: {_text.write_list(names)}. No coefficients "
        f"{', '.join(structure.names)} satisfy them together. Drop one of them or loosen it."
    )
