"""The filter run along a record, on the plant linearized.

The extended Kalman filter linearizes about its own estimate. Here all samples are linearized at
once about the estimate of the pass before, which is the same thing when the two agree; they do
after two or three passes, and between the passes parameters and noise may move as well.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import casadi
import numpy as np
from scipy import linalg, signal

from ..._base.arrays import Array
from ..._base.errors import ModelCannotRun
from ..._base.interruption import check_budget
from ..._base.statistics import compute_lagged_products
from ...physics.block_evaluation import BlockEvaluation
from .filter_data import FilterData
from .kalman_recursion import choose_sizes, filter_pass
from .sampled_plant import Linearized, SampledPlant, Trajectory
from .tails import GAUSSIAN, JointTails, Tails

# While its variance exceeds so many times the median, a prediction depends on the initial state.
INITIAL_VARIANCE_RATIO = 4.0
# So many Newton steps invert the curve of a sensor.
NEWTON = 6
# What goes with a pass, such as a model that is built for it, takes as long as so many samples.
BESIDE_A_PASS = 2000
# A trajectory converges in two or three passes; after so many it is taken as it is.
PASSES = 12
# A trajectory that moves by less than this share of its standard deviation has converged.
CONVERGED_MOTION = 1e-3


@dataclass(frozen=True)
class Noise:
    """The noise of a loop, as variances relative to that of the sensor.

    Parameters
    ----------
    force : tuple of float
        Variances of the white forces that are held over each period.
    memory : float
        Correlation of the coloured force from one sample to the next.
    drift : float
        Variance of the steps of the coloured force; zero: there is none.
    ar, ma : tuple of float
        Coefficients of coloured sensor noise,
        ``n[k] = ar[0] n[k-1] + ... + w[k] + ma[0] w[k-1] + ...``; white if both are empty.
    sensors : tuple of float
        Variances of the sensor noise of all further outputs, relative to that of the first.
    tails : Tails, JointTails or None
        Heavy tails of the sensor noise, of several outputs jointly; None: it is Gaussian.
    """

    force: tuple[float, ...]
    memory: float = 0.0
    drift: float = 0.0
    ar: tuple[float, ...] = ()
    ma: tuple[float, ...] = ()
    tails: Tails | JointTails | None = None
    sensors: tuple[float, ...] = ()

    @property
    def ratios(self) -> Array:
        """Variances of the sensor noise of all outputs, relative to that of the first."""
        return np.array([1.0, *self.sensors])

    @property
    def plain(self) -> "Noise":
        """The noise without its colours, of force and sensor."""
        return Noise(self.force, tails=self.tails, sensors=self.sensors)

    @property
    def is_coloured(self) -> bool:
        """Whether the force or the sensor noise has a colour."""
        return bool(self.drift) or not self.sensor_is_white

    @property
    def sensor_is_white(self) -> bool:
        """Whether the sensor noise is white."""
        return not (self.ar or self.ma)

    @property
    def parameters(self) -> int:
        """Number of parameters beyond those of white Gaussian noise."""
        tails = self.tails.parameters if self.tails is not None else 0
        return 2 * bool(self.drift) + len(self.ar) + len(self.ma) + tails

    @property
    def coloured(self) -> float:
        """Variance of the coloured force."""
        return self.drift / (1 - self.memory**2)


@dataclass(frozen=True, eq=False)
class Filtered:
    """What one pass of the filter gives; variances are relative to the sensor noise's.

    Of several outputs innovations and variances have shape (n, outputs), and that of each output is
    given those of the same sample before it.
    """

    innovations: Array
    variance: Array
    trajectory: Trajectory
    slopes: Array
    disturbance: Array


def run_filter(
    plant: SampledPlant, data: FilterData, lin: Linearized, noise: Noise, sensitive: bool = True,
    columns: int | None = None,
) -> Filtered:  # fmt: skip
    """Run the filter along a linearized plant, with sensitivities to its first columns."""
    p = len(plant.index) if columns is None else columns
    return _run_pass(data, lin, noise, p if sensitive else 0, noise.ratios)


def predict_outputs(data: FilterData, lin: Linearized, noise: Noise) -> tuple[Array, Array]:
    """Return errors and variances of each output predicted from the samples before, (n, outputs).

    In one pass only the first output is predicted without those of its own sample.
    """
    q = lin.output.shape[1]
    scale = noise.ratios
    errors, variances = [], []
    for k in range(q):
        order = [k, *(i for i in range(q) if i != k)]
        turned = replace(lin, output=lin.output[:, order], c=lin.c[:, order], hp=lin.hp[:, order])
        moved = replace(data, y=data.y[:, order], valid=data.valid[:, order],
                        alike=data.alike[:, order], counted=data.counted[:, order])  # fmt: skip
        tails = noise.tails.reorder(order) if isinstance(noise.tails, JointTails) else None
        out = _run_pass(moved, turned, replace(noise, tails=tails), 0, scale[order])
        errors.append(out.innovations[:, 0])
        variances.append(out.variance[:, 0])
    return np.column_stack(errors), np.column_stack(variances)


def _run_pass(data: FilterData, lin: Linearized, noise: Noise, p: int, ratios: Array) -> Filtered:
    """Run the filter, with sensitivities to p parameters, and the noise of each output by ratios.

    Of one output the axis of outputs is left out.
    """
    scale, n, tails = np.sqrt(ratios), lin.step.shape[1], noise.tails
    out = filter_pass(*arrange_pass(data, lin, noise, p, scale))
    error, variance, before, after, wide, slopes, disturbance = out
    if lin.output.ndim == 1:
        error, variance, slopes = error[:, 0], variance[:, 0], slopes[:, 0]
    variance = _count_alone(variance, data, noise)
    if lin.output.ndim == 2:
        error, variance, slopes = error * scale, variance * scale**2, slopes * scale[:, None]
    # The caller reports a filter that lost the record, so that no warning is needed here.
    with np.errstate(all="ignore"):
        squares = (error**2 / variance)[data.usable]
        sensor = np.sqrt(np.mean(squares) if tails is None else tails.scale)
    trajectory = Trajectory(before[:, :n], after[:, :n], wide[:, :n] * sensor)
    return Filtered(error, variance, trajectory, slopes, disturbance)


def _count_alone(variance: Array, data: FilterData, noise: Noise) -> Array:
    """Return the variances of innovations of which each reading errs by itself."""
    return variance - (data.alike - 1.0) if noise.sensor_is_white else variance


class PassArguments(NamedTuple):
    """What `kalman_recursion.filter_pass` takes, in its order and by the names it has there."""

    step: Array
    a: Array
    b: Array
    du: Array
    dp: Array
    output: Array
    c: Array
    hp: Array
    predicted: Array
    filtered: Array
    y: Array
    valid: Any
    restart: Any
    input_variance: Array
    start: Array
    spread: Array
    sensor: Array
    tails: Any
    force: Array
    memory: float
    drift: float
    states: Any
    widths: Any
    outputs: Any


def arrange_pass(
    data: FilterData, lin: Linearized, noise: Noise, p: int, scale: Array
) -> PassArguments:
    """Return the arguments of a pass, with sensitivities to p parameters.

    Each of several outputs is divided by its scale, after which all noises are alike.
    """
    white, force = noise.sensor_is_white, np.asarray(noise.force, dtype=float)
    if not white:
        lin, force = append_sensor_noise(lin, force, noise)
    size, states = lin.step.shape
    output, c, hp, y, valid = lin.output, lin.c, lin.hp[..., :p], data.y, data.valid
    sensor = data.alike if white else np.zeros(size)
    if output.ndim == 1:
        output, c, hp, y, valid, sensor = (v[:, None] for v in (output, c, hp, y, valid, sensor))
    else:
        output, c, hp, y = output / scale, c / scale[:, None], hp / scale[:, None], y / scale
    check_budget(size * output.shape[1] + BESIDE_A_PASS)
    return PassArguments(
        lin.step, lin.a, lin.b, lin.du, np.ascontiguousarray(lin.dp[:, :, :p]), output, c,
        np.ascontiguousarray(hp), lin.trajectory.predicted, lin.trajectory.filtered, y, valid,
        data.restart, lin.input_variance, lin.start, lin.spread, sensor, _list_tails(noise.tails),
        force, noise.memory, noise.drift,
        *choose_sizes(states, states + bool(noise.drift > 0), output.shape[1], size),
    )  # fmt: skip


def _list_tails(tails: Tails | JointTails | None) -> Array:
    """Return the heavy tails as the compiled filter takes them."""
    return np.array([GAUSSIAN]) if tails is None else tails.numbers


def append_sensor_noise(lin: Linearized, force: Array, noise: Noise) -> tuple[Linearized, Array]:
    """Return the plant with the sensor noise as further states, and the variances that drive it."""
    move, drive, start = make_sensor_states(noise.ar, noise.ma)
    n, channels = lin.step.shape[1], lin.b.shape[2]
    longer = _make_room(lin, len(move))
    a, b, spread = longer.a.copy(), longer.b.copy(), longer.spread.copy()
    a[:, n:, n:], spread[n:, n:] = move, start
    # Of two opposite drives with half the variance each, the coloured force moves neither.
    b[:, n:, channels], b[:, n:, channels + 1] = drive, -drive
    return replace(longer, a=a, b=b, spread=spread), np.append(force, [0.5, 0.5])


@lru_cache(maxsize=8)
def _make_room(lin: Linearized, r: int) -> Linearized:
    """Return the plant with r states more that nothing moves yet, the first of which is measured.

    A search for the noise filters the same plant many times, so that the last ones are kept.
    """

    def pad(array: Array, *widths: int) -> Array:
        return np.pad(array, [(0, 0), *((0, w) for w in widths)])

    c = pad(lin.c, r)
    c[:, lin.c.shape[1]] = 1.0
    at = Trajectory(*(pad(v, r) for v in (lin.trajectory.predicted, lin.trajectory.filtered,
                                          lin.trajectory.spread)))  # fmt: skip
    return replace(
        lin, step=pad(lin.step, r), a=pad(lin.a, r, r), b=pad(lin.b, r, 2), du=pad(lin.du, r),
        dp=pad(lin.dp, r, 0), c=c, start=np.pad(lin.start, (0, r)),
        spread=np.pad(lin.spread, (0, r)), trajectory=at,
    )  # fmt: skip


@lru_cache(maxsize=64)
def make_sensor_states(ar: tuple[float, ...], ma: tuple[float, ...]) -> tuple[Array, Array, Array]:
    r"""Return coloured sensor noise of variance one as states, the first of which is the noise.

    .. math:: \alpha_{k+1} = T \alpha_k + R w_{k+1}, \quad P = T P T^T + R R^T, \quad P_{11} = 1

    Returns
    -------
    move, drive, start : ndarray, shapes (r, r), (r,), (r, r)
        The matrix T, the drive R and the stationary covariance P, with r = max(p, q + 1).

    References
    ----------
    Harvey, *Forecasting, Structural Time Series Models and the Kalman Filter* (1989), section 3.3.
    """
    r = max(len(ar), len(ma) + 1)
    move, drive = np.eye(r, k=1), np.zeros(r)
    move[: len(ar), 0] = ar
    drive[: len(ma) + 1] = 1.0, *ma
    start = linalg.solve_discrete_lyapunov(move, np.outer(drive, drive))
    size = max(float(start[0, 0]), 1e-300)
    return move, np.asarray(drive / np.sqrt(size)), np.asarray(0.5 * (start + start.T) / size)


def compute_memory(noise: Noise, samples: int) -> float:
    r"""Return how many successive samples of the sensor noise tell its variance like one.

    .. math:: 1 + 2 \sum_{\tau \ge 1} \rho(\tau)^2

    over so many samples, with its autocorrelation :math:`\rho`.
    """
    impulse = np.zeros(samples)
    impulse[0] = 1.0
    response = signal.lfilter([1.0, *noise.ma], [1.0, *(-v for v in noise.ar)], impulse)
    products = compute_lagged_products(response, response, samples - 1)
    return float(1 + 2 * np.sum((products[1:] / products[0]) ** 2))


def choose_settled_samples(data: FilterData, out: Filtered) -> Any:
    """Return the usable samples whose prediction does not depend on the start."""
    if data.valid.ndim == 2:
        columns = [
            choose_settled_samples(
                replace(data, valid=data.valid[:, k], counted=data.counted[:, k]),
                replace(out, variance=out.variance[:, k]),
            )
            for k in range(data.valid.shape[1])
        ]
        return np.column_stack(columns)
    known = data.valid & np.isfinite(out.variance)
    return (
        known
        & data.usable
        & (out.variance <= INITIAL_VARIANCE_RATIO * np.median(out.variance[known]))
    )


def guess_trajectory(plant: SampledPlant, data: FilterData) -> Trajectory:
    """Return a trajectory to begin with: at rest, states that are measured as measured."""
    n, e = len(data.record), plant.e
    start, wide = plant.extend_start(data, data.start, data.spread, e.values)
    rest = np.tile(start, (n, 1))
    for row, column in zip(casadi.vertsplit(e.output), np.reshape(data.y, (n, -1)).T, strict=True):
        seen, values = row, column
        # The state of a sensor's lag is nearly equal to what it follows.
        for _ in range(1 + len(e.lags)):
            columns = casadi.jacobian(seen, e.x).sparsity().get_col()
            if len(columns) != 1 or casadi.depends_on(seen, casadi.vertcat(e.t, e.u)):
                break
            j = columns[0]
            rest[:, j] = values = _invert_sensor(plant, seen, e.x[j], float(rest[0, j]), values)
            behind = [lag.target for lag in e.lags if lag.state == j]
            if not behind:
                break
            seen = behind[0]
    for lag in e.lags:
        for k, u in enumerate(np.reshape(data.u, (n, -1)).T):
            if casadi.is_equal(lag.target, e.u[k], 2):
                rest[:, lag.state] = u
    quiet = np.minimum(np.sqrt(np.diag(wide)), 1.0) * data.scale
    return Trajectory(rest, rest.copy(), np.tile(quiet, (n, 1)))


def _invert_sensor(plant: SampledPlant, seen: Any, x: Any, at: float, values: Array) -> Array:
    """Return the state x at which the output has given values, by Newton's method; else rest."""
    if casadi.is_equal(seen, x, 2):
        return values
    f = BlockEvaluation(casadi.Function("seen", [x, plant.e.p], [seen, casadi.jacobian(seen, x)]))
    found = np.full(len(values), at)
    first = np.abs(f(found, plant.e.values)[0].ravel() - values)
    with np.errstate(all="ignore"):
        for _ in range(NEWTON):
            output, slope = (part.ravel() for part in f(found, plant.e.values))
            found = found + (values - output) / slope
        left = np.abs(f(found, plant.e.values)[0].ravel() - values)
    # A comparison with NaN is false, so that failed samples keep the state at rest.
    return np.where(left <= first, found, at)


