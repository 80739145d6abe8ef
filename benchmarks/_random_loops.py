"""Loops, controllers, references, noise and hidden effects drawn at random, for studies.

A draw has the true loop and the model of it, whose free parameters are up to 10 % off. It can be
simulated any number of times, each time with other noise. The sampling period is proportional to
the time constant of the plant.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import control as ct
import numpy as np
from scipy.signal import lfilter

import ctrlid as cid
from ctrlid import effects
from ctrlid.loop.period_map import count_forces
from ctrlid.loop.simulation import Simulator

SAMPLES = 20_000
OFF = 0.1  # a free parameter is believed at most this far off
FINE, MOST = 1e-8, 24  # local error of a simulation, and its steps in a period: enough for friction


@dataclass(frozen=True)
class Noise:
    """White sensor noise, white force, coloured force (standard deviations, time in periods)."""

    sensor: float
    force: float = 0.0
    coloured: float = 0.0
    time: float = 1.0

    def draw(self, rng: np.random.Generator, n: int, forces: int = 1) -> list[np.ndarray]:
        """Return sensor noise and forces, each of n samples; forces after the first are white."""
        white = rng.standard_normal((3, n))
        memory = math.exp(-1 / self.time)
        steps = white[2] * math.sqrt(1 - memory**2)
        steps[0] = white[2, 0]
        colour = lfilter([1.0], [1.0, -memory], steps)
        more = self.force * rng.standard_normal((forces - 1, n))
        return [self.sensor * white[0], self.force * white[1] + self.coloured * colour, *more]


@dataclass(frozen=True, eq=False)
class Draw:
    """A loop, what is believed of it, and how it is excited and disturbed."""

    plant: str
    loop: cid.Loop
    believed: cid.Loop
    swing: float
    hold: int
    levels: float
    noise: Noise
    samples: int = SAMPLES

    def excitation(self, seed: int) -> np.ndarray:
        """Return the reference, or the input of an open loop, around one set-point or several."""
        closed = self.loop.controller is not None
        at = self.loop.at.output if closed else 0.0
        jumps = cid.random_binary(
            self.samples, amplitude=self.swing, hold=self.hold, around=at, seed=seed
        )
        if not self.levels:
            return jumps
        rng = np.random.default_rng([seed, 5])
        count = int(rng.integers(4, 9))
        places = np.linspace(-1, 1, count)
        rng.shuffle(places)
        each = self.samples // (count + 1) + 1
        walk = np.repeat([0.0, *places], each)[: self.samples]
        ramp = max(2, each // 20)  # no jump from level to level
        smooth = np.convolve(np.pad(walk, (ramp, 0)), np.ones(ramp) / ramp)[ramp : ramp + len(walk)]
        return jumps + self.levels * smooth

    def run(
        self, real: cid.Loop, seed: int, noise: Noise | None = None, r: Any = None,
        spread: np.ndarray | None = None,
    ) -> cid.Record:  # fmt: skip
        """Return a record of a real loop; `spread` scales the sensor noise, sample by sample."""
        given = self.excitation(seed) if r is None else np.asarray(r, dtype=float)
        n, closed = len(given), real.controller is not None
        simulator = Simulator(real, FINE, MOST)
        rng, forces = np.random.default_rng([seed, 7]), count_forces(real.equations())
        hiss = (noise or self.noise).draw(rng, n, forces)
        if spread is not None:
            hiss[0] = hiss[0] * spread
        r, d = (given, np.zeros(n)) if closed else (None, given)
        y, u = simulator.run(simulator.start(None), r, d, hiss)
        e = real.equations()
        return cid.Record(
            r=r, u=u, y=y, dt=real.dt, hold="foh" if real.analog else "zoh", name=self.plant,
            names={"u": e.inputs[0], "y": e.outputs[0]},
        )  # fmt: skip


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def lead(
    rng: np.random.Generator, plant: Any, op: Any, dt: float, crossover: float, pid: float = 0.5
) -> Any:
    """Draw a digital controller: a sampled lead, or a PID of the same slope (with this chance)."""
    law = cid.design_lead(cid.linearize(plant, op), crossover, rng.uniform(45, 60))
    if rng.uniform() > pid:
        return law.sample(dt, "tustin")
    num, den = law.num[0][0], law.den[0][0]
    if len(num) < 2 or len(den) < 2:
        return law.sample(dt, "tustin")
    gain, lag, ahead = num[-1] / den[-1], den[0] / den[-1], num[0] / num[-1]
    integral = gain * crossover / rng.uniform(15, 60) if rng.uniform() < 0.6 else 0.0
    return cid.PID(
        kp=float(gain), ki=float(integral), kd=float(gain * (ahead - lag)), filter_time=float(lag)
    )


def believed(rng: np.random.Generator, loop: cid.Loop) -> cid.Loop:
    """Return the loop with its free parameters off."""
    known = loop.parameters
    return loop.with_parameters(
        {name: known[name] * (1 + rng.uniform(-OFF, OFF)) for name in loop.free}
    )


def maglev(rng: np.random.Generator) -> tuple[cid.Loop, float, float, Noise]:
    """Draw a levitation of 5 to 20 mm, pole times period 0.03 to 0.15."""
    gap, volts = rng.uniform(5e-3, 20e-3), rng.uniform(1.0, 10.0)
    mass = log_uniform(rng, 0.01, 0.1)
    plant = cid.plants.maglev(m=mass, K=mass * 9.81 * gap**2 / volts**2)
    op = cid.operating_point(plant, output=gap)
    p = math.sqrt(2 * 9.81 / gap)
    dt = log_uniform(rng, 0.03, 0.12) / p
    law = lead(rng, plant, op, dt, p * rng.uniform(2, 3))
    loop = cid.Loop(
        plant, law, dt=dt, at=op, free=("K",), input_limits=(0.0, rng.uniform(2, 3) * volts)
    )
    noise = Noise(gap * log_uniform(rng, 2e-4, 2e-3), log_uniform(rng, 0.005, 0.1))
    return loop, gap * rng.uniform(0.01, 0.04), gap * rng.uniform(0.08, 0.2), noise


def servo(rng: np.random.Generator) -> tuple[cid.Loop, float, float, Noise]:
    """Draw a drive with a pole at the origin; friction known or to be fitted."""
    mass, pole = log_uniform(rng, 0.5, 100), log_uniform(rng, 1, 10)
    full = log_uniform(rng, 0.02, 0.2)  # m
    crossover = pole * rng.uniform(2, 6)
    gain = full * crossover**2 * mass / rng.uniform(2, 10)
    plant = cid.plants.servo(m=mass, c=mass * pole, k=gain)
    op = cid.operating_point(plant, output=0.0)
    dt = log_uniform(rng, 0.04, 0.2) / crossover
    law = lead(rng, plant, op, dt, crossover)
    free = ("k",) if rng.uniform() < 0.5 else ("c", "k")
    limit = 30.0
    loop = cid.Loop(plant, law, dt=dt, at=op, free=free, input_limits=(-limit, limit))
    noise = Noise(full * log_uniform(rng, 2e-5, 1e-3),
                  full * crossover**2 * log_uniform(rng, 1e-3, 2e-2))  # fmt: skip
    return loop, full * rng.uniform(0.1, 0.3), full * rng.uniform(0.5, 1.0), noise


def pendulum(rng: np.random.Generator) -> tuple[cid.Loop, float, float, Noise]:
    """Draw an inverted pendulum held upright or at a tilt by a motor at its pivot."""
    mass, length = log_uniform(rng, 0.05, 1.0), log_uniform(rng, 0.1, 1.0)
    p = math.sqrt(9.81 / length)
    inertia = mass * length**2
    plant = cid.plants.pendulum(m=mass, length=length, c=inertia * p * rng.uniform(0.0, 0.3))
    op = cid.operating_point(plant, output=rng.choice([0.0, rng.uniform(0.05, 0.3)]))
    dt = log_uniform(rng, 0.02, 0.12) / p
    law = lead(rng, plant, op, dt, p * rng.uniform(2, 3.5))
    limit = rng.uniform(3, 6) * inertia * p**2
    loop = cid.Loop(plant, law, dt=dt, at=op, free=("m",), input_limits=(-limit, limit))
    noise = Noise(log_uniform(rng, 2e-4, 3e-3), p**2 * log_uniform(rng, 1e-3, 2e-2))
    return loop, rng.uniform(0.03, 0.1), rng.uniform(0.1, 0.35), noise


def spring(rng: np.random.Generator) -> tuple[cid.Loop, float, float, Noise]:
    """Draw a mass on a spring and a damper, driven open loop or controlled."""
    omega, zeta = log_uniform(rng, 5, 50), log_uniform(rng, 0.05, 0.8)
    gain = log_uniform(rng, 0.1, 10)

    def update(t: float, x: Any, u: Any, params: Any) -> Any:
        force = params["k"] * u[0] - params["d"] * x[1] - params["s"] * x[0]
        return np.array([x[1], force])

    plant = ct.nlsys(
        update, lambda t, x, u, params: x[0], name="spring", inputs=["F"], outputs=["x"],
        states=["x", "v"], params={"k": gain, "d": 2 * zeta * omega, "s": omega**2},
    )  # fmt: skip
    size = log_uniform(rng, 1e-3, 0.1)
    op = cid.operating_point(plant, output=float(rng.choice([0.0, 0.5 * size])))
    dt = log_uniform(rng, 0.03, 0.2) / omega
    free = ("k",) if rng.uniform() < 0.5 else ("k", "s", "d")
    force = size * omega**2
    noise = Noise(size * log_uniform(rng, 1e-3, 1e-2), force * log_uniform(rng, 3e-3, 3e-2))
    if rng.uniform() < 0.5:
        loop = cid.Loop(plant, None, dt=dt, at=op, free=free)
        return loop, force / gain * rng.uniform(0.3, 1), force / gain * rng.uniform(0.5, 1.5), noise
    law = lead(rng, plant, op, dt, omega * rng.uniform(1.8, 3.0))
    limit = 60 * force / gain
    loop = cid.Loop(plant, law, dt=dt, at=op, free=free, input_limits=(-limit, limit))
    return loop, size * rng.uniform(0.1, 0.4), size * rng.uniform(0.3, 1.0), noise


def tank(rng: np.random.Generator) -> tuple[cid.Loop, float, float, Noise]:
    """Draw one tank, filled by a pump, at a level that a PI controller holds, or none."""
    level, volts, area = rng.uniform(0.1, 1.0), rng.uniform(2, 8), log_uniform(rng, 3e-3, 0.1)
    time = log_uniform(rng, 20, 300)
    outlet = area * math.sqrt(2 * 9.81 * level) / (9.81 * time)
    flow = outlet * math.sqrt(2 * 9.81 * level)
    plant = cid.plants.tank(area=area, outlet=outlet, k=flow / volts)
    op = cid.operating_point(plant, output=level)
    dt = log_uniform(rng, 0.02, 0.2) * time
    noise = Noise(level * log_uniform(rng, 1e-3, 1e-2))
    free = ("k",) if rng.uniform() < 0.5 else ("k", "outlet")
    law = None
    limits = (-math.inf, math.inf)
    if rng.uniform() < 0.6:
        gain = flow and volts / level * rng.uniform(1, 2.5) * min(1.0, 0.1 * time / dt)
        law = cid.PID(kp=gain, ki=gain / (time * rng.uniform(0.5, 2)))
        limits = (0.0, rng.uniform(2, 4) * volts)
    loop = cid.Loop(plant, law, dt=dt, at=op, free=free, input_limits=limits)
    if law is None:
        return loop, volts * rng.uniform(0.05, 0.15), volts * rng.uniform(0.05, 0.2), noise
    return loop, level * rng.uniform(0.03, 0.1), level * rng.uniform(0.1, 0.3), noise


def tanks(rng: np.random.Generator) -> tuple[cid.Loop, float, float, Noise]:
    """Draw two tanks, one above the other; the level of the lower one is measured."""
    first, ratio = rng.uniform(2, 8), rng.uniform(0.6, 1.2)
    rate = log_uniform(rng, 0.05, 0.5)

    def update(t: float, x: Any, u: Any, params: Any) -> Any:
        upper, lower = np.sqrt(np.maximum(x[0], 0.0)), np.sqrt(np.maximum(x[1], 0.0))
        through = params["a"] * upper
        return np.array([params["k"] * u[0] - through, through - params["b"] * lower])

    volts = rng.uniform(1, 6)
    b = rate * ratio
    level = (rate / b) ** 2 * first
    plant = ct.nlsys(
        update, lambda t, x, u, params: x[1], name="two tanks", inputs=["V"], outputs=["h2"],
        states=["h1", "h2"], params={"k": rate * math.sqrt(first) / volts, "a": rate, "b": b},
    )  # fmt: skip
    op = cid.operating_point(plant, output=level)
    dt = log_uniform(rng, 0.02, 0.2) * 2 * math.sqrt(first) / rate
    free = ("k",) if rng.uniform() < 0.5 else ("k", "a")
    noise = Noise(level * log_uniform(rng, 1e-3, 1e-2))
    if rng.uniform() < 0.5:
        loop = cid.Loop(plant, None, dt=dt, at=op, free=free)
        return loop, volts * rng.uniform(0.1, 0.3), volts * rng.uniform(0.05, 0.2), noise
    gain = volts / level * rng.uniform(0.5, 2)
    loop = cid.Loop(plant, cid.PID(kp=gain), dt=dt, at=op, free=free, input_limits=(0.0, 4 * volts))
    return loop, level * rng.uniform(0.05, 0.15), level * rng.uniform(0.1, 0.2), noise


PLANTS: dict[str, Callable[[np.random.Generator], tuple[cid.Loop, float, float, Noise]]] = {
    "maglev": maglev, "servo": servo, "pendulum": pendulum, "spring": spring, "tank": tank,
    "two tanks": tanks,
}  # fmt: skip
MOVING = ("maglev", "servo", "pendulum", "spring")
SHARES = {"maglev": 0.4, "servo": 0.2, "pendulum": 0.15, "spring": 0.15, "tank": 0.06,
          "two tanks": 0.04}  # fmt: skip


def draw(rng: np.random.Generator, plant: str, coloured: bool, samples: int = SAMPLES) -> Draw:
    """Draw a loop of a kind of plant; `coloured` shakes it by a coloured random force as well."""
    loop, swing, levels, noise = PLANTS[plant](rng)
    speed = 1.0
    if coloured and plant in MOVING:
        noise = replace(noise, coloured=noise.force * log_uniform(rng, 1, 10),
                        time=log_uniform(rng, 3, 200))  # fmt: skip
    hold = round(log_uniform(rng, 10, 60) * speed)
    if plant in ("tank", "two tanks"):
        hold = round(log_uniform(rng, 10, 100))
    several = rng.uniform() < 0.5
    return Draw(plant, loop, believed(rng, loop), swing, hold, levels if several else 0.0, noise,
                samples)  # fmt: skip


@dataclass(frozen=True)
class Scales:
    """Typical sizes of the signals of an undisturbed run."""

    dt: float
    duration: float
    u: np.ndarray
    y: np.ndarray
    rest: tuple[float, float]
    sensor: float

    @property
    def swing(self) -> float:
        """Standard deviation of the input."""
        return float(np.std(self.u)) or 1.0

    @property
    def reach(self) -> float:
        """Standard deviation of the output."""
        return float(np.std(self.y))

    @property
    def speed(self) -> float:
        """Standard deviation of the velocity."""
        return float(np.std(np.gradient(self.y, self.dt)))

    @property
    def push(self) -> float:
        """Standard deviation of the acceleration."""
        return float(np.std(np.gradient(np.gradient(self.y, self.dt), self.dt)))


def scales_of(one: Draw, seed: int) -> Scales:
    """Run a draw without effects and noise and measure its signals."""
    record = one.run(one.loop, seed, Noise(0.0))
    at = one.loop.at
    return Scales(one.loop.dt, record.duration, record.u, record.y, (at.input, at.output),
                  one.noise.sensor)  # fmt: skip


Sized = Callable[[float], effects.AbstractEffect]  # an effect of a size; 1 is easily seen


def _limits(rng: np.random.Generator, kind: Any, values: np.ndarray, rest: float) -> Sized:
    """Limits that come nearer as the size grows: above, below, or on both sides."""
    side = rng.integers(3)
    high, low = float(values.max()), float(values.min())

    def sized(s: float) -> effects.AbstractEffect:
        inside = 1 / (1 + s)  # share of the range that is left
        upper = rest + (high - rest) * inside if side != 1 else math.inf
        lower = rest + (low - rest) * inside if side != 0 else -math.inf
        return kind(lower, upper)

    return sized


def hidden(
    rng: np.random.Generator, kind: type[effects.AbstractEffect], one: Draw, s: Scales
) -> Sized:
    """Draw an effect of a class; what is not its size is settled here.

    Parameters
    ----------
    rng : Generator
        Random numbers.
    kind : type
        A class of the catalogue.
    one : Draw
        The loop that will have it.
    s : Scales
        Its signals.

    Returns
    -------
    callable
        The effect by its size.
    """
    E = effects
    sign = float(rng.choice([-1.0, 1.0]))
    share = sign * rng.uniform(0.25, 0.8)
    phase = rng.uniform(0, 2 * math.pi)
    top = float(np.abs(s.u).max()) or 1.0
    drag = s.push / s.speed
    name = str(rng.choice(one.loop.free))
    held = [k for k in one.loop.parameters if k not in one.loop.free and "." not in k]
    when = rng.uniform(0.2, 0.8) * s.duration
    wave = log_uniform(rng, 5 / s.duration, 0.1 / s.dt)
    ripple = rng.uniform(0.05, 0.5) * float(np.ptp(s.y))
    mode = (log_uniform(rng, 0.02, 0.2) / s.dt, log_uniform(rng, 0.01, 0.1))
    slow = s.speed * rng.uniform(0.3, 1.5)
    simple: dict[Any, Sized] = {
        E.ActuatorLag: lambda z: E.ActuatorLag(0.3 * z * s.dt),
        E.InputDelay: lambda z: E.InputDelay(0.3 * z * s.dt),
        E.InputDeadZone: lambda z: E.InputDeadZone(0.2 * z * s.swing),
        E.InputOffset: lambda z: E.InputOffset(0.1 * sign * z * s.swing),
        E.InputBacklash: lambda z: E.InputBacklash(0.2 * z * s.swing),
        E.InputRateLimit: lambda z: E.InputRateLimit(2 * s.swing / (s.dt * z)),
        E.InputNonlinearity: lambda z: E.InputNonlinearity(0.05 * sign * z / s.swing),
        E.InputSaturatingGain: lambda z: E.InputSaturatingGain(0.05 * z / top**2),
        E.ViscousFriction: lambda z: E.ViscousFriction(0.05 * z * drag),
        E.AsymmetricViscousFriction: lambda z: E.AsymmetricViscousFriction(
            0.05 * z * drag, 0.05 * z * drag * share
        ),
        E.CoulombFriction: lambda z: E.CoulombFriction(0.05 * z * s.push),
        E.AsymmetricCoulombFriction: lambda z: E.AsymmetricCoulombFriction(
            0.05 * z * s.push, 0.05 * z * s.push * share
        ),
        E.StribeckFriction: lambda z: E.StribeckFriction(0.05 * z * s.push, slow),
        E.QuadraticDrag: lambda z: E.QuadraticDrag(0.05 * z * drag / s.speed),
        E.EddyCurrentDamping: lambda z: E.EddyCurrentDamping(
            0.05 * z * drag / float(np.mean(s.u**2))
        ),
        E.LinearStiffness: lambda z: E.LinearStiffness(0.05 * sign * z * s.push / s.reach),
        E.CubicStiffness: lambda z: E.CubicStiffness(0.02 * sign * z * s.push / s.reach**3),
        E.ConstantForce: lambda z: E.ConstantForce(0.05 * sign * z * s.push),
        E.PeriodicForce: lambda z: E.PeriodicForce(0.05 * z * s.push, wave, phase),
        E.PositionRipple: lambda z: E.PositionRipple(0.05 * z * s.push, ripple, phase),
        E.FlexibleMode: lambda z: E.FlexibleMode(*mode, 0.9 * z / (z + 20)),
        E.PositionOffset: lambda z: E.PositionOffset(0.2 * sign * z * s.reach),
        E.ForceExponent: lambda z: E.ForceExponent(
            2 + (0.05 * z if sign > 0 else -1.4 * z / (z + 30))
        ),
        E.ParameterDrift: lambda z: E.ParameterDrift(name, 0.03 * sign * z / s.duration),
        E.ParameterStep: lambda z: E.ParameterStep(name, when, 0.02 * sign * z),
        E.SensorLag: lambda z: E.SensorLag(0.3 * z * s.dt),
        E.SensorNonlinearity: lambda z: E.SensorNonlinearity(0.05 * sign * z / s.reach),
        # What is fitted anyway can be hidden by no error of it.
        E.ParameterError: lambda z: E.ParameterError((held or [name])[0], 0.02 * sign * z),
        E.SensorGain: lambda z: E.SensorGain(0.02 * sign * z),
        E.SensorDrift: lambda z: E.SensorDrift(0.3 * sign * z * s.reach / s.duration),
        E.SensorHum: lambda z: E.SensorHum(0.2 * z * s.sensor, wave, phase),
        E.SensorOffset: lambda z: E.SensorOffset(0.2 * sign * z * s.reach),
        E.Quantization: lambda z: E.Quantization(2 * z * s.sensor),
    }
    if kind is E.InputSaturation:
        return _limits(rng, kind, s.u, s.rest[0])
    if kind is E.SensorSaturation:
        return _limits(rng, kind, s.y, s.rest[1])
    if kind is E.StateLimit:
        return _full(rng, one, s)
    if kind not in simple:
        raise KeyError(f"{kind.__name__} has no size: give it a row in `hidden` of {__name__}.py, "
                       "with z the size relative to what is easily seen")  # fmt: skip
    return simple[kind]


def _full(rng: np.random.Generator, one: Draw, s: Scales) -> Sized:
    """Fill a tank: the measured one, or the upper of two, spilling into the lower."""
    high, rest = float(s.y.max()), s.rest[1]
    names = list(one.loop.equations().states)
    if len(names) == 1:
        return lambda z: effects.StateLimit(names[0], rest + (high - rest) / (1 + z))
    share, top = rng.uniform(0.2, 1.0), one.loop.point.states[0]
    far = top * (high / rest - 1)
    return lambda z: effects.StateLimit(names[0], top + 2 * far / (1 + z), names[1], float(share))
