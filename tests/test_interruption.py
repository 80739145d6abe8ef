"""Waiting: a budget of seconds, Ctrl-C, what is shown meanwhile, and files that are whole."""

import contextlib
import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace

import numba
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import __main__ as command
from ctrlid._base.compilation import compile_loop
from ctrlid._base.errors import CtrlidError
from ctrlid._base.files import replace_file
from ctrlid._base.interruption import Budget, Stopped, check_budget, keep_interrupt
from ctrlid._base.jobs import run_side_by_side, share_out
from ctrlid.diagnosis import growth, procedure
from ctrlid.diagnosis.noise_tests import run_noise_tests
from ctrlid.diagnosis.progress import Progress
from ctrlid.diagnosis.thresholds import vary_numbers

E = cid.effects


def drive():
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    at = cid.OperatingPoint(states=(0.0, 0.0), input=0.0, output=0.0)
    return cid.Loop(plant, cid.PID(kp=20.0, kd=1.0), dt=0.01, at=at, free=("k", "c"))


@pytest.fixture(scope="module")
def record():
    r = cid.random_binary(1000, amplitude=0.1, hold=50, seed=1)
    real = drive().with_effect(E.CoulombFriction(fc=0.5)).with_effect(E.InputOffset(offset=0.8))
    return cid.simulate(real, r, sensor_noise=1e-4, seed=2)


FEW = (E.CoulombFriction, E.InputOffset)


@pytest.fixture(scope="module")
def answer(record):
    """The whole search with what it shows meanwhile, which several tests look at."""
    with contextlib.redirect_stderr(io.StringIO()) as shown:
        found = cid.diagnose(drive(), record, catalogue=FEW)
    return found, shown.getvalue()


