"""Draws of the frozen study: six plants, what is hidden in them, and what it is worth there.

They share plants, controllers and noises with ``outside_rigs.py`` and know nothing of ctrlid. The
classes are

- ``clean``: nothing is hidden in plant or sensor, under the nine noises;
- ``rubbing``: the same of a plant with dry friction worth 50 to 30 000, which its model has as
  well, of a size that is up to a fifth off and free;
- ``one``: an effect of plant or sensor that is worth 50 to 30 000; ``faint``: one worth 5 to 50;
- ``two``, ``three``: each worth 50 to 30 000, the last one beside the others;
- ``outside``: worth 50 to 30 000, and in no catalogue;
- ``parameter``: one that is called exact is 2 % off.

Worths are drawn log-uniformly, and the size is found that has it. No draw is thrown away but for a
loop without margins: an effect that would upset its loop before it is worth so much keeps the
largest size that does not. What is uncertain is stated as it was drawn: a parameter by its standard
deviation, the bias of the input as unknown; the operating point is that of the given values. The
controller is stated exactly in two thirds of the draws, with a gain that is 3 to 10 % off in a
sixth, and not at all in the rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import outside_plants as op
import outside_rigs as rigs
from outside_worth import LAWS, WHITE, Truth, measure_worth
from scipy.signal import cont2discrete

CLASSES = ("clean", "rubbing", "one", "faint", "two", "three", "outside", "parameter")
WORTH = {"rubbing": (50.0, 3e4), "faint": (5.0, 50.0), "one": (50.0, 3e4), "two": (50.0, 3e4),
         "three": (50.0, 3e4), "outside": (50.0, 3e4)}  # fmt: skip
# How far the friction that a model has may be off, as a share.
GIVEN_FRICTION = 0.2
FREE = {
    "ball": ("K", "b"), "drive": ("k", "c", "b"), "pendulum": ("m", "c", "b"),
    "spring": ("s", "c", "b"), "cart": ("M", "b"), "tanks": ("o1", "o2", "k"),
}  # fmt: skip
# A parameter that is called exact: one that the free ones do not take up.
EXACT = {"ball": "g", "drive": "", "pendulum": "l", "spring": "", "cart": "l", "tanks": "A"}
MECHANICAL = ("ball", "drive", "pendulum", "spring", "cart")
ANY = op.PLANTS
# The plants on which an effect is no free parameter in disguise.
HOSTS = {
    "InputDelay": ANY, "ActuatorLag": ANY, "InputSaturation": ANY, "InputDeadZone": ANY,
    "InputBacklash": ANY, "InputNonlinearity": ANY, "InputSaturatingGain": ANY,
    "ViscousFriction": ("ball", "cart"),
    "AsymmetricViscousFriction": ("drive", "pendulum", "spring", "cart"),
    "CoulombFriction": MECHANICAL, "AsymmetricCoulombFriction": ("drive", "pendulum", "spring"),
    "StribeckFriction": ("drive", "pendulum", "spring"),
    "QuadraticDrag": MECHANICAL, "EddyCurrentDamping": ("ball",),
    "LinearStiffness": ("ball", "drive", "pendulum", "cart"),
    "CubicStiffness": ("ball", "drive", "pendulum", "spring"),
    "ConstantForce": ("ball",), "PeriodicForce": ("ball", "drive", "pendulum", "spring"),
    "PositionRipple": ("drive", "pendulum", "spring"),
    "FlexibleMode": ("drive", "pendulum", "spring"),
    "PositionOffset": ("ball",), "ForceExponent": ("ball",),
    "ParameterDrift": ANY, "ParameterStep": ANY,
    "SensorLag": ANY, "SensorNonlinearity": ANY, "SensorGain": ("ball",),
    "SensorDrift": ("ball", "pendulum", "spring", "cart", "tanks"),
    "SensorHum": ANY,
    # No limit of the sensor: readings that sit on it are read off the log, and no filter weighs it.
}  # fmt: skip
OUTSIDE = {
    "rate limit": ANY, "changing lag": ANY, "cubic drag": MECHANICAL, "soft stop": MECHANICAL,
    "hysteresis": MECHANICAL, "loss of gain": ANY, "play of the sensor": ANY,
    "growing noise": ANY,
}  # fmt: skip
# What was outside until the catalogue had it: its name there, and the first seed that knows of it.
ENTERED = {"rate limit": ("InputRateLimit", 96000)}
# Names that no record can tell apart, by plants.
SAME = (
    ({"ActuatorLag", "SensorLag"}, ("drive", "spring")),
    ({"PeriodicForce", "SensorHum"}, ("drive", "spring")),
    ({"ConstantForce", "InputOffset"}, ("drive", "pendulum", "spring")),
    # The bias of the input is free, and takes what friction has more in one direction.
    ({"CoulombFriction", "AsymmetricCoulombFriction"}, ("drive", "pendulum", "spring")),
    ({"PositionOffset", "SensorOffset"}, ("ball", "pendulum")),
    ({"ConstantForce", "SensorGain", "parameter g"}, ("ball",)),
)
TRIES = 200
LARGEST = 30.0  # times what is easily seen: beyond, a lag is longer than the record
NEAR = 0.25  # a size is found where the logarithm of its worth is so near to what was drawn


@dataclass(frozen=True)
class Rig:
    """What is drawn before anything is hidden."""

    plant: str
    true: dict[str, float]
    given: dict[str, float]
    deviation: dict[str, float]
    dt: float
    at: np.ndarray  # position, input and output at rest, sampling period
    x0: np.ndarray
    num: np.ndarray
    den: np.ndarray
    closed: bool
    swing: float
    bandwidth: float
    push: float
    sigma: float
    span: float  # of the input, about
    reference: str
    stated: str  # "exact", "gain" or "unknown"
    stated_gain: float


@dataclass(frozen=True)
class Case:
    """A record, what its user is told, and the truth."""

    name: str
    seed: int
    rig: Rig
    noise: str
    r: np.ndarray
    u: np.ndarray
    y: np.ndarray
    hidden: tuple[str, ...]
    sizes: tuple[dict[str, float], ...]
    worth: tuple[float, ...]
    wanted: float
    redrawn: int
    # Whether nothing of the input reaches the plant, so that no record tells what keeps it away.
    swallowed: bool = False
    # Dry friction that the model has as well [output unit/s^2], as its user gives it; zero: none.
    friction: float = 0.0


def make_array(plant: str, p: dict[str, float]) -> np.ndarray:
    """Return parameters in the order of the simulator."""
    return np.array([p[name] for name in op.PARAMETERS[op.PLANTS.index(plant)]], float)


def compute_rates(plant: str, p: np.ndarray, x: np.ndarray, w: float) -> np.ndarray:
    """Return the rates of a plant's own states, nothing hidden."""
    k = op.PLANTS.index(plant)
    full, dx = np.zeros(op.MOST), np.zeros(op.MOST)
    full[:2] = x
    op.accelerate(k, p, op.make_neutral(), np.array([1.0, 0, 0, 1.0]), full, w, 0.0, 0.0, dx)
    return dx[:2].copy()


