"""Records of several inputs and outputs: shapes, names, validity, files and responses."""

import argparse
import pickle

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid.reporting.cli.arguments import parse_assignments

N = 60
RNG = np.random.default_rng(1)
Y = RNG.standard_normal((2, N))
NAMES = {"r": ("theta", "alpha"), "u": "V", "y": ("theta", "alpha")}
UNITS = {"r": "rad", "u": "V", "y": ("rad", "deg")}


def make(**fields):
    fields = {"r": Y + 1, "u": Y[0] * 2, "y": Y, "dt": 0.01, "names": NAMES, "units": UNITS,
              **fields}  # fmt: skip
    return cid.Record(**fields)


def same(one, other):
    for key in ("r", "u", "y", "valid"):
        np.testing.assert_array_equal(getattr(one, key), getattr(other, key))
    assert dict(one.names) == dict(other.names)
    assert dict(one.units) == dict(other.units)
    assert (one.dt, one.hold, one.name) == (other.dt, other.hold, other.name)


def test_shapes_names_and_units():
    record = make()
    assert len(record) == record.n == N
    assert record.y.shape == (2, N)
    assert record.u.shape == (N,)
    assert record.signals == {"r": ("theta", "alpha"), "u": ("V",), "y": ("theta", "alpha")}
    assert record.units["r"] == ("rad", "rad")
    assert not record.y.flags.writeable
    assert make(names={}).signals["y"] == ("y[0]", "y[1]")
    # One signal stays what it was, also where it was given as a row.
    assert make(r=Y[:1], names={"y": ("a", "b")}).r.shape == (N,)
    assert cid.Record(u=Y[:1], y=Y[1:], dt=1, names={"y": ["gap"]}).names["y"] == "gap"
    same(pickle.loads(pickle.dumps(record)), record)


def test_text_lists_every_signal():
    text = str(make())
    for part in ("r (theta)", "r (alpha)", "u (V)", "y (theta)", "y (alpha)", "deg"):
        assert part in text
    assert "y[1]  " in str(make(names={}))
    assert "y (y[1])" not in str(make(names={}))


