"""Atomic output: files and folders appear complete or not at all, and replace only own outputs.

The *target* is the user's path. The *partial* is a hidden sibling ``.NAME.partial-XXXX``, written
first and renamed at the end, or removed on failure (after a kill, by the next process that writes
the target). A folder's *manifest*, ``splatseed.json``, records its *kind* (``command``) and lists
its files; an entry that is a folder with its own manifest stands for the files listed there.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import re
import secrets
import shutil
import tempfile
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from splatseed.errors import OutputError, SplatseedError
from splatseed.io.files import read_text

try:
    import fcntl
except ImportError:  # Windows has no file locks, so leftovers stay
    fcntl = None  # type: ignore[assignment]

MANIFEST = "splatseed.json"
"""The file that marks a folder as written by splatseed."""

_MIN_LEFTOVER_AGE = 5.0
"""Age in seconds from which an unlocked partial is a leftover; new ones are locked at once."""
_IGNORED = re.compile(
    r"preview(_methods|_maps|_cells|_origins)?\.png"  # written by splatseed after the manifest
    r"|(.*/)?(\.DS_Store|Thumbs\.db|\.[^/]+\.lock|\.[^/]+\.partial-[0-9a-f]{8}(\.\w+|/.*)?"
    r"|images_\d+_png/.*\.png)",  # gsplat's copies of the photographs
    re.IGNORECASE,
)
_FULL = dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "Free some space, or choose another disk.")
_FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)
_FIXES = _FULL | dict.fromkeys(_FORBIDDEN, "Choose a folder that you may write to.")
_FIXES[errno.ENAMETOOLONG] = "Choose a shorter name."
_LOG = logging.getLogger(__name__)


@contextmanager
def output_folder(
    path: Path, *, kind: str, overwrite: bool = False, protect: Sequence[Path] = ()
) -> Iterator[Path]:
    """Yield an empty folder that appears at ``path`` when the block succeeds.

    Args:
        path: The output; missing parents are made.
        kind: What writes it, for the manifest.
        overwrite: Replace an earlier output of this kind.
        protect: Paths that the output may not equal, contain or be inside of.

    Raises:
        OutputError: ``path`` is taken or protected, or writing failed.
    """
    check_separate(path, protect)
    target = _resolved(path)
    _check_replaceable(target, kind, overwrite=overwrite)
    with staged(target, folder=True) as partial:
        yield partial
        files = sorted({*_files(partial), MANIFEST})
        write_json(partial / MANIFEST, {**read_manifest(partial), "command": kind, "files": files})


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield an empty partial file that appears at ``path`` when the block succeeds.

    It has the same suffix. Missing parents are made; an existing file is replaced.

    Raises:
        OutputError: ``path`` is a folder or a device, or writing failed.
    """
    target = _resolved(path)
    if os.path.lexists(target) and not target.is_file():  # do not replace a device by a file
        other = "a folder" if target.is_dir() else "a device, a pipe or a link to itself"
        raise OutputError(f"a file name at {target}", found=other, fix="Choose another name.")
    with staged(target, folder=False) as partial:
        yield partial


@contextmanager
def reserved(path: Path) -> Iterator[None]:
    """Hold an output while the block runs, against other processes and threads that hold it, too.

    The lock is the system's, on a hidden ``.NAME.lock`` beside the output: it ends with the process
    however that ends, and a file that a kill leaves is no lock. Where there are no locks, or no
    file can be made, nothing is held.

    Raises:
        OutputError: Another one holds it.
    """
    target = _resolved(path)
    lock = FileLock(target.with_name(f".{target.name}.lock"))
    made = not target.parent.exists()
    try:
        with suppress(OSError, NotImplementedError):
            target.parent.mkdir(exist_ok=True)
            try:
                lock.acquire(timeout=0)
            except Timeout:
                raise OutputError(
                    f"no other process that writes {target}",
                    found="one",
                    fix="Wait until it ends, stop it, or choose another name.",
                ) from None
        yield
    finally:
        with suppress(OSError):
            if lock.is_locked:  # removed before it is released, so that nobody else's is removed
                Path(lock.lock_file).unlink()  # Windows does so on release
        lock.release()
        with suppress(OSError):
            if made:
                target.parent.rmdir()  # if nothing was written


