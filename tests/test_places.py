"""Effects at a place: an input, a velocity or an output of a plant with several of them."""

import math
from dataclasses import replace
from types import SimpleNamespace

import casadi
import control as ct
import numpy as np
import pytest
from scipy import linalg

import ctrlid as cid
from ctrlid import effects as E
from ctrlid.diagnosis.answer import _list_notes
from ctrlid.diagnosis.candidates import list_candidates
from ctrlid.estimation.likelihood.filter_data import find_noise_units
from ctrlid.loop.loop import write_loop
from ctrlid.loop.velocities import suppose_force
from problems import drive
from test_wiring import CART, DT, QUAD, at_rest, lqr_with_observer, luenberger

START = [0.0, 0.03, 0.0, 0.0]


def cart(*effects, plant=CART, **options):
    loop = cid.Loop(plant, luenberger(CART), dt=DT, at=at_rest(CART), **options)
    for effect in effects:
        loop = loop.with_effect(effect)
    return loop


def written_out(push=lambda x, u: (u, 0.0), show=lambda x: x[:2]):
    """The cart with what acts on it written into its equations by hand."""
    plant = CART.mechanism

    def update(t, x, u, params):
        force, torque = push(x, u[0])
        return plant.updfcn(t, x, [force, torque], plant.params)

    return ct.nlsys(update, lambda t, x, u, params: show(x), inputs=["F"], outputs=["x", "theta"],
                    states=CART.state_labels, name="by_hand")  # fmt: skip


