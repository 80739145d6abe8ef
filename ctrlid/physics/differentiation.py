r"""Derivatives of a period of integration, stage by stage.

A formula of Runge and Kutta evaluates the rates f of a plant at several points, each of which
depends on the rates before it. Differentiated as one long expression it repeats the formulas of
the plant for every direction of differentiation. Here the Jacobian of f is written once for each
stage, and the directions are carried through it,

.. math:: K_i = f(z_i), \quad dK_i = \frac{\partial f}{\partial z}(z_i) \, dz_i,

which gives the same numbers, to rounding, from a fraction of the instructions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi

from .equations import Equations


@dataclass(frozen=True, eq=False)
class Stages:
    """Rates and outputs of a plant that stand as symbols where they are evaluated.

    It takes the place of `Equations.smoothed` while a period is written down, and keeps what each
    symbol stands for: the symbols, the time, states, input, parameters and spreads.
    """

    equations: Equations
    found: list[tuple[Any, tuple[Any, ...]]] = field(default_factory=list)

    def __call__(self, t: Any, x: Any, u: Any, p: Any, spread: Any) -> tuple[Any, Any]:
        """Return symbols for the rates and the outputs at a point."""
        e = self.equations
        rates, outputs = (casadi.SX.sym(k, len(v)) for k, v in (("k", e.states), ("h", e.outputs)))
        self.found.append((casadi.vertcat(rates, outputs), (t, x, u, p, spread)))
        return rates, outputs


def differentiate(
    end: Any, stages: Stages, index: Sequence[int], by: Sequence[Any], seeds: Sequence[Any]
) -> tuple[Any, Any]:
    """Return an expression with its stages filled in, and its derivatives.

    Parameters
    ----------
    end : casadi.SX
        What is differentiated, with the symbols of the stages in it.
    stages : Stages
        What these stand for; their parameters are one column of symbols.
    index : sequence of int
        Places among the parameters that the derivatives are taken by.
    by : sequence of casadi.SX
        Columns of symbols that expression and stages depend on, those parameters among them.
    seeds : sequence of casadi.SX
        Derivatives of each of these columns, a column for each direction.

    Returns
    -------
    end, slopes : casadi.SX
        The expression, and its derivatives with a column for each direction.
    """
    known, slopes = casadi.vertcat(*by), casadi.SX(casadi.vertcat(*seeds))
    symbols, values, direct = [], [], None
    for symbol, (t, x, u, p, spread) in stages.found:
        moved = _carry(casadi.vertcat(t, x, u), known, slopes)
        if direct is None:
            # The parameters are the same symbols in every stage.
            direct = _carry(casadi.vertcat(*(p[k] for k in index)), known, slopes)
        value, by_point, by_parameters = _evaluate(stages.equations, index)(t, x, u, p, spread)
        slope = casadi.mtimes(by_point, moved) + casadi.mtimes(by_parameters, direct)
        known, slopes = casadi.vertcat(known, symbol), casadi.vertcat(slopes, slope)
        symbols.append(symbol)
        values.append(value)
    found = [casadi.SX(end), _carry(end, known, slopes)]
    if symbols:
        found = casadi.substitute_inplace(symbols, values, found)[1]
    return found[0], found[1]


def _carry(column: Any, known: Any, slopes: Any) -> Any:
    """Return the derivatives of a column by those of the symbols in it."""
    return casadi.mtimes(casadi.jacobian(casadi.SX(column), known), slopes)


def _evaluate(e: Equations, index: Sequence[int]) -> Any:
    """Return the function from a point to rates and outputs and to their derivatives.

    Those are by time, states and input, and by the parameters of that index.
    """

    def build() -> Any:
        spread = casadi.SX.sym("s", len(e.states)) if e.spread is None else e.spread
        both = casadi.vertcat(e.rhs, e.output)
        own = casadi.vertcat(*(e.p[k] for k in index)) if index else casadi.SX(0, 1)
        point = casadi.vertcat(e.t, e.x, e.u)
        by = casadi.vertcat(point, own)
        # Few rates have long formulas, so that a gradient for each is shorter than a direction for
        # each symbol.
        slopes = casadi.vertcat(*(casadi.gradient(v, by).T for v in casadi.vertsplit(both)))
        parts = casadi.horzsplit(slopes, [0, point.shape[0], by.shape[0]])
        return casadi.Function("stage", [e.t, e.x, e.u, e.p, spread], [both, *parts],
                               {"cse": True})  # fmt: skip

    return e.derive(("stage", *index), build)
