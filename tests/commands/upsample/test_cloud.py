"""``splatseed upsample --cloud``: flags, frames, reports, one-line refusals."""

from __future__ import annotations

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

from splatseed.camera import rotation_from_quat
from splatseed.commands.upsample.cloud import LoadedCloud
from splatseed.io import load_scene, write_scene
from splatseed.io.cleaning import recentred
from splatseed.io.ply import write_ply
from splatseed.io.staging import unlisted_files
from splatseed.similarity import Similarity
from splatseed.synthetic import make_capture
from splatseed.upsample.registry import SOURCE_CODES

CLOUD = SOURCE_CODES["cloud"]
MOVE = Similarity(
    0.5, rotation_from_quat(np.array([0.8, 0.0, 0.6, 0.0])), np.array([7e5, 4e6, 0.0])
)


@pytest.fixture(scope="module")
def xyz():
    return make_capture(0, 3, 32, 32).surfaces.sample(60_000, np.random.default_rng(2))


@pytest.fixture(scope="module")
def scan(tmp_path_factory, xyz):
    path = tmp_path_factory.mktemp("scan") / "scan.npz"
    np.savez(path, xyz=xyz)
    return path


@pytest.fixture(scope="module")
def moved(tmp_path_factory, xyz):
    path = tmp_path_factory.mktemp("moved") / "scan.npz"
    np.savez(path, xyz=MOVE.points(xyz))
    return path


def test_a_scan_in_the_scenes_frame(splatseed, room, scan, tmp_path):
    out = tmp_path / "out"
    run = splatseed(
        "upsample", room, "--cloud", scan, "--cloud", scan, "-o", out, "--budget", "1.5k"
    )
    assert run.code == 0, run.err
    seeds = load_scene(out).points
    assert len(seeds) == 1500
    assert CLOUD in seeds.source
    assert "cloud)" in run.out
    assert "120,000 points were read" in run.err + run.out
    assert re.search(r"voxels, 4\.\d GB of memory", run.out)
    told = json.loads((out / "splatseed.json").read_text())
    assert told["method"] == "cloud"
    assert len(told["cloud"]["files"]) == 2


@pytest.mark.parametrize("name", ["t.txt", "t.json", "dataparser_transforms.json"])
def test_transforms_from_files(splatseed, room, scan, moved, tmp_path, name):
    back = MOVE.inverse
    if name == "t.txt":
        np.savetxt(tmp_path / name, np.vstack([back.matrix, [0, 0, 0, 1]]))
    elif name == "t.json":
        content = {"matrix": [*back.matrix.tolist(), [0, 0, 0, 1]]}
        (tmp_path / name).write_text(json.dumps(content))
    else:  # from the scene to nerfstudio's world: scale after rotation and translation
        rows = np.column_stack([MOVE.rotation, MOVE.translation / MOVE.scale])
        content = {"transform": rows.tolist(), "scale": MOVE.scale}
        (tmp_path / name).write_text(json.dumps(content))
    words = ("--transform", tmp_path / name, "-o", tmp_path / "out")
    run = splatseed("upsample", room, "--cloud", moved, *words)
    assert run.code == 0, run.err
    splatseed("upsample", room, "--cloud", scan, "-o", tmp_path / "plain")
    first, second = (load_scene(tmp_path / each).points for each in ("plain", "out"))
    assert abs(len(first) - len(second)) < 0.01 * len(first)
    off = make_capture(0, 3, 32, 32).surfaces.distance(
        second.xyz[second.source == CLOUD].astype(float)
    )
    assert np.median(np.abs(off)) < 0.01


def test_recentring_moves_scene_and_cloud_alike(splatseed, room, xyz, tmp_path):
    grid = np.array([564000.0, 5932000.0, 90.0])
    far = recentred(load_scene(room), -grid)
    write_scene(far, tmp_path / "far", copy_images=True)
    np.savez(tmp_path / "far.npz", xyz=xyz + grid)
    words = ("upsample", tmp_path / "far", "--cloud", tmp_path / "far.npz", "-o", tmp_path / "out")
    refused = splatseed(*words)
    assert refused.code == 2
    assert "--recenter" in refused.err
    run = splatseed(*words, "--recenter", "--overwrite")
    assert run.code == 0, run.err
    assert unlisted_files(tmp_path / "out") == []
    offset = np.array(json.loads((tmp_path / "out" / "recenter.json").read_text())["offset"])
    assert np.abs(offset - grid).max() < 3
    out, plain = load_scene(tmp_path / "out"), load_scene(room)
    for new, old in zip(out.images, plain.images, strict=True):
        np.testing.assert_allclose(new.camera.center + offset - grid, old.camera.center, atol=1e-6)
    np.testing.assert_allclose(
        out.tracks.xyz + offset - grid, plain.tracks.xyz[: len(out.tracks)], atol=1e-6
    )


