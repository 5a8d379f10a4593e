"""Kills, full disks, damaged notes, changed inputs, too little memory."""

from __future__ import annotations

import dataclasses
import tracemalloc

import numpy as np
import pytest

from splatseed.errors import OutputError, ParameterError, PointCloudError
from splatseed.pointcloud import PointCloud
from splatseed.upsample import configure, upsample
from splatseed.upsample.tiles import check_disk, making, plan_tiles
from splatseed.upsample.tiles.cutting import origin_of

LINEAR = configure("linear")


def assert_whole(found, sheet):
    expected = upsample(sheet.select(sheet.distinct), "linear", ratio=3)
    np.testing.assert_array_equal(found[0], expected.xyz)


def kill_after(monkeypatch, name, number):
    """Let a step be done so often, and then be killed."""
    done, step = [], getattr(making, name)

    def killed(*arguments):
        if len(done) == number:
            raise KeyboardInterrupt
        done.append(arguments)
        return step(*arguments)

    monkeypatch.setattr(making, name, killed)
    return done


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("read_rows", 0),
        ("split", 0),
        ("weigh", 2),
        ("_draw", 0),
        ("place", 3),
        ("_find_repeats", 0),
    ],
)
def test_a_kill_loses_one_step(name, number, sheet, tiles, monkeypatch):
    with monkeypatch.context() as context:
        kill_after(context, name, number)
        with pytest.raises(KeyboardInterrupt):
            tiles(sheet, "linear", LINEAR, most=130)
    again = kill_after(monkeypatch, name, 10**6)
    tiles(sheet, "linear", LINEAR, most=130)
    assert tiles.resumed
    assert len(again) == (tiles.tiled.tiles - number if name in {"weigh", "place"} else 1)
    assert_whole(tiles(sheet, "linear", LINEAR, most=130), sheet)  # killed while it was written


def test_a_full_disk_leaves_what_is_done(sheet, tiles, monkeypatch):
    real, left = making.save_arrays, [2]

    def full(folder, arrays):
        if not left[0]:
            raise OSError(28, "No space left on device")
        left[0] -= 1
        real(folder, arrays)

    with monkeypatch.context() as context:
        context.setattr(making, "save_arrays", full)
        with pytest.raises(OSError, match="No space"):
            tiles(sheet, "linear", LINEAR, most=130)
    assert len(list((tiles.path / "weighed").iterdir())) == 2
    assert_whole(tiles(sheet, "linear", LINEAR, most=130), sheet)
    assert tiles.resumed


def test_another_command_input_or_memory_is_refused(sheet, tiles):
    tiles(sheet, "linear", LINEAR, most=130)
    with pytest.raises(OutputError, match="the same seed"):
        tiles(sheet, "linear", LINEAR, seed=1)
    with pytest.raises(OutputError, match="the same parameters"):
        tiles(sheet, "linear", dataclasses.replace(LINEAR, reject_isolated=False))
    with pytest.raises(OutputError, match="the same input"):
        tiles(PointCloud(sheet.xyz + 1, sheet.rgb), "linear", LINEAR)
    with pytest.raises(ParameterError, match=r"130 points.* 60\."):  # as they were cut
        tiles(sheet, "linear", LINEAR, most=60)
    note = tiles.path / "job.json"
    note.write_text(note.read_text()[:40])
    with pytest.raises(OutputError, match=r"job\.json"):
        tiles(sheet, "linear", LINEAR)


def test_a_foreign_folder_is_left_alone(sheet, tiles):
    tiles.path.mkdir()
    (tiles.path / "holiday.jpg").touch()
    with pytest.raises(OutputError, match=r"without job\.json"):
        tiles(sheet, "linear", LINEAR)
    assert [each.name for each in tiles.path.iterdir()] == ["holiday.jpg"]


def test_what_cannot_be_made_is_refused(tiles):
    nothing = PointCloud(np.full((5, 3), np.nan), np.zeros((5, 3), np.uint8))
    with pytest.raises(PointCloudError, match="none of them finite"):
        tiles(nothing, "linear", LINEAR)
    tiles.path = tiles.path.with_name("other")
    with pytest.raises(PointCloudError, match="at least 3 distinct"):
        tiles(PointCloud(np.eye(3)[:2], nothing.rgb[:2]), "triangle", configure("triangle"))


def test_too_little_memory_names_what_is_needed(tmp_path):
    with pytest.raises(ParameterError, match="--memory") as told:
        plan_tiles(LINEAR, 10**8, 3 * 10**8, 100 << 20)
    fix = told.value.fix.split("--memory ")[1].rstrip(".")
    plan = plan_tiles(LINEAR, 10**8, 3 * 10**8, int(fix[:-1]) << 20)
    assert plan.memory <= int(fix[:-1]) << 20
    assert plan.tiles >= 10**8 / plan.tile_points
    bound = 1 << 30
    plain = plan_tiles(LINEAR, 10**7, 10**7, bound)
    for more in ({"held": bound // 2}, {"jobs": 2}):
        plan = plan_tiles(LINEAR, 10**7, 10**7, bound, **more)
        assert plan.tile_points < plain.tile_points
        assert plan.memory <= bound
    with pytest.raises(ParameterError):
        plan_tiles(LINEAR, 10**7, 10**7, bound, held=bound)
    with pytest.raises(OutputError, match="free disk"):
        check_disk(tmp_path / "OUT.tiles", 1 << 60)


def test_the_memory_for_repeats_is_that_of_a_tile(tiles, monkeypatch):
    """However many there are: here nearly all new points fall together."""
    peaks, real = [], making._find_repeats

    def watched(*arguments):
        tracemalloc.start()
        real(*arguments)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()

    monkeypatch.setattr(making, "_find_repeats", watched)
    grid = np.stack(np.meshgrid(np.arange(72), np.arange(6), 0), axis=-1).reshape(-1, 3)
    cloud = PointCloud((grid + 2**24).astype(np.float32), np.zeros(grid.shape, np.uint8))
    tiles(cloud, "linear", LINEAR, most=500, ratio=800, at_once=500)
    assert tiles.tiled.num_repeated > 0.9 * tiles.tiled.num_new
    assert peaks[0] < 4 * tiles.tiled.num_new  # not even a number for each


@pytest.mark.parametrize(
    ("name", "count", "memory", "cores", "jobs"),
    [
        ("mls", 10**8, 64 << 30, 8, 8),
        ("mls", 10**8, 4 << 30, 64, 2),  # what the memory holds, beside the one that hands out
        ("mls", 10**8, 1 << 30, 2, 1),  # better one process with full tiles
        ("mls", 7 * 10**6, 4 << 30, 2, 1),  # not worth the start of another
        ("random", 10**8, 4 << 30, 2, 1),  # without work on tiles
    ],
)
def test_processes_are_as_many_as_are_worth_it(name, count, memory, cores, jobs):
    method, num_new = configure(name), 3 * count
    plan = plan_tiles(method, count, num_new, memory, jobs=None, cores=cores)
    assert plan.jobs == jobs
    if jobs > 1:
        assert plan.tile_points == plan_tiles(method, count, num_new, memory).tile_points
        assert plan.memory <= memory


def test_only_clouds_far_off_are_moved():
    low, high = np.array([4e5, 5e6, 100.0]), np.array([4e5 + 50, 5e6 + 60, 130.0])
    assert origin_of(low, high, exact=False).tolist() == [400025, 5000030, 115]
    assert not origin_of(low, high, exact=True).any()  # float32 holds them as they are
    assert not origin_of(low - low, high - low, exact=False).any()
