"""Simulating a loop: sampled or analog controller, held signals, noise, and failures in words."""

import functools
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._base.arguments import check_arguments, explain_names, point_at_part, shorten_value
from .._base.arrays import Array, to_real_array
from .._base.errors import CtrlidError, CtrlidWarning, ModelCannotRun
from .._base.interruption import hold_interrupt
from .._base.rounding import keep_numpy_quiet
from .._base.text import write_list
from ..data.reconstruction import PIECES, count_pieces, reconstruct_signal
from ..data.record import Record
from ..effects import Quantization
from .loop import Loop
from .period_map import (
    PeriodMap,
    compute_growth_rate,
    count_signals,
    leave_out_kinks,
    linearize_at_rest,
    make_period_map,
)
from .wiring import STATE_FEEDBACK, stack_references, suggest_transpose

# Steps are refined until their local error is below this share of each state's excursion.
TOLERANCE = 1e-9
# A local error above this share, which could not be refined further, causes a warning.
COARSE = 1e-5
# A period has at most so many integration steps, which bounds the time of a simulation.
MOST_SUBSTEPS = 128
# So many samples run at once, so that one compiled function serves records of any length.
CHUNK = 2048
# An output so many times further from rest than anything that was asked for has run away.
RUNAWAY = 1e3
# The last loops that were simulated are kept, ready to run again: making one takes as long as
# several thousand samples.
KEPT = 8


class SimulationStopped(ModelCannotRun):
    """A loop that left the range in which it can be simulated.

    `y` is its output until then, `unstable` whether small deviations grow in it.
    """

    y: Array = np.empty(0)
    unstable: bool = False


