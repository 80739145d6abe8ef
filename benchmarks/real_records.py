"""Fit four real rigs, each with a suitable estimator, and compare with the values of physics.

Run it as ``python benchmarks/real_records.py``; ``magnetoshield``, ``inteco``, ``emps`` and
``servo`` select some of them. The records are downloaded once, or read from the folder that the
environment variable CTRLID_DATA_DIR names.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace

import control as ct
import numpy as np

import ctrlid as cid
from ctrlid import effects
from ctrlid.validation.sampling_sweep import average_input

G = 9.81  # m/s^2
LEVELS = (0.008, 0.010, 0.012, 0.014)  # of the swings of the INTECO ball [m]


def line(*cells: object, widths: Sequence[int] = (30, 16, 16, 14, 14)) -> None:
    """Print the cells of a row under each other."""
    cells += ("",) * (len(widths) - len(cells))
    print("  " + "".join(f"{c!s:<{w}}" for c, w in zip(cells, widths, strict=True)).rstrip())


def pm(value: float, error: float, digits: int = 1) -> str:
    """Return a value with its standard error."""
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def magnetoshield() -> tuple[cid.FitSeries, np.ndarray]:
    """Fit a reciprocal pair behind one sample of delay to each of the five set-points.

    From the statics follows what the pair should be: where the magnet rests at every gap, the pull
    is the weight, ``F_x dx + F_i di = 0``, so ``p^2 = F_x/m = (-b1 R) di/dx`` with the resistance R
    from voltage to current and the slope of the resting current over the gap.
    """
    records = cid.datasets.load("magnetoshield_r3")
    series = cid.fit_each(
        cid.fit_continuous, records, poles=2, constraints=[cid.SymmetricPoles()],
        delay=records[0].dt,
    )  # fmt: skip
    means = np.array([
        [r.u[r.valid].mean(), r.extra["current"][r.valid].mean()] for r in records
    ])  # fmt: skip
    resistance = means[:, 0] / means[:, 1]
    slope = np.polyval(np.polyder(np.polyfit(series.levels, means[:, 1], 2)), series.levels)
    gains = np.array([model.estimate["b1"] for model in series.models])
    statics = np.sqrt(-gains * resistance * slope)
    print("MagnetoShield R3, a levitated permanent magnet: s^2 - p^2 behind a delay of one sample")
    line("set-point, mean gap", "p [rad/s]", "b1 [m/s^2/V]", "sqrt(2 g/x0)", "from statics")
    for record, model, level, p, error, static in zip(
        records, series.models, series.levels, series.rates, series.rate_errors, statics,
        strict=True,
    ):  # fmt: skip
        e = model.estimate
        line(
            f"{record.name.split(' ', 1)[1].split(',')[0]}, {1e3 * level:.2f} mm", pm(p, error),
            pm(e["b1"], e.standard_errors[2], 3), f"{np.sqrt(2 * G / level):.1f}", f"{static:.1f}",
        )  # fmt: skip
    trend = series.trend
    print(f"  {pm(trend.pole, trend.pole_error)} rad/s; as the gap to the power "
          f"{pm(trend.exponent, trend.exponent_error, 2)}, -0.50 for a ball; "
          f"scatter about the line p = {trend.p_value:.2f}")  # fmt: skip
    return series, statics


def inteco() -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Fit a free second order to the swings near each level, from the measured current."""
    record = cid.datasets.load("inteco_pid_step").with_input("current")
    swings = [replace(record[i : i + 2100], valid=None) for i in (9_900, 17_900)]
    still = [record[21_000:24_000], record[5_000:9_900], record[14_000:17_900]]
    gaps, currents = (np.array([getattr(r, k).mean() for r in still]) for k in "yu")
    slope, zero = np.polyfit(gaps, currents, 1)
    offset = zero / slope
    print("INTECO, a steel ball, measured current as input: b1/(s^2 + a1 s + a2), nothing known")
    line("swings within 2 mm of", "poles [rad/s]", "", "b1 [m/s^2/A]", "from statics")
    found = []
    for level in LEVELS:
        model = cid.fit_continuous([near(s, level) for s in swings if near(s, level)], poles=2)
        e = model.estimate
        order = np.argsort(-e.poles.real)
        p, errors = e.poles.real[order], e.poles_standard_errors[order]
        found.append((level, p, errors))
        line(f"{1e3 * level:g} mm", pm(p[0], errors[0]), pm(p[1], errors[1]), f"{e['b1']:.1f}",
             f"±{np.sqrt(2 * G / (level + offset)):.1f}")  # fmt: skip
    rests = ", ".join(f"{i:.3f} A at {1e3 * x:.0f} mm" for x, i in zip(gaps, currents, strict=True))
    print(f"  It rests with {rests}: the pull falls as i^2/(x + {1e3 * offset:.1f} mm)^2.")
    fitted = inteco_law(swings)
    e = fitted.estimate
    poles = []
    for level in LEVELS:
        at = replace(fitted, loop=replace(
            fitted.loop, at=cid.operating_point(fitted.loop.plant, output=level)
        ))  # fmt: skip
        poles.append(pm(at.poles.real.max(), at.poles_standard_errors[0]))
    print("  The law m x'' = m g - K i^2/(x + d)^2, fitted to the whole swings by fit_loop:")
    print(f"  d = {pm(1e3 * e['d'], 1e3 * e.standard_errors[1])} mm, p = {', '.join(poles)} rad/s.")
    return found


