"""The Ray executor: runs as tasks on the nodes of a cluster.

Notation: the *driver* is the process that the user started; it alone writes the ledger and the
folder of the benchmark. Promise: a run works in a temporary folder of its node and comes back as
bytes, so that nodes need not share a disk with the driver; its scene must be at the same path on
every node, with the same content, which is checked. A run whose node is lost is restarted on
another.
"""

from __future__ import annotations

import logging
import os
import socket
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from splatseed.bench.planning.records import RunSpec
from splatseed.bench.running.child import Child, Killed
from splatseed.bench.running.environment import package_version
from splatseed.bench.running.executor import Executor
from splatseed.bench.running.job import JobOptions, Outcome
from splatseed.bench.running.kept import kept_folder, read_result, write_kept
from splatseed.bench.running.ledger import Ledger
from splatseed.bench.running.local import slot_environment
from splatseed.bench.running.watcher import Watcher
from splatseed.errors import OutputError, ParameterError, SceneNotFoundError, SplatseedError
from splatseed.io.output.staging import MANIFEST
from splatseed.process.interruption import interruption
from splatseed.progress import silent
from splatseed.requirements import require

__all__ = ["Cluster", "RayExecutor", "Share", "ray_cluster", "run_on_node"]

LOSSES = 3
"""How often a run is restarted whose node or worker was lost."""
POLL_SECONDS = 0.5
GRACE_SECONDS = 10.0
"""Seconds for cancelled tasks to end."""
MOST_THREADS = 8
"""Default threads of a run: with more, they wait for each other."""


@dataclass(frozen=True)
class Share:
    """The resources of each run on a node.

    Args:
        threads: CPUs.
        gpus: GPUs, 0 or 1.
    """

    threads: int
    gpus: int = 0


