"""Arrays of real and of complex numbers: what annotations call them, and how values keep them."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .errors import CtrlidError

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Owner = TypeVar("Owner")
Result = TypeVar("Result")


def to_real_array(values: Any, what: str) -> Array:
    """Return values as an array of floats, or refuse what would lose a part on the way.

    Parameters
    ----------
    values : array_like
        Real numbers in any shape.
    what : str
        What they are, as the beginning of a sentence.

    Returns
    -------
    ndarray
        A new array.

    Raises
    ------
    CtrlidError
        If they are masked, complex, texts or rows of different lengths.

    Examples
    --------
    >>> to_real_array([1, 2.5], "levels")
    array([1. , 2.5])
    """
    if np.ma.is_masked(values):
        raise CtrlidError(f"{what} must be plain numbers; given a masked array, whose masked "
                          "values would come back: fill them first")  # fmt: skip
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "fiub":
            raise CtrlidError(f"{what} must be real numbers; given {array.dtype} data")
    except (ValueError, OSError) as reason:
        if isinstance(reason, CtrlidError):
            raise
        raise CtrlidError(f"{what} must be an array of numbers; {reason}") from reason
    return np.array(array, dtype=float)


def read_only(compute: Callable[[Owner], Result]) -> Callable[[Owner], Result]:
    """Return a property's function whose array is read-only, as those are that a result keeps.

    What is computed anew at each access would take a value and lose it.

    Examples
    --------
    >>> class Twice:
    ...     @property
    ...     @read_only
    ...     def both(self):
    ...         return np.ones(2)
    >>> Twice().both.flags.writeable
    False
    """

    @functools.wraps(compute)
    def handled(owner: Owner) -> Result:
        array = compute(owner)
        if isinstance(array, np.ndarray):
            array.setflags(write=False)
        return array

    return handled


def freeze_arrays(value: Any) -> None:
    """Make every array of a result read-only, those in its tuples too.

    A result is a value: what was computed is not changed by whoever looks at it. Arrays that
    others may hold are copied first.
    """
    for name in value.__dataclass_fields__:
        array = getattr(value, name)
        if isinstance(array, np.ndarray) and array.flags.writeable:
            array = array.copy()
            array.setflags(write=False)
            object.__setattr__(value, name, array)
