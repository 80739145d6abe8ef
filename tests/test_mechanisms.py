"""The plants of several outputs: energy, derivatives, and what python-control makes of them."""

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ctrlid as cid
from ctrlid.physics.trace import trace

PLANTS = {
    "cart_pole": cid.plants.cart_pole(M=0.5, m=0.2, length=0.3, J=0.004),
    "rotary_pendulum": cid.plants.rotary_pendulum(
        m=0.024, length=0.0645, arm=0.085, arm_inertia=5.7e-5, J=3.3e-5, kt=0.042, R=8.4, km=0.0),
    "ball_on_beam": cid.plants.ball_on_beam(m=0.05, J=0.02, radius=0.01),
    "quadrotor_planar": cid.plants.quadrotor_planar(m=0.5, J=2e-3, arm=0.15),
}  # fmt: skip


def energy(name, x, p):
    """Kinetic and potential energy [J], from the speeds of the bodies."""
    q, v = np.split(np.asarray(x), 2)
    g = p["g"]
    if name == "cart_pole":
        # The pole's centre is at x - l sin(-theta): it leans towards positive x.
        vx = v[0] - p["length"] * np.cos(q[1]) * v[1]
        vz = p["length"] * np.sin(q[1]) * v[1]
        return (0.5 * p["M"] * v[0] ** 2 + 0.5 * p["m"] * (vx**2 + vz**2)
                + 0.5 * p["J"] * v[1] ** 2 + p["m"] * g * p["length"] * np.cos(q[1]))  # fmt: skip
    if name == "rotary_pendulum":
        along = p["arm"] * v[0] + p["length"] * np.cos(q[1]) * v[1]
        out, up = p["length"] * np.sin(q[1]) * v[0], p["length"] * np.sin(q[1]) * v[1]
        spin = p["J"] * (v[1] ** 2 + (np.sin(q[1]) * v[0]) ** 2)
        return (0.5 * p["arm_inertia"] * v[0] ** 2 + 0.5 * p["m"] * (along**2 + out**2 + up**2)
                + 0.5 * spin + p["m"] * g * p["length"] * np.cos(q[1]))  # fmt: skip
    if name == "ball_on_beam":
        rolling = p["ball_inertia"] * ((v[0] / p["radius"]) ** 2 + v[1] ** 2)
        return (0.5 * p["m"] * (v[0] ** 2 + (q[0] * v[1]) ** 2) + 0.5 * rolling
                + 0.5 * p["J"] * v[1] ** 2 + p["m"] * g * q[0] * np.sin(q[1]))  # fmt: skip
    return (0.5 * p["m"] * (v[0] ** 2 + v[1] ** 2) + 0.5 * p["J"] * v[2] ** 2
            + p["m"] * g * q[1])  # fmt: skip


