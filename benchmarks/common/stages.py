"""Where a command's time and memory go: seconds, CPU seconds and peak memory of each stage.

Notation: a *stage* is one that the command reports as its progress, from its first report to the
first report of another; ``START`` is what comes before, imports above all. Promise: the stages add
up to the command. For a process of its own (``children.call``), where one command runs;
processes that it starts count.
"""

from __future__ import annotations

import os
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.common.memory import FamilyWatch, family_seconds, reset_peak, status_bytes

from splatseed import cli, console

__all__ = ["START", "Stage", "StageWatch", "run_command"]

START = "start"


@dataclass
class Stage:
    """What a stage took, all its parts together."""

    name: str
    seconds: float = 0.0
    processor: float = 0.0
    """CPU seconds of all threads and processes."""
    peak: int = 0
    """Peak resident bytes of all processes; -1 off Linux."""


class StageWatch:
    """Measures stages of this process and its descendants; ``begin`` ends the running one."""

    def __init__(self) -> None:
        self._stages = {START: Stage(START)}
        self._running = START
        self._family = FamilyWatch(os.getpid())
        self._family.__enter__()
        self._since = _now()
        reset_peak()

    def begin(self, name: str) -> None:
        """Note what the running stage took, and begin another unless it is the same."""
        if name == self._running:
            return
        self._end()
        self._running = name

    def stages(self) -> list[Stage]:
        """End the running stage, and with it all; return them in order of first appearance."""
        self._end()
        self._family.__exit__(None, None, None)
        return list(self._stages.values())

    def _end(self) -> None:
        now = _now()
        # The kernel knows this process' peak; what it has together with others is sampled.
        peak = max(status_bytes("VmHWM"), self._family.peak)
        stage = self._stages.setdefault(self._running, Stage(self._running))
        stage.seconds += now[0] - self._since[0]
        stage.processor += now[1] - self._since[1]
        stage.peak = max(stage.peak, peak)
        self._since, self._family.peak = now, 0
        reset_peak()


def _now() -> tuple[float, float]:
    """The wall's clock, and the CPU seconds of all processes."""
    return time.perf_counter(), family_seconds(os.getpid())


def run_command(arguments: list[str]) -> list[dict[str, Any]]:
    """Run ``splatseed`` with these arguments in this process, and return its stages.

    Raises:
        SystemExit: The command failed; it printed why.
    """
    watch = StageWatch()

    class Watched(console.StageClock):
        """Begins the stages that the command reports, and compilation."""

        def __call__(self, stage: str, fraction: float) -> None:
            watch.begin(stage)
            super().__call__(stage, fraction)

        def compilation(self, begins: bool) -> None:
            super().compilation(begins)
            with suppress(IndexError):  # no stage yet
                watch.begin(self._started[-1][0])

    console.StageClock = Watched  # type: ignore[misc]  # what ``stage_display`` makes
    cli.main(arguments)
    return [asdict(stage) for stage in watch.stages()]
