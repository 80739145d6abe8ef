"""A loop with effects: its interface, and each effect against a closed form or formula."""

import inspect
import math
from dataclasses import dataclass, replace
from functools import partial

import control as ct
import numpy as np
import pytest
from scipy import integrate, special

import ctrlid as cid
from ctrlid import effects as E
from ctrlid.physics.trace import trace
from problems import first_state, levitation, mass


def integrator():
    return ct.nlsys(lambda t, x, u, params: np.array([u[0]]), first_state, name="tub", inputs=["u"],
                    outputs=["x"], states=["x"])  # fmt: skip


levitated = partial(levitation, sampled=True, free=())


def free_run(plant, *effects, u, dt=0.01, initial=None):
    """Output of an open loop whose input is `u`."""
    loop = cid.Loop(plant, None, dt=dt)
    for effect in effects:
        loop = loop.with_effect(effect)
    return cid.simulate(loop, d=u, initial=initial).y


# The interface


def test_a_loop_takes_and_gives_back_effects():
    loop = levitated(free="K")
    rubbing = loop.with_effect(E.ViscousFriction(c=1.0)).with_effect(E.ViscousFriction(c=2.0))
    assert loop.effects == ()
    assert list(rubbing.labelled) == ["ViscousFriction", "ViscousFriction2"]
    assert rubbing.parameters == {"m": 0.0213, "K": 3.34e-6, "g": 9.81, "ViscousFriction.c": 1.0,
                                  "ViscousFriction2.c": 2.0}  # fmt: skip
    assert "effects: ViscousFriction, ViscousFriction2)" in repr(rubbing)
    assert rubbing.without_effect("ViscousFriction2").effects == (E.ViscousFriction(1.0),)
    assert rubbing.without_effect(E.ViscousFriction(2.0)).effects == (E.ViscousFriction(1.0),)
    assert rubbing.without_effect("ViscousFriction").effects == (E.ViscousFriction(2.0),)
    with pytest.raises(cid.CtrlidError, match="no effect CoulombFriction; it has "):
        rubbing.without_effect("CoulombFriction")
    with pytest.raises(cid.CtrlidError, match="instances of the classes"):
        loop.with_effect(E.ViscousFriction)
    same = cid.Loop(loop.plant, loop.controller, dt=loop.dt, at=loop.at, free=("K",),
                    effects=rubbing.effects)  # fmt: skip
    assert same.parameters == rubbing.parameters


def test_effect_parameters_can_be_free():
    loop = levitated(effects=(E.CoulombFriction(fc=0.0),), free=("K", "CoulombFriction.fc"))
    assert loop.free == ("K", "CoulombFriction.fc")
    assert loop.without_effect("CoulombFriction").free == ("K",)
    with pytest.raises(cid.CtrlidError, match=r"free= names \['CoulombFriction.mu'\]"):
        levitated(effects=(E.CoulombFriction(fc=0.0),), free=("CoulombFriction.mu",))


def test_other_parameters_are_another_loop():
    loop = levitated(effects=(E.ViscousFriction(c=1.0), E.ActuatorLag(tau=0.001)))
    other = loop.with_parameters({"K": 3e-6, "ViscousFriction.c": 0.2})
    assert other.parameters == {**loop.parameters, "K": 3e-6, "ViscousFriction.c": 0.2}
    assert other.equations().parameters == other.parameters
    assert other.effects == (E.ViscousFriction(c=0.2), E.ActuatorLag(tau=0.001))
    assert loop.plant.params["K"] == 3.34e-6
    assert other.plant.params == {"m": 0.0213, "K": 3e-6, "g": 9.81}
    afresh = cid.Loop(cid.plants.maglev(m=0.0213, K=3e-6), loop.controller, dt=0.002, at=loop.at,
                      effects=other.effects)  # fmt: skip
    r = cid.random_binary(200, amplitude=1e-4, hold=10, around=0.012, seed=1)
    assert np.array_equal(cid.simulate(other, r).y, cid.simulate(afresh, r).y)
    with pytest.raises(cid.CtrlidError, match="no parameter 'R'; it has"):
        loop.with_parameters({"R": 1.0})
    with pytest.raises(cid.CtrlidError, match="c between 0 and inf"):
        loop.with_parameters({"ViscousFriction.c": -1.0})
    with pytest.raises(cid.CtrlidError, match="finite"):
        loop.with_parameters({"K": math.nan})


@pytest.mark.parametrize("lag", [0.0, 3.0])
@pytest.mark.parametrize(("upper", "runs_over"), [(0.9, False), (0.81, False), (0.75, True)])
def test_a_limit_of_a_state_is_linearized_where_the_point_is(upper, runs_over, lag):
    """Half of the overflow was in the model wherever the tank stood: a pole at -2 in place of 0."""
    dt, plant = 1.0, cid.plants.tank(area=0.0147, outlet=7.7e-5, k=5.9e-5)
    at = cid.operating_point(plant, output=0.8)
    loop = cid.Loop(plant, None, dt=dt, at=at).with_effect(E.StateLimit("h", upper=upper))
    if lag:
        loop = loop.with_effect(E.ActuatorLag(tau=lag))
    G = loop.linearize(states=True)
    assert (G.A[0, 0] < -1) == runs_over
    rest = cid.operating_point(loop.system(), output=0.8)
    d, n = 1e-5 * rest.input, 50

    def run(step):
        given = np.full(n, rest.input - at.input + step)
        return cid.simulate(loop, d=given, initial=rest.states).y

    moved = (run(d) - run(-d)) / (2 * d)
    linear = ct.forced_response(G, np.arange(n) * dt, np.ones(n)).outputs
    np.testing.assert_allclose(moved, linear, rtol=2e-3, atol=1e-4 * np.max(np.abs(linear)))


