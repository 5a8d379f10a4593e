"""Alignment: made clouds, shifted, scaled and turned by what is known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from splatseed.errors import PointCloudError
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.seeding.alignment import align as align_module, coarse
from splatseed.seeding.alignment.align import align
from splatseed.seeding.alignment.coarse import spread_rotations
from splatseed.similarity import Similarity

MOVE = Similarity(0.37, spread_rotations(500)[321], np.array([5.6e5, 5.9e6, -80.0]))
QUICK = (
    (60, 150, 10, 0.25, 0.04, 0.04, 0.75),
    (6, 600, 15, 0.1, 0.02, 0.02, 0.75),
    (3, 1500, 40, 0.04, 0.005, 0.01, 0.75),
)
"""Fewer tries than for real clouds, as tests must be quick."""


def place(rng, num):
    """A room without symmetry: floor, two walls, a table, a ball."""
    sheets = {
        "floor": ((0, 0, 0), (6, 0, 0), (0, 4, 0)),
        "wall": ((0, 0, 0), (6, 0, 0), (0, 0, 2.5)),
        "other": ((0, 0, 0), (0, 4, 0), (0, 0, 2.5)),
        "end": ((6, 1, 0), (0, 3, 0), (0, 0, 1.2)),
        "table": ((1, 1, 0.8), (1.7, 0.3, 0), (-0.2, 0.9, 0)),
        "side": ((1, 1, 0), (1.7, 0.3, 0), (0, 0, 0.8)),
    }
    parts = []
    for corner, first, second in sheets.values():
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
def made(tmp_path_factory):
    """A scene of noisy points, a tenth of them wrong, and a cloud of the same place."""
    rng = np.random.default_rng(11)
    marks = place(rng, 1500)
    marks += 0.005 * rng.standard_t(3, marks.shape)
    marks[::10] += rng.normal(size=marks[::10].shape)
    dense = place(rng, 40_000)
    folder = tmp_path_factory.mktemp("clouds")
    np.savez(folder / "moved.npz", xyz=MOVE.points(dense), rgb=shades(dense))
    return SimpleNamespace(
        scene=Scene(PointCloud(marks, shades(marks))), marks=marks, dense=dense, folder=folder
    )


@pytest.mark.slow
def test_a_cloud_that_is_shifted_scaled_and_turned(made):
    found = align(made.scene, [made.folder / "moved.npz"])
    back = found.scene_from_cloud.points(MOVE.points(made.dense))
    assert np.linalg.norm(back - made.dense, axis=1).max() < 0.005  # metres
    turn = found.scene_from_cloud.rotation @ MOVE.rotation
    assert np.degrees(np.arccos(min(1.0, (np.trace(turn) - 1) / 2))) < 0.1
    assert found.share > 0.5
    assert found.likeness > 0.5
    assert found.error < 0.003 * found.extent
    np.testing.assert_allclose(
        np.array(found.report["matrix"])[:3] @ np.append(MOVE.translation, 1.0),
        found.scene_from_cloud.points(MOVE.translation[None])[0],
        atol=1e-6,
    )


@pytest.fixture
def few_starts(monkeypatch):
    """What is refused is refused after fewer tries as well."""
    monkeypatch.setattr(coarse, "ROTATIONS", 150)
    monkeypatch.setattr(coarse, "BEST", 2)
    monkeypatch.setattr(align_module, "ROUNDS", QUICK)


def refused(made, xyz, match, rgb=None):
    np.savez(made.folder / "bad.npz", xyz=xyz, **({} if rgb is None else {"rgb": rgb}))
    with pytest.raises(PointCloudError, match=match):
        align(made.scene, [made.folder / "bad.npz"])


def test_another_place_is_refused(made, rng, few_starts):
    other = np.concatenate(
        [(2, 0, 1) * rng.normal(size=(4000, 3)) + rng.normal(size=3) * 3 for _ in range(6)]
    )
    refused(made, other, "one alignment of the cloud that is sure")


def test_a_box_that_looks_alike_from_several_sides_is_refused(made, rng, few_starts):
    def box(num):
        xyz = rng.uniform(-1, 1, (num, 3)) * (3, 2, 1)
        axis = rng.integers(0, 3, num)
        xyz[np.arange(num), axis] = np.sign(xyz[np.arange(num), axis]) * np.array([3, 2, 1])[axis]
        return xyz

    scene = Scene(PointCloud(box(2000), np.zeros((2000, 3), np.uint8)))
    refused(SimpleNamespace(scene=scene, folder=made.folder), box(30000), "several that fit")


def test_too_few_points_are_refused(made):
    refused(made, made.dense[:500], "at least 1,000 points apart")
    few = SimpleNamespace(scene=Scene(made.scene.points.select(slice(50))), folder=made.folder)
    refused(few, made.dense, "at least 200 points of the scene's own")


def degrees_between(first, second):
    cosines = (np.einsum("nij,ij->n", first, second) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosines, -1, 1)))


def test_orientations_between_those_spread_are_tried(made):
    spread = spread_rotations(coarse.ROTATIONS)
    some = Rotation.random(1000, random_state=0).as_matrix()
    farthest = max(some, key=lambda each: degrees_between(spread, each).min())
    assert degrees_between(spread, farthest).min() > 13
    marks = coarse.to_unit_size(made.marks).points(made.marks)
    turned = made.dense @ farthest.T
    starts = coarse.find_starts(coarse.to_unit_size(turned).points(turned), marks, 5)
    assert degrees_between(starts.rotation, farthest).min() < 8


@settings(max_examples=30, deadline=None)
@given(num=st.integers(1, 400))
def test_spread_rotations_are_rotations(num):
    R = spread_rotations(num)
    np.testing.assert_allclose(
        R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
