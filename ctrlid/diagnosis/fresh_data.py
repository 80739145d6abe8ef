"""Step 9: models on data that they were not fitted to."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy import stats

from .._base.arrays import Array
from .._base.errors import CtrlidError, ModelCannotRun
from .._base.periods import write_both_periods
from .._base.statistics import autocorrelation_time, pseudo_inverse
from .._base.text import write_count
from ..data.record import Record
from ..data.several_records import require_valid_samples
from ..effects import SensorSaturation
from ..estimation.likelihood.kalman_filter import compute_memory
from ..estimation.likelihood.likelihood import Fit, Known, evaluate_likelihood, make_problem
from ..estimation.likelihood.maximization import begin_fit, maximize
from ..estimation.likelihood.prediction import (
    compute_spreads_ahead,
    make_prediction,
    predict_ahead,
)
from ..loop.loop import Loop
from ..loop.wiring import match_signals
from ..validation.record_audit import FEW
from ..validation.reproduction import CLOSED_LOOP, Reproduction, choose_reproduction
from . import gap as gaps
from .fitted_model import Model
from .recalibration import cut_stretches
from .records import censor_record
from .thresholds import THRESHOLD


@dataclass(frozen=True, eq=False)
class FreshData:
    """What models are compared on.

    `rest` holds the records without the windows, which the parameters are fitted to for the
    comparison; None where the windows are records that took no part in any fit.
    """

    windows: tuple[gaps.Window, ...]
    rest: tuple[Record, ...] | None
    how: Reproduction

    def prepare_loops(self, model: Model) -> tuple[Loop, ...]:
        """Return the loop of a model for each window, ready to be compared there."""
        if model.errors is not None:
            return (model.fitted,) * len(self.windows)
        if self.rest is None:
            return tuple(_fit_private_parameters(model, w) for w in self.windows)
        return (self._fit_loop(model, self.rest),) * len(self.windows)

    def censor(self, limits: SensorSaturation) -> Self:
        """Return the same with readings on a limit of the sensor left out of every filter.

        A simulation has the limit itself, and is compared there as well.
        """
        windows = tuple(
            replace(w, readable=np.asarray(censor_record(w.record, limits).valid))
            for w in self.windows
        )
        rest = self.rest and tuple(censor_record(one, limits) for one in self.rest)
        return replace(self, windows=windows, rest=rest)

    def halve(self) -> tuple[Self, Self]:
        """Return the first and the second half of what is compared."""
        first, second = gaps.halve_windows(self.windows)
        return replace(self, windows=first), replace(self, windows=second)

    def without_windows(self, records: Sequence[Record]) -> list[Record]:
        """Return of the diagnosed records what may be fitted without touching the windows."""
        if self.rest is None:
            return list(records)
        return [r[: len(rest)] for r, rest in zip(records, self.rest, strict=True)]

    def _fit_loop(self, model: Model, records: Sequence[Record]) -> Loop:
        """Return a model's loop with its parameters fitted to other records."""
        fit = model.fit
        if not model.names:
            return model.fitted
        parts, start_times = cut_stretches(records)
        problem = make_problem(model.fitted, model.names, parts, start_times)
        # What is believed stays about the values of the model as given, and so do the limits.
        of_fit = fit.problem
        problem = replace(problem, priors=of_fit.priors, lower=of_fit.lower, upper=of_fit.upper)
        known = fit.known
        if known is not None and (known.sensor is None or len(parts) == len(known.sensor)):
            problem = replace(problem, known=known)
        for noise in (fit.noise, None):
            try:
                start = begin_fit(problem, fit.theta, noise)
            except ModelCannotRun:
                # A model that lacks much may lose a part of a record that it could follow whole.
                continue
            return Model(model.loop, maximize(start, exact=False)).fitted
        return model.fitted

    def simulate_outputs(self, loops: Sequence[Loop]) -> tuple[Array, ...]:
        """Return what each loop makes of its window."""
        pairs = zip(loops, self.windows, strict=True)
        return tuple(gaps.simulate_window(loop, w, self.how) for loop, w in pairs)

    def measure_gap(self, loops: Sequence[Loop]) -> float:
        """Return the RMS error of loops [output unit]."""
        return gaps.root_mean_square(self.windows, self.simulate_outputs(loops))

    def measure_model_gap(self, model: Model) -> float:
        """Return the RMS error of a model, made ready for each window [output unit]."""
        return self.measure_gap(self.prepare_loops(model))

    def compute_widening_chance(self, one: Model, other: Model) -> float:
        """Return the probability with which chance alone makes one model err so much more."""
        results = [self.simulate_outputs(self.prepare_loops(m)) for m in (one, other)]
        windows = gaps.share_samples(self.windows, results)
        return gaps.compute_widening_chance(windows, *results)

    def measure_doubt(self, model: Model) -> Array:
        r"""Return how far the doubt about its parameters moves what a model makes of the windows.

        .. math:: \sqrt{\overline{(y(\theta_r) - y(\hat\theta))^2}}, \quad
            \theta_r \sim N(\hat\theta, I^{-1})

        One RMS difference for each draw. What is private to a record is not drawn. Zero where
        nothing tells the doubt.
        """
        fit = model.fit
        if model.errors is not None or not np.isfinite(fit.normal[0]).all():
            return np.zeros(THRESHOLD.size_runs)
        loops = self.prepare_loops(model)
        here, private = self.simulate_outputs(loops), _list_private_parameters(loops[0])
        covariance = pseudo_inverse(fit.normal[0])
        errors = np.sqrt(np.maximum(np.diag(covariance), THRESHOLD.tiny))
        draws = np.random.default_rng(0).multivariate_normal(
            np.zeros(len(errors)), covariance / np.outer(errors, errors), THRESHOLD.size_runs,
            method="eigh",
        )  # fmt: skip
        centre = np.array([loops[0].parameters[name] for name in model.names])
        theta = np.clip(centre + draws * errors, fit.problem.lower, fit.problem.upper)
        found = []
        for values in theta.tolist():
            known = {n: v for n, v in zip(model.names, values, strict=True) if n not in private}
            there = self.simulate_outputs([loop.with_parameters(known) for loop in loops])
            found.append(gaps.measure_difference(self.windows, here, there))
        return np.array(found)

    def measure_excess(self, loops: Sequence[Loop], fit: Fit) -> float:
        r"""Return what noise, as a fit knows it, leaves unexplained of the innovations.

        .. math:: \tfrac12 \sum_k (e_k^2 / s_k - 1)
        """
        known = fit.known or Known(fit.noise, fit.sensor)
        known = replace(known, sensor=np.full(1, float(np.mean(fit.sensor))))
        total = 0.0
        for loop, window in zip(loops, self.windows, strict=True):
            problem = make_problem(loop, (), [window.seen], [window.start_time])
            here = begin_fit(replace(problem, known=known))
            # Of several outputs the innovations have a column, the mask a row for each.
            z = here.standardized[0].T[window.mask]
            total += 0.5 * float(np.nansum(z**2 - 1))
        return max(total, 0.0)

    def compute_size_chance(self, loops: Sequence[Loop], fit: Fit) -> float:
        r"""Return the probability that noise leaves errors as small as those of loops.

        The noise is that of the fit, as coloured as it is. The errors are those of the simulation,
        among those of simulations with noise, or of predictions of the true output, with

        .. math:: \nu\,\overline{e^2} / \sigma^2 \sim \chi^2_\nu, \quad \nu = N / \tau

        for N samples of which one in :math:`\tau` is independent. NaN where the noise cannot be
        computed.
        """
        if not self.how.horizon:
            runs = gaps.measure_noise_errors(
                loops, fit, self.windows, self.how, THRESHOLD.size_runs
            )
            return gaps.compute_chance_among_runs(self.measure_gap(loops), runs[:, 0])
        known, horizon = Known(fit.noise, np.full(1, float(np.mean(fit.sensor)))), self.how.horizon
        outputs = len(fit.noise.sensors) + 1
        squares, usual, worth = np.zeros(outputs), np.zeros(outputs), np.zeros(outputs)
        for loop, window in zip(loops, self.windows, strict=True):
            plain, record = replace(loop, controller=None), window.record
            try:
                problem = make_problem(plain, (), [window.seen], [window.start_time])
                here = begin_fit(replace(problem, known=known))
            except ModelCannotRun:
                return math.nan
            index, y = predict_ahead(
                plain, record, make_prediction(here), horizon, window.start_time
            )
            spreads = compute_spreads_ahead(
                here.linearized[0], fit.noise, record.valid_somewhere, horizon
            )
            measured, made, masks = (
                np.reshape(v, (outputs, -1)) for v in (record.y, y.T, window.predicted)
            )
            for k, mask in enumerate(masks):
                use = mask[index] & np.isfinite(made[k])
                e = (measured[k][index] - made[k])[use]
                if not len(e):
                    continue
                squares[k] += float(np.sum(e**2))
                usual[k] += len(e) * float(here.sensor[0]) * spreads[k] ** 2
                # Errors may look more independent than such noise would be.
                count = int(np.count_nonzero(mask))
                memory = compute_memory(fit.noise, count)
                worth[k] += min(len(e) / autocorrelation_time(e, 2), count / memory)
        if not (usual > 0).all():
            return math.nan
        # The chance that one output's noise is too large, of several, is that of any.
        chances = stats.chi2.cdf(worth * squares / usual, worth)
        return float(min(1.0, outputs * np.min(chances)))

    def with_noise(self, model: Model) -> Self:
        """Return the same with loops simulated under draws of a model's noise.

        A prediction and an open-loop simulation begin with what was measured, noise and all.
        """
        if self.how != CLOSED_LOOP:
            return self
        return replace(self, windows=gaps.draw_noises(model.fit, self.windows))

    def weigh_outputs(self, model: Model) -> Self:
        """Return the same with several outputs counted in units of the floors of a model."""
        if self.windows[0].record.y.ndim == 1:
            return self
        loops = self.prepare_loops(model)
        floors = gaps.compute_floor(loops, model.fit, self.windows, self.how).outputs
        noise = np.sqrt(model.fit.sensor_noises)
        scales = tuple(
            floor.both if math.isfinite(floor.both) and floor.both > 0 else float(size)
            for floor, size in zip(floors, noise, strict=True)
        )
        windows = tuple(replace(w, scales=scales) for w in self.windows)
        return replace(self, windows=windows)