@pytest.mark.parametrize("name", PLANTS)
def test_energy_is_conserved_without_friction_and_input(name):
    plant, n = PLANTS[name], PLANTS[name].nstates
    start = 0.3 * np.random.default_rng(1).standard_normal(n)
    x = solve_ivp(lambda t, x: plant.dynamics(t, x, np.zeros(plant.ninputs)), (0, 1.0), start,
                  rtol=1e-11, atol=1e-12).y  # fmt: skip
    levels = np.array([energy(name, column, plant.params) for column in x.T])
    moved = np.ptp([energy(name, np.append(c[: n // 2], 0 * c[n // 2 :]), plant.params)
                    for c in x.T])  # fmt: skip
    assert np.ptp(levels) < 1e-7 * max(moved, 1e-3)


@pytest.mark.parametrize("name", PLANTS)
def test_a_force_does_the_work_that_its_velocity_says(name):
    # Power of each generalised force is force times velocity: this fixes where it works.
    plant = PLANTS[name].mechanism
    rng, n = np.random.default_rng(2), PLANTS[name].nstates
    for velocity, force in plant.forces.items():
        x, u = 0.5 * rng.standard_normal(n), np.zeros(plant.ninputs)
        slope = np.array([
            (energy(name, x + h, plant.params) - energy(name, x - h, plant.params)) / 2e-6
            for h in 1e-6 * np.eye(n)
        ])  # fmt: skip
        still = slope @ plant.dynamics(0, x, u)
        u[plant.input_labels.index(force)] = 1.0
        power = slope @ plant.dynamics(0, x, u) - still
        assert power == pytest.approx(x[plant.state_labels.index(velocity)], rel=1e-5)


@pytest.mark.parametrize("name", PLANTS)
def test_exact_linear_model_is_that_of_python_control(name):
    plant = PLANTS[name]
    outputs = [0.0] * plant.noutputs
    at = cid.operating_point(plant, output=outputs)
    ours = cid.linearize(plant, at)
    theirs = ct.linearize(plant, at.states, np.atleast_1d(at.input))
    for key in "ABCD":
        np.testing.assert_allclose(
            getattr(ours, key), getattr(theirs, key), rtol=1e-4, atol=1e-4, err_msg=key
        )
    assert ours.state_labels == plant.state_labels
    assert ours.output_labels == plant.output_labels
    hover = {"quadrotor_planar": (0.5 * 9.81 / 2,) * 2}.get(name, 0.0)
    assert at.input == pytest.approx(hover, abs=1e-9)


@pytest.mark.parametrize("name", PLANTS)
def test_equations_are_traced_with_and_without_the_forces(name):
    plant = PLANTS[name]
    assert trace(plant).inputs == tuple(plant.input_labels)
    assert set(plant.forces.values()) <= set(trace(plant.mechanism).inputs)
    assert len(trace(plant).velocities) == plant.noutputs


def test_a_leaning_pole_falls_and_a_pushed_cart_tilts_it_back():
    plant = PLANTS["cart_pole"]
    assert plant.dynamics(0, [0, 0.1, 0, 0], [0.0])[3] > 0
    assert plant.dynamics(0, [0, 0, 0, 0], [1.0])[2] > 0


@pytest.mark.parametrize("change", [{"M": 0.0}, {"m": -1.0}, {"length": np.nan}, {"c": -0.1}])
def test_a_mechanism_refuses_what_physics_does_not_have(change):
    with pytest.raises(cid.CtrlidError, match=f"cart_pole needs {next(iter(change))} >"):
        cid.plants.cart_pole(**{"M": 1.0, "m": 0.2, "length": 0.3, **change})


def test_swing_of_a_loop_that_sticks_is_no_flight():
    # A pole above a cart that sticks falls until the cart slips: the loop swings to and fro without
    # a reference, as far as the friction lets it.
    plant = cid.plants.cart_pole(M=0.5, m=0.2, length=0.3, c=0.1)
    upright = cid.operating_point(plant, output=(0, 0))
    G = ct.sample_system(cid.linearize(plant, upright), 0.005)
    K = ct.dlqr(G, np.diag([10.0, 10.0, 1.0, 1.0]), np.eye(1))[0]
    L = G.A @ ct.dlqe(G.A, G.B, G.C, np.eye(1), 1e-4 * np.eye(2))[0]
    observer = ct.ss(G.A - L @ G.C, np.hstack([L, G.B]), -K, np.zeros((1, 3)), 0.005,
                     inputs=["x", "theta", "F"], outputs=["F"])  # fmt: skip
    loop = cid.Loop(plant, observer, dt=0.005, at=upright)
    for difference in (0.006, 0.1):
        rubbing = loop.with_effect(
            cid.effects.AsymmetricCoulombFriction(fc=0.5, difference=difference, at="x_dot")
        )
        tilt = cid.simulate(rubbing, d=np.zeros(2000)).y[1]
        assert 1e-3 < np.abs(tilt).max() < 0.5
    # With the wrong sign it does fly, friction or not.
    flipped = ct.ss(observer.A, observer.B, -observer.C, observer.D, 0.005,
                    inputs=observer.input_labels, outputs=observer.output_labels)  # fmt: skip
    wrong = cid.Loop(plant, flipped, dt=0.005, at=upright)
    rubbing = wrong.with_effect(cid.effects.CoulombFriction(fc=0.01, at="x_dot"))
    with pytest.raises(cid.CtrlidError, match="diverged"):
        cid.simulate(rubbing, d=0.1 * np.ones(4000))
