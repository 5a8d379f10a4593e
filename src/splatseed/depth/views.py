"""One image at a time: align its map, draw pixels, lift and colour them; keep a reduced copy.

Notation: a *view* is what remains of an image once its files are closed: C candidates, and the map
and the photograph reduced to at most ``GRID`` pixels along the longer side, with which other
images' candidates are compared. Promise: each file is read once; the candidates depend on the
image, the seed and the settings only, not on threads or other images.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatseed.camera import Camera
from splatseed.depth.alignment import Alignment, align_map, trust_units
from splatseed.depth.pixel_sampling import Drawn, sample_pixels
from splatseed.depth.planar import PlanarDepth, lift_pixels, map_camera
from splatseed.depth.settings import Settings
from splatseed.depthmap import ASPECT_SLACK, DepthMap, DepthMaps
from splatseed.errors import SceneFormatError
from splatseed.io.photograph import decode_photograph, photograph_bytes
from splatseed.kernels.jit import inline
from splatseed.scene import Image
from splatseed.views.view import check_lens
from splatseed.views.visibility import SeenPoints, Visibility, camera_points

if TYPE_CHECKING:
    from PIL import Image as PilImage

GRID = 256
"""Longer side of a reduced copy: at most 7 bytes x 256 x 256 per image are kept."""


@dataclass(frozen=True, eq=False)
class Reduced:
    """An image's depth and colours on a coarse grid.

    Args:
        z: Planar depth at the grid's points, float32 [h, w]; NaN where unknown.
        factor: Scene units per unit of ``z``.
        grid_from_world: World to (column z, row z, z) of the grid, whose points are at whole
            numbers, float64 [3, 4].
        rgb: The photograph, smoothed and smaller, uint8 [p, q, 3].
        rgb_from_grid: Factor and offset from columns of the grid to those of ``rgb``, then of rows,
            float64 [2, 2].
    """

    z: Float32[np.ndarray, "h w"]
    factor: float
    grid_from_world: Float64[np.ndarray, "3 4"]
    rgb: UInt8[np.ndarray, "p q 3"]
    rgb_from_grid: Float64[np.ndarray, "2 2"]


@dataclass(frozen=True, eq=False)
class View:
    """What remains of an image; if its map is rejected, only the alignment.

    Args:
        alignment: The map's alignment.
        camera: The camera, in pixels of the map.
        pixel: Candidates, by their numbers row * W + column, int64 [C], roughly row by row.
        z: Their planar depth in scene units, float32 [C].
        rgb: Their colours, uint8 [C, 3].
        edge: Which lie near a depth discontinuity, bool [C].
        exhausted: Whether the map has no more pixels to give.
        reduced: The coarse copy; None if views are not compared.
    """

    alignment: Alignment
    camera: Camera
    pixel: Int64[np.ndarray, " C"]
    z: Float32[np.ndarray, " C"]
    rgb: UInt8[np.ndarray, "C 3"]
    edge: Bool[np.ndarray, " C"]
    exhausted: bool
    reduced: Reduced | None

    def __len__(self) -> int:
        """The number of candidates."""
        return len(self.pixel)

    def samples(self, num: int, factor: float = 1.0) -> Float32[np.ndarray, "num 3"]:
        """The positions of up to ``num`` candidates (one at least) spread evenly over the image.

        Args:
            num: How many.
            factor: Multiplies depth.
        """
        num = min(num, len(self))
        # Pixels come roughly row by row, so even numbers are spread over the image.
        which = ((np.arange(num) + 0.5) * (len(self) / num)).astype(np.int64)
        out = np.empty((num, 3), np.float32)
        return lift_pixels(self.pixel[which], self.z[which], self.camera, out, factor)


@dataclass(frozen=True, eq=False)
class Reader:
    """Turns images into views.

    Args:
        folder: The folder of the photographs.
        depths: The depth maps.
        visibility: The SfM points that each image sees.
        settings: The method's choices.
    """

    folder: Path
    depths: DepthMaps
    visibility: Visibility
    settings: Settings

    def read(self, image: Image, num: int, rng: np.random.Generator) -> View:
        """Read an image and its map, and draw ``num`` candidates, or a few more.

        Raises:
            SceneNotFoundError: A file is gone.
            SceneFormatError: A file is damaged, has the wrong aspect ratio, or the lens distorts.
        """
        check_lens(image, reason="along whose rays pixels are lifted")
        seen = self._read_map(image, num, rng)  # frees the map before reading the photograph
        if seen.alignment.rejected is not None:
            return _nothing(seen.alignment, seen.camera)
        photograph = decode_photograph(
            self.folder / image.name, photograph_bytes(self.folder / image.name)
        )
        _check_shape(self.folder / image.name, photograph, seen.camera)
        return View(
            seen.alignment,
            seen.camera,
            seen.drawn.pixel,
            seen.z,
            _colors_at(photograph, seen.drawn.pixel, seen.camera),
            seen.drawn.edge,
            exhausted=len(seen.drawn.pixel) < num,
            reduced=None if seen.coarse is None else _reduce(seen, seen.coarse, photograph),
        )

    def _read_map(self, image: Image, num: int, rng: np.random.Generator) -> _Seen:
        """Everything that is needed from a map."""
        depth = self.depths.read(image.name)
        camera = map_camera(depth, image)
        points = camera_points(camera, self.visibility.of(image))
        alignment = self._align(depth, camera, points)
        if alignment.rejected is not None:
            nothing = np.empty(0, np.int64)
            return _Seen(alignment, camera, Drawn(nothing, nothing > 0), np.empty(0, np.float32))
        planar = PlanarDepth.of(
            depth, camera, alignment.scale, alignment.shift, unit_ray=self.settings.unit_ray
        )
        drawn = sample_pixels(planar.values, num, points.uv, self.settings, rng)
        seen = _Seen(alignment, camera, drawn, planar.at(drawn.pixel))
        if not (self.settings.compares_views or self.settings.synchronizes):
            return seen
        # The whole step at which the longer side keeps at most GRID pixels.
        factor = -(-max(planar.values.shape) // GRID)
        return replace(seen, coarse=planar.every(factor // 2, factor), unit=planar.scale)

    def _align(self, depth: DepthMap, camera: Camera, points: SeenPoints) -> Alignment:
        if not self.settings.align:
            return trust_units(depth, camera, points)
        return align_map(depth, camera, points, self.settings.fit, self.settings.min_points)


@dataclass(frozen=True, eq=False)
class _Seen:
    """What is taken from a map: the fields of ``View`` before scales are synchronised."""

    alignment: Alignment
    camera: Camera
    drawn: Drawn
    z: Float32[np.ndarray, " C"]
    coarse: Float32[np.ndarray, "h w"] | None = None
    unit: float = 1.0


def _check_shape(path: Path, photograph: PilImage.Image, camera: Camera) -> None:
    stretch = photograph.width / camera.width / (photograph.height / camera.height)
    if abs(stretch - 1) > ASPECT_SLACK:
        raise SceneFormatError(
            f"{path} to have the aspect ratio of camera and map, {camera.width} x {camera.height}",
            found=f"{photograph.width} x {photograph.height}",
            fix="Use the images that the model was made from, or a resized copy of them.",
        )


def _colors_at(
    photograph: PilImage.Image, pixel: Int64[np.ndarray, " C"], camera: Camera
) -> UInt8[np.ndarray, "C 3"]:
    """The colours of a photograph of any size at the centres of a map's pixels."""
    out = np.empty((len(pixel), 3), np.uint8)
    _take_colors(np.asarray(photograph), pixel, camera.width, camera.height, out)
    return out


