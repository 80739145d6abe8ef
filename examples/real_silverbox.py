r"""
Silverbox: what the input does between the samples
==================================================

The data are a public benchmark of nonlinear identification: an electronic circuit that imitates a
mass on a spring,

.. math:: \ddot y = b u - k y - d \dot y

and is driven in open loop. In the circuit the spring gets stiffer the further it is bent. The
diagnosis is not told of this.

The input was *measured*, behind a filter that takes off all above half the sampling rate. So it is
neither held between the samples nor straight: ``hold="bandlimited"`` reconstructs it.

The record is not part of ctrlid. It is downloaded once, or read from the folder that the
environment variable CTRLID_DATA_DIR names.
"""

from dataclasses import replace

import control as ct
import matplotlib.pyplot as plt
import numpy as np

import ctrlid as cid
from ctrlid import effects as E

# %%
# A linear oscillator
# -------------------


def rates(t, x, u, p):
    """Return how fast the position and its rate change."""
    return np.array([x[1], p["b"] * u[0] - p["k"] * x[0] - p["d"] * x[1]])


plant = ct.nlsys(rates, lambda t, x, u, p: x[0], inputs=["u"], outputs=["y"], states=["x", "v"],
                 params={"b": 1.825e5, "k": 1.825e5, "d": 42.7}, name="oscillator")  # fmt: skip
record = cid.datasets.load("silverbox")
arrow, part = record[:40_500], record[50_000:53_000]
model = cid.Loop(plant, None, dt=record.dt, free=("b", "k", "d"),
                 at=cid.OperatingPoint(states=(0.0, 0.0), input=0.0, output=0.0))  # fmt: skip

# %%
# What is missing?
# ----------------
# Five seconds of one multisine are enough. The effects are sought on three quarters of them.

found = cid.diagnose(model, part, progress=False)
print(found)

cid.plot.diagnosis(found)
plt.show()

# %%
# On the arrow
# ------------
# The arrow is noise of growing amplitude, none of which was used. It is simulated from the input
# alone, 66 s in one run.


def measure_error(loop, hold):
    """Return the RMS error of the simulation of the arrow [mV]."""
    curves = cid.compare(replace(arrow, hold=hold), loop).curves
    return 1e3 * next(c.rms for c in curves if c.label == "open-loop simulation")


error = measure_error(found.loop, "bandlimited")
print(f"the model as given leaves {measure_error(model, 'bandlimited'):.1f} mV, with the effect "
      f"{error:.2f} mV")  # fmt: skip

# %%
# The same with other words for the input
# ---------------------------------------
# A held or a straight input is another experiment. The error of that is larger than anything else
# that is left, and no parameter takes it up.

spring = model.with_effect(E.CubicStiffness(7e5))
for hold in ("zoh", "foh"):
    fit = cid.fit_loop(spring, replace(part, hold=hold))
    print(f"{hold}: {measure_error(fit.loop, hold):.1f} mV")

assert [f.name for f in found.findings] == ["CubicStiffness"]
assert error < 1.0
