"""``splatseed bench report`` and ``splatseed bench compare``: the results of a benchmark."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from splatseed.bench.analysis.compare import (
    Comparison,
    change_table,
    compare,
    only_table,
    settings_table,
)
from splatseed.bench.analysis.tables import Table, cell_text, write_table
from splatseed.bench.planning.records import RunRow
from splatseed.bench.report.write import Report, write_report
from splatseed.bench.running.ledger import LEDGER, Ledger
from splatseed.commands.options import parse_options
from splatseed.console import (
    OUT,
    print_commands,
    print_note,
    print_pairs,
    print_table,
    stage_display,
)
from splatseed.errors import SceneNotFoundError
from splatseed.io.staging import check_output, output_folder
from splatseed.literal import counted, quoted


@dataclass(frozen=True)
class ReportOptions:
    """Write report.html, tables and figures of a benchmark, as far as it has run."""

    bench: Annotated[Path, tyro.conf.Positional]
    """The folder of splatseed bench."""
    from_scenes: bool = True
    """Open the scenes to describe them and draw each method's points; else only cached results."""


@dataclass(frozen=True)
class CompareOptions:
    """Show what changed from one benchmark to another, and whether it is more than noise."""

    a: Annotated[Path, tyro.conf.Positional]
    """The folder of the first benchmark."""
    b: Annotated[Path, tyro.conf.Positional]
    """The folder of the second."""
    output: Annotated[
        Path | None,
        tyro.conf.arg(aliases=["-o"], constructor=Path, metavar="DIR", help_behavior_hint=""),
    ] = None
    """A folder to write the tables to, as CSV, Markdown and LaTeX."""
    overwrite: bool = False
    """Replace what an earlier comparison wrote there."""


def run_report(arguments: list[str]) -> None:
    """Run the verb with these arguments.

    Args:
        arguments: The words after ``splatseed bench report``.
    """
    options = parse_options(ReportOptions, "bench report", arguments)
    with stage_display() as clock:
        clock("read", 0.0)
        report = write_report(options.bench, from_scenes=options.from_scenes, progress=clock)
    _print_report(options.bench, report)


def _print_report(bench: Path, report: Report) -> None:
    for sentence in report.summary:
        OUT.print(sentence)
    for note in report.notes:
        print_note(note)
    print_pairs(
        str(bench),
        [
            ("report", str(report.path)),
            ("tables", f"{report.tables}, each as .csv, .md and .tex, in {bench / 'tables'}"),
            ("figures", f"{report.figures} in {bench / 'figures'}"),
        ],
    )
    print_commands("next", [("", f"open {quoted(report.path)} in a browser")])


def run_compare(arguments: list[str]) -> None:
    """Run the verb with these arguments.

    Args:
        arguments: The words after ``splatseed bench compare``.
    """
    options = parse_options(CompareOptions, "bench compare", arguments)
    written: Any = {"kind": "bench compare", "protect": (options.a, options.b)}
    if options.output is not None:
        check_output(options.output, overwrite=options.overwrite, **written)
    comparison = compare(_rows(options.a), _rows(options.b))
    if comparison is None:
        raise SceneNotFoundError(
            f"finished runs in both {options.a} and {options.b}",
            found="none in one of them",
            fix="Let splatseed bench finish some.",
        )
    tables = [settings_table(comparison), change_table(comparison), only_table(comparison)]
    for table in tables:
        if table.rows:
            _print_table(table)
    for note in _notes(comparison, tables):
        print_note(note)
    if options.output is not None:
        with output_folder(options.output, overwrite=options.overwrite, **written) as partial:
            for table in tables:
                write_table(table, partial)
        print_pairs("written", [("tables", str(options.output))])


def _rows(bench: Path) -> list[RunRow]:
    return Ledger.open(bench / LEDGER, read_only=True).rows()


def _print_table(table: Table) -> None:
    rows = [[f"{cell_text(cell)} {cell.mark}".strip() for cell in row] for row in table.rows]
    print_table(table.title, table.header, rows)
    for note in table.notes:
        OUT.print(note, style="dim")


def _notes(comparison: Comparison, tables: Iterable[Table]) -> Iterable[str]:
    """Further notes on the two."""
    settings, changes, _ = tables
    if not settings.rows:
        yield "All settings are the same."
    if not changes.rows:
        yield "They have no scene and method in common."
    if comparison.same_runs:
        yield f"{counted(comparison.same_runs, 'run')} in both, with the same key and score."
    for scene in comparison.content:
        yield f"{scene} is not the same in both: its points, cameras or photographs differ."
