"""Tasks without return values, in this process, in several, or on a Ray cluster.

A task leaves its result on a disk that all processes see, and may run twice. Promise: tasks whose
process or node is lost are started again, up to ``LOSSES`` times; the first error that a task
raises ends all, and is raised here; an interrupt waits for tasks under way in processes of this
machine.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from splatseed.errors import TaskLostError
from splatseed.process.interpreter import safe_children
from splatseed.process.ray_tasks import LOSSES, Cluster, Flights, Share
from splatseed.process.threads import few_threads
from splatseed.progress import Progress

Call = tuple[Any, ...]
"""The arguments of a task."""


class Tasks(ABC):
    """Something that carries out tasks.

    Attributes:
        words: A description for the user.
        processes: Processes of this machine that hold memory at a time, this one included.
    """

    words: str
    processes: int = 1

    @abstractmethod
    def run(
        self, function: Callable[..., object], calls: Sequence[Call], stage: str, progress: Progress
    ) -> None:
        """Call a function once with each of some arguments; in any order.

        Args:
            function: At the top of a module, so that other processes find it.
            calls: Its arguments, task by task.
            stage: What it does, for the progress.
            progress: Called with the stage and the fraction done.

        Raises:
            TaskLostError: A task was lost with its process too often.
        """


class HereTasks(Tasks):
    """Tasks one after another in this process."""

    words = "this process"

    def run(
        self, function: Callable[..., object], calls: Sequence[Call], stage: str, progress: Progress
    ) -> None:
        """See ``Tasks``."""
        progress(stage, 0.0)
        for done, call in enumerate(calls, start=1):
            function(*call)
            progress(stage, done / len(calls))


class ProcessTasks(Tasks):
    """Tasks in processes of this machine.

    Args:
        jobs: How many at a time.
        threads: Threads of each.
    """

    def __init__(self, jobs: int, threads: int) -> None:
        self._jobs, self._threads = jobs, threads
        self.words = f"{jobs} processes"
        self.processes = 1 + jobs

    def run(
        self, function: Callable[..., object], calls: Sequence[Call], stage: str, progress: Progress
    ) -> None:
        """See ``Tasks``."""
        left, total = deque(calls), len(calls)
        progress(stage, 0.0)
        for _ in range(1 + LOSSES):
            if not left:
                return
            try:
                self._run(function, left, lambda: progress(stage, 1.0 - len(left) / total))
            except BrokenProcessPool:  # one was killed, perhaps for its memory: start anew
                continue
        if left:
            raise TaskLostError(
                f"processes that live until their tiles are done ({stage})",
                found=f"{1 + LOSSES} that were killed",
                fix="Out of memory? Pass fewer --jobs, or a smaller --memory.",
            )

    def _run(
        self, function: Callable[..., object], left: deque[Call], told: Callable[[], None]
    ) -> None:
        """Run what is left; what is done is removed from it."""
        context = multiprocessing.get_context("spawn")
        with safe_children(), ProcessPoolExecutor(self._jobs, context, _begin) as pool:
            flying: dict[Any, Call] = {}
            waiting = deque(left)
            try:
                while waiting or flying:
                    while waiting and len(flying) < self._jobs:
                        call = waiting.popleft()
                        flying[pool.submit(_limited, self._threads, function, call)] = call
                    for future in wait(flying, return_when=FIRST_COMPLETED).done:
                        call = flying.pop(future)
                        future.result()
                        left.remove(call)
                        told()
            finally:
                pool.shutdown(wait=True, cancel_futures=True)


class RayTasks(Tasks):
    """Tasks on the Ray cluster that this process is connected to.

    Args:
        threads: CPUs of each; as many as every node has, up to 8, when left out.
        jobs: Most tasks at a time; as many as fit, when left out.
    """

    def __init__(self, threads: int | None = None, jobs: int | None = None) -> None:
        self._cluster, self._jobs = Cluster(), jobs
        self._share: Share = self._cluster.share(threads, gpu=False)
        self.words = f"Ray, {self._most()} tasks at a time"

    def run(
        self, function: Callable[..., object], calls: Sequence[Call], stage: str, progress: Progress
    ) -> None:
        """See ``Tasks``."""
        flights: Flights[int] = Flights(_limited, self._share)
        waiting, done = deque(enumerate(calls)), 0
        progress(stage, 0.0)
        try:
            while waiting or len(flights):
                while waiting and len(flights) < self._most():  # nodes may have come or gone
                    number, call = waiting.popleft()
                    flights.launch(number, self._share.threads, function, call)
                for _, landing in flights.landed():
                    _raise_failed(landing.error, landing.lost, stage)
                    done += 1
                    progress(stage, done / len(calls))
        finally:
            flights.cancel()

    def _most(self) -> int:
        return self._jobs or max(self._cluster.capacity(self._share), 1)


def _raise_failed(error: BaseException | None, lost: str, stage: str) -> None:
    if error is not None:
        raise error
    if lost:
        raise TaskLostError(
            f"nodes that live until their tiles are done ({stage})",
            found=f"a task that was lost {1 + LOSSES} times: {lost}",
            fix="Check the cluster's memory and disks, and run the same command to go on.",
        )


def _limited(threads: int, function: Callable[..., object], call: Call) -> None:
    """A task with its share of the machine."""
    with few_threads(threads):
        function(*call)


def _begin() -> None:
    """Prepare a process for tasks: it leaves Ctrl-C to its parent, and ends with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
