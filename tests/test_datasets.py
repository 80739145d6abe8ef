"""Datasets: what is loaded, from where, and what is said when it is not there."""

import hashlib
import logging

import numpy as np
import pooch
import pytest
from scipy import io

import ctrlid as cid
from ctrlid import datasets

NAMES = (
    "emps",
    "emps_pulses",
    "inteco_pid_step",
    "inteco_coil_step",
    "magnetoshield_r3",
    "ip02_dirtran",
    "ip02_rtc",
    "pendubot",
    "qube_estimation",
    "qube_validation",
    "servo_random_steps",
    "servo_swept_sine",
    "silverbox",
    "tanks_estimation",
    "tanks_validation",
)


@pytest.fixture
def load(data_dir):
    """Load a record from the local folder only, or skip."""

    def loader(name):
        source = datasets._CATALOGUE[name][0]
        if not (data_dir / source.file).is_file():
            pytest.skip(f"needs the measured file {source.file} in {data_dir}")
        return datasets.load(name)

    return loader


@pytest.fixture
def no_folder(monkeypatch):
    monkeypatch.delenv("CTRLID_DATA_DIR", raising=False)


# --- what is in the records -------------------------------------------------------------------


def check(record, n, dt, units, extra=(), hold="zoh"):
    assert (len(record), record.dt, record.hold) == (n, dt, hold)
    assert dict(record.units) == units
    assert tuple(record.extra) == tuple(extra)


@pytest.mark.parametrize("name", NAMES)
def test_the_record_says_which_it_is(load, name):
    loaded = load(name)
    for record in loaded if isinstance(loaded, list) else [loaded]:
        assert record.name.startswith(name)
        assert set(record.names) == {k for k in "ruy" if getattr(record, k) is not None}


def test_emps(load):
    record = load("emps")
    check(record, 24841, 1e-3, {"r": "m", "u": "V", "y": "m"})
    assert record.valid.all()
    assert np.max(np.abs(record.r - record.y)) < 1.2e-3  # it prepared: the channels are in place
    # The published force equation, M q" = 35.15 u - Fv q' - Fc sign(q') - offset, holds.
    window = np.ones(41) / 41
    q = np.convolve(record.y, window, "same")
    v = np.gradient(q, record.dt)
    a = np.convolve(np.gradient(v, record.dt), window, "same")
    u = np.convolve(record.u, window, "same")
    moving = np.abs(v) > 0.01
    table = np.column_stack([a, v, np.sign(v), np.ones_like(v)])[moving]
    mass, viscous, coulomb, offset = np.linalg.lstsq(table, 35.15065 * u[moving])[0]
    assert mass == pytest.approx(95.11, rel=0.05)
    assert viscous == pytest.approx(203.5, rel=0.05)
    assert coulomb == pytest.approx(20.39, rel=0.1)
    assert offset == pytest.approx(-3.16, abs=1)


def test_emps_pulses(load):
    record = load("emps_pulses")
    check(record, 24841, 1e-3, {"r": "m", "u": "V", "y": "m", "pulses": "V"}, ["pulses"])
    assert set(record.extra["pulses"]) == {0.0, 5.0}
    # The drive voltage contains the pulses: it jumps where they do.
    edges = np.flatnonzero(np.diff(record.extra["pulses"]) > 0)
    assert np.mean(record.u[edges + 1] - record.u[edges]) == pytest.approx(5.07, abs=0.02)
    np.testing.assert_allclose(record.r, load("emps").r, atol=1e-14)


def test_inteco_pid_step(load):
    record = load("inteco_pid_step")
    check(record, 24343, 1e-3, {"r": "m", "u": "1", "y": "m", "current": "A"}, ["current"])
    assert set(record.r) == {0.008, 0.010, 0.012}
    assert (record.u.min(), record.u.max()) == (0, 1)
    assert 1.8 < record.extra["current"].max() < 1.9
    assert record.segments() == [(2000, 10000), (12000, 18000), (20000, 24343)]
    # What counts stays near the reference; what does not holds the stops and the swings.
    error = np.abs(record.r - record.y)
    assert error[record.valid].max() < 0.35e-3
    assert (record.y.min(), record.y.max()) == pytest.approx((0.24e-3, 17.54e-3), abs=1e-5)
    assert record.between(10, 12).y.max() == pytest.approx(16.8e-3, abs=0.1e-3)
    assert record.between(18, 20).y.min() == pytest.approx(2.6e-3, abs=0.1e-3)


