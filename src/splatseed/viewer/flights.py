"""Flights through a model: camera paths, their frames, and the video.

Notation: a path is a sequence of views without pixels, one per frame, in world coordinates with
OpenCV axes. Promise: equal input gives equal paths; a video appears complete or not at all.
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

from splatseed.camera import Camera
from splatseed.errors import OutputError, ParameterError, SceneFormatError
from splatseed.io.camera_records import OPENCV_FROM_OPENGL
from splatseed.io.files import read_bytes, read_json, translate_errors
from splatseed.io.staging import atomic_file
from splatseed.photos.upright import up_direction
from splatseed.photos.view import View
from splatseed.photos.viewpoint import look_at
from splatseed.photos.visibility import points_in_image
from splatseed.progress import Progress, silent
from splatseed.projection import camera_centers, scaled
from splatseed.requirements import require
from splatseed.sampling import evenly_spaced
from splatseed.similarity import Similarity
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.pictures import to_uint8
from splatseed.splat.rendering import ModelRenderer
from splatseed.text import counted, numeric_order
from splatseed.viewer.models import CORE, pinhole_view, split_picture
from splatseed.viewer.page import depth_picture, nearness, value_range

MAX_FRAMES = 100_000
DEFAULT_SIZE = (960, 720)
"""Width and height without cameras."""
DEPTH_SAMPLES = 7  # frames of a path that are rendered to find its depth range
QUALITY = 8  # imageio-ffmpeg's, 0 to 10


@dataclasses.dataclass(frozen=True)
class _Smoothing:
    sigma: float = 0.02  # of the Gaussian filter along the path, relative to its length
    samples_per_frame: int = 8
    max_detour: float = 2.0  # length in order of names over that by nearest neighbours


@dataclasses.dataclass(frozen=True)
class _PathCheck:
    num_views: int = 60  # sampled from the path
    num_gaussians: int = 5000  # sampled from the model
    min_seen: float = 0.002  # fraction of these that half of the views must see
    max_distance: float = 10.0  # median, relative to the cameras' extent


SMOOTHING, CHECK = _Smoothing(), _PathCheck()

# Paths --------------------------------------------------------------------------------------------


def smooth_path(views: Sequence[View], frames: int, size: tuple[int, int]) -> list[View]:
    """Make a path of ``frames`` views past all cameras, at constant speed."""
    ordered = _in_order(views)
    poses = _poses(ordered)
    reach = np.linalg.norm(poses[:, :3] - poses[:, :3].mean(axis=0), axis=1).max() if ordered else 0
    if len(ordered) < 2 or not reach > 0:
        raise ParameterError(
            "cameras in at least two places, for a path through them",
            found=counted(len(views), "camera"),
            fix="Pass `path='orbit'`, or `path=FILE`.",
        )
    # Turning by one radian counts as moving by the extent of the cameras.
    steps = np.linalg.norm(np.diff(poses * np.r_[np.ones(3) / reach, np.ones(6)], axis=0), axis=1)
    fine = _resampled(poses, steps, SMOOTHING.samples_per_frame * frames + 1)
    fine = gaussian_filter1d(fine, SMOOTHING.sigma * len(fine), axis=0, mode="nearest")
    # Constant speed: by the distance covered, not by the cameras passed.
    moved = np.linalg.norm(np.diff(fine[:, :3], axis=0), axis=1)
    even = _resampled(fine, moved + 1e-9 * reach, frames)
    poses_at = [(pose[:3], pose[:3] + pose[3:6], pose[6:]) for pose in even]
    return _posed(_lens(views, size), poses_at)


def orbit(
    views: Sequence[View], gaussians: Gaussians, frames: int, size: tuple[int, int]
) -> list[View]:
    """Circle the cameras' focus at their distance and height; without cameras, the model."""
    if len(views) > 1:
        centers = _poses(views)[:, :3]
        focus, lens = focus_point(views), _lens(views, size)
    else:
        focus = np.median(gaussians.means.astype(np.float64), axis=0)
        reach = np.quantile(np.linalg.norm(gaussians.means - focus, axis=1), CORE)
        if not reach > 0:  # all are in one place
            reach = max(1.0, 3 * np.exp(gaussians.scales.astype(np.float64).max()))
        centers = (focus + reach * np.array([2.0, -0.7, 0.0]))[None]
        lens = _lens([pinhole_view(DEFAULT_SIZE, 2 * np.arctan(0.5), np.eye(4))], size)
    up = up_direction([view.camera for view in views if len(views) > 1])
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


