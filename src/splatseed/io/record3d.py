"""Recordings of Record3D: the export "EXR + RGB", and ``.r3d`` archives, packed or unpacked.

The export is a folder ``EXR_RGBD`` with ``metadata.json``, ``rgb/N.jpg`` (or .png) and
``depth/N.exr``. An archive is a zip file with ``metadata``, ``rgbd/N.jpg``, ``rgbd/N.depth``
(float32, compressed by LZFSE) and ``rgbd/N.conf`` (ARKit's levels 0 to 2, uint8, likewise). N is
the number of the pose, from 0: of a frame that the app dropped, the pose remains. The metadata have
``poses`` (qx qy qz qw x y z of ``world_from_cam``, OpenGL axes of the photograph as stored,
metres), ``K`` (column-major, of the first frame) and, in newer versions,
``perFrameIntrinsicCoeffs`` (fx fy cx cy of each), both for photographs of ``w`` x ``h`` and used as
measured from the image corner; depth is planar z of ``dw`` x ``dh`` pixels, in metres. Sources: the
author's answers at github.com/marek-simonik/record3d (issues 7, 27, 83 and 93), and how nerfstudio
and instant-ngp read it.
"""

from __future__ import annotations

import importlib
import json
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64
from PIL import Image as PilImage

from splatseed.camera import rotation_from_quat
from splatseed.errors import MissingDependencyError, SceneNotFoundError
from splatseed.findings import Finding
from splatseed.io.camera_records import check_pose, check_unit_quat
from splatseed.io.depth_maps import DepthFiles, find_confidences
from splatseed.io.files import (
    COPY_AGAIN,
    StrPath,
    open_file,
    read_bytes,
    translate_errors,
    translate_read_errors,
)
from splatseed.io.phone import PhoneFrame, read_phone_scene
from splatseed.io.recordings import choose_photographs, chosen_finding, extracted
from splatseed.progress import Progress
from splatseed.requirements import require
from splatseed.runtime.fingerprint import fingerprint
from splatseed.scene import Scene
from splatseed.text import agreeing, counted

ARCHIVE = ".r3d"
"""The suffix of Record3D's archives."""
_EXPORT = "EXR_RGBD"
_PHOTOGRAPH = re.compile(r"(\d{1,9})\.(jpe?g|png)", re.IGNORECASE)
_MAX_MEMBER = 1 << 28
"""Bytes of the largest plausible photograph or map in an archive."""
_FIX = 'In the app, export the recording again, as "EXR + RGB" or as .r3d.'
_VIDEO_MARK = b'"rangeOfEncodedDepth"'
"""In the JSON at the end of the app's export "RGBD video"."""
_VIDEO_TAIL = 1 << 16


class _Layout(NamedTuple):
    metadata: str
    photographs: str  # a folder
    depths: str  # a folder
    depth_suffix: str


_EXR = _Layout("metadata.json", "rgb", "depth", ".exr")
_R3D = _Layout("metadata", "rgbd", "rgbd", ".depth")
_EXTRACTED = _Layout("metadata.json", "rgb", "depth", ".npy")


def is_record3d(folder: Path) -> bool:
    """Whether a folder is an export of Record3D, with or without its metadata."""
    return _find(folder) is not None


def _find(folder: Path) -> tuple[Path, _Layout] | None:
    for root in (folder, folder / _EXPORT):
        for layout in (_EXR, _R3D):
            depth = root / layout.depths / f"0{layout.depth_suffix}"
            known = (root / layout.metadata).is_file() or depth.is_file()
            if known and (root / layout.photographs).is_dir():
                return root, layout
    return None


def is_rgbd_video(path: Path) -> bool:
    """Whether a video is Record3D's export "RGBD video", which has no poses."""
    with translate_read_errors(path), open_file(path) as file:
        file.seek(max(0, file.seek(0, 2) - _VIDEO_TAIL))
        return _VIDEO_MARK in file.read()


