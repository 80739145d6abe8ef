"""The input that a loop's controller computes from recorded signals."""

import functools
from dataclasses import dataclass
from typing import Any

import casadi
import control as ct
import numpy as np
from scipy import linalg

from .._base.arguments import check_arguments, explain_names
from .._base.arrays import Array
from .._base.errors import CtrlidError, ModelCannotRun
from .._base.periods import have_same_period, write_both_periods, write_difference
from .._base.rounding import keep_numpy_quiet
from ..data.record import Record, hold_readings
from ..data.several_records import order_model_and_data
from ..physics.block_evaluation import BlockEvaluation
from .loop import Loop, exchange_controller, exchange_limits
from .sampled_form import read_matrices
from .wiring import knows_references, match_signals, stack_references


@dataclass(frozen=True, eq=False)
class _ControllerRun:
    """A digital controller along the samples of a record, from any initial state.

    `function` returns the next state and the input from the state and a column of `rows`.
    """

    rest: Array
    rows: Array
    function: casadi.Function

    @functools.cached_property
    def step(self) -> BlockEvaluation:
        """The function, for many samples."""
        return BlockEvaluation(self.function)

    @functools.cached_property
    def slopes(self) -> BlockEvaluation:
        """The next state, and how it and the input depend on the initial state."""
        n = len(self.rest)
        x, s, w = (casadi.SX.sym(k, *size)
                   for k, *size in (("x", n), ("s", n, n), ("w", len(self.rows))))  # fmt: skip
        after, limited = self.function.call([x, w])
        moved, shown = (casadi.mtimes(casadi.jacobian(v, x), s) for v in (after, limited))
        return BlockEvaluation(casadi.Function("slopes", [x, s, w], [after, moved, shown]))

    def compute_outputs(self, start: Array) -> Array:
        """Return what the controller computes, with a row for each of several inputs."""
        values = self.step.iterate(start, self.rows)[:, len(start) :].T
        return values[0] if len(values) == 1 else np.ascontiguousarray(values)

    def differentiate_outputs(self, start: Array) -> Array:
        """Return how the outputs depend on the initial state, one output below the other."""
        n = len(start)
        found = self.slopes.iterate(np.concatenate([start, np.eye(n).ravel()]), self.rows)
        shown = found[:, n + n * n :].T
        return shown.reshape(n, (self.step.rows_out - n) * len(found)).T


def _build_controller_run(
    loop: Loop, y: Array, r: Array | None, u: Array | None = None
) -> _ControllerRun:
    """Return the controller of a loop along all samples.

    An observer reads the input `u` that was applied, or without one what the controller computes.
    """
    law = loop.law()
    if law is None or law.dt == 0.0:
        kind = "no controller" if law is None else "an analog one"
        raise CtrlidError(
            f"only a digital controller can be replayed from the samples; this loop has {kind}"
        )
    n = y.shape[-1]
    if r is not None:
        reference = np.reshape(r, (-1, n))
    elif law.references is None:
        reference = np.full((1, n), loop.point.output)
    else:
        reference = np.tile(np.array(law.references)[:, None], n)
    rows = [np.arange(n)[None] * loop.dt, reference, np.reshape(y, (-1, n))]
    if u is not None and law.reads_input:
        rows.append(np.reshape(u, (-1, n)))
    x, w = casadi.SX.sym("x", len(law.rest)), casadi.SX.sym("w", sum(map(len, rows)))
    t, now, measured, *logged = casadi.vertsplit(w, np.cumsum([0, *map(len, rows)]).tolist())
    wish, after = law.apply(t, x, now, measured)
    lower, upper = (casadi.DM(v) if np.ndim(v) else v for v in loop.input_limits)
    limited = casadi.fmin(casadi.fmax(wish, lower), upper)
    if law.reads_input:
        after = law.apply(t, x, now, measured, logged[0] if logged else limited)[1]
    step = casadi.Function("controller", [x, w], [casadi.vertcat(after), limited])
    return _ControllerRun(np.array(law.rest, dtype=float), np.vstack(rows), step)


def read_references(loop: Loop, record: Record) -> Array | None:
    """Return the references of a loop's controller along a record, with a row for each of several.

    Raises
    ------
    CtrlidError
        If the controller needs one that the record has not.
    """
    wiring = loop.wiring
    if wiring is None:
        return None if record.r is None else np.asarray(record.r)
    return stack_references(wiring, record.r, record.signals.get("r"), len(record))[0]


def run_controller(loop: Loop, y: Array, r: Array | None = None) -> Array:
    """Return what a digital controller, at rest before, computes from a reference and an output.

    Parameters
    ----------
    loop : Loop
        The loop whose controller runs.
    y : ndarray, shape (n,) or (outputs, n)
        Measured output.
    r : ndarray, shape (n,) or (references, n), optional
        Reference; by default constant at the operating point.

    Returns
    -------
    ndarray, shape (n,) or (inputs, n)
        The input, within the limits of the loop.

    Raises
    ------
    CtrlidError
        If the loop has no controller, or an analog one.
    """
    run = _build_controller_run(loop, y, r)
    return run.compute_outputs(run.rest)


