"""Print results to stdout and all else to stderr, for people or for programs (``Reporting``).

If stderr is not a terminal, nothing is drawn; long work prints a line per stage. A stage's time
runs until the next one starts. Control characters are escaped, so that no file name can colour the
terminal, move its cursor or rewrite a line.
"""

from __future__ import annotations

import ast
import json
import logging
import math
import re
import sys
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import (
    AbstractContextManager,
    ExitStack,
    contextmanager,
    nullcontext,
    redirect_stdout,
)
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import IO, Any

from rich import progress as rich_progress
from rich.console import Console
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from splatseed.findings import LEVELS, LOGGER, Finding
from splatseed.progress import COMPILATION, Progress, StageTimes, extraction_progress, watched
from splatseed.text import quoted, visible

ARGUMENT = re.compile(r"`(?P<name>[a-z]\w*(?:\.[a-z]\w*)*)(?:=(?P<value>[^`]+))?`")
"""An argument in a message of the library, with its value if one is suggested."""
OPTIONS = {"cap_max": "budget", "seeding": "seeds", "depths": "depth"}
"""Options whose names differ from the arguments they set."""
FILE_SETTINGS = frozenset(
    {"opacity_reset", "placing", "seed_colors", "seed_normals", "seed_sizes", "sh_degree"}
)
"""Arguments that are no options: on the command line only files set them."""


@dataclass(frozen=True)
class Reporting:
    """What a command prints; options of every verb."""

    json: bool = False
    """Print one JSON object to stdout instead: results, findings, next commands."""
    quiet: bool = False
    """Print only warnings and errors to stderr."""
    verbose: bool = False
    """Also print stages with their times to stderr, and the traceback of an error."""
    log: Path | None = None
    """Append to this file what --verbose prints, with date and time."""


class _Session(logging.Handler):
    """A call of the command line: what it prints, its results, and contexts to leave at its end.

    As a handler it prints what the library logs.
    """

    def __init__(self) -> None:
        super().__init__()
        self.log: IO[str] | None = None
        self.stdout: IO[str] | None = None  # for ``--json``, away from what other libraries print
        self.stack: ExitStack | None = None  # None outside of a call
        self.reset()

    def reset(self) -> None:
        self.shown = logging.INFO
        self.results: dict[str, Any] = {}
        self.findings: dict[Finding, None] = {}
        self.next: list[dict[str, str]] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Print a message of the library."""
        if (finding := getattr(record, "finding", None)) is not None:
            print_note(finding)
            return
        label = "note" if record.levelno >= logging.WARNING else ""
        print_message(self.format(record), record.levelno, label)


_SESSION = _Session()


class LiteralConsole(Console):
    """A console without markup, emoji and highlighting that escapes control characters."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    @property
    def is_terminal(self) -> bool:
        """Whether bars may be drawn and lines must be wrapped."""
        return super().is_terminal and not (self.stderr and _SESSION.shown > logging.INFO)

    def render_str(self, text: str, **options: Any) -> Text:
        """Escape control characters but newlines; Rich calls this for every string."""
        return super().render_str(visible(text, keep="\n"), **options)


OUT = LiteralConsole()
ERR = LiteralConsole(stderr=True)
FILE_WIDTH = 1000
"""Width of tables in a file, in characters."""
LINE_INTERVAL = 30.0
"""Seconds between lines on a running stage, if stderr is not a terminal."""
MIN_LOGGED_COMPILATION = 3.0
"""Compilations of fewer seconds are not logged."""
_STYLES = {"note": "yellow", "error": "bold red"}


@contextmanager
def session() -> Iterator[None]:
    """Print what the library logs while the block runs; then leave the contexts of ``hold``."""
    level = LOGGER.level
    LOGGER.addHandler(_SESSION)
    LOGGER.setLevel(logging.DEBUG)
    try:
        with ExitStack() as _SESSION.stack:
            try:
                yield
            except Exception:
                _SESSION.shown = logging.CRITICAL  # Python prints it
                print_message(traceback.format_exc(), logging.ERROR)
                raise
    finally:
        LOGGER.removeHandler(_SESSION)
        LOGGER.setLevel(level)
        _SESSION.log = _SESSION.stdout = _SESSION.stack = None
        _SESSION.reset()
        OUT.quiet = False


