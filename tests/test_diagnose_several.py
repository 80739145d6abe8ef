"""Diagnosis of a cart with a pole under an LQR with an observer, simulated by other means."""

import math
from dataclasses import replace

import control as ct
import numpy as np
import pytest
from scipy import linalg, stats

import ctrlid as cid
from ctrlid.diagnosis.fitted_model import Model
from ctrlid.diagnosis.gap import draw_noise
from ctrlid.diagnosis.records import add_steps, read_steps
from ctrlid.diagnosis.replicas import make_replica
from ctrlid.estimation.likelihood.kalman_filter import Noise, run_filter
from ctrlid.estimation.likelihood.likelihood import make_problem
from ctrlid.estimation.likelihood.maximization import begin_fit
from ctrlid.estimation.likelihood.tails import JointTails, Tails

M, POLE, LENGTH, INERTIA, G = 0.5, 0.2, 0.3, 0.006, 9.81
DAMPING, PIVOT, DT = 0.2, 0.002, 0.005
NOISE = np.array([1e-4, 5e-4])
FEW = [cid.effects.CoulombFriction, cid.effects.SensorOffset]
MORE = [*FEW, cid.effects.QuadraticDrag, cid.effects.LinearStiffness, cid.effects.InputDeadZone]


def accelerate(q, v, force, friction):
    """Accelerations of cart and pole, by the mass matrix, with friction of cart and pivot."""
    width = 1e-4
    push = [force - DAMPING * v[0] - friction[0] * math.tanh(v[0] / width),
            -PIVOT * v[1] - friction[1] * math.tanh(v[1] / width)]  # fmt: skip
    s, c = math.sin(q[1]), math.cos(q[1])
    a, b, d = M + POLE, -POLE * LENGTH * c, INERTIA + POLE * LENGTH**2
    x = push[0] - POLE * LENGTH * s * v[1] ** 2
    y = push[1] + POLE * G * LENGTH * s
    det = a * d - b * b
    return np.array([(d * x - b * y) / det, (a * y - b * x) / det])


def design():
    """Gain and observer of the plant linearized and sampled here."""
    a, b, d = M + POLE, -POLE * LENGTH, INERTIA + POLE * LENGTH**2
    inverse = np.linalg.inv([[a, b], [b, d]])
    A = np.zeros((4, 4))
    A[:2, 2:] = np.eye(2)
    A[2:, :2] = inverse @ np.diag([0.0, POLE * G * LENGTH])
    A[2:, 2:] = inverse @ np.diag([-DAMPING, -PIVOT])
    B = np.vstack([np.zeros((2, 1)), inverse[:, :1]])
    both = linalg.expm(DT * np.block([[A, B], [np.zeros((1, 5))]]))
    A, B = both[:4, :4], both[:4, 4:]
    C = np.eye(2, 4)
    P = linalg.solve_discrete_are(A, B, np.diag([20.0, 20, 1, 1]), np.eye(1))
    K = np.linalg.solve(1 + B.T @ P @ B, B.T @ P @ A)
    S = linalg.solve_discrete_are(A.T, C.T, B @ B.T, np.diag(NOISE**2) * 100)
    L = A @ S @ C.T @ np.linalg.inv(C @ S @ C.T + np.diag(NOISE**2) * 100)
    return A, B, C, K, L


