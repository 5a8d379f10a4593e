"""Depth maps from photographs alone, and their fusion to one seed for each piece of surface.

Notation: V views of a scene. A scene that has too few points takes some from its depth maps, or
from *coarse stereo*: stereo on copies about ``SMALL`` pixels wide, in two steps: a few views over
every depth, then all views over the depths seen by those few. Promise: the same scene, settings and
seed give the same bytes, whatever the number of threads; a depth is kept, and a point made, only
where other views' independently computed maps agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt8

from splatseed.camera import Camera
from splatseed.depth.stereo.maps import TOO_FEW, StereoResult, StereoSettings
from splatseed.depth.stereo.matching import Hints, hints_from, match_views, other_from_view
from splatseed.depthmap import DepthMap
from splatseed.photos.sources import choose_by_pose, choose_sources
from splatseed.photos.view import View
from splatseed.photos.visibility import Visibility, find_visibility
from splatseed.progress import Progress, silent
from splatseed.runtime.jit import inline
from splatseed.scene import Image, Scene

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
SAME = 0.03
"""Relative difference of depth up to which two seeds in a cell count as one."""


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
    """Points that small copies of photographs, two at least, confirm."""
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


@dataclass(frozen=True, eq=False)
class StereoSeeds:
    """Points on surfaces.

    Args:
        xyz: World positions, float32 [N, 3].
        rgb: Mean colour of the map pixel in the photograph, uint8 [N, 3].
        normals: World axes, towards the view it comes from, float32 [N, 3].
        sizes: The side of a cell at that depth, scene units, float32 [N].
        confidence: From 0 to 1, float32 [N].
        view_idx: The view it comes from, int32 [N].
    """

    xyz: Float32[np.ndarray, "N 3"]
    rgb: UInt8[np.ndarray, "N 3"]
    normals: Float32[np.ndarray, "N 3"]
    sizes: Float32[np.ndarray, " N"]
    confidence: Float32[np.ndarray, " N"]
    view_idx: Int32[np.ndarray, " N"]

    def __len__(self) -> int:
        return len(self.xyz)


def fuse(stereo: StereoResult, cell: float, progress: Progress = silent) -> StereoSeeds:
    """Seeds ``cell`` pixels apart in the photographs, which are divided into cells of that side.

    A kept pixel becomes a seed unless its cell in its own view, or in one that confirms it, has a
    seed at that depth already. Seeds come in the order of the views and, within one, of falling
    confidence.

    Args:
        stereo: The result of stereo.
        cell: Side of a cell in pixels of the views; not below the grid of the maps.
        progress: Called with the stage and the fraction done.
    """
    cell = max(float(cell), float(stereo.settings.grid))
    shapes = np.array(
        [(int(view.height / cell) + 1, int(view.width / cell) + 1) for view in stereo.views]
    )
    offsets = np.cumsum([0, *shapes.prod(axis=1)])
    # The depth of the seed in each cell of each view; 0 is free, as 0 / depth is far from 1.
    taken = np.zeros(offsets[-1], np.float32)
    parts = []
    for i in range(len(stereo.views)):
        chosen = _choose(stereo, i, cell, taken, offsets, shapes)
        parts.append(_seeds(stereo, i, chosen, cell))
        progress("fuse depths", (i + 1) / len(stereo.views))
    fields = StereoSeeds.__dataclass_fields__
    return StereoSeeds(**{f: np.concatenate([getattr(part, f) for part in parts]) for f in fields})


def _choose(
    stereo: StereoResult,
    i: int,
    cell: float,
    taken: Float32[np.ndarray, " C"],
    offsets: Int64[np.ndarray, " V+1"],
    shapes: Int64[np.ndarray, "V 2"],
) -> Int64[np.ndarray, " M"]:
    """The pixels of a view that become seeds.

    Their cells are marked in all views that confirm them.
    """
    confidence = stereo.confidence(i).ravel()
    # The most confident pixel takes its cell first; those at 0 are not kept at all.
    order = np.argsort(-confidence, kind="stable")[: np.count_nonzero(confidence)]
    others = stereo.sources[i]
    matrices: Float64[np.ndarray, "K 3 4"] = np.zeros((len(others), 3, 4))
    for k, j in enumerate(others.tolist()):
        if j >= 0:
            matrices[k] = other_from_view(stereo.views[i], stereo.views[j])
    good = np.zeros(len(order), np.bool_)
    _take(
        order, stereo.planes[i], stereo.agreeing[i], i, others, matrices,
        stereo.settings.grid, cell, taken, offsets, shapes, good,
    )  # fmt: skip
    return np.asarray(order[good])


@inline
def _take(  # type: ignore[no-untyped-def]  # Numba's types
    order, planes, agreeing, own, others, matrices, grid, cell, taken, offsets, shapes, good
):
    """Mark the cells of a view's pixels, one after another."""
    width = agreeing.shape[1]
    num = len(others)
    places, depths = np.zeros(num + 1, np.int64), np.zeros(num + 1, np.float32)
    for n in range(len(order)):
        row, column = order[n] // width, order[n] % width
        w = planes[0, row, column]
        u, v = (column + 0.5) * grid, (row + 0.5) * grid
        places[0], depths[0] = offsets[own] + int(v / cell) * shapes[own, 1] + int(u / cell), w
        count = 1
        for k in range(num):
            # Its cell in each view that confirms it: the same surface must not get two seeds.
            if agreeing[row, column] >> np.uint8(k) & 1:
                m, j, z = matrices[k], others[k], 1.0 / w
                depth = (m[2, 0] * u + m[2, 1] * v + m[2, 2]) * z + m[2, 3]
                x = ((m[0, 0] * u + m[0, 1] * v + m[0, 2]) * z + m[0, 3]) / depth
                y = ((m[1, 0] * u + m[1, 1] * v + m[1, 2]) * z + m[1, 3]) / depth
                places[count] = offsets[j] + int(y / cell) * shapes[j, 1] + int(x / cell)
                depths[count] = 1.0 / depth
                count += 1
        free = True
        for k in range(count):
            free = free and not abs(taken[places[k]] / depths[k] - 1.0) <= SAME
        if free:
            good[n] = True
            for k in range(count):
                taken[places[k]] = depths[k]


def _seeds(
    stereo: StereoResult, i: int, chosen: Int64[np.ndarray, " M"], cell: float
) -> StereoSeeds:
    """The seeds at some of a view's pixels."""
    view, grid = stereo.views[i], stereo.settings.grid
    width = stereo.costs[i].shape[1]
    row, column = chosen // width, chosen % width
    z = 1.0 / stereo.planes[i][0][row, column].astype(np.float64)
    uv = (np.stack([column, row], axis=1) + 0.5) * grid
    camera = view.camera
    # n' R = (R' n)': from camera axes to the world's.
    normals = stereo.normals(i)[row, column] @ view.cam_from_world[:3, :3]
    return StereoSeeds(
        camera.unproject(uv, z).astype(np.float32),
        block_means(view.photograph, grid)[row, column],
        normals.astype(np.float32),
        (cell * z / view.K[0, 0]).astype(np.float32),
        stereo.confidence(i)[row, column],
        np.full(len(chosen), i, np.int32),
    )


def block_means(image: UInt8[np.ndarray, "H W C"], grid: int) -> UInt8[np.ndarray, "h w C"]:
    """The mean of each block of grid x grid pixels."""
    rows, columns = image.shape[0] // grid, image.shape[1] // grid
    blocks = image[: rows * grid, : columns * grid].reshape(rows, grid, columns, grid, -1)
    return np.asarray(np.rint(blocks.mean(axis=(1, 3))), np.uint8)