@pytest.fixture
def hears_interrupts():
    """A process started in the background, as some gates are, is born deaf to Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_a_budget_ends_where_it_is_asked_for():
    check_budget()
    with Budget(0.0).running(), pytest.raises(Stopped):
        check_budget()
    with Budget(0.0).running(binding=False):
        check_budget()
    outer = Budget()
    with outer.running(binding=False):
        inner = Budget(60.0)
    assert 0 < inner.left <= 60
    outer.stop()
    assert (inner.left, inner.asked) == (0.0, True)
    with inner.running(), pytest.raises(Stopped):
        list(share_out(abs, [1], None))


def test_a_budget_reaches_other_processes():
    def wait(k):
        time.sleep(0.4)
        check_budget()
        return k

    with Budget(0.2).running(), pytest.raises(Stopped):
        list(share_out(wait, range(40), 2))


@pytest.mark.parametrize("seconds", [0, -1.0, "60", True, float("nan")])
def test_a_budget_that_is_none(record, seconds):
    with pytest.raises(CtrlidError, match="a number above 0, or None"):
        cid.diagnose(drive(), record, seconds=seconds, progress=False)


def test_the_answer_so_far(record, tmp_path):
    found = cid.diagnose(drive(), record, catalogue=FEW, seconds=1e-3, progress=False)
    assert (found.verdict, found.finished, found.findings) == ("unknown", False, ())
    assert found.sentence.startswith("THE SEARCH WAS NOT FINISHED: it was stopped after ")
    assert "(round 1: screening" in found.sentence
    # The command line prints this sentence too, so that it names no argument of Python.
    assert found.sentence.endswith("Give the search more time, or fewer effects to try.")
    assert "Nothing is named yet" in found.sentence
    again = cid.load_diagnosis(found.save(tmp_path / "found.json"))
    assert (again.finished, str(again)) == (False, str(found))
    assert "UNKNOWN SO FAR. THE SEARCH WAS NOT FINISHED" in " ".join(str(again).split())


@pytest.mark.slow
def test_what_was_found_before_the_end_is_kept(monkeypatch):
    """Stopped in the second round, the effect of the first one is named, and nothing is claimed."""
    real = drive().with_effect(E.CubicStiffness(300.0)).with_effect(E.InputOffset(0.8))
    r = cid.random_binary(600, amplitude=0.1, hold=50, seed=1)
    record = cid.simulate(real, r, sensor_noise=1e-4, seed=2)
    budgets = []
    tell, make = Progress.tell, Progress.make_budget

    def keep(self, *given):
        budgets.append(make(self, *given))
        return budgets[-1]

    def stop(self, step, **options):
        tell(self, step, **options)
        if step == "round 2: screening":
            budgets[0].stop()

    monkeypatch.setattr(Progress, "make_budget", keep)
    monkeypatch.setattr(Progress, "tell", stop)
    few = (E.CubicStiffness, E.InputOffset)
    found = cid.diagnose(drive(), record, catalogue=few, progress=False)
    assert (found.verdict, found.finished, len(found.findings)) == ("partly explained", False, 1)
    assert "So far the model lacks" in found.sentence
    assert "(round 2: screening" in found.sentence
    words = " ".join(str(found).split())
    assert "PARTLY EXPLAINED SO FAR. THE SEARCH WAS NOT FINISHED" in words
    assert "STILL MISSING" not in words
    assert "other effects of the catalogue" not in words
    assert "no other effect of the catalogue" not in words
    assert "an effect that is not in the catalogue" not in words
    assert "The search did not come to compare it with all other effects" in words
    assert found.gap.after < found.gap.before
    monkeypatch.undo()
    whole = cid.diagnose(drive(), record, catalogue=few, progress=False, seconds=600)
    assert (whole.verdict, whole.finished, len(whole.findings)) == ("explained", True, 2)


@pytest.mark.slow
def test_friction_that_crept_in_place_of_what_was_found_later_sticks_at_the_end(answer):
    """Beside the missing offset of the input, the friction of the first round has to creep."""
    found, _ = answer
    (friction,) = (f.effect for f in found.findings if f.name == "CoulombFriction")
    assert friction.fc == pytest.approx(0.5, abs=0.003)
    assert friction.creep == 0.0


def test_a_budget_of_samples_counts_what_is_done_side_by_side():
    """What helpers go through counts, whether they are threads or processes."""
    budget = Budget(samples=1000)
    with budget.running():
        run_side_by_side(lambda n: check_budget(n), [100] * 5)
        assert list(share_out(count_samples, [100] * 5, 2)) == [100] * 5
        assert (budget.spent, budget.left_samples) == (1000, 0)
        with pytest.raises(Stopped):
            run_side_by_side(lambda n: check_budget(n), [1] * 5)
    assert budget.left == 0.0
    again = Budget(samples=450)
    with again.running(), pytest.raises(Stopped):
        list(share_out(count_samples, [100] * 5, 2))


def count_samples(n):
    """Spend samples, in a process of its own."""
    check_budget(n)
    return n


def test_a_search_ends_at_the_same_sample_whatever_the_jobs(record):
    """It is stopped by the count, not by the clock."""
    with vary_numbers(search_samples=1.0e6):
        one, two = (
            cid.diagnose(drive(), record, catalogue=FEW, jobs=jobs, progress=False)
            for jobs in (None, 2)
        )
    assert not one.finished
    assert "stopped after the work of 1 million filtered samples" in one.sentence
    assert (one.sentence, one.findings) == (two.sentence, two.findings)


@pytest.mark.slow
def test_what_is_shown_without_a_terminal(answer, record, capsys):
    lines = answer[1].splitlines()
    assert all(re.match(r"ctrlid diagnose: \d+ s, ", line) for line in lines)
    assert sum(", round " in line for line in lines) >= 2
    assert any("round 1 took" in line and "leads with an evidence of" in line for line in lines)
    cid.diagnose(drive(), record[:400], catalogue=(), progress=False)
    assert capsys.readouterr().err == ""


def test_what_is_shown_in_a_terminal(record, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setattr("ctrlid.diagnosis.progress.REFRESH", 0.0)
    cid.diagnose(drive(), record[:400], catalogue=FEW)
    frames = sys.stderr.getvalue().split("\r")
    # Passes move it too: while nothing is finished, the seconds go on.
    assert len(frames) > 50
    assert any("round 1: screening" in f and " 1/3" in f for f in frames)
    assert any("leads with an evidence of" in f and "s more for this step" in f for f in frames)


def test_an_interrupt_inside_compiled_code():
    def interrupted():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as reason:
            raise SystemError("returned a result with an exception set") from reason

    with pytest.raises(KeyboardInterrupt):
        keep_interrupt(interrupted)()

    def broken():
        raise SystemError("another")

    with pytest.raises(SystemError, match="another"):
        keep_interrupt(broken)()


def test_nobody_waits_for_the_rest_of_interrupted_work():
    done = []

    def work(k):
        done.append(k)
        if k == 0:
            raise KeyboardInterrupt
        time.sleep(0.01)

    with pytest.raises(KeyboardInterrupt):
        run_side_by_side(work, range(1000))
    time.sleep(0.05)
    assert len(done) < 500


WORK = {
    "diagnose": lambda loop, record: cid.diagnose(
        loop, record, catalogue=(E.CoulombFriction,), progress=False
    ),
    "simulate": lambda loop, record: cid.simulate(loop, record.r),
    "audit": lambda loop, record: cid.audit(record, loop),
    "predict": lambda loop, record: cid.predict(loop, record),
    "linearize": lambda loop, record: cid.linearize(loop.plant, loop.at),
}


@pytest.mark.usefixtures("hears_interrupts")
@pytest.mark.skipif(os.name != "posix", reason="signals of one process to itself")
@pytest.mark.parametrize("name", WORK)
def test_ctrl_c_raises_keyboard_interrupt_and_nothing_else(record, name):
    loop = drive()

    def work_until_interrupted(seconds):
        alarm = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGINT))
        alarm.start()
        end = time.monotonic() + 20
        while time.monotonic() < end:
            WORK[name](loop, record)
        alarm.cancel()

    before = signal.getsignal(signal.SIGINT)
    for k in range(6):
        with pytest.raises(KeyboardInterrupt):
            work_until_interrupted(0.02 + 0.037 * k)
        assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.usefixtures("hears_interrupts")
@pytest.mark.skipif(os.name != "posix", reason="signals of one process to another")
def test_ctrl_c_on_the_command_line_leaves_the_answer_so_far(record, tmp_path):
    file, folder = tmp_path / "log.csv", tmp_path / "found"
    record.to_csv(file)
    words = [sys.executable, "-m", "ctrlid", "diagnose", str(file), "--model", "servo", "--param",
             "m=1", "c=2", "k=3", "--controller", "kp=20,kd=1", "--save", str(folder)]  # fmt: skip
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as run:
        for line in run.stderr:
            if ", round 1" in line:
                break
        run.send_signal(signal.SIGINT)
        out, err = run.communicate(timeout=120)
    assert run.returncode == 130
    assert "THE SEARCH WAS NOT FINISHED" in " ".join(out.split())
    assert "writing the answer so far" in err
    files = sorted(path.name for path in folder.iterdir())
    assert files == ["diagnosis.json", "diagnosis.png", "report.html", "report.txt"]
    assert not cid.load_diagnosis(folder / "diagnosis.json").finished


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    file = tmp_path / "file.txt"
    file.write_text("before")
    file.chmod(0o640)

    def fail():
        with replace_file(file) as out:
            out.write("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert (file.read_text(), os.listdir(tmp_path)) == ("before", ["file.txt"])
    (tmp_path / "link.txt").symlink_to(file)
    with replace_file(tmp_path / "link.txt") as out:
        out.write("after")
    assert (file.read_text(), (tmp_path / "link.txt").is_symlink()) == ("after", True)
    assert file.stat().st_mode & 0o777 == 0o640
    with replace_file(os.devnull) as out:
        out.write("nothing is kept")


def test_records_and_reports_are_written_whole(record, tmp_path, monkeypatch):
    file = tmp_path / "log.csv"
    record.to_csv(file)
    before = file.read_bytes()

    def fail(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "column_stack", fail)
    with pytest.raises(CtrlidError, match="No space"):
        record.to_csv(file)
    monkeypatch.undo()
    assert (file.read_bytes(), os.listdir(tmp_path)) == (before, ["log.csv"])


def test_a_cut_csv_is_refused(record, tmp_path):
    file = tmp_path / "log.csv"
    record.to_csv(file)
    lines = file.read_text("utf-8").splitlines(keepends=True)
    assert json.loads(lines[0].removeprefix("# ctrlid "))["rows"] == len(record)
    file.write_text("".join(lines[:-300]), "utf-8")
    with pytest.raises(CtrlidError, match="is not whole: its line '# ctrlid' says 1000 rows, and "):
        cid.Record.from_csv(file)
    lines[0] = lines[0].replace(f', "rows": {len(record)}', "")
    file.write_text("".join(lines[:-300]), "utf-8")
    assert len(cid.Record.from_csv(file)) == 700


def test_a_terminal_that_lacks_signs_loses_nothing(monkeypatch):
    narrow = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", narrow)
    with pytest.raises(SystemExit):
        command.main(["--version"])
    narrow.write("2.0 ± 0.1 m/s², Jørgensen")
    narrow.flush()
    assert narrow.buffer.getvalue().endswith(b"2.0 +- 0.1 m/s^2, J?rgensen")


def test_compiled_loops_without_a_folder_to_keep_them(monkeypatch):
    plain = numba.njit

    def njit(**options):
        if options.pop("cache", False):
            raise RuntimeError("cannot cache function: no locator available")
        return plain(**options)

    monkeypatch.setattr(numba, "njit", njit)
    assert compile_loop(nogil=True)(lambda x: x + 1)(2) == 3


@pytest.mark.slow
def test_no_round_has_a_number_that_goes_back(record, monkeypatch, capsys):
    """The search is made to prefer the other effect in hindsight, and then to search again."""
    first = []

    def prefer_other(last, step, catalogue, work):
        first.append(last.best.key)
        return None if first[1:] else next(t for t in last.trials if t.key != last.best.key)

    monkeypatch.setattr(growth, "find_better_choice", prefer_other)
    monkeypatch.setattr(growth, "retest_with_replicas", lambda model: replace(
        run_noise_tests(model.fit), alpha=1.0))  # fmt: skip
    cid.diagnose(drive(), record, catalogue=FEW)
    heads = [line.split(", ")[1:] for line in capsys.readouterr().err.splitlines()]
    heads = [", ".join(parts).partition(" (")[0] for parts in heads]
    numbers = [int(head.split()[1]) for head in heads if head.startswith("round ")]
    assert numbers == sorted(set(numbers))
    assert "looking back from round 2" in heads
    assert [head for head in heads if head.startswith("second search, round ")]


def test_what_comes_before_and_after_the_search_is_part_of_the_seconds(record, monkeypatch):
    """A budget of 60 s took 66: its clock began late, and the end was not counted in."""
    budgets, make, choose = [], Progress.make_budget, procedure.choose_fresh_data

    def keep(self, *given):
        budgets.append(make(self, *given))
        return budgets[-1]

    def choose_slowly(*given):
        time.sleep(0.5)
        return choose(*given)

    monkeypatch.setattr(Progress, "make_budget", keep)
    monkeypatch.setattr(procedure, "choose_fresh_data", choose_slowly)
    begun = time.monotonic()
    few = (E.InputOffset,)
    cid.diagnose(drive(), record[:400], catalogue=few, seconds=600, progress=False)
    (budget,) = budgets
    assert budget.start == pytest.approx(begun, abs=0.2)
    assert 0.5 < budget.kept < time.monotonic() - begun
    budget = Budget(100.0)
    budget.keep_back(10.0)
    assert budget.left == pytest.approx(90.0, abs=0.5)
    budget.keep_back(90.0)
    assert budget.left == pytest.approx(75.0, abs=0.5)
