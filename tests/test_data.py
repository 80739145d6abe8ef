"""Record: what it holds and refuses, its parts, filters and files."""

import copy
import pickle
from dataclasses import replace

import control as ct
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import ctrlid as cid
from ctrlid._base.text import split_unit, with_unit
from ctrlid.data.several_records import as_records

N = 40


def make(n=N, **fields):
    """Make a record with every channel different."""
    k = np.arange(n)
    given = {"r": np.sign(np.sin(k)), "u": np.sin(k), "y": np.cos(k), "dt": 0.1}
    return cid.Record(**{**given, **fields})


def full(n=N, **fields):
    """Make a record that uses every field."""
    k = np.arange(n)
    given = {"extra": {"current": k / 3, "x[0]": -k / 7}, "valid": k % 7 != 3, "hold": "foh",
             "names": {"u": "duty", "y": "gap"}, "name": "run 3, second try", "start": 1.7,
             "units": {"r": "m", "u": "1", "y": "m", "current": "A"}}  # fmt: skip
    return make(n, **{**given, **fields})


def same(a, b):
    assert (a.dt, a.hold, a.name, a.start) == (b.dt, b.hold, b.name, b.start)
    assert dict(a.names) == dict(b.names)
    assert dict(a.units) == dict(b.units)
    assert list(a.extra) == list(b.extra)
    for key in ("r", "u", "y", "valid"):
        np.testing.assert_array_equal(getattr(a, key), getattr(b, key))
    for key, values in a.extra.items():
        np.testing.assert_array_equal(values, b.extra[key])


def channels(record):
    return [record.r, record.u, record.y, record.valid, *record.extra.values()]


# --- what it holds ----------------------------------------------------------------------------


def test_fields():
    record = make(4, start=2.0)
    assert len(record) == record.n == 4
    assert record.duration == pytest.approx(0.4)
    np.testing.assert_allclose(record.t, [2.0, 2.1, 2.2, 2.3])
    assert record.hold == "zoh"
    assert record.valid.all()
    assert record.u.dtype == record.r.dtype == float


def test_arrays_are_read_only_copies():
    u = np.ones(5)
    record = cid.Record(u=u, y=[1, 2, 3, 4, 5], dt=1, extra={"i": u}, valid=u > 0)
    u[:] = 7
    assert record.u.max() == record.extra["i"].max() == 1
    for values in (record.u, record.y, record.valid, record.extra["i"]):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 5
    with pytest.raises(TypeError, match="item assignment"):
        record.extra["i"] = u
    with pytest.raises(TypeError, match="item assignment"):
        record.units["y"] = "m"
    with pytest.raises(AttributeError):
        record.dt = 2


def test_mappings_are_copies():
    units = {"y": "m"}
    record = make(units=units)
    units["y"] = "ft"
    assert record.units["y"] == "m"


@pytest.mark.parametrize(
    "clone", [copy.copy, copy.deepcopy, lambda r: pickle.loads(pickle.dumps(r))]
)
def test_copies(clone):
    record = full()
    twin = clone(record)
    same(record, twin)
    assert not any(values.flags.writeable for values in channels(twin))


def test_few_samples_that_do_not_count_are_not_rounded_away():
    valid = np.ones(5000, dtype=bool)
    valid[:2] = False
    record = cid.Record(u=np.zeros(5000), y=np.zeros(5000), dt=0.1, valid=valid)
    assert "all but 2 valid" in str(record)


def test_text():
    assert str(full(8)) == repr(full(8)) == "\n".join([
        "Record run 3, second try: 8 samples at 0.1 s (0.8 s, foh), 87.5 % valid; ranges of these:",
        "  r         -1 .. 1 m",
        "  u (duty)  -0.958924 .. 0.909297",
        "  y (gap)   -0.653644 .. 1 m",
        "  current   0 .. 2.33333 A",
        "  x[0]      -1 .. 0",
    ])  # fmt: skip
    assert repr(make(8, r=None)).startswith("Record 8 samples at 0.1 s (0.8 s, zoh)\n  u  ")


# --- what it refuses --------------------------------------------------------------------------

