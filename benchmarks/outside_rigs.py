"""Records of four rigs from a simulator that shares nothing with ctrlid: numpy and scipy only.

A levitated ball, a drive, an inverted pendulum and a mass on a spring, with parameters, sampling
periods, set-points, references, controllers and noise drawn from a seed. What a user is told of a
rig (`Draw.given`, the stated law) may differ from what ran; `Draw.truth` says in what. All
values are in SI units and signals are absolute. ``study_suspects.py`` gives the draws to ctrlid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.signal import lfilter

PLANTS = ("ball", "drive", "pendulum", "spring")
NOISES = ("white", "ar", "averaged", "walk", "pink", "t3", "outliers", "jitter", "converter")
SENSORS = ("hum", "scale", "drift")
CLASSES = NOISES + SENSORS
COLOURED = ("ar", "averaged", "pink", "t3", "outliers")  # under which plant effects are hidden
EFFECTS = ("delay", "lag", "coulomb", "viscous", "periodic", "cubic", "deadzone")
FAULTS = ("gain", "sign", "bias", "delay", "limit", "filter", "unknown")
G = 9.81
SUBSTEPS = 8  # of the integration in a period, which is at most 0.15 of a plant's time constant
TRIES = 60  # draws until one is stable


@dataclass(frozen=True)
class Law:
    """A digital controller as its user states it: transfer function in 1/z, bias and limits.

    `num` and `den` are in powers of 1/z, `den[0]` is 1; it acts on r - y and adds `bias`.
    """

    kind: str
    num: tuple[float, ...]
    den: tuple[float, ...]
    bias: float

    def scaled(self, gain: float) -> Law:
        """Return the law with another gain."""
        return Law(self.kind, tuple(gain * b for b in self.num), self.den, self.bias)

    def shifted(self, bias: float) -> Law:
        """Return the law with another bias."""
        return Law(self.kind, self.num, self.den, self.bias + bias)


@dataclass(frozen=True)
class Rig:
    """What is drawn of a rig before anything is hidden in it."""

    plant: str
    true: dict[str, float]
    given: dict[str, float]
    dt: float
    at: float  # set-point [output unit]
    rest_input: float
    law: Law | None  # None: open loop
    swing: float  # of the reference [output unit], or of the input where the loop is open
    bandwidth: float  # [rad/s]
    sigma: float  # of the sensor noise [output unit]
    force: float  # standard deviation of a random acceleration, held for a period
    reference: str


@dataclass(frozen=True)
class Hidden:
    """What the record holds beside the rig: sizes in the units of the simulator."""

    delay: float = 0.0  # periods
    lag: float = 0.0  # s
    coulomb: float = 0.0  # acceleration
    viscous: float = 0.0  # 1/s
    periodic: float = 0.0  # acceleration
    frequency: float = 0.0  # Hz
    cubic: float = 0.0  # acceleration per cube of the deviation
    deadzone: float = 0.0  # input
    scale: float = 0.0
    step: float = 0.0  # of the converter [output unit]
    added: Any = None  # reading beside the true value, per sample
    periods: Any = None  # true length of every period [s]
    fault: str = ""
    fault_size: float = 0.0


@dataclass(frozen=True)
class Draw:
    """A record, what its user knows, and the truth."""

    name: str
    rig: Rig
    r: np.ndarray
    u: np.ndarray
    y: np.ndarray
    truth: dict[str, Any]
    hidden: Hidden
    redrawn: int
    shape: np.ndarray | None = field(default=None, repr=False)  # of a drift or a hum, per sample


# --- rigs


FREE = {"ball": ("K",), "drive": ("k", "c"), "pendulum": ("m",), "spring": ("s", "c")}


def make_acceleration(plant: str, p: dict[str, Any]) -> Callable[[Any, Any, Any], Any]:
    """Return the acceleration of a plant by position, speed and input; floats or arrays."""
    if plant == "ball":
        pull = p["K"] / p["m"]
        return lambda x, v, u: G - pull * u * u / (x * x)
    if plant == "drive":
        k, c = p["k"] / p["J"], p["c"] / p["J"]
        return lambda x, v, u: k * u - c * v
    if plant == "pendulum":
        a, inertia = G / p["l"], p["m"] * p["l"] ** 2
        sin = np.sin if isinstance(inertia, np.ndarray) else math.sin
        return lambda x, v, u: a * sin(x) + (u - p["c"] * v) / inertia
    s, c, m = p["s"] / p["m"], p["c"] / p["m"], p["m"]
    return lambda x, v, u: u / m - s * x - c * v


def make_slopes(plant: str, p: dict[str, Any]) -> Callable[[Any, Any, Any], Any]:
    """Return derivatives of the acceleration by position, speed and input."""
    if plant == "ball":
        pull = p["K"] / p["m"]
        return lambda x, v, u: (2 * pull * u * u / x**3, 0.0 * x, -2 * pull * u / (x * x))
    if plant == "drive":
        k, c = p["k"] / p["J"], p["c"] / p["J"]
        return lambda x, v, u: (0.0 * x, 0.0 * x - c, k)
    if plant == "pendulum":
        a, inertia = G / p["l"], p["m"] * p["l"] ** 2
        return lambda x, v, u: (a * np.cos(x), 0.0 * x - p["c"] / inertia, 1 / inertia)
    s, c, m = p["s"] / p["m"], p["c"] / p["m"], p["m"]
    return lambda x, v, u: (0.0 * x - s, 0.0 * x - c, 1 / m)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a number of any order of magnitude between two."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def draw_plant(rng: np.random.Generator, plant: str) -> tuple[dict[str, float], float, float]:
    """Return parameters, set-point and the pole that sets the time scale [rad/s]."""
    if plant == "ball":
        at, m, volts = rng.uniform(5e-3, 2e-2), log_uniform(rng, 0.01, 0.2), rng.uniform(2, 10)
        return {"m": m, "K": m * G * at**2 / volts**2}, at, math.sqrt(2 * G / at)
    if plant == "drive":
        J, tau = log_uniform(rng, 1e-4, 1.0), log_uniform(rng, 0.05, 1.0)
        gain = log_uniform(rng, 1.0, 30.0)  # rad/s per volt
        return {"J": J, "c": J / tau, "k": gain * J / tau}, rng.uniform(-1, 1), 1 / tau
    if plant == "pendulum":
        m, length = log_uniform(rng, 0.05, 2.0), rng.uniform(0.15, 1.0)
        pole = math.sqrt(G / length)
        c = rng.uniform(0.0, 0.1) * m * length**2 * pole
        return {"m": m, "l": length, "c": c}, rng.choice([0.0, rng.uniform(-0.2, 0.2)]), pole
    m, w = log_uniform(rng, 0.1, 5.0), log_uniform(rng, 4.0, 40.0)
    p = {"m": m, "s": m * w * w, "c": 2 * rng.uniform(0.03, 0.3) * m * w}
    return p, rng.choice([0.0, rng.uniform(0.01, 0.05)]), w


def draw_law(
    rng: np.random.Generator, plant: str, slopes: Sequence[float], pole: float, bias: float
) -> tuple[Law, float, float]:
    """Return a controller by pole placement, its period and the bandwidth it aims at [rad/s].

    The plant is x" = a x + d x' + b u about its rest; a PD places s^2 + 2 z w s + w^2.
    """
    a, d, b = (float(s) for s in slopes)
    w = pole * rng.uniform(1.5, 3.0)
    damping = rng.uniform(0.7, 1.1)
    dt = rng.uniform(0.04, 0.12) / w
    kp, kd = (w * w + a) / b, (2 * damping * w + d) / b
    filter_time = 1 / (w * rng.uniform(5, 10))
    kind = str(rng.choice(["lead", "pid", "pd"]))
    if kind == "lead":  # (kp + kd s) / (1 + Tf s) by Tustin
        h = 2 / dt
        top = (kp + kd * h, kp - kd * h)
        bottom = (1 + filter_time * h, 1 - filter_time * h)
        num = tuple(v / bottom[0] for v in top)
        return Law(kind, num, (1.0, bottom[1] / bottom[0]), bias), dt, w
    # Differences through a first-order filter: kd (1 - 1/z) / (Tf + T - Tf/z).
    f = filter_time / (filter_time + dt)
    slope = kd / (filter_time + dt)
    num, den = np.array([kp + slope, -kp * f - slope]), np.array([1.0, -f])
    if kind == "pid":
        ki = kp * w * rng.uniform(0.02, 0.1)
        num = np.convolve(num, [1.0, -1.0]) + ki * dt * np.array([1.0, -f, 0.0])
        den = np.convolve(den, [1.0, -1.0])
    return Law(kind, tuple(num.tolist()), tuple(den.tolist()), bias), dt, w


def find_largest_sensitivity(slopes: Sequence[float], dt: float, law: Law) -> float:
    """Return the peak of 1/(1 + L), infinite where the sampled loop is not stable."""
    a, d, b = slopes
    n = 60
    A, B, step = np.array([[0, 1.0], [a, d]]), np.array([0, b]), dt / n
    E = np.eye(2) + A * step + A @ A * step**2 / 2
    F, Q = np.eye(2), np.zeros(2)
    for _ in range(n):
        Q = E @ Q + (np.eye(2) * step + A * step**2 / 2) @ B
        F = E @ F
    den = np.array([1.0, -np.trace(F), np.linalg.det(F)])
    num = np.array([0.0, Q[0], F[0, 1] * Q[1] - F[1, 1] * Q[0]])
    open_den, open_num = np.convolve(den, law.den), np.convolve(num, law.num)
    size = max(len(open_den), len(open_num))
    total = np.pad(open_den, (0, size - len(open_den))) + np.pad(
        open_num, (0, size - len(open_num))
    )
    if np.abs(np.roots(total)).max() > 1 - 1e-4:
        return math.inf
    z = np.exp(1j * np.geomspace(1e-3, np.pi, 400))
    values = np.polyval(open_den[::-1], 1 / z) / np.polyval(total[::-1], 1 / z)
    return float(np.abs(values).max())


def draw_rig(rng: np.random.Generator, plant: str, closed: bool | None = None) -> Rig | None:
    """Return a rig, or None where the drawn loop has no sane margins."""
    true, at, pole = draw_plant(rng, plant)
    rest = {
        "ball": lambda: math.sqrt(true["m"] * G / true["K"]) * at,
        "drive": lambda: 0.0,
        "pendulum": lambda: -true["m"] * G * true["l"] * math.sin(at),
        "spring": lambda: true["s"] * at,
    }[plant]()
    slopes = make_slopes(plant, true)(at, 0.0, rest)
    law, dt, w = draw_law(rng, plant, slopes, pole, rest)
    swing = {
        "ball": at * rng.uniform(0.02, 0.06),
        "drive": rng.uniform(0.1, 1.0),
        "pendulum": rng.uniform(0.02, 0.15),
        "spring": rng.uniform(2e-3, 1e-2),
    }[plant]
    sigma = swing / log_uniform(rng, 15, 60)
    force = float(rng.choice([0.0, swing * w * w * log_uniform(rng, 3e-3, 3e-2)]))
    opened = plant == "spring" and (rng.random() < 0.5 if closed is None else not closed)
    if opened:
        dt, w = rng.uniform(0.06, 0.2) / pole, pole
        swing = swing * true["s"]
    elif find_largest_sensitivity(slopes, dt, law) > 2.5:
        return None
    off = {name: 1 + rng.choice([-1, 1]) * rng.uniform(0.05, 0.2) for name in FREE[plant]}
    given = {name: value * off.get(name, 1.0) for name, value in true.items()}
    return Rig(plant, true, given, dt, float(at), rest, None if opened else law, swing, w, sigma,
               force, str(rng.choice(["binary", "steps", "multisine"])))  # fmt: skip


def draw_reference(rng: np.random.Generator, rig: Rig, n: int) -> np.ndarray:
    """Return deviations of the reference: bits or levels held for a while, or ten sines."""
    if rig.reference == "multisine":
        top = rig.bandwidth / (2 * np.pi)
        f = rng.uniform(0.03, 1.0, 10) * top
        t = np.arange(n)[:, None] * rig.dt
        return rig.swing * np.sin(2 * np.pi * (f * t + rng.uniform(size=10))).sum(1) / np.sqrt(10)
    hold = max(2, round(rng.uniform(0.7, 3.0) / (rig.bandwidth * rig.dt)))
    count = n // hold + 1
    levels = rng.choice([-1.0, 1.0], count) if rig.reference == "binary" else None
    if levels is None:
        levels = rng.uniform(-1.7, 1.7, count)
    return rig.swing * np.repeat(levels, hold)[:n]


# --- the simulator


def integrate(
    total: Callable[[float, float, float], float], x: float, v: float, s: float, step: float,
    dry: float,
) -> tuple[float, float]:  # fmt: skip
    """Return position and speed after a Runge-Kutta step of fourth order from the time `s` on."""
    half = 0.5 * step
    a1 = total(x, v, s) - dry
    v2 = v + half * a1
    a2 = total(x + half * v, v2, s + half) - dry
    v3 = v + half * a2
    a3 = total(x + half * v2, v3, s + half) - dry
    v4 = v + step * a3
    a4 = total(x + step * v3, v4, s + step) - dry
    x += step * (v + 2 * v2 + 2 * v3 + v4) / 6
    return x, v + step * (a1 + 2 * a2 + 2 * a3 + a4) / 6


def run_rig(
    rig: Rig, moves: np.ndarray, hidden: Hidden, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return reference, logged input and reading, or None where the rig leaves its range.

    Between samples the equations are integrated by Runge-Kutta of fourth order in eight steps.
    Where dry friction would change its sign, the step ends at rest, and the mass stays there until
    the other forces exceed the friction.
    """
    n, dt, x0 = len(moves), rig.dt, rig.at
    accel = make_acceleration(rig.plant, rig.true)
    x, v = x0, 0.0
    law = rig.law
    num, den, bias = (law.num, law.den, law.bias) if law else ((0.0,), (1.0,), rig.rest_input)
    errors, outputs = [0.0] * len(num), [0.0] * len(den)
    h = hidden
    pushes = rig.force * rng.standard_normal(n) if rig.force else np.zeros(n)
    added = np.zeros(n) if h.added is None else h.added
    periods = np.full(n, dt) if h.periods is None else h.periods
    r, u_log, y_log = (moves + x0 if law else moves + bias), np.empty(n), np.empty(n)
    past = [rig.rest_input] * 4  # the newest input first
    z, filtered, late = rig.rest_input, 0.0, 0.0
    phase = rng.uniform(0, 2 * np.pi)
    t, reach = 0.0, (0.4 * x0 if rig.plant == "ball" else 0.7 if rig.plant == "pendulum" else 1e3)
    whole = int(h.delay)
    part = h.delay - whole
    for k in range(n):
        y = (1 + h.scale) * x + added[k]
        if h.step:
            y = h.step * round(y / h.step)
        if law:
            errors = [r[k] - y, *errors[:-1]]
            c = sum(b * e for b, e in zip(num, errors, strict=True))
            c -= sum(a * o for a, o in zip(den[1:], outputs[:-1], strict=True))
            outputs = [c, *outputs[:-1]]
            if h.fault == "delay":
                c, late = late, c
            elif h.fault == "filter":
                filtered += h.fault_size * (c - filtered)
                c = filtered
            elif h.fault == "limit":
                c = min(max(c, -h.fault_size), h.fault_size)
            elif h.fault == "unknown":
                c *= 1 + h.fault_size * min(abs(errors[0]) / rig.swing, 2.0)
            u = bias + c
        else:
            u = float(r[k])
        u_log[k], y_log[k] = (-u if h.fault == "sign" else u), y
        past = [u, *past[:-1]]
        push = float(pushes[k])
        step = float(periods[k]) / SUBSTEPS
        for j in range(SUBSTEPS):
            w = past[whole + 1] if (j + 0.5) / SUBSTEPS < part else past[whole]
            if h.lag:
                decay = math.exp(-step / h.lag)
                # The mean of the lagged input over the step acts in it.
                w, z = w + (z - w) * (1 - decay) * h.lag / step, w + (z - w) * decay
            if h.deadzone:
                e = w - rig.rest_input
                w = rig.rest_input + math.copysign(max(abs(e) - h.deadzone, 0.0), e)

            def total(
                x: float, v: float, s: float, w: float = w, push: float = push, t: float = t
            ) -> float:
                a = accel(x, v, w) + push
                if h.viscous:
                    a -= h.viscous * v
                if h.cubic:
                    a -= h.cubic * (x - x0) ** 3
                if h.periodic:
                    a += h.periodic * math.sin(2 * math.pi * h.frequency * (t + s) + phase)
                return a

            left, begun = step, 0.0
            while left > 0.0:
                dry = 0.0
                if h.coulomb:
                    rest = total(x, v, begun)
                    if v == 0.0 and abs(rest) <= h.coulomb:
                        break
                    dry = math.copysign(h.coulomb, v if v else rest)
                new = integrate(total, x, v, begun, left, dry)
                taken = left
                if v and new[1] * dry < 0:
                    # The step ends at rest; what then follows is a step of its own.
                    taken = left * v / (v - new[1])
                    new = integrate(total, x, v, begun, taken, dry)[0], 0.0
                x, v = new
                begun, left = begun + taken, left - taken
            t += step
            if not abs(x - x0) < reach:
                return None
    return r, u_log, y_log


