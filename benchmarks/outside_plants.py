"""Plants, effects, sensors and a filter of their own: a simulator that knows nothing of ctrlid.

Everything is in two compiled loops. `simulate` integrates a plant between the samples of a loop by
Runge-Kutta of fourth order. Where dry friction changes its sign, a step is split at the speed zero;
what friction can hold stays at rest. `filter_record` is the unscented Kalman filter of the
textbooks [1]_ over the same equations, with sensor noise that may be white, autoregressive,
averaged, walking or a mixture of normal laws. An effect is a number in the array that
`make_neutral` returns; all are switched off there.

.. [1] Julier and Uhlmann, Proceedings of the IEEE 92 (2004) 401-422; for the mixtures Sorenson and
   Alspach, Automatica 7 (1971) 465-479, collapsed to one normal law at every sample.
"""

from __future__ import annotations

import math

import numba
import numpy as np

PLANTS = ("ball", "drive", "pendulum", "spring", "cart", "tanks")
TANKS = 5  # the plant without a moving mass, whose second state is measured
PARAMETERS = (
    ("K", "m", "g", "b"),
    ("k", "c", "J", "b"),
    ("m", "l", "c", "g", "b"),
    ("s", "c", "m", "b"),
    ("M", "m", "l", "g", "b"),
    ("A", "o1", "o2", "k", "g", "b"),
)
EFFECTS = (
    "delay", "lag", "lower", "upper", "deadzone", "backlash", "curvature", "saturation", "offset",
    "rate", "changing", "changing_f",
    "viscous", "asymmetric", "coulomb", "coulomb_difference", "stribeck", "stribeck_v", "drag",
    "eddy", "stiffness", "cubic", "force", "periodic", "periodic_f", "periodic_phase", "ripple",
    "ripple_period", "ripple_phase", "mode_f", "mode_damping", "mode_share", "cubic_drag",
    "soft_stop", "reach", "bouc_wen", "bouc_wen_way",
    "position", "exponent", "which", "drift", "step", "step_time", "loss", "loss_f1", "loss_f2",
    "sensor_lag", "bend", "scale", "sensor_drift", "hum", "hum_f", "hum_phase", "play",
    "growth",
)  # fmt: skip
I = {name: i for i, name in enumerate(EFFECTS)}
(DELAY, LAG, LOWER, UPPER, DEADZONE, BACKLASH, CURVATURE, SATURATION, OFFSET, RATE, CHANGING,
 CHANGING_F, VISCOUS, ASYMMETRIC, COULOMB, COULOMB_D, STRIBECK, STRIBECK_V, DRAG, EDDY, STIFFNESS,
 CUBIC, FORCE, PERIODIC, PERIODIC_F, PERIODIC_P, RIPPLE, RIPPLE_L, RIPPLE_P, MODE_F, MODE_D, MODE_S,
 CUBIC_DRAG, SOFT_STOP, REACH, BOUC_WEN, BOUC_WEN_L, POSITION, EXPONENT, WHICH, DRIFT, STEP, STEP_T,
 LOSS, LOSS_1, LOSS_2, SENSOR_LAG, BEND, SCALE, SENSOR_DRIFT, HUM, HUM_F, HUM_P, PLAY,
 GROWTH) = range(len(EFFECTS))  # fmt: skip
EXTRA = 5  # states beside the plant's: mode (2), hysteresis, lag of the sensor, play of the sensor
MOST = 2 + EXTRA
SUBSTEPS = 8  # of the integration in a period
FINE = 4  # of the same in the filter, where something happens within a period


def make_neutral() -> np.ndarray:
    """Return the numbers of the effects, all switched off."""
    e = np.zeros(len(EFFECTS))
    e[LOWER], e[UPPER], e[RATE], e[EXPONENT] = -np.inf, np.inf, np.inf, 2.0
    e[[STRIBECK_V, BOUC_WEN_L, RIPPLE_L]] = 1.0
    return e


