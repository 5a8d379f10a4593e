"""Write pages of labelled pictures, map numbers to colours, and read photographs for them.

Notation: a picture is uint8 [H, W, 3]; a tile is a picture with its label; a page is tiles in rows.
Promise: the same input gives the same bytes; files appear complete, or ``OutputError`` is raised;
unknown values are grey; an unreadable photograph is no error, as pages have other pictures, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image as PillowImage, ImageDraw, ImageFont

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.files import StrPath
from splatseed.io.staging import atomic_file
from splatseed.scene import Image

GRID_SIDE = 600
"""Longer side of a picture in a grid, in pixels."""
LABEL_SIZES = (20, 11)  # font size by default, and the smallest for long labels
GAP, LABEL_HEIGHT, STRIP_HEIGHT = 12, 34, 44
PAPER, INK, UNKNOWN = (255, 255, 255), (20, 20, 20), (150, 150, 150)
GROUND = (110, 110, 110)
"""Behind points in their own colours, here and in the viewer: white and black walls show on it."""
BLANK = (230, 230, 230)  # in place of a photograph
RANGE = (2, 98)
"""Percentiles of a map's values at the ends of its colours."""


class Tile(NamedTuple):
    """A picture of a page."""

    label: str
    picture: UInt8[np.ndarray, "H W 3"]


def fitted(width: int, height: int, side: float = GRID_SIDE) -> tuple[int, int]:
    """Width and height scaled so that the longer side is ``side``."""
    factor = side / max(width, height)
    return max(round(width * factor), 1), max(round(height * factor), 1)


def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Font of labels, which has the letters of Latin-1."""
    return ImageFont.load_default(size=size)


def latin(text: str) -> str:
    r"""Escape characters that ``font`` does not have, as \u...."""
    return text.encode("latin-1", "backslashreplace").decode("latin-1")


def write_grid(
    tiles: Sequence[Tile],
    path: StrPath,
    *,
    columns: int | None = None,
    footer: UInt8[np.ndarray, "H W 3"] | None = None,
) -> Path:
    """Arrange one or more pictures in rows, each with its label above, and write the PNG.

    By default a row has three or four columns, whichever leaves fewer gaps; smaller pictures are
    centred. The footer, no wider than the page, is at the bottom.
    """
    if columns is None:
        columns = min(len(tiles), min((3, 4), key=lambda count: -len(tiles) % count))
    height, width = np.max([tile.picture.shape[:2] for tile in tiles], axis=0).tolist()
    rows = -(-len(tiles) // columns)
    foot = 0 if footer is None else len(footer)
    page_height = rows * (height + LABEL_HEIGHT) + GAP + foot
    page = PillowImage.new("RGB", (columns * (width + GAP) + GAP, page_height), PAPER)
    draw, (default, smallest) = ImageDraw.Draw(page), LABEL_SIZES
    for i, (label, picture) in enumerate(tiles):
        x = GAP + (i % columns) * (width + GAP)
        y = (i // columns) * (height + LABEL_HEIGHT)
        text = latin(label)
        # A smaller, legible font where a label would be wider than its tile.
        size = int(default * width / max(font(default).getlength(text), 1.0))
        letters = font(max(min(default, size), smallest))
        draw.text((x, y + LABEL_HEIGHT / 2), text, fill=INK, font=letters, anchor="lm")
        left, top = (width - picture.shape[1]) // 2, (height - len(picture)) // 2
        page.paste(PillowImage.fromarray(picture), (x + left, y + LABEL_HEIGHT + top))
    if footer is not None:
        page.paste(PillowImage.fromarray(footer), (GAP, page_height - foot))
    with atomic_file(Path(path)) as partial:
        page.save(partial, format="PNG")
    return Path(path)


def resized(
    picture: UInt8[np.ndarray, "h w 3"], size: tuple[int, int], *, smooth: bool = True
) -> UInt8[np.ndarray, "H W 3"]:
    """Resize a picture to a width and height; ``smooth=False`` repeats pixels."""
    method = PillowImage.Resampling.LANCZOS if smooth else PillowImage.Resampling.NEAREST
    return np.asarray(PillowImage.fromarray(picture).resize(size, method))


# Colours ------------------------------------------------------------------------------------------


def map_colors(
    values: Float[np.ndarray, "*S"], low: float, high: float, colormap: str = "viridis"
) -> UInt8[np.ndarray, "*S 3"]:
    """Map values from ``low`` to ``high`` to colours; grey where they are not finite.

    The colour maps viridis (dark is low) and plasma (blue is low) stay legible in grey print.
    """
    from matplotlib import colormaps  # noqa: PLC0415  (slow to import)

    known = np.isfinite(values)
    share = (np.where(known, values, low) - low) / max(high - low, 1e-12)
    colors = colormaps[colormap](np.clip(share, 0.0, 1.0), bytes=True)[..., :3]
    return np.asarray(np.where(known[..., None], colors, np.array(UNKNOWN, np.uint8)))


def value_range(values: Float[np.ndarray, "*S"]) -> tuple[float, float]:
    """Range of the finite values without their extremes; 0 to 0 if there are none."""
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, RANGE) if finite.size else (0.0, 0.0)
    return float(low), float(high)


def nearness(depth: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S"]:
    """-log(depth), in which colours are evenly spaced; not finite where depth is unknown."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(-np.log(depth))


