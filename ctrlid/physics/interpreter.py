"""The instructions of a CasADi expression carried out over a block of samples.

Compiled once: an expression comes in as data.
"""

import math
from typing import Any

import casadi
import numpy as np

from .._base.compilation import compile_loop
from .._base.interruption import keep_interrupt

UNARY = {
    casadi.OP_SQ, casadi.OP_TWICE, casadi.OP_NEG, casadi.OP_INV, casadi.OP_FABS, casadi.OP_SQRT,
    casadi.OP_EXP, casadi.OP_LOG, casadi.OP_SIN, casadi.OP_COS, casadi.OP_TAN, casadi.OP_ASIN,
    casadi.OP_ACOS, casadi.OP_ATAN, casadi.OP_SINH, casadi.OP_COSH, casadi.OP_TANH, casadi.OP_ASINH,
    casadi.OP_ACOSH, casadi.OP_ATANH, casadi.OP_LOG1P, casadi.OP_EXPM1, casadi.OP_ERF,
    casadi.OP_FLOOR, casadi.OP_CEIL, casadi.OP_SIGN, casadi.OP_NOT, casadi.OP_ASSIGN,
}  # fmt: skip
BINARY = {
    casadi.OP_MUL, casadi.OP_ADD, casadi.OP_SUB, casadi.OP_DIV, casadi.OP_IF_ELSE_ZERO,
    casadi.OP_LT, casadi.OP_LE, casadi.OP_EQ, casadi.OP_NE, casadi.OP_AND, casadi.OP_OR,
    casadi.OP_FMIN, casadi.OP_FMAX, casadi.OP_POW, casadi.OP_CONSTPOW, casadi.OP_FMOD,
    casadi.OP_ATAN2, casadi.OP_HYPOT, casadi.OP_COPYSIGN,
}  # fmt: skip