@pytest.mark.parametrize(
    ("effect", "plant"),
    [
        (E.ViscousFriction(c=0.7, at="x_dot"), written_out(lambda x, u: (u - 0.7 * x[2], 0.0))),
        (E.ViscousFriction(c=0.01, at="theta_dot"), written_out(lambda x, u: (u, -0.01 * x[3]))),
        (E.LinearStiffness(k1=2.0, at="x_dot"), written_out(lambda x, u: (u - 2 * x[0], 0.0))),
        (E.ConstantForce(bias=0.2, at="theta_dot"), written_out(lambda x, u: (u, 0.2))),
        (E.InputOffset(offset=0.3, at="F"), written_out(lambda x, u: (u + 0.3, 0.0))),
        (E.SensorGain(error=0.1, at="theta"),
         written_out(show=lambda x: np.array([x[0], 1.1 * x[1]]))),
        (E.SensorOffset(offset=0.01, at="theta"),
         written_out(show=lambda x: np.array([x[0], x[1] + 0.01]))),
        (E.Quantization(step=0.002, at="theta"),
         written_out(show=lambda x: np.array([x[0], 0.002 * np.round(x[1] / 0.002)]))),
        (E.SensorSaturation(lower=-0.02, upper=0.02, at="theta"),
         written_out(show=lambda x: np.array([x[0], np.clip(x[1], -0.02, 0.02)]))),
    ],
)  # fmt: skip
def test_an_effect_acts_where_it_says(effect, plant):
    loop = cart(effect)
    by_hand = cid.Loop(plant, luenberger(CART), dt=DT, at=at_rest(CART))
    runs = [cid.simulate(one, d=np.full(300, 0.05), initial=START) for one in (loop, by_hand)]
    np.testing.assert_allclose(runs[0].y, runs[1].y, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(runs[0].u, runs[1].u, rtol=1e-7, atol=1e-10)


def test_each_output_has_readings_of_its_own():
    saturated = E.SensorSaturation(lower=-0.011, upper=0.011, at="x")
    loop = cart(
        E.Quantization(step=0.005, at="x"), saturated, E.Quantization(step=0.02, at="theta")
    )
    noise = (1e-3, 2e-3)
    record = cid.simulate(loop, d=np.full(300, 0.05), sensor_noise=noise, initial=START, seed=1)
    assert set(np.round(record.y[0], 9)) <= {-0.011, -0.01, -0.005, 0.0, 0.005, 0.01, 0.011}
    assert {-0.011, 0.011} & set(np.round(record.y[0], 9))
    np.testing.assert_allclose(np.round(record.y[1] / 0.02), record.y[1] / 0.02, atol=1e-9)
    assert len(np.unique(record.y[1])) > 2


def test_a_force_without_a_known_input_accelerates_one_coordinate():
    loop = cart(E.ConstantForce(bias=1.0, at="theta_dot"), forces={})
    rates = loop.equations().evaluate(np.zeros(4), 0.0)[0]
    np.testing.assert_allclose(rates, [0, 0, 0, 1], atol=1e-12)
    known = cart(E.ConstantForce(bias=1.0, at="theta_dot"))
    rates = known.equations().evaluate(np.zeros(4), 0.0)[0]
    assert rates[2] != 0


def test_sizes_are_in_the_unit_of_what_works_there():
    units = {
        "x_dot": (E.CoulombFriction(fc=0.2, at="x_dot"), "fc = 0.2 N", cart()),
        "theta_dot": (E.ViscousFriction(c=0.1, at="theta_dot"), "c = 0.1 N m s/rad", cart()),
        "alone": (E.CoulombFriction(fc=0.2, at="theta_dot"), "fc = 0.2 rad/s^2", cart(forces={})),
        "F": (E.InputOffset(offset=0.3, at="F"), "offset = 0.3 N", cart()),
        "theta": (E.SensorOffset(offset=0.01, at="theta"), "offset = 0.01 rad", cart()),
    }
    for effect, text, loop in units.values():
        assert effect.text(loop).endswith(text)
    placed = E.CoulombFriction(fc=0.2, at="x_dot")
    # A plant of your own has its units from the loop; a position without one is no reason to err.
    plant = ct.nlsys(lambda t, x, u, p: [x[2], x[3], u[0], u[1]], lambda t, x, u, p: x[:2],
                     inputs=["F", "Q"], outputs=["x1", "x2"], states=["x1", "x2", "v1", "v2"],
                     name="own")  # fmt: skip
    own = {"forces": {"v1": "F", "v2": "Q"}, "dt": 0.01}
    known = cid.Loop(plant, units={"F": "N", "x1": "m"}, **own)
    assert E.CoulombFriction(fc=0.8, at="v1").text(known).endswith("fc = 0.8 N")
    assert E.ViscousFriction(c=0.8, at="v1").text(known).endswith("c = 0.8 N s/m")
    half = cid.Loop(plant, units={"F": "N"}, **own)
    assert E.CoulombFriction(fc=0.8, at="v1").text(half).endswith("fc = 0.8 N")
    assert E.ViscousFriction(c=0.8, at="v1").text(half).endswith("c = 0.8 N s/[y]")
    assert str(placed).startswith("CoulombFriction at x_dot: fc = 0.2")


def test_friction_of_the_cart_is_fitted():
    C = lqr_with_observer(CART)
    loop = cid.Loop(CART, C, dt=DT, at=at_rest(CART), free=("length",))
    real = loop.with_effect(E.CoulombFriction(fc=0.3, at="x_dot"))
    d = 1.0 * cid.random_binary(2000, amplitude=1, hold=50, seed=1)
    record = cid.simulate(real, d=d, sensor_noise=(1e-4, 5e-4), seed=2)
    given = loop.with_effect(E.CoulombFriction(fc=0.05, at="x_dot"))
    estimate = cid.fit_loop(given.with_parameters({"length": 0.28}), record).estimate
    for name, value in (("CoulombFriction.fc", 0.3), ("length", 0.3)):
        low, high = estimate.confidence_interval(name, 0.999)
        assert low < value < high


def test_the_linear_model_has_the_effects():
    loop = cart(E.ViscousFriction(c=0.7, at="x_dot"))
    plain = cid.plants.cart_pole(**{**CART.params, "c": CART.params["c"] + 0.7})
    np.testing.assert_allclose(
        loop.linearize().A, cid.linearize(plain, at_rest(plain)).A, atol=1e-9
    )
    rough = cart(E.CoulombFriction(fc=0.3, at="x_dot")).linearize()
    np.testing.assert_allclose(rough.A, cart().linearize().A, atol=1e-9)


def test_one_place_needs_no_name_and_takes_it():
    r = cid.random_binary(200, amplitude=0.1, hold=20, seed=1)
    for effect in (E.CoulombFriction, E.InputDeadZone, E.SensorGain):
        name = effect.parameters()[0].name
        at = {"force": "v", "input": "V", "output": "x"}[effect.place]
        runs = [cid.simulate(drive().with_effect(effect(**{name: 0.05}, at=where)), r)
                for where in ("", at)]  # fmt: skip
        np.testing.assert_array_equal(runs[0].y, runs[1].y)


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: cart(E.CoulombFriction(fc=0.1)),
         "acts at a velocity, and cart_pole has several: say which with at=, one of x_dot, theta_"),
        (lambda: cart(E.SensorGain(error=0.1)), "an output, and cart_pole has several"),
        (lambda: cart(E.CoulombFriction(fc=0.1, at="x")), "given at='x', but cart_pole has x_dot"),
        (lambda: cart(E.InputOffset(offset=0.1, at="V")), "an input; given at='V'"),
        (lambda: drive().with_effect(E.InputOffset(offset=0.1, at="G")), "servo has V"),
        (lambda: cart(E.Quantization(step=0.1)), "say which with at=, one of x, theta"),
        (lambda: cid.Loop(QUAD, dt=DT).with_effect(E.InputBacklash(width=0.1, at="F1")),
         "remembers the one input of a plant; quadrotor_planar has F1, F2"),
    ],
)  # fmt: skip
def test_refused_places(build, words):
    with pytest.raises(cid.CtrlidError, match=words):
        build()


