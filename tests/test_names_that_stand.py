"""Names that stand, and what only describes part of a record."""

from dataclasses import replace
from types import SimpleNamespace

import control as ct
import numpy as np
import pytest

import ctrlid as cid
import ctrlid.effects as E
from ctrlid.diagnosis.constancy import _estimate_alone, compare_stretches
from ctrlid.diagnosis.grounds import (
    Case,
    is_at_a_limit,
    is_one_of_several,
    is_phase_locked,
    narrows_no_gap,
    was_not_checked,
)
from ctrlid.diagnosis.recalibration import fit_base_model, recalibrate
from ctrlid.reporting.tables import make_blocks

DT, N = 0.01, 2000
M, C, K = 2.0, 4.0, 3.0


def steps(seed, hold=50):
    """A random telegraph of 0.1 m."""
    rng = np.random.default_rng(seed)
    return 0.1 * np.repeat(rng.choice([-1.0, 1.0], N // hold), hold)


def simulate_mass(r, force, noise=1e-4, seed=1, kp=20.0, damping=C, step=0.0):
    """A mass with damping in a loop, by small steps of the midpoint rule."""
    rng = np.random.default_rng(seed)
    x = v = 0.0
    y, u = np.empty(len(r)), np.empty(len(r))
    fine = 20
    h = DT / fine
    for k in range(len(r)):
        y[k] = x + noise * rng.standard_normal()
        y[k] = step * np.round(y[k] / step) if step else y[k]
        u[k] = kp * (r[k] - y[k])
        for i in range(fine):
            t, push = k * DT + (i + 0.5) * h, K * u[k] / M
            middle = v + h / 2 * (push - damping * v / M + force(t, x, v))
            x += h * middle
            v += h * (push - damping * middle / M + force(t, x, middle))
    return cid.Record(dt=DT, r=r, u=u, y=y)


def mass(free=("c", "k"), c=C):
    return cid.Loop(cid.plants.servo(M, c, K), ct.tf([20.0], [1.0], DT), dt=DT, free=free)


def rub(v, size=0.5):
    return -size * np.tanh(v / 1e-3)


@pytest.fixture(scope="module")
def half():
    """A cubic spring that is half as stiff again in the first half of the record."""
    end = N * DT / 2
    record = simulate_mass(steps(3), lambda t, x, v: -(300 if t < end else 200) * x**3)
    return cid.diagnose(mass(), record, catalogue=(E.CubicStiffness,), progress=False)


def test_a_size_that_differs_between_stretches_is_a_stand_in(half):
    assert half.verdict == "unknown"
    assert half.findings == ()
    assert [f.name for f in half.stand_ins] == ["CubicStiffness"]
    assert "differs between stretches" in half.stand_ins[0].note
    assert "does not stand" in half.sentence
    assert "CubicStiffness" in repr(half)


def test_a_size_that_differs_by_little_is_one_size():
    """With little noise a record tells sizes apart that differ by a fiftieth."""
    end = N * DT / 2
    record = simulate_mass(steps(3), lambda t, x, v: -(253 if t < end else 247) * x**3)
    found = cid.diagnose(mass(), record, catalogue=(E.CubicStiffness,), progress=False)
    assert [f.name for f in found.findings] == ["CubicStiffness"]
    fit = fit_base_model(
        mass().with_effect(E.CubicStiffness(k3=250.0)), [record], ("CubicStiffness.k3",)
    ).fit
    assert compare_stretches(fit, "CubicStiffness.k3") < 0.01
    assert compare_stretches(fit, "CubicStiffness.k3", 12.0) > 0.1


def test_a_limit_is_as_large_as_its_value():
    """It is infinitely far from the limit that has no effect, which is no size to compare with."""
    plant = cid.plants.servo(m=1.0, c=2.0, k=3.0)
    loop = cid.Loop(plant, cid.PID(kp=20.0, kd=1.0), dt=0.01, free=("k", "c"))
    r = cid.random_binary(1200, amplitude=0.1, hold=50, seed=1)
    real = loop.with_effect(E.InputSaturation(-1.5, 1.5))
    record = cid.simulate(real, r, sensor_noise=1e-4, seed=2)
    found = cid.diagnose(loop, record, catalogue=(E.InputSaturation,), progress=False)
    assert [f.name for f in found.findings] == ["InputSaturation"]
    assert found.findings[0].effect.upper == pytest.approx(1.5, rel=0.01)


def test_stand_ins_have_a_section_of_their_own(half, tmp_path):
    text = str(half)
    assert "what is missing" not in text
    assert "what only describes part of the record" in text
    assert "THE NAME DOES NOT STAND" in text
    blocks = [str(block) for block in make_blocks(half)]
    assert any("What only describes part of the record" in block for block in blocks)
    back = cid.load_diagnosis(half.save(tmp_path / "half.json"))
    assert str(back) == text
    assert [f.name for f in back.stand_ins] == ["CubicStiffness"]
    labels = [line.get_label() for line in cid.plot.diagnosis(half)[0].get_lines()]
    assert any("CubicStiffness" in label for label in labels)


@pytest.mark.slow
def test_friction_all_along_stands():
    record = simulate_mass(steps(4), lambda t, x, v: rub(v))
    found = cid.diagnose(mass(), record, catalogue=(E.CoulombFriction,), progress=False)
    assert [f.name for f in found.findings] == ["CoulombFriction"]
    assert found.stand_ins == ()


@pytest.mark.slow
def test_what_is_beside_a_parameter_at_its_limit_is_a_stand_in():
    record = simulate_mass(steps(5), lambda t, x, v: rub(v), damping=30 * C)
    found = cid.diagnose(mass(), record, catalogue=(E.CoulombFriction,), progress=False)
    assert found.findings == ()
    assert found.stand_ins
    for f in found.stand_ins:
        assert "c went to its limit" in f.note


def test_a_constant_force_that_cancels_weight_is_a_stand_in():
    plant = cid.plants.maglev(m=0.0213, K=3.34e-6, g=9.81)
    at = cid.operating_point(plant, output=0.012)
    law = cid.PID(kp=-800.0, kd=-10.0, bias=at.input)
    loop = cid.Loop(plant, law, dt=0.001, at=at, free=("K",))
    r = 0.012 + cid.random_binary(N, amplitude=4e-4, hold=60, seed=2)
    less, more = (loop.with_effect(E.ConstantForce(b)) for b in (-7.0, -3.0))
    for real, stands in ((less, False), (more, True)):
        rest = cid.operating_point(real.system(), output=0.012)
        real = replace(real, at=rest, controller=replace(law, bias=rest.input))
        record = cid.simulate(real, r, sensor_noise=1e-6, seed=3)
        given = replace(loop, controller=replace(law, bias=rest.input))
        found = cid.diagnose(given, record, catalogue=(E.ConstantForce,), progress=False)
        assert bool(found.findings) == stands
        assert bool(found.stand_ins) != stands
    assert "cancels a known constant force" not in found.sentence


def test_a_line_of_the_reference_has_a_locked_phase():
    t = np.arange(N) * DT
    quiet = np.zeros(N)

    def record(r):
        return cid.Record(dt=DT, u=quiet, y=quiet, r=r)

    sine = record(0.1 * np.sin(2 * np.pi * 1.7 * t + 0.3))
    assert is_phase_locked(sine, 1.7)
    assert not is_phase_locked(sine, 7.3)
    # A random telegraph has power everywhere, of random phase.
    assert sum(is_phase_locked(record(steps(seed)), 0.9) for seed in range(40)) <= 2
    # Steps that repeat have lines at the multiples of one over their period.
    again = record(np.tile(steps(1)[: N // 8], 8))
    assert is_phase_locked(again, 3 / (N / 8 * DT))
    # Lines may be close to each other, and a fitted frequency is not exact.
    lines = (0.9, 1.7, 2.6)
    several = record(sum(np.sin(2 * np.pi * f * t + f) for f in lines))
    for f in lines:
        assert is_phase_locked(several, f + 0.2 / (N * DT))
    assert not is_phase_locked(several, 1.3)


def test_a_line_at_a_frequency_of_the_reference_is_a_stand_in():
    t = np.arange(N) * DT
    r = 0.1 * np.sin(2 * np.pi * 1.5 * t)
    for own, stands in ((1.5, False), (4.1, True)):
        record = simulate_mass(r, lambda t, x, v, own=own: 0.3 * np.sin(2 * np.pi * own * t + 1.0))
        found = cid.diagnose(mass(()), record, catalogue=(E.PeriodicForce,), progress=False)
        assert bool(found.findings) == stands
        assert bool(found.stand_ins) != stands


def test_a_wrong_model_names_what_fresh_data_like(half):
    def narrows(before, after, explained):
        gap = replace(half.gap, before=before, after=after)
        return narrows_no_gap(Case(mass(), None, (), {}, gap, explained), None)

    assert "do not narrow the gap" in narrows(40e-6, 53e-6, explained=False)
    assert "do not narrow the gap" in narrows(40e-6, 39.5e-6, explained=False)
    assert not narrows(40e-6, 30e-6, explained=False)
    # A small effect that leaves noise alone needs no wider gap to be seen.
    assert not narrows(40e-6, 40e-6, explained=True)
    assert narrows(np.inf, np.inf, explained=False)


def test_several_of_a_kind_in_a_wrong_model_only_describe_it():
    ripple = E.PositionRipple(amplitude=0.1, period=0.01, phase=0.0)
    loop = mass()
    for effect in (ripple, replace(ripple, period=0.02), E.LinearStiffness(k1=3.0)):
        loop = loop.with_effect(effect)

    def judge(position, explained, given=None):
        case = Case(given or mass(), SimpleNamespace(fitted=loop), (), {}, None, explained)
        return is_one_of_several(case, SimpleNamespace(position=position))

    assert "of the same kind" in judge(0, explained=False)
    assert "of the same kind" in judge(1, explained=False)
    assert not judge(2, explained=False)
    assert not judge(0, explained=True)
    # What the model had from the beginning is known.
    assert not judge(1, explained=False, given=mass().with_effect(ripple))


def test_a_small_effect_of_a_search_that_was_stopped_was_not_checked():
    def judge(gain, explained=False, finished=False):
        case = Case(mass(), None, (), {}, None, explained, gained=1000.0, finished=finished)
        return was_not_checked(case, SimpleNamespace(trial=SimpleNamespace(gain=gain)))

    assert "was stopped before" in judge(gain=100.0)
    assert not judge(gain=400.0)
    # Where only noise is left nothing else is missing, and a search that ended has asked.
    assert not judge(gain=100.0, explained=True)
    assert not judge(gain=100.0, finished=True)


def test_the_steps_of_a_converter_are_a_remark():
    record = simulate_mass(steps(6), lambda t, x, v: 0.0, noise=1e-4, step=5e-4)
    found = cid.diagnose(mass(), record, progress=False)
    assert "Quantization" not in [f.name for f in (*found.findings, *found.stand_ins)]
    # The loop has them, so that it simulates what the record shows.
    assert [type(effect).__name__ for effect in found.loop.effects] == ["Quantization"]
    assert any(remark.startswith("converter: ") for remark in found.audit)


def test_estimates_of_stretches_scatter_as_they_say():
    """The variance of a stretch's estimate, against white and correlated errors."""
    rng = np.random.default_rng(7)
    for memory in (0.0, 0.6):
        z = []
        for _ in range(300):
            x = rng.standard_normal((400, 3)).cumsum(axis=0) / 10
            e = rng.standard_normal(440)
            for k in range(1, len(e)):
                e[k] += memory * e[k - 1]
            move, variance = _estimate_alone(x, e[40:], 1)
            z.append(move / variance**0.5)
        assert 0.7 < np.std(z) < 1.3
    assert _estimate_alone(np.zeros((50, 2)), np.ones(50), 0) == (0.0, 0.0)


def test_a_limit_within_chance_of_the_given_value_is_none():
    """Sixty noisy samples say next to nothing of a damping, which ends at ten times the given."""
    loop = mass(c=0.05)
    excused = 0
    for seed in range(5):
        record = simulate_mass(steps(seed)[:60], lambda t, x, v: 0.0, noise=0.02, seed=seed)
        model = recalibrate(loop, [record], [cid.audit(record)])
        at_limit = model.fit.theta[model.names.index("c")] in (0.005, 0.5)
        if not at_limit:
            continue
        errors = dict.fromkeys(model.names, 0.0)
        case = SimpleNamespace(
            given=loop, final=model, errors=errors,
            read_effect=lambda f: ("ConstantForce", E.ConstantForce(0.1)),
        )  # fmt: skip
        doubt = model.fit.standard_errors[model.names.index("c")]
        moved = abs(model.fit.theta[model.names.index("c")] - 0.05)
        assert bool(is_at_a_limit(case, None)) == (moved > 2 * doubt)
        excused += moved <= 2 * doubt
    assert excused
