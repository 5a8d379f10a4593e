"""The depth that growth places Gaussians at: true, of training views alone, found once."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, strategies as st

from splatseed.camera import Intrinsics
from splatseed.depth.stereo.pipeline import find_stereo
from splatseed.scene import Image
from splatseed.training.depths import COSTS, MIN_VIEWS, known_depths, placing_views, stereo_size
from splatseed.training.prepare import prepare_run
from splatseed.training.settings import TrainSettings

SCALE = 0.25
GROW = TrainSettings(strategy="grow", max_steps=60)


def test_depths_are_those_of_the_surfaces_and_kept_with_the_time_they_took(
    sixteen_views, tmp_path, monkeypatch
):
    capture, scene = sixteen_views
    kept, findings = tmp_path / "bench" / "depths.npz", []
    depths, seconds = known_depths(scene, SCALE, GROW, "cpu", cache=kept, note=findings.append)
    truths = {image.name: truth for image, truth in zip(scene.images, capture.depths, strict=True)}
    errors = []
    for name, depth in depths.items():
        rows, columns = (
            (np.arange(n) * m // n + m // n // 2)
            for n, m in zip(depth.shape, truths[name].shape, strict=True)
        )
        truth, known = truths[name][np.ix_(rows, columns)], depth > 0
        errors.append(np.abs(depth[known] / SCALE / truth[known] - 1))
    errors = np.concatenate(errors)
    assert depths.keys() <= {image.name for image in scene.split(8)[0]}  # no test view's
    assert len(errors) > 2000
    assert np.median(errors) < 0.02
    assert [each.kind for each in findings[:1]] == ["stereo-depths"]
    with monkeypatch.context() as patch:
        patch.setattr("splatseed.training.depths.stereo_depths", None)
        again, same = known_depths(scene, SCALE, GROW, "cpu", cache=kept)
    assert same == seconds > 0
    assert depths.keys() == again.keys()
    assert all(np.array_equal(depths[name], again[name]) for name in depths)
    kept.write_bytes(b"damaged")
    assert known_depths(scene, SCALE, GROW, "cpu", cache=kept)[0].keys() == depths.keys()


@pytest.mark.parametrize("settings", [{"strategy": "default"}, {"placing": "none"}, {}])
def test_nobody_looks_where_there_is_no_use(room, settings):
    asked = dataclasses.replace(GROW, **settings)
    shown = room if settings else room.replace(images=room.images[:2])  # one is a test view
    assert known_depths(shown, SCALE, asked, "cpu") == ({}, 0.0)


def test_photographs_are_compared_once_for_seeds_and_growth(room, tmp_path, monkeypatch):
    calls = []

    def counted(*arguments, **options):
        calls.append(1)
        return find_stereo(*arguments, **options)

    monkeypatch.setattr("splatseed.depth.stereo.pipeline.find_stereo", counted)
    settings = dataclasses.replace(GROW, data_factor=2, seeding="auto")
    run = prepare_run(room, tmp_path / "run", settings)
    assert len(calls) == 1
    assert len(run.state.strategy.depths) > 5


@given(
    steps=st.integers(1, 100_000),
    count=st.integers(0, 400),
    width=st.integers(64, 4000),
    factor=st.integers(1, 8),
    device=st.sampled_from(["cpu", "cuda"]),
)
def test_comparing_takes_a_part_of_training_unless_few_views_are_compared_at_its_size(
    steps, count, width, factor, device
):
    lens = Intrinsics(1, "PINHOLE", width, width * 3 // 4, (width, width, width / 2, width / 3))
    image = Image("0.png", 1, lens, np.array([1.0, 0, 0, 0]), np.zeros(3))
    asked = TrainSettings(strategy="grow", max_steps=steps, data_factor=factor)
    longer = dataclasses.replace(asked, max_steps=steps + 1)
    size = stereo_size([image] * count, asked, device)
    assert 64 <= size <= stereo_size([image] * count, longer, device) <= 800
    chosen, placing = placing_views([image] * count, asked, device)
    assert placing <= size
    size = placing
    compared = len(chosen) * min(size, width) ** 2 * 3 / 4
    rendered = steps * (width / factor) ** 2 * 3 / 4
    least = max(64, width // factor) if device == "cpu" else 200
    part = 1.0 if count <= MIN_VIEWS else 0.5
    fits = compared <= 1.05 * part * COSTS[device].pixels * rendered
    assert fits or (size <= least and len(chosen) == min(count, MIN_VIEWS))
    # Rounding may cost one view where stereo affords exactly all.
    assert len(chosen) >= count - 1 or size <= least
    assert count or size == 800
