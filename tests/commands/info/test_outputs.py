"""``splatseed info`` on what splatseed itself wrote: seeded scenes and runs."""

from __future__ import annotations

import json

import numpy as np
import pytest

from splatseed.io import load_scene, write_scene
from splatseed.train.folder import RunFolder
from splatseed.upsample import upsample


def test_points_of_a_seeded_scene_are_no_problem_for_being_isolated(room, tmp_path, splatseed):
    scene = load_scene(room)
    far = scene.points.xyz.copy()
    far[:40] += 100 * np.arange(1, 41)[:, None]
    scene = scene.replace(points=scene.points.replace(xyz=far), tracks=None)
    write_scene(scene, tmp_path / "plain", provenance={})
    assert "are isolated" in splatseed("info", tmp_path / "plain").out
    seeds = upsample(scene, "linear", ratio=2)
    write_scene(scene.replace(points=seeds), tmp_path / "out", provenance={"command": "upsample"})
    assert "are isolated" not in splatseed("info", tmp_path / "out").out


@pytest.fixture
def seeded(room, tmp_path):
    """The room with points that method linear made."""
    scene = load_scene(room)
    seeds = upsample(scene, "linear", ratio=4)
    path = tmp_path / "my seeds"
    write_scene(scene.replace(points=seeds), path, provenance={"command": "upsample"})
    return path


def test_a_seeded_scene_is_to_be_trained_and_not_seeded_again(seeded, room, splatseed):
    run = splatseed("info", seeded)
    assert (run.code, run.err) == (0, "")
    assert "train it" in run.out
    assert "made 1,392 of its points and kept 464" in run.out
    assert run.out.rstrip().endswith(f"splatseed train '{seeded}' -o RUN")
    assert "upsampl" not in run.out.replace("splatseed upsample made", "")
    isolated = [
        next(line for line in splatseed("info", path).out.splitlines() if "isolated " in line)
        for path in (seeded, room)
    ]
    assert isolated[0].split()[-1] == isolated[1].split()[-1]


def test_a_run_is_told_from_a_scene(tmp_path, splatseed):
    config = {"splatseed": "1", "scene": "/data/fox"}
    (tmp_path / "run").mkdir()
    RunFolder(tmp_path / "run").begin(config)
    run = splatseed("info", tmp_path / "run")
    assert (run.code, run.out) == (2, "")
    assert "a run of splatseed train on the scene /data/fox" in run.err
    assert f"splatseed view {tmp_path / 'run'}" in run.err
    assert f"splatseed evaluate {tmp_path / 'run'}" in run.err
    (tmp_path / "run" / "config.json").write_text(json.dumps([]))
    assert "a run of splatseed train. Look" in splatseed("info", tmp_path / "run").err
