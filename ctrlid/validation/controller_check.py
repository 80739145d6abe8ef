"""Whether a logged u is what the controller computes from the logged r and y; if not, why."""

from dataclasses import replace
from typing import Any

import numpy as np

from .._base.errors import CtrlidError
from ..data.record import Record
from ..loop.controller_replay import replay_controller
from ..loop.loop import Loop
from .residual_tests import compute_explained_share

# At most so many samples are replayed, which tell enough and take seconds.
MOST = 20_000
# Each shift of a channel is tried on so many samples only, to save time.
TRIAL = 4000
# Fewer samples do not tell whether a controller computed the input.
FEWEST = 20
# A channel may have been logged so many samples late, or early if negative.
STEPS = (1, -1, 2, -2, 3, -3)
# Rounding and printing leave at most this share of u's variance.
EXACT = 1e-6
# A shift is believed if it leaves less than this share of what was unexplained.
CLEARLY = 0.1
# If a larger share of what is left follows r and y, the controller is another one.
FOLLOWS = 0.2

# A fact is its kind, its words, the unexplained share of u's variance, and whether it is harmful.
Fact = tuple[str, str, float, bool]


def check_controller(loop: Loop, record: Record) -> list[Fact]:
    """Compare the logged input with a replay of the loop's digital controller.

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
        empty if there is no digital controller, no reference, or too little to compare.
    """
    law = loop.law()
    if law is None or law.dt == 0.0 or record.r is None:
        return []
    first = int(np.argmax(record.valid))
    if record.n - first < FEWEST:
        return []
    part = record[first : first + MOST]
    facts: list[Fact] = []
    lower, upper = loop.input_limits
    slack = 1e-6 * (float(np.ptp(part.u)) + 1e-300)
    beyond = float(np.mean((part.u < lower - slack) | (part.u > upper + slack)))
    if beyond:
        facts.append(("limits", f"u is outside the input limits of the loop ({lower:g} to "
                      f"{upper:g}) for {100 * beyond:.2g} % of the samples: u was logged before "
                      "the limiter, or the limits are wrong. Limit u before fitting, or correct "
                      "input_limits=.", beyond, True))  # fmt: skip
        loop = replace(loop, input_limits=(-np.inf, np.inf))
    try:
        e, left = _compute_remainder(loop, part)
    except CtrlidError as reason:  # The audit prints a refusal among its facts.
        return [*facts, ("refused", "u cannot be computed with the controller of the loop: "
                         f"{reason}.", 1.0, True)]  # fmt: skip
    if left <= EXACT:
        return [*facts, ("exact", "the logged u is exactly what the controller of the loop "
                         "computes from r and y.", left, False)]  # fmt: skip
    shift = _find_shift(loop, part, left)
    if shift is not None:
        words, moved, remains = shift
        facts.append(("late", f"{words}: the controller of the loop explains "
                      f"{100 * (1 - left):.4g} % of the variance of u as logged, and "
                      f"{100 * (1 - remains):.4g} % with this shift removed. Shift the channel "
                      "back before fitting.", left, True))  # fmt: skip
        part = moved
        e, left = _compute_remainder(loop, part)
        if left <= EXACT:
            return facts
    facts.append(_explain_remainder(e, left, part))
    return facts


def _compute_remainder(loop: Loop, record: Record) -> tuple[Any, float]:
    """Return what the controller leaves of u, and its share of the variance."""
    e = record.u - replay_controller(loop, record)
    counts = record.valid if record.valid.sum() > 1 else np.ones(record.n, bool)
    spread = float(np.var(record.u[counts]))
    return e, float(np.mean(e[counts] ** 2)) / max(spread, 1e-300)


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


def _explain_remainder(e: Any, left: float, record: Record) -> Fact:
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
    moving = [(s, 0) for s in (record.y, record.r) if np.ptp(s[record.valid]) > 0]
    follows = compute_explained_share(e, moving, record.valid, lags=10)
    if follows > FOLLOWS:
        share = f"{100 * left:.3g} % of the variance of u" if left < 1 else "u"
        return ("other", f"the controller of the loop does not explain {share} (RMS {rms}), and "
                f"{100 * follows:.0f} % of this part depends on r and y: the true controller has "
                "other gains or another structure, or a slow signal is added to u. Correct the "
                "controller, or give None.", left, True)  # fmt: skip
    return ("injected", f"in addition to the output of the controller, u contains a signal of RMS "
            f"{rms} that does not depend on r and y: excitation, dither or rounding.", left,
            False)  # fmt: skip
