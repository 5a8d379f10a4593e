"""Writing a scene that every 3D Gaussian Splatting trainer loads unchanged.

Notation: *originals* are the points that were read, with their tracks; a *layout* is the set of
files a trainer looks for. Promise: the folder appears whole or not at all; its points are finite
and distinct; all its point files agree; originals keep their float64 positions and tracks; point
ids are 1..N in the cloud's order; other attributes of points are in ``seeds.npz``, which no trainer
but ours looks for. docs/formats.md says which trainer needs which file.
"""

from __future__ import annotations

import platform
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePath
from typing import BinaryIO, Literal

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.errors import OutputError, PointCloudError
from splatseed.io.cleaning import clean_scene
from splatseed.io.colmap.binary import point_rows, set_point_count
from splatseed.io.layouts import bring, write_colmap, write_transforms
from splatseed.io.ply import ply_header, ply_rows
from splatseed.io.seeds import SEEDS, PositionDigest, write_origins
from splatseed.io.staging import MANIFEST, output_folder, write_json
from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.scene import Scene

Layout = Literal["colmap", "transforms"]
Piece = tuple[Float32[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]

_KIND = "write_scene"
"""The kind of an output whose provenance names no verb."""
_PACKAGES = ("splatseed", "numpy", "scipy", "numba")


@dataclass(frozen=True)
class PointStream:
    """Points that follow those of a scene a piece at a time: more than memory holds.

    Args:
        num_original: How many of them come from the input; they come first.
        num_new: How many were made.
        code: ``PointCloud.source`` of the new ones.
        pieces: Gives positions and colours, in order.
        files: The input's files, which the output must stay apart from.
        left_out: Rows of the input that are not finite, and that repeat a position.
    """

    num_original: int
    num_new: int
    code: int
    pieces: Callable[[], Iterator[Piece]]
    files: tuple[Path, ...] = ()
    left_out: tuple[int, int] = (0, 0)

    def __len__(self) -> int:
        return self.num_original + self.num_new


@dataclass(frozen=True)
class WriteReport:
    """What was written.

    Args:
        path: The output folder.
        layout: Which set of files it holds.
        num_points: Points written.
        num_original: How many of them were in the input.
        dropped_nonfinite: Points left out, on reading or here, because a coordinate is not finite.
        dropped_duplicates: Likewise, because an earlier one has the same position.
        files: Paths inside the folder; an image folder is named, not listed.
        notes: What the user should know, one sentence each.
    """

    path: Path
    layout: Layout
    num_points: int
    num_original: int
    dropped_nonfinite: int
    dropped_duplicates: int
    files: tuple[str, ...]
    notes: tuple[str, ...]


def write_scene(
    scene: Scene,
    path: str | Path,
    *,
    format: Literal["auto", "colmap", "transforms"] = "auto",  # noqa: A002  (the user's word)
    overwrite: bool = False,
    copy_images: bool = False,
    provenance: Mapping[str, object] | None = None,
    stream: PointStream | None = None,
    require_points: bool = True,
) -> WriteReport:
    """Write a scene folder for training.

    Args:
        scene: What to write; originals first in its cloud.
        path: The folder to make.
        format: The layout; ``auto`` takes the one that was read, and COLMAP's for a bare PLY, an
            RGB-D capture or a scene made in memory.
        overwrite: Whether an earlier output of splatseed may be replaced.
        copy_images: Copy the image folders instead of linking them.
        provenance: How the points were made, for ``splatseed.json``.
        stream: Points that follow those of the scene, more than memory holds.
        require_points: Whether a scene without any point is refused.

    Returns:
        What was written.

    Raises:
        OutputError: The folder is taken, protected or cannot be written, or the layout cannot hold
            the scene.
        PointCloudError: No point is finite, or there is none although ``require_points``.
    """
    path, layout, made = Path(path), _choose_layout(scene, format), dict(provenance or {})
    clean = clean_scene(scene)  # a scene from load_scene is clean already
    required = require_points or bool(len(scene.points))
    if required and not len(clean.points) and not (stream and len(stream)):
        raise PointCloudError(
            "at least one point with finite coordinates",
            found=f"{len(scene.points)} points, none of them finite",
            fix="Check the cloud.",
        )
    more = stream or PointStream(0, 0, ORIGINAL, lambda: iter(()))
    inputs = (*(scene.source.inputs if scene.source else ()), *more.files)
    kind = str(made.get("command", _KIND))
    with output_folder(path, kind=kind, overwrite=overwrite, protect=inputs) as folder:
        write_layout = write_colmap if layout == "colmap" else write_transforms
        notes, image_sources = write_layout(clean, folder)
        if stream is not None:
            _append_points(folder, clean.points, stream)
        linked = bring(image_sources, folder, copy=copy_images)
        tops = {PurePath(each).parts[0] for each in linked}
        own = [each for each in folder.rglob("*") if each.relative_to(folder).parts[0] not in tops]
        files = [each.relative_to(folder).as_posix() for each in own if not each.is_dir()]
        report = WriteReport(
            path=path,
            layout=layout,
            num_points=len(clean.points) + len(more),
            num_original=clean.points.num_original + more.num_original,
            dropped_nonfinite=clean.left_out.non_finite + more.left_out[0],
            dropped_duplicates=clean.left_out.duplicates + more.left_out[1],
            files=tuple(sorted([*files, *linked, MANIFEST])),
            notes=tuple(notes),
        )
        facts = {
            "source": _source_path(scene),
            **made,
            "format": layout,
            "num_points": report.num_points,
            "num_original": report.num_original,
            "num_new": report.num_points - report.num_original,
            "dropped_nonfinite": report.dropped_nonfinite,
            "dropped_duplicates": report.dropped_duplicates,
            "notes": report.notes,
            "versions": {"python": platform.python_version(), **_versions()},
        }
        write_json(folder / MANIFEST, facts)
    return report


def _choose_layout(scene: Scene, wanted: str) -> Layout:
    if wanted == "auto":
        read = scene.source.format if scene.source else None
        wanted = "transforms" if read == "transforms" else "colmap"
    if wanted == "transforms" and not scene.images:
        raise OutputError(
            "a scene with images for transforms.json",
            found="none",
            fix="Write the COLMAP layout (--format colmap).",
        )
    if wanted == "colmap":
        return "colmap"
    if wanted == "transforms":
        return "transforms"
    raise OutputError(
        "a format of auto, colmap or transforms", found=repr(wanted), fix="Choose one of them."
    )


def _append_points(folder: Path, first: PointCloud, stream: PointStream) -> None:
    """Append points to the point files of a scene that was written with the first ones alone.

    The files are, byte for byte, those of the same points in memory.
    """
    total, digest = len(first) + len(stream), PositionDigest(first.xyz)
    transforms = folder / "sparse_pc.ply"
    model = folder / "sparse" / "0" / "points3D.bin"
    ply = transforms if transforms.exists() else model.with_suffix(".ply")
    with ExitStack() as files:
        rows = files.enter_context(ply.open("wb"))
        rows.write(ply_header(total))
        rows.write(ply_rows(first.xyz, first.rgb))
        records: BinaryIO | None = None
        if model.exists():
            set_point_count(model, total)
            records = files.enter_context(model.open("ab"))
        written = len(first)
        for xyz, rgb in stream.pieces():
            digest.add(xyz)
            rows.write(ply_rows(xyz, rgb))
            if records is not None:
                records.write(point_rows(written + 1, xyz, rgb))
            written += len(xyz)
    assert written == total  # noqa: S101  (the headers say so)
    if ply == transforms:
        shutil.copyfile(ply, folder / "pointcloud.ply")
    (folder / SEEDS).unlink(missing_ok=True)
    runs = [(ORIGINAL, len(first) + stream.num_original), (stream.code, stream.num_new)]
    write_origins(folder, digest.bytes(), runs)


def _source_path(scene: Scene) -> str | None:
    source = scene.source
    if source is None:
        return None
    if source.format == "ply":
        return str(source.points_path)
    return str(source.transforms_path or source.root)


def _versions() -> dict[str, str]:
    versions = {}
    for package in _PACKAGES:
        with suppress(PackageNotFoundError):  # splatseed itself may not be installed
            versions[package] = version(package)
    return versions
