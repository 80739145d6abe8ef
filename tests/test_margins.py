"""Margins, nu-gap and robust margin against what they mean, not against other code alone."""

import math

import control as ct
import numpy as np
import pytest

import ctrlid as cid


def closed_loop_stable(L, factor=1.0):
    """Judge by the eigenvalues of a state-space closed loop."""
    loop = ct.ss(L)
    A, B, C, D = loop.A, factor * loop.B, loop.C, factor * loop.D
    poles = np.linalg.eigvals(A - B @ C / (1 + D))
    return bool(np.all(np.abs(poles) < 1) if L.dt else np.all(poles.real < 0))


def random_system(generator, order, *, unstable=0, integrators=0, zeros=None):
    """Draw a proper system with poles and zeros of size 0.1 to 10 rad/s."""

    def draw(count, sign):
        found = []
        while len(found) < count:
            size = 10 ** generator.uniform(-1, 1)
            if count - len(found) >= 2 and generator.random() < 0.5:
                angle = generator.uniform(0, np.pi / 2 * 0.95)
                root = sign * size * np.exp(1j * angle)
                found += [root, root.conjugate()]
            else:
                found.append(sign * size)
        return found

    count = generator.integers(0, order + 1) if zeros is None else zeros
    poles = draw(order - unstable - integrators, -1) + draw(unstable, 1) + [0.0] * integrators
    gain = 10 ** generator.uniform(-1, 1) * generator.choice([-1, 1])
    num = gain * np.real(np.poly(draw(int(count), generator.choice([-1, 1]))))
    return ct.tf(np.atleast_1d(num), np.real(np.poly(poles)))


def random_stable_loops(count, *, dt=0.0):
    generator = np.random.default_rng(11)
    found = []
    while len(found) < count:
        order = int(generator.integers(1, 5))
        unstable = int(generator.integers(0, 2))
        L = random_system(generator, order, unstable=min(unstable, order))
        L = ct.c2d(L, dt) if dt else L
        if closed_loop_stable(L):
            found.append(L)
    return found


LOOPS = random_stable_loops(25) + random_stable_loops(15, dt=0.05)


def response(L, omega):
    return L(np.exp(1j * omega * L.dt)) if L.dt else L(1j * omega)


def dense(L):
    top = np.pi / L.dt if L.dt else 1e4
    return np.geomspace(1e-5, top, 200_001)


def test_known_third_order_loop():
    # 2/(s+1)^3: phase -180 at sqrt(3), where the gain is 2/8.
    margins = cid.loop_margins(ct.tf([2], [1, 3, 3, 1]))
    assert margins.stable
    assert margins.gain_margin == pytest.approx(4, rel=1e-12)
    assert margins.gain_reduction_margin == 0
    omega = math.sqrt(2 ** (2 / 3) - 1)
    assert margins.crossover == pytest.approx(omega, rel=1e-12)
    assert margins.phase_margin == pytest.approx(180 - 3 * math.degrees(math.atan(omega)))
    assert margins.delay_margin == pytest.approx(math.radians(margins.phase_margin) / omega)


def test_known_unstable_plant():
    # k/(s-1) is stable above k = 1 and has its phase -180 + atan(w) at w = sqrt(k^2 - 1).
    margins = cid.loop_margins(ct.tf([4], [1, -1]))
    assert (margins.gain_margin, margins.gain_reduction_margin) == (math.inf, 0.25)
    assert margins.crossover == pytest.approx(math.sqrt(15))
    assert margins.phase_margin == pytest.approx(math.degrees(math.acos(1 / 4)))
    assert margins.modulus_margin == pytest.approx(1)


@pytest.mark.parametrize(
    "L",
    [
        ct.tf([0.5], [1, -1]),
        ct.tf([9], [1, 3, 3, 1]),
        ct.tf([1, -1], [1, 0, -1]),  # the unstable pole is cancelled, hence hidden
        ct.tf([1, 0], [1, 1, 0]),  # so is the integrator
        ct.tf([-1, 0], [1, 1]),  # 1 + L vanishes at infinity: ill-posed
        ct.tf([1], [1, -0.5], 0.1) * 2,
        ct.tf([1, -1], [1, -1.5, 0.5], 0.1),
    ],
    ids=str,
)
def test_an_unstable_loop_has_no_margins(L):
    margins = cid.loop_margins(L)
    assert margins.stable is False
    rest = (margins.crossover, margins.phase_margin, margins.gain_margin, margins.modulus_margin)
    assert np.isnan([*rest, margins.gain_reduction_margin, margins.delay_margin]).all()