@explain_names
@keep_numpy_quiet
def replay_controller(loop: Loop, record: Record) -> Array:
    """Return the input that the controller of a loop computes from a record's own r and y.

    The controller's initial state is not in the record; it is chosen to reproduce the logged u
    best. What then remains between the result and ``record.u`` is not the controller's: injected
    pulses or dither, a channel logged late, another controller. An observer reads the logged u.
    Where readings do not count, the controller had them all the same, or the last ones that do:
    whichever reproduces the logged u better.

    Parameters
    ----------
    loop : Loop
        Loop with a digital controller.
    record : Record
        Record with the references that the controller needs.

    Returns
    -------
    ndarray, shape (n,) or (inputs, n)
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
    loop, record = order_model_and_data(loop, record)
    check_arguments(replay_controller, locals())
    return replay_from_best_state(loop, record)[0]


def sample_analog_controller(loop: Loop, hold_r: str, hold_y: str) -> Loop | None:
    r"""Return the loop with a digital controller that is its analog one at the samples.

    A signal e that runs straight between samples moves the state x of the analog law by

    .. math:: x_{k+1} = \Phi x_k + \Gamma_0 e_k + \Gamma_1 e_{k+1}

    which :math:`x_k - \Gamma_1 e_k` turns into a law that knows nothing of the future; of a signal
    that is held, :math:`\Gamma_1` is zero.

    Parameters
    ----------
    loop : Loop
        Loop with an analog controller.
    hold_r, hold_y : {"zoh", "foh"}
        How reference and output run between the samples.

    Returns
    -------
    Loop or None
        None where the controller is not linear.

    References
    ----------
    Franklin, Powell and Workman, *Digital Control of Dynamic Systems*, section 4.3.2 (triangle
    hold).
    """
    law = loop.controller
    if isinstance(law, int | float | np.number):
        law = ct.tf([float(law)], [1.0])
    if not isinstance(law, ct.TransferFunction | ct.StateSpace):
        return None
    a, b, c, d = read_matrices(law, loop.equations().outputs[0])
    n, dt = len(a), loop.dt
    # The input is a signal and its slope over the period.
    block = np.zeros((n + 4, n + 4))
    block[:n, :n], block[:n, n : n + 2], block[n : n + 2, n + 2 :] = a, b, np.eye(2) / dt
    whole = linalg.expm(dt * block)
    phi, held, slope = whole[:n, :n], whole[:n, n : n + 2], whole[:n, n + 2 :]
    slope = slope * [hold == "foh" for hold in (hold_r, hold_y)]
    sampled = ct.ss(phi, held - slope + phi @ slope, c, d + c @ slope, dt, inputs=["r", "y"])
    return exchange_controller(loop, sampled)


def replay_from_best_state(loop: Loop, record: Record) -> tuple[Array, Array]:
    """Return what `replay_controller` does, and the controller's initial state that it chose."""
    if not have_same_period(loop.dt, record.dt):
        both = write_both_periods("the loop is sampled", loop.dt, "the record", record.dt)
        raise CtrlidError(f"{both}; give both the same period: "
                          f"{write_difference(loop.dt, record.dt)}")  # fmt: skip
    if not loop.equations().siso:
        record = match_signals(record, loop.equations(), loop.wiring)
    if not knows_references(loop.wiring, record):
        raise ModelCannotRun("the record has no reference r, which the controller needs; give it "
                              "r=, a constant for a fixed set-point")  # fmt: skip
    # A reading that does not count may be what the controller had, or be none at all.
    tried = [_replay(loop, one) for one in dict.fromkeys((record, hold_readings(record)))]
    replayed, start, _ = min(tried, key=lambda one: one[2])
    return replayed, start


def _replay(loop: Loop, record: Record) -> tuple[Array, Array, float]:
    """Return input and initial state of a controller that had these readings, and the misfit."""
    r = read_references(loop, record)
    run = _build_controller_run(loop, record.y, r, record.u)
    start = run.rest
    replayed, best = _compare_inputs(run, start, record)
    if start.size and np.isfinite(loop.input_limits).any():
        # From the wrong state all may be cut off, and the state is then nowhere to be seen.
        unlimited = exchange_limits(loop)
        low, high = (np.reshape(v, (-1, 1)) if np.ndim(v) else v for v in loop.input_limits)
        inside = np.ravel((record.u > low) & (record.u < high) & record.valid_somewhere)
        free = _build_controller_run(unlimited, record.y, r, record.u)
        moved = _take_gauss_newton_step(free, start, record.u, inside)
        trial, cost = _compare_inputs(run, moved, record)
        if cost < best:
            start, replayed, best = moved, trial, cost
    # Gauss-Newton: one step where the law is linear in its state, a few more around limits.
    every = np.broadcast_to(record.valid_somewhere, np.shape(record.u)).ravel()
    for _ in range(10 if start.size else 0):
        moved = _take_gauss_newton_step(run, start, record.u, every)
        trial, cost = _compare_inputs(run, moved, record)
        if not cost < best:
            break
        start, replayed, best = moved, trial, cost
    return replayed, start, best


def differentiate_replay(loop: Loop, record: Record) -> tuple[Array, Array, float]:
    """Return what `run_controller` does, its slope by the initial state, and its output at rest."""
    run = _build_controller_run(loop, record.y, read_references(loop, record), record.u)
    still = run_controller(loop, np.full(1, loop.point.output))
    slope = run.differentiate_outputs(run.rest)
    return np.ravel(run.compute_outputs(run.rest)), slope, float(still[0])


def _compare_inputs(run: _ControllerRun, start: Array, record: Record) -> tuple[Array, float]:
    """Return what a controller computes from a state, and how far the logged input is from it."""
    replayed = run.compute_outputs(start)
    left = np.where(record.valid_somewhere, replayed - record.u, 0.0)
    return replayed, float(np.sum(left**2))


def _take_gauss_newton_step(run: _ControllerRun, start: Array, u: Array, use: Any) -> Array:
    """Return a state by one Gauss-Newton step towards a logged input, on the samples to use."""
    jacobian = run.differentiate_outputs(start)
    left = np.ravel(u - run.compute_outputs(start))
    step = np.linalg.lstsq(jacobian[use], left[use], rcond=1e-12)[0]
    return np.asarray(start + step)