def focus_point(views: Sequence[View]) -> Float64[np.ndarray, " 3"]:
    """Point nearest to the axes of all cameras; a point ahead of them if these are parallel."""
    centers, axes, _ = np.split(_poses(views), 3, axis=1)
    # Distance of x to axis i: |A_i (x - c_i)| with A_i = I - a_i a_i'; sum A_i x = sum A_i c_i
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    middle, spread = centers.mean(axis=0), np.linalg.norm(centers - centers.mean(axis=0), axis=1)
    # A weak pull towards a point ahead determines what the axes leave open.
    ahead = middle + axes.mean(axis=0) * (spread.max() or 1.0)
    weight = 1e-2 * len(views)
    normal = across.sum(axis=0) + weight * np.eye(3)
    return np.asarray(
        np.linalg.solve(normal, (across @ centers[..., None]).sum(axis=0)[:, 0] + weight * ahead)
    )


def read_path(
    path: Path, size: tuple[int, int], world: Similarity | None = None
) -> tuple[list[View], float | None]:
    """Read a camera path in nerfstudio's JSON: its views, and its frame rate if it has one.

    ``world`` maps the model's world to the file's; None if they are the same. Fields of view are
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
        frames, kind = content["camera_path"], content.get("camera_type", "perspective")
        if str(kind).lower() != "perspective":
            raise ValueError(f"cameras of type {kind!r}, not 'perspective'")
        for i, frame in enumerate(frames):
            world_from_gl = np.array(frame["camera_to_world"], np.float64).reshape(4, 4)
            fov, rotation = np.radians(float(frame.get("fov", 50))), world_from_gl[:3, :3]
            if not 0 < fov < np.pi:
                raise ValueError(f"camera {i} with a field of view of {frame.get('fov')}")
            skewed = np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3
            if skewed or not np.isfinite(world_from_gl).all():
                raise ValueError(f"camera {i}, whose matrix is no rotation")
            pose = np.linalg.inv(world_from_gl @ OPENCV_FROM_OPENGL)
            views.append(pinhole_view(size, fov, world.inverse.camera(pose) if world else pose))
        if not 0 < len(views) <= MAX_FRAMES:
            raise ValueError(counted(len(views), "camera"))
        return views, float(content["fps"]) if content.get("fps") else None


def size_of_path(path: Path) -> tuple[int, int] | None:
    """Return the width and height that a camera path is made for; None if it has none."""
    with suppress(SceneFormatError, TypeError, KeyError, ValueError, OverflowError):
        content = read_json(path, "a camera path")
        width, height = int(content["render_width"]), int(content["render_height"])
        return (width, height) if width > 0 and height > 0 else None
    return None


def check_path(
    path: Path, views: Sequence[View], gaussians: Gaussians, cameras: Sequence[View]
) -> None:
    """Refuse the path of a file that misses the model or is far from all training cameras."""
    sample = [views[i] for i in evenly_spaced(len(views), CHECK.num_views)]
    xyz = gaussians.means[:: max(1, len(gaussians) // CHECK.num_gaussians)].astype(np.float64)
    seen = [len(points_in_image(view.camera, xyz).depth) / len(xyz) for view in sample]
    lost = np.mean(np.array(seen) < CHECK.min_seen) > 0.5
    if len(cameras) > 1:
        middle = np.median(_poses(cameras)[:, :3], axis=0)
        reach, away = (np.linalg.norm(_poses(v)[:, :3] - middle, axis=1) for v in (cameras, sample))
        lost = lost or np.median(away) > CHECK.max_distance * reach.max() > 0
    if lost:
        raise SceneFormatError(
            f"{path} to show the model",
            found="a path through another world, far away or with next to no Gaussians in sight",
            fix="nerfstudio's paths are in a world of its own: pass the dataparser_transforms.json "
            "of its run as `transform`; to use the path unchanged, pass `transform='none'`.",
        )


def _in_order(views: Sequence[View]) -> list[View]:
    """Sort views by name, as in a walk or video, or by nearest neighbour if names give no path."""
    by_name = sorted(views, key=lambda view: numeric_order(view.name))
    if len(views) < 3:
        return by_name
    centers = _poses(by_name)[:, :3]
    gaps = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    tour, left = [0], set(range(1, len(views)))
    while left:
        tour.append(min(left, key=lambda i: gaps[tour[-1], i]))
        left.remove(tour[-1])
    nearest = sum(gaps[a, b] for a, b in pairwise(tour))
    named = sum(gaps[a, b] for a, b in pairwise(range(len(views))))
    return [by_name[i] for i in tour] if named > SMOOTHING.max_detour * nearest else by_name


def _poses(views: Sequence[View]) -> Float64[np.ndarray, "V 9"]:
    """Centres, forward and up axes of views, which can be averaged."""
    poses = np.array([view.cam_from_world for view in views]).reshape(-1, 4, 4)
    return np.hstack([camera_centers(poses), poses[:, 2, :3], -poses[:, 1, :3]])


def _posed(lens: View, looks: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> list[View]:
    poses = [look_at(*look) for look in looks]
    return [dataclasses.replace(lens.posed(p), name=f"{i}") for i, p in enumerate(poses)]


def _resampled(
    poses: Float64[np.ndarray, "N 9"], steps: Float64[np.ndarray, " N-1"], count: int
) -> Float64[np.ndarray, "M 9"]:
    """Interpolate poses at even distances along a path whose segments have these lengths."""
    distance = np.concatenate([[0.0], np.cumsum(steps)])
    return np.asarray(interp1d(distance, poses, axis=0)(np.linspace(0, 1, count) * distance[-1]))


def _lens(views: Sequence[View], size: tuple[int, int]) -> View:
    """Camera with the median vertical field of view, at another size."""
    view = sorted(views, key=lambda view: view.K[1, 1] / view.height)[len(views) // 2]
    width, height = size
    scale = height / view.height
    K = scaled(view.K, scale)
    K[0, 2] += (width - scale * view.width) / 2
    camera = Camera(K, width, height, view.cam_from_world)
    return dataclasses.replace(view, camera=camera)


# Frames and videos --------------------------------------------------------------------------------


def flight_frames(
    renderers: Sequence[ModelRenderer],
    names: Sequence[str],
    path: Sequence[View],
    *,
    depth: bool = False,
    progress: Progress = silent,
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """Render the frames of a path, of a model or of two side by side with their names."""
    if depth:
        sample = path[:: max(1, len(path) // DEPTH_SAMPLES)]
        limits = value_range(nearness(np.stack([renderers[0].depth(view) for view in sample])))
    for i, view in enumerate(path):
        pictures = [
            depth_picture(r.depth(view), limits) if depth else to_uint8(r.color(view))
            for r in renderers
        ]
        yield pictures[0] if len(pictures) == 1 else split_picture(pictures[0], pictures[1], *names)
        progress("render", (i + 1) / len(path))


def even_size(width: int, height: int, limit: int | None = None) -> tuple[int, int]:
    """Nearest size with even sides, as H.264 needs, and the longer one at most ``limit``."""
    scale = min(1.0, limit / max(width, height)) if limit else 1.0
    width, height = (max(2, 2 * round(scale * side / 2)) for side in (width, height))
    return width, height


def write_video(
    path: Path, frames: Iterable[UInt8[np.ndarray, "H W 3"]], size: tuple[int, int], fps: float
) -> None:
    """Write frames as H.264 to a .mp4, .mkv or .mov; replaces an existing file.

    Width and height of all frames are even.
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
            with closing(writer):  # on errors, too: ffmpeg must end before its file is removed
                writer.send(None)
                for sent, frame in enumerate(frames, 1):  # noqa: B007  (the last number is used)
                    writer.send(np.ascontiguousarray(frame))
            # imageio-ffmpeg does not report whether ffmpeg could write the end of the file.
            written = 0
            with suppress(RuntimeError):
                written, _ = imageio_ffmpeg.count_frames_and_secs(str(partial))
            if written != sent:
                raise RuntimeError(f"{written} of {sent} frames")  # noqa: TRY301
        except (OSError, RuntimeError) as error:  # ffmpeg ended early
            raise OutputError(
                f"{path} to be written",
                found=" ".join(str(error).split())[-160:] or type(error).__name__,
                fix="Check the disk and try again. The incomplete file was removed.",
            ) from None
