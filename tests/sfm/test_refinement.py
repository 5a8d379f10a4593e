"""Given poses with noise, refined: on the demo's room, whose poses are known."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PilImage
from scipy.spatial.transform import Rotation

from splatseed.camera import quat_from_rotation
from splatseed.errors import ReconstructionError
from splatseed.io import load_scene
from splatseed.progress import silent
from splatseed.scene import Image, Scene
from splatseed.sfm import Refinement, triangulate
from splatseed.sfm.features import (
    Run,
    Settings,
    known_cameras,
    match_photographs,
    require_pycolmap,
)
from splatseed.sfm.photos import find_photos, match_poses
from splatseed.sfm.refinement import (
    Poses,
    align,
    poses_of,
    refine,
    shifts,
    spread,
    turns,
    with_poses,
)

pycolmap = pytest.importorskip("pycolmap")

VIEWS = 12
EXTENT = 3.2
"""The cameras' extent in units of their spread."""


@dataclass(frozen=True)
class Matched:
    """Photographs with verified matches, ready to be refined from any poses."""

    run: Run
    cameras: Sequence[object]
    images: Sequence[object]

    def refine(self, given: Sequence[Image]) -> tuple[list[Image], Refinement]:
        return refine(self.run, self.cameras, self.images, given)


@pytest.fixture(scope="module")
def matched(room: Scene, tmp_path_factory) -> Matched:
    folder = room.source.image_dir
    settings = Settings(device="cpu", threads=1)
    run = Run(require_pycolmap(), settings, folder, tmp_path_factory.mktemp("matches"), silent)
    cameras, images = known_cameras(run, match_poses(find_photos(folder)[0], room, folder))
    match_photographs(run, cameras, images)
    return Matched(run, cameras, images)


def with_noise(images: Sequence[Image], degrees: float, percent: float) -> list[Image]:
    """Poses off by ``degrees`` and ``percent`` of the cameras' extent, as root mean squares."""
    rng = np.random.default_rng(1)
    true = poses_of(images)
    turn = np.radians(degrees) / np.sqrt(3) * rng.standard_normal((len(images), 3))
    length = percent / 100 * EXTENT * spread(true)
    shift = length / np.sqrt(3) * rng.standard_normal((len(images), 3))
    rotations = Rotation.from_rotvec(turn).as_matrix() @ true.rotations
    return with_poses(images, Poses(rotations, true.centers + shift))


def median_errors(poses: Poses, true: Poses) -> np.ndarray:
    """Median turn in degrees and median shift."""
    return np.array([np.median(turns(poses, true)), np.median(shifts(poses, true))])


@pytest.mark.parametrize(("degrees", "percent"), [(0.5, 1.0), (2.0, 3.0)])
def test_noise_is_taken_out(room: Scene, matched: Matched, degrees: float, percent: float) -> None:
    true, given = poses_of(room.images), with_noise(room.images, degrees, percent)
    images, refinement = matched.refine(given)
    before, refined = median_errors(poses_of(given), true), poses_of(images)
    # In the given frame, whose own error is the noise's mean over 12 cameras
    assert (median_errors(refined, true) < before / 2).all()
    assert (median_errors(align(refined, true), true) < before / 15).all()
    assert spread(refined) == pytest.approx(spread(true), rel=0.02)  # metres stay metres
    assert not refinement.kept
    assert refinement.error_after < 0.25
    assert refinement.error_before > 10 * refinement.error_after
    assert refinement.largest_turn == pytest.approx(turns(refined, poses_of(given)).max())
    assert refinement.median_shift == pytest.approx(np.median(shifts(refined, poses_of(given))))


def test_true_poses_stay_exactly(room: Scene, matched: Matched) -> None:
    images, refinement = matched.refine(room.images)
    assert images == list(room.images)
    assert refinement.kept
    assert refinement.largest_turn == refinement.largest_shift == 0
    assert refinement.error_before == refinement.error_after < 0.25


