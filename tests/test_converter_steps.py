"""An arm behind an encoder, simulated in plain numpy: rounding is no white noise while it rests."""

import math

import control as ct
import numpy as np
import pytest

import ctrlid as cid
from ctrlid.data.validity import find_equal_readings
from ctrlid.diagnosis.thresholds import THRESHOLD
from ctrlid.estimation.likelihood.kalman_filter import Noise
from ctrlid.estimation.likelihood.likelihood import make_problem
from ctrlid.estimation.likelihood.maximization import begin_fit
from ctrlid.loop import step_check

J, DAMPING, TORQUE, WEIGHT = 0.012, 0.05, 0.08, 0.25
DT, STEP = 0.005, 2 * math.pi / 4096
KP, KI, KD, FILTER, LIMIT = 60.0, 120.0, 3.0, 0.01, 24.0


def simulate_arm(n, friction=0.0, lag=0.0, seed=3, noise=0.0):
    """A PID with derivative of the reading moves an arm from step to step; it rests in between."""
    rng = np.random.default_rng(seed)
    r = np.repeat(rng.choice([-0.5, -0.25, 0.25, 0.5], n // 120 + 1), 120)[:n]
    h = DT / 10
    angle = speed = drive = integral = slope = 0.0
    last = 0.0
    y, u = np.zeros(n), np.zeros(n)
    for k in range(n):
        y[k] = STEP * round((angle + noise * rng.standard_normal()) / STEP)
        error = r[k] - y[k]
        integral += KI * DT * error
        slope = (FILTER * slope - KD * (y[k] - last)) / (FILTER + DT)
        last = y[k]
        wanted = KP * error + integral + slope
        u[k] = min(max(wanted, -LIMIT), LIMIT)
        # Where u is limited the integral stands still.
        if wanted != u[k] and wanted * error > 0:
            integral -= KI * DT * error
            u[k] = min(max(KP * error + integral + slope, -LIMIT), LIMIT)
        for _ in range(10):
            drive = u[k] + (drive - u[k]) * math.exp(-h / lag) if lag else u[k]
            push = TORQUE * drive - DAMPING * speed - WEIGHT * math.sin(angle)
            if friction and abs(speed) < 1e-3 and abs(push) <= friction:
                speed = 0.0
                continue
            turn = math.copysign(1.0, speed or push)
            # The midpoint rule; a turn ends a step at rest.
            middle = angle + h / 2 * speed, speed + h / 2 * (push - friction * turn) / J
            push = TORQUE * drive - DAMPING * middle[1] - WEIGHT * math.sin(middle[0])
            angle += h * middle[1]
            new = speed + h * (push - friction * turn) / J
            speed = 0.0 if friction and speed * new < 0 else new
    return cid.Record(r=r, u=u, y=y, dt=DT, units={"y": "rad", "u": "V"})


def make_arm(*effects, free=("c", "mgl", "kt"), controller=None):
    def move(t, x, u, p):
        push = p["kt"] * u[0] - p["c"] * x[1] - p["mgl"] * np.sin(x[0])
        return np.array([x[1], push / p["J"]])

    params = {"J": J, "c": DAMPING, "kt": TORQUE, "mgl": WEIGHT}
    plant = ct.nlsys(move, lambda t, x, u, p: x[0], inputs=["V"], outputs=["phi"],
                     states=["phi", "w"], params=params)  # fmt: skip
    at = cid.operating_point(plant, output=0.0)
    loop = cid.Loop(plant, controller, dt=DT, at=at, free=free)
    for effect in effects:
        loop = loop.with_effect(effect)
    return loop


def test_equal_readings_in_a_row_count_once():
    rng = np.random.default_rng(0)
    y = np.repeat(rng.integers(0, 1000, 400), rng.integers(1, 9, 400)).astype(float)
    valid = rng.random(len(y)) < 0.9
    lengths, one = find_equal_readings(y, valid)
    assert not (one & ~valid).any()
    assert (lengths[~valid] == 1).all()
    # Each run is told by as many samples as it is long, and one of them is chosen.
    seen = y[valid]
    runs = 1 + int(np.count_nonzero(np.diff(seen)))
    assert one.sum() == runs
    assert np.sum(1 / lengths[valid]) == pytest.approx(runs)
    np.testing.assert_array_equal(find_equal_readings(7 * y - 3, valid)[1], one)
    places = [
        np.flatnonzero(part == 1)[0]
        for part in (find_equal_readings(np.zeros(50), np.arange(50) < n)[1] for n in (1, 2, 50))
    ]
    assert places[0] == 0
    assert 0 <= places[2] < 50
    assert not find_equal_readings(y, np.zeros(len(y), bool))[1].any()


def test_equal_readings_tell_together_what_one_of_them_tells():
    """The state of a plant at rest is known after n equal readings as after one."""
    integrator = ct.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]])
    at = cid.OperatingPoint(states=(0.0,), input=0.0, output=0.0)
    loop = cid.Loop(integrator, None, dt=0.1, at=at)
    loop = loop.with_effect(cid.effects.Quantization(step=1.0))
    y = np.repeat(np.arange(12.0), 10)
    record = cid.Record(u=np.zeros(len(y)), y=y, dt=0.1)
    with np.errstate(all="ignore"):
        fit = begin_fit(make_problem(loop, (), [record]), np.zeros(0), Noise((0.0,)))
    # Behind nine of ten equal readings nine tenths of one are known.
    first = fit.filtered[0].variance[9]
    spread = fit.data[0].spread[0, 0]
    assert first == pytest.approx(1 + 1 / (1 / spread + 9 / 10), rel=1e-6)
    assert fit.sensor[0] >= 1 / 12


