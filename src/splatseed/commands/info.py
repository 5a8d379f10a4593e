"""``splatseed info``: the contents of a scene, its problems, and what to do with it.

Notation of ``--json``: lengths are in scene units; five numbers are percentiles 5, 25, 50, 75, 95.
Promise: with ``--json`` standard output is one JSON object alone; a number that JSON does not know
is null; keys are only ever added.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from splatseed.commands.next_steps import (
    Planned,
    advice_commands,
    advice_rows,
    number_for,
    use,
)
from splatseed.commands.options import parse_options
from splatseed.console import (
    OUT,
    StageClock,
    print_note,
    print_pairs,
    print_table,
    stage_display,
)
from splatseed.depthmap import DepthKind
from splatseed.errors import ParameterError, SplatseedError
from splatseed.io import find_depths, load_scene
from splatseed.io.seeds import was_upsampled
from splatseed.io.staging import check_parents
from splatseed.literal import quoted, visible
from splatseed.progress import Progress
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
from splatseed.seeding.photographs import has_points, photographed
from splatseed.train.schedule import FULL_RUN

if TYPE_CHECKING:  # Numba, which takes a while to load, comes with it
    from splatseed.depth.alignment import Alignment
    from splatseed.seeding.poses import PoseError

KINDS_SHOWN = 3
"""Kinds of cameras listed; collections of photographs from the web have one per photograph."""
IMAGES_SHOWN = 12
"""Images whose depth is listed."""
REFINE = "--refine-poses"
"""What problems of poses name that it can mend."""


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


@dataclass(frozen=True)
class _Poses:
    """What the photographs tell of their poses.

    Args:
        agreement: Share of the pixels looked at whose depth others confirm.
        error: By how much the photographs miss each other; None if that could not be told.
        problem: Why they cannot be compared, or should not be as they are; empty if they can.
    """

    agreement: float
    error: PoseError | None
    problem: str

    @property
    def refine(self) -> bool:
        """Whether they should be refined first."""
        return REFINE in self.problem


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
        poses = _look_at_poses(scene, clock)
        doubts = [poses.problem] if poses and poses.problem else []
        problems = (*problems, *_unfit_maps(scene, alignments or {}), *doubts)
    if options.json:
        _print_json(scene, cloud, tracks, regions, poses, alignments, problems)
        return
    rows = [*_source_rows(scene), *_cloud_rows(cloud), *_track_rows(tracks), *_region_rows(regions)]
    rows += _pose_rows(poses)
    usable = scene
    if alignments and len(scene.points) and all(each.rejected for each in alignments.values()):
        usable = scene.replace(depths=None)  # nothing follows from maps that cannot be used
    rows += _advice_rows(options, usable, regions)
    print_pairs(str(options.scene), rows)
    if alignments is not None:
        _print_depth(str(options.depth or "depth"), scene, alignments)
    OUT.print("\nproblems" if problems else "\nno problems found", style="bold" if problems else "")
    for problem in problems:
        OUT.print(f"  - {problem}", soft_wrap=True)
    if options.picture is not None:
        print_pairs("picture", [("of depth", str(options.picture))])
    if len(scene.points) or scene.images:
        if missing := untrainable(scene):
            print_note(missing)
        print_pairs("next", _next_commands(options, usable, known, poses))


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


def _look_at_poses(scene: Scene, progress: Progress) -> _Poses | None:
    """Compare a few photographs of a scene without points; None with points or without any."""
    if has_points(scene) or not scene.has_photographs:
        return None
    from splatseed.seeding.poses import check_poses, pose_error  # noqa: PLC0415  (loads Numba)

    try:
        images = photographed(scene)
        agreement = check_poses(scene, images, progress)
    except SplatseedError as refused:
        return _Poses(0.0, None, f"The photographs cannot be compared: {refused}")
    error = pose_error(scene, images, progress)
    return _Poses(agreement, error, error.warning if error else "")


def _unfit_maps(scene: Scene, alignments: Mapping[str, Alignment]) -> list[str]:
    if alignments and not len(scene.points):
        unit = "only maps in the scene's unit can be used, with --depth.no-align"
        return [f"there are no points to align the depth maps with: {unit}"]
    unfit = sum(each.rejected is not None for each in alignments.values())
    maps = f"{unfit:,} of {len(alignments):,} depth maps"
    return [f"{maps} cannot be aligned with the points, and are left out"] if unfit else []


def _next_commands(
    options: Options, scene: Scene, known: int, poses: _Poses | None
) -> list[tuple[str, str]]:
    """What to do next with the scene, or what there is to choose from."""
    if scene.depths is not None and options.depth and len(scene.points) and not is_distorted(scene):
        planned = Planned.of(scene, options.budget, options.max_steps)
        number = number_for(len(scene.points), known, planned.most_seeds)
        how = f"{_reading(options)}{number}"
        return [("", use(options.scene, options.depth, how)[1])]
    advised, refine = [], poses is not None and poses.refine
    if len(scene.points) or (
        (poses is None or poses.refine or not poses.problem) and scene.has_photographs
    ):
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
    error = "unknown" if unknown else _spread_of(tracks.mean_error, tracks.error, ".3f")
    return [
        ("track length, images", _spread_of(tracks.mean_length, tracks.length, ".3g")),
        ("reprojection error, px", error),
    ]


def _spread_of(mean: float, percentiles: tuple[float, ...], style: str) -> str:
    spread = " ".join(f"{x:{style}}" for x in percentiles)
    return f"mean {mean:{style}}, 5/25/50/75/95% {spread}"


def _pose_rows(poses: _Poses | None) -> list[tuple[str, str]]:
    if poses is None or (poses.error is None and poses.problem):
        return []
    miss = "cannot be told" if poses.error is None else f"{poses.error}"
    agree = f"at {poses.agreement:.0%} of the pixels looked at"
    return [("photographs agree", agree), ("they miss by", miss)]


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
    worst = f"{regions.worst:.0%} in {regions.worst_name}"
    grid = f"(of cells, {EMPTY_CELLS} along the longer side)"
    return [("image area without points", f"{regions.mean:.0%} on average, {worst} {grid}")]


def _print_json(
    scene: Scene,
    cloud: CloudStatistics,
    tracks: TrackStatistics | None,
    regions: EmptyRegions | None,
    poses: _Poses | None,
    alignments: Mapping[str, Alignment] | None,
    problems: Sequence[str],
) -> None:
    """Print the facts that ``info`` shows."""
    train, test = scene.split()
    source = scene.source
    facts = {
        "format": source.format if source else None,
        "root": str(source.root) if source else None,
        "images": len(scene.images),
        "train_images": len(train),
        "test_images": len(test),
        "photographs": scene.has_photographs,
        "cameras": [
            {"id": c.camera_id, "model": c.model, "width": c.width, "height": c.height}
            for c in scene.intrinsics
        ],
        "depth_maps": 0 if scene.depths is None else len(scene.depths),
        "points": asdict(cloud),
        "tracks": None if tracks is None else asdict(tracks),
        "empty": None if regions is None else asdict(regions),
        "poses": None if poses is None else asdict(poses),
        "depth": None if alignments is None else {k: asdict(a) for k, a in alignments.items()},
        "problems": list(problems),
    }
    print(json.dumps(_finite(facts), indent=2, allow_nan=False), file=OUT.file)


def _finite(value: Any) -> Any:
    """The value, with null for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {str(key): _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    if isinstance(value, float) or hasattr(value, "item"):
        number = float(value)
        return number if math.isfinite(number) else None
    return value


def _print_depth(title: str, scene: Scene, alignments: Mapping[str, Alignment]) -> None:
    """Print a summary of the depth maps and a table of images, the worst first."""
    maps = f"{len(alignments):,} of {len(scene.images):,} images"
    kind: DepthKind = "z"
    known = [image.name for image in scene.images if image.name in alignments]
    if known and scene.depths is not None:
        first = scene.depths.read(known[0])
        kind = first.kind
        maps = f"{maps}, the first {first.width} x {first.height}, kind {kind}"
    if not len(scene.points):  # nothing to compare with
        print_pairs(title, [("maps", maps)])
        return
    used = [each for each in alignments.values() if each.rejected is None]
    counts = _spread((each.num_points for each in alignments.values()), ".0f")
    rows = [("maps", maps), ("left out", f"{len(alignments) - len(used):,}")]
    rows.append(("SfM points per image", counts))
    if used:
        rows.append(("scale", _spread((each.scale for each in used), ".4g")))
        if kind == "inverse":
            rows.append(("shift", _spread((each.shift for each in used), ".4g")))
        rows.append(("residual", _spread((each.residual for each in used), ".2%")))
    print_pairs(title, rows)
    ordered = sorted(alignments, key=lambda name: _badness(name, alignments[name]))
    listed = ordered[:IMAGES_SHOWN]
    header = ["image", "points", "scale", *(["shift"] if kind == "inverse" else []), "residual"]
    some = "" if len(listed) == len(ordered) else f", the {len(listed)} worst; --json has all"
    table = [_row(name, alignments[name], len(header)) for name in listed]
    print_table(f"depth against SfM points{some}", header, table)
    _print_rejections(alignments, listed)


def _spread(values: Iterable[float], style: str) -> str:
    known = np.array([value for value in values if not math.isnan(value)])
    if not known.size:
        return "unknown"
    low, median, high = np.percentile(known, [5, 50, 95])
    return f"median {median:{style}}, 5/95% {low:{style}} {high:{style}}"


def _badness(name: str, alignment: Alignment) -> tuple[bool, float, str]:
    """Sort key: images left out first, then the largest residuals."""
    residual = -math.inf if math.isnan(alignment.residual) else -alignment.residual
    return alignment.rejected is None, residual, name


def _row(name: str, alignment: Alignment, columns: int) -> list[str]:
    numbers = [_number(alignment.scale, ".4g")]
    if columns == 5:
        numbers.append(_number(alignment.shift, ".4g") if numbers != ["-"] else "-")
    return [name, f"{alignment.num_points:,}", *numbers, _number(alignment.residual, ".2%")]


def _number(value: float, style: str) -> str:
    return "-" if math.isnan(value) else f"{value:{style}}"


def _print_rejections(alignments: Mapping[str, Alignment], listed: Sequence[str]) -> None:
    rejected = [(name, alignments[name].rejected) for name in listed]
    sentences = [f"{name}: {reason}" for name, reason in rejected if reason is not None]
    if not sentences:
        return
    OUT.print("\nleft out", style="bold")
    more = sum(a.rejected is not None for a in alignments.values()) - len(sentences)
    for sentence in [*sentences, *([f"and {more:,} more"] if more else [])]:
        OUT.print(f"  - {sentence}", soft_wrap=True)
