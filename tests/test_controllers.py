"""Controllers: PID sequences computed by hand, and the laws of real loops replayed on their logs.

Groups: PID by hand; other forms of the same controller; refusals; real logs.
"""

import math
from dataclasses import replace

import casadi
import control as ct
import numpy as np
import pytest
from scipy import signal

import ctrlid as cid
from ctrlid import PID, CtrlidError
from ctrlid.loop.controllers import make_control_law

AT = cid.OperatingPoint((0.0,), 2.0, 1.0)
DT = 0.5


def run(controller, r, y, at=AT, dt=DT):
    """Step a controller through sequences of reference and output, from rest."""
    law = make_control_law(controller, at, dt)
    x, w = casadi.SX.sym("x", len(law.rest)), casadi.SX.sym("w", 3)
    u, after = law.apply(w[0], x, w[1], w[2])
    step = casadi.Function("step", [x, w], [casadi.vertcat(after), u])
    state, inputs = casadi.DM(law.rest), []
    for k, pair in enumerate(zip(np.broadcast_to(r, len(y)), y, strict=True)):
        state, value = step(state, [k * dt, *pair])
        inputs.append(float(value))
    return np.array(inputs)


# --- PID by hand: r = 1, e = 1 - y, dt = 0.5, bias 2 from the operating point

Y = [1.0, 0.0, 0.0, 2.0, 1.0]  # e = 0, 1, 1, -1, 0


@pytest.mark.parametrize(
    ("integral", "expected"),
    [
        ("backward", [2, 3, 4, 3, 3]),  # 2 + 2 * 0.5 * (0, 1, 2, 1, 1)
        ("forward", [2, 2, 3, 4, 3]),  # one sample later
        ("trapezoidal", [2, 2.5, 3.5, 3.5, 3]),  # half of each
    ],
)
def test_integral_rules(integral, expected):
    np.testing.assert_allclose(run(PID(kp=0, ki=2, integral=integral), 1.0, Y), expected)


def test_proportional_part_and_its_weight():
    np.testing.assert_allclose(run(PID(kp=3), 1.0, Y), [2, 5, 5, -1, 2])
    np.testing.assert_allclose(run(PID(kp=3, b=0.5, bias=10), 1.0, Y), 10 + 3 * (0.5 - np.array(Y)))
    np.testing.assert_allclose(run(PID(kp=3, bias=0), 1.0, Y), 3 * (1 - np.array(Y)))


def test_derivative_part_its_weight_and_its_filter():
    r = np.array([1.0, 2.0, 2.0, 2.0, 2.0])
    # Slopes of e: (1 - 0.. ) e = 0, 2, 2, 0, 1; differences over 0.5 s.
    np.testing.assert_allclose(run(PID(kp=0, kd=1), r, Y), [2, 6, 2, -2, 4])
    # Of -y alone: y = 1, 0, 0, 2, 1.
    measured = [2, 4, 2, -2, 4]
    np.testing.assert_allclose(run(PID(kp=0, kd=1, derivative="measurement"), r, Y), measured)
    np.testing.assert_allclose(run(PID(kp=0, kd=1, c=0), r, Y), measured)
    np.testing.assert_allclose(run(PID(kp=0, kd=1, c=0.5), r, Y), [2, 5, 2, -2, 4])
    # D = (Tf D + kd diff) / (Tf + T), Tf = T = 0.5: each D is half the last plus the difference.
    np.testing.assert_allclose(
        run(PID(kp=0, kd=1, filter_time=0.5), r, Y), [2, 4, 3, 0.5, 2.25]
    )  # fmt: skip


def test_no_derivative_kick_from_rest():
    for c in (0.0, 0.3, 1.0):
        np.testing.assert_array_equal(run(PID(kp=1, ki=1, kd=5, c=c), 1.0, [1.0, 1.0]), [2, 2])


E = [1.0, 1.0, 1.0, -1.0, -1.0]  # r = 1 + e, y = 1


@pytest.mark.parametrize(
    ("anti_windup", "expected"),
    [
        # I grows 1, 2, 3 and comes back 2, 1 with ki * dt = 1.
        ("none", [3, 3.5, 3.5, 3.5, 3]),
        # The step that would pass 3.5 is not taken: I = 1, 1, 1, 0, -1.
        ("clamp", [3, 3.5, 3.5, 2, 1]),
        # I <- I + e + 0.5 (u - wish): 1; 2 - 0.25 = 1.75; 2.75 - 0.625 = 2.125; 1.125; 0.125.
        ("back-calculation", [3, 3.5, 3.5, 3.125, 2.125]),
    ],
)
def test_anti_windup(anti_windup, expected):
    pid = PID(kp=0, ki=2, upper=3.5, lower=-5, anti_windup=anti_windup, tracking_time=1.0)
    np.testing.assert_allclose(run(pid, 1 + np.array(E), np.ones(5)), expected)


