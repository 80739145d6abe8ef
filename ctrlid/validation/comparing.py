"""compare(): how well a model or a loop reproduces a record, every curve labelled."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from numbers import Integral
from typing import Any, TypeVar

import control as ct
import numpy as np
from scipy import signal

from .._base.arguments import explain_names, point_at_part
from .._base.arrays import Array
from .._base.errors import CtrlidError, CtrlidWarning, EffectDoesNotApply, ModelCannotRun
from .._base.interruption import hold_interrupt
from .._base.periods import have_same_period, write_both_periods, write_difference
from .._base.rounding import keep_numpy_quiet
from .._base.signals import require_one_signal
from .._base.text import write_count, write_number
from ..data.record import Record
from ..data.several_records import order_model_and_data
from ..data.validity import find_whole_past
from ..estimation.identified_model import IdentifiedModel, read_delay
from ..estimation.likelihood.filter_data import FEWEST
from ..estimation.likelihood.prediction import Prediction, predict, predict_ahead, predict_spread
from ..estimation.linear.sampled_motion import discretize_model, list_inputs
from ..loop.loop import Loop, write_loop
from ..loop.period_map import compute_growth_rate
from ..loop.simulation import Simulator, make_simulator
from ..loop.step_check import describe_unstated_steps
from ..loop.unit_check import note_unit_clashes
from ..loop.wiring import match_signals
from ..physics.conversions import to_polynomials, to_state_matrices
from ..physics.trace import timebase
from .comparison import EXACT, Comparison, Curve
from .controller_check import find_rejection
from .noise_model import fit_noise_polynomial, whiten_errors
from .record_simulation import Stretch, find_long_stretches, prepare_stretch
from .reproduction import (
    CLOSED_LOOP,
    ONE_STEP,
    OPEN_LOOP,
    Reproduction,
    compute_moving_poles,
    find_time_constant,
)
from .residual_tests import Correlation, autocorrelation, compute_explained_share, cross_correlation
from .wired_controller_check import find_wired_rejection

Result = TypeVar("Result")

# A curve is useless from this many times the error of a guess without a model; chance is less.
BEATEN = 1.05
# An injected signal below this share of the input's standard deviation is rounding.
MEANINGFUL = 1e-6


@explain_names
@hold_interrupt()
@keep_numpy_quiet
def compare(record: Record, model_or_loop: Any, *, horizon: int | None = None) -> Comparison:
    """Compare a record with a model or a loop.

    A prediction uses the measured output up to some samples before; a simulation uses none of it.
    A loop with a controller is simulated closed loop; a stable plant without one is simulated
    from the measured input. An unstable plant is never simulated open loop: any difference
    would grow without bound and say nothing. What the controller's own law leaves of the measured
    u (injected pulses, dither) is injected in the simulation as well; initial states are
    estimated for each valid stretch.

    Parameters
    ----------
    record : Record
        The data. Record and model may change places.
    model_or_loop : Loop, IdentifiedModel or control.TransferFunction
        What to compare with them. A transfer function predicts with a noise polynomial, a
        result of `fit_arx` with none; polynomial and constant part are fitted to this record.
    horizon : int, optional
        Samples to predict ahead; by default about one time constant of the slowest unstable, or
        else the slowest stable, pole.

    Returns
    -------
    Comparison
        Curves with fit and error, and tests of the one-step errors.

    Raises
    ------
    CtrlidError
        If record and model do not fit together.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    >>> loop = cid.Loop(plant, 5.0, dt=0.01)
    >>> r = cid.random_binary(1000, amplitude=0.1, hold=50, seed=1)
    >>> record = cid.simulate(loop, r, sensor_noise=1e-3, seed=2)
    >>> [curve.label for curve in cid.compare(record, loop).curves]
    ['one-step prediction', '50-step prediction', 'closed-loop simulation']
    """
    model_or_loop, record = order_model_and_data(model_or_loop, record)
    if not isinstance(record, Record):
        raise CtrlidError(
            "compare needs a Record and a model; given "
            f"{type(record).__name__} and {type(model_or_loop).__name__}"
        )
    several = isinstance(model_or_loop, Loop) and not model_or_loop.equations().siso
    if several:
        record = match_signals(record, model_or_loop.equations(), model_or_loop.wiring)
    else:
        require_one_signal("compare", model_or_loop, record)
    if horizon is not None and not (isinstance(horizon, Integral) and 1 <= horizon < len(record)):
        raise CtrlidError(
            f"horizon must be between 1 and {len(record) - 1} samples; given {horizon}"
        )
    for name, row, use in zip(
        record.signals["y"], np.reshape(record.y, (-1, len(record))), record.valid_outputs,
        strict=True,
    ):  # fmt: skip
        y = row[use]
        if not (y.size and np.ptp(y) == 0):
            continue
        raise CtrlidError(
            f"{name if several else 'y'} is {y[0]:g} in all valid samples, so that no curve can "
            "follow it better than another: record while the plant moves, or look whether the "
            "sensor is stuck"
        )
    horizon = None if horizon is None else int(horizon)
    if isinstance(model_or_loop, Loop):
        run = _compare_several if several else _compare_loop
        made = run(record, model_or_loop, horizon)
        return replace(made, notes=(*note_unit_clashes(model_or_loop, record), *made.notes))
    if isinstance(model_or_loop, ct.TransferFunction):
        return _compare_model(record, model_or_loop, horizon)
    raise CtrlidError(
        "compare needs a Loop, or a transfer function such as the fits return; given "
        f"{type(model_or_loop).__name__}"
        + (
            point_at_part(model_or_loop, Loop)
            or (". Give control.tf(model)" if isinstance(model_or_loop, ct.StateSpace) else "")
            or ". Put a nonlinear plant into a Loop(plant, controller, dt=..., at=...)"
        )
    )


def _compare_loop(record: Record, loop: Loop, horizon: int | None) -> Comparison:
    prediction = predict(loop, record)
    residuals = np.where(prediction.settled, prediction.innovations, np.nan)
    one_step = np.where(prediction.settled, prediction.y, np.nan)
    curves = [_judge_curve(ONE_STEP, record, one_step, _list_known_signals(record, 1))]
    e = loop.equations()
    steps = horizon or find_time_constant(compute_moving_poles(loop), e.dt, record)
    if steps > 1:
        index, values = predict_ahead(loop, record, prediction, steps)
        ahead = np.full(len(record), np.nan)
        ahead[index] = values
        curves.append(_judge_curve(Reproduction("prediction", steps), record, ahead,
                             _list_known_signals(record, steps),
                             predict_spread(loop, record, prediction, steps)[0]))  # fmt: skip
    rejected = find_rejection(loop, record)
    curve, notes = _try_simulation(rejected, lambda: _simulate(record, loop, prediction))
    curves += [] if curve is None else [curve]
    made = _make_comparison(write_loop(loop), record, curves, residuals, notes)
    if made.tests and not made.tests[0].passed:
        # The first test is that of their own past.
        made = replace(made, notes=(*made.notes, _TAKEN_FOR_WHITE))
    stepped = describe_unstated_steps(loop, record, prediction.sensor_noise)
    return replace(made, rejection=rejected, steps=stepped)


_TAKEN_FOR_WHITE = (
    "the sensor noise is taken for white here, and the one-step errors are not white. diagnose() "
    "fits coloured noise as well, and tells whether anything but its colour is missing"
)


def _try_simulation(
    rejected: str, simulate: Callable[[], Result]
) -> tuple[Result | None, list[str]]:
    """Return a simulation where the law stands and the model runs, and notes of what came of it."""
    made, notes = None, []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CtrlidWarning)
        try:
            if not rejected:
                made = simulate()
        except (ModelCannotRun, EffectDoesNotApply) as reason:
            notes.append(f"no simulation: {reason}")
    if rejected:
        notes.append("no simulation: the law of the controller is rejected, as the last lines say; "
                     "the prediction uses the logged u instead")  # fmt: skip
    return made, notes + sorted({str(w.message) for w in caught})[-1:]


def _compare_several(record: Record, loop: Loop, horizon: int | None) -> Comparison:
    """Compare each output of a loop with several signals, all reproduced together."""
    prediction = predict(loop, record)
    names, n = loop.signals["y"], len(record)
    settled, y, errors = (
        np.reshape(v, (-1, n)) for v in (prediction.settled, prediction.y, prediction.innovations)
    )
    made = [(ONE_STEP, np.where(settled, y, np.nan), np.full(len(names), np.nan))]
    residuals = np.where(settled, errors, np.nan)
    steps = horizon or find_time_constant(compute_moving_poles(loop), loop.equations().dt, record)
    if steps > 1:
        index, values = predict_ahead(loop, record, prediction, steps)
        ahead = np.full((len(names), n), np.nan)
        ahead[:, index] = values.T
        spread = np.ravel(predict_spread(loop, record, prediction, steps)[0])
        made.append((Reproduction("prediction", steps), ahead, spread))
    rejected = find_wired_rejection(loop, record)
    run, notes = _try_simulation(rejected, lambda: _run_simulation(record, loop, prediction))
    made += [] if run is None else [run[:3]]
    each = []
    for k, name in enumerate(names):
        part = record.select(y=name)
        curves = [
            _judge_curve(how, part, values[k],
                         _list_known_signals(part, max(how.horizon, 1)), float(noise[k]))
            for how, values, noise in made
        ]  # fmt: skip
        each.append(_make_comparison(name, part, curves, residuals[k], []))
    curves = [replace(c, label=f"{c.label} of {one.what}") for one in each for c in one.curves]
    tests = tuple(replace(t, name=f"{t.name}, of {one.what}") for one in each for t in one.tests)
    notes += [f"{note}, of {one.what}" for one in each for note in one.notes]
    what = write_loop(loop).partition(", wired:")[0]
    return Comparison(what, record, tuple(curves), residuals, tests, tuple(notes),
                      tuple(each), rejected,
                      describe_unstated_steps(loop, record, prediction.sensor_noise))  # fmt: skip


def _list_known_signals(record: Record, steps: int) -> list[tuple[Array, int]]:
    """Return the signals that an error `steps` after the last known output should not follow.

    The reference, if there is one: the input carries the noise itself round the loop. Without a
    reference the input as it was known then.
    """
    if record.r is None:
        return [(row, steps) for row in np.reshape(record.u, (-1, len(record)))]
    return [(row, 1) for row in np.reshape(record.r, (-1, len(record)))]


def _make_comparison(
    what: str, record: Record, curves: list[Curve], residuals: Array, notes: list[str]
) -> Comparison:
    known = tuple(c for c in curves if np.isfinite(c.rms))
    notes += [f"no {c.label}: no stretch of valid samples is long enough"
              for c in curves if c not in known]  # fmt: skip
    exact = known[0].fit > EXACT
    tests = () if exact else _test_residuals(record, residuals)
    return Comparison(what, record, known, residuals, tests, tuple(notes))


def _simulate(record: Record, loop: Loop, prediction: Prediction) -> Curve:
    """Simulate a record, stretch by stretch, each from its own best initial state.

    Once more with noise of the size found in the one-step errors, to see what it makes of it.
    """
    how, y, by_noise, injected = _run_simulation(record, loop, prediction)
    driven = [] if record.r is None else [(np.asarray(record.r), 1)]
    if np.std(injected) > MEANINGFUL * np.std(record.u) and not (driven and not loop.controller):
        driven.append((injected, 1))
    return _judge_curve(how, record, y, driven, float(by_noise[0]))


def _run_simulation(
    record: Record, loop: Loop, prediction: Prediction
) -> tuple[Reproduction, Array, Any, Array]:
    """Return how a record is simulated, its outputs, what noise makes of each, and what drives it.

    Of several outputs each has a row.
    """
    if loop.controller is None and compute_growth_rate(loop) > -1e-9:
        raise ModelCannotRun(
            "the plant is not stable and the loop has no controller, so an open-loop simulation "
            "would drift without bound. Make the loop with the controller of the record: "
            "Loop(plant, controller, ...)"
        )
    y, noisy = np.full(np.shape(record.y), np.nan), np.zeros(np.shape(record.y))
    injected = np.zeros(np.shape(record.u))
    simulator = make_simulator(loop, hold=record.hold, hold_r=record.hold_r)
    for part in find_long_stretches(record, loop):
        stretch = prepare_stretch(
            simulator, record, part, start_time=0.0, guess=prediction.states[part.start],
            seek_controller=True, set_point=True,
        )  # fmt: skip
        y[..., part], injected[..., part] = stretch.run(simulator)[0], stretch.d
        noisy[..., part] = _run_with_noise(simulator, stretch, prediction) - y[..., part]
    # Through a curved law noise moves the mean as well, and that is its doing too.
    rows = zip(*(np.reshape(v, (-1, len(record))) for v in (noisy, y)), strict=True)
    by_noise = np.array([np.sqrt(np.mean(v[np.isfinite(made)] ** 2)) for v, made in rows])
    return CLOSED_LOOP if loop.controller else OPEN_LOOP, y, by_noise, injected


def _run_with_noise(simulator: Simulator, stretch: Stretch, prediction: Prediction) -> Array:
    """Return the output of one run with the noise of a prediction, NaN where that cannot be."""
    unknown = np.full((), np.nan)
    e = simulator.loop.equations()
    if e.dt and not e.velocities:
        # A plant in discrete time has no place for the force noise of the prediction.
        return unknown
    sizes = [np.reshape(v, (-1, 1)) for v in (prediction.sensor_noise, prediction.force_noise)]
    streams = np.random.default_rng(0).standard_normal((sum(map(len, sizes)), stretch.d.shape[-1]))
    noise = [streams[: len(sizes[0])] * sizes[0], streams[len(sizes[0]) :] * sizes[1]]
    try:
        return stretch.run(simulator, noise)[0]
    except ModelCannotRun:
        return unknown


def _sample_model(model: Any, record: Record, delay: float) -> tuple[dict[str, Array], Array]:
    """Return the polynomials in z of a continuous model, its input as the record has it and late.

    A band-limited input has a numerator for each of its corners.
    """
    if delay and record.hold != "zoh":
        model, delay = model.with_delay(), 0.0
    a, b, c, d = to_state_matrices(model)
    motion = discretize_model(a, b[:, 0], c[0], record.dt, record.hold, delay)
    columns = np.column_stack([column for *_, column in motion.inputs])
    paths, den = to_polynomials(motion.f, columns, motion.c[None], np.zeros((1, columns.shape[1])))
    late = max(lag for _, lag, _ in motion.inputs)
    nums: dict[str, Array] = {"u": float(d[0, 0]) * den}
    for (name, lag, _), path in zip(motion.inputs, paths, strict=True):
        more = np.append(path[1:], np.zeros(late - lag))
        nums[name] = np.asarray(np.polyadd(nums.get(name, np.zeros(1)), more), dtype=float)
    return nums, np.append(den, np.zeros(late))


def _compare_model(record: Record, model: Any, horizon: int | None) -> Comparison:
    if model.ninputs != 1 or model.noutputs != 1:
        raise CtrlidError("compare needs a model with one input and one output; given "
                          f"{write_count(model.ninputs, 'input')} and "
                          f"{write_count(model.noutputs, 'output')}. Pick a channel, "
                          "for example G[0, 0]")  # fmt: skip
    dt = record.dt if model.dt is True else timebase(model)
    if dt and not have_same_period(dt, record.dt):
        both = write_both_periods("the model is sampled", dt, "the record", record.dt)
        raise CtrlidError(f"{both}; fit or sample the model at the record's period: "
                          f"{write_difference(dt, record.dt)}")  # fmt: skip
    poles = ", ".join(write_number(p, 4) for p in model.poles())
    what = f"{model.name} (poles {poles or 'none'}"
    delay = read_delay(model)
    what += f", delay {write_number(delay, 4)} s)" if delay else ")"
    if not dt:
        nums, den = _sample_model(model, record, delay)
    else:
        num, den = (np.asarray(p[0][0], float) for p in (model.num, model.den))
        nums = {"u": num}
    nums = {
        name: np.concatenate([np.zeros(len(den) - len(num)), num]) / den[0]
        for name, num in nums.items()
    }
    den = den / den[0]
    order = len(den) - 1
    valid = np.asarray(record.valid)
    usable = find_whole_past(valid, order)
    if np.count_nonzero(usable) < FEWEST:
        raise ModelCannotRun(
            f"a model of order {order} needs {FEWEST + order} valid samples in "
            "succession; the record has "
            f"{write_count(int(np.count_nonzero(valid)), 'valid sample')} of {len(record)}"
        )
    y0, u0 = float(np.mean(record.y[valid])), float(np.mean(record.u[valid]))
    y, u = record.y - y0, record.u - u0
    signals = list_inputs(u, record.hold, valid)
    driven = np.sum([np.convolve(signals[k], num)[: len(u)] for k, num in nums.items()], axis=0)
    error = np.convolve(y, den)[: len(y)] - driven
    constant = float(np.mean(error[usable]))
    error = np.where(usable, error - constant, 0.0)
    stretches = [(a + order, b) for a, b in record.segments() if b - a > order]
    noise = np.eye(1, order + 1)[0]
    if not (isinstance(model, IdentifiedModel) and model.estimate.errors == "equation error"):
        noise = fit_noise_polynomial(error, stretches, den)
    white_errors = whiten_errors(error, stretches, noise)
    residuals = np.where(usable, white_errors, np.nan)
    curves = [_judge_curve(ONE_STEP, record, record.y - residuals, _list_known_signals(record, 1))]
    roots = np.roots(den)
    # White one-step errors pass through C/A.
    white = float(np.std(residuals[usable]))
    with np.errstate(over="ignore"):
        impulse = signal.lfilter(noise, den, np.eye(1, len(record))[0])
        grown = np.sqrt(np.cumsum(impulse**2))
    steps = horizon or find_time_constant(roots, record.dt, record)
    if steps > 1:
        ahead = y0 + _predict_arx_ahead(
            y, driven + constant, den, noise, white_errors, steps, usable
        )
        known = _list_known_signals(record, steps)
        curves.append(
            _judge_curve(
                Reproduction("prediction", steps), record, ahead, known, white * grown[steps - 1]
            )
        )
    notes = []
    if np.all(np.abs(roots) < 1 - 1e-9):
        free = y0 + _simulate_arx(record, y, driven + constant, den)
        outside = _list_known_signals(record, 1)
        curves.append(_judge_curve(OPEN_LOOP, record, free, outside, white * grown[-1]))
    else:
        notes.append("an unstable model cannot be simulated in open loop; for a closed-loop "
                     "simulation put it into a Loop with its controller")  # fmt: skip
    return _make_comparison(what, record, curves, residuals, notes)


def _simulate_arx(record: Record, y: Array, driven: Array, den: Array) -> Array:
    """Iterate the ARX equation over each valid stretch from its first measured outputs."""
    order = len(den) - 1
    free = np.full(len(y), np.nan)
    for start, stop in record.segments():
        if stop - start > order:
            state = signal.lfiltic([1.0], den, y[start : start + order][::-1])
            free[start + order : stop] = signal.lfilter(
                [1.0], den, driven[start + order : stop], zi=state
            )[0]
    return free


def _predict_arx_ahead(
    y: Array, driven: Array, den: Array, noise: Array, white: Array, steps: int, usable: Any
) -> Array:
    """Iterate ``A y = B u + C e`` `steps` times, with the predictions and errors made before."""
    order, n = len(den) - 1, len(y)
    # past[i] holds, for each origin k, the (predicted or measured) output at k + j - i.
    past = [np.concatenate([np.zeros(i), y[: n - i]]) for i in range(order)]
    for j in range(1, steps + 1):
        drive = np.concatenate([driven[j:], np.full(j, np.nan)])
        new = drive - sum((a * p for a, p in zip(den[1:], past, strict=True)), np.zeros(n))
        # Errors after the origin are not known, so that their mean, zero, stands for them.
        for i in range(j, order + 1):
            new += noise[i] * np.concatenate([np.zeros(i - j), white[: n - (i - j)]])
        past = [new, *past][:order]
    ahead = np.full(n, np.nan)
    ahead[steps:] = new[: n - steps]
    ahead[~find_whole_past(usable, steps - 1)] = np.nan
    ahead[: steps + order] = np.nan
    return ahead


def _judge_curve(
    how: Reproduction, record: Record, y: Array, signals: Sequence[tuple[Array, int]],
    noise: float = float("nan"),
) -> Curve:  # fmt: skip
    """Judge a reproduction; `noise` is the error that noise alone makes, NaN if not known."""
    known = np.asarray(record.valid) & np.isfinite(y)
    unit = record.units.get("y", "")
    if not known.any():
        nan = float("nan")
        return Curve(str(how), y, nan, nan, nan, nan, unit=unit)
    error = np.where(known, record.y - y, 0.0)
    measured = record.y[known]
    size = float(np.linalg.norm(measured - measured.mean())) if np.ptp(measured) > 0 else 0.0
    fit = 100 * (1 - float(np.linalg.norm(error[known])) / size) if size else float("nan")
    rms = float(np.sqrt(np.mean(error[known] ** 2)))
    follows = 0.0 if fit > EXACT else compute_explained_share(error, signals, known)
    share = 1 - follows
    if fit <= EXACT and np.isfinite(noise) and noise < rms:
        share = min(share, (noise / rms) ** 2)
    useless = rms > 0 and rms > BEATEN * _measure_simple_guesses(record, how.horizon, error, known)
    return Curve(str(how), np.where(known, y, np.nan), fit, rms, follows, share, useless, unit)


def _measure_simple_guesses(record: Record, steps: int, error: Array, known: Any) -> float:
    """Return the RMS error of the best guess without a model, as one over all samples of a curve.

    A prediction is set beside the last value known and the line through the last two, on the
    samples where both are known; any curve beside the mean.
    """
    y = np.asarray(record.y)
    rms = float(np.sqrt(np.mean(error[known] ** 2)))
    best = float(np.std(y[known]))
    both = known & find_whole_past(np.asarray(record.valid), steps + 1)
    if not steps or not both.any():
        return best
    last, before = np.roll(y, steps), np.roll(y, steps + 1)
    own = max(float(np.sqrt(np.mean(error[both] ** 2))), 1e-300)
    for guess in (last, last + steps * (last - before)):
        best = min(best, rms / own * float(np.sqrt(np.mean((y - guess)[both] ** 2))))
    return best


def _test_residuals(record: Record, residuals: Array) -> tuple[Correlation, ...]:
    known = np.isfinite(residuals)
    e = np.where(known, residuals, 0.0)
    lags = int(min(25, max(known.sum() // 10, 1)))
    tests = [autocorrelation(e, known, lags),
             *(cross_correlation(e, row, known, name, lags, 1)
               for name, row in _list_rows(record, "u"))]  # fmt: skip
    if record.r is not None:
        tests += [cross_correlation(e, row, known, name, lags, 0)
                  for name, row in _list_rows(record, "r")]  # fmt: skip
    return tuple(tests)


def _list_rows(record: Record, key: str) -> list[tuple[str, Array]]:
    """Return the inputs or references of a record, each with its name where there are several."""
    values = np.asarray(getattr(record, key))
    if values.ndim == 1:
        return [(key, values)]
    return list(zip(record.signals[key], values, strict=True))
