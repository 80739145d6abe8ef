"""Help and words that a stranger meets first."""

import copy
import inspect
import pickle
import subprocess
import sys
import threading
from dataclasses import replace
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import effects as E
from ctrlid._base.text import write_percent
from ctrlid.diagnosis.findings import Disturbance
from ctrlid.diagnosis.noise_tests import NoiseTests
from ctrlid.diagnosis.verdict import write_conclusion
from problems import record_of, servo


@pytest.fixture(scope="module")
def record():
    return record_of(servo(cid.PID(kp=20.0, kd=1.0), dt=0.01), swing=0.1, hold=50, n=1000, seed=1,
                     sensor_noise=1e-3)  # fmt: skip


def test_the_help_of_diagnose_begins_with_short_words():
    signature = str(inspect.signature(cid.diagnose))
    assert len(signature) < 500
    assert "ctrlid." not in signature
    assert inspect.signature(cid.diagnose).parameters["catalogue"].default is None


@pytest.mark.parametrize(
    ("wrong", "near"), [("Kp", "kp"), ("Ki", "ki"), ("antiwindup", "anti_windup"),
                        ("filtertime", "filter_time"), ("antiWindup", "anti_windup")]
)  # fmt: skip
def test_a_pid_knows_what_was_meant(wrong, near):
    with pytest.raises(cid.CtrlidError, match=f"PID has no {wrong}=; did you mean {near}="):
        cid.PID(**{wrong: 1.0})
    with pytest.raises(cid.CtrlidError, match="PID has no zz=; it takes kp, ki, kd"):
        cid.PID(kp=1.0, zz=2.0)


def test_a_pid_is_copied_and_pickled_as_before():
    pid = cid.PID(kp=1.0, ki=2.0)
    assert copy.deepcopy(pid) == pickle.loads(pickle.dumps(pid)) == replace(pid) == pid


@pytest.mark.parametrize(
    ("wrong", "near"), [("Coulomb", "CoulombFriction"), ("coulombfriction", "CoulombFriction"),
                        ("Backlash", "InputBacklash"), ("Stribek", "StribeckFriction"),
                        ("DeadZone", "InputDeadZone")]
)  # fmt: skip
def test_effects_know_what_was_meant(wrong, near):
    with pytest.raises(AttributeError, match=f"did you mean {near}?"):
        getattr(cid.effects, wrong)
    assert not hasattr(cid.effects, "zzz")


def test_one_estimator_is_recommended_for_a_record_without_reference(record):
    """What fit_iv, check_feedback and the table of the manual say."""
    alone = replace(record, r=None)
    with pytest.raises(cid.CtrlidError, match="Without either use fit_continuous"):
        cid.fit_iv(alone, na=2, nb=2)
    assert "fit_continuous, which needs no reference" in cid.check_feedback(alone).text
    assert "feedback: fit_iv, by the reference" in cid.check_feedback(record).text


@pytest.mark.parametrize(
    ("share", "digits", "expected"),
    [(1.0, 2, "100 %"), (0.9999, 2, "100 %"), (34.21, 3, "3421 %"), (0.123, 2, "12 %"),
     (0.0, 2, "0 %"), (1e-9, 2, "under 0.001 %"), (3e-5, 2, "0.003 %"), (0.99961, 4, "99.96 %")],
)  # fmt: skip
def test_per_cent_are_plain_numbers(share, digits, expected):
    assert write_percent(share, digits) == expected


def test_a_comparison_has_no_trailing_blanks(record):
    text = str(cid.compare(record, servo(cid.PID(kp=20.0, kd=1.0), dt=0.01)))
    assert [line for line in text.splitlines() if line != line.rstrip()] == []


def make_spring(controller):
    """Return a loop whose plant has no parameters and consists of lambdas."""
    plant = ct.nlsys(lambda t, x, u, params: [x[1], u[0] - x[0]], lambda t, x, u, params: x[0],
                     states=2, inputs=1, outputs=1, name="spring")  # fmt: skip
    return cid.Loop(plant, controller, dt=0.01)


def test_a_plant_of_lambdas_is_diagnosed_and_pickled(tmp_path):
    """The plant has no parameter either, so that nothing competes with the one effect."""
    loop = make_spring(cid.PID(kp=6.0, ki=1.0, kd=0.8))
    record = record_of(loop.with_effect(cid.effects.CoulombFriction(fc=0.1)), swing=0.1, hold=40,
                       n=500, seed=1, sensor_noise=1e-4)  # fmt: skip
    found = cid.diagnose(loop, record, catalogue=[cid.effects.CoulombFriction], progress=False)
    assert [f.name for f in found.findings] == ["CoulombFriction"]
    for kept in (pickle.loads(pickle.dumps(found)), copy.deepcopy(found), copy.copy(found)):
        assert str(kept) == str(found)
        assert np.array_equal(cid.simulate(kept.loop, record.r).y,
                              cid.simulate(found.loop, record.r).y)  # fmt: skip
    file = tmp_path / "found.pickle"
    file.write_bytes(pickle.dumps(found))
    elsewhere = f"import pickle; print(pickle.load(open({str(file)!r}, 'rb')).loop)"
    told = subprocess.run([sys.executable, "-c", elsewhere], capture_output=True, text=True)
    assert told.stdout.strip() == str(found.loop), told.stderr


