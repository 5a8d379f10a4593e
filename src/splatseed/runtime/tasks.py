"""Functions called here, in child processes, or (``ray_tasks``) on a Ray cluster.

Notation: a *task* is a call of a function at the top of a module, with arguments that can be
pickled. Promise: a failure ends no other task; a process that dies is the failure of its task
alone, which is tried once more after all others. Children import nothing from the working
directory (a ``numpy.py`` that lies there is never executed), and end with us. On Ctrl-C they get a
SIGTERM, at which training saves a checkpoint, and on a second one they are killed.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass
from typing import IO, Any, TypeAlias, cast

from splatseed.errors import SplatseedError, TaskLostError
from splatseed.progress import Progress, silent, thread_limit
from splatseed.runtime.interruption import interruption

Function: TypeAlias = Callable[..., Any]
Report: TypeAlias = Callable[[int, str, float], None]
"""Takes a task's index, its stage, and the fraction of it that is done."""

_PROGRAM = "from splatseed.runtime.tasks import serve; serve()"
_POLL_SECONDS = 0.2
_REPORT_SECONDS = 0.5
_LAST_WORDS = 40


def cores() -> int:
    """How many cores this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Windows and macOS
        return os.cpu_count() or 1


def slot_environment(threads: int, gpu: str = "") -> dict[str, str]:
    """The variables that tell a process its share of the machine; results do not depend on it.

    ``gpu`` is as in ``CUDA_VISIBLE_DEVICES``; empty to leave the choice to PyTorch.
    """
    libraries = ("NUMBA", "OMP", "MKL", "OPENBLAS")
    environment = {f"{library}_NUM_THREADS": str(threads) for library in libraries}
    # Idle threads of one pool would take the cores from the other: see splatseed.cli.
    environment["OMP_WAIT_POLICY"] = os.environ.get("OMP_WAIT_POLICY", "passive")
    return {**environment, "CUDA_VISIBLE_DEVICES": gpu} if gpu else environment


@dataclass(frozen=True)
class Result:
    """How a task, the call of this index, ended: what it returned or raised."""

    index: int
    value: Any = None
    error: Exception | None = None
    """A ``TaskLostError`` if its process or node died."""


class Tasks(ABC):
    """Something that carries out tasks."""

    words: str
    """A description for the user."""

    @abstractmethod
    def run(
        self, function: Function, calls: Sequence[tuple[Any, ...]], report: Report | None = None
    ) -> Iterator[Result]:
        """Call a function once with each of some arguments; gives results as tasks end.

        Args:
            function: The function.
            calls: Its arguments, task by task.
            report: Told when a task starts; then the function is also given a ``progress``, and
                what it tells that one is passed on, but for tasks on a cluster.

        Raises:
            KeyboardInterrupt: The user stopped it; tasks that ended in time were given before.
        """


class HereTasks(Tasks):
    """Tasks one after another in this process."""

    words = "this process"

    def run(
        self, function: Function, calls: Sequence[tuple[Any, ...]], report: Report | None = None
    ) -> Iterator[Result]:
        """See ``Tasks``."""
        for index, call in enumerate(calls):
            try:
                yield Result(index, function(*call, **_progress_of(index, report)))
            except Exception as error:  # noqa: BLE001  (the caller's to judge)
                yield Result(index, error=error)


class ProcessTasks(Tasks):
    """Tasks in processes of this machine, each of which a thread of this one waits for.

    Args:
        environments: Variables of each process, such as ``slot_environment`` gives.
        fresh: Whether each task gets a new process, as to measure its memory.
    """

    def __init__(self, environments: Sequence[Mapping[str, str]], *, fresh: bool = False) -> None:
        self._environments, self._fresh = environments, fresh
        self.words = f"{len(environments)} processes"

    def run(
        self, function: Function, calls: Sequence[tuple[Any, ...]], report: Report | None = None
    ) -> Iterator[Result]:
        """See ``Tasks``."""
        slots, died = _Slots(self._environments, fresh=self._fresh), set[int]()

        def work(index: int) -> Any:
            return slots.call(function, calls[index], _progress_of(index, report))

        pool = ThreadPoolExecutor(len(self._environments))
        with interruption() as stop:
            try:
                futures = {pool.submit(work, index): index for index in range(len(calls))}
                while futures:
                    done = wait(futures, _POLL_SECONDS, FIRST_COMPLETED).done
                    if stop.requested and not slots.stopped:
                        pool.shutdown(wait=False, cancel_futures=True)
                        futures = {each: futures[each] for each in futures if not each.cancelled()}
                        slots.stop(signal.SIGTERM)
                    for future in done & futures.keys():
                        index, error = futures.pop(future), future.exception()
                        lost = isinstance(error, TaskLostError)
                        if lost and index not in died and not slots.stopped:
                            died.add(index)
                            futures[pool.submit(work, index)] = index
                        elif not (lost and slots.stopped):
                            value = None if error else future.result()
                            yield Result(index, value, cast("Exception | None", error))
            finally:
                pool.shutdown(wait=False, cancel_futures=True)
                slots.stop(signal.SIGKILL if os.name == "posix" else signal.SIGTERM)
                pool.shutdown()
                slots.close()
        if stop.requested:
            raise KeyboardInterrupt


class _Slots:
    """The processes of ``ProcessTasks``, one for each environment, each begun when it is needed."""

    def __init__(self, environments: Sequence[Mapping[str, str]], *, fresh: bool) -> None:
        self._free: queue.SimpleQueue[tuple[Mapping[str, str], Child | None]] = queue.SimpleQueue()
        for environment in environments:
            self._free.put((environment, None))
        self._fresh, self._children, self.stopped = fresh, set[Child](), False

    def call(self, function: Function, arguments: tuple[Any, ...], told: dict[str, Any]) -> Any:
        """Call a function in a free process."""
        environment, child = self._free.get()
        try:
            if child is None:
                child = Child(environment, tempfile.TemporaryFile())  # noqa: SIM115  (the child's)
                self._children.add(child)
            if self.stopped:  # meanwhile
                child.process.kill()
            return child.call(function, *arguments, **told)
        finally:
            if child is not None and (self._fresh or child.process.poll() is not None):
                self._children.discard(child)
                child.close()
                child = None
            self._free.put((environment, child))

    def stop(self, number: int) -> None:
        """Send all processes a signal; those that begin later are killed."""
        self.stopped = True
        for child in list(self._children):
            child.process.send_signal(number)

    def close(self) -> None:
        """End all processes; no thread may wait for any."""
        for child in self._children:
            child.close()


class Child:
    """A process that calls functions for us, one after another.

    Args:
        environment: Variables to set.
        log: Where its output goes; the terminal when left out. ``close`` closes it.
    """

    def __init__(
        self, environment: Mapping[str, str] | None = None, log: IO[bytes] | None = None
    ) -> None:
        # An empty entry would stand for the working directory.
        paths = os.pathsep.join(filter(None, sys.path))
        self._log = log
        self.process = subprocess.Popen(  # noqa: S603  (our own interpreter and module)
            [sys.executable, "-P", "-c", _PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            env={**os.environ, "PYTHONPATH": paths, "PYTHONSAFEPATH": "1", **(environment or {})},
            process_group=0,  # Ctrl-C reaches only us
        )

    def start(self, function: Function, *arguments: object, reports: bool = False) -> None:
        """Begin a call, with a ``progress`` too if it ``reports``; ``wait`` gives its result."""
        commands = cast("IO[bytes]", self.process.stdin)
        with suppress(BrokenPipeError):  # it has died, as waiting will tell
            pickle.dump(pickle.dumps((function, arguments, reports)), commands)
            commands.flush()

    def wait(self, progress: Progress = silent) -> Any:
        """What the function returns, or raises; a ``TaskLostError``: the process died."""
        replies = cast("IO[bytes]", self.process.stdout)
        try:
            while (reply := pickle.load(replies))[0] == "told":  # noqa: S301  (our child)
                progress(*reply[1:])
        except (EOFError, pickle.UnpicklingError):
            raise self._death() from None
        if reply[0] == "failed":
            raise reply[1]
        return reply[1]

    def call(self, function: Function, *arguments: object, progress: Progress | None = None) -> Any:
        """``start`` and ``wait``."""
        self.start(function, *arguments, reports=progress is not None)
        return self.wait(progress or silent)

    def close(self) -> None:
        """End the process, whatever it is doing."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout, self._log):
            with suppress(BrokenPipeError):
                if pipe is not None:
                    pipe.close()

    def _death(self) -> TaskLostError:
        code = self.process.wait()
        found = "one that "
        found += f"killed by {signal.Signals(-code).name}" if code < 0 else f"ended by code {code}"
        if self._log is not None:
            self._log.seek(0)
            said = self._log.read().decode("utf-8", "replace").split()[-_LAST_WORDS:]
            found += f": {' '.join(said)}" if said else ""
        return TaskLostError(
            "a process that lives until its work is done",
            found=found,
            fix="Out of memory? Use fewer processes at a time (`jobs`), or smaller settings.",
        )


