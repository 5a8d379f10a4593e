"""Tiles as tasks of a Ray cluster, one of whose workers is killed."""

from __future__ import annotations

import os
import tempfile

import numpy as np
import pytest

pytest.importorskip("ray", reason="Ray is an extra: pip install -e '.[cluster]'")

from splatseed.errors import OutputError
from splatseed.runtime.ray_tasks import RayTasks, ray_cluster
from splatseed.upsample import configure, upsample


def raiser():
    """A task that fails."""

    def fail():
        raise OutputError("a manifest", found="none", fix="Give up.")

    return fail


class DyingTasks(RayTasks):
    """A cluster of which one worker is killed."""

    def __init__(self, flag):
        super().__init__(1, jobs=1)
        self.flag = flag

    def run(self, function, calls, report=None):
        def dying(flag, *arguments):  # the workers cannot import this file
            if not flag.exists():
                flag.touch()
                os._exit(9)
            function(*arguments)

        return super().run(dying, [(self.flag, *call) for call in calls], report)


@pytest.mark.slow
def test_a_cluster_gives_the_same_bytes_though_a_worker_is_killed(
    sheet, tiles, tmp_path, monkeypatch
):
    monkeypatch.setenv("RAY_TMPDIR", tempfile.mkdtemp(dir="/tmp"))  # names of sockets must be short
    monkeypatch.setenv("RAY_worker_niceness", "0")  # or workers wait for every other process
    flag = tmp_path / "killed"
    with ray_cluster(None):
        xyz, _ = tiles(sheet, "linear", configure("linear"), most=250, tasks=DyingTasks(flag))
        with pytest.raises(OutputError, match="expected a manifest; found none"):
            RayTasks(1, jobs=1).run_all(raiser(), [()], "stage", lambda *_: None)
    assert flag.exists()
    expected = upsample(sheet.select(sheet.distinct), "linear", ratio=3)
    np.testing.assert_array_equal(xyz, expected.xyz)
