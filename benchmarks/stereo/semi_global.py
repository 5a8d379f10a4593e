"""OpenCV's semi-global matching as a peer of stereo: rectified pairs of the same photographs.

Notation: a *pair* is a view and one of the sources that stereo would compare it with, best first.
Both are rotated until their rows match, ``StereoSGBM`` finds disparities of 1/16 pixel, and its
depths go back to the view's own pixels. Promise: the peer is given what our stereo is given, the
range of depths that SfM's points span, and its own check of left against right; where two pairs
must agree, a pixel stays if both give the same depth within our tolerance. H. Hirschmueller,
"Stereo Processing by Semiglobal Matching and Mutual Information" (2008).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.seeds.depth import CAPTURES, HELD_OUT, Truth
from benchmarks.stereo.truth import MADE_STEP, Score, first, load, reached, relative_error
from jaxtyping import Float, Int, UInt8

from splatseed.depth.stereo.maps import StereoSettings
from splatseed.depth.stereo.pipeline import known_visibility
from splatseed.photos.loading import load_views
from splatseed.photos.sizes import factor_for_size
from splatseed.photos.sources import choose_sources
from splatseed.photos.view import View
from splatseed.scene import Scene

__all__ = ["score_pairs"]

BLOCK = 5
"""Side of the window, pixels: that of ours at stride 1."""
SMOOTH, JUMP = 8 * BLOCK**2, 32 * BLOCK**2
"""Costs of a step of one disparity and of more between neighbours, as OpenCV's own example has them
for one channel."""
WIDER = 1.25
"""The range of depths is that of a view's points, from the 1st to the 99th percentile, and so much
wider at both ends."""
MIN_SIDEWAYS = 0.3
"""Sine of the angle between the baseline and the first camera's axis, below which a pair is left
out."""
LARGEST = 3
"""Times the picture's size up to which a turned one is drawn."""
GRID = 4
"""Pixels between the seeds that the surface is held against."""


@dataclass(frozen=True)
class Rectified:
    """Two views whose rows match.

    Args:
        images: Grey, turned.
        rotation: From the first camera's axes to the turned ones, [3, 3].
        K: Pinhole matrix of both.
        baseline: Along the rows, scene units; negative where the second stands to the left.
        least: The fewest pixels by which a point moves.
        count: How many disparities from there on are looked at.
    """

    images: tuple[UInt8[np.ndarray, "H W"], UInt8[np.ndarray, "H W"]]
    rotation: Float[np.ndarray, "3 3"]
    K: Float[np.ndarray, "3 3"]
    baseline: float
    least: int
    count: int


def score_pairs(
    names: list[str], cache: str, limit: int, pairs: int, settings: dict[str, Any]
) -> dict[str, dict[str, float]]:
    """The score on each scene, as JSON can hold it.

    Args:
        names: Of the scenes, which are in the cache.
        cache: Where.
        limit: Photographs of a capture at most, the first by name.
        pairs: How many pairs must agree on a depth: 1 or 2.
        settings: Not used: the peer has its own.
    """
    del settings
    return {name: asdict(_score(name, Path(cache), limit, pairs)) for name in names}


def _score(name: str, cache: Path, limit: int, pairs: int) -> Score:
    scene = first(load(name, cache), limit)
    truth = Truth.of(scene, CAPTURES.get(name, MADE_STEP))
    images = scene.split(HELD_OUT)[0]
    views = load_views(
        scene, images, data_factor=factor_for_size(images, StereoSettings().max_size)
    )
    started = time.process_time()
    maps = depth_maps(scene, views, pairs)
    xyz = np.concatenate([_seeds(*each) for each in zip(views, maps, strict=True)])
    seconds = time.process_time() - started
    errors, known = [], 0
    for view, depth in zip(views, maps, strict=True):
        assert scene.depths is not None  # noqa: S101  (these scenes are chosen for theirs)
        error = relative_error(depth, scene.depths.read(view.name).values)[np.isfinite(depth)]
        errors.append(error[np.isfinite(error)])
        known += int(np.isfinite(depth).sum())
    error = np.concatenate(errors)
    kept = known / sum(depth.size for depth in maps)
    one, five = (float((error < bound).mean()) for bound in (0.01, 0.05))
    return Score(kept, one, five, reached(xyz, truth), len(xyz), seconds)


def depth_maps(scene: Scene, views: Sequence[View], pairs: int) -> list[Float[np.ndarray, "H W"]]:
    """Planar depth of every view at its own pixels, NaN where unknown."""
    images = scene.split(HELD_OUT)[0]
    visibility = known_visibility(scene)
    seen = [visibility.rows_of(image) for image in images]
    centers = np.stack([image.camera.center for image in images])
    sources = choose_sources(seen, visibility.xyz, centers, pairs)
    return [
        _agreed(views[i], [views[s] for s in sources[i] if s >= 0], visibility.xyz[seen[i]], pairs)
        for i in range(len(views))
    ]


def _agreed(
    view: View, others: Sequence[View], xyz: Float[np.ndarray, "M 3"], pairs: int
) -> Float[np.ndarray, "H W"]:
    """The mean depth of all pairs where they agree."""
    if len(others) < pairs or not len(xyz):
        return np.full((view.height, view.width), np.nan)
    z = (xyz @ view.cam_from_world[2, :3]) + view.cam_from_world[2, 3]
    nearest, farthest = np.percentile(z[z > 0], (1, 99)) * (1 / WIDER, WIDER)
    depths = np.stack([pair_depth(view, other, nearest, farthest) for other in others])
    with np.errstate(invalid="ignore"):
        alike = np.ptp(depths, axis=0) <= StereoSettings().tolerance * depths.min(axis=0)
    return np.where(alike, depths.mean(axis=0), np.nan)


