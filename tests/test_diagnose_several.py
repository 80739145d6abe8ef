"""Diagnosis of a cart with a pole under an LQR with an observer, simulated by other means."""

import math
from dataclasses import replace

import control as ct
import numpy as np
import pytest
from scipy import linalg

import ctrlid as cid

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


def simulate(n, friction=(0.0, 0.0), seed=0):
    """Two outputs and the input of the loop with dither, 20 Runge-Kutta steps in a period."""
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
        ys[:, k] = q + NOISE * rng.standard_normal(2)
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
    assert len(cid.plot.diagnosis(rubbing).axes) == 5
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
