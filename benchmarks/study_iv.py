"""Compare all estimators with the Cramér-Rao bound, on levitations drawn at random.

Run it as ``python benchmarks/study_iv.py --runs 40 --jobs 2``. The options are ``--analog`` for
known analog leads, ``--only fit_iv fit_loop`` for some of the estimators, ``--free`` for fit_iv
without constraints, and ``--given`` for fit_iv with the true controller instead of one estimated
from the record. ``--physics 0.01`` simulates the nonlinear levitation with a standard deviation of
the voltage of at most 1 %, which is in the linear range; ``--physics 1`` takes the reference as
drawn, which is not.

Each run draws a gap of 5-20 mm, a voltage of 1-10 V, a lead (crossover 2-3 times the unstable pole
p, 40-55 degrees; less demanding where such a loop would hardly be stable, at p*Ts = 0.5), a random
binary reference of 1-2 % of the gap, and 10 000-45 000 samples. The estimators estimate alpha and
beta of -beta/(s^2 - alpha). For each estimator and each of the two it prints

- the median of the absolute error in percent;
- bias: the mean of error / standard error;
- covered: the share of nominal 95 % intervals that contain the true value;
- efficiency: the mean square of the error divided by the Cramér-Rao bound, which is 1 for an
  efficient estimator. The bound is that of two unknowns, so ``--free`` with four stays above 1.

The structure is given to each estimator in its own way: as reciprocal poles and b1 = b2, as
symmetric poles, or, for fit_loop, as the physical equations with their operating point; fit_loop
starts 5 % off in both parameters. A difference equation assumes a held input, which is wrong under
an analog lead, so fit_iv refuses such records.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import control as ct
import joblib
import numpy as np
from scipy.signal import lfilter

import ctrlid as cid
from ctrlid.estimation.identified_model import Estimate
from ctrlid.estimation.likelihood.likelihood import (
    evaluate_likelihood,
    make_problem,
    pseudo_inverse,
)
from ctrlid.estimation.likelihood.maximization import begin_fit, choose_noise, compute_information

STEPS = (0.5, 0.2, 0.1, 0.03, 0.01, 0.005)
NOISES = (0.01, 0.05, 0.2)
KNOWN = (cid.ReciprocalPoles(), cid.Equal("b1", "b2"))


@dataclass(frozen=True, eq=False)
class Draw:
    """A levitation, its lead and one record, with the bound on what it can tell."""

    alpha: float
    beta: float
    lead: ct.TransferFunction
    record: cid.Record
    bound: np.ndarray
    loop: cid.Loop
    noise: float


def plant(alpha: float, beta: float, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Denominator and numerator of -beta/(s^2 - alpha) behind a hold, in powers of the delay."""
    step = np.sqrt(alpha) * dt
    b = -beta / alpha * 2 * np.sinh(step / 2) ** 2
    return np.array([1.0, -2 * np.cosh(step), 1.0]), np.array([0.0, b, b])


