"""One-input one-output systems as polynomials: what the margins and the lead design share."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq, minimize_scalar

from .._base.arguments import is_number
from .._base.arrays import Array, ComplexArray
from .._base.errors import CtrlidError
from .._base.text import write_count
from ..physics.conversions import require_finite_coefficients, to_polynomials

Function = Callable[[Array], Array]

# A closed-loop pole closer to the stability limit than this share of its size counts as unstable.
AXIS_TOLERANCE = 1e-9
# Values that differ by less than this share may differ by rounding alone.
FLAT = 1e-9


@dataclass(frozen=True, eq=False)
class Rational:
    """A transfer function num/den with real coefficients, highest power first.

    Attributes
    ----------
    num, den : numpy.ndarray
        Coefficients; nothing is cancelled, so that hidden modes stay visible. The degree of `num`
        is at most the degree of `den`.
    dt : float
        Sampling period in seconds, 0 for continuous time.
    """

    num: Array
    den: Array
    dt: float

    def __mul__(self, other: "Rational") -> "Rational":
        return Rational(
            multiply_polynomials(self.num, other.num),
            multiply_polynomials(self.den, other.den),
            self.dt,
        )

    @property
    def order(self) -> int:
        """The number of poles."""
        return len(self.den) - 1

    @property
    def nyquist(self) -> float:
        """The highest frequency that means anything, in rad/s."""
        return math.pi / self.dt if self.dt else math.inf

    def parts(self, omega: npt.ArrayLike) -> tuple[ComplexArray, ComplexArray]:
        """Return num and den at the frequencies omega (rad/s; infinity is allowed)."""
        omega = np.asarray(omega, dtype=float)
        if self.dt:
            point = np.exp(1j * np.minimum(omega, self.nyquist) * self.dt)
            return np.polyval(self.num, point), np.polyval(self.den, point)
        # Above 1 rad/s both are divided by s**order: no overflow, and the limit at infinity is
        # simply the leading coefficients.
        high = omega > 1.0
        s = 1j * np.where(high, 0.0, omega)
        with np.errstate(divide="ignore"):
            inverse = np.where(high, -1j / np.where(high, omega, 1.0), 0.0)
        num = np.concatenate([np.zeros(len(self.den) - len(self.num)), self.num])
        return (
            np.where(high, np.polyval(num[::-1], inverse), np.polyval(num, s)),
            np.where(high, np.polyval(self.den[::-1], inverse), np.polyval(self.den, s)),
        )

    def at(self, omega: npt.ArrayLike) -> ComplexArray:
        """Return the frequency response at omega (rad/s), infinite at poles."""
        num, den = self.parts(omega)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(num / den, dtype=complex)

    def rounding(self, omega: float) -> tuple[float, float]:
        """Return the relative rounding errors of num and den at omega (rad/s), 1 where they vanish.

        At fast sampling both are small differences of large coefficients.
        """
        point = np.exp(1j * omega * self.dt) if self.dt else 1j * omega
        found = []
        for c in (self.num, self.den):
            size, value = np.polyval(np.abs(c), abs(point)), abs(np.polyval(c, point))
            found.append(float(np.finfo(float).eps * size / value) if value > 0 else 1.0)
        return found[0], found[1]

    def zeros(self) -> ComplexArray:
        """Return the roots of num."""
        return find_roots(self.num)

    def poles(self) -> ComplexArray:
        """Return the roots of den."""
        return find_roots(self.den)

    def flipped(self, coefficients: Array) -> Array:
        """Return coefficients of c(-s), or of z**order c(1/z): the conjugate on the boundary."""
        if self.dt:
            return np.concatenate([np.zeros(len(self.den) - len(coefficients)), coefficients])[::-1]
        return coefficients * (-1.0) ** np.arange(len(coefficients))[::-1]

    def hidden(self) -> list[complex]:
        """Return the poles that are cancelled by a zero."""
        zeros = list(self.zeros())
        found = []
        for pole in self.poles():
            if not zeros:
                break
            nearest = int(np.argmin(np.abs(np.array(zeros) - pole)))
            # Poles of a fast-sampled plant crowd around z = 1, at distances of |s| dt.
            scale = min(abs(pole), abs(pole - 1)) if self.dt else abs(pole)
            if abs(zeros[nearest] - pole) <= 1e-8 * scale + 1e-14 * bool(self.dt):
                found.append(complex(pole))
                del zeros[nearest]
        return found

    def reduced(self) -> "Rational":
        """Return the same transfer function without its hidden modes."""
        if not (hidden := self.hidden()):
            return self
        part = make_real_polynomial(hidden)
        num, den = (np.polydiv(c, part)[0].astype(float) for c in (self.num, self.den))
        return Rational(num, den, self.dt)


def to_rational(system: Any, name: str) -> Rational:
    """Return `system` as polynomials, or refuse and say what `name` has to be."""
    if is_number(system):
        system = ct.tf([float(system)], [1.0], 0)
    if not isinstance(system, ct.TransferFunction | ct.StateSpace):
        hint = ": linearize it first" if isinstance(system, ct.NonlinearIOSystem) else ""
        raise CtrlidError(
            f"{name} is a {type(system).__name__}; needed is a linear system "
            f"(control.TransferFunction or control.StateSpace){hint}."
        )
    if (system.ninputs, system.noutputs) != (1, 1):
        raise CtrlidError(
            f"{name} has {write_count(system.ninputs, 'input')} and "
            f"{write_count(system.noutputs, 'output')}; needed is one of "
            f"each: pick a channel, for example {name}[0, 0]."
        )
    if system.dt is True:
        raise CtrlidError(
            f"{name} is discrete with no sampling period (dt=True), so frequencies in rad/s are "
            f"not defined; give it one in seconds, for example dt=0.001."
        )
    require_finite_coefficients(system, name)
    dt = float(system.dt or 0.0)
    if isinstance(system, ct.StateSpace):
        (num,), den = to_polynomials(system.A, system.B, system.C, system.D)
    else:
        num, den = (np.array(part[0][0]) for part in (system.num, system.den))
    num, den = num.astype(float), den.astype(float)
    num, den = _drop_dust(num, den, dt)
    if len(num) > len(den):
        raise CtrlidError(
            f"{name} is improper (degree {len(num) - 1} over {len(den) - 1}), so it answers a step "
            f"with an impulse; needed are at least as many poles as zeros: add a filter pole."
        )
    return Rational(num, den, dt)


def _drop_dust(num: Array, den: Array, dt: float) -> tuple[Array, Array]:
    """Drop leading coefficients that are rounding errors of a conversion."""
    den = np.trim_zeros(den, "f")
    scale = 1.0 if dt else float(max(np.abs(find_roots(den)), default=1.0) or 1.0)
    weights = np.abs(num) * scale ** np.arange(len(num), dtype=float)[::-1]
    keep = np.flatnonzero(weights > 1e-13 * max(weights))
    return (num[keep[0] :] if len(keep) else np.zeros(1)), den


def require_same_time_base(first: Rational, second: Rational, names: str) -> None:
    """Refuse systems that do not run on the same clock."""
    if not math.isclose(first.dt, second.dt, rel_tol=1e-9):
        raise CtrlidError(
            f"{names} have different time bases (dt = {first.dt:g} s and {second.dt:g} s, 0 "
            f"meaning continuous); sample one like the other first, for example with control.c2d."
        )


def multiply_polynomials(first: Array, second: Array) -> Array:
    """Return the product of two polynomials."""
    return np.convolve(first, second)


def find_roots(polynomial: npt.ArrayLike) -> ComplexArray:
    """Return the roots of a polynomial, none for a constant."""
    c = np.atleast_1d(np.asarray(polynomial))
    size = float(np.max(np.abs(c), initial=0.0))
    if not 0 < size < math.inf:
        return np.zeros(0, dtype=complex)
    with np.errstate(under="ignore"):
        c = c / size
    # A root beyond 1e300 is at infinity.
    return np.asarray(np.roots(np.where(np.abs(c) < 1e-300, 0.0, c)), dtype=complex)


def make_real_polynomial(zeros: Iterable[complex]) -> Array:
    """Return the monic real polynomial with these roots."""
    return np.atleast_1d(np.real(np.poly(np.array(list(zeros), dtype=complex)))).astype(float)


def to_s(points: ComplexArray, dt: float) -> ComplexArray:
    """Return the s-plane picture of poles or zeros (s itself, or log(z)/dt)."""
    if not dt:
        return points
    return np.asarray(np.log(points[np.abs(points) > 1e-12]) / dt, dtype=complex)


def are_resolved(s: ComplexArray, dt: float) -> npt.NDArray[np.bool_]:
    """Tell which roots set a time scale, and are not integrators but for rounding errors."""
    sizes = np.where(np.isfinite(s), np.abs(s), 0.0)
    return np.asarray(sizes > 1e-7 * (1 / dt if dt else max(sizes, default=0.0)))


def find_time_scales(polynomial: npt.ArrayLike, dt: float) -> ComplexArray:
    """Return the roots that set a time scale, in the s-plane.

    Those of an integrator do not. In continuous time they are zero; in discrete time they lie at
    z = 1 as nearly as the rounding of the coefficients lets them be found.
    """
    c = np.trim_zeros(np.atleast_1d(np.asarray(polynomial)), "f")
    roots = find_roots(c)
    if not dt:
        return roots[(np.abs(roots) > 0) & np.isfinite(roots)]
    roots = roots[np.abs(roots) > 1e-12]
    with np.errstate(all="ignore"):
        moved = np.polyval(np.abs(c), np.abs(roots)) / np.abs(np.polyval(np.polyder(c), roots))
        resolved = np.abs(roots - 1) > 10 * np.finfo(float).eps * moved
    return to_s(roots[resolved], dt)


def is_stable(points: ComplexArray, dt: float) -> bool:
    """Tell whether all points lie clearly inside the stability region."""
    if dt:
        return bool(np.all(np.abs(points) < 1 - AXIS_TOLERANCE * np.abs(points - 1) - 1e-13))
    return bool(np.all(points.real < -AXIS_TOLERANCE * np.abs(points)))


def find_closed_loop_poles(loop: Rational) -> ComplexArray | None:
    """Return the roots of num + den, hidden modes included; None where the loop is ill-posed."""
    total = np.polyadd(loop.num, loop.den)
    if abs(total[0]) <= 1e-12 * abs(loop.den[0]) or len(total) < len(loop.den):
        return None
    return find_roots(total)


def make_frequency_grid(
    dt: float, acting: Iterable[npt.ArrayLike], special: Iterable[npt.ArrayLike] = ()
) -> Array:
    """Return a grid in rad/s, dense wherever the roots of the `acting` polynomials act.

    A resonance at |Im s| is as narrow as |Re s|, so each root brings its own points. Roots of the
    `special` polynomials are single points; they may be far off, so they do not set the range.
    """
    s = np.concatenate([find_time_scales(p, dt) for p in acting])
    points = [np.abs(to_s(find_roots(p), dt).imag) for p in special]
    return make_grid_of_roots(dt, s, points)


def make_grid_of_roots(dt: float, s: ComplexArray, points: Iterable[Array] = ()) -> Array:
    """Return a grid in rad/s, dense wherever roots in the s-plane act, with further points.

    A resonance at |Im s| is as narrow as |Re s|, so each root brings its own points.
    """
    sizes = np.abs(s) if len(s) else np.array([1.0 / dt if dt else 1.0])
    top = math.pi / dt if dt else 1e3 * float(max(sizes))
    bottom = 1e-3 * min(float(min(sizes)), top)
    offsets = np.concatenate([[0.0], np.geomspace(0.01, 30.0, 25)])
    offsets = np.concatenate([-offsets, offsets])
    near = (np.abs(s.imag)[:, None] + np.abs(s.real)[:, None] * offsets).ravel()
    count = 30 * math.ceil(math.log10(top / bottom)) + 1
    grid = np.concatenate([np.geomspace(bottom, top, count), near, sizes, *points])
    return np.unique(grid[(grid >= bottom) & (grid <= top)])


def find_smallest(function: Function, grid: Array, ends: tuple[float, ...]) -> tuple[float, float]:
    """Return (frequency, value) of the minimum over grid and ends, refined between grid points."""
    values = function(grid)
    dips = [
        k
        for k in range(1, len(grid) - 1)
        if values[k] <= values[k - 1] and values[k] <= values[k + 1]
    ]
    best = int(np.argmin(values))
    found = [(float(grid[best]), float(values[best]))]
    found += [(end, float(function(np.array([end]))[0])) for end in ends]
    # Only dips that can still win are worth refining.
    for k in sorted(dips, key=lambda k: float(values[k]))[:8]:
        # Points that differ by rounding do not tell on which side of them the minimum lies.
        higher = np.flatnonzero(values > values[k] + FLAT * abs(values[k]))
        below, above = higher[higher < k], higher[higher > k]
        low, high = below[-1] if below.size else 0, above[0] if above.size else len(grid) - 1
        fine = minimize_scalar(
            lambda x: float(function(np.array([math.exp(x)]))[0]),
            bounds=(math.log(grid[low]), math.log(grid[high])),
            method="bounded",
            options={"xatol": 1e-10},
        )
        found.append((math.exp(fine.x), float(fine.fun)))
    return min(found, key=lambda pair: pair[1])


def find_crossings(function: Function, grid: Array) -> list[float]:
    """Return the frequencies where the function changes sign or touches zero."""
    values = function(grid)
    values[np.abs(values) < 1e-13] = 0.0
    found = [float(w) for w in grid[values == 0]]
    found += [
        # The sign may jump at a pole, where brentq falls back to (slow) bisection.
        brentq(
            lambda w: float(function(np.array([w]))[0]),
            grid[k],
            grid[k + 1],
            xtol=1e-300,
            rtol=1e-15,
            maxiter=1000,
        )
        for k in np.flatnonzero(values[:-1] * values[1:] < 0)
    ]
    return sorted(found)
