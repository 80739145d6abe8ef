r"""
Start here: the failure everyone meets first
============================================

You have a log of an unstable plant under feedback, and you do what works with stable plants:
simulate the model from the recorded input, and fit a difference equation by least squares. With an
unstable plant both fail, and neither says why. This story shows the two failures, their causes and
the cure.
"""

import control as ct
import matplotlib.pyplot as plt
import numpy as np

import ctrlid as cid

# %%
# The experiment
# --------------
# A ball is levitated under a magnet, with a digital lead compensator at 1 kHz. The reference jumps
# at random by 0.1 mm to either side. The position sensor has a noise of 10 micrometres. The log
# lasts 45 s. Since the log is simulated, the true unstable pole is known: it is at sqrt(2 g/x0).

plant = cid.plants.maglev(m=0.0213, K=3.34e-6, g=9.81)
op = cid.operating_point(plant, output=0.012)
P = cid.linearize(plant, op)
dt = 0.001
C = cid.design_lead(ct.sample_system(P, dt), crossover=80.0, phase_margin=45.0)
loop = cid.Loop(plant, C, dt=dt, at=op)
r = cid.random_binary(45_000, amplitude=1e-4, hold=20, around=op.output, seed=1)
record = cid.simulate(loop, r, sensor_noise=1e-5, seed=2)
true_pole = float(P.poles().real.max())
print(record)
print(f"true poles: +-{true_pole:.2f} rad/s")

# %%
# Failure one: simulating the plant from the recorded input
# ---------------------------------------------------------
# We take the *exact* physics, the *exact* initial state and the recorded voltage. The only error is
# that of the log, in which the voltage is rounded to a microvolt.

logged = np.round(record.u, 6)
open_loop = cid.Loop(plant, None, dt=dt, at=op)
try:
    cid.simulate(open_loop, d=logged - op.input)
except cid.CtrlidError as refusal:
    print(refusal)

# %%
# ctrlid stops the simulation when the ball is a thousand gaps away. Until then:

simulated = cid.simulate(open_loop, d=logged[:2000] - op.input)
error = np.abs(simulated.y - record.y[:2000])
lost = int(np.argmax(error > 1e-3))
print(f"off by more than 1 mm after {lost * dt:.3f} s")
print(f"after {simulated.duration:.0f} s the simulated ball is {simulated.y[-1]:.1f} m down")

# %%
# An error of a microvolt is enough. It grows as exp(p t) with the unstable pole p, by a factor of e
# every 25 ms, and nothing corrects it. In the experiment, feedback did, but it acted on the
# *measured* gap, not on the simulated one. No model is good enough to pass this test, so the test
# cannot tell a good model from a bad one.

# %%
# Failure two: plain least squares
# --------------------------------
# The usual difference equation with two poles is fitted by least squares:

free = cid.fit_arx(record, na=2, nb=2)
print(free.estimate)

# %%
# Least squares returns a **stable** model of an unstable plant. The last line of the report says
# that. The standard errors give no warning: they are small, and they are wrong. There are two
# causes.
#
# - The sampling is too fast. In 1 ms the ball hardly moves. From one sample to the next, the sensor
#   noise is much larger than the motion due to the unstable pole, and the fit describes the noise.
# - The loop is closed. The noise passes through the controller into the input, so input and noise
#   are correlated, and more data do not remove the bias.
#
# In z the poles look only slightly wrong; in rad/s the size of the error is visible:

print("poles found [rad/s]:", free.estimate.poles_s.round(1))

# %%
# The cure
# --------
# **First, use an estimator that is consistent under feedback.** `fit_iv` uses the logged reference
# as an instrument: the sensor noise reaches u and y, but never r. With the same record, the same
# two poles and no constraint:

iv = cid.fit_iv(record, na=2, nb=2)
print("poles found [rad/s]:", iv.estimate.poles_s.real.round(1))

# %%
# **Second, use what you know for certain.** The poles of a levitated ball are +p and -p. After
# sampling they are z and 1/z, so a2 = 1. That is the constraint `ReciprocalPoles`. With it there
# are fewer free coefficients, and the standard errors are smaller:

model = cid.fit_iv(record, na=2, nb=2, constraints=[cid.ReciprocalPoles()])
print(model.estimate)

# %%
# The constraint alone is not enough. Least squares with it ends on the bound of the constraint. The
# report says so, because it is a symptom of bias:

stuck = cid.fit_arx(record, na=2, nb=2, constraints=[cid.ReciprocalPoles()])
print("\n".join(str(stuck.estimate).splitlines()[-3:]))

# %%
# If the reference was not logged, **sample more slowly**: `Record.decimate` filters the noise and
# keeps every q-th sample. Choose q so that the unstable pole times the sampling period is about 0.2
# to 0.5. (The filtered input is no longer held between the slow samples and acts without delay,
# hence ``nk=0`` and one more b.) With the constraint, least squares then comes close:

slow = record.decimate(8)
print(f"pole times sampling period: {true_pole * record.dt:.3f} -> {true_pole * slow.dt:.3f}")
slower = cid.fit_arx(slow, na=2, nb=3, nk=0, constraints=[cid.ReciprocalPoles()])
print("poles found [rad/s]:", slower.estimate.poles_s.real.round(1))

# %%
# **Third, validate by prediction or in closed loop, never in open loop.** `compare` does both,
# labels each curve as prediction or simulation, and tests the residuals.

comparison = cid.compare(record, loop)
print(comparison)

# %%
# The error of the one-step prediction is as large as the sensor noise, and it is white: the
# physics explains the record.
#
# In one picture
# --------------

plt.rcParams.update(cid.plot.style())
fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
start = slice(0, 900)
left.semilogy(1e3 * record.t[start], 1e3 * error[start], color="0.6", lw=0.8,
              label="of the simulation")  # fmt: skip
growth = error[lost] * np.exp(true_pole * dt * (np.arange(900) - lost))
left.semilogy(1e3 * record.t[start], 1e3 * growth, "k--", label="growing like exp(p t)")
left.axhline(1e3 * op.output, color="k", ls=":", lw=1)
left.text(5, 1.3e3 * op.output, "the whole gap")
left.set(xlabel="time [ms]", ylabel="error of the gap [mm]", ylim=(1e-4, 1e3),
         title="Open-loop simulation of the exact model")  # fmt: skip
left.legend(loc="lower right", fontsize=8)

right.axvline(0, color="0.6", lw=1)
right.axvline(true_pole, color="k", lw=1, ls=":")
right.axvline(-true_pole, color="k", lw=1, ls=":")
fits = {
    "plain\nleast squares": free,
    "constrained\nleast squares": stuck,
    "constrained\nleast squares, 8 ms": slower,
    "instruments": iv,
    "constrained\ninstruments": model,
}
for row, fit in enumerate(fits.values()):
    right.plot(fit.estimate.poles_s.real, np.full(2, row), "ko", ms=8, mfc="none")
right.set(xlabel="real part of the pole [rad/s]", xlim=(-100, 60), ylim=(4.5, -0.5),
          yticks=range(5), yticklabels=fits, title="Poles found (dotted: the truth)")  # fmt: skip
plt.show()

# %%
# (The second pole of plain least squares is far out to the left, beyond the edge of the picture.)
#
# This story asserts that plain least squares finds no unstable pole, and that with instruments and
# the constraint the same record gives it to 1 %.

assert np.abs(free.estimate.poles).max() < 1
assert abs(model.estimate.poles_s.real.max() / true_pole - 1) < 0.01
