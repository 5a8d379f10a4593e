"""``splatseed info``: the contents of a scene, its problems, and the next commands.

With ``--json``, lengths are in scene units, and five numbers are percentiles 5, 25, 50, 75 and 95.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from splatseed.commands import next_steps
from splatseed.commands.capture_check import CaptureCheck, PoseCheck, check_capture
from splatseed.commands.info_rows import (
    advice_rows,
    cloud_rows,
    depth_map_rows,
    photograph_rows,
    scene_facts,
    source_rows,
    track_rows,
)
from splatseed.commands.next_steps import Commands, Planned, Source, TrainerName
from splatseed.commands.options import check_free, parse_options, refuse
from splatseed.console import (
    OUT,
    StageClock,
    add_findings,
    add_results,
    print_next,
    print_note,
    print_pairs,
    print_table,
    stage_display,
    with_options,
)
from splatseed.depth.settings import DepthSettings
from splatseed.depthmap import DepthKind, DepthMaps, in_scene_units
from splatseed.findings import Finding
from splatseed.io import load_scene
from splatseed.io.exclusion import exclude
from splatseed.io.load import depths_beside, with_depths_in
from splatseed.io.seeds import was_upsampled
from splatseed.photos.camera_check import stray_cameras
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.seeding import diagnostics
from splatseed.seeding.advice import Advice, advice_for, is_distorted, untrainable
from splatseed.seeding.clouds.point_colors import missing_color_findings
from splatseed.seeding.photo_methods import photographed
from splatseed.text import quoted, visible
from splatseed.training.folder import RunFolder
from splatseed.training.request import ExcludeChoice

if TYPE_CHECKING:  # Numba, which takes a while to load, comes with it
    from splatseed.depth.alignment import Alignment

IMAGES_SHOWN = 12
"""Images whose depth is listed."""


@dataclass(frozen=True)
class Options:
    """Show what is in a scene (cameras, images, points, maps) and its problems, or in a model."""

    scene: Annotated[Path, tyro.conf.Positional]
    """A COLMAP scene folder, a folder with transforms.json, an RGB-D capture, a .ply; or a run or a
    file of trained Gaussians."""
    depth: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Also compare a folder of depth maps, in any layout of docs/formats.md, with the SfM
    points."""
    depth_kind: DepthKind | None = None
    """Values of the maps: planar depth (z), distance along the ray, or inverse depth; by default
    the folder's own statement, else z."""
    depth_scale: float | None = None
    """Stored units per unit of depth: 1000 for millimetres in a scene in metres; by default the
    folder's own statement."""
    picture: Path | None = None
    """Write a PNG of depth beside photographs, and of where the two disagree."""
    budget: Annotated[str | None, tyro.conf.arg(metavar="N|Xrho")] = None
    """Gaussians that you plan to end with: a number, or per pixel of a photograph; by default as
    splatseed train's. The advice depends on it."""
    max_steps: int | None = None
    """Steps that you plan to train, for the commands that are printed; by default as splatseed
    train's."""
    trainer: Annotated[TrainerName, tyro.conf.arg(name="for")] = "splatseed"
    """The trainer that you plan to use: the advice and the commands are for it."""
    exclude: ExcludeChoice = ()
    """Photographs to leave out: a name, a pattern such as 'IMG_00*', or a .txt file of these."""
    all_photographs: bool = False
    """Compare all photographs with the points, not 150 at most, to find single wrong poses."""


@dataclass(frozen=True)
class _Facts:
    """What is measured of a scene."""

    cloud: diagnostics.CloudStatistics
    tracks: diagnostics.TrackStatistics | None
    masks: diagnostics.MaskStatistics
    regions: diagnostics.EmptyRegions | None
    alignments: Mapping[str, Alignment] | None  # of --depth with the points
    known: int  # pixels of the maps with a depth
    maps: diagnostics.DepthMapStatistics | None
    beside: int  # depth maps beside the photographs
    check: CaptureCheck
    unusable_maps: bool  # they are in another unit, or cannot be aligned
    problems: tuple[Finding, ...]

    def verdict(self, scene: Scene) -> str:
        return with_options(self.check.verdict(scene, self.problems))

    def usable(self, scene: Scene) -> Scene:
        """Return the scene without the points and depth maps that cannot be used."""
        if self.unusable_maps:
            scene = scene.replace(depths=None)
        return scene.with_points(PointCloud.empty()) if self.check.unfit_points else scene


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "info", arguments)
    if _shows_model(options):
        return
    with stage_display() as clock:
        clock("read", 0.0)
        scene = _read(options)
        facts = _measure(options, scene, clock)
    _show(options, scene, facts)


