"""What is kept of a run: numbers, the curve, a few pictures; and for a failed one, the reason.

Notation: ``BENCH/runs/KEY`` holds what is kept of the run KEY, ``BENCH/work/KEY`` its working
files. Promise: the kept folder appears whole or not at all, and is small: models are kept only on
request.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from splatseed.bench.planning.records import RunResult, RunSpec
from splatseed.io.files import read_text
from splatseed.io.staging import output_folder
from splatseed.train.folder import RunFolder

RESULT = "result.json"
ERROR = "error.txt"
PICTURES = 3
"""Test views that are kept as pictures."""


def kept_folder(bench: Path, key: str) -> Path:
    """Where what is kept of a run lies."""
    return bench / "runs" / key


def work_folder(bench: Path, key: str) -> Path:
    """Where a run works."""
    return bench / "work" / key


def kept_files(work: Path, *, models: bool) -> dict[str, Path]:
    """The files of a finished run that are kept, by their names there.

    The pictures are of views spread evenly over the test views, so the same ones for every arm.

    Args:
        work: The folder of the run, as training leaves it.
        models: Whether the trained Gaussians are kept too.
    """
    run = RunFolder(work)
    files = [run.metrics, run.config, run.curve_csv, *([run.gaussians] if models else [])]
    pictures = sorted(run.renders.iterdir())
    count = min(PICTURES, len(pictures))
    shown = [pictures[(2 * i + 1) * len(pictures) // (2 * count)] for i in range(count)]
    return {path.relative_to(work).as_posix(): path for path in (*files, *shown)}


def write_kept(target: Path, files: Mapping[str, Path | bytes]) -> None:
    """Make the folder of what is kept, replacing that of an earlier attempt.

    Args:
        target: The folder.
        files: Files, which are moved, or contents, by their names in it.

    Raises:
        OutputError: It cannot be written.
    """
    with output_folder(target, kind="bench", overwrite=True) as partial:
        for name, content in files.items():
            path = partial / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(content, bytes):
                path.write_bytes(content)
            else:
                shutil.move(content, path)


def result_bytes(spec: RunSpec, result: RunResult) -> bytes:
    """A run and its result as JSON, so that what is kept speaks for itself."""
    parts = {"spec": json.loads(spec.to_json()), "result": json.loads(result.to_json())}
    return (json.dumps({"key": spec.key, **parts}, indent=2) + "\n").encode()


def read_result(target: Path, key: str) -> RunResult | None:
    """The result that is kept of a run; None where there is none."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        content = json.loads(read_text(target / RESULT))
        if content["key"] == key:
            return RunResult.from_json(json.dumps(content["result"]))
    return None
