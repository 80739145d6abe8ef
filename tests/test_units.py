"""Units: where they come from, what they become in powers, and when a size is told in newtons."""

import math
import re
from dataclasses import replace

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import effects as E
from ctrlid._base.units import fill_unit, is_same_unit, is_unit
from ctrlid.estimation.likelihood.filter_data import find_noise_units
from ctrlid.loop.unit_check import find_unit_clashes
from problems import record_of as record_any

DT = 0.01


def turntable(units):
    """Return a loop around a disc on a motor, J w' = k u - c w, with an angle as output."""
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], (p["k"] * u[0] - p["c"] * x[1]) / p["J"]]),
        lambda t, x, u, p: x[0], inputs=["duty"], outputs=["angle"], states=["angle", "rate"],
        params={"J": 0.5, "c": 0.1, "k": 1.0}, name="disc",
    )  # fmt: skip
    return cid.Loop(plant, cid.PID(kp=10.0, kd=1.0), dt=DT, free=("k",), units=units)


def record_of(loop, effect, swing, noise, seed, n):
    real = loop.with_effect(effect)
    return record_any(real, swing=swing, hold=60, n=n, seed=seed, sensor_noise=noise)


@pytest.mark.parametrize(
    ("template", "u", "y", "expected"),
    [("{u}^2", "N m", "", "(N m)^2"), ("1/(s {u}^2)", "V", "", "1/(s V^2)"),
     ("1/{u}", "N m", "", "1/(N m)"), ("{y}/s^2", "", "m/s", "m/s^3"), ("{y}/s", "", "°", "°/s"),
     ("1/(s^2 {y}^2)", "", "m^2", "1/(s^2 m^4)"), ("{y}/s^2", "", "1", "1/s^2"),
     ("1/{y}", "", "1/s", "s"), ("{u}", "%", "", "%"), ("m^3/s^2", "V", "m", "m^3/s^2"),
     ("{y}/s^2", "", "odd ^ unit", "odd ^ unit/s^2")],
)  # fmt: skip
def test_units_of_products_and_quotients(template, u, y, expected):
    assert fill_unit(template, {"u": u, "y": y}) == expected


def test_which_texts_are_units():
    known = ("s", "ms", "µm", "kV", "N m", "m/s^2", "°", "%", "1/s", "(m/s)", "m²", "rad/s")
    assert [t for t in known if not is_unit(t)] == []
    assert [t for t in ("", "y", "down", "volt", "x0", "((", "^2") if is_unit(t)] == []


@pytest.fixture(scope="module")
def degrees():
    """Return a loop, and a record of it with friction, in degrees and per cent."""
    loop = turntable({})
    record = record_of(loop, E.CoulombFriction(3.0), 1.0, 1e-3, 11, n=250)
    return loop, cid.Record(r=record.r, u=record.u, y=record.y, dt=DT, name="log",
                            units={"r": "deg", "u": "%", "y": "deg"})  # fmt: skip


@pytest.fixture(scope="module")
def found_in_degrees(degrees):
    """Return the diagnosis of that record, of whose friction several tests ask the unit."""
    return cid.diagnose(*degrees, progress=False, catalogue=[E.CoulombFriction])


def test_a_log_in_degrees_and_per_cent_is_told_in_them(found_in_degrees):
    found = found_in_degrees
    (friction,) = found.findings
    assert friction.effect.units(found.loop) == {"fc": "deg/s^2"}
    assert found.gap.unit == "deg"
    assert {p.axis: p.unit for p in found.where}["velocity"] == "deg/s"
    text = str(found)
    assert " deg/s^2" in text
    assert "[y]" not in text
    assert "kg" not in text
    assert E.EddyCurrentDamping(0.1).units(found.loop) == {"ce": "1/(s %^2)"}
    assert E.InputOffset(0.1).text(found.loop) == "InputOffset: offset = 0.1 %"
    assert not any("units: " in remark for remark in found.audit)


