"""What is wrong with a stated controller, told from records of a simulator of its own."""

import numpy as np
import pytest
from scipy.linalg import expm

import ctrlid as cid

DT = 0.01
KP, KI, KD = 30.0, 20.0, 4.0
LIMIT = 2.0


def record_servo(fault="", noise=1e-3, seed=0, n=2500, dither=0.0, pulses=0.0):
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


def test_another_option_of_the_controller_is_named():
    record = record_servo()
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0),
                    cid.PID(kp=KP, kd=KD * 5 * DT, derivative="measurement"), dt=DT)  # fmt: skip
    found = cid.audit(record, loop)["filter"]
    assert "derivative='error'" in found[0].text


def record_pid(n=2000, limit=np.inf, measured=False, forward=False, wound=False, b=1.0, tf=0.0):
    """A mass on a spring under a PID written out in numpy, and the PID that it is stated to be."""
    rng = np.random.default_rng(11)
    whole = expm(DT * np.array([[0, 1, 0], [-3, -2, 1], [0, 0, 0]]))
    r = np.repeat(rng.choice([-0.3, 0.3], n // 40 + 1), 40)[:n]
    x, u, y = np.zeros(2), np.zeros(n), np.zeros(n)
    integral = slope = last = 0.0
    for j in range(n):
        y[j] = x[0] + 1e-3 * rng.standard_normal()
        difference = -y[j] if measured else r[j] - y[j]
        slope = (tf * slope + 4 * (difference - last)) / (tf + DT)
        last = difference
        step = 60 * DT * (r[j] - y[j])
        v = 40 * (b * r[j] - y[j]) + slope + integral + (0 if forward else step)
        if wound or not abs(v) > limit or v * step < 0:
            integral += step
        u[j] = round(float(np.clip(v, -limit, limit)), 3)
        x = whole[:2, :2] @ x + whole[:2, 2] * u[j]
    stated = cid.PID(kp=40.0, ki=60.0, kd=4.0, lower=-limit, upper=limit)
    loop = cid.Loop(cid.plants.servo(m=1.0, c=2.0, k=3.0), stated, dt=DT)
    return cid.Record(r=r, u=u, y=y, dt=DT), loop


@pytest.mark.parametrize(
    ("true", "said"),
    [({"measured": True}, "with derivative='measurement':"),
     ({"forward": True, "limit": 12.0}, "with integral='forward':"),
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


def test_a_pid_as_stated_stands():
    record, loop = record_pid(limit=12.0)
    assert "computes from r and y" in cid.audit(record, loop)["controller"][0].text


@pytest.mark.parametrize("added", [{}, {"dither": 0.3}, {"pulses": 0.5}])
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
