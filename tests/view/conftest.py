"""A small room on disk, and a run of it."""

from __future__ import annotations

import dataclasses
import json

import pytest

pytest.importorskip("torch", reason="rendering needs PyTorch")

from splatseed.io import load_scene
from splatseed.splat.gaussians import initial_gaussians
from splatseed.splat.ply import write_gaussians
from splatseed.synthetic import make_capture, write_capture
from splatseed.train.settings import TrainSettings


@pytest.fixture(scope="session")
def room(tmp_path_factory):
    """A COLMAP scene: 12 images of 120 x 90, about 460 points. Not to be written to."""
    path = tmp_path_factory.mktemp("room") / "room"
    return write_capture(make_capture(0, num_views=12, width=120, height=90), path)


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
