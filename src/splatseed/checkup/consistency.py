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
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from splatseed.camera import Camera
from splatseed.checkup._kernels import find_points
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
    hidden: int = 6
    """Points without tracks per point compared: the most alike in colour are."""
    parts: int = 4
    """Rows and columns of parts of an image, each of which keeps its share of these."""
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
    has_colors: bool = field(init=False)  # whether these differ
    _loaded: dict[int, tuple[View, Grey]] = field(init=False, default_factory=dict)
    _partners: dict[bytes, Int64[np.ndarray, "V K"]] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self._seen = find_visibility(self.scene)
        points = self.scene.points
        rgb = points.rgb[(points.source == ORIGINAL) & points.distinct].astype(np.float64)
        limit = len(rgb) if self._seen.count else CONSISTENCY.max_points
        self.rgb = strided(rgb, limit)
        spread = np.abs(self.rgb - self.rgb.mean(axis=0)).mean() if len(rgb) else 0.0
        self.has_colors = bool(spread >= CONSISTENCY.min_spread)
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
        by_color: bool = True,
        progress: Progress = silent,
    ) -> Fit:
        """Measure how points fit photographs if a hypothesis is true.

        Args:
            hypothesis: What the capture may be.
            points: The maximum number per pair of views.
            photographs: How many, spread evenly, are compared with partners.
            compared: The pairs to compare instead.
            by_color: Whether points without tracks are chosen by their colours.
            progress: Called with the stage and the fraction done.
        """
        if compared is None:
            compared = self._pairs(hypothesis.poses, photographs)
        pairs, errors, unrelated = list[PairFit](), list[np.ndarray](), list[np.ndarray]()
        self._load({i for pair in compared for i in pair}, progress)
        seen_by = cache(lambda i: self._seen_by(i, hypothesis))
        for number, (i, j) in enumerate(compared):
            progress("compare photographs with points", number / len(compared))
            cameras = self.cameras(i, j, hypothesis)
            rows = _in_both(seen_by(i), seen_by(j))
            sample = strided(rows, points)
            if len(sample) < CONSISTENCY.min_points:
                continue
            beneath = self._beneath(i, cameras[0], hypothesis.xyz[sample])
            inside = ~np.isnan(beneath[:, 0])
            seen = self.rgb[sample[inside]]
            errors.append(np.abs(beneath[inside] - seen).mean(axis=1))
            others = np.roll(seen, len(seen) // 2, axis=0)
            unrelated.append(np.abs(beneath[inside] - others).mean(axis=1))
            if by_color and self.has_colors and not self._seen.count:
                sample = self._alike((i, j), cameras, hypothesis.xyz, rows, points)
            pairs.append(self._fit_pair(i, j, cameras, hypothesis.xyz[sample]))
        return Fit(tuple(pairs), self._color_error(errors, unrelated))

    def _beneath(
        self, i: int, camera: Camera, xyz: Float64[np.ndarray, "M 3"]
    ) -> Float64[np.ndarray, "M 3"]:
        """The colours of a photograph at points; NaN beyond it, and where masks leave it out."""
        view, colors = self._loaded[i][0], np.full(xyz.shape, np.nan)
        inside = points_in_image(camera, xyz)
        column, row = inside.uv.astype(np.int64).T
        colors[inside.point_idx] = view.photograph[row, column]
        if view.mask is not None:
            colors[inside.point_idx[~view.mask[row, column]]] = np.nan
        return colors

    def _alike(
        self, pair: tuple[int, int], cameras: Sequence[Camera], xyz: Float64[np.ndarray, "P 3"],
        rows: Int64[np.ndarray, " M"], points: int,
    ) -> Int64[np.ndarray, " N"]:  # fmt: skip
        """Of a larger sample, the points whose colours are most like those of both photographs.

        The coarse z-buffer lets hidden points through, above all foliage's. Each part of the image
        keeps its share, as distortion and wrong focal lengths show at the borders.
        """
        rows = strided(rows, CONSISTENCY.hidden * points)
        beneath = [
            self._beneath(k, camera, xyz[rows]) for k, camera in zip(pair, cameras, strict=True)
        ]
        errors = np.abs(np.array(beneath) - self.rgb[rows]).mean(axis=2).max(axis=0)
        uv = np.stack(project(cameras[0].pixels_from_world, xyz[rows])[:2], axis=1)
        size = np.array([cameras[0].width, cameras[0].height])
        parts = (uv / size * CONSISTENCY.parts).astype(np.int64) @ [CONSISTENCY.parts, 1]
        order = np.lexsort((errors, parts))  # NaN last
        _, start, count = np.unique(parts[order], return_index=True, return_counts=True)
        rank = np.arange(len(rows)) - np.repeat(start, count)
        kept = rank * len(rows) < points * np.repeat(count, count)
        alike = np.sort(rows[order[kept]])
        return np.asarray(alike[evenly_spaced(len(alike), points)])

    def _color_error(self, errors: Sequence[np.ndarray], unrelated: Sequence[np.ndarray]) -> float:
        if not sum(map(len, errors)):
            return float("nan")
        other = float(np.median(np.concatenate(unrelated)))
        if not self.has_colors or other < 1.0:
            return float("nan")
        return float(np.median(np.concatenate(errors))) / other

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

    def _seen_by(self, i: int, hypothesis: Hypothesis) -> Int64[np.ndarray, " M"]:
        """Points that a view sees: by tracks if there are any, else by a coarse z-buffer."""
        if self._seen.count:
            return self._seen.rows_of(self.images[i])
        return _nearest_points(self._camera(i, hypothesis), hypothesis.xyz)

    def _fit_pair(
        self, i: int, j: int, cameras: Sequence[Camera], xyz: Float64[np.ndarray, "M 3"]
    ) -> PairFit:
        """Compare points."""
        (_, grey), (_, other) = self._loaded[i], self._loaded[j]
        outside = len(xyz) - len(points_in_image(cameras[0], xyz).point_idx)
        within = xyz[~np.isnan(self._beneath(i, cameras[0], xyz)[:, 0])]
        center = cameras[0].center
        confirmed, textured, matches = _confirm(grey, other, cameras, within)
        by_chance = moved = 0
        for number, factor in enumerate(CONSISTENCY.moves):  # a part of the points each
            part = within[number :: len(CONSISTENCY.moves)]
            away = center + factor * (part - center)
            chance, tested, _ = _confirm(grey, other, cameras, away)
            by_chance, moved = by_chance + chance, moved + tested
        return PairFit(i, j, confirmed, textured + outside, by_chance, moved, matches)


def _in_both(
    first: Int64[np.ndarray, " M"], second: Int64[np.ndarray, " N"]
) -> Int64[np.ndarray, " K"]:
    """The rows that both have, rising; one may have a row twice."""
    both = np.zeros((2, 1 + max(first.max(initial=0), second.max(initial=0))), bool)
    both[0, first] = both[1, second] = True
    return np.flatnonzero(both.all(axis=0))


def _nearest_points(camera: Camera, xyz: Float64[np.ndarray, "P 3"]) -> Int64[np.ndarray, " M"]:
    points = points_in_image(camera, xyz)
    nearest = points.nearest(camera, COARSE_GRID)[points.cells(camera, COARSE_GRID)]
    return np.asarray(points.point_idx[points.depth <= nearest * (1 + SURFACE)])


def _confirm(
    grey: Grey, other: Grey, cameras: Sequence[Camera], xyz: Float64[np.ndarray, "M 3"]
) -> tuple[int, int, Matches]:
    """Return how many points of a view another confirms, how many have a patch, and its places."""
    first, second = cameras
    column, row, depth = project(first.pixels_from_world, xyz)
    # X_j = z (R K_i^-1) (u, v, 1) + t for the plane at depth z that faces i.
    relative = second.cam_from_world @ first.world_from_cam
    uv = np.stack([column, row], axis=1)
    places = find_points(
        grey, other, uv, depth,
        second.K @ relative[:3, :3] @ np.linalg.inv(first.K), second.K @ relative[:3, 3],
        CONSISTENCY.half_patch, CONSISTENCY.reach, CONSISTENCY.min_contrast,
    )  # fmt: skip
    textured = ~np.isnan(places[:, 2])
    uv, depth, places = uv[textured], depth[textured], places[textured]
    near = np.hypot(*np.rint(places[:, :2]).T) <= CONSISTENCY.max_miss
    found = places[:, 2] >= CONSISTENCY.min_correlation
    # At the border of what is searched the best place may lie beyond.
    within = found & (np.abs(places[:, :2]).max(axis=1, initial=0.0) <= CONSISTENCY.reach - 0.5)
    matches = Matches(uv[within], depth[within], places[within, :2])
    return int(np.count_nonzero(near & found)), len(places), matches
