r"""
A servo with dry friction and an offset
=======================================

The data are two public records of the drive of a ball-and-beam rig in closed loop, with a swept
sine and with random steps. The plant is an integrator, the sampling rate is 1 kHz, and all signals
are in volts. The given model is ``y" = -a y' + b u``, with viscous friction only. Publications
report dry friction of 0.15 to 0.46 V and an offset of the input of 0.75 V.

The records are not part of ctrlid. They are downloaded once, or read from the folder that the
environment variable CTRLID_DATA_DIR names.
"""

import control as ct
import matplotlib.pyplot as plt
import numpy as np

import ctrlid as cid
from ctrlid.validation.sampling_sweep import average_input

# %%
# Mains hum in the sensor
# -----------------------
# A line at 60 Hz is the largest fast noise of the sensor. So `diagnose` is given every tenth
# sample, with the mean of the input in between, where the line matters less.

record, other = (
    average_input(cid.datasets.load(f"servo_{k}"), 10) for k in ("swept_sine", "random_steps")
)


def rates(t, x, u, p):
    """Return speed and acceleration."""
    return np.array([x[1], p["b"] * u[0] - p["a"] * x[1]])


plant = ct.nlsys(rates, lambda t, x, u, p: x[0], inputs=["u"], outputs=["y"], states=["y", "v"],
                 params={"a": 27.0, "b": 160.0}, name="drive")  # fmt: skip
rest = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
model = cid.Loop(plant, None, dt=record.dt, at=rest, free=("a", "b"))

# %%
# What is missing?
# ----------------
# `diagnose` finds two things. One is a line in the reading at 40.03 Hz, or 60 Hz folded at the
# sampling rate of 100 Hz: the hum of the mains, whose name stands. The other is dry friction that
# is stronger in one direction, with an evidence far above all others. On this plant it is the same
# as symmetric dry friction with a constant force, and no record of u and y can tell them apart. Its
# size differs between stretches of the record, so its name does not stand: it may stand in for a
# friction that the catalogue does not have. The residuals are not noise, and the search ends at its
# bound before it is finished. The difference between the directions is near the published offset.

found = cid.diagnose(model, record, validation=other, progress=False)
print(found)

cid.plot.diagnosis(found)
plt.show()

# %%
# In volts
# --------

b = found.loop.parameters["b"]
volts = {
    finding.name: {name: value / b for name, value in finding.effect.values().items()}
    for finding in found.added
    if "Friction" in finding.name
}
for name, sizes in volts.items():
    print(name, ", ".join(f"{size} {v:.2f} V" for size, v in sizes.items() if size != "vs"))
print(f"gap {found.gap.given:.3f} V as given, {found.gap.after:.3f} V with the effects, "
      f"floor {found.gap.floor:.3f} V")  # fmt: skip

# %%
# The hum at 1 kHz
# ----------------
# The record as it was logged shows the same line where it is, at 60 Hz, and as large.

raw = cid.datasets.load("servo_swept_sine")
window = np.hanning(raw.n)
spectrum = 2 * np.abs(np.fft.rfft((raw.y - raw.y.mean()) * window)) / window.sum()
frequency = np.fft.rfftfreq(raw.n, raw.dt)
fast = frequency > 50
line = frequency[fast][np.argmax(spectrum[fast])]
print(f"the largest line above 50 Hz: {1e3 * spectrum[fast].max():.0f} mV at {line:.2f} Hz")

(hum,) = found.findings
assert hum.name == "SensorHum"
assert abs(1 / record.dt - hum.effect.frequency - line) < 0.02
assert 0.7 < hum.effect.amplitude / spectrum[fast].max() < 1.3
assert found.stand_ins[0].name == "AsymmetricCoulombFriction"
assert abs(volts["AsymmetricCoulombFriction"]["difference"] - 0.75) < 0.15
assert found.gap.after < found.gap.given
