"""A small scene on disk, and plans for it."""

from __future__ import annotations

import shutil

import pytest

from splatseed.bench.plan import Plan
from splatseed.bench.scenes import PlannedScene
from splatseed.training.settings import TrainSettings


class InProcess:
    """``Workers`` that run tasks in this process, which spares them the import of PyTorch."""

    jobs, retries = 1, 0

    def call(self, function, arguments, progress):
        return function(*arguments, **({} if progress is None else {"progress": progress}))

    def stop(self):
        pass

    kill = stop


@pytest.fixture(autouse=True)
def _compare_once(compare_once):
    """Photographs are not the subject of benchmarks."""


@pytest.fixture
def in_process():
    """``InProcess`` workers."""
    return InProcess()


@pytest.fixture(scope="session")
def room_path(room_of):
    """A COLMAP scene of 9 views of 64 x 48 with depth maps, not to be written to."""
    return room_of(9, 64, 48).path


@pytest.fixture
def own_room(room_path, tmp_path):
    """A copy that a test may spoil."""
    return shutil.copytree(room_path, tmp_path / "own room")


@pytest.fixture
def small_plan(room_path):
    """Four runs of three steps."""
    return Plan(
        scenes=(PlannedScene(str(room_path)),),
        methods=("sfm", "linear"),
        ratios=(2,),
        strategies=("none",),
        repeats=2,
        training=TrainSettings(max_steps=3, test_every=4, sh_degree=0, backend="cpu"),
    )
