"""Lists that say which images train and which test: followed, told of, and carried over."""

from __future__ import annotations

import json

import pytest

from splatseed.bench.scenes import scene_digest
from splatseed.io import load_scene, write_scene

TEST = {"left/image001.jpg", "left/image003.jpg"}


@pytest.fixture
def names(model):
    return [image.name for image in model.images]


def _names(images):
    return {image.name for image in images}


def _parts(path):
    scene = load_scene(path)
    train, test = scene.split(8)
    return _names(train), _names(test)


@pytest.mark.parametrize(
    ("file", "form"),
    [
        ("test_list.txt", "{name}"),
        ("validation_list.txt", "{name}"),
        ("test.txt", "images/{name}"),
        ("sparse/0/test.txt", "{name}"),
        ("test.txt", "{stem}"),
    ],
)
@pytest.mark.parametrize("layout", ["colmap", "transforms"])
def test_a_list_of_test_images_is_followed_and_carried_over(
    layout, file, form, scene_dir, names, tmp_path
):
    stems = {name: name.rpartition("/")[2].removesuffix(".jpg") for name in names}
    lines = [form.format(name=name, stem=stems[name]) for name in sorted(TEST)]
    (scene_dir / file).write_text("\n".join(lines) + "\r\n\n")
    write_scene(load_scene(scene_dir), tmp_path / "out", format=layout)
    for path in (scene_dir, tmp_path / "out"):
        assert _parts(path) == (set(names) - TEST, TEST)
    if layout == "transforms":
        content = json.loads((tmp_path / "out/transforms.json").read_text())
        listed = {f"images/{name}" for name in TEST}
        assert set(content["test_filenames"]) == set(content["val_filenames"]) == listed
    if layout == "colmap" or not file.startswith("sparse"):
        assert (tmp_path / "out" / file).read_bytes() == (scene_dir / file).read_bytes()


def test_two_lists_can_leave_images_out(scene_dir, names):
    train, test = sorted(names)[1:4], sorted(names)[:1]
    (scene_dir / "train_list.txt").write_text("\n".join(train))
    (scene_dir / "test_list.txt").write_text("\n".join(test))
    assert _parts(scene_dir) == (set(train), set(test))
    scene = load_scene(scene_dir)
    assert "scene's train_list.txt and test_list.txt: 3 training" in scene.listed.sentence
    assert not any("list.txt" in each for each in scene.warnings)


@pytest.mark.parametrize(
    ("slips", "told"),
    [
        ((), None),
        (("left/imgae002.jpg",), "1 name matches no image (left/imgae002.jpg)"),
        (tuple("abcd"), "4 names match no image (a, b, c, ...)"),
    ],
)
def test_names_of_no_image_are_told(slips, told, scene_dir):
    (scene_dir / "test_list.txt").write_text("\n".join([*TEST, *slips]))
    (scene_dir / "validation_list.txt").write_text("only nerfstudio reads it\n")
    scene = load_scene(scene_dir)
    assert _names(scene.split(8)[1]) == TEST
    warnings = [each for each in scene.warnings if "test_list.txt" in each]
    assert warnings == ([] if told is None else [f"test_list.txt and validation_list.txt: {told}."])


def test_the_lists_of_transforms_json_are_followed_and_carried_over(scene_dir, names, tmp_path):
    write_scene(load_scene(scene_dir), tmp_path / "plain", format="transforms")
    path = tmp_path / "plain/transforms.json"
    content = json.loads(path.read_text())
    assert "test_filenames" not in content
    parts = {"train": sorted(set(names) - TEST), "test": sorted(TEST)}
    content |= {f"{k}_filenames": [f"./images/{n}" for n in v] for k, v in parts.items()}
    path.write_text(json.dumps(content))
    scene = load_scene(tmp_path / "plain")
    for layout in ("transforms", "colmap"):
        write_scene(scene, tmp_path / f"to_{layout}", format=layout)
        assert _parts(tmp_path / f"to_{layout}") == (set(names) - TEST, TEST), layout
    assert set((tmp_path / "to_colmap/test_list.txt").read_text().split()) == TEST
    # nerfstudio fails over a listed file that no frame has
    write_scene(scene.replace(images=scene.images[:2]), tmp_path / "fewer")
    content = json.loads((tmp_path / "fewer/transforms.json").read_text())
    kept = {frame["file_path"] for frame in content["frames"]}
    assert {n.removeprefix("./") for n in content["train_filenames"]} <= kept


@pytest.mark.parametrize("text", ["", "nobody.jpg\n", "0 1 2\n"])
def test_a_list_that_fits_no_image_is_left_aside(text, scene_dir, names):
    (scene_dir / "train.txt").write_text(text)
    scene = load_scene(scene_dir)
    assert scene.listed is None
    assert _names(scene.split(8)[1]) == set(sorted(names)[::8])
    assert bool(text) == any("train.txt was ignored" in each for each in scene.warnings)


def test_a_benchmark_knows_when_a_list_changed(scene_dir):
    before = scene_digest(load_scene(scene_dir), scene_dir / "images")
    (scene_dir / "test_list.txt").write_text("\n".join(TEST))
    assert scene_digest(load_scene(scene_dir), scene_dir / "images") != before