def loop(
    a: np.ndarray, b: np.ndarray, lead: ct.TransferFunction, r: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Run the linear loop: u and y caused by the reference, then by the sensor noise."""
    n, d = lead.num[0][0], lead.den[0][0]
    both = np.polyadd(np.convolve(a, d), np.convolve(b, n))
    caused = lfilter(np.convolve(n, a), both, r), lfilter(np.convolve(n, b), both, r)
    noise = -lfilter(np.convolve(n, a), both, v), lfilter(np.convolve(a, d), both, v)
    return *caused, *noise


def slowest(a: np.ndarray, b: np.ndarray, lead: ct.TransferFunction) -> float:
    """Decay per sample of the slowest mode of the loop."""
    both = np.polyadd(np.convolve(a, lead.den[0][0]), np.convolve(b, lead.num[0][0]))
    return float(-np.log(np.abs(np.roots(both)).max()))


def design(rng: np.random.Generator, a: np.ndarray, b: np.ndarray, p: float, dt: float):
    """Draw leads until one works and leaves no mode slower than a twentieth of p."""
    for trial in range(1000):
        # Slow sampling leaves less phase: ask for less.
        ease = 1.0 if trial < 5 and p * dt < 0.4 else rng.uniform(0.4, 0.8)
        try:
            lead = cid.design_lead(
                ct.tf(b[1:], a, dt), p * rng.uniform(2, 3) * ease, rng.uniform(40, 55) * ease
            )
        except cid.CtrlidError:
            continue
        if slowest(a, b, lead) > 0.05 * p * dt:
            return lead
    raise RuntimeError("no lead found")


def linear_loop(
    alpha: float, beta: float, lead: ct.TransferFunction, dt: float, gap: float, voltage: float
) -> cid.Loop:
    """Return the linear levitation as a law with two parameters, resting at gap and voltage."""

    def rates(t: float, x: np.ndarray, u: np.ndarray, params: dict[str, float]) -> np.ndarray:
        return np.array([x[1], params["alpha"] * (x[0] - gap) - params["beta"] * (u[0] - voltage)])

    law = ct.nlsys(
        rates, lambda t, x, u, params: x[0], name="levitation", inputs=["V"], outputs=["x"],
        states=["x", "v"], params={"alpha": alpha, "beta": beta},
    )  # fmt: skip
    at = cid.OperatingPoint((gap, 0.0), voltage, gap)
    return cid.Loop(law, lead, dt=dt, at=at, free=("alpha", "beta"))


def draw_analog(rng: np.random.Generator, step: float, noise: float) -> Draw:
    """Draw a linear levitation under an analog lead, whose u moves between the samples."""
    gap, voltage = rng.uniform(5e-3, 20e-3), rng.uniform(1.0, 10.0)
    alpha, beta = 2 * 9.81 / gap, 2 * 9.81 / voltage
    p = np.sqrt(alpha)
    lead = cid.design_lead(
        ct.tf([-beta], [1, 0, -alpha]), p * rng.uniform(2, 3), rng.uniform(40, 55)
    )
    n = int(rng.integers(10_000, 45_001))
    amplitude = gap * rng.uniform(0.01, 0.02)
    hold = int(np.exp(rng.uniform(np.log(3), np.log(max(8.0, 2 / step)))))
    r = cid.random_binary(
        n, amplitude=amplitude, hold=hold, around=gap, seed=int(rng.integers(1 << 30))
    )
    loop = linear_loop(alpha, beta, lead, step / p, gap, voltage)
    record = cid.simulate(loop, r, sensor_noise=noise * amplitude, seed=int(rng.integers(1 << 30)))
    return Draw(alpha, beta, lead, record, information_bound(loop, record), loop, noise * amplitude)


def information_bound(loop: cid.Loop, record: cid.Record) -> np.ndarray:
    """Cramér-Rao bound on the loop's free parameters, from the exact information at their values.

    The noise is as it is found with these values.
    """
    names = loop.free
    start = begin_fit(make_problem(loop, names, [record]))
    fit = choose_noise(start)
    if fit.theta is not start.theta:  # the choice of the noise may have moved the parameters
        fit = evaluate_likelihood(start.problem, start.theta, fit.noise, fit.trajectories)
    inverse = pseudo_inverse(compute_information(fit)[0])
    return np.sqrt(np.diag(inverse)[: len(names)])


def draw(rng: np.random.Generator, step: float, noise: float, swing: float | None = None) -> Draw:
    """Draw a levitation sampled at p*Ts = step, and a record with this share of sensor noise.

    With ``swing`` the nonlinear levitation is simulated, reference and noise made so much smaller
    that the voltage scatters by no more than this share of itself.
    """
    gap, voltage = rng.uniform(5e-3, 20e-3), rng.uniform(1.0, 10.0)
    mass = np.exp(rng.uniform(np.log(0.01), np.log(0.1)))
    alpha, beta = 2 * 9.81 / gap, 2 * 9.81 / voltage
    p = np.sqrt(alpha)
    dt = step / p
    a, b = plant(alpha, beta, dt)
    lead = design(rng, a, b, p, dt)
    n = int(rng.integers(10_000, 45_001))
    amplitude = gap * rng.uniform(0.01, 0.02)
    hold = int(np.exp(rng.uniform(np.log(3), np.log(max(8.0, 2 / step)))))
    r = cid.random_binary(n, amplitude=amplitude, hold=hold, seed=int(rng.integers(1 << 30)))
    sigma = noise * amplitude
    v = sigma * rng.standard_normal(n)
    ur, yr, uv, yv = loop(a, b, lead, r, v)
    bound = cramer_rao(alpha, beta, dt, sigma, (ur, yr, uv, yv))
    if swing is not None:
        small = min(1.0, swing * voltage / float(np.std(ur + uv)))
        r, sigma = small * r, small * sigma
        law = cid.plants.maglev(m=mass, K=mass * 9.81 * gap**2 / voltage**2)
        at = cid.operating_point(law, output=gap)
        record = cid.simulate(
            cid.Loop(law, lead, dt=dt, at=at),
            gap + r,
            sensor_noise=sigma,
            seed=int(rng.integers(1 << 30)),
        )
        # V^2 rectifies, so it hovers a little off the set-point: what is true there counts.
        off = float(record.y.mean()) / gap
        alpha, beta = alpha / off, beta / off
        gap = gap * off
    else:
        record = cid.Record(r=gap + r, u=voltage + ur + uv, y=gap + yr + yv, dt=dt)
    linear = linear_loop(alpha, beta, lead, dt, gap, voltage)
    return Draw(alpha, beta, lead, record, bound, linear, sigma)


def cramer_rao(
    alpha: float,
    beta: float,
    dt: float,
    sigma: float,
    signals: tuple[np.ndarray, ...],
) -> np.ndarray:
    """Bound on the standard deviations of alpha and beta, white Gaussian sensor noise, linear loop.

    The innovations are ``e = A y - B u`` over A with its pole outside reflected; their variance is
    that of the noise times the square of that pole.
    """

    def errors(x: np.ndarray) -> np.ndarray:
        a, b = plant(x[0], x[1], dt)
        z = np.exp(-np.sqrt(x[0]) * dt)
        stable = np.array([1.0, -2 * z, z * z])
        ur, yr, uv, yv = signals
        # Reference and noise do not depend on each other, so their information adds.
        pairs = (yr, ur), (yv, uv)
        return np.array([lfilter(a, stable, y) - lfilter(b, stable, u) for y, u in pairs])

    x = np.array([alpha, beta])
    h = 1e-4 * x
    slopes = [(errors(x + e) - errors(x - e)) / (2 * e.sum()) for e in np.diag(h)]
    variance = (sigma * np.exp(np.sqrt(alpha) * dt)) ** 2
    information = np.array([[np.sum(s * t) for t in slopes] for s in slopes]) / variance
    return np.sqrt(np.diag(np.linalg.inv(information)))


def physical(estimate: Estimate, values: np.ndarray | None = None) -> np.ndarray:
    """Alpha from the pole farthest out, beta from the static gain."""
    return physical_values(estimate.values if values is None else values, estimate.dt)


def physical_values(theta: np.ndarray, dt: float) -> np.ndarray:
    """Alpha and beta of the coefficients a1, a2, b1, b2."""
    a1, a2, b1, b2 = theta
    x = np.roots([1.0, 2.0 + a1, 1.0 + a1 + a2]).astype(complex)  # poles less one
    s = np.log1p(x[np.argmax(np.abs(1 + x))]) / dt
    alpha = float((s * s).real)
    return np.array([alpha, alpha * (b1 + b2) / (1 + a1 + a2)])


def physical_errors(estimate: Estimate) -> np.ndarray:
    """Find standard errors of alpha and beta by the delta method."""
    se = estimate.standard_errors
    columns = []
    for i, width in enumerate(1e-3 * se):
        e = np.zeros(4)
        e[i] = width
        high, low = physical(estimate, estimate.values + e), physical(estimate, estimate.values - e)
        columns.append((high - low) / (2 * width) if width else np.zeros(2))
    slope = np.column_stack(columns)
    return np.sqrt(np.diag(slope @ estimate.covariance @ slope.T))


def delayed_references(record: cid.Record, count: int = 20) -> np.ndarray:
    """Coefficients by instruments: references 1 to 20 samples old, with a2 = 1 and b1 = b2."""
    y, u, r = (s - s.mean() for s in (record.y, record.u, record.r))
    n = len(y)
    z = np.column_stack([r[count - i : n - i] for i in range(1, count + 1)])
    y0, y1, y2 = (y[count - i : n - i] for i in range(3))
    u1, u2 = (u[count - i : n - i] for i in (1, 2))
    # Projections on the references, from products of columns: narrow, so without many threads.
    x = np.column_stack([-y1, u1 + u2, y0 + y2])
    half = np.linalg.solve(np.linalg.cholesky(z.T @ z), z.T @ x)
    a1, b = np.linalg.lstsq(half[:, :2], half[:, 2], rcond=None)[0]
    return np.array([a1, 1.0, b, b])


def _regression(one: Draw, known: Sequence[object]) -> tuple[np.ndarray, np.ndarray]:
    estimate = cid.fit_arx(one.record, 2, 2, constraints=known).estimate
    with np.errstate(divide="ignore", invalid="ignore"):
        return physical(estimate), physical_errors(estimate)


def _delayed(one: Draw) -> tuple[np.ndarray, np.ndarray]:
    with np.errstate(divide="ignore", invalid="ignore"):
        theta = delayed_references(one.record)
        return physical_values(theta, one.record.dt), np.full(2, np.nan)


def _instruments(one: Draw, free: bool, given: bool) -> tuple[np.ndarray, np.ndarray]:
    known = () if free else KNOWN
    controller = one.lead if given else None
    estimate = cid.fit_iv(one.record, 2, 2, constraints=known, controller=controller).estimate
    return physical(estimate), physical_errors(estimate)


def _continuous(one: Draw) -> tuple[np.ndarray, np.ndarray]:
    controller = one.lead if one.loop.analog else None
    estimate = cid.fit_continuous(
        one.record, 2, 0, [cid.SymmetricPoles()], controller=controller
    ).estimate
    return -estimate.values[1:], estimate.standard_errors[1:]


def _likelihood(one: Draw) -> tuple[np.ndarray, np.ndarray]:
    believed = {"alpha": 1.05 * one.alpha, "beta": 0.95 * one.beta}
    estimate = cid.fit_loop(one.loop.with_parameters(believed), one.record).estimate
    return estimate.values, estimate.standard_errors


ESTIMATORS = (
    "fit_arx", "fit_arx constrained", "delayed references", "fit_iv", "fit_continuous", "fit_loop",
)  # fmt: skip


def run(one: Draw, free: bool, given: bool, only: Sequence[str] = ESTIMATORS) -> np.ndarray:
    """Errors and standard errors of each estimator, ``(estimators, 2, 2)``, relative."""
    truth = np.array([one.alpha, one.beta])
    found = np.full((len(ESTIMATORS), 2, 2), np.nan)
    ways: tuple[Callable[[Draw], tuple[np.ndarray, np.ndarray]], ...] = (
        partial(_regression, known=()),
        partial(_regression, known=KNOWN),
        _delayed,
        partial(_instruments, free=free, given=given),
        _continuous,
        _likelihood,
    )
    for k, (name, way) in enumerate(zip(ESTIMATORS, ways, strict=True)):
        if name not in only:
            continue
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", cid.CtrlidWarning)
                found[k] = way(one)
        except cid.CtrlidError as reason:
            if not (name == "fit_iv" and one.loop.analog):
                print(f"  {name} refused: {reason}", flush=True)
    found[:, 0] -= truth
    return found / truth


def summary(found: np.ndarray, bound: np.ndarray) -> list[np.ndarray]:
    """Median size of the error in percent, bias, coverage, efficiency, of alpha and beta each."""
    found, bound = found[~np.isnan(found[:, 0, 0])], bound[~np.isnan(found[:, 0, 0])]
    if not len(found):
        return [np.full(2, np.nan)] * 4
    error, se = found[:, 0], found[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = error / se
        covered = np.mean(np.abs(z) < 1.959964, axis=0) + 0 * z[0]
        return [
            100 * np.median(np.abs(error), axis=0),
            z.mean(axis=0),
            100 * covered,
            np.mean((error / bound) ** 2, axis=0),
        ]


def study(
    runs: int,
    steps: tuple[float, ...] = STEPS,
    noises: tuple[float, ...] = NOISES,
    swing: float | None = None,
    free: bool = False,
    given: bool = False,
    analog: bool = False,
    only: Sequence[str] = ESTIMATORS[:4],
    jobs: int = 1,
    tell: bool = False,
) -> dict[tuple[float, float], tuple[np.ndarray, np.ndarray]]:
    """All runs: by p*Ts and noise the errors of each estimator and the bounds, relative.

    With ``tell`` each line of the table is printed as soon as it is known.
    """

    def one_run(seed: int, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng([seed, i, j])
        drawn = (
            draw_analog(rng, steps[i], noises[j])
            if analog
            else draw(rng, steps[i], noises[j], swing)
        )
        return run(drawn, free, given, only), drawn.bound / [drawn.alpha, drawn.beta]

    work = joblib.Parallel(n_jobs=jobs)
    table = {}
    for i, step in enumerate(steps):
        for j, noise in enumerate(noises):
            done = work(joblib.delayed(one_run)(seed, i, j) for seed in range(runs))
            found, bounds = zip(*done, strict=True)
            table[step, noise] = np.array(found), np.array(bounds)
            if tell:
                show(f"p*Ts {step:<6} noise {100 * noise:g} %", *table[step, noise])
    return table


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20, help="draws for each line of the table")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--analog", action="store_true", help="analog leads that are known")
    parser.add_argument("--only", nargs="+", default=ESTIMATORS, choices=ESTIMATORS)
    parser.add_argument(
        "--physics",
        type=float,
        metavar="SWING",
        help="simulate the nonlinear levitation, its voltage scattering by at most this share",
    )
    parser.add_argument("--free", action="store_true", help="fit_iv without constraints")
    parser.add_argument("--given", action="store_true", help="give fit_iv the controller")
    options = parser.parse_args()
    print("alpha / beta: median error %, bias in s.e., covered %, efficiency")
    table = study(
        options.runs, swing=options.physics, free=options.free, given=options.given,
        analog=options.analog, only=options.only, jobs=options.jobs, tell=True,
    )  # fmt: skip
    found, bound = (np.concatenate(parts) for parts in zip(*table.values(), strict=True))
    show(f"all {len(found)} runs", found, bound)


def show(title: str, found: np.ndarray, bound: np.ndarray) -> None:
    """Print one block: a line for each estimator."""
    print(f"{title}, bound {100 * np.median(bound):.2g} %", flush=True)
    for k, name in enumerate(ESTIMATORS):
        if np.isnan(found[:, k, 0]).all():
            continue
        cells = [
            " / ".join("-" if np.isnan(x) else f"{x:.3g}" for x in pair)
            for pair in summary(found[:, k], bound)
        ]
        refused = int(np.isnan(found[:, k, 0, 0]).sum())
        end = f"   refused {refused}" if refused else ""
        print(f"  {name:<22}" + "".join(f"{cell:>22}" for cell in cells) + end)


if __name__ == "__main__":
    main()
