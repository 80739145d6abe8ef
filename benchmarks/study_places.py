"""Measure which effects diagnose names, and where, on plants of two outputs drawn at random.

Run it as ``python benchmarks/study_places.py --runs 100 --jobs 2``. ``--first 7 --runs 1`` draws
the run of that number alone.

Each run draws a cart with a pole or a rotary pendulum, with parameters of its own, and a digital
LQR that reads an observer or differences of the outputs; a dither is added to the input. One effect
hides at an input, a velocity or an output of every second one, and nothing in the others. What is
simulated here shares no equation, integrator or design with ctrlid: numpy and scipy alone make the
record. The sensor noise of each output is white, and two parameters of the model are up to 5 % off.

It prints, each with its 95 % interval by Wilson,

- clean: the share of the records without an effect in which one is named all the same;
- named: the share of the others with the effect and its place among the names of a finding, first
  of the records that its size shows in (evidence of 50 or more), and then of all;
- blamed: the share of the others in which some other effect is named, and the hidden one is not.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import control as ct
import joblib
import numpy as np
from _random_loops import log_uniform
from _shares import wilson
from scipy import linalg

import ctrlid as cid

SAMPLES, SUBSTEPS = 1500, 16
LARGE = 50.0
FREE = {"cart_pole": ("m", "c"), "rotary_pendulum": ("arm_inertia", "c")}


@dataclass(frozen=True)
class Rig:
    """A mechanism of two coordinates, ``mass(q) a = load(q, v) + (drive + force, torque)``."""

    kind: str
    parameters: dict[str, float]
    mass: Callable[[Any], tuple[float, float, float]]
    load: Callable[[Any, Any], tuple[float, float]]
    drive: Callable[[float, float], float]
    size: float

    @property
    def pace(self) -> float:
        """Rate at which the pendulum falls, about [rad/s]."""
        return math.sqrt(9.81 / self.parameters["length"])


def draw_rig(rng: np.random.Generator) -> Rig:
    """Draw a cart with a pole or a rotary pendulum."""
    return draw_cart(rng) if rng.random() < 0.5 else draw_furuta(rng)


def draw_cart(rng: np.random.Generator) -> Rig:
    """Draw a cart with a pole; `size` is what its position moves, about [m]."""
    M, length = log_uniform(rng, 0.3, 2), log_uniform(rng, 0.15, 0.8)
    m, c = M * rng.uniform(0.2, 0.8), M * rng.uniform(0.2, 2)
    J = m * length**2 / 3
    gamma = 0.02 * m * length**2

    def mass(q: Any) -> tuple[float, float, float]:
        return M + m, -m * length * math.cos(q[1]), J + m * length**2

    def load(q: Any, v: Any) -> tuple[float, float]:
        s = math.sin(q[1])
        return (-c * v[0] - m * length * s * v[1] ** 2, -gamma * v[1] + m * 9.81 * length * s)

    values = {"M": M, "m": m, "length": length, "J": J, "c": c, "gamma": gamma}
    return Rig("cart_pole", values, mass, load, lambda u, rate: u, 0.3 * length)


def draw_furuta(rng: np.random.Generator) -> Rig:
    """Draw a rotary pendulum; `size` is what its arm moves, about [rad]."""
    m, length = log_uniform(rng, 0.02, 0.2), log_uniform(rng, 0.06, 0.3)
    arm, kt = length * rng.uniform(0.8, 1.6), log_uniform(rng, 0.03, 0.3)
    inertia, J = m * arm**2 * rng.uniform(0.2, 1), m * length**2 / 3
    R = kt**2 / ((inertia + m * arm**2) * math.sqrt(9.81 / length) * rng.uniform(0.1, 1))
    c, gamma, whole = 0.5 * inertia, 0.02 * m * length**2, J + m * length**2

    def mass(q: Any) -> tuple[float, float, float]:
        return (inertia + m * arm**2 + whole * math.sin(q[1]) ** 2,
                m * arm * length * math.cos(q[1]), whole)  # fmt: skip

    def load(q: Any, v: Any) -> tuple[float, float]:
        s, twice = math.sin(q[1]), whole * math.sin(2 * q[1])
        return (-c * v[0] - twice * v[0] * v[1] + m * arm * length * s * v[1] ** 2,
                -gamma * v[1] + 0.5 * twice * v[0] ** 2 + m * 9.81 * length * s)  # fmt: skip

    values = {"m": m, "length": length, "arm": arm, "arm_inertia": inertia, "kt": kt, "R": R,
              "J": J, "c": c, "gamma": gamma}  # fmt: skip
    return Rig("rotary_pendulum", values, mass, load, lambda u, rate: kt / R * (u - kt * rate), 0.3)


def accelerate(rig: Rig, q: Any, v: Any, u: float, extra: Any) -> Any:
    """Return the accelerations under an input and further generalized forces."""
    a, b, d = rig.mass(q)
    first, second = rig.load(q, v)
    first, second = first + rig.drive(u, v[0]) + extra[0], second + extra[1]
    det = a * d - b * b
    return np.array([(d * first - b * second) / det, (a * second - b * first) / det])


@dataclass(frozen=True)
class Hidden:
    """What is hidden: the names that may be said, and its size at each of its three places."""

    names: tuple[str, ...] = ()
    dry: tuple[float, float] = (0.0, 0.0)
    drag: float = 0.0
    spring: float = 0.0
    dead: float = 0.0
    lag: float = 0.0
    gain: float = 0.0
    slow: float = 0.0


def choose_hidden(
    rig: Rig, rng: np.random.Generator, force: float, rates: Any, dt: float
) -> Hidden:
    """Choose an effect by what the loop does without: RMS of input's force and of the rates."""
    plant = build_plant(rig, rig.parameters)
    (u,), velocities, outputs = plant.input_labels, plant.state_labels[2:], plant.output_labels
    share = rng.uniform(0.05, 0.2)
    torque = share * rig.parameters["m"] * 9.81 * rig.parameters["length"] * 0.1
    choices = (
        Hidden((f"CoulombFriction at {velocities[0]}",), dry=(share * force, 0.0)),
        Hidden((f"CoulombFriction at {velocities[1]}",), dry=(0.0, torque)),
        Hidden((f"QuadraticDrag at {velocities[0]}",), drag=share * force / rates[0] ** 2),
        Hidden((f"LinearStiffness at {velocities[0]}",), spring=share * force / rig.size),
        Hidden((f"InputDeadZone at {u}",), dead=share),
        Hidden((f"ActuatorLag at {u}", f"InputDelay at {u}"), lag=2 * dt * rng.uniform(0.5, 2)),
        Hidden((f"SensorGain at {outputs[1]}",), gain=rng.uniform(0.05, 0.15)),
        Hidden((f"SensorLag at {outputs[1]}",), slow=2 * dt * rng.uniform(0.5, 2)),
    )
    return choices[rng.integers(len(choices))]


