"""Choose a camera that shows a scene: one of its own, or a synthetic one for a bare cloud.

The *fill* of an image is the number of cells, of a coarse grid over it, that contain a point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Camera
from splatseed.errors import PointCloudError
from splatseed.sampling import strided
from splatseed.scene import Image, Scene


@dataclass(frozen=True)
class ViewpointSettings:
    """Constants of the choice of a camera."""

    max_points: int = 20_000  # considered when choosing a camera
    grid: tuple[int, int] = (16, 12)  # columns and rows of the cells that measure the fill
    core_share: float = 0.6  # of the points, nearest to the median, that a synthetic camera shows
    elevation: float = 28.0  # degrees by which a synthetic camera points downwards
    size: tuple[int, int] = (800, 600)  # px, of a synthetic camera
    focal: float = 900.0  # px, of a synthetic camera


VIEWPOINT = ViewpointSettings()


def look_at(
    eye: Float64[np.ndarray, " 3"], target: Float64[np.ndarray, " 3"], up: Float64[np.ndarray, " 3"]
) -> Float64[np.ndarray, "4 4"]:
    """Return ``cam_from_world`` of an OpenCV camera at ``eye`` that faces ``target``.

    ``up`` points upwards in the image; it must not be parallel to the view direction.
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
    """Return the camera of ``choose_image`` or, for a bare cloud, a synthetic one.

    The synthetic camera shows the points nearest to the median from an elevation of 28 degrees.
    The vertical is the direction in which the cloud is flattest, upwards where it thins out.
    """
    image = choose_image(scene)
    return _synthetic_camera(_finite_sample(scene)) if image is None else image.camera


def choose_image(scene: Scene) -> Image | None:
    """Return the image with the largest fill; of equals, the one with most points.

    An image's points are its features with a 3D point or, in a scene without features, a sample of
    the points that project into its frame. The number of points alone would favour close-ups of
    rich texture. In a scene without points the middle image is chosen; without images the result is
    None.

    Raises:
        PointCloudError: The scene has neither images nor points.
    """
    if scene.images and not scene.points.finite.any():
        return scene.images[len(scene.images) // 2]
    xyz = _finite_sample(scene)
    features = [image.observations for image in scene.images]
    sizes = [(image.intrinsics.width, image.intrinsics.height) for image in scene.images]
    seen = [each.xy[each.point_ids >= 0] if each else np.empty((0, 2)) for each in features]
    if not any(len(uv) for uv in seen):
        seen = [image.camera.project(xyz)[0] for image in scene.images]
        sizes = [(image.camera.width, image.camera.height) for image in scene.images]
    fill = [_fill(uv / size) for size, uv in zip(sizes, seen, strict=True)]
    return scene.images[fill.index(max(fill))] if fill else None


def _fill(places: Float64[np.ndarray, "M 2"]) -> tuple[int, int]:
    """Return the fill of the frame and the number of points in it, by places in it from 0 to 1."""
    cells = places * VIEWPOINT.grid
    inside = ((cells >= 0) & (cells < VIEWPOINT.grid)).all(axis=1)  # NaN compares false
    column, row = cells[inside].astype(np.int64).T
    return len(np.unique(row * VIEWPOINT.grid[0] + column)), int(inside.sum())


def _finite_sample(scene: Scene) -> Float64[np.ndarray, "N 3"]:
    """Return at most ``max_points`` finite points, evenly spaced in the file's order."""
    xyz = scene.points.xyz[scene.points.finite].astype(np.float64)
    if len(xyz) == 0:
        raise PointCloudError(
            "at least one finite point",
            found=f"none among {len(scene.points)}",
            fix="Check that the cloud was read correctly.",
        )
    return strided(xyz, VIEWPOINT.max_points)


def _synthetic_camera(xyz: Float64[np.ndarray, "N 3"]) -> Camera:
    center = np.median(xyz, axis=0)
    radius = np.linalg.norm(xyz - center, axis=1)
    core = xyz[radius <= np.quantile(radius, VIEWPOINT.core_share)]
    _, axes = np.linalg.eigh(np.cov((core - center).T) if len(core) > 1 else np.eye(3))
    up = _thin_side(core - center, axes[:, 0])
    backward = _thin_side(core - center, axes[:, 1])
    tilt = np.radians(VIEWPOINT.elevation)
    toward_eye = np.cos(tilt) * backward + np.sin(tilt) * up
    (width, height), extent = VIEWPOINT.size, np.linalg.norm(core - center, axis=1).max() or 1.0
    focal = VIEWPOINT.focal
    eye = center + toward_eye * extent * 2.0 * focal / width
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Camera(K, width, height, look_at(eye, center, up))


def _thin_side(
    offsets: Float64[np.ndarray, "N 3"], axis: Float64[np.ndarray, " 3"]
) -> Float64[np.ndarray, " 3"]:
    """Return the axis pointing to the cloud's longer tail, usually away from the ground."""
    low, middle, high = np.percentile(offsets @ axis, [5, 50, 95])
    return axis if high - middle >= middle - low else -axis