def test_clamping_below_and_with_the_forward_rule():
    pid = PID(kp=0, ki=2, lower=0.5, upper=9)
    np.testing.assert_allclose(run(pid, 1 - np.array(E), np.ones(5)), [1, 0.5, 0.5, 2, 3])
    pid = PID(kp=0, ki=2, upper=3.5, integral="forward")
    # The step decided at a sample that is not beyond the limit is taken: I = 0, 1, 2, 2, 1.
    np.testing.assert_allclose(run(pid, 1 + np.array(E), np.ones(5)), [2, 3, 3.5, 3.5, 3])


def test_back_calculation_tracks_with_kp_over_ki_by_default():
    r = 1 + np.array(E)
    explicit = PID(kp=1, ki=2, upper=3.2, anti_windup="back-calculation", tracking_time=0.5)
    default = PID(kp=1, ki=2, upper=3.2, anti_windup="back-calculation")
    np.testing.assert_array_equal(run(default, r, np.ones(5)), run(explicit, r, np.ones(5)))
    plain = PID(kp=1, upper=3.2, anti_windup="back-calculation")
    np.testing.assert_allclose(run(plain, r, np.ones(5)), [3, 3, 3, 1, 1])


def reference_pid(pid, r, y, dt, bias):
    """The same controller written as a loop over plain numbers."""
    total, slope, out = 0.0, 0.0, []
    c = 0.0 if pid.derivative == "measurement" else pid.c
    last_e, last_d = 0.0, (c - 1) * AT.output
    for rk, yk in zip(r, y, strict=True):
        e, d = rk - yk, c * rk - yk
        gain = {"backward": dt * e, "forward": 0.0, "trapezoidal": dt * (e + last_e) / 2}
        slope = (pid.filter_time * slope + pid.kd * (d - last_d)) / (pid.filter_time + dt)
        wish = bias + pid.kp * (pid.b * rk - yk) + slope + total + pid.ki * gain[pid.integral]
        u = min(max(wish, pid.lower), pid.upper)
        step = pid.ki * (dt * e if pid.integral == "forward" else gain[pid.integral])
        if pid.anti_windup == "clamp":
            if (wish > pid.upper and step > 0) or (wish < pid.lower and step < 0):
                step = 0.0
        elif pid.anti_windup == "back-calculation":
            step += dt / (pid.tracking_time or pid.kp / pid.ki) * (u - wish)
        total, last_e, last_d = total + step, e, d
        out.append(u)
    return np.array(out)


@pytest.mark.parametrize("integral", ["backward", "forward", "trapezoidal"])
@pytest.mark.parametrize("anti_windup", ["clamp", "back-calculation", "none"])
@pytest.mark.parametrize("derivative", ["error", "measurement"])
def test_every_combination_equals_a_plain_loop(integral, anti_windup, derivative):
    rng = np.random.default_rng(3)
    r, y = 1 + rng.standard_normal((2, 300))
    pid = PID(kp=-1.2, ki=-0.7, kd=-0.2, bias=0.3, lower=-1.5, upper=2.0, b=0.7,
              derivative=derivative, filter_time=0.1, integral=integral,
              anti_windup=anti_windup)  # fmt: skip
    expected = reference_pid(pid, r, y, DT, 0.3)
    assert np.mean((expected <= -1.5) | (expected >= 2.0)) > 0.1  # the limits are met
    np.testing.assert_allclose(run(pid, r, y), expected, atol=1e-11)


# --- other forms of one controller

RNG = np.random.default_rng(1)
R, YR = RNG.standard_normal((2, 60))
C = ct.tf([2.0, -1.4], [1.0, -0.3], DT)


def lead_by_hand(r, y):
    """u[k] = 0.3 u[k-1] + 2 e[k] - 1.4 e[k-1] around the bias."""
    u, last_u, last_e, out = 0.0, 0.0, 0.0, []
    for e in r - y:
        u = 0.3 * last_u + 2 * e - 1.4 * last_e
        last_u, last_e = u, e
        out.append(2.0 + u)
    return np.array(out)