HOLES = np.array([0.0, np.nan, 1.0, np.inf])


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"u": None}, "needs u and y; u is None"),
        ({"y": HOLES}, r"y must be finite; 2 of 4 values are NaN or infinite, the first at sample 1"
                       r"\. Cut them out by slicing, or fill them and exclude .* with valid="),
        ({"extra": {"i": HOLES}}, r"extra\['i'\] must be finite"),
        ({"u": np.ones((4, 2))}, r"u has shape \(4, 2\): several .* Give u.T, or pick .*\[:, 0"),
        ({"u": np.ones((2, 2, 4))}, r"u must be one-dimensional .* shape \(2, 2, 4\). Pick one"),
        ({"u": np.ones((0, 4))}, r"u has shape \(0, 4\)"),
        ({"u": 1.0}, r"one value per sample; given shape \(\). Repeat it with np.full"),
        ({"u": [[1, 2], [3]]}, "u must be one array of numbers: "),
        ({"u": np.ones(N) + 0j}, "u must be an array of real numbers; given complex128 data"),
        ({"u": ["a"] * N}, "real numbers; given <U1 data"),
        ({"u": [None] * N}, "real numbers; given object data"),
        ({"u": np.ma.masked_less(np.arange(N), 3)}, "u is a masked array.*and give valid"),
        ({"u": np.ones(N + 1)}, "equally long; given r: 40, u: 41, y: 40. Cut them"),
        ({"extra": {"i": np.ones(3)}}, "equally long; given r: 40, u: 40, y: 40, i: 3"),
        ({"r": [0], "u": [0], "y": [0]}, "at least 2 samples; given 1"),
        ({"dt": 0}, "dt is the sampling period in seconds, > 0; given 0"),
        ({"dt": -0.1}, "> 0; given -0.1"),
        ({"dt": np.inf}, "dt is the sampling period in seconds, a finite number; given inf"),
        ({"dt": "1 ms"}, "a finite number; given '1 ms'"),
        ({"dt": 1j}, "a finite number; given 1j"),
        ({"dt": True}, "a finite number; given True"),
        ({"start": np.nan}, "start is the time of sample 0 in seconds, a finite number; given nan"),
        ({"start": "now"}, "a finite number; given 'now'"),
        ({"hold": "linear"}, r"hold must be 'zoh' \(held between samples\), 'foh' \(straight\) or "
                             "'bandlimited'; given 'linear'"),
        ({"valid": np.ones(N)}, r"valid must be 40 booleans, one per sample; given float64 of "
                                r"shape \(40,\). A comparison makes booleans"),
        ({"valid": [True]}, r"given bool of shape \(1,\)"),
        ({"names": {"v": "speed"}}, r"names has 'v', .* does not have; its signals are r, u, y"),
        ({"names": "force"}, "names maps signals to words, .*given 'force'"),
        ({"units": {"i": "A"}}, r"units has 'i', .* does not have; its signals are r, u, y"),
        ({"units": {"y": 1}}, "units maps signals to words, as in {'y': 'm'}; given {'y': 1}"),
        ({"extra": {"u": np.ones(N)}}, r"names other than r, u, y, t, time, valid; given \['u'\]"),
        ({"extra": {0: np.ones(N)}}, r"names other than .* given \[0\]"),
        ({"extra": [np.ones(N)]}, "extra maps names to channels, .*given list"),
        ({"r": {"rpos": np.ones(N)}}, "r is an array, given a mapping of rpos: give the series "
                                      "alone, .* in names={'r': 'rpos'}"),
        ({"y": {"a": 1, "b": 2}}, r"in names={'y': \('a', 'b'\)}"),
        ({"name": 3}, "name is the experiment's name in words; given 3"),
    ],
)  # fmt: skip
def test_refusals(fields, words):
    with pytest.raises(cid.CtrlidError, match=words):
        make(**fields)


def test_keywords_only():
    with pytest.raises(cid.CtrlidError, match=r"Record\(r=.*, dt=.*; given 3 values without"):
        cid.Record(np.ones(3), np.ones(3), 0.1)


# --- parts of it ------------------------------------------------------------------------------


def test_slices():
    record = full()
    part = record[10:30]
    assert len(part) == 20
    assert part.start == pytest.approx(2.7)
    for whole, cut in zip(channels(record), channels(part), strict=True):
        np.testing.assert_array_equal(whole[10:30], cut)
        assert not cut.flags.writeable
        assert not np.shares_memory(whole, cut)
    same(record[:], record)
    np.testing.assert_array_equal(record[-5:].y, record.y[-5:])
    np.testing.assert_array_equal(record[: np.int64(5)].y, record.y[:5])


