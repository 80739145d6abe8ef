"""Lead compensators with exactly the crossover and the phase margin asked for."""

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import control as ct
import numpy as np

from .._base.arguments import explain_names, is_number
from .._base.errors import CtrlidError, CtrlidWarning
from .._base.rounding import keep_numpy_quiet
from .margins import find_gain_crossovers, modulus_margin
from .rational import Rational, are_resolved, find_closed_loop_poles, is_stable, to_rational, to_s

# Less phase than this (radians) is none: the answer is a pure gain.
NO_PHASE = 1e-10
# The family of leads, as shares of its parameter's range; dense at both ends: some are stable
# only there.
FAMILY = tuple(0.5 * (1 - np.cos(np.linspace(0, np.pi, 203)[1:-1])))
LOST = "with any margin a lead gives at this crossover, the loop is unstable"
# Powers of frequencies beyond are no numbers any more [rad/s].
FASTEST = 1e100
COARSE_FAMILY = (0.5, *FAMILY[::16])

# What no lead can do, other controllers may.
OTHER_DESIGNS = (
    "Other controllers, such as one with a lag, are tried with redesign(G, loop, design=lambda P: "
    "C)."
)


@dataclass(frozen=True)
class _Task:
    """One plant, one crossover and one phase margin: what a compensator has to do there."""

    plant: Rational
    crossover: float
    phase_margin: float

    @cached_property
    def target(self) -> complex:
        """The value the compensator must have at the crossover."""
        turn = complex(np.exp(1j * math.radians(self.phase_margin)))
        return -turn / complex(self.plant.at(self.crossover))

    def needed(self, sign: int) -> float:
        """Return the phase in (-pi, pi] that a compensator with a gain of this sign must add."""
        phase = math.atan2((sign * self.target).imag, (sign * self.target).real)
        return math.pi if phase <= -math.pi + NO_PHASE else phase

    def sign(self) -> int | None:
        """Return the sign of the gain with which one lead can add the phase, if there is one."""
        for sign in (1, -1):
            if -NO_PHASE <= self.needed(sign) < math.pi / 2 - NO_PHASE:
                return sign
        return None

    def compensator(self, sign: int, share: float) -> Rational:
        """Return one member of the family of leads with the target value at the crossover.

        With x = s / crossover and t in (0, cot phi) all of them are, linear in t,
        M ((cos phi - t sin phi) + (sin phi + t cos phi) x) / (1 + t x).
        """
        phi, size = self.needed(sign), sign * abs(self.target)
        period = self.plant.dt
        if abs(phi) <= NO_PHASE:
            return Rational(np.array([size]), np.ones(1), period)
        t = math.tan(share * (math.pi / 2 - phi))
        a, b = math.cos(phi) - t * math.sin(phi), math.sin(phi) + t * math.cos(phi)
        if not period:
            pole = self.crossover / t
            return Rational(size * np.array([b / t, a * pole]), np.array([1.0, pole]), 0.0)
        # In the w-plane x = j at the crossover, exactly, is x = cot(wc T / 2) (z - 1) / (z + 1).
        c = 1 / math.tan(self.crossover * period / 2)
        lead = 1 + t * c
        return Rational(
            size * np.array([a + b * c, a - b * c]) / lead,
            np.array([1.0, (1 - t * c) / lead]),
            period,
        )

    def stabilised(self, controller: Rational) -> bool:
        """Tell whether all closed-loop poles, hidden ones included, are stable."""
        poles = find_closed_loop_poles(controller * self.plant)
        return poles is not None and is_stable(poles, self.plant.dt)

    def weakest(self, controller: Rational) -> tuple[float, float]:
        """Return the crossover with the smallest margin, rad/s, and that margin in degrees."""
        found = find_gain_crossovers(controller * self.plant)
        omega, angle = min(found, key=lambda pair: abs(pair[1]), default=(math.nan, math.nan))
        return omega, math.degrees(abs(angle))

    def holds(self, crossover: float, phase_margin: float) -> bool:
        """Tell whether these are what is asked for, to the accuracy of the plant."""
        accuracy = max(1e-9, 100 * max(self.plant.rounding(self.crossover)))
        return math.isclose(crossover, self.crossover, rel_tol=accuracy) and math.isclose(
            phase_margin, self.phase_margin, rel_tol=accuracy
        )


