"""Simulation against tight-tolerance references, noise statistics, and failures in words.

Groups: accuracy; signals (noise, d, initial states, limits); failures; the loop itself.
"""

import copy
import warnings

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ctrlid as cid
from ctrlid import CtrlidError
from ctrlid.loop.period_map import compute_growth_rate
from ctrlid.loop.simulation import make_simulator
from problems import REST, drive, held_ball, rough_mass, servo, tank, under_lead

RNG = np.random.default_rng(5)
CASES = [
    (RNG.uniform(0.01, 0.1), RNG.uniform(0.005, 0.02), RNG.uniform(1, 10), share, analog)
    for share in (0.3, 0.1, 0.02)
    for analog in (False, True)
]


def make(mass, gap, voltage, share=0.05, analog=False, **kwargs):
    """Levitate a ball with a lead at 2.5 times its unstable pole p and p*dt = share."""
    plant = held_ball(mass, gap, voltage)
    op = cid.operating_point(plant, output=gap)
    p = np.sqrt(2 * 9.81 / gap)
    return under_lead(plant, share / p, op, crossover=2.5 * p, analog=analog, **kwargs), op


def reference(loop, r):
    """Integrate period by period with SciPy at a tolerance near round-off."""
    c, op, plant = ct.ss(loop.controller), loop.at, loop.plant
    n, z = plant.nstates, np.r_[loop.at.states, np.zeros(ct.ss(loop.controller).nstates)]
    ys, us = [], []

    def control(z, rk):
        return op.input + (c.C @ z[n:])[0] + c.D[0, 0] * (rk - z[0])

    for rk in r:
        u = control(z, rk)
        ys.append(z[0])
        us.append(u)

        def rate(t, z, rk=rk, u=u):
            u = control(z, rk) if loop.analog else u
            slope = c.A @ z[n:] + c.B[:, 0] * (rk - z[0]) if loop.analog else 0 * z[n:]
            return np.r_[plant.updfcn(t, z[:n], [u], plant.params), slope]

        after = solve_ivp(rate, (0, loop.dt), z, method="DOP853", rtol=1e-12, atol=1e-15).y[:, -1]
        if not loop.analog:
            after[n:] = c.A @ z[n:] + c.B[:, 0] * (rk - z[0])
        z = after
    return np.array(ys), np.array(us)


@pytest.mark.parametrize(("mass", "gap", "voltage", "share", "analog"), CASES)
def test_simulation_is_accurate(mass, gap, voltage, share, analog):
    loop, op = make(mass, gap, voltage, share, analog)
    r = cid.random_binary(60, amplitude=0.01 * gap, hold=7, around=gap, seed=3)
    record = cid.simulate(loop, r)
    y, u = reference(loop, r)
    assert np.abs(record.y - y).max() < 1e-7 * y.std()
    assert np.abs(record.u - u).max() < 1e-7 * u.std()
    assert record.hold == ("foh" if analog else "zoh")
    assert record.names["y"] == "x"
    assert record.names["u"] == "V"
    assert op.input == pytest.approx(voltage)


def test_linear_sampled_loop_equals_matrix_recursion():
    a, b, c = np.array([[0.0, 1.0], [4.0, -1.0]]), np.array([[0.0], [-3.0]]), np.array([[1.0, 0]])
    plant = ct.ss(a, b, c, 0)
    at = cid.OperatingPoint((0.0, 0.0), 2.0, 0.5)
    loop = cid.Loop(plant, ct.tf([-8.0, 6.5], [1.0, -0.2], 0.1), dt=0.1, at=at)
    r = 0.5 + 0.1 * np.sign(np.sin(np.arange(80)))
    record = cid.simulate(loop, r)
    sampled = ct.sample_system(plant, 0.1)
    x, q = np.zeros(2), np.zeros(1)
    C = ct.ss(loop.controller)
    for k, rk in enumerate(r):
        y = (sampled.C @ x)[0]
        e = rk - (0.5 + y)
        v = (C.C @ q)[0] + C.D[0, 0] * e
        assert record.y[k] == pytest.approx(0.5 + y, abs=1e-10)
        assert record.u[k] == pytest.approx(2.0 + v, abs=1e-9)
        x = sampled.A @ x + sampled.B[:, 0] * v
        q = C.A @ q + C.B[:, 0] * e


