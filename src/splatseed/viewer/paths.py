"""Camera paths: smooth ones through a scene's cameras, orbits, and nerfstudio's files.

Notation: a path is a sequence of views without pixels, one per frame, in world coordinates with
OpenCV axes; a *stop* is a camera that a path is made from. Promise: equal input gives equal paths;
cameras far from all others are left out.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import gaussian_filter1d

from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io.files import read_bytes
from splatseed.literal import counted, told
from splatseed.similarity import Similarity
from splatseed.splat.gaussians import Gaussians, stray_views
from splatseed.viewer.renderer import CORE, resized
from splatseed.views.view import View
from splatseed.views.viewpoint import look_at

SMOOTHING = 0.02
"""Standard deviation of the filter along a path, as a fraction of the path's length."""
FINE = 8
"""Samples per frame at which a path is smoothed."""
DETOUR = 2.0
"""Names give no order if following them takes this many times the way by nearest neighbours."""
MOST_FRAMES = 100_000
MADE_UP_SIZE = (960, 720)
LOOKS, LOOKED_AT = 60, 5000
"""Views and Gaussians sampled to decide whether a path misses the model."""
LEAST_SEEN, HALF = 0.002, 0.5
"""A view that sees a smaller share of the Gaussians misses them; more than half must not."""
FAR_AWAY = 10.0
"""A path is far away beyond this many times the cameras' extent."""
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def smooth_path(views: Sequence[View], frames: int, size: tuple[int, int]) -> list[View]:
    """A path past all cameras, at even speed.

    Args:
        views: The cameras, in the order in which the photographs may have been taken.
        frames: How many views to return.
        size: Their width and height.

    Raises:
        ParameterError: There are fewer than two cameras, or all are in one place.
    """
    strays = stray_views(views)
    stops = _in_order([view for view in views if view.name not in strays])
    poses = np.array([_pose_vector(view) for view in stops])
    reach = np.linalg.norm(poses[:, :3] - poses[:, :3].mean(axis=0), axis=1).max() if stops else 0
    if len(stops) < 2 or not reach > 0:
        raise ParameterError(
            "cameras in at least two places, for a path through them",
            found=counted(len(views), "camera"),
            fix="Pass --orbit, or --path FILE.",
        )
    # Turning by one radian counts as moving by the extent of the cameras.
    steps = np.linalg.norm(np.diff(poses * np.r_[np.ones(3) / reach, np.ones(6)], axis=0), axis=1)
    places = np.linspace(0, 1, FINE * frames + 1)
    fine = _interpolated(poses, steps, places)
    # Then at even speed: by the distance covered, not by the stops passed.
    fine = gaussian_filter1d(fine, SMOOTHING * len(places), axis=0, mode="nearest")
    moved = np.linalg.norm(np.diff(fine[:, :3], axis=0), axis=1)
    even = _interpolated(fine, moved + 1e-9 * reach, np.linspace(0, 1, frames))
    model = resized(_median_camera(views), *size)
    return [_view_of_vector(model, pose, i) for i, pose in enumerate(even)]


def orbit(
    views: Sequence[View], gaussians: Gaussians, frames: int, size: tuple[int, int]
) -> list[View]:
    """Circle what the cameras look at, at their distance and height; without cameras, the model.

    Args:
        views: The cameras, or none.
        gaussians: The model.
        frames: How many views to return.
        size: Their width and height.
    """
    if len(views) > 1:
        centers = _centers(views)
        up = -np.mean([view.cam_from_world[1, :3] for view in views], axis=0)
        focus, model = focus_of(views), _median_camera(views)
    else:
        focus = np.median(gaussians.means.astype(np.float64), axis=0)
        reach = np.quantile(np.linalg.norm(gaussians.means - focus, axis=1), CORE)
        up = np.array([0.0, -1.0, 0.0])  # as in the world of most captures
        centers, model = (focus + reach * np.array([2.0, -0.7, 0.0]))[None], _made_up()
    up = up / np.linalg.norm(up)
    offsets = centers - focus
    # Distances from the focus along up, and around it.
    heights = offsets @ up
    radius = np.median(np.linalg.norm(offsets - heights[:, None] * up, axis=1))
    first = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    first /= np.linalg.norm(first)
    side, model = np.cross(up, first), resized(model, *size)
    eyes = [
        focus + np.median(heights) * up + radius * (np.cos(angle) * first + np.sin(angle) * side)
        for angle in 2 * np.pi * np.arange(frames) / frames
    ]
    return [
        dataclasses.replace(model, name=f"{i}", cam_from_world=look_at(eye, focus, up))
        for i, eye in enumerate(eyes)
    ]