@pytest.mark.slow
def test_forces_need_a_length_and_one_mass_in_kilograms(degrees, found_in_degrees, tmp_path):
    _, record = degrees
    size = found_in_degrees.findings[0].effect.fc

    def tell(units, of_y):
        made = cid.Record(r=record.r, u=record.u, y=record.y, dt=DT, units={"y": of_y})
        found = cid.diagnose(turntable(units), made, progress=False, catalogue=[E.CoulombFriction])
        loaded = cid.load_diagnosis(found.save(tmp_path / f"{len(list(tmp_path.iterdir()))}.json"))
        assert str(loaded) == str(found)
        return str(found)

    assert f"({0.5 * size:.3g} N m at J = 0.5 kg m^2)" in tell({"J": "kg m^2"}, "rad")
    assert f"({0.5 * size:.3g} N at J = 0.5 kg)" in tell({"J": "kg"}, "m")
    for units, of_y in (({"J": "kg"}, "rad"), ({"J": "kg", "c": "kg"}, "m")):
        text = tell(units, of_y)
        assert f"{of_y}/s^2" in text
        assert " at J" not in text


def test_the_mass_of_a_pendulum_moves_on_a_circle():
    """N s/m at m = 0.35 kg would be wrong: friction at a pivot is in N m s/rad."""
    plant = cid.plants.pendulum(m=0.35, length=0.3)
    at = cid.operating_point(plant, output=0.0)
    loop = cid.Loop(plant, cid.PID(kp=5.0, kd=0.5, bias=0.0), dt=DT, at=at, free=("m",))
    record = record_of(loop, E.ViscousFriction(2.0), 0.1, 1e-4, 3, n=500)
    assert record.units == {"r": "rad", "u": "N m", "y": "rad"}
    found = cid.diagnose(loop, record, progress=False, catalogue=[E.ViscousFriction])
    assert [f.name for f in found.findings] == ["ViscousFriction"]
    assert "kg" not in str(found)
    assert E.EddyCurrentDamping(0.1).units(loop) == {"ce": "1/(s (N m)^2)"}


@pytest.mark.parametrize(
    ("units", "said"),
    [
        pytest.param({}, " [theta]/s^2", marks=pytest.mark.slow),
        ({"theta": "rad", "J": "kg m^2"}, " N m at J = 0.5 kg m^2)"),
    ],
)
def test_an_output_in_degrees_of_an_angle_in_radians_gives_no_unit_to_forces(units, said):
    """Friction of 3 rad/s^2 was told as 3 °/s^2."""
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], (p["k"] * u[0] - p["c"] * x[1]) / p["J"]]),
        lambda t, x, u, p: 180 / np.pi * x[0], inputs=["duty"], outputs=["angle"],
        states=["theta", "omega"], params={"J": 0.5, "c": 0.1, "k": 1.0}, name="disc",
    )  # fmt: skip
    loop = cid.Loop(plant, cid.PID(kp=0.2, kd=0.02), dt=DT, free=("k",), units=units)
    record = record_of(loop, E.CoulombFriction(3.0), 60.0, 0.02, 11, n=300)
    record = cid.Record(r=record.r, u=record.u, y=record.y, dt=DT,
                        units={"r": "°", "u": "%", "y": "°"})  # fmt: skip
    found = cid.diagnose(loop, record, progress=False, catalogue=[E.CoulombFriction])
    text = " ".join(str(found).split())
    assert [f.name for f in found.findings] == ["CoulombFriction"]
    assert said in text
    assert "°/s" not in text
    assert "° RMS" in text
    assert "°/s" not in str(cid.fit_loop(loop, record).estimate)


@pytest.mark.parametrize(
    ("first", "second", "same"),
    [("°", "deg", True), ("Degrees", "deg", True), ("N m", "N*m", True), ("Nm", "N·m", True),
     ("m/s^2", "m s^-2", True), ("um", "µm", True), ("[V]", "V", True), ("Volt", "V", True),
     ("rad/s", "1/s", True), ("N m s/rad", "N m s", True), ("m", "mm", False),
     ("rad", "deg", False), ("rad", "1", False), ("V", "A", False), ("N m", "N/m", False)],
)  # fmt: skip
def test_which_texts_are_the_same_unit(first, second, same):
    assert is_same_unit(first, second) == is_same_unit(second, first) == same


