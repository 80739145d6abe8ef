"""Records diagnosed together that do not have the same in them."""

import pytest

import ctrlid as cid
from ctrlid import effects as E
from ctrlid.diagnosis.several_records import describe_presence
from problems import drive, record_of

FEW = (E.ViscousFriction, E.CoulombFriction, E.InputDelay)


def diagnosed(*reals, seed, catalogue=FEW, n=700):
    records = [record_of(real, swing=0.3, hold=60, n=n, seed=seed + 10 * k, sensor_noise=1e-3)
               for k, real in enumerate(reals)]  # fmt: skip
    return cid.diagnose(drive(), records, catalogue=catalogue, progress=False)


def test_each_record_lacks_something_else(tmp_path):
    loop = drive()
    rubbing = loop.with_effect(E.CoulombFriction(fc=0.4))
    late = loop.with_effect(E.InputDelay(delay=0.008))
    found = diagnosed(rubbing, late, seed=8300, n=500)
    assert found.verdict == "explained"
    notes = {f.name: f.note for f in found.findings}
    assert notes == {"CoulombFriction": "seen in record 1 of 2 only",
                     "InputDelay": "seen in record 2 of 2 only"}  # fmt: skip
    assert {type(e).__name__ for e in found.loop.effects} == set(notes)
    assert "CoulombFriction (seen in record 1 of 2 only)" in found.sentence
    assert found.gap.after < 1.1 * found.gap.floor < 0.2 * found.gap.before
    assert any("each was diagnosed alone" in note for note in found.notes)
    assert str(cid.load_diagnosis(found.save(tmp_path / "found.json"), loop)) == str(found)


@pytest.mark.slow
def test_the_same_effect_in_two_sizes():
    loop = drive()
    reals = [loop.with_effect(E.CoulombFriction(fc=fc)) for fc in (0.3, 0.6)]
    found = diagnosed(*reals, loop, seed=8400, catalogue=(E.CoulombFriction,), n=1200)
    (finding,) = found.findings
    assert finding.name == "CoulombFriction"
    assert finding.note.startswith(
        "seen in records 1 and 2 of 3 only; each has its own size: fc = "
    )
    # The clearest record gives the size.
    assert finding.effect.fc == pytest.approx(0.6, abs=5 * finding.standard_errors["fc"])


@pytest.mark.slow
def test_a_parameter_that_changed_between_the_records():
    loop = drive()
    # What is wrongly blamed shows in a longer record.
    found = diagnosed(loop, loop.with_parameters({"k": 27.0}), seed=8500, n=1200)
    assert found.verdict == "unknown"
    assert not found.findings
    assert "but with different values: k = " in found.sentence
    (k,) = (c for c in found.calibrated if c.name == "k")
    assert 27.0 < k.after < 30.0


def test_in_which_records():
    assert describe_presence([0, 1], 2) == "seen in every record"
    assert describe_presence([0, 2], 3) == "seen in records 1 and 3 of 3 only"
    assert describe_presence([], 2) == "seen in no record alone"
