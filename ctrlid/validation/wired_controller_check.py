"""Whether logged inputs are what a controller of several signals computes from the logged ones."""

from typing import Any

import numpy as np
from scipy import stats

from .._base.errors import CtrlidError
from .._base.text import write_percent
from ..data.record import Record
from ..data.validity import find_whole_past
from ..loop.controller_replay import replay_controller
from ..loop.loop import Loop
from ..loop.wiring import knows_references, match_signals
from .controller_changes import FEWEST
from .controller_check import EXACT, IMMATERIAL, LEVEL, MEMORY, MOST, REJECTED, Fact
from .residual_tests import compute_explained_share
from .signal_defects import find_grid_step

# A remainder whose own past tells it exactly follows the outputs above this share.
FOLLOWS = 0.2
# Below this share of its variance the remainder of a regression is rounding of the computer.
ROUNDING = 1e-12


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
    record = match_signals(record, e)
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
    rows = list(zip(e.inputs, left, inputs, strict=True))
    told = [_explain_row(loop, name, row, u, part, use)
            for name, row, u in rows if not _is_rounding_of(row, u, use)]  # fmt: skip
    return told or [("exact", "the logged u is exactly what the controller of the loop computes "
                     "from the logged signals.", 0.0, False)]  # fmt: skip


def find_wired_rejection(loop: Loop, record: Record) -> str:
    """Return why the stated law is not what computed the logged inputs; see `find_rejection`."""
    for kind, text, share, _ in check_wired_controller(loop, record):
        if kind in REJECTED and not (kind == "unknown" and share < IMMATERIAL):
            return text
    return ""


def _is_rounding_of(e: Any, u: Any, use: Any) -> bool:
    """Tell whether what is left of one input is no more than the rounding of its log."""
    step = find_grid_step(u[use])
    small = float(np.mean(e[use] ** 2)) <= EXACT * max(float(np.var(u[use])), 1e-300)
    return small or (bool(step) and float(np.max(np.abs(e[use]))) <= 0.51 * step)


def _explain_row(loop: Loop, name: str, e: Any, u: Any, record: Record, use: Any) -> Fact:
    """Say what the part of one of several inputs is that does not come from the controller."""
    share = float(np.mean(e[use] ** 2)) / max(float(np.var(u[use])), 1e-300)
    rms = f"{float(np.sqrt(np.mean(e[use] ** 2))):.3g}"
    if float(np.ptp(e[use])) <= 1e-6 * float(np.ptp(u[use])):
        return ("bias", f"{name} is the output of the controller of the loop plus a constant of "
                f"{float(np.mean(e[use])):.4g}. Correct the bias of the controller or the input of "
                "the operating point.", share, True)  # fmt: skip
    inputs = loop.equations().inputs
    lower, upper = (np.broadcast_to(v, len(inputs)) for v in loop.input_limits)
    k = inputs.index(name)
    ys = np.reshape(record.y, (-1, record.n))
    rs = np.zeros((0, record.n)) if record.r is None else np.reshape(record.r, (-1, record.n))
    inner = use & (u > lower[k]) & (u < upper[k])
    if _is_row_independent(e, u - e, ys, rs, inner, use):
        return ("injected", f"in addition to the output of the controller, {name} contains a "
                f"signal of RMS {rms} that does not depend on the outputs: excitation, dither or "
                "rounding.", share, False)  # fmt: skip
    return ("unknown", "the controller of the loop does not explain "
            f"{write_percent(min(share, 1.0), 3)} of the variance of {name} (RMS {rms}), and this "
            "part depends on the outputs: the true controller has other gains or another "
            "structure. Correct the controller, or give None.", share, True)  # fmt: skip


def _is_row_independent(e: Any, law: Any, ys: Any, rs: Any, inner: Any, use: Any) -> bool:
    """Test whether a remainder is independent of all outputs up to now, given r and its past.

    Of what the law itself made of them it is asked alone, too, which tells another gain best.
    """
    moves = use[1:] & use[:-1] & (np.abs(np.diff(ys[0])) > 1e-6 * np.ptp(ys[0][use]))
    held = np.abs(np.diff(e)) <= 1e-6 * np.ptp(e[use])
    if moves.any() and np.mean(held[moves]) > 0.5:
        return True
    rows = np.flatnonzero(find_whole_past(use, MEMORY) & inner)
    lags = range(MEMORY + 1)

    def follows() -> bool:
        moving = [(s, 0) for s in (*ys, *rs) if np.ptp(s[use]) > 0]
        return compute_explained_share(np.where(use, e, 0.0), moving, use, lags=MEMORY) > FOLLOWS

    if len(rows) <= 4 * ((1 + len(ys) + len(rs)) * MEMORY + 3):
        return not follows()

    def scale(v: Any) -> Any:
        return (v - np.mean(v[use])) / max(float(np.std(v[use])), 1e-300)

    e, ys, rs = scale(e), [scale(v) for v in ys], [scale(v) for v in rs]
    own = np.column_stack([np.ones(len(rows)), *(e[rows - k] for k in lags[1:]),
                           *(r[rows - k] for r in rs for k in lags)])  # fmt: skip
    without, few = _regress(own, e[rows])
    if without <= ROUNDING * len(rows):
        return not follows()
    chances = [1.0]
    for more in ([y[rows - k] for y in ys for k in lags], [scale(law)[rows]]):
        left, many = _regress(np.column_stack([own, *more]), e[rows])
        if many > few:
            ratio = (without - left) / (many - few) / max(left / (len(rows) - many), 1e-300)
            chances.append(float(stats.f.sf(ratio, many - few, len(rows) - many)))
    return bool(min(chances) >= LEVEL / 2)


def _regress(table: Any, goal: Any) -> tuple[float, int]:
    """Return the sum of squares that a regression leaves, and its number of coefficients."""
    solution, _, rank, _ = np.linalg.lstsq(table, goal, rcond=1e-10)
    return float(np.sum((goal - table @ solution) ** 2)), int(rank)
