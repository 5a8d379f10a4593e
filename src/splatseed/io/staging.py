"""Output that appears whole or not at all, and replaces only what splatseed wrote.

The *target* is what the user named; the *partial* is a hidden sibling ``.NAME.partial-XXXX`` that
is written first and renamed at the end, or removed, after a kill by the next process that writes
the same target. A folder's *manifest*, ``splatseed.json``, says what wrote it, its *kind*
(``command``), and lists its files; an entry that names a folder with a manifest of its own stands
for that one's list.
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

from splatseed.errors import OutputError, SplatseedError
from splatseed.io.files import read_text

try:
    import fcntl
except ImportError:  # on Windows nothing can be locked, so leftovers stay
    fcntl = None  # type: ignore[assignment]

MANIFEST = "splatseed.json"
ABSENT = "absent"
"""The manifest's key for ``Scene.absent``."""
"""The file that marks a folder as written by splatseed."""

_MIN_LEFTOVER_AGE = 5.0
"""Seconds after which a partial that nobody holds is a leftover: it is held once it is made."""
_IGNORED = re.compile(
    r"preview(_methods|_maps|_cells|_origins)?\.png"  # ours, written after the manifest
    r"|(.*/)?(\.DS_Store|Thumbs\.db|\.[^/]+\.partial-[0-9a-f]{8}(\.\w+|/.*)?"
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
    """An empty folder to write into that appears at ``path`` when the block ends without an error.

    Missing parents are made. The manifest is completed at the end. ``overwrite`` allows to replace
    an earlier output of this kind; ``protect`` are files and folders that the output may not be,
    lie in or contain. An ``OutputError``: ``path`` is taken or protected, or writing failed.
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
    """The name of an empty partial file; it appears at ``path`` when the block ends without error.

    Its name keeps the suffix. Missing parents are made, and an existing file is replaced. An
    ``OutputError``: ``path`` is a folder or a device, or writing failed.
    """
    target = _resolved(path)
    if os.path.lexists(target) and not target.is_file():  # a device would be replaced by a file
        other = "a folder" if target.is_dir() else "a device, a pipe or a link to itself"
        raise OutputError(f"a file name at {target}", found=other, fix="Choose another name.")
    with staged(target, folder=False) as partial:
        yield partial


def write_json(path: Path, content: Mapping[str, object]) -> None:
    """Write readable JSON as an ``atomic_file``; NumPy scalars become numbers, paths text."""
    text = json.dumps(
        content, indent=2, default=lambda v: v.item() if isinstance(v, np.generic) else str(v)
    )
    with atomic_file(path) as partial:
        partial.write_text(text + "\n", encoding="utf-8")


@contextmanager
def staged(target: Path, *, folder: bool) -> Iterator[Path]:
    """An empty partial, a folder or a file, that replaces ``target``, whatever that is, at the end.

    Missing parents are made. If the block or the writing (an ``OutputError``) fails, all stays.
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
            with suppress(OSError):  # the next process tries again
                remove(partial)
                for each in missing:
                    each.rmdir()
            raise
        finally:
            if (old / MANIFEST).is_file() and (names := unlisted_files(old)):  # put there meanwhile
                _LOG.warning("%s is complete; %s has what it held: %s.", target, old, names)
            elif old.exists():
                remove(old)


def add_files(folder: Path, names: Iterable[str]) -> None:
    """List more of an output's files in its manifest, so that ``--overwrite`` may replace them.

    They are paths inside the folder, with forward slashes, which need not exist yet. A folder
    without a manifest stands for the files in it now.
    """
    listed = _listed(folder)
    for name in names:
        plain = (folder / name).is_dir() and not (folder / name / MANIFEST).is_file()
        listed.update(_files(folder, prefix=f"{name}/") if plain else [name])
    write_json(folder / MANIFEST, {**read_manifest(folder), "files": sorted(listed)})


def read_manifest(folder: Path) -> dict[str, Any]:
    """What a folder's manifest says; nothing where none can be read."""
    try:
        content = json.loads(read_text(folder / MANIFEST))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def unlisted_files(folder: Path) -> list[str]:
    """Files in ``folder`` that its manifest does not list."""

    def is_copy(name: str) -> bool:  # nerfstudio's smaller photographs
        return bool(re.match("images_[248]/", name)) and (folder / f"images{name[8:]}").is_file()

    names = _files(folder, {*_listed(folder), MANIFEST})
    return sorted(name for name in names if not (_IGNORED.fullmatch(name) or is_copy(name)))


def check_output(
    path: Path, *, kind: str, overwrite: bool = False, protect: Sequence[Path] = ()
) -> None:
    """Refuse what ``output_folder`` and ``check_parents`` refuse, before any work is done."""
    check_separate(path, protect)
    check_parents(path)
    _check_replaceable(_resolved(path), kind, overwrite=overwrite)


def check_separate(path: Path, protect: Sequence[Path]) -> None:
    """Raise an ``OutputError`` for an output that is, lies in or contains one of ``protect``."""
    target, here = _resolved(path), Path.cwd()
    for source in (*map(_resolved, protect), here):
        held = target == source or target in source.parents
        if held or (source in target.parents and source != here):
            raise OutputError(
                "an output apart from the input and the working directory",
                found=f"{target}, which {'holds or is' if held else 'lies in'} {source}",
                fix="Choose a place outside of it.",
            )


def check_parents(path: Path) -> None:
    """Raise an ``OutputError`` where nothing can be made, or a parent's parent is missing."""
    target = _resolved(path)
    if os.path.lexists(target):  # perhaps a run that goes on, in a write-protected folder
        return
    missing = [each for each in target.parents if not each.exists()]
    above = target.parents[len(missing)]
    try:  # permissions do not tell, least of all to root
        Path(tempfile.mkdtemp(prefix=".splatseed-", dir=above)).rmdir()
        found = f"no {missing[-1]}" if len(missing) > 1 else ""
    except OSError:
        found = f"{above}, which is {'write-protected' if above.is_dir() else 'not a folder'}"
    if found:
        expected = f"a folder for {target.name} that exists, or that can be made"
        raise OutputError(expected, found=found, fix="Check the path, or make the folder first.")


@contextmanager
def translate_write_errors(target: Path) -> Iterator[None]:
    """Let an ``OSError`` in the block become an ``OutputError`` that says what to do."""
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
    """Remove one of our own files or folders, if it is there, with read-only folders in it."""
    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)
        return
    path.chmod(0o700)
    for parent, names, _ in os.walk(path):
        for child in (Path(parent, name) for name in names):
            if not child.is_symlink():  # what a link names is the user's
                child.chmod(0o700)
    for child in path.iterdir():  # the manifest last: what a kill leaves can still be replaced
        if child.is_dir() and not child.is_symlink():
            shutil.rmtree(child)
        elif child.name != MANIFEST:
            child.unlink()
    shutil.rmtree(path)


