"""Visibility: which points a camera sees, by projection or by a scene's tracks.

Points are in an image if they lie in front of its camera and within its frame
(``points_in_image``). A scene's tracks say which of its points an image sees; without tracks its
points are projected, and the nearest of each coarse cell hide the others (``find_visibility``).
What a whole cloud hides is found by ``photos.zbuffer``.
Promise: results depend neither on the order of the points nor on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from splatseed.camera import Camera
from splatseed.pointcloud import ORIGINAL
from splatseed.projection import project
from splatseed.scene import Image, Scene

SURFACE = 0.1  # share of a cell's depth up to which a point behind it counts as on its surface
COARSE_GRID = (40, 40)  # rows and columns of the z-buffer for points without tracks


class PointsInImage(NamedTuple):
    """The M of N points that lie in front of a camera and within its image."""

    point_idx: Int64[np.ndarray, " M"]  # among the N points, rising
    uv: Float64[np.ndarray, "M 2"]  # pixels
    depth: Float64[np.ndarray, " M"]

    def select(self, which: Bool[np.ndarray, " M"]) -> PointsInImage:
        """Some of the points."""
        return PointsInImage(*(values[which] for values in self))

    def cells(
        self, camera: Camera, shape: tuple[int, ...]
    ) -> tuple[Int64[np.ndarray, " M"], Int64[np.ndarray, " M"]]:
        """Row and column of each point in a grid of ``shape`` over the image."""
        rows, cols = shape
        per_pixel = np.array([cols / camera.width, rows / camera.height])
        # Rounding may reach the border.
        col, row = np.minimum((self.uv * per_pixel).astype(np.int64), [cols - 1, rows - 1]).T
        return row, col

    def nearest(self, camera: Camera, shape: tuple[int, ...]) -> Float64[np.ndarray, "rows cols"]:
        """A z-buffer: the smallest depth in each cell of a grid; infinite without points."""
        depths = np.full(shape, np.inf)
        np.minimum.at(depths, self.cells(camera, shape), self.depth)
        return depths


def points_in_image(
    camera: Camera, xyz: Float[np.ndarray, "N 3"], *, near: float = 0.0, margin: float = 0.0
) -> PointsInImage:
    """The world points beyond depth ``near`` and within the image.

    ``margin`` extends the image on every side by this share of its size. Points with NaN are in no
    image. For many cameras pass ``np.asfortranarray(xyz, np.float64)``.
    """
    column, row, depth = project(camera.pixels_from_world, xyz)
    low_u, low_v = -margin * camera.width, -margin * camera.height
    inside = (depth > near) & (column >= low_u) & (column < camera.width - low_u)
    inside &= (row >= low_v) & (row < camera.height - low_v)
    index = np.flatnonzero(inside)
    return PointsInImage(index, np.stack([column[index], row[index]], axis=1), depth[index])


@dataclass(frozen=True, eq=False)
class Visibility:
    """The distinct, finite, original points of a scene, and which of them each image sees."""

    xyz: Float64[np.ndarray, "N 3"]
    point_idx: Int64[np.ndarray, " T"]  # rows of ``xyz``, image after image
    start: dict[int, int]  # of each image in ``point_idx``, by its id
    count: dict[int, int]  # of the points that each sees, by its id

    def of(self, image: Image) -> Float64[np.ndarray, "M 3"]:
        """World positions of the points that an image sees."""
        return np.asarray(self.xyz[self.rows_of(image)])

    def rows_of(self, image: Image) -> Int64[np.ndarray, " M"]:
        """The points that an image sees, as rows of ``xyz``: by tracks, else by projection."""
        count = self.count.get(image.image_id, 0)
        if count:
            start = self.start[image.image_id]
            return self.point_idx[start : start + count]
        points = points_in_image(image.camera, self.xyz)
        nearest = points.nearest(image.camera, COARSE_GRID)[points.cells(image.camera, COARSE_GRID)]
        seen: Int64[np.ndarray, " M"] = points.point_idx[points.depth <= nearest * (1 + SURFACE)]
        return seen


def find_visibility(scene: Scene) -> Visibility:
    """Sort a scene's tracks by image, so that the points of each image can be looked up."""
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
