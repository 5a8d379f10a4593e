"""What Ray's workers import: nothing of the working directory; and what they cannot is told."""

from __future__ import annotations

import importlib
import tempfile

import pytest

pytest.importorskip("ray", reason="Ray is an extra: pip install -e '.[cluster]'")

from splatseed.errors import ParameterError
from splatseed.process.ray_tasks import ray_cluster
from splatseed.process.tasks import RayTasks


@pytest.mark.slow
def test_workers_import_nothing_of_the_working_directory(tmp_path, monkeypatch):
    monkeypatch.setenv("RAY_TMPDIR", tempfile.mkdtemp(dir="/tmp"))  # names of sockets must be short
    monkeypatch.setenv("RAY_worker_niceness", "0")  # or workers wait for every other process
    mark = tmp_path / "mark"
    for name in ("numpy", "splatseed", "tempfile", "wave"):
        (tmp_path / f"{name}.py").write_text(f"open({str(mark)!r}, 'a').write({name!r})")
    (tmp_path / "unknown").mkdir()
    (tmp_path / "unknown" / "elsewhere.py").write_text("def task():\n    pass\n")
    monkeypatch.chdir(tmp_path)

    def task():
        import wave  # no worker has imported it before

        import splatseed

        assert hasattr(wave, "Wave_read")
        assert callable(splatseed.upsample)

    with ray_cluster(None):
        RayTasks(1, 1).run(task, [()], "stage", lambda *_: None)
        assert not mark.exists()
        monkeypatch.syspath_prepend(tmp_path / "unknown")
        function = importlib.import_module("elsewhere").task
        told = "splatseed on every node .*; found ModuleNotFoundError: .*'elsewhere'"
        with pytest.raises(ParameterError, match=told):
            RayTasks(1, 1).run(function, [()], "stage", lambda *_: None)
