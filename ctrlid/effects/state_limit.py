"""States that cannot exceed a limit."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, ClassVar, Self, final

import casadi
import numpy as np
from scipy import signal

from .._base.errors import EffectDoesNotApply
from ..physics.equations import Equations
from ..physics.linearization import compute_state_matrices
from .context import Moment
from .kinds import LawEffect
from .parameters import parameter
from .scanning import CUT_OFF, Overview, Scan, Sight
from .symbolic import to_expression

# What exceeds a limit runs off with a time constant of this share of a sampling period.
OVERFLOW_TIME = 0.25


@final
@dataclass(frozen=True)
class StateLimit(LawEffect):
    r"""A state that cannot exceed a limit: what flows in beyond it runs over.

    .. math:: \dot x = f - q, \quad \dot x_{to} = f_{to} + \kappa q, \quad
        q = \max(x - x_{max}, 0) / (T/4)

    with the sampling period T. A tank that overflows, in part into the next one.

    Parameters
    ----------
    name : str
        The state.
    upper : float
        Its limit [unit of the state].
    spill_to : str, optional
        The state that what runs over flows into; by default it is lost.
    share : float, optional
        The share kappa of it that arrives there, between 0 and 1.

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.StateLimit("h1", upper=10.0, spill_to="h2", share=0.3))
    StateLimit: name = h1, upper = 10 [state], spill_to = h2, share = 0.3
    """

    name: str
    upper: float = parameter("{x}", neutral=math.inf)
    spill_to: str = ""
    share: float = parameter("", lower=0.0, upper=1.0, default=1.0)

    look_alikes: ClassVar[tuple[str, ...]] = ("SensorSaturation", "InputSaturation")
    sentence: ClassVar[str] = "A state has an upper limit, as a tank that overflows."
    experiment: ClassVar[str] = "large slow steps that take the state up to its limit and beyond"

    @property
    def limited_states(self) -> tuple[str, ...]:
        """The state: below its limit nothing runs over, however large the motion may be."""
        return (self.name,)

    @classmethod
    def candidates(cls, loop: Any, record: Any = None) -> tuple[Self, ...]:
        """Return one for each state that is no motion; it spills into the state it feeds."""
        e = loop.equations()
        own = range(len(e.states) - len(e.rest))
        moving = {*e.velocities, *(i for i in own if _rate_is_state(e, i))}
        if loop.linear_plant or e.dt:
            return ()
        found = []
        for i in own:
            if i in moving:
                continue
            fed = [k for k in own if k != i and casadi.jacobian(e.rhs[k], e.x[i]).nnz()]
            upper = _find_high_value(loop, record, i)
            to, share = (e.states[fed[0]], 0.5) if fed else ("", 1.0)
            found.append(cls(e.states[i], upper, to, share))
        return cls._applicable(loop, *found)

    def spread_starts(self, sight: Overview) -> tuple[Self, ...]:
        """Return limits from the highest down: where one cuts off little, the model still holds."""
        values = sight.state(self.name)
        if values is None:
            return (self,)
        levels = np.quantile(np.concatenate(values), CUT_OFF)
        return tuple(dataclasses.replace(self, upper=float(v)) for v in levels)

    def scan(self, sight: Sight) -> Scan | None:
        """Look at limits over the range that the state has visited."""
        if sight.state(self.name) is None:
            return None
        starts = self.spread_starts(sight)
        return Scan((starts,), places=len(starts))

    def build(self, e: Equations, m: Moment) -> Equations:
        """Return the equations with the overflow."""
        unknown = [s for s in (self.name, self.spill_to or self.name) if s not in e.states]
        if unknown:
            raise EffectDoesNotApply(
                f"StateLimit names the state {unknown[0]!r}; {e.name} has {list(e.states)}"
            )
        if e.dt:
            raise EffectDoesNotApply(
                "StateLimit is a flow in continuous time; the plant "
                f"{e.name} is sampled at {e.dt:g} s"
            )
        over = to_expression(m.above(m.states[self.name] - self.upper)) / (OVERFLOW_TIME * m.dt)
        rhs = casadi.SX(e.rhs)
        i = e.states.index(self.name)
        rhs[i] = rhs[i] - over
        if self.spill_to:
            k = e.states.index(self.spill_to)
            rhs[k] = rhs[k] + to_expression(self.share) * over
        return dataclasses.replace(e, rhs=rhs)


def _rate_is_state(e: Equations, i: int) -> bool:
    rate = casadi.simplify(e.rhs[i])
    return any(casadi.is_equal(rate, e.x[k], 2) for k in range(len(e.states)) if k != i)


def _find_high_value(loop: Any, record: Any, i: int) -> float:
    """Return a value that a state exceeds now and then, as far as a record tells."""
    e, at = loop.equations(), loop.point
    if record is not None and casadi.is_equal(e.output[0], e.x[i], 2):
        return float(np.quantile(record.y, 0.9))
    # The linear model tells the range of the state from the recorded input.
    if record is not None:
        a, b, _, _ = compute_state_matrices(e, at)
        if np.linalg.eigvals(a).real.max() < 0:
            n = len(a)
            # Of several inputs the record has the first; a scan looks at limits further on.
            sampled = signal.cont2discrete((a, b[:, :1], np.eye(n), np.zeros((n, 1))), record.dt)
            deviation = signal.dlsim(sampled, record.u - at.input)[1][:, i]
            return float(at.states[i] + np.quantile(deviation, 0.9))
    return float(at.states[i] + 0.5 * max(abs(at.states[i]), 1e-3))
