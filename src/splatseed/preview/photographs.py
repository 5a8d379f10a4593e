"""A scene's photographs at a given size.

Promise: an unreadable photograph is no error: a scene without photographs still has much to show.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8
from PIL import Image as PillowImage

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.photograph import decode_photograph, photograph_bytes
from splatseed.scene import Image, Scene

BLANK = (230, 230, 230)


def photograph_at(
    scene: Scene, image: Image, size: tuple[int, int]
) -> UInt8[np.ndarray, "H W 3"] | None:
    """An image's photograph, scaled to width and height; None if it cannot be read."""
    folder = scene.source.image_dir if scene.source else None
    if folder is None:
        return None
    path = folder / image.name
    try:
        picture = decode_photograph(path, photograph_bytes(path))
    except (SceneNotFoundError, SceneFormatError):
        return None
    return np.array(picture.resize(size, PillowImage.Resampling.LANCZOS))


def photograph_or_blank(
    scene: Scene, image: Image | None, size: tuple[int, int]
) -> UInt8[np.ndarray, "H W 3"]:
    """The photograph, or plain light grey if it cannot be read."""
    photograph = None if image is None else photograph_at(scene, image, size)
    return np.full((size[1], size[0], 3), BLANK, np.uint8) if photograph is None else photograph
