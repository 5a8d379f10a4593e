"""The paper's figures 1 and 2 from a capture: its points, and those that the methods add.

    python -m benchmarks.paper.figures DIR/bonsai -o PICTURE.png
    python -m benchmarks.paper.figures DIR/room0 --depth CAPTURE -o PICTURE.png

With depth maps it is figure 2. The camera is ``choose_camera``'s; a point is a disc of the same
size in every panel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from benchmarks.paper.gained import LAYOUT, RANDOM
from PIL import Image as PillowImage

import splatseed as ss
from splatseed.bench.plan import DEPTH
from splatseed.errors import SplatseedError
from splatseed.io import find_depths
from splatseed.io.staging import atomic_file
from splatseed.photos.viewpoint import choose_camera, choose_image
from splatseed.viewer import page
from splatseed.viewer.points import render_points

__all__: list[str] = []


@dataclass(frozen=True)
class Options:
    """Draw a capture's clouds by method."""

    scene: Annotated[Path, tyro.conf.Positional]
    """A scene with points and photographs."""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",))]
    """The PNG to write."""
    depth: Path | None = None
    """The folder of its depth maps, for figure 2."""
    ratio: float = 16.0
    """Points in all, per point of the scene."""
    width: int = 1600
    """Pixels of a row of panels."""
    colors: int = 64
    """Of the picture's palette."""


def main(options: Options) -> None:
    """Make the clouds and the picture."""
    scene = ss.load_scene(options.scene)
    clouds: dict[str, ss.PointCloud] = {"SfM": scene.points}
    if options.depth is None:
        named = [*(name for name in LAYOUT if name != DEPTH), RANDOM]
        of = {
            name: ss.upsample(scene, name, ratio=options.ratio, profile="paper") for name in named
        }
        clouds |= {f"{name}, {options.ratio:g}x": cloud for name, cloud in of.items()}
    else:
        scene = scene.replace(depths=find_depths(scene, options.depth))
        for profile in ("paper", "default"):
            cloud = ss.upsample(scene, DEPTH, ratio=options.ratio, profile=profile)
            clouds[f"depth-guided, {options.ratio:g}x, profile {profile}"] = cloud
    draw(scene, clouds, options)


def draw(scene: ss.Scene, clouds: Mapping[str, ss.PointCloud], options: Options) -> None:
    """Write the photograph and the clouds in a grid, in few colours."""
    camera, image = choose_camera(scene), choose_image(scene)
    columns = 2 if len(clouds) < 4 else 4
    side = options.width // columns
    scale = side / max(camera.width, camera.height)
    photograph = page.photograph_at(scene, image, page.fitted(camera.width, camera.height, side))
    tiles = [] if photograph is None else [page.Tile("photograph", photograph)]
    for label, cloud in clouds.items():
        picture = render_points(cloud, camera, scale=scale)
        tiles.append(page.Tile(f"{label}: {len(cloud):,} points", picture))
    page.write_grid(tiles, options.output, columns=columns)
    with PillowImage.open(options.output) as picture:
        none, kind = PillowImage.Dither.NONE, PillowImage.Quantize.MEDIANCUT
        few = picture.convert("RGB").quantize(options.colors, kind, options.colors, dither=none)
    with atomic_file(options.output) as partial:
        few.save(partial, format="PNG", optimize=True)


if __name__ == "__main__":
    try:
        main(tyro.cli(Options))
    except SplatseedError as error:
        raise SystemExit(f"error: {error}") from None
