"""Points at known poses from features of small photographs, within seconds.

``splatseed sfm`` finds more, in ten times the time: here photographs have the size of stereo, and
only nearby views that look the same way are matched, along epipolar lines, which needs no RANSAC.

Notation: V views; view i has M features at ``uv`` [M, 2], pixels. A feature's *matches* are one
feature in each of K partners, -1 for none. Promise: the same photographs give the same bytes,
whatever the number of threads; a point lies within ``max_error`` of features of three views.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatseed.depth.stereo.matching import grey_image
from splatseed.photos.sources import choose_by_pose
from splatseed.photos.view import View
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, in_threads, num_threads, silent
from splatseed.projection import project
from splatseed.requirements import require
from splatseed.runtime.child import Child
from splatseed.sfm._kernels import match_along_lines
from splatseed.sfm.colmap import Features, find_features
from splatseed.sfm.first_look import Pair


@dataclass(frozen=True)
class _Settings:
    partners: int = 8
    """Views that each is matched with, at least."""
    zoom: float = 1.4
    """By which photographs are enlarged: 1 gives a third to a half of the points, in half of the
    time, and doubling 1.3 to 1.9 times as many in twice the time; none is more accurate."""
    max_features: int = 2000
    max_distance: float = 2.0
    """Between a feature and the epipolar line of its match, pixels."""
    max_angle: float = 0.7
    """Between matching descriptors, radians, as in COLMAP."""
    max_ratio: float = 0.85
    """Of this angle to the second best's near the line, which leaves fewer to confuse it with."""
    max_error: float = 1.5
    """Between a feature and the projection of its point, pixels."""
    min_views: int = 3
    """Two match by chance wherever their lines are crowded."""
    min_angle: float = 1.5
    """Largest between two rays of a point, at least, degrees, as in COLMAP."""
    steps: int = 3
    """Of Gauss-Newton, by which a point's projections approach its features."""


SETTINGS = _Settings()
_PER_CHILD = 8  # photographs, at least, that are worth the start of a process


def triangulate(views: Sequence[View], progress: Progress = silent) -> PointCloud:
    """Triangulate points that three or more photographs show, at the given poses.

    Args:
        views: Photographs, pinhole; masked pixels have no features.
        progress: Called with the stage and the fraction done.

    Returns:
        The points, with the colour of a photograph and a confidence of 1 - 2^-n for n further
        views, as stereo's.

    Raises:
        MissingDependencyError: pycolmap is absent or too old.
        TaskLostError: It aborted.
    """
    require("pycolmap")
    features = _detect(views, progress)
    matches = _match(views, features, progress)
    used = [np.zeros(len(each.uv), np.bool_) for each in features]
    parts = [PointCloud.empty()]
    for i in range(len(views)):
        partners = sorted(j for k, j in matches if k == i)
        if partners:
            found = np.stack([matches[i, j] for j in partners])
            parts.append(_points_of(i, partners, found, views, features, used))
    points = PointCloud.concatenate(*parts)
    return points.select(points.distinct)  # a corner of two orientations is two features


