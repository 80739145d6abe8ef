"""How u runs between its samples, as the record itself tells it."""

import math
from dataclasses import replace
from typing import get_args

import numpy as np

from .._base.errors import ModelCannotRun
from .._base.text import write_percent
from ..data.record import Hold, Record
from ..data.several_records import VISIBLE_MOTION, measure_input_motion
from ..data.validity import find_longest_run
from ..estimation.likelihood.likelihood import make_problem
from ..estimation.likelihood.maximization import begin_fit, maximize
from ..estimation.likelihood.physics_fit import fit_loop
from ..loop.loop import Loop
from .feedback_check import FEWEST, ORDER, check_feedback, compute_residual

# Evidence from 10 on is called strong: so much more likely must one way be than another.
STRONG = 10.0
# So many samples tell, which keeps the check short.
ENOUGH = 2000
WORDS = {"zoh": "held", "foh": "straight", "bandlimited": "band-limited"}


def check_hold(record: Record, loop: Loop | None) -> tuple[str, float, bool] | None:
    """Return what to say of the input between the samples: text, size and whether it harms.

    A band-limited input that reacts to y is reconstructed from samples that contain the noise to be
    predicted. Of an input that is not held, the sample at the same time takes part in y. Which way
    it runs is told by the likelihood of the loop with each of them.

    Parameters
    ----------
    record : Record
        The record.
    loop : Loop or None
        Its loop. With a controller in it, nothing is asked.

    Returns
    -------
    tuple or None
        The size is the gain of log-likelihood, what u moves from sample to sample as a share of
        its standard deviation, or the bias as a share of a free parameter. None where the record is
        too short or gives no reason to speak.
    """
    if loop is not None and loop.controller is not None:
        return None
    if max((b - a for a, b in record.segments()), default=0) < FEWEST or any(
        np.ptp(s[record.valid]) == 0 for s in (record.u, record.y)
    ):
        return None
    part = record[find_longest_run(record.valid)][:ENOUGH]
    feedback = check_feedback(record)
    if feedback.closed_loop and record.hold == "bandlimited":
        return _warn_of_later_samples(part, loop, float(np.max(np.abs(feedback.correlation))))
    if feedback.closed_loop:
        moves = measure_input_motion([record])
        if moves <= VISIBLE_MOTION:
            return None
        return (
            f"u reacts to y and changes by {100 * moves:.0f} % of its standard deviation from "
            "sample to sample. Between the samples a straight line is assumed, but a controller "
            "moves u by its own law: give the analog controller to the loop, or sample faster.",
            moves, loop is not None,
        )  # fmt: skip
    if record.hold == "zoh" and not _takes_part(part):
        return None
    if loop is None:
        if record.hold != "zoh":
            return None
        return (
            "u is not held between the samples, since its value at a sample takes part in y of "
            "the same sample. Give the record hold='foh' if it is nearly straight, or "
            "hold='bandlimited' if it was measured behind a filter that takes off what is above "
            "half the sampling rate; audit(record, loop) says which of them is likelier.",
            STRONG, True,
        )  # fmt: skip
    likely = _compute_likelihoods(part, loop)
    best = max(likely, key=lambda hold: likely[hold])
    rest = [value for hold, value in likely.items() if hold != best]
    if not math.isfinite(likely[best]) or not rest or likely[best] - max(rest) < STRONG:
        return None
    others = ", ".join(f"{likely[best] - value:.0f} above {WORDS[hold]}"
                       for hold, value in likely.items() if hold != best)  # fmt: skip
    text = f"u looks {WORDS[best]} between the samples (log-likelihood {others})"
    if best == record.hold:
        return f"{text}, as the record says.", likely[best] - max(rest), False
    return (
        f"{text}, but the record says hold={record.hold!r}. Whether an effect is missing may "
        f"depend on that: give it hold={best!r}, as in dataclasses.replace(record, hold={best!r}).",
        likely[best] - likely.get(record.hold, max(rest)), True,
    )  # fmt: skip


def _warn_of_later_samples(
    part: Record, loop: Loop | None, correlation: float
) -> tuple[str, float, bool]:
    """Return what a band-limited input does to a fit under feedback, with the size of the bias.

    The parameters are fitted with each hold. Those that use no sample of u after the interval err
    by how u runs within a sample, which is less than what the noise of y in later samples does.
    """
    text = ("u reacts to y (correlation of its innovations with those of y "
            f"{correlation:.2g}), and hold='bandlimited' reconstructs u between the samples from "
            "later ones, which contain the noise of y: a fit is biased")  # fmt: skip
    cure = ("Give the loop its controller, or the record hold='zoh' for a digital controller or "
            "hold='foh' for an analog one.")  # fmt: skip
    size, which = correlation, ""
    if loop is not None and loop.free:
        fits = {}
        for hold in get_args(Hold):
            try:
                fits[hold] = fit_loop(loop, replace(part, hold=hold)).estimate
            except ModelCannotRun:
                continue
        others = [hold for hold in fits if hold != "bandlimited"]
        if "bandlimited" in fits and others:
            hold = max(others, key=lambda hold: fits[hold].log_likelihood)
            ours, theirs = fits["bandlimited"].values, fits[hold].values
            shares = np.abs(ours - theirs) / np.maximum(np.abs(theirs), 1e-300)
            k = int(np.argmax(shares))
            size = float(shares[k])
            errors = abs(float(ours[k] - theirs[k])) / float(fits[hold].standard_errors[k])
            which = (
                f", here {fits[hold].names[k]} by {write_percent(size)}, from {theirs[k]:.4g} "
                f"with hold={hold!r} to {ours[k]:.4g}, or {errors:.2g} standard errors"
            )
    return f"{text}{which}. {cure}", size, True


def _takes_part(part: Record) -> bool:
    """Return whether u of the same sample takes part in y, by the Bayesian criterion."""
    order = int(np.clip(len(part) // 20, 2, ORDER))
    signals = {"u": part.u, "y": part.y}
    sums = []
    for first in (1, 0):
        left, rows = compute_residual(
            signals, part.valid, "y", {"y": (1, order), "u": (first, order)}
        )
        sums.append(float(np.sum(left[rows] ** 2)))
    if not sums[0] > 0:
        return False
    gain = len(rows) * math.log(sums[0] / max(sums[1], np.finfo(float).tiny))
    return gain - math.log(len(rows)) > 2 * STRONG


def _compute_likelihoods(part: Record, loop: Loop) -> dict[str, float]:
    """Return the log-likelihood of a record with each hold, as far as the model can run it."""
    found = {}
    for hold in get_args(Hold):
        one = replace(part, hold=hold)
        try:
            problem = make_problem(replace(loop, free=()), (), [one])
            found[hold] = maximize(begin_fit(problem)).value
        except ModelCannotRun:
            continue
    return found
