"""Spreading: one point a cube, held to a dictionary of cubes."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.depth.candidates import _Cubes, thin_by_voxels


def sheet(rng, num):
    """Points on a bent sheet 2 wide, dense on its left."""
    u, v = rng.random((2, num)) ** [[2], [1]] * 2
    return np.stack([u, v, 0.2 * np.sin(3 * u)], axis=1).astype(np.float32)


def spread(xyz, num, rng, originals=None, footprint=None):
    """Indices of the chosen, by default with nothing to tell candidates apart."""
    every = np.ones(len(xyz), bool)
    footprint = every.astype(np.float32) if footprint is None else footprint
    originals = xyz[:0] if originals is None else originals
    return np.flatnonzero(thin_by_voxels(xyz, footprint, every, originals, num, rng))


def reference(xyz, footprint, originals, side):
    """The finest candidate of every cube without an original, one by one."""
    low = xyz.min(axis=0).astype(np.float64)
    there = {tuple(np.floor((p - low) / side)) for p in originals.astype(np.float64)}
    best: dict[tuple[float, ...], int] = {}
    for k, point in enumerate(xyz.astype(np.float64)):
        cube = tuple(np.floor((point - low) / side))
        if cube not in there and (cube not in best or footprint[k] < footprint[best[cube]]):
            best[cube] = k
    return sorted(best.values())


@given(st.integers(0, 2**32 - 1), st.floats(0.003, 3.0))
@settings(max_examples=30, deadline=None)
def test_cubes_are_those_of_a_dictionary(seed, side):
    rng = np.random.default_rng(seed)
    xyz, originals = sheet(rng, 400), rng.normal(size=(60, 3)).astype(np.float32)
    footprint = rng.integers(0, 5, 400).astype(np.float32)  # ties, which the first wins
    cubes = _Cubes(xyz, footprint, np.ones(400, bool), originals)
    expected = reference(xyz, footprint, originals, side)
    assert np.flatnonzero(cubes.take(side)).tolist() == expected
    assert cubes.count(side) == len(expected)


@pytest.mark.parametrize("num", [1, 7, 500, 4000, 5000])
def test_exactly_so_many_come_out(num, rng):
    xyz = sheet(rng, 5000)
    chosen = spread(xyz, num, rng)
    assert len(chosen) == num == len(np.unique(chosen))
    assert (np.diff(chosen) > 0).all()


def test_many_candidates_are_estimated_from_some(rng):
    xyz = rng.random((100_000, 3)).astype(np.float32)
    every = np.ones(100_000, bool)
    cubes = _Cubes(xyz, every.astype(np.float32), every, xyz[:0])
    for side in (0.5, 0.02, 0.001):
        exact = np.count_nonzero(cubes.take(side))
        assert cubes.count(side) == pytest.approx(exact, rel=0.05, abs=40)
    chosen = spread(xyz, 20_000, rng)
    assert len(chosen) == 20_000


def test_threads_do_not_matter(rng):
    xyz = sheet(rng, 80_000)
    footprint = rng.random(80_000).astype(np.float32)
    available, results = numba.config.NUMBA_NUM_THREADS, []
    try:
        for threads in (1, available):
            numba.set_num_threads(threads)
            results.append(
                spread(xyz, 9000, np.random.default_rng(1), xyz[:100], footprint).tobytes()
            )
    finally:
        numba.set_num_threads(available)
    assert len(set(results)) == 1