def pair_depth(
    view: View, other: View, nearest: float, farthest: float
) -> Float[np.ndarray, "H W"]:
    """Depth of the first view's pixels from one pair, NaN where there is none."""
    import cv2  # noqa: PLC0415  (benchmarks run without it)

    pair = rectify(view, other, nearest, farthest)
    if pair is None:
        return np.full((view.height, view.width), np.nan)
    matcher = cv2.StereoSGBM_create(
        minDisparity=pair.least, numDisparities=pair.count, blockSize=BLOCK, P1=SMOOTH, P2=JUMP,
        disp12MaxDiff=1, uniquenessRatio=5, speckleWindowSize=50, speckleRange=2,
        mode=cv2.StereoSGBM_MODE_HH,
    )  # fmt: skip
    # The matcher looks for the second picture's pixel to the left: a camera on the other side is
    # looked at in a mirror.
    way = 1 if pair.baseline > 0 else -1
    left, right = (np.ascontiguousarray(image[:, ::way]) for image in pair.images)
    disparity = matcher.compute(left, right)[:, ::way].astype(np.float32) / 16
    disparity[disparity < max(pair.least, 0.5)] = np.nan
    return _back(view, pair, pair.K[0, 0] * abs(pair.baseline) / disparity)


def rectify(view: View, other: View, nearest: float, farthest: float) -> Rectified | None:
    """Turn two views until their rows match; a pair one above the other is laid on its side.

    None where that cannot be done: one camera stands before the other. The rows run along the
    baseline, and the axis is as near as can be to the first camera's own: Fusiello et al., "A
    compact algorithm for rectification of stereo pairs" (2000).
    """
    relative = other.cam_from_world @ np.linalg.inv(view.cam_from_world)
    center = -relative[:3, :3].T @ relative[:3, 3]
    across = center / np.linalg.norm(center)
    across = across * np.sign(across[np.argmax(np.abs(across[:2]))])
    down = np.cross((0.0, 0.0, 1.0), across)
    if np.linalg.norm(down) < MIN_SIDEWAYS:
        return None
    down /= np.linalg.norm(down)
    rotation = np.stack([across, down, np.cross(across, down)])
    corners = np.array([[0, view.width, 0, view.width], [0, 0, view.height, view.height]])
    turned = rotation @ np.linalg.inv(view.K) @ np.vstack([corners, np.ones(4)])
    if turned[2].min() <= 0:
        return None
    places = view.K[0, 0] * turned[:2] / turned[2]
    low, high = np.floor(places.min(axis=1)), np.ceil(places.max(axis=1))
    if (high - low).max() > LARGEST * max(view.width, view.height):
        return None
    baseline = float(rotation[0] @ center)
    focal = view.K[0, 0] * abs(baseline)
    least = int(focal / farthest)
    count = 16 * -(-int(focal / nearest + 1 - least) // 16)
    # Beside the first picture, on the side to which its pixels move, there is room for the second.
    low[0] -= max(0.0, np.sign(baseline)) * (least + count)
    high[0] += max(0.0, -np.sign(baseline)) * (least + count)
    K = np.array([[view.K[0, 0], 0, -low[0]], [0, view.K[0, 0], -low[1]], [0, 0, 1.0]])
    size = (int(high[0] - low[0]), int(high[1] - low[1]))
    first = _turned(view, K @ rotation, size)
    second = _turned(other, K @ rotation @ relative[:3, :3].T, size)
    return Rectified((first, second), rotation, K, baseline, least, count)


def _turned(
    view: View, turn: Float[np.ndarray, "3 3"], size: tuple[int, int]
) -> UInt8[np.ndarray, "h w"]:
    """A photograph, in grey, by a camera that is turned; black beyond its edges."""
    import cv2  # noqa: PLC0415  (benchmarks run without it)

    # Pixel centres are at half pixels in ours, at whole ones in OpenCV.
    half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])
    homography = half @ turn @ np.linalg.inv(half @ view.K)
    grey = cv2.cvtColor(view.photograph, cv2.COLOR_RGB2GRAY)
    image: UInt8[np.ndarray, "h w"] = cv2.warpPerspective(grey, homography, size)
    return image


def _back(view: View, pair: Rectified, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "H W"]:
    """A depth map of the turned camera at the pixels of the view itself, as the view's depth."""
    columns, rows = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    rays = np.stack([columns.ravel(), rows.ravel(), np.ones(columns.size)])
    rays = np.linalg.inv(view.K) @ rays
    turned = pair.rotation @ rays
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = (pair.K[:2] @ turned) / turned[2]
    inside = (turned[2] > 0) & (x >= 0) & (y >= 0) & (x < depth.shape[1]) & (y < depth.shape[0])
    places: Int[np.ndarray, " M"] = np.flatnonzero(inside)
    z = depth[y[places].astype(int), x[places].astype(int)]
    depths = np.full(columns.size, np.nan)
    depths[places] = z / turned[2][places]  # the rays have depth 1 in the view
    return depths.reshape(view.height, view.width)


def _seeds(view: View, depth: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "N 3"]:
    """World points of every fourth pixel that has a depth."""
    rows, columns = np.meshgrid(
        np.arange(GRID // 2, view.height, GRID), np.arange(GRID // 2, view.width, GRID),
        indexing="ij",
    )  # fmt: skip
    z = depth[rows, columns]
    known = np.isfinite(z)
    pixels = np.stack([columns[known] + 0.5, rows[known] + 0.5, np.ones(known.sum())])
    points = (np.linalg.inv(view.K) @ pixels) * z[known] - view.cam_from_world[:3, 3:]
    return np.asarray((view.cam_from_world[:3, :3].T @ points).T)
