"""Single changes of a stated control law, one of which may have computed the logged u."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, get_args

import control as ct
import numpy as np
from scipy import linalg, optimize, signal

from .._base.arrays import Array
from .._base.statistics import regress
from ..data.record import Record
from ..data.validity import find_longest_run, find_whole_past
from ..loop.controller_replay import differentiate_replay, replay_controller
from ..loop.controllers import PID, AntiWindup, Derivative, Integral
from ..loop.loop import (
    Loop,
    exchange_constant_input,
    exchange_controller,
    exchange_limits,
    find_input_limits,
)
from ..physics.conversions import to_state_matrices

# Shorter stretches do not tell what computed the input.
FEWEST = 20
# The parameters of a change are read from so many samples, which tell enough.
TRIAL = 4000
# Directions below this share of the largest are not in a regression's data.
DETERMINED = 1e-10
# A pole this near to one is an integral's, which a filter of its own does not have.
INTEGRAL = 1e-6
# The start of a low-pass filter is forgotten when this share of it is left.
FORGOTTEN = 1e-9
# A filter keeps at most this share of its state, or the record tells nothing but its start.
SLOWEST = 0.98
# Time constants that are looked at before the best one is refined, in sampling periods.
TIMES = (0.2, 0.4, 0.7, 1.2, 2.0, 4.0, 8.0, 16.0, 32.0)
# The search for a time constant replays so many samples, which saves time.
SEARCH = 1000
# A time constant is refined where it leaves less than this share of what the stated law leaves.
PROMISING = 0.8
# Factors between units in which a log and a controller may differ, as a share they are known to.
SAME = 2e-3
UNITS = (
    (np.pi / 180, "pi/180, degrees for radians"),
    (180 / np.pi, "180/pi, radians for degrees"),
    (1e-3, "as between thousandths (milli) and wholes"),
    (1e3, "as between wholes and thousandths (milli)"),
    (1e-2, "as between per cent and shares of one"),
    (1e2, "as between shares of one and per cent"),
)
# Factors about a gain that a regression gave, between which the best one is refined.
FACTORS = (0.8, 1.0, 1.25)
# Powers of two times a tracking time that are looked at before the best one is refined.
TRACKED = range(-6, 7)


@dataclass(frozen=True)
class LawChange:
    """Another law than the stated one.

    Parameters
    ----------
    kind : str
        Kind of finding: ``"gain"``, ``"sign"``, ``"bias"``, ``"limit"`` or ``"filter"``.
    words : str
        The change, as the end of the sentence "u is not what the controller computes, but".
    loop : Loop
        The loop with it.
    record : Record
        The record that this loop should replay; a filter may be taken off its channels.
    exact : bool
        Whether only an exact replay speaks for it.
    """

    kind: str
    words: str
    loop: Loop
    record: Record
    exact: bool = False


def list_changes(
    loop: Loop, record: Record, sample: Callable[[Any], Loop | None] | None = None
) -> Iterator[LawChange]:
    """Yield the changes of a law that are tried, those with the fewest words first.

    Of an analog controller, `loop` has it at the samples, and `sample` makes such a loop of an
    analog transfer function by which that controller is multiplied.
    """
    pid = loop.controller
    if isinstance(pid, PID):
        # One other option may leave nothing where another gain leaves hardly anything.
        yield from _list_single_options(loop, pid, record)
    gain = _estimate_gain(loop, record)
    if gain is not None:
        yield from _list_gains(loop, record, *gain)
    yield from _list_limits(loop, record)
    if isinstance(pid, PID):
        yield from _list_options(loop, pid, record)
    if sample is not None:
        yield from _list_analog_filters(loop, record, sample)
    else:
        yield from _list_filters(loop, record)
    if isinstance(pid, PID):
        yield from _list_single_gains(loop, pid, record)


# --- gains and constants


def _list_gains(
    loop: Loop, record: Record, constant: float, factor: float, beside: float
) -> Iterator[LawChange]:
    """Yield a law about another constant, and so many times the law beside its own constant."""
    if shifted := _scale_controller(loop, 1.0, constant):
        yield LawChange("bias", f"that about a constant of {constant:.4g}", shifted, record)
    if factor == 0.0 or not (scaled := _scale_controller(loop, factor, beside)):
        return
    words = f"{factor:.4g} times that"
    if factor < 0:
        words = ("has the opposite sign" if abs(factor + 1) < 1e-3
                 else f"has the opposite sign and {-factor:.4g} times the size")  # fmt: skip
        if abs(factor + 1) < 1e-3 and _seem_exchanged(record):
            words = "with r and y exchanged (y stays at one value between steps, and r is noisy)"
    words += _name_factor(abs(factor))
    yield LawChange("sign" if factor < 0 else "gain", words, scaled, record)


def _seem_exchanged(record: Record) -> bool:
    """Whether y stays where it is from sample to sample as a reference does, and r moves."""
    assert record.r is not None
    still = [float(np.mean(np.diff(signal[record.valid]) == 0)) for signal in (record.r, record.y)]
    return still[0] < 0.1 and still[1] > 0.5


def _name_factor(factor: float) -> str:
    """Return what a factor is known as where units are mixed up; empty for any other."""
    for known, words in UNITS:
        if abs(factor / known - 1) < SAME:
            return f" ({words})"
    return ""


def _estimate_gain(loop: Loop, record: Record) -> tuple[float, float, float] | None:
    """Return the constant between u and the unlimited output of the controller, and its factor.

    First the constant beside a factor of one, then factor and constant together. Both are read from
    the longest stretch with the controller's unknown state: the state adds its own slow response,
    which an alternating solution would share out wrongly.
    """
    part = _take_longest(record)
    output, responses, rest = differentiate_replay(take_limits_off(loop), part)
    inner = _find_inner(part)
    table = np.column_stack([output - rest, np.ones(part.n), responses])[inner]
    if len(table) <= 2 * table.shape[1]:
        return None
    goal = part.u[inner]
    constant = regress(table[:, 1:], goal - table[:, 0], DETERMINED)[0]
    factor, beside = regress(table, goal, DETERMINED)[:2]
    return float(constant), float(factor), float(beside)


def measure_opposite_sign(loop: Loop, record: Record) -> tuple[float, float]:
    """Return the factor of a law that fits u best, if it is negative, and what it then explains.

    A share of the variance that neither a constant nor the state of the controller explains; both
    zero where the factor is not negative.
    """
    part = _take_longest(record)
    output, responses, rest = differentiate_replay(take_limits_off(loop), part)
    inner = _find_inner(part)
    table = np.column_stack([output - rest, np.ones(part.n), responses])[inner]
    if len(table) <= 2 * table.shape[1]:
        return 0.0, 0.0
    goal = part.u[inner]
    found = regress(table, goal, DETERMINED)
    without = goal - table[:, 1:] @ regress(table[:, 1:], goal, DETERMINED)
    left, most = float(np.sum((goal - table @ found) ** 2)), float(np.sum(without**2))
    if not (found[0] < 0 and most > 0):
        return 0.0, 0.0
    return float(found[0]), 1 - left / most


def scale_controller(controller: Any, factor: Any) -> Any:
    """Return so many times a linear controller, which keeps the names of its signals."""
    scaled = factor * controller
    if isinstance(controller, ct.InputOutputSystem):
        scaled.update_names(inputs=controller.input_labels, outputs=controller.output_labels)
    return scaled


def _scale_controller(loop: Loop, factor: float, constant: float) -> Loop | None:
    """Return the loop with so many times its controller, about another constant input."""
    controller = loop.controller
    if isinstance(controller, PID):
        other = replace(controller, kp=factor * controller.kp, ki=factor * controller.ki,
                        kd=factor * controller.kd, bias=constant)  # fmt: skip
        return exchange_controller(loop, other)
    if isinstance(controller, ct.TransferFunction | ct.StateSpace | int | float):
        scaled = scale_controller(controller, factor)
        return exchange_constant_input(replace(loop, controller=scaled), constant)
    return None


def _list_single_gains(loop: Loop, pid: PID, record: Record) -> Iterator[LawChange]:
    """Yield the PID with one of its three gains as the logged u has it."""
    part = _take_longest(record)
    free = take_limits_off(loop)
    inner = _find_inner(part)
    whole = differentiate_replay(free, part)[0]
    for name, words in (("kp", "proportional"), ("ki", "integral"), ("kd", "derivative")):
        if not getattr(pid, name):
            continue
        without = exchange_controller(free, replace(free.controller, **{name: 0.0}))
        others, responses, _ = differentiate_replay(without, part)
        table = np.column_stack([whole - others, responses])[inner]
        factor = float(regress(table, part.u[inner] - others[inner], DETERMINED)[0])
        if not np.isfinite(factor) or factor == 0.0:
            continue
        if factor < 0 and pid.anti_windup == "back-calculation":
            # Its integral would run away: no such controller exists.
            continue
        if factor > 0 and _has_limits(loop):
            # The integral remembers the limits, of which the regression knows nothing.

            def make_scaled(factor: float, name: str = name) -> tuple[Loop, Record]:
                changed = replace(pid, **{name: factor * getattr(pid, name)})
                return exchange_controller(loop, changed), record

            factor = _search_value(make_scaled, [factor * f for f in FACTORS], np.inf) or factor
        changed = replace(pid, **{name: factor * getattr(pid, name)})
        yield LawChange(
            "gain",
            f"with {factor:.4g} times the {words} gain, {name}={getattr(changed, name):.4g}",
            exchange_controller(loop, changed), record, exact=True,
        )  # fmt: skip


# --- limits and options


def _list_limits(loop: Loop, record: Record) -> Iterator[LawChange]:
    """Yield the law cut off where the logged u ends, and without limits of its own."""
    u = record.u[record.valid]
    ends = float(np.min(u)), float(np.max(u))
    counts = [int(np.count_nonzero(u == end)) for end in ends]
    # What reaches an end once or twice is a limiter's only where all else is replayed exactly.
    low, high = (end if count > 2 else side * np.inf
                 for end, count, side in zip(ends, counts, (-1, 1), strict=True))  # fmt: skip
    choices = [(low, high, False)] if np.isfinite([low, high]).any() and low < high else []
    if ends[0] < ends[1] and min(counts) <= 2:
        once = ((ends[0], high), (low, ends[1]), ends)
        choices += [(*pair, True) for pair in once if pair != (low, high)]
    for lower, upper, exact in choices:
        words = f"it is limited to {lower:.4g} to {upper:.4g}"
        yield LawChange("limit", words, exchange_limits(loop, lower, upper), record, exact)
        if isinstance(loop.controller, PID) and lower < upper:
            limited = replace(loop.controller, lower=lower, upper=upper)
            yield LawChange("limit", words, exchange_controller(loop, limited), record, exact)


def _list_options(loop: Loop, pid: PID, record: Record) -> Iterator[LawChange]:
    """Yield the other forms of a PID that there are, those with the fewest changes first."""
    limited = np.isfinite([pid.lower, pid.upper]).any()
    if limited:
        yield LawChange("limit", "without the limits of the controller", replace(
            loop, controller=replace(pid, lower=-np.inf, upper=np.inf)), record)  # fmt: skip
    choices = _list_choices(pid)
    stated = {name: getattr(pid, name) for name in choices}
    made = [dict(zip(choices, values, strict=True)) for values in product(
        *({stated[name], *choices[name]} for name in choices))]  # fmt: skip
    changes = [{k: v for k, v in one.items() if v != stated[k]} for one in made]
    for change in sorted(changes, key=lambda c: (len(c), str(c))):
        if change:
            yield _change_options(loop, pid, record, change)
    if "back-calculation" in choices["anti_windup"]:
        tracking = _find_tracking_time(pid)

        def make_tracked(time: float) -> tuple[Loop, Record]:
            other = replace(pid, anti_windup="back-calculation", tracking_time=time)
            return exchange_controller(loop, other), record

        stated_leaves = _measure_remainder(loop, record)
        times = [tracking * 2.0**k for k in TRACKED]
        time = _search_value(make_tracked, times, stated_leaves)
        if time is not None:
            words = f"with anti_windup='back-calculation' and tracking_time={time:.4g}"
            yield LawChange("limit", words, *make_tracked(time), exact=True)


def _list_single_options(loop: Loop, pid: PID, record: Record) -> Iterator[LawChange]:
    """Yield the PID with one other option, for which only an exact replay speaks."""
    for name, values in _list_choices(pid).items():
        for value in values:
            if value != getattr(pid, name):
                yield replace(_change_options(loop, pid, record, {name: value}), exact=True)


def _list_choices(pid: PID) -> dict[str, list[Any]]:
    """Return the options of a PID that make a difference, with all their values."""
    limited = np.isfinite([pid.lower, pid.upper]).any()
    # With a negative time constant the integrator would run away: no such controller exists.
    windups = [w for w in get_args(AntiWindup)
               if w != "back-calculation" or _find_tracking_time(pid) > 0]  # fmt: skip
    return {
        "derivative": [*get_args(Derivative)] if pid.kd and pid.c in (0, 1) else [],
        "integral": [*get_args(Integral)] if pid.ki else [],
        "b": [0.0, 1.0],
        "anti_windup": windups if pid.ki and limited else [],
    }


def _find_tracking_time(pid: PID) -> float:
    return pid.tracking_time or (pid.kp / pid.ki if pid.ki else 1.0)


def _change_options(loop: Loop, pid: PID, record: Record, change: dict[str, Any]) -> LawChange:
    """Return the PID with other options."""
    kind = "limit" if "anti_windup" in change else "filter"
    other = exchange_controller(loop, replace(pid, **change))
    return LawChange(kind, _write_options(change), other, record)


def _write_options(change: dict[str, Any]) -> str:
    return "with " + " and ".join(f"{name}={value!r}" for name, value in change.items())


# --- filters


def _list_filters(loop: Loop, record: Record) -> Iterator[LawChange]:
    r"""Yield the law behind a first-order low-pass filter, with another one, or sampled otherwise.

    A filter on the output of a law, or on the error before a linear one, is read from the log by
    one regression: with its pole p and the output v that the law would give,

    .. math:: u_k + \gamma (u_k - u_{k-1}) = v_k, \\quad \gamma = p / (1 - p)
    """
    part = _take_longest(record)
    output, responses, _ = differentiate_replay(take_limits_off(loop), part)
    dt, stated = record.dt, _measure_remainder(loop, record)
    times = [dt * time for time in TIMES]
    text = "behind a first-order low-pass filter with a time constant of"
    keep = _estimate_pole(part, output, responses, 0.0)
    if keep is not None and keep > 0:
        yield LawChange("filter", f"that {text} {-dt / np.log(keep):.3g} s", loop,
                        _take_filter_off_input(record, keep))  # fmt: skip
    places = {"y": "that of y"}
    if _has_limits(loop) or _is_nonlinear(loop):
        # Without limits, a filter on the error is one on the output.
        places |= {"ry": "that of r - y", "u": "that"}
    for channels, what in places.items():

        def make_filtered(time: float, channels: str = channels) -> tuple[Loop, Record]:
            pole = float(np.exp(-dt / time))
            if channels == "u":
                return loop, _take_filter_off_input(record, pole)
            return loop, _filter_channels(record, channels, pole)

        time = _search_value(make_filtered, times, stated)
        if time is not None:
            words = f"{what} {text} {time:.3g} s"
            yield LawChange("filter", words, *make_filtered(time), exact=True)
    pid = loop.controller
    if isinstance(pid, PID):
        yield from _list_derivatives(loop, pid, record, stated)
    elif isinstance(pid, ct.TransferFunction | ct.StateSpace) and pid.ninputs == 1:
        yield from _list_moved_poles(loop, record, part, output, responses)
        yield from _list_discretizations(loop, record)


def _list_analog_filters(
    loop: Loop, record: Record, sample: Callable[[Any], Loop | None]
) -> Iterator[LawChange]:
    """Yield an analog law behind a low-pass filter."""

    def make(time: float) -> tuple[Loop, Record]:
        changed = sample(ct.tf([1.0], [time, 1.0]))
        return (loop if changed is None else changed), record

    stated = _measure_remainder(loop, record)
    time = _search_value(make, [record.dt * time for time in TIMES], stated)
    if time is not None:
        words = ("that behind a first-order low-pass filter with a time constant of "
                 f"{time:.3g} s")  # fmt: skip
        yield LawChange("filter", words, *make(time))


def _estimate_pole(
    part: Record, output: Array, responses: Array, instead_of: float
) -> float | None:
    """Return the pole of a filter that stands in place of one of the law's poles, or of none.

    `output` and its `responses` to the initial state of the law are those of the law as stated.
    """
    v, columns = ((s[1:] - instead_of * s[:-1]) / (1 - instead_of) for s in (output, responses))
    return _solve_pole(part, part.u, v, columns)


def _solve_pole(part: Record, u: Array, v: Array, columns: Array) -> float | None:
    """Return p of ``u + p / (1 - p) (u - last u) = v + columns x`` where no limit is reached."""
    inner = _find_inner(part)
    rows = inner[1:] & inner[:-1]
    table = np.column_stack([-np.diff(u), columns])[rows]
    if len(table) <= 2 * table.shape[1]:
        return None
    gamma = float(regress(table, (u[1:] - v)[rows], DETERMINED)[0])
    pole = gamma / (1 + gamma) if gamma > -0.5 else -1.0
    return pole if -SLOWEST < pole < SLOWEST else None


def _take_filter_off_input(record: Record, pole: float) -> Record:
    """Return the record with u as it was before a low-pass filter of that pole."""
    u, valid = record.u.copy(), find_whole_past(record.valid, 1)
    u[1:] += pole / (1 - pole) * np.diff(record.u)
    return replace(record, u=u, valid=valid)


def _filter_channels(record: Record, channels: str, pole: float) -> Record:
    """Return the record with a low-pass filter on r and y, or on y alone, without its start."""
    changed: dict[str, Any] = {}
    for name in channels:
        v = getattr(record, name)
        changed[name] = signal.lfilter([1 - pole], [1, -pole], v, zi=[pole * v[0]])[0]
    start = 1 + int(np.ceil(np.log(FORGOTTEN) / np.log(pole))) if pole > FORGOTTEN else 1
    valid = find_whole_past(record.valid, min(start, record.n // 2))
    return replace(record, **changed, valid=valid)


def _search_value(
    make: Callable[[float], tuple[Loop, Record]], values: Sequence[float], stated: float
) -> float | None:
    """Return the positive value that leaves least of u, None where none leaves clearly less.

    `make` gives loop and record by the value, and `stated` is the logarithm of what the stated law
    leaves. The best of `values` is refined between those beside it.
    """

    def measure(logarithm: float) -> float:
        return _measure_remainder(*make(float(np.exp(logarithm))))

    logs = np.log(values)
    tried = [measure(value) for value in logs]
    best = int(np.argmin(tried))
    if not tried[best] < np.log(PROMISING) + stated:
        return None
    step = float(logs[1] - logs[0])
    around = (logs[best - 1] if best else logs[0] - step,
              logs[best + 1] if best + 1 < len(logs) else logs[-1] + step)  # fmt: skip
    found = optimize.minimize_scalar(measure, bounds=around, method="bounded",
                                     options={"xatol": 1e-6, "maxiter": 40})  # fmt: skip
    return float(np.exp(found.x))


def _measure_remainder(loop: Loop, record: Record) -> float:
    """Return the logarithm of the share of u that a law leaves in the longest stretch."""
    if max((b - a for a, b in record.segments()), default=0) < FEWEST:
        # Behind a slow filter every stretch may still be its start, which explains nothing.
        return float(np.log(1e300))
    part = _take_longest(record)[:SEARCH]
    left = part.u - replay_controller(loop, part)
    return float(np.log(np.mean(left**2) / max(float(np.var(part.u)), 1e-300) + 1e-30))


def _list_derivatives(loop: Loop, pid: PID, record: Record, stated: float) -> Iterator[LawChange]:
    """Yield the PID with its derivative filtered or sampled otherwise."""
    if not pid.kd:
        return

    forms: list[dict[str, Any]] = [{}]
    if pid.derivative == "error" and pid.c in (0, 1):
        forms.append({"derivative": "measurement"})
    for form in forms:

        def make(time: float, form: dict[str, Any] = form) -> tuple[Loop, Record]:
            other = replace(pid, filter_time=time, **form)
            return exchange_controller(loop, other), record

        found = _search_value(make, [record.dt * time for time in TIMES], stated)
        times = [*([0.0] if pid.filter_time else []), *([] if found is None else [found])]
        for time in times:
            words = _write_options({"filter_time": float(f"{time:.4g}"), **form})
            yield LawChange("filter", words, *make(time), exact=True)
    if pid.filter_time < 0.5 * record.dt:
        # A slower filter by Tustin's rule is one by backward differences, T/2 faster.
        words = f"with its derivative by {RULES['tustin']}"
        other = _sample_derivative(loop, pid, record.dt)
        yield LawChange("filter", words, other, record, exact=True)


def _sample_derivative(loop: Loop, pid: PID, dt: float) -> Loop:
    """Return the loop with a PID, as state matrices, whose derivative follows Tustin's rule."""
    time = pid.filter_time
    pole, gain = (2 * time - dt) / (2 * time + dt), 2 * pid.kd / (2 * time + dt)
    c = 0.0 if pid.derivative == "measurement" else pid.c
    step = pid.ki * dt
    direct = {"backward": step, "forward": 0.0, "trapezoidal": 0.5 * step}[pid.integral]
    # The derivative is gain (z - 1)/(z - pole).
    A, B = np.diag([1.0, pole]), np.array([[1.0, -1.0], [c, -1.0]])
    C = np.array([[step, gain * (pole - 1)]])
    D = np.array([[pid.b * pid.kp + direct + c * gain, -pid.kp - direct - gain]])
    keep = [0, 1] if pid.ki else [1]
    system = ct.ss(A[np.ix_(keep, keep)], B[keep], C[:, keep], D, dt, inputs=["r", "y"])
    bias = loop.point.input if pid.bias is None else pid.bias
    # About the output of the operating point, r weighs (b kp) there while y weighs kp.
    bias += pid.kp * (pid.b - 1) * loop.point.output
    limits = find_input_limits(exchange_controller(loop, pid))
    return exchange_constant_input(replace(loop, controller=system, input_limits=limits), bias)


