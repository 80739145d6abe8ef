r"""
A lead compensator for a levitated ball
=======================================

A steel ball hangs 12 mm below an electromagnet. Without control it falls, or jumps to the magnet. A
lead compensator stabilizes it. This story goes from the physics to the controller, and checks that
the loop has the margins that were asked for.
"""

import control as ct
import matplotlib.pyplot as plt
import numpy as np

import ctrlid as cid

# %%
# From the physics to a transfer function
# ---------------------------------------
# The plant is an ordinary `control.NonlinearIOSystem`. `operating_point` finds the voltage that
# holds the ball, and `linearize` differentiates the equations there, exactly.

plant = cid.plants.maglev(m=0.0213, K=3.34e-6, g=9.81)
op = cid.operating_point(plant, output=0.012)
P = cid.linearize(plant, op)
print(op)
print(P)

# %%
# The poles lie symmetrically about the imaginary axis, at plus and minus the square root of 2 g /
# x0, where x0 is the gap. The gain is negative: more voltage lifts the ball, and the gap decreases.

print("poles [rad/s]:", P.poles().real.round(3))
print("sqrt(2 g/x0): ", round(float(np.sqrt(2 * 9.81 / 0.012)), 3))

# %%
# The compensator
# ---------------
# `design_lead` takes the gain crossover in rad/s and the phase margin in degrees, and returns a
# lead whose loop has exactly these. It chooses the sign of the gain itself.

C = cid.design_lead(P, crossover=100.0, phase_margin=50.0)
print(C)
margins = cid.loop_margins(C * P)
print(f"crossover {margins.crossover:.3f} rad/s, phase margin {margins.phase_margin:.3f} deg")
low, high = margins.gain_reduction_margin, margins.gain_margin
print(f"stable with the loop gain times {low:.3f} to {high}")

# %%
# The last line matters for an unstable plant: the loop also becomes unstable when its gain becomes
# too *small*.
#
# Not every specification can be met. Then the error says why, and what is possible instead.

try:
    cid.design_lead(P, crossover=20.0, phase_margin=85.0)
except cid.CtrlidError as refusal:
    print(refusal)

# %%
# The loop on the nonlinear physics
# ---------------------------------
# The reference is stepped by 0.2 mm, once with the linear model and once with the nonlinear
# equations. The compensator has no integrator, and the static gain of the plant is finite. So the
# ball moves farther than the reference, in both simulations.

loop = cid.Loop(plant, C, dt=0.0005, at=op)
n, height = 200, 2e-4
r = np.full(n, op.output + height)
physics = cid.simulate(loop, r)
linear = ct.forced_response(ct.ss(ct.feedback(C * P, 1)), physics.t, np.full(n, height))

omega = np.geomspace(5, 2000, 400)
L = (C * P)(1j * omega)
plt.rcParams.update(cid.plot.style())
fig, ((gain, step), (phase, volts)) = plt.subplots(
    2, 2, figsize=(9, 5.2), sharex="col", layout="constrained"
)
gain.loglog(omega, np.abs(L), "k")
gain.axhline(1, color="0.6", lw=0.8)
gain.axvline(margins.crossover, color="0.6", lw=0.8, ls=":")
gain.set(ylabel="loop gain |C P| [-]", title="Loop, linear model")
phase.semilogx(omega, np.degrees(np.unwrap(np.angle(L))), "k")
phase.axhline(-180, color="0.6", lw=0.8)
phase.axvline(margins.crossover, color="0.6", lw=0.8, ls=":")
phase.annotate(
    f"{margins.phase_margin:.0f}° at {margins.crossover:.0f} rad/s",
    (margins.crossover, -180 + margins.phase_margin), (190, -126),
    arrowprops={"arrowstyle": "->"},
)  # fmt: skip
phase.set(xlabel="frequency [rad/s]", ylabel="loop phase [deg]", yticks=[-180, -150, -120])
milliseconds = 1e3 * physics.t
step.plot(milliseconds, 1e3 * physics.y, "k", label="simulation, nonlinear physics")
step.plot(
    milliseconds, 1e3 * (op.output + linear.outputs), color="0.5", ls="--", lw=2.5,
    label="simulation, linear model",
)  # fmt: skip
step.plot(milliseconds, 1e3 * r, "k:", lw=1, label="reference")
step.set(ylabel="gap [mm]", title="Step of the reference by 0.2 mm")
step.legend()
volts.plot(milliseconds, physics.u, "k")
volts.set(xlabel="time [ms]", ylabel="magnet voltage [V]")
plt.show()

# %%
# This story asserts that the loop has the crossover and the margin that were asked for.

assert abs(margins.crossover - 100) < 1e-6
assert abs(margins.phase_margin - 50) < 1e-6
