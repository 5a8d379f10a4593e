"""What a scene contains, and what is wrong with it: the numbers behind ``splatseed info``.

Notation: the spacing of a point is its mean distance to its 6 nearest, in scene units; track
lengths count images, reprojection errors are in px. Shares refer to all points unless said
otherwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatseed.progress import Progress, silent
from splatseed.scene import NO_POINT, Image, Scene

PERCENTILES = (5, 25, 50, 75, 95)
EMPTY_CELLS = 32
"""Empty regions are counted on a grid with this many cells along an image's longer side."""
MANY_ISOLATED = 0.02
"""Share of isolated points that is worth a warning."""
MANY_EMPTY = 0.5
"""Share of the images' area without points that is worth a warning."""


@dataclass(frozen=True)
class CloudStatistics:
    """Statistics of the points alone.

    Args:
        num_points: All points.
        non_finite: Points with a coordinate that is NaN or infinite.
        duplicates: Finite points at exactly the position of an earlier one.
        isolated: Points whose spacing is over 3 times that of their surroundings.
        spacing: Percentiles 5, 25, 50, 75, 95 of the spacing, scene units; NaN for fewer than 2.
        low: Least coordinates of the bounding box, [3].
        high: Greatest coordinates, [3].
        resolution: Step of float32 at the greatest coordinate, scene units.
    """

    num_points: int
    non_finite: int
    duplicates: int
    isolated: int
    spacing: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    resolution: float


@dataclass(frozen=True)
class TrackStatistics:
    """Statistics of the tracks: mean, and percentiles 5, 25, 50, 75, 95."""

    mean_length: float
    length: tuple[float, ...]
    mean_error: float
    error: tuple[float, ...]


@dataclass(frozen=True)
class EmptyRegions:
    """How much of the images no point projects into.

    Args:
        mean: Mean share of empty cells over the images.
        worst: Share in the emptiest image.
        worst_name: Its name.
    """

    mean: float
    worst: float
    worst_name: str


def cloud_statistics(scene: Scene, progress: Progress = silent) -> CloudStatistics:
    """Count, measure and check the points of a scene; an empty cloud has NaN bounds."""
    from splatseed.upsample.neighbors import prepare, sound_bases  # noqa: PLC0415  (SciPy)

    xyz = scene.points.xyz
    finite = xyz[scene.points.finite].astype(np.float64)
    nothing = (np.nan,) * 3
    left = scene.left_out
    total = len(xyz) + sum(left)
    if len(finite) == 0:
        return CloudStatistics(
            total,
            total - left.duplicates,
            left.duplicates,
            0,
            (np.nan,) * len(PERCENTILES),
            nothing,
            nothing,
            np.nan,
        )
    cloud = prepare(scene.points.replace(source=np.zeros(len(xyz), np.uint8)), progress=progress)
    # Only originals start new points; alone they are spaced otherwise than among added ones.
    added = 0 < scene.points.num_original < len(xyz)
    originals = prepare(scene.points) if added else cloud
    spacing = cloud.neighbors(16).spacing if len(cloud) > 1 else np.array([np.nan])
    isolated = 0
    if len(originals) > 1:
        isolated = int((sound_bases(originals, originals.neighbors(16)) == 0).sum())
    greatest = np.abs(finite).max().astype(np.float32)
    return CloudStatistics(
        num_points=total,
        non_finite=len(xyz) - len(finite) + left.non_finite,
        duplicates=len(finite) - len(cloud) + left.duplicates,
        isolated=isolated,
        spacing=_percentiles(spacing),
        low=tuple(finite.min(axis=0).tolist()),
        high=tuple(finite.max(axis=0).tolist()),
        resolution=float(np.spacing(greatest)),
    )


def track_statistics(scene: Scene) -> TrackStatistics | None:
    """Track lengths and reprojection errors; None for a scene without tracks."""
    if scene.tracks is None or not _has_tracks(scene):
        return None
    lengths, errors = scene.tracks.lengths, scene.tracks.errors
    known = errors[errors >= 0]
    if len(known) == 0:
        known = np.array([np.nan])
    return TrackStatistics(
        float(lengths.mean()), _percentiles(lengths), float(known.mean()), _percentiles(known)
    )


