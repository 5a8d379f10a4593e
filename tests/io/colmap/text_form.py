"""COLMAP's text form with writers: the product only reads it, so tests write it for themselves.

Floats are written with the fewest digits that read back equal.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from splatseed.camera import Intrinsics
from splatseed.io.colmap.model import point_columns
from splatseed.io.colmap.text import read_cameras, read_images, read_points3d
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Tracks

__all__ = [
    "read_cameras",
    "read_images",
    "read_points3d",
    "write_cameras",
    "write_images",
    "write_points3d",
]

_CAMERA_HEADER = "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
_IMAGE_HEADER = (
    "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n# then a line of POINTS2D[] as X Y POINT3D_ID"
)
_POINT_HEADER = "# POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX"


def write_cameras(path: Path, intrinsics: Sequence[Intrinsics]) -> None:
    lines = (
        f"{camera.camera_id} {camera.model} {camera.width} {camera.height} "
        f"{_spaced(map(float, camera.params))}"
        for camera in intrinsics
    )
    _write_lines(path, _CAMERA_HEADER, lines)


def write_images(path: Path, images: Sequence[Image]) -> None:
    _write_lines(path, _IMAGE_HEADER, map(_image_lines, images))


def _image_lines(image: Image) -> str:
    pose = _spaced([*image.quat.tolist(), *image.translation.tolist()])
    head = f"{image.image_id} {pose} {image.intrinsics.camera_id} {image.name}\n"
    if image.observations is None:
        return head
    rows = zip(image.observations.xy.tolist(), image.observations.point_ids.tolist(), strict=True)
    return head + " ".join(f"{x!r} {y!r} {point_id}" for (x, y), point_id in rows)


def write_points3d(path: Path, points: PointCloud, tracks: Tracks | None) -> None:
    """Write a ``points3D.txt``.

    Args:
        path: The file.
        points: The cloud.
        tracks: Ids, float64 positions, errors and tracks of the first ``len(tracks)`` points. The
            others get the ids that follow the largest, error -1 (COLMAP's "unknown") and no track.
            Without it all points do, with ids from 1.

    Raises:
        PointCloudError: There are more tracks than points.
        OSError: The file cannot be written.
    """
    ids, xyz, errors = point_columns(points, tracks)
    heads = zip(ids.tolist(), xyz.tolist(), points.rgb.tolist(), errors.tolist(), strict=True)
    lines = (
        f"{point_id} {_spaced(position)} {_spaced(colour)} {error!r}{track}"
        for (point_id, position, colour, error), track in zip(
            heads, _track_fields(tracks, len(points)), strict=True
        )
    )
    _write_lines(path, _POINT_HEADER, lines)


def _track_fields(tracks: Tracks | None, num_points: int) -> Iterator[str]:
    """What follows the error on each point's line: its track after a space, or nothing."""
    num_tracked = 0
    if tracks is not None:
        num_tracked = len(tracks)
        pairs = np.stack([tracks.image_ids, tracks.point2d_idx], axis=1).ravel().tolist()
        ends = (2 * tracks.offsets).tolist()
        for start, stop in pairwise(ends):
            yield f" {_spaced(pairs[start:stop])}" if stop > start else ""
    for _ in range(num_points - num_tracked):
        yield ""


def _spaced(values: Iterable[float]) -> str:
    return " ".join(map(repr, values))


def _write_lines(path: Path, header: str, lines: Iterable[str]) -> None:
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(f"{header}\n")
        file.writelines(f"{line}\n" for line in lines)
