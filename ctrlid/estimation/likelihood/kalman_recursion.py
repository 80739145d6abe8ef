"""The Kalman filter along a trajectory, with held-gain sensitivities: the one compiled loop.

Everything that depends on the plant comes in as arrays (its map over one period and the derivatives
of that map, evaluated along a nominal trajectory), so one function serves every plant and every
effect.
"""

from collections import Counter
from typing import Any

import numpy as np

from ..._base.compilation import compile_loop
from ..._base.interruption import keep_interrupt

# A state beyond this size has lost the record, and its square would soon overflow.
LARGE = 1e150
# From so many samples on, a filter of one size is worth two seconds of compiling for that size.
OFTEN = 10_000_000

_filtered: Counter[tuple[int, int, int]] = Counter()


def choose_sizes(states: int, width: int, outputs: int, samples: int) -> tuple[Any, Any, Any]:
    """Return what tells the filter its sizes: tuples where it has run often with them, or arrays.

    The length of a tuple is known when the filter is compiled, once for each, which makes it 1.2 to
    1.6 times as fast as arrays, whose length is found out later. The results are the same bits.
    """
    sizes = states, width, outputs
    _filtered[sizes] += samples
    if _filtered[sizes] < OFTEN:
        return np.empty(states), np.empty(width), np.empty(outputs)
    return (0,) * states, (0,) * width, (0,) * outputs


