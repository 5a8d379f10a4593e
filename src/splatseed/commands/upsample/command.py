"""``splatseed upsample``: read a scene, add points, write a scene that trainers load unchanged."""

from __future__ import annotations

import dataclasses
from argparse import ArgumentParser
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro

from splatseed.commands.options import MaskChoice, check_least, parse_options, refuse
from splatseed.commands.outputs import check_free
from splatseed.commands.upsample import output
from splatseed.commands.upsample.cloud import load_cloud
from splatseed.console import OUT, StageClock, print_note, stage_display
from splatseed.depthmap import DepthKind
from splatseed.io import find_depths, load_originals, write_scene
from splatseed.io.clouds import open_cloud
from splatseed.io.colmap_model import scene_root
from splatseed.io.load import with_own_depths
from splatseed.io.masks import with_masks
from splatseed.io.origin import RECENTER, middle_of_cameras, moved_by, place_words
from splatseed.io.staging import check_output
from splatseed.methods import (
    METHODS,
    Profile,
    Upsampler,
    configure,
    number_of_new,
    planned_size,
    traits_of,
)
from splatseed.photos.sight import stray_notes
from splatseed.runtime.memory import bytes_of
from splatseed.scene import Scene
from splatseed.seeding import photo_methods
from splatseed.seeding.advice import DEFAULT_METHOD, method_for
from splatseed.seeding.upsampling import points_within, upsample
from splatseed.text import counted, quoted, visible

FILES = (".ply", ".las", ".laz", ".e57", ".pcd", ".xyz", ".pts", ".npz", ".bin", ".txt")
"""Suffixes by which somebody means a file of points."""
COVERING = ("auto", "cover")
"""Methods that leave no gaps for --cover."""
CLOUD = "cloud"
WITH_CLOUD = (CLOUD, "auto", "stereo", "cover", "depth")
"""Methods that --cloud can be combined with."""


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
    """Total points per original point, for methods that interpolate; 4 unless --num-points is
    given."""
    num_points: int | None = None
    """Total points, not a ratio."""
    budget: Annotated[str | None, tyro.conf.arg(metavar="N|Xrho")] = None
    """Maximum points: a number, or 0.25rho for a quarter of a full-size photograph's pixels."""
    cover_cell: Annotated[int | None, tyro.conf.arg(name="cover")] = None
    """Cell side in pixels: each cell of a photograph that no point falls in gets a seed; auto and
    cover have --auto.cell and --cover.cell instead."""
    verify: bool = False
    """Move interpolated points to where the photographs agree; drop those that fit nowhere."""
    seed: int = 0
    """Random seed: same seed, same bytes."""
    profile: Profile = "default"
    """Defaults of the methods' options: improved ones, or those of the paper's text."""
    depth_maps: Annotated[Path | None, tyro.conf.arg(name="depth", metavar="DIR")] = None
    """For --method depth: a folder of maps, as docs/formats.md lists them; by default the
    scene's own."""
    depth_kind: DepthKind | None = None
    """What the maps hold: planar depth, distance along the ray, or inverse depth; by default
    what the folder says, else z."""
    depth_scale: float | None = None
    """Stored units per unit of depth: 1000 for millimetres in a scene in metres; by default what
    the folder says."""
    masks: MaskChoice = None
    """A folder of masks, where pixels of 0 do not count, or none; inverted: only they count. By
    default the folder masks beside the photographs, and transparency."""
    refine_poses: bool = False
    """First refine a phone's or SLAM's poses and triangulate points; both replace the scene's."""
    cloud_files: Annotated[
        tyro.conf.UseAppendAction[tuple[Path, ...]],
        tyro.conf.arg(name="cloud", metavar="FILE", help_behavior_hint="(repeatable)"),
    ] = ()
    """Seeds from a scan or dense cloud (docs/scans.md), alone or with
    auto, stereo, cover or depth."""
    cloud_transform: Annotated[Path | None, tyro.conf.arg(name="transform")] = None
    """For --cloud: a 4x4 matrix from its frame to the scene's, as text or JSON, or nerfstudio's
    dataparser_transforms.json."""
    align: bool = False
    """For --cloud: find --transform from the scene's points."""
    recenter: bool = False
    """Write the scene, and a cloud in its frame, around 0, with the offset in recenter.json."""
    memory: Annotated[str | None, tyro.conf.arg(metavar="BYTES|4G")] = None
    """For --cloud: the memory within which scans are merged; by default what is free, at most
    4G."""
    preview: bool = False
    """Also write pictures: before and after, origins, cells covered, the method's stereo maps."""
    gaussians: Path | None = None
    """Also write the initial Gaussians as a 3DGS .ply, for trainers that start from one."""
    format: Literal["auto", "colmap", "transforms"] = "auto"
    """Layout to write: auto is the input's."""
    copy_images: bool = False
    """Copy images, do not link them."""
    overwrite: bool = False
    """Replace an earlier output."""

    @property
    def memory_bytes(self) -> int | None:
        """Most bytes of memory, if the user says so."""
        return None if self.memory is None else bytes_of(self.memory)