def linearize(plant: str, p: np.ndarray, x: np.ndarray, w: float) -> tuple[np.ndarray, np.ndarray]:
    """Return A and B at a point, by differences."""
    n = len(x)
    scale = 1e-5 * np.maximum(np.abs(x), 1e-3)
    columns = [
        (compute_rates(plant, p, x + s * row, w) - compute_rates(plant, p, x - s * row, w))
        / (2 * s)
        for s, row in zip(scale, np.eye(n), strict=True)
    ]
    h = 1e-5 * max(abs(w), 1e-2)
    b = (compute_rates(plant, p, x, w + h) - compute_rates(plant, p, x, w - h)) / (2 * h)
    return np.array(columns).T, b[:, None]


def draw_parameters(rng: np.random.Generator, plant: str) -> tuple[dict[str, float], float, float]:
    """Return parameters without a bias, the set-point and the pole that sets the time scale."""
    if plant == "cart":
        p = {"M": rng.uniform(0.3, 2.0), "m": rng.uniform(0.05, 0.3), "l": rng.uniform(0.2, 0.8)}
        pole = math.sqrt(rigs.G * (1 + p["m"] / p["M"]) / p["l"])
        return p | {"g": rigs.G}, 0.0, pole
    if plant == "tanks":
        area, level = rigs.log_uniform(rng, 5e-3, 0.2), rng.uniform(0.05, 0.5)
        time = rigs.log_uniform(rng, 5.0, 60.0)
        out = area * math.sqrt(2 * level / 9.81) / time  # the time constant of the lower tank
        p = {"A": area, "o1": out * rng.uniform(0.9, 1.6), "o2": out, "g": 9.81}
        p["k"] = out * math.sqrt(2 * 9.81 * level) / rng.uniform(2, 8)
        return p, level, 1 / time
    p, at, pole = rigs.draw_plant(rng, plant)
    if plant in ("ball", "pendulum"):
        p["g"] = rigs.G
    return p, float(at), pole


