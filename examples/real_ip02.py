r"""
IP02 cart with a pole: the friction that is not in the data sheet
=================================================================

A linear servo (Quanser IP02, underactuated robotics group, DFKI) swings a weighted pendulum up and
balances it. Two runs of five seconds at 100 Hz are logged: position of the cart, angle of the
pendulum, and the commanded force, clipped at 6 N. The controller changes along the swing-up, and
its gains were not published. So it is unknown here: the force is taken as measured.

What is known beforehand are the numbers that the authors declare: masses, lengths and a viscous
friction of 5.4 N s/m at the cart; no dry friction.

The records are not part of ctrlid. They are read from the folder that the environment variable
CTRLID_DATA_DIR names.
"""

import control as ct
import matplotlib.pyplot as plt

import ctrlid as cid

# %%
# Physics as declared
# -------------------
# The cart's mass counts its motor's inertia, and the pendulum has a weight of 0.1 kg at its centre
# of mass. The frequency of the pendulum, by its inertia, and the viscous friction of the cart are
# free.

plant = cid.plants.cart_pole(
    M=0.57 + 0.37 + 0.133, m=0.127 + 0.1, length=0.1778, J=1.1987e-3 + 0.1 * 0.1778**2, c=5.4,
    gamma=0.0024,
)  # fmt: skip
at = cid.operating_point(plant, output=(0.0, 0.0))
given = cid.Loop(plant, dt=0.01, at=at, free=("J", "c"))
runs = [cid.datasets.load(f"ip02_{name}") for name in ("rtc", "dirtran")]
print(given)
print("the inputs that work on each velocity:", plant.forces)

# %%
# What is missing?
# ----------------
# Every velocity and output is a place. Dry friction is tried at the cart and at the pivot, and an
# effect at one of them accelerates both, through the mass matrix.

found = cid.diagnose(given, runs, progress=False)
print(found)

cid.plot.diagnosis(found)
plt.show()

# %%
# The friction and the pole
# -------------------------
# Most of the declared viscous friction turns out to be dry friction at the cart. Which law of dry
# friction it is, the record cannot tell, and the first of the set is decided by last bits. The mass
# of the pendulum is larger than declared, or what stands for it: the reaction of the pendulum on
# the cart is. The pendulum is upright where the model is linearized; in motion dry friction damps
# nothing.

dry = (cid.effects.CoulombFriction, cid.effects.StribeckFriction,
       cid.effects.AsymmetricCoulombFriction)  # fmt: skip
label, friction = next((label, e) for label, e in found.loop.labelled.items()
                       if isinstance(e, dry) and e.at == "x_dot")  # fmt: skip
size = friction.fs if isinstance(friction, cid.effects.StribeckFriction) else friction.fc
moving = found.loop.without_effect(label)
viscous = found.loop.parameters["c"]
poles = [float(ct.poles(loop.linearize(states=True)).real.max()) for loop in (given, moving)]
print(f"unstable pole {poles[0]:.2f} rad/s as declared, {poles[1]:.2f} rad/s completed; "
      f"dry friction ({type(friction).__name__}) {size:.2f} N, viscous "
      f"{viscous:.2f} N s/m")  # fmt: skip

assert found.verdict == "partly explained"
assert any("CoulombFriction at x_dot" in f.names for f in found.findings)
assert 0.5 < size < 1.2
assert viscous < 2.0
assert 6.6 < poles[1] < 7.7
