"""Backlash of an input that a controller kicks and sensor noise shakes.

The records are of plain arithmetic, without ctrlid: a mass on a spring, a backlash ahead of it, and
a PD controller whose derivative passes the noise of the sensor on and kicks at each step.
"""

import control as ct
import numpy as np
import pytest
from scipy import linalg

import ctrlid as cid
from ctrlid import effects as E
from ctrlid.diagnosis.recalibration import fit_base_model
from ctrlid.diagnosis.refitting import refit_candidate
from ctrlid.diagnosis.scans import scan_candidate
from ctrlid.loop.simulation import make_simulator
from ctrlid.validation.record_simulation import prepare_stretch

DT, SIGMA, GAP = 0.002, 2e-4, 110.0
MASS, SPRING, DAMPING = 1.0, 900.0, 6.0
KP, KD, FILTER = 800.0, 30.0, 0.5


def make_loop() -> cid.Loop:
    """Return what the user knows, with a spring and a damping that are a little off."""
    plant = ct.nlsys(
        lambda t, x, u, q: np.array([x[1], (u[0] - q["s"] * x[0] - q["c"] * x[1]) / q["m"]]),
        lambda t, x, u, q: x[0], inputs=["F"], outputs=["x"], states=["x", "v"],
        params={"m": MASS, "s": 1.03 * SPRING, "c": 0.95 * DAMPING}, name="spring",
    )  # fmt: skip
    # u = KP e + KD/DT (1 - a)(e - e_filtered), a derivative with a filter.
    law = ct.tf([KP], [1.0], DT) + ct.tf([KD / DT * (1 - FILTER), -KD / DT * (1 - FILTER)],
                                         [1.0, -FILTER], DT)  # fmt: skip
    at = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
    return cid.Loop(plant, law, dt=DT, at=at, free=("s", "c"))


def record_backlash(seed: int, n: int = 1500) -> cid.Record:
    """Return a record of the rig, whose plant is linear for a held force."""
    rates = np.array([[0, 1, 0], [-SPRING / MASS, -DAMPING / MASS, 1 / MASS], [0, 0, 0]])
    step = linalg.expm(rates * DT)
    rng = np.random.default_rng(seed)
    r = np.repeat(rng.choice([-0.01, 0.01], n // 60 + 1), 60)[:n]
    x = v = held = old = slow = 0.0
    y, u = np.zeros(n), np.zeros(n)
    for k in range(n):
        y[k] = x + SIGMA * rng.standard_normal()
        error = r[k] - y[k]
        slow = FILTER * slow + KD / DT * (1 - FILTER) * (error - old)
        old = error
        u[k] = KP * error + slow
        held = min(max(held, u[k] - GAP / 2), u[k] + GAP / 2)
        x, v, _ = step @ [x, v, held]
    return cid.Record(r=r, u=u, y=y, dt=DT)


def test_a_gap_is_found_though_kicks_make_the_range_of_the_input_many_times_as_large():
    loop, record = make_loop(), record_backlash(1)
    base = fit_base_model(loop, [record], loop.free)
    narrow = E.InputBacklash.candidates(loop, record)[0]
    found = refit_candidate(base, scan_candidate(base, narrow))
    assert found.gain > 100
    assert found.fitted.width == pytest.approx(GAP, rel=0.01)


def test_the_start_of_a_simulation_is_where_the_plant_follows_the_logged_input():
    record = record_backlash(2)
    loop = make_loop().with_effect(E.InputBacklash(GAP))
    loop = loop.with_parameters({"s": SPRING, "c": DAMPING})
    part = slice(900, 1500)
    start = prepare_stretch(make_simulator(loop), record, part).initial
    plant = make_simulator(cid.Loop(loop.plant, dt=DT, at=loop.at, effects=loop.effects).
                           with_parameters({"s": SPRING, "c": DAMPING}))  # fmt: skip
    alone = np.concatenate([start[:2], start[-1:]])
    y, _ = plant.run(alone, None, record.u[part])
    assert np.std(record.y[part] - y) == pytest.approx(SIGMA, rel=0.1)


@pytest.mark.parametrize("seed", [4, pytest.param(5, marks=pytest.mark.slow)])
def test_a_backlash_that_noise_shakes_loose_is_named_alone(seed):
    found = cid.diagnose(
        make_loop(), record_backlash(seed), progress=False,
        catalogue=(E.InputBacklash, E.InputDeadZone, E.CoulombFriction, E.SensorLag),
    )  # fmt: skip
    assert found.verdict == "explained"
    assert [f.names for f in found.findings] == [("InputBacklash",)]
    assert found.gap.after < 1.3 * found.gap.floor
