"""Margins of a loop of any number of signals, at each input of its plant, from state matrices."""

import math
from dataclasses import dataclass
from typing import Any

import control as ct
import numpy as np
import numpy.typing as npt

from .._base.arrays import Array, ComplexArray, freeze_arrays
from .._base.text import Printed, write_count
from ..loop.controllers import connect_law
from ..loop.loop import Loop
from ..loop.period_map import compute_closed_loop_poles
from ..physics.conversions import to_state_matrices
from ..physics.trace import timebase
from .margins import UNSTABLE, Margins, collect_margins
from .rational import are_resolved, find_crossings, find_smallest, make_grid_of_roots, to_s

# At so small a share of the lowest frequency a loop without integrator shows its static gain.
STILL = 1e-6
# A response there is real if its imaginary part is below this share.
REAL = 1e-3

# A pole this share of the fastest one, or nearer to zero, is at zero but for rounding.
ROUNDED = 1e-9
# A point on a pole is moved off it by this share.
NUDGE = 1e-9


def open_at_inputs(loop: Loop) -> Any:
    r"""Return the linear loop, opened at the inputs of its plant.

    .. math:: L = -C_y(z) P(z)

    from what enters the plant to the negative of what the controller computes from it. An observer
    inside the controller reads what the controller asks for, as it does in the computer, and not
    what a wrong actuator makes of it.

    Parameters
    ----------
    loop : Loop
        The loop, with a controller.

    Returns
    -------
    control.StateSpace
        Square, with the time base of the controller.
    """
    law = loop.law()
    assert law is not None
    plant = loop.linearize(states=True)
    if law.dt and not timebase(plant):
        plant = ct.sample_system(plant, law.dt, "zoh")
    a, b, c, _ = to_state_matrices(plant)
    both, entry, feedback = connect_law(a, b, c, law, loop.point)
    m = b.shape[1]
    return ct.ss(both, entry, -feedback, np.zeros((m, m)), law.dt or 0,
                 inputs=list(loop.signals["u"]))  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class LoopPerformance(Printed):
    """Poles and margins that a controller promises on a model, or achieves on the physics.

    Parameters
    ----------
    stable : bool
        Whether small deviations die out and every step that was tried ended near where it should.
    poles : ndarray of complex
        Closed-loop poles [rad/s], of plant and controller; of a digital one ``log(z) / dt``.
    margins : tuple of Margins
        One for each input of the plant: the loop is cut there, all others stay closed. NaN for an
        unstable loop.
    disk_margin : float
        `control.disk_margins` for all inputs at once [1]; NaN where python-control cannot tell.
    disk_gain : float
        Factor by which the gains of all inputs may rise or fall at the same time.
    disk_phase : float
        Phase [deg] that all inputs may lose or gain at the same time.
    """

    stable: bool
    poles: ComplexArray
    margins: tuple[Margins, ...]
    disk_margin: float
    disk_gain: float
    disk_phase: float

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    def growth_rate(self) -> float:
        """The largest real part of a pole [1/s]; negative for a stable loop.

        Zero where a pole at zero remains, such as the position of what is held at a speed.
        """
        return find_growth_rate(self.poles)

    @property
    def damping(self) -> float:
        """The smallest damping ratio [1] of a pole that is not at rest after one period."""
        poles = self.poles[np.isfinite(self.poles) & ~_find_poles_at_zero(self.poles)]
        return float(np.min(-poles.real / np.abs(poles), initial=1.0))

    def __str__(self) -> str:
        head = "stable loop" if self.stable else "LOOP THAT IS NOT STABLE"
        text = (f"{head}: {write_count(len(self.poles), 'pole')}, the slowest with real part "
                f"{self.growth_rate:.4g} 1/s, smallest damping {self.damping:.3g}")  # fmt: skip
        if not math.isnan(self.disk_margin):
            text += f", disk margin {self.disk_margin:.3g}"
        each = [f"  input {k + 1}: phase margin {m.phase_margin:.4g} deg, gain margin "
                f"{m.gain_margin:.4g}, delay margin {m.delay_margin:.4g} s"
                for k, m in enumerate(self.margins)]  # fmt: skip
        return "\n".join([text, *each])