def test_units_that_contradict_each_other_are_told_by_every_door():
    """A record in degrees of a pendulum in radians was taken without a word by all but one."""
    plant = cid.plants.pendulum(m=0.35, length=0.3)
    at = cid.operating_point(plant, output=0.0)
    loop = cid.Loop(plant, cid.PID(kp=5.0, kd=0.5, bias=0.0), dt=DT, at=at, free=("m",))
    record = record_of(loop, E.ViscousFriction(0.1), 0.1, 1e-4, 3, n=600)
    words = (
        r"y is recorded in deg, but the plant has it in rad.*scale=.'y': 0.0174533.*units=.'theta'"
    )
    wrong = replace(record, units={"r": "rad", "u": "Nm", "y": "deg"})
    (found,) = cid.audit(wrong, loop)["units"]
    assert found.harmful
    assert found.channel == "y"
    assert re.search(words, found.text)
    told = [*cid.fit_loop(loop, wrong).estimate.notes, *cid.compare(wrong, loop).notes]
    told = [text for text in told if "UNITS DO NOT AGREE" in text]
    assert len(told) == 2
    assert all(re.search(words, text) for text in told)
    # Names of effects have no meaning there, and would cost minutes.
    with pytest.raises(cid.CtrlidError, match="the units do not agree: " + words):
        cid.diagnose(loop, wrong, progress=False)
    # A duty cycle for a torque may be meant: the model takes the numbers as they are, and says so.
    other = replace(record[:300], units={"u": "1"})
    found = cid.diagnose(loop, other, catalogue=[E.ViscousFriction], progress=False)
    assert "u is recorded without a unit, but the plant has it in N m" in " ".join(
        str(found).split()
    )
    for right in ({"y": "radians", "u": "N*m", "r": "rad"}, {}, {"u": "N m"}):
        alike = replace(record, units=right)
        assert cid.audit(alike, loop)["units"] == ()
        assert not any("UNITS" in text for text in cid.fit_loop(loop, alike).estimate.notes)


