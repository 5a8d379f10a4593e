"""Spreading candidates in space: one per cube, the finest."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.depth.thinning import Cubes, spread_evenly


def sheet(rng, num):
    """Points on a bent sheet 2 wide, dense on its left."""
    u, v = rng.random((2, num)) ** [[2], [1]] * 2
    return np.stack([u, v, 0.2 * np.sin(3 * u)], axis=1).astype(np.float32)


@given(st.integers(0, 2**32 - 1), st.floats(0.003, 3.0))
@settings(max_examples=30, deadline=None)
def test_cubes_equal_those_of_a_dictionary(seed, side):
    rng = np.random.default_rng(seed)
    xyz, originals = sheet(rng, 400), rng.normal(size=(60, 3)).astype(np.float32)
    footprint = rng.integers(0, 5, 400).astype(np.float32)  # ties, which the first wins
    low = xyz.min(axis=0).astype(np.float64)
    there = {tuple(np.floor((p - low) / side)) for p in originals.astype(np.float64)}
    best = {}
    for k, point in enumerate(xyz.astype(np.float64)):
        cube = tuple(np.floor((point - low) / side))
        if cube not in there and (cube not in best or footprint[k] < footprint[best[cube]]):
            best[cube] = k
    cubes = Cubes(xyz, footprint, np.ones(400, bool), originals)
    assert np.flatnonzero(cubes.take(side)).tolist() == sorted(best.values())
    assert cubes.count(side) == len(best)


@pytest.mark.parametrize("num", [1, 7, 500, 4000, 5000, 20_000, 100_000])
def test_spreading_takes_exactly_the_number_and_estimates_large_counts(num, rng):
    total = 5000 if num <= 5000 else 100_000
    xyz, every = sheet(rng, total), np.ones(total, bool)
    taken = spread_evenly(xyz, every.astype(np.float32), every, xyz[:0], num, rng)
    assert np.count_nonzero(taken) == num
    cubes = Cubes(xyz, every.astype(np.float32), every, xyz[:0])
    for side in (0.5, 0.02, 0.001):
        exact = np.count_nonzero(cubes.take(side))
        assert cubes.count(side) == pytest.approx(exact, rel=0.15, abs=40)
