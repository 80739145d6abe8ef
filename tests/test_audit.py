"""audit(): silent on healthy records, and each defect found by its name."""

from dataclasses import replace

import control as ct
import numpy as np
import pytest

import ctrlid as cid
import problems
from ctrlid import CtrlidError
from ctrlid.data.converter_grid import find_grid_step
from ctrlid.loop.controller_replay import run_controller
from ctrlid.validation import signal_defects as defects


def reference(rng, n, amplitude, around):
    seed = int(rng.integers(1_000_000))
    kind = rng.choice(["binary", "steps", "multisine", "prbs", "noise"])
    if kind == "binary":
        hold = int(rng.integers(1, 60))
        return cid.random_binary(n, amplitude=amplitude, hold=hold, around=around, seed=seed)
    if kind == "steps":
        hold = int(rng.integers(n // 20, n // 6))
        return around + amplitude * np.repeat(rng.uniform(-1, 1, n // hold + 1), hold)[:n]
    if kind == "prbs":
        return around + amplitude * problems.repeated_bits(rng, n)
    if kind == "multisine":
        return around + amplitude * problems.twelve_waves(rng, n)
    return around + amplitude * np.repeat(rng.standard_normal(n), 5)[:n]


def random_loop(rng):
    """A maglev, servo, tank or lag of any size, under a digital or an analog controller."""
    plant = rng.choice(["maglev", "servo", "tank", "lag"])
    digital = bool(rng.random() < 0.6)
    if plant == "maglev":
        loop, gap = problems.random_levitation(rng, digital)
        return loop, gap * 10 ** rng.uniform(-2.5, -1.9)
    if plant == "servo":
        P, m, w = problems.random_servo(rng)
        dt = float(f"{0.03 / w:.3g}")
        kp = m * w**2 * rng.uniform(0.5, 4)
        C = cid.PID(kp, ki=rng.choice([0, 0.3 * m * w**3]), kd=m * w, filter_time=3 * dt)
        C = C if digital else ct.tf([m * w**2], [1])
        return cid.Loop(P, C, dt=dt), 10 ** rng.uniform(-3, 1)
    if plant == "tank":
        P = problems.random_tank(rng)
        level = rng.uniform(0.5, 2)
        C = cid.PID(rng.uniform(1, 5), ki=rng.choice([0, 0.01])) if digital else ct.tf([2.0], [1])
        op = cid.operating_point(P, output=level)
        return cid.Loop(P, C, dt=2.0, at=op), 0.03 * level
    return problems.random_lag(rng, digital), 1.0


def random_records(count, seed):
    out = []
    rng = np.random.default_rng(seed)
    while len(out) < count:
        loop, amplitude = random_loop(rng)
        n = int(10 ** rng.uniform(2.5, 3.7))
        r = reference(rng, n, amplitude, loop.point.output)
        noise = amplitude * 10 ** rng.uniform(-2, -0.7)
        try:
            record = cid.simulate(loop, r, sensor_noise=noise, seed=int(rng.integers(1_000_000)))
        except cid.CtrlidError:  # the step was too large for a levitated ball
            continue
        out.append((loop, record))
    return out


NEVER = ("saturation", "dropped samples", "outliers", "quantization")


@pytest.fixture(scope="module")
def healthy():
    return random_records(55, seed=1)


def test_healthy_records_are_left_in_peace(healthy):
    harmful, named = [], []
    for loop, record in healthy:
        found = cid.audit(record, loop)
        harmful += [f for f in found.findings if f.harmful]
        named += [f for f in found.findings if f.kind in NEVER]
        said = found["controller"]
        assert len(said) == 1
        assert all("computes from r and y" in f.text for f in said)
    assert named == []
    assert harmful == []  # one drift in a few hundred records would be chance


def clip_y(rng, record):
    q, side = rng.uniform(0.02, 0.1), rng.choice([-1, 1])
    y = side * np.minimum(side * record.y, np.quantile(side * record.y, 1 - q))
    return replace(record, y=y)


def clip_u(rng, record):
    return replace(record, u=np.minimum(record.u, np.quantile(record.u, rng.uniform(0.9, 0.98))))


def lose_samples(rng, record):
    y, u = record.y.copy(), record.u.copy()
    for k in rng.integers(5, record.n - 8, max(3, int(record.n * rng.uniform(0.003, 0.03)))):
        end = k + int(rng.integers(1, 4))
        y[k:end], u[k:end] = y[k - 1], u[k - 1]
    return replace(record, y=y, u=u)


def add_spikes(rng, record):
    bend = np.abs(np.diff(record.y, 2))
    size = max(0.6 * float(np.median(bend)), float(bend.max()) / 10)
    y = record.y.copy()
    at = rng.integers(10, record.n - 10, max(3, record.n // 500))
    y[at] += rng.choice([-1, 1], len(at)) * rng.uniform(20, 100, len(at)) * size
    return replace(record, y=y)


def add_drift(rng, record):
    t = np.linspace(0, 1, record.n)
    shape = (t, 1 - np.exp(-4 * t), t**2)[rng.integers(3)]
    return replace(record, y=record.y + rng.uniform(4, 8) * np.std(record.y - record.r) * shape)


DEFECTS = [
    (clip_y, "saturation", "y", 0.02),
    (clip_u, "saturation", "u", 0.02),
    (lose_samples, "dropped samples", "y", 0.02),
    (add_spikes, "outliers", "y", 0.02),
    (add_drift, "drift", "y", 0.12),  # a few hundred samples of a slow loop are few time constants
]


@pytest.mark.parametrize(("spoil", "kind", "channel", "share"), DEFECTS)
def test_a_defect_is_found(healthy, spoil, kind, channel, share):
    rng = np.random.default_rng(2)
    missed = 0
    for _, record in healthy:
        found = cid.audit(spoil(rng, record))
        missed += not any(f.channel == channel for f in found[kind])
    assert missed <= share * len(healthy)


@pytest.mark.slow
def test_rates_over_many_records(capsys):
    """False alarms and finds by kind: ``pytest -m slow tests/test_audit.py``."""
    records, rng = random_records(800, seed=20), np.random.default_rng(21)
    alarms = [f for loop, record in records for f in cid.audit(record, loop).findings]
    kinds = {kind: sum(f.kind == kind for f in alarms) for kind in (*NEVER, "drift")}
    found = {
        f"{kind} of {channel}": sum(
            any(f.channel == channel for f in cid.audit(spoil(rng, record))[kind])
            for _, record in records
        )
        for spoil, kind, channel, _ in DEFECTS
    }
    with capsys.disabled():
        print(f"\nof {len(records)}: false alarms {kinds}; found {found}")  # noqa: T201
    assert max(kinds.values()) < 0.01 * len(records)
    assert all(found[f"{k} of {c}"] >= (1 - s) * len(records) for _, k, c, s in DEFECTS)


def test_quantisation_is_measured(healthy):
    rng = np.random.default_rng(3)
    for _, record in healthy:
        step = float(f"{np.std(record.y) * 10 ** rng.uniform(-2.5, -0.6):.3g}")
        found = cid.audit(replace(record, y=np.round(record.y / step) * step))
        assert found.quantum["y"] == pytest.approx(step, rel=1e-3)
        assert found["quantization"][0].channel == "y"
        assert found["dropped samples"] == found["outliers"] == ()


def test_printed_digits_are_a_step_but_no_news():
    y = np.random.default_rng(4).standard_normal(5000)
    found = cid.audit(cid.Record(u=y, y=np.array([float(f"{v:.5f}") for v in y]), dt=1.0))
    assert found.quantum["y"] == pytest.approx(1e-5, rel=1e-6)
    assert found["quantization"] == ()
    assert found.quantum["u"] == found.quantum["r"] == 0.0


def test_levels_of_a_calibrated_converter():
    raw = np.round(np.random.default_rng(5).standard_normal(5000) * 30)
    y = np.exp(raw / 500)  # evenly spaced in counts, not in units
    assert find_grid_step(y) == pytest.approx(1 / 500, rel=0.1)


@pytest.mark.parametrize("lag", [1, 2, -1, -2])
@pytest.mark.parametrize("channel", ["u", "y"])
def test_a_channel_logged_late_or_early(healthy, lag, channel):
    word = f"{'one' if abs(lag) == 1 else 'two'} sample{'s' if abs(lag) > 1 else ''}"
    word += " late" if lag > 0 else " early"
    for loop, record in [pair for pair in healthy if not pair[0].analog][:5]:
        moved = np.roll(getattr(record, channel), lag)
        late = replace(record, **{channel: moved})[5:-5]
        said = cid.audit(late, loop)["delay"]
        assert said[0].harmful
        assert f"logged {word}" in said[0].text


@pytest.fixture
def servo():
    loop = problems.servo(cid.PID(kp=20.0, kd=0.5))
    return loop, cid.random_binary(4000, amplitude=0.1, hold=50, seed=1)


def test_injected_signal_is_named_with_its_size(servo):
    loop, r = servo
    d = 0.2 * np.random.default_rng(6).standard_normal(len(r))
    record = cid.simulate(loop, r, d=d, sensor_noise=1e-4, seed=1)
    said = cid.audit(record, loop)["controller"][0]
    assert not said.harmful
    assert "u contains a signal of RMS 0.2" in said.text


def test_injected_channel_is_recognised(servo):
    loop, r = servo
    d = np.where(np.arange(len(r)) % 300 < 60, 1.5, 0.0)  # slow: y follows it within a pulse
    record = replace(cid.simulate(loop, r, d=d, sensor_noise=1e-4, seed=1), extra={"pulses": d})
    said = cid.audit(record, loop)["controller"][0]
    assert not said.harmful
    assert "'pulses'" in said.text


def test_around_a_constant_reference_late_u_is_early_y(servo):
    loop, r = servo
    d = 0.2 * np.random.default_rng(6).standard_normal(len(r))
    still = cid.simulate(loop, 0 * r, d=d, sensor_noise=1e-3, seed=1)
    assert cid.audit(still).harmful == ()  # the dither excites
    noise = cid.simulate(loop, 0 * r, sensor_noise=1e-3, seed=1)
    assert "u is computed from y" in cid.audit(noise)["too little excitation"][0].text
    late = replace(noise[1:], u=noise.u[:-1])
    text = cid.audit(late, loop)["delay"][0].text
    assert text.startswith("u is logged one sample late or y is logged one sample early")


def test_another_controller_is_said(servo):
    loop, r = servo
    record = cid.simulate(loop, r, sensor_noise=1e-4, seed=1)
    other = replace(loop, controller=cid.PID(kp=14.0, kd=0.8))
    said = cid.audit(record, other)["unknown"][0]
    assert said.harmful
    assert "other gains or another structure" in said.text


def test_u_ahead_of_the_limiter_and_behind_it(servo):
    loop, r = servo
    limited = replace(loop, input_limits=(-2.0, 2.0))
    record = cid.simulate(limited, r, sensor_noise=1e-4, seed=1)
    found = cid.audit(record, limited)
    assert found.harmful == ()
    assert found.saturated["u"][2:] == (-2.0, 2.0)
    assert min(found.saturated["u"][:2]) > 0.005
    assert "The loop has these limits" in found["saturation"][0].text
    assert (
        "Give the limits to the loop with input_limits="
        in cid.audit(record, loop)["saturation"][0].text
    )
    wish = replace(record, u=run_controller(loop, record.y, record.r))
    said = cid.audit(wish, limited)
    assert "before the limiter" in said["limit"][0].text
    assert "computes from r and y" in said["controller"][0].text


def test_wrong_period_of_the_loop_is_a_finding(servo):
    loop, r = servo
    record = replace(cid.simulate(loop, r), dt=0.02)
    assert "cannot be computed with the controller of the loop: the loop is sampled" in (
        cid.audit(record, loop)["controller"][0].text
    )


def test_an_experiment_repeats_where_all_references_do():
    rng = np.random.default_rng(5)
    one, two = (np.tile(rng.choice([-1.0, 1.0], 200), 4) for _ in range(2))
    other = rng.choice([-1.0, 1.0], 800)
    for second, repeats in ((two, True), (other, False), (0 * two, True)):
        r = np.array([one, second])
        y = np.cumsum(r, axis=1) + 0.01 * rng.standard_normal(r.shape)
        record = cid.Record(r=r, u=r + y, y=y, dt=0.1)
        assert ("repeats" in [f.kind for f in cid.audit(record).findings]) == repeats


def test_repeats():
    rng = np.random.default_rng(7)
    for _ in range(100):
        n, times = int(rng.integers(20, 2000)), int(rng.integers(2, 6))
        r = np.tile(np.cumsum(rng.standard_normal(n)), times)
        r = np.append(r, r[: n // 3]) + 3e-4 * np.std(r) * rng.standard_normal(len(r) + n // 3)
        assert defects.find_period(r) == n
    for _ in range(100):
        n = int(rng.integers(50, 5000))
        assert defects.find_period(np.cumsum(rng.standard_normal(n))) == 0
        assert defects.find_period(np.repeat(rng.standard_normal(n // 10 + 1), 10)[:n]) == 0


def test_excitation():
    n = 2000
    noise = np.random.default_rng(8).standard_normal(n)
    t = np.arange(n)

    def said(r):
        return [f.text for f in cid.audit(cid.Record(r=r, u=r - noise, y=noise + r, dt=1.0))
                ["too little excitation"]]  # fmt: skip

    assert "only noise excites the loop" in said(np.zeros(n))[0]
    assert "changes only once" in said(np.where(t > 500, 1.0, 0.0))[0]
    assert "single sine" in said(np.sin(0.0513 * t))[0]
    assert said(np.sin(0.0513 * t) + np.sin(0.1713 * t)) == []
    assert said(np.sin(2e-5 * t**2)) == []
    assert said(np.repeat(np.random.default_rng(9).choice([-1.0, 1.0], n // 20), 20)) == []


def test_slow_sensor_is_named():
    y = np.cumsum(np.random.default_rng(10).standard_normal(3000))
    found = cid.audit(cid.Record(u=np.gradient(y), y=np.repeat(y[::3], 3), dt=0.1))
    assert "measured only once in 3 samples" in found["dropped samples"][0].text


def test_staircases_and_rest_are_not_saturation():
    levels = np.repeat([0.0, 1.0, 0.0, 2.0, 0.0, 3.0, 0.0, 1.0], 100)
    y = np.zeros(800)
    for k in range(1, 800):
        y[k] = 0.9 * y[k - 1] + 0.1 * levels[k - 1]
    found = cid.audit(cid.Record(u=levels, y=y, dt=1.0))
    assert found["saturation"] == found["quantization"] == ()
    assert found.quantum["u"] == 0.0


def switch(sizes):
    """A reference that changes its sign at unequal times, each long enough for rest."""
    lengths = np.random.default_rng(5).integers(300, 400, len(sizes))
    return np.repeat(sizes * (-1.0) ** np.arange(len(sizes)), lengths)


def kick(r, noise, limits=(-np.inf, np.inf), seed=1):
    """A lead with feed-through on a mass: u jumps with r for one sample, and is rounded."""
    lead = ct.tf([30.0, -27.0], [1.0, -0.2], 0.02)
    loop = cid.Loop(cid.plants.servo(m=1.0, c=10.0, k=50.0), lead, dt=0.02, input_limits=limits)
    record = cid.simulate(loop, r, sensor_noise=noise, seed=seed)
    return replace(loop, input_limits=(-np.inf, np.inf)), replace(record, u=record.u.round(4))


def test_equal_peaks_of_equal_jumps_are_no_limit():
    r = switch(np.full(20, 0.1))
    loop, record = kick(r, 0.0)
    top = record.u == record.u.max()
    assert np.count_nonzero(top) >= defects.SOME
    assert np.diff(np.flatnonzero(top)).min() > 1
    for found in (cid.audit(record), cid.audit(record, loop)):
        assert found["saturation"] == ()
        assert found.saturated["u"][:2] == (0.0, 0.0)
    # Two references in place of one, of which one rests.
    several = cid.Record(r=np.array([r, 0 * r]), u=record.u, y=np.array([record.y, record.y]),
                         dt=record.dt, names={"y": ("x", "z")})  # fmt: skip
    assert not [f for f in cid.audit(several)["saturation"] if f.channel == "u"]


def test_a_limit_of_one_sample_is_still_one():
    """Noise beside equal peaks, jumps of different heights, or a limit that the loop states."""
    rng = np.random.default_rng(3)
    equal, unequal = switch(np.full(20, 0.1)), switch(rng.uniform(0.08, 0.1, 20))
    limits = (-4.5, 4.5)
    for r, noise in ((equal, 1e-3), (unequal, 0.0)):
        loop, record = kick(r, noise, limits)
        assert np.diff(np.flatnonzero(record.u == 4.5)).min() > 1
        assert "u is exactly -4.5" in cid.audit(record, loop)["saturation"][0].text
    loop, record = kick(equal, 0.0, limits)
    said = cid.audit(record, replace(loop, input_limits=limits))["saturation"][0].text
    assert "The loop has these limits" in said


def test_limits_of_a_pid_are_known(servo):
    """What the controller of the loop keeps by itself is not asked for once more."""
    loop, r = servo
    limited = replace(loop, controller=replace(loop.controller, lower=-2.0, upper=2.0))
    record = cid.simulate(limited, r, sensor_noise=1e-4, seed=1)
    found = cid.audit(record, limited)
    assert found.saturated["u"][2:] == (-2.0, 2.0)
    assert "The loop has these limits" in found["saturation"][0].text
    assert "Give the limits" not in str(found)
    assert "Give the limits" in str(cid.audit(record, loop))


@pytest.mark.parametrize("n", [2, 5, 20])
def test_few_samples(n):
    y = np.random.default_rng(n).standard_normal(n)
    for record in (cid.Record(u=y, y=y, dt=1.0), cid.Record(r=0 * y, u=0 * y, y=y, dt=1.0)):
        found = cid.audit(record)
        assert "too few samples" in [f.kind for f in found.harmful]
        assert "TOO FEW SAMPLES" in str(found)
    none = cid.Record(u=y, y=y, dt=1.0, valid=np.zeros(n, bool))
    assert cid.audit(none).harmful[0].size == 0


def test_no_record_is_too_odd(servo):
    """Ramps, spikes, constants, steps, of any size, with any gaps: findings, never an exception."""
    for seed in range(300):
        rng = np.random.default_rng(seed)
        n, size = int(10 ** rng.uniform(0.31, 2.7)), 10.0 ** rng.integers(-12, 12)
        shapes = [
            rng.standard_normal(n),
            np.zeros(n),
            np.repeat(rng.choice([-1.0, 1.0], n), 7)[:n],
            np.round(rng.standard_normal(n)),
            np.clip(rng.standard_normal(n), -1, 1),
            np.arange(n) * 1.0,
            np.sin(0.1 * np.arange(n)),
            (rng.random(n) < 0.02) * 1.0,
        ]
        r, u, y = (size * shapes[rng.integers(8)] + rng.choice([0, 1e3 * size]) for _ in range(3))
        valid = rng.random(n) < rng.choice([0, 0.5, 0.95, 1])
        record = cid.Record(r=r if seed % 3 else None, u=u, y=y, dt=0.01, valid=valid)
        str(cid.audit(record, servo[0] if seed % 10 == 0 else None))


def test_only_what_counts_is_looked_at(healthy):
    _, record = healthy[0]
    y = record.y.copy()
    y[100:120] = y.max() + 1.0
    valid = np.ones(record.n, bool)
    valid[95:125] = False
    found = cid.audit(replace(record, y=y, valid=valid))
    assert found.harmful == ()
    assert cid.audit(replace(record, y=y)).harmful != ()


def test_constant_signals():
    y = np.random.default_rng(11).standard_normal(100)
    found = cid.audit(cid.Record(u=np.full(100, 2.0), y=y, dt=1.0, units={"u": "V"}))
    assert "u stays at 2 V" in found["constant signal"][0].text


def test_a_signal_that_is_stuck_most_of_the_time():
    rng = np.random.default_rng(12)
    r = np.repeat(rng.choice([-1.0, 1.0], 100), 20)
    u = r + 0.1 * rng.standard_normal(2000)
    fallen = np.full(2000, -0.3)
    fallen[:5] = [0.0, -0.02, -0.07, -0.15, -0.25]
    found = cid.audit(cid.Record(r=r, u=u, y=fallen, dt=0.01))["constant signal"]
    assert "y stays at -0.3 for 99.75 % of the samples" in found[0].text
    rests = np.zeros(2000)  # a drive that goes out and back now and then, and rests at nought
    r = np.zeros(2000)
    for k in (300, 900, 1500):
        r[k : k + 40], rests[k + 5 : k + 60] = 1.0, np.sin(np.linspace(0, np.pi, 55))
    assert not cid.audit(cid.Record(r=r, u=rests - r, y=rests, dt=0.01))["constant signal"]


def test_refusal_says_what_is_needed():
    with pytest.raises(cid.CtrlidError, match="audit needs a Record"):
        cid.audit([1, 2, 3])


@pytest.mark.parametrize(("name", "kinds"), [
    ("tanks_estimation", {("saturation", "y")}),
    ("emps", {("repeats", "r")}),
    ("servo_swept_sine", {("saturation", "u"), ("outliers", "y"), ("quantization", "y")}),
    ("inteco_pid_step", {("too little excitation", "r"), ("quantization", "y")}),
])  # fmt: skip
def test_measured_records(data_dir, name, kinds):
    record = cid.datasets.load(name)
    assert {(f.kind, f.channel) for f in cid.audit(record).findings} == kinds


def test_an_output_in_other_units_than_the_loop():
    loop = problems.levitation()
    r = cid.random_binary(1000, amplitude=2e-4, hold=50, around=0.012, seed=1)
    record = cid.simulate(loop, r, sensor_noise=1e-6, seed=2)
    assert not cid.audit(record, loop)["operating point"]
    for wrong in (replace(record, y=1e3 * record.y, r=1e3 * r), replace(record, y=record.u)):
        (finding,) = cid.audit(wrong, loop)["operating point"]
        assert finding.harmful
        assert "times the output of the operating point, 0.012." in finding.text
        with pytest.raises(CtrlidError, match="may be in another unit than the plant"):
            cid.diagnose(loop, wrong, progress=False)
    servo = problems.servo(cid.PID(kp=5.0))
    far = cid.simulate(servo, 5.0 + cid.random_binary(1000, amplitude=0.1, hold=50, seed=3))
    assert not cid.audit(far, servo)["operating point"]  # which rests at zero: nobody knows


@pytest.mark.parametrize("factor", [180 / np.pi, np.pi / 180, 1e3, 1e-3])
def test_r_in_another_unit_than_y_is_remarked_upon(factor):
    pid = cid.PID(kp=50.0, ki=80.0, kd=2.0)
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), pid, dt=0.01)
    for hold in (25, 100, 400):
        r = cid.random_binary(2000, amplitude=0.1, hold=hold, seed=1)
        record = cid.simulate(loop, r, sensor_noise=1e-3, seed=1)
        assert cid.audit(record)["units"] == ()
        (found,) = cid.audit(replace(record, r=record.r * factor))["units"]
        assert not found.harmful
        assert found.size == pytest.approx(1 / factor, rel=0.04)
        assert "it looks as if one is in" in found.text
        # Any other ratio may be that of a loop without integral action, or of another sensor.
        for other in (0.5, 1.2, 1.1 * factor, 100.0):
            assert cid.audit(replace(record, r=record.r * other))["units"] == ()
        # What does not follow r has no ratio to it.
        unlike = np.random.default_rng(1).standard_normal(record.n) / factor
        assert cid.audit(replace(record, y=unlike))["units"] == ()


# --- angles and counters that start over


def turning(amplitude=2.0):
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], 3.0 * u[0] - 2.0 * x[1]]), lambda t, x, u, p: x[0],
        inputs=["V"], outputs=["phi"], states=["phi", "w"], name="axle",
    )  # fmt: skip
    loop = cid.Loop(plant, cid.PID(kp=20.0, kd=1.0), dt=0.01)
    r = cid.random_binary(1500, amplitude=amplitude, hold=150, around=2.0, seed=3)
    return loop, cid.simulate(loop, r, sensor_noise=1e-3, seed=1)


@pytest.mark.parametrize(
    ("scale", "period", "words"),
    [(1.0, 2 * np.pi, "2 pi, a turn in radians"), (180 / np.pi, 360.0, "360, a turn in degrees"),
     (1e4, 65536.0, "65536, the range of a counter of 16 bits")],
)  # fmt: skip
def test_an_angle_that_starts_over_is_told_and_can_be_made_continuous(scale, period, words):
    loop, record = turning()
    y = scale * record.y
    wrapped = replace(record, y=np.mod(y + period / 2, period) - period / 2)
    (found,) = cid.audit(wrapped, loop)["wrapped"]
    assert found.harmful
    assert words in found.text
    assert not cid.audit(wrapped, loop)["controller"]
    again = np.unwrap(wrapped.y, period=period)
    np.testing.assert_allclose(again, y, atol=1e-9 * period)
    with pytest.raises(cid.CtrlidError, match=r"numpy.unwrap"):
        cid.diagnose(loop, wrapped)


JUMPS = {
    "telegraph": lambda rng: rng.choice([-3.1, 3.1], 600),
    "noise": lambda rng: 1.5 * rng.standard_normal(600).clip(-2, 2),
    "walk": lambda rng: np.cumsum(rng.standard_normal(600)),
    "switch": lambda rng: 256.0 * rng.integers(0, 2, 600),
    "lost readings": lambda rng: np.where(
        rng.random(600) < 0.01, 0.0, 4079.0 + rng.integers(0, 9, 600)
    ),
    "bytes": lambda rng: 127.0 * np.sign(np.sin(np.arange(600) / 20)),
    "steps": lambda rng: (
        3.1 * np.sign(np.sin(np.arange(600) / 20)) + 0.01 * rng.standard_normal(600)
    ),
}


@pytest.mark.parametrize("kind", JUMPS)
def test_jumps_of_other_kinds_are_no_turn(kind):
    rng = np.random.default_rng(7)
    record = cid.Record(u=rng.standard_normal(600), y=JUMPS[kind](rng), dt=0.01)
    assert not cid.audit(record)["wrapped"]


@pytest.mark.parametrize("digits", [2, 3, 4, 6])
def test_a_rounded_turn_is_a_turn(digits):
    """Plus and minus 3.142 are further apart than two pi."""
    y = np.round(np.mod(0.02 * np.arange(2000) + np.pi, 2 * np.pi) - np.pi, digits)
    record = cid.Record(u=np.sin(np.arange(2000) / 30), y=y, dt=0.01)
    (found,) = cid.audit(record)["wrapped"]
    assert found.size == 6


def test_a_reference_that_starts_over_as_well_is_told():
    _, record = turning()
    y = np.mod(record.y, 2 * np.pi)
    ramp = np.mod(np.linspace(0.0, 40.0, 1500), 2 * np.pi)
    (found,) = cid.audit(replace(record, y=y, r=ramp))["wrapped"]
    assert "make both continuous" in found.text
    (found,) = cid.audit(replace(record, y=y))["wrapped"]
    assert "reference" not in found.text


def test_each_of_several_outputs_may_start_over():
    _loop, record = turning()
    y = np.mod(record.y, 2 * np.pi)
    both = cid.Record(u=record.u, y=[record.y, y], names={"y": ("phi", "psi")}, dt=0.01)
    (found,) = cid.audit(both)["wrapped"]
    assert found.channel == "psi"
    assert "numpy.unwrap(the row of psi, period=2 * numpy.pi)" in found.text


# --- signals that repeat themselves


@pytest.mark.parametrize("phases", ["random", "schroeder"])
@pytest.mark.parametrize("period", [100, 200])
def test_a_periodic_input_is_neither_limited_nor_quantized(phases, period):
    """Each of its values comes as often as there are periods, the largest one too."""
    u = cid.multisine(2000, amplitude=1.0, period=period, seed=1, phases=phases)
    loop = cid.Loop(ct.tf([1], [1, 1]), None, dt=0.1)
    record = cid.simulate(loop, d=u, sensor_noise=1e-2, seed=1)
    assert not [f.kind for f in cid.audit(record).findings if f.channel == "u"]
    sine = replace(record, u=np.sin(2 * np.pi * np.arange(2000) / (period / 2)))
    assert not cid.audit(sine)["saturation"]


def test_a_periodic_input_that_is_limited_is_said_to_be():
    u = cid.multisine(2000, amplitude=1.0, period=200, seed=1, phases="random").clip(-0.5, 0.6)
    record = cid.Record(u=u, y=np.random.default_rng(0).standard_normal(2000), dt=0.1)
    (found,) = cid.audit(record)["saturation"]
    assert "-0.5 for 12 %" in found.text
    coarse = replace(record, u=0.02 * np.round(u / 0.02))
    assert cid.audit(coarse)["quantization"]


# --- an operating point that contradicts its states


def test_an_output_that_the_plant_does_not_show_at_its_states_is_told():
    plant = cid.plants.maglev(m=0.0213, K=3.34e-6)
    at = cid.operating_point(plant, output=0.012)
    G = cid.linearize(plant, at)
    law = cid.design_lead(G, crossover=100, phase_margin=50)
    right, wrong = (cid.Loop(plant, law, dt=0.001, at=replace(at, output=y)) for y in (0.012, 0.12))
    r = cid.random_binary(600, amplitude=1e-4, hold=20, around=0.012, seed=1)
    record = cid.simulate(right, r, sensor_noise=1e-5, seed=2)
    assert "ANOTHER" not in str(right)
    assert "THE OUTPUT IS ANOTHER: at these states the plant shows x = 0.012" in str(wrong)
    (found,) = cid.audit(record, wrong)["operating point"]
    assert found.harmful
    assert not cid.audit(record, right)["operating point"]
    with pytest.raises(cid.CtrlidError, match=r"the plant shows x = 0.012"):
        cid.redesign(G, wrong, crossover=100, phase_margin=50)
