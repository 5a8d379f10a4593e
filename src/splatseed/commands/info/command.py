"""``splatseed info``: the contents of a scene, and its problems."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from splatseed.commands.depth.next_steps import number_for, use
from splatseed.commands.info.advice import advice_commands, advice_rows
from splatseed.commands.info.as_json import print_json
from splatseed.commands.info.poses import Poses, look_at_poses
from splatseed.commands.options import parse_options
from splatseed.commands.planned import Planned
from splatseed.console import (
    OUT,
    StageClock,
    print_commands,
    print_note,
    print_pairs,
    stage_display,
)
from splatseed.depthmap import DepthKind
from splatseed.errors import ParameterError
from splatseed.io import find_depths, load_scene
from splatseed.io.seeds import was_upsampled
from splatseed.io.staging import check_parents
from splatseed.literal import quoted, visible
from splatseed.scene import Scene
from splatseed.seeding.advice import advice_for
from splatseed.seeding.diagnostics import (
    EMPTY_CELLS,
    CloudStatistics,
    EmptyRegions,
    TrackStatistics,
    cloud_statistics,
    empty_regions,
    find_problems,
    is_distorted,
    track_statistics,
    untrainable,
)
from splatseed.train.schedule import FULL_RUN

if TYPE_CHECKING:  # Numba, which takes a while to load, comes with it
    from splatseed.depth.alignment import Alignment

KINDS_SHOWN = 3
"""Kinds of cameras listed; collections of photographs from the web have one per photograph."""


@dataclass(frozen=True)
class Options:
    """Show what is in a scene: cameras, images, points, tracks, depth maps, and problems."""

    scene: Annotated[Path, tyro.conf.Positional]
    """A COLMAP scene folder, a folder with transforms.json, an RGB-D capture, or a .ply."""
    depth: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Also compare a folder of depth maps, in any layout of docs/formats.md, with the SfM
    points."""
    depth_kind: DepthKind | None = None
    """What their values are: planar depth, distance along the ray, or inverse depth; by default
    what the folder says, else z."""
    depth_scale: float | None = None
    """Stored units per unit of depth: 1000 for millimetres in a scene in metres; by default what
    the folder says."""
    picture: Path | None = None
    """Write a PNG of depth beside photographs, and of where the two disagree."""
    budget: Annotated[str | None, tyro.conf.arg(metavar="N|Xrho")] = None
    """Gaussians that you plan to end with: a number, or per pixel of a photograph; by default as
    splatseed train's. The advice depends on it."""
    max_steps: int = FULL_RUN
    """Steps that you plan to train; the advice depends on them."""
    json: bool = False
    """Print one JSON object instead, for scripts."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "info", arguments)
    with stage_display() as clock:
        clock("read", 0.0)
        scene = _read(options)
        cloud = cloud_statistics(scene, clock)
        tracks = track_statistics(scene)
        regions = empty_regions(scene, clock)
        # An empty part is reason to upsample, which was done.
        problems = find_problems(scene, cloud, None if was_upsampled(scene) else regions)
        alignments = _alignments(options, scene, clock)
        known = _known_depths(options, scene, clock)
        poses = look_at_poses(scene, clock)
        doubts = [poses.problem] if poses and poses.problem else []
        problems = (*problems, *_unfit_maps(scene, alignments or {}), *doubts)
    if options.json:
        print_json(scene, cloud, tracks, regions, poses, alignments, problems)
        return
    rows = [*_source_rows(scene), *_cloud_rows(cloud), *_track_rows(tracks), *_region_rows(regions)]
    rows += poses.rows() if poses else []
    usable = scene
    if alignments and len(scene.points) and all(each.rejected for each in alignments.values()):
        usable = scene.replace(depths=None)  # nothing follows from maps that cannot be used
    rows += _advice_rows(options, usable, regions)
    print_pairs(str(options.scene), rows)
    if alignments is not None:
        from splatseed.commands.info.depth_numbers import print_depth  # noqa: PLC0415  (loads Numba)

        print_depth(str(options.depth or "depth"), scene, alignments)
    OUT.print("\nproblems" if problems else "\nno problems found", style="bold" if problems else "")
    for problem in problems:
        OUT.print(f"  - {problem}", soft_wrap=True)
    if options.picture is not None:
        print_pairs("picture", [("of depth", str(options.picture))])
    if len(scene.points) or scene.images:
        if missing := untrainable(scene):
            print_note(missing)
        print_commands("next", _next_commands(options, usable, known, poses))


def _read(options: Options) -> Scene:
    """The scene, with the depth maps that the user names, else with its own."""
    if options.picture is not None:
        if options.picture.suffix.lower() != ".png":
            raise ParameterError(
                "a file that ends in .png, for --picture",
                found=visible(options.picture.name),
                fix=f"Try {quoted(options.picture.with_suffix('.png'))}.",
            )
        check_parents(options.picture)
    scene = load_scene(options.scene, require_points=False)
    if options.depth is not None:
        maps = find_depths(scene, options.depth, kind=options.depth_kind, scale=options.depth_scale)
        return scene.replace(depths=maps)
    if options.depth_kind is not None or options.depth_scale is not None or options.picture:
        raise ParameterError(
            "--depth DIR, which --depth-kind, --depth-scale and --picture refer to",
            found="none",
            fix="Name the folder.",
        )
    return scene


def _alignments(options: Options, scene: Scene, clock: StageClock) -> dict[str, Alignment] | None:
    """How each map fits the SfM points, drawn if requested; None if no maps were named."""
    if options.depth is None:
        return None
    from splatseed.depth.alignment import align  # noqa: PLC0415  (loads Numba)

    alignments = align(scene, progress=clock)
    if options.picture is not None:
        from splatseed.view.maps import preview_depth  # noqa: PLC0415  (loads with its use)

        clock("draw picture", 0.0)
        preview_depth(scene, alignments, options.picture)
    return alignments


def _unfit_maps(scene: Scene, alignments: Mapping[str, Alignment]) -> list[str]:
    if alignments and not len(scene.points):
        unit = "only maps in the scene's unit can be used, with --depth.no-align"
        return [f"there are no points to align the depth maps with: {unit}"]
    unfit = sum(each.rejected is not None for each in alignments.values())
    maps = f"{unfit:,} of {len(alignments):,} depth maps"
    return [f"{maps} cannot be aligned with the points, and are left out"] if unfit else []


def _next_commands(
    options: Options, scene: Scene, known: int, poses: Poses | None
) -> list[tuple[str, str]]:
    """What to do next with the scene, or what there is to choose from."""
    if scene.depths is not None and options.depth and len(scene.points) and not is_distorted(scene):
        planned = Planned.of(scene, options.budget, options.max_steps)
        number = number_for(len(scene.points), known, planned.most_seeds)
        how = f"{_reading(options)}{number}"
        return [("", use(options.scene, options.depth, how)[1])]
    advised, refine = [], poses is not None and poses.refine
    if len(scene.points) or ((poses is None or poses.usable) and scene.has_photographs):
        planned = Planned.of(scene, options.budget, options.max_steps)
        advice = advice_for(scene, planned.most_seeds, strategy=planned.strategy)
        advised = advice_commands(options.scene, scene, advice, planned, refine=refine)
    if len(scene.points):
        return advised
    images = scene.source.image_dir if scene.source else None
    photographs = "IMAGES" if images is None else quoted(images)
    points = f"splatseed sfm {photographs} --poses-from {quoted(options.scene)} -o OUT"
    points = f"{points} --refine-poses" if refine else points
    maps = _from_maps(options, scene, known)
    return [*advised, *maps, ("or points" if advised or maps else "points", points)]


def _from_maps(options: Options, scene: Scene, known: int) -> list[tuple[str, str]]:
    """The command for seeds from metric maps of a scene without points."""
    if not known or options.depth is None or is_distorted(scene):
        return []
    most = Planned.of(scene, options.budget, options.max_steps).most_seeds
    how = f"{_reading(options)}--depth.no-align {number_for(0, known, most)}"
    return [("or from the maps", use(options.scene, options.depth, how)[1])]


def _reading(options: Options) -> str:
    """The options that say how the maps are to be read."""
    kind = "" if options.depth_kind is None else f"--depth-kind {options.depth_kind} "
    return kind if options.depth_scale is None else f"{kind}--depth-scale {options.depth_scale:g} "


def _known_depths(options: Options, scene: Scene, clock: StageClock) -> int:
    """How many pixels have a depth, of all maps that the user named."""
    if options.depth is None or scene.depths is None:
        return 0
    known = 0
    for i, name in enumerate(scene.depths):
        known += int(np.count_nonzero(np.isfinite(scene.depths.read(name).values)))
        clock("count depths", (i + 1) / len(scene.depths))
    return known


def _source_rows(scene: Scene) -> list[tuple[str, str]]:
    sizes = Counter(f"{c.model} {c.width}x{c.height}" for c in scene.intrinsics)
    cameras = [f"{count:,} {kind}" for kind, count in sizes.most_common(KINDS_SHOWN)]
    if len(sizes) > KINDS_SHOWN:
        cameras.append(f"{len(sizes) - KINDS_SHOWN:,} more kinds")
    train, test = scene.split()
    by = f", by its {scene.listed.origin}" if scene.listed else ""
    images = f"{len(scene.images):,} ({len(train):,} to train, {len(test):,} to test{by})"
    maps = [] if scene.depths is None else [("depth maps", f"{len(scene.depths):,}")]
    return [
        ("format", scene.source.format if scene.source else "memory"),
        ("cameras", ", ".join(cameras) or "none"),
        ("images", images if scene.images else "none"),
        *maps,
    ]


def _cloud_rows(cloud: CloudStatistics) -> list[tuple[str, str]]:
    rows = [("points", f"{cloud.num_points:,}"), ("not finite", f"{cloud.non_finite:,}")]
    if cloud.num_points == cloud.non_finite:  # nothing to measure
        return rows if cloud.num_points else [("points", "none")]
    low, high = (" ".join(f"{x:.4g}" for x in corner) for corner in (cloud.low, cloud.high))
    spacing = " ".join(f"{x:.4g}" for x in cloud.spacing if not math.isnan(x))
    return [
        *rows,
        ("duplicates", f"{cloud.duplicates:,}"),
        ("isolated", f"{cloud.isolated:,}"),
        ("spacing 5/25/50/75/95%", spacing or "none"),
        ("bounding box", f"{low}  to  {high}"),
        ("float32 resolution", f"{cloud.resolution:.2g}"),
    ]


def _track_rows(tracks: TrackStatistics | None) -> list[tuple[str, str]]:
    if tracks is None:
        return [("tracks", "none")]
    unknown = math.isnan(tracks.mean_error)
    error = "unknown" if unknown else _spread(tracks.mean_error, tracks.error, ".3f")
    return [
        ("track length, images", _spread(tracks.mean_length, tracks.length, ".3g")),
        ("reprojection error, px", error),
    ]


def _spread(mean: float, percentiles: tuple[float, ...], style: str) -> str:
    spread = " ".join(f"{x:{style}}" for x in percentiles)
    return f"mean {mean:{style}}, 5/25/50/75/95% {spread}"


def _advice_rows(
    options: Options, scene: Scene, regions: EmptyRegions | None
) -> list[tuple[str, str]]:
    """What to do before training, and why; photographs are not looked at for it."""
    if not len(scene.points):
        return []
    planned = Planned.of(scene, options.budget, options.max_steps)
    empty = None if regions is None else regions.mean
    said = advice_for(scene, planned.most_seeds, strategy=planned.strategy, empty=empty)
    return advice_rows(said, planned)


def _region_rows(regions: EmptyRegions | None) -> list[tuple[str, str]]:
    if regions is None:
        return []
    grid = f" (of cells, {EMPTY_CELLS} along the longer side)"
    return [
        (
            "image area without points",
            f"{regions.mean:.0%} on average, {regions.worst:.0%} in {regions.worst_name}{grid}",
        )
    ]
