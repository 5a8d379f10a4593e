"""What cannot fit the memory is refused before any work, with the number that fits."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed import upsample
from splatseed.depth.stereo import StereoSettings, stereo_depths
from splatseed.depth.stereo.matching import BYTES_PER_DEPTH, check_stereo_memory
from splatseed.errors import ParameterError
from splatseed.io import load_scene
from splatseed.methods import number_of_new
from splatseed.methods.add_points import BYTES_EACH
from splatseed.methods.neighbors import NEIGHBOR_BYTES
from splatseed.photos.loading import load_views
from splatseed.pointcloud import PointCloud
from splatseed.progress import num_threads
from splatseed.runtime import memory
from splatseed.scene import Scene
from splatseed.synthetic import make_capture, write_capture
from splatseed.training.settings import BYTES_PER_GAUSSIAN


@pytest.fixture
def free(monkeypatch):
    """Sets the bytes that are said to be free."""
    return lambda count: monkeypatch.setattr(memory, "free_memory", lambda: count)


@pytest.fixture
def scene(tmp_path):
    capture = make_capture(0, num_views=4, width=60, height=40)
    return load_scene(write_capture(capture, tmp_path / "room"))


def test_upsample_says_how_many_points_and_neighbors_fit(free, rng):
    cloud = PointCloud(rng.random((1000, 3)), np.zeros((1000, 3), np.uint8))
    free(5000 * BYTES_EACH)
    assert len(upsample(cloud, "random", num_points=5000)) == 5000
    with pytest.raises(ParameterError, match=r"5,000 points.*found 1,000,000,000.*Ask for 5000"):
        upsample(cloud, "mls", num_points=10**9)
    free(200 * 1000 * NEIGHBOR_BYTES)
    assert len(upsample(cloud, "mls", ratio=2, k=200)) == 2000
    with pytest.raises(ParameterError, match=r"at most 200 neighbours of each of 1,000 .* 999"):
        upsample(cloud, "mls", ratio=2, k=100_000)
    free(None)  # an unknown amount refuses nothing
    assert number_of_new(None, "mls", Scene(cloud), None, 10**9) == 10**9 - 1000


def test_photographs_of_a_scene_and_what_stereo_holds_beside_them(free, scene):
    pixels, threads = 4 * 60 * 40, min(num_threads(), 4)
    free(3 * pixels)
    views = load_views(scene, scene.images)
    free(3 * pixels - 1)
    with pytest.raises(ParameterError, match=r"found 4 of 60 x 40.*`data_factor`"):
        load_views(scene, scene.images)
    assert len(load_views(scene, scene.images, data_factor=2)) == 4
    free(pixels + pixels * BYTES_PER_DEPTH + threads * 60 * 40 * 4 * 4)
    check_stereo_memory(views, StereoSettings(grid=1))
    free(pixels * BYTES_PER_DEPTH)
    with pytest.raises(ParameterError, match=r"found 9,600, at a grid of 1.*larger grid"):
        stereo_depths(scene, grid=1)
    check_stereo_memory(views, StereoSettings(grid=4))


def test_the_runs_of_a_benchmark(free, scene, splatseed):
    words = ("bench", "--scenes", scene.source.root, "--methods", "sfm", "--jobs", 2, "--dry-run")
    points = len(scene.points)
    free(points * 2 * BYTES_PER_GAUSSIAN)
    assert splatseed(*words).code == 0
    free(points * 2 * BYTES_PER_GAUSSIAN - 1)
    run = splatseed(*words)
    assert (run.code, f"at most {points - 1} seeds per run with 2" in run.err) == (2, True)


def test_a_container_has_less_than_its_machine(monkeypatch, tmp_path):
    monkeypatch.setattr(memory, "CGROUP", tmp_path)
    whole = memory.free_memory()
    (tmp_path / "memory.max").write_text("3000000\n")
    (tmp_path / "memory.current").write_text("2500000\n")
    (tmp_path / "memory.stat").write_text("anon 1\ninactive_file 400000\n")
    assert memory.free_memory() == 900_000
    (tmp_path / "memory.max").write_text("max\n")
    assert memory.free_memory() == pytest.approx(whole, rel=0.5)


def test_amounts_of_memory():
    parse_bytes = memory.parse_bytes
    assert parse_bytes("4G") == parse_bytes("4GB") == parse_bytes(" 4gib ") == 4 << 30
    assert (parse_bytes("500M"), parse_bytes("123"), parse_bytes("1.5K")) == (500 << 20, 123, 1536)
