"""Which views confirm a depth, against a loop over pixels."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.depth.stereo.matching import confirm

from .references import agrees

GRID, TOLERANCE, MAX_COST = 4, 0.05, 0.5
BIT = np.uint8(4)


def make_map(rng, rows: int, columns: int):
    """Planes about depth 2 and costs, a fifth of them too high."""
    planes = np.stack(
        [rng.uniform(0.48, 0.52, (rows, columns)), *rng.normal(scale=1e-3, size=(2, rows, columns))]
    )
    costs = np.where(rng.random((rows, columns)) < 0.2, 0.9, 0.1)
    return planes.astype(np.float32), costs.astype(np.float32)


@pytest.fixture
def maps(rng):
    """Two maps of different sizes."""
    return make_map(rng, 12, 15), make_map(rng, 10, 17)


def asked(maps, warp, tolerance=TOLERANCE) -> np.ndarray:
    (planes, costs), (other, other_costs) = maps
    out = np.ones(costs.shape, np.uint8)  # an earlier witness has said something
    confirm(planes, costs, MAX_COST, GRID, warp, other, other_costs, tolerance, BIT, out)
    assert (out & 1).all()
    return (out & BIT) != 0


WARPS = {
    "moved": np.hstack([np.eye(3), [[12.0], [-7.0], [0.02]]]),
    "turned": np.array([[0.9, 0.3, 2.0, 1.0], [-0.3, 0.9, 9.0, 3.0], [0.002, 0.001, 1.0, -0.03]]),
    "behind": np.hstack([-np.eye(3), np.zeros((3, 1))]),
}


@pytest.mark.parametrize("warp", WARPS.values(), ids=WARPS)
def test_it_is_the_loop(warp, maps):
    (planes, costs), (other, other_costs) = maps
    bits = asked(maps, warp)
    for row, column in np.ndindex(costs.shape):
        off = agrees(
            planes, GRID, row, column, warp, np.where(other_costs > MAX_COST, np.nan, other)
        )
        expected = costs[row, column] <= MAX_COST and off <= TOLERANCE
        if abs(off - TOLERANCE) > 1e-5:
            assert bits[row, column] == expected
    if warp is not WARPS["behind"]:
        assert 0.2 < bits.mean() < 0.9
