"""fit_arx and fit_iv with several inputs and outputs, on simulators of their own.

Groups: exact recovery; noise; constraints by output; models; refusals.
"""

import control as ct
import numpy as np
import pytest
from scipy import linalg, stats

import ctrlid as cid
from ctrlid import CtrlidError

DT = 0.05
# A mass on a spring that pushes away, with a second mass on it: one pole outside the circle.
A = np.array([[0.0, 0, 1, 0], [0, 0, 0, 1], [6.0, 3.0, -0.5, 0.2], [2.0, -20.0, 0.1, -1.0]])
B = np.array([[0.0, 0], [0, 0], [1.0, 0.3], [-0.4, 2.0]])
C = np.eye(2, 4)
G = ct.sample_system(ct.ss(A, B, C, np.zeros((2, 2))), DT)
K = ct.dlqr(G, np.diag([20.0, 5, 1, 1]), np.eye(2))[0]
L = G.A @ ct.dlqe(G, np.eye(2), 1e-2 * np.eye(2))[0]
NAMES = {"r": ("a", "b"), "u": ("F1", "F2"), "y": ("x", "z")}


def run(seed, n=3000, noise=0.0, columns=2, levels=(0.0, 0.0)):
    """A record under feedback by an observer that reads the noisy outputs; numpy alone."""
    rng = np.random.default_rng(seed)
    r = np.repeat(rng.choice([-1.0, 1.0], (2, n // 8 + 1)), 8, axis=1)[:, :n]
    b, k = G.B[:, :columns], K[:columns]
    x, z = np.zeros(4), np.zeros(4)
    y, u = np.zeros((2, n)), np.zeros((columns, n))
    for i in range(n):
        y[:, i] = C @ x + noise * rng.standard_normal(2)
        u[:, i] = -k @ z + r[:columns, i]
        z = G.A @ z + b @ u[:, i] + L @ (y[:, i] - C @ z)
        x = G.A @ x + b @ u[:, i]
    y = y + np.array(levels)[:, None]
    names = {**NAMES, "r": NAMES["r"][:columns], "u": NAMES["u"][:columns]}
    return cid.Record(r=r[:columns], u=u, y=y, dt=DT, names=names)


def true_coefficients(output, columns=2):
    """The coefficients of one output, from the state equations by Leverrier's recursion."""
    n = len(G.A)
    a, m, markov = [1.0], np.eye(n), []
    for k in range(1, n + 1):
        markov.append(C[output] @ m @ G.B[:, :columns])
        product = G.A @ m
        a.append(-np.trace(product) / k)
        m = product + a[-1] * np.eye(n)
    return np.concatenate([a[1:], np.array(markov).T.ravel()])


FITS = pytest.mark.parametrize("fit", [cid.fit_arx, cid.fit_iv])


# --- exact recovery


@FITS
@pytest.mark.parametrize("columns", [1, 2])
def test_exact_without_noise(fit, columns):
    found = fit(run(1, columns=columns, levels=(0.3, -0.2)), 4, 4)
    assert found.output_labels == ["x", "z"]
    assert found.input_labels == ["F1", "F2"][:columns]
    for k, estimate in enumerate(found.estimates.values()):
        np.testing.assert_allclose(estimate.values, true_coefficients(k, columns), atol=2e-6)
        assert len(estimate.names) == 4 + 4 * columns
    # Poles of the plant, one set for each output.
    expected = np.sort_complex(linalg.eigvals(G.A))
    np.testing.assert_allclose(np.sort_complex(found.estimates["z"].poles), expected, atol=1e-5)


def test_the_transfer_function_is_that_of_the_plant():
    found = cid.fit_arx(run(1), 4, 4)
    assert isinstance(found, ct.TransferFunction)
    points = np.exp(1j * np.array([0.01, 0.3, 1.0, 3.0]))
    for z in points:
        expected = C @ np.linalg.solve(z * np.eye(4) - G.A, G.B)
        np.testing.assert_allclose(found(z), expected, rtol=1e-4, atol=1e-6)
        states = found.to_states(order=8)
        np.testing.assert_allclose(states(z), found(z), rtol=1e-8)
        np.testing.assert_allclose(found.to_states()(z), expected, rtol=1e-4, atol=1e-6)
    assert states.nstates == 8
    assert states.output_labels == ["x", "z"]
    assert found.to_states().nstates == 4
    with pytest.raises(CtrlidError, match="order is a number of states from 1 to 8; given 9"):
        found.to_states(9)


@pytest.mark.parametrize("seed", [21, 22])
def test_states_of_a_noisy_fit_have_the_poles_of_the_plant(seed):
    found = cid.fit_iv(run(seed, n=4000, noise=0.005), 4, 4)
    poles = np.sort_complex(found.to_states().poles())
    np.testing.assert_allclose(poles, np.sort_complex(linalg.eigvals(G.A)), atol=0.02)


def test_one_input_and_one_output_of_a_record_are_fitted_as_before():
    record = run(2, columns=1, noise=0.02)
    together = cid.fit_arx(record, 4, 4)
    alone = cid.fit_arx(record.select(y="z"), 4, 4)
    np.testing.assert_array_equal(together.estimates["z"].values, alone.estimate.values)
    assert isinstance(alone, cid.IdentifiedModel)


def test_orders_by_output():
    found = cid.fit_arx(run(3), [4, 5], [4, 3], nk=(1, 2))
    assert [e.structure.na for e in found.estimates.values()] == [4, 5]
    assert [e.structure.nb for e in found.estimates.values()] == [4, 3]
    assert [e.structure.nk for e in found.estimates.values()] == [1, 2]


def test_an_input_that_is_late_is_held_at_zero():
    fixed = [cid.Fixed("b1[F2]", 0.0, output="x")]
    found = cid.fit_arx(run(1), 4, 4, constraints=fixed)
    assert found.estimates["x"]["b1[F2]"] == 0.0
    assert found.estimates["z"]["b1[F2]"] != 0.0
    assert "b1[F2] = 0 (fixed)" in str(found.estimates["x"])


def test_several_records_and_samples_that_do_not_count():
    first, second = run(4, n=800), run(5, n=900, levels=(1.0, 2.0))
    valid = np.ones((2, 800), dtype=bool)
    valid[1, 300:310] = False
    y = first.y.copy()
    y[1, 300:310] = 99.0
    spoilt = cid.Record(r=first.r, u=first.u, y=y, dt=DT, valid=valid, names=NAMES)
    found = cid.fit_arx([spoilt, second], 4, 4)
    assert found.estimates["x"].n_samples == 796 + 896
    assert found.estimates["z"].n_samples == 796 + 896 - 14
    for k, estimate in enumerate(found.estimates.values()):
        np.testing.assert_allclose(estimate.values, true_coefficients(k), atol=1e-6)
        level = np.array([0.0, (1.0, 2.0)[k]]) * (1 + estimate.values[:4].sum())
        np.testing.assert_allclose(estimate.intercepts, level, atol=1e-6)


# --- noise


def test_instruments_are_unbiased_where_least_squares_is_not():
    record = run(6, n=12_000, noise=0.03)
    truth = true_coefficients(0)
    worst = {}
    for fit in (cid.fit_arx, cid.fit_iv):
        e = fit(record, 4, 4).estimates["x"]
        worst[fit] = np.max(np.abs(e.values - truth) / e.standard_errors)
    assert worst[cid.fit_iv] < 4.5
    assert worst[cid.fit_arx] > 10


def test_colour_is_told_of_each_output():
    found = cid.fit_arx(run(7, noise=0.03), 4, 4)
    for estimate in found.estimates.values():
        assert any("NOT WHITE" in note for note in estimate.notes)
    assert cid.fit_arx(run(7), 4, 4).estimates["x"].notes == ()


@pytest.mark.slow
@pytest.mark.parametrize("columns", [1, 2])
def test_intervals_of_instruments_cover(columns):
    hits = trials = 0
    for seed in range(25):
        found = cid.fit_iv(run(100 + seed, n=4000, noise=0.002, columns=columns), 4, 4)
        for k, e in enumerate(found.estimates.values()):
            truth = true_coefficients(k, columns)
            # One coefficient of each estimate: those of one estimate are not independent.
            name = e.names[seed % len(e.names)]
            low, high = e.confidence_interval(name)
            hits += low < truth[e.names.index(name)] < high
            trials += 1
    assert stats.binom.cdf(hits, trials, 0.95) > 1e-3, (hits, trials)


def test_intervals_of_least_squares_cover_with_white_equation_errors():
    hits = trials = 0
    truth = true_coefficients(0)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal((2, 600))
        # Stable variant: the equation of output x driven by noise, its poles drawn in.
        a = np.concatenate([[1.0], truth[:4] * 0.5 ** np.arange(1, 5)])
        y = np.zeros(600)
        for k in range(4, 600):
            past = -a[1:] @ y[k - 4 : k][::-1]
            forced = truth[4:8] @ u[0, k - 4 : k][::-1] + truth[8:] @ u[1, k - 4 : k][::-1]
            y[k] = past + forced + 0.01 * rng.standard_normal()
        record = cid.Record(u=u, y=np.array([y, y]), dt=DT)
        e = cid.fit_arx(record, 4, 4).estimates["y[1]"]
        low, high = e.confidence_interval("b2[u[1]]")
        hits += low < truth[9] < high
        trials += 1
    assert stats.binom.cdf(hits, trials, 0.95) > 1e-3


# --- constraints by output


def test_a_constraint_speaks_of_one_output():
    (pole,) = (p for p in linalg.eigvals(G.A) if abs(p) > 1)
    known = [cid.PoleAt(pole.real, output="z")]
    found = cid.fit_arx(run(8, noise=0.02), 4, 4, constraints=known)
    assert np.min(np.abs(found.estimates["z"].poles - pole)) < 1e-9
    assert np.min(np.abs(found.estimates["x"].poles - pole)) > 1e-6
    assert repr(known[0]).endswith('output="z")')
    assert repr(cid.ReciprocalPoles()) == "ReciprocalPoles()"


def test_the_static_gain_of_one_entry():
    gain = (C @ np.linalg.solve(np.eye(4) - G.A, G.B))[0, 1]
    known = cid.StaticGain(gain, output="x", input="F2")
    found = cid.fit_iv(run(9, noise=0.01), 4, 4, constraints=known)
    assert found(1.0)[0, 1].real == pytest.approx(gain, rel=1e-6)


# --- models


def test_the_text_has_a_part_for_each_output():
    text = str(cid.fit_arx(run(1), 4, 4))
    assert "x: least squares (ARX)" in text
    assert "z: least squares (ARX)" in text
    assert "b4[F2]" in text
    assert "b4[F2]" in cid.fit_arx(run(1), 4, 4)._repr_html_()


def test_a_fitted_system_is_redesigned():
    plant = ct.ss(A, B, C, np.zeros((2, 2)), inputs=["F1", "F2"], outputs=["x", "z"])
    found = cid.fit_arx(run(1), 4, 4)

    def design(P):
        k = ct.dlqr(P, P.C.T @ P.C, 0.01 * np.eye(2))[0]
        slow = P.A @ ct.dlqe(P.A, P.B, P.C, np.eye(2), 1e-2 * np.eye(2))[0]
        return ct.ss(P.A - slow @ P.C - P.B @ k, slow, -k, np.zeros((2, 2)), DT,
                     inputs=P.output_labels, outputs=P.input_labels)  # fmt: skip

    trial = cid.redesign(found, cid.Loop(plant, dt=DT), design=design)
    assert trial.promised.stable
    assert trial.stable
    np.testing.assert_allclose(
        trial.promised.margins[0].phase_margin, trial.achieved.margins[0].phase_margin, rtol=1e-3
    )


# --- refusals


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: cid.fit_arx(run(1, 200), [4, 4, 4], 4), r"na is one integer, or one for each out"),
        (lambda: cid.fit_iv(run(1, 200), 4, [4]), r"nb is one integer, or one for each output \(x"),
        (lambda: cid.fit_arx(run(1, 200), [4, 0], 4), "na must be an integer of at least 1"),
        (lambda: cid.fit_arx(run(1, 200), 4, 4, constraints=cid.PoleAt(1.0, output="w")),
         "speaks of the output 'w'; the record has x, z"),
        (lambda: cid.fit_arx(run(1, 200), 4, 4, constraints=cid.StaticGain(1.0)),
         "StaticGain needs input= with one of F1, F2; given ''"),
        (lambda: cid.fit_arx(run(1, 200), 4, 4, constraints=cid.Fixed("b1", 1.0)),
         r"uses 'b1', but this model has no such coefficient; it has a1, .*b1\[F1\]"),
        (lambda: cid.fit_arx(iter([run(1, 200)]), 4, 4), "once for each output: give a list"),
        (lambda: cid.fit_iv(run(1), 4, 4, controller=ct.ss([], [], [], np.eye(2), DT)),
         "fit_iv does not use controller= with several signals"),
        (lambda: cid.redesign(cid.fit_arx(run(1), 4, 4) * 1.0,
                              cid.Loop(ct.ss(A, B, C, 0 * B[:2]), dt=DT), design=abs),
         "redesign needs a model of several signals in states"),
        (lambda: cid.fit_continuous(run(1).select(r="a", u="F1", y="x"), 4, 3,
                                    constraints=cid.PoleAt(-1.0, output="z")),
         "speaks of the output 'z'; the record has x"),
        (lambda: cid.fit_continuous(run(1), 4, 3), "fit_continuous takes one input and one output"),
        (lambda: cid.fit_arx([run(1, 200), run(1, 200, columns=1)], 4, 4), "need the same inputs"),
    ],
)  # fmt: skip
def test_refusals(call, words):
    with pytest.raises(CtrlidError, match=words):
        call()


def test_a_still_input_is_named():
    record = run(1, 400)
    u = record.u.copy()
    u[1] = 0.5
    still = cid.Record(r=record.r, u=u, y=record.y, dt=DT, names=NAMES)
    with pytest.raises(CtrlidError, match="F2 is constant in all valid samples"):
        cid.fit_arx(still, 4, 4)
