"""A beam on two magnets: two inputs that act on both coordinates, two references, two outputs."""

import re
from dataclasses import replace
from functools import partial

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import effects as E
from ctrlid.diagnosis.report_text import write_gap_lines
from ctrlid.estimation.likelihood.physics_estimate import note_absurd_values
from ctrlid.validation.reproduction import find_law_rejection

DT, GAP, CURRENT = 0.002, 0.01, 4.4294
UNITS = {"z": "m", "phi": "rad", "i1": "A", "i2": "A", "K": "N m^2/A^2", "J": "kg m^2"}
NAMES = {"r": ("r_z", "r_phi"), "u": ("i1", "i2"), "y": ("z", "phi")}


def move(t, x, u, p):
    z, phi, v, w = x
    left = p["K"] * u[0] ** 2 / (z + p["a"] * phi) ** 2
    right = p["K"] * u[1] ** 2 / (z - p["a"] * phi) ** 2
    lift, tilt = (left + right) / p["m"], p["a"] * (left - right) / p["J"]
    return np.array([v, w, p["g"] - lift, -tilt])


def make_controller(sign=-1.0):
    """A PD for height and one for tilt, whose sum and difference drive the magnets.

    A gap grows where the current is too small, so that their gains are negative.
    """
    law = [
        ct.ss(sign * (p + d * ct.tf([1, -1], [0.002 + DT, -0.002], DT)), inputs=[error],
              outputs=[out], name=f"pd {out}")
        for error, out, p, d in (("ez", "iz", 900.0, 14.0), ("ep", "ip", 120.0, 1.9))
    ]  # fmt: skip
    mix = ct.nlsys(
        None, lambda t, x, u, p: np.array([CURRENT + u[0] + u[1], CURRENT + u[0] - u[1]]),
        inputs=["iz", "ip"], outputs=["i1", "i2"], name="mix", dt=DT,
    )  # fmt: skip
    sums = [ct.summing_junction(["r_z", "-z"], "ez"), ct.summing_junction(["r_phi", "-phi"], "ep")]
    return ct.interconnect([*law, mix, *sums], inputs=["r_z", "z", "r_phi", "phi"],
                           outputs=["i1", "i2"], name="two PDs")  # fmt: skip


def make_loop(**given):
    plant = ct.nlsys(
        move, lambda t, x, u, p: np.array([x[0], x[1]]), name="beam", inputs=["i1", "i2"],
        outputs=["z", "phi"], states=["z", "phi", "z_dot", "phi_dot"],
        params={"m": 0.8, "J": 0.012, "a": 0.15, "K": 2e-5, "g": 9.81},
    )  # fmt: skip
    at = cid.OperatingPoint((GAP, 0.0, 0.0, 0.0), (CURRENT, CURRENT), (GAP, 0.0))
    return cid.Loop(plant, make_controller(), dt=DT, at=at, **{"free": ("K", "J"), "units": UNITS,
                    **given})  # fmt: skip


def make_record(n=800, seed=1, **given):
    r = np.array([GAP + cid.random_binary(n, amplitude=3e-4, hold=60, seed=seed),
                  cid.random_binary(n, amplitude=2e-3, hold=45, seed=seed + 1)])  # fmt: skip
    return cid.simulate(make_loop(), {"r_z": r[0], "r_phi": r[1]}, sensor_noise=(2e-6, 1e-5),
                        seed=seed, **given)  # fmt: skip


@pytest.fixture(scope="module")
def record():
    return make_record()


# --- what is saved


@pytest.mark.parametrize("limits", [(0.0, 9.0), ((0.0, 0.5), (9.0, 8.5)), (0.0, (9.0, 8.5))])
def test_limits_of_one_and_of_each_input_survive_a_file(limits, record, tmp_path):
    loop = make_loop(input_limits=limits)
    found = cid.diagnose(loop, record, catalogue=[E.SensorGain], progress=False)
    file = found.save(tmp_path / "found.json")
    for back in (cid.load_diagnosis(file), cid.load_diagnosis(file, loop=loop)):
        assert back.loop.input_limits == loop.input_limits
        assert str(back) == str(found)
        assert back.save(tmp_path / "again.json").read_text() == file.read_text()


