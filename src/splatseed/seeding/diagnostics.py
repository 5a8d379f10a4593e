"""What a scene contains, what is wrong with it, and how accurate a cloud is: in numbers.

Notation: the spacing of a point is its mean distance to its 6 nearest others, in scene units; h is
a cloud's: the mean over its points. Scores are in units of h of the *originals*, so that scenes of
any size compare. Track lengths count images, reprojection errors are in px. Five numbers are the
percentiles 5, 25, 50, 75, 95. Promise: exact duplicates and non-finite points do not count as
neighbours; nothing is random; photographs are opened only for their masks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.spatial import cKDTree

from splatseed.errors import PointCloudError, SplatseedError
from splatseed.io.files import special_kind
from splatseed.io.masks import read_mask
from splatseed.pointcloud import first_of_equals
from splatseed.progress import Progress, silent
from splatseed.scene import NO_POINT, Image, Scene
from splatseed.text import agreeing, visible

NEIGHBORS = 6
"""Neighbours whose mean distance is the spacing: those of a point in a hexagonal pattern."""
FAR_SPACINGS, FAR_SAMPLE = 3.0, 50_000
"""A new point is far from the originals beyond this many spacings of the nearest one; and of how
many new points that is asked, at most."""
EMPTY_CELLS = 32
"""Empty regions are counted on a grid with this many cells along an image's longer side."""
COUNTED = 0.5
"""Least share of a cell's pixels that count for the cell to count, where there are masks."""
MASKS_READ = 32
"""Most photographs whose masks are read."""
MANY_ISOLATED, MANY_EMPTY = 0.02, 0.5
"""Shares of isolated points, and of the images' area without points, that are worth a warning."""

Five = tuple[float, ...]


@dataclass(frozen=True)
class CloudStatistics:
    """Statistics of the points alone; lengths are in scene units, NaN without finite points."""

    num_points: int
    non_finite: int  # points with a coordinate that is NaN or infinite
    duplicates: int  # finite points at exactly the position of an earlier one
    isolated: int  # points whose spacing is over 3 times that of their surroundings
    spacing: Five
    low: tuple[float, ...]  # corner of the bounding box
    high: tuple[float, ...]
    resolution: float  # step of float32 at the greatest coordinate


@dataclass(frozen=True)
class TrackStatistics:
    """Statistics of the tracks."""

    mean_length: float
    length: Five
    mean_error: float
    error: Five


@dataclass(frozen=True)
class EmptyRegions:
    """How much of the images no point projects into."""

    mean: float  # share of empty cells
    worst: float  # that of the emptiest image
    worst_name: str


def cloud_statistics(scene: Scene, progress: Progress = silent) -> CloudStatistics:
    """Count, measure and check the points of a scene."""
    from splatseed.methods.neighbors import prepare, sound_bases  # noqa: PLC0415  (SciPy)

    xyz, left = scene.points.xyz, scene.left_out
    finite = xyz[scene.points.finite].astype(np.float64)
    num, bad = len(xyz) + sum(left), len(xyz) - len(finite) + left.non_finite
    if len(finite) == 0:
        nothing = (np.nan,) * 3
        return CloudStatistics(
            num, bad, left.duplicates, 0, (np.nan,) * 5, nothing, nothing, np.nan
        )
    cloud = prepare(scene.points.replace(source=np.zeros(len(xyz), np.uint8)), progress=progress)
    # Only originals start new points; alone they are spaced otherwise than among added ones.
    added = 0 < scene.points.num_original < len(xyz)
    originals = prepare(scene.points) if added else cloud
    spacing = cloud.neighbors(16).spacing if len(cloud) > 1 else np.array([np.nan])
    isolated = 0
    if len(originals) > 1:
        isolated = int((sound_bases(originals, originals.neighbors(16)) == 0).sum())
    return CloudStatistics(
        num, bad, len(finite) - len(cloud) + left.duplicates, isolated, _five(spacing),
        tuple(finite.min(axis=0).tolist()), tuple(finite.max(axis=0).tolist()),
        float(np.spacing(np.abs(finite).max().astype(np.float32))),
    )  # fmt: skip


