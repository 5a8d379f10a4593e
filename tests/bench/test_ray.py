"""A benchmark on a Ray cluster of local nodes, one of which is lost on the way."""

from __future__ import annotations

import dataclasses
import shutil
import tempfile
import threading
import time
from importlib.util import find_spec

import pytest

pytest.importorskip("torch", reason="training needs PyTorch")
pytest.importorskip("gsplat", reason="training needs gsplat's strategies")
if find_spec("ray") is None:  # not imported here: half a second in each process of the suite
    pytest.skip("Ray is an extra: pip install -e '.[cluster]'", allow_module_level=True)

from splatseed.bench.plan_file import plan_text
from splatseed.bench.runs import read_runs

NODE = {"num_cpus": 1, "object_store_memory": 80 * 2**20}  # bytes; the least that Ray takes


@pytest.fixture
def nodes(tmp_path, monkeypatch):
    """The cluster, and two nodes beside a head that runs nothing, by their temporary folders."""
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_worker_niceness", "0")  # or workers wait for every other process
    short = tempfile.mkdtemp(dir=tempfile.gettempdir())  # names of sockets must not be long
    monkeypatch.setenv("RAY_TMPDIR", short)
    head = NODE | {"num_cpus": 0, "include_dashboard": False}
    cluster, nodes = Cluster(initialize_head=True, head_node_args=head), {}
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        monkeypatch.setenv("TMPDIR", str(folder))
        nodes[folder] = cluster.add_node(**NODE)
    yield cluster, nodes
    cluster.shutdown()
    shutil.rmtree(short, ignore_errors=True)


@pytest.mark.slow
def test_a_run_whose_node_is_lost_is_done_on_another(nodes, small_plan, tmp_path, splatseed):
    cluster, folders = nodes
    training = dataclasses.replace(small_plan.training, max_steps=200)
    plan = dataclasses.replace(small_plan, methods=("sfm",), repeats=1, training=training)
    (tmp_path / "plan.toml").write_text(plan_text(plan))
    lost = []

    def lose_the_node():
        until = time.monotonic() + 120
        while time.monotonic() < until and not lost:
            time.sleep(0.05)
            lost.extend(f for f in folders if list(f.glob("splatseed-*/runs/.*/*/config.json")))
        cluster.remove_node(folders[lost[0]], allow_graceful=False)

    loser = threading.Thread(target=lose_the_node)
    loser.start()
    words = ("--executor", "ray", "--address", cluster.address, "--jobs", 1)
    said = splatseed("bench", "--plan", tmp_path / "plan.toml", "-o", tmp_path / "B", *words)
    loser.join()
    assert lost
    assert (said.code, "Ray, 1 at a time" in said.err) == (0, True), said
    assert len([line for line in said.err.splitlines() if line.startswith("[")]) == 1
    (run,) = read_runs(tmp_path / "B")
    assert run.result is not None