@numba.njit(cache=True, error_model="numpy")
def accelerate(plant, p, e, at, x, w, t, moving, dx):
    """Write the rates of all states; `moving` is the sign of what rubs, zero for none.

    `at` holds the position, the input and the output at rest, and the sampling period.
    """
    q = p
    if e[DRIFT] != 0.0 or e[STEP] != 0.0 or e[LOSS] != 0.0:
        q = p.copy()
        i = int(e[WHICH])
        q[i] *= 1 + e[DRIFT] * t
        if t >= e[STEP_T]:
            q[i] *= 1 + e[STEP]
        if math.sin(2 * math.pi * e[LOSS_1] * t) + math.sin(2 * math.pi * e[LOSS_2] * t) > 1:
            q[i] *= 1 - e[LOSS]
    a = 0.0
    if plant == 0:
        d = x[0] + e[POSITION]
        u = w + q[3]
        pull = q[0] / q[1] * u * u / (d * d)
        if e[EXPONENT] != 2.0:
            pull *= (d / at[0]) ** (2.0 - e[EXPONENT])
        a = q[2] - pull
    elif plant == 1:
        a = (q[0] * (w + q[3]) - q[1] * x[1]) / q[2]
    elif plant == 2:
        inertia = q[0] * q[1] * q[1]
        a = q[3] / q[1] * math.sin(x[0] + e[POSITION]) + (w + q[4] - q[2] * x[1]) / inertia
    elif plant == 3:
        a = (w + q[3] - q[0] * (x[0] + e[POSITION]) - q[1] * x[1]) / q[2]
    elif plant == 4:
        # A cart with a pole by the pole's angle; where the cart stands, does not matter.
        sin, cos = math.sin(x[0] + e[POSITION]), math.cos(x[0] + e[POSITION])
        push = w + q[4] - q[1] * q[2] * sin * x[1] * x[1]
        a = ((q[0] + q[1]) * q[3] * sin + cos * push) / (q[2] * (q[0] + q[1] * sin * sin))
    else:
        h1, h2 = max(x[0], 0.0), max(x[1], 0.0)
        out = q[1] * math.sqrt(2 * q[4] * h1)
        dx[0] = (q[3] * (w + q[5]) - out) / q[0]
        dx[1] = (out - q[2] * math.sqrt(2 * q[4] * h2)) / q[0]
    for i in range(2, MOST):
        dx[i] = 0.0
    if plant != TANKS:
        pos, v = x[0], x[1]
        d = pos - at[0]
        f = e[FORCE] - e[VISCOUS] * v - e[ASYMMETRIC] * abs(v) - e[DRAG] * v * abs(v)
        f -= e[EDDY] * w * w * v + e[STIFFNESS] * d + e[CUBIC] * d * d * d
        f -= e[CUBIC_DRAG] * v * v * v
        if e[SOFT_STOP] != 0.0:
            f -= e[SOFT_STOP] * max(d - e[REACH], 0.0)
        if e[PERIODIC] != 0.0:
            f += e[PERIODIC] * math.sin(2 * math.pi * e[PERIODIC_F] * t + e[PERIODIC_P])
        if e[RIPPLE] != 0.0:
            f += e[RIPPLE] * math.sin(2 * math.pi * pos / e[RIPPLE_L] + e[RIPPLE_P])
        if e[BOUC_WEN] != 0.0:
            z, s = x[4], v / e[BOUC_WEN_L]
            dx[4] = s - 0.5 * abs(s) * z - 0.5 * s * abs(z)
            f -= e[BOUC_WEN] * z
        if moving != 0.0:
            dry = e[COULOMB]
            if e[STRIBECK] != 0.0:
                dry += e[STRIBECK] * math.exp(-((v / e[STRIBECK_V]) ** 2))
            f -= moving * dry + e[COULOMB_D]
        a += f
        if e[MODE_S] != 0.0:
            o = 2 * math.pi * e[MODE_F]
            hold = o * o * x[2] + 2 * e[MODE_D] * o * x[3]
            a = (a + e[MODE_S] * hold) / (1 - e[MODE_S])
            dx[2], dx[3] = x[3], -hold - a
        dx[0], dx[1] = v, a


