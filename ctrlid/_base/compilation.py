"""Functions that numba compiles when they are first called, not when they are imported."""

import functools
from collections.abc import Callable
from typing import Any


class Compiled:
    """A function that is compiled at its first call, or where another compiled one calls it.

    The compiler itself is imported then as well: who only fits a linear model need not wait for it.

    Parameters
    ----------
    function : callable
        The function in Python.
    options : dict
        Options of ``numba.njit``.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        functools.update_wrapper(self, function)
        self.options = options

    @functools.cached_property
    def dispatcher(self) -> Any:
        """What numba makes of the function."""
        import numba

        function = self.__wrapped__  # type: ignore[attr-defined]
        try:
            return numba.njit(cache=True, **self.options)(function)
        except RuntimeError:
            # There is no folder to write machine code to, so that each session compiles anew.
            return numba.njit(**self.options)(function)

    @property
    def _numba_type_(self) -> Any:
        """The type that numba sees where a compiled function calls this one."""
        return self.dispatcher._numba_type_

    def __call__(self, *args: Any) -> Any:
        return self.dispatcher(*args)


def compile_loop(**options: Any) -> Callable[[Callable[..., Any]], Compiled]:
    """Decorate a function that numba compiles when it is first called.

    Parameters
    ----------
    **options
        Options of ``numba.njit``, such as ``nogil``. The machine code is kept in a file.

    Returns
    -------
    callable
        The decorator.

    Examples
    --------
    >>> @compile_loop()
    ... def half(x):
    ...     return x / 2
    >>> half(3.0)
    1.5
    """
    return lambda function: Compiled(function, options)
