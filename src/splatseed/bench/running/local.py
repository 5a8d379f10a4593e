"""The local executor: processes on this machine, several at a time.

Notation: a *slot* runs one process after another; a machine's cores and GPUs are divided among the
slots. Promise: when the user stops, runs in training leave checkpoints; a second signal stops at
once.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from splatseed.bench.planning.records import RunSpec
from splatseed.bench.running.child import Child, Killed
from splatseed.bench.running.executor import Executor
from splatseed.bench.running.job import JobOptions, Outcome
from splatseed.bench.running.kept import kept_folder, work_folder
from splatseed.bench.running.ledger import Ledger
from splatseed.bench.running.watcher import Watcher
from splatseed.process.interruption import Interruption, interruption

POLL_SECONDS = 0.2


class LocalExecutor(Executor):
    """Executes the runs of a ledger on this machine.

    Args:
        ledger: The ledger.
        bench: The benchmark's folder.
        environments: The variables of each slot's processes; one entry per slot.
        options: Options of the runs.
        watcher: Told what happens.
    """

    def __init__(
        self,
        ledger: Ledger,
        bench: Path,
        environments: Sequence[Mapping[str, str]],
        options: JobOptions | None = None,
        watcher: Watcher | None = None,
    ) -> None:
        super().__init__(ledger, watcher)
        self._bench = bench
        self._environments = environments
        self._options = options or JobOptions()
        self._children: dict[str, Child] = {}
        self._lock = threading.Lock()
        self._errors: list[BaseException] = []

    def run(self, keys: Collection[str]) -> bool:
        """Execute the given runs that nobody else has, until none are left or the user stops.

        Returns:
            Whether it was completed.

        Raises:
            OutputError: The ledger or a folder cannot be written.
        """
        slots = [
            threading.Thread(target=self._slot, args=(environment, keys))
            for environment in self._environments
        ]
        with interruption() as stop, self.alive():
            for slot in slots:
                slot.start()
            try:
                self._wait(slots, stop)
            except KeyboardInterrupt:
                self._kill()
            for slot in slots:
                slot.join()
        if self._errors:
            raise self._errors[0]
        return not self.stopping.is_set()

    def _wait(self, slots: Sequence[threading.Thread], stop: Interruption) -> None:
        while any(slot.is_alive() for slot in slots):
            if stop.requested:
                self._stop()
            time.sleep(POLL_SECONDS)

    def _stop(self) -> None:
        """Ask all runs to stop, and start no more."""
        with self._lock:
            if self.stopping.is_set():  # a second signal would stop them at once
                return
            self.stopping.set()
            for child in self._children.values():
                child.stop()
        self.watcher.stopping("runs in training save a checkpoint; again Ctrl-C to stop at once")

    def _kill(self) -> None:
        with self._lock:
            self.stopping.set()
            for child in self._children.values():
                child.kill()

    def _slot(self, environment: Mapping[str, str], keys: Collection[str]) -> None:
        try:
            while (spec := self.claim(keys)) is not None:
                self.settle(spec, self._outcome(spec, environment))
        except BaseException as error:  # noqa: BLE001  (raised again where the slots are waited for)
            self._errors.append(error)
            self._stop()

    def _outcome(self, spec: RunSpec, environment: Mapping[str, str]) -> Outcome:
        """The outcome of a run in a process."""
        child = self._begin(spec, environment)
        if child is None:
            return Outcome("interrupted")
        try:
            return child.wait(lambda stage, part: self.watcher.progress(spec, stage, part))
        except Killed as error:
            return self.after_death(spec, str(error))
        finally:
            with self._lock:
                del self._children[spec.key]

    def _begin(self, spec: RunSpec, environment: Mapping[str, str]) -> Child | None:
        """The process of a run; None if the user has stopped meanwhile."""
        work, target = (folder(self._bench, spec.key) for folder in (work_folder, kept_folder))
        with self._lock:
            if self.stopping.is_set():
                return None
            child = Child(spec, work, target, self._options, environment)
            self._children[spec.key] = child
        return child
