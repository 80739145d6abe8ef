"""``ctrlid diagnose``: what the words mean, what is refused, and a diagnosis from a file."""

import argparse
import dataclasses
import functools
import inspect
import math
import os
import re
import sys
import warnings
from pathlib import Path

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import CtrlidError
from ctrlid import __main__ as command
from ctrlid import effects as E
from ctrlid.loop.controller_replay import run_controller
from ctrlid.reporting.cli import arguments as _spoken
from ctrlid.reporting.cli import diagnose_command as _command
from ctrlid.reporting.cli.arguments import MergePairs, import_object, parse_assignments
from ctrlid.reporting.cli.options import OPTIONS, name_options
from problems import servo

DT = 0.01
SERVO = ("--model", "servo", "--param", "m=1", "c=2", "k=3")
COLUMNS = ("--columns", "r=ref,u=volt,y=angle")


@pytest.fixture(scope="module")
def record():
    """A servo with a drag that its model lacks."""
    loop = servo(cid.PID(kp=20.0, kd=1.0), dt=DT)
    r = cid.random_binary(2000, amplitude=0.1, hold=50, seed=3)
    real = loop.with_effect(E.QuadraticDrag(c2=3.0))
    return cid.simulate(real, r, sensor_noise=1e-4, seed=2)


@pytest.fixture
def folder(record, tmp_path, monkeypatch):
    """A folder with the record in other words, in which a user works."""
    rows = np.column_stack([record.t, record.r, record.u, record.y])
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", comments="",
               header="time [s],ref [m],volt [V],angle [m]", fmt="%.9g")  # fmt: skip
    np.savetxt(tmp_path / "bare.csv", rows[:, 1:], delimiter=",", comments="", header="r,u,y")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def asked(monkeypatch):
    """Catch what the diagnosis is asked; it ends there."""
    calls = []

    class Answer(str):
        __slots__ = ()

    def diagnose(loop, record, **settings):
        calls.append((loop, record, settings))
        return Answer("the report")

    monkeypatch.setattr(_command, "diagnose", diagnose)
    return calls


def run(*arguments):
    return command.main(["diagnose", *map(str, arguments)])


def refused(capsys, *arguments):
    assert run(*arguments) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    return err


def test_a_file_is_diagnosed(folder, capsys, monkeypatch):
    # What the command makes of the answer is asked; which name it is, others ask of the catalogue.
    few = (E.QuadraticDrag, E.CoulombFriction, E.CubicStiffness, E.InputDelay)
    monkeypatch.setattr(_command, "diagnose", functools.partial(cid.diagnose, catalogue=few))
    assert run("log.csv", *COLUMNS, *SERVO, "--controller", "kp=20,kd=1", "--at-output", 0,
               "--save", "found") == 0  # fmt: skip
    out, err = capsys.readouterr()
    assert all(line.startswith("ctrlid diagnose: ") for line in err.splitlines())
    assert out.startswith("Diagnosis of log (2000 samples, dt = 0.01 s)\n")
    assert "QuadraticDrag" in out
    assert out.endswith("report.html, report.txt, diagnosis.png and diagnosis.json are in "
                        f"found{os.sep}\n")  # fmt: skip
    files = sorted(path.name for path in (folder / "found").iterdir())
    assert files == ["diagnosis.json", "diagnosis.png", "report.html", "report.txt"]
    found = cid.diagnosis.load_diagnosis(folder / "found" / "diagnosis.json")
    assert out.startswith(str(found))
    assert found.findings[0].name == "QuadraticDrag"
    assert found.findings[0].effect.c2 == pytest.approx(3.0, rel=0.02)
    assert {c.name for c in found.calibrated} == {"c", "k"}
    page = (folder / "found" / "report.html").read_text("utf-8")
    assert "<h1>Diagnosis of log (2000 samples" in page