def find_rest(plant: str, p: dict[str, float], at: float) -> tuple[float, np.ndarray]:
    """Return the input and the states at rest at an output."""
    if plant == "ball":
        return math.sqrt(p["m"] * p["g"] / p["K"]) * at - p["b"], np.array([at, 0.0])
    if plant == "drive":
        return -p["b"], np.array([at, 0.0])
    if plant == "pendulum":
        return -p["m"] * p["g"] * p["l"] * math.sin(at) - p["b"], np.array([at, 0.0])
    if plant == "spring":
        return p["s"] * at - p["b"], np.array([at, 0.0])
    if plant == "cart":
        return -p["b"], np.array([at, 0.0])
    flow = p["o2"] * math.sqrt(2 * p["g"] * at)
    return flow / p["k"] - p["b"], np.array([(flow / p["o1"]) ** 2 / (2 * p["g"]), at])


def find_peak(f: np.ndarray, g: np.ndarray, c: np.ndarray, num: Any, den: Any) -> float:
    """Return the peak of 1/(1 + L), infinite where the sampled loop is not stable."""
    plant_den = np.poly(f)
    plant_num = np.poly(f - g @ c) - plant_den
    size = max(len(num), len(den))
    num, den = (np.pad(v, (0, size - len(v))) for v in (num, den))
    open_den, open_num = np.convolve(plant_den, den), np.convolve(plant_num, num)
    total = open_den + open_num
    if np.abs(np.roots(total)).max() > 1 - 1e-4:
        return math.inf
    z = np.exp(1j * np.geomspace(1e-3, np.pi, 400))
    return float(np.abs(np.polyval(open_den, z) / np.polyval(total, z)).max())