def test_units_of_a_file_that_are_overruled_without_a_scale_are_questioned(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t [s],u [V],y [deg]\n" + "".join(f"{k},1,{k}\n" for k in range(5)))
    with pytest.warns(cid.CtrlidWarning, match=r"y is in deg by the header .*, and in rad by unit"):
        record = cid.Record.from_csv(path, units={"y": "rad"})
    assert record.units["y"] == "rad"
    cid.Record.from_csv(path, units={"y": "rad"}, scale={"y": math.pi / 180})
    cid.Record.from_csv(path, units={"y": "°", "u": "volt"})


def test_units_of_a_loop_are_checked():
    with pytest.raises(cid.CtrlidError, match=r"names \['phi'\], but the signals, states and"):
        turntable({"phi": "rad"})
    with pytest.raises(cid.CtrlidError, match="maps names of the plant to units"):
        turntable({"angle": 3})


def test_axes_of_bins_say_where_no_unit_is_known(degrees):
    loop, record = degrees
    made = cid.Record(r=record.r, u=record.u, y=record.y, dt=DT)
    found = cid.diagnose(loop, made, progress=False, catalogue=[E.CoulombFriction])
    labels = {ax.get_xlabel() for ax in cid.plot.diagnosis(found)[0].figure.axes}
    assert not any("[1]" in text for text in labels if "lag" not in text)
    assert any("[unit not given]" in text for text in labels)


def test_a_file_is_converted_on_a_stated_scale(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("Zeit/ms;Soll/°;Ist/°;Stell/%\n0;0,0;0,0;50\n4;9,0;0,9;60\n8;9,0;1,8;70\n")
    names = {"r": "Soll", "u": "Stell", "y": "Ist"}
    plain = cid.Record.from_csv(path, **names)
    assert plain.dt == 0.004
    assert plain.units == {"r": "°", "u": "%", "y": "°"}
    scale = {"r": math.pi / 180, "y": math.pi / 180}
    made = cid.Record.from_csv(path, **names, scale=scale, units={"y": "rad"})
    assert made.units == {"u": "%", "y": "rad"}
    np.testing.assert_allclose(made.y, np.deg2rad(plain.y))
    np.testing.assert_allclose(made.u, plain.u)
    refusals = (({"x": 2.0}, "scale= names 'x', but the channels are"),
                ({"y": 0.0}, "a number other than zero for y; given 0.0"),
                ({"y": "deg"}, "as scale; given {'y': 'deg'}"))  # fmt: skip
    for wrong, words in refusals:
        with pytest.raises(cid.CtrlidError, match=words):
            cid.Record.from_csv(path, **names, scale=wrong)


def test_times_that_are_hardly_seconds_are_questioned(tmp_path):
    path = tmp_path / "log.csv"

    def write(label, step):
        rows = "\n".join(f"{k * step:g},0.1,{0.1 * k}" for k in range(5))
        path.write_text(f"{label},u,y\n{rows}\n")
        return path

    for step in (1, 4, 50):
        with pytest.warns(cid.CtrlidWarning, match=rf"the period is {step} s. If it is in milli"):
            cid.Record.from_csv(write("Zeit", step))
    for label, step in (("t", 0.004), ("t", 1.5), ("t [s]", 4), ("Zeit/s", 4), ("seconds", 4)):
        assert cid.Record.from_csv(write(label, step)).dt == step
    assert cid.Record.from_csv(write("t", 4), dt=4).dt == 4


@pytest.mark.parametrize("n", [50, 60])
def test_a_record_that_is_too_short_is_called_so(n):
    loop = turntable({})
    record = record_of(loop, E.CoulombFriction(3.0), 1.0, 1e-3, 11, n=n)
    with pytest.raises(cid.CtrlidError, match=r"too short for a diagnosis.* at least 67 samples"):
        cid.diagnose(loop, record, progress=False)


def robot(factor, units):
    """Return a cart with a rod whose outputs, named like its states, are these times a factor."""
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], p["k"] * u[0], x[3], p["g"] * x[2] - u[0]]),
        lambda t, x, u, p: np.array([factor * x[0], 180 / np.pi * x[2]]), inputs=["u"],
        outputs=["x", "phi"], states=["x", "v", "phi", "w"], params={"k": 1.0, "g": 9.0},
    )  # fmt: skip
    return cid.Loop(plant, None, dt=DT, units=units)


@pytest.mark.parametrize(
    ("factor", "stated", "of_x", "unit", "states"),
    [(1e3, {}, "mm", "[x]/s^2", {}),
     (1e3, {"v": "m/s"}, "mm", "m/s^2", {"x": "m", "v": "m/s"}),
     (1e3 * 1e-3, {}, "mm", "mm/s^2", {"x": "mm", "v": "mm/s"}),
     (1.0, {"v": "m/s"}, "", "m/s^2", {"x": "m", "v": "m/s"}),
     (1e3, {"v": "rpm"}, "mm", "[x]/s^2", {"v": "rpm"}),
     (1.0, {"w": "rad/s"}, "", "[y]/s^2", {"w": "rad/s", "phi": "rad"})],
)  # fmt: skip
def test_an_acceleration_has_the_unit_of_its_velocity(factor, stated, of_x, unit, states):
    """A friction at a velocity in m/s was told in mm/s^2, since the output is in mm."""
    loop = robot(factor, {**stated, **({"x": of_x, "phi": "deg"} if of_x else {})})
    assert E.CoulombFriction(0.3, at="v").units(loop) == {"fc": unit}
    angular = "rad/s^2" if "w" in stated else "[phi]/s^2"
    assert E.CoulombFriction(0.3, at="w").units(loop) == {"fc": angular}
    assert loop.state_units == states
    # A gain of the sensor is no gain of the state's unit.
    with_gain = loop.with_effect(E.SensorGain(1.1, at="x"))
    assert E.CoulombFriction(0.3, at="v").units(with_gain) == {"fc": unit}


