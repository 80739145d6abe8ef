"""A loop over one sampling period, as exact equations: the map that simulation repeats."""

import math
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
from scipy.integrate import DOP853

from .errors import CtrlidError
from .loop import Loop
from .physics import Array


@dataclass(frozen=True, eq=False)
class Stepper:
    """The loop over one sampling period as a CasADi function.

    ``step(z, w) -> (next z, y, u, local error)``; z stacks plant and controller states, w is
    ``(t, r, d, sensor noise, force noise)``, all held over the period.
    """

    plant_states: tuple[str, ...]
    rest: tuple[float, ...]
    step: Any


def integrate(rate: Any, z: Any, dt: float, substeps: int) -> tuple[Any, Any]:
    """Advance an expression by Dormand and Prince's eighth-order formula.

    Parameters
    ----------
    rate : callable
        ``rate(tau, z)``, the derivative at time `tau` after the start, as CasADi expression.
    z : casadi.SX
        The state at the start.
    dt : float
        Time to advance [s].
    substeps : int
        Number of steps of equal length.

    Returns
    -------
    z : casadi.SX
        The state after `dt`.
    error : casadi.SX
        Largest estimate of the local error of a step, per state.

    References
    ----------
    Hairer, Nørsett and Wanner, *Solving Ordinary Differential Equations I*, section II.10.
    """
    h = dt / substeps
    worst = casadi.SX.zeros(z.shape[0], 1)
    for k in range(substeps):
        stages: list[Any] = []
        for row, c in zip(DOP853.A, DOP853.C, strict=True):
            point = z
            for weight, stage in zip(row, stages, strict=False):
                if weight:
                    point = point + (h * weight) * stage
            stages.append(rate((k + c) * h, point))
        total, fifth, third = (
            sum((w * s for w, s in zip(weights, stages, strict=False) if w), casadi.SX(0))
            for weights in (DOP853.B, DOP853.E5, DOP853.E3)
        )
        z = z + h * total
        fifth, third = casadi.fabs(h * fifth), casadi.fabs(h * third)
        worst = casadi.fmax(worst, fifth**2 / casadi.sqrt(fifth**2 + 0.01 * third**2 + 1e-300))
    return z, worst


def stepper(loop: Loop, substeps: int) -> Stepper:
    """Build the map of a loop over one sampling period.

    Parameters
    ----------
    loop : Loop
        The loop.
    substeps : int
        Integration steps in a period.

    Returns
    -------
    Stepper
        The map.
    """
    e, law = loop.equations(), loop.law()
    n, nc = len(e.states), len(law.rest) if law else 0
    z, w = casadi.SX.sym("z", n + nc), casadi.SX.sym("w", 5)
    t0, r, d, sensor, force = casadi.vertsplit(w)
    kick = casadi.SX.zeros(n, 1)
    for j in e.velocities:
        kick[j] = force
    at, (lower, upper) = loop.point, loop.input_limits

    def plant(t: Any, x: Any, u: Any) -> tuple[Any, Any]:
        rhs, y = e.function(t, x, u, e.values)
        return rhs + kick, y

    def act(t: Any, z: Any, y: Any) -> tuple[Any, Any]:
        wish, moved = law.apply(t, z[n:], r, y) if law else (at.input, casadi.SX(0, 1))
        u = wish + d
        if math.isfinite(lower):
            u = casadi.fmax(u, lower)
        if math.isfinite(upper):
            u = casadi.fmin(u, upper)
        return u, moved

    def measured(t: Any, z: Any, u: Any) -> Any:
        return plant(t, z[:n], u)[1] + sensor

    y = measured(t0, z, at.input)
    u, moved = act(t0, z, y)
    if law is None:
        y = measured(t0, z, u)
    if loop.analog:
        # A jump of the reference is a jump of the circuit's input: the period is smooth.
        def rate(tau: Any, z: Any) -> Any:
            u, slope = act(t0 + tau, z, measured(t0 + tau, z, at.input))
            return casadi.vertcat(plant(t0 + tau, z[:n], u)[0], slope)

        after, error = integrate(rate, z, loop.dt, substeps)
    elif e.dt:
        after, error = casadi.vertcat(plant(t0, z[:n], u)[0], moved), casadi.SX.zeros(n + nc, 1)
    else:
        x, error = integrate(
            lambda tau, x: plant(t0 + tau, x, u)[0], z[:n], loop.dt, substeps
        )  # fmt: skip
        after = casadi.vertcat(x, moved)
        error = casadi.vertcat(error, casadi.SX.zeros(nc, 1))
    rest = (*at.states, *(law.rest if law else ()))
    return Stepper(e.states, rest, casadi.Function("step", [z, w], [after, y, u, error]))


def sensitivity(s: Stepper, reference: float) -> tuple[Array, Array]:
    """Return how the state after one period depends on the state and signals at rest."""
    z, w = casadi.SX.sym("z", len(s.rest)), casadi.SX.sym("w", 5)
    after = s.step(z, w)[0]
    both = casadi.Function("j", [z, w], [casadi.jacobian(after, z), casadi.jacobian(after, w)])
    a, b = both(s.rest, [0.0, reference, 0.0, 0.0, 0.0])
    return np.asarray(a, float), np.asarray(b, float)


def growth_rate(loop: Loop) -> float:
    r"""Return the growth rate of small deviations in the closed loop [1/s].

    .. math:: \max_i \ln|\lambda_i| / T

    over the eigenvalues of the linearized map over one sampling period T, with the controller as it
    runs. Negative: the loop is stable.

    Parameters
    ----------
    loop : Loop
        The loop.

    Returns
    -------
    float
        The rate; minus infinity for a loop that is at rest after one period.

    Raises
    ------
    CtrlidError
        If the plant has no derivative at the operating point.
    """
    matrix = sensitivity(stepper(loop, 8), loop.point.output)[0]
    if not np.isfinite(matrix).all():
        raise CtrlidError(
            f"{loop.equations().name} has no derivative at its operating point {loop.point}; "
            "give at=operating_point(plant, output=...)"
        )
    largest = np.max(np.abs(np.linalg.eigvals(matrix)), initial=0.0)
    return float(np.log(largest) / loop.dt) if largest > 0 else -math.inf
