r"""
QUBE rotary pendulum: a coarse encoder, and a fit that does not mind
====================================================================

A pendulum stands on a motor-driven arm (QUBE-Servo, DECAR group, McGill University). Two PD laws in
parallel keep it upright, while the targets of arm and pendulum and a voltage that is added move it
independently. Five runs of 20 s at 500 Hz are logged, and the law is exact to rounding. The
encoders have steps of 3.07 mrad, of which there are two or three in all that the pendulum does.

What is known beforehand are the numbers of the manufacturer's workbook. Three runs are used to fit,
two are kept back.

The records are not part of ctrlid. They are read from the folder that the environment variable
CTRLID_DATA_DIR names.
"""

import control as ct
import matplotlib.pyplot as plt
import numpy as np

import ctrlid as cid

DT = 0.002

# %%
# Physics and law
# ---------------
# Each PD law has a derivative with a filter of 20 ms. Both together are one system of two inputs:
# the errors of the arm and of the pendulum.

plant = cid.plants.rotary_pendulum(
    m=0.024, length=0.0645, arm=0.085, arm_inertia=0.095 * 0.085**2 / 12, J=0.024 * 0.129**2 / 12,
    kt=0.042, R=8.4, c=0.00027, gamma=5e-5,
)  # fmt: skip
den = 1 + 50 * DT
keep, slope = np.eye(2) / den, 50 / den
law = ct.ss(keep, np.eye(2) - keep, [[1.8 * slope, 2.5 * slope]],
            [[-6 - 1.8 * slope, -30 - 2.5 * slope]], DT)  # fmt: skip
free = ("arm_inertia", "arm", "J", "kt", "c", "gamma")
given = cid.Loop(plant, law, dt=DT, free=free, input_limits=(-10, 10))

# The pendulum is raised by hand in the first second.
runs, kept_back = ([run[1000:] for run in cid.datasets.load(f"qube_{which}")]
                   for which in ("estimation", "validation"))  # fmt: skip


def simulate(loop):
    """Return the RMS errors of the closed-loop simulation of the runs kept back [mrad]."""
    found = [cid.compare(run, loop) for run in kept_back]
    errors = [[1e3 * one["closed-loop simulation"].rms for one in each.outputs] for each in found]
    print("theta {:.1f} mrad, alpha {:.1f} mrad".format(*np.mean(errors, axis=0)))
    return np.mean(errors, axis=0), found[1]


simulate(given)

# %%
# Maximum likelihood takes the noise for white
# --------------------------------------------
# The rounding of the encoders follows the motion, so that it is not white, and `fit_loop` says so.
# It drives the friction of the pivot to zero, where no pendulum has it.

likely = cid.fit_loop(given, runs)
print(likely)

# %%
# A fit by the error of the simulation
# ------------------------------------
# The targets and the added voltage are known, and the rounding does not depend on them. So the
# loop is simulated from them, without any measured output, and the parameters are those with the
# smallest error.

physics = cid.fit_simulation(given, runs)
print(physics.estimate)
simulate(physics.loop)

# %%
# What an arm with a cable has besides
# ------------------------------------
# The arm creeps back towards the middle by itself, and dry friction holds it a little. A spring at
# the arm (the cable of the encoder is one), dry friction and an offset of the voltage are fitted
# with the others. Levels count now, since they tell the offset.

E = cid.effects
larger = (
    physics.loop.with_effect(E.CoulombFriction(fc=3e-4, at="theta_dot"))
    .with_effect(E.LinearStiffness(k1=1e-3, at="theta_dot"))
    .with_effect(E.InputOffset(offset=0.01))
)
fitted = cid.fit_simulation(larger, runs, intercept=False)
print(fitted.estimate)
errors, comparison = simulate(fitted.loop)

cid.plot.comparison(comparison, window=(6.0, 12.0))
plt.show()

# %%
# The unstable pole
# -----------------
# All of these models agree on how fast the pendulum falls.

fastest = [model.poles.real.max() for model in (likely, physics, fitted)]
print("unstable pole: " + ", ".join(f"{pole:.1f}" for pole in fastest) + " rad/s")

assert "ARE NOT WHITE" in str(likely)
assert errors[0] < 12
assert errors[1] < 5.5
assert 12.5 < min(fastest) < max(fastest) < 14.9
