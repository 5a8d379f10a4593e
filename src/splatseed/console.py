"""The terminal: progress bars on stderr, results on stdout.

Promise: nothing is drawn when stderr is not a terminal; a stage's time runs until the next begins;
what is printed is shown as it is, so that no file name can colour, move or rewrite anything.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress as Bar,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from splatseed.literal import visible
from splatseed.runtime.compilation import watched


class LiteralConsole(Console):
    """A console without markup, emoji and highlighting, that escapes what terminals act on."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Text unchanged but for control characters; Rich calls this for every string."""
        return super().render_str(visible(text, keep="\n"), **options)


OUT = LiteralConsole()
ERR = LiteralConsole(stderr=True)
WIDEST = 1000
"""Most characters of a table's line in a file."""
COMPILE = "compiling kernels"
TOLD_AFTER = 3.0
"""Compilations shorter than this many seconds are not logged."""


class _Bars(BarColumn):
    """Bars that stand still until their stage begins; Rich's would pulse."""

    def render(self, task: Task) -> ProgressBar:
        """The bar of a stage."""
        bar = super().render(task)
        bar.pulse = False
        return bar


class StageClock:
    """A ``Progress`` that times the stages and, within ``stage_display``, shows them."""

    def __init__(self) -> None:
        self._bar: Bar | None = None
        self._tasks: dict[str, TaskID] = {}
        self._started: list[tuple[str, float]] = []
        self._compiling = 0
        self._before = COMPILE
        self._announced = False
        self._told = 0.0

    def __call__(self, stage: str, fraction: float) -> None:
        """Note that ``fraction`` of ``stage`` is done."""
        if not self._started or self._started[-1][0] != stage:
            self._started.append((stage, time.perf_counter()))
        if self._bar is not None:
            self.expect(stage)
            self._bar.start_task(self._tasks[stage])
            self._bar.update(self._tasks[stage], completed=fraction)

    def expect(self, *stages: str) -> None:
        """Show stages that are still to come, so that the user sees what is left."""
        if self._bar is not None:
            for stage in stages:
                if stage not in self._tasks:
                    self._tasks[stage] = self._bar.add_task(stage, total=1.0, start=False)

    def seconds(self) -> dict[str, float]:
        """Wall time of each stage so far, in order of first appearance."""
        if not self._started:
            return {}
        ends = [start for _, start in self._started[1:]] + [time.perf_counter()]
        total: dict[str, float] = {}
        for (stage, start), end in zip(self._started, ends, strict=True):
            total[stage] = total.get(stage, 0.0) + end - start
        return total

    def begin_compilation(self) -> None:
        """Count time as compilation and show it; compilations can nest."""
        self._compiling += 1
        if self._compiling == 1:
            self._before = self._started[-1][0] if self._started else COMPILE
            self._started.append((COMPILE, time.perf_counter()))
            if self._bar is not None and COMPILE not in self._tasks:
                note = f"{COMPILE} (first use only, then cached)"
                self._tasks[COMPILE] = self._bar.add_task(note, total=None)

    def end_compilation(self) -> None:
        """Return to the stage that compilation interrupted."""
        self._compiling -= 1
        if self._compiling == 0:
            self._started.append((self._before, time.perf_counter()))
            if self._bar is not None and COMPILE in self._tasks:
                self._bar.remove_task(self._tasks.pop(COMPILE))
            if self._bar is None and not self._announced and self._compiled() > TOLD_AFTER:
                self._announced = True
                ERR.print(f"{COMPILE}, needed on first use ...")

    def tell_compilation(self) -> None:
        """Report on stderr how long compilation took since the last report, if it was long."""
        since = self._compiled() - self._told
        if since > TOLD_AFTER:
            self._told += since
            ERR.print(f"{COMPILE} took {since:.0f} s; cached for the next run")

    def _compiled(self) -> float:
        return self.seconds().get(COMPILE, 0.0)

    @contextmanager
    def shown_on(self, bar: Bar) -> Iterator[None]:
        """Show the stages on ``bar`` while the block runs."""
        self._bar, self._tasks = bar, {}
        try:
            yield
        finally:
            self._bar = None


@contextmanager
def stage_display(
    clock: StageClock | None = None, *, remaining: bool = False
) -> Iterator[StageClock]:
    """Show progress bars on stderr while the block runs; print to stdout only outside the block.

    Args:
        clock: A clock that was shown before, to resume; a new one when left out.
        remaining: Whether to show the time left too, for stages that take minutes.
    """
    clock = StageClock() if clock is None else clock
    if not ERR.is_terminal:
        with _compilation_shown(clock):
            yield clock
        clock.tell_compilation()
        return
    left = (TextColumn("left", markup=False), TimeRemainingColumn()) if remaining else ()
    named = TextColumn("{task.description}", markup=False)
    columns = (named, _Bars(), TimeElapsedColumn(), *left)
    with (
        Bar(*columns, console=ERR, transient=True) as bar,
        clock.shown_on(bar),
        _compilation_shown(clock),
    ):
        yield clock
    clock.tell_compilation()


def _compilation_shown(clock: StageClock) -> AbstractContextManager[None]:
    """Tell the clock about compilations, which make a first run slow."""
    return watched(lambda begins: clock.begin_compilation() if begins else clock.end_compilation())


def print_pairs(title: str, rows: Sequence[tuple[str, str]]) -> None:
    """Print names and their values, or commands, unwrapped so that they can be copied."""
    _print_title(title)
    _print_columns(rows)


def print_note(note: str) -> None:
    """Print one thing the user should know."""
    OUT.print("note:", style="yellow", end=" ")
    OUT.print(visible(note), soft_wrap=True)


def print_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table whose first column names the row."""
    table = Table(box=None, pad_edge=False)
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i == 0 else "right")
    for row in rows:
        table.add_row(*map(visible, row))
    _print_title(title)
    # A file has no edge at which names would have to be cut short.
    (OUT if OUT.is_terminal else LiteralConsole(file=OUT.file, width=WIDEST)).print(table)


def _print_title(title: str) -> None:
    OUT.print(f"\n{visible(title)}", style="bold", soft_wrap=True)


def _print_columns(rows: Sequence[tuple[str, str]]) -> None:
    width = max((len(label) for label, _ in rows), default=0)
    for label, value in rows:
        OUT.print(f"  {label:<{width}}  {visible(value)}", soft_wrap=True)
