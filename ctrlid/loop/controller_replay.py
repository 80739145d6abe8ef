"""The input that a loop's controller computes from recorded signals."""

import math
from dataclasses import replace
from typing import Any

import casadi
import numpy as np

from .._base.arguments import check_arguments
from .._base.arrays import Array
from .._base.errors import CtrlidError, ModelCannotRun
from .._base.periods import have_same_period, write_both_periods, write_difference
from .._base.rounding import keep_numpy_quiet
from .._base.signals import require_one_signal
from ..data.record import Record
from ..data.several_records import order_model_and_data
from .loop import Loop


def _build_controller_run(loop: Loop, y: Array, r: Array | None) -> tuple[Any, Array]:
    """Return the controller over all samples as a function of its initial state, and its rest."""
    law = loop.law()
    if law is None or law.dt == 0.0:
        kind = "no controller" if law is None else "an analog one"
        raise CtrlidError(
            f"only a digital controller can be replayed from the samples; this loop has {kind}"
        )
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


def run_controller(loop: Loop, y: Array, r: Array | None = None) -> Array:
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
    run, rest = _build_controller_run(loop, y, r)
    return np.asarray(run(rest), float).ravel()


@keep_numpy_quiet
def replay_controller(loop: Loop, record: Record) -> Array:
    """Return the input that the controller of a loop computes from a record's own r and y.

    The controller's initial state is not in the record; it is chosen to reproduce the logged u
    best. What then remains between the result and ``record.u`` is not the controller's: injected
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
    loop, record = order_model_and_data(loop, record)
    check_arguments(replay_controller, locals())
    return replay_from_best_state(loop, record)[0]


def replay_from_best_state(loop: Loop, record: Record) -> tuple[Array, Array]:
    """Return what `replay_controller` does, and the controller's initial state that it chose."""
    require_one_signal("replay_controller", loop, record)
    if not have_same_period(loop.dt, record.dt):
        both = write_both_periods("the loop is sampled", loop.dt, "the record", record.dt)
        raise CtrlidError(f"{both}; give both the same period: "
                          f"{write_difference(loop.dt, record.dt)}")  # fmt: skip
    if record.r is None:
        raise ModelCannotRun("the record has no reference r, which the controller needs; give it "
                              "r=, a constant for a fixed set-point")  # fmt: skip
    run, start = _build_controller_run(loop, record.y, record.r)
    replayed, best = _compare_inputs(run, start, record)
    if start.size and np.isfinite(loop.input_limits).any():
        # From the wrong state all may be cut off, and the state is then nowhere to be seen.
        unlimited = replace(loop, input_limits=(-math.inf, math.inf))
        inside = (record.u > loop.input_limits[0]) & (record.u < loop.input_limits[1])
        free, _ = _build_controller_run(unlimited, record.y, record.r)
        moved = _take_gauss_newton_step(
            free, _differentiate_outputs(free, start.size), start, record.u, inside
        )
        trial, cost = _compare_inputs(run, moved, record)
        if cost < best:
            start, replayed, best = moved, trial, cost
    # Gauss-Newton: one step where the law is linear in its state, a few more around limits.
    slope, every = _differentiate_outputs(run, start.size), np.full(len(record), True)
    for _ in range(10 if start.size else 0):
        moved = _take_gauss_newton_step(run, slope, start, record.u, every)
        trial, cost = _compare_inputs(run, moved, record)
        if not cost < best:
            break
        start, replayed, best = moved, trial, cost
    return replayed, start


def differentiate_replay(loop: Loop, record: Record) -> tuple[Array, Array, float]:
    """Return what `run_controller` does, its slope by the initial state, and its output at rest."""
    run, rest = _build_controller_run(loop, record.y, record.r)
    slope = np.asarray(_differentiate_outputs(run, rest.size)(rest).full(), float)
    still = run_controller(loop, np.full(1, loop.point.output))
    return np.asarray(run(rest), float).ravel(), slope, float(still[0])


def _compare_inputs(run: Any, start: Array, record: Record) -> tuple[Array, float]:
    """Return what a controller computes from a state, and how far the logged input is from it."""
    replayed = np.asarray(run(start), float).ravel()
    return replayed, float(np.sum((replayed - record.u) ** 2))


def _differentiate_outputs(run: Any, size: int) -> Any:
    """Return how the outputs of a controller depend on its initial state, as a function of it."""
    state = casadi.MX.sym("state", size)
    return casadi.Function("slope", [state], [casadi.jacobian(run(state), state)])


def _take_gauss_newton_step(run: Any, slope: Any, start: Array, u: Array, use: Any) -> Array:
    """Return a state by one Gauss-Newton step towards a logged input, on the samples to use."""
    jacobian = np.asarray(slope(start).full(), float)
    left = u - np.asarray(run(start), float).ravel()
    step = np.linalg.lstsq(jacobian[use], left[use], rcond=1e-12)[0]
    return np.asarray(start + step)