# --- noise


def draw_noise(
    rng: np.random.Generator, kind: str, sigma: float, n: int, dt: float
) -> tuple[np.ndarray, dict[str, float]]:
    """Return sensor noise of a kind and what was drawn for it."""
    white = rng.standard_normal(n + 500)
    if kind == "ar":
        a = rng.uniform(0.3, 0.95)
        out = np.empty(n + 500)
        last = 0.0
        for i, w in enumerate(white):
            last = a * last + w
            out[i] = last
        return sigma * math.sqrt(1 - a * a) * out[500:], {"ar": a}
    if kind == "averaged":
        count = int(rng.integers(2, 5))
        mean = np.convolve(white, np.ones(count), "valid") / math.sqrt(count)
        return sigma * mean[:n], {"samples": count}
    if kind == "walk":
        return sigma * (white[:n] + 0.03 * np.cumsum(rng.standard_normal(n))), {"step": 0.03}
    if kind == "pink":
        spectrum = np.fft.rfft(white[:n])
        spectrum[1:] /= np.sqrt(np.arange(1, len(spectrum)))
        spectrum[0] = 0
        out = np.fft.irfft(spectrum, n)
        return sigma * out / out.std(), {}
    if kind == "t3":
        return sigma * rng.standard_t(3, n) / math.sqrt(3), {}
    if kind == "outliers":
        share = log_uniform(rng, 0.002, 0.02)
        return sigma * white[:n] * np.where(rng.random(n) < share, 10.0, 1.0), {"share": share}
    return sigma * white[:n], {}


