"""A diagnosis as text, file, picture and page: what each verdict says, and that nothing is lost."""

import dataclasses
import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import effects as E
from ctrlid import plot
from ctrlid.diagnosis import gap as gap_of
from ctrlid.diagnosis import wording
from ctrlid.diagnosis.findings import BinnedErrors, Calibrated, Candidate, Disturbance, Finding, Gap
from ctrlid.diagnosis.loading import load_diagnosis
from ctrlid.diagnosis.noise_tests import NoiseTests, choose_alarm_level
from ctrlid.diagnosis.recalibration import fit_base_model
from ctrlid.diagnosis.result import Diagnosis
from ctrlid.diagnosis.saving import SavedLoop
from ctrlid.diagnosis.several_records import merge_diagnoses
from ctrlid.diagnosis.thresholds import THRESHOLD
from ctrlid.diagnosis.verdict import describe_grounds, gap_stands_out
from ctrlid.diagnosis.where import locate_errors
from ctrlid.reporting import pictures as _pictures
from ctrlid.reporting.tables import make_blocks
from ctrlid.validation.record_simulation import prepare_stretch
from ctrlid.validation.reproduction import CLOSED_LOOP
from problems import drive, legend, levitation, record_of, servo

DT, N = 0.002, 3000
VERDICTS = ("nothing missing", "explained", "partly explained", "unknown")
FLAT = np.array([1.02, 0.97, 1.0, 1.04, 0.98, 0.99, 1.03, 1.0])
BAD = np.array([1.0, 1.05, 1.4, 3.02, 2.9, 1.5, 1.1, 1.0])
SENTENCES = {
    "nothing missing": "Noise and random forces explain the record; no candidate earns a place.",
    "explained": "CoulombFriction explains the disagreement; what is left looks like noise.",
    "partly explained": "CoulombFriction earned its place, but something remains.",
    "unknown": "The model disagrees with the record, and no candidate earns its place.",
}


@pytest.fixture(scope="module")
def experiment():
    """The loop, the record of one with friction, and simulations without and with it."""
    loop = levitation(dt=DT)
    true = loop.with_effect(E.CoulombFriction(fc=0.4))
    record = record_of(true, swing=3e-4, hold=100, n=N, seed=1, sensor_noise=1e-5, force_noise=0.03)
    return loop, record, cid.simulate(loop, record.r), cid.simulate(true, record.r)


def rms(error):
    return float(np.sqrt(np.mean(error**2)))


def tried():
    rows = (
        (1, E.CoulombFriction(fc=0.3987), 790.0, 812.4, ""),
        (1, E.StribeckFriction(fs=0.41, vs=0.3), 780.0, 811.0, ""),
        (1, E.ViscousFriction(c=6.0), 402.0, 431.5, "WRONG SIGN"),
        (1, E.ActuatorLag(tau=0.0), 102.0, math.nan, ""),
        (1, E.CubicStiffness(k3=0.0), 0.4, math.nan, ""),
        (2, E.InputDelay(delay=1e-4), 6.1, 6.5, ""),
        (2, E.InputSaturation(lower=-math.inf, upper=9.0), 2.0, 2.1, ""),
    )
    return tuple(Candidate(k, e, s, g, 5.0, remark) for k, e, s, g, remark in rows)


