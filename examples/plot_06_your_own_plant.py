r"""
Your own plant: written in numpy, traced, linearized, simulated
===============================================================

There is no plant class to learn. A plant is a python-control system with an ordinary update
function. ctrlid traces the function: it calls it once with symbols and so gets the exact equations.
The example is an active magnetic bearing, with a loop over its two magnets, a ``math`` function and
an array filled line by line.
"""

import math

import control as ct
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

import ctrlid as cid

# %%
# The plant
# ---------
# A rotor is held between two magnets, each with a bias current. The control voltage raises the
# current of one and lowers that of the other, through the resistance and inductance of the coils.


def bearing(t, x, u, params):
    """Return the rates of position, velocity and current."""
    position, velocity, current = x
    dx = np.zeros(3)
    force = 0.0
    for side in (+1, -1):
        air_gap = params["gap"] - side * position
        force += side * params["k"] * math.pow((params["bias"] + side * current) / air_gap, 2)
    dx[0] = velocity
    dx[1] = force / params["m"]
    dx[2] = (u[0] - params["R"] * current) / params["L"]
    return dx


parameters = {"m": 2.0, "k": 2e-5, "gap": 5e-4, "bias": 1.0, "R": 4.0, "L": 0.001}
plant = ct.nlsys(
    bearing, lambda t, x, u, params: x[0], params=parameters, name="bearing",
    inputs=["voltage"], outputs=["position"], states=["position", "velocity", "current"],
)  # fmt: skip

# %%
# Linearized
# ----------
# Without the lag of the coils the rotor has poles at plus and minus 2 i0 sqrt(k / (m s0^3)), with
# the bias current i0 and the air gap s0: the magnets act like a spring of negative stiffness. The
# coils add a pole at -R/L.

op = cid.operating_point(plant, output=0.0)
P = cid.linearize(plant, op)
spring = 2 * parameters["bias"] * math.sqrt(parameters["k"] / (2.0 * parameters["gap"] ** 3))
print(P)
print("poles [rad/s]:", np.sort(P.poles().real).round(4))
print("by hand:      ", np.round([-parameters["R"] / parameters["L"], -spring, spring], 4))

# %%
# Controlled and simulated
# ------------------------
# The controller is a lead with its crossover at 900 rad/s, simulated as an analog circuit. The
# reference is a staircase.

C = cid.design_lead(P, crossover=900.0, phase_margin=40.0)
loop = cid.Loop(plant, C, dt=2e-4, at=op)
r = cid.staircase(600, levels=[0.0, 2e-5, -2e-5], hold=200)
record = cid.simulate(loop, r)

# %%
# To check the simulation, we solve the equations of the whole loop, plant and circuit, with scipy
# at a tight tolerance. This uses the Python function itself, not the traced one.

circuit = ct.ss(C)


def whole_loop(t, z, reference):
    """Return the rates of plant and circuit."""
    error = reference - z[0]
    voltage = op.input + (circuit.C @ z[3:] + circuit.D[0, 0] * error).item()
    inside = circuit.A @ z[3:] + circuit.B[:, 0] * error
    return np.append(bearing(t, z[:3], [voltage], parameters), inside)


z, positions = np.zeros(4), []
for level in (0.0, 2e-5, -2e-5):
    times = np.arange(201) * loop.dt
    solved = solve_ivp(
        whole_loop, (0, times[-1]), z, "DOP853", times, args=(level,), rtol=1e-11, atol=1e-15
    )
    positions.append(solved.y[0, :-1])
    z = solved.y[:, -1]
independent = np.concatenate(positions)
worst = np.abs(record.y - independent).max() / np.ptp(independent)
print(f"largest difference: {worst:.1e} of the motion")

plt.rcParams.update(cid.plot.style())
fig, (above, below) = plt.subplots(2, 1, figsize=(8, 4.4), sharex=True, layout="constrained")
milliseconds = 1e3 * record.t
above.plot(milliseconds, 1e6 * record.y, "k", label="simulation, ctrlid")
above.plot(milliseconds[::10], 1e6 * independent[::10], "ko", mfc="none", ms=5,
           label="simulation, scipy")  # fmt: skip
above.step(milliseconds, 1e6 * r, "0.5", where="post", ls="--", label="reference")
above.set(ylabel="position [µm]")
above.legend(loc="lower left")
below.plot(milliseconds, record.u, "k")
below.set(xlabel="time [ms]", ylabel="control voltage [V]")
plt.show()

# %%
# What cannot be traced
# ---------------------
# A Python ``if`` on a state needs the value of the state, and a symbol has none. ctrlid raises an
# error that names the line and says what to write instead.


def with_stop(t, x, u, params):
    """Return the rates of a mass that sticks beyond a stop."""
    if x[0] > 0.001:
        return np.array([0.0, 0.0])
    return np.array([x[1], u[0]])


stopped = ct.nlsys(with_stop, lambda t, x, u, params: x[0], name="stop",
                   inputs=["u"], outputs=["y"], states=["x", "v"])  # fmt: skip
try:
    cid.operating_point(stopped, output=0.0)
except cid.CtrlidError as refusal:
    message = str(refusal)
    print(message[message.index("a Python 'if'") :])

# %%
# This story asserts that the poles are those of the formula, and that the simulation agrees with an
# independent one to better than a millionth.

assert abs(P.poles().real.max() / spring - 1) < 1e-9
assert worst < 1e-6