def track_statistics(scene: Scene) -> TrackStatistics | None:
    """Track lengths and reprojection errors; None for a scene without tracks."""
    if scene.tracks is None or not np.any(scene.tracks.lengths):
        return None
    lengths, errors = scene.tracks.lengths, scene.tracks.errors
    known = errors[errors >= 0]
    if len(known) == 0:
        known = np.array([np.nan])
    return TrackStatistics(float(lengths.mean()), _five(lengths), float(known.mean()), _five(known))


def empty_regions(
    scene: Scene, progress: Progress = silent, sample: MaskSample | None = None
) -> EmptyRegions | None:
    """The share of the images' area without points; None for a scene without images or points.

    Masked area does not count; where there are masks, images of the ``sample``, which is read if it
    is not given, stand for all. Visibility is not tested: a wall with points behind it counts as
    covered.
    """
    if not scene.images or not len(scene.points):
        return None
    xyz = np.ascontiguousarray(scene.points.xyz[scene.points.finite].T, np.float64)
    sample = read_mask_sample(scene, progress) if sample is None else sample
    images, files = list(scene.images), scene.masks.files if scene.masks else {}
    if any(cells is not None for cells in sample.cells.values()):
        whole = {image.name for image in images if files and image.name not in files}
        images = [image for image in images if image.name in whole or image.name in sample.cells]
    shares: dict[str, float] = {}
    for i, image in enumerate(images):
        counted = sample.cells.get(image.name)
        counts = np.ones(_cells_of(image), bool) if counted is None else counted >= COUNTED
        if counts.any():
            shares[image.name] = 1.0 - float(_seen_cells(image, xyz)[counts].mean())
        progress("empty regions", (i + 1) / len(images))
    if not shares:
        return None
    worst = max(shares, key=lambda name: shares[name])
    return EmptyRegions(float(np.mean(list(shares.values()))), shares[worst], worst)


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
            "outliers or a sparse background; methods that interpolate never start from them"
        )
    if cloud.num_points == 0:
        problems.append(
            "there are no points yet: splatseed upsample makes some from the photographs, by "
            "comparing them (method auto), splatseed sfm --poses-from triangulates some"
            if scene.has_photographs
            else "there are no points to upsample"
        )
    elif regions is not None and regions.mean > MANY_EMPTY:
        problems.append(
            f"{regions.mean:.0%} of the images' area has no point: upsampling fills between "
            "points, but only photographs or depth maps can fill a bare wall"
        )
    if cloud.num_points and track_statistics(scene) is None:
        seen = (image.observations for image in scene.images)
        astray = sum(int(np.count_nonzero(each.point_ids != NO_POINT)) for each in seen if each)
        if astray:
            problems.append(
                f"{astray:,} features of the photographs name points, but no point has a track: "
                "the points were added later, and a trainer that reads features gets wrong ones; "
                "what splatseed upsample writes of this scene is free of that"
            )
    return tuple(problems)


def _cells_of(image: Image) -> tuple[int, int]:
    """Rows and columns of an image's grid."""
    width, height = image.intrinsics.width, image.intrinsics.height
    cell = max(width, height) / EMPTY_CELLS
    return max(math.ceil(height / cell), 1), max(math.ceil(width / cell), 1)


def _seen_cells(image: Image, xyz: Float64[np.ndarray, "3 N"]) -> Bool[np.ndarray, "R C"]:
    """Which cells of a grid a point projects into."""
    camera = image.camera
    width, height = camera.width, camera.height
    cell, (rows, columns) = max(width, height) / EMPTY_CELLS, _cells_of(image)
    pixel_from_world = camera.K @ camera.cam_from_world[:3]
    # Ten times as fast as @, whose routines suit matrices that are large in both dimensions.
    u, v, depth = np.einsum("ij,jn->in", pixel_from_world[:, :3], xyz) + pixel_from_world[:, 3:]
    # Before the division, which most points are spared; what is behind the camera fails it too.
    inside = (u >= 0) & (u < width * depth) & (v >= 0) & (v < height * depth)
    scale = 1.0 / (cell * depth[inside])
    seen = np.zeros((rows, columns), bool)
    row = np.minimum((v[inside] * scale).astype(int), rows - 1)  # rounding may reach the border
    seen[row, np.minimum((u[inside] * scale).astype(int), columns - 1)] = True
    return seen