@pytest.mark.parametrize(
    ("values", "named", "words"),
    [
        ({"J": 1.0}, {}, r"the loop has no parameter 'J'; it has m, K, g, CoulombFriction.fc$"),
        (None, {"J": 1.0}, r"the loop has no parameter 'J'; it has m, K, g, CoulombFriction.fc$"),
        (None, {"k": 1.0}, "no parameter 'k'; .*; did you mean K\\?"),
        ({"fc": 1.0}, {}, "no parameter 'fc'; .*; did you mean CoulombFriction.fc\\?"),
        (None, {"K": "3e-6"}, "with_parameters needs a number as K; given '3e-6'"),
        (None, {"K": [1.0, 2.0]}, r"with_parameters needs a number as K; given \[1.0, 2.0\]"),
        ({"K": np.ones(2)}, {}, "needs a mapping of a text to a number or None as values"),
        ("K", {}, "needs a mapping of a text to a number or None as values; given 'K'"),
    ],
)
def test_a_loop_knows_which_parameter_was_meant(values, named, words):
    loop = levitated(effects=(E.CoulombFriction(fc=0.1),))
    with pytest.raises(cid.CtrlidError, match=words):
        loop.with_parameters(values, **named)


def test_parameters_are_named_by_keyword_too():
    loop = levitated(effects=(E.CoulombFriction(fc=0.1),))
    both = loop.with_parameters({"CoulombFriction.fc": 0.2}, K=3e-6)
    assert both.parameters == {**loop.parameters, "K": 3e-6, "CoulombFriction.fc": 0.2}
    assert loop.with_parameters().parameters == loop.parameters


def test_an_unknown_field_of_a_loop_is_refused_in_words():
    loop = levitated()
    with pytest.raises(cid.CtrlidError, match="Loop has no unit=; did you mean units="):
        replace(loop, unit={})
    with pytest.raises(cid.CtrlidError, match=r"Loop has no K=; it takes plant, .*, sharpness$"):
        cid.Loop(loop.plant, dt=0.01, at=loop.at, K=1.0)
    assert list(inspect.signature(cid.Loop).parameters)[:3] == ["plant", "controller", "dt"]
    with pytest.raises(cid.CtrlidError, match=r"no effect Coulomb; it has .*mean CoulombFriction"):
        loop.with_effect(E.CoulombFriction(fc=0.1)).without_effect("Coulomb")


def test_parameters_of_an_interconnection():
    drive = ct.nlsys(lambda t, x, u, params: -x / params["T"] + u / params["T"], first_state,
                     name="drive", inputs=["e"], outputs=["f"], states=["f"],
                     params={"T": 0.1})  # fmt: skip
    cart = ct.nlsys(lambda t, x, u, params: np.array([x[1], u[0] / params["m"]]), first_state,
                    name="cart", inputs=["f"], outputs=["x"], states=["x", "v"],
                    params={"m": 2.0})  # fmt: skip
    both = ct.interconnect([drive, cart], inputs=["e"], outputs=["x"], name="both",
                           params={"T": 0.1, "m": 2.0})  # fmt: skip
    loop = cid.Loop(both, None, dt=0.01).with_effect(E.ViscousFriction(c=0.5))
    heavy = loop.with_parameters({"m": 4.0})
    assert heavy.linearize()(2j) == pytest.approx(1 / (1 + 0.2j) / 4 / (2j * (2j + 0.5)))
    assert loop.linearize()(2j) == pytest.approx(1 / (1 + 0.2j) / 2 / (2j * (2j + 0.5)))


def test_transfer_functions_have_their_coefficients_as_parameters():
    G = ct.tf([6.0], [2.0, 4.0, 0.0], name="G", inputs="V", outputs="x")
    at = cid.OperatingPoint((), 1.0, 5.0)
    loop = cid.Loop(G, None, dt=0.01, at=at, free=("a1", "b1"))
    assert loop.parameters == {"a1": 2.0, "a2": 0.0, "b1": 3.0}
    other = loop.with_parameters({"a1": 3.0})
    assert other.plant.den[0][0].tolist() == [1.0, 3.0, 0.0]
    assert (other.plant.name, other.plant.input_labels, other.plant.dt) == ("G", ["V"], 0)
    assert G.den[0][0].tolist() == [2.0, 4.0, 0.0]
    assert loop.linearize() is G
    # Output and its derivative are the states, so that forces know where to act.
    assert loop.equations().velocities == (1,)
    assert loop.with_effect(E.ViscousFriction(c=0.5)).linearize()(1j) == pytest.approx(
        3 / (1j * (1j + 2.5)))  # fmt: skip


@pytest.mark.parametrize(("num", "den", "dt"), [
    ([1.0, 2.0], [2.0, 3.0, 4.0], 0), ([5.0], [1.0, -3.0], 0), ([1.0], [1.0, 0.1, 2.0, 3.0], 0),
    ([0.2, 0.1], [1.0, -2.05, 1.0], 0.02), ([0.5], [1.0, -0.2, 0.3], 0.02),
    ([2.0, 1.0, 4.0], [1.0, 5.0, 6.0], 0), ([0.7], [1.0], 0.1),
])  # fmt: skip
def test_a_traced_transfer_function_is_the_transfer_function(num, den, dt):
    G = ct.tf(num, den, dt)
    e = trace(G)
    s = np.exp(0.7j) if dt else 0.7j
    assert cid.linearize(G, cid.OperatingPoint((0.0,) * len(e.states), 0.0, 0.0))(s) == (
        pytest.approx(G(s)))  # fmt: skip
    assert len(e.parameters) == len(den) - 1 + len(num)
    if dt and len(den) > 1:
        u = np.random.default_rng(1).standard_normal(30)
        y = cid.simulate(cid.Loop(G, None, dt=dt), d=u).y
        expected = ct.forced_response(G, np.arange(30) * dt, u).outputs
        np.testing.assert_allclose(y, expected, atol=1e-12)


