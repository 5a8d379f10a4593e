"""``splatseed upsample``: read a scene, add points, and write it in a layout trainers read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from splatseed.commands.options import check_free
from splatseed.commands.upsample import report
from splatseed.commands.upsample.options import CLOUD, Options, check, parse
from splatseed.console import StageClock, print_message, print_note, stage_display
from splatseed.findings import Finding
from splatseed.io import load_originals, write_scene
from splatseed.io.clouds import open_cloud
from splatseed.io.colmap_model import scene_root
from splatseed.io.exclusion import exclude
from splatseed.io.load import with_depths_in, with_own_depths
from splatseed.io.masks import with_masks
from splatseed.io.matrices import read_cloud_transform
from splatseed.io.origin import (
    RECENTER,
    find_shift,
    format_offset,
    middle_of_cameras,
    translated,
    write_offset,
)
from splatseed.io.regions import Region, parse_region
from splatseed.io.staging import add_files, check_output, write_json
from splatseed.methods import Upsampler, configure, number_of_new, planned_size, traits_of
from splatseed.photos.camera_check import stray_cameras
from splatseed.progress import Note, Progress
from splatseed.requirements import require
from splatseed.runtime.memory import format_bytes
from splatseed.scene import Scene
from splatseed.seeding import photo_methods
from splatseed.seeding.advice import DEFAULT_METHOD, method_for
from splatseed.seeding.budget import describe_rho, points_within
from splatseed.similarity import Similarity
from splatseed.splat.formats import write_gaussians
from splatseed.text import counted, visible
from splatseed.training.initialization import gaussians_of_scene
from splatseed.training.settings import TrainSettings

if TYPE_CHECKING:  # Numba comes with them
    from splatseed.seeding.clouds.align import CloudAlignment
    from splatseed.seeding.clouds.method import Cloud, GivenClouds
    from splatseed.sfm import RefinedScene

SAMPLE = 10_000
"""Points read from a file to tell whether its coordinates include the scene's offset."""
CLOSE = 0.01
"""Residual at the middle of the picture's colour scale, relative to the cloud's extent."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options, methods = parse(arguments)
    check(options)
    region = None if options.region is None else parse_region(options.region)
    planned_size(1, options.ratio, None if options.ratio is None else options.num_points)
    inputs = (options.scene, options.depth_maps, options.cloud_transform, *options.cloud_files)
    protect = [path for path in inputs if path is not None]
    protect += [scene_root(options.scene)] if options.scene.is_dir() else []
    check_output(options.output, kind="upsample", overwrite=options.overwrite, protect=protect)
    if options.gaussians is not None:
        check_free(options.gaussians, overwrite=options.overwrite, protect=protect)
    require(*["pycolmap"] * options.refine_poses)
    clouds: Any = methods[CLOUD]
    for file in options.cloud_files:
        open_cloud(file, clouds.columns)  # reads the header, so that a bad file fails first
    _upsample(options, methods, region, arguments)


def _upsample(
    options: Options, methods: dict[str, Any], region: Region | None, arguments: list[str]
) -> None:
    from splatseed.seeding.upsampling import upsample_checked

    notes: list[Finding] = []
    with stage_display() as clock:
        note = _keep_or_announce(notes, clock)
        clock("read", 0.0)
        scene = _read(options, methods[options.method])
        points_in = ""
        if options.gaussians is not None:  # photographs bound their sizes
            photo_methods.photographed(scene, without="leave out --gaussians")
        if options.refine_poses:
            given = scene.points
            scene, kept, findings = _refined(options, scene, methods[options.method], note, clock)
            points_in = report.triangulated(int(given.distinct.sum()), kept, len(scene.points))
            notes += findings
        scene = _checked_up(options, scene, methods[options.method], note, clock)
        if options.recenter:
            scene, region = _recentered(scene, region, note)
        if options.method == DEFAULT_METHOD:  # it needs photographs
            options = replace(options, method=str(method_for(scene, note=note)))
        cloud = extra_method = None
        if options.cloud_files:
            cloud = load_cloud(options, scene, methods[CLOUD], clock)
            scene, methods = cloud.scene, {**methods, CLOUD: cloud.method}
            notes += cloud.findings
            if options.method != CLOUD:
                extra_method = replace(cloud.method, alone=False)
        method, count = methods[options.method], len(scene.points)
        new = number_of_new(
            method, options.method, scene, options.ratio, options.num_points, region
        )
        total = None if new is None else count + new
        limit = None if options.budget is None else points_within(scene, options.budget)
    number = report.number_summary(total, limit, covered=options.cover_cell is not None)
    _announce(
        options, scene, points_in, methods, number, "" if cloud is None else cloud.memory_note
    )
    with stage_display(clock):
        seeds = upsample_checked(
            scene, method, num_points=total, budget=options.budget, cover=options.cover_cell,
            region=region, extra_method=extra_method, seed=options.seed, progress=clock,
            note=note,
        )  # fmt: skip
        seeded = scene.replace(points=seeds, findings=(*scene.findings, *notes))
        clock("check", 0.0)
        coverage = report.measure_coverage(scene, seeds)
        quality = report.quality_rows(options, scene, seeds, method, coverage)
        clock("write", 0.0)
        written = write_scene(
            seeded, options.output, format=options.format, overwrite=options.overwrite,
            copy_images=options.copy_images,
            provenance=report.provenance(options, scene, method, coverage),
        )  # fmt: skip
        if cloud is not None:
            cloud.write(options.output)
        _write_extras(options, scene, seeded, method, clock)
        seconds = clock.seconds()
    if options.gaussians is not None:
        where = visible(options.gaussians)
        notes.append(Finding("gaussians-written", f"The initial Gaussians are in {where}.", "info"))
    origins = report.origin_counts(seeds, options.method, written.num_points)
    report.summarise(options, scene, points_in, origins, written, seconds, quality, arguments)
    print_note(*notes)


def _keep_or_announce(notes: list[Finding], clock: StageClock) -> Note:
    """Return a ``Note`` that keeps findings for the end, but shows what long work takes at once."""
    from splatseed.seeding.dense import SECOND_COMPARISON

    def note(finding: Finding) -> None:
        (clock.announce if finding.kind == SECOND_COMPARISON else notes.append)(finding)

    return note


def _checked_up(
    options: Options, scene: Scene, method: Upsampler, note: Note, clock: StageClock
) -> Scene:
    """Leave out or move points, and photographs, that do not fit the others."""
    from splatseed.checkup.wrong_poses import without_wrong_poses
    from splatseed.seeding.upsampling import checked_points

    findings: tuple[Finding, ...] = ()
    if options.drop_wrong_poses:
        scene, findings = without_wrong_poses(scene, clock)
    scene, unfit = checked_points(scene, method, options.unfit_points, clock)
    for finding in (*findings, *unfit):
        note(finding)
    return scene


def _recentered(scene: Scene, region: Region | None, note: Note) -> tuple[Scene, Region | None]:
    before = scene.offset
    scene = translated(scene, middle_of_cameras(scene))
    shift, inside = scene.offset - before, region
    if inside is not None:
        region = lambda xyz: inside(xyz + shift)  # noqa: E731  (one expression)
    where = f"written around {format_offset(scene.offset)}, as {RECENTER} has it."
    unchanged = "around 0 already: --recenter changes nothing."
    text = f"The scene is {where if scene.offset.any() else unchanged}"
    note(Finding("recentered", text, "info"))
    return scene, region


def _refined(
    options: Options, scene: Scene, method: Upsampler, note: Note, clock: StageClock
) -> RefinedScene:
    """Return the scene at refined poses; no points of the method's test views."""
    from splatseed.seeding.clouds.point_colors import with_colors
    from splatseed.sfm import refined
    from splatseed.sfm.first_look import FIRST_LOOK, NEIGHBOURS, STAGE

    look = [STAGE, NEIGHBOURS] if len(scene.images) > FIRST_LOOK.max_exhaustive else []
    clock.expect("features", *look, "matching", "refinement", "triangulation")
    test_every = getattr(method, "test_every", 0)
    return refined(
        scene, options.seed, clock, test_every=test_every, unfit_points=options.unfit_points,
        color=partial(with_colors, test_every=test_every, note=note, progress=clock),
    )  # fmt: skip