@pytest.mark.parametrize("passed", [False, True])
def test_where_something_is_left_a_mechanism_is_told_of_its_forces(passed):
    bare = cart(plant=written_out())
    search = SimpleNamespace(after=SimpleNamespace(passed=passed))
    told = [note for note in _list_notes(bare, search) if "without forces=" in note]
    assert bool(told) == (not passed)
    assert not any("without forces=" in note for note in _list_notes(cart(), search))
    assert all("mass matrix" in note for note in told)


def test_a_loop_says_that_it_does_not_know_the_forces_of_its_mechanism():
    """That a diagnosis needs them was its last line, after minutes."""
    bare = cart(plant=written_out())
    assert "forces={'x_dot': 'F'}" in str(bare)
    assert str(bare).count("forces=") == 2
    assert "forces=" not in write_loop(bare)
    assert "forces=" not in str(cart())
    known = cid.Loop(bare.plant, dt=DT, forces={"x_dot": "F"})
    assert "forces=" not in str(known)
    # Of a chain of integrators just one state is pushed.
    chain = ct.nlsys(lambda t, x, u, p: [x[1], x[2], u[0]], lambda t, x, u, p: x[0],
                     inputs=["u"], outputs=["y"], states=["a", "b", "c"], name="chain")  # fmt: skip
    assert "forces=" not in str(cid.Loop(chain, dt=DT))


def test_a_mechanism_seen_by_one_output_has_its_forces_at_each_velocity():
    one = ct.nlsys(
        lambda t, x, u, p: [x[2], x[3], 2 * u[0] - x[1], 30 * x[1] - 5 * u[0]],
        lambda t, x, u, p: x[0], inputs=["F"], outputs=["x"], states=CART.state_labels, name="cart",
    )  # fmt: skip
    bare = cid.Loop(one, dt=DT)
    record = cid.Record(u=np.zeros(50), y=np.zeros(50), dt=DT)
    assert [e.at for e in list_candidates([E.ViscousFriction], bare, record)] == [""]
    assert suppose_force(bare.equations(), bare.point) == ("x_dot", "F")
    known = replace(bare, forces={"x_dot": "F"})
    assert suppose_force(known.equations(), known.point) is None
    found = list_candidates([E.ViscousFriction, E.InputOffset], known, record)
    assert [(type(e).__name__, e.at) for e in found] == [
        ("ViscousFriction", "x_dot"), ("ViscousFriction", "theta_dot"), ("InputOffset", "")
    ]  # fmt: skip
    # The unit of each random force is told.
    assert len(find_noise_units(known, record)[1]) == 2
    # Two masses on a spring: the force accelerates its own mass alone, as a friction there does.
    chain = ct.nlsys(
        lambda t, x, u, p: [x[1], u[0] - 30 * (x[0] - x[2]), x[3], 30 * (x[0] - x[2])],
        lambda t, x, u, p: x[0], inputs=["F"], outputs=["a"],
        states=["a", "a_dot", "b", "b_dot"], name="chain",
    )  # fmt: skip
    two = cid.Loop(chain, dt=DT)
    assert suppose_force(two.equations(), two.point) is None
    # A torque that accelerates both its own way may be the force at either.
    both = ct.nlsys(
        lambda t, x, u, p: [x[1], 2 * u[0], x[3], u[0]], lambda t, x, u, p: x[0],
        inputs=["F"], outputs=["a"], states=["a", "a_dot", "b", "b_dot"], name="both",
    )  # fmt: skip
    either = cid.Loop(both, dt=DT)
    assert suppose_force(either.equations(), either.point) is None


