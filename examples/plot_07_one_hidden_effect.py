r"""
One hidden effect, named and then used
======================================

A ball is levitated, and simulation and record disagree. The model does not have the lag of the
amplifier, whose time constant is two milliseconds. `diagnose` finds the lag in the record. The end
of the story shows the benefit in a redesign: one lead is designed without the lag and one with it,
and both are tried on the rig.
"""

import control as ct
import matplotlib.pyplot as plt

import ctrlid as cid

# %%
# The model
# ---------
# The model consists of the physics, a digital lead at 2 ms, and an operating point 12 mm below the
# magnet. The force constant K is uncertain, so it is named in `free`.

plant = cid.plants.maglev(m=0.0213, K=3.34e-6, g=9.81)
at = cid.operating_point(plant, output=0.012)
lead = cid.design_lead(cid.linearize(plant, at), crossover=110, phase_margin=50)
C = ct.sample_system(ct.ss(lead), 0.002, "tustin")
model = cid.Loop(plant, C, dt=0.002, at=at, free=("K",))

# %%
# The rig
# -------
# On the rig K is 5 % larger, and the amplifier has a lag. The rig is used only to make the record
# and, at the end, to try the controllers.

TAU = 0.002
rig = model.with_parameters({"K": 1.05 * 3.34e-6})
rig = rig.with_effect(cid.effects.ActuatorLag(tau=TAU))
r = cid.random_binary(6000, amplitude=2e-4, hold=20, around=at.output, seed=1)
record = cid.simulate(rig, r, sensor_noise=5e-6, seed=2)

# %%
# What is missing
# ---------------
# `diagnose` first fits K. Then it looks for the effect that explains the remaining error.

found = cid.diagnose(model, record, progress=False)
print(found)

# %%
# The upper part of the figure shows the samples kept back: measured, and simulated before and
# after. The lower part shows where the one-step errors are larger than noise, and how much each
# candidate of the catalogue would have explained.

cid.plot.diagnosis(found)
plt.show()

# %%
# What the name is worth
# ----------------------
# We want a faster loop: 180 rad/s with 45 degrees. `redesign` designs the lead on a model and tries
# it on the rig. One design uses the recalibrated model without the lag, the other the diagnosed
# model.

recalibrated = {c.name: c.before for c in found.calibrated}
naive = cid.redesign(model.with_parameters(recalibrated).linearize(), rig, 180, 45)
named = cid.redesign(found.loop.linearize(), rig, 180, 45)
print("without the lag:", naive.verdict)
print("with the lag:   ", named.verdict)

cid.plot.step({"lead designed without the lag": naive, "lead designed with the lag": named})
plt.show()

# %%
# This story asserts that the lag and nothing else is named, that its time constant is right within
# three standard errors, that the gap decreases to the noise floor, and that the promised phase
# margin is achieved only with the lag in the model.

print(f"gap {1e6 * found.gap.before:.1f} um before, {1e6 * found.gap.after:.2f} um after, "
      f"floor {1e6 * found.gap.floor:.2f} um")  # fmt: skip
lag = found.findings[0]
assert [finding.names for finding in found.findings] == [("ActuatorLag",)]
assert abs(lag.effect.tau - TAU) < 3 * lag.standard_errors["tau"]
assert found.gap.before > 5 * found.gap.floor
assert found.gap.after < 1.05 * found.gap.floor
assert abs(named.achieved.phase_margin - 45) < 1
assert naive.achieved.phase_margin < 30
