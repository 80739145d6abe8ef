"""A delay at one of several inputs, against a simulator in matrix exponentials of its own."""

from dataclasses import replace
from itertools import pairwise

import control as ct
import numpy as np
import pytest
from scipy.linalg import expm

import ctrlid as cid
from ctrlid import CtrlidError
from ctrlid import effects as E
from ctrlid.estimation.likelihood.filter_data import make_filter_data
from ctrlid.estimation.likelihood.kalman_filter import Trajectory
from ctrlid.estimation.likelihood.sampled_plant import SampledPlant

DT = 0.02
A = np.array([[0, 1, 0, 0], [-4, -1, 4, 0], [0, 0, 0, 1], [4, 0, -5, -1.0]])
B = np.array([[0, 0], [1, 0], [0, 0], [0, 2.0]])
C = np.eye(4)[[0, 2]]
INPUTS = ("F1", "F2")


def two_masses(**options):
    """Two masses with a spring between them, and a force on each."""

    def rates(t, x, u, p):
        stretch = p["k"] * (x[0] - x[2])
        return [x[1], -p["c"] * x[1] - stretch + u[0],
                x[3], -p["c"] * x[3] + stretch - x[2] + 2 * u[1]]  # fmt: skip

    plant = ct.nlsys(
        rates, lambda t, x, u, p: [x[0], x[2]], inputs=list(INPUTS), outputs=["x1", "x2"],
        states=["x1", "v1", "x2", "v2"], params={"k": 4.0, "c": 1.0}, name="masses",
    )  # fmt: skip
    return cid.Loop(plant, dt=DT, **options)


