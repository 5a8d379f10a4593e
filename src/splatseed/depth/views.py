"""Read one image at a time: align its map, draw pixels, lift and colour them, keep a reduced copy.

Notation: a *view* is kept of an image once its files are closed: C candidates, and reduced copies
of the map and the photograph, with which other images' candidates are compared. A map is H x W;
``cells`` are squares of ``step`` pixels with a weight each; a pixel's number is row * W + column.
w = 1 / depth is linear in the image on a plane at any slant, so w(-k) + w(+k) = 2 w(0) there, and a
discontinuity shows as a residual.
Promise: each file is read once. Pixels drawn have depth, lie away from discontinuities and where
SfM has few points; none is drawn twice; there are at least the requested number, or all there are.
Candidates depend on the image, the seed and the settings only, not on threads or other images.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from PIL import Image as PilImage

from splatseed.camera import Camera
from splatseed.depth._kernels import chamfer_distance, draw_pixels, find_edges
from splatseed.depth.alignment import (
    Alignment,
    PlanarDepth,
    align_map,
    check_units,
    lift_pixels,
    map_camera,
)
from splatseed.depth.settings import DepthSettings
from splatseed.depthmap import DepthMap, DepthMaps, in_scene_units
from splatseed.frozen import read_only_view
from splatseed.io.photograph_checks import check_sizes
from splatseed.photos.loading import refuse_distortion
from splatseed.photos.view import surface_pixels
from splatseed.photos.visibility import Visibility, points_in_image
from splatseed.scene import Image


@dataclass(frozen=True)
class _Sampling:
    """Sampling of pixels, and the size of reduced copies."""

    reduced_side: int = 256  # longer side of a reduced copy: 7 bytes x 256 x 256 per image at most
    max_cells: int = 64  # cells along the longer side of a map
    max_rounds: int = 4  # rounds of drawing, each for the pixels still missing
    min_distance: float = 0.5  # cells; that of a cell with SfM points, which stays open to new ones
    surplus: float = 1.15  # overdraw: some pixels are unknown or near a discontinuity
    min_usable: float = 0.05  # fraction of the drawn pixels that is assumed usable


SAMPLING = _Sampling()


class Reduced(NamedTuple):
    """An image's depth and colours on a coarse grid."""

    z: Float32[np.ndarray, "h w"]  # planar depth at the grid's points; NaN where unknown
    factor: float  # scene units per unit of z
    grid_from_world: Float64[np.ndarray, "3 4"]  # to (column z, row z, z), points at whole numbers
    rgb: UInt8[np.ndarray, "p q 3"]  # the photograph, smoothed and smaller
    rgb_from_grid: Float64[np.ndarray, "2 2"]  # factor and offset of columns, then of rows


@dataclass(frozen=True, eq=False)
class DepthView:
    """Candidates and reduced copies of an image; of a rejected map only the alignment."""

    alignment: Alignment
    camera: Camera  # in pixels of the map
    pixel: Int64[np.ndarray, " C"]  # numbers row * W + column, roughly row by row
    z: Float32[np.ndarray, " C"]  # planar depth in scene units
    rgb: UInt8[np.ndarray, "C 3"]
    edge: Bool[np.ndarray, " C"]  # near a depth discontinuity
    exhausted: bool  # the map has no more pixels to give
    reduced: Reduced | None  # None where views are not compared

    def __len__(self) -> int:
        return len(self.pixel)

    def samples(self, num: int, factor: float = 1.0) -> Float32[np.ndarray, "num 3"]:
        """World positions of up to ``num`` candidates (at least one), spread over the image."""
        num = min(num, len(self))
        # Pixels are ordered roughly row by row, so even indices spread over the image.
        which = ((np.arange(num) + 0.5) * (len(self) / num)).astype(np.int64)
        return lift_pixels(self.pixel[which], self.z[which], self.camera, factor)


