"""``splatseed upsample`` of clouds larger than memory: tile by tile, in processes, on a cluster."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from splatseed.commands.next_steps import tell_training
from splatseed.commands.upsample.output import method_words
from splatseed.console import (
    OUT,
    StageClock,
    print_note,
    print_pairs,
    stage_display,
)
from splatseed.errors import OutputError, ParameterError, PointCloudError, SceneFormatError
from splatseed.io import WriteReport, load_originals, load_scene, write_scene
from splatseed.io.clouds import open_cloud
from splatseed.io.colmap.scene import find_model
from splatseed.io.write import PointStream
from splatseed.literal import counted, visible
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress
from splatseed.runtime.memory import free_memory, option_of, words_of
from splatseed.scene import Scene
from splatseed.seeding.advice import DEFAULT_METHOD, method_for
from splatseed.upsample import BYTES_EACH, Upsampler, planned_size, traits_of
from splatseed.upsample.registry import source_code

if TYPE_CHECKING:
    from splatseed.commands.upsample.command import Options
    from splatseed.runtime.tasks import Tasks
    from splatseed.tiles import Source, Tiled

CLOUDS = (".las", ".laz", ".e57", ".pcd", ".xyz", ".csv", ".asc", ".pts", ".npz", ".glb")
"""Files of points that only ``open_cloud`` reads."""
PROCESS, PER_POINT, PER_NEIGHBOR = 300 << 20, 120, 20
"""Bytes that the process takes, a cloud in memory for each original, and for each neighbour."""
MEMORY = 4 << 30
"""Bytes that may be used where neither user nor system says."""
READ = 2.5
"""Bytes that a scene takes for each byte of COLMAP's files."""
NOT_IN_TILES = {
    "budget": "--budget",
    "cover_cell": "--cover",
    "verify": "--verify",
    "refine_poses": "--refine-poses",
    "preview": "--preview",
    "gaussians": "--gaussians",
    "depth_maps": "--depth",
    "cloud_files": "--cloud",
}
"""Options that need all points in memory, by field."""


@dataclass(frozen=True)
class Tiling:
    """Memory and executor options.

    Args:
        memory: Most bytes of memory, if the user says so.
        jobs: Tiles at a time; None for as many as cores and memory allow, on a cluster as fit.
        executor: Where tiles run.
        address: The cluster's address.
        tile_points: Most points in a tile, if the user says so.
    """

    memory: int | None
    jobs: int | None
    executor: Literal["local", "ray"]
    address: str | None
    tile_points: int | None

    @property
    def asked(self) -> tuple[str, ...]:
        """The options that ask for tiles, whatever the memory."""
        asks = {
            "--executor": self.executor == "ray",
            "--jobs": (self.jobs or 1) > 1,
            "--tile-points": self.tile_points is not None,
        }
        return tuple(name for name, asked in asks.items() if asked)

    @property
    def bound(self) -> int | None:
        """The memory that may be used; None if neither user nor system says."""
        known = [each for each in (self.memory, free_memory()) if each is not None]
        return min(known, default=None)


def find_source(options: Options, methods: Mapping[str, Upsampler]) -> Source | None:
    """What to cut into tiles; None if all fits into memory.

    Raises:
        SceneNotFoundError: There is no scene.
        SceneFormatError: It is not what its name says.
        OutputError: It has attributes that tiles do not.
    """
    tiling, path = options.tiling, options.scene
    if not tiling.asked and (options.cloud_files or (path.is_dir() and tiling.memory is None)):
        return None
    from splatseed.tiles import FileSource, SceneSource  # noqa: PLC0415  (Numba)

    if path.is_file() and path.suffix.lower() in CLOUDS and find_model(path.parent) is None:
        return FileSource(open_cloud(path))
    method = methods[options.method]
    if path.is_file() and path.suffix.lower() == ".ply":
        file = FileSource(open_cloud(path))
        return file if tiling.asked or _is_large(options, method, file.count or 0) else None
    if not tiling.asked and tiling.memory is None:  # a file that holds no cloud alone
        return None
    _check_model(path, tiling.bound)
    scene = load_originals(path)
    if tiling.asked or _is_large(options, method, len(scene.points)):
        return SceneSource(scene)
    return None


