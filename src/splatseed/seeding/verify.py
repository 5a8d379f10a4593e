"""verify: compare interpolated points with the photographs, then move or drop them.

Notation: n originals, M new points, each with a base, a spacing h and a normal
(``local_geometry``). Up to two *reference views* check a point: those that see its base and contain
the point well within their frame, as two of their source views do (all, if there is but one); the
closer and the more frontal a view, the better. In each, the point slides along its normal to where
the photographs agree best, at a cost of one minus correlation; the better view counts.

A point of one view, at pixel (u, v), slides with the plane through it: inverse depth w and its
slopes gx, gy per pixel. Moving the plane by t spacings h along its normal n, where n X is
its distance from the camera, multiplies all three by 1 / (1 + t h / (n X)); the point then lies
where the plane meets the ray of (u, v), so that its window in the view stays the same.
Of the t, the one with the smallest (cost(t) + FLOOR) (1 + t^2) wins: a clearly lower cost may move
a point, small differences between high costs may not.
Promise: the order of points stays; each result depends on that point, the originals, poses and
visibility, not on other points; the same input gives the same bytes, whatever the number of
threads; points that no photograph can check are kept and reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatseed.depth.stereo.quads import grey_image, make_quad_images
from splatseed.methods.contract import NewPoints
from splatseed.photos.sources import choose_sources, views_of_points
from splatseed.photos.view import View
from splatseed.photos.visibility import Visibility
from splatseed.progress import Progress, in_threads, silent
from splatseed.projection import camera_centers
from splatseed.scene import Image
from splatseed.seeding._kernels.verify import REFERENCE_VIEWS, rank_reference_views, slide
from splatseed.seeding.local_geometry import LocalGeometry, local_geometry


@dataclass(frozen=True)
class VerifySettings:
    """When a point counts as confirmed."""

    num_sources: int = 5
    """Views that a reference view is compared with."""
    max_cost: float = 0.4
    """Cost above which a point fits nowhere."""
    min_variance: float = 4.0
    """Variance of grey levels around a pixel below which there is no texture to compare."""
    textureless_confidence: float = 0.1
    """Confidence of points on flat untextured surfaces, which stay in place."""
    min_cosine: float = 0.3
    """Minimum cosine between ray and normal; a steeper normal is taken for wrong and turned to
    this."""
    max_relative_move: float = 0.3
    """Maximum move of a plane, as a fraction of its distance from the camera."""
    reported_move: float = 0.25
    """Spacings from which on a point is reported as moved."""


SETTINGS = VerifySettings()


@dataclass(frozen=True, eq=False)
class PhotoChecks:
    """What the J reference views of M points found; infinite cost where there is no view."""

    xyz: Float32[np.ndarray, "M J 3"]  # the best position
    moves: Float32[np.ndarray, "M J"]  # its offset from the point along the normal, in spacings
    costs: Float32[np.ndarray, "M J"]  # one minus correlation there
    variances: Float32[np.ndarray, "M J"]  # of the grey levels around the point's pixel

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> PhotoChecks:
        """Checks in which no view sees any point."""
        zeros = np.zeros(shape, np.float32)
        costs = np.full(shape, np.inf, np.float32)
        return cls(np.zeros((*shape, 3), np.float32), zeros, costs, zeros.copy())


def verify(
    views: Sequence[View],
    images: Sequence[Image],
    visibility: Visibility,
    new: NewPoints,
    progress: Progress = silent,
) -> NewPoints:
    """Compare interpolated points with the photographs.

    A point stays, moved by up to 1.5 spacings along its normal, if the photographs agree there; its
    confidence is their correlation. On a flat surface without texture it stays in place, with
    ``textureless_confidence``; if fewer than two photographs see it, with unknown confidence (NaN).
    All others are dropped.

    Args:
        views: Photographs at the size to compare.
        images: Theirs, in the same order.
        visibility: Which originals each image sees.
        new: The points to check.
        progress: Called with the stage and the fraction done.

    Returns:
        The points that stay, with normals towards the reference view (NaN where the originals are
        collinear), and notes on how many were dropped and why.
    """
    if len(visibility.xyz) < 2 or not len(new.xyz) or not views:
        return _unchecked(new)
    visible = [visibility.rows_of(image) for image in images]
    centers = camera_centers([view.cam_from_world for view in views])
    sources = choose_sources(visible, visibility.xyz, centers, SETTINGS.num_sources)
    geometry = local_geometry(visibility.xyz, new.xyz, progress)
    reference_views = choose_reference_views(
        new.xyz, geometry, views, visible, len(visibility.xyz), sources
    )
    checks = _check_photos(new.xyz, geometry, views, reference_views, sources, progress)
    return _apply_checks(new, geometry, checks, centers[reference_views])


def choose_reference_views(
    xyz: Float32[np.ndarray, "M 3"],
    geometry: LocalGeometry,
    views: Sequence[View],
    visible: Sequence[Int64[np.ndarray, " N"]],
    num_originals: int,
    sources: Int64[np.ndarray, "V K"],
) -> Int64[np.ndarray, "M J"]:
    """Return the views that check each point, best first; -1 for none.

    ``visible`` are the originals that each view sees, ``sources`` the views it is compared with.
    """
    order, offsets = views_of_points(visible, num_originals)
    matrices = np.stack([view.camera.pixels_from_world for view in views])
    sizes = np.array([(view.width, view.height) for view in views], np.float64)
    focals = np.array([view.K[0, 0] for view in views])
    reference_views = np.full((len(xyz), REFERENCE_VIEWS), -1)
    rank_reference_views(
        xyz, geometry.base, np.nan_to_num(geometry.normals), order, offsets, matrices, sizes,
        camera_centers([view.cam_from_world for view in views]), focals, sources, reference_views,
    )  # fmt: skip
    return reference_views


def _check_photos(
    xyz: Float32[np.ndarray, "M 3"],
    geometry: LocalGeometry,
    views: Sequence[View],
    reference_views: Int64[np.ndarray, "M J"],
    sources: Int64[np.ndarray, "V K"],
    progress: Progress,
) -> PhotoChecks:
    """Slide every point in each of its reference views."""
    greys = [grey_image(view.photograph) for view in views]
    checks = PhotoChecks.empty(reference_views.shape)
    # Sorted by view; -1, no view, sorts before all.
    order = np.argsort(reference_views, axis=None, kind="stable")
    starts = np.searchsorted(reference_views.ravel()[order], np.arange(len(views) + 1))

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            own = order[starts[i] : starts[i + 1]]
            others = sources[i][sources[i] >= 0].tolist()
            if len(own):
                _check_in_view(i, others, views, greys, xyz, geometry, own, checks)

    in_threads(work, len(views), 1, "compare with photographs", progress)
    return checks


def _check_in_view(
    i: int,
    others: Sequence[int],
    views: Sequence[View],
    greys: Sequence[UInt8[np.ndarray, "H W"]],
    xyz: Float32[np.ndarray, "M 3"],
    geometry: LocalGeometry,
    own: Int64[np.ndarray, " T"],
    checks: PhotoChecks,
) -> None:
    """Fill the checks of view i; ``own`` are their positions in the flattened ``checks``."""
    view, (point, slot) = views[i], np.unravel_index(own, checks.costs.shape)
    world = xyz[point].astype(np.float64)
    uv, planes, reach = _planes(view, world, geometry.normals[point], geometry.spacing[point])
    moves, costs, variances = (np.empty(len(own), np.float32) for _ in range(3))
    # No bounds on inverse depth: the slide itself is bounded.
    unbounded = np.array([0.0, np.inf], np.float32)
    quad_images = make_quad_images(
        view, greys[i], [views[j] for j in others], [greys[j] for j in others], 1, unbounded
    )
    slide(quad_images, uv, planes, reach, moves, costs, variances)
    if view.mask is not None:
        column, row = uv.astype(np.int64).T
        costs[~view.mask[row, column]] = np.inf
    center = view.camera.center
    # The plane at w / (1 + t h / (n X)) meets the ray 1 + t h / (n X) times as far from the camera.
    checks.xyz[point, slot] = center + (1.0 + moves * reach)[:, None] * (world - center)
    checks.moves[point, slot], checks.costs[point, slot] = moves, costs
    checks.variances[point, slot] = variances


def _planes(
    view: View,
    xyz: Float64[np.ndarray, "T 3"],
    normals: Float64[np.ndarray, "T 3"],
    spacing: Float64[np.ndarray, " T"],
) -> tuple[Float32[np.ndarray, "T 2"], Float32[np.ndarray, "T 3"], Float32[np.ndarray, " T"]]:
    """Return pixels of points, planes through them (w, gx, gy), and h / (n X), for ``slide``."""
    rotation, translation = view.cam_from_world[:3, :3], view.cam_from_world[:3, 3]
    cam = xyz @ rotation.T + translation
    n = _facing(normals @ rotation.T, cam)
    distance = np.einsum("ij,ij->i", n, cam)  # negative, as n faces the camera
    uv = (cam @ view.K.T)[:, :2] / cam[:, 2:]
    # n K^-1 (u, v, 1) w^-1 = n X, so w is linear in u and v with the slopes of n K^-1 / (n X)
    slopes = (n @ np.linalg.inv(view.K))[:, :2] / distance[:, None]
    planes = np.column_stack([1.0 / cam[:, 2], slopes])
    # Negative, as n X is: t > 0 moves along the normal, towards the camera.
    reach = np.maximum(spacing / distance, -SETTINGS.max_relative_move)
    return uv.astype(np.float32), planes.astype(np.float32), reach.astype(np.float32)


def _facing(
    normals: Float64[np.ndarray, "T 3"], cam: Float64[np.ndarray, "T 3"]
) -> Float64[np.ndarray, "T 3"]:
    """Turn normals, in camera axes, towards the camera, by ``min_cosine`` at least.

    Unknown ones (NaN) become the direction to the camera.
    """
    limit = SETTINGS.min_cosine
    back = -cam / np.linalg.norm(cam, axis=1, keepdims=True)
    n = np.where(np.isnan(normals), back, normals)
    cosine = np.einsum("ij,ij->i", n, back)[:, None]
    n, cosine = np.where(cosine < 0, -n, n), np.abs(cosine)
    # Tilted just far enough: the cosine of the angle to the ray becomes the limit.
    across = n - cosine * back
    length = np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(float).tiny)
    tilted = limit * back + np.sqrt(1.0 - limit**2) * across / length
    return np.asarray(np.where(cosine < limit, tilted, n))


def _apply_checks(
    new: NewPoints,
    geometry: LocalGeometry,
    checks: PhotoChecks,
    centers: Float64[np.ndarray, "M J 3"],
) -> NewPoints:
    """Keep, move and drop points; ``centers`` are the centers of their reference views."""
    checked, textured = np.isfinite(checks.costs), checks.variances >= SETTINGS.min_variance
    # Where there is no texture a low cost is chance.
    costs = np.where(textured, checks.costs, np.inf)
    rows, best = np.arange(len(costs)), costs.argmin(axis=1)
    agrees = costs[rows, best] <= SETTINGS.max_cost
    unchecked = ~checked.any(axis=1)
    # Interpolation is safe where nothing can be compared but the originals are coplanar.
    textureless = ~unchecked & ~(checked & textured).any(axis=1) & geometry.flat
    # 1 - cost is the correlation.
    confidence = np.where(agrees, 1.0 - np.maximum(costs[rows, best], 0.0), np.nan)
    confidence[textureless] = SETTINGS.textureless_confidence
    xyz = np.where(agrees[:, None], checks.xyz[rows, best], new.xyz)
    # Principal axes have no sign: the normal is turned towards the reference view.
    outward = np.einsum("ij,ij->i", geometry.normals, centers[rows, best] - new.xyz)
    sign = np.where((outward < 0)[:, None] & ~unchecked[:, None], -1.0, 1.0)
    changed = new._replace(
        xyz=xyz.astype(np.float32),
        normals=(sign * geometry.normals).astype(np.float32),
        confidence=confidence.astype(np.float32),
    )
    moved = agrees & (np.abs(checks.moves[rows, best]) >= SETTINGS.reported_move)
    kept = agrees | textureless | unchecked
    return _select(changed, kept, _notes(agrees, moved, textureless, unchecked))


def _select(new: NewPoints, kept: Bool[np.ndarray, " M"], notes: tuple[str, ...]) -> NewPoints:
    """Return some of the points, with more notes."""
    arrays = {
        name: array[kept] for name, array in new._asdict().items() if isinstance(array, np.ndarray)
    }
    return new._replace(**arrays, notes=(*new.notes, *notes))


def _notes(
    agrees: Bool[np.ndarray, " M"],
    moved: Bool[np.ndarray, " M"],
    textureless: Bool[np.ndarray, " M"],
    unchecked: Bool[np.ndarray, " M"],
) -> tuple[str, ...]:
    """Count the points of each outcome, one sentence each."""
    dropped = ~(agrees | textureless | unchecked)
    outcomes = (
        (moved, "of them were moved by more than a quarter of their spacing"),
        (dropped, "agree nowhere and were dropped"),
        (textureless, "lie on flat surfaces without texture and were kept, at low confidence"),
        (unchecked, "are seen by fewer than two photographs and were kept unchecked"),
    )
    first = f"{agrees.sum():,} of {len(agrees):,} new points agree with the photographs."
    return (first, *(f"{which.sum():,} {text}." for which, text in outcomes if which.any()))


def _unchecked(new: NewPoints) -> NewPoints:
    """Return the points unchanged, with a note that nothing could be compared."""
    num = len(new.xyz)
    unknown = np.full(num, np.nan, np.float32)
    note = f"{num:,} new points could not be compared with photographs and were kept unchecked."
    changed = new._replace(normals=np.full((num, 3), np.nan, np.float32), confidence=unknown)
    return changed._replace(notes=(*new.notes, note)) if num else changed
