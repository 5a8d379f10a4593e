"""The numbers of ``splatseed info`` against brute force on small clouds."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.camera import Intrinsics
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, Tracks
from splatseed.seeding.diagnostics import (
    CloudStatistics,
    EmptyRegions,
    cloud_statistics,
    empty_regions,
    find_problems,
    track_statistics,
)

SHARES = [5, 25, 50, 75, 95]


def _scene(xyz, **parts):
    xyz = np.asarray(xyz, np.float32).reshape(-1, 3)
    return Scene(PointCloud(xyz, np.zeros(xyz.shape, np.uint8)), **parts)


def _brute_spacing(xyz):
    """Mean distance of every distinct point to its 6 nearest, by all pairs."""
    distinct = np.unique(xyz.astype(np.float64), axis=0)
    distances = np.linalg.norm(distinct[:, None] - distinct, axis=2)
    return np.sort(distances, axis=1)[:, 1:7].mean(axis=1)


def test_counts_spacing_and_bounds(rng):
    xyz = rng.normal(size=(200, 3)).astype(np.float32)
    xyz[10:15] = xyz[0]
    scene = _scene(np.concatenate([xyz, [[np.nan, 0, 0], [0, np.inf, 0]]]))
    statistics = cloud_statistics(scene)
    assert (statistics.num_points, statistics.non_finite, statistics.duplicates) == (202, 2, 5)
    np.testing.assert_allclose(
        statistics.spacing, np.percentile(_brute_spacing(xyz), SHARES), rtol=1e-6
    )
    np.testing.assert_array_equal(statistics.low, xyz.min(axis=0))
    np.testing.assert_array_equal(statistics.high, xyz.max(axis=0))


def test_a_point_far_from_a_cluster_is_isolated(rng):
    grid = np.stack(np.meshgrid(*[np.arange(10.0)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    grid += 0.01 * rng.normal(size=grid.shape)
    assert cloud_statistics(_scene(grid)).isolated == 0
    strays = [[40, 40, 40], [-60, 0, 50]]
    assert cloud_statistics(_scene(np.concatenate([grid, strays]))).isolated == 2


@pytest.mark.parametrize("far", [1.0, 1e3, 5e6])
def test_resolution_is_the_step_to_the_next_float32(far):
    statistics = cloud_statistics(_scene([[0, 0, 0], [0, -far, 0]]))
    next_one = np.nextafter(np.float32(far), np.float32(np.inf))
    assert statistics.resolution == float(next_one) - far


@pytest.mark.parametrize("xyz", [np.zeros((0, 3)), np.full((3, 3), np.nan)])
def test_clouds_of_nothing_have_no_measures(xyz):
    statistics = cloud_statistics(_scene(xyz))
    assert (statistics.num_points, statistics.non_finite) == (len(xyz), len(xyz))
    assert np.isnan([*statistics.spacing, *statistics.low, *statistics.high]).all()


def test_tracks(rng):
    lengths, errors = rng.integers(2, 9, 40), rng.random(40)
    errors[::5] = -1  # unknown
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    seen = np.zeros(offsets[-1], np.uint32)
    xyz = rng.random((40, 3))
    statistics = track_statistics(
        _scene(xyz, tracks=Tracks(np.arange(40), xyz, errors, offsets, seen, seen))
    )
    known = [error for error in errors if error >= 0]
    assert statistics.mean_length == pytest.approx(sum(lengths) / 40)
    assert statistics.mean_error == pytest.approx(sum(known) / len(known))
    np.testing.assert_allclose(statistics.length, np.percentile(lengths, SHARES))
    np.testing.assert_allclose(statistics.error, np.percentile(known, SHARES))
    assert track_statistics(_scene(xyz)) is None


def _image(name, size=(320, 200)):
    intrinsics = Intrinsics(1, "PINHOLE", *size, (100.0, 100.0, size[0] / 2, size[1] / 2))
    return Image(name, 1, intrinsics, np.array([1.0, 0, 0, 0]), np.zeros(3))


def _brute_empty(xyz, size, cell):
    """Share of square cells that no point falls in, one point at a time."""
    hit = set()
    for x, y, z in np.asarray(xyz, float):
        u, v = 100 * x / z + size[0] / 2, 100 * y / z + size[1] / 2
        if z > 0 and 0 <= u < size[0] and 0 <= v < size[1]:
            hit.add((int(u // cell), int(v // cell)))
    columns, rows = -(-size[0] // cell), -(-size[1] // cell)
    return 1 - len(hit) / (columns * rows)


@pytest.mark.parametrize("size", [(320, 200), (200, 320)])
def test_empty_regions(size, rng):
    xyz = rng.normal(size=(300, 3)).astype(np.float32)  # half of them behind the camera
    turned = Image("b.png", 2, _image("", size).intrinsics, np.array([0.0, 1, 0, 0]), np.zeros(3))
    regions = empty_regions(_scene(xyz, images=(_image("a.png", size), turned)))
    shares = [_brute_empty(xyz, size, 10), _brute_empty(xyz * [1, -1, -1], size, 10)]
    assert regions.mean == pytest.approx(np.mean(shares))
    assert regions.worst == pytest.approx(max(shares))
    assert regions.worst_name == ["a.png", "b.png"][int(np.argmax(shares))]


def _statistics(num_points, isolated, duplicates=0):
    three, five = (0.0,) * 3, (1.0,) * 5
    return CloudStatistics(num_points, 0, duplicates, isolated, five, three, three, 0.0)


def test_problems_are_told_and_the_readers_come_first(rng):
    scene = _scene(rng.random((5, 3)), warnings=("The reader's.",))
    sound = find_problems(scene, _statistics(1000, 1), EmptyRegions(0.1, 0.9, "a"))
    assert sound == ("The reader's.",)
    first, *others = find_problems(scene, _statistics(1000, 100), EmptyRegions(0.8, 0.9, "a"))
    assert first == "The reader's."
    assert [text.split()[0] for text in others] == ["100", "80%"]
    # Not only those with surfaces: linear and triangle reject isolated points too.
    assert "methods that interpolate start nothing from them" in others[0]
    (repeats,) = find_problems(_scene(rng.random((5, 3))), _statistics(1000, 100, 200), None)
    assert repeats.startswith("100 points (12.5%)")  # of those that are left
    assert "no points" in find_problems(_scene([]), _statistics(0, 0), None)[0]
