"""Records prepared for the filter of a loop: signals, initial state, and where it restarts."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..._base.arrays import Array
from ..._base.errors import CtrlidError, ModelCannotRun
from ..._base.periods import have_same_period, write_both_periods, write_difference
from ..._base.units import fill_unit
from ...data.reconstruction import count_pieces, reconstruct_signal
from ...data.record import Record
from ...loop.loop import Loop
from ...physics.equations import Equations
from ...physics.linearization import compute_state_matrices

# A record needs at least so many valid samples, or its noise cannot be estimated.
FEWEST = 10
# The model predicts across gaps of at most so many samples; after longer ones the filter restarts.
BRIDGE = 20


@dataclass(frozen=True, eq=False)
class FilterData:
    """A record made ready: signals, and where the filter starts and starts anew.

    Parameters
    ----------
    record : Record
        The record.
    t, u, r, y : ndarray, shape (n,)
        Time since the start of the experiment [s], input, reference (without one the output) and
        output, each held where the record is not valid.
    path : ndarray, shape (n,) or (n * PIECES,)
        The input between the corners of which it runs straight: u itself, or for a band-limited
        one closer points.
    valid, restart : ndarray of bool, shape (n,)
        Samples that are valid; samples at which the filter starts anew.
    input_variance : ndarray, shape (n,)
        Variance of the input, relative to that of the sensor noise.
    start, spread : ndarray, shapes (states,), (states, states)
        State at a start, and its covariance relative to the variance of the sensor noise.
    scale : float
        Standard deviation of the sensor noise, roughly [output unit].
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

    @property
    def usable(self) -> Any:
        """Samples that are valid and no start."""
        return self.valid & ~self.restart


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
    )


def find_noise_units(loop: Loop, record: Record) -> tuple[str, str]:
    """Return the units of sensor noise and of force noise, empty where they are not known."""
    of_plant = loop.known_units.get(loop.equations().outputs[0], "")
    unit = record.units.get("y", "") or of_plant
    if unit in ("", "1"):
        return "", ""
    # Without a moving mass the noise acts on the rates of the states, whose units are not known.
    return unit, fill_unit("{y}/s^2", {"y": unit}) if loop.equations().velocities else ""


def prepare_for_loop(data: FilterData, loop: Loop) -> FilterData:
    """Return data made ready for another model of the same loop; the signals are shared."""
    start, spread, _ = _guess_initial_state(loop, data.record)
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
    for first, stop in record.segments():
        if first - last > bridge:
            restart[max(last, 0) : first + 1] = True
        last = stop
    if len(record) - last > bridge:
        restart[last:] = True
    return restart


def _guess_initial_state(loop: Loop, record: Record) -> tuple[Array, Array, float]:
    """Return an initial state at the operating point, uncertain enough for any record.

    Its covariance is relative to the sensor noise, whose rough standard deviation comes last.
    """
    e, at = loop.equations(keep=True), loop.point
    y = record.y[record.valid]
    reach = float(np.std(y)) + abs(float(np.mean(y)) - at.output)
    # Third differences leave little of a smooth output.
    noise = float(np.std(np.diff(y, 3))) / np.sqrt(20)
    noise = max(noise, 1e-9 * max(abs(at.output), reach), 1e-300)
    speed = max(float(np.std(np.diff(y))) / record.dt, noise / record.dt)
    rest = find_rest_state(loop, e)
    wide = [max(0.1 * abs(v), reach, noise) for v in rest]
    for j in e.velocities:
        wide[j] = speed
    return np.array(rest), np.diag((np.array(wide) / noise) ** 2), noise


def find_rest_state(loop: Loop, e: Equations) -> tuple[float, ...]:
    """Return the state at rest, with effects at their neutral values taking part."""
    # States of effects follow those of the plant and have their own values at rest.
    own = len(e.states) - len(e.rest)
    return (*loop.point.states[:own], *e.rest)
