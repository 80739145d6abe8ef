"""Linear systems as polynomials, as state matrices and at the samples.

`canonical` is the other way to states: symbols whose coefficients are named parameters.
"""

from fractions import Fraction
from typing import Any

import control as ct
import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from .._base.arrays import Array
from .._base.errors import CtrlidError

# A coefficient so much smaller than the others, at the fastest pole, is zero but for rounding.
ROUNDING = 1e-14
# A pulse response is taken for so many samples at most.
LONGEST = 100


def require_finite_coefficients(system: Any, name: str) -> None:
    """Refuse a linear system in which a coefficient is no finite number.

    Parameters
    ----------
    system : control.TransferFunction or control.StateSpace
        Others have no coefficients, and pass.
    name : str
        What it is called in the message.

    Raises
    ------
    CtrlidError
        If a coefficient is NaN or infinite.
    """
    parts: list[Any] = []
    if isinstance(system, ct.StateSpace):
        parts = [system.A, system.B, system.C, system.D]
    elif isinstance(system, ct.TransferFunction):
        parts = [one for table in (system.num, system.den) for row in table for one in row]
    if not all(np.isfinite(np.asarray(part, dtype=float)).all() for part in parts):
        raise CtrlidError(
            f"{name} has coefficients that are NaN or infinite. Replace them by finite numbers"
        )


def to_polynomials(
    a: ArrayLike, b: ArrayLike, c: ArrayLike, d: ArrayLike
) -> tuple[list[Array], Array]:
    r"""Return the polynomials of state equations with one output.

    .. math:: \frac{b_j(s)}{a(s)} = C (s I - A)^{-1} B_j + D_j, \quad
        M_k = A M_{k-1} + a_{k-1} I, \quad a_k = -\tfrac1k \operatorname{tr} A M_k

    The recursion of Faddeev and LeVerrier on whole numbers, which all entries are but for a power
    of two: every coefficient is rounded once, at the end. What is exactly zero stays zero, and the
    small numerators of fast sampling keep their digits.

    Parameters
    ----------
    a, b, c, d : array_like
        State matrices, of shapes (n, n), (n, inputs), (1, n) and (1, inputs).

    Returns
    -------
    numerators : list of ndarray, shape (n + 1,)
        One for each input, in falling powers.
    denominator : ndarray, shape (n + 1,)
        Monic, the same for all inputs. All coefficients are NaN if an entry is NaN or infinite.

    References
    ----------
    Gantmacher, *The Theory of Matrices*, volume 1, chapter IV, section 5.

    Examples
    --------
    >>> to_polynomials([[0.0, 1.0], [-6.0, -5.0]], [[0.0], [1.0]], [[2.0, 0.0]], [[0.0]])
    ([array([0., 0., 2.])], array([1., 5., 6.]))
    """
    if not all(np.isfinite(np.asarray(m, dtype=float)).all() for m in (a, b, c, d)):
        unknown = np.full(np.shape(a)[0] + 1, np.nan)
        return [unknown.copy() for _ in range(np.shape(b)[1])], unknown
    (A, p), (B, q), (C, r) = _whole_numbers(a), _whole_numbers(b), _whole_numbers(c)
    direct = [Fraction(v) for v in np.asarray(d, dtype=float).ravel().tolist()]
    n = len(A)
    den = [Fraction(1)]
    numerators = [[v] for v in direct]
    m, last = np.zeros((n, n), dtype=object), 1
    for k in range(1, n + 1):
        m = A @ m + last * np.eye(n, dtype=int).astype(object)
        # The trace of integers is divisible by k in the recursion of Faddeev and LeVerrier.
        last = -int(np.trace(A @ m)) // k
        den.append(Fraction(last, p**k))
        for num, v, gain in zip(numerators, direct, (C @ m @ B).ravel(), strict=True):
            num.append(Fraction(int(gain), p ** (k - 1) * q * r) + v * den[-1])
    return [np.array(num, dtype=float) for num in numerators], np.array(den, dtype=float)