# --- names of a record that are not those of the model


def call(record, **names):
    return replace(record, names={**record.names, **names})


@pytest.mark.parametrize("judge", [
    lambda record, loop: cid.audit(record, loop),
    lambda record, loop: cid.compare(record, loop),
    lambda record, loop: cid.predict(loop, record),
    lambda record, loop: cid.fit_loop(loop, record).estimate,
    lambda record, loop: cid.diagnose(loop, record, catalogue=[E.SensorGain], progress=False),
], ids=["audit", "compare", "predict", "fit", "diagnose"])  # fmt: skip
def test_other_names_are_taken_in_order_with_a_warning(judge, record):
    loop = make_loop()
    other = call(record, r=("ref1", "ref2"), y=("gap", "tilt"))
    with pytest.warns(cid.CtrlidWarning) as caught:
        found = judge(other, loop)
    texts = [str(w.message) for w in caught]
    assert len(texts) == 2
    assert "y of the record is (gap, tilt), and none of these is a name in the loop" in texts[0]
    assert "Record.from_csv(..., names={'gap': 'z', 'tilt': 'phi'})" in texts[0]
    assert "in order as (r_z, r_phi)" in texts[1]
    if hasattr(found, "seconds"):
        found = replace(found, seconds=0.0)
        assert str(found) == str(replace(judge(record, loop), seconds=0.0))
    else:
        assert str(found) == str(judge(record, loop))


def test_signals_without_names_are_taken_in_order_without_a_word(record):
    bare = replace(record, names={})
    assert str(cid.compare(bare, make_loop())) == str(cid.compare(record, make_loop()))


@pytest.mark.parametrize(("names", "words"), [
    ({"y": ("phi", "gap")}, r"y of the record is \(phi, gap\), and the loop has \(z, phi\): phi is "
     r"found by name, but which of the others is z\? Name gap so"),
    ({"u": ("left", "i2")}, r"i2 is found by name, but which of the others is i1\?"),
    ({"r": ("ref", "r_z")}, r"r_z is found by name, but which of the others is r_phi\?"),
])  # fmt: skip
@pytest.mark.parametrize("judge", [cid.audit, cid.compare, cid.fit_loop, cid.predict])
def test_some_names_and_not_the_others_are_refused(judge, names, words, record):
    with pytest.raises(cid.CtrlidError, match=words):
        judge(call(record, **names), make_loop())


