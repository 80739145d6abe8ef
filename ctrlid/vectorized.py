"""CasADi expressions evaluated over many samples at once.

CasADi's own interpreter walks through an expression once per sample. Walking through it once per
block of samples, with a loop over the block at each instruction, gives the same numbers many times
faster and costs no compilation per expression.
"""

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

import casadi
import joblib
import numpy as np

from ._jobs import side_by_side
from .errors import CtrlidError
from .interpreter import BINARY, UNARY, run
from .physics import Array

BLOCK = 512  # samples at once: long enough that a call costs little, short enough for the cache


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
        self.rows_in = sum(self.sizes)
        self.rows_out = sum(rows * columns for rows, columns in self.shapes)
        steps, self.constants = _instructions(function)
        self.program, self.registers = _allocated(steps)

    def __call__(self, *arguments: Any) -> list[Array]:
        """Evaluate; arguments are numbers or arrays of shape (rows,) or (rows, n).

        Returns
        -------
        list of ndarray
            Each output with shape (n, rows, columns).
        """
        return through([self], [], arguments)


def _instructions(function: Any) -> tuple[list[tuple[int, int, int, int]], Array]:
    """Return the instructions of a function, inputs and outputs by their rows, and its numbers.

    The elements of inputs and outputs stand one column after another, one table after another.
    """
    into, out = [], []
    first = 0
    for k in range(function.n_in()):
        into.append([first + i for i in function.sparsity_in(k).find()])
        first += function.numel_in(k)
    first = 0
    for k in range(function.n_out()):
        out.append([first + i for i in function.sparsity_out(k).find()])
        first += function.numel_out(k)
    steps: list[tuple[int, int, int, int]] = []
    constants: list[float] = []
    for k in range(function.n_instructions()):
        op = function.instruction_id(k)
        to, a = function.instruction_output(k), function.instruction_input(k)
        if op == casadi.OP_CONST:
            steps.append((op, to[0], len(constants), 0))
            constants.append(function.instruction_constant(k))
        elif op == casadi.OP_INPUT:
            steps.append((op, to[0], into[a[0]][a[1]], 0))
        elif op == casadi.OP_OUTPUT:
            steps.append((op, out[to[0]][to[1]], a[0], 0))
        elif op in UNARY:
            steps.append((op, to[0], a[0], a[0]))
        elif op in BINARY:
            steps.append((op, to[0], a[0], a[1]))
        else:
            raise CtrlidError(
                f"the equations use an operation (CasADi's number {op}) that cannot be "
                "evaluated over many samples; write it with ordinary numpy functions"
            )
    return steps, np.array(constants, dtype=float)


def _allocated(steps: Sequence[tuple[int, int, int, int]]) -> tuple[Any, int]:
    """Return the program with registers of its own, and their number.

    CasADi lets a result overwrite an operand. Here it never does: a loop in place is no vector.
    """
    fed = (casadi.OP_CONST, casadi.OP_INPUT)
    holds: dict[int, int] = {}  # which instruction's result CasADi's register holds
    operands: list[tuple[int, ...]] = []
    last: dict[int, int] = {}  # where each result is used for the last time
    for k, (op, to, a, b) in enumerate(steps):
        operands.append(() if op in fed else (holds[a],) if op == casadi.OP_OUTPUT
                        else (holds[a], holds[b]))  # fmt: skip
        last.update(dict.fromkeys(operands[-1], k))
        if op != casadi.OP_OUTPUT:
            holds[to] = k
            last[k] = k
    done: list[list[int]] = [[] for _ in steps]
    for result, k in last.items():
        done[k].append(result)
    free: list[int] = []
    place: dict[int, int] = {}
    program = np.zeros((len(steps), 4), dtype=np.int64)
    count = 0
    for k, (op, to, a, b) in enumerate(steps):
        if op != casadi.OP_OUTPUT:
            if not free:
                free.append(count)
                count += 1
            to = place[k] = free.pop()
        read = [place[i] for i in operands[k]]
        program[k] = op, to, *(read * 2 if len(read) == 1 else read or (a, b))
        free += [place[i] for i in done[k]]
    return program, count


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
    rows = [row for t in tables for row in t]
    moving = [(k, row) for k, row in enumerate(rows) if len(row) > 1]
    block = min(n, BLOCK)
    still = np.zeros((stages[0].rows_in, block))
    for k, row in enumerate(rows):
        still[k] = row[0]
    again = len([row for t in tables[: len(carried)] for row in t])

    def work(firsts: Iterable[int]) -> None:
        inputs, results = still.copy(), np.zeros((stages[-1].rows_out, block))
        room = np.empty((max(s.registers for s in stages), block))
        for first in firsts:
            size = min(block, n - first)
            inputs[:again] = still[:again]
            for k, row in moving:
                inputs[k, :size] = row[first : first + size]
            for stage, part in itertools.product(stages, range(parts)):
                if not alone:
                    inputs[-1] = part
                run(stage.program, stage.constants, inputs, room, results, size)
                inputs[:again] = results[:again]
            at = 0
            for out in outputs:
                count = out.shape[1] * out.shape[2]
                values = results[at : at + count, :size].reshape(out.shape[2], out.shape[1], size)
                out[first : first + size] = values.T
                at += count

    firsts = range(0, n, block)
    if len(firsts) == 1:
        work(firsts)
    else:
        share = joblib.cpu_count()
        side_by_side(work, (firsts[k::share] for k in range(share)))
    return outputs
