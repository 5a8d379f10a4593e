"""The command line on real captures, each by another method."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pycolmap
import pytest

from splatseed.io import load_scene


@pytest.mark.parametrize(
    ("name", "method"),
    [
        ("fox", "mls"),
        ("fern", "voronoi"),
        ("mipnerf360_sfm/bicycle", "triangle"),
        ("mipnerf360_sfm/stump", "spline"),
    ],
)
def test_colmap_scenes_are_described_and_upsampled(name, method, scenes, tmp_path, splatseed):
    path, out = scenes / name, tmp_path / "out"
    run = splatseed("info", path)
    assert (run.code, run.unexpected) == (0, "")
    before = load_scene(path)
    total = len(before.points) + before.left_out.duplicates + before.left_out.non_finite
    assert f"{total:,}" in run.out
    assert "nan" not in run.out
    run = splatseed("upsample", path, "--method", method, "--ratio", 2, "-o", out)
    assert (run.code, run.unexpected) == (0, "")
    after, model = load_scene(out), pycolmap.Reconstruction(out / "sparse/0")
    assert model.num_points3D() == len(after.points)
    assert model.num_images() == len(before.images)
    assert ("train it with" in run.out) == bool(before.images)
    # Duplicates of the input are left out, and told of.
    assert 1.9 * len(before.points) < len(after.points) <= 2 * len(before.points)
    assert ("repeat the position" in run.err) == ("left out" in run.err)
    assert re.search(rf"points in +{total:,}\n", run.out)


@pytest.fixture
def capture(request, scenes, tmp_path_factory) -> Path:
    """A capture with depth maps, of its first photographs where there are many."""
    path = scenes / request.param
    poses = (path / "traj.txt").read_text().splitlines(keepends=True)
    if len(poses) < 30:
        return path
    few = tmp_path_factory.mktemp("captures") / path.name
    (few / "results").mkdir(parents=True)
    (few / "traj.txt").write_text("".join(poses[:10]))
    shutil.copy(path / "cam_params.json", few)
    for number in range(10):
        for name in (f"frame{number:06d}.jpg", f"depth{number:06d}.png"):
            (few / "results" / name).symlink_to(path / "results" / name)
    return few


@pytest.mark.parametrize("capture", ["replica/room0", "7scenes_redkitchen"], indirect=True)
def test_depth_captures_need_no_points_for_the_default(capture, tmp_path, splatseed):
    run = splatseed("info", capture)
    assert run.code == 0
    assert "--poses-from" in run.out
    assert "nan" not in run.out
    run = splatseed("upsample", capture, "--method", "mls", "-o", tmp_path / "out")
    assert run.code == 2
    assert "--poses-from" in run.err
    assert not list(tmp_path.iterdir())
    if capture.name == "room0":
        few = ["--auto.test-every", 0, "--auto.max-size", 240]
        run = splatseed("upsample", capture, *few, "-o", tmp_path / "out")
        assert run.code == 0
        assert len(load_scene(tmp_path / "out").points) > 1500
