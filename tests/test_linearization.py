"""Operating points and linear models against physics known by hand."""

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import CtrlidError
from problems import held_ball, tank

RNG = np.random.default_rng(11)
MAGLEVS = [
    (RNG.uniform(0.01, 0.1), RNG.uniform(0.005, 0.02), RNG.uniform(1, 10)) for _ in range(40)
]


@pytest.mark.parametrize(("mass", "gap", "voltage"), MAGLEVS)
def test_maglev_operating_point_and_poles(mass, gap, voltage):
    plant = held_ball(mass, gap, voltage)
    op = cid.operating_point(plant, output=gap)
    assert op.input == pytest.approx(voltage, rel=1e-13)
    assert op.states == (pytest.approx(gap, rel=1e-15), 0.0)
    assert all(isinstance(v, float) for v in (*op.states, op.input, op.output))
    P = cid.linearize(plant, op)
    assert P.num[0][0].size == 1
    assert P.num[0][0][0] == pytest.approx(-2 * 9.81 / voltage, rel=1e-12)
    np.testing.assert_allclose(P.den[0][0], [1, 0, -2 * 9.81 / gap], rtol=1e-12)
    assert P.den[0][0][1] == 0.0


def test_linearize_equals_finite_differences_of_python_control():
    plant = cid.plants.pendulum(m=0.2, length=0.5, c=0.01)
    op = cid.operating_point(plant, output=0.3)
    reference = ct.tf(ct.linearize(plant, op.states, op.input))
    omega = np.array([0.1, 3.0, 40.0])
    np.testing.assert_allclose(
        cid.linearize(plant, op)(1j * omega), reference(1j * omega), rtol=1e-5
    )


def test_tank_has_its_time_constant():
    loop = tank()
    assert loop.at.input == pytest.approx(np.sqrt(2 * 9.81 * 0.2))
    pole = cid.linearize(loop.plant, loop.at).poles()[0].real
    assert pole == pytest.approx(-1e-5 / 0.01 * np.sqrt(9.81 / (2 * 0.2)))


def test_servo_keeps_its_pole_at_the_origin():
    plant = cid.plants.servo(m=2.0, c=3.0, k=4.0)
    P = cid.linearize(plant, cid.operating_point(plant, output=0.5))
    np.testing.assert_array_equal(P.den[0][0], [1.0, 1.5, 0.0])
    np.testing.assert_array_equal(P.num[0][0], [2.0])


@pytest.mark.parametrize(
    ("plant", "output", "words"),
    [
        (cid.plants.maglev(m=0.02, K=3e-6), -0.01, "maglev has no equilibrium with x = -0.01"),
        (
            cid.plants.maglev(m=0.02, K=3e-6),
            0.0,
            "no states and input V were found that hold it there",
        ),
        (tank().plant, -0.2, "inside the range of the plant"),
        (cid.plants.maglev(m=0.02, K=3e-6), np.nan, "output must be a finite number"),
        (cid.plants.maglev(m=0.02, K=3e-6), "high", "output must be a finite number; given 'high'"),
    ],
)
def test_unreachable_outputs_are_refused(plant, output, words):
    with pytest.raises(CtrlidError, match=words):
        cid.operating_point(plant, output=output)


@pytest.mark.parametrize("output", [0.0, 0.1])
@pytest.mark.parametrize(
    ("acceleration", "bias"),
    [(lambda x, v, u: u - 0.1 * v, lambda x: 0.0),
     (lambda x, v, u: u - 3.0 * x - 0.1 * v, lambda x: 3.0 * x),
     (lambda x, v, u: 9.81 - (u / (x + 0.2)) ** 2, lambda x: (x + 0.2) * np.sqrt(9.81))],
    ids=["mass", "spring", "magnet"],
)  # fmt: skip
def test_a_plant_with_dry_friction_as_a_sign_rests(acceleration, bias, output):
    """Rounding left a speed of 1e-18, whose friction the input had to balance."""
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], acceleration(x[0], x[1], u[0]) - 0.2 * np.sign(x[1])]),
        lambda t, x, u, p: x[0], inputs=["u"], outputs=["x"], states=["x", "v"], name="rubbing",
    )  # fmt: skip
    at = cid.operating_point(plant, output=output)
    assert at.states == pytest.approx((output, 0.0), abs=1e-15)
    assert at.input == pytest.approx(bias(output), rel=1e-9, abs=1e-12)
    assert np.isfinite(cid.linearize(plant, at)(1j))


