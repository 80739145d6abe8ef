"""The check at the door: what a public function is given is of the kind that it declares."""

import functools
import inspect
import itertools
import os
import re
import sys
import types
import typing
from abc import ABCMeta
from collections.abc import Callable, Iterable, Mapping, Sequence
from numbers import Complex, Integral
from pathlib import Path
from typing import Any, Literal, ParamSpec, TypeVar, get_args, get_origin

import numpy as np

from .errors import CtrlidError
from .text import find_near_name, write_count, write_list

Given = ParamSpec("Given")
Answer = TypeVar("Answer")
Made = TypeVar("Made")

# A unit in a docstring stands behind a blank; [1] is a number without one, and [1]_ a citation.
UNIT = re.compile(r"(?<=\s)\[([^\]\d`][^\]`]*)\]")
# The largest whole number of a machine word.
LARGEST = 2**63 - 1
NUMBERS = {
    float: "a number", int: "a whole number", complex: "a real or complex number",
    bool: "True or False", str: "a text", Path: "the path of a file", type(None): "None",
}  # fmt: skip


def check_arguments(function: Callable[..., Any], given: Mapping[str, Any], *own: str) -> None:
    """Refuse arguments that are not of the kind that a function's annotations declare.

    It stands in the first line of a public function. What goes beyond the kind, such as bounds and
    shapes, is checked where it matters.

    Parameters
    ----------
    function : function
        The function itself.
    given : mapping
        Its arguments by name, ``locals()``.
    *own : str
        Parameters with a check of their own, whose words say more.

    Raises
    ------
    CtrlidError
        At the first argument of another kind.

    Examples
    --------
    >>> def keep(samples: int, name: str = "") -> None:
    ...     check_arguments(keep, locals())
    >>> keep(3)
    >>> keep(True)
    Traceback (most recent call last):
    ...
    ctrlid._base.errors.CtrlidError: keep needs a whole number as samples; given True (bool)
    """
    function = getattr(function, "__func__", function)
    for name, kind in _find_kinds(function).items():
        if name not in own:
            _check_kind(function.__name__, name, given[name], kind, function.__doc__)