def read_record3d(folder: StrPath) -> Scene:
    """Read an export's folder or an unpacked archive, with its depth maps; the cloud is empty."""
    found = _find(Path(folder))
    assert found is not None  # noqa: S101  (is_record3d)
    root, layout = found
    path, photographs = root / layout.metadata, root / layout.photographs
    if not path.is_file():
        raise SceneNotFoundError(f"{path}, with Record3D's poses", found="no such file", fix=_FIX)
    data = read_bytes(path)
    metadata = _read_metadata(path, data)
    sizes = {file.name: file.stat().st_size for file in photographs.iterdir() if file.is_file()}
    names, findings = _choose(metadata, sizes, root)
    depths = root / layout.depths, layout.depth_suffix
    if layout is _R3D:
        maps = [f"{_number(name)}{suffix}" for name in names for suffix in (".depth", ".conf")]
        facts = fingerprint(data, [(name, sizes.get(name)) for name in maps])
        read = partial(_read_member, root)
        unpacked, lacking = _unpack(root, facts, metadata, names, read, photographs=False)
        depths, findings = (
            (unpacked / _EXTRACTED.depths, _EXTRACTED.depth_suffix),
            findings + lacking,
        )
    return _scene(root, metadata, photographs, names, depths, findings)


def read_r3d(path: StrPath) -> Scene:
    """Read an archive, whose photographs and depth maps are extracted into the user's cache."""
    path = Path(path)
    with _opened(path) as archive, translate_errors(path, "an archive of Record3D"):
        data = _read_within(archive, _R3D.metadata)
        members = {info.filename: (info.file_size, info.CRC) for info in archive.infolist()}
    metadata = _read_metadata(path, data)
    inside = f"{_R3D.photographs}/"
    sizes = {n.removeprefix(inside): s for n, (s, _) in members.items() if n.startswith(inside)}
    names, findings = _choose(metadata, sizes, path)
    facts = fingerprint(data, sorted(members.items()))
    with _opened(path) as archive:
        read = partial(_read_packed, path, archive)
        root, lacking = _unpack(path, facts, metadata, names, read, photographs=True)
    depths = root / _EXTRACTED.depths, _EXTRACTED.depth_suffix
    photographs = root / _EXTRACTED.photographs
    return _scene(root, metadata, photographs, names, depths, findings + lacking)


def find_recorded_depths(scene: Scene, path: Path) -> DepthFiles | None:
    """Find the depth maps of a recording for a scene made of its photographs; None if none fits.

    Raises as ``read_record3d`` and ``read_r3d``.
    """
    maps = (read_record3d if path.is_dir() else read_r3d)(path).depths
    names = {image.name for image in scene.images}
    if not isinstance(maps, DepthFiles) or not (used := names & maps.paths.keys()):
        return None
    paths, confidences = (
        {name: found for name, found in each.items() if name in used}
        for each in (maps.paths, maps.confidences)
    )
    return replace(maps, paths=paths, confidences=confidences)


def _scene(
    root: Path,
    metadata: _Metadata,
    photographs: Path,
    names: Sequence[str],
    depths: tuple[Path, str],
    findings: Sequence[Finding],
) -> Scene:
    """Make the scene of some photographs; ``depths`` are a folder of maps and their suffix."""
    folder, suffix = depths
    paths = {name: folder / f"{_number(name)}{suffix}" for name in names}
    paths = {name: path for name, path in paths.items() if path.is_file()}
    if paths and suffix == _EXR.depth_suffix and (lacking := _lacking("OpenEXR")):
        paths, findings = {}, [*findings, *lacking]
    scene = read_phone_scene(root, metadata.path, photographs, names, metadata.frame, findings)
    posed = {image.name for image in scene.images}
    paths = {name: path for name, path in paths.items() if name in posed}
    maps = DepthFiles(paths, "z", confidences=find_confidences(paths)) if paths else None
    return scene.replace(depths=maps)


def _lacking(package: str) -> list[Finding]:
    try:
        require(package)
    except MissingDependencyError as error:
        text = f"Depth maps are left out, as reading them needs {package}."
        return [Finding("missing-package", text, fix=error.fix)]
    return []


