"""Other identification packages on the same record of an unstable plant in closed loop.

Run it as ``python benchmarks/peers.py``, in an environment that has some of them
(``pip install pysib sippy_unipi sysidentpy archimedes``). Packages that are not installed are left
out. ``--seed``, ``--noise`` and ``--step`` (unstable pole times sampling period) choose the record.

All packages get the same levitation, drawn as in study_iv.py: a digital lead, a random binary
reference and white sensor noise. They estimate alpha and beta of -beta/(s^2 - alpha). Each package
is used as its documentation says, with the true orders. Further knowledge (reciprocal poles, b1 =
b2, the physical equations) is given to those that can use it. The signals are given as deviations
from their means, divided by their standard deviations, since most packages estimate no constant and
do not scale. The times are those of a second call, because the first one loads and compiles; if it
takes more than ten seconds, there is no second call. Methods that cannot have a pole outside the
unit circle (output error, Box-Jenkins) are left out, and so is one that needs a second experiment
with the same input (pysib iv).
"""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from study_iv import KNOWN, Draw, draw

import ctrlid as cid

TIGHT = {"ftol": 1e-10, "xtol": 1e-8, "gtol": 1e-8}  # archimedes stops early by default


@dataclass(frozen=True)
class Scaled:
    """A record as most packages want it, and the way back."""

    u: np.ndarray
    y: np.ndarray
    ratio: float
    dt: float

    def physical(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Alpha from the pole farthest out, beta from the gain at rest.

        ``y(k) + a1 y(k-1) + a2 y(k-2) = b1 u(k-1) + b2 u(k-2)``.
        """
        x = np.roots([1.0, 2.0 + a[0], 1.0 + a[0] + a[1]]).astype(complex)
        s = np.log1p(x[np.argmax(np.abs(1 + x))]) / self.dt
        alpha = float((s * s).real)
        return np.array([alpha, alpha * self.ratio * (b[0] + b[1]) / (1 + a[0] + a[1])])


def scaled(record: cid.Record) -> Scaled:
    """Take the means off and divide by the spreads."""
    y, u = record.y - record.y.mean(), record.u - record.u.mean()
    return Scaled(u / u.std(), y / y.std(), float(y.std() / u.std()), record.dt)


def pysib_arx(data: Scaled) -> np.ndarray:
    """Least squares."""
    import pysib

    theta, _ = pysib.arx(data.u, data.y, 2, 2, 1)
    return data.physical(theta[:2], theta[2:])


def pysib_armax(data: Scaled) -> np.ndarray:
    """Prediction errors with C free: the structure of sensor noise."""
    import pysib

    theta, _ = pysib.armax(data.u, data.y, 2, 2, 2, 1)
    return data.physical(theta[:2], theta[2:4])


def _sippy(data: Scaled, method: str, **options: object) -> np.ndarray:
    from sippy_unipi import system_identification

    model = system_identification(data.y, data.u, method, tsample=data.dt, **options)
    num, den = np.ravel(model.G.num[0][0]), np.ravel(model.G.den[0][0])
    num = np.concatenate([np.zeros(max(len(den) - len(num), 0)), num])
    return data.physical(den[1:3] / den[0], num[1:3] / den[0])


def sippy_arx(data: Scaled) -> np.ndarray:
    """Least squares."""
    return _sippy(data, "ARX", ARX_orders=[2, 2, 1])


def sippy_armax(data: Scaled) -> np.ndarray:
    """Least squares with C free, iterated."""
    return _sippy(data, "ARMAX", ARMAX_orders=[2, 2, 2, 1])


def sippy_parsim(data: Scaled) -> np.ndarray:
    """Subspace method for closed loops, PARSIM-K of order two."""
    from sippy_unipi import system_identification

    model = system_identification(data.y, data.u, "PARSIM-K", SS_fixed_order=2, tsample=data.dt)
    den = np.poly(model.A)
    gains = [float((model.C @ np.linalg.matrix_power(model.A, k) @ model.B)[0, 0]) for k in (0, 1)]
    return data.physical(den[1:], np.array([gains[0], gains[1] + den[1] * gains[0]]))


def _narmax(data: Scaled, model_type: str, terms: int, **options: object) -> np.ndarray:
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares

    model = FROLS(
        ylag=2, xlag=2, order_selection=False, n_terms=terms, model_type=model_type,
        estimator=LeastSquares(**options), basis_function=Polynomial(degree=1),
    )  # fmt: skip
    model.fit(X=data.u[:, None], y=data.y[:, None])
    found = dict(zip((int(row[0]) for row in model.final_model), np.ravel(model.theta),
                     strict=False))  # fmt: skip
    a = -np.array([found.get(1001, 0.0), found.get(1002, 0.0)])
    return data.physical(a, np.array([found.get(2001, 0.0), found.get(2002, 0.0)]))


def sysidentpy_arx(data: Scaled) -> np.ndarray:
    """Least squares on four chosen terms."""
    return _narmax(data, "NARMAX", 5)


def sysidentpy_extended(data: Scaled) -> np.ndarray:
    """Least squares with past residuals among the regressors."""
    return _narmax(data, "NARMAX", 5, unbiased=True)


def archimedes_pem(one: Draw) -> np.ndarray:
    """Prediction errors of an extended Kalman filter on the law, noise levels given as drawn."""
    import archimedes as arc
    from archimedes.observers import ExtendedKalmanFilter
    from archimedes.sysid import Timeseries, pem

    record, scale = one.record, 1e3  # millimetres: its filter starts with a unit covariance
    y, u = scale * (record.y - one.loop.at.output), record.u - one.loop.at.input

    def rates(t, x, u, p):  # type: ignore[no-untyped-def]
        force = p["alpha"] * one.alpha * x[0] - scale * p["beta"] * one.beta * u[0]
        return np.hstack([x[1], force])

    model = arc.discretize(rates, dt=record.dt, method="rk4")
    sigma = scale * one.noise
    observer = ExtendedKalmanFilter(
        model, lambda t, x, u, p: x[0], Q=1e-8 * sigma**2 * np.eye(2), R=np.array([[sigma**2]])
    )
    # Its filter predicts y(k) with the input of the same row: that is u(k-1).
    data = Timeseries(ts=record.t[1:], us=u[None, :-1], ys=y[None, 1:])
    start = {"alpha": 1.05, "beta": 0.95}
    found = pem(observer, data, start, x0=np.zeros(2), P0=sigma**2 * np.eye(2), options=TIGHT).p
    return np.array([found["alpha"] * one.alpha, found["beta"] * one.beta])


def ours(one: Draw, which: str) -> np.ndarray:
    """Fit with one of ctrlid's estimators."""
    record = one.record
    if which == "fit_continuous":
        e = cid.fit_continuous(record, 2, 0, [cid.SymmetricPoles()]).estimate
        return -e.values[1:]
    if which == "fit_loop":
        believed = {"alpha": 1.05 * one.alpha, "beta": 0.95 * one.beta}
        return np.array(cid.fit_loop(one.loop.with_parameters(believed), record).estimate.values)
    fit = cid.fit_arx if "arx" in which else cid.fit_iv
    known = () if which.endswith("free") else KNOWN
    values = fit(record, 2, 2, constraints=known).estimate.values
    same = Scaled(record.u, record.y, 1.0, record.dt)
    return same.physical(values[:2], values[2:])


PEERS: dict[str, tuple[str, Callable[[Scaled], np.ndarray]]] = {
    "pysib arx": ("pysib", pysib_arx),
    "pysib armax": ("pysib", pysib_armax),
    "SIPPY ARX": ("sippy_unipi", sippy_arx),
    "SIPPY ARMAX, ILLS": ("sippy_unipi", sippy_armax),
    "SIPPY PARSIM-K": ("sippy_unipi", sippy_parsim),
    "SysIdentPy FROLS": ("sysidentpy", sysidentpy_arx),
    "SysIdentPy FROLS, extended LS": ("sysidentpy", sysidentpy_extended),
}
OURS = ("fit_arx free", "fit_arx", "fit_iv free", "fit_iv", "fit_continuous", "fit_loop")


def version(package: str) -> str | None:
    """Return the installed version of a package, None where it is missing."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


@contextmanager
def quiet() -> Iterator[None]:
    """Keep warnings, prints and what compiled code prints to ourselves."""
    kept = [os.dup(1), os.dup(2)]
    sys.stdout.flush()
    with open(os.devnull, "w") as nowhere, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
        try:
            yield
        finally:
            sys.stdout.flush()
            for number, copy in enumerate(kept, start=1):
                os.dup2(copy, number)
                os.close(copy)


def show(name: str, fit: Callable[[], np.ndarray], one: Draw) -> None:
    """Run a fit twice and print its errors and the time of the second run."""
    truth, spent, found = np.array([one.alpha, one.beta]), 0.0, np.full(2, np.nan)
    trouble = ""
    try:
        with quiet():
            for _ in range(2):
                started = time.perf_counter()
                found = fit()
                spent = time.perf_counter() - started
                if spent > 10:
                    break
    except Exception as reason:  # whatever a foreign package raises is its answer
        trouble = f"{type(reason).__name__}: {reason}"[:60]
    error = 100 * (found / truth - 1)
    cells = "".join(f"{e:>+12.3g}" if np.isfinite(e) else f"{'-':>12}" for e in error)
    print(f"  {name:<32}{cells}{spent:>10.2f}  {trouble}", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--step", type=float, default=0.1, help="unstable pole x sampling period")
    parser.add_argument("--noise", type=float, default=0.1, help="share of the reference")
    options = parser.parse_args()
    one = draw(np.random.default_rng([options.seed]), options.step, options.noise)
    print(f"{len(one.record)} samples at {1e3 * one.record.dt:.3g} ms, p = "
          f"{np.sqrt(one.alpha):.1f} rad/s, p Ts = {options.step:g}, sensor noise "
          f"{100 * options.noise:g} % of the reference")  # fmt: skip
    print(f"  {'':<32}{'alpha [%]':>12}{'beta [%]':>12}{'time [s]':>10}")
    bound = 100 * one.bound / [one.alpha, one.beta]
    print(f"  {'Cramér-Rao bound':<32}{bound[0]:>12.3g}{bound[1]:>12.3g}")
    for name in OURS:
        show(f"ctrlid {name}", lambda name=name: ours(one, name), one)
    data, missing = scaled(one.record), []
    for name, (package, fit) in PEERS.items():
        if version(package) is None:
            missing.append(package)
            continue
        show(name, lambda fit=fit: fit(data), one)
    if version("archimedes") is None:
        missing.append("archimedes")
    else:
        show("archimedes pem", lambda: archimedes_pem(one), one)
    packages = ("ctrlid", "pysib", "sippy_unipi", "sysidentpy", "archimedes", "numpy")
    print("  versions: " + ", ".join(f"{p} {v}" for p in packages if (v := version(p)))
          + f", Python {sys.version.split()[0]}")  # fmt: skip
    if missing:
        print("  not installed: " + ", ".join(dict.fromkeys(missing)))


if __name__ == "__main__":
    main()
