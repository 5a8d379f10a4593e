"""Which cells of a photograph hold a seed, and which hold none.

Notation: cell (i, j) of a ``covered`` grid [rows, columns] starts at pixel (``cell i``, ``cell j``)
and has ``cell`` px a side; the last row and column may reach beyond the photograph. Promise: cells
are coloured exactly, without bleeding into each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image as PillowImage

from splatseed.errors import ParameterError
from splatseed.preview.page import Tile, centered, fitted, write_grid

EMPTY = np.array([214.0, 20.0, 190.0])
"""Magenta, the rarest colour in photographs."""
BLEND = 0.6
"""Opacity of that colour over an empty cell."""
DIM = 0.75
"""Factor on the photograph's brightness."""
SIDE = 600


class CoveredView(NamedTuple):
    """Which cells of one view are covered.

    Args:
        name: The image's name.
        photograph: Its pixels, uint8 [H, W, 3].
        cell: Side of a cell in pixels.
        before: Whether each cell holds an original, bool [rows, columns].
        after: Whether it holds a seed; None if nothing was added.
    """

    name: str
    photograph: UInt8[np.ndarray, "H W 3"]
    cell: int
    before: Bool[np.ndarray, "rows columns"]
    after: Bool[np.ndarray, "rows columns"] | None = None


def cell_picture(
    photograph: UInt8[np.ndarray, "H W 3"], covered: Bool[np.ndarray, "rows columns"], cell: int
) -> UInt8[np.ndarray, "H W 3"]:
    """The dimmed photograph, with cells without a seed in magenta.

    Args:
        photograph: The photograph at the size at which cells were counted.
        covered: Whether each cell holds a seed.
        cell: Side of a cell in pixels.

    Raises:
        ParameterError: The cells do not cover the photograph.
    """
    height, width = photograph.shape[:2]
    if covered.shape != (-(-height // cell), -(-width // cell)):
        raise ParameterError(
            f"{-(-height // cell)} x {-(-width // cell)} cells of {cell} px for {width} x {height}",
            found=" x ".join(map(str, covered.shape)),
            fix="Pass the photograph at the size at which cells were counted.",
        )
    empty = ~np.repeat(np.repeat(covered, cell, axis=0), cell, axis=1)[:height, :width, None]
    dimmed = DIM * photograph.astype(np.float64)
    grey = dimmed.mean(axis=2, keepdims=True)
    picture = np.where(empty, (1 - BLEND) * grey + BLEND * EMPTY, dimmed)
    return np.asarray(np.round(picture), np.uint8)


def preview_cells(views: Sequence[CoveredView], path: Path | str) -> Path:
    """Write a page: for each view, the cells covered by the originals, and by all seeds.

    Args:
        views: At least one.
        path: The PNG to write.

    Raises:
        OutputError: The file cannot be written.
        ParameterError: The cells of a view do not cover it.
    """
    tiles = [tile for view in views for tile in _tiles(view)]
    columns = 2 if len(views) == 1 or len(tiles) == len(views) else 4
    return write_grid(centered(tiles), path, columns=min(columns, len(tiles)))


def _tiles(view: CoveredView) -> list[Tile]:
    before = _tile(view, view.before, f"{view.name[-28:]}: {view.before.mean():.1%} covered")
    if view.after is None:
        return [before]
    return [before, _tile(view, view.after, f"with new points: {view.after.mean():.1%}")]


def _tile(view: CoveredView, covered: Bool[np.ndarray, "rows columns"], label: str) -> Tile:
    picture = PillowImage.fromarray(cell_picture(view.photograph, covered, view.cell))
    resized = picture.resize(
        fitted(picture.width, picture.height, SIDE), PillowImage.Resampling.LANCZOS
    )
    return Tile(label, np.asarray(resized))
