"""The command: the story it tells, the files it leaves, and how it ends."""

import os
import subprocess
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest

import ctrlid as cid
from ctrlid import __main__ as command
from ctrlid.reporting.cli import demo_diagnosis as act
from ctrlid.reporting.cli import demo_identification as told


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments):
    return command.main(["--samples", "1500", "--seed", "1", "--quiet", *arguments])


def test_the_whole_story(folder, capsys):
    assert run() == 0
    out, err = capsys.readouterr()
    assert err == ""
    text = " ".join(out.split())
    for number, title in enumerate((*told.TITLES, *act.TITLES), 1):
        assert f"{number}. {title}" in out
    for sentence in (
        "A steel ball of 21.3 g hangs below a magnet",
        "so the ball can be identified in closed loop only",
        "finds the lead with a crossover of 130 rad/s and a phase margin of 60 degrees",
        "The record has 1500 samples",
        "The result is a2 = 1",
        "gives the right structure, but does not remove the bias under feedback",
        "the share of the variance of its error that noise explains",
        "fit_iv() uses its past as instruments",
        "at 120 rad/s, but THE LOOP IS UNSTABLE on the physics.",
        "Constrained: The model promises a phase margin of 50.0 deg at 120 rad/s; achieved",
        "Instruments: The model promises a phase margin of 50.0 deg at 120 rad/s; achieved",
        "The same ball hangs at a gap of 12 mm",
        "1500 samples, one every 2 ms",
        "Diagnosis of maglev (1500 samples, dt = 0.002 s)",
        "what is missing",
        "The hidden effect was InputDelay: delay = 0.00",
        "It was found, and no alternative was named.",
    ):
        assert sentence in text
    assert out.endswith(f"10 figures and report.html are in ctrlid-report{os.sep}\n")
    files = sorted(p.name for p in (folder / "ctrlid-report").iterdir())
    assert len([f for f in files if f.endswith(".png")]) == 10
    assert "report.html" in files
    assert {"03-the-experiment.png", "10-what-is-missing.png"} <= set(files)
    page = (folder / "ctrlid-report" / "report.html").read_text("utf-8")
    assert page.count('src="data:image/png;base64,') == 10
    for number, title in enumerate((*told.TITLES, *act.TITLES), 1):
        assert f"<h2>{number}. {title}</h2>" in page


def test_nothing_is_overwritten(folder, monkeypatch):
    short(monkeypatch)
    (folder / "ctrlid-report").mkdir()
    (folder / "ctrlid-report-2").write_text("mine")
    assert run() == 0
    assert list((folder / "ctrlid-report").iterdir()) == []
    assert (folder / "ctrlid-report-2").read_text() == "mine"
    assert (folder / "ctrlid-report-3" / "report.html").exists()


def test_output_folder(folder, monkeypatch, capsys):
    short(monkeypatch)
    assert run("--output", "new/place") == 0
    assert capsys.readouterr().out.endswith(f"are in new{os.sep}place{os.sep}\n")
    before = (folder / "new" / "place" / "report.html").stat()
    assert run("--output", "new/place") == 1
    assert capsys.readouterr().err == (
        f"ctrlid: new{os.sep}place is not empty and nothing is overwritten; give --output a new "
        "folder\n"
    )
    assert (folder / "new" / "place" / "report.html").stat() == before
    (folder / "file").write_text("mine")
    assert run("--output", "file") == 1
    assert capsys.readouterr().err.startswith("ctrlid: cannot make a folder for the report: ")