def _check_model(path: Path, bound: int | None) -> None:
    """Refuse a scene whose own points and tracks do not fit into memory, before it is read.

    Raises:
        ParameterError: They do not.
    """
    places = (path / "sparse" / "0", path / "sparse", path, path / "0")
    model = find_model(*places) if path.is_dir() else None
    names = [f"{each}{end}" for each in ("images", "points3D") for end in (".bin", ".txt")]
    files = [] if model is None else [model / name for name in names]
    needed = PROCESS + round(READ * sum(each.stat().st_size for each in files if each.is_file()))
    if model is None or bound is None or needed <= bound:
        return
    raise ParameterError(
        f"at least {words_of(needed, up=True)} of memory for the points and tracks of {path}, which"
        " are read whole",
        found=words_of(bound),
        fix=f"Pass {option_of(needed)}; or name a file of its points alone, such as points3D.ply.",
    )


def _is_large(options: Options, method: Upsampler, count: int) -> bool:
    """Whether the whole cloud takes more memory than it may."""
    bound = options.tiling.bound
    return bound is not None and _needed(options, method, count) > bound


def _needed(options: Options, method: Upsampler, count: int) -> int:
    """Bytes that the whole cloud takes in memory."""
    from splatseed.upsample.nearest import NearestMethod  # noqa: PLC0415  (SciPy, Numba)

    total = planned_size(count, options.ratio, options.num_points)
    neighbors = method.num_queried if isinstance(method, NearestMethod) else 16
    return PROCESS + total * BYTES_EACH + count * (PER_POINT + PER_NEIGHBOR * neighbors)


def run_tiled(
    options: Options,
    methods: Mapping[str, Upsampler],
    source: Source,
    provenance: Callable[[Options, Upsampler], dict[str, object]],
) -> None:
    """Upsample a cloud tile by tile, write it, and say so.

    Args:
        options: The command's options.
        methods: All methods with their parameters.
        source: The cloud.
        provenance: What ``splatseed.json`` is to say, from the options and the method.

    Raises:
        ParameterError: An option or the method needs all points in memory, or the memory is not
            enough for tiles.
        OutputError: The disk is too small, or an earlier run's folder belongs to another command.
    """
    from splatseed import tiles  # noqa: PLC0415  (Numba)

    scene = source.scene if isinstance(source, tiles.SceneSource) else None
    if options.method == DEFAULT_METHOD:
        options = replace(
            options, method=str(method_for(scene or PointCloud.empty(), note=print_note))
        )
    method = methods[options.method]
    _check_tileable(options, method, scene, source.count)
    request = tiles.Request(options.method, method, options.ratio, options.num_points, options.seed)
    points = "unknown" if source.count is None else f"{source.count:,}"
    path, clock, tiling = tiles.work_path(options.output), StageClock(), options.tiling
    count, new = source.count, None
    if count is not None:
        new = planned_size(count, options.ratio, options.num_points) - count
    memory = tiling.bound or MEMORY
    choose = partial(tiles.choose_jobs, method, count, new, memory, held=source.held)
    with _tasks(options, choose) as tasks:
        if tiling.executor == "ray" and tiling.memory is not None:
            memory = tiling.memory  # of each task, wherever it runs
        plan = tiles.plan_tiles(
            method, count, new, memory, processes=tasks.processes,
            tile_points=tiling.tile_points, held=source.held,
        )  # fmt: skip
        tiles.check_disk(path, plan.disk)
        with _kept(path), tiles.open_work(path, request.job(source)) as resumed:
            OUT.print(
                f"{visible(options.scene)} ({points} points)\n"
                f"  -> {method_words(options.method, method, options.profile)}, in {plan.words}\n"
                f"  -> {visible(options.output)} (seed {options.seed}, {tasks.words})",
                soft_wrap=True,
            )
            if resumed:
                done = counted(len(list((path / "made").glob("*[0-9]"))), "tile")
                print_note(f"Going on with the work in {visible(path)}: {done} done.")
            with stage_display(clock, remaining=True):
                tiled = tiles.make_tiled(path, source, request, plan, tasks, clock)
                report = _write(options, source, tiled, clock, provenance(options, method))
    shutil.rmtree(path)
    _summarise(options, tiled, report, clock.seconds())


