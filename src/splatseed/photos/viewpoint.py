"""Viewpoints: poses that look at a target, and the camera from which to show a scene.

The camera is one of the scene's own if it has any, otherwise one placed by the cloud alone. An
image's *fill* is the number of cells of a coarse grid over it that hold a point.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Camera
from splatseed.errors import PointCloudError
from splatseed.scene import Image, Scene

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
