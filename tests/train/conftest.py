"""A small capture on disk, and runs on it."""

from __future__ import annotations

import os

# Set before PyTorch loads its thread pool, as the command line does: see splatseed.cli.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import pytest

pytest.importorskip("torch", reason="training needs PyTorch")
pytest.importorskip("gsplat", reason="training needs gsplat's strategies")

from splatseed.io import load_scene
from splatseed.synthetic import make_capture, write_capture
from splatseed.train.run import RunOptions, prepare_run
from splatseed.train.settings import TrainSettings


@pytest.fixture(scope="session")
def room_path(tmp_path_factory):
    """A COLMAP scene of 9 views of 96 x 72, not to be written to."""
    path = tmp_path_factory.mktemp("room") / "room"
    return write_capture(make_capture(0, num_views=9, width=96, height=72), path)


@pytest.fixture(scope="session")
def room(room_path):
    return load_scene(room_path)


@pytest.fixture
def begin(room, tmp_path):
    """Prepares a run of the room; ``begin(name, RunOptions(), strategy=...)``."""

    def prepare(name="run", options=None, **settings):
        asked = TrainSettings(**{"max_steps": 60, "data_factor": 2, **settings})
        return prepare_run(room, tmp_path / name, asked, options or RunOptions())

    return prepare
