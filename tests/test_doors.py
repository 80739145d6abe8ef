"""Arguments are checked at the door, answers are right or refused, and results are values.

Groups: the check of kinds; wild calls; results that cannot be changed; what once was silently
wrong, or crashed; damaged files.
"""

import contextlib
import copy
import inspect
import json
import math
import random
from dataclasses import replace
from datetime import datetime, timedelta

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import CtrlidError
from ctrlid import effects as E
from ctrlid._base.arguments import check_arguments
from ctrlid._base.arrays import to_real_array
from ctrlid.validation.sampling_sweep import average_input
from problems import ROOT, levitation, load_script, servo

fuzz = load_script("benchmarks", "fuzz")


@pytest.fixture(scope="module")
def loop():
    return servo(ct.tf([5.0], [1], 0.05), dt=0.05, free=("c",))


@pytest.fixture(scope="module")
def record(loop):
    r = cid.random_binary(400, amplitude=0.1, hold=10, seed=1)
    return cid.simulate(loop, r, sensor_noise=1e-3, seed=2)


# --- the check of kinds


@pytest.mark.parametrize("unit", ["ms", "ns"])
def test_a_span_of_time_is_no_number(unit):
    """In nanoseconds numpy makes a float of it: 10 ms would be a period of 1e7 s."""
    span = np.timedelta64(np.timedelta64(10, "ms"), unit)
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    for call in (
        lambda: cid.Record(u=np.zeros(9), y=np.zeros(9), dt=span),
        lambda: cid.Loop(plant, None, dt=span),
        lambda: cid.operating_point(plant, output=span),
        lambda: cid.PoleAt(span),
        lambda: E.ActuatorLag(tau=span),
        lambda: cid.random_binary(100, amplitude=span, hold=5),
    ):
        with pytest.raises(CtrlidError, match=r"timedelta64|loop needs"):
            call()


def greet(
    who: str,
    times: int = 1,
    loud: bool = False,
    size: float | None = None,
    where: tuple[float, float] = (0.0, 1.0),
) -> None:
    check_arguments(greet, locals())


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"who": 3}, r"greet needs a text as who; given 3 \(int\)"),
        ({"who": "a", "times": 1.0}, "a whole number as times; given 1.0"),
        ({"who": "a", "times": True}, "a whole number as times; given True"),
        ({"who": "a", "loud": "no"}, "True or False as loud; given 'no'"),
        ({"who": "a", "size": "1"}, "a number or None as size; given '1'"),
        ({"who": "a", "size": 1 + 2j}, "a number or None as size"),
        ({"who": "a", "size": np.complex128(1)}, "a number or None as size"),
        ({"who": "a", "size": 10**400}, "a number or None as size"),
        ({"who": "a", "where": (1.0,)}, r"\(a number, a number\) as where"),
        ({"who": "a", "where": None}, r"\(a number, a number\) as where"),
    ],
)
def test_arguments_of_another_kind_are_refused_by_name(given, words):
    with pytest.raises(CtrlidError, match=words):
        greet(**given)


def test_numbers_of_numpy_and_rows_of_any_kind_are_what_they_say():
    greet("a", np.int8(2), np.bool_(True), np.float32(0.5), np.array([0.0, 1.0]))
    greet("a", size=np.array(0.5), where=[0, 1])


@pytest.mark.parametrize("values", [[1j], ["1"], [[1], [1, 2]], np.ma.array([1.0], mask=[True])])
def test_what_would_lose_a_part_is_no_array(values):
    with pytest.raises(CtrlidError, match="levels must be"):
        to_real_array(values, "levels")


def select_wide(record):
    return cid.Record(u=record.u, y=np.array([record.y, record.y]), dt=record.dt)


