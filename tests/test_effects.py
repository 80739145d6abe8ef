"""Every effect keeps the contract on every plant; a user's own effect does so too."""

import copy
import dataclasses
import math
import pickle
import re
from pathlib import Path

import control as ct
import numpy as np
import numpydoc.validate
import pytest

import ctrlid as cid
from ctrlid import effects
from ctrlid.effects import CATALOGUE
from problems import levitation, tank, tanks, under_lead

SAMPLES = 300


def levitated():
    return levitation(sampled=True), 2e-4


def driven():
    plant = cid.plants.servo(m=2.0, c=3.0, k=4.0)
    op = cid.operating_point(plant, output=0.1)
    return under_lead(plant, 0.01, op, crossover=20, sampled=True, free=("c", "k")), 0.02


def swinging():
    def update(t, x, u, params):
        theta, omega = x
        return np.array([omega, params["w"] ** 2 * np.sin(theta) + params["k"] * u[0]])

    plant = ct.nlsys(update, lambda t, x, u, params: x[0], name="own pendulum", inputs=["tau"],
                     outputs=["theta"], states=["theta", "omega"],
                     params={"w": 4.0, "k": 2.0})  # fmt: skip
    op = cid.operating_point(plant, output=0.2)
    return under_lead(plant, 0.01, op, crossover=15, sampled=True, free=("k",)), 0.05


def cascaded():
    gain = ct.tf([1.0], [1.0], 1.0)
    return tanks(gain, level=4.0, dt=1.0, free=("k4",), k1=0.2, k3=0.2, k4=0.1), 1.0


def single():
    return tank(ct.tf([20.0], [1.0], 2.0), dt=2.0), 0.05


PLANTS = {f.__name__: f() for f in (levitated, driven, swinging, cascaded, single)}
RECORDS = {}
MOVING = ("levitated", "driven", "swinging")


def excitation(name):
    loop, size = PLANTS[name]
    return cid.random_binary(SAMPLES, amplitude=size, hold=12, around=loop.at.output, seed=3)


def record_of(name):
    if name not in RECORDS:
        RECORDS[name] = cid.simulate(PLANTS[name][0], excitation(name))
    return RECORDS[name]


def scales(name):
    """Return typical sizes: of input and output swings, speed, acceleration, and dt."""
    record, dt = record_of(name), PLANTS[name][0].dt
    speed = np.gradient(record.y, dt)
    return {"U": float(np.ptp(record.u)), "Y": float(np.ptp(record.y)),
            "V": float(np.std(speed)), "A": float(np.std(np.gradient(speed, dt))),
            "u": float(np.abs(record.u).max()), "dt": dt}  # fmt: skip


VISIBLE = {
    "ActuatorLag": lambda s: {"tau": 0.5 * s["dt"]},
    "InputDelay": lambda s: {"delay": 0.7 * s["dt"]},
    "InputOffset": lambda s: {"offset": 0.03 * s["U"]},
    "InputNonlinearity": lambda s: {"curvature": 0.1 / s["U"]},
    "InputSaturatingGain": lambda s: {"saturation": 0.05 / s["u"] ** 2},
    "ViscousFriction": lambda s: {"c": 0.1 * s["A"] / s["V"]},
    "AsymmetricViscousFriction": lambda s: {"c": 0.1 * s["A"] / s["V"],
                                            "difference": 0.05 * s["A"] / s["V"]},
    "CoulombFriction": lambda s: {"fc": 0.1 * s["A"]},
    "AsymmetricCoulombFriction": lambda s: {"fc": 0.1 * s["A"], "difference": -0.02 * s["A"]},
    "StribeckFriction": lambda s: {"fs": 0.1 * s["A"], "vs": s["V"]},
    "QuadraticDrag": lambda s: {"c2": 0.1 * s["A"] / s["V"] ** 2},
    "EddyCurrentDamping": lambda s: {"ce": 0.1 * s["A"] / s["V"] / s["u"] ** 2},
    "LinearStiffness": lambda s: {"k1": 0.1 * s["A"] / s["Y"]},
    "CubicStiffness": lambda s: {"k3": 0.1 * s["A"] / s["Y"] ** 3},
    "ConstantForce": lambda s: {"bias": 0.05 * s["A"]},
    "PeriodicForce": lambda s: {"amplitude": 0.1 * s["A"], "frequency": 0.1 / s["dt"]},
    "PositionRipple": lambda s: {"amplitude": 0.1 * s["A"], "period": 0.3 * s["Y"]},
    "FlexibleMode": lambda s: {"frequency": 0.15 / s["dt"], "damping": 0.05, "coupling": 0.05},
    "PositionOffset": lambda s: {"offset": 0.3 * s["Y"]},
    "ForceExponent": lambda s: {"n": 2.2},
    "ParameterError": lambda s: {"error": 0.05},
    "ParameterDrift": lambda s: {"rate": 0.1 / (SAMPLES * s["dt"])},
    "ParameterStep": lambda s: {"size": 0.05},
    "SensorLag": lambda s: {"tau": 0.5 * s["dt"]},
    "SensorNonlinearity": lambda s: {"curvature": 0.1 / s["Y"]},
    "SensorOffset": lambda s: {"offset": 0.05 * s["Y"]},
    "SensorGain": lambda s: {"error": 0.05},
    "SensorDrift": lambda s: {"rate": 0.1 * s["Y"] / (SAMPLES * s["dt"])},
    "SensorHum": lambda s: {"amplitude": 0.05 * s["Y"], "frequency": 0.1 / s["dt"]},
    "Quantization": lambda s: {"step": 0.05 * s["Y"]},
}  # fmt: skip
PAIRS = [(cls, name) for cls in CATALOGUE for name in PLANTS]


