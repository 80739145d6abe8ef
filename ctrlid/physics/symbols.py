"""Scalars and arrays of symbols, with which Python and numpy compute as with numbers."""

import functools
import math
from collections.abc import Callable
from typing import Any

import casadi
import numpy as np

from .._base.errors import CtrlidError

Function = Callable[..., Any]


class TracingError(CtrlidError):
    """A plant's function does something that equations cannot express."""


class Symbol:
    """A scalar expression that numpy treats as an opaque number."""

    __slots__ = ("sx",)
    __hash__ = object.__hash__

    def __init__(self, sx: Any) -> None:
        self.sx = sx

    def __bool__(self) -> bool:
        raise TracingError(
            "a Python 'if', 'while', 'and', 'or', 'not', 'max' or 'min' decides on the value of a "
            "state, input or time; write np.where(condition, a, b), np.maximum, np.minimum, "
            "or & and | between conditions instead"
        )

    def __float__(self) -> float:
        raise TracingError(
            "an expression of the states is turned into a plain float, by float(...), a "
            "preallocated array of floats or a function that knows numbers only; build the array "
            "in one expression, np.array([a, b]), inside the function and use numpy's functions"
        )

    __int__ = __index__ = __complex__ = __float__

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        op = ELEMENTWISE.get(ufunc.__name__) or OPERATORS.get(ufunc.__name__)
        if method != "__call__" or op is None:
            raise TracingError(
                f"the function {ufunc.__name__} is not known to the tracing; rewrite it with "
                "arithmetic, np.where, np.maximum or np.minimum"
            )
        return elementwise(op)(*inputs)

    def __abs__(self) -> "Symbol":
        return Symbol(casadi.fabs(self.sx))

    def __pos__(self) -> "Symbol":
        return self

    def __neg__(self) -> "Symbol":
        return Symbol(-self.sx)

    def __invert__(self) -> "Symbol":
        return Symbol(casadi.logic_not(self.sx))

    def __round__(self, digits: int | None = None) -> "Symbol":
        return Symbol(_round(self.sx, digits or 0))


def lift(value: Any) -> Any:
    """Return the expression of a symbol, or a number as it is."""
    return value.sx if isinstance(value, Symbol) else value


def _floor_mod(a: Any, b: Any) -> Any:
    return a - b * casadi.floor(a / b)


def _round(a: Any, digits: int = 0) -> Any:
    # Halves are rounded to even, as Python and numpy do.
    scaled = a * 10.0**digits
    low = casadi.floor(scaled)
    even = casadi.if_else(_floor_mod(low, 2) == 0, low, low + 1)
    diff = scaled - low
    up = casadi.if_else(diff > 0.5, low + 1, casadi.if_else(diff < 0.5, low, even))
    return up / 10.0**digits


OPERATORS: dict[str, Function] = {
    "add": lambda a, b: a + b,
    "subtract": lambda a, b: a - b,
    "multiply": lambda a, b: a * b,
    "divide": lambda a, b: a / b,
    "true_divide": lambda a, b: a / b,
    "floor_divide": lambda a, b: casadi.floor(a / b),
    "remainder": _floor_mod,
    "power": lambda a, b: a**b,
    "less": lambda a, b: a < b,
    "less_equal": lambda a, b: a <= b,
    "greater": lambda a, b: a > b,
    "greater_equal": lambda a, b: a >= b,
    "equal": lambda a, b: a == b,
    "not_equal": lambda a, b: a != b,
    "bitwise_and": casadi.logic_and,
    "bitwise_or": casadi.logic_or,
    "negative": lambda a: -a,
    "positive": lambda a: a,
}
_DUNDERS = {
    "add": "add", "sub": "subtract", "mul": "multiply", "truediv": "divide",
    "floordiv": "floor_divide", "mod": "remainder", "pow": "power", "and": "bitwise_and",
    "or": "bitwise_or", "lt": "less", "le": "less_equal", "gt": "greater",
    "ge": "greater_equal", "eq": "equal", "ne": "not_equal",
}  # fmt: skip


def _make_operator(op: Function, swapped: bool) -> Function:
    def method(self: Symbol, other: Any) -> Any:
        if isinstance(other, np.ndarray):
            # Numpy's own loop then calls this method element by element.
            return NotImplemented
        pair = (lift(other), self.sx) if swapped else (self.sx, lift(other))
        try:
            return Symbol(op(*pair))
        except (NotImplementedError, TypeError):
            return NotImplemented

    return method


for _dunder, _ufunc in _DUNDERS.items():
    setattr(Symbol, f"__{_dunder}__", _make_operator(OPERATORS[_ufunc], swapped=False))
    setattr(Symbol, f"__r{_dunder}__", _make_operator(OPERATORS[_ufunc], swapped=True))


def _clip(a: Any, low: Any = None, high: Any = None) -> Any:
    a = a if low is None else casadi.fmax(a, low)
    return a if high is None else casadi.fmin(a, high)


