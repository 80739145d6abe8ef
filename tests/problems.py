"""The plants, loops, references and records that tests share.

All values are in SI units and all signals are absolute, as a rig logs them. A loop comes under the
controller with which most tests want it; arguments change what some tests need otherwise.
"""

import importlib
import sys
from pathlib import Path

import control as ct
import numpy as np

import ctrlid as cid

ROOT = Path(__file__).resolve().parents[1]
REST = cid.OperatingPoint(states=(0.0, 0.0), input=0.0, output=0.0)


# --- loops under a lead


def under_lead(plant, dt, at=None, crossover=100.0, phase_margin=50.0, analog=False, sampled=False,
               **options):  # fmt: skip
    """A plant under a lead with this crossover [rad/s] and phase margin [degrees].

    The lead is designed on the linear plant. It acts digitally, as its Tustin equivalent at the
    period `dt` [s], or is `analog`; `sampled`: it is designed on the plant with a zero-order hold.
    """
    P = plant if isinstance(plant, ct.TransferFunction) else cid.linearize(plant, at)
    design = ct.sample_system(P, dt) if sampled else P
    C = cid.design_lead(design, crossover=crossover, phase_margin=phase_margin)
    C = C if analog or sampled else C.sample(dt, "tustin")
    return cid.Loop(plant, C, dt=dt, at=at, **options)


def levitation(*effects, dt=2e-3, gap=0.012, free=("K",), **options):
    """A ball of 21.3 g under a magnet, 12 mm below it at 3 V; unstable with a pole of 40 rad/s.

    Output: gap x [m]; input: voltage V [V]; samples every 2 ms. It hangs under a lead; see
    `under_lead` for the options of its design, all others go to the loop.
    """
    plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    loop = under_lead(plant, dt, cid.operating_point(plant, output=gap), free=free, **options)
    for effect in effects:
        loop = loop.with_effect(effect)
    return loop


# The levitation as a textbook has it: deviation of the gap [m] by that of the voltage [V].
LINEAR_LEVITATION = ct.tf([-6.5], [1, 0, -1600])


def held_ball(mass, gap, voltage):
    """A ball [kg] that a voltage [V] holds at this gap [m]: a plant without a controller."""
    return cid.plants.maglev(m=mass, K=mass * 9.81 * gap**2 / voltage**2)


def pendulum(*effects, dt=0.005):
    """A pendulum of 0.12 kg and 0.25 m that a torque [N m] and a lead hold on its head.

    Output: angle [rad]; unstable with a pole of 5.5 rad/s; the lead crosses over at 15 rad/s.
    """
    plant = cid.plants.pendulum(m=0.12, length=0.25, c=0.013)
    loop = under_lead(plant, dt, REST, crossover=15)
    for effect in effects:
        loop = loop.with_effect(effect)
    return loop


# --- loops under other controllers


def drive(free=("c", "k"), plant=None, controller=None):
    """A position drive: a mass of 2 kg, viscous friction of 5 N s/m and a gain of 30 N/V.

    Output: position [m]; input: voltage [V]; samples every 10 ms; it rests at zero. The controller
    is a slow PID with an integral part, the plant the textbook's servo unless they are given.
    """
    plant = plant or cid.plants.servo(m=2.0, c=5.0, k=30.0)
    controller = controller or cid.PID(kp=6.0, ki=4.0, kd=0.4, filter_time=0.02)
    return cid.Loop(plant, controller, dt=0.01, at=REST, free=free)


def servo(controller=5.0, dt=0.01, **options):
    """A servo with round numbers, 1 kg, 2 N s/m and 3 N/V, under an analog gain of 5 V/m.

    Output: position [m]; samples every 10 ms. Where it rests is not said.
    """
    return cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), controller, dt=dt, **options)