def test_what_the_command_line_means(folder, asked, record, capsys):
    assert run("log.csv", *COLUMNS, *SERVO, "--free", "c", "--at-output", 0.02, "--input-bias", 0.1,
               "--controller", "kp=20,kd=1,derivative=measurement,upper=10", "--jobs", 2,
               "--validation", "log.csv", "--hold", "foh", "--quiet",
               "--seconds", 90) == 0  # fmt: skip
    ((loop, read, settings),) = asked
    assert loop.parameters == {"m": 1.0, "c": 2.0, "k": 3.0}
    assert (loop.free, loop.dt) == (("c",), DT)
    assert (loop.at.output, loop.at.input) == (0.02, 0.1)
    assert loop.controller == cid.PID(kp=20.0, kd=1.0, derivative="measurement", upper=10.0)
    np.testing.assert_allclose(read.y, record.y, rtol=1e-8, atol=1e-12)
    assert (read.hold, read.names["u"], read.units["y"]) == ("foh", "volt", "m")
    assert settings.keys() == {"validation", "jobs", "seconds", "progress"}
    assert (settings["jobs"], settings["seconds"], settings["progress"]) == (2, 90.0, False)
    assert capsys.readouterr().out == "the report\n"


def test_what_is_taken_without_saying(folder, asked, record):
    assert run("bare.csv", "--dt", DT, *SERVO) == 0
    ((loop, read, settings),) = asked
    assert loop.controller is None
    assert loop.free == ("c", "k")
    assert loop.at.output == pytest.approx(record.y.mean())
    assert read.hold == "zoh"
    assert read.r is not None
    assert settings == {"progress": True}
    assert run("bare.csv", "--dt", DT, *SERVO, "--free") == 0
    assert asked[1][0].free == ()


@pytest.mark.parametrize("controller", ["kp=20,kd=1", "kp=20,kd=1,ki=3", "kp=20,kd=1,bias=0.4"])
def test_a_bias_that_nobody_stated_is_that_of_the_log(folder, asked, record, controller):
    """The mean of y is nowhere near the point about which the controller works, which is zero."""
    y = record.y + 0.05 * np.arange(len(record)) / len(record)
    named = _spoken.read_controller(controller)
    bias = 0.4 if named.bias else 0.25
    loop = servo(dataclasses.replace(named, bias=bias), dt=DT)
    u = run_controller(loop, y, record.r)
    rows = np.column_stack([record.t, record.r, u, y])
    np.savetxt(folder / "off.csv", rows, delimiter=",", comments="", header="time,r,u,y",
               fmt="%.12g")  # fmt: skip
    assert run("off.csv", *SERVO, "--controller", controller) == 0
    ((made, read, _),) = asked
    assert made.at.output == pytest.approx(y.mean())
    left = read.u - cid.replay_controller(made, read)
    assert np.max(np.abs(left)) < 1e-8
    assert "exactly what the controller of the loop computes" in str(cid.audit(read, made))


def test_a_file_with_lost_samples(folder, asked, record, capsys):
    lines = (folder / "log.csv").read_text().splitlines()
    (folder / "lost.csv").write_text("\n".join(lines[:501] + lines[511:]) + "\n")
    assert run("lost.csv", *COLUMNS, *SERVO) == 1
    assert "lacks 10 samples in one place" in (said := capsys.readouterr().err)
    assert "Give --gaps mask" in said
    assert run("lost.csv", *COLUMNS, *SERVO, "--gaps", "mask") == 0
    ((_, read, _),) = asked
    assert (len(read), int((~read.valid).sum())) == (len(record), 10)


def test_a_plant_that_is_not_defined_at_zero(folder, asked):
    arguments = ("bare.csv", "--dt", DT, "--model", "maglev", "--param", "m=0.0213", "K=3.34e-6")
    assert run(*arguments, "--at-output", 0.012) == 0
    ((loop, _, _),) = asked
    assert loop.at == cid.operating_point(cid.plants.maglev(m=0.0213, K=3.34e-6), output=0.012)
    assert loop.free == ("K",)


def test_every_textbook_plant_has_its_uncertain_parameters():
    for name, free in _spoken.PLANTS.items():
        needed = {"maglev": {"m": 1.0, "K": 1.0}, "servo": {"m": 1.0, "c": 1.0, "k": 1.0},
                  "tank": {"area": 1.0, "outlet": 1.0, "k": 1.0},
                  "pendulum": {"m": 1.0, "length": 1.0}}[name]  # fmt: skip
        plant = _spoken.read_plant(name, dict(needed))
        assert set(free) <= set(plant.params)


