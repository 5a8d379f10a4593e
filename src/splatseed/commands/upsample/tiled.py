"""``splatseed upsample`` of clouds larger than memory: tile by tile, in processes, on a cluster."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from splatseed.commands.options import refuse
from splatseed.commands.upsample import output
from splatseed.console import OUT, StageClock, print_note, stage_display
from splatseed.errors import OutputError, PointCloudError, SceneFormatError
from splatseed.io import WriteReport, load_originals, write_scene
from splatseed.io.clouds import open_cloud
from splatseed.io.colmap import find_model
from splatseed.io.write import PointStream
from splatseed.literal import counted, visible
from splatseed.progress import Progress
from splatseed.runtime.memory import PROCESS, free_memory, option_of, words_of
from splatseed.seeding.advice import DEFAULT_METHOD, method_for
from splatseed.upsample import BYTES_EACH, Upsampler, planned_size, source_code, traits_of

if TYPE_CHECKING:
    from splatseed.commands.upsample.command import Options
    from splatseed.upsample.tiles import Source, Tiled

CLOUDS = (".las", ".laz", ".e57", ".pcd", ".xyz", ".txt", ".csv", ".asc", ".pts", ".npz", ".glb")
"""Files of points that only ``open_cloud`` reads."""
PER_POINT, PER_NEIGHBOR = 120, 20
"""Bytes that a cloud in memory takes for each original, and for each neighbour of it."""
MEMORY = 4 << 30
"""Bytes that may be used where neither user nor system says."""
READ = 2.5
"""Bytes that a scene takes for each byte of COLMAP's files."""
IN_TILES = "linear, triangle, spline, mls, random"
"""Methods that need a point's surroundings alone, or none."""
NOT_IN_TILES = {
    "budget": "--budget", "cover_cell": "--cover", "verify": "--verify", "preview": "--preview",
    "refine_poses": "--refine-poses", "gaussians": "--gaussians", "depth_maps": "--depth",
    "cloud_files": "--cloud", "masks": "--masks",
}  # fmt: skip
"""Options that need all points in memory, by field."""


def _asks_for_tiles(options: Options) -> bool:
    """Whether the options ask for tiles, whatever the memory."""
    apart = options.executor == "ray" or (options.jobs or 1) > 1
    return apart or options.tile_points is not None


def find_source(options: Options, methods: Mapping[str, Upsampler]) -> Source | None:
    """What to cut into tiles; None if all fits into memory."""
    asked, path, method = _asks_for_tiles(options), options.scene, methods[options.method]
    if not asked and (options.cloud_files or (path.is_dir() and options.memory is None)):
        return None
    from splatseed.upsample.tiles import file_source, scene_source  # noqa: PLC0415  (Numba)

    bound, suffix = _bound(options), path.suffix.lower() if path.is_file() else ""

    def is_large(count: int) -> bool:
        return asked or (bound is not None and _needed(options, method, count) > bound)

    if suffix in CLOUDS and find_model(path.parent) is None:
        return file_source(open_cloud(path))
    if suffix == ".ply":
        file = file_source(open_cloud(path))
        return file if is_large(file.count or 0) else None
    if not asked and options.memory is None:  # a file that holds no cloud alone
        return None
    _check_model(path, bound)
    scene = load_originals(path)
    return scene_source(scene) if is_large(len(scene.points)) else None


def _bound(options: Options) -> int | None:
    """The memory that may be used; None if neither user nor system says."""
    known = (options.memory_bytes, free_memory())
    return min((each for each in known if each is not None), default=None)


