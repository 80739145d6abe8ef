"""Lead design: exact where it answers, and right where it refuses."""

import math

import control as ct
import numpy as np
import pytest

import ctrlid as cid

G = 9.81


def maglev(x0, V0):
    """Linearised levitation, -beta / (s^2 - alpha), gap x0 (m) at voltage V0 (V)."""
    return ct.tf([-2 * G / V0], [1, 0, -2 * G / x0])


def response(system, omega):
    """Evaluate num/den by hand, independently of python-control and ctrlid."""
    point = np.exp(1j * omega * system.dt) if system.dt else 1j * omega
    return np.polyval(system.num[0][0], point) / np.polyval(system.den[0][0], point)


def closed_loop_stable(P, C):
    """Judge by the eigenvalues of a state-space closed loop, nothing cancelled."""
    p, c = ct.ss(P), ct.ss(C)
    loop = 1 / (1 + c.D[0, 0] * p.D[0, 0])
    A = np.block(
        [
            [p.A - loop * p.B @ c.D @ p.C, loop * p.B @ c.C],
            [-loop * c.B @ p.C, c.A - loop * c.B @ p.D @ c.C],
        ]
    )
    poles = np.linalg.eigvals(A)
    return bool(np.all(np.abs(poles) < 1) if P.dt else np.all(poles.real < 0))


def check(P, C, crossover, phase_margin):
    """Demand exactly this crossover and margin, a stable loop, and no smaller margin elsewhere."""
    L = response(P, crossover) * response(C, crossover)
    assert abs(L) == pytest.approx(1, abs=1e-9)
    assert math.degrees(np.angle(-L)) == pytest.approx(phase_margin, abs=1e-7)
    assert closed_loop_stable(P, C)
    top = math.pi / P.dt if P.dt else 1e5 * crossover
    omega = np.geomspace(1e-6 * crossover, top, 50_001)
    values = response(P, omega) * response(C, omega)
    size = np.abs(values)
    changes = np.flatnonzero((size[:-1] - 1) * (size[1:] - 1) < 0)
    margins = np.degrees(np.abs(np.angle(-values[changes])))
    assert margins.min() >= phase_margin - 0.1
    if len(C.den[0][0]) == 2 and not P.dt:
        assert -C.poles()[0].real > -C.zeros()[0].real > 0


def family(P, crossover, phase_margin, count=400):
    """Yield leads with this crossover and margin: the pole is free, the zero follows."""
    target = -np.exp(1j * math.radians(phase_margin)) / response(P, crossover)
    period = P.dt or 0.0
    nu = 2 / period * math.tan(crossover * period / 2) if period else crossover
    for sign in (1, -1):
        phi = float(np.angle(sign * target))
        if not 0 < phi < math.pi / 2:
            continue
        for b in np.tan(np.linspace(0, math.pi / 2 - phi, count)[1:-1]):
            a = math.tan(phi + math.atan(b))
            K = sign * abs(target) * math.hypot(1, b) / math.hypot(1, a)
            zero, pole = nu / a, nu / b
            if period:  # s -> (2/T)(z-1)/(z+1)
                h = 2 / period
                num = [h / zero + 1, 1 - h / zero]
                den = [h / pole + 1, 1 - h / pole]
            else:
                num, den = [1 / zero, 1], [1 / pole, 1]
            yield ct.tf(K * np.array(num), den, period)


def polynomial_stable(P, C):
    """Judge by the characteristic polynomial: many times faster, for brute force."""
    pole = np.roots(
        np.polyadd(
            np.polymul(P.num[0][0], C.num[0][0]),
            np.polymul(P.den[0][0], C.den[0][0]),
        )
    )
    return bool(np.all(np.abs(pole) < 1) if P.dt else np.all(pole.real < 0))


