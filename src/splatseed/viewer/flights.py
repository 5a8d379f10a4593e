"""Flights through a model: camera paths, their frames, and the video of these.

Notation: a path is a sequence of views without pixels, one per frame, in world coordinates with
OpenCV axes; a *stop* is a camera that a path is made from. Promise: equal input gives equal paths;
a video appears whole or not at all.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from scipy.interpolate import interp1d
from scipy.ndimage import gaussian_filter1d

from splatseed.errors import OutputError, ParameterError, SceneFormatError
from splatseed.io.files import read_bytes, translate_errors
from splatseed.io.staging import atomic_file
from splatseed.photos.view import View
from splatseed.photos.viewpoint import look_at
from splatseed.progress import Progress, silent
from splatseed.requirements import require
from splatseed.similarity import Similarity
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.rendering import ModelRenderer, as_bytes
from splatseed.text import counted
from splatseed.viewer.models import CORE, pinhole_view, split_picture
from splatseed.viewer.page import depth_picture, nearness, usual_range

SMOOTHING, FINE = 0.02, 8
"""Standard deviation of the filter along a path, as a fraction of its length; samples a frame."""
DETOUR = 2.0
"""Names give no order if following them takes this many times the way by nearest neighbours."""
MOST_FRAMES = 100_000
MADE_UP_SIZE = (960, 720)
LOOKS, LOOKED_AT, LEAST_SEEN = 60, 5000, 0.002
"""Views and Gaussians sampled to decide whether a path misses the model: one that sees a smaller
share of the Gaussians does, and more than half must not."""
CANCELLED = 1e-6
"""Length of a mean up direction below which the cameras' cancel."""
FAR_AWAY = 10.0
"""A path is far away beyond this many times the cameras' extent."""
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
DEPTH_SAMPLES = 7  # frames of a path that are rendered to find its depth range
QUALITY = 8  # imageio-ffmpeg's, 0 to 10

# Paths --------------------------------------------------------------------------------------------


def smooth_path(views: Sequence[View], frames: int, size: tuple[int, int]) -> list[View]:
    """A path of so many frames past all cameras, at even speed.

    Raises:
        ParameterError: There are fewer than two cameras, or all are in one place.
    """
    ordered = _in_order(views)
    poses = _poses(ordered)
    reach = np.linalg.norm(poses[:, :3] - poses[:, :3].mean(axis=0), axis=1).max() if ordered else 0
    if len(ordered) < 2 or not reach > 0:
        raise ParameterError(
            "cameras in at least two places, for a path through them",
            found=counted(len(views), "camera"),
            fix="Pass --path orbit, or --path FILE.",
        )
    # Turning by one radian counts as moving by the extent of the cameras.
    steps = np.linalg.norm(np.diff(poses * np.r_[np.ones(3) / reach, np.ones(6)], axis=0), axis=1)
    fine = _resampled(poses, steps, FINE * frames + 1)
    # Then at even speed: by the distance covered, not by the stops passed.
    fine = gaussian_filter1d(fine, SMOOTHING * len(fine), axis=0, mode="nearest")
    moved = np.linalg.norm(np.diff(fine[:, :3], axis=0), axis=1)
    even = _resampled(fine, moved + 1e-9 * reach, frames)
    stops = [(pose[:3], pose[:3] + pose[3:6], pose[6:]) for pose in even]
    return _posed(_lens(views, size), stops)


def orbit(
    views: Sequence[View], gaussians: Gaussians, frames: int, size: tuple[int, int]
) -> list[View]:
    """Circle what the cameras look at, at their distance and height; without cameras, the model."""
    if len(views) > 1:
        centers, _, ups = np.split(_poses(views), 3, axis=1)
        up, focus, lens = ups.mean(axis=0), focus_of(views), _lens(views, size)
    else:
        focus = np.median(gaussians.means.astype(np.float64), axis=0)
        reach = np.quantile(np.linalg.norm(gaussians.means - focus, axis=1), CORE)
        if not reach > 0:  # all are in one place
            reach = max(1.0, 3 * np.exp(gaussians.scales.astype(np.float64).max()))
        up = np.zeros(3)
        centers = (focus + reach * np.array([2.0, -0.7, 0.0]))[None]
        lens = _lens([pinhole_view(MADE_UP_SIZE, 2 * np.arctan(0.5), np.eye(4))], size)
    up = upward(up)
    offsets = centers - focus
    # Distances from the focus along up, and around it.
    heights = offsets @ up
    radius = np.median(np.linalg.norm(offsets - heights[:, None] * up, axis=1))
    first = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    first /= np.linalg.norm(first)
    side = np.cross(up, first)
    eyes = [
        focus + np.median(heights) * up + radius * (np.cos(angle) * first + np.sin(angle) * side)
        for angle in 2 * np.pi * np.arange(frames) / frames
    ]
    return _posed(lens, [(eye, focus, up) for eye in eyes])


