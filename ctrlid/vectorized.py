"""CasADi expressions evaluated by numpy over many samples at once.

CasADi's own interpreter walks through an expression once per sample. Walking through it once per
block of samples, with a numpy operation at each node, gives the same numbers several times faster
and needs no compiler.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import casadi
import numpy as np
from scipy import special

from .errors import CtrlidError
from .physics import Array

BLOCK = 4096  # samples at once: long enough that a call costs little, short enough for the cache


def _sign(a: Any, out: Any) -> Any:
    return np.sign(a, out=out)


def _select(a: Any, b: Any, out: Any) -> Any:
    # CasADi's if_else_zero: an expression that is not selected must not spoil the rest by NaN.
    chosen = np.asarray(a, dtype=bool)
    if b is not out:
        np.copyto(out, b)
    np.copyto(out, 0.0, where=~chosen)
    return out


UNARY: dict[int, Callable[..., Any]] = {
    casadi.OP_ASSIGN: np.positive, casadi.OP_NEG: np.negative, casadi.OP_EXP: np.exp,
    casadi.OP_LOG: np.log, casadi.OP_SQRT: np.sqrt, casadi.OP_SQ: np.square,
    casadi.OP_TWICE: lambda a, out: np.add(a, a, out=out), casadi.OP_SIN: np.sin,
    casadi.OP_COS: np.cos, casadi.OP_TAN: np.tan, casadi.OP_ASIN: np.arcsin,
    casadi.OP_ACOS: np.arccos, casadi.OP_ATAN: np.arctan, casadi.OP_SINH: np.sinh,
    casadi.OP_COSH: np.cosh, casadi.OP_TANH: np.tanh, casadi.OP_ASINH: np.arcsinh,
    casadi.OP_ACOSH: np.arccosh, casadi.OP_ATANH: np.arctanh, casadi.OP_FLOOR: np.floor,
    casadi.OP_CEIL: np.ceil, casadi.OP_FABS: np.abs, casadi.OP_SIGN: _sign,
    casadi.OP_ERF: special.erf, casadi.OP_INV: np.reciprocal, casadi.OP_LOG1P: np.log1p,
    casadi.OP_EXPM1: np.expm1, casadi.OP_NOT: np.logical_not,
}  # fmt: skip
BINARY: dict[int, Callable[..., Any]] = {
    casadi.OP_ADD: np.add, casadi.OP_SUB: np.subtract, casadi.OP_MUL: np.multiply,
    casadi.OP_DIV: np.divide, casadi.OP_POW: np.power, casadi.OP_CONSTPOW: np.power,
    casadi.OP_FMIN: np.fmin, casadi.OP_FMAX: np.fmax, casadi.OP_FMOD: np.fmod,
    casadi.OP_ATAN2: np.arctan2, casadi.OP_HYPOT: np.hypot, casadi.OP_COPYSIGN: np.copysign,
    casadi.OP_IF_ELSE_ZERO: _select, casadi.OP_LT: np.less, casadi.OP_LE: np.less_equal,
    casadi.OP_EQ: np.equal, casadi.OP_NE: np.not_equal, casadi.OP_AND: np.logical_and,
    casadi.OP_OR: np.logical_or,
}  # fmt: skip


class Vectorized:
    """A CasADi function of scalars and columns, evaluated over many samples at once.

    Parameters
    ----------
    function : casadi.Function
        Function of SX expressions.

    Raises
    ------
    CtrlidError
        If an operation of the function is not known here.
    """

    def __init__(self, function: Any) -> None:
        # Rows of each argument, rows and columns of each output.
        self.sizes = [function.numel_in(k) for k in range(function.n_in())]
        self.shapes = [(function.size1_out(k), function.size2_out(k))
                        for k in range(function.n_out())]  # fmt: skip
        # Where the elements that are not always zero stand, columns one after another.
        into_at = [function.sparsity_in(k).find() for k in range(function.n_in())]
        out_at = [function.sparsity_out(k).find() for k in range(function.n_out())]
        self._work = function.sz_w()
        self._program: list[tuple[int, int, int, int, Any]] = []
        for k in range(function.n_instructions()):
            op = function.instruction_id(k)
            out, into = function.instruction_output(k), function.instruction_input(k)
            if op == casadi.OP_CONST:
                step = (0, out[0], 0, 0, function.instruction_constant(k))
            elif op == casadi.OP_INPUT:
                step = (1, out[0], into[0], into_at[into[0]][into[1]], None)
            elif op == casadi.OP_OUTPUT:
                step = (2, into[0], out[0], out_at[out[0]][out[1]], None)
            elif op in UNARY:
                step = (3, out[0], into[0], 0, UNARY[op])
            elif op in BINARY:
                step = (4, out[0], into[0], into[1], BINARY[op])
            else:
                raise CtrlidError(
                    f"the equations use an operation (CasADi's number {op}) that cannot be "
                    "evaluated over many samples; write it with ordinary numpy functions"
                )
            self._program.append(step)

    def __call__(self, *arguments: Any) -> list[Array]:
        """Evaluate; arguments are numbers or arrays of shape (rows,) or (rows, n).

        Returns
        -------
        list of ndarray
            Each output with shape (n, rows, columns).
        """
        return through([self], [], arguments)

    def run(self, inputs: Sequence[Sequence[Any]], size: int) -> list[list[Any]]:
        """Evaluate over a block; return the elements of each output, columns one after another."""
        store: list[Any] = [None] * self._work
        values: list[Any] = [None] * self._work
        outputs: list[list[Any]] = [[0.0] * (rows * columns) for rows, columns in self.shapes]
        for kind, a, b, c, extra in self._program:
            if kind >= 3:
                buffer = store[a]
                if buffer is None:
                    buffer = store[a] = np.empty(size)
                if kind == 4:
                    extra(values[b], values[c], out=buffer)
                else:
                    extra(values[b], out=buffer)
                values[a] = buffer
            elif kind == 0:
                values[a] = extra
            elif kind == 1:
                values[a] = inputs[b][c]
            else:
                outputs[b][c] = values[a]
                store[a] = None  # what comes next must not overwrite it
        return outputs


def through(
    stages: Sequence[Vectorized], carried: Sequence[Any], given: Sequence[Any], parts: int = 1
) -> list[Array]:
    """Evaluate functions one after another, each fed with what the one before it returned.

    Parameters
    ----------
    stages : sequence of Vectorized
        The functions, of the carried values, the given ones and, last, the number of the part;
        or a single one of the given values alone.
    carried : sequence of array_like
        Columns (rows, n) or (rows,) that the first function begins with.
    given : sequence of array_like
        Columns that all of them see.
    parts : int, optional
        How often in turn each function is gone through.

    Returns
    -------
    list of ndarray
        The outputs of the last one, each with shape (n, rows, columns).
    """
    alone = not carried
    numbers = [np.asarray(value, dtype=float) for value in (*carried, *given)]
    tables = [t.reshape(rows, -1 if rows else 1)
              for t, rows in zip(numbers, stages[0].sizes, strict=alone)]  # fmt: skip
    n = max([1, *(t.shape[1] for t in tables)])
    outputs = [np.zeros((n, *shape)) for shape in stages[-1].shapes]
    count = len(carried)
    with np.errstate(all="ignore"):
        for first in range(0, n, BLOCK):
            stop = min(first + BLOCK, n)
            inputs = [[row[first:stop] if len(row) > 1 else row[0] for row in t] for t in tables]
            state, rest = inputs[:count], inputs[count:]
            for stage, part in itertools.product(stages, range(parts)):
                state = stage.run([*state, *rest, *([] if alone else [[part]])], stop - first)
            for out, values in zip(outputs, state, strict=True):
                for k, value in enumerate(values):
                    out[first:stop, k % out.shape[1], k // out.shape[1]] = value
    return outputs
