"""A play of the input along a record: what the plant gets, and how that depends on parameters."""

import functools
from dataclasses import dataclass
from typing import Any

import casadi
import numba
import numpy as np

from ..._base.arrays import Array
from ...loop.period_map import apply_backlash
from ...physics.block_evaluation import BlockEvaluation
from ...physics.interpreter import follow
from .transition_maps import PeriodPlan


@dataclass(frozen=True, eq=False)
class BacklashPath:
    """What an input passes through once per sample, as functions of memory, input, parameters.

    `after` is the next memory; `slopes` returns the applied input and how it and the next memory
    depend on the memory and on the free parameters.
    """

    after: BlockEvaluation
    slopes: BlockEvaluation

    def memories(self, first: float, u: Array, p: Array) -> Array:
        """Return the memory before each of n samples and after the last, shape (n + 1,)."""
        after = self.after
        inputs = np.concatenate([[first, 0.0], p])[:, None]
        room = np.empty((after.registers, 1)), np.zeros((after.rows_out, 1))
        found: Array = follow(after.program, after.constants, inputs, *room, u)
        return found

    def along(self, first: float, u: Array, p: Array) -> tuple[Array, Array]:
        """Return the applied input, shape (n,), and its derivatives by the free parameters.

        Those have shape (n, free); the first memory is held.
        """
        memories = self.memories(first, u, p)[:-1]
        applied, *slopes = self.slopes(memories[None, :], u[None, :], p)
        seen, moved = (np.broadcast_to(v, (len(u), *v.shape[1:]))[:, 0, :] for v in slopes)
        by_memory = _carry_gap(moved[:, 0], moved[:, 1:])
        return applied[:, 0, 0], seen[:, :1] * by_memory + seen[:, 1:]


@functools.lru_cache(maxsize=64)
def follow_backlash(plan: PeriodPlan) -> BacklashPath:
    """Return the play of a plan, built once."""
    e = plan.equations
    assert e.play is not None
    m, u, p = casadi.SX.sym("m"), casadi.SX.sym("u"), casadi.SX.sym("p", e.p.shape[0])
    applied, after = apply_backlash(e, m, u, p)
    by = casadi.vertcat(m, *(p[k] for k in plan.index))
    slopes = [applied, casadi.jacobian(applied, by), casadi.jacobian(after, by)]
    return BacklashPath(
        *(BlockEvaluation(casadi.Function("play", [m, u, p], out)) for out in ([after], slopes))
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _carry_gap(gain: Any, push: Any) -> Any:  # pragma: no cover - compiled
    """Return what obeys ``s[k + 1] = gain[k] s[k] + push[k]`` and begins at zero."""
    out = np.zeros(push.shape)
    for k in range(len(push) - 1):
        for j in range(push.shape[1]):
            out[k + 1, j] = gain[k] * out[k, j] + push[k, j]
    return out