def test_the_point_has_the_rest_of_the_effects_states():
    loop = levitated()
    full = loop.with_effect(E.SensorOffset(0.001)).with_effect(E.SensorLag(0.001))
    full = full.with_effect(E.ActuatorLag(0.001)).with_effect(E.InputOffset(0.5))
    e, point = full.equations(), full.point
    assert e.states == ("x", "v", "ActuatorLag.input", "SensorLag.reading")
    assert point.states == pytest.approx((0.012, 0.0, loop.at.input + 0.5, 0.013))
    assert (point.input, point.output) == (loop.at.input, loop.at.output)


def test_the_order_of_places_does_not_depend_on_the_order_of_effects():
    several = (E.EddyCurrentDamping(0.3), E.InputDelay(0.003), E.InputSaturation(2.0, 4.0),
               E.ForceExponent(2.2), E.SensorLag(0.001), E.PositionOffset(1e-4))  # fmt: skip
    r = cid.random_binary(300, amplitude=1e-4, hold=10, around=0.012, seed=1)
    one = cid.simulate(levitated(effects=several), r)
    two = cid.simulate(levitated(effects=several[::-1]), r)
    np.testing.assert_allclose(one.y, two.y, rtol=1e-9)


def test_of_a_curve_and_a_lag_the_one_given_last_is_furthest_from_the_plant():
    """A step u behind the lag tau has moved by u (1 - exp(-t / tau)), squared or not."""
    tau, c, dt, u = 0.02, 0.5, 0.01, 2.0
    plant = ct.nlsys(lambda t, x, u, p: u - 50.0 * x, outputs=["y"], inputs=["u"], states=["y"],
                     name="tank")  # fmt: skip
    loop = cid.Loop(plant, dt=dt, at=cid.OperatingPoint((0.0,), 0.0, 0.0))
    t = dt * np.arange(60)
    lagged = u * (1 - np.exp(-t / tau))
    effects = E.ActuatorLag(tau), E.InputNonlinearity(c)
    for order, reached in ((effects, (u + c * u**2) / u * lagged),
                           (effects[::-1], lagged + c * lagged**2)):  # fmt: skip
        changed = loop
        for effect in order:
            changed = changed.with_effect(effect)
        y = cid.simulate(changed, d=np.full(60, u)).y
        # The plant holds still where what reaches it, less 50 y, is the rate of y.
        rate = np.gradient(y, dt, edge_order=2)
        np.testing.assert_allclose(rate[3:-3] + 50 * y[3:-3], reached[3:-3], rtol=0.03)


def test_other_values_keep_the_formulas_and_nothing_else():
    # The offset moves where the lag rests, and the exponent looks at the numbers of the plant.
    effects = (E.ActuatorLag(tau=0.004), E.InputOffset(offset=0.1), E.SensorLag(tau=0.002),
               E.ForceExponent(n=2.1), E.CoulombFriction(fc=0.1))  # fmt: skip
    changed = {"K": 3e-6, "InputOffset.offset": 0.3, "ActuatorLag.tau": 0.01,
               "CoulombFriction.fc": 0.2}  # fmt: skip
    one = levitation(*effects)
    other = one.with_parameters(changed)
    anew = cid.Loop(other.plant, other.controller, other.dt, other.at, effects=other.effects)
    for keep in (True, False):
        e, known, fresh = (x.equations(keep=keep) for x in (one, other, anew))
        assert known.parameters == fresh.parameters != e.parameters
        assert known.rest == fresh.rest != e.rest
        assert known.velocities == fresh.velocities
        x = np.array([0.011, 0.02, *fresh.rest])
        for a, b in zip(known.evaluate(x, 3.1), fresh.evaluate(x, 3.1), strict=True):
            np.testing.assert_array_equal(a, b)
    plain = levitation().with_effect(E.CoulombFriction(fc=0.1))
    faster = plain.with_parameters({"K": 3e-6})
    assert plain.equations().function is faster.equations().function
    assert plain.point == faster.point == levitation().point


def test_an_effect_may_look_at_the_values_of_the_plant():
    class Scaled(E.ForceEffect):
        def build(self, e, m):
            return replace(e, rhs=e.rhs * e.parameters["k"])

    loop = cid.Loop(mass(k=3.0), dt=0.01, effects=(Scaled(),))
    for k in (3.0, 5.0, 3.0):
        rates, _ = loop.with_parameters({"k": k}).equations(keep=True).evaluate([1.0, 2.0], 4.0)
        np.testing.assert_allclose(rates, [2.0 * k, 4.0 * k])


def test_the_system_of_a_loop_is_a_plant_again():
    loop = levitated(effects=(E.ViscousFriction(2.0), E.ActuatorLag(0.004), E.SensorOffset(1e-4)))
    system = loop.system()
    assert isinstance(system, ct.NonlinearIOSystem)
    assert system.params == loop.parameters
    again = cid.Loop(system, loop.controller, dt=loop.dt, at=loop.point)
    r = cid.random_binary(300, amplitude=1e-4, hold=10, around=0.012, seed=1)
    np.testing.assert_allclose(cid.simulate(again, r).y, cid.simulate(loop, r).y, rtol=1e-8)
    assert again.with_parameters({"K": 3e-6}).equations().parameters["K"] == 3e-6
    # python-control integrates the same equations.
    op = cid.operating_point(system, output=0.012)
    t = np.linspace(0.0, 0.02, 201)
    response = ct.input_output_response(system, t, np.full(201, op.input * 1.01), list(op.states),
                                        solve_ivp_kwargs={"rtol": 1e-9, "atol": 1e-12})  # fmt: skip
    held = cid.simulate(
        cid.Loop(system, None, dt=1e-4, at=op), d=np.full(201, op.input * 0.01)
    )  # fmt: skip
    np.testing.assert_allclose(response.outputs, held.y, rtol=1e-7)
    assert levitated().system().name == "maglev"


