"""Check that an output file may be written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from splatseed.errors import OutputError
from splatseed.io.staging import check_parents, check_separate


def check_free(
    path: Path,
    *,
    overwrite: bool = False,
    protect: Sequence[Path] = (),
    fix: str = "Pass --overwrite to replace it, or choose another name.",
) -> None:
    """Refuse an output file that may not be written, before any work is done.

    Args:
        path: The file.
        overwrite: Whether it may exist.
        protect: Inputs, which it must neither equal nor lie in.
        fix: What the user can do if the file exists.
    """
    check_separate(path, protect)
    check_parents(path)
    if path.exists() and not path.is_file():
        found = "a folder" if path.is_dir() else "no regular file"
        raise OutputError(f"a file name at {path}", found=found, fix="Choose another name.")
    if path.exists() and not overwrite:
        raise OutputError(f"no file at {path}", found="one", fix=fix)