@pytest.mark.parametrize("L", LOOPS, ids=range(len(LOOPS)))
def test_gain_margins_are_where_stability_ends(L):
    margins = cid.loop_margins(L)
    assert margins.stable
    upper, lower = margins.gain_margin, margins.gain_reduction_margin
    inside = np.geomspace(max(lower, 1e-4) * 1.00001, min(upper, 1e4) * 0.99999, 60)
    assert all(closed_loop_stable(L, k) for k in inside)
    if upper < math.inf:
        assert not closed_loop_stable(L, upper * 1.00001)
    if lower > 0:
        assert not closed_loop_stable(L, lower * 0.99999)


@pytest.mark.parametrize("L", LOOPS, ids=range(len(LOOPS)))
def test_phase_delay_and_modulus_margins_against_a_dense_response(L):
    margins = cid.loop_margins(L)
    omega = dense(L)
    values = response(L, omega)
    size = np.abs(values)
    changes = np.flatnonzero((size[:-1] - 1) * (size[1:] - 1) < 0)
    if len(changes):
        angles = np.abs(np.degrees(np.angle(-values[changes])))
        assert margins.phase_margin == pytest.approx(angles.min(), abs=0.02)
        assert abs(response(L, margins.crossover)) == pytest.approx(1, abs=1e-10)
        exact = abs(math.degrees(np.angle(-response(L, margins.crossover))))
        assert margins.phase_margin == pytest.approx(exact, abs=1e-9)
        delays = np.angle(-values[changes]) % (2 * np.pi) / omega[changes]
        if L.dt or size[-1] < 1:
            assert margins.delay_margin == pytest.approx(delays.min(), rel=2e-3)
        else:
            assert margins.delay_margin == 0
    else:
        assert margins.phase_margin == math.inf
        assert math.isnan(margins.crossover)
    assert margins.modulus_margin <= np.abs(1 + values).min() + 1e-12
    assert margins.modulus_margin == pytest.approx(np.abs(1 + values).min(), rel=1e-4)


def test_a_resonance_a_thousandth_wide_is_not_missed():
    # Both crossovers at the peak lie within 0.2 % of one another.
    L = ct.tf([0.001], [1, 1e-4, 1]) * ct.tf([1, 20], [20])
    margins = cid.loop_margins(L)
    omega = np.linspace(0.999, 1.001, 400_001)
    values = L(1j * omega)
    assert margins.modulus_margin == pytest.approx(np.abs(1 + values).min(), rel=1e-6)
    changes = np.flatnonzero((np.abs(values[:-1]) - 1) * (np.abs(values[1:]) - 1) < 0)
    assert len(changes) == 2
    angles = np.abs(np.degrees(np.angle(-values[changes])))
    assert margins.phase_margin == pytest.approx(angles.min(), abs=0.05)


def test_margins_print_as_a_table():
    lines = str(cid.loop_margins(ct.tf([2], [1, -1]))).splitlines()
    assert [line.split()[-1] for line in lines] == ["1.732", "60", "inf", "0.5", "1", "0.6046"]
    assert str(cid.loop_margins(ct.tf([0.5], [1, 1]))).startswith("crossover [rad/s]")
    assert "none" in str(cid.loop_margins(ct.tf([0.5], [1, 1])))
    assert (
        str(cid.loop_margins(ct.tf([1], [1, -2]))) == "THE LOOP IS UNSTABLE and so has no margins."
    )


def test_pure_gain_and_integrator_loops():
    margins = cid.loop_margins(2.0)
    assert margins.stable
    assert (margins.gain_margin, margins.delay_margin, margins.modulus_margin) == (math.inf, 0, 3)
    assert cid.loop_margins(ct.tf([-0.5], [1])).gain_margin == 2
    margins = cid.loop_margins(ct.tf([3], [1, 0]))
    assert margins.phase_margin == pytest.approx(90)
    assert margins.crossover == pytest.approx(3)