CALLS = {
    "imaginary reference": lambda loop, record: cid.simulate(loop, record.r * 1j),
    "imaginary frequency": lambda loop, record: cid.response_band(cid.fit_arx(record, 2, 2), [1j]),
    "intercept": lambda loop, record: cid.fit_arx(record, 2, 2, intercept="no"),
    "masked samples": lambda loop, record: replace(
        record, valid=np.ma.array(record.valid, mask=record.u > 0)
    ),
    "unknown key": lambda loop, record: cid.sweep_sampling_period(
        record, estimators=["fit_arx"], constraints={"fit_arxx": [cid.Integrator()]}
    ),
    "no number": lambda loop, record: cid.plants.servo(m="1", c=1, k=1),
    "an endless delay": lambda loop, record: cid.fit_continuous(record, 2, delay=1000.0),
    "a differentiator": lambda loop, record: cid.fit_continuous(
        record, 2, controller=ct.tf([1, 0], [1])
    ),
    "an improper plant": lambda loop, record: cid.Loop(ct.tf([1, 0, 0], [1, 1]), 1.0, dt=0.1),
    "two inputs": lambda loop, record: cid.Loop(
        ct.tf([[[1], [1]]], [[[1, 1], [1, 2]]]), 1.0, dt=0.1
    ),
    "a guess of another plant": lambda loop, record: cid.operating_point(
        loop.plant, output=0.2, guess=cid.OperatingPoint((1, 2, 3), 0, 0)
    ),
    "a negative seed": lambda loop, record: cid.simulate(loop, record.r, seed=-1),
    "a band of two rows": lambda loop, record: cid.multisine(
        150, amplitude=0.2, band=np.ones((2, 3))
    ),
    "a period that no float holds": lambda loop, record: replace(loop, dt=10**400),
    "an array without dimensions as order": lambda loop, record: cid.fit_arx(
        record, 2, np.array(1.5)
    ),
    "a controller that no float holds": lambda loop, record: replace(loop, controller=10**400),
    "an infinite controller": lambda loop, record: replace(loop, controller=math.inf),
    "a controller that is no number": lambda loop, record: replace(
        loop, controller=ct.tf([1.0], [1.0, math.nan])
    ),
    "instruments of an infinite controller": lambda loop, record: cid.fit_iv(
        record, 2, 1, controller=math.inf
    ),
    "progress of several kinds": lambda loop, record: cid.diagnose(
        loop, record, progress=np.array([True, False])
    ),
    "no folder": lambda loop, record: record.to_csv("/nonexistent/x.csv"),
    "processes without end": lambda loop, record: cid.fit_each(
        cid.fit_arx, [record, record], na=1, nb=1, jobs=10**9
    ),
    "no model": lambda loop, record: cid.fit_each(lambda r: 5, [record, record]),
    "nothing valid": lambda loop, record: cid.diagnose(
        loop, replace(record, valid=np.zeros(400, bool)), progress=False
    ),
    "nothing valid for validation": lambda loop, record: cid.diagnose(
        loop, record, validation=replace(record, valid=np.zeros(400, bool)), progress=False
    ),
    "an array without dimensions as effects": lambda loop, record: replace(
        loop, effects=np.array(1.0)
    ),
    "a transfer function as limits": lambda loop, record: replace(
        loop, input_limits=ct.tf([1], [1, 1])
    ),
    "rows of different lengths": lambda loop, record: replace(
        record, valid=[[True], [True, False]]
    ),
    "a record of another plant": lambda loop, record: cid.predict(loop, select_wide(record)),
    "a ball without end": lambda loop, record: cid.plants.ball_on_beam(m=1, J=1, radius=1e300),
    "an empty operating point": lambda loop, record: replace(loop, at=np.zeros((0, 3))),
    "an array without dimensions as constraints": lambda loop, record: cid.fit_arx(
        record, 2, 2, constraints=np.array(1.0)
    ),
    "a stuck sensor": lambda loop, record: cid.compare(replace(record, y=np.full(400, 0.1)), loop),
}


@pytest.mark.parametrize("name", CALLS)
def test_what_does_not_fit_is_refused(loop, record, name):
    with pytest.raises(CtrlidError):
        CALLS[name](loop, record)


# --- wild calls


def test_every_public_callable_is_fuzzed():
    assert fuzz.find_public() - fuzz.LEFT_OUT == set(fuzz.RECIPES)


def test_wild_calls_are_answered_right_or_refused():
    done = fuzz.run(500, seed=3)
    assert done["failures"] == {}
    assert done["counts"]["answer"] >= 500 / 3


def test_the_fuzzer_notices_what_is_wrong(monkeypatch):
    monkeypatch.setattr(cid, "nu_gap", lambda P1, P2: 2.0)
    assert "breaks its invariant" in str(fuzz.run(20, 1, only="nu_gap")["failures"])

    def raising(P1, P2):
        raise TypeError("P1")

    monkeypatch.setattr(cid, "nu_gap", raising)
    assert "TypeError" in str(fuzz.run(20, 1, only="nu_gap")["failures"])


