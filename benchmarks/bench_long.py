"""A log longer than the memory: fit_arx on a memory-mapped file, block by block.

Run it as ``python benchmarks/bench_long.py --samples 100000000``. It writes the log (two columns of
doubles, 1.6 GB for 1e8 samples) to a temporary file, and fits it from a generator of Records. It
prints the time, the coefficients and the peak of the memory that Python allocated during the fit.
With ``--jobs 2`` the blocks are distributed over processes.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

import ctrlid as cid

A, B = np.array([1.0, -1.9, 0.92]), np.array([0.0, 0.1, 0.08])
BLOCK = 500_000  # samples of a Record


def write(path: Path, n: int) -> None:
    """Write n samples of input and output of a stable plant with white equation error."""
    rng, log = np.random.default_rng(0), np.memmap(path, dtype=float, mode="w+", shape=(n, 2))
    memory, errors = np.zeros(2), np.zeros(2)
    for start in range(0, n, BLOCK):
        size = min(BLOCK, n - start)
        u = rng.standard_normal(size)
        y, memory = lfilter(B, A, u, zi=memory)
        e, errors = lfilter([1.0], A, 0.1 * rng.standard_normal(size), zi=errors)
        log[start : start + size, 0], log[start : start + size, 1] = u, y + e
    log.flush()


def blocks(path: Path, n: int) -> Iterator[cid.Record]:
    """Cut the log into Records that overlap by two samples, so that no row is lost at the seams.

    Each block maps its own part of the file: what a process has read does not stay mapped.
    """
    for start in range(0, n - 2, BLOCK):
        size = min(BLOCK + 2, n - start)
        part = np.memmap(path, dtype=float, mode="r", offset=16 * start, shape=(size, 2))
        yield cid.Record(u=part[:, 0], y=part[:, 1], dt=1e-3)


def main() -> None:
    """Print what a fit of the whole log takes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=10_000_000)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    n = options.samples
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.f8"
        write(path, n)
        tracemalloc.start()
        started = time.perf_counter()
        model = cid.fit_arx(blocks(path, n), 2, 2, intercept=False, jobs=options.jobs)
        spent = time.perf_counter() - started
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    e = model.estimate
    z = (e.values - [A[1], A[2], B[1], B[2]]) / e.standard_errors
    print(f"{e.n_samples} rows in {spent:.1f} s, peak {peak / 1e6:.1f} MB beside the interpreter")
    print(f"a1, a2, b1, b2 = {e.values}, errors in standard errors {np.round(z, 2)}")


if __name__ == "__main__":
    main()