def test_discrete_integrator_under_gain():
    # z - 1 + k T: stable for k T < 2.
    margins = cid.loop_margins(ct.tf([0.5], [1, -1], 0.1))
    assert margins.gain_margin == pytest.approx(4)


def test_state_space_and_transfer_function_agree():
    L = LOOPS[0]
    first, second = cid.loop_margins(L), cid.loop_margins(ct.ss(L))
    assert first.phase_margin == pytest.approx(second.phase_margin, rel=1e-6)
    assert first.modulus_margin == pytest.approx(second.modulus_margin, rel=1e-6)


def test_nu_gap_of_gains_is_the_chord():
    for a, b in [(1.0, 2.0), (-0.5, 3.0), (0.0, 0.7)]:
        chord = abs(a - b) / math.hypot(1, a) / math.hypot(1, b)
        if 1 + a * b > 0:
            assert cid.nu_gap(a, b) == pytest.approx(chord, rel=1e-12)
    # On opposite points of the Riemann sphere: as far apart as can be.
    assert cid.nu_gap(2.0, -0.5) == pytest.approx(1, rel=1e-12)


def test_nu_gap_known_formulas():
    # 1/s against 1/(s + e): the chord is largest at zero, e/sqrt(1 + e^2), whichever side.
    for e in (0.3, 0.01, -0.01):
        gap = cid.nu_gap(ct.tf([1], [1, 0]), ct.tf([1], [1, e]))
        assert gap == pytest.approx(abs(e) / math.hypot(1, e), rel=1e-9)
    # 1/(s-1) and 1/(s+1): |2|/(w^2+2) is 1 at zero.
    assert cid.nu_gap(ct.tf([1], [1, -1]), ct.tf([1], [1, 1])) == 1
    # k1/s and k2/s meet |k1-k2| w/(w^2+k^2).. at w^2 = k1 k2: |k1-k2|/(k1+k2).
    assert cid.nu_gap(ct.tf([2], [1, 0]), ct.tf([3], [1, 0])) == pytest.approx(1 / 5, rel=1e-9)
    assert cid.nu_gap(ct.tf([2], [1, 0]), ct.tf([-3], [1, 0])) == 1


def test_nu_gap_is_one_where_the_chord_alone_is_small():
    # An all-pass-like pair: similar responses, but one unstable pole more, far from any zero.
    generator = np.random.default_rng(5)
    seen = 0
    for _ in range(200):
        first = random_system(generator, 2, unstable=1, zeros=1)
        second = random_system(generator, 2, unstable=0, zeros=1)
        omega = np.geomspace(1e-4, 1e4, 4001)
        a, b = first(1j * omega), second(1j * omega)
        chord = np.max(np.abs(a - b) / np.hypot(1, np.abs(a)) / np.hypot(1, np.abs(b)))
        if chord < 0.9 and cid.nu_gap(first, second) == 1:
            seen += 1
    assert seen > 3


def winding(values):
    return round(float(np.unwrap(np.angle(values))[[0, -1]] @ [-1, 1]) / (2 * np.pi))


def test_nu_gap_winding_condition_against_counting_turns():
    """wno(1 + P2* P1) + eta(P1) - eta(P2) = 0 by following the phase along the axis."""
    generator = np.random.default_rng(3)
    half = np.geomspace(1e-5, 1e5, 20_001)
    omega = np.concatenate([-half[::-1], half])
    outcomes = []
    for _ in range(200):
        eta = generator.integers(0, 3, size=2)
        first, second = (random_system(generator, 3, unstable=int(k), zeros=2) for k in eta)
        a, b = first(1j * omega), second(1j * omega)
        chord = np.abs(a - b) / np.hypot(1, np.abs(a)) / np.hypot(1, np.abs(b))
        if chord.max() > 0.999:
            continue
        # Vinnicombe's wno counts zeros minus poles on the right: turns going down the axis.
        holds = -winding(1 + b.conj() * a) + eta[0] - eta[1] == 0
        gap = cid.nu_gap(first, second)
        assert (gap < 1) == holds
        if holds:
            assert gap == pytest.approx(chord.max(), abs=1e-4)
        outcomes.append(holds)
    assert 10 < sum(outcomes) < len(outcomes) - 10