def test_what_is_no_continuous_state_is_refused_or_approximated():
    loop = levitated()
    with pytest.raises(cid.CtrlidError, match="has a memory"):
        loop.with_effect(E.InputBacklash(0.1)).system()
    late = loop.with_effect(E.InputDelay(0.004))
    assert late.system().nstates == 4
    w = 50j
    num, den = ct.pade(0.004, 2)
    expected = loop.linearize()(w) * ct.tf(num, den)(w)
    assert late.linearize()(w) == pytest.approx(expected)
    rounded = loop.with_effect(E.Quantization(1e-3)).system()
    assert rounded.output(0.0, [0.0124, 0.0], [3.0])[0] == pytest.approx(0.012)
    sampled = cid.Loop(ct.tf([1.0], [1.0, -0.5], 0.1), None, dt=0.1).with_effect(E.InputDelay(0.1))
    with pytest.raises(cid.CtrlidError, match="discrete time"):
        sampled.system()


@pytest.mark.parametrize("effect", [
    E.ViscousFriction(2.0), E.EddyCurrentDamping(0.2), E.LinearStiffness(100.0),
    E.ConstantForce(-1.0), E.ForceExponent(2.6), E.PositionOffset(0.001), E.SensorOffset(0.001),
    E.SensorNonlinearity(3.0), E.InputOffset(0.3), E.InputSaturatingGain(0.02),
    E.InputNonlinearity(0.05), E.ActuatorLag(0.003), E.SensorLag(0.003), E.CubicStiffness(1e6),
    E.FlexibleMode(30.0, 0.02, 0.1),
])  # fmt: skip
def test_the_linear_model_is_the_derivative_at_the_equilibrium(effect):
    loop = levitated(effects=(effect,))
    system = loop.system()
    op = cid.operating_point(system, output=0.012)
    expected = ct.tf(ct.linearize(system, op.states, op.input, eps=1e-7))
    for w in (3j, 40j, 300j):
        assert loop.linearize()(w) == pytest.approx(expected(w), rel=2e-5)


@pytest.mark.parametrize("effect", [
    E.CoulombFriction(0.2), E.StribeckFriction(0.2, 0.01), E.InputDeadZone(0.1),
    E.InputBacklash(0.1), E.Quantization(1e-5), E.PeriodicForce(0.5, 50.0, 1.0),
    E.ParameterDrift("K", 0.1), E.ParameterStep("K", 1.0, 0.1), E.QuadraticDrag(2.0),
])  # fmt: skip
def test_what_does_not_show_in_small_motion_leaves_the_linear_model_alone(effect):
    loop = levitated()
    changed = loop.with_effect(effect).linearize()
    assert changed(40j) == pytest.approx(loop.linearize()(40j), rel=1e-9)


def test_a_loop_that_passes_its_input_through_is_refused_with_its_effect():
    class Leak(E.OutputEffect):
        def output(self, m):
            return m.y + 0.1 * m.u

    with pytest.raises(cid.CtrlidError, match="without delay"):
        levitated().with_effect(Leak())


# The physics of the input

DT = 0.01
TRIANGLE = np.concatenate(
    [np.linspace(0, 1, 50), np.linspace(1, -1, 100), np.linspace(-1, 0.5, 75)]
)


def applied(*effects, u=TRIANGLE):
    """The input that reaches the plant, from the slope of an integrator."""
    return np.diff(free_run(integrator(), *effects, u=u, dt=DT)) / DT


def test_actuator_lag_step():
    t = np.arange(100) * DT
    y = free_run(integrator(), E.ActuatorLag(tau=0.07), u=np.ones(100), dt=DT)
    np.testing.assert_allclose(y, t - 0.07 * (1 - np.exp(-t / 0.07)), atol=1e-12)
    short = free_run(integrator(), E.ActuatorLag(tau=1e-5), u=np.ones(100), dt=DT)
    np.testing.assert_allclose(short, np.where(t > 0, t - 1e-5, 0), atol=1e-8)


@pytest.mark.parametrize("delay", [0.01, 0.03, 0.005, 0.0275, 0.0101])
def test_input_delay(delay):
    u = np.random.default_rng(2).standard_normal(60)
    t = np.arange(60) * DT
    held = np.concatenate([[0.0], np.cumsum(u) * DT])  # the integral at the samples
    knots = np.concatenate([t, [60 * DT]])
    expected = np.where(t < delay, 0.0, np.interp(t - delay, knots, held))
    got = free_run(integrator(), E.InputDelay(delay), u=u, dt=DT)
    np.testing.assert_allclose(got, expected, atol=1e-12)


def test_two_delays_add_up():
    u = np.random.default_rng(2).standard_normal(60)
    two = free_run(integrator(), E.InputDelay(0.004), E.InputDelay(0.011), u=u, dt=DT)
    np.testing.assert_allclose(two, free_run(integrator(), E.InputDelay(0.015), u=u, dt=DT),
                               atol=1e-14)  # fmt: skip


def test_backlash_opens_a_loop():
    u, got, m = TRIANGLE, applied(E.InputBacklash(width=0.3)), 0.0
    for k in range(len(u) - 1):
        m = min(max(m, u[k] - 0.15), u[k] + 0.15)
        assert got[k] == pytest.approx(m, abs=1e-12)
    assert got[45] == pytest.approx(u[45] - 0.15)
    assert got[120] == pytest.approx(u[120] + 0.15)


def follow_with_play(u, width):
    """What a backlash that begins in the middle of its gap passes on."""
    out, m = np.empty(len(u)), u[0]
    for k, value in enumerate(u):
        out[k] = m = min(max(m, value - width / 2), value + width / 2)
    return out


