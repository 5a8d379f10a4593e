"""Tables as CSV, Markdown, LaTeX and HTML; ``data/tables.toml`` has their titles and notes.

CSV has unrounded numbers, and columns for standard errors and marks.
"""

from __future__ import annotations

import html
import math
import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd

from splatseed.io.staging import atomic_file

_TEX = str.maketrans({
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"$\sim$", "^": r"\^{}", "±": r"$\pm$", "†": r"$\dagger$",
    "∞": r"$\infty$", "≤": r"$\le$", "<": r"$<$", ">": r"$>$",
})  # fmt: skip


@dataclass(frozen=True)
class Number:
    """A number in a table; NaN, if unknown, is blank.

    ``digits`` are its decimals. ``se`` is its standard error, NaN for a single sample, None if it
    has none. ``signed`` shows a plus sign. ``text`` and ``mark``, which notes explain, follow it.
    """

    value: float
    digits: int = 2
    se: float | None = None
    signed: bool = False
    text: str = ""
    mark: str = ""
    bold: bool = False

    def __str__(self) -> str:
        """Format the number without its mark."""
        if math.isnan(self.value):
            return ""
        shown = _rounded(self.value, self.digits, signed=self.signed)
        if self.se is not None and not math.isnan(self.se):
            shown += f" ± {_rounded(self.se, self.digits)}"
        return f"{shown} {self.text}".strip()


Cell: TypeAlias = Number | str
Row: TypeAlias = tuple[Cell, ...]


@dataclass(frozen=True)
class Table:
    """A table; ``name`` is the file name without suffix; the first cell of a row is its heading."""

    name: str
    title: str
    header: Sequence[str]
    rows: Sequence[Row]
    notes: Sequence[str] = ()

    def shown(
        self, escape: Callable[[str], str] = str, bold: str = "{}", mark: str = " {}"
    ) -> pd.DataFrame:
        """Format the cells, with templates for bold cells and for marks."""

        def text_of(cell: Cell) -> str:
            text = escape(str(cell))
            if isinstance(cell, str) or not text:
                return text
            text = bold.format(text) if cell.bold else text
            return text + mark.format(escape(cell.mark)) if cell.mark else text

        rows = [tuple(map(text_of, row)) for row in self.rows]
        return pd.DataFrame(rows, columns=list(map(escape, self.header)))


def make_table(
    kind: str, header: Sequence[str], rows: Sequence[Row], *, strategy: str = "", **values: object
) -> Table:
    """Make a table with the title and notes of its kind.

    ``values`` fill the braces in title and notes; empty notes are dropped.
    """
    texts = [_texts()[kind]["title"], *_texts()[kind]["notes"]]
    title, *notes = (text.format(strategy=strategy, **values) for text in texts)
    name = f"{kind}_{strategy}" if strategy else kind
    return Table(name, title, header, rows, list(filter(None, notes)))


@cache
def _texts() -> dict[str, Any]:
    return tomllib.loads((files("splatseed.bench") / "data" / "tables.toml").read_text("utf-8"))


def _rounded(value: float, digits: int, *, signed: bool = False) -> str:
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    text = f"{value:{'+' if signed else ''},.{digits}f}"
    # A gain of -0.001 is shown as 0.00, not as -0.00.
    return text.lstrip("+-") if not text.strip("+-0.,") else text


def to_csv(table: Table) -> str:
    """Convert to CSV, with columns for standard errors and marks if there are any."""
    columns: list[tuple[str, list[str]]] = []
    for i, name in enumerate(table.header):
        cells = [row[i] for row in table.rows]
        numbers = [each if isinstance(each, Number) else Number(math.nan) for each in cells]
        columns.append((name, [c if isinstance(c, str) else _full(c.value) for c in cells]))
        if any(each.se is not None for each in numbers):
            columns.append((f"{name} se", [_full(each.se) for each in numbers]))
        marks = [" ".join(filter(None, ("best" * n.bold, n.mark, n.text))) for n in numbers]
        if any(marks):
            columns.append((f"{name} mark", marks))
    frame = pd.DataFrame(dict(enumerate(values for _, values in columns)))
    return str(frame.to_csv(index=False, header=[name for name, _ in columns], lineterminator="\n"))


def _full(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else f"{value:.8g}"


def to_markdown(table: Table) -> str:
    """Convert to Markdown, with the title above and the notes below."""
    shown = table.shown(_escape_markdown, "**{}**")
    right = ["---", *(["---:"] * (len(table.header) - 1))]
    lines = [list(shown.columns), right, *shown.itertuples(index=False, name=None)]
    notes = "".join(f"\n{_escape_markdown(note)}\n" for note in table.notes)
    rows = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"**{_escape_markdown(table.title)}**\n\n{rows}\n{notes}"


def _escape_markdown(text: str) -> str:
    return re.sub(r"([\\|*_`<>])", r"\\\1", text)


def to_tex(table: Table) -> str:
    """Convert to a LaTeX ``table`` that needs the package booktabs."""
    text = table.shown(_escape_tex, r"\textbf{{{}}}").to_latex(
        index=False,
        escape=False,
        caption=_escape_tex(table.title),
        label=f"tab:{table.name}",
        column_format="l" + "r" * (len(table.header) - 1),
    )
    notes = "".join(rf"\par\footnotesize {_escape_tex(note)}" + "\n" for note in table.notes)
    return str(text).replace(r"\end{table}", rf"{notes}\end{{table}}")


def _escape_tex(text: str) -> str:
    return text.translate(_TEX)


def to_html(table: Table) -> str:
    """Convert to an HTML table without title and notes."""
    mark = ' <span class="mark">{}</span>'
    shown = table.shown(html.escape, "<strong>{}</strong>", mark)
    first = shown.columns[0]  # by position, as a scene may have the same name
    shown = shown.iloc[:, 1:].set_axis(shown.iloc[:, 0]).rename_axis(index=None, columns=first)
    return str(shown.to_html(escape=False, border=0, justify="right"))


def write_table(table: Table, folder: Path) -> None:
    """Write ``NAME.csv``, ``NAME.md``, ``NAME.tex`` and ``NAME.html``."""
    kinds = {"csv": to_csv, "md": to_markdown, "tex": to_tex, "html": to_html}
    for suffix, text in kinds.items():
        with atomic_file(folder / f"{table.name}.{suffix}") as partial:
            partial.write_text(text(table), "utf-8", errors="backslashreplace")