@pytest.mark.parametrize("dt", [0.0, 0.02])
def test_nu_gap_is_a_metric(dt):
    generator = np.random.default_rng(8)
    for _ in range(15):
        base = random_system(generator, 3, unstable=1, zeros=1)
        family = [base, base * generator.uniform(1, 1.5), base + generator.uniform(-0.1, 0.1)]
        plants = [ct.c2d(p, dt) if dt else p for p in family]
        gaps = [cid.nu_gap(plants[i], plants[j]) for i, j in [(0, 1), (1, 2), (0, 2)]]
        assert cid.nu_gap(plants[1], plants[0]) == pytest.approx(gaps[0], abs=1e-8)
        assert cid.nu_gap(plants[0], plants[0]) == 0
        assert all(0 <= gap <= 1 for gap in gaps)
        assert gaps[2] <= gaps[0] + gaps[1] + 1e-9


def test_nu_gap_sees_transfer_functions_only():
    P = ct.tf([1], [1, 1])
    hidden = ct.tf([1, -3], np.polymul([1, 1], [1, -3]))
    assert cid.nu_gap(P, hidden) < 1e-9
    P = ct.tf([1], [1, -0.5], 0.1)
    for root in (0.0, 1.0, 0.3):
        hidden = ct.tf([1, -root], np.polymul([1, -0.5], [1, -root]), 0.1)
        assert cid.nu_gap(P, hidden) < 1e-9


@pytest.mark.parametrize("dt", [0.0, 0.02])
def test_small_nu_gap_keeps_the_loop_stable(dt):
    """Vinnicombe: arcsin b(P2, C) >= arcsin b(P1, C) - arcsin gap(P1, P2)."""
    generator = np.random.default_rng(21)
    informative = 0
    for _ in range(50):
        order = int(generator.integers(1, 4))
        P = random_system(generator, order, unstable=int(generator.integers(0, 2)), zeros=0)
        C = random_system(generator, 1)
        num = P.num[0][0] * generator.uniform(0.6, 1.4)
        other = ct.tf(num, P.den[0][0] * generator.uniform(0.7, 1.3, order + 1))
        if dt:
            P, C, other = (ct.c2d(x, dt) for x in (P, C, other))
        b, gap = cid.robust_margin(P, C), cid.nu_gap(P, other)
        after = cid.robust_margin(other, C)
        assert (b > 0) == closed_loop_stable(P * C)
        if b > gap:
            informative += 1
            assert closed_loop_stable(other * C)
        assert math.asin(after) >= math.asin(b) - math.asin(gap) - 1e-6
    assert informative > 5


def test_robust_margin_is_the_norm_it_is_defined_by():
    generator = np.random.default_rng(2)
    checked = 0
    while checked < 15:
        P = random_system(generator, 2, unstable=1, zeros=0)
        C = random_system(generator, 2)
        if not closed_loop_stable(P * C):
            continue
        omega = np.geomspace(1e-7, 1e8, 60_001)
        for _ in range(2):  # the second time around the peak of the first
            p, c = P(1j * omega), C(1j * omega)
            blocks = np.array([[p * c, p], [c, np.ones_like(p)]]) / (1 + p * c)
            sizes = np.linalg.svd(np.moveaxis(blocks, 2, 0), compute_uv=False)[:, 0]
            norm, peak = sizes.max(), omega[sizes.argmax()]
            omega = np.linspace(0.998 * peak, 1.002 * peak, 20_001)
        b = cid.robust_margin(P, C)
        assert b <= 1 / norm + 1e-12
        assert b == pytest.approx(1 / norm, rel=1e-4)
        # What b promises of the classical margins (Vinnicombe).
        margins = cid.loop_margins(P * C)
        assert margins.gain_margin >= (1 + b) / (1 - b) - 1e-9
        assert margins.gain_reduction_margin <= (1 - b) / (1 + b) + 1e-9
        assert margins.phase_margin >= 2 * math.degrees(math.asin(b)) - 1e-9
        checked += 1


