"""``splatseed upsample``: read a scene, add points, write a scene that trainers load unchanged."""

from __future__ import annotations

import dataclasses
from argparse import ArgumentParser
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast, get_args

import tyro

from splatseed.commands.options import check_least, parse_options
from splatseed.commands.upsample.cloud import CLOUD, CloudOptions, load_clouds, with_cloud_defaults
from splatseed.commands.upsample.output import (
    PICTURES,
    check_start,
    found_how,
    method_words,
    number_words,
    parameters_of,
    summarise,
    write_previews,
    write_start,
)
from splatseed.commands.upsample.tiled import Tiling, find_source, run_tiled
from splatseed.console import (
    OUT,
    StageClock,
    print_note,
    stage_display,
)
from splatseed.depthmap import DepthKind
from splatseed.errors import ParameterError
from splatseed.io import WriteReport, find_depths, load_originals, write_scene
from splatseed.io.clouds import open_cloud
from splatseed.io.depth_search import with_own_depths
from splatseed.io.staging import check_output
from splatseed.literal import counted, quoted, visible
from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.runtime.memory import bytes_of
from splatseed.scene import Scene
from splatseed.seeding.advice import DEFAULT_METHOD, method_for
from splatseed.seeding.diagnostics import far_share
from splatseed.seeding.photographs import photographed
from splatseed.seeding.upsampling import points_within, share_covered, upsample
from splatseed.upsample import (
    METHODS,
    Profile,
    Upsampler,
    chooses_number,
    configure,
    number_of_new,
    planned_size,
    traits_of,
)

if TYPE_CHECKING:
    from splatseed.seeding.clouds.method import Cloud, GivenClouds


FILES = (".ply", ".las", ".laz", ".e57", ".pcd", ".xyz", ".pts", ".npz", ".bin", ".txt")
"""Suffixes by which somebody means a file of points."""
COVERING = ("auto", "cover")
"""Methods that leave no gaps for --cover."""


@dataclass(frozen=True)
class Options:
    """Upsample the points of a scene, ready for any 3DGS trainer."""

    scene: Annotated[Path, tyro.conf.Positional]
    """A COLMAP folder, one with transforms.json, an RGB-D capture, or a cloud (.ply, .las, .laz,
    .e57, .xyz ...)."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The scene folder to write."""
    method: str = DEFAULT_METHOD
    """The method that makes new points; --method NAME --help shows its own options."""
    ratio: float | None = None
    """Points in all over originals, for methods that interpolate: 4, unless --num-points says how
    many."""
    num_points: int | None = None
    """Points in all, not a ratio."""
    budget: Annotated[str | None, tyro.conf.arg(metavar="N|Xrho")] = None
    """Most points in all: a number, or 0.25rho for a quarter of a full photograph's pixels."""
    cover_cell: Annotated[int | None, tyro.conf.arg(name="cover")] = None
    """Side in pixels of the parts of the photographs that get a seed if no point falls in; auto and
    cover have --auto.cell and --cover.cell instead."""
    verify: bool = False
    """Slide interpolated points to where the photographs agree, and drop those that fit none."""
    seed: int = 0
    """The same seed gives the same bytes."""
    profile: Profile = "default"
    """Defaults of the methods' options: improved ones, or those of the paper's text."""
    depth_maps: Annotated[Path | None, tyro.conf.arg(name="depth", metavar="DIR")] = None
    """For --method depth: a folder of maps, as docs/formats.md lists them; by default the
    scene's own."""
    depth_kind: DepthKind | None = None
    """What their values are: planar depth, distance along the ray, or inverse depth; by default
    what the folder says, else z."""
    depth_scale: float | None = None
    """Stored units per unit of depth: 1000 for millimetres in a scene in metres; by default what
    the folder says."""
    refine_poses: bool = False
    """Refine poses of a phone or SLAM first, and triangulate points; they replace the scene's."""
    cloud_files: Annotated[
        tyro.conf.UseAppendAction[tuple[Path, ...]],
        tyro.conf.arg(name="cloud", metavar="FILE", help_behavior_hint="(repeatable)"),
    ] = ()
    """Seeds from a scan or dense cloud (docs/scans.md), alone or beside
    auto, stereo, cover or depth."""
    cloud_transform: Annotated[Path | None, tyro.conf.arg(name="transform")] = None
    """For --cloud: a 4x4 matrix from its frame to the scene's, as text or JSON, or nerfstudio's
    dataparser_transforms.json."""
    align: bool = False
    """For --cloud: find that matrix, by the scene's own points."""
    recenter: bool = False
    """Write scene and cloud around 0, with the offset in recenter.json: for national grids."""
    memory: Annotated[str | None, tyro.conf.arg(metavar="BYTES|4G")] = None
    """Most memory, by default what is free: larger clouds are upsampled in tiles on disk; --cloud
    merges more points (in at most 4G by default)."""
    jobs: int | None = None
    """Tiles at a time, each in a process of its own; by default as many as cores and memory
    allow."""
    executor: Literal["local", "ray"] = "local"
    """Where tiles run: on this machine, or on a Ray cluster that shares its disk."""
    address: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT|auto")] = None
    """The cluster's address, or auto on one of its nodes; by default a cluster on this machine."""
    tile_points: int | None = None
    """Most points in a tile; by default what the memory allows."""
    preview: bool = False
    """Also write pictures: before and after, origins, cells covered, the method's stereo maps."""
    gaussians: Path | None = None
    """Also write the initial Gaussians as a 3DGS .ply, for trainers that start from one."""
    format: Literal["auto", "colmap", "transforms"] = "auto"
    """Layout to write: auto is the input's."""
    copy_images: bool = False
    """Copy images, do not link them."""
    overwrite: bool = False
    """Replace an output of splatseed's."""

    @property
    def memory_bytes(self) -> int | None:
        """Most bytes of memory, if the user says so."""
        return None if self.memory is None else bytes_of(self.memory)

    @property
    def tiling(self) -> Tiling:
        """The options about memory and who works."""
        return Tiling(self.memory_bytes, self.jobs, self.executor, self.address, self.tile_points)

    @property
    def cloud_options(self) -> CloudOptions:
        """The options about clouds."""
        return CloudOptions(
            self.cloud_files, self.cloud_transform, self.align, self.recenter, self.memory_bytes
        )