def test_a_controller_of_lambdas_is_pickled():
    law = ct.nlsys(None, lambda t, x, u, params: 3 * (u[0] - u[1]), inputs=["r", "y"],
                   outputs=["u"], dt=0.01)  # fmt: skip
    loop = make_spring(law)
    r = cid.random_binary(100, amplitude=0.1, hold=10, seed=1)
    again = pickle.loads(pickle.dumps(loop))
    assert np.array_equal(cid.simulate(again, r).y, cid.simulate(loop, r).y)


def test_a_plant_that_cannot_be_pickled_says_why_not():
    lock = threading.Lock()

    def rates(t, x, u, params):
        del t, params
        return [u[0] - x[0] if lock is not None else u[0]]

    plant = ct.nlsys(rates, None, states=1, inputs=1, outputs=1, name="locked")
    with pytest.raises(
        cid.CtrlidError, match=r"the plant of locked cannot be pickled .*lock.*save"
    ):
        pickle.dumps(cid.Loop(plant, dt=0.1))


@pytest.fixture(scope="module")
def fit(record):
    """A fit, which all that needs a loop refuses in its place."""
    return cid.fit_loop(servo(cid.PID(kp=20.0, kd=1.0), dt=0.01, free=("k",)), record[:200])


@pytest.mark.parametrize(
    "name",
    ["compare", "simulate", "audit", "replay_controller", "redesign", "fit_loop", "diagnose",
     "predict"],
)  # fmt: skip
def test_what_needs_a_loop_says_where_a_fit_has_it(record, fit, name):
    calls = {
        "compare": lambda: cid.compare(record, fit),
        "simulate": lambda: cid.simulate(fit, record.r),
        "audit": lambda: cid.audit(record, fit),
        "replay_controller": lambda: cid.replay_controller(fit, record),
        "redesign": lambda: cid.redesign(ct.tf([1.0], [1.0, 1.0]), fit, 10.0, 50.0),
        "fit_loop": lambda: cid.fit_loop(fit, record),
        "diagnose": lambda: cid.diagnose(fit, record, progress=False),
        "predict": lambda: cid.predict(fit, record),
    }
    with pytest.raises(cid.CtrlidError, match=r"LoopFit( and Record|\))?\. Give its \.loop$"):
        calls[name]()


def test_one_of_a_thing_is_no_plural():
    with pytest.raises(cid.CtrlidError, match=r"the plant 1 output \(x\)"):
        servo(ct.ss([], [], [], np.ones((1, 3)), 0.01), dt=0.01)
    quiet = Disturbance(0.0, 0.0, np.nan, 0.0)
    gap = SimpleNamespace(name="simulation", outputs=(), after=2.0, before=2.0, floor=1.0)
    tests = NoiseTests({"whiteness": 0.0}, np.zeros(3), {})
    for tried, words in ((1, "The one effect of the catalogue does not explain it."),
                         (7, "None of the 7 effects of the catalogue explains it.")):  # fmt: skip
        assert words in write_conclusion("unknown", [], gap, quiet, tests, (), tried=tried)


def test_milliseconds_that_were_taken_for_seconds_are_suspected(record):
    slow = replace(record, dt=10.0)
    words = "10 s is a thousand times as much, so that milliseconds were probably taken for seconds"
    loop = servo(cid.PID(kp=20.0, kd=1.0), dt=0.01)
    for call in (lambda: cid.predict(loop, slow), lambda: cid.compare(slow, loop)):
        with pytest.raises(cid.CtrlidError, match=words):
            call()
    with pytest.raises(cid.CtrlidError) as told:
        cid.predict(loop, replace(record, dt=0.011))
    assert "milliseconds" not in str(told.value)


@pytest.mark.parametrize(
    ("call", "words"),
    [(lambda: E.CoulombFriction(fc=-1), r"between 0 and inf \[output unit/s\^2\]; given -1"),
     (lambda: E.InputDelay("late"), r"needs a number for delay \[s\]; given 'late'"),
     (lambda: E.Quantization(np.nan), r"needs a finite step \[output unit\]; given nan"),
     (lambda: cid.random_binary(9, amplitude=1, hold=0.5), "a whole number of samples, at least 1"),
     (lambda: cid.random_binary(9, amplitude="1"), "finite number, in the unit of the signal"),
     (lambda: cid.multisine(9, amplitude=-1), "number above 0, in the unit of the signal"),
     (lambda: cid.plants.servo(m="1", c=1, k=1), r"needs a number as m \[kg\]; given '1' \(str\)"),
     (lambda: cid.fit_continuous(3, 2, 1, delay="1"), r"a number or None as delay \[s\]; given")],
)  # fmt: skip
def test_a_refused_value_is_told_its_unit(call, words):
    with pytest.raises(cid.CtrlidError, match=words):
        call()
