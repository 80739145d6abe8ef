"""IdentifiedModel and Estimate: a transfer function that knows how well it is known."""

from __future__ import annotations

import copy
import pickle
import warnings

import control
import numpy as np
import pytest

from ctrlid._base import text as _text
from ctrlid._base.errors import CtrlidError
from ctrlid.estimation.identified_model import ActiveBound, Estimate, IdentifiedModel, Structure


def estimate(values=(-1.9, 0.85, 0.2, 0.1), covariance=None, **changes):
    values = np.array(values, dtype=float)
    fields = {
        "structure": Structure(2, len(values) - 2),
        "values": values,
        "covariance": np.diag([1e-4, 4e-4, 1e-6, 0.0]) if covariance is None else covariance,
        "intercepts": np.array([0.5]),
        "rss": 1.0,
        "residual_variance": 0.01,
        "n_samples": 100,
        "degrees_of_freedom": 95,
        "method": "least squares (ARX)",
        "solver": "orthogonal least squares",
        "dt": 0.01,
        "condition": 3.0,
    }
    return Estimate(**{**fields, **changes})


def test_is_a_transfer_function():
    model = IdentifiedModel(estimate(), inputs="V", outputs="x")
    assert isinstance(model, control.TransferFunction)
    assert model.dt == 0.01
    assert (model.input_labels, model.output_labels) == (["V"], ["x"])
    assert model.name == "identified"
    np.testing.assert_array_equal(model.den[0][0], [1.0, -1.9, 0.85])
    np.testing.assert_array_equal(model.num[0][0], [0.2, 0.1])


@pytest.mark.parametrize(
    "duplicate",
    [copy.copy, copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m)), lambda m: m.copy()],
    ids=["copy", "deepcopy", "pickle", "control"],
)
def test_copies_keep_the_estimate(duplicate):
    model = IdentifiedModel(estimate(), inputs="V", outputs="x")
    other = duplicate(model)
    assert isinstance(other, IdentifiedModel)
    assert other.estimate["a1"] == -1.9
    assert other.input_labels == ["V"]
    assert str(other.estimate) == str(model.estimate)


def test_arithmetic_gives_plain_transfer_functions():
    model = IdentifiedModel(estimate())
    for result in (2 * model, model * model, -model, model + 1, 1 / model, model.feedback(1)):
        assert type(result) is control.TransferFunction
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        control.ss(model)
        control.frequency_response(model, [1.0, 10.0])


def test_arrays_are_read_only():
    e = estimate()
    for array in (e.values, e.covariance, e.intercepts):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_names_and_lookup():
    e = estimate()
    assert e.names == ("a1", "a2", "b1", "b2")
    assert e["b2"] == 0.1
    with pytest.raises(CtrlidError, match="No coefficient 'b3': this model has a1, a2, b1, b2"):
        e["b3"]


def test_confidence_interval():
    e = estimate()
    low, high = e.confidence_interval("a1")
    assert (low + high) / 2 == pytest.approx(-1.9)
    assert (high - low) / 2 == pytest.approx(1.9853 * 0.01, rel=1e-4)
    assert e.confidence_interval("b2", 0.5) == (0.1, 0.1)
    for level in (0.0, 1.0, 95, float("nan")):
        with pytest.raises(CtrlidError, match="lies between 0 and 1"):
            e.confidence_interval("a1", level)


@pytest.mark.parametrize("nk", [0, 1, 4])
def test_fraction_has_the_delay(nk):
    structure = Structure(2, 2, nk)
    num, den = structure.fraction(np.array([-1.5, 0.7, 2.0, 3.0]))
    z = 1.3 * np.exp(0.4j)
    wanted = z**-nk * (2 + 3 / z) / (1 - 1.5 / z + 0.7 / z**2)
    assert np.polyval(num, z) / np.polyval(den, z) == pytest.approx(wanted)


def test_poles_near_one_are_accurate():
    step = 1e-4
    e = estimate([-2 * np.cosh(step), 1.0, 1.0, 1.0], dt=1e-6)
    assert np.max(e.poles_s.real) == pytest.approx(step / 1e-6, rel=1e-7)
    merged = estimate([-2.0, 1.0, 1.0, 1.0], covariance=np.zeros((4, 4)))
    np.testing.assert_array_equal(merged.poles, [1.0, 1.0])
    np.testing.assert_array_equal(merged.poles_standard_errors, [0.0, 0.0])


