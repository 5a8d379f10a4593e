"""``undistort``: turns a scene with lens distortion into one with pinhole cameras."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import write_scene
from splatseed.io.layouts import write_split
from splatseed.io.seeds import carry_seeds
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.sfm.jobs import Outcome, UndistortJob
from splatseed.sfm.pipeline import staged
from splatseed.sfm.settings import Settings, check_installed
from splatseed.sfm.worker import run_job


def undistort(
    scene: Scene,
    output: Path | str,
    *,
    threads: int = -1,
    overwrite: bool = False,
    verbose: bool = False,
    on_progress: Progress = silent,
) -> Outcome:
    """Write a scene with undistorted photographs and PINHOLE cameras.

    Poses, points, their origins and tracks stay; features move with the pixels. The size of
    photographs changes a little.

    Args:
        scene: A scene with all its photographs.
        output: The scene folder to write, in COLMAP's layout.
        threads: Worker threads; -1 = all cores.
        overwrite: Whether an earlier output of this function may be replaced.
        verbose: Let pycolmap's log through to the terminal.
        on_progress: Called with the stage and the fraction done.

    Returns:
        What the new scene holds.

    Raises:
        SceneNotFoundError: The scene has no photographs, or one is missing.
        SceneFormatError: The name of one leads out of their folder.
        OutputError: ``output`` is taken or cannot be written.
        ReconstructionError: pycolmap failed.
        MissingDependencyError: pycolmap is absent.
    """
    check_installed()
    images = _photographs(scene)
    with staged(images, Path(output), kind="undistort", overwrite=overwrite) as staging:
        work = staging / ".work" / "distorted"
        distorted = write_scene(scene, work, format="colmap", require_points=False).path
        settings = Settings("exhaustive", "cpu", 1600, 0, threads)  # only threads matters
        job = UndistortJob(images, staging, settings, distorted / "sparse" / "0")
        log = staging / ".work" / "log.txt"
        outcome = run_job(job, log, verbose=verbose, on_progress=on_progress)
        carry_seeds(scene, distorted, staging)
        write_split(scene, staging)
    return outcome


def _photographs(scene: Scene) -> Path:
    if not scene.images:
        raise SceneNotFoundError(
            "a scene with the poses of its photographs",
            found="none",
            fix="Copy the whole model, images.bin too, or make one: splatseed sfm IMAGES -o SCENE.",
        )
    _check_names(scene)
    folder = scene.source.image_dir if scene.source else None
    there = "no folder of images"
    if folder is not None:
        missing = next((im.name for im in scene.images if not (folder / im.name).is_file()), "")
        if not missing:
            return folder.absolute()
        there = f"{missing} missing in {folder}"
    raise SceneNotFoundError(
        "a scene with all of its photographs",
        found=there,
        fix="Put them beside the model in a folder named images.",
    )


def _check_names(scene: Scene) -> None:
    """Refuse names that lead out: pycolmap writes to the output's folder joined with each."""
    paths = ((image.name, PurePosixPath(image.name.replace("\\", "/"))) for image in scene.images)
    outside = next((name for name, path in paths if path.is_absolute() or ".." in path.parts), None)
    if outside is not None:
        raise SceneFormatError(
            "photographs whose names stay inside their folder, as copies get the same names",
            found=repr(outside),
            fix="Move it into the folder and rename it in the model.",
        )