def _whole_numbers(matrix: ArrayLike) -> tuple[Any, int]:
    """Return a matrix times the smallest power of two that makes it whole, and that power."""
    entries = np.asarray(matrix, dtype=float)
    ratios = [v.as_integer_ratio() for v in entries.ravel().tolist()]
    power = max((under for _, under in ratios), default=1)
    whole = np.array([over * (power // under) for over, under in ratios], dtype=object)
    return whole.reshape(entries.shape), power


def to_transfer_function(system: Any) -> Any:
    """Return a linear system of one input and one output as a transfer function and nothing else.

    Parameters
    ----------
    system : control.TransferFunction or control.StateSpace
        The system; what a fit carries along is left behind.

    Returns
    -------
    control.TransferFunction
        With the sampling period of the system.

    Examples
    --------
    >>> G = to_transfer_function(ct.ss([[-2.0]], [[3.0]], [[1.0]], [[0.0]]))
    >>> G.num[0][0].tolist(), G.den[0][0].tolist()
    ([3.0], [1.0, 2.0])
    """
    if isinstance(system, ct.TransferFunction):
        return ct.tf(system.num, system.den, system.dt)
    (num,), den = to_polynomials(system.A, system.B, system.C, system.D)
    return ct.tf(num, den, system.dt)


def to_state_matrices(system: Any) -> tuple[Array, Array, Array, Array]:
    """Return state matrices of a linear system; each of its entries has states of its own.

    Parameters
    ----------
    system : control.StateSpace or control.TransferFunction
        The system, with no more zeros than poles.

    Returns
    -------
    a, b, c, d : ndarray
        Of shapes (n, n), (n, inputs), (outputs, n) and (outputs, inputs); those of a state space
        as they are.

    Raises
    ------
    CtrlidError
        If the system has more zeros than poles.
    """
    if isinstance(system, ct.StateSpace):
        return system.A, system.B, system.C, system.D
    rows = []
    for nums, dens in zip(system.num, system.den, strict=True):
        parts = []
        for num, den in zip(nums, dens, strict=True):
            if len(np.trim_zeros(num, "f")) > len(np.trim_zeros(den, "f")):
                raise CtrlidError(
                    f"{system.name} has more zeros than poles, so that it would differentiate "
                    "without a filter: add the pole that the real one has"
                )
            parts.append(_realize_fraction(num, den, system.dt))
        a, b, c, d = zip(*parts, strict=True)
        rows.append((linalg.block_diag(*a), linalg.block_diag(*b), np.hstack(c), np.hstack(d)))
    if len(rows) == 1:
        return rows[0]
    a, b, c, d = zip(*rows, strict=True)
    return linalg.block_diag(*a), np.vstack(b), linalg.block_diag(*c), np.vstack(d)


def _realize_fraction(num: Array, den: Array, dt: float | None) -> tuple[Array, ...]:
    """Return the controller form of a fraction of polynomials (Kailath, Linear Systems, 2.2).

    A first coefficient of the numerator that is zero but for rounding is left out: it would let
    the input through without delay. SciPy judges it by its size, whatever the units, and warns.
    """
    num, den = np.trim_zeros(num, "f"), np.trim_zeros(den, "f")
    if not len(num):
        return np.empty((0, 0)), np.empty((0, 1)), np.empty((1, 0)), np.zeros((1, 1))
    n = len(den) - 1
    fastest = 1.0 if dt else max(np.abs(np.roots(den)), default=1.0) or 1.0
    parts = np.abs(num) * fastest ** np.arange(len(num))[::-1]
    first = int(np.argmax(parts > ROUNDING * np.max(parts)))
    num = np.pad(num[first:], (n + 1 - len(num) + first, 0)) / den[0]
    den = den / den[0]
    a = linalg.companion(den) if n else np.empty((0, 0))
    return a, np.eye(n, 1), (num[1:] - num[0] * den[1:])[None], num[:1, None]


def reduce_states(a: Array, b: Array, c: Array, order: int) -> tuple[Array, Array, Array]:
    r"""Return a system in discrete time with fewer states, from its pulse response.

    .. math:: H_{ij} = C A^{i+j} B = O R, \quad O_{i+1} = O_i A

    The block Hankel matrix H, each output and input scaled to size one, is factored by its largest
    singular values (Ho and Kalman; Kung). It is so long that an unstable mode grows by no more than
    a factor of about seven.

    Parameters
    ----------
    a, b, c : ndarray
        State matrices.
    order : int
        Number of states to keep.

    Returns
    -------
    a, b, c : ndarray
        State matrices of that order.

    References
    ----------
    Kung, "A new identification and model reduction algorithm via singular value decomposition",
    Proc. 12th Asilomar Conference (1978).

    Examples
    --------
    >>> twice = np.diag([0.5, 0.5])
    >>> a, b, c = reduce_states(twice, np.ones((2, 1)), np.eye(2), 1)
    >>> a.round(12).tolist(), np.round(c @ b, 12).tolist()
    ([[0.5]], [[1.0], [1.0]])
    """
    p, m = len(c), b.shape[1]
    growth = float(np.log(np.max(np.abs(np.linalg.eigvals(a)))))
    size = int(np.clip(1.0 / growth if growth > 0 else LONGEST, 2 * order, LONGEST))
    pulses = [c @ b]
    state = b
    for _ in range(2 * size - 2):
        state = a @ state
        pulses.append(c @ state)
    response = np.array(pulses)
    rows = np.sqrt(np.sum(response**2, axis=(0, 2)))
    rows = np.where(rows > 0, rows, 1.0)
    columns = np.sqrt(np.sum((response / rows[:, None]) ** 2, axis=(0, 1)))
    columns = np.where(columns > 0, columns, 1.0)
    scaled = response / rows[:, None] / columns
    hankel = np.block([[scaled[i + j] for j in range(size)] for i in range(size)])
    left, values, right = np.linalg.svd(hankel, full_matrices=False)
    root = np.sqrt(values[:order])
    seen, reached = left[:, :order] * root, root[:, None] * right[:order]
    moved = np.linalg.lstsq(seen[:-p], seen[p:], rcond=None)[0]
    return moved, reached[:, :m] * columns, rows[:, None] * seen[:p]


def sample_held(system: Any, dt: float) -> Any:
    """Return what a system in continuous time is at the samples, its input held between them.

    Parameters
    ----------
    system : control.TransferFunction or control.StateSpace
        The system, of one input and one output.
    dt : float
        Sampling period [s].

    Returns
    -------
    control.TransferFunction
        In discrete time.

    Examples
    --------
    >>> G = sample_held(ct.tf([1.0], [1.0, 0.0, 0.0]), 0.1)
    >>> G.num[0][0].round(12).tolist(), G.den[0][0].tolist()
    ([0.005, 0.005], [1.0, -2.0, 1.0])
    """
    return to_transfer_function(ct.sample_system(ct.ss(*to_state_matrices(system)), dt, "zoh"))