def _write_extras(
    options: Options, scene: Scene, seeded: Scene, method: Upsampler, clock: StageClock
) -> None:
    """Write initial Gaussians and pictures, if requested, once the scene is written."""
    try:
        if options.gaussians is not None:
            _write_start(options.gaussians, seeded, method, clock)
        if options.preview:
            report.write_previews(options, scene, seeded.points, method, clock)
    except KeyboardInterrupt as stop:
        complete = f"The scene in {visible(options.output)} is complete"
        stop.add_note(f"{complete}; its pictures or initial Gaussians may be missing.")
        raise


def _read(options: Options, method: Upsampler) -> Scene:
    """Read the scene's original points, and its depth maps if the method or an option uses them."""
    needed = "points" in traits_of(method).needs and not options.refine_poses  # it makes points
    scene = exclude(load_originals(options.scene, require_points=needed), options.exclude)
    scene = with_masks(scene, options.masks)
    if options.depth_maps is not None:
        kind, scale = options.depth_kind, options.depth_scale
        return with_depths_in(scene, options.depth_maps, kind=kind, scale=scale)
    return with_own_depths(scene) if options.method == "depth" else scene


def _write_start(path: Path, scene: Scene, method: Upsampler, progress: Progress) -> None:
    """Write the Gaussians that training on the scene's points would start from.

    The test views of the method are not used.
    """
    images = photo_methods.photographed(scene, getattr(method, "test_every", 0))
    views = photo_methods.read_views(scene, images, photo_methods.MAX_SIZE, progress)
    settings = TrainSettings(strategy="grow", seed_colors=True)
    write_gaussians(path, gaussians_of_scene(scene.points, views, settings))
    write_offset(path, scene.offset)


