"""verify: interpolated points compared with the photographs, then moved or dropped.

Notation: M new points, each with a spacing h and a normal from the originals around it
(``surroundings``), and up to two views that judge it (``judges``), each with its sources. In each,
the point slides along its normal to where the photographs agree best (``sliding``), at a cost of
one minus correlation; the better judge counts. Promise: the order of points stays; the same input
gives the same bytes, whatever the number of threads; points that no photograph can judge are kept
and reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatseed.progress import Progress, in_threads, silent
from splatseed.scene import Image
from splatseed.seeding.judges import choose_judges
from splatseed.seeding.sliding import slide
from splatseed.seeding.surroundings import Surroundings, survey
from splatseed.stereo.matching import make_quad_images
from splatseed.stereo.quads import grey_image
from splatseed.upsample.method import NewPoints
from splatseed.views.pairs import choose_sources
from splatseed.views.view import View
from splatseed.views.visibility import Visibility

NUM_SOURCES = 5
"""Views that a judge is compared with."""
MAX_COST = 0.4
"""A point whose lowest cost is higher fits nowhere."""
TEXTURE = 4.0
"""Variance of grey levels around a pixel below which there is nothing to compare."""
BARE_CONFIDENCE = 0.1
"""Confidence of points on flat untextured surfaces, which stay in place."""
STEEPEST = 0.3
"""Smallest cosine between ray and normal; steeper normals are taken to be wrong and turned to
this."""
LARGEST_MOVE = 0.3
"""Largest move of a plane along its normal, in spacings, as a fraction of its distance from the
camera."""
MOVED = 0.25
"""Spacings from which on a point is reported as moved."""


@dataclass(frozen=True, eq=False)
class _Trials:
    """The verdicts of the judges of M points; infinite cost where there is no judge.

    Args:
        xyz: The best position, float32 [M, J, 3].
        moves: Its offset from the point along the normal, in spacings, float32 [M, J].
        costs: One minus correlation there, float32 [M, J].
        variances: Of the grey levels around the judge's pixel, float32 [M, J].
    """

    xyz: Float32[np.ndarray, "M J 3"]
    moves: Float32[np.ndarray, "M J"]
    costs: Float32[np.ndarray, "M J"]
    variances: Float32[np.ndarray, "M J"]


def verify(
    views: Sequence[View],
    images: Sequence[Image],
    visibility: Visibility,
    new: NewPoints,
    progress: Progress = silent,
) -> NewPoints:
    """Compare interpolated points with the photographs.

    A point stays, moved by up to 1.5 spacings along its normal, if the photographs agree there; its
    confidence is their correlation. It stays in place, with ``BARE_CONFIDENCE``, on a flat surface
    without texture, and with unknown confidence (NaN) if fewer than two photographs see it. All
    others are dropped.

    Args:
        views: The photographs, at the size to compare.
        images: Their images, in the same order.
        visibility: The originals that the points were made from, and who sees them.
        new: The points, finite.
        progress: Called with the stage and the fraction done.

    Returns:
        The points that stay, in order, with confidence and normals (towards the judge; NaN where
        the originals are collinear), their other attributes, and notes on how many were dropped and
        why.
    """
    if len(visibility.xyz) < 2 or not len(new.xyz) or not views:
        return _unchecked(new)
    seen = [visibility.rows_of(image) for image in images]
    poses = np.stack([view.cam_from_world for view in views])
    centers = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    sources = choose_sources(seen, visibility.xyz, centers, NUM_SOURCES)
    around = survey(visibility.xyz, new.xyz, progress)
    judges = choose_judges(new.xyz, around, views, seen, len(visibility.xyz), sources)
    trials = _try_all(new.xyz, around, views, judges, sources, progress)
    return _decide(new, around, trials, centers[judges])


def _try_all(
    xyz: Float32[np.ndarray, "M 3"],
    around: Surroundings,
    views: Sequence[View],
    judges: Int64[np.ndarray, "M J"],
    sources: Int64[np.ndarray, "V K"],
    progress: Progress,
) -> _Trials:
    """Let every view judge its points."""
    greys = [grey_image(view.photograph) for view in views]
    trials = _no_trials(*judges.shape)
    # The trials of each view side by side; -1, no judge, sorts before all.
    order = np.argsort(judges, axis=None, kind="stable")
    starts = np.searchsorted(judges.ravel()[order], np.arange(len(views) + 1))

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            mine = order[starts[i] : starts[i + 1]]
            others = sources[i][sources[i] >= 0].tolist()
            if len(mine):
                _judge(i, others, views, greys, xyz, around, mine, trials)

    in_threads(work, len(views), 1, "hold points against photographs", progress)
    return trials


def _no_trials(num: int, judges: int) -> _Trials:
    shape = (num, judges)
    return _Trials(
        np.zeros((*shape, 3), np.float32),
        np.zeros(shape, np.float32),
        np.full(shape, np.inf, np.float32),
        np.zeros(shape, np.float32),
    )


def _judge(
    i: int,
    others: Sequence[int],
    views: Sequence[View],
    greys: Sequence[UInt8[np.ndarray, "H W"]],
    xyz: Float32[np.ndarray, "M 3"],
    around: Surroundings,
    mine: Int64[np.ndarray, " T"],
    trials: _Trials,
) -> None:
    """Let view i judge its points.

    ``mine`` indexes the trials, judge by judge within each point.
    """
    view, (point, judge) = views[i], np.unravel_index(mine, trials.costs.shape)
    world = xyz[point].astype(np.float64)
    uv, planes, reach = _planes(view, world, around.normals[point], around.spacing[point])
    moves, costs, variances = (np.empty(len(mine), np.float32) for _ in range(3))
    # No bounds on inverse depth: the slide itself is bounded.
    anything = np.array([0.0, np.inf], np.float32)
    quad_images = make_quad_images(
        view, greys[i], [views[j] for j in others], [greys[j] for j in others], 1, anything
    )
    slide(quad_images, uv, planes, reach, moves, costs, variances)
    if view.mask is not None:
        column, row = uv.astype(np.int64).T
        costs[~view.mask[row, column]] = np.inf
    rotation, translation = view.cam_from_world[:3, :3], view.cam_from_world[:3, 3]
    center = -rotation.T @ translation
    # The plane at w / (1 + t h / (n X)) meets the ray 1 + t h / (n X) times as far from the camera.
    trials.xyz[point, judge] = center + (1.0 + moves * reach)[:, None] * (world - center)
    trials.moves[point, judge], trials.costs[point, judge] = moves, costs
    trials.variances[point, judge] = variances


def _planes(
    view: View,
    xyz: Float64[np.ndarray, "T 3"],
    normals: Float64[np.ndarray, "T 3"],
    spacing: Float64[np.ndarray, " T"],
) -> tuple[Float32[np.ndarray, "T 2"], Float32[np.ndarray, "T 3"], Float32[np.ndarray, " T"]]:
    """Pixels of points, planes through them (w, gx, gy), and h / (n X), as ``slide`` has them."""
    rotation, translation = view.cam_from_world[:3, :3], view.cam_from_world[:3, 3]
    cam = xyz @ rotation.T + translation
    n = _facing(normals @ rotation.T, cam)
    distance = np.einsum("ij,ij->i", n, cam)  # negative, as n faces the camera
    uv = (cam @ view.K.T)[:, :2] / cam[:, 2:]
    # n K^-1 (u, v, 1) w^-1 = n X, so w is linear in u and v with the slopes of n K^-1 / (n X)
    slopes = (n @ np.linalg.inv(view.K))[:, :2] / distance[:, None]
    planes = np.column_stack([1.0 / cam[:, 2], slopes])
    # Negative, as n X is: t > 0 moves along the normal, towards the camera.
    reach = np.maximum(spacing / distance, -LARGEST_MOVE)
    return uv.astype(np.float32), planes.astype(np.float32), reach.astype(np.float32)


def _facing(
    normals: Float64[np.ndarray, "T 3"], cam: Float64[np.ndarray, "T 3"]
) -> Float64[np.ndarray, "T 3"]:
    """Normals in camera axes turned towards the camera, at least by an angle of ``STEEPEST``.

    Unknown normals become the direction to the camera.
    """
    back = -cam / np.linalg.norm(cam, axis=1, keepdims=True)
    n = np.where(np.isnan(normals), back, normals)
    cosine = np.einsum("ij,ij->i", n, back)[:, None]
    n, cosine = np.where(cosine < 0, -n, n), np.abs(cosine)
    # Tilted just far enough: cos of the angle to the ray becomes STEEPEST.
    across = n - cosine * back
    length = np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(float).tiny)
    leaning = STEEPEST * back + np.sqrt(1.0 - STEEPEST**2) * across / length
    return np.asarray(np.where(cosine < STEEPEST, leaning, n))


def _decide(
    new: NewPoints,
    around: Surroundings,
    trials: _Trials,
    centers: Float64[np.ndarray, "M J 3"],
) -> NewPoints:
    """Keep, move and drop points by their judges' verdicts; ``centers`` are the judges' centres."""
    judged, textured = np.isfinite(trials.costs), trials.variances >= TEXTURE
    # Where there is no texture a low cost is chance.
    costs = np.where(textured, trials.costs, np.inf)
    rows, best = np.arange(len(costs)), costs.argmin(axis=1)
    agrees = costs[rows, best] <= MAX_COST
    unknown = ~judged.any(axis=1)
    # Interpolation is safe where nothing can be compared but the originals are coplanar.
    bare = ~unknown & ~(judged & textured).any(axis=1) & around.flat
    # 1 - cost is the correlation.
    confidence = np.where(agrees, 1.0 - np.maximum(costs[rows, best], 0.0), np.nan)
    confidence[bare] = BARE_CONFIDENCE
    xyz = np.where(agrees[:, None], trials.xyz[rows, best], new.xyz)
    # Principal axes have no sign: the normal is turned towards the judge.
    outward = np.einsum("ij,ij->i", around.normals, centers[rows, best] - new.xyz)
    normals = np.where((outward < 0)[:, None] & ~unknown[:, None], -1.0, 1.0) * around.normals
    changed = new._replace(
        xyz=xyz.astype(np.float32),
        normals=normals.astype(np.float32),
        confidence=confidence.astype(np.float32),
    )
    moved = agrees & (np.abs(trials.moves[rows, best]) >= MOVED)
    return _select(changed, agrees | bare | unknown, _notes(agrees, moved, bare, unknown))


def _select(new: NewPoints, kept: Bool[np.ndarray, " M"], notes: tuple[str, ...]) -> NewPoints:
    """Some of the points, with notes."""
    arrays = {
        name: array[kept] for name, array in new._asdict().items() if isinstance(array, np.ndarray)
    }
    return new._replace(**arrays, notes=(*new.notes, *notes))


def _notes(
    agrees: Bool[np.ndarray, " M"],
    moved: Bool[np.ndarray, " M"],
    bare: Bool[np.ndarray, " M"],
    unknown: Bool[np.ndarray, " M"],
) -> tuple[str, ...]:
    """How many points met which fate, one sentence each."""
    dropped = ~(agrees | bare | unknown)
    fates = (
        (moved, "of them do so only after a move of more than a quarter of their spacing"),
        (dropped, "agree nowhere and were dropped"),
        (bare, "lie on flat surfaces without texture and were kept in place, at low confidence"),
        (unknown, "are seen by fewer than two photographs and were kept unchecked"),
    )
    first = f"{agrees.sum():,} of {len(agrees):,} new points agree with the photographs."
    return (first, *(f"{which.sum():,} {fate}." for which, fate in fates if which.any()))


def _unchecked(new: NewPoints) -> NewPoints:
    """The points unchanged, if there is nothing to compare them with."""
    num = len(new.xyz)
    unknown = np.full(num, np.nan, np.float32)
    note = f"{num:,} new points could not be compared with photographs and were kept unchecked."
    changed = new._replace(normals=np.full((num, 3), np.nan, np.float32), confidence=unknown)
    return changed._replace(notes=(*new.notes, note)) if num else changed