def random_maglevs(count, seed):
    generator = np.random.default_rng(seed)
    for _ in range(count):
        mass, x0 = generator.uniform(0.01, 0.1), generator.uniform(0.005, 0.02)
        V0 = generator.uniform(1, 10)
        # The force K (V/x)^2 balances the weight: the mass sets K and leaves the model.
        K = mass * G * (x0 / V0) ** 2
        beta, alpha = 2 * K * V0 / x0**2 / mass, 2 * K * V0**2 / x0**3 / mass
        yield ct.tf([-beta], [1, 0, -alpha]), math.sqrt(alpha), generator


@pytest.mark.parametrize("dt", [0.0, 1e-4, 1e-3, 5e-3])
def test_random_maglevs(dt):
    for P, pole, generator in random_maglevs(25, seed=int(dt * 1e4)):
        phase_margin = generator.uniform(20, 60)
        # The centred lead needs (1 + (wc/pole)^2) tan((90 - phi)/2) > 1.
        crossover = pole * generator.uniform(2.0, 4.0)
        if dt:
            P = ct.c2d(P, dt)
            crossover = min(crossover, 0.5 / dt)
            lag = math.degrees(crossover * dt / 2)  # the hold's, to first order
            phase_margin = min(phase_margin, 80 - lag)
        C = cid.design_lead(P, crossover, phase_margin)
        assert C.dt == dt
        assert C.num[0][0][0] < 0  # K < 0
        check(P, C, crossover, phase_margin)


def test_centred_lead_is_the_textbook_one():
    C = cid.design_lead(maglev(0.012, 3.0), crossover=100.0, phase_margin=50)
    z, p = -C.zeros()[0].real, -C.poles()[0].real
    assert z * p == pytest.approx(100.0**2, rel=1e-12)
    alpha = (1 - math.sin(math.radians(50))) / (1 + math.sin(math.radians(50)))
    assert z / p == pytest.approx(alpha, rel=1e-12)


def test_lowest_crossover_of_a_levitation_is_the_derived_one():
    # |L(0)| > 1 with t -> 0 (p -> infinity): (1 + wc^2/alpha) cos(phi) > 1.
    P, alpha = maglev(0.012, 3.0), 2 * G / 0.012
    lowest = math.sqrt(alpha * (1 / math.cos(math.radians(50)) - 1))
    with pytest.raises(cid.CtrlidError, match=f"from about {lowest:.2g}") as refusal:
        cid.design_lead(P, 0.95 * lowest, 50)
    assert "unstable with every lead" in str(refusal.value)
    assert "upwards" in str(refusal.value)
    # Just above it the centred lead is unstable, but one near the edge of the family is not.
    C = cid.design_lead(P, 1.02 * lowest, 50)
    check(P, C, 1.02 * lowest, 50)
    assert C.poles()[0].real * C.zeros()[0].real > 1.1 * (1.02 * lowest) ** 2


def test_off_centre_lead_has_the_largest_modulus_margin():
    P, crossover = maglev(0.012, 3.0), 34.0
    C = cid.design_lead(P, crossover, 50)
    best = max(
        (
            cid.loop_margins(P * trial).modulus_margin
            for trial in family(P, crossover, 50, count=100)
            if polynomial_stable(P, trial)
        ),
    )
    assert cid.loop_margins(P * C).modulus_margin >= 0.995 * best


def random_plant(generator, kind):
    """Draw a plant of order 1 to 4 with gain of either sign and the named kind of poles."""
    order = int(generator.integers(1, 5))
    size = 10 ** generator.uniform(-1, 1, size=order)
    poles = -size.astype(complex)
    if order >= 3 and generator.random() < 0.5:
        damping = generator.uniform(0.1, 0.9)
        pair = -size[1] * (damping + 1j * math.sqrt(1 - damping**2))
        poles[1:3] = pair, pair.conjugate()
    if kind == "integrating":
        poles[0] = 0
    elif kind == "unstable":
        poles[0] = size[0]
    num = np.ones(1)
    if order > 1 and generator.random() < 0.4:
        num = np.array([1 / generator.uniform(1, 10), 1.0])
    gain = 10 ** generator.uniform(-2, 2) * generator.choice([-1, 1])
    return ct.tf(gain * num, np.real(np.poly(poles)))