PLANT = """
import control as ct
import numpy as np
import ctrlid as cid

def update(t, x, u, params):
    return np.array([x[1], (params["k"] * u[0] - 2.0 * x[1]) / params["m"]])

mine = ct.nlsys(update, lambda t, x, u, params: x[0], inputs=["V"], outputs=["x"],
                states=["x", "v"], params={"m": 1.0, "k": 3.0}, name="mine")
loop = cid.Loop(mine, cid.PID(kp=20.0, kd=1.0), dt=0.01, free=("k",))
law = cid.PID(kp=7.0)
linear = ct.tf(3, [1, 2, 0])
number = 3

def make(k, m=1.0):
    return cid.plants.servo(m=m, c=2.0, k=k)

def nothing():
    return None
"""


def test_models_of_ones_own(folder, asked):
    (folder / "bench.py").write_text(PLANT)
    for source in ("bench.py", "bench"):
        assert run("log.csv", *COLUMNS, "--model", f"{source}:mine", "--param", "k=2.5",
                   "--free", "k", "--controller", f"{source}:law") == 0  # fmt: skip
    for loop, _, _ in asked:
        assert loop.parameters == {"m": 1.0, "k": 2.5}
        assert (loop.free, loop.controller.kp) == (("k",), 7.0)
    assert run("log.csv", *COLUMNS, "--model", "bench.py:loop", "--param", "m=1.2") == 0
    loop = asked[2][0]
    assert (loop.parameters, loop.free) == ({"m": 1.2, "k": 3.0}, ("k",))
    assert loop.controller.kp == 20.0
    assert run("log.csv", *COLUMNS, "--model", "bench.py:make", "--param", "k=4") == 0
    assert asked[3][0].parameters == {"m": 1.0, "c": 2.0, "k": 4.0}
    assert run("log.csv", *COLUMNS, "--model", "bench.py:linear") == 0
    assert isinstance(asked[4][0].plant, ct.TransferFunction)
    assert asked[4][0].at.input == pytest.approx(asked[4][1].u.mean())


def test_refusals_say_what_to_do(folder, asked, capsys):
    (folder / "bench.py").write_text(PLANT)
    for words, arguments in (
        ("no column 'volts' for u; its columns are time [s], ref [m], volt [V], angle [m]. Name "
         "the right one with --columns u=NAME", ("--columns", "u=volts", *SERVO)),
        ("--columns takes r, u, y, time, as in --columns u=volt,y=gap; given v",
         ("--columns", "v=volt", *SERVO)),
        ("the model servo needs m, c; give them in SI units, as in --param m=... c=...",
         (*COLUMNS, "--model", "servo", "--param", "k=3")),
        ("servo has no parameter 'q'; it has m, c, k", (*COLUMNS, *SERVO, "--param", "q=3")),
        ("servo has no parameter 'K'; it has m, c, k", (*COLUMNS, *SERVO, "--free", "K")),
        ("--model is one of maglev, servo, tank, pendulum, MODULE:NAME or FILE.py:NAME; given ball",
         (*COLUMNS, "--model", "ball")),
        ("--model nowhere:ball: nowhere cannot be imported: No module named 'nowhere'",
         (*COLUMNS, "--model", "nowhere:ball")),
        ("--model nowhere.py:ball: nowhere.py cannot be imported",
         (*COLUMNS, "--model", "nowhere.py:ball")),
        ("bench.py has no ball; its python-control systems and loops are mine, loop, linear",
         (*COLUMNS, "--model", "bench.py:ball")),
        ("--model bench.py:number is a int; needed is a python-control system",
         (*COLUMNS, "--model", "bench.py:number")),
        ("wrap it, system = ct.nlsys(update, output_function",
         (*COLUMNS, "--model", "bench.py:update")),
        ("--model bench.py:nothing returns a NoneType", (*COLUMNS, "--model", "bench.py:nothing")),
        ("bench.py:loop is a ctrlid.Loop, which has its own operating point and controller: leave "
         "out --at-output", (*COLUMNS, "--model", "bench.py:loop", "--at-output", "0")),
        ("bench.py:mine has no parameter 'c'; it has m, k",
         (*COLUMNS, "--model", "bench.py:mine", "--param", "c=3")),
        ("a PID has no parameter 'gain'; it has kp, ki",
         (*COLUMNS, *SERVO, "--controller", "gain=3")),
        ("a PID needs kp", (*COLUMNS, *SERVO, "--controller", "ki=3")),
        ("--controller kp= needs a number; given high",
         (*COLUMNS, *SERVO, "--controller", "kp=high")),
        ("--controller needs NAME=VALUE,NAME=VALUE; given kp=",
         (*COLUMNS, *SERVO, "--controller", "kp=")),
        ("--controller is MODULE:NAME or FILE.py:NAME; given fast",
         (*COLUMNS, *SERVO, "--controller", "fast")),
    ):  # fmt: skip
        assert words in refused(capsys, "log.csv", *arguments)
    assert "cannot read nowhere.csv" in refused(capsys, "nowhere.csv", *SERVO)
    assert "Name the column with --columns time=NAME, or give --dt" in refused(
        capsys, "bare.csv", *SERVO
    )
    slow = ("bare.csv", "--dt", 0.02, "--model", "bench.py:loop")
    assert "is sampled at 0.01 s, the record at 0.02 s; give" in refused(capsys, *slow)
    slow = ("bare.csv", "--dt", 10.0, "--model", "bench.py:loop")
    assert "if the times are in milliseconds, name their column t [ms]" in refused(capsys, *slow)
    assert asked == []


