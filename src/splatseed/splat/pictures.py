"""Images of renders and of their errors, written as PNG files.

A *comparison* is a photograph, its render and its FLIP side by side, under a band with their names.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8
from matplotlib import colormaps
from PIL import Image, ImageDraw, ImageFont

from splatseed.io.files import StrPath
from splatseed.io.staging import atomic_file

GAP = 4  # white columns between the images of a row
BAND = 20  # height of the names above them
FLIP_LABEL = "FLIP: black 0, brightest 1"
_WHITE = 255


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
    """Write photograph, render and FLIP side by side as a PNG, with their names above."""
    gap = np.full((len(photograph), GAP, 3), _WHITE, np.uint8)
    row = [photograph, gap, to_uint8(render), gap, flip_heatmap(errors)]
    band = _name_band(("photograph", "render", FLIP_LABEL), photograph.shape[1])
    picture = np.concatenate([band, np.concatenate(row, axis=1)])
    with atomic_file(Path(path)) as partial:
        # Zlib's default level takes 2.6 times as long for files that are 6% smaller.
        Image.fromarray(picture).save(partial, compress_level=1)


def split_comparison(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "3 H W 3"]:
    """Split a comparison into photograph, render and error map, without their names.

    Earlier versions wrote no names: a row that is white above the error map, which has no white,
    begins the band.
    """
    width = (picture.shape[1] - 2 * GAP) // 3
    named = len(picture) > BAND and (picture[0, -width:] == _WHITE).all()
    images = picture[BAND * named :]
    return np.stack([images[:, i * (width + GAP) :][:, :width] for i in range(3)])


def _name_band(names: Sequence[str], width: int) -> UInt8[np.ndarray, "H W 3"]:
    """Names above images of a width, in letters as large as the narrowest column permits."""
    full = len(names) * (width + GAP) - GAP
    band = Image.new("RGB", (full, BAND), (_WHITE,) * 3)
    draw, letters = ImageDraw.Draw(band), ImageFont.load_default(size=13)
    longest = max(letters.getlength(name) for name in names)
    letters = ImageFont.load_default(size=max(min(13, int(13 * width / longest)), 6))
    for i, name in enumerate(names):
        draw.text((i * (width + GAP) + 2, BAND / 2), name, (20, 20, 20), letters, anchor="lm")
    pixels = np.array(band)
    pixels[0] = _WHITE
    return pixels


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
