"""Given poses with noise, refined: on the demo's room, whose poses are known."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from PIL import Image as PilImage
from scipy.spatial.transform import Rotation

from splatseed.camera import quat_from_rotation
from splatseed.checkup.examination import examine
from splatseed.errors import ReconstructionError
from splatseed.io import load_scene
from splatseed.pointcloud import PointCloud
from splatseed.progress import silent, silent_note
from splatseed.scene import LeftOut
from splatseed.seeding.clouds.point_colors import with_colors
from splatseed.sfm import Settings, first_look, matching, reconstruct, with_refined
from splatseed.sfm.colmap import ColmapRun, posed_model, require_pycolmap
from splatseed.sfm.matching import match_photographs
from splatseed.sfm.refined_scene import _Refined, refined as refined_scene
from splatseed.sfm.refinement import (
    Poses,
    Refinement,
    align_poses,
    poses_of,
    refine,
    shifts,
    spread,
    turns,
    with_poses,
)
from splatseed.tracks import Tracks

pycolmap = pytest.importorskip("pycolmap")

EXTENT = 3.2
"""The cameras' extent in units of their spread."""


@pytest.fixture(scope="module")
def refined(room, tmp_path_factory):
    """Refines poses of the room's photographs, whose matches are verified once."""
    work, settings = tmp_path_factory.mktemp("matches"), Settings(device="cpu", threads=1)
    run = ColmapRun(require_pycolmap(), settings, room.source.image_dir, work, silent)
    match_photographs(run, posed_model(pycolmap, room.images))
    return partial(refine, run)


def with_noise(images, degrees, percent):
    """Poses off by ``degrees`` and ``percent`` of the cameras' extent, as root mean squares."""
    rng = np.random.default_rng(1)
    true = poses_of(images)
    turn = np.radians(degrees) / np.sqrt(3) * rng.standard_normal((len(images), 3))
    length = percent / 100 * EXTENT * spread(true)
    shift = length / np.sqrt(3) * rng.standard_normal((len(images), 3))
    rotations = Rotation.from_rotvec(turn).as_matrix() @ true.rotations
    return with_poses(images, Poses(rotations, true.centers + shift))


def median_errors(poses, true):
    """Median turn in degrees and median shift."""
    return np.array([np.median(turns(poses, true)), np.median(shifts(poses, true))])


def test_noise_is_taken_out_the_same_each_time(room, refined):
    true, given = poses_of(room.images), with_noise(room.images, 2.0, 3.0)
    images, refinement = refined(given)
    before, found = median_errors(poses_of(given), true), poses_of(images)
    # In the given frame, whose own error is the noise's mean over 12 cameras
    assert (median_errors(found, true) < before / 2).all()
    assert (median_errors(align_poses(found, true), true) < before / 15).all()
    assert spread(found) == pytest.approx(spread(true), rel=0.02)  # metres stay metres
    assert not refinement.kept
    assert refinement.error_after < 0.25
    assert refinement.error_before > 10 * refinement.error_after
    assert refinement.largest_turn == pytest.approx(turns(found, poses_of(given)).max())
    assert refinement.median_shift == pytest.approx(np.median(shifts(found, poses_of(given))))
    np.testing.assert_equal(poses_of(refined(given)[0]), found)


def test_pairs_by_poses_that_are_off_suffice(room, tmp_path, monkeypatch):
    few = replace(first_look.FIRST_LOOK, max_exhaustive=4, partners=2, max_partners=2, bridges=0)
    for module in (first_look, matching):
        monkeypatch.setattr(module, "FIRST_LOOK", few)
    given = with_noise(room.images, 2.0, 3.0)
    run = ColmapRun(
        require_pycolmap(), Settings(device="cpu"), room.source.image_dir, tmp_path, silent
    )
    model = posed_model(pycolmap, given)
    agreement = match_photographs(run, model, None, given)
    assert run.num_pairs() < 50  # of 66
    with pycolmap.Database.open(run.database) as database:
        shared = database.read_two_view_geometry(1, 2).inlier_matches
    assert agreement[0, 1] > agreement[0, 6]
    assert len(shared) > 50
    true, (images, _) = poses_of(room.images), refine(run, given)
    before, found = median_errors(poses_of(given), true), poses_of(images)
    assert (median_errors(align_poses(found, true), true) < before / 15).all()


def test_true_poses_stay_exactly(room, refined):
    images, refinement = refined(room.images)
    assert images == list(room.images)
    assert refinement.kept
    assert refinement.largest_turn == refinement.largest_shift == 0
    assert refinement.error_before == refinement.error_after < 0.25


