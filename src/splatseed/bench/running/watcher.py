"""Watcher: told what happens while a benchmark runs. This one ignores everything."""

from __future__ import annotations

from splatseed.bench.planning.records import RunResult, RunSpec


class Watcher:
    """Told about runs by their executor; may be called from several threads at once."""

    def begun(self, spec: RunSpec) -> None:
        """A run has started."""

    def progress(self, spec: RunSpec, stage: str, fraction: float) -> None:
        """A fraction, 0 to 1, of a stage of a run is done."""

    def done(self, spec: RunSpec, result: RunResult) -> None:
        """A run is done and recorded."""

    def failed(self, spec: RunSpec, error: str) -> None:
        """A run has failed."""

    def handed_back(self, spec: RunSpec, reason: str) -> None:
        """A run has been stopped, and will be resumed."""

    def stopping(self, words: str) -> None:
        """The user asked to stop; the words say what happens to the runs."""