def _list_moved_poles(
    loop: Loop, record: Record, part: Record, output: Array, responses: Array
) -> Iterator[LawChange]:
    """Yield a linear law with one of its filters faster or slower.

    Either the whole law passes the filter, as a lead compensator's pole does, or only the term that
    vanishes at rest, as the filter of a derivative does.
    """
    law = ct.tf(*_read_polynomials(loop.controller), record.dt)
    num, den = law.num[0][0], law.den[0][0]
    if len(num) > len(den):
        return
    # In powers of 1/z both have as many coefficients.
    num = np.pad(num, (len(den) - len(num), 0))
    residues, poles, _ = signal.residuez(num, den)
    e = part.r - part.y
    whole = signal.lfilter(num, den, e)
    powers = np.array([[q**k for q in poles.real] for k in range(part.n)])
    columns = np.column_stack([powers[1:], np.ones(part.n - 1)])
    for residue, pole in zip(residues, poles, strict=True):
        if abs(pole.imag) > 1e-9 or not 1e-9 < abs(pole) < 1 - INTEGRAL:
            continue
        p, r = float(pole.real), float(residue.real)
        other = _estimate_pole(part, output, responses, p)
        if other is not None:
            moved = law * ct.tf(np.array([1, -p]) * (1 - other) / (1 - p), [1, -other], record.dt)
            yield _move_pole(loop, record, p, other, moved)
        weight = -r * p / (1 - p)
        term = signal.lfilter([weight, -weight], [1, -p], e)
        others = part.u - (whole - term)
        slope = signal.lfilter([weight / (1 - p), -weight / (1 - p)], [1], e)
        other = _solve_pole(part, others, slope[1:], columns)
        if other is not None:
            gain = weight * (1 - other) / (1 - p)
            rest = law - ct.tf([weight, -weight], [1, -p], record.dt)
            moved = rest + ct.tf([gain, -gain], [1, -other], record.dt)
            yield _move_pole(loop, record, p, other, moved)


