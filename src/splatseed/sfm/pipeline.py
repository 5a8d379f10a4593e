"""The two pipelines: ``reconstruct`` and ``triangulate``.

Here the input is checked and the output staged; the work is done by ``worker`` in another process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from shutil import rmtree
from typing import TypeAlias

from splatseed.io.layouts import write_split
from splatseed.io.staging import MANIFEST, output_folder, write_json
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.sfm.jobs import Outcome, ReconstructJob, TriangulateJob
from splatseed.sfm.photos import Photo, find_photos, match_poses
from splatseed.sfm.report import SfmReport
from splatseed.sfm.settings import (
    DeviceName,
    MatcherName,
    Settings,
    check_camera_model,
    check_installed,
)
from splatseed.sfm.worker import run_job

OnPhotos: TypeAlias = Callable[[Sequence[str], Mapping[str, Sequence[str]]], None]


def reconstruct(
    image_dir: Path | str,
    output: Path | str,
    *,
    matcher: MatcherName = "exhaustive",
    camera_model: str = "OPENCV",
    shared_camera: bool = True,
    device: DeviceName = "auto",
    max_image_size: int = 1600,
    seed: int = 0,
    threads: int = -1,
    overwrite: bool = False,
    verbose: bool = False,
    on_progress: Progress = silent,
    on_photos: OnPhotos | None = None,
) -> SfmReport:
    """Make a scene from photographs alone: features, matching, mapping, undistortion.

    Args:
        image_dir: The photographs, also in subfolders.
        output: The scene folder to write. Its images are those that got a pose, undistorted.
        matcher: ``exhaustive`` compares every pair of images; ``sequential`` each with its
            successors in the order of names, for a video.
        camera_model: COLMAP's model of the lens in the photographs.
        shared_camera: One lens for all photographs of a size, or one for each photograph.
        device: Where features are found and matched; mapping runs on the CPU.
        max_image_size: Longer sides are reduced to this many pixels to find features. The scene's
            images keep their size.
        seed: Seed of every random choice.
        threads: Worker threads; -1 = all cores.
        overwrite: Replace ``output`` if it exists.
        verbose: Let pycolmap's log through to the terminal.
        on_progress: Called with the stage and the fraction done.
        on_photos: Called before work begins with the photographs' names, and with those of other
            images, by what they are.

    Returns:
        What was found, and how long it took.

    Raises:
        InputError: Images missing or unreadable, an option out of range, output not writable.
        ReconstructionError: No model came out, or fewer than half of the images got a pose.
        MissingDependencyError: pycolmap is absent or cannot use ``device``.
    """
    settings = Settings(matcher, device, max_image_size, seed, threads)
    check_camera_model(camera_model)
    check_installed()
    images = Path(image_dir).absolute()
    photos, left_out = find_photos(images, at_least=2)
    with staged(images, Path(output), overwrite=overwrite) as staging:
        if on_photos is not None:
            on_photos([photo.name for photo in photos], left_out)
        job = ReconstructJob(images, staging, settings, photos, camera_model, shared_camera)
        log = staging / ".work" / "log.txt"
        outcome = run_job(job, log, verbose=verbose, on_progress=on_progress)
        report = _report(Path(output), photos, outcome)
        _write_manifest(staging, "reconstruct", settings, report)
    return report


def triangulate(
    image_dir: Path | str,
    poses_from: Scene,
    output: Path | str,
    *,
    refine_poses: bool = False,
    matcher: MatcherName = "exhaustive",
    device: DeviceName = "auto",
    max_image_size: int = 1600,
    seed: int = 0,
    threads: int = -1,
    overwrite: bool = False,
    verbose: bool = False,
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
        refine_poses: Refine poses that are off by a few degrees or per cent of the cameras' extent,
            as those of phones and SLAM are. Poses stay exactly as given where refinement would
            lower the mean reprojection error by less than 0.1 px.
        matcher: As in ``reconstruct``.
        device: As in ``reconstruct``.
        max_image_size: As in ``reconstruct``.
        seed: As in ``reconstruct``.
        threads: As in ``reconstruct``.
        overwrite: Replace ``output`` if it exists.
        verbose: Let pycolmap's log through to the terminal.
        on_progress: Called with the stage and the fraction done.
        on_photos: Called before work begins with the photographs' names, and with those of other
            images, by what they are.

    Returns:
        What was found, and how long it took.

    Raises:
        InputError: Images missing, unreadable or of another size than their camera; fewer than
            two with a pose; an option out of range; output not writable.
        ReconstructionError: No point could be triangulated, or refinement drifted: it fits fewer
            photographs or observations than the given poses do, or a camera turned by more than 10
            degrees or moved by more than half of the cameras' root mean square distance from their
            middle.
        MissingDependencyError: pycolmap is absent or cannot use ``device``.
    """
    settings = Settings(matcher, device, max_image_size, seed, threads)
    check_installed()
    images = Path(image_dir).absolute()
    photos, left_out = find_photos(images, at_least=2)
    pairs = match_poses(photos, poses_from, images)
    with staged(images, Path(output), overwrite=overwrite) as staging:
        if on_photos is not None:
            on_photos([photo.name for photo in photos], left_out)
        job = TriangulateJob(images, staging, settings, pairs, refine_poses)
        log = staging / ".work" / "log.txt"
        outcome = run_job(job, log, verbose=verbose, on_progress=on_progress)
        write_split(poses_from, staging)
        report = _report(Path(output), photos, outcome)
        _write_manifest(staging, "triangulate", settings, report)
    return report


@contextmanager
def staged(images: Path, output: Path, *, kind: str = "sfm", overwrite: bool) -> Iterator[Path]:
    """The folder to make the scene in, with ``.work`` for scratch files, on the output's disk."""
    with output_folder(output, kind=kind, overwrite=overwrite, protect=(images,)) as staging:
        work = staging / ".work"
        work.mkdir()
        yield staging.absolute()
        rmtree(work)


def _report(output: Path, photos: tuple[Photo, ...], outcome: Outcome) -> SfmReport:
    return SfmReport(
        path=output,
        registered=len(outcome.registered),
        total=len(photos),
        unregistered=tuple(p.name for p in photos if p.name not in outcome.registered),
        num_points=outcome.num_points,
        mean_track_length=outcome.mean_track_length,
        mean_reprojection_error=outcome.mean_reprojection_error,
        seconds=outcome.seconds,
        refinement=outcome.refinement,
    )


def _write_manifest(staging: Path, job: str, settings: Settings, report: SfmReport) -> None:
    """Say how the scene was made."""
    manifest = {
        "job": job,
        "version": version("splatseed"),
        "settings": asdict(settings),
        "report": {key: value for key, value in asdict(report).items() if key != "path"},
    }
    write_json(staging / MANIFEST, manifest)
