"""Run Structure-from-Motion: ``reconstruct``, ``undistort``.

Input is checked and output staged here; pycolmap runs in a child process (``child``).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from shutil import rmtree
from typing import TypeAlias

from splatseed import errors
from splatseed.camera import CAMERA_MODELS, Intrinsics
from splatseed.findings import Finding
from splatseed.io import write_scene
from splatseed.io.colmap_layout import write_lists, write_split
from splatseed.io.colmap_model import read_model_cameras
from splatseed.io.depth_maps import write_lenses
from splatseed.io.files import StrPath
from splatseed.io.mask_files import FOLDER as MASKS
from splatseed.io.masks import write_masks, write_transparency
from splatseed.io.origin import write_offset
from splatseed.io.photograph import photograph_folder
from splatseed.io.photograph_checks import check_sizes, with_photographs
from splatseed.io.picture import find_white
from splatseed.io.seeds import carry_seeds
from splatseed.io.staging import MANIFEST, output_folder, read_manifest, write_json
from splatseed.photos.sizes import at_file_size
from splatseed.progress import Note, Progress, silent, silent_note
from splatseed.requirements import require, version_of
from splatseed.scene import Image, Masks, Scene
from splatseed.sfm import colmap
from splatseed.sfm.cameras import (
    MIN_DISTORTION,
    MIN_FOCAL,
    SharedCamera,
    default_model,
    describe_cameras,
    held_lens,
    share_cameras,
)
from splatseed.sfm.child import WORK, call
from splatseed.sfm.colmap import ColmapRun, Settings
from splatseed.sfm.export import export_scene
from splatseed.sfm.gps import GpsFrame, GpsPosition, align_to_gps
from splatseed.sfm.mapping import map_images
from splatseed.sfm.matching import match_further, match_photographs
from splatseed.sfm.own_points import Color, add_own_points, unchanged
from splatseed.sfm.panoramas import (
    PanoramaRig,
    PanoramasName,
    check_mask_below,
    cut_finding,
    cut_photographs,
    cut_scene,
    find_panoramas,
    rigs_of,
    split_of_faces,
)
from splatseed.sfm.photos import EXCLUDED, find_photos, match_poses
from splatseed.sfm.refinement import Refinement, refine, unrefined_finding
from splatseed.sfm.work_folder import resumable_work, work_key
from splatseed.text import counted

OnPhotos: TypeAlias = Callable[[Sequence[str], Mapping[str, Sequence[str]], str], None]
_DEFAULT = Settings()


@dataclass(frozen=True)
class SfmReport:
    """Result of ``reconstruct`` or ``undistort``."""

    path: Path  # the scene folder
    registered: int  # images with a pose
    total: int  # input images
    unregistered: tuple[str, ...]  # images without a pose, sorted; not in the scene
    num_points: int
    mean_track_length: float  # observations per point
    mean_reprojection_error: float  # mean over points, undistorted px
    seconds: Mapping[str, float]  # wall time by stage, in order
    refinement: Refinement | None = None  # None without ``refine_poses``
    poses: tuple[Image, ...] = ()  # the known poses, refined with ``refine_poses``
    num_kept: int = 0  # points of the given scene that stay, which have no track
    num_pairs: int = 0  # matched pairs of photographs
    gps: GpsFrame | None = None  # the frame, if it is that of GPS positions
    findings: tuple[Finding, ...] = ()  # a lens held, poses that may be wrong or were not refined


def reconstruct(
    image_dir: StrPath,
    output: StrPath,
    settings: Settings = _DEFAULT,
    *,
    camera_model: str | None = None,
    shared_camera: bool = True,
    panoramas: PanoramasName = "auto",
    mask_below: float = 0.0,
    poses_from: Scene | None = None,
    refine_poses: bool = False,
    test_names: Collection[str] = (),
    exclude: Sequence[str] = (),
    masks: Masks | None = None,
    partial: bool = False,
    keep: bool = True,
    resume: bool = False,
    overwrite: bool = False,
    on_progress: Progress = silent,
    on_photos: OnPhotos | None = None,
    note: Note = silent_note,
    color: Color = unchanged,
) -> SfmReport:
    """Reconstruct a scene: features, matching, mapping or triangulation, undistortion.

    If EXIF has GPS positions that determine it, the frame is metric: x east, y north, z up. Else
    frame and scale are arbitrary.

    Known poses and intrinsics stay exactly as given, and only points are estimated.
    ``refine_poses`` adjusts the poses to the matches, in the given world frame and scale, but not
    the intrinsics. Photographs and poses are paired by name; those without a partner are left out.
    Lists of test images of ``poses_from`` are kept.

    Args:
        image_dir: Folder of photographs, with subfolders.
        output: The scene folder to write, with the undistorted photographs that have a pose, at
            the input's size.
        settings: Settings of features, matching and reconstruction.
        camera_model: COLMAP's camera model, if poses are not known. By default OPENCV; for few
            photographs SIMPLE_PINHOLE, and for very few with the focal length of EXIF, if there is
            one (``sfm.cameras``), as they would fit distortion to noise.
        shared_camera: One camera per lens (``share_cameras``), or one per photograph, if poses are
            not known.
        panoramas: Which photographs are equirectangular panoramas, if poses are not known: those
            recognised, ``all`` or ``none``. Each is cut into six photographs, which get one pose.
        mask_below: Angle of straight down, in degrees, within which panoramas are masked.
        poses_from: A scene with poses and intrinsics; its points are ignored, or those with tracks.
        refine_poses: Refine poses that are off by a few degrees or per cent of the cameras' extent
            (phones, SLAM). They are unchanged if refinement would lower the mean reprojection
            error by less than 0.1 px. The points of ``poses_from`` without tracks (LiDAR, a mesh)
            stay beside the triangulated ones, as by ``refined``.
        test_names: Posed photographs, by name, whose poses are refined with the others but which
            neither contribute points nor appear in the scene, such as test views.
        exclude: Photographs to leave out: names or patterns, as for ``io.exclusion.exclude``.
        masks: Masked pixels get no features; the scene gets undistorted masks.
        partial: Accept a model of fewer than half of the photographs.
        keep: On failure, keep features, matches and models in ``OUTPUT_sfm``, and resume from
            those of an earlier call (``sfm.work_folder``).
        resume: Keep them on success as well, for calls with further photographs or other options.
        overwrite: Replace ``output`` if it exists.
        on_progress: Called with the stage and the fraction done.
        on_photos: Called before work starts with the photographs' names, the names of skipped
            images by reason, and a description of the cameras (empty if poses are known).
        note: Called with findings on resumed work.
        color: Gives colours to points that stay where they lack them.

    Raises:
        InputError: Photographs missing, unreadable or of another size than their known camera;
            fewer than two with a known pose; an argument out of range; output not writable.
        ReconstructionError: No model, or fewer than half of the photographs got a pose and
            ``partial`` is False; no point could be triangulated at known poses, or refinement
            failed.
        MissingDependencyError: pycolmap is not installed, or cannot use the device.
    """
    if camera_model is not None:
        colmap.check_choice("camera_model", camera_model, tuple(CAMERA_MODELS))
    require("pycolmap")
    images = Path(image_dir).absolute()
    photos, left_out = find_photos(images, exclude)
    poses = None if poses_from is None else match_poses(photos, poses_from, images)
    whole, found = find_panoramas(images, photos, panoramas if poses is None else "none")
    check_mask_below(mask_below, whole)
    others = {name: photo for name, photo in photos.items() if name not in whole}
    cameras = share_cameras(others)
    described = describe_cameras(cameras) if cameras and poses is None and shared_camera else ""
    if not shared_camera:
        cameras = tuple(SharedCamera((name,), name, "") for name in others)
    with _staged(images, Path(output), "sfm", overwrite=overwrite) as staging:
        faces: dict[str, list[str]] = {}
        places = {name: photo.gps for name, photo in photos.items() if photo.gps is not None}
        for finding in found:
            note(finding)
        if whole:
            images, faces, masks = cut_photographs(
                *(images, whole, others, staging / WORK / "cut"),
                masks=masks,
                mask_below=mask_below,
                white=find_white([images / name for name in whole])[0],
                progress=on_progress,
            )
            photos, _ = find_photos(images)
        rigs = rigs_of(whole, faces, len(cameras) + 1)
        if on_photos is not None:
            on_photos(list(photos), left_out, described)
        if refine_poses or poses is None:
            settings = settings.for_poses(photos)
        lenses = _lenses(cameras, camera_model or default_model(len(others)), poses)
        lenses += [([*rig.camera_ids], rig.lens) for rig in rigs]
        white, _ = find_white([images / name for name in photos])
        key = work_key(
            *(photos, lenses, masks, settings.seed),
            # Features are found in copies of photographs that use fewer than 16 bits.
            features=[settings.max_image_size, settings.doubled, white],
            pairs=[settings.matcher, refine_poses, camera_model],
        )
        gps = {faces.get(name, [name])[0]: place for name, place in places.items()}
        options = camera_model, poses, refine_poses, test_names, masks, partial, gps
        work = resumable_work(Path(output), key, note, resume=resume)
        with work if keep or resume else nullcontext() as kept:
            how = (images, staging, settings, on_progress, kept, _reconstruct)
            report: SfmReport = call(*how, list(photos), cameras, rigs, *options)
        if refine_poses and poses_from is not None and poses is not None:
            source = replace(poses_from.source, image_dir=images)
            given = poses_from.replace(images=poses, source=source, masks=masks, depths=None)
            report = _with_own_points(report, given, on_progress, color)
        posed = photos.keys() - {*report.unregistered}
        names = {name: faces.get(name, [name]) for name in (*others, *whole)}
        split = split_of_faces({n: [f for f in each if f in posed] for n, each in names.items()})
        if whole and split is not None and split.train and split.test:
            write_lists(staging, sorted(split.train), sorted(split.test))
        if poses_from is not None:
            write_split(poses_from, staging)
            write_offset(staging, poses_from.offset)
        manifest = {
            **read_manifest(staging),
            "job": "reconstruct" if poses is None else "triangulate",
            "version": version_of("splatseed"),
            "settings": asdict(settings),
            "exclude": left_out.get(EXCLUDED, []),
            "report": {k: v for k, v in asdict(report).items() if k not in {"path", "poses"}},
        }
        write_json(staging / MANIFEST, manifest)
    return replace(report, path=Path(output))


def _lenses(
    cameras: Sequence[SharedCamera], camera_model: str, poses: Sequence[Image] | None
) -> list[tuple[Sequence[str], Intrinsics | str]]:
    """Return the photographs of each camera, and its intrinsics, or model name if unknown."""
    if poses is None:
        return [(camera.names, camera_model) for camera in cameras]
    lenses = {image.intrinsics.camera_id: image.intrinsics for image in poses}
    return [
        ([image.name for image in poses if image.intrinsics.camera_id == camera_id], lens)
        for camera_id, lens in lenses.items()
    ]


def _reconstruct(
    run: ColmapRun,
    staging: Path,
    names: Sequence[str],
    cameras: Sequence[SharedCamera],
    rigs: Sequence[PanoramaRig],
    camera_model: str | None,
    poses: Sequence[Image] | None,
    refine_poses: bool,
    test_names: Collection[str],
    masks: Masks | None,
    partial: bool,
    gps: Mapping[str, GpsPosition],
) -> SfmReport:
    refinement: Refinement | None = None
    frame: GpsFrame | None = None
    held: Finding | None = None
    finding: Finding | None = None
    located: Finding | None = None
    if poses is None:
        count = sum(len(camera.names) for camera in cameras)
        chosen, run = camera_model or default_model(count), replace(run, rigs=rigs)
        model = colmap.guessed_model(run, cameras, chosen)
        if camera_model is None and 0 < count < MIN_DISTORTION:
            known = all(camera.has_prior_focal_length for camera in model.cameras.values())
            run = replace(run, holds_focal=known and count < MIN_FOCAL)
            held = held_lens(count, focal=run.holds_focal)
        agreement = match_photographs(run, model, masks)
        further = None if agreement is None else lambda lost: match_further(run, agreement, lost)
        model_dir, finding = map_images(run, names, chosen, further, partial=partial)
        if gps:
            aligned = run.work / "aligned"
            model_dir, frame, located = align_to_gps(run.pycolmap, model_dir, aligned, gps)
    else:
        match_photographs(run, colmap.posed_model(run.pycolmap, poses), masks, poses)
        if refine_poses:
            poses, refinement = refine(run, poses)
            finding = unrefined_finding(len(poses), refinement.excluded)
        model_dir = colmap.triangulate_points(run, poses, test_names)
    _export(run, model_dir, staging, masks)
    return replace(
        _report(run, staging, names),
        num_pairs=run.num_pairs(),
        findings=tuple(each for each in (held, finding, located) if each is not None),
        gps=frame,
        refinement=refinement,
        poses=tuple(poses or ()),
    )


def _with_own_points(
    report: SfmReport, given: Scene, progress: Progress, color: Color
) -> SfmReport:
    """Add the points that stay of a given scene to the model that was written."""
    model_dir = report.path / "sparse" / "0"
    kept, fits = add_own_points(model_dir, given, report.poses, progress, color)
    findings, number = (*report.findings, *fits), report.num_points + kept
    return replace(report, num_points=number, num_kept=kept, findings=findings)


def _export(
    run: ColmapRun, model_dir: Path, staging: Path, masks: Masks | None, *, distinct: bool = True
) -> None:
    export_scene(run, model_dir, staging, distinct=distinct)
    before, after = (
        {image.name: image.intrinsics for image in read_model_cameras(folder)[1]}
        for folder in (model_dir, staging / "sparse" / "0")
    )
    write_lenses(staging, {name: before[name] for name in after})
    if masks is None:
        return
    lenses = {name: (before[name], pinhole) for name, pinhole in after.items()}
    write_masks(masks, run.image_dir, lenses, staging / MASKS, lenses)
    if not masks.alpha:
        write_transparency(run.image_dir, staging / "images", lenses)


def undistort(
    scene: Scene,
    output: StrPath,
    *,
    mask_below: float = 0.0,
    overwrite: bool = False,
    on_progress: Progress = silent,
) -> SfmReport:
    """Write a scene with undistorted photographs and PINHOLE cameras, in COLMAP's layout.

    Poses, points, their origin and tracks stay; 2D features are undistorted. The size of
    photographs may change slightly. Each panorama (``load_scene(..., panoramas=True)``) becomes six
    photographs, masked within the angle ``mask_below`` of straight down, in degrees.

    Raises:
        SceneNotFoundError: Fewer than half of the photographs exist.
        SceneFormatError: A name leads out of the folder, or a photograph does not fit its camera.
        OutputError: ``output`` exists or cannot be written.
        ReconstructionError: pycolmap failed.
        MissingDependencyError: pycolmap is not installed.
    """
    require("pycolmap")
    _check_names(scene)
    scene = with_photographs(scene)
    check_sizes(scene.images)
    scene = scene.replace(images=at_file_size(scene.images), intrinsics=())
    given = photograph_folder(scene)
    whole = {im.name: im.intrinsics for im in scene.images if im.intrinsics.is_panorama}
    check_mask_below(mask_below, whole)
    with _staged(given, Path(output), "undistort", overwrite=overwrite) as staging:
        scene = cut_scene(scene, staging / WORK / "cut", mask_below, on_progress)
        images = photograph_folder(scene).absolute()
        work = staging / WORK / "distorted"
        distorted = write_scene(scene, work, format="colmap", require_points=False).path
        names, how = sorted(image.name for image in scene.images), (images, staging, _DEFAULT)
        model_dir = distorted / "sparse" / "0"
        report: SfmReport = call(*how, on_progress, None, _undistort, model_dir, names, scene.masks)
        carry_seeds(scene, distorted, staging)
        write_split(scene, staging)
        write_offset(staging, scene.offset)
    findings = (cut_finding(counted(len(whole), "panorama"), whole),) if whole else ()
    return replace(report, path=Path(output), findings=findings)


def _undistort(
    run: ColmapRun, staging: Path, model_dir: Path, names: Sequence[str], masks: Masks | None
) -> SfmReport:
    _export(run, model_dir, staging, masks, distinct=False)
    return _report(run, staging, names)


@contextmanager
def _staged(images: Path, output: Path, kind: str, *, overwrite: bool) -> Iterator[Path]:
    """Yield the staging folder of the scene, with ``.work`` for temporary files on its disk."""
    with output_folder(output, kind=kind, overwrite=overwrite, protect=(images,)) as staging:
        (staging / WORK).mkdir()
        yield staging.absolute()
        rmtree(staging / WORK)


def _report(run: ColmapRun, staging: Path, names: Sequence[str]) -> SfmReport:
    model = run.pycolmap.Reconstruction(staging / "sparse" / "0")
    registered = {image.name for image in model.images.values() if image.has_pose}
    return SfmReport(
        path=staging,
        registered=len(registered),
        total=len(names),
        unregistered=tuple(name for name in names if name not in registered),
        num_points=model.num_points3D(),
        mean_track_length=float(model.compute_mean_track_length()),
        mean_reprojection_error=float(model.compute_mean_reprojection_error()),
        seconds=dict(run.seconds),
    )


def _check_names(scene: Scene) -> None:
    for name in (image.name for image in scene.images):
        path = PurePosixPath(name.replace("\\", "/"))
        if path.is_absolute() or ".." in path.parts:  # pycolmap joins it with the output folder
            raise errors.SceneFormatError(
                "photograph names inside their folder",
                found=repr(name),
                fix="Move it into the folder and rename it in the model.",
            )
