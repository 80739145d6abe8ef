"""An actuator that moves at a limited speed.

The records are of plain arithmetic, without ctrlid: a pendulum on its head, balanced by a PD
controller with a filtered derivative through a servo whose arm runs at a limited speed.
"""

import dataclasses

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import effects as E
from ctrlid.estimation.likelihood.input_memory import find_input_range
from ctrlid.loop.simulation import Simulator
from problems import levitation

DT, PARTS, NOISE, PUSH = 0.01, 20, 2e-4, 0.02
GRAVITY, GAIN, DAMPING = 9.0, 1.0, 0.1
KP, KD, FILTER = 30.0, 6.0, 0.6


def turn(angle: float, speed: float, arm: float) -> np.ndarray:
    return np.array([speed, GRAVITY * np.sin(angle) + GAIN * arm - DAMPING * speed])


def record_servo(seed: int, rate: float, n: int = 1500, before: int = 0) -> cid.Record:
    """Return a record of the rig, which had run for some samples before it began."""
    rng = np.random.default_rng(seed)
    total, h = n + before, DT / PARTS
    r = np.repeat(rng.uniform(-0.1, 0.1, total // 40 + 1), 40)[:total]
    state, arm, slow, old = np.zeros(2), 0.0, 0.0, 0.0
    y, u = np.zeros(total), np.zeros(total)
    for k in range(total):
        y[k] = state[0] + NOISE * rng.standard_normal()
        error = r[k] - y[k]
        slow = FILTER * slow + (1 - FILTER) * (error - old) / DT
        old = error
        u[k] = KP * error + KD * slow
        push = np.array([0.0, PUSH * rng.standard_normal()])
        for _ in range(PARTS):
            # A servo without a limit is there at once.
            last = arm if rate < np.inf else u[k]
            arm = last + min(max(u[k] - last, -rate * h), rate * h)
            one = turn(*state, last) + push
            two = turn(*(state + h / 2 * one), (last + arm) / 2) + push
            three = turn(*(state + h / 2 * two), (last + arm) / 2) + push
            four = turn(*(state + h * three), arm) + push
            state = state + h / 6 * (one + 2 * two + 2 * three + four)
    return cid.Record(r=r[before:], u=u[before:], y=y[before:], dt=DT)


def make_loop(hidden: tuple = ()) -> cid.Loop:
    """Return what the user knows, with a gravity and a gain that are a little off."""
    plant = ct.nlsys(
        lambda t, x, u, q: np.array([x[1], q["a"] * np.sin(x[0]) + q["b"] * u[0] - q["c"] * x[1]]),
        lambda t, x, u, q: x[0], inputs=["arm"], outputs=["angle"], states=["angle", "speed"],
        params={"a": 1.02 * GRAVITY, "b": 1.03 * GAIN, "c": DAMPING}, name="balanced",
    )  # fmt: skip
    law = ct.tf([KP], [1.0], DT) + ct.tf([KD * (1 - FILTER) / DT, -KD * (1 - FILTER) / DT],
                                         [1.0, -FILTER], DT)  # fmt: skip
    at = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
    return cid.Loop(plant, law, dt=DT, at=at, free={"a": 0.05, "b": 0.05}, effects=hidden)


# Two of its look-alikes and two others; the slow tests take all of the catalogue.
SOME = (E.InputRateLimit, E.ActuatorLag, E.InputDelay, E.InputSaturation, E.InputBacklash)


@pytest.mark.parametrize(
    ("seed", "rate", "before", "catalogue"),
    [
        (1, 60.0, 0, SOME),
        pytest.param(2, 60.0, 700, E.CATALOGUE, marks=pytest.mark.slow),
        pytest.param(7, 150.0, 0, E.CATALOGUE, marks=pytest.mark.slow),
        pytest.param(8, 150.0, 350, E.CATALOGUE, marks=pytest.mark.slow),
    ],
)
def test_a_servo_of_limited_speed_is_named_alone_and_its_speed_is_found(
    seed, rate, before, catalogue
):
    found = cid.diagnose(
        make_loop(), record_servo(seed, rate, before=before), progress=False, catalogue=catalogue
    )
    assert found.verdict == "explained"
    assert [f.names for f in found.findings] == [("InputRateLimit",)]
    (finding,) = found.findings
    assert finding.effect.rate == pytest.approx(rate, rel=0.01)
    assert abs(finding.effect.rate - rate) < 4 * finding.standard_errors["rate"]
    assert found.gap.after < 1.3 * found.gap.floor


def test_a_servo_without_a_limit_has_none():
    found = cid.diagnose(make_loop(), record_servo(3, np.inf), progress=False, catalogue=SOME)
    assert found.verdict == "nothing missing"


def test_the_mean_of_the_ramp_moves_an_integrator_as_the_ramp_does():
    rate, dt, fine = 3.0, 0.1, 1000
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-1, 1, 20), rng.integers(1, 6, 20))
    plant = ct.nlsys(lambda t, x, u, q: u, lambda t, x, u, q: x, inputs=["u"], outputs=["x"],
                     states=["x"], name="integrator")  # fmt: skip
    at = cid.OperatingPoint((0.0,), 0.0, 0.0)
    loop = cid.Loop(plant, dt=dt, at=at, effects=(E.InputRateLimit(rate),))
    x, arm, exact = 0.0, 0.0, []
    for value in u:
        exact.append(x)
        for _ in range(fine):
            last = arm
            arm += min(max(value - arm, -rate * dt / fine), rate * dt / fine)
            x += (last + arm) / 2 * dt / fine
    y = cid.simulate(loop, d=u).y
    np.testing.assert_allclose(y, exact, atol=1e-6)