def test_a_plant_without_a_value_at_rest_says_what_to_write():
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], u[0] - 0.2 * x[1] / abs(x[1])]),
        lambda t, x, u, p: x[0], inputs=["u"], outputs=["x"], states=["x", "v"], name="rubbing",
    )  # fmt: skip
    with pytest.raises(CtrlidError, match=r"has no value at v = 0: write np.sign\(v\)"):
        cid.operating_point(plant, output=0.1)


def test_a_level_below_the_outlet_is_answered_with_the_root_of_a_negative_number():
    tanks = ct.nlsys(
        lambda t, x, u, p: np.array([u[0] - np.sqrt(x[0]), np.sqrt(x[0]) - np.sqrt(x[1])]),
        lambda t, x, u, p: x[1], inputs=["q"], outputs=["level"], states=["h1", "h2"], name="tanks",
    )  # fmt: skip
    with pytest.raises(CtrlidError, match="A root or a logarithm of a negative number has no"):
        cid.operating_point(tanks, output=-1.0)


def test_a_plant_that_changes_with_time_has_no_operating_point():
    plant = ct.nlsys(lambda t, x, u, params: np.array([x[1], np.sin(t) - x[0] + u[0]]),
                     lambda t, x, u, params: x[0], name="shaken", inputs=1, outputs=1,
                     states=2)  # fmt: skip
    with pytest.raises(CtrlidError, match=r"shaken changes with time .* without t, .* input"):
        cid.operating_point(plant, output=0.1)


def two_signs(t, x, u, params):
    return [x[1], u[0] ** 2 - 4 * x[0]]


def test_smallest_non_negative_input_of_several_equilibria():
    plant = ct.nlsys(two_signs, lambda t, x, u, p: x[0], inputs=1, outputs=1, states=2, name="sq")
    assert cid.operating_point(plant, output=1.0).input == pytest.approx(2.0)
    only_negative = ct.nlsys(
        lambda t, x, u, p: [u[0] + x[0]], None, inputs=1, outputs=1, states=1, name="neg"
    )
    assert cid.operating_point(only_negative, output=3.0).input == pytest.approx(-3.0)


def test_guess_chooses_among_equilibria():
    plant = ct.nlsys(
        lambda t, x, u, p: [x[0] - x[1], u[0] - np.sin(x[0])], lambda t, x, u, p: np.sin(x[1]),
        inputs=1, outputs=1, states=2, name="waves",
    )  # fmt: skip
    near = cid.operating_point(plant, output=0.5, guess=(6.8, 6.8))
    assert near.states[0] == pytest.approx(np.pi / 6 + 2 * np.pi)
    again = cid.operating_point(plant, output=0.5, guess=near)
    assert again.states == pytest.approx(near.states)
    with pytest.raises(CtrlidError, match="guess needs 2 states; given 1"):
        cid.operating_point(plant, output=0.5, guess=(1.0,))


def test_discrete_plants_rest_and_linearize():
    plant = ct.nlsys(
        lambda t, x, u, p: [0.5 * x[0] + u[0] ** 3], lambda t, x, u, p: x[0],
        inputs=1, outputs=1, states=1, dt=0.1, name="steps",
    )  # fmt: skip
    op = cid.operating_point(plant, output=2.0)
    assert op.input == pytest.approx(1.0)
    P = cid.linearize(plant, op)
    assert P.dt == 0.1
    np.testing.assert_allclose(np.r_[P.num[0][0], P.den[0][0]], [3.0, 1.0, -0.5])


def test_only_unreachable_or_unobservable_states_are_removed():
    at = cid.OperatingPoint((0.0, 0.0, 0.0), 0.0, 0.0)
    weak = ct.ss([[1, 0, 0], [0, -2, 1], [0, 0, -3]], [[1], [0], [1e-9]], [[1, 1e-9, 0]], 0)
    assert len(cid.linearize(weak, at).poles()) == 3
    cut = ct.ss([[1, 0, 0], [0, -2, 1], [0, 0, -3]], [[1], [0], [0]], [[1, 1e-9, 0]], 0)
    np.testing.assert_allclose(cid.linearize(cut, at).poles(), [1.0])
    turn = np.random.default_rng(0).standard_normal((3, 3))
    back = np.linalg.inv(turn)
    hidden = ct.ss(
        turn @ np.diag([1, -2, -3]) @ back,
        turn @ [[1], [1], [0.0]],
        np.array([[1, 0, 1.0]]) @ back,
        0,
    )
    np.testing.assert_allclose(cid.linearize(hidden, at).poles(), [1.0], rtol=1e-9)
    static = ct.ss([[-1.0]], [[0.0]], [[1.0]], [[2.0]])
    assert cid.linearize(static, cid.OperatingPoint((0.0,), 0, 0)).num[0][0] == [2.0]


