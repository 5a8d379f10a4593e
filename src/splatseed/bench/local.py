"""The local executor: processes on this machine, some at a time.

Notation: a *slot* runs one process after the other; a machine's cores and GPUs are shared out among the
slots. Promise: a run whose process is killed is tried once more, after all others, and then fails; when
the user stops, runs in training leave checkpoints, and every run that is not done is handed back.
"""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Collection, Sequence
from contextlib import suppress
from pathlib import Path

from splatseed.bench.child import Child, Killed
from splatseed.bench.job import JobOptions, Outcome
from splatseed.bench.kept import kept_folder, work_folder
from splatseed.bench.ledger import Ledger
from splatseed.bench.records import RunSpec
from splatseed.bench.watcher import Watcher
from splatseed.bench.worker import HEARTBEAT_SECONDS, worker_name
from splatseed.errors import OutputError
from splatseed.train.interruption import Interruption, interruption

__all__ = ["LocalExecutor", "cores", "slot_environment"]

TRIES = 2
"""How often a run is begun whose process is killed, by one call of the command."""
POLL_SECONDS = 0.2
THREAD_VARIABLES = (
    "NUMBA_NUM_THREADS",
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
)


class LocalExecutor:
    """Runs what a ledger has to run, on this machine.

    Args:
        ledger: The ledger.
        bench: The benchmark's folder.
        jobs: How many runs at a time.
        threads: Threads of each; the cores shared out when left out.
        gpus: Names of the GPUs, as ``CUDA_VISIBLE_DEVICES`` has them; none to leave that alone.
        options: What runs do beside.
        watcher: Told what happens.
    """

    def __init__(
        self,
        ledger: Ledger,
        bench: Path,
        *,
        jobs: int = 1,
        threads: int | None = None,
        gpus: Sequence[str] = (),
        options: JobOptions | None = None,
        watcher: Watcher | None = None,
    ) -> None:
        self._ledger = ledger
        self._bench = bench
        self._environments = [slot_environment(slot, jobs, threads, gpus) for slot in range(jobs)]
        self._options = options or JobOptions()
        self._watcher = watcher or Watcher()
        self._worker = worker_name()
        self._stopping = threading.Event()
        self._deaths: Counter[str] = Counter()
        self._children: dict[str, Child] = {}
        self._lock = threading.Lock()
        self._errors: list[BaseException] = []

    def run(self, keys: Collection[str]) -> bool:
        """Do those of the runs that nobody else has, or until the user interrupts.

        The first SIGINT or SIGTERM stops the runs, which leave checkpoints; the second kills them.

        Returns:
            Whether it went to the end.

        Raises:
            OutputError: The ledger cannot be written.
        """
        ended = threading.Event()
        slots = [
            threading.Thread(target=self._slot, args=(environment, keys))
            for environment in self._environments
        ]
        pulse = threading.Thread(target=self._beat, args=(ended,))
        with interruption() as stop:
            for thread in (*slots, pulse):
                thread.start()
            try:
                self._wait(slots, stop)
            finally:
                ended.set()
                pulse.join()
        if self._errors:
            raise self._errors[0]
        return not self._stopping.is_set()

    def _wait(self, slots: Sequence[threading.Thread], stop: Interruption) -> None:
        try:
            while any(slot.is_alive() for slot in slots):
                if stop.requested and not self._stopping.is_set():
                    self._stop()
                time.sleep(POLL_SECONDS)
        except KeyboardInterrupt:
            self._stopping.set()
            with self._lock:
                for child in self._children.values():
                    child.kill()
            for slot in slots:
                slot.join()

    def _stop(self) -> None:
        """Ask all runs to stop, and begin no more."""
        with self._lock:
            if self._stopping.is_set():  # a second word would stop them at once
                return
            self._stopping.set()
            for child in self._children.values():
                child.stop()
        self._watcher.stopping()

    def _beat(self, ended: threading.Event) -> None:
        """Give a sign of life, so that no other process takes the runs."""
        while not ended.wait(HEARTBEAT_SECONDS):
            with suppress(OutputError):  # a busy disk; the next one may succeed
                self._ledger.heartbeat(self._worker)

    def _slot(self, environment: dict[str, str], keys: Collection[str]) -> None:
        try:
            while not self._stopping.is_set():
                spec = self._ledger.claim(self._worker, keys)
                if spec is None:
                    return
                self._run(spec, environment)
        except BaseException as error:  # noqa: BLE001  (raised again where the slots are waited for)
            self._errors.append(error)
            self._stop()

    def _run(self, spec: RunSpec, environment: dict[str, str]) -> None:
        self._watcher.begun(spec)
        try:
            outcome = self._outcome(spec, environment)
        except Killed as error:
            outcome = self._after_death(spec, str(error))
        if outcome.status == "done" and outcome.result is not None:
            self._ledger.finish(spec.key, outcome.result)
            self._watcher.done(spec, outcome.result)
        elif outcome.status == "failed":
            self._ledger.fail(spec.key, self._worker, outcome.error)
            self._watcher.failed(spec, outcome.error)
        else:
            self._ledger.release(spec.key, self._worker)
            self._watcher.handed_back(spec, outcome.error or "stopped")

    def _outcome(self, spec: RunSpec, environment: dict[str, str]) -> Outcome:
        """What comes of a run in a process."""
        work = work_folder(self._bench, spec.key)
        with self._lock:
            if self._stopping.is_set():
                return Outcome("interrupted")
            target = kept_folder(self._bench, spec.key)
            child = Child(spec, work, target, self._options, environment)
            self._children[spec.key] = child
        try:
            return child.wait(lambda stage, part: self._watcher.progress(spec, stage, part))
        finally:
            with self._lock:
                del self._children[spec.key]

    def _after_death(self, spec: RunSpec, how: str) -> Outcome:
        """What comes of a run whose process died: it may have been in want of memory for a while."""
        if self._stopping.is_set():
            return Outcome("interrupted")
        self._deaths[spec.key] += 1
        if self._deaths[spec.key] < TRIES:
            return Outcome("interrupted", error=f"its process was {how}")
        hint = "; out of memory? Try fewer --jobs or --cap-max" if "SIGKILL" in how else ""
        return Outcome("failed", error=f"its process was {how}, {TRIES} times{hint}")


def cores() -> int:
    """How many cores this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Windows and macOS
        return os.cpu_count() or 1


def slot_environment(
    slot: int, jobs: int, threads: int | None, gpus: Sequence[str]
) -> dict[str, str]:
    """The variables by which a slot's processes know their share of the machine.

    Args:
        slot: Its number, from 0.
        jobs: How many slots there are.
        threads: Threads of each; the cores shared out when None.
        gpus: Names of the GPUs; none to leave the choice to PyTorch.
    """
    count = threads or max(1, cores() // jobs)
    environment = dict.fromkeys(THREAD_VARIABLES, str(count))
    # Idle threads of the one pool would take the cores from the other: see splatseed.cli.
    environment["OMP_WAIT_POLICY"] = os.environ.get("OMP_WAIT_POLICY", "passive")
    if gpus:
        environment["CUDA_VISIBLE_DEVICES"] = gpus[slot % len(gpus)]
    return environment