@numba.njit(cache=True, error_model="numpy")
def step(plant, p, e, at, x, w, t, h, push, moving, new, dx, y, s1, s2, s3):
    """Write into `new` the states after a Runge-Kutta step of fourth order."""
    for i in range(MOST):
        y[i] = x[i]
    accelerate(plant, p, e, at, y, w, t, moving, dx)
    if plant != TANKS:
        dx[1] += push
    for i in range(MOST):
        y[i] = x[i] + 0.5 * h * dx[i]
    accelerate(plant, p, e, at, y, w, t + 0.5 * h, moving, s1)
    if plant != TANKS:
        s1[1] += push
    for i in range(MOST):
        y[i] = x[i] + 0.5 * h * s1[i]
    accelerate(plant, p, e, at, y, w, t + 0.5 * h, moving, s2)
    if plant != TANKS:
        s2[1] += push
    for i in range(MOST):
        y[i] = x[i] + h * s2[i]
    accelerate(plant, p, e, at, y, w, t + h, moving, s3)
    if plant != TANKS:
        s3[1] += push
    for i in range(MOST):
        new[i] = x[i] + h * (dx[i] + 2 * s1[i] + 2 * s2[i] + s3[i]) / 6


@numba.njit(cache=True, error_model="numpy")
def advance(plant, p, e, at, x, w, t, h, push, dx, y, s1, s2, s3):
    """Integrate all states over a step `h` in place; `push` is a random force held over it.

    Where dry friction changes its sign, the step ends at the speed zero, and the rest of it is
    another step, unless the mass is held.
    """
    iy = 1 if plant == TANKS else 0
    before, left, new = x[iy], h, np.empty(MOST)
    rubbed = plant != TANKS and (e[COULOMB] != 0.0 or e[STRIBECK] != 0.0)
    for _ in range(4):
        moving = 0.0
        if rubbed:
            moving = 1.0 if x[1] > 0 else -1.0
            if x[1] == 0.0:
                accelerate(plant, p, e, at, x, w, t, 0.0, dx)
                free = dx[1] + push - e[COULOMB_D]
                if abs(free) <= e[COULOMB] + e[STRIBECK]:
                    break
                moving = 1.0 if free > 0 else -1.0
        step(plant, p, e, at, x, w, t, left, push, moving, new, dx, y, s1, s2, s3)
        if moving * new[1] < 0 and x[1] != 0.0:
            part = left * x[1] / (x[1] - new[1])
            step(plant, p, e, at, x, w, t, part, push, moving, new, dx, y, s1, s2, s3)
            new[1] = 0.0
            t, left = t + part, left - part
        else:
            left = 0.0
        for i in range(MOST):
            x[i] = new[i]
        if left <= 0.0:
            break
    if plant == TANKS:
        x[0] = max(x[0] + h * push, 0.0)
        x[1] = max(x[1], 0.0)
    if e[SENSOR_LAG] != 0.0:
        # The response to a ramp, as which the output moves within a step.
        behind = (x[iy] - before) / h * e[SENSOR_LAG]
        x[5] = x[iy] - behind + (x[5] - before + behind) * math.exp(-h / e[SENSOR_LAG])


@numba.njit(cache=True, error_model="numpy")
def find_older_share(e, j, parts):
    """Return in which share of part `j` of a period the older one of two delayed inputs acts."""
    return min(max((e[DELAY] - int(e[DELAY])) * parts - j, 0.0), 1.0)


