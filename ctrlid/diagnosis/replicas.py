"""Step 6: records that a fitted model would have given, in which nothing more is hidden."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import control as ct
import numpy as np

from .._base.arrays import Array
from .._base.errors import EffectDoesNotApply, ModelCannotRun
from .._base.statistics import regress, rounding_variance
from ..data.record import Record, fill_readings
from ..data.validity import find_whole_past
from ..estimation.likelihood.filter_data import FilterData
from ..estimation.likelihood.likelihood import (
    evaluate_likelihood,
    make_problem,
    rank_by_likelihood,
)
from ..estimation.likelihood.maximization import begin_fit, maximize
from ..loop.loop import Loop, find_converter_steps, sharpen_effects
from ..loop.period_map import comes_to_rest
from ..validation.record_simulation import find_long_stretches, prepare_stretch
from ..validation.reproduction import choose_reproduction
from .candidates import Trial
from .fitted_model import Model, can_simulate, carry_over_fit
from .gap import draw_noise, make_gap_simulator
from .noise_tests import NoiseTests, run_noise_tests
from .refitting import refit_candidate
from .screening import screen_at
from .thresholds import THRESHOLD

# The seeds of successive records differ by so much that segments that start alike get other noise.
SEEDS = 101


def make_replica(model: Model, seed: int = 0, noisy: bool = True) -> Model | None:
    """Simulate the records with a fitted model and its noise, and fit the model to them.

    Parameters
    ----------
    model : Model
        The fitted model. If it is unstable and its controller not known, one that follows the
        record stands in for that.
    seed : int, optional
        Seed of the noise.
    noisy : bool, optional
        Whether there is noise beside the steps of converters in the loop.

    Returns
    -------
    Model or None
        The model fitted to the simulated records; None where it cannot be simulated.
    """
    loop, fit = model.fitted, model.fit
    try:
        start_times = [float(data.t[0]) for data in fit.data]
        records = [
            _simulate_record(
                model, record, start_time, float(r) if noisy else 0.0, seed + SEEDS * k
            )
            for k, (record, start_time, r) in enumerate(
                zip(model.records, start_times, fit.sensor, strict=True)
            )
        ]
        problem = make_problem(loop, model.names, records, start_times)
        counts = fit.counts
        if any(find_converter_steps(loop)):
            # Other readings are equal, so that other ones count.
            counts = tuple(map(_count_after_start, problem.data, fit.counts))
        problem = replace(problem, counts=counts, known=fit.known)
        # With other noise a loop may take another path, so the old one and a new guess are tried.
        along = evaluate_likelihood(problem, fit.theta, fit.noise, fit.trajectories)
        starts = along, begin_fit(problem, fit.theta, fit.noise)
        again = maximize(
            max(starts, key=rank_by_likelihood), rounds=THRESHOLD.replica_rounds, exact=False
        )
    except (ModelCannotRun, EffectDoesNotApply):
        return None
    return Model(loop, again) if math.isfinite(again.value) else None


def _count_after_start(data: FilterData, counted: Any) -> Any:
    """Return the usable readings from the first one on that counted in another record."""
    begun = np.maximum.accumulate(counted, axis=0)
    return data.usable & begun


def _simulate_record(
    model: Model, record: Record, first: float, sensor: float, seed: int
) -> Record:
    # What a rejected law leaves of the recorded input carries the recorded noise into a simulation.
    follows = not can_simulate(model) or choose_reproduction(model.loop, record).horizon > 0
    loop = follow_record(model.fitted, record) if follows else model.fitted
    if loop is None:
        raise ModelCannotRun("the record cannot be followed")
    # A filter smooths what is abrupt over a part of a period. What an effect gains by mending that
    # is no evidence for it, and shows on records that are simulated as abruptly as nature acts.
    loop = sharpen_effects(loop, THRESHOLD.replica_sharpness)
    simulator = make_gap_simulator(loop, record.hold, record.hold_r, THRESHOLD.replica_steps)
    y, u = np.array(record.y), np.array(record.u)
    for part in find_long_stretches(record, model.loop, THRESHOLD.shortest_segment):
        stretch = prepare_stretch(simulator, record, part, start_time=first, follow=follows)
        noise = draw_noise(model.fit, sensor, stretch.d.shape[-1], seed + part.start)
        y[..., part], u[..., part] = stretch.run(simulator, noise)
    return replace(record, y=y, u=u)


def measure_rounding(model: Model) -> Model:
    r"""Return the model with the variance that the steps of its converters add to its noise.

    Rounding adds :math:`q^2 / 12` in motion. A controller that works against a reading between
    two steps keeps it there, where rounding adds three times as much. A record simulated without
    any other noise tells how much it is. A model that was measured before is returned as it is.

    References
    ----------
    Gouriéroux, Monfort and Renault, Journal of Applied Econometrics 8 (1993) S85-S118 (indirect
    inference).
    """
    steps = find_converter_steps(model.loop)
    measured = bool(model.fit.rounding)
    bare = make_replica(model, noisy=False) if any(steps) and not measured else None
    if bare is None:
        return model
    added = np.maximum(np.where(steps, bare.fit.sensor_noises, 0.0), rounding_variance(steps))
    return replace(model, fit=replace(model.fit, rounding=tuple(added.tolist())))


def has_kinks(model: Model) -> bool:
    """Whether a model has kinks in its states, such as dry friction."""
    return model.plant.e.kinked


def measure_gain_on_replicas(copies: Sequence[Model | None], trial: Trial) -> float:
    """Return what a candidate gains on records in which it is known not to be.

    Parameters
    ----------
    copies : sequence of Model or None
        Replicas of the model that the candidate was added to.
    trial : Trial
        The candidate.

    Returns
    -------
    float
        Gain of log-likelihood, zero at least.
    """
    gains = [0.0]
    for copy in copies:
        if copy is None:
            continue
        again = refit_candidate(copy, screen_at(copy, trial.fitted, trial.scan_penalty))
        # From the fitted values dry friction may have led the refit to a wrong maximum.
        if not again.gain > 0:
            again = refit_candidate(copy, screen_at(copy, trial.effect, trial.scan_penalty))
        gains.append(again.gain if math.isfinite(again.gain) else 0.0)
    return max(gains)


def measure_gain_beyond_simple(base: Model, best: Trial, simple: Trial) -> float:
    """Return what the further parameters of an effect gain over a simpler one.

    What the further parameters gain on a record simulated with the simpler effect, they gain
    from the approximations of the filter: twice that is taken off.

    Parameters
    ----------
    base : Model
        The model without either.
    best, simple : Trial
        The refitted candidates.

    Returns
    -------
    float
        Gain of log-likelihood; infinite where no record can be simulated.
    """
    copy = make_replica(simple.model)
    if copy is None:
        return math.inf
    try:
        under = carry_over_fit(copy, base.fitted, base.names)
    except ModelCannotRun:
        return math.inf
    # Both climb from the same start: where the replica was fitted, the simple one may be stuck.
    without = Model(base.fitted, under)
    again, plain = (refit_candidate(without, screen_at(without, t.fitted)) for t in (best, simple))
    least = max(copy.fit.value, plain.model.fit.value)
    usual = again.model.fit.value - least if math.isfinite(again.gain) else 0.0
    return best.gain - simple.gain - THRESHOLD.replica_weight * max(usual, 0.0)


def forgive_filter(tests: NoiseTests, copies: Sequence[Model | None]) -> NoiseTests:
    """Return the tests without alarms that the filter's own approximation raises.

    A test that fails on the record, and on records simulated with the very model, says nothing
    against the model. Where the size of the errors depends on what the plant does, as it does where
    a reading sticks to the steps of a converter, it differs in time, and by the reference, by what
    the plant does then.
    """
    bent = any(copy is not None and copy.loop.effects and has_kinks(copy) for copy in copies)
    known = [run_noise_tests(copy.fit).p_values for copy in copies if copy is not None]
    if not known:
        return tests
    p = {}
    kin = {
        f"size by {outer}{end}": [f"size by {axis}{end}" for axis in tests.axes]
        for outer in ("time", *(axis for axis in tests.axes if axis.startswith("reference")))
        for end in ("", *(f" of {name}" for name in tests.outputs))
    }
    for name, value in tests.p_values.items():
        usual = min(k.get(each, 1.0) for k in known for each in kin.get(name, [name]))
        failed = usual < THRESHOLD.false_alarm and math.log(
            max(value, THRESHOLD.tiny)
        ) > THRESHOLD.beyond_replica * math.log(max(usual, THRESHOLD.tiny))
        p[name] = max(value, 0.5) if failed else value
    outputs = {
        name: replace(one, p_values={test: p[f"{test} of {name}"] for test in one.p_values})
        for name, one in tests.outputs.items()
    }
    alpha = THRESHOLD.false_alarm_beside_kinks if bent else tests.alpha
    return replace(tests, p_values=p, alpha=alpha, outputs=outputs)


def follow_record(loop: Loop, record: Record) -> Loop | None:
    r"""Return a loop whose output follows that of a record, driven by its input.

    .. math:: u = u_{record} + C (y_{record} - y)

    With the recorded input alone an unstable plant leaves the record at once. C is the part of the
    controller that acts on y, as a regression of the recorded u finds it, where that keeps the
    plant: then u moves with each step of a converter and each noise as it did. Else it is the
    normalized linear quadratic Gaussian controller of the linearized plant: input and output count
    by their standard deviations in the record, and so do the noises at input and output.

    Parameters
    ----------
    loop : Loop
        The model, without a controller.
    record : Record
        What it follows.

    Returns
    -------
    Loop or None
        The loop with C; None where no such controller keeps it stable.

    References
    ----------
    Jonckheere and Silverman, IEEE Transactions on Automatic Control 28 (1983) 953-964.
    """
    if loop.equations().feedthrough:  # No controller acts around it without delay.
        return None
    whole = fill_readings(record)
    u, y = (np.maximum(np.std(np.atleast_2d(v)[:, whole.valid_somewhere], axis=1), THRESHOLD.tiny)
            for v in (whole.u, whole.y))  # fmt: skip
    if len(u) == len(y) == 1:
        made = _close_loop(loop, lambda: _regress_controller(record, loop.dt))
        if made is not None:
            return made
    return _close_loop(loop, lambda: _design_normalized_controller(loop.linearize(), loop.dt, u, y))


def _close_loop(loop: Loop, design: Callable[[], Any]) -> Loop | None:
    """Return a loop with a controller that is designed for it, None where it does not keep it."""
    try:
        controller = design()
        made = replace(loop, controller=controller)
        return made if controller is not None and comes_to_rest(made) else None
    except (ModelCannotRun, EffectDoesNotApply):
        return None


def _regress_controller(record: Record, dt: float) -> Any:
    r"""Return how the recorded input reacts to y, None where it does so hardly.

    .. math:: A(q)\, u_k = -B(q)\, y_k + F(q)\, r_k + c

    by least squares. A digital law without limits is found exactly, since it computes u from the
    recorded numbers, their noise included.
    """
    order = THRESHOLD.law_order
    lags = range(order + 1)
    signals = [record.u, record.y, *([] if record.r is None else [record.r])]
    whole = find_whole_past(record.valid, order)[order:]
    columns = np.column_stack([
        *(v[order - k : len(v) - k] for v in signals for k in lags), np.ones(len(whole))
    ])[whole]  # fmt: skip
    if len(columns) <= columns.shape[1]:
        return None
    goal, table = columns[:, 0], columns[:, 1:]
    found = regress(table, goal, len(table) * np.finfo(float).eps)
    left = np.var(goal - table @ found)
    if left > THRESHOLD.law_left * np.var(np.diff(record.u)[record.valid[1:]]):
        return None
    return ct.tf(-found[order : 2 * order + 1], [1, *-found[:order]], dt)


def _design_normalized_controller(model: Any, dt: float, u: Array, y: Array) -> Any:
    """Return the controller for a linear model by the sizes of its input and output.

    None where python-control finds no solution of the Riccati equations, and where the input moves
    nothing, as one that rests beyond its limits.
    """
    try:
        plant = ct.ss(model)
        if not plant.nstates:
            return None
        plant = plant if plant.dt else ct.sample_system(plant, dt, "zoh")
        a, b, c = plant.A, plant.B * u, plant.C / y[:, None]
        feedback, _, _ = ct.dlqr(a, b, c.T @ c, np.eye(len(u)))
        # The gain is that of the predictor: what is measured acts at the next sample.
        gain, _, _ = ct.dlqe(a, np.eye(len(a)), c, b @ b.T, np.eye(len(y)))
    except ValueError:
        return None
    return ct.ss(a - b @ feedback - gain @ c, gain / y, feedback * u[:, None], 0, plant.dt)