def draw_suspect(
    rng: np.random.Generator, kind: str, rig: Rig, n: int
) -> tuple[Hidden, dict[str, Any], np.ndarray | None]:
    """Return what a class adds to a record, in numbers and in a shape per sample."""
    noise, truth = draw_noise(rng, kind, rig.sigma, n, rig.dt)
    t = np.arange(n) * rig.dt
    if kind == "jitter":
        share = rng.uniform(0.01, 0.05)
        periods = rig.dt * (1 + share * rng.uniform(-1, 1, n))
        return Hidden(added=noise, periods=periods), {"share": share}, None
    if kind == "converter":
        step = rng.uniform(0.5, 3.0)
        return Hidden(added=noise, step=step * rig.sigma), {"step": step}, None
    if kind == "hum":
        size, f = rng.uniform(0.2, 1.0), float(rng.choice([50.0, 60.0]))
        angle = 2 * np.pi * f * t
        phase = rng.uniform(0, 2 * np.pi)
        line = size * rig.sigma * np.sin(angle + phase)
        shape = np.stack([np.sin(angle), np.cos(angle)])
        return Hidden(added=noise + line), {"sigmas": size, "hertz": f}, shape
    if kind == "scale":
        error = rng.choice([-1, 1]) * rng.uniform(0.01, 0.05)
        return Hidden(added=noise, scale=float(error)), {"error": float(error)}, None
    if kind == "drift":
        size = rng.choice([-1, 1]) * rng.uniform(2, 10)
        settling = bool(rng.random() < 1 / 3)
        way = 1 - np.exp(-t / (0.3 * t[-1])) if settling else t / t[-1]
        truth = {"sigmas": float(size), "settling": settling}
        return Hidden(added=noise + size * rig.sigma * way), truth, way[None]
    return Hidden(added=noise), truth, None