def test_refusals_of_the_library_speak_in_options(folder, capsys):
    """They said ``from_csv(..., r="setpoint")`` and ``time=`` to someone who typed a command."""
    (folder / "times.csv").write_text("t [ns],r,u,y\n0,1,2,3\n1,1,2,3\n")
    (folder / "two.csv").write_text("t [s],u,v,y\n0,1,2,3\n1,1,2,4\n2,1,2,3\n")
    for words, arguments in (
        ("with --columns u=NAME and the others likewise: --columns r=setpoint,u=voltage,y=gap; "
         "--columns r=NAME may be left out", ("log.csv", "--columns", "u=volts", *SERVO)),
        ("Convert it, or remove the column and give --dt", ("times.csv", *SERVO)),
        ("Leave out --dt, or remove the column", ("log.csv", *COLUMNS, *SERVO, "--dt", 0.03)),
        ("--scale needs a number other than zero for y",
         ("log.csv", *COLUMNS, *SERVO, "--scale", "y=0")),
        ("pick them with --columns u=...", ("two.csv", "--columns", "u=u,v y=y", *SERVO)),
        ("Choose an output inside the range of the plant, with --at-output",
         ("log.csv", *COLUMNS, "--model", "maglev", "--param", "m=1", "K=1", "--at-output", -1)),
        ("give a second record for --validation",
         ("short.csv", *COLUMNS, *SERVO, "--controller", "kp=20")),
        ("--seconds is the time after which", ("log.csv", *COLUMNS, *SERVO, "--seconds", -1)),
        ("--jobs is a number of processes from 1 to 256, or -1",
         ("log.csv", *COLUMNS, *SERVO, "--jobs", 0)),
    ):  # fmt: skip
        lines = (folder / "log.csv").read_text().splitlines()
        (folder / "short.csv").write_text("\n".join(lines[:60]) + "\n")
        said = refused(capsys, *arguments)
        assert words in said
        assert not re.search(
            r"\b(time|dt|gaps|scale|units|hold|jobs)=|from_csv|Record[.(]|None", said
        )


def test_every_keyword_of_the_library_has_its_option():
    """A new option, or a new argument of what the command calls, needs its line in the table."""
    parser = argparse.ArgumentParser()
    _command.add_parser(commands := parser.add_subparsers())
    options = {name for action in commands.choices["diagnose"]._actions
               for name in action.option_strings}  # fmt: skip
    named = {option for option in OPTIONS.values() if option.startswith("--")}
    # These have no keyword: they make the loop, or say where to write and what to show.
    own = {"-h", "--help", "--model", "--param", "--at-output", "--input-bias", "--save", "--quiet"}
    assert options == named | own
    keywords = {name for function in (cid.Record.from_csv, cid.diagnose)
                for name in inspect.signature(function).parameters}  # fmt: skip
    # The command has no option for these, or the file and the loop are what it is given.
    assert keywords - OPTIONS.keys() == {"path", "extra", "name", "loop", "record", "catalogue",
                                         "progress"}  # fmt: skip


