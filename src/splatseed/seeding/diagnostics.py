"""What a scene contains and what is wrong with it, in numbers.

Track lengths count images, reprojection errors are in px, spacing is that of ``geometry_score``.
Percentiles are 5, 25, 50, 75, 95. Nothing is random; photographs are opened only for their masks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from splatseed.depthmap import in_scene_units
from splatseed.errors import SplatseedError
from splatseed.findings import Finding
from splatseed.methods.neighbors import prepare, sound_bases
from splatseed.photos.view import surface_pixels
from splatseed.photos.visibility import points_in_image
from splatseed.progress import Progress, silent
from splatseed.sampling import strided
from splatseed.scene import Image, Scene
from splatseed.text import agreeing, counted
from splatseed.tracks import NO_POINT

EMPTY_CELLS = 32  # cells of the grid of empty regions along an image's longer side
MIN_UNMASKED = 0.5  # minimum fraction of a cell's pixels that count for the cell to count
MAX_MASKS_READ = 32
MAX_MAPS_READ = 16
MAX_ISOLATED, MAX_EMPTY = 0.02, 0.5
"""Fractions of isolated points, and of the images' area without points, above which to warn."""

Percentiles = tuple[float, ...]


@dataclass(frozen=True)
class CloudStatistics:
    """Statistics of the points alone; lengths are in scene units, NaN without finite points."""

    num_points: int
    non_finite: int  # points with a coordinate that is NaN or infinite
    duplicates: int  # finite points at exactly the position of an earlier one
    isolated: int  # points whose spacing is over 3 times that of their surroundings
    spacing: Percentiles
    low: tuple[float, ...]  # corner of the bounding box
    high: tuple[float, ...]
    resolution: float  # step of float32 at the greatest coordinate


@dataclass(frozen=True)
class TrackStatistics:
    """Statistics of the tracks."""

    mean_length: float
    length: Percentiles
    mean_error: float
    error: Percentiles


@dataclass(frozen=True)
class EmptyRegions:
    """The part of the images that no point projects into."""

    mean: float  # fraction of empty cells
    worst: float  # the same of the emptiest image
    worst_name: str


@dataclass(frozen=True)
class DepthMapStatistics:
    """Statistics of a scene's depth maps, by a sample of them."""

    num_maps: int
    width: int  # pixels of the first
    height: int
    known: float  # fraction of the pixels with a depth
    confidence: (
        tuple[float, float, float] | None
    )  # fractions of low, medium and high; None: unknown
    in_scene_units: bool  # whether method auto uses them


def cloud_statistics(scene: Scene, progress: Progress = silent) -> CloudStatistics:
    """Compute statistics of the points of a scene."""
    xyz, left = scene.points.xyz, scene.left_out
    finite = xyz[scene.points.finite].astype(np.float64)
    num, bad = len(xyz) + sum(left), len(xyz) - len(finite) + left.non_finite
    if len(finite) == 0:
        unknown = (np.nan,) * 3
        return CloudStatistics(
            num, bad, left.duplicates, 0, (np.nan,) * 5, unknown, unknown, np.nan
        )
    cloud = prepare(scene.points.replace(source=np.zeros(len(xyz), np.uint8)), progress=progress)
    # Isolation is that of originals among themselves: they are the bases of interpolation.
    added = 0 < scene.points.num_original < len(xyz)
    originals = prepare(scene.points) if added else cloud
    spacing = cloud.neighbors(16).spacing if len(cloud) > 1 else np.array([np.nan])
    isolated = 0
    if len(originals) > 1:
        isolated = int((sound_bases(originals, originals.neighbors(16)) == 0).sum())
    return CloudStatistics(
        num, bad, len(finite) - len(cloud) + left.duplicates, isolated, _percentiles(spacing),
        tuple(finite.min(axis=0).tolist()), tuple(finite.max(axis=0).tolist()),
        float(np.spacing(np.abs(finite).max().astype(np.float32))),
    )  # fmt: skip


def track_statistics(scene: Scene) -> TrackStatistics | None:
    """Compute statistics of track lengths and reprojection errors; None without tracks."""
    if scene.tracks is None or not np.any(scene.tracks.lengths):
        return None
    lengths, errors = scene.tracks.lengths, scene.tracks.errors
    known = errors[errors >= 0]
    if len(known) == 0:
        known = np.array([np.nan])
    return TrackStatistics(
        float(lengths.mean()), _percentiles(lengths), float(known.mean()), _percentiles(known)
    )