def empty_regions(scene: Scene, progress: Progress = silent) -> EmptyRegions | None:
    """The share of the images' area without points; None for a scene without images or points.

    Visibility is not tested: a wall with points behind it counts as covered.
    """
    if not scene.images or not len(scene.points):
        return None
    xyz = np.ascontiguousarray(scene.points.xyz[scene.points.finite].T, np.float64)
    shares = []
    for i, image in enumerate(scene.images):
        shares.append(_empty_share(image, xyz))
        progress("empty regions", (i + 1) / len(scene.images))
    worst = int(np.argmax(shares))
    return EmptyRegions(float(np.mean(shares)), shares[worst], scene.images[worst].name)


def find_problems(
    scene: Scene, cloud: CloudStatistics, regions: EmptyRegions | None
) -> tuple[str, ...]:
    """What a user should know before training, one sentence each; the reader's warnings first."""
    problems = list(scene.warnings)
    used = cloud.num_points - cloud.non_finite - cloud.duplicates
    added = scene.points.num_original < len(scene.points)  # nothing will be interpolated
    if not added and cloud.isolated > MANY_ISOLATED * max(used, 1):
        problems.append(
            f"{cloud.isolated:,} points ({cloud.isolated / used:.1%}) are isolated: "
            "outliers or a sparse background; methods that interpolate start nothing from them"
        )
    if cloud.num_points == 0:
        problems.append(_without_points(scene))
    elif regions is not None and regions.mean > MANY_EMPTY:
        problems.append(
            f"{regions.mean:.0%} of the images' area has no point: upsampling fills between "
            "points, but only photographs or depth maps can fill a bare wall"
        )
    if cloud.num_points and (astray := _features_astray(scene)):
        problems.append(
            f"{astray:,} features of the photographs name points, but no point has a track: the "
            "points were put in later, and a trainer that reads features takes wrong ones for them;"
            " what splatseed upsample writes of this scene is free of that"
        )
    return tuple(problems)


def _has_tracks(scene: Scene) -> bool:
    return scene.tracks is not None and bool(np.any(scene.tracks.lengths))


def _features_astray(scene: Scene) -> int:
    """How many features name a point, in a scene whose points know of no feature."""
    if _has_tracks(scene):
        return 0
    seen = (image.observations for image in scene.images)
    return sum(int(np.count_nonzero(each.point_ids != NO_POINT)) for each in seen if each)


def _without_points(scene: Scene) -> str:
    if not scene.has_photographs:
        return "there are no points to upsample"
    return (
        "there are no points yet: splatseed upsample makes some from the photographs, by comparing "
        "them (method auto), splatseed sfm --poses-from triangulates some"
    )


def _empty_share(image: Image, xyz: Float64[np.ndarray, "3 N"]) -> float:
    """Share of a grid's cells that no point projects into."""
    camera = image.camera
    width, height = camera.width, camera.height
    cell = max(width, height) / EMPTY_CELLS
    columns, rows = max(math.ceil(width / cell), 1), max(math.ceil(height / cell), 1)
    pixel_from_world = camera.K @ camera.cam_from_world[:3]
    # Ten times as fast as @, whose routines suit matrices that are large in both dimensions.
    u, v, depth = np.einsum("ij,jn->in", pixel_from_world[:, :3], xyz) + pixel_from_world[:, 3:]
    # Before the division, which most points are spared; what is behind the camera fails it too.
    inside = (u >= 0) & (u < width * depth) & (v >= 0) & (v < height * depth)
    scale = 1.0 / (cell * depth[inside])
    seen = np.zeros((rows, columns), bool)
    row = np.minimum((v[inside] * scale).astype(int), rows - 1)  # rounding may reach the border
    seen[row, np.minimum((u[inside] * scale).astype(int), columns - 1)] = True
    return 1.0 - np.count_nonzero(seen) / seen.size


def _percentiles(values: np.ndarray) -> tuple[float, ...]:
    return tuple(np.percentile(values, PERCENTILES).tolist())