def test_poses_that_drift_or_are_of_others_are_refused(room, refined):
    given = with_noise(room.images, 0.5, 0.5)
    camera = given[3].camera
    turned = Rotation.from_rotvec([0, np.radians(25), 0]).as_matrix()
    rotation = turned @ camera.cam_from_world[:3, :3]
    quat, translation = quat_from_rotation(rotation), -rotation @ camera.center
    given[3] = replace(given[3], quat=quat, translation=translation)
    with pytest.raises(ReconstructionError) as caught:
        refined(given)
    assert "1 of 12 such images: view_003.png" in caught.value.found
    true = poses_of(room.images)
    for order in (np.zeros(12, int), np.random.default_rng(0).permutation(12)):
        others = Poses(true.rotations[order], true.centers[order])
        with pytest.raises(ReconstructionError, match="refine_poses"):
            refined(with_poses(room.images, others))


@pytest.mark.usefixtures("pycolmap_here")
def test_a_scene_has_the_refined_poses_and_one_without_matches_its_own(room, tmp_path):
    photos = tmp_path / "photos"
    shutil.copytree(room.source.image_dir, photos)
    noise = np.random.default_rng(0).integers(0, 256, (192, 256, 3), np.uint8)
    PilImage.fromarray(noise).save(photos / "view_000.png")
    noisy, own = tuple(with_noise(room.images, 2.0, 3.0)), room.points.select(slice(None))
    given = room.replace(images=noisy, points=own, tracks=None)
    how = {"poses_from": given, "refine_poses": True, "test_names": {"view_003.png"}}
    report = reconstruct(photos, tmp_path / "out", **how)
    scene = load_scene(report.path)
    assert 0 < report.num_kept <= len(own) < report.num_points == len(scene.points)
    there = np.isin(own.xyz[:, 0], scene.points.xyz[-report.num_kept :, 0])
    assert there.sum() == report.num_kept
    assert (scene.tracks.lengths > 0).sum() == report.num_points - report.num_kept
    shown = {image.name for image in load_scene(report.path).images}
    assert {image.name for image in report.poses} - shown == {"view_003.png"}
    found = sorted(report.poses, key=lambda image: image.name)
    np.testing.assert_allclose(found[0].camera.center, given.images[0].camera.center)
    assert report.refinement.excluded == ("view_000.png",)
    moved = shifts(poses_of(found), poses_of(given.images))
    assert report.refinement.median_shift == pytest.approx(np.median(moved))
    true = poses_of(room.images[1:])
    before = median_errors(poses_of(given.images[1:]), true)
    assert (median_errors(align_poses(poses_of(found[1:]), true), true) < before / 20).all()
    assert report.mean_reprojection_error < 0.25
    stages = ["features", "matching", "refinement", "triangulation", "undistortion"]
    assert list(report.seconds) == stages


@pytest.mark.parametrize("wrong", [False, True], ids=["on a line", "one wrong camera"])
def test_rotations_count_and_a_wrong_camera_hardly(wrong):
    rng = np.random.default_rng(0)
    centers = np.linspace(0, 4, 9)[:, None] * [1.0, 2.0, 2.0]
    if wrong:
        centers = rng.standard_normal((9, 3))
    given = Poses(Rotation.random(9, rng).as_matrix(), centers)
    turn = Rotation.random(1, rng).as_matrix()[0]
    moved = Poses(given.rotations @ turn.T, 2.5 * centers @ turn.T + [3.0, -1.0, 8.0])
    moved.centers[4] += [12.0 * wrong, 0.0, 0.0]
    aligned, rest = align_poses(moved, given), np.arange(9) != 4
    assert turns(aligned, given).max() < (1e-2 if wrong else 1e-4)
    assert shifts(aligned, given)[rest].max() < (1e-3 if wrong else 1e-5)


def test_poses_that_stay_among_refined_ones_are_named(room, tmp_path, monkeypatch):
    photos = shutil.copytree(room.source.image_dir, tmp_path / "photos")
    (photos / "view_001.png").rename(photos / "view_001.webp")
    names = ["view_000.png", "view_001.webp", *(image.name for image in room.images[2:])]
    images = [replace(im, name=name) for im, name in zip(room.images, names, strict=True)]
    source = replace(room.source, image_dir=photos)
    scene = room.replace(images=tuple(images), source=source)
    (photos / "view_005.png").unlink()  # which the scene's own warning names

    def call(*arguments):
        change = Refinement(False, 9.0, 0.1, excluded=("view_000.png",))
        return _Refined(arguments[6], room.points, change)

    monkeypatch.setattr("splatseed.sfm.refined_scene.call", call)
    note = refined_scene(scene, 0).findings[0]
    assert str(note).endswith(
        "The poses of 2 of 12 images stay as given: SfM does not read view_001.webp; fewer than 10 "
        "points are seen in view_000.png."
    )