def simulate(n, friction=(0.0, 0.0), seed=0, louder=None, step=0.0):
    """Two outputs and the input of the loop with dither, 20 Runge-Kutta steps in a period.

    The noise of each reading is `louder` times as large, shape (2, n); the encoder of the angle has
    steps.
    """
    sizes = NOISE[:, None] * (np.ones((2, n)) if louder is None else louder)
    A, B, C, K, L = design()
    rng = np.random.default_rng(seed)
    t = DT * np.arange(n)
    d = (
        0.8 * np.sin(2 * np.pi * 0.5 * t)
        + 0.8 * np.repeat(rng.choice([-1, 1], n // 40 + 1), 40)[:n]
    )
    q, v, z = np.zeros(2), np.zeros(2), np.zeros(4)
    ys, us = np.empty((2, n)), np.empty(n)
    h = DT / 20
    for k in range(n):
        ys[:, k] = q + sizes[:, k] * rng.standard_normal(2)
        ys[1, k] = step * np.round(ys[1, k] / step) if step else ys[1, k]
        us[k] = (-K @ z).item() + d[k]
        for _ in range(20):
            a1 = accelerate(q, v, us[k], friction)
            a2 = accelerate(q + h / 2 * v, v + h / 2 * a1, us[k], friction)
            q, v = q + h * v + h * h / 2 * a1, v + h * a2
        z = A @ z + B[:, 0] * us[k] + L @ (ys[:, k] - C @ z)
    return cid.Record(u=us, y=ys, dt=DT, names={"u": "F", "y": ("x", "theta")},
                      units={"u": "N", "y": ("m", "rad")})  # fmt: skip


def make_loop(free=("m", "c")):
    A, B, C, K, L = design()
    plant = cid.plants.cart_pole(M=M, m=POLE, length=LENGTH, J=INERTIA, c=DAMPING, gamma=PIVOT)
    controller = ct.ss(A - L @ C, np.hstack([L, B]), -K, np.zeros((1, 3)), DT,
                       inputs=["x", "theta", "F"], outputs=["F"])  # fmt: skip
    at = cid.operating_point(plant, output=[0.0, 0.0])
    return cid.Loop(plant, controller, dt=DT, at=at, free=free)


@pytest.fixture(scope="module")
def rubbing():
    return cid.diagnose(make_loop(), simulate(700, (0.4, 0.0), seed=1), catalogue=FEW,
                        progress=False)  # fmt: skip


def test_friction_at_the_cart_is_named_with_its_place(rubbing):
    first = rubbing.findings[0]
    assert (first.name, first.at) == ("CoulombFriction", "x_dot")
    assert first.effect.fc == pytest.approx(0.4, rel=0.05)
    assert rubbing.verdict == "explained"
    assert "CoulombFriction at x_dot" in str(rubbing)
    assert len(rubbing.findings) == 1


def test_the_gap_is_told_for_each_output(rubbing):
    gap = rubbing.gap
    assert [(g.output, g.unit) for g in gap.outputs] == [("x", "m"), ("theta", "rad")]
    assert gap.floor == pytest.approx(1.0, abs=0.3)
    for part in (gap, *gap.outputs):
        assert part.after < 1.5 * part.floor < part.before
    assert "noise floor, theta" in str(rubbing)
    assert [name for name, *_ in rubbing.noise.outputs] == ["x", "theta"]
    sizes = [size for _, size, _ in rubbing.noise.outputs]
    assert sizes == pytest.approx(NOISE, rel=0.15)


def test_candidates_stand_at_every_place(rubbing):
    tried = {(type(c.effect).__name__, c.effect.at) for c in rubbing.ranking}
    assert {("CoulombFriction", "x_dot"), ("CoulombFriction", "theta_dot"),
            ("SensorOffset", "theta")} <= tried  # fmt: skip


def test_saved_drawn_and_reported(rubbing, tmp_path):
    file = rubbing.save(tmp_path / "found.json")
    again = cid.load_diagnosis(file, loop=make_loop())
    assert str(again) == str(rubbing)
    assert again.gap.outputs[1].after == rubbing.gap.outputs[1].after
    axes = cid.plot.diagnosis(rubbing).axes
    assert len(axes) == 5
    kept = f"{len(rubbing.gap.time)} samples kept back"
    assert axes[1].get_xlabel().endswith(f"among {kept}")
    assert f"simulation of {kept}" in str(rubbing)
    cid.write_report(rubbing, tmp_path / "page.html")
    assert "CoulombFriction at x_dot" in (tmp_path / "page.html").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 12, 22])
def test_a_clean_draw_names_nothing(seed):
    found = cid.diagnose(make_loop(), simulate(1000, seed=seed), progress=False)
    assert found.verdict == "nothing missing"
    assert not found.findings


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 13])
def test_friction_at_the_cart_is_named_of_all_effects(seed):
    found = cid.diagnose(make_loop(), simulate(1200, (0.4, 0.0), seed=seed), progress=False)
    assert any(f.names[0] == "CoulombFriction at x_dot" for f in found.findings)


@pytest.mark.slow
def test_friction_at_the_pivot_is_not_blamed_on_the_cart():
    loop = replace(make_loop(), controller=None)
    found = cid.diagnose(loop, simulate(1000, (0.0, 0.02), seed=3), catalogue=MORE, progress=False)
    assert (found.findings[0].name, found.findings[0].at) == ("CoulombFriction", "theta_dot")
    assert found.gap.kind == "prediction"


def make_wild(n, output, seed):
    """One reading of a hundred of one output errs ten times as much as the others."""
    louder = np.ones((2, n))
    louder[output] = np.where(np.random.default_rng([seed, 9]).random(n) < 0.01, 10.0, 1.0)
    return louder


