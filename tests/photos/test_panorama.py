"""Faces of panoramas: directions against pycolmap, colours against the room that they show."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.camera import Intrinsics
from splatseed.photos.panorama import (
    FACES,
    cut_face,
    face_directions,
    face_features,
    face_lens,
    pixel_directions,
    project_directions,
)

from ..panoramas import poses, render, shade

PANORAMA = Intrinsics(1, "EQUIRECTANGULAR", 256, 128, (256.0, 128.0))
LENS = face_lens(PANORAMA)


def test_directions_are_colmaps(rng):
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap")
    theirs = pycolmap.Camera(model="EQUIRECTANGULAR", width=256, height=128, params=[256, 128])
    uv = rng.uniform(size=(200, 2)) * [256, 128]
    rays = [theirs.cam_ray_from_img(each) for each in uv]
    np.testing.assert_allclose(pixel_directions(PANORAMA, uv), rays, atol=1e-12)
    for face in FACES:
        xyz = face_directions(LENS, face, slice(0, LENS.height)).reshape(-1, 3)
        expected = theirs.img_from_cam(xyz, check_cheirality=False)
        np.testing.assert_allclose(project_directions(PANORAMA, xyz), expected, atol=1e-9)


def test_faces_cover_the_sphere_and_keep_the_resolution():
    """100 degrees a side; a pixel in the middle is a pixel of the horizon; no face is mirrored."""
    assert (LENS.model, LENS.width, LENS.height) == ("PINHOLE", 98, 98)
    assert LENS.params == pytest.approx((256 / (2 * np.pi), 256 / (2 * np.pi), 49, 49))
    axes = np.array([turn[2] for turn in FACES.values()])
    np.testing.assert_array_equal(
        axes, [(0, 0, 1), (1, 0, 0), (0, 0, -1), (-1, 0, 0), (0, -1, 0), (0, 1, 0)]
    )
    for turn in FACES.values():
        np.testing.assert_array_equal(turn @ turn.T, np.eye(3))
        assert np.linalg.det(turn) == 1


def test_colours_are_those_of_the_room_across_the_panoramas_border():
    """Without a seam where the panorama closes, in the middle of the face behind."""
    (pose,) = poses(1)
    panorama = render(pose, 256)
    for face in FACES:
        rays = face_directions(LENS, face, slice(0, LENS.height)) @ pose[:3, :3]
        expected = shade(-pose[:3, :3].T @ pose[:3, 3], rays)
        found = cut_face(panorama, PANORAMA, face)
        assert np.corrcoef(found.ravel(), expected.ravel())[0, 1] > 0.9
    smooth = np.round(127 + 100 * pixel_directions(PANORAMA, _pixels())).astype(np.uint8)
    for face in FACES:
        rays = face_directions(LENS, face, slice(0, LENS.height))
        expected = 127 + 100 * rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        assert np.abs(cut_face(smooth, PANORAMA, face) - expected).max() < 1.6


def _pixels() -> np.ndarray:
    u, v = np.meshgrid(np.arange(256) + 0.5, np.arange(128) + 0.5)
    return np.stack([u, v], axis=-1)


def test_features_go_to_the_face_that_shows_them_best(rng):
    uv = rng.uniform(size=(500, 2)) * [256, 128]
    face, xy = face_features(PANORAMA, uv)
    assert {*face.tolist()} == {*range(6)}
    for number, turn in enumerate(FACES.values()):
        mine = face == number
        rays = np.concatenate([(xy[mine] - 49) / LENS.params[0], np.ones((mine.sum(), 1))], axis=1)
        np.testing.assert_allclose(project_directions(PANORAMA, rays @ turn), uv[mine], atol=1e-9)
        assert np.abs(xy[mine] - 49).max() <= LENS.params[0] + 1e-9  # within 45 degrees
