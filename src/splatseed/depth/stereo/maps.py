"""Stereo's settings and results: depth and normals at the pixels of each photograph of a scene.

Notation: V views of W x H pixels; a map has one pixel per block of g x g pixels. Its ``camera`` is
the photograph's, scaled to the map's pixels, with the centre of the first at (0.5, 0.5). Promise:
every depth of a map is confirmed by independently computed maps of other views; the depth of all
other pixels is NaN and their confidence 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8

from splatseed.camera import Camera
from splatseed.io.regions import Region
from splatseed.photos.view import View
from splatseed.pointcloud import PointCloud
from splatseed.projection import pixel_centers, scaled
from splatseed.settings import Range, check_settings

MIN_POINTS = 30
"""With fewer points, neither depth ranges nor poses can be inferred from them."""
MIN_SIZE = 32
"""Smallest ``max_size``, in pixels."""
MAX_GRID = 32
MAX_SOURCES = 8
"""Bits of the byte that records which views agree."""


@dataclass(frozen=True)
class StereoSettings:
    """Settings of stereo."""

    max_size: Annotated[int, Range(MIN_SIZE)] = 800
    """Photographs are downsampled by a whole factor to at most this many pixels a side."""
    grid: Annotated[int, Range(1, MAX_GRID)] = 4
    """Pixels between depths, along a row and a column."""
    sweeps: Annotated[int, Range(1)] = 4
    """PatchMatch iterations: each propagates and refines all planes."""
    num_sources: Annotated[int, Range(1, MAX_SOURCES)] = 5
    """Views that a plane is matched against."""
    num_check_views: Annotated[int, Range(1, MAX_SOURCES)] = 8
    """Views that may confirm a depth."""
    min_agreeing: Annotated[int, Range(1, "num_check_views")] = 2
    """How many of these views must confirm it."""
    tolerance: Annotated[float, Range(above=0, below=1)] = 0.01
    """Relative difference at which two depths agree."""
    max_cost: Annotated[float, Range(above=0, maximum=2)] = 0.5
    """Pixels of higher cost (one minus correlation, 0 to 2) are left out."""

    def __post_init__(self) -> None:
        check_settings(self, "stereo")


@dataclass(frozen=True, eq=False)
class StereoMap:
    """Depth, normal and confidence of one view.

    Args:
        name: The image's name.
        camera: Pinhole, in pixels of the map.
        depth: Planar z, scene units, float32 [H, W]; NaN where unknown.
        normal: Unit vectors in camera axes, towards the camera, float32 [H, W, 3]; NaN where
            unknown.
        confidence: From 0, unknown, to 1, float32 [H, W].
        sources: Names of the views it was compared with, best first; 8 at most.
        agreeing: Bit k is set where source k confirms the depth, uint8 [H, W].
        rgb: Mean colour of the photograph in each pixel of the map, uint8 [H, W, 3].
    """

    name: str
    camera: Camera
    depth: Float32[np.ndarray, "H W"]
    normal: Float32[np.ndarray, "H W 3"]
    confidence: Float32[np.ndarray, "H W"]
    sources: tuple[str, ...]
    agreeing: UInt8[np.ndarray, "H W"]
    rgb: UInt8[np.ndarray, "H W 3"]

    def __repr__(self) -> str:
        height, width = self.depth.shape
        return f"StereoMap({self.name!r}, {width} x {height}, {self.known_fraction:.0%} known)"

    @property
    def known_fraction(self) -> float:
        """Fraction of the pixels that have a depth."""
        return float(np.isfinite(self.depth).mean())

    def points(self) -> PointCloud:
        """Unproject the pixels that have a depth to world points with their colours, row by row."""
        row, column = np.nonzero(np.isfinite(self.depth))
        uv = np.stack([column, row], axis=1) + 0.5
        xyz = self.camera.unproject(uv, self.depth[row, column].astype(np.float64))
        return PointCloud(xyz.astype(np.float32), self.rgb[row, column])


@dataclass(frozen=True, eq=False)
class StereoResult:
    """Planes and costs of all views, from which maps and seeds are made.

    Args:
        views: The photographs at the size that was compared.
        planes: Of each view, float32 [3, h, w]: inverse depth and its slopes per pixel of the view.
        costs: Of each view, float32 [h, w].
        agreeing: Bit k is set where source k of a view confirms its depth, uint8 [h, w] of each.
        sources: The views that each was compared with, best first, int64 [V, K]; -1 = none.
        bounds: Smallest and largest inverse depth of each view's search, float32 [V, 2].
        settings: The settings.
    """

    views: tuple[View, ...]
    planes: list[Float32[np.ndarray, "3 h w"]]
    costs: list[Float32[np.ndarray, "h w"]]
    agreeing: list[UInt8[np.ndarray, "h w"]]
    sources: Int64[np.ndarray, "V K"]
    bounds: Float32[np.ndarray, "V 2"]
    settings: StereoSettings

    def confirmed(self, i: int) -> Bool[np.ndarray, "h w"]:
        """Pixels of view i whose depth enough other views confirm."""
        # A view with a single source can be confirmed by that one only.
        num_sources = int((self.sources[i] >= 0).sum())
        needed = max(1, min(self.settings.min_agreeing, num_sources))
        return np.asarray(np.bitwise_count(self.agreeing[i]) >= needed)

    def within(self, region: Region) -> StereoResult:
        """Return the result without the depths outside of a region, as if none confirmed them."""
        kept = []
        for i, view in enumerate(self.views):
            row, column = np.nonzero(self.confirmed(i))
            uv = (np.stack([column, row], axis=1) + 0.5) * self.settings.grid
            inside = region(view.camera.unproject(uv, 1.0 / self.planes[i][0, row, column]))
            agreeing = np.zeros_like(self.agreeing[i])
            at = row[inside], column[inside]
            agreeing[at] = self.agreeing[i][at]
            kept.append(agreeing)
        return replace(self, agreeing=kept)

    def map(self, i: int) -> StereoMap:
        """The map of view i."""
        view, valid, grid = self.views[i], self.confirmed(i), self.settings.grid
        height, width = valid.shape
        K = scaled(view.K, 1 / grid)
        depth = np.where(valid, 1.0 / self.planes[i][0], np.nan).astype(np.float32)
        normal = np.where(valid[..., None], self.normals(i), np.nan).astype(np.float32)
        names = tuple(self.views[j].name for j in self.sources[i] if j >= 0)
        camera = Camera(K, width, height, view.cam_from_world)
        agreeing = np.where(valid, self.agreeing[i], 0).astype(np.uint8)
        rgb = block_means(view.photograph, grid)
        return StereoMap(view.name, camera, depth, normal, self.confidence(i), names, agreeing, rgb)

    def maps(self) -> tuple[StereoMap, ...]:
        """The maps of all views."""
        return tuple(self.map(i) for i in range(len(self.views)))

    def confidence(self, i: int) -> Float32[np.ndarray, "h w"]:
        """Correlation times 1 - 2^-n where n views agree; 0 where a depth is not confirmed."""
        correlation = np.clip(1.0 - self.costs[i], 0.0, 1.0)
        belief = 1.0 - 0.5 ** np.bitwise_count(self.agreeing[i])
        return np.where(self.confirmed(i), correlation * belief, 0.0).astype(np.float32)

    def normals(self, i: int) -> Float32[np.ndarray, "h w 3"]:
        """Unit normals towards the camera, in its axes.

        1 / z = m (u, v, 1) = (K' m) ray for the plane's m = (gx, gy, w0 - gx u0 - gy v0); the
        normal is along -K' m, as 1 / z > 0 along every ray.
        """
        w, gx, gy = self.planes[i].astype(np.float64)
        u, v = np.moveaxis(pixel_centers(*w.shape) * self.settings.grid, -1, 0)
        m = np.stack([gx, gy, w - gx * u - gy * v], axis=-1)
        normal = -m @ self.views[i].K
        return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True), np.float32)


def block_means(image: UInt8[np.ndarray, "H W C"], grid: int) -> UInt8[np.ndarray, "h w C"]:
    """Mean of each block of grid x grid pixels, rounded; incomplete blocks are left out."""
    rows, columns = image.shape[0] // grid, image.shape[1] // grid
    blocks = image[: rows * grid, : columns * grid]
    blocks = blocks.reshape(rows, grid, columns, grid, image.shape[2])
    return np.asarray(np.rint(blocks.mean(axis=(1, 3))), np.uint8)
