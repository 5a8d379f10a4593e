"""The larger room's path, and a run of it."""

from __future__ import annotations

import dataclasses
import json

import pytest

pytest.importorskip("torch", reason="rendering needs PyTorch")

from splatseed.io import load_scene
from splatseed.splat.formats import write_gaussians
from splatseed.splat.from_seeds import initial_gaussians
from splatseed.training.settings import TrainSettings


@pytest.fixture(scope="session")
def room(larger_room_path):
    """The path of the larger room."""
    return larger_room_path


@pytest.fixture(scope="session")
def run_folder(room, tmp_path_factory):
    """What a run leaves, of Gaussians that nobody trained."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    folder.mkdir()
    config = {"scene": str(room), **dataclasses.asdict(TrainSettings(max_steps=1))}
    for name in ("config.json", "splatseed.json"):
        (folder / name).write_text(json.dumps(config))
    gaussians = initial_gaussians(load_scene(room).points, opacity=0.9)
    write_gaussians(folder / "point_cloud.ply", gaussians)
    return folder
