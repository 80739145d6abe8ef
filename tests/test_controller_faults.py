"""What is wrong with a stated controller, told from records of a simulator of its own."""

from dataclasses import replace

import control as ct
import numpy as np
import pytest
from scipy.linalg import expm

import ctrlid as cid

DT = 0.01
KP, KI, KD = 30.0, 20.0, 4.0
LIMIT = 2.0


def record_servo(fault="", noise=1e-3, seed=0, n=1250, dither=0.0, pulses=0.0):
    """A mass on a spring under a PD controller with one fault, in plain numpy."""
    rng = np.random.default_rng(seed)
    m, c, k = rng.uniform(0.8, 1.2), rng.uniform(1, 3), rng.uniform(-4, 4)
    whole = expm(DT * np.array([[0, 1, 0], [-k / m, -c / m, 1 / m], [0, 0, 0]]))
    factor, late = rng.choice([rng.uniform(0.4, 0.9), rng.uniform(1.1, 2.5)]), 1
    r = np.repeat(rng.choice([-0.1, 0.1], n // 50 + 1), 50)[:n]
    x, u, y = np.zeros(2), np.zeros(n), np.zeros(n)
    wish, last, smooth = [], 0.0, 0.0
    for j in range(n):
        y[j] = x[0] + noise * rng.standard_normal()
        error = r[j] - y[j]
        smooth += 0.5 * (error - smooth)
        e = smooth if fault == "unknown" else error
        v = KP * e + KD * (e - last) * 5
        last = e
        if fault == "unknown":
            v += 300 * error**3
        wish.append({"gain": factor * v, "bias": v + 0.3 * factor}.get(fault, v))
        u[j] = wish[max(j - late, 0)] if fault == "delay" else wish[-1]
        if fault == "limit":
            u[j] = np.clip(u[j], -LIMIT, LIMIT)
        d = dither * rng.standard_normal() + pulses * (j % 300 < 60)
        u[j] += d
        x = whole[:2, :2] @ x + whole[:2, 2] * u[j]
    logged = -u if fault == "sign" else u
    return cid.Record(r=r, u=logged, y=y, dt=DT)


def stated_loop(gain=1.0):
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    return cid.Loop(plant, cid.PID(kp=gain * KP, kd=gain * KD * 5 * DT), dt=DT)


FAULTS = ("gain", "sign", "bias", "delay", "limit", "unknown")


def name_faults(record, loop):
    known = (*FAULTS, "filter")
    return [f.kind for f in cid.audit(record, loop).findings if f.kind in known]


@pytest.mark.parametrize("noise", [1e-4, 1e-2])
@pytest.mark.parametrize("fault", FAULTS)
def test_the_fault_of_a_controller_is_named(fault, noise):
    for seed in range(3):
        assert name_faults(record_servo(fault, noise, seed), stated_loop()) == [fault]


@pytest.mark.parametrize("controller", ["tf", "pid"])
@pytest.mark.parametrize("fault", ["gain", "bias", "unknown"])
def test_a_fault_is_named_where_an_effect_of_the_loop_has_a_state_of_its_own(fault, controller):
    effects = (cid.effects.InputBacklash(width=0.01), cid.effects.ActuatorLag(tau=0.03))
    loop = replace(stated_loop(), effects=effects)
    if controller == "tf":
        kp, kd = KP, KD * 5
        loop = replace(loop, controller=ct.tf([kp + kd, -kd], [1.0, 0.0], DT))
    assert name_faults(record_servo(fault), loop) == [fault]


def test_another_option_of_the_controller_is_named():
    record = record_servo()
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0),
                    cid.PID(kp=KP, kd=KD * 5 * DT, derivative="measurement"), dt=DT)  # fmt: skip
    found = cid.audit(record, loop)["filter"]
    assert "derivative='error'" in found[0].text
    assert str(found[0]).startswith("ANOTHER FILTER OR RULE: u is not what")