def nonlinear_lead():
    """The same lead as a python-control function of (r, y) that computes all of u."""
    return ct.nlsys(
        lambda t, x, u, p: [0.3 * x[0] - 0.8 * (u[0] - u[1])],
        lambda t, x, u, p: 2.0 + x[0] + 2 * (u[0] - u[1]),
        inputs=["r", "y"], outputs=["u"], states=["x"], dt=DT, name="lead",
    )  # fmt: skip


@pytest.mark.parametrize(
    "controller",
    [
        C,
        ct.ss(C),
        ct.tf([[[2.0, -1.4], [-2.0, 1.4]]], [[[1.0, -0.3], [1.0, -0.3]]], DT),
        ct.ss([[0.3]], [[1.0, -1.0]], [[-0.8]], [[2.0, -2.0]], DT),
        ct.ss([[0.3]], [[1.0, -1.0]], [[-0.8]], [[2.0, -2.0]], DT, inputs=["r", "y"]),
        ct.ss([[0.3]], [[-1.0, 1.0]], [[-0.8]], [[-2.0, 2.0]], DT, inputs=["y", "r"]),
        ct.tf(
            [[[-2.0, 1.4], [2.0, -1.4]]], [[[1.0, -0.3], [1.0, -0.3]]], DT, inputs=["y", "r"]
        ),
        nonlinear_lead(),
    ],
)  # fmt: skip
def test_one_controller_in_all_its_forms(controller):
    np.testing.assert_allclose(run(controller, R, YR), lead_by_hand(R, YR), atol=1e-12)


def test_two_inputs_act_on_deviations_from_the_operating_point():
    feedback = ct.ss([], [], [], [[3.0, -5.0]], DT)
    np.testing.assert_allclose(run(feedback, R, YR), 2 + 3 * (R - 1) - 5 * (YR - 1))
    zero = ct.tf([[[0.0], [-5.0]]], [[[1.0], [1.0]]], DT)
    np.testing.assert_allclose(run(zero, R, YR), 2 - 5 * (YR - 1))


def test_functions_of_the_error_and_in_other_order():
    cubic = ct.nlsys(None, lambda t, x, u, p: p["k"] * u[0] ** 3, inputs=["e"], outputs=["u"],
                     params={"k": 4.0}, dt=DT, name="cubic")  # fmt: skip
    np.testing.assert_allclose(run(cubic, R, YR), 2 + 4 * (R - YR) ** 3)
    swapped = ct.nlsys(None, lambda t, x, u, p: 7 * u[1] - 9 * u[0], inputs=["y", "r"],
                       outputs=["u"], dt=DT, name="swapped")  # fmt: skip
    np.testing.assert_allclose(run(swapped, R, YR), 7 * R - 9 * YR)


def test_numbers_and_unspecified_periods():
    np.testing.assert_allclose(run(4, R, YR), 2 + 4 * (R - YR))
    open_period = ct.tf([2.0, -1.4], [1.0, -0.3], True)
    np.testing.assert_allclose(run(open_period, R, YR), lead_by_hand(R, YR))
    assert make_control_law(open_period, AT, DT).dt == DT
    assert make_control_law(ct.tf([1], [1, 1]), AT, DT).dt == 0.0


def test_leading_zeros_do_not_make_a_controller_improper():
    padded = ct.tf([0.0, 0.0, 2.0, -1.4], [1.0, -0.3], DT)
    np.testing.assert_allclose(run(padded, R, YR), lead_by_hand(R, YR))


# --- refusals


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"kp": math.nan}, "PID needs a finite number as kp; given nan"),
        ({"kp": None}, "PID needs a finite number as kp; given None"),
        ({"ki": "2"}, "a finite number as ki; given '2'"),
        ({"bias": math.inf}, "a finite number as bias; given inf"),
        ({"lower": 1, "upper": 1}, "PID needs lower < upper; given lower=1, upper=1"),
        ({"upper": math.nan}, "lower < upper"),
        ({"upper": None}, "lower < upper; given lower=-inf, upper=None"),
        ({"filter_time": -1}, "filter_time is a time constant >= 0 s; given -1"),
        ({"integral": "euler"}, "PID integral must be one of backward, forward, trapezoidal; giv"),
        ({"derivative": "y"}, "PID derivative must be one of error, measurement; given 'y'"),
        ({"anti_windup": True}, "PID anti_windup must be one of clamp, .*; given True"),
        ({"derivative": "measurement", "c": 0.5}, "sets c=0; leave c=0.5 out"),
        ({"anti_windup": "back-calculation", "ki": -2.0}, "back-calculation needs tracking_time"),
        ({"anti_windup": "back-calculation", "ki": 2.0, "tracking_time": 0.0},
         "needs tracking_time > 0 s; given tracking_time=0.0 with kp=1.0, ki=2.0"),
    ],
)  # fmt: skip
def test_pid_refuses(fields, words):
    with pytest.raises(CtrlidError, match=words):
        PID(**{"kp": 1.0, **fields})


