"""Ray: tasks on the nodes of a cluster, for benchmarks and for clouds in tiles.

Notation: the *driver* is the process that the user started. A task *lands* when it returns, fails,
or is given up. Promise: a task whose node or worker is lost is started again on another, up to
``LOSSES`` times; Ray is imported only when a cluster is used.
"""

from __future__ import annotations

import logging
import os
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from splatseed.errors import ParameterError
from splatseed.requirements import require

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

Key = TypeVar("Key")


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
        """The tasks that have ended, after at most ``POLL_SECONDS``."""
        import ray  # noqa: PLC0415  (an extra, and slow to import)

        ready, _ = ray.wait(list(self._flying), timeout=POLL_SECONDS)
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
            ray.wait(list(self._flying), num_returns=len(self._flying), timeout=GRACE_SECONDS)
        keys = list(self._flying.values())
        self._flying.clear()
        return keys


def _landing(reference: Any) -> Landing:
    import ray  # noqa: PLC0415  (an extra, and slow to import)

    try:
        return Landing(ray.get(reference))
    except ray.exceptions.RayTaskError as error:
        told = str(error.cause)
        if isinstance(error.cause, ray.exceptions.RaySystemError) or UNIMPORTED in told:
            return Landing(error=_not_installed(told))
        return Landing(error=error.cause)
    except ray.exceptions.RayError as error:
        return Landing(lost=" ".join(str(error).split()))


def _not_installed(told: str) -> ParameterError:
    """What a worker's traceback means, if the worker could not import what it is to call."""
    reason = next(filter(None, map(str.strip, reversed(told.splitlines()))), "no reason")
    return ParameterError(
        "splatseed on every node of the cluster, in the Python that ray start ran in",
        found=reason,
        fix="Install the same version of splatseed there, and run the same command again.",
    )