def tank(controller=None, dt=5.0):
    """A tank of 100 cm^2 with an outlet of 10 mm^2, filled to 0.2 m; stable, without a controller.

    Output: level [m]; input: voltage of the pump [V]; samples every 5 s.
    """
    plant = cid.plants.tank(area=0.01, outlet=1e-5, k=1e-5)
    return cid.Loop(plant, controller, dt=dt, at=cid.operating_point(plant, output=0.2))


TANKS = {"k1": 0.05, "k3": 0.06, "k4": 0.05}


def tanks(controller=None, level=6.0, dt=4.0, free=("k1", "k3", "k4"), **values):
    """Two tanks, the upper running into the lower, whose level is measured; stable.

    h1' = k4 u - k1 sqrt(h1), h2' = k1 sqrt(h1) - k3 sqrt(h2); levels in cm, the pump's voltage u in
    V; samples every 4 s. Nobody controls them unless a controller is given.
    """

    def rates(t, x, u, p):
        upper, lower = np.sqrt(np.maximum(x, 1e-6))
        return np.array([p["k4"] * u[0] - p["k1"] * upper, p["k1"] * upper - p["k3"] * lower])

    plant = ct.nlsys(rates, lambda t, x, u, p: x[1], inputs=["u"], outputs=["y"],
                     states=["h1", "h2"], params=TANKS | values, name="two tanks")  # fmt: skip
    at = cid.operating_point(plant, output=level)
    return cid.Loop(plant, controller, dt=dt, at=at, free=free)


def beam(controller=True):
    """A plant as a user writes it: a mass on a spring, one of its states an angle [rad].

    Input: moment M; samples every 10 ms; it rests at 0.1 rad under a PID, or under nobody knows
    what.
    """

    def update(t, x, u, params):
        angle, rate = x
        return np.array([rate, params["k"] * u[0] - params["s"] * np.sin(angle)
                         - params["d"] * rate])  # fmt: skip

    plant = ct.nlsys(
        update, lambda t, x, u, params: x[0], name="beam", inputs=["M"], outputs=["angle"],
        states=["angle", "rate"], params={"k": 20.0, "s": 100.0, "d": 3.0},
    )  # fmt: skip
    at = cid.operating_point(plant, output=0.1)
    C = cid.PID(kp=8.0, ki=20.0, kd=0.6, bias=at.input, filter_time=0.01) if controller else None
    return cid.Loop(plant, C, dt=0.01, at=at, free=("k", "s"))


# --- plants alone


def first_state(t, x, u, params):
    """The output of most plants: their first state."""
    return x[0]


def mass(update=lambda t, x, u, params: np.array([x[1], u[0]]), **params):
    """A mass of 1 kg moved by a force u [N], or by another law; output: position x [m]."""
    return ct.nlsys(update, first_state, name="mass", inputs=["u"], outputs=["x"],
                    states=["x", "v"], params=params)  # fmt: skip


def rough_mass(friction):
    """A mass of 1 kg with dry friction [N] written as a sign: too sharp for an integration."""
    return ct.nlsys(
        lambda t, x, u, p: [x[1], u[0] - friction * np.sign(x[1]) - 2 * x[1]], first_state,
        inputs=["u"], outputs=["y"], states=["x", "v"], name="rough",
    )  # fmt: skip


# --- plants and loops at random


def random_levitation(rng, digital):
    """A levitated ball of any size under a lead at 2.5 times its pole, 20 to 100 samples a time
    constant; and the gap [m] at which it rests."""
    gap = rng.uniform(0.008, 0.02)
    plant = cid.plants.maglev(m=rng.uniform(0.01, 0.1), K=10 ** rng.uniform(-6, -4))
    at = cid.operating_point(plant, output=gap)
    p = float(np.max(np.abs(cid.linearize(plant, at).poles())))
    dt = float(f"{10 ** rng.uniform(-2, -1.3) / p:.3g}")
    loop = under_lead(plant, dt, at, crossover=2.5 * p, phase_margin=45, analog=not digital)
    return loop, gap