# --- results that cannot be changed


def test_arrays_of_results_are_read_only(loop, record):
    model, open_loop = cid.fit_arx(record, 2, 2), cid.fit_continuous(record, 2)
    found = cid.diagnose(loop, record, catalogue=(E.ViscousFriction,), progress=False)
    comparison = cid.compare(record, loop)
    results = [
        record, cid.fit_loop(loop, record), cid.predict(loop, record), comparison,
        *comparison.curves, *comparison.tests,
        cid.redesign(open_loop, loop, 2.0, 50.0), cid.fit_loop(loop, record).estimate,
        found.gap, *found.where, cid.response_band(model, [1.0, 2.0]), cid.check_feedback(record),
        *cid.select_order(record, [1, 2], [1], [1]).rows, model.estimate,
        cid.sweep_sampling_period(record, [0.05], estimators=["fit_arx"]),
        cid.fit_each(cid.fit_arx, [record, record], na=1, nb=1),
    ]  # fmt: skip
    seen = 0
    for result in results:
        made = inspect.getmembers(type(result), lambda member: isinstance(member, property))
        computed = [name for name, _ in made if not name.startswith("_")]
        for name in (*result.__dataclass_fields__, *computed):
            value = None
            # A trend over set-points is refused where there is one record of each.
            with contextlib.suppress(CtrlidError):
                value = getattr(result, name)
            if isinstance(value, np.ndarray):
                seen += 1
                assert not value.flags.writeable, (type(result).__name__, name)
    assert seen > 30


# --- what once was silently wrong


@pytest.mark.parametrize("effect", [E.InputDelay(0.03), E.InputBacklash(0.02)])
@pytest.mark.parametrize("order", [0, 1])
def test_a_loop_whose_input_remembers_simulates_its_own_record(effect, order):
    """The states of the controller stand before what the input remembers."""
    C = ct.tf([5.0], [1], 0.05) if order == 0 else ct.tf([5.0, -4.0], [1, -0.8], 0.05)
    loop = servo(C, dt=0.05).with_effect(effect)
    record = cid.simulate(loop, cid.random_binary(400, amplitude=0.1, hold=20, seed=1))
    curve = cid.compare(record, loop)["simulation"]
    assert curve.fit > 99.9
    assert abs(curve.y[0] - record.y[0]) < 1e-6


def test_a_constant_reference_is_followed_by_nothing(loop):
    record = cid.simulate(loop, np.full(400, 0.1), initial=(0.05, 0.0), sensor_noise=1e-3, seed=2)
    r = cid.random_binary(400, amplitude=0.1, hold=10, seed=1)
    for model in (loop, cid.fit_arx(cid.simulate(loop, r), 2, 2)):
        comparison = cid.compare(record, model)
        assert all(np.isfinite(curve.fit) for curve in comparison.curves)
    assert cid.compare(record, loop)["one-step"].follows == 0


@pytest.mark.parametrize("effect", [E.Quantization(step=1e-8), E.InputDeadZone(width=1e-4)])
def test_a_redesign_counts_a_converter_and_a_dead_zone_as_small_not_as_unstable(effect):
    loop = levitation(free=())
    P = cid.linearize(loop.plant, loop.at)
    outcome = cid.redesign(P, loop.with_effect(effect), 100, 50)
    assert outcome.stable
    assert outcome.achieved.phase_margin == pytest.approx(50, abs=1)


def test_an_analog_controller_of_a_loop_with_backlash_is_refused_and_no_divergence():
    loop = levitation(free=()).with_effect(E.InputBacklash(width=1e-3))
    P = cid.linearize(loop.plant, loop.at)
    with pytest.raises(CtrlidError, match="acts on the samples of a digital controller") as refusal:
        cid.redesign(P, loop, 100, 50)
    # What the message says to do is done.
    assert f"ct.sample_system(G, {loop.dt:g})" in str(refusal.value)
    assert cid.redesign(ct.sample_system(P, loop.dt), loop, 100, 50).controller.dt == loop.dt


def test_a_controller_without_states_is_a_function_of_r_and_y(loop):
    law = ct.nlsys(None, lambda t, x, u, params: 5.0 * (u[0] - u[1]), inputs=["r", "y"],
                   outputs=["u"], dt=0.05)  # fmt: skip
    r = cid.random_binary(100, amplitude=0.1, hold=10, seed=1)
    same = cid.simulate(replace(loop, controller=law), r)
    assert np.allclose(same.y, cid.simulate(loop, r).y, rtol=1e-12, atol=1e-12)