def record_pid(n=2000, limit=np.inf, measured=False, forward=False, wound=False, b=1.0, tf=0.0,
               ki=60.0, kd=4.0, kp=40.0, rule=None):  # fmt: skip
    """A mass on a spring under a PID written out in numpy, and the PID that it is stated to be."""
    rng = np.random.default_rng(11)
    whole = expm(DT * np.array([[0, 1, 0], [-3, -2, 1], [0, 0, 0]]))
    r = np.repeat(rng.choice([-0.3, 0.3], n // 40 + 1), 40)[:n]
    x, u, y = np.zeros(2), np.zeros(n), np.zeros(n)
    integral = slope = last = 0.0
    for j in range(n):
        y[j] = x[0] + 1e-3 * rng.standard_normal()
        difference = -y[j] if measured else r[j] - y[j]
        slope = (tf * slope + kd * (difference - last)) / (tf + DT)
        last = difference
        step = ki * DT * (r[j] - y[j])
        v = kp * (b * r[j] - y[j]) + slope + integral + (0 if forward else step)
        if rule == "reset" and abs(v) > limit:
            integral = 0.0
        elif rule == "half" and abs(v) > limit:
            integral += 0.5 * step
        elif rule == "late" and j and abs(u[j - 1]) >= limit:
            pass
        elif wound or not abs(v) > limit or v * step < 0:
            integral += step
        u[j] = round(float(np.clip(v, -limit, limit)), 3)
        x = whole[:2, :2] @ x + whole[:2, 2] * u[j]
    stated = cid.PID(kp=40.0, ki=ki, kd=kd, lower=-limit, upper=limit)
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), stated, dt=DT)
    return cid.Record(r=r, u=u, y=y, dt=DT), loop


@pytest.mark.parametrize(
    ("true", "said"),
    [({"measured": True}, "with derivative='measurement':"),
     ({"forward": True, "limit": 12.0}, "with integral='forward':"),
     # Where the integral is slow, 0.99 times the law leaves hardly anything.
     ({"forward": True, "ki": 20.0, "kd": 0.0}, "with integral='forward':"),
     ({"wound": True, "limit": 12.0}, "with anti_windup='none':"),
     ({"b": 0.0}, "with b=0.0:"),
     ({"measured": True, "forward": True},
      "with derivative='measurement' and integral='forward':"),
     ({"tf": 0.025}, "with filter_time=0.025:"),
     ({"tf": 0.04, "measured": True}, "with filter_time=0.04 and derivative='measurement':")],
)  # fmt: skip
def test_the_options_of_a_pid_are_tried_and_named(true, said):
    record, loop = record_pid(**true)
    texts = [f.text for f in cid.audit(record, loop).findings if f.kind in ("filter", "limit")]
    assert any(said in text for text in texts), texts


@pytest.mark.parametrize(
    "rule", [*(pytest.param(k, marks=pytest.mark.slow) for k in ("reset", "half")), "late"]
)
def test_another_rule_at_the_limit_does_not_speak_against_the_law(rule):
    record, loop = record_pid(limit=12.0, rule=rule)
    (found,) = cid.audit(record, loop)["anti-windup"]
    assert "leaves its limits by another rule (anti-windup)" in found.text
    # What is a hundredth of u steers no simulation; more than that forbids one.
    simulated = "closed-loop simulation" in [c.label for c in cid.compare(record, loop).curves]
    assert simulated == (found.size < 0.01) == (rule != "half")
    # Other gains are no matter of the limits.
    wrong, _ = record_pid(limit=12.0, rule=rule, kp=44.0)
    assert not any("Gains and structure are right" in f.text
                   for f in cid.audit(wrong, loop).findings)  # fmt: skip


def record_by_another_converter(read, logged, seed, factor=1.0, still=False, n=2500):
    """A mass on a spring under a PD controller that reads y with other noise than the logger."""
    rng = np.random.default_rng(seed)
    whole = expm(DT * np.array([[0, 1, 0], [-3, -2, 1], [0, 0, 0]]))
    r = np.repeat(rng.choice([-0.3, 0.3], n // 40 + 1), 40)[:n] * (not still)
    x, u, y, last = np.array([0.1, 0.0]), np.zeros(n), np.zeros(n), 0.0
    for k in range(n):
        error = r[k] - x[0] - read * rng.standard_normal()
        y[k] = x[0] + logged * rng.standard_normal()
        u[k] = factor * (40 * error + 16 * (error - last))
        last = error
        x = whole[:2, :2] @ x + whole[:2, 2] * (u[k] + 0.05 * rng.standard_normal())
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), cid.PID(kp=40.0, kd=16 * DT), dt=DT)
    return cid.Record(r=r, u=u, y=y, dt=DT), loop


@pytest.mark.parametrize(
    ("read", "logged"),
    [(0.0, 1e-3), (1e-4, 1e-3), (1e-3, 1e-3), pytest.param(0.0, 0.05, marks=pytest.mark.slow)],
)
def test_a_logger_with_noise_of_its_own_does_not_speak_against_the_law(read, logged):
    for seed in range(4):
        record, loop = record_by_another_converter(read, logged, seed)
        (found,) = [f for f in cid.audit(record, loop).findings if f.kind in (*FAULTS, "logger")]
        assert found.kind == "logger"
        assert "Gains and structure are right" in found.text


