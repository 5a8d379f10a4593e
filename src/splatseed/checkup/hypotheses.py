"""What people's tools do to a capture: focal lengths of another size, points in another frame.

A hypothesis is *better* than the capture as it is if photographs support it clearly more
(``is_better``). Each search measures few points first, and all for the best.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from splatseed.checkup.consistency import Evidence, Fit, Hypothesis
from splatseed.depth.stereo.maps import MIN_POINTS
from splatseed.pointcloud import PointCloud
from splatseed.sampling import strided
from splatseed.scene import Image
from splatseed.similarity import Similarity, fit_similarity

Points = Float64[np.ndarray, "N 3"]
Affine = Float64[np.ndarray, "3 4"]


@dataclass(frozen=True)
class _Settings:
    """Which hypotheses are tried, and when one is better."""

    min_support: float = 0.2
    """Support of a hypothesis that may be true; wrong ones reached 0.09."""
    min_gain: float = 0.1
    min_ratio: float = 1.3
    """Support above that of the capture as it is, absolutely and as a factor."""
    min_tested: int = 50
    """Minimum number of points compared, for a hypothesis that may be true."""
    max_color_error: float = 0.6
    """Colour error of a hypothesis that may be true, unless it was higher before."""
    points: int = 16
    photographs: int = 6
    """Points of a pair, and photographs, in a search."""
    nearby_factors: tuple[float, ...] = (0.8, 0.9, 1.11, 1.25)
    """Focal factors tried even where points fit."""
    all_factors: tuple[float, ...] = tuple(np.geomspace(0.3, 3.4, 42).tolist())
    fine_steps: tuple[float, ...] = (0.95, 0.97, 0.985, 1.0, 1.015, 1.03, 1.05)
    """Multiples of the best factor through which a parabola is fitted."""
    scales: tuple[float, ...] = (1.0, 0.7, 1.4, 0.5, 2.0)
    """Factors of the scale by which points are first aligned."""
    iterations: int = 25
    kept: float = 0.7
    """Fraction of the nearest pairs that an alignment is fitted to."""
    color_weight: float = 1.0
    """Distance between black and white, in spreads of the points, when points are aligned."""
    min_surface: int = 100
    """Minimum number of points that photographs show, to align others with."""
    aligned: int = 1500
    """Maximum number of points that are aligned."""
    verified: int = 5
    """Alignments, the nearest first, that are compared with photographs."""


SEARCH = _Settings()


@dataclass(frozen=True, eq=False)
class Found:
    """A hypothesis that fits better than the capture as it is."""

    hypothesis: Hypothesis
    fit: Fit
    affine: Affine | None = None  # scene_from_points, for points in another frame


def is_better(fit: Fit, than: Fit) -> bool:
    """Whether photographs support a hypothesis clearly more."""
    needed = max(
        SEARCH.min_support, than.support + SEARCH.min_gain, than.support * SEARCH.min_ratio
    )
    if fit.tested < max(SEARCH.min_tested, than.tested // 3):
        return False
    contradicted = fit.color_error > max(SEARCH.max_color_error, than.color_error)
    return fit.support >= needed and not contradicted


def find_intrinsics(evidence: Evidence, fit: Fit, *, nearby: bool) -> Found | None:
    """Find the factor of all focal lengths that fits better; None if there is none.

    Principal points are the image's centre, or were scaled with the focal length and are once
    scaled back. ``nearby``: the points fit as they are, so that only a small error is possible.
    """
    given = evidence.given
    factors = SEARCH.nearby_factors if nearby else SEARCH.all_factors
    tried = [replace(given, focal_factor=factor) for factor in factors]
    center = centering_factor(evidence.images)
    if center is not None:
        tried.append(replace(given, focal_factor=center, center_factor=center))
    base = _quick(evidence, given)
    best = _best(evidence, tried)
    # Between two factors of a search few points may fit; all are compared below.
    near = not nearby and best is not None and best.fit.support >= SEARCH.min_support / 2
    if best is None or not (near or is_better(best.fit, base)):
        return None
    hypothesis = best.hypothesis
    if hypothesis.center_factor == 1.0:  # else the factor is exact
        hypothesis = _refined(evidence, hypothesis)
    found = Found(hypothesis, evidence.fit(hypothesis))
    return found if is_better(found.fit, fit) else None


def _refined(evidence: Evidence, hypothesis: Hypothesis) -> Hypothesis:
    """Return the hypothesis at the vertex of a parabola through the scores of nearby factors."""
    factors = hypothesis.focal_factor * np.array(SEARCH.fine_steps)
    scores = [evidence.fit(replace(hypothesis, focal_factor=each)).score for each in factors]
    return replace(hypothesis, focal_factor=peak(factors.tolist(), scores))


def peak(factors: Sequence[float], scores: Sequence[float]) -> float:
    """Return the factor at the vertex of a parabola through the scores of nearby factors.

    It is the one with the highest score where the parabola has no peak, or there are fewer than
    three.
    """
    best = factors[int(np.argmax(scores))]
    if len(factors) < 3:
        return best
    bend, slope, _ = np.polyfit(np.log(factors), scores, 2)
    vertex = np.exp(-slope / (2 * bend)) if bend < 0 else best
    return float(np.clip(vertex, min(factors), max(factors)))


def centering_factor(images: Sequence[Image]) -> float | None:
    """The factor that brings off-centre principal points to the centre of their images."""
    ratios = [2 * image.K[0, 2] / image.lens.width if image.lens.width else 1.0 for image in images]
    ratio = float(np.median(ratios))
    return 1 / ratio if ratio > 0 and abs(ratio - 1) > 0.04 else None


def find_axes(evidence: Evidence, fit: Fit) -> Found | None:
    """Find exchanged or negated axes of the points that fit better; None if there are none."""
    given = evidence.given
    found: tuple[Float64[np.ndarray, "3 3"], Fit] | None = None
    for axes in _axes():
        fitted = _quick(evidence, replace(given, xyz=given.xyz @ axes.T))
        supported = fitted.support >= SEARCH.min_support
        if supported and (found is None or fitted.score > found[1].score):
            found = axes, fitted
    if found is None:
        return None
    return _confirmed(evidence, fit, np.column_stack([found[0], np.zeros(3)]))


def find_similarity(evidence: Evidence, fit: Fit, surfaces: PointCloud) -> Found | None:
    """Find a scale, a shift and axes of the points that fit better, by aligning them.

    ``surfaces`` are points that photographs show, in the frame of the poses.
    """
    xyz = evidence.given.xyz
    if len(surfaces) < SEARCH.min_surface or len(xyz) < MIN_POINTS:
        return None
    weight = SEARCH.color_weight if evidence.has_colors else 0.0
    source = _Colored.of(xyz, evidence.rgb, weight)
    target = _Colored.of(surfaces.xyz.astype(np.float64), surfaces.rgb, weight)
    aligned = []
    # The identity first, then the usual turns about x: OpenGL's axes, and z up.
    turns = [np.diag([1.0, 1, 1]), np.diag([1.0, -1, -1])]
    turns += [np.array([[1.0, 0, 0], [0, 0, -sign], [0, sign, 0]]) for sign in (1, -1)]
    for turn, scale in product(turns, SEARCH.scales):
        aligned.append(_align(source, target, turn, scale))
    best = sorted((each for each in aligned if each is not None), key=lambda each: each[0])
    quick = [
        (_quick(evidence, replace(evidence.given, xyz=similarity.points(xyz))), similarity)
        for _, similarity in best[: SEARCH.verified]
    ]
    supported = [each for each in quick if each[0].support >= SEARCH.min_support]
    if not supported:
        return None
    _, similarity = max(supported, key=lambda each: each[0].score)
    return _confirmed(evidence, fit, similarity.matrix)


class _Colored(NamedTuple):
    """Points with colours, as features of a nearest neighbour."""

    xyz: Points
    rgb: Points  # in units in which a distance counts as one of positions, per spread
    middle: Float64[np.ndarray, " 3"]
    spread: float  # median distance from the middle

    @classmethod
    def of(cls, xyz: Points, rgb: np.ndarray, weight: float) -> _Colored:
        xyz, rgb = strided(xyz, SEARCH.aligned), strided(rgb, SEARCH.aligned)
        middle = np.median(xyz, axis=0)
        spread = float(np.median(np.linalg.norm(xyz - middle, axis=1)))
        return cls(xyz, weight / 255 * rgb.astype(np.float64), middle, spread)


def _align(
    source: _Colored, target: _Colored, turn: Float64[np.ndarray, "3 3"], scale: float
) -> tuple[float, Similarity] | None:
    """Align points with others by ICP; return the distance that is left, and the similarity.

    Nearest neighbours are paired both ways: one way alone would shrink the points to one place.
    """
    if not min(source.spread, target.spread) > 0:
        return None
    factor = scale * target.spread / source.spread
    similarity = Similarity(factor, turn, target.middle - factor * turn @ source.middle)
    features = np.column_stack([target.xyz / target.spread, target.rgb])
    tree, distance = cKDTree(features), np.inf
    for _ in range(SEARCH.iterations):
        moved = np.column_stack([similarity.points(source.xyz) / target.spread, source.rgb])
        there, to = tree.query(moved)
        back, of = cKDTree(moved).query(features)
        near = [np.argsort(d)[: int(SEARCH.kept * len(d))] for d in (there, back)]
        fitted = fit_similarity(
            np.concatenate([source.xyz[near[0]], source.xyz[of[near[1]]]]),
            np.concatenate([target.xyz[to[near[0]]], target.xyz[near[1]]]),
        )
        if fitted is None:
            return None
        similarity = fitted
        distance = float(np.median(there[near[0]]) + np.median(back[near[1]]))
    return distance, similarity


def _confirmed(evidence: Evidence, fit: Fit, affine: Affine) -> Found | None:
    """Measure all points of an affine map from their frame; None unless it is better."""
    xyz = evidence.given.xyz @ affine[:, :3].T + affine[:, 3]
    hypothesis = replace(evidence.given, xyz=xyz)
    fitted = evidence.fit(hypothesis)
    return Found(hypothesis, fitted, affine) if is_better(fitted, fit) else None


def _axes() -> Iterator[Float64[np.ndarray, "3 3"]]:
    """All exchanges and negations of axes but the identity."""
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        axes = np.eye(3)[list(order)] * np.array(signs)[:, None]
        if not np.array_equal(axes, np.eye(3)):
            yield axes


def _best(evidence: Evidence, tried: Sequence[Hypothesis]) -> Found | None:
    found = [Found(each, _quick(evidence, each)) for each in tried]
    return max(found, key=lambda each: each.fit.score, default=None)


def _quick(evidence: Evidence, hypothesis: Hypothesis) -> Fit:
    return evidence.fit(hypothesis, points=SEARCH.points, photographs=SEARCH.photographs)
