"""Which of several COLMAP models is read, and how the others can be."""

from __future__ import annotations

import shutil

import pytest

from splatseed.errors import SceneFormatError
from splatseed.io import colmap, load_scene
from splatseed.io.colmap_model import count_images, scene_root
from splatseed.io.staging import check_output

from ..findings import texts
from .conftest import written


@pytest.fixture
def model_of(scene_dir, model):
    """Writes a model of some of the images into a numbered folder."""

    def write(number, count, parent="sparse"):
        folder = scene_dir / parent / str(number)
        folder.mkdir(parents=True, exist_ok=True)
        few = model._replace(images=model.images[:count])
        written(folder, few)
        return folder

    return write


def note_of(path):
    (note,) = [each for each in texts(load_scene(path)) if "models" in each]
    return note


@pytest.mark.parametrize("parent", ["sparse", "colmap/sparse"])
def test_the_model_with_most_images_is_read_and_all_are_counted(scene_dir, model_of, parent):
    shutil.rmtree(scene_dir / "sparse")
    for number, count in ((0, 1), (9, 3), (10, 4), (2, 4)):
        model_of(number, count, parent)
    scene = load_scene(scene_dir)
    assert (scene.source.model_dir, len(scene.images)) == (scene_dir / parent / "2", 4)
    note = note_of(scene_dir)
    assert "0 with 1 image, 2 with 4 images, 9 with 3 images, 10 with 4 images: 2 is read" in note
    assert f"such as {scene_dir / parent / '10'}." in note
    named = load_scene(scene_dir / parent / "9")
    assert (len(named.images), named.source.root) == (3, scene_dir)
    assert named.source.again == scene_dir / parent / "9"
    assert load_scene(scene_dir / parent).source.model_dir.name == "2"


def test_one_model_needs_no_note_whatever_its_number(scene_dir, model_of):
    shutil.rmtree(scene_dir / "sparse")
    model_of(3, 2)
    scene = load_scene(scene_dir)
    assert len(scene.images) == 2
    assert not any("models" in each for each in texts(scene))


def test_a_damaged_model_is_left_aside_unless_it_was_the_largest(scene_dir, model_of):
    (model_of(0, 1) / "images.bin").write_bytes(b"")
    model_of(1, 3)
    assert len(load_scene(scene_dir).images) == 3
    assert "0 with damaged images" in note_of(scene_dir)
    path = model_of(0, 4) / "images.bin"
    path.write_bytes(path.read_bytes()[:-99])  # cut short: its count says what is lost
    with pytest.raises(SceneFormatError, match=r"sparse/0/images\.bin"):
        load_scene(scene_dir)


def test_images_of_text_are_counted(tmp_path):
    text = "# 2 images\n\n1 1 0 0 0 0 0 0 1 a b.jpg\n\n2 1 0 0 0 0 0 0 1 c.jpg\n1 2 -1\n"
    (tmp_path / "images.txt").write_text(text)
    assert count_images(tmp_path) == 2
    colmap.write_images(tmp_path / "images.bin", ())
    assert count_images(tmp_path) == 0


def test_a_model_in_sparse_itself_is_read_if_it_has_more_images(scene_dir, model_of, model):
    model_of(0, 1)
    written(scene_dir / "sparse", model)
    scene = load_scene(scene_dir)
    assert (scene.source.model_dir, scene.source.root) == (scene_dir / "sparse", scene_dir)
    assert len(scene.images) == len(model.images)
    assert "sparse/0 with 1 image, sparse with 4 images: sparse is read" in note_of(scene_dir)
    small = load_scene(scene_dir / "sparse/0")
    assert len(small.images) == 1
    found = {each.kind: each for each in small.findings}
    assert found["several-models"].severity == found["missing-poses"].severity == "warning"
    assert len(found["missing-poses"].subjects) == 3


def test_a_list_of_names_is_no_model(scene_dir):
    (scene_dir / "images.txt").write_text("\n".join(f"{i}.jpg" for i in range(99)))
    assert load_scene(scene_dir).source.model_dir == scene_dir / "sparse/0"


@pytest.mark.parametrize("place", ["sparse_4/0", "sparse_12", "dense/0/sparse", "dense/sparse"])
def test_other_places_of_models(scene_dir, model_of, model, place):
    shutil.rmtree(scene_dir / "sparse")
    folder = scene_dir / place
    folder.mkdir(parents=True)
    written(folder, model)
    root = folder.parent if "dense" in place else scene_dir
    if root != scene_dir:
        (scene_dir / "images").rename(root / "images")
    for path in (scene_dir, folder, root):
        scene = load_scene(path)
        assert (scene.source.root, scene.source.image_dir) == (root, root / "images")
        assert len(scene.images) == len(model.images)
    model_of(0, 2)
    assert load_scene(scene_dir).source.model_dir == folder
    assert f"{place} with 4 images" in note_of(scene_dir)


def test_a_distorted_model_with_more_images_is_reported_and_read_on_request(scene_dir, model_of):
    model_of(0, 1)
    model_of(0, 1, "distorted/sparse")
    assert not any("models" in each for each in texts(load_scene(scene_dir)))
    larger = model_of(1, 3, "distorted/sparse")
    assert "distorted/sparse/1 with 3 images: sparse/0 is read" in note_of(scene_dir)
    assert f"such as {larger}." in note_of(scene_dir)
    scene = load_scene(larger)
    assert scene.source.image_dir == scene_dir / "images"
    assert all(image.has_photograph for image in scene.images)


@pytest.mark.parametrize("place", ["sparse/room", "sparse/room/sparse/0", "sparse", "sparse/0"])
@pytest.mark.parametrize("photographs", ["images", ""])
def test_a_folder_called_sparse_may_hold_scenes(tmp_path, scene_dir, model, place, photographs):
    root = tmp_path / "data" / place.removesuffix("/sparse/0")
    folder = tmp_path / "data" / place
    folder.mkdir(parents=True)
    written(folder, model)
    shutil.copytree(scene_dir / "images", root / photographs, dirs_exist_ok=True)
    if not photographs:
        shutil.copy(next(root.glob("left/*")), root / "first.png")
    assert scene_root(folder) == scene_root(root) == root
    assert load_scene(folder).source.root == root
    check_output(tmp_path / "data/out", kind="upsample", protect=[root, scene_root(root)])


def test_a_folder_of_poses_called_sparse_belongs_to_the_scene_above(scene_dir):
    (scene_dir / "sparse/0/preview.png").touch()
    for folder in ("sparse", "sparse/0"):
        assert scene_root(scene_dir / folder) == scene_dir
    assert scene_root(scene_dir) == scene_dir