def test_discrete_plant_steps_as_its_difference_equation():
    G = ct.tf([0.2, 0.1], [1.0, -2.05, 1.0], 0.02)
    loop = cid.Loop(G, ct.tf([4.0, -3.4], [1.0, 0.2], 0.02), dt=0.02,
                    at=cid.OperatingPoint((0.012, 0.0), 3.0, 1.0))  # fmt: skip
    record = cid.simulate(loop, 1.0 + 0.1 * np.ones(50))
    y, u = record.y - 1.0, record.u - 3.0
    np.testing.assert_allclose(
        y[2:], 2.05 * y[1:-1] - y[:-2] + 0.2 * u[1:-1] + 0.1 * u[:-2], atol=1e-12
    )


def test_noise_has_the_size_asked_for_and_its_own_stream():
    loop, op = make(0.02, 0.01, 3.0)
    r = np.full(4000, op.output)
    quiet = cid.simulate(loop, r)
    assert np.ptp(quiet.y) < 1e-15
    noisy = cid.simulate(loop, r, sensor_noise=1e-6, seed=1)
    again = cid.simulate(loop, r, sensor_noise=1e-6, seed=1)
    np.testing.assert_array_equal(noisy.y, again.y)
    assert np.any(cid.simulate(loop, r, sensor_noise=1e-6, seed=2).y != noisy.y)
    # White noise enters y directly: its first difference at the first sample is the noise itself.
    first = [cid.simulate(loop, r[:2], sensor_noise=1e-6, seed=s).y[0] for s in range(200)]
    assert np.std(first) == pytest.approx(1e-6, rel=0.2)
    pushed = cid.simulate(loop, r, force_noise=0.05, seed=1)
    kick = pushed.y[1] - op.output
    expected = np.random.default_rng(1).spawn(2)[1].standard_normal() * 0.05 * loop.dt**2 / 2
    assert kick == pytest.approx(expected, rel=1e-2)


def test_injected_signal_adds_to_the_controller_ahead_of_the_limits():
    loop, op = make(0.02, 0.01, 3.0)
    r = np.full(300, op.output)
    d = np.zeros(300)
    d[100:110] = 0.05
    free = cid.simulate(loop, r, d=d)
    assert free.u[100] == pytest.approx(op.input + 0.05)
    tight = copy.replace(loop, input_limits=(2.9, 3.04)) if hasattr(copy, "replace") else None
    tight = tight or cid.Loop(loop.plant, loop.controller, dt=loop.dt, at=op,
                              input_limits=(2.9, 3.04))  # fmt: skip
    assert cid.simulate(tight, r, d=d).u.max() == 3.04


def test_initial_states_of_plant_and_controller():
    loop, op = make(0.02, 0.01, 3.0)
    r = np.full(2000, op.output)
    moved = cid.simulate(loop, r, initial=(1.01 * op.output, 0.0))
    assert moved.y[0] == 1.01 * op.output
    assert moved.y[-1] == pytest.approx(op.output, rel=1e-9)
    charged = cid.simulate(loop, r, initial=(op.output, 0.0, 1e-5))
    assert charged.u[0] != op.input
    with pytest.raises(CtrlidError, match=r"initial needs 2 plant states \(x, v\)"):
        cid.simulate(loop, r, initial=(op.output,))


def test_open_loop_runs_from_d():
    loop = tank()
    record = cid.simulate(loop, d=np.full(4000, 0.1))
    assert record.r is None
    assert record.u[0] == pytest.approx(loop.at.input + 0.1)
    level = (loop.at.input + 0.1) ** 2 / (2 * 9.81)
    assert record.y[-1] == pytest.approx(level, rel=1e-6)


