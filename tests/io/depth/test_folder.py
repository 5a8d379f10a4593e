"""Writing a folder of depth maps, and reading it again."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from splatseed.camera import Intrinsics
from splatseed.errors import OutputError, SceneFormatError
from splatseed.io import find_depths
from splatseed.io.depth.folder import DESCRIPTION, depth_folder, read_description, write_description
from splatseed.io.staging import MANIFEST
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene

LENS = Intrinsics(1, "PINHOLE", 40, 30, (35.0, 36.0, 20.0, 15.0))
WORDS = st.text(st.characters(categories=("L", "N"), include_characters=" -_.()"), min_size=1)
PARTS = WORDS.map(lambda word: word.strip(" .")).filter(lambda word: 0 < len(word.encode()) < 60)
NAMES = st.lists(PARTS, min_size=1, max_size=3).map(lambda parts: "/".join(parts) + ".jpg")
MAPS = hnp.arrays(
    np.float32,
    hnp.array_shapes(min_dims=2, max_dims=2, max_side=5),
    elements=st.just(np.float32(np.nan)) | st.floats(0.125, 1e6, width=32),
)


def scene_of(*names: str) -> Scene:
    images = tuple(
        Image(name, i + 1, LENS, np.array([1.0, 0, 0, 0]), np.zeros(3))
        for i, name in enumerate(names)
    )
    return Scene(
        PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)), images, (LENS,)
    )


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    maps=st.dictionaries(NAMES, MAPS, min_size=1, max_size=4),
    kind=st.sampled_from(["z", "ray", "inverse"]),
)
def test_what_is_written_is_read(tmp_path_factory, maps, kind):
    path = tmp_path_factory.mktemp("maps") / "depths"
    tops = {name.split("/")[0] for name in maps}
    if any(f"{name}.npy" in tops for name in maps):  # a file where a folder must be
        return
    with depth_folder(path, kind) as writer:
        for name, values in maps.items():
            writer.write(name, values)
    depths = find_depths(scene_of(*maps), path)
    assert list(depths) == sorted(maps)
    for name, values in maps.items():
        read = depths.read(name)
        assert read.kind == kind
        np.testing.assert_array_equal(read.values, values)


def test_images_that_differ_only_in_suffix_keep_their_own(tmp_path):
    with depth_folder(tmp_path / "out", "z") as writer:
        for i, name in enumerate(("a.jpg", "a.png", "sub/a.jpg"), 1):
            writer.write(name, np.full((2, 2), i, np.float32))
    depths = find_depths(scene_of("a.jpg", "a.png", "sub/a.jpg"), tmp_path / "out")
    assert [depths.read(name).values[0, 0] for name in depths] == [1, 2, 3]


def test_threads_may_write_at_once(tmp_path):
    names = [f"{i % 3}/{i}.jpg" for i in range(60)]
    with depth_folder(tmp_path / "out", "z") as writer, ThreadPoolExecutor(8) as pool:
        values = (np.full((4, 5), i + 1, np.float32) for i in range(60))
        list(pool.map(writer.write, names, values))
    depths = find_depths(scene_of(*names), tmp_path / "out")
    for i, name in enumerate(names):
        assert np.unique(depths.read(name).values) == [i + 1]


def test_nothing_is_left_of_a_failure(tmp_path):
    def fail():
        with depth_folder(tmp_path / "out", "z") as writer:
            writer.write("a.jpg", np.ones((2, 2), np.float32))
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_only_an_earlier_output_is_replaced(tmp_path):
    path = tmp_path / "out"
    for value, overwrite in ((1, False), (2, True)):
        with depth_folder(path, "z", overwrite=overwrite, provenance={"model": "m"}) as writer:
            writer.write("sub/a.jpg", np.full((2, 2), value, np.float32))
    assert find_depths(scene_of("sub/a.jpg"), path).read("sub/a.jpg").values[0, 0] == 2
    manifest = json.loads((path / MANIFEST).read_text())
    files = [DESCRIPTION, MANIFEST, "sub/a.jpg.npy"]
    assert manifest == {"model": "m", "command": "depth", "files": files}
    (path / "mine.txt").write_text("keep")
    with pytest.raises(OutputError, match=r"mine\.txt"), depth_folder(path, "z", overwrite=True):
        pass
    with pytest.raises(OutputError, match="apart"), depth_folder(path, "z", protect=(path,)):
        pass


def test_a_name_out_of_the_folder_stays_inside(tmp_path):
    with depth_folder(tmp_path / "a" / "out", "z") as writer:
        writer.write("../images/f.jpg", np.ones((2, 2), np.float32))
        with pytest.raises(OutputError, match="two for"):
            writer.write("/images/f.jpg", np.ones((2, 2), np.float32))
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["out"]
    assert list(find_depths(scene_of("../images/f.jpg"), tmp_path / "a" / "out")) == [
        "../images/f.jpg"
    ]


@pytest.mark.parametrize("shape", [(3,), (2, 2, 3), (0, 4)])
def test_only_maps_are_written(tmp_path, shape):
    with depth_folder(tmp_path / "out", "z") as writer, pytest.raises(SceneFormatError):
        writer.write("a.jpg", np.ones(shape, np.float32))


def test_description_round_trip(tmp_path):
    for kind, scale in (("z", 1.0), ("ray", 0.25), ("inverse", 5000.0)):
        assert write_description(tmp_path, kind, scale, model="x") == (kind, scale)
        assert read_description(tmp_path / DESCRIPTION) == (kind, scale)
    (tmp_path / DESCRIPTION).write_text("{}")
    assert read_description(tmp_path / DESCRIPTION) == (None, None)