@pytest.mark.parametrize(
    ("controller", "words"),
    [
        ("PID", "a controller is a TransferFunction, .* or None; given str"),
        (ct.ss([], [], [], np.ones((1, 3)), DT), "given 3 inputs and 1 output"),
        (ct.ss([], [], [], np.ones((2, 1)), DT), "given 1 input and 2 outputs"),
        (ct.tf([1], [1, 0.5], 0.2), "runs at 0.2 s, the loop at 0.5 s; convert it"),
        (ct.tf([1, 0, 0], [1, 1]), "has 2 zeros but 1 pole: no circuit and no program"),
    ],
)
def test_control_law_refuses(controller, words):
    with pytest.raises(CtrlidError, match=words):
        make_control_law(controller, AT, DT)


REPLAY = cid.Loop(ct.tf([1], [1, 1]), cid.PID(kp=2.0, ki=1.0), dt=DT)
LOG = cid.Record(r=np.ones(20), u=np.ones(20), y=np.zeros(20), dt=DT)


@pytest.mark.parametrize(
    ("loop", "record", "words"),
    [
        (REPLAY, LOG.decimate(2, antialias=False), "sampled at 0.5 s, the record at 1 s"),
        (REPLAY, cid.Record(u=LOG.u, y=LOG.y, dt=DT), "no reference r, which the controller needs"),
        (cid.Loop(ct.tf([1], [1, 1]), dt=DT), LOG, "this loop has no controller"),
        (
            cid.Loop(ct.tf([1], [1, 1]), ct.tf([1], [1, 2]), dt=DT),
            LOG,
            "this loop has an analog one",
        ),
    ],
    ids=["period", "reference", "none", "analog"],
)
def test_replay_refuses(loop, record, words):
    with pytest.raises(CtrlidError, match=words):
        cid.replay_controller(loop, record)


def test_replay_finds_the_initial_state_and_leaves_what_was_injected():
    loop = cid.Loop(ct.tf([1], [1, 1]), cid.PID(kp=2.0, ki=1.0), dt=0.1)
    d = np.zeros(400)
    d[200:] = 0.3 * np.random.default_rng(0).standard_normal(200)
    r = cid.random_binary(400, amplitude=1.0, hold=20, seed=1)
    part = cid.simulate(loop, r, d=d)[50:]
    # The integral at the cut is not in the record; the injected noise hardly moves its estimate.
    assert np.std(part.u[:150] - cid.replay_controller(loop, part)[:150]) < 0.05
    clean = cid.simulate(loop, r)[50:]
    np.testing.assert_allclose(cid.replay_controller(loop, clean), clean.u, atol=1e-10)


# --- real logs


def test_replay_finds_a_state_from_which_everything_was_cut_off():
    # A lead sampled slowly rings: from rest, all that it computes from these samples is at a limit.
    plant = cid.plants.maglev(m=0.02, K=2e-6)
    at = cid.operating_point(plant, output=0.01)
    lead = ct.tf([-6585.0, 5440.0], [1.0, 0.9995], 0.0044)
    loop = cid.Loop(plant, lead, dt=0.0044, at=at, input_limits=(0.0, 7.8))
    r = cid.random_binary(1500, amplitude=2.8e-4, hold=20, around=0.01, seed=7)
    part = cid.simulate(loop, r)[500:]
    np.testing.assert_allclose(cid.replay_controller(loop, part), part.u, atol=1e-8)


def explained(replayed, logged):
    return 1 - np.var(replayed - logged) / np.var(logged)


def loop_for(record, controller, **options):
    at = cid.OperatingPoint((float(record.y.mean()), 0.0), 0.0, float(record.y.mean()))
    plant = cid.plants.servo(m=1.0, c=1.0, k=1.0)
    return cid.Loop(plant, controller, dt=record.dt, at=at, **options)