def list_wild_shares(found):
    return [share for _, share, _ in found.noise.tails]


@pytest.mark.parametrize("output", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_wild_readings_of_one_output_are_its_noise(output, tmp_path):
    record = simulate(800, seed=1, louder=make_wild(800, output, 1))
    found = cid.diagnose(make_loop(), record, catalogue=FEW, progress=False)
    assert found.verdict == "nothing missing"
    shares = list_wild_shares(found)
    assert 0.003 < shares[output] < 0.03
    assert shares[1 - output] == 0
    assert math.isinf(found.noise.tails[1 - output][0])
    assert found.noise.outputs[1 - output][1] == pytest.approx(NOISE[1 - output], rel=0.1)
    name = found.noise.outputs[output][0]
    assert found.noise.kind == "heavy-tailed"
    assert f"RMS at {name} (" in str(found.noise)
    again = cid.load_diagnosis(found.save(tmp_path / "found.json"))
    assert again.noise == found.noise


@pytest.mark.slow
def test_friction_is_named_at_its_place_beside_wild_readings():
    record = simulate(800, (0.4, 0.0), seed=1, louder=make_wild(800, 1, 1))
    found = cid.diagnose(make_loop(), record, catalogue=FEW, progress=False)
    (first,) = found.findings
    assert (first.name, first.at) == ("CoulombFriction", "x_dot")
    assert first.effect.fc == pytest.approx(0.4, rel=0.02)
    assert found.verdict == "explained"
    assert list_wild_shares(found)[0] == 0 < list_wild_shares(found)[1]


@pytest.mark.slow
def test_readings_that_err_for_a_while_are_no_heavy_tails():
    louder = np.ones((2, 800))
    louder[1, 300:360] = 8.0
    found = cid.diagnose(make_loop(), simulate(800, seed=1, louder=louder), catalogue=FEW,
                         progress=False)  # fmt: skip
    assert found.noise.kind == "white"
    assert found.verdict in ("unknown", "partly explained")


STEP = 3e-3  # What an encoder of 2048 counts in a turn shows.


def simulate_encoder(n, friction, seed):
    """The noise of the angle is far below the step of its encoder."""
    return simulate(n, friction, seed, louder=np.array([[1.0], [0.2]]) * np.ones((2, n)), step=STEP)


@pytest.fixture(scope="module")
def on_encoder():
    return [
        # Names and steps are asked of it, no simulation, which takes longest beside friction.
        cid.diagnose(replace(make_loop(), controller=None) if fc else make_loop(),
                     simulate_encoder(500, (fc, 0.0), seed=1),
                     catalogue=[*FEW, cid.effects.Quantization], progress=False)
        for fc in (0.0, 0.4)
    ]  # fmt: skip


def test_the_steps_of_an_encoder_are_neither_finding_nor_alarm(on_encoder):
    for found, verdict in zip(on_encoder, ("nothing missing", "explained"), strict=True):
        assert found.verdict == verdict
        assert found.noise.outputs[1][1] == pytest.approx(STEP / math.sqrt(12), rel=0.25)
        (remark,) = (line for line in found.audit if line.startswith("converter: "))
        assert "theta moves in steps of 0.003 rad" in remark
        everything = (*found.findings, *found.stand_ins)
        assert "Quantization" not in [f.name for f in everything]
        assert "Quantization" not in [type(c.effect).__name__ for c in found.ranking]
        # What is simulated with the completed loop has the steps of the record.
        assert found.loop.labelled["Quantization"].step == pytest.approx(STEP)


def test_friction_is_named_at_its_place_beside_an_encoder(on_encoder):
    clean, rubs = on_encoder
    assert not clean.findings
    (first,) = rubs.findings
    assert (first.name, first.at) == ("CoulombFriction", "x_dot")
    assert first.effect.fc == pytest.approx(0.4, rel=0.02)


def test_the_steps_of_an_encoder_are_read_off_whatever_is_in_the_catalogue():
    record = simulate_encoder(500, (0.0, 0.0), seed=1)
    found = cid.diagnose(make_loop(), record, catalogue=FEW, progress=False)
    assert found.verdict == "nothing missing"


def test_the_steps_of_each_output_are_taken_off_its_noise():
    record = simulate_encoder(300, (0.0, 0.0), seed=1)
    loop = make_loop(free=())
    noise = Noise((1e2, 1e2), sensors=(75.0,))
    fit = replace(begin_fit(make_problem(loop, (), [record]), np.zeros(0), noise),
                  sensor=np.array([1e-8]))  # fmt: skip
    (read,) = read_steps(fit, [cid.audit(record, loop)])
    assert (read.effect.at, read.effect.step) == ("theta", pytest.approx(STEP))
    stepped = add_steps(loop, [read])
    assert stepped.effects == (read.effect,)
    assert add_steps(stepped, [read]) is stepped
    fit = begin_fit(make_problem(stepped, (), [record]), np.zeros(0), noise)
    # The reading of the angle errs no less than it is rounded.
    assert fit.sensor[0] * 75 >= STEP**2 / 12 * (1 - 1e-12)
    model = Model(stepped, replace(fit, sensor=np.array([STEP**2 / 12 / 75])))
    x, theta = (np.std(v) for v in draw_noise(model.fit, float(model.fit.sensor[0]), 4000, 1)[0])
    assert x == pytest.approx(STEP / math.sqrt(12 * 75), rel=0.05)
    assert theta == pytest.approx(math.sqrt(1e-3 / 12) * STEP, rel=0.05)
    x, theta = make_replica(model).records[0].y
    np.testing.assert_allclose(np.round(theta / STEP), theta / STEP, atol=1e-6)
    assert np.ptp(np.diff(np.unique(x))) > 0


def test_the_law_of_several_outputs_is_that_of_each():
    wild, student = Tails(share=0.02, ratio=8.0), Tails(freedom=3.0)
    rng = np.random.default_rng(0)
    z = rng.standard_normal((500, 3)) * [1.0, 4.0, 2.0]
    joint = JointTails((wild, None, student))
    for k, law in enumerate((wild, student)):
        np.testing.assert_array_equal(joint.compute_weight(z)[:, 2 * k],
                                      law.compute_weight(z[:, 2 * k]))  # fmt: skip
        np.testing.assert_array_equal(joint.normalize(z)[:, 2 * k], law.normalize(z[:, 2 * k]))
    np.testing.assert_array_equal(joint.normalize(z)[:, 1], z[:, 1])
    keep = rng.random((500, 3)) < 0.7
    density = np.column_stack([
        wild.compute_log_density(z[:, 0]), stats.norm.logpdf(z[:, 1]),
        student.compute_log_density(z[:, 2]),
    ])  # fmt: skip
    part = joint.choose(keep)
    np.testing.assert_allclose(part.compute_log_density(z[keep]), density[keep])
    squares = (3.0 * np.column_stack([
        np.where(rng.random(20_000) < 0.02, 8.0, 1.0) * rng.standard_normal(20_000),
        rng.standard_normal(20_000), rng.standard_t(3, 20_000),
    ])) ** 2  # fmt: skip
    every = joint.choose(np.ones(squares.shape, dtype=bool))
    assert every.find_scale(squares.ravel(), 1.0) == pytest.approx(9.0, rel=0.03)
    assert joint.reorder([2, 0, 1]).each == (student, wild, None)


def test_the_filter_passes_over_a_wild_reading_of_one_output_alone():
    record = simulate(400, seed=1)
    problem = make_problem(make_loop(free=()), (), [record])
    plain = Noise((1e2, 1e2), sensors=(25.0,))
    fit = begin_fit(problem, np.zeros(0), plain)
    data, lin = problem.data[0], fit.linearized[0]
    law = JointTails((None, Tails(share=0.01, ratio=10.0)), scale=1e-8)
    for output, factor in ((0, 1.0), (1, 0.05)):
        y = data.y.copy()
        y[200, output] += 100 * NOISE[output]
        shifted = replace(data, y=y)
        moved = [
            run_filter(fit.plant, shifted, lin, noise).trajectory.filtered[200]
            - run_filter(fit.plant, data, lin, noise).trajectory.filtered[200]
            for noise in (plain, replace(plain, tails=law))
        ]
        assert np.max(np.abs(moved[0])) > 0
        ratio = np.linalg.norm(moved[1]) / np.linalg.norm(moved[0])
        assert ratio == pytest.approx(1.0, abs=0.05) if factor == 1.0 else ratio < factor


def test_a_window_is_predicted_that_a_filter_loses_from_its_first_guess():
    record = simulate(1000, (0.0, 0.02), seed=3)[550:1000]
    loop = replace(make_loop(free=()), controller=None)
    loop = loop.with_parameters({"m": 0.19987930886855268, "c": 0.1998788443107679})
    rubs = cid.effects.CoulombFriction(fc=0.02054333058745406, at="theta_dot")
    innovations = cid.predict(loop.with_effect(rubs), record).innovations
    assert (np.std(innovations[:, 20:], axis=1) < 1.2 * NOISE).all()
