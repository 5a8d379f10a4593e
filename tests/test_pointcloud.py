"""PointCloud holds what it was given, and cannot be changed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from splatseed.errors import PointCloudError
from splatseed.pointcloud import ORIGINAL, PointCloud


@pytest.fixture
def cloud(rng):
    rgb = rng.integers(0, 256, (6, 3)).astype(np.uint8)
    return PointCloud(rng.normal(size=(6, 3)), rgb, np.array([0, 0, 4, 0, 4, 1], np.uint8))


def test_types_and_defaults():
    cloud = PointCloud(np.arange(6).reshape(2, 3), np.zeros((2, 3), np.uint8))
    assert (cloud.xyz.dtype, cloud.rgb.dtype, cloud.source.dtype) == (
        np.float32,
        np.uint8,
        np.uint8,
    )
    assert cloud.source.tolist() == [ORIGINAL, ORIGINAL]
    assert (len(cloud), cloud.num_original) == (2, 2)


def test_arrays_are_read_only_and_the_callers_stay_writable():
    xyz, rgb = np.zeros((3, 3), np.float32), np.zeros((3, 3), np.uint8)
    cloud = PointCloud(xyz, rgb)
    for array in (cloud.xyz, cloud.rgb, cloud.source):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        cloud.xyz = xyz
    xyz[0], rgb[0] = 1, 1


def test_arrays_are_contiguous_whatever_comes_in(rng):
    wide = rng.normal(size=(5, 6)).astype(np.float32)
    cloud = PointCloud(wide[:, ::2], np.zeros((3, 5), np.uint8).T)
    assert cloud.xyz.flags.c_contiguous
    assert cloud.rgb.flags.c_contiguous
    np.testing.assert_array_equal(cloud.xyz, wide[:, ::2])


def test_originals_and_new_points_are_told_apart(cloud):
    assert cloud.num_original == 3
    np.testing.assert_array_equal(cloud.originals.xyz, cloud.xyz[[0, 1, 3]])
    assert not cloud.originals.source.any()


@pytest.mark.parametrize(
    "which", [slice(1, 4), np.array([5, 0, 0]), np.arange(6) % 2 == 0, np.zeros(0, int)]
)
def test_select_takes_all_arrays_alike(cloud, which):
    chosen = cloud.select(which)
    np.testing.assert_array_equal(chosen.xyz, cloud.xyz[which])
    np.testing.assert_array_equal(chosen.rgb, cloud.rgb[which])
    np.testing.assert_array_equal(chosen.source, cloud.source[which])


def test_concatenate_undoes_a_cut(cloud):
    whole = PointCloud.concatenate(cloud.select(slice(2)), cloud.select(slice(2, None)))
    for name in ("xyz", "rgb", "source"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(cloud, name))


def test_replace_leaves_the_first_cloud_alone(cloud):
    moved = cloud.replace(xyz=cloud.xyz + 1)
    np.testing.assert_array_equal(moved.xyz, cloud.xyz + 1)
    assert moved.rgb is cloud.rgb or np.array_equal(moved.rgb, cloud.rgb)
    with pytest.raises(PointCloudError):
        cloud.replace(xyz=cloud.xyz[:-1])


def test_finite_needs_all_three():
    xyz = np.array([[0, 0, 0], [0, np.nan, 0], [np.inf, 0, 0], [0, 0, -np.inf]])
    assert PointCloud(xyz, np.zeros((4, 3), np.uint8)).finite.tolist() == [
        True,
        False,
        False,
        False,
    ]


@pytest.mark.parametrize(
    ("xyz", "rgb", "source", "says"),
    [
        (np.zeros((4, 2)), np.zeros((4, 2), np.uint8), None, r"\[4, 2\]"),
        (np.zeros(3), np.zeros(3, np.uint8), None, r"\[3\]"),
        (np.zeros((4, 3), complex), np.zeros((4, 3), np.uint8), None, "complex"),
        (np.zeros((4, 3), bool), np.zeros((4, 3), np.uint8), None, "bool"),
        (np.full((4, 3), "a"), np.zeros((4, 3), np.uint8), None, "xyz as numbers"),
        (np.zeros((4, 3)), np.zeros((4, 3)), None, "float64"),
        (np.zeros((4, 3)), np.zeros((3, 3), np.uint8), None, r"found uint8 \[3, 3\]"),
        (np.zeros((4, 3)), np.zeros((4, 3), np.uint8), np.zeros(3, np.uint8), "one code a point"),
    ],
)
def test_arrays_that_do_not_fit(xyz, rgb, source, says):
    with pytest.raises(PointCloudError, match=says):
        PointCloud(xyz, rgb, source)


def test_distinct_points_are_finite_and_the_first_at_their_position(rng):
    xyz = rng.integers(-2, 3, (500, 3)).astype(np.float32)
    xyz[xyz == 0] *= rng.choice(np.array([1, -1], np.float32), np.count_nonzero(xyz == 0))
    xyz[::50, 0] = np.nan
    xyz[::70, 2] = np.inf
    cloud = PointCloud(xyz, np.zeros((500, 3), np.uint8))
    seen: set[tuple[float, ...]] = set()
    for i, row in enumerate(map(tuple, xyz.tolist())):
        assert cloud.distinct[i] == (np.isfinite(row).all() and row not in seen)
        seen.add(row)
    assert not cloud.select(slice(0, 0)).distinct.size
