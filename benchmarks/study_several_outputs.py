"""Measure the coverage of fit_loop on plants of several outputs, drawn at random.

Run it as ``python benchmarks/study_several_outputs.py --runs 400 --jobs 2``. ``--only cart_pole``
draws one kind of plant.

Each run draws a cart with a pole, a rotary pendulum, a ball on a beam, a planar quadrotor or a
drive of two masses, each with parameters of its own, and puts it under `control.dlqr` with an
observer that reads the outputs and the input. The first reference jumps, and a dither is added to
each input. The sensor noise of each output is 1-20 % of what that output moves without noise;
random forces are absent, or move the outputs by 1-20 % of that too. The initial values of the free
parameters are up to 10 % off. For each kind of plant, parameter and noise it prints

- covered: the share of nominal 95 % intervals that contain the true value, with its 95 % and
  99 % intervals by Wilson;
- bias: the mean of error / standard error; size: the root mean square of the same, which should
  be 1;
- error: the median of the absolute error in percent.

The row "one of each run" takes one parameter of each run by lot: its entries are independent.
"""

from __future__ import annotations

import argparse
import math
import time
from typing import Any

import control as ct
import joblib
import numpy as np
from _random_loops import log_uniform
from _shares import print_farthest, wilson
from scipy.stats import norm

import ctrlid as cid

Z95 = float(norm.ppf(0.975))
FREE = {
    "cart_pole": (("m", "length"), ("M", "length"), ("m", "length", "c")),
    "rotary_pendulum": (("m", "arm_inertia"), ("length", "kt"), ("length", "c")),
    "ball_on_beam": (("J",), ("J", "c"), ("m", "J")),
    "quadrotor_planar": (("m", "J"), ("J",), ("m", "J", "c")),
    "two_masses": (("J1", "k"), ("J1", "J2", "k"), ("k", "d")),
}


def cart_pole(rng: np.random.Generator) -> tuple[Any, float, float]:
    """Draw a cart with a pole: the plant, its fastest rate [rad/s], and a step of x [m]."""
    M, length = log_uniform(rng, 0.2, 2), log_uniform(rng, 0.1, 1)
    m = M * rng.uniform(0.2, 0.8)
    plant = cid.plants.cart_pole(
        M=M, m=m, length=length, J=m * length**2 / 3, c=M * rng.uniform(0.1, 2),
        gamma=0.02 * m * length**2,
    )  # fmt: skip
    return plant, math.sqrt(9.81 / length), length * rng.uniform(0.1, 0.4)


def rotary_pendulum(rng: np.random.Generator) -> tuple[Any, float, float]:
    """Draw a rotary pendulum, and a step of theta [rad]."""
    m, length = log_uniform(rng, 0.02, 0.2), log_uniform(rng, 0.06, 0.3)
    arm = length * rng.uniform(0.8, 1.6)
    kt = log_uniform(rng, 0.03, 0.3)
    inertia = m * arm**2 * rng.uniform(0.2, 1)
    # The back-EMF brakes the arm at so many times the rate of the pendulum.
    R = kt**2 / ((inertia + m * arm**2) * math.sqrt(9.81 / length) * rng.uniform(0.1, 1))
    plant = cid.plants.rotary_pendulum(
        m=m, length=length, arm=arm, arm_inertia=inertia, J=m * length**2 / 3, kt=kt, R=R,
        c=0.2 * inertia,
    )  # fmt: skip
    return plant, math.sqrt(9.81 / length), rng.uniform(0.1, 0.4)


def ball_on_beam(rng: np.random.Generator) -> tuple[Any, float, float]:
    """Draw a ball on a beam, and a step of r [m]."""
    m, reach = log_uniform(rng, 0.03, 0.3), log_uniform(rng, 0.2, 1)
    J = m * reach**2 * rng.uniform(0.5, 3)
    plant = cid.plants.ball_on_beam(m=m, J=J, radius=0.02 * reach, c=J * rng.uniform(0.2, 2))
    return plant, (m * 9.81**2 / J) ** 0.25, reach * rng.uniform(0.1, 0.3)


def quadrotor_planar(rng: np.random.Generator) -> tuple[Any, float, float]:
    """Draw a planar quadrotor, and a step of x [m]."""
    m, arm = log_uniform(rng, 0.1, 2), log_uniform(rng, 0.08, 0.3)
    plant = cid.plants.quadrotor_planar(
        m=m, J=m * arm**2 * rng.uniform(0.2, 0.6), arm=arm, c=m * rng.uniform(0.05, 0.5)
    )
    return plant, math.sqrt(9.81 / arm) / 3, arm * rng.uniform(1, 3)


