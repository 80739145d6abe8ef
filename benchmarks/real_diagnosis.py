"""What `diagnose` finds on real records, with the force error of EMPS that its literature quotes.

Run it as ``python benchmarks/real_diagnosis.py`` (``emps``, ``magnetoshield``, ``tanks``, ``servo``
for some of them; INTECO has a story of its own, ``examples/real_inteco.py``). The records are
fetched once, or read from the folder named by CTRLID_DATA_DIR. About five minutes in all.
"""

from __future__ import annotations

import control as ct
import numpy as np
from real_records import run
from scipy import signal

import ctrlid as cid
from ctrlid import effects
from ctrlid.diagnosis.fresh import fresh_data
from ctrlid.diagnosis.gap import FEW_STEPS, ROUGH, drive
from ctrlid.diagnosis.trial import base_model
from ctrlid.sampling import averaged
from ctrlid.simulation import Simulator

GAIN = 35.15065  # N/V, of the EMPS drive
BAND = 50.0  # Hz, in which its forces are compared


def force_error(loop: cid.Loop, record: cid.Record) -> float:
    """Return the relative RMS error of the simulated drive force, in per cent, below 50 Hz."""
    simulator = Simulator(loop, ROUGH, FEW_STEPS)
    z, r, d = drive(simulator, record)
    u = simulator.run(z, r, d)[1]
    b, a = signal.butter(4, 2 * BAND * record.dt)
    error, size = (signal.filtfilt(b, a, GAIN * v)[500:] for v in (record.u - u, record.u))
    return float(100 * np.sqrt(np.sum(error**2) / np.sum(size**2)))


def inverse_error(loop: cid.Loop, record: cid.Record) -> float:
    """Return the relative RMS error of the inverse model, in per cent, below 50 Hz.

    The drive force that measured position, speed and acceleration ask for, against the measured
    one; both smoothed by the same filter forwards and backwards, at the ends left out.
    """
    e = loop.equations()
    sections = signal.butter(4, BAND, fs=1 / record.dt, output="sos")
    q = signal.sosfiltfilt(sections, record.y)
    v = np.gradient(q, record.dt)
    u = np.asarray(record.u)
    x = np.zeros((len(e.states), len(q)))
    x[0], x[1] = q, v
    rate = e.function.map(len(q))(record.t[None, :], x, u[None, :], e.values)[0]
    mass = loop.parameters["m"]
    off = mass * signal.sosfiltfilt(sections, np.gradient(v, record.dt) - np.asarray(rate)[1])
    force = signal.sosfiltfilt(sections, GAIN * u)
    inner = slice(100, -100)
    return float(100 * np.linalg.norm(off[inner]) / np.linalg.norm(force[inner]))


def emps() -> None:
    """Diagnose mass with viscous friction; compare forces on the record with pulses."""
    record, pulses = (cid.datasets.load(name) for name in ("emps", "emps_pulses"))
    rest = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
    C = cid.PID(kp=254.49 * 159.86, kd=254.49, bias=0.0, derivative="measurement")
    model = cid.Loop(cid.plants.servo(m=95.0, c=200.0, k=GAIN), C, dt=record.dt, at=rest,
                     free=("m", "c"))  # fmt: skip
    found = cid.diagnose(model, record, validation=pulses, progress=False)
    print(found)
    published = model.with_parameters({"m": 95.11, "c": 203.5})
    for effect in (effects.CoulombFriction(20.39 / 95.11), effects.ConstantForce(3.16 / 95.11)):
        published = published.with_effect(effect)
    # The phase of a ripple is private to a record.
    fitted = base_model(found.loop, [record], ())
    (moved,) = fresh_data(model, [], [pulses]).loops(fitted)
    print(
        "\nforce error below 50 Hz [%]          estimation      pulses   inverse model, estimation"
    )
    for name, there, here in (("published symmetric model", published, published),
                              ("with the effects", found.loop, moved)):  # fmt: skip
        print(f"  {name:<30}{force_error(there, record):14.2f}{force_error(here, pulses):12.2f}"
              f"{inverse_error(there, record):28.2f}")  # fmt: skip


def magnetoshield() -> None:
    """Diagnose a magnet as if it were a ball of iron; compare at another set-point."""
    records = cid.datasets.load("magnetoshield_r3")
    plant = cid.plants.maglev(m=0.000945, K=0.000945 * 9.81 * 0.014**2 / 5.0**2)
    at = cid.operating_point(plant, output=0.014)
    model = cid.Loop(plant, None, dt=records[0].dt, at=at, free=("K",))
    print(cid.diagnose(model, records[0], validation=records[3], progress=False))


def tanks() -> None:
    """Diagnose two tanks with square-root outflow; compare on the validation record."""

    def rates(t: float, x: np.ndarray, u: np.ndarray, p: dict[str, float]) -> np.ndarray:
        upper, lower = np.sqrt(np.maximum(x, 1e-6))
        return np.array([p["k4"] * u[0] - p["k1"] * upper, p["k1"] * upper - p["k3"] * lower])

    plant = ct.nlsys(rates, lambda t, x, u, p: x[1], inputs=["u"], outputs=["y"],
                     states=["h1", "h2"], params={"k1": 0.05, "k3": 0.05, "k4": 0.05},
                     name="two tanks")  # fmt: skip
    at = cid.operating_point(plant, output=6.0)
    record, other = (cid.datasets.load(f"tanks_{k}") for k in ("estimation", "validation"))
    model = cid.Loop(plant, None, dt=record.dt, at=at, free=("k1", "k3", "k4"))
    print(cid.diagnose(model, record, validation=other, progress=False))


def servo() -> None:
    """Diagnose a drive with viscous friction at 10 ms, where the hum of its sensor is less."""
    record, other = (
        averaged(cid.datasets.load(f"servo_{k}"), 10) for k in ("swept_sine", "random_steps")
    )
    rest = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
    plant = cid.plants.servo(m=1 / 160, c=27 / 160, k=1.0)
    model = cid.Loop(plant, None, dt=record.dt, at=rest, free=("k", "c"))
    print(cid.diagnose(model, record, validation=other, progress=False))


RIGS = {"emps": emps, "magnetoshield": magnetoshield, "tanks": tanks, "servo": servo}


if __name__ == "__main__":
    run(RIGS, __doc__)
