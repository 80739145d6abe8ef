"""Measure coverage, bias and efficiency of fits of a loop, on loops drawn at random.

Run it as ``python benchmarks/study_fit_loop.py --runs 300 --jobs 2``. ``--long`` draws records of
10 000 to 45 000 samples in place of 2 000 to 8 000, and ``--only maglev`` one kind of loop;
``--by fit_simulation`` measures that estimator in place of `fit_loop`.

Each run draws a levitation (gap 5-20 mm, voltage 1-10 V, unstable pole times period 0.5 to 0.005,
digital or known analog lead) or a drive with an integrator, a reference, sensor noise of 1-20 % of
the reference, no force noise or a white or coloured one, and which parameters are free. The initial
values of these are up to 10 % off. For each parameter and for groups of runs it prints

- covered: the share of nominal 95 % intervals that contain the true value, with its own 95 %
  interval;
- bias: the mean of error / standard error; size: the root mean square of the same, which should
  be 1;
- efficiency: the mean square of the error divided by the Cramér-Rao bound, which is computed from
  the exact information at the true parameters with the noise fitted there. It is 1 for an
  efficient estimator;
- error: the median of the absolute error in percent.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass
from typing import Any

import joblib
import numpy as np
from _random_loops import Noise, log_uniform
from _shares import print_farthest
from scipy.stats import beta
from study_iv import design, information_bound, plant

import ctrlid as cid
from ctrlid.loop.simulation import Simulator

Z95 = 1.959964
FREE = {
    "maglev": (("K",), ("m",), ("K", "g")),
    "servo": (("k", "c"), ("k", "c"), ("m", "c")),
}


@dataclass(frozen=True, eq=False)
class Draw:
    """A real loop, how far from it one believes to be, and a record of it."""

    kind: str
    loop: cid.Loop
    believed: cid.Loop
    record: cid.Record
    tags: dict[str, Any]


def maglev(rng: np.random.Generator) -> tuple[cid.Loop, float, int, float, float]:
    """Draw a levitation: loop, step of the reference, hold, sensor noise, p*Ts."""
    gap, volts = rng.uniform(5e-3, 20e-3), rng.uniform(1.0, 10.0)
    mass = log_uniform(rng, 0.01, 0.1)
    law = cid.plants.maglev(m=mass, K=mass * 9.81 * gap**2 / volts**2)
    op = cid.operating_point(law, output=gap)
    p, step = math.sqrt(2 * 9.81 / gap), log_uniform(rng, 0.005, 0.5)
    dt = step / p
    if rng.uniform() < 0.5:
        controller = cid.design_lead(
            cid.linearize(law, op), p * rng.uniform(2, 3), rng.uniform(40, 55)
        )
    else:
        controller = design(rng, *plant(p**2, 2 * 9.81 / volts, dt), p, dt)
    amplitude = gap * rng.uniform(0.005, 0.02)
    hold = int(log_uniform(rng, 3, max(8.0, 2 / step)))
    loop = cid.Loop(law, controller, dt=dt, at=op)
    return loop, amplitude, hold, amplitude * log_uniform(rng, 0.01, 0.2), step


def servo(rng: np.random.Generator) -> tuple[cid.Loop, float, int, float, float]:
    """Draw a drive with a pole at the origin, under a sampled lead or a PID."""
    mass, pole = log_uniform(rng, 0.5, 100), log_uniform(rng, 1, 10)
    crossover = pole * rng.uniform(2, 6)
    gain = crossover**2 * mass / rng.uniform(2, 10)
    law = cid.plants.servo(m=mass, c=mass * pole, k=gain)
    op = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
    step = log_uniform(rng, 0.005, 0.1)
    dt = step / pole
    size = crossover * math.hypot(crossover, pole) * mass / gain
    if rng.uniform() < 0.5:
        controller: Any = cid.PID(kp=0.7 * size, ki=0.05 * size * crossover,
                                  kd=0.5 * size / crossover, filter_time=dt)  # fmt: skip
    else:
        controller = cid.design_lead(cid.linearize(law, op), crossover, rng.uniform(45, 55))
        controller = controller.sample(dt, "tustin")
    amplitude = log_uniform(rng, 1e-3, 0.1)
    hold = int(log_uniform(rng, 3, max(8.0, 2 / step)))
    loop = cid.Loop(law, controller, dt=dt, at=op)
    return loop, amplitude, hold, amplitude * log_uniform(rng, 0.01, 0.2), step


KINDS = {"maglev": maglev, "servo": servo}


def draw(seed: int, run: int, only: str | None, long: bool) -> Draw:
    """Draw until a loop survives its own reference and noise."""
    rng = np.random.default_rng([seed, run])
    while True:
        kind = only or ("servo" if rng.uniform() < 0.3 else "maglev")
        loop, amplitude, hold, hiss, step = KINDS[kind](rng)
        n = int(log_uniform(rng, *((10_000, 45_000) if long else (2_000, 8_000))))
        force = ("none", "white", "coloured")[rng.integers(3)]
        # A force that moves the mass within the loop's own time by a share of the reference.
        speed = 2 * step / loop.dt
        push = amplitude * speed**2 * log_uniform(rng, 0.003, 0.1)
        noise = Noise(
            hiss, push if force != "none" else 0.0, push if force == "coloured" else 0.0,
            log_uniform(rng, 3, 3 / step) if force == "coloured" else 1.0,
        )  # fmt: skip
        free = FREE[kind][rng.integers(3)]
        wrong = {k: loop.parameters[k] * (1 + rng.uniform(-0.1, 0.1)) for k in free}
        r = cid.random_binary(
            n, amplitude=amplitude, hold=hold, around=loop.at.output, seed=int(rng.integers(1e9))
        )
        try:
            simulator = Simulator(loop)
            y, u = simulator.run(simulator.start(None), r, np.zeros(n), noise.draw(rng, n))
        except cid.CtrlidError:
            continue
        record = cid.Record(r=r, u=u, y=y, dt=loop.dt, hold="foh" if loop.analog else "zoh")
        loop = cid.Loop(loop.plant, loop.controller, dt=loop.dt, at=loop.at, free=free)
        tags = {
            "controller": "analog" if loop.analog else "digital", "force": force,
            "p*Ts": "over 0.1" if step > 0.1 else "0.02 to 0.1" if step > 0.02 else "under 0.02",
            "noise": "over 5 %" if hiss > 0.05 * amplitude else "under 5 %",
        }  # fmt: skip
        return Draw(kind, loop, loop.with_parameters(wrong), record, tags)


def run(
    seed: int, number: int, only: str | None, long: bool, estimator: str
) -> list[dict[str, Any]]:
    """One draw: a row for each parameter."""
    one = draw(seed, number, only, long)
    started = time.perf_counter()
    try:
        estimate = getattr(cid, estimator)(one.believed, one.record).estimate
    except cid.CtrlidError as reason:
        return [{"run": number, "failed": str(reason), **one.tags}]
    spent = time.perf_counter() - started
    rows = []
    for name, bound, value, error in zip(
        estimate.names,
        information_bound(one.loop, one.record),
        estimate.values,
        estimate.standard_errors,
        strict=True,
    ):
        truth = one.loop.parameters[name]
        rows.append({
            "run": number, "parameter": f"{one.kind} {name}", "z": (value - truth) / error,
            "relative": (value - truth) / truth, "excess": (value - truth) / bound,
            "seconds": spent, "samples": len(one.record),
            "colour": getattr(estimate, "coloured_force", 0) > 0,
            **one.tags,
        })  # fmt: skip
    return rows


def line(label: str, rows: list[dict[str, Any]]) -> str:
    """One line of the table."""
    z = np.array([row["z"] for row in rows])
    hit, n = int(np.sum(np.abs(z) < Z95)), len(z)
    low, high = beta.ppf(0.025, hit, n - hit + 1), beta.ppf(0.975, hit + 1, max(n - hit, 1e-9))
    excess = np.array([row["excess"] for row in rows])
    error = 100 * np.median(np.abs([row["relative"] for row in rows]))
    return (
        f"{label:<26}{n:>5}{100 * hit / n:>8.1f} ({100 * np.nan_to_num(low):.0f}-{100 * high:.0f})"
        f"{z.mean():>9.2f}{np.sqrt(np.mean(z**2)):>7.2f}{np.mean(excess**2):>8.2f}{error:>10.3g}"
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--only", choices=list(KINDS), help="one kind of loop")
    parser.add_argument("--by", choices=["fit_loop", "fit_simulation"], default="fit_loop")
    parser.add_argument("--long", action="store_true", help="10 000 to 45 000 samples")
    options = parser.parse_args()
    work = joblib.Parallel(n_jobs=options.jobs)
    found = work(
        joblib.delayed(run)(options.seed, k, options.only, options.long, options.by)
        for k in range(options.runs)
    )
    rows = [row for part in found for row in part]
    failed = [row for row in rows if "failed" in row]
    rows = [row for row in rows if "failed" not in row]
    print(f"{'':<26}{'n':>5}  covered %        bias   size    eff.   error %")
    print(line("all", rows))
    for key in ("parameter", "controller", "force", "p*Ts", "noise", "colour"):
        for value in sorted({row[key] for row in rows}, key=str):
            print(line(f"{key} {value}".replace("parameter ", ""),
                       [row for row in rows if row[key] == value]))  # fmt: skip
    print_farthest(rows, failed)


if __name__ == "__main__":
    main()