@given(a=st.integers(0, 15), b=st.integers(22, 40), c=st.integers(0, 5), d=st.integers(10, 15))
@settings(deadline=None, max_examples=30)
def test_slices_of_slices(a, b, c, d):
    record = full()
    part = record[a:b][c:d]
    direct = record[a + c : min(a + d, b)]
    np.testing.assert_array_equal(part.y, direct.y)
    np.testing.assert_allclose(part.t, direct.t, rtol=1e-14)


@pytest.mark.parametrize(
    ("index", "words"),
    [
        (3, r"sliced by samples, record\[100:2000\]; given 3. Single values are in record.y"),
        (slice(None, None, 2), r"a step of 2 would alias; use record.decimate\(q\)"),
        (slice(0.5, 2.0), r"whole sample numbers; given slice\(0.5.*record.between\(t0, t1\)"),
        (slice(5, 6), "at least 2 samples; the slice 5:6 of 40 leaves 1"),
        (slice(9, 3), "the slice 9:3 of 40 leaves 0"),
    ],
)
def test_refused_slices(index, words):
    with pytest.raises(cid.CtrlidError, match=words):
        make()[index]


def test_between_is_half_open():
    record = make(start=5.0)
    part = record.between(5.3, 6.1)
    assert (len(part), part.start) == (8, pytest.approx(5.3))
    assert len(record.between(-np.inf, np.inf)) == len(record)
    assert len(record.between(8.0, np.inf)) == 10
    assert len(record.between(5.25, 5.55)) == 3


@given(
    dt=st.sampled_from([0.1, 0.003, 1e-3, 7.0]), start=st.sampled_from([0.0, 1.7, -3.3, 1.6e9]),
    a=st.integers(0, 500), length=st.integers(2, 400),
)  # fmt: skip
@settings(deadline=None)
def test_between_is_not_a_sample_off_by_rounding(dt, start, a, length):
    record = make(1000, dt=dt, start=start)
    t = record.t
    part = record.between(t[a], t[a + length])
    np.testing.assert_array_equal(part.y, record.y[a : a + length])
    part = record.between(start + a * dt, start + (a + length) * dt)
    np.testing.assert_array_equal(part.y, record.y[a : a + length])


@pytest.mark.parametrize(
    ("t0", "t1", "words"),
    [
        (1, 1, "needs t0 < t1 in seconds; given 1 and 1"),
        (np.nan, 1, "needs t0 < t1 in seconds; given nan and 1"),
        (4, 9, "fewer than 2 samples lie between 4 and 9 s; the record runs from 0 to 4 s"),
        (1.0, 1.1, "fewer than 2 samples lie between 1 and 1.1 s"),
    ],
)
def test_refused_times(t0, t1, words):
    with pytest.raises(cid.CtrlidError, match=words):
        make().between(t0, t1)


def test_split():
    record = full()
    first, second = record.split()
    assert (len(first), len(second)) == (20, 20)
    np.testing.assert_array_equal(np.concatenate([first.y, second.y]), record.y)
    assert second.start == pytest.approx(first.start + first.duration)
    assert [len(p) for p in record.split(0.1, 0.7)] == [4, 24, 12]


@pytest.mark.parametrize("fractions", [(0,), (1,), (0.5, 0.5), (0.7, 0.2), (np.nan,), (30,)])
def test_refused_fractions(fractions):
    with pytest.raises(cid.CtrlidError, match="increasing fractions between 0 and 1; given"):
        make().split(*fractions)


def test_split_too_small():
    with pytest.raises(cid.CtrlidError, match="at least 2 samples"):
        make().split(0.01)


def test_segments():
    valid = np.array([0, 1, 1, 0, 0, 1, 0, 1, 1, 1], dtype=bool)
    assert make(10, valid=valid).segments() == [(1, 3), (5, 6), (7, 10)]
    assert make(10).segments() == [(0, 10)]
    assert make(10, valid=np.zeros(10, dtype=bool)).segments() == []


@given(arrays(bool, st.integers(2, 30)))
@settings(deadline=None)
def test_segments_are_the_valid_samples(valid):
    rebuilt = np.zeros(len(valid), dtype=bool)
    stops = [-1]
    for start, stop in make(len(valid), valid=valid).segments():
        assert stops[-1] < start < stop  # apart, hence maximal
        rebuilt[start:stop] = True
        stops.append(stop)
    np.testing.assert_array_equal(rebuilt, valid)