def interp(a: Any, xp: Any, fp: Any) -> Any:
    """Return the value at `a` of the polygon through points, constant beyond its ends."""
    xp, fp = np.asarray(xp, float), np.asarray(fp, float)
    value: Any = fp[0]
    for k in range(len(xp) - 1):
        slope = (fp[k + 1] - fp[k]) / (xp[k + 1] - xp[k])
        value = casadi.if_else(a >= xp[k], fp[k] + slope * (a - xp[k]), value)
    return casadi.if_else(a >= xp[-1], fp[-1], value)


ELEMENTWISE: dict[str, Function] = {
    **{name: getattr(casadi, name) for name in (
        "sin", "cos", "tan", "sinh", "cosh", "tanh", "arcsin", "arccos", "arctan", "arctan2",
        "arcsinh", "arccosh", "arctanh", "exp", "expm1", "log", "log10", "log1p", "sqrt", "sign",
        "floor", "ceil", "fmax", "fmin", "hypot", "erf", "copysign")},
    "asin": casadi.arcsin, "acos": casadi.arccos, "atan": casadi.arctan,
    "atan2": casadi.arctan2, "asinh": casadi.arcsinh, "acosh": casadi.arccosh,
    "atanh": casadi.arctanh, "abs": casadi.fabs, "absolute": casadi.fabs, "fabs": casadi.fabs,
    "maximum": casadi.fmax, "minimum": casadi.fmin, "pow": lambda a, b: a**b,
    "float_power": lambda a, b: a**b, "square": lambda a: a * a,
    "reciprocal": lambda a: 1.0 / a, "cbrt": lambda a: casadi.sign(a) * casadi.fabs(a) ** (1 / 3),
    "log2": lambda a: casadi.log(a) / math.log(2.0), "exp2": lambda a: 2.0**a,
    "fmod": casadi.fmod, "mod": _floor_mod, "deg2rad": lambda a: a * (math.pi / 180),
    "rad2deg": lambda a: a * (180 / math.pi), "radians": lambda a: a * (math.pi / 180),
    "degrees": lambda a: a * (180 / math.pi), "clip": _clip,
    "heaviside": lambda a, at0: casadi.if_else(a > 0, 1.0, casadi.if_else(a < 0, 0.0, at0)),
    "sinc": lambda a: casadi.if_else(a == 0, 1.0, casadi.sin(math.pi * a) / (math.pi * a)),
    "logical_and": casadi.logic_and, "logical_or": casadi.logic_or,
    "logical_not": casadi.logic_not, "where": casadi.if_else,
    "round": _round, "around": _round, "trunc": lambda a: casadi.sign(a) * casadi.floor(
        casadi.fabs(a)),
}  # fmt: skip


def has_symbols(value: Any) -> bool:
    """Return whether a value is a symbol, or an array or a sequence with one in it."""
    if isinstance(value, (list, tuple)):
        return any(has_symbols(v) for v in value)
    if isinstance(value, np.ndarray) and value.dtype == object:
        return any(isinstance(v, Symbol) for v in value.flat)
    return isinstance(value, Symbol)


def elementwise(op: Function) -> Function:
    """Lift a function of casadi scalars to numpy arrays of symbols."""

    def apply(*args: Any, **kwargs: Any) -> Any:
        target = kwargs.pop("out", None)
        target = target[0] if isinstance(target, tuple) else target
        names = {"a_min": "low", "a_max": "high", "min": "low", "max": "high", "decimals": "digits"}
        named = {names.get(key, key): lift(value) for key, value in kwargs.items()}
        arrays = [np.asarray(_boxed(a), dtype=object) for a in args]
        shape = np.broadcast_shapes(*(a.shape for a in arrays))
        flat = [np.broadcast_to(a, shape).reshape(-1) for a in arrays]
        out = np.empty(math.prod(shape), dtype=object)
        for k in range(out.size):
            out[k] = Symbol(op(*(lift(a[k]) for a in flat), **named))
        # Operations in place, such as x += 1 and np.sin(x, out=y), name a target.
        if target is not None:
            target[...] = out.reshape(shape)
            return target
        return out.reshape(shape).view(Symbols) if shape else out[0]

    return apply


class Symbols(np.ndarray):
    """An array of symbols that also compares and reduces element by element."""

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        plain = [np.asarray(a) if isinstance(a, Symbols) else a for a in inputs]
        op = ELEMENTWISE.get(ufunc.__name__) or OPERATORS.get(ufunc.__name__)
        if method == "reduce" and ufunc.__name__ in ("maximum", "minimum"):
            return functools.reduce(elementwise(ELEMENTWISE[ufunc.__name__]), plain[0].ravel())
        if method == "__call__" and op is not None:
            return elementwise(op)(*plain, out=kwargs.get("out"))
        result = getattr(ufunc, method)(*plain, **kwargs)
        return result.view(Symbols) if isinstance(result, np.ndarray) else result


def _boxed(value: Any) -> Any:
    if isinstance(value, Symbol):
        box = np.empty((), dtype=object)
        box[()] = value
        return box
    return value
