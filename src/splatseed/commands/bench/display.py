"""The display of a running benchmark: bars on stderr, one line per finished run on stdout."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from rich.progress import BarColumn, Progress as Bar, TaskID, TextColumn

from splatseed.bench.planning.records import RunResult, RunSpec
from splatseed.bench.running.watcher import Watcher
from splatseed.console import ERR, OUT
from splatseed.literal import visible

TRAIN = "train"
MINUTE = 60.0


class RunDisplay(Watcher):
    """Shows the progress of a benchmark; its methods are called from several threads.

    Args:
        seconds: Expected seconds of each remaining run, by its key.
        done: Number of runs done already.
        jobs: Number of runs at a time.
        bar: Where to draw; None without a terminal.
    """

    def __init__(
        self, seconds: Mapping[str, float], done: int, jobs: int, bar: Bar | None = None
    ) -> None:
        self._expected = dict(seconds)
        self._ended, self._total, self._failed = done, done + len(seconds), 0
        self._jobs, self._bar = jobs, bar
        self._tasks: dict[str, TaskID] = {}
        self._parts: dict[str, float] = {}
        self._begun: dict[str, float] = {}
        self._pace = (0.0, 0.0)
        self._lock = threading.RLock()
        self._whole = bar.add_task("", total=self._total) if bar else None
        self._draw()

    def begun(self, spec: RunSpec) -> None:
        """Show a run."""
        with self._lock:
            self._begun[spec.key], self._parts[spec.key] = time.monotonic(), 0.0
            if self._bar:
                self._tasks[spec.key] = self._bar.add_task(f"  {describe(spec)}", total=1.0)
            self._draw()

    def progress(self, spec: RunSpec, stage: str, fraction: float) -> None:
        """Show how far a run is."""
        with self._lock:
            if stage == TRAIN:
                self._parts[spec.key] = fraction
            if self._bar and spec.key in self._tasks:
                label = f"  {describe(spec)}: {stage}"
                self._bar.update(self._tasks[spec.key], completed=fraction, description=label)
            self._draw()

    def done(self, spec: RunSpec, result: RunResult) -> None:
        """Report the result of a run."""
        with self._lock:
            seconds = self._end(spec)
            expected, actual = self._pace
            self._pace = (expected + self._expected.pop(spec.key, 0.0), actual + seconds)
            self._say(
                f"{describe(spec)}: {result.psnr:.2f} dB, {result.num_gaussians:,} Gaussians,"
                f" {seconds:.0f} s"
            )

    def failed(self, spec: RunSpec, error: str) -> None:
        """Report why a run failed."""
        with self._lock:
            self._end(spec)
            self._failed += 1
            self._expected.pop(spec.key, None)
            self._say(f"{describe(spec)} failed: {error}")

    def handed_back(self, spec: RunSpec, reason: str) -> None:
        """Report why a run is not done."""
        with self._lock:
            self._end(spec)
            self._ended -= 1
            self._say(f"{describe(spec)}: {reason}; to be resumed", count=False)

    def stopping(self, words: str) -> None:
        """Report what the user is waiting for."""
        ERR.print(f"stopping: {words}")

    def _end(self, spec: RunSpec) -> float:
        """Remove a run from the display; returns the seconds it took."""
        self._ended += 1
        self._parts.pop(spec.key, None)
        task = self._tasks.pop(spec.key, None)
        if self._bar and task is not None:
            self._bar.remove_task(task)
        return time.monotonic() - self._begun.pop(spec.key, time.monotonic())

    def _say(self, text: str, *, count: bool = True) -> None:
        number = f"[{self._ended}/{self._total}] " if count else ""
        OUT.print(f"{number}{text}", soft_wrap=True)
        self._draw()

    def _draw(self) -> None:
        if self._bar is None or self._whole is None:
            return
        failed = f", {self._failed} failed" if self._failed else ""
        label = (
            f"{self._ended - self._failed} of {self._total} done, {len(self._begun)} running"
            f"{failed}, {spoken_time(self.seconds_left())} left"
        )
        self._bar.update(self._whole, completed=self._ended, description=label)

    def seconds_left(self) -> float:
        """An estimate, refined by the time that runs have taken so far."""
        expected, actual = self._pace
        left = sum(self._expected.values())
        left -= sum(part * self._expected.get(key, 0.0) for key, part in self._parts.items())
        return left / self._jobs * (actual / expected if expected else 1.0)


@contextmanager
def run_display(seconds: Mapping[str, float], done: int, jobs: int) -> Iterator[RunDisplay]:
    """A display while the block runs; bars only where stderr is a terminal.

    Args:
        seconds: Expected seconds of each remaining run, by its key.
        done: Number of runs done already.
        jobs: Number of runs at a time.
    """
    if not ERR.is_terminal:
        yield RunDisplay(seconds, done, jobs)
        return
    columns = (BarColumn(20), TextColumn("{task.description}", markup=False))
    # What goes into a file on stdout must not end up on the terminal.
    shared = sys.stdout.isatty()
    with Bar(*columns, console=ERR, transient=True, redirect_stdout=shared) as bar:
        yield RunDisplay(seconds, done, jobs, bar)


def describe(spec: RunSpec) -> str:
    """A run in a few words."""
    budget = f", {spec.arm.budget}" if spec.arm.budget else ""
    arm = f"{spec.arm.label}, {spec.arm.strategy}{budget}"
    return f"{visible(spec.scene)}, {arm}, repeat {spec.repeat + 1}"


def spoken_time(seconds: float) -> str:
    """A duration in words, as roughly as an estimate deserves."""
    if seconds < 1.5 * MINUTE:
        return f"{seconds:.0f} s"
    if seconds < 90 * MINUTE:
        return f"{seconds / MINUTE:.0f} min"
    return f"{seconds / MINUTE / MINUTE:.1f} h"
