"""Excitation signals: levels, holds, spectra, repeats and refusals."""

import numpy as np
import pytest

import ctrlid as cid


def test_random_binary_has_two_levels_and_keeps_each_toss() -> None:
    r = cid.random_binary(45_000, amplitude=1e-4, hold=20, around=0.012, seed=1)
    assert r.shape == (45_000,)
    assert r.dtype == np.float64
    np.testing.assert_allclose(np.unique(r), [0.0119, 0.0121], rtol=1e-14)
    assert np.all(r.reshape(-1, 20) == r[::20, None])
    assert abs(np.mean(r > 0.012) - 0.5) < 0.05  # 2250 tosses: five standard deviations


def test_random_binary_is_a_function_of_its_seed() -> None:
    first = cid.random_binary(100, amplitude=1, seed=3)
    np.testing.assert_array_equal(first, cid.random_binary(100, amplitude=1, seed=3))
    assert np.any(first != cid.random_binary(100, amplitude=1, seed=4))
    generator = np.random.default_rng(3)
    np.testing.assert_array_equal(first, cid.random_binary(100, amplitude=1, seed=generator))


def test_random_binary_length_need_not_divide_by_hold() -> None:
    whole = cid.random_binary(12, amplitude=1, hold=4, seed=0)
    np.testing.assert_array_equal(whole[:10], cid.random_binary(10, amplitude=1, hold=4, seed=0))


def test_steps_repeat_their_levels() -> None:
    r = cid.staircase(9, levels=(1.0, 2.0), hold=3)
    np.testing.assert_array_equal(r, [1, 1, 1, 2, 2, 2, 1, 1, 1])


@pytest.mark.parametrize("phases", ["schroeder", "random"])
@pytest.mark.parametrize("period", [100, 101])
def test_multisine_is_flat_in_its_band_and_silent_outside(phases: str, period: int) -> None:
    r = cid.multisine(
        3 * period, amplitude=0.2, period=period, band=(0.1, 0.6), phases=phases, around=5.0, seed=1
    )
    np.testing.assert_array_equal(r[:period], r[period : 2 * period])
    assert np.max(np.abs(r - 5.0)) == pytest.approx(0.2, rel=1e-12)
    size = np.abs(np.fft.rfft(r[:period] - 5.0))
    share = np.arange(len(size)) * 2 / period
    inside = (share >= 0.1 - 1e-9) & (share <= 0.6 + 1e-9)
    np.testing.assert_allclose(size[inside], size[inside][0], rtol=1e-9)
    assert np.max(size[~inside]) < 1e-12


def test_multisine_default_excites_all_lines_but_the_constant_and_nyquist() -> None:
    size = np.abs(np.fft.rfft(cid.multisine(64, amplitude=1.0)))
    assert np.all(size[1:-1] > 0.1)
    assert max(size[0], size[-1]) < 1e-12


def test_schroeder_phases_pack_more_power_than_random_ones() -> None:
    smooth = np.std(cid.multisine(1000, amplitude=1.0, band=(0, 0.5)))
    drawn = [
        np.std(cid.multisine(1000, amplitude=1.0, band=(0, 0.5), phases="random", seed=k))
        for k in range(20)
    ]
    assert smooth > max(drawn)
    assert smooth > 0.55  # crest factor below 1.8


@pytest.mark.parametrize("order", list(range(2, 21)))
def test_prbs_has_maximum_length_and_a_flat_spectrum(order: int) -> None:
    length = 2**order - 1
    r = cid.prbs(2 * length, amplitude=1.0, order=order)
    np.testing.assert_array_equal(r[:length], r[length:])
    assert r[:length].sum() == 1
    # The autocorrelation is two-valued, so every line but the constant has power length + 1.
    power = np.abs(np.fft.rfft(r[:length])) ** 2
    np.testing.assert_allclose(power[1:], length + 1, rtol=1e-6)


def test_prbs_hold_levels_and_seed() -> None:
    r = cid.prbs(20, amplitude=0.5, order=4, hold=3, around=2.0)
    assert set(r) == {1.5, 2.5}
    assert np.all(r[:18].reshape(-1, 3) == r[:18:3, None])
    whole = cid.prbs(15, amplitude=1.0, order=4)
    other = cid.prbs(15, amplitude=1.0, order=4, seed=9)
    assert any(np.array_equal(np.roll(whole, k), other) for k in range(1, 15))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: cid.random_binary(0, amplitude=1), "n is 0; needed is a whole number"),
        (lambda: cid.random_binary(1.5, amplitude=1), "n is 1.5"),
        (lambda: cid.random_binary(True, amplitude=1), "n is True"),
        (lambda: cid.random_binary(5, amplitude=-1), "amplitude is -1; needed is a number above 0"),
        (lambda: cid.random_binary(5, amplitude=np.nan), "amplitude is nan"),
        (lambda: cid.random_binary(5, amplitude="big"), "amplitude is 'big'"),
        (lambda: cid.random_binary(5, amplitude=1, hold=0), "hold is 0"),
        (
            lambda: cid.random_binary(5, amplitude=1, around=np.inf),
            "around is inf; needed is a fin",
        ),
        (lambda: cid.random_binary(5, amplitude=1, seed=-1), "seed is -1"),
        (lambda: cid.random_binary(5, amplitude=1, seed=0.5), "seed is 0.5"),
        (lambda: cid.staircase(5, levels=[], hold=1), r"levels is \[\]; needed is a list"),
        (lambda: cid.staircase(5, levels=[1, np.nan], hold=1), "levels is"),
        (lambda: cid.staircase(5, levels="ab", hold=1), "levels is 'ab'"),
        (lambda: cid.multisine(50, amplitude=1, band=(0.5, 0.2)), r"band is \(0.5, 0.2\)"),
        (lambda: cid.multisine(50, amplitude=1, band=0.5), "band is 0.5; needed are two shares"),
        (lambda: cid.multisine(50, amplitude=1, band=(0.001, 0.002)), "no line of a period of 50"),
        (lambda: cid.multisine(50, amplitude=1, phases="zero"), "phases is 'zero'"),
        (lambda: cid.multisine(50, amplitude=1, period=0), "period is 0"),
        (lambda: cid.prbs(50, amplitude=1, order=1), "order is 1; needed is a number of stages"),
        (lambda: cid.prbs(50, amplitude=1, order=4, seed=16), "seed is 16; needed for order 4"),
        (lambda: cid.prbs(50, amplitude=1, order=4, seed=0), "seed is 0"),
    ],
)
def test_refusals_say_what_is_needed(call, words) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(cid.CtrlidError, match=words):
        call()