def depth_picture(
    depth: Float[np.ndarray, "H W"], limits: tuple[float, float] | None = None
) -> UInt8[np.ndarray, "H W 3"]:
    """Map planar depth to colours: near is yellow, far is violet, 0 and NaN are grey.

    ``limits`` are those of its ``nearness``, by default its ``value_range``.
    """
    near = nearness(depth)
    return map_colors(near, *(limits or value_range(near)))


def color_bar(low: str, high: str, colormap: str = "plasma") -> UInt8[np.ndarray, "H W 3"]:
    """Strip of colours with labels at its ends."""
    letters = font(18)
    left, right = (round(letters.getlength(label)) + 24 for label in (low, high))
    values = np.tile(np.linspace(0.0, 1.0, GRID_SIDE - left - right), (20, 1))
    bar = PillowImage.new("RGB", (GRID_SIDE, STRIP_HEIGHT), PAPER)
    bar.paste(PillowImage.fromarray(map_colors(values, 0.0, 1.0, colormap)), (left, 12))
    draw = ImageDraw.Draw(bar)
    draw.text((12, 22), low, fill=INK, font=letters, anchor="lm")
    draw.text((GRID_SIDE - right + 12, 22), high, fill=INK, font=letters, anchor="lm")
    return np.asarray(bar)


def legend(entries: Mapping[str, tuple[int, ...]], width: int) -> UInt8[np.ndarray, "H W 3"]:
    """Strip with a dot in each colour, and its name; as many rows as fit ``width``."""
    letters, places, x, row = font(18), list[tuple[float, int]](), 8.0, 0
    for text in entries:
        needed = 24 + letters.getlength(text) + 28
        if x + needed > width and x > 8.0:
            x, row = 8.0, row + 1
        places.append((x, row * STRIP_HEIGHT))
        x += needed
    strip = PillowImage.new("RGB", (width, (row + 1) * STRIP_HEIGHT), PAPER)
    draw = ImageDraw.Draw(strip)
    for (text, color), (left, top) in zip(entries.items(), places, strict=True):
        draw.ellipse((left, top + 14, left + 16, top + 30), fill=tuple(color))
        draw.text((left + 24, top + 22), text, fill=INK, font=letters, anchor="lm")
    return np.asarray(strip)


# Photographs --------------------------------------------------------------------------------------


def photograph_at(image: Image | None, size: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"] | None:
    """Read an image's photograph at a width and height; None if it cannot be read."""
    if image is None:
        return None
    try:
        picture = PillowImage.fromarray(image.read())
    except (SceneNotFoundError, SceneFormatError):
        return None
    return np.array(picture.resize(size, PillowImage.Resampling.LANCZOS))


def photograph_or_blank(image: Image | None, size: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """Read the photograph, or make a light grey picture if it cannot be read."""
    photograph = photograph_at(image, size)
    return np.full((size[1], size[0], 3), BLANK, np.uint8) if photograph is None else photograph
