"""Tables as CSV, Markdown, LaTeX and HTML; ``data/tables.toml`` has their titles and notes.

CSV has unrounded numbers, with separate columns for standard errors and marks; names are escaped.
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
    """A number in a table, NaN where it is unknown, shown with so many decimals.

    ``se`` is its standard error, NaN where one sample leaves it unknown, None where it has none;
    ``signed`` is for gains; ``text`` and a ``mark``, which the notes explain, stand behind it.
    """

    value: float
    digits: int = 2
    se: float | None = None
    signed: bool = False
    text: str = ""
    mark: str = ""
    bold: bool = False

    def __str__(self) -> str:
        """Without the mark."""
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
    """A table; ``name`` is its file's without suffix, and the first cell of a row names the row."""

    name: str
    title: str
    header: Sequence[str]
    rows: Sequence[Row]
    notes: Sequence[str] = ()

    def shown(
        self, escape: Callable[[str], str] = str, bold: str = "{}", mark: str = " {}"
    ) -> pd.DataFrame:
        """The cells as text, with templates for bold ones and for marks."""

        def text_of(cell: Cell) -> str:
            text = escape(str(cell))
            if isinstance(cell, str) or not text:
                return text
            text = bold.format(text) if cell.bold else text
            return text + mark.format(escape(cell.mark)) if cell.mark else text

        rows = [tuple(map(text_of, row)) for row in self.rows]
        return pd.DataFrame(rows, columns=list(map(escape, self.header)))


def make_table(
    kind: str, header: Sequence[str], rows: Sequence[Row], *, strategy: str = "", **words: object
) -> Table:
    """A table named by its kind and the strategy, if any, with its kind's title and notes.

    In these, ``words`` take the place of braces; what they leave empty is left out.
    """
    texts = [_texts()[kind]["title"], *_texts()[kind]["notes"]]
    title, *notes = (text.format(strategy=strategy, **words) for text in texts)
    name = f"{kind}_{strategy}" if strategy else kind
    return Table(name, title, header, rows, list(filter(None, notes)))


@cache
def _texts() -> dict[str, Any]:
    return tomllib.loads((files("splatseed.bench") / "data" / "tables.toml").read_text("utf-8"))


def _rounded(value: float, digits: int, *, signed: bool = False) -> str:
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    text = f"{value:{'+' if signed else ''},.{digits}f}"
    # A gain of -0.001 is shown as 0.00, not as a loss that the digits do not show.
    return text.lstrip("+-") if not text.strip("+-0.,") else text


def to_csv(table: Table) -> str:
    """The table as CSV: numbers in full, and columns for standard errors and marks, if any."""
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
    """The table in Markdown, with its title above and its notes below."""
    shown = table.shown(_escape_markdown, "**{}**")
    right = ["---", *(["---:"] * (len(table.header) - 1))]
    lines = [list(shown.columns), right, *shown.itertuples(index=False, name=None)]
    notes = "".join(f"\n{_escape_markdown(note)}\n" for note in table.notes)
    rows = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"**{_escape_markdown(table.title)}**\n\n{rows}\n{notes}"


def _escape_markdown(text: str) -> str:
    return re.sub(r"([\\|*_`<>])", r"\\\1", text)


def to_tex(table: Table) -> str:
    """The table as a LaTeX ``table``, for the package booktabs."""
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
    """The table in HTML, without title and notes; the first column heads the rows."""
    mark = ' <span class="mark">{}</span>'
    shown = table.shown(html.escape, "<strong>{}</strong>", mark)
    first = shown.columns[0]  # by place, as a scene may have its name
    shown = shown.iloc[:, 1:].set_axis(shown.iloc[:, 0]).rename_axis(index=None, columns=first)
    return str(shown.to_html(escape=False, border=0, justify="right"))


def write_table(table: Table, folder: Path) -> None:
    """Write ``NAME.csv``, ``NAME.md``, ``NAME.tex`` and ``NAME.html``."""
    kinds = {"csv": to_csv, "md": to_markdown, "tex": to_tex, "html": to_html}
    for suffix, text in kinds.items():
        with atomic_file(folder / f"{table.name}.{suffix}") as partial:
            partial.write_text(text(table), "utf-8", errors="backslashreplace")
