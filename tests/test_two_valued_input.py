"""An input of two values hides much, and a set says so: a limit is not left out of it."""

import control as ct
import numpy as np
import pytest
from scipy import signal

import ctrlid as cid
from ctrlid import effects as E
from ctrlid.diagnosis.replicas import _design_normalized_controller

DT, N = 0.01, 1000
# What is nearest to a limit of the input, and what a mass on a spring may lack. With the whole
# catalogue the search takes several times longer and says nothing more of limits.
SOME = (
    E.InputSaturation, E.InputSaturatingGain, E.InputDeadZone, E.InputNonlinearity,
    E.CoulombFriction, E.CubicStiffness,
)  # fmt: skip


def push_spring(seed, lower, upper, levels=(0.1, 1.5)):
    """Return a record of a mass on a spring, driven by an input of two values through limits."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice(levels, N // 20), 20)
    a, b = np.array([[0.0, 1.0], [-120.0, -4.0]]), np.array([[0.0], [1.0]])
    a, b, *_ = signal.cont2discrete((a, b, np.eye(2), np.zeros((2, 1))), DT)
    x, y = np.zeros(2), np.zeros(N)
    for k in range(N):
        y[k] = x[0]
        x = a @ x + b[:, 0] * np.clip(u[k], lower, upper)
    return cid.Record(u=u, y=y + 1e-4 * rng.standard_normal(N), dt=DT)


def make_loop():
    plant = ct.nlsys(
        lambda t, x, u, p: [x[1], (u[0] - p["c"] * x[1] - p["s"] * x[0]) / p["m"]],
        lambda t, x, u, p: x[0], inputs=["F"], outputs=["x"], states=["x", "v"],
        params={"m": 1.0, "c": 4.0, "s": 120.0}, name="spring",
    )  # fmt: skip
    at = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
    return cid.Loop(plant, None, dt=DT, at=at, free=("s", "c"))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_limits_on_both_sides_are_found(seed):
    record = push_spring(seed, 0.45, 1.0)
    found = cid.diagnose(record, make_loop(), catalogue=SOME, progress=False)
    assert found.verdict == "explained"
    (finding,) = found.findings
    assert finding.names == ("InputSaturation",)
    assert finding.effect.lower == pytest.approx(0.45, abs=5e-3)
    assert finding.effect.upper == pytest.approx(1.0, abs=5e-3)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_limit_stays_beside_a_gain_that_saturates(seed):
    # With an upper limit alone nothing tells the two apart, and the gain has a parameter less.
    record = push_spring(seed, -np.inf, 1.0)
    found = cid.diagnose(record, make_loop(), catalogue=SOME, progress=False)
    assert found.verdict == "explained"
    (finding,) = found.findings
    assert {"InputSaturation", "InputSaturatingGain"} <= set(finding.names)


@pytest.mark.parametrize("levels", [[0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
def test_limits_start_well_inside_an_input_of_two_values(levels):
    sight = type("Sight", (), {"inputs": np.array(levels)})()
    starts = E.InputSaturation(0.0, 1.0).other_starts(sight)
    assert [(s.lower, s.upper) for s in starts] == [(0.25, 0.75), (0.375, 0.625)]
    flat = type("Sight", (), {"inputs": np.ones(3)})()
    assert E.InputSaturation(0.0, 1.0).other_starts(flat) == ()


def test_no_controller_is_designed_where_the_input_moves_nothing():
    still = ct.ss([], [], [], [[0.0]])
    assert _design_normalized_controller(still, DT, np.ones(1), np.ones(1)) is None