# --- other channels as input and output -------------------------------------------------------


def test_with_input():
    record = full()
    swapped = record.with_input("current")
    np.testing.assert_array_equal(swapped.u, record.extra["current"])
    np.testing.assert_array_equal(swapped.extra["duty"], record.u)
    assert swapped.names["u"] == "current"
    assert dict(swapped.units) == {"r": "m", "y": "m", "duty": "1", "u": "A"}
    back = swapped.with_input("duty")
    same(back, record)


def test_with_output():
    record = full()
    swapped = record.with_output("x[0]")
    np.testing.assert_array_equal(swapped.y, record.extra["x[0]"])
    np.testing.assert_array_equal(swapped.extra["gap"], record.y)
    assert "y" not in swapped.units
    assert swapped.units["gap"] == "m"


@pytest.mark.parametrize("names", [{}, {"u": "u", "y": "y"}])
def test_unnamed_signals_move_under_plain_words(names):
    record = make(extra={"current": np.ones(N)}, names=names)
    assert list(record.with_input("current").extra) == ["input"]
    assert list(record.with_output("current").extra) == ["output"]


@pytest.mark.parametrize("old", ["x[0]", "y", "valid"])
def test_nothing_is_overwritten(old):
    record = full(names={"u": old})
    words = (
        r"the old u would be kept as the extra channel .* taken; give it another name first, with"
    )
    with pytest.raises(cid.CtrlidError, match=words):
        record.with_input("current")


def test_no_such_channel():
    with pytest.raises(cid.CtrlidError, match=r"no extra channel 'i'; it has current, x\[0\]"):
        full().with_input("i")
    with pytest.raises(cid.CtrlidError, match="no extra channel 'i'; it has none"):
        make().with_output("i")


# --- slower -----------------------------------------------------------------------------------


@pytest.mark.parametrize("q", [2, 3, 10])
@pytest.mark.parametrize("share", [0.1, 0.4, 0.65, 1.0, 1.2, 1.9])
def test_decimate_keeps_slow_sines_and_stops_fast_ones(q, share):
    nyquist = np.pi / (0.1 * q)
    t = 0.1 * np.arange(200 * q)
    sine = np.sin(share * nyquist * t + 0.3)
    slow = cid.Record(r=2 * sine, u=sine, y=-sine, dt=0.1, extra={"i": sine}).decimate(q)
    assert slow.dt == pytest.approx(0.1 * q)
    assert len(slow) == 200
    expected = np.sin(share * nyquist * slow.t + 0.3) if share < 1 else np.zeros(200)
    # 50 dB: a ripple of 0.3 % in the pass band, as much of what is stopped.
    np.testing.assert_allclose(slow.u[slow.valid], expected[slow.valid], atol=3.2e-3)
    # One filter for all: the channels keep their relation.
    np.testing.assert_allclose(slow.r, 2 * slow.u, atol=1e-12)
    np.testing.assert_allclose(slow.y, -slow.u, atol=1e-12)
    np.testing.assert_allclose(slow.extra["i"], slow.u, atol=1e-12)


def test_without_filter_a_fast_sine_folds_down():
    t = 0.1 * np.arange(400)
    y = np.sin(1.9 * np.pi / 0.2 * t)
    record = cid.Record(u=y, y=y, dt=0.1, valid=t < 20, start=3.0)
    slow = record.decimate(2, antialias=False)
    np.testing.assert_array_equal(slow.y, y[::2])
    np.testing.assert_array_equal(slow.valid, record.valid[::2])
    np.testing.assert_array_equal(slow.t, record.t[::2])
    # Filtered, an input runs smoothly between the samples; taken as it is, nobody knows.
    assert (slow.hold, record.decimate(2).hold) == ("zoh", "foh")


@given(level=st.floats(-1e6, 1e6), q=st.integers(2, 12))
@settings(deadline=None, max_examples=30)
def test_a_constant_stays_exactly_constant(level, q):
    slow = cid.Record(u=np.full(400, level), y=np.zeros(400), dt=1e-3).decimate(q)
    assert set(slow.u) == {level}


@given(offset=st.floats(-1e3, 1e3), q=st.integers(2, 8))
@settings(deadline=None, max_examples=20)
def test_an_offset_passes_by_the_filter(offset, q):
    record = make(300)
    moved = make(300, y=record.y + offset).decimate(q)
    np.testing.assert_allclose(moved.y, record.decimate(q).y + offset, atol=1e-9)