def test_a_reading_that_hardly_changes_is_refused_in_words():
    y = np.repeat([0.0, 1.0, 0.0], 40)
    record = cid.Record(u=np.sin(np.arange(120.0)), y=STEP * y, dt=DT)
    loop = make_arm(cid.effects.Quantization(step=STEP))
    with pytest.raises(cid.CtrlidError, match="changes its reading only 2 times"):
        cid.fit_loop(loop, record)


def test_fit_of_an_encoder_has_white_innovations_and_honest_intervals():
    loop = make_arm(cid.effects.Quantization(step=STEP))
    away = []
    for seed in range(6):
        fit = cid.fit_loop(loop, simulate_arm(1500, seed=seed))
        assert fit.estimate.names == ("c", "mgl", "kt")
        assert not any("NOT WHITE" in note for note in fit.estimate.notes)
        truth = np.array([DAMPING, WEIGHT, TORQUE])
        errors = np.asarray(fit.estimate.standard_errors)
        away.append((np.array([fit.loop.parameters[n] for n in fit.estimate.names]) - truth)
                    / errors)  # fmt: skip
    # The root mean square of errors in standard errors is one, 18 of them to a sixth.
    assert 0.4 < np.sqrt(np.mean(np.square(away))) < 1.6


def test_nothing_is_missing_behind_an_encoder():
    found = cid.diagnose(make_arm(), simulate_arm(1200), progress=False)
    assert found.verdict == "nothing missing"
    assert found.noise.kind == "white"
    assert found.noise.size == pytest.approx(STEP / math.sqrt(12), rel=0.25)
    assert any("moves in steps" in line for line in found.audit)
    (converter,) = found.loop.effects
    assert isinstance(converter, cid.effects.Quantization)
    assert converter.step == pytest.approx(STEP)


