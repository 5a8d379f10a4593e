"""Depth maps from the photographs of a scene: choose priors and sources, match, return maps.

Promise: the same scene, settings and seed give the same bytes, whatever the number of threads; a
map holds only depths that independently computed maps of other views confirm.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatseed.depth.alignment import ray_length
from splatseed.depth.stereo.coarse import coarse_stereo, without_tracks
from splatseed.depth.stereo.maps import MIN_POINTS, StereoMap, StereoResult, StereoSettings
from splatseed.depth.stereo.matching import DepthPrior, match_views
from splatseed.depthmap import DepthMap
from splatseed.errors import SceneNotFoundError
from splatseed.io.photograph_checks import with_photographs
from splatseed.photos.loading import load_views
from splatseed.photos.sizes import factor_for_size
from splatseed.photos.sources import choose_sources
from splatseed.photos.view import View
from splatseed.photos.visibility import Visibility, find_visibility
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene
from splatseed.settings import change_settings

MIN_SEEN = 300
"""A scene counts as having no points if half of its images see fewer. Coarse stereo takes two or
three times as long as the rest of stereo, and gives as many known pixels as 800 points an image: of
fern's .49, where 80 points an image give .44 and 8 give .41 (benchmarks/tried.md)."""
CLOSER_SWEEPS = 1
"""PatchMatch iterations on larger photographs: with a second one the same pixels are confirmed, no
more accurately."""
MAP_SAMPLES = 18
"""Rows and columns at which points are sampled from a depth map."""


def stereo_depths(
    scene: Scene,
    settings: StereoSettings | None = None,
    *,
    seed: int = 0,
    progress: Progress = silent,
    **choices: Any,
) -> tuple[StereoMap, ...]:
    """Compute depth, normals and confidence of every photograph of a scene.

    Args:
        scene: A scene with photographs.
        settings: Settings of stereo.
        seed: The same seed gives the same bytes.
        progress: Called with the stage and the fraction done.
        choices: Fields of ``StereoSettings`` that replace those of ``settings``, such as
            ``grid=2``.

    Returns:
        A map per photograph. ``map.points()`` are its points; ``scene.with_depths(maps)`` gives
        them to the method ``depth``.

    Raises:
        ParameterError: A setting is unknown or out of range.
        SceneNotFoundError: There are fewer than two photographs, or than half of the scene's.
        SceneFormatError: A photograph cannot be used.
    """
    settings = change_settings(settings or StereoSettings(), "stereo_depths", choices)
    if len(scene.images) < 2:
        raise SceneNotFoundError(
            "at least two photographs with a pose",
            found=f"{len(scene.images)}",
            fix="Name a scene with photographs: stereo compares them.",
        )
    scene = with_photographs(scene)
    views = load_views(
        scene,
        scene.images,
        data_factor=factor_for_size(scene.images, settings.max_size),
        undistort=True,
        progress=progress,
    )
    return find_stereo(
        views, scene.images, known_visibility(scene), settings, seed, progress
    ).maps()


def find_stereo(
    views: Sequence[View],
    images: Sequence[Image],
    visibility: Visibility,
    settings: StereoSettings,
    seed: int = 0,
    progress: Progress = silent,
    only: Sequence[int] | None = None,
) -> StereoResult:
    """Match photographs with each other.

    Args:
        views: The photographs, at the size to compare.
        images: Their images, in the same order.
        visibility: The points that each image sees, which give its range of depth. If there are
            too few, coarse stereo finds some.
        settings: Settings of stereo.
        seed: The same seed gives the same bytes.
        progress: Called with the stage and the fraction done.
        only: Views that need maps, all by default. Other views are matched only if they may
            confirm these; the bytes do not depend on it.
    """
    if len(visibility.xyz) < MIN_POINTS:
        visibility = coarse_stereo(views, seed, progress)
    seen = [visibility.rows_of(image) for image in images]
    centers = np.stack([image.camera.center for image in images])
    sources = choose_sources(seen, visibility.xyz, centers, settings.num_check_views)
    needed = range(len(views)) if only is None else {*only, *sources[list(only)].ravel().tolist()}
    priors = [
        _prior_from_points(view, visibility.xyz[rows]) if i in needed else None
        for i, (view, rows) in enumerate(zip(views, seen, strict=True))
    ]
    return match_views(views, priors, sources, settings, seed, progress)


