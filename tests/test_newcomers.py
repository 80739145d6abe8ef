"""What strangers typed first: answers that say what to type."""

import os
import subprocess
import sys
import types

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import CtrlidError, CtrlidWarning
from ctrlid import __main__ as command
from ctrlid import effects as E
from ctrlid.reporting.cli.arguments import read_plant
from problems import levitation, servo


def write_log(folder, t, name="log.csv"):
    path = folder / name
    rows = "\n".join(f"{a:.7f},{k % 7},{k % 5}" for k, a in enumerate(t))
    path.write_text(f"t [s],u,y\n{rows}\n")
    return path


def test_a_clock_that_jitters_has_the_period_that_its_maker_gave_it(tmp_path):
    rng = np.random.default_rng(1)
    for dt in (0.005, 0.0125):
        t = dt * np.arange(3000) + 0.03 * dt * rng.standard_normal(3000)
        with pytest.warns(CtrlidWarning, match="jitter by up to.*Give dt= if"):
            record = cid.Record.from_csv(write_log(tmp_path, t))
        assert record.dt == dt


def test_a_period_that_is_no_short_number_is_not_made_one(tmp_path):
    rng = np.random.default_rng(2)
    dt = 0.005 * (1 + 2e-3)
    t = dt * np.arange(3000) + 0.03 * dt * rng.standard_normal(3000)
    with pytest.warns(CtrlidWarning, match="jitter by up to"):
        record = cid.Record.from_csv(write_log(tmp_path, t))
    assert record.dt == pytest.approx(dt, rel=1e-4)


@pytest.mark.parametrize("share", [3.3e-6, 10.0])
def test_a_belief_that_is_a_value_or_per_cent_is_questioned(share):
    plant = levitation().plant
    op = cid.operating_point(plant, output=0.012)
    with pytest.warns(CtrlidWarning, match=r"10 % is \{'K': 0.1\}") as caught:
        cid.Loop(plant, None, dt=0.001, at=op, free={"K": share})
    # The warning shows the line of whoever made the loop.
    assert caught[0].filename == __file__


@pytest.mark.parametrize("share", [0.1, 1e-6, 1.0, np.inf])
def test_a_belief_is_none(share):
    assert levitation(free={"K": share}).free["K"] == share


def test_a_controller_is_no_design():
    loop = servo(cid.PID(kp=20.0, kd=1.0), dt=0.05)
    with pytest.raises(CtrlidError, match="give design=lambda P: C"):
        cid.redesign(loop.linearize(), loop, design=ct.tf([1], [1]))


def test_a_function_of_a_model_may_pass_options_on(monkeypatch):
    loop = servo(cid.PID(kp=20.0), dt=0.05)
    module = types.ModuleType("rig")
    module.model = lambda dt=0.05, **more: loop
    monkeypatch.setitem(sys.modules, "rig", module)
    assert read_plant("rig:model", {}) is loop


def test_one_letter_is_near_no_name():
    with pytest.raises(CtrlidError, match="no T=; it takes tau"):
        E.ActuatorLag(T=0.1)


def test_a_loop_without_its_period_says_where_it_stands():
    with pytest.raises(CtrlidError, match=r"Loop\(plant, controller, dt=0.001\)"):
        cid.Loop(cid.plants.servo(m=1, c=1, k=1), 1.0)


