"""Step 2: the model's own free parameters and the noise, fitted before anything is added."""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .._base.arrays import Array
from .._base.errors import ModelCannotRun
from ..data.record import Record
from ..estimation.likelihood.likelihood import (
    list_start_values,
    make_problem,
    rank_by_likelihood,
)
from ..estimation.likelihood.maximization import (
    begin_fit,
    choose_noise,
    guess_noise,
    maximize,
    refit_noise_size,
)
from ..estimation.likelihood.noise.orders import estimate_noise_from_repeats
from ..loop.loop import Loop
from ..validation.record_audit import Audit
from .fitted_model import Model, takes_readings_as_exact
from .records import find_repeat_periods
from .thresholds import THRESHOLD


def recalibrate(loop: Loop, records: Sequence[Record], audits: Sequence[Audit]) -> Model:
    """Return the model with its free parameters and the noise fitted, before anything is added.

    Where an experiment repeats itself often enough, what differs between its repeats is noise
    whatever the model, and the model is fitted with that.

    Parameters
    ----------
    loop : Loop
        The model as given.
    records : sequence of Record
        The data.
    audits : sequence of Audit
        What the records show by themselves, their repeats among it.

    Returns
    -------
    Model
        The base to which effects are added.
    """
    parts, start_times = cut_stretches(records)
    base = fit_base_model(loop, parts, tuple(loop.free), start_times)
    periods = find_repeat_periods(parts, audits)
    return fit_with_repeat_noise(base, periods) if periods else base


def fit_base_model(
    loop: Loop, records: Sequence[Record], names: Sequence[str], start_times: Sequence[float] = ()
) -> Model:
    """Fit the model as it is, with the noise that the data want."""
    problem = make_problem(loop, names, records, start_times)
    lower, upper = _narrow_bounds(loop, names, problem.lower, problem.upper)
    problem = replace(problem, lower=lower, upper=upper)
    fit = refit_noise_size(maximize(begin_fit(problem)))
    fits = [choose_noise(fit)]
    if takes_readings_as_exact(fit):
        # The force that is likeliest at the given values may leave no noise to the sensor, from
        # where no slope leads back.
        with contextlib.suppress(ModelCannotRun):
            usual = begin_fit(fit.problem, noise=guess_noise(fit.problem))
            fits.append(choose_noise(maximize(usual)))
    return Model(loop, max(fits, key=rank_by_likelihood))


def fit_with_repeat_noise(base: Model, periods: Sequence[int]) -> Model:
    """Return the model fitted with the noise that differs between repeats.

    A noise that is fitted to what a model leaves takes part of a missing effect for noise.
    """
    problem = replace(base.fit.problem, known=estimate_noise_from_repeats(base.fit, periods))
    return Model(base.loop, maximize(begin_fit(problem, base.fit.theta), exact=False))


def restore_given_values(base: Model) -> Model | None:
    """Return the model at its given values if recalibration has led far away from them.

    Where much is missing, the likelihood of the model alone may be largest at absurd values; the
    missing effect shows at the given ones.
    """
    given = list_start_values(base.loop, base.names)
    size = np.maximum(np.abs(given), THRESHOLD.tiny)
    if not np.any(np.abs(base.fit.theta - given) > THRESHOLD.far_recalibration * size):
        return None
    try:
        fit = begin_fit(base.fit.problem, given)
    except ModelCannotRun:
        return None
    return Model(base.loop, fit) if math.isfinite(fit.value) else None


def _narrow_bounds(
    loop: Loop, names: Sequence[str], lower: Array, upper: Array
) -> tuple[Array, Array]:
    """Narrow the bounds of the plant's parameters: a model ten times off is another model."""
    lower, upper = lower.copy(), upper.copy()
    for k, (name, value) in enumerate(zip(names, list_start_values(loop, names), strict=True)):
        if "." not in name and value:
            ends = sorted((value / THRESHOLD.parameter_range, value * THRESHOLD.parameter_range))
            lower[k], upper[k] = max(lower[k], ends[0]), min(upper[k], ends[1])
    return lower, upper


def cut_stretches(records: Sequence[Record]) -> tuple[list[Record], list[float]]:
    """Return records short enough to be fitted many times, and the times at which they start [s].

    Of long records these are stretches, evenly spaced.
    """
    total = sum(len(r) for r in records)
    if total <= THRESHOLD.fitted_samples:
        return list(records), [0.0] * len(records)
    parts, start_times = [], []
    for record in records:
        size = max(
            THRESHOLD.fitted_samples * len(record) // total // THRESHOLD.stretches,
            THRESHOLD.shortest_stretch,
        )
        firsts = np.linspace(0, max(len(record) - size, 0), THRESHOLD.stretches).astype(int)
        for first in dict.fromkeys(firsts.tolist()):
            part = record[first : first + size]
            if np.count_nonzero(part.valid) > size // 2:
                parts.append(part)
                start_times.append(first * record.dt)
    return parts, start_times
