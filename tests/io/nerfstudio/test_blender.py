"""Blender's folders: two files, one scene, with the split that they are."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.io import load_scene, write_scene
from splatseed.io.ply import write_ply
from splatseed.pointcloud import PointCloud

COUNTS = {"train": 5, "val": 2, "test": 3}


@pytest.fixture
def lego(tmp_path, rng):
    """As NeRF's data set has it: paths without suffix, one angle of view, names alike in each
    part."""
    root = tmp_path / "lego"
    for part, count in COUNTS.items():
        (root / part).mkdir(parents=True)
        frames = []
        for i in range(count):
            pose = np.eye(4)
            pose[:3, 3] = rng.normal(size=3)
            frames.append({"file_path": f"./{part}/r_{i}", "transform_matrix": pose.tolist()})
            PilImage.new("RGBA", (40, 30)).save(root / part / f"r_{i}.png")
        content = {"camera_angle_x": 0.7, "frames": frames}
        (root / f"transforms_{part}.json").write_text(json.dumps(content))
    write_ply(
        root / "points3d.ply", PointCloud(rng.normal(size=(9, 3)), np.zeros((9, 3), np.uint8))
    )
    return root


def _parts(scene):
    return [[image.name for image in part] for part in scene.split(8)]


def test_both_files_are_one_scene_with_their_split(lego):
    scene = load_scene(lego)
    wanted = [[f"{part}/r_{i}.png" for i in range(COUNTS[part])] for part in ("train", "test")]
    assert _parts(scene) == wanted
    assert len({image.image_id for image in scene.images}) == 8
    assert len(scene.intrinsics) == 1
    assert len(scene.points) == 9
    assert scene.has_photographs
    assert not [each for each in scene.warnings if "missing" in each or "outside" in each]
    assert "transforms_train.json" in scene.listed.sentence


@pytest.mark.parametrize("layout", ["auto", "colmap"])
def test_an_output_has_the_same_split_and_cameras(layout, lego, tmp_path):
    scene = load_scene(lego)
    again = load_scene(write_scene(scene, tmp_path / "out", format=layout).path)
    assert _parts(again) == _parts(scene)
    assert again.has_photographs
    pixels = {}
    for each in (scene, again):
        seen = [
            im.camera.project(each.points.xyz.astype(np.float64))[0]
            for im in sorted(each.images, key=lambda image: image.name)
        ]
        pixels[id(each)] = np.nan_to_num(np.stack(seen))
    np.testing.assert_allclose(*pixels.values(), rtol=1e-3, atol=1e-2)


def test_the_world_stays_that_of_the_files(lego, tmp_path):
    scene = load_scene(lego)
    again = load_scene(write_scene(scene, tmp_path / "out", format="transforms").path)
    np.testing.assert_array_equal(again.points.xyz, scene.points.xyz)
    by_name = {image.name: image.camera.world_from_cam for image in again.images}
    for image in scene.images:
        np.testing.assert_allclose(by_name[image.name], image.camera.world_from_cam, atol=1e-12)


def test_one_of_the_files_alone_is_named_as_before(lego):
    (lego / "transforms_test.json").unlink()
    assert len(load_scene(lego / "transforms_train.json").images) == 5