def _announce(
    options: Options,
    scene: Scene,
    points_in: str,
    methods: Mapping[str, Upsampler],
    number: str,
    memory_note: str,
) -> None:
    """Print the plan, the scene's warnings, and the options that have no effect."""
    name, method = options.method, methods[options.method]
    unused = report.unused_maps(options, scene, method)
    print_note(*scene.findings, *stray_cameras(scene), *unused)
    if (listed := scene.listed) is not None and hasattr(method, "test_every"):
        tests = counted(len(listed.test), "test image")
        text = f"{tests} of the scene's {listed.origin} take no part in the seeds."
        print_note(Finding("test-views-left-out", text, "info"))
    for other, given in methods.items():
        changed = given != configure(other, options.profile) and not (
            other == CLOUD and options.cloud_files
        )
        if other != name and (changed or (other == "depth" and options.depth_maps is not None)):
            text = f"The options of {other} have no effect with --method {name}."
            print_note(Finding("unused-options", text))
    if options.profile == "paper" and configure(name, "paper") == configure(name):
        text = f"Profile paper changes nothing for method {name}."
        print_note(Finding("unused-options", text))
    how = ""
    if isinstance(method, photo_methods.Stereo) and not photo_methods.has_depth_hints(scene):
        points = "too few" if len(scene.points) else "no"
        maps = scene.depths if method.depth_maps else None
        where = "" if maps is None else ", around its depth maps"
        how = f": {points} points, so depth is found by comparing photographs{where}"
    points = f"{counted(len(scene.points), 'point')}{points_in}"
    size = f"{counted(len(scene.images), 'image')}, {points}"
    print_message(
        f"{visible(options.scene)} ({scene.source.format}, {size})\n"
        f"  -> {report.method_description(name, method, options.profile)}{how}\n  "
        f"-> {visible(options.output)} ({number}{describe_rho(scene, options.budget)}, "
        f"seed {options.seed}){memory_note}"
    )


class LoadedCloud(NamedTuple):
    """A scene, and the method ``cloud`` whose files are in the scene's frame."""

    scene: Scene
    method: GivenClouds
    memory_note: str = ""
    alignment: CloudAlignment | None = None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """How well the cloud is aligned, if that was computed."""
        return () if self.alignment is None else (self.alignment.finding,)

    def write(self, folder: Path) -> None:
        """Write the alignment's report and picture into the scene folder, if there is one."""
        if (found := self.alignment) is not None:
            from splatseed.viewer.clouds import preview_alignment

            add_files(folder, report.ALIGNMENT)
            written, picture = (folder / name for name in report.ALIGNMENT)
            write_json(written, found.report)
            off = found.residuals / (2 * CLOSE * found.extent)
            preview_alignment(self.scene, found.sample, found.rgb, found.tie_points, off, picture)


def load_cloud(options: Options, scene: Scene, method: Cloud, progress: Progress) -> LoadedCloud:
    """Find the transform of the clouds into the scene's frame, and configure the method with it."""
    files, memory = options.cloud_files, options.memory_bytes
    plan = method.of(*files, memory=memory).plan(scene)
    limit = f"at most {plan.capacity:,} voxels, {format_bytes(plan.memory)} of memory"
    memory_note = f"\n  -> {', '.join(visible(path) for path in files)}: {limit}"
    transform = alignment = None
    if options.cloud_transform is not None:
        transform = read_cloud_transform(options.cloud_transform, scene)
        transform = transform.then(Similarity(1.0, np.eye(3), -scene.origin))
    elif not options.align and (shift := find_shift(scene, _sample(files, method.columns))).any():
        transform = Similarity(1.0, np.eye(3), shift)
    if options.align:
        from splatseed.seeding.clouds.align import align_cloud

        alignment = align_cloud(scene, files, progress, columns=method.columns)
        transform = alignment.scene_from_cloud
    given = method.of(*files, transform=transform, memory=memory)
    return LoadedCloud(scene, given, memory_note, alignment)


def _sample(files: Sequence[Path], columns: Sequence[str]) -> Float64[np.ndarray, "N 3"]:
    """Return the finite ones among the first points of each file."""
    firsts = (next(iter(open_cloud(file, columns).chunks(SAMPLE)), None) for file in files)
    return np.concatenate([np.empty((0, 3)), *(c.xyz[c.finite] for c in firsts if c is not None)])
