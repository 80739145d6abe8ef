"""Checks of the fields of a record: samples, words and seconds."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from .._base.arguments import is_number
from .._base.errors import CtrlidError
from .._base.text import write_count, write_list


def check_samples(name: str, values: Any, several: bool = False) -> Any:
    """Copy a signal to a read-only (n,) float array, or say what is wrong with it.

    With `several` also signals of shape (signals, n); a single one among them becomes (n,).
    """
    if np.ma.is_masked(values):
        raise CtrlidError(
            f"{name} is a masked array, and a record would use its masked values: fill them and "
            "give valid=~mask"
        )
    if isinstance(values, Mapping):
        words = tuple(map(str, values))
        raise CtrlidError(
            f"{name} is an array, given a mapping of {write_list(words) or 'nothing'}: give the "
            "series alone, several one in a row, and what they are called in names="
            f"{{{name!r}: {(words[0] if len(words) == 1 else words)!r}}}"
        )
    try:
        array = np.asarray(values)
    except ValueError as reason:
        raise CtrlidError(f"{name} must be one array of numbers: {reason}") from reason
    if array.dtype.kind not in "fiub":
        raise CtrlidError(
            f"{name} must be an array of real numbers; given {array.dtype} data. Make numbers of "
            "them, for instance by pandas.to_numeric(column, errors='coerce'), and mark what is "
            "missing by valid="
        )
    if several and array.ndim == 2:
        if not 0 < array.shape[0] <= array.shape[1]:
            raise CtrlidError(
                f"{name} has shape {array.shape}: several signals have the shape (signals, "
                f"samples), as in python-control. Give {name}.T, or pick one channel, as in "
                "data[:, 0]"
            )
        array = array[0] if len(array) == 1 else array
    if array.ndim != (2 if several and array.ndim == 2 else 1):
        cure = "Pick one channel, as in data[:, 0]" if array.ndim else "Repeat it with np.full"
        raise CtrlidError(
            f"{name} must be one-dimensional with one value per sample; given shape "
            f"{array.shape}. {cure}"
        )
    array = np.array(array, dtype=float)
    bad = np.flatnonzero(~np.atleast_2d(np.isfinite(array)).all(axis=0))
    if bad.size:
        raise CtrlidError(
            f"{name} must be finite; {bad.size} of {array.shape[-1]} values are NaN or infinite, "
            f"the first at sample {bad[0]}. Cut them out by slicing, or fill them and exclude the "
            "samples with valid="
        )
    array.setflags(write=False)
    return array


def check_words(
    what: str, given: Any, known: Sequence[str], counts: Mapping[str, int] | None = None
) -> Mapping[str, Any]:
    """Copy names or units to a read-only mapping of known signals to words.

    Where `counts` says that there are several of a signal, the words are a tuple of as many; one
    unit stands for all of them.
    """
    counts = counts or {}

    def check(key: Any, words: Any) -> Any:
        count = counts.get(key, 1)
        if isinstance(words, str):
            return words if count == 1 else (words,) * count
        if not isinstance(words, list | tuple) or not all(isinstance(w, str) for w in words):
            raise CtrlidError(f"{what} maps signals to words, as in {{'y': 'm'}}; given {given!r}")
        if len(words) != count:
            raise CtrlidError(f"{what} has {len(words)} words for {key}, which has "
                              f"{write_count(count, 'signal')}; given {given!r}")  # fmt: skip
        return words[0] if count == 1 else tuple(words)

    if not isinstance(given, Mapping):
        raise CtrlidError(f"{what} maps signals to words, as in {{'y': 'm'}}; given {given!r}")
    found = {key: check(key, words) for key, words in given.items()}
    if what == "names":
        for key, words in found.items():
            if len(set(words)) < counts.get(key, 1) and counts.get(key, 1) > 1:
                raise CtrlidError(
                    f"names needs a name of its own for each signal of {key}, as in "
                    f"{{{key!r}: ('first', 'second')}}; given {given[key]!r}"
                )
    unknown = [k for k in given if k not in known]
    if unknown:
        raise CtrlidError(
            f"{what} has {write_list([repr(k) for k in unknown])}, which the record does not have; "
            f"its signals are {', '.join(known)}"
        )
    return MappingProxyType(found)


def check_seconds(what: str, value: Any) -> float:
    """Return a time as float, or say what it is and that it must be a finite number."""
    if not is_number(value) or not np.isfinite(float(value)):
        raise CtrlidError(f"{what} in seconds, a finite number; given {value!r}")
    return float(value)
