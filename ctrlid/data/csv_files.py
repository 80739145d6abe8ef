"""Records as CSV files: exact round trips, and the files that other tools write."""

import csv
import io
import json
import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._base.arguments import is_number
from .._base.errors import CtrlidError, CtrlidWarning
from .._base.files import replace_file
from .._base.text import drop_roundoff, split_unit, with_unit, write_count, write_percent
from .._base.units import find_shift, is_same_unit, write_shift
from .dates import read_seconds
from .field_checks import check_words

TIME = ("t", "time", "timestamp", "seconds", "zeit")
SECONDS = {"": 1.0, "s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6,
           "min": 60.0, "h": 3600.0}  # fmt: skip
# The first cell of each column that is no number, by the place of the column, with its line.
Texts = dict[int, tuple[str, int]]
# A channel, or a further column, and the number of a signal in it.
Signal = tuple[str, int]
MARK = "# ctrlid "
# The first line in which Excel is told the separator.
SEPARATOR = "sep="
CLOCK = re.compile(r"\d{4}-\d\d-\d\d|\d{1,2}[./]\d{1,2}[./]\d{2,4}|\d{1,2}:\d\d")
# A file with more missing samples than this many times its rows has a wild time stamp.
WILD = 100
# A good clock never jitters by more than this share of the period.
JITTER = 0.01
# A step of more periods between two time stamps says that samples are missing.
GAP = 1.5
# Where steps of two units come less often than this, rows may have been lost at a regular pace. A
# recorder that loses a fifth of all rows would have been noticed, so that it is only warned of.
LOST = 0.2
# Sampling periods are shorter, so that times are finite [s].
LONGEST = 1e12
# So many bytes of a file show in what signs it is written.
BEGINNING = 200
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
        or [split_unit(c) for c in _split_cells(line.getvalue(), ",")] != expected
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
    own, header, table, texts, dates = _read_table(path)
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
        found = [k for k in range(len(header)) if label in (names[k], header[k])]
        if len(found) != 1:
            raise CtrlidError(
                f"{path} has {'no column' if not found else 'several columns'} {label!r} for "
                f"{what}; its columns are {', '.join(header)}. Name the right one with {what}="
                ' and the others likewise: from_csv(..., r="setpoint", u="voltage", y="gap"); '
                "r= may be left out where the file has no reference"
            )
        return found[0]

    for key, each in sources.items():
        labels_of_key = (each,) if isinstance(each, str | None) else each
        if not all(isinstance(label, str | None) for label in labels_of_key):
            raise CtrlidError(f"{key}= names a column, or several in a list; given {each!r}")
    given = {k: k if v is None else v for k, v in sources.items()}
    stored = {k: v for k, v in own.get("columns", {}).items() if isinstance(given[k], str)
              and given[k] == k}  # fmt: skip
    wanted = {k: v for k, v in sources.items() if v is not None} | stored
    if "r" in names:
        wanted = {"r": "r", **wanted}
    columns = {k: (v,) if isinstance(v, str) else tuple(v) for k, v in wanted.items()}
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
    further = {names[k]: k for k in (place(c, "extra") for c in extra)}
    counting = [place("valid", "valid")] if "valid" in names else []
    each = [f"valid {name}" for name in columns["y"]]
    counted = len(each) > 1 and each[0] in names
    apart = [place(label, "valid") for label in each] if counted else []
    needed = {*places.values(), *further.values(), *counting, *apart, clock}
    # Text in a column that nobody asked for, such as the state of a machine, does no harm.
    dated = clock in dates
    _refuse_text(path, {k: v for k, v in texts.items()
                        if k in needed and not (dated and k == clock)}, header)  # fmt: skip
    valid = np.ones(len(table), dtype=bool)
    if counting:
        valid = table[:, counting[0]] > 0.5
    rows_valid = table[:, apart] > 0.5 if apart else None
    table, valid = _fill_gaps(table, places, valid, gaps, path)
    start, rows = 0.0, None
    if dt is not None and not 0 < dt < LONGEST:
        raise CtrlidError(f"dt is the sampling period, a number of seconds above 0; given {dt!r}")
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
        if unit not in SECONDS:
            raise CtrlidError(f"the time column of {path} is in {unit!r}; known units are "
                              f"{', '.join(filter(None, SECONDS))}. Convert it, or remove the "
                              "column and give dt=")  # fmt: skip
        stamps = dates[clock] if dated else table[:, clock] * SECONDS[unit]
        dt, rows = _make_uniform(stamps, period_given, gaps, path)
        start = float(stamps[0])
        if not unit and names[clock].lower() != "seconds" and period_given is None:
            _question_period(dt, stamps, path, header[clock])
    if rows is not None and len(rows) != len(table):
        valid = valid[rows] & (np.diff(rows, prepend=-1) > 0)
        table = table[rows]
        rows_valid = None if rows_valid is None else rows_valid[rows]
    if rows_valid is not None:
        valid = (rows_valid & valid[:, None]).T
    at = {key: [found[key, i] for i in range(len(each))] for key, each in columns.items()}
    every = {**at, **{label: [k] for label, k in further.items()}}
    known = {key: tuple(names[k] for k in ks) for key, ks in at.items()}
    called = own.get("names", {k: v for k, v in known.items() if v != (k,)})
    spoken = _list_names(every, names, header, called)
    if renamed:
        own_words = _list_names(at, names, header, called)
        called = _rename(called, known, _spread_words("names", renamed, own_words, at))
        # A signal may be scaled by its new name as well.
        spoken = {**_list_names(every, names, header, called), **spoken}
    factors = _check_scale(scale or {}, spoken, every)
    stated = _spread_words("units", units or {}, spoken, every)
    written = {(key, i): labels[k] for key, ks in every.items() for i, k in enumerate(ks)}
    _question_units(stated, written, factors, every, path)
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


