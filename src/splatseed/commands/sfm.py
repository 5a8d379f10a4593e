"""``splatseed sfm``: reconstruct a scene from photographs with pycolmap."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from splatseed.commands.options import parse_options, refuse
from splatseed.console import (
    StageClock,
    add_results,
    print_message,
    print_next,
    print_note,
    print_pairs,
    stage_display,
)
from splatseed.errors import SplatseedError
from splatseed.findings import Finding
from splatseed.io import load_scene
from splatseed.io.files import is_video
from splatseed.io.masks import masks_near
from splatseed.io.staging import check_output
from splatseed.requirements import require
from splatseed.runtime.torch_device import DeviceName
from splatseed.scene import Masks, Scene
from splatseed.sfm import MatcherName, Settings, SfmReport, reconstruct
from splatseed.sfm.first_look import FIRST_LOOK, NEIGHBOURS, STAGE
from splatseed.sfm.panoramas import PanoramasName
from splatseed.sfm.photos import pick_frames
from splatseed.text import agreeing, counted, name_some, quoted, visible
from splatseed.training.request import ExcludeChoice

if TYPE_CHECKING:  # Numba, for which --help would wait, comes with it
    from splatseed.checkup.pose_accuracy import PoseErrorEstimate

SHOWN = 3
"""Images of each kind that are named where they are left out."""


@dataclass(frozen=True)
class Options:
    """Make a scene from photographs: poses and points, undistorted, ready to upsample."""

    images: Annotated[Path, tyro.conf.Positional]
    """A folder of photographs, a phone app's export, or a video, of which sharp frames at even
    distances are used. No features are detected where masks (in a folder masks beside the
    photographs) are 0."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The scene folder to write: in metres, with x east, y north and z up, if GPS in the
    photographs' EXIF determines that."""
    poses_from: Path | None = None
    """Triangulate points for the poses and intrinsics of this scene, in place of its own."""
    refine_poses: bool = False
    """Refine the poses of --poses-from first, such as those of a phone or SLAM, which are off by a
    degree or two. Its points without tracks, such as LiDAR's, stay beside the triangulated."""
    exclude: ExcludeChoice = ()
    """Photographs to leave out: a name, a pattern such as 'IMG_00*', or a .txt file of these."""
    matcher: MatcherName = "auto"
    """Match all pairs of images (exhaustive), each image with the next ones by name (sequential),
    or the pairs that a first look at few features finds to overlap (auto)."""
    frames: int = 150
    """Maximum frames from a video."""
    camera_model: str | None = None
    """COLMAP's camera model; not used with --poses-from. By default OPENCV, and SIMPLE_PINHOLE,
    which has no distortion, with fewer than 16 photographs."""
    shared_camera: bool = True
    """Photographs of the same size and EXIF lens share a camera; not used with --poses-from."""
    panoramas: PanoramasName = "auto"
    """Which photographs are equirectangular panoramas (360 degrees), each to be cut into six: those
    recognised, all or none; not used with --poses-from."""
    mask_below: float = 0.0
    """Mask panoramas within this angle of straight down, in degrees, where the photographer is."""
    device: DeviceName = "auto"
    """Device for features and matching; auto takes a GPU if pycolmap can use one."""
    seed: int = 0
    """Seed of every random choice."""
    threads: int = -1
    """Worker threads; -1 = all cores."""
    partial: bool = False
    """Write the scene even if fewer than half of the photographs get a pose."""
    resume: bool = False
    """Keep features and matches in OUTPUT_sfm after success, too, and use them in later runs with
    further photographs or other options; after a failure, the same command resumes without it."""
    overwrite: bool = False
    """Replace an output folder that splatseed wrote before."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "sfm", arguments)
    video, known = is_video(options.images), options.poses_from is not None
    poses = "the folder of photographs with poses"
    lens = [
        f"--{name.replace('_', '-')}"
        for name in ("camera_model", "shared_camera", "panoramas", "mask_below")
        if getattr(options, name) != getattr(Options, name)
    ]
    refuse(
        (options.frames < 1, "--frames of 1 or more", options.frames, "Try 150."),
        (options.frames != Options.frames and not video, "a video with --frames",
         f"the folder {visible(options.images)}", "Leave --frames out."),
        (options.refine_poses and not known, "--poses-from with --refine-poses", "none",
         "Name a scene with the poses, or leave --refine-poses out to have all poses found."),
        (known and lens, "the lens from --poses-from, without options of its own",
         ", ".join(lens), "Leave them out."),
        (known and options.partial, "--partial where poses are searched for",
         "it with --poses-from, of which all are known", "Leave it out."),
        (known and video, f"{poses} with --poses-from", "a video", f"Name {poses}."),
    )  # fmt: skip
    require("pycolmap", *["imageio_ffmpeg"] * video)
    with stage_display(remaining=True, lines=True) as clock:
        clock("prepare", 0.0)
        make = _from_video if video else _from_photographs
        report = make(options, options.images, clock)
        error = _pose_error(report, clock)
    _summarise(options, report, error)


def _from_video(options: Options, video: Path, clock: StageClock) -> SfmReport:
    """Pick frames and reconstruct from them; the scene contains those with a pose."""
    check_output(options.output, kind="sfm", overwrite=options.overwrite, protect=[video])
    with TemporaryDirectory(prefix="splatseed-frames-") as name:
        picked = pick_frames(video, Path(name), options.frames, clock)
        report = _from_photographs(options, Path(name), clock)
    text = f"{len(picked.numbers)} of the video's {picked.total:,} frames were picked; the "
    text += f"picture moves by {picked.motion:.1f} times its width."
    print_note(Finding("picked-frames", text, "info"))
    return report


def _from_photographs(options: Options, images: Path, clock: StageClock) -> SfmReport:
    video = images != options.images
    settings = Settings(options.matcher, options.device, seed=options.seed, threads=options.threads)
    masks: Masks | None = None
    poses: Scene | None = None
    capture = None if video else _posed(options.images)
    if capture is not None and capture.source.format == "phone":
        images = capture.source.image_dir or images  # an app's folder has other pictures, too
    if options.poses_from is None:
        stages = ["mapping"]
        how: dict[str, Any] = {
            "camera_model": options.camera_model,
            "shared_camera": options.shared_camera,
            "partial": options.partial,
            "panoramas": options.panoramas,
            "mask_below": options.mask_below,
        }
    else:
        stages = [*(["refinement"] if options.refine_poses else []), "triangulation"]
        poses = load_scene(options.poses_from, require_points=False)
        print_note(*(each for each in poses.findings if each.kind == "far-from-origin"))
        from splatseed.seeding.clouds.point_colors import with_colors

        color = partial(with_colors, test_every=0, note=print_note, progress=clock)
        how = {"poses_from": poses, "refine_poses": options.refine_poses, "color": color}
    if poses is not None and poses.masks is not None and poses.masks.files:
        masks = poses.masks
    elif not video:
        masks, findings = masks_near(images)
        print_note(*findings)
    return reconstruct(
        images,
        options.output,
        settings,
        masks=masks,
        resume=options.resume,
        overwrite=options.overwrite,
        on_progress=clock,
        note=print_note,
        exclude=options.exclude,
        on_photos=partial(_report_photographs, options, images, capture, clock, stages, poses),
        **how,
    )


def _posed(path: Path) -> Scene | None:
    """Return the scene of photographs with poses that is at a path already, if there is one."""
    try:
        scene = load_scene(path, require_points=False)
    except SplatseedError:
        return None  # its photographs may do
    return scene if scene.images else None


def _report_photographs(
    options: Options,
    images: Path,
    capture: Scene | None,
    clock: StageClock,
    stages: Sequence[str],
    poses: Scene | None,
    names: Sequence[str],
    left_out: Mapping[str, Sequence[str]],
    cameras: str,
) -> None:
    """Print the images that are read, since subfolders may hold images of other scenes.

    ``capture`` is the scene at ``options.images``, whose poses are not used unless asked for;
    ``poses`` has those that are.
    """
    number = len(names)
    chosen = options.matcher == "auto" and number > FIRST_LOOK.max_exhaustive
    look = [STAGE, *([NEIGHBOURS] if options.poses_from else [])] if chosen else []
    clock.expect("features", *look, "matching", *stages, "undistortion")
    clock.count(number, "photographs", "features", STAGE)
    if options.matcher != "sequential" and not chosen:
        clock.count(math.comb(number, 2), "pairs", "matching")
    if is_video(options.images):
        return
    folders = Counter(str(PurePosixPath(name).parent) for name in names)
    shown = name_some([f"{count:,} in {folder}" for folder, count in folders.most_common()])
    where = "" if set(folders) == {"."} else f": {shown}"
    print_message(visible(f"{counted(len(names), 'photograph')} in {images}{where}"))
    if cameras:
        print_message(cameras)
    skipped = [
        f"{counted(len(them), 'image')} {what} ({name_some(them, SHOWN)})"
        for what, them in left_out.items()
    ]
    known = {*names, *(name for them in left_out.values() for name in them)}
    if poses is not None and (lost := [im.name for im in poses.images if im.name not in known]):
        skipped.append(
            f"{counted(len(lost), 'pose')} without a photograph ({name_some(lost, SHOWN)})"
        )
    if skipped:
        print_note(Finding("images-left-out", f"Left out: {'; '.join(skipped)}."))
    if capture is not None and options.poses_from is None:
        scene = quoted(options.images)
        text = (
            f"{visible(options.images)} has poses of {counted(len(capture.images), 'photograph')}"
            f"{', and depth maps' if capture.depths else ''}: splatseed upsample {scene} -o OUT "
            f"uses them without SfM, splatseed info {scene} measures the error of the poses."
        )
        print_note(Finding("known-poses", text, "info"))


def _pose_error(report: SfmReport, clock: StageClock) -> PoseErrorEstimate | None:
    """Measure the poses by corners that SfM did not use: wrong ones can fit its own points."""
    from splatseed.checkup.pose_accuracy import estimate_pose_error
    from splatseed.seeding.photo_methods import photographed

    scene = load_scene(report.path, require_points=False)
    return estimate_pose_error(scene, photographed(scene), clock)


def _summarise(options: Options, report: SfmReport, error: PoseErrorEstimate | None) -> None:
    kept = f", {report.num_kept:,} of them the given scene's" if report.num_kept else ""
    rows = [
        ("pairs matched", f"{report.num_pairs:,} of {math.comb(report.total, 2):,}"),
        ("images with a pose", f"{report.registered} of {report.total}"),
        ("points", f"{report.num_points:,}{kept}"),
        ("track length", f"mean {report.mean_track_length:.2f} images"),
        ("reprojection error", f"mean {report.mean_reprojection_error:.3f} px"),
        ("pose error", "unknown" if error is None else error.verdict),
    ]
    if (change := report.refinement) is not None:
        before, after = f"{change.error_before:.3f} px", f"{change.error_after:.3f} px"
        shift, turn = f"median {change.median_shift:.3g}", f"median {change.median_turn:.2f}"
        kept = f"kept as given, at {before}: refined, they gain less than 0.1 px"
        changed = [
            ("at the given poses", f"mean {before}, refined {after}"),
            ("cameras moved", f"{shift} units, largest {change.largest_shift:.3g}"),
            ("cameras turned", f"{turn} degrees, largest {change.largest_turn:.2f}"),
        ]
        rows += [("poses", kept)] if change.kept else changed
    rows += [
        ("seconds", ", ".join(f"{stage} {time:.1f}" for stage, time in report.seconds.items())),
        ("output", str(report.path)),
    ]
    print_pairs("splatseed sfm", rows)
    facts = {key: value for key, value in asdict(report).items() if key not in {"path", "poses"}}
    add_results(output=report.path, pose_error=error, **facts)
    if 2 * report.registered < report.total:
        text = "This is a part of the scene: fewer than half of the photographs have a pose."
        print_note(Finding("partial-scene", text))
    contradicted = any(each.kind == "contradicted-poses" for each in report.findings)
    if not contradicted and error is not None and not error.exact:
        text = (
            "The photographs do not fit these poses well: look at them (splatseed view), and take "
            "more photographs, closer together, of where they are wrong."
        )
        print_note(Finding("inexact-poses", text))
    print_note(*report.findings)
    if report.unregistered:
        lost = len(report.unregistered)
        are = agreeing(lost, "has no pose and is", "have no pose and are")
        text = f"{counted(lost, 'photograph')} {are} left out: {name_some(report.unregistered)}."
        shares = agreeing(lost, "It shares", "They share")
        fix = f"{shares} too little with the others: take more photographs in between."
        print_note(Finding("unregistered-images", text, subjects=report.unregistered, fix=fix))
    print_next([("what suits it", f"splatseed info {quoted(options.output)}")])