@pytest.mark.parametrize(
    ("text", "said"),
    [("record hold='zoh', as in dataclasses.replace(record, hold='zoh')",
      "record --hold zoh, as in --hold zoh"),
     ("give dt=0.02", "give --dt 0.02"),
     ("not defined; give at=operating_point(plant, output=...)", "not defined; give --at-output"),
     ("exclude them with valid=.", "exclude them with the column valid."),
     ("make the loop: Loop(plant, controller, dt=..., at=...)",
      "make the loop: Loop(plant, controller, dt=..., at=...)"),
     ("PID needs lower < upper; given lower=1", "PID needs lower < upper; given lower=1")],
)  # fmt: skip
def test_keywords_become_options(text, said):
    assert name_options(text) == said


def test_columns_are_renamed(folder, asked):
    assert run("log.csv", *COLUMNS, *SERVO, "--names", "volt=V,u=drive") == 1
    assert run("log.csv", *COLUMNS, *SERVO, "--names", "volt=drive") == 0
    ((_, read, _),) = asked
    assert read.names["u"] == "drive"


def test_warnings_are_told_as_refusals_are(folder, asked, capsys):
    """They came with the path of a module of ctrlid and a line of its code."""
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert run("log.csv", *COLUMNS, *SERVO, "--units", "y=mm") == 0
    err = capsys.readouterr().err
    assert err.startswith("ctrlid: y is in m by the header of log.csv, and in mm by --units, which")
    assert "give --scale y=factor as well" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(("log.csv",), "the following arguments are required: --model"),
     ((*SERVO,), "the following arguments are required: FILE.csv"),
     (("log.csv", *SERVO, "--param", "k"), "needs NAME=VALUE, as in K=3.3e-6; given k"),
     (("log.csv", *SERVO, "--param", "k=much"), "k= needs a number; given much"),
     (("log.csv", *SERVO, "--param", "m=0,35"), "needs a number with a decimal point; given 0,35: "
      "type 0.35"),
     (("log.csv", *SERVO, "--scale", "y=-1,5e-3"), "given -1,5e-3: type -1.5e-3"),
     (("log.csv", *SERVO, "--at-output", "0,01"), "argument --at-output: it needs a number with a "
      "decimal point; given 0,01: type 0.01"),
     (("log.csv", *SERVO, "--dt", "soon"), "it needs a number; given soon"),
     (("log.csv", *SERVO, "--param", "m=0.5,c=2"), "takes several with blanks between them, as in "
      "m=0.5 c=2; given m=0.5,c=2"),
     (("log.csv", *SERVO, "--columns", "volt"), "needs NAME=VALUE,NAME=VALUE; given volt"),
     (("log.csv", *SERVO, "--hold", "spline"), "invalid choice: 'spline'")],
)  # fmt: skip
def test_wrong_usage(folder, capsys, arguments, words):
    with pytest.raises(SystemExit) as end:
        run(*arguments)
    assert end.value.code == 2
    err = capsys.readouterr().err
    assert err.startswith("usage: ctrlid diagnose")
    assert words in err


@pytest.mark.parametrize(
    ("arguments", "advised"),
    [(("--columns", "r=ref", "u=volt", "y=angle"), True),
     (("--units", "r=rad", "y=rad"), True), (("--free", "k", "--speed=3"), False)],
)  # fmt: skip
def test_names_of_one_option_in_several_words_are_explained(capsys, arguments, advised):
    with pytest.raises(SystemExit) as end:
        run("log.csv", *SERVO, *arguments)
    assert end.value.code == 2
    err = capsys.readouterr().err
    assert f"unrecognized arguments: {' '.join(arguments[2:])}" in err
    assert ("--columns r=ref,u=volt,y=gap" in err.split("error:")[1]) == advised


