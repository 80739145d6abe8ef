"""Measure whether 95 % intervals hold under sensor noise of nine kinds, or a note says why not.

Run it as ``python benchmarks/study_coverage.py --draws 100 --jobs 2``; all draws are ``--draws
1000``. Records come from ``outside_rigs.py``, a simulator that does not know ctrlid: a drive
(J angle'' = k V - c angle') and a mass on a spring, in closed loop, with a random force in half of
the draws. `fit_arx`, `fit_iv` and `fit_continuous` know the orders only, `fit_loop` the plant but
for two parameters; the true coefficients follow from the true parameters by theory.

For each estimator and kind of noise it prints of how many intervals (with Wilson's interval of
99 %) the true value is within, in draws without a note in capitals and in all, and the share of
draws with such a note. ``ok`` says that intervals without a note cover at least 90 % with a Wilson
interval that reaches 95 %.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Iterable
from typing import Any

import control as ct
import joblib
import numpy as np
import outside_rigs as rigs
from _shares import wilson
from study_suspects import make_loop, make_record

import ctrlid as cid

PLANTS = ("drive", "spring")
Z95 = 1.959964
Fit = tuple[np.ndarray, np.ndarray, np.ndarray, tuple[str, ...]]


def make_truth(plant: str, p: dict[str, float]) -> ct.TransferFunction:
    """Return the plant in s, from its true parameters."""
    if plant == "drive":
        return ct.tf([p["k"] / p["J"]], [1, p["c"] / p["J"], 0])
    return ct.tf([1 / p["m"]], [1, p["c"] / p["m"], p["s"] / p["m"]])


def read_coefficients(system: ct.TransferFunction, names: Iterable[str]) -> np.ndarray:
    """Return the coefficients a1, a2, b1, ... of a system as the estimators name them."""
    num, den = np.ravel(system.num[0][0]), np.ravel(system.den[0][0])
    num = num / den[0]
    values = {f"a{i}": v for i, v in enumerate(den / den[0])}
    values |= {f"b{i + 1}": v for i, v in enumerate(np.trim_zeros(num, "f"))}
    return np.array([values.get(name, np.nan) for name in names])


def fit_linear(fit: Callable[[], Any], system: ct.TransferFunction) -> Fit:
    """Return estimates, standard errors, true values and notes of a linear model."""
    estimate = fit().estimate
    truth = read_coefficients(system, estimate.names)
    return (np.asarray(estimate.values), np.asarray(estimate.standard_errors), truth,
            tuple(estimate.notes))  # fmt: skip


def fit_physics(draw: rigs.Draw) -> Fit:
    """Return the same of the physical parameters that are free."""
    found = cid.fit_loop(make_loop(draw), make_record(draw)).estimate
    truth = np.array([draw.rig.true.get(name, np.nan) for name in found.names])
    return (np.asarray(found.values), np.asarray(found.standard_errors), truth,
            tuple(found.notes))  # fmt: skip


def list_fits(draw: rigs.Draw) -> dict[str, Callable[[], Fit]]:
    """Return the estimators by name."""
    record = make_record(draw)
    system = make_truth(draw.rig.plant, draw.rig.true)
    sampled = ct.sample_system(system, draw.rig.dt, "zoh")
    return {
        "fit_arx": lambda: fit_linear(lambda: cid.fit_arx(record, 2, 2), sampled),
        "fit_iv": lambda: fit_linear(lambda: cid.fit_iv(record, 2, 2), sampled),
        "fit_continuous": lambda: fit_linear(lambda: cid.fit_continuous(record, 2), system),
        "fit_loop": lambda: fit_physics(draw),
    }


def run(kind: str, seed: int, n: int, only: Iterable[str]) -> list[dict[str, Any]]:
    """Return a row for each estimator on a draw: distances in standard errors, and notes."""
    plant, rows = PLANTS[seed % len(PLANTS)], []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        draw = rigs.draw(kind, plant, seed, n)
        if draw.rig.law is None:
            return []
        for name, fit in list_fits(draw).items():
            if name not in only:
                continue
            row = {"fit": name, "noise": kind, "seed": seed}
            try:
                value, error, truth, notes = fit()
            except cid.CtrlidError as refusal:
                rows.append(row | {"refused": str(refusal)})
                continue
            known = np.isfinite(truth) & (error > 0)
            off = ((value - truth)[known] / error[known]).tolist()
            noted = any(words.split(" (")[0].isupper() for words in notes)
            rows.append(row | {"off": off, "noted": noted})
    return rows


def write_row(rows: list[dict[str, Any]]) -> str:
    """Return what holds of one estimator under one noise, as a line."""
    answers = [x for x in rows if "off" in x]
    noted = [x["noted"] for x in answers]
    cells = []
    for chosen in ([x for x in answers if not x["noted"]], answers):
        hits = [abs(v) < Z95 for x in chosen for v in x["off"]]
        low, high = wilson(sum(hits), len(hits), 0.99)
        share = 100 * sum(hits) / len(hits) if hits else np.nan
        cells.append((share, 100 * low, 100 * high, len(hits)))
    share, _, high, count = cells[0]
    verdict = "ok" if not count or (share >= 90 and high >= 95) else "SHORT"
    told = "".join(f"{s:>8.1f} ({a:.0f}-{b:.0f}) of {k:<5}" for s, a, b, k in cells)
    return (f"{told}{100 * np.mean(noted) if noted else np.nan:>7.0f} %"
            f"{sum('refused' in x for x in rows):>6}  {verdict}")  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = ("fit_arx", "fit_iv", "fit_continuous", "fit_loop")
    parser.add_argument("--noises", nargs="+", choices=rigs.NOISES, default=list(rigs.NOISES))
    parser.add_argument("--only", nargs="+", choices=names, default=list(names))
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--samples", type=int, default=1500)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.draws)
    work = joblib.Parallel(n_jobs=options.jobs)
    parts = work(joblib.delayed(run)(kind, seed, options.samples, options.only)
                 for kind in options.noises for seed in seeds)  # fmt: skip
    rows = [row for part in parts for row in part]
    print(f"{'':<28}{'covered % without a note':>26}{'in all':>20}{'noted':>12} refused")
    for name in options.only:
        for kind in options.noises:
            own = [x for x in rows if x["fit"] == name and x["noise"] == kind]
            print(f"{name:<15} {kind:<11}", write_row(own), flush=True)


if __name__ == "__main__":
    main()