@pytest.mark.parametrize("kind", ["stable", "integrating", "unstable"])
@pytest.mark.parametrize("dt", [0.0, pytest.param(0.01, marks=pytest.mark.slow),
                                pytest.param(0.1, marks=pytest.mark.slow)])  # fmt: skip
def test_random_plants_are_answered_exactly_or_refused_rightly(kind, dt):
    generator = np.random.default_rng([len(kind), int(1000 * dt)])
    answered = refused = 0
    for _ in range(20):
        P = random_plant(generator, kind)
        P = ct.c2d(P, dt) if dt else P
        crossover = min(10 ** generator.uniform(-0.5, 1.2), 2.0 / dt if dt else math.inf)
        phase_margin = generator.uniform(20, 110)
        try:
            C = cid.design_lead(P, crossover, phase_margin)
        except cid.CtrlidError as refusal:
            refused += 1
            text = str(refusal)
            trials = list(family(P, crossover, phase_margin, count=25))
            if "unstable with every lead" in text:
                assert trials
                assert not any(polynomial_stable(P, trial) for trial in trials)
            elif "another crossover" in text:
                stable = [trial for trial in trials if polynomial_stable(P, trial)]
                margins = [cid.loop_margins(P * trial).phase_margin for trial in stable]
                assert max(margins) < phase_margin
            else:
                assert "degrees of lead" in text or "phase lag" in text
                assert not trials
        else:
            answered += 1
            check(P, C, crossover, phase_margin)
    assert answered >= 2
    assert refused >= 1


def test_margins_above_90_degrees_where_the_plant_allows_them():
    for P in (ct.tf([1], [1, -1]), ct.tf([2], [1, 0.1])):
        C = cid.design_lead(P, 3.0, 130)
        check(P, C, 3.0, 130)


def test_state_space_plants_and_keywords():
    P = maglev(0.01, 2.0)
    first = cid.design_lead(P, 120.0, 45)
    second = cid.design_lead(P=ct.ss(P), crossover=120.0, phase_margin=45)
    np.testing.assert_allclose(first.num[0][0], second.num[0][0], rtol=1e-9)
    np.testing.assert_allclose(first.den[0][0], second.den[0][0], rtol=1e-9)


def test_dust_of_a_conversion_does_no_harm():
    exact = maglev(0.012, 3.0)
    dusty = ct.tf([8.9e-16, *exact.num[0][0]], exact.den[0][0])
    first, second = (cid.design_lead(P, 100.0, 50) for P in (exact, dusty))
    np.testing.assert_allclose(first.num[0][0], second.num[0][0], rtol=1e-9)


def test_discrete_design_tends_to_the_continuous_one():
    P = maglev(0.012, 3.0)
    continuous = cid.design_lead(P, 100.0, 50)
    discrete = cid.design_lead(ct.c2d(P, 1e-5), 100.0, 50)
    for omega in (1.0, 50.0, 400.0):
        assert response(discrete, omega) == pytest.approx(response(continuous, omega), rel=5e-3)


def test_pure_gain_where_no_phase_is_needed():
    C = cid.design_lead(ct.tf([1], [1, 1, 0]), 1.0, 45)
    assert C.num[0][0] == pytest.approx([math.sqrt(2)])
    assert len(C.den[0][0]) == 1
    C = cid.design_lead(ct.tf([-1], [1, 1, 0]), 1.0, 45)
    assert C.num[0][0] == pytest.approx([-math.sqrt(2)])


def test_names_do_not_depend_on_counters():
    C = cid.design_lead(ct.tf([1], [1, 0, 0]), 1.0, 45)
    assert (C.name, C.input_labels, C.output_labels) == ("lead", ["e"], ["u"])
    assert repr(C) == repr(cid.design_lead(ct.tf([1], [1, 0, 0]), 1.0, 45))