def candidates(cls, name):
    return cls.candidates(PLANTS[name][0], record_of(name))


def neutral_of(effect):
    """The same effect at values that change nothing."""
    return dataclasses.replace(
        effect, **{p.name: p.neutral for p in effect.parameters() if p.neutral is not None}
    )


def visible(cls, name):
    """The candidates of a class, at sizes that one sees."""
    change = VISIBLE.get(cls.__name__, lambda s: {})(scales(name))
    return [dataclasses.replace(e, **change) for e in candidates(cls, name)]


def by_class_and_plant(pair):
    return pair.__name__ if isinstance(pair, type) else pair


@pytest.mark.parametrize(("cls", "name"), PAIRS, ids=by_class_and_plant)
def test_neutral_changes_not_one_sample(cls, name):
    loop, before = PLANTS[name][0], record_of(name)
    for effect in candidates(cls, name)[:1]:
        calm = loop.with_effect(neutral_of(effect))
        assert neutral_of(effect).neutral
        assert calm.point == loop.point
        after = cid.simulate(calm, excitation(name))
        assert np.array_equal(after.y, before.y)
        assert np.array_equal(after.u, before.u)


@pytest.mark.parametrize(("cls", "name"), PAIRS, ids=by_class_and_plant)
def test_away_from_neutral_it_changes_the_output_and_all_stays_finite(cls, name):
    loop, before = PLANTS[name][0], record_of(name)
    for effect in visible(cls, name):
        assert not effect.neutral, f"give {cls.__name__} a size in VISIBLE"
        after = cid.simulate(loop.with_effect(effect), excitation(name))
        assert np.isfinite([after.y, after.u]).all()
        assert np.max(np.abs(after.y - before.y)) > 1e-6 * np.ptp(before.y)


