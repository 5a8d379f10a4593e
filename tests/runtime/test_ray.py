"""Tasks on a Ray cluster: its address, what workers import, and what they cannot."""

from __future__ import annotations

import importlib
import importlib.util
import socket
import tempfile

import pytest

if importlib.util.find_spec("ray") is None:  # not imported here: half a second in each process
    pytest.skip("Ray is an extra: pip install -e '.[cluster]'", allow_module_level=True)

from splatseed.errors import ParameterError
from splatseed.runtime.ray_tasks import RayWorkers, ray_cluster
from splatseed.runtime.tasks import run_tasks


@pytest.mark.parametrize("address", ["127.0.0.1:{}", "ray://127.0.0.1:{}", "127.0.0.1:{}0000"])
def test_where_nothing_answers_is_no_cluster(address, monkeypatch):
    """Ray may not be asked about it, as it does not give up."""
    monkeypatch.setattr("ray.init", lambda **_: pytest.fail("Ray was asked"))
    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))
        address = address.format(reserved.getsockname()[1])
        with pytest.raises(ParameterError, match="no answer there") as caught:
            ray_cluster(address).__enter__()
    assert address in str(caught.value)
    monkeypatch.undo()
    for word in ("nonsense", "host:port"):  # Ray itself says that these are none
        with pytest.raises(ParameterError, match="a Ray cluster at"):
            ray_cluster(word).__enter__()


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
        return callable(splatseed.upsample)

    with ray_cluster(None):
        workers = RayWorkers(1, limit=1)
        assert [each.value for each in run_tasks(workers, task, [()])] == [True]
        assert not mark.exists()
        monkeypatch.syspath_prepend(tmp_path / "unknown")
        function = importlib.import_module("elsewhere").task
        (result,) = run_tasks(RayWorkers(1, limit=1), function, [()])
        assert isinstance(result.error, ParameterError)
        assert "splatseed on every node" in str(result.error)
        assert "'elsewhere'" in str(result.error)
