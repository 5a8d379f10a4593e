"""Kills, full disks, damaged notes, changed inputs, too little memory."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from splatseed.errors import OutputError, ParameterError, PointCloudError
from splatseed.pointcloud import PointCloud
from splatseed.process.tasks import HereTasks
from splatseed.tiles import check_disk, check_tileable, choose_jobs, plan_tiles, run
from splatseed.tiles.reading import origin_of
from splatseed.tiles.repeats import find_repeats
from splatseed.upsample import configure, upsample

LINEAR = configure("linear")


def kill_after(monkeypatch, name, number):
    """Let a step of ``run`` be done so often, and then be killed in its middle."""
    done, step = [], getattr(run, name)

    def killed(*arguments):
        if len(done) == number:
            raise KeyboardInterrupt
        done.append(arguments)
        return step(*arguments)

    monkeypatch.setattr(run, name, killed)
    return done


@pytest.mark.parametrize(
    ("name", "number"),
    [("read_rows", 0), ("split", 0), ("weigh", 2), ("draw", 0), ("place", 1), ("place", 3)],
)
def test_a_kill_loses_one_step(name, number, sheet, tiles, monkeypatch):
    with monkeypatch.context() as context:
        kill_after(context, name, number)
        with pytest.raises(KeyboardInterrupt):
            tiles(sheet, "linear", LINEAR, most=130)
    again = kill_after(monkeypatch, name, 10**6)
    xyz, _ = tiles(sheet, "linear", LINEAR, most=130)
    assert tiles.resumed
    per_tile = name in {"weigh", "place"}
    assert len(again) == (tiles.tiled.tiles - number if per_tile else 1)
    xyz, _ = tiles(sheet, "linear", LINEAR, most=130)  # killed while the output was written
    expected = upsample(sheet.select(sheet.distinct), "linear", ratio=3)
    np.testing.assert_array_equal(xyz, expected.xyz)


@pytest.mark.slow
def test_sigkill_in_the_middle_of_a_tile_loses_that_tile(sheet, tiles):
    """A process of its own, as nothing can catch the signal."""
    code = (
        "import os, signal; from pathlib import Path; import numpy as np\n"
        "from splatseed.tiles import run; from tests.tiles.conftest import Tiles\n"
        "from splatseed.pointcloud import PointCloud; from splatseed.upsample import configure\n"
        "complete = run.WorkFolder.complete\n"
        "def killed(self, name):\n"
        "    if name == 'made/000002': os.kill(os.getpid(), signal.SIGKILL)\n"
        "    complete(self, name)\n"
        "run.WorkFolder.complete = killed\n"
        f"kept = np.load({str(tiles.path.with_name('sheet.npz'))!r})\n"
        "cloud = PointCloud(kept['xyz'], kept['rgb'])\n"
        f"Tiles(Path({str(tiles.path)!r}))(cloud, 'linear', configure('linear'), most=130)\n"
    )
    np.savez(tiles.path.with_name("sheet.npz"), xyz=sheet.xyz, rgb=sheet.rgb)
    root = Path(__file__).parents[2]
    paths = os.pathsep.join([str(root), str(root / "src")])
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": paths}, check=False
    )
    assert done.returncode == -signal.SIGKILL
    assert sorted(each.name for each in (tiles.path / "made").iterdir()) == [
        "000000", "000001", "000002.partial",
    ]  # fmt: skip
    xyz, _ = tiles(sheet, "linear", LINEAR, most=130)
    assert tiles.resumed
    expected = upsample(sheet.select(sheet.distinct), "linear", ratio=3)
    np.testing.assert_array_equal(xyz, expected.xyz)


@pytest.mark.parametrize("step", ["tile_of_row", "tiles", "weighed/000001", "drawn", "made/000002"])
def test_what_a_kill_leaves_half_written_is_written_again(step, sheet, tiles, monkeypatch):
    complete = run.WorkFolder.complete

    def killed(self, name):
        if name == step:
            raise KeyboardInterrupt
        complete(self, name)

    with monkeypatch.context() as context:
        context.setattr(run.WorkFolder, "complete", killed)
        with pytest.raises(KeyboardInterrupt):
            tiles(sheet, "linear", LINEAR, most=130)
    assert (tiles.path / f"{step}.partial").exists()
    xyz, _ = tiles(sheet, "linear", LINEAR, most=130)
    expected = upsample(sheet.select(sheet.distinct), "linear", ratio=3)
    np.testing.assert_array_equal(xyz, expected.xyz)


def test_a_full_disk_leaves_what_is_done(sheet, tiles, monkeypatch):
    save = run.WorkFolder.save
    left = [2]

    def full(self, name, arrays):
        if name.startswith("weighed"):
            if not left[0]:
                raise OSError(28, "No space left on device")
            left[0] -= 1
        save(self, name, arrays)

    with monkeypatch.context() as context:
        context.setattr(run.WorkFolder, "save", full)
        with pytest.raises(OSError, match="No space"):
            tiles(sheet, "linear", LINEAR, most=130)
    assert len(list((tiles.path / "weighed").iterdir())) == 2
    tiles(sheet, "linear", LINEAR, most=130)
    assert tiles.resumed


def test_another_command_or_a_changed_input_is_refused(sheet, tiles):
    tiles(sheet, "linear", LINEAR)
    with pytest.raises(OutputError, match=r"the same seed .*\(0\); found 1\. Repeat the earlier"):
        tiles(sheet, "linear", LINEAR, seed=1)
    with pytest.raises(OutputError, match="the same parameters"):
        tiles(sheet, "linear", dataclasses.replace(LINEAR, reject_isolated=False))
    moved = PointCloud(sheet.xyz + 1, sheet.rgb)
    with pytest.raises(OutputError, match=r"the same input .* Repeat the earlier command"):
        tiles(moved, "linear", LINEAR)


def test_less_memory_than_the_tiles_were_cut_for_is_refused(sheet, tiles):
    tiles(sheet, "linear", LINEAR, most=130)
    with pytest.raises(ParameterError, match=r"tiles of 130 points.*found enough for 60\. Pass"):
        tiles(sheet, "linear", LINEAR, most=60)


def test_a_damaged_note_is_one_line(sheet, tiles):
    tiles(sheet, "linear", LINEAR)
    note = tiles.path / "job.json"
    note.write_text(note.read_text()[:40])
    with pytest.raises(OutputError, match=r"found a damaged file\. Remove the folder .*OUT.tiles"):
        tiles(sheet, "linear", LINEAR)


def test_a_foreign_folder_is_left_alone(sheet, tiles):
    tiles.path.mkdir()
    (tiles.path / "holiday.jpg").touch()
    with pytest.raises(OutputError, match=r"found a folder without job\.json"):
        tiles(sheet, "linear", LINEAR)
    assert [each.name for each in tiles.path.iterdir()] == ["holiday.jpg"]


def test_nothing_finite_and_too_few_are_refused(tiles):
    nothing = PointCloud(np.full((5, 3), np.nan), np.zeros((5, 3), np.uint8))
    with pytest.raises(PointCloudError, match="none of them finite"):
        tiles(nothing, "linear", LINEAR)
    tiles.path = tiles.path.with_name("other")
    with pytest.raises(PointCloudError, match="at least 3 distinct"):
        tiles(PointCloud(np.eye(3)[:2], nothing.rgb[:2]), "triangle", configure("triangle"))


def test_methods_of_the_whole_are_refused():
    for name, method in (("auto", configure("auto")), ("voronoi", configure("voronoi", "paper"))):
        with pytest.raises(
            ParameterError, match=r"tile by tile .* at once\. Choose one of these.* or work in"
        ):
            check_tileable(name, method)
    with pytest.raises(ParameterError, match="or voronoi with --profile default"):
        check_tileable("voronoi", configure("voronoi", "paper"))
    check_tileable("random", configure("random"))


def test_too_little_memory_names_what_is_needed():
    with pytest.raises(ParameterError, match=r"at least (.*) of memory .* --memory (.*)\.") as told:
        plan_tiles(LINEAR, 10**8, 3 * 10**8, 100 << 20)
    fix = told.value.fix.split("--memory ")[1].rstrip(".")
    assert fix.endswith("M")
    plan = plan_tiles(LINEAR, 10**8, 3 * 10**8, int(fix[:-1]) << 20)
    assert plan.memory <= int(fix[:-1]) << 20
    assert plan.tiles >= 10**8 / plan.tile_points


def test_what_the_source_keeps_counts():
    bound = 1 << 30
    plain = plan_tiles(LINEAR, 10**7, 10**7, bound)
    kept = plan_tiles(LINEAR, 10**7, 10**7, bound, held=bound // 2)
    assert kept.tile_points < plain.tile_points
    assert kept.memory <= bound
    with pytest.raises(ParameterError, match=r"at least 1\.\d GB of memory"):
        plan_tiles(LINEAR, 10**7, 10**7, bound, held=bound)


def test_the_memory_for_repeats_is_that_of_a_tile(tiles, tmp_path, monkeypatch):
    """However many there are: here nearly all new points fall together."""
    peaks = []

    def watched(*arguments):
        tracemalloc.start()
        find_repeats(*arguments)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()

    monkeypatch.setattr(run, "find_repeats", watched)
    # The first loads what the others use. In a strip nearly all tiles have as many tiles around.
    for length in (48, 48, 480):
        grid = np.stack(np.meshgrid(np.arange(length), np.arange(6), 0), axis=-1).reshape(-1, 3)
        cloud = PointCloud((grid + 2**24).astype(np.float32), np.zeros(grid.shape, np.uint8))
        tiles.path = tmp_path / f"{len(peaks)}.tiles"
        tiles(cloud, "linear", LINEAR, most=40, ratio=40, at_once=10_000)
        assert tiles.tiled.num_repeated > 0.9 * tiles.tiled.num_new
    assert peaks[2] < 1.5 * peaks[1]


def test_more_processes_share_the_memory():
    one = plan_tiles(configure("mls"), 10**8, 10**8, 2 << 30)
    three = plan_tiles(configure("mls"), 10**8, 10**8, 2 << 30, processes=3)
    assert three.tile_points < one.tile_points
    assert three.memory <= 2 << 30


@pytest.mark.parametrize(
    ("name", "count", "memory", "cores", "jobs"),
    [
        ("mls", 10**8, 4 << 30, 2, 2),
        ("mls", 10**8, 64 << 30, 8, 8),
        ("mls", 10**8, 4 << 30, 64, 2),  # what the memory holds, beside the one that hands out
        ("mls", None, 4 << 30, 2, 2),
        ("mls", 10**8, 1 << 30, 2, 1),  # better one process with full tiles
        ("mls", 7 * 10**6, 4 << 30, 2, 1),  # not worth the start of another
        ("random", 10**8, 4 << 30, 2, 1),  # without work on tiles
    ],
)
def test_processes_are_as_many_as_are_worth_it(name, count, memory, cores, jobs):
    method, num_new = configure(name), None if count is None else 3 * count
    assert choose_jobs(method, count, num_new, memory, cores=cores) == jobs
    if jobs > 1:
        plan = plan_tiles(method, count, num_new, memory, processes=1 + jobs)
        alone = plan_tiles(method, count, num_new, memory)
        assert plan.tile_points == alone.tile_points
        assert plan.memory <= memory


def test_a_small_disk_is_refused_beforehand(tmp_path):
    with pytest.raises(OutputError, match=r"of free disk at .*; found .* Free some space"):
        check_disk(tmp_path / "OUT.tiles", 1 << 60)
    check_disk(tmp_path / "OUT.tiles", 1 << 60, there=1 << 60)


def test_only_clouds_far_off_are_moved():
    low, high = np.array([4e5, 5e6, 100.0]), np.array([4e5 + 50, 5e6 + 60, 130.0])
    assert origin_of(low, high, exact=False).tolist() == [400025, 5000030, 115]
    assert not origin_of(low, high, exact=True).any()  # float32 holds them as they are
    assert not origin_of(low - low, high - low, exact=False).any()


def test_notes_are_json(sheet, tiles):
    tiles(sheet, "linear", LINEAR, tasks=HereTasks())
    assert json.loads((tiles.path / "job.json").read_text())["method"] == "linear"