def _measure(options: Options, scene: Scene, clock: StageClock) -> _Facts:
    cloud = diagnostics.cloud_statistics(scene, clock)
    tracks = diagnostics.track_statistics(scene)
    sample = diagnostics.read_mask_sample(scene, clock)
    masks = diagnostics.mask_statistics(scene, sample)
    regions = diagnostics.empty_regions(scene, clock, sample)
    # An empty part is reason to upsample, which was done.
    empty = None if was_upsampled(scene) else regions
    problems = [*diagnostics.find_problems(scene, cloud, empty)]
    problems += missing_color_findings(scene)
    alignments = None if options.depth is None else _alignments(options, scene, clock)
    known = _known_depths(scene.depths, clock) if options.depth and scene.depths else 0
    maps = diagnostics.depth_map_statistics(scene, clock)
    beside = len(depths_beside(scene) or ())
    check = check_capture(scene, masks.share, clock, all_photographs=options.all_photographs)
    mismatch = _unit_mismatch(scene, check.poses)
    if maps is not None and mismatch:
        maps = replace(maps, in_scene_units=False)
    unfit = bool(alignments) and all(each.rejected for each in (alignments or {}).values())
    problems += [*stray_cameras(scene), *masks.findings, *_unfit_maps(scene, alignments or {})]
    problems += [*check.findings, *mismatch]
    return _Facts(
        cloud, tracks, masks, regions, alignments, known, maps, beside, check,
        bool(mismatch) or (unfit and len(scene.points) > 0), tuple(problems),
    )  # fmt: skip


def _add_results(scene: Scene, facts: _Facts, advice: Advice, planned: Planned) -> None:
    """Add what ``--json`` prints."""
    poses, first = facts.check.poses, facts.check.first
    problems, reasons = (
        [with_options(str(each)) for each in texts]
        for texts in (facts.problems, () if first else advice.reasons)
    )
    add_results(
        **scene_facts(scene), verdict=facts.verdict(scene), checkup=facts.check.facts,
        points=facts.cloud, tracks=facts.tracks, empty=facts.regions,
        poses=poses and poses.facts, masks=facts.masks, depth_map_statistics=facts.maps,
        depth=facts.alignments, problems=problems, planned=planned.facts, reasons=reasons,
        advice=first or advice.sentence, layout=advice.measured.layout,
    )  # fmt: skip
    add_findings(*facts.problems)


def _show(options: Options, scene: Scene, facts: _Facts) -> None:
    check, usable, problems = facts.check, facts.usable(scene), facts.problems
    planned = Planned.of(usable, options.budget, options.max_steps, options.trainer)
    advice = _advice(usable, planned, facts)
    OUT.print(facts.verdict(scene), style="bold", soft_wrap=True)
    rows = [*source_rows(scene), *depth_map_rows(facts.maps, facts.beside)]
    rows += [*cloud_rows(facts.cloud), *track_rows(facts.tracks)]
    rows += [*check.rows, *photograph_rows(facts.regions, check.poses, facts.masks)]
    if len(scene.points):
        rows += [("advice", check.first)] if check.first else advice_rows(advice, planned)
    _add_results(scene, facts, advice, planned)
    print_pairs(str(options.scene), rows)
    if facts.alignments is not None:
        _print_depth(str(options.depth), scene, facts.alignments)
    _print_list("problems" if problems else "no problems found", [*map(str, problems)])
    if options.picture is not None:
        print_pairs("picture", [("of depth", str(options.picture))])
    if len(scene.points) or scene.images:
        if missing := untrainable(scene):
            print_note(missing)
        commands = _next(options, usable, advice, planned, facts.known, check.poses)
        if check.first and len(scene.points):
            commands = [
                ("once that is mended", f"splatseed info {Source(options.scene, options.exclude)}")
            ]
        print_next(commands)


def _shows_model(options: Options) -> bool:
    """Print what is in trained Gaussians; returns False for a scene."""
    scene = options.scene  # of other folders nothing is imported
    if not (scene.is_file() or RunFolder(scene).is_run or (scene / "meta.json").is_file()):
        return False
    from splatseed.commands.model_info import is_model, show_model

    if not is_model(options.scene):
        return False
    given = (options.depth, options.depth_kind, options.depth_scale, options.picture,
             options.budget, options.exclude or None)  # fmt: skip
    found = f"trained Gaussians at {visible(options.scene)}"
    expected = "a scene, for options about depth and budgets"
    fix = "Drop these options, or name the scene."
    refuse((any(each is not None for each in given), expected, found, fix))
    show_model(options.scene)
    return True


