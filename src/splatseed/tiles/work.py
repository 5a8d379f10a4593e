"""The folder that a cloud is cut up in: what is finished there, and for which command.

Notation: a *step* is a pass over the whole cloud or the work on one tile; what it gives lies in one
file or folder. Promise: a step writes under a partial name and is renamed when it is complete, so
that a kill at any moment loses only the step that was running; the folder is used again only by the
command that began it, with the same input, and by one process at a time.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.errors import OutputError
from splatseed.io.files import read_text
from splatseed.io.staging import remove
from splatseed.literal import visible

JOB = "job.json"
PARTIAL = ".partial"


def work_path(output: Path) -> Path:
    """The folder that an output is made in: beside it, so that it is on the same disk."""
    output = Path(output).absolute()
    return output.with_name(f"{output.name}.tiles")


class WorkFolder:
    """Files and finished steps by name.

    Args:
        path: The folder, which exists.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def file(self, name: str) -> Path:
        """Where a file of the folder is, or is to be."""
        return self.path / name

    def partial(self, name: str) -> Path:
        """Where a file or folder is written before it is complete; an earlier attempt is removed.

        Raises:
            OSError: It cannot be removed.
        """
        path = self.path / f"{name}{PARTIAL}"
        path.parent.mkdir(parents=True, exist_ok=True)
        remove(path)
        return path

    def complete(self, name: str) -> None:
        """Give a partial file or folder its name."""
        target = self.path / name
        remove(target)
        (self.path / f"{name}{PARTIAL}").rename(target)

    def finish(self, step: str, facts: Mapping[str, object]) -> None:
        """Note that a step is finished, and what it found."""
        self.partial(f"{step}.json").write_text(json.dumps(dict(facts)), "utf-8")
        self.complete(f"{step}.json")

    def facts(self, step: str) -> dict[str, Any] | None:
        """What a finished step found; None if it is not finished.

        Raises:
            OutputError: The note is damaged.
        """
        path = self.path / f"{step}.json"
        if not path.is_file():
            return None
        return _read(path)

    def save(self, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Save arrays as a finished folder, one file each."""
        folder = self.partial(name)
        folder.mkdir()
        for key, values in arrays.items():
            np.save(folder / f"{key}.npy", values, allow_pickle=False)
        self.complete(name)

    def load(self, name: str, key: str, *, mapped: bool = False) -> np.ndarray:
        """One of the arrays of a finished folder, read or memory-mapped."""
        path = self.path / name / f"{key}.npy"
        array: np.ndarray = np.load(path, mmap_mode="r" if mapped else None, allow_pickle=False)
        return array

    def keys(self, name: str) -> list[str]:
        """The names of the arrays of a finished folder."""
        return sorted(path.stem for path in (self.path / name).glob("*.npy"))

    def has(self, name: str) -> bool:
        """Whether a file or folder is finished."""
        return (self.path / name).exists()

    def discard(self, name: str) -> None:
        """Remove what is no longer needed."""
        remove(self.path / name)


@contextmanager
def open_work(path: Path, job: Mapping[str, object]) -> Iterator[tuple[WorkFolder, bool]]:
    """The folder for a job, held by this process while the block runs.

    Args:
        path: Where it is, or is to be.
        job: All that determines the result, as JSON has it.

    Yields:
        The folder, and whether it goes on with an earlier run's work.

    Raises:
        OutputError: It belongs to another job or to a process that is running, it is damaged, or it
            cannot be made.
    """
    resumed = path.exists()
    work = WorkFolder(path)
    try:
        if not resumed:
            path.mkdir(parents=True)
    except OSError as error:
        raise OutputError(
            f"a folder for tiles at {path}",
            found=f"{error.strerror or type(error).__name__}",
            fix="Choose an output in a folder that you may write to.",
        ) from None
    with _held(path):
        if work.facts("job") is not None:
            _check_same(path, work.facts("job") or {}, job)
        elif any(path.iterdir()) and not (path / f"{JOB}{PARTIAL}").exists():
            raise OutputError(
                f"no folder, or one with tiles, at {path}",
                found=f"a folder without {JOB}",
                fix="Remove it, or choose another output.",
            )
        else:
            resumed = False
            work.finish("job", job)
        yield work, resumed


def _check_same(path: Path, there: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    asked = json.loads(json.dumps(asked))
    for name in sorted({*there, *asked}):
        if there.get(name) != asked.get(name):
            raise OutputError(
                f"the same {name} as when {path} was begun ({_brief(there.get(name))})",
                found=_brief(asked.get(name)),
                fix="Repeat the earlier command to go on, or remove that folder to begin anew.",
            )


def _brief(value: object) -> str:
    text = visible(json.dumps(value))
    return text if len(text) <= 120 else f"{text[:117]}..."


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(read_text(path))
    except (OSError, ValueError):
        content = None
    if not isinstance(content, dict):
        raise OutputError(
            f"{path} as an earlier run wrote it",
            found="a damaged file",
            fix=f"Remove the folder {path.parent} to begin anew.",
        )
    return content


@contextmanager
def _held(path: Path) -> Iterator[None]:
    """Hold the folder; on systems without such locks, nothing is held."""
    try:
        import fcntl  # noqa: PLC0415  (not on Windows)
    except ImportError:
        yield
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise OutputError(
            f"{path} to be free",
            found="another process at work there",
            fix="Wait for it to end, or stop it.",
        ) from None
    try:
        yield
    finally:
        os.close(descriptor)


def free_space(path: Path) -> int:
    """Free bytes on the disk of a folder that exists, or of its nearest parent that does."""
    while not path.exists():
        path = path.parent
    return shutil.disk_usage(path).free