def random_lag(rng, digital):
    """A lag with a gain of 2 under a PI controller, or under a gain where that is analog.

    Its time constant is 10 ms to 100 s, of which a sample is a twentieth; it rests at 1 and 3.
    """
    lag, gain = 10 ** rng.uniform(-2, 2), rng.uniform(0.5, 4)
    C = cid.PID(gain, ki=rng.uniform(0.1, 2) / lag) if digital else ct.tf([gain], [1])
    at = cid.OperatingPoint((0.0,), 1.0, 3.0)
    return cid.Loop(ct.tf([2.0], [lag, 1]), C, dt=0.05 * lag, at=at)


def random_servo(rng):
    """A servo of any mass m [kg] with m w^2 as its gain, and m and w [rad/s]."""
    m, w = 10 ** rng.uniform(-1, 1), 10 ** rng.uniform(0, 1.5)
    return cid.plants.servo(m=m, c=m * w * rng.uniform(0.2, 3), k=m * w**2), m, w


def random_tank(rng):
    """A tank of 0.5 to 2 m^2."""
    return cid.plants.tank(area=rng.uniform(0.5, 2), outlet=0.02, k=0.05)


# --- references


def twelve_waves(rng, n):
    """A sum of twelve sines of any frequency, down to 400 samples a period."""
    return sum(np.sin(2 * np.pi * (f * np.arange(n) + rng.uniform()))
               for f in rng.uniform(1 / 400, 0.1, 12)) / 5  # fmt: skip


def repeated_bits(rng, n):
    """A random sequence of 127 bits, each held for one to eight samples, again and again."""
    return np.tile(np.repeat(rng.choice([-1.0, 1.0], 127), int(rng.integers(1, 9))), n)[:n]


def walk(n, levels, seed, hold=400):
    """Set-points visited one after the other, reached by short ramps."""
    rng = np.random.default_rng(seed)
    steps = np.repeat(rng.uniform(-levels, levels, -(-n // hold)), hold)[:n]
    return np.convolve(np.pad(steps, (20, 0), mode="edge"), np.ones(21) / 21, "valid")


# --- records


def record_of(loop, *, swing, hold, n, seed, noise_seed=None, levels=0.0, **noise):
    """A record of `n` samples of a loop whose reference jumps by `swing` about where it rests.

    Whether it jumps is drawn every `hold` samples from `seed`, set-points within `levels` from the
    seed after it, and the noise from `noise_seed`, by default the seed after the reference's.
    """
    r = cid.random_binary(n, amplitude=swing, hold=hold, around=loop.point.output, seed=seed)
    r = r + walk(n, levels, seed + 1) if levels else r
    return cid.simulate(loop, r, seed=seed + 1 if noise_seed is None else noise_seed, **noise)


# --- what tests do with them


def astray(loop, seed):
    """The loop with its free parameters up to 10 % off."""
    rng = np.random.default_rng(seed)
    known = loop.parameters
    return loop.with_parameters({k: known[k] * (1 + rng.uniform(-0.1, 0.1)) for k in loop.free})


def redesigned_levitation():
    """What a lead promises on the linear levitation, and what it does on the ball itself."""
    loop = levitation(dt=0.001, free=())
    base = cid.Loop(loop.plant, None, dt=loop.dt, at=loop.at)
    return cid.redesign(loop.linearize(), base, crossover=100, phase_margin=50)


def legend(ax):
    """The words in the legend of a picture."""
    return [text.get_text() for text in ax.get_legend().get_texts()]


def diagnose_draw(name, seed, catalogue):
    """Return a draw of the frozen study, and its diagnosis with few effects."""
    study = load_script("benchmarks", "study_frozen")
    case = study.cases.draw_case(name, seed)
    record = cid.Record(r=case.r, u=case.u, y=case.y, dt=case.rig.dt)
    loop = study.make_loop(case.rig)
    return case, cid.diagnose(loop, record, catalogue=catalogue, progress=False)


def load_script(folder, name):
    """Import a file of ``benchmarks`` or ``examples``, which finds its neighbours as a script."""
    place = str(ROOT / folder)
    sys.path.insert(0, place)
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(place)
