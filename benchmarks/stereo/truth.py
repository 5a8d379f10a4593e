"""Stereo against true depth: two captures with a depth camera, a made room, a bare one.

Notation: every eighth photograph by name is *held out*: stereo does not see it, and its depth is
the surface that seeds are held against. A *pixel* is one of a stereo map; its true depth is that of
the four depth pixels around its centre: their mean where they lie on one surface, any of them where
they do not. Promise: captures are only read; what is made goes into a cache.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.seeds.depth import CAPTURES, FAR, HELD_OUT, Truth, query, triangulated
from scipy.spatial import cKDTree

import splatseed as ss
from splatseed.depth.stereo.fusion import fuse
from splatseed.depth.stereo.maps import StereoResult, StereoSettings
from splatseed.depth.stereo.pipeline import find_stereo, known_visibility
from splatseed.io import find_depths
from splatseed.photos.loading import load_views
from splatseed.photos.sizes import factor_for_size
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.synthetic import make_capture, write_capture
from splatseed.synthetic.room import Room, render_views
from splatseed.synthetic.texture import Plain

__all__ = ["TRUE_SCENES", "Score", "first", "load", "prepare", "relative_error", "score_all"]

TRUE_SCENES = ("replica/room0", "7scenes_redkitchen", "made room", "made, no texture")
CELL = 4.0
"""Pixels between seeds."""
ONE_SURFACE = 1.02
"""Depths beside each other that differ by less are of one surface."""
MADE_STEP = 2
GAP_SAMPLES = 50_000


@dataclass(frozen=True)
class Score:
    """How good stereo is on one scene.

    Args:
        kept: Share of the maps' pixels that have a depth.
        within_1: Share of these, where the truth is known, that are within 1% of it.
        within_5: Likewise 5%.
        reached: Share of the held-out surface with a seed within 5 cm.
        seeds: How many there are.
        seconds: Processor time of maps and seeds.
    """

    kept: float
    within_1: float
    within_5: float
    reached: float
    seeds: int
    seconds: float

    def cells(self) -> list[str]:
        """As a row of a table."""
        shares = (self.kept, self.within_1, self.within_5, self.reached)
        return [*(f"{share:.1%}" for share in shares), f"{self.seconds:.1f}"]


def prepare(names: list[str], cache: Path) -> None:
    """Make, or triangulate, what is not in the cache."""
    for name in names:
        if name in CAPTURES:
            triangulated(name, cache)
        elif not _made_folder(name, cache).is_dir():
            capture = make_capture()
            if name == "made, no texture":
                capture = dataclasses.replace(capture, images=_bare_images(capture))
            write_capture(capture, _made_folder(name, cache))


def score_all(
    names: list[str], cache: str, limit: int, without: str
) -> dict[str, dict[str, float]]:
    """The score on each scene, as JSON can hold it.

    Args:
        names: Of the scenes, which are in the cache.
        cache: Where.
        limit: Photographs of a capture at most, the first by name.
        without: "points": forget what Structure-from-Motion found; "depths": the depth maps as
            well.
    """
    return {name: asdict(_score(name, Path(cache), limit, without)) for name in names}


def _score(name: str, cache: Path, limit: int, without: str) -> Score:
    settings = StereoSettings()
    scene = first(load(name, cache), limit)
    truth = Truth.of(scene, CAPTURES.get(name, MADE_STEP))
    images = scene.split(HELD_OUT)[0]
    seen = scene
    if without:
        seen = scene.replace(
            points=PointCloud(np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8)), tracks=None
        )
    if without == "depths":
        seen = seen.replace(depths=None)
    factor = factor_for_size(images, settings.max_size)
    views = load_views(scene, images, data_factor=factor)
    find_stereo(views[:2], images[:2], known_visibility(scene), settings)  # compiled
    started = time.process_time()
    stereo = find_stereo(views, images, known_visibility(seen), settings)
    seeds = fuse(stereo, CELL)
    seconds = time.process_time() - started
    kept, one, five = _map_shares(stereo, scene)
    return Score(kept, one, five, _reached(seeds.xyz, truth), len(seeds), seconds)


def load(name: str, cache: Path) -> Scene:
    """A scene of known depth, with its depth maps."""
    if name in CAPTURES:
        return triangulated(name, cache)
    folder = _made_folder(name, cache)
    scene = ss.load_scene(folder)
    return scene.replace(depths=find_depths(scene, folder))


def _made_folder(name: str, cache: Path) -> Path:
    return cache / name.replace(",", "").replace(" ", "_")


def _bare_images(capture: Any) -> np.ndarray:
    """The made room's photographs with one colour on all surfaces; light and shade remain."""
    room, wall = capture.room, Plain((0.83, 0.84, 0.82))
    bare = Room(room.names, room.surfaces, (wall,) * len(room.textures))
    return render_views(bare, [image.camera for image in capture.scene.images])[0]


def first(scene: Scene, limit: int) -> Scene:
    """The scene with its first photographs by name."""
    ordered = sorted(scene.images, key=lambda image: image.name)
    return scene.replace(images=tuple(ordered[:limit]))


def _map_shares(stereo: StereoResult, scene: Scene) -> tuple[float, float, float]:
    """Of all pixels those kept; of these those within 1% and 5% of the truth."""
    errors, pixels, kept = [], 0, 0
    for i in range(len(stereo.views)):
        depth_map = stereo.map(i)
        known = np.isfinite(depth_map.depth)
        pixels, kept = pixels + known.size, kept + known.sum()
        truth = scene.depths.read(depth_map.name).values
        errors.append(relative_error(depth_map.depth, truth)[known])
    error = np.concatenate(errors)
    error = error[np.isfinite(error)]
    return float(kept / pixels), float((error < 0.01).mean()), float((error < 0.05).mean())


def relative_error(depth: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Of a map against the four depth pixels around each of its own, [h, w]; NaN where unknown.

    The maps may differ in size.
    """
    row, column = (
        np.clip(np.rint((np.arange(n) + 0.5) / n * m).astype(int), 1, m - 1)
        for n, m in zip(depth.shape, truth.shape, strict=True)
    )
    row = row[:, None]
    around = np.stack([truth[row - a, column - b] for a in (0, 1) for b in (0, 1)])
    around = np.where(around > 0, around, np.nan)
    one = around.max(axis=0) < ONE_SURFACE * around.min(axis=0)
    around = np.where(one, around.mean(axis=0), around)
    return np.abs(depth / around - 1.0).min(axis=0)


def _reached(xyz: np.ndarray, truth: Truth) -> float:
    """The share of the held-out surface with a point within ``FAR``."""
    if not len(xyz):
        return 0.0
    places = np.random.default_rng(0).choice(len(truth.surface), GAP_SAMPLES)
    gap = query(cKDTree(xyz, balanced_tree=False), truth.surface[places])
    return float((gap <= FAR).mean())
