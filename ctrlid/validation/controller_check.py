"""Whether a logged u is what the controller computes from the logged r and y; if not, why."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from scipy import stats

from .._base.errors import CtrlidError
from .._base.periods import have_same_period
from .._base.statistics import regress
from .._base.text import write_count, write_percent
from ..data.converter_grid import find_grid_step
from ..data.record import Record
from ..data.validity import find_longest_run, find_whole_past
from ..loop.controller_replay import (
    differentiate_replay,
    replay_controller,
    replay_from_best_state,
    sample_analog_controller,
)
from ..loop.controller_sight import find_sight
from ..loop.controllers import PID
from ..loop.loop import (
    Loop,
    exchange_constant_input,
    exchange_controller,
    exchange_limits,
    find_input_limits,
)
from ..loop.sampled_form import describe_sampled_form, find_sampled_form
from ..loop.wiring import knows_references
from .controller_changes import (
    DETERMINED,
    FEWEST,
    TRIAL,
    list_changes,
    measure_opposite_sign,
    scale_controller,
    take_limits_off,
)
from .residual_tests import compute_explained_share

# At most so many samples are replayed, which tell enough and take seconds.
MOST = 20_000
# A channel may have been logged so many samples late, or early if negative.
STEPS = (1, -1, 2, -2, 3, -3)
# Rounding and printing leave at most this share of u's variance.
EXACT = 1e-6
# Between samples that are held or straight, so much of the difference is not resolved.
UNRESOLVED = 0.5
# A shift is believed if it leaves less than this share of what was unexplained.
CLEARLY = 0.1
# Where the past of an added signal tells it exactly, it follows r and y above this share.
FOLLOWS = 0.2
# A remainder that the present and past of y tells is an independent one with this probability.
LEVEL = 1e-3
# An added signal is told by so many samples of its own past, of r and of y.
MEMORY = 10
# A law that is asked off its limits alone is asked on at least this share of the samples.
MOSTLY = 0.5
# Below this share of its variance the remainder of a regression is rounding of the computer.
ROUNDING = 1e-12
# Changes of a law are put out by so many samples, most of them at once.
BEGINNING = 1000
# What is below this share of u's variance is written with all its zeros.
HARDLY = 1e-5
# A remainder below this share of u's variance steers no simulation.
IMMATERIAL = 0.01
# A law that explains so much of u by a negative factor has the wrong sign, whatever else it lacks.
OPPOSITE = 0.5
# Kinds of finding after which the stated law is not that of the record.
REJECTED = ("gain", "sign", "exchange", "delay", "limit", "filter", "sampled", "anti-windup",
            "logger", "unknown")  # fmt: skip
# Of these, what leaves an immaterial share of u steers no simulation.
SMALL_MATTERS = ("anti-windup", "logger", "unknown")
# These look the same where the log of a signal has them and not the controller.
MIRRORED = ("gain", "sign")
# What may be wrong with a stated law; a constant that is added to it leaves it standing.
FAULTS = (*REJECTED, "bias")

# A fact is its kind, its words, the unexplained share of u's variance, and whether it is harmful.
Fact = tuple[str, str, float, bool]


def check_controller(loop: Loop, record: Record) -> list[Fact]:
    """Compare the logged input with a replay of the loop's controller.

    Of an analog controller, the log has r and y at the samples only. What it leaves of u is no more
    than the log resolves where it is less than what another run of y between the samples would do.
    Where a sampled form of it computes u down to rounding, it was no analog one.

    Parameters
    ----------
    loop : Loop
        The loop.
    record : Record
        The record.

    Returns
    -------
    list of (str, str, float, bool)
        Kind, words, share of u that the controller does not explain, and whether it is harmful;
        empty if there is no controller, a nonlinear analog one, no reference, or too little to
        compare.
    """
    law = loop.law()
    if law is None or record.r is None:
        return []
    first = int(np.argmax(record.valid))
    if record.n - first < FEWEST:
        return []
    part = record[first : first + MOST]
    resolution, sample, seen = 0.0, None, ""
    if law.dt == 0.0:
        form = find_sampled_form(loop.controller, part, loop.equations().outputs[0])
        if form is not None:
            text = describe_sampled_form(form, part, "the loop")
            return [("sampled", text, form.analog, True)]
        sampled = _sample_analog_law(loop, part)
        if sampled is None:
            return []
        if find_sight(loop, part) == "output":
            seen = (" The controller sees the output itself: the noise of y is that of the logger "
                    "alone.")  # fmt: skip
        loop, resolution, sample = sampled
    facts: list[Fact] = []
    lower, upper = loop.input_limits
    logged = part.u[part.valid]
    slack = 1e-6 * (float(np.ptp(logged)) + 1e-300)
    beyond = float(np.mean((logged < lower - slack) | (logged > upper + slack)))
    if beyond:
        facts.append(("limit", f"u is outside the input limits of the loop ({lower:g} to "
                      f"{upper:g}) for {write_percent(beyond)} of the samples: u was logged before "
                      "the limiter, or the limits are wrong. Limit u before fitting, or correct "
                      "input_limits=.", beyond, True))  # fmt: skip
        loop = exchange_limits(loop)
    try:
        e, left = _compute_remainder(loop, part)
    except CtrlidError as reason:  # The audit prints a refusal among its facts.
        return [*facts, ("refused", "u cannot be computed with the controller of the loop: "
                         f"{reason}.", 1.0, True)]  # fmt: skip
    if is_rounding(e, left, part.u[part.valid], resolution):
        constant = _read_constant(loop, part)
        if constant:
            return [*facts, _report_bias(constant, left)]
        if resolution:
            return [*facts, ("exact", "the logged u is what the analog controller of the loop "
                             f"computes from r and y, as far as samples tell.{seen}", left,
                             False)]  # fmt: skip
        return [*facts, ("exact", "the logged u is exactly what the controller of the loop "
                         "computes from r and y.", left, False)]  # fmt: skip
    shift = _find_shift(loop, part, left)
    if shift is not None:
        words, moved, remains = shift
        e, least = _compute_remainder(loop, moved)
        exact = is_rounding(e, least, moved.u[moved.valid], resolution)
        # A shift that leaves something may stand for another law, which leaves nothing.
        wrong = None if exact else _find_wrong_law(loop, part, left, True, resolution, sample)
        if wrong is not None:
            return [*facts, wrong]
        facts.append(("delay", f"{words}: the controller of the loop explains "
                      f"{write_percent(1 - left, 4)} of the variance of u as logged, and "
                      f"{write_percent(1 - remains, 4)} with this shift removed. Shift the channel "
                      "back before fitting.", left, True))  # fmt: skip
        if exact:
            return facts
        part, left = moved, least
    stated = _explain_remainder(loop, e, left, part, resolution)
    if seen and stated[0] == "injected":
        stated = (stated[0], stated[1] + seen, *stated[2:])
    # Another form of a derivative adds a function of r, and only its exact replay tells it.
    exact_only = stated[0] == "injected" and not resolution
    if stated[0] == "bias":
        return [*facts, stated]
    wrong = _find_wrong_law(loop, part, left, exact_only, resolution, sample)
    wrong = wrong or _find_law_off_limits(loop, part, left, resolution)
    if wrong is None and stated[0] == "unknown":
        wrong = _find_opposite_sign(loop, part, left)
    return [*facts, wrong or stated]


def find_rejection(loop: Loop, record: Record) -> str:
    """Return why the stated law is not what computed the logged u; empty where it stands.

    An added signal that is independent of y, or a constant one, does not speak against a law. Nor
    does a remainder without a name, or of another rule at the limits, that is far smaller than u:
    no real record is exact to the last digit.
    """
    return pick_rejection(check_controller(loop, record))


def pick_rejection(facts: Sequence[Fact]) -> str:
    """Return the words of the first fact that speaks against a law; empty without one."""
    for kind, text, share, _ in facts:
        if kind in REJECTED and not (kind in SMALL_MATTERS and share < IMMATERIAL):
            return text
    return ""


def _compute_remainder(loop: Loop, record: Record) -> tuple[Any, float]:
    """Return what the controller leaves of u, and its share of the variance.

    Samples that do not count leave the state of the controller unknown, so that each stretch is
    replayed from its own best state. What is too short to tell it leaves nothing.
    """
    e, counts = np.zeros(record.n), np.zeros(record.n, bool)
    long = [(a, b) for a, b in record.segments() if b - a >= FEWEST]
    for a, b in long or [(0, record.n)]:
        e[a:b] = record.u[a:b] - replay_controller(loop, record[a:b])
        counts[a:b] = True
    spread = float(np.var(record.u[counts]))
    return e, float(np.mean(e[counts] ** 2)) / max(spread, 1e-300)


def _sample_analog_law(
    loop: Loop, record: Record
) -> tuple[Loop, float, Callable[[Any], Loop | None]] | None:
    """Return the loop with its analog controller at the samples, and the share of u they resolve.

    r and y are taken as held or as straight, whichever leaves least of u; some of what is between
    the two runs of y is not resolved. Only where the law as stated leaves far more with all of
    them, r runs as the record says, and a factor and a constant are allowed for. Last comes a
    function of an analog filter that gives such a loop with the filter in it.
    """
    part = record[find_longest_run(record.valid)][:TRIAL]
    runs = []
    # Which way r runs is for the record to say, and no fault of the law.
    for hold_r, hold in product(("foh", "zoh"), ("foh", "zoh")):
        sampled = sample_analog_controller(loop, hold_r, hold)
        if sampled is None:
            return None
        free = exchange_limits(sampled)
        if not have_same_period(loop.dt, record.dt):
            return sampled, EXACT, lambda _: None  # The replay refuses it in words.
        output, responses, rest = differentiate_replay(free, part)
        table = np.column_stack([output - rest, np.ones(part.n), responses])
        stated, scaled = (
            float(np.mean((goal - columns @ regress(columns, goal, DETERMINED)) ** 2))
            for goal, columns in ((part.u - output, responses), (part.u, table))
        )
        runs.append((stated, scaled, hold_r, hold, sampled, output))

    def resolve(run: tuple[Any, ...]) -> float:
        """Return the variance of u that the samples leave open."""
        other = next(one for one in runs if one[2] == run[2] and one[3] != run[3])
        return UNRESOLVED**2 * float(np.var(run[-1] - other[-1]))

    best = min(runs, key=lambda run: run[0])
    spread = max(float(np.var(part.u)), 1e-300)
    if best[0] > max(EXACT * spread, resolve(best)) / CLEARLY:
        best = min((run for run in runs if run[2] == record.hold_r), key=lambda run: run[1])
    _, _, hold_r, hold, sampled, _ = best

    def sample(factor: Any) -> Loop | None:
        changed = exchange_controller(loop, scale_controller(loop.controller, factor))
        return sample_analog_controller(changed, hold_r, hold)

    return sampled, max(EXACT, resolve(best) / spread), sample


def is_rounding(e: Any, left: float, u: Any, resolution: float = 0.0) -> bool:
    """Tell whether a remainder, a share of the variance, is no more than rounding of the logged u.

    `e` and `u` are the remainder and the input on the samples that count.
    """
    step = find_grid_step(u)
    return left <= max(EXACT, resolution) or (
        bool(step) and float(np.max(np.abs(e))) <= 0.51 * step
    )


def _shift_channels(record: Record, u: int, y: int) -> Record:
    """Return the record with u and y taken so many samples later than r."""
    a, b = max(0, -u, -y), record.n - max(0, u, y)
    cut = record[a:b]
    return replace(cut, u=record.u[a + u : b + u], y=record.y[a + y : b + y],
                   valid=record.valid[a + u : b + u] & record.valid[a + y : b + y])  # fmt: skip


def _find_shift(loop: Loop, record: Record, left: float) -> tuple[str, Record, float] | None:
    """Try u and y earlier and later; return the shift that explains far more, in words."""
    trial = record[:TRIAL]
    _, base = _compute_remainder(loop, trial)
    shifts = [(k, 0) for k in STEPS] + [(0, k) for k in STEPS] + [(k, k) for k in STEPS]
    tried = [(_compute_remainder(loop, _shift_channels(trial, u, y))[1], u, y) for u, y in shifts]
    best = min(left_over for left_over, _, _ in tried)
    if best > CLEARLY * min(base, left):
        return None
    # Around a constant reference a late u and an early y are the same; u is the likelier one.
    alike = [(u, y) for left_over, u, y in tried if left_over <= 2 * best + EXACT]
    u, y = alike[0]
    words = " or ".join(_describe_shift(*shift) for shift in alike)
    return words, _shift_channels(record, u, y), best


def _describe_shift(u: int, y: int) -> str:
    """Say which channel is late."""
    k, late = abs(u or y), "late" if (u or y) > 0 else "early"
    if u and y:
        return f"r is logged {_spell_samples(k)} {'early' if late == 'late' else 'late'}"
    return f"{'u' if u else 'y'} is logged {_spell_samples(k)} {late}"


def _spell_samples(k: int) -> str:
    return f"{('one', 'two', 'three')[k - 1]} sample{'s' if k > 1 else ''}"


def _find_law_off_limits(loop: Loop, record: Record, left: float, resolution: float) -> Fact | None:
    """Return that the law is exact but where u is at a limit; None where it is not.

    What an integral does at a limit (anti-windup) is a matter of many recipes, of which a PID of
    ctrlid knows three. Each visit of a limit leaves another state, so that every stretch between
    two of them is replayed from its own.
    """
    lower, upper = find_input_limits(loop)
    slack = 1e-6 * float(np.ptp(record.u[record.valid]))
    at_limit = record.valid & ((record.u <= lower + slack) | (record.u >= upper - slack))
    off = replace(record, valid=record.valid & ~at_limit)
    long = sum(b - a for a, b in off.segments() if b - a >= FEWEST)
    if not at_limit.any() or long < MOSTLY * np.count_nonzero(record.valid):
        return None
    e, remains = _compute_remainder(take_limits_off(loop), off)
    if not is_rounding(e, remains, record.u[off.valid], resolution):
        return None
    return ("anti-windup", "u is what the controller of the loop computes from r and y, but for "
            f"the {write_count(int(np.count_nonzero(at_limit)), 'sample')} at a limit of u and the "
            "state of the controller after them: it leaves its limits by another rule "
            "(anti-windup) than the stated one. Gains and structure are right.", left,
            left >= IMMATERIAL)  # fmt: skip


def _explain_remainder(loop: Loop, e: Any, left: float, record: Record, resolution: float) -> Fact:
    """Say what the part of u is that does not come from the controller."""
    assert record.r is not None
    unit = record.units.get("u", "")
    rms = f"{float(np.sqrt(np.mean(e[record.valid] ** 2))):.3g}" + (
        f" {unit}" if unit not in ("", "1") else ""
    )
    for name, channel in record.extra.items():
        like = float(np.corrcoef(channel[record.valid], e[record.valid])[0, 1] ** 2) if (
            np.ptp(channel[record.valid]) and np.ptp(e[record.valid])) else 0.0  # fmt: skip
        if like > 0.9:
            return ("injected", f"in addition to the output of the controller, u contains a signal "
                    f"of RMS {rms} that is correlated with the channel {name!r}.", left,
                    False)  # fmt: skip
    if float(np.ptp(e[record.valid])) <= 1e-6 * float(np.ptp(record.u[record.valid])):
        return _report_bias(float(np.mean(e[record.valid])), left)
    if not _is_added(loop, e, left, record, resolution):
        share = f"{write_percent(left, 3)} of the variance of u" if left < 1 else "u"
        if not resolution and _is_noise_of_log(e, record):
            return ("logger", f"the controller of the loop explains u but for {share} (RMS {rms}), "
                    "which follows y but hardly r and u, as noise does that only the "
                    "logger has: the logged y is not the reading that the controller had (another "
                    "converter or sensor). Gains and structure are right. Log what the controller "
                    "reads where that is possible.", left, left >= IMMATERIAL)  # fmt: skip
        return ("unknown", f"the controller of the loop does not explain {share} (RMS {rms}), and "
                "this part depends on y: the true controller has "
                "other gains or another structure. Correct the "
                "controller or the log, or give None.", left, True)  # fmt: skip
    if resolution:
        return ("injected", "the logged u is what the analog controller of the loop computes from "
                f"r and y, and a remainder of RMS {rms} that does not follow r: noise that only "
                "the logger sees, or an added signal.", left, False)  # fmt: skip
    return ("injected", f"in addition to the output of the controller, u contains a signal of RMS "
            f"{rms} that does not depend on y: excitation, dither, rounding, or another "
            "weight of r.", left, False)  # fmt: skip


def _report_bias(constant: float, left: float) -> Fact:
    return ("bias", "u is the output of the controller of the loop plus a constant of "
            f"{constant:.4g}. Correct the bias of the controller or the input of the operating "
            "point.", left, True)  # fmt: skip


def take_bias_from_log(loop: Loop, record: Record) -> Loop:
    """Return the loop with the bias that its digital controller adds to the logged u.

    Where nobody has stated a bias, the input that holds the model at rest is no more than a guess;
    held against the log it would be called a fault of the controller. A PID with a bias of its own
    and a loop whose log does not show it stay as they are.
    """
    stated = isinstance(loop.controller, PID) and loop.controller.bias is not None
    if loop.controller is None or loop.analog or stated or not loop.equations().siso:
        return loop
    if not knows_references(loop.wiring, record):
        return loop
    free = exchange_limits(loop)
    left = (record.u - replay_controller(free, record))[record.valid]
    # Where limits, pulses and dither act the controller is not alone.
    bias = loop.point.input + float(np.median(left)) + _read_constant(free, record)
    return exchange_constant_input(loop, bias)


def _read_constant(loop: Loop, record: Record) -> float:
    """Return the constant that the state of an integral without gain took over; 0 if none."""
    if not isinstance(loop.controller, PID) or loop.controller.ki:
        return 0.0
    longest = record[find_longest_run(record.valid)]
    constant = float(replay_from_best_state(loop, longest)[1][0])
    u = record.u[record.valid]
    seen = max(np.sqrt(EXACT) * float(np.std(u)), 0.5 * find_grid_step(u))
    return constant if abs(constant) > seen else 0.0


def _is_noise_of_log(e: Any, record: Record) -> bool:
    """Tell whether what a law leaves of u comes from noise that only the logged y has.

    The plant never sees such noise, so that what it leaves does not follow r, and what the
    controller read in its place is in u at most in part. What another law leaves is a function of r
    and u, from which it was computed.
    """
    moving = [(s, 0) for s in (record.r, record.u) if np.ptp(s[record.valid]) > 0]
    by_all = compute_explained_share(e, moving, record.valid, lags=4 * MEMORY)
    by_r = compute_explained_share(e, moving[:-1], record.valid, lags=4 * MEMORY)
    return by_r <= FOLLOWS and by_all <= 1 - FOLLOWS


def _is_independent(loop: Loop, e: Any, record: Record) -> bool:
    """Test whether a remainder is independent of y up to now, given r and its own past.

    The samples at the stated limits are left out, which cut off what was added.
    """
    assert record.r is not None
    u, (lower, upper) = record.u, find_input_limits(loop)
    inner = record.valid & (u > lower) & (u < upper)
    return is_independent(e, [record.y], [record.r], inner, record.valid)


def is_independent(
    e: Any, ys: Sequence[Any], rs: Sequence[Any], inner: Any, use: Any, law: Any = None
) -> bool:
    """Test whether a remainder is independent of the outputs up to now, given r and its own past.

    Under feedback the outputs follow an added signal, but tell nothing of it that its own past does
    not.

    Parameters
    ----------
    e : ndarray, shape (n,)
        What the law leaves of an input; zero where nothing counts.
    ys, rs : sequence of ndarray, shape (n,)
        Outputs and references.
    inner, use : ndarray of bool
        Samples that no limit cuts off, and all samples that count.
    law : ndarray, shape (n,), optional
        What the law makes of them. It is then asked alone, too, which tells another gain best.
    """
    y = ys[0]
    moves = use[1:] & use[:-1] & (np.abs(np.diff(y)) > 1e-6 * np.ptp(y[use]))
    held = np.abs(np.diff(e)) <= 1e-6 * np.ptp(e[use])
    # What holds its value while y moves is not computed from y, however regular its steps are.
    if moves.any() and np.mean(held[moves]) > 0.5:
        return True
    rows, lags = np.flatnonzero(find_whole_past(use, MEMORY) & inner), range(MEMORY + 1)
    if len(rows) <= 4 * ((1 + len(ys) + len(rs)) * MEMORY + 3):
        return not _follows(e, (*ys, *rs), use)

    def scale(v: Any) -> Any:
        return (v - np.mean(v[use])) / max(float(np.std(v[use])), 1e-300)

    z, outputs, references = scale(e), [scale(v) for v in ys], [scale(v) for v in rs]
    own = np.column_stack([np.ones(len(rows)), *(z[rows - k] for k in lags[1:]),
                           *(r[rows - k] for r in references for k in lags)])  # fmt: skip
    without, few = _regress(own, z[rows])
    if without <= ROUNDING * len(rows):
        return not _follows(e, (*ys, *rs), use)
    more = [[y[rows - k] for y in outputs for k in lags]]
    more += [] if law is None else [[scale(law)[rows]]]
    chances = [1.0]
    for columns in more:
        left, many = _regress(np.column_stack([own, *columns]), z[rows])
        if many > few:
            ratio = (without - left) / (many - few) / max(left / (len(rows) - many), 1e-300)
            chances.append(float(stats.f.sf(ratio, many - few, len(rows) - many)))
    return bool(min(chances) >= LEVEL / len(more))


def _regress(table: Any, goal: Any) -> tuple[float, int]:
    """Return the sum of squares that a regression leaves, and its number of coefficients."""
    solution, _, rank, _ = np.linalg.lstsq(table, goal, rcond=DETERMINED)
    return float(np.sum((goal - table @ solution) ** 2)), int(rank)


def _is_added(loop: Loop, e: Any, left: float, record: Record, resolution: float) -> bool:
    """Tell whether a remainder is a signal that was added to what the law computes.

    An analog controller does not see the noise of the logger, which its replay amplifies, so that
    only what follows the reference beyond the resolution speaks against its law.
    """
    if not resolution:
        return _is_independent(loop, e, record)
    assert record.r is not None
    share = compute_explained_share(e, [(record.r, 0)], record.valid, lags=4 * MEMORY)
    return share <= FOLLOWS or share * left <= resolution


def _follows(e: Any, channels: Sequence[Any], use: Any) -> bool:
    """Tell whether a remainder follows signals where its own past leaves nothing to be tested."""
    moving = [(s, 0) for s in channels if np.ptp(s[use]) > 0]
    return compute_explained_share(e, moving, use, lags=MEMORY) > FOLLOWS


def _find_wrong_law(
    loop: Loop, record: Record, left: float, exact_only: bool, resolution: float, sample: Any
) -> Fact | None:
    """Return which single change of the stated law leaves only rounding or an added signal."""
    most = CLEARLY * max(_compute_remainder(loop, record[:BEGINNING])[1], left)
    for change in list_changes(loop, record, sample):
        if np.count_nonzero(change.record.valid[:BEGINNING]) < FEWEST:
            continue
        if not _compute_remainder(change.loop, change.record[:BEGINNING])[1] <= most:
            continue
        e, remains = _compute_remainder(change.loop, change.record)
        if not remains <= CLEARLY * left:
            continue
        u = change.record.u[change.record.valid]
        rounded = is_rounding(e, remains, u, resolution)
        if rounded or (
            not (exact_only or change.exact)
            and _is_added(change.loop, e, remains, change.record, resolution)
        ):
            what = "the controller or the log" if change.kind in MIRRORED else "the controller"
            hardly = rounded and remains < HARDLY
            rest = "what rounding leaves" if hardly else _write_share(remains)
            text = (
                f"u is not what the controller of the loop computes from r and y, but "
                f"{change.words}: what remains unexplained falls from {_write_share(left)} of the "
                f"variance of u to {rest}. Correct {what}."
            )
            return change.kind, text, left, True
    return None


def _find_opposite_sign(loop: Loop, record: Record, left: float) -> Fact | None:
    """Return that the law has the wrong sign where a negative factor explains most of the input.

    Other gains, a limit or noise may be wrong beside it, so that no single change explains all.
    """
    factor, share = measure_opposite_sign(loop, record)
    if share < OPPOSITE:
        return None
    return ("sign", f"u has the opposite sign of what the controller of the loop computes from r "
            f"and y: {factor:.3g} times that explains {write_percent(share)} of the variance of u, "
            "and something else differs as well. Look first whether u is logged with the sign that "
            "the plant has, r and y are not exchanged, and the gains have their right sign; then "
            "correct the controller or the log.", left, True)  # fmt: skip


def _write_share(share: float) -> str:
    """Write a share in per cent however small, since a rejected law may leave hardly anything."""
    if share >= HARDLY:
        return write_percent(share)
    return f"{np.format_float_positional(100 * share, 1, fractional=False, trim='-')} %"
