"""Renders of views beside the photograph, with an error map.

Notation: the error of a pixel is the mean over the channels of |render - photograph|, 0 to 1.
Promise: one colour scale for all pictures, so that they can be compared.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.io.staging import atomic_file

FULL_ERROR = 0.25
"""The error that is drawn brightest."""
GAP = 4
WHITE = 255


def beside_photograph(
    photograph: UInt8[np.ndarray, "H W 3"], render: Float32[np.ndarray, "H W 3"]
) -> UInt8[np.ndarray, "H V 3"]:
    """Photograph, render and error map in a row.

    Args:
        photograph: The view as captured.
        render: What the Gaussians look like, 0 to 1; clamped.
    """
    gap = np.full((len(photograph), GAP, 3), WHITE, np.uint8)
    drawn = np.round(np.clip(render, 0.0, 1.0) * 255).astype(np.uint8)
    return np.concatenate([photograph, gap, drawn, gap, error_map(photograph, render)], axis=1)


def error_map(
    photograph: UInt8[np.ndarray, "H W 3"], render: Float32[np.ndarray, "H W 3"]
) -> UInt8[np.ndarray, "H W 3"]:
    """The error of each pixel as a colour: black is none, ``FULL_ERROR`` or more the brightest.

    Args:
        photograph: The view as captured.
        render: What the Gaussians look like, 0 to 1; clamped.
    """
    error = np.abs(np.clip(render, 0.0, 1.0) - photograph / np.float32(255)).mean(axis=2)
    return _heat(error)


def picture_name(image_name: str) -> str:
    """The file name for an image's picture; folders in the name become part of it."""
    return Path(image_name).with_suffix("").as_posix().replace("/", "_") + ".png"


def write_picture(path: Path, pixels: UInt8[np.ndarray, "H W 3"]) -> None:
    """Write a PNG.

    Raises:
        OutputError: The file cannot be written.
    """
    from PIL import Image  # noqa: PLC0415  (slow to import)

    with atomic_file(path) as partial:
        Image.fromarray(pixels).save(partial)


def _heat(error: Float32[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    from matplotlib import colormaps  # noqa: PLC0415  (slow to import)

    colors = colormaps["inferno"](np.minimum(error / FULL_ERROR, 1.0), bytes=True)
    return np.asarray(colors[..., :3], np.uint8)
