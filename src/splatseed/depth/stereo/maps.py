"""Stereo's choices and its maps: depth and normals at the pixels of each photograph of a scene.

Notation: V views of W x H pixels; a map has one pixel per block of g x g pixels, and ``camera`` is
the photograph's, scaled to the map's pixels, with the centre of the first at (0.5, 0.5). Promise: a
depth is kept only where other views' independently computed maps agree; what they do not confirm is
NaN, and its confidence 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from splatseed.camera import Camera
from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.photos.view import View
from splatseed.progress import Progress, silent
from splatseed.scene import Scene

TOO_FEW = 30
"""Points that are not worth being searched around, and vouch for no pose."""
LEAST_SIZE = 32
MOST_GRID = 32
MOST_SOURCES = 8
"""Bits of the byte that records which views agree."""


@dataclass(frozen=True)
class StereoSettings:
    """The choices of stereo: depth from photographs alone."""

    max_size: int = 800
    """Photographs are downsampled by a whole factor to at most this many pixels a side."""
    grid: int = 4
    """Pixels between depths, along a row and a column."""
    sweeps: int = 4
    """PatchMatch iterations: each propagates and refines all planes."""
    num_sources: int = 5
    """Views in which a plane is compared."""
    num_witnesses: int = 8
    """Views that may confirm a depth."""
    min_agreeing: int = 2
    """How many of these views must confirm it."""
    tolerance: float = 0.01
    """Relative difference at which two depths agree."""
    max_cost: float = 0.5
    """Pixels of higher cost (one minus correlation, 0 to 2) are left out."""

    def __post_init__(self) -> None:
        for name, good, expected in (
            ("max_size", self.max_size >= LEAST_SIZE, f"at least {LEAST_SIZE}"),
            ("grid", 1 <= self.grid <= MOST_GRID, f"1 to {MOST_GRID}"),
            ("sweeps", self.sweeps >= 1, "at least 1"),
            ("num_sources", 1 <= self.num_sources <= MOST_SOURCES, f"1 to {MOST_SOURCES}"),
            ("num_witnesses", 1 <= self.num_witnesses <= MOST_SOURCES, f"1 to {MOST_SOURCES}"),
            (
                "min_agreeing",
                1 <= self.min_agreeing <= self.num_witnesses,
                f"1 to {self.num_witnesses}",
            ),
            ("tolerance", 0 < self.tolerance < 1, "more than 0 and less than 1"),
            ("max_cost", 0 < self.max_cost <= 2, "more than 0, 2 at most"),
        ):
            if not good:
                raise ParameterError(
                    f"stereo.{name} of {expected}",
                    found=repr(getattr(self, name)),
                    fix="Choose such a value.",
                )


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
    """

    name: str
    camera: Camera
    depth: Float32[np.ndarray, "H W"]
    normal: Float32[np.ndarray, "H W 3"]
    confidence: Float32[np.ndarray, "H W"]
    sources: tuple[str, ...]
    agreeing: UInt8[np.ndarray, "H W"]

    @property
    def known_share(self) -> float:
        """The fraction of pixels that have a depth."""
        return float(np.isfinite(self.depth).mean())


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


def stereo_depths(
    scene: Scene,
    settings: StereoSettings | None = None,
    *,
    seed: int = 0,
    progress: Progress = silent,
    **choices: Any,
) -> tuple[StereoMap, ...]:
    """Depth, normals and confidence of every photograph of a scene.

    Args:
        scene: A scene with photographs.
        settings: The choices of stereo; the defaults when left out.
        seed: The same seed gives the same bytes.
        progress: Called with the stage and the fraction done.
        choices: Fields of the settings, such as ``grid=2``.

    Raises:
        ParameterError: A choice is out of range.
        SceneNotFoundError: There are fewer than two photographs, or than half of the scene's.
        SceneFormatError: A photograph cannot be used.
    """
    from splatseed.depth.stereo.depths import find_stereo, known_visibility  # noqa: PLC0415  (loads Numba)
    from splatseed.io.photograph_checks import with_photographs  # noqa: PLC0415  (loads with its use)
    from splatseed.photos.view import at_file_size, data_factor, load_views  # noqa: PLC0415  (loads with its use)

    settings = replace(settings or StereoSettings(), **choices)
    if len(scene.images) < 2:
        raise SceneNotFoundError(
            "at least two photographs with a pose",
            found=f"{len(scene.images)}",
            fix="Name a scene with photographs: depth comes from comparing them.",
        )
    scene = at_file_size(with_photographs(scene))
    views = load_views(
        scene,
        scene.images,
        data_factor=data_factor(scene.images, settings.max_size),
        undistort=True,
        progress=progress,
    )
    stereo = find_stereo(views, scene.images, known_visibility(scene), settings, seed, progress)
    return tuple(stereo.map(i) for i in range(len(stereo.views)))