def test_a_slope_is_not_bent_at_the_edges():
    ramp = 5 + 0.25 * np.arange(300)
    slow = cid.Record(u=ramp, y=ramp, dt=1).decimate(5)
    np.testing.assert_allclose(slow.y, ramp[::5], rtol=1e-12)


@given(
    valid=arrays(bool, 100, elements=st.sampled_from([True] * 40 + [False])), q=st.integers(2, 4)
)
@settings(deadline=None)
def test_a_sample_counts_where_all_under_the_filter_count(valid, q):
    half = 10 * q
    expected = [
        k - half >= 0 and k + half < 100 and bool(valid[k - half : k + half + 1].all())
        for k in range(0, 100, q)
    ]
    record = make(100, valid=valid)
    if any(expected):
        np.testing.assert_array_equal(record.decimate(q).valid, expected)
    else:
        with pytest.raises(cid.CtrlidError, match="no valid sample"):
            record.decimate(q)


def test_what_does_not_count_cannot_leak_in():
    record = make(400)
    valid = np.ones(400, dtype=bool)
    valid[200:203] = False
    spoilt = np.where(valid, record.y, 1e3)
    clean, spoilt = record.decimate(4), make(400, y=spoilt, valid=valid).decimate(4)
    np.testing.assert_allclose(spoilt.y[spoilt.valid], clean.y[spoilt.valid], atol=1e-9)
    assert spoilt.valid.sum() == 100 - 20 - 21


def test_decimate_by_one():
    record = make()
    assert record.decimate(1) is record


@pytest.mark.parametrize("q", [0, -2, 1.5, 2.0, 21, "2"])
def test_refused_factors(q):
    with pytest.raises(cid.CtrlidError, match="a whole factor from 1 to 20 for 40 samples; given"):
        make().decimate(q)


def test_too_short_for_the_filter():
    words = (r"decimate\(4\) would leave no valid sample: its filter spans 81 samples and "
             r"the longest valid stretch has 40. Use a smaller factor")  # fmt: skip
    with pytest.raises(cid.CtrlidError, match=words):
        make().decimate(4)


# --- CSV files: see also test_csv.py ----------------------------------------------------------


def test_a_record_with_everything_comes_back_from_a_file(tmp_path):
    record = full()
    record.to_csv(tmp_path / "a.csv")
    same(cid.Record.from_csv(tmp_path / "a.csv"), record)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[1] == "t [s],r [m],u [1],y [m],current [A],x[0],valid"
    assert lines[2].startswith("1.7,0.0,0.0,1.0,0.0,")


@pytest.mark.parametrize("key", ["a [m]", "a (m)", "a[b]", 'a "b"', "a, b"])
def test_names_that_look_like_units_come_back_too(tmp_path, key):
    record = make(extra={key: np.ones(N)})
    record.to_csv(tmp_path / "a.csv")
    same(cid.Record.from_csv(tmp_path / "a.csv"), record)


def test_a_file_may_have_more_rows_than_are_written_at_once(tmp_path):
    record = make(50_001)
    record.to_csv(tmp_path / "a.csv")
    same(cid.Record.from_csv(tmp_path / "a.csv"), record)


def test_a_swapped_column_keeps_its_own_name(tmp_path):
    (tmp_path / "log.csv").write_text("t [s],duty,gap,i [A]\n0,1,2,3\n1,2,3,4\n")
    record = cid.Record.from_csv(tmp_path / "log.csv", u="duty", y="gap", extra=["i"])
    swapped = record.with_input("i")
    assert list(swapped.extra) == ["duty"]
    assert swapped.units["u"] == "A"


def test_rows_taken_out_of_our_own_file_are_noticed(tmp_path):
    path = tmp_path / "a.csv"
    full(valid=None).to_csv(path)
    text = path.read_text()
    lines = text.splitlines(keepends=True)
    path.write_text("".join(lines[:10] + lines[14:]))
    with pytest.raises(cid.CtrlidError, match="says 40 rows, and it has 36"):
        cid.Record.from_csv(path)
    lines = text.replace(', "rows": 40', "").splitlines(keepends=True)
    path.write_text("".join(lines[:10] + lines[14:]))
    with pytest.raises(cid.CtrlidError, match="lacks 4 samples in one place"):
        cid.Record.from_csv(path)
    path.write_text("".join(lines[:2] + lines[7:]))
    record = cid.Record.from_csv(path)
    assert (record.dt, record.start) == (0.1, pytest.approx(2.2))