def explain_names(function: Callable[Given, Answer]) -> Callable[Given, Answer]:
    """Refuse a call of a public function with unknown or missing arguments in words.

    Python's own TypeError names one wrong argument and none that there are.

    Examples
    --------
    >>> @explain_names
    ... def keep(samples, *, name=""):
    ...     return samples
    >>> keep(samples=3)
    3
    >>> keep(3, names="x")
    Traceback (most recent call last):
    ...
    ctrlid._base.errors.CtrlidError: keep has no names=; did you mean name=?
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def handled(*args: Given.args, **kwargs: Given.kwargs) -> Answer:
        _check_call(function, signature, args, kwargs)
        return function(*args, **kwargs)

    return handled


def _check_call(
    function: Any, signature: inspect.Signature, args: tuple[Any, ...], given: Mapping[str, Any]
) -> None:
    """Refuse in words the arguments of a call that the signature does not take."""
    try:
        signature.bind(*args, **given)
    except TypeError:
        raise CtrlidError(_describe_call(function, signature, args, given)) from None


def _describe_call(
    function: Any, signature: inspect.Signature, args: tuple[Any, ...], given: Mapping[str, Any]
) -> str:
    """Say what is wrong with the arguments of a call that the signature does not take."""
    who, parameters = function.__name__, signature.parameters
    fixed = [p for p in parameters.values() if p.kind is p.POSITIONAL_OR_KEYWORD]
    for name in given:
        if name not in parameters:
            return _refuse_name(who, name, tuple(parameters))
    if len(args) > len(fixed):
        named = [f"{name}=" for name in list(parameters)[len(fixed) :]]
        rest = f", and {', '.join(named)} by name" if named else ""
        return (f"{who} takes {', '.join(p.name for p in fixed)} without names{rest}; given "
                f"{write_count(len(args), 'value')} without a name")  # fmt: skip
    twice = [p.name for p in fixed[: len(args)] if p.name in given]
    if twice:
        return f"{who} is given {twice[0]} twice, without its name and as {twice[0]}="
    seen = {*given, *(p.name for p in fixed[: len(args)])}
    missing = [p.name for p in parameters.values() if p.default is p.empty and p.name not in seen]
    return f"{who} needs {write_list([f'{name}=' for name in missing])}; it takes " + ", ".join(
        parameters
    )


def _refuse_name(who: str, name: str, known: Sequence[str]) -> str:
    """Say that there is no such argument, with a near name or all of them."""
    # A word of a name may be one of several names.
    near = [one for one in known if name in one.split("_")] or [find_near_name(name, known) or ""]
    meant = " or ".join(f"{one}=" for one in near if one)
    hint = f"did you mean {meant}?" if meant else f"it takes {', '.join(known)}"
    return f"{who} has no {name}=; {hint}"


def is_number(value: Any) -> bool:
    """Tell whether a value is one real number that a float can hold, and no truth value."""
    return not isinstance(value, np.ndarray) and _is_float(value)


def point_at_part(value: Any, kind: type) -> str:
    """Say which part of a result is of the kind that is needed, such as the loop of a fit.

    Parameters
    ----------
    value : object
        What was given.
    kind : type
        What is needed.

    Returns
    -------
    str
        A sentence with a full stop before it; empty if the result has no such part.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> point_at_part(SimpleNamespace(dict={"a": 1}), dict)
    '. Give its .dict'
    """
    name = kind.__name__.lower()
    return f". Give its .{name}" if isinstance(getattr(value, name, None), kind) else ""


def shorten_value(value: Any) -> str:
    """Write a value that was given, in one line of a message and without most of a long array.

    Parameters
    ----------
    value : object
        The value.

    Returns
    -------
    str
        Its representation, in 60 signs at most.

    Examples
    --------
    >>> shorten_value("ab"), len(shorten_value(list(range(1000))))
    ("'ab'", 60)
    """
    shown = " ".join(repr(value).split())
    return shown if len(shown) <= 60 else shown[:57] + "..."


def is_iterable(value: Any) -> bool:
    """Tell whether a value can be walked through; an array without dimensions only looks so."""
    return value.ndim > 0 if isinstance(value, np.ndarray) else isinstance(value, Iterable)


def check_fields(value: Any, *own: str) -> None:
    """Refuse fields of a dataclass that are not of the kind that it declares.

    Parameters
    ----------
    value : dataclass
        The value that is being made.
    *own : str
        Fields with a check of their own, whose words say more.

    Raises
    ------
    CtrlidError
        At the first field of another kind.
    """
    cls: Any = type(value)
    for name, kind in _find_field_kinds(cls).items():
        if name not in own:
            _check_kind(type(value).__name__, name, getattr(value, name), kind, type(value).__doc__)


def explain_fields(cls: type[Made]) -> type[Made]:
    """Refuse unknown, missing and surplus fields of a dataclass in words, as `explain_names` does.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @explain_fields
    ... @dataclass
    ... class Spring:
    ...     stiffness: float
    >>> Spring()
    Traceback (most recent call last):
    ...
    ctrlid._base.errors.CtrlidError: Spring needs stiffness=; it takes stiffness
    """
    made, signature = cls.__init__, ShownFields().__get__(None, cls)

    @functools.wraps(made)
    def init(self: Any, *args: Any, **fields: Any) -> None:
        _check_call(cls, signature, args, fields)
        made(self, *args, **fields)

    cls.__init__ = init  # type: ignore[method-assign]
    # A class with a ``__new__`` of its own would show the arguments of that.
    cls.__signature__ = signature  # type: ignore[attr-defined]
    return cls


class CheckedCalls(ABCMeta):
    """Classes whose subclasses are dataclasses, and refuse the fields of a call in words.

    A single dataclass has `explain_fields`. Copies are made without a call, and are not checked.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> class Part(metaclass=CheckedCalls):
    ...     pass
    >>> @dataclass
    ... class Spring(Part):
    ...     stiffness: float
    >>> Spring()
    Traceback (most recent call last):
    ...
    ctrlid._base.errors.CtrlidError: Spring needs stiffness=; it takes stiffness
    """

    def __call__(cls, *args: Any, **fields: Any) -> Any:
        """Check the call, and make the object."""
        if "__dataclass_fields__" in vars(cls):
            _check_call(cls, _find_signature(cls), args, fields)
        return super().__call__(*args, **fields)


@functools.cache
def _find_signature(cls: Any) -> inspect.Signature:
    return ShownFields().__get__(None, cls)


class ShownFields:
    """The signature of each subclass of a dataclass: its own fields, for help to show."""

    def __get__(self, instance: Any, cls: Any) -> inspect.Signature:
        own = inspect.signature(cls.__init__)
        return own.replace(parameters=list(own.parameters.values())[1:])


def _check_kind(who: str, name: str, value: Any, kind: Any, about: str | None) -> None:
    if not _is_kind(value, kind):
        part = point_at_part(value, kind) if isinstance(kind, type) else ""
        unit = find_unit(about, name)
        raise CtrlidError(
            f"{who} needs {_describe_kind(kind)} as {name}{unit and f' [{unit}]'}; given "
            f"{shorten_value(value)} ({type(value).__name__}){part}"
        )


def find_unit(about: str | None, name: str) -> str:
    r"""Return the unit of a parameter, as its docstring says it in square brackets.

    Parameters
    ----------
    about : str or None
        A docstring in the form of numpydoc.
    name : str
        The parameter.

    Returns
    -------
    str
        The unit; empty where none is said.

    Examples
    --------
    >>> find_unit(find_unit.__doc__, "name"), find_unit(None, "name")
    ('', '')
    >>> find_unit("Wait.\n\nlate, early : float\n    How long [s].", "early")
    's'
    """
    if about is None:
        return ""
    lines = inspect.cleandoc(about).splitlines()
    heads = [k for k, line in enumerate(lines) if name in line.partition(" : ")[0].split(", ")
             and " : " in line]  # fmt: skip
    for k in heads:
        words = itertools.takewhile(lambda line: line.startswith(" "), lines[k + 1 :])
        found = UNIT.search(" " + " ".join(map(str.strip, words)))
        if found is not None:
            return found[1]
    return ""


@functools.cache
def _find_kinds(function: Any) -> dict[str, Any]:
    parameters = inspect.signature(function).parameters.values()
    return {
        p.name: types.GenericAlias(tuple, (kind, ...)) if p.kind is p.VAR_POSITIONAL else kind
        for p in parameters
        if p.kind is not p.VAR_KEYWORD
        and (kind := _resolve(p.annotation, sys.modules[function.__module__])) is not Any
    }


@functools.cache
def _find_field_kinds(cls: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, field in cls.__dataclass_fields__.items():
        home = next(c for c in cls.__mro__ if name in inspect.get_annotations(c))
        kind = _resolve(field.type, sys.modules[home.__module__])
        if field.init and kind is not Any and get_origin(kind) is not typing.ClassVar:
            found[name] = kind
    return found


def _resolve(annotation: Any, module: Any) -> Any:
    """Return what an annotation means; Any for what only a type checker can see."""
    if annotation is inspect.Parameter.empty:
        return Any
    probe = types.SimpleNamespace(__annotations__={"x": annotation}, __globals__=vars(module))
    try:
        return typing.get_type_hints(probe)["x"]
    except NameError:
        return Any


def _is_kind(value: Any, kind: Any) -> bool:
    """Tell whether a value is of a kind; a number may be numpy's, a sequence an array."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Any or isinstance(kind, TypeVar | str | typing.ForwardRef):
        return True
    if origin in (typing.Union, types.UnionType):
        return any(_is_kind(value, part) for part in parts)
    if origin is Literal:
        return isinstance(value, str) and value in parts
    if origin is typing.Annotated:
        return _is_kind(value, parts[0])
    if kind is float:
        return _is_float(value)
    if kind in (int, complex, bool, str, Path):
        return _is_plain(value, kind)
    if origin is type:
        return isinstance(value, type) and _is_class(value, parts)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return isinstance(value, Mapping) and all(
            _is_kind(k, parts[0]) and _is_kind(v, parts[1]) for k, v in value.items()
        )
    if isinstance(origin, type) and issubclass(origin, np.ndarray):
        return isinstance(value, np.ndarray)
    if isinstance(origin, type) and issubclass(origin, tuple):
        return _is_row(value, parts)
    if isinstance(origin, type) and issubclass(origin, Iterable):
        return _is_row(value, (parts[0] if parts else Any, ...), origin is Iterable)
    if origin is not None or kind is Callable:
        return callable(value)
    return isinstance(value, kind) if isinstance(kind, type) else True


