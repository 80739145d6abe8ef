"""fit_arx: exact recovery, constraints against independent solutions, coverage, refusals."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import qpsolvers
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from ctrlid._base.errors import CtrlidError
from ctrlid.data.record import Record
from ctrlid.estimation.constraints import (
    AbstractConstraint,
    Bounds,
    Branch,
    Equal,
    Fixed,
    Integrator,
    Linear,
    Nonlinear,
    PoleAt,
    ReciprocalPoles,
    StaticGain,
    SymmetricPoles,
    equals,
)
from ctrlid.estimation.linear.arx import fit_arx
from ctrlid.estimation.linear.regression import (
    build_arx_regression,
    count_equations,
    list_structures,
)

DT = 1e-3


def maglev(step, beta=3.0, dt=DT):
    """Coefficients of -beta/(s^2 - p^2) under a zero-order hold, step = p*dt."""
    b = -2.0 * beta * (dt / step) ** 2 * np.sinh(step / 2) ** 2
    return np.array([-2.0 * np.cosh(step), 1.0, b, b])


def run(theta, controller, reference, noise=None, equation_error=None, order=2):
    """Short recursion: A y = B u + e under D u = N (r - y), with noise on the measured y."""
    a, b = np.r_[1.0, theta[:order]], np.r_[0.0, theta[order:]]
    numerator, denominator = controller
    n = len(reference)
    y, measured, u = np.zeros(n), np.zeros(n), np.zeros(n)
    noise = np.zeros(n) if noise is None else noise
    equation_error = np.zeros(n) if equation_error is None else equation_error
    for k in range(n):
        y[k] = equation_error[k]
        for i in range(1, min(k, order) + 1):
            y[k] += b[i] * u[k - i] - a[i] * y[k - i]
        measured[k] = y[k] + noise[k]
        for i in range(min(k, len(numerator) - 1) + 1):
            u[k] += numerator[i] * (reference[k - i] - measured[k - i])
        for i in range(1, min(k, len(denominator) - 1) + 1):
            u[k] -= denominator[i] * u[k - i]
    return u, measured


def place(a, b, pole):
    """Controller of order len(a) - 2 that puts all closed-loop poles in one place."""
    order = len(a) - 1
    size = 2 * order
    m = np.zeros((size, size))
    for i in range(order):
        m[i : i + order + 1, i] = a
        m[i : i + order + 1, order + i] = np.r_[0.0, b]
    x = np.linalg.solve(m, np.poly(np.full(size - 1, pole)))
    return x[order:] / x[0], x[:order] / x[0]


def binary(n, step, seed):
    hold = max(1, int(0.5 / step))
    levels = np.random.default_rng(seed).choice([-1.0, 1.0], n // hold + 1)
    return np.repeat(levels, hold)[:n]


def sampled_levitation(step, n=4000, seed=0, sensor_noise=0.0, offset=(0.0, 0.0)):
    """Record of a maglev under a digital lead; a random binary reference."""
    theta = maglev(step)
    lead = place(np.r_[1.0, theta[:2]], theta[2:], np.exp(-1.2 * step))
    r = binary(n, step, seed)
    noise = sensor_noise * np.random.default_rng(seed + 1).standard_normal(n)
    u, y = run(theta, lead, r, noise)
    record = Record(r=r + offset[0], u=u + offset[1], y=y + offset[0], dt=DT)
    return theta, record


def open_loop(theta, n, seed, scale=1.0, order=2):
    """Record of a stable difference equation with white equation error."""
    rng = np.random.default_rng(seed)
    u, e = rng.standard_normal(n), scale * rng.standard_normal(n)
    a, b = theta[:order], theta[order:]
    y = np.zeros(n)
    for k in range(order, n):
        y[k] = -a @ y[k - order : k][::-1] + b @ u[k - len(b) : k][::-1] + e[k]
    return Record(r=None, u=u, y=y, dt=DT)


def matrix(record, na=2, nb=2, intercept=True):
    """Build the plain regression, in the coefficients themselves."""
    y, u = record.y, record.u
    first = max(na, nb)
    n = len(y)
    columns = [-y[first - i : n - i] for i in range(1, na + 1)]
    columns += [u[first - i : n - i] for i in range(1, nb + 1)]
    columns += [np.ones(n - first)] * intercept
    return np.column_stack(columns), y[first:]


# -- exact recovery ------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [0.5, 0.22, 0.044, 0.02, 0.005])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (100.0, 1000.0)], ids=["deviations", "offset"])
@pytest.mark.parametrize(
    "constraints",
    [[], [ReciprocalPoles()], [SymmetricPoles(), Equal("b1", "b2")]],
    ids=["free", "reciprocal", "zoh"],
)
def test_recovers_the_plant_exactly_without_noise(step, offset, constraints):
    theta, record = sampled_levitation(step, offset=offset)
    estimate = fit_arx(record, na=2, nb=2, constraints=constraints).estimate
    np.testing.assert_allclose(estimate.values, theta, rtol=1e-8)
    p = step / DT
    np.testing.assert_allclose(np.sort(estimate.poles_s.real), [-p, p], rtol=1e-8)
    assert np.all(estimate.poles_s.imag == 0)
    if constraints:
        assert estimate["a2"] == 1.0
        assert estimate.branch.startswith("a1 <= -2")
        assert estimate.active == ()
    if len(constraints) == 2:
        assert estimate["b1"] == estimate["b2"]


@settings(max_examples=25, deadline=None)
@given(
    gap=st.floats(5e-3, 20e-3),
    voltage=st.floats(1.0, 10.0),
    step=st.floats(0.005, 0.5),
    constrained=st.booleans(),
)
def test_recovers_any_levitation_in_physical_units(gap, voltage, step, constrained):
    """alpha = 2 g / x0, beta = 2 g / V0; signals are absolute, the set-point moves by 1 %."""
    p, beta = np.sqrt(2 * 9.81 / gap), 2 * 9.81 / voltage
    theta = maglev(step, beta, step / p)
    lead = place(np.r_[1.0, theta[:2]], theta[2:], np.exp(-1.2 * step))
    u, y = run(theta, lead, 0.01 * gap * binary(2000, step, 5))
    record = Record(u=u + voltage, y=y + gap, dt=step / p)
    known = [ReciprocalPoles()] if constrained else []
    estimate = fit_arx(record, na=2, nb=2, constraints=known).estimate
    np.testing.assert_allclose(estimate.values, theta, rtol=1e-8)
    np.testing.assert_allclose(np.sort(estimate.poles_s.real), [-p, p], rtol=1e-8)


@pytest.mark.parametrize("step", [0.22, 0.044, 0.005])
def test_recovers_a_reciprocal_pair_among_three_poles(step):
    z = np.exp(step)
    a = np.poly([z, 1 / z, np.exp(-3 * step)])
    theta = np.r_[a[1:], np.array([1.0, 3.0, 0.8]) * step**3]
    controller = place(a, theta[3:], np.exp(-1.5 * step))
    r = binary(5000, step, 2)
    u, y = run(theta, controller, r, order=3)
    record = Record(r=r, u=u, y=y, dt=DT)
    estimate = fit_arx(record, na=3, nb=3, constraints=[ReciprocalPoles()]).estimate
    # Third differences at p*Ts = 0.005 keep some nine digits of the data.
    np.testing.assert_allclose(estimate.values, theta, rtol=1e-8)
    pair = np.sort(estimate.poles.real)[1:]
    # Three coefficients rounded at 1e-15 move poles that lie p*Ts apart.
    assert pair[0] * pair[1] == pytest.approx(1.0, abs=1e-15 / step**2)
    assert estimate.branch.startswith("reciprocal pair at z = 1.")


def test_condition_number_is_small_at_every_sampling_period():
    conditions = [
        fit_arx(sampled_levitation(step)[1], na=2, nb=2).estimate.condition
        for step in (0.5, 0.22, 0.044, 0.005)
    ]
    assert max(conditions) < 10


@settings(max_examples=20, deadline=None)
@given(y=st.sampled_from([1e-6, 1e-4, 1e-2, 1e3]), u=st.sampled_from([1e-5, 1.0, 1e4]))
def test_units_change_nothing_but_units(y, u):
    _, record = sampled_levitation(0.1, n=600, sensor_noise=0.02)
    scaled = replace(record, y=record.y * y, u=record.u * u, r=None)
    constraints = [ReciprocalPoles(), Bounds("b1", upper=0.0)]
    one = fit_arx(record, na=2, nb=2, constraints=constraints).estimate
    other = fit_arx(scaled, na=2, nb=2, constraints=constraints).estimate
    expected = one.values * np.array([1, 1, y / u, y / u])
    np.testing.assert_allclose(other.values, expected, rtol=1e-9, atol=1e-12 * y / u)
    assert other.active == one.active
    assert other.condition == pytest.approx(one.condition, rel=1e-6)


def test_delay_and_direct_feedthrough():
    rng = np.random.default_rng(3)
    u = np.r_[np.zeros(5), rng.standard_normal(295)]
    for nk in (0, 1, 3):
        y = np.zeros(300)
        for k in range(5, 300):
            y[k] = 0.7 * y[k - 1] + 0.4 * u[k - nk] - 0.3 * u[k - nk - 1]
        model = fit_arx(Record(r=None, u=u, y=y, dt=DT), na=1, nb=2, nk=nk)
        np.testing.assert_allclose(model.estimate.values, [-0.7, 0.4, -0.3], rtol=1e-10)
        z = np.exp(0.3j)
        wanted = z**-nk * (0.4 - 0.3 / z) / (1 - 0.7 / z)
        assert model(z) == pytest.approx(wanted, rel=1e-9)


# -- constrained solutions against independent ones ----------------------------------------------


@pytest.mark.parametrize("step", [0.5, 0.1, 0.044])
def test_least_squares_agrees_with_lstsq(step):
    _, record = sampled_levitation(step, sensor_noise=0.1)
    estimate = fit_arx(record, na=2, nb=2).estimate
    a, b = matrix(record)
    wanted, rss, _, _ = np.linalg.lstsq(a, b, rcond=None)
    np.testing.assert_allclose(estimate.values, wanted[:4], rtol=1e-7)
    assert estimate.intercepts[0] == pytest.approx(wanted[4], rel=1e-6)
    assert estimate.rss == pytest.approx(rss[0], rel=1e-9)
    sigma2 = rss[0] / (len(b) - 5)
    wanted_cov = sigma2 * np.linalg.inv(a.T @ a)[:4, :4]
    np.testing.assert_allclose(estimate.covariance, wanted_cov, rtol=1e-5)


def test_equalities_agree_with_direct_elimination():
    _, record = sampled_levitation(0.22, sensor_noise=0.1)
    estimate = fit_arx(
        record, na=2, nb=2, constraints=[Fixed("a2", 1.0), Equal("b1", "b2")]
    ).estimate
    a, b = matrix(record)
    reduced = np.column_stack([a[:, 0], a[:, 2] + a[:, 3], a[:, 4]])
    wanted, rss, _, _ = np.linalg.lstsq(reduced, b - a[:, 1], rcond=None)
    np.testing.assert_allclose(estimate.values[[0, 2]], wanted[:2], rtol=1e-9)
    assert estimate["a2"] == 1.0
    assert estimate["b1"] == estimate["b2"]
    cov = rss[0] / (len(b) - 3) * np.linalg.inv(reduced.T @ reduced)
    np.testing.assert_allclose(
        estimate.standard_errors, np.sqrt([cov[0, 0], 0, cov[1, 1], cov[1, 1]]), rtol=1e-7
    )
    assert estimate.degrees_of_freedom == len(b) - 3


@pytest.mark.parametrize("seed", range(6))
def test_inequalities_agree_with_daqp(seed):
    rng = np.random.default_rng(seed)
    record = open_loop(np.array([-1.5, 0.7, 1.0, 0.5]), 300, seed)
    constraints = [
        Bounds("a1", lower=-1.45),
        Bounds("b1", upper=0.9 + 0.2 * rng.standard_normal()),
        Linear({"a1": 1, "a2": 1}, upper=-0.82),
        Linear({"b1": 1, "b2": -1}, lower=0.55, upper=0.6),
    ]
    estimate = fit_arx(record, na=2, nb=2, constraints=constraints).estimate
    a, b = matrix(record)
    a, b = a[:, :4] - a[:, :4].mean(axis=0), b - b.mean()
    rows = np.array([[-1, 0, 0, 0], [0, 0, 1, 0], [1, 1, 0, 0], [0, 0, 1, -1], [0, 0, -1, 1.0]])
    bounds = np.array([1.45, constraints[1].upper, -0.82, 0.6, -0.55])
    wanted = qpsolvers.solve_qp(a.T @ a, -a.T @ b, rows, bounds, solver="daqp")
    np.testing.assert_allclose(estimate.values, wanted, rtol=1e-7)
    on_bound = np.abs(rows @ estimate.values - bounds) < 1e-9
    assert len(estimate.active) == on_bound.sum() > 0


def test_the_cheaper_branch_wins():
    # Poles at -1.1 and -1/1.1: the other alternative of the paper's |a1| > 2.
    theta = np.array([1.1 + 1 / 1.1, 1.0, 0.3, -0.2])
    controller = place(np.r_[1.0, theta[:2]], theta[2:], 0.2)
    u, y = run(theta, controller, binary(500, 0.5, 1))
    estimate = fit_arx(
        Record(r=None, u=u, y=y, dt=DT), 2, 2, constraints=[ReciprocalPoles()]
    ).estimate
    assert estimate.branch == "a1 >= 2"
    np.testing.assert_allclose(estimate.values, theta, rtol=1e-9)
    # A sampled pair s = ±p has positive z: here that fact does not hold, and the bound says so.
    symmetric = fit_arx(Record(r=None, u=u, y=y, dt=DT), 2, 2, constraints=[SymmetricPoles()])
    assert symmetric.estimate["a1"] == -2.0


def test_active_bound_is_exact_and_in_capitals():
    _, record = sampled_levitation(0.044, sensor_noise=0.1)
    plain = fit_arx(record, na=2, nb=2)
    assert np.all(np.abs(plain.estimate.poles) < 1)
    assert "no pole is outside the unit circle: the model is stable" in str(plain)
    model = fit_arx(record, na=2, nb=2, constraints=[ReciprocalPoles()])
    estimate = model.estimate
    assert estimate["a1"] == -2.0
    assert estimate["a2"] == 1.0
    assert estimate.active == ("a1 <= -2 [ReciprocalPoles()]",)
    assert estimate.standard_errors[0] == 0.0
    assert estimate.active_bounds[0].free > -2.0
    text = str(model)
    for words in (
        "a1 = -2 (on its bound)",
        "a2 = 1 (fixed)",
        "a1 IS ON ITS BOUND -2. Without ReciprocalPoles() the estimate would be -1.9",
        "symptom of bias, not a result",
        "TWO POLES COINCIDE at z = 1",
    ):
        assert words in text
    # The exact point satisfies the optimality conditions of the full problem: see test_qp.


@pytest.mark.parametrize(
    ("constraint", "linear"),
    [
        (Nonlinear(equality=lambda t: t[1] - 1), Fixed("a2", 1.0)),
        (Nonlinear(equality=lambda t: t[2] - t[3]), Equal("b1", "b2")),
        (Nonlinear(inequality=lambda t: -1.99 - t[0]), Bounds("a1", upper=-1.99)),
        (
            Nonlinear(equality=lambda t: t[1] - 1, inequality=lambda t: abs(t[0]) - 2),
            ReciprocalPoles(),
        ),
    ],
)
def test_nonlinear_agrees_with_linear_where_it_is_linear(constraint, linear):
    _, record = sampled_levitation(0.22, sensor_noise=0.1)
    one = fit_arx(record, 2, 2, constraints=[constraint]).estimate
    other = fit_arx(record, 2, 2, constraints=[linear]).estimate
    np.testing.assert_allclose(one.values, other.values, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-4, atol=1e-12)
    assert len(one.active) == len(other.active)


def test_nonlinear_curved_constraint_is_optimal():
    """On the circle a1^2 + a2^2 = c the gradient of the cost is radial."""
    _, record = sampled_levitation(0.22, sensor_noise=0.1)
    radius2 = 4.9
    known = Nonlinear(equality=lambda t: t[0] ** 2 + t[1] ** 2 - radius2)
    estimate = fit_arx(record, 2, 2, constraints=[known]).estimate
    assert estimate["a1"] ** 2 + estimate["a2"] ** 2 == pytest.approx(radius2, abs=1e-10)
    a, b = matrix(record)
    gradient = a.T @ (a @ np.r_[estimate.values, estimate.intercepts] - b)
    radial = np.array([estimate["a1"], estimate["a2"]])
    along = gradient[0] * radial[1] - gradient[1] * radial[0]
    size = np.linalg.norm(a, axis=0) * np.linalg.norm(b)
    assert abs(along) < 1e-8 * size[0]
    assert np.all(np.abs(gradient[2:]) < 1e-8 * size[2:])
    # No point of a dense scan of the circle is cheaper.
    reduced = np.linalg.qr(np.column_stack([a[:, 2:], a[:, :2], b]), mode="r")[3:, 3:]
    angle = np.linspace(0, 2 * np.pi, 20001)
    circle = np.sqrt(radius2) * np.vstack([np.cos(angle), np.sin(angle)])
    costs = np.sum((reduced[:, :2] @ circle - reduced[:, 2:]) ** 2, axis=0)
    assert estimate.rss <= costs.min() * (1 + 1e-9)


def test_a_constraint_of_ones_own():
    class HalfGain(AbstractConstraint):
        def __repr__(self):
            return "HalfGain()"

        def branches(self, structure):
            return [Branch([equals({"b1": 1.0, "b2": -2.0}, 0.0)], label="half")]

    _, record = sampled_levitation(0.22)
    estimate = fit_arx(record, 2, 2, constraints=[HalfGain()]).estimate
    assert estimate["b1"] == 2 * estimate["b2"]
    assert estimate.branch == "half"
    with pytest.raises(CtrlidError, match=r"contradict each other: .*, HalfGain\(\) and"):
        fit_arx(
            record, 2, 2, constraints=[Fixed("b1", 1.0), HalfGain(), Fixed("b2", 1.0), PoleAt(0.1)]
        )


def test_known_facts_hold_in_the_model():
    record = open_loop(np.array([-1.2, 0.5, 1.0, 0.5]), 500, 4)
    static = fit_arx(record, 2, 2, constraints=[StaticGain(4.0)])
    assert static.dcgain() == pytest.approx(4.0, rel=1e-12)
    integrating = fit_arx(record, 2, 2, constraints=[Integrator()])
    assert np.min(np.abs(integrating.estimate.poles - 1.0)) < 1e-14
    complex_pole = 0.6 + 0.3j
    poles = fit_arx(record, 2, 2, constraints=[PoleAt(complex_pole)]).estimate.poles
    np.testing.assert_allclose(np.sort_complex(poles), [0.6 - 0.3j, 0.6 + 0.3j], rtol=1e-12)


# -- records -------------------------------------------------------------------------------------


def test_invalid_samples_leave_no_trace():
    _, record = sampled_levitation(0.1, n=1500, sensor_noise=0.05)
    y, u = record.y.copy(), record.u.copy()
    valid = np.ones(len(y), dtype=bool)
    for hole in (slice(100, 130), slice(700, 701), slice(1490, 1500)):
        valid[hole] = False
        y[hole] = 1e6
        u[hole] = -3.0
    masked = replace(record, y=y, u=u, valid=valid)
    estimate = fit_arx(masked, 2, 2).estimate
    a, b = matrix(record)
    ok = valid[2:] & valid[1:-1] & valid[:-2]
    wanted = np.linalg.lstsq(a[ok], b[ok], rcond=None)[0]
    np.testing.assert_allclose(estimate.values, wanted[:4], rtol=1e-7)
    assert estimate.n_samples == ok.sum()


def test_several_records_share_coefficients_but_not_intercepts():
    theta, one = sampled_levitation(0.1, n=900, offset=(5.0, 2.0))
    _, two = sampled_levitation(0.1, n=700, seed=7, offset=(-3.0, 40.0))
    estimate = fit_arx([one, two], 2, 2).estimate
    np.testing.assert_allclose(estimate.values, theta, rtol=1e-8)
    # c = A(1) y0 - B(1) u0
    a1, b1 = 1 + theta[:2].sum(), theta[2:].sum()
    wanted = [a1 * 5.0 - b1 * 2.0, -a1 * 3.0 - b1 * 40.0]
    np.testing.assert_allclose(estimate.intercepts, wanted, rtol=1e-7)
    # No row across the joint: n - 2 of each.
    assert estimate.n_samples == 898 + 698
    assert estimate.degrees_of_freedom == 898 + 698 - 4 - 2


def test_without_intercept():
    theta, record = sampled_levitation(0.22)
    estimate = fit_arx(record, 2, 2, intercept=False).estimate
    np.testing.assert_allclose(estimate.values, theta, rtol=1e-9)
    assert estimate.intercepts.shape == (0,)
    _, biased = sampled_levitation(0.22, offset=(1.0, 0.0))
    wrong = fit_arx(biased, 2, 2, intercept=False).estimate
    assert np.max(np.abs(wrong.values / theta - 1)) > 1e-3


def test_names_come_from_the_record():
    _, record = sampled_levitation(0.22)
    model = fit_arx(record, 2, 2)
    assert (model.input_labels, model.output_labels) == (["u"], ["y"])
    model = fit_arx(replace(record, names={"u": "V", "y": "gap"}), 2, 2)
    assert (model.input_labels, model.output_labels) == (["V"], ["gap"])
    assert model.dt == DT


def test_memory_does_not_grow_with_the_record():
    n = 1_000_000
    rng = np.random.default_rng(0)
    y, u = np.cumsum(rng.standard_normal(n)), rng.standard_normal(n)
    valid = np.ones(n, dtype=bool)
    valid[1000:1010] = False
    record = Record(r=None, u=u, y=y, dt=DT, valid=valid)
    fit_arx(record, 2, 2)
    tracemalloc.start()
    fit_arx(record, 2, 2, constraints=[ReciprocalPoles()])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10e6


# -- standard errors -----------------------------------------------------------------------------


@pytest.mark.parametrize("constraints", [[], [Fixed("a2", 0.7)]], ids=["free", "a2 known"])
def test_intervals_cover_the_truth(constraints):
    """95 % intervals of genuinely ARX data cover 93-97 % in a thousand runs."""
    theta = np.array([-1.5, 0.7, 1.0, 0.5])
    runs, n = 1000, 200
    rng = np.random.default_rng(11)
    u, e = rng.standard_normal((n, runs)), 0.3 * rng.standard_normal((n, runs))
    y = np.zeros((n, runs))
    for k in range(2, n):
        past = theta[2] * u[k - 1] + theta[3] * u[k - 2]
        y[k] = past - theta[0] * y[k - 1] - theta[1] * y[k - 2] + e[k]
    poles = np.sort_complex(np.roots(np.r_[1, theta[:2]]))
    covered = np.zeros(4)
    for i in range(runs):
        record = Record(r=None, u=u[:, i], y=y[:, i], dt=DT)
        estimate = fit_arx(record, 2, 2, constraints=constraints).estimate
        for j, name in enumerate(estimate.names):
            low, high = estimate.confidence_interval(name)
            covered[j] += low <= theta[j] <= high
    free = [j for j in range(4) if not (constraints and j == 1)]
    assert np.all((covered[free] > 930) & (covered[free] < 970)), covered
    assert poles.imag.any()


def test_pole_errors_follow_from_coefficients():
    """The delta method agrees with the scatter of the poles over many runs."""
    theta = np.array([-1.5, 0.54, 1.0, 0.5])  # poles 0.9 and 0.6
    found, errors = [], []
    for seed in range(200):
        estimate = fit_arx(open_loop(theta, 400, seed, 0.1), 2, 2).estimate
        order = np.argsort(estimate.poles.real)
        found.append(estimate.poles.real[order])
        errors.append(estimate.poles_standard_errors[order])
    np.testing.assert_allclose(np.mean(errors, axis=0), np.std(found, axis=0), rtol=0.15)
    s = estimate.poles_s_standard_errors * np.abs(estimate.poles) * DT
    np.testing.assert_allclose(s, estimate.poles_standard_errors)


# -- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("orders", "words"),
    [
        ((0, 2, 1), "na must be an integer of at least 1; given 0"),
        ((2, 0, 1), "nb must be an integer of at least 1; given 0"),
        ((2, 2.0, 1), "nb must be an integer of at least 1; given 2.0"),
        ((2, 2, -1), "nk must be an integer of at least 0; given -1"),
        ((True, 2, 1), "na must be an integer of at least 1; given True"),
    ],
)
def test_bad_orders_are_refused(orders, words):
    _, record = sampled_levitation(0.22, n=50)
    with pytest.raises(CtrlidError, match=words):
        fit_arx(record, *orders)


def test_too_few_samples_are_refused():
    _, record = sampled_levitation(0.22, n=7)
    with pytest.raises(CtrlidError, match="Too few samples: 5 equations for 5 unknowns"):
        fit_arx(record, 2, 2)
    _, short = sampled_levitation(0.22, n=3)
    with pytest.raises(CtrlidError, match="Record 2 of 2 gives no equation"):
        fit_arx([record, short], 2, 3)
    nothing = replace(record, valid=np.zeros(7, dtype=bool))
    with pytest.raises(CtrlidError, match="gives no equation"):
        fit_arx(nothing, 2, 2)


def test_different_sampling_periods_are_refused():
    _, record = sampled_levitation(0.22, n=100)
    with pytest.raises(CtrlidError, match="need the same sampling period"):
        fit_arx([record, replace(record, dt=0.002)], 2, 2)


@pytest.mark.parametrize(
    ("u", "y", "words"),
    [
        (lambda u, y: u * 0 + 3.3, lambda u, y: y, "u is constant"),
        (lambda u, y: u, lambda u, y: y * 0 + 0.012, "y is constant"),
        (lambda u, y: -3.0 * y, lambda u, y: y, "a1, a2, b1 and b2 can change together"),
    ],
    ids=["u", "y", "static feedback"],
)
def test_what_is_not_excited_is_named(u, y, words):
    _, record = sampled_levitation(0.22, n=500, sensor_noise=0.1)
    still = replace(record, u=u(record.u, record.y), y=y(record.u, record.y), r=None)
    with pytest.raises(CtrlidError, match=words) as refusal:
        fit_arx(still, 2, 2)
    assert "do not determine the coefficients" in str(refusal.value)
    assert "reference" in str(refusal.value)


def test_orders_beyond_the_plant_are_not_excited_without_noise():
    _, record = sampled_levitation(0.22)
    with pytest.raises(CtrlidError, match="orders are higher than those of the plant"):
        fit_arx(record, 3, 3)


@pytest.mark.parametrize(
    ("constraints", "words"),
    [
        ([StaticGain(2.0), Integrator()], r"StaticGain\(2.0\) and Integrator\(\)"),
        (
            [Equal("b1", "b2"), ReciprocalPoles(), Fixed("a2", 0.9)],
            r"contradict each other: ReciprocalPoles\(\) and Fixed\(\"a2\", 0.9\)",
        ),
        ([Fixed("c1", 2.0)], "no such coefficient; it has a1, a2, b1, b2"),
        ("ReciprocalPoles", "must be a list of constraint objects"),
    ],
)
def test_unusable_constraints_are_refused_by_name(constraints, words):
    _, record = sampled_levitation(0.22, n=200)
    with pytest.raises(CtrlidError, match=words):
        fit_arx(record, 2, 2, constraints=constraints)


def test_a_constraint_can_stand_in_for_excitation():
    _, record = sampled_levitation(0.22, n=500, sensor_noise=0.1)
    still = replace(record, u=np.full(500, 3.3), r=None)
    estimate = fit_arx(still, 2, 2, constraints=[Fixed("b1", 0.0), Fixed("b2", 0.0)]).estimate
    assert estimate["b1"] == estimate["b2"] == 0.0


def test_an_input_that_is_not_held_is_said_in_capitals():
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal(300), rng.standard_normal(300)
    held = fit_arx(Record(u=u, y=y, dt=0.1), 1, 1).estimate
    smooth = fit_arx(Record(u=u, y=y, dt=0.1, hold="foh"), 1, 1).estimate
    assert held.notes == ()
    assert "u CHANGES BETWEEN THE SAMPLES (hold='foh'" in str(smooth)
    slow = Record(u=np.sin(np.arange(300) / 50), y=y, dt=0.1, hold="foh")
    assert fit_arx(slow, 1, 1).estimate.notes == ()


def test_equations_are_counted_before_any_is_formed(monkeypatch):
    """Orders of 2000 took half a minute to be refused."""
    _, record = sampled_levitation(0.22, n=3000)

    def refuse(*given, **named):
        raise AssertionError("a regression was formed")

    with monkeypatch.context() as patched:
        patched.setattr("ctrlid.estimation.linear.arx.build_arx_regression", refuse)
        with pytest.raises(CtrlidError, match="1000 equations for 4001 unknowns"):
            fit_arx(record, 2000, 2000)
        with pytest.raises(CtrlidError, match="Too few samples: 1 equation for 5 unknowns"):
            fit_arx(record[:3], 2, 2)


@pytest.mark.parametrize("orders", [(2, 2, 1), (1, 3, 4), (4, 1, 0), (3, 2, 2)])
def test_the_count_of_equations_is_that_of_the_regression(orders):
    rng = np.random.default_rng(3)
    record = Record(y=rng.normal(size=400), u=rng.normal(size=400), dt=DT,
                    valid=rng.random(400) > 0.05)  # fmt: skip
    (structure,) = list_structures(*orders, record).values()
    rows = build_arx_regression([record], structure).rows
    assert count_equations(record, structure) == rows > 100


def test_an_iterator_of_records_is_checked_as_a_list_is():
    """Its notes were left out, so that a bias was not told."""
    rng = np.random.default_rng(1)
    u = rng.choice([-1.0, 1.0], 800)
    y = lfilter([0, 0.1, 0.1], [1, -1.5, 0.6], u) + 0.1 * rng.standard_normal(800)
    records = [Record(u=u[s], y=y[s], dt=0.01) for s in (slice(400), slice(400, 800))]
    whole = fit_arx(records, 2, 2).estimate
    assert any("NOT WHITE" in note for note in whole.notes)
    assert fit_arx(iter(records), 2, 2).estimate.notes == whole.notes
