r"""
A cart with a pole: two outputs, one force, and friction where it is
====================================================================

A cart of 0.5 kg balances a pole of 0.2 kg. Its position x and the angle theta of the pole are
measured, and a digital state feedback with an observer drives the cart. The cart that stands in the
laboratory has a bearing that rubs, of which the model knows nothing.
"""

import control as ct
import matplotlib.pyplot as plt
import numpy as np

import ctrlid as cid

DT = 0.005

# %%
# From physics to a controller
# ----------------------------
# `linearize` gives python-control what its designs need: a state-space model with the names of the
# states, from which ``ct.dlqr`` and ``ct.dlqe`` make a gain and an observer.

plant = cid.plants.cart_pole(M=0.5, m=0.2, length=0.3, J=0.006, c=0.2, gamma=0.002)
upright = cid.operating_point(plant, output=[0.0, 0.0])
G = ct.sample_system(cid.linearize(plant, upright), DT)
K = ct.dlqr(G, np.diag([20.0, 20.0, 1.0, 1.0]), np.eye(1))[0]
L = G.A @ ct.dlqe(G.A, G.B, G.C, np.eye(1), 1e-4 * np.eye(2))[0]
controller = ct.ss(G.A - L @ G.C, np.hstack([L, G.B]), -K, np.zeros((1, 3)), DT,
                   inputs=["x", "theta", "F"], outputs=["F"])  # fmt: skip

# The observer reads the outputs and the force by their names.
model = cid.Loop(plant, controller, dt=DT, at=upright, free=("m", "c"))
print(model)

# %%
# The experiment
# --------------
# Steps are added to the force of the controller. What is logged is the applied force and the two
# outputs with the noise of their encoders; here it is simulated, with dry friction of 0.4 N.

n = 1600
dither = 0.8 * np.sin(np.pi * DT * np.arange(n))
dither += cid.random_binary(n, amplitude=0.8, hold=40, seed=1)
laboratory = model.with_effect(cid.effects.CoulombFriction(fc=0.4, at="x_dot"))
record = cid.simulate(laboratory, d=dither, sensor_noise=[1e-4, 5e-4], seed=2)
print(record)

# %%
# Is the record what the model says?
# ----------------------------------
# `audit` finds that the logged force is that of the stated controller and something beside it that
# does not depend on the outputs, the dither; `compare` shows for each output how far the model is
# from the record.

print(cid.audit(record, model))
print(cid.compare(record, model))

# %%
# What is missing?
# ----------------
# Every effect of the catalogue is tried at every place where it can act: at the force, at each of
# the two velocities and at each of the two sensors. A force at the pivot accelerates the cart as
# well, through the mass matrix, and its size is a torque. The gap of both outputs together is in
# units of their noise floors, and that of each is in its own unit.

found = cid.diagnose(model, record, progress=False)
print(found)

cid.plot.diagnosis(found)
plt.show()

first = found.findings[0]
print(f"{first.names[0]}: {first.effect.fc:.3f} N")

assert found.verdict == "explained"
assert "CoulombFriction at x_dot" in first.names
