"""The Ray executor: runs as tasks on the nodes of a cluster.

Notation: the *driver* is the process that the user started; it alone writes the ledger and the
folder of the benchmark. Promise: a run works in a temporary folder of its node and comes back as
bytes, so that nodes need not share a disk with the driver; its scene must be at the same path on
every node, with the same content, which is checked. A run whose node is lost is restarted on
another.
"""

from __future__ import annotations

import socket
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from splatseed.bench.planning.records import RunSpec
from splatseed.bench.running.child import Child, Killed
from splatseed.bench.running.environment import package_version
from splatseed.bench.running.executor import Executor
from splatseed.bench.running.job import JobOptions, Outcome
from splatseed.bench.running.kept import kept_folder, read_result, work_folder, write_kept
from splatseed.bench.running.ledger import Ledger
from splatseed.bench.running.watcher import Watcher
from splatseed.errors import OutputError, ParameterError, SceneNotFoundError, SplatseedError
from splatseed.io.staging import MANIFEST
from splatseed.process.interruption import interruption
from splatseed.process.ray_tasks import LOSSES, Cluster, Share, not_installed
from splatseed.process.threads import slot_environment
from splatseed.progress import silent

Key = TypeVar("Key")


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


@dataclass(frozen=True)
class Landing:
    """How a task ended.

    Args:
        value: What it returned.
        error: What it raised.
        lost: How it was lost with its node or worker, once too often; empty if it was not.
    """

    value: Any = None
    error: BaseException | None = None
    lost: str = ""


class Flights(Generic[Key]):
    """The tasks of one function that are under way on the cluster, by key.

    Args:
        function: What they call; nodes import it.
        share: The resources of each.
    """

    def __init__(self, function: Callable[..., Any], share: Share) -> None:
        import ray  # noqa: PLC0415  (an extra, and slow to import)

        options = {"num_cpus": share.threads, "num_gpus": share.gpus, "max_retries": LOSSES}
        self._task = ray.remote(**options)(function)
        self._flying: dict[Any, Key] = {}

    def __len__(self) -> int:
        return len(self._flying)

    def launch(self, key: Key, *arguments: object) -> None:
        """Start a task."""
        self._flying[self._task.remote(*arguments)] = key

    def landed(self) -> list[tuple[Key, Landing]]:
        """The tasks that have ended, after at most ``0.5``."""
        import ray  # noqa: PLC0415  (an extra, and slow to import)

        ready, _ = ray.wait(list(self._flying), timeout=0.5)
        return [(self._flying.pop(reference), _landing(reference)) for reference in ready]

    def cancel(self) -> list[Key]:
        """Stop all tasks; returns their keys."""
        import ray  # noqa: PLC0415  (an extra, and slow to import)

        if not self._flying:
            return []
        for force in (False, True):  # asked first, a task removes its temporary folder
            for reference in self._flying:
                with suppress(ray.exceptions.RayError):
                    ray.cancel(reference, force=force)
            ray.wait(list(self._flying), num_returns=len(self._flying), timeout=10.0)
        keys = list(self._flying.values())
        self._flying.clear()
        return keys


def _landing(reference: Any) -> Landing:
    import ray  # noqa: PLC0415  (an extra, and slow to import)

    try:
        return Landing(ray.get(reference))
    except ray.exceptions.RayTaskError as error:
        told = str(error.cause)
        if (
            isinstance(error.cause, ray.exceptions.RaySystemError)
            or "remote function failed to import" in told
        ):
            return Landing(error=not_installed(told))
        return Landing(error=error.cause)
    except ray.exceptions.RayError as error:
        return Landing(lost=" ".join(str(error).split()))


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
        flights: Flights[RunSpec] = Flights(run_on_node, self._share)
        with interruption() as stop, self.alive():
            try:
                while not stop.requested:
                    self._fill(flights, keys)
                    if not len(flights):
                        return True
                    for spec, landing in flights.landed():
                        self.settle(spec, self._outcome(spec, landing))
                self.stopping.set()
            finally:
                self._cancel(flights)
        return False

    def _fill(self, flights: Flights[RunSpec], keys: Collection[str]) -> None:
        """Start as many runs as fit now; nodes may have come or gone."""
        most = self._jobs or max(self._cluster.capacity(self._share), 1)
        while len(flights) < most and (spec := self.claim(keys)) is not None:
            kept = read_result(kept_folder(self._bench, spec.key), spec.key)
            if kept is not None:
                self.settle(spec, Outcome("done", kept))
                continue
            flights.launch(spec, spec.to_json(), asdict(self._options), self._share.threads)

    def _outcome(self, spec: RunSpec, landing: Landing) -> Outcome:
        """The outcome of a task; its files are written here."""
        if landing.error is not None:
            return Outcome("failed", error=" ".join(str(landing.error).split()))
        if landing.lost:
            lost = f"lost with its node or worker {LOSSES + 1} times: {landing.lost}"
            return Outcome("failed", error=lost)
        returned: _Returned = landing.value
        if returned.killed:
            return self.after_death(spec, returned.killed)
        try:
            if returned.files:
                write_kept(kept_folder(self._bench, spec.key), returned.files)
        except OutputError as error:
            return Outcome("failed", error=str(error))
        return returned.outcome

    def _cancel(self, flights: Flights[RunSpec]) -> None:
        """Cancel the running tasks, and hand their runs back."""
        if len(flights):
            self.watcher.stopping("runs on the cluster restart next time")
        for spec in flights.cancel():
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
        bench = Path(temporary)  # laid out as one: runs keep there what others can use
        work, target = work_folder(bench, spec.key), kept_folder(bench, spec.key)
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