def draw_rig(rng: np.random.Generator, plant: str) -> Rig | None:
    """Return a rig, or None where the drawn loop has no sane margins."""
    true, at, pole = draw_parameters(rng, plant)
    if plant != "tanks":
        true["b"] = 0.0
        rest = find_rest(plant, true, at)[0]
        a, b = linearize(plant, make_array(plant, true), find_rest(plant, true, at)[1], rest)
        # A bias of some hundredths of what moves the plant at its bandwidth.
        true["b"] = float(rng.choice([-1, 1]) * rng.uniform(0.005, 0.05)) * abs(
            rest or pole**2 * 0.1 / b[1, 0]
        )
    else:
        true["b"] = 0.0
    w, x0 = find_rest(plant, true, at)
    a, b = linearize(plant, make_array(plant, true), x0, w)
    c = np.eye(2)[[1 if plant == "tanks" else 0]]
    if plant == "tanks":
        band = pole * rng.uniform(1.0, 2.0)
        dt = rng.uniform(0.03, 0.1) / band
        kp = band / abs(b[0, 0]) * rng.uniform(0.4, 1.2)
        ki = kp * pole * rng.uniform(0.3, 0.8)
        num, den = np.array([kp + ki * dt, -kp]), np.array([1.0, -1.0])
        swing = at * rng.uniform(0.05, 0.2)
    else:
        law, dt, band = rigs.draw_law(rng, plant, (a[1, 0], a[1, 1], b[1, 0]), pole, w)
        num, den = np.array(law.num), np.array(law.den)
        low, high = {
            "ball": (0.02 * at, 0.06 * at),
            "drive": (0.1, 1.0),
            "spring": (2e-3, 1e-2),
        }.get(plant, (0.02, 0.15))
        swing = rng.uniform(low, high)
    sigma = swing / rigs.log_uniform(rng, 15, 60)
    closed = plant != "spring" or rng.random() < 0.5
    if not closed:
        dt, band = rng.uniform(0.06, 0.2) / pole, pole
    else:
        f, g, *_ = cont2discrete((a, b, c, np.zeros((1, 1))), dt)
        if find_peak(f, g, c, num, den) > 2.5:
            return None
    push = swing * band**2 * rigs.log_uniform(rng, 1e-3, 3e-2)
    if plant == "tanks":
        push = swing * band * rigs.log_uniform(rng, 1e-3, 3e-2)
    deviation = {name: float(rng.choice([0.02, 0.05, 0.1])) for name in FREE[plant] if name != "b"}
    # The belief is as far off as it says.
    given = true | {
        name: true[name] / (1 + s * np.clip(rng.standard_normal(), -2.5, 2.5))
        for name, s in deviation.items()
    }
    given = {name: float(v) for name, v in given.items()}
    stated = str(rng.choice(["exact", "exact", "exact", "exact", "gain", "unknown"]))
    return Rig(
        plant, true, given | {"b": 0.0}, deviation, float(dt), np.array([x0[0], w, at, dt]), x0,
        np.asarray(num, float), np.asarray(den, float), closed, float(swing), float(band),
        float(push), float(sigma), 0.0, str(rng.choice(["binary", "steps", "multisine"])), stated,
        float(1 + rng.choice([-1, 1]) * rng.uniform(0.03, 0.1)) if stated == "gain" else 1.0,
    )  # fmt: skip


def draw_moves(rng: np.random.Generator, rig: Rig, n: int) -> np.ndarray:
    """Return deviations of the reference, or of the input where the loop is open."""
    swing = rig.swing if rig.closed else rig.swing * rig.true["s"]
    stand_in = rigs.Rig(rig.plant, {}, {}, rig.dt, 0.0, 0.0, None, swing, rig.bandwidth, 0.0, 0.0,
                        rig.reference)  # fmt: skip
    return rigs.draw_reference(rng, stand_in, n)


def draw_colour(rng: np.random.Generator, kind: str, n: int, dt: float) -> tuple:
    """Return noise of size one, periods, the converter's step and the noise of the filter."""
    periods, step = np.full(n, dt), 0.0
    colour, (weights, ratios) = WHITE.copy(), LAWS.get(kind, (np.ones(1), np.ones(1)))
    values, drawn = rigs.draw_noise(rng, kind, 1.0, n, dt)
    if kind == "jitter":
        periods = dt * (1 + rng.uniform(0.01, 0.05) * rng.uniform(-1, 1, n))
    elif kind == "converter":
        step = float(rng.uniform(0.5, 3.0))
        colour[2] = math.sqrt(1 + step**2 / 12)
    elif kind == "ar":
        colour[:3] = drawn["ar"], math.sqrt(1 - drawn["ar"] ** 2), 0.0
    elif kind == "averaged":
        colour[3] = drawn["samples"]
    elif kind == "walk":
        colour[:3] = 1.0, 0.03, 1.0
    elif kind == "pink":
        colour[:3] = 0.95, 0.2, 0.7
    elif kind == "outliers":
        weights = np.array([1 - drawn["share"], drawn["share"]])
    return values, periods, step, colour, weights, ratios


