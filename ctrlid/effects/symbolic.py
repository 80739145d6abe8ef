"""Operations on traced equations: formulas of effects, substitution, further states."""

import dataclasses
import inspect
from collections.abc import Mapping, Sequence
from typing import Any

import casadi
import numpy as np

from ..physics.equations import Equations, Lag
from ..physics.symbols import Symbol
from ..physics.tracing import rebind
from .context import Follow


def trace_hook(hook: Any) -> Any:
    """Return a hook that computes with symbols where it says numpy or math."""
    return rebind(hook) if inspect.ismethod(hook) else hook


def to_expression(value: Any) -> Any:
    """Return what a hook returned as a CasADi expression."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    return value.sx if isinstance(value, Symbol) else casadi.SX(float(value))


def substitute_symbol(e: Equations, old: Any, new: Any) -> Equations:
    """Return the equations with an expression in place of a symbol, wherever the plant has it."""
    rhs, output = (casadi.substitute(f, old, new) for f in (e.rhs, e.output))
    lags = tuple(
        Lag(lag.state, lag.time_constant, casadi.substitute(lag.target, old, new))
        for lag in e.lags
    )  # fmt: skip
    pushes = None if e.pushes is None else casadi.substitute(e.pushes, old, new)
    return dataclasses.replace(e, rhs=rhs, output=output, lags=lags, pushes=pushes)


def find_spread(e: Equations) -> Any:
    """Return the symbols for how uncertain each state is, new ones where there are none."""
    return casadi.SX.sym("s", len(e.states)) if e.spread is None else e.spread


def append_states(
    e: Equations, label: str, own: Mapping[str, Any], rates: Sequence[Any], rest: Sequence[float]
) -> Equations:
    """Append an effect's own states to the equations."""
    if not own:
        return e
    n, lags, columns = len(e.states), list(e.lags), []
    for k, rate in enumerate(rates):
        if isinstance(rate, Follow):
            tau, target = to_expression(rate.time_constant), to_expression(rate.target)
            tau = casadi.fmax(tau, rate.shortest)
            lags.append(Lag(n + k, tau, target))
            columns.append((target - list(own.values())[k]) / tau)
        else:
            columns.append(to_expression(rate))
    return dataclasses.replace(
        e,
        states=(*e.states, *(f"{label}.{name}" for name in own)),
        x=casadi.vertcat(e.x, *own.values()),
        rhs=casadi.vertcat(e.rhs, *columns),
        spread=casadi.vertcat(e.spread, *(casadi.SX.sym("s") for _ in own)),
        lags=tuple(lags),
        rest=(*e.rest, *(float(v) for v in rest)),
    )