@numba.njit(cache=True, error_model="numpy")
def actuate(u, k, e, at, memory, t, h, older):
    """Return what reaches the plant in a part of period `k`; `memory` holds lag, gap and rate.

    In a share of it the `older` input of a delay acts; of both the mean is taken.
    """
    whole = int(e[DELAY])
    w = u[k - whole] if k >= whole else at[1]
    if older > 0.0:
        w += older * ((u[k - whole - 1] if k > whole else at[1]) - w)
    if w < e[LOWER]:
        w = e[LOWER]
    if w > e[UPPER]:
        w = e[UPPER]
    if e[DEADZONE] != 0.0:
        half = 0.5 * e[DEADZONE]
        w -= min(max(w - at[1], -half), half)
    if e[BACKLASH] != 0.0:
        half = 0.5 * e[BACKLASH]
        memory[1] = min(max(memory[1], w - half), w + half)
        w = memory[1]
    if e[CURVATURE] != 0.0:
        w += e[CURVATURE] * (w - at[1]) ** 2
    if e[SATURATION] != 0.0:
        w /= math.sqrt(1 + e[SATURATION] * w * w)
    w += e[OFFSET]
    if e[RATE] < np.inf:
        way = min(max(w - memory[2], -e[RATE] * h), e[RATE] * h)
        memory[2] += way
        # The mean of the ramp over the step acts in it.
        w = memory[2] - way * abs(way) / (2 * e[RATE] * h)
    tau = e[LAG]
    if e[CHANGING] != 0.0:
        tau = e[CHANGING] * (1.02 + math.sin(2 * math.pi * e[CHANGING_F] * t))
    if tau > 0.0:
        decay = math.exp(-h / tau)
        # The mean of the lagged input over the step acts in it.
        last = memory[0]
        memory[0] = w + (last - w) * decay
        w += (last - w) * (1 - decay) * tau / h
    return w


@numba.njit(cache=True, error_model="numpy")
def read(plant, e, at, x, t):
    """Return what the sensor makes of the states, before its noise."""
    y = x[5] if e[SENSOR_LAG] != 0.0 else x[1 if plant == TANKS else 0]
    if e[PLAY] != 0.0:
        half = 0.5 * e[PLAY]
        x[6] = min(max(x[6], y - half), y + half)
        y = x[6]
    if e[BEND] != 0.0:
        y += e[BEND] * (y - at[2]) ** 2
    y *= 1 + e[SCALE]
    y += e[SENSOR_DRIFT] * t
    if e[HUM] != 0.0:
        y += e[HUM] * math.sin(2 * math.pi * e[HUM_F] * t + e[HUM_P])
    return y


@numba.njit(cache=True, error_model="numpy")
def simulate(plant, p, e, at, x0, num, den, closed, moves, pushes, noise, periods, step, reach):
    """Return input and reading of a loop, and whether the output stayed within its reach.

    The controller acts on r - y, in powers of 1/z, and adds the input at rest.
    """
    n = len(moves)
    x = x0.copy()
    u, y = np.zeros(n), np.zeros(n)
    errors, outputs = np.zeros(len(num)), np.zeros(len(den))
    memory = np.full(3, at[1])
    a, b, c, d, f = np.zeros((5, MOST))
    t = 0.0
    iy = 1 if plant == TANKS else 0
    for k in range(n):
        shown = read(plant, e, at, x, t)
        y[k] = shown + noise[k] * (1 + e[GROWTH] * abs(x[iy] - at[2]))
        if step > 0.0:
            y[k] = step * round(y[k] / step)
        if closed:
            for i in range(len(errors) - 1, 0, -1):
                errors[i] = errors[i - 1]
            errors[0] = moves[k] + at[2] - y[k]
            new = 0.0
            for i in range(len(num)):
                new += num[i] * errors[i]
            for i in range(1, len(den)):
                new -= den[i] * outputs[i - 1]
            for i in range(len(outputs) - 1, 0, -1):
                outputs[i] = outputs[i - 1]
            outputs[0] = new
            u[k] = at[1] + new
        else:
            u[k] = moves[k] + at[1]
        h = periods[k] / SUBSTEPS
        for j in range(SUBSTEPS):
            # A step in which a delayed input changes is two: their mean would act as a lag does.
            share = find_older_share(e, j, SUBSTEPS)
            for older, part in ((1.0, share * h), (0.0, (1.0 - share) * h)):
                if part > 0.0:
                    w = actuate(u, k, e, at, memory, t, part, older)
                    advance(plant, p, e, at, x, w, t, part, pushes[k], a, b, c, d, f)
                    t += part
        if not abs(x[iy] - at[2]) < reach:
            return u, y, False
    return u, y, True