def test_inteco_pid_law_explains_the_duty(load):
    record = load("inteco_pid_step")
    e = np.asarray(record.r - record.y)
    rate = np.diff(e, prepend=0.0) / record.dt
    raw = 0.583 - 37.81 * e - 188 * np.cumsum(e) * record.dt - 1.92 * rate
    assert np.max(np.abs(np.clip(raw, 0, 1) - record.u)[1:]) < 1e-4


def test_inteco_coil_step(load):
    record = load("inteco_coil_step")
    check(record, 10764, 1e-3, {"u": "1", "y": "A", "distance": "m"}, ["distance"])
    assert record.r is None
    assert np.flatnonzero(np.diff(record.u)).tolist() == [4999]
    assert np.abs(record.between(0, 4.9).y).max() < 0.05
    assert record.between(9, 10).y.mean() == pytest.approx(2.9, abs=0.05)


def test_magnetoshield(load):
    records = load("magnetoshield_r3")
    assert isinstance(records, list)
    assert len(records) == 5
    for record, level in zip(records, (14, 13.5, 14.5, 15, 14.5), strict=True):
        check(record, 1500, 3.25e-3, {"u": "V", "y": "m", "current": "A"}, ["current"])
        assert record.r is None
        assert f"{level:g} mm" in record.name
        assert np.median(record.y) * 1e3 == pytest.approx(level, abs=0.03)
        assert record.u.min() >= 0
        assert record.u.max() <= 10.67
        assert 0 <= record.extra["current"].min() < record.extra["current"].max() < 0.052
    assert records[0].segments() == [(46, 1500)]
    assert np.ptp(records[0].y[:40]) < 0.03e-3  # it lies on the floor
    assert all(record.valid.all() for record in records[1:])


@pytest.mark.parametrize(
    ("name", "n"), [("servo_random_steps", 59802), ("servo_swept_sine", 60001)]
)
def test_servo(load, name, n):
    record = load(name)
    check(record, n, 1e-3, dict.fromkeys(("r", "u", "y", "filtered"), "V"), ["filtered"])
    law = np.clip(3 * (record.r - record.extra["filtered"]), -10, 10)
    np.testing.assert_array_equal(record.u, law)
    assert np.mean(np.abs(record.u) == 10) == pytest.approx(
        {59802: 0.112, 60001: 0.058}[n], abs=1e-3
    )


def test_silverbox(load):
    record = load("silverbox")
    check(record, 131072, 1 / 610.35, {"u": "V", "y": "V"}, hold="bandlimited")
    part = record[50_000:58_192]
    # The multisine ends at 200 Hz, and the gain at low frequencies is one.
    u, y = (np.abs(np.fft.rfft(s)) for s in (part.u, part.y))
    frequency = np.fft.rfftfreq(len(part), part.dt)
    assert np.sum(u[frequency > 201] ** 2) < 1e-3 * np.sum(u**2)
    slow = (frequency > 1) & (frequency < 5)
    assert np.sqrt(np.sum(y[slow] ** 2) / np.sum(u[slow] ** 2)) == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("name", ["tanks_estimation", "tanks_validation"])
def test_tanks(load, name):
    record = load(name)
    check(record, 1024, 4.0, {"u": "V", "y": "V"})
    assert record.r is None
    assert record.y.max() == 10
    assert 0.03 < np.mean(record.y == 10) < 0.05


def test_rotary_pendulum(load):
    runs = load("qube_estimation")
    assert [run.n for run in runs] == [10_000] * 3
    assert len(load("qube_validation")) == 2
    run = runs[0]
    assert run.signals == {"r": ("theta", "alpha"), "u": ("V",), "y": ("theta", "alpha")}
    # The law as the authors run it: two PD in parallel, each derivative filtered.
    e, rate, expected = run.r - run.y, np.zeros(2), []
    before = e[:, 0]
    for k in range(run.n):
        rate = (50 * (e[:, k] - before) + rate) / (1 + 50 * run.dt)
        before = e[:, k]
        expected.append(-6 * e[0, k] - 1.8 * rate[0] - 30 * e[1, k] - 2.5 * rate[1])
    np.testing.assert_allclose(run.extra["controller"][500:], expected[500:], atol=1e-10)
    limited = np.clip(run.extra["controller"] + run.extra["feedforward"], -10, 10)
    np.testing.assert_allclose(run.u, limited, atol=1e-12)
    assert run.segments() == [(500, 10_000)]


@pytest.mark.parametrize(("name", "n"), [("ip02_rtc", 503), ("ip02_dirtran", 518)])
def test_cart_with_a_pole(load, name, n):
    record = load(name)
    assert len(record) == n
    assert record.signals == {"u": ("F",), "y": ("x", "theta")}
    assert record.y[1, 0] == pytest.approx(np.pi)
    assert abs(record.y[1, -100:]).max() < 0.05
    assert np.ptp(record.u) == pytest.approx(12)