@explain_names
@keep_numpy_quiet
def design_lead(P: Any, crossover: float, phase_margin: float) -> Any:
    r"""Design a lead compensator with exactly this gain crossover and phase margin.

    .. math:: C(s) = K \frac{s/z + 1}{s/p + 1}, \quad p > z > 0, \qquad
        C(j\omega_c) P(j\omega_c) = -e^{j \varphi_m}

    It acts as :math:`u = C (r - y)`, negative feedback. The sign of K follows from the plant, so a
    magnetic levitation, :math:`-\beta / (s^2 - \alpha)`, gets K < 0. First the centred lead is
    tried, with its largest phase at the crossover, :math:`\omega_c^2 = z p`. If its loop is
    unstable, or has another crossover with less margin, all leads with the same value at
    :math:`\omega_c` are searched, :math:`\arctan(\omega_c/z) - \arctan(\omega_c/p) = \varphi`, and
    the one that keeps L farthest from -1 is returned. No unstable loop is ever returned: the
    closed-loop poles, and the margins reached, are computed and checked.

    Parameters
    ----------
    P : control.TransferFunction or control.StateSpace
        The plant, one input and one output, with stable, integrating or unstable poles and any
        sign; continuous, or discrete with its period. `linearize` makes one of a nonlinear plant.
    crossover : float
        The frequency in rad/s where the loop gain is 1; below pi/dt for a discrete plant.
    phase_margin : float
        Degrees, between 0 and 180: the distance of the phase from -180 there. It is the smallest
        over all gain crossovers, as `loop_margins` has it.

    Returns
    -------
    control.TransferFunction
        The compensator, named "lead", from "e" to "u", with the time base of the plant. It is a
        pure gain where no phase is needed. For a discrete plant the design is done in the w-plane,
        :math:`z = (1 + wT/2)/(1 - wT/2)`, and mapped back exactly.

    Raises
    ------
    CtrlidError
        If one lead cannot do it: it would need 90 degrees or more, or would have to remove phase,
        or the loop is unstable with every lead that meets the demand; the message says what is
        possible. Also for anything that is not a proper, finite, one-input one-output linear plant
        with a known time base, and for numbers outside their range.

    Warns
    -----
    CtrlidWarning
        If the phase margin is so small that it is likely to be in radians.

    See Also
    --------
    loop_margins : The margins of the result, from L = C P.

    Notes
    -----
    G. F. Franklin, J. D. Powell and A. Emami-Naeini, *Feedback Control of Dynamic Systems*,
    section 6.7 (lead compensation) and 8.3 (w-plane); K. J. Åström and R. M. Murray, *Feedback
    Systems*, 2nd ed., section 12.3. Textbooks choose the gain and correct by trial; here gain,
    zero and pole follow in closed form from the crossover.

    Examples
    --------
    A ball that hangs 12 mm below its magnet at 3 V:

    >>> import control as ct, ctrlid as cid
    >>> P = ct.tf([-6.54], [1, 0, -1635])
    >>> C = cid.design_lead(P, crossover=100.0, phase_margin=50)
    >>> C.zeros().real.round(2), C.poles().real.round(2), round(float(C(0).real), 1)
    (array([-36.4]), array([-274.75]), -647.5)
    >>> margins = cid.loop_margins(P * C)
    >>> margins.stable, round(margins.crossover, 6), round(margins.phase_margin, 6)
    (True, 100.0, 50.0)
    """
    plant = to_rational(P, "P")
    crossover = _check_number(crossover, "crossover", "rad/s")
    phase_margin = _check_number(phase_margin, "phase_margin", "degrees")
    if not 1 / FASTEST < crossover < FASTEST:
        raise CtrlidError(f"crossover is {crossover:g} rad/s; needed is a frequency above 0, not "
                          "too far from the poles of P.")  # fmt: skip
    if crossover >= plant.nyquist * (1 - 1e-9):
        raise CtrlidError(
            f"crossover is {crossover:g} rad/s, but with a sampling period of {plant.dt:g} s it "
            f"must be below pi/dt = {plant.nyquist:.4g} rad/s; give a lower one or sample faster."
        )
    if not 0 < phase_margin < 180:
        raise CtrlidError(
            f"phase_margin is {phase_margin:g} degrees; needed is a value between 0 and 180."
        )
    if phase_margin < math.pi / 2:
        warnings.warn(
            f"phase_margin is {phase_margin:g} degrees, which is almost none; if it was meant in "
            f"radians, give {math.degrees(phase_margin):.3g}", CtrlidWarning, stacklevel=4,
        )  # fmt: skip
    _check_plant(plant, crossover)

    task = _Task(plant, crossover, phase_margin)
    sign = task.sign()
    found = _explain_phase(task, (1, -1)) if sign is None else _find_best(task, sign)
    if isinstance(found, str) and sign is not None:
        other = _explain_phase(task, (-sign,))
        if LOST not in other:
            found = f"{found} With a gain of the other sign: {other}"
    if isinstance(found, str):
        raise CtrlidError(f"{found} {_explain_crossovers(task)} {OTHER_DESIGNS}")
    return ct.tf(found.num, found.den, plant.dt, name="lead", inputs=["e"], outputs=["u"])


