"""``splatseed upsample`` on captures that have poses but no points, and on poses that are wrong."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splatseed.io import load_scene, write_scene

LOOKED = "auto: no points, so depth is found by comparing photographs"


@pytest.fixture
def bare(room, tmp_path) -> Path:
    """The room in nerfstudio's layout, without its points."""
    folder = tmp_path / "bare"
    write_scene(load_scene(room), folder, format="transforms")
    for path in folder.glob("*.ply"):
        path.unlink()
    (folder / "splatseed.json").unlink(missing_ok=True)
    return folder


def test_it_says_how_depth_is_found_and_how_much(bare, tmp_path, splatseed):
    run = splatseed("upsample", bare, "-o", tmp_path / "out")
    assert (run.code, run.err) == (0, "")
    assert f"-> {LOOKED}\n" in run.out
    assert "note: There were no points to begin from: comparing the photographs gave" in run.out
    assert load_scene(tmp_path / "out").points.num_original == 0


def test_depth_maps_show_where_to_look(rgbd, tmp_path, splatseed):
    run = splatseed("upsample", rgbd, "--method", "stereo", "-o", tmp_path / "out")
    assert run.code == 0
    assert "photographs, around its depth maps\n" in run.out
    assert len(load_scene(tmp_path / "out").points) > 100


def test_wrong_axes_are_named_before_the_search(bare, tmp_path, splatseed):
    content = json.loads((bare / "transforms.json").read_text())
    for frame in content["frames"]:
        opengl = np.array(frame["transform_matrix"])
        frame["transform_matrix"] = (opengl @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()
    (bare / "transforms.json").write_text(json.dumps(content))
    run = splatseed("upsample", bare, "-o", tmp_path / "out")
    assert run.code == 2
    assert "once the y and z axes of every camera are negated" in run.err
    assert "transform_matrix is world_from_cam, with OpenGL's camera axes" in run.err
    assert not (tmp_path / "out").exists()
