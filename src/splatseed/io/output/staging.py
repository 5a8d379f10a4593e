"""Output that appears whole or not at all.

Notation: the *target* is what the user named; the *partial* is a hidden sibling
``.NAME.partial-XXXX`` that is written first and renamed to the target at the end; a *leftover* is
the partial of a process that was killed, which the next one for the same target removes. Promise:
whatever interrupts writing (an error, a full disk, Ctrl-C), the partial is removed and an older
output stays unharmed; an ``OSError`` becomes an ``OutputError`` that says what to do, and what
cannot be removed is named.
"""

from __future__ import annotations

import errno
import secrets
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from splatseed.errors import OutputError
from splatseed.io.output.leftovers import held, remove_leftovers, remove_tree
from splatseed.io.output.manifest import seal, why_kept

_NO_SPACE = {errno.ENOSPC, errno.EDQUOT}
_NO_PERMISSION = {errno.EACCES, errno.EPERM, errno.EROFS}


@contextmanager
def output_folder(
    path: Path, *, kind: str, overwrite: bool = False, protect: Sequence[Path] = ()
) -> Iterator[Path]:
    """A folder to write into that appears at ``path`` when the block ends without an error.

    Missing parents are made. An empty folder at ``path`` is used; a full
    one is replaced only with ``overwrite``, and only if its ``splatseed.json`` says that the same
    kind wrote it and lists everything in it. The new folder's own manifest is written at the end.

    Args:
        path: Where the output should be.
        kind: What writes it: the verb of the command line, if any.
        overwrite: Whether an earlier output of this kind may be replaced.
        protect: Files and folders that are read: the output may not be, lie inside or contain any
            of them.

    Yields:
        The partial folder, empty.

    Raises:
        OutputError: ``path`` is taken or protected, or writing failed.
    """
    check_apart(path, protect)
    target = _resolved(path)
    _check_replaceable(target, kind, overwrite=overwrite)
    remove_leftovers(target)
    partial = _partial_name(target)
    with _oserror_as_output_error(target), _parents(target.parent), held(partial) as hold:
        try:
            partial.mkdir()
            hold()
            yield partial
            seal(partial, kind)
            _put_in_place(partial, target, kind)
        except BaseException as error:
            _remove_after(error, partial)
            raise
    remove_leftovers(target)  # what seemed to be in use before is settled now


def check_output(
    path: Path, *, kind: str, overwrite: bool = False, protect: Sequence[Path] = ()
) -> None:
    """Refuse what ``output_folder`` would refuse, before any work is done; arguments as there.

    A folder that a user names is also refused if too many of its parents are missing.

    Raises:
        OutputError: ``path`` is taken or protected, or too many of its parents are missing.
    """
    check_apart(path, protect)
    target = _resolved(path)
    check_parents(target)
    _check_replaceable(target, kind, overwrite=overwrite)


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """A file to write to; it appears at ``path`` when the block ends without an error.

    Its name keeps the suffix, by which image writers choose the format. Missing parents are made,
    and an existing file is replaced.

    Args:
        path: Where the file should be.

    Yields:
        The name of the partial file, which is empty.

    Raises:
        OutputError: ``path`` is a folder or a device, or writing failed.
    """
    target = _resolved(path)
    if target.exists() and not target.is_file():  # a device would be replaced by a file
        other = "a folder" if target.is_dir() else "a device or a pipe"
        raise OutputError(f"a file name at {target}", found=other, fix="Choose another name.")
    partial = _partial_name(target, target.suffix)
    remove_leftovers(target)
    with _oserror_as_output_error(target), _parents(target.parent), held(partial) as hold:
        try:
            partial.touch()
            hold()
            yield partial
            partial.replace(target)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise


def _resolved(path: Path) -> Path:
    try:
        return Path(path).resolve()
    except (OSError, RuntimeError):  # RuntimeError before Python 3.13
        raise OutputError(
            f"a name at {path}",
            found="a link that leads back to itself",
            fix="Remove the link, or choose another name.",
        ) from None


def _partial_name(target: Path, suffix: str = "") -> Path:
    return target.with_name(f".{target.name}.partial-{secrets.token_hex(4)}{suffix}")


def check_apart(path: Path, protect: Sequence[Path]) -> None:
    """Refuse an output that is one of ``protect``, lies inside one, or contains one.

    Raises:
        OutputError: It is one of them, lies inside one, or contains one.
    """
    target = _resolved(path)
    for source in (_resolved(kept) for kept in protect):
        if target == source or source in target.parents or target in source.parents:
            raise OutputError(
                "an output folder apart from the input",
                found=f"{target}, which {_relation(target, source)} {source}",
                fix="Choose a folder beside the input.",
            )
    here = Path.cwd()
    if target == here or target in here.parents:
        raise OutputError(
            "an output folder that can be renamed into place",
            found=f"{target}, which holds the working directory",
            fix="Name a new folder.",
        )


