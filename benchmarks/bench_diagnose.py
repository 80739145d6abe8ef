"""What diagnose() costs: processor and wall time, passes of the filter by purpose, peak memory.

Run it as ``python benchmarks/bench_diagnose.py``; ``--samples 5000`` gives another length than
20 000, ``--cases one two`` only some of the cases, ``--jobs 2`` two processes (whose passes are not
counted). Each case is a process of its own, so that the peak memory is that of one diagnosis, and
the compiled loops are warm before the clock starts.

Times of a shared machine say little. So each case is timed beside a yardstick, a fixed piece of
numpy and Python that no change of ctrlid makes faster, run before and after it in the same
process: what can be compared from day to day is the number of yardsticks of processor time, and
the number of passes.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

import ctrlid as cid
from ctrlid import effects as E
from ctrlid.estimation.likelihood import kalman_filter

DT, CART_DT = 2e-3, 0.01
# What a pass is for is told by the outermost of these functions that asked for it.
PURPOSES = {
    "recalibrate": "recalibrate", "scan_candidate": "screen", "refit_candidate": "refit",
    "refit_quietly": "refit quietly", "refit_under_noise": "refit",
    "prefer_sensor_noise": "noise", "find_better_choice": "look back",
    "_check_on_replicas": "replicas", "retest_with_replicas": "replicas",
    "refit_noise": "weigh", "drop_superfluous": "weigh", "order_effect": "weigh",
    "weigh_effects": "weigh", "find_log_error": "log errors", "seems_idle": "log errors",
    "compare_names": "names",
    "summarize_gap": "gap",
}  # fmt: skip
COLUMNS = tuple(dict.fromkeys(PURPOSES.values()))


def make_loop(*known: Any, analog: bool = False) -> cid.Loop:
    """Return a levitation 12 mm below its magnet, with a lead; `known` effects are in the model."""
    plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    at = cid.operating_point(plant, output=0.012)
    lead = cid.design_lead(cid.linearize(plant, at), crossover=100, phase_margin=50)
    law = lead if analog else lead.sample(DT, "tustin")
    loop = cid.Loop(plant, law, dt=DT, at=at, free=("K",))
    for effect in known:
        loop = loop.with_effect(effect)
    return loop


def make_records(
    hidden: Sequence[Any], known: Sequence[Any], count: int, samples: int, analog: bool = False
) -> Any:
    """Return records of a loop in which effects are hidden."""
    real = make_loop(*known, *hidden, analog=analog)
    made = []
    for seed in range(1, count + 1):
        r = cid.random_binary(samples // count, amplitude=1e-4, hold=40, around=0.012, seed=seed)
        made.append(cid.simulate(real, r, sensor_noise=2e-6, seed=100 + seed))
    return made


def make_cart_loop(outputs: int, law: Any = None) -> cid.Loop:
    """Return a cart with a pole, seen by its position alone or by the angle as well."""
    plant = cid.plants.cart_pole(M=0.5, m=0.2, length=0.3, J=0.006, c=0.1, gamma=0.002)
    if outputs == 1:
        # The equations are those of the plant, the output is the first of its own.
        plant = ct.nlsys(plant.updfcn, lambda t, x, u, p: x[0], inputs=plant.input_labels,
                         outputs=["x"], states=plant.state_labels, params=plant.params,
                         name="cart")  # fmt: skip
    at = cid.operating_point(plant, output=0.0 if outputs == 1 else [0.0, 0.0])
    return cid.Loop(plant, law, dt=CART_DT, at=at, free=("m", "c"))


def make_cart_record(hidden: Sequence[Any], samples: int) -> cid.Record:
    """Return a record of the cart under LQR with an observer, with a dither at the input."""
    loop = make_cart_loop(2)
    plant, linear = loop.plant, loop.linearize(states=True)
    d = ct.c2d(ct.ss(linear.A, linear.B, np.eye(4), 0), CART_DT)
    gain = ct.dlqr(d.A, d.B, np.diag([10.0, 30, 1, 1]), 0.5 * np.eye(1))[0]
    slow = ct.dlqe(d.A, np.eye(4), np.eye(2, 4), 1e-4 * np.eye(4), 1e-5 * np.eye(2))[0]
    law = ct.ss(d.A - slow @ np.eye(2, 4), np.hstack([slow, d.B]), -gain, np.zeros((1, 3)),
                CART_DT, inputs=[*plant.output_labels, *plant.input_labels],
                outputs=plant.input_labels)  # fmt: skip
    real = make_cart_loop(2, law)
    for effect in hidden:
        real = real.with_effect(effect)
    bits = np.random.default_rng(0).choice([-0.8, 0.8], samples // 30 + 1)
    return cid.simulate(real, d=np.repeat(bits, 30)[:samples], sensor_noise=[2e-4, 5e-4], seed=3)


DRAG, OFFSET = E.ViscousFriction(c=0.3), E.InputOffset(offset=0.02)
LAG, DRY = E.ActuatorLag(tau=0.004), E.CoulombFriction(fc=0.004)
# For each case what is hidden, what the model knows, the records, and what the catalogue lacks.
CASES: dict[str, tuple[tuple[Any, ...], tuple[Any, ...], int, tuple[type, ...]]] = {
    "nothing": ((), (), 1, ()),
    "one": ((DRAG,), (), 1, ()),
    "two": ((DRAG, OFFSET), (), 1, ()),
    "three": ((DRAG, OFFSET, LAG), (), 1, ()),
    "unknown": ((LAG,), (), 1, (E.ActuatorLag, E.InputDelay, E.SensorLag)),
    "friction": ((OFFSET,), (DRY,), 1, ()),
    "records": ((DRAG,), (), 3, ()),
    "analog": ((LAG, DRY), (), 1, ()),
}
ANALOG = {"analog"}  # the lead is a circuit
# Dry friction at a cart with a pole: how many outputs are seen.
CARTS = {"one output": 1, "two outputs": 2}


def measure_yardstick() -> float:
    """Return the processor time of a fixed piece of numpy and Python [s]."""
    rng = np.random.default_rng(1)
    matrix, begun = rng.standard_normal((120, 120)), time.process_time()
    for _ in range(20):
        np.linalg.svd(matrix)
    total = 0.0
    for k in range(300_000):
        total += 1.0 / (k + 1)
    return time.process_time() - begun


def count_passes(passes: Counter[str]) -> None:
    """Count every pass of the filter by its purpose from now on."""
    plain = kalman_filter.run_filter

    def run_filter(*arguments: Any, **options: Any) -> Any:
        # Only noise is looked for in threads, whatever for.
        main = threading.current_thread() is threading.main_thread()
        purpose = "other" if main else "noise"
        frame = sys._getframe(1) if main else None
        while frame is not None:
            purpose = PURPOSES.get(frame.f_code.co_name, purpose)
            frame = frame.f_back
        passes[purpose] += 1
        return plain(*arguments, **options)

    for module in list(sys.modules.values()):
        if getattr(module, "run_filter", None) is plain:
            module.run_filter = run_filter  # type: ignore[attr-defined]


def make_question(case: str, samples: int) -> tuple[cid.Loop, list[cid.Record], list[type]]:
    """Return what is diagnosed in a case: a loop, records and the effects to look for."""
    if case in CARTS:
        loop = make_cart_loop(CARTS[case]).with_parameters({"m": 0.21})
        record = make_cart_record([E.CoulombFriction(fc=0.15, at="x_dot")], samples)
        if CARTS[case] == 1:
            record = cid.Record(u=record.u, y=np.asarray(record.y)[0], dt=CART_DT)
        return loop, [record], list(E.CATALOGUE)
    hidden, known, count, lacking = CASES[case]
    analog = case in ANALOG
    records = make_records(hidden, known, count, samples, analog)
    loop = make_loop(*known, analog=analog).with_parameters({"K": 1.05 * 3.34e-6})
    return loop, records, [kind for kind in E.CATALOGUE if kind not in lacking]


def measure_case(case: str, samples: int, jobs: int | None) -> dict[str, Any]:
    """Diagnose the records of a case, and return what it cost."""
    loop, records, catalogue = make_question(case, samples)
    cid.diagnose(loop, [r[:1500] for r in records], catalogue=(E.InputOffset,), progress=False)
    passes = Counter[str]()
    count_passes(passes)
    before = measure_yardstick()
    cpu, wall = time.process_time(), time.perf_counter()
    found = cid.diagnose(loop, records, catalogue=catalogue, jobs=jobs, progress=False)
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    yardstick = 0.5 * (before + measure_yardstick())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    names = ", ".join(f.name for f in found.findings)
    answer = f"{found.verdict}{': ' if names else ''}{names}"
    return {"cpu": cpu, "wall": wall, "yardsticks": cpu / yardstick, "peak": peak,
            "passes": passes, "answer": answer}  # fmt: skip


def main() -> None:
    """Print a row for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=20_000)
    parser.add_argument("--cases", nargs="+", choices=[*CASES, *CARTS], default=[*CASES, *CARTS])
    parser.add_argument("--jobs", type=int, default=None)
    args = parser.parse_args()
    print(f"{args.samples} samples; a yardstick is {measure_yardstick():.3f} s of CPU now")
    print(f"{'case':<12}{'CPU s':>8}{'wall s':>8}{'yards':>7}{'MB':>6}{'passes':>8}  "
          + "".join(f"{c:>14}" for c in (*COLUMNS, "other")))  # fmt: skip
    context = multiprocessing.get_context("spawn")
    for case in args.cases:
        with context.Pool(1) as pool:
            done = pool.apply(measure_case, (case, args.samples, args.jobs))
            # Left to itself, the process ends without tidying up after joblib.
            pool.close()
            pool.join()
        passes = done["passes"]
        row = f"{case:<12}{done['cpu']:>8.1f}{done['wall']:>8.1f}{done['yardsticks']:>7.0f}"
        row += f"{done['peak']:>6.0f}{sum(passes.values()):>8}  "
        print(row + "".join(f"{passes[c]:>14}" for c in (*COLUMNS, "other")), flush=True)
        print(f"{'':<12}{done['answer']}", flush=True)


if __name__ == "__main__":
    main()
