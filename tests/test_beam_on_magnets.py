"""A beam on two magnets: two inputs that act on both coordinates, two references, two outputs."""

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid import effects as E

DT, GAP, CURRENT = 0.002, 0.01, 4.4294
UNITS = {"z": "m", "phi": "rad", "i1": "A", "i2": "A", "K": "N m^2/A^2", "J": "kg m^2"}
NAMES = {"r": ("r_z", "r_phi"), "u": ("i1", "i2"), "y": ("z", "phi")}


def move(t, x, u, p):
    z, phi, v, w = x
    left = p["K"] * u[0] ** 2 / (z + p["a"] * phi) ** 2
    right = p["K"] * u[1] ** 2 / (z - p["a"] * phi) ** 2
    lift, tilt = (left + right) / p["m"], p["a"] * (left - right) / p["J"]
    return np.array([v, w, p["g"] - lift, -tilt])


def make_controller(sign=-1.0):
    """A PD for height and one for tilt, whose sum and difference drive the magnets.

    A gap grows where the current is too small, so that their gains are negative.
    """
    law = [
        ct.ss(sign * (p + d * ct.tf([1, -1], [0.002 + DT, -0.002], DT)), inputs=[error],
              outputs=[out], name=f"pd {out}")
        for error, out, p, d in (("ez", "iz", 900.0, 14.0), ("ep", "ip", 120.0, 1.9))
    ]  # fmt: skip
    mix = ct.nlsys(
        None, lambda t, x, u, p: np.array([CURRENT + u[0] + u[1], CURRENT + u[0] - u[1]]),
        inputs=["iz", "ip"], outputs=["i1", "i2"], name="mix", dt=DT,
    )  # fmt: skip
    sums = [ct.summing_junction(["r_z", "-z"], "ez"), ct.summing_junction(["r_phi", "-phi"], "ep")]
    return ct.interconnect([*law, mix, *sums], inputs=["r_z", "z", "r_phi", "phi"],
                           outputs=["i1", "i2"], name="two PDs")  # fmt: skip


def make_loop(**given):
    plant = ct.nlsys(
        move, lambda t, x, u, p: np.array([x[0], x[1]]), name="beam", inputs=["i1", "i2"],
        outputs=["z", "phi"], states=["z", "phi", "z_dot", "phi_dot"],
        params={"m": 0.8, "J": 0.012, "a": 0.15, "K": 2e-5, "g": 9.81},
    )  # fmt: skip
    at = cid.OperatingPoint((GAP, 0.0, 0.0, 0.0), (CURRENT, CURRENT), (GAP, 0.0))
    return cid.Loop(plant, make_controller(), dt=DT, at=at, **{"free": ("K", "J"), "units": UNITS,
                    **given})  # fmt: skip


def make_record(n=800, seed=1, **given):
    r = np.array([GAP + cid.random_binary(n, amplitude=3e-4, hold=60, seed=seed),
                  cid.random_binary(n, amplitude=2e-3, hold=45, seed=seed + 1)])  # fmt: skip
    return cid.simulate(make_loop(), {"r_z": r[0], "r_phi": r[1]}, sensor_noise=(2e-6, 1e-5),
                        seed=seed, **given)  # fmt: skip


@pytest.fixture(scope="module")
def record():
    return make_record()


# --- what is saved


@pytest.mark.parametrize("limits", [(0.0, 9.0), ((0.0, 0.5), (9.0, 8.5)), (0.0, (9.0, 8.5))])
def test_limits_of_one_and_of_each_input_survive_a_file(limits, record, tmp_path):
    loop = make_loop(input_limits=limits)
    found = cid.diagnose(loop, record, catalogue=[E.SensorGain], progress=False)
    file = found.save(tmp_path / "found.json")
    for back in (cid.load_diagnosis(file), cid.load_diagnosis(file, loop=loop)):
        assert back.loop.input_limits == loop.input_limits
        assert str(back) == str(found)
        assert back.save(tmp_path / "again.json").read_text() == file.read_text()