def test_too_much_lead_says_how_much_and_what_is_possible():
    with pytest.raises(cid.CtrlidError) as refusal:
        cid.design_lead(ct.tf([1], [1, 0, 0]), 100.0, 104.2)
    text = str(refusal.value)
    assert "104.2 degrees at 100 rad/s needs 104.2 degrees of lead" in text
    assert "one lead gives less than 90" in text
    assert "largest phase margin at this crossover is just under 90.0 degrees" in text
    assert "None of 61 crossovers tried from" in text


def test_largest_margin_of_a_levitation_is_the_derived_one():
    # (1 + wc^2/alpha) cos(phi) > 1 again, now for phi.
    P, alpha = maglev(0.012, 3.0), 2 * G / 0.012
    largest = math.degrees(math.acos(1 / (1 + 100.0**2 / alpha)))
    with pytest.raises(cid.CtrlidError, match=f"is about {largest:.1f} degrees"):
        cid.design_lead(P, 100.0, 95)
    check(P, cid.design_lead(P, 100.0, largest - 0.2), 100.0, largest - 0.2)


def test_too_little_phase_asked_says_what_a_gain_gives():
    P = ct.tf([1], [1, 1, 0])
    with pytest.raises(cid.CtrlidError) as refusal:
        cid.design_lead(P, 1.0, 30)
    text = str(refusal.value)
    assert "would need a phase lag" in text
    assert "a pure gain gives exactly 45.0000 degrees" in text
    assert text.endswith("are tried with redesign(G, loop, design=lambda P: C).")
    assert "45.0 to just under 135.0 degrees" in text
    # Without a lead, phase -150 is at tan(60): from there on leads work.
    assert "With 30 degrees, crossovers are possible from about 1.73 rad/s upwards" in text
    check(P, cid.design_lead(P, 1.74, 30), 1.74, 30)


def test_no_crossover_at_all():
    with pytest.raises(
        cid.CtrlidError, match=r"unstable with every lead.*None of 61 crossovers tried"
    ):
        cid.design_lead(ct.tf([1], [1, -3, 2, 0]), 3.0, 45)


def test_possible_crossovers_are_a_range_for_a_discrete_levitation():
    P = ct.c2d(maglev(0.012, 3.0), 0.001)
    with pytest.raises(cid.CtrlidError, match=r"possible from about 30\S* to about \S+ rad/s"):
        cid.design_lead(P, 20.0, 50)
    with pytest.raises(cid.CtrlidError, match=r"possible up to about \S+ rad/s"):
        cid.design_lead(ct.tf([1], [1, 0.1, 0]), 5.0, 95)


def test_the_other_sign_of_gain_is_not_forgotten():
    # K < 0 could give the angle but not stability; K > 0 gives more than what is asked.
    P = ct.tf([1], [1, -0.5], 0.1)
    with pytest.raises(cid.CtrlidError) as refusal:
        cid.design_lead(P, 1.0, 60)
    text = str(refusal.value)
    assert "unstable with every lead" in text
    assert "With a gain of the other sign: A phase margin of 60 degrees at 1 rad/s" in text
    plain = 180 + math.degrees(np.angle(response(P, 1.0)))
    assert f"a pure gain gives exactly {plain:.4f} degrees" in text


def test_every_margin_unstable_at_this_crossover():
    with pytest.raises(cid.CtrlidError, match="with any margin a lead gives at this crossover"):
        cid.design_lead(ct.tf([1], [1, 0, 0, -1]), 3.0, 50)


def test_a_pure_gain_that_does_not_stabilise_is_refused():
    # 1/(s (s^2 + 0.02 s + 1)): at 0.5 rad/s the resonance stands above 1.
    P = ct.tf([1], [1, 0.02, 1, 0])
    margin = 90 - math.degrees(math.atan2(0.02 * 0.5, 1 - 0.25))
    with pytest.raises(cid.CtrlidError, match="unstable with the pure gain"):
        cid.design_lead(P, 0.5, margin)