@pytest.fixture(scope="module")
def found(experiment):
    """A diagnosis by verdict."""
    loop, record, before, after = experiment
    y, b, a = (x.y[2 * N // 3 :] for x in (record, before, after))
    floor = rms(y - a)
    finding = Finding(
        E.CoulombFriction(fc=0.3987), {"fc": 0.0061}, (E.StribeckFriction(fs=0.41, vs=0.3),), (),
        812.4, 0.995, "slow motion with reversals: the force jumps when the motion turns",
        0.012 + 1e-4 * np.sin(np.arange(200) / 20),
    )  # fmt: skip
    made = {}
    for verdict in VERDICTS:
        good = verdict == "nothing missing"
        rest = {"partly explained": 0.6 * a + 0.4 * b, "unknown": b}.get(verdict, a)
        first = a if good else b
        gap = Gap("simulation", 1.3 * rms(y - first), rms(y - first), rms(y - rest),
                  floor, "m", record.t[2 * N // 3 :], y, first, rest, closed_loop=True)  # fmt: skip
        levels = (FLAT if good else BAD, FLAT if good or verdict == "explained" else BAD)
        chances = tuple(0.4 if v is FLAT else 1e-30 for v in levels)
        where = (
            BinnedErrors("velocity", "m/s", np.linspace(-0.04, 0.04, 9), *levels, *chances,
                         "where the motion turns"),
            BinnedErrors("position", "m", np.linspace(0.0113, 0.0127, 9), *levels, *chances, ""),
            BinnedErrors("time", "s", np.linspace(0, 4, 9), FLAT, FLAT, 0.3, 0.4,
                         "all the time alike"),
        )  # fmt: skip
        findings = (finding,) if "explained" in verdict else ()
        made[verdict] = Diagnosis(
            verdict, SENTENCES[verdict], findings,
            loop.with_effect(finding.effect) if findings else loop, gap, where, tried(),
            Disturbance(0.03, 0.4, 0.11, 0.81) if good else Disturbance(0.03, 0.0, math.nan, 0.12),
            (Calibrated("K", 3.1e-6, 3.31e-6, 3.3391e-6, 2.1e-9),
             Calibrated("m", 0.0213, 0.0213, 0.0213, math.inf)),
            {"CoulombFriction.fc": 0.021, "ActuatorLag.tau": 1.1e-4, "Homemade.size": 3.0,
             "StribeckFriction.vs": math.inf},
            {"whiteness": 0.41 if good or verdict == "explained" else 1e-9, "heavy tails": 0.22},
            ("u moves in steps of 0.00122 V",), ("two samples were left out",),
            "maglev, 3000 samples at 0.002 s", 8.4, {"horizon": 25, "table": np.eye(2)},
        )  # fmt: skip
    return made


def text(diagnosis):
    return " ".join(str(diagnosis).split())


@pytest.mark.parametrize("verdict", VERDICTS)
def test_report_is_read_in_a_minute(found, verdict):
    lines = str(found[verdict]).splitlines()
    assert len(lines) <= 45
    assert max(map(len, lines)) <= 100
    assert SENTENCES[verdict] in text(found[verdict])
    for part in ("maglev, 3000 samples", "closed-loop simulation of 1000 samples kept back",
                 "the model as given", "noise floor", "random force", "computed in 8.4 s",
                 "about the record: u moves in steps", "note: two samples were left out",
                 "0.0213 (not determined by the data)"):  # fmt: skip
        assert part in text(found[verdict])
    assert "likelihood" not in text(found[verdict])


def test_report_of_an_explanation(found):
    words = text(found["explained"])
    for part in (
        "Explained. CoulombFriction explains",
        "CoulombFriction: a force of constant size against the motion, as of dry surfaces",
        "fc = 0.3987 ± 0.0061 m/s^2 (8.49 mN at m = 0.0213 kg)",
        "evidence 812 (very strong); ONE OF 2 EFFECTS that explain the record",
        "this record cannot distinguish it from StribeckFriction (fs = 0.41 m/s^2, vs = 0.3 m/s)",
        "to decide, use slow motion with reversals",
        "the reference signal for it is in .reference of this finding (200 samples)",
        "velocity where the motion turns 1.74 1.02",
        "position between 0.0118 and 0.012 m 1.74 1.02",
        "K 3.1e-06 3.31e-06 (3.3391 ± 0.0021)e-06",
        "On these samples the effects remove",
        "random force: white (30 mm/s^2 RMS); it causes 12 % of the variance of the noise floor",
        "residuals: noise, by 2 tests. The smallest p-value is that of heavy tails, p = 0.22",
        "Chance reaches 2 or 3; from 10 on evidence is strong, from 30 on very strong. Names are "
        "of the catalogue. What is not in it and acts like one of them is taken for that one",
    ):
        assert part in words
    assert "time all the time alike" not in words
    partly = replace(found["explained"], verdict="partly explained")
    assert "Names are of the catalogue" not in text(partly)


def test_report_of_a_clean_bill(found):
    words = text(found["nothing missing"])
    assert "Nothing missing. Noise" in words
    assert "where the error is: nowhere. In bins of velocity, position and time, the one" in words
    assert "size of each effect that 80 of 100 records like this one would have shown" in words
    assert "CoulombFriction.fc 21 mm/s^2" in words
    assert "ActuatorLag.tau 0.11 ms" in words
    assert "Homemade.size 3" in words
    assert "StribeckFriction.vs not visible" in words
    assert "A LARGE RANDOM FORCE: white (30 mm/s^2 RMS) and coloured (0.4 m/s^2 RMS, time " in words
    assert "it causes 81 % of the variance of the noise floor" in words
    assert "what is missing" not in words


def test_a_parameter_at_its_limit_is_said_to_be(found):
    stuck = replace(found["explained"].calibrated[0], after=3.1e-5, standard_error=0.0)
    assert "3.1e-05 (ON ITS BOUND)" in text(replace(found["explained"], calibrated=(stuck,)))


def test_one_of_many_tests_may_look_bad(found):
    """The verdict counts how many tests there are; the line on what remains does not deny it."""
    tests = {**{f"test {k}": 0.5 for k in range(30)}, "rhythm of K": 4e-4}
    words = text(replace(found["explained"], tests=tests))
    assert (
        "noise, by 31 tests. The smallest p-value is that of a periodic change of K, p = 0" in words
    )
    assert "p = 0.0004, which is 0.012 for the smallest of 31" in words
    tiny = text(replace(found["explained"], tests={**tests, "rhythm of K": 8.5e-6}))
    assert "p = 8.5e-06, which is 0.00026 for the smallest of 31" in tiny
    assert "NOT NOISE ALONE" not in words
    assert "NOT NOISE ALONE" in text(replace(found["unknown"], tests={**tests, "whiteness": 1e-6}))


def test_an_error_that_the_effects_bring_in_has_its_place(found):
    """A test of the final errors that fails is no test of the errors before."""
    axes = {"input": np.linspace(0, 1, 800)}
    z = np.random.default_rng(1).standard_normal(800)
    moved = np.where(axes["input"] > 0.9, z + 0.7, z)
    was = NoiseTests({"mean by input": 7e-3, "size by input": 0.5}, z, axes)
    now = NoiseTests({"mean by input": 1e-7, "size by input": 0.5}, moved, axes)
    (place,) = locate_errors(was, now, {"input": "V"})
    assert place.words.startswith("at input from 0.9")
    assert "V, afterwards the output is above its prediction by " in place.words
    assert "afterwards" not in locate_errors(now, was, {})[0].words
    base = found["partly explained"]
    assert "where the error is: nowhere" not in text(replace(base, where=(place,)))
    assert "V, afterwards the output is above" in text(replace(base, where=(place,)))
    # It is not cut off behind those that were there before.
    strong = [replace(base.where[0], axis=axis) for axis in "abcd"]
    told = wording.list_telling_places(replace(base, where=(*strong, place)))
    assert [p.axis for p in told] == ["a", "b", "c", "d", "input"]
    quiet = replace(place, p_after=0.3)
    nowhere = text(replace(base, where=(quiet, replace(quiet, output="T"))))
    assert "where the error is: nowhere. In bins of input, the one-step errors" in nowhere
    # Tests of what depends on a quantity see more than any of its bins alone.
    seen = replace(base, where=(quiet,), tests={"mean by input": 0.2, "force by input": 1e-9})
    assert (
        "where the error is: in no bin of input do the one-step errors differ from noise by "
        "themselves, but together they show a force that depends on input" in text(seen)
    )


def test_places_of_errors_are_those_of_the_completed_model():
    """A recalibration that ran away sees states in which the rig never was."""
    rng = np.random.default_rng(0)
    p = {"mean by ca": 1e-9, "size by ca": 0.5}
    away = NoiseTests(p, 3 * rng.standard_normal(500), {"ca": rng.uniform(0.1, 0.2, 500)})
    true = NoiseTests(p, rng.standard_normal(500), {"ca": rng.uniform(0.4, 0.5, 500)})
    (place,) = locate_errors(away, true, {"ca": "mol/l"})
    assert 0.39 < place.edges[0] < place.edges[-1] < 0.51
    assert "at ca from 0.4" in place.words


def test_a_name_that_does_not_stand_is_said_once(found):
    (one,) = found["explained"].findings
    why = describe_grounds([(one, "A, and on fresh data B"), (one, "A, and on fresh data B")])
    assert why is not None
    assert why.count("does not stand") == 1
    assert why.endswith(" does not stand, since A, and on fresh data B")
    two = describe_grounds([(one, "A"), (one, "B")])
    assert two is not None
    assert two.endswith(" does not stand, since A and since B")


def test_an_alarm_of_many_effects_is_told(found):
    partly = found["partly explained"]
    many = replace(partly, findings=partly.findings * 4, tests={"whiteness": 1.5e-3, "size": 0.5})
    assert "residuals: NOT NOISE ALONE. 1 of 2 tests fails: whiteness (p = 0.0015)" in text(many)


def test_the_more_effects_the_sooner_an_alarm():
    assert choose_alarm_level(0) == choose_alarm_level(1) == THRESHOLD.false_alarm
    assert choose_alarm_level(3) == pytest.approx(3 * THRESHOLD.false_alarm)


def test_bad_news_is_in_capitals(found):
    assert "PARTLY EXPLAINED: SOMETHING IS STILL MISSING. " in text(found["partly explained"])
    assert "residuals: NOT NOISE ALONE. 1 of 2 tests fails: whiteness (p < 0.0001)" in text(
        found["unknown"]
    )
    assert "UNKNOWN: SOMETHING IS MISSING. The model disagrees" in text(found["unknown"])
    assert "with the effects" not in text(found["unknown"])
    assert "It may stand in for an effect that is not in the catalogue" in text(
        found["partly explained"]
    )
    many = dict.fromkeys(("a", "b", "c", "d", "e", "f"), 1e-5)
    words = text(replace(found["unknown"], tests={**many, "g": 0.5}))
    assert "6 of 7 tests fail: a, b, c and 3 others (smallest p < 0.0001)" in words
    assert "velocity where the motion turns 1.74" in text(found["unknown"])
    base = found["explained"]
    worse = replace(base, gap=replace(base.gap, after=2 * base.gap.before))
    assert "the effects do NOT REDUCE THE GAP" in text(worse)
    for given, widened in ((0.5 * base.gap.before, True), (base.gap.before, False)):
        other = replace(base, gap=replace(base.gap, given=given))
        assert ("Recalibration alone decreases" in text(other)) == widened
    lost = replace(base, gap=replace(base.gap, given=math.inf, before=math.inf))
    assert "DIVERGES" in text(lost)
    assert "of the mean square error" not in text(lost)


def test_a_recalibration_that_ends_on_a_limit_is_marked(found, tmp_path):
    base = found["explained"]
    c = replace(base.calibrated[0], name="k", given=2.0, before=0.2, at_limit=True)
    assert "k ENDS AT ITS LIMIT" in text(replace(base, calibrated=(c,)))
    page = cid.write_report(replace(base, calibrated=(c,)), tmp_path / "report.html")
    assert "k ENDS AT ITS LIMIT" in page.read_text("utf-8")
    assert "LIMIT" not in text(replace(base, calibrated=(replace(c, at_limit=False),)))


def test_what_the_effects_close_counts_from_the_smaller_gap(found):
    base = found["explained"]
    gap = replace(base.gap, given=2.0, before=2.0, recalibrated=9.0, after=1.0, floor=0.9,
                  widest=0.9)  # fmt: skip
    words = text(replace(base, gap=gap))
    assert "recalibrated" in words
    assert "9.00" in words
    assert "the effects remove 94 % of the mean square" in words
    assert "Recalibration alone decreases" in words
    output = plot.diagnosis(replace(base, gap=gap))[0]
    assert legend(output)[1] == "closed-loop simulation, model as given"


def test_a_gap_without_a_noise_floor_says_so(found):
    base = found["explained"]
    bare = replace(base, findings=base.findings * 2, gap=replace(base.gap, floor=math.nan))
    words = text(bare)
    assert "noise floor none because the completed model breaks off when simulated with" in words
    assert "of the mean square error would return" in words
    assert "above the noise floor" not in words
    assert "due to sensor noise and random force alone" in text(base)


def test_report_of_rare_cases(found):
    base = found["explained"]
    finding = base.findings[0]
    weak = replace(finding, evidence=8.0, alternatives=(), equivalents=("InputOffset",),
                   experiment="", reference=None, note="in 2 of 3 records")  # fmt: skip
    words = text(replace(base, findings=(weak, replace(weak, evidence=20.0)), where=()))
    assert "1. CoulombFriction" in words
    assert "2. CoulombFriction" in words
    assert "evidence 8.0 (WEAK); without it, 99.5 % of the mean square error above the" in words
    assert "evidence 20 (strong)" in words
    assert "no record of u and y can distinguish it from InputOffset, because on this" in words
    # The other one may have another value, or the other sign.
    tied = replace(weak, alternatives=(E.InputOffset(offset=-0.02),))
    words = text(replace(base, findings=(tied,), where=()))
    assert "distinguish it from InputOffset (offset = -20 mV), because on this plant" in words
    assert "in 2 of 3 records" in words
    assert "where the error is: not known" in words
    bare = replace(base, calibrated=(), tests={}, disturbance=Disturbance(0.0, 0.0, math.nan, 0.0),
                   gap=replace(base.gap, unit="", floor=0.0))  # fmt: skip
    words = text(bare)
    assert "the model has no free parameters" in words
    assert "residuals: not tested" in words
    assert "random force: none was found; the noise floor is due to sensor noise alone" in words


def test_repr_and_notebook(found):
    assert repr(found["explained"]).startswith("Diagnosis(explained: CoulombFriction; gap 8.")
    assert repr(found["unknown"]).startswith("Diagnosis(unknown; gap ")
    page = found["explained"]._repr_html_()
    assert page.startswith('<pre class="ctrlid"')
    assert ">Diagnosis of maglev" in page
    assert found["explained"].effects == (E.CoulombFriction(fc=0.3987),)


def same(one, other):
    """Compare values field by field, arrays by their numbers."""
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and np.array_equal(one, other, equal_nan=True)
    if isinstance(one, float) and math.isnan(one):
        return math.isnan(other)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[k], other[k]) for k in one)
    if dataclasses.is_dataclass(one) and not isinstance(one, cid.Loop):
        fields = dataclasses.fields(one)
        return type(one) is type(other) and all(
            same(getattr(one, f.name), getattr(other, f.name)) for f in fields
            if f.name not in ("loop", "extra")
        )  # fmt: skip
    return one == other or isinstance(one, cid.Loop)


@pytest.mark.parametrize("verdict", VERDICTS)
def test_round_trip(found, experiment, verdict, tmp_path):
    given = found[verdict]
    before = given.gap.simulated_before.copy()
    before[:3] = np.nan, np.inf, -np.inf
    given = replace(given, gap=replace(given.gap, simulated_before=before, given=math.inf))
    path = given.save(tmp_path / "found.json")
    json.loads(path.read_text("utf-8"), parse_constant=pytest.fail)  # no NaN, no Infinity
    back = load_diagnosis(path)
    assert same(given, back)
    assert same(back, given)
    assert str(back) == str(given)
    assert back.extra == {"horizon": 25, "table": [[1.0, 0.0], [0.0, 1.0]]}
    assert back.save(tmp_path / "again.json").read_bytes() == path.read_bytes()
    whole = load_diagnosis(path, loop=experiment[0].with_parameters({"K": 1e-6}))
    assert whole.loop.parameters == given.loop.parameters
    assert whole.loop.effects == given.loop.effects
    assert (whole.loop.free, whole.loop.at) == (given.loop.free, given.loop.at)
    r = experiment[1].r[:200]
    np.testing.assert_array_equal(cid.simulate(whole.loop, r).y, cid.simulate(given.loop, r).y)
    assert whole.save(tmp_path / "whole.json").read_text() == path.read_text()


def test_a_person_can_read_the_file(found, tmp_path):
    rows = found["explained"].save(tmp_path / "f.json").read_text("utf-8").splitlines()
    assert rows[2] == '  "verdict": "explained",'
    assert '        "name": "CoulombFriction",' in rows
    assert max(map(len, rows)) < 250
    data = json.loads("\n".join(rows))
    assert data["findings"][0]["effect"] == {
        "name": "CoulombFriction",
        "parameters": {"fc": 0.3987},
    }
    assert data["loop"]["plant"] == "maglev"


def test_a_loop_without_its_plant_says_what_to_do(found, tmp_path):
    back = load_diagnosis(found["explained"].save(tmp_path / "f.json"))
    assert isinstance(back.loop, SavedLoop)
    assert back.loop.parameters["CoulombFriction.fc"] == 0.3987
    with pytest.raises(cid.CtrlidError, match=r"load_diagnosis\(file, loop=loop\)"):
        back.loop.linearize()
    with pytest.raises(cid.CtrlidError, match="so that its 'signals' is not known"):
        cid.compare(record_of(servo(), swing=0.1, hold=20, n=200, seed=1), back.loop)


def test_a_finding_by_itself_is_told_as_in_the_report(found, tmp_path):
    base = found["explained"]
    (finding,) = base.findings
    told = replace(finding, units={"fc": "N"})
    assert "fc = 0.3987 ± 0.0061 N, evidence 812" in str(told)
    assert "likelihood" not in str(told)
    assert "evidence 8.0" in str(replace(told, evidence=8.0))
    back = load_diagnosis(replace(base, findings=(told,)).save(tmp_path / "f.json"))
    assert str(back.findings[0]) == str(told)
    # Files of earlier versions do not know the units.
    path = base.save(tmp_path / "old.json")
    data = json.loads(path.read_text("utf-8"))
    for one in data["findings"]:
        del one["units"]
    path.write_text(json.dumps(data), "utf-8")
    assert str(load_diagnosis(path)) == str(base)


def test_a_loop_that_does_not_fit_is_refused(found, tmp_path):
    path = found["explained"].save(tmp_path / "f.json")
    with pytest.raises(cid.CtrlidError, match=r"of the plant 'maglev'; the loop given has 'servo'"):
        load_diagnosis(path, loop=servo())
    with pytest.raises(cid.CtrlidError, match=r"loop= needs the Loop .* given int"):
        load_diagnosis(path, loop=3)


def test_own_effects_are_found_by_name(found, tmp_path):
    @dataclasses.dataclass(frozen=True)
    class Homemade(E.ForceEffect):
        size: float = E.parameter("{y}/s^2", neutral=0.0)

        def force(self, m):
            return self.size

    base = found["explained"]
    mine = replace(base, findings=(replace(base.findings[0], effect=Homemade(size=2.0)),))
    path = mine.save(tmp_path / "f.json")
    assert load_diagnosis(path).findings[0].effect == Homemade(size=2.0)
    stranger = path.read_text("utf-8").replace('"Homemade"', '"Unheard"')
    path.write_text(stranger, "utf-8")
    with pytest.raises(cid.CtrlidError, match=r"'Unheard', but no effect .*; import it first"):
        load_diagnosis(path)


def test_sizes_that_are_shown_with_other_probabilities(found, tmp_path):
    clean = replace(
        found["nothing missing"], sensitivity={"CoulombFriction.fc": 0.05},
        sensitivity_errors={"CoulombFriction.fc": 0.01},
    )  # fmt: skip
    assert clean.find_sensitivity() == clean.sensitivity
    half, most = (clean.find_sensitivity(p)["CoulombFriction.fc"] for p in (0.5, 0.95))
    assert half == pytest.approx(0.05 - 0.8416 * 0.01, abs=1e-6)
    assert most == pytest.approx(0.05 + (1.6449 - 0.8416) * 0.01, abs=1e-6)
    assert load_diagnosis(clean.save(tmp_path / "f.json")).find_sensitivity(0.5) == {
        "CoulombFriction.fc": half
    }
    with pytest.raises(cid.CtrlidError, match="a probability between 0 and 1; given 1"):
        clean.find_sensitivity(1.0)
    older = replace(clean, sensitivity_errors={})
    with pytest.raises(cid.CtrlidError, match="without the standard errors of its sensitivity"):
        older.find_sensitivity(0.5)
    assert replace(older, sensitivity={}).find_sensitivity(0.5) == {}


def test_what_is_no_saved_diagnosis_is_refused(found, tmp_path):
    path = tmp_path / "f.json"
    with pytest.raises(cid.CtrlidError, match=r"cannot read .*No such file"):
        load_diagnosis(path)
    with pytest.raises(cid.CtrlidError, match="cannot be written to"):
        found["explained"].save(tmp_path / "nowhere" / "f.json")
    for content, reason in (("{", "is not a saved diagnosis: "), ("[]", "has the format 'list'"),
                            ('{"format": "x"}', "has the format 'x'"),
                            ('{"format": "ctrlid diagnosis 1"}', "damaged: 'loop'")):  # fmt: skip
        path.write_text(content)
        with pytest.raises(cid.CtrlidError, match=reason):
            load_diagnosis(path)


def test_what_is_no_text_is_left_out_and_said(found, tmp_path):
    odd = replace(found["explained"], extra={"plant": object(), "n": 3})
    path = odd.save(tmp_path / "f.json")
    assert json.loads(path.read_text("utf-8"))["left out of extra"] == ["plant"]
    assert load_diagnosis(path).extra == {"n": 3}


def test_picture_of_an_explanation(found):
    output, error, first, second, ranking = plot.diagnosis(found["explained"])
    gap = found["explained"].gap
    assert legend(output) == ["measured", "closed-loop simulation, recalibrated model",
                              "closed-loop simulation, with CoulombFriction"]  # fmt: skip
    assert output.get_ylabel() == "output [mm]"
    assert error.get_ylabel() == "error [µm]"
    assert legend(error) == [f"±2 x noise floor, {1e6 * gap.floor:.3g} µm",
                             f"before: RMS {1e6 * gap.before:.3g} µm",
                             f"after: RMS {1e6 * gap.after:.3g} µm"]  # fmt: skip
    assert error.get_xlabel() == "time [s], where the gap is largest among 1000 samples kept back"
    assert [ax.get_xlabel() for ax in (first, second)] == ["velocity [mm/s]", "position [mm]"]
    assert set(legend(first)) == {"before", "after", "noise"}
    edges = [bars.get_data().edges for bars in first.patches]
    places = {place.axis: 1e3 * place.edges for place in found["explained"].where}
    assert len(edges) == 3
    for drawn in edges:
        np.testing.assert_allclose(drawn, places["velocity"])
    assert set(legend(ranking)) == {
        "required net gain, 5",
        "found",
        "not told apart",
        "put out",
        "fitted, not taken",
        "screened only, not fitted",
    }
    names = [tick.get_text() for tick in ranking.get_yticklabels()]
    assert names == ["", "CoulombFriction", "StribeckFriction", "ViscousFriction", "ActuatorLag",
                     "CubicStiffness", "", "InputDelay", "InputSaturation"]  # fmt: skip
    assert "BIC" in ranking.get_xlabel()
    assert plot.png(output).startswith(b"\x89PNG")


@pytest.mark.parametrize("verdict", ["nothing missing", "unknown"])
def test_picture_without_effects(found, verdict):
    output, _, first, _, ranking = plot.diagnosis(found[verdict])
    assert legend(output) == ["measured", "closed-loop simulation, recalibrated"]
    assert set(legend(first)) == {"recalibrated", "noise"}
    assert "found" not in legend(ranking)
    plot.png(output)


def test_an_effect_is_drawn_as_found_in_the_round_that_took_it(found):
    """A lag stood in for friction in round 1 with the longest bar, was dropped, and came back."""
    base = found["explained"]
    bar = next(c for c in base.ranking if type(c.effect).__name__ == "CoulombFriction")
    ranking = tuple(replace(bar, round=k, gain=g) for k, g in ((1, 900.0), (2, 400.0), (3, 2.0)))
    rounds = _pictures.make_ranking(replace(base, ranking=ranking))
    assert {k: bars[0].kind for k, bars in rounds.items()} == {
        "round 1": "fitted, not taken", "round 2": "found", "round 3": "fitted, not taken"
    }  # fmt: skip
    assert rounds["round 2"][0].evidence == base.findings[0].evidence
    shown = [t.get_text() for t in plot.diagnosis(replace(base, ranking=ranking))[4].texts]
    assert any(t.endswith(f"; evidence {base.findings[0].evidence:.0f}") for t in shown)


def test_a_bar_beyond_the_line_that_is_no_name_is_explained(found):
    """A bar of 55 that no fit had confirmed stood beyond the line, and nothing said what it was."""
    base = found["explained"]
    rows = {type(c.effect).__name__: c for c in base.ranking}
    friction = rows["CoulombFriction"]
    cases = (
        (rows["ActuatorLag"], "screened only, not fitted", "was only screened"),
        (rows["ViscousFriction"], "put out", "is put out"),
        (replace(rows["ViscousFriction"], remark=""), "fitted, not taken", "takes one effect"),
        (replace(rows["InputDelay"], round=1, gain=30.0, taken=True),
         "taken, later replaced or dropped", "gives way"),
    )  # fmt: skip
    for other, kind, words in cases:
        shown = replace(base, ranking=(friction, other))
        (bars,) = _pictures.make_ranking(shown).values()
        assert {bar.label: bar.kind for bar in bars} == {
            "CoulombFriction": "found", type(other.effect).__name__: kind}  # fmt: skip
        ax = plot.diagnosis(shown)[4]
        assert kind in legend(ax)
        caption = " ".join(ax.texts[-1].get_text().split())
        assert caption.startswith("A bar beyond the dashed line need not be a name")
        assert words in caption
        unsure = [t for t in ax.texts if t.get_text().startswith("about ")]
        assert bool(unsure) == (kind == "screened only, not fitted")
        below = replace(base, ranking=(friction, replace(other, score=1.0, gain=other.gain * 0)))
        assert _pictures.explain_bars(_pictures.make_ranking(below)) == ""


def test_two_drifts_are_told_apart_by_their_parameters(found, tmp_path):
    """Headline, picture and page said "ParameterDrift and ParameterDrift", and not of what."""
    base = found["explained"]
    drifts = [E.ParameterDrift("K", rate=-0.01), E.ParameterDrift("m", rate=0.02)]
    one, two = (replace(base.findings[0], effect=e, alternatives=(), standard_errors={"rate": 1e-3})
                for e in drifts)  # fmt: skip
    assert wording.join_names([one, two]) == "ParameterDrift of K and ParameterDrift of m"
    assert wording.join_names([replace(one, alternatives=(drifts[1],))]) == (
        "ParameterDrift of K or ParameterDrift of m"
    )
    rows = tuple(Candidate(1, e, 90.0, g, 5.0) for e, g in zip(drifts, (90.0, 80.0), strict=True))
    both = replace(base, findings=(two,), ranking=rows,
                   sensitivity={"ParameterDrift of m.rate": 0.1})  # fmt: skip
    assert [(bar.label, bar.kind) for bar in _pictures.make_ranking(both)["round 1"]] == [
        ("ParameterDrift of K", "fitted, not taken"), ("ParameterDrift of m", "found")]  # fmt: skip
    assert legend(plot.diagnosis(both)[0])[-1].endswith("with ParameterDrift of m")
    assert "1. ParameterDrift of m: a parameter of the plant drifts" in text(both)
    assert wording.list_sensitivity_rows(both) == [("ParameterDrift of m.rate", "0.1 1/s")]
    page = cid.write_report(both, tmp_path / "report.html").read_text("utf-8")
    assert all(f">ParameterDrift of {name}<" in page for name in "Km")
    doubted = replace(one, alternatives=(drifts[1],))
    assert "ONE OF 2 EFFECTS" in wording.describe_certainty(both, doubted)


def test_a_name_that_does_not_stand_is_no_find_in_the_picture(found):
    base = found["explained"]
    doubted = replace(base, findings=(), stand_ins=base.findings)
    kinds = {bar.kind for bar in _pictures.make_ranking(doubted)["round 1"]}
    assert "in the model, but its name does not stand" in kinds
    assert "found" not in kinds


def test_a_shorter_bar_that_was_taken_is_explained(found):
    base = found["explained"]
    friction, *_ = base.ranking
    longer = replace(friction, effect=E.ViscousFriction(c=6.0), gain=900.0)
    rounds = _pictures.make_ranking(replace(base, ranking=(friction, longer)))
    assert "looked back" in _pictures.explain_bars(rounds)
    longer = replace(longer, gain=500.0)
    rounds = _pictures.make_ranking(replace(base, ranking=(friction, longer)))
    assert "looked back" not in _pictures.explain_bars(rounds)


def test_the_caption_stays_in_the_figure(found):
    picture = plot.diagnosis(found["explained"])
    picture.figure.draw_without_rendering()
    box, page = picture[4].texts[-1].get_window_extent(), picture.figure.bbox
    assert page.x0 <= box.x0
    assert box.x1 <= page.x1
    assert box.y0 >= page.y0
    assert box.y1 <= picture[4].xaxis.label.get_window_extent().y0


def test_legends_stay_in_the_figure_and_ticks_are_plain_numbers(found):
    base = found["explained"]
    wide = replace(base.gap, unit="a long unit", floor=1.23e-4, before=1234.5, after=987.6)
    far = replace(base.where[0], edges=np.r_[-5e3, np.linspace(-740, 700, 7), 5e3], unit="V")
    picture = plot.diagnosis(replace(base, gap=wide, where=(far, base.where[1])))
    picture.figure.draw_without_rendering()
    for ax in picture:
        made = ax.get_legend()
        assert made is None or made.get_window_extent().x1 <= picture.figure.bbox.x1
        shown = [t.get_text() for t in (*ax.get_xticklabels(), *ax.get_yticklabels())]
        assert not any("e+" in t for t in shown)
    assert "-740" in [t.get_text() for t in picture[2].get_xticklabels()]


def test_the_unit_circle_is_round():
    for size in ((4, 6), (9, 3)):
        (ax,) = plot.poles(ct.tf([1, 1], [1, -2.01, 1], 0.005), plot.figure(size=size))
        ax.figure.draw_without_rendering()
        (x0, y0), (x1, y1) = ax.transData.transform([(0, 0), (1, 1)])
        assert x1 - x0 == pytest.approx(y1 - y0)


def test_a_candidate_that_no_round_took_is_not_drawn_as_found(found):
    # What is found by other means than a round of the search, such as a converter's steps.
    base = found["explained"]
    lost = tuple(replace(c, gain=-5.0) for c in base.ranking)
    bars = [
        bar for bars in _pictures.make_ranking(replace(base, ranking=lost)).values() for bar in bars
    ]
    assert bars
    assert "found" not in {bar.kind for bar in bars}


def test_picture_of_rare_cases(found):
    base = found["explained"]
    gone = np.full_like(base.gap.measured, np.nan)
    place = replace(base.where[0], edges=np.r_[-np.inf, base.where[0].edges[1:]], before=300 * BAD,
                    axis="frequency", unit="Hz")  # fmt: skip
    gap = replace(base.gap, simulated_before=gone, before=math.nan, floor=0.0, unit="")
    odd = replace(base, gap=gap, where=(place,), ranking=())
    output, error, first, second, ranking = plot.diagnosis(odd)
    assert output.get_ylabel() == "output [unit not given]"
    assert legend(error)[0] == "before: none"
    assert first.get_yscale() == "log"
    assert [entry.get_text() for entry in second.texts] == ["no bins to show"]
    assert [entry.get_text() for entry in ranking.texts] == ["no candidate was tried"]
    plot.png(output)


def test_predictions_at_some_samples_only_are_drawn_as_lines(found):
    base = found["explained"]
    sparse = np.where(np.arange(len(base.gap.time)) % 3 == 0, base.gap.simulated_after, np.nan)
    gap = replace(base.gap, kind="prediction", horizon=12, simulated_after=sparse)
    output, error, *_ = plot.diagnosis(replace(base, gap=gap))
    for ax in (output, error):
        drawn = [line.get_ydata() for line in ax.get_lines() if "after" in line.get_label()
                 or "prediction, with" in line.get_label()]  # fmt: skip
        assert len(drawn) == 1
        assert len(drawn[0]) > 5
        assert np.isfinite(drawn[0]).all()


def test_simulations_far_away_are_said_to_be_outside_the_picture(found):
    base = found["explained"]
    for far, words in ((1.0, ", outside this picture"), (0.0, "")):
        gap = replace(base.gap, simulated_before=base.gap.simulated_before + far,
                      simulated_after=base.gap.simulated_after - far)  # fmt: skip
        output = plot.diagnosis(replace(base, gap=gap))[0]
        models = ("recalibrated model", "with CoulombFriction")
        assert legend(output)[1:] == [f"{gap.name}, {which}{words}" for which in models]
        assert np.ptp(output.get_lines()[0].get_ydata()) >= 0.25 * np.ptp(output.get_ylim())


def test_text_and_picture_count_the_same_samples(found):
    """The text counted both of two outputs and the picture one, or one record and the text all."""
    base = found["explained"]
    part = replace(base.gap, samples=1000, output="x")
    for gap, kept, among in (
        (replace(base.gap, samples=2000, outputs=(part, replace(part, output="z"))), 1000, "1000"),
        (replace(base.gap, samples=2500), 2500, "1000 of 2500"),
        (replace(base.gap, samples=0), 1000, "1000"),
    ):
        same = replace(base, gap=gap)
        assert f"simulation of {kept} samples kept back" in text(same)
        label = plot.diagnosis(same)[1].get_xlabel()
        assert label == f"time [s], where the gap is largest among {among} samples kept back"


def test_predictions_at_some_samples_are_counted_as_a_part_of_those_kept_back(found):
    """A picture said "375 of 26 samples": of 375 kept back, 26 were predicted."""
    base = found["explained"]
    sparse = np.where(np.arange(1000) % 40 == 0, base.gap.simulated_after, np.nan)
    ahead = replace(base.gap, kind="prediction", horizon=160, simulated_after=sparse, samples=25)
    several = replace(ahead, samples=60)  # of three records
    pair = replace(ahead, samples=50, outputs=(ahead, replace(ahead, output="z")))
    for gap, told, drawn in (
        (ahead, "at 25 of the 1000 samples kept back", "25 of 1000 samples kept back"),
        (pair, "at 25 of the 1000 samples kept back", "25 of 1000 samples kept back"),
        (several, "at 60 of the samples kept back", "25 of 60 samples kept back"),
    ):
        same = replace(base, gap=gap)
        assert f"RMS error of the 160-step prediction {told}" in text(same)
        label = plot.diagnosis(same)[1].get_xlabel()
        assert label == f"time [s], where the gap is largest among {drawn}"


def test_a_rejected_law_is_said_to_make_the_gap_one_of_predictions(tmp_path):
    loop = drive()
    record = record_of(loop, swing=0.1, hold=60, n=400, seed=1, sensor_noise=1e-4)
    other = replace(loop, controller=cid.PID(kp=4.0, ki=4.0, kd=0.3, filter_time=0.02))
    words = ("The law of the controller is rejected, since it is not what computed the logged "
             "input, so that this gap is that of predictions, which use")  # fmt: skip
    for model, there in ((loop, False), (other, True)):
        judged = cid.diagnose(model, record, catalogue=(), progress=False)
        assert (judged.gap.kind == "prediction") == there
        assert (words in text(judged)) == there
        page = cid.write_report(judged, tmp_path / "report.html").read_text("utf-8")
        assert (words in page) == there
        assert str(load_diagnosis(judged.save(tmp_path / "found.json"))) == str(judged)
    blind = cid.diagnose(replace(loop, controller=None), record, catalogue=(), progress=False)
    assert "No controller is given, and the plant alone does not come to rest" in text(blind)
    mute = cid.diagnose(loop, replace(record, r=None), catalogue=(), progress=False)
    assert "The record lacks a reference of the controller" in text(mute)


def test_picture_on_given_axes(found):
    axes = plot.figure(5)
    assert list(plot.diagnosis(found["explained"], axes)) == list(axes[:, 0])
    with pytest.raises(cid.CtrlidError, match="needs 5 matplotlib Axes; given 1"):
        plot.diagnosis(found["explained"], axes[0, 0])
    with pytest.raises(cid.CtrlidError, match="draws a Diagnosis, as diagnose"):
        plot.diagnosis(3)


def test_the_stretch_drawn_has_the_largest_gap_and_no_break():
    n = 1000
    time = 0.01 * np.arange(n)
    error = np.zeros(n)
    error[600:700] = 1.0
    gap = Gap("simulation", 1.0, 1.0, 1.0, 0.1, "m", time, error, np.zeros(n), np.zeros(n))
    part = _pictures.find_largest_gap(gap)
    assert part.start <= 600
    assert part.stop >= 700
    broken = np.where(np.arange(n) < 650, time, time + 5.0)
    part = _pictures.find_largest_gap(replace(gap, time=broken))
    assert part.start >= 650 or part.stop <= 650
    fields = ("time", "measured", "simulated_before", "simulated_after")
    short = replace(gap, **{k: getattr(gap, k)[:40] for k in fields})
    assert _pictures.find_largest_gap(short) == slice(0, 40)


@pytest.mark.parametrize("verdict", VERDICTS)
def test_page(found, verdict, tmp_path):
    path = cid.write_report(found[verdict], tmp_path / "report.html")
    page = path.read_text("utf-8")
    assert "<h1>Diagnosis of maglev, 3000 samples at 0.002 s</h1>" in page
    assert page.count('src="data:image/png;base64,') == 1
    assert ("<h3>What is missing</h3>" in page) == ("explained" in verdict)
    assert "<h3>Where the error is</h3>" in page
    assert SENTENCES[verdict] in page
    bad = verdict in ("unknown", "partly explained")
    assert ('<p class="bad">' in page) == (bad or verdict == "nothing missing")
    assert ("SOMETHING IS" in page) == bad
    assert ("1. CoulombFriction: a force of constant size" in page) == ("explained" in verdict)
    assert ("size that 80 of 100 records like this one would have shown" in page) == (
        verdict == "nothing missing"
    )
    assert ("LARGE RANDOM FORCE" in page) == (verdict == "nothing missing")
    assert "StribeckFriction" in page
    assert "<h3>About the record</h3>\n<p>u moves in steps of 0.00122 V.</p>" in page


def test_a_gap_where_only_the_given_model_can_be_simulated():
    nothing = np.zeros(3)
    gap = Gap("simulation", 2.7e-3, math.inf, math.inf, math.nan, "m", *[nothing] * 4)
    rows = {label: size for label, size, _ in wording.list_gap_rows(gap)}
    assert rows["the model as given"] == "2.70 mm"
    assert rows["recalibrated"] == "DIVERGES"


def test_a_window_far_from_rest_finds_its_start():
    """In a stretch that begins far away, the operating point is no place to begin from."""
    loop = levitation(dt=DT, gap=0.013, free=(), input_limits=(0.0, 4.5))
    r = np.linspace(loop.at.output, 0.006, 4000) + cid.random_binary(
        4000, amplitude=1e-4, hold=50, seed=1
    )
    record = cid.simulate(loop, r, sensor_noise=2e-6, seed=2)[3500:]
    assert abs(record.y[0] - loop.at.output) > 4e-3
    window = gap_of.make_window(record)
    error = gap_of.root_mean_square([window], [gap_of.simulate_window(loop, window, CLOSED_LOOP)])
    assert error < 1e-5


def test_an_unknown_force_is_not_paid_for_by_an_absurd_start():
    """Behind a lag, a huge input that dies at once could stand for a kick, and did: 700 V."""
    loop = drive((), cid.plants.servo(m=1.0, c=4.0, k=1.0), cid.PID(kp=20.0, kd=3.0))
    loop = loop.with_effect(E.ActuatorLag(0.006))
    r = cid.random_binary(600, amplitude=0.03, hold=60, seed=3)
    force = 0.6 * np.sin(np.arange(600) / 40)
    record = cid.simulate(loop, r, sensor_noise=1e-6, d=force, seed=1)
    simulator, every = gap_of.make_simulator(loop), slice(0, 600)
    calm = replace(record, u=record.u - force)
    x, v, lag = prepare_stretch(simulator, calm, every).initial[:3]
    assert abs(x) < 5e-3
    assert abs(v) < 0.5
    assert abs(lag) < 20
    still = replace(record, y=np.zeros(600), u=np.zeros(600), r=np.zeros(600))
    assert np.allclose(prepare_stretch(simulator, still, every).initial, 0.0, atol=1e-6)


def test_noise_that_parts_a_loop_from_itself_explains_a_gap():
    """A drive that rests in one hollow of its ripple or in the next, as noise will have it."""
    calm = drive(("k",), cid.plants.servo(m=1.0, c=4.0, k=1.0), cid.PID(kp=20.0, kd=3.0))
    rough = calm.with_effect(E.PositionRipple(amplitude=0.25, period=0.01, phase=0.0))
    record = record_of(rough, swing=0.03, hold=90, n=3000, seed=3, sensor_noise=1e-4,
                       force_noise=0.005)  # fmt: skip
    windows, fitted = [gap_of.make_window(record)], fit_base_model(rough, [record], ("k",)).fit
    floors = [
        gap_of.compute_floor([loop], fitted, windows, CLOSED_LOOP, THRESHOLD.floor_more_runs)
        for loop in (rough, calm)
    ]
    assert floors[0].widest > 2 * floors[0].both
    assert floors[1].widest < 1.2 * floors[1].both
    for loop, floor in zip((rough, calm), floors, strict=True):
        left = 2 * floor.both
        gap = Gap("simulation", 1.0, 1.0, left, floor.both, "m", *[np.zeros(3)] * 4, floor.widest)
        assert gap_stands_out(gap, fitted) == (loop is calm)
        assert (
            "differ only in their noise" in wording.describe_shrinking(replace(gap, before=0.9))
        ) == (loop is rough)


@pytest.mark.parametrize(("before", "shown"), [(1.01, False), (1.15, False), (1.5, True)])
def test_a_gap_that_was_at_the_floor_shows_no_benefit(before, shown):
    """Of 1 % above the floor, "100 % removed" says nothing."""
    gap = Gap("simulation", before, before, 0.99, 1.0, "m", *[np.zeros(3)] * 4, 1.0)
    told = wording.describe_shrinking(gap)
    assert ("remove 100 % of the mean square error" in told) == shown
    assert ("the gap cannot show the benefit" in told) == (not shown)


@pytest.mark.parametrize(
    ("rivals", "words"),
    [
        ([], "; no other effect of the catalogue explains the record as well"),
        (["ViscousFriction"], "; no other effect of the catalogue explains the record as well"),
        (["ViscousFriction", "ActuatorLag"], "; none of the 2 other effects of the catalogue"),
    ],
)
def test_the_rest_of_a_small_catalogue_is_counted_in_words(rivals, words):
    friction = E.CoulombFriction(fc=0.1)
    starts = {"ViscousFriction": E.ViscousFriction(c=0.1), "ActuatorLag": E.ActuatorLag(tau=0.1)}
    tried = [friction, *(starts[name] for name in rivals)]
    finding = Finding(friction, {}, (), (), 50.0)
    found = SimpleNamespace(added=(finding,), verdict="explained", finished=True,
                            ranking=[SimpleNamespace(effect=e) for e in tried])  # fmt: skip
    assert words in wording.describe_certainty(found, finding)


# --- what readers of the reports found


def test_each_record_has_rounds_of_its_own(found):
    """Friction of records 1 and 2 was "taken, later replaced or dropped" in one of them."""
    base = found["explained"]
    rows = (*(replace(c, record=1) for c in base.ranking), replace(base.ranking[0], record=2),
            replace(base.ranking[0], record=3))  # fmt: skip
    seen = replace(base.findings[0], records=(1, 2))
    several = replace(base, findings=(seen,), ranking=rows)
    rounds = _pictures.make_ranking(several)
    assert [*rounds] == ["record 1, round 1", "record 1, round 2", "record 2, round 1",
                         "record 3, round 1"]  # fmt: skip
    kinds = [next(b.kind for b in bars if b.label == "CoulombFriction")
             for name, bars in rounds.items() if name.endswith("round 1")]  # fmt: skip
    assert kinds == ["found", "found", "fitted, not taken"]
    tried_in = [row[1] for row in make_blocks(several)[-1].rows]
    assert tried_in[0] == "record 1, round 1"


def test_errors_of_two_kinds_have_no_mean(found):
    """The gap of a simulation and that of a prediction went into one figure."""
    base = found["explained"]
    far = replace(base.gap, kind="prediction", horizon=37, samples=20, given=1.0, before=1.0,
                  after=0.5, floor=0.4, recalibrated=1.0, closed_loop=False)  # fmt: skip
    other = replace(base, gap=far, notes=("the law was rejected",),
                    findings=(replace(base.findings[0], evidence=1.0),))  # fmt: skip
    merged = merge_diagnoses(levitation(dt=DT), [base, other])
    assert merged.gap.name == "closed-loop simulation"
    assert merged.gap.given == pytest.approx(base.gap.given)
    said = " ".join(merged.notes)
    assert "The gap is that of record 1, on the last quarter" in said
    assert "that of record 2 is the RMS error of the 37-step prediction, 1 m before, 0.5" in said
    assert "record 2: the law was rejected" in merged.notes


def test_a_bound_is_no_standard_error_of_zero(found):
    held = replace(found["explained"].calibrated[0], standard_error=0.0)
    table = next(b for b in make_blocks(replace(found["explained"], calibrated=(held,)))
                 if getattr(b, "caption", "").startswith("The free parameters"))  # fmt: skip
    assert table.rows[0][-1] == "on its bound"


def test_effects_on_two_states_keep_their_units_in_a_file(tmp_path):
    def drain(t, x, u, p):
        return [u[0] - p["a"] * x[0], p["a"] * x[0] - x[1]]

    plant = ct.nlsys(drain, lambda t, x, u, p: x[1], inputs=["q"], outputs=["T"],
                     states=["level", "T"], params={"a": 1.0}, name="tank")  # fmt: skip
    loop = cid.Loop(plant, None, dt=0.1, units={"level": "m", "T": "K", "q": "m/s", "a": "1/s"})
    limits = [E.StateLimit("level", upper=0.5, spill_to="T", share=0.3),
              E.StateLimit("T", upper=300.0, spill_to="level", share=0.2)]  # fmt: skip
    rows = tuple(Candidate(1, e, 50.0, 50.0, 3.0) for e in limits)
    wrong = E.ParameterError("a", error=0.2)
    findings = tuple(Finding(e, {k: 0.01}, (), (), 50.0)
                     for e, k in ((limits[0], "upper"), (wrong, "error")))  # fmt: skip
    base = cid.load_diagnosis(Path(__file__).with_name("saved_diagnosis.json"))
    found = replace(base, loop=loop.with_effect(limits[0]), findings=findings, ranking=rows,
                    calibrated=())  # fmt: skip
    again = cid.load_diagnosis(found.save(tmp_path / "found.json"))
    assert str(again) == str(found)
    assert "upper = 0.500 ± 0.010 m" in str(again)
    assert "a = 1.200 ± 0.010 1/s in place of 1 1/s" in " ".join(str(again).split())
    assert "upper = 300 K" in wording.describe_parameters(again, limits[1])


def test_the_bars_of_what_loses_are_cut_and_say_so(found):
    base = found["explained"]
    rows = (replace(base.ranking[0], effect=E.CubicStiffness(k3=1.0), score=-2267.0, gain=math.nan),
            base.ranking[0])  # fmt: skip
    shown = [t.get_text() for t in plot.diagnosis(replace(base, ranking=rows))[4].texts]
    assert "below -10" in shown
    assert "about -10" not in shown


def test_a_gap_without_end_is_written_with_an_exponent(found):
    gap = replace(found["explained"].gap, given=1.234e40)
    label, size, times = wording.list_gap_rows(gap)[0]
    assert (label, size) == ("the model as given", "1.23e+46 µm")
    assert len(times) < 22


def test_a_model_without_free_parameters_is_not_recalibrated(found):
    base = found["explained"]
    gap = replace(base.gap, given=base.gap.before)
    plain = replace(base, gap=gap, calibrated=())
    assert [row[0] for row in wording.list_gap_rows(gap)] == [
        "the model as given", "with the effects", "noise floor"]  # fmt: skip
    picture = plot.diagnosis(plain)
    assert "closed-loop simulation, model as given" in legend(picture[0])
    assert not any("recalibrated" in t for ax in picture.axes for t in legend(ax))


def test_a_prediction_is_not_spoken_of_as_a_simulation(found):
    base = found["explained"].gap
    gap = replace(base, kind="prediction", horizon=25, before=base.floor, after=1.001 * base.floor,
                  recalibrated=math.nan, closed_loop=False)  # fmt: skip
    said = wording.describe_shrinking(gap)
    assert said.startswith("By noise alone, the predictions of the completed model err by as much")


def test_the_places_of_several_outputs_say_whose_errors_they_are(found):
    base = found["unknown"]
    two = tuple(replace(p, axis="theta_dot", output=o)
                for p, o in zip(base.where[:2], ("x", "theta"), strict=True))  # fmt: skip
    blocks = make_blocks(replace(base, where=two))
    table = next(b for b in blocks if getattr(b, "head", ("",))[0] == "in bins of")
    assert [row[0] for row in table.rows] == [
        "theta_dot, errors of x",
        "theta_dot, errors of theta",
    ]
    assert table.head == ("in bins of", "RMS", "p-value")
    assert any(isinstance(b, str) and b.startswith("theta_dot, errors of x: ") for b in blocks)


def test_long_names_of_signals_are_wrapped_and_not_refused(found):
    base = found["unknown"]
    name = "change of Application.PLC_PRG.Axis1.fbController.fbPosition.rActualVelocity"
    assert name in str(replace(base, where=(replace(base.where[0], axis=name),)))
