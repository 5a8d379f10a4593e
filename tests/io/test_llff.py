"""Poses of LLFF: against those of a COLMAP model, and what does not fit."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import colmap, load_scene, write_scene
from splatseed.io.llff import _OPENCV_FROM_LLFF, POSES, _read_rows


def rows_of(scene, scale=1):
    """As LLFF's scripts write them: columns down, right, back, centre, and height, width, focal."""
    rows = []
    for image in sorted(scene.images, key=lambda each: each.name):
        right, down, forward = image.camera.world_from_cam[:3, :3].T
        lens = image.intrinsics
        hwf = np.array([lens.height, lens.width, lens.params[0]]) * scale
        matrix = np.stack([down, right, -forward, image.camera.center, hwf], axis=1)
        rows.append([*matrix.ravel(), 1.0, 9.0])
    return np.array(rows)


@pytest.fixture
def root(room, room_path, tmp_path):
    shutil.copytree(room_path / "images", tmp_path / "scene/images")
    np.save(tmp_path / "scene" / POSES, rows_of(room))
    return tmp_path / "scene"


def load(path):
    return load_scene(path, require_points=False)


@pytest.mark.parametrize(("folder", "scale"), [("images", 1), ("images", 4), ("images_4", 4)])
def test_cameras_are_those_of_the_model(root, room, tmp_path, folder, scale):
    (root / "images").rename(root / folder)
    np.save(root / POSES, rows_of(room, scale))
    scene = load(root)
    assert (scene.source.format, scene.source.image_dir, len(scene.points)) == (
        "llff",
        root / folder,
        0,
    )
    assert not scene.findings
    again = load(write_scene(scene, tmp_path / "out", require_points=False).path)
    assert again.source.format == "colmap"
    for read in (scene, again):
        for image, known in zip(read.images, room.images, strict=True):
            assert image.name == known.name
            np.testing.assert_allclose(image.camera.K, known.camera.K, rtol=1e-6)
            np.testing.assert_allclose(
                image.camera.cam_from_world, known.camera.cam_from_world, atol=1e-9
            )


def test_a_model_goes_first(root, room_path):
    shutil.copytree(room_path / "sparse", root / "sparse")
    assert load(root).source.format == "colmap"


def test_masks_are_no_photographs(root):
    shutil.copy(root / "images/view_001.png", root / "images/view_001_mask.png")
    (root / "images/.hidden.png").touch()
    scene = load(root)
    assert len(scene.images) == 9
    assert scene.masks.files.keys() == {"view_001.png"}


def test_what_does_not_fit_is_one_error(root, room):
    rows = rows_of(room)
    for data, match in (
        (rows[:, :9], "9 x 9"),
        (np.full_like(rows, np.nan), "not finite"),
        (rows * 2, "rotation"),
        (-rows, "rotation|size|mirrored"),
    ):
        np.save(root / POSES, data)
        with pytest.raises(SceneFormatError, match=match):
            load(root)
    np.save(root / POSES, rows[1:])
    with pytest.raises(SceneFormatError, match=r"8 photographs.*found 9 in images"):
        load(root)
    shutil.rmtree(root / "images")
    with pytest.raises(SceneNotFoundError, match="8 photographs"):
        load(root)
    (root / POSES).write_bytes(b"no array")
    with pytest.raises(SceneFormatError, match=POSES):
        load(root)


def test_depths_of_a_real_file_are_those_of_its_points(scenes):
    """Its bounds are percentiles of the depths that COLMAP's points have at its poses."""
    root = scenes / "mipnerf360_sfm/stump"
    _, tracks = colmap.read_points3d(root / "sparse/0/points3D.bin")
    owners = np.repeat(np.arange(len(tracks)), tracks.lengths)
    rows = _read_rows(root / POSES)
    ratios = []
    for i, row in enumerate(rows):
        matrix = row[:15].reshape(3, 5)
        forward = (matrix[:, :3] @ _OPENCV_FROM_LLFF.T)[:, 2]
        seen = tracks.xyz[owners[tracks.image_ids == i + 1]]
        depths = (seen - matrix[:, 3]) @ forward
        ratios.append(np.percentile(depths, [0.1, 99.9]) / row[15:])
    np.testing.assert_allclose(np.median(ratios, axis=0), 1, atol=1e-4)