def test_a_curve_is_ahead_of_a_backlash_or_behind_it_as_it_is_given():
    u = TRIANGLE[:-1]

    def bend(v):
        return np.clip(np.sign(v) * np.maximum(np.abs(v) - 0.2, 0) + 0.1, -0.5, 0.4)

    curves = E.InputSaturation(-0.5, 0.4), E.InputOffset(0.1), E.InputDeadZone(0.4)
    play = E.InputBacklash(width=0.3)
    np.testing.assert_allclose(applied(play, *curves), follow_with_play(bend(u), 0.3), atol=1e-12)
    np.testing.assert_allclose(applied(*curves, play), bend(follow_with_play(u, 0.3)), atol=1e-12)
    # The limits are behind it, and the others ahead.
    some = applied(curves[0], play, *curves[1:])
    ahead = np.sign(u) * np.maximum(np.abs(u) - 0.2, 0) + 0.1
    np.testing.assert_allclose(some, np.clip(follow_with_play(ahead, 0.3), -0.5, 0.4), atol=1e-12)


def test_a_lag_and_what_depends_on_time_stay_behind_a_backlash():
    u, play = TRIANGLE, E.InputBacklash(width=0.3)
    for effect in (E.ActuatorLag(tau=0.07), Wobble(0.2)):
        one, other = (free_run(integrator(), *pair, u=u, dt=DT)
                      for pair in ((effect, play), (play, effect)))  # fmt: skip
        np.testing.assert_array_equal(one, other)
    # A delay may be either way round: it bends nothing.
    late = E.InputDelay(delay=0.7 * DT)
    one = free_run(integrator(), late, play, E.InputDeadZone(0.4), u=u, dt=DT)
    other = free_run(integrator(), play, E.InputDeadZone(0.4), late, u=u, dt=DT)
    np.testing.assert_array_equal(one, other)


@dataclass(frozen=True)
class Wobble(E.InputEffect):
    """A gain that changes in time."""

    share: float = E.parameter("", neutral=0.0)

    def input(self, m):
        return m.u * (1 + self.share * np.sin(m.t))


def test_curves_of_the_input():
    u = TRIANGLE[:-1]
    for effect, expected in (
        (E.InputSaturation(-0.3, 0.6), np.clip(u, -0.3, 0.6)),
        (E.InputDeadZone(0.4), np.sign(u) * np.maximum(np.abs(u) - 0.2, 0)),
        (E.InputOffset(0.25), u + 0.25),
        (E.InputNonlinearity(0.2), u + 0.2 * u**2),
        (E.InputSaturatingGain(1 / 0.8**2), 0.8 * u / np.sqrt(0.8**2 + u**2)),
    ):
        np.testing.assert_allclose(applied(effect), expected, atol=1e-12)


# The physics of forces


def test_friction_stops_a_coasting_mass():
    t = np.arange(200) * DT
    y = free_run(mass(), E.CoulombFriction(fc=0.5), u=np.zeros(200), initial=(0.0, 0.6))
    stop = 0.6 / 0.5
    expected = np.where(t < stop, 0.6 * t - 0.25 * t**2, 0.36)
    np.testing.assert_allclose(y, expected, atol=1e-5)  # the jump is spread over a quarter sample
    v = free_run(mass(), E.ViscousFriction(c=2.0), u=np.zeros(200), initial=(0.0, 0.6))
    np.testing.assert_allclose(v, 0.3 * (1 - np.exp(-2 * t)), atol=1e-9)
    q = free_run(mass(), E.QuadraticDrag(c2=3.0), u=np.zeros(200), initial=(0.0, -0.6))
    np.testing.assert_allclose(q, -np.log(1 + 1.8 * t) / 3, atol=1e-9)


def test_sticking_friction_holds_against_a_smaller_force():
    held = free_run(mass(), E.CoulombFriction(fc=0.5), u=np.full(300, 0.3))
    assert np.max(np.abs(held)) < 1e-3
    moving = free_run(mass(), E.CoulombFriction(fc=0.5), u=np.full(300, 0.7))
    assert moving[-1] == pytest.approx(0.1 * 2.99**2, rel=0.01)


def slide(fc, push, dt, x=0.0, v=0.0):
    """The position of 1 kg under dry friction [N] and a force held over each period, exactly.

    Between stops the acceleration is constant, so that each part of the motion is a parabola.
    """
    shown = []
    for force in push:
        shown.append(x)
        left = dt
        while left > 0:
            if v == 0 and abs(force) <= fc:
                break
            along = np.sign(v) if v else np.sign(force)
            a = force - fc * along
            stops = -v / a if v * a < 0 else np.inf
            step = min(left, stops)
            x, v = x + v * step + a * step**2 / 2, 0.0 if stops <= left else v + a * step
            left -= step
    return np.array(shown)


@pytest.mark.parametrize(("effects", "push"), [
    ((E.CoulombFriction(2.0),), 1.9),
    ((E.CoulombFriction(2.0),), -1.0),
    ((E.AsymmetricCoulombFriction(2.0, 0.8),), 2.5),
    ((E.AsymmetricCoulombFriction(2.0, 0.8),), -1.0),
    ((E.CoulombFriction(1.5), E.StribeckFriction(0.5, 0.05)), 1.8),
])  # fmt: skip
def test_what_rests_is_held(effects, push):
    """A force below the friction of its direction moves nothing for a hundred samples."""
    dt = 0.01
    loop = cid.Loop(mass(), None, dt=dt)
    for effect in effects:
        loop = loop.with_effect(effect)
    y = cid.simulate(loop, d=np.full(100, push)).y
    # Without friction it would move by half a force times a second squared.
    assert abs(y[-1]) < 0.01 * abs(push) / 2


@pytest.mark.parametrize("seed", range(4))
def test_a_mass_sticks_and_slips_as_an_exact_solution_does(seed):
    rng = np.random.default_rng(seed)
    dt, fc = 0.01, 2.0
    push = np.repeat(rng.uniform(-3.5, 3.5, 100), 6)
    exact = slide(fc, push, dt)
    assert np.mean(np.diff(exact) == 0) > 0.2
    y = cid.simulate(cid.Loop(mass(), None, dt=dt).with_effect(E.CoulombFriction(fc)), d=push).y
    # A mass that crept by its friction's quarter of a sample was off by 3 mm and more.
    assert np.max(np.abs(y - exact)) < 0.002


