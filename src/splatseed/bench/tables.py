"""Tables as CSV, Markdown, LaTeX and HTML.

Notation: a *cell* is words, or a number with its standard error, a mark and whether it is bold.
Promise: CSV has unrounded numbers, with separate columns for standard errors and marks; the others
have rounded ones, with their marks explained below; names are escaped.
"""

from __future__ import annotations

import html
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import pandas as pd

from splatseed.io.staging import atomic_file

_TEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"$\sim$", "^": r"\^{}", "±": r"$\pm$", "†": r"$\dagger$",
    "∞": r"$\infty$", "≤": r"$\le$", "<": r"$<$", ">": r"$>$",
}  # fmt: skip


@dataclass(frozen=True)
class Number:
    """A number in a table.

    Args:
        value: The number; NaN where it is unknown.
        digits: Decimals shown.
        se: Its standard error, NaN where one sample leaves it unknown; None where it has none.
        signed: Whether a gain is shown with its plus.
        text: Words behind it.
        mark: A sign behind it, explained in the table's notes.
        bold: Whether it is the best of its row.
    """

    value: float
    digits: int = 2
    se: float | None = None
    signed: bool = False
    text: str = ""
    mark: str = ""
    bold: bool = False


Cell: TypeAlias = Number | str


@dataclass(frozen=True)
class Table:
    """A table.

    Args:
        name: Its file name without suffix.
        title: What it shows.
        header: One name per column.
        rows: The cells, as many per row; the first names the row.
        notes: Explanations, a sentence or more each.
    """

    name: str
    title: str
    header: tuple[str, ...]
    rows: Sequence[tuple[Cell, ...]]
    notes: tuple[str, ...] = ()


def cell_text(cell: Cell) -> str:
    """A cell's number and words, as they are shown; without its mark."""
    if isinstance(cell, str):
        return cell
    if math.isnan(cell.value):
        return ""
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


def _shown(
    table: Table, escape: Callable[[str], str], bold: str, mark: str = " {}"
) -> pd.DataFrame:
    """The cells as strings, with templates for bold ones and for marks."""

    def shown(cell: Cell) -> str:
        text = escape(cell_text(cell))
        if isinstance(cell, str) or not text:
            return text
        text = bold.format(text) if cell.bold else text
        return text + mark.format(escape(cell.mark)) if cell.mark else text

    rows = [tuple(map(shown, row)) for row in table.rows]
    return pd.DataFrame(rows, columns=list(map(escape, table.header)))


def to_csv(table: Table) -> str:
    """The table as CSV, numbers in full."""
    cells = zip(*table.rows, strict=True) if table.rows else ((),) * len(table.header)
    parts = [part for name, column in zip(table.header, cells, strict=True)
             for part in _csv_columns(name, column)]  # fmt: skip
    frame = pd.DataFrame(dict(enumerate(values for _, values in parts)))
    return str(frame.to_csv(index=False, header=[name for name, _ in parts], lineterminator="\n"))


def _csv_columns(name: str, cells: Sequence[Cell]) -> Iterator[tuple[str, list[str]]]:
    """A column, and where any cell has them one for standard errors and one for marks."""
    yield name, [each if isinstance(each, str) else _full(each.value) for each in cells]
    numbers = [each if isinstance(each, Number) else Number(math.nan) for each in cells]
    if any(each.se is not None for each in numbers):
        yield f"{name} se", [_full(each.se) for each in numbers]
    marks = [
        " ".join(filter(None, ["best" if each.bold else "", each.mark, each.text]))
        for each in numbers
    ]
    if any(marks):
        yield f"{name} mark", marks


def _full(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else f"{value:.8g}"


def to_markdown(table: Table) -> str:
    """The table in Markdown, with its title above and its notes below."""
    shown = _shown(table, _escape_markdown, "**{}**")
    right = ["---", *(["---:"] * (len(table.header) - 1))]
    lines = [table.header, right, *shown.itertuples(index=False, name=None)]
    notes = "".join(f"\n{_escape_markdown(note)}\n" for note in table.notes)
    rows = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"**{_escape_markdown(table.title)}**\n\n{rows}\n{notes}"


def _escape_markdown(text: str) -> str:
    return re.sub(r"([\\|*_`<>])", r"\\\1", text)


def to_tex(table: Table) -> str:
    """The table as a LaTeX ``table``, for the package booktabs."""
    text = _shown(table, _escape_tex, r"\textbf{{{}}}").to_latex(
        index=False,
        escape=False,
        caption=_escape_tex(table.title),
        label=f"tab:{table.name}",
        column_format="l" + "r" * (len(table.header) - 1),
    )
    notes = "".join(rf"\par\footnotesize {_escape_tex(note)}" + "\n" for note in table.notes)
    return str(text).replace(r"\end{table}", rf"{notes}\end{{table}}")


def _escape_tex(text: str) -> str:
    return "".join(_TEX.get(letter, letter) for letter in text)


def to_html(table: Table) -> str:
    """The table in HTML, without title and notes; the first column heads the rows."""
    mark = ' <span class="mark">{}</span>'
    shown = _shown(table, html.escape, "<strong>{}</strong>", mark)
    first = shown.columns[0]
    shown.index = pd.Index(shown.pop(first))
    shown.index.name = None
    shown.columns.name = first
    return str(shown.to_html(escape=False, border=0, justify="right"))


def write_table(table: Table, folder: Path) -> tuple[Path, ...]:
    """Write ``NAME.csv``, ``NAME.md``, ``NAME.tex`` and ``NAME.html``.

    Args:
        table: The table.
        folder: Where to.

    Raises:
        OutputError: A file cannot be written.
    """
    kinds = {"csv": to_csv, "md": to_markdown, "tex": to_tex, "html": to_html}
    paths = []
    for suffix, text in kinds.items():
        paths.append(folder / f"{table.name}.{suffix}")
        with atomic_file(paths[-1]) as partial:
            partial.write_text(text(table), "utf-8", errors="backslashreplace")
    return tuple(paths)