@compile_loop(nogil=True, error_model="numpy")
def run_program(
    program: Any, constants: Any, inputs: Any, work: Any, outputs: Any, size: int
) -> None:  # pragma: no cover - compiled
    """Carry out a program over the first `size` samples of a block.

    The loops are short, plain and never in place, which lets the compiler make vectors of them.

    Parameters
    ----------
    program : ndarray of int, shape (instructions, 4)
        CasADi's number of the operation, where the result goes, and its operands: registers,
        but for an input, an output or a constant the row of their table.
    constants : ndarray, shape (constants,)
        Numbers of the expression.
    inputs : ndarray, shape (rows, block)
        Arguments.
    work : ndarray, shape (registers, block)
        Room for what is calculated on the way.
    outputs : ndarray, shape (rows, block)
        Where the results go.
    size : int
        Samples.
    """
    samples = range(size)
    for i in range(len(program)):
        op, to, a, b = program[i, 0], program[i, 1], program[i, 2], program[i, 3]
        if op == casadi.OP_MUL:
            for k in samples:
                work[to, k] = work[a, k] * work[b, k]
        elif op == casadi.OP_ADD:
            for k in samples:
                work[to, k] = work[a, k] + work[b, k]
        elif op == casadi.OP_SUB:
            for k in samples:
                work[to, k] = work[a, k] - work[b, k]
        elif op == casadi.OP_DIV:
            for k in samples:
                work[to, k] = work[a, k] / work[b, k]
        elif op == casadi.OP_INPUT:
            for k in samples:
                work[to, k] = inputs[a, k]
        elif op == casadi.OP_OUTPUT:
            for k in samples:
                outputs[to, k] = work[a, k]
        elif op == casadi.OP_CONST:
            for k in samples:
                work[to, k] = constants[a]
        elif op == casadi.OP_SQ:
            for k in samples:
                work[to, k] = work[a, k] * work[a, k]
        elif op == casadi.OP_TWICE:
            for k in samples:
                work[to, k] = work[a, k] + work[a, k]
        elif op == casadi.OP_NEG:
            for k in samples:
                work[to, k] = -work[a, k]
        elif op == casadi.OP_INV:
            for k in samples:
                work[to, k] = 1.0 / work[a, k]
        elif op == casadi.OP_IF_ELSE_ZERO:
            for k in samples:
                work[to, k] = work[b, k] if work[a, k] != 0.0 else 0.0
        elif op == casadi.OP_LT:
            for k in samples:
                work[to, k] = 1.0 if work[a, k] < work[b, k] else 0.0
        elif op == casadi.OP_LE:
            for k in samples:
                work[to, k] = 1.0 if work[a, k] <= work[b, k] else 0.0
        elif op == casadi.OP_FABS:
            for k in samples:
                work[to, k] = abs(work[a, k])
        elif op == casadi.OP_SQRT:
            for k in samples:
                work[to, k] = np.sqrt(work[a, k])
        elif op == casadi.OP_EXP:
            for k in samples:
                work[to, k] = np.exp(work[a, k])
        elif op == casadi.OP_LOG:
            for k in samples:
                work[to, k] = np.log(work[a, k])
        elif op == casadi.OP_SIN:
            for k in samples:
                work[to, k] = np.sin(work[a, k])
        elif op == casadi.OP_COS:
            for k in samples:
                work[to, k] = np.cos(work[a, k])
        elif op == casadi.OP_TAN:
            for k in samples:
                work[to, k] = np.tan(work[a, k])
        elif op == casadi.OP_ASIN:
            for k in samples:
                work[to, k] = np.arcsin(work[a, k])
        elif op == casadi.OP_ACOS:
            for k in samples:
                work[to, k] = np.arccos(work[a, k])
        elif op == casadi.OP_ATAN:
            for k in samples:
                work[to, k] = np.arctan(work[a, k])
        elif op == casadi.OP_SINH:
            for k in samples:
                work[to, k] = np.sinh(work[a, k])
        elif op == casadi.OP_COSH:
            for k in samples:
                work[to, k] = np.cosh(work[a, k])
        elif op == casadi.OP_TANH:
            for k in samples:
                work[to, k] = np.tanh(work[a, k])
        elif op == casadi.OP_ASINH:
            for k in samples:
                work[to, k] = np.arcsinh(work[a, k])
        elif op == casadi.OP_ACOSH:
            for k in samples:
                work[to, k] = np.arccosh(work[a, k])
        elif op == casadi.OP_ATANH:
            for k in samples:
                work[to, k] = np.arctanh(work[a, k])
        elif op == casadi.OP_LOG1P:
            for k in samples:
                work[to, k] = np.log1p(work[a, k])
        elif op == casadi.OP_EXPM1:
            for k in samples:
                work[to, k] = np.expm1(work[a, k])
        elif op == casadi.OP_ERF:
            for k in samples:
                work[to, k] = math.erf(work[a, k])
        elif op == casadi.OP_FLOOR:
            for k in samples:
                work[to, k] = np.floor(work[a, k])
        elif op == casadi.OP_CEIL:
            for k in samples:
                work[to, k] = np.ceil(work[a, k])
        elif op == casadi.OP_SIGN:
            for k in samples:
                x = work[a, k]
                work[to, k] = 1.0 if x > 0.0 else (-1.0 if x < 0.0 else x)
        elif op == casadi.OP_NOT:
            for k in samples:
                work[to, k] = 1.0 if work[a, k] == 0.0 else 0.0
        elif op == casadi.OP_ASSIGN:
            for k in samples:
                work[to, k] = work[a, k]
        elif op == casadi.OP_EQ:
            for k in samples:
                work[to, k] = 1.0 if work[a, k] == work[b, k] else 0.0
        elif op == casadi.OP_NE:
            for k in samples:
                work[to, k] = 1.0 if work[a, k] != work[b, k] else 0.0
        elif op == casadi.OP_AND:
            for k in samples:
                x, y = work[a, k], work[b, k]
                work[to, k] = 1.0 if x != 0.0 and y != 0.0 else 0.0
        elif op == casadi.OP_OR:
            for k in samples:
                x, y = work[a, k], work[b, k]
                work[to, k] = 1.0 if x != 0.0 or y != 0.0 else 0.0
        elif op == casadi.OP_FMIN:
            for k in samples:
                x, y = work[a, k], work[b, k]
                work[to, k] = x if x < y or y != y else y
        elif op == casadi.OP_FMAX:
            for k in samples:
                x, y = work[a, k], work[b, k]
                work[to, k] = x if x > y or y != y else y
        elif op in (casadi.OP_POW, casadi.OP_CONSTPOW):
            for k in samples:
                work[to, k] = work[a, k] ** work[b, k]
        elif op == casadi.OP_FMOD:
            for k in samples:
                work[to, k] = np.fmod(work[a, k], work[b, k])
        elif op == casadi.OP_ATAN2:
            for k in samples:
                work[to, k] = math.atan2(work[a, k], work[b, k])
        elif op == casadi.OP_HYPOT:
            for k in samples:
                work[to, k] = math.hypot(work[a, k], work[b, k])
        elif op == casadi.OP_COPYSIGN:
            for k in samples:
                work[to, k] = math.copysign(work[a, k], work[b, k])


