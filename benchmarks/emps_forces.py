"""Forces of the EMPS drive: the model that `diagnose` completes, beside the published one.

Run it as ``python benchmarks/emps_forces.py``. It first prints the diagnosis of the story
``examples/real_emps.py``, which takes some minutes. The records are downloaded once, or read
from the folder that the environment variable CTRLID_DATA_DIR names.
"""

from __future__ import annotations

import numpy as np
from scipy import signal

import ctrlid as cid
from ctrlid import effects
from ctrlid.diagnosis.fresh_data import choose_fresh_data
from ctrlid.diagnosis.gap import make_simulator
from ctrlid.diagnosis.recalibration import fit_base_model
from ctrlid.validation.record_simulation import prepare_stretch

GAIN = 35.15065  # N/V, of the EMPS drive
BAND = 50.0  # Hz, in which its forces are compared


def force_error(loop: cid.Loop, record: cid.Record) -> float:
    """Return the relative RMS error of the simulated drive force, in per cent, below 50 Hz."""
    simulator = make_simulator(loop)
    u = prepare_stretch(simulator, record, slice(0, len(record))).run(simulator)[1]
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


def main() -> None:
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
    fitted = fit_base_model(found.loop, [record], ())
    (moved,) = choose_fresh_data(model, [], [pulses]).prepare_loops(fitted)
    print("\nforce error below 50 Hz [%]          estimation      pulses   inverse model")
    for name, there, here in (("published symmetric model", published, published),
                              ("with the effects", found.loop, moved)):  # fmt: skip
        print(f"  {name:<30}{force_error(there, record):14.2f}{force_error(here, pulses):12.2f}"
              f"{inverse_error(there, record):16.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