def _check_model(path: Path, bound: int | None) -> None:
    """Refuse a scene whose own points and tracks do not fit into memory, before it is read."""
    places = (path / "sparse" / "0", path / "sparse", path, path / "0")
    model = find_model(*places) if path.is_dir() else None
    if model is None or bound is None:
        return
    files = [model / f"{each}{end}" for each in ("images", "points3D") for end in (".bin", ".txt")]
    needed = PROCESS + round(READ * sum(each.stat().st_size for each in files if each.is_file()))
    least = words_of(needed, up=True)
    refuse(
        (needed > bound,
         f"at least {least} of memory for the points and tracks of {path}, which are read whole",
         words_of(bound),
         f"Pass {option_of(needed)}; or name a file of its points alone, such as points3D.ply."),
    )  # fmt: skip


def _needed(options: Options, method: Upsampler, count: int) -> int:
    """Bytes that the whole cloud takes in memory."""
    from splatseed.upsample.nearest import NearestMethod  # noqa: PLC0415  (SciPy, Numba)

    # Rows may repeat others: whether the number is too small, only the distinct ones tell.
    total = planned_size(
        count, options.ratio, options.num_points and max(count, options.num_points)
    )
    neighbors = method.num_queried if isinstance(method, NearestMethod) else 16
    return PROCESS + total * BYTES_EACH + count * (PER_POINT + PER_NEIGHBOR * neighbors)


