r"""
Two hidden effects in one record
================================

A servo has dry friction in its bearings and a delay in its bus. Each would be easy to find alone.
Together they hide each other: fitted to such a record, the gain and the viscous friction of the
model take wrong values. `diagnose` names one effect and then the other, and with both in the model
the parameters are right.
"""

import matplotlib.pyplot as plt

import ctrlid as cid

# %%
# The model and the rig
# ---------------------
# The model is a mass with viscous friction under a digital PD controller at 5 ms. Its gain k and
# friction c are 5 % too low. The rig also has Coulomb friction, and a delay that is not a multiple
# of the sampling period.

FRICTION, DELAY = 0.8, 0.006
plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
at = cid.OperatingPoint(states=(0.0, 0.0), input=0.0, output=0.0)
model = cid.Loop(plant, cid.PID(kp=20.0, kd=1.0), dt=0.005, at=at, free=("k", "c"))
rig = model.with_parameters({"k": 3.15, "c": 2.1})
rig = rig.with_effect(cid.effects.CoulombFriction(fc=FRICTION))
rig = rig.with_effect(cid.effects.InputDelay(delay=DELAY))
r = cid.random_binary(5000, amplitude=0.1, hold=100, seed=1)
record = cid.simulate(rig, r, sensor_noise=2e-4, seed=2)

# %%
# Named one after the other
# -------------------------
# The second round of the search starts from the model with the first effect in it, and all
# parameters are refitted. The delay of the input may also be one of the output: on this plant no
# record can tell them apart.

found = cid.diagnose(model, record, progress=False)
print(found)
cid.plot.diagnosis(found)
plt.show()

# %%
# If one effect is left out
# -------------------------
# The same record is fitted with only one of the two effects in the model. The physical parameters
# are then wrong:

for name in [finding.name for finding in found.findings]:
    partial = cid.fit_loop(found.loop.without_effect(name), record)
    values = partial.loop.parameters
    print(f"without {name}: k = {values['k']:.3f}, c = {values['c']:.3f}; true 3.15 and 2.1")

# %%
# This story asserts that these two effects and no third are named, that both sizes and both
# parameters are right within half a percent, and that the gap decreases from more than twenty times
# the noise floor to the noise floor.

print(f"gap {1e3 * found.gap.before:.2f} mm before, {1e3 * found.gap.after:.3f} mm after, "
      f"floor {1e3 * found.gap.floor:.3f} mm")  # fmt: skip
named = {finding.name: finding for finding in found.findings}
assert found.verdict == "explained"
assert set(named) == {"CoulombFriction", "InputDelay"}
assert abs(named["CoulombFriction"].effect.fc / FRICTION - 1) < 0.005
assert abs(named["InputDelay"].effect.delay / DELAY - 1) < 0.005
for parameter, truth in zip(found.calibrated, (3.15, 2.1), strict=True):
    assert abs(parameter.after / truth - 1) < 0.005
assert found.gap.before > 20 * found.gap.floor
assert found.gap.after < 1.05 * found.gap.floor
