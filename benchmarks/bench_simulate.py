"""Compare cid.simulate with python-control's input_output_response on one analog levitation loop.

Run it as ``python benchmarks/bench_simulate.py``; it takes a minute or two. Both simulate the same
45 000 samples: a lead at 100 rad/s on the nonlinear plant, a random binary reference held over each
period.

python-control interpolates its input linearly between samples. So the held reference is a block
that looks the sample up by time. The steps of the integrator do not coincide with the jumps of the
reference; `max_step` of one period prevents it from missing a jump. It is used in three ways:

- interconnected: plant, lead, bias and difference are joined by `ct.interconnect`;
- by hand: the same equations are written as one update function, without the interconnection;
- from jump to jump: the same equations, with one call for every stretch of constant reference, so
  that there is no jump within a call. This simulation needs to know where the reference jumps; it
  shows what can be achieved by hand.

Each way uses the largest rtol, in powers of ten, with an error below 1e-6. Errors are relative to
the standard deviation of the output. The exact solution is integrated period by period with SciPy's
DOP853 at rtol 1e-12, for a part of the record.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import control as ct
import numpy as np
from scipy.integrate import solve_ivp

import ctrlid as cid

DT, N, PIECE, HOLD = 0.001, 45_000, 4000, 20
SHOWN = 1e-6  # what both must reach


def loop() -> cid.Loop:
    """Build the levitation of the paper under its analog lead."""
    plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    op = cid.operating_point(plant, output=0.012)
    lead = cid.design_lead(cid.linearize(plant, op), crossover=100, phase_margin=50)
    return cid.Loop(plant, lead, dt=DT, at=op)


def closed(system: cid.Loop) -> Any:
    """Write the same loop as one python-control system from reference to gap."""
    lead, op = ct.ss(system.controller), system.at
    m, k, g = (system.plant.params[name] for name in ("m", "K", "g"))
    a, b, c, d = (float(v[0, 0]) for v in (lead.A, lead.B, lead.C, lead.D))
    bias = op.input

    def rates(t: float, z: Any, r: Any, params: Any) -> Any:
        e = r[0] - z[0]
        volts = bias + c * z[2] + d * e
        return np.array([z[1], g - k / m * (volts / z[0]) ** 2, a * z[2] + b * e])

    return ct.nlsys(rates, lambda t, z, r, params: z[0], inputs=["r"], outputs=["x"],
                    states=["x", "v", "c"], name="levitation")  # fmt: skip


def start(system: cid.Loop) -> list[float]:
    """Return plant and lead at rest."""
    return [*system.at.states, 0.0]


def exact(system: Any, r: Any, state: list[float]) -> Any:
    """Integrate period by period at a tolerance near round-off."""
    z, y = np.array(state), []
    for value in r:
        y.append(z[0])
        z = solve_ivp(
            lambda t, z, v=value: system.updfcn(t, z, [v], {}), (0, DT), z, method="DOP853",
            rtol=1e-12, atol=1e-16,
        ).y[:, -1]  # fmt: skip
    return np.array(y)


def by_jumps(system: Any, r: Any, state: list[float], rtol: float, method: str) -> Any:
    """Run input_output_response from jump to jump, where its input is constant."""
    y, z = np.empty(len(r)), np.array(state)
    for first in range(0, len(r), HOLD):
        part = r[first : first + HOLD]
        stamps = np.arange(len(part) + 1) * DT
        out = ct.input_output_response(
            system, stamps, np.full(len(stamps), part[0]), z,
            solve_ivp_kwargs={"method": method, "rtol": rtol, "atol": 1e-7 * rtol},
        )  # fmt: skip
        y[first : first + len(part)] = np.asarray(out.outputs).ravel()[: len(part)]
        z = np.asarray(out.states)[:, -1]
    return y


def held(r: Any) -> Callable[[float], float]:
    """Return the reference as a function of time; its last sample ends the run."""
    return lambda t: float(r[min(int(t / DT + 1e-9), len(r) - 1)])


def whole_run(whole: Any, n: int, state: list[float], rtol: float, method: str) -> Any:
    """Run input_output_response once over all samples."""
    out = ct.input_output_response(
        whole, np.arange(n) * DT, np.zeros(n), state,
        solve_ivp_kwargs={"method": method, "rtol": rtol, "atol": 1e-7 * rtol, "max_step": DT},
    )  # fmt: skip
    return np.asarray(out.outputs).ravel()


def by_hand(system: Any, r: Any, state: list[float], rtol: float, method: str) -> Any:
    """Run the equations written out, the reference held."""
    at = held(r)
    whole = ct.nlsys(
        lambda t, z, u, params: system.updfcn(t, z, [at(t)], params),
        lambda t, z, u, params: z[0], inputs=["none"], outputs=["x"], states=["x", "v", "c"],
    )  # fmt: skip
    return whole_run(whole, len(r), state, rtol, method)


def interconnected(system: cid.Loop, r: Any, state: list[float], rtol: float, method: str) -> Any:
    """Run the loop as joined by ct.interconnect, the reference held."""
    at, op = held(r), system.at
    parts = [
        system.plant,
        ct.ss(system.controller, inputs="e", outputs="v", name="lead"),
        ct.nlsys(None, lambda t, z, u, p: u[0] + op.input, inputs="v", outputs="V", name="bias"),
        ct.nlsys(None, lambda t, z, u, p: at(t), inputs="none", outputs="r", name="reference"),
        ct.summing_junction(["r", "-x"], "e", name="difference"),
    ]
    whole = ct.interconnect(parts, inputs="none", outputs="x", name="loop")
    return whole_run(whole, len(r), state, rtol, method)


def median(run: Callable[[], Any], turns: int) -> float:
    """Median time of some runs [s]."""
    times = []
    for _ in range(turns):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def main() -> None:
    """Print errors on the shorter piece, then times on the whole run."""
    ours = loop()
    theirs, state = closed(ours), start(ours)
    r = cid.random_binary(N, amplitude=1e-4, hold=HOLD, around=ours.at.output, seed=1)
    piece = r[:PIECE]
    y = exact(theirs, piece, state)

    def error(other: Any) -> float:
        return float(np.abs(other - y).max() / y.std())

    print(f"largest error over {PIECE} samples, relative to the standard deviation of the output")
    print(f"  {'ctrlid.simulate':<56}{error(cid.simulate(ours, piece).y):>10.1e}")
    runs: dict[str, tuple[Callable[..., Any], Any, float, str]] = {}
    for name, run, system, method in (
        ("interconnected, RK45", interconnected, ours, "RK45"),
        ("by hand, RK45", by_hand, theirs, "RK45"),
        ("from jump to jump, DOP853", by_jumps, theirs, "DOP853"),
    ):
        for rtol in (1e-3, 1e-6, 1e-7, 1e-8, 1e-9):
            reached = error(run(system, piece, state, rtol, method))
            print(f"  {f'python-control, {name}, rtol {rtol:g}':<56}{reached:>10.1e}", flush=True)
            if reached <= SHOWN:
                runs[name] = (run, system, rtol, method)
                break

    print(f"\ntime for {N} samples, first call with building its equations included")
    first = median(lambda: cid.simulate(loop(), r), 1)
    mine = median(lambda: cid.simulate(ours, r), 5)
    print(f"  {'ctrlid.simulate, first call':<56}{first:>8.2f} s")
    print(f"  {'ctrlid.simulate, median of 5':<56}{mine:>8.2f} s")
    for name, (run, system, rtol, method) in runs.items():
        begin = time.perf_counter()
        run(system, r, state, rtol, method)
        spent = time.perf_counter() - begin
        label = f"python-control, {name}, rtol {rtol:g}"
        print(f"  {label:<56}{spent:>8.2f} s{spent / mine:>8.0f} times ours", flush=True)


if __name__ == "__main__":
    main()
