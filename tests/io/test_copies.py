"""Copies of photographs: named, and in neither part of the split beside their originals."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.io import load_scene, write_scene

SUFFIXES = ["png", "bmp"]  # pictures without compression have equal sizes


@pytest.fixture
def photographed(scene_dir, model, rng):
    """A scene whose photographs differ, and their paths by name in order."""
    names = sorted(image.name for image in model.images)
    for name in names:
        noise = rng.integers(0, 256, (480, 640, 3), np.uint8)
        PilImage.fromarray(noise).save(scene_dir / "images" / name)
    return scene_dir, [scene_dir / "images" / name for name in names], names


def test_photographs_that_differ_are_all_kept(photographed):
    scene = load_scene(photographed[0])
    assert len(scene.images) == 4
    assert not scene.absent


def test_a_copy_is_left_out_and_named(photographed, tmp_path):
    folder, paths, names = photographed
    before = [[im.name for im in part] for part in load_scene(folder).split()]
    paths[2].write_bytes(paths[0].read_bytes())  # of the test image
    scene = load_scene(folder)
    assert scene.absent == (names[2],)
    (finding,) = [each for each in scene.findings if each.kind == "copied-photographs"]
    assert f"{names[2]} of {names[0]}" in finding.text
    assert finding.subjects == (names[2],)
    after = [[im.name for im in part] for part in scene.split()]
    assert after == [[name for name in part if name != names[2]] for part in before]
    write_scene(scene, tmp_path / "out")
    assert [im.name for im in load_scene(tmp_path / "out").images if im.name == names[2]] == []


def test_a_listed_test_image_stays(photographed):
    folder, paths, names = photographed
    paths[2].write_bytes(paths[0].read_bytes())
    (folder / "test.txt").write_text(names[2])
    scene = load_scene(folder)
    assert [im.name for im in scene.split()[1]] == [names[2]]
    assert scene.absent == (names[0],)


def test_equal_sizes_and_plain_pictures_are_no_copies(photographed):
    folder, paths, _ = photographed
    paths[1].write_bytes(paths[0].read_bytes()[:-1] + b"\0")
    assert not load_scene(folder).absent
    for path in paths:
        PilImage.new("RGB", (640, 480), "teal").save(path)
    assert not load_scene(folder).absent


def test_a_copy_of_few_bytes_is_left_out(photographed):
    """A drawing compresses well, unlike a photograph."""
    folder, paths, names = photographed
    drawing = PilImage.new("RGB", (640, 480), "teal")
    drawing.paste("white", (200, 100, 300, 400))
    drawing.save(paths[0])
    assert paths[0].stat().st_size < 1000 + 0.02 * 640 * 480
    paths[2].write_bytes(paths[0].read_bytes())
    scene = load_scene(folder)
    assert scene.absent == (names[2],)
    assert names[0] in {image.name for image in scene.split()[1]}


@pytest.mark.parametrize("test_every", [2, 3, 8])
def test_no_training_image_is_a_copy_of_a_test_image(photographed, test_every):
    folder, paths, names = photographed
    paths[3].write_bytes(paths[0].read_bytes())
    paths[1].write_bytes(paths[2].read_bytes())
    parts = load_scene(folder).split(test_every)
    shown = [{image.path.read_bytes() for image in part} for part in parts]
    assert not shown[0] & shown[1]
    assert {*shown[0], *shown[1]} == {paths[0].read_bytes(), paths[2].read_bytes()}
    assert names[0] in {image.name for image in parts[1]}