def test_columns_get_the_names_of_the_model_as_they_are_read(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text("t [s],Soll [mm],Ball [mm],Wippe [mrad],V\n0,0,1,2,3\n0.1,0,1,2,4\n")
    read = partial(cid.Record.from_csv, file, r="Soll", u="V", y=("Ball", "Wippe"))
    made = read(names={"Ball": "x", "Wippe": "theta"}, scale={"x": 1e-3, "Wippe": 1e-3},
                units={"x": "m", "theta": "rad"})  # fmt: skip
    assert made.names == {"r": "Soll", "u": "V", "y": ("x", "theta")}
    assert made.units == {"r": "mm", "y": ("m", "rad")}
    np.testing.assert_allclose(made.y[:, 0], [1e-3, 2e-3])
    by_channel = read(names={"y": ("x", "theta"), "r": "r_x"})
    assert by_channel.names == {"r": "r_x", "u": "V", "y": ("x", "theta")}
    assert read(names={"Ball": "x"}).names["y"] == ("x", "Wippe")
    made.to_csv(tmp_path / "own.csv")
    again = cid.Record.from_csv(tmp_path / "own.csv", names={"theta": "alpha"})
    assert again.names == {**made.names, "y": ("x", "alpha")}
    with pytest.raises(cid.CtrlidError, match="names= names 'Balken', but the channels are r, u"):
        read(names={"Balken": "x"})
    with pytest.raises(cid.CtrlidError, match="names has 1 words for y"):
        read(names={"y": ("x",)})


# --- signs and exchanged signals


def turn(record, key, sign):
    return replace(record, **{key: getattr(record, key) * np.array(sign)[:, None]})


def exchange(record, key):
    return replace(record, **{key: getattr(record, key)[::-1]})


@pytest.fixture(scope="module", params=[0.0, 0.05], ids=["exact", "dither"])
def moved(request):
    """A record whose inputs are exact, or have dither of 0.05 A."""
    rng = np.random.default_rng(5)
    return make_record(1500, d=request.param * rng.choice([-1.0, 1.0], (2, 1500)))


@pytest.mark.parametrize(("kind", "words", "change"), [
    ("sign", "with the opposite sign of r_phi", lambda record: turn(record, "r", (1, -1))),
    ("sign", "with the opposite sign of phi", lambda record: turn(record, "y", (1, -1))),
    ("sign", "with the opposite sign of i2", lambda record: turn(record, "u", (1, -1))),
    ("exchange", "with i1 and i2 exchanged", lambda record: exchange(record, "u")),
    ("exchange", "with z and phi exchanged", lambda record: exchange(record, "y")),
    ("exchange", "with r_z and r_phi exchanged", lambda record: exchange(record, "r")),
], ids=["r sign", "y sign", "u sign", "u", "y", "r"])  # fmt: skip
def test_what_is_mixed_up_is_named(kind, words, change, moved):
    found = cid.audit(change(moved), make_loop())
    (fact,) = found[kind]
    assert f"but {words} it is: what remains unexplained falls from" in fact.text
    assert fact.harmful
    assert not found["unknown"]
    assert words in find_law_rejection(make_loop(), change(moved))


def test_a_right_log_and_other_gains_are_not_mixed_up(moved):
    assert not cid.audit(moved, make_loop()).harmful
    other = replace(make_loop(), controller=make_controller(-1.3))
    found = cid.audit(moved, other)
    assert found["unknown"]
    assert not found["sign"]
    assert not found["exchange"]


def test_signals_at_rest_leave_two_answers():
    """Without tilt the two magnets are alike, and so are their currents."""
    n = 1500
    r_phi = 2e-3 * np.sign(np.sin(np.arange(n) / 20))
    record = cid.simulate(make_loop(), {"r_z": np.full(n, GAP), "r_phi": r_phi}, seed=1)
    (fact,) = cid.audit(exchange(record, "u"), make_loop())["exchange"]
    assert "with i1 and i2 exchanged" in fact.text


# --- a model of two outputs with poles of their own in a redesign


def test_outputs_with_poles_of_their_own_keep_them():
    """Height and tilt are two plants of two poles each, of which two states are no model."""
    G = cid.fit_iv(make_record(3000), na=2, nb=2)
    states = G.to_states()
    assert states.nstates == 4
    for w in (1.0, 50.0, 400.0):
        z = np.exp(1j * w * DT)
        np.testing.assert_allclose(states(z), G(z), rtol=1e-7)
    given = []
    outcome = cid.redesign(G, make_loop(), step={"r_z": 5e-5, "r_phi": 1e-3},
                           design=lambda P: given.append(P) or make_controller())  # fmt: skip
    assert given[0].nstates == 4
    assert "DOES NOT STABILIZE" not in str(outcome)
    assert [(step.reference, step.output) for step in outcome.steps] == [
        ("r_z", "z"), ("r_phi", "phi"),
    ]  # fmt: skip
    assert "(r_z by 50 µm, r_phi by 0.001 rad)" in str(outcome)


# --- what a fit and a loop say


def test_a_value_absurdly_far_from_its_start_is_said_so_in_capitals(record):
    found = cid.fit_loop(make_loop(), exchange(record, "u")).estimate
    ratio = found["J"] / 0.012
    assert not 1e-3 < ratio < 1e3
    (note,) = (note for note in found.notes if note.startswith("ABSURDLY FAR FROM THE START: "))
    assert "J = " in note
    assert "in place of 0.012" in note
    assert "THE START" not in str(cid.fit_loop(make_loop(), record).estimate)


def test_values_are_absurd_beyond_a_factor_of_a_thousand():
    starts = {"J": 0.012, "k": -2.0, "c": 0.0, "m": 1.0}
    values = np.array([0.011, -1.9, 5.0, 500.0])
    sure, lost = 1e-3 * np.abs(values), np.full(4, np.inf)
    assert note_absurd_values(tuple(starts), starts, values, lost) == ()
    values = np.array([120.0, -1.9, 5.0, 5000.0])
    for errors in (sure, lost):
        (note,) = note_absurd_values(tuple(starts), starts, values, errors)
        assert note.startswith("ABSURDLY FAR FROM THE START: J = 120 in place of 0.012 and m = "
                               "5000 in place of 1. ")  # fmt: skip
    assert note_absurd_values(("lag",), starts, np.array([1e9]), np.ones(1)) == ()
    # What may be zero is not far from a trace, and what has gone to zero is told as on its bound.
    starts = {"friction": 6e-11, "drag": 0.1}
    values, errors = np.array([2e-5, 1e-12]), np.array([4e-5, 1e-13])
    assert note_absurd_values(tuple(starts), starts, values, errors) == ()


def test_the_note_on_forces_recommends_only_what_can_be_given():
    """The magnets pull by the square of their currents, and each acts on both coordinates."""
    text = str(make_loop())
    assert "without forces= a force at a velocity accelerates that coordinate alone" in text
    assert "No input of beam is such a force" in text
    assert "driven=('i1', 'i2'), forces={'z_dot': 'force'})" in text
    assert "forces={'z_dot': 'i1'}" not in text


def make_pushed(gain):
    """Two masses on a bench, whose accelerations are a matrix of gains times two inputs."""
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([x[2], x[3], *(np.array(gain) @ u)]),
        lambda t, x, u, p: np.array([x[0], x[1]]), name="masses",
        inputs=[f"F{k + 1}" for k in range(len(gain[0]))], outputs=["a", "b"],
        states=["a", "b", "a_dot", "b_dot"],
    )  # fmt: skip
    zeros = (0.0,) * len(gain[0])
    at = cid.OperatingPoint((0.0,) * 4, zeros if len(zeros) > 1 else 0.0, (0.0, 0.0))
    return cid.Loop(plant, dt=0.01, at=at)


