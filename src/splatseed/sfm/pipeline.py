"""Scenes by Structure-from-Motion: ``reconstruct``, ``triangulate``, ``undistort``, ``refined``.

Here the input is checked and the output staged; the work is done by ``worker`` in another process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from shutil import rmtree
from tempfile import TemporaryDirectory
from typing import TypeAlias

from splatseed.camera import CAMERA_MODELS
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import load_scene, write_scene
from splatseed.io.layouts import write_split
from splatseed.io.seeds import carry_seeds
from splatseed.io.staging import MANIFEST, output_folder, write_json
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.sfm.features import Settings, check_choice, check_installed
from splatseed.sfm.photos import find_photos, match_poses
from splatseed.sfm.worker import (
    SfmReport,
    reconstruct_job,
    run_job,
    triangulate_job,
    undistort_job,
)

OnPhotos: TypeAlias = Callable[[Sequence[str], Mapping[str, Sequence[str]]], None]
_DEFAULT = Settings()


def reconstruct(
    image_dir: Path | str,
    output: Path | str,
    settings: Settings = _DEFAULT,
    *,
    camera_model: str = "OPENCV",
    shared_camera: bool = True,
    overwrite: bool = False,
    on_progress: Progress = silent,
    on_photos: OnPhotos | None = None,
) -> SfmReport:
    """Make a scene from photographs alone: features, matching, mapping, undistortion.

    Args:
        image_dir: The photographs, also in subfolders.
        output: The scene folder to write. Its images are those that got a pose, undistorted, at the
            photographs' size.
        settings: How features are detected and matched.
        camera_model: COLMAP's model of the lens in the photographs.
        shared_camera: One lens for all photographs of a size, or one for each photograph.
        overwrite: Replace ``output`` if it exists.
        on_progress: Called with the stage and the fraction done.
        on_photos: Called before work begins with the photographs' names, and with those of other
            images, by what they are.

    Returns:
        What was found, and how long it took.

    Raises:
        InputError: Images missing or unreadable, an option out of range, output not writable.
        ReconstructionError: No model came out, or fewer than half of the images got a pose.
        MissingDependencyError: pycolmap is absent or cannot use the device.
    """
    check_choice("camera_model", camera_model, tuple(CAMERA_MODELS))
    check_installed()
    images = Path(image_dir).absolute()
    photos, left_out = find_photos(images)
    with _staged(images, Path(output), "sfm", overwrite=overwrite) as staging:
        if on_photos is not None:
            on_photos([photo.name for photo in photos], left_out)
        report = run_job(
            *(reconstruct_job, images, staging, settings, photos, camera_model, shared_camera),
            on_progress=on_progress,
        )
        report = replace(report, path=Path(output))
        _write_manifest(staging, "reconstruct", settings, report)
    return report


def triangulate(
    image_dir: Path | str,
    poses_from: Scene,
    output: Path | str,
    settings: Settings = _DEFAULT,
    *,
    refine_poses: bool = False,
    overwrite: bool = False,
    on_progress: Progress = silent,
    on_photos: OnPhotos | None = None,
) -> SfmReport:
    """Make a scene from photographs whose poses are known: features, matching, triangulation.

    Poses and intrinsics stay exactly as given; only points are estimated. With ``refine_poses``
    the poses move to where the photographs' matches agree, in the given world frame and scale, and
    intrinsics stay. Photographs and poses are paired by name. Images without a pose are left out,
    as are poses without an image. A scene that says which images test keeps its lists.

    Args:
        image_dir: The photographs, also in subfolders.
        poses_from: A scene whose ``images`` give poses and intrinsics; its points are not used.
        output: The scene folder to write.
        settings: How features are detected and matched.
        refine_poses: Refine poses that are off by a few degrees or per cent of the cameras' extent,
            as those of phones and SLAM are. Poses stay exactly as given where refinement would
            lower the mean reprojection error by less than 0.1 px.
        overwrite: As in ``reconstruct``.
        on_progress: As in ``reconstruct``.
        on_photos: As in ``reconstruct``.

    Returns:
        What was found, and how long it took.

    Raises:
        InputError: Images missing, unreadable or of another size than their camera; fewer than
            two with a pose; output not writable.
        ReconstructionError: No point could be triangulated, or refinement drifted: it fits fewer
            photographs or observations than the given poses do, or a camera turned by more than 10
            degrees or moved by more than half of the cameras' root mean square distance from their
            middle.
        MissingDependencyError: pycolmap is absent or cannot use the device.
    """
    check_installed()
    images = Path(image_dir).absolute()
    photos, left_out = find_photos(images)
    pairs = match_poses(photos, poses_from, images)
    with _staged(images, Path(output), "sfm", overwrite=overwrite) as staging:
        if on_photos is not None:
            on_photos([photo.name for photo in photos], left_out)
        report = run_job(
            *(triangulate_job, images, staging, settings, photos, pairs, refine_poses),
            on_progress=on_progress,
        )
        report = replace(report, path=Path(output))
        write_split(poses_from, staging)
        _write_manifest(staging, "triangulate", settings, report)
    return report


def undistort(
    scene: Scene,
    output: Path | str,
    *,
    overwrite: bool = False,
    on_progress: Progress = silent,
) -> SfmReport:
    """Write a scene with undistorted photographs and PINHOLE cameras.

    Poses, points, their origins and tracks stay; features move with the pixels. The size of
    photographs changes a little.

    Args:
        scene: A scene with all its photographs.
        output: The scene folder to write, in COLMAP's layout.
        overwrite: Whether an earlier output of this function may be replaced.
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
    images = _all_photographs(scene)
    with _staged(images, Path(output), "undistort", overwrite=overwrite) as staging:
        work = staging / ".work" / "distorted"
        distorted = write_scene(scene, work, format="colmap", require_points=False).path
        names = sorted(image.name for image in scene.images)
        report = run_job(
            *(undistort_job, images, staging, _DEFAULT, distorted / "sparse" / "0", names),
            on_progress=on_progress,
        )
        carry_seeds(scene, distorted, staging)
        write_split(scene, staging)
    return replace(report, path=Path(output))