@numba.njit(cache=True, error_model="numpy")
def factorize(P, n, L):
    """Write the Cholesky factor of a covariance; what rounding made negative is almost zero."""
    for i in range(n):
        for j in range(i + 1):
            s = P[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                L[i, i] = math.sqrt(max(s, 1e-14 * P[i, i] + 1e-300))
            else:
                L[i, j] = s / L[j, j]
        for j in range(i + 1, n):
            L[i, j] = 0.0


@numba.njit(cache=True, error_model="numpy")
def filter_record(plant, p, e, at, x0, spread, u, y, sigma, push, colour, weights, ratios):
    """Return the means and variances of the predicted readings, a column for each normal law.

    Parameters
    ----------
    plant, p, e, at : int and arrays
        The model.
    x0, spread : ndarray
        The states at rest and how far they may be from there.
    u, y : ndarray
        The record.
    sigma, push : float
        Standard deviations of the sensor noise and of a random force that is held over a period.
    colour : ndarray
        The noise is ``colour[0]`` times itself plus a step of ``colour[1]`` sigma, beside white
        noise of ``colour[2]`` sigma; or the mean of ``colour[3]`` samples of white noise.
    weights, ratios : ndarray
        Laws of which the white noise is mixed, and their standard deviations over sigma.

    Returns
    -------
    mean, variance : ndarray
        Of the reading, shapes (n,) and (n, laws).
    """
    iy = 1 if plant == TANKS else 0
    active = np.zeros(MOST, np.int64)
    d = 0
    for i in range(MOST):
        on = i < 2
        on = on or (i < 4 and e[MODE_S] != 0.0) or (i == 4 and e[BOUC_WEN] != 0.0)
        on = on or (i == 5 and e[SENSOR_LAG] != 0.0) or (i == 6 and e[PLAY] != 0.0)
        if on:
            active[d] = i
            d += 1
    count = int(colour[3])
    extra = 1 if colour[1] > 0 else count if count > 1 else 0
    dim = d + extra
    n, dt = len(y), at[3]
    parts = FINE
    if e[DELAY] == 0 and e[COULOMB] == 0 and e[STRIBECK] == 0 and e[LAG] == 0 and e[CHANGING] == 0:
        parts = 2 if e[MODE_S] != 0 or e[SENSOR_LAG] != 0 or e[RATE] < np.inf else 1
    h = dt / parts
    laws = len(weights)
    mean, variance = np.zeros(n), np.zeros((n, laws))
    m, P, L = np.zeros(dim), np.zeros((dim, dim)), np.zeros((dim, dim))
    for i in range(d):
        m[i] = x0[active[i]]
        P[i, i] = spread[active[i]] ** 2
    if colour[1] > 0:
        P[d, d] = (colour[1] * sigma) ** 2 / max(1 - colour[0] ** 2, 1e-3)
    for i in range(d, dim):
        if count > 1:
            P[i, i] = sigma**2
    points, shown = np.zeros((2 * dim + 1, dim)), np.zeros(2 * dim + 1)
    others, cross = np.zeros((2 * dim + 1, dim)), np.zeros(dim)
    new, newP = np.zeros(dim), np.zeros((dim, dim))
    x = np.zeros(MOST)
    a, b, c, f, g = np.zeros((5, MOST))
    # Of more than three states the middle would weigh less than nothing, and variances with it.
    reach = max(dim, 3)
    w0 = 1.0 - dim / reach
    wi = 0.5 / reach
    root = math.sqrt(reach)
    memory = np.full(3, at[1])
    inputs = np.zeros(FINE)
    post, moved = np.zeros(laws), np.zeros(dim)
    for k in range(n):
        t = k * dt
        factorize(P, dim, L)
        for s in range(2 * dim + 1):
            for i in range(dim):
                points[s, i] = m[i]
                if s > 0:
                    j = (s - 1) // 2
                    points[s, i] += root * L[i, j] * (1.0 if s % 2 else -1.0)
        yhat, grown = 0.0, 0.0
        for s in range(2 * dim + 1):
            x[:] = x0
            for i in range(d):
                x[active[i]] = points[s, i]
            shown[s] = read(plant, e, at, x, t)
            for i in range(d):
                points[s, i] = x[active[i]]
            if colour[1] > 0:
                shown[s] += points[s, d]
            elif count > 1:
                for i in range(count):
                    shown[s] += points[s, d + i] / math.sqrt(count)
            yhat += (w0 if s == 0 else wi) * shown[s]
            grown += (w0 if s == 0 else wi) * abs(x[iy] - at[2])
        if e[PLAY] != 0.0:
            # What the sensor shows has moved with the reading: its mean and variance are new.
            for i in range(dim):
                m[i] = 0.0
                for s in range(2 * dim + 1):
                    m[i] += (w0 if s == 0 else wi) * points[s, i]
            for i in range(dim):
                for j in range(dim):
                    P[i, j] = 0.0
                    for s in range(2 * dim + 1):
                        weight = w0 if s == 0 else wi
                        P[i, j] += weight * (points[s, i] - m[i]) * (points[s, j] - m[j])
        var = 0.0
        cross[:] = 0.0
        for s in range(2 * dim + 1):
            weight = w0 if s == 0 else wi
            var += weight * (shown[s] - yhat) ** 2
            for i in range(dim):
                cross[i] += weight * (points[s, i] - m[i]) * (shown[s] - yhat)
        var = max(var, 1e-12 * sigma**2)
        white = sigma * colour[2] * (1 + e[GROWTH] * max(grown, 0.0))
        if count > 1:
            white = 0.02 * sigma
        mean[k] = yhat
        err = y[k] - yhat
        top = -1e300
        for q in range(laws):
            variance[k, q] = var + (white * ratios[q]) ** 2
            post[q] = math.log(weights[q]) - 0.5 * (
                math.log(variance[k, q]) + err * err / variance[k, q]
            )
            top = max(top, post[q])
        total = 0.0
        for q in range(laws):
            post[q] = math.exp(post[q] - top)
            total += post[q]
        gain1, gain2 = 0.0, 0.0
        for q in range(laws):
            post[q] /= total
            gain1 += post[q] / variance[k, q]
            gain2 += post[q] / variance[k, q] ** 2
        for i in range(dim):
            m[i] += cross[i] * gain1 * err
        # The laws' means are apart by what each makes of the same error.
        apart = (gain2 - gain1 * gain1) * err * err
        for i in range(dim):
            for j in range(dim):
                P[i, j] += cross[i] * cross[j] * (apart - gain1)
        for j in range(parts):
            share = find_older_share(e, j, parts)
            inputs[j] = actuate(u, k, e, at, memory, t + j * h, h, share)
        factorize(P, dim, L)
        new[:] = 0.0
        for s in range(2 * dim + 1):
            x[:] = x0
            for i in range(dim):
                others[s, i] = m[i]
                if s > 0:
                    j = (s - 1) // 2
                    others[s, i] += root * L[i, j] * (1.0 if s % 2 else -1.0)
            for i in range(d):
                x[active[i]] = others[s, i]
            for j in range(parts):
                advance(plant, p, e, at, x, inputs[j], t + j * h, h, 0.0, a, b, c, f, g)
            for i in range(d):
                others[s, i] = x[active[i]]
            if colour[1] > 0:
                others[s, d] *= colour[0]
            elif count > 1:
                for i in range(dim - 1, d, -1):
                    others[s, i] = others[s, i - 1]
                others[s, d] = 0.0
            for i in range(dim):
                new[i] += (w0 if s == 0 else wi) * others[s, i]
        newP[:] = 0.0
        for s in range(2 * dim + 1):
            weight = w0 if s == 0 else wi
            for i in range(dim):
                for j in range(dim):
                    newP[i, j] += weight * (others[s, i] - new[i]) * (others[s, j] - new[j])
        for i in range(dim):
            m[i] = new[i]
            for j in range(dim):
                P[i, j] = newP[i, j]
        # What a random force that is held over the period moves.
        moved[:] = 0.0
        if plant == TANKS:
            moved[0] = push * dt
        else:
            moved[0], moved[1] = 0.5 * push * dt * dt, push * dt
        for i in range(dim):
            for j in range(dim):
                P[i, j] += moved[i] * moved[j]
        if colour[1] > 0:
            P[d, d] += (colour[1] * sigma) ** 2
        elif count > 1:
            P[d, d] += sigma**2
        if not (abs(m[0]) < 1e8 and P[0, 0] < 1e16):
            mean[k:] = np.nan
            return mean, variance
    return mean, variance


# Nodes and weights of Gauss and Hermite, for expectations over a normal law.
NODES, MASSES = np.polynomial.hermite_e.hermegauss(9)
MASSES = MASSES / MASSES.sum()


@numba.njit(cache=True, error_model="numpy")
def compute_log_density(v, mean, variance, weights):
    """Return the logarithm of a mixture of normal laws."""
    top, total = -1e300, 0.0
    for q in range(len(weights)):
        value = math.log(weights[q]) - 0.5 * (
            math.log(2 * math.pi * variance[q]) + (v - mean) ** 2 / variance[q]
        )
        if value > top:
            total = total * math.exp(top - value) + 1.0
            top = value
        else:
            total += math.exp(value - top)
    return top + math.log(total)


@numba.njit(cache=True, error_model="numpy")
def sum_divergence(mean, variance, weights, other, width, masses, nodes, share):
    r"""Return the divergence of Kullback and Leibler from one filter to another, sample by sample.

    .. math:: \sum_k \int p_k \ln (p_k / q_k)

    The log-likelihood ratio less this sum is a martingale, so that this is its expectation.
    """
    total = 0.0
    for k in range(len(mean)):
        for c in range(len(weights)):
            deviation = math.sqrt(variance[k, c])
            for j in range(len(nodes)):
                v = mean[k] + deviation * nodes[j]
                total += (
                    weights[c]
                    * share[j]
                    * (
                        compute_log_density(v, mean[k], variance[k], weights)
                        - compute_log_density(v, other[k], width[k], masses)
                    )
                )
    return total


@numba.njit(cache=True, error_model="numpy")
def differentiate_divergence(mean, variance, weights, other, width, masses, nodes, share):
    """Return the divergence, and its derivatives by the other filter's means and variances.

    Of two normal laws in closed form, else by quadrature.
    """
    n, laws = width.shape
    total, by_mean, by_variance = 0.0, np.zeros(n), np.zeros((n, laws))
    for k in range(n):
        if laws == 1 and len(weights) == 1:
            v, w, off = variance[k, 0], width[k, 0], other[k] - mean[k]
            total += 0.5 * (math.log(w / v) + (v + off * off) / w - 1.0)
            by_mean[k] = off / w
            by_variance[k, 0] = 0.5 * (1.0 - (v + off * off) / w) / w
            continue
        for c in range(len(weights)):
            deviation = math.sqrt(variance[k, c])
            for j in range(len(nodes)):
                mass = weights[c] * share[j]
                v = mean[k] + deviation * nodes[j]
                ours = compute_log_density(v, other[k], width[k], masses)
                total += mass * (compute_log_density(v, mean[k], variance[k], weights) - ours)
                for q in range(laws):
                    w, off = width[k, q], v - other[k]
                    part = math.log(masses[q]) - 0.5 * (math.log(2 * math.pi * w) + off * off / w)
                    owed = mass * math.exp(part - ours)
                    by_mean[k] -= owed * off / w
                    by_variance[k, q] -= owed * 0.5 * (off * off / w - 1.0) / w
    return total, by_mean, by_variance


@numba.njit(cache=True, error_model="numpy")
def compute_log_likelihood(y, mean, variance, weights):
    """Return the log-likelihood of a record under the predictions of a filter."""
    total = 0.0
    for k in range(len(y)):
        total += compute_log_density(y[k], mean[k], variance[k], weights)
    return total