def _move_pole(loop: Loop, record: Record, old: float, new: float, law: Any) -> LawChange:
    words = [f"{-record.dt / np.log(p):.3g} s" if p > 0 else "none" for p in (old, new)]
    return LawChange("filter", f"with a filter of another time constant ({words[1]} where the "
                     f"stated law has {words[0]})", exchange_controller(loop, law), record,
                     exact=True)  # fmt: skip


def _list_discretizations(loop: Loop, record: Record) -> Iterator[LawChange]:
    """Yield what other rules of sampling make of the analog law behind a linear one."""
    a, b, c, d = to_state_matrices(loop.controller)
    if not len(a):
        return
    for source in RULES:
        analog = _undo_sampling(a, b, c, d, record.dt, source)
        if analog is None:
            continue
        for rule in RULES:
            if rule == source:
                continue
            sampled = _sample_matrices(*analog, record.dt, rule)
            if sampled is None:
                continue
            yield LawChange(
                "filter", f"what {RULES[rule]} makes of the analog law behind it, where the stated "
                f"law is what {RULES[source]} makes of it",
                exchange_controller(loop, ct.ss(*sampled, record.dt)), record, exact=True,
            )  # fmt: skip


# By name: s is (z - 1)/T, (z - 1)/(T z) or 2 (z - 1)/(T (z + 1)), or the error is held.
RULES = {"tustin": "Tustin's rule", "backward": "the backward difference",
         "forward": "the forward difference", "zoh": "a held error"}  # fmt: skip