def near(record: cid.Record, level: float, within: float = 2e-3) -> cid.Record | None:
    """Return the record with those stretches valid that move near a level."""
    inside = replace(record, valid=np.abs(record.y - level) < within)
    kept = np.zeros(len(record), dtype=bool)
    for a, b in inside.segments():
        kept[a:b] = b - a >= 20 and np.ptp(record.y[a:b]) > 0.5 * within
    return replace(record, valid=kept) if kept.any() else None


def inteco_law(swings: Sequence[cid.Record]) -> cid.LoopFit:
    """Fit the pull of the coil on the ball, an inverse square with an offset."""

    def rates(t: float, x: np.ndarray, u: np.ndarray, p: dict[str, float]) -> np.ndarray:
        return np.array([x[1], G - p["K"] / p["m"] * u[0] ** 2 / (x[0] + p["d"]) ** 2])

    ball = ct.nlsys(
        rates, lambda t, x, u, p: x[0], name="ball", inputs=["i"], outputs=["x"],
        states=["x", "v"], params={"m": 0.058, "K": 9e-5, "d": 0.003},
    )  # fmt: skip
    at = cid.operating_point(ball, output=0.01)
    return cid.fit_loop(cid.Loop(ball, None, dt=swings[0].dt, at=at, free=("K", "d")), swings)


def emps() -> cid.LoopFit:
    """Fit mass and friction of the carriage, the motor's force per volt being known."""
    record = cid.datasets.load("emps")
    rest = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
    plain = cid.Loop(cid.plants.servo(m=90.0, c=250.0, k=35.15065), None, dt=record.dt, at=rest,
                     free=("m", "c"))  # fmt: skip
    rubbing = plain.with_effect(effects.CoulombFriction(0.15)).with_effect(
        effects.ConstantForce(0.01)
    )
    print("EMPS, a carriage on a screw: M x'' = 35.15 N/V u - Fv x' - Fc sign(x') + F0")
    line("", "M [kg]", "Fv [N s/m]", "Fc [N]", "F0 [N]")
    line("published", "95.11", "203.5", "20.39", "3.16")
    loops = {"viscous friction alone": plain, "with Coulomb friction": rubbing}
    for label, loop in loops.items():
        fitted = cid.fit_loop(loop, record, coloured=False)
        values, errors = in_newtons(fitted)
        line(label, *(pm(v, e) for v, e in zip(values, errors, strict=True)))
    meet = (20.39 - values[2]) / (values[1] - 203.5)
    parts = [
        in_newtons(cid.fit_loop(rubbing, part, coloured=False))[0]
        for part in record.split(0.25, 0.5, 0.75)
    ]
    spread = np.std(parts, axis=0, ddof=1) / np.sqrt(len(parts))
    line("mean of four quarters", *(
        pm(v, e) for v, e in zip(np.mean(parts, axis=0), spread, strict=True)
    ))  # fmt: skip
    loose = cid.fit_loop(rubbing, record)
    values, errors = in_newtons(loose)
    line("and a coloured random force", *(pm(v, e) for v, e in zip(values, errors, strict=True)))
    speed = np.diff(record.y) / record.dt
    print(
        f"  Published and fitted friction, Fv v + Fc, are equal at v = {meet:.3f} m/s; the carriage"
    )
    print(f"  moves at up to {speed.max():.3f} m/s, its root mean square is {speed.std():.3f} m/s.")
    print(f"  The random force has a time constant of {loose.estimate.force_time:.2f} s.")
    return fitted


