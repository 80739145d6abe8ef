"""Coloured sensor noise in the likelihood, against theory and noise made by a filter."""

import dataclasses

import numpy as np
import pytest
from scipy import signal
from scipy.linalg import toeplitz

import ctrlid as cid
from ctrlid.estimation.likelihood.kalman_filter import Noise
from ctrlid.estimation.likelihood.likelihood import make_problem
from ctrlid.estimation.likelihood.maximization import begin_fit, choose_sensor_noise, maximize


def make_loop_and_record(b, a, n=1500):
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    at = cid.OperatingPoint(states=(0.0, 0.0), input=0.0, output=0.0)
    loop = cid.Loop(plant, cid.PID(kp=20.0, kd=1.0), dt=0.01, at=at, free=("k", "c"))
    r = cid.random_binary(n, amplitude=0.1, hold=50, seed=1)
    record = cid.simulate(loop, r, sensor_noise=0.0, seed=2)
    noise = signal.lfilter(b, a, np.random.default_rng(2).standard_normal(n + 500))[500:]
    noise *= 1e-4 / noise.std()
    # The noise is added to the reading only: u is that of the exact output.
    return loop, dataclasses.replace(record, y=np.array(record.y) + noise), noise


@pytest.mark.parametrize(
    ("ar", "ma"), [((0.8,), ()), ((), (0.6,)), ((), (1.0,)), ((0.5, 0.2), (0.3, -0.4))]
)
def test_the_likelihood_is_that_of_the_dense_covariance(ar, ma):
    loop, record, _ = make_loop_and_record([1.0], [1.0])
    quiet = Noise((1e-290,))
    fit = begin_fit(make_problem(loop, (), [record]), noise=quiet)
    known = dataclasses.replace(fit.data[0], spread=0 * fit.data[0].spread)
    problem = dataclasses.replace(fit.problem, data=(known,))
    fit = begin_fit(problem, noise=dataclasses.replace(quiet, ar=ar, ma=ma))
    out = fit.filtered[0]
    # The covariance of the process, of variance one, comes from its impulse response.
    impulse = signal.lfilter([1, *ma], [1, *(-v for v in ar)], np.eye(1, 3000)[0])
    gamma = np.correlate(impulse, impulse, "full")[2999 : 2999 + len(record)]
    covariance = toeplitz(gamma / gamma[0])
    e = record.y - out.trajectory.predicted[:, 0]
    squares = np.sum(out.innovations**2 / out.variance)
    assert squares == pytest.approx(e @ np.linalg.solve(covariance, e), rel=1e-9)
    logs = np.linalg.slogdet(covariance)[1]
    assert np.sum(np.log(out.variance)) == pytest.approx(logs, rel=1e-8)


@pytest.mark.parametrize(
    ("b", "a", "orders"),
    [
        ([1.0], [1.0], (0, 0)),
        ([1.0], [1.0, -0.9], (1, 0)),
        ([0.5, 0.5], [1.0], (0, 1)),
        ([1.0, 1.0, 1.0], [1.0], (0, 2)),
    ],
)
def test_the_order_of_coloured_noise_is_found_and_white_stays_white(b, a, orders):
    loop, record, noise = make_loop_and_record(b, a, n=2500)
    fit = choose_sensor_noise(maximize(begin_fit(make_problem(loop, ("k", "c"), [record]))))
    assert (len(fit.noise.ar), len(fit.noise.ma)) == orders
    assert np.sqrt(fit.sensor[0]) == pytest.approx(noise.std(), rel=0.15)
    z = fit.standardized[0]
    z = z[np.isfinite(z)]
    assert abs(np.mean(z[1:] * z[:-1])) < 4 / np.sqrt(len(z))
    error = (fit.theta - [3.0, 2.0]) / fit.standard_errors
    assert np.abs(error).max() < 4