def test_friction_of_an_exact_solution_is_fitted_without_a_random_force():
    """A large force and too large a friction are a maximum of the likelihood as well."""
    rng = np.random.default_rng(5)
    dt, fc, sigma = 0.01, 2.0, 2e-4
    push = np.repeat(rng.uniform(-3.5, 3.5, 100), 6)
    y = slide(fc, push, dt) + sigma * rng.standard_normal(len(push))
    loop = cid.Loop(mass(), None, dt=dt).with_effect(E.CoulombFriction(1.2 * fc))
    found = cid.fit_loop(loop, cid.Record(u=push, y=y, dt=dt)).estimate
    assert found.values[0] == pytest.approx(fc, rel=0.01)
    assert found.sensor_noise == pytest.approx((sigma,), rel=0.1)
    assert found.force_noise < 0.1 * fc


def creep(fc, v0, push, dt):
    """The position of 1 kg under a friction that never sticks, by an implicit solver."""
    shown, state = [], np.zeros(2)
    for force in push:
        shown.append(state[0])
        state = integrate.solve_ivp(
            lambda t, z, force=force: [z[1], force - fc * np.tanh(z[1] / v0)], (0, dt), state,
            method="Radau", rtol=1e-8, atol=1e-10,
        ).y[:, -1]  # fmt: skip
    return np.array(shown)


@pytest.mark.parametrize("v0", [1e-4, 3e-3, 0.05])
def test_friction_that_never_sticks_creeps_as_its_formula_does(v0):
    rng = np.random.default_rng(3)
    dt, fc = 0.01, 2.0
    push = np.repeat(rng.uniform(-5.0, 5.0, 30), 20)
    exact = creep(fc, v0, push, dt)
    assert np.ptp(exact) > 0.2
    loop = cid.Loop(mass(), None, dt=dt)
    y = cid.simulate(loop.with_effect(E.CoulombFriction(fc, creep=v0 / fc)), d=push).y
    assert np.max(np.abs(y - exact)) < 0.005
    sigma = 1e-3
    record = cid.Record(u=push, y=exact + sigma * rng.standard_normal(len(push)), dt=dt)
    started = loop.with_effect(E.CoulombFriction(0.7 * fc, creep=0.5 * v0 / fc + 0.002))
    found = cid.fit_loop(started, record).estimate
    error = np.maximum(found.standard_errors, [0.01, 1e-3])
    assert np.all(np.abs(found.values - [fc, v0 / fc]) < 3.5 * error)
    assert found.standard_errors[0] < 0.1 * fc


def test_a_time_of_creep_is_a_value_of_friction_only_where_there_is_one():
    stuck, creeping = E.CoulombFriction(0.2), E.CoulombFriction(0.2, creep=0.01)
    assert stuck.values() == {"fc": 0.2}
    assert "creep" not in str(stuck)
    assert "creep = 0.01 s" in str(creeping)
    assert list(cid.Loop(mass(), None, dt=0.01).with_effect(stuck).parameters)[-1].endswith("fc")
    with pytest.raises(cid.CtrlidError, match="creep"):
        E.CoulombFriction(0.2, creep=-1.0)


FORCES = [
    (E.AsymmetricViscousFriction(2.0, 0.5), lambda t, x, v, u: -2.0 * v - 0.5 * np.abs(v)),
    (E.AsymmetricCoulombFriction(0.2, 0.05),
     lambda t, x, v, u: -0.2 * special.erf(v / (math.sqrt(2) * 0.25 * 0.2 * DT))
     - 0.05 * (1 - np.exp(-0.5 * (v / (0.25 * 0.2 * DT)) ** 2))),
    (E.StribeckFriction(0.3, 0.1), lambda t, x, v, u: -0.3 * special.erf(
        v / (math.sqrt(2) * 0.25 * 0.3 * DT)) * np.exp(-(v / 0.1) ** 2)),
    (E.EddyCurrentDamping(0.7), lambda t, x, v, u: -0.7 * u**2 * v),
    (E.LinearStiffness(30.0), lambda t, x, v, u: -30.0 * (x - 0.2)),
    (E.CubicStiffness(500.0), lambda t, x, v, u: -500.0 * (x - 0.2) ** 3),
    (E.ConstantForce(-0.4), lambda t, x, v, u: -0.4),
    (E.PeriodicForce(0.4, 3.0, 0.5), lambda t, x, v, u: 0.4 * np.sin(6 * np.pi * t + 0.5)),
    (E.PositionRipple(0.4, 0.05, 1.0), lambda t, x, v, u: 0.4 * np.sin(40 * np.pi * x + 1.0)),
]  # fmt: skip


@pytest.mark.parametrize(("effect", "force"), FORCES, ids=[type(e).__name__ for e, _ in FORCES])
def test_forces_against_the_formula(effect, force):
    at = cid.OperatingPoint((0.2, 0.0), 0.0, 0.2)
    e = cid.Loop(mass(), None, dt=DT, at=at).with_effect(effect).equations()
    rng = np.random.default_rng(5)
    for _ in range(20):
        (x, v, u), t = rng.standard_normal(3) * 0.3, rng.uniform(0, 3)
        rhs, y = e.evaluate((x, v), u, t)
        assert rhs == pytest.approx([v, u + force(t, x, v, u)], rel=1e-9, abs=1e-12)
        assert y == pytest.approx([x])