def short(monkeypatch):
    """Tell a story without its contents."""

    def one(**settings):
        for title in told.TITLES:
            yield cid.Section(title, "Words.")

    def two(**settings):
        for title in act.TITLES:
            yield cid.Section(title, "Words.")

    monkeypatch.setattr(command, "tell_identification", one)
    monkeypatch.setattr(command, "tell_diagnosis", two)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--samples", "10"], "needs at least 500 samples; given 10"),
     (["--seed", "-1"], "needs a whole number >= 0; given -1"),
     (["--seed", "x"], "needs a whole number >= 0; given x"),
     (["--samples", "many"], "needs at least 500 samples; given many"),
     (["--noise", "loud"], "needs a share >= 0, such as 0.1; given loud"),
     (["--noise", "-0.1"], "needs a share >= 0, such as 0.1; given -0.1"),
     (["--noise", "nan"], "given nan"), (["--nonsense"], "unrecognized arguments: --nonsense"),
     (["nonsense"], "invalid choice: 'nonsense' (choose from ")],
)  # fmt: skip
def test_wrong_usage(folder, capsys, arguments, words):
    with pytest.raises(SystemExit) as end:
        command.main(arguments)
    assert end.value.code == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.startswith("usage: ctrlid")
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "line"),
    [(["audit", "my.csv"], 'record = cid.Record.from_csv("my.csv", r="ref", u="volt", y="gap"); '
      "loop = cid.Loop(plant, controller, dt=record.dt); print(cid.audit(record, loop))"),
     (["fit_arx", "--na", "2"], 'from_csv("log.csv", r="ref", u="volt", y="gap"); '
      "print(cid.fit_arx(record, na, nb))"),
     (["redesign"], "loop = cid.Loop(plant, controller, dt=0.001); print(cid.redesign(G, loop))")],
)  # fmt: skip
def test_what_is_no_command_but_a_function_is_answered_in_python(capsys, arguments, line):
    with pytest.raises(SystemExit) as end:
        command.main(arguments)
    assert end.value.code == 2
    err = capsys.readouterr().err
    assert f"there is no command {arguments[0]}, only diagnose" in err
    assert line in err
    assert "invalid choice" not in err


def test_help_and_version(capsys):
    with pytest.raises(SystemExit) as end:
        command.main(["--help"])
    assert end.value.code == 0
    out = capsys.readouterr().out
    for option in ("--help", "--version", "--seed", "--samples", "--noise", "--output", "--quiet"):
        assert option in out
    with pytest.raises(SystemExit) as end:
        command.main(["--version"])
    assert end.value.code == 0
    assert capsys.readouterr().out == f"ctrlid {cid.__version__}\n"


def test_a_refusal_is_one_line_and_leaves_nothing(folder, capsys, monkeypatch):
    def refuse(**settings):
        raise cid.CtrlidError("the ball\nis lost")
        yield

    monkeypatch.setattr(command, "tell_identification", refuse)
    assert run() == 1
    assert capsys.readouterr() == ("", "ctrlid: the ball is lost\n")
    assert list(folder.iterdir()) == []


def test_too_much_noise_throws_the_ball(folder, capsys):
    assert run("--noise", "200", "--samples", "600") == 1
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert err.startswith("ctrlid: the simulation stops at t = ")


def test_ctrl_c(folder, capsys, monkeypatch):
    def interrupted(**settings):
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr(command, "tell_identification", interrupted)
    assert run() == 130
    assert capsys.readouterr().err == "ctrlid: interrupted\n"
    assert list(folder.iterdir()) == []


@pytest.mark.slow
def test_as_a_module_into_a_closed_pipe(folder):
    done = subprocess.run([sys.executable, "-W", "error", "-m", "ctrlid", "--version"],
                          capture_output=True, text=True, check=False)  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, f"ctrlid {cid.__version__}\n", "")
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, "-m", "ctrlid", "--samples", "600"], stdout=write,
                          stderr=subprocess.PIPE, text=True, check=False)  # fmt: skip
    os.close(write)
    assert (done.returncode, done.stderr) == (1, "")


@pytest.mark.parametrize("seed", [1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3))])
def test_the_plain_fit_fails_whatever_the_seed(seed):
    """Equation (6) of the paper is typical of this experiment and no lucky draw."""
    bench = told._make_bench()
    record, perfect = told._simulate_records(bench, 45_000, 0.1, seed)
    plain = cid.fit_arx(record, na=2, nb=2)
    assert told._find_unstable_pole(plain) is None
    # Five standard deviations of this number, over eight seeds, are 0.001.
    assert np.abs(plain.estimate.poles).max() < 0.999
    # What the square law of the magnet leaves of the linear model at this amplitude.
    assert told._find_unstable_pole(cid.fit_arx(perfect, na=2, nb=2)) == pytest.approx(
        bench.pole, rel=5e-3
    )
    known = cid.fit_arx(record, na=2, nb=2, constraints=[cid.ReciprocalPoles()])
    assert known.estimate["a2"] == 1.0
    assert 0.7 < told._find_unstable_pole(known) / bench.pole < 0.9
    cured = cid.fit_iv(record, na=2, nb=2, constraints=[cid.ReciprocalPoles()])
    assert told._find_unstable_pole(cured) == pytest.approx(bench.pole, rel=0.01)
    assert np.abs(told._compute_gain_errors(bench, cured.estimate)).max() < 0.03


