"""CSV files: exact round trips, files that other tools write, and clocks that are not regular."""

import re
import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

import ctrlid as cid
from ctrlid import CtrlidError, CtrlidWarning, Record

WORDS = st.text(
    st.characters(codec="utf-8", exclude_categories=["C", "Z"], exclude_characters="[]()"),
    min_size=1, max_size=8,
)  # fmt: skip
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def records(draw):
    n = draw(st.integers(2, 12))
    column = st.lists(NUMBERS, min_size=n, max_size=n)
    taken = {"r", "u", "y", "t", "time", "valid"}
    names = draw(st.lists(WORDS.filter(lambda w: w.lower() not in taken), max_size=3, unique=True))
    has_r = draw(st.booleans())
    labels = [*(["r"] if has_r else []), "u", "y"]
    return Record(
        r=draw(column) if has_r else None, u=draw(column), y=draw(column),
        dt=draw(st.floats(1e-9, 1e6)), start=draw(st.floats(-1e6, 1e6)),
        hold=draw(st.sampled_from(["zoh", "foh"])), extra={k: draw(column) for k in names},
        valid=draw(st.lists(st.booleans(), min_size=n, max_size=n)),
        names={k: draw(st.text(max_size=8)) for k in labels if draw(st.booleans())},
        units={k: draw(WORDS) for k in [*labels, *names] if draw(st.booleans())},
        name=draw(st.text(max_size=10)),
    )  # fmt: skip


