"""Whether logged inputs are what a controller of several signals computes from the logged ones."""

from typing import Any

import numpy as np

from .._base.errors import CtrlidError
from .._base.text import write_percent
from ..data.record import Record
from ..loop.controller_replay import replay_controller
from ..loop.loop import Loop
from ..loop.wiring import knows_references, match_signals
from .controller_changes import FEWEST
from .controller_check import MOST, Fact, is_independent, is_rounding, pick_rejection

# What differs in this share of a record at its beginning, and hardly after it, is a start from
# another state.
BEGINNING = 0.2
DIED_DOWN = 1e-2


def check_wired_controller(loop: Loop, record: Record) -> list[Fact]:
    """Compare each logged input with what a digital controller of several signals computes.

    Of a wrong law it is told that it is wrong, or that a constant is added.

    Parameters
    ----------
    loop : Loop
        The loop.
    record : Record
        The record.

    Returns
    -------
    list of (str, str, float, bool)
        As `check_controller` has them.
    """
    law, e = loop.law(), loop.equations()
    if law is None or law.dt == 0.0 or not knows_references(loop.wiring, record):
        return []
    record = match_signals(record, e, loop.wiring)
    first = int(np.argmax(record.valid_samples))
    if record.n - first < FEWEST:
        return []
    part = record[first : first + MOST]
    inputs = np.reshape(part.u, (len(e.inputs), -1))
    left, use = np.zeros(inputs.shape), np.zeros(part.n, dtype=bool)
    try:
        for a, b in [(a, b) for a, b in part.segments() if b - a >= FEWEST] or [(0, part.n)]:
            replayed = replay_controller(loop, part[a:b])
            left[:, a:b] = inputs[:, a:b] - np.reshape(replayed, (len(inputs), -1))
            use[a:b] = True
    except CtrlidError as reason:  # The audit prints a refusal among its facts.
        return [("refused", "u cannot be computed with the controller of the loop: "
                 f"{reason}.", 1.0, True)]  # fmt: skip
    rows = zip(e.inputs, left, inputs, strict=True)
    told = [_explain_row(loop, name, row, u, part, use) for name, row, u in rows]
    exact = ("exact", "the logged u is exactly what the controller of the loop computes from the "
             "logged signals.", 0.0, False)  # fmt: skip
    return [fact for fact in told if fact is not None] or [exact]


def find_wired_rejection(loop: Loop, record: Record) -> str:
    """Return why the stated law is not what computed the logged inputs; see `find_rejection`."""
    return pick_rejection(check_wired_controller(loop, record))


def _find_end_of_start(e: Any) -> int | None:
    """Return after how many samples a remainder has died down; None if it does not."""
    first = int(BEGINNING * len(e))
    if np.sum(e[first:] ** 2) > DIED_DOWN * np.sum(e**2):
        return None
    return int(np.flatnonzero(np.abs(e) > 0.01 * np.max(np.abs(e)))[-1]) + 1


def _explain_row(loop: Loop, name: str, e: Any, u: Any, record: Record, use: Any) -> Fact | None:
    """Say what the part of one of several inputs is that does not come from the controller.

    None where it is rounding of the log.
    """
    share = float(np.mean(e[use] ** 2)) / max(float(np.var(u[use])), 1e-300)
    if is_rounding(e[use], share, u[use]):
        return None
    rms = f"{float(np.sqrt(np.mean(e[use] ** 2))):.3g}"
    if float(np.ptp(e[use])) <= 1e-6 * float(np.ptp(u[use])):
        return ("bias", f"{name} is the output of the controller of the loop plus a constant of "
                f"{float(np.mean(e[use])):.4g}. Correct the bias of the controller or the input of "
                "the operating point.", share, True)  # fmt: skip
    lasts = _find_end_of_start(np.where(use, e, 0.0))
    if lasts is not None:
        return ("start", f"{name} is what the controller of the loop computes, but for the first "
                f"{lasts * record.dt:.3g} s (RMS {rms} over the record): the controller of the rig "
                "began in another state than that of the loop. Leave these samples out with valid= "
                "where they matter.", share, False)  # fmt: skip
    inputs = loop.equations().inputs
    lower, upper = (np.broadcast_to(v, len(inputs)) for v in loop.input_limits)
    k = inputs.index(name)
    ys, rs = (
        [] if v is None else list(np.reshape(v, (-1, record.n))) for v in (record.y, record.r)
    )
    inner = use & (u > lower[k]) & (u < upper[k])
    if is_independent(np.where(use, e, 0.0), ys, rs, inner, use, u - e):
        return ("injected", f"in addition to the output of the controller, {name} contains a "
                f"signal of RMS {rms} that does not depend on the outputs: excitation, dither or "
                "rounding.", share, False)  # fmt: skip
    return ("unknown", "the controller of the loop does not explain "
            f"{write_percent(min(share, 1.0), 3)} of the variance of {name} (RMS {rms}), and this "
            "part depends on the outputs: the true controller has other gains or another "
            "structure. Correct the controller or the log, or give None.", share, True)  # fmt: skip
