"""Samples that count: stretches, and rows whose whole past counts, against counting one by one."""

import itertools

import numpy as np
import pytest

from ctrlid.data.validity import find_runs, find_whole_past


@pytest.mark.parametrize("lags", [0, 1, 4, 29, 30, 31])
@pytest.mark.parametrize("seed", range(4))
def test_a_row_counts_where_every_sample_of_its_past_does(lags, seed):
    valid = np.random.default_rng(seed).random(30) < (0.5, 0.8, 1.0, 0.0)[seed]
    expected = [k >= lags and bool(valid[k - lags : k + 1].all()) for k in range(30)]
    assert find_whole_past(valid, lags).tolist() == expected


@pytest.mark.parametrize("mask", [[], [0, 0], [1, 1], [1, 0, 0, 1, 1, 0, 1]])
def test_stretches_are_told_by_their_first_sample_and_their_end(mask):
    runs = list(zip(*find_runs(np.array(mask, dtype=bool)), strict=True))
    inside = [k for first, stop in runs for k in range(first, stop)]
    assert inside == np.flatnonzero(mask).tolist()
    assert all(a[1] < b[0] for a, b in itertools.pairwise(runs))
