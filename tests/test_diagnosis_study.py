"""A slice of the study of diagnose(): random loops, hidden effects, their names."""

import argparse
import json
import re

import numpy as np
import pytest

import ctrlid as cid
from ctrlid import CtrlidError, effects
from ctrlid.diagnosis.thresholds import THRESHOLD
from problems import load_script

study = load_script("benchmarks", "study_diagnosis")
loops = load_script("benchmarks", "_random_loops")

SEED = 90_210  # none of the study


def drawn(kind, index, band="ordinary"):
    row = study.run(kind, band if kind in ("named", "outside") else "", SEED, index)
    assert not row.error, row.error
    assert not row.extra.get("skipped")
    return row


def index_of(kind):
    return effects.CATALOGUE.index(kind)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [effects.InputDelay, effects.LinearStiffness])
def test_an_ordinary_effect_is_named_and_closes_the_gap(kind):
    row = drawn("named", index_of(kind))
    assert row.extra["first"]
    assert row.verdict == "explained"
    assert 3e3 <= row.worth <= 3e4
    assert row.ratio < 1.02
    assert abs(row.left) < 10


@pytest.mark.slow
def test_where_nothing_is_missing_nothing_is_named():
    row = drawn("none", 1)
    assert row.verdict == "nothing missing"
    assert row.named == ()
    assert row.ratio == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
def test_what_no_catalogue_has_gets_no_clean_bill():
    row = drawn("outside", list(study.OUTSIDE).index("multiplicative noise"))
    assert row.verdict in ("unknown", "partly explained")


@pytest.mark.slow
@pytest.mark.parametrize("index", range(len(effects.CATALOGUE)))
def test_every_class_is_in_the_set_that_names_it(index):
    row = drawn("named", index)
    assert row.in_set
    assert row.verdict == "explained"


@pytest.mark.slow
@pytest.mark.parametrize("index", range(len(study.OUTSIDE)))
def test_every_outsider_is_unknown(index):
    assert drawn("outside", index).verdict in ("unknown", "partly explained")


@pytest.mark.slow
@pytest.mark.parametrize("index", range(6))
def test_two_effects_are_both_in_the_sets(index):
    row = drawn("two", index)
    assert min(row.shares) > study.MARGINAL
    assert row.in_set


@pytest.mark.slow
def test_the_size_of_an_effect_is_drawn_by_what_it_is_worth():
    case = study.case_of("named", study.WORTH["faint"], SEED, index_of(effects.ViscousFriction))
    assert 50 <= case.worth <= 300
    known = case.truth.fitted.parameters
    label = next(k for k in known if k.startswith("ViscousFriction."))
    assert known[label] == pytest.approx(case.effects[0].c, rel=0.5)
    for name in case.one.loop.free:
        believed = case.one.believed.parameters[name] / case.one.loop.parameters[name]
        assert 0.9 <= believed <= 1.1
        assert known[name] == pytest.approx(case.one.loop.parameters[name], rel=0.05)


def test_draws_are_repeatable_and_differ_by_seed():
    first, again = (study.case_of("none", (1, 1e9), SEED, 3) for _ in range(2))
    other = study.case_of("none", (1, 1e9), SEED + 1, 3)
    assert np.array_equal(first.record.y, again.record.y)
    assert len(other.record) == len(first.record) == 20_000
    assert not np.array_equal(first.record.y, other.record.y)
    poles = cid.linearize(first.one.loop.plant, first.one.loop.at).poles()
    assert np.max(np.abs(poles)) * first.one.loop.dt < 0.5


def test_tables_count_what_the_rows_say(capsys):
    rows = [
        study.Row("named", "ordinary", 1, 0, truth=("InputDelay",), named=(("InputDelay",),),
                  verdict="explained", in_set=True, right=True, ratio=1.0, inside=(True,),
                  seconds=3.0, extra={"first": True}),
        study.Row("named", "ordinary", 1, 1, truth=("SensorLag",), named=(("InputDelay",),),
                  verdict="explained", seconds=4.0),
        study.Row("none", "", 1, 2, truth=("none",), verdict="unknown"),
        study.Row("outside", "", 1, 3, truth=("BoucWen",), verdict="partly explained"),
        study.Row("named", "ordinary", 1, 4, truth=("InputOffset",), error="ValueError: no"),
    ]  # fmt: skip
    study.report(rows)
    text = capsys.readouterr().out
    for line in ("exact name first .* 33.3 % of 3", "wrong single name .* 1$",
                 "needless unknown .* 100.0 % of 1", "unknown or partly .* 100.0 % of 1",
                 "raised .* 1$", "SensorLag .*0/1  1 InputDelay"):  # fmt: skip
        assert re.search(line, text, re.MULTILINE), line


def test_numbers_of_the_table_are_varied_on_the_same_draws(monkeypatch):
    assert study.parse_vary("near_winner=0.3,0.9") == [
        {"near_winner": 0.5}, {"near_winner": 0.3}, {"near_winner": 0.9}]  # fmt: skip
    assert study.parse_vary("looked_at=3") == [{"looked_at": 5}, {"looked_at": 3}]
    for wrong in ("nonsense=1", "gate=much", "experiment_levels=1", "gate"):
        with pytest.raises(argparse.ArgumentTypeError, match="needs"):
            study.parse_vary(wrong)
    seen = []

    def diagnose(loop, record, **options):
        seen.append((THRESHOLD.gate, record.y[:3].tolist()))
        raise CtrlidError("far enough")

    monkeypatch.setattr(study.cid, "diagnose", diagnose)
    for setting in study.parse_vary("gate=7"):
        row = study.run("none", "", SEED, 3, samples=2000, numbers=setting)
        assert "far enough" in row.error
    assert [gate for gate, _ in seen] == [5.0, 7.0]
    assert seen[0][1] == seen[1][1]
    assert THRESHOLD.gate == 5.0


def test_rows_survive_their_file(tmp_path):
    row = study.Row("two", "", 3, 4, truth=("A", "B"), named=(("A", "C"), ("B",)), worth=1e3)
    path = tmp_path / "rows.jsonl"
    path.write_text(2 * (json.dumps(vars(row)) + "\n"))
    (again,) = study.read([str(path)])
    assert again.named == row.named
    assert again.truth == row.truth
    assert again.text() == row.text()


@pytest.mark.parametrize("plant", sorted(loops.PLANTS))
def test_every_plant_is_drawn_and_shaken(plant):
    """Two tanks have a random force each, and the study ended with an error of shapes."""
    one = loops.draw(np.random.default_rng(1), plant, False, 400)
    record = one.run(one.loop, 1)
    assert np.isfinite(record.y).all()
    assert np.ptp(record.y) > 0


def test_every_effect_of_the_catalogue_has_a_size_to_be_hidden_with():
    for kind in effects.CATALOGUE:
        plant = next(p for p in loops.PLANTS if p in study.plants_for(kind))
        one = loops.draw(np.random.default_rng(3), plant, False, 400)
        made = loops.hidden(np.random.default_rng(4), kind, one, loops.scales_of(one, 1))
        assert made is None or isinstance(made(1.0), kind)