def test_commas_separate_names_of_free_parameters(folder, asked):
    for words in (("k,c",), ("k", "c"), ("k,", "c")):
        assert run("log.csv", *COLUMNS, *SERVO, "--free", *words) == 0
        assert asked[-1][0].free == ("k", "c")
    assert run("log.csv", *COLUMNS, *SERVO, "--free") == 0
    assert asked[-1][0].free == ()


def test_a_decimal_comma_in_a_controller_is_refused(folder, asked, capsys):
    assert run("log.csv", *COLUMNS, *SERVO, "--controller", "kp=2,5,ki=1") == 1
    assert "--controller kp= needs a number with a decimal point; given 2,5: type 2.5" in (
        capsys.readouterr().err
    )


def test_help_has_a_worked_example(capsys):
    with pytest.raises(SystemExit) as end:
        run("--help")
    assert end.value.code == 0
    out = capsys.readouterr().out
    for option in (
        "--model", "--param", "--free", "--at-output", "--input-bias", "--dt", "--quiet",
        "--columns", "--controller", "--hold", "--validation", "--jobs", "--save",
    ):  # fmt: skip
        assert option in out
    example = out[out.index("  ctrlid diagnose log.csv") :].split("\n\n")[0]
    parser = argparse.ArgumentParser()
    _command.add_parser(parser.add_subparsers())
    args = parser.parse_args(example.replace("\\\n", " ").split()[1:])
    assert args.param == [("m", 0.0213), ("K", 3.3e-6)]
    assert _spoken.read_controller(args.controller) == cid.PID(kp=-1200.0, kd=-20.0, bias=3.0)


def test_a_failed_diagnosis_leaves_no_folder(folder, capsys, monkeypatch):
    def refuse(*arguments, **settings):
        raise cid.CtrlidError("too few samples")

    monkeypatch.setattr(_command, "diagnose", refuse)
    assert "ctrlid: too few samples" in refused(
        capsys, "log.csv", *COLUMNS, *SERVO, "--save", "new"
    )
    assert not (folder / "new").exists()
    (folder / "old").mkdir()
    refused(capsys, "log.csv", *COLUMNS, *SERVO, "--save", "old")
    assert (folder / "old").is_dir()
    (folder / "old" / "mine").write_text("mine")
    words = refused(capsys, "log.csv", *COLUMNS, *SERVO, "--save", "old")
    assert "old is not empty and nothing is overwritten; give --save a new folder" in words


def test_numbers_that_are_none():
    assert math.isinf(_spoken._parse_number("x", "inf"))
    with pytest.raises(cid.CtrlidError, match="x needs a number; given nan"):
        _spoken._parse_number("x", "nan")


def test_a_model_file_is_run_as_python_runs_it(tmp_path, monkeypatch):
    """It finds its neighbours, and its dataclasses their module."""
    (tmp_path / "neighbour_of_rig.py").write_text("GAIN = 3.0\n")
    (tmp_path / "rig_of_test.py").write_text(
        "from __future__ import annotations\n"
        "from dataclasses import dataclass\n"
        "import control as ct\n"
        "from neighbour_of_rig import GAIN\n"
        "@dataclass\n"
        "class Rig:\n    k: float = GAIN\n"
        "servo = ct.tf([Rig().k], [1, 2, 0])\n"
    )
    monkeypatch.setattr(sys, "path", [*sys.path])
    found = import_object("--model", f"{tmp_path / 'rig_of_test.py'}:servo")
    assert found.num[0][0][0] == 3.0
    # A file may be called as a package that it imports, and leaves no trace.
    (tmp_path / "control.py").write_text("import control as ct\nservo = ct.tf([1], [1, 0])\n")
    modules = dict(sys.modules)
    assert import_object("--model", f"{tmp_path / 'control.py'}:servo").den[0][0].tolist() == [1, 0]
    assert sys.modules["control"] is ct
    assert set(sys.modules) == set(modules)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = (1\n", r"SyntaxError: '\(' was never closed \(line 1\)"),
        ("import math\n1 / 0\n", r"ZeroDivisionError: division by zero \(line 2\)"),
        ("import no_such_module\n", "It is imported there"),
        ("import numpy\nnumpy.loadtxt('no_such_file.csv')\n", r"FileNotFoundError: .* \(line 2\)"),
        ("import control as ct\nct.tf('a', 'b')\n", r"cannot be run: .* \(line 2\)"),
    ],
)
def test_what_is_wrong_in_a_model_file_is_told_in_one_line(tmp_path, monkeypatch, text, words):
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "wrong_rig.py").write_text(text)
    with pytest.raises(CtrlidError, match=words):
        import_object("--model", f"{tmp_path / 'wrong_rig.py'}:rig")