@keep_interrupt
@compile_loop(nogil=True, error_model="numpy")
def iterate_program(
    program: Any, constants: Any, inputs: Any, work: Any, outputs: Any, carried: int, signals: Any
) -> Any:  # pragma: no cover - compiled
    """Carry out a program once per sample, its first results the first inputs of the next sample.

    Parameters
    ----------
    program, constants, work, outputs
        As `run_program` takes them, in blocks of one sample.
    inputs : ndarray, shape (rows, 1)
        Arguments: the first values of what is carried, room for the signals, and others.
    carried : int
        How many results are carried.
    signals : ndarray, shape (signals, n)
        Values of the arguments behind those.

    Returns
    -------
    ndarray, shape (n, rows of the results)
        The results of each sample.
    """
    results = np.empty((signals.shape[1], len(outputs)))
    for k in range(len(results)):
        for row in range(len(signals)):
            inputs[carried + row, 0] = signals[row, k]
        # A number written here would be a type of its own, and all of it compiled once more.
        run_program(program, constants, inputs, work, outputs, inputs.shape[1])
        for row in range(len(outputs)):
            results[k, row] = outputs[row, 0]
        for row in range(carried):
            inputs[row, 0] = outputs[row, 0]
    return results


@keep_interrupt
@compile_loop(nogil=True, error_model="numpy")
def run_programs(
    program: Any,
    starts: Any,
    constants: Any,
    parts: int,
    carried: int,
    still: Any,
    places: Any,
    moving: Any,
    registers: int,
    tables: Any,
    out: Any,
    everything: int,
    first: int,
    block: int,
) -> None:  # pragma: no cover - compiled
    """Carry out programs one after another over a stretch of samples, a block at a time.

    Parameters
    ----------
    program : ndarray of int, shape (instructions, 4)
        The programs as `run_program` takes them, one below the other.
    starts : ndarray of int, shape (programs + 1,)
        Where each begins, and the end.
    constants : ndarray, shape (constants,)
        Numbers of all programs.
    parts : int
        How often in turn each program is carried out.
    carried : int
        Rows of the results that are the first rows of the next program's inputs; its last row is
        then the number of the part. Zero: there is one program, and no such row.
    still : ndarray, shape (rows,)
        Values of the inputs, where they are the same for all samples.
    places : ndarray of int, shape (moving,)
        Rows of the inputs that are not.
    moving : ndarray, shape (moving, samples)
        Their values.
    registers : int
        Room that the programs need.
    tables : ndarray of int, shape (outputs, 3)
        First row among the results, rows and columns of each output of the last program.
    out : ndarray, shape (everything * rows of the results,)
        Where the outputs go, each with shape (everything, rows, columns), one behind the other.
    everything : int
        Samples in all.
    first : int
        The sample at which the stretch begins.
    block : int
        Samples of a block.
    """
    size = moving.shape[1]
    count = tables[-1, 0] + tables[-1, 1] * tables[-1, 2]
    inputs, work = np.empty((len(still), block)), np.empty((registers, block))
    results = np.zeros((count, block))
    for row in range(len(still)):
        for k in range(block):
            inputs[row, k] = still[row]
    for begin in range(0, size, block):
        samples = min(block, size - begin)
        for row in range(carried):
            for k in range(samples):
                inputs[row, k] = still[row]
        for row in range(len(places)):
            for k in range(samples):
                inputs[places[row], k] = moving[row, begin + k]
        for s in range(len(starts) - 1):
            for part in range(parts):
                if carried:
                    for k in range(samples):
                        inputs[len(still) - 1, k] = part
                run_program(
                    program[starts[s] : starts[s + 1]], constants, inputs, work, results, samples
                )
                for row in range(carried):
                    for k in range(samples):
                        inputs[row, k] = results[row, k]
        for j in range(len(tables)):
            at, rows, columns = tables[j]
            base = everything * at + (first + begin) * rows * columns
            for column in range(columns):
                for row in range(rows):
                    place = base + row * columns + column
                    for k in range(samples):
                        out[place + k * rows * columns] = results[at + column * rows + row, k]
