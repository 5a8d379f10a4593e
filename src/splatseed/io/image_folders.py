"""Image folders of an output: where ``images`` and its siblings come from, linked or copied.

A mapping from a path inside the output to the folder or file that it stands for.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path, PurePath

from splatseed.io.files import open_file
from splatseed.io.mask_files import FOLDER as MASKS
from splatseed.io.recordings import is_extracted
from splatseed.scene import Scene

_KINDS = ("images", MASKS, "depths")
"""Folders in which trainers look, each also with the resolution that they ask for."""


def image_folders(scene: Scene) -> dict[str, Path]:
    """Map ``images`` and its siblings in an output to the scene's folders."""
    source = scene.source
    if not scene.images:
        return {}
    folders = sibling_folders(scene)
    if source.image_dir is None:
        return folders
    if source.root is None or source.image_dir.resolve() != source.root.resolve():
        return {**folders, "images": source.image_dir}
    folders.pop("images", None)
    names = [n for n in (image.name for image in scene.images) if first_folders([n])]
    # One by one: gsplat's examples do not enter a linked folder within images.
    return {**folders, **{f"images/{name}": scene[name].path for name in names}}


def first_folders(paths: Iterable[str]) -> list[str]:
    """Return the first parts of relative paths; absolute ones and ``..`` have none."""
    pure = (PurePath(path) for path in paths)
    firsts = {path.parts[0] for path in pure if path.parts and not path.anchor}
    return sorted(firsts - {".."})


def sibling_folders(scene: Scene) -> dict[str, Path]:
    """Return the folders of images, masks and depth maps, at any scale, in a scene's folder.

    Those of masks are left out if none of them count.
    """
    root = scene.source.root
    kinds = [kind for kind in _KINDS if kind != MASKS or scene.masks is not None]
    names = (f"{kind}{scale}" for kind in kinds for scale in ("", "_2", "_4", "_8"))
    return {name: root / name for name in names if root and (root / name).is_dir()}


def photographs_hidden(folders: Mapping[str, Path], scene: Scene) -> str:
    """Say which linked files Brush would take for photographs; empty if none.

    Of the files whose path ends in the name of an image of a COLMAP model, Brush takes the first
    by path, in whichever folder (its ``find_image_by_name``).
    """
    image_dir = scene.source.image_dir
    wanted = {image.name.lower(): image.name for image in scene.images}
    for name, source in sorted(folders.items()):
        if image_dir is None or name >= "images" or not source.is_dir():
            continue
        for top, _, files in os.walk(source):
            inside = PurePath(top).relative_to(source).parts
            for parts in ((*inside, file) for file in files):
                ends = ("/".join(parts[start:]).lower() for start in range(len(parts)))
                own = (image_dir / wanted[end] for end in ends if end in wanted)
                if any(path.parent.resolve() != Path(top).resolve() for path in own):
                    return f"Brush would take files in {name} for photographs of their names"
    return ""


def link_folders(folders: Mapping[str, Path], output: Path, *, copy: bool) -> list[str]:
    """Link or copy image folders into ``output``; missing ones are left out.

    Photographs extracted into the user's cache are always copied.
    """
    present = {name: source for name, source in folders.items() if source.exists()}
    around, copied = output.resolve().parent, dict[Path, Path]()
    for name, source in present.items():
        target = output / name
        target.parent.mkdir(parents=True, exist_ok=True)
        goal = source.resolve()
        # Relative if output and source are siblings, to move together.
        if around in goal.parents and around != Path(around.anchor):
            goal = Path(os.path.relpath(goal, target.parent.resolve()))
        if not copy and not is_extracted(source):  # a link would break when the cache is emptied
            with suppress(OSError, NotImplementedError):  # a file system or system without links
                target.symlink_to(goal, target_is_directory=source.is_dir())
        elif (twin := copied.get(source.resolve())) is not None:  # under another name
            with suppress(OSError, NotImplementedError):
                target.symlink_to(os.path.relpath(twin, target.parent), twin.is_dir())
        if not target.is_symlink():
            _copy(source.resolve(), target)
            copied[source.resolve()] = target
    return sorted(present)


def _copy(source: Path, target: Path) -> None:
    """Copy contents without modes, as a copy of a read-only folder could not be removed."""
    if not source.is_dir():
        with open_file(source) as file, target.open("xb") as copy:
            shutil.copyfileobj(file, copy)
        return
    above = {source.resolve(), *source.resolve().parents}
    target.mkdir()
    for each in source.iterdir():
        if each.is_dir() and each.resolve() in above:
            raise OSError(errno.ELOOP, "a link that leads back into itself", str(each))
        _copy(each, target / each.name)


def copy_files(source: Path | None, names: Sequence[str], target: Path) -> None:
    """Copy the files of these names that exist, if there is a source."""
    for name in names:
        if source and (source / name).is_file():
            shutil.copyfile(source / name, target / name)
