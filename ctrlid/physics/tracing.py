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
from typing import Any

import casadi
import numpy as np

from .symbols import (
    ELEMENTWISE,
    Function,
    Symbol,
    Symbols,
    TracingError,
    elementwise,
    has_symbols,
    interp,
    lift,
)


def _dispatch_on_symbols(symbolic: Function, original: Function) -> Function:
    """Choose the symbolic version where a symbol is among the arguments, else the original."""

    @functools.wraps(original, updated=())
    def call(*args: Any, **kwargs: Any) -> Any:
        symbols = has_symbols(args) or any(has_symbols(v) for v in kwargs.values())
        return (symbolic if symbols else original)(*args, **kwargs)

    return call


def _allow_symbols(make: Function) -> Function:
    """Return numpy's constructor with room for symbols, whatever number type was asked for."""

    @functools.wraps(make, updated=())
    def build(*args: Any, **kwargs: Any) -> Any:
        if make in (np.zeros, np.ones, np.empty, np.array, np.asarray):
            args = args[:1]
        kwargs.pop("dtype", None)
        return make(*args, dtype=object, **kwargs).view(Symbols)

    return build


def _to_casadi(array: Any) -> Any:
    rows = np.atleast_2d(np.asarray(array, dtype=object))
    return casadi.vertcat(*(casadi.horzcat(*(lift(v) for v in row)) for row in rows))


def _from_casadi(matrix: Any, shape: tuple[int, ...]) -> Any:
    out = np.empty(matrix.shape, dtype=object)
    for index in np.ndindex(*matrix.shape):
        out[index] = Symbol(matrix[index])
    return out.reshape(shape).view(Symbols)


def _solve(a: Any, b: Any) -> Any:
    b = np.asarray(b, dtype=object)
    right = _to_casadi(b.reshape(len(b), -1))
    return _from_casadi(casadi.mtimes(casadi.inv(casadi.SX(_to_casadi(a))), right), b.shape)


LINALG: dict[str, Function] = {
    "solve": _dispatch_on_symbols(_solve, np.linalg.solve),
    "inv": _dispatch_on_symbols(
        lambda a: _from_casadi(casadi.inv(_to_casadi(a)), np.shape(a)), np.linalg.inv
    ),
    "det": _dispatch_on_symbols(lambda a: Symbol(casadi.det(_to_casadi(a))), np.linalg.det),
    "norm": _dispatch_on_symbols(
        lambda a: Symbol(casadi.sqrt(sum(lift(v) ** 2 for v in np.ravel(a)))), np.linalg.norm
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
            return _keep_symbols(found)
        return _replace_object(found, {})


def _keep_symbols(function: Function) -> Function:
    """Return numpy's function (hstack, ...), whose arrays of symbols stay arrays of symbols."""

    @functools.wraps(function, updated=())
    def call(*args: Any, **kwargs: Any) -> Any:
        result = function(*args, **kwargs)
        return result.view(Symbols) if has_symbols(result) and np.ndim(result) else result

    return call


class _Instance:
    """A user's object seen by one of its traced methods: its other methods are traced as well."""

    def __init__(self, instance: Any) -> None:
        object.__setattr__(self, "_instance", instance)

    def __getattr__(self, name: str) -> Any:
        return _replace_object(getattr(self._instance, name), {})

    def __setattr__(self, name: str, value: Any) -> None:
        raise TracingError(
            f"the method stores self.{name}; a plant must not remember anything between calls: "
            "make it a state"
        )


def _identity(value: Any = 0.0) -> Any:
    return value


def _build_numpy_table() -> dict[str, Any]:
    table: dict[str, Any] = {
        name: _dispatch_on_symbols(elementwise(op), getattr(np, name))
        for name, op in ELEMENTWISE.items()
        if hasattr(np, name)
    }
    for make in (np.zeros, np.ones, np.empty, np.full, np.array, np.asarray, np.zeros_like,
                 np.ones_like, np.empty_like, np.full_like, np.asanyarray):  # fmt: skip
        table[str(getattr(make, "__name__"))] = _allow_symbols(make)  # noqa: B009
    for number in ("float64", "float32", "double"):
        table[number] = _dispatch_on_symbols(_identity, getattr(np, number))
    table["interp"] = _dispatch_on_symbols(
        lambda a, xp, fp: elementwise(lambda s: interp(s, xp, fp))(a), np.interp
    )
    table["linalg"] = _Module(np.linalg, LINALG)
    return table


_NUMPY = _Module(np, _build_numpy_table())
_MATH = _Module(
    math,
    {n: _dispatch_on_symbols(elementwise(op), getattr(math, n)) for n, op in ELEMENTWISE.items()
     if hasattr(math, n)},
)  # fmt: skip
_MODULES: dict[str, Any] = {"numpy": _NUMPY, "math": _MATH}
_BY_IDENTITY = {
    id(getattr(module._module, name)): new
    for module in (_NUMPY, _MATH, _NUMPY._table["linalg"])
    for name, new in module._table.items()
}


def _import(name: str, *args: Any, **kwargs: Any) -> Any:
    return _replace_object(builtins.__import__(name, *args, **kwargs), {})


_BUILTINS = {
    **vars(builtins),
    "float": _dispatch_on_symbols(_identity, float),
    "max": _dispatch_on_symbols(
        lambda *a: functools.reduce(elementwise(casadi.fmax), a if len(a) > 1 else a[0]), max
    ),
    "min": _dispatch_on_symbols(
        lambda *a: functools.reduce(elementwise(casadi.fmin), a if len(a) > 1 else a[0]), min
    ),
    "__import__": _import,
}


def _replace_object(obj: Any, memo: dict[int, Any]) -> Any:
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
    # A function compiled by numba keeps its Python function in this attribute.
    if hasattr(obj, "py_func"):
        return rebind(obj.py_func, memo)
    return obj


def _collect_names(code: types.CodeType) -> set[str]:
    nested = (c for c in code.co_consts if isinstance(c, types.CodeType))
    return set(code.co_names).union(*(_collect_names(c) for c in nested))


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
    library = (function.__module__ or "").partition(".")[0]
    # Of python-control, functions made for one system (an estimator, a state feedback) are traced.
    if library == "numpy" or (library == "control" and "<locals>" not in function.__qualname__):
        return function
    scope: dict[str, Any] = {**function.__globals__, "__builtins__": _BUILTINS}
    cells = [types.CellType() for _ in function.__closure__ or ()]
    copy = types.FunctionType(
        function.__code__, scope, function.__name__, function.__defaults__, tuple(cells)
    )
    copy.__kwdefaults__ = function.__kwdefaults__
    memo[id(function)] = copy
    for name in _collect_names(function.__code__) & function.__globals__.keys():
        scope[name] = _replace_object(function.__globals__[name], memo)
    for new, old in zip(cells, function.__closure__ or (), strict=True):
        new.cell_contents = _replace_object(old.cell_contents, memo)
    if function.__defaults__:
        copy.__defaults__ = tuple(_replace_object(v, memo) for v in function.__defaults__)
    return copy
