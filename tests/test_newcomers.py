"""What strangers typed first: answers that say what to type."""

import sys
import types

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import CtrlidError, CtrlidWarning
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
    with pytest.warns(CtrlidWarning, match=r"10 % is \{'K': 0.1\}"):
        levitation(free={"K": share})


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
    with pytest.raises(CtrlidError, match="no T=; it has tau"):
        E.ActuatorLag(T=0.1)


def test_a_loop_without_its_period_says_where_it_stands():
    with pytest.raises(CtrlidError, match=r"Loop\(plant, controller, dt=0.001\)"):
        cid.Loop(cid.plants.servo(m=1, c=1, k=1), 1.0)