def _read(options: Options) -> Scene:
    """Read the scene, with the depth maps of ``--depth`` in place of its own."""
    about = options.depth_kind, options.depth_scale, options.picture
    refuse(
        (options.depth is None and any(each is not None for each in about),
         "--depth DIR, which --depth-kind, --depth-scale and --picture refer to", "none",
         "Name the folder."),
    )  # fmt: skip
    if options.picture is not None:
        name = options.picture.name
        fix = f"Try {quoted(f'{options.picture.stem}.png')}."
        wrong = options.picture.suffix.lower() != ".png"
        refuse((wrong, "a file that ends in .png, for --picture", visible(name), fix))
        inputs = [each for each in (options.scene, options.depth) if each is not None]
        check_free(options.picture, protect=inputs, fix="Choose another name, or remove it.")
    scene = exclude(load_scene(options.scene, require_points=False), options.exclude)
    if options.depth is None:
        return scene
    kind, scale = options.depth_kind, options.depth_scale
    return _with_kind(with_depths_in(scene, options.depth, kind=kind, scale=scale))


def _with_kind(scene: Scene) -> Scene:
    """Read depth maps as the kind that fits the points, unless it is stated."""
    from splatseed.depth.kinds import with_fitting_kind
    from splatseed.photos.visibility import find_visibility

    scene, findings = with_fitting_kind(scene, find_visibility(scene))
    return scene.replace(findings=(*scene.findings, *findings))


def _alignments(options: Options, scene: Scene, clock: StageClock) -> dict[str, Alignment]:
    """Align each map with the SfM points; draw the picture, if requested."""
    from splatseed.depth.alignment import align_maps

    alignments = align_maps(scene, progress=clock)
    if options.picture is not None:
        from splatseed.viewer.maps import preview_depth

        clock("draw picture", 0.0)
        preview_depth(scene, alignments, options.picture)
    return alignments


def _known_depths(depths: DepthMaps, clock: StageClock) -> int:
    """Count the pixels with a depth, over all maps."""
    known = 0
    for i, name in enumerate(depths):
        reliable = depths.read(name).reliable(DepthSettings.min_confidence)
        known += int(np.count_nonzero(np.isfinite(reliable.values)))
        clock("count depths", (i + 1) / len(depths))
    return known


def _unfit_maps(scene: Scene, alignments: Mapping[str, Alignment]) -> list[Finding]:
    """Report maps that cannot be aligned."""
    if alignments and not len(scene.points) and not in_scene_units(scene.depths):
        unit = "only maps in the scene's unit can be used, with --depth.no-align"
        text = f"there are no points to align the depth maps with: {unit}"
        return [Finding("no-points-to-align", text)]
    unfit = tuple(name for name, each in alignments.items() if each.rejected is not None)
    maps = f"{len(unfit):,} of {len(alignments):,} depth maps"
    text = f"{maps} cannot be aligned with the points, and are left out"
    return [Finding("unfit-depth-maps", text, subjects=unfit)] if unfit else []


def _advice(scene: Scene, planned: Planned, facts: _Facts) -> Advice:
    """Advise on the points, or on a scene without those that photographs contradict."""
    share = None if facts.regions is None else facts.regions.mean
    advice = advice_for(
        scene, planned.max_seeds, why_no_seeds=planned.strategy.why_no_seeds, empty=share
    )
    if not facts.check.unfit_points:
        return advice
    reasons = ("Photographs contradict its points, so seeds come from the photographs alone.",)
    return replace(advice, reasons=reasons)


def _unit_mismatch(scene: Scene, poses: PoseCheck | None) -> tuple[Finding, ...]:
    """Report depth maps of another unit than the poses, unless the poses cannot be checked."""
    if not in_scene_units(scene.depths) or poses is None or not poses.agreement:
        return ()
    from splatseed.depth.kinds import UNIT_MISMATCH
    from splatseed.seeding.map_seeds import unit_ratio

    ratio = unit_ratio(scene, photographed(scene))
    if ratio is None:
        return ()
    times = f"their depth is {ratio:.4g} times that of the photographs"
    text = f"the depth maps are in another unit than the poses: {times}."
    fix = "Method auto divides by it; other methods and trainers need the right unit."
    return (Finding(UNIT_MISMATCH, text, "error", fix=fix),)


