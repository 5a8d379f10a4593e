"""Run tasks on the nodes of a Ray cluster; Ray is an extra, imported only when it is used."""

from __future__ import annotations

import logging
import os
import socket
import sys
from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager, suppress
from typing import Any

from splatseed.errors import ParameterError, TaskLostError
from splatseed.progress import Progress, thread_limit
from splatseed.requirements import require
from splatseed.runtime.child import Function

GRACE_SECONDS = 10.0
"""Time for cancelled tasks to end."""
ANSWER_SECONDS = 5.0
"""Timeout of the first connection to a cluster's address."""
ATTEMPTS = 2
"""Ray's attempts, 40 s each, to connect to an address that answers; Ray's default is 20."""
UNIMPORTED = "remote function failed to import"
"""Ray's message for a task whose function a worker could not import."""
MAX_THREADS = 8
"""Maximum default threads of a task; with more, they wait for each other."""


@contextmanager
def ray_cluster(address: str | None) -> Iterator[None]:
    """Connect to a cluster while the block runs: "auto" on one of its nodes, None starts one here.

    Raises:
        MissingDependencyError: Ray is absent.
        ParameterError: There is no such cluster, or it runs another version of Ray or Python.
    """
    require("ray")
    # Otherwise Ray reports usage on each start; clusters that others started keep their settings.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    options: dict[str, Any] = {"address": address or "local"}
    if address:
        _check_answers(address)
        os.environ.setdefault("RAY_NUM_REDIS_GET_RETRIES", str(ATTEMPTS))  # Ray's name is older
    else:
        options["include_dashboard"] = False
    import ray  # noqa: PLC0415  (an extra)

    try:
        # Workers import from the directory that Ray is started in, before all else.
        with chdir(sys.prefix):
            ray.init(log_to_driver=False, logging_level=logging.ERROR, **options)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise _no_cluster(address, " ".join(str(error).split())) from None
    try:
        yield
    finally:
        ray.shutdown()


def _check_answers(address: str) -> None:
    """Refuse an address at which nothing listens: Ray would try for a quarter of an hour."""
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
        fix="Start it with: ray start --head; then pass `address='auto'` on its node. If it asks "
        "for a token, set RAY_AUTH_MODE=token and RAY_AUTH_TOKEN for both.",
    )


class RayWorkers:
    """Tasks on the cluster that this process is connected to; they report no progress.

    Args:
        threads: CPUs per task; by default as many as leave one task per GPU to every node.
        gpu: Whether a task needs a GPU; None for yes if any node has one.
        limit: Maximum tasks at a time; by default as many as fit.

    Raises:
        ParameterError: No node has these resources.
    """

    retries = 3

    def __init__(
        self, threads: int | None = None, *, gpu: bool | None = False, limit: int | None = None
    ) -> None:
        nodes = _nodes()
        self.gpu = any(gpus >= 1 for _, gpus in nodes) if gpu is None else gpu
        fitting = [cpus // max(gpus, 1) for cpus, gpus in nodes if cpus >= 1 and gpus >= self.gpu]
        self.threads = threads or max(1, min(int(min(fitting, default=1)), MAX_THREADS))
        self._limit = limit
        self._running = set[Any]()
        self._stopped = False
        if not self._capacity():
            raise ParameterError(
                f"a node of the cluster with {self.threads} CPUs{' and a GPU' * self.gpu}",
                found=f"{len(fitting)} nodes, none of that size",
                fix="Add nodes to the cluster.",
            )

    @property
    def jobs(self) -> int:
        """See ``Workers``; nodes may join or leave the cluster."""
        capacity = max(self._capacity(), 1)
        return min(self._limit or capacity, capacity)

    def _capacity(self) -> int:
        """The number of tasks for which the nodes have CPUs and GPUs."""
        fitting = [(cpus // self.threads, gpus if self.gpu else cpus) for cpus, gpus in _nodes()]
        return sum(int(min(node)) for node in fitting)

    def call(self, function: Function, arguments: Sequence[Any], _: Progress | None) -> Any:
        """See ``Workers``."""
        import ray  # noqa: PLC0415  (an extra)

        task = ray.remote(num_cpus=self.threads, num_gpus=int(self.gpu), max_retries=0)(_limited)
        reference = task.remote(self.threads, function, tuple(arguments))
        self._running.add(reference)
        try:
            if self._stopped:  # since the task was submitted
                ray.cancel(reference)
            return _value(reference)
        finally:
            self._running.discard(reference)

    def stop(self) -> None:
        """See ``Workers``."""
        self._cancel(force=False)

    def kill(self) -> None:
        """See ``Workers``; asks first, so that tasks can clean up."""
        import ray  # noqa: PLC0415  (an extra)

        for force in (False, True) if self._running else ():
            self._cancel(force=force)
            running = list(self._running)
            if running:
                ray.wait(running, num_returns=len(running), timeout=GRACE_SECONDS)

    def _cancel(self, *, force: bool) -> None:
        import ray  # noqa: PLC0415  (an extra)

        self._stopped = True
        for reference in list(self._running):
            with suppress(ray.exceptions.RayError):
                ray.cancel(reference, force=force)


def _nodes() -> list[tuple[float, float]]:
    import ray  # noqa: PLC0415  (an extra)

    resources = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    return [(each.get("CPU", 0.0), each.get("GPU", 0.0)) for each in resources]


def _limited(threads: int, function: Function, call: tuple[Any, ...]) -> Any:
    """Make a call with as many threads of Numba and ``in_threads``, in a worker's process."""
    import numba  # noqa: PLC0415  (slow to import)

    before = numba.get_num_threads()
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]  # absent from Numba's stubs
    limit = thread_limit.set(threads)
    try:
        return function(*call)
    finally:
        thread_limit.reset(limit)
        numba.set_num_threads(before)


def _value(reference: Any) -> Any:
    import ray  # noqa: PLC0415  (an extra)

    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        message = str(error.cause)
        if not isinstance(error.cause, ray.exceptions.RaySystemError) and UNIMPORTED not in message:
            raise error.cause from None
        raise ParameterError(
            "splatseed on every node of the cluster, in the Python that ray start ran in",
            found=next(filter(None, map(str.strip, reversed(message.splitlines()))), "no reason"),
            fix="Install the same version of splatseed there, and run the same command again.",
        ) from None
    except ray.exceptions.RayError as error:
        raise TaskLostError(
            "a node that lives until its task is done",
            found=" ".join(str(error).split()),
            fix="Check the cluster's memory and disks, and run the same command again.",
        ) from None