def test_a_flexible_mode_has_its_notch_and_its_resonance():
    G = cid.Loop(mass(), None, dt=DT).with_effect(E.FlexibleMode(5.0, 0.01, 0.19)).linearize()
    notch, peak = G.zeros()[0], G.poles()[np.argmax(np.abs(G.poles()))]
    assert abs(notch) == pytest.approx(2 * np.pi * 5.0)
    assert abs(peak) == pytest.approx(2 * np.pi * 5.0 / math.sqrt(1 - 0.19))
    assert -notch.real / abs(notch) == pytest.approx(0.01)
    # Far below the resonance the two masses move as one.
    assert (G(0.01j) * (0.01j) ** 2).real == pytest.approx(1.0, rel=1e-4)
    # Two masses and a spring, written out: 0.81 and 0.19 of the whole.
    k, d = 0.19 * (2 * np.pi * 5) ** 2, 0.19 * 2 * 0.01 * 2 * np.pi * 5
    a = [[0, 0, 1, 0], [0, 0, 0, 1], [-k / 0.81, k / 0.81, -d / 0.81, d / 0.81],
         [k / 0.19, -k / 0.19, d / 0.19, -d / 0.19]]  # fmt: skip
    two = ct.ss(a, [[0], [0], [1 / 0.81], [0]], [[1, 0, 0, 0]], 0)
    assert G(7j) == pytest.approx(two(7j))


# The physics of the law


def test_exponent_and_offset_of_the_magnet():
    loop = levitated()
    g, x0 = 9.81, 0.012
    steep = loop.with_effect(E.ForceExponent(n=3.4)).linearize()
    assert steep.poles().real.max() == pytest.approx(math.sqrt(3.4 * g / x0))
    shifted = loop.with_effect(E.PositionOffset(offset=0.002)).linearize()
    assert shifted.poles().real.max() == pytest.approx(math.sqrt(2 * g / (x0 + 0.002)))
    e = loop.with_effect(E.PositionOffset(0.002)).equations()
    rhs, y = e.evaluate((0.011, 0.3), 3.1)
    assert rhs == pytest.approx([0.3, g - 3.34e-6 * 3.1**2 / 0.013**2 / 0.0213])
    assert y == pytest.approx([0.011])
    n = loop.with_effect(E.ForceExponent(3.0)).equations().evaluate((0.011, 0.3), 3.1)[0][1]
    assert n == pytest.approx(g - 3.34e-6 * 3.1**2 * 0.012 / 0.011**3 / 0.0213)


def test_parameters_drift_and_step():
    plant = mass(lambda t, x, u, params: np.array([x[1], params["k"] * u[0]]), k=2.0)
    e = cid.Loop(plant, None, dt=DT).with_effect(E.ParameterDrift("k", 0.1)).equations()
    assert e.evaluate((0.0, 0.0), 1.0, t=3.0)[0][1] == pytest.approx(2.0 * 1.3)
    e = cid.Loop(plant, None, dt=DT).with_effect(E.ParameterStep("k", 2.0, -0.25)).equations()
    for t, k in ((1.9, 2.0), (2.1, 1.5), (2.0, 1.75)):
        assert e.evaluate((0.0, 0.0), 1.0, t=t)[0][1] == pytest.approx(k)


def test_a_full_tank_runs_over():
    def update(t, x, u, params):
        return np.array([u[0] - 0.1 * x[0], 0.1 * x[0]])

    def level(t, x, u, params):
        return x[1]

    tanks = ct.nlsys(update, level, name="tanks", inputs=["q"], outputs=["h2"],
                     states=["h1", "h2"])  # fmt: skip
    spill = E.StateLimit("h1", upper=2.0, spill_to="h2", share=0.4)
    loop = cid.Loop(tanks, None, dt=DT).with_effect(spill)
    n = 1501
    above = ct.nlsys(update, first_state, name="tanks", inputs=["q"], outputs=["h1"],
                     states=["h1", "h2"])  # fmt: skip
    full = cid.Loop(above, None, dt=DT).with_effect(spill)
    h1, h2 = cid.simulate(full, d=np.ones(n)).y, cid.simulate(loop, d=np.ones(n)).y
    t = np.arange(n) * DT
    brim = -10 * math.log(0.8)  # 10 (1 - exp(-t/10)) = 2
    filling = t < brim - 0.01
    np.testing.assert_allclose(h1[filling], 10 * (1 - np.exp(-0.1 * t[filling])), atol=1e-6)
    assert h1[-1] == pytest.approx(2.0, abs=0.8 * DT / 4 * 1.01)  # the head over the rim
    # 0.2 flows on by the outlet, 0.4 of the 0.8 that run over arrives.
    assert (h2[-1] - h2[-501]) / 5 == pytest.approx(0.2 + 0.4 * 0.8, rel=1e-3)


# The physics of the output


def test_sensors():
    def through(*effects, **noise):
        loop = cid.Loop(integrator(), None, dt=DT)
        for effect in effects:
            loop = loop.with_effect(effect)
        return cid.simulate(loop, d=np.ones(300), seed=4, **noise).y

    t = np.arange(300) * DT
    np.testing.assert_allclose(through(E.SensorLag(0.2)), t - 0.2 * (1 - np.exp(-t / 0.2)),
                               atol=1e-9)  # fmt: skip
    np.testing.assert_allclose(through(E.SensorOffset(0.3)), t + 0.3)
    np.testing.assert_allclose(through(E.SensorNonlinearity(-0.1)), t - 0.1 * t**2)
    noisy = through(sensor_noise=0.1)
    np.testing.assert_allclose(through(E.SensorSaturation(0.5, 2.0), sensor_noise=0.1),
                               np.clip(noisy, 0.5, 2.0))  # fmt: skip
    np.testing.assert_allclose(through(E.Quantization(0.2), sensor_noise=0.1),
                               0.2 * np.round(noisy / 0.2))  # fmt: skip
    both = through(E.Quantization(0.2), E.SensorSaturation(0.5, 2.0), sensor_noise=0.1)
    np.testing.assert_allclose(both, np.clip(0.2 * np.round(noisy / 0.2), 0.5, 2.0))


# What a filter sees