# --- draws


def draw_effect(rng: np.random.Generator, kind: str, rig: Rig) -> dict[str, float]:
    """Return the size of a plant effect by what moves the swing at the bandwidth."""
    swing = rig.swing if rig.law else rig.swing / rig.true["s"]
    size = swing * rig.bandwidth**2
    if kind == "delay":
        return {"delay": rng.uniform(0.3, 2.0)}
    if kind == "lag":
        return {"lag": rig.dt * rng.uniform(0.4, 2.0)}
    if kind == "coulomb":
        return {"coulomb": size * log_uniform(rng, 0.03, 0.2)}
    if kind == "viscous":
        return {"viscous": rig.bandwidth * log_uniform(rng, 0.03, 0.2)}
    if kind == "periodic":
        hertz = rig.bandwidth / (2 * np.pi) * log_uniform(rng, 0.3, 2.0)
        return {"periodic": size * log_uniform(rng, 0.02, 0.1), "frequency": hertz}
    if kind == "cubic":
        return {"cubic": size * log_uniform(rng, 0.1, 0.5) / swing**3}
    weight = make_slopes(rig.plant, rig.true)(rig.at, 0.0, rig.rest_input)[2]
    return {"deadzone": abs(size / float(weight)) * log_uniform(rng, 0.05, 0.3)}


