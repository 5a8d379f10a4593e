"""Clouds larger than memory: cut into tiles on disk, upsampled tile by tile.

The steps, each of them resumable: ``reading`` copies the cloud to disk; ``splitting`` sorts it into
tiles; ``steps`` weighs each tile's points; ``drawing`` draws the bases in file order; ``steps``
makes the new points of each tile; ``assembly`` puts all points in order. Promise: the same bytes as
in memory, whatever the size of the tiles and whoever works on them.
"""

from splatseed.tiles.planning import TilePlan, check_disk, choose_jobs, plan_tiles
from splatseed.tiles.run import Request, Tiled, check_tileable, make_tiled
from splatseed.tiles.sources import FileSource, SceneSource, Source
from splatseed.tiles.work import WorkFolder, open_work, work_path

__all__ = [
    "FileSource",
    "Request",
    "SceneSource",
    "Source",
    "TilePlan",
    "Tiled",
    "WorkFolder",
    "check_disk",
    "check_tileable",
    "choose_jobs",
    "make_tiled",
    "open_work",
    "plan_tiles",
    "work_path",
]
