"""A loop simulated with the derivatives of its outputs by parameters and by its initial state."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi
import numpy as np

from .._base.arrays import Array
from ..physics.block_evaluation import BlockEvaluation
from ..physics.integration import count_delay_samples
from .loop import Loop
from .period_map import make_period_map


@dataclass(frozen=True, eq=False)
class SensitiveSimulation:
    """A loop over one sampling period, with exact derivatives.

    ``step(z, w, theta) -> (next z, y)``, with z, w and y as in a `PeriodMap` and the free
    parameters theta; ``slopes`` returns the derivatives of next z by z and theta, and those of y.
    """

    step: BlockEvaluation
    slopes: BlockEvaluation

    def run(self, start: Array, w: Array, theta: Array, states: int) -> tuple[Array, Array]:
        """Return outputs and their derivatives along a record.

        Parameters
        ----------
        start : ndarray, shape (z,)
            State at the first sample.
        w : ndarray, shape (signals, n)
            What drives the loop, as `Simulator.stack_signals` returns it.
        theta : ndarray, shape (p,)
            Values of the parameters.
        states : int
            The derivatives are those by theta and by so many first entries of `start`.

        Returns
        -------
        y : ndarray, shape (n, outputs)
            The outputs.
        slopes : ndarray, shape (n, outputs, p + states)
            Their derivatives.
        """
        size, p = len(start), len(theta)
        found = self.step.iterate(start, w, theta)
        visited = np.vstack([start, found[:-1, :size]])
        a, b, c, d = self.slopes(visited.T, w, theta)
        carried = np.zeros((size, p + states))
        carried[:states, p:] = np.eye(states)
        slopes = np.zeros((*c.shape[:2], p + states))
        slopes[:, :, :p] = d
        for k in range(len(c)):
            slopes[k] += c[k] @ carried
            carried = a[k] @ carried
            carried[:, :p] += b[k]
        return found[:, size:], slopes


def build_sensitive_simulation(
    loop: Loop, names: Sequence[str], substeps: int, hold: str, hold_r: str
) -> SensitiveSimulation:
    """Build the map of a period and its derivatives.

    Parameters
    ----------
    loop : Loop
        The loop; near its values the map holds, see `find_delay_range`.
    names : sequence of str
        The free parameters.
    substeps : int
        Integration steps in a period.
    hold, hold_r : str
        As `make_period_map` has them.

    Returns
    -------
    SensitiveSimulation
        The maps.
    """
    made = make_period_map(loop, substeps, hold, hold_r, names)
    sizes = {"z": len(made.rest), "w": sum(made.counts), "theta": len(names)}
    z, w, theta = (casadi.SX.sym(key, size) for key, size in sizes.items())
    after, y = made.step(z, w, theta)[:2]
    slopes = [casadi.densify(casadi.jacobian(v, by)) for v in (after, y) for by in (z, theta)]
    return SensitiveSimulation(
        BlockEvaluation(casadi.Function("step", [z, w, theta], [after, y])),
        BlockEvaluation(casadi.Function("slopes", [z, w, theta], slopes)),
    )


def find_delay_range(loop: Loop, name: str) -> tuple[float, float]:
    """Return between which values of a parameter a map of the loop holds [its unit].

    The input remembers as many samples as a delay has when the map is built; for all other
    parameters there is no limit.
    """
    e = loop.equations()
    place = list(e.parameters).index(name)
    if e.delay is None or not casadi.depends_on(e.delay, e.p[place]):
        return -np.inf, np.inf
    late = count_delay_samples(e, loop.dt)
    return late * loop.dt, (late + 1) * loop.dt
