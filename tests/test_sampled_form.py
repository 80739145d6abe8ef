"""A transfer function without dt is an analog circuit: what if the record is of a sampled one?"""

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid.loop.sampled_form import find_sampled_form

DT = 0.01
ANALOG = ct.tf([0.8, 12.0], [0.01, 1.0])
LOUD = "THE LOGGED INPUT IS THAT OF A SAMPLED CONTROLLER"


def pendulum():
    def move(t, x, u, p):
        return np.array([x[1], p["a"] * np.sin(x[0]) - p["c"] * x[1] + p["b"] * u[0]])

    return ct.nlsys(move, lambda t, x, u, p: x[0], name="pend", inputs=["V"], outputs=["theta"],
                    states=["theta", "omega"], params={"a": 60.0, "b": 20.0, "c": 1.0})  # fmt: skip


def make_loop(controller, free=()):
    plant = pendulum()
    at = cid.operating_point(plant, output=0.0)
    return cid.Loop(plant, controller, dt=DT, at=at, free=free)


def record_with(controller, noise=2e-4, n=1500):
    r = cid.random_binary(n, amplitude=0.05, hold=25, seed=1)
    return cid.simulate(make_loop(controller), r, sensor_noise=noise, seed=1)


@pytest.mark.parametrize("rule", ["tustin", "zoh", "matched", "euler", "backward_diff"])
def test_the_rule_of_a_sampled_controller_is_found(rule):
    record = record_with(ct.sample_system(ANALOG, DT, rule))
    form = find_sampled_form(ANALOG, record)
    assert form.rule == rule
    assert form.left < 1e-12 < form.analog
    # A state-space system without dt is the same circuit, and so is one that reads r and y.
    assert find_sampled_form(ct.ss(ANALOG), record).rule == rule
    one, signs = ct.ss(ANALOG), np.array([[-1.0, 1.0]])
    pair = ct.ss(one.A, one.B @ signs, one.C, one.D @ signs, inputs=["y", "r"])
    if rule != "matched":
        assert find_sampled_form(pair, record).rule == rule


@pytest.mark.parametrize("noise", [0.0, 1e-5, 2e-4])
def test_an_analog_controller_is_none(noise):
    record = record_with(ANALOG, noise)
    assert find_sampled_form(ANALOG, record) is None
    # Nobody has to say how u runs between the samples for that.
    undeclared = cid.Record(r=record.r, u=record.u, y=record.y, dt=DT)
    assert find_sampled_form(ANALOG, undeclared) is None


def test_a_log_with_few_digits_and_limits_tells_as_well():
    record = record_with(ct.sample_system(ANALOG, DT, "tustin"))
    logged = cid.Record(r=record.r, u=np.round(record.u, 3), y=record.y, dt=DT)
    assert find_sampled_form(ANALOG, logged).rule == "tustin"
    limit = 0.9 * float(np.abs(record.u).max())
    cut = cid.Record(r=record.r, u=np.clip(record.u, -limit, limit), y=record.y, dt=DT)
    assert find_sampled_form(ANALOG, cut).rule == "tustin"


def test_every_room_says_so():
    record = record_with(ct.sample_system(ANALOG, DT, "tustin"))
    wrong = make_loop(ANALOG, free=("b",))
    (found,) = cid.audit(record, wrong).harmful
    assert found.kind == "sampled"
    assert "give the loop ct.sample_system(C, 0.01, 'tustin')" in found.text
    assert cid.fit_loop(wrong, record).estimate.notes[0].startswith(LOUD)
    notes = cid.fit_continuous(record, poles=2, controller=ANALOG).estimate.notes
    assert notes[0].startswith(LOUD)
    assert "give fit_continuous ct.sample_system" in notes[0]
    with pytest.raises(cid.CtrlidError, match=LOUD):
        cid.diagnose(wrong, record, progress=False)
    right = make_loop(ct.sample_system(ANALOG, DT, "tustin"), free=("b",))
    assert not cid.audit(record, right).harmful
    fitted = cid.fit_loop(right, record).estimate
    assert fitted.notes == ()
    assert abs(fitted["b"] - 20.0) < 0.1


def test_a_gain_is_as_the_record_says():
    gain = ct.tf([5.0], [1.0])
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    r = cid.random_binary(500, amplitude=0.1, hold=50, seed=1)
    held = cid.simulate(cid.Loop(plant, ct.tf([5.0], [1.0], DT), dt=DT), r, sensor_noise=1e-4)
    loop = cid.Loop(plant, gain, dt=DT)
    (found,) = cid.audit(held, loop).harmful
    assert found.kind == "sampled"
    assert "for an analog circuit the record hold='foh'" in found.text
    moving = cid.simulate(loop, r)
    assert moving.hold == "foh"
    assert not cid.audit(moving, loop).harmful