def draw_inputs(n, seed=0):
    rng = np.random.default_rng(seed)
    return np.array([np.repeat(rng.choice([-1.0, 1.0], n // k + 1), k)[:n] for k in (7, 5)])


def follow(u, late, hold, x, first, last):
    """States at the samples from `first` to `last`, for inputs that are late by `late` seconds."""
    n = u.shape[1]
    times = [np.arange(first, last + 1) * DT, *(np.arange(-3, last + 4) * DT + d for d in late)]
    corners = np.unique(np.round(np.concatenate(times), 12))
    corners = corners[(corners >= first * DT - 1e-9) & (corners <= last * DT + 1e-9)]
    states = [x]

    def value(j, t):
        if t < late[j] - 1e-9:
            return u[j, 0], 0.0
        k = min(int((t - late[j]) / DT + 1e-9), n - 1)
        ahead = u[j, min(k + 1, n - 1)] if hold == "foh" else u[j, k]
        slope = (ahead - u[j, k]) / DT
        return u[j, k] + slope * (t - late[j] - k * DT), slope

    for start, end in pairwise(corners):
        level, slope = np.array([value(j, start) for j in range(2)]).T
        big = np.zeros((8, 8))
        big[:4, :4], big[:4, 4:6], big[4:6, 6:] = A, B, np.eye(2)
        x = (expm(big * (end - start)) @ np.concatenate([x, level, slope]))[:4]
        if abs(end / DT - round(end / DT)) < 1e-7:
            states.append(x)
    return np.array(states)


def move(u, late, hold):
    """The outputs of the masses, which rest before the record begins."""
    return C @ follow(u, late, hold, np.zeros(4), 0, u.shape[1] - 1).T


def move_from_rest(u, late, hold, k):
    """What the inputs do in the period after sample k to masses that were at rest."""
    return follow(u, late, hold, np.zeros(4), k, k + 1)[1]


PLACES = pytest.mark.parametrize(
    ("place", "delay"), [(0, 0.6 * DT), (1, 0.3 * DT), (1, DT), (1, 2.7 * DT)]
)


def make_case(place, delay, hold="zoh"):
    """A loop with the delay, and a record of it without noise, which rests at first."""
    u, late = draw_inputs(150), [0.0, 0.0]
    u[:, :5] = 0.0
    late[place] = delay
    loop = two_masses().with_effect(E.InputDelay(delay=delay, at=INPUTS[place]))
    return loop, cid.Record(u=u, y=move(u, late, hold), dt=DT, hold=hold)


@PLACES
def test_a_simulation_holds_back_one_input_and_not_the_other(place, delay):
    loop, record = make_case(place, delay)
    made = cid.simulate(loop, d=record.u)
    np.testing.assert_allclose(made.y, record.y, atol=1e-9)


def test_a_single_input_comes_late_as_one_of_two_does():
    u, late = draw_inputs(80), 1.4 * DT
    u[:, :3] = 0.0
    alone = cid.Loop(cid.plants.servo(m=1.0, c=1.0, k=3.0), None, dt=DT)
    made = cid.simulate(alone.with_effect(E.InputDelay(delay=late)), d=u[0])
    system, t = ct.ss([[0, 1], [0, -1]], [[0], [3]], [[1, 0]], [[0]]), np.arange(80 * 5) * DT / 5
    pushed = np.repeat(u[0], 5)
    arrived = np.concatenate([np.zeros(7), pushed])[: len(t)]
    exact = ct.forced_response(ct.sample_system(system, DT / 5), t, arrived).y[0][::5]
    np.testing.assert_allclose(made.y, exact, atol=1e-9)


@PLACES
@pytest.mark.parametrize("hold", ["zoh", "foh"])
def test_the_filter_holds_back_one_input_and_not_the_other(place, delay, hold):
    loop, record = make_case(place, delay, hold)
    plant = SampledPlant(loop, (), hold, "")
    data = make_filter_data(loop, record)
    rng = np.random.default_rng(4)
    x = rng.standard_normal((len(record), 4))
    after = plant.linearize(data, np.empty(0), Trajectory(x, x, x)).step
    # A state moves to where the plant takes it; the inputs act as if it had been at rest.
    free, late = expm(A * DT), [0.0, 0.0]
    late[place] = delay
    for k in range(10, 140):
        pushed = move_from_rest(np.asarray(record.u), late, hold, k)
        np.testing.assert_allclose(after[k], free @ x[k] + pushed, atol=2e-6)


def test_a_linear_model_has_the_phase_of_the_delay():
    loop = two_masses().with_effect(E.InputDelay(delay=0.5 * DT, at="F2"))
    w = 2.0
    late, prompt = (x.linearize()(1j * w) for x in (loop, two_masses()))
    np.testing.assert_allclose(late[:, 0], prompt[:, 0], atol=1e-9)
    np.testing.assert_allclose(late[:, 1], prompt[:, 1] * np.exp(-0.5j * w * DT), atol=1e-6)


def test_two_late_inputs_are_refused_in_words():
    loop = two_masses().with_effect(E.InputDelay(delay=0.01, at="F2"))
    with pytest.raises(CtrlidError, match="one of several inputs can come late, and F2 does"):
        loop.with_effect(E.InputDelay(delay=0.01, at="F1"))
    more = loop.with_effect(E.InputDelay(delay=0.02, at="F2"))
    assert more.linearize().ninputs == 2


@pytest.mark.parametrize(
    ("place", "delay"), [pytest.param(0, 0.6 * DT, marks=pytest.mark.slow), (1, 1.3 * DT)]
)
def test_a_fit_and_a_diagnosis_find_the_delay_and_its_place(place, delay):
    u = draw_inputs(900, seed=1)
    late = [0.0, 0.0]
    late[place] = delay
    y = move(u, late, "zoh")
    y += 1e-3 * np.random.default_rng(2).standard_normal(y.shape)
    record = cid.Record(u=u, y=y, dt=DT)
    loop = two_masses(free=("k", "c"))
    wrong = loop.with_effect(E.InputDelay(delay=0.5 * DT, at=INPUTS[place]))
    fit = cid.fit_loop(replace(wrong, free=("k", "c", "InputDelay.delay")), record)
    for name, true in {"k": 4.0, "c": 1.0, "InputDelay.delay": delay}.items():
        low, high = fit.estimate.confidence_interval(name, 0.9999)
        assert low < true < high
    few = [E.InputDelay, E.ActuatorLag, E.ViscousFriction, E.SensorGain]
    found = cid.diagnose(loop, record, catalogue=few, progress=False)
    assert found.verdict == "explained"
    (finding,) = found.findings
    assert isinstance(finding.effect, E.InputDelay)
    assert finding.effect.at == INPUTS[place]
    assert f"InputDelay at {INPUTS[place]};" in repr(found)


FEEDTHROUGH = ct.tf([0.5, 1.0, 2.0], [1.0, 1.2, 4.0])


@pytest.mark.parametrize("delay", [0.1, 0.2, 0.25])
def test_what_passes_through_at_once_comes_late_as_well(delay):
    """The output had the part of the input that passes through as it was computed, not late."""
    loop = cid.Loop(FEEDTHROUGH, None, dt=0.1)
    d = np.repeat(np.random.default_rng(1).choice([-1.0, 1.0], 20), 5)
    late = cid.simulate(loop.with_effect(E.InputDelay(delay=delay)), d=d).y
    fine = cid.Loop(FEEDTHROUGH, None, dt=0.05)
    shifted = np.concatenate([np.zeros(round(delay / 0.05)), np.repeat(d, 2)])[: 2 * len(d)]
    expected = cid.simulate(fine, d=shifted).y[::2]
    np.testing.assert_allclose(late, expected, atol=1e-9)


def test_a_backlash_takes_its_part_of_what_passes_through():
    loop = cid.Loop(FEEDTHROUGH, None, dt=0.1).with_effect(E.InputBacklash(width=0.4))
    d = np.where(np.arange(20) < 3, 0.0, 1.0)
    assert cid.simulate(loop, d=d).y[3] == pytest.approx(0.5 * 0.8)


def test_a_comparison_with_a_late_input_does_not_contradict_itself():
    loop = cid.Loop(FEEDTHROUGH, None, dt=0.1).with_effect(E.InputDelay(delay=0.2))
    d = cid.random_binary(1000, amplitude=1.0, hold=20, seed=1)
    record = cid.simulate(loop, d=d, sensor_noise=1e-2, seed=1)
    found = cid.compare(record, loop)
    assert min(c.fit for c in found.curves) > 97.0