@pytest.mark.parametrize(("gain", "words"), [
    ([[2.0, -0.5], [-0.5, 1.0]], "as in forces={'a_dot': 'F1'} of the Loop"),
    ([[2.0], [-0.5]], "as in forces={'a_dot': 'F1'} of the Loop"),
    ([[1.0, 1.0], [1.0, -1.0]], "No input of masses is such a force"),
    ([[0.0], [0.0]], "No input of masses is such a force"),
], ids=["arm", "cart", "beam", "none"])  # fmt: skip
def test_a_force_that_may_be_one_is_recommended(gain, words):
    assert words in str(make_pushed(gain))


# --- what a diagnosis prints


@pytest.fixture(scope="module")
def found(record):
    return cid.diagnose(make_loop(), record, catalogue=[E.SensorGain], progress=False)


def test_each_axis_of_the_bins_is_named_once(found):
    _, _, words = " ".join(str(found).split()).partition("In bins of ")
    axes = words.partition(", the one-step errors")[0].replace(" and ", ", ").split(", ")
    assert len(axes) == len(set(axes)) > 8


def test_a_table_has_its_columns_below_one_another(found):
    long = {"SensorGain at z.error": 5e-4, "CoulombFriction at phi_dot_of_the_long_beam.fc": 1.0,
            "SensorGain at phi.error": 1e-3, "EddyCurrentDamping at phi_dot.ce": 0.04}  # fmt: skip
    for table in (long, {k: v for k, v in long.items() if "long" not in k}):
        text = str(replace(found, sensitivity=table))
        rows = text.partition("would have shown\n")[2].partition("\n\n")[0].splitlines()
        assert max(map(len, rows)) <= 100
        assert len({row.find(" SensorGain", 6) for row in rows} - {-1}) <= 1
    gap = found.gap
    wide = replace(gap, outputs=tuple(replace(part, unit="rad of the beam")
                                      for part in gap.outputs))  # fmt: skip
    rows = [line for line in write_gap_lines(wide) if " x the floor" in line]
    assert len({re.search(r"\S+ x the floor", row).start() for row in rows}) == 1


def test_the_unit_of_what_goes_by_an_input_has_that_of_the_input():
    effect = E.EddyCurrentDamping(ce=0.1, at="phi_dot")
    assert effect.units(make_loop()) == {"ce": "1/(s A^2)"}