def choose_fresh_data(
    loop: Loop, records: Sequence[Record], validation: Sequence[Record] | None
) -> FreshData:
    """Return the records given for validation, or the last quarter of each record.

    Raises
    ------
    CtrlidError
        If a record for validation has another sampling period than the loop.
    """
    require_valid_samples(validation or (), "validation=")
    for r in validation or ():
        if abs(r.dt - loop.dt) > THRESHOLD.rounding * loop.dt:
            both = write_both_periods("validation= is sampled", r.dt, "the loop", loop.dt)
            raise CtrlidError(f"{both}; give both the same period")
    e = loop.equations()
    if not e.siso:
        records = [match_signals(r, e, loop.wiring) for r in records]
        validation = (
            None if validation is None else [match_signals(r, e, loop.wiring) for r in validation]
        )
    rest: tuple[Record, ...] | None = None
    if validation is None:
        windows, rest = zip(*(gaps.hold_out(r) for r in records), strict=True)
    else:
        windows = tuple(gaps.make_window(r) for r in validation)
    # Gaps of several windows are one number only if all of them are reproduced in the same way.
    ways = [choose_reproduction(loop, w.record) for w in windows]
    return FreshData(windows, rest, next((way for way in ways if way.horizon), ways[0]))


def check_length(fresh: FreshData) -> None:
    """Refuse records of which too little is left to fit when a part is kept back.

    Raises
    ------
    CtrlidError
        If fewer samples are left than a fit of a few coefficients needs.
    """
    if fresh.rest is None:
        return
    left = sum(int(np.count_nonzero(r.valid_somewhere)) for r in fresh.rest)
    if left < FEW:
        raise CtrlidError(
            f"the record is too short for a diagnosis: {write_count(left, 'valid sample')} would "
            f"be left to fit when the last quarter is kept back for the comparison, and a fit "
            f"needs {FEW}. Record at least {math.ceil(FEW / (1 - THRESHOLD.held_out))} samples, or "
            "give a second record for validation="
        )


