"""A benchmark on a Ray cluster of several local nodes, one of which is lost on the way."""

from __future__ import annotations

import dataclasses
import shutil
import subprocess
import sys
import tempfile
import time

import pytest

pytest.importorskip("torch", reason="training needs PyTorch")
pytest.importorskip("gsplat", reason="training needs gsplat's strategies")
pytest.importorskip("ray", reason="Ray is an extra: pip install -e '.[cluster]'")

from ray.cluster_utils import Cluster

from splatseed.bench.plan_file import plan_text
from splatseed.bench.runs import read_runs, run_folder

COMMAND = (sys.executable, "-c", "from splatseed.cli import main; main()", "bench")
STORE = 80 * 2**20  # bytes; the least that Ray takes


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """A head that runs nothing, and two nodes of one core, whose temporary files are the test's."""
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("TMPDIR", str(tmp_path / "nodes"))
    (tmp_path / "nodes").mkdir()
    short = tempfile.mkdtemp(dir=tempfile.gettempdir())  # names of sockets must not be long
    monkeypatch.setenv("RAY_TMPDIR", short)
    head = {"num_cpus": 0, "include_dashboard": False, "object_store_memory": STORE}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    for _ in range(2):
        cluster.add_node(num_cpus=1, object_store_memory=STORE)
    yield cluster
    cluster.shutdown()
    shutil.rmtree(short, ignore_errors=True)


@pytest.mark.slow
def test_all_runs_end_up_done_once_although_a_node_is_lost(cluster, small_plan, tmp_path):
    training = dataclasses.replace(small_plan.training, max_steps=250)
    plan = dataclasses.replace(
        small_plan, methods=("sfm", "linear", "mls"), repeats=1, training=training
    )
    (tmp_path / "plan.toml").write_text(plan_text(plan))
    folder = tmp_path / "B"
    words = ["--plan", tmp_path / "plan.toml", "-o", folder, "--executor", "ray"]
    words += ["--address", cluster.address]
    process = subprocess.Popen(
        [*COMMAND, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    until = time.monotonic() + 120
    while len(list((tmp_path / "nodes").glob("splatseed-*/runs/.*/*/config.json"))) < 2:
        assert time.monotonic() < until, "no run on each of the nodes"
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)
    cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
    out, err = process.communicate(timeout=240)
    assert process.returncode == 0, err
    assert "Ray, 2 at a time" in out
    assert len([line for line in out.splitlines() if line.startswith("[")]) == 3
    runs = read_runs(folder)
    assert len(runs) == 3
    for run in runs:
        assert run.result is not None
        assert len(list((run_folder(folder, run.spec) / "renders").iterdir())) == 3