@settings(
    deadline=None,
    max_examples=150,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(record=records())
def test_round_trip_is_exact(tmp_path, record):
    assume(np.all(np.diff(record.t) > 0))  # else a clock beyond its digits
    path = tmp_path / "r.csv"
    record.to_csv(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CtrlidWarning)  # a clock with few digits left
        twin = Record.from_csv(path)
    for key in ("r", "u", "y", "valid"):
        np.testing.assert_array_equal(getattr(twin, key), getattr(record, key))
    for key in ("dt", "start", "hold", "name", "names", "units"):
        assert getattr(twin, key) == getattr(record, key), key
    assert list(twin.extra) == list(record.extra)
    for key, values in record.extra.items():
        np.testing.assert_array_equal(twin.extra[key], values)


def write(tmp_path, text, name="log.csv", **options):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8"))
    return Record.from_csv(path, **options)


ROWS = "0,1,2,3\n0.1,4,5,6\n0.2,7,8,9\n"


@pytest.mark.parametrize(
    "text",
    [
        "t,r,u,y\n" + ROWS,
        "t;r;u;y\n" + ROWS.replace(",", ";"),
        "t;r;u;y\n" + ROWS.replace(",", ";").replace("0.", "0,"),  # decimal commas
        "t\tr\tu\ty\n" + ROWS.replace(",", "\t"),
        "\ufefft,r,u,y\n" + ROWS,
        "t, r, u, y\r\n" + ROWS.replace("\n", "\r\n"),
        '"t","r","u","y"\n' + ROWS,
        "# a log of mine\n# dt = fast\n\nt,r,u,y\n" + ROWS + "\n",
        "# t,r,u,y\n" + ROWS,  # as numpy.savetxt writes it
        "Time,r,u,y\n" + ROWS.rstrip("\n"),
        "time [ms],r,u,y\n0,1,2,3\n100,4,5,6\n200,7,8,9\n",
        "t (s),r,u,y\n" + ROWS,
    ],
)
def test_files_of_other_tools(tmp_path, text):
    record = write(tmp_path, text)
    assert record.dt == pytest.approx(0.1, rel=1e-12)
    np.testing.assert_array_equal(record.r, [1, 4, 7])
    np.testing.assert_array_equal(record.u, [2, 5, 8])
    np.testing.assert_array_equal(record.y, [3, 6, 9])
    assert (record.name, record.hold, record.start) == ("log", "zoh", 0.0)
    assert record.valid.all()


def test_columns_by_name_with_units_and_old_encodings(tmp_path):
    text = "t [s],Soll [µm],Spannung [V],Weg [µm],Strom [A]\n5,1,2,3,4\n5.5,1,2,3,5\n"
    with pytest.warns(CtrlidWarning, match="y is in µm by the header"):
        record = write(tmp_path, text.encode("cp1252"), u="Spannung", y="Weg", r="Soll",
                       extra=["Strom"], hold="foh", name="mine", units={"y": "m"})  # fmt: skip
    assert dict(record.units) == {"u": "V", "y": "m", "r": "µm", "Strom": "A"}
    assert dict(record.names) == {"u": "Spannung", "y": "Weg", "r": "Soll"}
    assert (record.hold, record.name, record.start, record.dt) == ("foh", "mine", 5.0, 0.5)
    np.testing.assert_array_equal(record.extra["Strom"], [4, 5])
    single = write(tmp_path, text, u="Spannung", y="Weg", extra="Strom")
    assert list(single.extra) == ["Strom"]
    assert single.r is None


def test_dt_without_a_time_column_and_a_valid_column(tmp_path):
    record = write(tmp_path, "u,y,valid\n1,2,1\n3,4,0\n5,6,1\n", dt=0.02)
    assert record.dt == 0.02
    np.testing.assert_array_equal(record.valid, [True, False, True])


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("t,u\n" + "0,1\n1,2\n", {}, "has no column 'y' for y; its columns are t, u. .* with y="),
        ("t,u,u,y\n" + ROWS, {}, "has several columns 'u' for u"),
        ("0,1,2\n1,2,3\n", {}, "has no header line: its first line is '0,1,2'. Add one"),
        ("t,u,y\n0,1,2\n1,x,3\n", {}, "is not a table of numbers: .*'x'"),
        ("t,u,y\ns,V,m\n0,1,2\n1,2,3\n", {}, "row of units: delete them or start them with #"),
        ("my rig, 5 V\nt,u,y\n0,1,2\n1,2,3\n", {}, "lines above the header or a row of units"),
        ("My rig\nt,u,y\n0,1,2\n", {}, "a line above the header, delete it or start it with #"),
        ("Rig; 4711\n2026-11-25 10:00\n\nt;u;y\n0;1;2\n", {}, "above the header: delete it"),
        ("t,u,y\n12:00:01,1,2\n", {"dt": 1.0}, "remove the column from the file and give dt="),
        ("t,u,y\n0,1,2\n10,1,2\n20,1,2\n", {"dt": 0.01}, r"another unit, .* as in 't \[ms\]'"),
        ("t,u,y\n0,1,2\n1,,3\n", {}, "has no number for u in row 2"),
        ("t,u,y\n0,1,2\n1,3\n", {}, "is not a table of numbers"),
        ("t,u,y\n0.5,1,2,9\n1.5,3,3,9\n", {}, "names 3 columns, its rows have 4; give every"),
        ("t,u,y\n", {}, "has no rows of numbers below its header"),
        ("", {}, "has no header line"),
        ("u,y\n1,2\n3,4\n", {}, r"has no time column \(t, time, .*\); its columns are u, y. Name"),
        ("t,u,y\n0,1,2\n1,3,4\n", {"time": "clock"}, "no column 'clock' for time"),
        ("t,u,y\n0,1,2\n1,3,4\n", {"extra": ["i"]}, "no column 'i' for extra"),
        ("t,u,y\n0,1,2\n1,3,4\n", {"gaps": "fill"}, "gaps must be 'error' or 'mask'; given 'fill'"),
        ("t [days],u,y\n0,1,2\n1,3,4\n", {}, "is in 'days'; known units are s, .* give dt="),
        ("t,u,y\n0,1,2\n", {}, "needs at least 2 values, all finite"),
        ("t,u,y\n0,1,2\nnan,3,4\n", {}, "needs at least 2 values, all finite"),
        ("t,u,y\n0,1,2\n1,nan,4\n", {}, "has no number for u in row 2"),
        ("t,u,y\n0,1,2\n2,3,4\n1,3,4\n", {},
         "does not increase: 2 s in row 2 of the data is followed by 1 s. Sort the rows"),
        ("t,u,y\n0,1,2\n0,3,4\n1,3,4\n", {}, "does not increase: 0 s in row 1"),
        ("t,u,y\n0,1,2\n1,3,4\n2,5,6\n", {"dt": 0.001}, "steps by 1 s, but dt is 0.001 s"),
        ("t,u,y\n0,1,2\n1,3,4\n2,5,6\n", {"dt": 5e-324}, "steps by 1 s, but dt is 4.94"),
        ('# ctrlid {"dt": \nt,u,y\n0,1,2\n', {}, "is damaged: .*. Restore or remove it"),
    ],
)  # fmt: skip
def test_refusals(tmp_path, text, options, words):
    with pytest.raises(CtrlidError, match=words):
        write(tmp_path, text, **options)


