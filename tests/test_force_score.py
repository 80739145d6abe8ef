"""The filter run backwards: the score of a force in each period, against forward sensitivities."""

from dataclasses import replace

import numpy as np
import pytest

import ctrlid as cid
from ctrlid import effects as E
from ctrlid.diagnosis.recalibration import fit_base_model
from ctrlid.diagnosis.scans import ModelSight, scan_candidate
from ctrlid.diagnosis.shape_scores import score_shapes
from ctrlid.effects import force
from ctrlid.effects.scanning import make_waves
from ctrlid.estimation.likelihood.force_score import compute_force_scores
from ctrlid.estimation.likelihood.likelihood import make_problem
from ctrlid.estimation.likelihood.maximization import begin_fit, choose_tails, maximize
from ctrlid.estimation.likelihood.noise.orders import try_coloured_force, try_coloured_sensor
from problems import levitation
from test_several_outputs import swinging

KINDS = {
    "white": lambda fit: fit, "coloured force": try_coloured_force,
    "coloured sensor": try_coloured_sensor, "heavy tails": choose_tails,
}  # fmt: skip


def record_with_gap(seed, n=900):
    r = cid.random_binary(n, amplitude=1e-4, hold=40, around=0.012, seed=seed)
    record = cid.simulate(levitation(), r, sensor_noise=2e-6, force_noise=0.05, seed=seed)
    rng = np.random.default_rng(seed)
    y = record.y + np.where(rng.random(n) < 0.01, 3e-5, 0.0) * rng.standard_normal(n)
    valid = np.ones(n, dtype=bool)
    valid[300:304] = False
    return replace(record, y=y, valid=valid)


def shapes_of(lengths, columns=5):
    rng = np.random.default_rng(3)
    slow = [np.sin(0.02 * np.arange(n))[:, None] for n in lengths]
    return [rng.standard_normal((n, columns)) + s for n, s in zip(lengths, slow, strict=True)]


def sum_scores(scores, shapes):
    return sum(f.T @ lam for f, lam in zip(shapes, scores, strict=True))


def score_forwards(fit, shapes, at=""):
    """Scores and information of shapes, by the sensitivities of a pass for each."""
    gains, sizes = score_shapes(fit, shapes, at=at)
    scores = 2 * gains / sizes[:, 0]
    return scores, scores / sizes[:, 0]


@pytest.mark.parametrize("kind", KINDS)
def test_backwards_is_forwards_beside_every_noise_gaps_and_two_records(kind):
    records = [record_with_gap(1), record_with_gap(2, n=700)]
    fit = maximize(begin_fit(make_problem(levitation(), ("K",), records)))
    fit = KINDS[kind](fit)
    shapes = shapes_of([900, 700])
    expected, _ = score_forwards(fit, shapes)
    found = sum_scores(compute_force_scores(fit), shapes)[:, 0]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("coloured", [False, True])
def test_backwards_is_forwards_with_several_outputs(coloured):
    loop, record = swinging(n=600)
    name = next(iter(loop.equations().parameters))
    fit = begin_fit(make_problem(loop, (name,), [record]))
    if coloured:
        fit = try_coloured_force(fit)
    shapes = shapes_of([600])
    places = [loop.equations().states[k] for k in fit.plant.e.velocities]
    for channel, at in enumerate(places):
        expected, _ = score_forwards(fit, shapes, at)
        found = sum_scores(compute_force_scores(fit, channel=channel), shapes)[:, 0]
        np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_draws_have_the_information_as_their_variance():
    fit = maximize(begin_fit(make_problem(levitation(), ("K",), [record_with_gap(1)])))
    shapes = shapes_of([900])
    _, information = score_forwards(fit, shapes)
    draws = 2000
    drawn = sum_scores(compute_force_scores(fit, draws), shapes)[:, 1:]
    # The variance of as many draws errs by 3 % on average.
    np.testing.assert_allclose(np.mean(drawn**2, axis=1), information, rtol=5 * np.sqrt(2 / draws))


@pytest.mark.parametrize(("period", "n"), [(1.8e-4, 4000), (3e-4, 1500)])
def test_the_waves_that_are_looked_at_closely_hold_the_best_of_all(period, n):
    hidden = E.PositionRipple(amplitude=0.1, period=period, phase=1.0)
    r = cid.random_binary(n, amplitude=2e-4, hold=40, around=0.012, seed=4)
    record = cid.simulate(levitation(hidden), r, sensor_noise=2e-6, seed=5)
    base = fit_base_model(levitation(), [record], ("K",))
    sight = ModelSight(base)
    (start,) = E.PositionRipple.candidates(base.fitted, record)
    positions, travel = sight.positions(), sight.travel
    numbers = np.arange(force.FEWEST_WAVES / travel, force.LENGTHS / travel, 0.25 / travel)
    waves = [make_waves(2 * np.pi * np.outer(w, numbers)) for w in positions]
    gains, _ = sight.score_shapes(waves, width=2)
    trial = scan_candidate(base, start)
    assert 1 / trial.effect.period == pytest.approx(numbers[np.argmax(gains)], rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("share", "named"), [(0.75, False), (0.25, True)])
def test_a_wave_that_the_motion_spans_once_is_no_ripple(share, named):
    # A longer period on the same way is any smooth curve of the position, as of a magnet.
    r = cid.random_binary(1500, amplitude=2e-4, hold=40, around=0.012, seed=6)
    bare = cid.simulate(levitation(), r, sensor_noise=2e-6, seed=7)
    hidden = E.PositionRipple(amplitude=0.3, period=share * float(np.ptp(bare.y)), phase=1.0)
    record = cid.simulate(levitation(hidden), r, sensor_noise=2e-6, seed=7)
    model = replace(levitation(), free=("K",))
    found = cid.diagnose(model, record, catalogue=(E.PositionRipple,), progress=False)
    assert [f.name for f in found.findings] == (["PositionRipple"] if named else [])
    assert found.verdict == ("explained" if named else "unknown")
