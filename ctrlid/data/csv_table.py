"""The text of a CSV file as a header and a table of numbers, whatever tool wrote it."""

import csv
import io
import json
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._base.errors import CtrlidError
from .._base.text import write_count
from .dates import read_seconds

# The first cell of each column that is no number, by the place of the column, with its line.
Texts = dict[int, tuple[str, int]]
# Begins the comment with the fields of a record.
MARK = "# ctrlid "
# The first line in which Excel is told the separator.
SEPARATOR = "sep="
CLOCK = re.compile(r"\d{4}-\d\d-\d\d|\d{1,2}[./]\d{1,2}[./]\d{2,4}|\d{1,2}:\d\d")
# How workbooks begin, new ones (a zip file) and old ones.
WORKBOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")
THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:[.,' ]\d{3})+(?:[.,]\d+)?")
# So many bytes of a file show in what signs it is written.
BEGINNING = 200


def read_table(path: Path) -> tuple[dict[str, Any], list[str], Any, Texts, dict[int, Any]]:
    """Return the fields in ctrlid's own comment, the header cells, values, texts and dates."""
    try:
        data = path.read_bytes()
    except OSError as reason:
        raise CtrlidError(f"cannot read {path}: {reason.strerror}") from reason
    if data.startswith(WORKBOOKS):
        raise CtrlidError(
            f"{path} is an Excel workbook and no text: save it as CSV, or read it with "
            "pandas.read_excel and give the columns to Record(u=, y=, dt=)"
        )
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
    header = split_cells(line, separator)
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
        header = split_cells(comment, separator)
        stop = at
        if not comment or any(_is_number(cell) for cell in header):
            raise CtrlidError(f"{path} has no header line: its first line is {line!r}. Add one "
                              "with the names of the columns, such as t,r,u,y")  # fmt: skip
    body = text[stop:]
    if not body.strip():
        raise CtrlidError(f"{path} has no rows of numbers below its header")
    if separator != ",":
        _refuse_two_signs(path, body, separator, text.count("\n", 0, stop))
    # Where commas do not separate columns, they are decimal commas.
    plain = body if separator == "," else body.replace(",", ".")
    above, texts, dates = text.count("\n", 0, stop), Texts(), dict[int, Any]()
    try:
        table = np.loadtxt(io.StringIO(plain), delimiter=separator, ndmin=2, quotechar='"')
    except ValueError:
        table, texts, dates = _read_with_blanks(path, body, separator, above, len(header))
    if table.shape[1] != len(header):
        refuse_text(path, texts, ())
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


def _refuse_two_signs(path: Path, body: str, separator: str, above: int) -> None:
    """Refuse a column of numbers with points and with commas: one of them parts thousands.

    A column may also have points alone where another has commas alone, as where only one of them is
    large enough for thousands.
    """
    if "." not in body or "," not in body:
        return
    first: dict[tuple[int, str], str] = {}
    text: set[int] = set()
    for k, cells in enumerate(_read_cells(body, separator)):
        if not cells or cells[0].lstrip().startswith("#"):
            continue
        for column, cell in enumerate(cells):
            if not _is_number(cell):
                text.add(column)
            for sign in ".,":
                if sign in cell:
                    here = f"{cell.strip()!r} in line {above + k + 1}"
                    first.setdefault((column, sign), here)
    seen = {sign: where for (column, sign), where in reversed(first.items()) if column not in text}
    if len(seen) == 2:
        raise CtrlidError(
            f"{path} has numbers with points, such as {seen['.']}, and numbers with commas, such "
            f"as {seen[',']}: one of the two signs parts thousands, and which of them cannot be "
            "told. Save the file without it"
        )


def _refuse_decimal_commas(path: Path, row: str, separator: str, columns: int) -> None:
    """Refuse a row of numbers with more cells than there are columns, if commas may be decimal."""
    cells = split_cells(row, separator)
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
            refuse_text(path, texts, ())
            lines = body.split("\n")
            for place in (first, k):
                _refuse_decimal_commas(path, lines[place], separator, columns)
            raise CtrlidError(f"{path} is not a table of numbers: line {above + k + 1} has "
                              f"{write_count(len(cells), 'cell')}, the lines above it "
                              f"{len(rows[0])}. Complete the line or remove it; the last one may "
                              "have been cut off")  # fmt: skip
    found = {column: read_seconds(cells) for column, cells in begun.items()}
    return np.array(rows), texts, {k: v for k, v in found.items() if v is not None}


def refuse_text(path: Path, texts: Texts, header: Sequence[str]) -> None:
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
    cure = "Remove it"
    if THOUSANDS.fullmatch(cell.strip()):
        cure = "If its signs part thousands, save the file without them. Else remove it"
    raise CtrlidError(
        f"{path} is not a table of numbers: {where}. {cure}, or leave the cell blank and give "
        "gaps='mask'; lines above the header or a row of units: delete them or start them with #"
    )


def split_cells(line: str, separator: str) -> list[str]:
    """Return the cells of one line."""
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
