"""The pictures behind the viewer's points: renders, photographs, errors and uncovered cells.

Notation: an *entry* is one of the things the user opened; *at* is the image whose camera the canvas
stands at, or None. Promise: pictures are drawn one at a time, however many browsers are connected,
because PyTorch's and Numba's threads are shared; a picture that cannot be drawn is None, with a
reason.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cached_property, lru_cache

import numpy as np
import torch
from jaxtyping import UInt8

from splatseed.camera import Camera
from splatseed.errors import SplatseedError
from splatseed.preview.cells import cell_picture
from splatseed.preview.origins import origin_colors
from splatseed.preview.photographs import photograph_at
from splatseed.preview.points import render_points
from splatseed.scene import Image, Scene
from splatseed.seeding.coverage import covered_cells
from splatseed.splat.gaussians import Gaussians, TrainingFrame
from splatseed.splat.pictures import error_map
from splatseed.viewer.canvas import laid_onto
from splatseed.viewer.frames import as_bytes, depth_colors
from splatseed.viewer.renderer import ModelRenderer
from splatseed.viewer.shown import Shown
from splatseed.views.view import View, poses_of

Drawn = tuple[UInt8[np.ndarray, "H W 3"] | None, str]
"""A picture, or None and the reason why there is none."""
NOTHING = "points only"
MOST_MOVING = 250_000
"""Gaussians rendered while a camera moves, on the CPU: projecting a million takes longer there than
all pixels. A GPU, which projects millions in milliseconds, renders all."""
CELL = 8
"""Side in pixels of the cells that are tested for seeds."""
PHOTOGRAPH_SIDE = 1600
CELLS_SIDE = 800
PAPER = (255, 255, 255)
GO = "Click a camera to stand where a photograph was taken."
_DRAWING = threading.Lock()


class Entry:
    """Something the user opened, and the pictures that can be made of it.

    Args:
        shown: The scene, model or both.
        frame: The stage, in which models are rendered.
        device: Where to render; the CPU when left out.
    """

    def __init__(
        self, shown: Shown, frame: TrainingFrame, device: torch.device | None = None
    ) -> None:
        self.shown = shown
        self.name = shown.name
        self.frame = frame
        self._device = device
        self._painters = self._available()

    @cached_property
    def renderer(self) -> ModelRenderer:
        """The renderer of the whole model."""
        assert self.shown.gaussians is not None  # noqa: S101  (kinds says so)
        return ModelRenderer(self.shown.gaussians, self.frame, self._device)

    @cached_property
    def quick_renderer(self) -> ModelRenderer:
        """A renderer for moving cameras, of the most visible Gaussians where all would be slow."""
        gaussians, on_gpu = self.shown.gaussians, getattr(self._device, "type", "cpu") == "cuda"
        if gaussians is None or on_gpu or len(gaussians) <= MOST_MOVING:
            return self.renderer
        return ModelRenderer(most_seen(gaussians, MOST_MOVING), self.frame, self._device)

    @property
    def has_model(self) -> bool:
        """Whether there are Gaussians to render."""
        return self.shown.gaussians is not None

    @property
    def kinds(self) -> tuple[str, ...]:
        """The pictures that can be asked for."""
        return tuple(self._painters)

    def draw(self, kind: str, canvas: View, at: Image | None, *, quick: bool = False) -> Drawn:
        """A picture as large as the canvas; a quick one may skip the least visible Gaussians."""
        if quick and kind == "Gaussians" and self.has_model:
            with _DRAWING:
                return as_bytes(self.quick_renderer.color(canvas)), ""
        with _DRAWING:
            try:
                return self._painters[kind](canvas, at)
            except SplatseedError as error:
                return None, str(error)

    def warm_up(self) -> None:
        """Compile the kernels that renders need, so that no browser waits for them."""
        if self.has_model:
            K = np.array([[32.0, 0, 16], [0, 32.0, 12], [0, 0, 1]])
            view = View("", np.empty((0, 0, 3), np.uint8), K, 32, 24, np.eye(4))
            for quick in (True, False):
                self.draw("Gaussians", view, None, quick=quick)

    def _available(self) -> dict[str, Callable[[View, Image | None], Drawn]]:
        available: dict[str, Callable[[View, Image | None], Drawn]] = {}
        scene = self.shown.scene
        if self.has_model:
            available |= {"Gaussians": self._gaussians, "depth": self._depth}
        if scene is not None and scene.has_photographs:
            available["photograph"] = self._photograph
            if self.has_model:
                available["error"] = self._error
        if scene is not None and scene.depths is not None:
            available["depth map"] = self._depth_map
        if scene is not None and len(scene.points):
            available |= {"points": self._points, "origins": self._origins}
            if scene.images:
                available["uncovered cells"] = self._uncovered
        return available

    def _gaussians(self, canvas: View, at: Image | None) -> Drawn:
        del at
        return as_bytes(self.renderer.color(canvas)), ""

    def _depth(self, canvas: View, at: Image | None) -> Drawn:
        del at
        return _depth_picture(self.renderer.depth(canvas)), ""

    def _points(self, canvas: View, at: Image | None) -> Drawn:
        del at
        return render_points(self._scene.points, _camera_of(canvas), background=PAPER), ""

    def _origins(self, canvas: View, at: Image | None) -> Drawn:
        del at
        points = self._scene.points
        colored = points.replace(rgb=origin_colors(points.source))
        return render_points(colored, _camera_of(canvas), background=PAPER), ""

    def _photograph(self, canvas: View, at: Image | None) -> Drawn:
        if at is None:
            return None, GO
        photograph = _photograph_of(self._scene, at, PHOTOGRAPH_SIDE)
        if photograph is None:
            return None, f"The photograph {at.name} cannot be read."
        return laid_onto(canvas, photograph, at.camera), ""

    def _error(self, canvas: View, at: Image | None) -> Drawn:
        photograph, why = self._photograph(canvas, at)
        if photograph is None or at is None:
            return None, why
        white = np.full((2, 2, 3), 255, np.uint8)
        inside = laid_onto(canvas, white, at.camera, smooth=False) > 0
        return np.where(inside, error_map(photograph, self.renderer.color(canvas)), 0), ""

    def _depth_map(self, canvas: View, at: Image | None) -> Drawn:
        maps = self._scene.depths
        if at is None or maps is None or at.name not in maps:
            return None, GO if at is None else f"{at.name} has no depth map."
        values = np.nan_to_num(maps.read(at.name).values, nan=0.0, posinf=0.0)
        return laid_onto(canvas, _depth_picture(values), at.camera, smooth=False), ""

    def _uncovered(self, canvas: View, at: Image | None) -> Drawn:
        if at is None:
            return None, GO
        view = _sized(at, CELLS_SIDE)
        photograph = _photograph_of(self._scene, at, CELLS_SIDE)
        if photograph is None:
            photograph = np.full((view.height, view.width, 3), 230, np.uint8)
        (covered,) = covered_cells([view], self._scene.points.xyz, CELL)
        return laid_onto(canvas, cell_picture(photograph, covered, CELL), at.camera), ""

    @property
    def _scene(self) -> Scene:
        assert self.shown.scene is not None  # noqa: S101  (kinds says so)
        return self.shown.scene


def most_seen(gaussians: Gaussians, count: int) -> Gaussians:
    """The Gaussians with the largest opacity times area, in their original order."""
    wide = np.sort(gaussians.scales.astype(np.float64), axis=1)[:, 1:].sum(axis=1)
    weight = wide - np.logaddexp(0, -gaussians.opacities.astype(np.float64))
    keep = np.sort(np.argpartition(-weight, count)[:count])
    return Gaussians(**{name: array[keep] for name, array in gaussians.arrays().items()})


def _camera_of(canvas: View) -> Camera:
    return Camera(canvas.K, canvas.width, canvas.height, canvas.cam_from_world)


def _depth_picture(depth: np.ndarray) -> UInt8[np.ndarray, "H W 3"]:
    """Depth as colours between the 2nd and 98th percentiles of this picture."""
    seen = depth[depth > 0]
    limits = tuple(np.percentile(seen, [2, 98]).tolist()) if seen.size else (1.0, 2.0)
    return depth_colors(depth, (limits[0], max(limits[1], 1.001 * limits[0])))


def _sized(image: Image, side: int) -> View:
    """An image's view, its longer side at most ``side`` pixels."""
    (view,) = poses_of([image], max(1, -(-max(image.camera.width, image.camera.height) // side)))
    return view


@lru_cache(maxsize=8)
def _photograph_of(scene: Scene, image: Image, side: int) -> UInt8[np.ndarray, "h w 3"] | None:
    view = _sized(image, side)
    return photograph_at(scene, image, (view.width, view.height))