def test_inteco_pid_is_replayed_to_round_off(data_dir):
    record = cid.datasets.load("inteco_pid_step")
    pid = PID(-37.812, -188, -1.92, bias=0.583, lower=0, upper=1, integral="backward",
              anti_windup="none")  # fmt: skip
    replayed = cid.replay_controller(loop_for(record, pid), record)
    assert np.abs(replayed - record.u).max() < 1e-12
    wrong = PID(-37.812, -188, -1.92, bias=0.583, lower=0, upper=1)  # with anti-windup
    assert np.abs(cid.replay_controller(loop_for(record, wrong), record) - record.u).max() > 1e-3


def test_emps_cascade_is_replayed(data_dir):
    record = cid.datasets.load("emps")
    pid = PID(kp=254.49 * 159.86, kd=254.49, bias=0, derivative="measurement")
    assert explained(cid.replay_controller(loop_for(record, pid), record), record.u) >= 0.9999
    error = PID(kp=254.49 * 159.86, kd=254.49, bias=0)
    assert explained(cid.replay_controller(loop_for(record, error), record), record.u) < 0.99


def low_pass_between(y, filtered, order=3):
    """Least squares on prefiltered signals, iterated: the error of a simulation, not of a step."""
    a = np.eye(order + 1)[0]
    y, filtered = y - y[0], filtered - y[0]
    n = len(y)
    for _ in range(30):
        s, f = (signal.lfilter([1.0], a, v) for v in (y, filtered))
        past = [f[order - i : n - i] for i in range(1, order + 1)]
        past += [s[order - i : n - i] for i in range(order + 1)]
        rows = slice(2000, None)
        found = np.linalg.lstsq(np.column_stack(past)[rows], f[order:][rows], rcond=None)[0]
        a = np.r_[1.0, -found[:order]]
    return ct.ss(ct.tf(found[order:], a, 1e-3))


@pytest.mark.parametrize("name", ["servo_random_steps", "servo_swept_sine"])
def test_servo_law_with_its_filter_is_replayed(data_dir, name):
    record = cid.datasets.load(name)
    yf = record.extra["filtered"]
    np.testing.assert_allclose(np.clip(3 * (record.r - yf), -10, 10), record.u, atol=1e-12)
    low_pass = low_pass_between(record.y, yf)
    law = ct.ss(low_pass.A, np.hstack([0 * low_pass.B, low_pass.B]), -3 * low_pass.C,
                np.hstack([[[3.0]], -3 * low_pass.D]), record.dt, inputs=["r", "y"])  # fmt: skip
    at = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
    plant = cid.plants.servo(m=1.0, c=1.0, k=1.0)
    loop = cid.Loop(plant, law, dt=record.dt, at=at, input_limits=(-10, 10))
    replayed = cid.replay_controller(loop, record)
    assert explained(replayed, record.u) >= 0.9999
    assert np.abs(replayed).max() == 10


def test_magnetoshield_pid_leaves_white_dither(data_dir):
    """u less the PID is the injected noise: white, uniform within 2 Vpp, at every set-point."""
    set_points = (14.0e-3, 13.5e-3, 14.5e-3, 15.0e-3, 14.5e-3)
    for record, r in zip(cid.datasets.load("magnetoshield_r3"), set_points, strict=True):
        # e = y - r in millimetres: 4 V/mm, Ti = 0.2 s, Td = 0.03 s.
        pid = PID(kp=-4e3, ki=-4e3 / 0.2, kd=-4e3 * 0.03, bias=0.0, anti_windup="none")
        with_r = cid.Record(r=np.full(len(record), r), u=record.u, y=record.y, dt=record.dt)
        dither = record.u - cid.replay_controller(loop_for(with_r, pid), with_r)
        free = (record.u > 0.01) & (record.u < 9.99)
        dither = dither[free] - dither[free].mean()
        assert dither.std() == pytest.approx(2 / np.sqrt(12), rel=0.12)
        lagged = np.corrcoef(dither[1:], dither[:-1])[0, 1]
        assert abs(lagged) < 0.1


# --- inputs that have names


SPRING = ct.ss([[0, 1], [-3, -2]], [[0], [1]], [[1, 0]], 0, inputs="V", outputs="x", name="st")


def end_with(names, gains):
    law = ct.ss([], [], [], [gains], inputs=names, outputs="V", name="C")
    return cid.simulate(cid.Loop(SPRING, law, dt=0.01), np.ones(500)).y[-1]