def two_masses(rng: np.random.Generator) -> tuple[Any, float, float]:
    """Draw a drive of two masses on a soft shaft, and a step of the motor's angle [rad]."""
    J1 = log_uniform(rng, 1e-3, 1e-1)
    J2, pace = J1 * rng.uniform(0.3, 3), log_uniform(rng, 5, 30)
    k = pace**2 * J1 * J2 / (J1 + J2)

    def rates(t: float, x: Any, u: Any, params: Any) -> Any:
        twist = params["k"] * (x[0] - x[1]) + params["d"] * (x[2] - x[3])
        return np.array([x[2], x[3], (u[0] - twist) / params["J1"], twist / params["J2"]])

    plant = ct.nlsys(
        rates, lambda t, x, u, params: np.array([x[0], x[1]]), name="two_masses", inputs=["tau"],
        outputs=["phi1", "phi2"], states=["phi1", "phi2", "omega1", "omega2"],
        params={"J1": J1, "J2": J2, "k": k, "d": 0.1 * k / pace},
    )  # fmt: skip
    return plant, pace, rng.uniform(0.1, 0.5)


KINDS = {each.__name__: each for each in
         (cart_pole, rotary_pendulum, ball_on_beam, quadrotor_planar, two_masses)}  # fmt: skip


def design(plant: Any, at: Any, dt: float, pace: float, rng: np.random.Generator) -> Any:
    """Return ``u = ud - K (z - xd)`` with z from an observer, as one linear system."""
    P = cid.linearize(plant, at)
    G = ct.sample_system(P, dt)
    n, m, p = P.nstates, P.ninputs, P.noutputs
    # A deviation of an output counts as much as one of its rate in the time of the plant. The input
    # counts so that the loop is about as fast as the plant.
    weights = np.diag([1.0] * p + [pace**-2] * p)
    reach = np.linalg.norm(P.B, axis=0) / pace**2
    gain = ct.dlqr(G, weights, rng.uniform(0.3, 3) * np.diag(reach**2))[0]
    scaled = G.B / reach
    forces = scaled @ scaled.T
    slow = G.A @ ct.dlqe(G.A, np.eye(n), G.C, forces + 1e-9 * np.eye(n), 1e-3 * np.eye(p))[0]
    names = [*P.output_labels, *P.input_labels]
    names += [f"xd[{k}]" for k in range(n)] + [f"ud[{k}]" for k in range(m)]
    read = np.hstack([slow, G.B, np.zeros((n, n)), -G.B])
    direct = np.hstack([np.zeros((m, p + m)), gain, np.eye(m)])
    return ct.ss(G.A - slow @ G.C, read, -gain, direct, dt, inputs=names, outputs=P.input_labels)


