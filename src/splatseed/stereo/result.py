"""Stereo: the result for all views, from which maps and seeds are made.

Notation: V views of W x H pixels; maps have one pixel per block of g x g pixels. Promise: a depth
is kept only where other views' independently computed maps agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from splatseed.camera import Camera
from splatseed.stereo.maps import StereoMap
from splatseed.stereo.settings import StereoSettings
from splatseed.views.view import View


@dataclass(frozen=True, eq=False)
class StereoResult:
    """The result of stereo.

    Args:
        views: The photographs at the size that was compared.
        planes: Of each view, float32 [3, h, w]: inverse depth and its slopes per pixel of the view.
        costs: Of each view, float32 [h, w].
        agreeing: Which of a view's witnesses confirm each pixel, one bit per witness, uint8
            [h, w].
        sources: The views that each was compared with, best first, int64 [V, K]; -1 = none.
        settings: The choices of stereo.
    """

    views: tuple[View, ...]
    planes: list[Float32[np.ndarray, "3 h w"]]
    costs: list[Float32[np.ndarray, "h w"]]
    agreeing: list[UInt8[np.ndarray, "h w"]]
    sources: Int64[np.ndarray, "V K"]
    settings: StereoSettings

    def kept(self, i: int) -> np.ndarray:
        """Which pixels of view i have a depth that enough others confirm, bool [h, w]."""
        asked = int((self.sources[i] >= 0).sum())
        # A view with a single source can be confirmed by no more than that one.
        needed = max(1, min(self.settings.min_agreeing, asked))
        return np.asarray(np.bitwise_count(self.agreeing[i]) >= needed)

    def map(self, i: int) -> StereoMap:
        """The map of view i."""
        view, kept = self.views[i], self.kept(i)
        height, width = kept.shape
        K = np.diag([1 / self.settings.grid, 1 / self.settings.grid, 1.0]) @ view.K
        depth = np.where(kept, 1.0 / self.planes[i][0], np.nan).astype(np.float32)
        normal = np.where(kept[..., None], self.normals(i), np.nan).astype(np.float32)
        names = tuple(self.views[j].name for j in self.sources[i] if j >= 0)
        camera = Camera(K, width, height, view.cam_from_world)
        agreeing = np.where(kept, self.agreeing[i], 0).astype(np.uint8)
        return StereoMap(view.name, camera, depth, normal, self.confidence(i), names, agreeing)

    def confidence(self, i: int) -> Float32[np.ndarray, "h w"]:
        """The correlation, with doubt halved by each view that agrees; 0 where not kept."""
        correlation = np.clip(1.0 - self.costs[i], 0.0, 1.0)
        belief = 1.0 - 0.5 ** np.bitwise_count(self.agreeing[i])
        return np.where(self.kept(i), correlation * belief, 0.0).astype(np.float32)

    def normals(self, i: int) -> Float32[np.ndarray, "h w 3"]:
        """Unit normals towards the camera, in its axes.

        1 / z = m (u, v, 1) = (K' m) ray for the plane's m = (gx, gy, w0 - gx u0 - gy v0); the
        normal is along -K' m, as 1 / z > 0 along every ray.
        """
        w, gx, gy = self.planes[i].astype(np.float64)
        place = (np.indices(w.shape)[::-1] + 0.5) * self.settings.grid
        m = np.stack([gx, gy, w - gx * place[0] - gy * place[1]], axis=-1)
        normal = -m @ self.views[i].K
        return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True), np.float32)