def make_effect(rng: np.random.Generator, name: str, rig: Rig, n: int) -> tuple[dict, Any, int]:
    """Return what is fixed of an effect, a function of its size (one is visible), and its index.

    Sizes are in what moves: accelerations of the swing at the bandwidth, ranges of the input.
    """
    a, v = rig.swing * rig.bandwidth**2, rig.swing * rig.bandwidth
    if rig.plant == "tanks":
        v = rig.swing
    span, dt = rig.span, rig.dt
    hertz = rig.bandwidth / (2 * math.pi)
    end = n * dt
    sign = float(rng.choice([-1, 1]))
    names = op.PARAMETERS[op.PLANTS.index(rig.plant)]
    which = float(names.index(str(rng.choice([f for f in FREE[rig.plant] if f != "b"]))))
    phase = float(rng.uniform(0, 2 * math.pi))
    one = lambda key, unit: lambda s: {key: s * unit}  # noqa: E731
    table: dict[str, tuple[dict, Any, str]] = {
        "InputDelay": ({}, lambda s: {"delay": min(s, 6.0)}, "delay"),
        "ActuatorLag": ({}, one("lag", dt), "lag"),
        "InputSaturation": ({}, lambda s: {
            "upper": rig.at[1] + span / (0.5 + s), "lower": rig.at[1] - span / (0.5 + s)}, ""),
        "InputDeadZone": ({}, one("deadzone", 0.2 * span), "deadzone"),
        "InputBacklash": ({}, one("backlash", 0.2 * span), "backlash"),
        "InputNonlinearity": ({}, one("curvature", sign * 0.1 / span), "curvature"),
        "InputSaturatingGain": ({}, one("saturation", 0.1 / (span + abs(rig.at[1])) ** 2),
                                "saturation"),
        "ViscousFriction": ({}, one("viscous", 0.1 * rig.bandwidth), "viscous"),
        "AsymmetricViscousFriction": ({}, one("asymmetric", sign * 0.1 * rig.bandwidth),
                                      "asymmetric"),
        "CoulombFriction": ({}, one("coulomb", 0.05 * a), "coulomb"),
        "AsymmetricCoulombFriction": ({}, lambda s: {
            "coulomb": s * 0.05 * a, "coulomb_difference": sign * s * 0.02 * a}, "coulomb"),
        "StribeckFriction": ({"stribeck_v": 0.3 * v}, one("stribeck", 0.05 * a), "stribeck"),
        "QuadraticDrag": ({}, one("drag", 0.1 * a / v**2), "drag"),
        "EddyCurrentDamping": ({}, one("eddy", 0.1 * rig.bandwidth / max(rig.at[1] ** 2, 1e-12)),
                               "eddy"),
        "LinearStiffness": ({}, one("stiffness", sign * 0.05 * rig.bandwidth**2), "stiffness"),
        "CubicStiffness": ({}, one("cubic", sign * 0.1 * a / rig.swing**3), "cubic"),
        "ConstantForce": ({}, one("force", sign * 0.02 * rigs.G), "force"),
        "PeriodicForce": ({"periodic_f": hertz * rigs.log_uniform(rng, 0.3, 2.0),
                           "periodic_phase": phase}, one("periodic", 0.05 * a), "periodic"),
        "PositionRipple": ({"ripple_period": rig.swing * rigs.log_uniform(rng, 0.2, 1.0),
                            "ripple_phase": phase}, one("ripple", 0.05 * a), "ripple"),
        "FlexibleMode": ({"mode_f": hertz * rigs.log_uniform(rng, 1.5, 4.0),
                          "mode_damping": rigs.log_uniform(rng, 0.005, 0.1)},
                         lambda s: {"mode_share": min(0.03 * s, 0.6)}, "mode_share"),
        "PositionOffset": ({}, one("position", sign * 0.02 * abs(rig.at[2])), "position"),
        "ForceExponent": ({}, lambda s: {"exponent": float(np.clip(2 + sign * 0.1 * s, 0.6, 5.9))},
                          ""),
        # No parameter changes its sign before the end.
        "ParameterDrift": ({"which": which}, lambda s: {"drift": sign * min(0.05 * s, 0.8) / end},
                           "drift"),
        "ParameterStep": ({"which": which, "step_time": end * rng.uniform(0.15, 0.85)},
                          one("step", sign * 0.03), "step"),
        "SensorLag": ({}, one("sensor_lag", 0.3 * dt), "sensor_lag"),
        # Nor is any reading that of two positions.
        "SensorNonlinearity": ({}, lambda s: {"bend": sign * min(0.05 * s, 0.15) / rig.swing},
                               "bend"),
        "SensorGain": ({}, one("scale", sign * 0.01), "scale"),
        "SensorDrift": ({}, one("sensor_drift", sign * 3 * rig.sigma / end), "sensor_drift"),
        "SensorHum": ({"hum_f": float(rng.uniform(0.05, 0.45)) / dt, "hum_phase": phase},
                      one("hum", 0.3 * rig.sigma), "hum"),
        **dict.fromkeys(("rate limit", "InputRateLimit"),
                        ({}, lambda s: {"rate": span / dt / (0.5 + s)}, "")),
        "changing lag": ({"changing_f": hertz * rng.uniform(0.05, 0.3)}, one("changing", dt), ""),
        "cubic drag": ({}, one("cubic_drag", 0.1 * a / v**3), "cubic_drag"),
        "soft stop": ({"reach": 0.6 * rig.swing}, one("soft_stop", 0.3 * rig.bandwidth**2),
                      "soft_stop"),
        "hysteresis": ({"bouc_wen_way": 0.3 * rig.swing}, one("bouc_wen", 0.05 * a), "bouc_wen"),
        "loss of gain": ({"which": which, "loss_f1": hertz * rng.uniform(0.02, 0.1),
                          "loss_f2": hertz * rng.uniform(0.1, 0.3)},
                         lambda s: {"loss": min(0.05 * s, 0.9)}, "loss"),
        "play of the sensor": ({}, one("play", 0.1 * rig.swing), "play"),
        "growing noise": ({}, one("growth", 0.2 / rig.swing), "growth"),
    }  # fmt: skip
    fixed, sized, main = table[name]
    return fixed, sized, op.I[main] if main else -1


