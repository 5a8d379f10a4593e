"""Poses of scenes without points: wrong ones are refused, sound ones never; random starts."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image as PilImage
from scipy.ndimage import zoom
from scipy.spatial.transform import Rotation

from splatseed.camera import quat_from_rotation
from splatseed.checkup import poses as module
from splatseed.checkup.poses import CORRECTIONS, agreement_findings, check_poses, random_start
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import load_scene
from splatseed.pointcloud import PointCloud
from splatseed.seeding.upsampling import upsample

YZ, XY = np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])
PLAIN_YZ, PLAIN_XY, INVERTED, INVERTED_YZ = CORRECTIONS


def _posed(scene, poses):
    """The scene without points, at other poses."""
    images = tuple(
        replace(im, quat=quat_from_rotation(p[:3, :3]), translation=p[:3, 3], observations=None)
        for im, p in zip(scene.images, poses, strict=False)
    )
    return scene.replace(points=PointCloud.empty(), tracks=None, images=images)


@pytest.fixture(scope="module")
def room(room_path):
    """The room in 9 views of 96 x 72: the agreement of poses is as clear as in larger ones."""
    return load_scene(room_path)


@pytest.fixture
def poses(room):
    return np.array([image.camera.cam_from_world for image in room.images])


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_sound_poses_pass_in_any_unit_after_one_comparison(unit, room, poses, monkeypatch):
    calls = []
    agreement = module._agreement
    monkeypatch.setattr(module, "_agreement", lambda *a: calls.append(agreement(*a)) or calls[-1])
    poses[:, :3, 3] *= unit
    scene = _posed(room, poses)
    check_poses(scene, scene.images)
    assert len(calls) == 1


def _back_to_back():
    """Four cameras that look outward, 5 units from the middle."""
    outward = np.tile(np.eye(4), (4, 1, 1))
    turns = Rotation.from_euler("y", np.arange(4)[:, None] * 90, degrees=True)
    outward[:, :3, :3], outward[:, 2, 3] = turns.as_matrix(), -5.0
    return outward


def _in_place(poses, place):
    centers = np.broadcast_to(np.asarray(place), (len(poses), 3))
    poses[:, :3, 3] = -np.einsum("vij,vj->vi", poses[:, :3, :3], centers)
    return poses


@pytest.mark.parametrize(
    ("spoil", "error", "found"),
    [
        (lambda poses: YZ @ poses, SceneFormatError, f"once {PLAIN_YZ}.*OpenCV"),
        (lambda poses: XY @ poses, SceneFormatError, f"once {PLAIN_XY}"),
        (np.linalg.inv, SceneFormatError, f"once {INVERTED}"),
        (lambda poses: np.linalg.inv(poses) @ YZ, SceneFormatError, f"once {INVERTED_YZ}"),
        (np.random.default_rng(0).permutation, SceneFormatError, "confirm at"),
        (lambda poses: _in_place(poses, (0.0, 0, 0)), SceneFormatError, "all 9 cameras"),
        (lambda poses: _in_place(poses, (100.0, -20, 3)), SceneFormatError, "all 9 cameras"),
        (lambda _: _back_to_back(), SceneFormatError, "no two of 4"),
        (lambda poses: poses[:1], SceneNotFoundError, "found 1"),
    ],
)
def test_poses_at_which_nothing_can_be_compared_are_refused(spoil, error, found, room, poses):
    scene = _posed(room, spoil(poses))
    with pytest.raises(error, match=found):
        check_poses(scene, scene.images)


def test_of_few_photographs_too_little_overlap_is_named_as_a_reason(room, poses):
    scene = _posed(room, np.random.default_rng(0).permutation(poses))
    with pytest.raises(SceneFormatError, match="show too little in common"):
        check_poses(scene, scene.images)


def test_only_poses_of_scenes_without_points_are_checked(room, poses, monkeypatch):
    notes = []
    seeds = upsample(_posed(room, poses), note=notes.append)
    assert len(seeds) > 300
    assert [note.kind for note in notes] == ["confirmed-depth", "few-photographs"]
    turned = poses.copy()
    turned[4] = np.diag([-1.0, -1, 1, 1]) @ poses[4]  # as if the photograph were upside down
    notes.clear()
    upsample(_posed(room, turned), note=notes.append)
    (odd,) = [note for note in notes if note.kind == "photographs-disagree"]
    assert odd.subjects == (room.images[4].name,)
    monkeypatch.setattr(module, "check_poses", None)
    upsample(room, "stereo")
    with pytest.raises(SceneNotFoundError, match=r"other than test views.*all 1 are test views"):
        upsample(_posed(room, poses[:1]), test_every=8)


@pytest.mark.parametrize(("trainer", "num"), [("gsplat", 100_000), ("nerfstudio", 50_000)])
def test_points_fill_a_cube_around_the_cameras(room, trainer, num):
    points = random_start(room, np.random.default_rng(0), trainer)
    assert len(points) == num
    low, high = points.xyz.min(axis=0), points.xyz.max(axis=0)
    np.testing.assert_allclose(high - low, (high - low)[0], rtol=1e-3)
    centers = np.stack([image.camera.center for image in room.images])
    assert ((centers > low) & (centers < high)).all()
    again = random_start(room, np.random.default_rng(0), trainer)
    assert again.xyz.tobytes() == points.xyz.tobytes()


def _changed(scene, folder, change, mask=None):
    """The scene without points, with changed photographs, and one mask for all."""
    path = shutil.copytree(scene.source.root, folder)
    rng = np.random.default_rng(1)
    for file in sorted((path / "images").iterdir()):
        pixels = change(np.asarray(PilImage.open(file), np.float64), rng)
        PilImage.fromarray(pixels.clip(0, 255).astype(np.uint8)).save(file)
        if mask is not None:
            (path / "masks").mkdir(exist_ok=True)
            PilImage.fromarray(mask).save(path / "masks" / f"{file.name}.png")
    return load_scene(path).replace(points=PointCloud.empty(), tracks=None)


def test_masked_pixels_need_not_agree(room, tmp_path):
    mask = np.zeros((72, 96), np.uint8)
    mask[24:60, 30:78] = 255  # a quarter
    scene = _changed(room, tmp_path / "statue", lambda pixels, _: pixels, mask)
    share = check_poses(scene, scene.images)
    assert share > 0.3
    assert not agreement_findings(share, 0.75)


def test_changing_light_gives_a_warning_and_exposure_none(sixteen_views, tmp_path):
    _, room = sixteen_views
    exposed = _changed(room, tmp_path / "exposed", lambda p, rng: p * rng.uniform(0.4, 1.2))
    assert not agreement_findings(check_poses(exposed, exposed.images))

    def light(pixels, rng):
        return pixels * np.exp(2.0 * zoom(rng.normal(size=(9, 12)), 120 / 9, order=1))[..., None]

    lit = _changed(room, tmp_path / "lit", light)
    agreement = check_poses(lit, lit.images)
    (low,), (masked,) = agreement_findings(agreement), agreement_findings(0.08, 0.8)
    (stated,) = agreement_findings(agreement, stated=True)
    assert f"{agreement:.0%} of the pixels" in low.text
    assert "20%" in masked.text
    assert f"{agreement:.0%}" not in stated.text
