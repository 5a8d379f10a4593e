"""Writing a scene that every 3D Gaussian Splatting trainer loads unchanged.

Notation: *originals* are the points that were read, with their tracks; a *layout* is the set of
files a trainer looks for. Promise: the folder appears whole or not at all; its points are finite
and distinct; all its point files agree; originals keep their float64 positions and tracks; point
ids are 1..N in the cloud's order; other attributes of points are in ``seeds.npz``, which no trainer
but ours looks for. docs/formats.md says which trainer needs which file.
"""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePath
from typing import Literal

from splatseed.errors import OutputError, PointCloudError
from splatseed.io.cloud import clean_scene
from splatseed.io.output.image_folders import bring
from splatseed.io.output.layouts import write_colmap, write_transforms
from splatseed.io.output.point_stream import PointStream, append_points
from splatseed.io.staging import MANIFEST, output_folder, write_json
from splatseed.pointcloud import ORIGINAL
from splatseed.scene import Scene

Layout = Literal["colmap", "transforms"]

_KIND = "write_scene"
"""The kind of an output whose provenance names no verb."""
_PACKAGES = ("splatseed", "numpy", "scipy", "numba")


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
    layout = _choose_layout(scene, format)
    clean = clean_scene(scene)  # a scene from load_scene is clean already
    required = require_points or bool(len(scene.points))
    if required and not len(clean.points) and not (stream and len(stream)):
        raise PointCloudError(
            "at least one point with finite coordinates",
            found=f"{len(scene.points)} points, none of them finite",
            fix="Check the cloud.",
        )
    path = Path(path)
    kind = str((provenance or {}).get("command", _KIND))
    more = stream or PointStream(0, 0, ORIGINAL, lambda: iter(()))
    inputs = (*(scene.source.inputs if scene.source else ()), *more.files)
    with output_folder(path, kind=kind, overwrite=overwrite, protect=inputs) as folder:
        write_layout = write_colmap if layout == "colmap" else write_transforms
        notes, image_sources = write_layout(clean, folder)
        if stream is not None:
            append_points(folder, clean.points, stream)
        linked = bring(image_sources, folder, copy=copy_images)
        report = WriteReport(
            path=path,
            layout=layout,
            num_points=len(clean.points) + len(more),
            num_original=clean.points.num_original + more.num_original,
            dropped_nonfinite=clean.left_out.non_finite + more.left_out[0],
            dropped_duplicates=clean.left_out.duplicates + more.left_out[1],
            files=_listing(folder, linked),
            notes=tuple(notes),
        )
        write_json(folder / MANIFEST, _manifest(scene, report, provenance or {}))
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


def _listing(folder: Path, linked: Sequence[str]) -> tuple[str, ...]:
    """The files written, and the image folders brought in."""
    own = [
        file.relative_to(folder).as_posix()
        for top in folder.iterdir()
        if not any(PurePath(each).parts[0] == top.name for each in linked)
        for file in ([top] if not top.is_dir() else top.rglob("*"))
        if not file.is_dir()
    ]
    return tuple(sorted([*own, *linked, MANIFEST]))


def _manifest(
    scene: Scene, report: WriteReport, provenance: Mapping[str, object]
) -> dict[str, object]:
    return {
        "source": _source_path(scene),
        **provenance,
        "format": report.layout,
        "num_points": report.num_points,
        "num_original": report.num_original,
        "num_new": report.num_points - report.num_original,
        "dropped_nonfinite": report.dropped_nonfinite,
        "dropped_duplicates": report.dropped_duplicates,
        "notes": report.notes,
        "versions": {"python": platform.python_version(), **_versions()},
    }


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
