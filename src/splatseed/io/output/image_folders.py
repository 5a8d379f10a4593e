"""Linking or copying a scene's image folders into an output.

Notation: ``folders`` maps a path inside the output to the folder or file it stands for. Promise:
the photographs are linked, or copied where links are not wanted or not possible; the source is
never written to.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path, PurePath

from splatseed.io.files import open_file
from splatseed.scene import Scene

_SIBLINGS = tuple(
    f"{kind}{scale}" for kind in ("images", "masks", "depths") for scale in ("", "_2", "_4", "_8")
)
"""Folders in which trainers look for photographs, by the resolution they ask for."""


def image_folders(scene: Scene) -> dict[str, Path]:
    """The source of ``images/`` and its siblings in a scene folder.

    Images that lie in the scene's own root, between other files, are linked by their first folder
    (or one by one).
    """
    source = scene.source
    if source is None or not scene.images:
        return {}
    folders = _siblings(source.root)
    if source.image_dir is None:
        return folders
    if source.image_dir.resolve() != source.root.resolve():
        return {**folders, "images": source.image_dir}
    firsts = _first_folders(image.name for image in scene.images)
    return {
        **{name: path for name, path in folders.items() if name != "images"},
        **{f"images/{first}": source.image_dir / first for first in firsts},
    }


def frame_folders(root: Path, file_paths: Iterable[str]) -> dict[str, Path]:
    """The first folders of a ``transforms.json``'s relative paths, so that these resolve."""
    return {**_siblings(root), **{first: root / first for first in _first_folders(file_paths)}}


def bring(folders: Mapping[str, Path], output: Path, *, copy: bool) -> list[str]:
    """Link or copy ``folders`` into ``output``; missing ones are left out.

    Returns:
        The paths inside ``output`` that were made.

    Raises:
        OSError: Neither worked.
    """
    present = {name: source for name, source in folders.items() if source.exists()}
    for name, source in present.items():
        target = output / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if copy or not _linked(_goal(source.resolve(), target, output.resolve().parent), target):
            _copy(source, target)
    return sorted(present)


def _first_folders(paths: Iterable[str]) -> list[str]:
    """The first part of each path; those that lead elsewhere (absolute, ``..``) have none."""
    pure = (PurePath(path) for path in paths)
    firsts = {path.parts[0] for path in pure if path.parts and not path.anchor}
    return sorted(firsts - {".."})


def _siblings(root: Path) -> dict[str, Path]:
    return {name: root / name for name in _SIBLINGS if (root / name).is_dir()}


def _goal(source: Path, link: Path, around: Path) -> Path:
    """The target of a link: relative if output and source are siblings, to move together."""
    if around not in source.parents or around == Path(around.anchor):
        return source
    return Path(os.path.relpath(source, link.parent.resolve()))


def _linked(source: Path, target: Path) -> bool:
    with suppress(OSError, NotImplementedError):  # a file system or system without links
        target.symlink_to(source, target_is_directory=(target.parent / source).is_dir())
        return True
    return False


def _copy(source: Path, target: Path) -> None:
    """Copy contents without modes: a copy of a read-only folder could not be removed again."""
    if not source.is_dir():
        _copy_file(source, target)
        return
    for parent, _, names in os.walk(source, followlinks=True, onerror=_raise):
        folder = target / Path(parent).relative_to(source)
        if any(Path(parent).samefile(above) for above in _above(Path(parent), source)):
            raise OSError(errno.ELOOP, "a link that leads back into itself", parent)
        folder.mkdir()
        for name in names:
            _copy_file(Path(parent, name), folder / name)


def _copy_file(source: Path, target: Path) -> None:
    with open_file(source) as file, target.open("xb") as copy:
        shutil.copyfileobj(file, copy)


def _above(folder: Path, top: Path) -> list[Path]:
    """The folders from ``folder`` up to ``top``, both included."""
    return [each for each in folder.parents if each == top or top in each.parents]


def _raise(error: OSError) -> None:
    raise error
