"""Running a user's numpy function on symbols, so that its exact equations are known.

A python-control update function is ordinary Python. Called with `Symbol` objects in place of
numbers it returns its own formula, provided that every function it calls understands symbols.
`rebind` makes a copy of the function in which `numpy`, `math` and a few builtins do; the user's
function, and everybody else's `numpy`, stay untouched. What a symbol cannot do (decide an ``if``,
become a float) raises with the cure: nothing is guessed, and `physics.trace` compares the result
with the original function afterwards.
"""

import builtins
import functools
import inspect
import math
import sys
import types
from collections.abc import Callable
from typing import Any

import casadi
import numpy as np

from .errors import CtrlidError

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
        return _elementwise(op)(*inputs)

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


def _lift(value: Any) -> Any:
    return value.sx if isinstance(value, Symbol) else value


def _floor_mod(a: Any, b: Any) -> Any:
    return a - b * casadi.floor(a / b)


def _round(a: Any, digits: int = 0) -> Any:
    # Half to even, as Python and numpy round.
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


def _binary(op: Function, swapped: bool) -> Function:
    def method(self: Symbol, other: Any) -> Any:
        if isinstance(other, np.ndarray):
            return NotImplemented  # numpy's own loop comes back element by element
        pair = (_lift(other), self.sx) if swapped else (self.sx, _lift(other))
        try:
            return Symbol(op(*pair))
        except (NotImplementedError, TypeError):
            return NotImplemented

    return method


for _dunder, _ufunc in _DUNDERS.items():
    setattr(Symbol, f"__{_dunder}__", _binary(OPERATORS[_ufunc], swapped=False))
    setattr(Symbol, f"__r{_dunder}__", _binary(OPERATORS[_ufunc], swapped=True))


def _clip(a: Any, low: Any = None, high: Any = None) -> Any:
    a = a if low is None else casadi.fmax(a, low)
    return a if high is None else casadi.fmin(a, high)


def _interp(a: Any, xp: Any, fp: Any) -> Any:
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


def _has_symbols(value: Any) -> bool:
    if isinstance(value, (list, tuple)):
        return any(_has_symbols(v) for v in value)
    if isinstance(value, np.ndarray) and value.dtype == object:
        return any(isinstance(v, Symbol) for v in value.flat)
    return isinstance(value, Symbol)


def _elementwise(op: Function) -> Function:
    """Lift a function of casadi scalars to numpy arrays of symbols."""

    def apply(*args: Any, **kwargs: Any) -> Any:
        target = kwargs.pop("out", None)
        target = target[0] if isinstance(target, tuple) else target
        names = {"a_min": "low", "a_max": "high", "min": "low", "max": "high", "decimals": "digits"}
        named = {names.get(key, key): _lift(value) for key, value in kwargs.items()}
        arrays = [np.asarray(_boxed(a), dtype=object) for a in args]
        shape = np.broadcast_shapes(*(a.shape for a in arrays))
        flat = [np.broadcast_to(a, shape).reshape(-1) for a in arrays]
        out = np.empty(math.prod(shape), dtype=object)
        for k in range(out.size):
            out[k] = Symbol(op(*(_lift(a[k]) for a in flat), **named))
        if target is not None:  # x += 1 and np.sin(x, out=y)
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
            return functools.reduce(_elementwise(ELEMENTWISE[ufunc.__name__]), plain[0].ravel())
        if method == "__call__" and op is not None:
            return _elementwise(op)(*plain, out=kwargs.get("out"))
        result = getattr(ufunc, method)(*plain, **kwargs)
        return result.view(Symbols) if isinstance(result, np.ndarray) else result


def _boxed(value: Any) -> Any:
    if isinstance(value, Symbol):
        box = np.empty((), dtype=object)
        box[()] = value
        return box
    return value


def _or_original(symbolic: Function, original: Function) -> Function:
    """Choose the symbolic version where a symbol is among the arguments, else the original."""

    @functools.wraps(original, updated=())
    def call(*args: Any, **kwargs: Any) -> Any:
        symbols = _has_symbols(args) or any(_has_symbols(v) for v in kwargs.values())
        return (symbolic if symbols else original)(*args, **kwargs)

    return call