def make_controller(rig: Rig, dt: float, rng: np.random.Generator) -> tuple[Any, ...]:
    """Return the matrices A, B, C, D of a law that reads both outputs and the input."""
    a, h = np.zeros((4, 4)), 1e-6
    a[:2, 2:] = np.eye(2)
    zero = np.zeros(2)
    rest = accelerate(rig, zero, zero, 0.0, zero)
    for k in range(2):
        a[2:, k] = (accelerate(rig, h * np.eye(2)[k], zero, 0.0, zero) - rest) / h
        a[2:, 2 + k] = (accelerate(rig, zero, h * np.eye(2)[k], 0.0, zero) - rest) / h
    b = np.append(zero, (accelerate(rig, zero, zero, h, zero) - rest) / h)[:, None]
    reach = abs(float(b[2, 0])) / rig.pace**2 / rig.size
    both = linalg.expm(dt * np.block([[a, b], [np.zeros((1, 5))]]))
    a, b = both[:4, :4], both[:4, 4:]
    weights = np.diag([1.0, 1.0, rig.pace**-2, rig.pace**-2])
    weights[0, 0] /= rig.size**2
    weights[2, 2] /= rig.size**2
    cost = rng.uniform(0.3, 3) * reach**2 * np.eye(1)
    p = linalg.solve_discrete_are(a, b, weights, cost)
    gain = np.linalg.solve(cost + b.T @ p @ b, b.T @ p @ a)
    if rng.random() < 0.5:
        c = np.eye(2, 4)
        noise = 1e-3 * float(np.max(b**2)) * np.diag([rig.size**2, 1.0])
        s = linalg.solve_discrete_are(a.T, c.T, b @ b.T + 1e-12 * np.eye(4), noise)
        slow = a @ s @ c.T @ np.linalg.inv(c @ s @ c.T + noise)
        return a - slow @ c, np.hstack([slow, b]), -gain, np.zeros((1, 3))
    # Velocities are differences, smoothed over a few samples: d+ = s d + (1 - s)(y - y-)/dt.
    s, eye, none = 0.5, np.eye(2), np.zeros((2, 2))
    A = np.block([[none, none], [-(1 - s) / dt * eye, s * eye]])
    B = np.hstack([np.vstack([eye, (1 - s) / dt * eye]), np.zeros((4, 1))])
    rate = gain[:, 2:]
    return (A, B, -rate @ A[2:], -np.hstack([gain[:, :2] + rate @ B[2:, :2], np.zeros((1, 1))]))