@pytest.mark.parametrize("still", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_other_gains_are_no_noise_of_the_logger(still):
    for seed in range(4):
        for factor, noise in ((1.1, 0.0), (1.3, 1e-4), (0.7, 1e-4)):
            record, loop = record_by_another_converter(1e-3, noise, seed, factor, still, 1200)
            assert not cid.audit(record, loop)["logger"]


def test_a_pid_as_stated_stands():
    record, loop = record_pid(limit=12.0)
    assert "computes from r and y" in cid.audit(record, loop)["controller"][0].text


@pytest.mark.parametrize(
    "added", [{}, pytest.param({"dither": 0.3}, marks=pytest.mark.slow), {"pulses": 0.5}]
)
def test_an_exact_law_stands_under_what_is_added(added):
    for seed in range(5):
        record = record_servo(seed=seed, **added)
        assert name_faults(record, stated_loop()) == []
        labels = [c.label for c in cid.compare(record, stated_loop()).curves]
        assert "closed-loop simulation" in labels


def test_every_rejected_law_leaves_the_same_prediction():
    record = record_servo(noise=1e-2, seed=4)
    found = [cid.compare(record, stated_loop(gain)) for gain in (0.7, 1.5, 2.5)]
    for one in found:
        assert "closed-loop simulation" not in [c.label for c in one.curves]
        assert any("the law of the controller is rejected" in note for note in one.notes)
    fits = [[c.fit for c in one.curves] for one in found]
    assert fits[0] == pytest.approx(fits[1], rel=1e-9)
    assert fits[0] == pytest.approx(fits[2], rel=1e-9)


def test_a_cut_record_and_a_gap_do_not_blame_the_controller():
    record = record_servo(noise=1e-2, seed=5)
    assert name_faults(record[701:], stated_loop()) == []
    valid, y = np.ones(record.n, bool), record.y.copy()
    valid[1000:1040], y[1000:1040] = False, 5.0
    gappy = cid.Record(r=record.r, u=record.u, y=y, dt=DT, valid=valid)
    assert name_faults(gappy, stated_loop()) == []


# --- filters and other ways of sampling, of a PID and of a transfer function


def record_filtered(fault, limit=np.inf, seed=0, n=1500, noise=1e-3):
    """The mass under a PID with a filtered derivative; one filter or rule is not as stated."""
    rng = np.random.default_rng([seed, 7])
    whole = expm(DT * np.array([[0, 1, 0], [-3.0, -2.0, 1.0], [0, 0, 0]]))
    r = np.repeat(rng.choice([-0.1, 0.1], n // 50 + 1), 50)[:n]
    share, factor = rng.uniform(0.3, 0.8), rng.uniform(1.2, 1.8)
    # Only a fast filter by Tustin's rule is not one by differences with another time constant.
    time = 0.002 if fault == "tustin" else 0.02
    kp, ki, kd = (k * (factor if fault == name else 1.0)
                  for k, name in ((KP, "kp"), (KI, "ki"), (KD, "kd")))  # fmt: skip
    kept = {"another time": factor * time, "no filter": 0.0}.get(fault, time)
    x, u, y = np.zeros(2), np.zeros(n), np.zeros(n)
    integral = slope = last = y_slow = e_slow = u_slow = 0.0
    for j in range(n):
        y[j] = x[0] + noise * rng.standard_normal()
        y_slow += (share if fault == "y" else 1.0) * (y[j] - y_slow)
        e_slow += (share if fault == "error" else 1.0) * (r[j] - y_slow - e_slow)
        e, moved = e_slow, e_slow - last
        last = e
        if fault == "tustin":
            slope = ((2 * time - DT) * slope + 2 * kd * moved) / (2 * time + DT)
        else:
            slope = (kept * slope + kd * moved) / (kept + DT)
        wish = kp * e + integral + ki * DT * e + slope
        cut = min(max(wish, -limit), limit)
        if not ((wish > limit and e > 0) or (wish < -limit and e < 0)):
            integral += ki * DT * e
        u_slow += (share if fault == "output" else 1.0) * (cut - u_slow)
        u[j] = u_slow
        x = whole[:2, :2] @ x + whole[:2, 2] * u[j]
    pid = cid.PID(KP, KI, KD, filter_time=time, lower=-limit, upper=limit)
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), pid, dt=DT)
    return cid.Record(r=r, u=u, y=y, dt=DT), loop


@pytest.mark.parametrize(
    ("fault", "kind", "words"),
    [("y", "filter", "that of y behind"), ("error", "filter", "low-pass"),
     ("output", "filter", "low-pass"), ("another time", "filter", "filter_time="),
     ("no filter", "filter", "filter_time=0"), ("tustin", "filter", "Tustin"),
     ("kp", "gain", "proportional"), ("ki", "gain", "integral"), ("kd", "gain", "derivative")],
)  # fmt: skip
def test_a_filter_or_one_gain_of_a_pid_is_named(fault, kind, words):
    found = cid.audit(*record_filtered(fault)).harmful
    assert [f.kind for f in found] == [kind]
    assert words in found[0].text


@pytest.mark.parametrize("fault", ["y", "error", "output", "another time", "kd"])
def test_a_filter_is_named_beside_limits(fault):
    found = cid.audit(*record_filtered(fault, limit=6.0)).harmful
    assert [f.kind for f in found] == ["gain" if fault == "kd" else "filter"]


def sample_lead(kp, kd, time, rule, dt):
    """Numerator and denominator of (kp + kd s)/(1 + time s), sampled by a rule."""
    if rule == "tustin":
        h = 2 / dt
        return [kp + kd * h, kp - kd * h], [1 + time * h, 1 - time * h]
    if rule == "backward":
        return [kp + kd / dt, -kd / dt], [1 + time / dt, -time / dt]
    if rule == "forward":
        return [kd / dt, kp - kd / dt], [time / dt, 1 - time / dt]
    pole = np.exp(-dt / time)
    high = kd / time
    return [high, kp - pole * kp - high], [1.0, -pole]


@pytest.mark.parametrize("ran", ["tustin", "backward", "forward", "zoh", "slower"])
def test_another_rule_of_sampling_is_named(ran):
    rng = np.random.default_rng(3)
    n, time = 1200, 0.04
    whole = expm(DT * np.array([[0, 1, 0], [-3.0, -2.0, 1.0], [0, 0, 0]]))
    stated = "backward" if ran == "tustin" else "tustin"
    num, den = (np.array(v) for v in (
        sample_lead(KP, KD, 1.5 * time, "tustin", DT) if ran == "slower"
        else sample_lead(KP, KD, time, ran, DT)))  # fmt: skip
    r = np.repeat(rng.choice([-0.1, 0.1], n // 50 + 1), 50)[:n]
    x, u, y, last, before = np.zeros(2), np.zeros(n), np.zeros(n), 0.0, 0.0
    for j in range(n):
        y[j] = x[0] + 1e-3 * rng.standard_normal()
        e = r[j] - y[j]
        u[j] = (num[0] * e + num[1] * last - den[1] * before) / den[0]
        last, before = e, u[j]
        x = whole[:2, :2] @ x + whole[:2, 2] * u[j]
    law = ct.tf(*sample_lead(KP, KD, time, stated, DT), DT)
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), law, dt=DT)
    found = cid.audit(cid.Record(r=r, u=u, y=y, dt=DT), loop).harmful
    assert [f.kind for f in found] == ["filter"]


# --- an analog controller, of which the log has samples only


def record_analog(fault="", noise=0.0, seed=0, n=1000, steps=10):
    """The mass under an analog lead with one fault, both integrated between the samples."""
    rng = np.random.default_rng([seed, 8])
    time = 0.04
    r = np.repeat(rng.choice([-0.1, 0.1], n // 50 + 1), 50)[:n]
    factor = rng.choice([rng.uniform(0.5, 0.9), rng.uniform(1.1, 2.0)])
    gain, bias = (factor if fault == "gain" else 1.0), (0.5 if fault == "bias" else 0.0)
    slow = rng.uniform(1, 3) * DT

    def compute_input(s, r):
        e = r - s[0]
        if fault == "unknown":
            e += 30 * e * abs(e)
        wish = gain * (KD / time * e + s[2]) + bias
        lead = (-s[2] + (KP - KD / time) * e) / time
        moved = (wish - s[3]) / slow
        u = s[3] if fault == "filter" else wish
        return (np.clip(u, -2.5, 2.5) if fault == "limit" else u), lead, moved

    def differentiate(s, r):
        u, lead, moved = compute_input(s, r)
        return np.array([s[1], u - 2.0 * s[1] - 3.0 * s[0], lead, moved])

    s, u, y, h = np.zeros(4), np.zeros(n), np.zeros(n), DT / steps
    for j in range(n):
        y[j], u[j] = s[0] + noise * rng.standard_normal(), compute_input(s, r[j])[0]
        for _ in range(steps):
            k1 = differentiate(s, r[j])
            k2 = differentiate(s + h / 2 * k1, r[j])
            k3 = differentiate(s + h / 2 * k2, r[j])
            s = s + h / 6 * (k1 + 2 * k2 + 2 * k3 + differentiate(s + h * k3, r[j]))
    u = {"sign": -u, "delay": np.r_[u[0], u[:-1]]}.get(fault, u)
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), ct.tf([KD, KP], [time, 1.0]), dt=DT)
    return cid.Record(r=r, u=u, y=y, dt=DT), loop


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("fault", [*FAULTS, "filter"])
def test_the_fault_of_an_analog_controller_is_named(fault, noise):
    assert name_faults(*record_analog(fault, noise)) == [fault]


@pytest.mark.parametrize("noise", [0.0, 1e-4, 1e-3])
def test_an_analog_controller_stands(noise):
    record, loop = record_analog("", noise)
    assert name_faults(record, loop) == []
    if not noise:
        assert "as far as samples tell" in cid.audit(record, loop)["controller"][0].text


def test_a_nonlinear_analog_controller_is_not_checked():
    record, loop = record_analog()
    law = ct.nlsys(None, lambda t, x, u, p: 30 * u[0], inputs=1, outputs=1, name="law")
    nonlinear = cid.Loop(loop.plant, law, dt=DT)
    assert name_faults(record, nonlinear) == []


# --- what is wrong may be the log


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        ({"u": -1.0}, "but has the opposite sign: "),
        ({"y": 180 / np.pi, "r": 180 / np.pi}, r"0.01745 times that (pi/180, degrees for radians)"),
        ({"y": np.pi / 180, "r": np.pi / 180}, r"57.3 times that (180/pi, radians for degrees)"),
        ({"u": 1e3}, "1000 times that (as between wholes and thousandths (milli))"),
        ({"u": 1e-2}, "0.01 times that (as between per cent and shares of one)"),
        ({"u": 1.7}, "1.7 times that: "),
    ],
)
def test_an_audit_blames_the_controller_or_the_log_and_knows_units(spoil, words):
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), cid.PID(kp=20.0, kd=1.0), dt=DT)
    r = cid.random_binary(600, amplitude=0.1, hold=25, seed=1)
    record = cid.simulate(loop, r, sensor_noise=1e-4, seed=1)
    given = {key: spoil.get(key, 1.0) * getattr(record, key) for key in ("r", "u", "y")}
    (found,) = [f for f in cid.audit(cid.Record(**given, dt=DT), loop).harmful if f.channel == "u"]
    assert words in found.text
    assert found.text.endswith("Correct the controller or the log.")