def _list_private_parameters(loop: Loop) -> list[str]:
    """Return the parameters of effects that differ from record to record, such as a phase."""
    return [f"{label}.{k}" for label, e in loop.labelled.items() for k in e.private]


def _fit_private_parameters(model: Model, window: gaps.Window) -> Loop:
    """Return the loop with what is private to a record, such as a phase, fitted to this one."""
    loop, fit = model.fitted, model.fit
    names = _list_private_parameters(loop)
    if not names:
        return loop
    sensor = np.full(1, float(np.mean(fit.sensor)))
    try:
        problem = make_problem(loop, names, [window.seen], [window.start_time])
        problem = replace(problem, known=Known(fit.noise, sensor))
        start = begin_fit(problem)
        at = start.trajectories
        for k in range(len(names)):
            turns = np.arange(THRESHOLD.phase_starts) * 2 * math.pi / THRESHOLD.phase_starts
            turned = [start.theta + turn * np.eye(len(names))[k] for turn in turns]
            tried = [evaluate_likelihood(start.problem, theta, fit.noise, at) for theta in turned]
            start = max(tried, key=lambda f: f.value)
        best = maximize(start, exact=False)
    except ModelCannotRun:
        return loop
    return loop.with_parameters(dict(zip(names, best.theta.tolist(), strict=True)))