@pytest.mark.parametrize(("cls", "name"), PAIRS, ids=by_class_and_plant)
def test_parameters_reach_the_equations_with_their_labels(cls, name):
    loop = PLANTS[name][0]
    for effect in candidates(cls, name)[:1]:
        label = cls.__name__
        with_it = loop.with_effect(neutral_of(effect))
        kept = with_it.equations(keep=True)
        names = [f"{label}.{name}" for name in effect.values()]
        assert names
        assert list(kept.parameters)[-len(names) :] == names
        assert list(with_it.parameters) == list(kept.parameters)
        assert with_it.equations().parameters == loop.equations().parameters
        assert kept.p.shape[0] == len(kept.parameters)
        assert len(kept.states) == kept.x.shape[0] == kept.rhs.shape[0]
        assert len(kept.rest) == len(effect.states) == len(kept.states) - len(loop.point.states)
        # Both formulas agree, but for the rounding, where nothing has been added.
        point = np.array([*loop.point.states, *kept.rest])
        n = len(loop.point.states)
        rhs, y = kept.evaluate(point * 1.01 + 1e-3, loop.at.input * 1.1)
        rhs0, y0 = loop.equations().evaluate((point * 1.01 + 1e-3)[:n], loop.at.input * 1.1)
        if not effect.states:
            np.testing.assert_allclose(rhs[:n], rhs0, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(y, y0, rtol=1e-12)
        assert set(effect.units(loop)) == set(effect.values())
        assert not any("{" in unit for unit in effect.units(loop).values())


def test_every_effect_makes_sense_somewhere():
    for cls in CATALOGUE:
        assert any(candidates(cls, name) for name in PLANTS), cls


def test_forces_need_something_that_moves():
    for cls in CATALOGUE:
        for name in PLANTS:
            if issubclass(cls, effects.ForceEffect) and name not in MOVING:
                assert candidates(cls, name) == ()
    with pytest.raises(cid.CtrlidError, match="position and velocity as states"):
        PLANTS["single"][0].with_effect(effects.CoulombFriction(fc=1.0))


@pytest.mark.parametrize("cls", CATALOGUE)
def test_an_effect_is_a_value(cls):
    name = next(n for n in PLANTS if candidates(cls, n))
    effect = visible(cls, name)[0]
    assert pickle.loads(pickle.dumps(effect)) == effect
    assert copy.deepcopy(effect) == effect
    assert dataclasses.replace(effect) == effect
    assert hash(effect) == hash(dataclasses.replace(effect))
    first = effect.parameters()[0].name
    assert dataclasses.replace(effect, **{first: 0.99 * getattr(effect, first)}) != effect
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(effect, first, 1.0)
    text = str(effect)
    assert text.startswith(f"{cls.__name__}: ")
    assert all(f"{key} = " in text for key in effect.values())


@pytest.mark.parametrize("cls", CATALOGUE)
def test_an_effect_explains_itself(cls):
    known = {c.__name__ for c in CATALOGUE}
    assert cls.place in ("input", "force", "law", "output")
    assert cls.look_alikes
    assert set(cls.look_alikes) <= known - {cls.__name__}
    assert cls.sentence.endswith(".")
    assert cls.sentence.count(".") == 1
    assert len(cls.experiment) > 20
    assert set(cls.experiment_against) <= set(cls.look_alikes)
    assert ".. math::" in cls.__doc__
    assert ">>>" in cls.__doc__
    assert any(p.neutral is not None for p in cls.parameters())
    for p in cls.parameters():
        assert p.lower < p.upper
        assert f"{p.name} :" in cls.__doc__ or f"{p.name}, " in cls.__doc__ or (
            f", {p.name} :" in cls.__doc__)  # fmt: skip


@pytest.mark.parametrize("cls", CATALOGUE)
def test_wrong_values_are_refused(cls):
    name = next(n for n in PLANTS if candidates(cls, n))
    effect = candidates(cls, name)[0]
    for p in cls.parameters():
        for wrong in (math.nan, "0.1", None, True):
            with pytest.raises(cid.CtrlidError, match=p.name):
                dataclasses.replace(effect, **{p.name: wrong})
        if math.isfinite(p.lower):
            with pytest.raises(cid.CtrlidError, match="between"):
                dataclasses.replace(effect, **{p.name: p.lower - 1.0})
        if math.isfinite(p.upper):
            with pytest.raises(cid.CtrlidError, match="between"):
                dataclasses.replace(effect, **{p.name: p.upper + 1.0})


def test_further_refusals():
    for cls in (effects.InputSaturation, effects.SensorSaturation):
        with pytest.raises(cid.CtrlidError, match="lower < upper"):
            cls(lower=2.0, upper=1.0)
    with pytest.raises(cid.CtrlidError, match="finite"):
        effects.ViscousFriction(c=math.inf)
    loop = PLANTS["driven"][0]
    with pytest.raises(cid.CtrlidError, match="square"):
        loop.with_effect(effects.ForceExponent(n=3.0))
    with pytest.raises(cid.CtrlidError, match="does not depend on x"):
        loop.with_effect(effects.PositionOffset(offset=0.1))
    with pytest.raises(cid.CtrlidError, match=r"no numeric parameter 'R'.*'m', 'c', 'k'"):
        loop.with_effect(effects.ParameterDrift("R", rate=0.1))
    with pytest.raises(cid.CtrlidError, match="names the state 'h3'"):
        PLANTS["cascaded"][0].with_effect(effects.StateLimit("h3", upper=1.0))
    with pytest.raises(cid.CtrlidError, match="single InputBacklash"):
        loop.with_effect(effects.InputBacklash(1.0)).with_effect(effects.InputBacklash(1.0))
    sampled = cid.Loop(ct.tf([1.0], [1.0, -0.5], 0.1), dt=0.1)
    with pytest.raises(cid.CtrlidError, match="give the plant in continuous time"):
        sampled.with_effect(effects.SensorLag(tau=0.1))


@dataclasses.dataclass(frozen=True)
class MagneticPull(effects.ForceEffect):
    """A user's own effect: a permanent magnet at the end of the way."""

    strength: float = effects.parameter("{y}^3/s^2", lower=0.0, neutral=0.0)
    gap: float = effects.parameter("{y}", lower=1e-6, default=0.5)

    def force(self, m):
        return np.where(m.position < 10.0, self.strength / (self.gap + abs(m.position)) ** 2, 0.0)


@dataclasses.dataclass(frozen=True)
class SlowFilter(effects.OutputEffect):
    """A user's own effect with states: a filter of second order."""

    tau: float = effects.parameter("s", lower=1e-9, neutral=1e-9)
    states = ("y", "dy")

    def rates(self, m):
        y, dy = m.own["y"], m.own["dy"]
        return [dy, (m.y - y) / self.tau**2 - 2 * dy / self.tau]

    def rest(self, at):
        return (at.output, 0.0)

    def output(self, m):
        return m.own["y"]


def test_an_effect_of_ones_own():
    loop, _ = PLANTS["driven"]
    pull = MagneticPull(strength=0.05)
    assert str(pull) == "MagneticPull: strength = 0.05 [y]^3/s^2, gap = 0.5 [y]"
    assert pull.units(loop) == {"strength": "m^3/s^2", "gap": "m"}
    # The gap has no neutral value, and starts from its default.
    assert MagneticPull.candidates(loop) == (MagneticPull(strength=0.0, gap=0.5),)
    attracted = loop.with_effect(pull)
    e, x = attracted.equations(), np.array([0.3, 0.2])
    assert e.evaluate(x, 1.0)[0][1] == pytest.approx((4.0 * 1.0 - 3.0 * 0.2) / 2 + 0.05 / 0.64)
    assert np.isfinite(cid.simulate(attracted, excitation("driven")).y).all()
    calm = loop.with_effect(MagneticPull(strength=0.0))
    assert np.array_equal(cid.simulate(calm, excitation("driven")).y, record_of("driven").y)


def test_an_effect_of_ones_own_with_states():
    loop = cid.Loop(ct.tf([2.0], [1.0, 3.0]), None, dt=0.1)
    G = loop.with_effect(SlowFilter(tau=0.2)).linearize()
    expected = ct.tf([2.0], [1.0, 3.0]) * ct.tf([1.0], [0.04, 0.4, 1.0])
    assert G(3j) == pytest.approx(expected(3j))
    start = SlowFilter.candidates(loop)
    assert start == (SlowFilter(tau=1e-9),)
    with pytest.raises(cid.CtrlidError, match="unknown_state"):
        loop.with_effect(Wrong(size=1.0))


@dataclasses.dataclass(frozen=True)
class Wrong(effects.LawEffect):
    """Changes what is not there."""

    size: float = effects.parameter("", neutral=0.0)

    def law(self, m):
        return {"unknown_state": self.size}


def test_the_catalogue_is_explicit_and_public():
    assert len(set(CATALOGUE)) == len(CATALOGUE)
    for cls in CATALOGUE:
        assert getattr(effects, cls.__name__) is cls
        assert cls.__name__ in effects.__all__


def test_the_pages_count_the_effects():
    root, count = Path(__file__).parents[1], len(CATALOGUE)
    readme = (root / "README.md").read_text(encoding="utf-8")
    assert f"`diagnose`: {count} `effects`" in readme
    measured = (root / "docs" / "measured.rst").read_text(encoding="utf-8")
    assert f"one or several of {count} ``effects``" in measured


def test_the_manual_has_every_effect():
    page = (Path(__file__).parents[1] / "docs" / "effects.rst").read_text(encoding="utf-8")
    rows = dict(re.findall(r"\* - `~ctrlid\.effects\.(\w+)`\n((?:     - .*\n)+)", page))
    assert list(rows) == [cls.__name__ for cls in CATALOGUE]
    for cls in CATALOGUE:
        equation, parameters, alike, experiment = re.findall(r"- (.*)", rows[cls.__name__])
        assert " ".join(equation.split("`")[1].split()) in " ".join(cls.__doc__.split())
        assert re.findall(r"``(\w+)``", parameters) == [p.name for p in cls.parameters()]
        assert alike.split(", ") == list(cls.look_alikes)
        assert experiment == cls.experiment
    for name in effects.__all__:
        assert re.search(rf"^   {name}$", page, re.M) or name == "CATALOGUE"


@pytest.mark.parametrize("name", [n for n in effects.__all__ if n != "CATALOGUE"])
def test_docstrings(name):
    checks = {"GL01", "GL02", "GL03", "GL08", "SS03", "PR01", "PR02", "PR03", "RT01"}
    found = numpydoc.validate.validate(f"ctrlid.effects.{name}")["errors"]
    if name in ("Parameter", "Moment"):  # nobody makes one by hand
        found = [e for e in found if e[0] != "PR01"]
    # Where an effect acts is told in the docstring of the class of all of them.
    found = [e for e in found if e[1] != "Parameters {'at'} not documented"]
    assert [e for e in found if e[0] in checks] == []