def parse(arguments: list[str]) -> tuple[Options, dict[str, Upsampler]]:
    """The options, and every method with its parameters, from the words of the command line."""
    parser = ArgumentParser(add_help=False, allow_abbrev=False)
    for option in ("--profile", "--method"):
        parser.add_argument(option, nargs="?")  # what is missing, tyro tells
    named = parser.parse_known_args(arguments)[0]
    # The profile sets the defaults of the methods' options, so it is parsed before them.
    profile: Profile = named.profile if named.profile in get_args(Profile) else "default"
    names: Collection[str] = METHODS
    if {"-h", "--help"} & set(arguments):  # all methods' options would be too much to read
        names = {named.method} & set(METHODS)
    methods = {name: configure(name, profile) for name in names}
    options: Any = parse_options(_with_methods(methods), "upsample", arguments)
    if options.cloud_files and named.method is None:
        options = replace(options, method=CLOUD)
    return options, {name: getattr(options, name) for name in METHODS}


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
    _check(options)
    planned_size(1, options.ratio, None if options.ratio is None else options.num_points)
    inputs = (options.scene, options.depth_maps, options.cloud_transform, *options.cloud_files)
    protect = [path for path in inputs if path is not None]
    protect += [scene_root(options.scene)] if options.scene.is_dir() else []
    check_output(options.output, kind="upsample", overwrite=options.overwrite, protect=protect)
    if options.gaussians is not None:
        check_free(options.gaussians, overwrite=options.overwrite, protect=protect)
    for file in options.cloud_files:
        open_cloud(file)  # reads headers only: what is wrong is told before work begins
    _upsample(options, methods)


def _check(options: Options) -> None:
    """Refuse options out of their range, and those that another makes pointless."""
    check_least(options, 1, "num_points")
    check_least(options, 0, "seed")
    method, cell, folder = options.method, options.cover_cell, options.output
    maps = options.depth_kind is not None or options.depth_scale is not None
    moved = options.cloud_transform is not None
    framed = moved or options.align or method == CLOUD
    refuse(
        (folder.suffix.lower() in FILES and not folder.is_dir(),
         "a folder for -o, as a whole scene is written", f"{folder}, the name of a file",
         f"Pass -o {quoted(folder.parent / folder.stem)}: a .ply of the points is included."),
        (cell is not None and cell < 1, "--cover of 1 or more", cell, "Try --cover 8."),
        (cell is not None and method in COVERING,
         f"--{method}.cell for method {method}, which already covers", f"--cover {cell}",
         f"Use --{method}.cell {cell} instead."),
        (maps and options.depth_maps is None,
         "--depth DIR, which --depth-kind and --depth-scale refer to", "none", "Name the folder."),
        (framed and not options.cloud_files, "--cloud FILE", "none", "Name the scan."),
        (options.memory is not None and not options.cloud_files,
         "--cloud FILE with --memory, within which scans are merged", "none", "Leave it out."),
        (options.cloud_files and method not in WITH_CLOUD,
         f"--method {', '.join(WITH_CLOUD[:-1])} or {WITH_CLOUD[-1]} with --cloud", method,
         "Leave --method out for the cloud's points alone: interpolating needs no scan."),
        (options.align and moved, "--align or --transform", "both", "Leave one of them out."),
    )  # fmt: skip
    if (start := options.gaussians) is not None:
        inside = folder.resolve() in (start.resolve(), *start.resolve().parents)
        refuse(
            (start.suffix.lower() != ".ply", "--gaussians FILE.ply", start, "Name a .ply file."),
            (inside, "a file outside the scene that is written, for the initial Gaussians",
             f"{start} in {folder}, where some trainers read any .ply as points",
             "Name a file beside the folder."),
        )  # fmt: skip