def draw(seed: int, number: int, only: str | None) -> dict[str, Any]:
    """Draw until a loop survives its own references and noise."""
    rng = np.random.default_rng([seed, number])
    while True:
        kind = only or list(KINDS)[rng.integers(len(KINDS))]
        plant, pace, step = KINDS[kind](rng)
        dt = log_uniform(rng, 0.01, 0.2) / pace
        at = cid.operating_point(plant, output=[0.0] * plant.noutputs)
        n = int(log_uniform(rng, 800, 3000))
        free = FREE[kind][rng.integers(len(FREE[kind]))]
        loop = cid.Loop(plant, design(plant, at, dt, pace, rng), dt=dt, at=at, free=free)
        hold = max(2, int(rng.uniform(2, 6) / (pace * dt)))
        r = step * cid.random_binary(n, amplitude=1, hold=hold, seed=int(rng.integers(1e9)))
        seeds = rng.integers(1e9, size=2 * plant.ninputs + 1).tolist()
        law = loop.controller
        # The first columns that xd[0] and dither reach tell how large the dither is to be.
        size = step * np.abs(law.D[:, law.input_labels.index("xd[0]")]) * rng.uniform(0.2, 1)
        fast = max(2, int(rng.uniform(0.2, 1) / (pace * dt)))
        d = np.array([a * cid.random_binary(n, amplitude=1, hold=fast, seed=s)
                      for a, s in zip(size, seeds[1:], strict=False)])  # fmt: skip
        share, push = log_uniform(rng, 0.01, 0.2), log_uniform(rng, 0.01, 0.2)
        forced = bool(rng.integers(2))
        try:
            still = cid.simulate(loop, {"xd[0]": r}, d=d)
            moved = np.std(still.y, axis=1)
            force = 0.0
            if forced:
                # What forces of size one do tells how large they may be.
                units = size.max() * np.ones(max(len(plant.output_labels), 1))
                swing = np.std(cid.simulate(loop, {"xd[0]": 0 * r}, force_noise=1e-3 * units,
                                            seed=seeds[0]).y, axis=1)  # fmt: skip
                force = 1e-3 * units * push * float(np.min(moved / swing))
            record = cid.simulate(loop, {"xd[0]": r}, d=d, sensor_noise=share * moved,
                                  force_noise=force, seed=seeds[0])  # fmt: skip
        except cid.CtrlidError:
            continue
        # A ball that flies off its beam, or a pole that falls over and is caught, is another rig.
        if max(np.abs(one.y[0]).max() for one in (still, record)) > 10 * step:
            continue
        wrong = {k: loop.parameters[k] * (1 + rng.uniform(-0.1, 0.1)) for k in free}
        tags = {"kind": kind, "force": "white" if forced else "none",
                "noise": "over 5 %" if share > 0.05 else "under 5 %"}  # fmt: skip
        return {"loop": loop, "believed": loop.with_parameters(wrong), "record": record,
                "tags": tags, "lot": float(rng.uniform())}  # fmt: skip


def run(seed: int, number: int, only: str | None) -> list[dict[str, Any]]:
    """One draw: a row for each parameter."""
    one = draw(seed, number, only)
    started = time.perf_counter()
    try:
        estimate = cid.fit_loop(one["believed"], one["record"]).estimate
    except cid.CtrlidError as reason:
        return [{"run": number, "failed": str(reason), **one["tags"]}]
    spent = time.perf_counter() - started
    chosen = int(one["lot"] * len(estimate.names))
    rows = []
    for k, (name, value, error) in enumerate(
        zip(estimate.names, estimate.values, estimate.standard_errors, strict=True)
    ):
        truth = one["loop"].parameters[name]
        rows.append({
            "run": number, "parameter": f"{one['tags']['kind']} {name}",
            "z": (value - truth) / error, "relative": (value - truth) / truth, "seconds": spent,
            "samples": len(one["record"]), "chosen": k == chosen, **one["tags"],
        })  # fmt: skip
    return rows


def line(label: str, rows: list[dict[str, Any]]) -> str:
    """One line of the table."""
    z = np.array([row["z"] for row in rows])
    hit, n = int(np.sum(np.abs(z) < Z95)), len(z)
    low, high = wilson(hit, n, 0.95)
    lower, upper = wilson(hit, n, 0.99)
    error = 100 * np.median(np.abs([row["relative"] for row in rows]))
    return (
        f"{label:<30}{n:>5}{100 * hit / n:>8.1f} ({100 * low:.1f}-{100 * high:.1f}; "
        f"{100 * lower:.1f}-{100 * upper:.1f}){z.mean():>9.2f}{np.sqrt(np.mean(z**2)):>7.2f}"
        f"{error:>9.3g}"
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=400)
    parser.add_argument("--first", type=int, default=0, help="number of the first run")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only", choices=list(KINDS), help="one kind of plant")
    options = parser.parse_args()
    work = joblib.Parallel(n_jobs=options.jobs)
    found = work(
        joblib.delayed(run)(options.seed, k, options.only)
        for k in range(options.first, options.first + options.runs)
    )
    rows = [row for part in found for row in part]
    failed = [row for row in rows if "failed" in row]
    rows = [row for row in rows if "failed" not in row]
    print(f"{'':<30}{'n':>5} covered % (95 %; 99 %)            bias   size  error %")
    print(line("all", rows))
    print(line("one of each run", [row for row in rows if row["chosen"]]))
    for key in ("kind", "parameter", "force", "noise"):
        for value in sorted({row[key] for row in rows}):
            label = value if key in ("kind", "parameter") else f"{key} {value}"
            print(line(label, [row for row in rows if row[key] == value]))
    print_farthest(rows, failed)


if __name__ == "__main__":
    main()
