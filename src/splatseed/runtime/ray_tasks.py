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
from typing import Any

from splatseed.errors import ParameterError, TaskLostError
from splatseed.progress import thread_limit
from splatseed.requirements import require
from splatseed.runtime.interruption import interruption
from splatseed.runtime.tasks import Function, Report, Result, Tasks

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
    import ray  # noqa: PLC0415  (an extra, and slow to import)

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


class RayTasks(Tasks):
    """Tasks on the cluster that this process is connected to.

    Args:
        threads: CPUs of each; left out, as many as let every node work on one for each of its GPUs.
        gpu: Whether each needs a GPU; None for yes if any node has one.
        jobs: Most tasks at a time; as many as fit, when left out.

    Raises:
        ParameterError: No node has enough.
    """

    def __init__(
        self, threads: int | None = None, *, gpu: bool | None = False, jobs: int | None = None
    ) -> None:
        nodes = _nodes()
        self.gpu = any(gpus >= 1 for _, gpus in nodes) if gpu is None else gpu
        fitting = [cpus // max(gpus, 1) for cpus, gpus in nodes if cpus >= 1 and gpus >= self.gpu]
        self.threads = threads or max(1, min(int(min(fitting, default=1)), MOST_THREADS))
        self._jobs = jobs
        if not self._fitting():
            raise ParameterError(
                f"a node of the cluster with {self.threads} CPUs{' and a GPU' * self.gpu}",
                found=f"{len(fitting)} nodes, none with so much",
                fix="Pass fewer `threads`, or add nodes.",
            )
        self.words = f"Ray, {self.jobs} tasks at a time"

    @property
    def jobs(self) -> int:
        """Tasks at a time, on the nodes that are there now."""
        fitting = max(self._fitting(), 1)
        return min(self._jobs or fitting, fitting)

    def _fitting(self) -> int:
        most = [(cpus // self.threads, gpus if self.gpu else cpus) for cpus, gpus in _nodes()]
        return sum(int(min(each)) for each in most)

    def run(
        self, function: Function, calls: Sequence[tuple[Any, ...]], report: Report | None = None
    ) -> Iterator[Result]:
        """See ``Tasks``; the function is given no ``progress``."""
        import ray  # noqa: PLC0415  (an extra, and slow to import)

        task = ray.remote(num_cpus=self.threads, num_gpus=int(self.gpu), max_retries=LOSSES)(
            _limited
        )
        waiting, running = deque(range(len(calls))), dict[Any, int]()
        with interruption() as stop:
            try:
                while (waiting or running) and not stop.requested:
                    while waiting and len(running) < self.jobs:  # nodes may have come or gone
                        index = waiting.popleft()
                        running[task.remote(self.threads, function, calls[index])] = index
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


def _nodes() -> list[tuple[float, float]]:
    """CPUs and GPUs of each node."""
    import ray  # noqa: PLC0415  (an extra, and slow to import)

    resources = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    return [(each.get("CPU", 0.0), each.get("GPU", 0.0)) for each in resources]


def _limited(threads: int, function: Function, call: tuple[Any, ...]) -> Any:
    """A task, whose kernels and ``in_threads`` use its share of a node, in a worker's process."""
    import numba  # noqa: PLC0415  (slow to import)

    before = numba.get_num_threads()
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]  # absent from Numba's stubs
    limit = thread_limit.set(threads)
    try:
        return function(*call)
    finally:
        thread_limit.reset(limit)
        numba.set_num_threads(before)


def _result(index: int, reference: Any) -> Result:
    import ray  # noqa: PLC0415  (an extra, and slow to import)

    try:
        return Result(index, ray.get(reference))
    except ray.exceptions.RayTaskError as error:
        told = str(error.cause)
        if not isinstance(error.cause, ray.exceptions.RaySystemError) and UNIMPORTED not in told:
            return Result(index, error=error.cause)
        missing = ParameterError(
            "splatseed on every node of the cluster, in the Python that ray start ran in",
            found=next(filter(None, map(str.strip, reversed(told.splitlines()))), "no reason"),
            fix="Install the same version of splatseed there, and run the same command again.",
        )
        return Result(index, error=missing)
    except ray.exceptions.RayError as error:
        lost = TaskLostError(
            "a node that lives until its work is done",
            found=f"{1 + LOSSES} losses, the last: {' '.join(str(error).split())}",
            fix="Check the cluster's memory and disks, and run the same command to go on.",
        )
        return Result(index, error=lost)