def carry_trajectory(
    old: SampledPlant, new: SampledPlant, known: Trajectory, guess: Trajectory
) -> Trajectory:
    """Take states that both have from the old trajectory, and guess the others."""
    mine = list(new.e.states)
    columns = [(mine.index(s), k) for k, s in enumerate(old.e.states) if s in mine]
    # A delay keeps a known analog controller from being followed, so both plants need its states,
    # and only one that has a backlash remembers where that began.
    if new.size - new.n == old.size - old.n and (new.e.memory is None) == (old.e.memory is None):
        columns += [(new.n + k, old.n + k) for k in range(old.size - old.n)]
    result = []
    for start, theirs in ((guess.predicted, known.predicted), (guess.filtered, known.filtered),
                         (guess.spread, known.spread)):  # fmt: skip
        mixed = start.copy()
        for i, k in columns:
            mixed[:, i] = theirs[:, k]
        result.append(mixed)
    return Trajectory(*result)


def converge_trajectory(
    plant: SampledPlant,
    data: FilterData,
    theta: Array,
    noise: Noise,
    at: Trajectory,
    passes: int = PASSES,
) -> tuple[Linearized, Filtered]:
    """Linearize and filter in turn until the trajectory has converged.

    Raises
    ------
    CtrlidError
        If the filter cannot follow the record with this model.
    """
    for count in range(passes):
        at, lin = linearize_inside_domain(plant, data, theta, at)
        out = run_filter(plant, data, lin, noise, sensitive=False)
        change = np.abs(out.trajectory.filtered - at.filtered)
        if not np.isfinite(out.innovations).all() or not np.isfinite(change).all():
            lost = ~np.isfinite(out.innovations).reshape(len(change), -1).all(axis=1)
            k = int(np.argmax(lost))
            raise ModelCannotRun(
                f"the Kalman filter of {plant.e.name} diverges at sample {k} "
                f"(t = {data.record.t[k]:.4g} s): the model contradicts the record there. Check "
                "units, signs and the operating point, or exclude these samples with valid="
            )
        size = np.maximum(np.std(out.trajectory.filtered, axis=0), 1e-300)
        if plant.e.memory is not None:
            # Where a backlash began does not move, but is part of the input that does.
            size[-1] = max(size[-1], float(np.std(data.u)))
        still = bool((np.sqrt(np.mean(change**2, axis=0)) <= CONVERGED_MOTION * size).all())
        at = out.trajectory
        if still and count:
            break
    return lin, out


def linearize_inside_domain(
    plant: SampledPlant, data: FilterData, theta: Array, at: Trajectory
) -> tuple[Trajectory, Linearized]:
    """Linearize; samples at which the plant is not defined are set to the state at rest.

    A level that nothing measures may be estimated below zero, where no root of it is defined.
    """
    bad = _find_bad_samples(at.filtered, at.predicted)
    if bad is None:
        lin = plant.linearize(data, theta, at)
        bad = _find_bad_samples(lin.step, lin.a, lin.output, lin.c)
        if bad is None:
            return at, lin
    rest = guess_trajectory(plant, data)
    at = Trajectory(*(np.where(bad[:, None], old, new) for new, old in (
        (at.predicted, rest.predicted), (at.filtered, rest.filtered),
        (at.spread, rest.spread))))  # fmt: skip
    return at, plant.linearize(data, theta, at)


def _find_bad_samples(*arrays: Array) -> Any:
    """Return at which samples numbers are not finite; None where all of them are, as mostly."""
    # A whole array is asked many times faster than each of its rows.
    if all(np.isfinite(array).all() for array in arrays):
        return None
    return ~np.all([np.isfinite(v.reshape(len(v), -1)).all(axis=1) for v in arrays], axis=0)
