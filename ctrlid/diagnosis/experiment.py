"""Which experiment would tell apart what a record cannot."""

import math
from collections.abc import Sequence

import numpy as np

from ..data import Record
from ..errors import CtrlidError
from ..physics import Array
from ..signals import random_binary
from ..simulation import Simulator
from .gap import FEW_STEPS, ROUGH
from .trial import Trial

LONGEST = 20_000  # samples of a recommended experiment
LEVELS = (-1.0, 1.0, -0.5, 0.5, 0.0)  # set-points it visits, in units of its reach
WORTH = 1.5  # times the distance of the record itself: below, no experiment worth the name
RAMP = 0.1  # share of each level that is spent on the way to it


def separating_experiment(
    best: Trial, others: Sequence[Trial], record: Record
) -> tuple[str, Array | None]:
    """Return the experiment that separates a finding from its rivals best.

    References that the loop survives are simulated with each of the rival models; the one on which
    their outputs differ most, against the sensor noise, is recommended.

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
    words = type(best.effect).experiment
    loop = best.model.fitted
    if loop.controller is None or record.r is None:
        return words, None
    sensor = math.sqrt(float(np.mean(best.model.fit.sensor)))
    models = []
    for trial in (best, *others):
        try:
            models.append(Simulator(trial.model.fitted, ROUGH, FEW_STEPS))
        except CtrlidError:
            continue
    chosen: tuple[float, str, Array] | None = None
    for text, r in _references(record):
        distance = _distance(models, r, sensor)
        if distance is not None and (chosen is None or distance > 1.2 * chosen[0]):
            chosen = (distance, text, r)
    if chosen is None or len(models) < 2:
        return words, None
    own = _distance(models, np.asarray(record.r), sensor) or 0.0
    if chosen[0] < WORTH * own:
        return words, None
    if own <= 0:
        return f"{words.rstrip('.')}. Recommended: {chosen[1]}.", chosen[2]
    times = chosen[0] / own
    text = (f"{words.rstrip('.')}. Recommended: {chosen[1]}; there the candidates differ "
            f"{times:.1f} times as much for the same number of samples.")  # fmt: skip
    return text.strip(), chosen[2]


def _references(record: Record) -> list[tuple[str, Array]]:
    """Return references of several kinds, from the record's own to bolder ones."""
    assert record.r is not None
    r = np.asarray(record.r)[record.valid]
    middle, n = float(np.mean(r)), min(max(len(r), 5000), LONGEST)
    reach = float(np.max(np.abs(r - middle)))
    moves = np.abs(np.diff(r))
    step = float(np.median(moves[moves > 0])) / 2 if (moves > 0).any() else reach
    step = min(max(step, 0.1 * reach), reach) or 1e-3
    hold = max(2, round(len(r) / max(int(np.count_nonzero(moves)), 1)))
    found = []
    for label, amplitude, width, levels in (
        ("the reference's kind of steps, around one set-point", step, hold, 0.0),
        ("steps on several set-points over the range visited so far", step, hold, reach),
        ("steps on several set-points over twice that range", step, hold, 2 * reach),
        ("steps twice as large, around one set-point", 2 * step, hold, 0.0),
        ("steps twice as large on several set-points over the range so far", 2 * step, hold, reach),
        ("steps four times as large, around one set-point", 4 * step, hold, 0.0),
        ("steps that change four times as often", step, max(2, hold // 4), 0.0),
        ("steps that change four times as often on several set-points", step, max(2, hold // 4),
         reach),
        ("slow steps, four times as long, on several set-points", step, 4 * hold, reach),
    ):  # fmt: skip
        signal = random_binary(n, amplitude=amplitude, hold=width, around=middle, seed=0)
        found.append((label, signal + _levels(n, levels)))
    return found


def _levels(n: int, reach: float) -> Array:
    """Return a walk over set-points with ramps between them, starting from the middle."""
    size = n / len(LEVELS)
    times, values = [0.0], [0.0]
    for k, level in enumerate(LEVELS):
        times += [(k + RAMP) * size, (k + 1) * size]
        values += [level * reach, level * reach]
    return np.asarray(np.interp(np.arange(n), times, values), dtype=float)


def _distance(models: Sequence[Simulator], r: Array, sensor: float) -> float | None:
    """Return the least distance of the first model from any other, per sample."""
    try:
        outputs = [m.run(m.start(None), r, np.zeros(len(r)))[0] for m in models]
    except CtrlidError:
        return None
    if len(outputs) < 2:
        return None
    return min(float(np.mean((y - outputs[0]) ** 2)) for y in outputs[1:]) / sensor**2
