"""Output that is there whole or not at all.

Notation: the *target* is what the user named, the *partial* a hidden sibling ``.NAME.partial-XXXX``
that is written first and renamed to the target at the end. Promise: whatever interrupts the writing
(an error, a full disk, Ctrl-C), the partial is removed and an older output is still there unharmed;
an ``OSError`` becomes an ``OutputError`` that says what to do.
"""

from __future__ import annotations

import errno
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from splatseed.errors import OutputError

__all__ = ["MANIFEST", "atomic_file", "check_output", "output_folder"]

MANIFEST = "splatseed.json"
"""The file that marks a folder as written by splatseed: only such a folder is ever replaced."""

_NO_SPACE = {errno.ENOSPC, errno.EDQUOT}
_NO_PERMISSION = {errno.EACCES, errno.EPERM, errno.EROFS}


@contextmanager
def output_folder(
    path: Path, *, overwrite: bool = False, protect: Sequence[Path] = ()
) -> Iterator[Path]:
    """A folder to write into that appears at ``path`` when the block ends without an error.

    Missing parents are made. An empty folder at ``path`` is used up; a full one is replaced only
    with ``overwrite`` and only if it holds ``splatseed.json``, so the block should write one.

    Args:
        path: Where the output is to be.
        overwrite: Whether an earlier output of splatseed may be replaced.
        protect: Files and folders that are read: the output may be neither one of them, nor inside
            one, nor around one.

    Yields:
        The partial folder, empty.

    Raises:
        OutputError: ``path`` is taken or protected, or writing failed.
    """
    check_output(path, overwrite=overwrite, protect=protect)
    target = Path(path).resolve()
    partial = _partial_name(target)
    with _oserror_as_output_error(target), _parents(target.parent):
        try:
            partial.mkdir()
            yield partial
            _put_in_place(partial, target)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise


def check_output(path: Path, *, overwrite: bool = False, protect: Sequence[Path] = ()) -> None:
    """Refuse what ``output_folder`` would refuse, before any work is done.

    Raises:
        OutputError: ``path`` is taken or protected.
    """
    target = Path(path).resolve()
    _check_apart(target, protect)
    _check_replaceable(target, overwrite=overwrite)


@contextmanager
def atomic_file(path: Path, *, overwrite: bool = True) -> Iterator[Path]:
    """A file name to write to; the file appears at ``path`` when the block ends without an error.

    The name keeps the suffix, by which image writers choose the format. Missing parents are made.

    Args:
        path: Where the file is to be.
        overwrite: Whether a file there may be replaced.

    Yields:
        The name of the partial file, which does not exist yet.

    Raises:
        OutputError: ``path`` is a folder or is taken, or writing failed.
    """
    target = Path(path).resolve()
    if target.is_dir() or (target.exists() and not overwrite):
        raise OutputError(
            f"a file name that is free at {target}",
            found="a folder" if target.is_dir() else "a file",
            fix="Choose another name, or pass --overwrite to replace a file.",
        )
    partial = _partial_name(target, target.suffix)
    with _oserror_as_output_error(target), _parents(target.parent):
        try:
            yield partial
            partial.replace(target)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise


def _partial_name(target: Path, suffix: str = "") -> Path:
    return target.with_name(f".{target.name}.partial-{secrets.token_hex(4)}{suffix}")


def _check_apart(target: Path, protect: Sequence[Path]) -> None:
    for source in (Path(kept).resolve() for kept in protect):
        if target == source or source in target.parents or target in source.parents:
            raise OutputError(
                "an output folder apart from the input",
                found=f"{target}, which is, holds or lies in the input {source}",
                fix="Choose a folder beside the input.",
            )
    here = Path.cwd()
    if target == here or target in here.parents:
        raise OutputError(
            "an output folder that can be put in place whole",
            found=f"{target}, which holds the working directory",
            fix="Name a new folder.",
        )


def _check_replaceable(target: Path, *, overwrite: bool) -> None:
    with _oserror_as_output_error(target):
        if not target.exists() or (target.is_dir() and not any(target.iterdir())):
            return
    if not target.is_dir():
        found, fix = "a file", "Choose another name."
    elif not (target / MANIFEST).is_file():
        found = f"files that splatseed did not write (no {MANIFEST})"
        fix = "Choose another folder, or empty this one yourself."
    elif not overwrite:
        found, fix = "an earlier output", "Pass --overwrite to replace it, or choose another name."
    else:
        return
    raise OutputError(f"no folder, or an empty one, at {target}", found=found, fix=fix)


@contextmanager
def _parents(folder: Path) -> Iterator[None]:
    """Make ``folder`` and its parents; take those made away again on an error."""
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for each in missing:
            with suppress(OSError):
                each.rmdir()
        raise


def _put_in_place(partial: Path, target: Path) -> None:
    """Rename ``partial`` to ``target``; what was there steps aside and comes back on failure."""
    if not target.exists():
        partial.rename(target)
        return
    old = target.with_name(f".{target.name}.old-{secrets.token_hex(4)}")
    target.rename(old)
    try:
        partial.rename(target)
    except BaseException:
        old.rename(target)
        raise
    shutil.rmtree(old, ignore_errors=True)


@contextmanager
def _oserror_as_output_error(target: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        where = f" at {error.filename}" if error.filename else ""
        if error.errno in _NO_SPACE:
            fix = "Free some space, or choose another disk."
        elif error.errno in _NO_PERMISSION:
            fix = "Choose a folder that you may write to."
        else:
            fix = "Check the disk and try again."
        raise OutputError(
            f"{target} to be written",
            found=f"{error.strerror or type(error).__name__}{where}",
            fix=f"{fix} Nothing was left behind.",
        ) from error
