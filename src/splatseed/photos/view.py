"""Views: posed pinhole cameras with their photographs in memory, at the size they are used at.

``photos.loading`` reads them; ``camera_views`` makes views without pixels, where only cameras
matter.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8

from splatseed.camera import Camera
from splatseed.errors import ParameterError
from splatseed.io.downsampling import reduced_size, reduction
from splatseed.photos.sizes import check_side
from splatseed.projection import scaled
from splatseed.scene import Image

NEAR_PLANE = 0.01  # gsplat's near plane, where nothing is known of the scene
NO_PIXELS = np.empty((0, 0, 3), np.uint8)
"""The photograph of a view without pixels."""


@dataclass(frozen=True, eq=False)
class View:
    """A posed photograph."""

    name: str  # the image's name in its scene
    photograph: UInt8[np.ndarray, "H W 3"]  # sRGB; ``NO_PIXELS`` if it is not loaded
    camera: Camera  # in pixels of the photograph
    mask: Bool[np.ndarray, "H W"] | None = None  # pixels that count; None: all
    empty: Bool[np.ndarray, "H W"] | None = None  # pixels that show nothing; None: none
    opacity: UInt8[np.ndarray, "H W"] | None = None  # alpha of pixels over black; None: opaque
    near: float = NEAR_PLANE  # Gaussians nearer than this are not rendered; in the pose's unit

    @property
    def K(self) -> Float64[np.ndarray, "3 3"]:  # noqa: N802  (the field's name)
        """The camera's matrix, in pixels."""
        return self.camera.K

    @property
    def width(self) -> int:
        """Pixels."""
        return self.camera.width

    @property
    def height(self) -> int:
        """Pixels."""
        return self.camera.height

    @property
    def cam_from_world(self) -> Float64[np.ndarray, "4 4"]:
        """The camera's pose."""
        return self.camera.cam_from_world

    @cached_property
    def surface(self) -> Bool[np.ndarray, "H W"] | None:
        """Pixels that count and show something; None: all."""
        return surface_pixels(self.mask, self.empty)

    def posed(self, cam_from_world: Float[np.ndarray, "4 4"]) -> View:
        """The same photograph, its camera at another pose."""
        camera = dataclasses.replace(self.camera, cam_from_world=cam_from_world)
        return dataclasses.replace(self, camera=camera)


def surface_pixels(
    mask: Bool[np.ndarray, "H W"] | None, empty: Bool[np.ndarray, "H W"] | None
) -> Bool[np.ndarray, "H W"] | None:
    """Return the pixels that count and are not empty; None: all."""
    if empty is None:
        return mask
    return ~empty if mask is None else mask & ~empty


def view_of(camera: Image | Camera | View) -> View:
    """A camera as a view without pixels; a view as it is."""
    if isinstance(camera, View):
        return camera
    if isinstance(camera, Image):
        return View(camera.name, NO_PIXELS, camera.camera)
    if not isinstance(camera, Camera):
        raise ParameterError(
            "`camera` as an image of a scene, a Camera or a View",
            found=type(camera).__name__,
            fix='Pass scene["NAME"], for example.',
        )
    return View("", NO_PIXELS, camera)


def camera_views(images: Sequence[Image], data_factor: float = 1) -> tuple[View, ...]:
    """Views of images without pixels, at the size of photographs downsampled by ``data_factor``.

    Raises:
        SceneFormatError: A photograph would have no pixel.
    """
    views = []
    for image in images:
        camera = image.camera
        width, height = reduced_size(camera.width, camera.height, data_factor)
        check_side(image.name, 1, data_factor, (width, height))
        K = scaled(camera.K, *reduction(camera.width, camera.height, data_factor))
        small = Camera(K, width, height, camera.cam_from_world)
        views.append(View(image.name, NO_PIXELS, small))
    return tuple(views)