def simulate(
    rig: Rig, law: tuple[Any, ...], dt: float, dither: Any, hidden: Hidden, sizes: Any,
    push: float, rng: np.random.Generator,
) -> tuple[Any, Any, Any]:  # fmt: skip
    """Return outputs, input and rates; the step is split so finely that dry friction can hold."""
    n, h = len(dither), dt / SUBSTEPS
    a, b, d = rig.mass(np.zeros(2))
    inverse = np.array([d, a]) / (a * d - b * b)
    width = np.maximum(np.array(hidden.dry) * inverse * h, 1e-12)
    A, B, C, D = law
    q, v, z = np.zeros(2), np.zeros(2), np.zeros(len(A))
    shown, moved = np.zeros(2), 0.0
    ys, us, vs = np.empty((2, n)), np.empty(n), np.empty((2, n))
    dead = hidden.dead * float(np.std(dither))

    def rate(q: Any, v: Any, u: float, noise: float) -> Any:
        extra = (
            noise - hidden.dry[0] * math.tanh(v[0] / width[0]) - hidden.drag * v[0] * abs(v[0])
            - hidden.spring * q[0],
            -hidden.dry[1] * math.tanh(v[1] / width[1]),
        )  # fmt: skip
        return accelerate(rig, q, v, u, extra)

    for k in range(n):
        ys[:, k] = (q[0], (1 + hidden.gain) * (shown[1] if hidden.slow else q[1]))
        ys[:, k] += sizes * rng.standard_normal(2)
        us[k] = (C @ z + D[:, :2] @ ys[:, k]).item() + dither[k]
        vs[:, k] = v
        u = us[k] - math.copysign(min(abs(us[k]), dead), us[k]) if dead else us[k]
        noise = push * rng.standard_normal()
        for _ in range(SUBSTEPS):
            if hidden.lag:
                moved += (1 - math.exp(-h / hidden.lag)) * (u - moved)
            now = moved if hidden.lag else u
            a1 = rate(q, v, now, noise)
            a2 = rate(q + h / 2 * v, v + h / 2 * a1, now, noise)
            a3 = rate(q + h / 2 * v + h * h / 4 * a1, v + h / 2 * a2, now, noise)
            a4 = rate(q + h * v + h * h / 2 * a2, v + h * a3, now, noise)
            q = q + h * v + h * h / 6 * (a1 + a2 + a3)
            v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
            if hidden.slow:
                shown = shown + (1 - math.exp(-h / hidden.slow)) * (q - shown)
        z = A @ z + B @ np.append(ys[:, k], us[k])
        if not abs(q[1]) < 1.0:
            raise ArithmeticError("the pendulum fell")
    return ys, us, vs


def build_plant(rig: Rig, values: dict[str, float]) -> Any:
    """Return the plant of a rig as ctrlid has it."""
    return getattr(cid.plants, rig.kind)(**values)