@explain_names
@hold_interrupt()
@keep_numpy_quiet
def simulate(
    loop: Loop,
    r: Any = None,
    *,
    sensor_noise: Any = 0.0,
    force_noise: Any = 0.0,
    d: Any = None,
    initial: Sequence[float] | None = None,
    seed: int | None = None,
) -> Record:
    """Simulate a loop and return the record that its data logger would write.

    At sample k the output is measured, ``y[k] = h(x(kT)) + noise``, the controller computes
    ``u[k]`` from it, and a digital one holds u until the next sample; a continuous controller is
    integrated together with the plant. The reference, the injected signal and the noise are held
    over each period. Steps are of order eight, as many per period as an error of 1e-9 of each
    state's excursion needs.

    Parameters
    ----------
    loop : Loop
        The loop; without a controller, ``u = at.input + d``.
    r : array_like, shape (n,) or (references, n), or mapping of str to array_like, optional
        Reference [output unit]; needed if the loop has a controller. A controller of several
        signals has references by name, as `loop.wiring` lists them: one row for each that cannot be
        held, or for all, or a mapping of their names.
    sensor_noise : float or sequence of float, optional
        Standard deviation of white noise on the measured output [output unit], one for each of
        several outputs.
    force_noise : float or sequence of float, optional
        Standard deviation of a white acceleration, held over each period [output unit/s^2]; of a
        plant with several signals one for each velocity, in the unit of the force that works on it
        (`Loop.forces`). Without a moving mass, of a noise on the rate of each state, such as a feed
        that fluctuates: one number for each state [its unit/s], or one for all.
    d : array_like, shape (n,) or (inputs, n), optional
        Signal added to the controller's output, ahead of the limits [input unit]: dither, pulses.
    initial : sequence of float, optional
        Initial plant states, or plant and controller states [their units]; by default those at
        rest.
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
    check_arguments(simulate, locals(), "loop", "sensor_noise", "force_noise")
    if not isinstance(loop, Loop):
        raise CtrlidError(
            "simulate needs a Loop(plant, controller, dt=..., at=...); given "
            f"{type(loop).__name__}{point_at_part(loop, Loop)}"
        )
    r, d, names = _check_signals(loop, r, d)
    noise = _draw_noise(loop, d.shape[-1], sensor_noise, force_noise, seed)
    simulator = make_simulator(loop)
    y, u = simulator.run(simulator.start(initial), r, d, noise)
    e = loop.equations()
    known = loop.known_units
    if names is not None or not e.siso:
        return _make_record(loop, r, u, y, names or ())
    signals = {"r": e.outputs[0], "u": e.inputs[0], "y": e.outputs[0]}
    units = {key: known[name] for key, name in signals.items() if name in known}
    return Record(
        r=r, u=u, y=y, dt=loop.dt, hold="foh" if loop.analog else "zoh",
        names={"u": e.inputs[0], "y": e.outputs[0]}, name=e.name,
        units={k: unit for k, unit in units.items() if k != "r" or r is not None},
    )  # fmt: skip


def _make_record(loop: Loop, r: Any, u: Array, y: Array, names: tuple[str, ...]) -> Record:
    """Return the record of a loop with several signals, with the references that were given."""
    e, wiring = loop.equations(), loop.wiring
    known = loop.known_units
    signals = {"r": names, "u": e.inputs, "y": e.outputs}
    if names:
        assert wiring is not None
        r = r[[wiring.open.index(name) for name in names]]
    else:
        signals.pop("r")
    units = {key: tuple(known.get(name, "") for name in each) for key, each in signals.items()}
    return Record(
        r=r if names else None, u=u, y=y, dt=loop.dt, hold="foh" if loop.analog else "zoh",
        names=signals, name=e.name, units={k: each for k, each in units.items() if any(each)},
    )  # fmt: skip


def _check_signals(
    loop: Loop, r: Any, d: Any
) -> tuple[Array | None, Array, tuple[str, ...] | None]:  # fmt: skip
    """Return references and injected signal as arrays, and the names of several references."""
    wiring, inputs = loop.wiring, len(loop.equations().inputs)
    if wiring is not None or inputs > 1:
        return _check_several_signals(loop, r, d)
    arrays = {}
    for name, value in (("r", r), ("d", d)):
        if value is None:
            continue
        if isinstance(value, Mapping):
            raise CtrlidError(
                f"simulate takes {name} as an array, because this loop has a single one; given a "
                f"mapping of {write_list([str(key) for key in value])}. Give its series alone"
            )
        array = to_real_array(value, f"simulate needs {name} as an array of numbers: they")
        if array.ndim == 2 and 1 in array.shape:
            raise CtrlidError(f"simulate needs {name} as a one-dimensional array, one number for "
                              f"each sample; given shape {array.shape}. Give {name}.ravel()"
                              )  # fmt: skip
        if array.ndim != 1 or array.size < 2 or not np.isfinite(array).all():
            raise CtrlidError(
                f"simulate needs {name} as a one-dimensional array of at least 2 finite numbers, "
                f"one per sample; given shape {array.shape}"
                + (
                    f" with {lost} not finite"
                    if (lost := np.count_nonzero(~np.isfinite(array)))
                    else ""
                )
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
    return arrays.get("r"), arrays.get("d", np.zeros(size)), None


def _check_several_signals(loop: Loop, r: Any, d: Any) -> tuple[Array, Array, tuple[str, ...]]:
    """Return the series of a wired controller's open inputs, the injected ones, and names."""
    inputs = loop.equations().inputs
    if isinstance(r, Mapping):
        r = {name: np.asarray(v, dtype=float) for name, v in r.items()}
    try:
        parts = [None if v is None else np.asarray(v, dtype=float) for v in
                 (None if isinstance(r, Mapping) else r, d)]  # fmt: skip
    except (TypeError, ValueError) as reason:
        raise CtrlidError(f"simulate needs r and d as arrays of numbers; {reason}") from reason
    series = [*parts, *(r.values() if isinstance(r, Mapping) else ())]
    for v in series:
        if v is not None and (v.ndim not in (1, 2) or v.shape[-1] < 2 or not np.isfinite(v).all()):
            cure = ". Give its transpose, .T" if v.ndim == 2 and v.shape[0] > v.shape[1] else ""
            raise CtrlidError("simulate needs r and d with at least 2 finite samples, of shape "
                              f"(n,) or (signals, n); given shape {v.shape}{cure}")  # fmt: skip
    given = r if isinstance(r, Mapping) else parts[0]
    injected = None if parts[1] is None else np.atleast_2d(parts[1])
    if injected is not None and len(injected) != len(inputs):
        raise CtrlidError(f"d needs one row for each input ({', '.join(inputs)}); given shape "
                          f"{injected.shape}{suggest_transpose('d', injected)}"
                          )  # fmt: skip
    if loop.wiring is None:
        if injected is None:
            raise CtrlidError("simulate needs r or d to know how many samples to run; an open loop "
                              "is driven by d (u = at.input + d)")  # fmt: skip
        return np.zeros((1, injected.shape[1])), injected, ()
    n = None if injected is None else injected.shape[1]
    references, names = stack_references(loop.wiring, given, None, n)
    n = n or references.shape[1]
    if references.shape[1] != n:
        raise CtrlidError(f"r and d must be equally long; given {references.shape[1]} and {n}")
    return references, np.zeros((len(inputs), n)) if injected is None else injected, names


