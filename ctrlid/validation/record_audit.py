"""audit(): defects of a record, found before anything is fitted to it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from .._base.arguments import explain_names, point_at_part
from .._base.arrays import Array
from .._base.errors import CtrlidError
from .._base.interruption import hold_interrupt
from .._base.rounding import keep_numpy_quiet
from .._base.text import Printed, write_count, write_percent
from ..data.converter_grid import estimate_rounding, find_grid_step
from ..data.record import SIGNALS, Record
from ..data.several_records import order_model_and_data
from ..data.validity import find_longest_run, find_runs
from ..loop.loop import Loop, describe_other_output, find_input_limits
from ..loop.unit_check import describe_distance, find_unit_clashes, measure_distance
from ..loop.wiring import match_signals
from . import signal_defects as defects
from .controller_check import FAULTS, check_controller
from .hold_check import check_hold
from .wired_controller_check import check_wired_controller

# These findings are no matter of one signal.
OF_THE_LOOP = ("controller", *FAULTS)
# A kind covers more than its name says: any other filter, or rule by which an integral is summed.
LABELS = {"filter": "another filter or rule"}
# With fewer valid samples no fit says much.
FEW = 50
# A fit needs at least so many valid samples in succession.
STRETCH = 20
# A quantization step above this share of y's standard deviation disturbs a fit.
COARSE = 0.3
# With fewer changes of the excitation there is little to average over.
FEW_CHANGES = 4
# A drift that chance produces with a smaller probability is reported.
SURE = 2e-4
# If y does not explain more than this share of u's variance, something is added to u.
OWN = 0.01
# What y does after r is compared with r in means of so many blocks, by which its transients pass.
BLOCKS = (20, 40, 80)
# Such means follow each other, and their ratio is that of two units, up to these shares.
ALIKE = 0.95
NEAR = 0.04
# Means that move less than this share of their signal's range say little of it.
MOVES = 0.02
# How many of the one unit the other is, and which they are.
FACTORS = (
    (180 / np.pi, "one is in degrees and the other in radians"),
    (1000.0, "one is in thousandths (milli) of what the other is in"),
)
# A spectral line counts if its power is above this share of the largest one's.
LINE = 1e-5


@dataclass(frozen=True, repr=False)
class AuditFinding(Printed):
    """One thing to know about a record.

    Parameters
    ----------
    kind : str
        ``"saturation"``, ``"quantization"``, ``"repeats"``, ``"dropped samples"``, ``"outliers"``,
        ``"drift"``, ``"offset"``, ``"too little excitation"``, ``"constant signal"``,
        ``"too few samples"``, ``"between samples"``, ``"controller"``, ``"units"``,
        ``"wrapped"`` (an angle or a counter that starts over) or ``"operating point"``;
        where the stated controller does not compute the logged u, what is wrong with it:
        ``"gain"``, ``"sign"``, ``"bias"``, ``"delay"``, ``"limit"``, ``"filter"``, ``"sampled"``
        (it is stated as analog, and was sampled) or ``"unknown"``. A ``"filter"`` is also another
        rule of sampling, such as ``integral=`` of a `PID`.
    channel : str
        ``"r"``, ``"u"`` or ``"y"``, or the name of one of several signals; empty where it concerns
        the whole record.
    text : str
        The finding in words, with what to do about it.
    size : float
        How large it is: a share of the samples (saturation, dropped samples, outliers), a ratio to
        the signal's spread (quantization, drift, offset), a gain of log-likelihood or the motion
        of u from sample to sample (between samples), a number (repeats, changes, samples), the
        share of u that the controller does not explain, or the ratio of y to where the loop rests.
    where : (int, int)
        First sample concerned and the one after the last.
    harmful : bool
        Whether a fit or a diagnosis goes wrong if nothing is done.
    """

    kind: str
    channel: str
    text: str
    size: float
    where: tuple[int, int]
    harmful: bool = False

    def __str__(self) -> str:
        label = LABELS.get(self.kind, self.kind)
        kind = label.upper() if self.harmful else label
        of = f" of {self.channel}" if self.channel and self.kind not in OF_THE_LOOP else ""
        return f"{kind}{of}: {self.text}"


@dataclass(frozen=True, repr=False)
class Audit(Printed):
    """What `audit` found.

    Parameters
    ----------
    findings : tuple of AuditFinding
        Harmful ones first.
    quantum : mapping of str to float
        Quantisation step by signal [its unit], 0 where there is none.
    repeats : (int, int)
        Period of the reference in samples and number of whole periods; (0, 0) if it has none.
    saturated : mapping of str to (float, float, float, float)
        By signal: share of the samples at its lower and at its upper limit, and the two limits.
    """

    findings: tuple[AuditFinding, ...]
    quantum: Mapping[str, float]
    repeats: tuple[int, int]
    saturated: Mapping[str, tuple[float, float, float, float]]

    @property
    def harmful(self) -> tuple[AuditFinding, ...]:
        """The findings that need something done."""
        return tuple(f for f in self.findings if f.harmful)

    def __getitem__(self, kind: str) -> tuple[AuditFinding, ...]:
        return tuple(f for f in self.findings if f.kind == kind)

    def __str__(self) -> str:
        if not self.findings:
            return "Audit: no defect was found in this record."
        bad = len(self.harmful)
        harm = f"{bad} of which harm" if bad > 1 else f"{bad or 'none'} of which harms"
        if len(self.findings) == 1:
            harm = "which harms" if bad else "which does not harm"
        rows = [f"Audit: {write_count(len(self.findings), 'finding')}, {harm} a fit"]
        return "\n".join([*rows, *(f"  {finding}" for finding in self.findings)])


@explain_names
@hold_interrupt()
@keep_numpy_quiet
def audit(record: Record, loop: Loop | None = None) -> Audit:
    """Look a record over before any fit: limits, steps, repeats, gaps, spikes, drift, excitation.

    Nothing is assumed about the plant. Samples that are marked as not valid are left out, and a
    bound is always one of chance for a record of this length, or a ratio to the signal's own
    size.

    Parameters
    ----------
    record : Record
        The record. Record and loop may change places.
    loop : Loop, optional
        The loop it comes from. If it has a controller and r was logged, it is also checked
        whether the logged u is what this controller computes, and if not, why: another gain, sign,
        constant, limit or filter, or a sample of delay. Of an analog controller only linear ones
        are checked, as far as the samples tell how y runs between them, and whether u is that of
        a sampled one.

    Returns
    -------
    Audit
        The findings, as data and as text.

    Raises
    ------
    CtrlidError
        If something other than a record and a loop is given.

    References
    ----------
    Ljung, *System Identification*, 2nd edition, chapter 14 (preprocessing data).

    Examples
    --------
    >>> import numpy as np
    >>> import ctrlid as cid
    >>> plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    >>> loop = cid.Loop(plant, cid.PID(kp=5.0, kd=0.1), dt=0.01)
    >>> r = cid.random_binary(2000, amplitude=0.1, hold=50, seed=1)
    >>> record = cid.simulate(loop, r, sensor_noise=1e-4, seed=2)
    >>> print(cid.audit(record, loop))
    Audit: 1 finding, which does not harm a fit
      controller: the logged u is exactly what the controller of the loop computes from r and y.
    >>> stuck = cid.Record(r=r, u=record.u, y=np.minimum(record.y, 0.08), dt=0.01)
    >>> [f.kind for f in cid.audit(stuck).harmful]
    ['saturation']
    """
    loop, record = order_model_and_data(loop, record)
    if not isinstance(record, Record) or not (loop is None or isinstance(loop, Loop)):
        raise CtrlidError(
            "audit needs a Record and, optionally, its Loop; given "
            f"{type(record).__name__} and {type(loop).__name__}"
            + (point_at_part(loop, Loop) or ". Audit several records one by one")
        )
    if any(len(names) > 1 for names in record.signals.values()) or (
        loop is not None and not loop.equations().siso
    ):
        return _audit_several(record, loop)
    count = int(np.count_nonzero(record.valid))
    if count < 2:
        text = f"the record has {write_count(count, 'valid sample')}. Record longer."
        few = AuditFinding("too few samples", "", text, count, (0, record.n), harmful=True)
        still = dict.fromkeys(SIGNALS, (0.0, 0.0, 0.0, 0.0))
        return Audit((few,), MappingProxyType(dict.fromkeys(SIGNALS, 0.0)), (0, 0),
                     MappingProxyType(still))  # fmt: skip
    references = () if record.r is None else (record.r,)
    checks = _RecordChecks(record, () if loop is None else find_input_limits(loop), references)
    findings = [
        *checks.check_length(),
        *checks.find_constant(),
        *checks.find_wraps(),
        *checks.find_limits(),
        *checks.find_steps(),
        *checks.find_gaps(),
        *checks.find_outliers(),
        *checks.find_drift(),
        *checks.find_repetition(),
        *checks.find_other_unit(),
    ]
    said = check_hold(record, loop)
    if said is not None:
        text, size, harmful = said
        findings.append(AuditFinding("between samples", "u", text, size, checks.whole, harmful))
    injected = False
    if loop is not None:
        findings += _list_unit_clashes(loop, record)
        findings += checks.check_operating_point(loop)
        shifted = _list_unchecked_law(loop, record)
        findings += shifted
        # A law reads the jumps of an angle that starts over as errors.
        unclear = shifted or any(f.kind == "wrapped" for f in findings)
        for kind, text, size, harmful in () if unclear else check_controller(loop, record):
            injected = injected or kind == "injected"
            named = kind if kind in FAULTS else "controller"
            findings.append(AuditFinding(named, "u", text, size, checks.whole, harmful))
    findings += checks.check_excitation(injected)
    findings.sort(key=lambda f: not f.harmful)
    return Audit(tuple(findings), MappingProxyType(checks.quantum), checks.repeats,
                 MappingProxyType(checks.saturated))  # fmt: skip


def _audit_several(record: Record, loop: Loop | None) -> Audit:
    """Audit each signal of several, with the checks of a record with one input and one output.

    Steps, limits and repeats are found by the name of the signal.
    """
    if loop is not None:
        record = match_signals(record, loop.equations(), loop.wiring)
    findings: list[AuditFinding] = []
    quantum, saturated = dict[str, float](), dict[str, tuple[float, float, float, float]]()
    u, y = record.signals["u"], record.signals["y"]
    r = record.signals.get("r", ())
    parts = [("u", name, record.select(u=name, y=y[0])) for name in u]
    parts += [("y", name, record.select(u=u[0], y=name)) for name in y]
    parts += [("r", name, record.select(u=u[0], y=y[0], r=name)) for name in r]
    references = tuple(np.asarray(part.r) for key, _, part in parts if key == "r")
    ends = np.subtract(*find_runs(record.valid_somewhere)[::-1])
    together = int(np.max(ends, initial=0))
    # An experiment is repeated where all that moves it has the same period.
    periods = {defects.find_period(v) for v in references if np.ptp(v) > 0}
    limits = np.broadcast_to(
        np.array([-np.inf, np.inf] if loop is None else
                 np.array(np.broadcast_arrays(*loop.input_limits)).T), (len(u), 2)
    )  # fmt: skip
    for key, name, part in parts:
        if key != "r":
            # Whatever y does beside r is a matter of all references together.
            part = replace(part, r=None, names={k: v for k, v in part.names.items() if k != "r"},
                           units={k: v for k, v in part.units.items() if k != "r"})  # fmt: skip
        if np.count_nonzero(part.valid) < 2:
            text = f"{name} has {write_count(int(np.count_nonzero(part.valid)), 'valid sample')}."
            findings.append(AuditFinding("too few samples", "", text, 0, (0, part.n), True))
            continue
        stated = tuple(limits[u.index(name)]) if key == "u" else ()
        called = {k: each[0] for k, each in part.signals.items()}
        checks = _RecordChecks(part, stated, references, called)
        # A slow sensor has each reading alone; the others count in between.
        spaced = np.count_nonzero(part.valid) >= FEW and together >= STRETCH
        found = [*(() if spaced else checks.check_length()), *checks.find_constant(),
                 *checks.find_limits(), *checks.find_steps()]  # fmt: skip
        if key == "y":
            found += [*checks.find_wraps(), *checks.find_gaps(), *checks.find_outliers()]
        elif key == "r" and len(periods) == 1:
            found += checks.find_repetition()
        # A reference may have the name of the output that follows it.
        if key != "r" or name not in y:
            quantum[name], saturated[name] = checks.quantum[key], checks.saturated[key]
        findings += [
            replace(f, channel=name) if f.channel else f
            for f in found if f.channel in ("", key)
        ]  # fmt: skip
    if loop is not None:
        shifted = _list_unchecked_law(loop, record)
        findings += [*_list_unit_clashes(loop, record), *shifted]
        for kind, text, size, harmful in () if shifted else check_wired_controller(loop, record):
            named = kind if kind in FAULTS else "controller"
            findings.append(AuditFinding(named, "", text, size, (0, record.n), harmful))
    findings = list(dict.fromkeys(findings))
    findings.sort(key=lambda f: not f.harmful)
    return Audit(tuple(findings), MappingProxyType(quantum), (0, 0), MappingProxyType(saturated))


def _list_unit_clashes(loop: Loop, record: Record) -> list[AuditFinding]:
    whole = (0, record.n)
    return [AuditFinding("units", one.signal, one.text, 1.0, whole, harmful=True)
            for one in find_unit_clashes(loop, record)]  # fmt: skip


def _list_unchecked_law(loop: Loop, record: Record) -> list[AuditFinding]:
    """Say that a law is not checked by signals whose zero is not that of its limits and bias."""
    shifted = any(one.zeros_differ for one in find_unit_clashes(loop, record))
    if not shifted or loop.controller is None:
        return []
    text = ("whether the controller of the loop computes the logged u was not checked, since its "
            "limits and its bias are counted from another zero than the record.")  # fmt: skip
    return [AuditFinding("controller", "u", text, 0.0, (0, record.n))]


class _RecordChecks:
    """The checks of one record; later ones use what earlier ones found."""

    def __init__(
        self, record: Record, limits: tuple[float, ...], references: tuple[Array, ...],
        names: Mapping[str, str] | None = None,
    ) -> None:  # fmt: skip
        # What the signals are called in sentences: of several, each by its own name.
        self.names = names or {key: key for key in SIGNALS}
        self.record, self.valid, self.stated = record, record.valid, limits
        self.references = references
        self.signals = {k: v for k in SIGNALS if (v := getattr(record, k)) is not None}
        self.whole = (0, record.n)
        # What is exactly periodic has each value as often as there are periods.
        self.period = {
            k: defects.find_exact_period(v) if self.valid.all() else 0
            for k, v in self.signals.items()
        }
        self.quantum = dict.fromkeys(SIGNALS, 0.0) | {
            k: find_grid_step(v[self.valid][: self.period[k] or None])
            for k, v in self.signals.items()
            if k == "y" or not defects.is_held(v[self.valid])
        }
        self.saturated = dict.fromkeys(SIGNALS, (0.0, 0.0, 0.0, 0.0))
        self.at_limit = self.repeated = np.zeros(record.n, dtype=bool)
        self.repeats = (0, 0)

    def write_value(self, key: str, value: float) -> str:
        """Write a value of a signal with its unit."""
        unit = self.record.units.get(key, "")
        return f"{value:.4g}{'' if unit in ('', '1') else ' ' + unit}"

    def compute_spread(self, key: str) -> float:
        return float(np.std(self.signals[key][self.valid]))

    def is_stated(self, value: float) -> bool:
        """Return whether the loop says that u ends at a value."""
        return bool(np.isclose(value, self.stated, rtol=1e-3).any())

    def check_length(self) -> list[AuditFinding]:
        count = int(np.count_nonzero(self.valid))
        longest = max(b - a for a, b in self.record.segments())
        if count >= FEW and longest >= STRETCH:
            return []
        text = (f"the record has {write_count(count, 'valid sample')}, at most {longest} of them "
                f"in succession. A fit of a few coefficients needs at least {FEW}, and {STRETCH} "
                "in succession. Record longer.")  # fmt: skip
        return [AuditFinding("too few samples", "", text, count, self.whole, harmful=True)]

    def find_constant(self) -> list[AuditFinding]:
        out = []
        driver = self.signals.get("r", self.signals["u"])[self.valid]
        for key in ("u", "y"):
            v = self.signals[key][self.valid]
            value, long = float(v[0]), ""
            if np.ptp(v) > estimate_rounding(v):
                share, value = defects.find_stuck(v, driver) if key == "y" else (0.0, 0.0)
                if not share:
                    continue
                long = (f" for {write_percent(share, 4)} of the samples, although the excitation "
                        "changes")  # fmt: skip
            text = (
                f"{self.names[key]} stays at {self.write_value(key, value)}{long}: no model can be "
                "identified from it."
            )
            kind = "constant signal"
            out.append(AuditFinding(kind, key, text, 0.0, self.whole, harmful=True))
        return out

    def find_limits(self) -> list[AuditFinding]:
        out = []
        for key in ("u", "y"):
            v = self.signals[key]
            others = [s for k, s in self.signals.items() if k != key]
            if self.period[key] and not self._is_clipped(key, others, slice(self.period[key])):
                continue
            shares, values, mask = [], [], np.zeros(len(v), dtype=bool)
            for side in (-1, 1):
                at, limit = defects.find_clipped(v, self.valid, others, self.quantum[key], side,
                                            self.record.r if key == "y" else None)  # fmt: skip
                known = key == "u" and self.is_stated(limit)
                if not known and defects.is_one_event(v, at, self.references, self.quantum[key]):
                    at = np.zeros(len(v), dtype=bool)
                mask |= at
                shares.append(float(np.mean(at[self.valid])))
                values.append(limit)
            self.saturated[key] = (shares[0], shares[1], values[0], values[1])
            if not mask.any():
                continue
            ends = " and ".join(
                f"{self.write_value(key, value)} for {write_percent(share)} of the samples"
                for share, value in zip(shares, values, strict=True)
                if share
            )
            if key == "y":
                self.at_limit = mask
                cure = (": the sensor, or a mechanical stop, is at its limit. Exclude these "
                        "samples, and some before and after them, with valid=.")  # fmt: skip
            else:
                reached = [v for share, v in zip(shares, values, strict=True) if share]
                known = all(self.is_stated(v) for v in reached)
                advice = ("The loop has these limits" if known else
                          "Give the limits to the loop with input_limits=")  # fmt: skip
                cure = (", so it is limited. Fits from u to y are valid if the logged u is the "
                        f"limited one. {advice}.")  # fmt: skip
            where = np.flatnonzero(mask)
            out.append(AuditFinding("saturation", key, f"{self.names[key]} is exactly {ends}{cure}",
                                    float(np.mean(mask[self.valid])),
                                    (int(where[0]), int(where[-1]) + 1), key == "y"))  # fmt: skip
        return out

    def _is_clipped(self, key: str, others: Sequence[Array], part: slice) -> bool:
        """Whether a signal sits on one of its extreme values within a part of the record."""
        v, valid = self.signals[key][part], self.valid[part]
        rest, step = [s[part] for s in others], self.quantum[key]
        sides = (defects.find_clipped(v, valid, rest, step, side)[0] for side in (-1, 1))
        return any(at.any() for at in sides)

    def find_wraps(self) -> list[AuditFinding]:
        """Say where an angle or a counter starts over."""
        period, at = defects.find_wraps(self.record.y, self.valid)
        if not period:
            return []
        name, r = self.names["y"], self.record.r
        size = "2 * numpy.pi" if period == 2 * math.pi else f"{period:.0f}"
        what = {2 * math.pi: "2 pi, a turn in radians", 360.0: "360, a turn in degrees"}.get(
            period, f"{size}, the range of a counter of {math.log2(period):.0f} bits"
        )
        alone = name == "y"
        cure = f"numpy.unwrap({'record.y' if alone else f'the row of {name}'}, period={size})"
        also = r is not None and defects.find_wraps(r, self.valid)[0] == period
        text = (
            f"{name} jumps by {what}, at {write_count(len(at), 'sample')}, the first of them "
            f"{at[0]}, and goes on as if it had not: it starts over at the end of its range, and "
            f"the plant does not. Make it continuous by {cure}"
            f"{', and give dataclasses.replace(record, y=...)' if alone else ''}."
            f"{' The reference starts over as well: make both continuous.' if also else ''}"
        )
        return [AuditFinding("wrapped", "y", text, len(at), (int(at[0]), int(at[-1]) + 1), True)]

    def find_steps(self) -> list[AuditFinding]:
        out = []
        for key in ("u", "y"):
            step, spread = self.quantum[key], self.compute_spread(key)
            # Rounding far below everything else is how numbers are written, and no news.
            if step < 1e-3 * spread or not spread:
                continue
            ratio = step / spread
            size = self.write_value(key, step)
            text = (f"{self.names[key]} is quantized in steps of {size}, {write_percent(ratio)} of "
                    "its standard deviation")  # fmt: skip
            bad = key == "y" and ratio > COARSE
            text += (
                ": too coarse to show the motion. Excite the loop more strongly." if bad else "."
            )
            out.append(AuditFinding("quantization", key, text, ratio, self.whole, bad))
        return out

    def find_gaps(self) -> list[AuditFinding]:
        y, u = self.record.y, self.record.u
        mask = defects.find_repeats(y, self.valid, self.quantum["y"], self.at_limit)
        self.repeated = mask
        if not mask.any():
            return []
        first, stop = find_runs(mask)
        share = float(np.mean(mask[self.valid]))
        with_u = np.mean([np.ptp(u[a - 1 : b]) == 0 for a, b in zip(first, stop, strict=True)])
        also = with_u > 0.8 and np.mean(np.diff(u) == 0) < 0.5
        name = self.names["y"]
        what = f"{name} and {self.names['u']} repeat their" if also else f"{name} repeats its"
        count, places = write_count(int(mask.sum()), "sample"), write_count(len(first), "place")
        text = (f"{what} last value for {count} in {places}, "
                "although the samples before and after change: ")  # fmt: skip
        every = np.diff(first)
        usual = int(np.median(every)) if len(every) > 10 else 0
        if share > 0.3 and np.mean(every == usual) > 0.9:
            text += (f"{name} is measured only once in {usual} samples. Decimate the record by "
                     f"{usual} with antialias=False.")  # fmt: skip
        else:
            text += "samples were lost and replaced. Exclude them with valid=."
        return [AuditFinding("dropped samples", "y", text, share,
                             (int(first[0]), int(stop[-1])), harmful=True)]  # fmt: skip

    def find_outliers(self) -> list[AuditFinding]:
        height = defects.find_spikes(self.record.y, self.valid, self.quantum["y"])
        at = np.flatnonzero(np.where(self.repeated, 0.0, height))
        if not at.size:
            return []
        worst = at[np.argmax(np.abs(height[at]))]
        text = (
            f"{self.names['y']} has {write_count(at.size, 'isolated spike')}, the largest of "
            f"{self.write_value('y', height[worst])} at sample {worst}. No plant moves there and "
            f"back within one sample. Exclude {'it' if at.size == 1 else 'them'} with valid=."
        )
        return [AuditFinding("outliers", "y", text, at.size / self.record.n,
                             (int(at[0]), int(at[-1]) + 1), harmful=True)]  # fmt: skip

    def find_drift(self) -> list[AuditFinding]:
        y, u = self.record.y[self.valid], self.record.u[self.valid]
        r = None if self.record.r is None else self.record.r[self.valid]
        causes = [u, np.cumsum(u - np.mean(u))] if r is None else [r]
        change, scatter, p = defects.find_drift(y, causes)
        out = []
        if p < SURE and change > scatter > 0:
            ratio = change / scatter
            text = (
                f"y drifts by {self.write_value('y', change)} over the record, which is "
                f"{ratio:.2g} times the standard deviation about it, and "
                f"{'u' if r is None else 'r'} does not explain it. Divide the record into parts "
                "and give them as a list: each part then has its own constant."
            )
            out.append(AuditFinding("drift", "y", text, ratio, self.whole, ratio > 2))
        if r is not None:
            mean, sd = float(np.mean(y - r)), float(np.std(y - r))
            if abs(mean) > 0.5 * sd and abs(mean) > 1e-9 * float(np.max(np.abs(y))):
                away = self.write_value("y", mean)
                text = (f"the mean of y - r is {away}; the controller may have no integral "
                        "action.")  # fmt: skip
                out.append(AuditFinding("offset", "y", text, abs(mean) / max(sd, 1e-300),
                                        self.whole))  # fmt: skip
        return out

    def find_other_unit(self) -> list[AuditFinding]:
        """Say where y follows r so many times as far as two units of one quantity differ.

        A loop without integral action rests elsewhere than at r, but not just there.
        """
        r = self.record.r
        if r is None:
            return []
        part = slice(*self._find_longest())
        likeness, ratio = max(_compare_means(r[part], self.record.y[part], m) for m in BLOCKS)
        for factor, words in FACTORS:
            known = factor if ratio > 1 else 1 / factor
            if likeness < ALIKE or abs(ratio / known - 1) > NEAR:
                continue
            text = (
                f"y follows r with a ratio of {ratio:.4g}, about {known:.4g}: it looks as if "
                f"{words}. If so, convert one of them: Record.from_csv has scale=."
            )
            return [AuditFinding("units", "r", text, ratio, self.whole)]
        return []

    def _find_longest(self) -> tuple[int, int]:
        return max(self.record.segments(), key=lambda ends: ends[1] - ends[0])

    def check_operating_point(self, loop: Loop) -> list[AuditFinding]:
        other = describe_other_output(loop)
        if other:
            text = (
                f"the output of the loop's operating point is {loop.point.output:.4g}, but "
                f"{other}. Give at=operating_point(plant, output=...), or the states that belong "
                "to the output."
            )
            return [AuditFinding("operating point", "y", text, 1.0, self.whole, harmful=True)]
        ratio = measure_distance(loop, self.record)
        if not ratio:
            return []
        text = describe_distance(loop, ratio)
        return [AuditFinding("operating point", "y", text, ratio, self.whole, harmful=True)]

    def find_repetition(self) -> list[AuditFinding]:
        r = self.record.r
        found = defects.find_period(r) if r is not None else 0
        if not found:
            return []
        times = self.record.n // found
        self.repeats = (found, times)
        name = self.names["r"]
        which = "the reference" if name == "r" else f"the reference {name}"
        text = (f"{which} has a period of {found} samples, and the record has "
                f"{self.record.n / found:.3g} periods. Averaging over the periods separates the "
                "noise from the response.")  # fmt: skip
        return [AuditFinding("repeats", "r", text, times, self.whole)]

    def check_excitation(self, injected: bool) -> list[AuditFinding]:
        key = "u" if self.record.r is None else "r"
        v = self.signals[key]
        moves = (np.abs(np.diff(v)) > estimate_rounding(v)) & self.valid[1:] & self.valid[:-1]
        changes = int(np.count_nonzero(moves))
        kind, size = "too little excitation", float(changes)
        if changes == 0:
            # A constant u is reported by the check for constant signals.
            if injected or key == "u":
                return []
            text = "r is constant in the valid samples, and "
            share = defects.find_share_beyond_controller(self.record.u, self.record.y, self.valid)
            if share > OWN:
                text += (f"{write_percent(share, 3)} of the variance of u does not depend linearly "
                         "on y: only a signal added to u, or noise of the input, excites the "
                         "loop.")  # fmt: skip
            else:
                text += ("u is computed from y: only noise excites the loop, and the plant cannot "
                         "be identified from it. Vary the reference (random_binary) or add a "
                         "signal to u.")  # fmt: skip
            return [AuditFinding(kind, key, text, size, self.whole, share <= OWN)]
        if changes < FEW_CHANGES:
            times = ("once", "twice", "three times")[changes - 1]
            text = (f"{key} changes only {times}, so the estimates have a large variance. Use a "
                    "reference with many steps, such as random_binary.")  # fmt: skip
            return [AuditFinding(kind, key, text, size, self.whole)]
        longest = find_longest_run(self.valid)
        if changes > 0.5 * self.record.n and _count_lines(v[longest]) == 1 and not injected:
            text = (f"{key} is a single sine, which determines two coefficients and no more. Use "
                    "several frequencies, as multisine gives.")  # fmt: skip
            return [AuditFinding(kind, key, text, 2.0, self.whole, harmful=True)]
        return []


def _compare_means(r: Any, y: Any, blocks: int) -> tuple[float, float]:
    """Return correlation of the means of two signals in so many blocks, and their ratio y to r.

    Both zero for a record too short, or where one of them rests.
    """
    size = len(r) // blocks
    if size < 2:
        return 0.0, 0.0
    means = [np.reshape(v[: size * blocks], (blocks, size)).mean(axis=1) for v in (r, y)]
    spread = [float(np.std(v)) for v in means]
    if min(spread[0] / max(float(np.ptp(r)), 1e-300), spread[1] / max(float(np.ptp(y)), 1e-300)) < (
        MOVES
    ):
        return 0.0, 0.0
    return float(np.corrcoef(*means)[0, 1]), spread[1] / spread[0]


def _count_lines(v: Any) -> int:
    """Return the number of separate spectral lines of a signal, or 0 if it has a broad spectrum."""
    if len(v) < FEW:
        return 0
    window = np.blackman(len(v))
    power = np.abs(np.fft.rfft((v - np.average(v, weights=window)) * window)) ** 2
    first, stop = find_runs(power > LINE * power.max())
    return len(first) if np.all(stop - first <= 10) else 0
