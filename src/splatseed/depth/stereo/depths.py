"""Depth maps from photographs alone: views are compared with each other, then their maps are.

Notation: V views of a scene. A scene that has too few points takes some from its depth maps, or
from *coarse stereo*: stereo on copies about ``SMALL`` pixels wide, in two steps: a few views over
every depth, then all views over the depths seen by those few. Promise: the same scene, settings and
seed give the same bytes, whatever the number of threads; a depth is kept, and a point made, only
where other views' independently computed maps agree.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from splatseed.camera import Camera
from splatseed.depth.stereo.fusion import block_means, fuse
from splatseed.depth.stereo.maps import StereoResult
from splatseed.depth.stereo.matching import Hints, hints_from, match_views
from splatseed.depth.stereo.settings import TOO_FEW, StereoSettings
from splatseed.depthmap import DepthMap
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene
from splatseed.views.pairs import choose_by_pose, choose_sources
from splatseed.views.view import View
from splatseed.views.visibility import Visibility, find_visibility

LEAST_SEEN = 300
"""A scene counts as having no points if half of its images see fewer. Coarse stereo takes two or
three times as long as what follows, and as many pixels become known as from 800 points an image: of
fern's .49, where 80 points an image give .44 and 8 give .41 (benchmarks/stereo)."""
SMALL = 200
"""Longer side of a small photograph, in pixels."""
LOOK = StereoSettings(grid=2, sweeps=6, tolerance=0.03, max_cost=0.4)
CELL = 4.0
"""Pixels of the small photographs between points."""
LOOKED_AT = 24
"""Number of views compared first, to find the range of depths."""
GOOD = 0.15
"""Highest cost of a pixel that counts in that first comparison."""
LEAST_MOVE = 0.2
"""Parallax in pixels at the farthest depth tried first."""
AROUND = 3.0
"""The second search reaches this many times beyond the nearest and farthest tenth."""
MOST_POINTS = 30_000
"""Points kept: pairs of views need no more to be chosen."""
SAMPLES = 18
"""Rows and columns at which a depth map is sampled."""


def known_visibility(scene: Scene) -> Visibility:
    """The points that each image sees: from SfM, else sampled from depth maps, else none."""
    visibility, maps = find_visibility(scene), scene.depths
    if enough_points(visibility, scene.images):
        return visibility
    known = [image for image in scene.images if maps is not None and image.name in maps]
    places = [_places(image, maps.read(image.name)) for image in known if maps is not None]
    return _unseen(np.concatenate([np.empty((0, 3)), *places]))


def enough_points(visibility: Visibility, images: Sequence[Image]) -> bool:
    """Whether depth can be searched around points: half of the images see ``LEAST_SEEN``."""
    seen = [len(visibility.rows_of(image)) for image in images]
    return bool(seen) and bool(np.median(seen) >= LEAST_SEEN)


def coarse_stereo(views: Sequence[View], seed: int, progress: Progress) -> Visibility:
    """Points that small copies of photographs confirm.

    Args:
        views: The photographs, two at least.
        seed: The same seed gives the same points.
        progress: Called with the stage and the fraction done.
    """
    small = [_small(view) for view in views]
    # A few views, compared with neighbours chosen by pose, show which depths occur.
    spread = _spread_of_depth(small, seed, progress)
    # All views are compared with those that see such depths at a good angle.
    xyz, seen = _imagined_points(small, spread)
    centers = np.stack([view.camera.center for view in small])
    sources = choose_sources(seen, xyz, centers, LOOK.num_witnesses)
    # ``spread`` holds inverse depths, so low is far and high is near.
    hints = [_between(low / AROUND, high * AROUND) for low, _, high in spread]
    stereo = match_views(small, hints, sources, LOOK, seed, progress)
    return _unseen(fuse(stereo, CELL).xyz.astype(np.float64))


def _places(image: Image, depth: DepthMap) -> Float64[np.ndarray, "N 3"]:
    """World points at a few pixels of a map."""
    camera = depth.camera(image.camera)
    row, column = (
        ((np.arange(SAMPLES) + 0.5) * side / SAMPLES).astype(np.int64)
        for side in depth.values.shape
    )
    row, column = (each.ravel() for each in np.meshgrid(row, column, indexing="ij"))
    z = depth.values[row, column].astype(np.float64)
    known = np.isfinite(z) & (z > 0) & (depth.kind != "inverse")
    uv = np.stack([column, row], axis=1)[known] + 0.5
    z = z[known]
    if depth.kind == "ray":
        rays = np.concatenate([uv, np.ones((len(uv), 1))], axis=1) @ np.linalg.inv(camera.K).T
        # distance along the ray / |ray|, for rays of unit z, is planar depth
        z /= np.linalg.norm(rays, axis=1)
    return camera.unproject(uv, z)