def read_view(
    image: Image,
    depths: DepthMaps,
    visibility: Visibility,
    settings: DepthSettings,
    num: int,
    rng: np.random.Generator,
) -> DepthView:
    """Read an image and its map, and draw about ``num`` candidates."""
    refuse_distortion(image, reason="along whose rays pixels are lifted")
    depth = depths.read(image.name).reliable(settings.min_confidence)
    surface = surface_pixels(image.read_mask(), image.read_empty())
    if surface is not None:
        values = np.where(pixels_within(surface, depth), depth.values, np.float32(np.nan))
        depth = replace(depth, values=values)
    camera = map_camera(depth, image)
    points = points_in_image(camera, visibility.of(image))
    ray = {"unit_ray": settings.unit_ray}
    if settings.align:
        alignment = align_map(
            depth, camera, points, settings.fit, settings.min_points,
            in_units=in_scene_units(depths), **ray,
        )  # fmt: skip
    else:
        alignment = check_units(depth, camera, points, **ray)
    if alignment.rejected is not None:
        none, no_rgb = np.empty(0, np.int64), np.empty((0, 3), np.uint8)
        no_z = np.empty(0, np.float32)
        return DepthView(alignment, camera, none, no_z, no_rgb, none > 0, True, None)
    scale, shift = alignment.scale, alignment.shift
    planar = PlanarDepth.from_map(depth, camera, scale, shift, **ray)
    pixel, edge = sample_pixels(planar.values, num, points.uv, settings, rng)
    z, unit, coarse = planar.at_pixels(pixel), planar.scale, None
    if settings.compares_views or settings.synchronizes:
        step = -(-max(planar.values.shape) // SAMPLING.reduced_side)
        coarse = planar.strided(step // 2, step)
    del depth, planar  # before the photograph needs memory
    photograph = image.read()
    check_sizes([image])
    height, width = photograph.shape[:2]
    row, column = (index + 0.5 for index in np.divmod(pixel, camera.width))
    row = (row * height / camera.height).astype(np.int64)
    column = (column * width / camera.width).astype(np.int64)
    rgb = photograph[row, column]
    picture = PilImage.fromarray(photograph)
    reduced = None if coarse is None else _reduce(camera, coarse, unit, picture)
    return DepthView(alignment, camera, pixel, z, rgb, edge, len(pixel) < num, reduced)


def pixels_within(mask: Bool[np.ndarray, "P Q"], depth: DepthMap) -> Bool[np.ndarray, "H W"]:
    """Pixels of a map that lie entirely within the photograph's mask."""
    for axis, size in enumerate(depth.values.shape):
        starts = np.arange(size) * mask.shape[axis] // size
        mask = np.logical_and.reduceat(mask, starts, axis=axis)
    return mask


def _reduce(
    camera: Camera, coarse: Float32[np.ndarray, "h w"], unit: float, photograph: PilImage.Image
) -> Reduced:
    """Reduce a map to every f-th pixel, as means would bridge edges, and a photograph by means."""
    factor = -(-max(camera.width, camera.height) // SAMPLING.reduced_side)
    first = factor // 2 + 0.5
    grid_from_map = np.array([[1, 0, -first], [0, 1, -first], [0, 0, factor]]) / factor
    size = [
        -(-side // -(-max(photograph.size) // SAMPLING.reduced_side)) for side in photograph.size
    ]
    # The mean of 2 x 2 samples of a block is smooth enough and several times as fast as its mean.
    samples = photograph.resize((2 * size[0], 2 * size[1]), resample=0)
    block_from_map = np.array(size) / [camera.width, camera.height]
    return Reduced(
        coarse,
        unit,
        grid_from_map @ camera.pixels_from_world,
        np.asarray(samples.reduce(2)),
        block_from_map[:, None] * [[factor, first]],
    )


def sample_pixels(
    values: Float32[np.ndarray, "H W"],
    num: int,
    points: Float64[np.ndarray, "M 2"],
    settings: DepthSettings,
    rng: np.random.Generator,
) -> tuple[Int64[np.ndarray, " C"], Bool[np.ndarray, " C"]]:
    """Draw ``num`` distinct pixels with depth, or a few more; fewer if the map has fewer.

    ``values`` are positive where known, else NaN; ``points`` are where SfM points lie, in pixels.

    Returns:
        The pixels' numbers, and whether each lies near a discontinuity; those are drawn last.
    """
    # The central part of each dimension.
    top, left = (round(0.5 * (1.0 - settings.central_fraction) * size) for size in values.shape)
    box = (top, left, values.shape[0] - top, values.shape[1] - left)
    step = -(-max(values.shape) // SAMPLING.max_cells)
    weight = np.ones([-(-size // step) for size in values.shape])
    if settings.placement != "uniform" and len(points):
        weight[:] = np.inf
        column, row = (points // step).astype(np.int64).T
        weight[row, column] = 0.0
        chamfer_distance(weight)
        # The root of a cell's distance to the nearest one with an SfM point: by the distance itself
        # too few pixels near points are drawn. The root leaves the smallest gaps in test frames of
        # two captures.
        weight = np.sqrt(np.maximum(weight, SAMPLING.min_distance))
    cumulative = np.cumsum(weight, dtype=np.float64)
    # Radius and tolerance of the discontinuity test; radius 0 passes all.
    edges = (0, np.inf)
    if settings.edge_tolerance is not None:
        edges = settings.edge_radius, settings.edge_tolerance
    pixel, tried, values = np.empty(0, np.int64), 0, read_only_view(values)
    for _ in range(SAMPLING.max_rounds):
        missing = num - len(pixel)
        if missing <= 0:
            break
        # The fraction of usable pixels so far determines how many to try.
        usable = max(len(pixel) / tried, SAMPLING.min_usable) if tried else 1.0
        picks = rng.random(int(SAMPLING.surplus * missing / usable) + 1)
        if settings.placement == "uniform":
            picks.sort()
        else:  # stratified: one in each part
            picks = (np.arange(len(picks)) + picks) / len(picks)
        # Inverse of the cumulative weight: a cell is drawn in proportion to its weight.
        picks *= cumulative[-1]
        jitter = rng.random((len(picks), 2), dtype=np.float32)
        part = np.empty(len(picks), np.int64)
        drawn = draw_pixels(
            values, cumulative, weight.shape[1], step, box, picks, jitter, *edges, part
        )
        pixel = part[:drawn] if not tried else np.unique(np.concatenate([pixel, part[:drawn]]))
        tried += len(picks)
    edge = np.zeros(len(pixel), np.bool_)
    if len(pixel) >= num:
        return pixel, edge
    # The missing ones are drawn from all others, whatever their weight, edges last.
    free = np.zeros(values.shape, bool)
    inner = np.s_[box[0] : box[2], box[1] : box[3]]
    free[inner] = (values[inner] > 0) & (values[inner] < np.inf)
    free.ravel()[pixel] = False
    rest = rng.permutation(np.flatnonzero(free))
    near = np.empty(len(rest), np.bool_)
    find_edges(values, rest, *edges, near)
    chosen = np.argsort(near, kind="stable")[: num - len(pixel)]
    return np.concatenate([pixel, rest[chosen]]), np.concatenate([edge, near[chosen]])