def test_a_ball_that_leaves_the_gap_is_an_error_that_says_when_and_why():
    loop, op = make(0.02, 0.01, 3.0)
    r = cid.random_binary(400, amplitude=0.4 * op.output, hold=30, around=op.output, seed=1)
    with pytest.raises(CtrlidError) as failure:
        cid.simulate(loop, r)
    text = str(failure.value)
    assert "the simulation stops at t = " in text
    assert "x left the range where the plant is defined" in text
    assert "the signals are too large" in text
    assert "V was up to" in text
    assert text.endswith("Use a smaller reference")


def test_a_reference_of_deviations_is_recognized():
    loop, op = make(0.02, 0.01, 3.0)
    with pytest.raises(CtrlidError, match=r"Signals are absolute: .* add 0\.01 to it"):
        cid.simulate(loop, cid.random_binary(400, amplitude=0.01 * op.output, hold=30, seed=1))


def test_an_unstable_loop_says_so():
    loop, op = make(0.02, 0.01, 3.0)
    weak = cid.Loop(loop.plant, 0.1 * loop.controller, dt=loop.dt, at=op)
    with pytest.raises(CtrlidError, match=r"closed loop is unstable: small deviations grow at"):
        cid.simulate(weak, np.full(4000, op.output * 1.001))
    assert compute_growth_rate(weak) > 0 > compute_growth_rate(loop)


def test_the_growth_of_a_loop_with_an_analog_controller_is_that_of_its_poles():
    for filter_time in (1e-2, 1e-7):  # the second is far faster than any step of an integration
        num = [6.0 * filter_time + 0.4, 6.0]
        C = ct.tf(num, [filter_time, 1.0])
        closed = np.polyadd(np.polymul([2.0, 5.0, 0.0], [filter_time, 1.0]), 30.0 * np.array(num))
        loop = drive((), controller=C)
        assert loop.analog
        assert compute_growth_rate(loop) == pytest.approx(np.roots(closed).real.max(), rel=1e-6)


def test_a_saturated_loop_says_so():
    loop, op = make(0.02, 0.01, 3.0)
    tight = cid.Loop(loop.plant, loop.controller, dt=loop.dt, at=op, input_limits=(2.95, 3.05))
    with pytest.raises(CtrlidError, match=r"V was at its limit \(2.95 to 3.05\)"):
        cid.simulate(tight, np.full(2000, op.output * 1.1))


def test_an_unstable_plant_is_not_simulated_without_its_controller():
    loop, op = make(0.02, 0.01, 3.0)
    alone = cid.Loop(loop.plant, None, dt=loop.dt, at=op)
    with pytest.raises(CtrlidError, match="cannot be simulated without its controller"):
        cid.simulate(alone, d=np.full(5000, 0.01))


def test_a_plant_too_sharp_to_integrate_warns():
    loop = cid.Loop(rough_mass(50), None, dt=0.05)
    with pytest.warns(cid.CtrlidWarning, match="simulate with a smaller dt"):
        cid.simulate(loop, d=60 * np.sin(np.arange(100)))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda loop: cid.simulate(loop), "needs the reference r"),
        (lambda loop: cid.simulate(loop, np.ones((3, 2))), r"one-dimensional .* shape \(3, 2\)"),
        (lambda loop: cid.simulate(loop, [0.01, np.nan]), "with 1 not finite"),
        (lambda loop: cid.simulate(loop, np.zeros((100, 1))), r"\(100, 1\). Give r.ravel\(\)$"),
        (lambda loop: cid.simulate(loop, [0.01]), r"given shape \(1,\)$"),
        (lambda loop: cid.simulate(loop, {"x": np.ones(5)}), "given a mapping of x. Give its ser"),
        (lambda loop: cid.simulate(loop, np.ones(5), d=np.ones(4)), "equally long; given"),
        (lambda loop: cid.simulate(loop, np.ones(5), sensor_noise=-1), "standard deviation >= 0"),
        (
            lambda loop: cid.simulate(loop, np.ones(5), sensor_noise=[[1], [1, 2]]),
            "standard deviation >= 0: it must be an array of numbers",
        ),
        (
            lambda loop: cid.simulate(loop, np.ones(5), force_noise=np.ma.array([1.0], mask=[1])),
            "masked values would come back",
        ),
        (lambda loop: cid.simulate(loop, np.ones(5), force_noise="x"), "force_noise is a standard"),
        (lambda loop: cid.simulate(loop, "abc"), "needs r as an array of numbers"),
        (
            lambda loop: cid.simulate(loop.plant, np.ones(5)),
            "needs a Loop.*given NonlinearIOSystem",
        ),
        (
            lambda loop: cid.simulate(cid.Loop(loop.plant, 1.0, dt=1.0, at=REST), np.ones(5)),
            "not defined at the operating point",
        ),
        (
            lambda loop: compute_growth_rate(cid.Loop(loop.plant, 1.0, dt=1.0, at=REST)),
            "no derivative at its",
        ),
        (lambda loop: cid.simulate(cid.Loop(loop.plant, None, dt=1.0, at=loop.at)), "needs r or d"),
    ],
)
def test_simulate_refuses_bad_signals(call, words):
    with pytest.raises(CtrlidError, match=words):
        call(make(0.02, 0.01, 3.0)[0])


