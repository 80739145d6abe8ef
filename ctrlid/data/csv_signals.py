"""Which signals of a file a word stands for, and what is said of them: scales, units, names."""

import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .._base.arguments import is_number
from .._base.errors import CtrlidError, CtrlidWarning
from .._base.units import find_shift, is_same_unit, write_shift
from .field_checks import check_words

# A channel, or a further column, and the number of a signal in it.
Signal = tuple[str, int]


def list_names(
    every: Mapping[str, Sequence[int]], names: Sequence[str], header: Sequence[str],
    called: Any,
) -> dict[str, list[Signal]]:  # fmt: skip
    """Return which signals a word stands for: a channel, a column, or a signal of a stored record.

    A channel stands for all of its signals, and what r and y are both called for both.
    """
    found: dict[str, list[Signal]] = {}
    for key, columns in every.items():
        # A comment that was changed by hand may hold anything; the record refuses what is no name.
        own = called.get(key, ()) if isinstance(called, Mapping) else ()
        own = [own] if isinstance(own, str) else own if isinstance(own, list) else []
        for i, k in enumerate(columns):
            words = (names[k], header[k], *(own[i : i + 1] if len(own) == len(columns) else []))
            for word in dict.fromkeys(words):
                found.setdefault(word, []).append((key, i))
    return {**found, **{key: [(key, i) for i in range(len(ks))] for key, ks in every.items()}}


def _find_signals(
    what: str, given: Mapping[str, Any], spoken: Mapping[str, list[Signal]],
    every: Mapping[str, Sequence[int]],
) -> dict[str, list[Signal]]:  # fmt: skip
    """Return the signals that each given name stands for, or refuse one unknown or named twice."""
    found: dict[str, list[Signal]] = {}
    by: dict[Signal, str] = {}
    for name in given:
        if name not in spoken:
            single = [word for word in spoken if word not in every]
            also = f", and of single signals {', '.join(single)}" if single else ""
            raise CtrlidError(
                f"{what}= names {name!r}, but the channels are {', '.join(every)}{also}"
            )
        for signal in spoken[name]:
            if signal in by:
                raise CtrlidError(
                    f"{what}= names a signal of {signal[0]} twice, as {by[signal]!r} and as "
                    f"{name!r}. Leave out one of them"
                )
            by[signal] = name
        found[name] = spoken[name]
    return found


def check_scale(
    scale: Mapping[str, float], spoken: Mapping[str, list[Signal]],
    every: Mapping[str, Sequence[int]],
) -> dict[Signal, float]:  # fmt: skip
    """Return the factors of signals, or refuse what is none."""
    found: dict[Signal, float] = {}
    for name, signals in _find_signals("scale", scale, spoken, every).items():
        factor = scale[name]
        if not is_number(factor) or not math.isfinite(factor) or factor == 0:
            single = [word for word, own in spoken.items() if len(own) == 1 and own[0] in signals]
            each = f". Each signal is scaled by its own name, as {' or '.join(single[:2])}"
            raise CtrlidError(f"scale= needs a number other than zero for {name}; given {factor!r}"
                              f"{each if len(signals) > 1 else ''}")  # fmt: skip
        found |= dict.fromkeys(signals, float(factor))
    return found


def spread_words(
    what: str, given: Mapping[str, Any], spoken: Mapping[str, list[Signal]],
    every: Mapping[str, Sequence[int]],
) -> dict[Signal, str]:  # fmt: skip
    """Return the stated units or names of signals; one unit stands for all signals of a name."""
    found: dict[Signal, str] = {}
    for name, signals in _find_signals(what, given, spoken, every).items():
        words = check_words(what, {name: given[name]}, (name,), {name: len(signals)})[name]
        found |= dict(zip(signals, (words,) if isinstance(words, str) else words, strict=True))
    return found


def rename_signals(
    called: Any, known: Mapping[str, Sequence[str]], renamed: Mapping[Signal, str]
) -> dict[str, Any]:
    """Return the names of all signals, some of them renamed."""
    found = dict(called) if isinstance(called, Mapping) else {}
    for key in {key for key, _ in renamed}:
        own = found.get(key)
        own = [own] if isinstance(own, str) else own
        own = own if isinstance(own, list) and len(own) == len(known[key]) else known[key]
        found[key] = [renamed.get((key, i), word) for i, word in enumerate(own)]
    return found


def question_units(
    stated: Mapping[Signal, str], written: Mapping[Signal, tuple[str, str]],
    factors: Mapping[Signal, float], every: Mapping[str, Sequence[int]], path: Path,
) -> None:  # fmt: skip
    """Warn of signals that are said to be in another unit than in the header, and not scaled."""
    for signal, here in stated.items():
        key, (column, there) = signal[0], written[signal]
        if signal in factors or not (there and here) or is_same_unit(there, here):
            continue
        name = key if len(every[key]) == 1 else column
        shift = find_shift(there, here)
        how = f"give scale={{{name!r}: factor}} as well"
        if shift is not None:
            how = (f"compute {write_shift(name, *shift)} in the file and write {here} into its "
                   "header, as their zeros differ and no scale= does it")  # fmt: skip
        warnings.warn(
            f"{name} is in {there} by the header of {path}, and in {here} by units=, which "
            f"is taken; the numbers stay as they are. To convert them, {how}; where the header is "
            "wrong, mend it",
            CtrlidWarning, stacklevel=4,
        )  # fmt: skip
