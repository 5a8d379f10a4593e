"""Pictures of point clouds, maps and cells, seen by the scene's own cameras.

Notation: a picture is uint8 [H, W, 3]; a tile is a picture with its label; a page is tiles in rows.
Promise: the functions that make pictures and tiles touch no files; the same input gives the same
bytes; files appear whole or not at all.
"""

from splatseed.preview.alignment import preview_alignment
from splatseed.preview.cells import CoveredView, cell_picture, preview_cells
from splatseed.preview.clouds import preview_errors, preview_methods, preview_pair
from splatseed.preview.colors import color_bar, heat
from splatseed.preview.maps import map_tiles, preview_maps
from splatseed.preview.origins import origin_legend, origin_picture, preview_origins
from splatseed.preview.page import Tile, write_grid
from splatseed.preview.points import render_points
from splatseed.views.viewpoint import choose_camera, choose_image

__all__ = [
    "CoveredView",
    "Tile",
    "cell_picture",
    "choose_camera",
    "choose_image",
    "color_bar",
    "heat",
    "map_tiles",
    "origin_legend",
    "origin_picture",
    "preview_alignment",
    "preview_cells",
    "preview_errors",
    "preview_maps",
    "preview_methods",
    "preview_origins",
    "preview_pair",
    "render_points",
    "write_grid",
]