def _resolved(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _check_replaceable(target: Path, kind: str, *, overwrite: bool) -> None:
    found, fix = "", "Choose another name, or move what is there elsewhere."
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
            fix = "Pass --overwrite (from Python, overwrite=True) to replace it, or choose another."
    if found:
        raise OutputError(f"no folder, or an empty one, at {target}", found=found, fix=fix)


def _listed(folder: Path) -> set[str]:
    """What its manifest lists."""
    files = read_manifest(folder).get("files")
    return {name for name in files if isinstance(name, str)} if isinstance(files, list) else set()


def _files(folder: Path, ours: Collection[str] = (), prefix: str = "") -> Iterator[str]:
    """Paths of the files and links in a folder that are not in ``ours``."""
    with os.scandir(folder / prefix) as entries:
        for entry in entries:
            name = prefix + entry.name
            if not entry.is_dir(follow_symlinks=False):
                if name not in ours:
                    yield name
            elif name in ours:  # itself an output
                yield from (f"{name}/{each}" for each in unlisted_files(folder / name))
            else:
                yield from _files(folder, ours, name + "/")


def _remove_leftovers(target: Path) -> None:
    """Remove, and log, the partials of processes that were killed while they wrote ``target``."""
    name = re.compile(
        re.escape(f".{target.name}.partial-") + f"[0-9a-f]{{8}}({re.escape(target.suffix)})?"
    )
    for path in list(target.parent.iterdir()) if fcntl and target.parent.is_dir() else []:
        with suppress(OSError):  # another process writes to it, or has removed it
            if name.fullmatch(path.name) and time.time() - path.stat().st_mtime > _MIN_LEFTOVER_AGE:
                with locked(path):
                    remove(path)
                _LOG.warning("Removed %s, left by a run that was killed.", path)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Lock a file or folder while the block runs; an OSError if another process has."""
    with ExitStack() as stack:
        if fcntl is not None:
            descriptor = os.open(path, os.O_RDONLY)
            stack.callback(os.close, descriptor)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
