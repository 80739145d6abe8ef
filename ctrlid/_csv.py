"""Records as CSV files: exact round trips, and the files that other tools write."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .errors import CtrlidError, CtrlidWarning

TIME = ("t", "time", "Time", "T", "timestamp", "seconds")
JITTER = 0.01  # of the period: what a good clock never shows
GAP = 1.5  # periods: samples are missing


def write_csv(path: str | Path, record: Any) -> None:
    """Write a record: comment lines with its fields, a header with units, one row per sample."""
    channels = {"t": record.t}
    channels |= {k: getattr(record, k) for k in ("r", "u", "y") if getattr(record, k) is not None}
    channels |= record.extra
    if not record.valid.all():
        channels["valid"] = record.valid.astype(float)
    units = {"t": "s", **record.units}
    header = [f"{k} [{units[k]}]" if k in units else k for k in channels]
    for label in header:
        if "," in label or "\n" in label:
            raise CtrlidError(f"the column name {label!r} would break the file: remove the comma or "
                              "line break from the channel's name or unit")  # fmt: skip
    comments = {"name": record.name, "dt": repr(record.dt), "start": repr(record.start),
                "hold": record.hold, **{f"name of {k}": v for k, v in record.names.items()}}  # fmt: skip
    lines = [f"# {k} = {v}" for k, v in comments.items() if v != ""]
    table = np.column_stack(list(channels.values()))
    with Path(path).open("w", encoding="utf-8") as file:
        file.write("\n".join([*lines, ",".join(header)]) + "\n")
        np.savetxt(file, table, fmt="%.17g", delimiter=",")


def read_csv(
    path: str | Path, *, r: str | None = None, u: str = "u", y: str = "y", time: str | None = None,
    dt: float | None = None, extra: Sequence[str] | None = None,
    units: Mapping[str, str] | None = None, hold: str | None = None, name: str | None = None,
    gaps: str = "error",
) -> dict[str, Any]:  # fmt: skip
    """Return the fields of a record from a CSV file with a header line.

    Parameters
    ----------
    path : str or path
        The file; columns separated by commas, semicolons or tabs.
    r, u, y : str, optional
        Names of the columns; r by default if there is a column so called.
    time : str, optional
        Name of the time column [s]; by default one called t, time or the like.
    dt : float, optional
        Sampling period [s], for a file without time.
    extra : sequence of str, optional
        Further columns to keep; by default all others of a file that ctrlid wrote, else none.
    units : mapping, optional
        Units, by signal; units in brackets in the header are read.
    hold, name : str, optional
        As in `Record`.
    gaps : {"error", "mask"}, optional
        Whether missing samples are refused, or filled with the last value and marked as not
        valid.

    Returns
    -------
    dict
        Arguments of `Record`.

    Raises
    ------
    CtrlidError
        If a column is missing, the time does not increase or samples are missing.
    """
    if gaps not in ("error", "mask"):
        raise CtrlidError(f"gaps must be 'error' or 'mask'; given {gaps!r}")
    comments, header, table, found = _read_table(Path(path))
    columns = dict(zip(header, table.T, strict=True))
    own = "dt" in comments
    named = {k: v.strip("[]") for k, v in found.items()}

    def column(label: str, what: str) -> Any:
        if label not in columns:
            raise CtrlidError(f"{path} has no column {label!r} for {what}; its columns are "
                              f"{', '.join(header)}. Name the right one with {what}=")  # fmt: skip
        return columns[label]

    data = {"u": column(u, "u"), "y": column(y, "y")}
    sources = {"u": u, "y": y}
    if r is not None or "r" in columns:
        sources["r"] = r or "r"
        data["r"] = column(sources["r"], "r")
    clock = time or next((t for t in TIME if t in columns), None)
    taken = {*sources.values(), clock, "valid"}
    keep = [c for c in header if c not in taken] if extra is None and own else list(extra or ())
    channels = {c: column(c, "extra") for c in keep}
    valid = columns["valid"] > 0.5 if "valid" in columns else np.ones(len(table), dtype=bool)
    start = float(comments.get("start", 0.0))
    if own and dt is None:
        dt = float(comments["dt"])
        clock = None  # the comment is exact, the column is for people
    if clock is not None:
        stamps = column(clock, "time")
        period, index = _uniform(stamps, dt, gaps, str(path))
        dt, start = period, float(stamps[0])
        if len(index) != len(stamps):
            fresh = np.diff(index, prepend=-1) > 0
            valid = valid[index] & fresh
            data = {k: v[index] for k, v in data.items()}
            channels = {k: v[index] for k, v in channels.items()}
    if dt is None:
        raise CtrlidError(f"{path} has no time column ({', '.join(TIME)}); its columns are "
                          f"{', '.join(header)}. Give time= or dt=")  # fmt: skip
    read = {k: named[s] for k, s in (*sources.items(), *((c, c) for c in keep)) if s in named}
    names = {k: s for k, s in sources.items() if s != k}
    names |= {k[8:]: v for k, v in comments.items() if k.startswith("name of ")}
    return {
        **data, "dt": dt, "start": start, "extra": channels, "valid": valid, "names": names,
        "units": {**read, **(units or {})}, "hold": hold or comments.get("hold", "zoh"),
        "name": Path(path).stem if name is None and not own else (name or comments.get("name", "")),
    }  # fmt: skip


def _read_table(path: Path) -> tuple[dict[str, str], list[str], Any, dict[str, str]]:
    """Return comments, column names, values and the units found in the header."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            comments, skip = {}, 0
            line = file.readline()
            while line.startswith("#") or (line and not line.strip()):
                key, equals, value = line[1:].partition("=")
                if equals:
                    comments[key.strip()] = value.strip()
                line, skip = file.readline(), skip + 1
    except OSError as reason:
        raise CtrlidError(f"cannot read {path}: {reason.strerror}") from reason
    separator = max(",;\t", key=line.count)
    cells = [c.strip().strip('"') for c in line.rstrip("\n").split(separator)]
    units = {}
    labels = []
    for cell in cells:
        label, bracket, unit = cell.partition("[")
        label = label.strip()
        labels.append(label)
        if bracket:
            units[label] = unit.rstrip("] ")
    if _is_number(cells[0]):
        raise CtrlidError(f"{path} has no header line: its first line is {line.strip()!r}. Add one "
                          "with the names of the columns, such as t,r,u,y")  # fmt: skip
    try:
        table = np.loadtxt(path, delimiter=separator, skiprows=skip + 1, ndmin=2, encoding="utf-8-sig")
    except ValueError as reason:
        raise CtrlidError(f"{path} is not a table of numbers: {reason}") from reason
    if table.shape[1] != len(labels):
        raise CtrlidError(f"{path} names {len(labels)} columns but has {table.shape[1]}")
    return comments, labels, table, units


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _uniform(stamps: Any, dt: float | None, gaps: str, path: str) -> tuple[float, Any]:
    """Return the period of time stamps and, for each uniform sample, its row."""
    steps = np.diff(stamps)
    if len(steps) == 0 or not np.isfinite(stamps).all():
        raise CtrlidError(f"the time column of {path} needs at least 2 finite values")
    back = np.flatnonzero(steps <= 0)
    if back.size:
        k = int(back[0])
        raise CtrlidError(f"the time column of {path} does not increase: {stamps[k]:g} s is followed "
                          f"by {stamps[k + 1]:g} s at row {k + 1}. Sort the rows, or cut at the "
                          "restart of the clock")  # fmt: skip
    usual = float(np.median(steps))
    regular = steps[steps < GAP * usual]
    period = dt or float(np.mean(regular))
    # Stamps printed with few digits show steps of one digit; the grid itself is then regular.
    missing = np.round(steps / period).astype(int) - 1
    missing[steps < GAP * period] = 0
    where = np.flatnonzero(missing)
    if where.size and gaps == "error":
        k = int(where[np.argmax(missing[where])])
        raise CtrlidError(
            f"{path} lacks {missing.sum()} samples in {where.size} places, the longest gap "
            f"{steps[k]:.4g} s after t = {stamps[k]:.6g} s at a period of {period:.4g} s. Give "
            "gaps='mask' to fill them with the last value and mark them as not valid"
        )
    if not where.size and dt is None:
        period = float((stamps[-1] - stamps[0]) / len(steps))
    jitter = float(np.max(np.abs(regular - period))) / period
    digits = np.spacing(np.abs(stamps).max()) / period
    if jitter > JITTER + 4 * digits:
        warnings.warn(
            f"the time stamps of {path} jitter by up to {100 * jitter:.0f} % of the period "
            f"{period:.4g} s; they are taken as uniform. If the samples really were taken "
            "unevenly, resample them first", CtrlidWarning, stacklevel=5,
        )  # fmt: skip
    return period, np.repeat(np.arange(len(stamps)), np.concatenate([missing, [0]]) + 1)