def upward(up: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 3"]:
    """A mean of up directions as a unit vector; where they cancel, most captures' up."""
    length = np.linalg.norm(up)
    return up / length if length > CANCELLED else np.array([0.0, -1.0, 0.0])


def focus_of(views: Sequence[View]) -> Float64[np.ndarray, " 3"]:
    """The point nearest to all cameras' axes; a point ahead of them if these are parallel."""
    centers, axes, _ = np.split(_poses(views), 3, axis=1)
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


def path_of_file(
    path: Path, size: tuple[int, int], world: Similarity | None = None
) -> tuple[list[View], float | None]:
    """The views of a camera path in nerfstudio's JSON, and its frame rate if the file gives one.

    ``world`` is from the model's world to the file's, None if they are one. Fields of view are
    vertical, in degrees.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is not a camera path.
    """
    with translate_errors(
        path,
        "a camera path as nerfstudio's viewer writes it: camera_path, with camera_to_world and fov",
        fix="Export the path again.",
    ):
        content, views = json.loads(read_bytes(path)), []
        for i, frame in enumerate(content["camera_path"]):
            world_from_gl = np.array(frame["camera_to_world"], np.float64).reshape(4, 4)
            fov, rotation = np.radians(float(frame.get("fov", 50))), world_from_gl[:3, :3]
            if not 0 < fov < np.pi:
                raise ValueError(f"camera {i} with a field of view of {frame.get('fov')}")
            skewed = np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3
            if skewed or not np.isfinite(world_from_gl).all():
                raise ValueError(f"camera {i}, whose matrix is no rotation")
            pose = np.linalg.inv(world_from_gl @ OPENCV_FROM_OPENGL)
            views.append(pinhole_view(size, fov, world.inverse.camera(pose) if world else pose))
        if not 0 < len(views) <= MOST_FRAMES:
            raise ValueError(counted(len(views), "camera"))
        return views, float(content["fps"]) if content.get("fps") else None


def check_path(
    path: Path, views: Sequence[View], gaussians: Gaussians, cameras: Sequence[View]
) -> None:
    """Refuse a path, of a file, that leads far from all training cameras, or past the model.

    Raises:
        SceneFormatError: Most of the views see next to nothing, or are out of reach.
    """
    some = [views[i] for i in np.linspace(0, len(views) - 1, min(len(views), LOOKS)).astype(int)]
    xyz = gaussians.means[:: max(1, len(gaussians) // LOOKED_AT)].astype(np.float64)
    seen = []
    for view in some:
        u, v, depth = view.K @ (xyz @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]).T
        inside = (u >= 0) & (u < view.width * depth) & (v >= 0) & (v < view.height * depth)
        seen.append(inside.mean())
    lost = np.mean(np.array(seen) < LEAST_SEEN) > 0.5
    if len(cameras) > 1:
        middle = np.median(_poses(cameras)[:, :3], axis=0)
        reach, away = (np.linalg.norm(_poses(v)[:, :3] - middle, axis=1) for v in (cameras, some))
        lost = lost or np.median(away) > FAR_AWAY * reach.max() > 0
    if lost:
        raise SceneFormatError(
            f"{path} to lead past the model",
            found="a path through another world, far away or with next to no Gaussians in sight",
            fix="nerfstudio's paths are in a world of its own: name the dataparser_transforms.json "
            "of its run with --transform; to follow the path as it is, pass --transform none.",
        )


def _in_order(views: Sequence[View]) -> list[View]:
    """Views sorted by name, as in a walk or video; by nearest neighbour if names give no order."""
    by_name = sorted(views, key=lambda view: view.name)
    if len(views) < 3:
        return by_name
    centers = _poses(by_name)[:, :3]
    gaps = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    tour, left = [0], set(range(1, len(views)))
    while left:
        tour.append(min(left, key=lambda each: gaps[tour[-1], each]))
        left.remove(tour[-1])
    walked = sum(gaps[a, b] for a, b in pairwise(tour))
    named = sum(gaps[a, b] for a, b in pairwise(range(len(views))))
    return [by_name[i] for i in tour] if named > DETOUR * walked else by_name


def _poses(views: Sequence[View]) -> Float64[np.ndarray, "V 9"]:
    """Centres, forward and up axes: quantities that can be averaged."""
    poses = np.array([view.cam_from_world for view in views]).reshape(-1, 4, 4)
    centers = -np.einsum("vij,vi->vj", poses[:, :3, :3], poses[:, :3, 3])
    return np.hstack([centers, poses[:, 2, :3], -poses[:, 1, :3]])


def _posed(lens: View, stops: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> list[View]:
    """Views from some places to targets, with their directions up."""
    poses = [look_at(*stop) for stop in stops]
    return [dataclasses.replace(lens, name=f"{i}", cam_from_world=p) for i, p in enumerate(poses)]


def _resampled(
    poses: Float64[np.ndarray, "N 9"], steps: Float64[np.ndarray, " N-1"], count: int
) -> Float64[np.ndarray, "M 9"]:
    """Poses at even distances along a path whose segments have these lengths."""
    way = np.concatenate([[0.0], np.cumsum(steps)])
    return np.asarray(interp1d(way, poses, axis=0)(np.linspace(0, 1, count) * way[-1]))


def _lens(views: Sequence[View], size: tuple[int, int]) -> View:
    """A camera with the median vertical field of view, and another picture size."""
    view = sorted(views, key=lambda view: view.K[1, 1] / view.height)[len(views) // 2]
    width, height = size
    scale = height / view.height
    K = np.diag([scale, scale, 1.0]) @ view.K
    K[0, 2] += (width - scale * view.width) / 2
    return dataclasses.replace(view, K=K, width=width, height=height)


# Frames and videos --------------------------------------------------------------------------------


def flight_frames(
    renderers: Sequence[ModelRenderer],
    names: Sequence[str],
    path: Sequence[View],
    *,
    depth: bool = False,
    progress: Progress = silent,
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """The frames of a path: of one model, or of two side by side with their names."""
    if depth:
        some = path[:: max(1, len(path) // DEPTH_SAMPLES)]
        limits = usual_range(nearness(np.stack([renderers[0].depth(view) for view in some])))
    for i, view in enumerate(path):
        pictures = [
            depth_picture(each.depth(view), limits) if depth else as_bytes(each.color(view))
            for each in renderers
        ]
        yield pictures[0] if len(pictures) == 1 else split_picture(pictures[0], pictures[1], *names)
        progress("render", (i + 1) / len(path))


def even_size(width: int, height: int, most: int | None = None) -> tuple[int, int]:
    """The nearest size that H.264 allows, both sides even, the longer one at most ``most``."""
    scale = min(1.0, most / max(width, height)) if most else 1.0
    width, height = (max(2, 2 * round(scale * side / 2)) for side in (width, height))
    return width, height


def write_video(
    path: Path, frames: Iterable[UInt8[np.ndarray, "H W 3"]], size: tuple[int, int], fps: float
) -> None:
    """Write frames as H.264 by imageio-ffmpeg's ffmpeg to a .mp4, .mkv or .mov; replaces a file.

    Width and height, of all frames, are even.

    Raises:
        MissingDependencyError: imageio-ffmpeg is absent.
        OutputError: The video cannot be written.
    """
    require("imageio_ffmpeg")
    import imageio_ffmpeg  # noqa: PLC0415  (of the extra view)

    with atomic_file(path) as partial:
        writer = imageio_ffmpeg.write_frames(
            str(partial), size, fps=fps, quality=QUALITY, macro_block_size=2,
            ffmpeg_log_level="error", output_params=["-movflags", "+faststart"],
        )  # fmt: skip
        sent = 0
        try:
            with closing(writer):  # also when stopped: ffmpeg must end before its file is removed
                writer.send(None)
                for sent, frame in enumerate(frames, 1):  # noqa: B007  (the last number counts)
                    writer.send(np.ascontiguousarray(frame))
            # imageio-ffmpeg does not tell whether ffmpeg could write the end of the file.
            whole = 0
            with suppress(RuntimeError):
                whole, _ = imageio_ffmpeg.count_frames_and_secs(str(partial))
            if whole != sent:
                raise RuntimeError(f"{whole} of {sent} frames")  # noqa: TRY301
        except (OSError, RuntimeError) as error:  # ffmpeg ended early
            raise OutputError(
                f"{path} to be written",
                found=" ".join(str(error).split())[-160:] or type(error).__name__,
                fix="Check the disk and try again. Nothing half-written was left behind.",
            ) from None