def test_dry_friction_of_a_cart_is_named_at_the_cart_by_its_position_alone():
    """The rig is simulated here: a cart of 0.5 kg, 20 mN of friction, a pole, state feedback.

    Friction that did not push the pole was named beside a saturating gain and a dead zone.
    """
    heavy, light, length, g, dt = 0.5, 0.2, 0.3, 9.81, 0.005
    rng = np.random.default_rng(3)
    gains = np.array([-4.47, -4.77, -31.7, -5.67])
    x, steps = np.zeros(4), 20
    n = 1200
    r = np.repeat(rng.choice([-0.15, 0.15], n // 100 + 1), 100)[:n]
    u, y = np.zeros(n), np.zeros(n)

    def move(state, force):
        _, v, th, om = state
        c, s = math.cos(th), math.sin(th)
        push = force - 0.02 * math.tanh(v / 2e-3)
        d = heavy + light * s * s
        a = (push + light * s * (length * om**2 - g * c)) / d
        b = ((heavy + light) * g * s - c * (push + light * length * om**2 * s)) / (length * d)
        return np.array([v, a, om, b])

    for k in range(n):
        y[k] = x[0] + 2e-4 * rng.standard_normal()
        u[k] = float(np.clip(-gains @ (x - [r[k], 0, 0, 0]), -15, 15))
        for _ in range(steps):
            h = dt / steps
            middle = x + h / 2 * move(x, u[k])
            x = x + h * move(middle, u[k])
    assert np.abs(x).max() < 1.0

    def rates(t, x, u, p):
        c, s = np.cos(x[2]), np.sin(x[2])
        d = p["M"] + light * s**2
        a = (u[0] + light * s * (length * x[3] ** 2 - g * c)) / d
        b = ((p["M"] + light) * g * s - c * (u[0] + light * length * x[3] ** 2 * s)) / (length * d)
        return [x[1], a, x[3], b]

    plant = ct.nlsys(rates, lambda t, x, u, p: x[0], inputs=["F"], outputs=["s"],
                     states=["s", "v", "th", "om"], params={"M": heavy}, name="cart")  # fmt: skip
    few = [E.CoulombFriction, E.ViscousFriction, E.InputSaturatingGain, E.InputDeadZone]
    found = cid.diagnose(cid.Loop(plant, dt=dt, free=("M",)), cid.Record(u=u, y=y, r=r, dt=dt),
                         catalogue=few, progress=False)  # fmt: skip
    assert found.verdict == "explained", str(found)
    assert [f.names for f in found.findings] == [("CoulombFriction at v",)]
    assert found.findings[0].effect.fc == pytest.approx(0.02, rel=0.05)
    assert any("F is taken for the force at v" in note for note in found.notes)
    assert found.gap.after < 1.5 * found.gap.floor


def hoist(sign):
    """Two masses, of which one is pulled by an input that may oppose its velocity."""
    return ct.nlsys(
        lambda t, x, u, p: np.array([x[2], x[3], u[0] - x[0] - p["c"] * x[2],
                                     sign * u[1] - x[1] - p["c"] * x[3]]),
        lambda t, x, u, p: x[:2], inputs=["Fx", "Fl"], outputs=["q", "l"],
        states=["q", "l", "qd", "ld"], params={"c": 1.0}, name="hoist",
    )  # fmt: skip


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_friction_brakes_where_an_input_opposes_its_velocity(sign):
    """A hoist pulls at a rope that it shortens: friction at its velocity brakes all the same."""
    poles = []
    for forces in (None, {"qd": "Fx", "ld": "Fl"}):
        loop = cid.Loop(hoist(sign), None, dt=0.05, forces=forces)
        loop = loop.with_effect(E.ViscousFriction(c=3.0, at="ld"))
        poles.append(np.sort_complex(loop.linearize(states=True).poles()))
    np.testing.assert_allclose(*poles, atol=1e-9)
    assert max(poles[1].real) < 0


def test_a_force_that_turns_with_the_state_works_along_its_velocity():
    """A rod that pulls on one side and pushes on the other: the friction brakes on both."""
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([x[2], x[3], u[0] - x[2], p["k"] * x[0] * u[1] - x[3]]),
        lambda t, x, u, p: x[:2], inputs=["F", "T"], outputs=["q", "w"],
        states=["q", "w", "qd", "wd"], params={"k": 2.0}, name="rod",
    )  # fmt: skip
    loop = cid.Loop(plant, None, dt=0.05, forces={"qd": "F", "wd": "T"})
    e = loop.with_effect(E.ViscousFriction(c=3.0, at="wd")).equations()
    for q in (0.5, -0.5):
        state = np.array([q, 0.0, 0.0, 1.0])
        rates = e.evaluate(state, np.zeros(2))[0]
        assert rates[3] == pytest.approx(-1.0 - 3.0 * abs(2.0 * q))


def test_levels_with_two_pumps_are_diagnosed():
    """Limits of a state are tried where several inputs drive it: scipy refused their matrices."""
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([u[0] - p["a"] * x[0], u[1] + x[0] - 2 * x[1]]),
        lambda t, x, u, p: x, inputs=["V1", "V2"], outputs=["h1", "h2"], states=["h1", "h2"],
        params={"a": 1.0}, name="levels",
    )  # fmt: skip
    rates = np.zeros((4, 4))
    rates[:2] = [[-1.1, 0, 1, 0], [1, -2, 0, 1]]
    step = linalg.expm(0.1 * rates)
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], (2, 50)), 20, axis=1)
    y, x = np.zeros((2, 1000)), np.zeros(2)
    for k in range(1000):
        y[:, k] = x
        x = step[:2] @ np.concatenate([x, u[:, k]])
    y += 0.01 * rng.standard_normal(y.shape)
    record = cid.Record(u=u, y=y, dt=0.1, names={"u": ("V1", "V2"), "y": ("h1", "h2")})
    loop = cid.Loop(plant, None, dt=0.1, free=("a",))
    kinds = (E.StateLimit, E.InputOffset)
    found = cid.diagnose(loop, record, catalogue=kinds, progress=False)
    assert found.verdict == "nothing missing"
    fitted = {c.name: c.after for c in found.calibrated}
    assert fitted["a"] == pytest.approx(1.1, abs=0.01)
    assert {c.effect.name for c in found.ranking if isinstance(c.effect, E.StateLimit)} == {
        "h1", "h2"}  # fmt: skip