def write_json(path: Path, content: Mapping[str, object]) -> None:
    """Write indented JSON atomically; NumPy scalars become numbers, paths text."""
    text = json.dumps(
        content, indent=2, default=lambda v: v.item() if isinstance(v, np.generic) else str(v)
    )
    with atomic_file(path) as partial:
        partial.write_text(text + "\n", encoding="utf-8")


@contextmanager
def staged(target: Path, *, folder: bool) -> Iterator[Path]:
    """Yield an empty partial file or folder that replaces ``target`` at the end, whatever it is.

    Missing parents are made. On any failure the target is unchanged; failed writes raise
    ``OutputError``.
    """
    _remove_leftovers(target)
    token = secrets.token_hex(4)
    old = target.with_name(f".{target.name}.old-{token}")
    partial = target.with_name(f".{target.name}.partial-{token}{'' if folder else target.suffix}")
    missing = [each for each in target.parents if not each.exists()]
    with translate_write_errors(target):
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            partial.mkdir() if folder else partial.touch()
            with locked(partial):
                yield partial
                if folder and target.exists():
                    target.rename(old)
                partial.replace(target)
        except BaseException:
            if old.exists() and not target.exists():
                old.rename(target)
            with suppress(OSError):  # the next process retries
                remove(partial)
                for each in missing:
                    each.rmdir()
            raise
        finally:
            if (old / MANIFEST).is_file() and (names := unlisted_files(old)):  # added meanwhile
                _LOG.warning("%s is complete; its earlier files are in %s: %s.", target, old, names)
            elif old.exists():
                remove(old)


def add_files(folder: Path, names: Iterable[str]) -> None:
    """Add files to an output's manifest, so that ``overwrite=True`` may replace them.

    Names are relative with forward slashes and need not exist yet. A folder without a manifest
    stands for its current files.
    """
    listed = _listed(folder)
    for name in names:
        plain = (folder / name).is_dir() and not (folder / name / MANIFEST).is_file()
        listed.update(_files(folder, prefix=f"{name}/") if plain else [name])
    write_json(folder / MANIFEST, {**read_manifest(folder), "files": sorted(listed)})


def read_manifest(folder: Path | None) -> dict[str, Any]:
    """Read a folder's manifest; empty if there is none, it is damaged, or no folder is given."""
    if folder is None:
        return {}
    try:
        content = json.loads(read_text(folder / MANIFEST))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def unlisted_files(folder: Path) -> list[str]:
    """List the files of a folder that its manifest does not list."""

    def is_copy(name: str) -> bool:  # nerfstudio's smaller photographs
        return bool(re.match("images_[248]/", name)) and (folder / f"images{name[8:]}").is_file()

    names = _files(folder, {*_listed(folder), MANIFEST})
    return sorted(name for name in names if not (_IGNORED.fullmatch(name) or is_copy(name)))


def check_output(
    path: Path, *, kind: str, overwrite: bool = False, protect: Sequence[Path] = ()
) -> None:
    """Raise as ``output_folder`` and ``check_parents``, before any work is done."""
    check_separate(path, protect)
    check_parents(path)
    _check_replaceable(_resolved(path), kind, overwrite=overwrite)


def check_separate(path: Path, protect: Sequence[Path]) -> None:
    """Raise ``OutputError`` if the output equals, contains or is inside of a protected path."""
    target, here = _resolved(path), Path.cwd()
    for source in (*map(_resolved, protect), here):
        contains = target == source or target in source.parents
        if contains or (source in target.parents and source != here):
            raise OutputError(
                "an output apart from the input and the working directory",
                found=f"{target}, which {'contains or is' if contains else 'is in'} {source}",
                fix="Choose a path outside of it.",
            )


def check_parents(path: Path) -> None:
    """Raise ``OutputError`` if the output cannot be made, or its parent's parent is missing."""
    target = _resolved(path)
    if os.path.lexists(target):  # may be a resumed run in a write-protected folder
        return
    missing = [each for each in target.parents if not each.exists()]
    above = target.parents[len(missing)]
    try:  # permission bits are unreliable, above all for root
        Path(tempfile.mkdtemp(prefix=".splatseed-", dir=above)).rmdir()
        found = f"no {missing[-1]}" if len(missing) > 1 else ""
    except OSError:
        found = f"{above}, which is {'write-protected' if above.is_dir() else 'not a folder'}"
    if found:
        expected = f"a folder for {target.name} that exists, or that can be made"
        raise OutputError(expected, found=found, fix="Check the path, or make the folder first.")