def _is_float(value: Any) -> bool:
    """Tell whether a value is one real number, no truth value and no span of time.

    numpy counts its spans of time as whole numbers, of a unit that a float would lose. Whole
    numbers that no machine word holds, and fractions, are objects to numpy, which few of its
    functions take.
    """
    if isinstance(value, np.ndarray) and value.ndim == 0 and value.dtype.kind in "fiu":
        value = value[()]
    if isinstance(value, bool | np.bool_ | np.timedelta64):
        return False
    if isinstance(value, int):
        return -LARGEST <= value <= LARGEST
    return isinstance(value, float | np.floating | np.integer)


def _is_plain(value: Any, kind: type) -> bool:
    if kind is bool:
        return isinstance(value, bool | np.bool_)
    if kind is Path:
        return isinstance(value, os.PathLike)
    if kind is str:
        return isinstance(value, str)
    numbers = {int: Integral, complex: Complex}
    return isinstance(value, numbers[kind]) and not isinstance(value, bool | np.bool_)


def _is_class(value: type, parts: tuple[Any, ...]) -> bool:
    wanted = get_origin(parts[0]) or parts[0] if parts else object
    return not isinstance(wanted, type) or issubclass(value, wanted)


def _is_row(value: Any, parts: tuple[Any, ...], once: bool = False) -> bool:
    """Tell whether a value is a row of values of given kinds, of any length where one is `...`.

    What can be walked through only once is taken as it is, where that is allowed.
    """
    if isinstance(value, str):
        # A single name stands for a row of one, where names are asked for.
        return str in parts
    if isinstance(value, bytes | Mapping | type) or not hasattr(type(value), "__iter__"):
        return False
    if isinstance(value, np.ndarray) and (value.ndim == 0 or value.dtype.kind in "fiu"):
        return value.ndim == 1 and (
            _is_kind(value.dtype.type(0), parts[0])
            and ((len(parts) == 2 and parts[1] is Ellipsis) or len(value) == len(parts))
        )  # fmt: skip
    if not hasattr(type(value), "__len__"):
        return once
    if len(parts) == 2 and parts[1] is Ellipsis:
        return all(_is_kind(v, parts[0]) for v in value)
    return len(value) == len(parts) and all(map(_is_kind, value, parts))