def focus_of(views: Sequence[View]) -> Float64[np.ndarray, " 3"]:
    """The point nearest to all cameras' axes; a point ahead of them if these are parallel."""
    centers = _centers(views)
    axes = np.array([view.cam_from_world[2, :3] for view in views])
    # Distance of x to axis i: |A_i (x - c_i)| with A_i = I - a_i a_i'; sum A_i x = sum A_i c_i
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    middle, spread = centers.mean(axis=0), np.linalg.norm(centers - centers.mean(axis=0), axis=1)
    # A weak pull towards a point ahead decides where the axes do not.
    ahead = middle + axes.mean(axis=0) * (spread.max() or 1.0)
    weight = 1e-2 * len(views)
    normal = across.sum(axis=0) + weight * np.eye(3)
    return np.asarray(
        np.linalg.solve(normal, (across @ centers[..., None]).sum(axis=0)[:, 0] + weight * ahead)
    )


def path_of_file(path: Path, size: tuple[int, int]) -> tuple[list[View], float | None]:
    """The views of a camera path in nerfstudio's JSON, and its frame rate if the file gives one.

    Args:
        path: The file; its cameras are assumed to be in the model's world.
        size: Width and height of the views; fields of view are vertical, in degrees.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is not a camera path.
    """
    try:
        content = json.loads(read_bytes(path))
        frames = content["camera_path"]
        views = [_view_of_frame(frame, size, i) for i, frame in enumerate(frames)]
        fps = float(content["fps"]) if content.get("fps") else None
    except SceneNotFoundError:
        raise
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise _no_path(path, told(error)) from None
    if not 0 < len(views) <= MOST_FRAMES:
        raise _no_path(path, counted(len(views), "camera"))
    return views, fps


def views_from(world: Similarity, views: Sequence[View]) -> list[View]:
    """Views of another world, transformed into the model's.

    Args:
        world: From the model's world to the views' world.
        views: The views in that world.
    """
    back = world.inverse
    return [
        dataclasses.replace(view, cam_from_world=back.camera(view.cam_from_world)) for view in views
    ]


