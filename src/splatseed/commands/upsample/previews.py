"""Write the pictures and the initial Gaussians of ``splatseed upsample``."""

from __future__ import annotations

from pathlib import Path

from splatseed.commands.upsample.options import Options
from splatseed.console import StageClock
from splatseed.io.origin import write_offset
from splatseed.methods import Upsampler
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent
from splatseed.sampling import evenly_spaced
from splatseed.scene import Scene
from splatseed.seeding.photo_methods import CELL, MAX_SIZE, Stereo, photographed, read_views
from splatseed.splat.formats import write_gaussians
from splatseed.training.initialization import gaussians_of_scene
from splatseed.training.settings import TrainSettings

PAIR, ORIGINS, CELLS, MAPS = PICTURES = (
    "preview.png",
    "preview_origins.png",
    "preview_cells.png",
    "preview_maps.png",
)
PHOTOGRAPHS_SHOWN = 4
"""Photographs whose cells and maps are drawn."""


def write_start(path: Path, scene: Scene, method: Upsampler, progress: Progress) -> None:
    """Write the Gaussians that training on the scene's points would start from.

    The test views of the method are not used.
    """
    images = photographed(scene, getattr(method, "test_every", 0))
    views = read_views(scene, images, MAX_SIZE, progress)
    settings = TrainSettings(strategy="grow", seed_colors=True)
    write_gaussians(path, gaussians_of_scene(scene.points, views, settings))
    write_offset(path, scene.offset)


def write_previews(
    options: Options, scene: Scene, seeds: PointCloud, method: Upsampler, clock: StageClock
) -> None:
    """Draw the points before and after; with photographs, also origins, cells and stereo's maps."""
    from splatseed.seeding.cover import covered_cells
    from splatseed.viewer import clouds, maps

    folder = options.output
    clock("preview", 0.0)
    clouds.preview_pair(scene, seeds, folder / PAIR, title=options.method)
    if scene.has_photographs:
        clock("preview", 0.4)
        clouds.preview_origins(scene, seeds, folder / ORIGINS, options.method)
        clock("preview", 0.6)
        images = photographed(scene)
        images = tuple(images[i] for i in evenly_spaced(len(images), PHOTOGRAPHS_SHOWN))
        views = read_views(scene, images, MAX_SIZE, silent)
        both = [cloud.xyz[cloud.finite] for cloud in (scene.points, seeds)]
        cells = zip(views, *(covered_cells(views, xyz, CELL) for xyz in both), strict=True)
        shown = [
            clouds.CoveredView(v.name, v.photograph, CELL, before, after)
            for v, before, after in cells
        ]
        clouds.preview_cells(shown, folder / CELLS)
    if isinstance(method, Stereo):
        # Recomputed for a few views: keeping all maps would take as much memory as the views.
        count = len(photographed(scene, method.test_every))
        some = evenly_spaced(count, PHOTOGRAPHS_SHOWN).tolist()
        maps.preview_maps(scene, method.maps(scene, some, options.seed, clock), folder / MAPS)
    clock("preview", 1.0)