def test_an_observer_that_began_in_another_state_adds_no_dither():
    """python-control's estimator begins with a covariance of its own, which dies down."""
    plant = cid.plants.cart_pole(M=0.5, m=0.2, length=0.3, c=0.1)
    at, dt = cid.operating_point(plant, output=(0, 0)), 0.005
    linear = cid.linearize(plant, at, states=True)
    P = ct.ss(ct.sample_system(linear, dt), inputs=["F"], outputs=["x", "theta"])
    K = ct.dlqr(P, np.diag([10, 10, 1, 1]), np.eye(1))[0]
    observer = ct.create_estimator_iosystem(P, np.eye(1), 1e-4 * np.eye(2))
    feedback, _ = ct.create_statefbk_iosystem(P, K, estimator=observer)
    held = [f"xd[{k}]" for k in range(4)] + ["ud[0]"]
    C = ct.interconnect([observer, feedback], inputs=["y[0]", "y[1]", *held], outputs="F")
    rng = np.random.default_rng(0)
    r = np.repeat(rng.choice([-0.1, 0.1], 8), 200)
    x, state = np.array([0, 0.02, 0, 0.0]), np.zeros(C.nstates)
    us, ys = [], []
    for k, reference in enumerate(r):
        y = P.C @ x + 5e-4 * rng.standard_normal(2)
        seen = np.r_[y, reference, 0, 0, 0, 0]
        u = np.ravel(C.output(k * dt, state, seen))
        state = np.ravel(C.dynamics(k * dt, state, seen))
        us.append(u[0])
        ys.append(y)
        x = P.A @ x + P.B @ u
    names = {"u": "F", "y": ("x", "theta"), "r": "xd[0]"}
    record = cid.Record(u=us, y=np.array(ys).T, r=r, dt=dt, names=names)
    told = str(cid.audit(record, cid.Loop(plant, C, dt=dt, at=at)))
    assert "but for the first" in told
    assert "began in another state" in told
    assert "dither" not in told
    struck = np.array(us) + 0.1 * rng.standard_normal(len(us))
    told = str(cid.audit(cid.Record(u=struck, y=np.array(ys).T, r=r, dt=dt, names=names),
                         cid.Loop(plant, C, dt=dt, at=at)))  # fmt: skip
    assert "dither" in told


def test_an_audit_says_where_r_and_y_seem_exchanged():
    loop = levitation()
    r = cid.random_binary(1500, amplitude=1e-4, hold=40, around=loop.at.output, seed=1)
    record = cid.simulate(loop, r, sensor_noise=2e-6, seed=2)
    exchanged = cid.Record(r=record.y, u=record.u, y=record.r, dt=record.dt)
    assert "with r and y exchanged" in str(cid.audit(exchanged, loop))
    flipped = cid.Record(r=record.r, u=2 * loop.at.input - record.u, y=record.y, dt=record.dt)
    told = str(cid.audit(flipped, loop))
    assert "opposite sign" in told
    assert "exchanged" not in told


PIDS = {
    "no windup": {"anti_windup": "back-calculation"},
    "of a time of its own": {"anti_windup": "back-calculation", "tracking_time": 0.05},
}


@pytest.mark.parametrize("hold", [30, 150])
@pytest.mark.parametrize("real", PIDS.values(), ids=PIDS)
def test_an_integral_that_is_pulled_back_is_no_delay(real, hold):
    limits = {"kp": 20.0, "ki": 80.0, "lower": -2.0, "upper": 2.0}
    loop = servo(cid.PID(**limits, **real), dt=0.01)
    r = cid.random_binary(1500, amplitude=0.1, hold=hold, seed=2)
    record = cid.simulate(loop, r, sensor_noise=1e-4, seed=1)
    told = str(cid.audit(record, servo(cid.PID(**limits, anti_windup="clamp"), dt=0.01)))
    assert "back-calculation" in told
    assert "DELAY" not in told
    if "tracking_time" in real:
        assert "tracking_time=0.05" in told


def test_an_audit_of_a_pid_with_a_windup_of_its_own_does_not_die_of_a_gain_of_zero():
    pid = cid.PID(kp=20.0, ki=80.0, kd=0.3, anti_windup="back-calculation")
    r = cid.random_binary(1000, amplitude=0.1, hold=30, seed=2)
    record = cid.simulate(servo(pid, dt=0.01), r, sensor_noise=1e-4, seed=1)
    stated = cid.PID(kp=30.0, ki=80.0, anti_windup="back-calculation")
    assert "controller" in str(cid.audit(record, servo(stated, dt=0.01)))


