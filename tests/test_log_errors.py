"""A record with a wrong sign or a wrong unit is told so, and no effect is named on it.

The rig is simulated here, in numpy: a stick that stands on its pivot, J th" = m g l sin th - c th'
+ u, under a digital law on filtered differences.
"""

import math
from dataclasses import replace

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid.diagnosis.log_errors import Log, _measure, _scale, find_log_error

MASS, LENGTH, GRAVITY, DT = 0.35, 0.40, 9.81, 0.005
INERTIA = MASS * LENGTH**2


def simulate(n=800, seed=0, damping=0.02, friction=0.0, inertia=1.08 * INERTIA):
    rng = np.random.default_rng(seed)
    r = np.repeat(rng.choice([-0.08, 0.08], n // 40 + 1), 40)[:n]
    y, u, angle, rate, before = np.zeros(n), np.zeros(n), 0.0, 0.0, None
    steps = 6
    h = DT / steps

    def move(state, torque):
        angle, rate = state
        push = MASS * GRAVITY * LENGTH * math.sin(angle) + torque - damping * rate
        return np.array([rate, (push - friction * math.tanh(rate / 1e-3)) / inertia])

    for k in range(n):
        y[k] = angle + 3e-4 * rng.standard_normal()
        before = y[k] if before is None else before
        u[k] = 9.0 * (r[k] - y[k]) - 0.9 * (y[k] - before) / DT
        before = y[k]
        for _ in range(steps):
            state = np.array([angle, rate])
            k1 = move(state, u[k])
            k2 = move(state + h / 2 * k1, u[k])
            k3 = move(state + h / 2 * k2, u[k])
            k4 = move(state + h * k3, u[k])
            angle, rate = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return r, u, y


@pytest.fixture(scope="module")
def loop():
    plant = ct.nlsys(
        lambda t, x, u, p: [x[1], (MASS * GRAVITY * LENGTH * np.sin(x[0]) + u[0]
                                   - 0.02 * x[1]) / p["J"]],
        lambda t, x, u, p: [x[0]],
        states=["theta", "omega"], inputs=["tau"], outputs=["theta"], name="stick",
        params={"J": INERTIA},
    )  # fmt: skip
    return cid.Loop(plant, None, dt=DT, free=("J",))


FAULTS = {
    "sign of u": (lambda r, u, y: (r, -u, y), "wrong sign"),
    "degrees": (lambda r, u, y: (np.rad2deg(r), u, np.rad2deg(y)), "degrees where the model has"),
    "milli": (lambda r, u, y: (r, 1e3 * u, y), "u is a thousand times too large"),
    "early": (lambda r, u, y: (r[:-1], u[:-1], y[1:]), "y is logged one sample early"),
}


@pytest.mark.parametrize(
    "fault",
    # Degrees are asked of below, in a search without time.
    [pytest.param(k, marks=[pytest.mark.slow] * (k != "early")) for k in FAULTS],
)
def test_the_log_is_the_headline_and_nothing_is_named(loop, fault):
    spoil, words = FAULTS[fault]
    r, u, y = spoil(*simulate(seed=1))
    small = [cid.effects.CoulombFriction, cid.effects.ConstantForce, cid.effects.ViscousFriction]
    found = cid.diagnose(loop, cid.Record(r=r, u=u, y=y, dt=DT), catalogue=small, progress=False)
    assert found.verdict == "unknown"
    assert not found.findings
    assert found.sentence.startswith("THE LOG LOOKS WRONG")
    assert words in found.sentence


@pytest.mark.parametrize("friction", [0.0, 0.06])
def test_a_right_log_is_not_blamed(loop, friction):
    r, u, y = simulate(1000, seed=2, friction=friction)
    small = [cid.effects.CoulombFriction, cid.effects.ConstantForce, cid.effects.ViscousFriction]
    found = cid.diagnose(loop, cid.Record(r=r, u=u, y=y, dt=DT), catalogue=small, progress=False)
    assert "LOG" not in found.sentence
    assert [f.name for f in found.findings] == (["CoulombFriction"] if friction else [])


def test_who_has_no_time_is_told_of_the_log_all_the_same(loop):
    r, u, y = FAULTS["degrees"][0](*simulate(seed=2))
    found = cid.diagnose(loop, cid.Record(r=r, u=u, y=y, dt=DT), seconds=0.2, progress=False)
    assert found.sentence.startswith("THE LOG LOOKS WRONG"), found.sentence
    assert (found.verdict, found.findings, found.finished) == ("unknown", (), True)


def simulate_spring(reaches, n=600, seed=4):
    """Mass on a spring, m x" = F - s x - c x', driven by steps of F that may not reach it."""
    rng = np.random.default_rng(seed)
    mass, stiffness, damping, dt, steps = 1.5, 90.0, 2.5, 0.02, 8
    u = np.repeat(rng.uniform(-2.0, 2.0, n // 40 + 1), 40)[:n]
    y, state, h = np.zeros(n), np.array([0.01, 0.0]), dt / steps
    for k in range(n):
        y[k] = state[0] + 2e-4 * rng.standard_normal()
        push = u[k] if reaches else 0.0
        for _ in range(steps):
            middle = state + h / 2 * np.array(
                [state[1], (push - stiffness * state[0] - damping * state[1]) / mass]
            )
            state = state + h * np.array(
                [middle[1], (push - stiffness * middle[0] - damping * middle[1]) / mass]
            )
    return u, y, dt


def make_spring_loop(dt):
    plant = ct.nlsys(
        lambda t, x, u, p: [x[1], (u[0] - p["s"] * x[0] - 2.5 * x[1]) / 1.5],
        lambda t, x, u, p: x[0],
        states=["x", "v"], inputs=["F"], outputs=["x"], name="spring", params={"s": 90.0},
    )  # fmt: skip
    return cid.Loop(plant, None, dt=dt, free={"s": 0.05})


@pytest.mark.parametrize("reaches", [False, True])
def test_an_input_that_does_nothing_is_the_headline(reaches):
    u, y, dt = simulate_spring(reaches)
    loop = make_spring_loop(dt)
    small = [cid.effects.LinearStiffness, cid.effects.CoulombFriction, cid.effects.InputSaturation]
    found = cid.diagnose(loop, cid.Record(u=u, y=y, dt=dt), catalogue=small, progress=False)
    assert found.sentence.startswith("THE INPUT DOES NOT SEEM TO REACH THE PLANT") != reaches
    assert found.verdict == ("nothing missing" if reaches else "unknown")
    assert not found.findings


def test_an_output_that_does_not_move_is_the_headline():
    """Dry friction that holds a mass against all that the input does names nothing."""
    u, _, dt = simulate_spring(True)
    y = 3e-3 + 2e-4 * np.random.default_rng(5).standard_normal(len(u))
    loop = make_spring_loop(dt)
    small = [cid.effects.SensorGain, cid.effects.CoulombFriction, cid.effects.ViscousFriction]
    found = cid.diagnose(loop, cid.Record(u=u, y=y, dt=dt), catalogue=small, progress=False)
    assert found.sentence.startswith("THE OUTPUT DOES NOT SEEM TO MOVE"), found.sentence
    assert (found.verdict, found.findings, found.stand_ins) == ("unknown", (), ())


@pytest.mark.slow
def test_a_repair_after_which_the_input_does_nothing_is_none():
    """A random force explains any record that wanders, in any unit."""
    rng = np.random.default_rng(12)
    u = cid.random_binary(900, amplitude=1.0, hold=20, seed=13)
    y = np.cumsum(rng.standard_normal(900)) * 1e-3 + 1e-4 * rng.standard_normal(900)
    plant = ct.nlsys(lambda t, x, u, p: [-0.05 * x[0] + u[0]], lambda t, x, u, p: [x[0]],
                     states=["h"], inputs=["q"], outputs=["h"], name="tank")  # fmt: skip
    loop = cid.Loop(plant, None, dt=0.1)
    record = cid.Record(u=u, y=y, dt=0.1)
    log = Log(loop, [record], (), -1e9)
    moved = _measure(loop, [_scale(record, 1e-3, 1.0)], None)
    assert moved > log.least  # so that a thousandth of the input looks like a mend
    assert find_log_error(log) is None
    # Where the input moves the plant, the same log has an error that is found.
    driven = cid.simulate(loop, d=u, sensor_noise=1e-3, seed=14)
    wrong = replace(driven, u=1e3 * np.asarray(driven.u))
    found = find_log_error(Log(loop, [wrong], (), -1e9))
    assert found is not None
    assert "u is a thousand times too large" in found.words


@pytest.mark.parametrize("known", [False, True])
def test_a_wrong_unit_is_seen_beside_the_steps_of_a_converter(loop, known):
    """The steps are in the log a thousand times too large as well, those of the model are not."""
    r, u, y = simulate(seed=5)
    step = 4e-3
    y = step * np.round(y / step)
    record = cid.Record(r=1e3 * r, u=u, y=1e3 * y, dt=DT)
    audits = [cid.audit(record)]
    assert audits[0].quantum["y"] == pytest.approx(1e3 * step)
    stepped = loop.with_effect(cid.effects.Quantization(step if known else 1e3 * step))
    reached = _measure(stepped, [record], audits)
    found = find_log_error(Log(stepped, [record], audits, reached))
    assert found is not None
    assert "y and r are a thousand times too large" in found.words