def _unseen(xyz: Float64[np.ndarray, "N 3"]) -> Visibility:
    """A subset of points whose visibility is unknown."""
    every = max(1, -(-len(xyz) // MOST_POINTS))
    return Visibility(xyz[::every], np.empty(0, np.int64), {}, {})


def _small(view: View) -> View:
    """A view downsampled by a whole factor."""
    factor = max(1, round(max(view.width, view.height) / SMALL))
    image = block_means(view.photograph, factor)
    K = np.diag([1 / factor, 1 / factor, 1.0]) @ view.K
    mask = None
    if view.mask is not None:
        mask = block_means(view.mask[..., None].astype(np.uint8), factor)[..., 0] > 0
    return View(view.name, image, K, image.shape[1], image.shape[0], view.cam_from_world, mask)


def _between(low: float, high: float) -> Hints:
    """Hints for a view whose depth is only known to lie between bounds."""
    return Hints(np.empty((0, 2)), np.empty(0), np.array([low, high], np.float32))


def _spread_of_depth(
    views: Sequence[View], seed: int, progress: Progress
) -> Float64[np.ndarray, "V 3"]:
    """Inverse depths of each view at the 10th, 50th and 90th percentiles of its pixels."""
    sources = choose_by_pose(np.stack([view.cam_from_world for view in views]), LOOK.num_sources)
    looked = np.unique(np.linspace(0, len(views) - 1, LOOKED_AT).round().astype(np.int64))
    hints: list[Hints | None] = [None] * len(views)
    for i in looked:
        hints[i] = any_depth(views, int(i), sources[i])
    stereo = match_views(views, hints, sources, LOOK, seed, progress)
    good = [stereo.planes[i][0][stereo.costs[i] < GOOD] for i in looked]
    told = np.array([np.quantile(w, [0.1, 0.5, 0.9]) if len(w) else [np.nan] * 3 for w in good])
    if np.isnan(told).all():
        return np.ones((len(views), 3))
    told = np.where(np.isnan(told), np.nanmedian(told, axis=0), told)
    nearest = np.abs(np.arange(len(views))[:, None] - looked).argmin(axis=1)
    return np.asarray(told[nearest])


def any_depth(views: Sequence[View], i: int, sources: Int64[np.ndarray, " K"]) -> Hints | None:
    """Hints from the depth at which a photograph hardly moves to that at which it leaves its width.

    Args:
        views: The photographs.
        i: Which.
        sources: The views that it is compared with, int64 [K]; -1 = none. Without any, or where all
            are in its own place, there are no hints.
    """
    others = sources[sources >= 0]
    apart = [np.linalg.norm(views[j].camera.center - views[i].camera.center) for j in others]
    # A sideways step b moves a point at inverse depth w by focal b w pixels.
    moves = views[i].K[0, 0] * float(np.median(apart)) if apart else 0.0
    return _between(LEAST_MOVE / moves, views[i].width / moves) if moves > 0 else None


def _imagined_points(
    views: Sequence[View], spread: Float64[np.ndarray, "V 3"]
) -> tuple[Float64[np.ndarray, "P 3"], list[Int64[np.ndarray, " M"]]]:
    """Positions that views may be seeing, and which of them fall into each view."""
    points = []
    for view, inverse in zip(views, spread, strict=True):
        # 5 x 4 places of the image, each at the three depths.
        share = (np.indices((4, 5)).reshape(2, -1).T[:, ::-1] + 0.5) / [5, 4]
        uv = np.tile(share * [view.width, view.height], (3, 1))
        points.append(view.camera.unproject(uv, np.repeat(1 / inverse, 20)))
    xyz = np.concatenate(points)
    return xyz, [_inside(view.camera, xyz) for view in views]


def _inside(camera: Camera, xyz: Float64[np.ndarray, "P 3"]) -> Int64[np.ndarray, " M"]:
    """The points that fall into an image."""
    uv = camera.project(xyz)[0]  # NaN behind the camera
    return np.flatnonzero(((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1))


def find_stereo(
    views: Sequence[View],
    images: Sequence[Image],
    visibility: Visibility,
    settings: StereoSettings,
    seed: int = 0,
    progress: Progress = silent,
    only: Sequence[int] | None = None,
) -> StereoResult:
    """Compare photographs with each other.

    Args:
        views: The photographs, at the size to compare.
        images: Their images, in the same order.
        visibility: The points that each image sees; depth is searched around them. If there are too
            few, small copies of the photographs are compared first, to get some.
        settings: The choices of stereo.
        seed: The same seed gives the same bytes.
        progress: Called with the stage and the fraction done.
        only: The views whose maps are wanted; the bytes are the same as if all were, and other
            views are computed only as far as they confirm these. All when left out.
    """
    if len(visibility.xyz) < TOO_FEW:
        visibility = coarse_stereo(views, seed, progress)
    seen = [visibility.rows_of(image) for image in images]
    centers = np.stack([image.camera.center for image in images])
    sources = choose_sources(seen, visibility.xyz, centers, settings.num_witnesses)
    needed = range(len(views)) if only is None else {*only, *sources[list(only)].ravel().tolist()}
    hints = [
        _hints(view, visibility.xyz[rows]) if i in needed else None
        for i, (view, rows) in enumerate(zip(views, seen, strict=True))
    ]
    return match_views(views, hints, sources, settings, seed, progress)


def _hints(view: View, xyz: Float64[np.ndarray, "M 3"]) -> Hints | None:
    """What the points that a view sees tell about its depth."""
    uv, z = view.camera.project(xyz)
    front = z > 0
    return hints_from(uv[front], 1.0 / z[front]) if front.any() else None