def parse(arguments: list[str]) -> tuple[Options, dict[str, Upsampler]]:
    """The options, and every method with its parameters, from the words of the command line."""
    profile = _profile_of(arguments)
    names: Collection[str] = METHODS
    if {"-h", "--help"} & set(arguments):  # all methods' options would be too much to read
        names = [name for name in METHODS if {name, f"--method={name}"} & set(arguments)]
    methods = {name: configure(name, profile) for name in names}
    options: Any = parse_options(_with_methods(methods), "upsample", arguments)
    return with_cloud_defaults(options, arguments), {
        name: getattr(options, name) for name in METHODS
    }


def _profile_of(arguments: Sequence[str]) -> Profile:
    """The profile, which sets the defaults of the methods' options; parsed before all others."""
    parser = ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--profile")
    named = parser.parse_known_args(arguments)[0].profile
    return named if named in get_args(Profile) else "default"


def full_options() -> type[Options]:
    """The options with those of every method."""
    return _with_methods({name: configure(name) for name in METHODS})


def _with_methods(methods: Mapping[str, Upsampler]) -> type[Options]:
    """The options with one more field per method, whose default is the method given."""
    fields: list[Any] = [
        (name, type(method), dataclasses.field(default=method)) for name, method in methods.items()
    ]
    full = dataclasses.make_dataclass(
        "UpsampleOptions",
        [("method", Literal[tuple(METHODS)], dataclasses.field(default=DEFAULT_METHOD)), *fields],
        bases=(Options,),
        frozen=True,
    )
    full.__doc__ = Options.__doc__
    return full


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options, methods = parse(arguments)
    _check_options(options)
    planned_size(1, options.ratio, None if options.ratio is None else options.num_points)
    given = (options.scene, options.depth_maps, options.cloud_transform, *options.cloud_files)
    inputs = [path for path in given if path is not None]
    check_output(options.output, kind="upsample", overwrite=options.overwrite, protect=inputs)
    if options.gaussians is not None:
        check_start(options.gaussians, options.output, overwrite=options.overwrite)
    for file in options.cloud_files:
        open_cloud(file)  # reads headers only: what is wrong is told before work begins
    source = find_source(options, methods)
    if source is not None:
        run_tiled(options, methods, source, _provenance)
        return
    _run_in_memory(options, methods)