def _check_number(value: Any, name: str, unit: str) -> float:
    number = float(value) if is_number(value) else math.nan
    if not math.isfinite(number):
        raise CtrlidError(f"{name} is {value!r}; needed is one finite number, in {unit}.")
    return number


def _check_plant(plant: Rational, crossover: float) -> None:
    """Refuse plants that no controller, or none with this crossover, can deal with."""
    for pole in plant.hidden():
        if not is_stable(np.array([pole]), plant.dt):
            raise CtrlidError(
                f"P has a hidden mode at {_write_root(pole)} that is not stable: a pole there is "
                f"cancelled by a zero, so no controller can reach it; if both are rounding "
                f"errors, remove them, for example with P.minreal()."
            )
    for error, word in zip(plant.rounding(crossover), ("zero", "infinite"), strict=True):
        if error > 1e-4:
            crowd = " (at fast sampling poles crowd around z = 1: sample more slowly, or design on "
            crowd += "the continuous plant)"
            raise CtrlidError(
                f"P is {word} at the crossover {crossover:g} rad/s, to the accuracy of its "
                f"coefficients{crowd if plant.dt else ''}, so no compensator gives a gain of 1 "
                f"there; choose another crossover."
            )


def _write_root(value: complex) -> str:
    return f"{value.real:.4g}" if abs(value.imag) <= 1e-9 * abs(value) else f"{value:.4g}"


def _list_stabilising(task: _Task, sign: int, shares: tuple[float, ...]) -> Iterator[Rational]:
    """Yield the compensators of these shares whose loop is stable."""
    for share in shares[:1] if abs(task.needed(sign)) <= NO_PHASE else shares:
        controller = task.compensator(sign, share)
        if task.stabilised(controller):
            yield controller


def _can_do(task: _Task, sign: int) -> bool:
    """Tell whether some lead, of the centred and a few more, does the task."""
    return any(
        task.holds(*task.weakest(controller))
        for controller in _list_stabilising(task, sign, COARSE_FAMILY)
    )


def _find_best(task: _Task, sign: int) -> Rational | str:
    """Return the compensator, or why there is none."""
    for controller in _list_stabilising(task, sign, (0.5,)):
        if task.holds(*task.weakest(controller)):
            return controller
    best, reach, worst = None, 0.0, (math.nan, 0.0)
    for controller in _list_stabilising(task, sign, FAMILY):
        weakest = task.weakest(controller)
        if not task.holds(*weakest):
            worst = max(worst, weakest, key=lambda pair: pair[1])
        elif (distance := modulus_margin(controller * task.plant)) > reach:
            best, reach = controller, distance
    if best is not None:
        return best
    asked = (
        f"the crossover {task.crossover:g} rad/s and the phase margin {task.phase_margin:g} degrees"
    )
    if worst[1] > 0:
        return (
            f"Every stabilising lead with {asked} gives the loop another crossover with a smaller "
            f"margin, at best {worst[1]:.1f} degrees at {worst[0]:.4g} rad/s."
        )
    if abs(task.needed(sign)) <= NO_PHASE:
        return f"The closed loop is unstable with the pure gain that alone has {asked}."
    return f"The closed loop is unstable with every lead that has {asked}."