def draw_fault(
    rng: np.random.Generator, kind: str, rig: Rig, moves: np.ndarray
) -> tuple[Hidden, Law, dict[str, Any]]:
    """Return a fault of the controller: what runs otherwise, and the law that is stated."""
    law = rig.law
    assert law is not None
    if kind == "gain":
        factor = float(rng.choice([rng.uniform(0.5, 0.9), rng.uniform(1.1, 2.0)]))
        return Hidden(), law.scaled(factor), {"stated by real": factor}
    if kind == "bias":
        effort = abs(law.num[0]) * rig.swing
        error = float(rng.choice([-1, 1]) * rng.uniform(0.05, 0.3) * effort)
        return Hidden(), law.shifted(error), {"error": error}
    if kind == "limit":
        limit = abs(law.num[0]) * rig.swing * rng.uniform(0.3, 0.8)
        return Hidden(fault="limit", fault_size=limit), law, {"limit": limit}
    if kind == "filter":
        share = rng.uniform(0.4, 0.8)
        return Hidden(fault="filter", fault_size=share), law, {"share": share}
    if kind == "unknown":
        share = rng.uniform(0.1, 0.4)
        return Hidden(fault="unknown", fault_size=share), law, {"share": share}
    return Hidden(fault=kind), law, {}


def draw(name: str, plant: str, seed: int, n: int = 3000) -> Draw:
    """Return a draw of a class.

    Parameters
    ----------
    name : str
        A noise or sensor class of `CLASSES`; ``"plant-"`` with one of `EFFECTS`, which is hidden
        under coloured or heavy-tailed noise; or ``"controller-"`` with one of `FAULTS`.
    plant : str
        One of `PLANTS`.
    seed, n : int
        Seed, and number of samples.

    Returns
    -------
    Draw
        The draw. Loops that are not stable or leave their range are drawn again, and counted.
    """
    key = [seed, *name.encode(), PLANTS.index(plant)]
    for attempt in range(TRIES):
        rng = np.random.default_rng([*key, attempt])
        rig = draw_rig(rng, plant, True if name.startswith("controller-") else None)
        if rig is None:
            continue
        moves = draw_reference(rng, rig, n)
        stated, shape = rig.law, None
        if name.startswith("plant-"):
            kind = str(rng.choice(COLOURED))
            hidden, truth, _ = draw_suspect(rng, kind, rig, n)
            sizes = draw_effect(rng, name.removeprefix("plant-"), rig)
            hidden = Hidden(added=hidden.added, **sizes)
            truth = {"noise": kind, **truth, **sizes}
        elif name.startswith("controller-"):
            fault, stated, truth = draw_fault(rng, name.removeprefix("controller-"), rig, moves)
            noise, _ = draw_noise(rng, "white", rig.sigma, n, rig.dt)
            hidden = Hidden(added=noise, fault=fault.fault, fault_size=fault.fault_size)
        else:
            hidden, truth, shape = draw_suspect(rng, name, rig, n)
        signals = run_rig(rig, moves, hidden, rng)
        if signals is None:
            continue
        told = Rig(**{**rig.__dict__, "law": stated})
        return Draw(name, told, *signals, truth, hidden, attempt, shape)
    raise RuntimeError(f"no stable draw of {name} on {plant} with seed {seed} in {TRIES} tries")


