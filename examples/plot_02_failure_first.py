r"""
Start here: the failure everyone meets first
============================================

You have a log of an unstable plant under feedback, and you do what has always worked: simulate
the model from the recorded input, and fit a difference equation by least squares. With an
unstable plant both fail, and neither says why. This page shows the two failures, their causes and
the cure.
"""

import control as ct
import matplotlib.pyplot as plt
import numpy as np

import ctrlid as cid

# %%
# The experiment
# --------------
# A ball levitated under a magnet, with a digital lead compensator at 1 kHz. The reference jumps at
# random by 0.1 mm to either side. The position sensor has a noise of 10 micrometres. The log lasts
# 45 s. Since we made the log ourselves, we know the truth: an unstable pole at sqrt(2 g/x0).

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
# We take the *exact* physics, the *exact* initial state and the recorded voltage. The only flaw:
# the log keeps the voltage to six digits behind the point, that is to a microvolt.

logged = np.round(record.u, 6)
open_loop = cid.Loop(plant, None, dt=dt, at=op)
try:
    cid.simulate(open_loop, d=logged - op.input)
except cid.CtrlidError as refusal:
    print(refusal)

# %%
# ctrlid stops when the ball is a thousand gaps away. Up to then:

simulated = cid.simulate(open_loop, d=logged[:2000] - op.input)
error = np.abs(simulated.y - record.y[:2000])
lost = int(np.argmax(error > 1e-3))
print(f"off by more than 1 mm after {lost * dt:.3f} s")
print(f"after {simulated.duration:.0f} s the simulated ball is {simulated.y[-1]:.1f} m down")

# %%
# A microvolt is enough. An error grows like exp(p t) with the unstable pole p, by a factor of e
# every 25 ms, and nothing pulls it back: the feedback that did so in the experiment acted on the
# *measured* gap, not on the simulated one. No model is good enough to pass this test, so the test
# cannot tell a good model from a bad one.

# %%
# Failure two: plain least squares
# --------------------------------
# The usual difference equation with two poles, fitted by least squares:

free = cid.fit_arx(record, na=2, nb=2)
print(free.estimate)

# %%
# Least squares returns a **stable** model of a plant that is not. The report says so in capitals.
# The standard errors are no help: they are small, and they are wrong. Two causes work together.
#
# - The sampling is too fast. In 1 ms the ball hardly moves. Over one sample the sensor noise is
#   much larger than what the unstable pole does, and the fit describes the noise.
# - The loop is closed. The noise passes through the controller into the input, so input and noise
#   are correlated, and more data do not average that away.
#
# The unit circle hides the size of the error; in rad/s it is plain to see:

print("poles found [rad/s]:", free.estimate.poles_s.round(1))

# %%
# The cure
# --------
# **First, take an estimator that is made for feedback.** `fit_iv` uses the logged reference as an
# instrument: the sensor noise reaches u and y, but never r. The same record, the same two poles,
# and nothing else said:

iv = cid.fit_iv(record, na=2, nb=2)
print("poles found [rad/s]:", iv.estimate.poles_s.real.round(1))

# %%
# **Second, say what you know for certain.** The poles of a levitated ball are +p and -p. Sampled
# they are z and 1/z, so a2 = 1. That is the constraint `ReciprocalPoles`. It leaves the data
# fewer ways to be wrong, and the standard errors become smaller:

model = cid.fit_iv(record, na=2, nb=2, constraints=[cid.ReciprocalPoles()])
print(model.estimate)

# %%
# The constraint alone is no cure. Least squares with it ends on the bound of the constraint, which
# is reported as the symptom that it is:

stuck = cid.fit_arx(record, na=2, nb=2, constraints=[cid.ReciprocalPoles()])
print("\n".join(str(stuck.estimate).splitlines()[-3:]))

# %%
# And if the reference was not logged? Then **sample more slowly**: `Record.decimate` filters the
# noise and thins out the record, until the unstable pole times the sampling period is about 0.2
# to 0.5. (The filtered input is no longer held between the slow samples; it acts at once, hence
# ``nk=0`` and one more b.) With the constraint, least squares then comes close:

slow = record.decimate(8)
print(f"pole times sampling period: {true_pole * record.dt:.3f} -> {true_pole * slow.dt:.3f}")
slower = cid.fit_arx(slow, na=2, nb=3, nk=0, constraints=[cid.ReciprocalPoles()])
print("poles found [rad/s]:", slower.estimate.poles_s.real.round(1))

# %%
# **Third, validate by prediction or in closed loop, never open loop.** `compare` does that, labels
# each curve as prediction or simulation, and tests what is left over.

comparison = cid.compare(record, loop)
print(comparison)

# %%
# The one-step prediction is wrong by the sensor noise and no more, and its errors are white: the
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
# What this story asserts: plain least squares finds no unstable pole; with instruments and the
# constraint the same record gives it to 1 %.

assert np.abs(free.estimate.poles).max() < 1
assert abs(model.estimate.poles_s.real.max() / true_pole - 1) < 0.01
