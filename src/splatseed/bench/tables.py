"""Tables as CSV and HTML; ``data/tables.toml`` has their titles and notes.

CSV has unrounded numbers, and columns for standard errors and marks.
"""

from __future__ import annotations

import html
import math
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd

from splatseed.io.staging import atomic_file


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


def to_html(table: Table) -> str:
    """Convert to an HTML table without title and notes."""
    mark = ' <span class="mark">{}</span>'
    shown = table.shown(html.escape, "<strong>{}</strong>", mark)
    first = shown.columns[0]  # by position, as a scene may have the same name
    shown = shown.iloc[:, 1:].set_axis(shown.iloc[:, 0]).rename_axis(index=None, columns=first)
    return str(shown.to_html(escape=False, border=0, justify="right"))


def write_table(table: Table, folder: Path) -> None:
    """Write ``NAME.csv`` and ``NAME.html``."""
    for suffix, text in (("csv", to_csv), ("html", to_html)):
        with atomic_file(folder / f"{table.name}.{suffix}") as partial:
            partial.write_text(text(table), "utf-8", errors="backslashreplace")
