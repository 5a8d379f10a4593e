"""Tiles give the bytes of the cloud in memory, wherever their borders fall."""

from __future__ import annotations

import os
import signal
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as arrays

from splatseed.pointcloud import PointCloud
from splatseed.runtime.tasks import ProcessTasks, slot_environment
from splatseed.scene import Scene, Tracks
from splatseed.upsample import configure, neighbors, upsample
from splatseed.upsample.neighbors import trusted_originals
from splatseed.upsample.tiles import making
from splatseed.upsample.tiles.making import TileDraws

from .conftest import Tiles

KINDS = [
    *((name, "default") for name in ("linear", "triangle", "spline", "mls", "voronoi", "random")),
    *((name, "paper") for name in ("linear", "spline", "mls")),
]


def assert_same(found, expected):
    xyz, rgb = found
    np.testing.assert_array_equal(xyz.view(np.uint32), expected.xyz.view(np.uint32))
    np.testing.assert_array_equal(rgb, expected.rgb)


def distinct(cloud):
    return cloud.select(cloud.distinct)


@pytest.mark.parametrize(("name", "profile"), KINDS)
def test_every_method_gives_the_same_bytes(name, profile, sheet, tiles):
    method = configure(name, profile)
    found = tiles(sheet, name, method, most=130)
    assert tiles.tiled.tiles >= 3
    assert (tiles.tiled.non_finite, tiles.tiled.repeats) == (1, 30)
    assert_same(found, upsample(distinct(sheet), method, ratio=3))


@settings(max_examples=12, deadline=None)
@given(
    xyz=st.one_of(
        arrays.arrays(np.float32, (60, 3), elements=st.integers(0, 4).map(np.float32)),  # ties
        arrays.arrays(np.float32, (40, 3), elements=st.floats(-1, 1, width=32)),
        arrays.arrays(np.float32, (50, 2), elements=st.floats(-1, 1, width=32)).map(
            lambda flat: np.concatenate([flat, np.full((len(flat), 1), 7, np.float32)], axis=1)
        ),
    ),
    most=st.integers(5, 45),
    at_once=st.integers(7, 70),
    seed=st.integers(0, 9),
)
def test_any_cloud_gives_the_same_bytes(xyz, most, at_once, seed):
    cloud = PointCloud(xyz, np.arange(3 * len(xyz), dtype=np.uint8).reshape(-1, 3))
    if cloud.distinct.sum() < 2:
        return
    with tempfile.TemporaryDirectory() as folder:
        run = Tiles(Path(folder) / "W")
        found = run(cloud, "linear", configure("linear"), most=most, at_once=at_once, seed=seed)
    assert_same(found, upsample(distinct(cloud), "linear", ratio=3, seed=seed))


def test_points_far_from_all_others_find_their_neighbors(tiles):
    """Two clusters and a point alone, whose nearest lie beyond empty tiles and tiles' borders."""
    rng = np.random.default_rng(1)
    xyz = np.concatenate([rng.normal(0, 1, (60, 3)), rng.normal(100, 1, (60, 3)), [[40, 0, 9]]])
    cloud = PointCloud(xyz.astype(np.float32), np.zeros((121, 3), np.uint8))
    assert_same(tiles(cloud, "mls", configure("mls"), most=11), upsample(cloud, "mls", ratio=3))
    assert tiles.tiled.tiles >= 11


def test_draws_of_many_blocks_are_those_in_memory(sheet, tiles, monkeypatch):
    monkeypatch.setattr(neighbors, "DRAW_BLOCK", 50)
    assert_same(
        tiles(sheet, "linear", configure("linear"), most=130),
        upsample(distinct(sheet), "linear", ratio=3),
    )


def test_tracks_are_heeded(tiles):
    rng = np.random.default_rng(2)
    xyz = rng.random((200, 3)).astype(np.float32)
    errors = np.where(np.arange(200) % 5 == 0, 9.0, 1.0)
    ids = np.arange(200)
    none = np.zeros(400, np.uint32)
    tracks = Tracks(ids + 1, xyz.astype(np.float64), errors, np.arange(201) * 2, none, none)
    scene = Scene(PointCloud(xyz, np.zeros((200, 3), np.uint8)), tracks=tracks)
    assert not trusted_originals(scene).all()
    assert_same(tiles(scene, "linear", configure("linear"), most=70),
                upsample(scene, "linear", ratio=3))  # fmt: skip


def dying(flag, function, *arguments):
    """A task whose process is killed the first time, in the middle of what it saves."""

    def save(*given, **options):
        real(*given, **options)
        if not flag.exists():
            flag.touch()
            os.kill(os.getpid(), signal.SIGKILL)

    real, np.save = np.save, save
    function(*arguments)
    np.save = real


class DyingTasks(ProcessTasks):
    """Processes of which one is killed."""

    def __init__(self, flag):
        super().__init__([slot_environment(1)])
        self.flag = flag

    def run(self, function, calls, report=None):
        return super().run(dying, [(self.flag, function, *call) for call in calls], report)


def test_processes_give_the_same_bytes_though_one_is_killed(sheet, tiles, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[3])  # where a new process finds ``dying``
    flag = tmp_path / "killed"
    found = tiles(sheet, "linear", configure("linear"), most=250, tasks=DyingTasks(flag))
    assert flag.exists()
    assert not list(tiles.path.glob("*/.*"))  # what was half-written is gone
    assert_same(found, upsample(distinct(sheet), "linear", ratio=3))


@pytest.mark.parametrize("columns", [None, 2, 3])
def test_a_tile_draws_its_part_of_the_stream(columns, monkeypatch):
    monkeypatch.setattr(making, "STREAM_BLOCK", 7)
    rng = np.random.default_rng(5)
    rng.multinomial(7, [0.5, 0.5])
    stream = {name: str(value) for name, value in rng.bit_generator.state["state"].items()}
    shape = (301,) if columns is None else (301, columns)
    first, second = (rng.random(shape, dtype=np.float32) for _ in range(2))
    rows = np.array([0, 1, 2, 4, *range(150, 190), 299, 300])
    draws = TileDraws(stream, 301, rows)
    for whole in (first, second):
        np.testing.assert_array_equal(draws.random((46, *shape[1:]), np.float32), whole[rows])