def refined(scene: Scene, seed: int, progress: Progress = silent) -> tuple[Scene, str]:
    """The scene at refined poses, with the points that its photographs' features give.

    Its photographs, lenses and depth maps stay; its own points are replaced.

    Args:
        scene: A scene with photographs.
        seed: Seed of every random choice.
        progress: Called with the stage and the fraction done.

    Returns:
        The scene, and what was done in a sentence.

    Raises:
        SceneNotFoundError: It has no photographs.
        ReconstructionError: The poses drifted, or no point could be triangulated.
        MissingDependencyError: pycolmap is absent.
    """
    folder = scene.source.image_dir if scene.source else None
    if folder is None:
        raise SceneNotFoundError(
            "photographs, at whose features --refine-poses looks",
            found="no folder with images",
            fix="Put them beside the model in a folder named images, or leave it out.",
        )
    with TemporaryDirectory(prefix="splatseed-refine-") as name:
        report = triangulate(
            *(folder, scene, Path(name) / "scene", Settings(seed=seed)),
            refine_poses=True,
            on_progress=progress,
        )
        found = load_scene(report.path)
    change, points = report.refinement, f"{report.num_points:,} points were triangulated"
    assert change is not None  # noqa: S101  (it was asked for)
    if change.kept:
        how = f"Poses are as given: refined, they would gain less than 0.1 px. {points}."
    else:
        how = (
            f"Refined poses lower the mean reprojection error from {change.error_before:.2f} to "
            f"{change.error_after:.2f} px: cameras turned by {change.median_turn:.2f} degrees "
            f"and moved by {change.median_shift:.3g} units, both the median; {points}."
        )
    return with_refined(scene, found), how


def with_refined(scene: Scene, found: Scene) -> Scene:
    """The scene with the poses and the points of another of the same photographs.

    Args:
        scene: Images that the other scene lacks keep their poses.
        found: Its points count as originals without tracks.
    """
    posed = {image.name: image for image in found.images}
    images = []
    for image in scene.images:
        pose = posed.get(image.name, image)
        images.append(replace(image, quat=pose.quat, translation=pose.translation))
    points = PointCloud(found.points.xyz, found.points.rgb)
    return scene.replace(images=tuple(images), points=points, tracks=None)


@contextmanager
def _staged(images: Path, output: Path, kind: str, *, overwrite: bool) -> Iterator[Path]:
    """The folder to make the scene in, with ``.work`` for scratch files, on the output's disk."""
    with output_folder(output, kind=kind, overwrite=overwrite, protect=(images,)) as staging:
        work = staging / ".work"
        work.mkdir()
        yield staging.absolute()
        rmtree(work)


def _write_manifest(staging: Path, job: str, settings: Settings, report: SfmReport) -> None:
    """Say how the scene was made."""
    manifest = {
        "job": job,
        "version": version("splatseed"),
        "settings": asdict(settings),
        "report": {key: value for key, value in asdict(report).items() if key != "path"},
    }
    write_json(staging / MANIFEST, manifest)


def _all_photographs(scene: Scene) -> Path:
    """The folder of a scene's photographs, all of which are there."""
    if not scene.images:
        raise SceneNotFoundError(
            "a scene with the poses of its photographs",
            found="none",
            fix="Copy the whole model, images.bin too, or make one: splatseed sfm IMAGES -o SCENE.",
        )
    names = [image.name for image in scene.images]
    for name in names:  # pycolmap writes to the output's folder joined with each
        path = PurePosixPath(name.replace("\\", "/"))
        if path.is_absolute() or ".." in path.parts:
            raise SceneFormatError(
                "photographs whose names stay inside their folder, as copies get the same names",
                found=repr(name),
                fix="Move it into the folder and rename it in the model.",
            )
    folder = scene.source.image_dir if scene.source else None
    there = "no folder of images"
    if folder is not None:
        missing = next((name for name in names if not (folder / name).is_file()), None)
        if missing is None:
            return folder.absolute()
        there = f"{missing} missing in {folder}"
    raise SceneNotFoundError(
        "a scene with all of its photographs",
        found=there,
        fix="Put them beside the model in a folder named images.",
    )