def _number(name: str) -> int:
    return int(Path(name).stem)


# Metadata -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Metadata:
    """A recording's poses and cameras, checked but for single frames."""

    path: Path
    size: tuple[int, int]  # width and height that intrinsics refer to
    depth_size: tuple[int, int] | None  # width and height
    poses: Float64[np.ndarray, "N 7"]  # qx qy qz qw x y z
    pinhole: tuple[float, ...]  # fx fy cx cy of the first frame
    pinholes: Float64[np.ndarray, "M 4"]  # of the first M frames, if stored

    def frame(self, name: str) -> PhoneFrame:
        """Return a photograph's camera and pose."""
        number = _number(name)
        where = f"{self.path}, pose {number}"
        quat, center = self.poses[number, [3, 0, 1, 2]], self.poses[number, 4:]
        check_pose((*quat, *center), f"of {name}", where)
        check_unit_quat(quat, where, _FIX)
        pose = np.column_stack([rotation_from_quat(quat), center])
        stored = self.pinholes[number].tolist() if number < len(self.pinholes) else self.pinhole
        fx, fy, cx, cy = map(float, stored)
        return PhoneFrame(where, self.size, (fx, fy, cx, cy), pose)


def _read_metadata(path: Path, data: bytes) -> _Metadata:
    expected = "Record3D's metadata, an object with w, h, K (9 numbers) and poses (7 numbers each)"
    with translate_errors(path, expected, fix=_FIX):
        content = json.loads(data)
        if not isinstance(content, dict):
            raise TypeError
        K, poses = _numbers(content["K"], 9), _numbers(content["poses"], 7)
        pinholes = _numbers(content.get("perFrameIntrinsicCoeffs") or [], 4)
        fx, _, skew, _, fy, _, cx, cy, one = K.ravel().tolist()
        if K.shape != (1, 9) or skew != 0 or one != 1:
            raise ValueError(f"K {content['K']}, not column by column")
        size = (int(content["w"]), int(content["h"]))
        depth = (int(content.get("dw") or 0), int(content.get("dh") or 0))
    if not len(poses):
        raise SceneNotFoundError(
            f"poses in {path}",
            found="none, as in recordings of the front camera",
            fix="Record with the LiDAR sensor of the back camera.",
        )
    return _Metadata(
        path, size, depth if min(depth) > 0 else None, poses, (fx, fy, cx, cy), pinholes
    )


def _numbers(content: Any, columns: int) -> Float64[np.ndarray, "N C"]:
    """Parse a list of lists of numbers, or one such list."""
    table = np.array(content, np.float64)
    if table.size and table.shape[-1] != columns:
        raise ValueError(f"lists of {table.shape[-1]} numbers, not {columns}")
    return table.reshape(-1, columns)


def _choose(
    metadata: _Metadata, sizes: Mapping[str, int], where: Path
) -> tuple[list[str], list[Finding]]:
    """Return the photographs to use in order of their numbers, and findings about the others.

    ``sizes`` are bytes of the files beside the photographs, and of these, by name.
    """
    found = {_number(name): name for name in sorted(sizes) if _PHOTOGRAPH.fullmatch(name)}
    posed = [number for number in sorted(found) if number < len(metadata.poses)]
    if not posed:
        raise SceneNotFoundError(
            f"photographs 0.jpg, 1.jpg, ... of Record3D in {where}",
            found=f"none with one of the {len(metadata.poses):,} poses" if found else "none",
            fix=_FIX,
        )
    findings = []
    if len(posed) < max(len(found), len(metadata.poses)):
        numbers = f"{counted(len(found), 'photograph')} and {counted(len(metadata.poses), 'pose')}"
        used = f"the {len(posed):,} of the same number {agreeing(len(posed), 'is', 'are')} used"
        findings.append(Finding("missing-poses", f"There are {numbers} in {where}: {used}."))
    quats, centers = metadata.poses[posed, :4], metadata.poses[posed, 4:]
    usable = np.isfinite(metadata.poses[posed]).all(axis=1) & quats.any(axis=1)
    known = [number for number, ok in zip(posed, usable.tolist(), strict=True) if ok]
    rotations = np.array([rotation_from_quat(quat[[3, 0, 1, 2]]) for quat in quats[usable]])
    # Of photographs with the same content, the sharper one has more bytes: among 5 to 20 successive
    # ones of a recording, ranks agree with those by the Laplacian's variance (Spearman 0.93-0.97).
    details = np.array([sizes[found[number]] for number in known], np.float64)
    focal = metadata.pinhole[0] / metadata.size[0]
    chosen = choose_photographs(details, rotations.reshape(-1, 3, 3), centers[usable], focal)
    if len(chosen) < len(known):
        findings.append(chosen_finding(f"{len(chosen):,} of {len(known):,} photographs"))
        posed = [known[index] for index in chosen.tolist()]
    return [found[number] for number in posed], findings


