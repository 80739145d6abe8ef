"""fit_arx against one numpy.linalg.lstsq of the same regression, matrix building included.

Run it as ``python benchmarks/bench_fit_arx.py``. The two are timed in turns, so that other work of
the machine slows both alike. The result is the ratio of the medians.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

import ctrlid as cid

DT = 1e-3


def record(n: int) -> cid.Record:
    """Simulate a stable second-order plant: speed is all that matters here."""
    rng = np.random.default_rng(0)
    u = rng.standard_normal(n)
    y = lfilter([0.0, 0.1, 0.08], [1.0, -1.9, 0.92], u)
    y += lfilter([1.0], [1.0, -1.9, 0.92], 0.01 * rng.standard_normal(n))
    return cid.Record(u=u + 3.0, y=y + 0.012, dt=DT)


def lstsq(data: cid.Record) -> None:
    """Solve the whole regression at once."""
    y, u = data.y, data.u
    columns = [-y[1:-1], -y[:-2], u[1:-1], u[:-2], np.ones(len(y) - 2)]
    np.linalg.lstsq(np.column_stack(columns), y[2:], rcond=None)


def peak(run: Callable[[], object]) -> float:
    """Largest memory taken above the data, in MB."""
    tracemalloc.start()
    run()
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most / 1e6


def main() -> None:
    """Print the table."""
    known = [cid.ReciprocalPoles(), cid.Equal("b1", "b2")]
    holding = [cid.Fixed("a2", 0.92), cid.Bounds("a1", lower=-1.89)]
    head = f"{'samples':>9}  {'solver':<28}{'median':>9}{'best':>9}{'ratio':>7}{'memory':>9}"
    print(head)
    for n, turns in ((45_000, 40), (1_000_000, 9)):
        data = record(n)
        runs: dict[str, Callable[[], object]] = {
            "numpy.linalg.lstsq": lambda data=data: lstsq(data),
            "fit_arx": lambda data=data: cid.fit_arx(data, 2, 2),
            "fit_arx, reciprocal, b1 = b2": lambda data=data: cid.fit_arx(
                data, 2, 2, constraints=known
            ),
            "fit_arx, bound held": lambda data=data: cid.fit_arx(data, 2, 2, constraints=holding),
        }
        times: dict[str, list[float]] = {name: [] for name in runs}
        for _ in range(turns):
            for name, run in runs.items():
                start = time.perf_counter()
                run()
                times[name].append(time.perf_counter() - start)
        reference = float(np.median(times["numpy.linalg.lstsq"]))
        for name, run in runs.items():
            median, best = float(np.median(times[name])), min(times[name])
            print(
                f"{n:>9}  {name:<28}{median * 1e3:>6.1f} ms{best * 1e3:>6.1f} ms"
                f"{median / reference:>7.2f}{peak(run):>6.1f} MB"
            )


if __name__ == "__main__":
    main()