@pytest.mark.parametrize(
    ("names", "gains"),
    [
        (["x", "r"], [-0.5, 0.5]), (["r", "x"], [0.5, -0.5]), (["x", "ref"], [-0.5, 0.5]),
        (["ref", "x"], [0.5, -0.5]), (["y", "r"], [-0.5, 0.5]), (["y[0]", "w"], [-0.5, 0.5]),
        (["u[0]", "u[1]"], [0.5, -0.5]),
    ],
)  # fmt: skip
def test_the_input_with_the_name_of_the_output_is_the_output(names, gains):
    """Read by position, a law of (x, r) had the wrong sign without a word."""
    whole = ct.interconnect(
        [SPRING, ct.ss([], [], [], [[-0.5, 0.5]], inputs=["x", "r"], outputs="V")],
        inputs="r", outputs="x",
    )  # fmt: skip
    expected = ct.step_response(whole, np.arange(500) * 0.01).outputs[-1]
    assert end_with(names, gains) == pytest.approx(expected, rel=1e-6)


def test_names_that_do_not_say_which_input_is_the_output_are_refused():
    with pytest.raises(CtrlidError, match=r"pv and sp, which does not say which .* output x"):
        end_with(["pv", "sp"], [-0.5, 0.5])
    for names in (["e", "r"], ["r", "e"], ["r", "r_dot"], ["ref", "r"], ["y", "e"], ["x", "y"]):
        with pytest.raises(CtrlidError, match="does not say"):
            end_with(names, [-0.5, 0.5])
    with pytest.raises(CtrlidError, match=r"only input is called x, .* acts on r - y"):
        end_with(["x"], [-0.5])
    assert end_with(["e"], [0.5]) == pytest.approx(end_with(["r", "x"], [0.5, -0.5]))


def two_degrees(names, dt=None):
    """A lead of y, and seven tenths of it of r, on the servo below; the order is that of names."""
    A = ct.ss(ct.tf([8.0, 40.0], [1.0, 10.0]))
    r, y = (0.7 * A.B, 0.7 * A.D), (-A.B, -A.D)
    first, second = (r, y) if names[0].startswith("r") else (y, r)
    law = ct.ss(A.A, np.hstack([first[0], second[0]]), A.C, np.hstack([first[1], second[1]]))
    law = law if dt is None else ct.sample_system(law, dt, "bilinear")
    return ct.ss(law.A, law.B, law.C, law.D, law.dt, inputs=names, outputs="V")


ORDERS = [["r", "y"], ["y", "r"], ["y", "ref"], ["x", "r"], ["ref", "x"]]


@pytest.mark.parametrize("names", ORDERS, ids=",".join)
@pytest.mark.parametrize("dt", [None, 0.01])
def test_all_read_the_inputs_of_a_controller_in_the_same_order(names, dt):
    """`audit`, `compare` and `fit_iv` knew only (y, r): other names were blamed or not used."""
    servo = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    law = two_degrees(names, dt)
    loop = cid.Loop(servo, law, dt=0.01)
    r = cid.random_binary(1200, amplitude=0.1, hold=50, around=0.3, seed=1)
    record = cid.simulate(loop, r, sensor_noise=1e-4, seed=2)
    assert not cid.audit(record, loop).harmful
    assert "closed-loop simulation" in [c.label for c in cid.compare(record, loop).curves]
    if dt is None:
        return
    G = cid.fit_iv(record, na=2, nb=2, controller=law)
    assert any("simulation with the given controller" in note for note in (str(G.estimate),))
    louder = ct.ss(law.A, law.B, 1.5 * law.C, 1.5 * law.D, 0.01, inputs=names, outputs="V")
    wrong = cid.Loop(servo, louder, dt=0.01)
    assert [f.kind for f in cid.audit(record, wrong).harmful] == ["gain"]


def test_a_masked_input_is_beyond_no_limit():
    servo = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    loop = cid.Loop(servo, cid.PID(kp=5.0, kd=0.3), dt=0.01, input_limits=(-30.0, 30.0))
    r = cid.random_binary(900, amplitude=0.1, hold=50, seed=1)
    record = cid.simulate(loop, r, sensor_noise=1e-4, seed=2)
    u = np.where(np.arange(900) == 500, 100.0, record.u)
    masked = replace(record, u=u, valid=np.arange(900) != 500)
    assert not cid.audit(masked, loop)["limit"]
    assert cid.audit(replace(record, u=u), loop)["limit"]