def test_a_seed_gives_the_same_poses(room: Scene, matched: Matched) -> None:
    given = with_noise(room.images, 1.0, 1.0)
    first, second = (poses_of(matched.refine(given)[0]) for _ in range(2))
    np.testing.assert_array_equal(first.rotations, second.rotations)
    np.testing.assert_array_equal(first.centers, second.centers)


def test_poses_that_drift_are_refused_by_name(room: Scene, matched: Matched) -> None:
    given = with_noise(room.images, 0.5, 0.5)
    turned = Rotation.from_rotvec([0, np.radians(25), 0]).as_matrix()
    camera = given[3].camera
    rotation = turned @ camera.cam_from_world[:3, :3]
    quat, translation = quat_from_rotation(rotation), -rotation @ camera.center
    given[3] = replace(given[3], quat=quat, translation=translation)
    with pytest.raises(ReconstructionError) as caught:
        matched.refine(given)
    assert "1 of 12 such images: view_003.png" in caught.value.found


def with_poses_of(images: Sequence[Image], others: Sequence[Image]) -> list[Image]:
    return [
        replace(image, quat=other.quat, translation=other.translation)
        for image, other in zip(images, others, strict=True)
    ]


def test_poses_of_other_photographs_are_refused(room: Scene, matched: Matched) -> None:
    for order in (np.zeros(VIEWS, int), np.random.default_rng(0).permutation(VIEWS)):
        given = with_poses_of(room.images, [room.images[k] for k in order])
        with pytest.raises(ReconstructionError, match="refine_poses"):
            matched.refine(given)


def test_a_scene_has_the_refined_poses_and_one_without_matches_its_own(
    room: Scene, tmp_path: Path
) -> None:
    photos = tmp_path / "photos"
    shutil.copytree(room.source.image_dir, photos)
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3), np.uint8)
    PilImage.fromarray(noise).save(photos / "view_000.png")
    given = room.replace(images=tuple(with_noise(room.images, 2.0, 3.0)))
    stages: dict[str, None] = {}
    report = triangulate(
        photos,
        given,
        tmp_path / "out",
        refine_poses=True,
        on_progress=lambda stage, _: stages.setdefault(stage),
    )
    found = sorted(load_scene(report.path).images, key=lambda image: image.name)
    np.testing.assert_allclose(found[0].camera.center, given.images[0].camera.center)
    moved = shifts(poses_of(found), poses_of(given.images))
    assert report.refinement is not None
    assert report.refinement.median_shift == pytest.approx(np.median(moved))
    true = poses_of(room.images[1:])
    before = median_errors(poses_of(given.images[1:]), true)
    assert (median_errors(align(poses_of(found[1:]), true), true) < before / 20).all()
    assert report.mean_reprojection_error < 0.25
    expected = ["features", "matching", "refinement", "triangulation", "undistortion"]
    assert list(stages) == expected == list(report.seconds)


def test_cameras_on_a_line_are_aligned_by_their_rotations() -> None:
    rng = np.random.default_rng(0)
    centers = np.linspace(0, 4, 9)[:, None] * [1.0, 2.0, 2.0]
    given = Poses(Rotation.random(9, rng).as_matrix(), centers)
    turn = Rotation.random(1, rng).as_matrix()[0]
    moved = Poses(given.rotations @ turn.T, 2.5 * centers @ turn.T + [3.0, -1.0, 8.0])
    aligned = align(moved, given)
    assert turns(aligned, given).max() < 1e-4
    assert shifts(aligned, given).max() < 1e-5


def test_one_wrong_camera_does_not_tilt_the_frame() -> None:
    rng = np.random.default_rng(0)
    given = Poses(Rotation.random(10, rng).as_matrix(), rng.standard_normal((10, 3)))
    moved = Poses(given.rotations, given.centers.copy())
    moved.centers[4] += [5.0, 0.0, 0.0]
    rest = np.arange(10) != 4
    assert shifts(align(moved, given), given)[rest].max() < 1e-3