def hold(context: AbstractContextManager[Any]) -> Any:
    """Enter a context until the call of the command line ends; outside of a call, do not."""
    return None if _SESSION.stack is None else _SESSION.stack.enter_context(context)


def configure(reporting: Reporting) -> None:
    """Print what the options ask for until the call of the command line ends.

    Raises:
        OSError: The log file cannot be written.
    """
    if _SESSION.stack is None:
        return
    if reporting.json:
        OUT.quiet, _SESSION.stdout = True, sys.stdout
        hold(redirect_stdout(sys.stderr))
    levels = {reporting.verbose: logging.DEBUG, reporting.quiet: logging.WARNING}
    _SESSION.shown = levels.get(True, logging.INFO)
    if reporting.log is not None:
        _SESSION.log = hold(reporting.log.open("a", encoding="utf-8"))


def print_message(text: str, level: int = logging.INFO, label: str = "") -> None:
    """Print a message to stderr and to the log file, each if it takes this level of ``logging``."""
    if level >= _SESSION.shown:
        if label:
            ERR.print(f"{label}:", style=_STYLES[label], end=" ")
        ERR.print(text, soft_wrap=True)
    if _SESSION.log is not None:
        now, name = time.strftime("%Y-%m-%d %H:%M:%S"), logging.getLevelName(level)
        print(now, name, visible(text, keep="\n"), file=_SESSION.log, flush=True)


def add_results(**results: object) -> None:
    """Add results to the object that ``--json`` prints."""
    _SESSION.results |= results


def print_report() -> None:
    """With ``--json``, print the results so far with findings and next commands, as one object."""
    if _SESSION.stdout is not None and _SESSION.results:
        notes = {"findings": list(_SESSION.findings), "next": _SESSION.next}
        content = as_json({**_SESSION.results, **notes})
        print(json.dumps(content, indent=2, allow_nan=False), file=_SESSION.stdout)
    _SESSION.results = {}
    (_SESSION.stdout or OUT.file).flush()  # a parent process may wait for it


