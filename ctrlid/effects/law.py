"""Changes inside the plant's own law: what it sees and how its force falls."""

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, final

import casadi
import numpy as np

from .._base.errors import EffectDoesNotApply
from ..physics.equations import Equations
from .base import require_position
from .context import Moment
from .kinds import LawEffect
from .parameters import parameter
from .symbolic import to_expression

# A force agrees with the inverse square of the distance up to this relative error.
INVERSE_SQUARE = 1e-9


@final
@dataclass(frozen=True)
class PositionOffset(LawEffect):
    r"""The law sees another position than the sensor's zero says.

    .. math:: f(x, \dot x, u) \to f(x + x_{off}, \dot x, u)

    The gap of a magnet counted from a wrong surface.

    Parameters
    ----------
    offset : float
        What the law adds to the position [output unit].

    Examples
    --------
    >>> import ctrlid as cid
    >>> print(cid.effects.PositionOffset(offset=0.0008))
    PositionOffset: offset = 0.0008 [y]
    """

    offset: float = parameter("{y}", neutral=0.0)

    look_alikes: ClassVar[tuple[str, ...]] = (
        "SensorOffset", "ForceExponent", "LinearStiffness", "InputOffset",
    )  # fmt: skip
    sentence: ClassVar[str] = "The position in the force law has an offset."
    experiment: ClassVar[str] = (
        "the stiffness at operating points far apart, and a reference measurement of the zero of "
        "the sensor"
    )

    def law(self, m: Moment) -> dict[str, Any]:
        """Return the position as the law sees it."""
        return {m.position_name: m.position + self.offset}

    def build(self, e: Equations, m: Moment) -> Equations:
        """Return the changed equations, if the force depends on the position at all."""
        i, j = require_position(self, e)
        if not casadi.jacobian(e.rhs[j], e.x[i]).nnz():
            raise EffectDoesNotApply(
                f"PositionOffset: the force in {e.name} does not depend on "
                f"{e.states[i]}: an offset of it changes nothing"
            )
        return super().build(e, m)


@final
@dataclass(frozen=True)
class ForceExponent(LawEffect):
    r"""The input's force falls with another power of the distance than the second.

    .. math:: f_u \propto x^{-2} \to x_0^{-2} (x / x_0)^{-n}

    The same force at the operating point; `f_u` is the part that vanishes with the input.

    Parameters
    ----------
    n : float
        The power, 2 for a thin gap in iron, about 4 for a coil and a small magnet.

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.effects.ForceExponent(n=2).neutral
    True
    """

    n: float = parameter("", lower=0.5, upper=6.0, neutral=2.0)

    # It changes the force as the plant's equations have it, before offsets and curves.
    stage: ClassVar[int] = -1
    look_alikes: ClassVar[tuple[str, ...]] = (
        "PositionOffset", "LinearStiffness", "CubicStiffness", "SensorNonlinearity",
    )  # fmt: skip
    sentence: ClassVar[str] = "The force decreases with another power of the distance."
    experiment: ClassVar[str] = (
        "the input that holds the plant at rest, at operating points over the whole stroke"
    )

    def build(self, e: Equations, m: Moment) -> Equations:
        """Return the changed equations, if the force falls with the square of the distance."""
        i, j = require_position(self, e)
        rest = m.at.states[i]
        pull = e.rhs[j] - casadi.substitute(e.rhs[j], e.u, casadi.SX.zeros(*e.u.shape))
        falling = casadi.Function("pull", [e.t, e.x, e.u, e.p], [pull])
        values = list(e.parameters.values())
        ratios = []
        for scale in (0.7, 1.0, 1.4):
            states = np.array(m.at.states[: len(e.states)])
            states[i] *= scale
            ratios.append(scale**2 * float(falling(0.0, states, m.at.input or 1.0, values)))
        off = np.ptp(ratios) / max(abs(ratios[1]), np.finfo(float).tiny)
        if not (rest > 0 and ratios[1] and off < INVERSE_SQUARE):
            raise EffectDoesNotApply(
                f"ForceExponent needs a force of the input that falls with the square of "
                f"{e.states[i]} > 0; that of {e.name} does not"
            )
        factor = (e.x[i] / rest) ** (2 - to_expression(self.n))
        rhs = casadi.SX(e.rhs)
        rhs[j] = rhs[j] + pull * (factor - 1)
        return dataclasses.replace(e, rhs=rhs)