class Cluster:
    """The current resources of the cluster that this process is connected to."""

    @property
    def has_gpus(self) -> bool:
        """Whether any node has a GPU."""
        return any(gpus >= 1 for _, gpus in self._nodes())

    def share(self, threads: int | None, *, gpu: bool) -> Share:
        """The resources of each run, such that every node with CPUs (and GPUs) can execute one.

        Args:
            threads: CPUs, if the user says so.
            gpu: Whether runs need a GPU.

        Raises:
            ParameterError: No node has enough.
        """
        nodes = [(cpus, gpus) for cpus, gpus in self._nodes() if cpus >= 1 and gpus >= gpu]
        fitting = min((int(cpus // max(gpus, 1)) for cpus, gpus in nodes), default=1)
        share = Share(threads or max(1, min(fitting, MOST_THREADS)), int(gpu))
        if not self.capacity(share):
            what = f"{share.threads} CPUs" + (" and a GPU" if gpu else "")
            raise ParameterError(
                f"a node of the cluster with {what}",
                found=f"{len(nodes)} nodes, none with so much",
                fix="Pass fewer --threads, or add nodes.",
            )
        return share

    def capacity(self, share: Share) -> int:
        """How many runs fit at a time."""
        return sum(
            min(int(cpus // share.threads), int(gpus) if share.gpus else int(cpus))
            for cpus, gpus in self._nodes()
        )

    def _nodes(self) -> list[tuple[float, float]]:
        """CPUs and GPUs of each node."""
        import ray  # noqa: PLC0415  (an extra, and slow to import)

        resources = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        return [(each.get("CPU", 0.0), each.get("GPU", 0.0)) for each in resources]


@contextmanager
def ray_cluster(address: str | None) -> Iterator[Cluster]:
    """Connect to a cluster while the block runs.

    Args:
        address: The cluster's address, or "auto" on one of its nodes; None to start one on this
            machine.

    Raises:
        MissingDependencyError: Ray is absent.
        ParameterError: There is no such cluster, or it runs another version of Ray or Python.
    """
    require("ray")
    # Otherwise Ray reports usage on each start; clusters that others started keep their settings.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import ray  # noqa: PLC0415  (an extra, and slow to import)

    options: dict[str, Any] = {} if address else {"include_dashboard": False}
    try:
        ray.init(
            address=address or "local",
            log_to_driver=False,
            logging_level=logging.ERROR,
            **options,
        )
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise ParameterError(
            f"a Ray cluster at {address or 'this machine'}, of the same versions of Ray and Python",
            found=" ".join(str(error).split()),
            fix="Start it with: ray start --head; then pass --address auto on its node.",
        ) from None
    try:
        yield Cluster()
    finally:
        ray.shutdown()


@dataclass(frozen=True)
class _Returned:
    """What a node returns.

    Args:
        outcome: How the run ended.
        killed: How its process died, if it did.
        files: What is kept, by its names.
    """

    outcome: Outcome
    killed: str = ""
    files: Mapping[str, bytes] = field(default_factory=dict)


class RayExecutor(Executor):
    """Executes the runs of a ledger on the cluster that this process is connected to.

    Args:
        ledger: The ledger.
        bench: The benchmark's folder.
        share: The resources of each run.
        jobs: Most runs at a time; as many as fit, when left out.
        options: Options of the runs.
        watcher: Told what happens, except the progress of a run.
    """

    def __init__(
        self,
        ledger: Ledger,
        bench: Path,
        share: Share,
        *,
        jobs: int | None = None,
        options: JobOptions | None = None,
        watcher: Watcher | None = None,
    ) -> None:
        super().__init__(ledger, watcher)
        self._bench = bench
        self._share = share
        self._jobs = jobs
        self._options = options or JobOptions()
        self._cluster = Cluster()

    def run(self, keys: Collection[str]) -> bool:
        """Execute the given runs that nobody else has, until none are left or the user stops.

        Stopped runs leave no checkpoint, because their folders belong to their nodes.

        Returns:
            Whether it was completed.

        Raises:
            OutputError: The ledger cannot be written.
        """
        import ray  # noqa: PLC0415  (an extra, and slow to import)

        task = ray.remote(
            num_cpus=self._share.threads, num_gpus=self._share.gpus, max_retries=LOSSES
        )(run_on_node)
        flying: dict[Any, RunSpec] = {}
        with interruption() as stop, self.alive():
            try:
                while not stop.requested:
                    self._fill(task, flying, keys)
                    if not flying:
                        return True
                    ready, _ = ray.wait(list(flying), timeout=POLL_SECONDS)
                    for reference in ready:
                        spec = flying.pop(reference)
                        self.settle(spec, self._outcome(spec, reference))
                self.stopping.set()
            finally:
                self._cancel(flying)
        return False

    def _fill(self, task: Any, flying: dict[Any, RunSpec], keys: Collection[str]) -> None:
        """Start as many runs as fit now; nodes may have come or gone."""
        most = self._jobs or max(self._cluster.capacity(self._share), 1)
        while len(flying) < most and (spec := self.claim(keys)) is not None:
            kept = read_result(kept_folder(self._bench, spec.key), spec.key)
            if kept is not None:
                self.settle(spec, Outcome("done", kept))
                continue
            order = (spec.to_json(), asdict(self._options), self._share.threads)
            flying[task.remote(*order)] = spec

    def _outcome(self, spec: RunSpec, reference: Any) -> Outcome:
        """The outcome of a task; its files are written here."""
        import ray  # noqa: PLC0415  (an extra, and slow to import)

        try:
            returned = ray.get(reference)
        except ray.exceptions.RayTaskError as error:
            return Outcome("failed", error=" ".join(str(error.cause).split()))
        except ray.exceptions.RayError as error:
            how = " ".join(str(error).split())
            return Outcome(
                "failed", error=f"lost with its node or worker {LOSSES + 1} times: {how}"
            )
        if returned.killed:
            return self.after_death(spec, returned.killed)
        try:
            if returned.files:
                write_kept(kept_folder(self._bench, spec.key), returned.files)
        except OutputError as error:
            return Outcome("failed", error=str(error))
        outcome: Outcome = returned.outcome
        return outcome

    def _cancel(self, flying: Mapping[Any, RunSpec]) -> None:
        """Cancel the running tasks, and hand their runs back."""
        import ray  # noqa: PLC0415  (an extra, and slow to import)

        if not flying:
            return
        self.watcher.stopping("runs on the cluster restart next time")
        for force in (False, True):  # asked first, a task removes its temporary folder
            for reference in flying:
                with suppress(ray.exceptions.RayError):
                    ray.cancel(reference, force=force)
            ray.wait(list(flying), num_returns=len(flying), timeout=GRACE_SECONDS)
        for spec in flying.values():
            self.settle(spec, Outcome("interrupted"))


def run_on_node(spec_json: str, options: Mapping[str, Any], threads: int) -> _Returned:
    """Execute a run on this node, in its own process, and return what is kept of it.

    Args:
        spec_json: The run, as JSON.
        options: Its options.
        threads: Its threads.
    """
    spec = RunSpec.from_json(spec_json)
    try:
        _check_node(spec)
    except SplatseedError as error:
        return _Returned(Outcome("failed", error=str(error)))
    with tempfile.TemporaryDirectory(prefix="splatseed-", ignore_cleanup_errors=True) as temporary:
        work, target = (Path(temporary) / name for name in ("work", "kept"))
        child = Child(spec, work, target, JobOptions(**options), slot_environment(threads))
        try:
            outcome = child.wait(silent)
        except Killed as error:
            return _Returned(Outcome("interrupted"), killed=f"{error} on {socket.gethostname()}")
        return _Returned(outcome, files=_files(target))


def _check_node(spec: RunSpec) -> None:
    """Check that the node meets a run's requirements."""
    host = socket.gethostname()
    here = package_version("splatseed")
    if here != spec.version:
        raise ParameterError(
            f"splatseed {spec.version} on the node {host}",
            found=here or "none",
            fix="Install the same version on every node.",
        )
    if not Path(spec.scene_path).exists():
        raise SceneNotFoundError(
            f"the scene {spec.scene_path} on the node {host}",
            found="no such folder",
            fix="Every node must have the scenes at the same path: share the disk, or copy them.",
        )


def _files(target: Path) -> dict[str, bytes]:
    """The files of a folder except its manifest, which is written anew."""
    paths: Sequence[Path] = [path for path in target.rglob("*") if path.is_file()]
    contents = {path.relative_to(target).as_posix(): path.read_bytes() for path in paths}
    return {name: content for name, content in contents.items() if name != MANIFEST}
