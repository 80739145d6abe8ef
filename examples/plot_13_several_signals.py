r"""
Several inputs and outputs: a cart with a pole
==============================================

A pole stands upright on a cart. One force moves the cart; two sensors tell where the cart is and
how far the pole leans. The controller is a linear-quadratic state feedback on an observer. This
page goes from the physics to a record, to a fitted model, and to a new gain, tried on the physics.
"""

import control as ct
import matplotlib.pyplot as plt
import numpy as np

import ctrlid as cid

# %%
# The rig and what is believed of it
# ----------------------------------
# `plants.cart_pole` has the equations of motion. Here the rod is longer and the cart runs less
# easily than the data sheet says.

DT = 0.01
believed = cid.plants.cart_pole(M=0.5, m=0.2, length=0.28, J=0.004, c=0.2)
real = cid.plants.cart_pole(M=0.5, m=0.2, length=0.33, J=0.004, c=0.9)
at = cid.operating_point(believed, output=(0.0, 0.0))
P = cid.linearize(believed, at)
print(P.input_labels, P.output_labels, P.state_labels)
print(P.poles().round(2))

# %%
# State feedback on an observer
# -----------------------------
# A design is a function from a linear model to a controller. This one samples the model and makes
# one linear system of `control.dlqr` and `control.dlqe`. Its inputs have the names of what they
# read: the outputs ``x`` and ``theta``, the input ``F``, which the observer needs, and the wanted
# states ``xd[0]``, ..., of which python-control's own functions speak as well. Any other
# python-control system would do: `control.create_statefbk_iosystem` with an estimator, a cascade.


def design(model, weights=(10.0, 10.0, 1.0, 1.0), effort=1.0):
    """Return a state feedback on an observer, as one digital system."""
    G = ct.sample_system(model, DT)
    n, m, p = G.nstates, G.ninputs, G.noutputs
    K = ct.dlqr(G, np.diag(weights), effort * np.eye(m))[0]
    L = G.A @ ct.dlqe(G, np.eye(m), 1e-4 * np.eye(p))[0]
    wanted = [f"xd[{k}]" for k in range(n)]
    return ct.ss(
        G.A - L @ G.C, np.hstack([L, G.B, np.zeros((n, n))]), -K,
        np.hstack([np.zeros((m, p + m)), K]), DT,
        inputs=[*model.output_labels, *model.input_labels, *wanted], outputs=model.input_labels,
    )  # fmt: skip


loop = cid.Loop(believed, design(P), dt=DT, at=at, free=("length", "c"))
print(loop)

# %%
# The text lists the wiring. What is not named by the record, the references of the other states, is
# held where the loop rests.
#
# The experiment
# --------------
# The cart goes to and fro, and a small dither is added to the force. The record has one row for
# each output.

rig = cid.Loop(real, loop.controller, dt=DT, at=at)
r = cid.random_binary(2000, amplitude=0.1, hold=150, seed=1)
d = cid.random_binary(2000, amplitude=0.3, hold=10, seed=2)
record = cid.simulate(rig, {"xd[0]": r}, d=d, sensor_noise=(5e-4, 2e-3), seed=3)
print(record.signals, record.y.shape)

# %%
# Difference equations, output by output
# --------------------------------------
# `fit_iv` needs no physics. Each output has an equation of its own, with its own intervals. The
# angle tells the pole that is to be stabilized; the position of the cart, which the controller
# keeps still, knows little of it, and says so.

G = cid.fit_iv(record, na=4, nb=4)
for name, estimate in G.estimates.items():
    k = np.argmax(estimate.poles_s.real)
    print(f"{name:6} unstable pole at {estimate.poles_s[k].real:.2f} "
          f"± {estimate.poles_s_standard_errors[k]:.2f} rad/s")  # fmt: skip
print(f"{'real':6} unstable pole at {rig.linearize().poles().real.max():.2f} rad/s")

# %%
# The physics, fitted
# -------------------
# `fit_loop` uses both outputs at once, and what is known of the equations.

fitted = cid.fit_loop(loop, record)
print(fitted.estimate)

# %%
# A new gain, promised and achieved
# ---------------------------------
# The cart is to be faster: its position gets thirty times the weight. `redesign` calls the design
# with the linear model of what it is given, here the fitted loop, and tries the controller on the
# rig. Beside it stands the same design on the data sheet. The margins are those of the loop cut at
# the force; the observer reads what the controller asks for, so they are those that the loop has.


def faster(model):
    """Return the same design, with more weight on the position."""
    return design(model, weights=(300.0, 10.0, 1.0, 1.0), effort=0.3)


height = {"xd[0]": 0.1}
on_paper = cid.redesign(loop, rig, design=faster, step=height)
informed = cid.redesign(fitted, rig, design=faster, step=height)
print(on_paper.verdict)
print()
print(informed)

# %%

cid.plot.step(informed)
plt.show()

# %%
# What the fit is worth
# ---------------------
# On the data sheet another response was promised than came; on the fitted model the rig does what
# the design says.


def worst(trial):
    """Return how far x is from what was promised, as a share of the step."""
    step = trial.steps[0]
    gap = np.abs(step.achieved.y[0] - step.promised.y[0]).max()
    return gap / step.height


print(f"largest error of the promise for x: on paper {100 * worst(on_paper):.1f} % of the step, "
      f"fitted {100 * worst(informed):.1f} %")  # fmt: skip
assert informed.stable
assert worst(informed) < 0.5 * worst(on_paper)
low, high = fitted.estimate.confidence_interval("length", 0.999)
assert low < 0.33 < high
