"""Predicting a record from its own past: an extended Kalman filter on the plant's equations.

The filter needs u and y only. It never simulates an unstable plant open loop: every sample pulls
the state back, so it works on plants that no open-loop simulation survives.
"""

from dataclasses import dataclass, replace
from typing import Any

import casadi
import numpy as np
from scipy import optimize

from .data import Record
from .errors import CtrlidError
from .linearization import state_matrices
from .loop import Loop
from .physics import Array
from .stepping import integrate

TUNING_SAMPLES = 4000  # enough to choose the ratio of force noise to sensor noise
FEWEST = 10  # valid samples, to say anything
BRIDGE = 20  # samples that do not count and are bridged by the model; then it starts afresh
SETTLED = 4.0  # times the usual variance: above, the start still dominates the prediction


@dataclass(frozen=True, eq=False)
class Prediction:
    """One-step predictions of a record.

    Parameters
    ----------
    y : ndarray, shape (n,)
        Prediction of each output sample from the samples before it [output unit].
    innovations : ndarray, shape (n,)
        Measured minus predicted output, zero where the record is not valid.
    settled : ndarray of bool, shape (n,)
        Where the record is valid and the prediction no longer depends on the guess of the state
        at the start, or after a long stretch that does not count.
    spread : ndarray, shape (n,)
        Standard deviation of the innovations that the filter expects.
    states : ndarray, shape (n, states)
        State at each sample, given the outputs up to and including it.
    circuit : ndarray, shape (n, controller states)
        State of a known analog controller at each sample, else empty.
    sensor_noise, force_noise : float
        Standard deviations of the noise model.
    """

    y: Array
    innovations: Array
    settled: Any
    spread: Array
    states: Array
    circuit: Array
    sensor_noise: float
    force_noise: float


def _plant_step(loop: Loop, record: Record | None) -> Any:
    """Return the CasADi function ``(x, xc, w, force) -> (next x, next xc)`` over one period.

    ``w`` is ``(t, u, next u, r, y)``. Between the samples u is held or straight, as the record
    says. Under a known analog controller it moves as the circuit does, from the measured value on:
    a straight line would miss the jump at each step of the reference. ``xc`` is the state of
    that circuit, empty otherwise.
    """
    e = loop.equations()
    law = loop.law() if record is not None and record.r is not None and loop.analog else None
    n, nc = len(e.states), len(law.rest) if law else 0
    x, xc, w, force = (casadi.SX.sym(s, k) for s, k in (("x", n), ("c", nc), ("w", 5), ("f", 1)))
    t, u, ahead, r, y = casadi.vertsplit(w)
    kick = casadi.SX.zeros(n, 1)
    for j in e.velocities or range(n):
        kick[j] = force

    def plant(tau: Any, x: Any, u: Any) -> tuple[Any, Any]:
        rhs, output = e.function(t + tau, x, u, e.values)
        return rhs + kick, output

    if e.dt:
        return casadi.Function("plant_step", [x, xc, w, force], [plant(0.0, x, u)[0], xc])
    if law is None:
        ramp = (ahead - u) / loop.dt if record is not None and record.hold == "foh" else 0.0
        after = integrate(lambda tau, z: plant(tau, z, u + ramp * tau)[0], x, loop.dt, 1)[0]
        return casadi.Function("plant_step", [x, xc, w, force], [after, xc])
    noise = y - plant(0.0, x, u)[1]
    offset = u - law.apply(t, xc, r, y)[0]  # bias, injected signals, what xc does not know

    def rate(tau: Any, z: Any) -> Any:
        seen = plant(tau, z[:n], u)[1] + noise
        computed, slope = law.apply(t + tau, z[n:], r, seen)
        return casadi.vertcat(plant(tau, z[:n], computed + offset)[0], slope)

    after = integrate(rate, casadi.vertcat(x, xc), loop.dt, 2)[0]
    return casadi.Function("plant_step", [x, xc, w, force], [after[:n], after[n:]])