def test_a_missing_file_and_names_that_break_a_header(tmp_path):
    with pytest.raises(CtrlidError, match=r"cannot read .*nothing.csv: No such file"):
        Record.from_csv(tmp_path / "nothing.csv")
    record = Record(u=[1, 2], y=[3, 4], dt=1.0, extra={"a ": [1, 2]})
    with pytest.raises(CtrlidError, match="would not be read back as it is: remove brackets"):
        record.to_csv(tmp_path / "x.csv")


def clock(tmp_path, stamps, digits=None, **options):
    def shown(t):
        return repr(float(t)) if digits is None else f"{t:.{digits}f}"

    rows = "".join(f"{shown(t)},{k},{2 * k}\n" for k, t in enumerate(stamps))
    return write(tmp_path, "t [s],u,y\n" + rows, **options)


@pytest.mark.parametrize("start", [0.0, 17.3, 1.7e9])
@pytest.mark.parametrize("dt", [1e-3, 3.25e-3, 0.1, 1 / 3])
def test_a_regular_clock_is_read_exactly_and_quietly(tmp_path, start, dt):
    record = clock(tmp_path, start + dt * np.arange(2000))
    assert record.dt == pytest.approx(dt, rel=1e-12 if start < 100 else 2e-6 * 0.01 / dt)
    assert record.start == start


@pytest.mark.parametrize("n", [30, 1500])
@pytest.mark.parametrize(("dt", "digits"), [(3.25e-3, 3), (1.5e-3, 3), (0.0125, 2), (1 / 3, 2)])
@pytest.mark.filterwarnings("ignore:.*Read as the slower clock")
def test_rounded_times_are_a_regular_clock(tmp_path, dt, digits, n):
    record = clock(tmp_path, dt * np.arange(n), digits)
    assert len(record) == n
    # What the first and the last stamp leave open.
    assert record.dt == pytest.approx(dt, abs=1.1 * 10.0**-digits / (n - 1))
    if n == 1500 and dt != 1 / 3:
        assert record.dt == dt
    floor = np.floor(dt * np.arange(n) * 10**digits) / 10**digits
    assert clock(tmp_path, floor, digits).dt == pytest.approx(dt, abs=1.1 * 10.0**-digits / (n - 1))


def test_a_short_clock_keeps_its_digits(tmp_path):
    assert clock(tmp_path, [0, 11]).dt == 11
    assert clock(tmp_path, [0, 0.26]).dt == 0.26
    assert clock(tmp_path, [0, 0.003, 0.007]).dt == pytest.approx(0.0035)


def test_a_given_period_is_kept_where_the_times_agree(tmp_path):
    assert clock(tmp_path, 3.25e-3 * np.arange(100), 3, dt=3.25e-3).dt == 3.25e-3
    with pytest.raises(CtrlidError, match=r"but dt is 0.0033 s|lacks"):
        clock(tmp_path, 1e-3 * np.arange(100), dt=3.3e-3)


def test_jitter_warns_with_its_size(tmp_path):
    t = 0.01 * np.arange(200)
    t[50] += 0.002
    with pytest.warns(CtrlidWarning, match=r"jitter by up to 20 % of the period 0.01 s") as caught:
        record = clock(tmp_path, t)
    assert caught[0].filename == __file__
    assert record.dt == pytest.approx(0.01)
    t[50] -= 0.00199  # 0.1 %: any clock
    clock(tmp_path, t)


def test_gaps_are_refused_with_place_and_length(tmp_path):
    t = np.delete(0.01 * np.arange(100), [20, 21, 22, 60])
    with pytest.raises(CtrlidError) as refusal:
        clock(tmp_path, t)
    text = str(refusal.value)
    assert "lacks 4 samples in 2 places; the longest gap has 3" in text
    assert "0.04 s after t = 0.19 s, at a period of 0.01 s" in text
    assert "gaps='mask'" in text
    with pytest.raises(CtrlidError, match="lacks 1 sample in one place"):
        clock(tmp_path, np.delete(0.01 * np.arange(100), 50), 2)
    with pytest.raises(CtrlidError, match="lacks 1 sample in one place"):
        clock(tmp_path, np.delete(0.01 * np.arange(100), 50), 2, dt=0.01)
    rounded = np.delete(3.25e-3 * np.arange(400), 100)
    with pytest.raises(CtrlidError, match="lacks 1 sample in one place"):
        clock(tmp_path, rounded, 3)


