"""Bad input gives one line on stderr that says what to do, exit code 2, and no output."""

from __future__ import annotations

import errno
import os
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

from splatseed.commands import info
from splatseed.io import colmap, load_scene
from splatseed.io.ply import write_ply
from splatseed.pointcloud import PointCloud


def _assert_refused(run, *says):
    """The rules that every error on the command line obeys."""
    assert run.code == 2, run
    assert run.err.startswith("error: expected ")
    assert run.err.count("\n") == 1
    assert "; found " in run.err
    assert "Traceback" not in run.out + run.err
    for text in says:
        assert str(text) in run.err


def _names(folder):
    return sorted(path.name for path in folder.iterdir())


def _truncate(room):
    path = room / "sparse/0/points3D.bin"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _claim_too_much(room):
    path = room / "sparse/0/points3D.bin"
    path.write_bytes(struct.pack("<Q", 1 << 60) + path.read_bytes()[8:])


def _append(room):
    with (room / "sparse/0/points3D.bin").open("ab") as file:
        file.write(b"more")


def _text_garbage(room):
    (room / "sparse/0/points3D.bin").unlink()
    (room / "sparse/0/points3D.ply").unlink()
    (room / "sparse/0/points3D.txt").write_text("# points\n1 2 3 these are no numbers\n")


def _unknown_model(room):
    path = room / "sparse/0/cameras.bin"
    data = bytearray(path.read_bytes())
    struct.pack_into("<i", data, 12, 99)  # count u64, camera id u32, then the model
    path.write_bytes(data)


def _unknown_model_name(room):
    (room / "sparse/0/cameras.bin").unlink()
    (room / "sparse/0/cameras.txt").write_text("1 FISHEYE_9 120 90 100 60 45\n")


def _no_points(room):
    for path in (room / "sparse/0").glob("points3D.*"):
        path.unlink()
    (room / "sparse/0/points3D.bin").write_bytes(struct.pack("<Q", 0))


def _folder_for_file(room):
    (room / "sparse/0/points3D.bin").unlink()
    (room / "sparse/0/points3D.ply").unlink()
    (room / "sparse/0/points3D.ply").write_bytes(b"")


def _broken_json(room):
    shutil.rmtree(room / "sparse")
    (room / "transforms.json").write_text('{"frames": [')


def _nothing(room):
    shutil.rmtree(room / "sparse")


DAMAGE = [
    (_truncate, "points3D.bin"),
    (_claim_too_much, "points3D.bin"),
    (_append, "points3D.bin"),
    (_text_garbage, "points3D.txt"),
    (_unknown_model, "99"),
    (_unknown_model_name, "FISHEYE_9"),
    (_no_points, "--poses-from"),
    (_folder_for_file, "points3D.ply"),
    (_broken_json, "transforms.json"),
    (_nothing, "splatseed sfm"),
]


@pytest.mark.parametrize(("spoil", "says"), DAMAGE)
def test_a_damaged_scene(spoil, says, own_room, tmp_path, splatseed):
    spoil(own_room)
    before = _names(tmp_path)
    words = ["--method", "mls"] if spoil is _no_points else []  # photographs alone do for others
    _assert_refused(splatseed("upsample", own_room, *words, "-o", tmp_path / "out"), says)
    assert _names(tmp_path) == before
    if spoil is not _no_points:  # which info reports
        _assert_refused(splatseed("info", own_room), says)


@pytest.mark.parametrize("method", ["linear", "triangle", "spline", "mls", "voronoi"])
def test_one_point_is_too_few(method, tmp_path, splatseed):
    write_ply(tmp_path / "one.ply", _cloud([[1, 2, 3]]))
    words = ("upsample", tmp_path / "one.ply", "-o", tmp_path / "deep/out", "--method", method)
    _assert_refused(splatseed(*words), "point")
    assert _names(tmp_path) == ["one.ply"]


def _cloud(xyz):
    xyz = np.array(xyz, np.float32)
    return PointCloud(xyz, np.full(xyz.shape, 100, np.uint8))


def test_nan_points_are_left_out_and_told_of(rng, tmp_path, splatseed):
    xyz = rng.random((100, 3))
    xyz[[3, 50]] = np.nan
    xyz[60] = xyz[61]
    write_ply(tmp_path / "some.ply", _cloud(xyz))
    run = splatseed("upsample", tmp_path / "some.ply", "-o", tmp_path / "out", "--ratio", 2)
    assert run.code == 0
    assert "2 points are not finite" in run.out
    assert "2 not finite, 1 duplicate" in run.out
    written = load_scene(tmp_path / "out").points
    assert len(written) == 2 * (100 - 3)
    assert written.finite.all()