def test_names_with_blanks_are_names():
    assert parse_assignments("Motor Voltage=mV") == {"Motor Voltage": "mV"}
    assert parse_assignments("y=theta,alpha u=V") == {"y": ("theta", "alpha"), "u": "V"}
    assert parse_assignments("a=1,b=2") == {"a": "1", "b": "2"}


def test_columns_may_be_given_one_by_one():
    parser = argparse.ArgumentParser()
    parser.add_argument("--columns", type=parse_assignments, action=MergePairs, default={})
    given = parser.parse_args(["--columns", "u=volt", "--columns", "y=pos"])
    assert given.columns == {"u": "volt", "y": "pos"}
    assert parser.parse_args([]).columns == {}


def test_a_report_that_cannot_be_saved_is_printed(folder, asked, capsys, monkeypatch):
    """A full disk cost the answer of minutes."""

    def fail(found, name):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(_command.plot, "diagnosis", fail)
    monkeypatch.setattr(_command.Diagnosis, "save", fail)
    found = cid.load_diagnosis(Path(__file__).with_name("saved_diagnosis.json"))
    monkeypatch.setattr(_command, "diagnose", lambda *a, **k: found)
    assert run("log.csv", *COLUMNS, *SERVO, "--save", "new") == 1
    out, err = capsys.readouterr()
    assert out.startswith("Diagnosis of maglev")
    assert "not all of the answer is saved in new" in err
    assert "No space left" in err


def test_options_before_the_command_count_or_are_refused(folder, asked, capsys):
    assert command.main(["--quiet", "diagnose", "log.csv", *COLUMNS, *SERVO]) == 0
    assert asked[-1][2]["progress"] is False
    with pytest.raises(SystemExit) as ended:
        command.main(["--output", "here", "diagnose", "log.csv", *COLUMNS, *SERVO])
    assert ended.value.code == 2
    assert "--output belongs to the demonstration" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "bias"), [(("--input-bias", "-1e-3"), -1e-3), (("--input-bias=-.5",), -0.5)]
)
def test_negative_numbers_are_numbers(folder, asked, given, bias):
    assert run("log.csv", *COLUMNS, *SERVO, *given) == 0
    assert asked[-1][0].at.input == bias


CART = """
import ctrlid as cid
cart = cid.plants.cart_pole(M=0.5, m=0.1, length=0.3, c=0.1)
linear = cid.linearize(cart, cid.operating_point(cart, output=(0, 0)))
"""


def test_a_model_of_several_outputs_is_told_where_it_rests(folder, asked, capsys):
    """Each model of two outputs that was no Loop ended in an IndexError."""
    rng = np.random.default_rng(0)
    rows = np.column_stack([0.01 * np.arange(400), *rng.standard_normal((3, 400))])
    np.savetxt("two.csv", rows, delimiter=",", comments="", header="time [s],F,x,theta")
    (folder / "plant.py").write_text(CART)
    given = ("two.csv", "--columns", "y=x,theta u=F", "--model")
    words = refused(capsys, *given, "plant.py:cart")
    assert "the model has 2 outputs (x, theta)" in words
    assert "give --at-output with a value for each, as in --at-output 0,0" in words
    assert run(*given, "plant.py:cart", "--at-output", "-0.1,0") == 0
    assert asked[-1][0].at.output == (-0.1, 0.0)
    assert run(*given, "plant.py:linear") == 0
    assert asked[-1][0].at.output == pytest.approx((rows[:, 2].mean(), rows[:, 3].mean()))
    capsys.readouterr()
    words = refused(capsys, *given, "plant.py:cart", "--at-output", "0.1")
    assert "--at-output takes a number for each of x, theta" in words
    assert "given 1" in words
