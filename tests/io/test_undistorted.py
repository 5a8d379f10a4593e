"""Depth maps of photographs that have been undistorted since."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.camera import Intrinsics
from splatseed.errors import SceneFormatError
from splatseed.io import find_depths
from splatseed.io.depth_maps import LENSES, write_lenses
from splatseed.io.load import with_depths_in
from splatseed.lens import project_rays
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, SceneSource

from ..findings import texts

BENT = Intrinsics(1, "OPENCV", 80, 60, (70.0, 72.0, 40.0, 30.0, -0.2, 0.0, 0.0, 0.0))
STRAIGHT = Intrinsics(1, "PINHOLE", 86, 62, (70.0, 72.0, 43.0, 31.0))


@pytest.fixture
def scene(tmp_path):
    """Undistorted photographs, the last of which had no distortion."""
    pose = (np.array([1.0, 0, 0, 0]), np.zeros(3))
    lenses = {"a.jpg": STRAIGHT, "b.jpg": replace(BENT.pinhole, camera_id=2)}
    images = tuple(Image(name, i, lens, *pose) for i, (name, lens) in enumerate(lenses.items()))
    write_lenses(tmp_path, {"a.jpg": BENT, "b.jpg": lenses["b.jpg"]})
    source = SceneSource("colmap", tmp_path, tmp_path / "points3D.bin")
    return Scene(PointCloud.empty(), images, source=source)


@pytest.mark.parametrize("factor", [1, 2])
def test_maps_of_the_photographs_of_before_are_undistorted(scene, tmp_path, factor):
    folder = tmp_path / "depth"
    folder.mkdir()
    height, width = 60 // factor, 80 // factor
    row, column = np.mgrid[:height, :width] * 1.0 + 0.5
    for name in ("a.npy", "b.npy"):
        np.save(folder / name, column)  # depth is the column, so that it says where it comes from
    if factor > 1:
        assert find_depths(scene, folder).lens is None  # perhaps a network's
        (tmp_path / "confidence").mkdir()
        PilImage.fromarray(np.full((height, width), 2, np.uint8)).save(
            tmp_path / "confidence/a.png"
        )
    maps = find_depths(scene, folder)
    depth = maps.read("a.jpg")
    assert (depth.width, depth.height) == (86 // factor, 62 // factor)
    camera = depth.camera(scene.images[0].camera)
    row, column = np.mgrid[: depth.height, : depth.width] + 0.5
    rays = np.stack([(column - camera.K[0, 2]) / camera.K[0, 0],
                     (row - camera.K[1, 2]) / camera.K[1, 1]], axis=-1)  # fmt: skip
    expected = project_rays(BENT, rays)[..., 0] / factor
    assert np.abs(depth.values - expected).max() <= 0.501
    assert np.abs(depth.values - column * width / depth.width).max() > 0.7  # as if not undistorted
    np.testing.assert_array_equal(maps.read("b.jpg").values[0], np.arange(width) + 0.5)
    assert any("before undistortion" in each for each in texts(with_depths_in(scene, folder)))


@pytest.mark.parametrize("shape", [(62, 86), (31, 43), (50, 50)])
def test_maps_of_the_undistorted_photographs_stay(scene, tmp_path, shape):
    (tmp_path / "depth").mkdir()
    np.save(tmp_path / "depth/a.npy", np.ones(shape))
    assert find_depths(scene, tmp_path / "depth").lens is None
    assert with_depths_in(scene, tmp_path / "depth").findings == ()


def test_damaged_lenses_are_named(scene, tmp_path):
    (tmp_path / "depth").mkdir()
    np.save(tmp_path / "depth/a.npy", np.ones((60, 80)))
    (tmp_path / LENSES).write_text('{"a.jpg": {"model": "OPENCV"}}')
    with pytest.raises(SceneFormatError, match="lenses by image name"):
        find_depths(scene, tmp_path / "depth")


def test_photographs_without_distortion_leave_no_file(tmp_path):
    write_lenses(tmp_path, {"a.jpg": STRAIGHT})
    assert not (tmp_path / LENSES).exists()
