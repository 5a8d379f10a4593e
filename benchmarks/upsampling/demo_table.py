"""Whether the table at the top of ``docs/methods.md`` is what ``splatseed demo`` measures.

    make demo-points
    python -m benchmarks.upsampling.demo_table demo/geometry.csv

It prints the rows that differ, as they should be, and exits with status 1 if there are any.
"""

from __future__ import annotations

import csv
import re
import sys
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "methods.md"
COLUMNS = ("median_h", "coverage_h")
"""Of ``geometry.csv``; the page has them in its last two columns."""
METHOD = re.compile(r"\w+")


def stale_rows(page: str, measured: dict[str, tuple[float, float]]) -> list[str]:
    """The page's rows whose numbers are not the measured ones rounded, with these in their place.

    Args:
        page: The page's text.
        measured: Median error and coverage by method, in spacings.
    """
    stale = []
    for name, row in _rows(page).items():
        cells = [cell.strip() for cell in row.strip("| ").split("|")]
        shown = [_as_shown(now, then) for now, then in zip(measured[name], cells[-2:], strict=True)]
        if shown != cells[-2:]:
            stale.append("| " + " | ".join([*cells[:-2], *shown]) + " |")
    return stale


def _rows(page: str) -> dict[str, str]:
    """The rows of the page's first table by method."""
    lines = page[page.index("| error (median) |") :].splitlines()[2:]
    table = lines[: next(i for i, line in enumerate(lines) if not line.startswith("|"))]
    return {METHOD.search(line)[0]: line for line in table}  # type: ignore[index]  # each names one


def _as_shown(now: float, then: str) -> str:
    """A number with as many decimals as the page has."""
    return f"{now:.{len(then.partition('.')[2])}f}"


def main() -> None:
    """Compare, and say what is stale."""
    with Path(sys.argv[1]).open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    measured = {row["method"]: tuple(float(row[column]) for column in COLUMNS) for row in rows}
    stale = stale_rows(PAGE.read_text("utf-8"), measured)  # type: ignore[arg-type]  # two columns
    print("\n".join(stale) or f"{PAGE.name} is up to date.")
    sys.exit(bool(stale))


if __name__ == "__main__":
    main()
