"""Clouds larger than memory: cut into tiles on disk, upsampled tile by tile.

The steps, each of them resumable: ``cutting`` copies the cloud to disk and sorts it into tiles;
``making`` weighs each tile's points, with the neighbours that ``neighborhood`` finds, draws the
bases in file order, makes the new points of each tile, and gives all points in order. Promise: the
same bytes as in memory, whatever the size of the tiles and wherever they are worked on; but for two
kinds of PLY, which ``docs/large_clouds.md`` names.
"""

from splatseed.upsample.tiles.cutting import Source, file_source, scene_source
from splatseed.upsample.tiles.making import Request, Tiled, make_tiled
from splatseed.upsample.tiles.work import TilePlan, check_disk, open_work, plan_tiles, work_path

__all__ = [
    "Request",
    "Source",
    "TilePlan",
    "Tiled",
    "check_disk",
    "file_source",
    "make_tiled",
    "open_work",
    "plan_tiles",
    "scene_source",
    "work_path",
]