def _object_array(make: Function) -> Function:
    """Numpy's constructor with room for symbols, whatever number type was asked for."""

    @functools.wraps(make, updated=())
    def build(*args: Any, **kwargs: Any) -> Any:
        if make in (np.zeros, np.ones, np.empty, np.array, np.asarray):
            args = args[:1]
        kwargs.pop("dtype", None)
        return make(*args, dtype=object, **kwargs).view(Symbols)

    return build


def _casadi_matrix(array: Any) -> Any:
    rows = np.atleast_2d(np.asarray(array, dtype=object))
    return casadi.vertcat(*(casadi.horzcat(*(_lift(v) for v in row)) for row in rows))


def _from_casadi(matrix: Any, shape: tuple[int, ...]) -> Any:
    out = np.empty(matrix.shape, dtype=object)
    for index in np.ndindex(*matrix.shape):
        out[index] = Symbol(matrix[index])
    return out.reshape(shape).view(Symbols)


def _solve(a: Any, b: Any) -> Any:
    b = np.asarray(b, dtype=object)
    right = _casadi_matrix(b.reshape(len(b), -1))
    return _from_casadi(casadi.mtimes(casadi.inv(casadi.SX(_casadi_matrix(a))), right), b.shape)


LINALG: dict[str, Function] = {
    "solve": _or_original(_solve, np.linalg.solve),
    "inv": _or_original(
        lambda a: _from_casadi(casadi.inv(_casadi_matrix(a)), np.shape(a)), np.linalg.inv
    ),
    "det": _or_original(lambda a: Symbol(casadi.det(_casadi_matrix(a))), np.linalg.det),
    "norm": _or_original(
        lambda a: Symbol(casadi.sqrt(sum(_lift(v) ** 2 for v in np.ravel(a)))), np.linalg.norm
    ),
}


class _Module:
    """A module seen by a traced function: the same names, but they understand symbols."""

    def __init__(self, module: types.ModuleType, table: dict[str, Any]) -> None:
        self._module, self._table = module, table

    def __getattr__(self, name: str) -> Any:
        if name in self._table:
            return self._table[name]
        found = getattr(self._module, name)
        if self._module is np and inspect.isroutine(found):
            return _keeping_symbols(found)
        return _replace(found, {})


def _keeping_symbols(function: Function) -> Function:
    """Numpy's function, whose arrays of symbols stay arrays of symbols (hstack, diff, ...)."""

    @functools.wraps(function, updated=())
    def call(*args: Any, **kwargs: Any) -> Any:
        result = function(*args, **kwargs)
        return result.view(Symbols) if _has_symbols(result) and np.ndim(result) else result

    return call


class _Instance:
    """A user's object seen by one of its traced methods: its other methods are traced as well."""

    def __init__(self, instance: Any) -> None:
        object.__setattr__(self, "_instance", instance)

    def __getattr__(self, name: str) -> Any:
        return _replace(getattr(self._instance, name), {})

    def __setattr__(self, name: str, value: Any) -> None:
        raise TracingError(
            f"the method stores self.{name}; a plant must not remember anything between calls: "
            "make it a state"
        )


def _identity(value: Any = 0.0) -> Any:
    return value


def _numpy_table() -> dict[str, Any]:
    table: dict[str, Any] = {
        name: _or_original(_elementwise(op), getattr(np, name))
        for name, op in ELEMENTWISE.items()
        if hasattr(np, name)
    }
    for make in (np.zeros, np.ones, np.empty, np.full, np.array, np.asarray, np.zeros_like,
                 np.ones_like, np.empty_like, np.full_like, np.asanyarray):  # fmt: skip
        table[str(getattr(make, "__name__"))] = _object_array(make)  # noqa: B009
    for number in ("float64", "float32", "double"):
        table[number] = _or_original(_identity, getattr(np, number))
    table["interp"] = _or_original(
        lambda a, xp, fp: _elementwise(lambda s: _interp(s, xp, fp))(a), np.interp
    )
    table["linalg"] = _Module(np.linalg, LINALG)
    return table