def compare_closer(
    coarse: StereoResult, views: Sequence[View], grid: int, seed: int, progress: Progress
) -> StereoResult:
    """Match photographs that were matched at a smaller size before, starting from those planes.

    Args:
        coarse: The result at the smaller size.
        views: The same photographs in the same order, as large or larger.
        grid: Pixels of these between depths.
        seed: The same seed gives the same bytes.
        progress: Called with the stage, as in ``match_views`` with "again", and the fraction done.
    """
    priors = [_prior_from_planes(coarse, i, view) for i, view in enumerate(views)]
    settings = dataclasses.replace(coarse.settings, grid=grid, sweeps=CLOSER_SWEEPS)

    def again(stage: str, fraction: float) -> None:
        progress(f"{stage} again", fraction)

    return match_views(views, priors, coarse.sources, settings, seed, again)


def _prior_from_planes(coarse: StereoResult, i: int, view: View) -> DepthPrior | None:
    """The planes of view i in pixels of the larger photograph; None without any."""
    if not np.isfinite(coarse.costs[i]).any():
        return None
    # Both are whole divisions of the same photograph, so focal lengths have the ratio of sizes.
    ratio = view.K[0, 0] / coarse.views[i].K[0, 0]
    planes = coarse.planes[i].copy()
    planes[1:] /= np.float32(ratio)  # slopes are per pixel
    step = coarse.settings.grid * ratio
    return DepthPrior(np.empty((0, 2)), np.empty(0), coarse.bounds[i], planes, step)


def known_visibility(scene: Scene) -> Visibility:
    """Points that each image sees: from SfM, else sampled from the depth maps, else none.

    Depth of low confidence is sampled, too: a phone's LiDAR is sure of nothing beyond 5 m, and
    without what lies there the range of depths is too small (of a corridor 17% of the pixels were
    confirmed instead of 22%).
    """
    visibility, maps = find_visibility(scene), scene.depths
    if has_enough_points(visibility, scene.images):
        return visibility
    points = [np.empty((0, 3))]
    if maps is not None:
        points += [_map_points(im, maps.read(im.name)) for im in scene.images if im.name in maps]
    return without_tracks(np.concatenate(points))


def has_enough_points(visibility: Visibility, images: Sequence[Image]) -> bool:
    """Whether half of the images see ``MIN_SEEN`` points, which then give ranges of depth."""
    seen = [len(visibility.rows_of(image)) for image in images]
    return bool(seen) and bool(np.median(seen) >= MIN_SEEN)


def _map_points(image: Image, depth: DepthMap) -> Float64[np.ndarray, "N 3"]:
    """World points at a few pixels of a depth map; none of inverse depth, whose scale is open."""
    camera = depth.camera(image.camera)
    row, column = (
        ((np.arange(MAP_SAMPLES) + 0.5) * side / MAP_SAMPLES).astype(np.int64)
        for side in depth.values.shape
    )
    row, column = np.repeat(row, MAP_SAMPLES), np.tile(column, MAP_SAMPLES)
    z = depth.values[row, column].astype(np.float64)
    known = np.isfinite(z) & (z > 0) & (depth.kind != "inverse")
    if depth.kind == "ray":
        z /= ray_length(camera, column, row)
    return camera.unproject(np.stack([column, row], axis=1)[known] + 0.5, z[known])


def _prior_from_points(view: View, xyz: Float64[np.ndarray, "M 3"]) -> DepthPrior | None:
    """Prior from the points that a view sees; None if none is in front of it."""
    uv, z = view.camera.project(xyz)
    front = z > 0
    return DepthPrior.from_points(uv[front], 1.0 / z[front]) if front.any() else None
