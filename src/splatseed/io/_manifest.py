"""``splatseed.json``: the list of files by which an output knows its own.

Notation: ``files`` lists paths inside the output with forward slashes; a listed folder stands for
all that is in it. Promise: a manifest that is missing, damaged or of another kind says nothing and
raises nothing.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

__all__ = ["MANIFEST", "add_files", "unlisted_files"]

MANIFEST = "splatseed.json"
"""The file that marks a folder as written by splatseed: only such a folder is ever replaced."""

_PICTURES = tuple(  # made after the manifest
    f"preview{which}.png" for which in ("", "_methods", "_maps", "_cells", "_origins")
)
_FILE_MANAGERS = (".DS_Store", "Thumbs.db")  # made by looking at the folder


def add_files(folder: Path, names: Iterable[str]) -> None:
    """List more of an output's files or folders, so that ``--overwrite`` may replace them.

    Args:
        folder: An output with a manifest.
        names: Paths inside it.

    Raises:
        OSError: The manifest cannot be written.
    """
    manifest = _read(folder)
    manifest["files"] = sorted({*_files(manifest), *names})
    text = json.dumps(manifest, indent=2) + "\n"
    (folder / MANIFEST).write_text(text, encoding="utf-8")


def unlisted_files(folder: Path) -> list[str]:
    """Files in ``folder`` that its manifest does not list; none if the manifest has no list.

    Raises:
        OSError: The folder cannot be read.
    """
    manifest = _read(folder)
    if "files" not in manifest:
        return []
    ours = {*_files(manifest), MANIFEST, *_PICTURES}
    found = _files_outside(folder, ours)
    return sorted(name for name in found if name.rpartition("/")[2] not in _FILE_MANAGERS)


def _read(folder: Path) -> dict[str, Any]:
    try:
        content = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _files(manifest: dict[str, Any]) -> list[str]:
    files = manifest.get("files")
    return [name for name in files if isinstance(name, str)] if isinstance(files, list) else []


def _files_outside(folder: Path, ours: set[str], prefix: str = "") -> Iterator[str]:
    """Paths of the files, links and other non-folders that are neither in ``ours`` nor below it."""
    with os.scandir(folder / prefix) as entries:
        for entry in entries:
            name = prefix + entry.name
            if name in ours:
                continue
            if entry.is_dir(follow_symlinks=False):
                yield from _files_outside(folder, ours, name + "/")
            else:
                yield name