def test_random_forces_have_the_units_of_their_velocities():
    """A white force of a coordinate in m was told in m/s/s, or in the mm of its output."""
    for stated, units in (({"v": "m/s"}, ("m/s^2", "")), ({"w": "rad/s"}, ("", "rad/s^2"))):
        loop = robot(1e3, stated)
        names = {"u": "u", "y": ("x", "phi")}
        record = cid.Record(u=np.zeros(9), y=np.zeros((2, 9)), dt=DT, names=names,
                            units={"y": ("mm", "deg")})  # fmt: skip
        assert find_noise_units(loop, record) == (("mm", "deg"), units)
    loop = robot(1.0, {})
    assert find_noise_units(loop, record) == (("mm", "deg"), ("mm/s^2", ""))


def test_a_force_of_an_input_without_a_unit_is_named_after_it():
    """It was told as an acceleration."""
    plant = robot(1.0, {}).plant
    loop = cid.Loop(plant, None, dt=DT, units={"v": "m/s"}, forces={"v": "u"})
    assert E.CoulombFriction(0.3, at="v").units(loop) == {"fc": "[u]"}
    assert E.CoulombFriction(0.3, at="w").units(loop) == {"fc": "[phi]/s^2"}


def test_of_several_outputs_the_one_in_another_unit_is_to_be_scaled():
    loop = robot(1.0, {"x": "m", "phi": "deg"})
    record = cid.Record(u=np.zeros(9), y=np.zeros((2, 9)), dt=DT, names={"u": "u", "y": ("a", "b")},
                        units={"y": ("mm", "deg")})  # fmt: skip
    (clash,) = find_unit_clashes(loop, record)
    assert "scale={'a': 0.001}, units={'a': 'm'}" in clash.text


def test_scales_of_temperature_are_no_factor_apart(tmp_path):
    """A plant in kelvins and a log in °C: a factor was advised, and the limits were blamed."""
    plant = ct.nlsys(
        lambda t, x, u, p: p["a"] * (u - x), lambda t, x, u, p: x[0],
        inputs=["Tc"], outputs=["T"], states=["T"], params={"a": 0.2}, name="bath",
    )  # fmt: skip
    at = cid.operating_point(plant, output=350.0)
    law = cid.PID(kp=3.0, ki=0.1, bias=350.0, lower=278.15, upper=380.0)
    loop = cid.Loop(plant, law, dt=0.5, at=at, free=("a",), units={"T": "K", "Tc": "K"})
    r = cid.random_binary(400, amplitude=2.0, hold=20, around=350.0, seed=1)
    kelvins = cid.simulate(loop, r, sensor_noise=0.02, seed=2)
    assert cid.audit(kelvins, loop)["units"] == ()
    shifted = {key: getattr(kelvins, key) - 273.15 for key in "ruy"}
    record = replace(kelvins, **shifted, units=dict.fromkeys("ruy", "°C"))
    found = cid.audit(record, loop)
    assert [f.channel for f in found["units"]] == ["u", "y", "r"]
    text = found["units"][1].text
    assert "recorded in °C, but the plant has it in K, whose zero is another one" in text
    assert "compute y + 273.15 in the file" in text
    assert "Loop(..., units={'T': '°C'})" in text
    assert not any("scale={" in f.text for f in found.findings)
    assert found["limit"] == ()
    assert "was not checked" in found["controller"][0].text
    with pytest.raises(cid.CtrlidError, match=r"the units do not agree: .*Tc?.*273\.15"):
        cid.diagnose(loop, record, progress=False)
    path = tmp_path / "log.csv"
    path.write_text("t [s],u [degF],y [°C]\n" + "".join(f"{k},1,{k}\n" for k in range(5)), "utf-8")
    with pytest.warns(cid.CtrlidWarning, match=r"compute y \+ 273\.15 in the file and write K"):
        cid.Record.from_csv(path, units={"y": "K"})
    with pytest.warns(cid.CtrlidWarning, match=r"compute 0\.555556 \* u - 17\.7778 in the file"):
        cid.Record.from_csv(path, units={"u": "°C"})