def test_masked_gaps_keep_all_data(tmp_path):
    every = np.arange(100)
    kept = np.delete(every, [20, 21, 22, 60])
    record = clock(tmp_path, 0.01 * kept, gaps="mask")
    assert len(record) == 100
    np.testing.assert_array_equal(np.flatnonzero(~record.valid), [20, 21, 22, 60])
    np.testing.assert_array_equal(record.u[record.valid], np.arange(96))
    assert record.u[21] == record.u[19]
    np.testing.assert_allclose(record.t[record.valid], 0.01 * kept, atol=1e-9)
    assert record.segments() == [(0, 20), (23, 60), (61, 100)]
    # The mean of the steps is 0.01 but for round-off, which a model would print.
    assert record.dt == 0.01


def test_a_long_record(tmp_path):
    n = 200_000
    rng = np.random.default_rng(0)
    record = Record(u=rng.standard_normal(n), y=rng.standard_normal(n), dt=1e-3)
    record.to_csv(tmp_path / "long.csv")
    twin = Record.from_csv(tmp_path / "long.csv")
    np.testing.assert_array_equal(twin.u, record.u)
    np.testing.assert_array_equal(twin.y, record.y)
    assert twin.dt == 1e-3


BLANKS = "t,u,y\n0,1,2\n0.01,,4\n0.02,5,nan\n0.03,7,8\n0.04,9,10\n"


