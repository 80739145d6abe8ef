"""A measured, band-limited signal between its samples."""

from typing import Any

import numpy as np
from scipy import signal

from .validity import find_runs

# Straight pieces per sampling period. Up to the Nyquist frequency, what the corners add lies above
# seven times that frequency, and below 2.1 % of the signal.
PIECES = 4
# The signal is continued beyond its ends by so many samples, so that the ends ring less. The
# prediction takes this order; on signals up to 0.65 times the Nyquist frequency it errs below 1e-4.
BEYOND = 100
ORDER = 32


def count_pieces(hold: str) -> int:
    """Return in how many straight pieces an input runs over a sampling period."""
    return PIECES if hold == "bandlimited" else 1


def reconstruct_signal(u: Any, valid: Any = None) -> Any:
    r"""Return the corners of the straight pieces that stand for a band-limited signal.

    .. math:: U_{fine}(\omega) = U(\omega) / \operatorname{sinc}^2(\omega h / 2), \quad h = T / 4

    below the Nyquist frequency, zero above: the line through the corners has exactly the spectrum
    of the signal there. The signal is continued beyond both ends by linear prediction and fades.

    Parameters
    ----------
    u : array_like, shape (n,)
        The samples.
    valid : array_like of bool, shape (n,), optional
        Which of them count; each stretch that does is reconstructed by itself, the others are held.

    Returns
    -------
    ndarray, shape (n * PIECES,)
        Values at the times ``k * dt / PIECES``.

    References
    ----------
    Unser, *Sampling -- 50 years after Shannon*, Proceedings of the IEEE 88 (2000) 569-587.
    """
    u = np.asarray(u, dtype=float)
    fine = np.repeat(u, PIECES)
    for first, stop in zip(*find_runs(np.ones(len(u), bool) if valid is None else valid),
                           strict=True):  # fmt: skip
        if np.ptp(u[first:stop]):
            fine[first * PIECES : stop * PIECES] = _reconstruct_stretch(u[first:stop])
    return fine


def _reconstruct_stretch(u: Any) -> Any:
    level = float(np.mean(u))
    v = u - level
    coefficients = _predict_linearly(v, min(ORDER, len(v) // 3))
    before, after = _continue_signal(v[::-1], coefficients)[::-1], _continue_signal(v, coefficients)
    long = np.concatenate([before, v, after])
    n = len(long)
    spectrum = np.fft.rfft(long)
    spectrum /= np.sinc(np.arange(len(spectrum)) / (n * PIECES)) ** 2
    if n % 2 == 0:
        # A line at the Nyquist frequency itself has no known phase; half of it is each alias.
        spectrum[-1] /= 2
    fine = PIECES * np.fft.irfft(spectrum, n * PIECES)
    return level + fine[BEYOND * PIECES : (BEYOND + len(u)) * PIECES]


def _predict_linearly(v: Any, order: int) -> Any:
    """Return the stable filter whose errors both ways are smallest, by Burg's recursion."""
    a, forward, backward = np.ones(1), v[1:], v[:-1]
    for _ in range(order):
        power = float(forward @ forward + backward @ backward)
        if not power > 0:
            break
        k = -2 * float(forward @ backward) / power
        a = np.append(a, 0.0)
        a = a + k * a[::-1]
        forward, backward = forward[1:] + k * backward[1:], backward[:-1] + k * forward[:-1]
    return a


def _continue_signal(v: Any, a: Any) -> Any:
    """Return what linear prediction puts behind a signal, faded out."""
    order = len(a) - 1
    past = signal.lfiltic([1.0], a, v[::-1][:order])
    onward, _ = signal.lfilter([1.0], a, np.zeros(BEYOND), zi=past)
    return onward * (0.5 + 0.5 * np.cos(np.pi * np.arange(1, BEYOND + 1) / (BEYOND + 1)))
