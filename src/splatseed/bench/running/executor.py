"""Shared by executors: claiming runs, heartbeats, and handling outcomes.

Promise: a run whose process is killed is retried once, after all others, and then fails; an
executor that stops hands back every run that is not done.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress

from splatseed.bench.planning.records import RunSpec
from splatseed.bench.running.job import Outcome
from splatseed.bench.running.ledger import Ledger
from splatseed.bench.running.watcher import Watcher
from splatseed.bench.running.worker import HEARTBEAT_SECONDS, worker_name
from splatseed.errors import OutputError

TRIES = 2
"""How often one call of the command starts a run whose process is killed."""


class Executor:
    """The ledger's side of an executor.

    Args:
        ledger: The ledger.
        watcher: Told what happens.
    """

    def __init__(self, ledger: Ledger, watcher: Watcher | None = None) -> None:
        self.ledger = ledger
        self.watcher = watcher or Watcher()
        self.worker = worker_name()
        self.stopping = threading.Event()
        self._deaths: Counter[str] = Counter()

    def claim(self, keys: Collection[str]) -> RunSpec | None:
        """The next run to do; None where there is none, or the user stops.

        Raises:
            OutputError: The ledger cannot be written.
        """
        if self.stopping.is_set():
            return None
        spec = self.ledger.claim(self.worker, keys)
        if spec is not None:
            self.watcher.begun(spec)
        return spec

    def settle(self, spec: RunSpec, outcome: Outcome) -> None:
        """Record the outcome of a run, and report it.

        Raises:
            OutputError: The ledger cannot be written.
        """
        if outcome.status == "done" and outcome.result is not None:
            self.ledger.finish(spec.key, outcome.result)
            self.watcher.done(spec, outcome.result)
        elif outcome.status == "failed":
            self.ledger.fail(spec.key, self.worker, outcome.error)
            self.watcher.failed(spec, outcome.error)
        else:
            self.ledger.release(spec.key, self.worker)
            self.watcher.handed_back(spec, outcome.error or "stopped")

    def after_death(self, spec: RunSpec, how: str) -> Outcome:
        """The outcome of a run whose process died: memory may have been short only for a while."""
        if self.stopping.is_set():
            return Outcome("interrupted")
        self._deaths[spec.key] += 1
        if self._deaths[spec.key] < TRIES:
            return Outcome("interrupted", error=f"its process was {how}")
        hint = "; out of memory? Try fewer --jobs, or --cap-max" if "SIGKILL" in how else ""
        return Outcome("failed", error=f"its process was {how}, {TRIES} times{hint}")

    @contextmanager
    def alive(self) -> Iterator[None]:
        """Send heartbeats while the block runs, so that no other process takes the runs."""
        ended = threading.Event()
        pulse = threading.Thread(target=self._beat, args=(ended,), daemon=True)
        pulse.start()
        try:
            yield
        finally:
            ended.set()
            pulse.join()

    def _beat(self, ended: threading.Event) -> None:
        while not ended.wait(HEARTBEAT_SECONDS):
            with suppress(OutputError):  # a busy disk; the next one may succeed
                self.ledger.heartbeat(self.worker)
