"""Time and memory of diagnose() against the length of the record.

Run it as ``python benchmarks/bench_diagnose.py``. It diagnoses a levitation with the whole
catalogue, once with viscous friction missing and once with nothing missing, for 5 000 to 80 000
samples; ``--samples 1000000`` gives another length. Each run is a process of its own, so that the
peak memory is that of one record.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time

import ctrlid as cid
from ctrlid import effects

LENGTHS = (5_000, 20_000, 80_000)


def loop_of() -> cid.Loop:
    """Return a levitation 12 mm below its magnet, with a lead at 2 ms."""
    plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    op = cid.operating_point(plant, output=0.012)
    lead = cid.design_lead(cid.linearize(plant, op), crossover=100, phase_margin=50)
    return cid.Loop(plant, lead.sample(2e-3, "tustin"), dt=2e-3, at=op, free=("K",))


def one(samples: int, hidden: float) -> tuple[str, float, float, float]:
    """Diagnose a record; return verdict, seconds, and peak memory before and at the end [MB]."""
    loop = loop_of()
    real = loop.with_effect(effects.ViscousFriction(c=hidden)) if hidden else loop
    r = cid.random_binary(samples, amplitude=1e-4, hold=40, around=loop.point.output, seed=1)
    record = cid.simulate(real, r, sensor_noise=2e-6, seed=2)
    wrong = loop.with_parameters({"K": 1.05 * loop.parameters["K"]})
    cid.diagnose(wrong, record[:2000], catalogue=(effects.ViscousFriction,), progress=False)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    started = time.perf_counter()
    found = cid.diagnose(wrong, record, progress=False)
    seconds = time.perf_counter() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    names = ", ".join(f.name for f in found.findings)
    return f"{found.verdict} {names}".strip(), seconds, before, peak


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--samples", nargs="+", type=int, default=LENGTHS)
    options = parser.parse_args()
    print(f"{'samples':>9}  {'answer':<28}{'s':>7}{'us a sample':>13}{'MB before':>11}{'peak':>7}")
    context = multiprocessing.get_context("spawn")
    for hidden in (3.0, 0.0):
        for samples in options.samples:
            with context.Pool(1) as pool:
                answer, seconds, before, peak = pool.apply(one, (samples, hidden))
            print(f"{samples:>9}  {answer:<28}{seconds:>7.1f}{1e6 * seconds / samples:>13.0f}"
                  f"{before:>11.0f}{peak:>7.0f}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
