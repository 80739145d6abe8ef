"""Velocities at which forces act, and what a loop does not say of them."""

from collections.abc import Mapping

import casadi
import numpy as np

from .._base.arrays import Array
from .._base.text import write_list
from ..effects.context import find_motion
from ..physics.equations import Equations, may_be_speed
from ..physics.linearization import OperatingPoint, compute_state_matrices

# Units by which a state is known as a speed.
SPEEDS = ("m/s", "mm/s", "cm/s", "km/h", "rad/s", "deg/s", "°/s", "rpm")


def list_unforced_velocities(e: Equations) -> tuple[str, ...]:
    """Return the velocities of a mechanism of several coordinates that does not know its forces.

    In a chain of integrators a velocity is the position of the next one, and just one moves.
    """
    pairs = [pair for j in e.position_rates if (pair := find_motion(e, e.states[j]))]
    moving = sorted({j for _, j in pairs} - {i for i, _ in pairs})
    return tuple(e.states[j] for j in moving) if len(moving) > 1 and e.pushes is None else ()


def list_possible_speeds(e: Equations, units: Mapping[str, str]) -> tuple[str, ...]:
    """Return the states that may be speeds of which the loop does not say so.

    Where their units are known, it is those in m/s, rad/s and the like; where they are not, those
    of a plant in which nothing else moves.
    """
    own = e.states[: len(e.states) - len(e.rest)]
    free = [s for s in own if e.states.index(s) not in e.velocities and may_be_speed(e, s)]
    if any(s in units for s in free):
        return tuple(s for s in free if units.get(s) in SPEEDS)
    return () if e.velocities else tuple(free)


def suppose_force(e: Equations, point: OperatingPoint) -> tuple[str, str] | None:
    """Return the only velocity that the only input of a mechanism can work on, with that input.

    A force accelerates its own coordinate its own way, and through the mass matrix others either
    way: where one acceleration of several grows with the input, that is where it works. None where
    the input accelerates one coordinate alone, or several its own way.
    """
    pair = _find_likely_force(e, point) if e.siso and list_unforced_velocities(e) else None
    if pair is None:
        return None
    gains = _compute_gains(e, point)
    return pair if np.count_nonzero(gains) > 1 and np.count_nonzero(gains > 0) == 1 else None


def describe_missing_forces(e: Equations, point: OperatingPoint) -> str:
    """Say what a loop of unforced velocities lacks and what to give, without a full stop."""
    text = (
        "without forces= a force at a velocity accelerates that coordinate alone, while in a "
        "mechanism it accelerates all of them, through the mass matrix. "
    )
    pair = _find_likely_force(e, point)
    if pair is not None:
        return (f"{text}Say which input works on which velocity, as in "
                f"forces={{{pair[0]!r}: {pair[1]!r}}} of the Loop")  # fmt: skip
    velocity = list_unforced_velocities(e)[0]
    return (
        f"{text}No input of {e.name} is such a force. In a mechanism that is "
        "coupled, add one for each velocity to the equations of the plant, and say which inputs "
        f"the record has: Loop(..., driven={e.inputs}, forces={{{velocity!r}: 'force'}})"
    )


def describe_possible_speeds(speeds: tuple[str, ...]) -> str:
    """Say which states may be speeds, and how to say so, without a full stop."""
    return (
        f"forces, friction among them, were not looked for at {write_list(speeds)}, for no state "
        "is its position. If it is a speed, say so, with the input that is its force or torque or "
        f"None: Loop(..., forces={{{speeds[0]!r}: None}})"
    )


def _compute_gains(e: Equations, point: OperatingPoint) -> Array:
    """Return what each input adds to the rates of the unforced velocities."""
    rows = [e.states.index(name) for name in list_unforced_velocities(e)]
    return np.asarray(compute_state_matrices(e, point)[1][rows])


def _find_likely_force(e: Equations, point: OperatingPoint) -> tuple[str, str] | None:
    """Return a velocity and an input that may be the force at it; None where no input can be.

    A force enters the accelerations as it is and moves its own coordinate its own way. As many
    forces as velocities have the inverse of the mass matrix for a gain, which is symmetric and
    positive definite; that of two magnets at both ends of a beam is not.
    """
    names = list_unforced_velocities(e)
    slopes = casadi.jacobian(e.rhs, e.u)
    if any(casadi.depends_on(slopes[:, k], e.u[k]) for k in range(len(e.inputs))):
        return None
    gain = _compute_gains(e, point)
    if len(e.inputs) == 1:
        pushed = [name for name, value in zip(names, gain[:, 0], strict=True) if value > 0]
        return (pushed[0], e.inputs[0]) if pushed else None
    if gain.shape[0] != gain.shape[1] or not np.allclose(gain, gain.T, rtol=1e-6, atol=0.0):
        return None
    return (names[0], e.inputs[0]) if np.all(np.linalg.eigvalsh(gain) > 0) else None
