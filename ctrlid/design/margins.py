"""How far a loop is from instability: margins, the nu-gap and the robust stability margin."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._base.arguments import explain_names
from .._base.arrays import Array, ComplexArray
from .._base.rounding import keep_numpy_quiet
from .._base.text import Printed
from .rational import (
    Rational,
    find_closed_loop_poles,
    find_crossings,
    find_roots,
    find_smallest,
    is_stable,
    make_frequency_grid,
    require_same_time_base,
    to_rational,
)


@dataclass(frozen=True, repr=False)
class Margins(Printed):
    """Distances of one feedback loop from instability, the worst of all crossovers.

    For an unstable loop `stable` is False and every number is NaN: there is no margin to speak of.

    Parameters
    ----------
    stable : bool
        Whether all closed-loop poles, hidden ones included, are clearly stable.
    crossover : float
        The gain crossover, size of L = 1, at which the phase margin is smallest, in rad/s; NaN
        if there is none.
    phase_margin : float
        Degrees between L and -1 at that crossover, never negative: the smallest phase change,
        lag or lead, that reaches the stability limit. Infinite without a crossover.
    gain_margin : float
        The smallest factor above 1 on L that reaches the stability limit; infinite if none does.
    gain_reduction_margin : float
        The largest factor below 1 that does: an unstable plant needs its loop gain; 0 if none does.
    modulus_margin : float
        The smallest distance [1] of L from -1 over all frequencies, that is 1/Ms.
    delay_margin : float
        The smallest extra delay, in seconds, that reaches the stability limit; 0 if the loop gain
        stays above 1 up to infinite frequency, infinite without a crossover.
    """

    stable: bool
    crossover: float
    phase_margin: float
    gain_margin: float
    gain_reduction_margin: float
    modulus_margin: float
    delay_margin: float

    def __str__(self) -> str:
        if not self.stable:
            return "THE LOOP IS UNSTABLE and so has no margins."
        rows = (
            ("crossover [rad/s]", self.crossover),
            ("phase margin [deg]", self.phase_margin),
            ("gain margin [factor]", self.gain_margin),
            ("gain reduction margin [factor]", self.gain_reduction_margin),
            ("modulus margin [1]", self.modulus_margin),
            ("delay margin [s]", self.delay_margin),
        )
        values = ("none" if math.isnan(v) else f"{v:.4g}" for _, v in rows)
        return "\n".join(
            f"{label:<32}{value:>10}" for (label, _), value in zip(rows, values, strict=True)
        )


UNSTABLE = Margins(False, *(math.nan,) * 6)


@explain_names
@keep_numpy_quiet
def loop_margins(L: Any) -> Margins:
    r"""Return the margins of the loop with negative feedback around L.

    .. math:: 1 + L(s) = 0, \quad L = C P

    The closed-loop poles come first: margins of an unstable loop are NaN, whatever its frequency
    response looks like. Then *all* crossovers of the gain and of the negative real axis are found
    (also those at zero, infinite and Nyquist frequency), and the worst of each kind is kept.

    Parameters
    ----------
    L : control.TransferFunction or control.StateSpace
        The open loop, one input and one output, continuous or discrete with its period; poles and
        zeros anywhere. Multiply controller and plant without cancelling, so that a hidden unstable
        mode stays visible.

    Returns
    -------
    Margins
        Frequencies in rad/s, phases in degrees, gains as factors (not dB), delays in seconds.

    Raises
    ------
    CtrlidError
        If L is not linear, not one-input one-output, improper, not finite or has no time base.

    Notes
    -----
    See K. J. Åström and R. M. Murray, *Feedback Systems*, 2nd ed., section 10.3, and
    G. F. Franklin, J. D. Powell and A. Emami-Naeini, *Feedback Control of Dynamic Systems*,
    section 6.4. For a discrete loop the phase lag of a delay is counted as omega times delay.

    Examples
    --------
    A loop around an unstable plant fails at too little gain, not only at too much:

    >>> import control as ct, ctrlid as cid
    >>> margins = cid.loop_margins(ct.tf([2], [1, -1]))
    >>> margins.stable, margins.gain_margin, margins.gain_reduction_margin
    (True, inf, 0.5)
    >>> round(margins.phase_margin, 3), round(margins.crossover, 3)
    (60.0, 1.732)
    """
    loop = to_rational(L, "L")
    poles = find_closed_loop_poles(loop)
    if poles is None or not is_stable(poles, loop.dt):
        return UNSTABLE
    gain = find_gain_crossovers(loop)
    direct = not loop.dt and bool(abs(loop.at(math.inf)) >= 1)
    return collect_margins(gain, _find_critical_factors(loop), modulus_margin(loop), direct)


def collect_margins(
    gain: Sequence[tuple[float, float]], factors: Sequence[float], modulus: float, direct: bool
) -> Margins:
    """Return the worst of each kind of a stable loop.

    Parameters
    ----------
    gain : sequence of (float, float)
        Frequency [rad/s] and angle from -1 [rad] of each gain crossover.
    factors : sequence of float
        Factors on the loop that reach the stability limit.
    modulus : float
        Smallest distance of the loop from -1.
    direct : bool
        Whether the loop gain stays above 1 up to infinite frequency.

    Returns
    -------
    Margins
        The margins.
    """
    worst, angle = min(gain, key=lambda pair: abs(pair[1]), default=(math.nan, math.inf))
    delays = [(angle % (2 * math.pi)) / omega for omega, angle in gain]
    return Margins(
        stable=True,
        crossover=worst,
        phase_margin=math.degrees(abs(angle)),
        gain_margin=min((k for k in factors if k > 1), default=math.inf),
        gain_reduction_margin=max((k for k in factors if k < 1), default=0.0),
        modulus_margin=modulus,
        delay_margin=0.0 if direct else min(delays, default=math.inf),
    )


def find_gain_crossovers(loop: Rational) -> list[tuple[float, float]]:
    """Return all (frequency, angle from -1 in radians) where the loop gain is 1."""

    def log_gain(omega: Array) -> Array:
        num, den = loop.parts(omega)
        tiny = np.finfo(float).tiny
        return np.log(np.abs(num) + tiny) - np.log(np.abs(den) + tiny)

    num, den = loop.num, loop.den
    candidates = np.polysub(np.polymul(num, loop.flipped(num)), np.polymul(den, loop.flipped(den)))
    found = find_crossings(log_gain, _make_grid(loop, candidates))
    return [(omega, float(np.angle(-loop.at(omega)))) for omega in found]


def _find_critical_factors(loop: Rational) -> list[float]:
    """Return the factors k for which k L passes through -1."""

    def sine_of_phase(omega: Array) -> Array:
        num, den = loop.parts(omega)
        return (num * den.conj()).imag / (np.abs(num) * np.abs(den) + np.finfo(float).tiny)

    num, den = loop.num, loop.den
    candidates = np.polysub(np.polymul(num, loop.flipped(den)), np.polymul(loop.flipped(num), den))
    found = find_crossings(sine_of_phase, _make_grid(loop, candidates))
    response = [complex(loop.at(omega)) for omega in (*found, 0.0, loop.nyquist)]
    # Beyond these sizes the "crossing" is a zero or a pole on the axis.
    return [-1 / x.real for x in response if -1e9 < x.real < -1e-9]


def modulus_margin(loop: Rational) -> float:
    """Return the smallest distance of L from -1."""

    def distance(omega: Array) -> Array:
        num, den = loop.parts(omega)
        with np.errstate(divide="ignore"):
            return np.abs(num + den) / np.abs(den)

    return find_smallest(distance, _make_grid(loop), (0.0, loop.nyquist))[1]


def _make_grid(loop: Rational, *candidates: Array) -> Array:
    total = np.polyadd(loop.num, loop.den)
    return make_frequency_grid(loop.dt, [loop.num, loop.den, total], candidates)


@explain_names
@keep_numpy_quiet
def nu_gap(P1: Any, P2: Any) -> float:
    r"""Return Vinnicombe's nu-gap between two plants.

    .. math:: \delta_\nu(P_1, P_2) = \max_\omega
        \frac{|P_1 - P_2|}{\sqrt{1 + |P_1|^2} \sqrt{1 + |P_2|^2}}

    if :math:`1 + P_2^* P_1` satisfies the winding-number condition, else 1. In plain words: 0 means
    the same plant, small means that whatever controls one well controls the other about as well,
    1 means that a good controller of one says nothing about the other. A controller C with
    ``robust_margin(P1, C) > nu_gap(P1, P2)`` is certain to stabilise P2.

    Parameters
    ----------
    P1, P2 : control.TransferFunction or control.StateSpace
        Plants with one input and one output and the same time base; poles anywhere, on the
        stability limit too. Hidden modes do not count: it is a distance of transfer functions.

    Returns
    -------
    float
        Between 0 and 1. It depends on the units of input and output: scale both so that an error
        of 1 matters as much as an input of 1.

    Raises
    ------
    CtrlidError
        If a plant is not linear, one-input one-output, proper and finite, or the time bases differ.

    Notes
    -----
    G. Vinnicombe, "Frequency domain uncertainty and the graph topology", IEEE Transactions on
    Automatic Control 38(9), 1371-1383, 1993. With the normalised spectral factors
    :math:`m^* m = d^* d + n^* n` of both plants, the winding number is that of
    :math:`(d_2^* d_1 + n_2^* n_1) / (m_2^* m_1)`, so it is zero exactly when the numerator has as
    many stable roots as P1 has poles. This counts without integrating along the axis and needs no
    indentation around poles there. It may also be found in Åström and Murray, section 13.1.

    Examples
    --------
    An integrator and a very slow lag behave alike under feedback, stable or not:

    >>> import control as ct, ctrlid as cid
    >>> round(cid.nu_gap(ct.tf([1], [1, 0]), ct.tf([1], [1, -0.01])), 4)
    0.01
    >>> cid.nu_gap(ct.tf([1], [1, 1]), ct.tf([-1], [1, 1]))
    1.0
    """
    first, second = to_rational(P1, "P1").reduced(), to_rational(P2, "P2").reduced()
    require_same_time_base(first, second, "P1 and P2")
    n1, d1, n2, d2 = first.num, first.den, second.num, second.den
    n2_, d2_ = second.flipped(n2), second.flipped(d2)
    total = np.polyadd(np.polymul(d2_, d1), np.polymul(n2_, n1))
    difference = np.polysub(np.polymul(n1, d2), np.polymul(n2, d1))
    if not difference.any():
        return 0.0
    inside = find_roots(total)
    inside = inside[np.abs(inside) < 1] if first.dt else inside[inside.real < 0]
    if len(inside) != first.order:
        return 1.0

    def closeness(omega: Array) -> Array:
        (a1, b1), (a2, b2) = first.parts(omega), second.parts(omega)
        return -np.abs(a1 * b2 - a2 * b1) / (_compute_length(a1, b1) * _compute_length(a2, b2))

    spectra = _compute_spectra(first, second)
    grid = make_frequency_grid(first.dt, [n1, d1, n2, d2, *spectra], [total, difference])
    return min(1.0, -find_smallest(closeness, grid, (0.0, first.nyquist))[1])


@explain_names
@keep_numpy_quiet
def robust_margin(P: Any, C: Any) -> float:
    r"""Return the robust stability margin b of a loop, the largest nu-gap it is sure to survive.

    .. math:: b_{P,C} = \left\| \begin{bmatrix} P \\ 1 \end{bmatrix} (1 + C P)^{-1}
        \begin{bmatrix} C & 1 \end{bmatrix} \right\|_\infty^{-1} = \min_\omega
        \frac{|1 + P C|}{\sqrt{1 + |P|^2} \sqrt{1 + |C|^2}}

    Parameters
    ----------
    P, C : control.TransferFunction or control.StateSpace
        Plant and controller in u = C (r - y): *negative* feedback. One input and one output each,
        the same time base; a number is a pure gain.

    Returns
    -------
    float
        Between 0 and 1; 0 for an unstable loop. Above 0.3 is comfortable, if input and output are
        scaled as for `nu_gap` (P times w and C divided by w is the same loop in other units).

    Raises
    ------
    CtrlidError
        If P or C is not linear, one-input one-output, proper and finite, or the time bases differ.

    Notes
    -----
    For one input and one output the matrix has rank one, so its largest singular value is the
    product of the lengths of its two factors. G. Vinnicombe (1993), see `nu_gap`.

    Examples
    --------
    >>> import ctrlid as cid, control as ct
    >>> round(cid.robust_margin(ct.tf([1], [1, 0]), 1), 4)
    0.7071
    >>> cid.robust_margin(ct.tf([1], [1, 0]), -1)
    0.0
    """
    plant, controller = to_rational(P, "P"), to_rational(C, "C")
    # A pure gain runs on any clock.
    if controller.order == 0:
        controller = Rational(controller.num, controller.den, plant.dt)
    if plant.order == 0:
        plant = Rational(plant.num, plant.den, controller.dt)
    require_same_time_base(plant, controller, "P and C")
    loop = plant * controller
    poles = find_closed_loop_poles(loop)
    if poles is None or not is_stable(poles, loop.dt):
        return 0.0

    def margin(omega: Array) -> Array:
        (a1, b1), (a2, b2) = plant.parts(omega), controller.parts(omega)
        return np.abs(a1 * a2 + b1 * b2) / (_compute_length(a1, b1) * _compute_length(a2, b2))

    total = np.polyadd(loop.num, loop.den)
    grid = make_frequency_grid(
        loop.dt, [loop.num, loop.den, total, *_compute_spectra(plant, controller)]
    )
    return min(1.0, find_smallest(margin, grid, (0.0, loop.nyquist))[1])


def _compute_length(num: ComplexArray, den: ComplexArray) -> Array:
    return np.asarray(np.hypot(np.abs(num), np.abs(den)), dtype=float)


def _compute_spectra(*systems: Rational) -> list[Array]:
    """Return n* n + d* d of each system: where its size against 1 changes."""
    return [
        np.polyadd(np.polymul(x.num, x.flipped(x.num)), np.polymul(x.den, x.flipped(x.den)))
        for x in systems
    ]