def test_a_robust_margin_is_at_most_one():
    assert [cid.robust_margin(g, g) for g in (1.5, 0.7, 3.1)] == [1.0, 1.0, 1.0]


def test_a_pole_at_zero_is_a_delay_of_one_sample(record):
    text = str(cid.fit_arx(record, 2, 2, constraints=[cid.PoleAt(0)]).estimate)
    assert "pole at z = 0, a delay of one sample" in text
    assert "nan" not in text


def test_periods_that_differ_by_their_last_digits_are_one(loop, record):
    single = replace(record, dt=float(np.float32(0.05)))
    assert cid.fit_loop(loop, single).estimate.n_samples > 0
    with pytest.raises(
        CtrlidError, match=r"0\.05 s, the record at 0\.0500002 s.*differ by 2e-07 s"
    ):
        cid.fit_loop(loop, replace(record, dt=0.0500002))


def test_dollars_in_names_are_drawn_as_they_are(record, tmp_path):
    named = replace(record, units={"y": "$$"}, names={"y": "$x_", "u": "a$b$"}, name="$")
    page = cid.write_report(named, tmp_path / "page.html").read_text("utf-8")
    assert "$$" in page


@pytest.mark.parametrize("name", ["fit_loop", "fit_continuous", "fit_iv", "compare", "redesign"])
def test_a_numpy_that_raises_at_every_rounding_changes_nothing(loop, record, name):
    """Search for errors with np.seterr(all="raise") is for the user's own code."""
    calls = {
        "fit_loop": lambda: cid.fit_loop(loop, record).estimate.values,
        "fit_continuous": lambda: cid.fit_continuous(record, 2).estimate.values,
        "fit_iv": lambda: cid.fit_iv(record, 2, 2).estimate.values,
        "compare": lambda: cid.compare(record, loop).residuals,
        "redesign": lambda: cid.redesign(cid.fit_continuous(record, 2), loop, 2.0, 50.0).time,
    }
    with np.errstate(all="raise"):
        strict = calls[name]()
    np.testing.assert_array_equal(strict, calls[name]())


def test_all_records_for_validation_are_counted(loop, record):
    r = cid.random_binary(300, amplitude=0.1, hold=10, seed=4)
    other = cid.simulate(loop, r, sensor_noise=1e-3, seed=5)

    def count(validation):
        found = cid.diagnose(loop, record, validation=validation, catalogue=(), progress=False)
        assert f"of {found.gap.samples} samples kept back" in str(found)
        return found.gap.samples

    assert count([record, other]) == count(record) + count(other)


def test_a_slow_record_keeps_its_extra_channels(record):
    whole = replace(record, extra={"current": record.u}, units={"current": "A", "y": "m"})
    slow = average_input(whole, 4)
    np.testing.assert_array_equal(slow.extra["current"], record.u[::4])
    assert dict(slow.units) == {"current": "A", "y": "m"}


# --- damaged files


def test_damaged_diagnoses_are_refused_or_can_be_printed(tmp_path):
    whole = json.loads((ROOT / "tests" / "saved_diagnosis.json").read_text("utf-8"))
    rng = random.Random(5)

    def find_places(value, path=()):
        yield path
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in items:
            if isinstance(inner, dict) or (isinstance(inner, list) and len(inner) < 30):
                yield from find_places(inner, (*path, key))
            else:
                yield (*path, key)

    places = [place for place in find_places(whole) if place]
    refused, file = 0, tmp_path / "found.json"
    for _ in range(300):
        damaged = copy.deepcopy(whole)
        *way, last = rng.choice(places)
        inner = damaged
        for key in way:
            inner = inner[key]
        value = rng.choice(["", None, 5, -1, "text", [], {}, [1, 2], {"a": 1}, True, "nan", [[1]]])
        if value == "":
            del inner[last]
        else:
            inner[last] = value
        file.write_text(json.dumps(damaged), "utf-8")
        try:
            str(cid.load_diagnosis(file))
        except CtrlidError:
            refused += 1
    assert refused > 100


