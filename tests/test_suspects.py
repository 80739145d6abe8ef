"""Two draws of each of the study's twelve noise and sensor classes, from a foreign simulator.

All 1 200 draws are ``python benchmarks/study_suspects.py --classes all --seeds 0-24``; what holds
of their shares is read there. Here each draw has to be right in what is wrong at any size of the
study: nobody blames a plant that is as modelled, and a sensor's effect is in a set.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ctrlid as cid
from problems import load_script

study = load_script("benchmarks", "study_suspects")
rigs = study.rigs
DRAWS = [
    (name, rigs.PLANTS[(i + 2 * k) % 4]) for i, name in enumerate(rigs.CLASSES) for k in (0, 1)
]

# What the sensor's effect is worth in each draw, which takes seconds to measure.
WORTH = {
    ("hum", "drive"): 82.15,
    ("hum", "spring"): 80.22,
    ("scale", "pendulum"): 0.0,
    ("scale", "ball"): 66.76,
    ("drift", "spring"): 93.56,
    ("drift", "drive"): 12.76,
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "plant"), WORTH)
def test_the_worth_of_a_sensor_effect_is_what_the_foreign_filter_measures(
    name: str, plant: str
) -> None:
    """The table above, by the simulator's own filter."""
    worth = rigs.measure_worth(rigs.draw(name, plant, 1000, 1500))
    assert worth == pytest.approx(WORTH[name, plant], abs=0.05)


@pytest.mark.parametrize(("name", "plant"), DRAWS)
def test_no_plant_is_blamed_for_what_its_sensor_or_noise_does(name: str, plant: str) -> None:
    """Noise of any kind gives no name; a hidden sensor effect is in a set, or no name is given."""
    line = study.run(name, plant, seed=1000, n=1500, worth=False)
    line |= {"worth": WORTH[name, plant]} if name in rigs.SENSORS else {}
    assert "error" not in line, line
    if study.is_hidden(line):
        assert not study.blames_the_plant_alone(line), line
        assert study.is_in_set(line), line
    elif name in rigs.NOISES:
        assert study.list_named_sets(line) == [], line


@pytest.mark.parametrize("plant", ["spring", pytest.param("pendulum", marks=pytest.mark.slow)])
def test_a_walk_of_the_sensor_is_noise_and_a_steady_drift_is_a_drift(plant: str) -> None:
    """Both go as far in the end, but a walk does not go steadily."""
    white = rigs.draw("white", plant, 31, 1500)
    rig, rng = white.rig, np.random.default_rng(8)
    noise = rig.sigma * rng.standard_normal(1500)
    walk = np.cumsum(0.1 * rig.sigma * rng.standard_normal(1500))
    drift = np.linspace(0.0, 8 * rig.sigma, 1500)
    names = {}
    for wander, name in ((walk, "walk"), (drift, "drift")):
        hidden = replace(white.hidden, added=noise + wander)
        moves = white.r - rig.at
        signals = rigs.run_rig(rig, moves, hidden, np.random.default_rng(9))
        assert signals is not None
        r, u, y = signals
        draw = replace(white, r=r, u=u, y=y, hidden=hidden)
        found = cid.diagnose(study.make_loop(draw), study.make_record(draw), progress=False)
        names[name] = study.list_names(found.findings)
        if name == "walk":
            assert found.verdict == "nothing missing"
            # A random force moves a mass on a spring as slowly.
            assert plant == "spring" or "wanders" in str(found.noise)
    assert names["walk"] == []
    assert [one[0] for one in names["drift"]] == ["SensorDrift"]


def test_the_foreign_simulator_knows_nothing_of_ctrlid() -> None:
    """A simulator that shared code with ctrlid would share its errors."""
    assert "import ctrlid" not in Path(rigs.__file__).read_text()
    assert "from ctrlid" not in Path(rigs.__file__).read_text()


def make_line(name, plant, seed=0, sets=(), **more):
    return {"class": name, "plant": plant, "seed": seed, "n": 10, "commit": "abc", "truth": {},
            "redrawn": 0, "findings": [list(s) for s in sets], "stand_ins": [], "seconds": 1.0,
            "verdict": "explained" if sets else "nothing missing", **more}  # fmt: skip


def test_the_table_counts_what_it_says(tmp_path):
    lines = [
        make_line("white", "ball"),
        make_line("ar", "ball", stand_ins=[["CoulombFriction"]], verdict="unknown"),
        make_line("hum", "drive", worth=80.0, sets=[["PeriodicForce"]]),
        make_line("scale", "drive", worth=20.0),
        make_line("plant-delay", "ball", sets=[["ActuatorLag", "InputDelay"], ["SensorGain"]]),
        make_line("plant-viscous", "drive"),
        make_line("controller-gain", "ball", audit=["gain"], visible=0.1),
        make_line("controller-bias", "ball", audit=[], visible=0.0),
    ]
    path = tmp_path / "suspects.jsonl.gz"
    study.write_lines(path, lines)
    assert study.read(path) == lines
    rows = study.score(lines)
    found = {what.strip(): value.partition(":")[0] for what, _, value in rows}
    assert found["nothing wrong in plant or sensor: any name, stand-ins included"] == "1 of 2"
    assert found['the same, autoregressive noise: "nothing missing"'] == "0 of 1"
    assert found["an effect of the sensor, worth over 50: in the set of a finding"] == "0 of 1"
    assert found["the same: names of the plant alone, explained"] == "1 of 1"
    assert found['an effect of the sensor, worth at most 50: "nothing missing"'] == "1 of 1"
    assert found["the same: false company, stand-ins included"] == "1 of 1"
    assert found["another controller than is stated, seen in u: named right"] == "1 of 1"
    assert found["another controller, not seen in u: no fault named"] == "1 of 1"
    assert [m.split(" (")[0] for m in study.find_misses(lines)] == [
        "ar ball 0", "hum drive 0", "plant-delay ball 0",
    ]  # fmt: skip
    tables = load_script("docs", "study_tables")
    page = "\n".join(tables.write_tables("study_suspects", path))
    assert "hum drive 0 (, worth 80)" not in page
    summary = "\n".join(tables.write_summary("study_suspects", path))
    assert "Nothing wrong in plant or sensor, autoregressive noise: " in summary
    assert "the target is 97 %" in summary
    assert "no draw" not in summary