def _check_tileable(
    options: Options, method: Upsampler, scene: Scene | None, count: int | None
) -> None:
    """Refuse what needs all points in memory, before any work."""
    from splatseed.tiles import check_tileable  # noqa: PLC0415  (Numba)

    in_memory = "leave out --memory, --jobs, --executor and --tile-points to work in memory"
    if scene is None and (options.scene.suffix.lower() in CLOUDS or _looks(method)):
        in_memory = "bring the scan to its photographs with splatseed upsample SCENE --cloud SCAN"
    elif not options.tiling.asked and options.tiling.memory is None:
        needed = words_of(_needed(options, method, count or 0), up=True)
        in_memory = f"use a machine with {needed} of free memory"
    if given := [flag for name, flag in NOT_IN_TILES.items() if getattr(options, name)]:
        raise ParameterError(
            "no option that looks at all points at once while a cloud is worked on in tiles",
            found=", ".join(given),
            fix=f"Leave it out (fewer points: --ratio or --num-points), or {in_memory}.",
        )
    read = scene.source.format if scene is not None and scene.source is not None else "ply"
    if options.format == "transforms" and read != "transforms":
        raise ParameterError(
            "--format colmap or auto for a cloud in tiles, whose points are not turned",
            found="transforms",
            fix="Leave --format out.",
        )
    check_tileable(options.method, method, in_memory)


def _looks(method: Upsampler) -> bool:
    """Whether a method needs more than points."""
    return bool(traits_of(method).needs - {"points"})


@contextmanager
def _tasks(options: Options, choose: Callable[..., int]) -> Iterator[Tasks]:
    """Where tiles are worked on, while the block runs."""
    from splatseed.runtime import tasks  # noqa: PLC0415  (processes)
    from splatseed.runtime.ray_tasks import RayTasks, ray_cluster  # noqa: PLC0415  (an extra)

    tiling = options.tiling
    if tiling.executor == "ray":
        with ray_cluster(tiling.address):
            yield RayTasks(1, jobs=tiling.jobs)
        return
    jobs = tiling.jobs or (1 if tiling.tile_points is not None else choose(cores=tasks.cores()))
    if jobs > 1:
        yield tasks.ProcessTasks([tasks.slot_environment(max(1, tasks.cores() // jobs))] * jobs)
    else:
        yield tasks.HereTasks()


def _write(
    options: Options,
    source: Source,
    tiled: Tiled,
    progress: Progress,
    provenance: Mapping[str, object],
) -> WriteReport:
    """Write the scene, its points a piece at a time."""
    from splatseed.tiles import FileSource, SceneSource  # noqa: PLC0415  (Numba)

    about: dict[str, Any] = {**provenance, "tiles": tiled.tiles, "origin": tiled.origin}
    repeated = tiled.num_repeated
    num_new, code = tiled.num_new - repeated, source_code(options.method)
    if isinstance(source, SceneSource):
        scene = source.scene
        stream = PointStream(
            0, num_new, code, lambda: tiled.new_distinct(progress), (), (0, repeated)
        )
    else:
        assert isinstance(source, FileSource)  # noqa: S101  (the two there are)
        file = source.cloud.path
        scene, about["source"] = Scene(PointCloud.empty()), str(file)
        stream = PointStream(
            tiled.num_original, num_new, code,
            lambda: chain(tiled.originals(progress), tiled.new_distinct(progress)),
            (file,), (tiled.non_finite, tiled.repeats + repeated),
        )  # fmt: skip
    return write_scene(
        scene, options.output, format=options.format, overwrite=options.overwrite,
        copy_images=options.copy_images, provenance=about, stream=stream,
    )  # fmt: skip


def _summarise(
    options: Options, tiled: Tiled, report: WriteReport, seconds: Mapping[str, float]
) -> None:
    """Print the final table."""
    new = report.num_points - tiled.num_original
    made = f"{tiled.num_original:,} original, {new:,} {options.method}"
    out = f"{report.dropped_nonfinite:,} not finite, {report.dropped_duplicates:,} duplicate"
    rows = [
        ("points in", f"{tiled.num_original:,}"),
        ("points out", f"{report.num_points:,} ({made})"),
        ("left out", out),
        ("tiles", f"{tiled.tiles:,}"),
        ("seconds", ", ".join(f"{stage} {time:.2f}" for stage, time in seconds.items())),
        ("output", str(options.output)),
    ]
    if not report.dropped_nonfinite + report.dropped_duplicates:
        rows.remove(("left out", out))
    print_pairs("splatseed upsample", rows)
    if any(tiled.origin):
        away = ", ".join(f"{each:,.0f}" for each in tiled.origin)
        print_note(
            f"The cloud lies far from zero, where float32 is coarse: ({away}) was subtracted from"
            " all points. splatseed.json has it as origin."
        )
    for note in report.notes:
        print_note(note)
    if not any(tiled.origin) and options.scene.is_dir():
        scene = load_scene(options.scene, require_points=False)
        tell_training(options.scene, scene, options.output, report.layout)


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