@dataclass(frozen=True)
class MaskStatistics:
    """Which photographs have pixels that do not count."""

    images: int  # how many; of those looked at, where transparency alone tells
    share: float  # the mean share of such pixels in some of them; 0 without any
    problem: str  # why a mask cannot be used; empty if none of those looked at


@dataclass(frozen=True)
class MaskSample:
    """The masks of up to ``MASKS_READ`` photographs, evenly spread."""

    cells: Mapping[str, Float64[np.ndarray, "R C"] | None]
    """By image, the share of each cell's pixels that count; None: the image is used whole."""
    shares: tuple[float, ...]  # of pixels that do not count, of each masked photograph
    problem: str  # why one cannot be used


def read_mask_sample(scene: Scene, progress: Progress = silent) -> MaskSample:
    """Read the masks of some photographs of a scene."""
    folder = scene.source.image_dir if scene.source else None
    if folder is None or scene.masks is None:
        return MaskSample({}, (), "")
    files = scene.masks.files
    images = [im for im in scene.images if (im.name in files or not files)]
    images = [im for im in images if (folder / im.name).is_file()]
    asked = images[:: -(-len(images) // MASKS_READ) or 1]
    cells: dict[str, Float64[np.ndarray, "R C"] | None] = {}
    shares, problem = [], ""
    for i, image in enumerate(asked):
        try:
            counts = read_mask(scene.masks, image.name, folder / image.name)
        except SplatseedError as error:
            problem = problem or str(error)
            continue
        cells[image.name] = None if counts is None else _cell_shares(image, counts)
        if image.name in files or counts is not None:
            shares.append(0.0 if counts is None else 1.0 - float(counts.mean()))
        progress("read masks", (i + 1) / len(asked))
    return MaskSample(cells, tuple(shares), problem)


def mask_statistics(scene: Scene, sample: MaskSample) -> MaskStatistics:
    """Count masks, and say how much those of a sample leave out."""
    files = scene.masks.files if scene.masks and sample.cells else {}
    share = float(np.mean(sample.shares)) if sample.shares else 0.0
    return MaskStatistics(len(files) or len(sample.shares), share, sample.problem)


def _cell_shares(image: Image, counts: Bool[np.ndarray, "H W"]) -> Float64[np.ndarray, "R C"]:
    """The share of the pixels that count, in each cell of an image."""
    shares: np.ndarray = counts
    for axis, number in enumerate(_cells_of(image)):
        starts = np.arange(number) * shares.shape[axis] // number
        sizes = np.diff([*starts, shares.shape[axis]])
        total = np.add.reduceat(shares, starts, axis=axis, dtype=np.float64)
        shares = total / np.expand_dims(np.maximum(sizes, 1), 1 - axis)
    return shares


def _five(values: np.ndarray) -> Five:
    return tuple(np.percentile(values, (5, 25, 50, 75, 95)).tolist())


def untrainable(scene: Scene) -> str:
    """Why no trainer can use the scene, and what to do, in a sentence; empty if nothing is missing.

    Lens distortion is no such reason: it can be removed (``is_distorted``).
    """
    if not scene.images:
        return "Points alone cannot be trained: that needs their scene's photographs and cameras."
    if not all(scene.split()):
        return "Training needs at least two photographs, one to train on and one to test."
    folder = scene.source.image_dir if scene.source else None
    if folder is None:
        return "Training needs the photographs: put them beside the model in a folder named images."
    missing = [image.name for image in scene.images if not (folder / image.name).is_file()]
    if 2 * len(missing) <= len(scene.images):
        return ""
    needs = f"Training needs at least half of the {len(scene.images):,} photographs"
    if kind := special_kind(folder / missing[0]):
        return f"{needs}: {visible(missing[0])} is {kind}."
    which = agreeing(len(missing), "", f"and {len(missing) - 1:,} more ")
    return f"{needs}: put {visible(missing[0])} {which}into {visible(folder)}."


def is_distorted(scene: Scene) -> bool:
    """Whether any of the images' cameras has lens distortion."""
    return any(image.intrinsics.has_distortion for image in scene.images)


@dataclass(frozen=True)
class GeometryScore:
    """Geometric quality of upsampled points, in units of the originals' spacing h.

    A few mismatched originals can make up most of the mean error.
    """

    error: float  # mean distance from a new point to the surface; NaN without new points
    median: float  # of the same
    p95: float  # of the same
    coverage: float  # mean distance from a surface sample to the nearest of all points
    share_far: float  # share of new points far from every original (``far_share``)


def measure(
    new_xyz: Float[np.ndarray, "M 3"],
    all_xyz: Float[np.ndarray, "N 3"],
    surfaces: Any,
    surface_samples: Float[np.ndarray, "S 3"],
    h: float,
) -> GeometryScore:
    """Compare new points with known surfaces, which have ``distance(xyz)``.

    The whole cloud has originals first, the new points last; to score originals alone, pass them as
    new. Samples lie evenly on the surfaces. The unit h is usually ``spacing(originals)``.

    Raises:
        PointCloudError: There are no points, or ``h`` is not positive.
    """
    if len(all_xyz) == 0 or not h > 0:
        raise PointCloudError(
            "at least one point and a spacing above zero to measure with",
            found=f"{len(all_xyz)} points and a spacing of {h}",
            fix="Pass the whole cloud and spacing(originals).",
        )
    errors = surfaces.distance(new_xyz) / h if len(new_xyz) else np.array([np.nan])
    coverage = cKDTree(all_xyz).query(surface_samples)[0].mean() / h
    originals = all_xyz[: len(all_xyz) - len(new_xyz)]
    share = far_share(originals, new_xyz) if len(originals) else 0.0
    median, p95 = (float(value) for value in np.percentile(errors, [50, 95]))
    return GeometryScore(float(errors.mean()), median, p95, float(coverage), share)


def spacing(xyz: Float[np.ndarray, "N 3"]) -> float:
    """h: the mean over the points of their local spacing, in scene units.

    Raises:
        PointCloudError: Fewer than two distinct finite points.
    """
    finite = _distinct(xyz)
    h = float(_spacing(cKDTree(finite), finite).mean()) if len(finite) else 0.0
    if not h > 0:
        raise PointCloudError(
            "at least two distinct finite points to take a spacing of",
            found=f"{len(xyz)} points, {len(finite)} of them distinct and finite",
            fix="Check that the cloud was read correctly.",
        )
    return h


def _distinct(xyz: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "M 3"]:
    """The finite points without repeats, in their order."""
    finite = xyz[np.isfinite(xyz).all(axis=1)]
    distinct: Float[np.ndarray, "M 3"] = finite[first_of_equals(finite)]
    return distinct


def _spacing(tree: cKDTree, xyz: Float[np.ndarray, "M 3"]) -> Float64[np.ndarray, " M"]:
    """The spacing of some of a tree's points, [M]; 0 if there are no others."""
    distances, _ = tree.query(xyz, k=NEIGHBORS + 1)
    # The point itself has distance 0, missing neighbours inf.
    counts = (distances > 0) & np.isfinite(distances)
    total = np.where(counts, distances, 0.0).sum(axis=1)
    return np.asarray(total / np.maximum(counts.sum(axis=1), 1))


def far_share(originals_xyz: Float[np.ndarray, "N 3"], new_xyz: Float[np.ndarray, "M 3"]) -> float:
    """Share 0..1 of new points farther than 3 h from any original, h local to the nearest one.

    A sample of the new points is judged; a non-finite one counts as far.

    Raises:
        PointCloudError: There are new points but no finite original.
    """
    if len(new_xyz) == 0:
        return 0.0
    originals = _distinct(originals_xyz)
    if len(originals) == 0:
        raise PointCloudError(
            "finite original points to compare the new ones with",
            found=f"none among {len(originals_xyz)}",
            fix="Check that the cloud was read correctly.",
        )
    sample = new_xyz
    if len(sample) > FAR_SAMPLE:
        sample = sample[np.random.default_rng(0).choice(len(sample), FAR_SAMPLE, replace=False)]
    # An unbalanced tree is built several times faster, and only few queries follow.
    tree = cKDTree(originals, balanced_tree=False, compact_nodes=False)
    to_original, nearest = tree.query(sample[np.isfinite(sample).all(axis=1)])
    h = _spacing(tree, originals[nearest])
    return float(1.0 - np.count_nonzero(to_original <= FAR_SPACINGS * h) / len(sample))
