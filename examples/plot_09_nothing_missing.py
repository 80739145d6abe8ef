r"""
Nothing is missing, and what the record would have shown
========================================================

The best verdict of a diagnosis is that the model is right. "Nothing missing" alone means little,
because a short or noisy record shows nothing either. So the report adds how large each effect would
have to be in order to be seen in this record.
"""

import control as ct
import matplotlib.pyplot as plt

import ctrlid as cid

# %%
# A model with a wrong parameter
# ------------------------------
# The plant is the levitated ball, with K known to 5 %. The rig differs from the model in K only. A
# random force acts on the ball, and the sensor is noisy.

plant = cid.plants.maglev(m=0.0213, K=3.34e-6, g=9.81)
at = cid.operating_point(plant, output=0.012)
lead = cid.design_lead(cid.linearize(plant, at), crossover=110, phase_margin=50)
C = ct.sample_system(ct.ss(lead), 0.002, "tustin")
model = cid.Loop(plant, C, dt=0.002, at=at, free=("K",))
rig = model.with_parameters({"K": 1.05 * 3.34e-6})
r = cid.random_binary(6000, amplitude=2e-4, hold=20, around=at.output, seed=5)
record = cid.simulate(rig, r, sensor_noise=5e-6, force_noise=0.05, seed=6)

# %%
# The verdict
# -----------
# The model as given does not explain the record. With K fitted, its gap is the noise floor. A wrong
# value of K is not reported as a missing effect.

found = cid.diagnose(model, record, progress=False)
print(found)
cid.plot.diagnosis(found)
plt.show()

# %%
# A check of one number
# ---------------------
# Would the record really have shown a lag of the actuator? To check this, a lag with three times
# the smallest visible time constant is hidden in a new record.

smallest = found.sensitivity["ActuatorLag.tau"]
lagging = rig.with_effect(cid.effects.ActuatorLag(tau=3 * smallest))
again = cid.simulate(lagging, r, sensor_noise=5e-6, force_noise=0.05, seed=7)
caught = cid.diagnose(model, again, catalogue=[cid.effects.ActuatorLag], progress=False)
print(f"visible from {1e6 * smallest:.0f} us; hidden {3e6 * smallest:.0f} us; found {caught}")

# %%
# This story asserts that nothing is named, that K is right, that the gap is the noise floor, and
# that a lag three times as large as the smallest visible one is found.

K = found.calibrated[0]
print(f"gap {1e6 * found.gap.after:.2f} um, floor {1e6 * found.gap.floor:.2f} um")
assert found.verdict == "nothing missing"
assert abs(K.after / (1.05 * 3.34e-6) - 1) < 0.005
assert found.gap.after < 1.05 * found.gap.floor
assert smallest < 2e-4
assert [finding.name for finding in caught.findings] == ["ActuatorLag"]
