"""Tasks on the nodes of a Ray cluster, for benchmarks and for clouds in tiles.

Promise: a task whose node or worker is lost is started again on another, up to ``LOSSES`` times;
Ray is imported only when a cluster is used.
"""

from __future__ import annotations

import logging
import os
import socket
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from splatseed.errors import ParameterError, TaskLostError
from splatseed.requirements import require
from splatseed.runtime.interruption import interruption
from splatseed.runtime.tasks import Function, Report, Result, Tasks
from splatseed.runtime.threads import few_threads

LOSSES = 3
"""How often a task is restarted whose node or worker was lost."""
POLL_SECONDS = 0.5
GRACE_SECONDS = 10.0
"""Seconds for cancelled tasks to end."""
ANSWER_SECONDS = 5.0
"""Seconds in which the machine at a cluster's address must answer."""
ATTEMPTS = 2
"""Ray's attempts, 40 s each, to find a cluster where something answers; its own default is 20."""
UNIMPORTED = "remote function failed to import"
"""What Ray says of a task whose function a worker could not import."""
MOST_THREADS = 8
"""Default threads of a task: with more, they wait for each other."""


@dataclass(frozen=True)
class Share:
    """The resources of each task on a node.

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
        """The resources of each task, such that every node with CPUs (and GPUs) can execute one.

        Args:
            threads: CPUs, if the user says so.
            gpu: Whether tasks need a GPU.

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
        """How many tasks fit at a time."""
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
    if address:
        _check_answers(address)
        os.environ.setdefault("RAY_NUM_REDIS_GET_RETRIES", str(ATTEMPTS))  # Ray's name is older
    import ray  # noqa: PLC0415  (an extra, and slow to import)

    options: dict[str, Any] = {} if address else {"include_dashboard": False}
    try:
        # Workers import from the directory that Ray is started in, before all else.
        with chdir(sys.prefix):
            ray.init(
                address=address or "local",
                log_to_driver=False,
                logging_level=logging.ERROR,
                **options,
            )
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise _no_cluster(address, " ".join(str(error).split())) from None
    try:
        yield Cluster()
    finally:
        ray.shutdown()


def _check_answers(address: str) -> None:
    """Refuse an address at which nothing listens: Ray would go on trying for a quarter of an hour.

    Raises:
        ParameterError: Nothing does.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdigit()):  # auto, or what Ray itself refuses at once
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), ANSWER_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise _no_cluster(address, f"no answer there ({error})") from None


def _no_cluster(address: str | None, found: str) -> ParameterError:
    return ParameterError(
        f"a Ray cluster at {address or 'this machine'}, of the same versions of Ray and Python",
        found=found,
        fix="Start it with: ray start --head; then pass --address auto on its node. If it asks for "
        "a token, set RAY_AUTH_MODE=token and RAY_AUTH_TOKEN for both.",
    )


class RayTasks(Tasks):
    """Tasks on the cluster that this process is connected to.

    Args:
        share: The resources of each.
        jobs: Most tasks at a time; as many as fit, when left out.
    """

    def __init__(self, share: Share, jobs: int | None = None) -> None:
        self._share, self._jobs = share, jobs
        self.words = f"Ray, {self._most()} tasks at a time"

    def run(
        self, function: Function, calls: Sequence[tuple[Any, ...]], report: Report | None = None
    ) -> Iterator[Result]:
        """See ``Tasks``; the function is given no ``progress``."""
        import ray  # noqa: PLC0415  (an extra, and slow to import)

        share = self._share
        options = {"num_cpus": share.threads, "num_gpus": share.gpus, "max_retries": LOSSES}
        task = ray.remote(**options)(_limited)
        waiting, running = deque(range(len(calls))), dict[Any, int]()
        with interruption() as stop:
            try:
                while (waiting or running) and not stop.requested:
                    while waiting and len(running) < self._most():  # nodes may have come or gone
                        index = waiting.popleft()
                        running[task.remote(share.threads, function, calls[index])] = index
                        if report is not None:
                            report(index, "start", 0.0)
                    for each in ray.wait(list(running), timeout=POLL_SECONDS)[0]:
                        yield _result(running.pop(each), each)
            finally:
                for force in (False, True) if running else ():  # asked first, a task cleans up
                    for each in running:
                        with suppress(ray.exceptions.RayError):
                            ray.cancel(each, force=force)
                    ray.wait(list(running), num_returns=len(running), timeout=GRACE_SECONDS)
        if stop.requested:
            raise KeyboardInterrupt

    def _most(self) -> int:
        return self._jobs or max(Cluster().capacity(self._share), 1)


def _limited(threads: int, function: Function, call: tuple[Any, ...]) -> Any:
    """A task with its share of a node."""
    with few_threads(threads):
        return function(*call)


def _result(index: int, reference: Any) -> Result:
    import ray  # noqa: PLC0415  (an extra, and slow to import)

    try:
        return Result(index, ray.get(reference))
    except ray.exceptions.RayTaskError as error:
        told = str(error.cause)
        if isinstance(error.cause, ray.exceptions.RaySystemError) or UNIMPORTED in told:
            return Result(index, error=not_installed(told))
        return Result(index, error=error.cause)
    except ray.exceptions.RayError as error:
        lost = TaskLostError(
            "a node that lives until its work is done",
            found=f"{1 + LOSSES} losses, the last: {' '.join(str(error).split())}",
            fix="Check the cluster's memory and disks, and run the same command to go on.",
        )
        return Result(index, error=lost)


def not_installed(told: str) -> ParameterError:
    """What a worker's traceback means, if the worker could not import what it is to call."""
    reason = next(filter(None, map(str.strip, reversed(told.splitlines()))), "no reason")
    return ParameterError(
        "splatseed on every node of the cluster, in the Python that ray start ran in",
        found=reason,
        fix="Install the same version of splatseed there, and run the same command again.",
    )