def draw_case(name: str, seed: int, n: int = 1500) -> Case:
    """Return a draw of a class, with its worth.

    Parameters
    ----------
    name : str
        One of `CLASSES`.
    seed, n : int
        Seed, and number of samples.

    Returns
    -------
    Case
        The draw. Only loops without margins, or that leave their range with nothing hidden, are
        drawn again, and counted.
    """
    plant = op.PLANTS[seed % len(op.PLANTS)]
    if name == "parameter":
        plants = [p for p, exact in EXACT.items() if exact]
        plant = plants[seed % len(plants)]
    if name == "rubbing":
        plant = MECHANICAL[seed % len(MECHANICAL)]
    for attempt in range(TRIES):
        rng = np.random.default_rng([seed, *name.encode(), attempt])
        rig = draw_rig(rng, plant)
        if rig is None:
            continue
        kinds = rigs.NOISES
        still = name in ("clean", "rubbing")
        white = still and seed // len(op.PLANTS) % len(kinds) == 0
        white = white or (not still and rng.random() < 0.5)
        kind = "white" if white else str(rng.choice(kinds[1:]))
        made = _fill_rig(rng, name, seed, rig, kind, n, attempt)
        if made is not None:
            return made
    raise RuntimeError(f"no stable draw of {name} with seed {seed} in {TRIES} tries")


def list_hosts(name: str, seed: int) -> dict[str, Sequence[str]]:
    """Return what a draw of a class may hide, each with the plants that may have it."""
    entered = {k: known for k, (known, first) in ENTERED.items() if seed >= first}
    if name == "outside":
        return {k: plants for k, plants in OUTSIDE.items() if k not in entered}
    return {**HOSTS, **{known: OUTSIDE[k] for k, known in entered.items()}}