@contextmanager
def translate_write_errors(target: Path) -> Iterator[None]:
    """Turn an ``OSError`` into ``OutputError`` with advice."""
    try:
        yield
    except SplatseedError:
        raise
    except OSError as error:
        fix = _FIXES.get(error.errno or 0, "Check the disk and try again.")
        where = f" at {error.filename}" if error.filename else ""
        found = f"{error.strerror or type(error).__name__}{where}"
        raise OutputError(f"{target} to be written", found=found, fix=fix) from error


def remove(path: Path) -> None:
    """Remove a file or folder of splatseed's, if it exists, including read-only subfolders."""
    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)
        return
    path.chmod(0o700)
    for parent, names, _ in os.walk(path):
        for child in (Path(parent, name) for name in names):
            if not child.is_symlink():  # the target of a link is the user's
                child.chmod(0o700)
    for child in path.iterdir():  # the manifest last, so that removal can be resumed
        if child.is_dir() and not child.is_symlink():
            shutil.rmtree(child)
        elif child.name != MANIFEST:
            child.unlink()
    shutil.rmtree(path)


def _resolved(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _check_replaceable(target: Path, kind: str, *, overwrite: bool) -> None:
    found, fix = "", "Choose another name, or move the existing files."
    with translate_write_errors(target):
        if not os.path.lexists(target) or (target.is_dir() and not any(target.iterdir())):
            return
        manifest, ours = read_manifest(target), "files that splatseed did not write"
        if not target.is_dir():
            found = "a file" if target.exists() else "a link that leads back to itself"
        elif manifest.get("command", kind) != kind:
            found = f"what splatseed {manifest['command']} wrote, not {kind}"
        elif "command" not in manifest or not isinstance(manifest.get("files"), list):
            found = f"{ours} (no {MANIFEST} that lists them)"
        elif names := unlisted_files(target):
            more = f" and {len(names) - 3:,} more" if len(names) > 3 else ""
            found = f"an earlier output with {ours}: {', '.join(names[:3])}{more}"
        elif not overwrite:
            found = "an earlier output"
            fix = "Pass `overwrite=True` to replace it, or choose another name."
    if found:
        raise OutputError(f"no folder, or an empty one, at {target}", found=found, fix=fix)


def _listed(folder: Path) -> set[str]:
    files = read_manifest(folder).get("files")
    return {name for name in files if isinstance(name, str)} if isinstance(files, list) else set()


def _files(folder: Path, ours: Collection[str] = (), prefix: str = "") -> Iterator[str]:
    """Yield the files and links in a folder that are not in ``ours``."""
    with os.scandir(folder / prefix) as entries:
        for entry in entries:
            name = prefix + entry.name
            if not entry.is_dir(follow_symlinks=False):
                if name not in ours:
                    yield name
            elif name in ours:  # an output with its own manifest
                yield from (f"{name}/{each}" for each in unlisted_files(folder / name))
            else:
                yield from _files(folder, ours, name + "/")


def _remove_leftovers(target: Path) -> None:
    """Remove and log partials of processes killed while writing ``target``."""
    name = re.compile(
        re.escape(f".{target.name}.partial-") + f"[0-9a-f]{{8}}({re.escape(target.suffix)})?"
    )
    for path in list(target.parent.iterdir()) if fcntl and target.parent.is_dir() else []:
        with suppress(OSError):  # another process writes or removed it
            if name.fullmatch(path.name) and time.time() - path.stat().st_mtime > _MIN_LEFTOVER_AGE:
                with locked(path):
                    remove(path)
                _LOG.warning("Removed %s, left by a killed process.", path)


@contextmanager
def locked(path: Path, *, wait: bool = False) -> Iterator[None]:
    """Lock a file or folder; if another process holds the lock, wait or raise ``OSError``."""
    with ExitStack() as stack:
        if fcntl is not None:
            descriptor = os.open(path, os.O_RDONLY)
            stack.callback(os.close, descriptor)
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield
