"""Step 8: the experiment that would tell an effect from its rivals."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .._base.arrays import Array
from .._base.errors import EffectDoesNotApply, ModelCannotRun
from ..data.record import Record
from ..data.references import random_binary
from ..estimation.likelihood.likelihood import Known, make_problem
from ..estimation.likelihood.maximization import begin_fit, compute_expected_gain
from ..loop.simulation import Simulator
from .candidates import Trial
from .gap import make_gap_simulator
from .thresholds import THRESHOLD


def find_experiment(
    best: Trial, others: Sequence[Trial], record: Record
) -> tuple[str, Array | None]:
    r"""Return the experiment that separates a finding from its rivals best.

    References that the loop survives are simulated with the finding, without noise. What each
    rival's filter cannot predict of that record, however its parameters move along, is the distance

    .. math:: D = \sum_k e_k^2 / s_k - g^T H^{-1} g,

    twice the log-likelihood that the experiment is expected to bring. The reference with the
    largest least distance is recommended, if it is enough to tell.

    Parameters
    ----------
    best : Trial
        The finding.
    others : sequence of Trial
        What the record cannot tell from it.
    record : Record
        The data, which set the scale.

    Returns
    -------
    text : str
        The experiment in words.
    reference : ndarray or None
        The reference signal; None where the loop has no controller to run it.
    """
    words = _describe_experiment(best, others)
    loop = best.model.fitted
    if loop.controller is None or record.r is None or not loop.equations().siso:
        # Of several references no one combination is recommended.
        return words, None
    try:
        simulators = [make_gap_simulator(t.model.fitted) for t in (best, *others)]
    except (ModelCannotRun, EffectDoesNotApply):
        return words, None
    simulator = simulators[0]
    able = [
        (d, text, r)
        for text, r in _list_references(record)
        if (
            d := _find_least_distance(
                simulator, best, others, r[: THRESHOLD.experiment_tried], record
            )
        )
        is not None
    ]
    chosen = _choose_clearest(able)
    while chosen is not None and not all(_can_survive(s, chosen[2], record) for s in simulators):
        able = [a for a in able if a is not chosen]
        chosen = _choose_clearest(able)
    if chosen is None:
        return words, None
    own = (
        _find_least_distance(
            simulator, best, others, np.asarray(record.r)[: THRESHOLD.experiment_tried], record
        )
        or 0.0
    )
    if chosen[0] * len(chosen[2]) < THRESHOLD.experiment_distance:
        return (f"{words}. No steps of the reference that are safe for the loop would decide "
                f"within {len(chosen[2])} samples"), None  # fmt: skip
    if chosen[0] < THRESHOLD.experiment_worth * own:
        return words, None
    if own <= 0 or chosen[0] > THRESHOLD.experiment_gain * own:
        return f"{words}. Recommended reference: {chosen[1]}", chosen[2]
    times = chosen[0] / own
    text = (f"{words}. Recommended reference: {chosen[1]}. It separates the candidates "
            f"{times:.1f} times as much as the reference of this record, with the same number of "
            "samples")  # fmt: skip
    return text, chosen[2]


def _describe_experiment(best: Trial, others: Sequence[Trial]) -> str:
    """Say what tells a finding from its rivals: one clause for all, or one for each of several."""
    kind = type(best.effect)
    told = [kind.experiment_against.get(t.name, kind.experiment).rstrip(".") for t in others]
    return "; and ".join(dict.fromkeys(told))


def _choose_clearest(able: Sequence[tuple[float, str, Array]]) -> tuple[float, str, Array] | None:
    """Return the experiment with the largest distance; a bolder one has to be clearly better."""
    chosen = None
    for one in able:
        if chosen is None or one[0] > THRESHOLD.experiment_bolder * chosen[0]:
            chosen = one
    return chosen


def _can_survive(simulator: Simulator, r: Array, record: Record) -> bool:
    """Whether a loop follows a reference somewhat larger than this one.

    Behind limits of the input, a loop that has lost its plant may yet stay bounded.
    """
    middle = float(np.mean(r))
    reach = THRESHOLD.experiment_reach * max(
        float(np.ptp(r)), float(np.ptp(record.y[record.valid]))
    )
    bold = middle + THRESHOLD.experiment_margin * (r - middle)
    try:
        y = simulator.run(simulator.start(None), bold, np.zeros(len(r)))[0]
    except ModelCannotRun:
        return False
    return bool(np.ptp(y) <= THRESHOLD.experiment_margin * reach)


def _list_references(record: Record) -> list[tuple[str, Array]]:
    """Return references of several kinds, from the record's own to bolder ones."""
    assert record.r is not None
    r = np.asarray(record.r)[record.valid]
    middle, n = (
        float(np.mean(r)),
        min(max(len(r), THRESHOLD.experiment_shortest), THRESHOLD.experiment_samples),
    )
    reach = float(np.max(np.abs(r - middle)))
    moves = np.abs(np.diff(r))
    step = float(np.median(moves[moves > 0])) / 2 if (moves > 0).any() else reach
    step = min(max(step, THRESHOLD.experiment_smallest * reach), reach) or THRESHOLD.experiment_step
    hold = max(2, round(len(r) / max(int(np.count_nonzero(moves)), 1)))
    times, found = THRESHOLD.experiment_times, []
    for label, amplitude, width, levels in (
        ("steps like those of this record, around one set-point", step, hold, 0.0),
        ("steps around several set-points over the range of this record", step, hold, reach),
        ("steps around several set-points over twice the range of this record", step, hold,
         2 * reach),
        ("steps twice as large, around one set-point", 2 * step, hold, 0.0),
        ("steps twice as large, around several set-points over the range of this record", 2 * step,
         hold, reach),
        ("steps four times as large, around one set-point", times * step, hold, 0.0),
        ("steps that change four times as often", step, max(2, hold // times), 0.0),
        ("steps that change four times as often, around several set-points", step,
         max(2, hold // times), reach),
        ("slow steps, four times as long, around several set-points", step, times * hold, reach),
        ("steps four times as large that change four times as often", times * step,
         max(2, hold // times), 0.0),
        ("steps four times as large that can change at every second sample", times * step, 2, 0.0),
    ):  # fmt: skip
        signal = random_binary(n, amplitude=amplitude, hold=width, around=middle, seed=0)
        found.append((label, signal + _visit_levels(n, levels)))
    return found


def _visit_levels(n: int, reach: float) -> Array:
    """Return a walk over set-points with ramps between them, starting from the middle."""
    size = n / len(THRESHOLD.experiment_levels)
    times, values = [0.0], [0.0]
    for k, level in enumerate(THRESHOLD.experiment_levels):
        times += [(k + THRESHOLD.experiment_ramp) * size, (k + 1) * size]
        values += [level * reach, level * reach]
    return np.asarray(np.interp(np.arange(n), times, values), dtype=float)


def _find_least_distance(
    simulator: Simulator, best: Trial, others: Sequence[Trial], r: Array, record: Record
) -> float | None:
    """Return the least distance of a finding from its rivals, per sample."""
    if not _can_survive(simulator, r, record):
        return None
    try:
        y, u = simulator.run(simulator.start(None), r, np.zeros(len(r)))
    except ModelCannotRun:
        return None
    made = Record(u=u, y=y, r=r, dt=record.dt, hold=record.hold)
    sizes = [d for t in others if (d := _measure_unpredicted(t, best, made)) is not None]
    return min(sizes) / len(r) if sizes else None


def _measure_unpredicted(rival: Trial, best: Trial, record: Record) -> float | None:
    """Return what a rival cannot predict of a record that the finding made."""
    model = rival.model
    known = Known(best.model.fit.noise, np.full(1, float(np.mean(best.model.fit.sensor))))
    try:
        problem = replace(make_problem(model.fitted, model.names, [record]), known=known)
        fit = begin_fit(problem, model.fit.theta)
    except (ModelCannotRun, EffectDoesNotApply):
        return None
    errors = sum(float(np.nansum(z**2)) for z in fit.standardized)
    left = errors - 2 * compute_expected_gain(fit)
    return max(left, 0.0) if math.isfinite(left) else None
