"""Pages: pictures of one size in rows, each with its label above.

Notation: a picture is uint8 [H, W, 3]; a tile is a picture with its label. Promise: files appear
whole or not at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image as PillowImage, ImageDraw, ImageFont

from splatseed.io.output.staging import atomic_file
from splatseed.preview.fonts import font_file

GRID_SIDE = 600
"""Longer side of a picture in a grid, in pixels."""

LABEL_SIZES = (20, 11)
"""Usual and smallest size of letters."""

PAPER = (255, 255, 255)
INK = (20, 20, 20)


class Tile(NamedTuple):
    """A picture and its label."""

    label: str
    picture: UInt8[np.ndarray, "H W 3"]


def columns_for(num_tiles: int) -> int:
    """Three or four columns, whichever leaves fewer gaps; fewer if that is enough."""
    return num_tiles if num_tiles < 3 else min((3, 4), key=lambda columns: -num_tiles % columns)


def fitted(width: int, height: int, side: int = GRID_SIDE) -> tuple[int, int]:
    """Width and height that keep the aspect ratio and whose longer side is ``side``."""
    factor = side / max(width, height)
    return max(round(width * factor), 1), max(round(height * factor), 1)


def centered(tiles: Sequence[Tile]) -> list[Tile]:
    """The tiles padded with white to the size of the largest: images may differ in size."""
    height, width = np.max([tile.picture.shape[:2] for tile in tiles], axis=0)
    return [Tile(tile.label, _centered(tile.picture, height, width)) for tile in tiles]


def _centered(
    picture: UInt8[np.ndarray, "h w 3"], height: int, width: int
) -> UInt8[np.ndarray, "H W 3"]:
    tile = np.full((height, width, 3), PAPER, np.uint8)
    top, left = (height - len(picture)) // 2, (width - picture.shape[1]) // 2
    tile[top : top + len(picture), left : left + picture.shape[1]] = picture
    return tile


LATIN = 0xFF
"""The last character of Latin-1, which Pillow's own font has."""


def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The font of labels."""
    return ImageFont.load_default(size=size)


def _letters(label: str, width: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The largest font, down to a legible size, in which a label is no wider than its tile."""
    size = LABEL_SIZES[0]
    # Pillow's own font has Latin letters only.
    file = font_file(label) if any(ord(each) > LATIN for each in label) else None
    of_size = font if file is None else partial(ImageFont.truetype, file)
    needed = of_size(size).getlength(label)
    return of_size(max(min(size, int(size * width / max(needed, 1.0))), LABEL_SIZES[1]))


def write_grid(
    tiles: Sequence[Tile],
    path: Path | str,
    *,
    columns: int,
    footer: UInt8[np.ndarray, "H W 3"] | None = None,
) -> Path:
    """Arrange pictures of one size in rows, each with its label above, and write the PNG.

    Args:
        tiles: At least one, placed row by row.
        path: The PNG to write.
        columns: Tiles per row.
        footer: A strip below all, no wider than the page.

    Raises:
        OutputError: The file cannot be written.
    """
    gap, label_height = 12, 34
    height, width = tiles[0].picture.shape[:2]
    rows = -(-len(tiles) // columns)
    foot = 0 if footer is None else len(footer)
    page_width = columns * (width + gap) + gap
    page_height = rows * (height + label_height) + gap + foot
    page = PillowImage.new("RGB", (page_width, page_height), PAPER)
    draw = ImageDraw.Draw(page)
    for i, tile in enumerate(tiles):
        x = gap + (i % columns) * (width + gap)
        y = (i // columns) * (height + label_height)
        letters = _letters(tile.label, width)
        draw.text((x, y + label_height / 2), tile.label, fill=INK, font=letters, anchor="lm")
        page.paste(PillowImage.fromarray(tile.picture), (x, y + label_height))
    if footer is not None:
        page.paste(PillowImage.fromarray(footer), (gap, page_height - foot))
    with atomic_file(Path(path)) as partial:
        page.save(partial, format="PNG")
    return Path(path)
