"""The commands that ``splatseed depth`` prints at its end, each of which works on the scene."""

from __future__ import annotations

from pathlib import Path

from splatseed.diagnostics.trainable import is_distorted
from splatseed.lens import undistort_command
from splatseed.literal import quoted
from splatseed.scene import Scene

__all__ = ["after_network", "after_stereo", "look"]


PER_POINT = 8
"""Confirmed pixels per point: lifting drops those that hide what another view sees."""


def after_stereo(path: Path, scene: Scene, maps: Path, confirmed: int) -> list[tuple[str, str]]:
    """What to do with stereo's maps, which need no alignment.

    Args:
        path: Where the scene lies.
        scene: The scene.
        maps: The folder of the maps.
        confirmed: Number of pixels with a depth, of all maps.
    """
    if is_distorted(scene):  # seeds are lifted along the rays of a pinhole camera
        return [look(path, maps)]
    if len(scene.points):
        return [look(path, maps), _use(path, maps, "--ratio 16")]
    number = max(1, confirmed // PER_POINT)
    return [look(path, maps), _use(path, maps, f"--no-align --num-points {number}")]


def after_network(path: Path, scene: Scene, maps: Path) -> list[tuple[str, str]]:
    """What to do with a network's maps, which must be aligned to points; arguments as above."""
    if is_distorted(scene):
        return [look(path, maps), ("for seeds, begin with", undistort_command(path))]
    if len(scene.points):
        return [look(path, maps), _use(path, maps, "--ratio 16")]
    photographs = scene.source.image_dir if scene.source else None
    images = "IMAGES" if photographs is None else quoted(photographs)
    made = Path("SCENE")
    points = f"splatseed sfm {images} --poses-from {quoted(path)} -o {made}"
    return [look(path, maps), ("points to align to", points), _use(made, maps, "--ratio 16")]


def look(path: Path, maps: Path) -> tuple[str, str]:
    """The command that shows the maps."""
    info = f"splatseed info {quoted(path)} --depth {quoted(maps)} --picture depth.png"
    return "look", info


def _use(path: Path, maps: Path, how: str) -> tuple[str, str]:
    seeds = f"splatseed upsample {quoted(path)} --method depth --depth {quoted(maps)}"
    return "use", f"{seeds} {how} -o OUT"
