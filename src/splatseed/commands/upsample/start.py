"""``splatseed upsample --gaussians``: the first Gaussians, for trainers that take a 3DGS .ply."""

from __future__ import annotations

from pathlib import Path

from splatseed.errors import OutputError, ParameterError
from splatseed.progress import Progress
from splatseed.scene import Scene
from splatseed.seeding.photographs import MAX_SIZE, photographed, read_views
from splatseed.splat.ply import write_gaussians
from splatseed.train.settings import TrainSettings
from splatseed.train.start import gaussians_of_scene
from splatseed.upsample import Upsampler

__all__ = ["check_start", "write_start"]


def check_start(path: Path, output: Path, *, overwrite: bool) -> None:
    """Refuse a name for the first Gaussians that cannot be had, before any work is done.

    Args:
        path: The .ply.
        output: The scene folder that is written beside it.
        overwrite: Whether a file that is there may be replaced.

    Raises:
        ParameterError: It is not named .ply.
        OutputError: It is taken, or lies in the output folder.
    """
    if path.suffix.lower() != ".ply":
        raise ParameterError("--gaussians FILE.ply", found=str(path), fix="Name a .ply file.")
    target, folder = path.resolve(), output.resolve()
    if folder == target or folder in target.parents:
        raise OutputError(
            "first Gaussians outside of the scene that is written",
            found=f"{path} in {output}, where some trainers take any .ply for the points",
            fix="Name a file beside the folder.",
        )
    if path.exists() and not overwrite:
        raise OutputError(
            f"no file at {path}", found="one", fix="Choose another name, or pass --overwrite."
        )


def write_start(path: Path, scene: Scene, method: Upsampler, progress: Progress) -> None:
    """Write the Gaussians that training from a scene's points would begin with.

    Args:
        path: The .ply.
        scene: With the seeds as its points, in whose world the Gaussians are.
        method: What made them; photographs that it held out are not looked at.
        progress: Told how far it is.

    Raises:
        SceneNotFoundError: The scene has no photographs, which say how large a Gaussian may be.
        OutputError: The file cannot be written.
    """
    images = photographed(scene, getattr(method, "hold_out", 0))
    views = read_views(scene, images, MAX_SIZE, progress)
    settings = TrainSettings(strategy="grow", seed_colors=True)
    write_gaussians(path, gaussians_of_scene(scene.points, views, settings))
