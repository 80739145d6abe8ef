"""Loops compiled by numba, with or without a folder to keep them in."""

from collections.abc import Callable
from typing import Any

import numba


def compile_loop(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return numba's decorator; what it compiles is kept on disk where that is possible.

    Parameters
    ----------
    **options
        As ``numba.njit`` takes them.
    """

    def compile_once(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **options)(function)
        # Numba refuses where neither the package nor the home may be written to: then every
        # process compiles anew, which takes its time and is no reason to fail.
        except RuntimeError:
            return numba.njit(**options)(function)

    return compile_once