def _fill_rig(
    rng: np.random.Generator, name: str, seed: int, rig: Rig, kind: str, n: int, attempt: int
) -> Case | None:
    """Return the case of a rig, or None where it leaves its range with nothing hidden."""
    plant = op.PLANTS.index(rig.plant)
    moves = draw_moves(rng, rig, n)
    noise, periods, step, colour, weights, ratios = draw_colour(rng, kind, n, rig.dt)
    pushes = rig.push * rng.standard_normal(n)
    p = make_array(rig.plant, rig.true)
    reach = {"ball": 0.4 * rig.at[2], "pendulum": 0.7, "cart": 0.7, "tanks": 0.9 * rig.at[2]}.get(
        rig.plant, 1e3 * rig.swing
    )
    x0 = np.zeros(op.MOST)
    x0[:2] = rig.x0
    x0[5:] = rig.at[2]

    def run(e: np.ndarray, p: np.ndarray = p) -> tuple[np.ndarray, np.ndarray, bool]:
        return op.simulate(plant, p, e, rig.at, x0, rig.num, rig.den, rig.closed, moves, pushes,
                           rig.sigma * noise, periods, step * rig.sigma, reach)  # fmt: skip

    u, y, ok = run(op.make_neutral())
    if not ok:
        return None
    rig = replace(rig, span=float(np.quantile(np.abs(u - rig.at[1]), 0.95)))
    velocity = rig.swing * rig.bandwidth
    spread = np.full(op.MOST, rig.swing)
    if rig.plant != "tanks":
        spread[1] = velocity
    spread *= 0.1
    free = {f: (rig.given[f], rig.deviation[f] * rig.given[f] if f != "b" else np.inf)
            for f in FREE[rig.plant]}  # fmt: skip
    bias = max(abs(rig.true["b"]), 0.05 * rig.span)
    truth = Truth(plant, p, op.make_neutral(), rig.at, x0, spread, rig.sigma, rig.push, colour,
                  weights, ratios, free, bias)  # fmt: skip
    hidden: list[str] = []
    sizes: list[dict[str, float]] = []
    worth: list[float] = []
    wanted = 0.0
    e = op.make_neutral()
    if name == "parameter":
        key = EXACT[rig.plant]
        factor = 1 + float(rng.choice([-1, 1])) * 0.02
        told = replace(rig, given=rig.given | {key: rig.true[key] / factor})
        wrong = replace(truth, u=u, y=y)
        worth.append(_weigh_parameter(wrong, rig.plant, key, factor))
        hidden.append(f"parameter {key}")
        sizes.append({key: factor})
        rig = told
    elif name != "clean":
        host = list_hosts(name, seed)
        count = {"two": 2, "three": 3}.get(name, 1)
        able = [k for k, where in host.items() if rig.plant in where]
        # Every name in turn, so that no class of effects is rare.
        first = able[(seed // len(op.PLANTS) + 5 * (seed % len(op.PLANTS))) % len(able)]
        hidden = ["CoulombFriction" if name == "rubbing" else first]
        while len(hidden) < count:
            # A plant has one change of a parameter at most, and no two that are one.
            k = str(rng.choice(able))
            changes = k.startswith("Parameter") and any(h.startswith("Parameter") for h in hidden)
            if not changes and not any(is_same(k, h, rig.plant) for h in hidden):
                hidden.append(k)
        low, high = WORTH[name]
        indices: list[int] = []
        for k in hidden:
            wanted = rigs.log_uniform(rng, low, high)
            fixed, sized, index = make_effect(rng, k, rig, n)
            without = e.copy()
            found = _find_size(truth, run, without, fixed, sized, wanted, tuple(indices))
            e, size, value, u, y = found
            worth.append(value)
            sizes.append({**fixed, **sized(size)})
            if index >= 0:
                indices.append(index)
        if len(hidden) > 1:
            # Each beside all the others, on the record as it is.
            final = replace(truth, e=e, u=u, y=y)
            worth = [
                measure_worth(final, _switch_off(e, values), _list_other_indices(values, indices))[
                    0
                ]
                for values in sizes
            ]
    # Then the output is that of the same plant whose input stands still, with the same noise.
    still = op.simulate(plant, p, e, rig.at, x0, rig.num, rig.den, False, 0.0 * moves, pushes,
                        rig.sigma * noise, periods, step * rig.sigma, reach)[1]  # fmt: skip
    swallowed = bool(np.allclose(still, y, rtol=0.0, atol=1e-6 * rig.sigma))
    friction = 0.0
    if name == "rubbing":
        # Nobody is asked for what the model has.
        friction = sizes[0]["coulomb"] * (1 + GIVEN_FRICTION * float(rng.uniform(-1, 1)))
        hidden, sizes, worth = [], [], []
    r = moves + rig.at[2] if rig.closed else moves + rig.at[1]
    return Case(name, seed, rig, kind, r, u, y, tuple(hidden), tuple(sizes), tuple(worth), wanted,
                attempt, swallowed, friction)  # fmt: skip


def _list_other_indices(values: dict[str, float], indices: list[int]) -> tuple[int, ...]:
    """Return the indices of the sizes of all effects but the one that has these values."""
    own = {op.I[key] for key in values}
    return tuple(i for i in indices if i not in own)


def _switch_off(e: np.ndarray, values: dict[str, float]) -> np.ndarray:
    """Return the effects with one of them switched off."""
    out, off = e.copy(), op.make_neutral()
    for key in values:
        out[op.I[key]] = off[op.I[key]]
    return out


def _insert_values(e: np.ndarray, values: dict[str, float]) -> np.ndarray:
    """Return the effects with the values of one more."""
    out = e.copy()
    for key, value in values.items():
        out[op.I[key]] = value
    return out


def _find_size(
    truth: Truth, run: Any, e: np.ndarray, fixed: dict, sized: Any, wanted: float,
    indices: tuple[int, ...],
) -> tuple[np.ndarray, float, float, np.ndarray, np.ndarray]:  # fmt: skip
    """Return the size of an effect that is worth what was drawn, nearly, and its record."""

    def weigh(size: float, start: Any) -> tuple | None:
        full = _insert_values(e, {**fixed, **sized(size)})
        u, y, ok = run(full)
        if not ok or not np.isfinite(y).all():
            return None
        worth, theta = measure_worth(replace(truth, e=full, u=u, y=y), e, indices, start)
        return (full, size, worth, u, y, theta) if np.isfinite(worth) else None

    low, high = 0.0, LARGEST
    size, best = 1.0, None
    start = np.zeros(len(truth.free) + 2 + int(0 < truth.colour[0] < 1) + len(indices))
    for _ in range(14):
        found = weigh(size, start)
        if found is None:
            high = size
        else:
            start = found[5]
            off = math.log(max(found[2], 1e-3) / wanted)
            if best is None or abs(off) < abs(math.log(max(best[2], 1e-3) / wanted)):
                best = found
            if abs(off) < NEAR:
                break
            if off < 0:
                low = max(low, size)
            else:
                high = min(high, size)
        if found is not None:
            step = size * float(np.clip(math.exp(-0.5 * off), 0.1, 6.0))
        else:
            step = size / 3
        if not low < step < high:
            step = math.sqrt(low * high) if low else 0.5 * size
            if low and high / low < 1.02:
                break
        size = step
    if best is None:
        full = e.copy()
        u, y, _ = run(full)
        return full, 0.0, 0.0, u, y
    # The search followed one optimum of the noise from size to size; there may be a better one.
    worth, _ = measure_worth(replace(truth, e=best[0], u=best[3], y=best[4]), e, indices)
    best = (*best[:2], min(worth, best[2]), *best[3:])
    return best[:5]


def _weigh_parameter(truth: Truth, plant: str, key: str, factor: float) -> float:
    """Return what the true value of a parameter is worth beside the one that is called exact."""
    index = op.PARAMETERS[op.PLANTS.index(plant)].index(key)
    wrong = truth.p.copy()
    wrong[index] /= factor
    return measure_worth(replace(truth, p=wrong), truth.e, right=truth)[0]


def is_same(one: str, other: str, plant: str) -> bool:
    """Whether no record of a plant can tell two names apart."""
    return one == other or any(
        one in names and other in names and plant in plants for names, plants in SAME
    )
