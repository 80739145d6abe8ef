"""Whether anything depends on a quantity: silent beside a right model, loud beside a wrong one."""

from dataclasses import replace

import control as ct
import numpy as np
import pytest

import ctrlid as cid
import problems
from ctrlid import effects as E
from ctrlid.diagnosis.noise_tests import run_noise_tests
from ctrlid.diagnosis.recalibration import fit_base_model
from ctrlid.diagnosis.shape_scores import compute_score_probability
from test_several_outputs import swinging

KINDS = ("force by ", "slope by ", "reading by ")


def drive_of(free=("k", "c"), plant=None):
    return problems.drive(free, plant or cid.plants.servo(m=2.0, c=5.0, k=30.0))


def with_hysteresis(force):
    """The drive with a friction that bends like a spring before it slides, as Dahl has it."""

    def rates(t, x, u, p):
        rubbed = np.sign(x[1]) * x[2]
        a = (30.0 * u[0] - 5.0 * x[1] - force * x[2]) / 2.0
        return np.array([x[1], a, x[1] / 0.05 * (1 - rubbed)])

    plant = ct.nlsys(rates, lambda t, x, u, p: x[0], inputs=["u"], outputs=["y"],
                     states=["x", "v", "z"], name="drive")  # fmt: skip
    at = cid.OperatingPoint((0.0, 0.0, 0.0), 0.0, 0.0)
    loop = drive_of()
    return cid.Loop(plant, loop.controller, dt=loop.dt, at=at)


def record_of(loop, seed, n=2000):
    return problems.record_of(loop, swing=0.3, hold=60, n=n, seed=seed, sensor_noise=1e-4)


def seen_in(loop, record):
    return run_noise_tests(fit_base_model(loop, [record], loop.free).fit).p_values


def split(p_values):
    shapes = {k: p for k, p in p_values.items() if k.startswith(KINDS)}
    return shapes, {k: p for k, p in p_values.items() if k not in shapes}


def test_beside_a_right_model_the_probabilities_are_uniform():
    loop = drive_of()
    found = [split(seen_in(loop, record_of(loop, seed)))[0] for seed in range(9900, 9924)]
    assert len(found[0]) == 18  # of time, input, its change, position, velocity and reference
    p = np.array([list(f.values()) for f in found])
    assert p.min() > 1e-5
    assert 0.4 < np.mean(p < 0.5) < 0.6
    assert 0.02 < np.mean(p < 0.09) < 0.14


def test_a_hysteresis_that_other_tests_hardly_see_is_seen():
    for seed in (9930, 9931):
        shapes, others = split(seen_in(drive_of(), record_of(with_hysteresis(0.02), seed)))
        assert min(shapes.values()) < 1e-8
        assert min(others.values()) > 1e-7


def test_an_error_of_the_reading_shows_as_one():
    loop = drive_of()
    record = record_of(loop, 9940)
    lost = 3e-5 * np.sign(np.gradient(record.y))  # the logger lags behind a gear with play
    shapes, _ = split(seen_in(loop, replace(record, y=record.y - lost)))
    assert min(shapes, key=shapes.get) == "reading by velocity"
    assert shapes["reading by velocity"] < 1e-8


def test_what_parameters_take_up_says_nothing():
    nothing = np.zeros(3), np.zeros((3, 3)), np.ones(3)
    assert compute_score_probability(*nothing) == 1.0
    assert compute_score_probability(np.full(3, np.nan), *nothing[1:]) == 1.0
    # A shape of which a millionth of a millionth is left has no freedom of its own.
    score, left = np.array([1.0, 1e-3]), np.diag([1.0, 1e-12])
    p = compute_score_probability(score, left, np.ones(2))
    assert p == compute_score_probability(score[:1], left[:1, :1], np.ones(1))
    assert 0.31 < p < 0.32  # of a standard normal deviate of one


def test_forces_and_readings_of_several_signals_are_told_apart():
    loop, record = swinging(free=("M",))
    p = seen_in(loop, record)
    shapes = [k for k in p if k.startswith(("force", "slope", "reading"))]
    assert {k.partition(" by ")[0] for k in shapes} == {
        "force at x_dot", "slope at x_dot", "force at theta_dot", "slope at theta_dot",
        "reading of x", "reading of theta",
    }  # fmt: skip
    assert min(p.values()) > 1e-4
    alpha = np.array(record.y)
    alpha[1] += 1e-3 * np.sin(150.0 * alpha[0])  # the encoder of the pole is bent by the cart
    p = seen_in(loop, replace(record, y=alpha))
    assert min(shapes, key=p.get) == "reading of theta by x"
    assert p["reading of theta by x"] < 1e-6


def chain(t, x, u, p):
    spring = 5.0 * (x[2] - x[0])
    return np.array([x[1], u[0] - p["k"] * x[0] - x[1] + spring, x[3], -spring - 2.0 * x[3]])


def tanks(t, x, u, p):
    return np.array([u[0] - p["k"] * x[0], x[0] - 0.5 * x[1], 0.5 * x[1] - 0.7 * x[2]])


@pytest.mark.parametrize(
    ("rates", "states", "kinds"),
    [(chain, ("x1", "v1", "x2", "v2"), {"force", "slope", "reading"}),
     (tanks, ("h1", "h2", "h3"), {"force at h1", "force at h2", "force at h3", "slope at h1",
                                  "slope at h2", "slope at h3", "reading"})],
)  # fmt: skip
def test_one_output_of_several_masses_or_tanks(rates, states, kinds):
    """One force acts on all velocities of a plant with one output, and one on each level."""
    plant = ct.nlsys(rates, lambda t, x, u, p: x[2], inputs=["u"], outputs=["y"], states=states,
                     params={"k": 1.0}, name="plant")  # fmt: skip
    loop = cid.Loop(plant, dt=0.05, free=("k",))
    d = cid.random_binary(1500, amplitude=1.0, hold=30, seed=1)
    p = seen_in(loop, cid.simulate(loop, d=d, sensor_noise=1e-3, seed=2))
    shapes = [k for k in p if k.startswith(("force", "slope", "reading"))]
    assert {k.partition(" by ")[0] for k in shapes} == kinds
    assert min(p[k] for k in shapes) > 1e-4


def test_a_quantity_counts_where_it_moves_in_one_record_of_several():
    loop = drive_of()
    moved = record_of(loop, 9950, n=900)
    still = cid.simulate(loop, np.full(600, 0.1), sensor_noise=1e-4, seed=3)
    fit = fit_base_model(loop, [moved, still], loop.free).fit
    shapes, _ = split(run_noise_tests(fit).p_values)
    assert len(shapes) == 18
    without = replace(still, r=None)
    fit = fit_base_model(loop, [moved, without], loop.free).fit
    shapes, _ = split(run_noise_tests(fit).p_values)
    assert len(shapes) == 15  # all but the reference, which one record does not have


def test_a_slope_of_the_input_shows_where_the_input_acts():
    """The force of a period depends on the input at its beginning, not on that before it.

    An input that is drawn anew for every sample tells one from the other.
    """
    rng = np.random.default_rng(9950)
    bend = E.InputNonlinearity(curvature=0.02)
    loop = replace(drive_of(), controller=None)
    u = rng.uniform(-3.0, 3.0, 1500)
    record = cid.simulate(loop.with_effect(bend), d=u, sensor_noise=1e-4, seed=9951)
    p = seen_in(loop, record)
    # By the input a sample before, the probability is 7e-5; it is 8e-86 by the one that acts.
    assert p["slope by input"] < 1e-20