def test_double_pendulum(load):
    record = load("pendubot")
    assert record.signals == {"u": ("tau1", "tau2"), "y": ("q1", "q2")}
    assert record.dt == 0.0025
    assert np.abs(record.y[0] - np.pi).max() < 0.4


def test_a_conversion_is_not_fetched(tmp_path, monkeypatch):
    monkeypatch.setenv("CTRLID_DATA_DIR", str(tmp_path))
    words = "qube_estim.npz is a conversion of qube_20230828T161408.*Put it into a folder"
    with pytest.raises(cid.CtrlidError, match=words):
        datasets.load("qube_estimation")


# --- where they come from ---------------------------------------------------------------------


def test_names_and_descriptions():
    assert datasets.names() == NAMES
    for name in NAMES:
        text = datasets.describe(name)
        assert "samples" in text
        made = bool(datasets._CATALOGUE[name][0].originals)
        place = "github.com/" if made else "raw.githubusercontent.com/"
        assert f"Source: https://{place}" in text
        assert not made or datasets._CATALOGUE[name][0].originals[0] in text
        assert "Terms: " in text
    assert "Janot" in datasets.describe("emps")
    assert "Schoukens" in datasets.describe("tanks_estimation")


@pytest.mark.parametrize("function", [datasets.load, datasets.describe])
def test_unknown_name(function):
    with pytest.raises(cid.CtrlidError, match="no dataset 'maglev'; there are emps, emps_pulses, "):
        function("maglev")


def test_every_file_has_its_address_and_checksum(data_dir):
    for source, _, _ in datasets._CATALOGUE.values():
        assert len(source.commit) == 40
        assert source.originals or source.path.endswith(source.file.split("/")[1])
        file = data_dir / source.file
        if file.is_file():
            assert hashlib.sha256(file.read_bytes()).hexdigest() == source.sha256


def test_another_file_in_the_folder_is_refused(tmp_path, monkeypatch):
    (tmp_path / "emps").mkdir()
    (tmp_path / "emps" / "DATA_EMPS.mat").write_bytes(b"something else")
    monkeypatch.setenv("CTRLID_DATA_DIR", str(tmp_path))
    with pytest.raises(cid.CtrlidError, match=r"DATA_EMPS.mat is not the published file: its SHA-25"
                       r"6 is not 6cf6814a\w+. Replace it by https://raw.github"):  # fmt: skip
        datasets.load("emps")


@pytest.mark.parametrize("folder", [None, "empty"])
def test_a_file_not_in_the_folder_is_fetched_silently(tmp_path, monkeypatch, folder, capfd):
    column = np.linspace(1, 10, 1024)[:, None]
    file = tmp_path / "fetched.mat"
    io.savemat(file, {"uVal": column, "yVal": column, "Ts": 4.0})
    if folder:
        monkeypatch.setenv("CTRLID_DATA_DIR", str(tmp_path))
    else:
        monkeypatch.delenv("CTRLID_DATA_DIR", raising=False)
    asked = []

    def retrieve(url, known_hash, path, progressbar):
        asked.append((url, known_hash, path, progressbar))
        pooch.get_logger().info("Downloading")
        return str(file)

    monkeypatch.setattr(pooch, "retrieve", retrieve)
    assert len(datasets.load("tanks_validation")) == 1024
    source = datasets.TANKS
    assert asked == [(source.address, f"sha256:{source.sha256}", pooch.os_cache("ctrlid"), False)]
    assert source.address == (
        "https://raw.githubusercontent.com/forgi86/sysid-neural-unc/4652931922a0a482babe6395057c54c8"
        "ceafda7e/examples/CTS/data/CascadedTanksFiles/dataBenchmark.mat"
    )
    assert capfd.readouterr() == ("", "")
    assert pooch.get_logger().level >= logging.ERROR


@pytest.mark.parametrize("reason", [OSError("no route"), ValueError("hash of downloaded file")])
def test_a_failed_download_says_what_to_do(no_folder, monkeypatch, reason):
    def retrieve(*_, **__):
        raise reason

    monkeypatch.setattr(pooch, "retrieve", retrieve)
    with pytest.raises(cid.CtrlidError) as refusal:
        datasets.load("servo_swept_sine")
    message = str(refusal.value)
    assert message.startswith(
        f"cannot fetch {datasets.SERVO_SINE.address} ({type(reason).__name__}"
    )
    assert str(reason) in message
    assert "put the file into a folder as servo/04_swept_sine.mat" in message
    assert "CTRLID_DATA_DIR" in message
