r"""The files that frames of a ``transforms.json`` name: photographs, masks and depth maps.

A name is tried as it is first. What was written on another computer is found where it lies here:
with \\ for /, with %20 for a space, without suffix, in another case, below another folder. Promise:
a file of another name is never taken.
"""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from urllib.parse import unquote

from splatseed.errors import SceneFormatError
from splatseed.io.depth_files import SUFFIXES as DEPTH_SUFFIXES
from splatseed.io.depth_maps import DepthFiles
from splatseed.io.files import read_json
from splatseed.text import counted

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
"""Tried in this order, in any case, for a photograph named without one."""
_PHOTOGRAPHS = ("images", "image", "input", "rgb", "images_2", "images_4", "images_8")
_SCANNETPP = ("../resized_images", "../resized_undistorted_images")
_MASKS = ("masks", "mask", "../resized_anon_masks", "../resized_undistorted_masks")
_DRIVE = re.compile(r"\A(?:[A-Za-z]:/|/+)")
"""How an absolute path begins, on Windows or here."""
FIX = "Correct the file, or export the scene again."
_INTEGERS = frozenset({".png", ".tif", ".tiff"})


class Found(NamedTuple):
    """A file that a frame names."""

    path: Path  # absolute; links are not followed, so that names are as in COLMAP
    elsewhere: bool = False  # whether it lies or is spelled otherwise than named


@dataclass(frozen=True)
class FrameFiles:
    """Finds files from the folder of a ``transforms.json``."""

    path: Path
    _names: dict[Path, dict[str, list[str]]] = field(default_factory=dict)

    def photograph(self, name: str) -> Found | None:
        """The photograph of a frame; None if it is not there."""
        undistorted = "undistorted" in self.path.name
        folders = _SCANNETPP[::-1] if undistorted else _SCANNETPP
        return self._find(name, (*_PHOTOGRAPHS, *folders), SUFFIXES)

    def mask(self, name: str) -> Found | None:
        """The mask of a frame; None if it is not there."""
        return self._find(name, _MASKS, (".png",))

    def depth_map(self, name: str) -> Found | None:
        """The depth map of a frame; None if it is not there."""
        return self._find(name, ("depth", "depths"), ())

    def expected(self, name: str, folder: Path | None) -> Path:
        """Where a missing photograph should be; ``folder`` is where others were found."""
        plain = name.replace("\\", "/")
        if folder is not None and _DRIVE.match(plain):
            return folder / PurePosixPath(plain).name
        return _absolute(self.path.parent / plain)

    def _find(self, name: str, folders: Sequence[str], suffixes: Sequence[str]) -> Found | None:
        root = self.path.parent
        spellings = list(dict.fromkeys(_spellings(name)))
        moved = _DRIVE.match(spellings[-1]) or ".." in PurePosixPath(spellings[-1]).parts
        for each in spellings:
            path = _absolute(root / each)
            if path.is_file():
                return Found(path)
            if suffixes and (near := self._near(path, suffixes, exact=True)):
                return Found(near)
        plain = _DRIVE.sub("", spellings[-1], 1)
        parts = [part for part in PurePosixPath(plain).parts if part not in {"..", "."}]
        ends = [root.joinpath(*parts[start:]) for start in range(len(parts))]
        if moved or len(parts) == 1:  # else its folder may tell it from others of its name
            ends += [root / folder / parts[-1] for folder in folders if parts]
        for end in map(_absolute, ends):
            if near := self._near(end, suffixes):
                return Found(near, elsewhere=True)
        return None

    def _near(self, path: Path, suffixes: Sequence[str], *, exact: bool = False) -> Path | None:
        """The file of this name in any case, or, for a name without suffix, with one of these."""
        if path.parent not in self._names:
            there: dict[str, list[str]] = {}
            for each in sorted(path.parent.iterdir()) if path.parent.is_dir() else ():
                there.setdefault(each.name.casefold(), []).append(each.name)
            self._names[path.parent] = there
        ends = ("",) if path.suffix.lower() in suffixes else ("", *suffixes)
        for end in ends:
            alike = self._names[path.parent].get(f"{path.name}{end}".casefold(), [])
            # Of several, that in the case of the name; a suffix may be in any.
            best = sorted(alike, key=lambda each: not each.startswith(path.name))
            for name in best if not exact else [e for e in best if e.startswith(path.name)]:
                if (file := path.with_name(name)).is_file() and (end or not exact):
                    return file
        return None


def _spellings(name: str) -> Iterator[str]:
    yield name
    yield name.replace("\\", "/")
    yield unquote(name.replace("\\", "/"))


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))  # noqa: PTH100  (resolve would follow links)


class Frame(NamedTuple):
    """A posed image of a ``transforms.json``."""

    where: str  # for errors
    file: Path  # absolute; it may not exist
    fields: Mapping[str, Any]
    tests: bool = False  # whether it is one of ``test_frames``, as ScanNet++ has them


class _Listed(NamedTuple):
    """A frame, and what was found for the photograph that it names."""

    where: str
    name: str
    fields: Mapping[str, Any]
    tests: bool
    found: Found | None


def any_photograph(path: Path) -> bool:
    """Whether the photograph of any frame of a ``transforms.json`` exists."""
    return any(each.found for each in _listed(path, read_json(path, fix=FIX)))


