"""Simulating a loop: sampled or analog controller, held signals, noise, and failures in words."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
from scipy.integrate import DOP853

from .data import Record
from .errors import CtrlidError, CtrlidWarning
from .loop import Loop
from .physics import Array

TOLERANCE = 1e-9  # local error of one integration step, relative to the excursion of each state
COARSE = 1e-5  # above this, what could not be refined further is worth a warning
MOST_SUBSTEPS = 128
CHUNK = 2048  # samples run at once
RUNAWAY = 1e3  # an output this many times further out than anything asked for has left


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


def _sensitivity(s: Stepper, reference: float) -> tuple[Array, Array]:
    """Return how the state after one period depends on the state and signals at rest."""
    z, w = casadi.SX.sym("z", len(s.rest)), casadi.SX.sym("w", 5)
    after = s.step(z, w)[0]
    both = casadi.Function("j", [z, w], [casadi.jacobian(after, z), casadi.jacobian(after, w)])
    a, b = both(s.rest, [0.0, reference, 0.0, 0.0, 0.0])
    return np.asarray(a, float), np.asarray(b, float)


def growth_rate(loop: Loop) -> float:
    """Return the growth rate of small deviations in the closed loop [1/s].

    .. math:: \\max_i \\ln|\\lambda_i| / T

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
    """
    matrix = _sensitivity(stepper(loop, 8), loop.point.output)[0]
    largest = np.max(np.abs(np.linalg.eigvals(matrix)), initial=0.0)
    return float(np.log(largest) / loop.dt) if largest > 0 else -math.inf


def simulate(
    loop: Loop,
    r: Any = None,
    *,
    sensor_noise: float = 0.0,
    force_noise: float = 0.0,
    d: Any = None,
    initial: Sequence[float] | None = None,
    seed: int | None = None,
) -> Record:
    """Simulate a loop and return the record that its data logger would write.

    At sample k the output is measured, ``y[k] = h(x(kT)) + noise``, the controller computes ``u[k]``
    from it, and a digital one holds u until the next sample; a continuous controller is
    integrated together with the plant. The reference, the injected signal and the noise are held
    over each period. Steps are of order eight, as many per period as an error of 1e-9 of each
    state's excursion needs.

    Parameters
    ----------
    loop : Loop
        The loop; without a controller, ``u = at.input + d``.
    r : array_like, shape (n,), optional
        Reference [output unit]; needed if the loop has a controller.
    sensor_noise : float, optional
        Standard deviation of white noise on the measured output [output unit].
    force_noise : float, optional
        Standard deviation of a white acceleration, held over each period [output unit/s^2].
    d : array_like, shape (n,), optional
        Signal added to the controller's output, ahead of the limits [input unit]: dither, pulses.
    initial : sequence of float, optional
        Initial plant states, or plant and controller states; by default those at rest.
    seed : int, optional
        Seed of the noise.

    Returns
    -------
    Record
        `r`, the applied input `u` and the measured output `y`.

    Raises
    ------
    CtrlidError
        If the loop diverges (it says when, where and why) or an argument does not fit.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    >>> op = cid.operating_point(plant, output=0.012)
    >>> C = cid.design_lead(cid.linearize(plant, op), crossover=100, phase_margin=50)
    >>> loop = cid.Loop(plant, C, dt=0.001, at=op)
    >>> r = cid.random_binary(2000, amplitude=1e-4, hold=20, around=op.output, seed=1)
    >>> len(cid.simulate(loop, r, sensor_noise=2e-6, seed=2))
    2000
    """
    r, d = _signals(loop, r, d)
    noise = _noise(loop, d.size, sensor_noise, force_noise, seed)
    simulator = Simulator(loop)
    y, u = simulator.run(simulator.start(initial), r, d, noise)
    e = loop.equations()
    return Record(
        r=r, u=u, y=y, dt=loop.dt, hold="foh" if loop.analog else "zoh",
        names={"u": e.inputs[0], "y": e.outputs[0]}, name=e.name,
    )  # fmt: skip


def _signals(loop: Loop, r: Any, d: Any) -> tuple[Array | None, Array]:
    arrays = {}
    for name, value in (("r", r), ("d", d)):
        if value is None:
            continue
        array = np.asarray(value, dtype=float)
        if array.ndim != 1 or array.size < 2 or not np.isfinite(array).all():
            raise CtrlidError(
                f"simulate needs {name} as a one-dimensional array of at least 2 finite numbers, "
                f"one per sample; given shape {array.shape} with "
                f"{np.count_nonzero(~np.isfinite(array))} not finite"
            )
        arrays[name] = array
    if loop.controller is not None and "r" not in arrays:
        raise CtrlidError("simulate needs the reference r: the loop has a controller; to hold it "
                          f"at rest give np.full(n, {loop.point.output:g})")  # fmt: skip
    if not arrays:
        raise CtrlidError("simulate needs r or d to know how many samples to run; an open loop "
                          "is driven by d (u = at.input + d)")  # fmt: skip
    sizes = {name: array.size for name, array in arrays.items()}
    if len(set(sizes.values())) > 1:
        raise CtrlidError(f"r and d must be equally long; given {sizes}")
    size = next(iter(sizes.values()))
    return arrays.get("r"), arrays.get("d", np.zeros(size))


def _noise(loop: Loop, n: int, sensor: float, force: float, seed: int | None) -> list[Array]:
    for name, value in (("sensor_noise", sensor), ("force_noise", force)):
        if not (np.ndim(value) == 0 and np.isfinite(value) and value >= 0):
            raise CtrlidError(f"{name} is a standard deviation >= 0; given {value!r}")
    if force and not loop.equations().velocities:
        raise CtrlidError(
            f"force_noise needs a plant with a moving mass, that is a state whose rate is another "
            f"state; {loop.equations().name} has none. Use d= for a disturbance of the input"
        )
    # Separate streams: switching one noise on does not change the other.
    streams = np.random.default_rng(seed).spawn(2)
    return [s.standard_normal(n) * v for s, v in zip(streams, (sensor, force), strict=True)]


class Simulator:
    """A loop made ready to run many times.

    Parameters
    ----------
    loop : Loop
        The loop.
    """

    def __init__(self, loop: Loop) -> None:
        self.loop = loop
        first = stepper(loop, 1)
        self.plant_states = first.plant_states
        self.rest: Array = np.array(first.rest, dtype=float)
        self._runners: dict[tuple[int, int], Any] = {}
        # What a millionth of the operating values does to each state: smaller motion is rest.
        a, b = (np.nan_to_num(np.abs(m)) for m in _sensitivity(first, loop.point.output))
        self._floor = 1e-6 * (a @ np.abs(self.rest) + b[:, 2] * abs(loop.point.input))

    def start(self, initial: Sequence[float] | None) -> Array:
        """Return the state to start from: at rest, or with the given values."""
        z, n = self.rest.copy(), len(self.plant_states)
        if initial is not None:
            given = np.atleast_1d(np.asarray(initial, dtype=float))
            if given.size not in (n, z.size) or not np.isfinite(given).all():
                raise CtrlidError(
                    f"initial needs {n} plant states ({', '.join(self.plant_states)}) or these and "
                    f"{z.size - n} controller states, all finite; given {given.tolist()}"
                )
            z[: given.size] = given
        return z

    def _runner(self, substeps: int, size: int) -> Any:
        key = (substeps, size)
        if key not in self._runners:
            self._runners[key] = stepper(self.loop, substeps).step.mapaccum("run", size)
        return self._runners[key]

    def run(
        self, z: Array, r: Array | None, d: Array, noise: Sequence[Array] | None = None
    ) -> tuple[Array, Array]:
        """Return measured output and applied input, from state `z` on.

        Runs chunk by chunk; the steps of a chunk are halved until its local errors are small.
        """
        loop, n = self.loop, d.size
        quiet = np.zeros(n)
        w = np.vstack([np.arange(n) * loop.dt, quiet if r is None else r, d,
                       *(noise or (quiet, quiet))])  # fmt: skip
        y, u = np.empty(n), np.empty(n)
        start, reach = z, self._floor
        substeps, size = 1, min(CHUNK, n)
        worst, where = 0.0, 0
        for first in range(0, n, size):
            block = w[:, first : first + size]
            count = block.shape[1]
            if count < size:
                block = np.hstack([block, np.repeat(block[:, -1:], size - count, axis=1)])
            previous_stop: int | None = None
            while True:
                states, ys, us, errors = (np.asarray(a, float)[:, :count]
                                          for a in self._runner(substeps, size)(z, block))  # fmt: skip
                stop = _first_bad(loop, states, ys, us, w)
                with np.errstate(all="ignore"):
                    moved = np.maximum(reach, np.max(np.abs(states - start[:, None]), axis=1))
                    relative = float(np.max(np.where(errors > 0, errors / moved[:, None], 0.0)))
                fine = stop is None and relative <= TOLERANCE
                if fine or substeps >= MOST_SUBSTEPS:
                    break
                if stop is not None and stop == previous_stop:
                    break  # finer steps leave at the same sample: it is the loop that leaves
                previous_stop = stop
                substeps *= 2
            if stop is not None:
                inside = bool(np.isfinite(states[:, stop]).all())
                raise CtrlidError(_why_left(loop, first + stop, inside, ys[:, : stop + 1],
                                            us[:, : stop + 1], w))  # fmt: skip
            if relative > worst:
                worst, where = relative, first
            y[first : first + count], u[first : first + count] = ys[0], us[0]
            z, reach = states[:, -1], moved
            if relative < TOLERANCE / 1e4 and substeps > 1:
                substeps //= 2
        if worst > COARSE:
            warnings.warn(
                f"the simulation is only good to about {worst:.0e} of the signals near t = "
                f"{where * loop.dt:.4g} s: the plant or the controller is too sharp or too fast "
                f"for {MOST_SUBSTEPS} steps in {loop.dt:g} s; simulate with a smaller dt",
                CtrlidWarning, stacklevel=3,
            )  # fmt: skip
        return y, u


def _controller_run(loop: Loop, y: Array, r: Array | None) -> tuple[Any, Array]:
    """Return the controller over all samples as a function of its initial state, and its rest."""
    law = loop.law()
    if law is None or law.dt == 0.0:
        raise CtrlidError("only a digital controller computes its output from the samples alone; "
                          f"this loop has {'no controller' if law is None else 'an analog one'}")  # fmt: skip
    x, w = casadi.SX.sym("x", len(law.rest)), casadi.SX.sym("w", 3)
    u, after = law.apply(w[0], x, w[1], w[2])
    lower, upper = loop.input_limits
    u = casadi.fmin(casadi.fmax(u, lower), upper)
    step = casadi.Function("controller", [x, w], [casadi.vertcat(after), u])
    reference = np.full(len(y), loop.point.output) if r is None else np.asarray(r)
    table = casadi.DM(np.vstack([np.arange(len(y)) * loop.dt, reference, y]))
    start = casadi.MX.sym("start", len(law.rest))
    outputs = step.mapaccum("run", len(y))(start, table)[1]
    return casadi.Function("outputs", [start], [outputs.T]), np.array(law.rest, dtype=float)


def controller_output(loop: Loop, y: Array, r: Array | None = None) -> Array:
    """Return what a digital controller, at rest before, computes from a reference and an output.

    Parameters
    ----------
    loop : Loop
        The loop whose controller runs.
    y : ndarray, shape (n,)
        Measured output.
    r : ndarray, shape (n,), optional
        Reference; by default constant at the operating point.

    Returns
    -------
    ndarray, shape (n,)
        The input, within the limits of the loop.

    Raises
    ------
    CtrlidError
        If the loop has no controller, or an analog one.
    """
    run, rest = _controller_run(loop, y, r)
    return np.asarray(run(rest), float).ravel()


def replay_controller(loop: Loop, record: Record) -> Array:
    """Return the input that the controller of a loop computes from a record's own r and y.

    The controller's initial state is not in the record; it is chosen to reproduce the logged u best.
    What then remains between the result and ``record.u`` is not the controller's: injected
    pulses or dither, a channel logged late, another controller.

    Parameters
    ----------
    loop : Loop
        Loop with a digital controller.
    record : Record
        Record with a reference.

    Returns
    -------
    ndarray, shape (n,)
        Input at each sample [input unit].

    Raises
    ------
    CtrlidError
        If there is no digital controller, no reference, or the sampling periods differ.

    Examples
    --------
    >>> import ctrlid as cid
    >>> plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    >>> loop = cid.Loop(plant, cid.PID(kp=5.0, kd=0.1), dt=0.01)
    >>> record = cid.simulate(loop, cid.random_binary(500, amplitude=0.1, hold=50, seed=1))
    >>> bool(abs(cid.replay_controller(loop, record) - record.u).max() < 1e-12)
    True
    """
    if abs(loop.dt - record.dt) > 1e-9 * loop.dt:
        raise CtrlidError(f"the loop is sampled at {loop.dt:g} s, the record at {record.dt:g} s")
    if record.r is None:
        raise CtrlidError("the record has no reference r, which the controller needs")
    run, start = _controller_run(loop, record.y, record.r)
    replayed = np.asarray(run(start), float).ravel()
    best = float(np.sum((replayed - record.u) ** 2))
    state = casadi.MX.sym("state", start.size)
    slope = casadi.Function("slope", [state], [casadi.jacobian(run(state), state)])
    # Gauss-Newton: one step where the law is linear in its state, a few more around limits.
    for _ in range(10 if start.size else 0):
        jacobian = np.asarray(slope(start).full(), float)
        start = start + np.linalg.lstsq(jacobian, record.u - replayed, rcond=1e-12)[0]
        trial = np.asarray(run(start), float).ravel()
        cost = float(np.sum((trial - record.u) ** 2))
        if not cost < best:
            break
        replayed, best = trial, cost
    return replayed


def _first_bad(loop: Loop, states: Array, ys: Array, us: Array, w: Array) -> int | None:
    """Index of the first sample at which the loop is no longer where it can be."""
    bad = ~(np.isfinite(states).all(axis=0) & np.isfinite(ys[0]) & np.isfinite(us[0]))
    if loop.controller is not None:
        rest = loop.point.output
        asked = max(abs(rest), float(np.max(np.abs(w[1] - rest))), 1e-300)
        asked = max(asked, float(np.abs(w[3]).max()))
        bad |= np.abs(ys[0] - rest) > RUNAWAY * asked
    return int(np.argmax(bad)) if bad.any() else None


def _why_left(loop: Loop, at: int, inside: bool, ys: Array, us: Array, w: Array) -> str:
    """Say when and why a simulation broke off."""
    e, op = loop.equations(), loop.point
    output, inp = e.outputs[0], e.inputs[0]
    k = ys.shape[1] - 1
    good = max(k - 1, 0)
    text = f"the simulation stops at t = {at * loop.dt:.5g} s (sample {at}): "
    if inside:
        text += f"{output} ran away to {ys[0, k]:.4g}"
    else:
        text += f"{output} left the range where the plant is defined, last at {ys[0, good]:.4g}"
    text += f", with {inp} = {us[0, good]:.4g}."
    try:
        growth = growth_rate(loop)
    except CtrlidError:
        growth = math.nan
    lower, upper = loop.input_limits
    recent = us[0, max(0, good - 20) : good + 1]
    if loop.controller is None:
        return (
            text + " The loop is open: an unstable plant cannot be simulated without its controller"
        )
    if growth > 0:
        return text + (f" The closed loop is unstable: small deviations grow at {growth:.3g} 1/s. "
                       "Check the sign and the gain of the controller and the operating point")  # fmt: skip
    if np.any(recent <= lower) or np.any(recent >= upper):
        text += f" {inp} was at its limit ({lower:g}..{upper:g}) when control was lost."
    swing = np.max(np.abs(us[0, : good + 1] - op.input)) if good else 0.0
    text += (f" Near the operating point the loop is stable, so the signals are too large for it: "
             f"{inp} moved {swing:.3g} away from {op.input:.4g}")  # fmt: skip
    asked = float(np.max(np.abs(w[1] - op.output)))
    return (
        text + f", {output} was asked to move by {asked:.3g}. Use a smaller reference or less noise"
    )
