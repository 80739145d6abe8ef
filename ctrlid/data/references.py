"""Excitation signals: what a reference or an injected input is made of."""

import math
import operator
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from .._base.arguments import explain_names, is_number
from .._base.arrays import Array, to_real_array
from .._base.errors import CtrlidError

# Feedback taps of maximum-length shift registers, by number of stages (XAPP 052 of Xilinx).
_TAPS = {
    2: (2, 1),
    3: (3, 2),
    4: (4, 3),
    5: (5, 3),
    6: (6, 5),
    7: (7, 6),
    8: (8, 6, 5, 4),
    9: (9, 5),
    10: (10, 7),
    11: (11, 9),
    12: (12, 6, 4, 1),
    13: (13, 4, 3, 1),
    14: (14, 5, 3, 1),
    15: (15, 14),
    16: (16, 15, 13, 4),
    17: (17, 14),
    18: (18, 11),
    19: (19, 6, 2, 1),
    20: (20, 17),
}

# A signal of more samples than this takes gigabytes, and is a slip of the keyboard.
MOST = 10**8


@explain_names
def random_binary(
    n: int, *, amplitude: float, hold: int = 1, around: float = 0.0, seed: int | None = None
) -> Array:
    r"""Return a random binary signal: a coin is tossed every `hold` samples.

    .. math:: r_k = r_0 \pm a, \quad \text{the sign new at } k = 0, h, 2h, \dots

    All its power is within a known amplitude, and with a longer hold it moves to lower
    frequencies: the spectrum falls off above about 1 / (2 hold) of the sampling rate.

    Parameters
    ----------
    n : int
        Number of samples; it need not be a multiple of `hold`.
    amplitude : float
        Distance a from the centre, in the unit of the signal; positive.
    hold : int
        Samples for which each toss is kept.
    around : float
        The centre r0, in the unit of the signal; for a reference the operating point's output.
    seed : int, optional
        Of the random numbers; the same seed gives the same signal.

    Returns
    -------
    numpy.ndarray
        The signal, shape ``(n,)``, in the unit of `amplitude`.

    Raises
    ------
    CtrlidError
        If a count is not a positive integer or a level not a finite number.

    Notes
    -----
    L. Ljung, *System Identification: Theory for the User*, 2nd ed., section 13.3.

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.random_binary(8, amplitude=0.5, hold=2, around=3.0, seed=1)
    array([2.5, 2.5, 3.5, 3.5, 3.5, 3.5, 3.5, 3.5])
    """
    n, hold = _check_count(n, "n"), _check_count(hold, "hold")
    amplitude, around = _check_positive(amplitude, "amplitude"), _check_level(around, "around")
    tosses = _make_generator(seed).integers(0, 2, size=-(-n // hold))
    levels = np.where(tosses == 1, around + amplitude, around - amplitude)
    return np.asarray(np.repeat(levels, min(hold, n))[:n], dtype=float)


@explain_names
def staircase(n: int, *, levels: Sequence[float] | npt.ArrayLike, hold: int) -> Array:
    """Return a staircase: each level for `hold` samples, over and over.

    Parameters
    ----------
    n : int
        Number of samples.
    levels : sequence of float
        The values, in order, in the unit of the signal; after the last one the first follows.
    hold : int
        Samples on each level; long enough for the loop to settle, if its gain is of interest.

    Returns
    -------
    numpy.ndarray
        The signal, shape ``(n,)``, in the unit of `levels`.

    Raises
    ------
    CtrlidError
        If a count is not a positive integer or `levels` not a list of finite numbers.

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.staircase(7, levels=[0.0, 1.0, 0.5], hold=2)
    array([0. , 0. , 1. , 1. , 0.5, 0.5, 0. ])
    """
    n, hold = _check_count(n, "n"), _check_count(hold, "hold")
    try:
        values = to_real_array(levels, "levels")
    except (TypeError, ValueError):
        values = np.array(math.nan)
    if values.ndim != 1 or not len(values) or not np.isfinite(values).all():
        raise CtrlidError(f"levels is {levels!r}; needed is a list of finite numbers.")
    return np.asarray(values[(np.arange(n) // hold) % len(values)], dtype=float)


@explain_names
def multisine(
    n: int,
    *,
    amplitude: float,
    period: int | None = None,
    band: tuple[float, float] = (0.0, 1.0),
    phases: Literal["schroeder", "random"] = "schroeder",
    around: float = 0.0,
    seed: int | None = None,
) -> Array:
    r"""Return a periodic sum of sines, equally strong on all lines of a frequency band.

    .. math:: r_k = r_0 + c \sum_{i \in \text{band}} \cos(2 \pi i k / N + \varphi_i)

    Every period is the same, sample by sample, so that averaging periods removes noise and their
    spread measures it; nothing is excited outside the band.

    Parameters
    ----------
    n : int
        Number of samples; several periods if it is larger than `period`.
    amplitude : float
        The largest distance from the centre over one period, in the unit of the signal; positive.
    period : int, optional
        Samples in one period, N; `n` if not given. The lines are 1/N of the sampling rate apart.
    band : tuple of float
        Lowest and highest frequency as shares of the Nyquist frequency, between 0 and 1. The
        constant and the Nyquist line itself are never excited.
    phases : {"schroeder", "random"}
        Schroeder's phases pack the most power into the amplitude; random ones are uniformly drawn
        and make independent realisations, for telling nonlinearity from noise.
    around : float
        The centre r0, in the unit of the signal.
    seed : int, optional
        Of the random phases.

    Returns
    -------
    numpy.ndarray
        The signal, shape ``(n,)``, in the unit of `amplitude`.

    Raises
    ------
    CtrlidError
        If a count, a level or the band is out of range, no line lies in the band, or the kind of
        phases is unknown.

    Notes
    -----
    M. Schroeder, "Synthesis of low-peak-factor signals and binary sequences with low
    autocorrelation", IEEE Transactions on Information Theory 16(1), 85-89, 1970. R. Pintelon and
    J. Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed., section 4.3.

    Examples
    --------
    >>> import ctrlid as cid
    >>> r = cid.multisine(300, amplitude=1.0, period=100, band=(0.0, 0.2))
    >>> bool(abs(r[:100] - r[100:200]).max() == 0.0), float(abs(r).max().round(12))
    (True, 1.0)
    """
    n = _check_count(n, "n")
    period = n if period is None else _check_count(period, "period")
    amplitude, around = _check_positive(amplitude, "amplitude"), _check_level(around, "around")
    generator = _make_generator(seed)
    try:
        low, high = map(float, to_real_array(band, "band"))
    except (TypeError, ValueError):
        low = high = math.nan
    if not 0 <= low < high <= 1:
        raise CtrlidError(
            f"band is {band!r}; needed are two shares of the Nyquist frequency, "
            f"0 <= lowest < highest <= 1."
        )
    # Line i is at the share 2 i / period of the Nyquist frequency; the allowance is for rounding.
    first = max(1, math.ceil(low * period / 2 - 1e-9))
    last = min((period - 1) // 2, math.floor(high * period / 2 + 1e-9))
    if last < first:
        raise CtrlidError(
            f"no line of a period of {period} samples lies in the band {low:g} to {high:g}; lines "
            f"are {2 / period:.3g} of the Nyquist frequency apart: widen the band or the period."
        )
    count = last - first + 1
    phases = phases if isinstance(phases, str) else repr(phases)
    if phases == "schroeder":
        index = np.arange(1, count + 1)
        angles = -np.pi * index * (index - 1) / count
    elif phases == "random":
        angles = generator.uniform(0, 2 * np.pi, count)
    else:
        raise CtrlidError(f'phases is {phases!r}; needed is "schroeder" or "random".')
    spectrum = np.zeros(period // 2 + 1, dtype=complex)
    spectrum[first : last + 1] = np.exp(1j * angles)
    wave = np.fft.irfft(spectrum, period)
    wave *= amplitude / np.max(np.abs(wave))
    return around + wave[np.arange(n) % period]


@explain_names
def prbs(
    n: int, *, amplitude: float, order: int, hold: int = 1, around: float = 0.0, seed: int = 1
) -> Array:
    r"""Return a pseudo-random binary sequence of maximum length.

    .. math:: b_k = b_{k - i_1} \oplus b_{k - i_2} \oplus \cdots, \quad
        r_k = r_0 + a (2 b_{\lfloor k/h \rfloor} - 1)

    A shift register with feedback that runs through all its states but zero, so the signal has
    the period (2^order - 1) hold and, over it, the flattest spectrum a binary signal can have.

    Parameters
    ----------
    n : int
        Number of samples.
    amplitude : float
        Distance a from the centre, in the unit of the signal; positive.
    order : int
        Stages of the register, 2 to 20.
    hold : int
        Samples for which each bit is kept, h.
    around : float
        The centre r0, in the unit of the signal.
    seed : int
        The register's first state, 1 to 2^order - 1: it shifts the sequence in time.

    Returns
    -------
    numpy.ndarray
        The signal, shape ``(n,)``, in the unit of `amplitude`.

    Raises
    ------
    CtrlidError
        If a count, a level, the order or the seed is out of range.

    Notes
    -----
    L. Ljung, *System Identification: Theory for the User*, 2nd ed., section 13.3. One period has
    one more sample at the upper level than at the lower, so its mean is a / (2^order - 1).

    Examples
    --------
    >>> import ctrlid as cid
    >>> cid.prbs(7, amplitude=1.0, order=3)
    array([ 1., -1., -1.,  1., -1.,  1.,  1.])
    """
    n, order, hold = _check_count(n, "n"), _check_count(order, "order"), _check_count(hold, "hold")
    amplitude, around = _check_positive(amplitude, "amplitude"), _check_level(around, "around")
    if order not in _TAPS:
        raise CtrlidError(f"order is {order}; needed is a number of stages from 2 to 20.")
    length = 2**order - 1
    state = _check_count(seed, "seed")
    if state > length:
        raise CtrlidError(f"seed is {seed}; needed for order {order} is one from 1 to {length}.")
    bits = np.empty(min(-(-n // hold), length))
    for k in range(len(bits)):
        bits[k] = state & 1
        feedback = 0
        for tap in _TAPS[order]:
            feedback ^= state >> (order - tap)
        state = (state >> 1) | ((feedback & 1) << (order - 1))
    levels = np.where(bits == 1, around + amplitude, around - amplitude)
    return np.asarray(levels[(np.arange(n) // hold) % length], dtype=float)


def _check_count(value: Any, name: str) -> int:
    try:
        number = operator.index(value)
    except TypeError:
        number = 0
    if isinstance(value, bool) or number < 1:
        counted = "" if name in ("order", "seed") else " of samples"
        raise CtrlidError(f"{name} is {value!r}; needed is a whole number{counted}, at least 1.")
    if number > MOST:
        raise CtrlidError(f"{name} is {value!r}; needed are at most {MOST:g} samples.")
    return number


def _check_level(value: Any, name: str) -> float:
    number = float(value) if is_number(value) else math.nan
    if not math.isfinite(number):
        raise CtrlidError(f"{name} is {value!r}; needed is a finite number, in the unit of the "
                          "signal.")  # fmt: skip
    return number


def _check_positive(value: Any, name: str) -> float:
    number = _check_level(value, name)
    if number <= 0:
        raise CtrlidError(f"{name} is {value!r}; needed is a number above 0, in the unit of the "
                          "signal.")  # fmt: skip
    return number


def _make_generator(seed: Any) -> np.random.Generator:
    try:
        return np.random.default_rng(seed)
    except (TypeError, ValueError):
        raise CtrlidError(
            f"seed is {seed!r}; needed is a whole number from 0 upwards, or None."
        ) from None
