"""Do points lie where photographs see surfaces: a number for a capture, and for what it might be.

Notation: a point seen by views i and j projects to p in i. The patch of i around p, carried to j by
the plane through the point that faces i, is searched for in j within ``reach`` pixels of where it
should be. The point is *confirmed* if the place that correlates best is the expected one. *Chance*
is the same share for points that were moved along their rays in i, so that small motion, bare walls
and repeated texture count for nothing; the *support* of a capture is the share confirmed less
chance. The *colour error* compares the colour of points with the pixel beneath, in units of that
of other points' colours: 0 if equal, 1 if unrelated. Nothing is random.

Measured on nine captures (benchmarks/checkup.py): support 0.39 to 0.91 and colour error 0.18 to
0.50 as they are; at most 0.09, and at least 0.62, with inverted poses, OpenGL axes, half the focal
length, or points that are random, turned, or scaled by 1.3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy.lib.stride_tricks import sliding_window_view

from splatseed.camera import Camera
from splatseed.photos.loading import load_views
from splatseed.photos.sizes import factor_for_size
from splatseed.photos.sources import choose_by_pose
from splatseed.photos.view import View
from splatseed.photos.visibility import COARSE_GRID, SURFACE, find_visibility, points_in_image
from splatseed.pointcloud import ORIGINAL
from splatseed.progress import Progress, silent
from splatseed.projection import project
from splatseed.sampling import evenly_spaced, strided
from splatseed.scene import Image, Scene

Grey = Float64[np.ndarray, "H W"]


@dataclass(frozen=True)
class _Settings:
    """How points are compared; pixels are those of the reduced photographs."""

    side: int = 300
    """Maximum longer side of the photographs, in pixels."""
    photographs: int = 8
    partners: int = 2
    """Views that each photograph is compared with."""
    candidates: int = 8
    """Views among which partners are chosen: the farthest first, for its parallax."""
    points: int = 60
    """Maximum number of points per pair of views."""
    max_points: int = 100_000
    """Maximum number of points without tracks."""
    min_points: int = 8
    """Minimum number of common points of a pair."""
    half_patch: int = 3
    reach: int = 4
    """Pixels around the expected place that are searched."""
    max_miss: float = 1.5
    """Pixels from the expected place within which the best one confirms a point."""
    min_correlation: float = 0.75
    min_contrast: float = 2.0
    """Standard deviation of a patch, in grey levels of 255, below which it is bare."""
    moves: tuple[float, ...] = (0.7, 1.4)
    """Factors by which points' depths are changed to measure chance."""
    min_spread: float = 8.0
    """Mean difference between colours of points, in levels of 255, below which they say nothing."""


CONSISTENCY = _Settings()
_HALF, _REACH = CONSISTENCY.half_patch, CONSISTENCY.reach
_PATCH = 2 * _HALF + 1


class Matches(NamedTuple):
    """Where patches of a view are found again in another, near the places where they should be."""

    uv: Float64[np.ndarray, "M 2"]  # pixels of the first view
    depth: Float64[np.ndarray, " M"]  # of the plane that carries the patch to the second view
    shift: Float64[np.ndarray, "M 2"]
    """From ``uv`` to the pixel of the first view that the plane carries to the place found."""


@dataclass(frozen=True, eq=False)
class PairFit:
    """How the points that two views share fit them."""

    first: int  # index of the view whose patches are searched for
    second: int
    confirmed: int  # of ``tested`` points
    tested: int  # with a patch that is not bare; those outside of the first view count
    by_chance: int  # of ``moved`` ones
    moved: int
    matches: Matches