def _filter_step(loop: Loop, plant_step: Any) -> Any:
    """Build one sample of the filter with sensor noise of variance one.

    The state is x stacked on the columns of P and on the circuit's state, twice: as it is and as
    it is at a start. The inputs are those of the plant step, `valid`, `afresh`, the variance of u
    where it is not known, and q, that of the force; variances are relative to that of the sensor.
    """
    e = loop.equations()
    n, nc = len(e.states), plant_step.size1_in(1)
    size = n + n * n + nc
    both, v = casadi.SX.sym("z", 2 * size), casadi.SX.sym("v", 9)
    w, valid, afresh, doubt, q = v[:5], v[5], v[6], v[7], v[8]
    z = casadi.if_else(afresh, both[size:], both[:size])
    x, p, xc = z[:n], casadi.reshape(z[n : n + n * n], n, n), z[n + n * n :]
    point = casadi.SX.sym("x", n)
    height = e.function(w[0], point, w[1], e.values)[1]
    sensor = casadi.Function("sensor", [point, w], [height, casadi.jacobian(height, point)])
    expected, h = sensor(x, w)
    s = casadi.mtimes([h, p, h.T]) + 1.0
    gain = casadi.if_else(valid, casadi.mtimes(p, h.T) / s, 0)
    innovation = casadi.if_else(valid, w[4] - expected, 0)
    x = x + gain * innovation
    keep = casadi.SX.eye(n) - casadi.mtimes(gain, h)
    p = casadi.mtimes([keep, p, keep.T]) + casadi.mtimes(gain, gain.T)  # Joseph: stays positive
    state, circuit, force = casadi.SX.sym("s", n), casadi.SX.sym("k", nc), casadi.SX.sym("f")
    after = plant_step(state, circuit, w, force)[0]
    slopes = casadi.Function("j", [state, circuit, w, force], [
        casadi.jacobian(after, state), casadi.jacobian(after, force),
        casadi.jacobian(after, w[1:3]),
    ])  # fmt: skip
    a, b, c = slopes(x, xc, w, 0.0)
    p_after = casadi.mtimes([a, p, a.T]) + q * casadi.mtimes(b, b.T)
    p_after = p_after + doubt * casadi.mtimes(c, c.T)
    p_after = (p_after + p_after.T) / 2
    x_after, xc_after = plant_step(x, xc, w, 0.0)
    after = casadi.vertcat(x_after, casadi.reshape(p_after, n * n, 1), xc_after, both[size:])
    return casadi.Function("filter", [both, v], [after, expected, innovation, s, x, xc])


def _signals(record: Record) -> Array:
    """Return the rows (t, u, next u, r, y) of a record, the last value where it is not valid."""
    last = np.maximum.accumulate(np.where(record.valid, np.arange(len(record)), 0))
    y = np.asarray(record.y)[last]
    u = np.asarray(record.u)[last]
    r = y if record.r is None else np.asarray(record.r)[last]
    return np.vstack([record.t - record.start, u, np.append(u[1:], u[-1]), r, y])