def depth_map_statistics(scene: Scene, progress: Progress = silent) -> DepthMapStatistics | None:
    """Read some of a scene's depth maps; None without any."""
    depths = scene.depths
    if depths is None or not len(depths):
        return None
    names = list(depths)
    sample = [names[i * len(names) // MAX_MAPS_READ] for i in range(MAX_MAPS_READ)]
    known, levels, first = list[float](), list[Float64[np.ndarray, " 3"]](), None
    for i, name in enumerate(dict.fromkeys(sample)):
        depth = depths.read(name)
        first = first or depth
        known.append(float(np.isfinite(depth.values).mean()))
        if depth.confidence is not None:
            counts = np.bincount(depth.confidence.ravel(), minlength=3)[:3]
            levels.append(counts / depth.confidence.size)
        progress("depth maps", (i + 1) / len(sample))
    assert first is not None  # noqa: S101  (there is a map)
    low, medium, high = np.mean(levels, axis=0).tolist() if levels else (np.nan,) * 3
    return DepthMapStatistics(
        len(names), first.width, first.height, float(np.mean(known)),
        (low, medium, high) if levels else None, in_scene_units(depths),
    )  # fmt: skip


def empty_regions(
    scene: Scene, progress: Progress = silent, sample: MaskSample | None = None
) -> EmptyRegions | None:
    """Measure the area of the images without points; None for a scene without images or points.

    Masked and transparent area does not count. Where there is any, the images of the ``sample``
    (read by default) represent all. Occlusion is not tested: a wall with points behind it counts as
    covered.
    """
    if not scene.images or not len(scene.points):
        return None
    xyz = np.asfortranarray(scene.points.xyz[scene.points.finite], np.float64)
    sample = read_mask_sample(scene, progress) if sample is None else sample
    images, files = list(scene.images), scene.masks.files if scene.masks else {}
    if any(cells is not None for cells in sample.cells.values()):
        unmasked = {image.name for image in images if files and image.name not in files}
        known = unmasked | sample.cells.keys()
        images = [image for image in images if image.name in known]
    shares: dict[str, float] = {}
    for i, image in enumerate(images):
        share = sample.cells.get(image.name)
        counts = np.ones(_grid_shape(image), bool) if share is None else share >= MIN_UNMASKED
        if counts.any():
            shares[image.name] = 1.0 - float(_occupied_cells(image, xyz)[counts].mean())
        progress("empty regions", (i + 1) / len(images))
    if not shares:
        return None
    worst = max(shares, key=lambda name: shares[name])
    return EmptyRegions(float(np.mean(list(shares.values()))), shares[worst], worst)


def find_problems(
    scene: Scene, cloud: CloudStatistics, regions: EmptyRegions | None
) -> tuple[Finding, ...]:
    """Return what is wrong with a scene; the findings of its reader first."""
    problems = list(scene.findings)
    used = cloud.num_points - cloud.non_finite - cloud.duplicates
    added = scene.points.num_original < len(scene.points)  # nothing will be interpolated
    if not added and cloud.isolated > MAX_ISOLATED * max(used, 1):
        text = (
            f"{counted(cloud.isolated, 'point')} ({cloud.isolated / used:.1%}) "
            f"{agreeing(cloud.isolated, 'is', 'are')} isolated: "
            "outliers or a sparse background; methods that interpolate never start from them"
        )
        problems.append(Finding("isolated-points", text))
    if cloud.num_points == 0:
        text = (
            "there are no points yet: make some by comparing the photographs (splatseed upsample), "
            "or triangulate some (splatseed sfm --poses-from)"
            if scene.has_photographs
            else "there are no points to upsample"
        )
        problems.append(Finding("no-points", text))
    elif regions is not None and regions.mean > MAX_EMPTY:
        text = (
            f"{regions.mean:.0%} of the images' area has no point: upsampling fills between "
            "points, but only photographs or depth maps can fill a bare wall"
        )
        problems.append(Finding("empty-regions", text))
    if cloud.num_points and track_statistics(scene) is None:
        features = (image.observations for image in scene.images)
        stray = sum(int(np.count_nonzero(f.point_ids != NO_POINT)) for f in features if f)
        if stray:
            text = (
                f"{stray:,} features of the photographs name points, but no point has a track: "
                "the points were added later, and a trainer that reads features gets wrong ones; "
                "what splatseed upsample writes of this scene is free of that"
            )
            problems.append(Finding("features-without-tracks", text))
    return tuple(problems)


def _grid_shape(image: Image) -> tuple[int, int]:
    width, height = image.camera.width, image.camera.height
    cell = max(width, height) / EMPTY_CELLS
    return max(math.ceil(height / cell), 1), max(math.ceil(width / cell), 1)


def _occupied_cells(image: Image, xyz: Float64[np.ndarray, "N 3"]) -> Bool[np.ndarray, "R C"]:
    """Tell which cells of an image's grid a point projects into."""
    camera, shape = image.camera, _grid_shape(image)
    # Cells are square; those of the last row and column may reach beyond the image.
    cell = max(camera.width, camera.height) / EMPTY_CELLS
    points = points_in_image(camera, xyz)
    column, row = (points.uv / cell).astype(np.int64).T
    occupied = np.zeros(shape, bool)
    occupied[np.minimum(row, shape[0] - 1), np.minimum(column, shape[1] - 1)] = True
    return occupied


@dataclass(frozen=True)
class MaskStatistics:
    """Statistics of the masks."""

    images: int  # masked photographs; with alpha channels only, those of the sample
    share: float  # mean fraction of masked pixels in the sample; 0 without masks
    findings: tuple[Finding, ...]  # why a mask of the sample cannot be used


@dataclass(frozen=True)
class MaskSample:
    """The masks of up to ``MAX_MASKS_READ`` photographs, evenly spread."""

    cells: Mapping[str, Float64[np.ndarray, "R C"] | None]
    """By image, the fraction of each cell's pixels that count; None without a mask."""
    shares: tuple[float, ...]  # fraction of masked pixels of each masked photograph
    findings: tuple[Finding, ...]  # why one cannot be used


def read_mask_sample(scene: Scene, progress: Progress = silent) -> MaskSample:
    """Read the masks of some photographs of a scene."""
    files = scene.masks.files if scene.masks else {}
    images = [im for im in scene.images if (im.name in files or not files) and im.has_photograph]
    images = strided(images, MAX_MASKS_READ)
    cells: dict[str, Float64[np.ndarray, "R C"] | None] = {}
    shares, findings = list[float](), list[Finding]()
    for i, image in enumerate(images):
        try:
            counts, empty = image.read_mask(), image.read_empty()
        except SplatseedError as error:
            findings.append(Finding("unusable-mask", str(error), "error", (image.name,)))
            continue
        surface = surface_pixels(counts, empty)
        cells[image.name] = None if surface is None else _cell_shares(image, surface)
        if image.name in files or counts is not None:
            shares.append(0.0 if counts is None else 1.0 - float(counts.mean()))
        progress("read masks", (i + 1) / len(images))
    return MaskSample(cells, tuple(shares), tuple(findings[:1]))


def mask_statistics(scene: Scene, sample: MaskSample) -> MaskStatistics:
    """Summarise a sample of masks."""
    files = scene.masks.files if scene.masks and sample.cells else {}
    share = float(np.mean(sample.shares)) if sample.shares else 0.0
    return MaskStatistics(len(files) or len(sample.shares), share, sample.findings)


def _cell_shares(image: Image, counts: Bool[np.ndarray, "H W"]) -> Float64[np.ndarray, "R C"]:
    """Return the fraction of the pixels that count, in each cell of an image."""
    shares: np.ndarray = counts
    for axis, number in enumerate(_grid_shape(image)):
        starts = np.arange(number) * shares.shape[axis] // number
        sizes = np.diff([*starts, shares.shape[axis]])
        total = np.add.reduceat(shares, starts, axis=axis, dtype=np.float64)
        shares = total / np.expand_dims(np.maximum(sizes, 1), 1 - axis)
    return shares


def _percentiles(values: np.ndarray) -> Percentiles:
    return tuple(np.percentile(values, (5, 25, 50, 75, 95)).tolist())