def _draw_noise(loop: Loop, n: int, sensor: Any, force: Any, seed: int | None) -> list[Array]:
    *_, outputs, forces = count_signals(loop)
    sizes = []
    for name, value, count in (("sensor_noise", sensor, outputs), ("force_noise", force, forces)):
        array = np.ravel(to_real_array(value, f"{name} is a standard deviation >= 0: it"))
        good = np.asarray(value).dtype.kind != "b" and array.size in (1, count)
        if not (good and np.isfinite(array).all() and (array >= 0).all()):
            each = f", or {count} of them" if count > 1 else ""
            raise CtrlidError(
                f"{name} is a standard deviation >= 0{each}; given {shorten_value(value)}"
            )
        sizes.append(np.broadcast_to(array, count))
    e = loop.equations()
    if sizes[1].any() and e.dt and not e.velocities:
        raise CtrlidError(
            f"force_noise acts on rates, and {e.name} is in discrete time without a moving mass. "
            "Use d= for a disturbance of the input"
        )
    if seed is not None and seed < 0:
        raise CtrlidError(f"seed is a whole number from 0 upwards, or None; given {seed}")
    # Each noise has its own stream, so that switching one on does not change the other.
    streams = np.random.default_rng(seed).spawn(2)
    return [
        s.standard_normal((len(v), n)) * v[:, None] for s, v in zip(streams, sizes, strict=True)
    ]


@functools.lru_cache(maxsize=KEPT)
def make_simulator(
    loop: Loop, tolerance: float = TOLERANCE, most: int = MOST_SUBSTEPS,
    hold: str = "zoh", hold_r: str = "zoh",
) -> "Simulator":  # fmt: skip
    """Return a loop made ready to run many times; the last ones are kept."""
    return Simulator(loop, tolerance, most, hold, hold_r)