# Archives -----------------------------------------------------------------------------------------

_Read = Callable[[str], bytes | None]
"""Returns the content of a member by its name in ``rgbd``; None if there is none."""


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    with translate_read_errors(path):
        file = open_file(path)
    with file:
        with translate_errors(path, "an archive of Record3D"):
            archive = zipfile.ZipFile(file)
        with archive:
            yield archive


def _read_packed(path: Path, archive: zipfile.ZipFile, name: str) -> bytes | None:
    member = f"{_R3D.photographs}/{name}"
    with translate_errors(path, f"an archive of Record3D, with {member} undamaged"):
        return _read_within(archive, member) if member in archive.NameToInfo else None


def _read_within(archive: zipfile.ZipFile, member: str) -> bytes:
    info = archive.NameToInfo[member]
    if info.file_size > _MAX_MEMBER:
        raise ValueError(f"{info.file_size:,} bytes of {member}")
    return archive.read(info)


def _read_member(root: Path, name: str) -> bytes | None:
    path = root / _R3D.depths / name
    return read_bytes(path) if path.is_file() else None


def _unpack(
    source: Path,
    facts: str,
    metadata: _Metadata,
    names: Sequence[str],
    read: _Read,
    *,
    photographs: bool,
) -> tuple[Path, list[Finding]]:
    """Extract some photographs and their maps; return the folder, and a finding if maps lack.

    ``facts`` identify the content of the archive ``source``; without ``photographs``, the maps
    alone are extracted.
    """
    lacking = _lacking("lzfse")

    def fill(folder: Path, progress: Progress) -> None:
        places = [folder / each for each in ("rgb", "depth", "confidence")]
        for place in places:
            place.mkdir()
        for i, name in enumerate(names):
            if photographs and (data := read(name)) is not None:
                (places[0] / name).write_bytes(data)
            number = _number(name)
            if not lacking and (data := read(f"{number}.depth")):
                where = f"{number}.depth in {source}"
                np.save(places[1] / f"{number}.npy", _decode(data, "<f4", metadata, where))
                if data := read(f"{number}.conf"):
                    levels = _decode(data, "u1", metadata, f"{number}.conf in {source}")
                    PilImage.fromarray(levels).save(places[2] / f"{number}.png")
            progress(f"extract {source.name}", (i + 1) / len(names))

    folder = extracted(source, (facts, list(names), not lacking, photographs), fill)
    return folder, lacking


def _decode(data: bytes, dtype: str, metadata: _Metadata, where: str) -> np.ndarray:
    """Decompress a map [dh, dw].

    Without a size in the metadata, that with the photographs' aspect ratio is taken.
    """
    with translate_errors(Path(where), "a map compressed by LZFSE", fix=COPY_AGAIN):
        values = np.frombuffer(importlib.import_module("lzfse").decompress(data), dtype)
        width, height = metadata.depth_size or (0, 0)
        if width * height != len(values):
            width = round((len(values) * metadata.size[0] / metadata.size[1]) ** 0.5)
            height = len(values) // max(width, 1)
        if not len(values) or width * height != len(values):
            raise ValueError(f"{len(values):,} values, not {metadata.depth_size}")
        return values.reshape(height, width)
