"""The depth that growth places Gaussians at: true, of training views alone, found once."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, strategies as st

from splatseed.camera import Intrinsics
from splatseed.depth.stereo.depths import find_stereo
from splatseed.io import load_scene
from splatseed.scene import Image
from splatseed.splat.gaussians import TrainingFrame
from splatseed.synthetic import make_capture, write_capture
from splatseed.train.depths import PER_RENDERED, known_depths, stereo_size
from splatseed.train.run import prepare_run
from splatseed.train.settings import TrainSettings

FRAME = TrainingFrame(np.array([1.0, 2.0, 3.0]), 0.25)
GROW = TrainSettings(strategy="grow", max_steps=60)


@pytest.fixture(scope="module")
def capture():
    return make_capture(0, num_views=16, width=160, height=120)


@pytest.fixture(scope="module")
def scene(capture, tmp_path_factory):
    return load_scene(write_capture(capture, tmp_path_factory.mktemp("room") / "room"))


def test_depths_are_those_of_the_surfaces_in_training_units(capture, scene):
    notes: list[str] = []
    depths = known_depths(scene, FRAME.scale, GROW, "cpu", note=notes.append)[0]
    truths = {image.name: truth for image, truth in zip(scene.images, capture.depths, strict=True)}
    errors = []
    for name, depth in depths.items():
        rows, columns = (
            (np.arange(n) * m // n + m // n // 2)
            for n, m in zip(depth.shape, truths[name].shape, strict=True)
        )
        world = depth / FRAME.scale
        truth = truths[name][np.ix_(rows, columns)]
        errors.append((np.abs(world / truth - 1))[world > 0])
    errors = np.concatenate(errors)
    assert depths.keys() <= {image.name for image in scene.split(8)[0]}  # no test view's
    assert len(errors) > 2000
    assert np.median(errors) < 0.02
    assert "only splits" in notes[0]


@pytest.mark.parametrize("settings", [{"strategy": "default"}, {"placing": "none"}])
def test_nobody_looks_where_there_is_no_use(scene, settings):
    asked = TrainSettings(**{"strategy": "grow", **settings})
    assert known_depths(scene, FRAME.scale, asked, "cpu") == ({}, 0.0)
    one = scene.replace(images=scene.images[:2])  # the first is a test view
    assert known_depths(one, FRAME.scale, GROW, "cpu") == ({}, 0.0)


def test_maps_are_kept_for_the_next_run_with_the_time_they_took(scene, tmp_path, monkeypatch):
    kept = tmp_path / "bench" / "depths.npz"
    first, seconds = known_depths(scene, FRAME.scale, GROW, "cpu", kept=kept)
    with monkeypatch.context() as patch:
        patch.setattr("splatseed.train.depths.stereo_depths", None)
        again, same = known_depths(scene, FRAME.scale, GROW, "cpu", kept=kept)
    assert same == seconds > 0
    assert first.keys() == again.keys()
    assert all(np.array_equal(first[name], again[name]) for name in first)
    kept.write_bytes(b"damaged")
    assert known_depths(scene, FRAME.scale, GROW, "cpu", kept=kept)[0].keys() == first.keys()


def test_photographs_are_compared_once_for_seeds_and_growth(scene, tmp_path, monkeypatch):
    calls = []

    def counted(*arguments, **options):
        calls.append(1)
        return find_stereo(*arguments, **options)

    monkeypatch.setattr("splatseed.depth.stereo.depths.find_stereo", counted)
    settings = TrainSettings(strategy="grow", max_steps=60, data_factor=2, seeding="auto")
    run = prepare_run(scene, tmp_path / "run", settings)
    assert len(calls) == 1
    assert len(run.state.strategy.depths) > 10


@given(
    steps=st.integers(1, 100_000),
    count=st.integers(1, 400),
    width=st.integers(64, 4000),
    factor=st.integers(1, 8),
    device=st.sampled_from(["cpu", "cuda"]),
)
def test_comparing_takes_a_part_of_training_unless_it_is_at_the_trained_size(
    steps, count, width, factor, device
):
    lens = Intrinsics(1, "PINHOLE", width, width * 3 // 4, (width, width, width / 2, width / 3))
    images = [Image(f"{i}.png", i + 1, lens, np.array([1.0, 0, 0, 0]), np.zeros(3)) for i in
              range(count)]  # fmt: skip
    asked = TrainSettings(strategy="grow", max_steps=steps, data_factor=factor)
    size = stereo_size(images, asked, device)
    assert 64 <= size <= 800
    longer = dataclasses.replace(asked, max_steps=steps + 1)
    assert stereo_size(images, longer, device) >= size
    side = min(size, width)
    compared = count * side * side * 3 / 4
    rendered = steps * (width / factor) ** 2 * 3 / 4
    least = max(64, width // factor) if device == "cpu" else 200
    assert compared <= 1.05 * PER_RENDERED[device] * rendered or size <= least


def test_without_photographs_the_size_is_stereos_own():
    assert stereo_size([], GROW, "cpu") == 800