def _upsample(options: Options, methods: dict[str, Any]) -> None:
    notes: list[str] = []
    with stage_display() as clock:
        clock("read", 0.0)
        scene = _read(options, methods[options.method])
        if options.gaussians is not None:
            photo_methods.photographed(scene, without="leave out --gaussians")  # they bound sizes
        if options.refine_poses:
            from splatseed.sfm import refined

            clock.expect("features", "matching", "refinement", "triangulation", "undistortion")
            held = getattr(methods[options.method], "test_every", 0)
            scene, told = refined(scene, options.seed, clock, test_every=held)
            notes.append(told)
        if options.recenter:
            scene = moved_by(scene, middle_of_cameras(scene))
            around = f"written around {place_words(scene.offset)}, as {RECENTER} has it."
            there = "around 0 already: --recenter changes nothing."
            notes.append(f"The scene is {around if scene.offset.any() else there}")
        if options.method == DEFAULT_METHOD:  # which needs photographs
            options = replace(options, method=str(method_for(scene, note=notes.append)))
        cloud, extra_method = None, None
        if options.cloud_files:
            cloud = load_cloud(options, scene, methods[CLOUD], clock)
            scene, methods = cloud.scene, {**methods, CLOUD: cloud.method}
            notes += cloud.notes
            if options.method != CLOUD:
                extra_method = replace(cloud.method, alone=False)
        method, count = methods[options.method], len(scene.points)
        new = number_of_new(method, options.method, count, options.ratio, options.num_points)
        total = None if new is None else count + new
        most = None if options.budget is None else points_within(scene, options.budget)
    asked = {"--verify": options.verify, "--cover": options.cover_cell is not None}
    number = output.number_words(total, most, [name for name, given in asked.items() if given])
    _announce(options, scene, methods, number, "" if cloud is None else cloud.takes)
    with stage_display(clock):
        seeds = upsample(
            scene, method, num_points=total, budget=options.budget, cover=options.cover_cell,
            verify=options.verify, extra_method=extra_method, seed=options.seed, progress=clock,
            note=notes.append,
        )  # fmt: skip
        clock("check", 0.0)
        findings = output.findings(scene, seeds, method)
        clock("write", 0.0)
        seeded = scene.replace(points=seeds)
        report = write_scene(
            seeded, options.output, format=options.format, overwrite=options.overwrite,
            copy_images=options.copy_images, provenance=output.provenance(options, scene, method),
        )  # fmt: skip
        if cloud is not None:
            cloud.write(options.output)
        _write_more(options, scene, seeded, method, clock)
        seconds = clock.seconds()
    if options.gaussians is not None:
        notes.append(f"The initial Gaussians are in {visible(options.gaussians)}.")
    origins = output.origins_of(seeds, report.num_points)
    output.summarise(options, scene, len(scene.points), origins, report, seconds, findings)
    for sentence in notes:
        print_note(sentence)


def _write_more(
    options: Options, scene: Scene, seeded: Scene, method: Upsampler, clock: StageClock
) -> None:
    """Write what was asked for beside the scene, which is there already."""
    try:
        if options.gaussians is not None:
            output.write_start(options.gaussians, seeded, method, clock)
        if options.preview:
            output.write_previews(options, scene, seeded.points, method, clock)
    except KeyboardInterrupt as stop:
        whole = f"The scene in {visible(options.output)} is whole"
        stop.add_note(f"{whole}; its pictures or initial Gaussians may be missing.")
        raise


def _read(options: Options, method: Upsampler) -> Scene:
    """The scene's originals, and its depth maps if their folder is named."""
    needed = "points" in traits_of(method).needs
    scene = with_masks(load_originals(options.scene, require_points=needed), options.masks)
    if options.depth_maps is not None:
        kind, scale = options.depth_kind, options.depth_scale
        return scene.replace(depths=find_depths(scene, options.depth_maps, kind=kind, scale=scale))
    return with_own_depths(scene) if options.method == "depth" else scene


def _announce(
    options: Options, scene: Scene, methods: Mapping[str, Upsampler], number: str, takes: str
) -> None:
    """Print what will be done, what a cloud takes, and which flags have no effect."""
    for warning in (*scene.warnings, *stray_notes(scene)):
        print_note(warning)
    name, method = options.method, methods[options.method]
    if (listed := scene.listed) is not None and hasattr(method, "test_every"):
        tests = counted(len(listed.test), "test image")
        print_note(f"{tests} of the scene's {listed.origin} take no part in the seeds.")
    for other, given in methods.items():
        changed = given != configure(other, options.profile) and not (
            other == CLOUD and options.cloud_files
        )
        if other != name and (changed or (other == "depth" and options.depth_maps is not None)):
            print_note(f"The flags of {other} have no effect with --method {name}.")
    if options.profile == "paper" and configure(name, "paper") == configure(name):
        print_note(f"Profile paper changes nothing for method {name}.")
    how = ""
    if isinstance(method, photo_methods.Stereo) and not photo_methods.begins_from_points(scene):
        points = "too few" if photo_methods.has_points(scene) else "no"
        where = "" if scene.depths is None else ", around its depth maps"
        how = f": {points} points, so depth is found by comparing photographs{where}"
    kind = scene.source.format if scene.source else "memory"
    size = f"{counted(len(scene.images), 'image')}, {counted(len(scene.points), 'point')}"
    OUT.print(
        f"{visible(options.scene)} ({kind}, {size})\n"
        f"  -> {output.method_words(name, method, options.profile)}{how}\n  "
        f"-> {visible(options.output)} ({number}, seed {options.seed}){takes}",
        soft_wrap=True,
    )
