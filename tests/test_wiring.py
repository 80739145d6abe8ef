"""Loops of several signals: wiring by name, simulation against a tight solution, refusals."""

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ctrlid as cid

DT = 2e-3
CART = cid.plants.cart_pole(M=0.5, m=0.2, length=0.3, J=0.004, c=0.1, gamma=0.001)
ROTARY = cid.plants.rotary_pendulum(
    m=0.024, length=0.0645, arm=0.085, arm_inertia=5.7e-5, J=3.3e-5, kt=0.042, R=8.4, c=2e-4
)
QUAD = cid.plants.quadrotor_planar(m=0.5, J=2e-3, arm=0.15, c=0.05)


def at_rest(plant):
    return cid.operating_point(plant, output=[0.0] * plant.noutputs)


def sampled_model(plant, dt=DT):
    P = cid.linearize(plant, at_rest(plant))
    G = ct.sample_system(P, dt)
    return ct.ss(G.A, G.B, G.C, G.D, dt, inputs=P.input_labels, outputs=P.output_labels)


def lqr_with_observer(plant, analog=False, weights=None):
    """State feedback on an estimate, both made by python-control; references are xd and ud."""
    P = cid.linearize(plant, at_rest(plant)) if analog else sampled_model(plant)
    n, m, p = P.nstates, P.ninputs, P.noutputs
    Q = np.diag(weights or [10.0] * (n // 2) + [1.0] * (n // 2))
    K = (ct.lqr if analog else ct.dlqr)(P, Q, np.eye(m))[0]
    observer = ct.create_estimator_iosystem(P, np.eye(m), 1e-4 * np.eye(p))
    feedback, _ = ct.create_statefbk_iosystem(P, K, estimator=observer)
    inputs = [f"y[{k}]" for k in range(p)] + [f"xd[{k}]" for k in range(n)]
    inputs += [f"ud[{k}]" for k in range(m)]
    return ct.interconnect([observer, feedback], inputs=inputs, outputs=P.input_labels)


def luenberger(plant):
    """The same idea as one linear system that reads the plant's outputs and input by name."""
    G = sampled_model(plant)
    K = ct.dlqr(G, np.diag([10.0, 10, 1, 1]), np.eye(1))[0]
    L = ct.dlqe(G, np.eye(1), 1e-4 * np.eye(2))[0]
    L = G.A @ L
    return ct.ss(G.A - L @ G.C, np.hstack([L, G.B]), -K, np.zeros((1, 3)), DT,
                 inputs=[*plant.output_labels, *plant.input_labels],
                 outputs=plant.input_labels)  # fmt: skip


def solve_digital(plant, C, read, x, xc, n, limits=(-np.inf, np.inf)):
    """Outputs and inputs of a digital loop, the plant solved tightly between the samples."""
    ys, us = [], []
    for k in range(n):
        y = plant.output(0, x, np.zeros(plant.ninputs))
        u = np.clip(C.output(0, xc, read(k, y, np.zeros(plant.ninputs))), *limits)
        xc = C.dynamics(0, xc, read(k, y, u))
        ys.append(y)
        us.append(u)
        x = solve_ivp(lambda t, z, u=u: plant.dynamics(t, z, u), (0, DT), x, method="DOP853",
                      rtol=1e-12, atol=1e-14).y[:, -1]  # fmt: skip
    return np.array(ys).T, np.array(us).T


def close(found, expected, share=1e-9):
    found, expected = np.atleast_2d(found), np.atleast_2d(expected)
    assert (np.abs(found - expected).max(axis=1) <= share * np.abs(expected).max(axis=1)).all()


@pytest.mark.parametrize(("plant", "size"), [(CART, 0.05), (ROTARY, 0.2)])
def test_digital_feedback_with_an_observer(plant, size):
    C, n = lqr_with_observer(plant), 400
    loop = cid.Loop(plant, C, dt=DT, at=at_rest(plant))
    r = size * np.sign(np.sin(2 * np.pi * np.arange(n) * DT / 0.5 + 0.1))
    start = np.array([0.01, 0.02, 0.0, 0.0])
    record = cid.simulate(loop, {"xd[0]": r}, initial=start)
    read = lambda k, y, u: np.concatenate([y, [r[k], 0, 0, 0, 0]])  # noqa: E731
    y, u = solve_digital(plant, C, read, start, np.array(loop.law().rest), n)
    close(record.y, y)
    close(record.u, u)
    assert record.signals == {"r": ("xd[0]",), "u": tuple(plant.input_labels),
                              "y": tuple(plant.output_labels)}  # fmt: skip


@pytest.mark.parametrize("plant", [CART, ROTARY])
def test_analog_feedback_with_an_observer(plant):
    C, n = lqr_with_observer(plant, analog=True), 200
    loop = cid.Loop(plant, C, dt=DT, at=at_rest(plant))
    start = np.array([0.01, 0.02, 0.0, 0.0])
    d = 0.1 * np.sign(np.sin(np.arange(n) / 20 + 0.1))
    record = cid.simulate(loop, d=d, initial=start)
    quiet = np.zeros(5)

    def rate(t, z, k):
        x, xc = z[:4], z[4:]
        w = np.concatenate([x[:2], quiet])
        u = C.output(0, xc, w) + d[k]
        return np.concatenate([plant.dynamics(0, x, u), C.dynamics(0, xc, w)])

    z, ys = np.concatenate([start, loop.law().rest]), []
    for k in range(n):
        ys.append(z[:2])
        z = solve_ivp(rate, (0, DT), z, args=(k,), method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    close(record.y, np.array(ys).T)
    assert record.hold == "foh"


def test_an_observer_reads_the_limited_input():
    C = luenberger(CART)
    loop = cid.Loop(CART, C, dt=DT, at=at_rest(CART), input_limits=(-0.5, 0.4))
    assert loop.wiring.reads_input
    start = np.array([0.0, 0.04, 0.0, 0.0])
    record = cid.simulate(loop, d=np.zeros(300), initial=start)
    read = lambda k, y, u: np.concatenate([y, u])  # noqa: E731
    y, u = solve_digital(CART, C, read, start, np.zeros(4), 300, (-0.5, 0.4))
    assert (record.u == -0.5).any()
    close(record.y, y)
    close(record.u, u)


def test_two_thrusts_and_three_outputs():
    C = lqr_with_observer(QUAD, weights=[10.0, 10, 10, 1, 1, 1])
    loop = cid.Loop(QUAD, C, dt=DT, at=at_rest(QUAD))
    n = 300
    record = cid.simulate(loop, {"xd[1]": np.full(n, 0.1)})
    hover = np.array(loop.at.input)
    rest = np.array(loop.law().rest)
    # The observer of a linear model does not know that hovering takes thrust: its rest is off.
    read = lambda k, y, u: np.concatenate([y, [0, 0.1, 0, 0, 0, 0], hover])  # noqa: E731
    y, u = solve_digital(QUAD, C, read, np.zeros(6), rest, n)
    close(record.y[1:2], y[1:2])
    close(record.u, u)
    assert record.u.shape == (2, n)
    assert loop.linearize().ninputs == 2


def test_a_state_that_stays_at_a_point_other_than_zero():
    # An observer of absolute signals waits at the plant's states, an integrator where it holds u.
    servo = ct.ss([[0, 1], [0, -1]], [[0], [2]], np.eye(2), np.zeros((2, 1)), inputs="V",
                  outputs=["x", "v"])  # fmt: skip
    follow = ct.ss([[0.5]], [[0.5, 0.0]], [[1.0]], [[0.0, 0.0]], 0.01, inputs=["x", "v"],
                   outputs="V")  # fmt: skip
    at = cid.OperatingPoint((0.3, 0.0), 0.3, (0.3, 0.0))
    assert cid.Loop(servo, follow, dt=0.01, at=at).law().rest == pytest.approx((0.3,))
    integral = ct.ss([[1.0]], [[0.1, -0.1]], [[2.0]], [[0.0, -1.0]], 0.01, inputs=["x_d", "x"],
                     outputs="V")  # fmt: skip
    law = cid.Loop(servo, integral, dt=0.01, at=cid.OperatingPoint((0, 0), 0.3, (0.0, 0.0))).law()
    assert law.rest == pytest.approx((0.15,))


PAIR = ct.ss([], [], [], [[6.0, 30.0]], DT)


def test_controllers_without_names_read_the_errors_or_references_and_outputs():
    plant, n = CART, 100
    gain = np.array([[-3.0, -40.0]])
    by_error = cid.Loop(plant, ct.ss([], [], [], -gain, DT), dt=DT, at=at_rest(plant))
    both = cid.Loop(plant, ct.ss([], [], [], np.hstack([-gain, gain]), DT), dt=DT,
                    at=at_rest(plant))  # fmt: skip
    named = cid.Loop(plant, ct.ss([], [], [], np.hstack([gain, -gain]), DT, outputs="F",
                     inputs=["x", "theta", "x_d", "theta_d"]), dt=DT,
                     at=at_rest(plant))  # fmt: skip
    r = np.array([np.full(n, 0.01), np.zeros(n)])
    runs = [cid.simulate(loop, r, initial=[0, 0.01, 0, 0]) for loop in (by_error, both, named)]
    for run in runs[1:]:
        np.testing.assert_allclose(run.u, runs[0].u, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(runs[0].u, (-gain @ (r - runs[0].y))[0], atol=1e-12)
    assert runs[0].signals["r"] == ("x", "theta")
    assert runs[2].signals["r"] == ("x_d", "theta_d")
    assert "reference x - x" in repr(by_error)


def test_a_cascade_of_transfer_functions():
    inner = ct.tf([4.0], [1.0], DT, inputs="e_v", outputs="F", name="inner")
    outer = ct.tf([2.0], [1.0], DT, inputs="e_x", outputs="v_d", name="outer")
    sums = [
        ct.summing_junction(["x_d", "-x"], "e_x"),
        ct.summing_junction(["v_d", "-theta"], "e_v"),
    ]
    C = ct.interconnect([outer, inner, *sums], inputs=["x", "theta", "x_d"], outputs="F")
    run = cid.simulate(cid.Loop(CART, C, dt=DT), np.full(50, 0.01))
    np.testing.assert_allclose(run.u, 4 * (2 * (0.01 - run.y[0]) - run.y[1]), atol=1e-12)


def test_the_text_lists_the_wiring():
    loop = cid.Loop(CART, lqr_with_observer(CART), dt=DT, at=at_rest(CART))
    for line in ("y[1] <- theta", "xd[2] <- reference xd[2], else held at 0", "F <- F of the"):
        assert line in repr(loop)
    assert "reads" not in repr(cid.Loop(CART, dt=DT))


def test_points_of_python_control():
    theirs = ct.find_operating_point(CART, [0, 0.01, 0, 0], [0.0])
    loop = cid.Loop(CART, lqr_with_observer(CART), dt=DT, at=theirs)
    assert loop.at.states == pytest.approx(theirs.states)
    assert loop.at.output == pytest.approx(theirs.states[:2])
    assert loop.at.input == pytest.approx(theirs.inputs[0])
    ours, ct_model = loop.linearize(), ct.linearize(CART, theirs.states, theirs.inputs)
    np.testing.assert_allclose(ours.A, ct_model.A, atol=1e-4)
    assert ours.state_labels == CART.state_labels


def test_driven_inputs_and_known_forces():
    pushed = CART.mechanism
    loop = cid.Loop(pushed, luenberger(CART), dt=DT, driven=("F",), forces=CART.forces)
    plain = cid.Loop(CART, luenberger(CART), dt=DT)
    run, other = (cid.simulate(one, d=np.full(200, 0.1)) for one in (loop, plain))
    np.testing.assert_array_equal(run.y, other.y)
    assert loop.signals["u"] == ("F",)
    # A torque at the pivot moves the cart as well, through the mass matrix.
    noisy = cid.simulate(plain, d=np.zeros(2), force_noise=(0.0, 1.0), seed=1)
    rates = pushed.dynamics(0, np.zeros(4), [0.0, 1.0])[2:]
    moved = cid.simulate(plain, d=np.zeros(3), force_noise=(0.0, 1.0), seed=1).y[:, 1]
    assert moved[0] / moved[1] == pytest.approx(rates[0] / rates[1], rel=1e-3)
    assert len(noisy) == 2
    alone = cid.simulate(cid.Loop(CART, luenberger(CART), dt=DT, forces={}), d=np.zeros(3),
                         force_noise=(0.0, 1.0), seed=1).y[:, 1]  # fmt: skip
    assert abs(alone[0]) < 1e-5 * abs(alone[1])


def test_noise_of_each_output_is_its_own():
    loop = cid.Loop(CART, luenberger(CART), dt=DT)
    quiet, noisy = (cid.simulate(loop, d=np.zeros(500), sensor_noise=s, seed=1)
                    for s in (0.0, (1e-4, 1e-3)))  # fmt: skip
    assert not quiet.y.any()
    assert np.diff(noisy.y).std(axis=1) == pytest.approx([1.4e-4, 1.4e-3], rel=0.1)


@pytest.mark.parametrize("change", [{"M": 0.7}, {"m": 0.25, "gamma": 0.0}])
def test_other_parameters_reach_the_forces(change):
    loop = cid.Loop(CART, luenberger(CART), dt=DT).with_parameters(change)
    fresh = cid.plants.cart_pole(**{**CART.params, **change})
    again = cid.Loop(fresh, luenberger(CART), dt=DT)
    for one in (loop, cid.Loop(loop.plant, loop.controller, dt=DT)):
        np.testing.assert_array_equal(one.linearize().A, again.linearize().A)


def test_a_gain_of_all_states_is_not_wired_to_references_and_outputs():
    K = np.array([[1.0, 2.0, 3.0, 4.0]])
    with pytest.raises(cid.CtrlidError, match=r"4 states \(x, theta, x_dot, theta_dot\) but 2 out"):
        cid.Loop(CART, ct.ss([], [], [], -K, DT), dt=DT)
    # With names it is what it says, and a controller with states has a reason for its inputs.
    named = ct.ss([], [], [], -K, DT, inputs=["r_x", "r_theta", "x", "theta"])
    assert "r_x <- reference r_x" in repr(cid.Loop(CART, named, dt=DT))
    filtered = ct.ss(0.5, np.ones((1, 4)), 1, -K, DT)
    loop = cid.Loop(CART, filtered, dt=DT)
    assert "without names read the references and then the outputs" in repr(loop)
    with pytest.raises(cid.CtrlidError, match=r"so that they read the references .* -K, dt, inp"):
        cid.simulate(loop, np.zeros((2, 2000)), sensor_noise=1e-3)


def test_a_reference_of_another_name_is_answered_once():
    names = ["x", "theta", "rpos"]
    loop = cid.Loop(CART, ct.ss([], [], [], [[5.0, 40.0, -5.0]], DT, inputs=names), dt=DT)
    words = r"the reference rpos; given r, which .* not have. .* a mapping such as \{'rpos': r\}"
    with pytest.raises(cid.CtrlidError, match=words):
        cid.simulate(loop, {"r": np.zeros(50)})


def pair(**options):
    return ct.ss([], [], [], [[1.0, 1.0]], DT, **options)


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: cid.Loop(CART, pair(inputs=["a", "b"]), dt=DT),
         r"reads \['a', 'b'\], and none of these is an output of the plant \(x, theta\)"),
        (lambda: cid.Loop(CART, ct.ss([], [], [], [[1, 1, 1.0]], DT), dt=DT),
         "3 inputs without names, the plant 2 outputs .*: give it 2 for r - y, or 4"),
        (lambda: cid.Loop(CART, 3.0, dt=DT), "its controller is a TransferFunction"),
        (lambda: cid.Loop(CART, cid.PID(kp=1), dt=DT), "Several PIDs are put together with"),
        (lambda: cid.Loop(CART, ct.ss([], [], [], np.eye(2), DT), dt=DT),
         r"has outputs \['y\[0\]', 'y\[1\]'\], the plant inputs \['F'\]"),
        (lambda: cid.Loop(CART, ct.ss([], [], [], np.ones((1, 3)), DT,
                          inputs=["x", "theta", "F"]), dt=DT), "from that very input .an alg"),
        (lambda: cid.Loop(CART, ct.ss([], [], [], [[1.0, 1.0]], 0.01), dt=DT),
         "the controller runs at 0.01 s, the loop at 0.002 s"),
        (lambda: cid.Loop(ct.ss([[-1.0]], [[1.0]], [[1.0], [0]], [[0], [1.0]]), pair(), dt=DT),
         "passes its input to its output without delay"),
        (lambda: cid.Loop(CART, dt=DT, at=cid.OperatingPoint((0, 0, 0, 0), 0, 0)),
         r"at= has 1 output, but cart_pole has 2 \(x, theta\); give output=\(\.\.\., \.\.\.\)"),
        (lambda: cid.Loop(CART, dt=DT, at=cid.OperatingPoint((0, 0), 0, (0, 0))),
         "at= has 2 states, but cart_pole has 4"),
        (lambda: cid.Loop(CART, dt=DT, driven=("G",)), r"driven= names \['G'\], but the inputs of"),
        (lambda: cid.Loop(CART, dt=DT, forces={"x": "F"}), "forces= says which input works on"),
        (lambda: cid.Loop(QUAD, dt=DT, input_limits=((0, 0), (1, 0))), "needs lower < upper"),
        (lambda: cid.Loop(QUAD, dt=DT, input_limits=((0, 0, 0), 1)), "is a pair"),
    ],
)  # fmt: skip
def test_refused_loops(build, words):
    with pytest.raises(cid.CtrlidError, match=words):
        build()


@pytest.mark.parametrize(
    ("r", "options", "words"),
    [
        (None, {"d": np.zeros(9)}, "reads x_d and theta_d, .* no reference of this name is given"),
        (np.zeros((3, 9)), {}, "has the references x_d and theta_d; given 3"),
        ({"x_d": np.zeros(9)}, {}, "reads theta_d, which is no input and no output of the plant"),
        ({"x_d": np.zeros(9), "w": np.zeros(9)}, {}, "given w"),
        (np.zeros((2, 9)), {"d": np.zeros(8)}, "equally long; given 9 and 8"),
        (np.zeros((2, 9)), {"d": np.zeros((2, 9))}, r"one row for each input \(F\)"),
        (np.zeros((2, 9)), {"sensor_noise": (1, 2, 3)}, "deviation >= 0, or 2 of them"),
        (np.zeros((9, 2)), {}, r"given 9, an array of shape \(9, 2\)\. It looks transposed.* r\.T"),
        (np.zeros((2, 9)), {"d": np.zeros((9, 2))}, r"given shape \(9, 2\)\. It looks .* d\.T"),
        ([["a"]], {}, "arrays of numbers"),
        (np.full((2, 9), np.nan), {}, "finite samples"),
    ],
)
def test_refused_simulations(r, options, words):
    C = ct.ss([], [], [], [[3, 40, 1, 1.0]], DT, inputs=["x", "theta", "x_d", "theta_d"])
    with pytest.raises(cid.CtrlidError, match=words):
        cid.simulate(cid.Loop(CART, C, dt=DT), r, **options)


def test_a_state_that_is_no_output_is_not_read_in_silence():
    C = ct.ss([], [], [], [[3, 40, 1, 5.0]], DT, inputs=["x", "theta", "x_dot", "x_d"])
    loop = cid.Loop(CART, C, dt=DT)
    assert "x_dot <- reference x_dot (NOT THE STATE, which is no output)\n" in str(loop)
    assert "x_d <- reference x_d\n" in str(loop)
    with pytest.raises(cid.CtrlidError, match="A state of the plant is read only where it is an"):
        cid.simulate(loop, {"x_d": np.zeros(9)})


def test_a_long_series_in_place_of_a_number_is_written_short():
    C = ct.ss([], [], [], [[3, 40.0]], DT, inputs=["x", "theta"])
    with pytest.raises(cid.CtrlidError, match=r"given array\(\[0\., 0\., .*\.\.\.$") as refused:
        cid.simulate(cid.Loop(CART, C, dt=DT), d=np.zeros(9), sensor_noise=np.zeros(99))
    assert "\n" not in str(refused.value)


def test_a_loop_that_diverges_is_explained():
    C = ct.ss([], [], [], [[5.0, 0.0]], DT, inputs=["x", "theta"])
    with pytest.raises(cid.CtrlidError, match="closed loop is unstable: small deviations grow"):
        cid.simulate(cid.Loop(CART, C, dt=DT), d=np.zeros(20000), initial=[0, 1e-6, 0, 0])


CHAIN = ct.nlsys(lambda t, x, u, p: [-x[0] + u[0], -x[1] + 0.5 * x[0]], lambda t, x, u, p: x,
                 inputs=["F"], outputs=["a", "b"], states=["x1", "x2"], name="chain")  # fmt: skip


@pytest.mark.parametrize(
    ("names", "b", "references"),
    [
        (["ref", "a"], [[0.05, -0.05]], (1.08,)),
        (["ref", "b"], [[0.05, -0.05]], (0.54,)),
        (["rb", "ra", "b", "a"], [[0.05, 0, -0.05, 0], [0, 0.05, 0, -0.05]], (0.54, 1.08)),
    ],
)
def test_an_integrator_rests_where_its_outputs_are(names, b, references):
    """Its reference was zero, or that of another output, and its state ran away to 1e13."""
    n = len(b)
    law = ct.ss(np.eye(n), b, [[0.3, 0.2][:n]], 0.1 * np.sign(np.sum(b, axis=0))[None], 0.05,
                inputs=names, outputs="F")  # fmt: skip
    at = cid.operating_point(CHAIN, output=[1.08, 0.54])
    loop = cid.Loop(CHAIN, law, dt=0.05, at=at)
    assert loop.law().references == pytest.approx(references)
    r = np.repeat(np.array(references)[:, None], 50, axis=1)
    record = cid.simulate(loop, r[0] if n == 1 else r)
    assert np.ptp(record.y, axis=1).max() < 1e-9


def test_a_controller_without_a_rest_begins_at_zero():
    law = ct.ss([[1.0]], [[0.05, 0.05, -0.05]], [[0.3]], [[0.1, 0.1, -0.1]], 0.05,
                inputs=["one", "two", "a"], outputs="F")  # fmt: skip
    at = cid.operating_point(CHAIN, output=[1.08, 0.54])
    assert np.abs(cid.Loop(CHAIN, law, dt=0.05, at=at).law().rest).max() < 100.0


def test_a_wrong_observer_of_a_plant_with_one_output_is_told():
    """It has three inputs, whose names were lost where its gain was tried."""
    plant = ct.ss([[0, 1], [-3, -2]], [[0], [1]], [[1, 0]], 0, inputs="V", outputs="x", name="st")
    d = ct.sample_system(plant, 0.02)
    K, L = np.array([[4.0, 1.0]]), ct.dlqe(d.A, np.eye(2), d.C, np.eye(2), np.eye(1))[0]
    law = ct.ss(d.A - L @ d.C, np.hstack([L, d.B, np.zeros((2, 1))]), -K, [[0, 0, 5.0]], 0.02,
                inputs=["x", "V", "r"], outputs="V")  # fmt: skip
    loop = cid.Loop(plant, law, dt=0.02)
    record = cid.simulate(loop, cid.random_binary(800, amplitude=1.0, hold=40, seed=1),
                          sensor_noise=1e-3, seed=2)  # fmt: skip
    louder = ct.ss(
        law.A, law.B, 1.3 * law.C, 1.3 * law.D, 0.02, inputs=["x", "V", "r"], outputs="V"
    )
    wrong = cid.Loop(plant, louder, dt=0.02)
    assert not cid.audit(record, loop).harmful
    assert cid.audit(record, wrong).harmful
    assert "prediction" in cid.compare(record, wrong).curves[0].label
