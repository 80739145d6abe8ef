"""Whether a record has the units of the plant, whose equations take its numbers as they are."""

import math
from dataclasses import dataclass

import numpy as np

from .._base.errors import CtrlidError
from .._base.units import find_factor, find_shift, is_same_unit, write_shift
from ..data.record import Record
from .loop import Loop

# A record that is so many times as far out as its operating point is in another unit.
ELSEWHERE = 100.0


def list_recorded_units(loop: Loop, record: Record) -> list[tuple[str, str, str]]:
    """Return which of u and y each input and output is, its name in the loop, and its unit.

    Parameters
    ----------
    loop : Loop
        The loop.
    record : Record
        A record with the signals of the loop, in its order.

    Returns
    -------
    list of (str, str, str)
        Key, name, and the unit in the record, which is empty where it has none.
    """
    e = loop.equations()
    found = []
    for key, names in (("u", e.inputs), ("y", e.outputs)):
        given = record.units.get(key, "")
        each = given if isinstance(given, tuple) else (given,) * len(names)
        found += [(key, name, unit) for name, unit in zip(names, each, strict=True)]
    if e.siso and record.r is not None:
        found.append(("r", e.outputs[0], record.units.get("r", "")))
    return found


@dataclass(frozen=True)
class UnitClash:
    """A signal whose unit in a record is another one than in the loop.

    Parameters
    ----------
    signal : str
        What it is called.
    text : str
        A sentence that says what to do.
    factor : float or None
        What converts the record's numbers; None where the two are not known to be units of one
        quantity, or where their zeros differ.
    zeros_differ : bool
        Whether they are scales with different zeros, such as K and °C.
    """

    signal: str
    text: str
    factor: float | None
    zeros_differ: bool = False


def find_unit_clashes(loop: Loop, record: Record) -> list[UnitClash]:
    """Return the signals whose unit in a record is another one than in the loop, and what to do.

    Parameters
    ----------
    loop : Loop
        The loop.
    record : Record
        A record with the signals of the loop, in its order.

    Returns
    -------
    list of UnitClash
        The clashes; other spellings of the same unit are the same unit.
    """
    known, several = loop.known_units, not loop.equations().siso
    found = []
    for key, name, there in list_recorded_units(loop, record):
        here, signal = known.get(name, ""), name if several else key
        # A channel stands for all of its signals: of several, one is scaled by its name.
        many = several and key != "r" and len(record.signals[key]) > 1
        spoken = record.signals[key][loop.signals[key].index(name)] if many else key
        if not (here and there) or is_same_unit(here, there):
            continue
        factor = find_factor(there, here)
        scale = "factor" if factor is None else f"{factor:.6g}"
        how = "without a unit" if there == "1" else f"in {there}"
        text = (
            f"{signal} is recorded {how}, but the plant has it in {here}. The model takes the "
            "numbers as they are. If the plant is right, convert the record: "
            f"Record.from_csv(..., scale={{{spoken!r}: {scale}}}, units={{{spoken!r}: {here!r}}}). "
            f"If the record is right, say so: Loop(..., units={{{name!r}: {there!r}}})."
        )
        shift = find_shift(there, here)
        if shift is not None:
            text = (
                f"{signal} is recorded in {there}, but the plant has it in {here}, whose zero is "
                "another one, so that no scale= converts it. The model takes the numbers as they "
                f"are. Either compute {write_shift(spoken, *shift)} in the file, before the record "
                f"is read, and write {here} into its header. Or write the plant, its operating "
                f"point and the limits and bias of the controller in {there}, and say so: "
                f"Loop(..., units={{{name!r}: {there!r}}})."
            )
        found.append(UnitClash(signal, text, factor, shift is not None))
    return found


def note_unit_clashes(loop: Loop, record: Record) -> tuple[str, ...]:
    """Return the notes of a result whose record has other units than the loop.

    Parameters
    ----------
    loop : Loop
        The loop.
    record : Record
        A record with the signals of the loop, in its order.

    Returns
    -------
    tuple of str
        Sentences that begin in capitals; none where the units agree or are not known.
    """
    return tuple(f"UNITS DO NOT AGREE: {one.text}" for one in find_unit_clashes(loop, record))


def refuse_unit_clashes(loop: Loop, record: Record) -> None:
    """Refuse a record whose numbers are by a known factor or shift other ones than the loop's.

    Of two quantities, such as a duty cycle and the voltage that it switches, the one may be counted
    as the other.

    Raises
    ------
    CtrlidError
        If they are: whatever is found with numbers of another size has no meaning.
    """
    texts = [one.text for one in find_unit_clashes(loop, record)
             if one.factor is not None or one.zeros_differ]  # fmt: skip
    if texts:
        raise CtrlidError(f"the units do not agree: {' '.join(texts)}")


def measure_distance(loop: Loop, record: Record) -> float:
    """Return how many times the output of the operating point a whole record is; 0 if it is near.

    Of a loop with one output, which does not rest at zero.

    Parameters
    ----------
    loop : Loop
        The loop.
    record : Record
        A record with valid samples.
    """
    if not loop.equations().siso or record.y.ndim > 1 or not record.valid.any():
        return 0.0
    y, rest = np.abs(record.y[record.valid]), abs(loop.point.output)
    ratio = float(np.median(y)) / rest if rest else 0.0
    far = ratio >= ELSEWHERE and y.min() >= math.sqrt(ELSEWHERE) * rest
    return ratio if far else 0.0


def describe_distance(loop: Loop, ratio: float) -> str:
    """Say that a record is so many times as far out as the operating point."""
    return (
        f"y is {ratio:.4g} times the output of the operating point, {loop.point.output:.4g}. "
        "The record may be in another unit than the plant, or u and y may be exchanged. Scale or "
        "exchange the channels, or give the loop the operating point of this record."
    )