def predict(loop: Loop, record: Record, force_noise: float | None = None) -> Prediction:
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
    force_noise : float, optional
        Ratio of force noise to sensor noise, as standard deviations [1/s^2].

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
    if abs(loop.dt - record.dt) > 1e-9 * loop.dt:
        raise CtrlidError(f"the loop is sampled at {loop.dt:g} s, the record at {record.dt:g} s; "
                          "give both the same period")  # fmt: skip
    valid = np.asarray(record.valid)
    if np.count_nonzero(valid) < FEWEST:
        raise CtrlidError(f"a prediction needs at least {FEWEST} valid samples; the record has "
                          f"{np.count_nonzero(valid)} of {len(record)}")  # fmt: skip
    if force_noise is not None and not (np.isfinite(force_noise) and force_noise >= 0):
        raise CtrlidError(f"force_noise is a ratio >= 0; given {force_noise!r}")
    plant_step = _plant_step(loop, record)
    step = _filter_step(loop, plant_step)
    state, noise = _start(loop, record)
    start = np.concatenate([state, np.zeros(plant_step.size1_in(1))])
    z = np.concatenate([start, start])
    afresh = _fresh_starts(loop, record)
    doubt = np.where(valid, 0.0, (np.std(record.u[valid]) / noise) ** 2)
    w = np.vstack([_signals(record), valid, afresh, doubt, np.zeros(len(record))])
    ratio = _tune(step, z, w) if force_noise is None else float(force_noise)
    w[-1] = ratio**2
    with np.errstate(all="ignore"):
        out = [np.asarray(m, float) for m in step.mapaccum("pass", w.shape[1])(z, w)]
    y, innovations, s = (row[0] for row in out[1:4])
    if not np.isfinite(innovations).all():
        k = int(np.argmin(np.isfinite(innovations)))
        raise CtrlidError(
            f"the predictor of {loop.equations().name} lost the record at sample {k} "
            f"(t = {record.t[k]:.4g} s): the model cannot follow these data there; check units, "
            "signs and the operating point, or mark the stretch as not valid"
        )
    known = valid & np.isfinite(s)
    settled = known & ~afresh & (s <= SETTLED * np.median(s[known]))
    sensor = float(np.sqrt(np.mean(innovations[settled] ** 2 / s[settled])))
    return Prediction(y, innovations, settled, sensor * np.sqrt(s), out[4].T, out[5].T, sensor,
                      sensor * ratio)  # fmt: skip


def _fresh_starts(loop: Loop, record: Record) -> Any:
    """Return at which samples the filter begins anew: at the start and in long gaps."""
    e = loop.equations()
    poles = np.linalg.eigvals(state_matrices(e, loop.point)[0])
    fastest = np.max(np.abs(poles) if e.dt else np.exp(poles.real * loop.dt), initial=0.0)
    # An unstable model may bridge as long as its errors grow by less than half.
    bridge = BRIDGE if fastest <= 1 else min(BRIDGE, int(np.log(1.5) / np.log(fastest)))
    afresh = np.zeros(len(record), dtype=bool)
    last = -BRIDGE - 1
    for first, stop in record.segments():
        if first - last > bridge:
            afresh[max(last, 0) : first + 1] = True
        last = stop
    if len(record) - last > bridge:
        afresh[last:] = True
    return afresh


def _start(loop: Loop, record: Record) -> tuple[Array, float]:
    """Return a state at the operating point that the first samples may overrule.

    And the size of the sensor noise, roughly.
    """
    e, at = loop.equations(), loop.point
    y = record.y[record.valid]
    reach = float(np.std(y)) + abs(float(np.mean(y)) - at.output)
    # Third differences leave little of a smooth output.
    noise = float(np.std(np.diff(y, 3))) / np.sqrt(20)
    noise = max(noise, 1e-9 * max(abs(at.output), reach), 1e-300)
    speed = max(float(np.std(np.diff(y))) / record.dt, noise / record.dt)
    wide = [max(0.1 * abs(v), reach, noise) for v in at.states]
    for j in e.velocities:
        wide[j] = speed
    # Variances are relative to that of the sensor noise.
    return np.concatenate([at.states, np.diag((np.array(wide) / noise) ** 2).ravel()]), noise


