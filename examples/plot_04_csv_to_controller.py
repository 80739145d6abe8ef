r"""
Tutorial: from a CSV log to a redesigned controller
===================================================

You have a levitation rig that works, a CSV file that its data logger wrote, and the wish for a
better controller. This tutorial goes all the way: read the log, look at it, write down what you
know, fit, validate, redesign, and see what the new controller achieves.
"""

import tempfile
from pathlib import Path

import control as ct
import matplotlib.pyplot as plt
import numpy as np

import ctrlid as cid

# %%
# Before we start: making the log
# -------------------------------
# This manual has no rig. So we simulate one, write the file as a data logger would (rounded to 0.1
# micrometre and a tenth of a millivolt), and then pretend that the file is all we have. Skip this
# block if you have a log of your own.

path = Path(tempfile.mkdtemp()) / "levitation.csv"
dt = 0.005
lead_on_the_rig = ct.tf([-2605.0, 2305.0], [1.0, -0.1957], dt)


def write_log():
    """Simulate the rig and write what its logger writes."""
    rig = cid.plants.maglev(m=0.0213, K=3.34e-6)
    at = cid.operating_point(rig, output=0.012)
    r = cid.random_binary(6000, amplitude=1e-4, hold=8, around=0.012, seed=1)
    log = cid.simulate(cid.Loop(rig, lead_on_the_rig, dt=dt, at=at), r, sensor_noise=3e-6, seed=2)
    columns = np.column_stack([log.t, log.r, log.u, log.y])
    header = "time [s],setpoint [m],voltage [V],gap [m]"
    np.savetxt(path, columns, fmt=["%.3f", "%.7f", "%.4f", "%.7f"], delimiter=",",
               header=header, comments="")  # fmt: skip


write_log()
print("\n".join(path.read_text().splitlines()[:4]))

# %%
# 1. Read the log
# ---------------
# `Record.from_csv` needs the names of the columns. It finds the sampling period from the time
# column and would complain about gaps, jitter or a clock that runs backwards. Units in brackets
# are kept.

record = cid.Record.from_csv(path, r="setpoint", u="voltage", y="gap", time="time")
print(record)

# %%
# All values are absolute: metres and volts as logged, no means removed. ctrlid needs it that way,
# since an operating point is a matter of absolute values.
#
# 2. Look at it
# -------------
# The gap stays within a fraction of a millimetre of 12 mm, so a linear model is a fair
# description. And the reference moves all the time; without that, nothing could be learnt in
# closed loop.

fig, axes = plt.subplots(2, 1, figsize=(8, 4.6), sharex=True, layout="constrained")
cid.plot.record(record.between(0, 1), axes)
plt.show()

# %%
# 3. Write down what you know
# ---------------------------
# The ball hangs at 12 mm. Then physics gives the poles without any fit, mass and magnet constant
# unknown: +p and -p, with p the square root of 2 g / x0.

expected = np.sqrt(2 * 9.81 / record.y.mean())
print(f"expected p = {expected:.2f} rad/s, p times sampling period = {expected * dt:.2f}")

# %%
# The product is between 0.2 and 0.5: the sampling period suits. That there is one pole at +p and
# one at -p is the constraint `ReciprocalPoles`; see :doc:`/which_one_when` for other plants.
#
# 4. Fit
# ------
# The first half is for fitting, the second for validation. Two poles, two numerator coefficients.
# The reference is in the log, so `fit_iv` can use it as an instrument; without it, `fit_arx`.

fitting, validation = record.split(0.5)
G = cid.fit_iv(fitting, na=2, nb=2, constraints=[cid.ReciprocalPoles()])
print(G.estimate)

# %%
# What to look for in this report: a pole outside the unit circle; no active bound; poles near the
# expected ones, within two standard errors. Nothing is in capitals. For comparison, plain least
# squares without the constraint:

plain = cid.fit_arx(fitting, na=2, nb=2)
print("plain least squares, poles [rad/s]:", plain.estimate.poles_s.real.round(2))

# %%
# 5. Validate
# -----------
# A model in the form of a transfer function predicts a few samples ahead:

print(cid.compare(validation, G))

# %%
# The tests find the errors not white. That is expected of a transfer function with sensor noise:
# it predicts as if the noise came in at the plant's equation. The physics in its own loop has no
# such trouble. For a known mass even the magnet constant K follows from the log: over a long time
# the mean acceleration is zero, so the mean of K V^2/x^2 is the weight. (The mean of the
# *square*: the square of the mean voltage is less, and would be wrong by the variance of the
# voltage.)

m = 0.0213
plant = cid.plants.maglev(m=m, K=m * 9.81 / np.mean(record.u**2 / record.y**2))
loop = cid.Loop(plant, lead_on_the_rig, dt=dt, at=cid.operating_point(plant, output=0.012))
comparison = cid.compare(validation, loop)
print(comparison)
fig, ax = plt.subplots(figsize=(8, 3.8), layout="constrained")
cid.plot.comparison(comparison, ax)
plt.show()

# %%
# Prediction and closed-loop simulation agree with the log to within the sensor noise.
#
# 6. Redesign
# -----------
# What is wrong with the old controller? Its margins on the model tell:

old = cid.loop_margins(lead_on_the_rig * G)
rest = float((lead_on_the_rig * G / (1 + lead_on_the_rig * G))(1).real)
print(f"phase margin {old.phase_margin:.1f} deg at {old.crossover:.1f} rad/s")
print(f"loop gain may fall to {old.gain_reduction_margin:.2f} of its value")
print(f"at rest the ball moves {rest:.2f} mm per mm of reference")

# %%
# The loop gain is too low: a third less and the ball falls, and a step of the reference is
# overdone threefold. So we ask for a faster loop. `redesign` designs the lead on the fitted model
# G and tries it on the nonlinear physics.

result = cid.redesign(G, loop, crossover=140.0, phase_margin=40.0)
print(result)

# %%
# The promise holds. The new controller, and what it does to a step of the reference:

print(result.controller)
n = 60
step = np.full(n, 0.0121)
before, after = cid.simulate(loop, step), cid.simulate(result.loop, step)

fig, ax = plt.subplots(figsize=(8, 3.4), layout="constrained")
ax.step(1e3 * before.t, 1e3 * before.y, "0.5", where="post", ls="--", lw=2,
        label="simulation, old controller")  # fmt: skip
ax.step(1e3 * after.t, 1e3 * after.y, "k", where="post", label="simulation, new controller")
ax.axhline(12.1, color="k", ls=":", lw=1, label="reference")
ax.set(xlabel="time [ms]", ylabel="gap [mm]",
       title="Step of the reference by 0.1 mm, nonlinear physics")  # fmt: skip
ax.legend(loc="lower right")
plt.show()

# %%
# What this story asserts: the fitted pole is within 1 % of the physics, and the new controller
# has the promised phase margin to within one degree.

assert abs(G.estimate.poles_s.real.max() / expected - 1) < 0.01
assert abs(result.achieved.phase_margin - 40) < 1
