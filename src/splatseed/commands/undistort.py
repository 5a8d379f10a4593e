"""``splatseed undistort``: remove lens distortion, for trainers that need PINHOLE cameras."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatseed.commands.options import parse_options
from splatseed.console import add_results, print_next, print_note, print_pairs, stage_display
from splatseed.findings import Finding, without_kinds
from splatseed.io import load_scene
from splatseed.io.depth_maps import DepthFiles
from splatseed.io.exclusion import exclude
from splatseed.io.load import depths_beside
from splatseed.io.seeds import was_upsampled
from splatseed.io.staging import check_output
from splatseed.photos.panorama import FACES
from splatseed.requirements import require
from splatseed.seeding.advice import is_distorted
from splatseed.sfm import undistort
from splatseed.text import agreeing, counted, quoted
from splatseed.training.request import ExcludeChoice


@dataclass(frozen=True)
class Options:
    """Remove lens distortion from a scene's photographs; its cameras become PINHOLE (pycolmap)."""

    scene: Annotated[Path, tyro.conf.Positional]
    """A scene with photographs, in any layout."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The scene folder to write, in COLMAP's layout."""
    exclude: ExcludeChoice = ()
    """Photographs to leave out: a name, a pattern such as 'IMG_00*', or a .txt file of these."""
    mask_below: float = 0.0
    """Mask panoramas within this angle of straight down, in degrees, where the photographer is."""
    overwrite: bool = False
    """Replace an output folder that splatseed undistort wrote before."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "undistort", arguments)
    output, overwrite = options.output, options.overwrite
    require("pycolmap")
    check_output(output, kind="undistort", overwrite=overwrite, protect=[options.scene])
    with stage_display(lines=True) as clock:
        clock("read", 0.0)
        scene = load_scene(options.scene, require_points=False, panoramas=True)
        scene = exclude(scene, options.exclude)
        whole = sum(image.intrinsics.is_panorama for image in scene.images)
        clock.count(len(scene.images) + (len(FACES) - 1) * whole, "photographs", "undistortion")
        report = undistort(
            scene, output, mask_below=options.mask_below, overwrite=overwrite, on_progress=clock
        )
    counts = [("images", f"{report.registered:,}"), ("points", f"{report.num_points:,}")]
    print_pairs("splatseed undistort", [*counts, ("output", str(output))])
    add_results(output=output, images=report.registered, points=report.num_points)
    print_note(*report.findings, *without_kinds(scene.findings, "lens-distortion"))
    maps = scene.depths or depths_beside(scene)
    if isinstance(maps, DepthFiles) and maps:
        folder = quoted(os.path.commonpath([path.parent for path in maps.paths.values()]))
        are = agreeing(len(maps), "is", "are")
        text = f"Its {counted(len(maps), 'depth map')} {are} not in the output"
        how = (
            ", as panoramas have none" if whole else f": name them to upsample by --depth {folder}"
        )
        print_note(Finding("depth-maps-left-out", f"{text}{how}."))
    if not is_distorted(scene):
        text = "No camera had distortion: the photographs are copies."
        print_note(Finding("no-distortion", text, "info"))
    verb, made = ("train", "RUN") if was_upsampled(scene) else ("upsample", "OUT")
    print_next([("", f"splatseed {verb} {quoted(output)} -o {made}")])
