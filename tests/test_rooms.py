"""The house: its rooms on disk, in pyproject.toml and in the picture, and what stays where it is.

The saved diagnosis was written by the last version with flat modules, from a simulated record of a
levitated ball with a dry friction of 0.1 m/s^2.
"""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import ctrlid as cid
from ctrlid import effects as E
from problems import ROOT, levitation

HOUSE = ROOT / "ctrlid"
ROOMS = {p.name for p in HOUSE.iterdir() if (p / "__init__.py").is_file()}
CONTRACTS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"][
    "contracts"
]
LAYERS = {c["containers"][0]: c for c in CONTRACTS if c["type"] == "layers"}
SAVED = Path(__file__).with_name("saved_diagnosis.json")


def names_in(layer):
    """The modules of a layer, which stand side by side or on one another."""
    return set(re.split(r"\s*[|:]\s*", layer))


def modules_in(folder):
    """The modules and packages in a package."""
    return {
        p.stem for p in folder.iterdir()
        if p.stem != "__init__" and (p.suffix == ".py" or (p / "__init__.py").is_file())
    }  # fmt: skip


LARGE = sorted(
    str(folder.relative_to(ROOT)).replace("/", ".")
    for folder in (p.parent for p in HOUSE.rglob("__init__.py"))
    if folder != HOUSE and len(modules_in(folder)) > 6
)


# --- names


def test_a_user_sees_the_public_names_and_nothing_else():
    assert dir(cid) == sorted(cid.__all__)
    assert len(set(cid.__all__)) == len(cid.__all__)
    assert [name for name in cid.__all__ if not hasattr(cid, name)] == []


@pytest.mark.parametrize(
    "words",
    ["import ctrlid.plot, ctrlid.plants, ctrlid.datasets; ctrlid.plot.bode; ctrlid.plants.maglev; "
     "ctrlid.datasets.load",
     "from ctrlid.plants import maglev; from ctrlid.plot import bode; "
     "from ctrlid.effects import InputDelay"],
)  # fmt: skip
def test_modules_are_imported_by_their_public_names(words):
    done = subprocess.run([sys.executable, "-c", words], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


# --- rooms


def test_at_the_top_there_are_rooms_only():
    files = (p for p in HOUSE.rglob("*") if p.is_file() and p.suffix != ".pyc")
    found = {p.relative_to(HOUSE).parts[0] for p in files}
    assert found == ROOMS | {"__init__.py", "__main__.py", "py.typed"}
    assert "_base" in ROOMS
    assert len(ROOMS - {"_base"}) <= 9


def test_floors_are_few_and_complete():
    floors = LAYERS["ctrlid"]
    assert floors["name"] == "floors"
    assert floors["exhaustive"]
    assert len(floors["layers"]) <= 8
    assert floors["layers"][-1] == "_base"
    assert set().union(*map(names_in, floors["layers"])) == ROOMS | {"__main__"}


@pytest.mark.parametrize("room", LARGE)
def test_a_large_room_has_an_order_of_its_own(room):
    order = LAYERS[room]
    assert order["exhaustive"]
    assert len(order["layers"]) <= 8
    named = set().union(*map(names_in, order["layers"]))
    assert named == modules_in(ROOT / room.replace(".", "/"))


def test_nothing_is_imported_in_a_circle():
    (contract,) = (c for c in CONTRACTS if c["type"] == "acyclic_siblings")
    assert contract["ancestors"] == ["ctrlid", "ctrlid.**"]


def test_the_picture_shows_every_room_on_its_floor():
    page = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    chapter = page.split("## The house in one picture", 1)[1].split("\n## ", 1)[0]
    picture = re.search(r"```\w*\n(.*?)```", chapter, re.DOTALL).group(1)
    # A line that begins with a space goes on with what is in the rooms of the line above.
    lines = [re.split(r"\s{2,}", line)[0] for line in picture.splitlines() if re.match(r"\S", line)]
    shown = [re.split(r"[\s,|]+", line) for line in lines]
    told = [name for names in shown for name in names]
    assert sorted(set(told) - {"__main__"}) == sorted(ROOMS)
    assert len(set(told)) == len(told)
    assert len(picture.splitlines()) <= 12
    floor = {n: k for k, layer in enumerate(LAYERS["ctrlid"]["layers"]) for n in names_in(layer)}
    heights = [floor[name] for name in told]
    assert heights == sorted(heights)


# --- what was saved before


def test_a_diagnosis_saved_before_the_move_is_read():
    back = cid.load_diagnosis(SAVED)
    assert f"{back}\n" == SAVED.with_suffix(".txt").read_text("utf-8")
    assert back.effects == (E.CoulombFriction(fc=0.09941314636779035),)
    assert back.findings[0].standard_errors == {"fc": 0.0010614080368832365}
    assert back.verdict == "explained"
    assert len(back.gap.measured) == len(back.gap.simulated_after) == 375


def test_a_diagnosis_saved_before_the_move_runs_on_its_loop(tmp_path):
    back = cid.load_diagnosis(SAVED, loop=levitation())
    assert back.loop.effects == back.effects
    assert back.loop.parameters["K"] == pytest.approx(3.34e-6, rel=1e-3)
    r = cid.random_binary(200, amplitude=1e-4, hold=20, around=0.012, seed=1)
    assert abs(cid.simulate(back.loop, r).y - 0.012).max() < 1e-3
    assert str(cid.load_diagnosis(back.save(tmp_path / "again.json"))) == str(back)


def test_what_takes_long_is_imported_when_it_is_needed():
    """The compiler, downloads and processes would add most to the time of `import ctrlid`."""
    late = ["numba", "pooch", "joblib", "tqdm.auto", "scipy.io"]
    code = f"import sys, control, ctrlid; print([m for m in {late} if m in sys.modules])"
    command = [sys.executable, "-W", "error", "-c", code]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (run.stdout.strip(), run.stderr) == ("[]", "")
