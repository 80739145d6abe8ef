"""fit_simulation(): physical parameters by the error of a simulation that uses no measured output.

It stands on this floor, above the other estimators, because it has to know first whether the stated
controller is the one that made the record: with another one the measured output would come in.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import optimize

from .._base.arguments import check_arguments, explain_names
from .._base.arrays import Array, ComplexArray
from .._base.errors import CtrlidError, ModelCannotRun
from .._base.interruption import check_budget, hold_interrupt
from .._base.rounding import keep_numpy_quiet
from .._base.statistics import pseudo_inverse
from .._base.text import write_list
from ..data.outliers import describe_outliers, mask_outliers
from ..data.record import Record
from ..data.several_records import as_records, order_model_and_data
from ..effects import Quantization
from ..estimation.likelihood.filter_data import FEWEST, find_noise_units
from ..estimation.likelihood.likelihood import list_parameter_bounds
from ..estimation.likelihood.physics_estimate import (
    LoopFit,
    SimulationEstimate,
    mark_unseen,
    note_absurd_values,
)
from ..estimation.likelihood.physics_fit import choose_free_names, list_starts
from ..loop.loop import Loop
from ..loop.period_map import leave_out_kinks, linearize_sensors_at_rest, make_period_map
from ..loop.sensitivities import (
    SensitiveSimulation,
    build_sensitive_simulation,
    find_delay_range,
)
from ..loop.simulation import make_simulator
from ..loop.unit_check import note_unit_clashes
from ..loop.wiring import knows_references, match_signals
from .error_covariance import compute_score_covariance
from .record_simulation import find_long_stretches, prepare_stretch
from .reproduction import choose_reproduction, find_law_rejection

# Outputs are weighed by their own errors, which are known after a fit; so many times at most.
ROUNDS = 6
# No further round follows one that moved the errors by less than this share.
SETTLED = 1e-3
# A period has at most so many integration steps: more of them do not make dry friction smooth.
SUBSTEPS = 4
# A search ends where a step gains less than this share of the sum of squares: a hundredth of what
# the noise of a thousand samples leaves open.
ENOUGH = 1e-5
# It takes at most so many steps.
STEPS = 40
# Where a simulation runs away, it errs by so many spreads of the output: its numbers say no more.
LOST = 1e3
# A parameter that is nearer to its bound than this share of its standard error is on it.
NEAR = 0.05
# A search begins this share of a parameter inside its bounds, as its solver demands.
INSIDE = 1e-9


@explain_names
@hold_interrupt()
@keep_numpy_quiet
def fit_simulation(
    loop: Loop,
    record: Record | Sequence[Record],
    *,
    free: Sequence[str] | Mapping[str, float] | None = None,
    intercept: bool = True,
) -> LoopFit:
    r"""Fit the uncertain physical parameters of a loop by the error of its simulation.

    .. math:: \min_{\theta, x_0, c} \; \sum_j \frac{1}{\sigma_j^2} \sum_k
        \bigl(y_j[k] - \hat y_j[k; \theta, x_0, r, d] - c_j\bigr)^2

    The whole loop is simulated from its references r and the injected signal d, which is what the
    controller leaves of the logged input; a stable plant without a controller from its input. No
    measured output enters, so that noise of any colour, a coarse encoder or a disturbance that the
    references do not cause bias no parameter. Where the noise is white and the model complete,
    `fit_loop` is the more accurate of the two, and it needs neither controller nor reference.
    Initial states are fitted with the parameters, and so is a constant c for each output, because
    noise moves the level of a plant with a curved law, and zeros of sensors are seldom exact. Each
    output j is weighed by the root mean square of its own error. Standard errors allow for
    correlated errors.

    Parameters
    ----------
    loop : Loop
        Plant with the names of its uncertain parameters in `free`, and the controller that made the
        record; its values are the start. Effects in the loop are fitted with them.
    record : Record or sequence of Record
        The data; several records share the parameters. Each valid stretch has an initial state of
        its own.
    free : sequence of str, or mapping of str to float, optional
        Parameters to fit; by default those of `loop.free` and those of the effects. How well a
        parameter is known beforehand does not take part: an error with correlations of its own
        cannot be weighed against it.
    intercept : bool, optional
        Whether a constant is fitted for each output and stretch, so that levels tell nothing of the
        parameters. Without it they do, and offsets of inputs and sensors can be fitted.

    Returns
    -------
    LoopFit
        The loop with the fitted values, and a `SimulationEstimate`.

    Raises
    ------
    CtrlidError
        If nothing is free, the records do not fit the loop, the stated controller is not the one
        that computed the logged input, an unstable plant has no controller, or the loop as given
        runs away when it is simulated.

    References
    ----------
    Landau and Karimi, "Recursive algorithms for identification in closed loop: a unified approach
    and evaluation", Automatica 33 (1997) 1499-1523; Ljung, *System Identification*, section 7.6 on
    the weights.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    >>> op = cid.operating_point(plant, output=0.012)
    >>> C = cid.design_lead(cid.linearize(plant, op), crossover=100, phase_margin=50)
    >>> loop = cid.Loop(plant, C.sample(0.001, "tustin"), dt=0.001, at=op, free=("K",))
    >>> r = cid.random_binary(3000, amplitude=1e-4, hold=20, around=op.output, seed=1)
    >>> record = cid.simulate(loop, r, sensor_noise=2e-6, seed=2)
    >>> fitted = cid.fit_simulation(loop.with_parameters({"K": 3.1e-6}), record)
    >>> low, high = fitted.estimate.confidence_interval("K", level=0.999)
    >>> low < 3.34e-6 < high
    True
    """
    loop, record = order_model_and_data(loop, record)
    check_arguments(fit_simulation, locals(), "loop", "record")
    names = choose_free_names(loop, free, "fit_simulation")
    whole, loop = loop, _take_out_steps(loop, names)
    _require_start(loop, names)
    given = as_records(record)
    masked = [mask_outliers(one) for one in given]
    records = tuple(match_signals(one, loop.equations(), loop.wiring) for one, _ in masked)
    for one in records:
        how = choose_reproduction(loop, one)
        if how.horizon:
            raise ModelCannotRun(
                f"fit_simulation cannot simulate this record, because {_explain(loop, one)} "
                "fit_loop(loop, record) fits the same parameters without a simulation"
            )
    sizes, starts = np.full(len(loop.signals["y"]), np.inf), list_starts(loop)
    for _ in range(ROUNDS):
        # Other parameters need other steps of integration, and start at other states.
        point = _start(_prepare(loop, names, records, intercept))
        point = _fit(point, np.minimum(sizes, point.sizes))
        loop = loop.with_parameters(dict(zip(names, point.theta.tolist(), strict=True)))
        if np.all(np.abs(point.sizes - sizes) < SETTLED * point.sizes):
            unsettled: tuple[str, ...] = ()
            break
        sizes = point.sizes
    else:
        unsettled = (
            f"THE FIT HAS NOT SETTLED after {ROUNDS} rounds: call fit_simulation again with the "
            "loop that it returned",
        )
    left_out = [describe_outliers(one, lost)
                for one, (_, lost) in zip(given, masked, strict=True) if lost.any()]  # fmt: skip
    notes = (*note_unit_clashes(loop, records[0]), *left_out, *unsettled)
    estimate = _summarize(point, find_noise_units(loop, records[0])[0], notes)
    absurd = note_absurd_values(names, starts, point.theta, estimate.standard_errors)
    loop = whole.with_parameters({name: loop.parameters[name] for name in names})
    return LoopFit(loop, replace(estimate, notes=(*absurd, *estimate.notes)))


def _take_out_steps(loop: Loop, names: Sequence[str]) -> Loop:
    """Return the loop without the steps of its converters, which have no slope to go by.

    A reading that moves in steps errs by them, as by other noise; the mean of many does not.
    """
    for label, effect in loop.labelled.items():
        if isinstance(effect, Quantization) and not any(n.startswith(f"{label}.") for n in names):
            loop = loop.without_effect(label)
    return loop


def _require_start(loop: Loop, names: Sequence[str]) -> None:
    """Refuse effects at values that do nothing: a simulation has no slope to leave them by."""
    used = loop.equations().parameters
    absent = [name for name in names if name not in used]
    if absent:
        raise CtrlidError(f"fit_simulation needs a start from which each effect acts, but at "
                          f"{write_list(absent)} = 0 there is none: give a size, about as large as "
                          "you expect it")  # fmt: skip


def _explain(loop: Loop, record: Record) -> str:
    """Return why a record cannot be simulated."""
    if loop.controller is None:
        return (
            "the plant is not stable and the loop has no controller: the smallest error would grow "
            "without bound. Give Loop(plant, controller, ...) the controller of the record."
        )
    if not knows_references(loop.wiring, record):
        return (
            "it has no reference, which a loop with a controller is simulated from. Give the "
            "record r=, a constant for a fixed set-point."
        )
    rejected = find_law_rejection(loop, record)
    if not rejected:
        return f"{choose_reproduction(loop, record).reason}."
    return (
        f"the law of the controller is rejected: {rejected} With another law the measured "
        "output would come into the simulation."
    )


@dataclass(frozen=True, eq=False)
class _Stretch:
    """A valid stretch of a record as the map of a period takes it.

    `start` is the initial state of plant, controller and input, `w` the signals, a column for each
    sample, `y` the measured outputs, a row for each, with NaN where they do not count.
    """

    start: Array
    w: Array
    y: Array


@dataclass(frozen=True, eq=False)
class _Task:
    """Records to be simulated by a loop, with its sensitivities for one period in `step`.

    The first `states` entries of a stretch's start are those of the plant, which are fitted;
    `constants` is the number of those of a stretch, one for each output or none;
    `lower` and `upper` bound the parameters where the map holds, within their own bounds `limits`.
    """

    loop: Loop
    names: tuple[str, ...]
    stretches: tuple[_Stretch, ...]
    states: int
    constants: int
    step: SensitiveSimulation
    lower: Array
    upper: Array
    limits: tuple[Array, Array]


@dataclass(frozen=True, eq=False)
class _Point:
    """The simulations of a task at some parameters.

    `nuisance` are the initial states of the plant and the constants, a row for each stretch.
    `errors`, shape (samples, outputs), and `slopes`, shape (samples, outputs, values), are zero
    where an output does not count; stretches follow one another, and the derivatives by the
    parameters come first. `sizes` are root mean squares of the errors by outputs, `n_samples` says
    how many values count.
    """

    task: _Task
    theta: Array
    nuisance: Array
    errors: Array
    slopes: Array
    sizes: Array
    n_samples: int


def _prepare(
    loop: Loop, names: tuple[str, ...], records: Sequence[Record], intercept: bool
) -> _Task:
    hold, hold_r = records[0].hold, records[0].hold_r
    simulator = make_simulator(loop, most=SUBSTEPS, hold=hold, hold_r=hold_r)
    stretches, substeps = [], 1
    for record in records:
        for samples in find_long_stretches(record, loop):
            made = prepare_stretch(simulator, record, samples, start_time=0.0, seek_controller=True)
            *_, needed = simulator.run_in_steps(
                1, made.initial, made.r, made.d, start_time=made.start_time
            )
            substeps = max(substeps, needed)
            w = simulator.stack_signals(made.r, made.d, start_time=made.start_time)
            y, seen = (np.reshape(v, (-1, len(record)))[:, samples]
                       for v in (record.y, record.valid_outputs))  # fmt: skip
            stretches.append(_Stretch(made.initial, w, np.where(seen, y, np.nan)))
    if not stretches:
        raise CtrlidError(
            "fit_simulation needs a stretch of at least "
            f"{FEWEST} valid samples in a row, and the record has none"
        )
    states, limits = len(simulator.plant_states), list_parameter_bounds(loop, names)
    step = build_sensitive_simulation(loop, names, substeps, hold, hold_r)
    constants = len(loop.signals["y"]) if intercept else 0
    return _Task(loop, names, tuple(stretches), states, constants, step,
                 *_narrow_bounds(loop, names, *limits), limits)  # fmt: skip


def _narrow_bounds(
    loop: Loop, names: Sequence[str], lower: Array, upper: Array
) -> tuple[Array, Array]:
    """Return the bounds of parameters as far as the map of a period holds."""
    holds = np.array([find_delay_range(loop, name) for name in names])
    return np.maximum(lower, holds[:, 0]), np.minimum(upper, holds[:, 1])


def _start(task: _Task) -> _Point:
    """Return the simulations of a loop as it is given."""
    parameters = task.loop.equations().parameters
    theta = np.array([parameters[name] for name in task.names], dtype=float)
    starts = np.array([one.start[: task.states] for one in task.stretches])
    return _evaluate(task, theta, np.pad(starts, ((0, 0), (0, task.constants))))


def _evaluate(task: _Task, theta: Array, nuisance: Array) -> _Point:
    p, n, own = len(theta), task.states, nuisance.shape[1]
    errors, slopes, samples = [], [], 0
    for k, stretch in enumerate(task.stretches):
        outputs, count = stretch.y.shape
        check_budget(count)
        start = np.concatenate([nuisance[k, :n], stretch.start[n:]])
        y, moved = task.step.run(start, stretch.w, theta, n)
        slope = np.zeros((count, outputs, p + nuisance.size))
        slope[:, :, :p] = -moved[:, :, :p]
        slope[:, :, p + own * k : p + own * k + n] = -moved[:, :, p:]
        slope[:, :, p + own * k + n : p + own * (k + 1)] = -np.eye(outputs)[:, : task.constants]
        error = stretch.y.T - y - (nuisance[k, n:] if task.constants else 0.0)
        lost = ~(np.isfinite(error) & np.isfinite(slope).all(axis=2))
        out = np.isnan(stretch.y.T)
        error[lost] = (LOST * np.nanstd(stretch.y, axis=1) * np.ones_like(error))[lost]
        error[out] = 0.0
        slope[lost | out] = 0.0
        errors.append(error)
        slopes.append(slope)
        samples += (~out).sum(axis=0)
    joined = np.concatenate(errors)
    sizes = np.sqrt(np.sum(joined**2, axis=0) / np.maximum(samples, 1))
    return _Point(
        task, theta, nuisance, joined, np.concatenate(slopes), sizes, int(np.sum(samples))
    )


def _fit(point: _Point, sizes: Array) -> _Point:
    """Return the values with the smallest error nearby, outputs weighed by the sizes of theirs."""
    task, p, shape = point.task, len(point.theta), point.nuisance.shape
    free = np.full(point.nuisance.size, np.inf)
    lower, upper = np.concatenate([task.lower, -free]), np.concatenate([task.upper, free])
    start = np.concatenate([point.theta, point.nuisance.ravel()])
    inside = INSIDE * np.maximum(np.abs(start), INSIDE)
    start = np.clip(start, lower + inside, upper - inside)
    weights = 1 / np.maximum(sizes, np.finfo(float).tiny)
    last: dict[bytes, _Point] = {}

    def evaluate(v: Array) -> _Point:
        if v.tobytes() not in last:
            last.clear()
            last[v.tobytes()] = _evaluate(task, v[:p], v[p:].reshape(shape))
        return last[v.tobytes()]

    def weigh_errors(v: Array) -> Array:
        return (evaluate(v).errors * weights).ravel()

    def weigh_slopes(v: Array) -> Array:
        return (evaluate(v).slopes * weights[:, None]).reshape(-1, len(v))

    found = optimize.least_squares(
        weigh_errors,
        start,
        weigh_slopes,
        bounds=(lower, upper),
        x_scale="jac",
        ftol=ENOUGH,
        max_nfev=STEPS,
    )
    return evaluate(found.x)


def _summarize(point: _Point, units: Any, notes: tuple[str, ...]) -> SimulationEstimate:
    r"""Return parameters, their covariance and the size of the errors.

    .. math:: H^{-1} M H^{-1}, \quad H = \sum_k \psi_k \psi_k^T, \quad
        M = \operatorname{cov} \sum_k \psi_k e_k

    with errors e and slopes psi in units of the errors' size: the covariance of least squares under
    correlated errors (Ljung, *System Identification*, section 9.3).
    """
    task, p = point.task, len(point.theta)
    weights = 1 / np.maximum(point.sizes, np.finfo(float).tiny)
    slopes, errors = point.slopes * weights[:, None], point.errors * weights
    ends = np.cumsum([one.y.shape[1] for one in task.stretches])[:-1]
    middle = compute_score_covariance(
        np.split(slopes, ends), np.split(errors, ends), _make_amplification(task.loop, point.sizes)
    )
    flat = slopes.reshape(-1, slopes.shape[2])
    matrix = flat.T @ flat
    free = np.ones(len(matrix), dtype=bool)
    covariance = _compute_covariance(matrix, middle, free, p)
    # A parameter that is so much nearer to its bound than its error says cannot be told from it.
    near = NEAR * np.sqrt(np.diag(covariance))
    on_bound = (point.theta <= task.limits[0] + near) | (point.theta >= task.limits[1] - near)
    free[:p] = ~on_bound
    covariance = _compute_covariance(matrix, middle, free, p)
    covariance, lost = mark_unseen(covariance, matrix, free, task.names)
    return SimulationEstimate(
        task.names, point.theta, covariance, tuple(point.sizes.tolist()), point.n_samples,
        tuple(n for n, b in zip(task.names, on_bound, strict=True) if b),
        (*notes, *lost), units,
    )  # fmt: skip


def _compute_covariance(matrix: Array, middle: Array, free: Any, p: int) -> Array:
    """Return the covariance of the first p parameters, zero for those that are not free."""
    rows = np.flatnonzero(free & (np.diag(matrix) > 0))
    inverse = pseudo_inverse(matrix[np.ix_(rows, rows)])
    covariance = np.zeros(matrix.shape)
    covariance[np.ix_(rows, rows)] = inverse @ middle[np.ix_(rows, rows)] @ inverse
    return covariance[:p, :p]


def _make_amplification(loop: Loop, sizes: Array) -> Callable[[Array], ComplexArray]:
    """Return how a loop amplifies noise at a frequency, with outputs in units of `sizes`."""
    p = len(sizes)

    def keep(frequencies: Array) -> ComplexArray:
        return np.broadcast_to(np.eye(p, dtype=complex), (len(frequencies), p, p))

    if loop.controller is None:
        return keep
    a, b, c, d = linearize_sensors_at_rest(make_period_map(leave_out_kinks(loop), 1))
    if not all(np.isfinite(v).all() for v in (a, b, c, d)):
        return keep

    def evaluate(frequencies: Array) -> ComplexArray:
        ahead = np.exp(1j * frequencies)[:, None, None] * np.eye(len(a)) - a
        found = c @ np.linalg.solve(ahead, np.broadcast_to(b, (len(frequencies), *b.shape))) + d
        left, gains, right = np.linalg.svd(found * sizes / sizes[:, None])
        # Where the loop suppresses noise, at rest altogether, it is taken to do nothing.
        return np.asarray((left * np.maximum(gains, 1.0)[:, None]) @ right)

    return evaluate