SHARES = {"forward": 0.0, "backward": 1.0, "tustin": 0.5}


def _undo_sampling(
    a: Any, b: Any, c: Any, d: Any, dt: float, rule: str
) -> tuple[Any, Any, Any, Any] | None:
    """Return the matrices in continuous time that a rule of sampling gave, None if there are none.

    With the share w of the newer sample, the rule is ``x+ = x + T (1 - w) rate + T w rate+``.
    """
    n = len(a)
    if rule == "zoh":
        values = np.linalg.eigvals(a)
        if np.any((np.abs(values.imag) < 1e-12) & (values.real < 1e-9)):
            return None
        block = np.zeros((n + b.shape[1],) * 2)
        block[:n, :n], block[:n, n:], block[n:, n:] = a, b, np.eye(b.shape[1])
        root = np.real(linalg.logm(block)) / dt
        return root[:n, :n], root[:n, n:], c, d
    w = SHARES[rule]
    middle = (1 - w) * np.eye(n) + w * a
    if np.linalg.cond(middle) > 1e9:
        return None
    inverse = np.linalg.inv(middle)
    return (a - np.eye(n)) @ inverse / dt, inverse @ b / dt, c @ inverse, d - w * c @ inverse @ b


def _sample_matrices(
    a: Any, b: Any, c: Any, d: Any, dt: float, rule: str
) -> tuple[Any, Any, Any, Any] | None:
    """Return the matrices in discrete time that a rule of sampling gives, None if unstable."""
    if rule == "zoh":
        return signal.cont2discrete((a, b, c, d), dt, "zoh")[:4]
    w = SHARES[rule]
    if np.linalg.cond(np.eye(len(a)) - w * dt * a) > 1e9:
        return None
    sampled = signal.cont2discrete((a, b, c, d), dt, "gbt", alpha=w)[:4]
    return None if np.abs(np.linalg.eigvals(sampled[0])).max() > 1 + 1e-9 else sampled


