"""Call a function many times in child processes; ``ray_tasks`` does so on a Ray cluster.

A *task* is one call of a function at the top level of a module, with picklable arguments. A failed
task does not affect the others. A task whose process died is tried again after all others. Ctrl-C
sends a SIGTERM to running tasks, so that training can save a checkpoint; a second one kills them.
"""

from __future__ import annotations

import os
import queue
import signal
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeAlias, cast

from splatseed.errors import TaskLostError
from splatseed.progress import Progress, silent
from splatseed.runtime.child import Child, Function
from splatseed.runtime.interruption import interruption

Report: TypeAlias = Callable[[int, str, float], None]
"""Takes a task's index, its stage, and the fraction of it that is done."""
_POLL_SECONDS = 0.2


class Workers(Protocol):
    """Where tasks run."""

    retries: int
    """How often a lost task is tried again."""

    @property
    def jobs(self) -> int:
        """How many tasks can run at a time, now."""

    def call(self, function: Function, arguments: Sequence[Any], progress: Progress | None) -> Any:
        """Run one task and return its value; one of several threads calls this.

        With a ``progress``, the function is passed one.

        Raises:
            TaskLostError: Its process or node died.
        """

    def stop(self) -> None:
        """Ask the running tasks to end; later ones are lost at once."""

    def kill(self) -> None:
        """End the running tasks."""


@dataclass(frozen=True)
class Result:
    """The value or the error of the task with this index."""

    index: int
    value: Any = None
    error: Exception | None = None
    """A ``TaskLostError`` if its process or node died."""


def run_tasks(
    workers: Workers,
    function: Function,
    calls: Sequence[tuple[Any, ...]],
    report: Report | None = None,
) -> Iterator[Result]:
    """Call a function once per tuple of arguments; yields results in the order in which tasks end.

    Args:
        workers: Where to run the tasks.
        function: The function.
        calls: Its arguments, a tuple per task.
        report: Called when a task starts, and with the progress that the function reports.

    Raises:
        KeyboardInterrupt: The user stopped the tasks; those that ended before were yielded.
    """

    def work(index: int) -> Any:
        if report is None:
            return workers.call(function, calls[index], None)
        report(index, "start", 0.0)
        return workers.call(function, calls[index], partial(report, index))

    waiting, running = deque(range(len(calls))), dict[Future[Any], int]()
    losses = [0] * len(calls)
    stopped = False
    pool = ThreadPoolExecutor(max(len(calls), 1))  # threads start as tasks need them
    with interruption() as stop:
        try:
            while waiting or running:
                if stop.requested and not stopped:
                    stopped = True
                    waiting.clear()
                    workers.stop()
                while waiting and len(running) < workers.jobs:
                    index = waiting.popleft()
                    running[pool.submit(work, index)] = index
                for future in wait(running, _POLL_SECONDS, FIRST_COMPLETED).done:
                    index, error = running.pop(future), future.exception()
                    lost = isinstance(error, TaskLostError)
                    losses[index] += lost
                    if lost and not stopped and losses[index] <= workers.retries:
                        waiting.append(index)
                    elif not (lost and stopped):
                        value = None if error else future.result()
                        yield Result(index, value, cast("Exception | None", error))
        finally:
            workers.kill()
            pool.shutdown()
    if stop.requested:
        raise KeyboardInterrupt


class ProcessWorkers:
    """A fresh process for each task.

    Args:
        environments: For each task at a time, the variables of its process, as of ``worker_env``.
    """

    retries = 1

    def __init__(self, environments: Sequence[Mapping[str, str]]) -> None:
        self.jobs = len(environments)
        self._free: queue.SimpleQueue[Mapping[str, str]] = queue.SimpleQueue()
        for environment in environments:
            self._free.put(environment)
        self._children = set[Child]()
        self._stopped = False

    def call(self, function: Function, arguments: Sequence[Any], progress: Progress | None) -> Any:
        """See ``Workers``."""
        environment = self._free.get()
        try:
            log = tempfile.TemporaryFile()  # noqa: SIM115  (the child closes it)
            reports = progress is not None
            child = Child(function, *arguments, reports=reports, environment=environment, log=log)
            with closing(child):
                self._children.add(child)
                if self._stopped:  # since the task was submitted
                    child.process.kill()
                try:
                    return child.result(progress or silent)
                finally:
                    self._children.discard(child)
        finally:
            self._free.put(environment)

    def stop(self) -> None:
        """See ``Workers``."""
        self._signal(signal.SIGTERM)

    def kill(self) -> None:
        """See ``Workers``."""
        self._signal(signal.SIGKILL if os.name == "posix" else signal.SIGTERM)

    def _signal(self, number: int) -> None:
        self._stopped = True
        for child in list(self._children):
            child.process.send_signal(number)
