"""Lists that say which images train and which test: followed, told of, and carried over."""

from __future__ import annotations

import json

import pytest

from splatseed.bench.scenes import scene_digest
from splatseed.io import load_scene, write_scene

from ..findings import texts

TEST = {"left/image001.jpg", "left/image003.jpg"}
TRAIN = {"left/image000.jpg", "left/image002.jpg"}


def parts(scene):
    return tuple({image.name for image in images} for images in scene.split(8))


@pytest.mark.parametrize(
    ("file", "start", "end"),
    [
        ("test_list.txt", "", ""),
        ("val_list.txt", "", ""),
        ("validation_list.txt", "", ""),
        ("test.txt", "images/", ""),
        ("sparse/0/test.txt", "", ""),
        ("test.txt", "left/", ".jpg"),  # the stem alone
    ],
)
@pytest.mark.parametrize("layout", ["colmap", "transforms"])
def test_a_list_of_test_images_is_followed_and_carried_over(
    layout, file, start, end, scene_dir, tmp_path
):
    lines = [name.removeprefix(start).removesuffix(end) for name in sorted(TEST)]
    lines = [start + line for line in lines] if start == "images/" else lines
    (scene_dir / file).write_text("\n".join(lines) + "\r\n\n")
    before = scene_digest(load_scene(scene_dir), scene_dir / "images")
    out = write_scene(load_scene(scene_dir), tmp_path / "out", format=layout).path
    for path in (scene_dir, out):
        assert parts(load_scene(path)) == (TRAIN, TEST)
    if layout == "transforms":
        content = json.loads((out / "transforms.json").read_text())
        listed = {f"images/{name}" for name in TEST}
        assert set(content["test_filenames"]) == set(content["val_filenames"]) == listed
    if layout == "colmap" or not file.startswith("sparse"):
        assert (out / file).read_bytes() == (scene_dir / file).read_bytes()
    (scene_dir / file).write_text("left/image000.jpg")  # which a benchmark has to know
    assert scene_digest(load_scene(scene_dir), scene_dir / "images") != before


def test_two_lists_can_leave_images_out(scene_dir):
    (scene_dir / "train_list.txt").write_text("\n".join(TEST))
    (scene_dir / "test_list.txt").write_text("left/image000.jpg")
    scene = load_scene(scene_dir)
    assert parts(scene) == (TEST, {"left/image000.jpg"})
    assert not any("list.txt" in each for each in texts(scene))


def test_names_of_no_image_are_told(scene_dir):
    (scene_dir / "test_list.txt").write_text("\n".join([*TEST, "left/imgae002.jpg"]), "utf-8-sig")
    scene = load_scene(scene_dir)
    assert parts(scene)[1] == TEST
    assert any("left/imgae002.jpg" in each for each in texts(scene))


def test_the_lists_of_transforms_json_are_followed_and_carried_over(scene_dir, tmp_path):
    write_scene(load_scene(scene_dir), tmp_path / "plain", format="transforms")
    path = tmp_path / "plain/transforms.json"
    content = json.loads(path.read_text())
    assert "test_filenames" not in content
    for part, names in (("train", TRAIN), ("test", TEST)):
        content[f"{part}_filenames"] = [f"./images/{name}" for name in names]
    path.write_text(json.dumps(content))
    scene = load_scene(tmp_path / "plain")
    for layout in ("transforms", "colmap"):
        out = write_scene(scene, tmp_path / f"to_{layout}", format=layout).path
        assert parts(load_scene(out)) == (TRAIN, TEST), layout
    for part in ("test", "val"):  # nerfstudio wants both
        assert set((tmp_path / f"to_colmap/{part}_list.txt").read_text().split()) == TEST
    # nerfstudio fails over a listed file that no frame has
    write_scene(scene.replace(images=scene.images[:2]), tmp_path / "fewer")
    content = json.loads((tmp_path / "fewer/transforms.json").read_text())
    kept = {frame["file_path"] for frame in content["frames"]}
    assert {n.removeprefix("./") for n in content["train_filenames"]} <= kept


@pytest.mark.parametrize("text", ["", "nobody.jpg\n", "0 1 2\n"])
def test_a_list_that_fits_no_image_is_left_aside(text, scene_dir):
    (scene_dir / "train.txt").write_text(text)
    scene = load_scene(scene_dir)
    assert (scene.listed, parts(scene)[1]) == (None, {"left/image000.jpg"})
    assert bool(text) == any("train.txt was ignored" in each for each in texts(scene))
