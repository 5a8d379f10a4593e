"""Which pixels are drawn: known, distinct, off the edges, where SfM found little."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from splatseed.depth.settings import Settings
from splatseed.depth.views import sample_pixels

SHAPE = (60, 80)
NOWHERE = np.empty((0, 2))
PLAIN = Settings(placement="uniform", edge_tolerance=None)


def slanted(rng, holes=0.2):
    """A slanted plane, 1 / depth linear in the image, with holes."""
    row, column = np.indices(SHAPE)
    values = (1.0 / (0.5 + 0.004 * column - 0.003 * row)).astype(np.float32)
    values[rng.random(SHAPE) < holes] = np.nan
    return values


@pytest.mark.parametrize("placement", ["uniform", "empty"])
@pytest.mark.parametrize("num", [1, 100, 3000, 10_000])
def test_pixels_are_known_and_distinct(placement, num, rng):
    values = slanted(rng)
    points = rng.uniform(0, SHAPE[::-1], (40, 2))
    settings = Settings(placement=placement)
    drawn = sample_pixels(values, num, points, settings, rng)
    known = int((values > 0).sum())
    assert min(num, known) <= len(drawn.pixel) <= max(1.2 * num + 2, known)
    assert len(np.unique(drawn.pixel)) == len(drawn.pixel) == len(drawn.edge)
    assert (values.ravel()[drawn.pixel] > 0).all()


@pytest.mark.parametrize("region", [0.5, 0.2])
def test_the_region_is_that_share_of_each_dimension(region, rng):
    values = slanted(rng, holes=0.0)
    settings = Settings(placement="uniform", edge_tolerance=None, region=region)
    pixel = sample_pixels(values, 10_000, NOWHERE, settings, rng).pixel
    row, column = np.divmod(pixel, SHAPE[1])
    assert len(pixel) == round(region * SHAPE[0]) * round(region * SHAPE[1])
    assert np.ptp(row) + 1 == round(region * SHAPE[0])
    assert row.min() + row.max() == SHAPE[0] - 1
    assert column.min() + column.max() == SHAPE[1] - 1


def test_pixels_go_where_points_are_far(rng):
    values = slanted(rng, holes=0.0)
    points = np.stack([rng.uniform(0, 40, 500), rng.uniform(0, 60, 500)], axis=1)  # the left half
    mean = {}
    for placement in ("uniform", "empty"):
        settings = Settings(placement=placement, edge_tolerance=None)
        pixel = sample_pixels(values, 400, points, settings, rng).pixel
        row, column = np.divmod(pixel, SHAPE[1])
        mean[placement] = cKDTree(points).query(np.stack([column, row], axis=1))[0].mean()
        if placement == "empty":
            assert 0 < (column < 40).mean() < 0.35
    assert mean["empty"] > 1.25 * mean["uniform"]


@pytest.mark.parametrize("radius", [1, 3])
def test_pixels_keep_off_the_jumps_of_depth(radius, rng):
    values = slanted(rng, holes=0.0)
    values[:, 40:] *= 1.1
    values[30:, :20] *= 0.9
    settings = Settings(placement="uniform", edge_radius=radius)
    drawn = sample_pixels(values, 1500, NOWHERE, settings, rng)
    row, column = np.divmod(drawn.pixel, SHAPE[1])
    assert not drawn.edge.any()
    assert not ((column >= 40 - radius) & (column < 40 + radius)).any()
    assert not ((row >= 30 + radius) & (column >= 20 - radius) & (column < 20 + radius)).any()
    assert not ((column < 20 - radius) & (row >= 30 - radius) & (row < 30 + radius)).any()
    plain = np.divmod(sample_pixels(values, 1500, NOWHERE, PLAIN, rng).pixel, SHAPE[1])[1]
    assert ((plain >= 40 - radius) & (plain < 40 + radius)).any()


def test_what_is_mostly_unknown_around_comes_last(rng):
    values = slanted(rng, holes=0.0)
    values[:, 40:] = np.nan
    values[::6, 43:79:6] = 2.0  # sparse, as a lidar's
    settings = Settings(placement="uniform")
    known = int((values > 0).sum())
    some = sample_pixels(values, known // 2, NOWHERE, settings, rng)
    assert (some.pixel % 80 < 40).all()
    every = sample_pixels(values, known, NOWHERE, settings, rng)
    assert len(every.pixel) == known
    assert every.edge[every.pixel % 80 > 40].all()
