"""Which points each image sees, and the camera from which to look at a scene.

Only distinct finite originals are seen. A point with a track is seen by the images of the track.
Without tracks, points are projected; where several fall close together in an image, only the
nearest are kept, as the others are probably hidden. The camera chosen is one of the scene's own if
it has any, else one made up from the cloud alone. An image's *fill* is how much of it has points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from splatseed.camera import Camera
from splatseed.errors import PointCloudError
from splatseed.pointcloud import ORIGINAL
from splatseed.scene import Image, Scene

CELLS = 40  # columns and rows of the grid over an image in whose cells points hide each other
HIDDEN = 1.1  # a point this many times as far as the nearest one in its cell counts as hidden


class SeenPoints(NamedTuple):
    """Points within an image: pixels, and planar depths."""

    uv: Float64[np.ndarray, "M 2"]
    z: Float64[np.ndarray, " M"]


def camera_points(camera: Camera, xyz: Float64[np.ndarray, "N 3"]) -> SeenPoints:
    """The world points that lie in front of a camera and within its image."""
    uv, z = camera.project(xyz)
    inside = ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1)  # NaN behind the camera
    return SeenPoints(uv[inside], z[inside])


@dataclass(frozen=True, eq=False)
class Visibility:
    """The points that every image sees."""

    xyz: Float64[np.ndarray, "N 3"]  # the distinct finite originals
    point_idx: Int64[np.ndarray, " T"]  # rows of ``xyz``, image after image
    start: dict[int, int]  # where each image begins in ``point_idx``, by its id
    count: dict[int, int]  # how many each sees, by its id

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
    # a tenth beyond the nearest point of the cell may still be its surface.
    return np.asarray(inside[z[inside] <= HIDDEN * nearest[cell]])


SAMPLE = 20_000  # points considered when choosing a camera
FRAME_CELLS = (16, 12)  # columns and rows of the grid by which a frame's fill is measured
CORE_SHARE = 0.6  # share of the points, those nearest to the median, that a made-up camera frames
ELEVATION, MADE_UP_SIZE, MADE_UP_FOCAL = 28.0, (800, 600), 900.0
"""Degrees by which a made-up camera looks down, and its size and focal length in pixels."""


def look_at(
    eye: Float64[np.ndarray, " 3"], target: Float64[np.ndarray, " 3"], up: Float64[np.ndarray, " 3"]
) -> Float64[np.ndarray, "4 4"]:
    """``cam_from_world`` [4, 4] of an OpenCV camera at ``eye`` that sees ``target`` upright.

    ``up`` is the direction that is upward in the image, not along the view.
    """
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = rotation
    cam_from_world[:3, 3] = -rotation @ eye
    return cam_from_world


def choose_camera(scene: Scene) -> Camera:
    """The camera of ``choose_image``; for a bare cloud, one made up to frame its densest part.

    It takes the direction in which the cloud is flattest as the vertical, upward where the cloud
    thins out, and looks down on the points nearest the median at 28 degrees.
    """
    image = choose_image(scene)
    return _made_up_camera(_finite_sample(scene)) if image is None else image.camera


def choose_image(scene: Scene) -> Image | None:
    """The image whose points fill most of its frame; among equals, the one with the most points.

    An image's points are its features with a 3D point if the scene has features at all, else those
    of a sample that project into its frame. The mere number of points would favour close-ups of the
    richest texture. A scene without points, such as an RGB-D capture, gives the image in the middle
    of its list; one without images gives None, or PointCloudError if it has no points, either.
    """
    if scene.images and not scene.points.finite.any():
        return scene.images[len(scene.images) // 2]
    xyz = _finite_sample(scene)
    features = [image.observations for image in scene.images]
    seen = [each.xy[each.point_ids >= 0] if each else np.empty((0, 2)) for each in features]
    if not any(len(uv) for uv in seen):
        seen = [image.camera.project(xyz)[0] for image in scene.images]
    fill = [_fill(image.camera, uv) for image, uv in zip(scene.images, seen, strict=True)]
    return scene.images[fill.index(max(fill))] if fill else None


def _fill(camera: Camera, uv: Float64[np.ndarray, "M 2"]) -> tuple[int, int]:
    """How many cells of a grid over the frame hold a point, and how many points it has."""
    cells = uv / [camera.width, camera.height] * FRAME_CELLS
    inside = ((cells >= 0) & (cells < FRAME_CELLS)).all(axis=1)  # NaN compares false
    column, row = cells[inside].astype(np.int64).T
    return len(np.unique(row * FRAME_CELLS[0] + column)), int(inside.sum())


def _finite_sample(scene: Scene) -> Float64[np.ndarray, "N 3"]:
    """At most ``SAMPLE`` finite points, evenly spaced in the file's order."""
    xyz = scene.points.xyz[scene.points.finite].astype(np.float64)
    if len(xyz) == 0:
        raise PointCloudError(
            "at least one finite point to look at",
            found=f"none among {len(scene.points)}",
            fix="Check that the cloud was read correctly.",
        )
    return np.asarray(xyz[:: -(-len(xyz) // SAMPLE)])


def _made_up_camera(xyz: Float64[np.ndarray, "N 3"]) -> Camera:
    center = np.median(xyz, axis=0)
    radius = np.linalg.norm(xyz - center, axis=1)
    core = xyz[radius <= np.quantile(radius, CORE_SHARE)]
    _, axes = np.linalg.eigh(np.cov((core - center).T) if len(core) > 1 else np.eye(3))
    up = _thin_side(core - center, axes[:, 0])
    backward = _thin_side(core - center, axes[:, 1])
    tilt = np.radians(ELEVATION)
    toward_eye = np.cos(tilt) * backward + np.sin(tilt) * up
    (width, height), extent = MADE_UP_SIZE, np.linalg.norm(core - center, axis=1).max() or 1.0
    eye = center + toward_eye * extent * 2.0 * MADE_UP_FOCAL / width
    K = np.array([[MADE_UP_FOCAL, 0, width / 2], [0, MADE_UP_FOCAL, height / 2], [0, 0, 1.0]])
    return Camera(K, width, height, look_at(eye, center, up))


def _thin_side(
    offsets: Float64[np.ndarray, "N 3"], axis: Float64[np.ndarray, " 3"]
) -> Float64[np.ndarray, " 3"]:
    """The axis, directed to the cloud's longer tail: usually away from the ground."""
    low, middle, high = np.percentile(offsets @ axis, [5, 50, 95])
    return axis if high - middle >= middle - low else -axis