FAR = np.array([564_000, 5_932_000, 87])
SPOILT = {
    "cut short": lambda xyz: xyz,
    "empty": lambda xyz: xyz[:0],
    "not a number": lambda xyz: np.full_like(xyz[:9], np.nan),
    "degrees": lambda xyz: np.column_stack([xyz[:, :2] / 1e5 + (11.5, 48.1), xyz[:, 2] + 500]),
    "a national grid": lambda xyz: xyz + FAR,
    "another place": lambda xyz: np.column_stack([3 * xyz[:, :2], 0.5 * np.sin(xyz[:, 0])]),
    "once, a million times": lambda xyz: np.repeat(xyz[:1] + 9, 1_000_000, axis=0),
}


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("cut short", r"scan\.npz to be an archive of NumPy arrays"),
        ("empty", "points with finite coordinates in .*found none"),
        ("not a number", "found 9 that are not finite"),
        ("a national grid", r"none of 60,000, .* \(56\d{4}, 59\d{5}, .*--align.*--recenter would"),
        ("another place", "at its depth. It is in another frame .* or of another place"),
        ("once, a million times", "found none of 1,000,000"),
    ],
)
def test_what_is_wrong_with_a_scan_is_one_line(splatseed, room, xyz, tmp_path, kind, says):
    path = tmp_path / "scan.npz"
    np.savez(path, xyz=SPOILT[kind](xyz))
    if kind == "cut short":
        path.write_bytes(path.read_bytes()[:-20_000])
    run = splatseed("upsample", room, "--cloud", path, "-o", tmp_path / "out")
    assert run.code == 2
    assert re.search(says, run.err.replace("\n", " "))
    assert len([line for line in run.err.splitlines() if line.startswith("error")]) == 1
    assert not list(tmp_path.glob("out*"))


def test_the_files_of_an_alignment_are_listed(splatseed, room, scan, tmp_path, monkeypatch):
    found = SimpleNamespace(
        report={}, residuals=np.zeros(1), extent=1.0, sample=None, rgb=None, marks=None, sentence=""
    )
    monkeypatch.setattr(
        "splatseed.commands.upsample.command.load_cloud",
        lambda _, scene, method, __: LoadedCloud(scene, method.of(scan), alignment=found),
    )
    monkeypatch.setattr("splatseed.view.clouds.preview_alignment", lambda *given: given[-1].touch())
    out = tmp_path / "out"
    run = splatseed("upsample", room, "--cloud", scan, "-o", out)
    assert run.code == 0, run.err
    for name in ("alignment.json", "preview_alignment.png"):
        assert (out / name).is_file()
        assert str(out / name) in run.out
    assert unlisted_files(out) == []  # so that --overwrite replaces them


def test_a_cloud_beside_cover(splatseed, room, scan, tmp_path):
    few = load_scene(room).points
    write_ply(tmp_path / "part.ply", few.select(few.xyz[:, 0] < np.median(few.xyz[:, 0])))
    words = ("--cloud", scan, "--method", "cover", "-o", tmp_path / "out", "--preview")
    run = splatseed("upsample", room, *words)
    assert run.code == 0, run.err
    for i, method in enumerate(("cloud", "cover")):
        words = ("--cloud", tmp_path / "part.ply", "--method", method, "-o", tmp_path / f"part{i}")
        run = splatseed("upsample", room, *words)
        assert "The cloud covers" in run.out
        assert ("seeds the rest" in run.out) == (method == "cloud")
    assert {0, CLOUD, SOURCE_CODES["cover"]} <= set(load_scene(tmp_path / "out").points.source)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--method", "cloud"), "--cloud FILE"),
        (("--transform", "x.txt"), "--cloud FILE"),
        (("--align",), "--cloud FILE"),
        (("--cloud", "SCAN", "--memory", "500M"), "found 500 MB. Pass --memory 6"),
        (("--cloud", "SCAN", "--memory", "a lot"), "such as 4G or 500M; found 'a lot'"),
        (("--cloud", "none.laz"), "no such file"),
        (("--cloud", "SCAN", "--method", "mls"), "with --cloud; found mls"),
        (("--cloud", "SCAN", "--align", "--transform", "t.txt"), "found both"),
        (("--cloud", "SCAN", "--transform", "none.txt"), "none.txt"),
        (("--cloud", "MOVED"), "found none of 60,000"),
        (("--cloud", "SCAN", "--recenter", "--format", "transforms"), "--format colmap"),
    ],
)
def test_refusals_are_one_line_and_leave_nothing(
    splatseed, room, scan, moved, tmp_path, words, says
):
    words = [{"SCAN": scan, "MOVED": moved}.get(word, word) for word in words]
    run = splatseed("upsample", room, *words, "-o", tmp_path / "out")
    assert run.code == 2
    assert says in run.err
    assert len([line for line in run.err.splitlines() if line.startswith("error")]) == 1
    assert not (tmp_path / "out").exists()
