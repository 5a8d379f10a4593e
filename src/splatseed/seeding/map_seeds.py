"""Seeds from a sensor's depth maps where a cloud leaves cells of the photographs empty.

Notation: cells are those of ``photos.zbuffer``. The *cell map* of a view is its map's planar depth
at the centre of each cell, NaN where the map has none, where its confidence is too low, and near
discontinuities. Views are processed in order, each with the seeds of the views before; an empty
cell with a depth gets one seed. Another view *sees through* a seed that lies in front of all its
known depths around the seed's cell, by more than ``MAPS.tolerance``; then there is no seed.
Promise: seeds lie at measured depths, never at guesses; nothing is random, and bytes do not depend
on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from splatseed.checkup.poses import compare_samples
from splatseed.depth._kernels import find_edges
from splatseed.depth.alignment import LIMITS, map_camera
from splatseed.depth.kinds import UNIT_MISMATCH
from splatseed.depth.settings import DepthSettings
from splatseed.depth.stereo.maps import StereoResult
from splatseed.depthmap import MIN_CONFIDENCE, DepthMap, DepthMaps
from splatseed.findings import Finding
from splatseed.frozen import read_only_view
from splatseed.lens import project_rays
from splatseed.methods import source_code
from splatseed.photos.view import View
from splatseed.photos.zbuffer import cell_depths
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, in_threads, silent
from splatseed.projection import denormalized, normalized, pixel_centers, project
from splatseed.scene import Image, Scene
from splatseed.seeding.cover import GrowableArray, make_seeds
from splatseed.text import agreeing, counted, name_some

CellMap = Float32[np.ndarray, "rows cols"]


@dataclass(frozen=True)
class _MapSettings:
    confidence: float = 0.5  # of a seed: above cover's guesses, below what photographs confirm
    tolerance: float = 0.05  # relative depth by which a view must see past a seed
    same_unit: float = 1.05  # ratio of factors that are one unit


MAPS = _MapSettings()


def seeds_from_maps(
    views: Sequence[View],
    xyz: Float32[np.ndarray, "N 3"],
    maps: Sequence[CellMap],
    sources: Int64[np.ndarray, "V K"],
    cell: float,
    progress: Progress = silent,
) -> PointCloud:
    """Put a seed into every empty cell whose depth is known.

    Args:
        views: Photographs with their pixels.
        xyz: The points so far, finite.
        maps: The views' cell maps, as ``cell_maps`` returns.
        sources: The other views to compare each with, int64 [V, K]; -1 = none.
        cell: Side of a cell, in pixels.
        progress: Called with the stage and the fraction done.
    """
    cloud = GrowableArray(np.ascontiguousarray(xyz, np.float32))
    parts = []
    for i, view in enumerate(views):
        covered = np.isfinite(cell_depths(view.camera, cloud.values, cell))
        empty = np.flatnonzero(~covered & np.isfinite(maps[i]))
        found = maps[i].ravel()[empty], np.ones(len(empty), np.float32)
        seeds = make_seeds(view, cell, empty, found, view.surface)
        others = [j for j in sources[i].tolist() if j >= 0]
        seeds = seeds.select(~_seen_through(seeds.xyz, views, maps, others, cell))
        cloud.append(seeds.xyz)
        parts.append(seeds.replace(confidence=np.full(len(seeds), MAPS.confidence)))
        progress("depth maps", (i + 1) / len(views))
    return PointCloud.concatenate(*parts).with_source(source_code("depth"))


def in_scene_unit(
    stereo: StereoResult, names: Sequence[str], maps: Sequence[CellMap]
) -> tuple[list[CellMap], tuple[Finding, ...]]:
    """Return the maps without those whose depth contradicts the photographs', and a finding on it.

    A map with too few cells that photographs confirm is compared by those of all maps. If all are
    off by the same factor, they have another unit, and are divided by it.

    Args:
        stereo: Stereo of the photographs.
        names: Names of its views' images.
        maps: Cell maps of the views. A map that is left out becomes NaN.
    """
    ratios = [_ratios(stereo, i, known) for i, known in enumerate(maps)]
    pooled = np.concatenate(ratios)
    known = [i for i, each in enumerate(maps) if np.isfinite(each).any()]
    enough = {i: len(ratios[i]) >= LIMITS.unit_points for i in known}
    wrong = [i for i in known if not _same_unit(ratios[i] if enough[i] else pooled)]
    if not wrong:
        return list(maps), ()
    if wrong == known and (unit := _common_factor([ratios[i] for i in known])) is not None:
        text = (
            "The scene's depth maps have another unit than its poses: their depth is "
            f"{unit:.4g} times that of the photographs, and is divided by it."
        )
        return [each / np.float32(unit) for each in maps], (Finding(UNIT_MISMATCH, text),)
    kept = [np.full_like(each, np.nan) if i in wrong else each for i, each in enumerate(maps)]
    factor = f"{np.median(np.concatenate([ratios[i] for i in wrong])):.4g}"
    left_out = tuple(names[i] for i in wrong)
    if wrong == known:
        text = (
            f"The scene's depth maps are left out: their depth is {factor} times that of the "
            "photographs, so they have another unit."
        )
    else:
        are, which = agreeing(len(wrong), "is", "are"), name_some(left_out, 3)
        text = (
            f"{len(wrong)} of {counted(len(known), 'depth map')} {are} left out ({which}): depth "
            f"is {factor} times that of the photographs."
        )
    return kept, (Finding(UNIT_MISMATCH, text, subjects=left_out),)


def unit_ratio(scene: Scene, images: Sequence[Image]) -> float | None:
    """Return the depth of a scene's maps relative to that of its photographs; None if it agrees.

    A few photographs are compared without the maps: started at wrong depths, stereo finds too
    little to contradict them.
    """
    ratios = np.empty(0)
    for stereo, chosen in compare_samples(scene, images):
        assert scene.depths is not None  # noqa: S101  (callers check)
        maps = cell_maps(stereo.views, chosen, scene.depths, stereo.settings.grid, MIN_CONFIDENCE)
        found = [_ratios(stereo, i, known) for i, known in enumerate(maps)]
        ratios = np.concatenate([ratios, *found])
        if len(ratios) >= LIMITS.unit_points:
            break
    return None if _same_unit(ratios) else float(np.median(ratios))


def _same_unit(ratios: Float64[np.ndarray, " M"]) -> bool:
    """Whether ratios of depth, if there are enough, are about 1 at the median."""
    if len(ratios) < LIMITS.unit_points:
        return True
    return bool(1.0 / LIMITS.unit_factor < np.median(ratios) < LIMITS.unit_factor)


def _common_factor(ratios: Sequence[Float64[np.ndarray, " M"]]) -> float | None:
    """The factor by which all maps' depth is off; None if they, or the parts of one, differ.

    A power of ten is taken to be exact.
    """
    factors = [float(np.median(each)) for each in ratios if len(each) >= LIMITS.unit_points]
    if not factors or max(factors) > MAPS.same_unit * min(factors):
        return None
    low, factor, high = np.percentile(np.concatenate(ratios), [25, 50, 75])
    if high > MAPS.same_unit * low:
        return None
    power = 10.0 ** np.round(np.log10(factor))
    return float(power if abs(factor / power - 1) < MAPS.same_unit - 1 else factor)


def _ratios(stereo: StereoResult, i: int, known: CellMap) -> Float64[np.ndarray, " M"]:
    """Return a cell map's depth over stereo's, at the cells' centres where both are known."""
    confirmed, shape = stereo.confirmed(i), np.array(known.shape)
    row, column = np.indices(known.shape)
    row = (row * confirmed.shape[0] + confirmed.shape[0] // 2) // shape[0]
    column = (column * confirmed.shape[1] + confirmed.shape[1] // 2) // shape[1]
    both = confirmed[row, column] & np.isfinite(known)
    # Planes hold inverse depth.
    return np.asarray((known * stereo.planes[i][0][row, column])[both], np.float64)


def _seen_through(
    points: Float32[np.ndarray, "M 3"],
    views: Sequence[View],
    maps: Sequence[CellMap],
    others: Sequence[int],
    cell: float,
) -> Bool[np.ndarray, " M"]:
    """Mark points in front of everything that one of some other views shows around them."""
    seen = np.zeros(len(points), np.bool_)
    for j in others:
        column, row, depth = project(views[j].camera.cells_from_world(cell), points)
        rows, cols = maps[j].shape
        inside = (depth > 0) & (column >= 0) & (column < cols) & (row >= 0) & (row < rows)
        at = np.flatnonzero(inside)
        nearest = _nearest_around(maps[j])[row[at].astype(np.int64), column[at].astype(np.int64)]
        # False where nothing is known.
        seen[at] |= depth[at] < nearest * (1.0 - MAPS.tolerance)
    return seen


def _nearest_around(known: CellMap) -> CellMap:
    """Return the smallest depth among each cell and its eight neighbours; NaN if one is unknown."""
    padded = np.pad(known, 1, constant_values=np.inf)
    shifted = [
        padded[i : i + known.shape[0], j : j + known.shape[1]] for i in range(3) for j in range(3)
    ]
    return np.asarray(np.minimum.reduce(shifted))  # NaN propagates


def cell_maps(
    views: Sequence[View],
    images: Sequence[Image],
    depths: DepthMaps,
    cell: float,
    min_confidence: int,
    progress: Progress = silent,
) -> list[CellMap]:
    """Read the maps of some views' images, at the centres of their cells.

    Args:
        views: The views, without lens distortion.
        images: Their images, as photographed.
        depths: Maps in scene units.
        cell: Side of a cell, in pixels of the views.
        min_confidence: Depth of a lower confidence is unknown.
        progress: Called with the stage and the fraction done.
    """
    found = [np.full(view.camera.grid_shape(cell), np.nan, np.float32) for view in views]

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            if images[i].name in depths:
                depth = depths.read(images[i].name).reliable(min_confidence)
                found[i] = depth_at_cells(views[i], images[i], depth, cell)

    in_threads(work, len(views), 1, "read depth maps", progress)
    return found


def depth_at_cells(view: View, image: Image, depth: DepthMap, cell: float) -> CellMap:
    """Return planar depth at the centres of a view's cells, NaN where unknown or near an edge."""
    rows, cols = view.camera.grid_shape(cell)
    if depth.kind == "inverse":  # up to an unknown scale and shift
        return np.full((rows, cols), np.nan, np.float32)
    pixels = pixel_centers(rows, cols) * [view.width / cols, view.height / rows]
    rays = normalized(view.K, pixels)
    with np.errstate(all="ignore"):  # far outside, a lens model need not be finite
        places = _pixels_of_rays(image, depth, rays)
    inside = ((places >= 0) & (places < [depth.width, depth.height])).all(axis=-1)
    places = places[inside]
    z = _interpolated(depth.values, places)
    if depth.kind == "ray":
        z /= np.sqrt((rays[inside] ** 2).sum(axis=-1) + 1.0).astype(np.float32)
    settings, known = DepthSettings(), np.isfinite(z)
    number = places.astype(np.int64)[known] @ [1, depth.width]
    near = np.empty(len(number), np.bool_)
    values = read_only_view(depth.values)
    find_edges(values, number, settings.edge_radius, settings.edge_tolerance, near)
    z[np.flatnonzero(known)[near]] = np.nan
    cells = np.full((rows, cols), np.nan, np.float32)
    cells[inside] = z
    return cells


def _interpolated(
    values: Float32[np.ndarray, "H W"], places: Float64[np.ndarray, "M 2"]
) -> Float32[np.ndarray, " M"]:
    """Interpolate 1 / z, linear on planes, between four pixels; NaN where one is unknown."""
    size = np.array(values.shape[::-1])
    corner = np.clip(np.floor(places - 0.5), 0, np.maximum(size - 2, 0)).astype(np.int64)
    right, down = np.clip(places - 0.5 - corner, 0.0, 1.0).T
    (column, row), (next_column, next_row) = corner.T, np.minimum(corner + 1, size - 1).T
    weighted = (
        ((1 - right) * (1 - down), values[row, column]),
        (right * (1 - down), values[row, next_column]),
        ((1 - right) * down, values[next_row, column]),
        (right * down, values[next_row, next_column]),
    )
    with np.errstate(divide="ignore"):
        z = 1.0 / sum(weight / z for weight, z in weighted)
    return np.where((z > 0) & (z < np.inf), z, np.nan).astype(np.float32)


def _pixels_of_rays(
    image: Image, depth: DepthMap, rays: Float64[np.ndarray, "R C 2"]
) -> Float64[np.ndarray, "R C 2"]:
    """Project rays (x, y, 1) to the pixels of an image's map, with the image's lens."""
    camera = map_camera(depth, image)
    if depth.K is not None:
        return denormalized(camera.K, rays)
    lens = image.intrinsics
    return project_rays(lens, rays) * [depth.width / lens.width, depth.height / lens.height]