def draw(seed: int, number: int) -> dict[str, Any]:
    """Draw until a loop stays upright with what is hidden, and diagnose its record."""
    rng = np.random.default_rng([seed, number])
    while True:
        rig = draw_rig(rng)
        dt = 0.05 / rig.pace
        law = make_controller(rig, dt, rng)
        held = np.repeat(rng.choice([-1.0, 1.0], SAMPLES // 30 + 1), 30)[:SAMPLES]
        dither = held + np.sin(0.5 * rig.pace * dt * np.arange(SAMPLES))
        try:
            quiet = simulate(rig, law, dt, 1e-3 * dither, Hidden(), np.zeros(2), 0.0, rng)
            dither *= 1e-3 * rig.size / np.std(quiet[0][0]) * rng.uniform(0.3, 1)
            ys, us, vs = simulate(rig, law, dt, dither, Hidden(), np.zeros(2), 0.0, rng)
            force = float(np.std([rig.drive(u, 0.0) for u in us]))
            hidden = Hidden()
            if number % 2:
                hidden = choose_hidden(rig, rng, force, np.std(vs, axis=1), dt)
            sizes = np.std(ys, axis=1) * 10 ** rng.uniform(-3, -1.5, 2)
            push = force * rng.choice([0.0, 0.02])
            ys, us, vs = simulate(rig, law, dt, dither, hidden, sizes, push, rng)
        except ArithmeticError:
            continue
        break
    values = {k: v * (1 + rng.uniform(-0.05, 0.05) * (k in FREE[rig.kind]))
              for k, v in rig.parameters.items()}  # fmt: skip
    plant = build_plant(rig, values)
    controller = ct.ss(*law, dt, inputs=[*plant.output_labels, *plant.input_labels],
                       outputs=plant.input_labels)  # fmt: skip
    at = cid.operating_point(plant, output=[0.0, 0.0])
    known = controller if rng.random() < 0.5 else None
    loop = cid.Loop(plant, known, dt=dt, at=at, free=FREE[rig.kind])
    record = cid.Record(u=us, y=ys, dt=dt, names={"u": plant.input_labels[0],
                                                  "y": tuple(plant.output_labels)})  # fmt: skip
    start = time.process_time()
    found = cid.diagnose(loop, record, progress=False)
    names = [name for f in found.findings for name in f.names]
    worth = max((c.gain for c in found.ranking if math.isfinite(c.gain)), default=0.0)
    return {
        "number": number, "kind": rig.kind, "closed": loop.controller is not None,
        "hidden": hidden, "said": [list(f.names) for f in found.findings], "worth": worth,
        "hit": any(name in hidden.names for name in names), "verdict": found.verdict,
        "seconds": time.process_time() - start, "noise": str(found.noise),
    }  # fmt: skip


def print_share(
    words: str, rows: list[dict[str, Any]], test: Callable[[dict[str, Any]], bool]
) -> None:
    """Print the share of the rows that pass a test, with its interval."""
    hits = sum(test(row) for row in rows)
    low, high = wilson(hits, len(rows))
    print(f"{words}: {hits} of {len(rows)}, {100 * low:.1f} to {100 * high:.1f} %")


def main() -> None:
    """Draw the runs, and print shares."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    numbers = range(options.first, options.first + options.runs)
    made = joblib.Parallel(n_jobs=options.jobs, return_as="generator")(
        joblib.delayed(draw)(options.seed, number) for number in numbers
    )
    rows = []
    for row in made:
        rows.append(row)
        hidden = ", ".join(row["hidden"].names) or "nothing"
        said = "; ".join("|".join(names) for names in row["said"]) or "nothing"
        wrong = said != "nothing" if hidden == "nothing" else not row["hit"]
        print("!" if wrong else " ", f"{row['number']:4d} {row['kind']:15s} {hidden} -> {said} "
              f"({row['verdict']}, worth {row['worth']:.0f}, {row['seconds']:.0f} s)",
              flush=True)  # fmt: skip
    clean = [row for row in rows if not row["hidden"].names]
    others = [row for row in rows if row["hidden"].names]
    print_share("clean, something named", clean, lambda row: bool(row["said"]))
    large = [row for row in others if row["worth"] >= LARGE]
    print_share("named with its place, of large ones", large, lambda row: row["hit"])
    print_share("named with its place, of all", others, lambda row: row["hit"])
    print_share("blamed on another", others, lambda row: bool(row["said"]) and not row["hit"])


if __name__ == "__main__":
    main()