def chapters(last=told.TITLES[-1], **settings):
    """Tell the story up to a title."""
    told_so_far = {}
    for section in told.tell_identification(samples=2000, **settings):
        told_so_far[section.title] = section
        if section.title == last:
            break
    return told_so_far


def test_without_noise_the_story_does_not_speak_of_its_harm():
    sections = chapters(noise=0.0)
    plain, known = sections[told.TITLES[3]].text, sections[told.TITLES[4]].text
    assert "The unstable pole of the fit is +25." in plain
    assert "NO POLE" not in plain
    assert "Without sensor noise" not in plain
    assert "bias" not in known
    assert sections[told.TITLES[7]].text.count("the promise holds") == 3


def test_figures_that_are_compared_look_equally_far_ahead_on_one_scale():
    pictures = list(chapters(told.TITLES[6])[told.TITLES[6]].figures.values())[:2]
    axes = [picture.axes[0] for picture in pictures]
    labels = [ax.get_legend_handles_labels()[1][2].split(":")[0] for ax in axes]
    assert labels == ["8-step prediction"] * 2
    assert axes[0].get_ylim() == axes[1].get_ylim()
    assert axes[0].get_xlim() == axes[1].get_xlim()


def test_doubts_of_the_estimator_are_passed_on(monkeypatch):
    def doubtful(record, **orders):
        warnings.warn("the instruments are weak", cid.CtrlidWarning, stacklevel=1)
        return cid.fit_arx(record, **orders)

    monkeypatch.setattr(told, "fit_iv", doubtful)
    text = chapters(told.TITLES[5], noise=0.5)[told.TITLES[5]].text
    assert "The model has no unstable pole" in text
    assert text.endswith("Warning: the instruments are weak")


def test_a_model_on_its_bound_is_called_so():
    text = chapters(told.TITLES[4], noise=0.5)[told.TITLES[4]].text
    assert "THE MODEL IS ON ITS BOUND, as in equation (8) of the paper" in text


def test_a_refused_redesign_is_reported(monkeypatch):
    monkeypatch.setattr(told, "WANTED", (5.0, 89.0))  # below what an unstable plant allows
    section = chapters(noise=0.0)[told.TITLES[7]]
    assert section.text.count(": REFUSED. ") == 3
    assert section.result is None
    assert section.figures == {}


def test_the_second_act_hides_what_the_seed_draws():
    drawn = {type(act.hide_effect(seed)[0]).__name__ for seed in range(40)}
    assert drawn == {kind.__name__ for kind, _ in act.HIDDEN}
    for seed in range(40):
        effect, factor = act.hide_effect(seed)
        ranges = next(ranges for kind, ranges in act.HIDDEN if kind is type(effect))
        for name, value in effect.values().items():
            assert ranges[name][0] <= value <= ranges[name][1]
        assert abs(factor - 1) == pytest.approx(act.BELIEVED)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind, _ in act.HIDDEN])
def test_the_second_act_names_it(kind):
    seed = next(s for s in range(50) if type(act.hide_effect(s)[0]) is kind)
    first, second, third = act.tell_diagnosis(seed=seed)
    assert "It is not told which effect was hidden." in first.text
    assert second.result.findings[0].name == kind.__name__
    assert f"The hidden effect was {kind.__name__}" in third.text
    assert "It was found, and " in third.text
    assert "the noise floor is " in third.text


def test_the_second_act_admits_what_it_missed():
    sections = list(act.tell_diagnosis(samples=1500, seed=2))
    found, effect, loop = sections[1].result, act.hide_effect(2)[0], None
    assert "It was found, and no alternative was named." in sections[2].text
    stranger = cid.effects.Quantization(step=1.0)
    assert "IT WAS NOT NAMED: the verdict is " in act.reveal_effect(found, stranger, loop)
    two = replace(found, findings=found.findings * 2)
    assert "It is among the effects that were named." in act.reveal_effect(two, effect, loop)