def test_robust_margin_known_values_and_unstable_loops():
    assert cid.robust_margin(ct.tf([1], [1, 0]), 1) == pytest.approx(1 / math.sqrt(2), rel=1e-9)
    assert cid.robust_margin(0, ct.tf([1], [1, 1])) == pytest.approx(1 / math.sqrt(2), rel=1e-9)
    assert cid.robust_margin(ct.tf([1], [1, -1]), 0.5) == 0
    # The best any controller reaches for 1/s is known: 1/sqrt(2).
    for k in (0.2, 0.7, 1.5, 5.0):
        assert cid.robust_margin(ct.tf([1], [1, 0]), k) < 1 / math.sqrt(2)
    assert cid.robust_margin(ct.tf([0.1], [1, -1], 0.1), 2.0) > 0


P = ct.tf([1], [1, 1])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: cid.loop_margins("P"), "L is a str; needed is a linear system"),
        (lambda: cid.loop_margins(ct.nlsys(None, lambda t, x, u, params: u)), "linearize it first"),
        (lambda: cid.loop_margins(ct.ss([], [], [], np.eye(2))), "2 inputs and 2 outputs"),
        (lambda: cid.loop_margins(ct.tf([1], [1, -0.5], True)), "no sampling period"),
        (lambda: cid.loop_margins(ct.tf([1, 0, 1], [1, 1])), "L is improper .degree 2 over 1."),
        (lambda: cid.loop_margins(ct.tf([np.nan], [1, 1])), "NaN or infinite"),
        (lambda: cid.nu_gap(P, ct.c2d(P, 0.1)), "P1 and P2 have different time bases"),
        (lambda: cid.robust_margin(P, ct.c2d(P, 0.1)), "P and C have different time bases"),
        (lambda: cid.robust_margin(P, None), "C is a NoneType"),
    ],
)
def test_refusals_say_what_is_needed(call, words):
    with pytest.raises(cid.CtrlidError, match=words):
        call()


@pytest.mark.parametrize("ratio", [1e7, 1e9, 1e12])
@pytest.mark.parametrize("slow", [1e-5, 3.0])
def test_the_slowest_mode_counts_beside_one_that_is_far_faster(ratio, slow):
    """A lag of gain two crosses over at sqrt(3) of its corner, with 120 degrees of phase margin."""
    fast = ct.tf([slow * ratio], [1, slow * ratio])
    margins = cid.loop_margins(ct.tf([2 * slow], [1, slow]) * fast)
    assert margins.crossover == pytest.approx(math.sqrt(3) * slow, rel=1e-6)
    assert margins.phase_margin == pytest.approx(120, abs=1e-4)
    P, C = ct.tf([50 * slow], [1, slow]), ct.tf([0.2, 0.4 * slow], [1, 0]) * fast
    omega = slow * np.geomspace(1e-4, 1e4, 40_001)
    p, c = P(1j * omega), C(1j * omega)
    share = np.abs(1 + p * c) / np.hypot(1, np.abs(p)) / np.hypot(1, np.abs(c))
    # Far above the fastest mode both gains are zero, where the share is one.
    assert cid.robust_margin(P, C) == pytest.approx(share.min(), rel=1e-5)


def test_the_nu_gap_is_a_maximum_wherever_the_grid_has_two_points_for_one():
    rng = np.random.default_rng(4)
    for _ in range(60):
        pole, gain = 10.0 ** rng.uniform(-4, -2), 10.0 ** rng.uniform(-5, 0)
        plants = [
            ct.tf([gain * rng.uniform(0.8, 1.2)],
                  [1, pole * rng.uniform(0.9, 1.1), -(pole**2) * rng.uniform(0.01, 0.1)])
            for _ in range(2)
        ]  # fmt: skip
        omega = pole * np.geomspace(1e-4, 1e5, 30_001)
        first, second = (P(1j * omega) for P in plants)
        gap = np.abs(first - second) / np.hypot(1, np.abs(first)) / np.hypot(1, np.abs(second))
        found = cid.nu_gap(*plants)
        assert found == 1 or found >= gap.max() * (1 - 1e-9)
        assert found == 1 or found <= gap.max() * (1 + 1e-3)
