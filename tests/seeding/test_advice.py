"""Advice: by room, by what there is, by how cameras stand; and it can say to do nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatseed.camera import Intrinsics
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene
from splatseed.seeding.advice import AS_IT_IS, Measured, advise, measure, untrainable
from splatseed.training.traits import STRATEGIES

FERN = Measured(6_009, 120_000, empty=0.24)
DORM = Measured(5_740, 89_600, empty=0.48)  # bare walls


@pytest.mark.parametrize(
    ("measured", "most", "strategy", "method", "says"),
    [
        (Measured(108_040, 106_400), 18_655, "default", AS_IT_IS, ["108,040", "no room"]),
        (FERN, 21_000, "default", "auto", ["3.5 times", "24%"]),
        (FERN, 6_500, "default", AS_IT_IS, ["6,009", "no room"]),
        (FERN, 30_000, "grow", AS_IT_IS, ["6,009", "24%"]),
        (replace(FERN, empty=None), 30_000, "grow", AS_IT_IS, ["6,009", "stereo"]),
        (DORM, 89_600, "grow", "auto", ["15.6 times", "48%"]),
        (DORM, 6_000, "grow", AS_IT_IS, ["5,740", "no room"]),
        (FERN, 30_000, "mcmc", "auto", []),
        (replace(FERN, num_points=0), 30_000, "grow", "auto", ["no points"]),
        (replace(FERN, depth_maps=True), 21_000, "default", "depth", []),
        (replace(FERN, depth_maps=True, metric_maps=True), 21_000, "default", "auto", ["", "maps"]),
        (replace(FERN, photographs=False), 21_000, "default", "mls", []),
    ],
)
def test_what_is_there_decides_the_method(measured, most, strategy, method, says):
    said = advise(measured, most, why_no_seeds=STRATEGIES[strategy].why_no_seeds)
    assert said.method == method
    assert all(word in reason for word, reason in zip(says, said.reasons, strict=False))
    per_pixel = "per pixel of a photograph's" in said.reasons[0]
    assert per_pixel == (measured.num_points > 0 and measured.photographs)
    assert ("leave" in said.sentence) == (method == AS_IT_IS)


@pytest.mark.parametrize("measured", [FERN, DORM, replace(FERN, num_points=100_000)])
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_no_gain_of_other_captures_is_promised(measured, strategy):
    said = advise(measured, 90_000, why_no_seeds=STRATEGIES[strategy].why_no_seeds)
    assert "dB" not in " ".join((said.sentence, *said.reasons))


def test_scoring_may_ask_for_another_room():
    assert advise(FERN, max_seeds=6_500, room=1.0).method == "auto"


def test_one_photograph_is_too_few_and_none_is_needed_to_test():
    lens = Intrinsics(1, "PINHOLE", 40, 30, (30.0, 30, 20, 15))
    images = tuple(
        Image(f"{i}.png", i, lens, np.array([1.0, 0, 0, 0]), np.zeros(3)) for i in (1, 2)
    )
    assert untrainable(Scene(PointCloud.empty(), images[:1])).text.endswith("two photographs.")
    two = Scene(PointCloud.empty(), images)
    assert "two photographs" not in untrainable(two).text
    left = Scene(PointCloud.empty(), (*images, replace(images[0], name="0.png"))).without(["0.png"])
    assert untrainable(left).text == untrainable(two).text  # the copy was the test photograph


ANGLES = np.linspace(0, 2 * np.pi, 8, endpoint=False)
RING = [(4 * np.sin(a), 0, -4 * np.cos(a)) for a in ANGLES]


@pytest.mark.parametrize(
    ("centers", "angles", "layout"),
    [
        ([(x, 0, 0) for x in range(5)], 0.02 * np.arange(5), "facing one way"),
        (RING, ANGLES, "around something"),
        (RING, ANGLES + np.pi, "through a place"),
        ([(0, 0, 0)], [0.0], None),
    ],
)
def test_how_cameras_stand(centers, angles, layout):
    lens = Intrinsics(1, "PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))
    images = []
    for i, (center, angle) in enumerate(zip(centers, angles, strict=True)):
        quat = np.array([np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0])
        image = Image(f"{i}.png", i + 1, lens, quat, np.zeros(3))
        rotation = image.camera.cam_from_world[:3, :3]
        images.append(replace(image, translation=-rotation @ np.asarray(center, float)))
    cloud = PointCloud(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8))
    found = measure(Scene(cloud, tuple(images), (lens,)), empty=0.5)
    assert found == Measured(1, 64 * 48, 0.5, layout, photographs=False)
