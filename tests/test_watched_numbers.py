"""Numbers that reckon with their half and double notice every decision that would flip."""

import math
import operator
from collections import Counter

import numpy as np
import pytest

import problems
from ctrlid import effects as E
from ctrlid.diagnosis.recalibration import fit_base_model
from ctrlid.diagnosis.replicas import make_replica
from ctrlid.diagnosis.thresholds import THRESHOLD
from problems import load_script

watched = load_script("benchmarks", "watched_numbers")

DECISIONS = {
    "product": lambda w: operator.gt(3.0, w * 4.0),
    "sum": lambda w: np.float64(1.8) <= 1.0 + w,
    "array": lambda w: np.array([0.2, 0.9]) > w,
    "array of limits": lambda w: w * np.array([1.0, 4.0]) < 3.5,
    "quotient": lambda w: w / 0.5 < 1.5,
    "power": lambda w: operator.lt(0.3, w**2),
    "difference": lambda w: (1 - w) * 10 >= 4,
    "negative": lambda w: -w < -0.4,
    "both sides": lambda w: w * 2 < w + 0.7,
}


@pytest.mark.parametrize("decide", DECISIONS.values(), ids=DECISIONS)
@pytest.mark.parametrize("value", [0.1, 0.3, 0.5, 0.8, 1.3, 5.0])
def test_a_decision_that_half_or_twice_would_flip_is_noted_and_no_other(decide, value):
    noted = Counter()
    number = watched.Watched(value, {"n": (value / 2, value * 2)}, noted)
    plain = decide(value)
    assert np.array_equal(decide(number), plain)
    assert bool(noted) == any(np.any(decide(value * f) != plain) for f in (0.5, 2))


def test_two_numbers_in_one_decision_are_told_apart():
    noted = Counter()
    a = watched.Watched(1.0, {"a": (0.5, 2.0)}, noted)
    b = watched.Watched(10.0, {"b": (5.0, 20.0)}, noted)
    assert a * b < 12.0
    assert noted == {"a": 1, "b": 1}
    noted.clear()
    assert a + b < 19.0
    assert noted == {"b": 1}


def test_what_leaves_python_is_noted_as_such():
    noted = Counter()
    number = watched.Watched(3, {"n": (2, 6)}, noted)
    assert math.log(number) == math.log(3)
    assert len(list(range(10))[:number]) == 3
    assert noted == {"n, left Python": 2}


def test_the_table_is_watched_within_the_block_only():
    before = THRESHOLD.table()
    with watched.watch_numbers() as noted:
        assert operator.lt(1.2, THRESHOLD.excess)
        assert THRESHOLD.excess < 100.0
        assert isinstance(THRESHOLD.gate, float)
    assert noted == {"excess": 1}
    assert THRESHOLD.table() == before
    assert set(watched.list_judged_numbers()) == {t.name for t in before if t.kind == "study"}


def test_a_number_that_enters_formulas_leaves_python_and_says_so():
    """Replicas have sharper friction, by a number that the formulas of the effects are told."""
    loop = problems.drive().with_effect(E.CoulombFriction(0.2))
    record = problems.record_of(loop, swing=0.3, hold=60, n=600, seed=8, sensor_noise=1e-4)
    model = fit_base_model(loop, [record], loop.free)
    with watched.watch_numbers() as noted:
        assert make_replica(model, 1) is not None
    assert noted["replica_sharpness, left Python"] > 0