def find_frames(path: Path, meta: Any) -> tuple[list[Frame], list[str]]:
    """The frames that can be used, with their files, and notes on the others."""
    listed = _listed(path, meta)
    there = [each.found.path.parent for each in listed if each.found]
    folder = Counter(there).most_common(1)[0][0] if there else None
    notes = _moved(path, listed)
    if bad := [each for each in listed if each.fields.get("is_bad") is True]:
        notes.append(f"{counted(len(bad), 'frame')} marked is_bad in {path.name} are left out.")
        listed = [each for each in listed if each not in bad]
    tests = [each for each in listed if each.tests]
    if tests and not any(each.found for each in tests):
        listed = [each for each in listed if not each.tests]
        what = f"{path.name}: {counted(len(tests), 'test frame')} have no photographs and are"
        notes.append(f"{what} left out, so training images are held out for testing.")
    sizes = [{**meta, **each.fields} for each in listed]
    sized = [size.get("w") is not None and size.get("h") is not None for size in sizes]
    used = [e for e, s in zip(listed, sized, strict=True) if e.found or s or folder is None]
    if lost := [each for each in listed if each not in used]:
        what = f"{len(lost)} of {counted(len(listed), 'frame')} in {path.name} have no photograph"
        notes.append(f"{what} and no size, and are left out, such as {lost[0].name}.")
    if not used:
        raise SceneFormatError(f"{path} to have frames that can be used", found="none", fix=FIX)
    files = FrameFiles(path)
    frames = []
    for each in used:
        file = each.found.path if each.found else files.expected(each.name, folder)
        frames.append(Frame(f"{path}, {each.where}", file, each.fields, each.tests))
    return frames, notes


def _listed(path: Path, meta: Any) -> list[_Listed]:
    """All frames of a file, training and test."""
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        found = "something else" if frames else "none"
        raise SceneFormatError(f"{path} to have a list of frames", found=found, fix=FIX)
    tests = meta.get("test_frames")
    tests = [each for each in tests if isinstance(each, dict)] if isinstance(tests, list) else []
    files, listed = FrameFiles(path), []
    for i, fields in enumerate((*frames, *tests)):
        is_test = i >= len(frames)
        where = f"test frame {i + 1 - len(frames)}" if is_test else f"frame {i + 1}"
        name = fields.get("file_path")
        if not isinstance(name, str) or not name or "\0" in name:
            raise SceneFormatError(f"a file_path in {path}, {where}", found=repr(name), fix=FIX)
        listed.append(_Listed(where, name, fields, is_test, files.photograph(name)))
    # What lies elsewhere than named is not what another frame names.
    names = Counter(each.found.path for each in {e.name: e for e in listed}.values() if each.found)
    return [
        each._replace(found=None)
        if each.found and each.found.elsewhere and names[each.found.path] > 1
        else each
        for each in listed
    ]


def _moved(path: Path, listed: Sequence[_Listed]) -> list[str]:
    """A note on photographs that lie elsewhere than named."""
    moved = {each.name: each.found.path for each in listed if each.found and each.found.elsewhere}
    if not moved:
        return []
    name, file = next(iter(moved.items()))
    what = f"{counted(len(moved), 'frame')} of {path.name} name photographs that are not there"
    return [f"{what}; those of the same name are read, such as {file} for {name}."]


def named_masks(
    files: FrameFiles, frames: Mapping[str, Mapping[str, Any]]
) -> tuple[dict[str, Path], list[str]]:
    """The masks that frames name, by image, and a note on those that are not there."""
    named = {name: frame.get("mask_path") for name, frame in frames.items()}
    found = {name: files.mask(mask) for name, mask in named.items() if isinstance(mask, str)}
    gone = [str(named[name]) for name, each in found.items() if each is None]
    masks = {name: each.path for name, each in found.items() if each}
    if not gone:
        return masks, []
    what = f"{counted(len(gone), 'mask')} that {files.path.name} names cannot be found"
    return masks, [f"{what}, such as {gone[0]}."]


def named_depths(
    files: FrameFiles, frames: Mapping[str, Mapping[str, Any]], meta: Mapping[str, Any]
) -> DepthFiles | None:
    """The depth maps that frames name, with their unit; None without any.

    ``depth_path`` is instant-ngp's and NeRFCapture's, whose integers are to be multiplied by
    ``integer_depth_scale``; ``depth_file_path`` is nerfstudio's, whose integers are millimetres.
    """
    paths, key_used = dict[str, Path](), ""
    for key in ("depth_file_path", "depth_path"):
        for name, frame in frames.items():
            depth = frame.get(key)
            found = files.depth_map(depth) if isinstance(depth, str) and depth else None
            if found and found.path.suffix.lower() in DEPTH_SUFFIXES and name not in paths:
                paths[name], key_used = found.path, key_used or key
    if not paths:
        return None
    integers = all(path.suffix.lower() in _INTEGERS for path in paths.values())
    unit_key = "integer_depth_scale"
    if key_used == "depth_file_path" and unit_key not in meta:
        unit_key = "depth_unit_scale_factor"
    unit = meta.get(unit_key)
    if unit is None or (unit_key == "integer_depth_scale" and not integers):
        return DepthFiles(paths)
    if isinstance(unit, bool) or not isinstance(unit, int | float) or not 0 < unit < math.inf:
        expected = f"a number above 0 as {unit_key} in {files.path}"
        raise SceneFormatError(expected, found=repr(unit)[:80], fix=FIX)
    return DepthFiles(paths, "z", 1 / unit)
