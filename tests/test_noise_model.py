"""The colour of a model's equation errors: found where the model carries none."""

import numpy as np
import pytest
from scipy import signal

import ctrlid as cid
from ctrlid.validation.noise_model import fit_noise_polynomial, whiten_errors
from problems import levitation, record_of


@pytest.mark.parametrize("colour", [[1.0, 0.0, 0.0], [1.0, -1.4, 0.5], [1.0, 0.6, 0.1]])
def test_recovers_a_known_colour_and_whitens(colour):
    e = np.random.default_rng(1).standard_normal(20_000)
    errors = signal.lfilter(colour, [1.0], e)
    found = fit_noise_polynomial(errors, [(0, len(e))], np.array([1.0, -2.04, 1.0]))
    np.testing.assert_allclose(found, colour, atol=0.03)
    white = whiten_errors(errors, [(0, len(e))], found)
    assert np.std(white) == pytest.approx(1.0, rel=0.02)


def test_sensor_noise_on_an_unstable_plant_reflects_its_poles():
    """A e with roots outside the unit circle looks like C e with the roots inside."""
    den = np.poly([1.25, 0.7])
    e = np.random.default_rng(2).standard_normal(20_000)
    found = fit_noise_polynomial(signal.lfilter(den, [1.0], e), [(0, len(e))], den)
    np.testing.assert_allclose(np.sort(np.roots(found).real), [0.7, 0.8], atol=0.03)


def test_a_right_model_without_a_noise_model_gets_a_clean_bill():
    loop = levitation(dt=0.005, crossover=85, phase_margin=45, sampled=True)
    P = loop.linearize()
    record = record_of(loop, swing=1e-4, hold=4, n=8000, seed=1, sensor_noise=1e-5)
    right = cid.compare(record, P)
    assert "SOMETHING IS MISSING" not in right.verdict
    assert right.curves[-1].noise_share > 0.95
    wrong = cid.compare(record, 1.3 * P)
    assert "SOMETHING IS MISSING" in wrong.verdict
    instruments = cid.fit_iv(record, 2, 2, constraints=[cid.ReciprocalPoles()])
    assert "SOMETHING IS MISSING" not in cid.compare(record, instruments).verdict
