"""Several records used together, checked to have one sampling period and one hold."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice
from typing import Any

import numpy as np

from .._base.errors import CtrlidError
from .._base.periods import have_same_period
from .record import Record

# An input that moves by more than this share of its standard deviation in a period is not held.
VISIBLE_MOTION = 0.1


def as_records(data: Any) -> tuple[Record, ...]:
    """Return one or several records as a tuple, checked to be of one kind.

    Parameters
    ----------
    data : Record or sequence of Record
        The experiments.

    Returns
    -------
    tuple of Record
        The same records.

    Raises
    ------
    CtrlidError
        If something else is among them, or sampling period, hold or hold of the reference differ.
    """
    records = (data,) if isinstance(data, Record) else data
    if not isinstance(records, list | tuple):
        raise CtrlidError(f"a Record or a list of Records is needed; given {type(data).__name__}. "
                          "Make one with Record(u=, y=, dt=) or Record.from_csv(path)")  # fmt: skip
    strangers = [type(item).__name__ for item in records if not isinstance(item, Record)]
    if strangers or not records:
        what = f"has {', '.join(strangers)}" if strangers else "is empty"
        raise CtrlidError(f"a Record or a list of Records is needed; the list given {what}")
    for record in records[1:]:
        _require_same_kind(records[0], record)
    holds = sorted({one.hold_r for one in records if one.r is not None})
    if len(holds) > 1:
        raise CtrlidError(
            "records used together need references that run alike between samples; given "
            f"{' and '.join(f'hold_r={hold!r}' for hold in holds)}. Give all of them the one that "
            "is right, as in dataclasses.replace(record, hold_r='zoh')"
        )
    return tuple(records)


def require_valid_samples(records: Sequence[Record], what: str) -> None:
    """Refuse records of which nothing counts."""
    for k, record in enumerate(records, 1):
        if not record.valid.any():
            where = what if len(records) == 1 else f"number {k} of {what}"
            raise CtrlidError(f"{where} has no valid sample: valid= is False everywhere, so that "
                              "nothing of it counts")  # fmt: skip


def order_model_and_data(first: Any, second: Any) -> tuple[Any, Any]:
    """Return the model and then the data of two arguments, whichever of them came first.

    A model and a record differ in type, so that nobody has to remember an order.

    Parameters
    ----------
    first, second : object
        One of them may be a Record or a sequence of Records.

    Returns
    -------
    model, data : object
        The two, swapped if only the first of them is data.
    """

    def is_data(given: Any) -> bool:
        several = isinstance(given, list | tuple) and any(isinstance(x, Record) for x in given)
        return isinstance(given, Record) or several

    return (second, first) if is_data(first) and not is_data(second) else (first, second)


def stream_records(data: Any) -> tuple[Record, Iterable[Record]]:
    """Return the first record and all of them, checked to be of one kind as they pass.

    Parameters
    ----------
    data : Record or iterable of Record
        The experiments; an iterator is read once.

    Returns
    -------
    first : Record
        The first record.
    records : iterable of Record
        All records, the first one too.

    Raises
    ------
    CtrlidError
        As `as_records`, for what an iterator yields when it yields it.
    """
    if not isinstance(data, Iterator):
        records = as_records(data)
        return records[0], records
    first = as_records(list(islice(data, 1)))[0]
    return first, chain([first], _check_each(first, data))


def _check_each(first: Record, rest: Iterator[Any]) -> Iterator[Record]:
    for record in rest:
        as_records([record])
        _require_same_kind(first, record)
        yield record


def _require_same_kind(first: Record, record: Record) -> None:
    if record.signals != first.signals:
        counts = [{k: len(v) for k, v in one.signals.items()} for one in (first, record)]
        if any(counts[0].get(k) != counts[1].get(k) for k in ("u", "y")):
            raise CtrlidError(
                "records used together need the same inputs and outputs; given "
                f"{first.signals} and {record.signals}"
            )
    if not have_same_period(record.dt, first.dt) or record.hold != first.hold:
        raise CtrlidError(
            "records used together need the same sampling period and the same hold; given "
            f"{first.dt:.10g} s, {first.hold!r} and {record.dt:.10g} s, {record.hold!r}. Decimate "
            "the faster one, or give both the hold that describes their input better"
        )


def measure_input_motion(records: Sequence[Record], reconstructed: bool = True) -> float:
    """Return how far u moves from sample to sample where it is not held, as share of its spread.

    Parameters
    ----------
    records : sequence of Record
        The experiments.
    reconstructed : bool, optional
        Whether the motion of a band-limited input is known between the samples, and no error.

    Returns
    -------
    float
        Zero for held inputs, and for reconstructed ones where that counts; above `VISIBLE_MOTION`
        a hold assumption shows in the poles.
    """
    shares = [0.0]
    for record in records:
        spread = float(np.std(record.u))
        if (record.hold == "foh" or (record.hold != "zoh" and not reconstructed)) and spread:
            shares.append(float(np.std(np.diff(record.u))) / spread)
    return max(shares)