class Simulator:
    """A loop made ready to run many times; `make_simulator` makes it, or finds one kept.

    Parameters
    ----------
    loop : Loop
        The loop.
    tolerance : float, optional
        Local error of a step, relative to the excursion of each state.
    most : int, optional
        Integration steps per period at most.
    hold : {"zoh", "foh", "bandlimited"}, optional
        How the input of a loop without controller runs between samples.
    hold_r : {"zoh", "foh"}, optional
        How the reference of an analog controller runs between samples.
    """

    def __init__(
        self, loop: Loop, tolerance: float = TOLERANCE, most: int = MOST_SUBSTEPS,
        hold: str = "zoh", hold_r: str = "zoh",
    ) -> None:  # fmt: skip
        self.loop, self.tolerance, self.most, self.hold = loop, tolerance, most, hold
        self.hold_r = hold_r if loop.analog else "zoh"
        first = make_period_map(loop, 1, hold, self.hold_r)
        self.plant_states, self.counts = first.plant_states, first.counts
        self._still = first.still
        self.rest: Array = np.array(first.rest, dtype=float)
        self._steps: dict[int, Any] = {1: first.step}
        self._runners: dict[tuple[int, int], Any] = {}
        e = loop.equations()
        if not np.isfinite(e.evaluate(first.rest[: len(e.states)], loop.point.inputs)[0]).all():
            raise ModelCannotRun(
                f"{e.name} is not defined at the operating point, {loop.point}; give "
                "at=operating_point(plant, output=...)"
            )
        # An undamped plant neither grows nor decays; round-off must not decide which.
        self._unstable = loop.controller is None and compute_growth_rate(loop) * loop.dt > 1e-6
        # What a millionth of the operating values does to each state: smaller motion is rest. What
        # sticks there says nothing of motion.
        plain = leave_out_kinks(loop, memories=False)
        moving = first if plain is loop else make_period_map(plain, 1, hold, self.hold_r)
        self._motion = linearize_at_rest(moving, moving.step)
        self._kinks = self._measure_kinks(moving) if moving is not first else 0 * self.rest
        a, b = (np.nan_to_num(np.abs(m)) for m in self._motion)
        now, ahead = first.places[2], first.places[5]
        # The corners of a band-limited input are those of all inputs in turn.
        inputs = np.abs(loop.point.inputs)
        following = b[:, ahead].reshape(len(b), -1, len(inputs)).sum(axis=1)
        self._floor = 1e-6 * (a @ np.abs(self.rest) + (b[:, now] + following) @ inputs)

    @functools.cached_property
    def smooth(self) -> "Simulator":
        """The same loop without the steps of converters, which hide every small change."""
        loop = self.loop
        for effect in self.loop.effects:
            if isinstance(effect, Quantization):
                loop = loop.without_effect(effect)
        if loop is self.loop:
            return self
        return make_simulator(loop, self.tolerance, self.most, self.hold, self.hold_r)

    def _measure_kinks(self, plain: PeriodMap) -> Array:
        """Return by how much kinks, such as dry friction, change the states in one period at most.

        They are looked for in motion away from rest, one state at a time. A loop that sticks may
        swing to and fro by as much without any reference.
        """
        size = len(self.rest)
        if len(plain.rest) != size:
            return np.zeros(size)
        sizes = np.concatenate([sign * np.geomspace(1e-6, 1.0, 7) for sign in (1, -1)])
        away = np.einsum("k,ij->kij", sizes, np.diag(np.maximum(np.abs(self.rest), 1.0)))
        z = (self.rest + away.reshape(-1, size)).T
        given = z, np.tile(self._still[:, None], z.shape[1])
        with_kinks, without = (
            np.asarray(step.map(z.shape[1])(*given)[0], float)
            for step in (self._steps[1], plain.step)
        )
        found = np.abs(with_kinks - without)
        return np.asarray(np.max(np.where(np.isfinite(found), found, 0.0), axis=1))

    def start(self, initial: Sequence[float] | None) -> Array:
        """Return the state to start from: at rest, or with the given values."""
        z, n = self.rest.copy(), len(self.plant_states)
        if initial is not None:
            given = np.atleast_1d(to_real_array(initial, "initial states"))
            if given.ndim > 1 or given.size not in (n, z.size) or not np.isfinite(given).all():
                raise CtrlidError(
                    f"initial needs {n} plant states ({', '.join(self.plant_states)}) or these and "
                    f"{z.size - n} controller states, all finite; given {given.tolist()}"
                )
            z[: given.size] = given
        return z

    def _build_runner(self, substeps: int, size: int) -> Any:
        key = (substeps, size)
        if key not in self._runners:
            if substeps not in self._steps:
                self._steps[substeps] = make_period_map(
                    self.loop, substeps, self.hold, self.hold_r
                ).step
            self._runners[key] = self._steps[substeps].mapaccum("run", size)
        return self._runners[key]

    def _find_path(self, d: Array) -> Array:
        """Return how d runs on within each period: the next sample, or the corners until there."""
        following = np.hstack([d[:, 1:], d[:, -1:]])
        if self.loop.controller is not None or count_pieces(self.hold) == 1:
            return following
        corners = np.array([reconstruct_signal(row).reshape(-1, PIECES).T for row in d])
        last = np.hstack([corners[:, 0, 1:], following[:, -1:]])
        path: Array = np.concatenate([*corners.transpose(1, 0, 2), last])
        return path

    def stack_signals(
        self, r: Array | None, d: Array, noise: Sequence[Array] | None = None,
        start_time: float = 0.0,
    ) -> Array:  # fmt: skip
        """Return the second argument of the period's map, a column for each sample."""
        n = d.shape[-1]
        _, references, inputs, outputs, forces, *_ = self.counts
        d, quiet = np.reshape(d, (inputs, n)), [np.zeros((k, n)) for k in (outputs, forces)]
        still = np.zeros((references, n))
        r = still if r is None else np.reshape(r, (references, n))
        w = [start_time + np.arange(n) * self.loop.dt, r, d, *(noise or quiet), self._find_path(d)]
        if self.hold_r == "foh":
            w.append(np.hstack([r[:, 1:], r[:, -1:]]))
        return np.vstack(w)

    def run(
        self, z: Array, r: Array | None, d: Array, noise: Sequence[Array] | None = None,
        start_time: float = 0.0,
    ) -> tuple[Array, Array]:  # fmt: skip
        """Return measured output and applied input, from state `z` and time `start_time` on."""
        return self.run_in_steps(1, z, r, d, noise, start_time)[:2]

    def run_in_steps(
        self, substeps: int, z: Array, r: Array | None, d: Array,
        noise: Sequence[Array] | None = None, start_time: float = 0.0,
    ) -> tuple[Array, Array, int]:  # fmt: skip
        """Return output, input, and the steps in a period with which a similar run should begin.

        Runs chunk by chunk, the first one with `substeps` steps in a period; the steps of a chunk
        are halved until its local errors are small.
        """
        loop, n = self.loop, d.shape[-1]
        inputs, outputs = self.counts[2:4]
        w = self.stack_signals(r, d, noise, start_time)
        y, u = np.empty((outputs, n)), np.empty((inputs, n))
        start, reach = z, self._floor
        asked, whole = self._measure_asked(w), loop.controller is None
        size = min(CHUNK, n)
        worst, where = 0.0, 0
        for first in range(0, n, size):
            count = min(size, n - first)
            # The last chunk is filled up with its last column, so that one function serves all.
            block = w[:, np.minimum(np.arange(first, first + size), n - 1)]
            previous_stop: int | None = None
            while True:
                results = self._build_runner(substeps, size)(z, block)
                states, ys, us, errors = (np.asarray(a, float)[:, :count] for a in results)
                stop = self._find_first_bad(states, ys, us, asked)
                if stop is not None and not whole:
                    # What moves the loop beside the reference asks for motion, too.
                    asked, whole = np.maximum(asked, self._compute_reach(start, w)), True
                    stop = self._find_first_bad(states, ys, us, asked)
                good = count if stop is None else max(stop - 1, 0)
                travel = np.max(np.abs(states[:, :good] - start[:, None]), axis=1, initial=0.0)
                excursion = np.maximum(reach, travel)
                largest = np.max(errors[:, :good], axis=1, initial=0.0)
                with np.errstate(all="ignore"):
                    error = float(np.max(np.where(largest > 0, largest / excursion, 0.0)))
                if (stop is None and error <= self.tolerance) or substeps >= self.most:
                    break
                if stop is not None and stop == previous_stop and good and error <= COARSE:
                    # The steps were accurate so far, and finer ones stop at the same sample.
                    break
                previous_stop = stop
                substeps *= 2
            if stop is not None:
                inside = bool(np.isfinite(states[:, stop]).all())
                growth, until = _compute_known_growth(loop), slice(stop + 1)
                pushed = bool(np.any(start != self.rest))
                stopped = SimulationStopped(
                    _explain_stop(loop, growth, first + stop, inside, ys[:, until], us[:, until], w,
                                  pushed, self.counts)
                )  # fmt: skip
                stopped.unstable = growth > 0
                stopped.y = _drop_single_row(np.hstack([y[:, :first], ys[:, :stop]]))
                raise stopped
            if error > worst:
                worst, where = error, first
            y[:, first : first + count], u[:, first : first + count] = ys, us
            z, reach = states[:, -1], excursion
            if error < self.tolerance / 1e4 and substeps > 1:
                substeps //= 2
        if worst > COARSE and self.most == MOST_SUBSTEPS:
            warnings.warn(
                f"near t = {where * loop.dt:.4g} s the simulation has an error of about "
                f"{worst:.0e} of the signals: the plant or the controller changes too fast for "
                f"{MOST_SUBSTEPS} steps in {loop.dt:g} s; simulate with a smaller dt",
                CtrlidWarning, stacklevel=5,
            )  # fmt: skip
        return _drop_single_row(y), _drop_single_row(u), substeps

    def _measure_asked(self, w: Array) -> Array:
        """Return how far from zero the point of rest, the reference and the noise ask y to be."""
        rest = np.array(self.loop.point.outputs)
        if self.loop.controller is None:
            return np.asarray(np.abs(rest))
        places = np.cumsum((0, *self.counts))
        parts = [np.abs(rest), np.max(np.abs(w[places[3] : places[4]]), axis=1)]
        if self.counts[1] == len(rest) == 1:
            parts.append(np.max(np.abs(w[1:2] - rest[:, None]), axis=1))
        return np.asarray(np.max(parts, axis=0))

    def _compute_reach(self, start: Array, w: Array) -> Array:
        """Return how far a start, injected signals, noises and forces move the output from rest.

        That is the largest output of the loop linearized at rest, without what would grow by
        itself; infinity where it has no derivative.
        """
        a, n = self._motion[0], w.shape[1]
        rest_of_outputs = np.array(self.loop.point.outputs)[:, None]
        if not np.isfinite(a).all():
            return np.full(len(rest_of_outputs), math.inf)
        step, rest = self._steps[1].map(n), self.rest[:, None]
        pushes = np.asarray(step(np.repeat(rest, n, axis=1), w)[0], float) - rest
        a = a / max(1.0, float(np.max(np.abs(np.linalg.eigvals(a)), initial=0.0)))
        moved = np.empty((len(start), n))
        moved[:, 0] = start - self.rest
        for k in range(n - 1):
            moved[:, k + 1] = a @ moved[:, k] + pushes[:, k]
        told = w.copy()
        places = np.cumsum((0, *self.counts))
        told[places[3] : places[4]] = 0.0
        y = np.asarray(step(rest + moved, told)[1], float)
        reach = np.max(np.abs(y - rest_of_outputs), axis=1)
        if self._kinks.any():
            reach = reach + self._compute_swing(a, n)
        return np.where(np.isfinite(reach), reach, math.inf)

    def _compute_swing(self, a: Array, n: int) -> Array:
        """Return how far kinks move the outputs if each time they do it in the same way."""
        moved, pushed = np.zeros(len(a)), np.diag(self._kinks)
        for _ in range(n):
            moved += np.abs(pushed).sum(axis=1)
            pushed = a @ pushed
            if np.abs(pushed).max() < 1e-6 * moved.max():
                break
        # One state at a time, and at last the loop at rest.
        z = self.rest[:, None] + np.eye(len(a), len(a) + 1) * moved[:, None]
        w = np.tile(self._still[:, None], z.shape[1])
        y = np.asarray(self._steps[1].map(z.shape[1])(z, w)[1], float)
        return np.asarray(np.abs(y[:, :-1] - y[:, -1:]).sum(axis=1))

    def _find_first_bad(self, states: Array, ys: Array, us: Array, asked: Array) -> int | None:
        """Return the first sample at which the loop is no longer where it can be, or None."""
        bad = ~np.isfinite(np.vstack([states, ys, us])).all(axis=0)
        # An open loop may travel far, an integrator must; only an unstable plant runs away from
        # rest.
        if self.loop.controller is not None or (asked.all() and self._unstable):
            away = np.abs(ys - np.array(self.loop.point.outputs)[:, None])
            # What moves an output in second order only, as a tilt moves the height of a quadrotor,
            # is no flight: there the largest of all outputs counts.
            most = np.max(asked, initial=0.0)
            asked = np.where(RUNAWAY * asked < most, most, asked)
            bad |= (away > RUNAWAY * asked[:, None]).any(axis=0)
        return int(np.argmax(bad)) if bad.any() else None


