"""One image at a time: align its map, draw pixels, lift and colour them; keep a reduced copy.

Notation: a *view* is what remains of an image once its files are closed: C candidates, and the map
and the photograph reduced to at most ``GRID`` pixels along the longer side, with which other
images' candidates are compared. A map is H x W; ``cells`` are squares of ``step`` pixels with a
weight each; a pixel's number is row * W + column. w = 1 / depth is linear in the image on a plane
at any slant, so w(-k) + w(+k) = 2 w(0) there, and a discontinuity shows as a residual.
Promise: each file is read once; pixels drawn are known ones, away from discontinuities, where SfM
has few points; none is drawn twice, and at least as many as are asked for, or all there are. The
candidates depend on the image, the seed and the settings only, not on threads or other images.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatseed.camera import Camera
from splatseed.depth.alignment import (
    Alignment,
    PlanarDepth,
    Settings,
    align_map,
    lift_pixels,
    map_camera,
    trust_units,
)
from splatseed.depthmap import DepthMap, DepthMaps
from splatseed.io.bit_depth import WHITE
from splatseed.io.masks import read_mask
from splatseed.io.photograph import decode_photograph, photograph_bytes
from splatseed.io.photograph_checks import check_sizes
from splatseed.photos.view import check_lens
from splatseed.photos.visibility import Visibility, points_in_image
from splatseed.runtime.jit import inline
from splatseed.scene import Image, Masks

if TYPE_CHECKING:
    from PIL import Image as PilImage

GRID = 256
"""Longer side of a reduced copy: at most 7 bytes x 256 x 256 per image are kept."""
CELLS = 64
"""Most cells along the longer side of a map."""
ROUNDS = 4
"""Most rounds of drawing, each for what the last has left missing."""
DIAGONAL = 2.0**0.5
"""Length of a diagonal step, in cells."""
LEAST_DISTANCE = 0.5
"""Distance, in cells, given to a cell that has points itself: it stays open to new ones."""
SURPLUS = 1.15
"""Overdraw factor: some pixels will be unknown or near a discontinuity."""
LEAST_SHARE = 0.05
"""Fraction of the drawn pixels that is assumed usable."""


class Reduced(NamedTuple):
    """An image's depth and colours on a coarse grid."""

    z: Float32[np.ndarray, "h w"]  # planar depth at the grid's points; NaN where unknown
    factor: float  # scene units per unit of z
    grid_from_world: Float64[np.ndarray, "3 4"]  # to (column z, row z, z), points at whole numbers
    rgb: UInt8[np.ndarray, "p q 3"]  # the photograph, smoothed and smaller
    rgb_from_grid: Float64[np.ndarray, "2 2"]  # factor and offset of columns, then of rows


@dataclass(frozen=True, eq=False)
class DepthView:
    """What remains of an image, with C candidates; if its map is rejected, only the alignment."""

    alignment: Alignment
    camera: Camera  # in pixels of the map
    pixel: Int64[np.ndarray, " C"]  # numbers row * W + column, roughly row by row
    z: Float32[np.ndarray, " C"]  # planar depth in scene units
    rgb: UInt8[np.ndarray, "C 3"]
    edge: Bool[np.ndarray, " C"]  # which lie near a depth discontinuity
    exhausted: bool  # the map has no more pixels to give
    reduced: Reduced | None  # none where views are not compared

    def __len__(self) -> int:
        """The number of candidates."""
        return len(self.pixel)

    def samples(self, num: int, factor: float = 1.0) -> Float32[np.ndarray, "num 3"]:
        """The positions of up to ``num`` candidates (one at least) spread evenly over the image."""
        num = min(num, len(self))
        # Pixels come roughly row by row, so even numbers are spread over the image.
        which = ((np.arange(num) + 0.5) * (len(self) / num)).astype(np.int64)
        return lift_pixels(self.pixel[which], self.z[which], self.camera, factor)


