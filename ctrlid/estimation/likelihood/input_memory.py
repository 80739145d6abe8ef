"""The input behind a backlash or a limited rate, of which nobody knows where it stood at first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi
import numpy as np
from scipy import special, stats

from ..._base.arrays import Array
from ..._base.compilation import compile_loop
from ..._base.interruption import keep_interrupt
from ...loop.period_map import apply_memory, find_memory_range
from ...physics.block_evaluation import BlockEvaluation
from ...physics.equations import Equations

# Beyond so many standard deviations a corner is met for certain; a spread of zero is no exception.
CERTAIN = 30.0
# The ends of the range are met from a little beyond, where a gap clips and has derivatives.
BEYOND = 1 + 1e-6


@dataclass(frozen=True, eq=False)
class InputRange:
    r"""What the input behind its memory may be at each sample, and its derivatives.

    A backlash only ever clips what it remembers, and clips one after another are a clip: from
    the memory m at the start,

    .. math:: u_a = \min(\max(m, l_k), h_k)

    where l and h are the inputs that follow from the lowest and from the highest memory there is.
    They are equal from the sample on at which the input has crossed the gap.

    Parameters
    ----------
    low, high : ndarray, shape (..., n)
        The lowest and the highest input.
    low_slopes, high_slopes : ndarray, shape (..., n, free)
        Their derivatives by the free parameters.
    """

    low: Array
    high: Array
    low_slopes: Array
    high_slopes: Array

    def map(self, change: Callable[[Array], Array]) -> InputRange:
        """Return what becomes of all four by the same change, of their samples, say."""
        return replace(
            self, low=change(self.low), high=change(self.high),
            low_slopes=change(self.low_slopes), high_slopes=change(self.high_slopes),
        )  # fmt: skip

    def follow(self, memory: Any) -> Array:
        """Return the input that follows from a known memory at the start."""
        return np.asarray(np.clip(memory, self.low, self.high))

    def linearize(self, memory: Array, spread: Array) -> tuple[Array, Array, Array]:
        r"""Return the expected input and its derivatives, for a normal memory at the start.

        .. math:: \bar u_a = l + s F\Bigl(\frac{m - l}{s}\Bigr) - s F\Bigl(\frac{m - h}{s}\Bigr),
            \quad F(z) = z \Phi(z) + \varphi(z)

        with the standard deviation s of the memory (statistical linearization: Gelb, *Applied
        Optimal Estimation*, section 6.2).

        Parameters
        ----------
        memory, spread : ndarray, shape (n,)
            Mean and standard deviation of the memory, as known at each sample.

        Returns
        -------
        applied, by_memory : ndarray, shape (..., n)
            The input, and its derivative by the memory.
        by_parameters : ndarray, shape (..., n, free)
            Its derivatives by the free parameters.
        """
        s = np.maximum(spread, np.finfo(float).tiny)
        with np.errstate(over="ignore"):
            above_low, above_high = (
                np.clip((memory - bound) / s, -CERTAIN, CERTAIN) for bound in (self.low, self.high)
            )
        inside, beyond = special.ndtr(above_low), special.ndtr(above_high)
        bent = stats.norm.pdf(above_low) - stats.norm.pdf(above_high)
        clipped = self.low * (1 - inside) + self.high * beyond
        applied = clipped + memory * (inside - beyond) + s * bent
        by_parameters = (
            self.low_slopes * (1 - inside)[..., None] + self.high_slopes * beyond[..., None]
        )
        return applied, inside - beyond, by_parameters


@dataclass(frozen=True, eq=False)
class RampRange(InputRange):
    r"""What the input behind a limited rate may be at each sample.

    The actuator moves on from where it was at the start. Until it arrives,

    .. math:: u_a = l_k + \lambda (h_k - l_k), \quad \lambda = \frac{m - l}{h - l}

    with the lowest and the highest memory l and h ahead of the first sample, which is exact at both
    ends: where the actuator rests, and where it is told to be.

    Parameters
    ----------
    lowest, highest : float
        The lowest and the highest memory ahead of the first sample.
    """

    lowest: float
    highest: float

    def _find_share(self, way: Any) -> Any:
        """Return which share of the way from the lowest to the highest memory something is."""
        width = self.highest - self.lowest
        return way / width if width > 0 else 0.0 * way

    def follow(self, memory: Any) -> Array:
        """Return the input that follows from a known memory at the start."""
        share = self._find_share(memory - self.lowest)
        return np.asarray(self.low + share * (self.high - self.low))

    def linearize(self, memory: Array, spread: Array) -> tuple[Array, Array, Array]:
        """Return the expected input and its derivatives, which do not depend on the spread."""
        del spread
        share = self._find_share(memory - self.lowest)[..., None]
        by_parameters = self.low_slopes + share * (self.high_slopes - self.low_slopes)
        return self.follow(memory), self._find_share(self.high - self.low), by_parameters


def find_input_range(
    e: Equations, index: Sequence[int], u: Array, p: Array, at_rest: float, period: float,
    held: bool,
) -> InputRange:  # fmt: skip
    """Return what the input behind its memory may be along a record.

    Parameters
    ----------
    e : Equations
        The plant, with a backlash or a limited rate.
    index : sequence of int
        Places of the free parameters.
    u : ndarray, shape (n,)
        The input before it.
    p : ndarray
        Values of all parameters.
    at_rest : float
        The input at the operating point.
    period : float
        Time from one input to the next [s].
    held : bool
        Whether the input is held from one to the next, and does not run straight.
    """
    key = ("input memory", tuple(index), period, held)
    after, slopes = e.derive(key, lambda: _build_maps(e, index, period, held))
    assert e.memory is not None
    middle, reach = find_memory_range(e, float(u[0]), at_rest, p)
    ends = middle - BEYOND * reach, middle + BEYOND * reach
    found = []
    for first in ends:
        follow = after.iterate(np.array([first]), u[None, :], p)[:, 0]
        memories = np.concatenate([[first], follow[:-1]])
        applied, *parts = slopes(memories[None, :], u[None, :], p)
        seen, carried = (np.broadcast_to(v, (len(u), *v.shape[1:]))[:, 0, :] for v in parts)
        by_memory = _carry_sensitivity(carried[:, 0], carried[:, 1:])
        found.append((applied[:, 0, 0], seen[:, :1] * by_memory + seen[:, 1:]))
    (low, low_slopes), (high, high_slopes) = found
    found_range = low, high, low_slopes, high_slopes
    return RampRange(*found_range, *ends) if e.memory.moves else InputRange(*found_range)


def _build_maps(
    e: Equations, index: Sequence[int], period: float, held: bool
) -> tuple[BlockEvaluation, BlockEvaluation]:
    """Return the next memory, and the applied input with the derivatives of both.

    Functions of memory, input and parameters; derivatives are by the memory and by the free
    parameters.
    """
    m, u, p = casadi.SX.sym("m"), casadi.SX.sym("u"), casadi.SX.sym("p", e.p.shape[0])
    applied, after = apply_memory(e, m, u, p, period, held)
    by = casadi.vertcat(m, *(p[k] for k in index))
    slopes: list[Any] = [applied, casadi.jacobian(applied, by), casadi.jacobian(after, by)]
    one, other = (casadi.Function("memory", [m, u, p], out) for out in ([after], slopes))
    return BlockEvaluation(one), BlockEvaluation(other)


@keep_interrupt
@compile_loop(nogil=True, error_model="numpy")
def _carry_sensitivity(gain: Any, push: Any) -> Any:  # pragma: no cover - compiled
    """Return what obeys ``s[k + 1] = gain[k] s[k] + push[k]`` and begins at zero."""
    out = np.zeros(push.shape)
    for k in range(1, len(push)):
        for j in range(push.shape[1]):
            out[k, j] = gain[k - 1] * out[k - 1, j] + push[k - 1, j]
    return out