@pytest.mark.parametrize(("v", "s"), [(0.0, 0.01), (0.02, 0.01), (-0.005, 0.02), (0.5, 0.0)])
def test_kinks_are_averaged_over_what_the_filter_does_not_know(v, s):
    draws = v + s * special.ndtri((np.arange(200_000) + 0.5) / 200_000)
    for effect, force in (
        (E.CoulombFriction(1e-6), -1e-6 * np.sign(draws)),
        (E.AsymmetricViscousFriction(0.0, 0.5), -0.5 * np.abs(draws)),
        (E.AsymmetricCoulombFriction(1e-9, 0.3), np.full(len(draws), -0.3 * (v != 0 or s > 0))),
    ):
        e = cid.Loop(mass(), None, dt=DT).with_effect(effect).equations()
        rhs, _ = e.smoothed(0.0, (0.0, v), 0.0, e.values, (0.0, s))
        assert float(rhs[1]) == pytest.approx(force.mean(), rel=1e-3, abs=1e-12)


def test_derivatives_at_neutral_are_finite():
    loop = levitated()
    for cls in E.CATALOGUE:
        for effect in cls.candidates(loop)[:1]:
            neutral = {p.name: p.neutral for p in cls.parameters() if p.neutral is not None}
            e = loop.with_effect(type(effect)(**{**vars(effect), **neutral})).equations(keep=True)
            if e.delay is None and e.memory is None and not effect.states:
                f = e.smoothed.jacobian()
                shape = [np.zeros(e.smoothed.size_out(k)) for k in range(2)]
                for v, s in ((0.0, 0.0), (0.01, 0.0), (0.0, 0.01)):
                    point = (0.012, v, *e.rest)
                    parts = f(0.0, point, 3.0, e.values, (s,) * len(point), *shape)
                    assert all(np.isfinite(np.asarray(part)).all() for part in parts), cls


# Equivalences


def test_equivalences_follow_from_the_equations():
    maglev, servo = levitated(), cid.Loop(cid.plants.servo(2.0, 1.0, 3.0), None, dt=0.01)
    unstable = cid.Loop(ct.tf([3.0], [1.0, 0.2, -4.0]), None, dt=0.01)
    assert E.equivalents(E.InputDelay(0.001), maglev) == ("delay of the output",)
    assert E.equivalents(E.PositionOffset(1e-3), maglev) == ("SensorOffset",)
    assert E.equivalents(E.SensorOffset(1e-3), maglev) == ("PositionOffset",)
    assert E.equivalents(E.ConstantForce(0.1), maglev) == ("parameter g",)
    assert E.equivalents(E.InputOffset(0.1), maglev) == ()
    assert E.equivalents(E.ActuatorLag(0.001), maglev) == ()
    assert E.equivalents(E.ActuatorLag(0.001), servo) == ("SensorLag",)
    assert E.equivalents(E.SensorLag(0.001), servo) == ("ActuatorLag",)
    assert E.equivalents(E.ConstantForce(0.1), servo) == ("InputOffset", "SensorDrift")
    assert E.equivalents(E.ViscousFriction(0.1), servo) == ("parameter c",)
    assert E.equivalents(E.SensorOffset(0.1), servo) == ("the initial position",)
    assert E.equivalents(E.SensorOffset(0.1), unstable) == (
        "ConstantForce", "InputOffset", "PositionOffset")  # fmt: skip
    for effect in (E.CoulombFriction(0.1), E.InputSaturation(-1, 1), E.Quantization(0.1)):
        assert E.equivalents(effect, servo) == ()
        assert E.equivalents(effect, servo.with_effect(effect)) == ()
    assert E.equivalents(E.AsymmetricCoulombFriction(0.1, 0.02), servo) == (
        "CoulombFriction with a constant force",)  # fmt: skip


def test_asymmetric_friction_is_friction_with_a_constant_force():
    servo = cid.Loop(cid.plants.servo(2.0, 1.0, 3.0), cid.PID(kp=20.0, kd=1.0), dt=0.01)
    r = 0.1 * np.sin(2 * np.pi * 0.5 * np.arange(2000) * 0.01)  # nowhere does it stick for long
    one = servo.with_effect(E.AsymmetricCoulombFriction(fc=0.4, difference=0.15))
    two = servo.with_effect(E.CoulombFriction(fc=0.4)).with_effect(E.ConstantForce(bias=-0.15))
    record = cid.simulate(one, r, sensor_noise=1e-4, seed=2)
    same = cid.simulate(two, r, sensor_noise=1e-4, seed=2)
    assert np.std(record.y - same.y) < 0.02 * np.std(record.y - r)
    # In the filter as well, which knows the velocity only nearly.
    errors = [cid.predict(loop, record).innovations for loop in (one, two)]
    assert np.std(errors[0]) == pytest.approx(np.std(errors[1]), rel=0.05)


def test_what_is_called_equivalent_gives_the_same_record():
    r = cid.random_binary(300, amplitude=1e-4, hold=10, around=0.012, seed=1)
    loop = levitated()
    shifted = loop.with_effect(E.PositionOffset(2e-4))
    seen = loop.with_effect(E.SensorOffset(-2e-4))
    x0, u0 = loop.at.output, loop.at.input
    one = cid.simulate(shifted, r, initial=(x0, 0.0))
    two = cid.simulate(seen, r, initial=(x0 + 2e-4, 0.0))
    np.testing.assert_allclose(one.y, two.y, rtol=1e-9)
    np.testing.assert_allclose(one.u - u0, two.u - u0, atol=1e-7)


def test_a_delay_of_very_many_samples_is_asked_about():
    """Whoever writes 2 may mean samples; a process with a long dead time is taken as it is."""
    loop = cid.Loop(integrator(), None, dt=0.005)
    with pytest.warns(cid.CtrlidWarning, match=r"400 sampling periods.* give delay=0\.01$") as told:
        late = loop.with_effect(E.InputDelay(delay=2))
    assert told[0].filename == __file__
    assert late.parameters["InputDelay.delay"] == 2.0
    with pytest.warns(cid.CtrlidWarning, match="in seconds") as told:
        cid.Loop(integrator(), None, dt=0.005, effects=(E.InputDelay(delay=2),))
    assert told[0].filename == __file__
    # A warning is an error here.
    loop.with_effect(E.InputDelay(delay=0.5))
