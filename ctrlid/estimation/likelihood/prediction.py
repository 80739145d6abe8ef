"""Predicting a record from its own past: an extended Kalman filter on the plant's equations.

The filter needs u and y only. It never simulates an unstable plant open loop: every sample pulls
the state back, so it works on plants that no open-loop simulation survives.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..._base.arguments import explain_names, is_number, point_at_part
from ..._base.arrays import Array, freeze_arrays
from ..._base.errors import CtrlidError, ModelCannotRun
from ..._base.interruption import hold_interrupt
from ..._base.rounding import keep_numpy_quiet
from ..._base.text import Printed, write_count, write_noises
from ...data.record import Record
from ...data.several_records import order_model_and_data
from ...data.validity import find_whole_past
from ...loop.loop import Loop
from .filter_data import find_noise_units, has_several_noises, name_noise_places
from .kalman_filter import Noise, append_sensor_noise, predict_outputs
from .likelihood import Fit, make_problem
from .maximization import begin_fit, maximize
from .sampled_plant import Linearized

# The covariance of the filter has converged after so many horizons.
LEAD = 4
# The spread is averaged over about so many predictions, evenly over the record.
STARTS = 300
# The filter of several outputs starts from at most this variance, relative to the sensor noise's.
WIDE = 1e8


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Printed):
    """One-step predictions of a record.

    Parameters
    ----------
    y : ndarray, shape (n,) or (outputs, n)
        Prediction of each output sample from the samples before it [output unit].
    innovations : ndarray, shape (n,) or (outputs, n)
        Measured minus predicted output [output unit], zero where the record is not valid.
    settled : ndarray of bool, shape (n,) or (outputs, n)
        Where the record is valid and the prediction no longer depends on the guess of the state
        at the start, or after a long stretch that does not count.
    spread : ndarray, shape (n,) or (outputs, n)
        Standard deviation of the innovations that the filter expects [output unit].
    states : ndarray, shape (n, states)
        State at each sample [units of the states], given the outputs up to and including it.
    circuit : ndarray, shape (n, controller states)
        State of a known analog controller at each sample [units of the controller]; behind a
        backlash, what is known at each sample of the input that acted when the record began [input
        unit]; else empty.
    sensor_noise, force_noise : float or tuple of float
        Standard deviations of the noise model [output unit, and unit of the acceleration]; one for
        each of several outputs and forces.
    units : (str, str)
        Units of both noises; empty where neither the record nor the plant has one.
    places : (tuple of str, tuple of str)
        Of several signals, the output of each sensor noise and the velocity that each force works
        on; without a moving mass, the state whose rate it is.
    """

    y: Array
    innovations: Array
    settled: Any
    spread: Array
    states: Array
    circuit: Array
    sensor_noise: Any
    force_noise: Any
    units: tuple[Any, Any] = ("", "")
    places: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def __str__(self) -> str:
        if self.y.ndim == 2:
            return self._write_several()
        (unit, push), (_, states) = self.units, self.places
        unit = f" {unit}" if unit else ""
        found = float(np.sqrt(np.mean(self.innovations[self.settled] ** 2)))
        expected = float(np.sqrt(np.mean(self.spread[self.settled] ** 2)))
        return (
            f"One-step prediction of {write_count(len(self.y), 'sample')}\n"
            f"  RMS of the innovations: {found:.3g}{unit}; the filter expects "
            f"{expected:.3g}{unit}\n"
            f"  standard deviation of the sensor noise: {self.sensor_noise:.3g}{unit}; of the "
            f"white force: {write_noises(self.force_noise, push, states, '/s')}"
        )

    def _write_several(self) -> str:
        (sensors, pushes), (outputs, velocities) = self.units, self.places
        rows = [
            f"One-step prediction of {write_count(self.y.shape[1], 'sample')} of "
            f"{write_count(len(self.y), 'output')}"
        ]
        for k, (name, noise) in enumerate(zip(outputs, self.sensor_noise, strict=True)):
            use, unit = self.settled[k], sensors[k] or f"[{name}]"
            found, expected = (
                float(np.sqrt(np.mean(v[k][use] ** 2))) for v in (self.innovations, self.spread)
            )
            rows.append(
                f"  {name}: RMS of the innovations {found:.3g} {unit}; the filter expects "
                f"{expected:.3g} {unit}, of which the sensor noise is {noise:.3g} {unit}"
            )
        forces = write_noises(self.force_noise, pushes, velocities, "/s")
        return "\n".join([*rows, f"  standard deviation of the white force: {forces}"])


@explain_names
@hold_interrupt()
@keep_numpy_quiet
def predict(loop: Loop, record: Record, noise_ratio: float | None = None) -> Prediction:
    r"""Predict each output sample of a record from the samples before it.

    .. math:: \hat y_k = h(\hat x_{k|k-1}), \quad
        \hat x_{k|k} = \hat x_{k|k-1} + K_k (y_k - \hat y_k)

    An extended Kalman filter on the plant's equations, driven by the measured input. Only the ratio
    of force noise to sensor noise matters for the prediction; it is chosen by maximum
    likelihood unless given.

    Parameters
    ----------
    loop : Loop
        The model; its controller is not used.
    record : Record
        The data.
    noise_ratio : float, optional
        Ratio of force noise to sensor noise, as standard deviations [1/s^2]; in `simulate` and in
        the result, force_noise is the acceleration itself.

    Returns
    -------
    Prediction
        Predictions, innovations and filtered states.

    Raises
    ------
    CtrlidError
        If the sampling periods differ, too few samples are valid, or the filter loses the record.

    References
    ----------
    Anderson and Moore, *Optimal Filtering*, chapter 8.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    >>> loop = cid.Loop(plant, 5.0, dt=0.01)
    >>> r = cid.random_binary(500, amplitude=0.1, hold=50, seed=1)
    >>> record = cid.simulate(loop, r, sensor_noise=1e-3, seed=2)
    >>> bool(cid.predict(loop, record).innovations.std() < 1.3e-3)
    True
    """
    loop, record = order_model_and_data(loop, record)
    if not (isinstance(loop, Loop) and isinstance(record, Record)):
        raise CtrlidError("predict needs a Loop and a Record; given "
                          f"{type(loop).__name__} and {type(record).__name__}"
                          f"{point_at_part(loop, Loop)}")  # fmt: skip
    if noise_ratio is not None and not (is_number(noise_ratio) and 0 <= noise_ratio < 1e150):
        raise CtrlidError("noise_ratio is the ratio of force noise to sensor noise [1/s^2], >= 0; "
                          f"given {noise_ratio!r}")  # fmt: skip
    if noise_ratio is not None and not loop.equations().siso:
        raise CtrlidError("noise_ratio= is one ratio of one force to one sensor noise; for several "
                          f"outputs ({', '.join(loop.signals['y'])}) leave it out: all are "
                          "estimated")  # fmt: skip
    return predict_from(loop, record, 0.0, noise_ratio)


def predict_from(
    loop: Loop, record: Record, start_time: float, noise_ratio: float | None = None
) -> Prediction:
    """Predict a part of a record, of which the first sample is at a time [s] of the whole one.

    What acts at a time of its own, such as a line or a drift, goes by that time.
    """
    problem = make_problem(_drop_neutral_effects(loop), (), [record], [start_time])
    if noise_ratio is None:
        return make_prediction(maximize(begin_fit(problem)))
    noise = Noise((max(noise_ratio, 1e-150) ** 2,) * problem.plant.channels)
    return make_prediction(begin_fit(problem, noise=noise))


def make_prediction(fit: Fit) -> Prediction:
    """Return the one-step predictions of the only record of a fit."""
    plant, record = fit.plant, fit.data[0].record
    out, sensor = fit.filtered[0], float(np.sqrt(fit.sensor[0]))
    if not np.isfinite(out.innovations).all():
        raise ModelCannotRun(
            f"the Kalman filter of {plant.e.name} loses the record: the model contradicts it. "
            "Check units, signs and the operating point, or exclude samples with valid="
        )
    states = out.trajectory.filtered
    units = find_noise_units(plant.loop, record)
    if record.y.ndim == 2:
        error, variance = predict_outputs(fit.data[0], fit.linearized[0], fit.noise)
        sizes = sensor * np.sqrt(fit.noise.ratios)
        return Prediction(
            record.y - error.T, error.T, fit.counts[0].T, sensor * np.sqrt(variance.T),
            states[:, : plant.n], states[:, plant.n :], tuple(sizes.tolist()),
            tuple((sensor * np.sqrt(fit.noise.force)).tolist()), units,
            name_noise_places(plant.loop),
        )  # fmt: skip
    error, variance, counts = (
        np.reshape(v, record.y.shape) for v in (out.innovations, out.variance, fit.counts[0])
    )
    forces = (sensor * np.sqrt(fit.noise.force)).tolist()
    several = has_several_noises(plant.e)
    return Prediction(
        record.y - error, error, counts,
        sensor * np.sqrt(variance), states[:, : plant.n], states[:, plant.n :], sensor,
        tuple(forces) if several else forces[0], units,
        name_noise_places(plant.loop) if several else ((), ()),
    )  # fmt: skip


def _drop_neutral_effects(loop: Loop) -> Loop:
    """Return a loop without effects that do nothing: a lag of zero, say, is no lag.

    The filter keeps their states for a fit that asks which way they go; a prediction needs none,
    and nothing is free in it.
    """
    return replace(loop, effects=tuple(e for e in loop.effects if not e.neutral), free=())


def predict_ahead(
    loop: Loop, record: Record, prediction: Prediction, horizon: int, start_time: float = 0.0
) -> tuple[Any, Array]:
    """Predict several samples ahead from the filtered states and the measured input.

    Parameters
    ----------
    loop : Loop
        The model.
    record : Record
        The data.
    prediction : Prediction
        What `predict` returned for them.
    horizon : int
        Number of samples to look ahead.
    start_time : float, optional
        Time of the first sample since the start of the whole record [s].

    Returns
    -------
    index : ndarray of int
        Samples that are predicted.
    y : ndarray
        Their predictions; of several outputs, a column for each.
    """
    # A slow sensor may have no reading at any of the samples in between.
    whole = np.array_equal(record.valid_samples, record.valid_somewhere)
    every = max(1, horizon // 4) if whole else 1
    starts = np.arange(0, len(record) - horizon, every)
    known = np.asarray(find_whole_past(record.valid_somewhere, horizon))[starts + horizon]
    seen = np.atleast_2d(prediction.settled)
    # Of several outputs each has to have been read before, and one now.
    read = np.asarray(np.maximum.accumulate(seen, axis=1).all(axis=0) & seen.any(axis=0))
    known &= read[starts]
    starts = starts[known]
    if not len(starts):
        return starts, np.empty(0)
    problem = make_problem(_drop_neutral_effects(loop), (), [record], [start_time])
    plant, data = problem.plant, problem.data[0]
    x = np.hstack([prediction.states, prediction.circuit])[starts]
    for j in range(horizon):
        # The outputs after the start are not known to the prediction.
        x = plant.advance(data, x, starts + j, known=j == 0)
    k = starts + horizon
    return k, plant.evaluate_output(data, x, k)


def predict_spread(
    loop: Loop, record: Record, prediction: Prediction, horizon: int, start_time: float = 0.0
) -> tuple[Any, Any]:
    r"""Return the standard deviation that noise gives predictions several samples ahead.

    .. math:: P_{k+1} = A_k P_k A_k^T + Q, \quad \sigma^2 = h P_{k+j} h^T + R

    from the covariance P of the filtered states, with the plant linearized along the record, and
    averaged over it. Dry friction, which holds still what rests, damps nothing that moves: at one
    operating point there is no such average.

    Parameters
    ----------
    loop : Loop
        The model.
    record : Record
        The data.
    prediction : Prediction
        What `predict` returned.
    horizon : int
        Number of samples ahead.
    start_time : float, optional
        Time of the first sample since the start of the whole record [s].

    Returns
    -------
    both, sensor : float
        Standard deviations by all noise, and by the sensor's alone [output unit]; NaN where no
        stretch is long enough. Of several outputs arrays of them.
    """
    plain = replace(_drop_neutral_effects(loop), controller=None)
    if not loop.equations().siso:
        return _predict_several_spreads(plain, record, prediction, horizon, start_time)
    r = prediction.sensor_noise**2
    problem = make_problem(plain, (), [record], [start_time])
    sizes = np.resize(np.asarray(prediction.force_noise, dtype=float), problem.plant.channels)
    forces = np.square(sizes) / r if r else np.zeros(len(sizes))
    noise = Noise(tuple(np.maximum(forces, 1e-300).tolist()) if r else (1.0,) * len(sizes))
    lin = begin_fit(problem, noise=noise).linearized[0]
    both, sensor = (
        compute_spread_ahead(lin, Noise(tuple(v.tolist())), record.valid, horizon)
        for v in (forces, 0 * forces)
    )
    return math.sqrt(r) * both, math.sqrt(r) * sensor


def _predict_several_spreads(
    loop: Loop, record: Record, prediction: Prediction, horizon: int, start_time: float
) -> tuple[Array, Array]:
    """Return what `predict_spread` does, for each of several outputs."""
    problem = make_problem(loop, (), [record], [start_time])
    sensor = np.maximum(np.ravel(np.asarray(prediction.sensor_noise, dtype=float)), 1e-150)
    force = np.ravel(np.asarray(prediction.force_noise, dtype=float))
    sensors = tuple(((sensor[1:] / sensor[0]) ** 2).tolist())
    forces = tuple(np.maximum((force / sensor[0]) ** 2, 1e-300).tolist())
    lin = begin_fit(problem, noise=Noise(forces, sensors=sensors)).linearized[0]
    quiet = tuple(0.0 for _ in forces)
    valid = problem.data[0].record.valid_somewhere
    both, alone = (
        sensor[0] * compute_spreads_ahead(lin, Noise(v, sensors=sensors), valid, horizon)
        for v in (forces, quiet)
    )
    return (both, alone) if record.y.ndim == 2 else (both[0], alone[0])


def compute_spreads_ahead(lin: Linearized, noise: Noise, valid: Any, horizon: int) -> Array:
    r"""Return the root mean square error that noise gives predictions of each of several outputs.

    .. math:: \sigma_i^2 = h_i P h_i^T + R_i

    as in `compute_spread_ahead`; of several outputs with white noise.

    Parameters
    ----------
    lin : Linearized
        The plant along a record.
    noise : Noise
        The noise.
    valid : ndarray of bool
        Samples of the record that are valid.
    horizon : int
        Number of samples ahead.

    Returns
    -------
    ndarray, shape (outputs,)
        Errors in standard deviations of the first sensor's noise; NaN where no stretch is long
        enough.
    """
    if lin.output.ndim == 1:
        return np.array([compute_spread_ahead(lin, noise, valid, horizon)])
    q, r = lin.output.shape[1], noise.ratios
    starts, lead = _choose_starts(valid, horizon)
    if not len(starts):
        return np.full(q, math.nan)
    force = np.asarray(noise.force)
    # A start that is known hardly at all would be lost to rounding.
    wide = np.diag(np.minimum(np.diag(lin.spread), WIDE))
    p = np.broadcast_to(wide, (len(starts), *wide.shape))
    for j in range(lead + horizon):
        k = starts + j
        for i in range(q if j <= lead else 0):
            h = lin.c[k, i][:, None, :]
            seen = p @ h.transpose(0, 2, 1)
            p = p - seen @ seen.transpose(0, 2, 1) / np.maximum(h @ seen + r[i], 1e-300)
        a, b = lin.a[k], lin.b[k][:, :, : len(force)]
        p = a @ p @ a.transpose(0, 2, 1) + (b * force) @ b.transpose(0, 2, 1)
    h = lin.c[starts + lead + horizon]
    # What grows beyond all numbers has no spread.
    with np.errstate(all="ignore"):
        variance = np.mean(np.einsum("sqi,sij,sqj->sq", h, p, h), axis=0)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0) + r))


def _choose_starts(valid: Any, horizon: int) -> tuple[Any, int]:
    """Return where a spread is followed from, and so many samples until the filter has settled."""
    size, lead = len(valid), int(np.clip(LEAD * horizon, 50, 500))
    starts = np.arange(0, size - lead - horizon, max(1, size // STARTS))
    return starts[find_whole_past(valid, lead + horizon)[starts + lead + horizon]], lead


def compute_spread_ahead(lin: Linearized, noise: Noise, valid: Any, horizon: int) -> float:
    r"""Return the root mean square error that noise gives predictions of the true output.

    .. math:: \sigma^2 = h P h^T + R + \operatorname{var} \hat n

    from the covariance P of the filtered states, carried over so many samples. What of coloured
    sensor noise n is foreseen, :math:`\hat n`, is not in a prediction of the true output.

    Parameters
    ----------
    lin : Linearized
        The plant along a record.
    noise : Noise
        The noise, coloured or white; a coloured force has no part in it.
    valid : ndarray of bool
        Samples of the record that are valid.
    horizon : int
        Number of samples ahead.

    Returns
    -------
    float
        The error in standard deviations of the sensor noise; NaN where no stretch is long enough.
    """
    force, r, n = np.asarray(noise.force), 1.0, lin.a.shape[1]
    p = np.eye(n)
    if not noise.sensor_is_white:
        # Such noise is a state that is measured exactly.
        r = 0.0
        lin, force = append_sensor_noise(lin, force, noise)
        p = np.array(lin.spread)
        p[:n, :n] = np.eye(n)
    starts, lead = _choose_starts(valid, horizon)
    if not len(starts):
        return math.nan
    p = np.broadcast_to(p, (len(starts), *p.shape))
    for j in range(lead + horizon):
        k = starts + j
        if j <= lead:
            h = lin.c[k][:, None, :]
            seen = p @ h.transpose(0, 2, 1)
            p = p - seen @ seen.transpose(0, 2, 1) / np.maximum(h @ seen + r, 1e-300)
        a, b = lin.a[k], lin.b[k]
        p = a @ p @ a.transpose(0, 2, 1) + (b * force) @ b.transpose(0, 2, 1)
    h = lin.c[starts + lead + horizon][:, None, :]
    foreseen = 0.0 if noise.sensor_is_white else 1 - float(np.mean(p[:, n, n]))
    return math.sqrt(float(np.mean(h @ p @ h.transpose(0, 2, 1))) + r + foreseen)