def find_growth_rate(poles: ComplexArray) -> float:
    """Return the largest real part, with zero for poles that only rounding keeps from zero."""
    return float(np.max(np.where(_find_poles_at_zero(poles), 0.0, poles.real), initial=-math.inf))


def _find_poles_at_zero(poles: ComplexArray) -> Any:
    fastest = np.max(np.abs(poles[np.isfinite(poles)]), initial=0.0)
    return np.abs(poles) <= ROUNDED * fastest


def measure_performance(loop: Loop) -> LoopPerformance:
    """Return poles and margins of a loop near its operating point.

    Parameters
    ----------
    loop : Loop
        The loop, with a controller.

    Returns
    -------
    LoopPerformance
        NaN for the numbers of an unstable loop.
    """
    poles = compute_closed_loop_poles(loop, hidden=False)
    m = len(loop.signals["u"])
    if find_growth_rate(poles) > 0:
        return LoopPerformance(False, poles, (UNSTABLE,) * m, *(math.nan,) * 3)
    L = open_at_inputs(loop)
    dt = float(L.dt or 0.0)
    matrices = [L.A - L.B[:, rest] @ L.C[rest] for rest in _leave_one_out(m)]
    every = [L.A, *matrices, L.A - L.B @ L.C]
    roots = np.concatenate([to_s(np.linalg.eigvals(matrix), dt) for matrix in every])
    grid = make_grid_of_roots(dt, roots[are_resolved(roots, dt)])
    margins = tuple(
        _measure_margins(_Response(matrix, L.B[:, k], L.C[k], dt), grid)
        for k, matrix in enumerate(matrices)
    )
    stable = all(one.stable for one in margins)
    return LoopPerformance(stable, poles, margins, *_measure_disk(L, grid))


def _leave_one_out(m: int) -> list[list[int]]:
    return [[i for i in range(m) if i != k] for k in range(m)]


@dataclass(frozen=True, eq=False)
class _Response:
    """The frequency response of one loop, from its state matrices."""

    a: Array
    b: Array
    c: Array
    dt: float

    def __call__(self, omega: npt.ArrayLike) -> ComplexArray:
        w = np.atleast_1d(np.asarray(omega, dtype=float))
        points = np.exp(1j * w * self.dt) if self.dt else 1j * w
        # On an undamped pole itself the response is infinite.
        poles = np.linalg.eigvals(self.a)
        near = np.abs(points[:, None] - poles).min(axis=1, initial=math.inf)
        points = points + np.where(near < NUDGE * np.maximum(np.abs(points), 1.0), NUDGE, 0.0) * (
            np.maximum(np.abs(points), 1.0)
        )
        pencil = points[:, None, None] * np.eye(len(self.a)) - self.a
        states = np.linalg.solve(pencil, np.broadcast_to(self.b[:, None], (len(w), len(self.b), 1)))
        return np.asarray((self.c @ states)[:, 0], dtype=complex)


def _measure_margins(L: _Response, grid: Array) -> Margins:
    """Return the margins of a loop that is known to be stable."""
    tiny = np.finfo(float).tiny
    crossovers = find_crossings(lambda w: np.log(np.abs(L(w)) + tiny), grid)
    gain = [(omega, float(np.angle(-L(omega)[0]))) for omega in crossovers]
    turns = find_crossings(lambda w: L(w).imag / (np.abs(L(w)) + tiny), grid)
    ends = [STILL * grid[0], *([math.pi / L.dt] if L.dt else [])]
    real = [v for v in (L(end)[0] for end in ends) if abs(v.imag) < REAL * abs(v)]
    values = [*(complex(L(omega)[0]) for omega in turns), *real]
    factors = [-1 / v.real for v in values if -1e9 < v.real < -1e-9]
    _, modulus = find_smallest(lambda w: np.abs(1 + L(w)), grid, tuple(ends))
    return collect_margins(gain, factors, modulus, direct=False)


def _measure_disk(L: Any, grid: Array) -> tuple[float, float, float]:
    """Return python-control's disk margin, with its gain as a factor and its phase [deg]."""
    try:
        size, decibels, phase = ct.disk_margins(L, grid)
    except ct.ControlMIMONotImplemented:
        # Of several inputs it is a structured singular value, which python-control has from slycot.
        return math.nan, math.nan, math.nan
    return float(size), float(10 ** (decibels / 20)), float(phase)
