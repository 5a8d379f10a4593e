"""``splatseed info`` tells from the photographs whether poses without points are good enough."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseed.io import load_scene, write_scene
from splatseed.synthetic import make_capture, write_capture


@pytest.fixture(scope="module")
def large(tmp_path_factory) -> Path:
    """The room in photographs that are large enough for corners to be found again."""
    capture = make_capture(0, num_views=16, width=240, height=180)
    return write_capture(capture, tmp_path_factory.mktemp("large") / "room")


@pytest.fixture
def bare(large, tmp_path) -> Path:
    """The same in nerfstudio's layout, without its points."""
    folder = tmp_path / "bare"
    write_scene(load_scene(large), folder, format="transforms")
    for path in folder.glob("*.ply"):
        path.unlink()
    content = json.loads((folder / "transforms.json").read_text())
    del content["ply_file_path"]
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def _turn(folder: Path, turn_of: object) -> None:
    """Turn each camera about its own axes."""
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    for number, frame in enumerate(content["frames"]):
        pose = np.array(frame["transform_matrix"])
        pose[:3, :3] @= turn_of(number)  # type: ignore[operator]
        frame["transform_matrix"] = pose.tolist()
    path.write_text(json.dumps(content))


def _found(splatseed, folder):
    run = splatseed("info", folder, "--json")
    assert run.code == 0
    return json.loads(run.out)


def test_sound_poses(bare, splatseed):
    facts = _found(splatseed, bare)
    assert facts["poses"]["agreement"] > 0.3
    assert facts["poses"]["error"]["exact"]
    assert len(facts["problems"]) == 1  # that there are no points
    told = splatseed("info", bare).out
    assert "photographs agree  at " in told
    assert "they miss by       0." in told
    assert "--refine-poses" not in told


def test_a_device_s_poses(bare, splatseed):
    rng = np.random.default_rng(0)
    _turn(bare, lambda _: Rotation.from_rotvec(np.radians(0.8) * rng.normal(size=3)).as_matrix())
    poses = _found(splatseed, bare)["poses"]
    assert not poses["error"]["exact"]
    assert 0.3 < poses["error"]["degrees"] < 2
    told = splatseed("info", bare).out
    assert "photographs miss each other by about" in told
    assert f"splatseed upsample {bare} --budget" in told.partition("next")[2]
    assert told.partition("next")[2].count("--refine-poses") == 2


def test_wrong_axes_are_a_problem_not_an_error(bare, splatseed):
    _turn(bare, lambda _: np.diag([1.0, -1.0, -1.0]))
    run = splatseed("info", bare)
    assert run.code == 0
    assert "once the y and z axes of every camera are negated" in run.out
    assert "splatseed upsample" not in run.out.partition("next")[2]


def test_points_vouch_for_poses(room, splatseed):
    assert _found(splatseed, room)["poses"] is None