def _relation(target: Path, source: Path) -> str:
    if target == source:
        return "is the input"
    return "lies in the input" if source in target.parents else "holds the input"


def check_parents(path: Path) -> None:
    """Refuse a place that a user names in which nothing can be made.

    So is one whose parent's parent is missing: probably a slip.

    Raises:
        OutputError: It is one of these.
    """
    target = _resolved(path)
    with _oserror_as_output_error(target):
        # What is there, such as a run that goes on, may lie in a folder that is write-protected.
        if target.exists():
            return
        missing = [each for each in target.parents if not each.exists()]
        above = target.parents[len(missing)]
        known = above.is_dir()
    if not known or not _takes_folders(above):
        raise OutputError(
            f"a folder above {target.name} that can be written to",
            found=f"{above}, which {'is write-protected' if known else 'is not a folder'}",
            fix="Choose another place.",
        )
    if len(missing) > 1:
        raise OutputError(
            f"a folder for {target.name}, or at least the folder above it",
            found=f"no {missing[-1]}",
            fix="Check the path, or make the folder first.",
        )


def _takes_folders(above: Path) -> bool:
    """Whether a folder can be made in another: permissions do not tell, least of all to root."""
    try:
        Path(tempfile.mkdtemp(prefix=".splatseed-", dir=above)).rmdir()
    except OSError:
        return False
    return True


def _check_replaceable(target: Path, kind: str, *, overwrite: bool) -> None:
    with _oserror_as_output_error(target):
        if not target.exists() or (target.is_dir() and not any(target.iterdir())):
            return
    kept: tuple[str, str] | None
    if not target.is_dir():
        kept = "a file", "Choose another name."
    else:
        with _oserror_as_output_error(target):
            kept = why_kept(target, kind)
        if kept is None and not overwrite:
            replace = "Pass --overwrite (from Python, overwrite=True) to replace it"
            kept = "an earlier output", f"{replace}, or choose another name."
    if kept is not None:
        there, fix = kept
        raise OutputError(f"no folder, or an empty one, at {target}", found=there, fix=fix)


@contextmanager
def _parents(folder: Path) -> Iterator[None]:
    """Make ``folder`` and its parents; remove the new ones again on an error."""
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for each in missing:
            with suppress(OSError):
                each.rmdir()
        raise


def _put_in_place(partial: Path, target: Path, kind: str) -> None:
    """Rename ``partial`` to ``target``; an older output steps aside, and returns on failure."""
    if not target.exists():
        partial.rename(target)
        return
    old = target.with_name(f".{target.name}.old-{secrets.token_hex(4)}")
    try:
        target.rename(old)
        partial.rename(target)
    except BaseException:
        if not target.exists():
            _restore(old, target)
        raise
    finally:
        if old.exists() and target.exists():
            _discard(old, target, kind)


def _restore(old: Path, target: Path) -> None:
    try:
        old.rename(target)
    except OSError as error:
        raise OutputError(
            f"the earlier output, set aside as {old}, to be put back",
            found=_reason(error),
            fix=f"Rename it to {target} yourself.",
        ) from error


def _discard(old: Path, target: Path, kind: str) -> None:
    """Remove the earlier output, now that the new one is in place."""
    try:
        kept = why_kept(old, kind) if any(old.iterdir()) else None
        if kept is not None:  # somebody wrote there while we worked
            raise OutputError(
                f"nothing but the earlier output in {target}",
                found=kept[0],
                fix=f"The new output is complete there; the earlier one was kept as {old}.",
            )
        remove_tree(old)
    except OSError as error:
        raise OutputError(
            f"the earlier output, set aside as {old}, to be removed",
            found=_reason(error),
            fix=f"Remove it yourself; the new output is complete at {target}.",
        ) from error


def _remove_after(failure: BaseException, partial: Path) -> None:
    """Remove what an interrupted block has written, or say where it is."""
    try:
        remove_tree(partial)
    except FileNotFoundError:
        return
    except OSError as error:
        cause = f"{type(failure).__name__}: {failure}".rstrip(": ")
        raise OutputError(
            f"{partial}, left by a failure ({cause}), to be removed",
            found=_reason(error),
            fix="Remove it yourself before you try again.",
        ) from failure


def _reason(error: OSError) -> str:
    where = f" at {error.filename}" if error.filename else ""
    return f"{error.strerror or type(error).__name__}{where}"


@contextmanager
def _oserror_as_output_error(target: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno in _NO_SPACE:
            fix = "Free some space, or choose another disk."
        elif error.errno in _NO_PERMISSION:
            fix = "Choose a folder that you may write to."
        else:
            fix = "Check the disk and try again."
        raise OutputError(
            f"{target} to be written",
            found=_reason(error),
            fix=f"{fix} Nothing half-written was left behind.",
        ) from error
