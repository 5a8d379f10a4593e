"""The commands that train a written scene, with splatseed and with each other 3DGS trainer."""

from __future__ import annotations

from pathlib import Path

from splatseed.console import print_commands, print_note
from splatseed.lens import undistort_command
from splatseed.literal import quoted
from splatseed.scene import Scene, SceneFormat
from splatseed.seeding.diagnostics import is_distorted, untrainable

COLMAP_ONLY = frozenset({"gsplat", "graphdeco", "LichtFeld"})
PINHOLE_ONLY = frozenset({"splatseed", "graphdeco", "OpenSplat", "LichtFeld"})
"""Trainers that do not deal with lens distortion themselves, as far as we know."""
COMMON_LENSES = frozenset({"SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"})
"""The distortion that the others know."""


def tell_training(read_from: Path, scene: Scene, output: Path, layout: SceneFormat) -> None:
    """Print the commands that train a scene that was written, and what some of them need first.

    Args:
        read_from: Where the scene was read.
        scene: The scene as it was read.
        output: The scene folder that was written.
        layout: Its layout.
    """
    if not scene.images:  # writing it said so
        return
    if missing := untrainable(scene):
        print_note(missing)
        return
    if not is_distorted(scene):
        print_commands("train it with", training_commands(output, layout))
        return
    lenses = {image.intrinsics.model for image in scene.images if image.intrinsics.has_distortion}
    known = lenses <= COMMON_LENSES
    if known:
        print_commands("train it with", training_commands(output, layout, distorted=True))
    print_note(
        f"{'The other trainers' if known else 'Trainers'} need photographs without lens "
        f"distortion: begin with {undistort_command(read_from)}, and upsample that scene."
    )


def training_commands(
    path: Path, written_format: SceneFormat, *, distorted: bool = False
) -> list[tuple[str, str]]:
    """(trainer, command) for every trainer that reads the scene at ``path`` unchanged.

    Args:
        path: The scene folder that was written.
        written_format: "colmap" or "transforms": gsplat's examples and graphdeco's code read only
            the former, and LichtFeld Studio is made for it.
        distorted: Whether cameras have lens distortion, with which only some trainers deal.

    Example:
        >>> dict(training_commands(Path("/data/out"), "colmap"))["graphdeco"]
        'python train.py -s /data/out -m /data/out-graphdeco --eval'
    """
    # Other trainers are run from their own checkouts, so a relative path would miss.
    full = path.resolve()
    scene = quoted(full)
    result = [quoted(f"{full}-{name}") for name in ("gsplat", "graphdeco", "lichtfeld")]
    gsplat = f"--data_dir {scene} --data_factor 1 --result_dir {result[0]}"
    colmap = written_format != "transforms"
    layout = " colmap --colmap-path sparse/0 --downscale-factor 1" if colmap else ""
    commands = {
        "splatseed": f"splatseed train {quoted(path)} -o {quoted(f'{path}-run')}",
        "gsplat": f"python examples/simple_trainer.py default {gsplat}",
        "graphdeco": f"python train.py -s {scene} -m {result[1]} --eval",
        "nerfstudio": f"ns-train splatfacto --data {scene}{layout}",
        "Brush": f"brush {scene} --with-viewer",
        "OpenSplat": f"./opensplat {scene} -n 30000",
        "LichtFeld": f"./build/LichtFeld-Studio -d {scene} -o {result[2]}",
    }
    unable = (frozenset() if colmap else COLMAP_ONLY) | (PINHOLE_ONLY if distorted else frozenset())
    return [(name, command) for name, command in commands.items() if name not in unable]
