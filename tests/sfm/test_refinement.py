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
from splatseed.commands import sfm
from splatseed.errors import ReconstructionError
from splatseed.io import load_scene
from splatseed.progress import silent
from splatseed.scene import Image, Scene
from splatseed.sfm import Refinement, SfmReport, triangulate
from splatseed.sfm.cameras import known_cameras
from splatseed.sfm.features import Run, find_features, match_features, write_database
from splatseed.sfm.photos import find_photos, match_poses
from splatseed.sfm.settings import Settings, require_pycolmap
from splatseed.sfm.solving.poses import Poses, align, poses_of, shifts, spread, turns, with_poses
from splatseed.sfm.solving.refinement import GAIN, refine
from splatseed.sfm.stages import Stages
from splatseed.synthetic import make_capture, write_capture

pycolmap = pytest.importorskip("pycolmap")

VIEWS = 12
EXTENT = 3.2
"""The cameras' extent in units of their spread."""


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Scene:
    """The room in 12 views of 320 x 240 with its true poses."""
    capture = make_capture(0, num_views=VIEWS, width=320, height=240)
    return load_scene(write_capture(capture, tmp_path_factory.mktemp("refined") / "room"))


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
    photos, _ = find_photos(folder, at_least=2)
    settings = Settings("exhaustive", "cpu", 1600, 0, threads=1)
    stages = Stages(require_pycolmap(), 0, silent)
    run = Run(stages, settings, folder, tmp_path_factory.mktemp("matches"))
    cameras, images = known_cameras(run, match_poses(photos, room, folder))
    write_database(run, cameras, images)
    find_features(run, [photo.name for photo in photos])
    match_features(run)
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


def test_a_small_gain_moves_little(room: Scene, matched: Matched) -> None:
    given = with_noise(room.images, 0.1, 0.1)
    images, refinement = matched.refine(given)
    assert refinement.error_before - refinement.error_after > GAIN
    assert turns(poses_of(images), poses_of(given)).max() < 0.5
    errors = median_errors(align(poses_of(images), poses_of(room.images)), poses_of(room.images))
    assert errors[0] < 0.03


def test_a_seed_gives_the_same_poses(room: Scene, matched: Matched) -> None:
    given = with_noise(room.images, 1.0, 1.0)
    first, second = (poses_of(matched.refine(given)[0]) for _ in range(2))
    np.testing.assert_array_equal(first.rotations, second.rotations)
    np.testing.assert_array_equal(first.centers, second.centers)


def test_one_camera_that_is_far_off_is_refused_by_name(room: Scene, matched: Matched) -> None:
    given = with_noise(room.images, 0.5, 0.5)
    turned = Rotation.from_rotvec([0, np.radians(25), 0]).as_matrix()
    camera = given[3].camera
    rotation = turned @ camera.cam_from_world[:3, :3]
    quat, translation = quat_from_rotation(rotation), -rotation @ camera.center
    given[3] = replace(given[3], quat=quat, translation=translation)
    with pytest.raises(ReconstructionError, match=r"no camera by more than 10 degrees") as caught:
        matched.refine(given)
    assert "1 of 12 such images: view_003.png" in caught.value.found


def test_cameras_in_one_place_are_refused(room: Scene, matched: Matched) -> None:
    first = room.images[0]
    given = [replace(i, quat=first.quat, translation=first.translation) for i in room.images]
    with pytest.raises(ReconstructionError, match="at least half of the 12 posed images"):
        matched.refine(given)


def shuffled(images: Sequence[Image]) -> list[Image]:
    """Every photograph with the pose of another."""
    others = np.random.default_rng(0).permutation(len(images))
    return [
        replace(image, quat=images[k].quat, translation=images[k].translation)
        for image, k in zip(images, others, strict=True)
    ]


def test_poses_of_other_photographs_are_refused(room: Scene, matched: Matched) -> None:
    with pytest.raises(ReconstructionError, match="in the same order and convention"):
        matched.refine(shuffled(room.images))


def test_a_refusal_leaves_nothing(room_path: Path, tmp_path: Path) -> None:
    small = load_scene(room_path)
    given = small.replace(images=tuple(shuffled(small.images)))
    with pytest.raises(ReconstructionError, match="leave refine_poses out"):
        triangulate(room_path / "images", given, tmp_path / "out", refine_poses=True)
    assert not list(tmp_path.iterdir())


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


def test_the_option_needs_poses(tmp_path: Path, splatseed) -> None:
    run = splatseed("sfm", tmp_path, "--refine-poses", "-o", tmp_path / "out")
    assert run.code == 2
    assert "--poses-from with --refine-poses" in run.err


@pytest.mark.parametrize(
    ("refinement", "told"),
    [
        (
            Refinement(False, 9.44, 0.16, 0.04, 0.113, 1.24, 3.66),
            (
                "mean 9.440 px, refined 0.160 px",
                "median 0.04 units, largest 0.113",
                "median 1.24 degrees, largest 3.66",
            ),
        ),
        (Refinement(True, 0.162, 0.162, 0.0, 0.0, 0.0, 0.0), ("kept as given", "0.162 px")),
    ],
)
def test_the_gain_is_told(
    refinement: Refinement,
    told: Sequence[str],
    room_path: Path,
    tmp_path: Path,
    splatseed,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    report = SfmReport(tmp_path, 9, 9, (), 10, 2.0, 0.5, {"features": 1.0}, refinement)
    asked = {}

    def stand_in(*_: object, **options: object) -> SfmReport:
        asked.update(options)
        return report

    monkeypatch.setattr(sfm, "triangulate", stand_in)
    words = ("--poses-from", room_path, "--refine-poses", "-o", tmp_path / "out")
    run = splatseed("sfm", room_path / "images", *words)
    assert run.code == 0
    assert asked["refine_poses"]
    for text in told:
        assert text in run.out