@pytest.mark.parametrize("hold", ["foh", "bandlimited"])
def test_a_straight_input_is_followed_from_sample_to_sample(hold):
    dt = 0.05
    t = dt * np.arange(200)
    u = np.sin(2 * np.pi * 0.2 * t)  # It changes by up to 1.26 per second.
    plant = ct.nlsys(lambda t, x, u, q: u - x, lambda t, x, u, q: x, inputs=["u"], outputs=["x"],
                     states=["x"], name="lag")  # fmt: skip
    plain = cid.Loop(plant, dt=dt, at=cid.OperatingPoint((0.0,), 0.0, 0.0))

    def run(*effects):
        loop = dataclasses.replace(plain, effects=effects)
        simulator = Simulator(loop, tolerance=1e-6, hold=hold)
        y = simulator.run(simulator.start(None), None, u)[0]
        return y, cid.predict(loop, cid.Record(u=u, y=y, dt=dt, hold=hold), noise_ratio=1.0)

    free, fast, slow = run(), run(E.InputRateLimit(2.0)), run(E.InputRateLimit(0.5))
    np.testing.assert_allclose(fast[0], free[0], atol=1e-9)
    assert np.ptp(slow[0]) < 0.8 * np.ptp(free[0])
    # The filter follows the input as the simulation does.
    assert np.abs(slow[1].innovations[10:]).max() < 1e-5


@pytest.mark.parametrize(
    ("first", "periods"),
    [(0.0, [0.5, 1.5, 2.5, 3.5]), (5.0, [0.0, -0.5, -1.5, -2.5])],
    ids=["at rest", "where it is told to be"],
)
def test_the_start_of_a_record_is_exact_where_the_actuator_rests_or_has_arrived(first, periods):
    rate, n = 8.0, 60
    rng = np.random.default_rng(4)
    u = np.concatenate([[5.0], np.repeat(rng.uniform(-1, 1, n // 5), 5)[1:]])
    e = make_loop((E.InputRateLimit(rate),)).equations(keep=True)
    index = [list(e.parameters).index("InputRateLimit.rate")]
    ranges = find_input_range(e, index, u, e.values, at_rest=0.0, period=DT, held=True)
    arm, means = first, []
    for value in u:
        way = min(max(value - arm, -rate * DT), rate * DT)
        means.append(arm + way - way * abs(way) / (2 * rate * DT))
        arm += way
    np.testing.assert_allclose(ranges.follow(np.array(first)), means, atol=1e-4)
    memory, certain = np.full(n, first), np.zeros(n)
    applied, by_memory, by_rate = ranges.linearize(memory, certain)
    np.testing.assert_allclose(applied, means, atol=1e-4)
    # A larger speed takes the arm further for as long as it has moved.
    np.testing.assert_allclose(by_rate[:4, 0], DT * np.array(periods), atol=1e-6)
    # The whole way of 5 is the same at both ends, until one of them has arrived.
    assert by_memory[0] == pytest.approx((5.0 - rate * DT / 2) / 5.0, rel=1e-4)


def test_a_speed_of_zero_moves_nothing_and_an_infinite_one_changes_nothing():
    loop = levitation(free=())
    r = cid.random_binary(200, amplitude=1e-4, hold=20, around=loop.point.output, seed=1)
    free = cid.simulate(loop.with_effect(E.InputRateLimit(np.inf)), r)
    np.testing.assert_array_equal(free.y, cid.simulate(loop, r).y)
    drive = cid.Loop(ct.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]], inputs=["u"], outputs=["y"]), dt=0.1)
    held = drive.with_effect(E.InputRateLimit(0.0))
    np.testing.assert_array_equal(cid.simulate(held, d=np.ones(10)).y, np.zeros(10))


def test_one_loop_remembers_its_input_once():
    loop = levitation().with_effect(E.InputRateLimit(100.0))
    with pytest.raises(cid.CtrlidError, match="single InputBacklash or InputRateLimit"):
        loop.with_effect(E.InputBacklash(0.01))
    with pytest.raises(cid.CtrlidError, match="InputRateLimit"):
        loop.system()


def test_what_bends_the_input_ahead_of_it_bends_where_it_rests_as_well():
    offset, rate = 0.5, 4.0
    plant = ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs=["u"], outputs=["y"])
    loop = cid.Loop(plant, dt=0.1, effects=(E.InputRateLimit(rate), E.InputOffset(offset)))
    plain = cid.Loop(plant, dt=0.1, effects=(E.InputOffset(offset),))
    # Nothing changes at rest: the actuator stands where the bent input is.
    still = np.zeros(20)
    np.testing.assert_allclose(cid.simulate(loop, d=still).y, cid.simulate(plain, d=still).y)