@pytest.fixture
def refined_to(monkeypatch):
    """Refines a scene to given images, with ten triangulated points, in place of pycolmap."""

    def refine_to(scene, images, **options):
        made = PointCloud(np.arange(30.0).reshape(10, 3) / 1000, np.full((10, 3), 7, np.uint8))
        found = _Refined(tuple(images), made, Refinement(False, 9.0, 0.1))
        monkeypatch.setattr("splatseed.sfm.refined_scene.call", lambda *_: found)
        result = refined_scene(scene, 0, **options)
        assert result.scene.images[2].translation is images[2].translation
        np.testing.assert_array_equal(result.scene.points.xyz[result.num_kept :], made.xyz)
        return result

    return refine_to


def test_points_that_were_not_triangulated_stay(room, refined_to):
    noisy = with_noise(room.images, 2.0, 3.0)
    own = room.points.select(slice(None))
    scanned = room.replace(images=tuple(noisy), points=own, tracks=None)
    scene, number, (note, fit) = refined_to(scanned, room.images)
    assert number == len(own)
    np.testing.assert_array_equal(scene.points.xyz[:number], own.xyz)
    np.testing.assert_array_equal(scene.points.rgb[:number], own.rgb)
    assert f"The scene's {number:,} points stay, beside 10 triangulated" in note.text
    better, worse = (int(share) for share in re.findall(r"(\d+)% (?:of|at)", fit.text))
    right = examine(room.replace(points=own, tracks=None), room.images).fit
    assert (fit.severity, better) == ("info", round(100 * right.confirmed))
    assert better > worse + 20
    # Poses that fit the points less than the given ones do, if not as badly
    near = with_noise(room.images, 0.6, 0.6)
    scene, _, (_, fit) = refined_to(scanned.replace(images=room.images), near)
    assert (fit.severity, "refine_poses=False" in fit.fix) == ("warning", True)
    # Some of them with tracks
    ids, features = np.full(20, 1, np.uint32), np.arange(20, dtype=np.uint32)
    xyz, once = own.xyz[:20].astype(np.float64), np.arange(21)
    few = Tracks(np.arange(20), xyz, np.ones(20), once, ids, features)
    scene, number, (note, _) = refined_to(scanned.replace(tracks=few), room.images)
    assert number == len(own) - 20
    np.testing.assert_array_equal(scene.points.xyz[:number], own.xyz[20:])
    assert f"20 of the scene's {len(own):,} points are replaced by 10" in note.text


def test_points_that_photographs_contradict_are_replaced(room, refined_to):
    noisy, rng = with_noise(room.images, 2.0, 3.0), np.random.default_rng(0)
    xyz = rng.uniform(room.points.xyz.min(axis=0), room.points.xyz.max(axis=0), (3000, 3))
    random = PointCloud(xyz, rng.integers(0, 256, (3000, 3), np.uint8))
    scanned = room.replace(images=tuple(noisy), points=random, tracks=None)
    _, number, (note, unfit) = refined_to(scanned, room.images)
    assert (number, unfit.kind) == (0, "points-do-not-fit")
    assert "The scene's 3,000 points are replaced by 10" in note.text
    scene, number, _ = refined_to(scanned, room.images, unfit_points="keep")
    assert number == 3000
    np.testing.assert_array_equal(scene.points.xyz[:number], random.xyz)


def test_colours_are_those_at_refined_poses(room, refined_to):
    grey = room.points.replace(rgb=np.full((len(room.points), 3), 128, np.uint8))
    noisy = with_noise(room.images, 2.0, 3.0)
    scanned = room.replace(images=tuple(noisy), points=grey, tracks=None)
    color = partial(with_colors, test_every=0, note=silent_note, progress=silent)
    scene, number, _ = refined_to(scanned, room.images, color=color)
    off = np.abs(scene.points.rgb[:number].astype(int) - room.points.rgb).mean(axis=1)
    assert np.median(off) < 10


def test_points_of_the_files_that_were_left_out_go_with_the_others(room):
    scene = room.replace(left_out=LeftOut(0, 5))
    moved = tuple(replace(im, translation=im.translation + 0.1) for im in room.images)
    assert with_refined(scene, scene).left_out == LeftOut(0, 5)  # poses and points stay
    assert with_refined(scene, scene.replace(images=moved)).left_out == LeftOut()
