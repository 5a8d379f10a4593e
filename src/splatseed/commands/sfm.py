"""``splatseed sfm``: a scene from photographs, by pycolmap."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import tyro

from splatseed.commands.options import parse_options
from splatseed.console import (
    ERR,
    StageClock,
    print_commands,
    print_note,
    print_pairs,
    stage_display,
)
from splatseed.errors import ParameterError
from splatseed.io import load_scene
from splatseed.io.files import is_video
from splatseed.io.staging import check_output
from splatseed.literal import counted, quoted, visible
from splatseed.sfm import (
    DeviceName,
    MatcherName,
    Refinement,
    SfmReport,
    reconstruct,
    triangulate,
)
from splatseed.sfm.photos import name_some
from splatseed.sfm.video import pick_frames

NAMES_SHOWN = 5
OF_LENS = ("camera_model", "shared_camera")
"""Options for a lens that is not known yet."""


@dataclass(frozen=True)
class Options:
    """Make a scene from photographs: poses and points, undistorted, ready to upsample."""

    images: Annotated[Path, tyro.conf.Positional]
    """The folder of photographs, or a video, from which sharp, evenly spread frames are taken."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The scene folder to write."""
    poses_from: Path | None = None
    """A scene whose poses and intrinsics are kept, so that only points are triangulated."""
    refine_poses: bool = False
    """Refine the poses of --poses-from, as a phone's or SLAM's that are off by a degree or two."""
    matcher: MatcherName | None = None
    """Compare every pair of images (the default for photographs), or each with its successors (for
    a video)."""
    frames: int = 150
    """Most frames to take from a video."""
    camera_model: str = "OPENCV"
    """COLMAP's model of the lens; not used with --poses-from."""
    shared_camera: bool = True
    """One lens for all photographs of a size; not used with --poses-from."""
    device: DeviceName = "auto"
    """Where features are detected and matched; auto takes a GPU if pycolmap can use one."""
    seed: int = 0
    """Seed of every random choice."""
    threads: int = -1
    """Worker threads; -1 = all cores."""
    overwrite: bool = False
    """Replace an output folder that splatseed wrote before."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "sfm", arguments)
    _check(options)
    with stage_display(remaining=True) as clock:
        clock("prepare", 0.0)
        if is_video(options.images):
            report = _of_video(options, clock)
        else:
            report = _reconstruct(options, options.images, clock)
    _summarise(options, report)


def _check(options: Options) -> None:
    """Refuse options that would have no effect.

    Raises:
        ParameterError: There is one.
    """
    if options.frames < 1:
        raise ParameterError("--frames of 1 or more", found=f"{options.frames}", fix="Try 150.")
    if options.frames != Options.frames and not is_video(options.images):
        found = f"the folder {visible(options.images)}"
        raise ParameterError("a video with --frames", found=found, fix="Leave --frames out.")
    if options.refine_poses and options.poses_from is None:
        raise ParameterError(
            "--poses-from with --refine-poses",
            found="none",
            fix="Name a scene with the poses, or leave --refine-poses out to have all poses found.",
        )
    own = [
        f"--{name.replace('_', '-')}"
        for name in OF_LENS
        if getattr(options, name) != getattr(Options, name)
    ]
    if options.poses_from is not None and own:
        raise ParameterError(
            "the lens from --poses-from, without options of its own",
            found=", ".join(own),
            fix="Leave them out.",
        )


def _of_video(options: Options, clock: StageClock) -> SfmReport:
    """Pick frames, then treat them like photographs; the scene keeps those with a pose."""
    if options.poses_from is not None:
        fix = "Leave one out, or name the folder of the photographs that have the poses."
        raise ParameterError("a video or --poses-from", found="both", fix=fix)
    check_output(options.output, kind="sfm", overwrite=options.overwrite, protect=[options.images])
    with TemporaryDirectory(prefix="splatseed-frames-") as name:
        folder = Path(name)
        picked = pick_frames(options.images, folder, options.frames, clock)
        report = _reconstruct(options, folder, clock)
    print_note(
        f"{len(picked.numbers)} of the video's {picked.total:,} frames were picked; the "
        f"picture moves by {picked.way:.1f} times its width."
    )
    return report


def _reconstruct(options: Options, images: Path, clock: StageClock) -> SfmReport:
    solved = ["mapping"] if options.poses_from is None else ["triangulation"]
    if options.refine_poses:
        solved.insert(0, "refinement")
    clock.expect("features", "matching", *solved, "undistortion")
    common: dict[str, Any] = {
        "matcher": options.matcher or ("sequential" if is_video(options.images) else "exhaustive"),
        "device": options.device,
        "seed": options.seed,
        "threads": options.threads,
        "overwrite": options.overwrite,
        "on_progress": clock,
        "on_photos": None if images != options.images else partial(_tell_photographs, images),
    }
    if options.poses_from is None:
        return reconstruct(
            images,
            options.output,
            camera_model=options.camera_model,
            shared_camera=options.shared_camera,
            **common,
        )
    poses = load_scene(options.poses_from, require_points=False)
    return triangulate(images, poses, options.output, refine_poses=options.refine_poses, **common)


def _tell_photographs(
    images: Path, names: Sequence[str], left_out: Mapping[str, Sequence[str]]
) -> None:
    """Say what is read, since a folder named by mistake may hold pictures of other things below."""
    folders = Counter(str(PurePosixPath(name).parent) for name in names)
    shown = name_some([f"{count:,} in {folder}" for folder, count in folders.most_common()])
    where = "" if set(folders) == {"."} else f": {shown}"
    ERR.print(visible(f"{counted(len(names), 'photograph')} in {images}{where}"), soft_wrap=True)
    for what, them in left_out.items():
        print_note(f"Left out: {counted(len(them), 'image')} {what}, {name_some(them)}.")


def _of_refinement(refinement: Refinement | None) -> list[tuple[str, str]]:
    """Rows on the poses, if they were to be refined."""
    if refinement is None:
        return []
    before, after = refinement.error_before, refinement.error_after
    if refinement.kept:
        return [
            ("poses", f"kept as given, at {before:.3f} px: refined, they gain less than 0.1 px")
        ]
    return [
        ("at the given poses", f"mean {before:.3f} px, refined {after:.3f} px"),
        (
            "cameras moved",
            f"median {refinement.median_shift:.3g} units, largest {refinement.largest_shift:.3g}",
        ),
        (
            "cameras turned",
            f"median {refinement.median_turn:.2f} degrees, largest {refinement.largest_turn:.2f}",
        ),
    ]


def _summarise(options: Options, report: SfmReport) -> None:
    seconds = ", ".join(f"{stage} {time:.1f}" for stage, time in report.seconds.items())
    rows = [
        ("images with a pose", f"{report.registered} of {report.total}"),
        ("points", f"{report.num_points:,}"),
        ("track length", f"mean {report.mean_track_length:.2f} images"),
        ("reprojection error", f"mean {report.mean_reprojection_error:.3f} px"),
        *_of_refinement(report.refinement),
        ("seconds", seconds),
        ("output", str(report.path)),
    ]
    print_pairs("splatseed sfm", rows)
    if report.unregistered:
        shown = ", ".join(report.unregistered[:NAMES_SHOWN])
        more = len(report.unregistered) - NAMES_SHOWN
        print_note(f"without a pose: {shown}" + (f" and {more} more" if more > 0 else ""))
    command = f"splatseed upsample {quoted(options.output)} -o OUT --preview"
    print_commands("next", [("", command)])