def test_force_noise_acts_on_rates():
    discrete = cid.Loop(ct.tf([1.0], [1.0, -0.5], 0.1), None, dt=0.1)
    with pytest.raises(CtrlidError, match=r"acts on rates, and .* is in discrete time"):
        cid.simulate(discrete, d=np.zeros(10), force_noise=1.0)


def test_a_loop_that_runs_again_is_not_made_again():
    loop, other = make(0.02, 0.01, 3.0)[0], make(0.02, 0.01, 3.0)[0]
    made = make_simulator(loop)
    assert make_simulator(loop) is made
    assert make_simulator(other) is not made
    # What a run leaves behind does not change the next one.
    r = cid.random_binary(300, amplitude=1e-4, hold=20, around=loop.at.output, seed=1)
    first, second = (cid.simulate(loop, r, seed=3, sensor_noise=1e-6) for _ in range(2))
    anew = cid.simulate(other, r, seed=3, sensor_noise=1e-6)
    for record in (second, anew):
        np.testing.assert_array_equal(record.y, first.y)
        np.testing.assert_array_equal(record.u, first.u)


def test_without_a_moving_mass_each_state_has_a_noise_of_its_own():
    """Two integrators in parallel: after k periods the variance is k (T s)^2 of each."""
    dt, size, n = 0.5, (0.2, 0.0), 4
    plant = ct.nlsys(lambda t, x, u, p: [0 * x[0], u[0]], lambda t, x, u, p: x[0], inputs=1,
                     outputs=1, states=["level", "other"], name="pair")  # fmt: skip
    loop = cid.Loop(plant, None, dt=dt).with_effect(cid.effects.ActuatorLag(tau=0.3))
    runs = [cid.simulate(loop, d=np.zeros(n), force_noise=size, seed=k).y for k in range(400)]
    expected = np.arange(n) * (dt * size[0]) ** 2
    np.testing.assert_allclose(np.var(runs, axis=0), expected, rtol=0.25)
    still = cid.simulate(loop, d=np.zeros(n), force_noise=(0.0, 0.3), seed=1).y
    np.testing.assert_allclose(still, 0.0, atol=1e-12)


