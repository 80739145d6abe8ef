"""Records prepared for the filter of a loop: signals, initial state, and where it restarts."""

import math
from dataclasses import dataclass, replace
from typing import Any

import casadi
import numpy as np

from ..._base.arrays import Array
from ..._base.errors import CtrlidError, ModelCannotRun
from ..._base.periods import have_same_period, write_both_periods, write_difference
from ..._base.text import write_count
from ..._base.units import fill_unit
from ...data.reconstruction import count_pieces, reconstruct_signal
from ...data.record import Record
from ...data.validity import find_equal_readings, find_runs
from ...loop.loop import Loop, add_units, find_converter_steps
from ...loop.period_map import count_forces
from ...loop.wiring import knows_references, match_signals, stack_references
from ...physics.equations import Equations
from ...physics.linearization import compute_state_matrices

# A record needs at least so many valid samples, or its noise cannot be estimated.
FEWEST = 10
# The model predicts across gaps of at most so many samples; after longer ones the filter restarts.
BRIDGE = 20
# A rough guess of the noise predicts an output from so many samples before, and tells noise from
# rounding down to this share of the output's standard deviation. It counts where it is less than
# this share of what third differences leave: a guess twice too large costs a state that starts one
# width from rest 2 of log-likelihood.
LAGS = 8
LEAST_NOISE = 1e-6
FAR_LESS = 0.5


@dataclass(frozen=True, eq=False)
class FilterData:
    """A record made ready: signals, and where the filter starts and starts anew.

    Parameters
    ----------
    record : Record
        The record.
    t, u, r, y : ndarray, shape (n,)
        Time since the start of the experiment [s], input, reference (without one the output) and
        output, each held where the record is not valid. Several signals have shape (n, signals).
    path : ndarray, shape (n,) or (n * PIECES,)
        The input between the corners of which it runs straight: u itself, or for a band-limited
        one closer points.
    valid, restart : ndarray of bool, shape (n,)
        Samples that are valid, of shape (n, outputs) for several outputs; samples at which the
        filter starts anew.
    input_variance : ndarray, shape (n,)
        Variance of the input, relative to that of the sensor noise.
    start, spread : ndarray, shapes (states,), (states, states)
        State at a start, and its covariance relative to the variance of the sensor noise.
    scale : float
        Standard deviation of the sensor noise, roughly [output unit]; of several outputs that of
        the first.
    scales : ndarray, shape (outputs,)
        The same for each of several outputs.
    alike, counted : ndarray, shape (n,) or (n, outputs)
        How many readings in a row err alike with each, and those that enter the likelihood, one of
        each row.
    """

    record: Record
    t: Array
    u: Array
    r: Array
    y: Array
    path: Array
    valid: Any
    restart: Any
    input_variance: Array
    start: Array
    spread: Array
    scale: float
    scales: Array
    alike: Array
    counted: Any

    @property
    def usable(self) -> Any:
        """Readings that count and are no start."""
        return self.counted & ~(self.restart if self.valid.ndim == 1 else self.restart[:, None])


def make_filter_data(loop: Loop, record: Record, start_time: float = 0.0) -> FilterData:
    """Make a record ready for the filter of a loop; `start_time` is the time of its first sample.

    Raises
    ------
    CtrlidError
        If the sampling periods differ, too few samples are valid, or the input of a loop with a
        controller is said to be band-limited.
    """
    if record.hold == "bandlimited" and loop.controller is not None:
        raise CtrlidError(
            "hold='bandlimited' reconstructs u between the samples from later ones as well, and "
            "under feedback these contain the noise of y. The loop has a controller: give the "
            "record hold='zoh' for a digital or hold='foh' for an analog one, as in "
            "dataclasses.replace(record, hold='zoh'), or a Loop without controller if u did not "
            "react to y"
        )
    if not have_same_period(loop.dt, record.dt):
        both = write_both_periods("the loop is sampled", loop.dt, "the record", record.dt)
        raise CtrlidError(f"{both}; give both the same period: "
                          f"{write_difference(loop.dt, record.dt)}")  # fmt: skip
    if not loop.equations().siso:
        return _make_several(loop, record, start_time)
    record = match_signals(record, loop.equations())
    # The copy is writable as all other arrays are, so that the filter is compiled only once.
    valid = np.array(record.valid)
    if np.count_nonzero(valid) < FEWEST:
        raise ModelCannotRun(
            f"a prediction needs at least {FEWEST} valid samples; the record has "
            f"{np.count_nonzero(valid)} of {len(record)}"
        )
    last = np.maximum.accumulate(np.where(valid, np.arange(len(record)), 0))
    y, u = np.asarray(record.y)[last], np.asarray(record.u)[last]
    r = y if record.r is None else np.asarray(record.r)[last]
    start, spread, scale = _guess_initial_state(loop, record)
    input_variance = np.where(valid, 0.0, (np.std(record.u[valid]) / scale) ** 2)
    t = start_time + record.t - record.start
    path = u if count_pieces(record.hold) == 1 else reconstruct_signal(u, valid)
    return FilterData(
        record,
        t,
        u,
        r,
        y,
        path,
        valid,
        find_segment_starts(loop, record),
        input_variance,
        start,
        spread,
        scale,
        np.array([scale]),
        *(v[:, 0] for v in _find_runs_of_readings(loop, y[:, None], valid[:, None])),
    )


