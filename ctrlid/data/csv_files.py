"""Records as CSV files: exact round trips, and the files that other tools write."""

import csv
import io
import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._base.errors import CtrlidError
from .._base.files import replace_file
from .._base.text import split_unit, with_unit, write_count
from .csv_signals import check_scale, list_names, question_units, rename_signals, spread_words
from .csv_table import MARK, read_table, refuse_text, split_cells
from .time_stamps import make_uniform, question_period

TIME = ("t", "time", "timestamp", "seconds", "zeit")
SECONDS = {"": 1.0, "s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3,
           "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "min": 60.0, "h": 3600.0}  # fmt: skip
SIGNALS = ("r", "u", "y")
# Sampling periods are shorter, so that times are finite [s].
LONGEST = 1e12
# So many rows are written at once, which bounds the memory that their text takes.
CHUNK = 20_000


def write_csv(path: Path, record: Any) -> None:
    """Write a record: a comment with its fields, a header with units, one row per sample."""
    columns = _name_columns(record)
    channels = {"t": record.t}
    units = {"t": "s", **{k: record.units.get(k, "") for k in record.extra}}
    for key, labels in columns.items():
        values = np.reshape(getattr(record, key), (len(labels), -1))
        given = record.units.get(key, "")
        words = (given,) * len(labels) if isinstance(given, str) else given
        channels |= dict(zip(labels, values, strict=True))
        units |= dict(zip(labels, words, strict=True))
    channels |= record.extra
    if not record.valid.all():
        rows = record.valid if record.valid.ndim == 2 else record.valid[None, :]
        labels = [f"valid {name}" for name in columns["y"]] if len(rows) > 1 else ["valid"]
        channels |= dict(zip(labels, rows, strict=True))
    line = io.StringIO()
    header = [with_unit(k, units.get(k, "")) for k in channels]
    csv.writer(line, lineterminator="").writerow(header)
    expected = [(k, units.get(k, "")) for k in channels]
    if (
        "\n" in line.getvalue()
        or [split_unit(c) for c in split_cells(line.getvalue(), ",")] != expected
    ):
        raise CtrlidError(f"the header {header} would not be read back as it is: remove brackets, "
                          "outer spaces and line breaks from names and units")  # fmt: skip
    fields = {key: getattr(record, key) for key in ("name", "dt", "hold", "hold_r")}
    # A file that was cut off by a full disk or a copy is told by its number of rows.
    fields |= {"names": dict(record.names), "rows": len(record)}
    several = {key: labels for key, labels in columns.items() if len(labels) > 1}
    if several:
        fields["columns"] = several
    with replace_file(path) as file:
        file.write(f"{MARK}{json.dumps(fields, ensure_ascii=False)}\n{line.getvalue()}\n")
        for first in range(0, len(record), CHUNK):
            rows = np.column_stack([c[first : first + CHUNK] for c in channels.values()])
            # Each number is written with the fewest digits that give it back.
            file.writelines(",".join(map(repr, row)) + "\n" for row in rows.tolist())


def _name_columns(record: Any) -> dict[str, list[str]]:
    """Return the columns of r, u and y: so called where there is one, by name where several."""
    names = [name for each in record.signals.values() for name in each]
    taken = {"t", "time", "valid", "r", "u", "y", *record.extra}
    return {
        key: [key] if len(each) == 1 else
        [f"{key}_{name}" if names.count(name) > 1 or name in taken else name for name in each]
        for key, each in record.signals.items()
    }  # fmt: skip


def read_csv(
    path: Path, sources: Mapping[str, str | Sequence[str] | None], time: str | None,
    dt: float | None, extra: Sequence[str] | None, units: Mapping[str, Any] | None,
    hold: str | None, name: str | None, gaps: str, scale: Mapping[str, float] | None = None,
    renamed: Mapping[str, Any] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return the fields of a record; see `Record.from_csv`, `sources` are its r, u and y."""
    if not isinstance(gaps, str) or gaps not in ("error", "mask"):
        raise CtrlidError(f"gaps must be 'error' or 'mask'; given {gaps!r}")
    own, header, table, texts, dates = read_table(path)
    if own.get("rows", len(table)) != len(table):
        raise CtrlidError(
            f"{path} is not whole: its line {MARK.strip()!r} says {own['rows']} rows, and it has "
            f'{len(table)}. Copy it again; if the rows were changed on purpose, take "rows" out '
            "of that line"
        )
    labels = [split_unit(cell) for cell in header]
    names = [label for label, _ in labels]
    period_given = own.get("dt") if dt is None else dt

    def place(label: str, what: str) -> int:
        return _find_column(path, header, label, what)

    columns = _choose_columns(sources, own, names)
    # One place for each column, under its key and its number among those of the key.
    found = {(k, i): place(v, k) for k, each in columns.items() for i, v in enumerate(each)}
    places = {k if len(columns[k]) == 1 else f"{k} ({columns[k][i]})": p
              for (k, i), p in found.items()}  # fmt: skip
    if time is None:
        time = next((label for label in names if label.lower() in TIME), None)
    if time is None and period_given is None and len(dates) == 1:
        time = header[next(iter(dates))]
    clock = None if time is None else place(time, "time")
    if isinstance(extra, str):
        extra = (extra,)
    if extra is None:
        taken = {*places.values(), clock}
        extra = [label for k, label in enumerate(names)
                 if k not in taken and label.partition(" ")[0] != "valid"]  # fmt: skip
        extra = extra if own else ()
    # A signal that another column takes the place of keeps its own name, or gets one that is free.
    spare = [(k, names[k]) for k in (place(c, "extra") for c in extra)]
    others = {label for _, label in spare}
    further = {
        _name_spare(label, own, others) if own and label in SIGNALS else label: k
        for k, label in spare
    }
    counting = [place("valid", "valid")] if "valid" in names else []
    each = [f"valid {name}" for name in columns["y"]]
    counted = len(each) > 1 and each[0] in names
    apart = [place(label, "valid") for label in each] if counted else []
    needed = {*places.values(), *further.values(), *counting, *apart, clock}
    # Text in a column that nobody asked for, such as the state of a machine, does no harm.
    dated = clock in dates
    refuse_text(path, {k: v for k, v in texts.items()
                        if k in needed and not (dated and k == clock)}, header)  # fmt: skip
    valid = np.ones(len(table), dtype=bool)
    if counting:
        valid = table[:, counting[0]] > 0.5
    rows_valid = table[:, apart] > 0.5 if apart else None
    table, valid = _fill_gaps(table, places, valid, gaps, path)
    if dt is not None and not 0 < dt < LONGEST:
        raise CtrlidError(f"dt is the sampling period, a number of seconds above 0; given {dt!r}")
    start, rows = 0.0, None
    if clock is None:
        if period_given is None:
            raise CtrlidError(
                f"{path} has no time column ({', '.join(TIME)}); its columns are "
                f"{', '.join(header)}. Name the column with time=, or give dt="
            )
        dt = period_given
    else:
        # Behind the name of a column of dates stands a zone, if anything.
        unit = "s" if dated else labels[clock][1]
        stamps = dates[clock] if dated else table[:, clock] * _find_seconds(unit, path)
        dt, rows = make_uniform(stamps, period_given, gaps, path)
        start = float(stamps[0])
        if not unit and names[clock].lower() != "seconds" and period_given is None:
            question_period(dt, stamps, path, header[clock])
    if rows is not None and len(rows) != len(table):
        valid = valid[rows] & (np.diff(rows, prepend=-1) > 0)
        table = table[rows]
        rows_valid = None if rows_valid is None else rows_valid[rows]
    if rows_valid is not None:
        valid = (rows_valid & valid[:, None]).T
    at = {key: [found[key, i] for i in range(len(each))] for key, each in columns.items()}
    every = {**at, **{label: [k] for label, k in further.items()}}
    known = {key: tuple(names[k] for k in ks) for key, ks in at.items()}
    # The names that a file of ours has are those of the signals in its own columns.
    stored = {key: (key,) for key in SIGNALS} | {
        key: (v,) if isinstance(v, str) else tuple(v) for key, v in own.get("columns", {}).items()
    }
    called = {key: v for key, v in own.get("names", {}).items() if known.get(key) == stored[key]}
    called |= {
        key: tuple(_name_stored(label, own) for label in v)
        for key, v in known.items() if v != stored[key]
    }  # fmt: skip
    spoken = list_names(every, names, header, called)
    if renamed:
        own_words = list_names(at, names, header, called)
        called = rename_signals(called, known, spread_words("names", renamed, own_words, at))
        # A signal may be scaled by its new name as well.
        spoken = {**list_names(every, names, header, called), **spoken}
    factors = check_scale(scale or {}, spoken, every)
    stated = spread_words("units", units or {}, spoken, every)
    written = {(key, i): labels[k] for key, ks in every.items() for i, k in enumerate(ks)}
    question_units(stated, written, factors, every, path)
    # The unit in the header is that of the numbers before they were scaled.
    read = {
        key: tuple(stated.get((key, i), "" if (key, i) in factors else written[key, i][1])
                   for i in range(len(ks)))
        for key, ks in every.items()
    }  # fmt: skip
    scales = {key: np.array([[factors.get((key, i), 1.0)] for i in range(len(ks))])
              for key, ks in every.items()}  # fmt: skip
    return {
        **{key: table[:, ks].T * scales[key] for key, ks in at.items()},
        "extra": {label: table[:, k] * scales[label][0, 0] for label, k in further.items()},
        "dt": dt, "start": start, "valid": valid,
        "units": {key: words for key, words in read.items() if any(words)},
        "names": called,
        "hold": hold or own.get("hold", "zoh"),
        "hold_r": own.get("hold_r", "zoh"),
        "name": own.get("name", path.stem) if name is None else name,
    }  # fmt: skip


def _name_spare(key: str, own: Mapping[str, Any], others: Collection[str]) -> str:
    """Return what a signal of a file is called as a channel beside the one in its place."""
    known = _name_stored(key, own)
    name = f"logged {key}" if known in SIGNALS or known in others else known
    while name in others:
        name = f"logged {name}"
    return name


def _name_stored(label: str, own: Mapping[str, Any]) -> str:
    """Return what a file of ours calls the signal in a column; else the column's own name."""
    called = own.get("names", {}).get(label, ())
    called = (called,) if isinstance(called, str) else tuple(called)
    return called[0] if label in SIGNALS and len(called) == 1 else label


def _find_column(path: Path, header: Sequence[str], label: str, what: str) -> int:
    """Return the place of the one column of that name, with its unit or without."""
    found = [k for k, cell in enumerate(header) if label in (cell, split_unit(cell)[0])]
    if len(found) != 1:
        raise CtrlidError(
            f"{path} has {'no column' if not found else 'several columns'} {label!r} for "
            f"{what}; its columns are {', '.join(header)}. Name the right one with {what}="
            ' and the others likewise: from_csv(..., r="setpoint", u="voltage", y="gap"); '
            "r= may be left out where the file has no reference"
        )
    return found[0]


def _choose_columns(
    sources: Mapping[str, str | Sequence[str] | None], own: Mapping[str, Any], names: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    """Return the columns of r, u and y: as named, as the file's own comment has them, or so called.

    Without a reference there is no r.
    """
    for key, each in sources.items():
        labels = (each,) if isinstance(each, str | None) else each
        if not all(isinstance(label, str | None) for label in labels):
            raise CtrlidError(f"{key}= names a column, or several in a list; given {each!r}")
    given = {k: k if v is None else v for k, v in sources.items()}
    stored = {k: v for k, v in own.get("columns", {}).items() if isinstance(given[k], str)
              and given[k] == k}  # fmt: skip
    wanted = {k: v for k, v in sources.items() if v is not None} | stored
    if "r" in names:
        wanted = {"r": "r", **wanted}
    return {k: (v,) if isinstance(v, str) else tuple(v) for k, v in wanted.items()}


def _find_seconds(unit: str, path: Path) -> float:
    """Return how many seconds a unit of time has."""
    if unit not in SECONDS:
        raise CtrlidError(f"the time column of {path} is in {unit!r}; known units are "
                          f"{', '.join(filter(None, SECONDS))}. Convert it, or remove the "
                          "column and give dt=")  # fmt: skip
    return SECONDS[unit]


def _fill_gaps(
    table: Any, places: Mapping[str, int], valid: Any, gaps: str, path: Path
) -> tuple[Any, Any]:
    """Return table and validity with the last values where numbers are missing."""
    missing = np.isnan(table[:, list(places.values())])
    rows = np.flatnonzero(missing.any(axis=1) & valid)
    if not missing.any():
        return table, valid
    if gaps == "error" and rows.size:
        k = int(rows[0])
        names = ", ".join(n for n, lacks in zip(places, missing[k], strict=True) if lacks)
        raise CtrlidError(
            f"{path} has no number for {names} in row {k + 1} of the data, and lacks some in "
            f"{rows.size} of {write_count(len(table), 'row')}, at most {_find_longest_run(rows)} "
            "of them one after the other. Give gaps='mask' to fill them with the last values "
            "and mark them as not valid"
        )
    table = table.copy()
    for (name, column), lacks in zip(places.items(), missing.T, strict=True):
        known = np.flatnonzero(~lacks)
        if not known.size:
            raise CtrlidError(f"{path} has no number at all for {name}, which is needed")
        last = np.maximum.accumulate(np.where(lacks, known[0], np.arange(len(table))))
        table[:, column] = table[last, column]
    return table, valid & ~missing.any(axis=1)


def _find_longest_run(rows: Any) -> int:
    """Return how many of ascending numbers follow one another at most."""
    ends = np.flatnonzero(np.diff(rows, append=rows[-1] + 2) > 1)
    return int(np.max(np.diff(ends, prepend=-1)))