def test_parts_of_a_record():
    record = make(valid=np.arange(N) > 3)
    assert record[10:30].y.shape == (2, 20)
    np.testing.assert_array_equal(record[10:30].y, Y[:, 10:30])
    first, second = record.split()
    assert len(first) + len(second) == N
    assert record.decimate(2, antialias=False).y.shape == (2, N // 2)
    slow, alone = record.decimate(2), record.select(y="alpha").decimate(2)
    np.testing.assert_array_equal(slow.y[1], alone.y)
    np.testing.assert_array_equal(slow.valid, alone.valid)


def test_selected_signals():
    one = make().select(y="alpha", r="alpha")
    np.testing.assert_array_equal(one.y, Y[1])
    assert one.names == {"r": "alpha", "u": "V", "y": "alpha"}
    assert one.units["y"] == "deg"
    turned = make().select(y=("alpha", "theta"))
    np.testing.assert_array_equal(turned.y, Y[::-1])
    assert turned.units["y"] == ("deg", "rad")
    with pytest.raises(cid.CtrlidError, match="no signal 'beta' in y; it has theta, alpha"):
        make().select(y="beta")
    with pytest.raises(cid.CtrlidError, match="no signal 'r' in r; it has none"):
        make(r=None, names={}, units={}).select(r="r")


def test_validity_for_all_and_for_each():
    each = np.ones((2, N), dtype=bool)
    each[0, 5], each[1, 9] = False, False
    record = make(valid=each)
    assert record.segments() == [(0, 5), (6, 9), (10, N)]
    np.testing.assert_array_equal(record.valid_outputs, each)
    np.testing.assert_array_equal(record.select(y="alpha").valid, each[1])
    np.testing.assert_array_equal(record[4:8].valid, each[:, 4:8])
    assert make(valid=each[0]).valid_outputs.shape == (2, N)
    assert "99.2 % valid" not in str(record)
    assert "98.3 % valid" in str(record)


@pytest.mark.parametrize("each", [False, True])
def test_csv_round_trip(tmp_path, each):
    valid = np.ones((2, N) if each else N, dtype=bool)
    valid[..., 7] = False
    if each:
        valid[1, 7] = True
    record = make(valid=valid, extra={"current": Y[0]}, name="swing")
    record.to_csv(tmp_path / "a.csv")
    same(cid.Record.from_csv(tmp_path / "a.csv"), record)
    header = (tmp_path / "a.csv").read_text().splitlines()[1]
    assert header.startswith("t [s],r_theta [rad],r_alpha [rad],u [V],y_theta [rad]")


def test_columns_of_other_tools(tmp_path):
    path = tmp_path / "b.csv"
    path.write_text("time,theta [rad],alpha [rad],V [V]\n" + "\n".join(
        f"{0.01 * k},{Y[0, k]},{Y[1, k]},{Y[0, k]}" for k in range(N)))  # fmt: skip
    record = cid.Record.from_csv(path, **parse_assignments("y=theta,alpha u=V"))
    np.testing.assert_array_equal(record.y, Y)
    assert record.signals == {"u": ("V",), "y": ("theta", "alpha")}
    assert record.units == {"u": "V", "y": ("rad", "rad")}
    with pytest.raises(cid.CtrlidError, match="has no column 'beta' for y"):
        cid.Record.from_csv(path, y=("theta", "beta"), u="V")


def test_column_assignments():
    assert parse_assignments("r=ref,u=volt,y=gap") == {"r": "ref", "u": "volt", "y": "gap"}
    assert parse_assignments("y=theta,alpha u=V") == {"y": ("theta", "alpha"), "u": "V"}
    assert parse_assignments("u=V,y=the angle") == {"u": "V", "y": "the angle"}
    with pytest.raises(argparse.ArgumentTypeError):
        parse_assignments("theta,alpha")


def test_responses_of_python_control():
    plant = ct.ss(-np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2)), inputs=["F", "tau"],
                  outputs=["x", "theta"])  # fmt: skip
    t = np.arange(N) * 0.01
    record = cid.Record.from_response(ct.forced_response(plant, t, Y))
    assert record.signals == {"u": ("F", "tau"), "y": ("x", "theta")}
    np.testing.assert_array_equal(record.u, Y)
    one = cid.Record.from_response(ct.forced_response(plant, t, Y), u="F", y=["theta"])
    assert one.signals == {"u": ("F",), "y": ("theta",)}
    same(cid.Record.from_response(record.to_response(), hold="foh"), record)
    back = cid.Record.from_response(make().to_response(), r=["r theta", "r alpha"],
                                    y=["y theta", "y alpha"], u="V")  # fmt: skip
    np.testing.assert_array_equal(back.r, Y + 1)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"y": Y.T}, r"y has shape \(60, 2\): several signals have the shape .* Give y.T"),
        ({"y": Y[:, :30]}, "must be equally long; given r: 60, u: 60, y: 30"),
        ({"names": {"y": "theta"}}, "names needs a name of its own for each signal of y"),
        ({"names": {"y": ("a", "b", "c")}}, "names has 3 words for y, which has 2 signals"),
        ({"names": {"u": ("a", "b")}}, "names has 2 words for u, which has 1 signal"),
        ({"units": {"y": ("m",)}}, "units has 1 words for y, which has 2 signals"),
        ({"valid": np.ones((3, N), dtype=bool)}, "60 booleans, one per sample, or 2 rows of them"),
    ],
)
def test_refused_records(fields, words):
    with pytest.raises(cid.CtrlidError, match=words):
        make(**{"names": {}, "units": {}, **fields})


def test_picture_has_axes_for_every_signal():
    axes = cid.plot.record(make())
    assert [ax.get_ylabel() for ax in axes] == [
        "theta [rad]", "alpha [deg]", "alpha [rad]", "V [V]"]  # fmt: skip
    assert "reference alpha" in axes[2].get_legend_handles_labels()[1]


def test_page_lists_every_signal(tmp_path):
    cid.write_report(make(), tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert page.count("alpha") >= 2


MODEL = ct.tf([1.0], [1.0, 1.0])


@pytest.mark.parametrize(
    ("function", "call"),
    [
        ("fit_continuous", lambda r: cid.fit_continuous(r, poles=2)),
        ("compare", lambda r: cid.compare(r, MODEL)),
        ("check_feedback", cid.check_feedback),
        ("select_order", cid.select_order),
        ("sweep_sampling_period", lambda r: cid.sweep_sampling_period(r, poles=2)),
        ("diagnose", lambda r: cid.diagnose(MODEL, r)),
        ("with_output", lambda r: r.with_output("current")),
    ],
)
def test_what_takes_one_signal_says_so(function, call):
    words = rf"{function} takes one input and one output; the record has .*alpha.*pick one with"
    with pytest.raises(cid.CtrlidError, match=words):
        call(make(extra={"current": Y[0]}))


def test_records_of_different_signals_are_not_mixed():
    with pytest.raises(cid.CtrlidError, match="need the same inputs and outputs"):
        cid.fit_arx([make(), make().select(y="alpha")], na=2, nb=2)