def test_pole_errors_by_the_delta_method():
    covariance = np.array([[2.0, -1.0, 0, 0], [-1, 3, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) * 1e-8
    rng = np.random.default_rng(0)
    for values in ([-1.7, 0.72, 1, 1], [-1.2, 0.72, 1, 1]):
        e = estimate(values, covariance)
        draws = rng.multivariate_normal(values, covariance, 4000)
        scatter = np.array([np.sort_complex(np.roots([1, *d[:2]])) for d in draws])
        wanted = np.sqrt(np.mean(np.abs(scatter - scatter.mean(axis=0)) ** 2, axis=0))
        order = np.argsort(e.poles.real + 1e-9 * e.poles.imag)
        np.testing.assert_allclose(e.poles_standard_errors[order], wanted, rtol=0.05)
        s_errors = e.poles_standard_errors / np.abs(e.poles) / e.dt
        np.testing.assert_allclose(e.poles_s_standard_errors, s_errors)


def test_a_double_pole_has_no_first_order_error():
    e = estimate([-2.0, 1.0, 1.0, 1.0])
    assert np.isinf(e.poles_standard_errors).all()
    assert "± inf" in str(e)


def test_continuous_model():
    e = estimate(
        [0.0, -1600.0, -5.0],
        np.diag([0.0, 16.0, 0.01]),
        structure=Structure(2, 1, domain="s"),
        dt=0,
    )
    model = IdentifiedModel(e)
    assert model.isctime()
    np.testing.assert_array_equal(model.den[0][0], [1.0, 0.0, -1600.0])
    np.testing.assert_allclose(np.sort(e.poles_s.real), [-40.0, 40.0])
    # p = sqrt(alpha), dp = d alpha / (2 p)
    np.testing.assert_allclose(e.poles_s_standard_errors, [0.05, 0.05])
    assert "pole at s = 40.000 ± 0.050 rad/s" in str(e)
    assert "dt =" not in str(e)
    stable = estimate(
        [3.0, 2.0, 1.0], np.zeros((3, 3)), structure=Structure(2, 1, domain="s"), dt=0
    )
    assert "no pole is in the right half plane: the model is stable." in str(stable)


GOLDEN = """\
constrained least squares (ARX), 100 samples used, dt = 0.01 s
  a1 = -2 (on its bound)
  a2 = 1 (fixed)
  b1 = (2.000 ± 0.010)e-05
  b2 = 0.100 ± 0.010
  branch of the constraint: a1 <= -2
  pole at z = 1 (fixed), s = 0 (fixed) rad/s
  pole at z = 1 (fixed), s = 0 (fixed) rad/s
  equation error: standard deviation 0.1
  solved by orthogonal least squares
  active bounds: a1 <= -2 [ReciprocalPoles()]
  a1 IS ON ITS BOUND -2. Without ReciprocalPoles() the estimate would be -1.95. \
An active bound is a symptom of bias, not a result: check for noise fed back through the \
controller, a sampling period that is too short, or a constraint that does not hold.
  TWO POLES COINCIDE at z = 1.
  NO POLE OUTSIDE THE UNIT CIRCLE."""


def test_report_in_full():
    bound = ActiveBound("a1 <= -2", "ReciprocalPoles()", "a1", -2.0, -1.95, unstable=True)
    e = estimate(
        [-2.0, 1.0, 2e-5, 0.1],
        np.diag([0.0, 0.0, 1e-14, 1e-4]),
        method="constrained least squares (ARX)",
        errors="equation error",
        branch="a1 <= -2",
        active_bounds=(bound,),
    )
    assert str(e) == GOLDEN
    assert str(IdentifiedModel(e)).endswith(GOLDEN)
    assert "z^2 - 2 z + 1" in str(IdentifiedModel(e))
    assert e.active == ("a1 <= -2 [ReciprocalPoles()]",)


def test_report_without_bad_news():
    text = str(estimate([-2.5, 1.0, 0.2, 0.1]))
    assert "active bounds: none" in text
    assert text.splitlines()[-1].startswith("  active bounds")


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (12.3456, 0.12, "12.35 ± 0.12"),
        (12345678.0, 1200.0, "(1.23457 ± 0.00012)e+07"),
        (0.0, 0.05, "0.000 ± 0.050"),
        (0.5 + 0.25j, 0.01, "0.500+0.250j ± 0.010"),
        (1.0, np.inf, "1 ± inf"),
        (3.0, 0.0, "3 (fixed)"),
        (1.5, 2e-15, "1.500000000000 ± 2.0e-15"),
    ],
)
def test_numbers_have_the_digits_their_error_allows(value, error, text):
    assert _text.with_error(value, error) == text


def test_complex_numbers():
    assert _text.write_number(1 - 0.5j) == "1-0.5j"
    assert _text.write_number(2.0) == "2"


def test_listing():
    assert [_text.write_list(x) for x in ([], ["a"], ["a", "b"], ["a", "b", "c"])] == [
        "", "a", "a and b", "a, b and c",
    ]  # fmt: skip
