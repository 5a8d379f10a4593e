"""Seeds of few photographs: as dense as pixels, each surface once, and only where few."""

from __future__ import annotations

import numpy as np

import splatseed as ss
from splatseed.camera import Camera
from splatseed.methods import source_code
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.seeding import few_photographs
from splatseed.seeding.few_photographs import angle_between, are_few
from splatseed.seeding.photo_methods import Auto


def few(room: Scene, count: int) -> Scene:
    return room.replace(images=room.images[:count], points=PointCloud.empty(), tracks=None)


def test_few_photographs_have_a_seed_every_two_pixels_on_the_surfaces(room, room_capture):
    notes = []
    cloud = ss.upsample(few(room, 4), "auto", note=notes.append)
    assert "few-photographs" in {note.kind for note in notes}
    pixels = 4 * 160 * 120 / few_photographs.SPACING**2
    assert 0.3 * pixels < len(cloud) < pixels  # what several views see has one seed
    distance = room_capture.surfaces.distance(cloud.xyz.astype(np.float64))
    confirmed = cloud.source == source_code("stereo")
    assert confirmed.mean() > 0.5
    assert np.quantile(distance[confirmed], 0.75) < 0.05
    assert np.median(distance[~confirmed]) < 0.3
    assert set(np.unique(cloud.source)) == {source_code("stereo"), source_code("cover")}
    assert (cloud.confidence[confirmed] > cloud.confidence[~confirmed].max()).all()
    again = ss.upsample(few(room, 4), "auto")
    assert (again.xyz == cloud.xyz).all()


def test_photographs_close_together_have_sparse_seeds(room, monkeypatch):
    monkeypatch.setattr(few_photographs, "MIN_ANGLE", 180.0)
    notes = []
    cloud = ss.upsample(few(room, 4), "auto", note=notes.append)
    assert "few-photographs" not in {note.kind for note in notes}
    assert len(cloud) < 5000


def test_a_budget_limits_them(room):
    cloud = ss.upsample(few(room, 3), Auto(), budget=2000)
    assert 1500 < len(cloud) <= 2000


def orbit(*degrees: float) -> list[Camera]:
    """Cameras around the origin, 10 away from it, at these angles."""
    cameras = []
    for angle in np.radians(degrees):
        turn = np.array(
            [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
        )
        pose = np.eye(4)
        pose[:3, :3], pose[2, 3] = turn, 10.0
        K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
        cameras.append(Camera(K, 100, 100, pose))
    return cameras


def test_the_angle_is_that_to_the_second_nearest_photograph():
    xyz = np.zeros((30, 3))
    # To the second nearest: 10, 7 and 10 degrees.
    np.testing.assert_allclose(angle_between(orbit(0, 3, 10), xyz), 10, atol=1e-6)
    np.testing.assert_allclose(angle_between(orbit(0, 3), xyz), 3, atol=1e-6)
    behind = np.full((30, 3), 1000.0)
    assert angle_between(orbit(0, 3, 10), behind) == 180


def test_photographs_as_close_as_those_of_a_video_are_not_few():
    xyz = np.zeros((30, 3))
    assert are_few(orbit(0, 3, 6), xyz, has_points=True)
    assert not are_few(orbit(0, 0.5, 1, 1.5), xyz, has_points=False)
    assert are_few(orbit(*range(0, 60, 3)), xyz, has_points=False)
    assert not are_few(orbit(*range(0, 60, 3)), xyz, has_points=True)
    assert not are_few(orbit(*range(0, 120, 3)), xyz, has_points=False)
    assert not are_few(orbit(0, 3, 6), xyz[:0], has_points=False)