_NUMPY = _Module(np, _numpy_table())
_MATH = _Module(
    math,
    {n: _or_original(_elementwise(op), getattr(math, n)) for n, op in ELEMENTWISE.items()
     if hasattr(math, n)},
)  # fmt: skip
_MODULES: dict[str, Any] = {"numpy": _NUMPY, "math": _MATH}
_BY_IDENTITY = {
    id(getattr(module._module, name)): new
    for module in (_NUMPY, _MATH, _NUMPY._table["linalg"])
    for name, new in module._table.items()
}


def _import(name: str, *args: Any, **kwargs: Any) -> Any:
    return _replace(builtins.__import__(name, *args, **kwargs), {})


_BUILTINS = {
    **vars(builtins),
    "float": _or_original(_identity, float),
    "max": _or_original(
        lambda *a: functools.reduce(_elementwise(casadi.fmax), a if len(a) > 1 else a[0]), max
    ),
    "min": _or_original(
        lambda *a: functools.reduce(_elementwise(casadi.fmin), a if len(a) > 1 else a[0]), min
    ),
    "__import__": _import,
}


def _replace(obj: Any, memo: dict[int, Any]) -> Any:
    if id(obj) in _BY_IDENTITY:
        return _BY_IDENTITY[id(obj)]
    if isinstance(obj, types.ModuleType):
        root = obj.__name__.partition(".")[0]
        if root in sys.stdlib_module_names or root in ("numpy", "scipy", "control", "casadi"):
            return _MODULES.get(obj.__name__, obj)
        return _Module(obj, {})
    if obj is float:
        return _BUILTINS["float"]
    if isinstance(obj, types.FunctionType | types.MethodType | functools.partial):
        return rebind(obj, memo)
    if hasattr(obj, "py_func"):  # a function compiled by numba keeps its source here
        return rebind(obj.py_func, memo)
    return obj


def _names(code: types.CodeType) -> set[str]:
    nested = (c for c in code.co_consts if isinstance(c, types.CodeType))
    return set(code.co_names).union(*(_names(c) for c in nested))


def rebind(function: Any, memo: dict[int, Any] | None = None) -> Any:
    """Return a copy of a Python function that computes with symbols.

    The copy shares its code with the original, but finds versions of `numpy`, `math`, `float`,
    `max` and `min` that accept `Symbol` objects, and so do the user's own functions it calls.
    Functions of the standard library and of compiled packages are left as they are.

    Parameters
    ----------
    function : callable
        A function, method, `functools.partial` or an object with ``__call__``.
    memo : dict, optional
        Copies made so far, for functions that call each other.

    Returns
    -------
    callable
        The copy.
    """
    memo = {} if memo is None else memo
    if id(function) in memo:
        return memo[id(function)]
    if isinstance(function, functools.partial):
        inner = rebind(function.func, memo)
        return functools.partial(inner, *function.args, **function.keywords)
    if isinstance(function, types.MethodType):
        return types.MethodType(rebind(function.__func__, memo), _Instance(function.__self__))
    if not isinstance(function, types.FunctionType):
        call = vars(type(function)).get("__call__")
        if isinstance(call, types.FunctionType):
            return types.MethodType(rebind(call, memo), _Instance(function))
        return function
    if function.__module__ and function.__module__.partition(".")[0] in ("numpy", "control"):
        return function
    scope: dict[str, Any] = {**function.__globals__, "__builtins__": _BUILTINS}
    cells = [types.CellType() for _ in function.__closure__ or ()]
    copy = types.FunctionType(
        function.__code__, scope, function.__name__, function.__defaults__, tuple(cells)
    )
    copy.__kwdefaults__ = function.__kwdefaults__
    memo[id(function)] = copy
    for name in _names(function.__code__) & function.__globals__.keys():
        scope[name] = _replace(function.__globals__[name], memo)
    for new, old in zip(cells, function.__closure__ or (), strict=True):
        new.cell_contents = _replace(old.cell_contents, memo)
    if function.__defaults__:
        copy.__defaults__ = tuple(_replace(v, memo) for v in function.__defaults__)
    return copy
