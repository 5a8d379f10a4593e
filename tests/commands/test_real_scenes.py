"""The command line on real captures, each by another method."""

from __future__ import annotations

import pycolmap
import pytest

from splatseed.io import load_scene

RUNS = [
    ("bonsai", "mls"),
    ("fox", "linear"),
    ("fern", "triangle"),
    ("treehill", "voronoi"),
    ("mipnerf360_sfm/bicycle", "spline"),
    ("mipnerf360_sfm/stump", "random"),
]


@pytest.mark.parametrize(("name", "method"), RUNS)
def test_colmap_scenes_are_upsampled_and_open(name, method, scenes, tmp_path, splatseed):
    run = splatseed(
        "upsample", scenes / name, "--method", method, "--ratio", 2, "-o", tmp_path / "o"
    )
    assert (run.code, run.err) == (0, "")
    before, after = load_scene(scenes / name), load_scene(tmp_path / "o")
    model = pycolmap.Reconstruction(tmp_path / "o/sparse/0")
    assert model.num_points3D() == len(after.points)
    assert model.num_images() == len(before.images)
    assert ("train it with" in run.out) == bool(before.images)
    # Duplicates of the input are left out, and told of.
    assert 1.9 * len(before.points) < len(after.points) <= 2 * len(before.points)
    assert ("repeat the position" in run.out) == ("left out" in run.out)


@pytest.mark.parametrize("name", [name for name, _ in RUNS[1:]])
def test_info_on_real_captures(name, scenes, splatseed):
    run = splatseed("info", scenes / name)
    assert (run.code, run.err) == (0, "")
    scene = load_scene(scenes / name)
    total = len(scene.points) + scene.left_out.duplicates + scene.left_out.non_finite
    assert f"{total:,}" in run.out
    assert "nan" not in run.out


@pytest.mark.parametrize("name", ["replica/room0", "7scenes_redkitchen"])
def test_depth_captures_need_no_points_for_the_default(name, scenes, tmp_path, splatseed):
    run = splatseed("info", scenes / name)
    assert run.code == 0
    assert "--poses-from" in run.out
    assert "nan" not in run.out
    run = splatseed("upsample", scenes / name, "--method", "mls", "-o", tmp_path / "out")
    assert run.code == 2
    assert "--poses-from" in run.err
    assert not list(tmp_path.iterdir())
    few = ["--auto.hold-out", 0, "--auto.max-size", 320]
    run = splatseed("upsample", scenes / name, *few, "-o", tmp_path / "out")
    assert run.code == 0
    assert len(load_scene(tmp_path / "out").points) > 3000
