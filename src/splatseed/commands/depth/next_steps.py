"""The commands that ``splatseed depth`` prints at its end, each of which works on the scene."""

from __future__ import annotations

from pathlib import Path

from splatseed.lens import undistort_command
from splatseed.literal import quoted
from splatseed.scene import Scene
from splatseed.seeding.diagnostics import is_distorted

RATIO = 16
PER_POINT = 8
"""Pixels of known depth per new point. Beyond that, lifting runs out of pixels that are free and
away from depth discontinuities: on stereo's maps of a kitchen with 14% known, one in 8.2 was."""


def after_stereo(
    path: Path, scene: Scene, maps: Path, confirmed: int, most: int
) -> list[tuple[str, str]]:
    """What to do with stereo's maps, which need no alignment.

    Args:
        path: Where the scene lies.
        scene: The scene.
        maps: The folder of the maps.
        confirmed: Number of pixels with a depth, of all maps.
        most: Most seeds with which training can begin.
    """
    if is_distorted(scene):  # seeds are lifted along the rays of a pinhole camera
        return [look(path, maps)]
    number = number_for(len(scene.points), confirmed, most)
    aligned = "" if len(scene.points) else "--depth.no-align "
    return [look(path, maps), use(path, maps, aligned + number)]


def after_network(
    path: Path, scene: Scene, maps: Path, known: int, most: int
) -> list[tuple[str, str]]:
    """What to do with a network's maps, which must be aligned to points; arguments as above."""
    if is_distorted(scene):
        return [look(path, maps), ("for seeds, begin with", undistort_command(path))]
    if len(scene.points):
        return [look(path, maps), use(path, maps, number_for(len(scene.points), known, most))]
    photographs = scene.source.image_dir if scene.source else None
    images = "IMAGES" if photographs is None else quoted(photographs)
    made = Path("SCENE")
    points = f"splatseed sfm {images} --poses-from {quoted(path)} -o {made}"
    return [look(path, maps), ("points to align to", points), use(made, maps, f"--ratio {RATIO}")]


def look(path: Path, maps: Path) -> tuple[str, str]:
    """The command that shows the maps."""
    info = f"splatseed info {quoted(path)} --depth {quoted(maps)} --picture depth.png"
    return "look", info


def number_for(points: int, known: int, most: int) -> str:
    """The option for as many points as maps can give and training can begin with.

    Of a scene with points, at most ``RATIO`` times as many.

    Args:
        points: Points of the scene.
        known: Number of pixels with a depth, of all maps.
        most: Most seeds with which training can begin.
    """
    number = max(points + 1, min(most, points + known // PER_POINT))
    return f"--ratio {RATIO}" if 0 < RATIO * points <= number else f"--num-points {number}"


def use(path: Path, maps: Path, how: str) -> tuple[str, str]:
    """The command that makes seeds of the maps."""
    seeds = f"splatseed upsample {quoted(path)} --method depth --depth {quoted(maps)}"
    return "use", f"{seeds} {how} -o OUT"
