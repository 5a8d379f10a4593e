"""``splatseed upsample --gaussians``: initial Gaussians, for trainers that take a 3DGS .ply."""

from __future__ import annotations

from pathlib import Path

from splatseed.errors import OutputError, ParameterError
from splatseed.io.staging import check_parents
from splatseed.progress import Progress
from splatseed.scene import Scene
from splatseed.seeding.photographs import MAX_SIZE, photographed, read_views
from splatseed.splat.ply import write_gaussians
from splatseed.train.seeds import gaussians_of_scene
from splatseed.train.settings import TrainSettings
from splatseed.upsample import Upsampler


def check_start(path: Path, output: Path, *, overwrite: bool) -> None:
    """Refuse an unusable name for the initial Gaussians before any work is done.

    Args:
        path: The .ply.
        output: The scene folder that is written beside it.
        overwrite: Whether an existing file may be replaced.

    Raises:
        ParameterError: It is not named .ply.
        OutputError: It is taken, or lies in the output folder.
    """
    if path.suffix.lower() != ".ply":
        raise ParameterError("--gaussians FILE.ply", found=str(path), fix="Name a .ply file.")
    check_parents(path)
    target, folder = path.resolve(), output.resolve()
    if folder == target or folder in target.parents:
        raise OutputError(
            "a file outside the scene that is written, for the initial Gaussians",
            found=f"{path} in {output}, where some trainers read any .ply as points",
            fix="Name a file beside the folder.",
        )
    if path.exists() and not overwrite:
        raise OutputError(
            f"no file at {path}", found="one", fix="Choose another name, or pass --overwrite."
        )


def write_start(path: Path, scene: Scene, method: Upsampler, progress: Progress) -> None:
    """Write the Gaussians that training from a scene's points would start with.

    Args:
        path: The .ply.
        scene: The scene with the seeds as its points; the Gaussians are in its world.
        method: The method that made them; photographs that it held out are not used.
        progress: Told how far it is.

    Raises:
        SceneNotFoundError: The scene has no photographs, which bound the size of a Gaussian.
        OutputError: The file cannot be written.
    """
    images = photographed(scene, getattr(method, "hold_out", 0))
    views = read_views(scene, images, MAX_SIZE, progress)
    settings = TrainSettings(strategy="grow", seed_colors=True)
    write_gaussians(path, gaussians_of_scene(scene.points, views, settings))