@pytest.mark.parametrize(
    ("header", "stamp", "separator"),
    [
        ("Timestamp", "{:%Y-%m-%dT%H:%M:%S}.{:03d}Z", ","),
        ("Timestamp [UTC]", "{:%Y-%m-%d %H:%M:%S}.{:03d}", ","),
        ("Date/Time", "{:%Y-%m-%d %H:%M:%S},{:03d}", ";"),
        ("t", '"{:%Y-%m-%d %H:%M:%S},{:03d}+01:00"', ","),
    ],
)
def test_dates_are_times_since_the_first_row(tmp_path, header, stamp, separator):
    """A log that runs over midnight, four times a second."""
    begin = datetime(2026, 11, 27, 23, 59, 58, 250_000)
    moments = [begin + timedelta(milliseconds=250 * k) for k in range(20)]
    rows = [separator.join([stamp.format(m, m.microsecond // 1000), "1", str(k)])
            for k, m in enumerate(moments)]  # fmt: skip
    file = tmp_path / "log.csv"
    file.write_text("\n".join([separator.join([header, "u", "y"]), *rows]), "utf-8")
    for options in ({}, {"dt": 0.25}):
        record = cid.Record.from_csv(file, **options)
        assert (record.dt, record.t[0], len(record)) == (0.25, 0.0, 20)
        assert np.all(record.y == np.arange(20))
    file.write_text("\n".join([separator.join([header, "u", "y"]), *rows[:9], *rows[10:]]), "utf-8")
    assert np.flatnonzero(~cid.Record.from_csv(file, gaps="mask").valid) == [9]


def test_dates_beside_a_period_that_is_given_may_be_coarse(tmp_path):
    """A column of dates that no name calls the time is asked only where nothing else tells."""
    file = tmp_path / "log.csv"
    rows = [f"2026-11-27 10:00:{k // 4:02d},{k},1" for k in range(20)]
    file.write_text("\n".join(["Date/Time,u,y", *rows]), "utf-8")
    assert cid.Record.from_csv(file, dt=0.25).dt == 0.25
    with pytest.raises(CtrlidError, match="does not increase"):
        cid.Record.from_csv(file)
    two = [f"{row},2026-11-27 10:00:00" for row in rows]
    file.write_text("\n".join(["Date/Time,u,y,shift", *two]), "utf-8")
    with pytest.raises(CtrlidError, match="no time column"):
        cid.Record.from_csv(file)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"t,u,y," + b"x" * 200_000 + b"\n0,1,2,3\n0.1,1,2,3\n", "not a line of a table"),
        (b"# ctrlid []\nt,u,y\n0,1,2\n0.1,1,2\n", "is damaged"),
        (b"t,u,y\n0,1,2\n0.01,1,2\n0.02,1,2\n1.7e9,1,2\n", "the wild time stamp"),
        (b"t|u|y\n0|1|2\n1|1|2\n", r"separated by '\|', replace it"),
        (b"t,u,y\n27.11.2026 10:00:00,1,2\n27.11.2026 10:00:01,1,2\n", "a date or a time of day"),
        (b"t,u,y\n2026-13-01T00:00:00,1,2\n2026-13-01T00:00:01,1,2\n", "a date or a time of day"),
        (b"t,u,y\n2026-11-01T00:00:00,1,2\n2026-11-01T00:00:01Z,1,2\n", "all of them dates with"),
        (b"t,u,y\n2026-11-01T00:00:00,1,2\nlater,1,2\n", "all of them dates with a time"),
        (b"t,u,y\n0,1,2026-11-01T00:00:00\n1,1,2026-11-01T00:00:01\n", "column 'y'; times are"),
        (b"t,u,y\n2026-11-01T00:00:00,1,2\n,1,2\n", "at least 2 values, all finite"),
        (b"t,u,y\n12:00:01,1,2\n12:00:02,1,2\n", "a date or a time of day"),
        (b"t,u,y\n12:00:01,1,2\n12:00:02,1,2\n", r"\(t - t\[0\]\).dt.total_seconds\(\)"),
    ],
)
def test_a_damaged_or_foreign_table_says_what_to_do(tmp_path, data, words):
    file = tmp_path / "log.csv"
    file.write_bytes(data)
    with pytest.raises(CtrlidError, match=words):
        cid.Record.from_csv(file, gaps="mask")


