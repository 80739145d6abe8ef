"""CasADi expressions evaluated over many samples at once.

CasADi's own interpreter walks through an expression once per sample. Walking through it once per
block of samples, with a loop over the block at each instruction, gives the same numbers many times
faster and costs no compilation per expression.
"""

import functools
from collections.abc import Iterable, Sequence
from typing import Any

import casadi
import numpy as np

from .._base.arrays import Array
from .._base.compilation import compile_loop
from .._base.errors import CtrlidError
from .._base.interruption import keep_interrupt
from .._base.jobs import count_processors, run_side_by_side
from .interpreter import BINARY, UNARY, iterate_program, run_programs

# A block of so many samples is long enough to hide the cost of its loop and fits into the cache.
BLOCK = 512
# A thread takes at most so many blocks at a time, since their inputs are copied.
BLOCKS = 64
# A fit evaluates the same few functions at each step; so many are kept joined.
JOINED = 16
# CasADi is asked for every so manieth instruction, to be sure where its text holds them.
ASKED = 50
# The operations that `run_program` carries out.
KNOWN = {casadi.OP_CONST, casadi.OP_INPUT, casadi.OP_OUTPUT} | UNARY | BINARY


class BlockEvaluation:
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
        # `sizes` are the rows of each argument, `tables` first row, rows and columns of each
        # output, `read` the rows of the arguments that are used at all.
        self.sizes = [function.numel_in(k) for k in range(function.n_in())]
        shapes = [(function.size1_out(k), function.size2_out(k)) for k in range(function.n_out())]
        ends = np.cumsum([0, *(rows * columns for rows, columns in shapes)])
        self.tables = np.array([(at, *s) for at, s in zip(ends, shapes, strict=False)])
        self.rows_out = int(ends[-1])
        steps, self.constants = _list_instructions(function)
        self.program, self.registers = _allocate_registers(steps)
        self.read = set(steps[steps[:, 0] == casadi.OP_INPUT, 2].tolist())

    def __call__(self, *arguments: Any) -> list[Array]:
        """Evaluate; arguments are numbers or arrays of shape (rows,) or (rows, n).

        Returns
        -------
        list of ndarray
            Each output with shape (n, rows, columns).
        """
        return evaluate_blocks([self], [], arguments)

    def iterate(self, first: Array, signals: Array, *others: Any) -> Array:
        """Evaluate sample by sample, the first results the first arguments of the next sample.

        Parameters
        ----------
        first : ndarray, shape (carried,)
            What is carried, at the first sample.
        signals : ndarray, shape (rows, n)
            Arguments behind those.
        *others : float or array_like
            Arguments that stay.

        Returns
        -------
        ndarray, shape (n, rows of the results)
            All results of each sample.
        """
        given = np.concatenate([first, np.zeros(len(signals)), *map(np.ravel, others)])[:, None]
        room = np.empty((self.registers, 1)), np.zeros((self.rows_out, 1))
        found: Array = iterate_program(
            self.program, self.constants, given, *room, len(first), np.ascontiguousarray(signals)
        )
        return found


def _list_instructions(function: Any) -> tuple[Any, Array]:
    """Return the instructions of a function, and its numbers.

    Each as operation, register of the result, operands; for inputs, outputs and constants the row
    of their table stands in place of a register. The elements of inputs and outputs stand one
    column after another, one table after another.
    """
    table = _decode_instructions(function)
    if table is None:
        table = _ask_for_instructions(function, range(function.n_instructions()))
    op = table[:, 0]
    unknown = set(op.tolist()) - KNOWN
    if unknown:
        raise CtrlidError(
            f"the equations use an operation (CasADi's number {min(unknown)}) that cannot be "
            "evaluated over many samples; write it with ordinary numpy functions"
        )
    into, out = [], []
    first = 0
    for k in range(function.n_in()):
        into.append([first + i for i in function.sparsity_in(k).find()])
        first += function.numel_in(k)
    first = 0
    for k in range(function.n_out()):
        out.append([first + i for i in function.sparsity_out(k).find()])
        first += function.numel_out(k)
    steps = table.astype(np.int64)
    fixed, read, written = (op == k for k in (casadi.OP_CONST, casadi.OP_INPUT, casadi.OP_OUTPUT))
    constants = np.ascontiguousarray(table[fixed, 2:]).view(float)[:, 0]
    steps[fixed, 2] = np.arange(len(constants))
    steps[read, 2] = [into[k][i] for k, i in table[read, 2:].tolist()]
    steps[fixed | read, 3] = 0
    steps[written, 1] = [out[k][i] for k, i in table[written][:, [1, 3]].tolist()]
    steps[written, 3] = steps[written, 2]
    return steps, constants


def _ask_for_instructions(function: Any, which: Iterable[int]) -> Any:
    """Return instructions of a function as CasADi keeps them, as 32-bit numbers.

    Each as operation, result and two operands: registers; for an input its table and element as
    operands; for an output its table as result and its element as second operand; for a constant
    the two halves of its number as operands.
    """
    rows = []
    for k in which:
        op = function.instruction_id(k)
        to, a = function.instruction_output(k), function.instruction_input(k)
        if op == casadi.OP_CONST:
            a = np.array([function.instruction_constant(k)]).view(np.int32).tolist()
        elif op == casadi.OP_OUTPUT:
            a = [a[0], to[1]]
        rows.append((op, to[0], a[0], a[-1]))
    return np.array(rows, dtype=np.int32).reshape(-1, 4)


