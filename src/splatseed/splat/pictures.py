"""Images of renders and of their errors, written as PNG files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8
from matplotlib import colormaps
from PIL import Image

from splatseed.io.files import StrPath
from splatseed.io.staging import atomic_file

GAP = 4  # white columns between the images of a row


def flip_heatmap(errors: Float32[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Map FLIP of each pixel to magma, its authors' colours: black for 0, the brightest for 1."""
    return np.asarray(colormaps["magma"](errors, bytes=True)[..., :3], np.uint8)


def to_uint8(image: Float32[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Convert colours to 8 bits, clamped to [0, 1]."""
    return np.asarray(np.rint(np.clip(image, 0, 1) * 255), np.uint8)


def write_comparison(
    path: StrPath,
    photograph: UInt8[np.ndarray, "H W 3"],
    render: Float32[np.ndarray, "H W 3"],
    errors: Float32[np.ndarray, "H W"],
) -> None:
    """Write photograph, render and FLIP side by side as a PNG."""
    gap = np.full((len(photograph), GAP, 3), 255, np.uint8)
    row = [photograph, gap, to_uint8(render), gap, flip_heatmap(errors)]
    with atomic_file(Path(path)) as partial:
        # Zlib's default level takes 2.6 times as long for files that are 6% smaller.
        Image.fromarray(np.concatenate(row, axis=1)).save(partial, compress_level=1)


def picture_names(image_names: Iterable[str]) -> dict[str, str]:
    """Return a unique PNG name per image; folders become part of it.

    Of a.jpg and a.jpeg the second becomes a-2.png.

    Example:
        >>> picture_names(["a/b.jpg", "a_b.jpg", "a/c.jpg"])
        {'a/b.jpg': 'a_b.png', 'a_b.jpg': 'a_b-2.png', 'a/c.jpg': 'a_c.png'}
    """
    pictures: dict[str, str] = {}  # the image of each picture
    for name in image_names:
        stem = Path(name).with_suffix("").as_posix().replace("/", "_")
        picture, number = f"{stem}.png", 1
        while picture in pictures:
            number += 1
            picture = f"{stem}-{number}.png"
        pictures[picture] = name
    return {name: picture for picture, name in pictures.items()}
