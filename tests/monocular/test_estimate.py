"""A scene's photographs through a network: what is written, and what stops it."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.errors import OutputError, ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io import find_depths, load_scene
from splatseed.monocular import estimate_depths
from splatseed.synthetic import make_capture, write_capture


@dataclass
class Brightness:
    """A network that takes bright for near, and remembers what it was asked."""

    meaning: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(kind="inverse"))
    asked: list = field(default_factory=list)

    def __call__(self, image):
        self.asked.append(image.shape[:2])
        return image.mean(axis=2).astype(np.float32) + 1


@pytest.fixture(scope="module")
def room_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("room") / "room"
    return write_capture(make_capture(0, num_views=5, width=80, height=60), path)


@pytest.fixture
def own_path(room_path, tmp_path):
    """A copy that a test may spoil."""
    return shutil.copytree(room_path, tmp_path / "own")


@pytest.fixture
def network():
    return Brightness()


def _tree(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*.npy")}


def test_every_image_gets_a_map_that_the_reader_finds(room_path, network, tmp_path):
    scene, stages = load_scene(room_path), []
    report = estimate_depths(
        scene, network, tmp_path / "maps", progress=lambda *each: stages.append(each)
    )
    assert (report.num_images, report.flat) == (5, ())
    assert report.sizes == ((80, 60), (80, 60))
    depths = find_depths(scene, tmp_path / "maps")
    assert set(depths) == {image.name for image in scene.images}
    for image in scene.images:
        depth_map = depths.read(image.name)
        assert depth_map.kind == "inverse"
        with PilImage.open(scene.source.image_dir / image.name) as picture:
            expected = np.asarray(picture.convert("RGB")).mean(axis=2) + 1
        np.testing.assert_allclose(depth_map.values, expected, rtol=1e-6)
    assert ("check images", 1.0) in stages
    assert stages[-1] == ("predict depth", 1.0)


def test_large_images_are_reduced_and_small_ones_left(own_path, network, tmp_path):
    scene = load_scene(own_path)
    path = scene.source.image_dir / scene.images[1].name
    with PilImage.open(path) as picture:
        smaller = picture.resize((40, 30))
    smaller.save(path)
    report = estimate_depths(scene, network, tmp_path / "maps", max_size=48)
    assert set(network.asked) == {(36, 48), (30, 40)}
    assert report.sizes == ((40, 30), (48, 36))
    depth_map = find_depths(scene, tmp_path / "maps").read(scene.images[0].name)
    assert depth_map.camera(scene.images[0].camera).width == 48


def test_subfolders_and_foreign_suffixes_keep_their_names(own_path, network, tmp_path):
    scene = load_scene(own_path)
    first, second, *_ = scene.images
    for image, name in ((first, "left/a.png"), (second, "right/a.png")):
        (scene.source.image_dir / name).parent.mkdir()
        shutil.move(scene.source.image_dir / image.name, scene.source.image_dir / name)
    renamed = (replace(first, name="left/a.png"), replace(second, name="right/a.png"))
    scene = scene.replace(images=renamed)
    estimate_depths(scene, network, tmp_path / "maps")
    assert list(find_depths(scene, tmp_path / "maps")) == ["left/a.png", "right/a.png"]


def test_a_network_that_fails_on_an_image_is_told_of(room_path, tmp_path):
    class Failing(Brightness):
        def __call__(self, image):
            values = super().__call__(image)
            failing = {1: 7.0, 4: np.inf}.get(len(self.asked))
            return values if failing is None else np.full_like(values, failing)

    scene = load_scene(room_path)
    report = estimate_depths(scene, Failing(), tmp_path / "maps")
    names = sorted(image.name for image in scene.images)
    assert report.flat == (names[0], names[3])
    values = find_depths(scene, tmp_path / "maps").read(names[3]).values
    assert np.isnan(values).all()


@pytest.mark.parametrize("damage", ["cut short", "missing", "of another shape", "text"])
def test_a_bad_photograph_stops_before_the_network_is_run(damage, own_path, network, tmp_path):
    scene = load_scene(own_path)
    path = scene.source.image_dir / max(image.name for image in scene.images)
    if damage == "cut short":
        path.write_bytes(path.read_bytes()[:-100])
    elif damage == "of another shape":
        PilImage.new("RGB", (60, 80)).save(path)
    elif damage == "text":
        path.write_text("not an image")
    else:
        path.unlink()
    with pytest.raises((SceneFormatError, SceneNotFoundError), match=path.name):
        estimate_depths(scene, network, tmp_path / "maps")
    assert not network.asked
    assert not (tmp_path / "maps").exists()


def test_a_failure_on_the_way_leaves_nothing(room_path, tmp_path):
    class Broken(Brightness):
        def __call__(self, image):
            if len(self.asked) == 3:
                raise ParameterError("memory", found="none", fix="Buy some.")
            return super().__call__(image)

    with pytest.raises(ParameterError):
        estimate_depths(load_scene(room_path), Broken(), tmp_path / "out" / "maps")
    assert not list(tmp_path.iterdir())


def test_the_scene_is_not_written_into(room_path, network):
    for name in ("", "maps", "images/maps"):
        with pytest.raises(OutputError):
            estimate_depths(load_scene(room_path), network, room_path / name)
    assert not network.asked


def test_what_cannot_be_done_is_refused(own_path, network, tmp_path):
    scene = load_scene(own_path)
    with pytest.raises(ParameterError, match="--max-size"):
        estimate_depths(scene, network, tmp_path / "maps", max_size=-5)
    with pytest.raises(SceneNotFoundError):
        estimate_depths(scene.replace(images=()), network, tmp_path / "maps")
    shutil.rmtree(own_path / "images")
    with pytest.raises(SceneNotFoundError):
        estimate_depths(load_scene(own_path), network, tmp_path / "maps")