# --- python-control's responses ---------------------------------------------------------------


def test_response_round_trip():
    record = full(extra={}, valid=None, hold="zoh", units={"u": "V", "y": "m"})
    response = record.to_response()
    assert response.output_labels == ["gap [m]"]
    assert response.input_labels == ["duty [V]", "r"]
    np.testing.assert_array_equal(response.time, record.t)
    np.testing.assert_array_equal(response.outputs[0], record.y)
    back = cid.Record.from_response(response, y="gap", u="duty [V]", name=record.name)
    np.testing.assert_allclose(back.dt, record.dt)
    for key in ("r", "u", "y"):
        np.testing.assert_array_equal(getattr(back, key), getattr(record, key))
    assert (dict(back.names), dict(back.units)) == (dict(record.names), dict(record.units))
    assert back.start == record.start
    bare = make(r=None)
    same(cid.Record.from_response(bare.to_response()), bare)
    alike = make(names={"u": "x", "r": "x"}).to_response()
    assert alike.input_labels == ["u", "r"]


def test_one_input_one_output_needs_no_names():
    plant = ct.tf([1], [1, 1], inputs="force", outputs="speed")
    t = np.arange(20) * 0.1
    for response in (ct.step_response(plant, t), ct.forced_response(plant, t, np.ones(20))):
        record = cid.Record.from_response(response)
        assert record.r is None
        assert dict(record.names) == {"u": "force", "y": "speed"}
        np.testing.assert_allclose(record.y, 1 - np.exp(-t), atol=1e-9)
        np.testing.assert_array_equal(record.u, 1)
        assert record.dt == 0.1


def loop_response(outputs):
    plant = ct.tf([1], [1, 1], inputs="u", outputs="y", name="plant")
    controller = ct.tf([5], [1], inputs="e", outputs="u", name="controller")
    error = ct.summing_junction(["r", "-y"], "e")
    loop = ct.interconnect([plant, controller, error], inputs=["r"], outputs=outputs)
    return ct.forced_response(loop, np.arange(20) * 0.1, np.ones(20))


def test_a_closed_loop_is_recognised_by_its_labels():
    record = cid.Record.from_response(loop_response(["y", "u"]))
    np.testing.assert_array_equal(record.r, 1)
    np.testing.assert_allclose(record.u, 5 * (record.r - record.y), atol=1e-9)
    assert dict(record.names) == {}
    named = cid.Record.from_response(loop_response(["y", "u", "e"]), u="e", hold="foh", start=2)
    np.testing.assert_allclose(named.u, record.r - record.y, atol=1e-9)
    assert (named.hold, named.start, dict(named.names)) == ("foh", 2, {"u": "e"})


def test_a_reference_is_never_taken_for_the_input():
    words = r"which signal .* is u \(given u=None\); .* inputs \['r'\] or of the outputs \['y'\]"
    with pytest.raises(cid.CtrlidError, match=words):
        cid.Record.from_response(loop_response(["y"]))


@pytest.mark.parametrize(
    ("response", "options", "words"),
    [
        (loop_response(["y", "u"]), {"y": "x"}, r"of the response is y \(given y='x'\); name one"),
        (loop_response(["y", "u"]), {"r": "x"}, r"of the response is r \(given r='x'\)"),
        (ct.initial_response(ct.ss(-1, 1, 1, 0), [0, 1, 2], [1]), {}, "of the response is u"),
        (ct.step_response(ct.ss([[-1.0]], [[1, 2]], 1, [[0, 0]]), [0, 1, 2]), {},
         "one experiment; the response has 2 traces. Compute it for one input at a time"),
        (ct.forced_response(ct.ss(-1, [[1, 2]], 1, [[0, 0]]), [0, 1, 2], np.ones((2, 3))),
         {"u": ["u[0]", "x"]},
         r"is u \(given u=\['u\[0\]', 'x'\]\); name one of the inputs \['u\[0\]', 'u\[1\]'\]"),
        (ct.TimeResponseData([0, 1, 3], [[0, 1, 2]], inputs=[[1, 1, 1]], issiso=True), {},
         "sampled uniformly, but the times of the response are 1 to 2 s apart. Compute it at"),
        (ct.TimeResponseData([0], [[0]], inputs=[[1]], issiso=True), {}, "at least 2 samples; the"),
        (ct.TimeResponseData([0, 1], [[0, 1]], inputs=[[1, 1]], issiso=True, input_labels=["x"],
                             output_labels=["x"]), {}, "input and an output called 'x' that diff"),
    ],
)  # fmt: skip
def test_refused_responses(response, options, words):
    with pytest.raises(cid.CtrlidError, match=words):
        cid.Record.from_response(response, **options)