def check_path(
    path: Path, views: Sequence[View], gaussians: Gaussians, cameras: Sequence[View]
) -> None:
    """Refuse a path that leads through another world: far from all cameras, or past the model.

    Args:
        path: Its file.
        views: Its cameras.
        gaussians: The model.
        cameras: The cameras that the model was trained from, or none.

    Raises:
        SceneFormatError: Most of the views see next to nothing, or are out of reach.
    """
    some = [views[i] for i in np.linspace(0, len(views) - 1, min(len(views), LOOKS)).astype(int)]
    xyz = gaussians.means[:: max(1, len(gaussians) // LOOKED_AT)].astype(np.float64)
    seen = np.array([_share_seen(view, xyz) for view in some])
    found = ""
    if np.mean(seen < LEAST_SEEN) > HALF:
        found = "next to none of them in most of its pictures"
    elif len(cameras) > 1:
        known, asked = _centers(cameras), _centers(some)
        middle = np.median(known, axis=0)
        reach = np.linalg.norm(known - middle, axis=1).max()
        if np.median(np.linalg.norm(asked - middle, axis=1)) > FAR_AWAY * reach > 0:
            found = "cameras far from all that the model was trained from"
    if found:
        raise SceneFormatError(
            f"{path} to show the Gaussians",
            found=f"{found}: a path through another world",
            fix="nerfstudio's paths are in a world of its own: name the dataparser_transforms.json "
            "of its run with --transform; to follow the path as it is, pass --transform none.",
        )


def _share_seen(view: View, xyz: Float64[np.ndarray, "N 3"]) -> float:
    """The share of the points that the view sees."""
    cam = xyz @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
    u, v, depth = view.K @ cam.T
    inside = (u >= 0) & (u < view.width * depth) & (v >= 0) & (v < view.height * depth)
    return float(inside.mean())


def _centers(views: Sequence[View]) -> Float64[np.ndarray, "N 3"]:
    return np.array([_pose_vector(view)[:3] for view in views])


def _no_path(path: Path, found: str) -> SceneFormatError:
    return SceneFormatError(
        f"{path} to be a camera path as nerfstudio's viewer writes it: "
        "camera_path, with camera_to_world and fov",
        found=found[:120],
        fix="Export the path again.",
    )


def _view_of_frame(frame: dict[str, Any], size: tuple[int, int], i: int) -> View:
    world_from_gl = np.array(frame["camera_to_world"], np.float64).reshape(4, 4)
    fov = np.radians(float(frame.get("fov", 50)))
    rotation = world_from_gl[:3, :3]
    if not np.isfinite(world_from_gl).all() or not 0 < fov < np.pi:
        raise ValueError(f"camera {i} with a field of view of {frame.get('fov')}")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        raise ValueError(f"camera {i}, whose matrix is no rotation")
    cam_from_world = np.linalg.inv(world_from_gl @ OPENCV_FROM_OPENGL)
    width, height = size
    focal = height / 2 / np.tan(fov / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return View(f"{i}", np.empty((0, 0, 3), np.uint8), K, width, height, cam_from_world)


def _in_order(views: Sequence[View]) -> list[View]:
    """Views sorted by name, as in a walk or video; by nearest neighbour if names give no order."""
    by_name = sorted(views, key=lambda view: view.name)
    if len(views) < 3:
        return by_name
    centers = _centers(by_name)
    gaps = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    at, tour = 0, [0]
    left = set(range(1, len(views)))
    while left:
        at = min(left, key=lambda each: gaps[tour[-1], each])
        tour.append(at)
        left.remove(at)
    walked = sum(gaps[a, b] for a, b in pairwise(tour))
    named = sum(gaps[a, b] for a, b in pairwise(range(len(views))))
    return [by_name[i] for i in tour] if named > DETOUR * walked else by_name


def _pose_vector(view: View) -> Float64[np.ndarray, " 9"]:
    """Centre, forward and up: quantities that can be averaged."""
    rotation, translation = view.cam_from_world[:3, :3], view.cam_from_world[:3, 3]
    return np.concatenate([-rotation.T @ translation, rotation[2], -rotation[1]])


def _view_of_vector(model: View, pose: Float64[np.ndarray, " 9"], i: int) -> View:
    eye, forward, up = pose[:3], pose[3:6], pose[6:]
    return dataclasses.replace(model, name=f"{i}", cam_from_world=look_at(eye, eye + forward, up))


def _interpolated(
    poses: Float64[np.ndarray, "N 9"],
    steps: Float64[np.ndarray, " N-1"],
    at: Float64[np.ndarray, " M"],
) -> Float64[np.ndarray, "M 9"]:
    """Poses at fractions in [0, 1] of a path whose segments have these lengths."""
    way = np.concatenate([[0.0], np.cumsum(steps)])
    place = at * way[-1]
    return np.stack([np.interp(place, way, column) for column in poses.T], axis=1)


def _median_camera(views: Sequence[View]) -> View:
    """A camera with the median lens."""
    focals = [view.K[1, 1] / view.height for view in views]
    return views[int(np.argsort(focals)[len(focals) // 2])]


def _made_up() -> View:
    width, height = MADE_UP_SIZE
    K = np.array([[height, 0, width / 2], [0, height, height / 2], [0, 0, 1.0]])
    return View("made up", np.empty((0, 0, 3), np.uint8), K, width, height, np.eye(4))