@pytest.mark.parametrize(
    ("hidden", "name", "size"),
    [
        pytest.param({"friction": 0.04}, "CoulombFriction", 0.04 / J, marks=pytest.mark.slow),
        ({"lag": 0.012}, "ActuatorLag", 0.012),
    ],
)
def test_an_effect_is_named_behind_an_encoder(hidden, name, size):
    effects = cid.effects
    few = [effects.CoulombFriction, effects.ActuatorLag, effects.InputDeadZone,
           effects.QuadraticDrag, effects.ConstantForce]  # fmt: skip
    record = simulate_arm(1200, **hidden)
    found = cid.diagnose(make_arm(), record, catalogue=few, progress=False)
    assert found.verdict == "explained"
    (finding,) = found.findings
    assert finding.names[0] == name
    (value,) = finding.effect.values().values()
    assert value == pytest.approx(size, rel=0.03)


def test_steps_that_the_loop_lacks_are_said_with_what_to_type():
    cure = f"loop.with_effect(ctrlid.effects.Quantization(step={STEP:.6g}))"
    record, bare = simulate_arm(2000), make_arm()
    compared = cid.compare(record, bare)
    assert "SOMETHING IS MISSING" in compared.verdict
    assert f"steps of {STEP:.6g} rad" in compared.verdict
    assert compared.verdict.endswith(f"{cure}.")
    assert any(cure in note for note in cid.fit_loop(bare, record).estimate.notes)
    stepped = make_arm(cid.effects.Quantization(step=STEP))
    assert cid.compare(record, stepped).steps == ""
    assert not any("STEPS" in note for note in cid.fit_loop(stepped, record).estimate.notes)
    # Steps far below the noise are how numbers are written.
    assert cid.compare(simulate_arm(2000, noise=4 * STEP), bare).steps == ""


def test_the_share_of_the_noise_says_from_which_steps_on_a_word_is_due():
    assert THRESHOLD.coarse_steps == step_check.COARSE
    record = simulate_arm(600)
    for share in (0.2, 0.3):
        noise = STEP / math.sqrt(12 * share)
        told = step_check.describe_unstated_steps(make_arm(), record, noise)
        assert bool(told) == (share > step_check.COARSE)


def simulate_ball(law, seed, n=2500, step=6e-3):
    """A ball on a beam, exactly for a held angle, whose place is read in steps of 6 mm."""
    b, a = (np.ravel(part[0][0]) for part in (law.num, law.den))
    rng = np.random.default_rng(seed)
    r = 0.08 * np.repeat(rng.choice([-1.0, 1.0], n // 60 + 1), 60)[:n]
    x = v = angle = before = 0.0
    y, u = np.zeros(n), np.zeros(n)
    for k in range(n):
        y[k] = step * round((x + 5e-4 * rng.standard_normal()) / step)
        error = r[k] - y[k]
        angle = (b[0] * error + b[1] * before - a[1] * angle) / a[0]
        u[k], before = angle, error
        push = 0.714 * 9.81 * math.sin(angle) + 0.02 * rng.standard_normal()
        x, v = x + 0.02 * v + 0.5 * 0.02**2 * push, v + 0.02 * push
    return cid.Record(r=r, u=u, y=y, dt=0.02)


@pytest.mark.parametrize("seed", [1, 4])
def test_errors_that_differ_by_where_a_reading_sticks_differ_in_time(seed):
    plant = ct.nlsys(
        lambda t, x, u, p: np.array([x[1], p["s"] * 9.81 * np.sin(u[0])]),
        lambda t, x, u, p: x[0], inputs=["alpha"], outputs=["x"], states=["x", "v"],
        params={"s": 0.68}, name="beam",
    )  # fmt: skip
    at = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
    lead = cid.design_lead(cid.linearize(plant, at), crossover=3.0, phase_margin=50)
    law = lead.sample(0.02, "tustin")
    loop = cid.Loop(plant, law, dt=0.02, at=at, free=("s",))
    few = [cid.effects.CoulombFriction, cid.effects.SensorDrift]
    found = cid.diagnose(loop, simulate_ball(law, seed), catalogue=few, progress=False)
    assert found.verdict == "nothing missing", found.sentence
    assert found.loop.parameters["s"] == pytest.approx(0.714, rel=0.01)