def test_another_crossover_with_less_margin_is_not_passed_over():
    # After its resonance the phase is near -180, where the gain comes down through 1 again.
    P = ct.tf([1], [1, 0.1, 1])
    with pytest.raises(cid.CtrlidError, match="another crossover with a smaller margin, at best"):
        cid.design_lead(P, 0.3, 179.5)
    margins = [
        cid.loop_margins(P * trial).phase_margin
        for trial in family(P, 0.3, 179.5, count=50)
        if closed_loop_stable(P, trial)
    ]
    assert margins
    assert max(margins) < 30


P = ct.tf([1], [1, 0, 0])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: cid.design_lead(P, 0, 45), "crossover is 0 rad/s; needed is a frequency above 0"),
        (lambda: cid.design_lead(P, -3, 45), "crossover is -3 rad/s"),
        (lambda: cid.design_lead(ct.tf(1, [1, -1.1], 0.1), 5e-324, 45), "a frequency above 0"),
        (lambda: cid.design_lead(P, np.nan, 45), "crossover is nan; needed is one finite number"),
        (lambda: cid.design_lead(P, [1, 2], 45), r"crossover is \[1, 2\]; needed is one finite"),
        (lambda: cid.design_lead(P, 1, "big"), "phase_margin is 'big'"),
        (lambda: cid.design_lead(P, 1, 0), "phase_margin is 0 degrees; needed is a value between"),
        (lambda: cid.design_lead(P, 1, 180), "phase_margin is 180 degrees"),
        (lambda: cid.design_lead(ct.c2d(P, 0.1), 32, 45), "must be below pi/dt = 31.42 rad/s"),
        (lambda: cid.design_lead(ct.tf([1, 2], [1, -1], True), 1, 45), "no sampling period"),
        (lambda: cid.design_lead(ct.ss([], [], [], np.eye(2)), 1, 45), "P has 2 inputs and 2 out"),
        (lambda: cid.design_lead("maglev", 1, 45), "P is a str; needed is a linear system"),
        (lambda: cid.design_lead(ct.tf([1, 0, 0], [1, 1]), 1, 45), "P is improper"),
        (lambda: cid.design_lead(ct.tf([np.inf], [1, 1]), 1, 45), "NaN or infinite"),
        (lambda: cid.design_lead(ct.tf([1], [1, 0, 1]), 1, 45), "P is infinite at the crossover 1"),
        (lambda: cid.design_lead(ct.tf([1, 0, 9], [1, 3, 3, 1]), 3, 45), "P is zero at the cros"),
        (
            lambda: cid.design_lead(ct.c2d(ct.tf([1], [1, 4, 6, 4, 1]), 1e-4), 0.5, 45),
            "to the accuracy of its coefficients .at fast sampling",
        ),
        (lambda: cid.design_lead(ct.tf([0], [1, 1]), 3, 45), "P is zero at the crossover 3"),
        (lambda: cid.design_lead(ct.tf([1, -2], [1, -1, -2]), 5, 45), "hidden mode at 2 that is"),
        (lambda: cid.design_lead(ct.tf([1, 0], [1, 1, 0]), 5, 45), "hidden mode at 0 that is"),
        (
            lambda: cid.design_lead(ct.tf([1, -2, 5], [1, -1, 3, 5]), 5, 45),
            r"hidden mode at 1[+-]2j that is",
        ),
        (
            lambda: cid.design_lead(ct.ss([[1, 0], [0, -1]], [[0], [1]], [[1, 1]], 0), 2, 100),
            "hidden mode at 1 that is",
        ),
    ],
)
def test_refusals_say_what_is_needed(call, words):
    with pytest.raises(cid.CtrlidError, match=words):
        call()


def test_a_margin_in_radians_is_doubted():
    P = ct.tf([-6.54], [1, 0, -1635])
    with pytest.warns(cid.CtrlidWarning, match=r"give 45\.8"):
        cid.design_lead(P, 100.0, 0.8)