@dataclass(frozen=True, eq=False)
class Fit:
    """How points fit photographs, over all pairs."""

    pairs: tuple[PairFit, ...]
    color_error: float  # NaN where colours say nothing

    @property
    def tested(self) -> int:
        """Number of points compared, once per pair."""
        return sum(pair.tested for pair in self.pairs)

    @property
    def confirmed(self) -> float:
        """Share of the points that photographs confirm; 0 without any."""
        return sum(pair.confirmed for pair in self.pairs) / max(self.tested, 1)

    @property
    def chance(self) -> float:
        """Share confirmed by chance; 0 without any."""
        moved = sum(pair.moved for pair in self.pairs)
        return sum(pair.by_chance for pair in self.pairs) / max(moved, 1)

    @property
    def support(self) -> float:
        """The share confirmed, less that by chance."""
        return self.confirmed - self.chance

    @property
    def score(self) -> float:
        """Support, and how well colours agree, which decides between points of one wall."""
        known = not math.isnan(self.color_error)
        return self.support + (0.5 * max(1.0 - self.color_error, 0.0) if known else 0.0)


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """What a capture may be: V poses, P points, and a change of all intrinsics."""

    poses: Float64[np.ndarray, "V 4 4"]
    xyz: Float64[np.ndarray, "P 3"]
    focal_factor: float = 1.0  # by which focal lengths are multiplied
    center_factor: float = 1.0  # by which principal points are multiplied
    view_factors: Mapping[int, float] = field(default_factory=dict)
    """By which the focal lengths of some views are multiplied, by index."""


