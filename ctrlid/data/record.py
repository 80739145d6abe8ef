"""Record: one experiment in one loop, measured or simulated."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from numbers import Integral
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, Self, get_args

import numpy as np
from scipy import signal

from .._base.arguments import check_arguments, explain_fields
from .._base.arrays import read_only
from .._base.errors import CtrlidError
from .._base.signals import list_signals, require_one_signal
from .._base.text import Printed, list_known, write_count, write_percent, write_time
from . import csv_files as _csv
from . import responses as _response
from .csv_files import SIGNALS as SIGNALS
from .field_checks import check_samples, check_seconds, check_words
from .validity import find_last_valid, find_runs, find_whole_past

Hold = Literal["zoh", "foh", "bandlimited"]
# Columns of a CSV file have these names, so that no extra channel may.
RESERVED = (*SIGNALS, "t", "time", "valid")


@explain_fields
@dataclass(frozen=True, eq=False, kw_only=True)
class Record(Printed):
    """Reference, input and output of one experiment, sampled together.

    At sample k the output ``y[k]`` is measured, then ``u[k]`` is computed and applied until sample
    k+1: ``y[k]`` depends on ``u[k-1]`` and earlier. All values are absolute and in SI units, or
    volts as logged. The arrays are copies and read-only.

    Parameters
    ----------
    u, y : array_like, shape (n,) or (signals, n)
        Input and output [physical units]; several signals of either, one in a row.
    dt : float
        Sampling period [s].
    r : array_like, shape (n,) or (signals, n), optional
        Reference [output unit], if it was logged.
    hold : {"zoh", "foh", "bandlimited"}, optional
        How u runs between samples: held, as a digital controller does; straight, as a smooth
        analog signal nearly does; or as the samples of a measured signal say that has nothing above
        half the sampling rate, which takes later samples and so holds only where u does not react
        to y.
    extra : mapping of str to array_like, optional
        Further measured channels [as in `units`], for instance a coil current.
    valid : array_like of bool, shape (n,) or (outputs, n), optional
        Which samples count in fits and comparisons; by default all. With a row for each output
        only that reading is left out.
    names : mapping, optional
        Names of the signals ``"r"``, ``"u"``, ``"y"``; a tuple for several.
    units : mapping, optional
        Units of ``"r"``, ``"u"``, ``"y"`` and of the extra channels; a tuple for several, or one
        for all of them.
    name : str, optional
        Name of the experiment.
    start : float, optional
        Time of sample 0 [s].
    hold_r : {"zoh", "foh"}, optional
        How r runs between samples, which counts where an analog controller sees it: held, or
        straight, as in a simulation of python-control.

    Raises
    ------
    CtrlidError
        If the data are not finite, of the wrong shape, of different lengths or too few, or a word
        is unknown.

    Examples
    --------
    >>> import ctrlid as cid
    >>> record = cid.Record(r=[1, 1, 1], u=[0.5, 0.4, 0.4], y=[0, 0.3, 0.5], dt=0.1)
    >>> record.duration, len(record[1:])
    (0.30000000000000004, 2)
    >>> both = cid.Record(u=[0.5, 0.4, 0.4], y=[[0, 0.3, 0.5], [0, 0.1, 0.2]], dt=0.1,
    ...                   names={"u": "F", "y": ("x", "theta")}, units={"y": ("m", "rad")})
    >>> both.select(y="theta").y
    array([0. , 0.1, 0.2])
    """

    u: Any
    y: Any
    dt: float
    r: Any = None
    hold: Hold = "zoh"
    extra: Mapping[str, Any] = field(default_factory=dict)
    valid: Any = None
    names: Mapping[str, Any] = field(default_factory=dict)
    units: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""
    start: float = 0.0
    hold_r: Literal["zoh", "foh"] = "zoh"

    def __new__(cls, *values: Any, **fields: Any) -> Self:
        """Refuse unnamed and unknown fields, before the generated constructor does so curtly."""
        if values:
            raise CtrlidError(
                "the fields of a record are named, because r, u and y look alike: "
                f"Record(r=..., u=..., y=..., dt=...); given {write_count(len(values), 'value')} "
                "without a name"
            )
        if "t" in fields:
            raise CtrlidError(_write_no_instants(fields["t"]))
        return super().__new__(cls)

    def __post_init__(self) -> None:
        given = {k: getattr(self, k) for k in SIGNALS}
        for key in ("u", "y"):
            if given[key] is None:
                raise CtrlidError(f"a record needs u and y; {key} is None")
        signals = {k: check_samples(k, v, True) for k, v in given.items() if v is not None}
        if not isinstance(self.extra, Mapping):
            raise CtrlidError(f"extra maps names to channels, as in {{'current': i}}; given "
                              f"{type(self.extra).__name__}")  # fmt: skip
        clash = [k for k in self.extra if not isinstance(k, str) or not k or k in RESERVED]
        if clash:
            raise CtrlidError(f"extra channels need names other than {', '.join(RESERVED)}; given "
                              f"{clash}")  # fmt: skip
        extra = {k: check_samples(f"extra[{k!r}]", v) for k, v in self.extra.items()}
        sizes = {k: v.shape[-1] for k, v in (*signals.items(), *extra.items())}
        if len(set(sizes.values())) > 1:
            lengths = ", ".join(f"{k}: {n}" for k, n in sizes.items())
            raise CtrlidError(f"all signals must be equally long; given {lengths}. Cut them to the "
                              "samples they have in common")  # fmt: skip
        n = signals["y"].shape[-1]
        counts = {k: len(v) if v.ndim == 2 else 1 for k, v in signals.items()}
        if n < 2:
            raise CtrlidError(f"a record needs at least 2 samples; given {n}")
        dt = check_seconds("dt is the sampling period", self.dt)
        if dt <= 0:
            raise CtrlidError(f"dt is the sampling period in seconds, > 0; given {self.dt!r}")
        if not isinstance(self.hold, str) or self.hold not in get_args(Hold):
            raise CtrlidError(f"hold must be 'zoh' (held between samples), 'foh' (straight) or "
                              f"'bandlimited'; given {self.hold!r}")  # fmt: skip
        if self.hold_r not in ("zoh", "foh"):
            raise CtrlidError(f"hold_r must be 'zoh' (held between samples) or 'foh' (straight); "
                              f"given {self.hold_r!r}")  # fmt: skip
        if np.ma.is_masked(self.valid):
            raise CtrlidError("valid is a masked array, and a record would use its masked values: "
                              "give valid.filled(False)")  # fmt: skip
        try:
            valid = np.ones(n, dtype=bool) if self.valid is None else np.array(self.valid)
        except ValueError as reason:
            raise CtrlidError(f"valid must be {n} booleans; {reason}") from reason
        several = (counts["y"], n) if counts["y"] > 1 else (n,)
        if valid.dtype != bool or valid.shape not in ((n,), several):
            rows = f", or {counts['y']} rows of them" if counts["y"] > 1 else ""
            raise CtrlidError(
                f"valid must be {n} booleans, one per sample{rows}; given {valid.dtype} of shape "
                f"{valid.shape}. A comparison makes booleans, as in y > 0"
            )
        if not isinstance(self.name, str):
            raise CtrlidError(f"name is the experiment's name in words; given {self.name!r}")
        valid.setflags(write=False)
        for key, value in {
            **signals, "extra": MappingProxyType(extra), "valid": valid, "dt": dt,
            "start": check_seconds("start is the time of sample 0", self.start),
            "names": check_words("names", self.names, SIGNALS, counts),
            "units": check_words("units", self.units, (*SIGNALS, *extra), counts),
        }.items():  # fmt: skip
            object.__setattr__(self, key, value)

    def __len__(self) -> int:
        return int(self.y.shape[-1])

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
    def signals(self) -> Mapping[str, tuple[str, ...]]:
        """The names of the signals of r, u and y; without names ``y``, or ``y[0], y[1], ...``."""
        given = {k: v for k in SIGNALS if (v := getattr(self, k)) is not None}
        return {k: list_signals(k, self.names.get(k), v.shape[0] if v.ndim == 2 else 1)
                for k, v in given.items()}  # fmt: skip

    @property
    def valid_outputs(self) -> Any:
        """Which readings count, with a row for each output, shape (outputs, n)."""
        return np.broadcast_to(self.valid, (len(self.signals["y"]), len(self)))

    @property
    def valid_samples(self) -> Any:
        """Which samples count for all outputs, shape (n,)."""
        return self.valid if self.valid.ndim == 1 else self.valid.all(axis=0)

    @property
    def valid_somewhere(self) -> Any:
        """Which samples count for one output at least, shape (n,)."""
        return self.valid if self.valid.ndim == 1 else self.valid.any(axis=0)

    def select(
        self, *, r: str | Sequence[str] | None = None, u: str | Sequence[str] | None = None,
        y: str | Sequence[str] | None = None,
    ) -> "Record":  # fmt: skip
        """Return the record with some of its signals only.

        Parameters
        ----------
        r, u, y : str or sequence of str, optional
            Names of the signals to keep, as in `signals`; by default all.

        Returns
        -------
        Record
            The same experiment.

        Raises
        ------
        CtrlidError
            If the record has no such signal.
        """
        check_arguments(Record.select, locals())
        fields: dict[str, Any] = {}
        names, units = dict(self.names), dict(self.units)
        for key, wanted in (("r", r), ("u", u), ("y", y)):
            if wanted is None:
                continue
            known = self.signals.get(key, ())
            wanted = (wanted,) if isinstance(wanted, str) else tuple(wanted)
            missing = [name for name in wanted if name not in known]
            if missing or not wanted:
                first = missing[0] if missing else ""
                raise CtrlidError(
                    f"the record has no signal {first!r} in {key}; {list_known(first, known)}"
                )
            at = [known.index(name) for name in wanted]
            fields[key] = np.reshape(getattr(self, key), (len(known), -1))[at]
            for labels in (names, units):
                if key in labels:
                    each = list_signals(key, labels[key], len(known))
                    labels[key] = tuple(each[k] for k in at)
            if key == "y" and self.valid.ndim == 2:
                fields["valid"] = self.valid[at] if len(at) > 1 else self.valid[at[0]]
        return replace(self, **fields, names=names, units=units)

    @property
    @read_only
    def t(self) -> Any:
        """Time of each sample [s]."""
        return self.start + self.dt * np.arange(len(self))

    @property
    def duration(self) -> float:
        """Number of samples times the sampling period [s]."""
        return len(self) * self.dt

    def _change_channels(self, change: Any, **fields: Any) -> "Record":
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
            raise CtrlidError(f"a step of {index.step} would alias; use record.decimate(q), with "
                              "antialias=False if that is what you want")  # fmt: skip
        if not all(k is None or isinstance(k, Integral) for k in (index.start, index.stop)):
            raise CtrlidError(f"a record is sliced by whole sample numbers; given {index}. By "
                              "seconds it is cut with record.between(t0, t1)")  # fmt: skip
        start, stop, _ = index.indices(len(self))
        if stop - start < 2:
            raise CtrlidError(f"a record needs at least 2 samples; the slice {start}:{stop} of "
                              f"{len(self)} leaves {max(stop - start, 0)}")  # fmt: skip
        return self._change_channels(lambda s: s[..., start:stop],
                         valid=self.valid[..., start:stop],
                         start=self.start + start * self.dt)  # fmt: skip

    def between(self, t0: float, t1: float) -> "Record":
        """Return the samples with ``t0 <= t < t1``.

        Parameters
        ----------
        t0, t1 : float
            Times on the record's own clock [s]; ``np.inf`` means to the end.

        Returns
        -------
        Record
            The part.

        Raises
        ------
        CtrlidError
            If fewer than 2 samples lie between.
        """
        check_arguments(Record.between, locals())
        if not t0 < t1:
            raise CtrlidError(f"between needs t0 < t1 in seconds; given {t0!r} and {t1!r}")
        # A sample that round-off puts a hair before t0 belongs to it.
        slack = 1e-6 + 4 * float(np.spacing(abs(self.start) + self.duration)) / self.dt
        first, last = (
            int(np.ceil(np.clip((t - self.start) / self.dt - slack, 0, len(self))))
            for t in (t0, t1)
        )
        if last - first < 2:
            raise CtrlidError(
                f"fewer than 2 samples lie between {t0:g} and {t1:g} s; the record runs from "
                f"{write_time(self.start, self.dt)} to "
                f"{write_time(self.start + self.duration, self.dt)} s"
            )
        return self[first:last]

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
        check_arguments(Record.split, locals())
        cuts = fractions or (0.5,)
        edges = np.array([0.0, *cuts, 1.0])
        if not np.all(np.diff(edges) > 0):
            raise CtrlidError(f"split takes increasing fractions between 0 and 1; given {cuts}")
        at = np.round(edges * len(self)).astype(int)
        return tuple(self[a:b] for a, b in pairwise(at))

    def decimate(self, q: int, antialias: bool = True) -> "Record":
        """Return the record at q times the sampling period.

        Every channel passes the same zero-phase FIR filter, so that the channels keep their
        relation. It passes what is below two thirds of the new Nyquist frequency and takes 50 dB
        off what is above the new Nyquist frequency. A sample counts only where all 20 q + 1
        samples under the filter count, which costs 10 slow samples at either end. An input that
        was held is smooth afterwards, so `hold` becomes ``"foh"``; a band-limited one stays so.
        This is for `fit_arx`, with ``nk=0`` and one b more, as u then acts without delay. `fit_iv`
        and `fit_continuous` take the record as it was logged, whose u is held, at any short period.

        Parameters
        ----------
        q : int
            Factor.
        antialias : bool, optional
            False takes every q-th sample: what a slower recorder would have logged. What u did in
            between is lost, and `hold` is no longer true of it.

        Returns
        -------
        Record
            The slower record.

        Raises
        ------
        CtrlidError
            If q is no positive integer or leaves too few samples.

        Examples
        --------
        >>> import ctrlid as cid
        >>> record = cid.Record(u=[0.0] * 100, y=[1.0] * 100, dt=0.001)
        >>> slow = record.decimate(4)
        >>> len(slow), slow.dt, float(slow.y[0]), slow.segments()
        (25, 0.004, 1.0, [(10, 15)])
        """
        check_arguments(Record.decimate, locals(), "q")
        if not isinstance(q, Integral) or not 1 <= q <= len(self) // 2:
            raise CtrlidError(f"decimate needs a whole factor from 1 to {len(self) // 2} for "
                              f"{write_count(len(self), 'sample')}; given {q!r}")  # fmt: skip
        q = int(q)
        if q == 1:
            return self
        if not antialias:
            return self._change_channels(
                lambda s: s[..., ::q], valid=self.valid[..., ::q], dt=self.dt * q
            )
        half = 10 * q

        def passed(mask: Any) -> Any:
            return find_whole_past(np.pad(mask, half), 2 * half)[2 * half :: q]

        valid = np.apply_along_axis(passed, -1, self.valid)
        if not valid.any():
            longest = max((b - a for a, b in self.segments()), default=0)
            raise CtrlidError(
                f"decimate({q}) would leave no valid sample: its filter spans {2 * half + 1} "
                f"samples and the longest valid stretch has {longest}. Use a smaller factor, or "
                "antialias=False"
            )
        # The transition band of a Hamming window of this length is a third of the new Nyquist band.
        taps = signal.firwin(2 * half + 1, (1 - 1 / 6) / q, window="hamming")

        def filtered(s: Any) -> Any:
            # Filtering the deviation keeps constants exact; odd reflection continues slopes.
            around = np.pad(s - s[0], half, mode="reflect", reflect_type="odd")
            return s[0] + signal.fftconvolve(around, taps, "valid")[::q]

        # What was held is smooth afterwards, the reference as well.
        hold = "foh" if self.hold == "zoh" else self.hold
        return self._change_channels(
            lambda s: np.apply_along_axis(filtered, -1, s), valid=valid, dt=self.dt * q, hold=hold,
            hold_r="foh",
        )  # fmt: skip

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
        check_arguments(Record.with_input, locals())
        return self._swap_channels("u", channel)

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
        check_arguments(Record.with_output, locals())
        return self._swap_channels("y", channel)

    def _swap_channels(self, key: str, channel: str) -> "Record":
        require_one_signal({"u": "with_input", "y": "with_output"}[key], self)
        if channel not in self.extra:
            raise CtrlidError(
                f"the record has no extra channel {channel!r}; {list_known(channel, self.extra)}"
            )
        old = self.names.get(key, key)
        if old == key:
            old = {"u": "input", "y": "output"}[key]
        extra = {k: v for k, v in self.extra.items() if k != channel}
        if old in (*extra, *RESERVED):
            raise CtrlidError(
                f"the old {key} would be kept as the extra channel {old!r}, but that name is "
                f"taken; give it another name first, with names={{{key!r}: ...}}"
            )
        units = {k: v for k, v in self.units.items() if k not in (key, channel)}
        if key in self.units:
            units[old] = self.units[key]
        if channel in self.units:
            units[key] = self.units[channel]
        return replace(self, **{key: self.extra[channel]}, extra={old: getattr(self, key), **extra},
                       units=units, names={**self.names, key: channel})  # fmt: skip

    def segments(self) -> list[tuple[int, int]]:
        """Return the (start, stop) sample indices of the stretches that count.

        Returns
        -------
        list of (int, int)
            Half-open index pairs in time order.
        """
        return [(int(a), int(b)) for a, b in zip(*find_runs(self.valid_samples), strict=True)]

    @classmethod
    def from_csv(
        cls, path: str | Path, *, r: str | Sequence[str] | None = None,
        u: str | Sequence[str] = "u", y: str | Sequence[str] = "y",
        time: str | None = None, dt: float | None = None, extra: Sequence[str] | None = None,
        units: Mapping[str, str | Sequence[str]] | None = None, hold: Hold | None = None,
        name: str | None = None, gaps: Literal["error", "mask"] = "error",
        scale: Mapping[str, float] | None = None,
        names: Mapping[str, str | Sequence[str]] | None = None,
    ) -> "Record":  # fmt: skip
        """Read a record from a CSV file with a header line.

        Columns are separated by commas, semicolons or tabs; units are read from headers such as
        ``u [V]``, ``u (V)`` or ``u/V``. A column called valid tells which samples count. Columns
        that are not asked for may hold text.

        Parameters
        ----------
        path : str or path
            The file.
        r, u, y : str or sequence of str, optional
            Names of the columns, several for several signals, as in ``y=("theta", "alpha")``; r by
            default if there is a column so called. A file that `to_csv` wrote knows its own.
        time : str, optional
            Name of the time column; by default one called t, time, timestamp, seconds or Zeit, or,
            without `dt`, the only one with dates. Its unit is s unless the header says ms, us, min
            or h. Dates with a time, such as ``2026-11-27T10:00:00.250Z`` or ``2026-11-27
            10:00:00,250``, are read in seconds since the first row.
        dt : float, optional
            Sampling period [s]; by default that of the time column.
        extra : sequence of str, optional
            Further columns to keep; by default all others of a file that `to_csv` wrote, else none.
        units : mapping, optional
            Units instead of those in the header, by channel (r, u, y or one of `extra`; one unit
            for all its signals, or a tuple) or by the name of a signal or column.
        hold, name : str, optional
            As in `Record`; by default what `to_csv` wrote, else ``"zoh"`` and the file's name.
        gaps : {"error", "mask"}, optional
            Whether missing samples are refused, or filled with the last values and marked as not
            valid.
        scale : mapping of str to float, optional
            Factors of channels, for all signals of each, or of single signals or columns by name:
            a log in degrees becomes radians with
            ``scale={"r": np.pi / 180, "y": np.pi / 180}, units={"r": "rad", "y": "rad"}``, and two
            outputs in mm and degrees SI units with ``scale={"x": 1e-3, "phi": np.pi / 180}``. A
            scaled signal has the unit in `units`, and none without.
        names : mapping, optional
            What the signals are called, instead of their columns, by column or by channel:
            ``names={"Ball": "x", "Wippe": "theta"}`` or ``names={"y": ("x", "theta")}``. A loop
            of several signals finds them by the names in its plant.

        Returns
        -------
        Record
            The record.

        Warns
        -----
        CtrlidWarning
            If the times jitter by more than 1 % of the period, if they have no unit and are hardly
            in seconds, or if `units` contradicts the header and `scale` does not convert.

        Raises
        ------
        CtrlidError
            If the file is no table of numbers, a column is missing, the time does not increase or
            samples are missing.
        """
        check_arguments(Record.from_csv, locals(), "gaps")
        return cls(**_csv.read_csv(
            Path(path), {"r": r, "u": u, "y": y}, time, dt, extra, units, hold, name, gaps,
            scale, names,
        ))  # fmt: skip

    def to_csv(self, path: str | Path) -> None:
        """Write the record to a CSV file that `from_csv` reads back exactly.

        A comment line at the top holds what a table cannot: name, dt, hold and signal names.

        Parameters
        ----------
        path : str or path
            The file.

        Raises
        ------
        CtrlidError
            If a channel's name or unit cannot stand in a header line.
        """
        check_arguments(Record.to_csv, locals())
        try:
            _csv.write_csv(Path(path), self)
        except OSError as reason:
            raise CtrlidError(
                f"the record cannot be written to {path}: {reason.strerror}. Give a file in a "
                "folder that exists and may be written to"
            ) from reason

    @classmethod
    def from_response(
        cls, response: Any, *, r: str | Sequence[str] | None = None,
        u: str | Sequence[str] | None = None, y: str | Sequence[str] | None = None, **fields: Any,
    ) -> "Record":  # fmt: skip
        """Make a record of a `control.TimeResponseData`.

        python-control takes the inputs of a system in continuous time as straight between the
        samples. Where the states of the response show that, `hold` and `hold_r` are ``"foh"``.

        Parameters
        ----------
        response : control.TimeResponseData
            A single response, uniformly sampled.
        r, u, y : str or sequence of str, optional
            Labels of the reference, input and output among the response's inputs and outputs. By
            default the signals so labelled, else all other inputs as u and all other outputs as
            y.
        **fields
            Further fields of the record, such as ``hold``, ``names``, ``units``.

        Returns
        -------
        Record
            The record.

        Raises
        ------
        CtrlidError
            If a signal is not there, the time is not uniform or there are several traces.

        Examples
        --------
        >>> import control as ct
        >>> import ctrlid as cid
        >>> plant = ct.tf([1], [1, 1], inputs="force", outputs="speed")
        >>> response = ct.step_response(plant, timepts=[0, 0.5, 1.0])
        >>> cid.Record.from_response(response, units={"y": "m/s"})
        Record 3 samples at 0.5 s (1.5 s, zoh)
          u (force)  1 .. 1
          y (speed)  0 .. 0.632121 m/s
        """
        check_arguments(Record.from_response, locals())
        return cls(**{**_response.read_response(response, {"r": r, "u": u, "y": y}), **fields})

    def to_response(self) -> Any:
        """Return a `control.TimeResponseData` with output y and inputs u and, if any, r.

        The labels are the names with their units, as in ``position [m]``, or r, u and y. Extra
        channels, `valid` and `hold` have no place in a response.

        Returns
        -------
        control.TimeResponseData
            The same samples.
        """
        return _response.write_response(self)

    def __repr__(self) -> str:
        rows = [f"Record "
                f"{self.name + ': ' if self.name else ''}{write_count(len(self), 'sample')} at "
                f"{self.dt:g} s ({self.duration:.4g} s, {self.hold})"]  # fmt: skip
        if not self.valid.all():
            share = f"{100 * self.valid.mean():.1f} %"
            # Few among many would be rounded away.
            much = f"all but {np.sum(~self.valid)}" if share == "100.0 %" else share
            rows[0] += f", {much} valid; ranges of these:"
        channels = list_rows(self)
        numbered = [f"{k}[" for k, names in self.signals.items() if len(names) > 1]
        labels = [name if name == key or name.startswith(tuple(numbered)) else f"{key} ({name})"
                  for key, name, *_ in channels]  # fmt: skip
        width = max(map(len, labels))
        for label, (_, _, unit, _, counted) in zip(labels, channels, strict=True):
            rows.append(f"  {label:<{width}}  {counted.min():.6g} .. {counted.max():.6g} "
                        f"{'' if unit == '1' else unit}".rstrip())  # fmt: skip
        return "\n".join(rows)


def _write_no_instants(t: Any) -> str:
    """Say that samples have one period, and what that means for instants as uneven as given."""
    text = ("a Record has no t=: its samples are taken as evenly spaced by dt, with start= as the "
            "time of the first")  # fmt: skip
    try:
        steps = np.diff(np.asarray(t, dtype=float))
    except (TypeError, ValueError):
        steps = np.zeros(0)
    if steps.ndim != 1 or not steps.size or not np.all(np.isfinite(steps)):
        return f"{text}. Give dt="
    dt = float(np.mean(steps))
    if not dt > 0:
        return f"{text}; the times given do not increase. Sort the samples, and give dt="
    uneven = float(np.max(np.abs(np.cumsum(steps - dt)), initial=0.0)) / dt
    if uneven < 1e-6:
        return f"{text}. Give dt={dt:.6g}"
    return (
        f"{text}; the times given are off such a grid by up to {write_percent(uneven)} of the mean "
        f"period {dt:.4g} s. Taken as even, each reading is wrong by the speed of y times the "
        "error of its instant, which is noise to a fit: give dt= where that is small beside the "
        "sensor noise, else resample r, u and y to an even grid with numpy.interp"
    )


def list_rows(record: Record) -> list[tuple[str, str, str, Any, Any]]:
    """Return what a record has, signal by signal and channel by channel.

    Each row is key, name, unit, samples, and those of the samples that count.
    """
    rows: list[tuple[str, str, str, Any, Any]] = []
    counts = record.valid_somewhere
    for key, names in record.signals.items():
        units = list_signals(key, record.units.get(key, ("",) * len(names)), len(names))
        each = np.reshape(getattr(record, key), (-1, len(record)))
        own = record.valid_outputs if key == "y" else (counts,) * len(names)
        kept = [keep_counted(v, use) for v, use in zip(each, own, strict=True)]
        rows += [(key, *row) for row in zip(names, units, each, kept, strict=True)]
    for key, values in record.extra.items():
        kept = keep_counted(values, counts)
        rows.append((key, key, record.units.get(key, ""), values, kept))
    return rows


def keep_counted(values: Any, counts: Any) -> Any:
    """Return the samples that count, or all where none does.

    What does not count, such as a dropout, says nothing of ranges and scales.
    """
    return values[counts] if counts.any() else values


def _rebuild(fields: dict[str, Any]) -> Record:
    return Record(**fields)


def fill_readings(record: Record) -> Record:
    """Return a record with straight lines in the place of readings that do not count.

    Of several outputs, for where each of them has a part in what the others say.
    """
    if record.valid.ndim == 1 or record.valid.all():
        return record
    k = np.arange(len(record))
    rows = zip(np.reshape(record.y, (-1, len(record))), record.valid_outputs, strict=True)
    y = [np.interp(k, k[use], row[use]) if use.any() else row for row, use in rows]
    return replace(record, y=np.reshape(y, np.shape(record.y)))


def hold_readings(record: Record) -> Record:
    """Return a record in which each output keeps its last value where it does not count."""
    each = np.reshape(record.valid_outputs, (-1, len(record)))
    if each.all() or not each.any(axis=1).all():
        return record
    rows = zip(np.reshape(record.y, (-1, len(record))), each, strict=True)
    y = np.array([row[find_last_valid(use)] for row, use in rows])
    return replace(record, y=y.reshape(np.shape(record.y)))
