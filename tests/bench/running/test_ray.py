"""The Ray executor on a cluster of several local nodes, one of which is lost on the way."""

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

from splatseed.bench.planning.plan import plan_runs
from splatseed.bench.planning.plan_file import plan_text
from splatseed.bench.planning.scenes import survey
from splatseed.bench.running.child import Child, Killed
from splatseed.bench.running.environment import package_version
from splatseed.bench.running.kept import kept_folder
from splatseed.bench.running.ledger import Ledger
from splatseed.bench.running.ray_cluster import run_on_node
from splatseed.errors import MissingDependencyError, ParameterError
from splatseed.process import ray_tasks as module
from splatseed.process.ray_tasks import Share

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


@pytest.fixture
def specs(small_plan, room_path):
    return plan_runs(small_plan, [survey(room_path, "room")], "cpu", package_version("splatseed"))


def _begun(nodes):
    """The folders of runs that have begun to train on any node."""
    found = [path.parent for path in nodes.glob("splatseed-*/*/*/config.json")]
    return [path for path in found if path.parent.name == "work"]


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
    while len(_begun(tmp_path / "nodes")) < 2:
        assert time.monotonic() < until, "no run on each of the nodes"
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)
    cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
    out, err = process.communicate(timeout=240)
    assert process.returncode == 0, err
    lost = list((tmp_path / "nodes").glob("splatseed-*"))
    assert len(lost) == 1  # what a run leaves that does not come to its end
    assert "Ray, 2 at a time" in out
    rows = Ledger.open(folder / "ledger.sqlite", read_only=True).rows()
    assert [(row.status, row.attempts) for row in rows] == [("done", 1)] * 3
    assert len([line for line in out.splitlines() if line.startswith("[")]) == 3
    for row in rows:
        kept = kept_folder(folder, row.spec.key)
        assert (kept / "result.json").is_file()
        assert len(list((kept / "renders").iterdir())) == 3


def test_a_node_says_what_it_lacks(specs, room_path):
    far = dataclasses.replace(specs[0], scene_path="elsewhere/room")
    outcome = run_on_node(far.to_json(), {}, 1).outcome
    assert outcome.status == "failed"
    assert "the same path" in outcome.error
    older = dataclasses.replace(specs[0], version="0.0.1", scene_path=str(room_path))
    assert "splatseed 0.0.1 on the node" in run_on_node(older.to_json(), {}, 1).outcome.error


def test_a_run_on_a_node_leaves_nothing_there(specs, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    outcome = run_on_node(specs[0].to_json(), {}, 1).outcome
    assert (outcome.status, outcome.error) == ("done", "")
    assert list(tmp_path.iterdir()) == []


def test_a_process_that_dies_on_a_node_is_told_of(specs, monkeypatch):
    def die(*_):
        raise Killed("killed by SIGKILL")

    monkeypatch.setattr(Child, "wait", die)
    returned = run_on_node(specs[0].to_json(), {}, 1)
    assert returned.killed.startswith("killed by SIGKILL on ")


def test_each_run_gets_a_share_that_any_node_has(monkeypatch):
    nodes = []
    monkeypatch.setattr(module.Cluster, "_nodes", lambda _: nodes)
    here = module.Cluster()
    nodes[:] = [(0, 0), (4, 0), (64, 0)]
    assert here.share(None, gpu=False) == Share(4)
    assert here.capacity(Share(4)) == 17
    assert not here.has_gpus
    nodes[:] = [(2, 0), (32, 8), (64, 4)]
    assert here.share(None, gpu=True) == Share(4, 1)
    assert here.capacity(Share(4, 1)) == 12
    assert here.share(16, gpu=True) == Share(16, 1)
    with pytest.raises(ParameterError, match="fewer --threads"):
        here.share(128, gpu=False)
    nodes[:] = [(8, 0)]
    with pytest.raises(ParameterError, match="and a GPU"):
        here.share(None, gpu=True)


def test_no_cluster_and_no_ray_are_one_line(monkeypatch):
    import ray

    def none(**_):
        raise ConnectionError("nobody\nthere")

    monkeypatch.setattr(ray, "init", none)
    with (
        pytest.raises(ParameterError, match=r"at auto, .* found nobody there\. Start it with"),
        module.ray_cluster("auto"),
    ):
        pass

    def absent(*names):
        raise MissingDependencyError("the package", found=f"no {names[0]}", fix="Install it.")

    monkeypatch.setattr(module, "require", absent)
    with pytest.raises(MissingDependencyError, match="no ray"), module.ray_cluster(None):
        pass