def _detect(views: Sequence[View], progress: Progress) -> list[Features]:
    """Find features in child processes, as pycolmap may abort and holds the GIL meanwhile."""
    greys = [grey_image(view.photograph) for view in views]
    parts = max(1, min(num_threads(), len(views) // _PER_CHILD))
    bounds = [len(views) * part // parts for part in range(parts + 1)]
    how = SETTINGS.zoom, SETTINGS.max_features
    children = [
        Child(find_features, greys[start:stop], *how, reports=True)
        for start, stop in pairwise(bounds)
    ]
    found: list[Features] = []
    try:
        for child in children:
            found += child.result(progress)
    finally:
        for child in children:
            child.close()
    for i, view in enumerate(views):
        if view.surface is not None:
            column, row = found[i].uv.astype(np.int64).T
            found[i] = Features(*(each[view.surface[row, column]] for each in found[i]))
    return found


def _match(
    views: Sequence[View], features: Sequence[Features], progress: Progress
) -> Mapping[Pair, Int64[np.ndarray, " M"]]:
    """Match pairs that poses choose; a pair (i, j) has the matches of view i's features in j."""
    chosen = choose_by_pose(np.stack([view.cam_from_world for view in views]), SETTINGS.partners)
    pairs = sorted(
        {(min(i, j), max(i, j)) for i, row in enumerate(chosen.tolist()) for j in row if j >= 0}
    )
    found: dict[Pair, Int64[np.ndarray, " M"]] = {}

    def work(start: int, stop: int) -> None:
        for i, j in pairs[start:stop]:
            matrix = _fundamental(views[i], views[j])
            there = _best(features[i], features[j], matrix)
            back = _best(features[j], features[i], matrix.T)
            # Each must be the other's best.
            both = np.flatnonzero((there >= 0) & (back[there] == np.arange(len(there))))
            found[i, j], found[j, i] = np.full(len(there), -1), np.full(len(back), -1)
            found[i, j][both], found[j, i][there[both]] = there[both], both

    in_threads(work, len(pairs), 4, "match features", progress)
    return found


def _best(
    own: Features, others: Features, matrix: Float64[np.ndarray, "3 3"]
) -> Int64[np.ndarray, " M"]:
    out = np.full(len(own.uv), -1)
    if len(others.uv):
        limits = SETTINGS.max_distance, SETTINGS.max_angle, SETTINGS.max_ratio
        match_along_lines(*own, *others, np.ascontiguousarray(matrix), limits, out)
    return out


def _fundamental(view: View, other: View) -> Float64[np.ndarray, "3 3"]:
    """F of the epipolar lines F (u, v, 1) in ``other`` (Hartley and Zisserman, section 9.2)."""
    relative = other.cam_from_world @ np.linalg.inv(view.cam_from_world)
    essential = np.cross(relative[:3, 3], relative[:3, :3], axisb=0).T  # [t]x R
    return np.asarray(np.linalg.inv(other.K).T @ essential @ np.linalg.inv(view.K))


def _points_of(
    i: int,
    partners: Sequence[int],
    found: Int64[np.ndarray, "K M"],
    views: Sequence[View],
    features: Sequence[Features],
    used: Sequence[Bool[np.ndarray, " M"]],
) -> PointCloud:
    """Triangulate view i's features that are not ``used`` by an earlier view; mark what it uses.

    Of the points that a feature and one match each define, the one is taken that most matches fit;
    then all that fit it move it.
    """
    rows = np.flatnonzero(~used[i] & ((found >= 0).sum(axis=0) >= SETTINGS.min_views - 1))
    indices, seen_by = found[:, rows], [views[i], *(views[j] for j in partners)]
    uv = np.stack(
        [features[i].uv[rows]]
        + [features[j].uv[each] for j, each in zip(partners, indices, strict=True)]
    )  # [1 + K, M, 2]; of features without a match any
    matched = np.vstack([np.ones(len(rows), np.bool_), indices >= 0])
    xyz, best = np.zeros((len(rows), 3)), np.zeros(len(rows))
    for k in range(1, len(seen_by)):
        guess = _between(seen_by[0], seen_by[k], uv[0], uv[k])
        error = _errors(seen_by, guess, uv)
        share = error / SETTINGS.max_error
        # By number, then by error.
        score = np.where(matched & (share < 1.0), 2.0 - share, 0.0).sum(axis=0)
        better = matched[k] & (score > best)
        best = np.where(better, score, best)
        xyz[better] = guess[better]
    fits = matched & (_errors(seen_by, xyz, uv) < SETTINGS.max_error)
    for _ in range(SETTINGS.steps):
        xyz += _step(seen_by, xyz, uv, fits)
    fits = matched & (_errors(seen_by, xyz, uv) < SETTINGS.max_error)
    rays = np.stack([xyz - view.camera.center for view in seen_by])
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    cosine = np.where(fits, (rays * rays[0]).sum(axis=2), 1.0).min(axis=0)
    good = fits[0] & (fits.sum(axis=0) >= SETTINGS.min_views)
    good &= cosine <= np.cos(np.radians(SETTINGS.min_angle))
    used[i][rows[good]] = True
    for j, index, fit in zip(partners, indices, fits[1:], strict=True):
        used[j][index[good & fit]] = True
    column, row = uv[0, good].astype(np.int64).T
    confidence = 1.0 - 0.5 ** (fits[:, good].sum(axis=0) - 1.0)
    return PointCloud(
        xyz[good].astype(np.float32),
        views[i].photograph[row, column],
        confidence=confidence.astype(np.float32),
    )


def _between(
    view: View, other: View, uv: Float64[np.ndarray, "M 2"], their_uv: Float64[np.ndarray, "M 2"]
) -> Float64[np.ndarray, "M 3"]:
    """Return the points half-way between two rays each; NaN for those that are parallel."""
    from_a, from_b = view.camera.center, other.camera.center
    a = view.camera.unproject(uv, np.ones(len(uv))) - from_a
    b = other.camera.unproject(their_uv, np.ones(len(uv))) - from_b
    # The depths z of the nearest points solve z_a a - z_b b = t in least squares.
    t = from_b - from_a
    aa, bb, ab = (a * a).sum(axis=1), (b * b).sum(axis=1), (a * b).sum(axis=1)
    at, bt, det = a @ t, b @ t, aa * bb - ab**2
    with np.errstate(divide="ignore", invalid="ignore"):
        z_a, z_b = (bb * at - ab * bt) / det, (ab * at - aa * bt) / det
    return np.asarray(0.5 * (from_a + z_a[:, None] * a + from_b + z_b[:, None] * b))


def _errors(
    views: Sequence[View], xyz: Float64[np.ndarray, "M 3"], uv: Float64[np.ndarray, "K M 2"]
) -> Float64[np.ndarray, "K M"]:
    """Return the distances of features from projected points, pixels; infinite behind a view."""
    errors = []
    for view, place in zip(views, uv, strict=True):
        column, row, depth = project(view.camera.pixels_from_world, xyz)
        error = np.hypot(column - place[:, 0], row - place[:, 1])
        errors.append(np.where((depth > 0) & np.isfinite(error), error, np.inf))
    return np.stack(errors)


def _step(
    views: Sequence[View],
    xyz: Float64[np.ndarray, "M 3"],
    uv: Float64[np.ndarray, "K M 2"],
    fits: Bool[np.ndarray, "K M"],
) -> Float64[np.ndarray, "M 3"]:
    """Return the Gauss-Newton step of the sum of squared errors; 0 where rays are parallel."""
    normal, gradient = np.zeros((len(xyz), 3, 3)), np.zeros((len(xyz), 3))
    for view, place, fit in zip(views, uv, fits, strict=True):
        matrix = view.camera.pixels_from_world
        column, row, depth = project(matrix, xyz)
        for k, at in enumerate((column, row)):
            # d (m_k x / m_2 x) / dx = (m_k - u m_2) / z
            with np.errstate(divide="ignore", invalid="ignore"):
                slope = (matrix[k, :3] - at[:, None] * matrix[2, :3]) / depth[:, None]
                miss = place[:, k] - at
            slope, miss = np.where(fit[:, None], slope, 0.0), np.where(fit, miss, 0.0)
            normal += slope[:, :, None] * slope[:, None, :]
            gradient += slope * miss[:, None]
    solvable = np.linalg.matrix_rank(normal, hermitian=True) == 3
    step = np.zeros_like(xyz)
    step[solvable] = np.linalg.solve(normal[solvable], gradient[solvable][..., None])[..., 0]
    return step
