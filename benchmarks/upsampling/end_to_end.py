"""The command line from start to finish: read a capture, upsample, write the scene.

Promise: the time is of the whole process, less that of an interpreter that does nothing
(``python -c pass``): imports, compiled code's loading, reading and writing all count.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from splatseed.errors import MissingDependencyError

__all__ = ["cli_seconds", "interpreter_seconds"]


def cli_seconds(scene: Path, method: str, ratio: float, repeats: int) -> list[float]:
    """Seconds of each of ``repeats`` runs of ``splatseed upsample``, after one to warm up.

    Raises:
        MissingDependencyError: The ``splatseed`` command is not installed or does not run.
    """
    program = Path(sys.executable).with_name("splatseed")
    command = [program, "upsample", scene, "--method", method, "--ratio", f"{ratio:g}", "-o"]
    with tempfile.TemporaryDirectory() as folder:
        try:
            return [_seconds([*command, Path(folder) / str(i)]) for i in range(repeats + 1)][1:]
        except (OSError, subprocess.CalledProcessError) as error:
            raise MissingDependencyError(
                "a working splatseed command beside the interpreter",
                found=getattr(error, "stderr", None) or str(error),
                fix="Install the package: pip install -e .",
            ) from error


def interpreter_seconds(repeats: int) -> list[float]:
    """Seconds of each of ``repeats`` interpreters that do nothing."""
    return [_seconds([sys.executable, "-c", "pass"]) for _ in range(repeats)]


def _seconds(command: Sequence[str | Path]) -> float:
    started = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, text=True)
    return time.perf_counter() - started
