"""Paths past the cameras of a scene, for flights through a model.

Notation: a path is a sequence of views without pixels, one per frame, in world coordinates with
OpenCV axes. Promise: equal input gives equal paths.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import interp1d
from scipy.ndimage import gaussian_filter1d

from splatseed.camera import Camera
from splatseed.errors import ParameterError
from splatseed.findings import Finding
from splatseed.photos.upright import up_direction
from splatseed.photos.view import View
from splatseed.photos.viewpoint import look_at
from splatseed.photos.visibility import points_in_image
from splatseed.progress import Note, silent_note
from splatseed.projection import camera_centers, scaled
from splatseed.sampling import evenly_spaced
from splatseed.splat.gaussians import Gaussians
from splatseed.text import counted, numeric_order
from splatseed.viewer.models import CORE, pinhole_view

DEFAULT_SIZE = (960, 720)
"""Width and height without cameras."""


@dataclasses.dataclass(frozen=True)
class _Smoothing:
    sigma: float = 0.02  # of the Gaussian filter along the path, relative to its length
    samples_per_frame: int = 8
    max_detour: float = 2.0  # length in order of names over that by nearest neighbours


@dataclasses.dataclass(frozen=True)
class _Orbit:
    max_gap: float = (
        90.0  # degrees between neighbouring cameras around the focus; a larger one cuts
    )
    trimmed: float = 0.05  # share of the cameras at either end of an arc
    min_swing: float = 3.0  # degrees to either side
    one_way: float = 0.7  # length of the mean axis above which cameras look one way
    near: float = 0.1  # quantile of the depths of Gaussians at which the scene begins
    num_views: int = 20  # and Gaussians that are sampled for it
    num_gaussians: int = 5000


SMOOTHING, ORBIT = _Smoothing(), _Orbit()


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
    views: Sequence[View],
    gaussians: Gaussians,
    frames: int,
    size: tuple[int, int],
    *,
    up: Float64[np.ndarray, " 3"] | None = None,
    note: Note = silent_note,
) -> list[View]:
    """Circle the cameras' focus at their distance and height; without cameras, the model.

    Where cameras look at it from some sides only, the path swings there and back, with a note.
    ``up`` is by default that of the cameras.
    """
    if len(views) > 1:
        centers = _poses(views)[:, :3]
        focus, lens = orbit_center(views, gaussians), _lens(views, size)
    else:
        focus = np.median(gaussians.means.astype(np.float64), axis=0)
        reach = np.quantile(np.linalg.norm(gaussians.means - focus, axis=1), CORE)
        if not reach > 0:  # all are in one place
            reach = max(1.0, 3 * np.exp(gaussians.scales.astype(np.float64).max()))
        centers = (focus + reach * np.array([2.0, -0.7, 0.0]))[None]
        lens = _lens([pinhole_view(DEFAULT_SIZE, 2 * np.arctan(0.5), np.eye(4))], size)
    if up is None or len(views) < 2:
        up = up_direction([view.camera for view in views if len(views) > 1])
    offsets = centers - focus
    # Distances from the focus along up, and around it.
    heights = offsets @ up
    radius = np.median(np.linalg.norm(offsets - heights[:, None] * up, axis=1))
    first = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    first /= np.linalg.norm(first)
    side = np.cross(up, first)
    angles = 2 * np.pi * np.arange(frames) / frames
    arc = _arc(np.arctan2(offsets @ side, offsets @ first)) if len(views) > 1 else None
    if arc is not None:
        angles = arc[0] + arc[1] * np.sin(angles)
        text = f"The cameras look at their focus from {np.degrees(2 * arc[1]):.0f} degrees around "
        text += "it, so the orbit swings there and back."
        note(Finding("orbit-swings", text, "info"))
    eyes = [
        focus + np.median(heights) * up + radius * (np.cos(angle) * first + np.sin(angle) * side)
        for angle in angles
    ]
    return _posed(lens, [(eye, focus, up) for eye in eyes])


def orbit_center(views: Sequence[View], gaussians: Gaussians) -> Float64[np.ndarray, " 3"]:
    """Focus of the cameras; if these look one way and it is not in the scene, a point ahead."""
    focus, (centers, axes, _) = focus_point(views), np.split(_poses(views), 3, axis=1)
    forward = axes.mean(axis=0)
    if np.linalg.norm(forward) < ORBIT.one_way:
        return focus
    xyz = gaussians.means[:: max(1, len(gaussians) // ORBIT.num_gaussians)].astype(np.float64)
    sample = [views[i] for i in evenly_spaced(len(views), ORBIT.num_views)]
    depths = np.concatenate([points_in_image(view.camera, xyz).depth for view in sample])
    if not len(depths):
        return focus
    near, middle = np.quantile(depths, (ORBIT.near, 0.5))
    if np.median(((focus - centers) * axes).sum(axis=1)) >= near:
        return focus
    return np.asarray(centers.mean(axis=0) + middle * forward / np.linalg.norm(forward))


def _arc(azimuths: Float64[np.ndarray, " V"]) -> tuple[float, float] | None:
    """Middle and half width of the directions from which cameras look; None if from all sides."""
    ordered = np.sort(azimuths)
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    cuts = np.flatnonzero(gaps > np.radians(ORBIT.max_gap))
    if not len(cuts):
        return None
    turned = np.roll(ordered, -cuts[0] - 1)
    turned[len(ordered) - cuts[0] - 1 :] += 2 * np.pi
    runs = np.split(turned, np.flatnonzero(np.diff(turned) > np.radians(ORBIT.max_gap)) + 1)
    low, high = np.quantile(max(runs, key=len), (ORBIT.trimmed, 1 - ORBIT.trimmed))
    return (low + high) / 2, max((high - low) / 2, np.radians(ORBIT.min_swing))


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
    return [dataclasses.replace(lens.posed(p), name=f"{i:05}.png") for i, p in enumerate(poses)]


def _resampled(
    poses: Float64[np.ndarray, "N 9"], steps: Float64[np.ndarray, " N-1"], count: int
) -> Float64[np.ndarray, "M 9"]:
    """Interpolate poses at even distances along a path whose segments have these lengths."""
    distance = np.concatenate([[0.0], np.cumsum(steps)])
    return np.asarray(interp1d(distance, poses, axis=0)(np.linspace(0, 1, count) * distance[-1]))


def _lens(views: Sequence[View], size: tuple[int, int]) -> View:
    """Camera with the median vertical field of view, at another size."""
    view = sorted(views, key=lambda view: view.K[1, 1] / view.height)[len(views) // 2]
    return at_size(view, size)


def at_size(view: View, size: tuple[int, int]) -> View:
    """Return a view at another size, with the same vertical field of view."""
    width, height = size
    scale = height / view.height
    K = scaled(view.K, scale)
    K[0, 2] += (width - scale * view.width) / 2
    camera = Camera(K, width, height, view.cam_from_world)
    return dataclasses.replace(view, camera=camera)
