"""OverlapPoints: points sampled from the maps, with tracks, for a model that has none.

Notation: a point's track names the image whose pixel it is and the sources that confirm it.
Promise: at most ``PER_MAP`` points per image, evenly over its pixels; which ones depends on the map
alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64, Int64

from splatseed.camera import Camera
from splatseed.io.colmap.ids import Renumbered
from splatseed.io.dense.maps import DenseMap
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Observations, Tracks

PER_MAP = 200
"""Enough to tell which views overlap much and which little."""
_GREY = 128
_UNKNOWN_ERROR = -1.0


class OverlapPoints:
    """Collects points as maps pass by."""

    def __init__(self) -> None:
        self._xyz: list[np.ndarray] = []
        self._views: list[tuple[str, ...]] = []

    def add(self, dense: DenseMap) -> None:
        """Take points of one map, from pixels confirmed by at least one source."""
        rows, columns = np.nonzero(np.isfinite(dense.depth) & (dense.agreeing > 0))
        chosen = np.linspace(0, len(rows) - 1, min(PER_MAP, len(rows))).astype(np.intp)
        rows, columns = rows[chosen], columns[chosen]
        uv = np.stack([columns, rows], axis=1) + 0.5
        self._xyz.append(dense.camera.unproject(uv, dense.depth[rows, columns]))
        for bits in dense.agreeing[rows, columns]:
            confirming = (name for k, name in enumerate(dense.sources) if bits >> k & 1)
            self._views.append((dense.name, *confirming))

    def model(self, images: Sequence[Image]) -> tuple[PointCloud, Renumbered]:
        """The points, and the images with features where they see them."""
        xyz = np.concatenate([np.empty((0, 3)), *self._xyz])
        idx_of = {image.name: idx for idx, image in enumerate(images)}
        lengths = np.array([len(views) for views in self._views], np.int64)
        image_idx = np.array([idx_of[n] for views in self._views for n in views], np.int64)
        point_idx = np.repeat(np.arange(len(xyz)), lengths)
        tracks = Tracks(
            point_ids=np.arange(1, len(xyz) + 1),
            xyz=xyz,
            errors=np.full(len(xyz), _UNKNOWN_ERROR),
            offsets=np.concatenate([[0], np.cumsum(lengths)]),
            image_ids=np.array([i.image_id for i in images], np.uint32)[image_idx],
            point2d_idx=_places(image_idx, len(images)),
        )
        seen = [point_idx[image_idx == idx] for idx in range(len(images))]
        featured = [_with_features(i, xyz, s) for i, s in zip(images, seen, strict=True)]
        cloud = PointCloud(xyz.astype(np.float32), np.full(xyz.shape, _GREY, np.uint8))
        return cloud, Renumbered(tracks, tuple(featured), 0)


def _places(image_idx: Int64[np.ndarray, " T"], num_images: int) -> np.ndarray:
    """The index of each track element among the features of its image, uint32 [T]."""
    order = np.argsort(image_idx, kind="stable")
    counts = np.bincount(image_idx, minlength=num_images)
    places = np.empty(len(image_idx), np.uint32)
    places[order] = np.arange(len(image_idx)) - np.repeat(np.cumsum(counts) - counts, counts)
    return places


def _with_features(
    image: Image, xyz: Float64[np.ndarray, "N 3"], seen: Int64[np.ndarray, " M"]
) -> Image:
    camera: Camera = image.camera
    uv = np.nan_to_num(camera.project(xyz[seen])[0])  # a wrong confirmation may lie behind it
    return replace(image, observations=Observations(uv, seen + 1))
