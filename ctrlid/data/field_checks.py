"""Checks of the fields of a record: samples, words and seconds."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from .._base.arguments import is_number
from .._base.errors import CtrlidError
from .._base.text import write_list


def check_samples(name: str, values: Any) -> Any:
    """Copy a signal to a read-only (n,) float array, or say what is wrong with it."""
    if np.ma.is_masked(values):
        raise CtrlidError(
            f"{name} is a masked array, and a record would use its masked values: fill them and "
            "give valid=~mask"
        )
    try:
        array = np.asarray(values)
    except ValueError as reason:
        raise CtrlidError(f"{name} must be one array of numbers: {reason}") from reason
    if array.dtype.kind not in "fiub":
        raise CtrlidError(f"{name} must be an array of real numbers; given {array.dtype} data")
    if array.ndim != 1:
        cure = "Pick one channel, as in data[:, 0]" if array.ndim else "Repeat it with np.full"
        raise CtrlidError(
            f"{name} must be one-dimensional with one value per sample; given shape "
            f"{array.shape}. {cure}"
        )
    array = np.array(array, dtype=float)
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise CtrlidError(
            f"{name} must be finite; {bad.size} of {array.size} values are NaN or infinite, the "
            f"first at sample {bad[0]}. Cut them out by slicing, or fill them and exclude the "
            "samples with valid="
        )
    array.setflags(write=False)
    return array


def check_words(what: str, given: Any, known: Sequence[str]) -> Mapping[str, str]:
    """Copy names or units to a read-only mapping of known signals to words."""
    if not isinstance(given, Mapping) or not all(isinstance(v, str) for v in given.values()):
        raise CtrlidError(f"{what} maps signals to words, as in {{'y': 'm'}}; given {given!r}")
    unknown = [k for k in given if k not in known]
    if unknown:
        raise CtrlidError(
            f"{what} has {write_list([repr(k) for k in unknown])}, which the record does not have; "
            f"its signals are {', '.join(known)}"
        )
    return MappingProxyType(dict(given))


def check_seconds(what: str, value: Any) -> float:
    """Return a time as float, or say what it is and that it must be a finite number."""
    if not is_number(value) or not np.isfinite(float(value)):
        raise CtrlidError(f"{what} in seconds, a finite number; given {value!r}")
    return float(value)