def test_arrays_are_no_response():
    with pytest.raises(cid.CtrlidError, match=r"takes a control.TimeResponseData, .* given tuple"):
        cid.Record.from_response(([0, 1], [2, 3]))


# --- several records, labels ------------------------------------------------------------------


def test_as_records():
    one, two = make(), make(60)
    assert as_records(one) == (one,)
    assert as_records([one, two]) == as_records((one, two)) == (one, two)
    nearly = make(dt=0.1 * (1 + 1e-9))
    assert as_records([one, nearly]) == (one, nearly)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ([], "a Record or a list of Records is needed; the list given is empty"),
        (
            np.ones(3),
            r"needed; given ndarray. Make one with Record\(u=, y=, dt=\) or Record.from_csv",
        ),
        (None, "needed; given NoneType"),
        ([make(), np.ones(3), 4], "the list given has ndarray, int"),
        (
            [make(), make(dt=0.2)],
            "the same sampling period and the same hold; given 0.1 s, 'zoh' and 0.2 s, 'zoh'. De",
        ),
        ([make(), make(hold="foh")], "given 0.1 s, 'zoh' and 0.1 s, 'foh'"),
    ],
)
def test_refused_lists(data, words):
    with pytest.raises(cid.CtrlidError, match=words):
        as_records(data)


WORDS = st.text(st.characters(exclude_categories=["C", "Z"], exclude_characters="[]()"), min_size=1)


@given(name=WORDS, unit=st.just("") | WORDS)
@settings(deadline=None)
def test_labels_come_apart_again(name, unit):
    assert split_unit(with_unit(name, unit)) == (name, unit)


@pytest.mark.parametrize(
    ("label", "parts"),
    [
        ("u[V]", ("u", "V")),
        ("u (V)", ("u", "V")),
        ("x[0]", ("x[0]", "")),
        ("u [1]", ("u", "1")),
        ("sin(x)", ("sin(x)", "")),
        ("x[0] [m/s^2]", ("x[0]", "m/s^2")),
        ("[V]", ("[V]", "")),
        ("", ("", "")),
    ],
)
def test_labels_of_other_tools(label, parts):
    assert split_unit(label) == parts


# --- instants of sampling


def test_uneven_instants_are_refused_with_their_size():
    rng = np.random.default_rng(0)
    t = 0.01 * np.arange(100) + 0.001 * rng.uniform(-1, 1, 100)
    x = np.sin(t)
    with pytest.raises(cid.CtrlidError, match=r"off such a grid by up to [12]\d? ?%.*numpy.interp"):
        cid.Record(t=t, u=x, y=x)
    with pytest.raises(cid.CtrlidError, match=r"Give dt=0\.01"):
        cid.Record(t=0.01 * np.arange(100), u=x, y=x)
    for wrong in (None, "abc", t[::-1]):
        with pytest.raises(cid.CtrlidError, match=r"has no t=.*give dt=|has no t=.*Give dt="):
            cid.Record(t=wrong, u=x, y=x)
    with pytest.raises(cid.CtrlidError, match="did you mean units"):
        cid.Record(u=x, y=x, dt=0.01, unit={"y": "m"})


def test_a_decimated_reference_runs_straight_between_samples():
    """Held, it made the exact analog loop look wrong: 11 mm of RMS error in place of 1."""
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    loop = cid.Loop(plant, ct.tf([20.0], [1]), dt=0.002)
    r = cid.random_binary(4000, amplitude=0.1, hold=100, seed=1)
    record = cid.simulate(loop, r, sensor_noise=1e-5, seed=1).decimate(10)
    assert (record.hold, record.hold_r) == ("foh", "foh")
    found = cid.compare(record, replace(loop, dt=record.dt))
    assert found["closed-loop simulation"].rms < 2e-3