def run_tiled(options: Options, methods: Mapping[str, Upsampler], source: Source) -> None:
    """Upsample a cloud tile by tile, write it, and say so."""
    from splatseed.runtime import tasks  # noqa: PLC0415  (processes)
    from splatseed.runtime.ray_tasks import RayTasks, ray_cluster  # noqa: PLC0415  (an extra)
    from splatseed.upsample import tiles  # noqa: PLC0415  (Numba)

    if options.method == DEFAULT_METHOD:
        options = replace(options, method=str(method_for(source.scene, note=print_note)))
    method = methods[options.method]
    _check_tileable(options, method, source)
    request = tiles.Request(options.method, method, options.ratio, options.num_points, options.seed)
    path, clock, count, new = tiles.work_path(options.output), StageClock(), source.count, None
    if count is not None:
        new = planned_size(count, options.ratio, options.num_points) - count
    memory, jobs, cores = _bound(options) or MEMORY, options.jobs, tasks.cores()
    if jobs is None and options.tile_points is not None:
        jobs = 1
    away = options.executor == "ray"
    if away:  # the memory is that of each task, wherever it runs
        memory, jobs = options.memory_bytes or memory, 1
    plan = tiles.plan_tiles(
        method, count, new, memory, jobs=jobs, cores=cores,
        tile_points=options.tile_points, held=source.held,
    )  # fmt: skip
    tiles.check_disk(path, plan.disk)
    with ray_cluster(options.address) if away else nullcontext():
        workers: tasks.Tasks = tasks.HereTasks()
        if away:
            workers = RayTasks(1, jobs=options.jobs)
        elif plan.jobs > 1:
            share = tasks.slot_environment(max(1, cores // plan.jobs))
            workers = tasks.ProcessTasks([share] * plan.jobs)
        with _kept(path), tiles.open_work(path, request.job(source)) as resumed:
            points = "unknown" if count is None else f"{count:,}"
            how = output.method_words(options.method, method, options.profile)
            OUT.print(
                f"{visible(options.scene)} ({points} points)\n"
                f"  -> {how}, in {plan.words}\n"
                f"  -> {visible(options.output)} (seed {options.seed}, {workers.words})",
                soft_wrap=True,
            )
            if resumed:
                done = counted(len(list((path / "made").glob("*[0-9]"))), "tile")
                print_note(f"Resuming the work in {visible(path)}: {done} done.")
            with stage_display(clock, remaining=True):
                tiled = tiles.make_tiled(path, source, request, plan, workers, clock)
                report = _write(options, method, source, tiled, clock)
    shutil.rmtree(path)
    made = {"original": tiled.num_original, options.method: report.num_points - tiled.num_original}
    number = [("tiles", f"{tiled.tiles:,}")]
    output.summarise(
        options, source.scene, tiled.num_original, made, report, clock.seconds(), number
    )
    if any(tiled.origin):
        place = ", ".join(f"{each:,.0f}" for each in tiled.origin)
        print_note(
            f"The cloud lies far from zero, where float32 is coarse: ({place}) was subtracted from"
            " all points; subtract it from the cameras of a scene, too, before you add them to it."
            " splatseed.json has it as origin."
        )


def _check_tileable(options: Options, method: Upsampler, source: Source) -> None:
    """Refuse what needs all points in memory, before any work."""
    from splatseed.upsample.methods.bounding_box import BoundingBox  # noqa: PLC0415  (Numba)
    from splatseed.upsample.nearest import NearestMethod  # noqa: PLC0415  (Numba)

    in_memory = "leave out --memory, --jobs, --executor and --tile-points to work in memory"
    bare, looks = source.path is not None, traits_of(method).needs - {"points"}
    if bare and (options.scene.suffix.lower() in CLOUDS or looks):
        in_memory = "bring the scan to its photographs with splatseed upsample SCENE --cloud SCAN"
    elif not _asks_for_tiles(options) and options.memory is None:
        needed = words_of(_needed(options, method, source.count or 0), up=True)
        in_memory = f"use a machine with {needed} of free memory"
    given = [flag for name, flag in NOT_IN_TILES.items() if getattr(options, name)]
    read = source.scene.source.format if source.scene.source is not None else "ply"
    needs = "" if isinstance(method, BoundingBox) else ", which needs the whole scene at once"
    if isinstance(method, NearestMethod):
        reason = method.untileable_reason
        needs = f" with {reason}, which needs all points at once" if reason else ""
    refuse(
        (given, "no option that looks at all points at once while a cloud is worked on in tiles",
         ", ".join(given),
         f"Leave it out (fewer points: --ratio or --num-points), or {in_memory}."),
        (options.format == "transforms" and read != "transforms",
         "--format colmap or auto for a cloud in tiles, whose points are not turned",
         "transforms", "Leave --format out."),
        (needs,
         f"a method that works tile by tile: {IN_TILES}, or voronoi with --profile default",
         f"{options.method}{needs}",
         f"Choose one of these, or {in_memory}."),
    )  # fmt: skip


def _write(
    options: Options, method: Upsampler, source: Source, tiled: Tiled, progress: Progress
) -> WriteReport:
    """Write the scene, its points a piece at a time."""
    about = output.provenance(options, method)
    about |= {"tiles": tiled.tiles, "origin": tiled.origin}
    repeated, new = tiled.num_repeated, partial(tiled.new_distinct, progress)
    num_new, code = tiled.num_new - repeated, source_code(options.method)
    stream = PointStream(0, num_new, code, new, (), (0, repeated))
    if source.path is not None:
        about["source"] = str(source.path)
        stream = PointStream(
            tiled.num_original, num_new, code, lambda: chain(tiled.originals(progress), new()),
            (source.path,), (tiled.non_finite, tiled.repeats + repeated),
        )  # fmt: skip
    return write_scene(
        source.scene, options.output, format=options.format, overwrite=options.overwrite,
        copy_images=options.copy_images, provenance=about, stream=stream,
    )  # fmt: skip


@contextmanager
def _kept(path: Path) -> Iterator[None]:
    """Say that what is done is kept, if the block is interrupted or the disk is full.

    Of an input that is damaged or empty nothing is kept: a repaired file counts as new input.
    """
    try:
        yield
    except (PointCloudError, SceneFormatError):
        shutil.rmtree(path, ignore_errors=True)
        raise
    except KeyboardInterrupt as stop:
        stop.add_note(f"Finished tiles are kept in {path}; the same command goes on from there.")
        raise
    except OSError as error:
        raise OutputError(
            f"{path} to be written",
            found=error.strerror or type(error).__name__,
            fix="Free some space and run the same command: it goes on from the finished tiles.",
        ) from error