@keep_interrupt
@compile_loop(nogil=True, error_model="numpy")
def filter_pass(
    step: Any, a: Any, b: Any, du: Any, dp: Any, output: Any, c: Any, hp: Any, predicted: Any,
    filtered: Any, y: Any, valid: Any, restart: Any, input_variance: Any, start: Any, spread: Any,
    sensor: Any, tails: Any, force: Any, memory: Any, drift: Any, states: Any, widths: Any,
    outputs: Any,
) -> Any:  # fmt: skip  # pragma: no cover - compiled
    r"""Run the filter over a record, linearized along a nominal trajectory.

    .. math:: x^-_{k+1} = f_k + A_k (\hat x_k - \bar x_k) + B_k d_k, \quad
        P^-_{k+1} = A_k P_k A_k^T + q B_k B_k^T, \quad d_{k+1} = \rho d_k + w_k

    where the force d is a state of its own if its variance is positive. The measurement update is
    in Joseph's form. With the gain held fixed, the sensitivities obey

    .. math:: S^-_{k+1} = A_k S_k + \partial f_k / \partial\theta, \quad
        S_k = S^-_k - K_k \psi_k, \quad
        \psi_k = c_k S^-_k + \partial h_k / \partial\theta.

    Where the sensor noise has heavy tails, a reading with the error e counts as one of the variance
    s/w, with the weight w of the law; s is the variance without.

    Parameters
    ----------
    step, a, b, du, dp : ndarray, shapes (N, n), (N, n, n), (N, n, m), (N, n), (N, n, p)
        Next state from the nominal filtered state; its derivatives by state, force, input and
        parameters.
    output, c, hp : ndarray, shapes (N, q), (N, q, n), (N, q, p)
        Outputs at the nominal predicted state and their derivatives.
    predicted, filtered : ndarray, shape (N, n)
        Nominal trajectory before and after the measurements of a sample.
    y, valid : ndarray, shape (N, q)
        Measured outputs, and whether they count.
    restart, input_variance : ndarray, shape (N,)
        Whether the filter starts anew; variance of the input.
    start, spread : ndarray, shapes (n,), (n, n)
        State and covariance at a start.
    sensor : ndarray, shape (N, q)
        Variances of the sensor noises, which are independent: the outputs of a sample update the
        state one after another.
    tails : ndarray, shape (1 or q, 4)
        Degrees of freedom, share and ratio of wild readings, and scale, as in `Tails`; all zero
        for Gaussian noise. Readings take the rows in turn.
    force : ndarray, shape (m,)
        Variances of the white forces.
    memory, drift : float
        Coefficient rho of the coloured force and variance of its steps; no such force if zero.
    states, widths, outputs : tuple of int or ndarray
        As many elements, whatever they are, as the plant has states, as the filter has (one more
        if there is a coloured force), and as there are outputs. See `choose_sizes`.

    Returns
    -------
    tuple
        innovations (N, q), their variances (N, q), each of which is given those of the same sample
        before it; predicted (N, n), filtered (N, n) states, standard deviations of the filtered
        states (N, n), sensitivities of the predictions (N, q, p) and the coloured force (N,).
    """
    size = step.shape[0]
    n, w, count = len(states), len(widths), len(outputs)
    p = dp.shape[2]
    m = b.shape[2]
    coloured = drift > 0.0
    x, cov, sens = np.zeros(w), np.zeros((w, w)), np.zeros((w, p))
    error, variance = np.zeros((size, count)), np.ones((size, count))
    before, after = np.empty((size, n)), np.empty((size, n))
    wide, slopes = np.zeros((size, n)), np.zeros((size, count, p))
    disturbance = np.zeros(size)
    row, gain = np.zeros(w), np.zeros(w)
    moved, turned = np.zeros(w), np.zeros((w, w))
    full, late = np.zeros((w, w)), np.zeros((w, p))
    ph, along = np.zeros(w), np.zeros(w)
    for k in range(size):
        if restart[k] or k == 0:
            for i in range(w):
                x[i] = start[i] if i < n else 0.0
                for j in range(w):
                    cov[i, j] = spread[i, j] if i < n and j < n else 0.0
                for q in range(p):
                    sens[i, q] = 0.0
            if coloured:
                cov[n, n] = drift / (1.0 - memory * memory)
        for i in range(n):
            before[k, i] = x[i]
        for h in range(count):
            expected = output[k, h]
            for i in range(n):
                row[i] = c[k, h, i]
                expected += c[k, h, i] * (x[i] - predicted[k, i])
            if coloured:
                row[n] = 0.0
            s = sensor[k, h]
            for i in range(w):
                total = 0.0
                for j in range(n):
                    total += cov[i, j] * row[j]
                ph[i] = total
            for i in range(n):
                s += row[i] * ph[i]
            variance[k, h] = s
            for q in range(p):
                total = hp[k, h, q]
                for i in range(n):
                    total += row[i] * sens[i, q]
                slopes[k, h, q] = total
            if valid[k, h]:
                e = y[k, h] - expected
                error[k, h] = e
                wild = 0.0
                law = tails[(k * count + h) % len(tails)]
                freedom, share, ratio, scale = law[0], law[1], law[2], law[3]
                if freedom > 0.0:
                    wild = e * e / (freedom * scale)
                elif share > 0.0:
                    square = 0.5 * e * e / (s * scale) * (1.0 - 1.0 / (ratio * ratio))
                    odds = share / (1.0 - share) / ratio * np.exp(min(square, 600.0))
                    usual = 1.0 - odds / (1.0 + odds) * (1.0 - 1.0 / (ratio * ratio))
                    wild = s * (1.0 / usual - 1.0)
                s += wild
                for i in range(w):
                    gain[i] = ph[i] / s
                    x[i] += gain[i] * e
                for i in range(w):
                    for q in range(p):
                        sens[i, q] -= gain[i] * slopes[k, h, q]
                # Joseph's form (I - K c) P (I - K c)' + K R K' stays positive whatever round-off
                # does; its products with c are formed once.
                for i in range(w):
                    total = 0.0
                    for j in range(w):
                        value = cov[i, j] - gain[i] * ph[j]
                        turned[i, j] = value
                        total += value * row[j]
                    along[i] = total
                for i in range(w):
                    for j in range(i + 1):
                        pull = (sensor[k, h] + wild) * gain[i] - along[i]
                        value = turned[i, j] + pull * gain[j]
                        cov[i, j] = value
                        cov[j, i] = value
        for i in range(n):
            after[k, i] = x[i]
            wide[k, i] = np.sqrt(max(cov[i, i], 0.0))
        if coloured:
            disturbance[k] = x[n]
        # Estimate and covariance are carried over one period.
        for i in range(n):
            total = step[k, i]
            for j in range(n):
                value = a[k, i, j]
                full[i, j] = value
                total += value * (x[j] - filtered[k, j])
            if coloured:
                push = 0.0
                for j in range(m):
                    push += b[k, i, j]
                full[i, n] = push
                total += push * x[n]
            moved[i] = total
        if coloured:
            for j in range(n):
                full[n, j] = 0.0
            full[n, n] = memory
            moved[n] = memory * x[n]
        for i in range(w):
            x[i] = moved[i]
            for j in range(w):
                total = 0.0
                for l in range(w):
                    total += full[i, l] * cov[l, j]
                turned[i, j] = total
        for i in range(w):
            for j in range(i + 1):
                total = 0.0
                for l in range(w):
                    total += turned[i, l] * full[j, l]
                if i < n and j < n:
                    for l in range(m):
                        total += force[l] * b[k, i, l] * b[k, j, l]
                    if input_variance[k] > 0.0:
                        total += input_variance[k] * du[k, i] * du[k, j]
                elif i == n and j == n:
                    total += drift
                cov[i, j] = total
                cov[j, i] = total
        if p > 0:
            for i in range(w):
                for q in range(p):
                    total = dp[k, i, q] if i < n else 0.0
                    for l in range(w):
                        total += full[i, l] * sens[l, q]
                    late[i, q] = total
            sens, late = late, sens
        if not np.isfinite(x[0]) or abs(x[0]) > LARGE:
            error[k:] = np.nan
            break
    return error, variance, before, after, wide, slopes, disturbance