def _describe_kind(kind: Any) -> str:
    """Return a kind in words."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind in NUMBERS:
        return NUMBERS[kind]
    if origin in (typing.Union, types.UnionType):
        words = list(dict.fromkeys(map(_describe_kind, sorted(parts, key=_is_none))))
        if len(words) > 1 and {str, Path} <= set(parts):
            words.remove(NUMBERS[str])
        return " or ".join(words)
    if origin is Literal:
        return "one of " + ", ".join(map(repr, parts))
    if origin is type:
        return f"a subclass of {getattr(parts[0], '__name__', parts[0])}"
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return f"a mapping of {_describe_kind(parts[0])} to {_describe_kind(parts[1])}"
    if isinstance(origin, type) and issubclass(origin, np.ndarray):
        return "an array"
    if isinstance(origin, type) and issubclass(origin, Iterable):
        if origin is tuple and parts[-1] is not Ellipsis:
            return "(" + ", ".join(map(_describe_kind, parts)) + ")"
        one = _describe_kind(parts[0])
        return "a sequence, each of it " + one
    if origin is not None or kind is Callable:
        return "a function"
    name: str = getattr(kind, "__name__", str(kind))
    return f"{'an' if name[:1] in 'AEIOU' else 'a'} {name}"


def _is_none(kind: Any) -> bool:
    return kind is type(None)