def test_blank_cells_are_refused_with_what_to_do(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(BLANKS)
    with pytest.raises(CtrlidError, match=r"no number for u in row 2 .* 2 of 5 rows.*gaps='mask'"):
        Record.from_csv(path)
    path.write_text(BLANKS.replace("5,nan", "5,off"))
    with pytest.raises(CtrlidError, match="'off' stands in line 4"):
        Record.from_csv(path, gaps="mask")
    path.write_text(BLANKS.replace("5,nan", '5,"1,5"'))
    with pytest.raises(CtrlidError, match="'1,5' stands in line 4"):
        Record.from_csv(path, gaps="mask")
    path.write_text(BLANKS + "0.05,1\n,1,2\n")
    with pytest.raises(CtrlidError, match="line 7 has 2 cells, the lines above it 3"):
        Record.from_csv(path, gaps="mask")
    path.write_text("t,u,y\n0,1,\n0.01,2,\n")
    with pytest.raises(CtrlidError, match="no number at all"):
        Record.from_csv(path, gaps="mask")


def test_blank_cells_are_masked(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(BLANKS)
    record = Record.from_csv(path, gaps="mask")
    assert record.valid.tolist() == [True, False, False, True, True]
    assert record.u.tolist() == [1, 1, 5, 7, 9]
    assert record.y.tolist() == [2, 4, 4, 8, 10]


@pytest.mark.parametrize("every", [3, 4, 5])
def test_many_rows_lost_at_a_regular_pace_are_warned_of(tmp_path, every):
    k = np.arange(2000)
    kept = k[k % every != every - 1]
    with pytest.warns(UserWarning, match=r"at a regular pace.*Read as the slower clock"):
        record = clock(tmp_path, 1e-3 * kept, 6)
    assert record.dt == pytest.approx(1e-3 * every / (every - 1), rel=1e-3)
    with pytest.warns(UserWarning, match="Read as lost rows"):
        record = clock(tmp_path, 1e-3 * kept, 6, gaps="mask")
    assert record.dt == 1e-3
    np.testing.assert_array_equal(np.flatnonzero(record.valid), kept)


@pytest.mark.parametrize("every", [6, 7, 20, 50, 133])
def test_rows_lost_at_a_regular_pace_are_not_taken_for_a_slower_clock(tmp_path, every):
    """A clock of 1.0204 ms in whole milliseconds would write the same stamps."""
    k = np.arange(2000)
    kept = k[k % every != every - 1]
    with pytest.raises(CtrlidError, match=r"at a regular pace, by twice as much") as refusal:
        clock(tmp_path, 1e-3 * kept, 3)
    record = clock(tmp_path, 1e-3 * kept, 3, gaps="mask")
    assert record.dt == 1e-3
    np.testing.assert_array_equal(np.flatnonzero(record.valid), kept)
    slow = float(re.search(r"give dt=([\d.e-]+)", str(refusal.value))[1])
    record = clock(tmp_path, 1e-3 * kept, 3, dt=slow)
    assert (record.dt, len(record), record.valid.all()) == (slow, len(kept), True)


def test_text_in_a_column_that_nobody_asked_for_does_no_harm(tmp_path):
    text = "t,state,r,u,y,date\n0,IDLE,1,2,3,2026-01-01\n0.1,RUN,1,2,4,2026-01-01\n"
    record = write(tmp_path, text)
    assert record.y.tolist() == [3, 4]
    with pytest.raises(CtrlidError, match="'IDLE' stands in line 2, column 'state'"):
        write(tmp_path, text, extra="state")
    with pytest.raises(CtrlidError, match="'IDLE' stands in line 2, column 'state'"):
        write(tmp_path, text, y="state")
    with pytest.raises(CtrlidError, match=r"time of day: '2026-01-01' .* column 'date'"):
        write(tmp_path, text, time="date")
    spoilt = text.replace("1,2,4", "1,off,4")
    with pytest.raises(CtrlidError, match="'off' stands in line 3, column 'u'"):
        write(tmp_path, spoilt, gaps="mask")


def test_decimal_commas_between_commas_are_named(tmp_path):
    path = tmp_path / "log.csv"
    for rows in ("0,005,1,25,3,4\n0,010,1,30,3,5\n", "0,005,1,25,3\n0,010,1,30,3,5\n",
                 "0,1,3\n0,010,1,30,3,5\n"):  # fmt: skip
        path.write_text("t,u,y\n" + rows)
        with pytest.raises(CtrlidError, match="decimal commas, a comma cannot also stand") as told:
            Record.from_csv(path)
        long = next(row for row in rows.splitlines() if row.count(",") > 2)
        assert f"3 columns by its header, but the row {long!r} has" in str(told.value)
    path.write_text('t,u,y\n0,"1,5",2\n0.1,"1,6",2\n')
    with pytest.raises(CtrlidError, match=r"'1,5' stands in line 2.*If it is a decimal comma"):
        Record.from_csv(path)
    # Columns without a name are refused as before, where no comma separates them.
    path.write_text("t;u;y\n0;1;2;3\n1;1;2;3\n")
    with pytest.raises(CtrlidError, match="names 3 columns, its rows have 4"):
        Record.from_csv(path)


def test_a_cell_is_quoted_as_it_stands_in_the_file(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t;u;y\n0;1,5;2\n0,1; 1,6 V;2\n")
    with pytest.raises(CtrlidError, match="' 1,6 V' stands in line 3, column 'u'"):
        Record.from_csv(path)
    path.write_text("t;u;y\n0;1.234,5;2\n0,1;1;2\n")
    with pytest.raises(CtrlidError, match=r"'1\.234,5' stands in line 2"):
        Record.from_csv(path)


def test_blank_cells_are_told_with_the_longest_run(tmp_path):
    text = "t,u,y\n0,,1\n1,1,1\n2,,1\n3,,1\n4,1,1\n"
    with pytest.raises(CtrlidError, match="in 3 of 5 rows, at most 2 of them one after the other"):
        write(tmp_path, text)


def read_robot(tmp_path, **options):
    path = tmp_path / "robot.csv"
    path.write_text("t/s;Soll/mm;x/mm;phi/°;u/V\n0;80;1;18;1\n1;80;2;36;2\n2;80;3;54;3\n")
    return Record.from_csv(path, r="Soll", u="u", y=("x", "phi"), dt=1.0, **options)


def test_signals_of_one_channel_are_scaled_each_by_its_name(tmp_path):
    """Outputs in mm and in degrees could not be brought to SI units."""
    scale = {"r": 1e-3, "x": 1e-3, "phi": np.pi / 180}
    record = read_robot(tmp_path, scale=scale, units={"Soll": "m", "x": "m", "phi": "rad"})
    np.testing.assert_allclose(record.y, [[1e-3, 2e-3, 3e-3], np.pi * np.array([0.1, 0.2, 0.3])])
    np.testing.assert_allclose(record.r, 0.08)
    assert record.units == {"r": "m", "u": "V", "y": ("m", "rad")}
    # What is scaled has no unit unless it is stated; the others keep that of the header.
    half = read_robot(tmp_path, scale={"x/mm": 1e-3})
    assert half.units["y"] == ("", "°")
    np.testing.assert_allclose(half.y[1], [18, 36, 54])
    whole = read_robot(tmp_path, scale={"y": 2.0}, units={"y": ("a", "b")})
    np.testing.assert_allclose(whole.y, 2 * np.array([[1, 2, 3], [18, 36, 54]]))
    assert whole.units["y"] == ("a", "b")
    with pytest.warns(CtrlidWarning, match=r"^phi is in ° by .* scale=\{'phi': factor\}"):
        assert read_robot(tmp_path, units={"phi": "rad"}).units["y"] == ("mm", "rad")


@pytest.mark.parametrize(
    ("options", "words"),
    [({"scale": {"z": 2.0}}, "scale= names 'z', but the channels are r, u, y, and of .* x, .* phi"),
     ({"units": {"z": "m"}}, "units= names 'z', but the channels are r, u, y, and of single"),
     ({"scale": {"y": 2.0, "x": 3.0}}, "scale= names a signal of y twice, as 'y' and as 'x'"),
     ({"units": {"phi": "rad", "phi/°": "rad"}}, "units= names a signal of y twice"),
     ({"units": {"x": ("m", "rad")}}, "units has 2 words for x, which has 1 signal"),
     ({"units": {"y": ("m",)}}, "units has 1 words for y, which has 2 signals")],
)  # fmt: skip
def test_names_of_signals_that_are_unknown_or_given_twice(tmp_path, options, words):
    with pytest.raises(CtrlidError, match=words):
        read_robot(tmp_path, **options)


def test_a_stored_record_is_scaled_by_the_names_of_its_signals(tmp_path):
    record = Record(r=[1.0, 2.0], u=[1.0, 2.0], y=[[1.0, 2.0], [3.0, 4.0]], dt=0.1,
                        names={"r": "x", "u": "F", "y": ("x", "theta")})  # fmt: skip
    record.to_csv(tmp_path / "stored.csv")
    made = Record.from_csv(tmp_path / "stored.csv", scale={"theta": 2.0, "x": 10.0})
    np.testing.assert_allclose(made.y, [[10, 20], [6, 8]])
    np.testing.assert_allclose(made.r, [10, 20])
    assert dict(made.names) == dict(record.names)


# --- what tools of others write


@pytest.mark.parametrize("dt", [5e-4, 3.25e-3, 0.01])
def test_seconds_since_1970_give_the_period_that_was_meant(tmp_path, dt):
    """Doubles of this size have a step of 0.24 us, which was in the digits of the period."""
    t = 1.7e9 + 0.123 + dt * np.arange(200)
    path = tmp_path / "log.csv"
    path.write_text(
        "t,u,y\n" + "".join(f"{v!r},{k % 7},{k % 5}\n" for k, v in enumerate(t.tolist()))
    )
    assert cid.Record.from_csv(path).dt == dt


@pytest.mark.parametrize("german", [False, True])
def test_points_and_commas_in_numbers_of_one_file_are_refused(tmp_path, german):
    """Thousands that are parted by the sign of the decimals were a thousand times too small."""
    rows = "".join(f"{k / 100:.2f};{k}.5;{990 + k:,}\n" for k in range(20))
    if german:
        rows = rows.translate(str.maketrans(".,", ",."))
    path = tmp_path / "log.csv"
    path.write_text("time;volt;pos\n" + rows)
    with pytest.raises(CtrlidError, match="parts thousands") as refused:
        cid.Record.from_csv(path, u="volt", y="pos")
    assert "in line 12" in str(refused.value)
    path.write_text("time;volt;pos\n" + rows.replace("1.0", "10").replace("1,0", "10"))
    assert cid.Record.from_csv(path, u="volt", y="pos").y[-1] == 1009.0


def test_signs_in_comments_and_in_texts_say_nothing_of_numbers(tmp_path):
    path = tmp_path / "log.csv"
    rows = "".join(f"{k};0,5;1.2;v1.3\n" for k in range(9)).replace("0;0,5;1.2", "0;0,5;x")
    path.write_text("t [s];u;firmware;y\n# 1.5 ; 2.5\n" + rows.replace("v1.3", "1,5"))
    record = cid.Record.from_csv(path)
    assert (record.u[0], record.y[0]) == (0.5, 1.5)


def test_lost_rows_of_rounded_times_do_not_contradict_a_stated_period(tmp_path):
    path = tmp_path / "log.csv"
    kept = [k for k in range(90) if k not in (20, 41, 60, 77)]
    path.write_text("t,u,y\n" + "".join(f"{1.02e-3 * k:.3f},1,{k}\n" for k in kept))
    assert cid.Record.from_csv(path, dt=1.02e-3, gaps="mask").dt == 1.02e-3


def test_a_stated_period_that_the_times_contradict_is_refused(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,u,y\n" + "".join(f"{k / 100:.2f},{k % 7},{k % 5}\n" for k in range(2000)))
    with pytest.raises(CtrlidError, match=r"steps by 0.01 s, but dt is 0.0104 s"):
        cid.Record.from_csv(path, dt=0.0104)
    with pytest.warns(cid.CtrlidWarning, match=r"run over 19.99 s, .* over 20.03 s"):
        assert cid.Record.from_csv(path, dt=0.01002).dt == 0.01002
    assert cid.Record.from_csv(path, dt=0.01).dt == 0.01


def test_times_in_whole_seconds_go_with_a_stated_period(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,u,y\n" + "".join(f"{k // 10},{k % 7},{k % 5}\n" for k in range(200)))
    record = cid.Record.from_csv(path, dt=0.1)
    assert (record.dt, len(record)) == (0.1, 200)


def test_a_unit_in_brackets_needs_no_blank_before_it(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("Time(s),u(V),f(x),y(mm)\n" + "".join(f"{k / 10},1,{k},2\n" for k in range(9)))
    record = cid.Record.from_csv(path, extra=["f(x)"])
    assert (record.dt, record.units["u"], record.units["y"]) == (0.1, "V", "mm")
    assert list(record.extra) == ["f(x)"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"PK\x03\x04\x14\x00", "is an Excel workbook"),
        (b"t,u,y\n0,1,2\n,1,2\n0.2,1,3\n", "row 2 of the data has none"),
        (b"t;u;y\n0;1.234,5;2\n1;1;2\n", "If its signs part thousands"),
        (b"t,u,y\n0,1,2\n0.1,1,2\n0.2,1\n", "the last one may have been cut off"),
    ],
)  # fmt: skip
def test_refusals_say_what_to_do(tmp_path, text, words):
    path = tmp_path / "log.csv"
    path.write_bytes(text)
    with pytest.raises(CtrlidError, match=words):
        cid.Record.from_csv(path)


def test_no_channel_is_lost_by_the_name_of_another(tmp_path):
    one = cid.Record(u=[0, 1, 2], y=[1, 2, 3], extra={"theta": [7, 8, 9], "z": [4, 5, 6]},
                     names={"y": "theta", "u": "V"}, dt=1.0)  # fmt: skip
    one.to_csv(tmp_path / "own.csv")
    other = cid.Record.from_csv(tmp_path / "own.csv", y="z")
    assert {k: v.tolist() for k, v in other.extra.items()} == {
        "theta": [7, 8, 9], "logged y": [1, 2, 3]}  # fmt: skip
    swapped = cid.Record.from_csv(tmp_path / "own.csv", y="u", u="y")
    assert dict(swapped.names) == {"y": "V", "u": "theta"}


@pytest.mark.parametrize(("names", "spare"), [({"y": "pos"}, "pos"), ({}, "logged y")])
def test_another_column_of_a_file_of_ours_takes_the_place_of_a_signal(tmp_path, names, spare):
    one = cid.Record(u=[0, 1, 2], y=[1, 2, 3], extra={"i": [4, 5, 6]}, names=names, dt=1.0)
    path = one.to_csv(tmp_path / "own.csv")
    other = cid.Record.from_csv(tmp_path / "own.csv", y="i")
    del path
    assert (other.y.tolist(), other.names["y"]) == ([4, 5, 6], "i")
    assert other.extra[spare].tolist() == [1, 2, 3]