def as_json(value: Any) -> Any:
    """Convert a value for JSON: a dataclass to an object, a number that is not finite to null."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, Mapping):
        return {str(key): as_json(each) for key, each in value.items()}
    if hasattr(value, "tolist"):  # NumPy's
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [as_json(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | None) else str(value)


class _Bars(rich_progress.BarColumn):
    def render(self, task: rich_progress.Task) -> ProgressBar:
        """Return a stage's bar; Rich's would pulse until the stage starts."""
        bar = super().render(task)
        bar.pulse = False
        return bar


class _Lines:
    """A ``Progress`` that prints a line when a stage ends, and every ``LINE_INTERVAL`` before."""

    def __init__(self, items: Mapping[str, tuple[int, str]], level: int) -> None:
        self._level = level
        self._items = items  # by stage: the number of items, and their noun
        self._times: dict[str, tuple[float, float]] = {}  # by stage: its start, its last line
        self._ended = set[str]()

    def __call__(self, stage: str, fraction: float) -> None:
        now = time.perf_counter()
        start, last = self._times.setdefault(stage, (now, now))
        if stage in self._ended or (fraction < 1 and now - last < LINE_INTERVAL):
            return
        self._times[stage] = start, now
        total, noun = self._items.get(stage, (0, ""))
        done = f" {round(fraction * total):,} of {total:,} {noun}" if total else f" {fraction:.0%}"
        if fraction >= 1:
            self._ended.add(stage)
            done = f" {total:,} {noun}" if total else " done"
        seconds = f"{now - start:.{0 if now - start >= 10 else 1}f} s"
        print_message(f"{stage}:{done}, {seconds}", self._level)


class StageClock(StageTimes):
    """A ``Progress`` that times stages and, within ``stage_display``, shows them."""

    def __init__(self) -> None:
        super().__init__()
        self._lines: _Lines | None = None
        self._items: dict[str, tuple[int, str]] = {}
        self._bar: rich_progress.Progress | None = None
        self._tasks: dict[str, rich_progress.TaskID] = {}
        self._logged = 0.0

    def __call__(self, stage: str, fraction: float) -> None:
        """Record that ``fraction`` of ``stage`` is done."""
        super().__call__(stage, fraction)
        if self._lines is not None:
            self._lines(stage, fraction)
        if self._bar is not None:
            self.expect(stage)
            self._bar.start_task(self._tasks[stage])
            self._bar.update(self._tasks[stage], completed=fraction)

    def announce(self, finding: Finding) -> None:
        """Print a finding above the bars, before long work."""
        print_note(finding)

    def expect(self, *stages: str) -> None:
        """Show stages that are still to come."""
        for stage in stages:
            if self._bar is not None and stage not in self._tasks:
                self._tasks[stage] = self._bar.add_task(stage, total=1.0, start=False)

    def count(self, number: int, noun: str, *stages: str) -> None:
        """Set the number of items of some stages, which lines off a terminal show."""
        self._items |= dict.fromkeys(stages, (number, noun))

    def compilation(self, begins: bool) -> None:
        """Count and show the time from the first compilation that begins to the last that ends."""
        super().compilation(begins)
        if self._compiling != int(begins) or self._bar is None:  # nested in another
            return
        if begins:
            note = f"{COMPILATION} (first use only, then cached)"
            self._tasks[COMPILATION] = self._bar.add_task(note, total=None)
        elif COMPILATION in self._tasks:
            self._bar.remove_task(self._tasks.pop(COMPILATION))

    @contextmanager
    def _shown(self, bar: rich_progress.Progress | None) -> Iterator[None]:
        """Show the stages while the block runs; then log the time of compilation if it was long."""
        self._bar, self._tasks = bar, {}
        try:
            yield
        finally:
            self._bar = None
        since = self.seconds().get(COMPILATION, 0.0) - self._logged
        if since > MIN_LOGGED_COMPILATION:
            self._logged += since
            print_message(f"{COMPILATION} took {since:.0f} s; cached for the next run")


@contextmanager
def stage_display(
    clock: StageClock | None = None, *, remaining: bool = False, lines: bool = False
) -> Iterator[StageClock]:
    """Show progress bars on stderr while the block runs; print to stdout only outside the block.

    Args:
        clock: A clock of an earlier block, to continue.
        remaining: Also show the time left, for stages that take minutes.
        lines: Print a line per stage if stderr is not a terminal; else only ``--verbose`` does.
    """
    clock = StageClock() if clock is None else clock
    # Extraction must not open a second display.
    extraction = _report_extraction(clock) if ERR.is_terminal or lines else nullcontext()
    with _display(clock, remaining=remaining, lines=lines), extraction:
        yield clock


@contextmanager
def _display(clock: StageClock, *, remaining: bool, lines: bool) -> Iterator[StageClock]:
    """Show progress as ``stage_display``, but not that of extraction."""
    named, left = (
        rich_progress.TextColumn(text, markup=False) for text in ("{task.description}", "left")
    )
    columns = [named, _Bars(), rich_progress.TimeElapsedColumn()]
    columns += [left, rich_progress.TimeRemainingColumn()] if remaining else []
    drawn = rich_progress.Progress(*columns, console=ERR, transient=True)
    bar = drawn if ERR.is_terminal else None
    level = logging.INFO if lines and bar is None else logging.DEBUG
    clock._lines = _Lines(clock._items, level)  # noqa: SLF001  (ours)
    with clock._shown(bar), bar or nullcontext(), watched(clock.compilation):  # noqa: SLF001  (ours)
        yield clock


@contextmanager
def _report_extraction(progress: Progress) -> Iterator[None]:
    token = extraction_progress.set(progress)
    try:
        yield
    finally:
        extraction_progress.reset(token)


class _ExtractionDisplay:
    """A ``Progress`` that opens a display at the first call and closes it once a stage is done."""

    def __init__(self) -> None:
        self._display = ExitStack()
        self._clock: StageClock | None = None

    def __call__(self, stage: str, fraction: float) -> None:
        if self._clock is None and fraction >= 1:
            return
        if self._clock is None:
            self._clock = self._display.enter_context(
                _display(StageClock(), remaining=True, lines=True)
            )
        self._clock(stage, fraction)
        if fraction >= 1:
            self.close()

    def close(self) -> None:
        self._display.close()
        self._clock = None


@contextmanager
def show_extraction() -> Iterator[None]:
    """Show the extraction of photographs from videos and archives, whichever call causes it."""
    shown = _ExtractionDisplay()
    try:
        with _report_extraction(shown):
            yield
    finally:
        shown.close()


def with_options(message: str) -> str:
    """Replace arguments in a library's message (see ``errors``) by the command line's options.

    Example:
        >>> with_options("Pass a smaller `ratio`, `mls.k=8` or `overwrite=True`.")
        'Pass a smaller --ratio, --mls.k 8 or --overwrite.'
        >>> with_options("Pass `depth.align=False` or `masks='my masks'`.")
        "Pass --depth.no-align or --masks 'my masks'."
        >>> with_options("With `placing='none'` it only splits.")
        'With `placing = "none"` in a --config file it only splits.'
    """
    return ARGUMENT.sub(_option, message)


def _option(argument: re.Match[str]) -> str:
    group, dot, name = argument["name"].rpartition(".")
    value = argument["value"]
    if name in FILE_SETTINGS:
        if value is None:
            return name
        in_toml = json.dumps(ast.literal_eval(value))
        return f"`{name} = {in_toml}` in a --config file"
    name = OPTIONS.get(name, name).replace("_", "-")
    if value in {None, "True", "False"}:
        return f"--{group}{dot}{'no-' * (value == 'False')}{name}"
    try:
        text = str(ast.literal_eval(value))
    except (ValueError, SyntaxError):  # a placeholder, such as FILE
        text = value
    return f"--{group}{dot}{name} {quoted(text)}"


def print_pairs(title: str, rows: Sequence[tuple[str, str]]) -> None:
    """Print labels with their values, unwrapped so that they can be copied.

    Values get options for the library's arguments, as notes do.
    """
    _print_title(title)
    width = max((len(label) for label, _ in rows), default=0)
    for label, value in rows:
        OUT.print(f"  {label:<{width}}  {visible(with_options(value))}", soft_wrap=True)


def print_next(commands: Sequence[tuple[str, str]], title: str = "next") -> None:
    """Print the commands to run next, each with a label."""
    _SESSION.next += [{"label": label, "command": command} for label, command in commands]
    print_pairs(title, commands)


def add_findings(*findings: Finding) -> None:
    """Add findings that are printed otherwise to the object that ``--json`` prints."""
    _SESSION.findings |= dict.fromkeys(findings)


def print_note(*findings: Finding) -> None:
    """Print findings to stderr, each once, with options for the library's arguments."""
    for finding in dict.fromkeys(findings):
        add_findings(finding)
        text = visible(with_options(str(finding)))
        print_message(text, LEVELS[finding.severity], "note")


def print_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table; the first column is left-aligned, the others right-aligned."""
    table = Table(box=None, pad_edge=False)
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i == 0 else "right")
    for row in rows:
        table.add_row(*map(visible, row))
    _print_title(title)
    # In a file, no name needs to be cut off at an edge.
    wide = LiteralConsole(file=OUT.file, width=FILE_WIDTH, quiet=OUT.quiet)
    (OUT if OUT.is_terminal else wide).print(table)


def _print_title(title: str) -> None:
    OUT.print(f"\n{visible(title)}", style="bold", soft_wrap=True)
