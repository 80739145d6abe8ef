"""Help and words that a stranger meets first."""

import copy
import inspect
import pickle
from dataclasses import replace

import pytest

import ctrlid as cid
from ctrlid._base.text import write_percent
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
    with pytest.raises(cid.CtrlidError, match=f"a PID has no {wrong}=; did you mean {near}="):
        cid.PID(**{wrong: 1.0})
    with pytest.raises(cid.CtrlidError, match="a PID has no zz=; it has kp, ki, kd"):
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
