"""Advice: by room, by what stereo finds, by how cameras stand; and it can say to do nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatseed.camera import Intrinsics
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene
from splatseed.seeding.advice import AS_IT_IS, Measured, advise, camera_layout, measure

FERN = Measured(6_009, 120_000, empty=0.4)
BONSAI = Measured(108_040, 106_400, empty=0.1)


def test_points_that_fill_the_budget_are_left_as_they_are():
    said = advise(BONSAI, most_seeds=18_655)
    assert said.method == AS_IT_IS
    assert "108,040" in said.reasons[0]
    assert "no room" in said.reasons[1]
    assert said.sentence == "leave the points as they are"


def test_room_is_filled_from_the_photographs():
    said = advise(FERN, most_seeds=21_000)
    assert said.method == "auto"
    assert "3.5 times" in said.reasons[0]
    assert "40%" in said.reasons[1]
    assert advise(FERN, most_seeds=6_500).method == AS_IT_IS
    assert advise(FERN, most_seeds=6_500, room=1.0).method == "auto"


def test_growth_needs_no_seeds_but_where_there_are_no_points():
    said = advise(FERN, most_seeds=30_000, strategy="grow")
    assert said.method == AS_IT_IS
    assert "stereo" in said.reasons[1]
    assert advise(FERN, most_seeds=30_000, strategy="mcmc").method == "auto"
    assert advise(replace(FERN, num_points=0), 30_000, strategy="grow").method == "auto"


def test_what_is_there_decides_the_method():
    assert advise(replace(FERN, depth_maps=True), 21_000).method == "depth"
    assert advise(replace(FERN, photographs=False), 21_000).method == "mls"
    assert advise(replace(FERN, num_points=0), 21_000).method == "auto"


def _scene(poses):
    lens = Intrinsics(1, "PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))
    images = []
    for i, (center, angle) in enumerate(poses):
        quat = np.array([np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0])
        image = Image(f"{i}.png", i + 1, lens, quat, np.zeros(3))
        rotation = image.camera.cam_from_world[:3, :3]
        images.append(replace(image, translation=-rotation @ np.asarray(center, float)))
    cloud = PointCloud(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8))
    return Scene(cloud, tuple(images), (lens,))


ANGLES = np.linspace(0, 2 * np.pi, 8, endpoint=False)


@pytest.mark.parametrize(
    ("poses", "layout"),
    [
        ([((x, 0, 0), 0.02 * x) for x in range(5)], "facing one way"),
        ([((4 * np.sin(a), 0, -4 * np.cos(a)), a) for a in ANGLES], "around something"),
        ([((4 * np.sin(a), 0, -4 * np.cos(a)), a + np.pi) for a in ANGLES], "through a place"),
        ([((0, 0, 0), 0.0)], None),
    ],
)
def test_how_cameras_stand(poses, layout):
    scene = _scene(poses)
    assert camera_layout(scene) == layout
    found = measure(scene, empty=0.5)
    assert (found.num_points, found.pixels, found.layout) == (1, 64 * 48, layout)
    assert not found.photographs
