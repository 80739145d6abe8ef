"""Every estimator says in capitals when its innovations are not white, and refuses what is absurd.

The records come from a simulator of this file's own: the held-input map of a plant, by
scipy.linalg.expm, under a digital law written out in numpy.
"""

import numpy as np
import pytest
from scipy import linalg, signal

import ctrlid as cid
from ctrlid.estimation.linear.instruments import compute_independence_probability
from ctrlid.estimation.whiteness import HARMLESS, LEVEL, note_coloured_innovations

SAYS = "INNOVATIONS ARE NOT WHITE"
DT = 0.01


def draw_noise(kind, n, rng):
    white = rng.standard_normal(n + 100)
    shapes = {
        "white": ([1.0], [1.0]),
        "averaged": ([0.5, 0.5], [1.0]),
        "slow": ([1.0], [1.0, -0.9]),
    }
    return signal.lfilter(*shapes[kind], white)[100:]


def simulate_unstable(kind, seed, n=3000, size=1e-4):
    """A plant 30 / (s^2 - 16) behind a held input, kept upright by a lead."""
    rng = np.random.default_rng(seed)
    a, b = np.array([[0.0, 1.0], [16.0, 0.0]]), np.array([[0.0], [30.0]])
    whole = linalg.expm(np.block([[a, b], [np.zeros((1, 3))]]) * DT)
    f, g = whole[:2, :2], whole[:2, 2]
    r = np.repeat(rng.choice([-0.01, 0.01], n // 30 + 1), 30)[:n]
    noise = size * draw_noise(kind, n, rng)
    x, before, held = np.zeros(2), 0.0, 0.0
    u, y = np.zeros(n), np.zeros(n)
    for k in range(n):
        y[k] = x[0] + noise[k]
        error = r[k] - y[k]
        # A lead: 8 (s + 4) / (s + 60), discretised by hand with backward differences.
        held = (held + 8.0 * ((1 + 4 * DT) * error - before)) / (1 + 60 * DT)
        before = error
        u[k] = held
        x = f @ x + g * u[k]
    return cid.Record(r=r, u=u, y=y, dt=DT)


def fit(estimator, record):
    if estimator == "fit_loop":
        # The plant of the simulator as equations: x" = a x + b u.
        import control as ct

        plant = ct.nlsys(
            lambda t, x, u, p: np.array([x[1], p["a"] * x[0] + p["b"] * u[0]]),
            lambda t, x, u, p: x[0],
            inputs=["u"], outputs=["y"], states=["y", "v"], params={"a": 14.0, "b": 28.0},
        )  # fmt: skip
        at = cid.OperatingPoint((0.0, 0.0), 0.0, 0.0)
        loop = cid.Loop(plant, None, dt=DT, at=at, free=("a", "b"))
        return cid.fit_loop(loop, record).estimate
    if estimator == "fit_continuous":
        return cid.fit_continuous(record, 2).estimate
    if estimator == "fit_arx":
        return cid.fit_arx(record, 2, 2).estimate
    return cid.fit_iv(record, 2, 2).estimate


@pytest.mark.parametrize("kind", ["averaged", "slow"])
def test_coloured_noise_is_said_in_capitals(kind):
    notes = fit("fit_loop", simulate_unstable(kind, 1)).notes
    assert any(SAYS in note for note in notes), notes
    (said,) = (note for note in notes if SAYS in note)
    assert "sensor noise is taken for white here" in said
    assert "diagnose() fits coloured noise as well" in said


@pytest.mark.parametrize("kind", ["averaged", pytest.param("slow", marks=pytest.mark.slow)])
def test_a_continuous_fit_has_coloured_noise_of_its_own(kind):
    """The noise is a moving average of some order: a1 = 0, a2 = -16 and b1 = 30 are covered."""
    estimate = fit("fit_continuous", simulate_unstable(kind, 1))
    assert "moving average of order" in estimate.solver
    errors = (estimate.values - [0.0, -16.0, 30.0]) / estimate.standard_errors
    # Of three intervals one fails at this level once in a thousand cases.
    assert np.max(np.abs(errors)) < 3.6


@pytest.mark.parametrize("estimator", ["fit_continuous", "fit_loop", "fit_iv"])
def test_white_noise_is_not_blamed(estimator):
    said = [any(SAYS in note for note in fit(estimator, simulate_unstable("white", s)).notes)
            for s in (1, 2)]  # fmt: skip
    assert not any(said)


def test_least_squares_in_a_noisy_loop_is_told_to_be_biased():
    estimate = fit("fit_arx", simulate_unstable("white", 1))
    assert any(SAYS in note and "fit_iv" in note for note in estimate.notes)


def test_least_squares_without_noise_has_nothing_to_say():
    estimate = fit("fit_arx", simulate_unstable("white", 1, size=0.0))
    assert not estimate.notes
    assert np.max(np.log(np.abs(estimate.poles)) / DT) == pytest.approx(4.0, rel=1e-6)


def test_the_level_is_what_it_says():
    """Of white innovations with a share of gaps at most one in a hundred is called coloured."""
    rng = np.random.default_rng(7)
    called = 0
    for _ in range(1000):
        e = rng.standard_normal(800)
        e[rng.random(800) < 0.05] = np.nan
        called += bool(note_coloured_innovations([e[:300], e[300:]], 0, ""))
    # The rate may be below the level, since the correlation must also do harm; five standard
    # deviations above it would be a fault.
    assert called <= 1000 * LEVEL + 5 * np.sqrt(1000 * LEVEL)


def test_a_certain_but_harmless_colour_is_not_mentioned():
    rng = np.random.default_rng(3)
    e = rng.standard_normal(50_000)
    faint = e[1:] + 0.03 * e[:-1]
    assert HARMLESS > 2 * 0.03
    assert not note_coloured_innovations([faint], 2, "")
    strong = e[1:] + 0.4 * e[:-1]
    assert note_coloured_innovations([strong], 2, "")


def test_an_absurd_pole_is_refused():
    """A static plant has no second pole: a search sends it to where nothing of it is left."""
    rng = np.random.default_rng(5)
    u = np.repeat(rng.choice([-1.0, 1.0], 400), 5)
    x = signal.lfilter([0.0, 0.1], [1.0, -0.9], u)
    record = cid.Record(u=u, y=x + 1e-3 * rng.standard_normal(len(u)), dt=DT)
    with pytest.raises(cid.CtrlidError, match=r"Lower the number of poles|do not determine"):
        cid.fit_continuous(record, 3)


def simulate_coloured(seed, equation, rho=0.0, n=1500):
    """(q^2 - 1.5 q + 0.56) x = (0.1 q + 0.05) u under a digital law, noise at y or in the sum."""
    rng = np.random.default_rng(seed)
    r = np.repeat(rng.choice([-1.0, 1.0], n // 40 + 1), 40)[:n]
    noise = signal.lfilter([1.0], [1.0, -rho], rng.standard_normal(n))
    x, y, u = np.zeros(n), np.zeros(n), np.zeros(n)
    for k in range(n):
        if k > 1:
            x[k] = 1.5 * x[k - 1] - 0.56 * x[k - 2] + 0.1 * u[k - 1] + 0.05 * u[k - 2]
            x[k] += 0.05 * noise[k] if equation else 0.0
        y[k] = x[k] + (0.0 if equation else noise[k])
        u[k] = 1.5 * (r[k] - y[k]) - (r[k - 1] - y[k - 1] if k else 0.0)
    return cid.Record(r=r, u=u, y=y, dt=DT)


def test_a_biased_fit_whose_errors_look_white_depends_on_the_past_reference():
    """Sensor noise of correlation 0.5 hides in the coefficients, and leaves white errors."""
    said = [cid.fit_arx(simulate_coloured(seed, equation=False, rho=0.5), 2, 2).estimate
            for seed in range(20)]  # fmt: skip
    for estimate in said:
        off = np.abs(estimate.values - [-1.5, 0.56, 0.1, 0.05]) / estimate.standard_errors
        assert max(off) > 5
    depend = [e for e in said if any("DEPEND ON THE PAST REFERENCE" in n for n in e.notes)]
    assert len(depend) >= 18


def test_a_right_difference_equation_is_not_doubted():
    notes = [cid.fit_arx(simulate_coloured(seed, equation=True), 2, 2).estimate.notes
             for seed in range(100)]  # fmt: skip
    assert sum(map(bool, notes)) <= 5


@pytest.mark.parametrize("level", [0.0, 5.0])
def test_an_exact_fit_about_another_level_has_nothing_to_say(level):
    """Beside the constant of the equation only rounding is left, which is not noise."""
    rng = np.random.default_rng(1)
    r = np.repeat(rng.choice([-1.0, 1.0], 40), 40)
    y = level + signal.lfilter([0.0, 0.1, 0.05], [1.0, -1.5, 0.56], r)
    assert cid.fit_arx(cid.Record(r=r, u=r, y=y, dt=DT), 2, 2).estimate.notes == ()


def test_errors_are_independent_of_references_that_move_nothing():
    rng = np.random.default_rng(3)
    e = [rng.standard_normal(400)]
    assert compute_independence_probability(e, [np.ones((1, 400))]) == 1.0
    assert compute_independence_probability([e[0][:5]], [rng.standard_normal((1, 5))]) == 1.0
    r = rng.standard_normal((1, 400))
    late = np.concatenate([[0.0, 0.0, 0.0], r[0, :-3]])
    assert compute_independence_probability([e[0] + late], [r]) < 1e-10
    # Half of the errors unknown, and in two stretches.
    some = np.where(np.arange(400) % 2, e[0] + late, np.nan)
    parts = [some[:150], some[150:]]
    assert compute_independence_probability(parts, [r[:, :150], r[:, 150:]]) < 1e-10
    # The chances of white errors are uniform.
    chances = [
        compute_independence_probability([rng.standard_normal(400)], [r]) for _ in range(400)
    ]
    assert abs(np.mean(np.less(chances, 0.1)) - 0.1) < 0.04


def test_coefficients_of_the_inputs_take_no_degree_of_freedom():
    """Of 14 coefficients 12 multiply inputs. With all taken off a twelfth was called coloured."""
    alarms = 0
    for seed in range(60):
        rng = np.random.default_rng([8300, seed])
        u, b, y = rng.standard_normal((3, 120)), rng.standard_normal((3, 4)), np.zeros(120)
        for k in range(4, 120):
            driven = sum(b[i] @ u[i, k - 4 : k][::-1] for i in range(3))
            y[k] = 0.9 * y[k - 1] - 0.2 * y[k - 2] + driven + rng.standard_normal()
        fitted = cid.fit_arx(cid.Record(u=u, y=y, dt=1.0), na=2, nb=4)
        alarms += "THE INNOVATIONS ARE NOT WHITE" in str(fitted)
    assert alarms <= 3
