"""Co-visible pixels: as the true depth of a made scene has them, and from the capture alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch", reason="scoring needs PyTorch")

from splatseed.photos.view import camera_views
from splatseed.pointcloud import PointCloud
from splatseed.splat.covisible import find_covisible, pixel_masks, read_covisible, write_covisible


def _truth(depths, view, train):
    """Which pixels of a view at least two training views see, by the true depth maps."""
    v, u = np.indices((view.height, view.width)).reshape(2, -1) + 0.5
    xyz = view.camera.unproject(np.stack([u, v], axis=1), depths[view.name].ravel())
    count = np.zeros(u.size, int)
    for other in train:
        uv, z = other.camera.project(xyz)
        inside = (z > 0) & ((uv >= 0) & (uv < [other.width, other.height])).all(axis=1)
        j, i = np.where(inside[:, None], uv, 0).astype(int).T
        count += inside & (depths[other.name][i, j] > 0.95 * z)
    return (count >= 2).reshape(view.height, view.width)


def test_covisible_pixels_match_the_true_depth_and_round_trip(sixteen_views, tmp_path):
    capture, scene = sixteen_views
    train, test = (camera_views(part) for part in scene.split(8))
    depths = {i.name: depth for i, depth in zip(scene.images, capture.depths, strict=True)}
    write_covisible(tmp_path / "a.npz", find_covisible(scene, 8))
    masks = pixel_masks(read_covisible(tmp_path / "a.npz"), test)
    agree = [(masks[v.name] == _truth(depths, v, train)).mean() for v in test]
    assert np.mean(agree) > 0.9
    (tmp_path / "a.npz").write_bytes(b"PK nonsense")
    assert read_covisible(tmp_path / "a.npz") is None
    assert read_covisible(tmp_path / "none.npz") is None


@pytest.mark.parametrize("kind", ["rgbd", "phone"])
def test_a_sensors_depth_needs_no_points(sixteen_views, kind):
    capture, scene = sixteen_views
    train, test = (camera_views(part) for part in scene.split(8))
    depths = {i.name: depth for i, depth in zip(scene.images, capture.depths, strict=True)}
    bare = scene.replace(points=PointCloud.empty())
    assert find_covisible(bare.with_depths(depths), 8) == {}
    sensed = bare.replace(source=replace(scene.source, format=kind)).with_depths(depths)
    masks = pixel_masks(find_covisible(sensed, 8), test)
    agree = [(masks[v.name] == _truth(depths, v, train)).mean() for v in test]
    assert np.mean(agree) > 0.95


def test_pixels_without_training_views_are_excluded(sixteen_views):
    """With the training cameras turned away nothing is co-visible."""
    _, scene = sixteen_views
    train, test = scene.split(8)
    turned = []
    for image in train:  # half a turn about y, in camera axes
        w, x, y, z = image.quat
        translation = image.translation * np.array([-1, 1, -1])
        turned.append(replace(image, quat=np.array([-y, z, w, -x]), translation=translation))
    assert np.allclose(turned[0].camera.center, train[0].camera.center, atol=1e-6)
    before, after = (
        np.mean([grid.mean() for grid in find_covisible(each, 8).values()])
        for each in (scene, scene.replace(images=(*turned, *test)))
    )
    assert after < 0.5 * before
