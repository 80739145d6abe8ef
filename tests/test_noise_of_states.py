"""Noise on the rates of a plant without a moving mass does not depend on the units of its states.

A stirred tank with a reaction, from a simulator of its own: concentration and temperature, of which
the temperature is measured, under a PI controller.
"""

import control as ct
import numpy as np
import pytest

import ctrlid as cid

DT = 0.5
PARAMETERS = {"UA": 1.0, "k": 0.04, "heat": 60.0}
COOLED = 0.02


def rates(c, temperature, u, p):
    burnt = p["k"] * c * np.exp(0.05 * (temperature - 60.0))
    flow = 0.02
    return (flow * (1.0 - c) - burnt,
            flow * (50.0 - temperature) + p["heat"] * burnt
            - COOLED * p["UA"] * (temperature - u))  # fmt: skip


def reactor(unit):
    """The model, with the concentration in a unit of which `unit` are one mol/l."""

    def f(t, x, u, p):
        dc, dT = rates(x[0] / unit, x[1], u[0], p)
        return [unit * dc, dT]

    plant = ct.nlsys(f, lambda t, x, u, p: x[1], inputs=["Tc"], outputs=["T"],
                     states=["c", "T"], params=PARAMETERS, name="reactor")  # fmt: skip
    at = cid.operating_point(plant, output=60.0, guess=(0.3 * unit, 60.0))
    control = cid.PID(kp=3.0, ki=0.05, bias=float(at.input))
    units = {"T": "degC", "Tc": "degC", "c": "mol/l" if unit == 1 else "mol/m^3"}
    return cid.Loop(plant, control, dt=DT, at=at, free=("UA",), units=units)


@pytest.fixture(scope="module")
def log():
    rng = np.random.default_rng(3)
    at, n, fine = reactor(1.0).at, 2000, 5
    x, held = np.array(at.states), 0.0
    r = 60.0 + np.repeat(rng.choice([-1.0, 1.0], n // 100), 100)
    u, y = np.zeros(n), np.zeros(n)
    for k in range(n):
        y[k] = x[1] + 0.05 * rng.standard_normal()
        held += 0.05 * DT * (r[k] - y[k])
        u[k] = float(at.input) + 3.0 * (r[k] - y[k]) + held
        # The feed fluctuates: concentration and temperature, each by itself.
        push = np.array([2e-4, 0.02]) * rng.standard_normal(2)
        for _ in range(fine):
            h = DT / fine
            one = np.array(rates(*x, u[k], PARAMETERS)) + push
            two = np.array(rates(*(x + h * one), u[k], PARAMETERS)) + push
            x = x + h * (one + two) / 2
    return cid.Record(r=r, u=u, y=y, dt=DT, units={"u": "degC", "y": "degC", "r": "degC"})


def test_the_floor_does_not_depend_on_the_unit_of_a_state(log):
    found = [cid.diagnose(reactor(unit), log, progress=False) for unit in (1.0, 1000.0)]
    for one in found:
        assert one.verdict == "nothing missing"
        # What noise alone leaves is what was measured, in a run of 500 samples.
        assert one.gap.floor == pytest.approx(one.gap.given, rel=0.25)
    small, large = (one.gap.floor for one in found)
    assert large == pytest.approx(small, rel=0.1)


def test_noise_is_told_of_each_state_with_its_unit(log):
    fit = cid.fit_loop(reactor(1.0), log).estimate
    assert fit.places[1] == ("c", "T")
    assert fit.force_noise[1] == pytest.approx(0.02, rel=0.3)
    assert "mol/(l s) at c and 0.0" in str(fit)
    assert "degC/s at T" in str(cid.predict(reactor(1.0), log))
    table = str(cid.compare(log, reactor(1.0)))
    row = next(line for line in table.splitlines() if "closed-loop simulation" in line)
    assert float(row.split("%")[-2].split()[-1]) > 60