@dataclass(eq=False)
class Evidence:
    """Photographs and points of a scene, from which hypotheses are measured; read when needed."""

    scene: Scene
    images: Sequence[Image]
    given: Hypothesis = field(init=False)  # its distinct original points
    rgb: Float64[np.ndarray, "P 3"] = field(init=False)  # their colours, 0 to 255
    _loaded: dict[int, tuple[View, Grey]] = field(init=False, default_factory=dict)
    _partners: dict[bytes, Int64[np.ndarray, "V K"]] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self._seen = find_visibility(self.scene)
        points = self.scene.points
        rgb = points.rgb[(points.source == ORIGINAL) & points.distinct].astype(np.float64)
        limit = len(rgb) if self._seen.count else CONSISTENCY.max_points
        self.rgb = strided(rgb, limit)
        poses = np.array([image.cam_from_world for image in self.images])
        self.given = Hypothesis(poses, strided(self._seen.xyz, limit))
        self._factor = factor_for_size(self.images, CONSISTENCY.side)

    def fit(
        self,
        hypothesis: Hypothesis,
        *,
        points: int = CONSISTENCY.points,
        photographs: int = CONSISTENCY.photographs,
        compared: Sequence[tuple[int, int]] | None = None,
        progress: Progress = silent,
    ) -> Fit:
        """Measure how points fit photographs if a hypothesis is true.

        Args:
            hypothesis: What the capture may be.
            points: The maximum number per pair of views.
            photographs: How many, spread evenly, are compared with partners.
            compared: The pairs to compare instead.
            progress: Called with the stage and the fraction done.
        """
        if compared is None:
            compared = self._pairs(hypothesis.poses, photographs)
        pairs, errors, unrelated = list[PairFit](), list[np.ndarray](), list[np.ndarray]()
        self._load({i for pair in compared for i in pair}, progress)
        for number, (i, j) in enumerate(compared):
            progress("compare photographs with points", number / len(compared))
            cameras = self.cameras(i, j, hypothesis)
            rows = strided(self._common(i, j, cameras, hypothesis.xyz), points)
            if len(rows) < CONSISTENCY.min_points:
                continue
            fit, inside = self._fit_pair(i, j, cameras, hypothesis.xyz[rows])
            pairs.append(fit)
            seen, uv = rows[inside], _pixels(cameras[0], hypothesis.xyz[rows[inside]])
            beneath = self._loaded[i][0].photograph[uv[:, 1], uv[:, 0]]
            errors.append(np.abs(beneath - self.rgb[seen]).mean(axis=1))
            others = np.roll(self.rgb[seen], len(seen) // 2, axis=0)
            unrelated.append(np.abs(beneath - others).mean(axis=1))
        return Fit(tuple(pairs), self._color_error(errors, unrelated))

    def _color_error(self, errors: Sequence[np.ndarray], unrelated: Sequence[np.ndarray]) -> float:
        if not sum(map(len, errors)):
            return float("nan")
        other = float(np.median(np.concatenate(unrelated)))
        if not self.has_colors or other < 1.0:
            return float("nan")
        return float(np.median(np.concatenate(errors))) / other

    @property
    def has_colors(self) -> bool:
        """Whether points have colours that differ."""
        spread = np.abs(self.rgb - self.rgb.mean(axis=0)).mean() if len(self.rgb) else 0.0
        return bool(spread >= CONSISTENCY.min_spread)

    def _pairs(
        self, poses: Float64[np.ndarray, "V 4 4"], photographs: int
    ) -> list[tuple[int, int]]:
        pairs = []
        for i in evenly_spaced(len(self.images), photographs).tolist():
            near = self.candidates(i, poses)
            pairs += [(i, j) for j in [*near[-1:], *near[:-1]][: CONSISTENCY.partners]]
        return pairs

    def candidates(self, i: int, poses: Float64[np.ndarray, "V 4 4"]) -> list[int]:
        """Views that view i may be compared with, the nearest first."""
        key = poses.tobytes()
        if key not in self._partners:
            self._partners[key] = choose_by_pose(poses, CONSISTENCY.candidates)
        return [j for j in self._partners[key][i].tolist() if j >= 0]

    def _load(self, wanted: set[int], progress: Progress) -> None:
        missing = sorted(wanted - self._loaded.keys())
        views = load_views(
            self.scene, [self.images[i] for i in missing], data_factor=self._factor,
            undistort=True, draft=True, progress=progress,
        )  # fmt: skip
        for i, view in zip(missing, views, strict=True):
            self._loaded[i] = view, np.asarray(view.photograph.mean(axis=2))

    def cameras(self, i: int, j: int, hypothesis: Hypothesis) -> tuple[Camera, Camera]:
        """The cameras of two views that were compared, in pixels of the reduced photographs."""
        return self._camera(i, hypothesis), self._camera(j, hypothesis)

    def _camera(self, i: int, hypothesis: Hypothesis) -> Camera:
        view = self._loaded[i][0]
        K = view.K.copy()
        K[:2, :2] *= hypothesis.focal_factor * hypothesis.view_factors.get(i, 1.0)
        K[:2, 2] *= hypothesis.center_factor
        return Camera(K, view.width, view.height, hypothesis.poses[i])

    def _common(
        self, i: int, j: int, cameras: Sequence[Camera], xyz: Float64[np.ndarray, "P 3"]
    ) -> Int64[np.ndarray, " M"]:
        """Points that both views see: by tracks if there are any, else by a coarse z-buffer."""
        if self._seen.count:
            first, second = (self._seen.rows_of(self.images[k]) for k in (i, j))
        else:
            first, second = (_nearest_points(camera, xyz) for camera in cameras)
        return np.asarray(np.intersect1d(first, second))

    def _fit_pair(
        self, i: int, j: int, cameras: Sequence[Camera], xyz: Float64[np.ndarray, "M 3"]
    ) -> tuple[PairFit, Bool[np.ndarray, " M"]]:
        """Compare points; also return which lie within the first view, at pixels that count."""
        (view, grey), (_, other) = self._loaded[i], self._loaded[j]
        inside = np.zeros(len(xyz), bool)
        inside[points_in_image(cameras[0], xyz).point_idx] = True
        outside = int(np.count_nonzero(~inside))
        if view.mask is not None:
            uv = _pixels(cameras[0], xyz[inside])
            inside[inside] = view.mask[uv[:, 1], uv[:, 0]]
        within, center = xyz[inside], cameras[0].center
        confirmed, textured, matches = _confirm(grey, other, cameras, within)
        by_chance = moved = 0
        for number, factor in enumerate(CONSISTENCY.moves):  # a part of the points each
            part = within[number :: len(CONSISTENCY.moves)]
            away = center + factor * (part - center)
            chance, tested, _ = _confirm(grey, other, cameras, away)
            by_chance, moved = by_chance + chance, moved + tested
        return PairFit(i, j, confirmed, textured + outside, by_chance, moved, matches), inside


def _nearest_points(camera: Camera, xyz: Float64[np.ndarray, "P 3"]) -> Int64[np.ndarray, " M"]:
    points = points_in_image(camera, xyz)
    nearest = points.nearest(camera, COARSE_GRID)[points.cells(camera, COARSE_GRID)]
    return np.asarray(points.point_idx[points.depth <= nearest * (1 + SURFACE)])


def _pixels(camera: Camera, xyz: Float64[np.ndarray, "M 3"]) -> Int64[np.ndarray, "M 2"]:
    """The pixels that points within the image fall into."""
    column, row, _ = project(camera.pixels_from_world, xyz)
    return np.stack([column, row], axis=1).astype(np.int64)


def _confirm(
    grey: Grey, other: Grey, cameras: Sequence[Camera], xyz: Float64[np.ndarray, "M 3"]
) -> tuple[int, int, Matches]:
    """Return how many points of a view another confirms, how many have a patch, and its places."""
    first, second = cameras
    column, row, depth = project(first.pixels_from_world, xyz)
    uv = np.stack([column, row], axis=1)[:, None, None]
    patches = _sample(grey, uv + _grid(_HALF))
    patches = patches - patches.mean(axis=(1, 2), keepdims=True)
    norms = np.sqrt((patches**2).sum(axis=(1, 2)))
    with np.errstate(invalid="ignore"):
        textured = norms >= CONSISTENCY.min_contrast * _PATCH
    if not textured.any():
        return 0, 0, Matches(np.empty((0, 2)), np.empty(0), np.empty((0, 2)))
    patches, norms = patches[textured] / norms[textured, None, None], norms[textured]
    # X_j = z (R K_i^-1) (u, v, 1) + t for the plane at depth z that faces i.
    relative = second.cam_from_world @ first.world_from_cam
    around = uv[textured] + _grid(_HALF + _REACH)
    rays = np.concatenate([around, np.ones((*around.shape[:3], 1))], axis=-1)
    rays = rays @ (second.K @ relative[:3, :3] @ np.linalg.inv(first.K)).T
    places = depth[textured, None, None, None] * rays + second.K @ relative[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        bands = _sample(
            other, np.where(places[..., 2:] > 0, places[..., :2] / places[..., 2:], -1.0)
        )
    windows = sliding_window_view(bands, (_PATCH, _PATCH), axis=(1, 2))
    deviation = windows.std(axis=(-1, -2)) * _PATCH
    scores = np.einsum("nabij,nij->nab", windows, patches) / np.maximum(deviation, 1e-3)
    scores = np.where(np.isfinite(scores), scores, -1.0)
    best = scores.reshape(len(scores), -1).argmax(axis=1)
    miss = np.linalg.norm(_grid(_REACH).reshape(-1, 2)[best], axis=1)
    row, column = np.divmod(best, scores.shape[2])
    found = scores[np.arange(len(best)), row, column] >= CONSISTENCY.min_correlation
    confirmed = int(np.count_nonzero(found & (miss <= CONSISTENCY.max_miss)))
    # At the border of what is searched the best place may lie beyond.
    for at in (row, column):
        found &= (at > 0) & (at < 2 * _REACH)
    at = np.flatnonzero(found), row[found], column[found]
    shift = np.stack([_peak(scores, at, (0, 1)), _peak(scores, at, (1, 0))], axis=1)
    shift += np.stack([column[found], row[found]], axis=1) - _REACH
    matches = Matches(uv[textured][found, 0, 0], depth[textured][found], shift)
    return confirmed, len(scores), matches


def _peak(
    scores: Float64[np.ndarray, "N S S"],
    at: tuple[Int64[np.ndarray, " M"], Int64[np.ndarray, " M"], Int64[np.ndarray, " M"]],
    step: tuple[int, int],
) -> Float64[np.ndarray, " M"]:
    """The peak of the parabola through three correlations, in pixels from the middle one."""
    n, row, column = at
    before, after = (
        scores[n, row - step[0], column - step[1]],
        scores[n, row + step[0], column + step[1]],
    )
    bend = 2 * scores[at] - before - after
    return np.where(bend > 0, 0.5 * (after - before) / np.where(bend > 0, bend, 1.0), 0.0)


def _grid(half: int) -> Float64[np.ndarray, "S S 2"]:
    """Offsets (column, row) of the pixels of a square around its centre."""
    steps = np.arange(-half, half + 1.0)
    return np.stack(np.meshgrid(steps, steps), axis=-1)


def _sample(image: Grey, uv: Float64[np.ndarray, "... 2"]) -> Float64[np.ndarray, "..."]:
    """Interpolate an image at pixels; NaN outside of the centres of its outermost pixels."""
    height, width = image.shape
    x, y = uv[..., 0] - 0.5, uv[..., 1] - 0.5
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    column = np.minimum(x.astype(np.int64), width - 2)
    row = np.minimum(y.astype(np.int64), height - 2)
    s, t, flat, at = x - column, y - row, image.ravel(), row * width + column
    upper = (1 - s) * flat[at] + s * flat[at + 1]
    lower = (1 - s) * flat[at + width] + s * flat[at + width + 1]
    return np.where(inside, (1 - t) * upper + t * lower, np.nan)
