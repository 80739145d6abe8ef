"""Whether a parameter is one number: silent where it is, loud where a law is only nearly right."""

import control as ct
import numpy as np
import pytest

import ctrlid as cid
import problems
from ctrlid import effects as E
from ctrlid.diagnosis.constancy import find_bin_edges
from ctrlid.diagnosis.noise_tests import run_noise_tests
from ctrlid.diagnosis.recalibration import fit_base_model

OF_INNOVATIONS = ("whiteness", "independence of past signals", "heavy tails", "isolated events")


def breathing(rhythm=0.0):
    """A drive whose gain may breathe at 0.15 Hz; the model has a gain that does not."""

    def rates(t, x, u, p):
        gain = 30.0 * (1 + rhythm * np.sin(0.3 * np.pi * t)) if rhythm else p["k"]
        return np.array([x[1], (gain * u[0] - 5.0 * x[1]) / 2.0])

    plant = ct.nlsys(rates, lambda t, x, u, p: x[0], inputs=["u"], outputs=["y"],
                     states=["x", "v"], params={"k": 30.0}, name="drive")  # fmt: skip
    return problems.drive(("k",), plant)


def record_of(loop, seed, n=6000):
    return problems.record_of(loop, swing=0.3, hold=60, n=n, seed=seed, sensor_noise=1e-4)


def seen_in(loop, record):
    return run_noise_tests(fit_base_model(loop, [record], loop.free).fit).p_values


def test_nothing_is_seen_where_a_parameter_is_one_number():
    loop = breathing()
    found = [seen_in(loop, record_of(loop, seed, n=3000)) for seed in range(9700, 9716)]
    names = [k for k in found[0] if k.startswith("constancy of k over ") or k == "rhythm of k"]
    assert len(names) == 7  # time, input, its change, position, velocity, reference; a rhythm
    p = np.array([[f[k] for k in names] for f in found])
    # Uniform: 112 of them, of which those of a record hang together.
    assert p.min() > 1e-5
    assert np.mean(p < 0.05) < 0.13
    assert 0.35 < np.mean(p < 0.5) < 0.65


def test_what_the_fit_takes_out_of_a_bin_is_not_missed():
    """Means and scores in bins have their level though several parameters were fitted."""
    plant = cid.plants.servo(m=2.0, c=5.0, k=30.0)
    loop = problems.drive(("k", "c"), plant)
    found = [
        seen_in(loop, problems.record_of(loop, swing=0.3, hold=60, n=2000, seed=seed,
                                         sensor_noise=1e-4))
        for seed in range(9800, 9824)
    ]  # fmt: skip
    bins = [k for k in found[0] if k.startswith(("constancy of ", "mean by "))]
    p = np.array([[f[k] for k in bins] for f in found])
    assert len(bins) == 18
    assert 0.4 < np.mean(p < 0.5) < 0.6
    assert 0.02 < np.mean(p < 0.05) < 0.09


def test_a_rhythm_of_a_parameter_shows_where_the_innovations_look_like_noise():
    record = record_of(breathing(rhythm=0.0007), 9720)
    p = seen_in(breathing(), record)
    assert p["rhythm of k"] < 1e-8
    assert min(p[k] for k in OF_INNOVATIONS) > 1e-5


def test_a_force_law_that_is_only_nearly_right_shows_in_its_parameter():
    loop = breathing()
    real = loop.with_effect(E.CubicStiffness(300.0))
    record = record_of(real, 9730)
    named = loop.with_effect(E.LinearStiffness(20.0))
    named = cid.Loop(named.plant, named.controller, dt=named.dt, at=named.at, effects=named.effects,
                     free=("k", "LinearStiffness.k1"))  # fmt: skip
    assert seen_in(named, record)["constancy of LinearStiffness.k1 over position"] < 1e-12


@pytest.mark.slow
def test_a_diagnosis_is_not_clean_where_a_gain_breathes():
    record = record_of(breathing(rhythm=0.03), 9740, n=2000)
    found = cid.diagnose(breathing(), record, progress=False,
                         catalogue=[E.CoulombFriction, E.ActuatorLag])  # fmt: skip
    assert found.verdict == "unknown"
    assert "a periodic change of k" in str(found)


def test_edges_of_bins_have_no_rounding_errors_in_place_of_zero():
    values = np.concatenate([np.full(300, 4.7e-13), np.linspace(-1.0, 1.0, 300)])
    edges = find_bin_edges(values)
    assert 0.0 in edges
    assert np.abs(edges[edges != 0.0]).min() > 1e-4
    assert find_bin_edges(1e-12 * values).max() == 1e-12