@pytest.mark.parametrize("at", ["x_dot", "theta_dot"])
def test_a_mode_at_one_coordinate_moves_all_through_the_mass_matrix(at):
    """Held against the equations of motion with the small mass as a coordinate of its own."""
    rest = cid.Loop(CART, dt=DT, at=at_rest(CART))
    mode = E.FlexibleMode(frequency=3.0, damping=0.05, coupling=0.2, at=at)
    loop = rest.with_effect(mode)
    state, push, deflection, speed = np.array([0.1, 0.4, 0.2, -0.3]), 0.7, 0.01, 0.05
    j = ["x_dot", "theta_dot"].index(at)
    free = evaluate_rates(rest, state, push)[2:4]

    def accelerate(force, torque):
        return np.array(CART.mechanism.updfcn(0, state, [force, torque], CART.params))[2:4]

    inverse = np.column_stack(
        [accelerate(1, 0) - accelerate(0, 0), accelerate(0, 1) - accelerate(0, 0)]
    )
    mass = np.linalg.inv(inverse)
    small = 0.2 / inverse[j, j]
    omega = 2 * np.pi * 3.0
    w = omega * (omega * deflection + 2 * 0.05 * speed)
    # (M - m2 e e') q" = M a + m2 w e for the coordinates, d" = -w - q_j" for the deflection.
    left, right = mass.copy(), mass @ free
    left[j, j] -= small
    right[j] += small * w
    expected = np.linalg.solve(left, right)
    found = evaluate_rates(loop, np.array([*state, deflection, speed]), push)
    np.testing.assert_allclose(found[2:4], expected, rtol=1e-9)
    assert found[5] == pytest.approx(-w - expected[j], rel=1e-9)


@pytest.mark.parametrize(
    ("effect", "unit"),
    [
        (E.QuadraticDrag(c2=0.1, at="x_dot"), "N s^2/m^2"),
        (E.CubicStiffness(k3=2.0, at="x_dot"), "N/m^3"),
        (E.EddyCurrentDamping(ce=0.1, at="x_dot"), "N s/(m N^2)"),
        (E.CubicStiffness(k3=2.0, at="theta_dot"), "N m/rad^3"),
    ],
)
def test_a_size_counted_per_square_or_cube_is_one_of_a_force_as_well(effect, unit):
    loop = cart(effect)
    assert f" {unit}" in loop.effects[0].text(loop)


def test_a_unit_that_is_not_known_leaves_the_others_apart():
    plant = ct.nlsys(lambda t, x, u, p: [x[2], x[3], u[0], u[1]], lambda t, x, u, p: x[:2],
                     inputs=["F", "Q"], outputs=["x1", "x2"], states=["x1", "x2", "v1", "v2"],
                     name="own")  # fmt: skip
    known = cid.Loop(plant, units={"F": "", "x1": "m"}, forces={"v1": "F", "v2": "Q"}, dt=0.01)
    assert E.ViscousFriction(c=0.8, at="v1").text(known).endswith("c = 0.8 [F] s/m")
    assert E.QuadraticDrag(c2=0.8, at="v1").text(known).endswith("c2 = 0.8 [F] s^2/m^2")


def evaluate_rates(loop, x, u):
    e = loop.equations(keep=True)
    rates = casadi.Function("rates", [e.t, e.x, e.u, e.p], [e.rhs])
    return rates(0.0, x, u, list(e.parameters.values())).full()[:, 0]