def _check_options(options: Options) -> None:
    """Refuse options out of their range, and those that another makes pointless.

    Raises:
        ParameterError: There is such an option.
    """
    check_least(options, 1, "num_points", "jobs", "tile_points")
    check_least(options, 0, "seed")
    if options.output.suffix.lower() in FILES and not options.output.is_dir():
        raise ParameterError(
            "a folder after -o, as a whole scene is written",
            found=f"{options.output}, the name of a file",
            fix=f"Pass -o {quoted(options.output.with_suffix(''))}: the points lie there as a .ply "
            "too.",
        )
    if options.address is not None and options.executor != "ray":
        raise ParameterError("--executor ray with --address", found="local", fix="Add it.")
    if options.cover_cell is None:
        return
    if options.cover_cell < 1:
        found = f"{options.cover_cell}"
        raise ParameterError("--cover of 1 or more", found=found, fix="Try --cover 8.")
    if options.method in COVERING:
        raise ParameterError(
            f"--{options.method}.cell for method {options.method}, which covers by itself",
            found=f"--cover {options.cover_cell}",
            fix=f"Say --{options.method}.cell {options.cover_cell} instead.",
        )


def _run_in_memory(options: Options, methods: dict[str, Upsampler]) -> None:
    """Upsample a scene that fits into memory whole."""
    notes: list[str] = []
    with stage_display() as clock:
        clock("read", 0.0)
        scene = _read(options, methods[options.method])
        if options.gaussians is not None:
            photographed(scene, without="leave out --gaussians")  # views bound their sizes
        if options.refine_poses:
            from splatseed.sfm import refined  # noqa: PLC0415  (loads with its use)

            clock.expect("features", "matching", "refinement", "triangulation", "undistortion")
            scene, told = refined(scene, options.seed, clock)
            notes.append(told)
        options = _settle(options, scene, notes)
        plain = cast("Cloud", methods[CLOUD])
        brought = load_clouds(options.cloud_options, scene, plain, clock)
        scene, methods = brought.scene, {**methods, CLOUD: brought.method}
        notes += brought.notes
        method = methods[options.method]
        total = _planned(options, method, len(scene.points))
        most = None if options.budget is None else points_within(scene, options.budget)
    given = {"--verify": options.verify, "--cover": options.cover_cell is not None}
    changed_by = [option for option, is_given in given.items() if is_given]
    number = number_words(total, most, changed_by)
    _announce(options, scene, method, number, _idle(options, methods), brought.takes)
    with stage_display(clock):
        extra_method = None
        if options.cloud_files and options.method != CLOUD:
            extra_method = dataclasses.replace(cast("GivenClouds", methods[CLOUD]), alone=False)
        seeds = _make(options, scene, method, extra_method, total, clock, notes)
        clock("check", 0.0)
        checks = _check(scene, seeds, method)
        clock("write", 0.0)
        report = _write(options, scene.replace(points=seeds), method)
        brought.write(options.output)
        if options.gaussians is not None:
            write_start(options.gaussians, scene.replace(points=seeds), method, clock)
            notes.append(f"The initial Gaussians are in {visible(options.gaussians)}.")
        if options.preview:
            write_previews(
                scene, seeds, options.method, method, options.seed, options.output, clock
            )
        seconds = clock.seconds()
    files = {"alignment": brought.aligned, "pictures": PICTURES}
    summarise(options.scene, scene, seeds, report, seconds, checks, options.output, files)
    for sentence in notes:
        print_note(sentence)


def _settle(options: Options, scene: Scene, notes: list[str]) -> Options:
    """The options with the method that will be used: the default needs photographs."""
    if options.method != DEFAULT_METHOD:
        return options
    method = method_for(scene, options.method, notes.append)
    return dataclasses.replace(options, method=str(method))


