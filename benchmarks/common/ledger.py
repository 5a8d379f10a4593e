"""Long runs, one JSON line per result: an interrupted command continues where it stopped."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Lock
from typing import Any

__all__ = ["read_ledger", "report", "run_missing", "write_line"]

WRITING = Lock()


def read_ledger(path: Path) -> dict[tuple[Any, ...], dict[str, Any]]:
    """Return the results so far by key; of repeated runs, the last."""
    if not path.is_file():
        return {}
    return {tuple(key): result for key, result in map(json.loads, path.open(encoding="utf-8"))}


def write_line(ledger: Path, key: Sequence[Any], result: Mapping[str, Any]) -> None:
    """Append a result, from any thread."""
    with WRITING, ledger.open("a", encoding="utf-8") as lines:
        lines.write(json.dumps([key, result]) + "\n")


def run_missing(wanted: Iterable[Any], run: Callable[[Any], None], ledger: Path, jobs: int) -> None:
    """Call ``run`` for the wanted keys that the ledger lacks, ``jobs`` at a time."""
    done = read_ledger(ledger)
    missing = [key for key in wanted if key not in done]
    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(run, missing))


def report(text: str) -> None:
    """Print progress to stderr."""
    print(text, file=sys.stderr, flush=True)
