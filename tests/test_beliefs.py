"""How well a parameter is known beforehand: free={"K": 0.1}."""

import math
from dataclasses import replace

import control as ct
import numpy as np
import pytest

import ctrlid as cid
import ctrlid.effects as E

DT, N = 0.01, 1000
TRUE = {"m": 2.0, "c": 4.0, "k": 3.0}


def servo(free, **given):
    plant = cid.plants.servo(**{**TRUE, **given})
    return cid.Loop(plant, ct.tf([20.0], [1.0], DT), dt=DT, free=free)


@pytest.fixture(scope="module")
def record():
    r = cid.random_binary(N, amplitude=0.1, hold=40, seed=3)
    return cid.simulate(servo(()), r, sensor_noise=2e-3, seed=4)


def test_a_list_of_names_stays_what_it_was():
    assert servo(["k", "c"]).free == ("k", "c")
    assert servo("k").free == ("k",)
    assert "free: k (± 10 %), c" in repr(servo({"k": 0.1, "c": math.inf}))


@pytest.mark.parametrize(("free", "words"), [
    ({"k": "10 %"}, "given '10 %' for k"),
    ({"k": True}, "given True for k"),
    ({"k": -0.1}, "given -0.1 for k"),
    ({"k": math.nan}, "given nan for k"),
    ({"k": 0}, "leave out what is not free"),
    ({"q": 0.1}, r"names \['q'\]"),
])  # fmt: skip
def test_what_is_no_knowledge_is_refused(free, words, record):
    with pytest.raises(cid.CtrlidError, match=words):
        servo(free)
    with pytest.raises(cid.CtrlidError, match=f"{words}|free"):
        cid.fit_loop(servo(("k",)), record, free=free)


def test_a_share_of_zero_is_refused():
    with pytest.raises(cid.CtrlidError, match="zero in the loop"):
        servo({"c": 0.1}, c=0.0)
    assert list(servo({"c": math.inf}, c=0.0).free) == ["c"]


def test_data_and_belief_are_weighed_by_their_information(record):
    """Of Gaussian data and prior, information adds, and so do values times information."""
    plain = cid.fit_loop(servo(("k",)), record).estimate
    best, error = plain.values[0], plain.covariance[0, 0] ** 0.5
    given = best + 2 * error
    for size in (0.01, 0.5, 1.0, 2.0, 100.0):
        h, p = error**-2, (size * error) ** -2
        fitted = cid.fit_loop(servo({"k": size * error / given}, k=given), record).estimate
        middle = (h * best + p * given) / (h + p)
        assert fitted.values[0] == pytest.approx(middle, abs=0.05 * error)
        assert fitted.covariance[0, 0] == pytest.approx(1 / (h + p), rel=0.03)
    again = cid.fit_loop(servo((), k=2.7), record, free={"k": 1e-6})
    assert again.estimate.values[0] == pytest.approx(2.7, rel=1e-4)


def test_the_covariance_of_two_parameters(record):
    plain = cid.fit_loop(servo(("k", "c")), record).estimate
    deviation = 0.5 * plain.covariance[0, 0] ** 0.5
    both = cid.fit_loop(servo({"k": deviation / 3.0, "c": math.inf}), record).estimate
    wanted = np.linalg.inv(np.linalg.inv(plain.covariance) + np.diag([deviation**-2, 0.0]))
    np.testing.assert_allclose(both.covariance, wanted, rtol=0.05)


def test_an_unknown_that_the_record_does_not_tell_is_as_believed(record):
    """A mass and the gain of its input, of which the record sees the ratio."""
    plain = cid.fit_loop(servo(("m", "k", "c")), record).estimate
    assert any("DO NOT DETERMINE" in note for note in plain.notes)
    known = cid.fit_loop(servo({"m": 0.05, "k": math.inf, "c": math.inf}), record).estimate
    assert not any("DO NOT DETERMINE" in note for note in known.notes)
    error = known.covariance[0, 0] ** 0.5
    assert error == pytest.approx(0.05 * TRUE["m"], rel=0.02)
    assert known.values[0] == pytest.approx(TRUE["m"], rel=1e-3)


def test_a_diagnosis_holds_to_what_is_believed(record):
    """A gain that is known well is not bent to what is missing beside it."""
    real = servo(()).with_effect(E.CubicStiffness(300.0))
    other = cid.simulate(real, record.r, sensor_noise=2e-4, seed=5)
    tight = cid.diagnose(servo({"k": 1e-4, "c": 0.2}), other, progress=False,
                         catalogue=(E.CubicStiffness, E.CoulombFriction))  # fmt: skip
    assert [f.name for f in tight.findings] == ["CubicStiffness"]
    k = next(c for c in tight.calibrated if c.name == "k")
    assert k.before == pytest.approx(3.0, rel=1e-3)
    assert k.after == pytest.approx(3.0, rel=1e-3)
    assert k.standard_error < 3e-4


def test_knowledge_survives_a_file(record, tmp_path):
    loop = servo({"k": 0.1, "c": math.inf})
    found = cid.diagnose(loop, record, progress=False, catalogue=(E.CoulombFriction,))
    file = found.save(tmp_path / "found.json")
    assert cid.load_diagnosis(file).loop.free == {"k": 0.1, "c": math.inf}
    assert cid.load_diagnosis(file, loop=loop).loop.free == {"k": 0.1, "c": math.inf}
    with_force = replace(loop, free={"k": 0.1}).with_effect(E.ConstantForce(0.1))
    assert with_force.without_effect("ConstantForce").free == {"k": 0.1}
