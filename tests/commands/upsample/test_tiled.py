"""``splatseed upsample`` in tiles: the files of the same command in memory, and what it refuses."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from splatseed.io.ply import write_ply
from splatseed.pointcloud import PointCloud
from splatseed.upsample.tiles import making


def files(folder):
    """All files but the manifest, which says how many tiles there were."""
    return {
        path.relative_to(folder): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "splatseed.json"
    }


@pytest.fixture
def cloud(tmp_path):
    """A PLY of 300 points, one of them twice and one nowhere."""
    rng = np.random.default_rng(0)
    xyz = rng.random((302, 3)).astype(np.float32)
    xyz[300], xyz[301] = xyz[7], np.nan
    path = tmp_path / "cloud.ply"
    write_ply(path, PointCloud(xyz, rng.integers(0, 256, (302, 3), np.uint8)))
    return path


def test_a_bare_cloud_in_tiles_gives_the_files_of_memory(cloud, tmp_path, splatseed):
    words = ("upsample", cloud, "--method", "linear", "--ratio", 3)
    assert splatseed(*words, "-o", tmp_path / "whole").code == 0
    run = splatseed(*words, "-o", tmp_path / "out", "--tile-points", 120)
    assert (run.code, run.err) == (0, "")
    assert "in about 4 tiles of at most 120 points, at most " in run.out
    assert "900 (300 original, 600 linear)" in run.out
    assert "1 not finite, 1 duplicate" in run.out
    assert files(tmp_path / "out") == files(tmp_path / "whole")
    told = json.loads((tmp_path / "out" / "splatseed.json").read_text())
    assert (told["num_points"], told["num_original"]) == (900, 300)
    assert (told["tiles"], told["source"]) == (4, str(cloud))
    assert not (tmp_path / "out.tiles").exists()


@pytest.mark.parametrize("kind", ["scene", "coarse cloud"])
def test_tiles_give_the_files_of_memory(kind, room, tmp_path, splatseed):
    path = room
    if kind == "coarse cloud":  # float32 has 3 values an axis: new points fall together
        xyz = np.random.default_rng(0).random((300, 3)) * 1e-3 + 4096
        path = tmp_path / "coarse.ply"
        write_ply(path, PointCloud(xyz, np.zeros((300, 3), np.uint8)))
    words = ("upsample", path, "--method", "linear", "--ratio", 9, "--copy-images")
    for out, tiles in (("whole", ()), ("out", ("--tile-points", 90))):
        run = splatseed(*words, *tiles, "-o", tmp_path / out)
        assert (run.code, run.err) == (0, "")
    assert files(tmp_path / "out") == files(tmp_path / "whole")


def test_points_from_an_output_are_not_taken_for_originals(cloud, tmp_path, splatseed):
    words = ("--method", "linear", "--tile-points", 200)
    first, again = tmp_path / "first", tmp_path / "again"
    assert splatseed("upsample", cloud, "-o", first, "--ratio", 2, *words).code == 0
    ply = first / "sparse/0/points3D.ply"
    (first / "splatseed.json").rename(ply.with_name("splatseed.json"))
    run = splatseed("upsample", ply, "-o", again, "--ratio", 3, *words)
    assert "900 (300 original, 600 linear)" in run.out


def test_a_survey_far_from_zero_is_moved_and_says_so(tmp_path, splatseed):
    xyz = np.random.default_rng(0).random((200, 3)) * 20 + [564000.25, 5932000.5, 80]
    np.savetxt(tmp_path / "survey.xyz", xyz, fmt="%.4f")
    out = tmp_path / "out"
    run = splatseed("upsample", tmp_path / "survey.xyz", "-o", out, "--method", "linear")
    assert (run.code, run.err) == (0, "")
    assert "(564,010, 5,932,010, 90) was subtracted" in run.out
    assert json.loads((out / "splatseed.json").read_text())["origin"] == [564010, 5932010, 90]


SCAN = "with splatseed upsample SCENE --cloud SCAN."


REFUSED = [
    ("ply", "--memory 100M", "at least"),
    ("ply", "--memory much", "'much'"),
    ("ply", "--tile-points 99 --budget 50", "--budget"),
    ("ply", "--tile-points 99 --method stereo", SCAN),
    ("ply", "--jobs 2 --memory 1G --verify", "--verify"),
    ("ply", "--tile-points 99 --method voronoi --profile paper", "leave out --memory"),
    ("npz", "--method stereo", SCAN),
    ("npz", "--preview --budget 50", SCAN),
    ("ply, little memory", "--preview", "or use a machine with 3"),
    ("room", "--memory 200M", "MB of memory for the points and tracks of"),
]


@pytest.mark.parametrize(("given", "words", "told"), REFUSED)
def test_what_cannot_be_is_refused(
    given, words, told, cloud, room, tmp_path, splatseed, monkeypatch
):
    np.savez(cloud.with_suffix(".npz"), xyz=np.eye(3))  # such are always cut into tiles
    path = {"room": room, "npz": cloud.with_suffix(".npz")}.get(given, cloud)
    if "little" in given:
        monkeypatch.setattr("splatseed.commands.upsample.tiled.free_memory", lambda: 200 << 20)
    words = words if "--method" in words else f"{words} --method mls"
    run = splatseed("upsample", path, "-o", tmp_path / "out", *words.split())
    assert (run.code, told in " ".join(run.err.split())) == (2, True)
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize("content", ["nan nan nan\n" * 9, "1 2 3\n" * 99 + "1 2\n"])
def test_of_a_damaged_cloud_nothing_is_kept(content, tmp_path, splatseed):
    (tmp_path / "a.xyz").write_text(content)
    run = splatseed("upsample", tmp_path / "a.xyz", "-o", tmp_path / "out", "--method", "linear")
    assert run.code == 2
    assert re.search("row 100 of|none of them finite", run.err.replace("\n", " "))
    assert [each.name for each in tmp_path.iterdir()] == ["a.xyz"]


def test_after_a_number_that_cannot_be_another_may_be_asked_for(tmp_path, splatseed):
    np.savetxt(tmp_path / "a.txt", np.random.default_rng(0).random((100, 3)))
    words = ("upsample", tmp_path / "a.txt", "-o", tmp_path / "out", "--method", "mls")
    run = splatseed(*words, "--num-points", 10)
    assert (run.code, "100 originals" in run.err) == (2, True)
    assert [each.name for each in tmp_path.iterdir()] == ["a.txt"]
    run = splatseed(*words, "--num-points", 300)
    assert run.code == 0, run.err


def test_interrupted_it_says_what_is_kept_and_goes_on(cloud, tmp_path, splatseed, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    words = ("upsample", cloud, "--method", "linear", "-o", tmp_path / "out", "--tile-points", 120)
    with monkeypatch.context() as context:
        context.setattr(making, "place", interrupted)
        run = splatseed(*words)
    assert run.code != 0
    told = f"Finished tiles are kept in {tmp_path / 'out.tiles'}; the same command goes on"
    assert run.err.strip().startswith(f"interrupted. {told}")
    assert "half-written" not in run.err
    run = splatseed(*words)
    assert f"Resuming the work in {tmp_path / 'out.tiles'}" in run.out
