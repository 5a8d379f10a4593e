"""Lens distortion and focal lengths that photographs contradict are measured and named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image as PilImage
from scipy.ndimage import map_coordinates

from splatseed.camera import Intrinsics
from splatseed.checkup.distortion import WRONG_DISTORTION
from splatseed.checkup.examination import comparable, examine
from splatseed.checkup.focal_lengths import WRONG_FOCAL_LENGTH, camera_groups
from splatseed.checkup.wrong_poses import find_wrong_poses
from splatseed.lens import unproject_pixels

K1 = -0.2


def _radial(lens, k):
    fx, fy, cx, cy = lens.params
    return replace(lens, model="OPENCV", params=(fx, fy, cx, cy, k, 0.0, 0.0, 0.0))


def _with_lenses(scene, change):
    images = [replace(im, intrinsics=change(i, im.intrinsics)) for i, im in enumerate(scene.images)]
    return scene.replace(images=tuple(images))


def _scaled(lens, factor, camera_id=None):
    fx, fy, cx, cy = lens.params
    camera_id = lens.camera_id if camera_id is None else camera_id
    return replace(lens, params=(factor * fx, factor * fy, cx, cy), camera_id=camera_id)


@pytest.fixture(scope="module")
def distorted(room, tmp_path_factory):
    """The room, photographed with k1 = -0.2 beside its pinhole cameras."""
    folder, images = tmp_path_factory.mktemp("distorted"), []
    for image in room.images:
        lens, pixels = image.intrinsics, np.asarray(PilImage.open(image.path).convert("RGB"), float)
        uv = np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), axis=-1) + 0.5
        x, y = np.moveaxis(unproject_pixels(_radial(lens, K1), uv), -1, 0)
        fx, fy, cx, cy = lens.params
        at = [fy * y + cy - 0.5, fx * x + cx - 0.5]
        taken = [map_coordinates(pixels[..., c], at, order=1, mode="nearest") for c in range(3)]
        path = folder / f"{image.path.stem}.png"
        PilImage.fromarray(np.stack(taken, axis=-1).round().astype(np.uint8)).save(path)
        images.append(replace(image, name=path.name))
    return room.replace(images=tuple(images), source=replace(room.source, image_dir=folder))


def test_distortion_that_cameras_lack_is_measured(distorted):
    (finding,) = examine(distorted, comparable(distorted)).findings
    assert (finding.kind, finding.severity) == (WRONG_DISTORTION, "error")
    assert float(str(finding).partition("k1 = ")[2].partition(":")[0]) == pytest.approx(
        K1, abs=0.03
    )
    right = _with_lenses(distorted, lambda _, lens: _radial(lens, K1))
    assert not examine(right, comparable(right)).findings


def test_distortion_that_photographs_lack_is_named(room):
    scene = _with_lenses(room, lambda _, lens: _radial(lens, 0.15))
    (finding,) = examine(scene, comparable(scene)).findings
    assert finding.kind == WRONG_DISTORTION
    assert "do not have the lens distortion of their cameras" in finding.text


def test_a_focal_length_that_is_a_few_per_cent_off_is_named(room):
    scene = _with_lenses(room, lambda _, lens: _scaled(lens, 1.06))
    (finding,) = examine(scene, comparable(scene)).findings
    assert finding.kind == WRONG_FOCAL_LENGTH
    right = float(finding.fix.partition("about ")[2].partition(" px")[0])
    assert right == pytest.approx(room.images[0].intrinsics.params[0], rel=0.02)


def test_one_of_two_cameras_is_named(room):
    scene = _with_lenses(room, lambda i, lens: _scaled(lens, 1.25, 7) if i % 4 == 1 else lens)
    (finding,) = examine(scene, comparable(scene)).findings
    assert finding.kind == WRONG_FOCAL_LENGTH
    assert "of camera 7 (" in finding.text
    assert set(finding.subjects) == {
        image.name for image in scene.images if image.intrinsics.camera_id == 7
    }
    right = float(finding.fix.partition("about ")[2].partition(" px")[0])
    assert right == pytest.approx(room.images[0].intrinsics.params[0], rel=0.03)


def test_two_right_cameras_say_nothing(room):
    scene = _with_lenses(room, lambda i, lens: _scaled(lens, 1.0, 7 if i % 2 else None))
    assert not examine(scene, comparable(scene)).findings


def test_a_single_photograph_of_another_focal_length_has_no_wrong_pose(room):
    scene = _with_lenses(room, lambda i, lens: _scaled(lens, 0.75) if i == 6 else lens)
    (finding,) = find_wrong_poses(scene, comparable(scene))
    assert finding.kind == WRONG_FOCAL_LENGTH
    assert finding.subjects == (scene.images[6].name,)
    factor = float(finding.text.partition("(")[2].partition(" times")[0])
    assert factor == pytest.approx(1 / 0.75, rel=0.04)


def test_groups_are_cameras_or_clusters_of_focal_lengths(room):
    def lens(i, focal):
        return Intrinsics(i, "PINHOLE", 100, 80, (focal, focal, 50.0, 40.0))

    def groups(focals, ids):
        pairs = zip(focals, ids, strict=True)
        return camera_groups([replace(room.images[0], intrinsics=lens(i, f)) for f, i in pairs])

    assert groups([90.0, 70, 90], [4, 2, 4]) == [0, 1, 0]
    assert groups(90 + 0.1 * np.arange(9) + 30 * (np.arange(9) > 5), range(9)) == [0] * 6 + [1] * 3
    assert groups(90 * 1.1 ** np.arange(9), range(9)) == [0] * 9
