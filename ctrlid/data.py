"""Record: one experiment in one loop, measured or simulated."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, get_args

import control as ct
import numpy as np
from scipy import signal

from . import _csv
from .errors import CtrlidError

Hold = Literal["zoh", "foh"]
SIGNALS = ("r", "u", "y")


def _samples(name: str, values: Any) -> Any:
    """Copy a signal to a read-only (n,) float array, or say what is wrong with it."""
    array = np.asarray(values)
    if array.dtype.kind not in "fiub":
        raise CtrlidError(f"{name} must be an array of real numbers; given {array.dtype} data")
    if array.ndim != 1:
        raise CtrlidError(
            f"{name} must be one-dimensional with one value per sample; given shape {array.shape}. "
            "Pick one channel, for instance data[:, 0]"
        )
    array = np.array(array, dtype=float)
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise CtrlidError(
            f"{name} has {bad.size} values that are NaN or infinite, the first at sample "
            f"{bad[0]}. Cut them out by slicing, or fill them and mark the samples in valid="
        )
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False, kw_only=True)
class Record:
    """Reference, input and output of one experiment, sampled together.

    At sample k the output ``y[k]`` is measured, then ``u[k]`` is computed and applied until sample
    k+1: ``y[k]`` depends on ``u[k-1]`` and earlier. All values are absolute and in SI units, or
    volts as logged. The arrays are copies and read-only.

    Parameters
    ----------
    u, y : array_like, shape (n,)
        Input and output [physical units].
    dt : float
        Sampling period [s].
    r : array_like, shape (n,), optional
        Reference [output unit], if it was logged.
    hold : {"zoh", "foh"}, optional
        How u runs between samples: held, as a digital controller does, or straight, as a smooth
        analog signal nearly does.
    extra : mapping of str to array_like, optional
        Further measured channels, for instance a coil current.
    valid : array_like of bool, shape (n,), optional
        Which samples count in fits and comparisons; by default all.
    names : mapping, optional
        Names of the signals ``"r"``, ``"u"``, ``"y"``, for labels.
    units : mapping, optional
        Units of ``"r"``, ``"u"``, ``"y"`` and of the extra channels.
    name : str, optional
        Name of the experiment.
    start : float, optional
        Time of sample 0 [s].

    Raises
    ------
    CtrlidError
        If the data are not finite, not one-dimensional, of different lengths or too few, or a word
        is unknown.

    Examples
    --------
    >>> import ctrlid as cid
    >>> record = cid.Record(r=[1, 1, 1], u=[0.5, 0.4, 0.4], y=[0, 0.3, 0.5], dt=0.1)
    >>> record.duration, len(record[1:])
    (0.30000000000000004, 2)
    """

    u: Any
    y: Any
    dt: float
    r: Any = None
    hold: Hold = "zoh"
    extra: Mapping[str, Any] = field(default_factory=dict)
    valid: Any = None
    names: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    name: str = ""
    start: float = 0.0

    def __post_init__(self) -> None:
        signals = {k: _samples(k, getattr(self, k)) for k in SIGNALS if getattr(self, k) is not None}
        for key in ("u", "y"):
            if key not in signals:
                raise CtrlidError(f"a record needs u and y; {key} is None")
        extra = {str(k): _samples(f"extra[{k!r}]", v) for k, v in dict(self.extra).items()}
        clash = [k for k in extra if k in (*SIGNALS, "t", "time", "valid")]
        if clash:
            raise CtrlidError(f"extra channels cannot be called {clash}: these names are taken")
        sizes = {k: v.size for k, v in (*signals.items(), *extra.items())}
        if len(set(sizes.values())) > 1:
            raise CtrlidError(f"all signals must be equally long; given "
                              f"{', '.join(f'{k}: {n}' for k, n in sizes.items())}")  # fmt: skip
        n = signals["y"].size
        if n < 2:
            raise CtrlidError(f"a record needs at least 2 samples; given {n}")
        if not (isinstance(self.dt, int | float | np.number) and np.isfinite(self.dt) and self.dt > 0):
            raise CtrlidError(f"dt is the sampling period in seconds, > 0; given {self.dt!r}")
        if self.hold not in get_args(Hold):
            raise CtrlidError(f"hold must be 'zoh' (held between samples) or 'foh' (straight); "
                              f"given {self.hold!r}")  # fmt: skip
        valid = np.ones(n, dtype=bool) if self.valid is None else np.array(self.valid)
        if valid.dtype != bool or valid.shape != (n,):
            raise CtrlidError(f"valid must be {n} booleans, one per sample; given {valid.dtype} of "
                              f"shape {valid.shape}")  # fmt: skip
        if not np.isfinite(self.start):
            raise CtrlidError(f"start is the time of sample 0 in seconds; given {self.start!r}")
        for words, allowed in ((self.names, SIGNALS), (self.units, (*SIGNALS, *extra))):
            unknown = [k for k in words if k not in allowed]
            if unknown:
                raise CtrlidError(f"names and units are given for signals of the record; unknown "
                                  f"{unknown}, known {list(allowed)}")  # fmt: skip
        valid.setflags(write=False)
        for key, value in {
            **{k: signals.get(k) for k in SIGNALS}, "extra": MappingProxyType(extra),
            "valid": valid, "dt": float(self.dt), "start": float(self.start),
            "names": MappingProxyType(dict(self.names)), "units": MappingProxyType(dict(self.units)),
        }.items():  # fmt: skip
            object.__setattr__(self, key, value)

    def __len__(self) -> int:
        return int(self.y.size)

    def __reduce__(self) -> Any:
        # A mapping proxy cannot be pickled.
        fields = {k: getattr(self, k) for k in self.__dataclass_fields__}
        plain = {k: dict(v) if isinstance(v, MappingProxyType) else v for k, v in fields.items()}
        return _rebuild, (plain,)

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self)

    @property
    def t(self) -> Any:
        """Time of each sample [s]."""
        return self.start + self.dt * np.arange(len(self))

    @property
    def duration(self) -> float:
        """Number of samples times the sampling period [s]."""
        return len(self) * self.dt

    def _map(self, change: Any, **fields: Any) -> "Record":
        """Apply a change to every channel."""
        return replace(
            self,
            **{k: change(getattr(self, k)) for k in SIGNALS if getattr(self, k) is not None},
            extra={k: change(v) for k, v in self.extra.items()},
            **fields,
        )

    def __getitem__(self, index: slice) -> "Record":
        if not isinstance(index, slice):
            raise CtrlidError(f"a record is sliced by samples, record[100:2000]; given {index!r}. "
                              "Single values are in record.y and the other arrays")  # fmt: skip
        if index.step not in (None, 1):
            raise CtrlidError(f"a step of {index.step} would alias; use record.decimate({index.step})")
        start, stop, _ = index.indices(len(self))
        if stop - start < 2:
            raise CtrlidError(f"the slice {start}:{stop} of {len(self)} samples leaves fewer than 2")
        return self._map(lambda s: s[start:stop], valid=self.valid[start:stop],
                         start=self.start + start * self.dt)  # fmt: skip

    def between(self, t0: float, t1: float) -> "Record":
        """Return the samples with ``t0 <= t < t1``.

        Parameters
        ----------
        t0, t1 : float
            Times on the record's own clock [s].

        Returns
        -------
        Record
            The part.

        Raises
        ------
        CtrlidError
            If fewer than 2 samples lie between.
        """
        # A sample that round-off puts a hair before t0 belongs to it.
        first, last = (int(np.ceil((t - self.start) / self.dt - 1e-6)) for t in (t0, t1))
        if min(last, len(self)) - max(first, 0) < 2:
            raise CtrlidError(
                f"fewer than 2 samples lie between {t0:g} and {t1:g} s; the record runs from "
                f"{self.start:g} to {self.start + self.duration:g} s"
            )
        return self[max(first, 0) : last]

    def split(self, *fractions: float) -> tuple["Record", ...]:
        """Cut the record in time order, by default into halves.

        Parameters
        ----------
        *fractions : float
            Where to cut, as increasing fractions of the length between 0 and 1.

        Returns
        -------
        tuple of Record
            One part more than there are fractions.

        Raises
        ------
        CtrlidError
            If the fractions are not increasing between 0 and 1.
        """
        cuts = fractions or (0.5,)
        edges = np.array([0.0, *cuts, 1.0])
        if np.any(np.diff(edges) <= 0):
            raise CtrlidError(f"split takes increasing fractions between 0 and 1; given {cuts}")
        at = np.round(edges * len(self)).astype(int)
        return tuple(self[a:b] for a, b in zip(at[:-1], at[1:], strict=True))

    def decimate(self, q: int, antialias: bool = True) -> "Record":
        """Return the record at q times the sampling period.

        Every channel passes the same zero-phase low-pass filter, so that nothing folds down and the
        channels keep their relation. What is held at the fast rate is no longer held exactly at
        the slow one. Samples near the ends, and near samples that do not count, do not count.

        Parameters
        ----------
        q : int
            Factor.
        antialias : bool, optional
            False takes every q-th sample, as a slower recorder would have.

        Returns
        -------
        Record
            The slower record.

        Raises
        ------
        CtrlidError
            If q is no positive integer or leaves too few samples.
        """
        if int(q) != q or q < 1 or len(self) < 2 * q:
            raise CtrlidError(f"decimate needs a whole factor from 1 to {len(self) // 2}; given {q!r}")
        q = int(q)
        if q == 1:
            return self
        if not antialias:
            return self._map(lambda s: s[::q], valid=self.valid[::q], dt=self.dt * q)
        half = 10 * q
        taps = signal.firwin(2 * half + 1, 1.0 / q, window="hamming")
        taps /= taps.sum()

        def filtered(s: Any) -> Any:
            # Odd reflection at the ends continues slopes; a constant stays exactly what it is.
            around = s[0]
            return around + signal.fftconvolve(_reflect(s - around, half), taps, "valid")[::q]

        ok = np.lib.stride_tricks.sliding_window_view(np.pad(self.valid, half), 2 * half + 1)
        return self._map(filtered, valid=ok.all(axis=1)[::q], dt=self.dt * q)

    def with_input(self, channel: str) -> "Record":
        """Return the record with an extra channel as input; the old input becomes an extra one.

        Parameters
        ----------
        channel : str
            Name of the extra channel, for instance ``"current"``.

        Returns
        -------
        Record
            The same experiment.

        Raises
        ------
        CtrlidError
            If there is no such channel.
        """
        return self._swap("u", channel)

    def with_output(self, channel: str) -> "Record":
        """Return the record with an extra channel as output; the old output becomes an extra one.

        Parameters
        ----------
        channel : str
            Name of the extra channel.

        Returns
        -------
        Record
            The same experiment.

        Raises
        ------
        CtrlidError
            If there is no such channel.
        """
        return self._swap("y", channel)

    def _swap(self, key: str, channel: str) -> "Record":
        if channel not in self.extra:
            raise CtrlidError(f"the record has no extra channel {channel!r}; it has {list(self.extra)}")
        old = self.names.get(key, {"u": "input", "y": "output"}[key])
        extra = {**{k: v for k, v in self.extra.items() if k != channel}, old: getattr(self, key)}
        units = {k: v for k, v in self.units.items() if k not in (key, channel)}
        if key in self.units:
            units[old] = self.units[key]
        if channel in self.units:
            units[key] = self.units[channel]
        return replace(self, **{key: self.extra[channel]}, extra=extra, units=units,
                       names={**self.names, key: channel})  # fmt: skip

    def segments(self) -> list[tuple[int, int]]:
        """Return the (start, stop) sample indices of the stretches that count.

        Returns
        -------
        list of (int, int)
            Half-open index pairs in time order.
        """
        edges = np.flatnonzero(np.diff(np.concatenate([[0], self.valid.astype(int), [0]])))
        return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]

    @classmethod
    def from_csv(cls, path: str | Path, **options: Any) -> "Record":
        """Read a record from a CSV file; see `read_csv` for the options.

        Parameters
        ----------
        path : str or path
            The file.
        **options
            Options of `read_csv`.

        Returns
        -------
        Record
            The record.
        """
        return cls(**_csv.read_csv(path, **options))

    def to_csv(self, path: str | Path) -> None:
        """Write the record to a CSV file that `from_csv` reads back exactly.

        Parameters
        ----------
        path : str or path
            The file.
        """
        _csv.write_csv(path, self)

    @classmethod
    def from_response(
        cls, response: Any, *, r: str | None = None, u: str | None = None, y: str | None = None,
        **fields: Any,
    ) -> "Record":  # fmt: skip
        """Make a record of a `control.TimeResponseData`.

        Parameters
        ----------
        response : control.TimeResponseData
            A single response, uniformly sampled.
        r, u, y : str, optional
            Labels of the reference, input and output among the response's inputs and outputs. By
            default the signals so labelled, else the only input as u and the only output as y.
        **fields
            Further fields of the record, such as ``hold``, ``names``, ``units``.

        Returns
        -------
        Record
            The record.

        Raises
        ------
        CtrlidError
            If a signal is not there or the time is not uniform.
        """
        if response.ntraces > 1:
            raise CtrlidError(f"a record is one experiment; the response has {response.ntraces} "
                              "traces, take one of them")  # fmt: skip
        shape = (-1, len(response.time))
        table = {}
        for labels, values in ((response.input_labels, response.u), (response.output_labels, response.y)):
            if values is not None:
                table.update(zip(labels or [], np.reshape(values, shape), strict=False))
        outputs, inputs = list(response.output_labels or []), list(response.input_labels or [])
        default = {"r": "r" if "r" in table else None,
                   "u": "u" if "u" in table else (inputs[0] if len(inputs) == 1 else None),
                   "y": "y" if "y" in table else (outputs[0] if len(outputs) == 1 else None)}  # fmt: skip
        chosen = {k: v or default[k] for k, v in (("r", r), ("u", u), ("y", y))}
        for key, label in chosen.items():
            if (label is None and key != "r") or (label is not None and label not in table):
                raise CtrlidError(f"say which signal is {key}: the response has {list(table)}; "
                                  f"given {label!r}")  # fmt: skip
        steps = np.diff(response.time)
        dt = float(np.median(steps))
        if np.any(np.abs(steps - dt) > 1e-6 * dt):
            raise CtrlidError("a record is sampled uniformly, but the times of the response are not; "
                              "compute it at np.arange(n) * dt")  # fmt: skip
        names = {k: v for k, v in chosen.items() if v is not None and v != k}
        fields = {"names": names, "start": float(response.time[0]), **fields}
        return cls(dt=dt, **{k: table[v] for k, v in chosen.items() if v is not None}, **fields)

    def to_response(self) -> Any:
        """Return a `control.TimeResponseData` with output y and inputs u and, if any, r.

        Returns
        -------
        control.TimeResponseData
            The same samples.
        """
        inputs = {self.names.get(k, k): getattr(self, k) for k in ("u", "r")
                  if getattr(self, k) is not None}  # fmt: skip
        return ct.TimeResponseData(
            self.t, np.array(self.y)[None, :], inputs=np.array(list(inputs.values())),
            output_labels=[self.names.get("y", "y")], input_labels=list(inputs),
            sysname=self.name or None,
        )  # fmt: skip

    def __repr__(self) -> str:
        rows = [f"Record {self.name + ': ' if self.name else ''}{len(self)} samples at "
                f"{self.dt:g} s ({self.duration:.4g} s, {self.hold})"]  # fmt: skip
        if not self.valid.all():
            rows[0] += f", {100 * self.valid.mean():.1f} % valid"
        channels = [(k, getattr(self, k)) for k in SIGNALS if getattr(self, k) is not None]
        for key, values in (*channels, *self.extra.items()):
            label = self.names.get(key, key)
            label = key if label == key else f"{key} ({label})"
            unit = self.units.get(key, "")
            rows.append(f"  {label:<14} {values.min():.6g} .. {values.max():.6g} {unit}".rstrip())
        return "\n".join(rows)


def _rebuild(fields: dict[str, Any]) -> Record:
    return Record(**fields)


def _reflect(s: Any, width: int) -> Any:
    """Extend a signal by odd reflection at both ends, by constants where it is too short."""
    reach = min(width, len(s) - 1)
    extended = np.concatenate([2 * s[0] - s[reach:0:-1], s, 2 * s[-1] - s[-2 : -reach - 2 : -1]])
    return np.pad(extended, width - reach, mode="edge")


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
        If something else is among them, or sampling period or hold differ.
    """
    records = (data,) if isinstance(data, Record) else data
    if not isinstance(records, Sequence) or not records or not all(
        isinstance(r, Record) for r in records
    ):
        raise CtrlidError(f"a fit takes a Record or a list of Records; given {type(data).__name__}. "
                          "Make one with Record(u=, y=, dt=) or Record.from_csv(path)")  # fmt: skip
    kinds = {(r.dt, r.hold) for r in records}
    if len(kinds) > 1:
        raise CtrlidError(f"records fitted together need one sampling period and hold; given "
                          f"{sorted(kinds)}")  # fmt: skip
    return tuple(records)
