"""Tables as CSV, Markdown and LaTeX.

Notation: a *cell* is words, or a number with its standard error, a mark and whether it is bold.
Promise: CSV has unrounded numbers, with separate columns for standard errors and marks; Markdown
and LaTeX have rounded ones, with their marks explained below; names are escaped.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from splatseed.io.staging import atomic_file

LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"$\sim$", "^": r"\^{}", "±": r"$\pm$", "†": r"$\dagger$",
    "∞": r"$\infty$", "≤": r"$\le$", "<": r"$<$", ">": r"$>$",
}  # fmt: skip


@dataclass(frozen=True)
class Cell:
    """The content of one table cell.

    Args:
        value: The number; None where there are only words.
        se: Its standard error, NaN where one sample leaves it unknown; None where it has none.
        digits: Decimals shown.
        signed: Whether a gain is shown with its plus.
        text: The words, instead of a number or behind it.
        mark: A sign behind it, explained in the table's notes.
        bold: Whether it is the best of its row.
        soft: Whether it is greyed out, as others' numbers are.
    """

    value: float | None = None
    se: float | None = None
    digits: int = 2
    signed: bool = False
    text: str = ""
    mark: str = ""
    bold: bool = False
    soft: bool = False


@dataclass(frozen=True)
class Table:
    """A table.

    Args:
        name: Its file name without suffix.
        title: What it shows.
        header: One name per column.
        rows: The cells, as many per row.
        notes: Explanations, a sentence or more each.
    """

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...] = field(default=())


def words(text: str, *, bold: bool = False) -> Cell:
    """A cell of words."""
    return Cell(text=text, bold=bold)


def number(value: float | None, digits: int = 2, *, signed: bool = False) -> Cell:
    """A cell of a number without standard error; empty for None and for NaN."""
    if value is None or math.isnan(value):
        return Cell()
    return Cell(value, digits=digits, signed=signed)


def cell_text(cell: Cell) -> str:
    """A cell's number and words, as they are shown; without its mark."""
    if cell.value is None:
        return cell.text
    shown = _rounded(cell.value, cell.digits, signed=cell.signed)
    if cell.se is not None and not math.isnan(cell.se):
        shown += f" ± {_rounded(cell.se, cell.digits)}"
    return f"{shown} {cell.text}".strip()


def _rounded(value: float, digits: int, *, signed: bool = False) -> str:
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    text = f"{value:{'+' if signed else ''},.{digits}f}"
    # A gain of -0.001 is shown as 0.00, not as a loss that the digits do not show.
    return text.lstrip("+-") if not text.strip("+-0.,") else text


def to_csv(table: Table) -> str:
    """The table as CSV, numbers in full."""
    columns = [[row[i] for row in table.rows] for i in range(len(table.header))]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    parts = [_csv_columns(*each) for each in zip(table.header, columns, strict=True)]
    writer.writerow([name for part in parts for name, _ in part])
    writer.writerows(
        zip(*(values for part in parts for _, values in part), strict=True) if parts else ()
    )
    return out.getvalue()


def _csv_columns(name: str, cells: Sequence[Cell]) -> list[tuple[str, list[str]]]:
    """A column, and where any cell has them one for standard errors and one for marks."""
    columns = [
        (name, [cell.text if c is None else _full(c) for cell in cells for c in [cell.value]])
    ]
    if any(cell.se is not None for cell in cells):
        columns.append((f"{name} se", [_full(cell.se) for cell in cells]))
    if any(cell.value is not None and (cell.mark or cell.bold or cell.text) for cell in cells):
        columns.append((f"{name} mark", [_csv_mark(cell) for cell in cells]))
    return columns


def _csv_mark(cell: Cell) -> str:
    if cell.value is None:
        return ""
    return " ".join(filter(None, ["best" if cell.bold else "", cell.mark, cell.text]))


def _full(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else f"{value:.8g}"


def to_markdown(table: Table) -> str:
    """The table in Markdown, with its title above and its notes below."""
    right = ["---", *(["---:"] * (len(table.header) - 1))]
    lines = [_markdown_row(table.header), _markdown_row(right)]
    lines += [_markdown_row([_markdown_cell(cell) for cell in row]) for row in table.rows]
    notes = "".join(f"\n{_escape_markdown(note)}\n" for note in table.notes)
    return f"**{_escape_markdown(table.title)}**\n\n" + "\n".join(lines) + "\n" + notes


def _markdown_row(texts: Sequence[str]) -> str:
    return f"| {' | '.join(texts)} |"


def _markdown_cell(cell: Cell) -> str:
    text = _escape_markdown(cell_text(cell))
    shown = f"**{text}**" if cell.bold and text else text
    return f"{shown} {cell.mark}".strip()


def _escape_markdown(text: str) -> str:
    return re.sub(r"([\\|*_`<>])", r"\\\1", text)


def to_tex(table: Table) -> str:
    """The table as a LaTeX ``table`` that needs no package."""
    columns = "l" + "r" * (len(table.header) - 1)
    rows = [" & ".join(_tex_cell(cell) for cell in row) + r" \\" for row in table.rows]
    head = " & ".join(_escape_tex(name) for name in table.header) + r" \\ \hline"
    notes = [rf"\par\footnotesize {_escape_tex(note)}" for note in table.notes]
    lines = [
        r"\begin{table}",
        rf"\caption{{{_escape_tex(table.title)}}}",
        rf"\label{{tab:{table.name}}}",
        rf"\begin{{tabular}}{{{columns}}} \hline",
        head,
        *rows,
        r"\hline \end{tabular}",
        *notes,
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def _tex_cell(cell: Cell) -> str:
    text = _escape_tex(cell_text(cell))
    shown = rf"\textbf{{{text}}}" if cell.bold and text else text
    return f"{shown} {_escape_tex(cell.mark)}".strip()


def _escape_tex(text: str) -> str:
    return "".join(LATEX.get(letter, letter) for letter in text)


def write_table(table: Table, folder: Path) -> tuple[Path, ...]:
    """Write ``NAME.csv``, ``NAME.md`` and ``NAME.tex``.

    Args:
        table: The table.
        folder: Where to.

    Raises:
        OutputError: A file cannot be written.
    """
    paths = []
    for suffix, text in (("csv", to_csv), ("md", to_markdown), ("tex", to_tex)):
        paths.append(folder / f"{table.name}.{suffix}")
        with atomic_file(paths[-1]) as partial:
            partial.write_text(text(table), "utf-8", errors="backslashreplace")
    return tuple(paths)