def can_follow_controller(loop: Loop, record: Record) -> bool:
    """Return whether a known analog controller tells how the input runs between samples."""
    return knows_references(loop.wiring, record) and loop.analog


def _make_several(loop: Loop, record: Record, start_time: float) -> FilterData:
    """Make a record of several signals ready; see `make_filter_data`."""
    e, wiring = loop.equations(), loop.wiring
    record = match_signals(record, e, wiring)
    n = len(record)
    valid = np.array(record.valid_outputs.T)
    if np.any(valid.sum(axis=0) < FEWEST):
        raise ModelCannotRun(
            f"a prediction needs at least {FEWEST} valid samples of each output; the record has "
            f"{valid.sum(axis=0).tolist()} of {n}"
        )
    seen = valid.any(axis=1)
    last = np.maximum.accumulate(np.where(seen, np.arange(n), 0))
    each = np.maximum.accumulate(np.where(valid, np.arange(n)[:, None], 0), axis=0)
    y = np.take_along_axis(np.reshape(record.y, (-1, n)).T, each, axis=0)
    u = np.ascontiguousarray(np.reshape(record.u, (-1, n)).T[last])
    r = np.zeros((n, 1))
    if wiring is not None and can_follow_controller(loop, record):
        r = stack_references(wiring, record.r, record.signals.get("r"), n)[0].T[last]
    start, spread, scales = _guess_several_states(loop, record)
    # An input that was not logged may be anything that it was elsewhere.
    input_variance = np.where(seen, 0.0, 1.0 / scales[0] ** 2)
    t = start_time + record.t - record.start
    path = u
    if count_pieces(record.hold) > 1:
        path = np.column_stack([reconstruct_signal(column) for column in u.T])
    runs = _find_runs_of_readings(loop, y, valid)
    return FilterData(record, t, u, r, np.ascontiguousarray(y), path, valid,
                      find_segment_starts(loop, record), input_variance, start, spread,
                      float(scales[0]), scales, *runs)  # fmt: skip


def _find_runs_of_readings(loop: Loop, y: Array, valid: Any) -> tuple[Array, Any]:
    """Return how many readings err alike with each, and those that count; columns are outputs.

    Equal readings in a row do, where the loop has the steps of a converter (`Quantization`).
    """
    alike, counted = np.ones(y.shape), valid.copy()
    for k, step in enumerate(find_converter_steps(loop)):
        if not step:
            continue
        alike[:, k], counted[:, k] = find_equal_readings(y[:, k], valid[:, k])
        count = int(np.count_nonzero(counted[:, k]))
        if count < FEWEST:
            raise ModelCannotRun(
                f"{loop.signals['y'][k]} changes its reading only {write_count(count - 1, 'time')}"
                f", and equal readings in a row count once; a prediction needs {FEWEST} of them"
            )
    return alike, counted


def find_noise_units(loop: Loop, record: Record) -> tuple[Any, Any]:
    """Return the units of sensor noise and of force noise, empty where they are not known.

    Of several outputs and forces, tuples of them.
    """
    e, known = loop.equations(), loop.known_units
    given = record.units.get("y", "")
    sensors = tuple(
        (given[k] if isinstance(given, tuple) else given) or known.get(name, "")
        for k, name in enumerate(e.outputs)
    )
    # The units of the record are those of the states, too, that the outputs show as they are.
    told = add_units(loop, {n: u for n, u in zip(e.outputs, sensors, strict=True) if u})
    if has_several_noises(e):
        _, rates = name_noise_places(loop)
        forces = e.push_units or ("",) * len(rates)
        return sensors[0] if e.siso else sensors, tuple(
            force or _find_rate_unit(told, name) for force, name in zip(forces, rates, strict=True)
        )
    if sensors[0] in ("", "1"):
        return "", ""
    return sensors[0], _find_rate_unit(told, "" if e.velocities else e.states[0])