def test_what_linearize_refuses():
    plant = cid.plants.maglev(m=0.02, K=3e-6)
    with pytest.raises(CtrlidError, match="needs an OperatingPoint"):
        cid.linearize(plant, (0.01, 0.0))
    with pytest.raises(CtrlidError, match=r"has 1 state .* maglev has 2: x, v"):
        cid.linearize(plant, cid.OperatingPoint((0.01,), 3.0, 0.01))
    with pytest.raises(CtrlidError, match="has no derivative"):
        cid.linearize(plant, cid.OperatingPoint((-0.01, 0.0), 3.0, -0.01))
    two = ct.ss(-np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2)))
    with pytest.raises(CtrlidError, match=r"at= has 1 input, but .* has 2 \(u\[0\], u\[1\]\)"):
        cid.linearize(two, cid.OperatingPoint((0, 0), 0, 0))


def test_operating_point_checks_its_numbers():
    with pytest.raises(CtrlidError, match="must be finite"):
        cid.OperatingPoint((0.01, np.inf), 1.0, 0.01)
    with pytest.raises(CtrlidError, match="given by numbers"):
        cid.OperatingPoint(("a",), 1.0, 0.01)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: cid.plants.maglev(m=-1, K=1e-6), r"maglev needs m > 0 in SI units; given m=-1"),
        (lambda: cid.plants.servo(m=1, c=-1, k=1), "servo needs c >= 0"),
        (lambda: cid.plants.tank(area=0, outlet=1, k=1), "tank needs area > 0"),
        (lambda: cid.plants.pendulum(m=1, length=1, c=np.nan), "pendulum needs c >= 0"),
    ],
)
def test_plants_refuse_unphysical_parameters(make, words):
    with pytest.raises(CtrlidError, match=words):
        make()


def test_states_are_those_of_the_plant_in_their_order():
    plant = cid.plants.pendulum(m=0.2, length=0.5, c=0.01)
    op = cid.operating_point(plant, output=0.3)
    made, theirs = cid.linearize(plant, op, states=True), ct.linearize(plant, op.states, op.input)
    for name in ("A", "B", "C", "D"):
        np.testing.assert_allclose(getattr(made, name), getattr(theirs, name), rtol=1e-5, atol=1e-6)
    assert made.state_labels == ["theta", "omega"]
    assert (made.input_labels, made.output_labels, made.dt) == (["tau"], ["theta"], 0)
    assert (
        cid.Loop(plant, None, dt=0.01, at=op).linearize(states=True).A.tolist() == made.A.tolist()
    )


def test_a_state_feedback_for_the_completed_plant():
    """K from the states of the model with its effects puts the poles of x' = f(x, -K x)."""
    plant = cid.plants.servo(m=2.0, c=1.0, k=3.0)
    loop = cid.Loop(plant, None, dt=0.01, effects=[cid.effects.LinearStiffness(k1=5.0)])
    G = loop.linearize(states=True)
    K = ct.place(G.A, G.B, [-2.0, -3.0])
    A = np.array([[0.0, 1.0], [-5.0, -0.5]]) - np.array([[0.0], [1.5]]) @ K
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(A)), [-3.0, -2.0], rtol=1e-9)


def test_states_of_effects_follow_those_of_the_plant():
    plant = cid.plants.servo(m=2.0, c=1.0, k=3.0)
    late = cid.Loop(plant, None, dt=0.01).with_effect(cid.effects.InputDelay(0.02))
    G = late.with_effect(cid.effects.ActuatorLag(0.05)).linearize(states=True)
    assert G.state_labels[:2] == ["x", "v"]
    assert G.nstates == 5
    assert not any("." in name for name in G.state_labels)
    w = 1j * np.array([0.1, 1.0, 10.0])
    bare = late.with_effect(cid.effects.ActuatorLag(0.05)).linearize()
    np.testing.assert_allclose(G(w), bare(w), rtol=1e-9)
    sampled = cid.Loop(ct.tf([1.0], [1.0, -1.1], 0.1, name="G"), None, dt=0.1)
    assert sampled.linearize(states=True).dt == 0.1


def at_height(u):
    return cid.OperatingPoint(states=(0.012, 0.0), input=u, output=0.012)


