"""One-step prediction errors of a linear continuous-time model on sampled data, hold-exact.

The model is ``x' = A x + B u, y = C x``, from the polynomials of a transfer function. Over a
sampling period its state moves exactly, whatever u does between the samples: held, straight,
delayed by a fraction of a period, or driven by a known analog controller.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import signal

from ..._base.arrays import Array
from ...data.reconstruction import PIECES, reconstruct_signal


@dataclass(frozen=True, eq=False)
class Circuit:
    """A known analog controller of r - y in state-space form."""

    a: Array
    b: Array
    c: Array
    d: float
    hold_r: str = "zoh"

    @property
    def fastest(self) -> float:
        """Magnitude of its fastest pole [rad/s]."""
        return float(np.max(np.abs(np.linalg.eigvals(self.a)), initial=0.0))


@dataclass(frozen=True, eq=False)
class DiscreteModel:
    """The discretized model: ``x+ = f x + b0 u_k + b1 u_(k-1) + ...``, and ``y = c x``.

    The corners of a band-limited input are inputs of their own, `name_corner`. With a circuit, x
    stacks plant and controller states and two more inputs follow those of u: the measured output
    and the reference.
    """

    f: Array
    inputs: tuple[tuple[str, int, Array], ...]
    c: Array
    order: int


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


def _integrate_hold(a: Array, b: Array, time: float) -> tuple[Array, Array]:
    n = len(a)
    block = np.zeros((n + 1, n + 1))
    block[:n, :n], block[:n, n] = a * time, b * time
    e = _exponential(block)
    return e[:n, :n], e[:n, n]


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
    Flow
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
        block = np.zeros((n + 2, n + 2))
        block[:n, :n], block[:n, n], block[n, n + 1] = a * dt, b * dt, 1.0
        e = _exponential(block)
        return DiscreteModel(
            e[:n, :n], (("u", 0, e[:n, n] - e[:n, n + 1]), ("u", -1, e[:n, n + 1])), c, n
        )
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

    The noise is held over the period, and so is r, unless it runs straight.
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
    motion = _exponential(block * dt)[: n + m]
    f = motion[:, : n + m].copy()
    # e = r - (y_measured - c x): the estimate of the noise at the sample.
    f[:, x] += np.outer(motion[:, e], c)
    both = np.concatenate([c, np.zeros(m)])
    signals = [("u", 0, motion[:, v]), ("y", 0, -motion[:, e])]
    if k.hold_r == "foh":
        ramp = motion[:, e + 1]
        signals += [("r", 0, motion[:, e] - ramp), ("r", -1, ramp)]
    else:
        signals.append(("r", 0, motion[:, e]))
    return DiscreteModel(f, tuple(signals), both, n)


def compute_prediction_errors(motion: DiscreteModel, gain: Array, signals: dict[str, Array]) -> Any:
    r"""Return the prediction errors of the model with an observer gain, and the filter behind them.

    .. math:: \hat x_{k+1} = F \hat x_k + \sum_i B_i s_{i,k} + K \varepsilon_k, \quad
        \varepsilon_k = y_k - C \hat x_k

    Parameters
    ----------
    motion : Flow
        The model over one period.
    gain : ndarray
        Observer gain K of the plant's states.
    signals : dict
        Arrays of the signals by name; all of the same length, deviations from a constant.

    Returns
    -------
    errors : ndarray or None
        The errors from state zero on; None if the observer is unstable.
    observer : ndarray
        Denominator of the filter.
    """
    size = len(motion.f)
    k = np.zeros(size)
    k[: motion.order] = gain
    closed = motion.f - np.outer(k, motion.c)
    if not np.isfinite(closed).all():
        return None, np.ones(1)
    poles = np.linalg.eigvals(closed)
    observer = np.real(np.poly(poles))
    if not np.isfinite(poles).all() or np.max(np.abs(poles)) >= 1 - 1e-9:
        return None, observer
    errors = signals["y"].copy()
    for name, late, column in (*motion.inputs, ("y", 0, k)):
        if not np.any(column):
            continue
        # C (zI - closed)^-1 column, whose poles are those of the observer. The numerator is a
        # difference of polynomials, linear in the column: a small column would be lost in it.
        unit = 2.0 ** np.round(np.log2(np.max(np.abs(column))))
        num = (np.real(np.poly(closed - np.outer(column / unit, motion.c))) - observer) * unit
        moved = signal.lfilter(-num, observer, _delay_signal(signals[name], late))
        errors += moved
    return errors, observer


def _delay_signal(s: Array, samples: int) -> Array:
    """Shift a signal later by some samples, or earlier by one; its ends are held."""
    if samples == 0:
        return s
    if samples < 0:
        return np.append(s[-samples:], np.repeat(s[-1], -samples))
    return np.concatenate([np.repeat(s[0], samples), s[:-samples]])