def _explain_phase(task: _Task, signs: tuple[int, ...]) -> str:
    """Say how much phase is missing or too much, and which margins this crossover allows."""

    def works(phi: float, sign: int) -> bool:
        margin = plain[sign] + phi
        return 0 < margin < 180 and _can_do(replace(task, phase_margin=margin), sign)

    needed = {sign: math.degrees(task.needed(sign)) for sign in signs}
    # This is the phase margin that a pure gain gives.
    plain = {sign: task.phase_margin - needed[sign] for sign in needed}
    grid = [1e-6, *np.arange(3.0, 90.0, 3.0), 90 - 1e-3]
    allowed = {sign: [phi for phi in grid if works(phi, sign)] for sign in needed}
    # Speak of the sign of K that can work at all, else of the one with less phase amiss.
    sign = min(
        needed, key=lambda s: (not allowed[s], needed[s] - 90 if needed[s] > 0 else -needed[s])
    )
    text = f"A phase margin of {task.phase_margin:g} degrees at {task.crossover:g} rad/s"
    if needed[sign] > 0:
        text += f" needs {needed[sign]:.1f} degrees of lead, but one lead gives less than 90"
    else:
        text += (
            f" would need a phase lag, but a lead only adds phase: a pure gain gives exactly "
            f"{plain[sign]:.4f} degrees"
        )
    if not allowed[sign]:
        return f"{text}; {LOST}."
    low, high = allowed[sign][0], allowed[sign][-1]
    if high == grid[-1] or plain[sign] + high > 176.9:
        largest = f"just under {min(plain[sign] + 90, 180):.1f}"
    else:
        high = _find_edge(grid[grid.index(high) + 1], high, lambda phi: works(phi, sign))
        largest = f"about {plain[sign] + high:.1f}"
    if needed[sign] > 0:
        return f"{text}; the largest phase margin at this crossover is {largest} degrees."
    return f"{text}; possible at this crossover are {plain[sign] + low:.1f} to {largest} degrees."


def _find_edge(outside: float, inside: float, works: Callable[[float], bool]) -> float:
    """Return the last value that works, by halving the ratio."""
    for _ in range(12):
        middle = math.sqrt(outside * inside)
        outside, inside = (outside, middle) if works(middle) else (middle, inside)
    return inside


def _explain_crossovers(task: _Task) -> str:
    """Say at which crossovers one lead does give the phase margin, by trying them."""
    plant = task.plant

    def works(omega: float) -> bool:
        trial = replace(task, crossover=omega)
        return (sign := trial.sign()) is not None and _can_do(trial, sign)

    s = to_s(np.concatenate([plant.poles(), plant.zeros()]), plant.dt)
    sizes = np.concatenate([np.abs(s[are_resolved(s, plant.dt)]), [task.crossover]])
    sizes = sizes[sizes > np.finfo(float).tiny * 100]
    if not sizes.size:
        return "No other crossover was tried."
    top = min(30 * float(max(sizes)), 0.999 * plant.nyquist)
    grid = np.geomspace(min(float(min(sizes)), top) / 30, top, 61).tolist()
    # At fast sampling the coefficients do not tell the plant at low frequencies.
    grid = [omega for omega in grid if max(plant.rounding(omega)) < 1e-7]
    good = [works(omega) for omega in grid]
    if not any(good):
        return (
            f"None of {len(grid)} crossovers tried from {min(grid, default=top):.2g} to {top:.4g} "
            f"rad/s gives that phase margin with one lead."
        )
    last = len(grid) - 1
    ranges = []
    starts = [k for k in range(last + 1) if good[k] and (k == 0 or not good[k - 1])]
    for start in starts:
        stop = next((k for k in range(start, last + 1) if not good[k]), last + 1) - 1
        low = _find_edge(grid[start - 1], grid[start], works) if start else grid[0]
        if stop == last:
            ranges.append(f"from about {low:.3g} rad/s upwards")
        else:
            high = _find_edge(grid[stop + 1], grid[stop], works)
            begin = f"from about {low:.3g}" if start else "up"
            ranges.append(f"{begin} to about {high:.3g} rad/s")
    return f"With {task.phase_margin:g} degrees, crossovers are possible {', '.join(ranges)}."
