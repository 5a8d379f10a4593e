r"""Photographs, masks and depth maps that the frames of a ``transforms.json`` name.

A name is tried as written first. For files from another computer, \\ and / are equal, as are %20
and a space, and both forms of an umlaut in Unicode; a missing suffix, other case or another parent
folder are allowed. Promise: a file of another name is never used.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from urllib.parse import unquote

from splatseed.depthmap import DepthKind
from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.io.depth_files import SUFFIXES as DEPTH_SUFFIXES
from splatseed.io.depth_maps import DepthFiles, find_confidences
from splatseed.io.files import IMAGE_SUFFIXES, absolute, read_json
from splatseed.text import agreeing, counted

_PHOTOGRAPHS = ("images", "image", "input", "rgb", "images_2", "images_4", "images_8")
_SCANNETPP = ("../resized_images", "../resized_undistorted_images")
_MASKS = ("masks", "mask", "../resized_anon_masks", "../resized_undistorted_masks")
_DRIVE = re.compile(r"\A(?:[A-Za-z]:/|/+)")
"""Start of an absolute path, on Windows or POSIX."""
FIX = "Correct the file, or export the scene again."
_INTEGERS = frozenset({".png", ".tif", ".tiff"})


class Found(NamedTuple):
    """A file that a frame names."""

    path: Path  # absolute; links are not followed, so that names are as in COLMAP
    relocated: bool = False  # whether its folder or spelling differs from the name


@dataclass(frozen=True)
class FrameFiles:
    """Finds files relative to a ``transforms.json``."""

    path: Path
    _names: dict[Path, dict[str, list[str]]] = field(default_factory=dict)

    def photographs(self, names: Iterable[str]) -> dict[str, Found]:
        """Find the photographs that frames name, without those that are missing."""
        undistorted = "undistorted" in self.path.name
        folders = _SCANNETPP[::-1] if undistorted else _SCANNETPP
        return self._find_all(names, (*_PHOTOGRAPHS, *folders), IMAGE_SUFFIXES)

    def masks(self, names: Iterable[str]) -> dict[str, Found]:
        """Find the masks that frames name, without those that are missing."""
        return self._find_all(names, _MASKS, (".png",))

    def depth_maps(self, names: Iterable[str]) -> dict[str, Found]:
        """Find the depth maps that frames name, without those that are missing."""
        return self._find_all(names, ("depth", "depths"), ())

    def expected(self, name: str, folder: Path | None) -> Path:
        """Return where a missing photograph should be; ``folder`` contains the others."""
        plain = name.replace("\\", "/")
        if folder is not None and _DRIVE.match(plain):
            return folder / PurePosixPath(plain).name
        return absolute(self.path.parent / plain)

    def _find_all(
        self, names: Iterable[str], folders: Sequence[str], suffixes: Sequence[str]
    ) -> dict[str, Found]:
        """Find files; a relocated one must not be that of another name."""
        each = {name: self._find(name, folders, suffixes) for name in dict.fromkeys(names)}
        found = {name: file for name, file in each.items() if file is not None}
        count = Counter(file.path for file in found.values())
        return {n: file for n, file in found.items() if not file.relocated or count[file.path] == 1}

    def _find(self, name: str, folders: Sequence[str], suffixes: Sequence[str]) -> Found | None:
        root = self.path.parent
        spellings = list(dict.fromkeys(_spellings(name)))
        moved = _DRIVE.match(spellings[-1]) or ".." in PurePosixPath(spellings[-1]).parts
        for each in spellings:
            path = absolute(root / each)
            if path.is_file():
                return Found(path)
            if suffixes and (near := self._near(path, suffixes, exact=True)):
                return Found(near)
        plain = _DRIVE.sub("", spellings[-1], 1)
        parts = [part for part in PurePosixPath(plain).parts if part not in {"..", "."}]
        ends = [root.joinpath(*parts[start:]) for start in range(len(parts))]
        if moved or len(parts) == 1:  # else the folder may distinguish files of one name
            ends += [root / folder / parts[-1] for folder in folders if parts]
        if suffixes and len(parts) > 1 and not _has_files(root / parts[0]):
            ends += [root.joinpath(each, *parts[1:]) for each in _resized_folders(parts[0])]
        for end in map(absolute, ends):
            if near := self._near(end, suffixes):
                return Found(near, relocated=True)
        return None

    def _near(self, path: Path, suffixes: Sequence[str], *, exact: bool = False) -> Path | None:
        """Find a file of this name in any case, with one of the suffixes if it has none."""
        if path.parent not in self._names:
            there: dict[str, list[str]] = {}
            for each in sorted(path.parent.iterdir()) if path.parent.is_dir() else ():
                there.setdefault(each.name.casefold(), []).append(each.name)
            self._names[path.parent] = there
        ends = ("",) if path.suffix.lower() in suffixes else ("", *suffixes)
        for end in ends:
            alike = self._names[path.parent].get(f"{path.name}{end}".casefold(), [])
            # Of several, prefer the name's case; suffixes may differ in case.
            best = sorted(alike, key=lambda each: not each.startswith(path.name))
            for name in best if not exact else [e for e in best if e.startswith(path.name)]:
                if (file := path.with_name(name)).is_file() and (end or not exact):
                    return file
        return None


def _has_files(folder: Path) -> bool:
    return folder.is_dir() and any(folder.iterdir())


def _resized_folders(name: str) -> list[str]:
    """Return the names of folders that hold the photographs of another at other sizes."""
    plain = re.sub(r"_[248]\Z", "", name)
    return [
        each for each in (plain, *(f"{plain}_{factor}" for factor in (2, 4, 8))) if each != name
    ]


def _spellings(name: str) -> Iterator[str]:
    yield name
    yield name.replace("\\", "/")
    plain = unquote(name.replace("\\", "/"))
    yield from (unicodedata.normalize(form, plain) for form in ("NFC", "NFD"))
    yield plain


class Frame(NamedTuple):
    """A posed image of a ``transforms.json``."""

    where: str  # for errors
    file: Path  # absolute; it may not exist
    fields: Mapping[str, Any]
    is_test: bool = False  # listed in ``test_frames``, as in ScanNet++


class _Listed(NamedTuple):
    """A frame, and the photograph found for its name."""

    where: str
    name: str
    fields: Mapping[str, Any]
    is_test: bool
    found: Found | None


def any_photograph(path: Path) -> bool:
    """Whether the photograph of any frame of a ``transforms.json`` exists."""
    return any(each.found for each in _listed(path, read_json(path, fix=FIX)))


def find_frames(path: Path, meta: Any) -> tuple[list[Frame], list[Finding]]:
    """Return the usable frames with their files, and findings about the others."""
    listed = _listed(path, meta)
    folders = [each.found.path.parent for each in listed if each.found]
    folder = Counter(folders).most_common(1)[0][0] if folders else None
    findings = _moved(path, listed)
    if bad := [each for each in listed if each.fields.get("is_bad") is True]:
        text = f"{counted(len(bad), 'frame')} marked is_bad in {path.name} are left out."
        names = tuple(each.name for each in bad)
        findings.append(Finding("bad-frames", text, subjects=names))
        listed = [each for each in listed if each not in bad]
    tests = [each for each in listed if each.is_test]
    if tests and not any(each.found for each in tests):
        listed = [each for each in listed if not each.is_test]
        what = f"{path.name}: {counted(len(tests), 'test frame')} have no photographs and are"
        text = f"{what} left out, so some training images become test views."
        findings.append(Finding("missing-test-views", text))
    sizes = [{**meta, **each.fields} for each in listed]
    sized = [size.get("w") is not None and size.get("h") is not None for size in sizes]
    used = [e for e, s in zip(listed, sized, strict=True) if e.found or s or folder is None]
    if lost := [each for each in listed if each not in used]:
        what = f"{len(lost)} of {counted(len(listed), 'frame')} in {path.name} have no photograph"
        text = f"{what} and no size, and are left out, such as {lost[0].name}."
        names = tuple(each.name for each in lost)
        findings.append(Finding("missing-photographs", text, subjects=names))
    if not used:
        raise SceneFormatError(f"{path} to have usable frames", found="none", fix=FIX)
    files = FrameFiles(path)
    frames = []
    for each in used:
        file = each.found.path if each.found else files.expected(each.name, folder)
        frames.append(Frame(f"{path}, {each.where}", file, each.fields, each.is_test))
    return frames, findings


def _listed(path: Path, meta: Any) -> list[_Listed]:
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        found = "another type" if frames else "none"
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
        listed.append(_Listed(where, name, fields, is_test, None))
    photographs = files.photographs(each.name for each in listed)
    return [each._replace(found=photographs.get(each.name)) for each in listed]


def _moved(path: Path, listed: Sequence[_Listed]) -> list[Finding]:
    moved = {each.name: each.found.path for each in listed if each.found and each.found.relocated}
    if not moved:
        return []
    name, file = next(iter(moved.items()))
    names = agreeing(len(moved), "names a missing photograph", "name missing photographs")
    what = f"{counted(len(moved), 'frame')} of {path.name} {names}"
    text = f"{what}; files of the same name are read instead, such as {file} for {name}."
    return [Finding("moved-photographs", text, subjects=tuple(moved))]


def named_masks(
    files: FrameFiles, frames: Mapping[str, Mapping[str, Any]]
) -> tuple[dict[str, Path], list[Finding]]:
    """Find the masks that frames name, by image, and report missing ones."""
    given = {name: frame.get("mask_path") for name, frame in frames.items()}
    named = {name: mask for name, mask in given.items() if isinstance(mask, str)}
    found = files.masks(named.values())
    missing = [mask for mask in named.values() if mask not in found]
    masks = {name: found[mask].path for name, mask in named.items() if mask in found}
    return masks, _not_found("missing-masks", files, "mask", missing)


def _not_found(kind: str, files: FrameFiles, noun: str, missing: Sequence[str]) -> list[Finding]:
    if not missing:
        return []
    what = f"{counted(len(missing), noun)} named in {files.path.name} cannot be found"
    return [Finding(kind, f"{what}, such as {missing[0]}.", subjects=tuple(missing))]


def named_depths(
    files: FrameFiles, frames: Mapping[str, Mapping[str, Any]], meta: Mapping[str, Any]
) -> tuple[DepthFiles | None, list[Finding]]:
    """Find the depth maps that frames name, with their unit, and report missing ones.

    Integers in ``depth_path`` (instant-ngp, NeRFCapture) are multiplied by
    ``integer_depth_scale``, of the file or of all its frames; those in ``depth_file_path``
    (nerfstudio, Spectacular AI) are millimetres.
    """
    paths, key_used, missing = dict[str, Path](), "", dict[str, str]()
    for key in ("depth_file_path", "depth_path"):
        given = {name: frame.get(key) for name, frame in frames.items() if name not in paths}
        named = {name: depth for name, depth in given.items() if isinstance(depth, str) and depth}
        found = files.depth_maps(named.values())
        missing |= {name: depth for name, depth in named.items() if depth not in found}
        for name, depth in named.items():
            if depth in found and found[depth].path.suffix.lower() in DEPTH_SUFFIXES:
                paths[name], key_used = found[depth].path, key_used or key
    lost = [depth for name, depth in missing.items() if name not in paths]
    findings = _not_found("missing-depth-maps", files, "depth map", lost)
    if not paths:
        return None, findings
    unit = _depth_unit(files, key_used, paths, [{**meta, **frames[name]} for name in paths])
    scale = None if unit is None else 1 / unit
    kind: DepthKind | None = None if unit is None else "z"
    return DepthFiles(paths, kind, scale, confidences=find_confidences(paths)), findings


def _depth_unit(
    files: FrameFiles, key_used: str, paths: Mapping[str, Path], fields: Sequence[Mapping[str, Any]]
) -> float | None:
    """Return scene units per stored unit by the fields of each frame; None if not given."""
    key = "integer_depth_scale"
    if key_used == "depth_file_path" and not any(key in each for each in fields):
        key = "depth_unit_scale_factor"
    units = {repr(each.get(key)): each.get(key) for each in fields}
    if len(units) > 1:
        expected = f"one {key} for all frames in {files.path}"
        raise SceneFormatError(expected, found=", ".join(units)[:80], fix=FIX)
    unit = next(iter(units.values()))
    integers = all(path.suffix.lower() in _INTEGERS for path in paths.values())
    if unit is None or (key == "integer_depth_scale" and not integers):
        return None
    if isinstance(unit, bool) or not isinstance(unit, int | float) or not 0 < unit < math.inf:
        raise SceneFormatError(f"{key} above 0 in {files.path}", found=repr(unit)[:80], fix=FIX)
    return unit