@pytest.mark.parametrize(
    "stated", [{}, pytest.param({"kp": 60.0, "filter_time": 0.05}, marks=pytest.mark.slow)]
)
def test_a_wrong_sign_is_what_is_said_first(stated):
    """Also where the gains or the noise of the logger hide that only the sign is wrong."""
    pid = cid.PID(kp=50.0, ki=20.0, kd=2.0, filter_time=0.02, lower=-5.0, upper=5.0)
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), pid, dt=DT)
    r = cid.random_binary(600, amplitude=0.1, hold=50, seed=1)
    record = cid.simulate(loop, r, sensor_noise=1e-4, seed=2)
    other = replace(loop, controller=replace(pid, **stated))
    noise = 0.02 * np.std(record.u) * np.random.default_rng(0).standard_normal(record.n)
    for u in (-record.u, -record.u + noise):
        found = cid.audit(replace(record, u=u), other).findings[0]
        assert found.kind == "sign"
        assert "opposite sign" in found.text
        compared = cid.compare(replace(record, u=u), other)
        assert compared.verdict.startswith("CHECK THE CONTROLLER AND THE LOG FIRST: u ")
        assert compared.verdict.index("opposite sign") < compared.verdict.index("The fit")
    # A law that only has other gains is not said to have another sign.
    kinds = [f.kind for f in cid.audit(replace(record, u=record.u + noise), other).findings]
    assert "sign" not in kinds
    assert cid.compare(record, loop).rejection == ""