def _decode_instructions(function: Any) -> Any:
    """Return what `_ask_for_instructions` returns for all instructions, or None.

    CasADi hands out one instruction at a time, which takes longer than all else in building a map.
    Its serialized text holds them one after another, two letters a byte, though it is nowhere
    promised: so that the place is where instructions stand that CasADi was asked for.
    """
    n = function.n_instructions()
    if not n:
        return None
    asked = [*range(0, n, ASKED), n - 1]
    known = _ask_for_instructions(function, asked)
    letters = np.frombuffer(function.serialize().encode(), np.uint8) - np.uint8(ord("a"))
    pairs = letters[: letters.size // 2 * 2]
    content = (pairs[0::2] | pairs[1::2] << 4).tobytes()
    place = content.find(known[0].tobytes())
    while 0 <= place <= len(content) - 16 * n:
        table = np.frombuffer(content, np.int32, 4 * n, place).reshape(n, 4)
        if np.array_equal(table[asked], known):
            return table
        place = content.find(known[0].tobytes(), place + 1)
    return None


@keep_interrupt
@compile_loop()
def _allocate_registers(steps: Any) -> tuple[Any, int]:  # pragma: no cover - compiled
    """Return the program with registers of its own, and their number.

    CasADi lets a result overwrite an operand. Here it never does: a loop in place is no vector.
    """
    count = len(steps)
    most = steps.max() + 1 if count else 1
    # For each of CasADi's registers, the instruction whose result it holds.
    holds = np.zeros(most, np.int64)
    operands = np.full((count, 2), -1)
    # For each result, the instruction that uses it last.
    last = np.arange(count)
    for k in range(count):
        op = steps[k, 0]
        if op != casadi.OP_CONST and op != casadi.OP_INPUT:
            for j in range(2):
                operands[k, j] = holds[steps[k, 2 + j]]
                last[operands[k, j]] = k
        if op != casadi.OP_OUTPUT:
            holds[steps[k, 1]] = k
    program = steps.copy()
    place = np.zeros(count, np.int64)
    free = np.zeros(count, np.int64)
    spare = registers = 0
    for k in range(count):
        if steps[k, 0] != casadi.OP_OUTPUT:
            if not spare:
                free[0], spare = registers, 1
                registers += 1
            spare -= 1
            place[k] = program[k, 1] = free[spare]
        read = operands[k]
        for j in range(2):
            if read[j] >= 0:
                program[k, 2 + j] = place[read[j]]
        for j in range(2):
            if read[j] >= 0 and last[read[j]] == k and not (j and read[0] == read[1]):
                free[spare] = place[read[j]]
                spare += 1
        # A result that nothing uses frees its register at once.
        if steps[k, 0] != casadi.OP_OUTPUT and last[k] == k:
            free[spare] = place[k]
            spare += 1
    return program, registers


def evaluate_blocks(
    stages: Sequence[BlockEvaluation], carried: Sequence[Any], given: Sequence[Any], parts: int = 1
) -> list[Array]:
    """Evaluate functions one after another, each fed with what the one before it returned.

    Parameters
    ----------
    stages : sequence of BlockEvaluation
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
    rows = [row for t in tables for row in t]
    still = np.array([row[0] for row in rows] + ([] if alone else [0.0]))
    # Of many programs, such as that of a sensor, most arguments are never read.
    read = set[int]().union(*(s.read for s in stages))
    moving = [k for k, row in enumerate(rows) if len(row) > 1 and k in read]
    again = sum(len(t) for t in tables[: len(carried)])
    program, starts, constants = _join_programs(tuple(stages))
    room, places = max(s.registers for s in stages), np.array(moving, dtype=np.int64)
    last = stages[-1]
    out = np.empty(n * last.rows_out)
    blocks = -(-n // BLOCK)
    stretch = BLOCK * min(-(-blocks // count_processors()), BLOCKS)

    def work(first: int) -> None:
        values = np.empty((len(moving), min(stretch, n - first)))
        for row, k in zip(values, moving, strict=True):
            row[:] = rows[k][first : first + stretch]
        run_programs(
            program,
            starts,
            constants,
            parts,
            again,
            still,
            places,
            values,
            room,
            last.tables,
            out,
            n,
            first,
            min(n, BLOCK),
        )

    firsts = range(0, n, stretch)
    if len(firsts) == 1:
        work(0)
    else:
        run_side_by_side(work, firsts)
    return [
        out[n * at : n * (at + r * c)].reshape(n, r, c) for at, r, c in last.tables.tolist()
    ]  # fmt: skip


@functools.lru_cache(maxsize=JOINED)
def _join_programs(stages: tuple[BlockEvaluation, ...]) -> tuple[Any, Any, Array]:
    """Return the programs one below the other, where each begins, and all their numbers."""
    programs, count = [], 0
    for stage in stages:
        program = stage.program.copy()
        program[program[:, 0] == casadi.OP_CONST, 2] += count
        programs.append(program)
        count += len(stage.constants)
    starts = np.cumsum([0, *map(len, programs)])
    return np.concatenate(programs), starts, np.concatenate([s.constants for s in stages])