def _tune(step: Any, z: Array, w: Array) -> float:
    """Return the ratio of force to sensor noise that makes the innovations most likely."""
    first = int(np.argmax(w[5] > 0))
    w = w[:, first : first + TUNING_SAMPLES].copy()
    runner = step.mapaccum("tune", w.shape[1])
    known = np.flatnonzero(w[5] > 0)
    # The start-up tells about the initial state, not about the noise.
    known = known[min(20, len(known) // 2) :]
    period = w[0, 1] - w[0, 0]

    def cost(log_ratio: float) -> float:
        w[-1] = 10.0 ** (2 * log_ratio)
        with np.errstate(all="ignore"):
            e, s = (np.asarray(m, float)[0][known] for m in runner(z, w)[2:4])
        usual = s <= SETTLED * np.median(s)
        e, s = e[usual], s[usual]
        if not e.size or not np.isfinite(e).all():
            return 1e12
        return float(np.log(max(np.mean(e**2 / s), 1e-300)) + np.mean(np.log(s)))

    scale = -2 * np.log10(period)
    grid = scale + np.arange(-5.0, 2.0)
    costs = [cost(g) for g in grid]
    best = grid[int(np.argmin(costs))]
    fine = optimize.minimize_scalar(
        cost, bounds=(best - 1, best + 1), method="bounded", options={"xatol": 0.02}
    )
    return float(10.0**fine.x)


def predict_ahead(
    loop: Loop, record: Record, prediction: Prediction, horizon: int
) -> tuple[Any, Array]:  # fmt: skip
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

    Returns
    -------
    index : ndarray of int
        Samples that are predicted.
    y : ndarray
        Their predictions.
    """
    every = max(1, horizon // 4)
    starts = np.arange(0, len(record) - horizon, every)
    bad = np.concatenate([[0], np.cumsum(~record.valid)])
    starts = starts[(bad[starts + horizon + 1] == bad[starts]) & prediction.settled[starts]]
    if not len(starts):
        return starts, np.empty(0)
    e = loop.equations()
    x, xc = prediction.states[starts].T, prediction.circuit[starts].T
    plant_step = _plant_step(loop, record).map(len(starts))
    output = e.function.map(len(starts))
    table = _signals(record)
    for j in range(horizon):
        w = table[:, starts + j]
        if j:  # the outputs after the start are not known to the prediction
            w[4] = np.asarray(output(w[0], x, w[1], e.values)[1], float)
        x, xc = (np.asarray(m, float) for m in plant_step(x, xc, w, 0.0))
    k = starts + horizon
    y = np.asarray(output(table[0, k], x, table[1, k], e.values)[1], float).ravel()
    return k, y


def spread_ahead(loop: Loop, prediction: Prediction, horizon: int) -> float:
    r"""Return the standard deviation that noise gives predictions several samples ahead.

    .. math:: P_{k+1} = A P_k A^T + Q, \quad \sigma^2 = h P_j h^T + R

    from the steady state of the filter, with the plant linearized at the operating point.

    Parameters
    ----------
    loop : Loop
        The model.
    prediction : Prediction
        What `predict` returned.
    horizon : int
        Number of samples ahead.

    Returns
    -------
    float
        Standard deviation [output unit].
    """
    e, at = loop.equations(), loop.point
    step = _plant_step(replace(loop, controller=None), None)
    n = len(e.states)
    x, force = casadi.SX.sym("x", n), casadi.SX.sym("f")
    after = step(x, casadi.SX(0, 1), [0, at.input, at.input, 0, 0], force)[0]
    height = e.function(0, x, at.input, e.values)[1]
    slopes = casadi.Function("j", [x, force], [
        casadi.jacobian(after, x), casadi.jacobian(after, force), casadi.jacobian(height, x),
    ])  # fmt: skip
    a, b, h = (np.asarray(m, float) for m in slopes(at.states, 0.0))
    r, q = prediction.sensor_noise**2, (prediction.force_noise * b) @ (prediction.force_noise * b).T
    p = q + r * np.eye(n)
    for _ in range(5000):
        gain = p @ h.T / (h @ p @ h.T + r) if r else np.zeros((n, 1))
        keep = np.eye(n) - gain @ h
        filtered = keep @ p @ keep.T + r * gain @ gain.T
        later = a @ filtered @ a.T + q
        if np.allclose(later, p, rtol=1e-9, atol=0.0):
            break
        p = later
    p = filtered
    for _ in range(horizon):
        p = a @ p @ a.T + q
    return float(np.sqrt((h @ p @ h.T).item() + r))