def has_several_noises(e: Equations) -> bool:
    """Whether the noises are told one by one: of several outputs, and of several forces."""
    return not e.siso or count_forces(e) > 1


def _find_rate_unit(loop: Loop, state: str) -> str:
    """Return the unit of the rate of a state, or of the moving mass; empty if it is not known."""
    e = loop.equations()
    if not e.velocities:
        unit = loop.state_units.get(state, "")
        return fill_unit("{x}/s", {"x": unit}) if unit else ""
    position = loop.position_units.get(state, loop.position_unit)
    return "" if position.startswith("[") else fill_unit("{x}/s^2", {"x": position})


def name_noise_places(loop: Loop) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the output of each sensor noise, and the velocity of each force of several signals.

    A plant without a moving mass has noise on the rates of its states.
    """
    e = loop.equations()
    own = e.states[: len(e.states) - len(e.rest)]
    return tuple(e.outputs), tuple(e.states[j] for j in e.velocities) or tuple(own)


def prepare_for_loop(data: FilterData, loop: Loop) -> FilterData:
    """Return data made ready for another model of the same loop; the signals are shared."""
    guess = _guess_initial_state if loop.equations().siso else _guess_several_states
    start, spread, _ = guess(loop, data.record, data.scales)
    return replace(data, restart=find_segment_starts(loop, data.record), start=start, spread=spread)


def find_segment_starts(loop: Loop, record: Record) -> Any:
    """Return the samples at which the filter restarts: the first ones and those after long gaps."""
    e = loop.equations()
    poles = np.linalg.eigvals(compute_state_matrices(e, loop.point)[0])
    fastest = np.max(np.abs(poles) if e.dt else np.exp(poles.real * loop.dt), initial=0.0)
    # An unstable model may bridge as long as its errors grow by less than half.
    bridge = BRIDGE if fastest <= 1 else min(BRIDGE, int(np.log(1.5) / np.log(fastest)))
    restart = np.zeros(len(record), dtype=bool)
    last = -BRIDGE - 1
    seen = record.valid_outputs.any(axis=0)
    for first, stop in zip(*find_runs(seen), strict=True):
        if first - last > bridge:
            restart[max(last, 0) : first + 1] = True
        last = stop
    if len(record) - last > bridge:
        restart[last:] = True
    return restart


def _guess_initial_state(
    loop: Loop, record: Record, noises: Array | None = None
) -> tuple[Array, Array, float]:
    """Return an initial state at the operating point, uncertain enough for any record.

    Its covariance is relative to the sensor noise, whose rough standard deviation comes last; it is
    guessed unless `noises` has it.
    """
    e, at = loop.equations(keep=True), loop.point
    y = record.y[record.valid]
    reach = float(np.std(y)) + abs(float(np.mean(y)) - at.output)
    known = _guess_noise(y, record.u[None, record.valid]) if noises is None else float(noises[0])
    noise = max(known, 1e-9 * max(abs(at.output), reach), 1e-300)
    speed = max(float(np.std(np.diff(y))) / record.dt, noise / record.dt)
    rest = find_rest_state(loop, e)
    wide = [max(0.1 * abs(v), reach, noise) for v in rest]
    for j in e.position_rates:
        wide[j] = speed
    widened = _widen_hidden_states(loop, record, np.array(rest), np.array(wide))
    return np.array(rest), np.diag((widened / noise) ** 2), noise


def _widen_hidden_states(loop: Loop, record: Record, rest: Array, wide: Array) -> Array:
    r"""Return how uncertain states are at first, those that nothing shows in their own unit.

    .. math:: \sigma_k = \min\Bigl(\frac{1}{|a_{kk}|}, t_N\Bigr) \sqrt{\sum_{j \neq k}
        (a_{kj} \sigma_j)^2 + \sum_i (b_{ki} \sigma_{u,i})^2}

    at least, for a state that comes to rest by itself, as the current of a coil does. Its motion is
    that of what drives it.

    Parameters
    ----------
    loop : Loop
        The loop.
    record : Record
        What tells how wide each input is, and the length :math:`t_N` [s].
    rest, wide : ndarray, shape (n,)
        All states at rest, and how uncertain they are by what outputs show.
    """
    e = loop.equations(keep=True)
    if e.dt:
        return wide
    u = np.reshape(record.u, (len(e.inputs), -1))[:, record.valid_outputs.any(axis=0)]
    drive = np.std(u, axis=1) + np.abs(np.mean(u, axis=1) - np.array(loop.point.inputs))
    slowest = 1 / (record.dt * len(record))
    # Wide against every kink.
    a, b, c, _ = compute_state_matrices(e, replace(loop.point, states=tuple(rest)), spread=1e6)
    shown = np.any(c != 0, axis=0)
    own = len(rest) - len(e.rest)
    hidden = [k for k in range(own)
              if not shown[k] and k not in e.velocities and a[k, k] < 0]  # fmt: skip
    wide = wide.copy()
    for _ in hidden:
        for k in hidden:
            others = np.delete(a[k] * wide, k)
            moved = math.sqrt(float(np.sum(others**2) + np.sum((b[k] * drive) ** 2)))
            wide[k] = max(wide[k], moved / max(-a[k, k], slowest))
    return wide


def _guess_several_states(
    loop: Loop, record: Record, noises: Array | None = None
) -> tuple[Array, Array, Array]:
    """Return an initial state, its covariance and the rough sensor noise of several outputs.

    The noise is guessed unless `noises` has it. The covariance is relative to that of the first
    output. A state that outputs show is as uncertain as they are wide, a velocity as its position
    moves.
    """
    e, at = loop.equations(keep=True), loop.point
    ys = np.reshape(record.y, (len(e.outputs), -1))
    rest = np.array(find_rest_state(loop, e))
    # Wide against every kink: only what the outputs show is needed here.
    _, _, c, _ = compute_state_matrices(e, replace(at, states=tuple(rest)), spread=1e6)
    wide, moving = np.zeros(len(rest)), np.zeros(len(rest))
    scales = np.zeros(len(ys))
    for k, (y, use, middle) in enumerate(zip(ys, record.valid_outputs, at.outputs, strict=True)):
        seen = y[use]
        reach = float(np.std(seen)) + abs(float(np.mean(seen)) - middle)
        noise = (_guess_noise(seen, np.reshape(record.u, (-1, len(use)))[:, use])
                 if noises is None else float(noises[k]))  # fmt: skip
        scales[k] = max(noise, 1e-9 * max(abs(middle), reach), 1e-300)
        speed = max(float(np.std(np.diff(seen))) / record.dt, scales[k] / record.dt)
        shown = np.abs(c[k]) > 1e-9 * np.max(np.abs(c[k]), initial=0.0)
        with np.errstate(divide="ignore"):
            wide = np.where(shown, np.maximum(wide, max(reach, scales[k]) / np.abs(c[k])), wide)
            moving = np.where(shown, np.maximum(moving, speed / np.abs(c[k])), moving)
    for j in e.velocities:
        rates = [i for i in range(len(rest)) if i != j and casadi.is_equal(e.rhs[i], e.x[j], 2)]
        wide[j] = max(wide[j], *(moving[i] for i in rates), 0.0)
    # What no output shows directly is as wide as the widest, whatever its unit.
    wide = np.where(wide > 0, wide, 10 * max(float(wide.max()), float(np.max(np.abs(rest)))))
    wide = np.maximum(wide, 0.1 * np.abs(rest))
    wide = _widen_hidden_states(loop, record, rest, wide)
    return rest, np.diag((wide / scales[0]) ** 2), scales


def _guess_noise(y: Array, u: Array) -> float:
    """Return a rough standard deviation of the noise of an output, given the inputs as rows.

    It is what third differences leave, which is little of an output that is sampled densely, or
    what a regression on the samples before leaves, if that is far less. A guess far too large would
    hold the state at the start near rest, against the readings, once a fit finds the noise small.
    """
    third = float(np.std(np.diff(y, 3)) / np.sqrt(20))
    count = len(y) - LAGS
    if count < 4 * LAGS * (1 + len(u)):
        return third
    # The input of the same sample is left out: under feedback it tells what is to be predicted.
    columns = [s[LAGS - k : len(s) - k] for s in (y, *u) for k in range(1, LAGS + 1)]
    past = np.column_stack([np.ones(count), *columns])
    left = y[LAGS:] - past @ np.linalg.lstsq(past, y[LAGS:], rcond=None)[0]
    # Of an output without noise both leave next to nothing, and rounding is no measure.
    noise = float(max(np.std(left), LEAST_NOISE * np.std(y)))
    return noise if noise < FAR_LESS * third else third


def find_rest_state(loop: Loop, e: Equations) -> tuple[float, ...]:
    """Return the state at rest, with effects at their neutral values taking part."""
    # States of effects follow those of the plant and have their own values at rest.
    own = len(e.states) - len(e.rest)
    return (*loop.point.states[:own], *e.rest)
