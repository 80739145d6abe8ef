r"""
Which sampling period?
======================

Fast sampling gives more data, but it harms plain least squares: from one sample to the next the
output changes less than the noise, and the unstable pole is lost. The paper found its sampling
period by trial and error. `sweep_sampling_period` makes these trials and recommends a period.
"""

import control as ct
import matplotlib.pyplot as plt
import numpy as np

import ctrlid as cid

# %%
# A fast log
# ----------
# The plant is a levitation with its unstable pole at 40 rad/s, sampled every half millisecond.

P = ct.tf([-6.5], [1, 0, -1600])
lead = cid.design_lead(P, crossover=100, phase_margin=50)
C = ct.sample_system(ct.ss(lead), 5e-4, "tustin")
r = cid.random_binary(8000, amplitude=1e-4, hold=40, seed=1)
record = cid.simulate(cid.Loop(P, C, dt=5e-4), r, sensor_noise=3e-6, seed=2)

# %%
# The sweep
# ---------
# Three estimators are compared at eight periods, without any constraint. If the poles in the
# s-plane are right, they do not depend on the period.

sweep = cid.sweep_sampling_period(record, [5e-4 * q for q in (1, 2, 3, 5, 7, 10, 15, 20)])
print(sweep)

# %%
# The figure shows the unstable pole against the period. The pole of least squares is near the
# origin at short periods, and approaches the true value as the period grows. The other two
# estimators are right at short periods, and become wrong at long ones, where u changes between the
# samples that are kept.

plt.rcParams.update(cid.plot.style())
fig, ax = plt.subplots(figsize=(8, 3.8), layout="constrained")
pole = {}
for name, marker in (("fit_arx", "o"), ("fit_iv", "s"), ("fit_continuous", "^")):
    rows = [row for row in sweep[name] if not row.failed]
    pole[name] = np.array([row.poles.real.max() for row in rows])
    ax.semilogx(
        [1e3 * row.period for row in rows], pole[name], marker=marker, mfc="none", label=name
    )
ax.axhline(40, color="0.6", ls=":", label="truth")
ax.axvline(1e3 * sweep.recommended, color="0.6", lw=0.8)
ax.annotate("recommended", (1e3 * sweep.recommended, 5), rotation=90, ha="right")
ticks = [0.5, 1, 2, 5, 10]
ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
ax.set(xlabel="sampling period [ms]", ylabel="unstable pole [rad/s]", ylim=(-12, 52))
ax.legend(loc="lower center", ncols=4)
plt.show()

# %%
# This story asserts that at the period of the logger the pole of least squares is less than half of
# the true one, and that at the recommended period all three are within five percent of it.

at_best = {row.estimator: row.poles.real.max() for row in sweep.table
           if row.period == sweep.recommended}  # fmt: skip
print(f"recommended: {1e3 * sweep.recommended:g} ms, p T = {40 * sweep.recommended:.2f}")
print({name: round(float(value), 2) for name, value in at_best.items()})
assert pole["fit_arx"][0] < 20
assert abs(pole["fit_iv"][0] / 40 - 1) < 0.05
assert all(abs(value / 40 - 1) < 0.05 for value in at_best.values())
