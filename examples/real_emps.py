r"""
EMPS: a carriage on a screw, and what its model lacks
=====================================================

The data are a public record of a positioning drive (Janot, Gautier and Brunot, *Data Set and
Reference Models of EMPS*, 2019): a carriage on a ball screw under PD control, whose reference has
four equal periods. The given model is the simplest one, mass and viscous friction. The authors
published Coulomb friction, and found in a separate study that the viscous friction is stronger in
one direction; `diagnose` is told neither. A second record, in which pulses are added to the input
of the drive, is used for the comparison only.

The records are not part of ctrlid. They are downloaded once, or read from the folder that the
environment variable CTRLID_DATA_DIR names.
"""

import matplotlib.pyplot as plt
import numpy as np

import ctrlid as cid

GAIN = 35.15065  # N/V, of the drive

record = cid.datasets.load("emps")
pulses = cid.datasets.load("emps_pulses")

# %%
# The model as given
# ------------------
# The model is ``m x" = k V - c x'``, with the uncertain parameters m and c. The controller was
# identified from the records: it has a gain on the position error and one on the measured velocity.

plant = cid.plants.servo(m=95.0, c=200.0, k=GAIN)
rest = cid.OperatingPoint(states=(0.0, 0.0), input=0.0, output=0.0)
C = cid.PID(kp=254.49 * 159.86, kd=254.49, bias=0.0, derivative="measurement")
model = cid.Loop(plant, C, dt=record.dt, at=rest, free=("m", "c"))

# %%
# What is missing?
# ----------------
# Because the reference is periodic, the differences between the periods are noise, whatever the
# model. With the variance of this noise, the effects are found in the order of their evidence. With
# noise fitted to the residuals, the slow effects would be taken for noise.

found = cid.diagnose(model, record, validation=pulses, progress=False)
print(found)

# %%
# The table has the fitted values in newtons beside the published ones. The ripple of 2.5 mm is not
# in the report of the benchmark. It is the force of a part that turns or rolls with the screw.

fitted, errors = found.loop.parameters, {f.name: f.standard_errors for f in found.findings}
m = fitted["m"]
friction, asymmetry, ripple = (
    next(f for f in found.findings if f.name == name)
    for name in ("CoulombFriction", "AsymmetricViscousFriction", "PositionRipple")
)
print(f"{'':34}{'here':>10}{'published':>12}")
print(f"{'mass [kg]':34}{m:10.2f}{95.11:12.2f}")
print(f"{'Coulomb friction [N]':34}{m * friction.effect.fc:10.2f}{20.39:12.2f}")
half = m * asymmetry.effect.difference
print(f"{'half difference of viscous [N s/m]':34}{abs(half):10.1f}{(240.4 - 166.7) / 2:12.1f}")
print(f"{'ripple [N]':34}{m * ripple.effect.amplitude:10.2f}{'-':>12}")
print(f"{'period of the ripple [mm]':34}{1e3 * ripple.effect.period:10.3f}{'-':>12}")

# %%
# The first finding is Coulomb friction. It is 13 % below the published value, and the viscous
# friction is correspondingly larger. There are two reasons: what is still missing biases both, and
# the likelihood weights fast motion more than the least squares of the publication did. The verdict
# is therefore "partly explained". On the record with pulses, which was not used for the fit, the
# gap of the closed-loop simulation decreases to a tenth.

cid.plot.diagnosis(found)
gap = found.gap
print(f"gap {1e6 * gap.given:.2f} um as given, {1e6 * gap.before:.2f} um recalibrated, "
      f"{1e6 * gap.after:.2f} um with the effects")  # fmt: skip
plt.show()

assert found.findings[0].name == "CoulombFriction"
assert found.verdict == "partly explained"
assert abs(m / 95.11 - 1) < 0.01
assert abs(ripple.effect.period - 2.5e-3) < 1e-5
assert gap.after < 2.8e-6 < gap.before
assert np.isfinite(gap.floor)
