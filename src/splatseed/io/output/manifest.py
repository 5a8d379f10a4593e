"""``splatseed.json``: which folder may be replaced, and which of its files are ours.

Notation: ``command`` says what wrote a folder, its *kind*; ``files`` lists the paths inside it with
forward slashes. An entry may name a folder that is itself an output: then that folder's manifest
lists our files there. Promise: a folder may be replaced only by its own kind, and only if it holds
nothing unlisted; a manifest that is missing, damaged or without a list allows nothing.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from splatseed.io.files import read_text

MANIFEST = "splatseed.json"
"""The file that marks a folder as written by splatseed: only such a folder is ever replaced."""

_PICTURES = tuple(  # written after the manifest
    f"preview{which}.png" for which in ("", "_methods", "_maps", "_cells", "_origins")
)
_SMALLER = re.compile(r"images_[248]/(.+)")
"""nerfstudio's smaller copies of the photographs, under their names: it can recreate them."""
_NOBODYS = re.compile(
    r"(.*/)?(\.DS_Store|Thumbs\.db"  # made by file browsers
    r"|\.[^/]+\.partial-[0-9a-f]{8}(\.\w+|/.*)?"  # left by a killed process of ours
    r"|images_\d+_png/.*\.png)",  # gsplat's copies of the photographs: it can recreate them
    re.IGNORECASE,
)


def seal(folder: Path, kind: str) -> None:
    """Mark a finished output with its kind and a list of everything in it now.

    Args:
        folder: The output; existing entries of its manifest are kept.
        kind: What wrote it.

    Raises:
        OSError: The folder cannot be read or written.
    """
    names = {*_files_outside(folder, set()), MANIFEST}
    _write(folder, {**_read(folder), "command": kind, "files": sorted(names)})


def add_files(folder: Path, names: Iterable[str]) -> None:
    """List more of an output's files, so that ``--overwrite`` may replace them.

    Args:
        folder: An output with a manifest.
        names: Paths inside it, including files yet to be written. A folder stands for all files in
            it now; if it is itself an output, or does not exist yet, for its own list.

    Raises:
        OSError: The manifest cannot be written.
    """
    manifest = _read(folder)
    listed = {*_files(manifest), *(each for name in names for each in _expanded(folder, name))}
    _write(folder, {**manifest, "files": sorted(listed)})


def kind_of(folder: Path) -> str | None:
    """What wrote a folder; None if unknown."""
    kind = _read(folder).get("command")
    return kind if isinstance(kind, str) else None


def why_kept(folder: Path, kind: str) -> tuple[str, str] | None:
    """Why a non-empty folder may not be replaced, and what the user can do; None if it may.

    Args:
        folder: The folder.
        kind: What would write to it.

    Raises:
        OSError: The folder cannot be read.
    """
    if not (folder / MANIFEST).is_file():
        kept = f"files that splatseed did not write (no {MANIFEST})"
        return kept, "Choose another folder, or empty this one yourself."
    manifest = _read(folder)
    if manifest.get("command", kind) != kind:
        kept = f"what splatseed {manifest['command']} wrote, not {kind}"
        return kept, "Choose another folder, or remove this one yourself."
    if "command" not in manifest or not isinstance(manifest.get("files"), list):
        kept = f"a folder whose {MANIFEST} does not say what splatseed wrote there"
        return kept, "Choose another folder, or empty this one yourself."
    if names := unlisted_files(folder):
        more = f" and {len(names) - 3:,} more" if len(names) > 3 else ""
        some = f"{', '.join(names[:3])}{more}"
        kept = f"an earlier output with files that splatseed did not write: {some}"
        return kept, "Move them elsewhere, or choose another name."
    return None


def unlisted_files(folder: Path) -> list[str]:
    """Files in ``folder`` that its manifest does not list.

    Raises:
        OSError: The folder cannot be read.
    """
    ours = {*_files(_read(folder)), MANIFEST, *_PICTURES}
    unlisted = _files_outside(folder, ours)
    return sorted(
        name for name in unlisted if not (_NOBODYS.fullmatch(name) or _is_smaller(folder, name))
    )


def _is_smaller(folder: Path, name: str) -> bool:
    copy = _SMALLER.fullmatch(name)
    return copy is not None and (folder / "images" / copy[1]).is_file()


def _read(folder: Path) -> dict[str, Any]:
    try:
        content = json.loads(read_text(folder / MANIFEST))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _write(folder: Path, manifest: dict[str, Any]) -> None:
    text = json.dumps(manifest, indent=2) + "\n"
    (folder / MANIFEST).write_text(text, encoding="utf-8")


def _files(manifest: dict[str, Any]) -> list[str]:
    files = manifest.get("files")
    return [name for name in files if isinstance(name, str)] if isinstance(files, list) else []


def _expanded(folder: Path, name: str) -> Iterator[str]:
    path = folder / name
    if path.is_dir() and not path.is_symlink() and not (path / MANIFEST).is_file():
        yield from _files_outside(folder, set(), f"{name}/")
    else:
        yield name


def _files_outside(folder: Path, ours: set[str], prefix: str = "") -> Iterator[str]:
    """Paths of the files, links and other non-folders that are not in ``ours``."""
    with os.scandir(folder / prefix) as entries:
        for entry in entries:
            name = prefix + entry.name
            if not entry.is_dir(follow_symlinks=False):
                if name not in ours:
                    yield name
            elif name in ours:  # itself an output
                yield from (f"{name}/{each}" for each in unlisted_files(folder / name))
            else:
                yield from _files_outside(folder, ours, name + "/")