# --- helpers


def _take_longest(record: Record) -> Record:
    """Return the head of the longest stretch of valid samples."""
    return record[find_longest_run(record.valid)][:TRIAL]


def _find_inner(part: Record) -> Any:
    """Return which samples of u are at neither end of its values."""
    return (part.u > np.min(part.u)) & (part.u < np.max(part.u))


def _has_limits(loop: Loop) -> bool:
    """Tell whether the loop or its controller limits the input."""
    return bool(np.isfinite(find_input_limits(loop)).any())


def _is_nonlinear(loop: Loop) -> bool:
    return not isinstance(
        loop.controller, PID | ct.TransferFunction | ct.StateSpace | int | float | np.number
    )


def take_limits_off(loop: Loop) -> Loop:
    """Return the loop without limits of its input or its controller, which then needs no windup."""
    free = exchange_limits(loop)
    if isinstance(free.controller, PID):
        free = exchange_controller(
            free, replace(free.controller, lower=-np.inf, upper=np.inf, anti_windup="none")
        )
    return free


def _read_polynomials(controller: Any) -> tuple[Any, Any]:
    """Return numerator and denominator of a linear controller of one input."""
    law = controller if isinstance(controller, ct.TransferFunction) else ct.ss2tf(controller)
    return np.trim_zeros(law.num[0][0], "f"), np.trim_zeros(law.den[0][0], "f")
