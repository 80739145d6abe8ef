"""Speeds whose position is no state: a drive with a tachometer, a reaction wheel."""

import math

import control as ct
import numpy as np
import pytest

import ctrlid as cid
import ctrlid.effects as E
from ctrlid.diagnosis.recalibration import fit_base_model

DT, FINE = 0.01, 40
J, C, KT = 2e-3, 1e-3, 0.05  # kg m^2, N m s/rad, N m/A


def motor():
    """A motor that a current [A] drives, as a user with a tachometer [rad/s] writes it."""
    return ct.nlsys(
        lambda t, x, u, p: np.array([(p["kt"] * u[0] - p["c"] * x[0]) / p["J"]]),
        lambda t, x, u, p: x[0], inputs=["i"], outputs=["omega"], states=["omega"],
        params={"J": J, "c": C, "kt": KT}, name="motor",
    )  # fmt: skip


def make_loop(**options):
    law = ct.tf([0.083, -0.08], [1, -1], DT)
    return cid.Loop(motor(), law, dt=DT, **options)


def run_motor(friction, seed, n=2000, loads=(0.0,), noise=0.1):
    """The log of a motor under its PI, with dry friction and loads in turn [N m]."""
    rng = np.random.default_rng(seed)
    r = np.repeat(rng.uniform(-30, 30, n // 50), 50)
    w = sum_of_errors = past = 0.0
    y, u = np.empty(n), np.empty(n)
    h = DT / FINE
    for k in range(n):
        y[k] = w + noise * rng.standard_normal()
        load = loads[k * len(loads) // n]
        error = r[k] - y[k]
        sum_of_errors += 0.083 * error - 0.08 * past
        past, u[k] = error, sum_of_errors
        for _ in range(FINE):
            torque = KT * u[k] - C * w - load
            if w == 0 and abs(torque) <= friction:
                break
            turning = np.sign(w) if w != 0 else np.sign(torque)
            later = w + h * (torque - friction * turning) / J
            w = 0.0 if w * later < 0 else later
    return cid.Record(dt=DT, r=r, u=u, y=y)


@pytest.mark.parametrize(
    "forces", [{"omega": "i"}, pytest.param({"omega": None}, marks=pytest.mark.slow)]
)
def test_friction_of_a_drive_with_a_tachometer(forces):
    loop = make_loop(free=("c",), forces=forces, units={"omega": "rad/s"})
    friction = E.CoulombFriction, E.ViscousFriction, E.ConstantForce, E.InputDeadZone
    found = cid.diagnose(loop, run_motor(0.01, 1), catalogue=friction)
    (finding,) = found.findings
    assert finding.names == ("CoulombFriction",)
    assert finding.effect.fc == pytest.approx(0.01 / J, rel=0.02)
    assert "rad/s^2" in str(found)
    assert found.gap.after < 1.1 * found.gap.floor
    clean = cid.diagnose(loop, run_motor(0.0, 2), catalogue=friction)
    assert clean.verdict == "nothing missing"


def test_steps_of_a_load_leave_the_sensor_its_noise():
    """A white force that stood for them left the sensor a thousandth, and a name was found."""
    record = run_motor(0.0, seed=3, n=1200, loads=(0.0, 0.1, -0.05, 0.1, 0.0), noise=0.05)
    fit = fit_base_model(make_loop(), [record], ("kt", "c")).fit
    assert math.sqrt(fit.sensor_noises[0]) == pytest.approx(0.05, rel=0.1)
    assert fit.noise.drift > 0


@pytest.mark.slow
def test_who_does_not_say_that_it_is_a_speed_is_told():
    record = run_motor(0.01, 1)
    kinds = E.ConstantForce, E.InputDelay
    found = cid.diagnose(make_loop(free=("c",)), record, catalogue=kinds, progress=False)
    assert found.verdict == "unknown"
    assert "forces={'omega': None}" in " ".join(str(found).split())
    # What a state in degrees Celsius does is no motion.
    other = make_loop(free=("c",), units={"omega": "degC"})
    found = cid.diagnose(other, record, catalogue=kinds[:1])
    assert found.verdict == "unknown"
    assert "forces={" not in str(found)


def test_a_speed_has_no_spring():
    loop = make_loop(forces={"omega": "i"})
    for effect in (E.LinearStiffness(1.0), E.CubicStiffness(1.0), E.PositionOffset(0.1)):
        with pytest.raises(cid.CtrlidError, match="position"):
            loop.with_effect(effect)


def test_what_is_no_speed_is_refused():
    servo = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    position, velocity = servo.state_labels
    with pytest.raises(cid.CtrlidError, match="velocities of servo"):
        cid.Loop(servo, dt=DT, forces={position: None})
    with pytest.raises(cid.CtrlidError, match="velocities of motor"):
        make_loop(forces={"speed": None})
    with pytest.raises(cid.CtrlidError, match="velocities of motor"):
        make_loop(forces={"omega": "torque"})
    assert cid.Loop(servo, dt=DT, forces={velocity: None}).equations().velocities == (1,)


# --- a pendulum that a reaction wheel holds

MASS, INERTIA, WHEEL = 0.6, 6e-3, 4e-4  # N m of weight by angle, kg m^2, kg m^2


def wheel_rates(x, torque, fan=0.0):
    """The rates of angle, its speed and the wheel's speed beside the pendulum."""
    turn = (MASS * np.sin(x[0]) - torque) / INERTIA
    return np.array([x[1], turn, torque / WHEEL - turn + fan])


def reaction_wheel():
    return ct.nlsys(
        lambda t, x, u, p: wheel_rates(x, p["b"] * u[0]), lambda t, x, u, p: np.array([x[0], x[2]]),
        inputs=["tau"], outputs=["theta", "wheel"], states=["theta", "theta_dot", "wheel"],
        params={"b": 1.0}, name="reaction_wheel",
    )  # fmt: skip


@pytest.mark.parametrize("friction", [pytest.param(0.0, marks=pytest.mark.slow), 4e-3])
def test_friction_at_a_reaction_wheel(friction):
    plant, dt, n = reaction_wheel(), 0.005, 3000
    at = cid.OperatingPoint((0.0, 0.0, 0.0), 0.0, (0.0, 0.0))
    P = cid.linearize(plant, at)
    gain = np.asarray(ct.lqr(P, np.diag([1e3, 10.0, 1e-3]), [[3e3]])[0])
    rng = np.random.default_rng(3)
    swing = 0.02 * np.repeat(rng.choice([-1.0, 1.0], n // 60), 60)
    x, u, y = np.zeros(3), np.empty(n), np.empty((2, n))
    for k in range(n):
        y[:, k] = x[[0, 2]] + [2e-4, 0.05] * rng.standard_normal(2)
        u[k] = -float(gain[0] @ (x - [swing[k], 0.0, 0.0])) + 5e-3 * rng.standard_normal()
        for _ in range(20):
            net = u[k]
            if friction:
                net -= friction * np.tanh(x[2] / 0.05)
            x = x + dt / 20 * wheel_rates(x + dt / 40 * wheel_rates(x, net), net)
    loop = cid.Loop(plant, dt=dt, at=at, free=("b",), forces={"wheel": "tau"},
                    units={"tau": "N m", "theta": "rad", "wheel": "rad/s"})  # fmt: skip
    record = cid.Record(dt=dt, u=u, y=y)
    kinds = E.CoulombFriction, E.ViscousFriction, E.ConstantForce
    found = cid.diagnose(loop, record, catalogue=kinds)
    if not friction:
        assert found.verdict == "nothing missing"
        return
    (finding,) = found.findings
    assert (finding.name, finding.effect.at) == ("CoulombFriction", "wheel")
    assert finding.effect.fc == pytest.approx(friction, rel=0.05)
    (size,) = (line for line in str(found).splitlines() if "fc = " in line)
    assert " mN m" in size