def _drop_single_row(values: Array) -> Array:
    """Return the samples of a single signal without the axis of several."""
    return values[0] if len(values) == 1 else values


def _compute_known_growth(loop: Loop) -> float:
    """Return how fast small deviations grow [1/s]; NaN where the loop has no derivative."""
    try:
        return compute_growth_rate(loop)
    except ModelCannotRun:
        return math.nan


def _doubt_wiring(loop: Loop) -> str:
    """Return what a controller reads whose several inputs have no names; empty for any other."""
    wiring = loop.wiring
    labels = [] if wiring is None else list(loop.controller.input_labels)
    if wiring is None or labels != [f"u[{k}]" for k in range(len(labels))]:
        return ""
    pairs = len(labels) == len(loop.signals["y"])
    read = "reference less output" if pairs else "the references and then the outputs"
    return (
        f". The {len(labels)} inputs of the controller have no names, so that they read {read}, in "
        f"the order of the plant. {STATE_FEEDBACK}"
    )


def _explain_stop(
    loop: Loop, growth: float, at: int, inside: bool, ys: Array, us: Array, w: Array, pushed: bool,
    counts: Sequence[int],
) -> str:  # fmt: skip
    """Say when and why a simulation broke off."""
    e, op = loop.equations(), loop.point
    k = ys.shape[1] - 1
    row = int(np.argmax(np.abs(np.nan_to_num(ys[:, k]) - op.outputs)))
    ys, output, inp = ys[row:], e.outputs[row], e.inputs[0]
    good = max(k - 1, 0)
    text = f"the simulation stops at t = {at * loop.dt:.5g} s (sample {at}): "
    if inside:
        text += f"{output} has diverged to {ys[0, k]:.4g}, with {inp} = {us[0, good]:.4g}."
    else:
        text += (f"{output} left the range where the plant is defined. The last values inside are "
                 f"{output} = {ys[0, good]:.4g} and {inp} = {us[0, good]:.4g}.")  # fmt: skip
    lower, upper = (float(np.ravel(v)[0]) for v in loop.input_limits)
    recent = us[0, max(0, good - 20) : good + 1]
    if loop.controller is None:
        return (
            text + " The loop is open: an unstable plant cannot be simulated without its controller"
        )
    if growth > 0:
        return (
            f"{text} The closed loop is unstable: small deviations grow at {growth:.3g} 1/s. Check "
            f"the sign and the gain of the controller and the operating point{_doubt_wiring(loop)}"
        )
    if np.any(recent <= lower) or np.any(recent >= upper):
        text += f" {inp} was at its limit ({lower:g} to {upper:g}) shortly before."
    if not e.siso or counts[1] != 1:
        return (
            f"{text} Near the operating point the loop is stable, so the signals are too large for "
            "it. Use smaller references, less noise or an initial state that is nearer to rest"
        )
    asked = float(np.max(np.abs(w[1] - op.output)))
    sizes = [f"the reference is up to {asked:.3g} away from the operating point"] if asked else []
    sizes += [f"{name} is up to {np.max(np.abs(v)):.3g}"
              for name, v in (("the injected signal d", w[2]), ("the sensor noise", w[3]),
                              ("the force noise", w[4])) if np.any(v)]  # fmt: skip
    sizes += ["it starts away from rest"] if pushed else []
    text += (" Near the operating point the loop is stable, so the signals are too large for it: "
             + ", ".join(sizes or ["what moves it is a force in the loop itself"]))  # fmt: skip
    if good:
        swing = np.max(np.abs(us[0, : good + 1] - op.input))
        text += f", and {inp} was up to {swing:.3g} away from {op.input:.4g}"
    text += "."
    if np.max(np.abs(w[1])) < abs(op.output) / 2:
        return (f"{text} Signals are absolute: if r was meant as a deviation from the operating "
                f"point, add {op.output:.6g} to it")  # fmt: skip
    smaller = [name for name, v in (("a smaller reference", asked), ("a smaller d", w[2]),
                                    ("less noise", w[3:5])) if np.any(v)]  # fmt: skip
    smaller += ["a start nearer to rest"] if pushed else []
    return f"{text} Use {' or '.join(smaller or ['a smaller force'])}"
