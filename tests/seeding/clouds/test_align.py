"""Alignment: made clouds, shifted, scaled and turned by what is known."""

from __future__ import annotations

import json

import numpy as np
import pytest

from splatseed.errors import PointCloudError
from splatseed.io.matrices import read_cloud_transform
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.seeding.clouds.align import AlignSettings, align_cloud
from splatseed.seeding.clouds.global_search import SearchSettings, spread_rotations
from splatseed.seeding.clouds.icp import Stage
from splatseed.similarity import Similarity

MOVE = Similarity(0.37, spread_rotations(500)[321], np.array([5.6e5, 5.9e6, -80.0]))
QUICK = AlignSettings(
    search=SearchSettings(rotations=300, refined=4, scales=SearchSettings.scales[1:4]),
    stages=(
        Stage(60, 150, 10, 0.25, 0.04, 0.75, 0.04),
        Stage(6, 600, 15, 0.1, 0.02, 0.75, 0.02),
        Stage(3, 1500, 40, 0.04, 0.005, 0.75, 0.01),
    ),
)
"""Less than real clouds need, as tests must be quick."""


def place(rng, num):
    """A room without symmetry: floor, three walls, a table, a ball."""
    sheets = [
        ((0, 0, 0), (6, 0, 0), (0, 4, 0)),
        ((0, 0, 0), (6, 0, 0), (0, 0, 2.5)),
        ((0, 0, 0), (0, 4, 0), (0, 0, 2.5)),
        ((6, 1, 0), (0, 3, 0), (0, 0, 1.2)),
        ((1, 1, 0.8), (1.7, 0.3, 0), (-0.2, 0.9, 0)),
        ((1, 1, 0), (1.7, 0.3, 0), (0, 0, 0.8)),
    ]
    parts = []
    for corner, first, second in sheets:
        area = np.linalg.norm(np.cross(first, second))
        u, v = rng.random((2, int(num * area / 64), 1))
        parts.append(np.array(corner) + u * np.array(first) + v * np.array(second))
    ball = rng.normal(size=(num // 20, 3))
    parts.append((4.5, 2.8, 0.6) + 0.6 * ball / np.linalg.norm(ball, axis=1, keepdims=True))
    return np.concatenate(parts)


def shades(xyz):
    grey = 128 + 90 * np.sin(3 * xyz[:, 0]) * np.cos(2 * xyz[:, 1] + xyz[:, 2])
    return np.repeat(grey.astype(np.uint8)[:, None], 3, axis=1)


@pytest.fixture(scope="module")
def made():
    """Noisy points of the room, a tenth of them wrong, and many exact ones."""
    rng = np.random.default_rng(11)
    tie_xyz = place(rng, 1500)
    tie_xyz += 0.005 * rng.standard_t(3, tie_xyz.shape)
    tie_xyz[::10] += rng.normal(size=tie_xyz[::10].shape)
    return tie_xyz, place(rng, 40_000)


def aligned(folder, tie_xyz, xyz, settings, **arrays):
    np.savez(folder / "cloud.npz", xyz=xyz, **arrays)
    scene = Scene(PointCloud(tie_xyz, shades(tie_xyz)))
    return align_cloud(scene, [folder / "cloud.npz"], settings=settings)


@pytest.mark.slow
def test_a_cloud_that_is_shifted_scaled_and_turned(made, tmp_path):
    tie_xyz, dense = made
    found = aligned(tmp_path, tie_xyz, MOVE.points(dense), QUICK, rgb=shades(dense))
    back = found.scene_from_cloud.points(MOVE.points(dense))
    assert np.linalg.norm(back - dense, axis=1).max() < 0.005  # metres
    rotation = found.scene_from_cloud.rotation @ MOVE.rotation
    assert np.degrees(np.arccos(min(1.0, (np.trace(rotation) - 1) / 2))) < 0.1
    assert found.inlier_ratio > 0.5
    assert found.brightness_correlation > 0.5
    assert found.error < 0.003 * found.extent
    np.testing.assert_allclose(
        np.array(found.report["matrix"])[:3] @ np.append(MOVE.translation, 1.0),
        found.scene_from_cloud.points(MOVE.translation[None])[0],
        atol=1e-6,
    )
    (tmp_path / "alignment.json").write_text(json.dumps(found.report))
    again = read_cloud_transform(tmp_path / "alignment.json", Scene(PointCloud.empty()))
    np.testing.assert_allclose(again.matrix, found.scene_from_cloud.matrix, rtol=1e-9)


def box(num, rng):
    xyz = rng.uniform(-1, 1, (num, 3)) * (3, 2, 1)
    axis = rng.integers(0, 3, num)
    xyz[np.arange(num), axis] = np.sign(xyz[np.arange(num), axis]) * np.array([3, 2, 1])[axis]
    return xyz


@pytest.mark.parametrize(
    ("case", "found"),
    [
        ("another place", "one reliable alignment"),
        ("a box that looks alike from several sides", "several that fit"),
        ("few points of a cloud", "found 500"),
        ("few points of a scene", "found 50"),
    ],
)
def test_an_unreliable_alignment_is_refused(case, found, made, rng, tmp_path):
    tie_xyz, dense = made
    if case == "another place":
        blobs = [(2, 0, 1) * rng.normal(size=(4000, 3)) + rng.normal(size=3) * 3 for _ in range(6)]
        dense = np.concatenate(blobs)
    elif "box" in case:
        tie_xyz, dense = box(2000, rng), box(30000, rng)
    elif "cloud" in case:
        dense = dense[:500]
    else:
        tie_xyz = tie_xyz[:50]
    with pytest.raises(PointCloudError, match=found):
        aligned(tmp_path, tie_xyz, dense, QUICK)