MAGLEV = cid.plants.maglev(m=0.02, K=3e-6)
POINT = cid.operating_point(MAGLEV, output=0.01)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"dt": -1.0}, "sampling period dt > 0 s, as in .*; given dt=-1.0"),
        ({}, "sampling period dt > 0"),
        (
            {"at": None, "dt": 0.001},
            "maglev is not defined where all its signals are zero; give at=",
        ),
        ({"dt": 0.01, "free": ("Kc",)}, r"free= names \['Kc'\].*\['m', 'K', 'g'\]"),
        ({"dt": 0.01, "at": (0.01, 0.0)}, "at= needs an OperatingPoint"),
        (
            {"dt": 0.01, "at": cid.OperatingPoint((0.01,), 3, 0.01)},
            "at= has 1 state, but maglev has 2",
        ),
        ({"dt": 0.01, "input_limits": (3, 1)}, "needs lower < upper"),
        ({"dt": 0.01, "input_limits": 3}, "is a pair"),
        ({"dt": 0.01, "controller": "PID"}, "a controller is a TransferFunction"),
        ({"dt": 0.01, "controller": ct.tf([1], [1, 1], 0.02)}, "runs at 0.02 s, the loop at 0.01"),
        (
            {"dt": 0.01, "controller": ct.tf([1, 0], [1])},
            "no circuit and no program differentiates",
        ),
        ({"dt": 0.01, "controller": ct.ss(-np.eye(3), np.eye(3), np.ones((1, 3)), 0)}, "3 inputs"),
    ],
)
def test_loop_refuses_what_does_not_fit(arguments, words):
    with pytest.raises(CtrlidError, match=words):
        cid.Loop(MAGLEV, **{"at": POINT, **arguments})


def test_loop_refuses_mixed_time_and_algebraic_loops():
    with pytest.raises(CtrlidError, match="analog controller cannot act on a plant in discrete"):
        cid.Loop(ct.tf([1], [1, -0.5], 0.1), ct.tf([1], [1, 1]), dt=0.1)
    with pytest.raises(CtrlidError, match=r"the plant is sampled at 0.1 s, the loop at 0.2 s"):
        cid.Loop(ct.tf([1], [1, -0.5], 0.1), dt=0.2)
    with pytest.raises(CtrlidError, match="passes its input to its output without delay"):
        cid.Loop(ct.tf([1, 0], [1, 1]), 0.5, dt=0.1)
    with pytest.raises(CtrlidError, match=r"the order is Loop\(plant, controller, \.\.\.\)"):
        cid.Loop(ct.tf([1, 0], [1, 1]), MAGLEV, dt=0.1)


def test_loop_is_a_value_and_gives_its_plant_back():
    loop, _ = make(0.02, 0.01, 3.0)
    assert loop.system() is loop.plant
    with pytest.raises(AttributeError):
        loop.dt = 1.0
    linear = cid.Loop(ct.tf([2.0], [1.0, 3.0]), None, dt=0.1, at=cid.OperatingPoint((), 1.0, 5.0))
    system = linear.system()
    assert isinstance(system, ct.NonlinearIOSystem)
    assert system.output(0, [0.0], [1.0])[0] == 5.0
    assert system.dynamics(0, [0.0], [1.0])[0] == 0.0
    assert "digital controller" in repr(loop)
    assert "no controller" in repr(linear)
    assert "V within 0..6" in repr(cid.Loop(MAGLEV, None, dt=1.0, at=POINT, input_limits=(0, 6)))


