"""Simulating a loop along a record: what drives it, and from where, in each valid stretch."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .._base.arrays import Array
from .._base.errors import ModelCannotRun
from ..data.record import Record, fill_readings
from ..data.validity import find_runs
from ..estimation.likelihood.filter_data import FEWEST
from ..loop.controller_replay import read_references, replay_from_best_state, run_controller
from ..loop.controller_sight import Sight, find_sight
from ..loop.controllers import PID
from ..loop.initial_state import FEW, FIRST, find_initial_state
from ..loop.loop import Loop
from ..loop.period_map import compute_growth_rate
from ..loop.simulation import Simulator, make_simulator
from ..loop.wiring import knows_references

# A plant that grows by itself is followed along a logged input for so many of its time constants.
FOLLOWED = 3.0


@dataclass(frozen=True, eq=False)
class Stretch:
    """A valid stretch of a record, ready to be simulated.

    Parameters
    ----------
    initial : ndarray
        States of plant, controller and input at its first sample.
    r : ndarray or None
        Reference [output unit]; None without a controller.
    d : ndarray
        What is added to the controller's output [input unit].
    start_time : float
        Time of the first sample since the start of the experiment [s].
    sight : {"reading", "output"}
        Whether an analog controller sees the sensor noise, or only the logger does.
    """

    initial: Array
    r: Array | None
    d: Array
    start_time: float
    sight: Sight = "reading"

    def run(
        self, simulator: Simulator, noise: Sequence[Array] | None = None
    ) -> tuple[Array, Array]:
        """Return simulated output and input, with given sensor and force noise.

        Raises
        ------
        CtrlidError
            If the loop leaves the range in which it can be simulated.
        """
        logged = None
        if noise is not None and self.sight == "output":
            logged, noise = noise[0], [0 * noise[0], *noise[1:]]
        y, u = simulator.run(self.initial, self.r, self.d, noise, self.start_time)
        return y if logged is None else y + np.reshape(logged, np.shape(y)), u


def find_long_stretches(record: Record, loop: Loop, shortest: int = FEWEST) -> list[slice]:
    """Return the stretches of a record that can be simulated and have at least so many samples.

    A controller has to know what all outputs read; without one a slow sensor, most of whose samples
    do not count, takes nothing from the others.
    """
    valid = record.valid_somewhere if loop.controller is None else record.valid_samples
    return [slice(a, b) for a, b in zip(*find_runs(valid), strict=True) if b - a >= shortest]


def prepare_stretch(
    simulator: Simulator, record: Record, samples: slice, *, start_time: float | None = None,
    guess: Array | None = None, seek_controller: bool = False, set_point: bool = False,
    follow: bool = False,
) -> Stretch:  # fmt: skip
    r"""Return what a stretch of a record is simulated with.

    .. math:: d = u - C(r, y)

    is injected: what a digital controller C leaves of the measured input (pulses, dither), or the
    input about the operating point where no controller is known. The initial state of the plant is
    the one from which the simulation follows the first samples best, that of a digital controller
    the one from which it reproduces u best. Ahead of a backlash it is the one from which the plant
    alone follows them along the measured input: the noise that a controller passes on shakes the
    backlash loose, which a simulation without noise leaves out.

    Parameters
    ----------
    simulator : Simulator
        The loop, with the error that its integration may make.
    record : Record
        The data.
    samples : slice
        One of its `find_long_stretches`.
    start_time : float, optional
        Time of the record's first sample since the start of the experiment [s]; by default each
        stretch is an experiment of its own.
    guess : ndarray, optional
        State of the plant from which its initial state is sought; by default rest.
    seek_controller : bool, optional
        Whether the states of an analog controller are sought with the plant's; else it is at rest.
    set_point : bool, optional
        Whether a digital controller without a reference in the record holds the operating point.
    follow : bool, optional
        Whether the record's output is the reference, and its input acts besides the controller.

    Returns
    -------
    Stretch
        Initial state, reference, injected signal and time.

    Raises
    ------
    CtrlidError
        If the controller needs a reference that the record has not.
    """
    loop, part = simulator.loop, record[samples]
    initial, fitted = simulator.rest.copy(), len(simulator.plant_states)
    if guess is not None:
        initial[:fitted] = guess
    middle = loop.point.inputs
    d = part.u - (middle[0] if part.u.ndim == 1 else np.array(middle)[:, None])
    r = None
    if loop.controller is not None and not follow and knows_references(loop.wiring, part):
        r = read_references(loop, part)
    if loop.controller is None:
        pass
    elif follow:
        r = np.asarray(fill_readings(part).y)
    elif loop.analog:
        if r is None:
            raise ModelCannotRun(
                "a loop with an analog controller is simulated from its reference, but the record "
                "has none; give it r=, a constant for a fixed set-point"
            )
        d = np.zeros(np.shape(part.u))
        fitted = len(initial) if seek_controller else fitted
    elif r is None and set_point:
        pid = loop.controller
        if isinstance(pid, PID) and np.isfinite([pid.lower, pid.upper]).any():
            raise ModelCannotRun(
                "a loop with a limited PID is simulated from its reference, but the record has "
                "none; give it r=, a constant for a fixed set-point"
            )
        r = np.full(len(part), loop.point.output)
        d = part.u - run_controller(loop, part.y, r)
    else:
        replayed, state = replay_from_best_state(loop, part)
        # Behind the controller's states stand those of the input: backlash, delayed samples.
        initial[fitted : fitted + len(state)] = state
        d = part.u - replayed
    time = 0.0 if start_time is None else start_time + float(record.t[samples.start] - record.start)
    if loop.controller is not None and not follow and loop.equations().memory is not None:
        start = _follow_input(simulator, part, initial, time)
    else:
        start = find_initial_state(simulator.smooth, part, r, d, initial, fitted, time)
    sight = find_sight(loop, part) if loop.analog and not follow else "reading"
    return Stretch(start, r, d, time, sight)


def _follow_input(simulator: Simulator, part: Record, initial: Array, time: float) -> Array:
    """Return an initial state from which the plant follows the first samples along their input.

    What a controller remembers stays as it is.
    """
    loop = simulator.loop
    plant = make_simulator(
        replace(loop, controller=None), simulator.tolerance, simulator.most, part.hold
    )
    fitted = len(plant.plant_states)
    # Behind the states of plant and controller stands what the input remembers.
    behind = len(plant.rest) - fitted
    guess = np.concatenate([initial[:fitted], initial[len(initial) - behind :]])
    growth = max(compute_growth_rate(plant.loop), 0.0) * loop.dt
    first = FIRST if growth * FIRST < FOLLOWED else max(FEW, math.ceil(FOLLOWED / growth))
    d = part.u - loop.point.input
    found = find_initial_state(plant.smooth, part, None, d, guess, fitted, time, first)
    start = initial.copy()
    start[:fitted], start[len(start) - behind :] = found[:fitted], found[fitted:]
    return start