def _planned(options: Options, method: Upsampler, count: int) -> int | None:
    """Points in all; None if the photographs determine the number."""
    new = number_of_new(method, options.method, count, options.ratio, options.num_points)
    return None if new is None else count + new


def _make(
    options: Options,
    scene: Scene,
    method: Upsampler,
    extra_method: Upsampler | None,
    total: int | None,
    clock: StageClock,
    notes: list[str],
) -> PointCloud:
    """The originals and the new points."""
    return upsample(
        scene, method, num_points=total, budget=options.budget, cover=options.cover_cell,
        verify=options.verify, extra_method=extra_method, seed=options.seed, progress=clock,
        note=notes.append,
    )  # fmt: skip


def _check(scene: Scene, seeds: PointCloud, method: Upsampler) -> dict[str, float]:
    """How far off the points are, or how much of the photographs they cover."""
    checks = {}
    new = seeds.xyz[seeds.source != ORIGINAL]
    if len(scene.points) and not chooses_number(method):
        checks["far"] = far_share(scene.points.xyz, new)
    if scene.images:
        checks["before"] = share_covered(scene, scene.points)
        checks["after"] = share_covered(scene, seeds)
    return checks


def _read(options: Options, method: Upsampler) -> Scene:
    """The scene's originals, and its depth maps if their folder is named."""
    scene = load_originals(options.scene, require_points="points" in traits_of(method).needs)
    if options.method == "depth" and options.depth_maps is None:
        scene = with_own_depths(scene)
    if options.depth_maps is not None:
        maps = find_depths(
            scene, options.depth_maps, kind=options.depth_kind, scale=options.depth_scale
        )
        return scene.replace(depths=maps)
    if options.depth_kind is not None or options.depth_scale is not None:
        raise ParameterError(
            "--depth DIR, which --depth-kind and --depth-scale refer to",
            found="none",
            fix="Name the folder.",
        )
    return scene


def _announce(
    options: Options,
    scene: Scene,
    method: Upsampler,
    number: str,
    idle: Sequence[str],
    takes: str,
) -> None:
    """Print what will be done, what a cloud takes, and which flags have no effect."""
    for warning in scene.warnings:
        print_note(warning)
    for name in idle:
        print_note(f"The flags of {name} have no effect with --method {options.method}.")
    if options.profile == "paper" and configure(options.method, "paper") == configure(
        options.method
    ):
        print_note(f"Profile paper changes nothing for method {options.method}.")
    kind = scene.source.format if scene.source else "memory"
    how = found_how(scene, method)
    size = f"{counted(len(scene.images), 'image')}, {counted(len(scene.points), 'point')}"
    OUT.print(
        f"{visible(options.scene)} ({kind}, {size})\n"
        f"  -> {method_words(options.method, method, options.profile)}{how}\n  "
        f"-> {visible(options.output)} ({number}, seed {options.seed}){takes}",
        soft_wrap=True,
    )


def _idle(options: Options, methods: dict[str, Upsampler]) -> list[str]:
    """Methods whose flags were changed although they are not used."""
    plain = {name: configure(name, options.profile) for name in methods}
    changed = {name for name in methods if methods[name] != plain[name]}
    if options.depth_maps is not None:
        changed.add("depth")
    changed -= {CLOUD} if options.cloud_files else set()
    return [name for name in methods if name in changed - {options.method}]


def _write(options: Options, scene: Scene, method: Upsampler) -> WriteReport:
    return write_scene(
        scene,
        options.output,
        format=options.format,
        overwrite=options.overwrite,
        copy_images=options.copy_images,
        provenance=_provenance(options, method),
    )


def _provenance(options: Options, method: Upsampler) -> dict[str, object]:
    """How the output was made, for ``splatseed.json``."""
    return {
        "command": "upsample",
        "method": options.method,
        "profile": options.profile,
        "parameters": parameters_of(method),
        "cloud": options.cloud_options.provenance if options.cloud_files else None,
        "depth": None if options.depth_maps is None else str(options.depth_maps.resolve()),
        "ratio": options.ratio,
        "num_points_asked": options.num_points,
        "budget": options.budget,
        "cover": options.cover_cell,
        "verify": options.verify,
        "seed": options.seed,
    }