# --- what a sensor effect is worth


def compute_log_likelihoods(draw: Draw, columns: np.ndarray, sensor: bool) -> np.ndarray:
    """Return log-likelihoods of an extended Kalman filter, one for each column of parameters.

    A column holds the logarithms of the factors on the free parameters, those of the sensor noise
    and the random force, and with `sensor` the sizes of the sensor's effect.
    """
    rig = draw.rig
    free = FREE[rig.plant]
    p = dict(rig.given) | {k: rig.given[k] * np.exp(columns[i]) for i, k in enumerate(free)}
    p = {k: v + np.zeros(columns.shape[1]) for k, v in p.items()}
    noise = (rig.sigma * np.exp(columns[len(free)])) ** 2
    swing = rig.swing if rig.law else rig.swing / rig.true["s"]
    push = (swing * rig.bandwidth**2 * np.exp(columns[len(free) + 1])) ** 2
    sizes = columns[len(free) + 2 :]
    scale = 1 + 0.0 * noise
    added = np.zeros((len(draw.y), columns.shape[1]))
    if sensor and draw.shape is not None:
        added = rig.sigma * draw.shape.T @ sizes
    elif sensor:
        scale = 1 + 0.01 * sizes[0]
    f, slopes = make_acceleration(rig.plant, p), make_slopes(rig.plant, p)
    dt = rig.dt
    x, v = rig.at / scale, 0.0 * noise
    P = np.array([(swing**2) + 0 * noise, 0 * noise, (swing * rig.bandwidth) ** 2 + 0 * noise])
    total = 0.0 * noise
    for k in range(len(draw.y)):
        e = draw.y[k] - scale * x - added[k]
        S = scale * scale * P[0] + noise
        total = total - 0.5 * (e * e / S + np.log(2 * np.pi * S))
        gx, gv = scale * P[0] / S, scale * P[1] / S
        x, v = x + gx * e, v + gv * e
        P = np.array([P[0] - gx * S * gx, P[1] - gx * S * gv, P[2] - gv * S * gv])
        u, h = draw.u[k], 0.5 * dt
        ax, av, _ = slopes(x, v, u)
        # The transition over a period, to third order in it.
        b = 1 + av * h + (av * av + ax) * dt * dt / 6
        F00, F01 = 1 + ax * dt * dt / 2 * (1 + av * dt / 3), dt * b
        F10, F11 = ax * F01, F00 + av * F01
        a1 = f(x, v, u)
        v2 = v + h * a1
        a2 = f(x + h * v, v2, u)
        v3 = v + h * a2
        a3 = f(x + h * v2, v3, u)
        v4 = v + dt * a3
        a4 = f(x + dt * v3, v4, u)
        x, v = x + dt * (v + 2 * v2 + 2 * v3 + v4) / 6, v + dt * (a1 + 2 * a2 + 2 * a3 + a4) / 6
        p0, p1, p2 = P
        P = np.array([
            F00 * F00 * p0 + 2 * F00 * F01 * p1 + F01 * F01 * p2 + push * dt**4 / 4,
            F00 * F10 * p0 + (F00 * F11 + F01 * F10) * p1 + F01 * F11 * p2 + push * dt**3 / 2,
            F10 * F10 * p0 + 2 * F10 * F11 * p1 + F11 * F11 * p2 + push * dt * dt,
        ])  # fmt: skip
    return np.where(np.isfinite(total), total, -1e12)