def in_newtons(fitted: cid.LoopFit) -> tuple[np.ndarray, np.ndarray]:
    """Return mass, viscous friction and the forces with their standard errors.

    Effects are accelerations; a force is that times the mass.
    """
    e = fitted.estimate
    m = e["m"]
    slope = np.eye(len(e.names))
    slope[2:, 2:] *= m
    slope[2:, 0] = e.values[2:]
    values = np.concatenate([e.values[:2], m * e.values[2:]])
    return values, np.sqrt(np.diag(slope @ e.covariance @ slope.T))


def servo() -> list[cid.LoopFit]:
    """Fit integrator, lag and gain, then friction and the offset of the drive, to two records.

    The sensor picks up the mains, 60 Hz: no white noise, as `fit_loop` supposes. It gets every
    tenth sample and the mean input between, where the hum counts for less; `fit_continuous` models
    what it can of the noise and takes all samples.
    """
    print("Servo of a ball-and-beam rig: y'' = -a y' + b (u - u0) - fc sign(y')")
    line("", "a [1/s]", "b [1/s^2]", "2nd pole [1/s]", "fc/b [V]", "u0 [V]",
         widths=(30, 16, 16, 18, 14, 14))  # fmt: skip
    fits = []
    for name in ("servo_random_steps", "servo_swept_sine"):
        record = cid.datasets.load(name)
        label = name.removeprefix("servo_").replace("_", " ")
        e = cid.fit_continuous(record, 2).estimate
        k = int(np.argmax(e.poles.real))
        free = pm(e.poles[k].real, e.poles_standard_errors[k], 2)
        e = cid.fit_continuous(record, 2, constraints=[cid.Integrator()]).estimate
        line(f"{label}, linear", pm(e["a1"], e.standard_errors[0]),
             pm(e["b1"], e.standard_errors[2]), free, widths=(30, 16, 16, 18, 14, 14))  # fmt: skip
        record = average_input(record, 10)
        loop = cid.Loop(
            cid.plants.servo(m=1.0, c=30.0, k=180.0), None, dt=record.dt, free=("c", "k"),
            at=cid.OperatingPoint((0.0, 0.0), 0.0, 0.0),
            effects=(effects.CoulombFriction(30.0), effects.ConstantForce(-50.0)),
        )  # fmt: skip
        fitted = cid.fit_loop(loop, record, coloured=False)
        e = fitted.estimate
        se = e.standard_errors
        line(f"{label}, with friction", pm(e["c"], se[0]), pm(e["k"], se[1]), "0 (integrator)",
             pm(e.values[2] / e["k"], se[2] / e["k"], 2),
             pm(-e.values[3] / e["k"], se[3] / e["k"], 2),
             widths=(30, 16, 16, 18, 14, 14))  # fmt: skip
        fits.append(fitted)
    return fits


RIGS = {"magnetoshield": magnetoshield, "inteco": inteco, "emps": emps, "servo": servo}


def run(rigs: dict[str, Callable[[], object]], about: str) -> None:
    """Print the tables of the rigs that the command line names, by default of all."""
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("rigs", nargs="*", default=list(rigs), help=", ".join(rigs))
    for name in parser.parse_args().rigs:
        rigs[name]()
        print(flush=True)


if __name__ == "__main__":
    run(RIGS, __doc__)
