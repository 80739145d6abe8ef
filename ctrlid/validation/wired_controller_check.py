"""Whether logged inputs are what a controller of several signals computes from the logged ones."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from .._base.errors import CtrlidError
from .._base.text import write_percent
from ..data.record import Record
from ..data.validity import find_longest_run
from ..loop.controller_replay import replay_controller
from ..loop.loop import Loop
from ..loop.wiring import knows_references, match_signals
from .controller_changes import FEWEST, TRIAL
from .controller_check import (
    CLEARLY,
    EXACT,
    FOLLOWS,
    MOST,
    Fact,
    is_independent,
    is_rounding,
    pick_rejection,
)
from .residual_tests import compute_explained_share

# What differs in this share of a record at its beginning, and hardly after it, is a start from
# another state.
BEGINNING = 0.2
DIED_DOWN = 1e-2


def check_wired_controller(loop: Loop, record: Record) -> list[Fact]:
    """Compare each logged input with what a digital controller of several signals computes.

    Of a wrong law it is told that it is wrong, that a constant is added, or which signal has the
    other sign or is exchanged with which.

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
    if not any(b - a >= FEWEST for a, b in part.segments()):
        return []  # Nowhere are all readings known that the controller had.
    try:
        remainder = _compute_remainder(loop, part)
    except CtrlidError as reason:  # The audit prints a refusal among its facts.
        return [("refused", "u cannot be computed with the controller of the loop: "
                 f"{reason}.", 1.0, True)]  # fmt: skip
    told = _explain_rows(loop, part, *remainder)
    if _may_be_mixed_up(part, told, *remainder):
        told = _find_mixed_up_signals(loop, part, _measure_share(part, *remainder)) or told
    exact = ("exact", "the logged u is exactly what the controller of the loop computes from the "
             "logged signals.", 0.0, False)  # fmt: skip
    return told or [exact]


def _compute_remainder(loop: Loop, record: Record) -> tuple[Any, Any]:
    """Return what the controller leaves of each input, and the samples on which that is known."""
    inputs = _list_rows(record, "u")
    left, use = np.zeros(inputs.shape), np.zeros(record.n, dtype=bool)
    for a, b in [(a, b) for a, b in record.segments() if b - a >= FEWEST]:
        replayed = replay_controller(loop, record[a:b])
        left[:, a:b] = inputs[:, a:b] - np.reshape(replayed, (len(inputs), -1))
        use[a:b] = True
    return left, use


def _list_rows(record: Record, key: str) -> Any:
    """Return the series of r, u or y with a row for each signal; none where there is no r."""
    values = getattr(record, key)
    return np.zeros((0, record.n)) if values is None else np.reshape(values, (-1, record.n))


def _measure_share(record: Record, left: Any, use: Any) -> float:
    """Return the share of the inputs' variance that is left, in the mean over all inputs."""
    spread = np.maximum(np.var(_list_rows(record, "u")[:, use], axis=1), 1e-300)
    return float(np.mean(np.mean(left[:, use] ** 2, axis=1) / spread))


def _explain_rows(loop: Loop, record: Record, left: Any, use: Any) -> list[Fact]:
    """Say of each input what its part is that does not come from the controller."""
    rows = zip(loop.equations().inputs, left, _list_rows(record, "u"), strict=True)
    told = [_explain_row(loop, name, row, u, record, use) for name, row, u in rows]
    return [fact for fact in told if fact is not None]


def _may_be_mixed_up(record: Record, told: list[Fact], left: Any, use: Any) -> bool:
    """Tell whether signals of another sign, or exchanged ones, may be what is left of the inputs.

    A wrong sign of a reference leaves what does not depend on the outputs, as dither does. Unlike
    dither it follows the references.
    """
    if any(kind == "unknown" for kind, *_ in told):
        return True
    references = [(r, 0) for r in _list_rows(record, "r")]
    return any(kind == "injected" for kind, *_ in told) and any(
        compute_explained_share(np.where(use, e, 0.0), references, use) > FOLLOWS for e in left
    )


def _list_mixed_up_records(record: Record) -> Iterator[tuple[str, str, Record]]:
    """Yield kind, words, and the record with one sign the other way round or two exchanged."""
    for key, names in record.signals.items():
        rows = _list_rows(record, key)
        shape = np.shape(getattr(record, key))
        for k, name in enumerate(names):
            # Of a signal that does not move the sign is a matter of the constant.
            if np.ptp(rows[k]) > 0:
                signs = np.where(np.arange(len(names)) == k, -1.0, 1.0)[:, None]
                other: dict[str, Any] = {key: np.reshape(signs * rows, shape)}
                yield "sign", f"with the opposite sign of {name}", replace(record, **other)
        for i, j in combinations(range(len(names)), 2):
            order = list(range(len(names)))
            order[i], order[j] = j, i
            fields: dict[str, Any] = {key: rows[order]}
            if key == "y" and record.valid.ndim == 2:
                fields["valid"] = record.valid[order]
            yield "exchange", f"with {names[i]} and {names[j]} exchanged", replace(record, **fields)


def _find_mixed_up_signals(loop: Loop, record: Record, share: float) -> list[Fact]:
    """Return which signal has the other sign, or which two are exchanged; empty where none is.

    That is what leaves only rounding or an added signal, and a tenth of what was unexplained.
    """
    # A law that explains nothing may leave any number of times the variance.
    share = min(share, 1.0)
    trial = record[find_longest_run(record.valid_samples)][:TRIAL]
    found: list[tuple[str, str, float, list[Fact]]] = []
    for (kind, words, short), (_, _, whole) in zip(
        _list_mixed_up_records(trial), _list_mixed_up_records(record), strict=True
    ):
        # A law that reads what was not meant for it may run away.
        with np.errstate(all="ignore"):
            left = _measure_share(short, *_compute_remainder(loop, short))
        if not left <= CLEARLY * share:
            continue
        remainder = _compute_remainder(loop, whole)
        left, told = _measure_share(whole, *remainder), _explain_rows(loop, whole, *remainder)
        harmless = all(kind != "unknown" for kind, *_ in told)
        if harmless and left <= CLEARLY * share and not _may_be_mixed_up(whole, told, *remainder):
            found.append((kind, words, left, told))
    if not found:
        return []
    least = min(left for _, _, left, _ in found)
    # A signal at rest may hide which of two it is, so that all that leave as little are told.
    alike = [one for one in found if one[2] <= 2 * least + EXACT]
    kind, _, left, told = alike[0]
    words = " or ".join(words for _, words, _, _ in alike)
    rest = "what rounding leaves" if left < EXACT else write_percent(left)
    text = (f"u is not what the controller of the loop computes from the logged signals, but "
            f"{words} it is: what remains unexplained falls from {write_percent(share)} of the "
            f"variance of u to {rest}. Correct the log, or the signs and the wiring of the "
            "controller.")  # fmt: skip
    return [(kind, text, share, True), *told]


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