def test_a_fit_says_where_a_record_is_in_another_unit():
    loop = levitation()
    r = cid.random_binary(800, amplitude=1e-4, hold=40, around=loop.at.output, seed=1)
    record = cid.simulate(loop, r, sensor_noise=2e-6, seed=2)
    far = cid.Record(r=1e3 * record.r, u=record.u, y=1e3 * record.y, dt=record.dt)
    notes = cid.fit_loop(loop, far).estimate.notes
    assert any(n.startswith("LOOK AT THE UNITS: y is 989.7 times") for n in notes), notes
    assert not any("UNITS" in n for n in cid.fit_loop(loop, record).estimate.notes)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-8"])
def test_a_file_in_two_bytes_a_sign_is_read_without_its_mark(tmp_path, encoding):
    path = tmp_path / "log.csv"
    path.write_bytes("t [s],u,y\n0,1,2\n0.1,3,4\n0.2,5,6\n".encode(encoding))
    record = cid.Record.from_csv(path)
    assert record.y.tolist() == [2, 4, 6]


def test_a_lead_at_a_frequency_where_nothing_is_left_of_the_plant_is_refused():
    with pytest.raises(CtrlidError, match="too far from the poles"):
        cid.design_lead(ct.tf([1], [1, 0, -1]), crossover=1e300, phase_margin=40)


def test_a_figure_says_what_it_takes():
    with pytest.raises(CtrlidError, match="figure needs a whole number as rows"):
        cid.plot.figure("a")
    with pytest.raises(CtrlidError, match="1 to 50 rows"):
        cid.plot.figure(0)
    with pytest.raises(CtrlidError, match=r"has no axes=; .*ax"):
        cid.plot.record(None, axes=None)


def test_tables_of_a_notebook_stand_straight():
    record = cid.Record(u=np.zeros(60), y=np.arange(60.0), dt=0.1)
    assert "font-family: monospace" in cid.audit(record)._repr_html_()


def test_a_regulator_at_zero_is_compared_and_redesigned_like_any_other():
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    at = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
    loop = cid.Loop(plant, cid.PID(kp=20.0, kd=1.0), dt=0.02, at=at)
    push = np.repeat([0.0, 1.0, -1.0, 0.5], 100)
    record = cid.simulate(loop, np.zeros(400), d=push, sensor_noise=1e-4, seed=1)
    told = str(cid.compare(record, loop)) + str(cid.redesign(loop, loop, 3.0, 50.0))
    assert "ran away" not in told


def test_the_help_says_that_a_model_file_is_run(capsys):
    with pytest.raises(SystemExit):
        command.main(["diagnose", "--help"])
    told = " ".join(capsys.readouterr().out.split())
    assert "the file is run as a Python program" in told


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a device that is full")
def test_the_answer_is_saved_before_it_is_printed(tmp_path):
    loop = servo(cid.PID(kp=20.0, kd=1.0), dt=0.05)
    r = cid.random_binary(300, amplitude=0.1, hold=10, seed=1)
    record = cid.simulate(loop, r, sensor_noise=1e-3, seed=1)
    record.to_csv(tmp_path / "log.csv")
    words = [sys.executable, "-m", "ctrlid", "diagnose", str(tmp_path / "log.csv"),
             "--model", "servo", "--param", "m=1", "c=2", "k=3", "--seconds", "1",
             "--save", str(tmp_path / "found")]  # fmt: skip
    with open("/dev/full", "w") as full:
        subprocess.run(words, stdout=full, stderr=subprocess.PIPE, check=False, timeout=300)
    assert cid.load_diagnosis(tmp_path / "found" / "diagnosis.json").verdict


def test_a_plant_without_a_state_is_no_plant_to_follow():
    record = cid.Record(u=np.sin(np.arange(200.0) ** 1.3), y=np.sin(np.arange(200.0)), dt=0.05)
    with pytest.raises(CtrlidError, match="has no state"):
        cid.diagnose(ct.tf([0], [1, 1]), record, progress=False)
    with pytest.raises(CtrlidError, match="compare needs a Loop"):
        cid.compare(record, cid.Loop)