def read_view(
    image: Image,
    folder: Path,
    masks: Masks | None,
    depths: DepthMaps,
    visibility: Visibility,
    settings: Settings,
    num: int,
    rng: np.random.Generator,
    white: int = WHITE,
) -> DepthView:
    """Read an image from the photographs' folder and its map, and draw about ``num`` candidates."""
    check_lens(image, reason="along whose rays pixels are lifted")
    depth = depths.read(image.name)
    if (mask := read_mask(masks, image.name, folder / image.name)) is not None:
        values = np.where(counting(mask, depth), depth.values, np.float32(np.nan))
        depth = DepthMap(values, depth.kind)
    camera = map_camera(depth, image)
    points = points_in_image(camera, visibility.of(image))
    ray = {"unit_ray": settings.unit_ray}
    if settings.align:
        alignment = align_map(depth, camera, points, settings.fit, settings.min_points, **ray)
    else:
        alignment = trust_units(depth, camera, points, **ray)
    if alignment.rejected is not None:
        none, no_rgb = np.empty(0, np.int64), np.empty((0, 3), np.uint8)
        no_z = np.empty(0, np.float32)
        return DepthView(alignment, camera, none, no_z, no_rgb, none > 0, True, None)
    scale, shift = alignment.scale, alignment.shift
    planar = PlanarDepth.of(depth, camera, scale, shift, **ray)
    pixel, edge = sample_pixels(planar.values, num, points.uv, settings, rng)
    z, unit, coarse = planar.at(pixel), planar.scale, None
    if settings.compares_views or settings.synchronizes:
        # The whole step at which the longer side keeps at most GRID pixels.
        step = -(-max(planar.values.shape) // GRID)
        coarse = planar.every(step // 2, step)
    del depth, planar  # before the photograph needs memory
    path = folder / image.name
    photograph = decode_photograph(path, photograph_bytes(path), white)
    check_sizes([image], folder)
    row, column = (each + 0.5 for each in np.divmod(pixel, camera.width))
    row = (row * photograph.height / camera.height).astype(np.int64)
    column = (column * photograph.width / camera.width).astype(np.int64)
    rgb = np.asarray(photograph)[row, column]
    reduced = None if coarse is None else _reduce(camera, coarse, unit, photograph)
    return DepthView(alignment, camera, pixel, z, rgb, edge, len(pixel) < num, reduced)


def counting(mask: Bool[np.ndarray, "P Q"], depth: DepthMap) -> Bool[np.ndarray, "H W"]:
    """Which pixels of a map count: those of which all pixels of the photograph do."""
    for axis, size in enumerate(depth.values.shape):
        starts = np.arange(size) * mask.shape[axis] // size
        mask = np.logical_and.reduceat(mask, starts, axis=axis)
    return mask


def _reduce(
    camera: Camera, coarse: Float32[np.ndarray, "h w"], unit: float, photograph: PilImage.Image
) -> Reduced:
    """Every f-th pixel of the map, as means would bridge edges; block means of the photograph."""
    factor = -(-max(camera.width, camera.height) // GRID)
    first = factor // 2 + 0.5
    grid_from_map = np.array([[1, 0, -first], [0, 1, -first], [0, 0, factor]]) / factor
    size = [-(-side // -(-max(photograph.size) // GRID)) for side in photograph.size]
    # The mean of 2 x 2 samples of each block is smooth enough, and several times as fast as the
    # mean of the block.
    samples = photograph.resize((2 * size[0], 2 * size[1]), resample=0)
    block_from_map = np.array(size) / [camera.width, camera.height]
    return Reduced(
        coarse,
        unit,
        grid_from_map @ camera.K @ camera.cam_from_world[:3],
        np.asarray(samples.reduce(2)),
        block_from_map[:, None] * [[factor, first]],
    )


def sample_pixels(
    values: Float32[np.ndarray, "H W"],
    num: int,
    points: Float64[np.ndarray, "M 2"],
    settings: Settings,
    rng: np.random.Generator,
) -> tuple[Int64[np.ndarray, " C"], Bool[np.ndarray, " C"]]:
    """Draw ``num`` distinct pixels with depth, or a few more; fewer if the map has fewer.

    ``values`` are positive where known, else NaN; ``points`` are where SfM points lie, in pixels.
    Returns the pixels' numbers, and which lie near a discontinuity: those are drawn last.
    """
    # The central share of each dimension.
    top, left = (round(0.5 * (1.0 - settings.region) * size) for size in values.shape)
    box = (top, left, values.shape[0] - top, values.shape[1] - left)
    step = -(-max(values.shape) // CELLS)
    weight = np.ones([-(-size // step) for size in values.shape])
    if settings.placement != "uniform" and len(points):
        weight[:] = np.inf
        column, row = (points // step).astype(np.int64).T
        weight[row, column] = 0.0
        _spread_distance(weight)
        # The root of a cell's distance to the nearest one with an SfM point. The distance itself
        # would leave too little for the surroundings of points: compared with held-out frames of
        # two captures, the root leaves the smallest gaps.
        weight = np.sqrt(np.maximum(weight, LEAST_DISTANCE))
    cumulative = np.cumsum(weight, dtype=np.float64)
    # Radius and tolerance of the discontinuity test; radius 0 passes all.
    edges = (0, np.inf)
    if settings.edge_tolerance is not None:
        edges = settings.edge_radius, settings.edge_tolerance
    pixel, tried = np.empty(0, np.int64), 0
    for _ in range(ROUNDS):
        missing = num - len(pixel)
        if missing <= 0:
            break
        # The share of usable pixels so far tells how many to try.
        usable = max(len(pixel) / tried, LEAST_SHARE) if tried else 1.0
        picks = rng.random(int(SURPLUS * missing / usable) + 1)
        if settings.placement == "uniform":
            picks.sort()
        else:  # stratified: one in each part
            picks = (np.arange(len(picks)) + picks) / len(picks)
        # Inverse of the cumulative weight: a cell is drawn in proportion to its weight.
        picks *= cumulative[-1]
        jitter = rng.random((len(picks), 2), dtype=np.float32)
        part = np.empty(len(picks), np.int64)
        drawn = _draw(values, cumulative, weight.shape[1], step, box, picks, jitter, *edges, part)
        pixel = part[:drawn] if not tried else np.unique(np.concatenate([pixel, part[:drawn]]))
        tried += len(picks)
    edge = np.zeros(len(pixel), np.bool_)
    if len(pixel) >= num:
        return pixel, edge
    # As many others as are missing, whatever their weight, edges last.
    free = np.zeros(values.shape, bool)
    inner = np.s_[box[0] : box[2], box[1] : box[3]]
    free[inner] = (values[inner] > 0) & (values[inner] < np.inf)
    free.ravel()[pixel] = False
    rest = rng.permutation(np.flatnonzero(free))
    near = np.empty(len(rest), np.bool_)
    _mark_edges(values, rest, *edges, near)
    chosen = np.argsort(near, kind="stable")[: num - len(pixel)]
    return np.concatenate([pixel, rest[chosen]]), np.concatenate([edge, near[chosen]])


@inline
def _spread_distance(distance):  # type: ignore[no-untyped-def]  # Numba's types
    """Chamfer distances from a grid's zeros, in place, at most 8% too long (Borgefors, 1986)."""
    rows, columns = distance.shape
    # Forward from the upper left, then backward from the lower right.
    for sweep in range(2):
        for a in range(rows):
            row = a if sweep == 0 else rows - 1 - a
            before = row - 1 if sweep == 0 else row + 1
            for b in range(columns):
                column = b if sweep == 0 else columns - 1 - b
                beside = column - 1 if sweep == 0 else column + 1
                least = distance[row, column]
                if 0 <= beside < columns:
                    least = min(least, distance[row, beside] + 1.0)
                if 0 <= before < rows:
                    least = min(least, distance[before, column] + 1.0)
                    if column > 0:
                        least = min(least, distance[before, column - 1] + DIAGONAL)
                    if column < columns - 1:
                        least = min(least, distance[before, column + 1] + DIAGONAL)
                distance[row, column] = least


@inline
def _draw(values, cumulative, columns, step, box, picks, jitter, radius, tolerance, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Pixels in the cells that ascending ``picks`` fall into; returns the number of usable ones."""
    top, left, bottom, right = box
    cell, count, first = 0, 0, 0  # out[first:count] belong to this cell
    for k in range(len(picks)):
        while cell < len(cumulative) - 1 and cumulative[cell] <= picks[k]:
            cell += 1
            first = count
        row = cell // columns * step + int(jitter[k, 0] * step)
        column = cell % columns * step + int(jitter[k, 1] * step)
        if row < top or row >= bottom or column < left or column >= right:
            continue
        pixel = row * values.shape[1] + column
        if not 0 < values[row, column] < np.inf or _contains(out[first:count], pixel):
            continue
        if radius == 0 or not _near_edge(values, row, column, radius, tolerance):
            out[count] = pixel
            count += 1
    return count


@inline
def _contains(numbers, number):  # type: ignore[no-untyped-def]  # Numba's types
    """Whether a short list contains a number."""
    for each in numbers:  # noqa: SIM110  (Numba has no any() of a generator)
        if each == number:
            return True
    return False


@inline
def _mark_edges(values, pixel, radius, tolerance, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Which of the pixels lie near a depth discontinuity."""
    width = values.shape[1]
    for k in range(len(pixel)):
        row, column = pixel[k] // width, pixel[k] % width
        out[k] = radius > 0 and _near_edge(values, row, column, radius, tolerance)


@inline
def _near_edge(values, row, column, radius, tolerance):  # type: ignore[no-untyped-def]  # Numba's types
    """Whether 1 / depth bends within ``radius``, across, down or diagonally, or is mostly unknown.

    All distances are tested along the row, where memory is near, and only the largest one
    elsewhere: there, a discontinuity that is crossed twice can be missed.
    """
    # w(-k) + w(+k) - 2 w(0), relative to w(0): 0 on any plane
    here = 2.0 / values[row, column]
    known, pairs = 0, 0
    for k in range(1, radius + 4):
        dy, dx = 0, k
        if k > radius:
            dy, dx = radius, radius * (k - radius - 2)
        y0, x0, y1, x1 = row - dy, column - dx, row + dy, column + dx
        if y0 < 0 or y1 >= values.shape[0] or min(x0, x1) < 0 or max(x0, x1) >= values.shape[1]:
            continue
        pairs += 1
        before, after = values[y0, x0], values[y1, x1]
        if 0 < before < np.inf and 0 < after < np.inf:
            known += 1
            if abs(1.0 / before + 1.0 / after - here) > 0.5 * tolerance * here:
                return True
    # Beside unknown depth there may be an edge, too.
    return 2 * known < pairs
