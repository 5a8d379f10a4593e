"""Which SfM points each image sees: the reference for aligning depth maps.

Notation: V images, N points; ``xyz`` float64 [M, 3] are the points of one image, in the scene's
world.
Promise: only distinct finite originals take part. A point with a track is seen by the images of the
track. Without tracks, points are projected; where several fall close together in an image, only the
nearest are kept, as the others are probably hidden.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from splatseed.camera import Camera
from splatseed.pointcloud import ORIGINAL
from splatseed.scene import Image, Scene

CELLS = 40
"""Columns and rows of the grid over an image in whose cells points hide each other."""

HIDDEN = 1.1
"""A point this many times as far as the nearest one in its cell counts as hidden."""


class SeenPoints(NamedTuple):
    """Points within an image."""

    uv: Float64[np.ndarray, "M 2"]
    """Where they are, in pixels."""
    z: Float64[np.ndarray, " M"]
    """Their planar depth, scene units."""


def camera_points(camera: Camera, xyz: Float64[np.ndarray, "N 3"]) -> SeenPoints:
    """The world points that lie in front of a camera and within its image."""
    uv, z = camera.project(xyz)
    inside = ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1)  # NaN behind the camera
    return SeenPoints(uv[inside], z[inside])


@dataclass(frozen=True, eq=False)
class Visibility:
    """The points that every image sees.

    Args:
        xyz: The distinct finite originals, float64 [N, 3], scene units.
        point_idx: Rows of ``xyz``, image after image, int64 [T].
        start: Where each image begins in ``point_idx``, by its id.
        count: How many each image sees, by its id.
    """

    xyz: Float64[np.ndarray, "N 3"]
    point_idx: Int64[np.ndarray, " T"]
    start: dict[int, int]
    count: dict[int, int]

    def of(self, image: Image) -> Float64[np.ndarray, "M 3"]:
        """The points an image sees, world positions [M, 3]: by tracks, or else by projection."""
        return np.asarray(self.xyz[self.rows_of(image)])

    def rows_of(self, image: Image) -> Int64[np.ndarray, " M"]:
        """The same as rows of ``xyz``."""
        count = self.count.get(image.image_id, 0)
        if count:
            start = self.start[image.image_id]
            return self.point_idx[start : start + count]
        return _in_front(self.xyz, image.camera)


def find_visibility(scene: Scene) -> Visibility:
    """Compute the points of all images once, to be queried image by image."""
    usable = np.flatnonzero((scene.points.source == ORIGINAL) & scene.points.distinct)
    xyz = scene.points.xyz[usable].astype(np.float64)
    tracks = scene.tracks
    if tracks is None:
        return Visibility(xyz, np.empty(0, np.int64), {}, {})
    row = np.full(len(scene.points), -1)
    row[usable] = np.arange(len(usable))
    point_idx = row[np.repeat(np.arange(len(tracks)), tracks.lengths)]
    good = point_idx >= 0
    image_ids = tracks.image_ids[good]
    if len(image_ids) and image_ids.max() < 1 << 16:
        image_ids = image_ids.astype(np.uint16)  # sorted by radix, ten times as fast
    order = np.argsort(image_ids, kind="stable")
    ids, start, count = np.unique(image_ids[order], return_index=True, return_counts=True)
    return Visibility(
        xyz,
        point_idx[good][order],
        dict(zip(ids.tolist(), start.tolist(), strict=True)),
        dict(zip(ids.tolist(), count.tolist(), strict=True)),
    )


def _in_front(xyz: Float64[np.ndarray, "N 3"], camera: Camera) -> Int64[np.ndarray, " M"]:
    """The rows of the points within the image that no nearby point hides."""
    uv, z = camera.project(xyz)
    size = np.array([camera.width, camera.height])
    inside = np.flatnonzero((z > 0) & ((uv >= 0) & (uv < size)).all(axis=1))
    column, row = (uv[inside] * CELLS / size).astype(np.int64).T
    cell = row * CELLS + column
    nearest = np.full(CELLS * CELLS, np.inf)
    np.minimum.at(nearest, cell, z[inside])
    # A tenth beyond the nearest point of the cell may still be its surface.
    return np.asarray(inside[z[inside] <= HIDDEN * nearest[cell]])