def measure_visibility(draw: Draw) -> float:
    """Return the share of the logged u that the stated law leaves, from its best initial state.

    An integral takes a wrong constant over, and a limit that is never reached is none.
    """
    law = draw.rig.law
    assert law is not None
    size = max(len(law.num), len(law.den))
    num, den = (np.pad(v, (0, size - len(v))) for v in (law.num, law.den))
    own = lfilter(num, den, draw.r - draw.y)
    states = np.eye(size - 1)
    free = np.stack([lfilter(num, den, np.zeros(len(own)), zi=z)[0] for z in states], axis=1)
    left = draw.u - law.bias - own
    left = left - free @ np.linalg.lstsq(free, left, rcond=1e-12)[0]
    return float(np.mean(left**2) / np.var(draw.u))


def fit_filter(draw: Draw, sensor: bool, start: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the largest likelihood near `start`, over `compute_log_likelihoods`, and where it is.

    Its gradient is one of finite differences, all of which are filtered at once.
    """
    m, width, free = len(start), 1e-5, len(FREE[draw.rig.plant])

    def cost(theta: np.ndarray) -> tuple[float, np.ndarray]:
        steps = width * np.hstack([np.eye(m), -np.eye(m), np.zeros((m, 1))])
        with np.errstate(all="ignore"):
            values = -compute_log_likelihoods(draw, theta[:, None] + steps, sensor)
        return float(values[-1]), (values[:m] - values[m : 2 * m]) / (2 * width)

    bounds = [(-1.5, 1.5)] * free + [(-1.5, 3.0), (-12.0, 2.0)] + [(-50.0, 50.0)] * (m - free - 2)
    found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds,
                     options={"maxiter": 40})  # fmt: skip
    return -float(found.fun), found.x


def measure_worth(draw: Draw) -> float:
    """Return what the sensor's effect gains of log-likelihood after recalibration.

    Each fit starts where the other ended, so that neither is lost where the other is not.
    """
    free = len(FREE[draw.rig.plant])
    extra = 1 if draw.shape is None else len(draw.shape)
    without, theta = fit_filter(draw, False, np.r_[np.zeros(free + 1), -3.0])
    within, theta = fit_filter(draw, True, np.r_[theta, np.zeros(extra)])
    again, _ = fit_filter(draw, False, theta[: free + 2])
    return within - max(without, again)
