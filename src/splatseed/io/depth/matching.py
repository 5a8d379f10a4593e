"""Matching depth maps to images by name.

Notation: a *stem* is a map's path without suffix, relative to the folder. For the image ``a/b.jpg``
the stems are tried in this order: ``a/b.jpg``, ``a/b.jpg.geometric`` and ``.photometric`` (COLMAP's
dense stereo), ``a/b``, ``a/b_depth``, ``a/depthN`` for ``a/frameN.jpg`` (NICE-SLAM) and
``a/X.depth`` for ``a/X.color.png`` (7-Scenes); for each, the suffixes in the order of ``SUFFIXES``.
Promise: the choice depends on names only, never on the order in which a system lists files.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from splatseed.errors import SceneFormatError
from splatseed.io.depth.files import SUFFIXES, DepthFiles
from splatseed.io.depth.folder import (
    CAMERA_FILE,
    DESCRIPTION,
    DepthDescription,
    read_capture_scale,
    read_description,
    safe_parts,
)
from splatseed.scene import Scene

_FOLDERS = ("", "stereo/depth_maps", "depth_maps", "results", "depths", "depth")
"""Subfolders searched for maps; the first with a map of any image is used."""
_FRAME = re.compile(r"frame(\d+)", re.IGNORECASE)
_CAPTURED = re.compile(r"depth(\d+)", re.IGNORECASE)


def match_by_name(scene: Scene, root: Path) -> DepthFiles | None:
    """The depth maps in a folder whose names match a scene's images; None if there are none.

    Raises:
        SceneFormatError: Two images share a map, or the folder's description is damaged.
    """
    for folder in (root / name for name in _FOLDERS):
        if folder.is_dir() and (paths := _match(scene, folder)):
            return DepthFiles(paths, *_describe(folder, next(iter(paths.values()))))
    return None


def _match(scene: Scene, folder: Path) -> dict[str, Path]:
    """The map of each image in one folder.

    Image names may begin with folders that map names lack: as many as needed to match any map are
    dropped.
    """
    parts = {image.name: safe_parts(image.name) for image in scene.images}
    listing = _Listing(folder, _image_files(scene))
    for drop in range(max(map(len, parts.values()), default=0)):
        maps = {name: listing.map_of(each[drop:]) for name, each in sorted(parts.items())}
        present = {name: path for name, path in maps.items() if path is not None}
        if present:
            _check_unshared(present)
            return present
    return {}


def _image_files(scene: Scene) -> frozenset[Path]:
    """The photographs themselves, which are not depth maps even if they lie in the same folder."""
    folder = scene.source.image_dir if scene.source else None
    if folder is None:
        return frozenset()
    paths = [folder / image.name for image in scene.images]
    resolved = {parent: parent.resolve() for parent in {path.parent for path in paths}}
    return frozenset(resolved[path.parent] / path.name for path in paths)


class _Listing:
    """The depth maps of a folder; each subfolder is listed once, on demand."""

    def __init__(self, root: Path, taken: frozenset[Path]) -> None:
        self._root = root
        self._taken = taken
        self._folders: dict[tuple[str, ...], dict[str, Path]] = {}

    def map_of(self, parts: tuple[str, ...]) -> Path | None:
        """The map of the image with these folders and this file name."""
        if not parts:
            return None
        if parts[:-1] not in self._folders:
            self._folders[parts[:-1]] = self._list(self._root.joinpath(*parts[:-1]))
        files = self._folders[parts[:-1]]
        keys = (stem + suffix for stem in _stems(parts[-1]) for suffix in SUFFIXES)
        return next((files[key] for key in keys if key in files), None)

    def _list(self, folder: Path) -> dict[str, Path]:
        """The files of a subfolder by name, suffixes in lower case, numbers also unpadded."""
        files: dict[str, Path] = {}
        if not folder.is_dir():
            return files
        resolved = folder.resolve()
        for path in sorted(folder.iterdir(), reverse=True):  # .png before .PNG
            if path.suffix.lower() in SUFFIXES and resolved / path.name not in self._taken:
                files.setdefault(path.stem + path.suffix.lower(), path)
        for key, path in list(files.items()):
            if number := _CAPTURED.match(key):
                files.setdefault(f"depth{int(number[1])}{key[number.end() :]}", path)
        return files


def _stems(file_name: str) -> Iterator[str]:
    """The stems that a map of this image may have, in order of preference."""
    stem = PurePosixPath(file_name).stem
    yield from (file_name, f"{file_name}.geometric", f"{file_name}.photometric")
    yield from (stem, f"{stem}_depth")
    if number := _FRAME.fullmatch(stem):
        yield f"depth{int(number[1])}"
    if stem.endswith(".color"):
        yield f"{stem.removesuffix('.color')}.depth"


def _check_unshared(maps: dict[str, Path]) -> None:
    owners: dict[Path, str] = {}
    for name, path in maps.items():
        other = owners.setdefault(path, name)
        if other != name:
            raise SceneFormatError(
                "a depth map of its own for each image",
                found=f"{path} for {other} and for {name}",
                fix=f"Name maps in full, with subfolders: {name}.npy or {name}.png.",
            )


def _describe(folder: Path, example: Path) -> DepthDescription:
    """What the folder says about its maps: ``depths.json``, or the camera file of a capture."""
    if (folder / DESCRIPTION).is_file():
        return read_description(folder / DESCRIPTION)
    if _CAPTURED.fullmatch(example.stem) and example.suffix.lower() == ".png":
        for parent in (folder, *folder.resolve().parents[:2]):
            if (parent / CAMERA_FILE).is_file():
                return DepthDescription(scale=read_capture_scale(parent / CAMERA_FILE))
    return DepthDescription()