def test_agrees_with_python_control_on_an_analog_loop():
    loop, op = make(0.02, 0.01, 3.0, share=0.05, analog=True)
    time = np.arange(60) * loop.dt
    C = ct.ss(loop.controller, inputs="e", outputs="v", name="C")
    bias = ct.nlsys(None, lambda t, x, u, p: u[0] + op.input, inputs="v", outputs="V", name="bias")
    error = ct.summing_junction(["r", "-x"], "e", name="error")
    whole = ct.interconnect(
        [loop.plant, C, bias, error], inputs="r", outputs=["x", "V"], name="all"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        response = ct.input_output_response(
            whole,
            time,
            np.full(60, 1.005 * op.output),
            [*op.states, 0.0],
            solve_ivp_kwargs={"method": "DOP853", "rtol": 1e-10, "atol": 1e-13},
        )
    record = cid.simulate(loop, np.full(60, 1.005 * op.output))
    np.testing.assert_allclose(record.y, response.outputs[0], rtol=1e-8)
    np.testing.assert_allclose(record.u, response.outputs[1], rtol=1e-7)


def test_records_of_textbook_plants_have_units_and_an_open_fall_is_noticed():
    loop, op = make(0.02, 0.01, 3.0)
    assert dict(cid.simulate(loop, np.full(10, op.output)).units) == {"r": "m", "u": "V", "y": "m"}
    alone = cid.Loop(loop.plant, None, dt=loop.dt, at=op)
    with pytest.raises(CtrlidError, match=r"x has diverged to .* The loop is open"):
        cid.simulate(alone, d=np.full(5000, -0.01))
    assert (
        cid.simulate(servo(None, dt=0.1), d=np.ones(4500)).y[-1] > 600
    )  # an integrator may travel far


def test_an_undamped_plant_swings_for_ever():
    """It moves far from a point at zero, and round-off makes its poles a hair unstable."""
    plant = ct.nlsys(
        lambda t, x, u, p: [x[1], -100 * np.sin(x[0]) + u[0]], lambda t, x, u, p: x[0],
        inputs=["torque"], outputs=["angle"], states=["angle", "rate"], name="pendulum",
    )  # fmt: skip
    d = cid.random_binary(2000, amplitude=0.05, seed=1)
    record = cid.simulate(cid.Loop(plant, None, dt=0.02), d=d, sensor_noise=1e-6, seed=2)
    assert np.abs(record.y).max() > 1e-3


# --- the regulator experiment: a loop that rests at zero, with r = 0


def regulated(push):
    """Return the record of a motor under a PD law, which was moved by something else than r."""
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    return cid.simulate(cid.Loop(plant, cid.PID(kp=30.0, kd=2.0), dt=0.01), np.zeros(3000), **push)


@pytest.mark.parametrize(
    ("push", "size"),
    [
        # The injected volts are those that the law takes back: kp x = d.
        ({"d": np.r_[np.zeros(2000), np.ones(1000)]}, 1 / 30),
        ({"initial": (0.05, 0.0)}, 0.05),
        ({"force_noise": 1.0, "seed": 1}, None),
    ],
)
def test_a_loop_at_rest_at_zero_may_be_moved_by_more_than_its_reference(push, size):
    record = regulated(push)
    assert np.isfinite(record.y).all()
    if size:
        assert np.abs(record.y).max() == pytest.approx(size, rel=0.3)


def test_a_constant_force_moves_a_loop_at_rest_at_zero():
    """It settles where the motor holds the acceleration: k kp x / m = bias."""
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    loop = cid.Loop(plant, cid.PID(kp=30.0, kd=2.0), dt=0.01)
    loop = loop.with_effect(cid.effects.ConstantForce(bias=0.5))
    record = cid.simulate(loop, np.zeros(2000))
    assert abs(record.y[-1]) == pytest.approx(0.5 / 90.0, rel=1e-6)


@pytest.mark.parametrize("push", [{"d": np.full(4000, 1e-3)}, {"initial": (1e-3, 0.0)},
                                  {"force_noise": 0.1, "seed": 2}])  # fmt: skip
def test_an_unstable_loop_moved_from_rest_at_zero_still_runs_away(push):
    plant = cid.plants.pendulum(m=0.2, length=0.5, c=0.01)
    loop = cid.Loop(plant, cid.PID(kp=-20.0, kd=0.6), dt=0.01)
    linear = cid.Loop(cid.linearize(plant, loop.at), loop.controller, dt=0.01)
    with pytest.raises(CtrlidError, match="closed loop is unstable"):
        cid.simulate(linear, np.zeros(4000), **push)


def test_what_was_too_large_is_named():
    """The inverted pendulum falls beyond the torque that the motor has."""
    plant = cid.plants.pendulum(m=0.2, length=0.5, c=0.01)
    linear = cid.linearize(plant, cid.OperatingPoint((0.0, 0.0), 0.0, 0.0))
    loop = cid.Loop(linear, cid.PID(kp=4.0, kd=0.6), dt=0.01, input_limits=(-0.1, 0.1))
    with pytest.raises(CtrlidError) as failure:
        cid.simulate(loop, np.zeros(3000), d=np.r_[np.full(200, 0.4), np.zeros(2800)])
    text = str(failure.value)
    assert "the injected signal d is up to 0.4" in text
    assert "reference is up to" not in text
    assert text.endswith("Use a smaller d")