def test_missing_images_are_a_note(own_room, tmp_path, splatseed):
    (own_room / "images/view_003.png").unlink()
    run = splatseed("upsample", own_room, "-o", tmp_path / "out")
    assert (run.code, run.err) == (0, "")
    assert "view_003.png" in run.out
    shutil.rmtree(own_room / "images")
    run = splatseed("upsample", own_room, "-o", tmp_path / "second")
    assert run.code == 0
    assert "images" in run.out.splitlines()[0]


def test_a_taken_output_is_refused(room, tmp_path, splatseed):
    out = tmp_path / "out"
    assert splatseed("upsample", room, "-o", out).code == 0
    before = {path: path.read_bytes() for path in out.rglob("*.bin")}
    _assert_refused(splatseed("upsample", room, "-o", out, "--ratio", 2), out, "--overwrite")
    assert {path: path.read_bytes() for path in out.rglob("*.bin")} == before
    assert _names(tmp_path) == ["out"]


@pytest.mark.parametrize("words", [[], ["--overwrite"]])
def test_what_splatseed_did_not_write_is_never_replaced(words, room, tmp_path, splatseed):
    thesis = tmp_path / "work" / "thesis.tex"
    thesis.parent.mkdir()
    thesis.write_text("years")
    _assert_refused(splatseed("upsample", room, "-o", thesis.parent, *words), "did not write")
    _assert_refused(splatseed("upsample", room, "-o", thesis, *words), "a file")
    assert thesis.read_text() == "years"
    assert _names(tmp_path) == ["work"]


@pytest.mark.parametrize("words", [[], ["--overwrite"]])
@pytest.mark.parametrize("place", [".", "up", "sparse", "sparse/0/up", ".."])
def test_the_input_is_no_place_for_the_output(place, words, own_room, tmp_path, splatseed):
    before = sorted(tmp_path.rglob("*"))
    run = splatseed("upsample", own_room, "-o", own_room / place, *words)
    _assert_refused(run, "apart from the input")
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere; simulated below")
def test_no_permission_to_write(room, tmp_path, splatseed):
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    _assert_refused(splatseed("upsample", room, "-o", locked / "out"), "write-protected")


@pytest.mark.parametrize(
    ("number", "says"), [(errno.ENOSPC, "Free some space"), (errno.EACCES, "may write to")]
)
def test_a_full_or_forbidden_disk_leaves_nothing(
    number, says, room, tmp_path, splatseed, monkeypatch
):
    _fail_halfway(monkeypatch, OSError(number, os.strerror(number)))
    _assert_refused(splatseed("upsample", room, "-o", tmp_path / "deep/out"), says)
    assert _names(tmp_path) == []


def test_a_full_disk_spares_the_earlier_output(room, tmp_path, splatseed, monkeypatch):
    out = tmp_path / "out"
    assert splatseed("upsample", room, "-o", out).code == 0
    before = {path: path.read_bytes() for path in out.rglob("*.bin")}
    _fail_halfway(monkeypatch, OSError(errno.ENOSPC, "full"))
    _assert_refused(splatseed("upsample", room, "-o", out, "--ratio", 2, "--overwrite"))
    assert {path: path.read_bytes() for path in out.rglob("*.bin")} == before
    assert _names(tmp_path) == ["out"]


@pytest.mark.parametrize(
    ("what", "code", "says"),
    [(KeyboardInterrupt(), 130, "interrupted"), (MemoryError("none"), 2, "fewer points")],
)
def test_an_interrupt_leaves_nothing(what, code, says, room, tmp_path, splatseed, monkeypatch):
    _fail_halfway(monkeypatch, what)
    run = splatseed("upsample", room, "-o", tmp_path / "deep/out")
    assert run.code == code
    assert says in run.err
    assert _names(tmp_path) == []


def _fail_halfway(monkeypatch, error):
    """Let the points' file fail after some of it is written."""

    def write(path, points, tracks=None):
        Path(path).write_bytes(b"half")
        raise error

    monkeypatch.setattr(colmap, "write_points3d", write)


def test_memory_that_ran_out_is_said_so_whatever_the_error_says(splatseed, monkeypatch):
    for error, says in (
        (MemoryError(), "found none left."),
        (MemoryError("a lot"), "found a lot."),
    ):
        monkeypatch.setattr(info, "run", lambda _, error=error: (_ for _ in ()).throw(error))
        _assert_refused(splatseed("info", "somewhere"), says)
