"""References that run straight between the samples, as python-control takes them."""

from dataclasses import replace

import control as ct
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ctrlid as cid
import problems

DT, N = 0.01, 1200
MASS, DAMPING, GAIN = 2.0, 1.0, 30.0


def run(t, r):
    """A mass under an analog lead ``(8 s + 30)/(0.01 s + 1)``, by a solver of SciPy."""

    def rates(now, z):
        error = np.interp(now, t, r) - z[0]
        u = 800 * error + z[2]
        return [z[1], (u - DAMPING * z[1]) / MASS, (-(z[2]) - 770 * error) / 0.01]

    y, u, z = [0.0], [800 * r[0]], np.zeros(3)
    for k in range(len(t) - 1):
        z = solve_ivp(rates, t[k : k + 2], z, "DOP853", rtol=1e-9, atol=1e-12).y[:, -1]
        y.append(z[0])
        u.append(800 * (r[k + 1] - z[0]) + z[2])
    return np.array(u), np.array(y)


@pytest.fixture(scope="module")
def record():
    t = DT * np.arange(N)
    r = cid.random_binary(N, amplitude=0.05, hold=20, seed=1)
    u, y = run(t, r)
    y = y + 1e-5 * np.random.default_rng(1).standard_normal(N)
    return cid.Record(r=r, u=u, y=y, dt=DT, hold="foh", hold_r="foh")


def make_loop():
    plant = problems.mass(lambda t, x, u, p: np.array([x[1], (u[0] - p["c"] * x[1]) / p["m"]]),
                          m=MASS, c=DAMPING)  # fmt: skip
    return cid.Loop(plant, ct.tf([8, 30], [0.01, 1]), dt=DT, free=("m", "c"))


def test_plant_and_controller_are_integrated_under_a_straight_reference(record):
    fit = cid.fit_loop(make_loop(), record)
    assert abs(fit.estimate["m"] / MASS - 1) < 0.01
    assert not any("NOT WHITE" in note for note in fit.estimate.notes)
    held = cid.fit_loop(make_loop(), replace(record, hold_r="zoh"))
    assert abs(held.estimate["m"] / MASS - 1) > 0.02


def test_a_simulation_follows_a_straight_reference(record):
    right, held = (
        next(c.rms for c in cid.compare(one, make_loop()).curves if "simulation" in c.label)
        for one in (record, replace(record, hold_r="zoh"))
    )
    assert right < 2e-5
    assert held > 20 * right


def test_a_continuous_model_is_fitted_under_a_straight_reference(record):
    G = cid.fit_continuous(record, poles=2, controller=ct.tf([8, 30], [0.01, 1]))
    assert abs(G.estimate["b1"] * MASS - 1) < 0.02


CONTINUOUS = ct.ss(ct.tf([1.0], [1.0, 0.4, 2.0], inputs="u", outputs="y"))
BENT = ct.nlsys(
    lambda t, x, u, p: np.array([x[1], u[0] - 0.4 * x[1] - 2 * np.sin(x[0])]),
    lambda t, x, u, p: x[0], inputs=["u"], outputs=["y"], states=2,
)  # fmt: skip
BENT_DISCRETE = ct.nlsys(
    lambda t, x, u, p: np.array([x[0] + 0.1 * x[1], x[1] + 0.1 * (u[0] - x[1] - np.sin(x[0]))]),
    lambda t, x, u, p: x[0], inputs=["u"], outputs=["y"], states=2, dt=0.1,
)  # fmt: skip


@pytest.mark.parametrize(("system", "hold"), [
    (CONTINUOUS, "foh"), (BENT, "foh"), (CONTINUOUS.sample(0.1), "zoh"),
    (BENT_DISCRETE, "zoh"),
])  # fmt: skip
@pytest.mark.parametrize("kind", ["steps", "noise", "sine"])
def test_a_response_tells_how_its_inputs_run(system, hold, kind):
    t = 0.1 * np.arange(300)
    u = {"steps": cid.random_binary(300, amplitude=1.0, hold=15, seed=2),
         "noise": np.random.default_rng(2).standard_normal(300), "sine": np.sin(3 * t)}  # fmt: skip
    record = cid.Record.from_response(ct.input_output_response(system, t, u[kind]))
    assert (record.hold, record.hold_r) == (hold, hold)


def test_a_response_of_a_loop_gives_the_mass():
    """The way of a user: interconnect, input_output_response, from_response, fit_loop."""
    plant = problems.mass(lambda t, x, u, p: np.array([x[1], (u[0] - p["c"] * x[1]) / p["m"]]),
                          m=MASS, c=DAMPING)  # fmt: skip
    lead = ct.tf([8, 30], [0.01, 1], inputs="e", outputs="u", name="lead")
    closed = ct.interconnect(
        [plant, lead, ct.summing_junction(["r", "-x"], "e")], inputs="r", outputs=["x", "u"]
    )
    t = DT * np.arange(600)
    r = cid.random_binary(600, amplitude=0.05, hold=20, seed=3)
    response = ct.input_output_response(closed, t, r, solve_ivp_kwargs={"rtol": 1e-8})
    record = cid.Record.from_response(response, r="r", u="u", y="x")
    assert (record.hold, record.hold_r) == ("foh", "foh")
    fit = cid.fit_loop(make_loop(), record)
    assert abs(fit.estimate["m"] / MASS - 1) < 0.01


def test_a_file_keeps_the_word(record, tmp_path):
    record.to_csv(tmp_path / "a.csv")
    assert cid.Record.from_csv(tmp_path / "a.csv").hold_r == "foh"
    with pytest.raises(cid.CtrlidError, match="hold_r must be 'zoh'"):
        replace(record, hold_r="bandlimited")