def _list_names(
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


def _check_scale(
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


def _spread_words(
    what: str, given: Mapping[str, Any], spoken: Mapping[str, list[Signal]],
    every: Mapping[str, Sequence[int]],
) -> dict[Signal, str]:  # fmt: skip
    """Return the stated units or names of signals; one unit stands for all signals of a name."""
    found: dict[Signal, str] = {}
    for name, signals in _find_signals(what, given, spoken, every).items():
        words = check_words(what, {name: given[name]}, (name,), {name: len(signals)})[name]
        found |= dict(zip(signals, (words,) if isinstance(words, str) else words, strict=True))
    return found


def _rename(
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


def _question_units(
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


def _question_period(dt: float, stamps: Any, path: Path, label: str) -> None:
    """Warn of times without a unit that are hardly in seconds: whole numbers, or below 1 µs."""
    if dt < 1e-6 or (dt >= 1 and np.all(stamps == np.round(stamps))):
        warnings.warn(
            f"the time column {label!r} of {path} has no unit, so that it is taken in seconds and "
            f"the period is {dt:g} s. If it is in milliseconds or counts samples, write its unit "
            f"into the header, as in '{label} [ms]', or remove the column and give dt=; otherwise "
            f"write '{label} [s]'",
            CtrlidWarning, stacklevel=4,
        )  # fmt: skip


def _read_table(path: Path) -> tuple[dict[str, Any], list[str], Any, Texts, dict[int, Any]]:
    """Return the fields in ctrlid's own comment, the header cells, values, texts and dates."""
    try:
        data = path.read_bytes()
    except OSError as reason:
        raise CtrlidError(f"cannot read {path}: {reason.strerror}") from reason
    text = _decode(data)
    own: dict[str, Any] = {}
    comment, told, at = "", "", 0
    while True:
        stop = text.find("\n", at)
        stop = len(text) if stop < 0 else stop + 1
        line = text[at:stop].strip()
        if at >= len(text) or (line and not line.startswith(("#", SEPARATOR))):
            break
        if line.startswith(MARK):
            try:
                own = json.loads(line.removeprefix(MARK))
            except (json.JSONDecodeError, RecursionError) as reason:
                raise CtrlidError(f"the line {line!r} of {path} is damaged: {reason}. Restore or "
                                  "remove it") from reason  # fmt: skip
            if not isinstance(own, dict):
                raise CtrlidError(f"the line {line!r} of {path} is damaged: it has no fields. "
                                  "Restore or remove it")  # fmt: skip
        elif line.lower().startswith(SEPARATOR) and len(line) == len(SEPARATOR) + 1:
            told = line[-1]
        elif line:
            comment = line.lstrip("# ")
        at = stop
    separator = told or max(",;\t", key=line.count)
    header = _split_cells(line, separator)
    if len(header) == 1 and line:
        other = next((c for c in "|:; " if c in line), "something else")
        raise CtrlidError(
            f"{path} has a single column, {line[:60]!r}: columns are separated by commas, "
            f"semicolons or tabs. If these are separated by {other!r}, replace it, or say so in a "
            "first line such as sep=| (Excel reads that, too); a line above the header, delete "
            "it or start it with #"
        )
    if all(_is_number(cell) for cell in header):
        # numpy.savetxt writes its header as a comment.
        header = _split_cells(comment, separator)
        stop = at
        if not comment or any(_is_number(cell) for cell in header):
            raise CtrlidError(f"{path} has no header line: its first line is {line!r}. Add one "
                              "with the names of the columns, such as t,r,u,y")  # fmt: skip
    body = text[stop:]
    if not body.strip():
        raise CtrlidError(f"{path} has no rows of numbers below its header")
    # Where commas do not separate columns, they are decimal commas.
    plain = body if separator == "," else body.replace(",", ".")
    above, texts, dates = text.count("\n", 0, stop), Texts(), dict[int, Any]()
    try:
        table = np.loadtxt(io.StringIO(plain), delimiter=separator, ndmin=2, quotechar='"')
    except ValueError:
        table, texts, dates = _read_with_blanks(path, body, separator, above, len(header))
    if table.shape[1] != len(header):
        _refuse_text(path, texts, ())
        _refuse_decimal_commas(path, body.lstrip("\n").partition("\n")[0], separator, len(header))
        raise CtrlidError(f"the header of {path} names {write_count(len(header), 'column')}, its "
                          f"rows have "
                          f"{table.shape[1]}; give every column a name")  # fmt: skip
    return own, header, table, texts, dates


def _decode(data: bytes) -> str:
    """Return the text of a file, with line ends of one kind; what tools of all ages write."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = data.decode("utf-16", errors="replace")
    elif _is_empty(data[1:BEGINNING:2]):
        # Two bytes a sign, without the mark that says so.
        text = data.decode("utf-16-le", errors="replace")
    elif _is_empty(data[0:BEGINNING:2]):
        text = data.decode("utf-16-be", errors="replace")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            # Older Windows tools write this encoding.
            text = data.decode("cp1252", errors="replace")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _is_empty(part: bytes) -> bool:
    """Whether nearly all bytes are zero, as every other one of a text in two bytes a sign."""
    return 10 * part.count(0) > 9 * len(part) > 0


def _refuse_decimal_commas(path: Path, row: str, separator: str, columns: int) -> None:
    """Refuse a row of numbers with more cells than there are columns, if commas may be decimal."""
    cells = _split_cells(row, separator)
    # Where there is a decimal point, no comma is one.
    commas = separator == "," and "." not in row
    if commas and len(cells) > columns and all(map(_is_number, cells)):
        raise CtrlidError(
            f"{path} has {write_count(columns, 'column')} by its header, but the row {row!r} has "
            f"{len(cells)} cells between commas. If its numbers have decimal commas, a comma "
            "cannot also stand between columns: save the file with semicolons between columns, or "
            "with decimal points. If they have decimal points, give every column a name"
        )


def _read_with_blanks(
    path: Path, body: str, separator: str, above: int, columns: int
) -> tuple[Any, Texts, dict[int, Any]]:
    """Read a table with blank cells and cells of text, which are NaN, below so many lines.

    The first text of each column is returned beside it, as it stands in the file, and the times of
    columns of dates [s].
    """
    rows: list[list[float]] = []
    texts, first = Texts(), 0
    # The cells of columns that begin with a text.
    begun: dict[int, list[str]] = {}
    for k, cells in enumerate(_read_cells(body, separator)):
        if not cells or cells[0].lstrip().startswith("#"):
            continue
        numbers = []
        for column, cell in enumerate(cells):
            if column in begun:
                begun[column].append(cell)
            try:
                plain = cell if separator == "," else cell.replace(",", ".")
                numbers.append(float(plain) if plain.strip() else math.nan)
            except ValueError:
                texts.setdefault(column, (cell, above + k + 1))
                if not rows:
                    begun[column] = [cell]
                numbers.append(math.nan)
        first = first if rows else k
        rows.append(numbers)
        if len(cells) != len(rows[0]):
            # Above a ragged table stands what is no part of it.
            _refuse_text(path, texts, ())
            lines = body.split("\n")
            for place in (first, k):
                _refuse_decimal_commas(path, lines[place], separator, columns)
            raise CtrlidError(f"{path} is not a table of numbers: line {above + k + 1} has "
                              f"{write_count(len(cells), 'cell')}, the lines above it "
                              f"{len(rows[0])}")  # fmt: skip
    found = {column: read_seconds(cells) for column, cells in begun.items()}
    return np.array(rows), texts, {k: v for k, v in found.items() if v is not None}


def _refuse_text(path: Path, texts: Texts, header: Sequence[str]) -> None:
    """Refuse the first text among columns of which numbers are needed; their names are optional."""
    if not texts:
        return
    column, (cell, line) = min(texts.items(), key=lambda item: (item[1][1], item[0]))
    where = f"{cell!r} stands in line {line}"
    where += f", column {header[column]!r}" if header else ""
    if CLOCK.match(cell.strip()):
        raise CtrlidError(
            f"{path} has a date or a time of day: {where}; times are numbers, in seconds from any "
            "start, or all of them dates with a time such as 2026-11-27T10:00:00.250. Convert "
            "them, for instance by t = pandas.to_datetime(column) and then "
            "(t - t[0]).dt.total_seconds(), or remove the column from the file and give dt=; a "
            "line above the header: delete it or start it with #"
        )
    if "," in cell and _is_number(cell):
        raise CtrlidError(
            f"{path} has a number with a comma between columns that commas separate: {where}. If "
            "it is a decimal comma, save the file with semicolons between columns, or with decimal "
            "points; if it parts thousands, save the file without it"
        )
    raise CtrlidError(
        f"{path} is not a table of numbers: {where}. Remove it, or leave the cell blank and give "
        "gaps='mask'; lines above the header or a row of units: delete them or start them with #"
    )


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


def _split_cells(line: str, separator: str) -> list[str]:
    rows = list(_read_cells(line, separator, skipinitialspace=True))
    return [cell.strip() for cell in rows[0]] if rows else [""]


def _read_cells(text: str, separator: str, **options: Any) -> Iterator[list[str]]:
    """Return the cells of each line, or refuse what is no table."""
    rows = csv.reader(io.StringIO(text), delimiter=separator, **options)
    try:
        yield from rows
    except csv.Error as reason:
        raise CtrlidError(
            f"line {rows.line_num} below the header is not a line of a table: {reason}. Remove it, "
            "or save the file as CSV again"
        ) from reason


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return not cell
    return True


def _find_resolution(stamps: Any) -> float:
    """Return the last decimal place that time stamps use, at least their round-off."""
    finest = 4 * float(np.spacing(np.abs(stamps).max()))
    for digits in range(13):
        unit = 10.0**-digits
        if unit <= finest:
            break
        if np.all(np.abs(stamps - np.round(stamps / unit) * unit) <= finest):
            return unit
    return finest


def _find_even_period(stamps: Any, rounding: float, dt: float | None) -> float | None:
    """Return the period of which stamps are rounded multiples, None if they are not.

    A clock of 3.25 ms printed in whole milliseconds steps by 3 and 4 ms, and is regular.
    """
    n = len(stamps)
    k = np.arange(n)

    def fits(period: float, share: float = 1.01) -> bool:
        return period > 0 and float(np.ptp(stamps - k * period)) <= share * rounding

    finest = 4 * float(np.spacing(np.abs(stamps).max()))
    mean = float(stamps[-1] - stamps[0]) / (n - 1)
    if dt is None and mean > 0 and float(np.ptp(stamps - k * mean)) <= finest:
        return estimate_period(stamps)
    steps = np.diff(stamps)
    base = float(np.median(steps)) if dt is None else dt
    if not rounding <= mean or base <= 0:
        return None
    # Steps of 1, 1 and 2 units may also be lost samples, unless there are many, evenly spread.
    with np.errstate(over="ignore"):  # A period far below the steps is refused by them below.
        longer = np.round(steps / base)
    if np.all(np.abs(steps - longer * base) <= finest) and (
        dt is not None or np.count_nonzero(longer > 1) < 5
    ):
        return None
    if dt is not None:
        return dt if fits(dt, 1.25) else None
    slope = float(np.polyfit(k / n, stamps - stamps[0], 1)[0]) / n
    if not fits(slope, 1.25):
        return None
    # Of the periods that the stamps allow, the one with the fewest digits is taken.
    short = _list_roundings(slope)
    return next((p for p in short if fits(p) and abs(p - slope) <= rounding / n), slope)


def _find_doubled_unit(stamps: Any) -> float | None:
    """Return the step of a clock of which some steps are twice as long, None for other clocks."""
    steps = np.diff(stamps)
    unit = float(np.min(steps))
    finest = 4 * float(np.spacing(np.abs(stamps).max()))
    longer = np.round(steps / unit) if unit > 0 else np.zeros(0)
    whole = np.all(np.abs(steps - longer * unit) <= finest)
    return drop_roundoff(unit, finest) if np.any(longer > 1) and whole else None


def _shorten_period(dt: float, uncertainty: float) -> float:
    """Return the period with the fewest digits within an uncertainty of another."""
    return next((p for p in _list_roundings(dt) if abs(p - dt) <= uncertainty), dt)


def _list_roundings(period: float) -> Iterator[float]:
    """Yield a period rounded to one digit, to two, and so on."""
    return (float(f"{period:.{digits}g}") for digits in range(1, 16))


def estimate_period(stamps: Any) -> float:
    """Return the mean period of time stamps, with no digits that only round-off gave it."""
    mean = float(stamps[-1] - stamps[0]) / (len(stamps) - 1)
    return drop_roundoff(mean, 4 * float(np.spacing(np.abs(stamps).max())))


def _make_uniform(stamps: Any, dt: float | None, gaps: str, path: Path) -> tuple[float, Any]:
    """Return the period of time stamps and, for each uniform sample, its row."""
    if len(stamps) < 2 or not np.isfinite(stamps).all():
        raise CtrlidError(f"the time column of {path} needs at least 2 values, all finite")
    rounding, period_is_free = _find_resolution(stamps), dt is None
    even = _find_even_period(stamps, rounding, dt)
    if even is not None and dt is None and (unit := _find_doubled_unit(stamps)) is not None:
        # A slow clock in whole units and a fast one that lost rows write the same stamps.
        longer = int(np.count_nonzero(np.diff(stamps) > GAP * unit))
        either = (
            f"the time column of {path} steps by {unit:g} s, and {longer} times, at a regular "
            f"pace, by twice as much: either rows were lost (give gaps='mask' to fill them and "
            f"mark them as not valid), or the period is no whole number of {unit:g} s (give "
            f"dt={even:.10g})"
        )
        few = longer <= LOST * (len(stamps) - 1) + 1
        if gaps == "error" and few:
            raise CtrlidError(either)
        if not few:
            here = "lost rows" if gaps == "mask" else "the slower clock"
            warnings.warn(f"{either}. Read as {here}", CtrlidWarning, stacklevel=5)
        if gaps == "mask":
            even, dt = None, unit
    if even is not None:
        return even, np.arange(len(stamps))
    steps = np.diff(stamps)
    back = np.flatnonzero(steps <= 0)
    if back.size:
        k = int(back[0])
        raise CtrlidError(
            f"the time column of {path} does not increase: {stamps[k]:g} s in row {k + 1} of the "
            f"data is followed by {stamps[k + 1]:g} s. Sort the rows, cut at the restart of the "
            "clock, or give dt= and remove the column"
        )
    regular = steps[steps < GAP * np.median(steps)]
    # Round-off of the stamps is no digit of the period, also where rows are lost.
    usual = drop_roundoff(float(np.mean(regular)), 4 * float(np.spacing(np.abs(stamps).max())))
    if dt is not None and not abs(usual - dt) < 0.05 * usual:
        raise CtrlidError(f"the time column of {path} steps by {usual:.4g} s, but dt is {dt:g} s. "
                          "Leave out dt=, or remove the column; if its times are in another unit, "
                          "write it into the header, as in 't [ms]'")  # fmt: skip
    if dt is None:
        dt = estimate_period(stamps) if len(regular) == len(steps) else usual
    lost = np.round(steps / dt) - 1
    if np.sum(lost) > WILD * len(stamps):
        k = int(np.argmax(lost))
        raise CtrlidError(
            f"the time column of {path} jumps from {stamps[k]:.6g} s to {stamps[k + 1]:.6g} s in "
            f"row {k + 2} of the data, at a period of {dt:.4g} s: {lost[k]:.4g} samples would be "
            "missing. Correct or remove the wild time stamp, or cut the file there"
        )
    missing = np.where(steps < GAP * dt, 0, lost).astype(int)
    where = np.flatnonzero(missing)
    if where.size and gaps == "error":
        k = int(where[np.argmax(missing[where])])
        places = "one place" if where.size == 1 else f"{where.size} places"
        raise CtrlidError(
            f"{path} lacks {write_count(int(missing.sum()), 'sample')} in {places}; the longest "
            f"gap has {missing[k]}, {steps[k]:.4g} s after t = {stamps[k]:.6g} s, at a period of "
            f"{dt:.4g} s. Give "
            "gaps='mask' to fill them with the last values and mark them as not valid"
        )
    jitter = float(np.max(np.abs(steps - (missing + 1) * dt))) / dt
    if jitter > JITTER + rounding / dt:
        if even is None and period_is_free:
            # No mean of stamps that jitter is known better than that.
            dt = _shorten_period(dt, 2 * jitter * dt / (len(stamps) - 1))
        warnings.warn(
            f"the times of {path} jitter by up to {write_percent(jitter)} of the period "
            f"{dt:.10g} s; they are taken as uniform. Give dt= if the clock has another period. If "
            "the samples really were taken unevenly, resample them at even times first, as with "
            "numpy.interp",
            CtrlidWarning, stacklevel=4,
        )  # fmt: skip
    return dt, np.repeat(np.arange(len(stamps)), np.append(missing, 0) + 1)
