"""A parameter that the model calls exact is a suspect like any effect."""

from types import SimpleNamespace

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ctrlid as cid
from ctrlid import effects as E
from ctrlid.diagnosis.wording import describe_parameters, describe_size, write_headline

DT = 0.01
TRUE = {"m": 0.2, "l": 0.3, "c": 0.02}


def make_plant(**given):
    """Return a pendulum that stands on its head, written down by its user."""
    values = {**TRUE, "g": 9.81, **given}
    return ct.nlsys(
        lambda t, x, u, p: [x[1], p["g"] / p["l"] * np.sin(x[0])
                            + (u[0] - p["c"] * x[1]) / (p["m"] * p["l"] ** 2)],
        lambda t, x, u, p: x[0], inputs=["tau"], outputs=["theta"], states=["theta", "omega"],
        params=values, name="pendulum",
    )  # fmt: skip


def make_loop(free=(), **given):
    at = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
    law = ct.tf([3.0, -2.7], [1.0, -0.2], DT) * 1.5
    return cid.Loop(make_plant(**given), law, dt=DT, at=at, free=free)


def swing(seed, n=1500, friction=0.0, load=lambda t: 1.0, **true):
    """Return a record of the real pendulum, by scipy; its mass may change by a load."""
    p = {**TRUE, **true}
    rng = np.random.default_rng(seed)
    r = 0.15 * np.repeat(rng.choice([-1.0, 1.0], n // 50), 50)
    x, state, before, us, ys = np.zeros(2), 0.0, 0.0, [], []
    for k in range(n):
        y = x[0] + 1e-3 * rng.standard_normal()
        e = r[k] - y
        u = 1.5 * (3.0 * e - 2.7 * before) + 0.2 * state
        before, state = e, u
        us.append(u)
        ys.append(y)

        mass = p["m"] * load(k * DT)

        def rates(t, x, u=u, mass=mass):
            torque = u - p["c"] * x[1] - friction * np.tanh(x[1] / 1e-3)
            return [x[1], 9.81 / p["l"] * np.sin(x[0]) + torque / (mass * p["l"] ** 2)]

        x = solve_ivp(rates, (0, DT), x, rtol=1e-8, atol=1e-10).y[:, -1]
    return cid.Record(r=r, u=us, y=ys, dt=DT)


def test_it_changes_the_parameter_and_nothing_else():
    loop = make_loop()
    changed = loop.with_effect(E.ParameterError("l", error=0.1))
    expected = make_loop(l=0.33)
    r = 0.1 * np.sign(np.sin(np.arange(200) / 15))
    one, other = (cid.simulate(each, r) for each in (changed, expected))
    np.testing.assert_allclose(one.y, other.y, rtol=0, atol=1e-12)


def test_what_is_free_and_what_gravity_is_are_no_suspects():
    named = lambda loop: [e.name for e in E.ParameterError.candidates(loop)]  # noqa: E731
    assert named(make_loop()) == ["m", "l", "c"]
    assert named(make_loop(free=("m", "c"))) == ["l"]
    assert named(make_loop(g=9.5)) == ["m", "l", "c", "g"]
    assert named(make_loop(c=0.0)) == ["m", "l"]


def test_equivalents_are_other_parameters_and_effects_not_itself():
    plant = cid.plants.maglev(m=0.02, K=3e-6)
    loop = cid.Loop(plant, None, dt=1e-3, at=cid.operating_point(plant, output=0.01))
    assert E.equivalents(E.ParameterError("K", 0.03), loop) == ("parameter m",)
    assert E.equivalents(E.ParameterError("m", 0.03), loop) == ("parameter K",)
    assert E.equivalents(E.ConstantForce(0.1), loop)[-1] == "parameter g"
    assert "ConstantForce" in E.equivalents(E.ParameterError("g", 0.03), loop)


@pytest.fixture(scope="module")
def found():
    return cid.diagnose(make_loop(), swing(1, m=0.206), progress=False)


def test_a_wrong_mass_is_named_where_nothing_is_free(found):
    assert found.verdict == "explained"
    (finding,) = found.findings
    assert finding.names[0] == "parameter m"
    assert finding.effect.error == pytest.approx(0.03, abs=3 * finding.standard_errors["error"])
    assert finding.standard_errors["error"] < 3e-3
    assert found.gap.after < 1.1 * found.gap.floor < found.gap.before


def test_a_report_says_the_right_value_in_place_of_the_given_one(found):
    assert "The model lacks the right value of the parameter m" in write_headline(found)
    (finding,) = found.findings
    assert describe_size(found, finding).startswith("m = 0.20")
    assert describe_size(found, finding).endswith(" in place of 0.2")
    assert "name = m" not in str(found)
    assert finding.units == finding.effect.units(found.loop)


@pytest.mark.parametrize(
    ("given", "unit", "error", "spread", "words"),
    [
        (8750.0, "", 140.5, 4.8, "ER = 8890.5 ± 4.8 in place of 8750"),
        (8750.0, "", 140.5, None, "ER = 8.89e+03 in place of 8.75e+03"),
        (0.2, "kg", 0.006, 2e-4, "ER = 0.20600 ± 0.00020 kg in place of 0.2 kg"),
        (0.5, "", 0.25, 0.1, "ER = 0.75 ± 0.10 in place of 0.5"),
    ],
)
def test_a_value_and_the_one_it_replaces_have_the_same_digits(given, unit, error, spread, words):
    loop = SimpleNamespace(parameters={"ER": given}, known_units={"ER": unit})
    effect = E.ParameterError("ER", error=error / given)
    errors = None if spread is None else {"error": spread / given}
    assert describe_parameters(SimpleNamespace(loop=loop), effect, errors) == words


@pytest.mark.slow
def test_friction_beside_a_wrong_mass_keeps_its_name():
    found = cid.diagnose(make_loop(), swing(2, m=0.206, friction=0.02), progress=False)
    names = [f.names for f in found.findings]
    assert any("CoulombFriction" in n for n in names), names
    assert any("parameter m" in n for n in names), names


def test_nothing_is_named_where_all_is_right():
    found = cid.diagnose(make_loop(), swing(3), progress=False)
    assert found.verdict == "nothing missing", found


def test_a_parameter_is_wrong_by_a_factor_of_ten_at_most():
    bounds = {p.name: (p.lower, p.upper) for p in E.ParameterError("m", 0.0).parameters()}
    assert bounds["error"] == (-0.9, 9.0)
    with pytest.raises(cid.CtrlidError, match="error"):
        E.ParameterError("m", 200.0)


CHANGES = (E.ParameterDrift, E.ParameterStep)


@pytest.mark.parametrize(("load", "name", "size"), [
    (lambda t: 1 + 0.02 * t, "ParameterDrift", {"rate": 0.02}),
    (lambda t: 1.25 if t > 4 else 1.0, "ParameterStep", {"time": 4.0, "size": 0.25}),
])  # fmt: skip
def test_what_was_exact_at_first_may_change(load, name, size):
    """Three effects of free parameters were named together for a battery that ran down."""
    found = cid.diagnose(make_loop(("c",)), swing(5, n=900, load=load), progress=False,
                         catalogue=(*CHANGES, E.ViscousFriction, E.LinearStiffness))  # fmt: skip
    (finding,) = found.findings
    assert (finding.name, finding.effect.name) == (name, "m")
    for key, value in size.items():
        assert getattr(finding.effect, key) == pytest.approx(value, rel=0.05)


def test_the_same_change_of_another_parameter_is_asked():
    """A motor's gain and its inertia change its motion alike, but for its small damping."""
    plant = cid.plants.servo(m=0.5, c=0.02, k=3.0)
    loop = cid.Loop(plant, ct.tf([60.0, -57.0], [1.0, -0.3], DT), dt=DT, free=("k",))
    r = cid.random_binary(800, amplitude=0.1, hold=40, seed=3)
    real = loop.with_effect(E.ParameterStep("k", time=3.1, size=-0.2))
    record = cid.simulate(real, r, sensor_noise=5e-3, seed=4)
    found = cid.diagnose(loop, record, progress=False, catalogue=CHANGES)
    (finding,) = found.findings
    changed = {(type(e).__name__, e.name) for e in (finding.effect, *finding.alternatives)}
    assert {("ParameterStep", "k"), ("ParameterStep", "m")} <= changed
    assert "ParameterStep of" in found.sentence
    assert found.sentence.count("ParameterStep of") == 2
