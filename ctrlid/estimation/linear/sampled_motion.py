"""One-step prediction errors of a linear continuous-time model on sampled data, hold-exact.

The model is ``x' = A x + B u, y = C x``, from the polynomials of a transfer function. Over a
sampling period its state moves exactly, whatever u does between the samples: held, straight,
delayed by a fraction of a period, or driven by a known analog controller.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..._base.arrays import Array
from ..._base.compilation import compile_loop
from ..._base.interruption import keep_interrupt
from ...data.reconstruction import PIECES, reconstruct_signal
from ...loop.controller_sight import Sight


@dataclass(frozen=True, eq=False)
class Circuit:
    """A known analog controller of r - y in state-space form, and what it sees of the noise."""

    a: Array
    b: Array
    c: Array
    d: float
    hold_r: str = "zoh"
    sight: Sight = "reading"

    @property
    def fastest(self) -> float:
        """Magnitude of its fastest pole [rad/s]."""
        return float(np.max(np.abs(np.linalg.eigvals(self.a)), initial=0.0))


@dataclass(frozen=True, eq=False)
class DiscreteModel:
    """The discretized model: ``x+ = f x + b0 u_k + b1 u_(k-1) + ...``, and ``y = c x``.

    `direct` has what y follows at once of u, and how many samples late.

    The corners of a band-limited input are inputs of their own, `name_corner`. With a circuit, x
    stacks plant and controller states and two more inputs follow those of u: the measured output
    and the reference.
    """

    f: Array
    inputs: tuple[tuple[str, int, Array], ...]
    c: Array
    order: int
    direct: tuple[int, float] = (0, 0.0)


def realize_model(a: Array, b: Array, speed: float) -> tuple[Array, Array, Array]:
    """Return an observer form of ``b(s)/a(s)`` in time units of ``1/speed``.

    Parameters
    ----------
    a : ndarray
        Monic denominator in falling powers of s.
    b : ndarray
        Numerator of lower degree.
    speed : float
        A typical rate [rad/s]; keeps the matrix balanced.

    Returns
    -------
    a, b, c : ndarray
        State matrices per unit of scaled time.
    """
    n = len(a) - 1
    scale = speed ** -np.arange(1.0, n + 1)
    matrix = np.zeros((n, n))
    matrix[:, 0] = -a[1:] * scale
    matrix[:-1, 1:] = np.eye(n - 1)
    numerator = np.concatenate([np.zeros(n - len(b)), b]) * scale
    c = np.zeros(n)
    c[0] = 1.0
    return matrix * speed, numerator * speed, c


def _exponential(matrix: Array) -> Array:
    """Return the matrix exponential by a scaled Taylor series.

    For the few states of a plant this is exact to round-off. SciPy's function wakes the threads of
    the linear algebra library for it, which on a busy machine takes a hundred times as long.
    """
    norm = float(np.abs(matrix).sum(axis=0).max())
    if not np.isfinite(norm):
        return np.full(matrix.shape, np.nan)
    squarings = max(0, int(np.ceil(np.log2(max(norm, 1e-300)))) + 2)
    scaled = matrix / 2.0**squarings
    total = term = np.eye(len(matrix))
    # The terms left out are below 0.25^15/15!, which is less than 1e-21.
    for k in range(1, 15):
        term = term @ scaled / k
        total = total + term
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(squarings):
            total = total @ total
    # What grows beyond any number within one period has no prediction.
    return total if np.isfinite(total).all() else np.full(matrix.shape, np.nan)


def _find_unit(a: Array, b: Array) -> float:
    """Return the power of two that makes what drives the states as large as what they do alone.

    The motion is linear in b. Beside a b of another size, the exponential of both would lose the
    digits of a: where y is counted in units a billion times smaller than those of u, all but seven.
    """
    size, alone = float(np.abs(b).max(initial=0.0)), float(np.abs(a).max(initial=0.0))
    if not (np.isfinite(size) and np.isfinite(alone) and size > 0 and alone > 0):
        return 1.0
    return float(2.0 ** np.clip(np.round(np.log2(size / alone)), -1000, 1000))


def _integrate_hold(a: Array, b: Array, time: float) -> tuple[Array, Array]:
    n, unit = len(a), _find_unit(a, b)
    block = np.zeros((n + 1, n + 1))
    block[:n, :n], block[:n, n] = a * time, b / unit * time
    e = _exponential(block)
    return e[:n, :n], unit * e[:n, n]


def discretize_model(
    a: Array, b: Array, c: Array, dt: float, hold: str, delay: float = 0.0,
    circuit: Circuit | None = None,
) -> DiscreteModel:  # fmt: skip
    """Return the exact motion of the model over one period.

    Parameters
    ----------
    a, b, c : ndarray
        State matrices.
    dt : float
        Sampling period [s].
    hold : str
        ``"zoh"``, ``"foh"`` or ``"bandlimited"``.
    delay : float, optional
        Time from u to the plant [s], for a held input.
    circuit : Circuit, optional
        The analog controller that moves u between the samples.

    Returns
    -------
    DiscreteModel
        The motion.
    """
    n = len(a)
    if circuit is not None:
        return _discretize_with_circuit(a, b, c, dt, circuit)
    if hold == "bandlimited":
        short = discretize_model(a, b, c, dt / PIECES, "foh")
        (_, _, here), (_, _, ahead) = short.inputs
        powers = [np.linalg.matrix_power(short.f, k) for k in range(PIECES + 1)]
        columns = np.zeros((PIECES + 1, n))
        for k in range(PIECES):
            columns[k] += powers[PIECES - 1 - k] @ here
            columns[k + 1] += powers[PIECES - 1 - k] @ ahead
        corners = [(name_corner(k), 0, columns[k]) for k in range(PIECES)]
        return DiscreteModel(powers[PIECES], (*corners, (name_corner(0), -1, columns[-1])), c, n)
    if hold == "foh":
        unit = _find_unit(a, b)
        block = np.zeros((n + 2, n + 2))
        block[:n, :n], block[:n, n], block[n, n + 1] = a * dt, b / unit * dt, 1.0
        e = _exponential(block)
        held, ramp = unit * e[:n, n], unit * e[:n, n + 1]
        return DiscreteModel(e[:n, :n], (("u", 0, held - ramp), ("u", -1, ramp)), c, n)
    whole, part = divmod(delay / dt, 1.0)
    late = int(whole)
    f, gamma = _integrate_hold(a, b, dt)
    if part < 1e-12:
        return DiscreteModel(f, (("u", late, gamma),), c, n)
    after, new = _integrate_hold(a, b, (1 - part) * dt)
    _, old = _integrate_hold(a, b, part * dt)
    return DiscreteModel(f, (("u", late, new), ("u", late + 1, after @ old)), c, n)


def name_corner(k: int) -> str:
    """Return the name of the signal that a band-limited input has k pieces after the samples."""
    return f"u {k}/{PIECES}"


def list_inputs(u: Array, hold: str, valid: Any = None) -> dict[str, Array]:
    """Return an input as the signals that a `DiscreteModel` is driven by."""
    if hold != "bandlimited":
        return {"u": u}
    corners = reconstruct_signal(u, valid).reshape(-1, PIECES).T
    return {"u": u} | {name_corner(k): values for k, values in enumerate(corners)}


def _discretize_with_circuit(a: Array, b: Array, c: Array, dt: float, k: Circuit) -> DiscreteModel:
    """Return plant, circuit and input as one system, driven by r and sensor noise.

    The noise is held over the period, and so is r, unless it runs straight. Noise of the logger is
    none to the circuit.
    """
    n, m = len(a), len(k.a)
    size = n + m + 1
    block = np.zeros((size + 2, size + 2))
    # The last state is the slope of the reference.
    block[size, size + 1] = 1 / dt
    x, q, v, e = slice(0, n), slice(n, n + m), n + m, size
    block[x, x], block[x, v] = a, b
    block[q, q], block[q, x], block[q, e] = k.a, -np.outer(k.b, c), k.b
    # v' = c_k q' + d_k (r' - y'); e is r less the noise, which is constant over the period.
    block[v, :] = k.c @ block[q, :]
    block[v, :] -= k.d * (c @ block[x, :])
    block[v, size + 1] = k.d / dt
    # The input is counted in units in which it drives the plant as much as the plant itself does.
    unit = _find_unit(a, b)
    block[v, :] *= unit
    block[:, v] /= unit
    motion = _exponential(block * dt)[: n + m]
    motion[:, v] *= unit
    f = motion[:, : n + m].copy()
    # e = r - (y_measured - c x): the estimate of the noise at the sample.
    both = np.concatenate([c, np.zeros(m)])
    signals = [("u", 0, motion[:, v])]
    if k.sight == "reading":
        f[:, x] += np.outer(motion[:, e], c)
        signals.append(("y", 0, -motion[:, e]))
    if k.hold_r == "foh":
        ramp = motion[:, e + 1]
        signals += [("r", 0, motion[:, e] - ramp), ("r", -1, ramp)]
    else:
        signals.append(("r", 0, motion[:, e]))
    return DiscreteModel(f, tuple(signals), both, n)


def add_noise_states(motion: DiscreteModel, order: int) -> DiscreteModel:
    r"""Return the motion with sensor noise that is a moving average, as states at its end.

    .. math:: v_{k} = e_k + c_1 e_{k-1} + \dots + c_m e_{k-m}

    The states are a chain of delays, and the coefficients are what their observer gains are.
    """
    size = len(motion.f)
    f = np.zeros((size + order, size + order))
    f[:size, :size] = motion.f
    f[size:, size:] = np.eye(order, k=1)
    inputs = tuple((name, late, np.append(column, np.zeros(order)))
                   for name, late, column in motion.inputs)  # fmt: skip
    return DiscreteModel(f, inputs, np.concatenate([motion.c, np.eye(1, order)[0]]), motion.order)


def place_gain(motion: DiscreteModel, gain: Array) -> Array:
    """Return an observer gain of plant and noise as one of all states."""
    k = np.zeros(len(motion.f))
    k[: motion.order] = gain[: motion.order]
    noise = len(gain) - motion.order
    k[len(k) - noise :] = gain[motion.order :]
    return k


def compute_prediction_errors(
    motion: DiscreteModel, gain: Array, signals: dict[str, Array], before: Array | None = None
) -> Array | None:
    r"""Return the prediction errors of the model with an observer gain.

    .. math:: \hat x_{k+1} = F \hat x_k + \sum_i B_i s_{i,k} + K \varepsilon_k, \quad
        \varepsilon_k = y_k - C \hat x_k

    Parameters
    ----------
    motion : DiscreteModel
        The model over one period.
    gain : ndarray
        Observer gain K of the plant's states, then of those of the noise.
    signals : dict
        Arrays of the signals by name; all of the same length, deviations from a constant.
    before : ndarray, optional
        The input before the first sample; what is not known of it is as at that sample.

    Returns
    -------
    ndarray or None
        The errors from state zero on; None if the observer is unstable.
    """
    k = place_gain(motion, gain)
    closed = motion.f - np.outer(k, motion.c)
    if not np.isfinite(closed).all() or np.max(np.abs(np.linalg.eigvals(closed))) >= 1 - 1e-9:
        return None
    # What of y does not follow u at once is predicted.
    late, at_once = motion.direct
    seen = signals["y"]
    if at_once:
        seen = seen - at_once * _delay_signal(signals["u"], late, before)
    driving = np.array([_delay_signal(signals[name], shift, before if name == "u" else None)
                        for name, shift, _ in motion.inputs])  # fmt: skip
    columns = np.column_stack([column for *_, column in motion.inputs])
    errors: Array = _run_observer(closed, columns, k, motion.c, driving, seen)
    return errors


@keep_interrupt
@compile_loop(nogil=True)
def _run_observer(
    closed: Any, columns: Any, gain: Any, c: Any, driving: Any, seen: Any
) -> Any:  # pragma: no cover - compiled
    """Return the errors of a predictor that begins at zero."""
    n, m = columns.shape
    state, after = np.zeros(n), np.zeros(n)
    errors = np.empty(len(seen))
    for k in range(len(seen)):
        predicted = 0.0
        for i in range(n):
            predicted += c[i] * state[i]
        errors[k] = seen[k] - predicted
        for i in range(n):
            total = gain[i] * seen[k]
            for j in range(n):
                total += closed[i, j] * state[j]
            for j in range(m):
                total += columns[i, j] * driving[j, k]
            after[i] = total
        state[:] = after
    return errors


def _delay_signal(s: Array, samples: int, before: Array | None = None) -> Array:
    """Shift a signal later by some samples, or earlier by one; its ends are held."""
    if before is not None and len(before) and samples > 0:
        return _delay_signal(np.concatenate([before, s]), samples)[len(before) :]
    if samples == 0:
        return s
    samples = min(samples, len(s))
    if samples < 0:
        return np.append(s[-samples:], np.repeat(s[-1], -samples))
    return np.concatenate([np.repeat(s[0], samples), s[:-samples]])