@inline
def _take_colors(photograph, pixel, width, height, out):  # type: ignore[no-untyped-def]  # Numba's types
    """The photograph's pixels at the centres of the map's pixels."""
    rows, columns = photograph.shape[0], photograph.shape[1]
    for k in range(len(pixel)):
        row = int((pixel[k] // width + 0.5) * rows / height)
        column = int((pixel[k] % width + 0.5) * columns / width)
        for channel in range(3):
            out[k, channel] = photograph[row, column, channel]


def _reduce(seen: _Seen, coarse: Float32[np.ndarray, "h w"], photograph: PilImage.Image) -> Reduced:
    """Every f-th pixel of the map, as means would bridge edges; block means of the photograph."""
    camera = seen.camera
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
        seen.unit,
        grid_from_map @ camera.K @ camera.cam_from_world[:3],
        np.asarray(samples.reduce(2)),
        block_from_map[:, None] * [[factor, first]],
    )


def _nothing(alignment: Alignment, camera: Camera) -> View:
    """The view of an image that is left out."""
    return View(
        alignment,
        camera,
        np.empty(0, np.int64),
        np.empty(0, np.float32),
        np.empty((0, 3), np.uint8),
        np.empty(0, np.bool_),
        exhausted=True,
        reduced=None,
    )
