"""``splatseed info`` on every kind of scene."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.io import load_scene, write_scene
from splatseed.io.colmap import write_points3d
from splatseed.io.ply import write_ply
from splatseed.pointcloud import PointCloud


def _rows(out):
    """Label to value, from the table."""
    lines = [line.strip().split("  ", 1) for line in out.splitlines()]
    return {line[0]: line[1].strip() for line in lines if len(line) == 2}


def test_a_colmap_scene(room, splatseed):
    run = splatseed("info", room)
    assert (run.code, run.err) == (0, "")
    scene, rows = load_scene(room), _rows(run.out)
    assert rows["format"] == "colmap"
    assert rows["cameras"] == "1 PINHOLE 120x90"
    assert rows["images"] == "12 (10 to train, 2 to test)"
    assert rows["points"] == f"{len(scene.points):,}"
    assert rows["track length, images"].startswith(f"mean {scene.tracks.lengths.mean():.3g},")
    assert rows["reprojection error, px"].startswith(f"mean {scene.tracks.errors.mean():.3f},")
    low = [float(x) for x in rows["bounding box"].split()[:3]]
    np.testing.assert_allclose(low, scene.points.xyz.min(axis=0), rtol=1e-3)
    assert run.out.partition("\nnext\n")[2].split()[1:3] == ["splatseed", "upsample"]


def test_for_scripts_it_is_json_alone(room, splatseed):
    run = splatseed("info", room, "--json")
    assert (run.code, run.err) == (0, "")
    facts = json.loads(run.out)
    assert (facts["images"], facts["train_images"] + facts["test_images"]) == (12, 12)
    assert facts["points"]["num_points"] > 400
    assert len(facts["points"]["spacing"]) == 5
    assert isinstance(facts["problems"], list)


def test_a_full_cloud_is_to_be_left_as_it_is(room, splatseed):
    out = splatseed("info", room, "--budget", 60, "--max-steps", 500).out
    assert "leave the points as they are" in out
    assert "--seeds scene --budget 60 --max-steps 500" in out.partition("\nnext\n")[2]


def test_a_sparse_cloud_is_to_be_added_to_and_a_trial_is_of_the_same_plan(room, splatseed):
    out = splatseed("info", room, "--budget", 5400, "--max-steps", 20000).out
    assert "add points by method auto" in out
    assert f"splatseed upsample {room} --budget" in out
    assert "--minutes 30 --budget 0.5rho --max-steps 20000\n" in out


WITHOUT_NUMBA = """
import sys
from splatseed.cli import main
main(sys.argv[1:])
assert "numba" not in sys.modules
assert "torch" not in sys.modules
"""


def test_info_does_not_wait_for_numba(room):
    words = [sys.executable, "-c", WITHOUT_NUMBA, "info", str(room)]
    run = subprocess.run(words, capture_output=True, check=False, text=True, timeout=60)
    assert (run.returncode, run.stderr) == (0, "")
    assert "image area without points" in run.stdout


def test_poses_without_points_ask_for_triangulation(room, tmp_path, splatseed):
    write_scene(load_scene(room), tmp_path / "nerf", format="transforms")
    for path in (tmp_path / "nerf").glob("*.ply"):
        path.unlink()
    run = splatseed("info", tmp_path / "nerf")
    assert run.code == 0
    assert _rows(run.out)["points"] == "none"
    assert "there are no points" in run.out
    assert f"--poses-from {tmp_path / 'nerf'}" in run.out
    assert "nan" not in run.out


def test_an_rgbd_capture(tmp_path, splatseed):
    camera = {"w": 16, "h": 12, "fx": 10, "fy": 10, "cx": 8, "cy": 6}
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": camera}))
    (tmp_path / "results").mkdir()
    PilImage.new("RGB", (16, 12)).save(tmp_path / "results/frame000000.jpg")
    (tmp_path / "traj.txt").write_text(" ".join(str(x) for x in np.eye(4).ravel()) + "\n")
    run = splatseed("info", tmp_path)
    assert run.code == 0
    assert _rows(run.out)["format"] == "rgbd"
    assert f"splatseed sfm {tmp_path / 'results'}" in run.out
    assert "no points yet: splatseed upsample makes some from the photographs" in run.out
    assert "cannot be compared: expected at least two photographs with a pose" in run.out
    assert "  seeds" not in run.out


@pytest.mark.parametrize(
    ("xyz", "points", "finite"),
    [(np.zeros((0, 3)), "none", True), (np.full((4, 3), np.nan), "4", False)],
)
def test_clouds_of_nothing(xyz, points, finite, tmp_path, splatseed):
    write_ply(tmp_path / "cloud.ply", PointCloud(xyz, np.zeros(xyz.shape, np.uint8)))
    run = splatseed("info", tmp_path / "cloud.ply")
    assert run.code == 0
    assert _rows(run.out)["points"] == points
    assert ("not finite" in run.out) != finite
    assert "nan" not in run.out


def test_points_that_were_put_into_another_model_are_a_problem(own_room, room, splatseed):
    write_points3d(own_room / "sparse/0/points3D.bin", load_scene(room).points, None)
    out = splatseed("info", own_room).out
    assert _rows(out)["tracks"] == "none"
    assert "features of the photographs name points, but no point has a track" in out
    assert "nan" not in out
    assert (
        splatseed("upsample", own_room, "--method", "mls", "-o", own_room.with_name("up")).code == 0
    )
    assert "name points, but" not in splatseed("info", own_room.with_name("up")).out


def test_unknown_reprojection_errors_are_called_so(own_room, splatseed):
    path = own_room / "sparse/0/points3D.bin"
    scene = load_scene(own_room)
    unknown = dataclasses.replace(scene.tracks, errors=np.full(len(scene.tracks), -1.0))
    write_points3d(path, scene.points, unknown)
    assert _rows(splatseed("info", own_room).out)["reprojection error, px"] == "unknown"