def serve() -> None:
    """Act as a child: call the functions that come in, until the parent ends."""
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print goes to the log
    if "NUMBA_NUM_THREADS" in os.environ:
        thread_limit.set(int(os.environ["NUMBA_NUM_THREADS"]))
    commands: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(commands,), daemon=True).start()
    last = ("", 0.0)

    def reply(*message: object) -> None:
        replies.write(pickle.dumps(message))
        replies.flush()

    def progress(stage: str, fraction: float) -> None:
        nonlocal last
        if stage != last[0] or fraction >= 1.0 or time.monotonic() - last[1] > _REPORT_SECONDS:
            last = (stage, time.monotonic())
            reply("told", stage, float(fraction))

    try:
        while True:
            function, arguments, reports = pickle.loads(commands.get())  # noqa: S301  (our parent)
            last = ("", 0.0)
            try:
                reply("done", function(*arguments, **({"progress": progress} if reports else {})))
            except Exception as error:  # noqa: BLE001  (the parent's to judge)
                if not isinstance(error, SplatseedError):
                    error.add_note(traceback.format_exc())
                reply("failed", error)
    except BaseException:  # noqa: BLE001  (the process ends here)
        traceback.print_exc()
    finally:
        os._exit(1)  # at once: the other thread holds a lock that a usual end would wait for


def _listen(commands: queue.SimpleQueue[bytes]) -> None:
    """Pass on what the parent sends; its end, even if it is killed, closes the pipe."""
    with suppress(EOFError):
        while True:
            commands.put(pickle.load(sys.stdin.buffer))  # noqa: S301  (our parent)
    os._exit(1)


def _progress_of(index: int, report: Report | None) -> dict[str, Progress]:
    """The argument for a task's progress, if any is wanted."""
    if report is None:
        return {}
    report(index, "start", 0.0)
    return {"progress": lambda stage, fraction: report(index, stage, fraction)}