def _next(
    options: Options,
    scene: Scene,
    advice: Advice,
    planned: Planned,
    known: int,
    poses: PoseCheck | None,
) -> Commands:
    """Return the next commands, or the choices if there are several."""
    any_points, refine = len(scene.points) > 0, poses is not None and poses.inexact
    sound = poses is None or not poses.doubts
    source, lifted = Source(options.scene, options.exclude), ""
    metric = in_scene_units(scene.depths) and not any_points
    if metric and not is_distorted(scene) and scene.has_photographs:
        lifted = f"splatseed upsample {source} --method depth -o OUT"
    elif options.depth is not None and scene.depths and not is_distorted(scene):
        how = "" if options.depth_kind is None else f"--depth-kind {options.depth_kind} "
        how += "" if options.depth_scale is None else f"--depth-scale {options.depth_scale:g} "
        how += "" if any_points else "--depth.no-align "
        how += next_steps.number_option(len(scene.points), known, planned.max_seeds)
        lifted = next_steps.lifting_command(source, options.depth, how)
    if any_points and lifted:
        return [("", lifted)]
    advised: Commands = []
    if any_points or (scene.has_photographs and (refine or sound)):
        advised = next_steps.advice_commands(source, scene, advice, planned, refine=refine)
    if any_points:
        return advised
    points = next_steps.triangulate_command(source, scene, "OUT")
    points = f"{points} --refine-poses" if refine else points
    maps = [("or from the maps", lifted)] if lifted and (known or metric) else []
    return [*advised, *maps, ("or points" if advised or maps else "points", points)]


def _print_depth(title: str, scene: Scene, alignments: Mapping[str, Alignment]) -> None:
    """Print a summary of the depth maps and a table of images, the worst first."""
    maps = f"{len(alignments):,} of {len(scene.images):,} images"
    columns = {"scale": ".4g", "residual": ".2%"}
    known = [image.name for image in scene.images if image.name in alignments]
    if known and scene.depths is not None:
        first = scene.depths.read(known[0])
        maps = f"{maps}, the first {first.width} x {first.height}, kind {first.kind}"
        if first.kind == "inverse":
            columns = {"scale": ".4g", "shift": ".4g", "residual": ".2%"}
    if not len(scene.points):  # nothing to compare with
        print_pairs(title, [("maps", maps)])
        return
    used = [each for each in alignments.values() if each.rejected is None]
    rows = [("maps", maps), ("left out", f"{len(alignments) - len(used):,}")]
    counts = _spread((each.num_points for each in alignments.values()), ".0f")
    rows.append(("SfM points per image", counts))
    for name, style in columns.items() if used else ():
        rows.append((name, _spread((getattr(each, name) for each in used), style)))
    print_pairs(title, rows)

    def badness(item: tuple[str, Alignment]) -> tuple[bool, float, str]:
        residual = np.nan_to_num(item[1].residual, nan=np.inf)
        return item[1].rejected is None, -float(residual), item[0]

    def cell(each: Alignment, name: str) -> str:
        value = getattr(each, name)
        unknown = math.isnan(value) or (name == "shift" and math.isnan(each.scale))
        return "-" if unknown else f"{value:{columns[name]}}"

    listed = sorted(alignments.items(), key=badness)[:IMAGES_SHOWN]
    some = "" if len(listed) == len(alignments) else f", the {len(listed)} worst; --json has all"
    print_table(
        f"depth against SfM points{some}",
        ["image", "points", *columns],
        [
            [name, f"{each.num_points:,}", *(cell(each, column) for column in columns)]
            for name, each in listed
        ],
    )
    reasons = [f"{name}: {each.rejected}" for name, each in listed if each.rejected is not None]
    if more := len(alignments) - len(used) - len(reasons):
        reasons.append(f"and {more:,} more")
    if reasons:
        _print_list("left out", reasons)


def _print_list(title: str, sentences: Sequence[str]) -> None:
    OUT.print(f"\n{title}", style="bold" if sentences else "")
    for sentence in sentences:
        OUT.print(f"  - {with_options(str(sentence))}", soft_wrap=True)


def _spread(values: Iterable[float], style: str) -> str:
    low, median, high = np.percentile(list(values), [5, 50, 95])
    return f"median {median:{style}}, 5/95% {low:{style}} {high:{style}}"
