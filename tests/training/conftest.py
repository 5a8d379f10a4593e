"""Runs on the room."""

from __future__ import annotations

import pytest

pytest.importorskip("torch", reason="training needs PyTorch")
pytest.importorskip("gsplat", reason="training needs gsplat's strategies")

from splatseed.training.prepare import prepare_run
from splatseed.training.request import PrepareOptions
from splatseed.training.settings import TrainSettings


@pytest.fixture(autouse=True)
def _compare_once(compare_once):
    """Photographs are not the subject of training."""


@pytest.fixture
def begin(room, tmp_path):
    """Prepares a run of the room; ``begin(name, {"resume": True}, strategy=...)``."""

    def prepare(name="run", ways=None, **settings):
        asked = TrainSettings(**{"max_steps": 60, "data_factor": 2, **settings})
        return prepare_run(room, tmp_path / name, asked, PrepareOptions(**(ways or {})))

    return prepare