def test_a_loop_says_where_its_plant_does_not_rest():
    plant = cid.plants.maglev(m=0.0213, K=3.34e-6)

    def text(u):
        return repr(cid.Loop(plant, None, dt=1e-3, at=at_height(u)))

    # A rounded input, and one that suits a magnet 10 % weaker, are at rest.
    assert "REST" not in text(3.0)
    assert "REST" not in text(3.0 / np.sqrt(0.9))
    assert text(2.5).endswith("V = 2.5 (NOT AT REST THERE: v changes by 3 m/s a second))")
    off = cid.Loop(plant, None, dt=1e-3, at=at_height(2.5))
    assert off.linearize().num[0][0] < 0
    # A force that holds the plant where it does not rest alone, and linear plants, are at rest.
    weight = ct.nlsys(lambda t, x, u, params: [x[1], u[0] - 9.81 * np.cos(x[0])],
                      lambda t, x, u, params: [x[0]], inputs=["F"], outputs=["y"],
                      states=["y", "v"], name="arm")  # fmt: skip
    arm = cid.Loop(weight, None, dt=0.01)
    assert "v changes by -9.81 a second" in repr(arm)
    assert "REST" not in repr(arm.with_effect(cid.effects.ConstantForce(bias=9.81)))
    at = cid.OperatingPoint((), 5.0, 7.0)
    assert "REST" not in repr(cid.Loop(ct.tf(1, [1, 1]), None, dt=0.01, at=at))
    jump = ct.nlsys(lambda t, x, u, params: [0.5 * x[0] + u[0] + 1.0],
                    lambda t, x, u, params: [x[0]], inputs=1, outputs=1, states=1,
                    dt=0.1)  # fmt: skip
    assert "x[0] changes by 1 a sample" in repr(cid.Loop(jump, None, dt=0.1))


def test_a_point_without_any_balance_is_not_linearized():
    plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    loop = cid.Loop(plant, None, dt=1e-3, at=at_height(0.0))
    words = "v changes by 9.81 a second, and the input 0 has no influence on that to first order"
    for call in (loop.linearize, lambda: loop.linearize(states=True),
                 lambda: cid.linearize(plant, at_height(0.0))):  # fmt: skip
        with pytest.raises(cid.CtrlidError, match=words):
            call()
    # A body that falls whatever the input is has a linear model, with its gain elsewhere.
    falling = ct.nlsys(lambda t, x, u, params: [u[0], -9.81], lambda t, x, u, params: [x[0]],
                       inputs=1, outputs=1, states=2)  # fmt: skip
    G = cid.linearize(falling, cid.OperatingPoint((0, 0), 0, 0))
    assert G.num[0][0] == pytest.approx([1.0])


def test_an_input_of_round_off_is_zero_and_a_small_one_is_not():
    """A bearing at rest in its middle was told to need 9.98e-18 A."""

    def make(force):
        return ct.nlsys(lambda t, x, u, p: np.array([x[1], force(x[0], u[0])]),
                        lambda t, x, u, p: x[0], inputs=["i"], outputs=["x"],
                        states=["x", "v"])  # fmt: skip

    bearing = make(lambda x, i: (2 + i) ** 2 / (4e-4 - x) ** 2 - (2 - i) ** 2 / (4e-4 + x) ** 2)
    at = cid.operating_point(bearing, output=0.0)
    assert (at.states, at.input) == ((0.0, 0.0), 0.0)
    small = make(lambda x, i: i - 1e-14)
    assert cid.operating_point(small, output=0.0).input == pytest.approx(1e-14)


def test_a_single_output_may_stand_in_a_list():
    plant = cid.plants.maglev(m=0.02, K=3e-6)
    alone = cid.operating_point(plant, output=0.01)
    for given in ([0.01], (0.01,), np.array([0.01])):
        assert cid.operating_point(plant, output=given) == alone
    with pytest.raises(cid.CtrlidError, match="one for each output of"):
        cid.operating_point(plant, output=[0.01, 0.02])


def test_a_plant_of_large_numbers_has_its_equilibrium():
    """Pressures in Pa, below which of the air the equations have no value."""
    tank = ct.nlsys(
        lambda t, x, u, p: np.array([1e4 * u[0] - 100 * np.sqrt(x[0] - 101325.0)]),
        lambda t, x, u, p: x[0], inputs=["q"], outputs=["p"], states=["p"], name="vessel",
    )  # fmt: skip
    at = cid.operating_point(tank, output=2e5)
    assert at.states == pytest.approx((2e5,))
    assert at.input == pytest.approx(0.01 * np.sqrt(2e5 - 101325.0))
    assert str(cid.Loop(tank, None, dt=0.1, at=at)).startswith("Loop(vessel")