@pytest.mark.parametrize(
    "data",
    [
        b"t,u,y\r0,1,2\r0.1,1,3\r", b"t,u,y\r\n0,1,2\r\n0.1,1,3\r\n",
        "t,u,y\n0,1,2\n0.1,1,3\n".encode("utf-16"), b"sep=;\nt;u;y\n0;1;2\n0,1;1;3\n",
        b"sep=|\nt|u|y\n0|1|2\n0.1|1|3\n",
    ],
)  # fmt: skip
def test_tables_of_other_tools_are_read(tmp_path, data):
    file = tmp_path / "log.csv"
    file.write_bytes(data)
    record = cid.Record.from_csv(file)
    assert record.dt == pytest.approx(0.1)
    assert record.y.tolist() == [2, 3]


def test_damaged_bytes_give_a_record_or_a_refusal(tmp_path):
    rng = random.Random(2)
    table = b"t [ms],u [V],y [m]\n" + b"".join(b"%d,%d,%d\n" % (k, k % 5, k) for k in range(30))
    file, refused = tmp_path / "log.csv", 0
    pieces = [b",", b"\n", b'"', b"1e400", b"nan", b"\x00", b"\r", b"#", b";", b"99999999999", b"|"]
    for _ in range(200):
        data = bytearray(table)
        for _ in range(rng.choice([1, 2, 5])):
            at = rng.randrange(len(data))
            data[at : at + rng.randrange(3)] = rng.choice(pieces)
        file.write_bytes(data)
        try:
            cid.Record.from_csv(file, gaps="mask")
        except CtrlidError:
            refused += 1
    assert 20 < refused < 200


# --- names of arguments


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: cid.fit_continuous(None, na=2, nb=2), "fit_continuous has no na=; it takes"),
        (lambda: cid.operating_point(None, out=0), r"no out=; did you mean output=\?"),
        (lambda: cid.operating_point(None, 0.0), "takes plant without names, and output=, guess="),
        (lambda: cid.simulate(None, noise=0.1), "did you mean sensor_noise= or force_noise="),
        (lambda: cid.fit_arx(None, 2, na=2, nb=2), "is given na twice"),
        (lambda: cid.fit_iv(), "fit_iv needs record=, na= and nb=; it takes record, na, nb, nk"),
        (lambda: cid.Record(u=[0, 1], y=[0, 1]), "Record needs dt=; it takes u, y, dt, r"),
        (lambda: cid.Loop(None, None, 0.1, operating=0), "Loop has no operating=; it takes plant"),
        (lambda: cid.Loop(dt=0.1), "Loop needs plant=; it takes plant, controller, dt"),
        (lambda: cid.PID(), "PID needs kp=; it takes kp, ki, kd"),
        (lambda: cid.PID(*range(20)), "given 20 values without a name"),
        (lambda: cid.Loop(None, dt=0.1, effect=0), r"Loop has no effect=; did you mean effects=\?"),
        (lambda: cid.plants.maglev(m=0.02, k=1), "maglev has no k="),
        (lambda: cid.plants.servo(m=1.0), "servo needs c= and k=; it takes m, c, k"),
        (lambda: E.CoulombFriction(f=0.1), r"CoulombFriction has no f=; did you mean fc=\?"),
        (
            lambda: E.CoulombFriction(1, 2, 3, 4),
            "takes fc, creep without names, and at= by name; given 4 values without a name",
        ),
        (lambda: E.ParameterStep(), "ParameterStep needs name=, time= and size=; it takes name"),
        (lambda: E.InputSaturation(5), "InputSaturation needs upper=; it takes lower, upper, at"),
        (lambda: cid.Bounds(), "Bounds needs .*=; it takes"),
        (
            lambda: cid.Fixed("a1", 1.0, 2.0),
            "Fixed takes name, value without names, and output= by name; given 3 values",
        ),
        (lambda: E.ActuatorLag(time=0.1), "ActuatorLag has no time="),
    ],
)
def test_a_wrong_name_of_an_argument_is_answered_with_the_right_ones(call, words):
    with pytest.raises(cid.CtrlidError, match=words):
        call()


def test_every_public_function_knows_its_arguments():
    functions = [f for name in cid.__all__ if inspect.isfunction(f := getattr(cid, name))]
    assert len(functions) > 25
    for function in functions:
        with pytest.raises(cid.CtrlidError, match="has no nonsense="):
            function(nonsense=1)
    # Help shows what each takes all the same.
    assert list(inspect.signature(E.CoulombFriction).parameters) == ["fc", "creep", "at"]
